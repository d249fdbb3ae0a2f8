"""Each number of controllers, their tuning and trials decides an outcome: as stated with it,
another with a third more or less."""

import math
import sys
from contextlib import suppress
from functools import cache
from inspect import unwrap
from types import SimpleNamespace as Stub
from typing import Any

import numpy as np
import pytest
from closed_loop import axis_of

from ehbench.control import (
    arc,
    arc_gains,
    functions,
    map_learning,
    monitor,
    oil_learning,
    pressure_feedback,
    sensor_checks,
)
from ehbench.control import position as position_law
from ehbench.control.arc_gains import pack_arc
from ehbench.control.law import DesignPoint
from ehbench.control.trajectory import pack_shaping
from ehbench.parts.sample import OF, entry
from ehbench.plant.model import Model
from ehbench.trial import checks, coordination, lever, limit_cycle, measures, path
from ehbench.tune import arc as arc_tune
from ehbench.tune import arc_loop, draws, gains, operating_point, search, stability
from tests.settings import OfKernels, answers, each, each_shows, first_call, refusal
from tests.shared import shipped

ANY: Any = Stub()
ARC, RULES = OfKernels(arc, "ARC"), OfKernels(functions, "FUNCTION")
MAPS, OIL = OfKernels(map_learning, "MAP_LEARNING"), OfKernels(oil_learning, "OIL_LEARNING")
MONITOR, SENSORS = OfKernels(monitor, "MONITOR"), OfKernels(sensor_checks, "SENSORS")
FED, POSITION = OfKernels(pressure_feedback, "DEFAULTS"), OfKernels(position_law, "POSITION")
GAINS, LOOP, MARGINS = arc_gains.ARC_GAINS, arc_loop.ARC_LOOP, stability.STABILITY
SWING = limit_cycle.LIMIT_CYCLE
RATES, SWINGS = [23.35, 66640000.0, 51560000.0, 6.533], [266.2, 219.4, 201.9, 200.3, 216.0]


# --- the adaptive robust controller


@cache
def slide():
    model = Model.of(shipped("slide_servo"))
    return model, axis_of(model, 0, None)


def gain(name="standby", payload=0.0, valve_lag=0.01, tick=1e-3, coarse=False, **given):
    """A default gain of the slide's controller."""
    model, axis = slide()
    supply = float(model.plant.supply.pressure)
    point = DesignPoint(axis, tick, supply, 1e-3, valve_lag, payload=payload)
    rules = functions.pack_rules(axis.circuit.area_rod, supply)
    given = given if coarse else {"stroke_resolution": 0.0, **given}
    return pack_arc(point, rules, given)[0][name]


def ratio(name, to, **given):
    """A default gain over another, or over what a function gives."""
    below = to() if callable(to) else gain(to, **given)
    return round(float(gain(name, **given)) / float(below), 6)


def highest_supply():
    """The supply's pressure [Pa]."""
    return slide()[0].plant.supply.pressure


def rates(**more):
    """Rates of adaptation, to four digits."""
    return [float(f"{rate:.4g}") for rate in gain("rate", **more)]


def place(swing, damping):
    return arc_gains._Place(ANY, 0.0, swing, damping)


def sum_of(swing, damping):
    """k1 + k2 + k3 for a load that swings at a frequency with a damping, after 10 ms."""
    point: Any = Stub(valve_lag=9e-3, tick=1e-3)
    return round(arc_gains._total(point, {}, [place(swing, damping)]), 3)


def packed_for(**parts):
    """The default gains of the slide's controller on an axis with other parts."""
    axis = slide()[1]._replace(**parts)
    point = DesignPoint(axis, 1e-3, 2e7, 1e-3, 0.01)
    return pack_arc(point, functions.pack_rules(axis.circuit.area_rod, 2e7), {})[0]


def overlap(onset):
    """The error of a deadband, of the range, where one is known of so much of it, or none."""
    axis = slide()[1]
    widest = float(np.abs(axis.circuit.highest).max())
    packed = packed_for(onset=np.full_like(axis.onset, onset * widest))
    return round(float(packed.deadband_error) / widest, 6)


def drop_corner():
    """The corner of the drop on a load-sensing pump, of the load's frequency."""
    circuit = slide()[1].circuit
    supply = circuit.supply.copy()
    supply.margin[:] = 1e6
    packed = packed_for(circuit=circuit._replace(supply=supply))
    return round(float(packed.drop_corner) / swing(), 6)


def swings():
    """The load's frequency at the strokes that are checked [rad/s]."""
    return [round(item.swing, 1) for item in arc_gains._places(slide()[1])[1:]]


def position(lag):
    """The bandwidth of position control by default, at a lag of the valve [s]."""
    point = DesignPoint(slide()[1], 1e-9, 2e7, 1e-3, lag)
    with answers(position_law, hydraulic_frequency=lambda _: 1e3,
                 reference_load=lambda _: (Stub(damping=0.0, mass=1e9), 0.0)):  # fmt: skip
        return round(position_law.default_bandwidth(point), 4)


def total(**more):
    """The sum of the bandwidths by default."""
    return sum(float(gain(f"{word}_bandwidth", **more)) for word in ("position", "speed", "force"))


def swing():
    """The lowest frequency of the load on its oil [rad/s]."""
    return min(place.swing for place in arc_gains._places(slide()[1]))


def heaviest():
    return round(float(gain("upper", payload=1e4)[1]), 1)


def payload_after(pull=1.0, ticks=200, bound=0.0, speed=0.0):
    """(payload, information, half of its interval [Mg]) after ticks of a force of 100 N at a pull,
    where disturbances have a bound, at a speed with a damping of 1 N·s/m."""
    state: Any = Stub(slow_force=0.0, slow_speed=0.0, slow_pull=0.0, estimates=np.ones(9))
    state.information = state.evidence = state.payload = state.scatter = state.half = 0.0
    load = Stub(mass=1.0, pull=pull, curve=0.0, damping=1.0)
    law: Any = Stub(position_bandwidth=10.0, tick=1e-3, upper=np.full(9, 1e9))
    law.upper[arc.DISTURBANCE] = bound
    axis: Any = Stub(cylinder=Stub(friction_coulomb=0.0, friction_viscous=0.0))
    for i in range(ticks):
        force: Any = Stub(phi_1=100.0 * pull)
        unwrap(arc.estimate_payload)(i == 0, force, load, 0.0, speed, axis, law, state)
    return round(state.payload, 9), round(state.information, 15), round(state.half / 1e6, 2)


def other_payload():
    """The change of a payload from which the oil is learnt anew, of the largest."""
    law = Stub(adapt_oil=1.0, adapt=1.0, tick=1e-3, speed_correction=1.0, upper=np.full(9, 100.0))
    memory: Any = Stub(gains=[law], state=Stub(half=0.0, payload=0.0, age=1.0), oil=None)
    oil: Any = Stub(bulk=1.0, head=1.0, rod=1.0, lost_head=0.0, lost_rod=0.0)
    axis: Any = Stub(circuit=Stub(area_head=1.0, area_rod=1.0))
    given: Any = (Stub(function=1, resting=False), Stub(head=0.0, rod=0.0), 0, 0.0, 0.0, oil, axis)
    work = lambda: unwrap(arc.estimate_bulk_modulus)(*given, memory)  # noqa: E731
    return first_call(arc, "restart_for", work)[1]


