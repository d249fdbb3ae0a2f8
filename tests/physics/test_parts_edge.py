"""Edge laws against their closed forms, what they do to a design, what logs tell of them."""

import math

import numpy as np
import pytest
from plant_differences import plant_model
from with_parts import books, moved, noisy, point_of, recovered, steps

from ehbench.config.rig import Edge, Rig
from ehbench.control.valve_level import edge_order
from ehbench.flow_maps.step_readings import step_readings
from ehbench.machines.virtual.machine import VirtualMachine
from ehbench.parts.edge import edge_command, edge_flow, edge_known, edge_onset, edge_slope
from ehbench.plant.design_point import circuit_of
from ehbench.plant.model import Model, simulate
from ehbench.tune.loop import damping_ratio
from ehbench.vocabulary.codes import FAINT, REVERSED
from ehbench.vocabulary.fields import Value
from tests.shared import shipped, started_off

DROPS = (1e2, 1e4, 3e5, 2e6, 1.9e6, 2.1e6, 1.2e7)


def with_law(name: str = "slide_servo", **update) -> Rig:
    """A shipped rig with every edge on another law; numbers in SI."""
    rig = shipped(name)
    given = {k: v if isinstance(v, str) else Value(v) for k, v in update.items()}

    def changed(edge: Edge) -> Edge:
        gain = {} if "compensated_gain" in given else {"flow_gain": edge.flow_gain}
        ends = {"from": edge.from_, "to": edge.to, "sign": edge.sign}
        return Edge.model_validate(ends | gain | given)

    def cylinder(c):
        valves = tuple(
            v.model_copy(update={"edge": tuple(changed(e) for e in v.edge)}) for v in c.valve
        )
        return c.model_copy(update={"valve": valves})

    return rig.model_copy(update={"cylinder": tuple(cylinder(c) for c in rig.cylinder)})


# --- an edge that saturates


@pytest.mark.parametrize("soft", [0.0, 0.6])
def test_a_saturating_edge_is_an_orifice_of_limited_opening(soft):
    """Orifice up to the corner, its area at ``opening_max`` beyond; the inverse is exact below."""
    plain = Model.of(with_law(law="orifice", deadband=0.5)).plant
    corner = {"opening_max": 4.0, "saturation_softness": soft}
    plant = Model.of(with_law(law="saturating", deadband=0.5, **corner)).plant
    for edge, whole in zip(plant.edges[:2], plain.edges[:2], strict=True):
        for drop in (*DROPS, *(-d for d in DROPS)):
            for u in (0.2, 0.7, 2.0, 3.39, 3.7, 4.0, 4.3, 4.59):
                flow, open_ = edge_flow(drop, u, edge, plant.maps), (u - 4.0) / (soft or 1.0)
                if u <= 4.0 - soft:
                    assert flow == edge_flow(drop, u, whole, plain.maps)
                elif open_ < 1.0 and soft:
                    assert 0.0 < flow / edge_flow(drop, u, whole, plain.maps) < 1.0
                if 0.5 < u < 4.0 + soft:
                    back = edge_command(drop, flow, edge, plant.maps)
                    assert back == pytest.approx(u, rel=1e-7)
            full = edge_flow(drop, 4.0, whole, plain.maps)
            for u in (4.0 + soft, 7.0, 10.0):
                assert edge_flow(drop, u, edge, plant.maps) == pytest.approx(full, rel=1e-14)
            assert edge_command(drop, 2.0 * full, edge, plant.maps) == 4.0 + soft
            assert edge_known(drop, edge, plant.maps) == 4.0 + soft


def test_a_controller_takes_a_saturating_edge_no_faster_than_it_goes():
    """Full speed of the design is that of the full opening: with one of 4 V of 10, 0.4 times."""
    speeds = {}
    for law, more in (("orifice", {}), ("saturating", {"opening_max": 4.0})):
        point = point_of(Model.of(with_law(law=law, **more)), share=1.0)
        assert point.possible and all(path.gain > 0.0 for path in point.paths)
        speeds[law] = point.v
    pump = 60e-3 / 60 / (math.pi / 4 * 0.05**2)  # what the orifice's own limit is
    assert speeds["orifice"] <= pump * (1 + 1e-9)
    assert speeds["saturating"] < 0.7 * speeds["orifice"]


