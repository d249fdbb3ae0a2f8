"""A stage takes in what its recipe names, does its work and leaves one run folder.

To add a stage, write its recipe model and one file here with its `Stage`, add it to
`STAGES` and to `runs.versions`, and give it a section in `ehbench.report.stages`."""

from __future__ import annotations

import shutil
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import numpy as np
import tomli_w

from ehbench.config.recipe import Recipe, load_rig
from ehbench.config.rig import Rig
from ehbench.physics.flow_map import FlowMaps, save_flow_maps
from ehbench.runs import rundir
from ehbench.runs.versions import Versions
from ehbench.runtime.disk import write_text
from ehbench.sampling.sample import Workers
from ehbench.stages.inputs import Inputs, Logs, NamedFiles, RigState, maps_in
from ehbench.vocabulary import InputError, Progress, message, plural, quantity
from ehbench.vocabulary.notebook import label, shown, table

if TYPE_CHECKING:
    import pandas as pd

DONE, INCOMPLETE, REJECTED, STOPPED = 0, 3, 4, 5


@dataclass(frozen=True)
class Outcome:
    """What a run leaves: its folder, the exit code and notes to the user."""

    folder: Path
    code: int = DONE
    notes: tuple[str, ...] = ()

    @property
    def rig(self) -> Rig:
        """The rig that the run leaves."""
        return load_rig(self.folder)

    @property
    def flow_maps(self) -> FlowMaps | None:
        """The flow maps that the run leaves, if any."""
        return maps_in(self.folder)

    @property
    def parameters(self) -> pd.DataFrame:
        """Parameters by name [SI]: value, standard error, 95 % interval, unit, status."""
        import pandas as pd

        rows = {}
        for row in self.json("parameters")["parameters"]:
            low, high = row["interval"] or (None, None)
            ends = {"value": row["value"], "std": row["std"], "low": low, "high": high}
            rows[row["name"]] = ends | {"unit": row["unit"], "status": row["status"]}
        return pd.DataFrame.from_dict(rows, orient="index")

    def json(self, name: str) -> Any:
        """A JSON result of the run, by its name without ending, such as ``parameters`` or
        ``validation``.

        Raises:
            InputError: the run left none of that name.
        """
        path = self.folder / f"{name}.json"
        if not path.is_file():
            known = ", ".join(sorted(file.stem for file in self.folder.glob("*.json")))
            text = message("stages.no_result", name=path.name, known=known)
            raise InputError(text, file=self.folder)
        return rundir.read_json(path)

    def __repr__(self) -> str:
        notes = plural(len(self.notes), "note")
        return f"<Outcome '{self.folder}': code {self.code}, {notes}>"

    def _repr_html_(self) -> str:
        notes = "".join(f"<li>{escape(note)}</li>" for note in self.notes)
        head = f"<p><code>{escape(str(self.folder))}</code>, code {self.code}</p><ul>{notes}</ul>"
        if not (self.folder / "parameters.json").is_file():
            return head
        rig, rows = self.rig, []
        for row in self.json("parameters")["parameters"]:
            name = row["name"]
            unit = rig.unit_of(name)
            value, error = (shown(row[key], name, unit) for key in ("value", "std"))
            interval = " … ".join(shown(end, name, unit) for end in row["interval"] or ())
            rows.append((name, value, error, interval, label(unit), row["status"]))
        header = ("parameter", "value", "standard error", "95 % interval", "unit", "status")
        return head + table(header, rows)


@dataclass(frozen=True)
class Prepared:
    """All that is known of a run before its work: each stage adds what it has taken in.

    ``inputs`` are its files; None where only the run can tell them. ``does`` is what the run
    does."""

    recipe: Recipe
    inputs: NamedFiles | None
    does: str
    seeds: Mapping[str, int] = field(default_factory=dict, kw_only=True)

    @property
    def notes(self) -> tuple[str, ...]:
        """What is known of its controllers before its work."""
        return ()


@dataclass(frozen=True)
class PreparedFromLogs(Prepared):
    """A run that reads a rig and logs."""

    state: RigState
    logs: Logs

    def done(self, warnings: Sequence[str], **facts: Any) -> Work:
        """The work on these logs, incomplete where data are lost."""
        recorded_on = {record.meta["on"] for _, record in self.logs.records if "on" in record.meta}
        losses = self.logs.losses
        return Work(
            {
                "rig": self.state.rig.name,
                "warnings": [*losses, *self.logs.remarks, *warnings],
                "recorded_on": sorted(recorded_on),
                **({"details": self.logs.details} if self.logs.details else {}),
                **facts,
            },
            code=INCOMPLETE if losses else DONE,
        )


@dataclass(frozen=True)
class Work:
    """Facts for ``run.json`` with ``warnings``, reasons for a code, the exit code, and what is said
    of this machine, which no file of the run holds."""

    facts: Mapping[str, Any]
    reasons: Sequence[str] = ()
    code: int = DONE
    here: Sequence[str] = ()


@dataclass(frozen=True)
class Host:
    """Where a stage runs.

    Args:
        root: folder of all runs.
        out: folder of this run; one under ``root`` by default.
        progress: callback.
        keep: leave a finished run of the very same inputs alone.
        resume: go on with searches and studies that were stopped.
        workers: where a study's samples are made.
    """

    root: Path = Path("reports")
    out: Path | None = None
    progress: Progress | None = None
    keep: bool = False
    resume: bool = False
    workers: Workers = Workers()

    def progress_of(self, name: str) -> Progress | None:
        """The progress callback, labelled with the recipe at work."""
        progress = self.progress
        if progress is None:
            return None
        return lambda text, share: progress(": ".join(t for t in (name, text) if t), share)

    def outcome_of(self, path: Path) -> Outcome:
        """The outcome of a recipe, run only if it has not been run with these very inputs."""
        raise NotImplementedError


