"""The catalogue of messages: every entry is used, and every use has its entry and its fields."""

import ast
import copy
import pickle
import re
import string
import tomllib
from pathlib import Path

import pytest

from ehbench.runs.rundir import read_json, write_json
from ehbench.vocabulary import messages
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.messages import Message, message
from ehbench.vocabulary.settings import rows, setting

PACKAGE = Path(messages.__file__).parents[1]
ENTRIES = {
    f"{path.stem}.{name}": entry if isinstance(entry, dict) else {"text": entry}
    for path in messages.CATALOGUE.glob("*.toml")
    for name, entry in tomllib.loads(path.read_text(encoding="utf-8")).items()
}


def _uses() -> list[tuple[str, str, set[str] | None]]:
    """(place, key, names of fields or None where they are unpacked) of each call of `message`, and
    of those of a ``misuse`` by its key, which has a label too."""
    uses, names_of = [], {"message": set(), "misuse": {"label"}}
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            called = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
            if (called := called.rpartition(".")[2]) not in names_of:
                continue
            names = [keyword.arg for keyword in node.keywords]
            fields = None if None in names else {*names} | names_of[called]
            place = f"{path.relative_to(PACKAGE)}:{node.lineno}"
            keys = [n for n in ast.walk(node.args[0]) if isinstance(n, ast.Constant)]
            uses += [(place, str(key.value), fields) for key in keys if key.value in ENTRIES]
            if isinstance(node.args[0], ast.Constant) and node.args[0].value not in ENTRIES:
                uses.append((place, str(node.args[0].value), fields))
    return uses


def _named(entry: dict[str, str]) -> set[str]:
    """The fields that an entry names."""
    parsed = [part for text in entry.values() for part in string.Formatter().parse(text)]
    return {name.split(".")[0].split("[")[0] for _, name, _, _ in parsed if name}


def test_every_use_has_its_entry_and_every_entry_its_use():
    wrong = []
    for place, key, fields in _uses():
        if key not in ENTRIES:
            wrong.append(f"{place}: no entry {key}")
        elif fields is not None and (missing := _named(ENTRIES[key]) - fields):
            wrong.append(f"{place}: {key} lacks {missing}")
    assert wrong == []
    texts = "".join(path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py"))
    begun = tuple(re.findall(r'message\(\s*f"([a-z_]+\.\w*)\{', texts))  # f"part.name_{{kind}}"
    unused = [key for key in ENTRIES if f'"{key}"' not in texts and not key.startswith(begun)]
    assert unused == []


def test_a_message_keeps_its_key_and_fields_and_an_unknown_one_is_a_bug(tmp_path):
    original = Message("3 of 4 fail", "data.fail", {"count": 3}, "look at them")
    for copied in (copy.deepcopy(original), pickle.loads(pickle.dumps(original))):
        assert (copied, copied.key, copied.fields) == ("3 of 4 fail", "data.fail", {"count": 3})
    error = InputError(original)
    assert (error.key, error.fields["count"], error.hint) == ("data.fail", 3, "look at them")
    write_json(tmp_path / "a.json", {"notes": [original, "plain"]})
    first, second = read_json(tmp_path / "a.json")["notes"]
    assert (first, first.key, first.fields) == (str(original), "data.fail", {"count": 3})
    assert second == "plain"
    with pytest.raises(KeyError):
        message("data.no_such_entry")


@pytest.mark.parametrize(
    ("value", "shown"),
    [(112.3, "110 %"), (12.34, "12 %"), (0.5, "0.5 %"), (1.26e5, "130000 %"), (3e6, "3e+06 %")],
)
def test_numbers_below_a_million_have_no_exponent(value, shown):
    assert message("faults.load_more", names="x", percent=value).split("is ")[1].startswith(shown)
    drift = message("flow_maps.warm_flow", share=-value, half=1.0, kelvin=5)
    assert f"-{shown.split()[0]} ±" in drift


def test_a_count_goes_with_its_word():
    """An s, or both forms where that is not enough."""
    drops = [message("flow_maps.few_drops", map="m", count=count) for count in range(3)]
    assert [drop.split(" at ")[1] for drop in drops] == [
        *("0 pressure drops", "1 pressure drop", "2 pressure drops")
    ]
    gone = [message("data.first_missing", topic="a", count=count, t=0.0) for count in (1, 2)]
    assert [text.split(" missing")[0] for text in gone] == [
        *("a: the first 1 sample is", "a: the first 2 samples are")
    ]


def test_a_share_is_written_with_a_space_before_its_sign():
    assert "82 % of v" in message("validation.unexplained", log="a", share=0.82, channel="v")


def test_commands_that_texts_advise_are_there():
    from typer.main import get_command

    from ehbench.app.cli import app

    advised = re.compile(r"ehbench ([a-z][a-z-]+) (?=FILE|\{|reports/|[\w/]+\.toml)")
    files = (path for kind in ("*.py", "*.toml") for path in PACKAGE.rglob(kind))
    words = {word for path in files for word in advised.findall(path.read_text(encoding="utf-8"))}
    assert {"check", "map"} <= words <= set(get_command(app).commands)  # type: ignore[attr-defined]


def test_settings_list_themselves():
    from dataclasses import dataclass

    @dataclass(frozen=True)
    class Settings:
        window: float = setting(0.1, "s", "Length of a window.", "Half a period at 5 Hz.")

    about = ("s", "Length of a window.", "Half a period at 5 Hz.")
    assert rows(Settings()) == [("window", 0.1, *about)]


def test_steps_of_one_text_are_as_many_as_their_lines():
    steps = [message("steps.free", line=line) for line in ('"b"', '"a"', '"b"')]
    first = message("steps.compare_position", line="x")
    assert [step.hint for step in messages.ranked([*steps, first])] == ["x", '"b",', '"a",']
