"""Whether tests notice wrong code: one change each of cosmic-ray's, drawn at random, in a copy of
the tree, and the share that the quick tests kill. A line that only others run, or none, lets its
mutants survive; one that hangs is killed, and named.

python -m tools.mutate [MUTANTS] [MINUTES] [SEED]"""

import ast
import difflib
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]
SEEN = ROOT / "build" / "mutate"  # which tests run which line, until a source is newer
STORED = "tests/unit/test_versions.py"  # asks the numbers of every method
PACKAGES = ("identification", "diagnosis", "validation", "flow_maps", "tune")
# of cosmic-ray's operators those that people could write: another sign, order, bound or constant
CHANGES = (
    *("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul"),
    *("Lt_GtE", "Gt_LtE", "LtE_Lt", "GtE_Gt", "Eq_NotEq", "NotEq_Eq"),
    *("AndWithOr", "OrWithAnd", "TrueWithFalse", "FalseWithTrue", "Delete_Not", "NumberReplacer"),
)
# words that only refuse what no caller does, what is shown of progress, how many threads work, how
# much is kept or written over to be fast: no number that anybody gets depends on these
NO_CHANGE = re.compile(
    r"\b(strict|frozen|eq|repr) ?= ?(True|False)|\b(report|progress)\([^\n]*"
    r"|\bworkers: int = .*|\bworkers (or|and) cores\(\)|\blru_cache\([^)\n]*\)"
    r"|\boverwrite_\w+=\d|\barbitrary_types_\w+=\w+"
)
_NUMBER = re.compile(r"(?<![\w.])-? ?\d+\.?\d*(?:e[-+]?\d+)?")
LEAST = 1.0 / 3.0  # change of a number, of itself: tests hold thresholds to a third (CONTRIBUTING)
TINY = (
    1e-3  # below it a step or a guard against zero: 1 more is a change, 1 less a sign that nobody
)
# would write
LONGEST = 120.0  # [s] of the tests of a mutant: one that hangs is killed
ENOUGH = 30.0  # [s] of tests
QUICK = 0.2  # [s] of a test


class Change(NamedTuple):
    """A mutant's module as text, the number of the line that it changes, and that line, before and
    after."""

    source: str
    line: int
    before: str
    after: str


def is_small(before: str, after: str) -> bool:
    """Whether a number changes by less than `LEAST` of itself, or a `TINY` one only its sign."""
    pairs = zip(_NUMBER.findall(before), _NUMBER.findall(after), strict=False)
    changed = next(((a, b) for a, b in pairs if a.strip() != b.strip()), None)
    if changed is None:
        return False
    old, new = (float(text.replace(" ", "")) for text in changed)
    return abs(new - old) < LEAST * abs(old) or new < 0.0 < old < TINY


class Mutant(NamedTuple):
    """A change of a module: cosmic-ray's operator, and at which of its places."""

    module: Path
    operator: str
    place: int

    def change(self) -> Change | None:
        """What it does; None where that means nothing."""
        from cosmic_ray.mutating import mutate_code
        from cosmic_ray.plugins import get_operator

        text = (ROOT / self.module).read_text(encoding="utf-8")
        source = mutate_code(text, get_operator(self.operator)(), self.place)
        assert source is not None  # `places` counts only such
        number = self.operator.endswith("NumberReplacer")
        if (
            NO_CHANGE.sub("", source) == NO_CHANGE.sub("", text)
            or number
            and is_small(text, source)
        ):
            return None
        a, b = text.splitlines(), source.splitlines()
        tag = next(x for x in difflib.SequenceMatcher(None, a, b).get_opcodes() if x[0] != "equal")
        return Change(source, tag[1] + 1, a[tag[1]].strip(), b[tag[3]].strip())


def places(module: Path) -> list[Mutant]:
    """Every change of a module."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.plugins import get_operator, operator_names

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


def copied(folder: Path) -> None:
    """The tree, its package and tests as files of their own, with the kernels' machine code."""
    folder.mkdir()
    for path in ROOT.iterdir():
        if path.name in ("ehbench", "tests", "tools"):
            shutil.copytree(path, folder / path.name, symlinks=True)
        elif path.name not in (".git", "reports", "build"):
            (folder / path.name).symlink_to(path)


