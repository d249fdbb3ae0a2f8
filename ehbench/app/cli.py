"""The command line: parse, call a workflow function, print its result, return the exit code."""

from __future__ import annotations

import codecs
import errno
import gc
import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from inspect import Parameter, Signature
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer
from typer.core import TyperGroup

from ehbench.runtime.cores import cores
from ehbench.runtime.disk import write_text
from ehbench.runtime.interrupts import Terminated, ended, listen
from ehbench.vocabulary import EhbenchError, InputError, message
from ehbench.vocabulary.commands import COMMANDS, Command
from ehbench.vocabulary.text import shortened_path

if TYPE_CHECKING:
    from ehbench.report.terminal import Answer
    from ehbench.workflow import Session


class _Commands(TyperGroup):
    """The commands; a word that is none of an option's is refused in plain words."""

    def invoke(self, ctx: Any) -> Any:
        """As typer's, which leaves its checker's own prefix before the sentence."""
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            error.message = error.message.removeprefix("Value error, ")
            raise


app = typer.Typer(
    name="ehbench",
    cls=_Commands,
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Workbench for electrohydraulic test rigs: flowmeter readings and step logs in; "
    "flow maps, bulk modulus and\ndamping with error bars, a judged model and a report out.\n\n"
    "Exit codes: 0 done, 1 a bug, 2 usage or a bad file, 3 finished with data loss, "
    "4 model rejected, a tuning's demands missed or data not sufficient,\n5 a trial stopped on a "
    "limit.",
    epilog="Example:  ehbench reproduce thesis",
)


def _option(kind: Any, default: Any, usage: str, text: str, **more: Any) -> tuple[Any, Any]:
    """(type, default) of an option by its usage: ``--as FORMAT``, ``--verbose -v``."""
    names = [word for word in usage.split() if word.startswith("-")]
    more["metavar"] = next((word for word in usage.split() if not word.startswith("-")), None)
    about = typer.Option(*names, help=text, show_default=bool(default), **more)
    return Annotated[kind, about], default


def _word(kind: Any, metavar: str | None, text: str, default: Any = Parameter.empty) -> Any:
    """(type, default) of a word that stands by its place."""
    return Annotated[kind, typer.Argument(metavar=metavar, help=text)], default


def _pem(usage: str, what: str) -> tuple[Any, Any]:
    return _option(Path | None, None, usage, f"With --workers tls://…: {what} (PEM).")


_OUT = "Folder for the run. Default: reports/<recipe>_<hash8>/."
_LOUD = "All tables, steps and notes; or no progress, and only the run's path."
_FORMATS = "c, fmu2, fmu3, matlab, urdf, mjcf. Default: c."
_EXPORTED = "A validated rig, a tuning, a trial with a controller, or an export's recipe."
_SILENCE = "Silence after which it stops, in ms. Default: 20, or four samples."
_OWNER = "Whose cylinders and valves they are. Default: rig.toml here, if there is one."
_NUMBER = "A number: a parameter, or the end of its path in the run's JSON."
# of several commands
_OPTIONS: dict[str, tuple[Any, Any]] = {
    "file": _word(Path, "recipe", "Recipe (TOML)."),
    "out": _option(Path | None, None, "--out", _OUT),
    "loud": _option(bool | None, None, "--verbose/--quiet -v/-q", _LOUD),
    "as_json": _option(bool, False, "--json", "Print what was found as JSON."),
    "verbose": _option(bool, False, "--verbose -v", "All tables, steps and notes."),
    "columns": _option(Path | None, None, "--columns", "A map of the columns of a log by others."),
    "allow_code": _option(
        bool, False, "--allow-code", "Let code of your own run: a controller, an FMU."
    ),
    "unvalidated": _option(bool, False, "--unvalidated", "Tune on a rig that was not validated."),
    "suggest": _option(bool, False, "--suggest", "Try what betters the fit; with --out write it."),
    "seconds": _option(float, 120.0, "--seconds", "With --suggest: how long to try.", min=1.0),
    "profile": _option(str | None, None, "--profile NAME", "Profile likelihood of this."),
    "workers": _option(
        str, "", "--workers N|ADDRESS", "So many here, or a Dask scheduler's, tls://host:8786."
    ),
    "tls_ca_file": _pem("--tls-ca-file", "who signs the cluster's certificates"),
    "tls_cert": _pem("--tls-cert", "your certificate"),
    "tls_key": _pem("--tls-key", "its key"),
    "insecure_workers": _option(
        bool, False, "--insecure-workers", "Let --workers be tcp://… elsewhere"
    ),
    "resume": _option(bool, False, "--resume", "Go on where a run of this recipe was stopped."),
    "on": _option(str | None, None, "--on URL", "The machine: udp://, modbus://, can://"),
    "arm": _option(bool, False, "--arm", "Let the machine move: a token is asked for."),
    "token": _option(str | None, None, "--token", "The token, in a script that lets it move."),
    "live": _option(bool, False, "--live", "Watch it here and on a page, in real time."),
}


