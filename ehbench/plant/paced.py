"""Steps chosen by the guard: as long as the motion is smooth, as short as its error asks.

The step is that of `ehbench.plant.integrate`, and beside it stands one of the third order, for the
derivative at the step's end: ``e = d/10 |k_4 − f(y_1)|``. A step whose ``e`` is beyond CLOSE of
what a state may run through is taken again, half as long. Ticks under one and the same command are
taken several at a time, and the samples between read from the cubic through both ends. Valves are
linear and get their own answer, exact while a command is held. Where means of several samples are
asked for, the cubic's values are added up, those of valves too."""

import math
from typing import Any, Literal, NamedTuple

import numpy as np

from ehbench.parts.cylinder import joint_range_of
from ehbench.parts.valve import limited, valve_advance
from ehbench.parts.valve.delay import Line, line_acting, line_push
from ehbench.plant.build import Plant
from ehbench.plant.derivatives import derivatives
from ehbench.plant.integrate import STABLE, put, stages
from ehbench.plant.layout import SIDES, Layout
from ehbench.runtime.compiled import allocating_kernel, kernel, part_kernel

AUTO: Literal["auto"] = "auto"
CLOSE = 2.0e-8  # share of a state's scale by which one step may miss it
MOST_TICKS = 16  # that a step may last
LEAST = 2.0e-6  # [s]: a step so short is taken whatever its error
SETTLED = 1.0e-12  # [V] per the square of its fastest rate: a valve that moves less has arrived
OWN, SCRATCH = 6, 11  # rows of scratch: a step's own, and all with those of a valve's series
LATE = 2  # steps a tick, at least, where a delay lets a command change within it

Step = float | Literal["auto"]


class Pace(NamedTuple):
    """What steps are chosen by: ``weights``, 1 over what a step may miss each state by, 0 for none;
    the ``units`` of a tick, a power of two, of which a step is one or more; a step of ``sure``
    units is taken whatever its error."""

    weights: np.ndarray
    units: int
    sure: int = 1


class Way(NamedTuple):
    """A plant on its way: state ``y``, ``line`` of past commands, ``pace``, scratch ``k`` of shape
    (SCRATCH, states) and ``work``."""

    y: np.ndarray
    plant: Plant
    line: Line
    pace: Pace
    k: np.ndarray
    work: np.ndarray


def pace_of(plant: Plant, names: Layout, tick: float) -> Pace:
    """The pace of a plant that is commanded every ``tick`` [s].

    A joint's scale is its range, and its range a second; a pressure's the highest that supply or
    relief valve let come, of the supply line a tenth of it; a mount's the deflection under it, as
    that of what sways, whose speed has the stroke a second.
    Valves are exact beside, and what states of a friction do is seen in the joints' rates."""
    weights, n = np.zeros(names.states), plant.at.rates
    state_of: Any = plant.nodes.state
    weights[: 2 * n] = 1.0
    for index, row in enumerate(plant.cylinders):
        low, high = joint_range_of(row)
        weights[[row.joint, n + row.joint]] = 1.0 / abs(high - low)
        highest = _highest(plant, row)
        for side in SIDES:
            weights[names.state(f"p_{side}", index)] = 1.0 / highest
        if row.mount_state >= 0:
            weights[row.mount_state] = row.mount_stiffness / (highest * row.area_head)
        if row.sway_state >= 0:
            weights[row.sway_state] = row.sway_stiffness / (highest * row.area_head)
            weights[row.sway_state + 1] = 1.0 / row.stroke
    for line in plant.lines:
        highest = _highest(plant, plant.cylinders[line.cylinder])
        weights[state_of[line.node]] = 1.0 / highest
    weights[plant.at.supply] = 10.0 / float(plant.supply.pressure)
    return Pace(weights / CLOSE, 2 ** max(1, math.ceil(math.log2(tick / LEAST))))


def _highest(plant: Plant, row: Any) -> float:
    """Pressure [Pa] up to which a cylinder's chambers come."""
    relief = float(row.relief_pressure)
    return max(float(plant.supply.pressure), relief if math.isfinite(relief) else 0.0)


