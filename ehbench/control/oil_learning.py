"""What a controller learns of its oil while it moves: how much softer it is than the design's;
derivation in docs/arc.md.

A flow that the motion does not take presses the oil: ``β0 (u − u_v) = θ4 dP_L/dt``, θ4 the design's
bulk modulus over the true one. Samples that are late and flows that are wrong look like other oil,
so both are found along with it."""

from __future__ import annotations

import numpy as np

from ehbench.compiled import kernel, record

SOFTER, LATER, MORE = range(3)  # what is found: θ4 − 1, lateness [s], share of the flow that lacks
FIRST = np.array([1.0, 0.01, 0.15])  # standard errors of them at the start
SCATTER = 0.02  # of the flow at the largest speed: what a comparison may be wrong by
CORNER = 1.0  # of k3: the low-pass, twice, behind which flows and pressures are compared
QUIET = 3.0  # over that corner: how long after a change of function nothing is learnt
FOLLOWS = 2.0  # of k1: the rate at which the law takes over what is found
MOST = 0.25  # share of the flow that may lack
SOFTEST = 2.5  # times as soft as the design, or as stiff: the most that the law takes
FORGETS = 30.0  # [s] over which what was found is doubted anew

OIL = record(
    ("bulk", "f8"),
    ("late", "f8"),
    ("pressed", "f8", (2,)),
    ("passed", "f8", (2,)),
    ("load", "f8", (2,)),
    ("quiet", "f8"),
    ("found", "f8", (3,)),
    ("sure", "f8", (3, 3)),
    ("softer", "f8"),
    ("more", "f8"),
)


@kernel
def begin_oil(load, bulk, memory):
    """Write the memory, a record of type OIL, of the first tick; ``load`` is the load force [N],
    ``bulk`` the design's bulk modulus [Pa].

    ``late`` is the flow behind the valve's lag; ``pressed``, ``passed`` [N/s] and ``load`` [N] are
    behind one low-pass and behind two; ``quiet`` [s] is for how long flows were. ``found`` are
    SOFTER, LATER and MORE, ``sure`` their covariance, ``softer`` what the law takes of the first.
    """
    memory.bulk = bulk
    memory.late = memory.quiet = memory.softer = memory.more = 0.0
    for i in range(2):
        memory.pressed[i] = memory.passed[i] = 0.0
        memory.load[i] = load
    for i in range(3):
        memory.found[i] = 0.0
        for j in range(3):
            memory.sure[i, j] = FIRST[i] * FIRST[i] if i == j else 0.0


@kernel
def pass_twice(held, value, slow):
    """Let a value go through two low-passes, in place."""
    held[0] += slow * (value - held[0])
    held[1] += slow * (held[0] - held[1])


@kernel
def learn_oil(quiet, given, moved, most, load, gains, memory):
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
        turn = corner * corner * (load - 2.0 * memory.load[0] + memory.load[1])
        doubt = (SCATTER * most) ** 2 / (corner * tick)
        correct_oil(memory.pressed[1] - rate, rate, turn, memory.passed[1], doubt, tick, memory)
    goal = min(max(memory.found[SOFTER], 1.0 / SOFTEST - 1.0), SOFTEST - 1.0)
    follows = min(FOLLOWS * gains.position_bandwidth * tick, 1.0)
    memory.softer += follows * (goal - memory.softer)
    lacks = min(max(memory.found[MORE], -MOST), MOST)
    memory.more += follows * (lacks / (1.0 - lacks) - memory.more)


@kernel
def correct_oil(lacking, rate, turn, passed, doubt, tick, memory):
    """One step of least squares: what is ``lacking`` [N/s] is SOFTER·``rate`` + LATER·``turn`` +
    MORE·``passed``, give or take the variance ``doubt``.
    """
    found, sure = memory.found, memory.sure
    for i in range(3):
        first = FIRST[i] * FIRST[i]
        sure[i, i] = min(sure[i, i] + tick / FORGETS * first, max(first, sure[i, i]))
    soft = sure[0, 0] * rate + sure[0, 1] * turn + sure[0, 2] * passed
    late = sure[1, 0] * rate + sure[1, 1] * turn + sure[1, 2] * passed
    more = sure[2, 0] * rate + sure[2, 1] * turn + sure[2, 2] * passed
    whole = doubt + rate * soft + turn * late + passed * more
    miss = lacking - found[SOFTER] * rate - found[LATER] * turn - found[MORE] * passed
    found[SOFTER] += soft / whole * miss
    found[LATER] += late / whole * miss
    found[MORE] += more / whole * miss
    sure[0, 0] -= soft * soft / whole
    sure[1, 1] -= late * late / whole
    sure[2, 2] -= more * more / whole
    sure[0, 1] -= soft * late / whole
    sure[0, 2] -= soft * more / whole
    sure[1, 2] -= late * more / whole
    sure[1, 0], sure[2, 0], sure[2, 1] = sure[0, 1], sure[0, 2], sure[1, 2]