Work = Callable[..., "Answer | tuple[Answer, int] | None"]  # what a command does


class Says(NamedTuple):
    """How much a command says: ``loud`` with ``--verbose`` (True), ``--quiet`` (False) or neither,
    and whether as JSON."""

    loud: bool | None = None
    as_json: bool = False

    @property
    def quiet(self) -> bool:
        """Whether nothing but the place of what was written."""
        return self.loud is False


def _command(name: str, example: str, /, *shared: str, help: str = "", **options: Any) -> Any:
    """A decorator of what a command does, by its words and options, then those of several
    commands: how much to say, then their values. The answer that it gives, perhaps with an exit
    code, is said."""
    rows = options | {key: _OPTIONS[key] for key in shared}

    def register(work: Work) -> Work:
        def run(**values: Any) -> None:
            loud = values.pop("loud", None)
            says = Says(values.pop("verbose", None) or loud, values.pop("as_json", False))
            result = work(says, **values)
            if result is not None:
                answer, code = result if isinstance(result, tuple) else (result, 0)
                _say(answer, says, code)

        kind = Parameter.KEYWORD_ONLY
        parameters = [Parameter(key, kind, default=x, annotation=a) for key, (a, x) in rows.items()]
        # pyrefly: ignore[missing-attribute]
        run.__signature__ = Signature(parameters)
        run.__annotations__ = {key: annotation for key, (annotation, _) in rows.items()}
        about: Any = {"help": help, "short_help": help} if help else {"help": work.__doc__}
        app.command(name, epilog=f"Example:  ehbench {name} {example}", **about)(run)
        return work

    return register


def _version(required: bool) -> None:
    if required:
        from importlib.metadata import version

        print(f"ehbench {version('ehbench')}")
        raise typer.Exit()


@app.callback()
def _start(
    version: Annotated[
        bool,
        typer.Option("--version", "-V", callback=_version, is_eager=True, help="Which ehbench."),
    ] = False,
) -> None:
    pass


@_command("init", "my_rig", "as_json", folder=_word(Path, "DIR", "New folder for the workspace."))
def init(_: Says, folder: Path) -> Answer:
    """Make a workspace: a commented rig file and recipes that run as they are."""
    from ehbench.app import starter
    from ehbench.report.terminal import Answer

    starter.init(folder)
    keys = ("steps.check_rig", "steps.identify", "steps.validate")
    steps = [message(key, folder=folder) for key in keys]
    values = {"folder": str(folder)}
    return Answer(message("app.made", folder=folder), steps=steps, values=values)


