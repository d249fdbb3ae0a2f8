"""ehbench: the workbench for people who run electrohydraulic test rigs.

    import ehbench
    rig = ehbench.load_rig("recipes/rigs/slide_servo.toml")
    log = ehbench.simulate(rig, {"press.servo": 2.0}, duration=0.5)
    run = ehbench.identify("recipes/slide_servo/hydraulics.toml")
    run.parameters

Everything is SI inside; `ehbench.vocabulary.quantities` names each quantity with its unit. Commands
of the command line are functions of the same names: `check`, `identify`, `validate`, `tune`,
`run_trial`, `report`; `run` takes a recipe of any stage. Importing the package changes nothing else
in the process."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import control

    from ehbench.app.inspection import Inspection
    from ehbench.config.recipe import load_rig as load_rig
    from ehbench.data import Record
    from ehbench.data import read_log as read_log
    from ehbench.machines.protocol import Machine as Machine
    from ehbench.physics.flow_map import load_flow_maps as load_flow_maps
    from ehbench.plant.model import simulate as simulate
    from ehbench.trial import Facts
    from ehbench.trial.stepping import Controller as Controller
    from ehbench.vocabulary import Progress
    from ehbench.workflow import Outcome, Session

__all__ = [
    "Controller",
    "Machine",
    "check",
    "identify",
    "linear_models",
    "load_flow_maps",
    "load_rig",
    "open_controller",
    "open_machine",
    "read_log",
    "report",
    "run",
    "run_on",
    "run_trial",
    "simulate",
    "tune",
    "validate",
]

# imported when first used, so that `import ehbench` and `ehbench --help` are quick
_HOME = {
    "Controller": "ehbench.trial.stepping",
    "Machine": "ehbench.machines.protocol",
    "load_flow_maps": "ehbench.physics.flow_map",
    "load_rig": "ehbench.config.recipe",
    "read_log": "ehbench.data",
    "simulate": "ehbench.plant.model",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'ehbench' has no attribute '{name}'")
    from importlib import import_module

    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)


class _Face(ModuleType):
    """The package: its functions stay what they are when the packages `ehbench.tune` and
    `ehbench.report` are imported, which Python would set in their place."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in __all__ and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Face


def check(file: str | Path) -> Inspection:
    """Look at a rig, recipe, flowmeter CSV or log without running anything.

    Example:
        found = ehbench.check("recipes/slide_servo/hydraulics.toml")
        print(*found.lines, *found.errors, sep="\\n")

    Args:
        file: TOML, CSV or MCAP.

    Returns:
        What was found: ``.lines`` to read, ``.errors``, and ``.code``: that of the first error,
            else 3 with data loss, else 0.

    Raises:
        InputError: the file cannot be taken for what it is."""
    from ehbench.app import inspection

    return inspection.check(Path(file))


def identify(
    recipe: str | Path,
    *,
    out: str | Path | None = None,
    progress: Progress | None = None,
    allow_code: bool = False,
) -> Outcome:
    """Run a recipe of stage ``identify``: flow maps from readings, or hydraulics from step logs.

    Example:
        run = ehbench.identify("recipes/slide_servo/hydraulics.toml")
        run.parameters.loc["bulk_modulus"]

    Arguments and errors as in `run`."""
    return _run(recipe, "identify", out, progress, allow_code=allow_code)


def validate(
    recipe: str | Path,
    *,
    out: str | Path | None = None,
    progress: Progress | None = None,
    allow_code: bool = False,
) -> Outcome:
    """Run a recipe of stage ``validate``; ``.code`` is 4 when the rig is rejected and
    ``.json("validation")`` says why.

    Example:
        run = ehbench.validate("recipes/slide_servo/validation.toml")
        run.code, run.json("validation")["verdict"]

    Arguments and errors as in `run`."""
    return _run(recipe, "validate", out, progress, allow_code=allow_code)


