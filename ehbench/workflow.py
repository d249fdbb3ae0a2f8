"""The main path, in the order of the data. Read this first.

    recipe → rig → record (log) → identified rig → validated rig → tuned controller → record (trial)
    → report

Each arrow is one stage, one file in `ehbench.stages`. Every run goes the same way: a recipe file is
read into its model (`recipe`), its stage takes in what the recipe names and refuses what does not
fit (`Stage.prepare`; ``ehbench check`` ends here), and works in a new run folder of plain files
(`Stage.run`). A recipe may name a rig, a flow map or a log by the file, by the run folder or by the
recipe that makes it; in the last case that recipe is run first, unless its run is current."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ehbench import stages
from ehbench.config.recipe import Recipe, TrialRecipe, kind_of, load_recipe, load_rig
from ehbench.runs import rundir
from ehbench.runtime.blas import one_thread
from ehbench.sampling.sample import Certificates, Workers
from ehbench.stages.base import DONE, INCOMPLETE, REJECTED, STOPPED, Host, Outcome
from ehbench.stages.campaign import write_report as report
from ehbench.stages.dry_run import CircularRecipes
from ehbench.stages.inputs import Inputs, RigState, ValidatedRig, maps_in
from ehbench.stages.notes import Notes
from ehbench.vocabulary import EhbenchError, InputError, message, quantity
from ehbench.vocabulary.fields import read_value

if TYPE_CHECKING:
    from ehbench.guidance.suggestions import Suggestions
    from ehbench.machines.protocol import Machine
    from ehbench.stages.planning import NextTest
    from ehbench.trial.preparation import Prepared

ROOT = Path("reports")


@dataclass(frozen=True)
class Session(Host):
    """Where runs go, how progress is reported, which runs are finished, and what is allowed.

    Args:
        allow_code: let recipes run Python code.
        unvalidated: let a controller be tuned on a rig that no validation accepted.
        ask: (what is about to happen, a token) → what a person typed; a machine moves only then.
        live: the address of a trial's live view → whether it may draw on the terminal.
        finished: outcomes by recipe file: each recipe is run once.
        under_way: the recipes that wait for the one at work."""

    allow_code: bool = False
    unvalidated: bool = False
    ask: Callable[[str, str], str] | None = None
    live: Callable[[str], bool] | None = None
    finished: dict[Path, Outcome] = field(default_factory=dict)
    under_way: tuple[Path, ...] = ()

    def inputs(self, recipe: Recipe) -> Inputs:
        """What a recipe takes in; other recipes that it names are run when it asks for them.

        Raises:
            InputError: it needs itself."""
        if recipe.path in self.under_way:
            raise CircularRecipes.of(list(self.under_way), recipe.path)
        session = replace(self, out=None, under_way=(*self.under_way, recipe.path))
        return Inputs(
            recipe,
            Notes(recipe),
            lambda path: session.outcome_of(path).folder,
            allow_code=self.allow_code,
            unvalidated=self.unvalidated,
            ask=self.ask,
            live=self.live,
        )

    def outcome_of(self, path: Path) -> Outcome:
        """The outcome of a recipe, run only if it has not been run with these very inputs."""
        place = path.resolve()
        if place not in self.finished:
            self.finished[place] = run(path, replace(self, out=None, keep=True))
        return self.finished[place]


@one_thread()
def run(recipe: Recipe | Path | str, session: Session | None = None) -> Outcome:
    """Run a recipe of any stage.

    Raises:
        EhbenchError: bad input, data that do not support the result, …; no run folder is left."""
    recipe = recipe if isinstance(recipe, Recipe) else load_recipe(recipe)
    session, stage = session or Session(), stages.stage_of(recipe)
    if not stage.command:
        raise InputError(message("stages.no_command", stage=recipe.stage_name), file=recipe.path)
    if session.out is not None:  # before runs are made that the recipe names
        rundir.checked_place(session.out)
    prepared = stage.prepare(recipe, session.inputs(recipe))
    under_way = (*session.under_way, recipe.path)
    return stage.run(prepared, replace(session, under_way=under_way))


@one_thread()
def profile(recipe: Recipe | Path | str, name: str, session: Session | None = None) -> Outcome:
    """The profile likelihood of a parameter of a hydraulics recipe, in a run folder of its own.

    Raises:
        EhbenchError: as `run`; another kind of recipe, a parameter that it does not fit."""
    from ehbench.stages.planning import write_profile

    recipe = recipe if isinstance(recipe, Recipe) else load_recipe(recipe)
    session = session or Session()
    return write_profile(session.inputs(recipe), name, session)


def export(source: Path, options: Mapping[str, Any], session: Session | None = None) -> Outcome:
    """Export a rig, or the controller of a trial or tuning; the recipe of it is written beside the
    run's folder.

    Args:
        source: rig file, run folder, or recipe: of an export, or of what is exported.
        options: keys of `ExportRecipe` as a recipe has them.
        session: as for `run`.

    Raises:
        EhbenchError: as `run`; options for a recipe of an export, which has them."""
    from ehbench.stages.export import recipe_for, withdraw

    session = session or Session()
    recipe = recipe_for(source, options, session)
    try:
        return run(recipe, session)
    except EhbenchError as error:
        if recipe.path != source.resolve():
            withdraw(recipe.path, source, error)
        raise


@one_thread()
def suggest(
    recipe: Recipe | Path | str, session: Session | None = None, seconds: float | None = None
) -> Suggestions:
    """What would improve the fit of an identify recipe, compared on windows left out of it; with
    ``session.out`` the first suggestion is written there, as a recipe with its rig.

    Args:
        recipe: of hydraulics.
        session: as for `run`; nothing else is written.
        seconds: after which nothing more is tried; 120 by default.

    Raises:
        EhbenchError: as `run`, or a recipe of another kind."""
    from ehbench.guidance import suggestions
    from ehbench.stages import hydraulics

    recipe = recipe if isinstance(recipe, Recipe) else load_recipe(recipe)
    recipe, session = hydraulics.expect_hydraulics(recipe), session or Session()
    prepared = hydraulics.HydraulicsStage().prepare(recipe, session.inputs(recipe))
    assert prepared.fit is not None  # a run has all its logs
    limit = suggestions.SECONDS if seconds is None else seconds
    progress = session.progress_of(recipe.name)
    result = suggestions.suggest(prepared.fit, prepared.logs.records, progress, limit)
    if session.out is not None:
        hydraulics.write_suggested(prepared, result, session.out)
    return result


@one_thread()
def next_test(folder: Path, name: str | None = None, session: Session | None = None) -> NextTest:
    """The tests that would sharpen a parameter of a run of hydraulics the most, by default the one
    that is known least; with ``session.out`` the best is written there as a recipe.

    Raises:
        EhbenchError: no such run or parameter, a recipe that has changed, no possible test."""
    from ehbench.report.provenance import TracedRun
    from ehbench.stages.planning import plan, recipe_of

    fit = TracedRun(folder)
    recipe, session = recipe_of(fit), session or Session()
    result = plan(fit, session.inputs(recipe), name, session.progress_of(recipe.name))
    if session.out is not None:
        result.write(session.out)
    return result


def prepared_trial(path: Path | str, session: Session | None = None) -> Prepared:
    """The trial of a recipe before its first tick, with all that the recipe names.

    Raises:
        EhbenchError: as `run`; a recipe of another stage."""
    from ehbench.stages.trial import TrialStage

    recipe, session = load_recipe(path), session or Session()
    if not isinstance(recipe, TrialRecipe):
        raise InputError(message("stages.no_trial", stage=recipe.stage_name), file=recipe.path)
    return TrialStage().prepare(recipe, session.inputs(recipe)).trial


def machine_of(
    path: Path, payload: str | None, rate: float, session: Session | None = None
) -> Machine:
    """The machine of a trial's recipe, or the model of a rig file or run folder.

    Raises:
        EhbenchError: no such payload or rate, as `prepared_trial`."""
    from ehbench.machines.fmu import FmuMachine
    from ehbench.machines.simulated import SimulatedMachine
    from ehbench.plant.foreign import FmuModel
    from ehbench.plant.model import Model
    from ehbench.stages.inputs import refuse_fmu

    if path.is_file() and kind_of(path) == "recipe":
        return prepared_trial(path, session).machine
    rate = float(read_value(f"{rate} Hz", quantity("rate")))
    rig, maps = load_rig(path), maps_in(path)
    refuse_fmu(rig, session is not None and session.allow_code)
    if rig.model is not None:
        return FmuMachine(FmuModel.of(rig, maps, payload), rate)
    return SimulatedMachine(Model.of(rig, maps, payload), rate)


@one_thread()
def sample(study: Path, index: int, session: Session | None = None) -> Recipe:
    """The recipe of one sample of a study, with its rig and bench file, in a folder of its own.

    Args:
        study: its recipe, or its run folder.
        index: of the sample, from 0.
        session: as for `run`; the folder goes to its root.

    Raises:
        EhbenchError: no such study or sample, a recipe that has changed since its run."""
    from ehbench.stages.study import sample_recipe

    session = session or Session()
    return load_recipe(sample_recipe(study, index, session.root, session.inputs))


def expect_stage(path: Path | str, *commands: str) -> Recipe:
    """The recipe of a file that one of these commands runs.

    Raises:
        InputError: with the command that takes it."""
    recipe = load_recipe(path)
    command = stages.stage_of(recipe).command
    if command not in commands:
        hint = f"run it with: ehbench {command} {path}" if command else None
        text = message("stages.other_stage", stage=recipe.stage_name)
        raise InputError(text, file=path, hint=hint)
    return recipe
