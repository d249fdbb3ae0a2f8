"""Identification of hydraulic parameters: values with intervals, correlation, what was matched,
and the fit to each log.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report.blocks import Block, Bullets, Cell, Grid, Heat, Part, Text
from ehbench.report.captions import as_fitted, plus, range_of
from ehbench.report.comparisons import draw_comparisons, log_cell, ringing_table
from ehbench.report.content import Pictures, SectionContent, StageReport, chip, folded, num
from ehbench.report.figures import hydraulics as figures
from ehbench.report.figures.channels import title_of
from ehbench.report.figures.sweeps import CAPTION, sweeps
from ehbench.report.headlines import estimates_of
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved, Table
from ehbench.report.words import (
    axis,
    count,
    interval,
    number,
    pretty,
    row_of,
    shown,
    unit_of,
    words,
)
from ehbench.vocabulary.fields import Value
from ehbench.vocabulary.terms import CORRELATED, Z95

_METHODS = {"thesis": "matching frequency and decay"}
_PARAMETERS_CAPTION = (
    "Dot and bar: value and 95 % interval. Grey: the bounds of the search. "
    "Hollow: where the search started."
)


def draw(run: Saved, index: FigureIndex) -> None:
    """The parameters within their bounds, then each log recorded and simulated."""
    fit = run.json("parameters.json")
    parameters = [item for item in estimates_of(fit) if item.number("value") is not None]
    if parameters:
        title, about = "Parameters within their bounds", FigureKey("parameters")
        path = index.add("parameters", title, _PARAMETERS_CAPTION, about)
        figures.parameters(path, run.rig, parameters)
    for log in fit["logs"]:
        draw_comparisons(run, index, log["name"], "fit", "Fitted to")
        if responses := log.get("responses"):
            command = responses[0]["input"].removesuffix(".command")
            title = f"Response to {command} in {words(log['name'])}"
            about = FigureKey("response", log=log["name"])
            path = index.add(f"response_{log['name']}", title, CAPTION, about)
            sweeps(path, run.rig, responses, responses[0]["coherence"])


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """Parameters with intervals, correlation, what was matched, and the fit to each log."""
    rig, fit = run.rig, run.json("parameters.json")
    parameters = estimates_of(fit)
    table = _parameters_table(rig, parameters, fit.get("sensors", []))
    leans = [lean["sentence"] for lean in fit.get("leans", [])]
    notes = [
        *filter(None, [fit.get("left_over")]),
        *fit.get("counts_on", []),
        *fit.get("compared", []),
    ]
    additional: list[Block] = [Bullets(leans, "warn")] if leans else []
    additional += [Bullets(notes)] if notes else []
    parts = [Part("Parameters", [table, *additional, *pictures(FigureKey("parameters"))])]
    names, matrix = fit.get("correlated_names", []), fit.get("correlation", [])
    if len(names) > 1:
        parts.append(Part("Correlation of the estimates", _correlation(names, matrix)))
    if groups := fit.get("groups", []):
        parts.append(Part("What the logs know together", [_groups(groups)]))
    if matches := fit.get("matches", []):
        caption = "Ringing of recorded and simulated transients over the same window."
        parts.append(Part("What was matched", [ringing_table(rig, matches, caption, True)]))
    if responses := pictures(FigureKey("response")):
        parts.append(Part("Frequency responses that were compared", responses))
    drawn = folded(pictures(FigureKey("fit")), "recorded and simulated")
    parts.append(Part("Fit to each log", [*_log_fits(rig, fit["logs"]), *drawn]))
    if variants := fit.get("dynamics_comparison", []):
        compared = [Text(_decision(variants)), _dynamics(rig, variants)]
        parts.append(Part("Valve dynamics compared", compared))
    weak = any(parameter["status"] != "estimated" for parameter in parameters)
    return SectionContent("partly_estimated" if weak else "done", _sentence(rig, fit), parts)


def _sentence(rig: Rig, fit: Table) -> str:
    parameters = estimates_of(fit)
    weak = [parameter for parameter in parameters if parameter["status"] != "estimated"]
    first = next((parameter for parameter in parameters if parameter not in weak), parameters[0])
    name = first["name"]
    value = as_fitted(rig, name, first)
    method = _METHODS.get(fit["method"], words(fit["method"]))
    sentence = (
        f"{count(len(parameters), 'parameter')} from {count(len(fit['logs']), 'log')} "
        f"by {method}: {words(name)} " + f"{value} {pretty(unit_of(rig, name))}".strip()
    )
    if weak:
        sentence += "; not simply estimated: " + ", ".join(
            f"{item['name']} ({words(item['status'])})" for item in weak
        )
    return sentence + "."


def _parameters_table(rig: Rig, parameters: Sequence[Table], sensors: Sequence[Table]) -> Grid:
    head = [
        "parameter",
        "value",
        "unit",
        "95 % interval",
        "bounds",
        "start",
        "status",
        "how sure",
        "samples",
        "error from",
        "logs' starts [%]",
    ]
    known = rig.parameters()
    rows = [
        _parameter_row(rig, parameter, known.get(parameter["name"])) for parameter in parameters
    ]
    note = (
        "± is half the width of the 95 % interval, which allows for coloured residuals; where the "
        "interval is lopsided, the value stands alone. Logs' starts: share of the variance that "
        "the estimated starts of the logs are to blame for."
    )
    if sensors or any(parameter.get("prior") for parameter in parameters):
        head += ["prior ±", "from data [%]"]
        rows = [
            row + _prior_cells(rig, parameter)
            for row, parameter in zip(rows, parameters, strict=True)
        ]
        rows += [_sensor_row(rig, sensor) for sensor in sensors]
        note += " From data: share of what is known that the prior did not bring."
    return Grid(head, rows, note)


def _sensor_row(rig: Rig, item: Table) -> list[Cell | str]:
    """What was found of a channel's sensor, below the parameters."""
    word, channel = item["word"], item["channel"]
    row = {"offset": channel, "scale": "sensor_scale"}.get(word, word)
    std, prior = item.number("std"), item.number("prior")
    share = 100.0 * max(0.0, 1.0 - (std / prior) ** 2) if std is not None and prior else None
    return [
        Cell(f"{word} of {channel}" + (f", {item['log']}" if item["log"] else ""), "code"),
        num(as_fitted(rig, row, item)),
        pretty(unit_of(rig, row)),
        num(range_of(rig, row, item.get("interval"))),
        "–",
        num(plus(rig, row, item.number("known"), None)),
        chip("estimated"),
        "sensor",
        *(num("–") for _ in range(3)),
        num(plus(rig, row, prior, None)),
        num(number(share, 3)),
    ]


