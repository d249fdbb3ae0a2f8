"""Flow maps: maps, inverse maps, deadbands, calibration, readings left out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from ehbench.config.rig import Rig
from ehbench.report.blocks import Block, Cell, Grid, Part
from ehbench.report.captions import range_of, span
from ehbench.report.content import Pictures, SectionContent, StageReport, chip, num
from ehbench.report.figures import flow_maps as figures
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved, Table, read_points
from ehbench.report.words import (
    axis,
    count,
    estimate,
    interval,
    number,
    pretty,
    shown,
    unit_of,
    words,
)

_MAP_CAPTION = (
    "Flow over pressure drop, one curve a command; below, readings minus curves. "
    "Bands are 95 % intervals of the curves; between two measured drops they also hold a kink that "
    "may hide in the gap, and so widen where readings lie far apart for the bend of the curve. "
    "Dashed and pale where no readings surround the curve."
)
_LEVEL_CAPTION = (
    "Flow over command, from a cylinder's speed without pressures, with its 95 % band; the "
    "deadband's interval is grey. What flows at other loads than those measured this does not say."
)
_INVERSE_CAPTION = (
    "Command that passes a flow, one curve a pressure drop; "
    "the exact inverse of the flow map, with its 95 % band. The command axis begins at the "
    "deadband's interval (grey); dashed and pale beyond the readings."
)


def draw(run: Saved, index: FigureIndex) -> None:
    """A figure a flow map, then one an inverse map."""
    from ehbench.physics.flow_map import load_flow_maps

    maps, points = load_flow_maps(run.folder), read_points(run.folder / "points.csv")
    for item in maps.each():
        path = index.add(
            f"flow_map_{item.valve}_{item.direction}",
            f"Flow map of {item.valve}, {item.direction}",
            _LEVEL_CAPTION if item.level else _MAP_CAPTION,
            FigureKey("flow_map", valve=item.valve, direction=item.direction),
        )
        picture = figures.level_map if item.level else figures.flow_map
        picture(path, run.rig, item, points.of(item.valve, item.direction))
    for item in maps.each():
        if item.level:
            continue
        path = index.add(
            f"inverse_map_{item.valve}_{item.direction}",
            f"Inverse map of {item.valve}, {item.direction}",
            _INVERSE_CAPTION,
            FigureKey("inverse_map", valve=item.valve, direction=item.direction),
        )
        figures.inverse_map(path, run.rig, item)


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """Maps, inverse maps, deadbands, calibration, readings left out."""
    rig, maps = run.rig, run.rows("summary.json")
    calibration = [
        _calibration_row(rig, item, point) for item in maps for point in item["calibration"]
    ]
    left_out = [_outlier_row(rig, item, reading) for item in maps for reading in item["outliers"]]
    parts = [
        Part("Flow maps", pictures(FigureKey("flow_map"))),
        Part("Inverse maps", pictures(FigureKey("inverse_map"))),
        Part("Deadbands", _deadbands(rig, maps)),
    ]
    ways = [row for item in maps for row in _way_rows(rig, item)]
    if ways:
        parts.append(Part("Beside the opening", [_ways(ways)]))
    if calibration:
        parts.append(Part("Calibration", [_calibration(rig, calibration)]))
    if left_out:
        parts.append(Part("Readings left out", [_left_out(rig, left_out)]))
    verdicts = [point["verdict"] for item in maps for point in item["calibration"]]
    return SectionContent("done", _sentence(maps, len(left_out), verdicts), parts)


def _sentence(maps: Sequence[Table], left_out: int, verdicts: Sequence[str]) -> str:
    readings = sum(item["readings"] for item in maps) + left_out
    valves = {item["valve"] for item in maps}
    sentence = (
        f"{count(len(maps), 'map')} of {count(len(valves), 'valve')} from {readings} readings, "
        f"{left_out} left out; deadbands {span([item['deadband'] for item in maps])} V"
    )
    if verdicts:
        met = f"{verdicts.count('met')} of {count(len(verdicts), 'point')}"
        sentence += f"; calibration met at {met}"
    return sentence + "."


def _deadbands(rig: Rig, maps: Sequence[Table]) -> list[Block]:
    head = [
        "valve",
        "direction",
        "deadband [V]",
        "95 % interval [V]",
        "status",
        "readings used",
        "left out",
        f"rms residual [{pretty(unit_of(rig, 'flow'))}]",
        "noise of one reading",
    ]
    note = (
        "The interval also holds where a flow would start that grows softly, so that it reaches "
        "below the deadband; where it is lopsided, there is no ±."
    )
    return [Grid(head, [_deadband_row(rig, item) for item in maps], note)]


def _deadband_row(rig: Rig, item: Table) -> list[Cell | str]:
    rms = item.get("rms")
    return [
        item["valve"],
        item["direction"],
        num(estimate(item.number("deadband"), *item["deadband_interval"])),
        num(interval(*item["deadband_interval"])),
        chip(item.get("status", "estimated")),
        num(number(item["readings"], 9)),
        num(str(len(item["outliers"]))),
        num(_flow(rig, rms, 2) if rms is not None else "–"),
        "; ".join(
            f"{words(method)} {_flow(rig, floor, 2)} {pretty(unit_of(rig, 'flow'))} "
            f"and {number(100 * share, 2)} %"
            for method, (floor, share) in item.get("noise", {}).items()
        ),
    ]


def _way_rows(rig: Rig, item: Table) -> Iterator[list[Cell | str]]:
    """Rows of what a valve does beside opening smoothly: leak, hysteresis, kinks, a fall."""

    def row(what: str, value: str, ends: str) -> list[Cell | str]:
        return [item["valve"], item["direction"], what, num(value), num(ends)]

    flow = pretty(unit_of(rig, "flow"))
    leak, ends = item.get("leakage"), item.get("leakage_interval", (0.0, 0.0))
    if ends[0] > 0.0:
        between = " … ".join(_flow(rig, end, 3) for end in ends)
        yield row(f"leak below the deadband [{flow}]", _flow(rig, leak, 3), between)
    if item.get("hysteresis") is not None:
        lag = item["hysteresis"]
        yield row("hysteresis [V]", number(lag, 3), interval(*item["hysteresis_interval"]))
    for value, low, high in item.get("kinks", ()):
        yield row("kink at [V]", number(value, 4), interval(low, high))
    if item.get("falls"):
        yield row("falls from its largest flow [%]", number(100.0 * item["falls"], 2), "–")


def _ways(rows: Sequence[Sequence[Cell | str]]) -> Grid:
    note = (
        "Hysteresis: what rising commands lie above falling ones at the same flow; the map is the "
        "middle of both. A flow that falls is inverted on its rising branch."
    )
    return Grid(["valve", "direction", "what", "value", "95 % interval"], rows, note)


def _flow(rig: Rig, value: float, digits: int = 4) -> str:
    """A flow [m³/s] as a number in the rig's unit."""
    return number(float(shown(rig, "flow", value)), digits)