@_command(
    "check",
    "recipes/rigs/thesis_arm.toml",
    *("verbose", "as_json"),
    file=_word(Path, None, "A rig, recipe, map of columns, flowmeter CSV or log."),
)
def check_file(says: Says, file: Path) -> None:
    """Check a rig, recipe, map, data file or log without running anything.

    Of a recipe, all that its run takes in: the rig, maps, data and recipes it names.
    What only a run can tell is said."""
    from ehbench.app import inspection

    result = inspection.check(file, verbose=bool(says.loud))
    if says.loud and not says.as_json:
        print("\n".join(result.lines))
    else:
        _say(result.answer(file), Says(None, says.as_json))
    for error in result.errors:
        print(f"error: {error}", file=sys.stderr)
    raise typer.Exit(result.code)


def _run_recipe(
    command: Command, says: Says, file: Path, out: Path | None, **settings: Any
) -> Answer | tuple[Answer, int]:
    """Run a recipe, make a sample of a study again, or suggest what betters a fit; what is left of
    the options are ``settings`` of a session."""
    from ehbench import workflow

    if "workers" in settings:
        names = ("tls_ca_file", "tls_cert", "tls_key")
        certificates, insecure = tuple(map(settings.pop, names)), settings.pop("insecure_workers")
        settings["workers"] = workflow.Workers.of(settings["workers"], certificates, insecure)
    if "arm" in settings:
        arm, token = settings.pop("arm"), settings.pop("token")
        settings["ask"] = (lambda about, expected: token) if token is not None else None
        settings["ask"] = _typed if arm and token is None else settings["ask"]
        settings["live"] = partial(_announced, says.quiet) if settings["live"] else None
    suggest, seconds = settings.pop("suggest", False), settings.pop("seconds", 0.0)
    profile, on = settings.pop("profile", None), settings.pop("on", None)
    study, _, index = file.name.partition("#")
    is_sample = not suggest and index.isdecimal() and not file.exists()
    recipe = None if is_sample else workflow.expect_stage(file, command.name)
    if on is not None:
        from ehbench.app.linking import moved_to

        recipe = moved_to(recipe, on)
    if settings.get("ask") is not None and "://" not in getattr(recipe, "on", ""):
        raise InputError(message("links.no_machine"), file=file)
    _say_first(says.quiet)
    # to draw a bar would hold up a machine in real time, and a live view draws itself
    timed = settings.get("live") is not None or "://" in getattr(recipe, "on", "")
    with _session(says.quiet or timed, out=out, **settings) as session:
        if suggest and recipe is not None:
            result = workflow.suggest(recipe, session, seconds)
            return result.answer(file, None if out is None else out / recipe.path.name)
        if recipe is None:
            built = workflow.sample(file.with_name(study), int(index), replace(session, out=None))
            recipe = workflow.expect_stage(built.path, command.name)
        if profile is None:
            built = workflow.run(recipe, session)
        else:
            built = workflow.profile(recipe, profile, session)
    from ehbench.report.terminal import answer

    losses = built.code == workflow.INCOMPLETE
    return answer(built.folder, built.notes, built.code, losses), built.code


for _row in COMMANDS:
    _first = ("file", "out", "loud", "as_json")
    _command(_row.name, _row.example, *_first, *_row.options, help=_row.help)(
        partial(_run_recipe, _row)
    )


@_command(
    "export",
    "recipes/rigs/slide_servo.toml --as c --unvalidated",
    *("out", "loud", "as_json", "allow_code"),
    source=_word(Path, "RUN|RIG|RECIPE", _EXPORTED),
    parts=_option(
        Literal["model", "controller", "both"] | None, None, "--what", "Default: all there is."
    ),
    formats=_option(str, "", "--as FORMAT,...", _FORMATS),
    payload=_option(str, "", "--payload NAME", "What the model carries."),
    rate=_option(str, "", "--rate HZ", "Steps a second."),
    targets=_option(
        str, "", "--target TARGET,...", "Of FMUs: linux64, win64, aarch64. Default: here."
    ),
    unvalidated=_option(
        bool, False, "--unvalidated", "Export what no validation accepted and no run tuned."
    ),
)
def export(
    says: Says, source: Path, parts: str | None, formats: str, payload: str, rate: str, **more: Any
) -> tuple[Answer, int]:
    """Export a validated model and a tuned controller as C or FMU, with a check of the numbers."""
    from ehbench import workflow
    from ehbench.report.terminal import answer

    targets = more.pop("targets")
    options = {
        "parts": parts,
        "formats": formats.split(",") if formats else (),
        "payload": payload,
        "rate": f"{rate} Hz" if rate[-1:].isdecimal() else rate,
        "targets": targets.split(",") if targets else (),
    }
    _say_first(says.quiet)
    with _session(says.quiet, **more) as session:
        built = workflow.export(source, options, session)
    return answer(built.folder, built.notes, built.code), built.code


