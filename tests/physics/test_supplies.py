"""Supplies that follow the load: pressures in closed form, ledgers that close, the bench too."""

import numpy as np
import pytest

import ehbench
from ehbench.config.rig import LoadSensing, LowRail, Rig
from ehbench.data.record import Record
from ehbench.ledger import bounds, ledger_of_log, ledger_of_model
from ehbench.machines.virtual import VirtualMachine
from ehbench.plant.model import Model
from ehbench.vocabulary.errors import InputError, InsufficientData
from ehbench.vocabulary.fields import Value
from tests.shared import shipped

SLIDE = shipped("slide_servo")
SET = float(SLIDE.supply.pressure)
MARGIN, LAG, RAIL = 1.5e6, 0.05, 0.4 * SET
SENSING = SLIDE.with_supply(
    load_sensing=LoadSensing(load_margin=Value(MARGIN), load_lag=Value(LAG))
)
RAILS = SLIDE.with_supply(low_rail=LowRail(rail_pressure=Value(RAIL), rail_margin=Value(1e6)))
TANK = float(SLIDE.supply.tank_pressure)


def moved(rig: Rig, volts: float = 2.0, rest: float = 0.1) -> Record:
    """0.4 s of a slide: at rest, out, and at rest again."""
    t = np.arange(401) / 1000.0
    command = np.where((t >= rest) & (t < 0.3), volts, 0.0)
    return ehbench.simulate(rig, {"press.servo": command}, 0.4, posture={"press": "50 mm"})


@pytest.fixture(scope="module")
def sensing() -> Record:
    return moved(SENSING)


@pytest.fixture(scope="module")
def rails() -> Record:
    return moved(RAILS)


def test_the_pressure_follows_the_load_with_its_lag(sensing):
    """ṗ = (p_head + margin − p)/lag while open, exact for a load pressure that runs straight."""
    p, head, tick = sensing["p_supply"], sensing["press.p_head"], 1e-3
    assert p[:100] == pytest.approx(TANK + MARGIN, rel=1e-9)
    at = slice(102, 300)  # the spool has left its overlap
    wanted, keep = head + MARGIN, np.exp(-tick / LAG)
    slope = np.diff(wanted)[at] / tick
    ahead = wanted[1:][at] - LAG * slope
    expected = ahead + (p[:-1][at] - wanted[:-1][at] + LAG * slope) * keep
    assert p[1:][at] == pytest.approx(expected, abs=2e-3 * MARGIN)
    assert 0.5 < (p[250] - head[250]) / MARGIN < 1.5


def test_a_spool_that_has_all_but_closed_senses_nothing():
    """The line's oil stays as it is once no more than a trickle would reach it, whatever the steps:
    felt to the last it rose by 2.1 bar in chosen ones."""
    command = np.where((np.arange(1501) >= 100) & (np.arange(1501) < 500), 2.0, 0.0)
    press = {"posture": {"press": "50 mm"}}
    chosen, fine = (
        ehbench.simulate(SENSING, {"press.servo": command}, 1.5, step=step, **press)["p_supply"]
        for step in ("auto", 2.5e-5)
    )
    assert chosen[700:] == pytest.approx(chosen[700], rel=1e-6)
    assert chosen == pytest.approx(fine, abs=2e-3 * MARGIN)


def test_the_pressure_stays_below_the_pumps_and_no_oil_flows_back():
    margin = Value(0.95 * (SET - TANK))
    high = SLIDE.with_supply(load_sensing=LoadSensing(load_margin=margin, load_lag=Value(0.005)))
    p = moved(high, rest=0.02)["p_supply"]
    assert p.max() == pytest.approx(SET, rel=1e-3)
    # A valve opens on a chamber above the pump: nothing passes until the pressure is there
    model = Model.of(SENSING)
    y = model.trim(model.posture({"press": "50 mm"}), 4e6)
    table = np.full((60, 1), 1.0)
    record = model.record(np.arange(60) / 1000.0, table, model.run(y, table))
    flow, drop = record["press.servo_supply_head.flow"], record["p_supply"] - record["press.p_head"]
    assert drop[0] < 0.0 < drop[-1]
    assert (flow[drop < 0.0] == 0.0).all() and flow[-1] > 0.0


def test_an_edge_takes_from_the_rail_that_is_high_enough(rails):
    """Flow by the orifice's own law at the low rail's drop; the high pump then gives nothing."""
    flow, head = rails["press.servo_supply_head.flow"], rails["press.p_head"]
    low = head + 1e6 <= RAIL
    out = (rails.t > 0.15) & (rails.t < 0.29)
    assert low[out].all()
    gain = float(SLIDE.parameters()["press.servo_supply_head.flow_gain"])
    wanted = gain * rails["press.servo.opening"] * np.sqrt(RAIL - head)
    assert flow[out] == pytest.approx(wanted[out], rel=1e-3)
    assert rails["flow_supply"][out] == pytest.approx(0.0, abs=1e-12)
    loaded = ehbench.simulate(RAILS, {"press.servo": 6.0}, 0.1, posture={"press": "50 mm"})
    high = loaded["press.p_head"] + 1e6 > RAIL
    assert high.any() and (loaded["flow_supply"][high] > 0.0).all()


