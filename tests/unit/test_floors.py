"""A module imports only from lower floors; inside a package no imports form a cycle."""

import ast
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "ehbench"
# lowest first; within a row nobody imports a neighbour
FLOORS = [
    {"vocabulary"},
    {"runtime"},
    {"physics", "signals"},
    {"parts"},
    {"control"},
    {"config"},
    {"data"},
    {"runs"},
    {"plant"},
    {"machines", "preprocessing"},
    {"ledger", "sampling"},
    {"diagnosis", "flow_maps", "frequency_response"},
    {"identification", "validation", "tune", "trial", "report"},
    {"guidance", "export", "links", "live"},
    {"stages"},
    {"workflow"},
    {"app"},
    {"__init__"},
    {"__main__"},
]
RANK = {name: rank for rank, names in enumerate(FLOORS) for name in names}
# the virtual bench's numbers must not reach what is judged on its logs: who opens one, and no other
BENCH = ("machines.virtual", "machines.registry")
BENCH_READERS = {"machines/registry.py", "trial/preparation.py"}
MODULES = sorted(p for p in PACKAGE.rglob("*.py") if "__pycache__" not in p.parts)


def top(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


@cache
def imports(path: Path) -> set[str]:
    """Dotted names inside the package that a file imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names if a.name.split(".")[0] == "ehbench"}
        elif isinstance(node, ast.ImportFrom):
            assert node.module and not node.level, f"{path}: a relative import hides its floor"
            if node.module.split(".")[0] == "ehbench":
                found |= {f"{node.module}.{a.name}" for a in node.names}
    return {name.removeprefix("ehbench.") for name in found if name != "ehbench"}


def test_every_module_has_a_floor_and_imports_from_lower_ones():
    assert sorted(name for floor in FLOORS for name in floor) == sorted({*map(top, MODULES)})
    above = []
    for path in MODULES:
        own = top(path)
        for name in imports(path):
            other = name.split(".")[0]
            within = other == own and path.parent != PACKAGE  # `test_no_cycle` asks these
            if not within and RANK[other] >= RANK[own]:
                place = path.relative_to(PACKAGE).as_posix()
                above.append(f"{place} (floor {RANK[own]}) imports {name} (floor {RANK[other]})")
    assert above == []


def _module(path: Path) -> str:
    """The dotted name of a file inside the package."""
    name = path.relative_to(PACKAGE).with_suffix("").as_posix().replace("/", ".")
    return name.removesuffix(".__init__")


def test_no_cycle_inside_a_package():
    names = {_module(path) for path in MODULES}
    graph = {
        _module(path): {
            module
            for name in imports(path)
            for module in (name if name in names else name.rpartition(".")[0],)
            if module in names and module != _module(path)
        }
        for path in MODULES
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        raise AssertionError(f"these import each other: {' → '.join(error.args[1])}") from None


def test_the_bench_is_seen_by_trials_and_reports_read_files_only():
    readers = {
        path.relative_to(PACKAGE).as_posix()
        for path in MODULES
        if any(name.startswith(BENCH) for name in imports(path))
        and path.parent != PACKAGE / "machines" / "virtual"
    }
    assert readers == BENCH_READERS
    for path in (PACKAGE / "report").rglob("*.py"):
        for name in imports(path):
            assert name.startswith("report") or RANK[name.split(".")[0]] <= RANK["runs"]