@_command(
    "report",
    "reports/flow_maps_* reports/validation_* --out my_report",
    *("out", "loud", "as_json"),
    runs=_word(list[Path], "RUN...", "Run folders."),
)
def report_runs(says: Says, runs: list[Path], out: Path | None) -> tuple[Answer, int]:
    """Write one self-contained HTML report over finished runs, from their saved files only."""
    from ehbench import workflow
    from ehbench.report.terminal import report_answer

    with _session(says.quiet, out=out) as session:
        built = workflow.report(runs, session)
    return report_answer(built.folder, built.notes, built.code), built.code


@_command(
    "reproduce",
    "thesis",
    *("loud", "as_json", "allow_code"),
    campaign=_word(str, None, "Name of a folder in recipes/, or a campaign file."),
    out=_option(Path | None, None, "--out", "Folder for all runs. Default: reports/."),
)
def reproduce(says: Says, campaign: str, out: Path | None, allow_code: bool) -> tuple[Answer, int]:
    """Run a whole campaign and write its report; runs that stand already are not run again."""
    from ehbench import workflow
    from ehbench.app import starter
    from ehbench.report.terminal import report_answer

    recipe = workflow.expect_stage(starter.find_campaign(campaign), "reproduce")
    with _session(says.quiet, root=out or workflow.ROOT, allow_code=allow_code) as session:
        built = workflow.run(recipe, session)
    return report_answer(built.folder, built.notes, built.code), built.code


@_command(
    "compare",
    "reports/identify_1a2b3c4d reports/identify_5e6f7a8b",
    *("verbose", "as_json"),
    first=_word(Path, "RUN", "A run folder."),
    second=_word(Path, "RUN", "Another of the same stage."),
)
def compare_runs(_: Says, first: Path, second: Path) -> tuple[Answer, int]:
    """Say which inputs, parameters and verdicts of two runs differ, and by how many intervals; exit
    3 where a run or what it was made from has changed."""
    from ehbench.report.compare import compare

    answer = compare(first, second)
    return answer, 3 if answer.values["changes"] else 0


@_command(
    "next",
    "reports/identify_1a2b3c4d",
    *("loud", "as_json", "allow_code"),
    run=_word(Path, "RUN", "The run of a hydraulics fit."),
    name=_option(str | None, None, "--for", "Parameter to sharpen. Default: the least known."),
    out=_option(Path | None, None, "--out", "Write the first test as a trial recipe."),
)
def next_test(
    says: Says, run: Path, name: str | None, out: Path | None, allow_code: bool
) -> tuple[Answer, int]:
    """Propose the test that would sharpen a fitted parameter most, with the interval to expect;
    exit 3 where the run or what it was made from has changed."""
    from ehbench import workflow

    _say_first(says.quiet)
    with _session(says.quiet, out=out, allow_code=allow_code) as session:
        result = workflow.next_test(run, name, session)
    return result.answer(run, out), 3 if result.changes else 0


