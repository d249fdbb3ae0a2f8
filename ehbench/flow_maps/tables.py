"""Flowmeter readings by metering edge, the maps of all, and what is saved."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ehbench.config.rig import Edge, Rig, Valve
from ehbench.data.flowmeter import FlowmeterData, LeftOut, merge_flowmeter
from ehbench.flow_maps.readings import SETTINGS as READING
from ehbench.flow_maps.readings import FlowMapOptions, Units
from ehbench.flow_maps.results import FlowMapFit, fit_flow_map
from ehbench.vocabulary import VOCABULARY, Z95, InputError, Message, from_si, message, setting
from ehbench.vocabulary.errors import nearest


@dataclass(frozen=True)
class TableSettings:
    """Numbers by which a table of readings is checked."""

    of_gain: float = setting(
        3.0, "", "flow over what the gain gives", "bar for psi: 3.8 in the flow"
    )
    large_flow: float = setting(20.0, "", "flow over the supply's limit", "units differ by 60")
    overshoot: float = setting(0.01, "", "commands beyond a driver's range, of it", "converters")
    warm_readings: int = setting(8, "", "smallest number with a temperature", "a slope")
    warming: float = setting(3.0, "K", "smallest change of temperature", "2 % of viscosity")
    correlation: float = setting(0.6, "", "temperature with drop or command", "not by chance")
    warm_flow: float = setting(0.1, "", "smallest flow that counts, of the rated", "its noise")
    warm_sigmas: float = setting(4.0, "", "standard errors of a change with temperature", "chance")
    warm_change: float = setting(0.01, "", "change of flow that matters", "a map's accuracy")


SETTINGS = TableSettings()


@dataclass(frozen=True)
class EdgeReadings:
    """The readings of one edge in one direction, commands as openings, with notes on them."""

    edge: str
    side: str
    sign: int
    rows: FlowmeterData
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class PreparedReadings:
    """Readings by the edge they belong to, with a message on what was left out of each file, and
    ``details`` of it."""

    edges: tuple[EdgeReadings, ...]
    losses: tuple[str, ...] = ()
    details: tuple[str, ...] = ()


def prepare_readings(
    rig: Rig, parts: Sequence[FlowmeterData], leave_out: Collection[str] = ()
) -> PreparedReadings:
    """Sort readings to the rig's edges.

    Args:
        rig: its edges give the names and the signs; readings name an edge, or a valve with one
            edge, or a valve and a direction such as ``head->rod``. Commands of an edge of sign −1
            are negative, as sent to the driver.
        parts: readings of one or more files.
        leave_out: names of files of which to leave out a few readings at commands that do not open
            their edge, or that no driver gives.

    Raises:
        InputError: readings of an edge that the rig does not have, or commands on the wrong side of
            zero.
    """
    data = merge_flowmeter(parts)
    # results must not depend on where data lie
    data = replace(data, file=np.array([Path(file).name for file in data.file]))
    notes: dict[str, list[str]] = {}
    for part in parts:
        notes.setdefault(Path(part.file[0]).name, []).extend(_file_notes(part))
    groups: dict[tuple[str, str, int], list[FlowmeterData]] = {}
    laws: dict[str, Edge] = {}
    losses, details = list(data.losses), list(data.details)
    for valve, direction in data.groups():
        rows = data.select(valve, direction)
        name, side, driver, edge = _edge_of(rig, valve, direction, rows)
        left_out = LeftOut(leave_out)
        rows = _commanded(valve, rows, driver, edge, left_out)
        losses += left_out.sentences([valve] * len(rows))
        details += left_out.details
        opened = replace(rows, command=np.maximum(edge.sign * rows.command, 0.0))
        groups.setdefault((name, side, edge.sign), []).append(opened)
        laws[name] = edge
    edges, limit = [], float(rig.supply.flow_limit)
    for (name, side, sign), group in groups.items():
        rows = merge_flowmeter(group)
        # of a file once
        items = [item for file in np.unique(rows.file).tolist() for item in notes.pop(file, ())]
        show = _units(rig, sign)
        # a slip of unit is in all rows: far from what the supply can give, or from the law
        flow, ratio = float(np.quantile(rows.flow, 0.9)), gain_ratio(laws[name], rows)
        if flow > SETTINGS.large_flow * limit > 0.0:
            fields = {"flow": show.flow(flow), "ratio": flow / limit, "limit": show.flow(limit)}
            items.append(message("flow_maps.flow_and_supply", **fields))
        elif abs(np.log(ratio)) > np.log(SETTINGS.of_gain):
            items.append(message("flow_maps.flow_and_gain", ratio=ratio))
        items += _warming(rows, show, rig.unit_of("temperature"))
        edges.append(EdgeReadings(name, side, sign, rows, tuple(items)))
    return PreparedReadings(tuple(edges), tuple(losses), tuple(details))


def gain_ratio(edge: Edge, rows: FlowmeterData) -> float:
    """Flow of the readings over what the edge's gain in the rig file gives; 1 without a gain."""
    widths = np.maximum(rows.command - float(edge.deadband), 0.0)
    gain = edge.compensated_gain
    if edge.flow_gain is not None:
        gain, widths = edge.flow_gain, widths * np.sqrt(np.maximum(rows.pressure_drop, 0.0))
    open_ = (widths > 0.0) & (rows.flow > 0.0)
    if gain is None or not open_.any():
        return 1.0
    return float(np.median(rows.flow[open_] / widths[open_])) / float(gain)


