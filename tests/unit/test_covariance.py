"""Standard errors against closed forms and brute force: every interval rests on them."""

from dataclasses import replace
from types import SimpleNamespace as Stub

import numpy as np
import pytest
from scipy.stats import norm
from scipy.stats import t as student

from ehbench.identification import covariance
from ehbench.identification.covariance import (
    Block,
    Covariance,
    Prior,
    covariance_of,
    eliminate,
    gains_of,
    release_of,
)
from ehbench.identification.matching import Matching
from ehbench.identification.problem import prior_of
from ehbench.preprocessing.observations import count_error
from tests.settings import answers

NONE = Prior(np.zeros(2), np.zeros(2), 1.0)


def regressors(count: int) -> np.ndarray:
    """Two smooth regressors, shape (count, 2)."""
    x = np.linspace(0.0, 1.0, count)
    return np.column_stack([np.sin(6.0 * x), np.cos(11.0 * x) + 0.3])


def block_of(columns, starts, left, shifts, channels=("a",)):
    """What a log says that has no readings in counts."""
    return Block(channels, columns, starts, left, shifts, left, np.zeros(1))


def solved(columns, noise, nuisances=None, weight=1.0, channels=("a",)):
    """A block of one log at the minimum of its least squares (weight of the nuisances' priors)."""
    whole = columns if nuisances is None else np.column_stack([columns, nuisances])
    count = whole.shape[1] - columns.shape[1]
    penalty = np.diag([0.0] * columns.shape[1] + [weight] * count)
    best = np.linalg.solve(whole.T @ whole + penalty, whole.T @ noise)
    rest = (noise - whole @ best)[:, None]
    starts = np.zeros((len(noise), 1, 0)) if nuisances is None else nuisances[:, None, :]
    return block_of(columns[:, None, :], starts, rest, -best[columns.shape[1] :], channels)


def ar1(rng, count, pole):
    """Unit innovations through a pole, from the stationary start."""
    noise = rng.standard_normal(count)
    noise[0] /= np.sqrt(1.0 - pole**2)
    for k in range(1, count):
        noise[k] += pole * noise[k - 1]
    return noise


def sandwich(columns: np.ndarray, autocovariance: np.ndarray) -> np.ndarray:
    """(JᵀJ)⁻¹ Jᵀ Σ J (JᵀJ)⁻¹ with the Toeplitz Σ written out."""
    count = len(columns)
    lags = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    bread = np.linalg.inv(columns.T @ columns)
    return bread @ columns.T @ autocovariance[lags] @ columns @ bread


@pytest.mark.parametrize("pole", [0.0, 0.6, 0.9])
@pytest.mark.parametrize("which", ["hac", "acf"])
def test_coloured_noise_gives_the_analytic_sandwich(pole, which):
    columns, rng = regressors(1500), np.random.default_rng(3)
    truth = sandwich(columns, pole ** np.arange(1500) / (1.0 - pole**2))
    stds = [
        np.sqrt(
            np.diag(getattr(covariance_of([solved(columns, ar1(rng, 1500, pole))], NONE), which))
        )
        for _ in range(40)
    ]
    ratio = np.mean(stds, axis=0) / np.sqrt(np.diag(truth))
    # Bartlett weights to four correlation times leave out a part of the colour
    assert np.all((0.85 < ratio) & (ratio < 1.08)), ratio


def test_scores_have_the_weights_of_bartlett_and_the_quantile_of_their_share():
    """To four correlation times of 2.3 samples, that is 10 lags of 400."""
    block = solved(regressors(400), ar1(np.random.default_rng(2), 400, 0.6))
    columns, left = block.jacobian[:, 0], block.residuals[:, 0]
    scores = columns * left[:, None]
    meat = scores.T @ scores
    for lag in range(1, 11):
        pairs = scores[lag:].T @ scores[:-lag]
        meat += (1.0 - lag / 11.0) * (pairs + pairs.T)
    bread = np.linalg.inv(columns.T @ columns)
    with answers(covariance, correlation_time=2.3):
        found = covariance_of([block], NONE)
    assert found.hac == pytest.approx(bread @ meat @ bread, rel=1e-6)
    share = 10.0 / 400.0  # of the lags
    assert found.quantile == pytest.approx(1.96 + 2.97 * share + 0.416 * share**2)
    nothing = replace(block, jacobian=block.jacobian[..., :0])
    assert covariance_of([nothing], Prior(np.zeros(0), np.zeros(0), 1.0)).quantile == 1.96
    with answers(covariance, correlation_time=1e3):  # no more than a quarter of all
        assert covariance_of([block], NONE).quantile == pytest.approx(1.96 + 2.97 / 4 + 0.416 / 16)


