"""What a controller learns of its oil and its flows while it moves: how much softer the oil is than
the design's, how late flows are and what share of them is missing; derivation in
docs/explanation/arc.md.

A flow that the motion does not take presses the oil: ``β0 (u − u_v) = θ4 dP_L/dt``, θ4 the design's
bulk modulus over the true one. Late or wrong flows look like other oil, so all are estimated
together."""

import math
from dataclasses import dataclass

from ehbench.control.records import constants
from ehbench.runtime.compiled import kernel, record
from ehbench.vocabulary import setting

# the estimates: θ4 − 1, lateness [s], missing shares of the flow, extending and retracting
SOFTER, LATER, MORE, BACK = range(4)
UNKNOWNS = 4


@dataclass(frozen=True)
class OilLearningSettings:
    """Numbers of the estimator of oil and flows."""

    first: tuple = setting(
        (1.0, 0.01, 0.15, 0.15), "", "standard errors at the start, SI", "docs arc.md"
    )
    apart: float = setting(0.05, "", "difference of that between directions", "docs arc.md")
    scatter: float = setting(0.02, "", "error of a comparison, of the largest flow", "chosen")
    corner: float = setting(1.0, "k3", "low-pass of the comparison, used twice", "chosen")
    quiet: float = setting(3.0, "1/corner", "time after a change of function", "low-passes settle")
    rate: float = setting(2.0, "k1", "rate at which the law takes estimates over", "chosen")
    largest: float = setting(0.25, "", "missing share that the law takes at most", "docs arc.md")
    latest: float = setting(0.02, "s", "lateness that the law takes at most", "docs arc.md")
    softest: float = setting(2.5, "", "softness that the law takes at most", "air in the oil")
    memory: float = setting(30.0, "s", "time over which estimates become uncertain", "chosen")


OIL_LEARNING = constants(OilLearningSettings())

OIL = record(
    ("bulk", "f8"),
    ("payload", "f8"),
    ("late", "f8"),
    ("pressed", "f8", (2,)),
    ("passed", "f8", (2,)),
    ("load", "f8", (2,)),
    ("quiet", "f8"),
    ("estimates", "f8", (UNKNOWNS,)),
    ("covariance", "f8", (UNKNOWNS, UNKNOWNS)),
    ("regressors", "f8", (UNKNOWNS,)),
    ("part", "f8", (UNKNOWNS,)),
    ("softer", "f8"),
    ("later", "f8"),
    ("more", "f8", (2,)),
)


@kernel
def begin_oil(load, bulk, memory):
    """Write the memory, a record of type OIL, of the first tick; ``load`` is the load force [N],
    ``bulk`` the design's bulk modulus [Pa].

    ``late`` is the flow behind the valve's lag; ``pressed``, ``passed`` [N/s] and ``load`` [N] are
    behind one low-pass and behind two; ``quiet`` [s] is for how long flows were, ``payload`` [kg]
    what the estimates belong to. ``estimates`` are SOFTER, LATER, MORE and BACK with their
    ``covariance``, ``regressors`` and ``part`` work space; the law takes of them ``softer``,
    ``later`` [s] and ``more``, the share added to the required flow in extension and retraction."""
    memory.bulk = bulk
    memory.payload = math.nan
    memory.late = memory.quiet = memory.softer = memory.later = 0.0
    for i in range(2):
        memory.pressed[i] = memory.passed[i] = 0.0
        memory.load[i] = load
        memory.more[i] = 0.0
    for i in range(UNKNOWNS):
        memory.estimates[i] = 0.0
        for j in range(UNKNOWNS):
            memory.covariance[i, j] = OIL_LEARNING.first[i] ** 2 if i == j else 0.0
    both = OIL_LEARNING.first[MORE] ** 2 - OIL_LEARNING.apart**2
    memory.covariance[MORE, BACK] = memory.covariance[BACK, MORE] = both


@kernel
def restart_for(payload, other, memory):
    """Drop the estimates where the ``payload`` [kg] differs by more than ``other`` [kg], and learn
    nothing until the function changes or the motion ends."""
    if math.isnan(memory.payload):
        memory.payload = payload
    if abs(payload - memory.payload) > other:
        memory.payload, memory.quiet = payload, -math.inf
        for i in range(UNKNOWNS):
            memory.estimates[i] = 0.0