# --- a compensated edge that holds its flow


def test_flow_control_is_flat_above_its_drop_and_smooth_below():
    """``gain·(u − deadband)`` to the last bit above, slope 0 where they meet, exact inverse."""
    gain, dead, reference = 5e-6, 0.5, 2e6
    given = {"compensated_gain": gain, "compensation_drop": reference, "deadband": dead}
    model = Model.of(with_law(law="flow_control", **given))
    edge, maps = model.plant.edges[0], model.plant.maps
    for drop in DROPS:
        flow = edge_flow(drop, 3.0, edge, maps)
        assert edge_flow(-drop, 3.0, edge, maps) == -flow
        assert edge_command(drop, flow, edge, maps) == pytest.approx(3.0, rel=1e-14)
        if drop >= reference:
            assert flow == gain * (3.0 - dead)
    small = np.geomspace(1.0, reference, 400)
    flows = np.array([edge_flow(drop, 3.0, edge, maps) for drop in small])
    assert (np.diff(flows) > 0.0).all()
    below = edge_flow(0.999 * reference, 3.0, edge, maps)
    # slope goes to zero linearly: 0.1 % below, a share of 1e-6 of the flow is missing at most
    assert 0.0 < 1.0 - below / (gain * (3.0 - dead)) < 1e-6
    # an orifice's √ below, s (3 − s²)/2; its rounding at zero, over 20 kPa, takes 0.3 % at 0.2 MPa
    share = math.sqrt(0.1)
    expected = 0.5 * share * (3.0 - share**2) * gain * (3.0 - dead)
    assert edge_flow(0.1 * reference, 3.0, edge, maps) == pytest.approx(expected, rel=5e-3)


def held_ring(law: str, drop: float) -> tuple[float, float]:
    """(damping ratio of an undamped boom on its two oil columns, valves held at a steady motion;
    the same with the chambers shut in)."""
    rig = with_law("boom_four_valve", law=law, compensated_gain=3e-5, compensation_drop=drop)
    model = Model.of(rig.with_values({"boom.joint_damping": 0.0}))
    point = point_of(model, low=2.05e6, cross=4e6, speed=0.08)
    assert point.possible and all(path.drop > drop for path in point.paths)
    held = plant_model(model, point).a[:3, :3]
    shut = held.copy()
    shut[1:, 1:] = 0.0
    ours, bare = (float(damping_ratio(np.linalg.eigvals(a))) for a in (held, shut))
    return ours, bare


def test_flow_control_adds_no_damping_above_its_drop():
    """At 20 bar the levelling law adds ζ = 0.04 to an undamped load, the flat one nothing."""
    ours, bare = held_ring("compensated", 2e6)
    assert ours - bare > 0.02
    ours, bare = held_ring("flow_control", 2e6)
    assert abs(ours - bare) < 1e-7


# --- an edge that is open at rest: underlap

OPEN = (
    {"law": "orifice"},
    {"law": "saturating", "opening_max": 4.0, "saturation_softness": 0.6},
    {"law": "compensated", "compensated_gain": 5e-6},
    {"law": "flow_control", "compensated_gain": 5e-6, "compensation_drop": 2e6},
)


@pytest.mark.parametrize("law", OPEN, ids=lambda law: law["law"])
def test_an_underlap_shifts_the_flow_by_itself(law):
    """``Q(u) = Q0(u + underlap)``; the inverse is exact, and 0 for a flow that passes at rest."""
    wide = law | ({"opening_max": 4.3} if "opening_max" in law else {})
    plant = Model.of(with_law(**law, underlap=0.3)).plant
    edge, bare, maps = plant.edges[0], Model.of(with_law(**wide)).plant.edges[0], plant.maps
    for drop in DROPS:
        for way in (1.0, -1.0):
            for u in (-0.2, 0.0, 0.4, 2.0):
                flow = edge_flow(way * drop, u, edge, maps)
                assert flow == pytest.approx(edge_flow(way * drop, u + 0.3, bare, maps), rel=1e-12)
                back = edge_command(way * drop, flow, edge, maps)
                assert back == pytest.approx(max(u, 0.0), abs=1e-9)
            for u in (-0.3, -0.4, -5.0):
                assert edge_flow(way * drop, u, edge, maps) == 0.0
    assert edge_onset(edge, maps) == 0.0