def test_white_noise_gives_the_textbook_covariance():
    columns, rng = regressors(4000), np.random.default_rng(5)
    block = solved(columns, 0.2 * rng.standard_normal(4000))
    square = float(np.sum(block.residuals**2)) / (4000 - 2)
    textbook = np.sqrt(np.diag(square * np.linalg.inv(columns.T @ columns)))
    result = covariance_of([block], NONE)
    assert np.sqrt(np.diag(result.acf)) == pytest.approx(textbook, rel=0.05)
    assert np.sqrt(np.diag(result.hac)) == pytest.approx(textbook, rel=0.15)
    assert np.diag(result.correlation) == pytest.approx(1.0)
    assert result.correlation[0, 1] == pytest.approx(
        -np.sum(columns[:, 0] * columns[:, 1]) / np.sqrt(np.prod(np.sum(columns**2, axis=0))),
        abs=0.1,
    )


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_standard_errors_go_with_the_unit_of_the_parameters(unit):
    """Of three logs that disagree, with starts, readings in counts and a prior."""
    rng, columns, blocks = np.random.default_rng(6), regressors(600), []
    for off in (-0.6, 0.2, 0.4):
        start = np.exp(-8.0 * np.linspace(0.0, 1.0, 600))[:, None]
        block = solved(columns, ar1(rng, 600, 0.5), start)
        left = block.residuals + off * columns[:, :1]
        blocks.append(replace(block, residuals=left, readings=np.round(left), coarse=np.ones(1)))
    prior = Prior(np.array([9.0, 0.0]), np.zeros(2), 1.0)
    plain = covariance_of(blocks, prior)
    others = [replace(block, jacobian=unit * block.jacobian) for block in blocks]
    found = covariance_of(others, replace(prior, sharpness=unit * prior.sharpness))
    for name in ("hac", "acf", "counts", "jackknife"):
        assert unit**2 * getattr(found, name) == pytest.approx(getattr(plain, name), rel=1e-6)
    assert unit * found.alone == pytest.approx(plain.alone)
    for name in ("correlation", "from_data", "from_starts", "quantile"):
        assert getattr(found, name) == pytest.approx(getattr(plain, name), rel=1e-6)
    known, whole = np.zeros((2, 2, 2)) + np.diag(prior.sharpness**2)
    for block in blocks:
        j, s = block.jacobian[:, 0], block.start_jacobian[:, 0]
        known += j.T @ j
        whole += j.T @ j - (j.T @ s) @ (s.T @ j) / (s.T @ s + 1.0)
    best, wide = (np.diag(np.linalg.inv(item)) for item in (known, whole))
    assert plain.from_starts == pytest.approx(1.0 - best / wide)
    assert plain.from_data == pytest.approx(1.0 - prior.sharpness**2 * wide)
    assert 0.01 < plain.from_starts.min() and plain.from_data[0] < 0.95


@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_the_interval_covers_by_brute_force(pole):
    columns, rng, inside = regressors(800), np.random.default_rng(7), 0
    bread = np.linalg.inv(columns.T @ columns) @ columns.T
    for _ in range(300):
        noise = ar1(rng, 800, pole)
        std, quantile, _ = covariance_of([solved(columns, noise)], NONE).error(0)
        inside += abs(float((bread @ noise)[0])) < quantile * std
    assert 0.91 <= inside / 300 <= 0.995  # 95 %, three binomial errors, never much too wide


def test_a_prior_adds_its_information():
    columns, rng = regressors(2000), np.random.default_rng(11)
    sharpness = np.array([60.0, 0.0])
    # at the minimum with the prior
    noise = rng.standard_normal(2000)
    normal = columns.T @ columns + np.diag(sharpness**2)
    best = np.linalg.solve(normal, columns.T @ noise)
    left = (noise - columns @ best)[:, None]
    block = block_of(columns[:, None, :], np.zeros((2000, 1, 0)), left, np.zeros(0))
    result = covariance_of([block], Prior(sharpness, best, 1.0))
    expected = np.linalg.inv(normal)  # unit noise, unit weight
    assert np.sqrt(np.diag(result.acf)) == pytest.approx(np.sqrt(np.diag(expected)), rel=0.06)
    assert result.from_data == pytest.approx([1.0 - 3600.0 * expected[0, 0], 1.0], abs=1e-9)


