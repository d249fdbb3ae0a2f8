"""Each number of the fit of a flow map decides an outcome, as in `test_settings_matter`."""

import math
from dataclasses import replace
from types import SimpleNamespace as Stub
from typing import Any

import numpy as np

from ehbench.flow_maps import fit, readings, shape
from ehbench.flow_maps.readings import SETTINGS as READING
from ehbench.flow_maps.readings import readings_table
from ehbench.flow_maps.spline import SETTINGS as SPLINE
from ehbench.flow_maps.spline import Axis, Spline
from ehbench.vocabulary.errors import EhbenchError
from tests.settings import answers, each_shows, first_call

COARSE, COMMANDS = Axis(np.linspace(0.0, 1.0, 5), 3), np.linspace(2.0, 10.0, 20)
PLAIN = shape.Shape(1.0, COMMANDS, COARSE, np.ones(2))
ANY: Any = Stub()
REFUSED = "flow_maps.no_map_fits"


def fit_of(rms=0.0, lack=1.0, rising=math.inf, lag=(0.0, 0.0), apart=0.0, later=None):
    """(refusal, turns, hysteresis taken off [V], deadband's interval [V]) of fits with these
    numbers; with a leak that is ``apart`` likelier to end than to go on, and a hysteresis that is
    ``later`` from the second turn on."""
    turns, inf = [], math.inf
    readings: Any = Stub(who="map", commands=np.array([0.0, 10.0]), sweep=np.ones(4), s=0.0, y=0.0)
    readings.shifted = lambda _: readings

    def iterate(_, leak):
        turns.append(1)
        goes_on = apart > 0.0 and leak is None
        solution = Stub(cells=Stub(heard=np.full(4, rms)), flow=0.0, widening=lack, lack=1.0)
        solution.parameters = 0.5 * apart if goes_on else 0.0
        interval = (3.0, 4.0) if goes_on else (1.0, 2.0)
        shape: Any = Stub(rising=rising)
        noise: Any = Stub(std=lambda *_: inf)
        return fit.Fit(
            *(readings, shape, solution, noise, fit.Deadband(interval=interval), Stub()),
            *(np.ones(4, bool), np.zeros(4), ()),
        )

    leak = None if not apart else fit.Leak(0.0, 0.0, 0.0, 1)
    with answers(fit, sort_readings=lambda *_: readings, without_zeros=lambda r: r,
                 _find_leak=lambda _: leak,
                 _iterate=iterate,
                 _hysteresis_of=lambda _: later if later and turns[1:] else lag,
                 _shift_of=lambda _: (0.0, 0.0),
                 replace=lambda x, **new: x if x is readings else replace(x, **new)):  # fmt: skip
        try:
            result = fit.fit_readings("map", ANY, ANY)
        except EhbenchError as error:
            return error.key, len(turns), 0.0, ()
    assert result.hysteresis
    return "", len(turns), result.hysteresis.removed, result.deadband.interval


def leak_of(leak, more, error=0.0):
    """How many commands pass a leak of so much of the rated flow, of two of which the second passes
    ``more``; 0 where no leak is found."""
    y = np.repeat([leak, more, 1.0], 5) + np.tile(math.sqrt(5) * error * np.arange(-2.0, 3.0), 3)
    step = np.repeat(np.arange(3), 5)
    readings: Any = Stub(level=step, command=1.0 * step, step=step, silent=np.zeros(15, bool))
    readings.y, readings.s, readings.cell = y, np.ones(15), step
    readings.cell_level = np.arange(3)
    result = fit._find_leak(readings)
    return result.level if result else 0


def opens_at(flow, sure=99.0):
    """The level from which a valve opens whose second command passes so much of the rated flow,
    so many standard deviations above none."""
    cells: Any = Stub(y=np.array([0.0, flow, 1.0, 1.0, 1.0]), count=np.ones(5))
    cells.weight = np.full(5, (sure / flow) ** 2)
    levels = np.arange(5.0)
    readings: Any = Stub(levels=levels, cell_level=np.arange(5), step=np.arange(5))
    return shape.window_of(readings, cells, 1.0).opens


