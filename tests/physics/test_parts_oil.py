"""Oil with free air: softer as its pressure falls, energy that closes, and what logs tell of it."""

import numpy as np
import pytest
from plant_differences import plant_model
from scipy.integrate import solve_ivp
from with_parts import books, moved, point_of, recovered, ringing

from ehbench.config.recipe import BenchRecipe
from ehbench.config.rig import Rig
from ehbench.ledger import ledger_of_log
from ehbench.machines.virtual import VirtualMachine
from ehbench.parts.oil import ATMOSPHERE, bulk, bulk_of, compressed, stored
from ehbench.plant.model import Model
from ehbench.tune.linear import development_model
from ehbench.vocabulary.fields import Value
from tests.shared import slide


def airy() -> Rig:
    """The sliding mass on oil with free air."""
    rig = slide()
    update = {"air_fraction": Value(0.02), "polytropic_exponent": Value(1.3)}
    return rig.model_copy(update={"oil": rig.oil.model_copy(update=update)})


def test_the_energy_of_compression_obeys_the_chamber_law():
    """``β(p) du/dp = p + u`` from u(0) = 0, against an integrator at 1e-12; without air the old
    closed form to the last bit."""
    row = Model.of(airy()).plant.supply
    for end in (2.5e7, 3e6, 1e5, -5e4, -8.9e4):
        found = solve_ivp(
            lambda p, u: (p + u) / bulk_of(row, p), (0.0, end), [0.0], rtol=1e-12, atol=1e-9
        )
        assert stored(row, end) == pytest.approx(found.y[0, -1], rel=1e-9)
    plain = Model.of(slide()).plant.supply
    assert stored(plain, 1e7) == compressed(1e7, plain.bulk_modulus)
    assert bulk_of(plain, 1e7) == plain.bulk_modulus
    p = 5e6 + ATMOSPHERE
    softer = 1.0 / 9e8 + 0.02 / (1.3 * p) * (ATMOSPHERE / p) ** (1.0 / 1.3)
    assert bulk(5e6, 9e8, 0.02, 1.3) == pytest.approx(1.0 / softer, rel=1e-14)


def test_a_load_rings_on_the_oil_as_stiff_as_its_pressures_make_it():
    """Valves shut: ``ω² = (β(p1) A1²/V1 + β(p2) A2²/V2)/m``; softer than without air."""
    model = Model.of(airy().with_values({"carriage.damping": 0.0}))
    row, y = model.plant.cylinders[0], model.trim(model.posture(None))
    x, spring = 0.5 * row.stroke, 0.0
    for key, area, volume in (
        ("p_head", row.area_head, row.volume_head + row.area_head * x),
        ("p_rod", row.area_rod, row.volume_rod - row.area_rod * x),
    ):
        spring += bulk_of(row, y[model.layout.state(key)]) * area**2 / volume
    omega = np.sqrt(spring / 250.0)
    assert ringing(model, omega) == pytest.approx(omega, rel=1e-5)
    assert bulk_of(row, 1e6) < 0.8 * row.bulk_modulus


def test_the_ledger_closes_with_air():
    record = moved(airy())
    kept = ("pump", "pump_compression", "supply_line", "press.head", "press.rod")
    ledger = books(airy(), record, *kept, share=2e-3)
    # oil of one stiffness would keep another energy in its chambers
    wrong = ledger_of_log(slide(), None, record)["press.head"].energy
    assert abs(wrong - ledger["press.head"].energy) > 1e-4 * ledger.pump


def test_a_design_and_the_virtual_bench_take_the_air():
    """The development model against differences of the plant, as without air."""
    model = Model.of(airy())
    point = point_of(model, speed=0.1)
    ours, plant = development_model(model, point).a, plant_model(model, point).a
    for side in (1, 2):
        assert np.allclose(ours[side, :3], plant[side, :3], rtol=1e-6)
    own = BenchRecipe(stage="bench", rig="", air_fraction="0.4 %")
    for recipe, share in ((None, 0.02), (own, 0.004)):
        assert VirtualMachine(airy(), recipe).bench.fluid.air == pytest.approx(share)
    assert VirtualMachine(slide()).bench.fluid.air == 0.003


@pytest.mark.slow
def test_air_comes_back_from_noisy_logs():
    """Share of air and bulk modulus together, started 2 and 0.7 times off."""
    recovered(airy(), {"air_fraction": 2.0, "bulk_modulus": 0.7})
