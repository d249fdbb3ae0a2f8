"""The search for the best fit and its errors, on simulations in closed form, against scipy's joint
least squares."""

import math
from dataclasses import replace
from types import SimpleNamespace as Stub
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

from ehbench.identification import estimate as estimating
from ehbench.identification import journal, results, sensitivity, uncertainty
from ehbench.identification.basins import _coarse, descend, foreseen, level, nearest_basin
from ehbench.identification.descent import bounded_step, constrained, settle, solve
from ehbench.identification.hydraulics import _doubt, ranked
from ehbench.identification.problem import Problem, State, cost, evaluate, initial
from ehbench.identification.results import FittedParameter, Lean, Moved, _statuses
from ehbench.identification.search import Coordinate
from ehbench.identification.sensitivity import _moved, _sentence
from ehbench.identification.uncertainty import Errors, _sensors, errors_of
from ehbench.preprocessing.sensors import Term
from ehbench.runs.rundir import write_json
from ehbench.signals.series import correlation_time
from ehbench.vocabulary.errors import InsufficientData
from tests.analytic_fit import LAG, NAMES, OFFSET, TRUTH, TWIN, log_of, problem, stroke
from tests.shared import refused, shipped


@pytest.fixture(autouse=True)
def bare(monkeypatch):
    """An estimate is its errors and its state: nothing is asked about a rig."""
    monkeypatch.setattr(estimating, "doubts_of", lambda *_: None)
    monkeypatch.setattr(estimating, "result_of", lambda *given: given)


def estimated(asked: Problem) -> tuple[State, Errors]:
    """Where an estimate of a problem ends, and its errors."""
    result: Any = estimating.estimate(asked)[0]
    return result[1], result[2]


def joint(state: State, fixed: dict[int, float] | None = None, more: str = ""):
    """scipy's least squares of all parameters that are not ``fixed`` and both starts at once, with
    the scales and the weight of the starts' priors of a state."""
    size = np.array([state.scales["press.x"], state.scales["press.v"]])
    free = [i for i in range(len(state.theta)) if i not in (fixed or {})]

    def residuals(z):
        theta = state.theta.copy()
        theta[list(fixed or {})] = list((fixed or {}).values())
        theta[free] = z[:-2]
        parts = [
            (stroke(np.exp(theta), z[k - 2], 1.0 - 2.0 * k, more) - log_of(k, 0.02, 1).recorded)
            / size
            for k in (0, 1)
        ]
        return np.concatenate([*map(np.ravel, parts), math.sqrt(state.prior_weight) * z[-2:]])

    z = np.append(state.theta[free], [0.0, 0.0])
    return least_squares(residuals, z, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)


@pytest.mark.parametrize(
    ("factors", "most"),
    [((1, 1, 1), 152), ((0.3, 3, 1), 212), ((8, 0.2, 3), 204), ((20, 1, 0.1), 224)],
)
def test_a_search_from_afar_finds_the_truth_and_how_sure_it_is(factors, most):
    """In no more simulations than it takes now: the look over the ranges takes 130 of them."""
    asked = problem(factors)
    state = nearest_basin(asked, initial(asked))
    assert asked.simulator.effort.evaluations <= most
    state, converged = settle(asked, state)
    assert converged and asked.simulator.effort.evaluations <= most + 10
    truth = joint(state)
    normal = truth.jac.T @ truth.jac
    std = np.sqrt(np.diag(np.linalg.inv(normal)))
    assert np.all(np.abs(state.theta - truth.x[:3]) < 0.01 * std[:3])
    assert [float(s[0]) for s in state.shifts] == pytest.approx(truth.x[3:].tolist(), abs=0.01)
    assert cost(asked, evaluate(asked, state)) == pytest.approx(2.0 * truth.cost, rel=1e-6)
    errors = errors_of(asked, evaluate(asked, state))
    # scaled residuals are unit noise; they are white, which is known to a few percent
    assert [errors.by_index[i].std for i in range(3)] == pytest.approx(std[:3], rel=0.15)
    assert all(item.kind == "estimated" for item in errors.by_index.values())
    known = np.diag(np.linalg.inv(normal[:3, :3]))
    shares = [errors.by_index[i].from_starts for i in range(3)]
    assert shares == pytest.approx(1.0 - known / std[:3] ** 2, abs=0.01)
    assert [item.from_data for item in errors.by_index.values()] == [1.0] * 3
    size = np.sqrt(np.diag(np.linalg.inv(normal)))
    shape = np.linalg.inv(normal) / np.outer(size, size)
    assert errors.correlation == pytest.approx(shape[:3, :3], abs=0.15)
    off = np.abs(state.theta - np.log(TRUTH)) / std[:3]
    assert np.all(off < 3.0) and abs(float(state.shifts[0][0]) - OFFSET) < 3.0 * std[3]


