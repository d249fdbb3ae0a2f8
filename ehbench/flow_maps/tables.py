"""Flowmeter readings of a rig's valves: which metering edge each one belongs to, the maps of all,
and what is saved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from ehbench.config.rig import Edge, Rig, Valve
from ehbench.data.flowmeter import FlowmeterData, LeftOut, merge_flowmeter
from ehbench.flow_maps.map import FlowMapFit, FlowMapOptions, Units, fit_flow_map
from ehbench.flow_maps.warmth import warm_flow, warmed
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.progress import Progress
from ehbench.vocabulary.quantities import VOCABULARY
from ehbench.vocabulary.units import from_si

# the largest flow of a valve as a share of what the supply can give: outside of these a unit is
# wrong
_FLOW_SHARES = 1e-3, 20.0
_OVERSHOOT = 0.01  # share of a driver's range that a command may lie outside of it


@dataclass(frozen=True)
class EdgeFit:
    """The fit of one edge in one direction, with the readings behind it.

    Commands in both are openings of the edge [V], zero or positive; the driver gets ``sign`` times
    them."""

    fit: FlowMapFit
    readings: FlowmeterData
    sign: int = 1


def fit_readings(
    rig: Rig,
    parts: Sequence[FlowmeterData],
    calibration: Sequence[tuple[float, float, float]] = (),
    reference_drop: float | None = None,
    progress: Progress | None = None,
    *,
    meter_limit: float = 0.0,
) -> list[EdgeFit]:
    """One flow map for each metering edge and direction that the readings name.

    Args:
        rig: its edges give the names and the signs; readings name an edge, or a valve with one
            edge, or a valve and a direction such as ``head->rod``. Commands of an edge of sign −1
            are negative, as sent to the driver.
        parts: readings of one or more files.
        calibration: (command [V], flow [m³/s], tolerance) to check on every map.
        reference_drop: [Pa] where the calibration is checked.
        progress: called with what is fitted and the share done.
        meter_limit: [m³/s] a flowmeter reading below it only says that the flow lies below it.

    Raises:
        InputError: readings of an edge that the rig does not have, or commands on the wrong side of
            zero.
        InsufficientData: too few readings for a map.
    """
    return run_readings(
        prepare_readings(rig, parts), calibration, reference_drop, progress, meter_limit=meter_limit
    )


@dataclass(frozen=True)
class EdgeReadings:
    """The readings of one edge in one direction, commands as openings, with doubts about them."""

    edge: str
    side: str
    sign: int
    rows: FlowmeterData
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True)
class PreparedReadings:
    """Readings by the edge they belong to, with a sentence on what was left out of each file."""

    rig: Rig
    edges: tuple[EdgeReadings, ...]
    losses: tuple[str, ...] = ()


def prepare_readings(
    rig: Rig, parts: Sequence[FlowmeterData], leave_out: bool = False
) -> PreparedReadings:
    """Sort readings to the rig's edges; arguments as in `fit_readings`, and ``leave_out``: a few
    readings at commands that do not open their edge, or that no driver gives, are left out.

    Raises:
        InputError: readings of an edge that the rig does not have, or commands on the wrong side of
            zero.
    """
    data = merge_flowmeter(parts)
    data = replace(
        data, file=np.array([Path(file).name for file in data.file])
    )  # results must not depend on where data lie
    doubts: dict[str, list[str]] = {}
    for part in parts:
        doubts.setdefault(Path(part.file[0]).name, []).extend(_file_doubts(part))
    groups: dict[tuple[str, str, int], list[FlowmeterData]] = {}
    losses = list(data.losses)
    for valve, direction in data.groups():
        rows = data.select(valve, direction)
        name, side, driver, edge = _edge_of(rig, valve, direction, rows)
        rows = _commanded(valve, rows, driver, edge, leave_out, losses)
        sign = edge.sign
        groups.setdefault((name, side, sign), []).append(
            replace(rows, command=sign * rows.command + 0.0)
        )
    edges = []
    for (name, side, sign), group in groups.items():
        rows = group[0] if len(group) == 1 else merge_flowmeter(group)
        messages = [
            text for file in np.unique(rows.file).tolist() for text in doubts.pop(file, ())
        ]  # of a file once
        show = Units(rig.unit_of("flow"), rig.unit_of("pressure_drop"), sign)
        messages += _flow_doubts(rig, rows, show)
        messages += warmed(rows, show, rig.unit_of("temperature"))
        edges.append(EdgeReadings(name, side, sign, rows, tuple(messages)))
    return PreparedReadings(rig, tuple(edges), tuple(losses))


def run_readings(
    prepared: PreparedReadings,
    calibration: Sequence[tuple[float, float, float]] = (),
    reference_drop: float | None = None,
    progress: Progress | None = None,
    *,
    meter_limit: float = 0.0,
    drop_std: float = 0.0,
    command_std: float = 0.0,
) -> list[EdgeFit]:
    """Fit a map to the readings of each edge; arguments as in `fit_readings`, and ``drop_std`` [Pa]
    and ``command_std`` [V], the standard errors that all drops and all commands share.

    Raises:
        InsufficientData: too few readings for a map.
    """
    rig, fits = prepared.rig, []
    for index, edge in enumerate(prepared.edges):
        if progress is not None:
            progress(f"{edge.edge} {edge.side}", index / len(prepared.edges))
        rows = edge.rows
        show = Units(rig.unit_of("flow"), rig.unit_of("pressure_drop"), edge.sign)
        options = FlowMapOptions(
            meter_limit=meter_limit,
            calibration=calibration,
            reference_drop=reference_drop,
            drop_std=drop_std,
            command_std=command_std,
            nominal_drop=float(rig.supply.pressure),
            show=show,
        )
        fit = fit_flow_map(edge.edge, edge.side, rows, options)
        fit = replace(fit, warnings=(*edge.doubts, *warm_flow(fit, rows), *fit.warnings))
        fits.append(EdgeFit(fit, rows, edge.sign))
    return fits


def _file_doubts(part: FlowmeterData) -> list[str]:
    """What the reader found odd in a file, and rows that stand in it twice."""
    name = Path(part.file[0]).name
    seen: set[tuple] = set()
    again = []
    columns = (
        part.valve,
        part.direction,
        part.method,
        part.trial,
        part.command,
        part.pressure_drop,
        part.flow,
    )
    for line, *row in zip(
        part.line.tolist(), *(column.tolist() for column in columns), strict=True
    ):
        if tuple(row) not in seen:
            seen.add(tuple(row))
        elif row[-1] != 0.0:  # a meter at rest reads zero again and again
            again.append(line)
    messages = [text.replace(str(part.file[0]), name) for text in part.warnings]
    if again:
        first = ", ".join(map(str, again[:5])) + (", …" if len(again) > 5 else "")
        count = f"{len(again)} rows repeat" if len(again) > 1 else "1 row repeats"
        messages.append(
            f"{name}: {count} an earlier one in command, drop, flow and trial (line {first}); if "
            "copied by mistake, "
            "delete them: they make the noise look smaller than it is"
        )
    return messages


def _flow_doubts(rig: Rig, rows: FlowmeterData, show: Units) -> list[str]:
    """Flows that a slip of unit would explain: far from what the supply can give."""
    limit, high = (
        float(rig.supply.flow_limit),
        float(np.quantile(rows.flow, 0.9)),
    )  # a slip of unit is in all rows
    maximum = float(rows.flow.max())
    if (
        not 0.0 < limit < np.inf
        or _FLOW_SHARES[0] * limit <= maximum
        and high <= _FLOW_SHARES[1] * limit
    ):
        return []
    times = f"{high / limit:.3g} times" if high > limit else f"{maximum / limit:.2g} of"
    maximum = high if high > limit else maximum
    return [
        f"the flows reach {show.flow(maximum)}, {times} the supply's limit of {show.flow(limit)}: "
        "check the unit in the header"
    ]


def _edge_of(
    rig: Rig, valve: str, direction: str, rows: FlowmeterData
) -> tuple[str, str, Valve, Edge]:
    """(name of the edge's map, forward or reverse, the valve, the edge) for readings of ``valve``
    in ``direction``.
    """
    where = {"file": str(rows.file[0]), "line": int(rows.line[0])}
    known: dict[str, list[tuple[str, Valve, Edge]]] = {}
    plain = [v.edge_name(e) for _, v, e in rig.edges()]
    for cylinder, item, edge in rig.edges():
        name = item.edge_name(edge)
        full = name if plain.count(name) == 1 else f"{cylinder.name}.{name}"
        for alias in {name, f"{cylinder.name}.{name}", item.name, f"{cylinder.name}.{item.name}"}:
            known.setdefault(alias, []).append((full, item, edge))
    if valve not in known:
        near = get_close_matches(valve, known, 1)
        hint = f"did you mean '{near[0]}'?" if near else "it has " + ", ".join(sorted(set(plain)))
        raise InputError(f"rig '{rig.name}' has no metering edge '{valve}'", hint=hint, **where)
    options = known[valve]
    side = direction
    if "->" in direction:
        upstream, downstream = (end.strip() for end in direction.split("->", 1))
        along = [
            option
            for option in options
            if (option[2].from_, option[2].to) == (upstream, downstream)
        ]
        against = [
            option
            for option in options
            if (option[2].to, option[2].from_) == (upstream, downstream)
        ]
        if not along and not against:
            there = ", ".join(f"{e.from_}->{e.to}" for _, _, e in options)
            raise InputError(f"'{valve}' has no edge {direction}", hint=f"it has {there}", **where)
        options, side = (along or against)[:1], "forward" if along else "reverse"
    if len(options) > 1:
        names = ", ".join(name for name, _, _ in options)
        raise InputError(
            f"'{valve}' has {len(options)} metering edges", hint=f"name one: {names}", **where
        )
    name, item, edge = options[0]
    return name, side, item, edge


def _commanded(
    valve: str,
    rows: FlowmeterData,
    driver: Valve,
    edge: Edge,
    leave_out: bool,
    losses: list[str],
) -> FlowmeterData:
    """The readings but for those at commands that do not open the edge, or that its driver does not
    give; these are refused, or left out where they are few and that is allowed.
    """
    low, high = float(driver.command_min), float(driver.command_max)
    slack = _OVERSHOOT * (high - low)
    opens = "negative" if edge.sign < 0 else "positive"
    doubts = (
        (
            edge.sign * rows.command < 0,
            f"'{valve}' opens on {opens} commands, and this reading has",
            f"the rig file says sign = {edge.sign} for this edge",
        ),
        (
            (rows.command < low - slack) | (rows.command > high + slack),
            f"the driver of '{valve}' gives {low:g} to {high:g} V, and this reading has",
            "check the unit, and command_min and command_max of the rig file",
        ),
    )
    left_out, keep = LeftOut(leave_out), np.ones(len(rows), bool)
    for wrong, message, hint in doubts:
        for at in np.flatnonzero(wrong & keep):
            where = {"file": str(rows.file[at]), "line": int(rows.line[at])}
            error = InputError(f"{message} {rows.command[at]:g} V", hint=hint, **where)
            left_out.take(valve, error)
            keep[at] = False
    losses += left_out.sentences([valve] * int(keep.sum()))
    return rows if keep.all() else rows.at(keep)


def signs(fits: Sequence[EdgeFit]) -> dict[tuple[str, str], int]:
    """Sign of the commands that open the edge, by name and direction of its map."""
    return {(fit.fit.map.valve, fit.fit.map.direction): fit.sign for fit in fits}


def summary(fits: Sequence[EdgeFit], rig: Rig) -> list[dict]:
    """What was found for each map, as plain values for a JSON file; SI, with the sentences people
    read.

    Commands and deadbands are openings [V], zero or positive, and the driver gets ``sign`` times
    them. The sentences speak of the driver's volts."""
    rows = []
    for fit in fits:
        show = Units(rig.unit_of("flow"), rig.unit_of("pressure_drop"), fit.sign)
        plain = fit.fit.to_dict() | {"sign": fit.sign}
        plain["outlier_sentences"] = [outlier.sentence(show) for outlier in fit.fit.outliers]
        plain["calibration_sentences"] = [check.sentence(show) for check in fit.fit.calibration]
        rows.append(plain)
    return rows


def points_table(fits: Sequence[EdgeFit], rig: Rig) -> str:
    """Every reading with its fitted flow as CSV text, in the units people see.

    ``command`` is the opening, zero or positive, which the maps take; ``driver_command`` is what
    was sent: sign·command."""
    flow_unit, drop_unit = rig.unit_of("flow"), rig.unit_of("pressure_drop")
    units = (
        f"command [V],driver_command [V],pressure_drop [{drop_unit}],flow [{flow_unit}],"
        f"fitted [{flow_unit}]"
    )
    lines = [f"valve,direction,{units},method,outlier,file,line"]
    flow_row, drop_row = VOCABULARY["flow"], VOCABULARY["pressure_drop"]
    for item in fits:
        rows, fit = item.readings, item.fit
        out = {(outlier.file, outlier.line) for outlier in fit.outliers}
        drop = np.where(np.isnan(rows.pressure_drop), fit.map.drop_max, rows.pressure_drop)
        fitted = _fitted(fit, rows, drop)
        for i in range(len(rows)):
            cells = (
                fit.map.valve,
                fit.map.direction,
                f"{rows.command[i]:.6g}",
                f"{item.sign * rows.command[i] + 0.0:.6g}",
                f"{from_si(drop[i], drop_unit, drop_row):.6g}",
                f"{from_si(rows.flow[i], flow_unit, flow_row):.6g}",
                f"{from_si(fitted[i], flow_unit, flow_row):.6g}",
                str(rows.method[i]),
                str(int((str(rows.file[i]), int(rows.line[i])) in out)),
                str(rows.file[i]),
                str(rows.line[i]),
            )
            lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


def _fitted(fit: FlowMapFit, rows: FlowmeterData, drop: np.ndarray) -> np.ndarray:
    """What the fit makes of each reading [m³/s]: the map, on the side of the hysteresis from which
    the command came.
    """
    level = np.asarray(fit.map.flow(drop, rows.command))
    own = rows.flow - fit.residuals
    # a residual of zero is of a reading too small for its meter
    aside = (fit.residuals != 0.0) & (np.abs(own - level) > 1e-6 * fit.map.rated_flow)
    return np.where(np.isfinite(own) & aside, own, level)