@pytest.mark.parametrize(
    "odd", [{"deadband": 0.5}, {"law": "map", "flow_gain": None}, {"law": "pump"}], ids=str
)
def test_an_underlap_that_can_not_be_is_refused(odd):
    with pytest.raises(ValueError, match="not both|takes no underlap|pump"):
        with_law(**({"law": "orifice", "underlap": 0.3} | odd))


def underlapped() -> Rig:
    """The sliding mass on a slope, every edge open at rest still."""
    rig = with_law(law="orifice", underlap=0.15)
    return rig.with_values({"carriage.incline": 0.5})


def test_an_underlapped_cylinder_rests_where_its_edges_leave_its_pressures():
    """The start is the creep that a simulation from other pressures comes to."""
    model = Model.of(underlapped())
    y = model.trim(model.posture(None))
    other = model.trim(model.posture(None), low_side=2e5)
    commands = np.zeros((1501, 1))
    log = model.record(np.arange(1501) * 1e-3, commands, model.run(other, commands, 1e-3))
    for name in ("p_head", "p_rod"):
        at = y[model.layout.state(name, 0)]
        assert log[f"press.{name}"][-1] == pytest.approx(at, rel=2e-3)
        assert abs(log[f"press.{name}"][0] / at - 1.0) > 0.2
    assert model.creep(0, y) == pytest.approx(log["press.v"][-1], rel=2e-2)
    (said,) = model.creeping("press")
    way = "out" if log["press.v"][-1] > 0.0 else "in"
    assert said.startswith(f"press creeps {way} at ")
    assert Model.of(with_law(law="orifice", deadband=0.2)).creeping("press") == []


def test_step_readings_are_of_one_open_edge_alone():
    """Within an underlap no reading is of one edge; beyond, a reading is the edge's own flow."""
    command = np.repeat([0.0, 0.1, 1.5, -0.1, -1.5], 500)
    record = simulate(underlapped(), {"press.servo": command}, 1e-3 * (command.size - 1))
    model = Model.of(underlapped())
    found = step_readings("log", record, model, 0.2, 0.1)
    assert set(np.abs(found.command)) == {1.5} and len(found.command) >= 8
    edges = dict(zip(model.layout.edges, model.plant.edges, strict=True))
    for name, u, drop, flow in zip(
        found.valve, found.command, found.pressure_drop, found.flow, strict=True
    ):
        assert flow == pytest.approx(edge_flow(drop, u, edges[name], model.plant.maps), rel=1e-2)


def test_an_underlap_comes_back_from_a_noisy_log():
    """Of one edge, from a third of it, beside another's gain."""
    rig = underlapped()
    command = steps((1.0, 3.0, -2.0, 0.6, -0.6))
    made = simulate(rig, {"press.servo": command}, 1e-3 * (command.size - 1))
    factors = {"press.servo_rod_tank.underlap": 1 / 3, "press.servo_supply_head.flow_gain": 0.6}
    fit, known = started_off(rig, [("log", noisy(made, 5))], factors)
    for name, truth in known.items():
        low, high = fit[name].interval
        assert low <= truth <= high and fit[name].status == "estimated"
        assert high - low < 0.05 * high


# --- a valve that a spring holds shut in series with an edge

