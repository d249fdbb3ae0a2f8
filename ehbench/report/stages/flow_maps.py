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
    for one in maps.each():
        path = index.add(
            f"flow_map_{one.valve}_{one.direction}",
            f"Flow map of {one.valve}, {one.direction}",
            _LEVEL_CAPTION if one.level else _MAP_CAPTION,
            FigureKey("flow_map", valve=one.valve, direction=one.direction),
        )
        picture = figures.level_map if one.level else figures.flow_map
        picture(path, run.rig, one, points.of(one.valve, one.direction))
    for one in maps.each():
        if one.level:
            continue
        path = index.add(
            f"inverse_map_{one.valve}_{one.direction}",
            f"Inverse map of {one.valve}, {one.direction}",
            _INVERSE_CAPTION,
            FigureKey("inverse_map", valve=one.valve, direction=one.direction),
        )
        figures.inverse_map(path, run.rig, one)


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """Maps, inverse maps, deadbands, calibration, readings left out."""
    rig, maps = run.rig, run.rows("summary.json")
    calibration = [
        _calibration_row(rig, one, point) for one in maps for point in one["calibration"]
    ]
    left_out = [_outlier_row(rig, one, reading) for one in maps for reading in one["outliers"]]
    parts = [
        Part("Flow maps", pictures(FigureKey("flow_map"))),
        Part("Inverse maps", pictures(FigureKey("inverse_map"))),
        Part("Deadbands", _deadbands(rig, maps)),
    ]
    ways = [row for one in maps for row in _way_rows(rig, one)]
    if ways:
        parts.append(Part("Beside the opening", [_ways(ways)]))
    if calibration:
        parts.append(Part("Calibration", [_calibration(rig, calibration)]))
    if left_out:
        parts.append(Part("Readings left out", [_left_out(rig, left_out)]))
    verdicts = [point["verdict"] for one in maps for point in one["calibration"]]
    return SectionContent("done", _sentence(maps, len(left_out), verdicts), parts)


def _sentence(maps: Sequence[Table], left_out: int, verdicts: Sequence[str]) -> str:
    readings = sum(one["readings"] for one in maps) + left_out
    valves = {one["valve"] for one in maps}
    sentence = (
        f"{count(len(maps), 'map')} of {count(len(valves), 'valve')} from {readings} readings, "
        f"{left_out} left out; deadbands {span([one['deadband'] for one in maps])} V"
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
    return [Grid(head, [_deadband_row(rig, one) for one in maps], note)]


def _deadband_row(rig: Rig, one: Table) -> list[Cell | str]:
    rms = one.get("rms")
    return [
        one["valve"],
        one["direction"],
        num(estimate(one.number("deadband"), *one["deadband_interval"])),
        num(interval(*one["deadband_interval"])),
        chip(one.get("status", "estimated")),
        num(number(one["readings"], 9)),
        num(str(len(one["outliers"]))),
        num(_flow(rig, rms, 2) if rms is not None else "–"),
        "; ".join(
            f"{words(method)} {_flow(rig, floor, 2)} {pretty(unit_of(rig, 'flow'))} "
            f"and {number(100 * share, 2)} %"
            for method, (floor, share) in one.get("noise", {}).items()
        ),
    ]


def _way_rows(rig: Rig, one: Table) -> Iterator[list[Cell | str]]:
    """Rows of what a valve does beside opening smoothly: leak, hysteresis, kinks, a fall."""

    def row(what: str, value: str, ends: str) -> list[Cell | str]:
        return [one["valve"], one["direction"], what, num(value), num(ends)]

    flow = pretty(unit_of(rig, "flow"))
    leak, ends = one.get("leakage"), one.get("leakage_interval", (0.0, 0.0))
    if ends[0] > 0.0:
        between = " … ".join(_flow(rig, end, 3) for end in ends)
        yield row(f"leak below the deadband [{flow}]", _flow(rig, leak, 3), between)
    if one.get("hysteresis") is not None:
        lag = one["hysteresis"]
        yield row("hysteresis [V]", number(lag, 3), interval(*one["hysteresis_interval"]))
    for value, low, high in one.get("kinks", ()):
        yield row("kink at [V]", number(value, 4), interval(low, high))
    if one.get("falls"):
        yield row("falls from its largest flow [%]", number(100.0 * one["falls"], 2), "–")


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


def _calibration_row(rig: Rig, one: Table, point: Table) -> list[Cell | str]:
    target = float(shown(rig, "flow", point["target"]))
    measured = point["verdict"] != "not_measured"
    return [
        one["valve"],
        one["direction"],
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


def _outlier_row(rig: Rig, one: Table, reading: Table) -> list[Cell | str]:
    file, line = reading["file"], reading["line"]
    return [
        Cell(f"{file}:{line}" if file else f"line {line}", "code"),
        one["valve"],
        one["direction"],
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