def _units(rig: Rig, sign: int) -> Units:
    return Units(rig.unit_of("flow"), rig.unit_of("pressure_drop"), sign)


def fit_edge(
    rig: Rig,
    edge: EdgeReadings,
    options: FlowMapOptions = FlowMapOptions(),  # noqa: B008
) -> FlowMapFit:
    """The map of the readings of an edge.

    Args:
        options: the nominal drop and the units of messages are the rig's.

    Raises:
        InsufficientData: too few readings for a map.
    """
    show = _units(rig, edge.sign)
    given = replace(options, nominal_drop=float(rig.supply.pressure), show=show)
    fit = fit_flow_map(edge.edge, edge.side, edge.rows, given)
    warnings = (*edge.notes, *_warm_flow(fit, edge.rows), *fit.warnings)
    return replace(fit, warnings=warnings, rows=edge.rows, sign=edge.sign)


def _file_notes(part: FlowmeterData) -> Iterator[str]:
    """What the reader noted of a file, and rows that stand in it twice."""
    name = Path(part.file[0]).name
    yield from (text.replace(str(part.file[0]), name) for text in part.warnings)
    columns = part.valve, part.direction, part.method, part.trial, part.command, part.pressure_drop
    seen: set[tuple] = set()
    again = []
    for line, *row in zip(part.line, *columns, part.flow, strict=True):
        if tuple(row) not in seen:
            seen.add(tuple(row))
        elif row[-1] != 0.0:  # a meter at rest reads zero again and again
            again.append(line)
    if again:
        lines = ", ".join(map(str, again[:5])) + (", …" if len(again) > 5 else "")
        yield message("flow_maps.repeated_rows", file=name, count=len(again), lines=lines)