R = TypeVar("R", bound=Recipe)
P = TypeVar("P", bound=Prepared)


# by kind of recipe, in the order of the data: the module and class of its stage, which is imported
# when such a recipe is at work
STAGES: dict[tuple[str, str | None], str] = {
    ("identify", "flow_map"): "flow_map.FlowMapStage",
    ("identify", "hydraulics"): "hydraulics.HydraulicsStage",
    ("response", None): "response.ResponseStage",
    ("validate", None): "validation.ValidationStage",
    ("tune", None): "tuning.TuningStage",
    ("tune", "arc"): "tuning.ArcTuningStage",
    ("trial", None): "trial.TrialStage",
    ("trials", None): "trials.TrialsStage",
    ("study", None): "study.StudyStage",
    ("export", None): "export.ExportStage",
    ("campaign", None): "campaign.CampaignStage",
    ("bench", None): "bench.BenchFile",
    ("dataset", None): "bench.Dataset",
}


def stage_of(recipe: Recipe | type[Recipe]) -> Stage[Any, Any]:
    """The stage of a recipe."""
    module, _, name = STAGES[recipe.kind()].partition(".")
    return getattr(import_module(f"ehbench.stages.{module}"), name)()


class Stage(ABC, Generic[R, P]):
    """A stage: ``name`` as in the report, its ``command``, the files it ``writes``. What no command
    runs can be checked."""

    name: ClassVar[str] = ""
    command: ClassVar[str] = ""
    writes: ClassVar[str] = ""

    @abstractmethod
    def prepare(self, recipe: R, inputs: Inputs) -> P:
        """Take in what the recipe names and refuse what does not fit, without running anything.

        A run and ``ehbench check`` both call it; notes go into ``inputs.notes``.

        Raises:
            EhbenchError: what the run would refuse before it begins.
        """

    def work(self, prepared: P, folder: Path, progress: Progress | None) -> Work:
        """Do the work and write its files into ``folder``.

        Raises:
            EhbenchError: the data do not support the result, numbers are not finite, …
        """
        raise NotImplementedError

    def results(self, prepared: P) -> list[Any]:
        """Types of the results for `sampling.measures.refuse_unknown`; nothing if unknown."""
        return []

    def place(self, prepared: P, host: Host) -> Path:
        """Where the run's folder goes."""
        return host.out or self.default_place(prepared, host.root)

    def default_place(self, prepared: P, root: Path) -> Path:
        """``<root>/<recipe>_<hash8>``: the hash is over recipe, inputs and versions."""
        path, versions = prepared.recipe.path, self.versions(prepared)
        return root / f"{path.stem}_{rundir.hash_of(path, prepared.inputs or (), versions)}"

    def versions(self, prepared: P) -> Versions:
        """Versions of the run's schema and of the methods that produce it."""
        return Versions.of(self.name)

    def run(self, prepared: P, host: Host) -> Outcome:
        """Do the work in a new run folder and draw its figures; the host may keep an old run."""
        from ehbench.report import draw

        recipe, inputs = prepared.recipe, prepared.inputs or ()
        final = self.place(prepared, host)
        if host.keep and rundir.is_whole(final):
            facts = rundir.read_json(final / "run.json")
            return Outcome(final, facts["code"], tuple(facts["notes"]))
        progress = host.progress_of(recipe.name)
        versions = self.versions(prepared)
        with rundir.open_run(
            final, recipe.stage_name, recipe.path, inputs, prepared.seeds, versions
        ) as run:
            run.facts["on"] = getattr(recipe, "on", None)  # a machine's log stays, come what may
            work = self.work(prepared, run.path, progress)
            notes = [*work.facts["warnings"], *work.reasons]
            about = {"what": self.name, "title": recipe.title}
            run.facts = about | {**work.facts, "code": work.code, "notes": notes}
            if progress is not None:
                progress("drawing figures", 0.95)
            run.save()
            draw(run.path)
        return Outcome(run.final, work.code, (*notes, *work.here, *run.left_over))


def write_rig(folder: Path, rig: Rig, maps: FlowMaps | None) -> None:
    """``rig.toml``, and ``flow_maps.json`` where there are maps."""
    if rig.model is not None:
        place = folder / Path(rig.model.fmu).name
        shutil.copyfile(rig.model.place, place)
        rig = rig.model_copy(update={"model": rig.model.model_copy(update={"fmu": place.name})})
    write_text(folder / "rig.toml", tomli_w.dumps(rig.as_toml()))
    if maps is not None:
        save_flow_maps(maps, folder)


def write_series(folder: Path, series: Sequence[tuple[str, Mapping[str, np.ndarray]]]) -> None:
    """One CSV log for each recording: ``<name>.csv`` with columns named ``t [s]``, ``boom.q [rad]``
    (recorded) and ``simulated.boom.q [rad]``, in SI; none where nothing is compared."""
    folder.mkdir()
    for name, columns in (pair for pair in series if len(pair[1]) > 1):
        table = np.column_stack(list(columns.values()))
        header = ",".join(f"{channel} [{quantity(channel).unit}]" for channel in columns)
        np.savetxt(folder / f"{name}.csv", table, "%.9g", ",", header=header, comments="")