@_command(
    "why",
    "bulk_modulus reports/identify_1a2b3c4d",
    "as_json",
    name=_word(str, None, _NUMBER),
    runs=_word(list[Path], "RUN...", "Run or report folders; the newest is asked."),
)
def why(says: Says, name: str, runs: list[Path]) -> None:
    """Say where a number of a run or report is from: interval, method, windows, logs, recipe and
    rig line; exit 3 where these have changed."""
    from ehbench.report.why import origin
    from ehbench.runs import rundir

    run = max(runs, key=rundir.started)
    answer = origin(name, run)
    if len(runs) > 1:
        said = message("report.of_newest", number=answer.verdict, run=run, count=len(runs))
        answer = replace(answer, verdict=said)
    _say(answer, says, 3 if answer.values["changes"] else 0, wide=True)


@_command(
    "show",
    "datasets/slide_servo/steps/press_no_load.mcap",
    *("columns", "verbose", "as_json"),
    files=_word(list[Path], "FILE|RUN...", "One or two logs, flow maps or run folders."),
    out=_option(Path | None, None, "--out", "The page. Default: <name>.html here."),
)
def show(says: Says, files: list[Path], out: Path | None, columns: Path | None) -> None:
    """Write a log, flow map or run as an interactive page: zoom, values, curves to hide; two of
    them over one another; exit 3 where a run or what it was made from has changed, or a log lost
    data."""
    from ehbench.report import viewer
    from ehbench.report.terminal import Answer

    if len(files) > 2:
        raise typer.BadParameter("one or two files can be shown at a time")
    path, changes = viewer.place(files, out), viewer.unsupported_runs(files)
    losses: dict[str, Sequence[str]] = {}
    write_text(path, viewer.page(files, columns, changes, losses))
    verdict = message("app.shown", names=", ".join(map(str, files)))
    _say_losses(Answer(verdict, notes=changes, place=path), losses, says)


@_command(
    "map",
    "recordings/run_07.tdms --rig rig.toml",
    *("loud", "as_json"),
    file=_word(Path, None, "A recording of any format that is read."),
    out=_option(Path | None, None, "--out", "Default: <name>.map.toml here."),
    rig=_option(Path | None, None, "--rig", _OWNER),
)
def map_columns(_: Says, file: Path, out: Path | None, rig: Path | None) -> Answer:
    """Look at a file of your own recorder and draft a map of its columns, with a picture of each.

    The map says which column is which channel, with its unit. Nothing is written over."""
    from ehbench.app import mapping
    from ehbench.config.recipe import load_rig

    if rig is None and Path("rig.toml").is_file():
        rig = Path("rig.toml")
    return mapping.draft(file, out, None if rig is None else load_rig(rig))


@_command(
    "convert",
    "datasets/slide_servo/steps/press_no_load.mcap --to mat",
    *("columns", "verbose", "as_json"),
    log=_word(Path, None, "A log of any format that is read, or a trial's run."),
    to=_option(Literal["parquet", "mat"], Parameter.empty, "--to", "What to write."),
    out=_option(Path | None, None, "--out", "Default: <name>.<to> here."),
)
def convert(says: Says, log: Path, to: str, out: Path | None, columns: Path | None) -> None:
    """Write a log as Parquet or MAT, in SI, with its units. Nothing is written over; exit 3 where
    the log lost data."""
    from ehbench.app import converting
    from ehbench.report.terminal import Answer

    path, record = converting.convert(log, to, out, columns)
    answer = Answer(message("app.converted", log=log, format=to), place=path)
    _say_losses(answer, {log.name: record.losses}, says)


@_command(
    "quantities",
    "damping",
    "as_json",
    text=_word(str, None, "A part of a name or meaning; none: all.", ""),
)
def quantities(_: Says, text: str) -> Answer:
    """List the names that recipes, rig files and maps of columns use, with units and meaning."""
    from ehbench.app import lookup

    return lookup.look_up(text)