def drawn(age):
    """The share by which a calm load is drawn to the measured one, so long after a change."""
    state: Any = Stub(age=age, calm_load=0.0)
    law: Any = Stub(drop_corner=1.0, tick=1e-3)
    circuit: Any = Stub(area_head=1.0, area_rod=1.0)
    with answers(arc, load_force=1.0), suppress(AttributeError):
        unwrap(arc.opened_by)(False, ANY, 0.0, ANY, ANY, circuit, law, state)
    return round(state.calm_load, 6)


def chosen(z1=0.0, required=0.0, spool=0, resolution=0.0, **given):
    """(choice, the speed that it is for, state) of a standstill with a small speed of 10 mm/s."""
    state: Any = Stub(slow_load=0.0, function=0, slow_reference=0.0, standstill=0.0, v=0.0)
    state.slow_error = state.slow_required = state.age = 0.0
    state.way = state.turns = 0
    vars(state).update(given)
    law: Any = Stub(tick=1e-3, position_bandwidth=10.0, rules=Stub(speed_start=1.0))
    law.load_corner = law.speed_correction = 1.0
    law.speed_nudge, law.stroke_resolution, law.force_bandwidth = 1e-2, resolution, 1e9
    axis: Any = Stub(spool=[spool], circuit=None)
    asked, reference = [], Stub(v=0.0)
    with answers(arc, steady_reference=0.0, select=lambda *given: asked.append(given[2]) or (0, 0),
                 clip=lambda x, low, high: min(max(x, low), high)):  # fmt: skip
        choice = unwrap(arc.choose)(reference, z1, 0.0, required, ANY, axis, law, state)
    return choice, asked[0], state


def turned(required):
    """Whether a required speed so many times the smallest turns a spool at standstill round."""
    return chosen(0.0, 1e-2 * required, 1, way=-1)[2].turns


def rests(time=0.0, turns=0):
    """Whether the controller rests after standing still so many times 1/k1, or so many turns."""
    return chosen(standstill=0.1 * time, turns=turns)[0].resting


def shuts(counts):
    """Whether a spool shuts that is so many counts off, and that little oil is required of."""
    return chosen(1e-3 * counts, -1e-6, 1, 1e-3)[1] == 0.0


def restarts(off):
    """Whether an observer takes a stroke as it is that is so far off its own."""
    state: Any = Stub(acceleration=0.0, bias=0.0, x=0.0, v=0.0)
    return unwrap(arc.observe)(off, 0.0, Stub(observer_bandwidth=100.0, tick=1e-3), state)[0] == off


def load_ahead():
    """How far ahead a load is asked for, in s, at 1 m/s."""
    places, axis = [], ANY
    memory: Any = Stub(angles=None, work=None)
    with answers(arc, load_at=lambda _, q, *__: places.append(q) or Stub(lever=1.0)):
        unwrap(arc.loads_along)(np.zeros(4), 0.0, 1.0, 1.0, axis, memory)
    return places[1]


def raised(less):
    """By how much of the supply's pressure an off-side's goal is raised at most."""
    state: Any = Stub(raised=0.0)
    memory: Any = Stub(state=state, oil=None)
    choice: Any = Stub(function=1, spool=False, load=0.0)
    circuit: Any = Stub(area_head=1.0, area_rod=1.0, supply=[Stub(margin=0.0)])
    law: Any = Stub(flow_reserve=0.06, low_pressure=0.0)
    p: Any = Stub(supply=1.0, tank=0.0)
    flows = iter([1.0, 2.0])
    with answers(arc, METERING=[arc.SUPPLY_HEAD] * 9, supply_pressure=1.0, lacking=0.0,
                 carried=lambda *_: next(flows), RAISED=[False] * 9,
                 DIRECTION=[1] * 9):  # fmt: skip
        unwrap(arc.provide_headroom)(choice, (0.0, less), p, circuit, law, memory)
    return round(state.raised, 6)


def felt(margins):
    """Whether a pump of a margin feels a swing at a drop of so many margins."""
    state: Any = Stub(slow_drop=0.0, supply_swing=0.0)
    circuit: Any = Stub(supply=[Stub(margin=1.0, lag=0.0, pressure=9e9)])
    choice: Any = Stub(function=1, spool=True)
    p: Any = Stub(supply=margins, head=0.0, rod=0.0)
    law: Any = Stub(tick=1e-3)
    with answers(arc, supply_draw=1.0):
        unwrap(arc.calm_supply)(choice, 1.0, 1.0, 1.0, p, circuit, law, state)
    return bool(state.supply_swing)


# --- what controllers learn


def known_maps():
    """Standard errors of a gain and of two shifts at the start, the first of a known deadband."""
    maps: Any = Stub(chambers=np.zeros((2, 2)), trim=np.zeros((2, 2)), edges=np.zeros((2, 10)))
    law: Any = Stub(map_error=1.0, deadband_error=1.0)
    p: Any = Stub(head=0.0, rod=0.0)
    unwrap(map_learning.begin)(p, np.array([1.0, 0.0]), law, maps)
    sizes = np.sqrt(maps.edges[:, [map_learning.VAR_GAIN, map_learning.VAR_SHIFT]])
    return np.round(sizes, 6).tolist()


def map_share(changed=0.0, pressed=0.0, late=0.0, largest=1.0):
    """(variance, least flow) of a comparison whose flow changes by a share of the largest; by what
    presses the oil, or what the low-pass delays."""
    maps: Any = Stub(added=[0.0, 0.0], chambers=np.zeros((2, 9)))
    law: Any = Stub(tick=1e-3, position_bandwidth=10.0, speed_correction=largest, map_bandwidth=1.0)
    state: Any = Stub(v=late, p=Stub(head=pressed, rod=pressed))
    state.oil = Stub(bulk=1.0, head=1.0, rod=1.0, lost_head=0.0, lost_rod=0.0)
    given: Any = (state, ANY, ANY, Stub(circuit=Stub(area_head=1.0, area_rod=1.0)), law, maps)
    with answers(map_learning, follow=True, changed=changed, approach=None):
        work = lambda: unwrap(map_learning.learn_maps)(True, False, *given)  # noqa: E731
        _, _, variance, least, _ = first_call(map_learning, "correct", work)
    return float(f"{variance:.4g}"), least


def quiet_maps(time):
    """Whether flows that were quiet for so many 1/corner are compared."""
    maps: Any = Stub(clock=[time / 20.0 - 1e-3])
    circuit: Any = Stub(count=0)
    law: Any = Stub(tick=1e-3, valve_lead=0.0, position_bandwidth=10.0)
    axis: Any = Stub(circuit=circuit)
    return bool(unwrap(map_learning.follow)(True, ANY, ANY, axis, law, maps))


