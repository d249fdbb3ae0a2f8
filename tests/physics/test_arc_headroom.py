"""Adaptive robust control raises the off-side where an edge would not carry what is to come."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ehbench.control.arc import ARC, Choice, carried, provide_headroom
from ehbench.control.functions import METERING, SUPPLY_HEAD
from ehbench.control.measured import Pressures
from ehbench.control.oil_learning import BACK, MORE
from ehbench.control.trajectory import V, speeds_soon, with_preview
from ehbench.data.flowmeter import read_flowmeter
from ehbench.flow_maps.tables import fit_edge, prepare_readings
from ehbench.physics.flow_map import collect
from ehbench.trial import prepare, run
from ehbench.vocabulary.codes import FUNCTIONS, SATURATED
from tests.shared import RECIPES, cycle, shipped

ARM = shipped("thesis_arm")
LOW = float(ARM.supply.pressure) / 20.0


@cache
def maps():
    """The edge from supply to head passes a tenth more at 15 bar than at 50; so shall the rod's."""
    readings = read_flowmeter(RECIPES.parent / "datasets" / "thesis_arm" / "flowmeter" / "hepc.csv")
    (edge,) = prepare_readings(ARM, [readings]).edges
    one = fit_edge(ARM, edge)
    return collect([one.map, replace(one.map, valve="repc")])


def prepared(payload=None, machine=None, rig=ARM, supply=None, **gains):
    """A fast cycle of the boom on the model of a machine whose flow may lack."""
    move = {"hold": "0.6 s", "acceleration": "1 m/s^2", "jerk": "20 m/s^3"}
    given = {"machine": machine or {}, "payload": payload}
    given |= {} if supply is None else {"supply": supply}
    way = "boom", ["50 mm", "200 mm", "50 mm"], "180 mm/s"
    recipe = cycle(*way, gains=gains, move=move, **given)
    return prepare(recipe, rig, maps() if rig is ARM else None)


@cache
def ran(payload, reserve, flow):
    """A run with the default reserve, or with a given one."""
    given = {} if reserve is None else {"flow_reserve": reserve}
    return run(prepared(payload, {"flow": flow} if flow != 1.0 else {}, **given))


@pytest.mark.parametrize("payload", [None, "50 lb"])
def test_a_motion_that_the_edge_would_not_carry_is_followed(payload):
    """With 10 % less flow than known the edge gives 176 of 180 mm/s at its plain drop."""
    with_it, without = (ran(payload, given, 0.9).facts.measures for given in (None, 0.0))
    assert with_it["limit_cycle"] is None
    assert without["short"] is not None and with_it["short"] is None
    assert with_it["tracking"]["max_error"] < 0.3 * without["tracking"]["max_error"]
    assert with_it["tracking"]["max_error"] < 0.5e-3
    with_it, without = (ran(payload, given, 1.0).record for given in (None, 0.0))
    for name in ("boom.x", "boom.hepc.command", "boom.pressure_set"):
        assert with_it[name].tobytes() == without[name].tobytes()


def test_room_is_made_ahead_and_the_pump_gives_no_more_for_it():
    """The off-side is up before the edge is at its end, or its oil would slow the motion."""
    record, plain = (ran(None, given, 0.9).record for given in (None, 0.0))
    raised = np.flatnonzero(record["boom.pressure_set"] > 2.0 * LOW)
    ended = np.flatnonzero(plain["boom.limits"].astype(int) & SATURATED)
    moving = ended[plain["boom.v_desired"][ended] > 0.1]
    assert plain.t[moving[0]] - record.t[raised[0]] > 0.05
    assert record["boom.pressure_set"].max() < 0.4 * record["p_supply"].max()
    down = record["boom.v_desired"] < 0.0
    assert record["boom.pressure_set"][down].max() < 3.0 * LOW

    # At constant pressure a stroke takes the same oil, whatever stands in the other chamber
    def energy(record):
        return float(np.sum(record["flow_supply"] * record["p_supply"]))

    with_it, without = (energy(ran(None, given, 0.9).record) for given in (None, 0.0))
    assert with_it == pytest.approx(without, rel=0.02)


