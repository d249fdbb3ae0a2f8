"""Edge laws against their closed forms, what they do to a design, what logs tell of them."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest

from ehbench.fields import Value
from ehbench.parts.edge import edge_command, edge_flow, edge_known
from ehbench.plant.model import Model
from ehbench.recipe import load_rig
from ehbench.rig import Edge, Rig
from ehbench.tune.differences import plant_model
from ehbench.tune.loop import damping_ratio
from ehbench.tune.operating_point import Aim, circuit_of, equivalent, operating_point

sys.path.insert(0, str(Path(__file__).parent))
from with_parts import recovered  # noqa: E402

RIGS = Path(__file__).parents[2] / "recipes" / "rigs"
DROPS = (1e2, 1e4, 3e5, 2e6, 1.9e6, 2.1e6, 1.2e7)


def with_law(name: str = "slide_servo", **update) -> Rig:
    """A shipped rig with every edge on another law; numbers in SI."""
    rig = load_rig(RIGS / f"{name}.toml")
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
    plant = Model.of(
        with_law(law="saturating", deadband=0.5, opening_max=4.0, saturation_softness=soft)
    ).plant
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
        model = Model.of(with_law(law=law, **more))
        circuit = circuit_of(model, 0)
        here = equivalent(model, 0, np.array([0.2]))
        point = operating_point(
            model, circuit, 1, here, 0, Aim(share=1.0, low_pressure=5e5, cross_drop=5e5)
        )
        assert point.possible and all(path.gain > 0.0 for path in point.paths)
        speeds[law] = point.v
    pump = 60e-3 / 60 / (math.pi / 4 * 0.05**2)  # what the orifice's own limit is
    assert speeds["orifice"] <= pump * (1 + 1e-9)
    assert speeds["saturating"] < 0.7 * speeds["orifice"]


@pytest.mark.slow
def test_a_saturation_comes_back_from_noisy_logs():
    """``opening_max`` and ``flow_gain`` of one edge, started 1.8 and 0.6 times off."""
    rig = with_law(law="saturating", opening_max=3.0, saturation_softness=0.4)
    edge = "press.servo_supply_head"
    recovered(rig, {f"{edge}.opening_max": 1.8, f"{edge}.flow_gain": 0.6})


# --- a compensated edge that holds its flow


def test_flow_control_is_flat_above_its_drop_and_smooth_below():
    """``gain·(u − deadband)`` to the last bit above, slope 0 where they meet, exact inverse."""
    gain, dead, reference = 5e-6, 0.5, 2e6
    model = Model.of(
        with_law(
            law="flow_control",
            compensated_gain=gain,
            compensation_drop=reference,
            deadband=dead,
        )
    )
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
    assert edge_flow(0.1 * reference, 3.0, edge, maps) == pytest.approx(
        0.5 * share * (3.0 - share**2) * gain * (3.0 - dead), rel=5e-3
    )


def held_ring(law: str, drop: float) -> tuple[float, float]:
    """(damping ratio of an undamped boom on its two oil columns, valves held at a steady motion;
    the same with the chambers shut in)."""
    rig = with_law("boom_four_valve", law=law, compensated_gain=3e-5, compensation_drop=drop)
    model = Model.of(rig.with_values({"boom.joint_damping": 0.0}))
    here = equivalent(model, 0, np.array([0.2]))
    point = operating_point(
        model,
        circuit_of(model, 0),
        1,
        here,
        0,
        Aim(speed=0.08, low_pressure=2.05e6, cross_drop=4e6),
    )
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


@pytest.mark.slow
def test_a_flow_control_gain_comes_back_from_noisy_logs():
    """Gain and deadband of one edge, started 1.6 and 0.5 times off."""
    rig = with_law(law="flow_control", compensated_gain=6e-6, deadband=0.4)
    edge = "press.servo_supply_head"
    recovered(rig, {f"{edge}.compensated_gain": 1.6, f"{edge}.deadband": 0.5})
