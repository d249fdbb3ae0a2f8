"""Flow maps: maps, inverse maps, deadbands, calibration, readings left out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ehbench.report.blocks import Part
from ehbench.report.content import (
    OFTEN,
    Findings,
    Headline,
    Pictures,
    SectionContent,
    StageReport,
    names,
)
from ehbench.report.figures import flow_maps as figures
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved, Table, read_points
from ehbench.report.template import Template
from ehbench.report.words import count
from ehbench.vocabulary.messages import message


def draw(run: Saved, index: FigureIndex) -> None:
    """A figure for each flow map, then one for each inverse map."""
    from ehbench.physics.flow_map import FlowMap, load_flow_maps

    page, points = Template("flow_maps"), read_points(run.folder / "points.csv")

    def place(kind: str, title: str, caption: str, item: FlowMap) -> Path:
        about = FigureKey(kind, valve=item.valve, direction=item.direction)
        key = f"{kind}_{item.valve}_{item.direction}"
        title = f"{title} of {item.valve}, {item.direction}"
        return index.add(key, title, page.text(caption), about)

    maps = [*load_flow_maps(run.folder).each()]
    for item in maps:
        path = place("flow_map", "Flow map", "level" if item.level else "map", item)
        picture = figures.level_map if item.level else figures.flow_map
        picture(path, run.rig, item, points.of(item.valve, item.direction))
    for item in maps:
        if not item.level:
            figures.inverse_map(place("inverse_map", "Inverse map", "inverse", item), run.rig, item)


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """Maps, inverse maps, deadbands, calibration, readings left out."""
    maps, page = run.rows("summary.json"), Template("flow_maps", run.rig)
    calibration = [(item, point) for item in maps for point in item["calibration"]]
    left_out = [(item, reading) for item in maps for reading in item["outliers"]]
    ways: list[tuple[Table, str, Any]] = []  # what a valve does besides opening smoothly
    for item in maps:
        if item.get("leakage_interval", (0.0, 0.0))[0] > 0.0:
            ways.append((item, "leak", [item["leakage"], *item["leakage_interval"]]))
        if item.get("hysteresis") is not None:
            ways.append((item, "hysteresis", [item["hysteresis"], *item["hysteresis_interval"]]))
        ways += [(item, "kink", kink) for kink in item.get("kinks", ())]
        ways += [(item, "falls", [falls]) for falls in [item.get("falls")] if falls]
    tables = {
        "Deadbands": page.table("deadbands", maps),
        "Beyond the opening": page.table("ways", ways),
        "Calibration": page.table("calibration", calibration),
        "Readings left out": page.table("outliers", left_out),
    }
    parts = [
        Part("Flow maps", pictures(FigureKey("flow_map"))),
        Part("Inverse maps", pictures(FigureKey("inverse_map"))),
        *(Part(title, [table]) for title, table in tables.items() if table.rows),
    ]
    sentence = page.text(
        "sentence",
        maps=maps,
        valves={item["valve"] for item in maps},
        readings=sum(item["readings"] for item in maps) + len(left_out),
        left_out=len(left_out),
        verdicts=[point["verdict"] for _, point in calibration],
    )
    return SectionContent("done", sentence, parts)


def findings(run: Saved) -> Findings:
    maps, page = run.rows("summary.json"), Template("headlines", run.rig)
    value, about = page.text("deadbands", maps=maps), count(len(maps), "flow map")
    missing = [
        page.text("calibration", item=item, point=point)
        for item in maps
        for point in item["calibration"]
        if point["verdict"] != "met"
    ]
    against = list(dict.fromkeys(missing))
    steps = [message("steps.calibrate", **names(run))] if against else []
    numbers = [Headline(OFTEN, "Deadbands", value, about)]
    return Findings(numbers, [FigureKey("flow_map")], against, steps)


REPORT = StageReport(
    "flow maps",
    section,
    draw,
    findings,
    standing=1,
    shows=("Deadbands",),
    numbers=("summary.json", ()),
)