def oil_after(quiet=9.0, rows=1):
    """What least squares are asked for after flows were quiet for so many 1/corner: how often, and
    the variance of what is missing; the share that the law takes."""
    asked, taken = [], []
    memory: Any = Stub(late=0.0, pressed=[0.0, 0.0], passed=[0.0, 0.0], load=[0.0, 0.0])
    memory.quiet = quiet / 50.0 - 1e-3
    law: Any = Stub(tick=1e-3, force_bandwidth=50.0, valve_lead=0.0, position_bandwidth=10.0)
    with answers(oil_learning, pass_twice=None, correct_oil=lambda *given: asked.append(given[4]),
                 take=lambda part, _: taken.append(part)):  # fmt: skip
        unwrap(oil_learning.learn_oil)(True, 0.0, 0.0, 1.0, 0.0, law, memory)
    return [round(x, 9) for x in asked], round(taken[0], 9)


def lacks(share):
    memory: Any = Stub(estimates=np.full(4, share))
    return unwrap(oil_learning.lacking)(1, memory)


def credited(share):
    memory: Any = Stub(passed=[0.0, 1.0], quiet=0.0, estimates=np.zeros(4), covariance=np.eye(4))
    unwrap(oil_learning.credit_maps)(share, memory)
    return round(float(memory.estimates.sum()), 6)


def unsure_after():
    """The variances of estimates of the oil after a second that tells nothing, of the first."""
    memory: Any = Stub(estimates=np.zeros(4), covariance=np.zeros((4, 4)))
    memory.regressors, memory.part = np.zeros(4), np.zeros(4)
    unwrap(oil_learning.correct_oil)(0.0, 0.0, 0.0, 0.0, 1.0, 1.0, memory)
    return np.round(
        np.diag(memory.covariance) / np.square(oil_learning.OIL_LEARNING.first), 6
    ).tolist()


def taken(estimate):
    """(softness, lateness) that the law takes of the oil where both are estimated so."""
    memory: Any = Stub(estimates=np.full(9, estimate), softer=0.0, later=0.0, more=[0.0, 0.0])
    with answers(oil_learning, lacking=0.0):
        unwrap(oil_learning.take)(1.0, memory)
    return round(memory.softer, 3), round(memory.later, 6)


# --- the choice of a function, and pressure feedback


def filled(active, share):
    """Whether chambers at a share of the set-point are full enough for a function."""
    plan: Any = Stub(head=share, rod=1.0, tank=0.0)
    rules: Any = Stub(reserve=0.0, low_pressure=1.0, supply_margin=0.0, supply_band=0.0)
    with answers(functions, area_of=0.0):
        return unwrap(functions.carries)(1, active, 1.0, plan, ANY, rules)


def rule(name):
    return round(float(functions.pack_rules(1e-3, 2e7)[name]), 6)


def probe():
    """The drop at which edges of a path compare."""
    circuit: Any = Stub(edges=Row(np.zeros(1, int), np.ones(1, int)), maps=None)
    with answers(functions, preload=0.0):
        work = lambda: functions._serving(circuit, np.zeros(1, int), (0, 1), -1)  # noqa: E731
        return first_call(functions, "widest", work)[2]


def feedback(name):
    """A gain by default, times bulk modulus over volume for the off-side's."""
    model, axis = slide()
    point = DesignPoint(axis, 1e-3, 2e7, 1e-3, 0.01, 0.1)
    rules, shaping = functions.pack_rules(axis.circuit.area_rod, 2e7), pack_shaping()
    packed: Any = pressure_feedback.pack(point, {"feedback_gain": 1e-10}, rules, shaping)
    volume = max(pressure_feedback.chamber_oil(axis.cylinder, side, 0.1) for side in range(2))
    scale = axis.cylinder.bulk_modulus / volume if name == "off_gain" else 1.0
    return round(float(packed.gains[name]) * scale, 6)


# --- the monitor


def chamber(speed=0.0, flow=0.0):
    """The deviation of what passed a chamber of 1 m², of which a valve was to pass so much."""
    rows = np.zeros((1, monitor.COLUMNS))
    rows[0, monitor.HEAD] = flow
    memory: Any = Stub(chambers=np.full((2, 2), math.nan), tick=1e-3, rows=rows)
    cylinder = Stub(area_head=1.0, leakage_internal=0.0, leakage_head=0.0, bulk_modulus=1.0)
    axis: Any = Stub(cylinder=cylinder)
    p: Any = Stub(head=0.0, rod=0.0, tank=0.0)
    with answers(monitor, chamber_oil=0.0):
        _, variance = unwrap(monitor._chamber)(0, 0.0, p, 0.0, 0.1, axis, memory)
    return round(math.sqrt(variance), 6)


def shifted():
    """The opening by which a deadband may be off, of a range of 20 V."""
    asked = []
    memory: Any = Stub(
        tick=1e-3, lag=0.0, valves=np.zeros(1, int), rows=np.zeros((1, monitor.COLUMNS))
    )
    circuit: Any = Stub(highest=[10.0], lowest=[-10.0])
    with answers(monitor, _expected=lambda _, u, *__: asked.append(u) or (0.0, 0.0)):
        unwrap(monitor._follow)(ANY, [0.0], circuit, memory)
    return round(asked[1], 6)


def score(kind, beyond, rod=0.0):
    """What flows beyond the expected add to a score, of a valve that was to pass 1 into the head
    end."""
    row = np.ones(monitor.COLUMNS)
    row[[monitor.ROD, monitor.WIDE_ROD]] = 0.0
    return unwrap(monitor._gain)(kind, row, beyond, rod, 1.0)


def idle_score():
    return unwrap(monitor._gain)(monitor.SHUT, np.zeros(monitor.COLUMNS), 1.0, 0.0, 1.0)


def blamed(height):
    """Whether a score of a stroke is a fault."""
    scores = np.zeros(sensor_checks.RESIDUALS)
    scores[sensor_checks.STROKE] = height
    sensors: Any = Stub(scores=scores, doubts=np.zeros(2))
    return unwrap(sensor_checks._blamed)(0, 1, True, sensors) >= 0


def passed_low():
    """What is left of 1 that came and goes, after a tick of 1 ms."""
    sensors: Any = Stub(low=np.ones(9), tick=1e-3)
    return round(float(unwrap(sensor_checks._low_pass)(0.0, 0, sensors)[0]), 6)


def checked(x=0.5, others=0.0, turned=0.0):
    """(deviations of a stroke, a force and the supply, whether a load is weighed, whether the
    stroke moves as the angle) at a stroke of 1 m, others at a speed and a joint that turns."""
    seen: dict = {}
    sample = np.zeros(200)
    sample[[entry(0, OF.x), entry(1, OF.v), entry(0, OF.qd)]] = x, others, turned
    sensors: Any = Stub(speed=np.zeros(2), tick=1e-3, steady=True, jumped=np.zeros(2))
    sensors.lines = np.zeros(2)
    cylinder = Stub(stroke=1.0, area_head=1.0)
    circuit = Stub(number=0, cylinder=0, supply=[Stub(pressure=1.0)])
    axis: Any = Stub(circuit=circuit, cylinder=cylinder)
    with answers(sensor_checks, linkage_of=(0.0, 1.0, 0.0), _doubt=None, _load=(7.0, 0.0, 1.0, 0.0),
                 _still=0.0, pressures=None, _low_pass=(0.0, 0.0), cylinders_in=2,
                 _score=lambda k, *given: seen.update({k: given}),
                 _blamed=lambda *given: given[2]):  # fmt: skip
        moved = unwrap(sensor_checks.wrong_sensor)(sample, 0.0, 0.0, True, axis, sensors)
    which = (sensor_checks.STROKE, sensor_checks.STUCK_HEAD, sensor_checks.SUPPLY)
    sizes = [seen[k][1] for k in which]
    return np.round(np.sqrt(sizes), 6).tolist(), seen[sensor_checks.LOAD][0] == 7.0, bool(moved)


