"""Flow maps: maps, inverse maps, deadbands, calibration, readings left out."""

from __future__ import annotations

from collections.abc import Iterator

from ehbench.config.rig import Rig
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
from ehbench.report.words import DASH, count, interval, number, pretty, shown, unit_of, words
from ehbench.vocabulary.messages import message


def draw(run: Saved, index: FigureIndex) -> None:
    """A figure for each flow map, then one for each inverse map."""
    from ehbench.physics.flow_map import load_flow_maps

    page = Template("flow_maps")
    maps, points = load_flow_maps(run.folder), read_points(run.folder / "points.csv")

    def place(kind: str, title: str, caption: str, valve: str, direction: str):
        about = FigureKey(kind, valve=valve, direction=direction)
        key, title = f"{kind}_{valve}_{direction}", f"{title} of {valve}, {direction}"
        return index.add(key, title, page.text(caption), about)

    for item in maps.each():
        named = (item.valve, item.direction)
        path = place("flow_map", "Flow map", "level" if item.level else "map", *named)
        picture = figures.level_map if item.level else figures.flow_map
        picture(path, run.rig, item, points.of(*named))
    for item in maps.each():
        if not item.level:
            path = place("inverse_map", "Inverse map", "inverse", item.valve, item.direction)
            figures.inverse_map(path, run.rig, item)


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """Maps, inverse maps, deadbands, calibration, readings left out."""
    rig, maps, page = run.rig, run.rows("summary.json"), Template("flow_maps", run.rig)
    calibration = [(item, point) for item in maps for point in item["calibration"]]
    left_out = [(item, reading) for item in maps for reading in item["outliers"]]
    ways = [row for item in maps for row in _ways(rig, item)]

    def noise(item: Table) -> str:
        return "; ".join(
            f"{words(method)} {_in_unit(rig, 'flow', floor, 2)} {pretty(unit_of(rig, 'flow'))} "
            f"and {number(100 * share, 2)} %"
            for method, (floor, share) in item.get("noise", {}).items()
        )

    def drops(point: Table) -> str:
        ends = [_in_unit(rig, "pressure_drop", point[f"drop_{end}"]) for end in ("low", "high")]
        return " … ".join(dict.fromkeys(ends))

    parts = [
        Part("Flow maps", pictures(FigureKey("flow_map"))),
        Part("Inverse maps", pictures(FigureKey("inverse_map"))),
        Part("Deadbands", [page.table("deadbands", maps, noise=noise)]),
    ]
    if ways:
        parts.append(Part("Beyond the opening", [page.table("ways", ways)]))
    if calibration:
        table = page.table("calibration", calibration, drops=drops)
        parts.append(Part("Calibration", [table]))
    if left_out:
        parts.append(Part("Readings left out", [page.table("outliers", left_out)]))
    sentence = page.text(
        "sentence",
        maps=maps,
        valves={item["valve"] for item in maps},
        readings=sum(item["readings"] for item in maps) + len(left_out),
        left_out=len(left_out),
        verdicts=[point["verdict"] for _, point in calibration],
    )
    return SectionContent("done", sentence, parts)


def _ways(rig: Rig, item: Table) -> Iterator[tuple[Table, str, str, str]]:
    """(map, what, value, interval) of what a valve does besides opening smoothly: leak, hysteresis,
    kinks, a fall.
    """
    leak, ends = item.get("leakage"), item.get("leakage_interval", (0.0, 0.0))
    if ends[0] > 0.0:
        between = " … ".join(_in_unit(rig, "flow", end, 3) for end in ends)
        name = Template("flow_maps", rig).text("leak")
        yield item, name, _in_unit(rig, "flow", leak, 3), between
    if (lag := item.get("hysteresis")) is not None:
        yield item, "hysteresis [V]", number(lag, 3), interval(*item["hysteresis_interval"])
    for value, low, high in item.get("kinks", ()):
        yield item, "kink at [V]", number(value, 4), interval(low, high)
    if item.get("falls"):
        yield item, "falls from its largest flow [%]", number(100.0 * item["falls"], 2), DASH


def _in_unit(rig: Rig, name: str, value: float, digits: int = 4) -> str:
    """An SI number in the rig's unit."""
    return number(float(shown(rig, name, value)), digits)


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