@pytest.mark.parametrize(
    ("i", "upper", "fixed"),
    [
        (0, (0.98, 1e3, 1e3), ()),
        (1, (1e3, 0.9, 1e3), ()),
        (0, (1.00005, 1e3, 1e3), (0,)),  # less than its interval from it
        (2, (1e3, 1e3, 1.0), (2,)),
    ],
)
def test_a_parameter_that_runs_into_its_bound_or_near_stands_there(i, upper, fixed):
    asked = problem(tuple(0.5 * min(x, 1.0) for x in upper), upper=upper)
    state, errors = estimated(asked)
    assert state.at_bound == fixed and state.theta[i] == asked.search[i].bounds[1]
    assert errors.by_index[i].kind == "at_bound" and NAMES[i] not in errors.names
    there = joint(state, {i: float(state.theta[i])})
    others = [k for k in range(3) if k != i]
    assert state.theta[others] == pytest.approx(there.x[:2], abs=3e-4)


@pytest.mark.parametrize(
    ("prior", "kind", "share"), [(math.inf, "correlated", 1.0), (0.02, "correlated", 0.0)]
)
def test_two_gains_that_the_logs_know_as_a_product_hang_together(prior, kind, share):
    """A prior of 2 % of the one is all that is known of it, and of the other."""
    asked = problem(more=(TWIN, 1.0, 0.05, 20.0, prior, 1.0))
    state, _ = settle(asked, initial(asked))
    errors = errors_of(asked, evaluate(asked, state))
    assert [errors.by_index[i].kind for i in range(4)] == ["estimated"] * 2 + [kind] * 2
    assert errors.correlation[2, 3] == pytest.approx(-1.0, abs=1e-3)
    assert errors.by_index[3].from_data == pytest.approx(share, abs=1e-3)
    if prior < math.inf:
        stds = [errors.by_index[i].std for i in (0, 2, 3)]
        assert stds[1:] == pytest.approx([prior, prior], rel=0.1)
        assert errors.by_index[0].kind == "estimated" and stds[0] < 1e-4


def test_what_is_known_beside_the_logs_pulls_a_split_to_its_centre():
    """The logs know the product of two gains alone; how it splits the prior says."""
    asked = problem(more=(TWIN, 1.5, 0.05, 20.0, 0.1, 1.25))
    state, converged = settle(asked, initial(asked))
    assert converged and math.exp(state.theta[3]) == pytest.approx(1.25, rel=1e-4)
    assert math.exp(state.theta[2]) == pytest.approx(TRUTH[2] / 1.25, rel=0.02)


def test_a_lag_too_fast_to_see_is_known_by_its_range():
    """From below: there 95 % of the likelihood ends, all others following."""
    asked = problem(more=(LAG, 3e3, 10.0, 1e5))
    state, errors = estimated(asked)
    low, high = state.ranges[3]
    assert high == asked.search[3].bounds[1] and 3 not in errors.by_index
    best = joint(state, {3: float(state.theta[3])}, LAG).cost
    rise = 2.0 * (joint(state, {3: low}, LAG).cost - best)
    # halvings leave 3 % of a twelfth of the range, in which the rise changes by a third
    assert rise == pytest.approx(3.84 * state.prior_weight, rel=0.35)


def test_a_lag_that_no_log_tells_is_dropped_and_alone_refused():
    asked = problem(more=(LAG, 2e4, 1e4, 1e5))
    state, errors = estimated(asked)
    assert state.free == (0, 1, 2) and not state.ranges and 3 not in errors.by_index
    assert math.exp(state.theta[3]) == pytest.approx(2e4)
    with pytest.raises(InsufficientData):
        estimating._over_ranges(asked, replace(state, free=(3,)), [3])


