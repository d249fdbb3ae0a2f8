"""Working functions: what a circuit can do, and a choice without gap, contradiction or chatter."""

import itertools

import numpy as np
import pytest

from ehbench.control import functions as fn
from ehbench.control.measured import Pressures
from ehbench.parts.edge import BY_NAME, EDGE
from ehbench.parts.supply import SUPPLY as SUPPLY_LINE
from ehbench.plant.design_point import circuit_of
from ehbench.plant.model import Model
from ehbench.runtime.compiled import table
from ehbench.vocabulary import codes
from tests.shared import refused, shipped

MOVES = ("extend_resistive", "extend_overrunning", "retract_resistive", "retract_overrunning")
PLAIN = {"hold", *MOVES}
ALL = set(codes.FUNCTIONS[:8])
SUPPLY, TANK, HEAD, ROD = range(4)
A1, A2, PS = 2.0268e-3, 1.0688e-3, 6.9e6
FIVE = ((HEAD, TANK, 0), (SUPPLY, HEAD, 1), (HEAD, ROD, 2), (SUPPLY, ROD, 3), (ROD, TANK, 4))
FOUR_WAY = ((SUPPLY, HEAD, 0, 1), (ROD, TANK, 0, 1), (SUPPLY, ROD, 0, -1), (HEAD, TANK, 0, -1))
LIFT = ((SUPPLY, HEAD, 0), (ROD, HEAD, 1), (HEAD, TANK, 2))


def shipped_circuit(rig: str, cylinder: str) -> fn.Circuit:
    model = Model.of(shipped(rig))
    return circuit_of(model, model.layout.cylinders.index(cylinder))


def circuit(rows, areas=(A1, A2), ranges=(0.0, 10.0), law="compensated", gain=6.3e-5) -> fn.Circuit:
    """One cylinder with edges (from, to, valve, sign = 1, blocked = 0); 1 gpm/V or ``gain``."""
    edges = table(len(rows), EDGE)
    edges.law, edges.forward, edges.reverse = BY_NAME[law], -1, -1
    edges.gain, edges.deadband, edges.compensation_drop = gain, 1.0, 2e5
    for edge, row in zip(edges, rows, strict=True):
        a, b, valve, sign, blocked = (*row, 1, 0)[:5] if len(row) == 3 else (*row, 0)[:5]
        edge.from_node, edge.to_node, edge.valve = a, b, valve
        edge.sign, edge.blocked = sign, blocked
    valves = 1 + max(row[2] for row in rows)
    # pyrefly: ignore[bad-argument-count]
    return fn.circuit(0, *areas, edges, np.zeros(1), np.tile(ranges, (valves, 1)))


def able(c) -> set[str]:
    """Names of the working functions that a circuit can do."""
    return {name for name, can in zip(codes.FUNCTIONS, c.able, strict=True) if can}


def choose(c, rules, v_d, p_head, p_rod, now=codes.HOLD, age=1e9, p_supply=PS):
    load = p_head * c.area_head - p_rod * c.area_rod
    return fn.select(now, age, v_d, load, Pressures(p_head, p_rod, p_supply, 0.0), c, rules)


def test_the_table_balances_the_oil_and_says_what_is_drawn():
    """Q1 into the head end, Q2 out of the rod end, no path backwards at steady speed."""
    into_head = np.array([1, -1, 0, 0, -1, 1, 1, 0])
    out_of_rod = np.array([0, 0, -1, 1, -1, 1, 0, -1])
    for function in range(1, len(codes.FUNCTIONS)):
        assert into_head @ fn.PATH_FLOWS[function] == pytest.approx([1, 0], abs=0)
        assert out_of_rod @ fn.PATH_FLOWS[function] == pytest.approx([0, 1], abs=0)
        steady = fn.PATH_FLOWS[function] @ (fn.DIRECTION[function] * np.array([A1, A2]))
        assert (steady >= 0).all() and (steady > 0).sum() == 2
        assert steady[fn.METERING[function]] > 0
    assert not fn.PATH_FLOWS[codes.HOLD].any()
    c = circuit(FIVE)
    drawn = [fn.supply_draw(f, c) for f in range(len(codes.FUNCTIONS))]
    expected = [0, A1, A1, A1 - A2, A2, A2, 0, A1 - A2, 0, A1 - A2, 0, 0]
    assert drawn == pytest.approx(expected, abs=1e-18)