def _prior_cells(rig: Rig, item: Table) -> list[Cell | str]:
    """What was known of a parameter beside the data, and the data's share in what is known now."""
    if not item.get("prior"):
        return [num("–"), num("–")]
    return [
        num(plus(rig, item["name"], item.number("prior"), None)),
        num(number(100.0 * item["from_data"], 3)),
    ]


def _parameter_row(rig: Rig, item: Table, value: Value | None) -> list[Cell | str]:
    name = item["name"]
    low, high = (plus(rig, name, item.number(key), None) for key in ("lower", "upper"))
    return [
        Cell(name, "code", hint=row_of(name).meaning),
        num(as_fitted(rig, name, item)),
        pretty(unit_of(rig, name)),
        num(range_of(rig, name, item.get("interval"))),
        num(f"{low} … {high}"),
        num(plus(rig, name, item.number("start"), None)),
        chip(item["status"]),
        value.sure if value is not None else "–",
        num(str(item["samples"])),
        words(item.get("error_from") or "–"),
        num(number(100.0 * item["from_starts"], 2) if item.get("from_starts") else "–"),
    ]


def _correlation(names: Sequence[str], matrix: Sequence[Sequence[float | None]]) -> list[Block]:
    """What correlates strongly in words, a sentence for all that hang together, then the matrix."""
    from scipy.sparse.csgraph import connected_components

    size = len(names)
    values = np.array(matrix[:size], float).reshape(size, -1)[:, :size]
    strong = np.tril(np.abs(values) > CORRELATED, -1)  # not where a value is not known
    _, groups = connected_components(strong, directed=False)
    messages = []
    for group in np.unique(groups):
        own = np.flatnonzero(groups == group).tolist()
        if len(own) == 1:
            continue
        *others, last = (names[i] for i in own)
        message = values[np.ix_(own, own)][strong[np.ix_(own, own)]]
        ends = message if len(own) == 2 else [np.abs(message).min(), np.abs(message).max()]
        by = " to ".join(dict.fromkeys(number(float(end), 3) for end in ends))
        messages.append(
            f"{', '.join(others)} and {last} correlate by {by}: the logs tell them only together."
        )
    return [*([Bullets(messages, "warn")] if messages else []), Heat(names, matrix)]


