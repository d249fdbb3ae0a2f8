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


def _option(*names: str, help: str, **more: Any) -> Any:
    return typer.Option(*names, help=help, show_default=False, **more)


RecipeFile = Annotated[Path, typer.Argument(help="Recipe (TOML).", show_default=False)]
Out = Annotated[
    Path | None, _option("--out", help="Folder for the run. Default: reports/<recipe>_<hash8>/.")
]
Loud = Annotated[
    bool | None,
    _option(
        *("--verbose/--quiet", "-v/-q"),
        help="All tables, steps and notes; or no progress, and only the run's path.",
    ),
]
Columns = Annotated[
    Path | None, _option("--columns", help="A map of the columns of a log by others.")
]
AllowCode = Annotated[
    bool, _option("--allow-code", help="Let code of your own run: a controller, an FMU.")
]
Verbose = Annotated[bool, _option("--verbose", "-v", help="All tables, steps and notes.")]
AsJson = Annotated[bool, _option("--json", help="Print what was found as JSON.")]


def _row(kind: Any, default: Any, flag: str, text: str, **more: Any) -> tuple[Any, Any]:
    return Annotated[kind, _option(flag, help=text, **more)], default


def _pem(flag: str, what: str) -> tuple[Any, Any]:
    return _row(Path | None, None, flag, f"With --workers tls://…: {what} (PEM).")


# options of commands that run a recipe, with their defaults; the first four are those of all
_OPTIONS: dict[str, tuple[Any, Any]] = {
    "recipe": (RecipeFile, Parameter.empty),
    "out": (Out, None),
    "loud": (Loud, None),
    "as_json": (AsJson, False),
    "allow_code": (AllowCode, False),
    "unvalidated": _row(bool, False, "--unvalidated", "Tune on a rig that was not validated."),
    "suggest": _row(bool, False, "--suggest", "Try what betters the fit; with --out write it."),
    "seconds": _row(float, 120.0, "--seconds", "With --suggest: how long to try.", min=1.0),
    "profile": _row(str | None, None, "--profile", "Profile likelihood of this.", metavar="NAME"),
    "workers": _row(
        *(str, "", "--workers", "So many here, or a Dask scheduler's, tls://host:8786."),
        metavar="N|ADDRESS",
    ),
    "tls_ca_file": _pem("--tls-ca-file", "who signs the cluster's certificates"),
    "tls_cert": _pem("--tls-cert", "your certificate"),
    "tls_key": _pem("--tls-key", "its key"),
    "insecure_workers": _row(
        bool, False, "--insecure-workers", "Let --workers be tcp://… elsewhere"
    ),
    "resume": _row(bool, False, "--resume", "Go on where a run of this recipe was stopped."),
    "on": _row(str | None, None, "--on", "The machine: udp://, modbus://, can://", metavar="URL"),
    "arm": _row(bool, False, "--arm", "Let the machine move: a token is asked for."),
    "token": _row(str | None, None, "--token", "The token, in a script that lets it move."),
    "live": _row(bool, False, "--live", "Watch it here and on a page, in real time."),
}


class Says(NamedTuple):
    """How much a command says: ``loud`` with ``--verbose`` (True), ``--quiet`` (False) or neither,
    and whether as JSON."""

    loud: bool | None = None
    as_json: bool = False

    @property
    def quiet(self) -> bool:
        """Whether nothing but the place of what was written."""
        return self.loud is False


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


@app.command(epilog="Example:  ehbench init my_rig")
def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="New folder for the workspace.")],
    as_json: AsJson = False,
) -> None:
    """Make a workspace: a commented rig file and recipes that run as they are."""
    from ehbench.app import starter
    from ehbench.report.terminal import Answer

    starter.init(folder)
    keys = ("steps.check_rig", "steps.identify", "steps.validate")
    steps = [message(key, folder=folder) for key in keys]
    values = {"folder": str(folder)}
    answer = Answer(message("app.made", folder=folder), steps=steps, values=values)
    _say(answer, Says(None, as_json))


