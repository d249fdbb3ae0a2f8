"""Every shipped rig loads, survives writing and reading, and names its sources."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from ehbench.config.recipe import load_rig
from ehbench.plant.model import Model
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.fields import SURENESS, Value
from ehbench.vocabulary.quantities import VOCABULARY
from ehbench.vocabulary.units import factor
from tests.shared import RECIPES

FOLDER = Path(__file__).parents[2] / "recipes" / "rigs"
RIGS = sorted(FOLDER.glob("*.toml"))


@pytest.mark.parametrize("path", RIGS, ids=lambda p: p.stem)
def test_rigs_survive_writing_and_take_every_parameter(path, tmp_path):
    rig = load_rig(path)
    copy = tmp_path / "rig.toml"
    copy.write_text(tomli_w.dumps(rig.as_toml()))
    assert load_rig(copy) == rig
    assert all(value.sure in SURENESS for value in rig.parameters().values())
    rig = load_rig(path)
    for name, value in rig.parameters().items():
        other = float(value) * 1.01 + 1e-6
        changed = rig.with_values({name: other}).parameters()[name]
        assert float(changed) == pytest.approx(other, rel=1e-12), name


def test_a_vector_is_a_number_for_each_axis(tmp_path):
    """Read as one list with one source, or by its entries; written so where these differ."""
    rig = load_rig(FOLDER / "crane_proportional.toml")
    known = rig.parameters()
    assert [float(known[f"arm.com_{axis}"]) for axis in "xyz"] == [-1.9, 0.05, 0.0]
    assert float(known["200 kg.arm.inertia_zz"]) == 532.0
    text = (FOLDER / "crane_proportional.toml").read_text()
    old = '{ value = ["-1.9 m", "0.05 m", "0 m"], source = "assumed" }'
    new = '["-1.9 m", { value = "5 cm", source = "weighed", std = "1 cm", lower = "0 m" }, "0 m"]'
    assert text.count(old) == 1
    (tmp_path / "rig.toml").write_text(text.replace(old, new))
    each = load_rig(tmp_path / "rig.toml")
    across = each.parameters()["arm.com_y"]
    assert (across.sure, across.std, across.lower, across.unit) == ("weighed", 0.01, 0.0, "cm")
    assert each.as_toml()["mechanism"]["joint"][0]["com"][0] == "-1.9 m"
    found = Value(-1.8, "identified", std=0.02)
    moved = rig.with_values({"arm.com_x": found, "arm.com_z": 0.1})
    assert moved.mechanism.joint[0].com.value == (-1.8, 0.05, 0.1)
    (tmp_path / "rig.toml").write_text(tomli_w.dumps(moved.as_toml()))
    again = load_rig(tmp_path / "rig.toml").parameters()
    assert (again["arm.com_x"].std, again["arm.com_x"].sure) == (0.02, "identified")
    assert (again["arm.com_y"].std, float(again["arm.com_z"])) == (None, 0.1)


def test_values_that_no_body_has_are_refused_where_they_meet():
    rig = load_rig(FOLDER / "crane_proportional.toml")
    rig.with_values({"arm.inertia_zz": 193.0}).refuse_misfits()
    for name in ("arm.inertia_zz", "200 kg.arm.inertia_zz"):
        wrong = rig.with_values({name: 800.0})
        with pytest.raises(InputError, match="no body has this inertia"):
            wrong.refuse_misfits()


@pytest.mark.parametrize(
    "more, head, rod",
    [
        ("", 0.25 * 0.08**2, 0.25 * (0.08**2 - 0.045**2)),
        ("count = 2", 2 * 0.25 * 0.08**2, 2 * 0.25 * (0.08**2 - 0.045**2)),
        ("through_rod = true", 0.25 * (0.08**2 - 0.045**2), 0.25 * (0.08**2 - 0.045**2)),
    ],
)
def test_areas_of_cylinders_side_by_side_and_of_a_rod_that_goes_through(tmp_path, more, head, rod):
    """The plant has them, and a written rig keeps them."""
    text = (FOLDER / "crane_proportional.toml").read_text()
    text = text.replace("\nstroke =", f"\n{more}\nstroke =").replace('"2.6 L"', '"5.2 L"')
    (tmp_path / "a.toml").write_text(text)
    copy = tmp_path / "b.toml"
    copy.write_text(tomli_w.dumps(load_rig(tmp_path / "a.toml").as_toml()))
    row = Model.of(load_rig(copy)).plant.cylinders[0]
    found = (row.area_head / math.pi, row.area_rod / math.pi)
    assert found == pytest.approx((head, rod), rel=1e-12)


@pytest.mark.parametrize(
    "law, command, drop, name, gain, unit",
    [
        ("orifice", "10 V", "35 bar", "flow_gain", 60 / 8.5 / 35**0.5, "L/min/V/bar^0.5"),
        ("orifice", "-10 V", "508 psi", "flow_gain", 60 / 8.5 / 508**0.5, "L/min/V/psi^0.5"),
        ("flow_control", "10 V", "", "compensated_gain", 60 / 8.5, "L/min/V"),
        ("saturating", "10 V", "35 bar", "flow_gain", 60 / 6.5 / 35**0.5, "L/min/V/bar^0.5"),
    ],
)
def test_a_data_sheets_point_gives_the_gain(tmp_path, law, command, drop, name, gain, unit):
    """Beyond the deadband of 1.5 V; it is written as the gain, with where it came from."""
    point = 'flow = { value = "60 L/min", source = "datasheet", std = "3 L/min" }, '
    point += f'command = "{command}"' + (f', drop = "{drop}"' if drop else "")
    more = '\nopening_max = "8 V"' if law == "saturating" else ""
    text = (FOLDER / "crane_proportional.toml").read_text()
    old = 'law = "orifice"\nflow_gain = { value = "1.7 L/min/V/MPa^0.5", source = "datasheet" }'
    assert old in text
    (tmp_path / "a.toml").write_text(
        text.replace(old, f'law = "{law}"{more}\nrated = {{ {point} }}')
    )
    copy = tmp_path / "b.toml"
    copy.write_text(tomli_w.dumps(load_rig(tmp_path / "a.toml").as_toml()))
    for rig in (load_rig(tmp_path / "a.toml"), load_rig(copy)):
        found = rig.parameters()[f"lift.spool_pa.{name}"]
        assert rig.unit_of(f"lift.spool_pa.{name}") == unit and found.sure == "datasheet"
        assert float(found) == pytest.approx(gain * factor(unit, VOCABULARY[name].unit), rel=1e-12)
        assert found.std == pytest.approx(0.05 * float(found), rel=1e-12)
        assert found.source.startswith(f"datasheet, rated 60 L/min at {command}")


def test_a_second_cylinder_on_a_joint_is_told_how_a_pair_is_written(tmp_path):
    text = (FOLDER / "crane_proportional.toml").read_text()
    second = text[text.index("[[cylinder]]") :].replace('name = "lift"', 'name = "other"', 1)
    (tmp_path / "a.toml").write_text(f"{text}\n{second}")
    with pytest.raises(InputError, match="two cylinders drive joint 'arm'; equal .* count = 2"):
        load_rig(tmp_path / "a.toml")


def test_valves_take_other_dynamics_of_their_file():
    rig = load_rig(FOLDER / "thesis_arm_standard.toml")
    fast = rig.with_dynamics({"boom.spool": "cartridge"})
    series = {f"{cylinder.name}.{valve.name}": valve.series for cylinder, valve in fast.valves()}
    others = {"swing.servo": ("servo",), "stick.servo": ("servo",)}
    assert series == {**others, "boom.spool": ("cartridge",)}
    with pytest.raises(InputError, match="no valve 'boom.spol'"):
        rig.with_dynamics({"boom.spol": "cartridge"})
    with pytest.raises(InputError, match=r"no \[dynamics\] 'slow'") as error:
        rig.with_dynamics({"boom.spool": "slow"})
    assert error.value.hint == "there are servo, cartridge"


def test_people_see_a_parameter_in_the_unit_of_its_file(tmp_path):
    """Also when it was identified since, and whatever unit another quantity of the rig has."""
    rig = load_rig(FOLDER / "boom_four_valve.toml")
    unit = "L/min/V/MPa^0.5"
    gain = next(n for n in rig.parameters() if n.endswith(".flow_gain"))
    known = rig.parameters()[gain]
    assert rig.unit_of(gain) == known.unit == unit
    assert rig.unit_of("bulk_modulus") == "MPa" and rig.unit_of(gain.split(".")[0] + ".q") == "deg"
    found = Value(1.1 * float(known), sure="identified", std=0.01 * float(known))
    path = tmp_path / "rig.toml"
    path.write_text(tomli_w.dumps(rig.with_values({gain: found}).as_toml()))
    back = load_rig(path)
    assert back.unit_of(gain) == unit and float(back.parameters()[gain]) == found.value


def test_the_unit_that_people_see_can_be_said(tmp_path):
    text = (FOLDER / "slide_servo.toml").read_text()
    line = next(one for one in text.splitlines() if one.startswith("bulk_modulus"))
    said = 'bulk_modulus = { value = "900 MPa", unit = "psi" }'
    path = tmp_path / "rig.toml"
    path.write_text(text.replace(line, said))
    assert load_rig(path).unit_of("bulk_modulus") == "psi"
    path.write_text(text.replace(line, said.replace("psi", "mm")))
    with pytest.raises(InputError, match="cannot be turned into Pa"):
        load_rig(path)


@pytest.mark.parametrize(("other", "unit"), [("0 N", "N"), ("0 lbf", "lbf"), (None, "kN")])
def test_a_word_has_the_unit_of_a_file_that_writes_it_in_one(tmp_path, other, unit):
    """Two cylinders, one with its friction in kN: 0 N of another is not told in kN."""
    key = r"(?m)^friction_coulomb = .*\n"
    first, *others = re.split(key, (FOLDER / "thesis_arm.toml").read_text())
    line = f'friction_coulomb = "{other}"\n' if other else ""
    text = line.join([first + 'friction_coulomb = "1 kN"\n' + others[0], *others[1:]])
    (tmp_path / "rig.toml").write_text(text)
    rig = load_rig(tmp_path / "rig.toml")
    assert [rig.unit_of(f"{one.name}.friction_coulomb") for one in rig.cylinder] == [
        "kN",
        *[unit] * (len(rig.cylinder) - 1),
    ]


def test_places_are_told_in_the_readers_unit_as_finely_as_in_mm():
    """An inch takes two decimals more than a millimetre, bar two more than kPa, m/s three more."""
    rig = load_rig(FOLDER / "slide_servo.toml")
    inch = rig.model_copy(update={"display": {"x": "in", "v": "m/s"}})
    assert rig.text("x", 0.254, 1) == "254.0 mm" and inch.text("x", 0.254, 1) == "10.000 in"
    assert rig.text("v", 0.05, 0, "+") == "+50 mm/s" and inch.text("v", 0.05, 0) == "0.050 m/s"
    assert rig.text("press.p_rod", 5.2e5, 0) == "5.20 bar"
    with pytest.raises(InputError, match=r"posture press = 118\.110 in lies") as caught:
        Model.of(inch).posture({"press": "3 m"})
    assert caught.value.hint == "the stroke allows 0.000 to 15.748 in"


def test_pressures_and_flows_are_seen_as_those_of_the_supply():
    """Where the rig says nothing else; a choice for one quantity holds for all of its kind."""
    press = load_rig(RECIPES / "press" / "rig.toml")  # 210 bar and 80 L/min, in no other words
    assert {press.unit_of(n) for n in ("press.p_head", "p_supply", "rail_pressure")} == {"bar"}
    assert press.unit_of("press.servo_supply_head.flow") == "L/min"
    assert press.unit_of("bulk_modulus") == "MPa" and press.unit_of("press.x") == "mm"
    chosen = press.model_copy(update={"display": {"p_rod": "psi"}})
    assert (chosen.unit_of("p_head"), chosen.unit_of("flow")) == ("psi", "L/min")


def test_a_thin_link_whose_moments_are_rounded_moves(tmp_path):
    """With a product of inertia a principal moment may come out just below zero."""
    text = (FOLDER / "boom_four_valve.toml").read_text()
    moments = 'inertia = ["0 kg*m^2", "25 kg*m^2", "25 kg*m^2", "0.5 kg*m^2"'
    moments += ', "0 kg*m^2"' * 2 + "]"
    text, count = re.subn(r"(?m)^inertia = .*$", moments, text)
    assert count
    (tmp_path / "rig.toml").write_text(text)
    model = Model.of(load_rig(tmp_path / "rig.toml"))
    assert np.isfinite(model.trim(model.posture(None))).all()
