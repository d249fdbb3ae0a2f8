"""Each number of the search for parameters decides an outcome, as in `test_settings_matter`."""

import math
from dataclasses import replace
from types import SimpleNamespace as Stub
from typing import Any

import numpy as np

from ehbench.data.record import Record
from ehbench.frequency_response import response, transfer
from ehbench.guidance import comparison
from ehbench.identification import (
    basins,
    descent,
    frequency_domain,
    matching,
    problem,
    sensitivity,
    simulator,
)
from ehbench.identification import estimate as estimates
from ehbench.identification import means as averages
from ehbench.identification.results import Lean, Moved
from ehbench.plant.model import Model
from ehbench.preprocessing import observations
from ehbench.validation import baseline, held_out
from tests import analytic_fit
from tests.settings import answers, each_shows, first_call
from tests.shared import shipped

ANY: Any = Stub()
SLIDE = shipped("slide_servo")


class Row:
    """A row of the fault table, which is a key."""

    def __init__(self, **fields):
        vars(self).update(fields)


# --- descent


def stepped(damping=1.0, gained=1.0):
    """(damping after a step, whether initial states stay linearised) of a step that should gain 1;
    none where no damping is left."""
    state: Any = Stub(free=(0,), cost=9.0)
    origin: Any = Stub()
    end: Any = Stub(cost=9.0 - gained)
    asked: Any = Stub(report=lambda *_: None, simulator=Stub(effort=Stub(iterations=1)))
    with answers(descent, start_jacobian=None, linearised=None, step=(None, None, 1.0),
                 evaluate=lambda *_: end, cost=lambda _, item: item.cost):  # fmt: skip
        there = descent._stepped(asked, descent._Descent(state, origin, damping), 0.0, False)
    return None if there is None else (there.damping, there.origin is origin)


def rounds_of(change):
    """Solutions until weights are settled that change by so much at each."""
    count = []
    state: Any = Stub(scales={"x": 1.0})
    with answers(descent, evaluate=lambda _, item: item,
                 weighed=lambda _, item: Stub(scales={"x": item.scales["x"] * math.exp(change)}),
                 solve=lambda _, item, __: (count.append(1) or item, True)):  # fmt: skip
        descent.settle(ANY, state)
    return len(count)


# --- basins


def looks(*costs):
    """How many basins are tried whose bottoms cost so much; the best costs 1."""
    row = [9.0] + [x for cost in (1.0, *costs) for x in (cost, 9.0)]
    place = Stub(row=Stub(mode_role=""), log=True, roams=True, known=False)
    asked: Any = Stub(logs=[Stub(commanded=("a",))], search=[place], requested=1)
    state = problem.State(np.zeros(1), [], {}, np.ones((1, 1)), (0,))
    with answers(basins,
                 _points=lambda *_: ([np.array([float(i)]) for i in range(len(row) + 1)], 1),
                 _costs=lambda *_: 2.0 * np.array([9.0, *row])):  # fmt: skip
        return len(basins._look(asked, state)[0])


def coarsely(left=0.0, size=1.0):
    """(solutions, parameters solved for) of a coarse solution that leaves so much of the spread,
    with a parameter of so much effect beside one that has all."""
    solved = []
    asked = analytic_fit.problem()
    state = problem.evaluate(asked, problem.initial(asked))

    def solve(_, item, __):
        solved.append(item.free)
        return item, True

    with answers(basins, solve=solve, effects=lambda *_: np.array([1.0, size]),
                 squares=lambda *_: left * sum(r.size for r in state.here.residuals)):  # fmt: skip
        basins._coarse(asked, state, state.theta, (0, 1))
    return len(solved), solved[0]


# --- matching of ringing