def stayed(row, pressure, demand, bulk):
    """(what has changed since a head end's pressure stays, by how much it jumped), remembered in
    ``row``, in oil of a bulk modulus."""
    sensors: Any = Stub(still=[row], jumped=[0.0], tick=1e-3)
    axis: Any = Stub(cylinder=Stub(area_rod=1.0, area_head=1.0, bulk_modulus=bulk))
    axis.circuit = Stub(supply=[Stub(flow_limit=0.5, pressure=2e7)])
    p: Any = Stub(head=pressure, rod=0.0)
    with answers(sensor_checks, chamber_oil=1.0):
        changed = unwrap(sensor_checks._still)(0, p, 0.1, demand, axis, sensors)
    return changed, sensors.jumped[0]


def jumped(rise):
    """By how much a pressure that rises by so much in a tick has jumped; twice the supply's flow
    makes it rise by 1."""
    return round(stayed([0.0, 0.0, 0.0, 1e-3, 0.0], rise, 0.0, 1e3)[1], 6)


def unexplained():
    """How much more what a valve leaves unexplained counts than what it explains."""
    idle = score(monitor.SHUT, -1.0)
    return round(2.0 * (idle - score(monitor.SHUT, -1.0, 1.0)), 6)


def weighed(force=0.0, payload=0.0, damping=0.0, ticks=1, pull=1.0):
    """(what a load is beyond all payloads, its deviation, the payload that is remembered after so
    many ticks) for a force beyond a load of 1 N/kg."""
    sensors: Any = Stub(speed=[0.0, 0.0], payload=payload, tick=1e-3, carried=[0.0], work=None)
    sensors.angles = None
    load: Any = Stub(damping=damping, mass=0.0, curve=0.0, gravity=0.0, pull=pull, lever=1.0)
    cylinder = Stub(area_head=1.0, area_rod=1.0, friction_viscous=0.0, friction_coulomb=0.0)
    axis: Any = Stub(cylinder=cylinder, circuit=Stub(cylinder=0, supply=[Stub(pressure=1.0)]))
    with answers(sensor_checks, place_joints=None, inertias=(1.0, 0.0), load_at=load,
                 pressures=None, load_force=0.0, _low_pass=(force, 0.0)):  # fmt: skip
        for _ in range(ticks):
            e, _, unsure, _ = unwrap(sensor_checks._load)(np.zeros(9), 1.0, axis, sensors)
    return round(e, 6), round(math.sqrt(unsure), 6), round(sensors.carried[0], 3)


def doubt_left():
    """What is left after a second of what tells two pressures apart."""
    sensors: Any = Stub(doubts=np.ones(2), tick=0.1)
    axis: Any = Stub(cylinder=Stub(area_head=1.0, area_rod=1.0))
    unwrap(sensor_checks._doubt)(0.0, 0.0, axis, sensors)
    return round(float(sensors.doubts[0]), 6)


# --- checks of sensors


def stands(seconds, before=1.0):
    """Whether a pressure is doubted that stays so long, where one stayed so long before."""
    return stayed([1e7, 0.0, 0.0, seconds - 1e-3, before], 1e7, 1e3, 1e9)[0] > 0.0


# --- tuning


def law_search():
    """The search for a law on a load that swings at 10 rad/s and has a volume of 1 l."""
    point = Stub(function="extend_resistive", volume_head=1e-3)
    motion = Stub(point=point, loop=lambda _: Stub(off=np.ones(1)))
    recipe: Any = Stub(delay=0.0, damping_ratio=0.5, washout=None, ramp_washout=None, off_gain=None)
    with answers(search, swing=lambda _: 10.0, _stiffness=lambda _: (1e8, 1e8)):
        motions: Any = [motion]
        return search.LawSearch(motions, recipe, {})


def shares():
    """Off-side gains that are tried, of the natural one."""
    built = law_search()
    return [round(off / math.sqrt(built.grid[1] * built.grid[-1]), 4) for off in built.offs]


def budgets():
    """How many budgets are tried where the first half of them keeps the demands."""
    tried = []
    of: Any = Stub(candidate=lambda budget: tried.append(budget) or Stub(met=budget < 0.3))
    with answers(arc_tune, Search=lambda _: of, _result=None):
        arc_tune.tune_arc(ANY)
    # pyrefly: ignore[bad-specialization]
    return len(tried), round(min(tried), 3), round(max(tried), 3)


def loop_of(a):
    """A sampled loop whose plant has poles of a frequency [rad/s] and damping."""
    tick, n = 1e-3, len(a)
    one = arc_loop.Sampled(
        np.diag(np.exp(np.array(a) * tick)), np.ones((n, 1)), np.ones((1, n)), np.zeros((1, 1))
    )
    law = arc_loop.Sampled(
        np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)), np.full((1, 1), 1e-9)
    )
    return arc_loop.ArcLoop(one, law, tick, np.zeros(1, bool))


def frequencies(damping):
    """(how many frequencies a loop is looked at whose one mode at 100 rad/s has a damping ratio,
    the least, the widest reach about the mode)."""
    mode = 100.0 * (-damping + 1j * math.sqrt(1.0 - damping**2))
    omega, _ = loop_of([mode]).loci(arc_loop.Sensing())
    return omega.size, round(float(omega[0]), 3)


def reach():
    """How far about a mode of 100 rad/s and 0.1 % damping frequencies reach, in half-widths."""
    mode = 100.0 * (-1e-3 + 1j)
    with answers(np, geomspace=lambda *_: np.array([5.0])):
        omega, _ = loop_of([mode]).loci(arc_loop.Sensing())
    return round(float(omega[-1] - 100.0) / 0.1, 1), omega.size


def slowest(omega):
    """Growth of a loop whose growing pole swings at a frequency [rad/s]."""
    poles = np.array([1.0 + 1j * omega, -1.0 + 100j])
    loop = loop_of([-1.0])
    with answers(arc_loop.ArcLoop, poles=lambda *_: poles):
        return loop.growth(arc_loop.Sensing())


def stated():
    """A delay margin of 3 s as it is stated."""
    return arc_loop.LoopMargins(0.0, 0.0, 3.0, 0.0).stated


def swings_as_it_is(growth):
    """Whether a loop swings as it is that grows by so much [1/s]."""
    with answers(arc_loop.ArcLoop, growth=lambda *_: growth):
        return loop_of([-1.0]).margins(arc_loop.Sensing()).gain == 0.0


