"""What a controller learns of its oil and its flows while it moves: how much softer the oil is than
the design's, how late flows are and what of them lacks; derivation in docs/arc.md.

A flow that the motion does not take presses the oil: ``β0 (u − u_v) = θ4 dP_L/dt``, θ4 the design's
bulk modulus over the true one. Flows that are late or wrong look like other oil, so all are found
together."""

from __future__ import annotations

import math

import numpy as np

from ehbench.runtime.compiled import kernel, record

# what is found: θ4 − 1, lateness [s], shares of the flow that lack, extending and retracting
SOFTER, LATER, MORE, BACK = range(4)
COUNT = 4
FIRST = np.array([1.0, 0.01, 0.15, 0.15])  # standard errors of them at the start
OWN = 0.05  # of these shares: what the two directions may differ by
SCATTER = 0.02  # of the flow at the largest speed: what a comparison may be wrong by
CORNER = 1.0  # of k3: the low-pass, twice, behind which flows and pressures are compared
QUIET = 3.0  # over that corner: how long after a change of function nothing is learnt
FOLLOWS = 2.0  # of k1: the rate at which the law takes over what is found
MOST = 0.25  # of the flow may lack, or be too much, for all that the law takes
LATEST = 0.02  # [s]: the most by which the law leads for lateness
SOFTEST = 2.5  # times as soft as the design, or as stiff: the most that the law takes
FORGETS = 30.0  # [s] over which what was found is doubted anew

OIL = record(
    ("bulk", "f8"),
    ("weighed", "f8"),
    ("late", "f8"),
    ("pressed", "f8", (2,)),
    ("passed", "f8", (2,)),
    ("load", "f8", (2,)),
    ("quiet", "f8"),
    ("found", "f8", (COUNT,)),
    ("sure", "f8", (COUNT, COUNT)),
    ("moves", "f8", (COUNT,)),
    ("part", "f8", (COUNT,)),
    ("softer", "f8"),
    ("later", "f8"),
    ("more", "f8", (2,)),
)


@kernel
def begin_oil(load, bulk, memory):
    """Write the memory, a record of type OIL, of the first tick; ``load`` is the load force [N],
    ``bulk`` the design's bulk modulus [Pa].

    ``late`` is the flow behind the valve's lag; ``pressed``, ``passed`` [N/s] and ``load`` [N] are
    behind one low-pass and behind two; ``quiet`` [s] is for how long flows were,
    ``weighed`` [kg] the payload that what is found belongs to. ``found`` are SOFTER, LATER, MORE
    and BACK, ``sure`` their covariance, ``moves`` and ``part`` room to work in; ``softer``,
    ``later`` [s] and ``more``, what is asked for beyond the flow that is wanted, as a share of it,
    in extension and retraction, are what the law takes of them."""
    memory.bulk = bulk
    memory.weighed = math.nan
    memory.late = memory.quiet = memory.softer = memory.later = 0.0
    for i in range(2):
        memory.pressed[i] = memory.passed[i] = 0.0
        memory.load[i] = load
        memory.more[i] = 0.0
    for i in range(COUNT):
        memory.found[i] = 0.0
        for j in range(COUNT):
            memory.sure[i, j] = FIRST[i] * FIRST[i] if i == j else 0.0
    both = FIRST[MORE] * FIRST[MORE] - OWN * OWN
    memory.sure[MORE, BACK] = memory.sure[BACK, MORE] = both


@kernel
def weigh_anew(payload, other, memory):
    """Drop what is found where another ``payload`` [kg] is on board, by more than ``other`` [kg],
    and learn nothing until the flows change their function or rest: the rest of such a motion leads
    back an error that tells little of the oil.
    """
    if math.isnan(memory.weighed):
        memory.weighed = payload
    if abs(payload - memory.weighed) > other:
        memory.weighed, memory.quiet = payload, -math.inf
        for i in range(COUNT):
            memory.found[i] = 0.0


@kernel
def pass_twice(held, value, slow):
    """Let a value go through two low-passes, in place."""
    held[0] += slow * (value - held[0])
    held[1] += slow * (held[0] - held[1])