def matched(miss=1.0, std=1e-9):
    """(whether a matching stands that misses by so much at once, NaN where nothing rings, of a
    parameter with such an error; the longest step of a round, rounds, fresh slopes)."""
    work: Any = object.__new__(matching.Matching)
    work.search = [Stub(row=Stub(mode_role="decay"), log=True, bounds=(-99.0, 99.0))]
    work.theta, work.live, work.rounds, slopes = np.zeros(1), [0], 0, []
    work.aim, work.progress = [np.array([miss])], lambda *_: None
    work._rings = lambda *_: []
    work._measure = lambda *_: np.zeros(1)
    work._scatter = lambda *_: (std, 1.96, 1)
    work._drop = lambda which: work.live.clear() if which else None
    work._slopes = lambda *_: slopes.append(1) or np.ones((1, 1))
    stand = work._stand(None)
    step = round(float(work.theta[0]) / max(work.rounds, 1), 6)
    return stand.converged, step, work.rounds, len(slopes)


def nudge():
    work: Any = object.__new__(matching.Matching)
    work.search = [Stub(bounds=(-99.0, 99.0))]
    moved = []
    work._rings = lambda theta, _: moved.append(float(theta[0]))
    work._measure = lambda *_: np.zeros(1)
    work._slopes(np.zeros(1), [0], [])
    return moved


# --- fixed numbers


def doubts(gain=0.0, shares=(), sure=None):
    """(warnings, reports) of a fit: of a gain that is off by so many standard errors, and of
    numbers that explain such shares; the shares in the order of the reports where it is said how
    ``sure`` each number is."""
    effort = Stub(evaluations=100)
    fit: Any = Stub(simulator=Stub(effort=effort, rig=SLIDE))

    def item(kind, explains, delta):
        row: Any = Stub(kind=kind, parameters=("press.v.flow_gain",), certainty=1)
        row.remedy = lambda *_: "do so"
        return Stub(row=row, explains=explains, delta=delta, beyond=0.0 if kind == "gain" else 9.0)

    def lean(asked):
        moved = (Moved("m", 1.0, 2.0, 9.0),)
        return asked.row, Lean("press.mass", 1.0, 2.0, 0.1, asked.explains, moved, "")

    every = [item("gain", 0.5, gain)] * bool(gain) + [item("mass", s, 1.0) for s in shares]
    for asked, certainty in zip(every, sure or (), strict=False):
        asked.row.certainty = certainty
    with answers(sensitivity, above_noise=1.0, _screened=([], ()), _promising=lambda *_: every,
                 _release=lambda *_: Stub(std=1.0),
                 _confirmed=lambda *given: lean(given[2]), _sentence=""):  # fmt: skip
        result = sensitivity.doubts_of(fit, ANY, ANY)
    if sure is not None:
        return [lean.explains for lean in result.leans]
    return len(result.warnings), len(result.leans)


def test_the_less_sure_number_comes_first_unless_it_leaves_much_more():
    """An assumed volume that leaves three times as much as a measured lever is not the cause."""
    assert doubts(shares=(0.85, 0.9), sure=(0, 6)) == [0.85, 0.9]
    assert doubts(shares=(0.7, 0.68, 0.9), sure=(0, 0, 6)) == [0.9, 0.7, 0.68]
    assert doubts(shares=(0.5, 0.6), sure=(6, 0)) == [0.6, 0.5]
    assert doubts(shares=(0.6, 0.5), sure=(6, 0)) == [0.5, 0.6]


def looked_at(count, gain=1.0):
    """How many of so many numbers that promise something are asked of every log."""
    rows: Any = [Row(bounds=(-9.0, 9.0), certainty=1, name=str(i)) for i in range(count)]
    every = [sensitivity._Suspect(row, [np.ones((2, 1))], (0,)) for row in rows]
    fit: Any = Stub(logs=[ANY])
    result: Any = Stub(state=Stub(live=(), theta=np.zeros(0)))
    with answers(sensitivity, cost=1.0, prior_of=None, _with=None, gains_of=[gain] * count,
                 _logs_of=[0], _columns={}, _moved=(),
                 _release=Stub(move=1.0, gain=gain, follow=np.zeros(0))):  # fmt: skip
        return len(sensitivity._promising(fit, result, every, ANY, 1.0))


def void():
    """Samples that do not count around one in which a chamber is empty."""
    p = np.full(1000, 1e6)
    p[500] = -2e5
    y = {"press.p_head": p, "press.servo.command": np.where(np.arange(1000) < 501, 0.0, 5.0)}
    log = Record(np.arange(1000) * 1e-3, y)
    return int(np.sum(~simulator._counts("log", Model.of(SLIDE), log, ("press.p_head",))[0]))


