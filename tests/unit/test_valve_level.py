"""Chamber flows become commands that give exactly those flows; every limit met is told."""

import math

import numpy as np
import pytest

from ehbench.control import functions as fn
from ehbench.control import valve_level as vl
from ehbench.control.measured import Pressures
from ehbench.parts.edge import edge_flow
from ehbench.physics.flow_map import FlowMap, ValveMaps
from ehbench.plant.design_point import circuit_of
from ehbench.plant.model import Model
from ehbench.vocabulary import codes
from tests.shared import shipped

GPM = 3.785411784e-3 / 60.0
FLOOR = 2e4


def a_map(seed: int, valve: str, direction: str = "forward") -> FlowMap:
    """A map with random positive increments, measured from 0.1 to 5 MPa."""
    rng = np.random.default_rng(seed)
    knots = np.array([1.6, 2.0, 2.5, 3.0, 4.0, 6.0, 8.0, 10.0])
    steps = rng.exponential(0.8 * GPM, (knots.size, 9)) * np.linspace(0.2, 1.0, 9) + 1e-9
    command, std = np.array([0.0, 2.0, 4.0, 10.0]), np.full((2, 2), 0.01 * GPM)
    low, high = np.array([1e5, 1e5, 2e5, 4e5]), np.array([5e6, 5e6, 4e6, 2e6])
    ends = np.array([0.0, 10.0]), np.array([0.0, 2500.0])
    law = valve, direction, 1.6, (1.5, 1.7), knots, 6e6, 2e4, steps
    return FlowMap(*law, command, low, high, *ends, std, 8 * GPM)


def of_rig(rig: str, cylinder: str, maps: dict | None = None) -> fn.Circuit:
    model = Model.of(shipped(rig), maps)
    return circuit_of(model, model.layout.cylinders.index(cylinder), maps)


EDGES = ("hect", "hepc", "regen", "repc", "rect")
MAPS = {name: ValveMaps(a_map(seed, name)) for seed, name in enumerate(EDGES)}
MAPS["regen"] = ValveMaps(MAPS["regen"].forward, a_map(2 + 9, "regen", "reverse"))
CIRCUITS = {
    "five, laws": of_rig("thesis_arm", "boom"),
    "five, maps": of_rig("thesis_arm", "boom", MAPS),
    "four": of_rig("boom_four_valve", "boom"),
    "spool": of_rig("crane_proportional", "lift"),
    "servo beside others": of_rig("thesis_arm", "stick"),
}


class Given:
    """What `allocate` writes for two flows, from a command vector of sevens."""

    def __init__(self, c: fn.Circuit, function: int, head, rod, pressures) -> None:
        self.command = np.full(c.lowest.size, 7.0)
        self.flows, self.limits = np.full(c.count, 7.0), np.full(c.count, 7.0)
        asked, out = (vl.Flows(head, rod), Pressures(*pressures)), (self.flows, self.limits)
        self.met = vl.allocate(function, *asked, FLOOR, c, self.command, *out)


def passed(c: fn.Circuit, edge: int, command: np.ndarray, pressures) -> float:
    """Flow along an edge at a command, by the plant's law."""
    p_head, p_rod, p_supply, p_tank = pressures
    nodes = {0: p_supply, 1: p_tank, 2 + 2 * c.cylinder: p_head, 3 + 2 * c.cylinder: p_rod}
    drop = nodes[c.edges[edge].from_node] - nodes[c.edges[edge].to_node]
    return edge_flow(drop, command[c.edges[edge].valve], c.edges[edge], c.maps)


def states(c: fn.Circuit, count: int, seed: int):
    """Random functions at pressures whose drops point the right way, above the floor."""
    rng = np.random.default_rng(seed)
    able = [f for f in range(1, 8) if c.able[f]]
    for _ in range(count):
        function = int(rng.choice(able))
        p_supply, p_tank = rng.uniform(5e6, 8e6), rng.uniform(0.0, 2e5)
        way = 1 if function in (3, 7) else -1
        p_head, p_rod = np.sort(rng.uniform(p_tank + 3e5, p_supply - 3e5, 2))[::way]
        if abs(p_head - p_rod) > 3e5:
            v = rng.uniform(0.002, 0.05) * fn.DIRECTION[function]
            yield function, v, (p_head, p_rod, p_supply, p_tank)


