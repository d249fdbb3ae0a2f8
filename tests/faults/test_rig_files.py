"""Rig files by strangers: odd ones run, and a slip gets one sentence with its line."""

import math
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
import tomli_w

import ehbench
from ehbench.app import inspection
from ehbench.config.recipe import load_recipe, load_rig
from ehbench.trial import run_trial
from ehbench.vocabulary import Message
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.fields import read_value
from ehbench.vocabulary.quantities import VOCABULARY
from tests.shared import RIGS

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
PINS = CRANE[CRANE.index("[cylinder.pins]") : CRANE.index("[[cylinder.valve]]")]
EDGE = '{ from = "supply", to = "head", law = "orifice", flow_gain = "2 L/min/V/bar^0.5" },'


def refused(tmp_path: Path, text: str) -> InputError:
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        inspection.check(tmp_path / "rig.toml")
    assert caught.value.file == str(tmp_path / "rig.toml")
    return caught.value


SLIDE, THESIS, PUMP = (
    (RIGS / f"{name}.toml").read_text("utf-8")
    for name in ("slide_servo", "thesis_arm", "pump_cylinder")
)
TEXTS = {"crane": CRANE, "rated": PRESS, "press": PRESS, "pump": PUMP, "part": CRANE}
TEXTS |= {"slide": SLIDE, "thesis": THESIS}
OPEN = [
    ("crane_proportional", "out", {"lift.spool": 10.0}),
    ("crane_proportional", "in", {"lift.spool": -10.0}),
    ("boom_four_valve", "out", {"boom.sh": 10.0, "boom.rt": 10.0}),
]
SLOW_AND_FAST = [
    ("250 kg", "250 kg", set()),
    ("250 kg", "250 g", {"natural frequency"}),
    (
        'flow_limit = { value = "60 L/min"',
        'flow_limit = { value = "60 mL/min"',
        {"full speed out", "full speed in"},
    ),
]
SLIPS = tomllib.loads(Path(__file__).with_name("rig_slips.toml").read_text("utf-8"))


@pytest.mark.parametrize(("of", "case"), [(of, case) for of in SLIPS for case in SLIPS[of]])
def test_a_slip_is_one_sentence_with_its_line(tmp_path, of, case):
    old, new, says, *place = (x.replace("<PINS>", PINS).replace("<EDGE>", EDGE) for x in case)
    pattern = old if of in ("slide", "thesis") else re.escape(old)
    text, count = re.subn(pattern, lambda _: new, TEXTS[of], count=1)
    error = refused(tmp_path, text)
    assert count == 1 and says in str(error) and "\n" not in str(error)
    assert len(str(error)) < 500 and error.line is not None
    in_edge = of == "rated" or old == EDGE or old.startswith('{ from = "head"')
    where = next(iter(place), "edge = [" if in_edge else new.splitlines()[0] if new else "")
    if of in ("crane", "rated"):
        assert where in text.splitlines()[error.line - 1]
    elif of == "part":
        line = text[: text.index(where if place else new)].count("\n") + 1
        assert line <= error.line <= line + new.count("\n")


@pytest.mark.parametrize("node", ["supply", "tank", "head", "rod"])
def test_a_missing_edge_is_noted(tmp_path, node):
    rig = tomllib.loads(CRANE)
    (valve,) = rig["cylinder"][0]["valve"]
    valve["edge"] = [edge for edge in valve["edge"] if node not in (edge["from"], edge["to"])]
    (tmp_path / "rig.toml").write_text(tomli_w.dumps(rig))
    result = inspection.check(tmp_path / "rig.toml")
    asked = [line for line in result.lines if f"touches the {node}" in line]
    assert len(asked) == 1 and "is one missing?" in asked[0] and result.lines[-1] == "ok"
    said = " ".join(result.answer(tmp_path / "rig.toml").lines(80))
    assert f"touches the {node}" in said  # without -v


def crane_force(mass: float, stroke: float) -> float:
    """Force [N] that holds the crane's boom at a stroke, by the law of cosines."""
    l_a, l_b, length = 1.2, 0.6, 0.85 + stroke
    between = math.acos((l_a**2 + l_b**2 - length**2) / (2 * l_a * l_b))
    arm = l_a * l_b * math.sin(between) / length
    return mass * 9.80665 * 1.5 * math.cos(between - math.radians(60)) / arm


STROKES, FULL = np.linspace(0.0, 0.5, 501), 200e5 * math.pi / 4 * 0.08**2  # [m], [N]
HEAVIEST = FULL / max(crane_force(1.0, x) for x in STROKES)  # kg


