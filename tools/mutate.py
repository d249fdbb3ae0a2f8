"""Whether tests notice wrong code: one change each of cosmic-ray's, drawn at random, in a copy of
the tree, and the share that the tests nearest to the module kill.

python -m tools.mutate [MUTANTS] [MINUTES] [SEED]
"""

import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PACKAGES = ("identification", "diagnosis", "validation", "flow_maps", "tune")
# of cosmic-ray's operators those that people could write: another sign, order, bound or constant
CHANGES = (
    *("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul"),
    *("Lt_GtE", "Gt_LtE", "LtE_Lt", "GtE_Gt", "Eq_NotEq", "NotEq_Eq"),
    *("AndWithOr", "OrWithAnd", "TrueWithFalse", "FalseWithTrue", "Delete_Not", "NumberReplacer"),
)
LONGEST = 300.0  # [s] of the tests of a mutant: one that hangs is killed


class Mutant(NamedTuple):
    """A change of a module: cosmic-ray's operator, and at which of its places."""

    module: Path
    operator: str
    place: int

    def source(self) -> str | None:
        """The module with the change."""
        from cosmic_ray.mutating import mutate_code  # pyright: ignore[reportMissingImports]
        from cosmic_ray.plugins import get_operator  # pyright: ignore[reportMissingImports]

        text = (ROOT / self.module).read_text(encoding="utf-8")
        return mutate_code(text, get_operator(self.operator)(), self.place)


def places(module: Path) -> list[Mutant]:
    """Every change of a module."""
    from cosmic_ray.ast import ast_nodes, get_ast  # pyright: ignore[reportMissingImports]
    from cosmic_ray.plugins import get_operator, operator_names  # pyright: ignore[reportMissingImports]

    nodes = list(ast_nodes(get_ast((ROOT / module).read_text(encoding="utf-8"))))
    results = []
    for name in (name for name in operator_names() if name.endswith(CHANGES)):
        operator = get_operator(name)()
        found = sum(1 for node in nodes for _ in operator.mutation_positions(node))
        results += [Mutant(module, name, place) for place in range(found)]
    return results


def mutants(seed: int) -> Iterator[Mutant]:
    """Mutants in a random order, each module as likely as it is long."""
    rng = random.Random(seed)
    modules = [
        path.relative_to(ROOT)
        for package in PACKAGES
        for path in sorted((ROOT / "ehbench" / package).rglob("*.py"))
    ]
    sizes = [(ROOT / path).stat().st_size for path in modules]
    left: dict[Path, list[Mutant]] = {}
    while True:
        (module,) = rng.choices(modules, sizes)
        if module not in left:
            left[module] = places(module)
            rng.shuffle(left[module])
        if left[module]:
            yield left[module].pop()


def nearest(module: Path) -> list[str]:
    """Tests that name a module, else those that name its package, the quickest folder first."""
    dotted = ".".join(module.with_suffix("").parts).removesuffix(".__init__")
    tests = sorted((ROOT / "tests").rglob("test_*.py"), key=lambda path: path.parent.name[::-1])
    for name in (dotted, dotted.rpartition(".")[0]):
        named = [p for p in tests if name in p.read_text(encoding="utf-8")]
        if named:
            return [str(path.relative_to(ROOT)) for path in named]
    return ["tests/unit"]


def copied(folder: Path) -> None:
    """The tree, its package and tests as files of their own, with the kernels' machine code."""
    for path in ROOT.iterdir():
        if path.name in ("ehbench", "tests", "tools"):
            shutil.copytree(path, folder / path.name, symlinks=True)
        elif path.name not in (".git", "reports", "build"):
            (folder / path.name).symlink_to(path)


def fails(tests: Sequence[str], folder: Path) -> bool:
    """Whether a test fails in the copy, or hangs."""
    words = ["-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-m", "not slow", *tests]
    given = {"cwd": folder, "env": os.environ | {"PYTHONPATH": str(folder)}}
    try:
        done = subprocess.run(
            [sys.executable, *words], **given, capture_output=True, timeout=LONGEST
        )
    except subprocess.TimeoutExpired:
        return True
    return done.returncode not in (0, 5)  # 5: all of them are slow


def killed(mutant: Mutant, folder: Path, sound: dict[str, bool]) -> bool:
    """Whether a test fails with the change, of those that do not fail without it (``sound``)."""
    tests = nearest(mutant.module)
    for test in tests:
        if test not in sound:
            sound[test] = not fails([test], folder)
    place, source = folder / mutant.module, mutant.source()
    assert source is not None  # `places` counts only such
    whole = place.read_text(encoding="utf-8")
    place.write_text(source, encoding="utf-8")
    try:
        return fails([test for test in tests if sound[test]], folder)
    finally:
        place.write_text(whole, encoding="utf-8")


def main(arguments: Sequence[str]) -> None:
    """Draw mutants until there are enough or time is over; print those that survive, and the share
    that is killed by package.
    """
    count, minutes, seed = (*map(int, arguments), *(300, 30, 1)[len(arguments) :])
    ends, all_of, dead = time.monotonic() + 60.0 * minutes, Counter[str](), Counter[str]()
    sound: dict[str, bool] = {}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        copied(folder)
        for mutant in mutants(seed):
            if all_of.total() == count or time.monotonic() > ends:
                break
            package = mutant.module.parts[1]
            gone = killed(mutant, folder, sound)
            all_of[package] += 1
            dead[package] += gone
            if not gone:
                print(f"survives: {mutant.module} {mutant.operator} {mutant.place}", flush=True)
    broken = [test for test, passes in sound.items() if not passes]
    print(f"not asked, as they fail without a change: {', '.join(broken) or 'none'}")
    for package in (*all_of, "all"):
        some, of = (n[package] if package != "all" else n.total() for n in (dead, all_of))
        print(f"{package}: {some} of {of} killed, {100.0 * some / max(of, 1):.0f} %")


if __name__ == "__main__":
    main(sys.argv[1:])