@part_kernel
def _valves_after(way, command, d, out):
    """Write the valves' states ``d`` [s] after ``way.y`` into ``out``; ``k[0]`` holds their
    rates."""
    plant, k = way.plant, way.k
    for v in range(plant.valves.shape[0]):
        valve, moves = plant.valves[v], False
        for e in range(valve.first, valve.first + valve.count):
            element = plant.elements[e]
            still = SETTLED * element.fastest * element.fastest
            for i in range(element.state, element.state + element.states):
                out[i] = way.y[i]
                moves = moves or abs(k[0, i]) > still
        if moves:
            valve_advance(valve, limited(command[v], valve), d, plant, out, k[OWN:])


@part_kernel
def reach(way, command, d):
    """Take a step of ``d`` [s]: its end to ``k[4]``, the derivatives there to ``k[5]``; the fastest
    rate."""
    y, k = way.y, way.k
    stages(y, command, way.plant, d, k, way.work)
    for i in range(y.shape[0]):
        k[4, i] = y[i] + d / 6.0 * (k[0, i] + 2.0 * (k[1, i] + k[2, i]) + k[3, i])
    _valves_after(way, command, d, k[4])
    return derivatives(k[4], command, way.plant, k[5], way.work)


@part_kernel
def attempt(way, command, d):
    """(error as a share of what it may be, fastest rate [1/s] at its end) of a step (`reach`)."""
    y, k = way.y, way.k
    rate, worst = reach(way, command, d), 0.0
    for i in range(y.shape[0]):
        miss = abs(k[3, i] - k[5, i]) * way.pace.weights[i]
        if not miss <= worst:  # nan is the worst
            worst = miss
    return 0.1 * d * worst, rate