@kernel
def learn_oil(quiet, given, moved, maximum, load, gains, memory):
    """Move what is known of the oil, and what the law takes of it.

    Args:
        quiet: whether the flows that are asked for are those that pass.
        given: β0 times the relative change of volume that the valves were asked for [N/s].
        moved: the same of what motion and leakages take.
        most: the same of the motion at the largest speed.
        load: the load force [N], as measured.
        gains: in force.
        memory: a record of type OIL.
    """
    tick, corner = gains.tick, CORNER * gains.force_bandwidth
    slow = tick * corner
    slow /= 1.0 + slow
    memory.late += tick / (tick + gains.valve_lead) * (given - memory.late)
    pass_twice(memory.pressed, memory.late - moved, slow)
    pass_twice(memory.passed, memory.late, slow)
    pass_twice(memory.load, load, slow)
    memory.quiet = memory.quiet + tick if quiet else 0.0
    if memory.quiet > QUIET / corner:
        rate = corner * (memory.load[0] - memory.load[1])
        turn = corner * (memory.passed[0] - memory.passed[1])
        doubt = (SCATTER * maximum) ** 2 / (corner * tick)
        correct_oil(memory.pressed[1] - rate, rate, turn, memory.passed[1], doubt, tick, memory)
    take(min(FOLLOWS * gains.position_bandwidth * tick, 1.0), memory)


@kernel
def take(part, memory):
    """Let the law take over ``part`` of what is found beyond what it has. It leads by no less than
    the design's lag: it would ask less of a load where it speeds up.
    """
    result = memory.found
    softer = min(max(result[SOFTER], 1.0 / SOFTEST - 1.0), SOFTEST - 1.0)
    memory.softer += part * (softer - memory.softer)
    memory.later += part * (min(max(result[LATER], 0.0), LATEST) - memory.later)
    for way in range(2):
        lacks = lacking(1 if way == 0 else -1, memory)
        memory.more[way] += part * (lacks / (1.0 - lacks) - memory.more[way])


@kernel
def lacking(way, memory):
    """Share of the flow that is found to lack in a direction, ±1, as far as the law counts on it;
    negative where there is too much.
    """
    return min(max(memory.found[MORE if way > 0 else BACK], -MOST), MOST)


@kernel
def told_already(mended, memory):
    """Take from the share that lacks what corrected maps make up for: by them the same commands
    pass ``mended`` [N/s] more, as β0 times a relative change of volume. What that share told of the
    other direction goes with it.
    """
    passed = memory.passed[1]
    if passed != 0.0 and memory.quiet >= 0.0:
        way, other = (MORE, BACK) if passed > 0.0 else (BACK, MORE)
        message = min(max(mended / passed, -OWN), OWN)
        memory.found[way] += message
        memory.found[other] += message * memory.sure[way, other] / memory.sure[way, way]


@kernel
def correct_oil(lacking, rate, turn, passed, doubt, tick, memory):
    """One step of least squares: what is ``lacking`` [N/s] is SOFTER·``rate`` + LATER·``turn`` +
    MORE·``passed``, or BACK in retraction, give or take the variance ``doubt``.
    """
    result, sure, moves, part = memory.found, memory.sure, memory.moves, memory.part
    for i in range(COUNT):
        first = FIRST[i] * FIRST[i]
        sure[i, i] = min(sure[i, i] + tick / FORGETS * first, max(first, sure[i, i]))
    moves[SOFTER], moves[LATER] = rate, turn
    moves[MORE], moves[BACK] = max(passed, 0.0), min(passed, 0.0)
    whole, miss = doubt, lacking
    for i in range(COUNT):
        part[i] = 0.0
        for j in range(COUNT):
            part[i] += sure[i, j] * moves[j]
        whole += moves[i] * part[i]
        miss -= result[i] * moves[i]
    for i in range(COUNT):
        result[i] += part[i] / whole * miss
        for j in range(COUNT):
            sure[i, j] -= part[i] * part[j] / whole
