"""Numbers of single parts come back, started 1.5 to 2 times off, with intervals that cover."""

from typing import Any

import numpy as np
import pytest

from ehbench.config.rig import Rig
from ehbench.plant.model import simulate
from tests.shared import slide, started_off
from tools.virtual_logs import noisy

NOISE = {"qd": 5e-4, "v": 5e-4, "p_head": 3e3, "p_rod": 3e3, "q": 1e-5, "x": 1e-5}
NOISE |= dict.fromkeys(("command", "p_supply", "p_tank"), 0.0)


def held(rig: Rig, factors: dict[str, float], drives: list[np.ndarray]) -> list[bool]:
    """Fit logs from starts ``factors`` off: whether each interval holds the truth."""
    logs = []
    for i, u in enumerate(drives):
        record = simulate(rig, {"press.servo": u}, (u.size - 1) / 1000)
        logs.append((f"log {i}", noisy(record, i, noise=NOISE)))
    fit, truth = started_off(rig, logs, factors)
    for name, value in truth.items():
        assert fit[name].status == "estimated", fit[name]
        assert fit[name].std < 0.1 * value, fit[name]
    return [fit[n].interval[0] <= value <= fit[n].interval[1] for n, value in truth.items()]


def wave(volts: float, period: float, samples: int) -> np.ndarray:
    t = np.arange(samples) * 1e-3
    return volts * np.sin(2 * np.pi * t / period)


SEALS: dict[str, Any] = {"friction_viscous": "300 N*s/m", "friction_coulomb": "200 N"}
BREAKS = {"friction_static": "400 N", "stribeck_speed": "20 mm/s"}
BRISTLES = {"bristle_stiffness": "2000 N/mm", "bristle_damping": "8000 N*s/m"}
STRIBECK = {"press.friction_static": 1.6, "press.stribeck_speed": 0.6}
LUGRE = {"press.bristle_stiffness": 2.0, "press.bristle_damping": 0.5}
FRICTIONS = {"stribeck": (BREAKS, STRIBECK), "lugre": (BREAKS | BRISTLES, STRIBECK | LUGRE)}


AMPLIFIER, BUS = {"amplifier": {"lag": "8 ms"}}, {"bus": {"delay": "7.3 ms"}}
FAST, SLOW = (
    {"spool": {"natural_frequency": f"{hertz} Hz", "damping_ratio": 0.8}} for hertz in (80, 30)
)
SERIES = {"amplifier.lag": 0.5, "spool.natural_frequency": 1.6}
VALVES = {
    "first_order": (AMPLIFIER, {"amplifier.lag": 1.8}),
    "delay": (BUS | FAST, {"bus.delay": 1.8}),
    "series": (AMPLIFIER | SLOW, SERIES),
}


def valve_with(dynamics: dict[str, Any]) -> Rig:
    """The sliding mass with other elements in series in its valve."""
    kinds = {"lag": "first_order", "delay": "delay"}
    made = {
        name: {"kind": next((kinds[key] for key in table if key in kinds), "second_order")} | table
        for name, table in dynamics.items()
    }
    plain = slide(**SEALS).as_toml() | {"dynamics": made}
    plain["cylinder"][0]["valve"][0]["dynamics"] = list(dynamics)
    return Rig.model_validate(plain)


def jumps(volts: float, hold: int = 100, samples: int = 801) -> np.ndarray:
    levels = np.random.default_rng(5).uniform(-volts, volts, samples // hold + 1)
    levels[0] = 0.0
    return np.repeat(levels, hold)[:samples]


@pytest.mark.parametrize("case", VALVES)
def test_valves(case):
    dynamics, factors = VALVES[case]
    assert all(held(valve_with(dynamics), factors, [jumps(3.0), -jumps(2.0, hold=61)]))


SHORT = [jumps(3.0, 60, 201), -jumps(2.0, 41, 201)]
LINES = [
    {"end": "head", "volume": "0.4 L", "resistance": "0.3 bar*min/L"},
    {"end": "rod", "volume": "0.25 L", "orifice_gain": "15 L/min/bar^0.5"},
]


@pytest.mark.slow
def test_lines():
    """Of pressures in the chambers alone."""
    factors = {"press.line_head.volume": 1.8, "press.line_head.resistance": 0.5}
    factors |= {"press.line_rod.orifice_gain": 1.7}
    assert all(held(slide(**SEALS, line=LINES), factors, SHORT))


def test_mounts():
    mount = {"stiffness": "12 kN/mm", "damping": "15 kN*s/m"}
    factors = {"press.mount.stiffness": 1.7, "press.mount.damping": 0.6}
    assert all(held(slide(**SEALS, mount=mount), factors, SHORT))


@pytest.mark.slow
@pytest.mark.parametrize("law", FRICTIONS)
def test_friction(law):
    table, factors = FRICTIONS[law]
    rig = slide(**SEALS, friction={"law": law} | table)
    drives = [wave(0.3, 0.6, 801), wave(-0.15, 0.1, 401), wave(0.12, 0.04, 201)]
    assert all(held(rig, factors, drives))