def test_a_descent_ends_where_it_may_not_go_on(monkeypatch):
    asked = problem((1.02, 1.0, 1.0))
    state, _ = settle(asked, initial(asked))
    fixed, price = constrained(asked, state, 0, float(state.theta[0]) + 1e-3)
    there = joint(state, {0: float(state.theta[0]) + 1e-3})
    assert fixed.theta[1:] == pytest.approx(there.x[:2], abs=1e-4) and fixed.free == (0, 1, 2)
    assert price == pytest.approx(2.0 * there.cost, rel=1e-6)
    short = replace(problem((1.2, 2.0, 0.5)), max_iterations=2)
    _, converged = solve(short, initial(short), 1e-9)
    assert not converged and short.simulator.effort.iterations == 2


def test_what_a_descent_comes_to_is_foreseen_where_it_is_linear():
    asked = problem()
    state, reached = descend(asked, {NAMES[0]: 1.002e9, NAMES[2]: 0.0501})
    assert reached == pytest.approx(level(asked, state.here.residuals))
    noise = sum(2.0 * math.log(0.02 * asked.spread[c]) for c in ("press.x", "press.v"))
    assert reached == pytest.approx(noise, abs=0.2)
    values = {NAMES[0]: 1.002e9, NAMES[2]: 0.0501}
    assert foreseen(asked, values)[0] == pytest.approx(reached, abs=0.1)


@pytest.mark.parametrize(("factor", "anew"), [(1.0, False), (1.3, True)])
def test_derivatives_of_another_problem_serve_where_it_simulates_alike(factor, anew):
    values = {NAMES[0]: 1.002e9, NAMES[2]: 0.0501}
    other, asked, plain = problem(), problem(), problem()
    _, state = foreseen(other, values | {NAMES[0]: factor * 1.002e9})
    reached, _ = foreseen(asked, values, (other, state))
    assert reached == foreseen(plain, values)[0]
    efforts = [item.simulator.effort.evaluations for item in (asked, plain)]
    assert efforts[0] == (efforts[1] if anew else len(asked.logs)) > 0


def test_a_bounded_step_is_the_least_of_its_quadratic():
    """Against a grid over the box."""
    normal, gradient = np.array([[2.0, 0.9], [0.9, 1.0]]), np.array([-2.0, 1.0])
    free = bounded_step(normal, gradient, 0.0, np.full(2, -9.0), np.full(2, 9.0))
    assert free == pytest.approx(-np.linalg.solve(normal, gradient), rel=1e-6)
    damped = bounded_step(normal, gradient, 0.5, np.full(2, -9.0), np.full(2, 9.0))
    held = normal + 0.5 * np.diag(np.diag(normal))
    assert damped == pytest.approx(-np.linalg.solve(held, gradient), rel=1e-6)
    small = bounded_step(1e-4 * normal, 1e-4 * gradient, 0.5, np.full(2, -9.0), np.full(2, 9.0))
    assert small == pytest.approx(damped, rel=1e-6)
    low, high = np.array([-0.5, -1.0]), np.array([0.7, 2.0])
    x, y = np.meshgrid(np.linspace(-0.5, 0.7, 601), np.linspace(-1.0, 2.0, 601), indexing="ij")
    value = 0.5 * (2.0 * x**2 + 1.8 * x * y + y**2) - 2.0 * x + y
    k = np.unravel_index(np.argmin(value), value.shape)
    step = bounded_step(normal, gradient, 0.0, low, high)
    assert step == pytest.approx([x[k], y[k]], abs=6e-3)
    small = bounded_step(1e-4 * normal, 1e-4 * gradient, 0.0, low, high)
    assert small == pytest.approx(step, abs=1e-6)


@pytest.mark.parametrize("noise", [1e-3, 0.02])
def test_a_coarse_solution_is_judged_by_what_it_leaves_above_a_floor(noise):
    """White noise, of which a floor of a two-hundredth of the spread makes a parabola."""
    asked = problem((1.1, 0.9, 1.02), noise)
    begin = initial(asked)
    end = _coarse(asked, begin, begin.theta, [0, 1, 2])
    values, starts = np.exp(end.state.theta), [float(s[0]) for s in end.state.shifts]
    left = [stroke(values, s, 1.0 - 2.0 * k) - asked.logs[k].recorded for k, s in enumerate(starts)]
    spread = np.std(stroke(TRUTH, OFFSET, 1.0), axis=0)
    share = 200.0 * np.sqrt(np.mean(np.concatenate(left) ** 2, axis=0)) / spread
    told = np.sum(np.where(share > 1.0, 2.0 * np.log(share), share**2 - 1.0))
    assert end.misfit == pytest.approx(told, rel=0.1) and not end.much
    assert np.exp(end.state.theta) == pytest.approx(TRUTH, rel=0.05)