@pytest.mark.parametrize(
    ("rig", "cylinder", "expected", "one_command"),
    [
        ("thesis_arm", "boom", ALL, False),
        ("thesis_arm", "swing", PLAIN, True),
        ("boom_four_valve", "boom", PLAIN, False),
        ("crane_proportional", "lift", PLAIN, True),
        ("slide_servo", "press", PLAIN, True),
    ],
)
def test_what_the_shipped_rigs_can_do(rig, cylinder, expected, one_command):
    c = shipped_circuit(rig, cylinder)
    assert able(c) == expected
    moves = [1, 2, 4, 5] if one_command else []
    assert [f for f in range(8) if fn.coupled(c, f)] == moves


def test_what_other_circuits_can_do():
    assert able(circuit(FOUR_WAY, ranges=(-10.0, 10.0))) == PLAIN
    # a driver that never goes negative closes half of the spool
    assert able(circuit(FOUR_WAY)) == {"hold", *MOVES[:2]}
    # a cross-port check valve lets oil through one way only, an edge drawn the other way round
    # serves as well
    checked = (*FIVE[:2], (ROD, HEAD, 2, 1, 1), (ROD, SUPPLY, 3), FIVE[4])
    assert able(circuit(checked)) == ALL - {"retract_overrunning_regeneration"}
    # a spool that opens a third edge with the two of a function cannot do that function
    leaky = ((SUPPLY, HEAD, 0), (ROD, TANK, 0), (HEAD, TANK, 0), (SUPPLY, ROD, 1))
    assert able(circuit(leaky)) == {"hold"}
    # lifting on regeneration alone: no way from the rod end to tank
    crossed = ("extend_overrunning", "extend_resistive", "retract_overrunning")
    expected = {"hold", *(f"{name}_regeneration" for name in crossed)}
    assert able(circuit(LIFT)) == expected
    # single-acting: the other end breathes by an edge of its own, by that of the same command, or
    # by a check valve; not by one that opens the other way only
    vented = PLAIN - {"retract_resistive", "retract_overrunning"} | {"retract_overrunning_vented"}
    up, down = (SUPPLY, HEAD, 0), (HEAD, TANK, 0, -1)
    ends = {"ranges": (-10.0, 10.0)}
    assert able(circuit((up, down, (ROD, TANK, 1)), **ends)) == vented
    assert able(circuit((up, down, (ROD, TANK, 0, 1), (ROD, TANK, 0, -1)), **ends)) == vented
    assert able(circuit((up, down, (ROD, TANK, 0, 1), (TANK, ROD, -1)), **ends)) == vented
    assert able(circuit((up, down, (ROD, TANK, 0, 1)), **ends)) == {"hold", *MOVES[:2]}
    pulled = ((SUPPLY, ROD, 0), (ROD, TANK, 1), (TANK, HEAD, 2))
    assert able(circuit(pulled)) == {"hold", *MOVES[2:], "extend_overrunning_vented"}
    # of two valves on one path the larger one serves
    both = circuit((*FIVE, (SUPPLY, HEAD, 5)))
    assert both.paths[fn.SUPPLY_HEAD] == 1
    both.edges[5].gain *= 2
    again = fn.circuit(0, A1, A2, both.edges, both.maps, np.tile([0.0, 10.0], (6, 1)))
    assert again.paths[fn.SUPPLY_HEAD] == 5


GRID = [-2e4, 0.0, 1e5, 3.4e5, 1e6, 2e6, 4e6, 6.8e6, 8e6]
CIRCUITS = {
    "five": circuit(FIVE),
    "small cross-port": circuit(FIVE, gain=1.2e-5),
    "four": circuit((*FIVE[:2], *FIVE[3:])),
    "four-way": circuit(FOUR_WAY, ranges=(-5.0, 5.0), law="orifice"),
    "equal areas": circuit(FIVE, areas=(A1, A1)),
    "lift only": circuit(LIFT),
    "no head to tank": circuit(FIVE[1:]),
    "no supply to head": circuit((FIVE[0], *FIVE[2:])),
    "no rod to tank": circuit(FIVE[:4]),
}