@_command(
    "wire",
    "recipes/rigs/slide_servo.toml --csv",
    rig=_word(Path, None, "A rig file, or a run with one."),
    c=_option(bool, False, "--c", "A C header; with --out its responder."),
    m=_option(bool, False, "--m", "A MATLAB script."),
    py=_option(bool, False, "--py", "Python; with --out its responder."),
    dbc=_option(bool, False, "--dbc", "A DBC file, for CAN."),
    csv=_option(bool, False, "--csv", "A table, the default."),
    rate=_option(float, 1000.0, "--rate", "Of the target [Hz].", min=1.0, max=1e6),
    out=_option(Path | None, None, "--out", "Folder to write to."),
)
def wire(_: Says, rig: Path, rate: float, out: Path | None, **chosen: bool) -> None:
    """Write the layout of the packets of a rig, for its own computer."""
    from ehbench.app import linking

    kinds = [name for name, is_chosen in chosen.items() if is_chosen] or ["csv"]
    print(linking.wire(rig, kinds, rate, out), end="")


@_command(
    "link",
    "udp://192.168.0.5:47000 --seconds 60",
    "as_json",
    url=_word(str, None, "Of the machine: udp://, modbus://, can://"),
    seconds=_option(float, 60.0, "--seconds", "How long.", min=0.1),
)
def link(_: Says, url: str, seconds: float) -> tuple[Answer, int]:
    """Measure round trip, lost and late ticks of a link; exit 4 where no trial may run over it."""
    from ehbench.app import linking

    return linking.measured(url, seconds)


@_command(
    "serve",
    "recipes/trials/arc_slow.toml --on bench",
    "allow_code",
    file=_word(Path, None, "A trial, whose machine it is, or a bench file."),
    at=_option(str, "udp://127.0.0.1:47000", "--at URL", "Where."),
    on=_option(Literal["model", "bench"] | None, None, "--on", "Default: as the trial."),
    rate=_option(float | None, None, "--rate", "Of the target [Hz].", min=1.0, max=1e6),
    watchdog=_option(float | None, None, "--watchdog", _SILENCE, min=1.0),
)
def serve_machine(_: Says, file: Path, at: str, watchdog: float | None, **more: Any) -> None:
    """Serve a model or the virtual bench as a machine by itself, in real time, with watchdog,
    clamps and the trial's faults: what a target must do."""
    from ehbench.app import linking

    silence = None if watchdog is None else 1e-3 * watchdog
    linking.serve(file, at, watchdog=silence, **more)


def _typed(about: str, token: str) -> str:
    """What a person types who lets a machine move; nothing where there is nobody to ask."""
    print(about, file=sys.stderr)
    try:
        return typer.prompt(f"type {token} to let it move", err=True)
    except typer.Abort:
        return ""


def _announced(quiet: bool, url: str) -> bool:
    """Say where a live view is; whether it may draw on the terminal."""
    print(message("app.live", url=url), file=sys.stderr)
    return not quiet and sys.stderr.isatty()


_WARMING: list[subprocess.Popen] = []  # it ends by itself, at the latest soon after the run


def _say_first(quiet: bool) -> None:
    """Say why a first run takes longer than the next, and share its work."""
    from ehbench.runtime.compiled import KEPT, is_cold

    if not is_cold():
        return
    if not quiet:
        print(message("app.compiling" if KEPT else "app.compiling_again"), file=sys.stderr)
    if cores() > 1 and KEPT:  # another core, one cache
        ahead = [sys.executable, "-P", "-m", "ehbench.app.warm", "--ahead"]
        null = subprocess.DEVNULL
        _WARMING.append(subprocess.Popen(ahead, stdin=null, stdout=null, stderr=null))


def _say(answer: Answer, says: Says, code: int = 0, wide: bool = False) -> None:
    """Print what a command says, the place of what it wrote alone when quiet; end with the code."""
    if says.as_json:
        print(answer.as_json())
    elif not says.quiet:
        width = sys.maxsize if wide else shutil.get_terminal_size((100, 24)).columns
        print("\n".join(answer.lines(width, bool(says.loud))))
    elif answer.place is not None:
        print(answer.place)
    if code:
        raise typer.Exit(code)