def weak(path: Path) -> list[Message]:
    """The notes of ``check`` on loads beyond the supply."""
    notes = inspection.check(path).answer(path).notes
    return [n for n in notes if isinstance(n, Message) and n.key == "plant.weak_supply"]


@pytest.mark.parametrize(("share", "noted"), [(0.999, False), (1.001, True), (5.0, True)])
def test_a_load_that_the_supply_cannot_carry_somewhere_is_noted(tmp_path, share, noted):
    """The crane needs most when it is retracted, 1.3 % more than at mid-stroke."""
    mass = share * HEAVIEST
    (tmp_path / "rig.toml").write_text(CRANE.replace('"200 kg"', f'"{mass} kg"'))
    notes = weak(tmp_path / "rig.toml")
    assert len(notes) == noted
    for note in notes:
        assert note.fields["cylinder"] == "lift" and note.fields["at"] == "lift 0 mm"
        need, limit = (float(note.fields[key].split()[0]) for key in ("need", "limit"))
        assert need == pytest.approx(crane_force(mass, 0.0), rel=0.005)
        assert limit == pytest.approx(FULL, rel=0.005)


MOVES = """[motion]
kind = "point_to_point"
cylinder = "lift"
waypoints = ["300 mm", "5 mm"]
speed = "50 mm/s"
[controller]
kind = "pressure_feedback"
gains = { feedback_gain = "0 m^3/(s*Pa)" }
"""


@pytest.mark.parametrize(
    ("wants", "noted"),
    [
        ('posture = { lift = "250 mm" }', False),
        ('posture = { lift = "0 mm" }', True),
        (MOVES.replace("5 mm", "200 mm"), False),
        (MOVES, True),
    ],
)
def test_a_trial_says_that_the_supply_cannot_carry_its_load(tmp_path, wants, noted):
    mass = 1.003 * HEAVIEST
    text = CRANE.replace('"200 kg"', f'"{mass} kg"')
    (tmp_path / "rig.toml").write_text(text)
    head = 'stage = "trial"\nrig = "rig.toml"\n'
    head += "" if "motion" in wants else 'duration = "0.4 s"\n'
    (tmp_path / "t.toml").write_text(f"{head}{wants}\n")
    notes = weak(tmp_path / "t.toml")
    assert len(notes) == noted
    for note in notes:
        stroke = float(note.fields["at"].split()[1]) / 1e3
        need = float(note.fields["need"].split()[0])
        assert need == pytest.approx(crane_force(mass, stroke), rel=0.005)


@pytest.mark.parametrize(
    ("old", "new", "fits"),
    [
        ('"200 bar"', '"900 bar"', "psi"),
        ("80 mm", "3 mm", "in"),
        ('"500 mm"', '"12 mm"', "in"),
        ("850 mm", "850.5 mm", ""),
    ],
)
def test_a_number_beyond_ordinary_rigs_names_the_unit_that_fits(tmp_path, old, new, fits):
    text = CRANE.replace("45 mm", "2 mm") if fits == "in" else CRANE
    text = text.replace("2 L/min/V/bar^0.5", "0.01 L/min/V/bar^0.5").replace(old, new)
    (tmp_path / "rig.toml").write_text(text)
    notes = inspection.check(tmp_path / "rig.toml").answer(tmp_path).notes
    found = [n.fields for n in notes if isinstance(n, Message) and n.key == "app.unusual"]
    found = [fields for fields in found if fields["name"] != "lift.rod"]
    assert len(found) == bool(fits)
    for fields in found:
        assert fits in fields["fits"].split() and fields["value"] == new.strip('"')


@pytest.mark.parametrize(("rod", "unusual"), [("0 mm", 0), ("2 mm", 1)])
def test_a_cylinder_without_a_rod_is_ordinary(tmp_path, rod, unusual):
    text = CRANE.replace("45 mm", rod).replace("2.5 L", "3.5 L")
    (tmp_path / "rig.toml").write_text(text)
    notes = inspection.check(tmp_path / "rig.toml").answer(tmp_path).notes
    found = [n.fields["name"] for n in notes if isinstance(n, Message) and n.key == "app.unusual"]
    assert found == ["lift.rod"] * unusual


