"""Numbers of a pump, its check valves and an accumulator come back from simulated, noisy logs."""

from functools import cache

import numpy as np
import pytest

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.plant.model import simulate
from tests.shared import shipped, started_off

RIG = shipped("pump_cylinder")
NOISE = {"v": 1e-3, "p_head": 6e3, "p_rod": 6e3, "x": 1e-5, "p_supply": 6e2}


def driven_to(limit: float) -> Rig:
    """The rig with a drive that gives no more than a command [V]."""
    plain = RIG.as_toml()
    (cylinder,) = plain["cylinder"]
    cylinder["valve"] = [one | {"drive_limit": f"{limit} V"} for one in cylinder["valve"]]
    return Rig.model_validate(plain)


# samples: the end of the first command, begin and end of the second, the end of the log
LONG, SHORT = (600, 1000, 1500, 1801), (350, 500, 800, 901)


@cache
def logs(
    limit: float | None = None, ends: tuple[int, int, int, int] = LONG, pairs: int = 1
) -> list[tuple[str, Record]]:
    """Up and down, down and up, of a drive that may give no more than a command [V].

    Slip lets the load sink from the first sample on, so the commands begin there: a start is the
    mean of what is at rest."""
    made, rig = [], RIG if limit is None else driven_to(limit)
    first = 6.0 if limit is None else 0.6 * limit  # what is told of a limit alone, a gain might be
    stop, begin, end, samples = ends
    for seed, (payload, way) in enumerate(((None, 1.0), ("150 kg", -1.0)) * pairs):
        u = np.zeros(samples)
        u[5:stop], u[begin:end] = first * way, -7.0 * way
        clean = simulate(rig, {"lift.drive": u}, 1e-3 * (samples - 1), payload=payload)
        rng, channels = np.random.default_rng(seed), {"lift.drive.command": u}
        for name, values in clean.channels.items():
            if std := NOISE.get(name.rsplit(".", 1)[-1]):
                channels[name] = values + std * rng.standard_normal(values.size)
        made.append((f"log {seed}", Record(clean.t, channels, clean.meta)))
    return made


@pytest.mark.slow
@pytest.mark.parametrize(
    ("factors", "ends", "pairs"),
    [
        # of these, several short logs tell as much as two long ones, or more, in less steps
        ({"lift.pump.displacement": 1.5, "lift.pump.slip": 2.0}, SHORT, 3),
        ({"bulk_modulus": 0.5, "table.damping": 2.0, "lift.pump.slip": 2.0}, SHORT, 2),
        ({"lift.check_rod.orifice_gain": 0.5}, SHORT, 1),
        ({"supply.gas_volume": 2.0}, SHORT, 1),
    ],
    ids=lambda given: ", ".join(given) if isinstance(given, dict) else "",
)
def test_a_start_far_off_comes_back_within_its_interval(factors, ends, pairs):
    comes_back(RIG, logs(None, ends, pairs), factors)


@pytest.mark.slow
def test_what_a_drive_gives_at_most_comes_back():
    """Full at 5 of the 7 V that are commanded."""
    factors = {"lift.drive.drive_limit": 0.7, "lift.pump.displacement": 1.5}
    comes_back(driven_to(5.0), logs(5.0, SHORT), factors)


def comes_back(rig: Rig, given: list[tuple[str, Record]], factors: dict[str, float]) -> None:
    """Fail unless parameters, started that many times off, come back from some logs."""
    fit, known = started_off(rig, given, factors)
    for name, truth in known.items():
        found = fit[name]
        assert found.status in ("estimated", "correlated")
        assert found.start == factors[name] * truth
        # four standard errors: one parameter in 16 000 fails by chance
        assert abs(found.value - truth) < 4.0 * found.std, found
        assert found.std < 0.05 * truth