def _edge_of(
    rig: Rig, valve: str, direction: str, rows: FlowmeterData
) -> tuple[str, str, Valve, Edge]:
    """(name of the map, forward or reverse, valve, edge) of readings."""
    where = {"file": str(rows.file[0]), "line": int(rows.line[0])}
    known: dict[str, list[tuple[str, Valve, Edge]]] = {}
    plain = [v.edge_name(e) for _, v, e in rig.edges()]
    for cylinder, item, edge in rig.edges():
        name = item.edge_name(edge)
        full = name if plain.count(name) == 1 else f"{cylinder.name}.{name}"
        for alias in {name, f"{cylinder.name}.{name}", item.name, f"{cylinder.name}.{item.name}"}:
            known.setdefault(alias, []).append((full, item, edge))
    if valve not in known:  # a file's name may be in capitals
        valve = next((name for name in known if name.lower() == valve.lower()), valve)
    if valve not in known:
        there = ", ".join(sorted(set(plain)))
        text = message("flow_maps.unknown_edge", rig=rig.name, valve=valve, there=there)
        raise InputError(text, **where, hint=nearest(valve, known))
    options, side = known[valve], direction
    if "->" in direction:
        ends = tuple(end.strip() for end in direction.split("->", 1))
        along = [option for option in options if (option[2].from_, option[2].to) == ends]
        against = [option for option in options if (option[2].to, option[2].from_) == ends]
        if not along and not against:
            there = ", ".join(f"{e.from_}->{e.to}" for _, _, e in options)
            text = message("flow_maps.unknown_direction", valve=valve, way=direction, there=there)
            raise InputError(text, **where)
        options, side = (along or against)[:1], "forward" if along else "reverse"
    if len(options) > 1:
        there, count = ", ".join(name for name, _, _ in options), len(options)
        text = message("flow_maps.several_edges", valve=valve, count=count, there=there)
        raise InputError(text, **where)
    name, item, edge = options[0]
    return name, side, item, edge


def _commanded(
    valve: str,
    rows: FlowmeterData,
    driver: Valve,
    edge: Edge,
    left_out: LeftOut,
) -> FlowmeterData:
    """The readings at commands that open the edge and that its driver gives; others are refused, or
    left out where they are few and that is allowed."""
    low, high = float(driver.command_min), float(driver.command_max)
    slack, command = SETTINGS.overshoot * (high - low), rows.command
    noise = SETTINGS.overshoot * driver.largest  # of a command of none that is measured
    checks = {
        "flow_maps.wrong_sign": edge.sign * command < -noise,
        "flow_maps.outside_driver": (command < low - slack) | (command > high + slack),
    }
    fields = {"valve": valve, "low": low, "high": high, "number": edge.sign}
    fields["sign"] = "negative" if edge.sign < 0 else "positive"
    keep = np.ones(len(rows), bool)
    for key, wrong in checks.items():
        for at in np.flatnonzero(wrong & keep):
            text = message(key, command=command[at], **fields)
            left_out.take(valve, InputError(text, file=str(rows.file[at]), line=int(rows.line[at])))
            keep[at] = False
    return rows if keep.all() else rows.at(keep)


def _warming(rows: FlowmeterData, show: Units, unit: str) -> Iterator[Message]:
    """A message for the drop and for the command where the temperature goes with it: no fit can
    separate what each does to the flow.

    Args:
        rows: readings of one edge in one direction.
        show: units of the messages.
        unit: in which temperatures are shown.
    """
    known = np.isfinite(rows.temperature) & (rows.pressure_drop > 0.0)
    if known.sum() < SETTINGS.warm_readings:
        return
    warm = rows.temperature[known]
    drop, command = rows.pressure_drop[known], rows.command[known]
    # an orifice, and so what heats the oil, goes with the root of the drop
    for key, values, shown in (
        ("flow_maps.warm_with_drop", np.sqrt(drop), [show.drop(f(drop)) for f in (min, max)]),
        ("flow_maps.warm_with_command", command, [show.volts(f(command)) for f in (min, max)]),
    ):
        if not (np.ptp(values) > 0.0 and np.ptp(warm) > 0.0):
            continue
        correlation = float(np.corrcoef(values, warm)[0, 1])
        ends = np.polyval(np.polyfit(values, warm, 1), [values.min(), values.max()])
        if abs(correlation) > SETTINGS.correlation and np.ptp(ends) > SETTINGS.warming:
            cold, hot = (
                f"{from_si(end, unit, VOCABULARY['temperature']):.3g} {unit}" for end in ends
            )
            low, high = shown
            yield message(key, correlation=correlation, cold=cold, low=low, warm=hot, high=high)