@pytest.mark.parametrize("name", CIRCUITS)
def test_the_commands_give_the_flows(name):
    """Every edge that decides its command passes what it is asked for, to rounding."""
    c = CIRCUITS[name]
    kept = 0
    for function, v, pressures in states(c, 2000, 1):
        asked = np.array([c.area_head, c.area_rod]) * v
        # pyrefly: ignore[bad-argument-count]
        given = Given(c, function, *asked, pressures)
        own = set(c.edges.valve[c.first : c.first + c.count].tolist())
        used = set()
        for path in np.flatnonzero(fn.PATH_FLOWS[function].any(axis=1)):
            edge = c.paths[path]
            flow = fn.PATH_FLOWS[function, path] @ asked
            assert c.along[path] * given.flows[edge - c.first] == pytest.approx(flow, rel=1e-14)
            used.add(int(c.edges[edge].valve))
            if fn.coupled(c, function) and path != fn.METERING[function]:
                continue
            limits = int(given.limits[edge - c.first])
            through = c.along[path] * passed(c, edge, given.command, pressures)
            if limits & codes.SATURATED:
                valve = c.edges[edge].valve
                end = (c.highest if c.edges[edge].sign > 0 else c.lowest)[valve]
                assert given.command[valve] == end
                assert through < flow
            else:
                kept += 1
                # a map's root loses digits near its deadband
                assert through == pytest.approx(flow, rel=1e-9)
        for valve in range(c.lowest.size):
            if valve not in own or valve not in used:
                assert given.command[valve] == (0.0 if valve in own else 7.0)
    assert kept > 1000


@pytest.mark.parametrize("name", CIRCUITS)
def test_saturation_begins_at_the_top_speed_and_hold_shuts_this_cylinder_only(name):
    c = CIRCUITS[name]
    for function, _, pressures in states(c, 50, 2):
        if fn.coupled(c, function):
            continue
        top = vl.top_speed(function, Pressures(*pressures), c) * fn.DIRECTION[function]
        below, above = (
            Given(c, function, c.area_head * v, c.area_rod * v, pressures)
            for v in (0.9999 * top, 1.0001 * top)
        )
        assert not below.met & codes.SATURATED
        assert above.met & codes.SATURATED and (above.limits.astype(int) & codes.SATURATED).any()
    assert vl.top_speed(codes.HOLD, Pressures(1e6, 1e6, 7e6, 0.0), c) == 0.0
    c = CIRCUITS[name]
    given = Given(c, codes.HOLD, 1e-4, 1e-4, (1e6, 1e6, 7e6, 0.0))
    own = sorted(set(c.edges.valve[c.first : c.first + c.count].tolist()))
    assert given.met == 0 and not given.flows.any() and not given.limits.any()
    assert not given.command[own].any() and (np.delete(given.command, own) == 7.0).all()


def test_a_spool_follows_the_edge_that_meters():
    c = CIRCUITS["spool"]
    pressures = (4e6, 1e6, 18e6, 3e5)
    for function, sign, path in (
        (1, 1, fn.SUPPLY_HEAD),
        (2, 1, fn.ROD_TANK),
        (4, -1, fn.SUPPLY_ROD),
        (5, -1, fn.HEAD_TANK),
    ):
        asked = sign * 0.02 * np.array([c.area_head, c.area_rod])
        # pyrefly: ignore[bad-argument-count]
        given = Given(c, function, *asked, pressures)
        assert given.met == 0 and given.command[0] * sign > 1.5
        other = next(p for p in np.flatnonzero(fn.PATH_FLOWS[function].any(axis=1)) if p != path)
        metered, follower = (passed(c, c.paths[p], given.command, pressures) for p in (path, other))
        assert metered == pytest.approx(fn.PATH_FLOWS[function, path] @ asked, rel=1e-12)
        assert follower > 0
        assert follower != pytest.approx(fn.PATH_FLOWS[function, other] @ asked, rel=0.01)


def test_what_a_drop_cannot_do_is_told():
    c = CIRCUITS["five, laws"]
    valve = {path: int(c.edges[c.paths[path]].valve) for path in range(6)}

    def vent(p_rod, flow_rod=5e-5):
        given = Given(c, codes.EXTEND_RESISTIVE, 1e-4, flow_rod, (2e6, p_rod, 7e6, 1e5))
        assert given.limits[c.paths[fn.SUPPLY_HEAD] - c.first] == 0
        limits = int(given.limits[c.paths[fn.ROD_TANK] - c.first])
        return given.command[valve[fn.ROD_TANK]], limits, given.met

    at_floor, limits, met = vent(1e5 + FLOOR)
    assert (limits, met) == (0, 0) and at_floor > 2.0
    for drop in (0.3 * FLOOR, 0.0, -0.9 * FLOOR):
        assert vent(1e5 + drop) == (at_floor, codes.FAINT, codes.FAINT)
    assert vent(1e5 - FLOOR) == (0.0, codes.REVERSED, codes.REVERSED)
    assert vent(1e6, -1e-6) == (0.0, codes.AGAINST, codes.AGAINST)
    assert vent(1e6, 0.0) == (0.0, 0, 0)
    both = codes.FAINT | codes.SATURATED
    assert vent(1e5, 5e-4) == (10.0, both, both)