def at_end():
    """Samples near an end of the stroke of 400 mm, of one each tenth of a millimetre."""
    log = Record(np.arange(4001.0), {"press.x": np.linspace(0.0, 0.4, 4001)})
    ((_, there),) = observations.at_ends(Model.of(SLIDE), log)
    return int(np.sum(there))


def late(errors, ticks=100.0):
    """Whether a response is late by so many times its error, and samples."""
    shift = 1e-3 * ticks
    band: Any = Stub(lateness=lambda *_: (shift, shift / errors), command="u")
    log: Any = Stub(band=band, channels=("v",), name="log")
    log.record, log.recorded = Stub(sample_time=1e-3), np.zeros((9, 1))
    return len(frequency_domain.late_responses(log, np.zeros((9, 1))))


def touched(size):
    """Whether a parameter counts in a log in which it does so much of what it does in all."""
    asked = analytic_fit.problem()
    with answers(estimates, nearest_basin=lambda _, state: state,
                 jacobian=lambda *_: [np.ones((3, 1, 3))] * 2,
                 effects=lambda *given: np.full(3, size if len(given) > 3 else 1.0)):  # fmt: skip
        call = first_call(estimates, "_over_ranges", lambda: estimates.estimate(asked))
    return bool(call[1].influence.all())


def heads():
    """How long the logs are that the search begins with [s]."""
    log: Any = Stub(head=max)
    asked: Any = Stub(logs=[log])
    return first_call(log, "head", lambda: estimates.estimate(asked))[0]


def falls(rise):
    """Whether a solution is tried where the cost falls by so much."""
    state: Any = Stub(prior_weight=1.0, influence=np.zeros((1, 1)))
    state.moved, costs = lambda *_: state, iter([0.0, 1.0])
    with answers(estimates, replace=lambda item, **_: item, cost=lambda *_: next(costs),
                 solve=lambda _, item, __: (item, True)):  # fmt: skip
        return estimates._better(ANY, state, 0, -rise, 0.0) is not None


def slack():
    """How much more the integration may err in a look."""
    asked = analytic_fit.problem()
    state = problem.initial(asked)
    work = lambda: basins._costs(asked, state, [state.theta], [0])  # noqa: E731
    return first_call(basins, "residuals_at", work)[-1]


def asked_rows(took):
    """(rows asked of one log, whether a suspect is freed) after a fit of so many simulations, where
    asking took 150."""
    seen = []
    fit: Any = Stub(simulator=Stub(effort=Stub(evaluations=took), rig=SLIDE))

    def screened(_, __, effort, count):
        effort.evaluations = 150
        seen.append(count)
        return [], ()

    item = Stub(row=Stub(kind="load", name="load of arm"), explains=0.5, delta=1.0, beyond=9.0)
    with answers(sensitivity, above_noise=1.0, _screened=screened, _promising=lambda *_: [item],
                 _confirmed=lambda *_: seen.append("freed")):  # fmt: skip
        sensitivity.doubts_of(fit, ANY, ANY)
    return seen


def moves(share):
    stroke = float(SLIDE.cylinder[0].stroke)
    log = Record(np.arange(2) * 1e-3, {"press.x": np.array([0.0, share * stroke])})
    return simulator._moves(SLIDE.cylinder[0], log)


def known(share):
    """The error of a response of 1 whose interval is a share of it."""
    item: Any = Stub(gain=np.ones(1), gain_high=np.array([1.0 + share * frequency_domain.Z95]))
    return round(float(frequency_domain._error(item)[0]), 6)


# --- responses, guidance, copies


def preferred(fit):
    """Which of two forms is preferred, where the one with more numbers fits better by so much."""

    def fitted(form, *_):
        fits = {"first order": 90.0, "two poles": 90.0 + fit}
        item = Stub(form=form, fit_percent=(fits.get(form, 0.0),), numbers=transfer.FORMS[form][0])
        item.is_within, item.widened = lambda _: False, lambda _: item
        return item if form in fits else None

    with answers(transfer, _fit_form=fitted, replace=lambda item, **_: item):
        return transfer.transfers([], 1.0)[0].form