def test_a_rise_is_that_of_the_least_squares_of_all_others():
    """Of a gain half an interval off; its effect is on the stroke that it scales."""
    asked = problem()
    state, _ = settle(asked, nearest_basin(asked, initial(asked)))
    state = evaluate(asked, state)
    at = state.theta[2] + np.array([-2e-3, 3e-3])
    rises, effect = estimating._rises(asked, state, 2, at)
    free = joint(state).cost
    asked_of_scipy = [2.0 * (joint(state, {2: x}).cost - free) for x in at]
    assert rises == pytest.approx(asked_of_scipy, rel=0.05)
    moved = 3e-3 * stroke(TRUTH, 0.0, 1.0)
    share = np.sqrt(np.mean(moved**2, axis=0)) / np.std(asked.logs[0].recorded, axis=0)
    assert effect == pytest.approx(max(share), rel=0.05)


def test_sensors_of_each_log_have_the_errors_of_the_joint_problem():
    """Here the start of each log is what its offset is 1e-3 of."""
    asked = problem()
    term = Term("press.x", "offset", 2e-3, 1.0, 1e-3, True)
    for log in asked.logs:
        # pyrefly: ignore[read-only]
        log.start.terms = (term,)
        # pyrefly: ignore[read-only]
        log.start.uncertain[0].name = term.name
    state, _ = settle(asked, initial(asked))
    truth = joint(state)
    std = np.sqrt(np.diag(np.linalg.inv(truth.jac.T @ truth.jac)))[3:]
    found = _sensors(asked, errors_of(asked, evaluate(asked, state)))
    assert [item.log for item in found] == ["log 0", "log 1"]
    assert [item.value for item in found] == pytest.approx(2e-3 + 1e-3 * truth.x[3:], abs=1e-6)
    assert [item.std for item in found] == pytest.approx(1e-3 * std, rel=0.15)
    for item in found:
        ends = (item.value - 1.96 * item.std, item.value + 1.96 * item.std)
        assert item.interval == pytest.approx(ends, rel=1e-4)
        assert (item.known, item.prior, item.unit) == (2e-3, 1e-3, "m")


def test_how_far_estimates_would_be_off_by_their_intervals():
    search = [Coordinate(n, True, 1.0, 2.0, 0.5, 4.0) for n in (*NAMES, "shared")]
    errors = {i: Stub(kind="estimated", std=0.1 * (i + 1), quantile=2.0) for i in range(4)}
    errors[1].kind = "not_excited"
    live = Stub(live=(0, 1, 2, 3), theta=np.zeros(4))
    fit: Any = Stub(search=search, requested=3)
    result: Any = Stub(state=live, by_index=errors)
    first, second = _moved(fit, result, np.array([-0.3, 9.0, 9.0, 9.0]))
    assert (first.name, first.here, first.there) == (NAMES[2], 1.0, 4.0)  # at its bound
    assert first.halves == pytest.approx(math.log(4.0) / 0.6)
    assert (second.name, second.there) == (NAMES[0], pytest.approx(math.exp(-0.3)))
    assert second.halves == pytest.approx(1.5)


@pytest.mark.parametrize(("off", "stands"), [(0.0, True), (1e-12, True), (1e-6, False)])
def test_a_number_at_its_bound_but_for_rounding_stands_there(off, stands):
    asked: Any = Stub(search=[Stub(bounds=(0.0, 2.0), reach=2.0)], limit_at=lambda theta, i: "")
    state: Any = Stub(at_bound=(), theta=np.array([2.0 - off]))
    assert uncertainty._at_bound(asked, state, 0) == stands


