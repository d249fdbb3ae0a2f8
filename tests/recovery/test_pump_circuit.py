"""Numbers of a pump, its check valves and an accumulator come back from simulated, noisy logs."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from ehbench.identification.hydraulics import FitOptions, identify_hydraulics
from ehbench.plant.model import simulate
from ehbench.recipe import load_rig
from ehbench.record import Record

RIG = load_rig(Path(__file__).parents[2] / "recipes" / "rigs" / "pump_cylinder.toml")
NOISE = {"v": 1e-3, "p_head": 6e3, "p_rod": 6e3, "x": 1e-5, "p_supply": 6e2}


@cache
def logs() -> list[tuple[str, Record]]:
    """Up and down, down and up. Slip lets the load sink from the first sample on, so the commands
    begin there: a start is the mean of what is at rest.
    """
    made = []
    for seed, (payload, way) in enumerate(((None, 1.0), ("150 kg", -1.0))):
        u = np.zeros(1801)
        u[5:600], u[1000:1500] = 6.0 * way, -7.0 * way
        clean = simulate(RIG, {"lift.drive": u}, 1.8, payload=payload)
        rng, channels = np.random.default_rng(seed), {"lift.drive.command": u}
        for name, values in clean.channels.items():
            if std := NOISE.get(name.rsplit(".", 1)[-1]):
                channels[name] = values + std * rng.standard_normal(values.size)
        made.append((f"log {seed}", Record(clean.t, channels, clean.meta)))
    return made


@pytest.mark.slow
@pytest.mark.parametrize(
    "factors",
    [
        {"lift.pump.displacement": 1.5, "lift.pump.slip": 2.0},
        {"bulk_modulus": 0.5, "table.damping": 2.0, "lift.pump.slip": 2.0},
        {"lift.check_rod.orifice_gain": 0.5},
        {"supply.gas_volume": 2.0},
    ],
    ids=lambda factors: ", ".join(factors),
)
def test_a_start_far_off_comes_back_within_its_interval(factors):
    known = {name: float(RIG.parameters()[name]) for name in factors}
    start = {name: known[name] * factor for name, factor in factors.items()}
    fit = identify_hydraulics(RIG, logs(), list(factors), FitOptions(start=start))
    for name, truth in known.items():
        found = fit[name]
        assert found.status in ("estimated", "correlated") and found.start == start[name]
        # four standard errors: one parameter in 16 000 fails by chance
        assert abs(found.value - truth) < 4.0 * found.std, found
        assert found.std < 0.05 * truth
