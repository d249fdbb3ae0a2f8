"""Tuning: functions, equivalents, operating points, gains, loci, steps, draws."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.config.rig import Rig, Slide
from ehbench.report import content
from ehbench.report.blocks import Block, Cell, Fold, Grid, Part, Text
from ehbench.report.figures import root_locus
from ehbench.report.figures.circuit import circuit, flow_words
from ehbench.report.saved import FigureIndex, Saved, Table
from ehbench.report.style import (
    ACCENT,
    CYCLE,
    MUTED,
    RECORDED,
    SIMULATED,
    Look,
    canvas,
    cycled,
    key,
    legend,
    tag,
)
from ehbench.report.template import Template
from ehbench.report.words import (
    axis,
    capital,
    load_name,
    measure,
    number,
    rounded_down,
    row_of,
    shown,
    unit_of,
    words,
)
from ehbench.vocabulary import message, plural
from ehbench.vocabulary.codes import EXTEND_RESISTIVE_REGENERATION, FUNCTIONS

# (key of the figure, key in the file, vocabulary row, title)
_EQUIVALENTS = (
    ("equivalent_mass", "mass", "mass", "Equivalent mass"),
    ("equivalent_gravity", "gravity_force", "force", "Equivalent gravity force"),
)
_LOCI = (
    ("feedback_gain", "locus", "Root locus over the feedback gain"),
    ("washout", "locus_washout", "Root locus over the washout corner"),
)
# (vocabulary row, key in the file, text)
_PARAMETERS = (
    ("washout", "washout", "washout corner f_w"),
    ("washout", "ramp_washout", "corner of the second washout f_r"),
    ("off_gain", "off_gain", "off-side gain K_o"),
    ("low_pressure", "low_pressure", "off-side set-point above tank"),
    ("cross_drop", "cross_drop", "planned drop across the cross-port edge"),
    ("lag", "tick", "tick"),
    ("lag", "delay", "delay from pressure to command"),
)


def counted(tuning: Table) -> list[Table]:
    """The operating points that the gain was chosen on."""
    return [point for point in tuning["points"] if point["counts"]]


def overshoot_of(values: Sequence[float]) -> float | None:
    """Overshoot of a response over its last value, as a share of it; None where it ends at zero."""
    y = np.asarray(values, float)
    return None if y[-1] == 0.0 else max(0.0, float((y * np.sign(y[-1])).max() / abs(y[-1]) - 1.0))


def draw(run: Saved, index: FigureIndex) -> None:
    """Every figure of a tuning."""
    rig, tuning = run.rig, run.json("tuning.json")
    page, cylinder = Template("tuning", rig), words(tuning["cylinder"])
    for item in tuning.get("functions", []):
        named = [[e["name"] for e in item["edges"] if bool(e["way"]) is on] for on in (True, False)]
        fields = {"opened": named[0], "shut": named[1], "metering": _metering(item)["name"]}
        about = {"function": item["name"], "cylinder": tuning["cylinder"]}
        title, key = f"{capital(words(item['name']))}: {cylinder}", f"function_{item['name']}"
        caption = page.text("function_caption", **fields)
        circuit(index.add(key, title, caption, "function", **about), item)
    for name, field, quantity, title in _EQUIVALENTS:
        fields = {"key": field, "quantity": quantity, "title": title}
        caption = page.text("equivalents", tuning=tuning, **fields)
        path = index.add(name, f"{title}: {cylinder}", caption, "equivalents")
        draw_equivalents(path, rig, tuning, **fields)
    gains = sorted(set(tuning["feedback_gain"].values()))
    caption = page.text("damping", tuning=tuning, points=counted(tuning), gains=gains)
    title = "Damping ratio over the feedback gain"
    path = index.add("damping_over_gain", title, caption, "damping")
    damping_over_gain(path, rig, tuning)
    points = {point["name"]: point for point in tuning["points"]}
    counting = {item["point"]["function"] for item in counted(tuning)}
    for function in function_names(tuning):
        whose, counts = f"{cylinder}, {words(function)}", function in counting
        about = {"function": function, "counts": "yes" if counts else "no"}
        loci, steps = (
            [item for item in tuning[key] if points[item["name"]]["point"]["function"] == function]
            for key in ("loci", "steps")
        )
        for parameter, lead, text in _LOCI:
            if drawn := [item for item in loci if item["parameter"] == parameter]:
                caption = page.text("locus", loci=drawn, by_name=points, counts=counts)
                key, title = f"{lead}_{function}", f"{text}: {whose}"
                path = index.add(key, title, caption, "locus", **about)
                root_locus.loci(path, drawn, points)
        if steps:
            caption = page.text("steps", steps=steps, by_name=points, overshoot=overshoot_of)
            title, key = f"Step response: {whose}", f"step_response_{function}"
            path = index.add(key, title, caption, "step_response", **about)
            draw_steps(path, steps, points)
    if (draws := tuning["robustness"])["draws"]:
        title = "Worst damping ratio over draws of the identified parameters"
        caption = page.text("draws", draws=draws, target=tuning["target"])
        draw_draws(index.add("draws", title, caption, "draws"), tuning)


_BLACK = "#111827"
_UNCOUNTED: Look = {"linestyle": (0, (1, 2))}  # how points look that no load calls for


def function_names(tuning: Table) -> list[str]:
    """Working functions of a tuning, in its order."""
    return list(dict.fromkeys(point["point"]["function"] for point in tuning["points"]))


def draw_equivalents(
    path: Path, rig: Rig, tuning: Table, key: str, quantity: str, title: str
) -> None:
    """A curve a payload over the stroke, dots at operating points (thesis B.1–B.4)."""
    from scipy.interpolate import make_interp_spline

    with canvas(path, size=(7.2, 3.4)) as (_, ax):
        for index, equivalent in enumerate(tuning["equivalents"]):
            x, y = (np.array(equivalent[name], float) for name in ("x", key))
            look = cycled(index, label=load_name(equivalent["payload"]))
            ax.plot(shown(rig, "x", x), shown(rig, quantity, y), **look)
            points = [p["point"] for p in tuning["points"]]
            places = np.unique([p["x"] for p in points if p["payload"] == equivalent["payload"]])
            there = shown(rig, quantity, np.interp(places, x, y))
            ax.plot(shown(rig, "x", places), there, "o", markersize=4, color=look["color"])
        ax.set_xlabel(axis(rig, "x", "stroke"))
        ax.set_ylabel(axis(rig, quantity, title.lower()))
        ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
        ax.legend()
        if not isinstance(rig.mechanism, Slide) and tuning["equivalents"]:
            first = tuning["equivalents"][0]
            x, q = (shown(rig, n, np.array(first[n], float)) for n in ("x", "q"))
            up = np.argsort(q)
            # lines that go on straight beyond their ends, as an axis needs them
            ways = make_interp_spline(x, q, 1), make_interp_spline(q[up], x[up], 1)
            above = ax.secondary_xaxis("top", functions=ways)
            above.set_xlabel(axis(rig, "q", "joint angle"))
            above.spines["top"].set_visible(False)


def damping_over_gain(path: Path, rig: Rig, tuning: Table) -> None:
    """Minimum damping ratio over K_p by operating point, target and choice."""
    low = -0.08  # end of the frame
    gains = np.array(tuning["gains"], float)
    positive = gains > 0.0
    x = shown(rig, "feedback_gain", gains)[positive]
    names = function_names(tuning)
    colours = {name: CYCLE[i % len(CYCLE)] for i, name in enumerate(names)}
    with canvas(path, size=(7.4, 4.6)) as (figure, ax):
        for point in tuning["points"]:
            y = np.array(point["curve"], float)
            y[1:][(y[1:] < low) & (y[:-1] < low)] = np.nan  # beyond the frame
            look: Look = {"linewidth": 0.7, "alpha": 0.55}
            if not point["counts"]:
                look = {"linewidth": 0.8, "alpha": 0.5} | _UNCOUNTED
            ax.plot(x, y[positive], color=colours[point["point"]["function"]], **look)
        ax.plot(x, np.array(tuning["worst_curve"], float)[positive], color=_BLACK, linewidth=2.0)
        ax.axhline(tuning["target"], color=MUTED, linewidth=1.0, linestyle=(0, (5, 3)))
        tag(ax, "target", 0.0, tuning["target"], (4, 3), "x", color=MUTED)
        ax.axhspan(low, 0.0, color=ACCENT, alpha=0.07, linewidth=0)
        tag(ax, "unstable", 0.0, low, (4, 3), "x", color=ACCENT)
        chosen = tuning["feedback_gain"]
        choices = sorted(set(chosen.values()))
        for gain in choices:  # a line, with a ring at the minimum damping that it gives
            functions = [name for name in colours if chosen[name] == gain]
            colour = _BLACK if len(choices) == 1 else colours[functions[0]]
            at = shown(rig, "feedback_gain", gain)
            ax.axvline(at, color=colour, linewidth=0.9, linestyle=(0, (2, 2)))
            reached = [
                point["damping_ratio_closed"]
                for point in tuning["points"]
                if point["counts"] and point["point"]["function"] in functions
            ]
            if reached:
                look = {"markerfacecolor": "white", "markeredgecolor": colour, "zorder": 6}
                ax.plot([at], [min(reached)], "o", markersize=6.5, markeredgewidth=1.6, **look)
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter(lambda tick, _: number(tick))
        ax.set(xlim=(x[0], x[-1]), ylim=(low, 1.02))
        ax.set_xlabel(axis(rig, "feedback_gain", "feedback gain K_p"))
        ax.set_ylabel("damping ratio of the least damped pole")
        counting = {point["point"]["function"] for point in tuning["points"] if point["counts"]}
        choice: Look = {"color": _BLACK, "linestyle": (0, (2, 2)), "linewidth": 0.9}
        ring: Look = {"marker": "o", "markersize": 6, "markerfacecolor": "white"}
        handles = [key("worst that counts", color=_BLACK, linewidth=2.0)]
        handles.append(key("choice", **choice, **ring))
        for name, colour in colours.items():
            text, look = (", shown only", _UNCOUNTED) if name not in counting else ("", {})
            handles.append(key(words(name) + text, color=colour, **look))
        legend(figure, handles, 3)


def draw_steps(path: Path, steps: Sequence[Table], by_name: dict[str, Table]) -> None:
    """A panel a payload: speed over desired speed, without any feedback and with it."""
    looks = {
        "v_open": ("without any feedback", {"color": RECORDED, "linewidth": 1.0}),
        "v_closed": ("with pressure feedback", {"color": SIMULATED, "linewidth": 1.8}),
    }
    with canvas(path, 1, len(steps), (7.4, 3.1), squeeze=False, sharey=True) as (figure, axes):
        for ax, step in zip(axes[0], steps, strict=True):
            t = np.array(step["t"], float)
            ax.axhline(1.0, color=MUTED, linewidth=0.8)
            for name, (_, look) in looks.items():
                ax.plot(t, step[name], **look)
            ax.set_title(load_name(by_name[step["name"]]["point"]["payload"]))
            ax.set_xlabel("time [s]")
            ax.set_xlim(0.0, t[-1])
        axes[0, 0].set_ylabel("speed over desired speed [1]")
        axes[0, 0].set_ylim(bottom=min(0.0, axes[0, 0].get_ylim()[0]))
        legend(figure, [key(text, **look) for text, look in looks.values()])


def draw_draws(path: Path, tuning: Table) -> None:
    """A histogram of each draw's worst damping ratio, with target and identified value."""
    values = np.array(tuning["robustness"]["damping_ratios"], float)
    room = 0.02 * max(float(np.ptp(values)), 1e-3)
    with canvas(path, size=(7.2, 2.6)) as (_, ax):
        bins = np.linspace(values.min() - room, values.max() + room, 25)
        ax.hist(values, bins=bins, color=RECORDED, alpha=0.75)
        marks = [(tuning["target"], "target", ACCENT)]
        marks.append((tuning["damping_ratio"], "as identified", SIMULATED))
        sides = (("right", -3), ("left", 3))  # away from one another
        for (value, text, colour), (side, off) in zip(sorted(marks), sides, strict=True):
            ax.axvline(value, color=colour, linewidth=1.4)
            tag(ax, text, value, 1.0, (off, 1), "y", color=colour, ha=side, va="bottom")
        ax.set_xlabel("worst damping ratio over the operating points")
        ax.set_ylabel("draws")
        ax.margins(x=0.06)


