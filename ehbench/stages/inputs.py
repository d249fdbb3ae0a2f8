"""What stages take in, by the names a recipe has for it: rigs with their maps, logs, runs of other
recipes.

In a run a recipe that another one names is run first. A check runs nothing: what has not been run
is stood in for by the rig file at the root of the chain, or left out, and that is said."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol

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
from ehbench.config.rig import Edge, Rig, Valve
from ehbench.runs import rundir
from ehbench.stages.findings import Findings
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.fields import Value

if TYPE_CHECKING:
    from ehbench.data.additional import AdditionalFile
    from ehbench.data.record import Record
    from ehbench.physics.flow_map import FlowMaps

NamedFiles = tuple[tuple[str, Path], ...]  # (role, file or run folder) of each input, in order


@dataclass(frozen=True)
class RigState:
    """A rig as a stage receives it: its numbers, its measured maps, how far it has come, and the
    inputs behind it.

    ``blind`` are edges whose measured maps are not there, in a check only: orifices stand in."""

    rig: Rig
    flow_maps: FlowMaps | None
    stage: str
    inputs: NamedFiles
    origin: Path
    blind: tuple[str, ...] = ()


@dataclass(frozen=True)
class ValidatedRig(RigState):
    """A rig that a validation accepted, or that the user insists on (`insisted`)."""

    @classmethod
    def insisted(cls, state: RigState) -> ValidatedRig:
        """A rig as it is because the user said ``--unvalidated``; its ``stage`` still tells."""
        return cls(**{name: getattr(state, name) for name in cls.__dataclass_fields__})


class Logs(NamedTuple):
    """Name and record of each log, the input behind each, what was lost, the number of the
    recipe's entry of each, the maps of columns that they were read by, and the inputs by entry,
    of which one with a gap is behind several logs.
    """

    records: list[tuple[str, Record]]
    inputs: NamedFiles
    losses: list[str]
    entries: list[int]
    maps: NamedFiles = ()
    files: NamedFiles = ()


class Runs(Protocol):
    """Where the runs of recipes come from that another recipe names."""

    def folder(self, path: Path, findings: Findings) -> Path | None:
        """The run folder of a recipe; None where a check finds none and says so in ``findings``."""
        ...

    def findings(self, path: Path) -> Findings | None:
        """What a check finds of a recipe; None in a run, which finds out when its turn comes."""
        ...


@dataclass(frozen=True)
class Inputs:
    """What the recipe at work takes in. ``allow_code`` and ``unvalidated`` are what the user
    allowed.
    """

    recipe: Recipe
    findings: Findings
    runs: Runs
    allow_code: bool = False
    unvalidated: bool = False

    def existing(self, name: str) -> Path:
        """The file or folder that the recipe names.

        Raises:
            InputError: it is not there; names the nearest.
        """
        path = self.recipe.file(name)
        if path.exists():
            return path
        folder = path.parent
        there = [p.name for p in folder.iterdir()] if folder.is_dir() else []
        near = get_close_matches(path.name, there, 1)
        raise InputError(
            f"names '{name}', which is not there",
            file=self.recipe.path,
            hint=f"did you mean '{near[0]}'?" if near else f"looked for {path}",
        )

    def run_folder(self, path: Path) -> Path | None:
        """A run folder, or that of a recipe; None where a check finds that it has not been run. A
        file that is no recipe stays as it is.
        """
        if path.is_file() and path.suffix == ".toml":
            return self.runs.folder(path, self.findings)
        return path

    def rig_state(self, rig: str, flow_maps: str | None = None) -> RigState:
        """A rig with its maps: from a rig file, a run folder, or a recipe that makes one.

        Raises:
            InputError: it is not there, or has no maps.
        """
        path, maps_path, promised = self._rig_source(rig, flow_maps)
        stage = _stage_of(path)
        inputs, maps = [("rig", path)], maps_in(path)
        if maps_path is not None:
            inputs.append(("flow_maps", maps_path))
            maps = maps_in(maps_path)
            if maps is None:
                raise InputError(
                    "holds no flow maps", file=maps_path, hint="name a run of what = 'flow_map'"
                )
        kind = ValidatedRig if promised or stage == "validated" else RigState
        state = kind(load_rig(path), maps, stage, tuple(inputs), path)
        sources = [f"{self.findings.shown(path)} (rig '{state.rig.name}', {stage})"]
        if maps_path is not None:
            sources.append(f"{self.findings.shown(maps_path)} (flow maps)")
        self.findings.say("reads", *sources)
        return self._with_stand_ins(state) if self.findings.collects else state

    def _with_stand_ins(self, state: RigState) -> RigState:
        rig, blind = with_laws(state.rig, state.flow_maps)
        if blind:
            self.findings.say(
                "open", f"what hangs on the flow maps of {', '.join(blind)}: none is given"
            )
        return replace(state, rig=rig, blind=blind)

    def _rig_source(self, rig: str, flow_maps: str | None) -> tuple[Path, Path | None, bool]:
        """(rig file or run folder, maps file or run folder, whether a validation that has not been
        run yet makes the rig) that a recipe has now.
        """
        path, promised = self.existing(rig), False
        if path.is_file() and kind_of(path) == "recipe":
            folder = self.runs.folder(path, self.findings)
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
            self.findings.say(
                "open",
                f"what hangs on the flow maps: '{self.findings.shown(source)}' has not been run",
            )
        return path, maps, promised

    def _root(self, rig: str, path: Path) -> tuple[Path, str | None]:
        """(rig file or run folder, flow maps) at the root of a chain that has not been run."""
        behind = load_recipe(path)
        name, maps = getattr(behind, "rig", None), getattr(behind, "flow_maps", None)
        if name is None or behind.stage_name == "bench":
            raise InputError(
                f"names '{rig}', which leaves no rig behind",
                **self.recipe.at("rig"),
                hint="name a rig file, or a recipe that has one",
            )
        inner = replace(self, recipe=behind, findings=Findings(behind, collects=True))
        root, maps_path, _ = inner._rig_source(name, maps)
        self.findings.say("open", *inner.findings.open)
        if isinstance(behind, FlowMapRecipe):
            self.findings.say("open", f"what hangs on the flow maps: '{rig}' has not been run")
        self.findings.say(
            "notes", f"'{rig}' has not been run: checked against {self.findings.shown(root)}"
        )
        return root, None if maps_path is None else str(maps_path)

    def logs(self, data: Sequence[DataFile], driven: bool = False) -> Logs:
        """Logs that are there, each a file, or the recipe or run folder of a trial; one with gaps
        is several (`gaps.parts_of`), of which those without a command that changes are left out
        where logs are to be ``driven``.

        Raises:
            InputError: one is not there, or has no samples in the window asked for.
        """
        import numpy as np

        from ehbench.data import read
        from ehbench.preprocessing.preparation import distinct_names
        from ehbench.preprocessing.time_base import parts_of

        items, places, entries = [], [], []
        for index, item in enumerate(data):
            place = self.run_folder(self.existing(item.path))
            if place is None:
                self.findings.say("open", f"the log of '{item.path}': it has not been run")
            else:
                items.append(item)
                places.append(place)
                entries.append(index)
        records, inputs, losses, maps, numbers = [], [], [], [], []
        files: list[tuple[str, Path]] = []
        named = zip(items, places, distinct_names(places), entries, strict=True)
        for item, place, name, index in named:
            is_run = (place / "log.mcap").is_file()
            path = place / "log.mcap" if is_run else place
            columns = None if is_run else self.columns(item, index)
            additional = self._additional(item, index)
            for entry in (columns, *(other.columns for other in additional)):
                used = () if entry is None else entry.files
                maps += [("columns", file) for file in used if ("columns", file) not in maps]
            whole = read(path, columns, window=_span(item), additional=additional)
            losses += [f"{path.name}: {loss}" for loss in whole.losses]
            record = self._tied(_window(whole, item, path), item, index)
            span = getattr(item, "scored", None)
            parts, message = parts_of(name, record, driven=driven, within=span)
            losses += message
            records += [(part.name, part.record) for part in parts]
            inputs += [("log", path)] * len(parts)
            files += [("log", path), *(("log", other.path) for other in additional)]
            numbers += [index] * len(parts)
            load = record.meta.get("payload") or "not said"
            also = "".join(f" and {other.path}" for other in item.beside)
            self.findings.say(
                "reads", f"{item.path}{also} ({np.ptp(record.t):.4g} s, payload {load})"
            )
        self.findings.say("losses", *(f"lost: {loss}" for loss in losses))
        return Logs(records, tuple(inputs), losses, numbers, tuple(maps), tuple(files))

    def _additional(self, item: DataFile, index: int) -> list[AdditionalFile]:
        """The additional files of a log, each with its map of columns."""
        from ehbench.data.additional import AdditionalFile

        results = []
        for at, other in enumerate(item.beside):
            columns = None
            if other.columns is not None:
                place = ("data", index, "beside", at, "columns")
                columns = whole_map(other.columns, self.recipe.path, place)
            shift = None if other.shift is None else float(other.shift)
            path = self.existing(other.path)
            results.append(AdditionalFile(path, columns, shift, other.clock == "shared"))
        return results

    def _tied(self, record: Record, item: DataFile, index: int) -> Record:
        """A record with what the simulation is tied to, as its entry or the recipe says."""
        from ehbench.plant.ties import RECORDED, SUPPLY, TIED

        facts = {name: fact for name, fact in record.meta.items() if name not in (TIED, SUPPLY)}
        for key, usual in ((TIED, "none"), (SUPPLY, "model")):
            message = getattr(item, key, None) or getattr(self.recipe, key, usual)
            facts |= {} if message == usual else {key: message}
        if facts.get(SUPPLY) == RECORDED and "p_supply" not in record:
            raise InputError(
                f'{item.path}: supply = "{RECORDED}", and the log has no p_supply',
                **self.recipe.at("data", index),
                hint='map a column to "p_supply [bar]", or leave the supply to the model',
            )
        return replace(record, meta=facts)

    def columns(self, item: DataFile | None = None, index: int = 0) -> ColumnMap | None:
        """The map of columns of an entry of ``data``, else that of the recipe."""
        path = self.recipe.path
        if item is not None and item.columns is not None:
            return whole_map(item.columns, path, ("data", index, "columns"))
        own = getattr(self.recipe, "columns", None)
        return None if own is None else whole_map(own, path, ("columns",))


def _stage_of(path: Path) -> str:
    """How far the rig of a file or run folder has come."""
    if not path.is_dir():
        return "file"
    facts = rundir.read_json(path / "run.json")
    if facts["stage"] == "validate" and not facts["accepted"]:
        return "rejected"
    return {"identify": "identified", "validate": "validated"}.get(
        facts["stage"], str(facts["stage"])
    )


def maps_in(folder: Path) -> FlowMaps | None:
    """The flow maps of a run folder, if it has any."""
    from ehbench.physics.flow_map import load_flow_maps

    return load_flow_maps(folder) if (folder / "flow_maps.json").is_file() else None


def _span(item: DataFile) -> tuple[float, float]:
    """The part of a log that an entry asks for [s]."""
    low = -math.inf if item.start is None else float(item.start)
    return low, math.inf if item.stop is None else float(item.stop)


def _window(record: Record, item: DataFile, path: Path) -> Record:
    """The part of a record between the data entry's start and stop, with the payload it names."""
    low, high = _span(item)
    keep = (record.t >= low) & (record.t <= high)
    if keep.sum() < 3 <= record.t.size:
        raise InputError(
            f"has no samples between {low:g} and {high:g} s",
            file=path,
            hint=f"it runs from {record.t[0]:g} to {record.t[-1]:g} s",
        )
    meta = dict(record.meta)
    if item.payload:
        meta.pop("payload_change", None)
        meta["payload"] = item.payload
    channels = {name: values[keep] for name, values in record.channels.items()}
    return type(record)(record.t[keep], channels, meta, record.attachments, record.losses)


