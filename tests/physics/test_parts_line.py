"""A line between valves and chamber: closed forms, its energy, linear models, what refuses it."""

import numpy as np
import pytest
from plant_differences import plant_model
from with_parts import books, jacobian, moved, point_of, ringing, slide, steps, swing

from ehbench.config.rig import Rig
from ehbench.control.law import DesignPoint
from ehbench.control.registry import LAWS
from ehbench.data.record import Record
from ehbench.ledger import ledger_of_model
from ehbench.machines.virtual import VirtualMachine
from ehbench.parts.edge.orifice import root
from ehbench.parts.line import LINE, Line, drop_for, line_conductance
from ehbench.plant.design_point import circuit_of
from ehbench.plant.model import Model, simulate
from ehbench.runtime.compiled import table_of
from ehbench.tune.linear import development_model
from ehbench.tune.operating_point import state_of
from tests.shared import refused

LAMINAR = {"end": "head", "volume": "0.4 L", "resistance": "0.3 bar*min/L"}
TURBULENT = {"end": "rod", "volume": "0.25 L", "orifice_gain": "15 L/min/bar^0.5"}
HOSE = TURBULENT | {"resistance": "0.1 bar*min/L", "bulk_modulus": "500 MPa"}


def lined(*lines: dict) -> Rig:
    """The sliding mass with lines at its cylinder."""
    return slide(line=tuple(Line.model_validate(line) for line in lines))


def row(**given: float) -> np.record:
    return table_of([given], LINE)[0]


@pytest.mark.parametrize("drop", [1e3, 2e5, -3e6])
def test_a_line_is_a_resistance_and_an_orifice_in_series(drop):
    def flow(**given: float) -> float:
        return drop * line_conductance(drop, row(**given))

    assert flow(resistance=2e9) == pytest.approx(drop / 2e9, rel=1e-14)
    gain = 8e-7
    assert flow(choke=gain**-2) == pytest.approx(np.sign(drop) * gain * root(abs(drop)), rel=1e-14)
    both = row(resistance=2e9, choke=gain**-2)
    passed = drop * line_conductance(drop, both)
    assert drop_for(passed, both) == pytest.approx(drop, rel=1e-12)
    if abs(drop) > 1e5:  # above the range in which the square is turned linear
        assert 2e9 * passed + passed * abs(passed) / gain**2 == pytest.approx(drop, rel=1e-2)


def test_a_line_evens_out_against_its_chamber_at_its_own_rate():
    """Beside a mass that does not move: ``(β_l/V_l + β/V)/R``."""
    rig = lined(LAMINAR | {"bulk_modulus": "500 MPa"}).with_values({"carriage.mass": 1e12})
    model = Model.of(rig)
    oil, end = model.plant.cylinders[0], model.plant.cylinders[0].volume_head
    resistance = float(rig.parameters()["press.line_head.resistance"])
    volume = end + 0.5 * oil.area_head * oil.stroke
    rate = (5e8 / 4e-4 + oil.bulk_modulus / volume) / resistance
    rates = -np.linalg.eigvals(jacobian(model)).real
    assert rates[np.argmin(np.abs(rates - rate))] == pytest.approx(rate, rel=1e-6)


@pytest.mark.parametrize("open_wide", [True, False])
def test_the_oil_of_a_wide_line_belongs_to_its_chamber_and_that_of_a_tight_one_does_not(open_wide):
    """``ω² = (β A1²/(V1 + V_l β/β_l) + β A2²/V2)/m``, without V_l where the line is tight."""
    given = LAMINAR | {"resistance": "1e5 Pa*s/m^3" if open_wide else "1e15 Pa*s/m^3"}
    rigs = (lined(given | {"bulk_modulus": "500 MPa"}), slide())
    model, bare = (Model.of(rig.with_values({"carriage.damping": 0.0})) for rig in rigs)
    oil = bare.plant.cylinders[0]
    extra = 4e-4 * oil.bulk_modulus / 5e8 if open_wide else 0.0
    longer = bare.rig.with_values({"press.volume_head": float(oil.volume_head) + extra})
    omega = np.sqrt(swing(Model.of(longer)) / 250.0)
    assert ringing(model, omega) == pytest.approx(omega, rel=1e-4)


def test_a_steady_flow_loses_its_pressure_in_the_lines():
    """At a lasting speed ``Δp = R A1 v`` in, ``A2 v = k √Δp`` out."""
    rig = lined(LAMINAR, TURBULENT).with_values({"carriage.damping": 2e4})
    record = simulate(rig, {"press.servo": 2.0}, 0.6, posture={"press": "100 mm"})
    last = {name: values[-1] for name, values in record.channels.items()}
    head, rod = rig.cylinder[0].areas()
    parameters = {name: float(value) for name, value in rig.parameters().items()}
    assert abs(last["press.v"] - record["press.v"][-20]) < 1e-4 * last["press.v"]
    inward = parameters["press.line_head.resistance"] * head * last["press.v"]
    assert last["press.p_line_head"] - last["press.p_head"] == pytest.approx(inward, rel=1e-3)
    drop = last["press.p_rod"] - last["press.p_line_rod"]
    passed = parameters["press.line_rod.orifice_gain"] * root(drop)
    assert passed == pytest.approx(rod * last["press.v"], rel=1e-3)


