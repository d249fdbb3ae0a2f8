"""Flowmeter readings → flow maps: ``flow_maps.json``, ``summary.json``, ``points.csv`` and a table
over all maps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ehbench.config.recipe import FlowMapRecipe
from ehbench.config.recipe.columns import LEAVE_OUT
from ehbench.runs import rundir
from ehbench.stages.base import DONE, INCOMPLETE, Prepared, Stage, Work, write_rig
from ehbench.stages.findings import counted
from ehbench.stages.inputs import Inputs, RigState
from ehbench.vocabulary.errors import InsufficientData
from ehbench.vocabulary.progress import Progress

if TYPE_CHECKING:
    from ehbench.config.rig import Rig
    from ehbench.flow_maps.tables import EdgeFit, PreparedReadings

# share of the supply's pressure by which the zero of a sensor of that range is off (standard error)
SENSOR_ERROR = 1e-3
# share of a valve's largest command likewise: steps from rest only come up to a command, so that
# half of the hysteresis is in it
COMMAND_ERROR = 5e-4


@dataclass(frozen=True)
class PreparedMaps(Prepared):
    """Readings by edge; None where a check finds none that can be read."""

    recipe: FlowMapRecipe
    state: RigState
    readings: PreparedReadings | None


class FlowMapStage(Stage[FlowMapRecipe, PreparedMaps]):
    """`FlowMapRecipe`."""

    recipe = FlowMapRecipe
    name = "flow_map"
    command = "identify"
    writes = "flow_maps.json, flow_maps.csv, summary.json, points.csv, rig.toml, figures"

    def prepare(self, recipe: FlowMapRecipe, inputs: Inputs) -> PreparedMaps:
        from ehbench.data.flowmeter import read_flowmeter
        from ehbench.flow_maps.tables import prepare_readings

        findings = inputs.findings
        state = inputs.rig_state(recipe.rig)
        if recipe.method == "steps":
            return _from_logs(recipe, inputs, state)
        supply = float(state.rig.supply.pressure)
        parts, files, columns = [], [], inputs.columns()
        leave_out = columns is not None and columns.columns.bad_samples == LEAVE_OUT
        for name in recipe.data:
            with findings.noting():
                files.append(inputs.existing(name))
                part = read_flowmeter(
                    files[-1], columns, supply_pressure=supply, leave_out=leave_out
                )
                parts.append(part)
                groups = ", ".join(" ".join(group) for group in part.groups())
                findings.say("reads", f"{name} ({len(part)} readings of {groups})")
                findings.notes += [str(text) for text in part.warnings]
        maps = () if columns is None else tuple(("columns", path) for path in columns.files)
        findings.say("open", "whether the readings carry a map")
        count = len({group for part in parts for group in part.groups()})
        readings = prepare_readings(state.rig, parts, leave_out) if parts else None
        if readings is not None:
            findings.say("losses", *(f"lost: {loss}" for loss in readings.losses))
        return PreparedMaps(
            recipe,
            (*state.inputs, *(("data", path) for path in files), *maps),
            f"fits {count} flow map{'s' * (count != 1)} to {sum(map(len, parts))} readings",
            state,
            readings,
        )

    def work(self, prepared: PreparedMaps, folder: Path, progress: Progress | None) -> Work:
        from ehbench.flow_maps import tables as readings
        from ehbench.physics.flow_map import collect, save_flow_maps, table

        recipe, rig = prepared.recipe, prepared.state.rig
        assert prepared.readings is not None  # a run stops where a check has none
        drop = recipe.calibration_drop
        given = (
            [
                (float(item.command), float(item.flow), item.tolerance)
                for item in recipe.calibration
            ],
            None if drop is None else float(drop),
            progress,
        )
        limit = float(recipe.meter_limit)
        fits, without = [], []
        if recipe.method == "steps":
            fits, without = _of_some(prepared.readings, given, recipe)
        else:
            fits = readings.run_readings(prepared.readings, *given, meter_limit=limit)
        maps = collect([fit.fit.map for fit in fits])
        save_flow_maps(maps, folder / "flow_maps.json")
        rundir.write_json(folder / "summary.json", readings.summary(fits, rig))
        (folder / "points.csv").write_text(readings.points_table(fits, rig), encoding="utf-8")
        text = table(
            maps,
            flow_unit=rig.unit_of("flow"),
            pressure_unit=rig.unit_of("pressure_drop"),
            signs=readings.signs(fits),
        )
        (folder / "flow_maps.csv").write_text(text, encoding="utf-8")
        write_rig(folder, rig, None)
        warnings = [
            f"{fit.fit.map.valve} {fit.fit.map.direction}: {text}"
            for fit in fits
            for text in fit.fit.warnings
        ]
        losses = prepared.readings.losses
        facts = {"rig": rig.name, "warnings": [*losses, *warnings, *without]}
        return Work(facts, code=INCOMPLETE if losses else DONE)


def _shared(recipe: FlowMapRecipe, rig: Rig, edge: str) -> dict[str, float]:
    """Standard errors that all readings of a machine's logs share: of the difference of two
    pressure sensors [Pa], and of the command [V] of the valve of an edge.
    """
    pressure, volts = recipe.pressure_error, recipe.command_error
    zero = SENSOR_ERROR * float(rig.supply.pressure) if pressure is None else float(pressure)
    (valve,) = (
        valve
        for cylinder, valve in rig.valves()
        for name in map(valve.edge_name, valve.edge)
        if edge in (name, f"{cylinder.name}.{name}")
    )
    maximum = max(abs(float(valve.command_min)), abs(float(valve.command_max)))
    command = COMMAND_ERROR * maximum if volts is None else float(volts)
    return {"drop_std": math.sqrt(2.0) * zero, "command_std": command}


def _of_some(
    prepared: PreparedReadings, given: tuple[Any, ...], recipe: FlowMapRecipe
) -> tuple[list[EdgeFit], list[str]]:
    """(maps of the edges that logs tell enough of, a sentence for each of the others): a log steps
    what it steps, and nobody asked for a map of each edge.

    Raises:
        InsufficientData: no edge has a map.
    """
    from ehbench.flow_maps.tables import run_readings

    fits, without = [], []
    for edge in prepared.edges:
        try:
            shared = _shared(recipe, prepared.rig, edge.edge)
            fits += run_readings(replace(prepared, edges=(edge,)), *given, **shared)
        except InsufficientData as error:
            without.append(f"no map of {edge.edge} {edge.side}: {error.message}")
    if not fits:
        raise InsufficientData("; ".join(without), hint="step each edge at 4 commands or more")
    return fits, without


def _from_logs(recipe: FlowMapRecipe, inputs: Inputs, state: RigState) -> PreparedMaps:
    """Readings that step logs give."""
    from ehbench.config.recipe.base import DataFile
    from ehbench.flow_maps.step_readings import step_readings
    from ehbench.flow_maps.tables import prepare_readings
    from ehbench.plant.model import Model

    findings = inputs.findings
    logs = inputs.logs([DataFile(path=name) for name in recipe.data])
    model, parts = Model.of(state.rig), []
    for name, record in logs.records:
        with findings.noting():
            part = step_readings(name, record, model, float(recipe.settle), float(recipe.span))
            parts.append(part)
            groups = ", ".join(" ".join(group) for group in part.groups())
            findings.say("reads", f"{name} ({len(part)} readings of {groups})")
    findings.say("open", "whether the readings carry a map")
    count = len({group for part in parts for group in part.groups()})
    does = f"fits {count} flow map{'s' * (count != 1)} to {sum(map(len, parts))} readings"
    return PreparedMaps(
        recipe,
        (*state.inputs, *logs.files, *logs.maps),
        f"{does} that {counted(recipe.data, 'log')} give",
        state,
        prepare_readings(state.rig, parts) if parts else None,
    )