def section(run: Saved, pictures: content.Pictures) -> content.SectionContent:
    """Functions, equivalents, points, gains, loci, steps, what else was tried, draws."""
    rig, tuning = run.rig, run.json("tuning.json")
    page, met, points = Template("tuning", rig), tuning["met"], tuning["points"]
    choice: list[Block] = [
        Text(page.text("verdict", tuning=tuning), "good" if met else "bad"),
        *supply_blocks(rig, tuning),
        *pictures(kind="damping"),
        page.table("parameters", parameter_rows(tuning)),
    ]
    loads = [item["payload"] for item in tuning["equivalents"]]
    groups = {(function, load): [] for function in function_names(tuning) for load in loads}
    for item in points:
        groups[item["point"]["function"], item["point"]["payload"]].append(item)
    by_load = page.table("points_by_load", filter(None, groups.values()), minimum=_minimum)
    every = Fold(f"All {plural(len(points), 'operating point')}", [page.table("points", points)])
    laws = tuning["alternatives"]
    others: list[Block] = []
    if laws:
        ratio, second = laws[0]["damping_ratio"], any(law.get("ramp_washout") for law in laws)
        better = [other["what"] for other in laws[1:] if other["damping_ratio"] > ratio]
        others = [Text(page.text("alternatives_lead", better=better))]
        others.append(page.table("alternatives", laws, second=second))
    draws: list[Block] = [Text(page.text("no_draws"), "note")]
    if tuning["robustness"]["draws"]:
        names = [[Cell(name, "code")] for name in tuning["robustness"]["parameters"]]
        drawn = Grid(["drawn, with their covariance"], names)
        draws = [*pictures(kind="draws"), Fold(plural(len(names), "parameter"), [drawn])]
    parts = [
        Part("Working functions", [*_functions(page, tuning), *pictures(kind="function")]),
        Part("Equivalent mass and gravity force", pictures(kind="equivalents")),
        Part("Operating points", [by_load, every]),
        Part("The gain", choice),
        Part("Root loci", _by_count(pictures, "locus")),
        Part("Step responses", _by_count(pictures, "step_response")),
        Part("What else was tried", others),
        Part("Draws of the identified parameters", draws),
    ]
    corners = [tuning[key] for key in ("washout", "ramp_washout") if tuning.get(key)]
    sentence = page.text(
        "sentence",
        tuning=tuning,
        points=counted(tuning),
        gains=sorted(set(tuning["feedback_gain"].values())),
        corners=list(dict.fromkeys(measure(rig, "washout", corner) for corner in corners)),
        many=len(corners) > 1,
    )
    return content.SectionContent("met" if met else "missed", sentence, parts)


