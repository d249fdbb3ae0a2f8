"""What stages take in, by the names a recipe has for it: rigs with their maps, logs, runs of other
recipes.

A run first runs a recipe that another one names. A dry run takes the rig file at the root of the
chain in place of what has not been run, or leaves it out, and notes that."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ehbench.config.recipe import (
    ColumnMap,
    DataFile,
    FlowMapRecipe,
    Recipe,
    ValidateRecipe,
    kind_of,
    load_recipe,
    load_rig,
    whole_map,
)
from ehbench.config.rig import Cylinder, Rig, Valve
from ehbench.data import read
from ehbench.data.additional import AdditionalFile
from ehbench.data.record import OVERRULED, Record, lost, recovered
from ehbench.physics.flow_map import FlowMaps, load_flow_maps
from ehbench.plant.foreign import FmuModel
from ehbench.plant.ties import RECORDED, SUPPLY, TIED
from ehbench.preprocessing.plausibility import travels
from ehbench.preprocessing.preparation import distinct_names
from ehbench.preprocessing.time_base import parts_of
from ehbench.runs import rundir
from ehbench.stages.notes import Notes, line_naming
from ehbench.vocabulary import EhbenchError, InputError, message
from ehbench.vocabulary.errors import gathered, nearest, raise_all
from ehbench.vocabulary.fields import Value

NamedFiles = tuple[tuple[str, Path], ...]  # (role, file or run folder) of each input, in order


@dataclass(frozen=True)
class RigState:
    """A rig as a stage receives it: its numbers, its measured maps, the stage it has passed, the
    inputs that made it.

    ``without_maps`` are edges whose measured maps are missing, in a dry run only: orifices stand
    in."""

    rig: Rig
    flow_maps: FlowMaps | None
    stage: str
    inputs: NamedFiles
    origin: Path
    without_maps: tuple[str, ...] = ()

    def saved(self, name: str) -> dict[str, Any]:
        """A JSON result, by its name without ending, of the run that made it; empty without."""
        path = self.origin / f"{name}.json"
        return rundir.read_json(path) if path.is_file() else {}


@dataclass(frozen=True)
class ValidatedRig(RigState):
    """A rig that a validation accepted, or that the user insists on."""


class Logs(NamedTuple):
    """The logs of a recipe.

    Attributes:
        records: name and record of each.
        inputs: the file of each; one with a gap is that of several logs.
        losses: what was lost.
        remarks: what was interpolated, one for each.
        details: each gap and bad sample that was.
        entries: number of the recipe's entry of each.
        files: all files, with the maps of columns that they were read by."""

    records: list[tuple[str, Record]]
    inputs: NamedFiles
    losses: list[str]
    remarks: Sequence[str]
    details: Sequence[str]
    entries: list[int]
    files: NamedFiles


@dataclass(frozen=True)
class Inputs:
    """What the recipe at work takes in.

    Args:
        recipe: at work.
        notes: of its preparation.
        run_of: the run folder of a recipe file, which a run makes first; None where a dry run has
            none.
        check: the notes of a recipe file, in a dry run.
        allow_code: whether recipes may run Python code.
        unvalidated: whether a controller may be tuned on a rig that no validation accepted.
        ask: gets a token from a person before a machine moves, see `ehbench.links.arming`.
        live: see `ehbench.live.view.View`; None without a live view."""

    recipe: Recipe
    notes: Notes
    run_of: Callable[[Path], Path | None]
    check: Callable[[Path], Notes] | None = None
    allow_code: bool = False
    unvalidated: bool = False
    ask: Callable[[str, str], str] | None = None
    live: Callable[[str], bool] | None = None

    def existing(self, name: str) -> Path:
        """The file or folder that the recipe names.

        Raises:
            InputError: it is not there; names the nearest."""
        path = self.recipe.file(name)
        if path.exists():
            return path
        folder = path.parent
        known = [item.name for item in folder.iterdir()] if folder.is_dir() else []
        hint = nearest(path.name, known) or f"looked for {path}"
        text = message("stages.no_file", name=name)
        line = line_naming(self.recipe.path, text)
        raise InputError(text, file=self.recipe.path, line=line, hint=hint)

    def run_folder(self, path: Path) -> Path | None:
        """A run folder, or that of a recipe (None in a dry run without); other files as is."""
        is_recipe = path.is_file() and path.suffix == ".toml"
        return self.run_of(path) if is_recipe else path

    def rig_state(self, rig: str, flow_maps: str | None = None) -> RigState:
        """A rig with its maps: from a rig file, a run folder, or a recipe that makes one.

        Raises:
            InputError: it is not there, or has no maps."""
        path, maps_path, promised = self._rig_source(rig, flow_maps)
        facts = rundir.read_json(path / "run.json") if path.is_dir() else {"stage": "file"}
        judged = "validated" if facts.get("accepted") else "rejected"
        stage = str(facts["stage"])
        stage = {"identify": "identified", "validate": judged}.get(stage, stage)
        inputs, maps = [("rig", path)], maps_in(path)
        if maps_path is not None:
            inputs.append(("flow_maps", maps_path))
            maps = maps_in(maps_path)
            if maps is None:
                raise InputError(message("stages.no_maps"), file=maps_path)
        kind = ValidatedRig if promised or stage == "validated" else RigState
        loaded = load_rig(path)
        if loaded.model is not None:
            refuse_fmu(loaded, self.allow_code)
            self.notes.add("remarks", message("stages.fmu_is_code", fmu=loaded.model.fmu))
            self.notes.options.add("--allow-code")
            inputs.append(("fmu", loaded.model.place))
        state = kind(loaded, maps, stage, tuple(inputs), path)
        sources = [f"{self.notes.name_of(path)} (rig '{state.rig.name}', {stage})"]
        if maps_path is not None:
            sources.append(f"{self.notes.name_of(maps_path)} (flow maps)")
        self.notes.add("reads", *sources)
        if not self.notes.dry_run:
            return state
        whole, missing = with_orifices(state.rig, state.flow_maps)
        if missing:
            text = message("stages.without_maps", edges=", ".join(missing))
            self.notes.add("undecided", text)
        return replace(state, rig=whole, without_maps=missing)

    def _rig_source(self, rig: str, flow_maps: str | None) -> tuple[Path, Path | None, bool]:
        """(rig's place, maps' place, whether a validation yet to be run makes the rig)."""
        path, promised = self.existing(rig), False
        if path.is_file() and kind_of(path) == "recipe":
            folder = self.run_of(path)
            if folder is None:
                promised = isinstance(load_recipe(path), ValidateRecipe)
                path, inherited = self._root(rig, path)
                flow_maps = flow_maps or inherited
            else:
                path = folder
        if flow_maps is None:
            return path, None, promised
        source = self.existing(flow_maps)
        maps = self.run_folder(source)
        if maps is None:
            text = message("stages.maps_not_run", name=self.notes.name_of(source))
            self.notes.add("undecided", text)
        return path, maps, promised

    def _root(self, rig: str, path: Path) -> tuple[Path, str | None]:
        """(rig file or run folder, flow maps) at the root of a chain that has not been run."""
        upstream = load_recipe(path)
        name, maps = getattr(upstream, "rig", None), getattr(upstream, "flow_maps", None)
        if name is None or upstream.stage_name == "bench":
            raise InputError(message("stages.no_rig", name=rig), **self.recipe.at("rig"))
        notes = Notes(upstream, dry_run=True)
        inner = replace(self, recipe=upstream, notes=notes)
        root, maps_path, _ = inner._rig_source(name, maps)
        self.notes.add("undecided", *notes.undecided)
        if isinstance(upstream, FlowMapRecipe):
            self.notes.add("undecided", message("stages.maps_not_run", name=rig))
        text = message("stages.checked_against", name=rig, root=self.notes.name_of(root))
        self.notes.add("remarks", text)
        return root, None if maps_path is None else str(maps_path.absolute())

    def logs(self, data: Sequence[DataFile], rig: Rig, driven: bool = False) -> Logs:
        """The logs of some entries, each a file, or the recipe or run folder of a trial, recorded
        on ``rig``; one with gaps is several (`time_base.parts_of`), without those in which no
        command changes where logs are to be ``driven``.

        Raises:
            InputError: one is not there, or has no samples in its window."""
        present, available, errors = [], [], list[EhbenchError]()
        for index, item in enumerate(data):
            with gathered(errors):
                present.append((index, item, self.existing(item.path)))
        if not self.notes.dry_run:
            raise_all(errors)  # before a recipe is run
        for index, item, path in present:
            place = self.run_folder(path)
            if place is None:
                self.notes.add("undecided", message("stages.log_not_run", name=item.path))
            else:
                available.append((index, item, place))
        names = distinct_names([place for _, _, place in available])
        records, inputs, losses, remarks, details, entries = [], [], [], [], [], []
        files: list[tuple[str, Path]] = []
        maps: list[tuple[str, Path]] = []
        for (index, item, place), name in zip(available, names, strict=True):
            with gathered(errors):
                path = place / "log.mcap" if (place / "log.mcap").is_file() else place
                whole, others = self._read(item, index, path, path is not place, maps, rig)
                record = self._taken(whole, item, index, path, rig)
                scored = getattr(item, "scored", None)
                parts, texts = parts_of(name, record, driven=driven, within=scored)
                losses += [f"{path.name}: {loss}" for loss in lost(whole.losses)] + lost(texts)
                every = [*whole.losses, *texts]
                told = recovered(name, every)
                remarks += told
                details += [
                    f"{name}: {note}" for note in every if note not in [*lost(every), *told]
                ]
                records += [(part.name, part.record) for part in parts]
                inputs += [("log", path)] * len(parts)
                entries += [index] * len(parts)
                files += [("log", path), *(("log", other.path) for other in others)]
                text = message(
                    "stages.reads_log",
                    names=" and ".join([item.path, *(other.path for other in item.beside)]),
                    seconds=float(np.ptp(record.t)),
                    payload=record.meta.get("payload") or "not stated",
                )
                self.notes.add("reads", text, *(note for note in told if note.key == OVERRULED))
        raise_all(errors)
        self.notes.add("losses", *(f"lost: {loss}" for loss in losses))
        self.notes.add("remarks", *(text for text in remarks if text not in self.notes.reads))
        places = (*files, *maps)
        return Logs(records, tuple(inputs), losses, remarks, details, entries, places)

    def try_files(self, data: Sequence[DataFile]) -> None:
        """Read the files of some entries that were not tried yet, for the errors of those that
        cannot be read: what is left to check where there is no rig.

        Raises:
            InputError: one is not there, or cannot be read; with those of the others."""
        errors: list[EhbenchError] = []
        for index, item in enumerate(data):
            with gathered(errors):
                path = self.existing(item.path)
                if path.suffix != ".toml" and not path.is_dir() and path not in self.notes.tried:
                    self._read(item, index, path, False, [], None)
        raise_all(errors)

    def _read(
        self,
        item: DataFile,
        index: int,
        path: Path,
        is_run: bool,
        maps: list[tuple[str, Path]],
        rig: Rig | None,
    ) -> tuple[Record, list[AdditionalFile]]:
        """(the record of an entry, its additional files); maps of columns go into ``maps``."""
        self.notes.tried.add(path)
        columns = None if is_run else self.columns(item, index)
        ways = {} if rig is None else travels(rig)
        columns = columns and replace(columns, travels=ways)
        others = []
        for number, other in enumerate(item.beside):
            place = ("data", index, "beside", number, "columns")
            whole = None
            if other.columns is not None:
                whole = whole_map(other.columns, self.recipe.path, place)
                whole = replace(whole, travels=ways)
            shift = None if other.shift is None else float(other.shift)
            shared = other.clock == "shared"
            others.append(AdditionalFile(self.existing(other.path), whole, shift, shared))
        for entry in (columns, *(other.columns for other in others)):
            for file in () if entry is None else entry.files:
                maps += [("columns", file)] if ("columns", file) not in maps else []
        record = read(path, columns=columns, window=span_of(item), additional=others)
        return record, others

    def _taken(self, record: Record, item: DataFile, index: int, path: Path, rig: Rig) -> Record:
        """The part of a record that an entry names, with its payload and forces, and what a
        simulation takes from it, by the entry or the recipe."""
        forces = [f.channel for axis in rig.cylinder for f in axis.force if f.kind == "channel"]
        if unknown := sorted(set(item.force) - set(forces)):
            fields = {"channel": unknown[0], "known": ", ".join(map(str, forces)) or "none"}
            text = message("stages.no_force", rig=rig.name, **fields)
            raise InputError(text, **self.recipe.at("data", index))
        low, high = span_of(item)
        part = record.between(low, high)
        if part.t.size < 3 <= record.t.size:
            first, last = float(record.t[0]), float(record.t[-1])
            text = message("stages.empty_window", low=low, high=high, first=first, last=last)
            raise InputError(text, file=path)
        without = (TIED, SUPPLY, *(["payload_change"] if item.payload else []))
        facts = {name: fact for name, fact in record.meta.items() if name not in without}
        facts |= {"payload": item.payload} if item.payload else {}
        forced = {name: np.full(part.t.size, float(force)) for name, force in item.force.items()}
        channels = part.channels | forced
        for key, default in ((TIED, "none"), (SUPPLY, "model")):
            choice = getattr(item, key, None) or getattr(self.recipe, key, default)
            facts |= {} if choice == default else {key: choice}
        if facts.get(SUPPLY) == RECORDED and "p_supply" not in channels:
            text = message("stages.no_supply", name=item.path)
            raise InputError(text, **self.recipe.at("data", index))
        return replace(part, channels=channels, meta=facts)

    def columns(self, item: DataFile | None = None, index: int = 0) -> ColumnMap | None:
        """The map of columns of an entry of ``data``, else that of the recipe."""
        path = self.recipe.path
        if item is not None and item.columns is not None:
            return whole_map(item.columns, path, ("data", index, "columns"))
        columns = getattr(self.recipe, "columns", None)
        return None if columns is None else whole_map(columns, path, ("columns",))


def refuse_fmu(rig: Rig, allowed: bool) -> None:
    """Refuse a rig whose FMU may not run, or is not what its ``[model]`` says.

    Raises:
        InputError: says why."""
    if rig.model is None:
        return
    if not allowed:
        raise InputError(message("stages.fmu_not_allowed", fmu=rig.model.fmu))
    _ = FmuModel.of(rig).binding


def maps_in(folder: Path) -> FlowMaps | None:
    """The flow maps of a run folder, if it has any."""
    return load_flow_maps(folder) if (folder / "flow_maps.json").is_file() else None


def span_of(item: DataFile) -> tuple[float, float]:
    """The part of a log that an entry names [s]."""
    low = -math.inf if item.start is None else float(item.start)
    return low, math.inf if item.stop is None else float(item.stop)


def with_orifices(rig: Rig, maps: FlowMaps | None) -> tuple[Rig, tuple[str, ...]]:
    """(the rig with an orifice in place of each edge whose measured map is not given, the names of
    those edges).

    The orifice passes the pump's flow limit at full command and supply pressure; only its sign and
    place are of use."""
    known = set(maps or ())
    missing = sorted(
        f"{c.name}.{v.edge_name(e)}"
        for c, v, e in rig.edges()
        if e.law == "map" and not {f"{c.name}.{v.edge_name(e)}", v.edge_name(e)} & known
    )
    if not missing:
        return rig, ()

    def changed(cylinder: Cylinder, valve: Valve) -> Valve:
        full = valve.largest * math.sqrt(float(rig.supply.pressure))
        orifice = {"law": "orifice", "flow_gain": Value(float(rig.supply.flow_limit) / full)}
        edges = (
            e.model_copy(update=orifice)
            if f"{cylinder.name}.{valve.edge_name(e)}" in missing
            else e
            for e in valve.edge
        )
        return valve.model_copy(update={"edge": tuple(edges)})

    return rig.with_valves(changed), tuple(missing)
