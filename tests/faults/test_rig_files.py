"""Rig files by strangers: odd ones run, and a slip gets one sentence with its line and what would
be right.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from ehbench.app import inspection
from ehbench.config.recipe import load_recipe, load_rig
from ehbench.trial import run_trial
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.fields import read_value
from ehbench.vocabulary.quantities import VOCABULARY

ROOT = Path(__file__).parents[2]
UP = ("supply", "head")
PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "rig_file.md").read_text(
    encoding="utf-8"
)
CRANE, *_ = EXAMPLES = re.findall(r"```toml\n(.*?)```", PAGE, re.S)
(PRESS,) = (text for text in EXAMPLES if text.startswith("# a press"))
PRESS = (
    'name = "press"\n[oil]\nbulk_modulus = "1.1 GPa"\n[supply]\npressure = "250 bar"\n'
    'flow_limit = "200 L/min"\n'
    + ('[dynamics.spool]\nnatural_frequency = "60 Hz"\ndamping_ratio = 0.7\n' + PRESS)
)
PUMP = (
    Path(__file__).parents[2].joinpath("recipes", "rigs", "pump_cylinder.toml").read_text("utf-8")
)
PINS = CRANE[CRANE.index("[cylinder.pins]") : CRANE.index("[[cylinder.valve]]")]
EDGE = '{ from = "supply", to = "head", law = "orifice", flow_gain = "2 L/min/V/bar^0.5" },'
FIRST, BACK = "cylinder 'lift', valve 'spool', edge 1", '{ from = "head", to = "tank", sign = -1,'


def refused(tmp_path: Path, text: str) -> InputError:
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        inspection.check(tmp_path / "rig.toml")
    assert caught.value.file == str(tmp_path / "rig.toml")
    return caught.value


def padded(*cases):
    return [(*case, None)[:4] for case in cases]


# what stands in the file, what is written instead, the sentence; it stands on the line of what is
# written, else of the last text
@pytest.mark.parametrize(
    ("old", "new", "words", "line"),
    padded(
        ('"60 L/min"', '"60 L"', "supply.flow_limit: 'L' cannot be turned into m^3/s"),
        ('"60 L/min"', "60", 'supply.flow_limit: flow_limit = 60 has no unit (write "60 gpm")'),
        ('"60 L/min"', '"60"', "has no unit"),
        ('"60 L/min"', '"60 L/mim"', "unknown unit 'L/mim'"),
        ('"60 L/min"', '["60 L/min"]', "not a number with a unit"),
        ('"800 MPa"', '"-800 MPa"', "outside 1 to 10000 MPa"),
        (
            '"800 MPa"',
            '{ value = "800 MPa", lower = "1 GPa" }',
            "outside its own bounds: lower = 1 GPa",
        ),
        (
            '"800 MPa"',
            '{ value = "800 MPa", lowr = "1 GPa" }',
            "unknown key 'lowr' (a value takes value, source,",
        ),
        (
            '{ value = "200 bar", source = "datasheet: pump, p. 4" }',
            '"0 bar"',
            "must lie above tank_pressure",
            "pressure =",
        ),
        (
            '{ value = "200 bar", source = "datasheet: pump, p. 4" }',
            '"20000 psi"',
            "20000 psi is beyond all hydraulics: at most 14503.8 psi",
            "pressure =",
        ),
        ('flow = "L/min"', 'flow = "bar"', "display.flow: 'bar' cannot be turned into m^3/s"),
        ('flow = "L/min"', 'flov = "L/min"', "there is no quantity 'flov'; nearest is 'flow'"),
        ("[oil]", "[oill]", "unknown key 'oill' (did you mean 'oil'?)"),
        ("[supply]", "[suppl]", "unknown key 'suppl' (did you mean 'supply'?)"),
        ('name = "crane"', 'name = "Kran-Größe"', "'kran_grosse'"),
        (
            'kind = "chain"',
            'kind = "chian"',
            "mechanism.kind = 'chian' is none of 'chain', 'slide' (did you mean 'chain'?)",
        ),
        ('kind = "chain"\n', "", "'mechanism.kind' is missing", "[mechanism]"),
        (
            "[[mechanism.joint]]",
            "[mechanism.joint]",
            "mechanism.joint is not a list (write [[mechanism.joint]] for each entry)",
        ),
        (
            'flow_limit = "60 L/min"',
            'flow_limit = "60 L/min"\naccumulator = 3',
            "accumulator = 3 is not a table (write accumulator = { gas_volume = …, ",
            "accumulator",
        ),
        (
            'mass = "200 kg"',
            'mas = "200 kg"',
            "mechanism.joint 'boom': unknown key 'mas' (did you mean 'mass'?)",
        ),
        (
            'mass = "200 kg"',
            'mass = "200 kN"',
            "mechanism.joint 'boom': mass: 'kN' cannot be turned into kg",
        ),
        (
            '["-1.5 m", "0 m", "0 m"]',
            '["-1.5 m", "0 m"]',
            "com takes a list of 3 values with units",
        ),
        (
            '["2 kg*m^2"',
            '["-2 kg*m^2"',
            "the inertia of link 'boom' is that of no body",
            'name = "boom"',
        ),
        (
            'joint = "boom"',
            'joint = "arm"',
            "cylinder 'lift': joint: there is no joint 'arm'; known are boom",
        ),
        ('name = "lift"', 'name = "li.ft"', "'li.ft' is not a name"),
        ('name = "lift"', 'name = ""', "'' is not a name"),
        ('rod = "45 mm"', 'rod = "45 mm"\ncount = 0', "count = 0", "count = 0"),
        ('rod = "45 mm"', 'rod = "45 mm"\nthrough_rod = 1.5', "through_rod", "through_rod = 1.5"),
        ('rod = "45 mm"', 'rod = "85 mm"', "area_rod must be positive and not above area_head"),
        (
            'rod = "45 mm"',
            'rod = "45 mm"\narea_rod = "20 cm^2"',
            "give area_head and area_rod, or bore and rod",
            "[[cylinder]]",
        ),
        ('volume_head = "0.5 L"', 'volume_head = "-0.5 L"', "outside 0.001 to 1e+07 cm^3"),
        (
            'volume_rod = "2.5 L"',
            'volume_rod = "0.5 L"',
            "is 0.5 L, but the full stroke displaces 1.71806 L",
        ),
        (
            'volume_rod = "2.5 L"',
            'volume_rod = "2.5 L"\ncolour = "red"',
            "unknown key 'colour' (valid",
            'colour = "red"',
        ),
        (
            'phase = "60 deg"',
            'phase = "60 deg"\nfriction_coulomb = "90 N"',
            "unknown key 'pins.friction_coulomb' (a key of cylinder 'lift': put it above the "
            "table [cylinder.pins])",
            "friction_c",
        ),
        ('l_a = "1.2 m"\n', "", "cylinder 'lift': 'pins.l_a' is missing", "[cylinder.pins]"),
        (
            PINS,
            "",
            "cylinder 'lift': on a joint a cylinder needs 'pins' or a 'rack'",
            "[[cylinder]]",
        ),
        (
            'retracted_length = "850 mm"',
            'retracted_length = "1450 mm"',
            "1450 mm long retracted and 1950 mm extended",
        ),
        ('retracted_length = "850 mm"', 'retracted_length = "600 mm"', "allow 600 mm to 1800 mm"),
        (
            'retracted_length = "850 mm"',
            'retracted_length = "60 in"',
            "is 60 in long retracted and 79.685 in extended; l_a and l_b allow 23.622 in to",
        ),
        ('command_min = "-10 V"', 'command_min = "10 V"', "command_min must lie below command_max"),
        (
            'command_min = "-10 V"',
            'command_min = "0 V"',
            "edge 3: the edge opens on commands below 0 V, and",
            "edge = [",
        ),
        (
            'command_min = "-10 V"',
            'command_min = "2 V"\ndrive_limit = "1 V"',
            "never comes to rest",
            "drive_limit = ",
        ),
        (
            'command_min = "-10 V"',
            'command_min = "-10 V"\ndrive_limit = "0 V"',
            "a drive limit of zero",
            "drive_limit = ",
        ),
        ('dynamics = "spool"', 'dynamics = "spol"', "there is no [dynamics.spol]; known are spool"),
        (
            "damping_ratio = 0.8",
            's1 = "8 ms"',
            "dynamics.spool: give natural_frequency and damping_ratio",
            "[dynamics.spool]",
        ),
        (
            EDGE,
            EDGE.replace('"head"', '"hed"'),
            f"{FIRST}: to = 'hed' is none of 'supply', 'tank', 'head', 'rod' (did you",
        ),
        (EDGE, EDGE.replace('"supply"', '"head"'), f"{FIRST}: an edge joins two different nodes"),
        (
            EDGE,
            EDGE.replace("orifice", "orifise"),
            f"{FIRST}: law = 'orifise' is none of 'orifice', 'compensated', 'map'",
        ),
        (
            EDGE,
            EDGE.replace("orifice", "compensated"),
            f"{FIRST}: law 'compensated' needs 'compensated_gain'",
        ),
        (
            EDGE,
            EDGE.replace("/bar^0.5", ""),
            f"{FIRST}: flow_gain: 'L/min/V' cannot be turned into",
        ),
        (
            EDGE,
            EDGE.replace(" },", ', deadband = "12 V" },'),
            f"{FIRST}: the edge opens on commands above 12 V",
        ),
        (EDGE, EDGE.replace('from = "supply", ', ""), f"{FIRST}: 'from' is missing"),
        (
            BACK,
            BACK.replace('"head"', '"rod"'),
            "two edges are called 'spool_rod_tank'",
            "edge = [",
        ),
        (BACK, BACK.replace("-1", "-2"), "edge 4: sign = -2 is none of 1, -1", "edge = ["),
        (
            "command_max",
            'calibration = [["4 V", "2 bar"]]\ncommand_max',
            "calibration 1: 'bar' cannot",
            "calibration",
        ),
    ),
)
def test_a_slip_is_one_sentence_with_its_line(tmp_path, old, new, words, line):
    assert old in CRANE
    text = CRANE.replace(old, new, 1)
    error = refused(tmp_path, text)
    assert words in str(error) and "\n" not in str(error) and len(str(error)) < 420
    there = text.splitlines()[error.line - 1]
    assert (line or ("edge = [" if old in (EDGE, BACK) else new.splitlines()[0])) in there, (
        there,
        str(error),
    )


@pytest.mark.parametrize(
    ("new", "words"),
    [
        ('rated = { flow = "60 L/min", command = "10 V" }', "takes the drop across the edge"),
        ('rated = { flow = "60 L/min", command = "10 V", drop = "0 bar" }', "a rated drop must be"),
        ('rated = { flow = "-6 L/min", command = "10 V", drop = "5 bar" }', "a rated flow must be"),
        (
            'rated = { flow = "6 L/min", command = "0 V", drop = "5 bar" }',
            "within the deadband of 0 V",
        ),
        ('rated = { flow = "6 L/min", command = "5 mA", drop = "5 bar" }', "as 1 V for 100 mA"),
        ('rated = { flow = "6 L/min", drop = "5 bar" }', "command' is missing"),
        (
            'flow_gain = "1 L/min/V/bar^0.5", '
            'rated = { flow = "6 L/min", command = "10 V", drop = "5 bar" }',
            "give flow_gain or rated, not both",
        ),
        ('flow_gain = "1 L/min/V"', "goes in as rated = { flow, command, drop }"),
    ],
)
def test_a_slip_in_a_rated_point(tmp_path, new, words):
    old = 'flow_gain = "4 L/min/V/bar^0.5"'
    assert old in PRESS
    text = PRESS.replace(old, new, 1)
    error = refused(tmp_path, text)
    assert words in str(error) and text.splitlines()[error.line - 1] == "edge = ["


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            'area_rod = "160 cm^2"',
            'area_rod = "360 cm^2"',
            "cylinder 'main': area_rod must be positive and not above area_head",
        ),
        ('area_head = "314 cm^2"', 'area_head = "314 cm"', "'cm' cannot be turned into m^2"),
        ('area_head = "314 cm^2"', 'area_head = "314 cm^2"\ncount = 2', "'count' goes with bore"),
        (
            'area_head = "314 cm^2"',
            'area_head = "314 cm^2"\nthrough_rod = true',
            "with bore and rod",
        ),
        ('name = "fine"', 'name = "fast"', "two valves are called 'fast'"),
        ('incline = "-90 deg"', 'incline = "-180 deg"', "outside -91.6732 to 91.6732 deg"),
        (
            'joint = "ram"',
            'joint = "ram"\npins = { l_a = "1 m", l_b = "1 m", retracted_length = "1 m" }',
            "slide it has none",
        ),
    ],
)
def test_a_slip_in_a_press(tmp_path, old, new, words):
    assert old in PRESS
    assert words in str(refused(tmp_path, PRESS.replace(old, new, 1)))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            'displacement = { value = "8 mL/rev", source = "datasheet" }\n',
            "",
            "law 'pump' needs 'displacement'",
        ),
        (
            '"8 mL/rev"',
            '"8 mL"',
            "'mL' says no angle for displacement (displacement is in m^3/rad, mL/rev or the like)",
        ),
        ('"8 mL/rev"', '"-8 mL/rev"', "displacement = -8 mL/rev lies outside"),
        ('"150 rpm/V"', '"150 rpm"', "'rpm' cannot be turned into rad/(s*V)"),
        ('law = "pump"', 'law = "pump"\nreverse = "blocked"', "a pump passes oil both ways"),
        ('law = "pump"', 'law = "pump"\ndeadband = "1 V"', "a pump has no deadband"),
        ('law = "pump"', 'law = "pump"\ncracking_pressure = "1 bar"', "has no cracking pressure"),
        ('"check_rod"', '"check_head"', "two edges are called 'check_head'"),
        ('"check_rod"', '"pump"', "two edges are called 'pump'"),
        ('pilot = "head"\n', "", "pilot and pilot_ratio belong together"),
        ('pilot = "head"', 'pilot = "supply"', "the pilot is at 'from', where it opens nothing"),
        ('to = "rod"', 'to = "supply"', "an edge joins two different nodes"),
        ('law = "pump"', 'law = "pump"\npump_speed = "900 rpm"', "unknown key 'pump_speed'"),
        ('law = "pump"', 'law = "pump"\nflow_gain = "1 L/min/V/bar^0.5"', "takes no 'flow_gain'"),
        ('law = "check"', 'law = "check"\nslip = "1 mL/min/bar"', "law 'check' takes no 'slip'"),
        ('pilot = "head"', 'pilto = "head"', "unknown key 'pilto' (did you mean 'pilot'?)"),
        ('"4 bar"', '"8 bar"', "the accumulator holds no oil: its precharge must lie below"),
        ('"1 L"', '"1 kg"', "gas_volume: 'kg' cannot be turned into m^3"),
        ("value = 1.2,", "value = 2.5,", "polytropic_exponent = 2.5 lies outside 1 to 1.7"),
    ],
)
def test_a_slip_in_a_pump_circuit(tmp_path, old, new, words):
    assert old in PUMP
    assert words in str(error := refused(tmp_path, PUMP.replace(old, new, 1)))
    assert error.line is not None


@pytest.mark.parametrize("node", ["supply", "tank", "head", "rod"])
def test_a_missing_edge_is_noted(tmp_path, node):
    rig = tomllib.loads(CRANE)
    (valve,) = rig["cylinder"][0]["valve"]
    valve["edge"] = [edge for edge in valve["edge"] if node not in (edge["from"], edge["to"])]
    (tmp_path / "rig.toml").write_text(tomli_w.dumps(rig))
    lines = inspection.check(tmp_path / "rig.toml").lines
    assert (
        sum(f"touches the {node}" in line and "is one missing?" in line for line in lines) == 1
        and lines[-1] == "ok"
    )


def test_a_load_that_the_supply_cannot_carry_is_noted(tmp_path):
    (tmp_path / "rig.toml").write_text(CRANE.replace('"200 kg"', '"20 t"'))
    lines = inspection.check(tmp_path / "rig.toml").lines
    assert "  note: no payload: the supply cannot carry the load of 'lift' at mid-stroke" in lines


def test_pressure_that_the_areas_raise_is_no_load_beyond_the_supply(tmp_path):
    """One edge open at rest holds the head end at the supply's pressure, and the smaller rod end
    stands above it.
    """
    rig = tomllib.loads(CRANE)
    (edge,) = [e for e in rig["cylinder"][0]["valve"][0]["edge"] if (e["from"], e["to"]) == UP]
    edge["underlap"] = "0.3 V"
    (tmp_path / "rig.toml").write_text(tomli_w.dumps(rig))
    lines = inspection.check(tmp_path / "rig.toml").lines
    rests = [re.search(r"rests at ([\d.]+) bar head, ([\d.]+) bar rod", line) for line in lines]
    head, rod = next((float(one[1]), float(one[2])) for one in rests if one)
    supply = float(load_rig(tmp_path / "rig.toml").supply.pressure) / 1e5
    assert head == pytest.approx(supply, rel=0.01) and rod > 1.1 * supply
    assert not any("cannot carry" in line for line in lines) and lines[-1] == "ok"


def test_names_of_another_alphabet_go_all_the_way(tmp_path):
    text = CRANE.replace('"boom"', '"Löffel-Stiel"').replace('"lift"', '"Zylinder-Ö"')
    text = text.replace('name = "spool"', 'name = "Ventil_2"')
    moved = trial(tmp_path, text, "Zylinder-Ö.Ventil_2", 'posture = { "Zylinder-Ö" = "200 mm" }')
    assert (
        moved["Zylinder-Ö.x"][0] == pytest.approx(0.2, abs=1e-9)
        and moved["Zylinder-Ö.x"][-1] > 0.21
    )


@pytest.mark.parametrize("valve", ["main.fast", "main.fine"])
def test_two_valves_side_by_side_move_a_press(tmp_path, valve):
    moved = trial(tmp_path, PRESS, valve)
    assert moved["main.x"][-1] > moved["main.x"][0] + 1e-3
    slow, fast = (
        np.ptp(trial(tmp_path, PRESS, f"main.{name}")["main.x"]) for name in ("fine", "fast")
    )
    assert fast > 3.0 * slow  # ten times the gain, less what the supply and the ram's start take


def trial(folder: Path, rig: str, valve: str, more: str = ""):
    """A small open-loop trial on a rig file, checked and run."""
    (folder / "rig.toml").write_text(rig, encoding="utf-8")
    command = f'{{ valve = "{valve}", kind = "step", amplitude = "3 V", start = "0.1 s" }}'
    head = 'stage = "trial"\nrig = "rig.toml"\nduration = "0.4 s"\n'
    (folder / "t.toml").write_text(f"{head}{more}\ncommand = [{command}]\n", encoding="utf-8")
    assert (
        inspection.check(folder / "rig.toml").lines[-1]
        == inspection.check(folder / "t.toml").lines[-1]
        == "ok"
    )
    record, facts = run_trial(load_rig(folder / "rig.toml"), load_recipe(folder / "t.toml"))
    assert not facts.stopped and all(
        np.isfinite(values).all() for values in record.channels.values()
    )
    return record


FORCE = '[[cylinder.force]]\nkind = "spring"\nstiffness = "5 kN/m"\n'
LINE = '[[cylinder.line]]\nend = "head"\nvolume = "1 L"\nresistance = "0.1 bar*min/L"\n'
MOUNT = '[cylinder.mount]\nstiffness = "50 kN/mm"\ndamping = "50 kN*s/m"\n'
NAMED = '[[cylinder.force]]\nname = "line_head"\nkind = "constant"\nforce = "1 N"\n'
SATURATING = EDGE.replace('"orifice"', '"saturating"')


# parts that a rig may have: text put in place of another, the sentence, where
@pytest.mark.parametrize(
    ("old", "new", "words", "line"),
    padded(
        (PINS, FORCE + PINS, "a force of kind 'spring' needs 'free_length'", FORCE),
        ("[oil]", '[oil]\nair_fraction = "60 %"', "outside 0 to 50 %", "air_fraction ="),
        (
            "[oil]",
            "[oil]\npolytropic_exponent = 1.3",
            "an exponent of air needs 'air_fraction'",
            "polytropic_exponent =",
        ),
        (
            PINS,
            FORCE.replace('stiffness = "5 kN/m"', 'force = "5 kN"') + PINS,
            "a force of kind 'spring' needs 'stiffness'",
            FORCE[:20],
        ),
        (
            PINS,
            FORCE + 'free_length = "0.1 m"\nchannel = "lift.force"\n' + PINS,
            "a force of kind 'spring' takes no 'channel'",
            "channel =",
        ),
        (
            PINS,
            FORCE.replace("kN/m", "kN") + 'free_length = "0.1 m"\n' + PINS,
            "'kN' cannot be turned into N/m",
            "stiffness =",
        ),
        (
            PINS,
            '[[cylinder.force]]\nkind = "channel"\nchannel = "lift.x"\n' + PINS,
            "'lift.x' is no channel of a force",
            "channel =",
        ),
        (
            PINS,
            LINE.replace('"head"', '"tank"') + PINS,
            "line 1: end = 'tank' is none of 'head', 'rod'",
            'end = "tank"',
        ),
        (PINS, LINE.replace("1 L", "0 L") + PINS, "line 1: volume: must be above 0", "volume = "),
        (PINS, LINE.replace("1 L", "1 m") + PINS, "'m' cannot be turned into m^3", 'volume = "1 m'),
        (
            PINS,
            LINE.replace("resistance", "# resistance") + PINS,
            "line 1: a line needs 'resistance', 'orifice_gain' or both",
            "[[cylinder.line]]",
        ),
        (
            PINS,
            LINE.replace('"0.1 bar*min/L"', '"-2 bar*min/L"') + PINS,
            "outside 0 to",
            "resistance =",
        ),
        (
            PINS,
            LINE + LINE.replace('"head"', '"head" ') + PINS,
            "the head end has a line already; give their volumes and resistances in one",
            'end = "head" ',
        ),
        (PINS, LINE + NAMED + PINS, "two forces are called 'line_head'", NAMED[:20]),
        (PINS, MOUNT.replace("50 kN/mm", "0 kN/mm") + PINS, "must be above 0", "stiffness = "),
        (PINS, MOUNT.replace("50 kN/mm", "50 kN") + PINS, "'kN' cannot be turned", "stiffness = "),
        (
            PINS,
            MOUNT.replace("50 kN*s", "0 kN*s") + PINS,
            "a mount without mass needs damping: 1000 N*s/m at the least, 20 us times its stiff",
            "damping = ",
        ),
        (PINS, MOUNT.replace("stiff", "# s") + PINS, "'mount.stiffness' is missing", MOUNT[:16]),
        (PINS, MOUNT.replace("damping", "dampin") + PINS, "unknown key 'mount.dampin'", "dampin ="),
        (
            EDGE,
            EDGE.replace('"orifice"', '"flow_control"'),
            "law 'flow_control' needs 'compensated_gain'",
            "edge = [",
        ),
        (EDGE, SATURATING, "law 'saturating' needs 'opening_max'", "edge = ["),
        (
            EDGE,
            SATURATING.replace(" }", ', deadband = "1 V", opening_max = "0.5 V" }'),
            "opening_max must lie above deadband",
            "edge = [",
        ),
        (
            EDGE,
            SATURATING.replace(" }", ', opening_max = "2 V", saturation_softness = "3 V" }'),
            "saturation_softness must not exceed opening_max − deadband, 2 V",
            "edge = [",
        ),
        (
            EDGE,
            EDGE.replace(" }", ', opening_max = "2 V" }'),
            "law 'orifice' takes no 'opening_max'; its keys: flow_gain",
            "edge = [",
        ),
    ),
)
def test_a_nonsense_part_is_refused_in_one_sentence(tmp_path, old, new, words, line):
    assert old in CRANE
    text = CRANE.replace(old, new, 1)
    error = refused(tmp_path, text)
    assert words in error.message and "\n" not in error.message, error.message
    at = text[: text.index(line or new)].count("\n") + 1
    assert at <= error.line <= at + new.count("\n"), (error.line, at)


SLIDE = (ROOT / "recipes" / "rigs" / "slide_servo.toml").read_text(encoding="utf-8")
THESIS = (ROOT / "recipes" / "rigs" / "thesis_arm.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("text", "old", "new", "says"),
    [
        (SLIDE, r"mass = \{[^}]*\}", 'mass = "0 kg"', "'carriage' has no mass to move"),
        (
            SLIDE,
            r"mass = \{ value = \"350 kg\"[^}]*\}",
            'mass = "200 kg"',
            "'carriage' has 200 kg, less than its 250 kg without",
        ),
        (
            SLIDE,
            r"pressure = \{ value = \"140 bar\"",
            'pressure = { value = "1800 bar"',
            "1800 bar",
        ),
        (SLIDE, r'"2\.4 L/min/V/MPa\^0\.5"', '"0 L/min/V/MPa^0.5"', "flow_gain = 0 L"),
        (SLIDE, r'"2\.4 L/min/V/MPa\^0\.5"', '"2.4e9 L/min/V/MPa^0.5"', "flow_gain = 2.4e9 L"),
        (SLIDE, r'"2\.4 L/min/V/MPa\^0\.5"', '"2400 L/min/V/MPa^0.5"', "m/s: check the unit of fl"),
        (SLIDE, r"damping_ratio = .*", "damping_ratio = -1.0", "damping_ratio = -1.0 lies outside"),
        (SLIDE, r"damping_ratio = .*", "damping_ratio = 1e6", "damping_ratio = 1000000.0 lies out"),
        (SLIDE, r"damping_ratio = .*", "damping_ratio = inf", "damping_ratio = inf lies outside"),
        (SLIDE, r"damping_ratio = .*", "damping_ratio = nan", "damping_ratio = nan lies outside"),
        (SLIDE, r"damping_ratio = .*", "damping_ratio = 1" + "0" * 400, "lies outside"),
        (
            SLIDE,
            r"mass = \{ value = \"250 kg\"",
            'mass = { std = "-1 kg", value = "250 kg"',
            "a standard error is not negative",
        ),
        (
            SLIDE,
            r"mass = \{ value = \"250 kg\"",
            'mass = { lower = inf, value = "250 kg"',
            "mass = inf has no unit",
        ),
        (
            THESIS,
            r'"0\.073 kg\*m\^2", "2\.2 kg\*m\^2", "2\.2 kg\*m\^2"',
            '"0.073 kg*m^2", "2.2 kg*m^2", "3.2 kg*m^2"',
            "no body has this inertia",
        ),
        (
            THESIS,
            r'"0\.271 kg\*m\^2", "3\.41 kg\*m\^2", "3\.59 kg\*m\^2", "0\.085',
            '"0.271 kg*m^2", "3.41 kg*m^2", "3.59 kg*m^2", "1.5',
            "no body has this inertia",
        ),
    ],
)
def test_numbers_that_no_machine_has_are_refused_with_their_line(tmp_path, text, old, new, says):
    path = tmp_path / "rig.toml"
    changed, count = re.subn(old, lambda _: new, text, count=1)
    assert count == 1
    path.write_text(changed, encoding="utf-8")
    with pytest.raises(InputError, match=re.escape(says)) as error:
        load_rig(path)
    assert error.value.line is not None and len(str(error.value)) < 500


def test_a_standard_error_of_a_temperature_is_a_difference():
    row = VOCABULARY["temperature"]
    value = read_value({"value": "40 degC", "std": "2 degC"}, row)
    assert value.std == pytest.approx(2.0) and value.value == pytest.approx(313.15)
