"""A study: how its measures are spread, which share keeps to its targets, what moves them, and its
worst samples.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ehbench.report.blocks import Block, Bullets, Cell, Grid, Part
from ehbench.report.content import Pictures, SectionContent, StageReport, num
from ehbench.report.figures import study as figures
from ehbench.report.headlines import ends_of
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved, Table
from ehbench.report.words import count, interval, number, pretty, words

MOST_ROWS = 60  # of a table by swept values
_ENDED = ("done", "incomplete", "rejected")


def draw(run: Saved, index: FigureIndex) -> None:
    """Each measure's distribution, scatter, what moves it, and its maps."""
    study, table = run.json("study.json"), _columns(run)
    targets = {item["measure"]: item for item in study["targets"]}
    for measure in study["measures"]:
        name, head = measure["name"], _head(measure["name"], measure["unit"])
        y = table[head]
        there = np.isfinite(y)
        if there.sum() < 2:
            continue
        if np.ptp(y[there]) > 0.0:
            target = targets.get(name)
            caption = _SPREAD + " Dashed: the target." * (target is not None)
            path = index.add(f"spread_{name}", f"Spread of {name}", caption, _key("spread", name))
            figures.distribution(path, _shown(measure), y[there], measure, target)
            _scatter(index, study, table, measure, y)
    for item in study["sensitivity"]:
        rows = sorted(item["inputs"], key=lambda row: -abs(_weight(row)))
        name = item["measure"]
        caption = _SOBOL if item["method"] == "sobol" else _RANK
        path = index.add(f"moves_{name}", f"What moves {name}", caption, _key("moves", name))
        figures.bars(path, rows[:20], item["method"])
    _maps(index, study)


_SPREAD = (
    "Left: samples by value. Right: the share of samples up to a value; bars: 95 % intervals of "
    "the quantiles from order statistics, open ends drawn to the last sample."
)
_RANK = (
    "Linear regression of the measure's rank on the inputs' ranks: 1 is all of it, sign as moved. "
    "A text counts by the mean rank of its samples, so without a sign."
)
_SOBOL = "Share of the measure's variance by one input alone (first) and with all others (total)."
_MAP = "Median over the samples of each combination of the two swept keys."


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
        caption = "Each sample; circles: the worst, kept as runs of their own."
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
            path = index.add(f"map_{name}", f"Map of {name}", _MAP, _key("map", name))
            names = (listed[0]["key"], listed[1]["key"])
            figures.field(path, names, (across, up), z, _shown(measure))


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """Measures and targets, then by swept values, what moves them, and the worst samples."""
    study = run.json("study.json")
    parts = [
        Part("Results", [*_unfinished(study), _measures(study), *_targets(study)]),
        Part("By swept values", [*_groups(study), *pictures(FigureKey("map"))]),
        Part("Spread", [*pictures(FigureKey("spread"))]),
        Part("What moves them", [*_moves(study), *pictures(FigureKey("moves"))]),
        Part("The worst", [*_worst(study), *pictures(FigureKey("over"))]),
        Part("Inputs", [_inputs(study)], paper=False),
    ]
    return SectionContent("done", _sentence(study), [part for part in parts if part.inside])


def _sentence(study: Table) -> str:
    ended = sum(study["status"].get(word, 0) for word in _ENDED)
    what = " and ".join(f"'{name}'" for name in study["recipe"])
    sentence = f"{count(study['samples'], 'sample')} of {what}, {ended} of which came to their end"
    for target in study["targets"]:
        sentence += f"; {_met(target)} keep {target['measure']} {ends_of(target)}"
    return sentence + "."


def _met(item: Table) -> str:
    span = interval(100.0 * item["low"], 100.0 * item["high"])
    return f"{number(100.0 * item['share'], 3)} % ({span} %)"


def _unfinished(study: Table) -> list[Block]:
    """How many samples did not come to their end."""
    sentences = [
        f"{n} of {study['samples']} samples {words(word)}"
        for word, n in study["status"].items()
        if word not in _ENDED
    ]
    return [Bullets(sentences, "warn")] if sentences else []


