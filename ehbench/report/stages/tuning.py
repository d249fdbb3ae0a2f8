"""Tuning: working functions, equivalent mass and gravity, operating points, gains and what they
promise, loci, steps, what else was tried, draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report.blocks import Block, Cell, Fold, Grid, Part, Text
from ehbench.report.captions import capital, measure
from ehbench.report.content import (
    DAMPING,
    OFTEN,
    Findings,
    Headline,
    Pictures,
    SectionContent,
    StageReport,
    folded,
)
from ehbench.report.figures import root_locus
from ehbench.report.figures import tuning as figures
from ehbench.report.figures.circuit import circuit, flow_words
from ehbench.report.figures.tuning import Equivalent, function_names
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved, Table
from ehbench.report.template import Template
from ehbench.report.words import count, number, words
from ehbench.vocabulary.codes import EXTEND_RESISTIVE_REGENERATION, FUNCTIONS
from ehbench.vocabulary.messages import message

_EQUIVALENTS = {
    "equivalent_mass": Equivalent("mass", "mass", "Equivalent mass"),
    "equivalent_gravity": Equivalent("gravity_force", "force", "Equivalent gravity force"),
}
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
        about = FigureKey("function", function=item["name"], cylinder=tuning["cylinder"])
        title, key = f"{capital(words(item['name']))}: {cylinder}", f"function_{item['name']}"
        circuit(index.add(key, title, page.text("function_caption", **fields), about), item)
    for key, what in _EQUIVALENTS.items():
        caption = page.text("equivalents", tuning=tuning, **vars(what))
        path = index.add(key, f"{what.title}: {cylinder}", caption, FigureKey("equivalents"))
        figures.equivalents(path, rig, tuning, what)
    gains = sorted(set(tuning["feedback_gain"].values()))
    caption = page.text("damping", tuning=tuning, points=counted(tuning), gains=gains)
    title = "Damping ratio over the feedback gain"
    path = index.add("damping_over_gain", title, caption, FigureKey("damping"))
    figures.damping_over_gain(path, rig, tuning)
    for function in function_names(tuning):
        _draw_function(page, tuning, function, index)
    if (draws := tuning["robustness"])["draws"]:
        title = "Worst damping ratio over draws of the identified parameters"
        caption = page.text("draws", draws=draws, target=tuning["target"])
        figures.draws(index.add("draws", title, caption, FigureKey("draws")), tuning)


def _draw_function(page: Template, tuning: Table, function: str, index: FigureIndex) -> None:
    """Root loci and step responses of one working function."""
    by_name = {point["name"]: point for point in tuning["points"]}
    counts = any(item["point"]["function"] == function for item in counted(tuning))
    whose = f"{words(tuning['cylinder'])}, {words(function)}"

    about = partial(FigureKey, function=function, counts="yes" if counts else "no")

    def of_function(key: str) -> list[Table]:
        return [r for r in tuning[key] if by_name[r["name"]]["point"]["function"] == function]

    for parameter, lead, text in _LOCI:
        loci = [item for item in of_function("loci") if item["parameter"] == parameter]
        if loci:
            caption = page.text("locus", loci=loci, by_name=by_name, counts=counts)
            path = index.add(f"{lead}_{function}", f"{text}: {whose}", caption, about("locus"))
            root_locus.loci(path, loci, by_name)
    if steps := of_function("steps"):
        caption = page.text("steps", steps=steps, by_name=by_name, overshoot=overshoot_of)
        title, key = f"Step response: {whose}", f"step_response_{function}"
        path = index.add(key, title, caption, about("step_response"))
        figures.step_responses(path, steps, by_name)


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """Working functions, equivalents, operating points, gains and what they promise, loci, steps,
    what else was tried, draws.
    """
    rig, tuning = run.rig, run.json("tuning.json")
    page, met, points = Template("tuning", rig), tuning["met"], tuning["points"]
    choice: list[Block] = [
        Text(page.text("verdict", tuning=tuning), "good" if met else "bad"),
        *supply_blocks(rig, tuning),
        *pictures(FigureKey("damping")),
        page.table("parameters", parameter_rows(tuning)),
    ]
    loads = [item["payload"] for item in tuning["equivalents"]]
    groups = {(function, load): [] for function in function_names(tuning) for load in loads}
    for item in points:
        groups[item["point"]["function"], item["point"]["payload"]].append(item)
    by_load = page.table("points_by_load", filter(None, groups.values()), minimum=_minimum)
    every = Fold(f"All {count(len(points), 'operating point')}", [page.table("points", points)])
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
        draws = [*pictures(FigureKey("draws")), Fold(count(len(names), "parameter"), [drawn])]
    parts = [
        Part("Working functions", [*_functions(page, tuning), *pictures(FigureKey("function"))]),
        Part("Equivalent mass and gravity force", pictures(FigureKey("equivalents"))),
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
    return SectionContent("met" if met else "missed", sentence, parts)


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
    """The supply that was tuned on, where its pressure is not constant: more than its kind and one
    pressure.
    """
    supply = tuning.get("supply", {})
    if len(supply) <= 2:
        return []
    return [Text(Template("tuning", rig).text("supply", supply=supply), "note")]


def _by_count(pictures: Pictures, kind: str) -> list[Block]:
    """Figures of the functions that count and those that a campaign names; the others folded."""
    drawn = pictures(FigureKey(kind))
    uncounted = {p.id for p in pictures(FigureKey(counts="no")) if p.named is None}
    others = [picture for picture in drawn if picture.id in uncounted]
    counting = [picture for picture in drawn if picture.id not in uncounted]
    return [*counting, *folded(others, "functions that no load calls for")]


def _minimum(points: Sequence[Table], key: str) -> float | None:
    """The minimum of a margin over those points that have it."""
    return min((m for p in points if (m := p["margins"].get(key)) is not None), default=None)


def parameter_rows(tuning: Table) -> list[dict[str, Any]]:
    """Controller parameters (thesis Table B.3), then what was demanded and what is reached at
    worst.
    """
    gains = tuning["feedback_gain"].plain()
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
    for key, demanded in tuning["constraints"].items():
        row = {"name": "natural_frequency" if key == "bandwidth" else key, "text": words(key)}
        rows.append(row | {"demanded": demanded, "reached": _minimum(counted(tuning), key)})
    return rows


def findings(run: Saved) -> Findings:
    page, tuning = Template("headlines", run.rig), run.json("tuning.json")
    draws = tuning["robustness"]
    about = page.text("damping", tuning=tuning, draws=draws)
    label = f"Worst damping ratio, {words(tuning['cylinder'])}"
    gain = page.text("gain", gains=sorted(set(tuning["feedback_gain"].values())))
    numbers = [
        Headline(DAMPING, label, number(tuning["damping_ratio"], 2), about),
        Headline(OFTEN, "Feedback gain K_p", gain),
    ]
    against = [] if tuning["met"] else [page.text("missed")]
    reached = number(tuning["damping_ratio"], 2)
    steps = [message("steps.less_damping", reached=reached)] if against else []
    share = draws["share"] if draws["draws"] else 1.0
    if share < 1.0:
        against.append(page.text("missed_draws", share=1.0 - share))
    return Findings(numbers, [FigureKey("damping")], against, steps)


REPORT = StageReport(
    "tuning",
    section,
    draw,
    findings,
    shows=("The gain",),
    numbers=(
        "tuning.json",
        ("met", "feedback_gain", "washout", "damping_ratio", "damping_ratio_open"),
    ),
)
