"""What the tests of a rig's parts share: a rig with a part, its linear form, noise, a fit."""

from dataclasses import replace

import numpy as np
import pytest
from plant_differences import plant_model

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.ledger import Ledger, ledger_of_log, ledger_of_model
from ehbench.ledger.loads import Loads
from ehbench.ledger.model_account import states_of
from ehbench.ledger.quadrature import flows_at, powers_at
from ehbench.ledger.sheet import Sheet
from ehbench.parts.cylinder import chamber_oil
from ehbench.plant.derivatives import derivatives
from ehbench.plant.design_point import circuit_of
from ehbench.plant.integrate import STEP
from ehbench.plant.model import Model, simulate
from ehbench.plant.valves import acting_commands
from ehbench.tune.linear import development_model
from ehbench.tune.operating_point import Aim, equivalent, operating_point, state_of
from tests.shared import measured, started_off

LEVELS = (1.0, 2.0, 5.0, -2.0, -6.0, 3.5, -3.0)  # [V]
NOISE = {"v": 1e-3, "qd": 1e-3, "p_head": 6e3, "p_rod": 6e3, "x": 1e-5, "q": 1e-5, "p_supply": 6e3}


def jacobian(model: Model) -> np.ndarray:
    """∂ẏ/∂y at rest at mid-stroke by central differences."""
    y = model.trim(model.posture(None))
    command, work = model.rest_commands(1)[0], np.empty(model.plant.at.work)
    columns = []
    for i in range(y.size):
        rates = []
        h = 1e-6 * max(abs(y[i]), 1e-1)
        for sign in (1.0, -1.0):
            moved, dy = y.copy(), np.empty_like(y)
            moved[i] += sign * h
            derivatives(moved, command, model.plant, dy, work)
            rates.append(dy)
        columns.append((rates[0] - rates[1]) / (2.0 * h))
    return np.array(columns).T


def linear_models_agree(rig: Rig, way: int, own: dict[str, float]) -> None:
    """Fail unless equations and differences give one linear model with the states ``own``, of
    these sizes [SI], about a steady motion."""
    model = Model.of(rig)
    circuit = circuit_of(model, 0)
    point = point_of(model, int(np.flatnonzero(circuit.able)[1 + way]), speed=0.1)
    assert point.possible, point.note
    y, command = state_of(model, point)
    dy = np.empty_like(y)
    derivatives(y, command, model.plant, dy, np.empty(model.plant.at.work))
    for name, size in {"qd": 1.0, **own}.items():
        assert abs(dy[model.layout.state(name)]) < 1e-6 * max(size, 1.0), name
    equations, differences = development_model(model, point), plant_model(model, point)
    assert equations.states == differences.states
    assert equations.states[3 : 3 + len(own)] == tuple(f"press.{name}" for name in own)
    scale = np.ones(len(equations.states))
    scale[1 : 3 + len(own)] = 1e6, 1e6, *own.values()
    mine, its = (one.a * scale / scale[:, None] for one in (equations, differences))
    assert (np.abs(mine - its) <= 1e-4 * np.abs(mine).max(axis=1, keepdims=True)).all()
    assert np.allclose(equations.b, differences.b, rtol=1e-5, atol=1e-3)


def swing(model: Model) -> float:
    """Stiffness [N/m] of the oil of both shut chambers at mid-stroke: ``β A1²/V1 + β A2²/V2``."""
    row = model.plant.cylinders[0]
    x = 0.5 * row.stroke
    ends = row.area_head**2 / chamber_oil(row, 0, x) + row.area_rod**2 / chamber_oil(row, 1, x)
    return row.bulk_modulus * ends


def ringing(model: Model, near: float) -> float:
    """[rad/s] of the ringing nearest to a frequency."""
    rings = np.abs(np.linalg.eigvals(jacobian(model)).imag)
    return float(rings[np.argmin(np.abs(rings - near))])