class Still:
    """A steady motion under a load [N] by a working function, as `provide_headroom` sees it."""

    def __init__(self, trial, function, load):
        self.law = trial.loop.laws[0].afresh().controller
        self.circuit = self.law.axis.circuit
        pressure = float(trial.rig.supply.pressure)
        self.p = Pressures(0.5 * pressure, 0.1 * pressure, pressure, 1e5)
        self.choice = Choice(FUNCTIONS.index(function), 0, load, False, 0.0, False)

    def plan(self, smaller=0.0):
        """(off-side pressure [Pa] for a drop smaller by so much [Pa], the largest speed [m/s])."""
        circuit, path, load = self.circuit, METERING[self.choice.function], self.choice.load
        head, rod = circuit.area_head, circuit.area_rod
        low = self.p.tank + float(self.law.gains.low_pressure)
        if path == SUPPLY_HEAD:
            filled, area, other = (load + low * rod) / head, head, rod
        else:
            filled, area, other = (low * head - load) / rod, rod, head
        drop = self.p.supply - filled - smaller
        return low + smaller * area / other, carried(path, drop, circuit) / area

    def raised(self, least, largest, lacks=0.0):
        """What `provide_headroom` writes [Pa] where a share of the flow lacks."""
        memory = self.law.memory
        memory.oil.estimates[MORE] = memory.oil.estimates[BACK] = lacks
        provide_headroom(
            self.choice, (least, largest), self.p, self.circuit, self.law.gains, memory
        )
        return float(memory.state.raised)


@pytest.mark.parametrize(
    ("function", "load", "way"), [("extend_resistive", 3e3, 1), ("retract_resistive", -2e3, -1)]
)
def test_what_is_raised(function, load, way):
    """As the speed that is wanted lies between those of the two ends."""
    still = Still(prepared(), function, load)

    def raised(speed, lacks=0.0):
        return still.raised(min(way * speed, 0.0), max(way * speed, 0.0), lacks)

    (low, plain), (high, wide) = still.plan(), still.plan(ARC.smaller * still.p.supply)
    more, most = 1.0 + float(still.law.gains.flow_reserve), high - low
    assert wide > 1.02 * plain
    assert raised(0.999 * plain / more) == 0.0
    between = 0.5 * (plain + wide) / more
    assert raised(between) == pytest.approx(0.5 * most)
    # what lacks counts as if so much more were wanted, what is too much for as much less
    assert raised(0.9 * between, 0.1) == pytest.approx(0.5 * most)
    assert raised(between, -0.1) == 0.0
    assert raised(10.0) == pytest.approx(most)
    assert raised(-10.0) == 0.0


def test_who_gets_nothing_raised():
    """An orifice, an edge that does not meter, a pump that keeps the drop, no reserve."""
    four = shipped("boom_four_valve")
    assert Still(prepared(rig=four), "extend_resistive", 3000.0).raised(0.0, 10.0) == 0.0
    for function in ("hold", "extend_overrunning", "retract_overrunning"):
        assert Still(prepared(), function, -3000.0).raised(-10.0, 10.0) == 0.0
    sensing = prepared(supply={"load_sensing": {"load_margin": "1 MPa", "load_lag": "50 ms"}})
    assert Still(sensing, "extend_resistive", 3000.0).raised(0.0, 10.0) == 0.0
    off = Still(prepared(flow_reserve=0.0), "extend_resistive", 3000.0)
    assert off.raised(0.0, 10.0) == 0.0


def test_a_preview_tells_the_least_and_the_largest_speed_to_come():
    rng = np.random.default_rng(5)
    table, tick = rng.standard_normal((400, 4)), 1e-3
    for ahead in (0.0, 3e-3, ARC.preview, 5.0):
        wide, span = with_preview(table, table[:, V], ahead, tick), round(ahead / tick) + 1
        assert np.array_equal(wide[:, :4], table)
        for i in (0, 7, 120, 398, 399):
            soon = table[i : i + span, V]
            assert speeds_soon(wide[i]) == (soon.min(), soon.max())
    assert speeds_soon(table[3]) == (table[3, V], table[3, V])
    joints = np.hstack([table, rng.standard_normal((400, 12))])
    assert speeds_soon(joints[3]) == (table[3, V], table[3, V])
    wide = with_preview(joints, table[:, V], ARC.preview, tick)
    assert speeds_soon(wide[3]) == (table[3:154, V].min(), table[3:154, V].max())