def bends(graded, sharp):
    """Whether a map that gains so much by either bends sharply, or more at low drops."""

    def likelihood(item, *_, **__):
        sharply, more = item.along_s.kink, item.along_s.stiffness[0] < 0.5
        return item, -sharp if sharply else -graded * more

    with answers(shape, likeliest_smoothing=likelihood, roughly_smoothed=likelihood):
        axis = shape.bend(PLAIN, ANY).along_s
    return axis.kink, bool(not axis.kink and axis.stiffness[0] < 0.5)


def cells_alone(gain, count=3, size=40, off=1e3):
    """How many of ``count`` cells that lie so many deviations ``off`` stand alone, of a map that
    gains so much without each."""
    cells: Any = Stub(weight=np.ones(size), weighed=size, u=np.full(size, 5.0), s=np.zeros(size))
    cells.count, cells.y = np.full(size, 3), np.where(np.arange(size) < count, off, 0.0)
    cells.without = lambda lone: Stub(out=int(lone.sum()))
    design: Any = Stub(design=lambda u, s: np.zeros((u.size, 1)))
    result = Stub(spline=design, coefficients=np.zeros(1), widening=1.0)
    result.variance = lambda _: np.zeros(size)
    with answers(shape, judge=lambda *_: result,
                 likeliest_smoothing=lambda s, c: (s, -gain * getattr(c, "out", 0.0))):  # fmt: skip
        return int(shape.lone_cells(ANY, PLAIN, cells).sum())


def kinks_of(rough=99.0, sure=99.0, commands=20):
    """How many kinks a map gets, each of which gains so much at a rough look and at a close one;
    −1 where none is sought."""
    plain = replace(PLAIN, above=COMMANDS[:commands])
    looked = []

    def smoothed(item, *_, **__):
        looked.append(item)
        return item, -sure * len(item.kinks)

    def bent(item, _, gap):
        return replace(item, kinks=(*item.kinks, gap[0])), -sure * len(item.kinks) - rough

    with answers(shape, likeliest_smoothing=smoothed, start_deadband=lambda _, item, *__: item,
                 find_deadband=lambda _, item, *__: (None, item), let_fall=lambda item, _: item,
                 _bent=bent,
                 _place=lambda item, _: shape.Kink(item.kinks[-1], 0.1, (0.0, 1.0))):  # fmt: skip
        kinks = shape.find_kinks(ANY, plain, ANY, 1.0)[1]
    return len(kinks) if looked else -1


def roomy(gap):
    """Whether a gap of a share of the range has room for a kink."""
    return bool(shape._roomy(np.array([0.0, 1.0 - gap, 1.0]))[2])


def knows_noise(repeats):
    """Whether the noise that so many repeats measure makes a map through every cell no likelier."""
    u, s = np.repeat(COMMANDS, 5), np.tile(np.linspace(0.2, 1.0, 5), 20)
    cells: Any = Stub(u=u, s=s, weight=np.ones(100), weighed=100, replicates=repeats)

    def deviance(miss):
        cells.y = np.full(100, miss)
        fit = shape.Regression(Spline(1.0, COMMANDS, COARSE), cells)
        return fit._deviance(np.zeros(fit.band.shape[1]), np.ones(2))

    return deviance(0.5) - deviance(0.4) < 10.0


def falls(gain):
    """From which of its openings on a map may fall that gains so much by it."""

    def likelihood(item, _):
        value = max(item.rising - 5.0, 0.0) - gain if np.isfinite(item.rising) else 0.0
        return Stub(free=lambda _: -1e3, solve=lambda _: (None, value, None))

    with (answers(shape.Shape,
                 spline=lambda self: Stub(volts=np.arange(1.0, 11.0), rising=self.rising)),
                 answers(shape, regression=likelihood)):  # fmt: skip
        return shape.let_fall(PLAIN, ANY).rising