def _metering(item: Table) -> Table:
    return next(edge for edge in item["edges"] if edge["meters"])


def _functions(page: Template, tuning: Table) -> list[Block]:
    """Which working function is chosen when, and what each opens (thesis Tables 3.1, 3.2)."""
    functions = tuning.get("functions", [])
    if not functions:
        return []
    seventh = FUNCTIONS[EXTEND_RESISTIVE_REGENERATION]
    hold = {"name": "hold", "direction": 0, "along": None, "cross": "", "draws": 0.0}
    order = sorted(functions, key=lambda item: (-item["direction"], item["along"]))
    there = any(function["name"] == seventh for function in functions)
    fields = {"seventh": seventh, "seventh_there": there}

    def others(item: Table) -> list[str]:
        edges = [edge for edge in item["edges"] if edge["way"] and not edge["meters"]]
        return [f"{edge['name']}, {flow_words(edge)}" for edge in edges]

    uses: dict[str, Any] = {"metering": _metering, "flow": flow_words, "others": others}
    return [
        page.table("functions", [hold, *order], **fields),
        page.table("cylinder_functions", functions, **uses),
    ]


def supply_blocks(rig: Rig, tuning: Table) -> list[Block]:
    """The supply that was tuned on, where its pressure is not constant."""
    supply = tuning.get("supply", {})
    if len(supply) <= 2:
        return []
    return [Text(Template("tuning", rig).text("supply", supply=supply), "note")]


