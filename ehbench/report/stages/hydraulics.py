"""Hydraulic parameters: values, intervals, correlation, what was matched, fit to each log."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report import content
from ehbench.report.blocks import Block, Bullets, Grid, Heat, Part, Text
from ehbench.report.comparisons import draw_comparisons, draw_responses
from ehbench.report.saved import FigureIndex, Saved, Table
from ehbench.report.style import ACCENT, MUTED, RECORDED, canvas
from ehbench.report.template import Template
from ehbench.report.words import (
    DASH,
    as_fitted,
    axis,
    interval,
    number,
    pretty,
    row_of,
    shown,
    title_of,
    unit_of,
    words,
)
from ehbench.vocabulary import Z95, message, quantity
from ehbench.vocabulary.terms import BEYOND, CORRELATED, TOLD

DOUBTFUL = "estimated, doubtful"  # as it is sensitive to a fixed number that the logs deny


def draw(run: Saved, index: FigureIndex) -> None:
    """The parameters within their bounds, then each log recorded and simulated."""
    fit = run.json("parameters.json")
    parameters = [item for item in estimates_of(fit) if item.number("value") is not None]
    if parameters:
        title = "Parameters within their bounds"
        caption = Template("hydraulics").text("parameters_caption")
        path = index.add("parameters", title, caption, "parameters")
        draw_parameters(path, run.rig, parameters)
    for log in fit["logs"]:
        draw_comparisons(run, index, log["name"], "fit", "Fitted to")
        if responses := log.get("responses"):
            name, limit = log["name"], responses[0]["coherence"]
            key = f"response_{name}"
            draw_responses(run, index, "response", name, key, responses, limit)


def draw_parameters(path: Path, rig: Rig, result: Sequence[Table]) -> None:
    """A strip a parameter: value with 95 % interval on the bounds of the search, start."""
    size = (7.2, 0.72 * len(result) + 0.3)
    with canvas(path, len(result), 1, size, squeeze=False) as (_, axes):
        for ax, item in zip(axes[:, 0], result, strict=True):
            name = item["name"]
            known = [item.number(key) for key in ("value", "start", "lower", "upper")]
            value, start, low, high, *ends = (
                None if v is None or not np.isfinite(v) else shown(rig, name, v)
                for v in (*known, *(item.get("interval") or (None, None)))
            )
            known = [v for v in (value, start, low, high, *ends) if v is not None]
            left, right = min(known), max(known)
            if left > 0.0 and right / left > 30.0:
                ax.set_xscale("log")
                ax.xaxis.set_major_formatter(lambda tick, _: number(tick))
                room = (right / left) ** 0.03
                left, right = left / room, right * room
            else:
                room = 0.03 * ((right - left) or abs(right) or 1.0)
                left, right = left - room, right + room
            ax.set(xlim=(left, right), ylim=(-1, 1), yticks=[])
            bounds = [left if low is None else low, right if high is None else high]
            ax.plot(bounds, [0, 0], color="#d1d5db", linewidth=7, solid_capstyle="butt")
            if None not in ends:
                ax.plot(ends, [0, 0], color=RECORDED, linewidth=3, solid_capstyle="butt")
            hollow = {"markerfacecolor": "white", "markeredgecolor": MUTED, "markeredgewidth": 1.2}
            ax.plot([start], [0], "o", markersize=6, **hollow)
            colour = RECORDED if item["status"] == "estimated" else ACCENT
            ax.plot([value], [0], "o", markersize=5.5, color=colour)
            ax.spines["left"].set_visible(False)
            ax.tick_params(axis="x", labelsize=7.5, pad=1)
            text = f"{as_fitted(rig, name, item)} {pretty(unit_of(rig, name))}".rstrip()
            ax.set_title(f"{name}   {text}", fontsize=8.5, pad=2)
            status = {"fontsize": 8, "pad": 2, "color": colour, "fontweight": "normal"}
            ax.set_title(words(item["status"]), loc="right", **status)


def section(run: Saved, pictures: content.Pictures) -> content.SectionContent:
    """Parameters with intervals, correlation, what was matched, and the fit to each log."""
    page, fit = Template("hydraulics", run.rig), run.json("parameters.json")
    parameters = estimates_of(fit)
    sensitive = [item["sentence"] for item in fit.get("leans", [])]
    notes = [fit["left_over"]] if fit.get("left_over") else []
    notes += [*fit.get("counts_on", []), *fit.get("compared", [])]
    unasked = ", ".join(fit.get("unasked", []))
    notes += [message("identification.unasked", names=unasked)] if unasked else []
    inside: list[Block] = [_parameters(page, parameters, fit.get("sensors", []))]
    inside += [Bullets(sensitive, "warn")] if sensitive else []
    inside += [Bullets(notes)] if notes else []
    inside += pictures(kind="parameters")
    names = fit.get("correlated_names", [])
    correlated = correlations(names, fit.get("correlation", [])) if len(names) > 1 else []
    groups, matches = fit.get("groups", []), fit.get("matches", [])
    ringing = Template("comparisons", run.rig).table("ringing", matches, with_log=True)
    rows = [
        {"log": log, "cylinder": cylinder, "errors": log.get("residual_rms", {})}
        for log in fit["logs"]
        for cylinder in dict.fromkeys(name.rpartition(".")[0] for name in log["fit_percent"])
    ]
    channels = dict.fromkeys(name for log in fit["logs"] for name in log["fit_percent"])
    fitted = list(dict.fromkeys(channel.rsplit(".", 1)[1] for channel in channels))
    fits = [page.table("logs", rows, fitted=fitted)] if rows else []
    fits += content.folded(pictures(kind="fit"), "recorded and simulated")
    variants = fit.get("dynamics_comparison", [])
    parts = [
        Part("Parameters", inside),
        Part("Correlation of the estimates", correlated),
        Part("What the logs know together", [page.table("groups", groups, z95=Z95)] * bool(groups)),
        Part("What was matched", [ringing] * bool(matches)),
        Part("Frequency responses that were compared", pictures(kind="response")),
        Part("Fit to each log", fits),
        Part("Valve dynamics compared", _dynamics(page, variants) if variants else []),
    ]
    weak = Counter(item["status"] for item in parameters if item["status"] != "estimated")
    sound = [item for item in parameters if item["status"] == "estimated"]
    fields = {"parameters": parameters, "logs": fit["logs"], "weak": weak}
    first = (sound or parameters)[0]
    sentence = page.text("sentence", method=fit["method"], first=first, **fields)
    return content.SectionContent("partly_estimated" if weak else "done", sentence, parts)


def _parameters(page: Template, parameters: Sequence[Table], sensors: Sequence[Table]) -> Grid:
    """A row a parameter, then a row an estimated error of a sensor."""
    assert page.rig is not None
    known = page.rig.parameters()
    rows: list[dict[str, Any]] = []
    for item in parameters:
        name = item["name"]
        row = {"item": item, "row": name, "label": name, "hint": row_of(name).meaning}
        row["sure"] = known[name].sure if name in known else DASH
        share = item["from_data"] if item.get("prior") else None
        rows.append(row | {"sensor": False, "from_data": share})
    for item in sensors:
        word, channel = item["word"], item["channel"]
        std, prior = item.number("std"), item.number("prior")
        share = max(0.0, 1.0 - (std / prior) ** 2) if std is not None and prior else None
        row = {"offset": channel, "scale": "sensor_scale"}.get(word, word)
        label = f"{word} of {channel}" + (f", {item['log']}" if item["log"] else "")
        rows.append({"item": item, "row": row, "label": label, "hint": "", "sure": "sensor"})
        rows[-1] |= {"sensor": True, "from_data": share}
    prior = bool(sensors) or any(parameter.get("prior") for parameter in parameters)
    return page.table("parameters", rows, prior=prior)


def correlations(
    names: Sequence[str], matrix: Sequence[Sequence[float | None]]
) -> list[Bullets | Heat]:
    """What correlates strongly in words, a sentence for all that hang together, then the matrix."""
    from scipy.sparse.csgraph import connected_components

    size = len(names)
    values = np.array(matrix[:size], float).reshape(size, -1)[:, :size]
    strong = np.tril(np.abs(values) > CORRELATED, -1)  # not where a value is not known
    _, groups = connected_components(strong, directed=False)
    texts = []
    for group in np.unique(groups):
        members = np.flatnonzero(groups == group).tolist()
        if len(members) == 1:
            continue
        *others, last = (names[i] for i in members)
        sizes = values[np.ix_(members, members)][strong[np.ix_(members, members)]]
        ends = sizes if len(members) == 2 else [np.abs(sizes).min(), np.abs(sizes).max()]
        ends = list(dict.fromkeys(number(float(end), 3) for end in ends))
        texts.append(Template("hydraulics").text("correlated", others=others, last=last, ends=ends))
    return [*([Bullets(texts, "warn")] if texts else []), Heat(names, matrix)]


def _dynamics(page: Template, variants: Sequence[Table]) -> list[Block]:
    """Whether the data tell the best of some valve dynamics from the others, and each fit."""
    assert page.rig is not None
    best, *others = variants
    sensors = best.get("fit", {}).get("sensors", [])
    text = page.text(
        "decision",
        best=best,
        others=others,
        undecided=[other["dynamics"] for other in others if other["interval"][0] <= 1.0],
        lags=[sensor for sensor in sensors if sensor["word"] == "lag"],
    )
    errors = {v["dynamics"]: content.num(number(v["relative_rms"], 4)) for v in variants}
    ends = {v["dynamics"]: content.num(interval(*v["interval"])) for v in others}
    rows: list[dict[str, Any]] = [
        {"text": "error relative to the best", "cells": errors},
        {"text": "its 95 % interval", "cells": {best["dynamics"]: ""} | ends},
    ]
    fits = {
        variant["dynamics"]: {item["name"]: item for item in variant["fit"]["parameters"]}
        for variant in variants
        if variant.get("fit")
    }
    for name in dict.fromkeys(name for fitted in fits.values() for name in fitted):
        cells = {variant["dynamics"]: content.num(DASH) for variant in variants}
        for dynamics, fitted in fits.items():
            if name in fitted:
                cells[dynamics] = content.num(as_fitted(page.rig, name, fitted[name]))
        rows.append({"text": axis(page.rig, name, name), "cells": cells})
    return [Text(text), page.table("dynamics", rows, variants=list(variants))]


def _spread(item: Table) -> float:
    """Half of the interval of an estimate over its value; infinite where it has none."""
    ends, value = item.get("interval"), item.number("value")
    if not ends or None in ends or not value:
        return np.inf
    return abs((ends[1] - ends[0]) / (2.0 * value))


def findings(run: Saved) -> content.Findings:
    page, fit = Template("headlines", run.rig), run.json("parameters.json")
    sensitive, parameters = fit.get("leans", [])[:1], estimates_of(fit)
    known = [parameter for parameter in parameters if parameter.number("value") is not None]
    known.sort(key=lambda entry: (entry["status"] != "estimated", entry["name"] != "bulk_modulus"))
    numbers = []
    for place, item in enumerate(known):
        name = item["name"]
        owner = name.rpartition(".")[0]
        label = title_of(name) + (f", {owner}" if owner else "")
        value, about = page.text("parameter_value", item=item), page.text("parameter", item=item)
        rank = content.OFTEN if place else content.PARAMETER
        numbers.append(content.Headline(rank, label, value, about))
    residual = str(fit.get("left_over") or "").partition(":")[0]  # its meaning is in the chapter
    # a doubtful one is explained by the number that it is sensitive to
    weak = [item for item in parameters if item["status"] not in ("estimated", DOUBTFUL)]
    written = [note for note in fit.get("warnings", []) if "cause" in getattr(note, "fields", {})]
    against = [*written, *(item["sentence"] for item in sensitive)] + [residual] * bool(residual)
    against += [page.text("weak", item=item) for item in weak]
    steps = [message(item["key"], **item["fields"]) for item in fit.get("advice", [])]
    doubts = [(content.weight(note.fields), content.written_step(note.fields)) for note in written]
    for item in sensitive:  # what somebody measured seldom is what is wrong
        share = content.weight({"share": item["explains"]})
        if residual and getattr(item["sentence"], "fields", {}).get("known"):
            first = message("steps.suggest_first", **content.names(run), number=item["name"])
            doubts.append((share, first))
            residual = ""
        doubts.append((share, content.remedy_step(item["remedy"])))
    steps += [step for _, step in sorted(doubts, key=lambda pair: -pair[0])]
    steps += [message("steps.suggest", **content.names(run))] * bool(residual)
    # of each status the least known; a test for what is told to a hundredth would be in vain
    vague = [item for item in weak if item["status"] != "correlated" or not _spread(item) < TOLD]
    worst: dict[str, str] = {}
    for item in sorted(vague, key=_spread, reverse=True):
        worst.setdefault(item["status"], item["name"])
    for status, parameter in worst.items():
        key = "steps.bound" if status == "at_bound" else "steps.settle"
        steps.append(message(key, **content.names(run), parameter=parameter))
    return content.Findings(numbers, [{"kind": "parameters"}], against, steps)


def estimates_of(fit: Table) -> list[Table]:
    """The parameters of a fit; doubtful ones are sensitive to a denied fixed number, stood at an
    end of their range beside it, or are what no ordinary rig has."""
    moved = [item for fixed in fit.get("leans", []) for item in fixed["moved"]]
    far = {item["name"] for item in moved if item["halves"] > BEYOND}
    if far:
        far |= {item["name"] for item in fit["parameters"] if item.get("error_from") == "range"}
    far |= {
        item["name"]
        for item in fit["parameters"]
        if not quantity(item["name"]).ordinary(item["value"])
    }
    return [
        parameter.having("status", DOUBTFUL)
        if parameter["name"] in far and parameter["status"] == "estimated"
        else parameter
        for parameter in fit["parameters"]
    ]
