"""Each number decides an outcome: as stated with it, another with a third more or less."""

import math
from pathlib import Path
from types import SimpleNamespace as Stub
from typing import Any

import numpy as np

from ehbench.config.recipe import Thresholds, TrialRecipe, TuneRecipe
from ehbench.data.record import Record
from ehbench.flow_maps import results, step_readings, tables
from ehbench.flow_maps.readings import SETTINGS as READING
from ehbench.flow_maps.readings import (
    FlowMapOptions,
    Noise,
    Units,
    few,
    readings_table,
    sort_readings,
)
from ehbench.flow_maps.results import SETTINGS as NOTES
from ehbench.flow_maps.spline import SETTINGS as SPLINE
from ehbench.flow_maps.spline import Axis, Spline
from ehbench.frequency_response.response import SETTINGS as RESPONSE
from ehbench.frequency_response.response import Averaging, Curve, estimate, signals_of
from ehbench.identification import basins, descent, problem
from ehbench.identification import estimate as estimates
from ehbench.identification.groups import SETTINGS as GROUPS
from ehbench.identification.groups import groups_of
from ehbench.identification.means import SETTINGS as MEANS
from ehbench.identification.means import means_of
from ehbench.identification.results import SETTINGS as RESULTS
from ehbench.identification.results import _late, _left_over, _turned
from ehbench.ledger.bounds import SETTINGS as BOUNDS
from ehbench.ledger.bounds import bounds
from ehbench.plant.model import Model
from ehbench.preprocessing import observations
from ehbench.signals.oddities import SETTINGS as ODD
from ehbench.signals.oddities import oddities
from ehbench.signals.series import Ringing
from ehbench.stages.flow_map import ERRORS, FlowMapStage
from ehbench.trial.coordination import COORDINATION, _direction, pace_of
from ehbench.trial.limit_cycle import LIMIT_CYCLE, limit_cycle
from ehbench.trial.measures import MEASURES, short_measures, step_measures, tracking_measures
from ehbench.trial.motion import MOTION, limits_of
from ehbench.tune import search as tune_search
from ehbench.validation import baseline, checks, held_out, judge, residuals, sweeps, transients
from ehbench.validation.results import ChannelResult, LogResult
from tests import analytic_fit
from tests.settings import answers, each, each_shows, first_call, refusal
from tests.shared import shipped

RIG, SLIDE = (shipped(name) for name in ("boom_four_valve", "slide_servo"))


USUAL = Averaging()


# --- samples that no sensor can have seen


def odd(values):
    return [item.kind for item in oddities(np.asarray(values, dtype=float))]


def sentinels(count):
    """Two runs of a value far off in a thousand samples of a sine."""
    y = np.sin(np.linspace(0.0, 6.0, 1000))
    y[200 : 200 + count] = y[600 : 600 + count] = -10.0
    return odd(y)


def spike(height, steps=1.0):
    """One sample off, among steps to and fro or on a slow ramp to 100."""
    y = np.arange(1000) % 2 if steps else np.linspace(0.0, 100.0, 1000)
    y = y.astype(float)
    y[500] = y[499] + height
    return odd(y)


def wraps(short):
    """An angle that turns by a degree a sample, and once over its end and ``short`` degrees on."""
    return odd(np.concatenate([np.arange(260.0, 360.0), short + np.arange(100.0)]))


# --- trials


def steady():
    """The mean of a step's last part, of which some is not steady."""
    t = np.arange(1000) * 1e-3
    return round(step_measures(t, np.where(t < 0.75, 1.3, 1.0), 1.0).steady_speed, 3)


def unsettled(end):
    t = np.arange(1000) * 1e-3
    v = np.where((t > end) & (t < end + 0.01), 1.2, 1.0)
    return step_measures(t, v, 1.0).settling_time is None


def in_band(off):
    t = np.arange(1000) * 1e-3
    return step_measures(t, np.where(t < 0.3, 1.0 + off, 1.0), 1.0).settling_time


def decay_begins(lacking):
    """Whether a ramp that lacks so much of the step up to its end is left out of the decay."""
    t = np.arange(2000) * 1e-3
    late = np.maximum(t - 0.3, 0.0)
    swing = np.exp(-2.5 * late) * np.sin(25.0 * np.sqrt(0.99) * late)
    asked = np.where(t < 0.2995, 1.0 - lacking, 1.0)
    result = step_measures(t, np.minimum(t / 0.3, 1.0) + 0.2 * swing, 1.0, asked=asked)
    return result.damping_ratio is not None and abs(result.damping_ratio - 0.1) < 2e-3


def short(lasts, less):
    t = np.arange(1000) * 1e-3
    v = np.where((t >= 0.2) & (t < 0.2 + lasts - 5e-4), 1.0 - less, 1.0)
    return short_measures(t, v, np.ones(t.size), v < 1.0) is None


def final():
    t = np.arange(1001) * 1e-3
    return round(tracking_measures(t, np.where(t < 0.93, 1.0, 0.0), 0.0 * t)["final_error"], 3)


