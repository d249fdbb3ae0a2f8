"""A study: how its measures are spread, which share keeps to its targets, what moves them, and its
worst samples.
"""

from __future__ import annotations

from collections.abc import Sequence

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
    study, table = run.json("study.json"), _columns(run)
    targets = {item["measure"]: item for item in study["targets"]}
    page = Template("study")
    for measure in study["measures"]:
        name, head = measure["name"], _head(measure["name"], measure["unit"])
        y = table[head]
        there = np.isfinite(y)
        if there.sum() < 2:
            continue
        if np.ptp(y[there]) > 0.0:
            target = targets.get(name)
            caption = page.text("spread", target=target)
            path = index.add(f"spread_{name}", f"Spread of {name}", caption, _key("spread", name))
            figures.distribution(path, _shown(measure), y[there], measure, target)
            _scatter(index, study, table, measure, y)
    for item in study["sensitivity"]:
        rows = sorted(item["inputs"], key=lambda row: -abs(_weight(row)))
        name = item["measure"]
        caption = page.text("sobol" if item["method"] == "sobol" else "rank")
        path = index.add(f"moves_{name}", f"What moves {name}", caption, _key("moves", name))
        figures.bars(path, rows[:20], item["method"])
    _maps(index, study)


def _columns(run: Saved) -> dict[str, np.ndarray]:
    """The columns of numbers of the table, by their heads; nan where a cell is no number."""
    import pandas as pd

    table = pd.read_csv(run.folder / "samples.csv", low_memory=False)
    numbers = table.apply(pd.to_numeric, errors="coerce").astype(float)
    return {str(name): np.asarray(numbers[name]) for name in numbers.columns}


def _head(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


def _shown(item: Table) -> str:
    return _head(words(item["name"]), pretty(item["unit"]))


def _unit(item: Table) -> str:
    """The unit of an input; that of factors is ×."""
    return "×" if item["factor"] else pretty(item["unit"])


def _key(kind: str, measure: str) -> FigureKey:
    return FigureKey(kind, case=measure)


def _weight(row: Table) -> float:
    return row.get("total", row.get("rank", 0.0))


def _scatter(
    index: FigureIndex, study: Table, table: dict[str, np.ndarray], measure: Table, y: np.ndarray
) -> None:
    inputs = []
    for item in study["inputs"]:
        x = table[_head(item["key"], item["unit"])]
        if item["varied"] != "seed" and not item["is_text"] and np.ptp(x) > 0.0:
            inputs.append((_head(item["key"], _unit(item)), x))
    if inputs:
        marks = np.array([item["sample"] for item in study["worst"]], int)
        name = measure["name"]
        caption = Template("study").text("over")
        path = index.add(f"over_{name}", f"{name} over the inputs", caption, _key("over", name))
        figures.scatter(path, _shown(measure), y, inputs[:12], marks)


def _maps(index: FigureIndex, study: Table) -> None:
    """A map of each measure over the first two swept keys, where two were swept."""
    listed = [item for item in study["inputs"] if item["values"]]
    if len(listed) != 2 or not study["groups"]:
        return
    across, up = (item["values"] for item in listed)
    for at, measure in enumerate(study["measures"]):
        z = np.full((len(up), len(across)), np.nan)
        for group in study["groups"]:
            values = group["values"]
            i, j = up.index(values[listed[1]["key"]]), across.index(values[listed[0]["key"]])
            z[i, j] = (
                np.nan
                if group["measures"][at].get("median") is None
                else (group["measures"][at]["median"])
            )
        name = measure["name"]
        if np.isfinite(z).any():
            caption = Template("study").text("map")
            path = index.add(f"map_{name}", f"Map of {name}", caption, _key("map", name))
            names = (listed[0]["key"], listed[1]["key"])
            figures.field(path, names, (across, up), z, _shown(measure))


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
    results.append(page.table("measures", study["measures"], quantile=_quantile))
    if study["targets"]:
        results.append(page.table("targets", study["targets"], text=page.text))
    moves: list[Block] = [Bullets(explained)] if explained else []
    parts = [
        Part("Results", results),
        Part("By swept values", [*_groups(page, study), *pictures(FigureKey("map"))]),
        Part("Spread", [*pictures(FigureKey("spread"))]),
        Part("What moves them", [*moves, *pictures(FigureKey("moves"))]),
        Part("The worst", [*_worst(page, study), *pictures(FigureKey("over"))]),
        Part("Inputs", [page.table("inputs", study["inputs"], unit=_unit)], paper=False),
    ]
    ended = sum(study["status"].get(word, 0) for word in _ENDED)
    sentence = page.text("sentence", study=study, ended=ended)
    return SectionContent("done", sentence, [part for part in parts if part.inside])


def _quantile(item: Table, percent: int) -> str | None:
    """A quantile with its 95 % interval; None where the measure has none."""
    for quantile in item.get("quantiles", []):
        if round(100 * quantile["share"]) == percent:
            low, high = (number(quantile.get(end), 3) for end in ("low", "high"))
            return f"{number(quantile['value'])} ({low} … {high})"
    return None


def _groups(page: Template, study: Table, maximum: int = 60) -> list[Block]:
    """Medians and upper quantiles of each combination of listed values, up to a maximum of rows."""
    groups = study["groups"]
    if not groups or len(groups) > maximum:
        return []
    ways = [(", median", "median"), (", 95 %", "q95"), (", maximum", "maximum")]
    ways = ways if study["points"] > 1 else [("", "median")]
    measures = [
        (place, f"{_shown(measure)}{text}", key)
        for place, measure in enumerate(study["measures"])
        for text, key in ways
    ]
    keys = [item["key"] for item in study["inputs"] if item["values"]]
    fields = {"keys": keys, "measures": measures, "study": study, "text": page.text}
    return [page.table("groups", groups, **fields)]


def _worst(page: Template, study: Table) -> list[Block]:
    """The samples that were retained: what they measured and what was set, and where they are."""
    inputs = [
        (place, _head(item["key"], _unit(item)))
        for place, item in enumerate(study["inputs"])
        if item["varied"] != "seed"
    ]
    measures = [(place, _shown(measure)) for place, measure in enumerate(study["measures"])]
    table = page.table("worst", study["worst"], inputs=inputs, measures=measures)
    return [table] if table.rows else []


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