def _drop(rig: Rig, value: float) -> str:
    """A pressure drop [Pa] as a number in the rig's unit."""
    return number(float(shown(rig, "pressure_drop", value)))


def _calibration_row(rig: Rig, item: Table, point: Table) -> list[Cell | str]:
    target = float(shown(rig, "flow", point["target"]))
    measured = point["verdict"] != "not_measured"
    return [
        item["valve"],
        item["direction"],
        num(number(point["command"])),
        num(f"{number(target)} ± {number(target * point['tolerance'], 2)}"),
        num(_flow(rig, point["flow"], 3) if measured else "–"),
        num(range_of(rig, "flow", (point["low"], point["high"])) if measured else "–"),
        num(_drops(rig, point) if measured else "–"),
        chip(point["verdict"]),
    ]


def _drops(rig: Rig, point: Table) -> str:
    low, high = _drop(rig, point["drop_low"]), _drop(rig, point["drop_high"])
    return low if low == high else f"{low} … {high}"


def _calibration(rig: Rig, rows: Sequence[Sequence[Cell | str]]) -> Grid:
    unit = pretty(unit_of(rig, "flow"))
    head = [
        "valve",
        "direction",
        "command [V]",
        f"asked [{unit}]",
        f"gives [{unit}]",
        "95 % interval",
        axis(rig, "pressure_drop", "over drops"),
        "verdict",
    ]
    note = (
        "Met or missed: the whole interval lies inside or outside of what is asked; "
        "undecided: it straddles."
    )
    return Grid(head, rows, note)


def _outlier_row(rig: Rig, item: Table, reading: Table) -> list[Cell | str]:
    file, line = reading["file"], reading["line"]
    return [
        Cell(f"{file}:{line}" if file else f"line {line}", "code"),
        item["valve"],
        item["direction"],
        num(number(reading["command"])),
        num(_drop(rig, reading["pressure_drop"])),
        num(_flow(rig, reading["flow"])),
        num(f"{reading['sigmas']:+.1f}".replace("-", "−")),
    ]


def _left_out(rig: Rig, rows: Sequence[Sequence[Cell | str]]) -> Grid:
    head = [
        "reading",
        "valve",
        "direction",
        "command [V]",
        axis(rig, "pressure_drop"),
        axis(rig, "flow"),
        "sigmas from the map",
    ]
    return Grid(head, rows)


REPORT = StageReport(
    "flow maps", section, draw, standing=1, shows=("Deadbands",), numbers=("summary.json", ())
)