def test_the_measured_range_is_that_of_the_map_and_leaving_it_is_told():
    c = CIRCUITS["five, maps"]
    rng = np.random.default_rng(3)
    seen = set()
    for name, edge in zip(MAPS, range(c.first, c.first + c.count), strict=True):
        drops, commands = rng.uniform(-6e6, 6e6, 400), rng.uniform(0.0, 11.0, 400)
        for drop, command in zip(drops, commands, strict=True):
            expected = bool(MAPS[name].inside(drop, command))
            seen.add((drop > 0, expected))
            assert vl.inside(c, edge, drop, command) == expected
    assert len(seen) == 4
    c = CIRCUITS["five, maps"]
    edge = c.paths[fn.SUPPLY_HEAD]
    for p_head, outside in ((1.95e6, True), (2.05e6, False), (6.95e6, True)):
        given = Given(c, codes.EXTEND_RESISTIVE, 2e-5, 1e-5, (p_head, 1e6, 7e6, 0.0))
        assert bool(int(given.limits[edge - c.first]) & codes.OUTSIDE) == outside
    # the reverse direction of a valve that was not measured that way
    one_way = {**MAPS, "regen": ValveMaps(MAPS["regen"].forward)}
    other = of_rig("thesis_arm", "boom", one_way)
    both = [Given(k, 3, 2e-5, 1e-5, (1e6, 2e6, 7e6, 0.0)) for k in (c, other)]
    limits = [given.limits[c.paths[fn.ROD_HEAD] - c.first] for given in both]
    assert limits == [0, codes.OUTSIDE]


def test_a_driver_that_cannot_go_to_zero_rests_at_its_lowest():
    c = CIRCUITS["four"]._replace(lowest=np.full(4, 0.5))
    assert Given(c, codes.HOLD, 0.0, 0.0, (1e6, 1e6, 7e6, 0.0)).command.tolist() == [0.5] * 4
    moving = Given(c, codes.EXTEND_RESISTIVE, 1e-4, 0.0, (1e6, 1e6, 7e6, 0.0)).command
    assert moving[1] > 1.0 and moving[[0, 2, 3]].tolist() == [0.5] * 3


@pytest.mark.parametrize("name", CIRCUITS)
def test_a_withheld_channel_poisons_the_commands(name):
    """NaN in a used pressure or flow comes out as NaN in each command that it decides."""
    c = CIRCUITS[name]
    used = {fn.SUPPLY_HEAD: (0, 2), fn.HEAD_TANK: (0, 3), fn.SUPPLY_ROD: (1, 2)}
    used |= {fn.ROD_TANK: (1, 3), fn.HEAD_ROD: (0, 1), fn.ROD_HEAD: (0, 1)}
    for function in range(1, 8):
        if not c.able[function]:
            continue
        pressures = [1e6, 2e6, 7e6, 0.0] if function in (3, 7) else [2e6, 1e6, 7e6, 0.0]
        asked = 0.02 * fn.DIRECTION[function] * np.array([c.area_head, c.area_rod])
        paths = np.flatnonzero(fn.PATH_FLOWS[function].any(axis=1))
        if fn.coupled(c, function):
            paths = [fn.METERING[function]]
        for path in paths:
            valve = c.edges[c.paths[path]].valve
            for gone in used[path]:
                with_gap = [math.nan if i == gone else p for i, p in enumerate(pressures)]
                # pyrefly: ignore[bad-argument-count]
                assert math.isnan(Given(c, function, *asked, with_gap).command[valve])
            assert math.isnan(Given(c, function, math.nan, math.nan, pressures).command[valve])


def test_an_edge_drawn_the_other_way_round_serves_as_well():
    c = CIRCUITS["four"]
    turned = c.edges.copy()
    turned.from_node, turned.to_node = c.edges.to_node, c.edges.from_node
    ranges = np.column_stack([c.lowest, c.highest])
    other = fn.circuit(0, c.area_head, c.area_rod, turned, c.maps, ranges)
    assert (other.along[:4] == -1).all() and (other.able == c.able).all()
    for function, v, pressures in states(c, 50, 4):
        flows = c.area_head * v, c.area_rod * v
        one, two = (Given(k, function, *flows, pressures) for k in (c, other))
        assert (one.command == two.command).all() and (one.flows == -two.flows).all()
        assert (one.limits == two.limits).all()