@pytest.mark.parametrize("kind", ["sensing", "rails"])
def test_the_ledger_closes_and_pays_each_oil_at_its_pressure(kind, request):
    record = request.getfixturevalue(kind)
    rig = SENSING if kind == "sensing" else RAILS
    ledger = ledger_of_model(Model.of(rig), record)
    assert abs(ledger.residual.energy) < 2e-3 * ledger.pump
    drawn = record["press.servo_supply_head.flow"]
    if kind == "sensing":
        power = record["p_supply"] * record["flow_supply"]
    else:
        head = record["press.p_head"]
        power = np.where(head + 1e6 <= RAIL, RAIL, record["p_supply"]) * drawn
    assert ledger.pump == pytest.approx(np.trapezoid(power, record.t), rel=5e-3)
    constant = ledger_of_model(Model.of(SLIDE), moved(SLIDE))
    paid = ledger.pump / np.trapezoid(drawn, record.t)
    assert paid < 0.6 * constant.pump / constant.oil_drawn
    with pytest.raises(InsufficientData, match="has not one pressure"):
        bounds(rig, record, "press", ledger)


def test_the_low_rail_has_rows_of_its_own():
    """Its pressure times the oil taken from it; the pump's row is the rest; each store closes."""
    t = np.arange(401) / 1000.0
    command = np.where(t < 0.2, 4.0, -4.0)
    record = ehbench.simulate(RAILS, {"press.servo": command}, 0.4, posture={"press": "100 mm"})
    given = 0.0
    for end in ("head", "rod"):
        flow, p = record[f"press.servo_supply_{end}.flow"], record[f"press.p_{end}"]
        given += np.trapezoid(np.where(p + 1e6 <= RAIL, RAIL * flow, 0.0), t)
    by_model = ledger_of_model(Model.of(RAILS), record)
    by_log = ledger_of_log(RAILS, None, record, accuracy=None)
    assert 0.2 * by_model.pump < given < 0.9 * by_model.pump
    for ledger, close in ((by_model, 2e-3), (by_log, 2e-2)):
        assert ledger.low_rail == pytest.approx(given, rel=0.02)
        assert ledger.pump == pytest.approx(ledger["pump"].energy + ledger["low_rail"].energy)
        assert ledger["low_rail_compression"].energy > 0.0
        for part in (row for row in ledger.rows if row.group == "part"):
            assert abs(part.energy) < close * ledger.pump, part.name
    own = record["p_supply"] * record["flow_supply"]
    assert by_model["pump"].energy == pytest.approx(np.trapezoid(own, record.t), rel=0.01)
    assert ledger_of_model(Model.of(SLIDE), moved(SLIDE)).low_rail is None


def test_a_recording_replays_on_its_own_supply(sensing):
    """The set pressure of a load-sensing pump is not that at which a recording begins."""
    again = Model.of(SENSING).replay(sensing)
    assert again["p_supply"] == pytest.approx(sensing["p_supply"], abs=1e-3 * MARGIN)
    assert SENSING.parameters()["supply.load_margin"].value == MARGIN
    wider = SENSING.with_values({"supply.load_margin": 2.0 * MARGIN})
    assert Model.of(wider).plant.supply.margin == 2.0 * MARGIN


@pytest.mark.parametrize(("rig", "most"), [(SENSING, 0.3 * SET), (RAILS, SET)])
def test_the_virtual_bench_has_them_too(rig, most):
    bench = VirtualMachine(rig)
    sample = bench.start({"press": "50 mm"})
    rows = [sample.copy()]
    for _ in range(300):
        rows.append(bench.tick(np.array([2.0])).copy())
    names = list(bench.channels)
    p, head = (np.array(rows)[:, names.index(name)] for name in ("p_supply", "press.p_head"))
    assert p.max() < 1.05 * most
    if rig is SENSING:
        assert p[0] == pytest.approx(TANK + MARGIN, abs=0.01 * SET)
        assert p[250:] - head[250:] == pytest.approx(MARGIN, abs=0.04 * SET)
    assert head[-1] > 2e5


def test_what_does_not_go_together_is_refused():
    for load, low, word in (
        ({"load_margin": 2.0 * SET}, None, "margin of load sensing"),
        ({"load_margin": 1e6, "load_lag": 0.0}, None, "lag of load sensing"),
        (None, {"rail_pressure": 2.0 * SET, "rail_margin": 1e6}, "low rail"),
        ({"load_margin": 1e6}, {"rail_pressure": 5e6, "rail_margin": 1e6}, "omit one"),
    ):
        given = [
            kind(**{name: Value(value) for name, value in numbers.items()}) if numbers else None
            for kind, numbers in ((LoadSensing, load), (LowRail, low))
        ]
        with pytest.raises(InputError, match=word):
            SLIDE.with_supply(*given)