def tune(
    recipe: str | Path,
    *,
    out: str | Path | None = None,
    progress: Progress | None = None,
    unvalidated: bool = False,
) -> Outcome:
    """Run a recipe of stage ``tune``: gains of the pressure feedback in ``.json("tuning")``.

    Example:
        run = ehbench.tune("recipes/slide_servo/tuning.toml")
        run.json("tuning")["gains"]

    Arguments and errors as in `run`."""
    return _run(recipe, "tune", out, progress, unvalidated=unvalidated)


def run_trial(
    recipe: str | Path,
    *,
    out: str | Path | None = None,
    progress: Progress | None = None,
    allow_code: bool = False,
    unvalidated: bool = False,
) -> Outcome:
    """Run a recipe of stage ``trial`` or ``trials``; ``.code`` is 5 when a limit stopped one.

    Example:
        run = ehbench.run_trial("my_rig/recipes/step_small.toml")
        log = ehbench.read_log(run.folder / "log.mcap")

    Arguments and errors as in `run`."""
    allowed = {"allow_code": allow_code, "unvalidated": unvalidated}
    return _run(recipe, "run-trial", out, progress, **allowed)


def open_machine(
    file: str | Path, *, payload: str | None = None, rate: float = 1000.0, allow_code: bool = False
) -> Machine:
    """A machine to step from Python: the model of a rig, or the machine of a trial's recipe.

    Example:
        machine = ehbench.open_machine("recipes/rigs/slide_servo.toml", payload="100 kg")
        machine.start({"press": "100 mm"})
        sample = dict(zip(machine.channels, machine.tick([2.0])))

    ``copy.deepcopy(machine)`` of a model is a machine in the same state: to look ahead.

    Args:
        file: a rig file, a run folder with a rig, or a recipe of stage ``trial``.
        payload: of the rig; that of a recipe is in the recipe.
        rate: ticks a second [Hz]; as above.
        allow_code: as in `run`.

    Raises:
        InputError: a bad file, no such payload."""
    from ehbench import workflow

    session = _session(None, None, allow_code=allow_code)
    return workflow.machine_of(Path(file), payload, rate, session)


def open_controller(
    recipe: str | Path, *, allow_code: bool = False, unvalidated: bool = False
) -> Controller:
    """The controller of a trial's recipe, to step from Python on a plant of your own.

    Example:
        recipe = "recipes/trials/own_controller.toml"
        controller = ehbench.open_controller(recipe, allow_code=True)
        machine = ehbench.open_machine(recipe, allow_code=True)
        sample = machine.start(controller.posture, controller.low_side)
        controller.start(sample)
        volts = controller.step(sample)

    Arguments and errors as in `run`."""
    from ehbench import workflow
    from ehbench.trial.stepping import RecipeController

    session = _session(None, None, allow_code=allow_code, unvalidated=unvalidated)
    return RecipeController(workflow.prepared_trial(recipe, session))


def run_on(
    recipe: str | Path,
    machine: Machine,
    *,
    log: str | Path | None = None,
    progress: Progress | None = None,
    allow_code: bool = False,
) -> tuple[Record, Facts]:
    """Run a trial's recipe, limits and all, on a `Machine` of your own; it is closed afterwards.

    Example:
        rig = "recipes/rigs/slide_servo.toml"
        machine = ehbench.open_machine(rig, payload="100 kg")
        recipe = "recipes/trials/own_controller.toml"
        record, facts = ehbench.run_on(recipe, machine, allow_code=True)

    Args:
        recipe: of stage ``trial``; its rig says what the machine's channels and valves are called.
        machine: with the channels, commands and rate of the recipe.
        log: where to write the log as it comes (``.mcap``).
        progress: called with a sentence and the share done.
        allow_code: as in `run`.

    Returns:
        The record, and the facts of ``trial.json``.

    Raises:
        InputError: a machine that does not fit the recipe; as `run`."""
    from ehbench import trial, workflow
    from ehbench.trial.stepping import refuse_other

    prepared = workflow.prepared_trial(recipe, _session(None, None, allow_code=allow_code))
    refuse_other(machine, prepared)
    result = trial.run(prepared, machine, None if log is None else Path(log), progress, fast=False)
    return result.record, result.facts


