"""A machine that is not its design: each change does what it says, and nothing else."""

import numpy as np
import pytest

from ehbench.config.recipe import TrialRecipe
from ehbench.machines.registry import open_machine
from ehbench.parts.edge import edge_flow
from ehbench.parts.sample import OF, entry
from ehbench.parts.valve import valve_lag
from ehbench.vocabulary.errors import InputError
from tests.shared import RECIPES, shipped

# a rig whose bench file says its friction and oil, and one whose bench draws them
RIGS = {"thesis_arm": "boom", "crane_proportional": "lift"}
CHANGES = {"valve_lag": 2.0, "bulk_modulus": 0.5, "friction": 3.0, "flow": 0.9, "deadband": "0.3 V"}
CHANGES |= {"supply_pressure": 0.8, "delay": "5 ms", "pressure_lag": "10 ms"}


def machine(name, on, change):
    """The machine of a trial on a rig after a change."""
    motion = {"kind": "velocity_steps", "cylinder": RIGS[name], "levels": ["10 %"]}
    given = {"stage": "trial", "rig": "x.toml", "on": on, "machine": change}
    given |= {"bench": f"bench/{name}.toml"} if on == "bench" else {}
    given |= {"motion": motion | {"duration": "1 s"}, "controller": {"kind": "open_loop"}}
    recipe = TrialRecipe.model_validate(given | {"path": RECIPES / "trial.toml"})
    return open_machine(recipe, shipped(name), None)


def plant_of(one):
    return one.bench if hasattr(one, "bench") else one.model.plant


def flows(one, shift=0.0):
    """Flow [m³/s] of every edge at rising openings, ``shift`` [V] wider, and two drops."""
    command = np.linspace(0.2, 0.9, 8) * one.commands.highest.max() + shift
    drops = (1.0e6, 3.0e6)
    if hasattr(one, "static_flow"):
        edges = one.layout.edges
        return np.array([one.static_flow(e, command, drop) for e in edges for drop in drops])
    plant = one.model.plant
    pairs = [(edge, drop) for edge in plant.edges for drop in drops]
    return np.array([[edge_flow(d, u, edge, plant.maps) for u in command] for edge, d in pairs])


def facts(one):
    """What a change may do, by its key."""
    plant = plant_of(one)
    rows = plant.cylinders
    return {
        "valve_lag": np.array([valve_lag(row, plant) for row in plant.valves]),
        "bulk_modulus": np.array(rows.bulk_modulus),
        "friction": np.array([rows.friction_coulomb, rows.friction_viscous]),
        "flow": flows(one),
        "supply_pressure": np.array([plant.supply.pressure]),
        "delay": np.array([one.latency]) if hasattr(one, "bench") else np.array(plant.valves.delay),
        "pressure_lag": np.array(plant.sensors.lag) if hasattr(one, "bench") else np.zeros(1),
    }


@pytest.fixture(scope="module", params=[(n, on) for n in RIGS for on in ("model", "bench")])
def as_it_is(request):
    """(rig, where, machine without a change)."""
    name, on = request.param
    return name, on, machine(name, on, {})


@pytest.mark.parametrize("key", CHANGES)
def test_a_change_does_what_it_says_and_nothing_else(as_it_is, key):
    name, on, plain = as_it_is
    if on == "model" and key == "pressure_lag":
        with pytest.raises(InputError, match="the sensors of the model are exact"):
            machine(name, on, {key: CHANGES[key]})
        return
    changed = machine(name, on, {key: CHANGES[key]})
    before, after = facts(plain), facts(changed)
    if key == "deadband":
        # but for what a shut spool leaks
        assert np.allclose(flows(changed, 0.3), before.pop("flow"), rtol=1e-9, atol=1e-8)
        assert (np.abs(after.pop("flow")) < np.abs(flows(plain))).any()
    elif key == "delay":
        assert after["delay"] - before.pop("delay") == pytest.approx(5e-3)
        if on == "model":  # a valve's delay is one of its lags
            after["valve_lag"] = after["valve_lag"] - 5e-3
        rest, late = trace(plain), trace(changed)
        assert np.allclose(late[5:], rest[:-5], rtol=0.0, atol=1e-9)
        assert np.ptp(rest) > 1e-3
    elif key == "pressure_lag":
        later = after["pressure_lag"] - before.pop("pressure_lag")
        assert set(np.round(later, 12)) == {0.0, 0.01}
        assert np.count_nonzero(later) == 2 * len(plain.strokes) + 2
    else:
        assert np.allclose(after[key], CHANGES[key] * before.pop(key), rtol=1e-9), key
    for other, value in before.items():
        assert np.allclose(after[other], value, rtol=1e-12), other


def trace(one):
    """Angle [rad] of the first cylinder's joint while its first valve opens."""
    one.start()
    command = one.commands.rest.copy()
    command[0] = one.commands.highest[0]
    at = entry(0, OF.q)
    return np.array([one.tick(command)[at] for _ in range(300)])