def with_laws(rig: Rig, maps: FlowMaps | None) -> tuple[Rig, tuple[str, ...]]:
    """(the rig with an orifice in place of each edge whose measured map is not given, the names of
    those edges).

    The orifice passes the pump's flow limit at full command and supply pressure; only its sign and
    place are of use."""
    known = set(maps or ())
    blind = sorted(
        f"{c.name}.{v.edge_name(e)}"
        for c, v, e in rig.edges()
        if e.law == "map" and not {f"{c.name}.{v.edge_name(e)}", v.edge_name(e)} & known
    )

    def lawful(cylinder: str, valve: Valve, edge: Edge) -> Edge:
        if f"{cylinder}.{valve.edge_name(edge)}" not in blind:
            return edge
        maximum = max(abs(float(valve.command_min)), abs(float(valve.command_max)))
        gain = Value(
            float(rig.supply.flow_limit) / (maximum * math.sqrt(float(rig.supply.pressure)))
        )
        return edge.model_copy(update={"law": "orifice", "flow_gain": gain})

    if not blind:
        return rig, ()
    cylinders = []
    for c in rig.cylinder:
        valves = tuple(
            v.model_copy(update={"edge": tuple(lawful(c.name, v, e) for e in v.edge)})
            for v in c.valve
        )
        cylinders.append(c.model_copy(update={"valve": valves}))
    return rig.model_copy(update={"cylinder": tuple(cylinders)}), tuple(blind)
