"""What a stage is: it takes in what its recipe names, does its one job, leaves one run folder.

To add a stage, write one file here with its recipe model and its `Stage`, add it to
`stages.REGISTRY`, and give it a section in `ehbench.report.stages` under the same name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Protocol, TypeVar

from ehbench.config.recipe import Recipe, load_rig
from ehbench.runs import rundir
from ehbench.runs.versions import Versions
from ehbench.stages.inputs import Inputs, NamedFiles, maps_in
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.notebook import label, plural, shown, table
from ehbench.vocabulary.progress import Progress

if TYPE_CHECKING:
    import pandas as pd

    from ehbench.config.rig import Rig
    from ehbench.data.record import Record
    from ehbench.physics.flow_map import FlowMaps

DONE, INCOMPLETE, REJECTED, STOPPED = 0, 3, 4, 5


@dataclass(frozen=True)
class Outcome:
    """What a run leaves: the run folder, the exit code, and what to tell the user."""

    folder: Path
    code: int = DONE
    notes: tuple[str, ...] = ()

    @property
    def rig(self) -> Rig:
        """The rig that the run leaves behind."""
        return load_rig(self.folder)

    @property
    def flow_maps(self) -> FlowMaps | None:
        """The flow maps that the run leaves behind, if any."""
        return maps_in(self.folder)

    @property
    def parameters(self) -> pd.DataFrame:
        """Identified parameters by name [SI]: value, standard error ``std``, 95 % interval ``low``
        and ``high``, unit, status.
        """
        import pandas as pd

        rows = {
            row["name"]: {
                "value": row["value"],
                "std": row["std"],
                "low": row["interval"] and row["interval"][0],
                "high": row["interval"] and row["interval"][1],
                "unit": row["unit"],
                "status": row["status"],
            }
            for row in self.json("parameters")["parameters"]
        }
        return pd.DataFrame.from_dict(rows, orient="index")

    def json(self, name: str) -> Any:
        """A JSON result of the run, by its name without ending, such as ``parameters`` or
        ``validation``.

        Raises:
            InputError: the run left none of that name; says which it left.
        """
        path = self.folder / f"{name}.json"
        if not path.is_file():
            there = ", ".join(sorted(file.stem for file in self.folder.glob("*.json")))
            raise InputError(f"has no {path.name}", file=self.folder, hint=f"it has {there}")
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
    """All that can be known of a run before its work: each stage adds what it has taken in.

    ``inputs`` name the run folder, with the recipe; None where only the run can tell them. ``does``
    says in words what the run does."""

    recipe: Recipe
    inputs: NamedFiles | None
    does: str
    seeds: Mapping[str, int] = field(default_factory=dict, kw_only=True)


@dataclass(frozen=True)
class Work:
    """What a stage's work leaves beside its files: facts for ``run.json`` with their ``warnings``,
    reasons why it is not simply done, and the exit code.
    """

    facts: Mapping[str, Any]
    reasons: Sequence[str] = ()
    code: int = DONE


class Host(Protocol):
    """The session that runs a stage, as far as a stage sees it."""

    @property
    def root(self) -> Path: ...

    @property
    def out(self) -> Path | None: ...

    @property
    def keep(self) -> bool: ...

    @property
    def resume(self) -> bool: ...

    def tell(self, name: str) -> Progress | None:
        """A progress callback labelled with the recipe at work."""
        ...

    def outcome_of(self, path: Path) -> Outcome:
        """The outcome of a recipe, run only if it has not been run with these very inputs."""
        ...


R = TypeVar("R", bound=Recipe)
P = TypeVar("P", bound=Prepared)


class Checked(ABC, Generic[R]):
    """A kind of recipe that can be checked; one that can be run is a `Stage`."""

    recipe: ClassVar[type[Recipe]]

    @abstractmethod
    def prepare(self, recipe: R, inputs: Inputs) -> Prepared:
        """Take in what the recipe names and refuse what does not fit, without running anything.

        A run and ``ehbench check`` both call it; what is to be said goes into ``inputs.findings``.

        Raises:
            EhbenchError: what the run would refuse before it begins.
        """


# by kind of recipe; `ehbench.stages` enters every stage
REGISTRY: dict[tuple[str, str | None], Checked[Any]] = {}


def stage_of(recipe: Recipe) -> Checked[Any]:
    """The stage of a recipe."""
    return REGISTRY[recipe.kind()]


class Stage(Checked[R], Generic[R, P]):
    """One stage: ``name`` is also that of its section in the report, ``command`` runs its recipes,
    ``writes`` says which files a run leaves.
    """

    name: ClassVar[str]
    command: ClassVar[str]
    writes: ClassVar[str]

    @abstractmethod
    def prepare(self, recipe: R, inputs: Inputs) -> P: ...

    @abstractmethod
    def work(self, prepared: P, folder: Path, progress: Progress | None) -> Work:
        """Do the work and write its files into ``folder``.

        Raises:
            EhbenchError: the data do not support the claim, the numbers left the finite range, …
        """

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
        """Do the work in a new run folder and draw its figures; a run that stands with these very
        inputs is kept if the host keeps.
        """
        from ehbench.report import draw

        recipe, inputs = prepared.recipe, prepared.inputs or ()
        final = self.place(prepared, host)
        if host.keep and rundir.is_whole(final):
            facts = rundir.read_json(final / "run.json")
            return Outcome(final, facts["code"], tuple(facts["notes"]))
        tell = host.tell(recipe.name)
        versions = self.versions(prepared)
        with rundir.open_run(
            final, recipe.stage_name, recipe.path, inputs, prepared.seeds, versions
        ) as run:
            work = self.work(prepared, run.path, tell)
            notes = [*work.facts["warnings"], *work.reasons]
            about = {"what": self.name, "title": recipe.title}
            run.facts |= about | {**work.facts, "code": work.code, "notes": notes}
            if tell is not None:
                tell("drawing figures", 0.95)
            run.save()
            draw(run.path)
        return Outcome(final, work.code, (*notes, *run.left_over))


def write_rig(folder: Path, rig: Rig, maps: FlowMaps | None) -> None:
    """``rig.toml``, and ``flow_maps.json`` where there are maps."""
    import tomli_w

    from ehbench.physics.flow_map import save_flow_maps

    (folder / "rig.toml").write_text(tomli_w.dumps(rig.as_toml()), encoding="utf-8")
    if maps is not None:
        save_flow_maps(maps, folder / "flow_maps.json")


def write_series(folder: Path, series: Mapping[str, Mapping[str, Any]]) -> None:
    """One CSV log for each recording: ``<name>.csv`` with recorded and simulated channels."""
    import numpy as np

    folder.mkdir()
    for name, columns in series.items():
        table = np.column_stack(list(columns.values()))
        header = ",".join(columns)
        np.savetxt(folder / f"{name}.csv", table, "%.9g", ",", header=header, comments="")


def recorded_on(logs: Sequence[tuple[str, Record]]) -> list[str]:
    """What the logs say they were recorded on, such as the virtual bench."""
    return sorted({record.meta["on"] for _, record in logs if "on" in record.meta})