def test_a_denied_number_is_told_with_its_interval():
    moved = tuple(Stub(name="bulk_modulus", there=9e8, here=8e8, halves=n) for n in (2.5, 0.5))
    fit: Any = Stub(simulator=Stub(rig=shipped("slide_servo")))
    both = "press.p_head, press.p_rod"
    row: Any = Stub(parameters=("carriage.mass",), name="load of press", certainty=3, numbers=())
    row.readings = tuple((name, "lag", 1.0) for name in ("press.p_head", "press.p_rod"))
    for name, key, value, half in (
        ("carriage.mass", "number_fixed", "27", 1.96 * 20.0),
        ("press.v.lag", "time_fixed", 270.0, 1.96e3 * 0.02),
        ("press.v.scale", "sensor_fixed", 0.27, 1.96 * 0.02),
    ):
        there = 270.0 if key == "number_fixed" else 0.27
        std = 20.0 if key == "number_fixed" else 0.02
        given = Lean(name, 0.25, there, std, 0.3, moved, "free it")
        text = _sentence(fit, row, given)
        assert text.key == f"identification.{key}" and text.fields["halves"] == 2.5
        width = str(text.fields["half"]).partition(" ")[0]
        assert float(width) == pytest.approx(half, rel=0.02 if key == "number_fixed" else 1e-4)
        shown = text.fields["value"]
        assert text.fields.get("channel", both) == both
        assert shown.startswith(value) if isinstance(value, str) else shown == pytest.approx(value)
    zero: Any = Lean("press.x.offset", 0.0, 0.01, 1e-4, 0.3, moved, "free it")
    fields = _sentence(fit, row, zero).fields
    assert (fields["name"], fields["fixed"], fields["value"]) == ("press.x.offset", "0 mm", "10 mm")
    pair: Any = Stub(**vars(row) | {"parameters": ("a.mass", "carriage.mass", "b.mass")})
    pair.numbers = [Stub(name="a", here=0.25), Stub(name="b", here=1.0), Stub(name="c", here=0.25)]
    heavy: Any = Lean("carriage.mass", 0.25, 270.0, 20.0, 0.3, moved, "free it")
    assert _sentence(fit, pair, heavy).fields["name"] == "a, c"  # what is fixed at the same value


@pytest.mark.parametrize(
    ("name", "value", "key", "side"),
    [
        ("bulk_modulus", 1e8, "at_bound", "lower"),
        ("bulk_modulus", 0.99e9, "at_bound", "upper"),
        ("carriage.damping", 99.0, "at_bound", "lower"),
        ("press.servo_rod_tank.deadband", 0.0, "closed_deadband", "lower"),
        ("press.servo_rod_tank.deadband", 5.0, "at_bound", "upper"),
    ],
)
def test_a_bound_is_told_with_its_side(name, value, key, side):
    ends = {"bulk_modulus": (1e8, 1e9), "carriage.damping": (98.0, 101.0)}.get(name, (0.0, 5.0))
    item = FittedParameter(name, "", value, None, None, *ends, value, "at_bound", 9)
    (note,) = _statuses([item], Stub(rig=shipped("slide_servo"), logs=()))
    assert getattr(note, "key", "") == f"identification.{key}"
    assert getattr(note, "fields", {})["side"] == side


def variant(error: np.ndarray, name: str = "press.v") -> Any:
    """A fit of one log with these errors of a channel."""
    rows = {name: np.zeros(error.size), f"simulated.{name}": error, "t": np.arange(error.size)}
    logs = [Stub(residual_rms={name: float(np.sqrt(np.mean(error**2)))})]
    return Stub(recordings=[("log", rows)], logs=logs)


