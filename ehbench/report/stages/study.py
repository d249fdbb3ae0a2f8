"""A study: spread of its measures, shares within targets, what moves them, the worst."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.report import content
from ehbench.report.blocks import Block, Bullets, Part
from ehbench.report.saved import FigureIndex, Saved, Table
from ehbench.report.style import ACCENT, MUTED, RECORDED, SIMULATED, canvas, key, legend
from ehbench.report.template import Template
from ehbench.report.words import capital, number, pretty, words
from ehbench.vocabulary import message

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
        return index.add(key, title, caption, kind, case=measure)

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
        draw_distribution(path, _label(measure), y[there], measure, target)
        if inputs:
            path = place("over", f"{name} over the inputs", "over", name)
            draw_scatter(path, _label(measure), y, inputs[:12], marks)
    for item in study["sensitivity"]:
        rows = sorted(item["inputs"], key=lambda row: -abs(row.get("total", row.get("rank", 0.0))))
        text = "sobol" if item["method"] == "sobol" else "rank"
        path = place("moves", f"What moves {item['measure']}", text, item["measure"])
        draw_bars(path, rows[:20], item["method"])
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
            draw_map(path, keys, ticks, z, _label(measure))


def _head(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


def _label(item: Table) -> str:
    return _head(words(item["name"]), pretty(item["unit"]))


def _input_unit(item: Table) -> str:
    """The unit of an input; that of factors is ×."""
    return "×" if item["factor"] else pretty(item["unit"])


def draw_distribution(
    path: Path, name: str, y: np.ndarray, summary: Table, target: Table | None
) -> None:
    """A histogram, and the share of samples up to a value with its quantiles' intervals."""
    with canvas(path, 1, 2, (7.2, 2.8)) as (figure, (left, right)):
        left.hist(y, bins=min(40, max(8, round(y.size**0.5))), color=RECORDED, alpha=0.85)
        left.set_ylabel("samples")
        left.yaxis.get_major_locator().set_params(integer=True)
        ordered = np.sort(y)
        share = 100.0 * np.arange(1, y.size + 1) / y.size
        right.step(ordered, share, where="post", color=RECORDED, linewidth=1.3)
        for quantile in summary["quantiles"]:
            low, high = quantile.get("low"), quantile.get("high")
            low = float(ordered[0]) if low is None else low
            high = float(ordered[-1]) if high is None else high
            level = 100.0 * quantile["share"]
            right.plot([low, high], [level, level], color=SIMULATED, linewidth=3, alpha=0.6)
            right.plot([quantile["value"]], [level], "o", color=SIMULATED, markersize=4)
        right.set_ylabel("samples up to here [%]")
        for ax in (left, right):
            ax.set_xlabel(name)
            for end in ("at_most", "at_least"):
                if target is not None and target.get(end) is not None:
                    ax.axvline(target[end], color=ACCENT, linestyle=(0, (4, 3)), linewidth=1.0)
        figure.align_labels()


