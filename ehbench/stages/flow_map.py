"""Flowmeter readings → flow maps: ``flow_maps.json``, ``summary.json``, ``points.csv`` and a table
over all maps.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ehbench import rundir
from ehbench.recipe import FlowMapRecipe
from ehbench.stages.base import Prepared, Progress, Stage, Work, write_rig
from ehbench.stages.inputs import Inputs, RigState

if TYPE_CHECKING:
    from ehbench.identification.readings import PreparedReadings


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
        from ehbench.identification.readings import prepare_readings
        from ehbench.logs.readings import mapped_readings
        from ehbench.readers import read_flowmeter

        findings = inputs.findings
        state = inputs.rig_state(recipe.rig)
        supply = float(state.rig.supply.pressure)
        parts, files, columns = [], [], inputs.columns()
        for name in recipe.data:
            with findings.noting():
                files.append(inputs.existing(name))
                lines = None if columns is None else mapped_readings(files[-1], columns)
                part = read_flowmeter(files[-1], supply_pressure=supply, lines=lines)
                parts.append(part)
                groups = ", ".join(" ".join(group) for group in part.groups())
                findings.say("reads", f"{name} ({len(part)} readings of {groups})")
                findings.notes += [str(text) for text in part.warnings]
        maps = () if columns is None else tuple(("columns", path) for path in columns.files)
        findings.say("open", "whether the readings carry a map")
        count = len({group for part in parts for group in part.groups()})
        return PreparedMaps(
            recipe,
            (*state.inputs, *(("data", path) for path in files), *maps),
            f"fits {count} flow map{'s' * (count != 1)} to {sum(map(len, parts))} readings",
            state,
            prepare_readings(state.rig, parts) if parts else None,
        )

    def work(self, prepared: PreparedMaps, folder: Path, progress: Progress | None) -> Work:
        from ehbench.identification import readings
        from ehbench.physics.flow_map import collect, save_flow_maps, table

        recipe, rig = prepared.recipe, prepared.state.rig
        assert prepared.readings is not None  # a run stops where a check has none
        drop = recipe.calibration_drop
        fits = readings.run_readings(
            prepared.readings,
            [(float(one.command), float(one.flow), one.tolerance) for one in recipe.calibration],
            None if drop is None else float(drop),
            progress,
            meter_limit=float(recipe.meter_limit),
        )
        maps = collect([one.fit.map for one in fits])
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
            f"{one.fit.map.valve} {one.fit.map.direction}: {text}"
            for one in fits
            for text in one.fit.warnings
        ]
        return Work({"rig": rig.name, "warnings": warnings})