CRACKING = 3e6
LAWS = tuple(law | {"deadband": 0.5} for law in OPEN)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law["law"])
def test_a_preload_takes_its_pressure_of_the_drop(law):
    """``Q(Δp) = Q0(Δp − p_c)`` above ``p_c``, nothing below, all in reverse; exact inverse."""
    plain = Model.of(with_law(**law)).plant
    plant = Model.of(with_law(**law, cracking_pressure=CRACKING)).plant
    edge, bare, maps = plant.edges[0], plain.edges[0], plant.maps
    for drop in (1e2, 1e6, CRACKING):
        assert edge_flow(drop, 2.0, edge, maps) == 0.0
        assert edge_command(drop, 1e-5, edge, maps) == 0.0
    for drop in DROPS:
        flow = edge_flow(CRACKING + drop, 2.0, edge, maps)
        assert flow == pytest.approx(edge_flow(drop, 2.0, bare, maps), rel=1e-9)
        assert edge_command(CRACKING + drop, flow, edge, maps) == pytest.approx(2.0, rel=1e-7)
        assert edge_flow(-drop, 2.0, edge, maps) == edge_flow(-drop, 2.0, bare, maps)
        around = [edge_flow(CRACKING + drop + h, 2.0, edge, maps) for h in (-10.0, 10.0)]
        slope = edge_slope(CRACKING + drop, flow, 2.0, edge)
        assert (around[1] - around[0]) / 20.0 <= 1.001 * slope
    assert edge_onset(edge, maps) == pytest.approx(0.5, abs=1e-4)


def preloaded() -> Rig:
    """The sliding mass, its rod's way back held shut to 30 bar."""
    rig = shipped("slide_servo")
    return rig.with_values({"press.servo_rod_tank.cracking_pressure": CRACKING})


def test_the_ledger_closes_with_a_preload():
    """What the spring takes, ``p_c ∫Q dt``, is part of the edge's throttling."""
    record = moved(preloaded())
    kept = "press.servo_rod_tank.throttling"
    ledger = books(preloaded(), record, kept, share=1e-2, closed=1e-4)
    flow = record["press.servo_rod_tank.flow"]
    spring = CRACKING * np.trapezoid(flow, record.t)
    assert ledger[kept].energy > 1.01 * spring > 100.0
    assert record["press.p_rod"][flow > 1e-6].min() > CRACKING


def test_controllers_and_the_bench_know_a_preload():
    """A design goes on beyond it, the inverse too, and the bench passes nothing below."""
    model = Model.of(preloaded())
    circuit = circuit_of(model, 0)
    points = [point_of(model, low=low, speed=0.05) for low in (5e5, 4e6)]
    assert points[1].possible and points[1].p_rod > CRACKING
    path = next(p.path for p in points[1].paths if p.edge == "press.servo_rod_tank")
    edge = circuit.edges[circuit.paths[path]]
    for drop, limits in ((-1e6, REVERSED), (1e6, FAINT), (CRACKING + 1e5, 0)):
        command, found = edge_order(circuit, path, 1e-5, drop, 2e4)
        assert found == limits
        least = max(drop, CRACKING + 2e4)
        if limits != REVERSED:
            given = circuit.along[path] * edge_flow(least, command, edge, circuit.maps)
            assert given == pytest.approx(1e-5, rel=1e-9)
    bench = VirtualMachine(preloaded())
    flows = bench.static_flow("press.servo_rod_tank", -4.0, np.array([1e6, 2.9e6, 3.2e6, 6e6]))
    assert flows[0] == flows[1] == 0.0 and 0.0 < flows[2] < flows[3]


# --- two numbers of an edge, or of one and the oil, from starts so many times off

EDGE = "press.servo_supply_head"
STARTS = {
    "saturating": (
        {"opening_max": 3.0, "saturation_softness": 0.4},
        {f"{EDGE}.opening_max": 1.8, f"{EDGE}.flow_gain": 0.6},
    ),
    "flow_control": (
        {"compensated_gain": 6e-6, "deadband": 0.4},
        {f"{EDGE}.compensated_gain": 1.6, f"{EDGE}.deadband": 0.5},
    ),
    "preload": ({}, {"press.servo_rod_tank.cracking_pressure": 0.4, "bulk_modulus": 1.5}),
}


@pytest.mark.slow
@pytest.mark.parametrize("law", STARTS)
def test_numbers_of_edges_come_back_from_noisy_logs(law):
    table, factors = STARTS[law]
    recovered(with_law(law=law, **table) if table else preloaded(), factors)
