"""A module imports only from lower floors, or from its own package."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "ehbench"
# lowest first; within a row nobody imports a neighbour
FLOORS = [
    {"sources", "cores", "interrupts"},
    {"codes", "commands", "errors", "quantities", "compiled", "blas", "terms"}
    | {"text", "usual_units"},
    {"units", "disk", "memory"},
    {"fields", "notebook", "oscillation"},
    {"physics", "signals", "stamps"},
    {"parts"},
    {"control"},
    {"record", "rig"},
    {"recipe", "readers"},
    {"logs"},
    {"rundir"},
    {"plant"},
    {"machines"},
    {"ledger", "observations", "preprocessing", "sensors"},
    {"gaps", "starts"},
    {"response", "structure", "transfer"},
    {"identification", "validation", "tune", "trial", "report", "sampling"},
    {"stages"},
    {"workflow", "starter"},
    {"inspection", "mapping", "converting"},
    {"__init__", "cli", "datasets", "benchmark", "reference", "study", "warm"},
    {"__main__"},
]
RANK = {name: rank for rank, names in enumerate(FLOORS) for name in names}
# the virtual bench's numbers must not reach what is judged on its logs: who opens one, and no other
BENCH = ("machines.virtual", "machines.registry")
BENCH_READERS = {
    *("machines/registry.py", "machines/variation.py"),
    *("trial/preparation.py", "datasets.py"),
}
MODULES = sorted(p for p in PACKAGE.rglob("*.py") if "__pycache__" not in p.parts)


def top(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


@cache
def imports(path: Path) -> set[str]:
    """Dotted names inside the package that a file imports, anywhere in it; annotations only are
    exempt from nothing.
    """
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names if a.name.split(".")[0] == "ehbench"}
        elif isinstance(node, ast.ImportFrom):
            assert node.module and not node.level, f"{path}: a relative import hides its floor"
            if node.module.split(".")[0] == "ehbench":
                found |= {f"{node.module}.{a.name}" for a in node.names}
    return {name.removeprefix("ehbench.") for name in found if name != "ehbench"}


def test_every_module_has_its_floor_and_only_one():
    assert sorted(name for floor in FLOORS for name in floor) == sorted({*map(top, MODULES)})


def test_imports_only_from_lower_floors():
    above = []
    for path in MODULES:
        own = top(path)
        for name in imports(path):
            other = name.split(".")[0]
            within = other == own and path.parent != PACKAGE
            if not within and RANK[other] >= RANK[own]:
                place = path.relative_to(PACKAGE).as_posix()
                above.append(f"{place} (floor {RANK[own]}) imports {name} (floor {RANK[other]})")
    assert above == []


def test_the_bench_is_seen_by_trials_only():
    readers = {
        path.relative_to(PACKAGE).as_posix()
        for path in MODULES
        if any(name.startswith(BENCH) for name in imports(path))
        and path.parent != PACKAGE / "machines" / "virtual"
    }
    assert readers == BENCH_READERS


def test_reports_read_files_only():
    for path in (PACKAGE / "report").rglob("*.py"):
        for name in imports(path):
            assert name.startswith("report") or RANK[name.split(".")[0]] <= RANK["rundir"]