def _by_count(pictures: content.Pictures, kind: str) -> list[Block]:
    """Figures of the functions that count and those that a campaign names; the others folded."""
    drawn = pictures(kind=kind)
    uncounted = {p.id for p in pictures(counts="no") if p.named is None}
    others = [picture for picture in drawn if picture.id in uncounted]
    counting = [picture for picture in drawn if picture.id not in uncounted]
    return [*counting, *content.folded(others, "functions that no load calls for")]


def _minimum(points: Sequence[Table], key: str) -> float | None:
    """The minimum of a margin over those points that have it."""
    return min((m for p in points if (m := p["margins"].get(key)) is not None), default=None)


def parameter_rows(tuning: Table) -> list[dict[str, Any]]:
    """Controller parameters (thesis Table B.3), then what is demanded and reached at worst."""
    gains = tuning["feedback_gain"]
    if len(set(gains.values())) == 1:
        gains = {"all functions": next(iter(gains.values()))}
    crossed = any("regeneration" in function for function in tuning["feedback_gain"])
    needless = {"ramp_washout": not tuning.get("ramp_washout"), "cross_drop": not crossed}
    rows: list[dict[str, Any]] = [
        {"name": "feedback_gain", "text": f"feedback gain K_p, {words(name)}", "value": gain}
        for name, gain in gains.items()
    ]
    rows += [
        {"name": name, "text": text, "value": tuning[key]}
        for name, key, text in _PARAMETERS
        if not needless.get(key)
    ]
    ratio = {"demanded": tuning["target"], "reached": tuning["damping_ratio"]}
    rows.append({"name": "damping_ratio", "text": "damping ratio", **ratio})
    for word, demanded in tuning["constraints"].items():
        row = {"name": word, "text": words(word), "demanded": demanded}
        rows.append(row | {"reached": _minimum(counted(tuning), word)})
    return rows