def linear_models(
    run: Outcome | str | Path, *, points: str | Path | None = None
) -> dict[str, control.StateSpace]:
    """The linear models of a rig's steady motions, by name, as python-control objects.

    Example:
        models = ehbench.linear_models("recipes/rigs/slide_servo.toml")
        model = models["press, extend_resistive, none, x = 40 mm, v = +74 mm/s"]
        model.poles(), model.input_labels, model.output_labels

    Inputs are the commands [V] of the valves at work and a force on the rod [N], outputs the
    cylinder's speed [m/s] and its pressures [Pa].

    Args:
        run: an outcome, a run folder with a rig, or a rig file.
        points: a recipe of stage ``tune``, whose operating points are taken; by default five
            strokes, all payloads and functions, 30 and 70 % of full speed, of each cylinder.

    Raises:
        InputError: a bad file, or no recipe of tuning.
        InsufficientData: no cylinder can move."""
    from ehbench import workflow
    from ehbench.config.recipe import load_rig
    from ehbench.export.linear import state_spaces
    from ehbench.stages.inputs import maps_in

    path = Path(run) if isinstance(run, str | Path) else run.folder
    recipe: Any = None if points is None else workflow.expect_stage(points, "tune")
    spaces = state_spaces(load_rig(path), maps_in(path), recipe)
    return {space.name: space.as_control() for space in spaces}


def run(
    recipe: str | Path,
    *,
    out: str | Path | None = None,
    progress: Progress | None = None,
    unvalidated: bool = False,
    allow_code: bool = False,
) -> Outcome:
    """Run a recipe of any stage.

    Example:
        run = ehbench.run("recipes/slide_servo/hydraulics.toml")
        run.code, run.notes

    Args:
        recipe: its TOML file.
        out: the run's folder; ``reports/<recipe>_<hash8>/`` by default.
        progress: called with an activity and the share done.
        unvalidated: tune on a rig that no validation accepted.
        allow_code: let the recipe run a controller or an FMU of your own.

    Returns:
        The outcome: ``.folder``, ``.code``, ``.notes``, and what the run saved: ``.rig``,
            ``.flow_maps``, ``.parameters``, ``.json("parameters")``.

    Raises:
        InputError: a bad recipe or bad data; with file, line and what would be right.
        InsufficientData: the data do not support the result.
        ModelRejected: the rig is not validated."""
    from ehbench import workflow

    session = _session(out, progress, unvalidated=unvalidated, allow_code=allow_code)
    return workflow.run(Path(recipe), session)


def report(
    runs: Sequence[Outcome | str | Path],
    *,
    out: str | Path | None = None,
    progress: Progress | None = None,
) -> Outcome:
    """Write one HTML page over finished runs, from their saved files only.

    Example:
        run = ehbench.validate("recipes/slide_servo/validation.toml")
        page = ehbench.report([run]).folder / "report.html"

    Args:
        runs: outcomes, or run folders.
        out: the page's folder; ``reports/report_<hash8>/`` by default.
        progress: called with a sentence and the share done.

    Returns:
        The outcome, in whose ``.folder`` the page is: ``report.html``.

    Raises:
        InputError: a folder is no whole run."""
    from ehbench import workflow

    folders = [Path(run) if isinstance(run, str | Path) else run.folder for run in runs]
    return workflow.report(folders, _session(out, progress))


def _session(
    out: str | Path | None,
    progress: Progress | None,
    *,
    unvalidated: bool = False,
    allow_code: bool = False,
) -> Session:
    from ehbench import workflow

    return workflow.Session(
        out=None if out is None else Path(out),
        progress=progress,
        unvalidated=unvalidated,
        allow_code=allow_code,
    )


def _run(
    recipe: str | Path,
    command: str,
    out: str | Path | None,
    progress: Progress | None,
    **allowed: bool,
) -> Outcome:
    from ehbench import workflow

    session = _session(out, progress, **allowed)
    return workflow.run(workflow.expect_stage(recipe, command), session)