@pytest.mark.parametrize("weight", [1e-6, 1.0, 1e4])
def test_an_estimated_initial_state_widens_as_in_the_joint_problem(weight):
    columns, rng = regressors(2000), np.random.default_rng(13)
    start = np.exp(-8.0 * np.linspace(0.0, 1.0, 2000))[:, None] * 12.0
    block = solved(columns, rng.standard_normal(2000), start, weight)
    joint = np.column_stack([columns, start])
    normal = joint.T @ joint + np.diag([0.0, 0.0, weight])
    result = covariance_of([block], Prior(np.zeros(2), np.zeros(2), weight))
    # the residual scores carry the noise, the prior of the start carries weight² · 1
    bread = np.linalg.inv(normal)
    expected = (bread @ (joint.T @ joint + np.diag([0.0, 0.0, weight**2])) @ bread)[:2, :2]
    assert np.sqrt(np.diag(result.acf)) == pytest.approx(np.sqrt(np.diag(expected)), rel=0.06)
    known = np.diag(np.linalg.inv(columns.T @ columns))
    share = 1.0 - known / np.diag(bread)[:2]
    assert result.from_starts == pytest.approx(share, abs=1e-6)
    item = eliminate(block, weight)
    assert item.normal == pytest.approx(np.linalg.inv(np.linalg.inv(normal)[:2, :2]), rel=1e-6)


def test_logs_that_disagree_are_jackknifed():
    columns, rng = regressors(400), np.random.default_rng(17)
    logs = [columns * (1.0 + 0.1 * k) for k in range(6)]
    off = [np.array([0.3, -0.2]) * side for side in (1, -1, 2, -2, 1, -1)]
    noise = [
        part @ move + 0.05 * rng.standard_normal(400) for part, move in zip(logs, off, strict=True)
    ]
    normal = sum(part.T @ part for part in logs)
    pull = sum(part.T @ y for part, y in zip(logs, noise, strict=True))
    best = np.linalg.solve(normal, pull)
    empty = np.zeros((400, 1, 0))
    blocks = [
        block_of(part[:, None, :], empty, (y - part @ best)[:, None], np.zeros(0))
        for part, y in zip(logs, noise, strict=True)
    ]
    alone = np.array(
        [
            np.linalg.solve(normal - part.T @ part, pull - part.T @ y)
            for part, y in zip(logs, noise, strict=True)
        ]
    )
    expected = 5.0 / 6.0 * np.sum((alone - alone.mean(axis=0)) ** 2, axis=0)
    result = covariance_of(blocks, NONE)
    assert result.jackknife is not None
    assert np.diag(result.jackknife) == pytest.approx(expected, rel=1e-9)
    std, quantile, source = result.error(0)
    assert source == "jackknife" and std == pytest.approx(np.sqrt(expected[0]))
    assert quantile == pytest.approx(student.ppf(0.975, 5), rel=1e-9)
    white = [block_of(rng.standard_normal((400, 1, 2)), empty, rng.standard_normal((400, 1)),
                      np.zeros(0)) for _ in range(3)]  # fmt: skip
    assert covariance_of(white, NONE).jackknife is None


def test_readings_in_counts_are_off_alike_where_they_read_alike():
    count, rng, errors = 0.7, np.random.default_rng(19), []
    columns = np.column_stack([np.linspace(0.0, 1.0, 600), np.ones(600)])
    for _ in range(400):
        true = np.repeat(rng.uniform(-5.0, 5.0, 3), 200)  # rests at three levels
        read = count * np.round(true / count)
        block = solved(columns, read - true)
        block = replace(block, readings=read[:, None], coarse=np.full(1, count / np.sqrt(12.0)))
        result = covariance_of([block], NONE)
        errors.append(np.linalg.lstsq(columns, read - true, rcond=None)[0])
    assert np.sqrt(np.diag(result.counts)) == pytest.approx(np.std(errors, axis=0), rel=0.1)
    assert result.error(0)[2] == "counts"
    nothing = Prior(np.zeros(0), np.zeros(0), 1.0)  # where no parameter is free
    assert covariance_of([replace(block, jacobian=block.jacobian[..., :0])], nothing).hac.size == 0


