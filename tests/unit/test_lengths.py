"""A function fits on a page: as many lines as the gates in pyproject.toml allow."""

import ast
import tomllib
from collections.abc import Iterator

from tests.shared import ROOT

MODULES = sorted(p for p in (ROOT / "ehbench").rglob("*.py") if "__pycache__" not in p.parts)
GATES = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["ehbench"]


def lengths(text: str) -> Iterator[tuple[str, int]]:
    """(name, lines from its ``def`` to its end) of every function in a module's text."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno is not None
            yield node.name, node.end_lineno - node.lineno + 1


def test_no_function_is_longer_than_a_page():
    text = (
        'class A:\n    @property\n    def f(\n        self\n    ):\n        """Doc."""\n'
        "        return 1\n"
    )
    assert dict(lengths(text)) == {"f": 5}
    most, longer = GATES["gates"]["function-lines"], {}
    for path in MODULES:
        for name, lines in lengths(path.read_text(encoding="utf-8")):
            if lines > most:
                longer[f"{path.relative_to(ROOT).as_posix()}: {name}"] = lines
    assert longer == {}