@app.command("check", epilog="Example:  ehbench check recipes/rigs/thesis_arm.toml")
def check_file(
    file: Annotated[
        Path, typer.Argument(help="A rig, recipe, map of columns, flowmeter CSV or log.")
    ],
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Check a rig, recipe, map, data file or log without running anything.

    Of a recipe, all that its run takes in: the rig, maps, data and recipes it names.
    What only a run can tell is said."""
    from ehbench.app import inspection

    result = inspection.check(file, verbose=verbose)
    if verbose and not as_json:
        print("\n".join(result.lines))
    else:
        _say(result.answer(file), Says(None, as_json))
    for error in result.errors:
        print(f"error: {error}", file=sys.stderr)
    raise typer.Exit(result.code)


def _runner(command: Command) -> Callable[..., None]:
    """What typer calls for a command that runs a recipe: its parameters are those of the help."""

    def run(recipe: Path, out: Path | None, loud: bool | None, as_json: bool, **more: Any) -> None:
        from ehbench import workflow

        says = Says(loud, as_json)
        if "workers" in more:
            certificates = tuple(more.pop(name) for name in ("tls_ca_file", "tls_cert", "tls_key"))
            insecure = more.pop("insecure_workers")
            more["workers"] = workflow.Workers.of(more["workers"], certificates, insecure)
        if "arm" in more:
            arm, token = more.pop("arm"), more.pop("token")
            more["ask"] = (lambda about, expected: token) if token is not None else None
            more["ask"] = _typed if arm and token is None else more["ask"]
            more["live"] = partial(_announced, says.quiet) if more["live"] else None
        suggest, seconds = more.pop("suggest", False), more.pop("seconds", 0.0)
        if suggest:
            read = workflow.expect_stage(recipe, command.name)
            _say_first(says.quiet)
            with _session(says.quiet, out=out, allow_code=more["allow_code"]) as session:
                result = workflow.suggest(read, session, seconds)
            _say(result.answer(recipe, None if out is None else out / read.path.name), says)
        else:
            _run_recipe(command.name, recipe, out, says, **more)

    names = [*list(_OPTIONS)[:4], *command.options]
    kind = Parameter.POSITIONAL_OR_KEYWORD
    parameters = [
        Parameter(name, kind, default=default, annotation=annotation)
        for name, (annotation, default) in ((name, _OPTIONS[name]) for name in names)
    ]
    run.__signature__ = Signature(parameters)  # pyright: ignore[reportFunctionMemberAccess]
    run.__annotations__ = {name: _OPTIONS[name][0] for name in names}
    return run


for _command in COMMANDS:
    app.command(
        _command.name,
        help=_command.help,
        short_help=_command.help,
        epilog=f"Example:  ehbench {_command.name} {_command.example}",
    )(_runner(_command))


@app.command(epilog="Example:  ehbench export recipes/rigs/slide_servo.toml --as c --unvalidated")
def export(  # noqa: PLR0913 - the parameters are the options of the command
    source: Annotated[
        Path,
        typer.Argument(
            metavar="RUN|RIG|RECIPE",
            help="A validated rig, a tuning, a trial with a controller, or an export's recipe.",
        ),
    ],
    parts: Annotated[
        Literal["model", "controller", "both"] | None,
        _option("--what", help="Default: all there is."),
    ] = None,
    formats: Annotated[
        str,
        _option(
            "--as",
            metavar="FORMAT,...",
            help="c, fmu2, fmu3, matlab, urdf, mjcf. Default: c.",
        ),
    ] = "",
    payload: Annotated[
        str, _option("--payload", metavar="NAME", help="What the model carries.")
    ] = "",
    rate: Annotated[str, _option("--rate", metavar="HZ", help="Steps a second.")] = "",
    targets: Annotated[
        str,
        _option(
            "--target",
            metavar="TARGET,...",
            help="Of FMUs: linux64, win64, aarch64. Default: here.",
        ),
    ] = "",
    out: Out = None,
    loud: Loud = None,
    as_json: AsJson = False,
    unvalidated: Annotated[
        bool,
        typer.Option("--unvalidated", help="Export what no validation accepted and no run tuned."),
    ] = False,
    allow_code: AllowCode = False,
) -> None:
    """Export a validated model and a tuned controller as C or FMU, with a check of the numbers."""
    from ehbench import workflow
    from ehbench.report.terminal import answer

    options = {
        "parts": parts,
        "formats": formats.split(",") if formats else (),
        "payload": payload,
        "rate": f"{rate} Hz" if rate[-1:].isdecimal() else rate,
        "targets": targets.split(",") if targets else (),
    }
    says = Says(loud, as_json)
    _say_first(says.quiet)
    settings = {"unvalidated": unvalidated, "allow_code": allow_code}
    with _session(says.quiet, out=out, **settings) as session:
        built = workflow.export(source, options, session)
    _say(answer(built.folder, built.notes, built.code), says, built.code)


@app.command(
    "report",
    epilog="Example:  ehbench report reports/flow_maps_* reports/validation_* --out my_report",
)
def report_runs(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run folders.")],
    out: Out = None,
    loud: Loud = None,
    as_json: AsJson = False,
) -> None:
    """Write one self-contained HTML report over finished runs, from their saved files only."""
    from ehbench import workflow
    from ehbench.report.terminal import report_answer

    says = Says(loud, as_json)
    with _session(says.quiet, out=out) as session:
        built = workflow.report(runs, session)
    _say(report_answer(built.folder, built.notes, built.code), says, built.code)


@app.command(epilog="Example:  ehbench reproduce thesis")
def reproduce(
    campaign: Annotated[
        str, typer.Argument(help="Name of a folder in recipes/, or a campaign file.")
    ],
    out: Annotated[
        Path | None, _option("--out", help="Folder for all runs. Default: reports/.")
    ] = None,
    loud: Loud = None,
    as_json: AsJson = False,
    allow_code: AllowCode = False,
) -> None:
    """Run a whole campaign and write its report; runs that stand already are not run again."""
    from ehbench import workflow
    from ehbench.app import starter
    from ehbench.report.terminal import report_answer

    says = Says(loud, as_json)
    recipe = workflow.expect_stage(starter.find_campaign(campaign), "reproduce")
    with _session(says.quiet, root=out or workflow.ROOT, allow_code=allow_code) as session:
        built = workflow.run(recipe, session)
    _say(report_answer(built.folder, built.notes, built.code), says, built.code)


@app.command(
    "compare",
    epilog="Example:  ehbench compare reports/identify_1a2b3c4d reports/identify_5e6f7a8b",
)
def compare_runs(
    first: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")],
    second: Annotated[Path, typer.Argument(metavar="RUN", help="Another of the same stage.")],
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Say which inputs, parameters and verdicts of two runs differ, and by how many intervals; exit
    3 where a run or what it was made from has changed."""
    from ehbench.report import compare as runs

    result = runs.compare(first, second)
    code = 3 if result.changes else 0
    _say(runs.answer(result, first), Says(verbose or None, as_json), code)


@app.command("next", epilog="Example:  ehbench next reports/identify_1a2b3c4d")
def next_test(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="The run of a hydraulics fit.")],
    name: Annotated[
        str | None, _option("--for", help="Parameter to sharpen. Default: the least known.")
    ] = None,
    out: Annotated[
        Path | None, _option("--out", help="Write the first test as a trial recipe.")
    ] = None,
    loud: Loud = None,
    as_json: AsJson = False,
    allow_code: AllowCode = False,
) -> None:
    """Propose the test that would sharpen a fitted parameter most, with the interval to expect."""
    from ehbench import workflow

    says = Says(loud, as_json)
    _say_first(says.quiet)
    with _session(says.quiet, out=out, allow_code=allow_code) as session:
        result = workflow.next_test(run, name, session)
    _say(result.answer(run, out), says)