@pytest.mark.parametrize(("noise", "error"), [(0.0, 1.0), (0.5, 0.01), (1.0, 0.0)])
def test_a_count_is_an_error_of_a_reading_without_noise(noise, error):
    """The first harmonic of the dithered mean's bias: exp(−2(πσ/Δ)²)."""
    rng = np.random.default_rng(23)
    true = np.concatenate([np.full(2000, 3.1), np.linspace(3.1, 9.0, 20)])
    read = 0.5 * np.round((true + 0.5 * noise * rng.standard_normal(2020)) / 0.5)
    assert count_error(read) == pytest.approx(error * 0.5 / np.sqrt(12.0), abs=0.012)


@pytest.mark.parametrize(
    ("variances", "jackknife", "source", "std"),
    [
        ((4.0, 1.0, 1.0), None, "hac", 2.0),
        ((1.0, 4.0, 1.0), None, "acf", 2.0),
        ((0.25, -4.0, 0.01), None, "hac", 0.5),  # no autocovariance need be positive
        ((1.0, 2.0, 9.0), None, "counts", 3.0),
        ((4.0, 4.0, 1.0), 9.0, "jackknife", 3.0),
    ],
)
def test_the_widest_interval_is_taken(variances, jackknife, source, std):
    one = np.ones(1)
    wide = None if jackknife is None else np.array([[jackknife]])
    hac, acf, counts = (np.array([[value]]) for value in variances)
    result = Covariance(hac, acf, counts, wide, 3, one, 1.96, one, one, np.zeros((1, 1)))
    assert result.error(0)[::2] == (std, source)
    off = replace(result, fixed=np.array([[7.0]]))
    assert off.error(0)[::2] == (pytest.approx(np.sqrt(std**2 + 7.0)), source)
    assert off.from_fixed == pytest.approx([7.0 / (7.0 + variances[0])])


@pytest.mark.parametrize("weight", [1e-6, 3.0])
def test_errors_of_fixed_numbers_move_a_fit_as_in_the_joint_problem(weight):
    """Two numbers off by their standard errors: what the best parameters of two logs with starts
    move by adds to their covariance."""
    rng, sharpness = np.random.default_rng(23), np.array([0.0, 5.0])
    logs = [rng.standard_normal((300, 5)) + 0.2 for _ in range(2)]  # parameters, start, numbers
    blocks = [
        block_of(x[:, None, :2], x[:, None, 2:3], rng.standard_normal((300, 1)), np.zeros(1))
        for x in logs
    ]
    rows = np.zeros((603, 4))
    rows[:300, [0, 1, 2]], rows[300:600, [0, 1, 3]] = logs[0][:, :3], logs[1][:, :3]
    rows[600:] = np.sqrt(weight) * np.diag([0.0, 5.0, 1.0, 1.0])[1:]
    off = np.concatenate([logs[0][:, 3:], logs[1][:, 3:], np.zeros((3, 2))])
    moves = np.linalg.lstsq(rows, off, rcond=None)[0][:2]
    prior = Prior(sharpness, np.zeros(2), weight)
    found = covariance_of(blocks, prior, [x[:, None, 3:] for x in logs])
    plain = covariance_of(blocks, prior)
    assert found.fixed == pytest.approx(moves @ moves.T, rel=1e-9)
    assert found.whole - plain.hac == pytest.approx(moves @ moves.T, rel=1e-6)
    assert not plain.fixed.any() and not plain.from_fixed.any()
    assert found.correlation == pytest.approx(plain.correlation)