def pytest(folder: Path, words: Sequence[str], timeout: float | None) -> tuple[int, str]:
    """Exit code and output of the quick tests in the copy."""
    words = ["-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "not slow", *words]
    environment = os.environ | {"PYTHONPATH": str(folder)}
    done = subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env=environment,
        capture_output=True,
        timeout=timeout,
        encoding="utf-8",
    )
    return done.returncode, done.stdout


def statement(text: str, line: int) -> range | None:
    """The lines of the innermost statement around one, without its body; None where it runs as the
    module is imported."""
    nodes = [
        node
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.stmt) and node.lineno <= line <= (node.end_lineno or line)
    ]
    if not any(isinstance(n, ast.FunctionDef) and n.body[0].lineno <= line for n in nodes):
        return None
    inner: Any = max(nodes, key=lambda node: node.lineno)
    end = inner.body[0].lineno if hasattr(inner, "body") else inner.end_lineno + 1
    return range(inner.lineno, max(end, inner.lineno + 1))


def bound(text: str, line: int) -> str:
    """The constant or setting that a line outside of functions gives a value, '' if none."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Assign | ast.AnnAssign | ast.AugAssign):
            target: Any = node.targets[0] if isinstance(node, ast.Assign) else node.target
            if node.lineno <= line <= (node.end_lineno or line) and isinstance(target, ast.Name):
                return target.id
    return ""


class Runs:
    """Which quick tests run a line, and how long each takes [s]."""

    def __init__(self, folder: Path) -> None:
        from coverage import CoverageData

        data, said = SEEN / "coverage", SEEN / "durations.txt"
        newest = max(
            path.stat().st_mtime
            for part in ("ehbench", "tests")
            for path in (ROOT / part).rglob("*.py")
        )
        if not said.exists() or said.stat().st_mtime < newest:
            SEEN.mkdir(parents=True, exist_ok=True)
            given = [f"    ehbench.{package}" for package in PACKAGES]
            settings = ["[run]", f"data_file = {data}", "source =", *given]
            (SEEN / "settings").write_text("\n".join(settings), encoding="utf-8")
            words = ["--cov", f"--cov-config={SEEN / 'settings'}", "--cov-context=test"]
            words += ["--cov-report=", "--durations=0", "--durations-min=0.001", "-rfE"]
            cores = ["-n", str(os.cpu_count()), "--dist", "worksteal"]
            said.write_text(pytest(folder, [*words, *cores], None)[1], encoding="utf-8")
        text = said.read_text(encoding="utf-8")
        self.broken = set(re.findall(r"^(?:FAILED|ERROR) (\S+)", text, re.MULTILINE))
        self.seconds: defaultdict[str, float] = defaultdict(float)
        for number, test in re.findall(r"^([\d.]+)s (?:setup|call) +(\S.*)$", text, re.MULTILINE):
            self.seconds[test.strip()] += float(number)
        self.data = CoverageData(str(data))
        self.data.read()
        self.files = {
            Path(*Path(name).parts[Path(name).parts.index("ehbench") :]): name
            for name in self.data.measured_files()
        }

    def of(self, module: Path, line: int) -> list[str]:
        """The tests of a line for `ENOUGH` seconds: first those of files that import its module and
        those of stored numbers; all that are `QUICK`, then one case of each test before any second,
        the quickest first.

        A constant's are those of the lines that name it, anywhere, and of the test files that do.
        Where tests share a result, only the first of them runs the line: then the others of its
        file follow."""
        text = (ROOT / module).read_text(encoding="utf-8")
        inside, word = statement(text, line), bound(text, line)
        names: set[str] = set()
        if inside is None and word:
            for other in self.files:
                rows = (ROOT / other).read_text(encoding="utf-8").splitlines()
                named = [i for i, row in enumerate(rows, 1) if re.search(rf"\b{word}\b", row)]
                names |= self.contexts(other, named)
        names = names or self.contexts(module, inside)
        tests = {name.rpartition("|")[0] for name in names} - {"", *self.broken}
        head, _, tail = (
            ".".join(module.with_suffix("").parts).removesuffix(".__init__").rpartition(".")
        )
        imported = rf"\b{head}(\.| import (\([^)]*|.*)\b){tail}\b"
        near, more, seen = set(), set(), {test.partition("::")[0] for test in tests}
        constant = rf"\b{word}\b" if inside is None and word else "(?!)"  # which matches nothing
        for file in {test.partition("::")[0] for test in self.seconds}:
            content = (ROOT / file).read_text(encoding="utf-8")
            near |= {file} if re.search(imported, content) or file == STORED else set()
            shares = file in seen and re.search(r"@cache\b|scope=.module", content)
            if shares or re.search(constant, content):
                more |= {test for test in self.seconds if test.startswith(f"{file}::")}
        cases, order = Counter[str](), []
        for test in sorted(tests | more - self.broken, key=lambda test: (self.seconds[test], test)):
            case = cases[test.partition("[")[0]] = cases[test.partition("[")[0]] + 1
            file = test.partition("::")[0]
            early = file == STORED or self.seconds[test] < QUICK
            order.append((file not in near, test not in tests, not early and case, test))
        some, total = [], 0.0
        for *_, test in sorted(order, key=lambda item: item[:3]):
            total += self.seconds[test]
            if some and total > ENOUGH:
                break
            some.append(test)
        return some

    def contexts(self, module: Path, lines: Sequence[int] | None) -> set[str]:
        """What runs some lines of a module; any of its lines for None."""
        known = self.data.contexts_by_lineno(self.files.get(module, ""))
        return {name for line in lines or known for name in known.get(line, ())}


def kills(mutant: Mutant, change: Change, folder: Path, runs: Runs) -> bool:
    """Whether a test fails with the change, or hangs."""
    tests = runs.of(mutant.module, change.line)
    if not tests:
        print("no quick test runs it:", end=" ")
        return False
    place = folder / mutant.module
    whole = place.read_text(encoding="utf-8")
    place.write_text(change.source, encoding="utf-8")
    try:
        return pytest(folder, ["-x", *tests], LONGEST)[0] not in (0, 5)
    except subprocess.TimeoutExpired:
        print(f"hangs: {mutant.module}:{change.line}\n    {change.after}", flush=True)
        return True
    finally:
        place.write_text(whole, encoding="utf-8")


def main(arguments: Sequence[str]) -> None:
    """Draw mutants until there are enough or time is over; print those that survive, and the share
    that is killed by package."""
    count, minutes, seed = (*map(int, arguments), *(300, 30, 1)[len(arguments) :])
    all_of, dead, cores = Counter[str](), Counter[str](), os.cpu_count() or 1
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(cores) as pool:
        free = SimpleQueue[Path]()
        for core in range(cores):
            copied(Path(scratch, str(core)))
            free.put(Path(scratch, str(core)))
        runs = Runs(Path(scratch, "0"))
        ends = time.monotonic() + 60.0 * minutes

        def is_killed(pair: tuple[Mutant, Change]) -> bool:
            folder = free.get()
            try:
                return kills(*pair, folder, runs)
            finally:
                free.put(folder)

        pairs = ((m, change) for m in mutants(seed) if (change := m.change()) is not None)
        while all_of.total() < count and time.monotonic() < ends:
            some = list(islice(pairs, min(4 * cores, count - all_of.total())))
            for (mutant, change), gone in zip(some, pool.map(is_killed, some), strict=True):
                package = mutant.module.parts[1]
                all_of[package] += 1
                dead[package] += gone
                if not gone:
                    print(f"survives: {mutant.module}:{change.line}", flush=True)
                    print(f"    {change.before}\n    {change.after}", flush=True)
    print(f"not asked, as they fail without a change: {', '.join(runs.broken) or 'none'}")
    for package in (*all_of, "all"):
        some, of = (n[package] if package != "all" else n.total() for n in (dead, all_of))
        print(f"{package}: {some} of {of} killed, {100.0 * some / max(of, 1):.0f} %")


if __name__ == "__main__":
    main(sys.argv[1:])