def begun(form):
    """Poles, or frequency and damping, at which searches begin, the first and the last."""
    import scipy.optimize

    seen = []
    work = lambda: transfer._fit_form(form, [(np.ones(64), np.arange(64.0))], 1.0, False)  # noqa: E731
    with answers(transfer, _outputs=lambda theta, *_: seen.append(np.exp(theta)) or (0.0, [1.0])):
        first_call(scipy.optimize, "least_squares", work)
    per = (lambda item: item[0]) if form == "two poles" else lambda _: 1.0
    return [round(float(item[1] / per(item)), 6) for item in seen[:2]]


def on_edge(off, damping=()):
    """Whether a form is offered whose pole lies so far from its bound, or a pair of a damping."""
    import scipy.optimize

    pairs, form = [(np.ones(64), np.arange(64.0))], "second order" if damping else "first order"
    x = np.append(math.log(2.0 * math.pi / 64.0) + off, np.log(damping))
    best = Stub(x=x, jac=1e9 * np.eye(64, x.size), fun=np.ones(64))
    with answers(scipy.optimize, least_squares=lambda *_, **__: best):
        return transfer._fit_form(form, pairs, 1.0, False) is not None


def tracks(alike, rough=-1.0):
    """Whether a command follows a position whose noise is so much in it, and whose third
    differences are so much alike."""
    y = {"press.x": np.arange(67.0), "press.servo.command": np.ones(67)}
    log: Any = Stub(record=Record(np.arange(67) * 1e-3, y))
    replies = iter([rough, *[alike] * 9])
    with answers(comparison, _alike=lambda *_: next(replies)):
        return comparison._follows(log, "press")


def bent(size):
    """Whether a phase is told to bend, by so many times its error."""
    f = np.linspace(1.0, 9.0, 100)
    bend = np.where(np.arange(100) % 2, 1.0, -1.0) * size * math.sqrt(98.0 / 100.0)
    return len(response._delay(f, bend, np.full(100, response.Z95), np.ones(100, bool))[1])


def probes():
    """How many rows of a copy that does not have them are asked by how much it is late."""
    y, asked = np.zeros((1000, 1)), []
    with answers(np, flatnonzero=lambda hits: asked.append(1) or np.empty(0)):
        held_out._shift(y[:, 0], y, y[:, 0], y, np.zeros(1))
    return len(asked)


def at_bound(share):
    """Parameters that end at a bound of which one comes so near, of its reach, that is unsure."""
    asked, unsure = analytic_fit.problem(), Stub(kind="", quantile=2.0, std=1e9, from_fixed=0.0)
    place, theta = asked.search[0], problem.initial(asked).theta.copy()
    theta[0] = place.bounds[1] - share * place.reach
    with answers(estimates, nearest_basin=lambda _, state: replace(state, theta=theta),
                 settle=lambda _, state: (state, True), doubts_of=None,
                 _over_ranges=lambda _, state, __: state,
                 errors_of=lambda _, state: Stub(
                     by_index={i: unsure for i in state.free if i == 0})):  # fmt: skip
        work = lambda: estimates.estimate(asked)  # noqa: E731
        return first_call(estimates, "result_of", work)[1].at_bound


def oscillates(share):
    """Whether an eigenvalue counts as a swing of which a share is imaginary."""
    real, imaginary = -1e9 * math.sqrt(1.0 - share**2), 1e9 * share
    swing = np.array([[real, -imaginary], [imaginary, real]])
    with answers(averages, _jacobian=lambda *_: swing):
        log = Record(np.arange(9) * 1e-3, {"press.x": np.full(9, 0.2)})
        return averages.fastest(Model.of(SLIDE), log) > 1e6


def difference():
    """The slope of a cube at zero by central differences: the square of their step, in 1e-12."""

    def cube(at, _, __, dy, ___):
        dy[:] = at**3

    model = Model.of(SLIDE)
    size = len(model.layout.state_names)
    with answers(averages, pace_of=lambda *_: Stub(weights=np.zeros(size)), derivatives=cube):
        return round(1e12 * averages._jacobian(model, np.zeros(size)).max(), 3)