@pytest.mark.parametrize(
    ("name", "lost", "instead"),
    [
        ("no head to tank", {4, 5, 6}, {codes.RETRACT_OVERRUNNING_THROUGH_ROD}),
        ("no supply to head", {1, 2, 3, 7}, {codes.EXTEND_RESISTIVE_FED_AT_ROD}),
        ("no rod to tank", {1, 2}, {codes.EXTEND_RESISTIVE_FED_AT_ROD}),
        ("five", set(), set()),
    ],
)
def test_a_circuit_that_lost_an_edge_goes_another_way(name, lost, instead):
    kept = set(range(8)) - lost
    assert able(CIRCUITS[name]) == {codes.FUNCTIONS[f] for f in kept | instead}


@pytest.mark.parametrize("name", ["no head to tank", "no supply to head", "no rod to tank"])
def test_a_spare_function_holds_its_planned_pressures(name):
    """The planned pressures balance the load, and oil runs along every path of the function."""
    c = CIRCUITS[name]
    rules = fn.pack_rules(A2, PS)
    (function,) = (f for f in fn.SPARE if c.able[f])
    load = 3e3
    plan = fn.planned(function, load, Pressures(2e6, 1e5, PS, 0.0), c, rules)
    assert plan.head * A1 - plan.rod * A2 == pytest.approx(load, rel=1e-12)
    for path in np.flatnonzero(fn.PATH_FLOWS[function].any(axis=1)):
        assert fn.path_drop(path, plan, c) > 0.0
    v_d = 0.02 * fn.DIRECTION[function]
    assert choose(c, rules, v_d, plan.head, plan.rod) == (function, codes.OK)
    heavy = 1.1 * PS * (A1 - A2)
    if function == codes.EXTEND_RESISTIVE_FED_AT_ROD:
        assert choose(c, rules, v_d, heavy / A1, 0.0) == (function, codes.STALLED)


@pytest.mark.parametrize("name", CIRCUITS)
@pytest.mark.parametrize("seventh", [False, True])
def test_every_state_has_one_function_and_it_suits(name, seventh):
    """Over directions, pressures, supplies, last functions, dwell: no gap, no contradiction."""
    c = CIRCUITS[name]
    rules = fn.pack_rules(c.area_rod, PS, allow_seventh=seventh)
    seen = set()
    speeds = (-0.2, -0.02, 0.0, 0.02, 0.2)
    grid = itertools.product(speeds, GRID, GRID, (1e6, PS), range(10), (0.0, 1e9))
    offered = [f for f in range(1, 10) if c.able[f] and (f != 7 or seventh)]
    for v_d, p_head, p_rod, p_supply, now, age in grid:
        if not c.able[now] or (now == 7 and not seventh):
            continue
        chosen, status = choose(c, rules, v_d, p_head, p_rod, now, age, p_supply)
        assert c.able[chosen]
        if v_d == 0.0:
            assert (chosen, status) == (codes.HOLD, codes.OK)
            continue
        load = p_head * c.area_head - p_rod * c.area_rod
        if chosen == codes.HOLD:
            assert status == codes.UNABLE
            lacking = [f for f in offered if fn.DIRECTION[f] * v_d > 0]
            if abs(load) > rules.force_band:
                assert all(fn.OVERRUNNING[f] != (-v_d * load > 0) for f in lacking)
            continue
        assert fn.DIRECTION[chosen] * v_d > 0
        if age == 0.0 and fn.DIRECTION[now] * v_d > 0:
            assert chosen == now
            continue
        seen.add(chosen)
        against = -np.sign(v_d) * load
        if abs(load) > rules.force_band:
            assert fn.OVERRUNNING[chosen] == (against > 0)
        state = (v_d, load, Pressures(p_head, p_rod, p_supply, 0.0), c, rules)
        kind = fn.DIRECTION[chosen], fn.OVERRUNNING[chosen]
        rivals = [f for f in offered if (fn.DIRECTION[f], fn.OVERRUNNING[f]) == kind]
        fit = [f for f in rivals if fn.feasible(f, f == now, *state)]
        assert status == (codes.OK if fit else codes.STALLED)
        draw = {f: fn.supply_draw(f, c) for f in rivals}
        assert draw[chosen] == (min(draw[f] for f in fit) if fit else max(draw.values()))
        if status == codes.OK and chosen in (3, 6):
            drop = p_rod - p_head if chosen == 3 else p_head - p_rod
            assert fn.capacity(c, fn.CROSS[chosen], drop) >= c.area_rod * abs(v_d)
    assert seen == {f for f in offered if f != 7 or c.area_head > c.area_rod}