def deadband_of(shut, spread=0.5):
    """The interval of a deadband whose likelihood is a parabola of so many volts; whether the
    lowest command is shut."""
    grid = np.linspace(0.0, 4.0, 81)
    window = shape.Window(0.0, 4.0, 1, (0.0, 4.0), not shut)
    readings: Any = Stub(levels=np.linspace(0.0, 10.0, 11))
    with answers(shape, window_of=lambda *_: window,
                 profile_deadband=lambda *_: (grid, ((grid - 2.0) / spread) ** 2)):  # fmt: skip
        return shape.find_deadband(readings, PLAIN, ANY, 1.0)[0].interval


def softens():
    """The lower end of a soft start whose likelihood is a parabola of 0.2 V about the kink."""
    soft: Any = Stub(spline=lambda u, soft: u if soft else math.nan, smoothing=None)
    window = shape.Window(0.0, 3.0, 1, (0.0, 3.0), False)
    with answers(shape, regression=lambda u, _: Stub(
            solve=lambda _: (None, ((u - 1.7) / 0.2) ** 2, None))):  # fmt: skip
        start = shape.Deadband(1.7, 0.1, (1.7, 1.7), False)
        return shape.soften(ANY, soft, ANY, start, window).interval[0]


def first_span(gap):
    """Spans of a spline whose first command lies a share of the range above the deadband."""
    return Spline(1.0, np.array([1.0 + 9.0 * gap, 4.0, 7.0, 10.0]), COARSE, True).volts.size


def turns_of(restless):
    """Turns of a fit in which a reading of two comes and goes for so many turns."""
    turns = []
    cells: Any = Stub(without=lambda _: cells, heard=np.zeros(2), weighed=99)
    bent: Any = Stub(spline=lambda: Stub(rows=1, design=lambda *_: None))
    solution = Stub(flow=np.ones(2), widening=1.0, lone=np.zeros(2, bool), spline=bent.spline())
    solution.cells, solution.variance = Stub(heard=np.full(2, 99.0)), lambda _: np.zeros(2)
    readings: Any = Stub(cell=np.arange(2), u=None, s=None)
    noise: Any = Stub(std=lambda *_: np.ones(2))

    def unbacked(*_):
        turns.append(1)
        return np.array([False, len(turns) % 2 > 0 and len(turns) < restless])

    with answers(fit, _first_shape=(readings, bent, np.ones(2), np.ones(2, bool)), judge=solution,
                 first_noise=noise, measure_noise=noise, gather_cells=cells, unbacked=unbacked,
                 likeliest_smoothing=(bent, 0.0), few=lambda far, _: far):  # fmt: skip
        first_call(fit, "let_fall", lambda: fit._iterate(readings, None))
    return len(turns)


def shift_of():
    """The standard error of a likely shift, of the largest command."""
    readings: Any = Stub(shift=0.0, commands=[1.0], one_drop=False, levels=[1.0], shifted=float)
    bent: Any = Stub(deadband=0.1, above=np.ones(2), smoothing=0.0, spline=lambda _: None)
    result: Any = Stub(readings=readings, shape=bent, used=Stub(shifted=float))
    result.deadband, result.solution = Stub(value=1.0), Stub(widening=1.0)
    with answers(fit, replace=lambda item, **_: item, start_deadband=None,
                 likeliest_smoothing=lambda _, at, coarse: (None, 1e6 * (at - 0.2) ** 2),
                 regression=lambda *_: Stub(solve=lambda _: (None, 1e9))):  # fmt: skip
        return round(fit._shift_of(result)[1], 9)


def idle(share):
    """Whether a flow that hardly changes over a share of the commands at each drop is refused."""
    volts = np.array([0.0, 10.0 * share, 10.0])
    command, drop = np.concatenate([np.tile(volts[:2], 4), [3.0, 10.0]]), np.arange(1e6, 7e6, 1e6)
    drop = np.concatenate([np.repeat(drop[:4], 2), drop[4:]])
    rows = readings_table(command, drop, np.where(command > 9.0, 1e-4, 1e-7))
    try:
        readings.sort_readings("map", rows, readings.FlowMapOptions(), 0.0)
    except EhbenchError as error:
        return error.key
    return ""