def test_valve_dynamics_are_ranked_by_the_ratio_of_their_residuals():
    """ln(rms/rms) of errors that change by tens: each sample moves it by ±¼ over their number."""
    size = 1000
    turns = np.repeat(np.random.default_rng(1).permutation([-1.0, 1.0] * (size // 20)), 10)
    even, uneven = np.full(size, 2e-3), 1e-3 * np.sqrt(1.0 + 0.5 * turns)
    best, other = ranked({"even": variant(even), "uneven": variant(uneven)})
    assert (best.dynamics, other.dynamics) == ("uneven", "even")
    assert other.relative_rms == pytest.approx(2.0) and best.relative_rms == 1.0
    assert correlation_time(turns) > 3.0
    half = 1.96 * math.sqrt(0.0625 * correlation_time(turns) / size)
    assert other.interval == pytest.approx((2.0 * math.exp(-half), 2.0 * math.exp(half)), rel=1e-4)
    assert best.interval == (1.0, 1.0)
    exact = ranked({"exact": variant(0.0 * even), "even": variant(even)})
    assert [item.dynamics for item in exact] == ["exact", "even"]


def test_channels_that_are_followed_worse_than_by_their_mean_are_named_the_worst_first():
    fits = {"a": -1.0, "b": -30.0, "c": 40.0, "d": -20.0, "e": -5.0, "f": -2.0, "g": -math.inf}
    log: Any = Stub(name="log", fit_percent=fits)
    (note,) = results._poor([log])
    assert note.fields["worst"] == "log: b -30 %, log: d -20 %, log: e -5 %, log: f -2 %"
    assert (note.fields["poor"], note.fields["all"]) == (5, 6)
    log.fit_percent = {"a": 0.0, "c": 40.0}
    assert results._poor([log]) == []
    log.fit_percent = {"a": -0.1}
    with refused("identification.follows_nothing", InsufficientData):
        results._poor([log])


def test_a_row_that_moves_no_estimate_is_beyond_no_interval():
    row: Any = Stub(name="gain")
    moved = (Moved("bulk_modulus", 8e8, 9e8, 2.5), Moved("carriage.damping", 1.0, 1.1, 0.5))
    assert sensitivity._Suspect(row, [], (0,), moved=moved).beyond == 2.5
    assert sensitivity._Suspect(row, [], (0,)).beyond == 0.0


def test_a_journal_goes_on_where_a_search_last_knew_how_far_it_was(tmp_path):
    """What came after the last step or the last costs is done again."""
    path, about = tmp_path / "journal.json", {"run": "a"}
    steps = [{"costs": [1.0]}, {"text": "a"}, {"steps": 2}, {"text": "b"}, {"text": "c"}]
    write_json(path, about | {"steps": steps})
    assert journal._steps(path, about) == steps[:3]
    assert journal._steps(path, {"run": "b"}) == []
    assert journal._steps(tmp_path / "none.json", about) == []
    for wrong in ("steps", {"costs": 1}, ["costs"]):
        write_json(path, about | {"steps": wrong})
        assert journal._steps(path, about) == []


def test_a_journal_knows_how_many_steps_of_its_search_follow():
    """Steps are known by what they start from; another one begins anew."""
    first = journal.Journal()
    for k, search in enumerate("aaba"):
        first.search = search
        assert first.begin("step", k, b"x") == {}
        first.keep({}, came_to=k)
    again = journal.Journal(known=[*first.steps])
    again.search = "a"
    found = [again.begin("step", k, b"x") for k in (0, 1, 2)]
    assert [(item["left"], item["came_to"]) for item in found] == [(2, 0), (1, 1), (1, 2)]
    assert again.begin("step", 3, b"y") == {} and again.steps[:3] == first.steps[:3]
    assert again.known == first.steps[:3]


def fit_of(rng, sizes, length, shared=None):
    """A fit whose residuals of two logs are noise of these sizes, by channel."""
    recordings, logs = [], []
    for log in range(2):
        columns = {"t": np.arange(length) * 1e-3}
        for channel, size in sizes.items():
            noise = rng.standard_normal(length) if shared is None else shared[log]
            columns |= {channel: noise * size + 9.0, f"simulated.{channel}": np.full(length, 9.0)}
        rms = {c: float(np.sqrt(np.mean((columns[c] - 9.0) ** 2))) for c in sizes}
        recordings.append((str(log), columns))
        logs.append(Stub(residual_rms=rms))
    built: Any = Stub(recordings=recordings, logs=logs)
    return built


def mean_level(fit) -> float:
    """The mean over logs and channels of ln(rms)."""
    return float(np.mean([math.log(x) for log in fit.logs for x in log.residual_rms.values()]))


@pytest.mark.parametrize("together", [False, True])
def test_the_error_of_a_comparison_is_its_scatter(together):
    """Channels whose residuals go together tell less than as many that do not."""
    rng, sizes = np.random.default_rng(1), {"a": 1.0, "b": 5.0}
    ratios, errors = [], []
    for _ in range(300):
        shared = rng.standard_normal((2, 2, 400)) if together else (None, None)
        first, other = (fit_of(rng, sizes, 400, noise) for noise in shared)
        ratios.append(mean_level(first) - mean_level(other))
        errors.append(_doubt(first, other))
    assert np.mean(errors) == pytest.approx(np.std(ratios), rel=0.1)


def test_fits_that_are_the_same_do_not_differ():
    one = fit_of(np.random.default_rng(2), {"a": 1.0}, 50)
    assert _doubt(one, one) == 0.0
