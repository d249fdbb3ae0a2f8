"""What several test modules share; one BLAS thread, as the package's own runs have, before numpy is
loaded."""

import fcntl
import gc
import importlib
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace

os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ.setdefault("MPLBACKEND", "agg")

gc.disable()  # until all tests are known: what is loaded until then stays

from pathlib import Path  # noqa: E402

import pytest  # noqa: E402

from ehbench.runtime import cores  # noqa: E402

# parallel workers share the processors: threads of each on all of them only wait for one another
if beside := int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", 0)):
    _there = cores.cores()
    cores.cores = lambda: max(1, _there // beside)

# modules of the package are loaded by what needs them: of the processes of a parallel run the first
# runs no tests, and the others wait for it
ROOT = Path(__file__).parents[1]
_LEFT = pytest.StashKey[int]()  # how many tests the words after -m leave out


def pytest_collection_finish() -> None:
    """Let the collector of garbage pass over what is there before the first test, modules above
    all: they stay, and to look through them again and again took a twentieth of all the time; and
    let it look less often at what comes after, another twentieth."""
    gc.collect()
    gc.freeze()
    gc.enable()
    gc.set_threshold(50_000, 50, 100)  # in place of 700, 10, 10: what tests make is soon let go


def pytest_sessionfinish() -> None:
    """Let the collector pass over what the tests left once more; pytest does it five times."""
    gc.collect()
    gc.freeze()


def pytest_deselected(items: list[pytest.Item]) -> None:
    """Count what is left out; a worker hands its count to the process that prints."""
    config = items[0].config
    config.stash[_LEFT] = config.stash.get(_LEFT, 0) + len(items)
    if hasattr(config, "workeroutput"):
        config.workeroutput["left"] = config.stash[_LEFT]


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node) -> None:
    """Take a worker's count; all of them leave out the same."""
    if left := getattr(node, "workeroutput", {}).get("left"):
        node.config.stash[_LEFT] = left


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say how much a run without the slow tests leaves open."""
    config = terminalreporter.config
    left = config.stash.get(_LEFT, 0)
    if left and config.option.markexpr == "not slow":
        terminalreporter.write_line(f"{left} slow tests were left out: `make test` runs them too")


@pytest.fixture(scope="session")
def made_once(tmp_path_factory) -> Callable[[str, Callable[[Path], object]], Path]:
    """Gives the folder of a name, filled by the first of the parallel workers that asks for it. It
    is for all: what changes files works on a copy."""
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent

    def made(name: str, fill: Callable[[Path], object]) -> Path:
        folder, part = root / name, root / f"{name}.part"
        with (root / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not folder.exists():
                shutil.rmtree(part, ignore_errors=True)
                part.mkdir()
                fill(part)
                part.rename(folder)
        return folder

    return made


@pytest.fixture(scope="session")
def slide_runs(made_once) -> Path:
    """The runs of the slide's campaign: a fit, its validation, their report."""
    from ehbench import workflow

    recipe = ROOT / "recipes" / "slide_servo" / "campaign.toml"
    return made_once("slide", lambda root: workflow.run(recipe, workflow.Session(root=root)))