def _targets(study: Table) -> list[Block]:
    rows = [
        [
            target["measure"],
            num(ends_of(target)),
            num(f"{target['count']} of {target['of']}"),
            num(_met(target)),
        ]
        for target in study["targets"]
    ]
    head = ["target", "", "samples that keep it", "share (95 % interval)"]
    return [Grid(head, rows)] if rows else []


def _measures(study: Table) -> Grid:
    rows = []
    for measure in study["measures"]:
        cells = [measure["name"], num(str(measure["samples"]))]
        if "quantiles" in measure:
            cells += [num(number(measure["mean"])), num(number(measure.get("std")))]
            cells += [num(_quantile(each)) for each in measure["quantiles"]]
            cells += [num(number(measure["minimum"])), num(number(measure["maximum"]))]
        else:
            cells += [num(number(None))] * (2 + len(_SHARES) + 2)
        rows.append([*cells, pretty(measure["unit"])])
    heads = [f"{100 * share:g} % quantile" for share in _SHARES]
    head = ["measure", "samples", "mean", "spread", *heads, "minimum", "maximum", "unit"]
    caption = "Of samples that came to their end; quantiles with 95 % intervals."
    return Grid(head, rows, caption)


_SHARES = (0.05, 0.5, 0.95, 0.99)


def _quantile(item: Table) -> str:
    low, high = (number(item.get(end), 3) for end in ("low", "high"))
    return f"{number(item['value'])} ({low} … {high})"


def _groups(study: Table) -> list[Block]:
    """Medians and upper quantiles of each combination of listed values."""
    groups = study["groups"]
    if not groups or len(groups) > MOST_ROWS:
        return []
    keys = [item["key"] for item in study["inputs"] if item["values"]]
    head = [*keys, "came to their end"]
    for measure in study["measures"]:
        ways = ("median", "95 %", "maximum") if study["points"] > 1 else ("",)
        head += [f"{_shown(measure)}{', ' * bool(way)}{way}" for way in ways]
    head += [f"keep {target['measure']} {ends_of(target)}" for target in study["targets"]]
    rows = []
    for group in groups:
        cells: list[Cell | str] = [group["values"][key] for key in keys]
        cells.append(num(f"{group['whole']} of {group['samples']}"))
        for item in group["measures"]:
            ways = ("median", "q95", "maximum") if study["points"] > 1 else ("median",)
            cells += [num(number(item.get(way), 3)) for way in ways]
        rows.append(cells + [num(_met(target)) for target in group["targets"]])
    return [Grid(head, rows)]


def _moves(study: Table) -> list[Block]:
    sentences = [
        f"ranks of {item['measure']}: the inputs explain {number(100.0 * item['explained'], 2)} %"
        for item in study["sensitivity"]
        if item.get("explained") is not None
    ]
    return [Bullets(sentences)] if sentences else []


def _worst(study: Table) -> list[Block]:
    """The samples that were kept: what they measured and what was set, and where they are."""
    varied = [item for item in study["inputs"] if item["varied"] != "seed"]
    inputs = [i for i, item in enumerate(study["inputs"]) if item in varied]
    heads = [_head(item["key"], _unit(item)) for item in varied]
    rows: list[Sequence[Cell | str]] = []
    for item in study["worst"]:
        cells = [num(str(item["sample"])), Cell(item["folder"], "code"), words(item["status"])]
        cells += [num(number(value, 4)) for value in item["measures"]]
        for i in inputs:
            value = item["inputs"][i]
            cells.append(value if isinstance(value, str) else num(number(value, 4)))
        rows.append([*cells, item["message"]])
    if not rows:
        return []
    measures = [_shown(measure) for measure in study["measures"]]
    caption = "Each was run again and kept whole; by its number it can be made anew."
    return [Grid(["sample", "its run", "status", *measures, *heads, ""], rows, caption)]


def _inputs(study: Table) -> Grid:
    rows: list[Sequence[Cell | str]] = [
        [
            Cell(item["key"], "code"),
            _unit(item),
            words(item["varied"]),
            ", ".join(item["values"]) or item["law"],
        ]
        for item in study["inputs"]
    ]
    return Grid(["key", "unit", "varied by", "values"], rows)


REPORT = StageReport("study", section, draw, shows=("Results",), numbers=("study.json", ()))