# upstream and downstream end of the path that sets the motion of each function (thesis 3.1)
METERS = {1: "sh", 2: "rt", 3: "rh", 4: "sr", 5: "ht", 6: "ht", 7: "sh"}


@pytest.mark.parametrize("choice", fn.CHOICES)
@pytest.mark.parametrize("seventh", [False, True])
def test_what_is_called_ok_moves_oil_the_right_way(seventh, choice):
    """Over pressures from cavitation to beyond the supply, predecessors and dwell: OK only where
    the drop of the metering path is along the flow and the supply carries the load."""
    c = circuit(FIVE)
    rules = fn.pack_rules(A2, PS, allow_seventh=seventh, choice=choice)
    pressures, functions = np.linspace(-9e4, 7.2e6, 9), range(8 if seventh else 7)
    grid = itertools.product((-0.1, 0.1), pressures, pressures, functions, (0.0, 1e9))
    stalled = called = 0
    for v_d, p_head, p_rod, now, age in grid:
        chosen, status = choose(c, rules, v_d, p_head, p_rod, now, age)
        at = {"s": PS, "t": 0.0, "h": p_head, "r": p_rod}
        first, last = METERS[chosen]
        load = p_head * A1 - p_rod * A2
        against = chosen in (1, 4) and abs(load) >= PS * (A1 if chosen == 1 else A2)
        wrong = at[first] <= at[last] or against
        assert not (status == codes.OK and wrong), (v_d, p_head, p_rod, now, age, chosen)
        called += wrong
        stalled += status == codes.STALLED
    assert called > 50 and stalled >= called


def test_regeneration_needs_drop_and_an_edge_that_carries_it():
    rules = fn.pack_rules(A2, PS)
    wide, narrow = circuit(FIVE), circuit(FIVE, gain=1.2e-5)
    crossed = codes.RETRACT_OVERRUNNING_REGENERATION, codes.OK
    assert choose(wide, rules, -0.1, 2e6, 3e5) == crossed
    assert choose(narrow, rules, -0.1, 2e6, 3e5) == (codes.RETRACT_OVERRUNNING, codes.OK)
    assert choose(narrow, rules, -0.03, 2e6, 3e5) == crossed
    start, stop = rules.drop_start, rules.drop_stop
    for drop, now, expected in (
        (1.01 * start, 5, 6),
        (0.99 * start, 5, 5),
        (0.99 * start, 6, 6),
        (1.01 * stop, 6, 6),
        (0.99 * stop, 6, 5),
    ):
        assert choose(wide, rules, -0.02, 2e6, 2e6 - drop, now)[0] == expected


def test_the_seventh_where_the_supply_carries_the_load_on_the_area_difference():
    c = circuit(FIVE)
    rules = fn.pack_rules(A2, PS, allow_seventh=True)
    most = (PS - rules.supply_margin - rules.supply_band) * (A1 - A2) - rules.cross_drop * A2
    p_rod = 1e5
    for share, expected in (
        (0.99, codes.EXTEND_RESISTIVE_REGENERATION),
        (1.01, codes.EXTEND_RESISTIVE),
    ):
        p_head = (share * most + p_rod * A2) / A1
        assert choose(c, rules, 0.05, p_head, p_rod)[0] == expected
        assert choose(c, fn.pack_rules(A2, PS), 0.05, p_head, p_rod)[0] == codes.EXTEND_RESISTIVE
    # once begun it holds through the band
    p_head = (1.01 * most + p_rod * A2) / A1
    assert choose(c, rules, 0.05, p_head, p_rod, now=7)[0] == codes.EXTEND_RESISTIVE_REGENERATION