ROWS = [
    (READING, "across", idle, (0.48, 0.52), ["", "flow_maps.idle"]),
    (fit.SETTINGS, "rms", lambda r: fit_of(r)[0], (0.19, 0.21), ["", REFUSED]),
    (fit.SETTINGS, "lack", lambda n: fit_of(0.1, n)[0], (95, 105), ["", REFUSED]),
    (fit.SETTINGS, "lack_rms", lambda r: fit_of(r, 200)[0], (0.047, 0.053), ["", REFUSED]),
    (fit.SETTINGS, "fall_rms", lambda r: fit_of(r, 200, 5.0)[0], (0.009, 0.011), ["", REFUSED]),
    (fit.SETTINGS, "lag_turns", lambda: fit_of(lag=(0.1, 0.01))[1], 12),
    (fit.SETTINGS, "lag", lambda n: fit_of(lag=(0.1, 0.1 / n))[2] > 0.0, (3.8, 4.2), [False, True]),
    (fit.SETTINGS, "lag_share", lambda v: fit_of(lag=(v, 1e-6))[2] > 0.0, (4.7e-3, 5.3e-3),
     [False, True]),
    (fit.SETTINGS, "settled", lambda share: fit_of(lag=(0.1, 0.01), later=(share * 0.01, 0.01))[1],
     (0.09, 0.11), [2, 12]),
    (fit.SETTINGS, "passing", lambda y: leak_of(2e-3, y), (4.8e-3, 5.2e-3), [2, 1]),
    (fit.SETTINGS, "leak_over", lambda y: leak_of(0.01, y), (0.0122, 0.0128), [2, 1]),
    (shape.SETTINGS, "shut", lambda y: (leak_of(y, 0.1), opens_at(y)), (0.9e-3, 1.1e-3),
     [(0, 2), (1, 1)]),
    (shape.SETTINGS, "shut_sure",
     lambda n: (opens_at(0.1, n), leak_of(0.1, 0.5, 0.1 / (1.4826 * n))), (3.8, 4.2),
     [(2, 0), (1, 1)]),
    (fit.SETTINGS, "leak_gain", lambda g: fit_of(apart=g)[3], (10.5, 11.2),
     [(1.0, 4.0), (1.0, 2.0)]),
    (shape.SETTINGS, "graded_gain", lambda g: bends(g, 0.0), (3.8, 4.2),
     [(False, False), (False, True)]),
    (shape.SETTINGS, "bend_gain", lambda g: bends(0.0, g)[0], (43.0, 47.0), [False, True]),
    (shape.SETTINGS, "lone_gain", cells_alone, (29.0, 31.0), [0, 3]),
    (shape.SETTINGS, "lone", lambda: cells_alone(99.0, 30, 200), 10),
    (READING, "outlier", lambda n: cells_alone(99.0, off=n), (4.8, 5.2), [0, 3]),
    (shape.SETTINGS, "kink_gain", lambda g: kinks_of(sure=g), (23.0, 25.0), [0, 3]),
    (shape.SETTINGS, "look_gain", kinks_of, (-5.3, -4.7), [0, 3]),
    (shape.SETTINGS, "kinks", lambda: kinks_of(), 3),
    (shape.SETTINGS, "kink_commands", lambda n: kinks_of(commands=n), (6, 7), [-1, 3]),
    (shape.SETTINGS, "kink_gap", roomy, (0.009, 0.011), [False, True]),
    (shape.SETTINGS, "repeats", knows_noise, (11, 12), [False, True]),
    (shape.SETTINGS, "fall_gain", falls, (43.0, 47.0), [math.inf, 8.0]),
    (shape.SETTINGS, "level_95", lambda: deadband_of(True), (1.0204, 2.9796)),
    (shape.SETTINGS, "level_99", softens, 1.1848),
    (shape.SETTINGS, "level_999", lambda: deadband_of(False), (0.3546, 3.6454)),
    (shape.SETTINGS, "width", lambda: deadband_of(True, 1e-4), (1.995, 2.005)),
    (SPLINE, "room", first_span, (0.9e-6, 1.1e-6), [5, 6]),
    (fit.SETTINGS, "settle", lambda: turns_of(99), 22),
    (fit.SETTINGS, "shift", shift_of, 0.005),
]  # fmt: skip

test_a_third_more_or_less_shows = each_shows(ROWS)