def draw_scatter(
    path: Path,
    name: str,
    y: np.ndarray,
    inputs: Sequence[tuple[str, np.ndarray]],
    marks: np.ndarray,
) -> None:
    """A measure over each input, 3000 dots at most; ``marks`` are samples to point out."""
    columns = min(3, len(inputs))
    rows = -(-len(inputs) // columns)
    size = (7.2, 2.4 * rows + 0.3)
    look = {"squeeze": False, "sharey": True}
    step = max(1, y.size // 3000)
    dot = 2.5 if y.size > 200 else 5.0
    with canvas(path, rows, columns, size, **look) as (figure, axes):
        for ax, (name_of, x) in zip(axes.flat, inputs, strict=False):
            ax.plot(x[::step], y[::step], ".", color=RECORDED, markersize=dot, alpha=0.5)
            ax.plot(x[marks], y[marks], "o", color=ACCENT, markersize=6, fillstyle="none")
            ax.margins(0.06)
            ax.set_xlabel(name_of, fontsize=8)
        for ax in axes.flat[len(inputs) :]:
            ax.set_visible(False)
        for row in axes:
            row[0].set_ylabel(name)
        handles = [
            key("sample", linestyle="", marker=".", color=RECORDED),
            key("retained as a run", linestyle="", marker="o", color=ACCENT, fillstyle="none"),
        ]
        legend(figure, handles)


def draw_bars(path: Path, rows: Sequence[Table], way: str) -> None:
    """What moves a measure, largest first."""
    keys = [row["key"] for row in rows]
    places = np.arange(len(keys))[::-1]
    with canvas(path, 1, 1, (7.2, 0.7 + 0.32 * len(keys))) as (figure, ax):
        if way == "sobol":
            for shift, word, colour in ((0.18, "first", RECORDED), (-0.18, "total", SIMULATED)):
                ax.barh(
                    places + shift,
                    [row[word] for row in rows],
                    0.34,
                    color=colour,
                    xerr=[row[f"{word}_error"] for row in rows],
                    label=word,
                    error_kw={"ecolor": MUTED, "elinewidth": 1.0},
                )
            ax.set_xlabel("Sobol index")
            legend(figure, ax.get_legend_handles_labels()[0])
        else:
            ax.barh(places, [row.get("rank", 0.0) for row in rows], 0.6, color=RECORDED)
            ax.axvline(0.0, color=MUTED, linewidth=0.8)
            ax.set_xlabel("standardised coefficient of ranks")
        ax.set_yticks(places, keys, fontsize=8)


def draw_map(
    path: Path, names: Sequence[str], ticks: Sequence[Sequence[str]], z: np.ndarray, label: str
) -> None:
    """A map of a number over two keys, with the numbers in its cells; nan: none."""
    rows, columns = z.shape
    size = (min(7.2, 2.2 + 0.7 * columns), min(7.0, 1.4 + 0.42 * rows))
    with canvas(path, 1, 1, size) as (figure, ax):
        image = ax.imshow(z, aspect="auto", cmap="viridis_r", origin="lower")
        ax.grid(False)
        ax.set_xticks(range(columns), ticks[0], fontsize=8)
        ax.set_yticks(range(rows), ticks[1], fontsize=8)
        ax.set_xlabel(names[0])
        ax.set_ylabel(names[1])
        middle = np.nanmean([np.nanmin(z), np.nanmax(z)]) if np.isfinite(z).any() else 0.0
        if rows * columns <= 150:
            for (i, j), value in np.ndenumerate(z):
                text = "–" if np.isnan(value) else f"{value:.3g}"
                look: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 7}
                ax.text(j, i, text, color="white" if value > middle else "black", **look)
        figure.colorbar(image, ax=ax, label=label, fraction=0.05)


def section(run: Saved, pictures: content.Pictures) -> content.SectionContent:
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
    by_values: list[Block] = []
    if 0 < len(study["groups"]) <= 60:  # a row each combination of listed values
        ways = [(", median", "median"), (", 95 %", "q95"), (", maximum", "maximum")]
        ways = ways if study["points"] > 1 else [("", "median")]
        of_ways = [(n, f"{label}{text}", key) for n, label in measures for text, key in ways]
        keys = [item["key"] for item in study["inputs"] if item["values"]]
        fields = {"keys": keys, "measures": of_ways, "study": study, "text": page.text}
        by_values.append(page.table("groups", study["groups"], **fields))
    parts = [
        Part("Results", results),
        Part("By case", _case_tables(run, page, study)),
        Part("By swept values", [*by_values, *pictures(kind="map")]),
        Part("Spread", [*pictures(kind="spread")]),
        Part("What moves them", [*moves, *pictures(kind="moves")]),
        Part("The worst", [*[worst] * bool(worst.rows), *pictures(kind="over")]),
        Part("Inputs", [page.table("inputs", study["inputs"], unit=_input_unit)], paper=False),
    ]
    ended = sum(study["status"].get(word, 0) for word in _ENDED)
    sentence = page.text("sentence", study=study, ended=ended)
    return content.SectionContent("done", sentence, [part for part in parts if part.inside])


def _case_tables(run: Saved, page: Template, study: Table) -> list[Block]:
    """How the samples of each named case ended, their measures, and what ended the first that was
    not completed; empty without cases."""
    import pandas as pd

    if all(item["key"] != "case" for item in study["inputs"]):
        return []
    samples = pd.read_csv(run.folder / "samples.csv", low_memory=False, keep_default_na=False)
    rows, measures = [], study["measures"]
    for name, group in samples.groupby("case", sort=False):
        ended = ", ".join(f"{words(str(k))} {n}" for k, n in group["status"].value_counts().items())
        broken = [str(text) for text in group["message"] if text]
        heads = [_head(measure["name"], measure["unit"]) for measure in measures]
        of = [pd.Series(pd.to_numeric(group[h], errors="coerce"), dtype=float) for h in heads]
        numbers = [{"median": column.median(), "maximum": column.max()} for column in of]
        first = broken[0].partition(";")[0] if broken else ""
        rows.append({"case": name, "ended": ended, "measures": numbers, "first": first})
    ways = [
        (place, f"{_label(measure)}, {way}", way)
        for place, measure in enumerate(measures)
        for way in ("median", "maximum")
    ]
    return [page.table("cases", rows, measures=ways)]


def findings(run: Saved) -> content.Findings:
    study, page = run.json("study.json"), Template("headlines")
    numbers = []
    for target in study["targets"]:
        value = f"{number(100.0 * target['share'], 3)} %"
        label, about = (page.text(key, target=target) for key in ("target", "share"))
        numbers.append(content.Headline(content.OFTEN, label, value, about))
    aimed = [target["measure"] for target in study["targets"]]
    spread = [item for item in study["measures"] if item.get("quantiles")]
    for item in spread:
        if item["name"] not in aimed:
            unit = f" {pretty(item['unit'])}" if item["unit"] else ""
            quantiles = {q["share"]: q["value"] for q in item["quantiles"]}
            label = f"{capital(words(item['name']))}, median"
            about = page.text("spread", item=item, upper=quantiles[0.95], unit=unit)
            numbers.append(
                content.Headline(content.OFTEN, label, f"{number(quantiles[0.5], 3)}{unit}", about)
            )
    figures = [{"kind": "spread", "case": name} for name in aimed] + [{"kind": "map"}]
    figures += [{"kind": "spread", "case": item["name"]} for item in spread]
    lost = ("failed", "refused", "late")
    ended = {word: n for word, n in study["status"].items() if word in lost}
    samples = study["samples"]
    against = [
        page.text("lost", count=n, samples=samples, status=word) for word, n in ended.items()
    ]
    steps = [
        message("steps.lost_samples", **content.names(run), status=words(word)) for word in ended
    ]
    return content.Findings(numbers, figures, against, steps)
