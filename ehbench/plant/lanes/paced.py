"""`ehbench.plant.paced` in lanes, bit for bit: plants of one layout side by side, each at a time of
its own, for each chooses its steps, or takes those of its own mesh, and follows its own commands.

What all do at once is the arithmetic of a step. Lanes that have arrived, or that have to shorten a
step first, pass it by with a step of no length."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ehbench.parts.valve.delay import late_between
from ehbench.plant.derivatives import any_derivatives
from ehbench.plant.integrate import STABLE
from ehbench.plant.lanes import vectors
from ehbench.plant.lanes.convert import of
from ehbench.plant.lanes.vectors import LANES
from ehbench.plant.paced import (
    LATE,
    MOST_TICKS,
    SCRATCH,
    Way,
    arrive,
    attempt,
    between,
    halved,
    weights_of,
)
from ehbench.runtime.compiled import allocating_kernel, part_kernel

_derivatives, _attempt = of(any_derivatives), of(attempt)
_between, _arrive = of(between), of(arrive)
_taken: Any = vectors.taken
_put: Any = vectors.put


class Track(NamedTuple):
    """What the lanes follow.

    ``commands`` [V], shape (rows, valves or more, LANES): a row whenever one changes, of plants
    with a delay one a sample; ``begins``, shape (rows + 1, LANES), the sample from which each acts,
    after the last the number of samples; ``meshes`` of steps [units], shape (steps, LANES), and how
    many ``given`` to each lane, none to choose; ``delays`` [s] and commands ``before`` [V], shape
    (valves, LANES), of no valves where none is late.
    """

    commands: np.ndarray
    begins: np.ndarray
    meshes: np.ndarray
    given: np.ndarray
    delays: np.ndarray
    before: np.ndarray


class Clocks(NamedTuple):
    """Where each lane is, of shape (LANES,): the ``sample`` that it has passed and the units since,
    ``part``; its ``last`` sample; the ``row`` of its commands; the units to try ``next``, and those
    on ``trial``, 0 before a step begins; what is left ``ahead`` of a step of its mesh, and how many
    of these it has ``begun``; how many steps it took, ``count``.
    """

    sample: np.ndarray
    part: np.ndarray
    last: np.ndarray
    row: np.ndarray
    next: np.ndarray
    trial: np.ndarray
    ahead: np.ndarray
    begun: np.ndarray
    count: np.ndarray


class Now(NamedTuple):
    """Of the present step, shape (1, LANES): its length ``d`` [s], 0 where none is taken; its
    ``error``; the fastest ``rate`` [1/s] at its start, and ``after`` it; a ``share`` of it; whether
    a lane is ``chosen``, above 0, for what is done to some alone.
    """

    d: np.ndarray
    error: np.ndarray
    rate: np.ndarray
    after: np.ndarray
    share: np.ndarray
    chosen: np.ndarray


@part_kernel
def _hold(lane, track, clocks, line):
    """Let a lane's plant feel its commands."""
    for i in range(track.commands.shape[1]):
        line.held[i, lane] = track.commands[clocks.row[lane], i, lane]


@part_kernel
def _feel(lane, track, clocks, line, unit):
    """`ehbench.parts.valve.delay.line_felt` for one lane over what it tries, the past commands read
    where they stand.
    """
    _hold(lane, track, clocks, line)
    sample = clocks.sample[lane]
    start, h = clocks.part[lane] * unit, clocks.trial[lane] * unit
    for i in range(track.delays.shape[0]):
        delay = track.delays[i, lane]
        if delay > 0.0:
            since = start - delay
            first = int(math.floor(since / line.tick))
            at, then = sample + min(first, 0), sample + min(first + 1, 0)
            late = track.commands[at, i, lane] if at >= 0 else track.before[i, lane]
            soon = track.commands[then, i, lane] if then >= 0 else track.before[i, lane]
            line.held[i, lane] = late_between(late, soon, since, first, h, line.tick)