@pytest.mark.parametrize(("mass", "wide"), [("200 g", 1), ("14 kg", 0), ("12 kg", 1)])
def test_an_inertia_that_spreads_a_mass_beyond_the_machine_is_noted(tmp_path, mass, wide):
    (tmp_path / "rig.toml").write_text(CRANE.replace("200 kg", mass))
    notes = inspection.check(tmp_path / "rig.toml").answer(tmp_path).notes
    found = [n.fields for n in notes if isinstance(n, Message) and n.key == "app.wide_body"]
    assert [(fields["link"], fields["mass"]) for fields in found] == [("boom", mass)] * wide


def test_check_says_how_fast_a_machine_swings_and_moves(tmp_path):
    """A slide on its oil by hand; a crane's speed as its simulation with an open valve ends."""
    (tmp_path / "rig.toml").write_text(SLIDE)
    lines = "".join(inspection.check(tmp_path / "rig.toml").lines)
    shown = [float(number) for number in re.findall(r"natural frequency ([\d.]+) Hz", lines)]
    head = math.pi / 4 * 0.05**2
    rod = head - math.pi / 4 * 0.028**2
    spring = 9e8 * (head**2 / (150e-6 + 0.2 * head) + rod**2 / (700e-6 - 0.2 * rod))
    swings = [math.sqrt(spring / mass) / math.tau for mass in (250.0, 350.0)]
    assert shown == pytest.approx(swings, rel=1e-3)
    for rig, way, commands in OPEN:
        found = inspection.check(RIGS / f"{rig}.toml").lines
        (speed, *_) = re.findall(rf"full speed {way} ([\d.]+) mm/s", "".join(found))
        log = ehbench.simulate(load_rig(RIGS / f"{rig}.toml"), commands, duration=0.6)
        (v,) = (log[name] for name in log.channels if name.endswith(".v"))
        assert float(speed) == pytest.approx(1e3 * abs(v[-1]), rel=0.03)


@pytest.mark.parametrize(("old", "new", "what"), SLOW_AND_FAST)
def test_a_machine_that_no_one_builds_is_noted(tmp_path, old, new, what):
    (tmp_path / "rig.toml").write_text(SLIDE.replace(old, new))
    notes = inspection.check(tmp_path / "rig.toml").answer(tmp_path).notes
    found = [n.fields for n in notes if isinstance(n, Message) and n.key == "app.improbable"]
    assert {fields["what"] for fields in found if fields["load"] == "no payload"} == what


def test_pressure_that_the_areas_raise_is_no_load_beyond_the_supply(tmp_path):
    """One open edge holds the head end at the supply's pressure; the rod end stands above."""
    rig = tomllib.loads(CRANE)
    edges = {(e["from"], e["to"]): e for e in rig["cylinder"][0]["valve"][0]["edge"]}
    edges["supply", "head"]["underlap"] = "0.3 V"
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
    assert moved["Zylinder-Ö.x"][0] == pytest.approx(0.2, abs=1e-9)
    assert moved["Zylinder-Ö.x"][-1] > 0.21


@pytest.mark.parametrize("valve", ["main.fast", "main.fine"])
def test_two_valves_side_by_side_move_a_press(tmp_path, valve):
    moved = trial(tmp_path, PRESS, valve)
    assert moved["main.x"][-1] > moved["main.x"][0] + 1e-3
    both = (trial(tmp_path, PRESS, f"main.{name}")["main.x"] for name in ("fine", "fast"))
    slow, fast = map(np.ptp, both)
    assert fast > 3.0 * slow  # ten times the gain, less what the supply and the ram's start take


def trial(folder: Path, rig: str, valve: str, more: str = ""):
    """A small open-loop trial on a rig file, checked and run."""
    (folder / "rig.toml").write_text(rig, encoding="utf-8")
    command = f'{{ valve = "{valve}", kind = "step", amplitude = "3 V", start = "0.1 s" }}'
    head = 'stage = "trial"\nrig = "rig.toml"\nduration = "0.4 s"\n'
    (folder / "t.toml").write_text(f"{head}{more}\ncommand = [{command}]\n", encoding="utf-8")
    for name in ("rig.toml", "t.toml"):
        assert inspection.check(folder / name).lines[-1] == "ok"
    record, facts = run_trial(load_rig(folder / "rig.toml"), load_recipe(folder / "t.toml"))
    assert not facts.stopped
    assert all(np.isfinite(values).all() for values in record.channels.values())
    return record


def test_a_standard_error_of_a_temperature_is_a_difference():
    row = VOCABULARY["temperature"]
    value = read_value({"value": "40 degC", "std": "2 degC"}, row)
    assert value.std == pytest.approx(2.0) and value.value == pytest.approx(313.15)
