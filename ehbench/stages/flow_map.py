"""Flowmeter readings → ``flow_maps.json``, ``summary.json``, ``points.csv``, a table."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ehbench.config.recipe import FlowMapRecipe
from ehbench.config.recipe.columns import LEAVE_OUT
from ehbench.config.rig import Rig
from ehbench.data.flowmeter import FlowmeterData, read_flowmeter
from ehbench.flow_maps import tables
from ehbench.flow_maps.readings import FlowMapOptions
from ehbench.flow_maps.step_readings import step_readings
from ehbench.physics.flow_map import collect, table
from ehbench.plant.model import Model
from ehbench.runs import rundir
from ehbench.runtime.disk import write_text
from ehbench.stages.base import DONE, INCOMPLETE, Prepared, Stage, Work, write_rig
from ehbench.stages.inputs import Inputs, Logs, RigState
from ehbench.vocabulary import InsufficientData, Progress, message, plural, setting
from ehbench.vocabulary.messages import of_log


@dataclass(frozen=True)
class MachineErrors:
    """Standard errors that all readings of a machine's logs share, where the recipe states none."""

    pressure: float = setting(
        1e-3, "", "zero of a pressure sensor, share of the supply pressure", "class 0.1 sensors"
    )
    command: float = setting(
        5e-4,
        "",
        "share of a valve's largest command",
        "half of the hysteresis is in it, since steps from rest only approach a command from below",
    )


ERRORS = MachineErrors()


@dataclass(frozen=True)
class PreparedMaps(Prepared):
    """Readings by edge, None where a dry run finds none that can be read; the logs that they are
    from, if any."""

    recipe: FlowMapRecipe
    state: RigState
    readings: tables.PreparedReadings | None
    logs: Logs | None


class FlowMapStage(Stage[FlowMapRecipe, PreparedMaps]):
    """`FlowMapRecipe`."""

    name = "flow_map"
    command = "identify"
    writes = "flow_maps.json, flow_maps.csv, summary.json, points.csv, rig.toml, figures"

    def prepare(self, recipe: FlowMapRecipe, inputs: Inputs) -> PreparedMaps:
        state, notes = inputs.rig_state(recipe.rig), inputs.notes
        from_logs, supply = recipe.method == "steps", float(state.rig.supply.pressure)
        parts, files, maps, lossy, logs = [], [*state.inputs], [], [], None
        if from_logs:
            logs, settle = inputs.logs(recipe.data, state.rig), float(recipe.settle)
            files, model = [*files, *logs.files], Model.of(state.rig)
            for name, record in logs.records:
                with notes.collected():
                    part = step_readings(name, record, model, settle, float(recipe.span))
                    parts.append(part)
                    _note_readings(name, part, inputs)
        for index, item in enumerate(() if from_logs else recipe.data):
            with notes.collected():
                columns = inputs.columns(item, index)
                files.append(("data", path := inputs.existing(item.path)))
                maps += [("columns", file) for file in (() if columns is None else columns.files)]
                leave_out = columns is not None and columns.columns.bad_samples == LEAVE_OUT
                lossy += [path.name] * leave_out
                part = read_flowmeter(path, columns, supply_pressure=supply, leave_out=leave_out)
                parts.append(part)
                _note_readings(item.path, part, inputs)
                notes.remarks += part.warnings
        notes.add("undecided", message("stages.map_supported"))
        does = message(
            "stages.does_flow_map",
            maps=plural(len({group for part in parts for group in part.groups()}), "flow map"),
            readings=sum(map(len, parts)),
            source=plural(len(recipe.data), "log" if from_logs else "file"),
        )
        readings = tables.prepare_readings(state.rig, parts, lossy) if parts else None
        if readings is not None and not from_logs:
            notes.add("losses", *(f"lost: {loss}" for loss in readings.losses))
        files = (*files, *dict.fromkeys(maps))
        return PreparedMaps(recipe, files, does, state, readings, logs)

    def work(self, prepared: PreparedMaps, folder: Path, progress: Progress | None) -> Work:
        recipe, rig = prepared.recipe, prepared.state.rig
        assert prepared.readings is not None  # a run has all its readings
        drop, fits, errors = recipe.calibration_drop, [], {}
        points = [(float(p.command), float(p.flow), p.tolerance) for p in recipe.calibration]
        options = FlowMapOptions(calibration=points)
        options = replace(options, reference_drop=None if drop is None else float(drop))
        edges = prepared.readings.edges
        for index, edge in enumerate(edges):
            if progress is not None:
                progress(f"{edge.edge} {edge.side}", index / len(edges))
            known = replace(options, **_errors_of(recipe, rig, edge.edge))
            try:
                fits.append(tables.fit_edge(rig, edge, known))
            except InsufficientData as error:
                errors[f"{edge.edge} {edge.side}"] = error
        without: list[str] = [
            message("stages.no_map", edge=name, reason=error.message)
            for name, error in errors.items()
        ]
        if not fits and len(errors) == 1:
            raise next(iter(errors.values()))
        if not fits:
            raise InsufficientData(message("stages.no_map_at_all", reasons="; ".join(without)))
        maps = collect([fit.map for fit in fits])
        rundir.write_json(folder / "summary.json", tables.summary(fits, rig))
        write_text(folder / "points.csv", tables.points_table(fits, rig))
        flow, drops = rig.unit_of("flow"), rig.unit_of("pressure_drop")
        write_text(folder / "flow_maps.csv", table(maps, tables.signs(fits), flow, drops))
        write_rig(folder, rig, maps)
        warnings = [
            of_log(f"{fit.map.valve} {fit.map.direction}", text)
            for fit in fits
            for text in fit.warnings
        ]
        losses, details, remarks = prepared.readings.losses, prepared.readings.details, ()
        if (logs := prepared.logs) is not None:
            losses, details = (*losses, *logs.losses), (*details, *logs.details)
            remarks = logs.remarks
        facts = {"rig": rig.name, "warnings": [*losses, *remarks, *warnings, *without]}
        facts |= {"details": details} if details else {}
        lost = losses or (without and recipe.method != "steps")
        return Work(facts, code=INCOMPLETE if lost else DONE)


def _errors_of(recipe: FlowMapRecipe, rig: Rig, edge: str) -> dict[str, Any]:
    """The limit of an edge's meter, and standard errors of its command and its drop."""
    limit, pressure, command = recipe.meter_limit, recipe.pressure_error, recipe.command_error
    if recipe.method == "steps":
        (valve,) = (
            valve
            for cylinder, valve in rig.valves()
            for name in map(valve.edge_name, valve.edge)
            if edge in (name, f"{cylinder.name}.{name}")
        )
        zero = ERRORS.pressure * float(rig.supply.pressure)
        limit, pressure = 0.0, zero if pressure is None else pressure
        command = ERRORS.command * valve.largest if command is None else command
    errors = {"meter_limit": float(limit), "command_std": float(command or 0.0)}
    return errors | {"drop_std": math.sqrt(2.0) * float(pressure or 0.0)}


def _note_readings(name: str, part: FlowmeterData, inputs: Inputs) -> None:
    groups = ", ".join(" ".join(group) for group in part.groups())
    text = message("stages.reads_flowmeter", name=name, count=len(part), groups=groups)
    inputs.notes.add("reads", text)