def reached_demands(rig: Rig, demands: Mapping[str, Any], reached: Mapping[str, Any]) -> str:
    """Lines of a recipe that ask for what was reached of the demands that were missed; '' where
    the loop swings with any gains."""
    lines = []
    for word, demand in demands.items():
        value = reached.get(word)
        if value is None or value >= demand:
            continue
        if value <= row_of(word).lower:
            return ""
        unit = unit_of(rig, word).replace("dimensionless", "")
        value = rounded_down(shown(rig, word, value))
        lines.append(f'{word} = "{value:g} {unit}'.rstrip() + '"')
    return "\n".join(lines)


def findings(run: Saved) -> content.Findings:
    page, tuning = Template("headlines", run.rig), run.json("tuning.json")
    draws = tuning["robustness"]
    about = page.text("damping", tuning=tuning, draws=draws)
    label = f"Worst damping ratio, {words(tuning['cylinder'])}"
    gain = page.text("gain", gains=sorted(set(tuning["feedback_gain"].values())))
    numbers = [
        content.Headline(content.DAMPING, label, number(tuning["damping_ratio"], 2), about),
        content.Headline(content.OFTEN, "Feedback gain K_p", gain),
    ]
    against = [] if tuning["met"] else [page.text("missed")]
    demands = {"damping_ratio": tuning["target"], **tuning["constraints"]}
    worst = {name: _minimum(counted(tuning), name) for name in tuning["constraints"]}
    keys = reached_demands(run.rig, demands, {"damping_ratio": tuning["damping_ratio"], **worst})
    steps = [message("steps.smaller_margins", keys=keys)] if against else []
    share = draws["share"] if draws["draws"] else 1.0
    if share < 1.0:
        against.append(page.text("missed_draws", share=1.0 - share))
    return content.Findings(numbers, [{"kind": "damping"}], against, steps)
