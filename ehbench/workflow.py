"""The main path, in the order of the data. Read this first.

    recipe → rig → record (log) → identified rig → validated rig → tuned controller → record (trial)
    → report

Each arrow is one stage, one file in `ehbench.stages`. Every run goes the same way: a recipe file is
read into its model (`recipe`), its stage takes in what the recipe names and refuses what does not
fit (`Stage.prepare`; ``ehbench check`` ends here), and works in a new run folder of plain files
(`Stage.run`). A recipe may name a rig, a flow map or a log by the file, by the run folder or by the
recipe that makes it; in the last case that recipe is run first, unless its run is there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ehbench import stages
from ehbench.config.recipe import HydraulicsRecipe, Recipe, load_recipe
from ehbench.runtime.blas import one_thread
from ehbench.stages.base import DONE, INCOMPLETE, REJECTED, STOPPED, Outcome, Stage
from ehbench.stages.campaign import write_report
from ehbench.stages.findings import Findings
from ehbench.stages.inputs import Inputs, RigState, ValidatedRig
from ehbench.stages.look import Circle
from ehbench.stages.study import Where
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.progress import Progress

if TYPE_CHECKING:
    from ehbench.guidance.suggestions import Suggestions
    from ehbench.stages.planning import NextTest

__all__ = [
    "DONE",
    "INCOMPLETE",
    "REJECTED",
    "ROOT",
    "STOPPED",
    "FinishedRuns",
    "Outcome",
    "RigState",
    "Session",
    "ValidatedRig",
    "Where",
    "expect_stage",
    "next_test",
    "profile",
    "report",
    "run",
    "sample",
    "suggest",
]
ROOT = Path("reports")


class FinishedRuns:
    """The runs that a session has made or met, by recipe file: each is made once."""

    def __init__(self) -> None:
        self._by_recipe: dict[Path, Outcome] = {}

    def of(self, path: Path) -> Outcome | None:
        """The outcome of a recipe file, if it is there."""
        return self._by_recipe.get(path.resolve())

    def add(self, path: Path, outcome: Outcome) -> Outcome:
        """Keep an outcome; returns it."""
        self._by_recipe[path.resolve()] = outcome
        return outcome


@dataclass(frozen=True)
class Session:
    """Where runs go, how progress is told, which runs are finished, and what was allowed aloud.

    ``allow_code`` lets recipes run Python code, ``unvalidated`` lets a controller be tuned on a rig
    that no validation accepted. ``keep`` leaves a run alone that stands with the very same inputs;
    dependencies and campaigns work so. ``where`` says where a study makes its samples; ``resume``
    goes on with searches and studies that were stopped.
    ``under_way`` are the recipes that wait for the one at work.
    """

    root: Path = ROOT
    out: Path | None = None
    progress: Progress | None = None
    finished: FinishedRuns = field(default_factory=FinishedRuns)
    allow_code: bool = False
    unvalidated: bool = False
    keep: bool = False
    where: Where = Where()
    resume: bool = False
    under_way: tuple[Path, ...] = ()

    def tell(self, name: str) -> Progress | None:
        """A progress callback labelled with the recipe at work."""
        progress = self.progress
        if progress is None:
            return None
        return lambda text, share: progress(": ".join(t for t in (name, text) if t), share)

    def outcome_of(self, path: Path) -> Outcome:
        """The outcome of a recipe, run only if it has not been run with these very inputs; it goes
        to ``root``.
        """
        finished = self.finished.of(path)
        return finished or self.finished.add(path, run(path, replace(self, out=None, keep=True)))

    def folder(self, path: Path, findings: Findings) -> Path:
        """The run folder of a recipe that another one names: made first, if need be."""
        return self.outcome_of(path).folder

    def findings(self, path: Path) -> None:
        """Nothing: a run finds out when its turn comes."""


@one_thread()
def run(recipe: Recipe | Path | str, session: Session | None = None) -> Outcome:
    """Run a recipe of any stage.

    Raises:
        EhbenchError: bad input, data that do not support the claim, and so on; nothing is left
            behind then.
    """
    recipe = recipe if isinstance(recipe, Recipe) else load_recipe(recipe)
    session = session or Session()
    if recipe.path in session.under_way:
        raise Circle.of(list(session.under_way), recipe.path)
    stage = stages.stage_of(recipe)
    if not isinstance(stage, Stage):
        raise InputError(f"no stage for {type(recipe).__name__}", file=recipe.path)
    session = replace(session, under_way=(*session.under_way, recipe.path))
    allowed = {"allow_code": session.allow_code, "unvalidated": session.unvalidated}
    prepared = stage.prepare(recipe, Inputs(recipe, Findings(recipe), session, **allowed))
    return stage.run(prepared, session)


@one_thread()
def profile(recipe: Recipe | Path | str, name: str, session: Session | None = None) -> Outcome:
    """The profile likelihood of a parameter of a hydraulics recipe, in a run folder of its own.

    Raises:
        EhbenchError: as `run`; another kind of recipe, a parameter that it does not fit.
    """
    from ehbench.stages.planning import write_profile

    recipe = recipe if isinstance(recipe, Recipe) else load_recipe(recipe)
    session = session or Session()
    within = replace(session, out=None, under_way=(*session.under_way, recipe.path))
    return write_profile(Inputs(recipe, Findings(recipe), within), name, session)


@one_thread()
def suggest(
    recipe: Recipe | Path | str, session: Session | None = None, seconds: float | None = None
) -> Suggestions:
    """What would better the fit of an identify recipe, compared on windows left out of it; with
    ``session.out`` the first suggestion is written there, as a recipe with its rig.

    Args:
        recipe: of hydraulics.
        session: as for `run`; nothing else is written.
        seconds: after which nothing more is tried; 120 by default.

    Raises:
        EhbenchError: as `run`, or a recipe of another kind.
    """
    from ehbench.guidance.suggestions import SECONDS
    from ehbench.stages.hydraulics import HydraulicsStage, suggested, write_suggested

    recipe = recipe if isinstance(recipe, Recipe) else load_recipe(recipe)
    session, stage = session or Session(), stages.stage_of(recipe)
    if not isinstance(stage, HydraulicsStage) or not isinstance(recipe, HydraulicsRecipe):
        raise InputError(
            "has no parameters to suggest others for",
            file=recipe.path,
            hint='name a recipe of stage "identify", what = "hydraulics"',
        )
    session = replace(session, under_way=(*session.under_way, recipe.path))
    prepared = stage.prepare(recipe, Inputs(recipe, Findings(recipe), session))
    result = suggested(prepared, session.tell(recipe.name), SECONDS if seconds is None else seconds)
    if session.out is not None:
        write_suggested(prepared, result, session.out)
    return result


@one_thread()
def next_test(folder: Path, name: str | None = None, session: Session | None = None) -> NextTest:
    """The tests that would sharpen a parameter of a run of hydraulics most, by default that which
    is known least; with ``session.out`` the best is written there as a recipe.

    Raises:
        EhbenchError: no such run or parameter, a recipe that has changed, no possible test.
    """
    from ehbench.report.bearing import Made
    from ehbench.stages.planning import fit_behind, plan

    built = Made(folder)
    recipe, session = fit_behind(built), session or Session()
    within = replace(session, out=None, under_way=(*session.under_way, recipe.path))
    inputs = Inputs(recipe, Findings(recipe), within)
    result = plan(built, inputs, name, session.tell(recipe.name))
    if session.out is not None:
        result.write(session.out)
    return result


@one_thread()
def sample(study: Path, index: int, session: Session | None = None) -> Recipe:
    """The recipe of one sample of a study, with its rig and bench file, in a folder of its own.

    Args:
        study: its recipe, or its run folder.
        index: of the sample, from 0.
        session: as for `run`; the folder goes to its root.

    Raises:
        EhbenchError: no such study or sample, a recipe that has changed since its run.
    """
    from ehbench.stages.single_sample import again

    session = session or Session()
    return again(study, index, session)


def expect_stage(path: Path | str, *commands: str) -> Recipe:
    """The recipe of a file that one of these commands runs.

    Raises:
        InputError: with the command that takes it.
    """
    recipe = load_recipe(path)
    stage = stages.stage_of(recipe)
    command = stage.command if isinstance(stage, Stage) else None
    if command not in commands:
        hint = f"run it with: ehbench {command} {path}" if command else None
        raise InputError(f"is a recipe of stage '{recipe.stage_name}'", file=path, hint=hint)
    return recipe


def report(folders: Sequence[Path], session: Session) -> Outcome:
    """Run folders → one self-contained ``report.html``; reads saved files only."""
    return write_report(folders, session)