def crossed(real=0.0, delay=0.0, of=np.ones_like):
    """(frequencies looked at first, the least and the largest, crossings) for an eigenvalue at
    100 rad/s off the axis by a share of it, or a delay alone; the level by frequency."""
    seen = []
    level: Any = lambda reply: seen.append(reply) or of(reply)  # noqa: E731
    loop = stability.OpenLoop(np.zeros((1, 1)), np.ones(1), np.ones(1), delay)
    poles = np.array([100.0 * real + 100j] if not delay else [])
    with answers(stability.OpenLoop, response=lambda _, omega: omega):
        found = stability._crossings(loop, poles, level)
    ends = (round(float(seen[0].min()), 6), round(float(seen[0].max()), 6)) if seen[0].size else ()
    return seen[0].size, ends, found.size


def jumps(size):
    """How many crossings there are where a level goes from one side to the other by twice this."""
    return crossed(of=lambda omega: np.where(omega > 100.1, size, -size) * omega)[2]


def calm(growth):
    """Whether a pole that grows so much of the largest entry [1] is none."""
    loop = stability.OpenLoop(np.diag([growth, -1.0]), np.zeros(2), np.zeros(2))
    return loop.growth() <= 0.0


def standstill():
    """The frequency of standstill, of the fastest pole's."""
    loop = stability.OpenLoop(np.diag([-5.0, -1.0]), np.ones(2), np.ones(2))
    with answers(stability, _crossings=lambda *_: np.zeros(0)):
        call = first_call(stability.OpenLoop, "response", lambda: stability.gain_margin(loop))
    return round(float(call[1][0]) / 5.0, 12)


# --- trials


def shifts_tried():
    """Shifts of a deadband that are tried against the true one: first, last and count."""
    seen = []
    design: Any = Stub(circuit=Stub(edges=[Stub(sign=1.0)], first=0, maps=None))
    use = np.zeros(1), np.ones(1)
    with answers(measures, edge_flows=lambda _, at, *__: seen.append(float(-at[0]))):
        measures._true_correction(design, 0, use, np.ones(1), (1.0, 0.0))
    return min(seen), max(seen), len(seen)


def coarse_swing(counts, stroke=1.0):
    """Whether a swing is a limit cycle that has so many counts of 1 mm."""
    t = np.arange(4000) * 1e-3
    y = 1e-3 * np.round(counts * np.sin(8.0 * np.pi * t))
    return limit_cycle.limit_cycle(t, y, 0.0 * t, np.sin(t)[:, None], stroke) is not None


def bounds(name):
    """A bound of the strokes that a recipe leaves to its default, of them."""
    limits: Any = Stub(following_error="auto", position_mismatch="auto")
    cylinders: Any = {"stroke": np.ones(1)}
    built = checks.checks_of(limits, np.ones(1, bool), cylinders, 1)
    return float(getattr(built, name)[0])


def highest():
    """The largest pressure that a sensor may show by default, of the rig's highest."""
    rig = shipped("slide_servo")
    top = [float(rig.supply.pressure), *(float(c.relief_pressure or 0.0) for c in rig.cylinder)]
    asked: Any = Stub(pressure_range="auto")
    row = checks.LIMITS.index("pressure_range")
    return round(float(checks.limit_array(asked, rig, 1e-3)[row]) / max(top), 6)


def oldest(tick):
    """The age [ms] that a sample may have by default, and the time that a controller may take."""
    asked: Any = Stub(sample_age="auto", overrun="auto", pressure_range=1.0)
    limits = checks.limit_array(asked, shipped("slide_servo"), tick)
    age, overrun = (float(limits[checks.LIMITS.index(n)]) for n in ("sample_age", "overrun"))
    assert age == overrun
    return round(1e3 * age, 6)


def postures(length, off=0.0):
    """Postures of a line of so many metres, each time that they are doubled, its refusal, and how
    many follow one another before."""
    counts, before = [], []

    def polished(_, line, *__):
        counts.append(len(line))
        return np.arange(len(line))[:, None] % 2.0, np.zeros(len(line))

    mover: Any = Stub(between=lambda point, q, index: before.append(1) or q, strokes=lambda q: q)
    mover.recipe, mover.motion = Stub(at=lambda *_: {}), Stub(where=())
    mover.chain, mover.free = Stub(low=np.zeros(1), high=np.ones(1)), [True]
    mover.model = Stub(rig=Stub(shown=lambda *_: ""))
    ends: Any = np.array([[0.0, 0.0, 0.0], [length, 0.0, 0.0]])
    with answers(path, polish=polished, _tip_slope=lambda _, q: np.full((len(q), 1), off)):
        refused = refusal(lambda: path.Mover.leg(mover, ends, np.zeros(1), 1))
    return counts, refused, len(before)


def tried():
    """How many postures are tried for a point that none of seven joints reaches."""
    count = []
    nowhere: Any = Stub(there=False, miss=1.0)
    model = Stub(posture=lambda _: np.zeros(7))
    chain = Stub(low=np.zeros(7), high=np.ones(7))
    mover: Any = Stub(model=model, recipe=Stub(posture=None), chain=chain, free=[True] * 7)
    with answers(path, reach=lambda *_: count.append(1) or nowhere):
        path.Mover.first(mover, np.zeros(3))
    return len(count)


def drawn_for():
    """Over how many of fifty operating points draws are judged."""
    points = [Stub(counts=True, damping_ratio_closed=0.1) for _ in range(50)]
    study: Any = Stub(recipe=Stub(draws=1, seed=1, damping_ratio=0.5), rig=Stub())
    study.rig.with_values, study.motions = lambda _: None, points
    seen: Any = points
    with answers(draws, uncertain=lambda _: ("a",), draw_parameters=lambda *_: np.zeros((1, 1)),
                 _worst_of_draw=1.0):  # fmt: skip
        return draws.robustness(study, seen, ANY, {}, None, lambda _: None).points


def openings(flows=(1.0,) * 9, commands=(10.0,) * 9):
    """The openings that are compared, of an edge that opens from 1 V to 10 V: ends, count."""
    size = len(flows)
    record = {"e.flow_desired": np.array(flows), "v.command": np.array(commands)}
    record |= {"p_supply": np.full(size, 2e7), "c.p_head": np.zeros(size)}
    design: Any = Stub(edges=("e",), valves=("v",), cylinder="c")
    design.circuit = Stub(edges=[Stub(sign=1.0, valve=0)], first=0, maps=None)
    design.rig = Stub(all_edges=lambda: {"e": Stub(from_="supply", to="head")})
    with answers(measures, edge_onset=1.0):
        use = measures._use(design, 0, record, size)
    assert use is not None
    return np.round(use[0][[0, -1]], 3).tolist(), use[0].size


def used(share):
    """Whether an opening counts that was to pass so much of the largest flow."""
    return openings((1.0, share), (2.0, 9.0))[0][1] > 5.0


def often(turns):
    """Whether a swing of 100 periods is the reference's, which turns round so often."""
    t = np.linspace(0.0, 1.0, 4001)
    desired = np.abs((t * (turns + 1)) % 2.0 - 1.0)
    result: Any = Stub(duration=100.0, period=1.0, amplitude=1e9)
    with answers(limit_cycle.np, hanning=lambda n: np.zeros(n)), suppress(AttributeError):
        return bool(limit_cycle._follows_reference(t, desired, result))
    return False