def _groups(groups: Sequence[Table]) -> Grid:
    note = (
        "Scales that the logs cannot tell change all parameters of a product together: each is "
        "open, the product is known. Measure one of them, or give it a prior. In SI."
    )
    rows: list[list[Cell | str]] = [
        [
            Cell(group["text"], "code"),
            num(number(group["value"], 4)),
            num(interval(*group["interval"])),
            num(f"± {number(100.0 * Z95 * group['std'], 2)} %"),
        ]
        for group in groups
    ]
    return Grid(["product", "value", "95 % interval", "known to"], rows, note)


def _log_fits(rig: Rig, logs: Sequence[Table]) -> list[Block]:
    fitted = list(
        dict.fromkeys(channel.rsplit(".", 1)[1] for log in logs for channel in log["fit_percent"])
    )
    head = [
        "log",
        "payload",
        "cylinder",
        *(f"{title_of(word).lower()} [%]" for word in fitted),
        *(axis(rig, word, f"rms error, {title_of(word).lower()}") for word in fitted),
    ]
    rows = [
        _log_fit_row(rig, log, cylinder, fitted)
        for log in logs
        for cylinder in dict.fromkeys(channel.rpartition(".")[0] for channel in log["fit_percent"])
    ]
    note = "Fit: 100 % is exact, 0 % no better than the mean of the recording."
    return [Grid(head, rows, note)] if rows else []


def _log_fit_row(rig: Rig, log: Table, cylinder: str, fitted: Sequence[str]) -> list[Cell | str]:
    cells: list[Cell | str] = [log_cell(log), log.get("payload", "none"), cylinder]
    errors = log["residual_rms"] if log.get("residual_rms") else {}
    names = [f"{cylinder}.{word}" for word in fitted]
    cells += [num(number(log["fit_percent"].get(name), 3)) for name in names]
    for name in names:
        error = errors.get(name)
        cells.append(num(number(None if error is None else float(shown(rig, name, error)), 3)))
    return cells


def _decision(variants: Sequence[Table]) -> str:
    """Whether the data tell the best of some valve dynamics from the others."""
    best, *others = variants
    larger = [
        f"{other['dynamics']} {number(100.0 * (other['relative_rms'] - 1.0), 2)} % "
        f"({interval(*(100.0 * (end - 1.0) for end in other['interval']))} %)"
        for other in others
    ]
    open_ones = [other["dynamics"] for other in others if other["interval"][0] <= 1.0]
    lead = f"The data decide for {best['dynamics']}"
    if open_ones:
        lead = f"Not decided between {best['dynamics']} and {', '.join(open_ones)}"
    text = f"{lead}: residuals larger than with {best['dynamics']} by {'; '.join(larger)}, in "
    text += "brackets the 95 % interval."
    lags = [
        f"{sensor['channel']} {number(1e3 * sensor['value'], 2)} ms"
        for sensor in best.get("fit", {}).get("sensors", [])
        if sensor["word"] == "lag"
    ]
    return text + (f" Sensors' lags fitted alongside: {', '.join(lags)}." if lags else "")


def _dynamics(rig: Rig, variants: Sequence[Table]) -> Grid:
    fits = [
        {parameter["name"]: parameter for parameter in variant["fit"]["parameters"]}
        if variant.get("fit")
        else {}
        for variant in variants
    ]
    errors = [num(number(variant["relative_rms"], 4)) for variant in variants]
    ends = [num(interval(*variant["interval"])) for variant in variants[1:]]
    rows: list[list[Cell | str]] = [
        ["error relative to the best", *errors],
        ["its 95 % interval", "", *ends],
    ]
    for name in dict.fromkeys(name for fitted in fits for name in fitted):
        cells = [_fitted_cell(rig, name, fitted.get(name)) for fitted in fits]
        rows.append([axis(rig, name, name), *cells])
    note = "The same logs, fitted with each valve dynamics in turn."
    return Grid(["", *(variant["dynamics"] for variant in variants)], rows, note)


def _fitted_cell(rig: Rig, name: str, item: Table | None) -> Cell:
    return num("–" if item is None else as_fitted(rig, name, item))


REPORT = StageReport(
    "identification",
    section,
    draw,
    standing=1,
    shows=("Parameters",),
    columns=("parameter", "value", "unit", "95 % interval", "status", "bounds"),
    numbers=("parameters.json", ("parameters", "warnings")),
)