def swing(cycles=12, size=1e-3, decay=0.0, reference=0.0):
    """Whether a swing of a stroke of 1 m counts as a limit cycle."""
    t = np.arange(4000) * 1e-3
    phase = 2.0 * np.pi * 4.0 * t
    on = (t >= 0.5) & (t < 0.5 + cycles / 4.0)
    y = np.where(on, size * np.exp(-decay * (t - 0.5)) * np.sin(phase), 0.0)
    desired = 0.1 + 0.05 * t + reference * np.sin(phase)  # never turns round
    return limit_cycle(t, desired + y, desired, np.sin(phase)[:, None], 1.0) is not None


# --- frequency responses


def response(size=64, segments=8, choice=USUAL, delay=0, weak=0.0, near=()):
    """A response of noise, or of two tones of which one is ``weak``, by so many segments; as large
    as the other are those of lines ``near`` it."""
    rng = np.random.default_rng(3)
    x = rng.standard_normal(size * (segments + 1) // 2)
    if weak:
        n = np.arange(size * segments)
        x = math.sqrt(weak) * np.sin(2 * np.pi * 9 * n / size)
        x += np.sum([np.sin(2 * np.pi * k * n / size) for k in (4, *near)], axis=0)
    y = np.roll(x, delay) + 1e-6 * rng.standard_normal(x.size)
    signals = signals_of([(x, y)], 1.0, choice._replace(segment=float(size)))
    return estimate(signals)


def least_segments(count):
    x = np.zeros(64 * count)
    return refusal(lambda: signals_of([(x, x)], 1.0, Averaging(64.0)))


def least_samples(size):
    x = np.zeros(1000)
    return refusal(lambda: signals_of([(x, x)], 1.0, Averaging(float(size))))


def usual_size():
    x = np.zeros(9000)
    return signals_of([(x, x)], 1.0, USUAL).size


def tones(weak, near=()):
    """How many frequencies have power."""
    return int(np.isfinite(response(weak=weak, near=near).coherence).sum())


def is_late(delay):
    texts = response(size=100, segments=20, choice=Averaging(coherence=0.5), delay=delay).warnings
    return any(text.key == "frequency_response.late" for text in texts)


def frequencies_of_a_line(count):
    choice = Averaging(frequency=(count + 0.5) / 64.0)
    return response(choice=choice).delay is None


# --- flow maps


def sorted_readings(slope=1.0, drops=(1e6, 2e6, 4e6, 8e6), up=None):
    """Readings whose flow grows by ``slope`` with the command; ``up``: the share on the way up."""
    u = np.repeat([2.0, 4.0, 6.0, 8.0, 10.0], len(drops))
    drop = np.tile(drops, 5)
    q = 1e-4 * (1.0 - slope + slope * u / 10.0) * np.sqrt(drop / 8e6)
    line = np.arange(u.size)
    if up is not None:
        ways = np.where(np.arange(100) < 100 * up, 1.0, -1.0)
        u = 5.0 + np.concatenate([[0.0], np.cumsum(ways)]) * 0.04
        drop, line = np.tile(drops, 26)[: u.size], np.arange(u.size)
        q = 1e-5 * u * np.sqrt(drop / 8e6)
    return sort_readings("map", readings_table(u, drop, q, line=line), FlowMapOptions(), 0.0)


def spans(gap):
    return sorted_readings(drops=(1e6, 2e6, 4e6, 8e6, 8e6 * (1.0 - gap) ** 2)).spans


def smallest_noise():
    r = Stub(method=["a"], digit={"a": 0.0})
    return round(1e6 * float(Noise({"a": (0.0, 0.0)}).std(r, np.zeros(1))[0]))


def left_out():
    return int(few(np.ones(200, bool), np.arange(200.0)).sum())


def spline(**more):
    return Spline(1.0, np.linspace(1.5, 10.0, 40), Axis(np.linspace(0.0, 1.0, 4), 3), **more)


def narrow():
    one = spline(kinks=(5.0,)).volts
    return round(1e5 * float(np.diff(one).min()))


UNITS = Units("L/min", "bar")


def unlike(x, share):
    """A series whose correlation with another is ``share``, of unit size."""
    x = (x - x.mean()) / x.std()
    y = np.cos(7.0 * np.arange(x.size))
    y = y - y.mean() - np.mean(y * x) * x
    return share * x + math.sqrt(1.0 - share**2) * y / y.std()


def warms(kelvin=30.0, share=1.0, count=40):
    """Whether oil that warms by so much with the command is told."""
    u = np.linspace(1.0, 9.0, count)
    warm = unlike(u, share)
    warm = 300.0 + kelvin * warm / (share * np.ptp((u - u.mean()) / u.std()))
    rows = Stub(temperature=warm, pressure_drop=np.full(count, 1e6), command=u)
    return keys(tables._warming(rows, UNITS, "degC"))


def warm_flow(change=0.05, sigmas=100.0, flow=0.5):
    """Whether flows are told that change by a share over 10 K, known to so many errors."""
    warm = np.linspace(-5.0, 5.0, 40)
    rest = unlike(warm, 0.0) * 0.1 * change / sigmas * math.sqrt(38.0 / 40.0 * np.sum(warm**2))
    share = 0.1 * change * warm + rest
    rows = Stub(temperature=300.0 + warm, flow=flow * (1.0 + share))
    fit = Stub(residuals=flow * share, sigmas=np.zeros(40), map=Stub(rated_flow=1.0))
    return keys(tables._warm_flow(fit, rows))


def driven(volts):
    """The refusal of a command of a driver of 0 to 10 V."""
    rows = readings_table(np.array([volts]), np.array([1e6]), np.array([1e-4]))
    given: Any = (
        rows,
        Stub(command_min=0.0, command_max=10.0, largest=10.0),
        Stub(sign=1),
        tables.LeftOut([]),
    )
    return refusal(lambda: tables._commanded("a", *given))


def of_flow(share, of_supply=False):
    """The keys of notes on flows that are a share of those of the gain, or of the supply's."""
    edge = next(edge for _, valve, edge in RIG.edges() if valve.edge_name(edge) == "sh")
    u, size = np.linspace(2.0, 9.0, 5), float(RIG.supply.flow_limit)
    flow = float(edge.flow_gain or 0.0) * (u - float(edge.deadband)) * math.sqrt(1e6)
    flow = size * np.linspace(0.1, 1.0, 5) if of_supply else flow
    rows = readings_table(u, np.full(5, 1e6), share * flow, valve="sh")
    (edge,) = tables.prepare_readings(RIG, [rows]).edges
    return [getattr(note, "key", "").partition(".")[2] for note in edge.notes]


def step_reading(size=0.1, scatter=0.0):
    """How many readings a block of a drop gives, a share of the supply's, that scatters by one."""
    model = Model.of(SLIDE)
    head, rod = (int(getattr(model.plant.cylinders[0], f"node_{s}")) for s in ("head", "rod"))
    supply = float(SLIDE.supply.pressure)
    drop = size * supply * (1.0 + scatter * np.where(np.arange(80) % 2, 1.0, -1.0))
    pressure = {0: np.full(80, supply), 1: np.zeros(80)}
    pressure |= {head: supply - drop, rod: np.full(80, 0.5 * supply)}
    log = Record(np.arange(80) * 1e-3, {"press.servo.command": np.full(80, 5.0)})
    block = step_readings._Block(0, pressure, {head: 1e-4})
    return len(list(step_readings._readings(model, log, block)))


# --- energies and fits


def motion(back=0.1, stroke=0.1, force=3000.0, pressed=0.0):
    """The bounds of a boom that goes out by ``stroke`` and comes ``back`` [m]."""
    head, rod = RIG.cylinder_named("boom").areas()
    x = 0.02 + np.concatenate(
        [np.linspace(0, stroke, 500), np.linspace(stroke, stroke - back, 500)]
    )
    p = np.full(1000, (force + 5e5 * rod) / head)
    low = 5e5 + np.where(np.arange(1000) > 900, pressed, 0.0)
    channels = {"boom.x": x, "boom.p_head": p, "boom.p_rod": low}
    return bounds(RIG, Record(np.arange(1000) * 1e-3, channels), "boom")


def travel(share):
    stroke = share * float(RIG.cylinder_named("boom").stroke)
    return refusal(lambda: motion(back=stroke, stroke=stroke))


def carries(share):
    head, _ = RIG.cylinder_named("boom").areas()
    return motion(force=share * float(RIG.supply.pressure) * head).carries


def closed_by_oil(share):
    price = motion().standard
    unit = motion(pressed=1e5).retained / price
    return motion(pressed=1e5 * share / unit).closed


def products(error, power=1.0):
    """How many products of powers logs know that know a product by its ``error``, each to 1."""
    a = np.array([power, -1.0]) / math.hypot(power, 1.0)
    b = np.array([a[1], -a[0]])
    normal = np.outer(a, a) / error**2 + np.outer(b, b)
    return [one.text for one in groups_of(("m", "k"), (2.0, 3.0), normal, 1.0)]


def means(rate, count=10_000, rig=SLIDE):
    """How many samples make a mean, of the slide or of a slower machine; 0 for none."""
    t = np.arange(count) / rate
    stroke = {f"{rig.cylinder[0].name}.x": 0.2 + 0.01 * np.sin(6.0 * t)}
    built = means_of(Model.of(rig), Record(t, stroke))
    return 0 if built is None else built.each


def log_of(y):
    counts = np.ones((y.size, 1), bool)
    return Stub(name="log", channels=("v",), recorded=y[:, None], counts=counts, sample_time=1e-3)


def goes_other_way(angle):
    t = np.arange(1000) * 2e-3 * np.pi
    return bool(_turned(log_of(np.sin(t)), np.sin(t + angle)[:, None]))


def behind(ticks, noise=0.0):
    t = np.arange(2000) * 1e-3
    y = np.sin(20.0 * (t - 1e-3 * ticks)) + noise * np.random.default_rng(1).standard_normal(2000)
    notes: Any = _late(log_of(y), np.sin(20.0 * t)[:, None])
    key = "identification.late" if ticks > 0 else "identification.early"
    assert [note.key for note in notes] in ([], [key])
    return bool(notes)


def drive():
    given = {"stage": "trial", "rig": "x", "controller": {"kind": "arc"}}
    way = {"kind": "point_to_point", "waypoints": ["1 mm", "2 mm"], "speed": "1 m/s"}
    recipe = TrialRecipe(**given, motion=way)
    limits = limits_of(recipe, recipe.motion, 2)
    return limits["hold"], round(limits["acceleration"], 3)


def pace():
    flow = np.where(np.arange(2000) == 1000, 2.0, 0.5)
    built = pace_of(flow, 1.0, 1e-3)
    assert built is not None
    return int(np.count_nonzero(built.pace < 1.0 - 1e-9))


def tip_stands(speed):
    t = np.arange(10) * 1e-3
    return not _direction(np.outer(speed * t, [1.0, 0.0, 0.0]), 1e-3).any()


def errors_of_steps():
    """The options of a map from steps whose recipe names no error of its sensors."""
    recipe = Stub(method="steps", calibration=(), calibration_drop=None, meter_limit=0.0)
    recipe.pressure_error = recipe.command_error = None
    edge = Stub(edge="sh", side="forward")
    prepared: Any = Stub(recipe=recipe, state=Stub(rig=RIG), readings=Stub(edges=[edge]))
    return first_call(tables, "fit_edge", lambda: FlowMapStage().work(prepared, Path(), None))[2]


# --- searches


def effort():
    """Simulations until the basin is known, and to the end, of two searches from afar."""
    counts = []
    for factors in ((0.3, 3.0, 1.0), (20.0, 1.0, 0.1)):
        asked = analytic_fit.problem(factors)
        state = basins.nearest_basin(asked, problem.initial(asked))
        counts.append(asked.simulator.effort.evaluations)
        descent.settle(asked, state)
        counts.append(asked.simulator.effort.evaluations)
    return counts


def denied():
    """From where on a lag [1/s] is fast enough for the logs, by its range on a grid."""
    asked = analytic_fit.problem(more=(analytic_fit.LAG, 3e3, 10.0, 1e5))
    with answers(estimates, doubts_of=None, result_of=None):
        state = estimates.estimate(asked)[1]
    return round(math.exp(state.ranges[3][0]), 1)


def residual(size):
    """A residual in spreads where a simulation is so large in SI, or failed."""
    asked = analytic_fit.problem()
    log = asked.logs[0]
    simulated = None if size is None else np.full(log.recorded.shape, size)
    return round(float(asked.residual(log, simulated)[0, 0] / asked.spread["press.x"]), 6)


def first_point(noise=0.02):
    asked = analytic_fit.problem(noise=noise)
    return asked, problem.evaluate(asked, problem.initial(asked))


def difference():
    """The step of the bulk modulus that derivatives are taken by, of itself."""
    asked, state = first_point()
    seen, each = [], asked.simulator.each
    with answers(asked.simulator, each=lambda *given: seen.extend(given[0]) or each(*given)):
        problem.jacobian(asked, state, [0])
    return round(math.log(seen[0][0][0] / asked.values(state.theta)[0]), 9)


def smallest_scale():
    asked, state = first_point(1e-3)
    return round(problem.weighed(asked, state).scales["press.x"] / asked.spread["press.x"], 6)


def same_mesh(move=0.0, shift=0.0):
    _, state = first_point()
    there = [item + shift for item in state.shifts]
    return state.here.mesh.serves(state.theta + move, there, state.slack)


# --- what is left of a fit


def left_over(share, times):
    """Whether a sine, is told of which so much is left, and how many noises that is."""
    y = np.sin(np.arange(2000) * 2e-3 * np.pi)
    log, name = log_of(y), "press.v"
    log.channels, log.band = (name,), None
    log.seen = Record(np.arange(2000) * 1e-3, {name: y})
    left = times * 0.005 * np.std(y)
    fit = Stub(fit_percent={name: 100.0 * (1.0 - share)}, residual_rms={name: left})
    return bool(_left_over([log], [fit]))


# --- verdicts


def channel(name="press.v", fit=50.0, error=1.0, bias=0.0, **more):
    return ChannelResult(name, "m/s", fit, error, bias, error, **more)


def keys(messages):
    return [item.key.partition(".")[2] for item in messages]


def poor(fit):
    return notes(channel("press.x", fit))


def notes(result):
    asked = Thresholds(fit_percent={})
    return keys(checks.unrequested([result], asked, SLIDE, Record(np.zeros(1), {})))


def level(fit, share=1.0):
    """Whether a channel is off by its level, which makes up a share of the error's square."""
    return notes(channel(fit=fit, bias=math.sqrt(share)))


def allowed(noise):
    """The threshold of a fit of 70 % for a channel of which so much is noise."""
    asked = Thresholds(fit_percent={"v": 70.0})
    (check,) = checks.checks_of([channel(noise_share=noise)], [], [], asked, SLIDE)
    return round(check.asked, 1)


def only_noise(share):
    t = np.arange(20_000) * 1e-3
    y = math.sqrt(2.0 * (1.0 - share)) * np.sin(t)
    y = y + math.sqrt(share) * np.random.default_rng(1).standard_normal(t.size)
    pair = residuals.Pair(y, y + 0.1, False)
    return residuals.compare_channel(Record(t, {"press.v": y}), Model.of(SLIDE), "press.v", pair)


def lags():
    """(first, last) lag of a residual at 1 kHz."""
    t = np.arange(20_000) * 1e-3
    y = np.sin(t)
    pair = residuals.Pair(y, y + np.cos(3.0 * t), False)
    model, log = Model.of(SLIDE), Record(t, {"press.v": y})
    seen = residuals.compare_channel(log, model, "press.v", pair).autocorrelation
    assert seen is not None
    return seen.lag[0], seen.lag[-1]


def drifts(share):
    """Whether a command stands that drifts by a share of its step."""
    drift = np.clip(np.arange(1000) - 100, 0, None) * 3.0 * share / 900.0
    return transients.stands(np.where(np.arange(1000) < 100, 0.0, 2.0 + drift)[:, None], 100)


def judged(periods=9.0, off=0.0, error=0.0, still=True):
    """Why a ringing of 6 Hz over so many periods is not judged, its frequency said ``off``."""
    omega = 12.0 * np.pi / (1.0 - off)
    damping = 0.3 if still else 0.01
    t = np.linspace(0.0, 2.0 * np.pi * periods / omega / math.sqrt(1.0 - damping**2), 800)
    y = np.exp(-0.6 * t) * np.sin(12.0 * np.pi * t) * (not still)
    seen = Ringing(omega, damping, 0.0, damping * error, stop=float(t[-1]), ok=True)
    note = transients.why_not_judged(t, y[:, None], seen)
    return "" if not note else note.key.partition(".")[2]


def sweeps_of(top=20.0, share=1.0):
    """How many sweeps count whose coherent frequencies go from 1 Hz to ``top``, a share of them."""
    f = np.linspace(1.0, top, 200)
    seen = Stub(frequency=f, coherent=np.append(np.arange(199) % 20 < 20 * share, True))
    with answers(sweeps, _sweeping=lambda *_: ("u", slice(None)), _response=lambda *_: seen,
                 _sweep_of=1):  # fmt: skip
        pairs = {"press.v": Stub(recorded=f, simulated=f)}
        return len(sweeps.sweeps_of(Record(f, {}), Model.of(SLIDE), "press", pairs, 0.5))


def sweeping(changes=100, stands=0.0):
    """Whether a command sweeps that changes so often, and stands a share of the time."""
    wait = np.zeros(round(10 * changes * stands / (1.0 - stands)))
    u = np.concatenate([np.repeat(np.arange(changes) % 2, 10), wait, np.repeat([1.0, 0.0], 10)])
    log = Record(np.arange(u.size) * 1e-3, {"press.servo.command": 5.0 * u})
    return sweeps._sweeping(log, Model.of(SLIDE), "press") is not None


def unexplained(fit, noise=0.0):
    items = (channel(fit=fit, noise_share=noise), channel(fit=None))
    log = LogResult("a", "none", "held_out", 1.0, 1e-3, channels=items)
    return len(list(judge._unexplained([log])))


def black_box(share):
    """Whether it is better whose squared error is a share of the model's."""
    items = (channel(fit=0.0, baseline_percent=100.0 * (1.0 - math.sqrt(share))),)
    return len(list(baseline._better(LogResult("a", "", "held_out", 1.0, 1e-3, channels=items))))


def arx_of(rows):
    """Whether a first-order ARX, six coefficients, is fitted to so many rows."""
    y, u = np.random.default_rng(1).standard_normal((2, rows + 1))
    log = Record(np.arange(rows + 1) * 1e-3, {"ram.p_head": y, "ram.spool.command": u})
    return baseline._least_squares("ram.p_head", ("ram.spool.command",), 1e-3, 1, [log]) is not None


# --- samples that a model was fitted to


def white(count, columns=1, seed=1):
    return np.random.default_rng(seed).standard_normal((count, columns))


def copies(off=0.0, late=0.0):
    """How many stretches of a log are those of one off by a share of its size, or late in ticks;
    it repeats, so that no shift of its time is found."""
    t, y = np.arange(100) * 1e-3, np.tile(white(50)[:, 0], 2)
    rows = held_out.FittedSamples("a", t, {"v": y + off * np.abs(y).max()}, "")
    return len(held_out._overlaps(Record(t + 1e-3 * late, {"v": y}), rows))


def run_of(count):
    t = np.arange(20) * 1e-3
    return len(held_out._runs(t, np.arange(20) < count, Stub(log="a", t=t)))


def same_blocks(off=0.0, count=64, near=5):
    """Whether noise is the same that is off by so many noises in all but ``near`` of 5 channels."""
    y, sign = white(count, 5), np.where(np.arange(count) % 2, 1.0, -1.0)
    shift = np.where(np.arange(5) < near, off, 9.0) * sign[:, None]
    t = np.arange(count) * 1e-3
    return bool(held_out._same_blocks(t, y + shift, t, y).any())


def tells(step, coarse=0):
    """Whether a channel whose readings are so many noises apart, some far more, has its own."""
    steps = np.where(np.arange(100) < 100 - coarse, step, 9.0)
    return held_out._tells(np.concatenate([[0.0], np.cumsum(steps)]), 1.0)


# --- a law of pressure feedback


def law_of(top=1.2, twice=2.0):
    """The washouts that are chosen where the damping is ``top`` at best, at one gain and off-side
    gain, and less by them: by a second one ``twice − 1`` times as much as by the first."""

    def loop(law):
        slow = 1.0 + (law.washout + (twice - 1.0) * law.ramp_washout) / 5.0
        beside = 1e9 * law.off_gain - 0.1

        def damping(gain):
            return top / slow * np.exp(-(np.log(np.maximum(gain, 1e-30) / 1e-10) ** 2) - beside**2)

        return Stub(damping_ratio=damping, off=np.ones(1))

    point = Stub(function="extend_resistive", volume_head=1e-3)
    with answers(tune_search, swing=lambda motion: 10.0, _stiffness=lambda motion: (1e8, 1e8)):
        recipe = TuneRecipe(stage="tune", rig="x", damping_ratio="0.5")
        search = tune_search.LawSearch([Stub(point=point, loop=loop)], recipe, {})
    try:
        with answers(tune_search, _keeps_demands=True):
            law = search.law()
    except ValueError:  # no washout is good enough
        return 0.0, 0.0, search
    return round(law.washout, 3), round(law.ramp_washout, 3), search


def blocks(share):
    """How many blocks of a log are read in which a chamber has so much of the cavitation
    pressure."""
    model, y = Model.of(SLIDE), np.zeros(80)
    empty = share * float(model.plant.cylinders[0].cavitation_pressure)
    y = {"press.x": y + 0.1, "press.v": y, "press.p_rod": y + 1e6, "press.p_head": y + empty}
    log = Record(np.arange(80) * 1e-3, y)
    return len(list(step_readings._steady_blocks(model, 0, log, slice(0, 80), 0.08)))


def notes_on(far=0, flow=1.0, scatter=0.0, lack=1.0, trials=0.0):
    """The keys of the notes on a map of 400 readings, so many of them far from it."""
    sigmas = np.where(np.arange(400) < far, 9.0, 0.0)
    solution = Stub(lone=np.zeros(1, bool), flow=np.full(400, flow), widening=lack)
    noise = Stub(std=lambda readings, flow: scatter * flow)
    keep = np.ones(400, bool)
    fit: Any = Stub(readings=None, solution=solution, noise=noise, keep=keep, sigmas=sigmas)
    known: Any = Stub(outliers=(), replicates=9, status="estimated", trial_scatter=trials)
    return [note.key.partition(".")[2] for note in results._warnings(fit, known)]


ROWS = [
    (ODD, "share", sentinels, (20, 30), [["sentinel"], []]),
    (ODD, "jump", spike, (7.0, 9.0), [[], ["jump"]]),
    (ODD, "span", lambda h: spike(h, 0.0), (17.0, 23.0), [[], ["jump"]]),
    (ODD, "wrap", wraps, (30.0, 40.0), [["wrap"], []]),
    (MEASURES, "steady", steady, 1.027),
    (MEASURES, "unsettled", unsettled, (0.85, 0.91), [False, True]),
    (MEASURES, "band", in_band, (0.04, 0.06), [0.0, 0.3]),
    (MEASURES, "shaped", decay_begins, (0.8e-3, 1.2e-3), [False, True]),
    (MEASURES, "lasts", lambda s: short(s, 0.1), (0.08, 0.12), [True, False]),
    (MEASURES, "less", lambda s: short(0.5, s), (1.6e-3, 2.4e-3), [True, False]),
    (MEASURES, "final", final, 0.297),
    (LIMIT_CYCLE, "cycles", swing, (4.4, 6.0), [False, True]),
    (LIMIT_CYCLE, "smallest", lambda s: swing(size=s), (4.2e-4, 6e-4), [False, True]),
    (LIMIT_CYCLE, "lasting", lambda d: swing(8, 3e-3, d), (0.5, 0.7), [True, False]),
    (LIMIT_CYCLE, "reference", lambda s: swing(reference=s), (4e-4, 6e-4), [True, False]),
    (RESPONSE, "averages", lambda n: bool(least_segments(n)), (3, 4), [True, False]),
    (RESPONSE, "samples", lambda n: bool(least_samples(n)), (15, 16), [True, False]),
    (RESPONSE, "usual_averages", usual_size, 1125),
    (RESPONSE, "no_power", tones, (0.8e-8, 1.2e-8), [1, 2]),
    (RESPONSE, "distinct", lambda p: tones(2.0 * p, (8.5, 9.5)), (0.8e-3, 1.2e-3), [1, 2]),
    (RESPONSE, "late", is_late, (23, 27), [False, True]),
    (RESPONSE, "line", frequencies_of_a_line, (3, 4), [True, False]),
    (RESPONSE, "shown", lambda: len(Curve.of(response(), 0.2).frequency), 19),
    (READING, "spans", lambda: spans(0.02), 24),
    (READING, "effect", lambda s: refusal(lambda: sorted_readings(s)), (0.19, 0.23),
     ["flow_maps.idle", ""]),
    (READING, "sweep", lambda s: bool(np.any(sorted_readings(up=s).sweep)), (0.13, 0.17),
     [False, True]),
    (READING, "outliers", left_out, 10),
    (READING, "noise", smallest_noise, 100),
    (NOTES, "far", lambda n: notes_on(far=n), (3, 5), [[], ["backed_outliers"]]),
    (NOTES, "wide", lambda f: notes_on(flow=f, scatter=0.2), (0.09, 0.11), [[], ["scatter"]]),
    (NOTES, "scatter", lambda s: notes_on(scatter=s), (0.045, 0.055), [[], ["scatter"]]),
    (NOTES, "lack", lambda s: notes_on(lack=s), (1.9, 2.1), [[], ["lack_of_fit"]]),
    (NOTES, "trials", lambda s: notes_on(trials=s), (1.9e-3, 2.1e-3), [[], ["trial_scatter"]]),
    (tables.SETTINGS, "correlation", lambda s: warms(share=s), (0.57, 0.63),
     [[], ["warm_with_command"]]),
    (tables.SETTINGS, "warming", warms, (2.8, 3.2), [[], ["warm_with_command"]]),
    (tables.SETTINGS, "warm_readings", lambda n: warms(count=n), (7, 8),
     [[], ["warm_with_command"]]),
    (tables.SETTINGS, "warm_change", warm_flow, (0.009, 0.011), [[], ["warm_flow"]]),
    (tables.SETTINGS, "warm_sigmas", lambda n: warm_flow(sigmas=n), (3.8, 4.2),
     [[], ["warm_flow"]]),
    (tables.SETTINGS, "warm_flow", lambda s: warm_flow(flow=s), (0.09, 0.12), [[], ["warm_flow"]]),
    (tables.SETTINGS, "overshoot", driven, (10.09, 10.11), ["", "flow_maps.outside_driver"]),
    (tables.SETTINGS, "of_gain", of_flow, (1.0 / 3.1, 1.0 / 2.9, 2.9, 3.1),
     [["flow_and_gain"], [], [], ["flow_and_gain"]]),
    (tables.SETTINGS, "large_flow", lambda s: of_flow(s, True), (20.0, 23.0),
     [["flow_and_gain"], ["flow_and_supply"]]),
    (step_readings.SETTINGS, "drop", step_reading, (1.8e-3, 2.2e-3), [0, 1]),
    (step_readings.SETTINGS, "steady", lambda s: step_reading(0.1, s), (0.23, 0.27), [1, 0]),
    (SPLINE, "spans", lambda: spline().volts.size - 1, 12),
    (SPLINE, "slope", lambda: round(1e9 * float(spline().floor.max())), 100000),
    (SPLINE, "narrow", narrow, 436),
    (SPLINE, "sharp", lambda: round(1e9 * spline(kinks=(5.0,)).along_u.stiffness.min()), 100),
    (SPLINE, "soft", lambda: round(1e11 * spline(soft=True).along_u.stiffness.min()), 100),
    (SPLINE, "bend", lambda: round(1e6 * spline().along_s.bent(1).stiffness.min()), 100),
    (BOUNDS, "travel", travel, (0.004, 0.006), ["ledger.did_not_move", ""]),
    (BOUNDS, "closed", lambda b: motion(back=b).closed, (0.0985, 0.0975), [True, False]),
    (BOUNDS, "loaded", carries, (0.016, 0.024), ["none", "head"]),
    (BOUNDS, "oil", closed_by_oil, (0.0025, 0.0035), [True, False]),
    (GROUPS, "better", lambda e: len(products(e)), (0.115, 0.145), [1, 0]),
    (GROUPS, "halves", lambda: products(0.05, 0.5), ["k^2/m"]),
    (MEANS, "share", lambda: means(10_000.0), 6),
    (MEANS, "longest", lambda: means(20_000.0, rig=RIG), 20),
    (MEANS, "fewest", lambda: means(10_000.0, 900), 4),
    (MEANS, "worth", lambda n: means(10_000.0, n), (410, 610), [0, 3]),
    (RESULTS, "opposite", goes_other_way, (1.98, 2.2), [False, True]),
    (RESULTS, "late", behind, (0.2, 0.3, -0.3), [False, True, True]),
    (RESULTS, "latest", behind, (4.5, 6.0), [True, False]),
    (RESULTS, "explains", lambda n: behind(1, n), (0.026, 0.031), [True, False]),
    (RESULTS, "little", lambda s: left_over(s, 9.0), (0.09, 0.11), [False, True]),
    (RESULTS, "structure", lambda n: left_over(0.5, n), (2.7, 3.3), [False, True]),
    (RESULTS, "fine", lambda n: left_over(0.5, n), (2.7, 3.3), [False, True]),
    (checks.SETTINGS, "poor", poor, (79.0, 81.0), [["poor_fit"], []]),
    (checks.SETTINGS, "level", level, (76.0, 74.0), [[], ["level"]]),
    (checks.SETTINGS, "mostly", lambda s: level(50.0, s), (0.47, 0.53), [[], ["level"]]),
    (checks.SETTINGS, "shape", lambda f: level(f, 0.6), (17.8, 24.1), [[], ["level"]]),
    (checks.SETTINGS, "noisy", allowed, (0.24, 0.26), [70.0, 61.1]),
    (residuals.SETTINGS, "noise", lambda s: only_noise(s).fit_percent is None, (0.47, 0.53),
     [False, True]),
    *each(residuals.SETTINGS, "lag_step lag_span", lags, (0.01, 0.5)),
    (transients.SETTINGS, "creep", drifts, (0.09, 0.11), [True, False]),
    (transients.SETTINGS, "periods", judged, (2.3, 2.7), ["short_stand", "no_half"]),
    (transients.SETTINGS, "halves", lambda s: judged(off=s, still=False), (0.13, 0.17),
     ["", "halves_differ"]),
    (transients.SETTINGS, "sigmas", lambda s: judged(error=s), (1 / 3.3, 1 / 2.7),
     ["no_half", "grows"]),
    (sweeps.SETTINGS, "band", sweeps_of, (1.9, 2.1), [0, 1]),
    (sweeps.SETTINGS, "share", lambda s: sweeps_of(share=s), (0.45, 0.55), [0, 1]),
    (sweeps.SETTINGS, "changes", sweeping, (38, 42), [False, True]),
    (sweeps.SETTINGS, "stand", lambda s: sweeping(stands=s), (0.08, 0.12), [True, False]),
    (judge.SETTINGS, "unexplained", unexplained, (71.0, 69.0), [0, 1]),
    (judge.SETTINGS, "above_noise", lambda n: unexplained(40.0, n), (0.21, 0.19), [0, 1]),
    (baseline.SETTINGS, "better", black_box, (0.47, 0.53), [1, 0]),
    (baseline.SETTINGS, "rows", arx_of, (29, 31), [False, True]),
    (held_out.SETTINGS, "same", copies, (0.8e-6, 1.2e-6), [1, 0]),
    (held_out.SETTINGS, "on_time", lambda s: copies(late=s), (0.27, 0.33), [1, 0]),
    (held_out.SETTINGS, "rows", run_of, (7, 8), [0, 1]),
    (held_out.SETTINGS, "noise", same_blocks, (0.55, 0.65), [True, False]),
    (held_out.SETTINGS, "block", lambda n: same_blocks(0.0, n), (63, 64), [False, True]),
    (held_out.SETTINGS, "agree", lambda n: same_blocks(0.0, 64, n), (2, 3), [False, True]),
    (held_out.SETTINGS, "fine", tells, (0.45, 0.55), [True, False]),
    (held_out.SETTINGS, "finest", lambda n: tells(0.1, n), (92, 88), [False, True]),
    *each(tune_search.SEARCH, "margin bisections", lambda: law_of()[:2], (2.855, 2.855)),
    (tune_search.SEARCH, "pair", lambda k: law_of(twice=k)[1] > 0.0, (3.6, 3.9), [True, False]),
    (tune_search.SEARCH, "nearly", lambda: law_of(0.5)[:2], (0.399, 0.0)),
    (tune_search.SEARCH, "gain_span", lambda: round(1e14 * law_of()[2].grid[1], 6), 100.0),
    (tune_search.SEARCH, "gain_points", lambda: law_of()[2].grid.size, 82),
    *each(basins.SETTINGS, "reach coarse fine damping", effort, [212, 222, 224, 234]),
    *each(descent.SETTINGS, "damping easier harder good", effort, [212, 222, 224, 234]),
    *each(estimates.SETTINGS, "denied points halvings", denied, 392.4),
    (problem.SETTINGS, "limit", lambda: residual(1e12), 1e6),
    (problem.SETTINGS, "failed", lambda: residual(None), 10.0),
    (problem.SETTINGS, "difference", difference, 1e-5),
    (problem.SETTINGS, "scale_floor", smallest_scale, 5e-3),
    (problem.SETTINGS, "coarse_slack", lambda: first_point()[1].slack, 100.0),
    (problem.SETTINGS, "near_theta", same_mesh, (0.018, 0.022), [True, False]),
    (problem.SETTINGS, "near_shift", lambda s: same_mesh(0.0, s), (0.9, 1.1), [True, False]),
    (ERRORS, "pressure", lambda: round(
        errors_of_steps().drop_std / float(RIG.supply.pressure), 6), 0.001414),
    (ERRORS, "command", lambda: errors_of_steps().command_std, 0.005),
    *each(MOTION, "rest speed_up", drive, (0.5, 5.0)),
    (COORDINATION, "smooth", pace, 863),
    (COORDINATION, "still", tip_stands, (8e-5, 1.2e-4), [True, False]),
    (GROUPS, "largest", lambda: products(0.05, 2.6) + products(0.05, 3.6),
     ["k^2/m^5", "k/m^3.48"]),
    (observations.SETTINGS, "empty", blocks, (0.48, 0.52), [1, 0]),
]  # fmt: skip

test_a_third_more_or_less_shows = each_shows(ROWS)