def test_a_load_beyond_the_supply_is_called_stalled():
    chosen = choose(circuit(FIVE), fn.pack_rules(A2, PS), 0.1, 1.02 * PS, 0.0)
    assert chosen == (codes.EXTEND_RESISTIVE, codes.STALLED)


def run(c, rules, v_d, p_head, p_rod, tick=1e-3, age=0.0):
    now, history = codes.HOLD, []
    for v, head, rod in np.broadcast(v_d, p_head, p_rod):
        chosen, _ = choose(c, rules, v, head, rod, now, age)
        age = tick if chosen != now else age + tick
        now = chosen
        history.append(now)
    return np.array(history)


def test_no_chatter_on_noisy_pressures():
    """Load and drop creep through their thresholds: as many switches as without noise."""
    rng, n = np.random.default_rng(5), 20_000
    c = circuit(FIVE)
    rod = np.full(n, 5e5)
    head = (np.linspace(-1500, 1500, n) + rod * A2) / A1
    noise = rng.normal(0.0, 1.0e4, (2, n))  # 0.15 % of supply, 23 N: band ±184 N is 8 sigma
    for v_d in (0.1, -0.1):
        rules = fn.pack_rules(A2, PS, dwell=0.0)
        quiet = run(c, rules, v_d, head, rod)
        noisy = run(c, rules, v_d, head + noise[0], rod + noise[1])
        assert (np.diff(noisy) != 0).sum() == (np.diff(quiet) != 0).sum() <= 3
        less = {"force_band": 0.0, "drop_stop": rules.drop_start, "reserve": 0.0}
        bare = fn.pack_rules(A2, PS, dwell=0.0, **less)
        assert (np.diff(run(c, bare, v_d, head + noise[0], rod + noise[1])) != 0).sum() > 20


@pytest.mark.parametrize(("speed", "passes"), [(0.05, True), (0.06, False)])
def test_a_load_within_its_band_keeps_only_what_passes_the_speed(speed, passes):
    """Out of the head end flow 9 V·gain·Δp/√(Δp² + Δp0²) = 1.11e-4 m³/s at 0.4 bar."""
    c, rules, p_head = CIRCUITS["four"], fn.pack_rules(A2, PS), 0.4e5
    overrunning, resistive = (
        codes.FUNCTIONS.index(f"retract_{w}") for w in ("overrunning", "resistive")
    )
    assert (A1 * speed < 1.11e-4) == passes
    now = overrunning
    for share, kept in ((0.9, True), (-0.9, passes), (0.9, passes), (1.1, True)):
        load = share * rules.force_band
        p = Pressures(p_head, (p_head * A1 - load) / A2, PS, 0.0)
        now, status = fn.select(now, 1e9, -speed, load, p, c, rules)
        assert (now, status) == (overrunning if kept else resistive, codes.OK)


def test_dwell_is_kept_but_for_a_change_of_direction():
    rng, n = np.random.default_rng(6), 5000
    c = circuit(FIVE)
    head, rod = rng.uniform(0.0, PS, (2, n))
    for dwell in (0.05, 0.2):
        history = run(c, fn.pack_rules(A2, PS, dwell=dwell, allow_seventh=True), 0.1, head, rod)
        gaps = np.diff(np.flatnonzero(np.diff(history)))
        assert gaps.size > 10 and gaps.min() >= round(dwell * 1000) - 1
    c = circuit(FIVE)
    rules = fn.pack_rules(A2, PS, dwell=10.0, speed_start=2e-3, speed_stop=1e-3)
    slow = [0.0, 0.0019, 0.0021, 0.0011, 0.0009, 0.0019, -0.0019]
    v_d = np.array([*slow, -0.05, 0.0015, 0.05, -0.05])
    way = fn.DIRECTION[run(c, rules, v_d, 2e6, 5e5)]
    assert way.tolist() == [0, 0, 1, 1, 0, 0, 0, -1, 0, 1, -1]