def _say_losses(answer: Answer, losses: Mapping[str, Sequence[str]], says: Says) -> None:
    """Say the place of what was written of logs and what they lost, with ``--verbose`` each of it;
    exit 3 where an answer has notes already, or data could not be used."""
    from ehbench.data.record import lost, noted_losses

    says = Says(bool(says.loud), says.as_json)  # the place alone, unless more is asked for
    each = [noted_losses(name, notes) for name, notes in losses.items()]
    gone = [*answer.notes, *(note for every in losses.values() for note in lost(every))]
    notes = [*answer.notes, *(note for few, _ in each for note in few)]
    answer = replace(answer, notes=notes, details=[note for _, more in each for note in more])
    if says.quiet and not says.as_json:
        for note in notes:
            print(f"note: {note}", file=sys.stderr)
    _say(answer, says)
    raise typer.Exit(3 if gone else 0)


_REPEATED = 30.0  # [s] after which a log that is no terminal hears again how far it is


@contextmanager
def _session(quiet: bool, **settings: Any) -> Iterator[Session]:
    """A session that shows how far it is on stderr, unless quiet."""
    from ehbench.workflow import Session

    if quiet:
        yield Session(**settings)
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
    )
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        tasks: dict[str, TaskID] = {}
        due: dict[str, float] = {}

        def report_progress(what: str, share: float) -> None:
            name = what.split(":")[0]
            if name not in tasks:
                tasks[name] = bar.add_task(what, total=1.0)
            if not console.is_terminal and time.monotonic() >= due.get(name, 0.0):
                print(f"{what}, {100.0 * share:.0f} %" if name in due else what, file=sys.stderr)
                due[name] = time.monotonic() + _REPEATED
            bar.update(tasks[name], description=what, completed=share)

        yield Session(progress=report_progress, **settings)


# what the system says no to is no bug of ours
_OUTSIDE = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO),
    *(errno.EACCES, errno.EPERM, errno.ENAMETOOLONG, errno.ELOOP, errno.EMFILE),
)


def main() -> None:
    """Entry point: an error becomes a sentence on stderr and an exit code."""
    listen()
    codecs.register_error("spelled", _spelled)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="spelled")
    # modules are a million objects that stay: to look through them for garbage again and again
    # takes a tenth of a short run
    gc.set_threshold(50_000, 20, 20)
    try:
        app()
    except BaseException as error:
        requested, notes = ended(), getattr(error, "__notes__", [])
        if requested and isinstance(error, (Terminated, Exception)):
            first = [message("app.interrupted")] if requested == signal.SIGINT else []
            print(*first, *notes, sep="\n", end="\n" if first or notes else "", file=sys.stderr)
            sys.exit(128 + requested)
        if isinstance(error, EhbenchError):
            every = (error, *error.others)
            if "--json" in sys.argv:
                print(json.dumps({"code": error.exit_code, "errors": [e.as_json() for e in every]}))
            print(*(f"error: {item}" for item in every), *notes, sep="\n", file=sys.stderr)
            sys.exit(error.exit_code)
        if isinstance(error, OSError) and error.errno in _OUTSIDE:
            where = f"{shortened_path(error.filename)}: " if error.filename else ""
            print(f"error: {where}{error.strerror}", file=sys.stderr)
            with suppress(OSError):
                sys.stdout.close()
            sys.exit(2)
        raise error


def _spelled(error: UnicodeError) -> tuple[bytes, int]:
    """What its encoding lacks: bytes of a file's name as they are, else ``\\uXXXX``."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = error.object[error.start : error.end]
    try:
        return text.encode("ascii", "surrogateescape"), error.end
    except UnicodeEncodeError:
        return text.encode("ascii", "backslashreplace"), error.end


if __name__ == "__main__":
    main()