@app.command(epilog="Example:  ehbench why bulk_modulus reports/identify_1a2b3c4d")
def why(
    name: Annotated[
        str, typer.Argument(help="A number: a parameter, or the end of its path in the run's JSON.")
    ],
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN...", help="Run or report folders; the newest is asked."),
    ],
    as_json: AsJson = False,
) -> None:
    """Say where a number of a run or report is from: interval, method, windows, logs, recipe and
    rig line; exit 3 where these have changed."""
    from ehbench.report.terminal import Answer
    from ehbench.report.why import origin
    from ehbench.runs import rundir

    run = max(runs, key=rundir.started)
    result = origin(name, run)
    said, values = result.headline, result.as_json()
    if len(runs) > 1:
        said = message("report.of_newest", number=said, run=run, count=len(runs))
    answer, code = Answer(said, [result.table()], values=values), 3 if result.changes else 0
    _say(answer, Says(None, as_json), code, wide=True)


@app.command(epilog="Example:  ehbench show datasets/slide_servo/steps/press_no_load.mcap")
def show(
    files: Annotated[
        list[Path],
        typer.Argument(metavar="FILE|RUN...", help="One or two logs, flow maps or run folders."),
    ],
    out: Annotated[
        Path | None, _option("--out", help="The page. Default: <name>.html here.")
    ] = None,
    columns: Columns = None,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
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
    _say_losses(Answer(verdict, notes=changes, place=path), losses, Says(verbose, as_json))


@app.command("map", epilog="Example:  ehbench map recordings/run_07.tdms --rig rig.toml")
def map_columns(
    file: Annotated[Path, typer.Argument(help="A recording of any format that is read.")],
    out: Annotated[Path | None, _option("--out", help="Default: <name>.map.toml here.")] = None,
    rig: Annotated[
        Path | None,
        _option(
            "--rig",
            help="Whose cylinders and valves they are. Default: rig.toml here, if there is one.",
        ),
    ] = None,
    loud: Loud = None,
    as_json: AsJson = False,
) -> None:
    """Look at a file of your own recorder and draft a map of its columns, with a picture of each.

    The map says which column is which channel, with its unit. Nothing is written over."""
    from ehbench.app import mapping
    from ehbench.config.recipe import load_rig

    if rig is None and Path("rig.toml").is_file():
        rig = Path("rig.toml")
    built = mapping.draft(file, out, None if rig is None else load_rig(rig))
    _say(built.answer(), Says(loud, as_json))


@app.command(
    epilog="Example:  ehbench convert datasets/slide_servo/steps/press_no_load.mcap --to mat"
)
def convert(
    log: Annotated[
        Path, typer.Argument(help="A log of any format that is read, or a trial's run.")
    ],
    to: Annotated[Literal["parquet", "mat"], _option("--to", help="What to write.")],
    out: Annotated[Path | None, _option("--out", help="Default: <name>.<to> here.")] = None,
    columns: Columns = None,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Write a log as Parquet or MAT, in SI, with its units. Nothing is written over; exit 3 where
    the log lost data."""
    from ehbench.app import converting
    from ehbench.report.terminal import Answer

    path, record = converting.convert(log, to, out, columns)
    answer = Answer(message("app.converted", log=log, format=to), place=path)
    _say_losses(answer, {log.name: record.losses}, Says(verbose, as_json))


@app.command(epilog="Example:  ehbench quantities damping")
def quantities(
    text: Annotated[str, typer.Argument(help="A part of a name or meaning; none: all.")] = "",
    as_json: AsJson = False,
) -> None:
    """List the names that recipes, rig files and maps of columns use, with units and meaning."""
    from ehbench.app import lookup

    _say(lookup.look_up(text), Says(None, as_json))


@app.command(epilog="Example:  ehbench wire recipes/rigs/slide_servo.toml --csv")
def wire(
    rig: Annotated[Path, typer.Argument(help="A rig file, or a run with one.")],
    c: Annotated[bool, typer.Option("--c", help="A C header; with --out its responder.")] = False,
    m: Annotated[bool, typer.Option("--m", help="A MATLAB script.")] = False,
    py: Annotated[bool, typer.Option("--py", help="Python; with --out its responder.")] = False,
    dbc: Annotated[bool, typer.Option("--dbc", help="A DBC file, for CAN.")] = False,
    csv: Annotated[bool, typer.Option("--csv", help="A table, the default.")] = False,
    rate: Annotated[
        float, typer.Option("--rate", help="Of the target [Hz].", min=1.0, max=1e6)
    ] = 1000.0,
    out: Annotated[Path | None, _option("--out", help="Folder to write to.")] = None,
) -> None:
    """Write the layout of the packets of a rig, for its own computer."""
    from ehbench.app import linking

    chosen = {"c": c, "m": m, "py": py, "dbc": dbc, "csv": csv}
    kinds = [name for name, is_chosen in chosen.items() if is_chosen] or ["csv"]
    print(linking.wire(rig, kinds, rate, out), end="")


@app.command(epilog="Example:  ehbench link udp://192.168.0.5:47000 --seconds 60")
def link(
    url: Annotated[str, typer.Argument(help="Of the machine: udp://, modbus://, can://")],
    seconds: Annotated[float, typer.Option("--seconds", help="How long.", min=0.1)] = 60.0,
    as_json: AsJson = False,
) -> None:
    """Measure round trip, lost and late ticks of a link; exit 4 where no trial may run over it."""
    from ehbench.app import linking

    answer, code = linking.measured(url, seconds)
    _say(answer, Says(None, as_json), code)


@app.command("serve", epilog="Example:  ehbench serve recipes/trials/arc_slow.toml --on bench")
def serve_machine(
    file: Annotated[Path, typer.Argument(help="A trial, whose machine it is, or a bench file.")],
    at: Annotated[
        str, typer.Option("--at", metavar="URL", help="Where.")
    ] = "udp://127.0.0.1:47000",
    on: Annotated[
        Literal["model", "bench"] | None, _option("--on", help="Default: as the trial.")
    ] = None,
    rate: Annotated[
        float | None, _option("--rate", help="Of the target [Hz].", min=1.0, max=1e6)
    ] = None,
    watchdog: Annotated[
        float | None,
        _option(
            "--watchdog",
            help="Silence after which it stops, in ms. Default: 20, or four samples.",
            min=1.0,
        ),
    ] = None,
    allow_code: AllowCode = False,
) -> None:
    """Serve a model or the virtual bench as a machine by itself, in real time, with watchdog,
    clamps and the trial's faults: what a target must do."""
    from ehbench.app import linking

    silence = None if watchdog is None else 1e-3 * watchdog
    linking.serve(file, at, on, rate, silence, allow_code)


def _run_recipe(
    command: str,
    file: Path,
    out: Path | None,
    says: Says,
    *,
    profile: str | None = None,
    on: str | None = None,
    **settings: Any,
) -> None:
    """Run a recipe, or make a sample of a study again; ``settings`` are those of a session."""
    from ehbench import workflow

    study, _, index = file.name.partition("#")
    is_sample = index.isdecimal() and not file.exists()
    recipe = None if is_sample else workflow.expect_stage(file, command)
    if on is not None:
        from ehbench.app.linking import moved_to

        recipe = moved_to(recipe, on)
    if settings.get("ask") is not None and "://" not in getattr(recipe, "on", ""):
        raise InputError(message("links.no_machine"), file=file)
    _say_first(says.quiet)
    # to draw a bar would hold up a machine in real time, and a live view draws itself
    timed = settings.get("live") is not None or "://" in getattr(recipe, "on", "")
    with _session(says.quiet or timed, out=out, **settings) as session:
        if recipe is None:
            built = workflow.sample(file.with_name(study), int(index), replace(session, out=None))
            recipe = workflow.expect_stage(built.path, command)
        if profile is None:
            built = workflow.run(recipe, session)
        else:
            built = workflow.profile(recipe, profile, session)
    from ehbench.report.terminal import answer

    losses = built.code == workflow.INCOMPLETE
    _say(answer(built.folder, built.notes, built.code, losses), says, built.code)


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
