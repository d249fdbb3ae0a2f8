"""More freedom never ends worse than less, and a parameter is told by its whole range."""

import math
from functools import partial

import numpy as np
import pytest

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.identification.hydraulics import FitOptions, identify_hydraulics
from ehbench.plant.model import simulate
from tests.shared import shipped
from tools import virtual_logs

NOISE = {"v": 1e-3, "p_head": 6e3, "p_rod": 6e3, "x": 1e-5, "command": 0.0, "p_supply": 0.0}
noisy = partial(virtual_logs.noisy, noise=NOISE)


def pulses(samples: int, size: float) -> np.ndarray:
    t = np.arange(samples) / samples
    out, back = (t > 0.1) & (t < 0.3), (t > 0.55) & (t < 0.75)
    return size * (1.0 * out - 1.0 * back)


def compensated(drop: float) -> Rig:
    """The sliding mass behind compensators, all of one drop but the first, of this one [Pa]."""
    plain = shipped("slide_servo").as_toml()
    for k, edge in enumerate(plain["cylinder"][0]["valve"][0]["edge"]):
        edge.pop("flow_gain")
        own = f"{drop if k == 0 else 2e5} Pa"
        edge |= {"law": "compensated", "compensated_gain": "8 L/min/V", "compensation_drop": own}
    return Rig.model_validate(plain)


DROP = "press.servo_supply_head.compensation_drop"


@pytest.mark.parametrize(("truth", "start"), [(2e5, 1e5), (6e6, 1e5)])
def test_a_compensators_drop_is_told_by_its_range(truth, start):
    """Below every drop of the logs it changes nothing, and is known to be so low."""
    made = simulate(compensated(truth), {"press.servo": pulses(801, 2.0)}, 0.8)
    given = FitOptions(
        start={DROP: start, "bulk_modulus": 7e8}, lower={DROP: 2e4}, upper={DROP: 1.2e7}, workers=1
    )
    fit = identify_hydraulics(
        compensated(truth), [("log", noisy(made, 1))], ["bulk_modulus", DROP], given
    )
    found = fit[DROP]
    low, high = found.interval
    assert found.status == "estimated" and low <= truth <= high < 1.0e7
    if truth < 1e6:
        assert found.error_from == "range" and low == 2e4
        assert found.std == pytest.approx((high - low) / (2.0 * 1.96), rel=1e-3)
        assert any(DROP in text and "deny the rest" in text for text in fit.warnings)
    else:
        assert found.value == pytest.approx(truth, rel=0.02)
    assert fit["bulk_modulus"].value == pytest.approx(9e8, rel=0.01)


def test_a_damping_is_told_by_its_range_where_it_rings_on():
    """A start a thousand times too low damps nothing, and a little more as little."""
    name = "carriage.damping"
    rig = shipped("slide_servo").with_values({name: 60.0})
    made = simulate(rig, {"press.servo": pulses(1001, 2.0)}, 1.0)
    given = FitOptions(start={name: 0.05}, lower={name: 0.01}, workers=1)
    fit = identify_hydraulics(rig, [("log", noisy(made, 2))], ["bulk_modulus", name], given)
    assert fit[name].status == "estimated"
    assert fit[name].interval[0] <= 60.0 <= fit[name].interval[1] < 100.0
    assert min(fit.logs[0].fit_percent.values()) > 90.0


@pytest.mark.parametrize("truth", [4e-4, 9e-4])
def test_a_parameter_that_its_range_alone_tells_needs_no_other(truth):
    """A limit of the pump, looked for on a coarse grid alone from where it does nothing: one that
    the flow just reaches lies between two points of the grid, where it is found; of one that it
    never reaches the range is told."""
    name = "supply.flow_limit"
    rig = shipped("slide_servo").with_values({name: truth})
    levels = np.repeat([0.0, 1.0, 2.0, 5.0, -2.0, -6.0, 3.5, -3.0, 0.0], 150)
    logs = [
        (f"log {i}", noisy(simulate(rig, {"press.servo": f * levels}, 1e-3 * (levels.size - 1)), i))
        for i, f in enumerate((0.9, 1.1))
    ]
    given = FitOptions(start={name: 8e-4}, upper={name: 3.2e-3}, workers=1)
    found = identify_hydraulics(rig, logs, [name], given)[name]
    low, high = found.interval
    assert found.status == "estimated" and low <= truth <= high
    if truth < 5e-4:
        assert high - low < 0.01 * truth and found.value == pytest.approx(truth, rel=5e-3)
    else:
        assert found.error_from == "range" and low > 5e-4 and high == 3.2e-3


def test_no_product_has_a_parameter_that_ran_into_its_bound():
    """Where it is taken for known, what the logs know of others is no scale of it."""
    made = simulate(shipped("slide_servo"), {"press.servo": pulses(401, 2.0)}, 0.4)
    asked = ["bulk_modulus", "press.volume_head", "press.volume_rod"]
    found = {}
    for upper in (4e9, 8e8):
        given = FitOptions(
            start={"bulk_modulus": 6e8}, lower={"bulk_modulus": 1e8}, upper={"bulk_modulus": upper}
        )
        rig = shipped("slide_servo")
        found[upper] = identify_hydraulics(rig, [("log", noisy(made, 4))], asked, given)
    assert any("bulk_modulus" in one.powers for one in found[4e9].groups)
    assert found[8e8]["bulk_modulus"].status == "at_bound"
    assert not any("bulk_modulus" in one.powers for one in found[8e8].groups)


def misfit(fit) -> float:
    """What fits make least: logarithms of what is left of the channels, pooled over the logs."""
    squares: dict[str, float] = {}
    for log in fit.logs:
        for channel, left in log.residual_rms.items():
            squares[channel] = squares.get(channel, 0.0) + left**2
    return sum(math.log(one) for one in squares.values())


@pytest.mark.slow
def test_more_freedom_ends_no_worse_on_a_model_that_does_not_hold():
    """However started, a part of the parameters never follows the log better than all."""
    plain = shipped("slide_servo").as_toml()
    for edge in plain["cylinder"][0]["valve"][0]["edge"]:
        edge |= {"law": "saturating", "opening_max": "1.5 V"}
    values = {"bulk_modulus": 3e8, "carriage.damping": 2500.0, "press.friction_coulomb": 500.0}
    true = Rig.model_validate(plain).with_values(values)
    made = noisy(simulate(true, {"press.servo": pulses(401, 3.5)}, 0.4), 3)
    late = {
        c: np.concatenate([y[:1]] * 8 + [y[:-8]]) for c, y in made.channels.items() if "p_" in c
    }
    log = Record(made.t, made.channels | late, made.meta)
    start = {"press.servo_rod_tank.flow_gain": 2.73e-8, "bulk_modulus": 1.76e9}
    start |= {"carriage.damping": 364.0, "spool.natural_frequency": 458.0}
    machine, last = shipped("slide_servo"), math.inf
    for count in (3, 4):
        some = list(start)[:count]
        given = FitOptions(start={n: start[n] for n in some}, workers=1)
        now = misfit(identify_hydraulics(machine, [("log", log)], some, given))
        # what the two settled solutions may differ by at the same place
        assert now < last + 0.01, (count, now, last)
        last = now