def test_head_and_rod_mirror():
    """Equal areas, ends exchanged, motion reversed: the mirrored function in every state."""
    mirror = {0: 0, 1: 4, 2: 5, 3: 6, 4: 1, 5: 2, 6: 3}
    c = circuit(FIVE, areas=(A1, A1))
    rules = fn.pack_rules(A1, PS)
    for v_d, p_head, p_rod, now in itertools.product((-0.1, 0.1), GRID, GRID, range(7)):
        if p_head != p_rod:  # the sign of no load is a matter of taste
            chosen = choose(c, rules, v_d, p_head, p_rod, now)[0]
            assert choose(c, rules, -v_d, p_rod, p_head, mirror[now])[0] == mirror[chosen]


@pytest.mark.parametrize(
    ("wrong", "key"),
    [
        ({"dwell": -1.0}, "negative_rule"),
        ({"reserve": np.nan}, "negative_rule"),
        ({"speed_start": 1e-5}, "stop_above_start"),
        ({"drop_start": 1e5, "drop_stop": 2e5}, "stop_above_start"),
        ({"cross_drop": np.inf}, "negative_rule"),
        ({"dwel": 0.2}, "unknown_rule"),
    ],
)
def test_rules_that_make_no_sense_are_refused(wrong, key):
    with refused(f"control.{key}"):
        fn.pack_rules(A2, PS, **wrong)


def test_circuits_that_are_none_are_refused():
    c = circuit(FIVE)
    ranges = np.tile([0.0, 10.0], (5, 1))
    with refused("control.no_edge"):
        fn.circuit(1, A1, A2, c.edges, c.maps, ranges)


def low_passed(c, rules, v_d, tick=1e-3, steady=True):
    """Functions chosen along desired speeds, at a load that rests on the head end."""
    slow = [0.0]
    for v in v_d:
        slow.append(fn.steady_reference(v, slow[-1], tick, rules) if steady else v)
    return run(c, rules, slow[1:], 2e6, 5e5, tick, age=1e9)


def test_a_noisy_speed_changes_nothing_and_a_wish_acts_at_once():
    """0.2 mm/s rms about speeds from rest to beyond where a motion begins: no more than one change
    a second, where the bare speed makes hundreds."""
    c, rules, rng = circuit(FIVE), fn.pack_rules(A2, PS), np.random.default_rng(7)
    for mean in (0.0, 1e-4, -2e-4, 3e-4):
        v_d = mean + rng.normal(0.0, 2e-4, 2000)
        assert (np.diff(low_passed(c, rules, v_d)) != 0).sum() <= 2
    bare = low_passed(c, rules, rng.normal(0.0, 2e-4, 1000), steady=False)
    assert (np.diff(bare) != 0).sum() > 200
    c, rules = circuit(FIVE), fn.pack_rules(A2, PS)
    steps = [0.0, 2e-3, 2e-3, 0.0, -2e-3, 2e-3]
    assert fn.DIRECTION[low_passed(c, rules, steps)].tolist() == [0, 1, 1, 0, -1, 1]
    turned = low_passed(c, rules, np.concatenate([np.full(300, 5e-4), np.full(300, -5e-4)]))
    way = fn.DIRECTION[turned]
    assert np.argmax(way == 1) < 30 and np.argmax(way[300:] == -1) <= 60
    # one that grows as a motion begins, 6 m/s³: the way that is lost is less than a sensor's count
    v_d = 3.0 * (1e-3 * np.arange(40)) ** 2
    late = [np.argmax(low_passed(c, rules, v_d, steady=on) != 0) for on in (True, False)]
    assert v_d[late[1] : late[0]].sum() * 1e-3 < 1e-5