class Row:
    """Edges from and to some nodes, of which each is one."""

    def __init__(self, from_node, to_node):
        self.from_node, self.to_node, self.blocked = from_node, to_node, np.zeros(1)

    def __getitem__(self, _):
        return None


def slope_of_map(wide):
    """What an edge passes a volt that passes 1 where it is open so many volts."""
    maps: Any = Stub(edges=np.zeros((1, 20)), trim=np.zeros((1, 2)), clock=[0.0])
    edges = [Stub(valve=0, sign=1.0)]
    axis: Any = Stub(circuit=Stub(count=1, first=0, edges=edges, play=[0.0]), onset=[0.0])
    law: Any = Stub(tick=1e-3, valve_lead=0.0, position_bandwidth=10.0)
    unwrap(map_learning.follow)(True, [1.0, 0.0], [wide], axis, law, maps)
    return round(float(maps.edges[0, map_learning.LATE_SLOPE]), 6)


def unsure_at_first():
    """Standard errors of the oil's estimates at the start."""
    memory: Any = Stub(covariance=np.zeros((4, 4)), estimates=np.zeros(4))
    memory.pressed, memory.passed, memory.load, memory.more = np.zeros((4, 2))
    unwrap(oil_learning.begin_oil)(0.0, 1.0, memory)
    return np.round(np.sqrt(np.diag(memory.covariance)), 6).tolist()


def supplied(share):
    """Whether the supply's pressure counts where so much of its flow is drawn."""
    rows, zeros = np.zeros((1, monitor.COLUMNS)), np.zeros(1)
    rows[0, monitor.HEAD] = share
    axis: Any = Stub(circuit=Stub(cylinder=0, supply=[Stub(flow_limit=1.0)], able=zeros))
    memory: Any = Stub(rows=rows, tick=1e-3, valves=zeros[1:], scores=zeros[1:], fault=zeros)
    memory.sensors = Stub(scores=zeros)
    with answers(monitor, pressures=None, entry=0, _chamber=(0.0, 0.0)):
        work = lambda: unwrap(monitor.watch)([0.0], [0.0], axis, memory)  # noqa: E731
        return first_call(monitor, "wrong_sensor", work)[3]


def estimate_step():
    """The step of an estimate by which a loop is linearised, of the width of its bounds."""
    law: Any = Stub(upper=np.full(4, 3.0), lower=np.ones(4))
    at: Any = Stub(point=Stub(x=0.0, v=0.0), sample=np.zeros(1), model=None)
    design: Any = Stub(axis=Stub(circuit=Stub(count=1)))
    with answers(arc_loop, steady_memory=None, _words=["x"]), answers(arc_loop.arc, memory_of=None,
                 observed=np.ones(1)):  # fmt: skip
        return round(float(arc_loop._LawTick(at, design, law).sizes[-1] / 2.0), 9)


def off_bounds():
    """How far inside its bounds an estimate stays that begins at one."""
    model, axis = slide()
    law: Any = Stub(lower=np.zeros(4), upper=np.ones(4), start=np.ones(4), low_pressure=0.0)
    point: Any = Stub(function="extend_resistive", p_tank=0.0, load_force=0.0, paths=())
    point.x = point.v = point.gravity_force = 0.0
    point.q, point.mass = np.zeros(model.plant.links.mass.size), 1.0
    design: Any = Stub(axis=axis, tick=1e-3)
    state = arc_loop.steady_memory(model, point, design, law)
    return round(1.0 - float(state.estimates[arc.INVERSE_BULK]), 9)


def push_step():
    """The slope of a cube at standstill by central differences, in small speeds."""
    motion: Any = Stub(push=lambda v: (v / operating_point.COULOMB_SPEED) ** 3)
    slope = operating_point._Motion.push_slope(motion, 0.0)
    return round(math.sqrt(slope * operating_point.COULOMB_SPEED), 12)


def top_speed():
    """The largest speed that is found where 0.3 of the most is possible."""
    motion: Any = Stub(function=1, settle=lambda _: Stub(p_head=0.0, p_rod=0.0), circuit=None)
    motion.at_ports, motion.impossible = lambda *_: None, lambda v: abs(v) > 0.3
    motion.railed = lambda _: False
    with answers(operating_point, top_speed=1.0, pump_speed=math.inf):
        return round(operating_point._Motion.largest_speed(motion), 9)


def drawn_points():
    """(gains of a root locus, samples of a step response)."""
    library: Any = Stub(root_locus_map=max, step_response=max)
    motion: Any = Stub(loop=lambda _: Stub(a=np.eye(1), b=np.ones(1), c=np.ones(1)))
    law: Any = Stub(without_feedback=lambda: None)
    seen: Any = Stub(natural_frequency_open=1.0)
    with pytest.MonkeyPatch.context() as patch, answers(gains, system_of=None, speed_of=None):
        patch.setitem(sys.modules, "control", library)
        locus = lambda: gains.locus(motion, law, 1.0, "feedback_gain", math.inf)  # noqa: E731
        steps = lambda: gains.step_response(motion, law, seen, 1.0)  # noqa: E731
        curves = (("root_locus_map", locus), ("step_response", steps))
        return [len(first_call(library, name, work)[1]) for name, work in curves]


def kept_of_a_step():
    """What is left of a step 30 ms after it, by each window."""
    t, left = np.arange(4000) * 1e-3, []
    y = np.where(t < 2.0, 0.0, 1.0)
    with answers(limit_cycle, _zigzag=lambda fast, *_: left.append(fast[2030]) or 0):
        limit_cycle.limit_cycle(t, y, 0.0 * t, np.sin(t)[:, None], 1.0)
    return np.round(left, 3).tolist()