def noisy_rate(share):
    """Whether a rate is noise of whose variance so much is noise."""
    t = np.arange(64) * 1e-3
    y = np.where(np.arange(64) % 2, 1.0, -1.0)
    log: Any = Stub(record=Record(t, {"press.x": t, "press.v": y}))
    with answers(comparison, noise_of=lambda *_: math.sqrt(share)):
        return comparison._only_noise(log, "press.v")


def follows_after(late):
    """Whether a command follows the noise of a position that comes so many samples later; its third
    differences are alike by −3/4 to a neighbour as well."""
    x = np.random.default_rng(1).standard_normal(999)
    y = {"press.x": x, "press.servo.command": np.roll(x, late)}
    return comparison._follows(Stub(record=Record(np.arange(999) * 1e-3, y)), "press")


def box_found(order=2, tick=1e-2):
    """Whether a black box is found that only one order and sample time gives."""
    y = np.arange(64.0)
    log = Record(np.arange(64) * 1e-4, {"press.v": y, "press.servo.command": y})

    def squares(_, __, at, degree, ___):
        return Stub(run=lambda _: y) if (degree, at) == (order, tick) else None

    with answers(baseline, _least_squares=squares, _usable=True, _values=lambda *_: y):
        return baseline.fit("press.v", [log]) is not None


def stretches(hole):
    """Into how many stretches a log falls whose noise is that of another but for so many rows."""
    t, y = np.arange(999) * 1e-3, np.random.default_rng(1).standard_normal(999)
    rows = held_out.FittedSamples("a", t, {"v": y}, "")
    same = (np.arange(999) < 300) | (np.arange(999) >= 300 + hole)
    with answers(held_out, _tells=True, _aligned=0.0, _same_blocks=lambda *_: same.copy()):
        return len(held_out._same_noise(Record(t, {"v": y}), rows))


def sharp(errors):
    """(whether half the lines have another H, so many standard errors away; which share they are):
    of all lines H is 1 ± √0.5, of the others' power half as much is left."""
    shares = []

    def sums(_, __, share=1.0):
        shares.append(share)
        size, value = (2.0, 1.0) if share == 1.0 else (1.0, 1.0 + errors * math.sqrt(0.5))
        along = np.array([size * value, 0.0, 0.0, 0.0, 0.0])[None, :, None]
        return size * np.eye(5)[None], along, np.array([3.0]), 4

    signals = Stub(size=4, rate=4.0, choice=response.Averaging())
    with answers(response, _sums=sums):
        *_, bias, marked = response._local(signals)
    assert math.isclose(bias[0], marked[0] * errors * math.sqrt(0.5), abs_tol=1e-9)
    return [bool(marked[0]), shares[1]]