def point_of(model: Model, function: int = 1, low: float = 5e5, cross: float = 5e5, **aim):
    """The operating point of the first cylinder at 0.2 m."""
    here = equivalent(model, 0, np.array([0.2]))
    return operating_point(model, circuit_of(model, 0), function, here, 0, Aim(low, cross, **aim))


def moved(rig: Rig, **more: np.ndarray) -> Record:
    """The press to and fro for 0.8 s, with other channels played beside it."""
    return simulate(rig, {"press.servo": steps((4.0, -5.0, 2.0))[:801]} | more, 0.8)


def closes(ledger: Ledger, share: float = 1e-5) -> None:
    """Fail unless no part, nor the residual, holds more than a share of pump energy."""
    for row in ledger.rows:
        if row.group in ("part", "residual"):
            assert abs(row.energy) < share * ledger.pump, row


def books(rig: Rig, record: Record, *names: str, share: float = 1e-3, closed: float = 1e-5):
    """The ledger of a record on its model, which closes; of the record as a log rows agree."""
    ledger, of_log = ledger_of_model(Model.of(rig), record), ledger_of_log(rig, None, record)
    assert ledger.pump > 500.0
    closes(ledger, closed)
    for name in names:
        exact = pytest.approx(ledger[name].energy, abs=share * ledger.pump)
        assert of_log[name].energy == exact, name
    return ledger


def noisy(record: Record, seed: int) -> Record:
    """What sensors would say of a simulated log."""
    return measured(record, seed, NOISE, drop=("p_line_head", "p_line_rod"))


def steps(levels: tuple[float, ...] | np.ndarray, hold: int = 150) -> np.ndarray:
    """Commands [V]: rest, each level for so many samples, rest."""
    return np.concatenate([np.zeros(400), np.repeat(levels, hold), np.zeros(50)])


def recovered(rig: Rig, factors: dict[str, float], accuracy: float = 0.05) -> None:
    """Fail unless parameters come back from two noisy logs, held by intervals over two draws."""
    made = []
    for sign in (0.9, 1.1):
        table = steps(sign * np.array(LEVELS))
        made.append(simulate(rig, {"press.servo": table}, 1e-3 * (table.size - 1)))
    held = []
    for seed in range(2):
        logs = [(f"log {i}", noisy(log, 10 * seed + i)) for i, log in enumerate(made)]
        fit, truth = started_off(rig, logs, factors)
        for name, value in truth.items():
            low, high = fit[name].interval
            assert fit[name].status == "estimated", fit[name]
            assert fit[name].std < accuracy * abs(value), fit[name]
            held.append(low <= value <= high)
    # of four intervals of 95 %, more than one misses once in seventy
    assert held.count(False) <= 1, held


def sampled(model: Model, record: Record) -> dict[str, np.ndarray]:
    """Energies [J] by row of a ledger, cumulated: trapezoids of the powers at the samples."""
    t, plant = record.t, model.plant.at_pressures(tank=record["p_tank"][0])
    first = [record[f"{name}.opening"][0] for name in model.layout.valves]
    before = np.where(model.plant.valves.delay > 0.0, first, model.plant.valves.before)
    plant, tick = plant.commanded_before(before), t[1] - t[0]
    states, commands = states_of(model, record)
    tank, sheet = np.full(t.size, plant.tank_pressure), Sheet(model, "residual")
    flows = np.empty((t.size, len(model.layout.edges) + 1))
    power, spent = np.empty((t.size, sheet.powers)), np.zeros((t.size, sheet.powers))
    acting = acting_commands(plant, commands, tick, tick / max(1, round(tick / STEP)))
    flows_at(states, acting, tank, plant, flows)
    powers_at(states, commands, flows, tank, plant, sheet.owner, power)
    np.cumsum(0.5 * (power[1:] + power[:-1]) * np.diff(t)[:, None], axis=0, out=spent[1:])
    stored = Loads.of(record).stored(replace(model, plant=plant), t, states, sheet.stores)
    names = [name for name, *_ in sheet.every]
    table = sheet.expand(np.concatenate([spent, stored], axis=1))
    return dict(zip(names, table.T, strict=True))