@pytest.fixture(scope="session")
def boom_maps(made_once) -> Path:
    """The run of the boom's flow maps, its figures not painted."""
    from ehbench import workflow

    def fill(root: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            _blank(patch)
            recipe = ROOT / "recipes" / "boom_four_valve" / "flow_maps.toml"
            workflow.run(recipe, workflow.Session(root=root))

    return made_once("boom_maps", fill)


@pytest.fixture
def undrawn(monkeypatch) -> None:
    """Runs leave an empty index in place of figures, for tests that look at none: to draw takes
    most of a short run."""
    _undrawn(monkeypatch)


@pytest.fixture(scope="module")
def all_undrawn() -> Iterator[None]:
    """`undrawn` for a module and its fixtures."""
    with pytest.MonkeyPatch.context() as patch:
        _undrawn(patch)
        yield


def _undrawn(patch: pytest.MonkeyPatch) -> None:
    from ehbench.report.saved import FigureIndex

    def draw(folder: Path) -> None:
        FigureIndex(folder).save()

    # by its full name: the package has a function of that name too
    patch.setattr(importlib.import_module("ehbench.report"), "draw", draw)


@pytest.fixture
def unpainted(monkeypatch) -> None:
    """Figures are made with all that stands in them, captions and index too, but saved blank, for
    tests that read what is said of them: to lay out and to paint takes three quarters of a figure.
    """
    _blank(monkeypatch)


def _blank(patch: pytest.MonkeyPatch) -> None:
    from ehbench.report import style

    patch.setattr(style, "painted", lambda page: '<svg xmlns="http://www.w3.org/2000/svg"/>\n')


@pytest.fixture
def unlocused(monkeypatch) -> None:
    """Tunings leave out the root loci and step responses that the report draws, for tests that look
    at gains: python-control takes a third of a tuning for them."""
    module = importlib.import_module("ehbench.tune.gains")  # the package has a function `tune`
    monkeypatch.setattr(module, "_curves", lambda *_: ((), ()))


@pytest.fixture
def undiagnosed(monkeypatch) -> None:
    """Validations judge by their checks, for tests that look at nothing else: to ask what the
    residuals say of the model takes most of one."""
    from ehbench.diagnosis import Structure

    module = importlib.import_module("ehbench.validation.judge")
    monkeypatch.setattr(module, "ask", lambda _: Structure())


@pytest.fixture
def door(monkeypatch) -> Iterator[Callable[..., int]]:
    """The command by its entry point in this process, which saves seconds: its exit code."""
    from ehbench.app import cli

    monkeypatch.setattr(sys, "excepthook", sys.excepthook)  # the door sets it, and the signal
    before, collects = signal.getsignal(signal.SIGTERM), gc.get_threshold()

    def enter(folder: str | Path, *words: str | Path) -> int:
        monkeypatch.setattr(sys, "argv", ["ehbench", *map(str, words)])
        monkeypatch.chdir(folder)
        with pytest.raises(SystemExit) as left:
            cli.main()
        return int(left.value.code or 0)

    yield enter
    signal.signal(signal.SIGTERM, before)
    gc.set_threshold(*collects)


@pytest.fixture
def inside(door, monkeypatch, capsys) -> Callable[..., subprocess.CompletedProcess]:
    """The command with what it prints on a plain terminal."""
    for name, value in {"COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}.items():
        monkeypatch.setenv(name, value)

    def run(*words: str | Path, cwd: Path = ROOT) -> subprocess.CompletedProcess:
        return subprocess.CompletedProcess(words, door(cwd, *words), *capsys.readouterr())

    return run


@pytest.fixture
def kept(monkeypatch) -> None:
    """The package's functions leave a run alone that stands with the very same inputs, as campaigns
    do: many examples run one recipe, each to show another word."""
    import ehbench

    made = ehbench._session
    monkeypatch.setattr(ehbench, "_session", lambda *of, **by: replace(made(*of, **by), keep=True))


@pytest.fixture(scope="session")
def workspace(tmp_path_factory, slide_runs, boom_maps) -> Path:
    """Where the examples of docs and docstrings run: beside the repository's recipes and datasets,
    a new workspace ``my_rig``, the runs of the slide's campaign and of the boom's flow maps, and a
    run ``reports/flow_maps`` of one valve's readings."""
    from ehbench import workflow
    from ehbench.app import starter

    folder = tmp_path_factory.mktemp("docs")
    for runs in (slide_runs, boom_maps):
        shutil.copytree(runs, folder / "reports", dirs_exist_ok=True)
    for name in ("recipes", "datasets"):
        (folder / name).symlink_to(ROOT / name)
    starter.init(folder / "my_rig")
    recipe = folder / "one_valve.toml"
    recipe.write_text(
        'stage = "identify"\nwhat = "flow_map"\nrig = "recipes/rigs/boom_four_valve.toml"\n'
        'data = ["datasets/boom_four_valve/flowmeter/sh.csv"]\n',
        encoding="utf-8",
    )
    with pytest.MonkeyPatch.context() as patch:
        _blank(patch)
        workflow.run(recipe, workflow.Session(out=folder / "reports" / "flow_maps"))
    return folder