@part_kernel
def _begin(lane, track, clocks, units, each):
    """What a lane tries first of a new step, in units."""
    sample, part, late = clocks.sample[lane], clocks.part[lane], track.delays.shape[0] > 0
    ends, maximum = track.begins[clocks.row[lane] + 1, lane], 1 if late else MOST_TICKS * each
    until = min(min(ends, clocks.last[lane]), sample + maximum)
    room = units - part if part > 0 else (until - sample) * units
    required, given = clocks.next[lane], track.given[lane]
    if given > 0:
        if clocks.ahead[lane] == 0:
            clocks.ahead[lane] = track.meshes[min(clocks.begun[lane], given - 1), lane]
            clocks.begun[lane] += 1
        required = clocks.ahead[lane]
    tried = min(required, room)
    return min(tried, units // LATE) if late else tried


@part_kernel
def _lengths(track, clocks, now, unit, units):
    """Write into ``d`` what lanes try, shortened first where it is too long for the rate at their
    start; where commands are late, what is too long is left to another time, for that rate changes.
    """
    late = track.delays.shape[0] > 0
    for lane in range(LANES):
        now.d[0, lane], step = 0.0, clocks.trial[lane]
        while step > 0:
            held_to = track.given[lane] > 0 or step == 1
            if held_to or now.rate[0, lane] * step * unit <= STABLE:
                now.d[0, lane] = step * unit
                break
            step = halved(step, units)
            clocks.trial[lane] = step
            if late:
                break


@part_kernel
def _judge(track, clocks, now, units):
    """Choose the lanes whose step stands; the others try a shorter one."""
    for lane in range(LANES):
        now.chosen[0, lane], step = 0.0, clocks.trial[lane]
        if now.d[0, lane] > 0.0:
            if track.given[lane] > 0 or step == 1 or now.error[0, lane] <= 1.0:
                now.chosen[0, lane] = 1.0
                now.rate[0, lane] = now.after[0, lane]
                clocks.next[lane] = 2 * step if now.error[0, lane] < 1.0 / 16.0 else step
            else:
                clocks.trial[lane] = halved(step, units)


@part_kernel
def _add_means(lane, way, log, each, sample, ends, ticks, d):
    """`ehbench.plant.paced`'s of the same name, of one lane."""
    first, k = sample + 1, way.k
    while first <= ends and first < each * log.shape[1]:
        row = first // each
        until = min(ends + 1, (row + 1) * each)
        begin, end, slope, last = weights_of(first, until, ends, ticks, d, each)
        for i in range(way.y.shape[0]):
            item, other = way.y[i, lane], k[4, i, lane]
            value = begin * item + end * other + slope * k[0, i, lane] + last * k[5, i, lane]
            log[lane, row, i] += value
        first = until


@part_kernel
def _write(way, clocks, now, log, each, row):
    """Write the samples, or their means, that the steps which stand have come to."""
    units, maximum = way.pace.units, 0
    for lane in range(LANES):
        part = clocks.part[lane] + clocks.trial[lane]
        if now.chosen[0, lane] > 0.0 and part % units == 0:
            sample = clocks.sample[lane]
            ends = sample + part // units
            if each > 1:
                ticks = clocks.trial[lane] / units
                _add_means(lane, way, log, each, sample, ends, ticks, ticks * way.line.tick)
            else:
                maximum = max(maximum, ends - sample - 1)
                for i in range(way.y.shape[0]):
                    log[lane, ends, i] = way.k[4, i, lane]
    for ahead in range(1, maximum + 1):
        for lane in range(LANES):
            within = now.chosen[0, lane] > 0.0 and ahead * units < clocks.trial[lane]
            now.share[0, lane] = ahead * units / clocks.trial[lane] if within else 1.0
        share = _taken(True, now.share, 0)
        _between(share < 1.0, way, way.line.held, share, _taken(True, now.d, 0), row)
        for lane in range(LANES):
            if now.share[0, lane] < 1.0:
                for i in range(way.y.shape[0]):
                    log[lane, clocks.sample[lane] + ahead, i] = row[i, lane]


@part_kernel
def _finite(y, lane):
    for i in range(y.shape[0]):
        if not math.isfinite(y[i, lane]):
            return False
    return True


@part_kernel
def _go_on(track, way, clocks, now, log, each, steps):
    """Let the lanes whose step stands be at its end; choose those whose commands change there, and
    whether there are any.
    """
    units, some, late = way.pace.units, False, track.delays.shape[0] > 0
    for lane in range(LANES):
        stands, now.chosen[0, lane] = now.chosen[0, lane] > 0.0, 0.0
        if stands:
            step, part = clocks.trial[lane], clocks.part[lane] + clocks.trial[lane]
            steps[lane, clocks.count[lane]] = step
            clocks.count[lane] += 1
            clocks.ahead[lane] -= step
            clocks.trial[lane] = 0
            clocks.sample[lane] += part // units
            clocks.part[lane] = part % units
            ends = clocks.sample[lane]
            if part % units == 0:
                if not _finite(way.y, lane):
                    log[lane, ends // each :] = math.nan
                    clocks.last[lane] = ends
                changes = ends == track.begins[clocks.row[lane] + 1, lane]
                if changes or late:
                    clocks.next[lane] = min(clocks.next[lane], units)
                if changes and ends < clocks.last[lane]:
                    clocks.row[lane] += 1
                    now.chosen[0, lane], some = 1.0, True
    return some


@part_kernel
def _try(track, clocks, way, each):
    """Choose what lanes try; whether any is under way."""
    units, some, late = way.pace.units, False, track.delays.shape[0] > 0
    for lane in range(LANES):
        if clocks.sample[lane] < clocks.last[lane]:
            some = True
            if clocks.trial[lane] == 0:
                clocks.trial[lane] = _begin(lane, track, clocks, units, each)
            if late:
                _feel(lane, track, clocks, way.line, way.line.tick / units)
    return some


@part_kernel
def _anew(track, clocks, now, way):
    """Let the chosen lanes feel their new commands, and find what the derivatives give."""
    for lane in range(LANES):
        if now.chosen[0, lane] > 0.0:
            _hold(lane, track, clocks, way.line)
    mask = _taken(True, now.chosen, 0) > 0.0
    rate = _derivatives(mask, way.y, way.line.held, way.plant, way.k[0], way.work)
    _put(mask, now.rate, 0, rate)


@part_kernel
def _step(track, clocks, now, way):
    """Take the steps on trial that are not too long; choose the lanes where they stand."""
    fixed, units = way.line.held, way.pace.units
    if track.delays.shape[0] > 0:
        rate = _derivatives(True, way.y, fixed, way.plant, way.k[0], way.work)
        _put(True, now.rate, 0, rate)
    _lengths(track, clocks, now, way.line.tick / units, units)
    error, after = _attempt(True, way, fixed, _taken(True, now.d, 0))
    _put(True, now.error, 0, error)
    _put(True, now.after, 0, after)
    _judge(track, clocks, now, units)


@allocating_kernel
def run_apart(y, track, plant, line, pace, each, log):
    """`ehbench.plant.paced.run_paced` in lanes, without flows; returns (the steps that each lane
    took [units of a tick], shape (LANES, room), their numbers).

    Args:
        y: states at the first sample, shape (states, LANES); in place.
        track: what the lanes follow.
        plant: in lanes (`ehbench.plant.lanes.pack`).
        line: its ``tick`` [s], and room for what plants feel, shape (valves or more, LANES).
        pace: weights by lane, shape (states, LANES).
        each: samples of which a row of the log is the mean; more than one needs a log of zeros.
        log: out, shape (LANES, samples, states).
    """
    size = y.shape[0]
    k, work = np.empty((SCRATCH, size, LANES)), np.empty((plant.at.work, LANES))
    way, row = Way(y, plant, line, pace, k, work), np.empty((size, LANES))
    at, result = np.zeros((9, LANES), np.int64), np.zeros((6, 1, LANES))
    clocks = Clocks(at[0], at[1], at[2], at[3], at[4], at[5], at[6], at[7], at[8])
    now = Now(result[0], result[1], result[2], result[3], result[4], result[5])
    steps = np.empty((LANES, 256), np.int64)
    for lane in range(LANES):
        clocks.last[lane], clocks.next[lane] = track.begins[-1, lane] - 1, pace.units
        now.chosen[0, lane] = 1.0
        for i in range(size):
            log[lane, 0, i] = y[i, lane] / each
    _anew(track, clocks, now, way)
    while _try(track, clocks, way, each):
        if clocks.count.max() == steps.shape[1]:
            more = np.empty((LANES, 2 * steps.shape[1]), np.int64)
            more[:, : steps.shape[1]] = steps
            steps = more
        _step(track, clocks, now, way)
        _write(way, clocks, now, log, each, row)
        _arrive(_taken(True, now.chosen, 0) > 0.0, way)
        if _go_on(track, way, clocks, now, log, each, steps) and track.delays.shape[0] == 0:
            _anew(track, clocks, now, way)
    return steps, clocks.count
