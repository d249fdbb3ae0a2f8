"""TOML that is no rig and no recipe in ways that no editor writes: one sentence, with its line."""

import pytest

from ehbench import workflow
from ehbench.app import inspection
from ehbench.config.recipe import load_recipe, load_rig
from ehbench.vocabulary.errors import EhbenchError, InputError
from tests.shared import ROOT

SLIDE = (ROOT / "recipes" / "rigs" / "slide_servo.toml").read_text(encoding="utf-8")
HEAD = 'stage = "trial"\nrig = "rig.toml"\n'


@pytest.mark.parametrize(
    ("text", "says", "line"),
    [
        (HEAD + "x = " + "[" * 2000 + "]" * 2000, "nested too deeply", None),
        (HEAD + "x = " + "{a=" * 2000 + "1" + "}" * 2000, "nested too deeply", None),
        (HEAD + ".".join(["a"] * 3000) + " = 1", "unknown key 'a'|nested", 3),
        # fields that the program sets
        (HEAD + 'path = "a"', "unknown key 'path'", 3),
        (HEAD + 'motion = { kind = "steps", where = ["a"] }', "unknown key 'motion.where'", 3),
        (HEAD + "seed = " + "9" * 400, "seed = .*less than or equal", 3),
        (HEAD + "seed = " + "9" * 5000, "a whole number is too long", 3),
        (HEAD + "duration = " + "9" * 400, "duration", 3),
        (HEAD + "duration = 1e400", "duration", 3),
        ('stage.x = "identify"', "unknown stage = {'x': 'identify'}", 1),
        ("stage = ['trial']", r"unknown stage = \['trial'\]", 1),
        ("stage = 1979-05-27", "unknown stage", 1),
        ('stage = "' + "x" * 5000 + '"', "unknown stage", 1),
        ('stage = "identify"\nwhat.x = 1', "unknown what = {'x': 1}", 2),
        ('stage = "identify"\nwhat = []', r"unknown what = \[\]", 2),
        ('stage = "validate"\npayload = "a"', "a key of 'data'", 2),
        ('stage = "tune"\nwhat = "arcs"', "what = 'arcs' .what is one of arc, or left out", 2),
        ('stage = "trial"\nwhat = "arc"', "unknown key 'what'", 2),
        ('stage = "trial"\nrig = "a', "close the quotes", 2),
        ("stage = trial", "is in quotes", 1),
        (HEAD + "rig = 'x'", "give each key once", 3),
        ("\ufeff" + HEAD, "'duration' is missing", None),
    ],
)
def test_a_recipe_of_any_shape_is_a_sentence(tmp_path, text, says, line):
    path = tmp_path / "recipe.toml"
    path.write_text(text, encoding="utf-8")
    for read in (load_recipe, inspection.check, workflow.run):
        with pytest.raises(InputError, match=says) as error:
            read(path)
        assert line in (None, error.value.line) and len(str(error.value)) < 1500


VALUES = [*'[] {} [[[]]] true nan 1979-05-27 "\\u0000"'.split(), "9" * 400, "[" * 900 + "]" * 900]


@pytest.mark.parametrize("key", "name title gravity oil supply cylinder payload".split())
@pytest.mark.parametrize("value", VALUES)
def test_a_rig_of_any_shape_is_a_rig_or_a_sentence(tmp_path, key, value):
    path = tmp_path / "rig.toml"
    path.write_text(f"{key} = {value}\n{SLIDE}".replace("\nname = ", "\n# name = ", 1))
    with pytest.raises(EhbenchError) as error:
        load_rig(path)
    assert error.value.file == str(path) and len(str(error.value)) < 1500


def test_a_mark_at_the_begin_of_a_file_is_taken(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_bytes(b"\xef\xbb\xbf" + SLIDE.encode())
    assert load_rig(path).name == "slide_servo"


def test_a_data_file_in_place_of_a_recipe_is_named_as_such(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t [s],press.x [mm]\n0,1\n")
    with pytest.raises(InputError, match="recipes and rig files end in .toml") as caught:
        load_recipe(path)
    assert caught.value.line == 1