def following(**numbers) -> fn.Circuit:
    """The five cartridges on a supply that follows the load."""
    supply = table(1, SUPPLY_LINE)
    for name, value in {"pressure": PS, **numbers}.items():
        supply[name] = value
    return circuit(FIVE)._replace(supply=supply)


def test_least_power_counts_what_the_pumps_give():
    """Costs [J/m] in closed form: p·(A1, A2, A1 − A2 or 0) at the pressure of the supply in use."""
    pressures = {"low_pressure": 3e5, "cross_drop": 3e5, "allow_seventh": True}
    rules = fn.pack_rules(A2, PS, **pressures)
    load, margin, rail = 2000.0, 1e6, 0.4 * PS
    heads = {1: (load + 3e5 * A2) / A1, 7: (load + 3e5 * A2) / (A1 - A2)}
    draws = {1: A1, 7: A1 - A2}
    costs = {
        "constant": lambda p: PS,
        "sensing": lambda p: min(p + margin, PS),
        "rails": lambda p: rail if p + 5e5 <= rail else PS,
    }
    kinds = {
        "constant": following(),
        "sensing": following(margin=margin),
        "rails": following(rail=rail, rail_margin=5e5),
    }
    at = Pressures(heads[1], 3e5, PS, 0.0)
    found = {}
    for kind, c in kinds.items():
        for function, head in heads.items():
            plan = fn.planned(function, load, at, c, rules)
            assert plan.head * A1 - plan.rod * A2 == pytest.approx(load, rel=1e-12)
            wanted = draws[function] * costs[kind](head)
            assert fn.pump_force(function, plan, c) == pytest.approx(wanted, rel=1e-12)
        least = fn.pack_rules(
            A2, PS, low_pressure=3e5, cross_drop=3e5, allow_seventh=True, choice="least_power"
        )
        found[kind], status = choose(c, least, 0.03, heads[1], 3e5)
        assert status == codes.OK
    # the low rail carries the load on the whole piston, regeneration would need the high one
    crossed, plain = codes.EXTEND_RESISTIVE_REGENERATION, codes.EXTEND_RESISTIVE
    assert found == {"constant": crossed, "sensing": crossed, "rails": plain}
    assert choose(kinds["rails"], rules, 0.03, heads[1], 3e5)[0] == found["constant"]


def test_least_power_keeps_what_is_at_work_within_its_band():
    rules = fn.pack_rules(A2, PS, low_pressure=3e5, cross_drop=3e5, choice="least_power")
    c = circuit(FIVE)
    head = (3000.0 + 3e5 * A2) / A1
    assert choose(c, rules, -0.03, head, 3e5)[0] == codes.RETRACT_OVERRUNNING_REGENERATION
    # too fast for the cross-port edge, to begin and to stay
    most = fn.capacity(c, fn.HEAD_ROD, head - 3e5) / A2
    for share, now, expected in (
        (0.9, codes.RETRACT_OVERRUNNING, codes.RETRACT_OVERRUNNING),
        (0.9, codes.RETRACT_OVERRUNNING_REGENERATION, codes.RETRACT_OVERRUNNING_REGENERATION),
        (1.1, codes.RETRACT_OVERRUNNING_REGENERATION, codes.RETRACT_OVERRUNNING),
    ):
        assert choose(c, rules, -share * most, head, 3e5, now)[0] == expected


def test_a_load_sensing_pump_is_counted_on_before_it_is_up():
    """At its margin above tank it stands below the load; what counts is what it can bring."""
    c, rules = following(margin=1e6), fn.pack_rules(A2, PS)
    assert choose(c, rules, 0.05, 3e6, 3e5, p_supply=1e6) == (codes.EXTEND_RESISTIVE, codes.OK)
    assert choose(circuit(FIVE), rules, 0.05, 3e6, 3e5, p_supply=1e6)[1] == codes.STALLED
    at = Pressures(3e6, 3e5, 1e6, 0.0)
    assert fn.path_drop(fn.SUPPLY_HEAD, at, c) == pytest.approx(1e6)
    assert fn.path_drop(fn.SUPPLY_HEAD, at._replace(head=PS - 4e5), c) == pytest.approx(4e5)