@pytest.mark.parametrize("lines", [(LAMINAR,), (LAMINAR, HOSE)])
def test_the_ledger_closes_with_lines(lines):
    """To what RK4 leaves over, as without; ``R ∫ Q² dt`` is lost, ``V u(p)`` stored."""
    rig = lined(*lines)
    record = moved(rig)
    kept = ("press.line_head.throttling", "press.line_head")
    ledger = books(rig, record, *kept, closed=1e-6)
    resistance = float(rig.parameters()["press.line_head.resistance"])
    through = (record["press.p_line_head"] - record["press.p_head"]) / resistance
    lost = np.trapezoid(resistance * through**2, record.t)
    assert ledger["press.line_head.throttling"].energy == pytest.approx(lost, rel=1e-3)
    assert ledger["press.line_head.throttling"].energy > 0.02 * ledger.pump


def test_without_lines_there_are_no_rows_and_a_law_of_the_cylinder_refuses_them():
    record = simulate(slide(), {"press.servo": 2.0}, 0.1)
    rows = ledger_of_model(Model.of(slide()), record).rows
    assert not [line.name for line in rows if "line_head" in line.name or "line_rod" in line.name]
    assert not [name for name in record.channels if "p_line" in name]
    site = DesignPoint(None, 1e-3, 1e7, 1e-3, 0.0, unmodelled=lined(LAMINAR).cylinder[0].unmodelled)
    with refused("control.arc_lacks_part"):
        LAWS["arc"].pack(site, {}, None, None)


def test_a_small_line_behind_a_small_resistance_is_seen_by_the_guard():
    """20 mL over 1e8 Pa·s/m³ even out within 2 µs: they might as well be the chamber's."""
    tiny = {"end": "head", "volume": "20 mL", "resistance": "1e8 Pa*s/m^3"}
    whole = float(slide().cylinder[0].volume_head) + 2e-5
    rigs = lined(tiny), slide().with_values({"press.volume_head": whole})
    commands = {"press.servo": steps((2.0,))[350:600]}
    found = [simulate(rig, commands, 0.249)["press.v"] for rig in rigs]
    assert np.abs(found[0] - found[1]).max() < 2e-3 * np.abs(found[1]).max()


def test_a_record_starts_its_lines_at_their_chambers():
    """A log with the pressures at the valve block alone is replayed from them."""
    rig = lined(LAMINAR, HOSE)
    model = Model.of(rig)
    record = simulate(rig, {"press.servo": steps((3.0, -2.0))[:601]}, 0.6)
    again = model.replay(record)
    assert np.allclose(again["press.p_line_rod"], record["press.p_line_rod"], rtol=1e-9)
    kept = {k: v for k, v in record.channels.items() if k not in ("press.p_head", "press.p_rod")}
    at_block = model.replay(Record(record.t, kept, record.meta))
    assert np.allclose(at_block["press.v"], record["press.v"], atol=1e-9)
    start = model.trim(model.posture(None))
    assert start[model.layout.state("p_line_head")] == start[model.layout.state("p_head")]


@pytest.mark.parametrize("function", [1, 3])
def test_a_linear_model_has_the_line(function):
    """From the equations as from differences of the plant; the point is a steady motion."""
    model = Model.of(lined(LAMINAR, HOSE))
    function = int(np.flatnonzero(circuit_of(model, 0).able)[function // 2 + 1])
    point = point_of(model, function, speed=0.1)
    assert point.possible, point.note
    y, command = state_of(model, point)
    log = model.run(y, np.tile(command, (100, 1)))
    at = [model.layout.state(name) for name in ("p_head", "p_rod", "p_line_head", "p_line_rod")]
    assert np.abs(log[5, at] - y[at]).max() < 2e-3 * y[at].max()  # volumes move on
    equations, differences = development_model(model, point), plant_model(model, point)
    assert equations.states == differences.states and "press.p_line_rod" in equations.states
    scale = np.ones(len(equations.states))
    scale[1:5] = 1e6
    for name in ("a", "b"):
        mine, its = getattr(equations, name), getattr(differences, name)
        ratio = scale / scale[:, None] if name == "a" else 1.0 / scale[:, None]
        assert np.allclose(mine * ratio, its * ratio, rtol=2e-4, atol=1e-3), name


def test_the_virtual_bench_has_the_line_too():
    machine = VirtualMachine(lined(LAMINAR), seed=1)
    machine.start()
    plain = VirtualMachine(slide(), seed=1)
    plain.start()
    at, end = (machine.model.layout.state(name) for name in ("p_line_head", "p_head"))
    assert machine.state[at] == pytest.approx(machine.state[end], rel=1e-3)
    for _ in range(40):
        machine.tick(np.array([3.0]))
        plain.tick(np.array([3.0]))
    assert machine.state[at] > machine.state[end] + 1e5
    own = [m.state[m.model.layout.state("qd")] for m in (machine, plain)]
    assert 0.0 < own[0] < own[1]