def _warm_flow(fit: FlowMapFit, rows: FlowmeterData) -> Iterator[Message]:
    """A message where a map's residuals go with the temperature: the map is of the mean one."""
    used = (
        np.isfinite(rows.temperature)
        & np.isfinite(fit.residuals)
        & (np.abs(fit.sigmas) < READING.outlier)
    )
    used &= rows.flow > SETTINGS.warm_flow * fit.map.rated_flow
    count = int(used.sum())
    if count < SETTINGS.warm_readings or np.ptp(rows.temperature[used]) < SETTINGS.warming:
        return
    warm = rows.temperature[used] - rows.temperature[used].mean()
    share = fit.residuals[used] / (rows.flow - fit.residuals)[used]
    slope, level = np.polyfit(warm, share, 1)
    residual = share - level - slope * warm
    std = float(np.sqrt(np.sum(residual**2) / (count - 2) / np.sum(warm**2)))
    change = abs(slope) * np.ptp(warm)
    if abs(slope) > SETTINGS.warm_sigmas * std and change > SETTINGS.warm_change:
        percent = 1000.0  # for 10 K
        half = percent * Z95 * std
        yield message("flow_maps.warm_flow", share=percent * slope, half=half, kelvin=10.0)


def signs(fits: Sequence[FlowMapFit]) -> dict[tuple[str, str], int]:
    """Sign of the commands that open the edge, by name and direction of its map."""
    return {(fit.map.valve, fit.map.direction): fit.sign for fit in fits}


def summary(fits: Sequence[FlowMapFit], rig: Rig) -> list[dict]:
    """The result of each map as plain values for a JSON file; SI, with the messages people read.

    Commands and deadbands are openings [V], zero or positive, and the driver gets ``sign`` times
    them. The messages have the driver's volts."""
    results = []
    for fit in fits:
        show, plain = _units(rig, fit.sign), fit.to_dict() | {"sign": fit.sign}
        plain["outlier_sentences"] = [item.sentence(show) for item in fit.outliers]
        plain["calibration_sentences"] = [item.sentence(show) for item in fit.calibration]
        results.append(plain)
    return results


def points_table(fits: Sequence[FlowMapFit], rig: Rig) -> str:
    """Every reading with its fitted flow as CSV text, in the units people see.

    ``command`` is the opening, zero or positive, which the maps take; ``driver_command`` is what
    was sent: sign·command."""
    flow_unit, drop_unit = rig.unit_of("flow"), rig.unit_of("pressure_drop")
    heads = ["valve", "direction", "command [V]", "driver_command [V]"]
    heads += [f"pressure_drop [{drop_unit}]", f"flow [{flow_unit}]", f"fitted [{flow_unit}]"]
    lines = [",".join([*heads, "method", "outlier", "file", "line"])]
    flow_row, drop_row = VOCABULARY["flow"], VOCABULARY["pressure_drop"]
    for fit in fits:
        rows = fit.rows
        assert rows is not None  # maps of a table have their readings
        out = {(outlier.file, outlier.line) for outlier in fit.outliers}
        drop = np.where(np.isnan(rows.pressure_drop), fit.map.drop_max, rows.pressure_drop)
        flows = rows.flow, fitted_flow(fit, rows, drop)
        numbers = [rows.command, fit.sign * rows.command + 0.0, from_si(drop, drop_unit, drop_row)]
        numbers += [from_si(values, flow_unit, flow_row) for values in flows]
        places = zip(rows.file.astype(str).tolist(), rows.line.tolist(), strict=True)
        for *row, method, place in zip(*numbers, rows.method, places, strict=True):
            cells = (fit.map.valve, fit.map.direction, *(f"{value:.6g}" for value in row))
            lines.append(",".join([*cells, str(method), f"{int(place in out)}", *map(str, place)]))
    return "\n".join(lines) + "\n"


def fitted_flow(fit: FlowMapFit, rows: FlowmeterData, drop: np.ndarray) -> np.ndarray:
    """The fitted flow [m³/s] of each reading, on the side of the hysteresis that it was read on."""
    level, fitted = np.asarray(fit.map.flow(drop, rows.command)), rows.flow - fit.residuals
    # a residual of zero is of a reading too small for its meter
    aside = (fit.residuals != 0.0) & (np.abs(fitted - level) > 1e-6 * fit.map.rated_flow)
    return np.where(np.isfinite(fitted) & aside, fitted, level)
