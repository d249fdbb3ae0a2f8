"""Names of files and folders may be of any bytes: nothing is lost for it, and each name stays."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from ehbench.app import starter
from ehbench.config.recipe.toml import read_text
from ehbench.vocabulary.errors import InputError

RIG, STEP, FIT = b"r\xfeg.toml", b"st\xfdp.toml", b"i\xfcd"
# in recipes; a fit to one log is enough
NAMED = {
    b"rig.toml": RIG,
    b"step_small.toml": STEP,
    b'"identify.toml"': b'"../' + FIT + b'"',
    b'  "step_large.toml",\n': b"",
}


@pytest.fixture
def ehbench(door, capfdbinary, unpainted, undiagnosed) -> Callable[..., bytes]:
    """What a command prints; it ends well."""

    def run(folder: bytes, *words: bytes | str) -> bytes:
        code = door(os.fsdecode(folder), *map(os.fsdecode, words))
        printed = capfdbinary.readouterr()
        assert code == 0, printed.err
        return printed.out

    return run


@pytest.fixture
def workspace(tmp_path) -> bytes:
    """A new workspace whose folder, rig and first recipe have names that are no UTF-8."""
    folder = os.fsencode(tmp_path) + b"/w\xffs"
    try:
        starter.init(Path(os.fsdecode(folder)))
    except Exception:
        pytest.skip("the disk takes no such name")
    recipes = folder + b"/recipes/"
    os.rename(folder + b"/rig.toml", folder + b"/" + RIG)
    os.rename(recipes + b"step_small.toml", recipes + STEP)
    for name in os.listdir(recipes):
        with open(recipes + name, "rb+") as file:
            text = file.read()
            for old, new in NAMED.items():
                text = text.replace(old, new)
            file.seek(0)
            file.write(text)
            file.truncate()
    return folder


@pytest.mark.slow
def test_a_fit_its_verdict_and_their_report_are_saved_whole(ehbench, workspace):
    verdict, page = b"v\xfca", b"p\xfcg"
    printed = ehbench(workspace, "identify", "recipes/identify.toml", "-q", "--out", FIT)
    assert printed == FIT + b"\n"
    ehbench(workspace, "validate", "recipes/validate.toml", "--out", verdict)
    ehbench(workspace, "next", FIT, "--out", b"n\xfct.toml")
    ehbench(workspace, "check", b"n\xfct.toml")
    ehbench(workspace, "report", FIT, verdict, "--out", page)
    assert b"bulk_modulus = " in ehbench(workspace, "why", "bulk_modulus", page)
    for run in (FIT, verdict, page):
        for name in os.listdir(workspace + b"/" + run):
            if name.endswith(b".json"):
                with open(workspace + b"/" + run + b"/" + name, encoding="utf-8") as file:
                    json.load(file)
    with open(workspace + b"/" + FIT + b"/volatile.json", encoding="utf-8") as file:
        noted = json.load(file)
    assert os.fsencode(noted["argv"][-1]) == FIT
    assert os.fsencode(noted["inputs"][0]) == os.path.realpath(workspace) + b"/" + RIG


def test_a_trial_and_its_log_in_each_form_keep_their_names(ehbench, workspace):
    out, log = b"o\xfct", b"l\xfag"
    assert ehbench(workspace, "run-trial", b"recipes/" + STEP, "--out", out, "-q") == out + b"\n"
    os.rename(workspace + b"/" + out + b"/log.mcap", workspace + b"/" + log + b".mcap")
    for to in ("mat", "parquet"):
        made = ehbench(workspace, "convert", log + b".mcap", "--to", to)
        assert made == log + b"." + to.encode() + b"\n"
    ehbench(workspace, "map", log + b".parquet")
    assert ehbench(workspace, "show", log + b".parquet") == log + b".html\n"
    ehbench(workspace, "check", log + b".map.toml")


def test_a_recipe_with_other_bytes_that_are_no_text_is_refused_with_its_line(
    door, capfdbinary, workspace
):
    recipe = workspace + b"/bad.toml"
    for line in (b'title = "caf\xe9"\n', b"# caf\xe9\n", b'rig = "none\xe9.toml"\n'):
        with open(recipe, "wb") as file:
            file.write(b'stage = "trial"\n' + line)
        assert door(os.fsdecode(workspace), "check", os.fsdecode(recipe)) == 2
        assert b"bad.toml:2: " in capfdbinary.readouterr().err


def test_a_terminal_of_ascii_gets_every_word_it_can(workspace):
    words = [sys.executable, "-m", "ehbench.app.cli", "check", RIG]
    ascii_only = os.environ | {"PYTHONIOENCODING": "ascii"}
    done = subprocess.run(words, cwd=workspace, env=ascii_only, capture_output=True, check=False)
    assert done.returncode == 0 and done.stdout.isascii()


def test_a_text_too_long_for_a_name_is_no_name(tmp_path):
    recipe = tmp_path / "a.toml"
    recipe.write_bytes(b'title = "' + b"a" * 5000 + b'\xe1"\n')
    with pytest.raises(InputError) as error:
        read_text(recipe)
    assert error.value.key == "config.not_utf8" and error.value.line == 1
