"""A study: how its measures are spread, which share keeps to its targets, what moves them, and its
worst samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.report.blocks import Block, Bullets, Part
from ehbench.report.captions import capital
from ehbench.report.content import (
    OFTEN,
    Findings,
    Headline,
    Pictures,
    SectionContent,
    StageReport,
    names,
)
from ehbench.report.figures import study as figures
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved, Table
from ehbench.report.template import Template
from ehbench.report.words import number, pretty, words
from ehbench.vocabulary.messages import message

_ENDED = ("done", "incomplete", "rejected")


def draw(run: Saved, index: FigureIndex) -> None:
    """Each measure's distribution, scatter, what moves it, and its maps."""
    import pandas as pd

    study, page = run.json("study.json"), Template("study")
    samples = pd.read_csv(run.folder / "samples.csv", low_memory=False)
    samples = samples.apply(pd.to_numeric, errors="coerce").astype(float)
    table = {str(name): np.asarray(samples[name]) for name in samples.columns}
    targets = {item["measure"]: item for item in study["targets"]}

    def place(kind: str, title: str, text: str, measure: str, **fields: Any) -> Path:
        key, caption = f"{kind}_{measure}", page.text(text, **fields)
        return index.add(key, title, caption, FigureKey(kind, case=measure))

    inputs = []
    for item in study["inputs"]:
        x = table[_head(item["key"], item["unit"])]
        if item["varied"] != "seed" and not item["is_text"] and np.ptp(x) > 0.0:
            inputs.append((_head(item["key"], _input_unit(item)), x))
    marks = np.array([item["sample"] for item in study["worst"]], int)
    for measure in study["measures"]:
        name, y = measure["name"], table[_head(measure["name"], measure["unit"])]
        there = np.isfinite(y)
        if there.sum() < 2 or np.ptp(y[there]) == 0.0:
            continue
        target = targets.get(name)
        path = place("spread", f"Spread of {name}", "spread", name, target=target)
        figures.distribution(path, _label(measure), y[there], measure, target)
        if inputs:
            path = place("over", f"{name} over the inputs", "over", name)
            figures.scatter(path, _label(measure), y, inputs[:12], marks)
    for item in study["sensitivity"]:
        rows = sorted(item["inputs"], key=lambda row: -abs(row.get("total", row.get("rank", 0.0))))
        text = "sobol" if item["method"] == "sobol" else "rank"
        path = place("moves", f"What moves {item['measure']}", text, item["measure"])
        figures.bars(path, rows[:20], item["method"])
    listed = [item for item in study["inputs"] if item["values"]]
    if len(listed) != 2:
        return
    ticks, keys = [item["values"] for item in listed], [item["key"] for item in listed]
    for column, measure in enumerate(study["measures"]):
        z = np.full((len(ticks[1]), len(ticks[0])), np.nan)
        for group in study["groups"]:
            j, i = (t.index(group["values"][key]) for t, key in zip(ticks, keys, strict=True))
            median = group["measures"][column].get("median")
            z[i, j] = np.nan if median is None else median
        if np.isfinite(z).any():
            path = place("map", f"Map of {measure['name']}", "map", measure["name"])
            figures.field(path, keys, ticks, z, _label(measure))


def _head(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


def _label(item: Table) -> str:
    return _head(words(item["name"]), pretty(item["unit"]))


def _input_unit(item: Table) -> str:
    """The unit of an input; that of factors is ×."""
    return "×" if item["factor"] else pretty(item["unit"])


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """Measures and targets, then by swept values, what moves them, and the worst samples."""
    study, page = run.json("study.json"), Template("study")
    unfinished = [
        page.text("unfinished", count=n, samples=study["samples"], status=word)
        for word, n in study["status"].items()
        if word not in _ENDED
    ]
    explained = [
        page.text("explained", item=item)
        for item in study["sensitivity"]
        if item.get("explained") is not None
    ]
    results: list[Block] = [Bullets(unfinished, "warn")] if unfinished else []
    results.append(page.table("measures", study["measures"]))
    if study["targets"]:
        results.append(page.table("targets", study["targets"], text=page.text))
    moves: list[Block] = [Bullets(explained)] if explained else []
    inputs = [
        (place, _head(item["key"], _input_unit(item)))
        for place, item in enumerate(study["inputs"])
        if item["varied"] != "seed"
    ]
    measures = [(place, _label(measure)) for place, measure in enumerate(study["measures"])]
    worst = page.table("worst", study["worst"], inputs=inputs, measures=measures)
    parts = [
        Part("Results", results),
        Part("By swept values", [*_group_tables(page, study), *pictures(FigureKey("map"))]),
        Part("Spread", [*pictures(FigureKey("spread"))]),
        Part("What moves them", [*moves, *pictures(FigureKey("moves"))]),
        Part("The worst", [*[worst] * bool(worst.rows), *pictures(FigureKey("over"))]),
        Part("Inputs", [page.table("inputs", study["inputs"], unit=_input_unit)], paper=False),
    ]
    ended = sum(study["status"].get(word, 0) for word in _ENDED)
    sentence = page.text("sentence", study=study, ended=ended)
    return SectionContent("done", sentence, [part for part in parts if part.inside])


def _group_tables(page: Template, study: Table, maximum: int = 60) -> list[Block]:
    """Medians and upper quantiles of each combination of listed values, up to a maximum of rows."""
    groups = study["groups"]
    if not groups or len(groups) > maximum:
        return []
    ways = [(", median", "median"), (", 95 %", "q95"), (", maximum", "maximum")]
    ways = ways if study["points"] > 1 else [("", "median")]
    measures = [
        (place, f"{_label(measure)}{text}", key)
        for place, measure in enumerate(study["measures"])
        for text, key in ways
    ]
    keys = [item["key"] for item in study["inputs"] if item["values"]]
    fields = {"keys": keys, "measures": measures, "study": study, "text": page.text}
    return [page.table("groups", groups, **fields)]


def findings(run: Saved, lost: Sequence[str] = ("failed", "refused", "late")) -> Findings:
    study, page = run.json("study.json"), Template("headlines")
    numbers = []
    for target in study["targets"]:
        value = f"{number(100.0 * target['share'], 3)} %"
        label, about = (page.text(key, target=target) for key in ("target", "share"))
        numbers.append(Headline(OFTEN, label, value, about))
    aimed = [target["measure"] for target in study["targets"]]
    spread = [item for item in study["measures"] if item.get("quantiles")]
    for item in spread:
        if item["name"] not in aimed:
            unit = f" {pretty(item['unit'])}" if item["unit"] else ""
            quantiles = {q["share"]: q["value"] for q in item["quantiles"]}
            label = f"{capital(words(item['name']))}, median"
            about = page.text("spread", item=item, upper=quantiles[0.95], unit=unit)
            numbers.append(Headline(OFTEN, label, f"{number(quantiles[0.5], 3)}{unit}", about))
    figures = [FigureKey("spread", case=name) for name in aimed]
    figures += [FigureKey("map"), *(FigureKey("spread", case=item["name"]) for item in spread)]
    ended = {word: n for word, n in study["status"].items() if word in lost}
    samples = study["samples"]
    against = [
        page.text("lost", count=n, samples=samples, status=word) for word, n in ended.items()
    ]
    steps = [message("steps.lost_samples", **names(run), status=words(word)) for word in ended]
    return Findings(numbers, figures, against, steps)


REPORT = StageReport(
    "study", section, draw, findings, shows=("Results",), numbers=("study.json", ())
)