def uneven(share):
    """Whether a swing of six periods is a limit cycle of which one is longer by a share."""
    turns = np.concatenate([[0.0], np.cumsum(np.where(np.arange(12) // 2 == 2, 1.0 + share, 1.0))])
    return any(limit_cycle._lasting(turns, np.arange(13), np.arange(13) % 2.0))


def flow_kept():
    """What several cylinders may take of the pump's flow."""
    plant = Stub(supply=Stub(flow_limit=1.0, pressure=1.0), tank_pressure=0.0, kind=0, gravity=0.0)
    plant.cylinders, plant.links, plant.forces = Stub(joint=None), None, None
    item: Any = Stub(design=Stub(model=Stub(plant=plant), q=None), recipe=Stub(rate=1.0))
    item.design.row, item.design.circuit, zeros = Stub(joint=0), None, np.zeros((1, 4))
    item.references = Stub(table=zeros)
    with answers(coordination, joints_of=(zeros, None), torques=zeros, axis_of=None,
                 required_flow=np.zeros(1)):  # fmt: skip
        work = lambda: coordination.planned([item], [ANY], 0.0, True)  # noqa: E731
        return round(first_call(coordination, "pace_of", work)[1], 9)


def slow_ticks():
    """How long a motion counts as slowed down [s], of ticks of a second at nearly its pace."""
    plan: Any = Stub(limit=1.0, longer=0.0, required=np.ones(2), pace=np.array([0.9985, 0.9995]))
    log: Any = {"t": np.arange(2.0), "tip_error": np.zeros(2), "tip_across": np.zeros(2)}
    record: Any = type("Log", (dict,), {"t": np.arange(2.0)})(log)
    return coordination.Plan.measures(plan, record, 2)["sharing"]["slowed"]


def kept_stroke():
    """The stroke that a lever leaves at an end, of 1 m."""
    recipe: Any = Stub(rate=1.0, limits=Stub(stroke_margin=None), duration=1.0)
    recipe.at = lambda _: {}
    motion: Any = Stub(dead_zone=0.0, axis="", file=None)
    design: Any = Stub(row=Stub(stroke=1.0), x=0.5)
    limits = {"speed": 1.0, "acceleration": 1.0}
    return lever.commanded(recipe, motion, design, limits)[1].low


def known_before():
    """For how long [s] the adaptive controller knows a speed before it is asked for."""
    table = np.zeros((500, 4))
    table[400:, 1] = 1.0
    item: Any = Stub(recipe=Stub(rate=1e3), references=Stub(lever=None, table=table))
    with answers(coordination, controller_of=Stub(kind="arc")):
        (wide,) = coordination.tables_of([item])
    return round(4e-1 - 1e-3 * int(np.argmax(wide[:, -1] > 0.0)), 6)


ROWS = [
    (GAINS, "spare", heaviest, 11500.0),
    *each(GAINS, "budget undamped", lambda: round(0.011 * total(), 6), 0.1092),
    (GAINS, "faster", lambda: ratio("bandwidth_limit", swing), 3.9),
    (GAINS, "observer", lambda: ratio("observer_bandwidth", total), 6.0),
    (GAINS, "fastest_observer", lambda: float(gain("observer_bandwidth", valve_lag=0.0)), 500.0),
    (GAINS, "slowest_observer",
     lambda: ratio("observer_bandwidth", "position_bandwidth", stroke_resolution=1.0), 2.0),
    (GAINS, "pressure_rate", lambda: ratio("pressure_rate", highest_supply), 3.0),
    (GAINS, "robust", lambda: float(gain("robust_limit")), 0.05),
    (GAINS, "nudge", lambda: ratio("speed_nudge", "speed_correction"), 0.01),
    *each(GAINS, "shares adaptation reserve adaptation_bulk", rates, RATES),
    (GAINS, "link", lambda: round(
        float(gain("upper")[1] / slide()[1].mechanism.links[-1].mass), 6), 1.5),
    (GAINS, "inertia", lambda: round(float(gain("upper")[0]), 6), 1.1),
    (GAINS, "disturbance", lambda: round(float(gain("upper")[2] / (
        slide()[0].plant.supply.pressure * slide()[1].circuit.area_head)), 6), 0.03),
    (GAINS, "bulk", lambda: refusal(gain) or round(float(gain("upper")[3]), 6), 1.4),
    (GAINS, "damping", lambda: sum_of(150.0, 10.0), 24.095),
    (GAINS, "parts", lambda: [round(
        float(gain(f"{word}_bandwidth")) * 0.011 / 0.1092, 6)
        for word in ("position", "speed", "force")], [0.2, 0.18, 0.62]),
    (GAINS, "overlap", lambda: overlap(0.0), 0.03),
    (GAINS, "onset", lambda: overlap(0.4), 0.1),
    (GAINS, "maps", lambda: ratio("map_bandwidth", "position_bandwidth"), 0.12),
    (GAINS, "count", lambda: round(float(
        gain("observer_bandwidth", stroke_resolution=2e-3) * 2e-3 / gain("speed_correction")), 6),
     0.08),
    (GAINS, "pressure", lambda: ratio("pressure_bandwidth", total), 0.6),
    (GAINS, "standby", lambda: refusal(gain) or float(gain("standby")), 0.8),
    (GAINS, "flow_reserve", lambda: float(gain("flow_reserve")), 0.06),
    (GAINS, "map_error", lambda: float(gain("map_error")), 0.25),
    (GAINS, "corner", drop_corner, 0.15),
    (GAINS, "strokes", swings, SWINGS),
    (POSITION, "lag_budget", lambda: position(1.0), 0.2),
    (POSITION, "damping_ratio", lambda: position(1e-3), 20.0),
    (ARC, "ahead", load_ahead, 1e-3),
    (ARC, "smaller", lambda: raised(9.0), 0.15),
    (ARC, "follows", felt, (1.45, 1.55), [True, False]),
    *each(MAPS, "first known", known_maps, [[0.4, 0.1], [0.4, 0.4]]),
    *each(MAPS, "scatter corner least", lambda: map_share(9.0), (0.00045, 0.015)),
    (MAPS, "steady", lambda: map_share(0.0)[0], 0.01125),
    (MAPS, "apart", lambda: map_share(0.02)[0], 0.001023),
    (MAPS, "quiet", quiet_maps, (1.9, 2.1), [False, True]),
    (OIL, "quiet", lambda n: len(oil_after(n)[0]), (2.9, 3.1), [0, 1]),
    *each(OIL, "scatter corner rate", oil_after, ([0.008], 0.02)),
    (OIL, "largest", lacks, (-9.0, 9.0), [-0.25, 0.25]),
    (OIL, "apart", credited, (-9.0, 9.0), [-0.05, 0.05]),
    (OIL, "memory", unsure_after, [0.033333] * 4),
    (MONITOR, "speed", chamber, 5e-3),
    (MONITOR, "model", lambda: chamber(flow=1e3), 150.0),
    (MONITOR, "opening", shifted, 0.6),
    (MONITOR, "share", lambda s: score(monitor.SHUT, -s) > -4.0, (0.65, 0.69), [False, True]),
    (MONITOR, "excess", lambda s: score(monitor.OPEN, s) > -4.0, (0.95, 1.05), [False, True]),
    (OfKernels(monitor, "SCORES"), "drift", idle_score, -4.0),
    (OfKernels(sensor_checks, "SCORES"), "alarm", blamed, (29.0, 31.0), [False, True]),
    (OfKernels(sensor_checks, "SCORES"), "corner", passed_low, 0.943396),
    *each(SENSORS, "line stroke force", lambda: checked()[0], [0.004, 0.03, 0.08]),
    (SENSORS, "jump", lambda: jumped(5.0), 2.0),
    (SENSORS, "still", lambda s: stands(s, 0.0), (0.048, 0.052), [False, True]),
    (MONITOR, "unexplained", unexplained, 16.0),
    (OIL, "latest", lambda: taken(1.0)[1], 0.02),
    (SENSORS, "ends", lambda x: checked(x)[1], (0.0095, 0.0105, 0.9895, 0.9905),
     [False, True, True, False]),
    (SENSORS, "moving", lambda v: checked(others=v)[1], (0.021, 0.019), [False, True]),
    (SENSORS, "payload", lambda f: weighed(f, 100.0)[0], (119.0, 121.0), [0.0, 1.0]),
    (SENSORS, "unsure", lambda: weighed(damping=10.0)[1], 3.00015),
    (SENSORS, "memory", doubt_left, 0.7),
    (ARC, "payload_memory", lambda: payload_after()[0], 30.954915149),
    (ARC, "weak_pull", lambda: payload_after(0.5)[0], 25.407858813),
    (ARC, "no_information", lambda: payload_after(0.0, 1)[1], 1e-6),
    (ARC, "other_payload", other_payload, 15.0),
    (ARC, "fresh", lambda: drawn(0.1), 0.030524),
    (ARC, "reversal", turned, (3.8, 4.2), [0, 1]),
    (ARC, "settled", rests, (2.9, 3.1), [False, True]),
    (MAPS, "squeezed", lambda: map_share(pressed=1.0, largest=1e-9)[0], 4806.0),
    (MAPS, "unsteady", lambda: map_share(late=1.0, largest=1e-9)[0], 3.004),
    (OIL, "softest", lambda s: taken(s)[0], (-1.0, 9.0), [-0.6, 1.5]),
    (RULES, "filled", lambda s: filled(False, s), (0.48, 0.52), [False, True]),
    (RULES, "filled_active", lambda s: filled(True, s), (0.24, 0.26), [False, True]),
    (RULES, "pressures", lambda: functions.default_pressure(20.0), 1.0),
    (RULES, "speed_start", lambda: rule("speed_start"), 2e-4),
    (RULES, "speed_stop", lambda: rule("speed_stop"), 1e-4),
    (RULES, "sure", lambda: rule("speed_sure"), 1e-3),
    (RULES, "corner", lambda: rule("desired_corner"), 20.0),
    (RULES, "reserve", lambda: rule("reserve"), 0.2),
    (RULES, "dwell", lambda: rule("dwell"), 0.1),
    (RULES, "power_band", lambda: rule("power_band"), 0.05),
    (RULES, "probe_drop", probe, 1e6),
    (FED, "off_rate", lambda: feedback("off_gain"), 10.0),
    (FED, "load_corner", lambda: feedback("load_corner"),
     6.283185),
    (FED, "drop_floor", lambda: feedback("drop_floor"), 2e4),
    (SENSORS, "usual", stands, (4.9, 5.1), [False, True]),
    (SENSORS, "carried", lambda: weighed(1e12, 1.0, 0.0, 1000, 1e9)[2], 95.167),
    (search.SEARCH, "corners", lambda: [round(c, 4) for c in law_search().corners[::21]],
     [25.0, 0.2]),
    (search.SEARCH, "offs", shares, [0.1, 0.2, 0.4, 0.7, 1.0, 1.5, 2.5, 5.0]),
    *each(arc_tune.ARC_SEARCH, "refinements budgets", budgets, (15, 0.08, 1.2)),
    (LOOP, "slowest", slowest, (2.8, 3.2), [-1.0, 1.0]),
    (LOOP, "rings", lambda z: frequencies(z)[0], (0.28, 0.32), [538, 500]),
    (LOOP, "points", lambda: frequencies(0.9)[0], 500),
    (LOOP, "peak", lambda: reach()[0], 8.2),
    (LOOP, "peak_points", lambda: reach()[1], 42),
    (MARGINS, "around", lambda: crossed()[1], (97.0, 103.0)),
    (MARGINS, "points", lambda: crossed()[0], 61),
    (LOOP, "safety", stated, 2.0),
    (LOOP, "growth", swings_as_it_is, (0.045, 0.055), [False, True]),
    (MARGINS, "near", lambda x: bool(crossed(x)[0]), (0.028, 0.032), [True, False]),
    *each(MARGINS, "turns spread", lambda: crossed(delay=1.0)[:2], (300, (0.3, 60.0))),
    (MARGINS, "calm", calm, (0.9e-9, 1.1e-9), [True, False]),
    (MARGINS, "slow", standstill, 1e-6),
    (measures.MEASURES, "shifts", shifts_tried, (-1.0, 1.0, 403)),
    (measures.MEASURES, "used", used, (0.045, 0.055), [False, True]),
    (SWING, "counts", coarse_swing, (3, 5), [False, True]),
    (checks.CHECKS, "following", lambda: bounds("following"), 0.1),
    (checks.CHECKS, "mismatch", lambda: bounds("mismatch"), 0.05),
    (checks.CHECKS, "range", highest, 3.0),
    (checks.CHECKS, "late", lambda: oldest(1e-3), 20.0),
    (checks.CHECKS, "late_ticks", lambda: oldest(0.05), 200.0),
    (path.PATH, "spacing", lambda: postures(1.0)[0], [201]),
    (path.PATH, "postures", lambda: postures(0.01)[0], [33]),
    (path.PATH, "doublings", lambda: postures(1.0, 1.0)[:2], ([201, 401, 801, 1601],
     "trial.near_singular")),
    (path.PATH, "tries", tried, 65),
    (search.SEARCH, "draw_points", drawn_for, 24),
    (measures.MEASURES, "openings", openings, ([2.35, 10.0], 12)),
    (SWING, "harmonics", often, (24, 26), [False, True]),
    (ARC, "turns", lambda n: rests(turns=n), (3, 4), [False, True]),
    (ARC, "counts", shuts, (1.4, 1.6), [True, False]),
    (ARC, "jump", restarts, (0.009, 0.011), [False, True]),
    (ARC, "offset", lambda: payload_after(bound=1e9)[2], 100.0),
    (ARC, "damping", lambda: payload_after(speed=1e9)[2], 200.0),
    (GAINS, "resolution", lambda: float(gain("stroke_resolution", coarse=True)),
     2.5e-5),
    (MAPS, "narrow", slope_of_map, (0.1, 0.2), [6.666667, 5.0]),
    (OIL, "first", unsure_at_first, [1.0, 0.01, 0.15, 0.15]),
    (OfKernels(monitor, "SENSORS"), "drawn", supplied, (0.68, 0.72), [True, False]),
    (LOOP, "estimate", estimate_step, 1e-4),
    (LOOP, "inside", off_bounds, 1e-3),
    (MARGINS, "jump", jumps, (0.9e-6, 1.1e-6), [1, 0]),
    (operating_point.POINT, "difference", push_step, 1e-5),
    (operating_point.POINT, "halvings", top_speed, 0.299804688),
    *each(search.SEARCH, "locus_points step_samples", drawn_points, [182, 201]),
    (SWING, "windows", kept_of_a_step, [0.249, 0.406, 0.471]),
    (SWING, "periods", uneven, (0.33, 0.37), [True, False]),
    (SWING, "coarse", lambda x: coarse_swing(2, x), (0.095, 0.105), [True, False]),
    (path.PATH, "coarse", lambda: postures(1.0)[2], 9),
    (path.PATH, "error", lambda x: postures(1.0, x)[1], (0.9e-5, 1.1e-5),
     ["", "trial.near_singular"]),
    (coordination.COORDINATION, "reserve", flow_kept, 0.9),
    (coordination.COORDINATION, "slowed", slow_ticks, 1.0),
    (lever.OPERATOR, "reserve", kept_stroke, 0.02),
    (arc.LAW, "preview", known_before, 0.15),
]  # fmt: skip

test_a_third_more_or_less_shows = each_shows(ROWS)