def test_freeing_a_number_does_what_the_joint_least_squares_say():
    """Two logs with a start each, a prior on the first of two parameters, two numbers behind."""
    rng, weight, sharpness = np.random.default_rng(29), 1.7, 11.0
    prior = Prior(np.array([sharpness, 0.0]), np.array([0.4, 0.0]), weight)
    logs = [rng.standard_normal((300, 5)) + 0.3 for _ in range(2)]  # four columns and a start
    noise = [part @ [0.02, 0.1, 0.3, -0.05, 0.2] + rng.standard_normal(300) for part in logs]
    shifts = [0.6, -0.8]

    def joint(which):
        """(moves of those columns and both starts, the cost there)."""
        rows, right = [], []
        for k, (part, y, shift) in enumerate(zip(logs, noise, shifts, strict=True)):
            start = np.zeros((300, 2))
            start[:, k] = part[:, 4]
            rows += [np.hstack([part[:, which], start])]
            rows += [np.sqrt(weight) * np.eye(len(which) + 2)[[len(which) + k]]]
            right += [y, [np.sqrt(weight) * shift]]
        rows += [np.sqrt(weight) * sharpness * np.eye(len(which) + 2)[[0]]]
        right += [[np.sqrt(weight) * sharpness * 0.4]]
        a, b = np.vstack(rows), np.concatenate(right)
        move = np.linalg.lstsq(a, -b, rcond=None)[0]
        return move, float(np.sum((a @ move + b) ** 2)), a

    def blocks(which):
        return [
            block_of(part[:, None, which], part[:, None, 4:], y[:, None], np.array([shift]))
            for part, y, shift in zip(logs, noise, shifts, strict=True)
        ]

    fixed, before, _ = joint([0, 1])
    behind = gains_of(blocks([0, 1, 2, 3]), prior)
    for k in (2, 3):
        free, after, a = joint([0, 1, k])
        assert behind[k - 2] == pytest.approx(before - after, rel=1e-9)
        given = Prior(np.append(prior.sharpness, 0.0), np.append(prior.off, 0.0), weight)
        result = release_of(blocks([0, 1, k]), given, 0.5 * (before - after))
        assert (result.move, result.gain) == pytest.approx((free[2], before - after), rel=1e-9)
        assert result.follow == pytest.approx(free[:2] - fixed[:2], rel=1e-6, abs=1e-9)
        if k == 2:  # where the other is fixed, what is left is not noise alone
            std = np.sqrt(np.linalg.inv(a.T @ a)[2, 2])
            assert result.std == pytest.approx(std, rel=0.2)
        assert release_of(blocks([0, 1, k]), given, 1.01 * (before - after)).std == np.inf


@pytest.mark.parametrize(
    ("errors", "each", "std"),
    [
        ([0.1, -0.1, 0.3, -0.3, np.nan], 0.01, np.sqrt(np.pi / 2.0 * 0.2 / 3.0 / 4.0)),
        ([0.1, -0.1], 0.01, np.sqrt(0.02 / 2.0)),  # a median of two is a mean
        ([0.1], 0.05, 0.05),
        ([0.01, -0.01, 0.0], 0.2, np.sqrt(np.pi / 2.0) * 0.2 / np.sqrt(3.0)),
    ],
)
@pytest.mark.parametrize("role", ["frequency", "decay"])
def test_windows_give_the_error_of_their_median(errors, each, std, role):
    """By their scatter, or by the error of each ring where that is more; Student's quantile."""
    ring = Stub(natural_frequency=20.0, natural_frequency_std=20.0 * each, damping_ratio_std=each)
    windows = [Stub(recorded=ring)] * len(errors)
    asked = Stub(windows=windows, search=[Stub(row=Stub(mode_role=role))])
    found, quantile, count = Matching._scatter(asked, 0, np.array(errors), -2.0)
    assert found == pytest.approx(std / 2.0) and count == np.isfinite(errors).sum()
    assert quantile == pytest.approx(
        norm.ppf(0.975) if count == 1 else student.ppf(0.975, count - 1), rel=1e-6
    )


def test_a_prior_pulls_from_where_the_parameter_is_to_its_centre():
    """Its coordinate less that of the centre, sharpened; what nothing is known of is not pulled."""
    known = Stub(known=True, sharpness=4.0, centre=1e9, of=np.log10)
    free = Stub(known=False, sharpness=9.0, start=1e7, of=np.log10)
    state = Stub(theta=np.array([7.0, 8.5]), prior_weight=2.0)
    prior = prior_of(Stub(search=[free, known]), state, [1, 0])  # type: ignore[arg-type]
    assert prior.sharpness.tolist() == [4.0, 0.0] and prior.weight == 2.0
    assert prior.off[0] == pytest.approx(8.5 - 9.0)