@kernel
def _step(way, command, part, room, step, rate):
    """One step from ``part`` units of a tick on: (units taken, units to try next, rate [1/s] at its
    end). Its end stands in ``k[4]``, the derivatives there in ``k[5]``.

    Args:
        way: where it begins; ``k[0]`` holds the derivatives and ``rate`` goes with them.
        command: of the present tick [V].
        room: units that it may take at most.
        step: units to try first.
    """
    line, units, sure = way.line, way.pace.units, way.pace.sure
    unit, step = line.tick / units, min(step, room)
    if step > units:
        step = step // units * units  # whole ticks of several: a log has a row at the end of each
    while True:
        if line.past.shape[0] > 1:
            step = min(step, units // LATE)
            line_acting(line, command, way.plant, part * unit, step * unit)
            rate = derivatives(way.y, line.acting, way.plant, way.k[0], way.work)
        if step <= sure or rate * step * unit <= STABLE:
            error, after = attempt(way, line.acting, step * unit)
            if step <= sure or error <= 1.0:
                return step, 2 * step if error < 1.0 / 16.0 else step, after
        half = step // 2
        step = half if half < units else half // units * units  # whole ticks of several


@part_kernel
def arrive(way):
    """Begin where the step has ended."""
    put(way.k[4], way.y)
    put(way.k[5], way.k[0])


@kernel
def over_tick(way, command, rate):
    """Bring ``way.y`` over one tick; ``k[0]`` and ``rate`` hold what the derivatives give."""
    step, left, units = way.pace.units, way.pace.units, way.pace.units
    while left > 0:
        taken, step, rate = _step(way, command, units - left, left, step, rate)
        left -= taken
        arrive(way)


@part_kernel
def _same(item, other):
    for i in range(item.shape[0]):
        if item[i] != other[i]:
            return False
    return True


@part_kernel
def _finite(values):
    for i in range(values.shape[0]):
        if not math.isfinite(values[i]):
            return False
    return True


@part_kernel
def between(way, command, share, d, out):
    """State at a ``share`` of a step of ``d`` [s]: the cubic through both ends, valves exact."""
    y, k, rest = way.y, way.k, 1.0 - share
    first, last = (1.0 + 2.0 * share) * rest * rest, share * share * (3.0 - 2.0 * share)
    begin, end = d * share * rest * rest, -d * share * share * rest
    for i in range(y.shape[0]):
        out[i] = first * y[i] + last * k[4, i] + begin * k[0, i] + end * k[5, i]
    _valves_after(way, command, share * d, out)


@part_kernel
def _let(way, log, sample):
    """Write the flows in ``work`` into a row, as many as it has room for behind the state."""
    size, at = way.y.shape[0], way.plant.at.flow
    for i in range(log.shape[1] - size):
        log[sample, size + i] = way.work[at + i]


@part_kernel
def _add_means(way, log, each, sample, ends, ticks):
    """Add the samples of a step, its end among them, to the means of ``each``, one a row."""
    first, d, k = sample + 1, ticks * way.line.tick, way.k
    while first <= ends and first < each * log.shape[0]:
        row = first // each
        until = min(ends + 1, (row + 1) * each)
        # what both ends and their derivatives [s] count for in the mean
        begin, end, slope, last = 0.0, 0.0, 0.0, 0.0
        for s in range(first, until):
            rest = (ends - s) / ticks
            share = 1.0 - rest
            begin += (1.0 + 2.0 * share) * rest * rest
            end += share * share * (3.0 - 2.0 * share)
            slope += share * rest * rest
            last -= share * share * rest
        begin, end, slope, last = begin / each, end / each, d * slope / each, d * last / each
        for i in range(way.y.shape[0]):
            log[row, i] += begin * way.y[i] + end * k[4, i] + slope * k[0, i] + last * k[5, i]
        first = until


@part_kernel
def _write_samples(way, command, log, sample, ends, taken):
    """Write the samples within a step of ``taken`` units, with flows where the log has room."""
    d, size = taken * (way.line.tick / way.pace.units), way.y.shape[0]
    for s in range(sample + 1, ends):
        between(way, command, (s - sample) * way.pace.units / taken, d, log[s])
        if log.shape[1] > size:
            derivatives(log[s, :size], command, way.plant, way.k[1], way.work)
            _let(way, log, s)


@allocating_kernel
def run_paced(y, commands, plant, line, pace, mesh, each, log):
    """`ehbench.plant.integrate.run` in steps chosen by the guard, or those of a mesh; returns
    (the steps taken [units of a tick], their number).

    Args:
        mesh: steps to take again [units]; empty to choose. Where commands differ within one, it is
            taken in parts.
        each: samples of which a row of the log is the mean; more than one needs a log of zeros,
            and no flows.
        log: out; of shape (samples, states) it holds the state alone, for fewer evaluations.
    """
    size, last, follows = y.shape[0], commands.shape[0] - 1, mesh.shape[0] > 0
    k, work = np.empty((SCRATCH, size)), np.empty(plant.at.work)
    pace = Pace(pace.weights, pace.units, last * pace.units if follows else 1)
    way, late = Way(y, plant, line, pace, k, work), line.past.shape[0] > 1
    begin = 0 * last  # numba compiles what is called with the literal 0 once more for it
    sample, part, until, step, count = begin, begin, begin, pace.units, 0
    steps, there, ahead = np.empty(256, np.int64), 0, 0
    line_acting(line, commands[0], plant, 0.0, line.tick / LATE)
    rate = derivatives(y, line.acting, plant, k[0], work)
    for i in range(size):
        log[0, i] = y[i] / each
    _let(way, log, 0)
    while sample < last:
        while until < last and until < sample + (1 if late else MOST_TICKS * each):
            if until > sample and not _same(commands[until], commands[sample]):
                break
            until += 1
        room = pace.units - part if part > 0 else (until - sample) * pace.units
        if follows and ahead == 0:
            ahead, there = mesh[min(there, mesh.shape[0] - 1)], there + 1
        step = min(ahead, room) if follows else step
        taken, step, rate = _step(way, commands[sample], part, room, step, rate)
        ahead -= taken
        if count == steps.shape[0]:
            longer = np.empty(2 * count, np.int64)
            put(steps, longer)
            steps = longer
        steps[count] = taken
        ends = sample + (part + taken) // pace.units
        part, count = (part + taken) % pace.units, count + 1
        if part == 0 and each > 1:
            _add_means(way, log, each, sample, ends, taken / pace.units)
        elif part == 0:
            put(k[4], log[ends])
            _let(way, log, ends)
            _write_samples(way, line.acting, log, sample, ends, taken)
        arrive(way)
        if part == 0:
            if not _finite(y):
                log[ends // each :] = math.nan
                break
            line_push(line, commands[sample])
            if late or not _same(commands[ends], commands[sample]):
                line_acting(line, commands[ends], plant, 0.0, line.tick / LATE)
                rate = derivatives(y, line.acting, plant, k[0], work)
                _let(way, log, ends)
                step = min(step, pace.units)
        sample = ends
    return steps, count
