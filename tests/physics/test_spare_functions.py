"""The boom with a cartridge out of service: the four that are left move it as far as they can."""

import numpy as np
import pytest

from ehbench.config.recipe import Motion, TrialRecipe, load_recipe, load_rig
from ehbench.data import read_log
from ehbench.ledger import ledger_of_model
from ehbench.plant.model import Model
from ehbench.trial.preparation import prepare
from ehbench.trial.running import run
from ehbench.vocabulary.codes import (
    EXTEND_RESISTIVE_FED_AT_ROD,
    HOLD,
    RETRACT_OVERRUNNING_THROUGH_ROD,
    RETRACT_OVERRUNNING_VENTED,
)
from tests.shared import ROOT, refused, shipped


@pytest.mark.parametrize(
    ("valve", "function", "largest"),
    [
        ("boom.hect", RETRACT_OVERRUNNING_THROUGH_ROD, 0.2e-3),
        # before it lifts, the rod end must be filled to the pressure above the head end
        ("boom.hepc", EXTEND_RESISTIVE_FED_AT_ROD, 8e-3),
        ("boom.rect", EXTEND_RESISTIVE_FED_AT_ROD, 8e-3),
        ("boom.repc", None, 0.2e-3),
        ("boom.regen", None, 0.2e-3),
    ],
)
def test_the_load_moves_without_a_cartridge(tmp_path, valve, function, largest):
    """Nothing passes the valve, and oil that moves the cylinder comes and goes by the others."""
    loaded = load_recipe(ROOT / "recipes/trials/arc_fast_bench.toml")
    assert isinstance(loaded, TrialRecipe) and loaded.controller is not None
    way = {"waypoints": ["50 mm", "200 mm", "50 mm"], "hold": "1 s", "speed": "40 mm/s"}
    way |= {"acceleration": "0.3 m/s^2", "jerk": "6 m/s^3"}
    motion = Motion.model_validate({"kind": "point_to_point", "cylinder": "boom"} | way)
    controller = loaded.controller.model_copy(update={"unused": (valve,)})
    given = {"on": "model", "bench": None, "payload": "50 lb", "motion": motion}
    recipe = loaded.model_copy(update=given | {"controller": controller})
    log = tmp_path / "log.mcap"
    result = run(prepare(recipe, shipped("thesis_arm")), log=log)
    assert result.facts.stop is None
    assert result.facts.measures["tracking"]["max_error"] < largest
    frame = read_log(log)
    assert not np.any(frame[f"{valve}.command"])
    moving = np.abs(frame["boom.v_desired"]) > 0.01
    used = set(np.unique(frame["boom.function"][moving]).astype(int))
    assert HOLD not in used
    assert function is None or function in used


MAST = """
name = "mast"
[oil]
bulk_modulus = "1000 MPa"
[supply]
pressure = "160 bar"
flow_limit = "40 L/min"
[mechanism]
kind = "slide"
name = "mast"
mass = "800 kg"
damping = "2000 N*s/m"
incline = "90 deg"
[[cylinder]]
name = "lift"
joint = "mast"
area_head = "20 cm^2"
area_rod = "7 cm^2"
stroke = "1000 mm"
volume_head = "500 cm^3"
volume_rod = "900 cm^3"
[[cylinder.valve]]
name = "spool"
command_min = "-10 V"
command_max = "10 V"
edge = [
  { from = "supply", to = "head", law = "orifice", flow_gain = "2 L/min/V/MPa^0.5" },
  { from = "head", to = "tank", sign = -1, law = "orifice", flow_gain = "2 L/min/V/MPa^0.5" },
]
[[cylinder.valve]]
name = "breather"
command_min = "9 V"
command_max = "10 V"
edge = [{ from = "rod", to = "tank", law = "orifice", flow_gain = "20 L/min/V/MPa^0.5" }]
"""


@pytest.mark.parametrize(("kind", "largest"), [("arc", 0.5e-3), ("position", 4e-3)])
def test_a_single_acting_cylinder_goes_down_by_its_load(tmp_path, kind, largest):
    """Its pressures and its command are those by hand, and the energies of a cycle close."""
    (tmp_path / "rig.toml").write_text(MAST)
    rig = load_rig(tmp_path / "rig.toml")
    motion = {"kind": "point_to_point", "cylinder": "lift", "speed": "0.15 m/s"}
    motion |= {"waypoints": ["200 mm", "500 mm", "200 mm"]}
    given = {"stage": "trial", "rig": "rig.toml", "motion": motion, "controller": {"kind": kind}}
    recipe = TrialRecipe.model_validate(given)
    result = run(prepare(recipe, rig))
    assert result.facts.stop is None
    assert result.facts.measures["tracking"]["max_error"] < largest
    frame = result.record
    down = np.flatnonzero(frame["lift.v_desired"] < -0.1499)[-1]
    assert frame["lift.function"][down] == RETRACT_OVERRUNNING_VENTED
    a1, a2, gain = 20e-4, 7e-4, 1e-3 / 60 / 1e3
    rod = -((0.15 * a2 / (200 * gain)) ** 2)
    head = (800 * 9.80665 - 2000 * 0.15 + a2 * rod) / a1
    assert frame["lift.p_head"][down] == pytest.approx(head, rel=2e-3)
    spool = -0.15 * a1 / (2 * gain * np.sqrt(head))
    assert frame["lift.spool.command"][down] == pytest.approx(spool, rel=1e-2)
    ledger = ledger_of_model(Model.of(rig), frame)
    assert abs(ledger.residual.energy) < 1e-3 * ledger.pump
    # without a breather the rod end has no oil to take
    (tmp_path / "rig.toml").write_text(MAST.rsplit("[[cylinder.valve]]", 1)[0])
    with refused("trial.no_function"):
        prepare(recipe, load_rig(tmp_path / "rig.toml"))