@kernel
def pass_twice(state, value, slow):
    """Let a value go through two low-passes, in place."""
    state[0] += slow * (value - state[0])
    state[1] += slow * (state[0] - state[1])


@kernel
def learn_oil(quiet, given, moved, maximum, load, gains, memory):
    """Move what is known of the oil, and what the law takes of it.

    Args:
        quiet: whether the required flows are those that pass.
        given: β0 times the relative change of volume required of the valves [N/s].
        moved: the same of what motion and leakages take.
        maximum: the same of the motion at the largest speed.
        load: the load force [N], as measured.
        gains: in force.
        memory: a record of type OIL.
    """
    tick, corner = gains.tick, OIL_LEARNING.corner * gains.force_bandwidth
    slow = tick * corner
    slow /= 1.0 + slow
    memory.late += tick / (tick + gains.valve_lead) * (given - memory.late)
    pass_twice(memory.pressed, memory.late - moved, slow)
    pass_twice(memory.passed, memory.late, slow)
    pass_twice(memory.load, load, slow)
    memory.quiet = memory.quiet + tick if quiet else 0.0
    if memory.quiet > OIL_LEARNING.quiet / corner:
        rate = corner * (memory.load[0] - memory.load[1])
        turn = corner * (memory.passed[0] - memory.passed[1])
        variance = (OIL_LEARNING.scatter * maximum) ** 2 / (corner * tick)
        correct_oil(memory.pressed[1] - rate, rate, turn, memory.passed[1], variance, tick, memory)
    take(min(OIL_LEARNING.rate * gains.position_bandwidth * tick, 1.0), memory)


@kernel
def take(part, memory):
    """Let the law take ``part`` of the difference to the estimates, leading by the design's lag at
    least."""
    result, softest = memory.estimates, OIL_LEARNING.softest
    softer = min(max(result[SOFTER], 1.0 / softest - 1.0), softest - 1.0)
    memory.softer += part * (softer - memory.softer)
    memory.later += part * (min(max(result[LATER], 0.0), OIL_LEARNING.latest) - memory.later)
    for way in range(2):
        lacks = lacking(1 if way == 0 else -1, memory)
        memory.more[way] += part * (lacks / (1.0 - lacks) - memory.more[way])


@kernel
def lacking(way, memory):
    """Missing share of the flow in a direction, ±1, that the law takes; negative for too much."""
    share, largest = memory.estimates[MORE if way > 0 else BACK], OIL_LEARNING.largest
    return min(max(share, -largest), largest)


@kernel
def credit_maps(added, memory):
    """Take from the missing share what corrected maps add, ``added`` [N/s] as β0 times a relative
    change of volume; the other direction follows."""
    passed = memory.passed[1]
    if passed != 0.0 and memory.quiet >= 0.0:
        way, other = (MORE, BACK) if passed > 0.0 else (BACK, MORE)
        share = min(max(added / passed, -OIL_LEARNING.apart), OIL_LEARNING.apart)
        memory.estimates[way] += share
        memory.estimates[other] += (
            share * memory.covariance[way, other] / memory.covariance[way, way]
        )


@kernel
def correct_oil(missing, rate, turn, passed, variance, tick, memory):
    """One step of least squares: ``missing`` [N/s] is SOFTER·``rate`` + LATER·``turn`` +
    MORE·``passed``, or BACK in retraction."""
    result, sure, moves, part = (
        memory.estimates,
        memory.covariance,
        memory.regressors,
        memory.part,
    )
    for i in range(UNKNOWNS):
        first = OIL_LEARNING.first[i] ** 2
        sure[i, i] = min(sure[i, i] + tick / OIL_LEARNING.memory * first, max(first, sure[i, i]))
    moves[SOFTER], moves[LATER] = rate, turn
    moves[MORE], moves[BACK] = max(passed, 0.0), min(passed, 0.0)
    whole, miss = variance, missing
    for i in range(UNKNOWNS):
        part[i] = 0.0
        for j in range(UNKNOWNS):
            part[i] += sure[i, j] * moves[j]
        whole += moves[i] * part[i]
        miss -= result[i] * moves[i]
    for i in range(UNKNOWNS):
        result[i] += part[i] / whole * miss
        for j in range(UNKNOWNS):
            sure[i, j] -= part[i] * part[j] / whole