ROWS = [
    (descent.SETTINGS, "damping_min", lambda: stepped(5e-9)[0], 1e-9),
    (descent.SETTINGS, "damping_max", lambda s: stepped(s) is None, (0.9e9, 1.1e9), [False, True]),
    (descent.SETTINGS, "faithful", lambda g: stepped(1.0, g)[1], (0.76, 0.74), [True, False]),
    (descent.SETTINGS, "rounds", lambda: rounds_of(1.0), 8),
    (descent.SETTINGS, "settled", rounds_of, (0.028, 0.032), [1, 8]),
    (basins.SETTINGS, "rival", looks, (2.9, 3.1), [2, 1]),
    (basins.SETTINGS, "rivals", lambda: looks(1.1, 1.2, 1.3, 1.4, 1.5), 4),
    (basins.SETTINGS, "much", lambda s: coarsely(s)[0], (0.009, 0.011), [1, 2]),
    (problem.SETTINGS, "faint", lambda s: coarsely(size=s)[1], (1.8e-3, 2.2e-3), [(0,), (0, 1)]),
    (estimates.SETTINGS, "nothing", touched, (0.9e-3, 1.1e-3), [False, True]),
    (estimates.SETTINGS, "head", heads, 5.0),
    (estimates.SETTINGS, "sure", falls, (15.0, 17.0), [False, True]),
    (basins.SETTINGS, "slack", slack, 1000.0),
    (sensitivity.SETTINGS, "effort", lambda: asked_rows(740), [89]),
    (sensitivity.SETTINGS, "first", lambda: asked_rows(760), [91, "freed"]),
    (sensitivity.SETTINGS, "quick", lambda: asked_rows(1), [72]),
    (simulator.SETTINGS, "moves", moves, (0.009, 0.011), [False, True]),
    (frequency_domain.SETTINGS, "known", known, (0.0, 0.5), [0.01, 0.5]),
    (transfer.SETTINGS, "close", preferred, (0.9, 1.1), ["first order", "two poles"]),
    (transfer.SETTINGS, "spread", lambda: begun("two poles")[0], 4.0),
    (transfer.SETTINGS, "damped", lambda: begun("second order"), [0.1, 0.5]),
    (transfer.SETTINGS, "edge", on_edge, (0.009, 0.011), [False, True]),
    (comparison.SETTINGS, "follows", tracks, (0.47, 0.53), [False, True]),
    (sensitivity.SETTINGS, "worth", lambda s: looked_at(1, s), (0.048, 0.052), [0, 1]),
    (matching.SETTINGS, "stand", lambda x: matched(x)[0], (0.9e-3, 1.1e-3), [True, False]),
    (matching.SETTINGS, "longest", lambda: matched(50.0)[1], 0.7),
    (matching.SETTINGS, "taming", lambda: matched(math.nan)[2], 5),
    (matching.SETTINGS, "rounds", lambda: matched()[2], 12),
    (matching.SETTINGS, "fresh_slopes", lambda: matched()[3], 8),
    (matching.SETTINGS, "nudge", nudge, [0.03]),
    (sensitivity.SETTINGS, "surely", lambda n: doubts(n)[0], (3.8, 4.2), [0, 1]),
    (sensitivity.SETTINGS, "alike", lambda s: doubts(shares=(0.6, s))[1], (0.28, 0.32), [1, 2]),
    (sensitivity.SETTINGS, "looked", lambda: looked_at(20), 8),
    (observations.SETTINGS, "emptying", void, 101),
    (observations.SETTINGS, "near", at_end, 80),
    (frequency_domain.SETTINGS, "surely", late, (3.8, 4.2), [0, 1]),
    (frequency_domain.SETTINGS, "late", lambda s: late(9.0, s), (0.23, 0.27), [0, 1]),
    (response.SETTINGS, "curved", bent, (1.9, 2.1), [0, 1]),
    (response.SETTINGS, "sharp", lambda n: sharp(n)[0], (2.9, 3.1), [False, True]),
    (response.SETTINGS, "narrow", lambda: sharp(1.0)[1], 0.5),
    (comparison.SETTINGS, "rough", lambda a: tracks(1.0, a), (-0.47, -0.53), [False, True]),
    (held_out.SETTINGS, "probes", probes, 24),
    (estimates.SETTINGS, "near", at_bound, (4.7e-3, 5.3e-3), [(0,), ()]),
    (matching.SETTINGS, "little", lambda x: matched(x, 1.0)[0], (0.019, 0.021), [True, False]),
    (averages.SETTINGS, "swings", oscillates, (0.095, 0.105), [False, True]),
    (averages.SETTINGS, "step", difference, 100.0),
    (transfer.SETTINGS, "damping", lambda z: on_edge(1.0, z), (0.5, 1e-3, 1.0),
     [True, False, False]),
    (comparison.SETTINGS, "noise", noisy_rate, (0.47, 0.53), [False, True]),
    (comparison.SETTINGS, "late", follows_after, (6, 7), [True, False]),
    (baseline.SETTINGS, "orders", box_found, (1, 2, 3, 4, 6), [True] * 5),
    (baseline.SETTINGS, "ticks", lambda t: box_found(tick=t), (1e-3, 2e-3, 5e-3, 1e-2, 2e-2),
     [True] * 5),
    (held_out.SETTINGS, "quiet", stretches, (250, 260), [1, 2]),
]  # fmt: skip

test_a_third_more_or_less_shows = each_shows(ROWS)
