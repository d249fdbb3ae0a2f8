"""Tuning: equivalent mass and gravity, operating points, gains and what they promise, loci, steps,
what else was tried, draws.
"""

from __future__ import annotations

from collections.abc import Sequence

from ehbench.config.rig import Rig
from ehbench.report.blocks import Block, Cell, Fold, Grid, Part, Text
from ehbench.report.captions import load_name, measure, percent, span
from ehbench.report.content import (
    Pictures,
    SectionContent,
    StageReport,
    chip,
    folded,
    num,
    quantity_cell,
)
from ehbench.report.figures import root_locus
from ehbench.report.figures import tuning as figures
from ehbench.report.figures.tuning import Equivalent
from ehbench.report.functions_part import draw_functions, function_tables
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved, Table
from ehbench.report.tuning_words import (
    counted,
    damping_caption,
    draws_caption,
    equivalents_caption,
    function_names,
    locus_caption,
    payloads_of,
    steps_caption,
    supply_blocks,
    undamped,
)
from ehbench.report.words import DASH, axis, count, number, pretty, shown, unit_of, words

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


def draw(run: Saved, index: FigureIndex) -> None:
    """Every figure of a tuning."""
    rig, tuning = run.rig, run.json("tuning.json")
    draw_functions(tuning, index)
    for key, what in _EQUIVALENTS.items():
        caption = equivalents_caption(rig, tuning, what.key, what.quantity, what.title)
        title = f"{what.title}: {words(tuning['cylinder'])}"
        path = index.add(key, title, caption, FigureKey("equivalents"))
        figures.equivalents(path, rig, tuning, what)
    title, caption = "Damping ratio over the feedback gain", damping_caption(rig, tuning)
    path = index.add("damping_over_gain", title, caption, FigureKey("damping"))
    figures.damping_over_gain(path, rig, tuning)
    for function in function_names(tuning):
        _draw_function(rig, tuning, function, index)
    if tuning["robustness"]["draws"]:
        title = "Worst damping ratio over draws of the identified parameters"
        path = index.add("draws", title, draws_caption(tuning), FigureKey("draws"))
        figures.draws(path, tuning)


def _draw_function(rig: Rig, tuning: Table, function: str, index: FigureIndex) -> None:
    """Root loci and step responses of one working function."""
    by_name = {point["name"]: point for point in tuning["points"]}
    counts = any(item["point"]["function"] == function for item in counted(tuning))
    whose = f"{words(tuning['cylinder'])}, {words(function)}"

    def about(kind: str) -> FigureKey:
        return FigureKey(kind, function=function, counts="yes" if counts else "no")

    def own(results: Sequence[Table]) -> list[Table]:
        return [r for r in results if by_name[r["name"]]["point"]["function"] == function]

    for parameter, lead, text in _LOCI:
        loci = [item for item in own(tuning["loci"]) if item["parameter"] == parameter]
        if loci:
            caption = locus_caption(rig, loci, by_name, counts)
            path = index.add(f"{lead}_{function}", f"{text}: {whose}", caption, about("locus"))
            root_locus.loci(path, loci, by_name)
    if steps := own(tuning["steps"]):
        title, caption = f"Step response: {whose}", steps_caption(steps, by_name)
        path = index.add(f"step_response_{function}", title, caption, about("step_response"))
        figures.step_responses(path, steps, by_name)


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """Equivalent mass and gravity, operating points, gains and what they promise, loci, steps, what
    else was tried, draws.
    """
    rig, tuning = run.rig, run.json("tuning.json")
    met = tuning["met"]
    verdict = f"Target and demands are {'met' if met else 'not met'}"
    choice: list[Block] = [
        Text(f"{verdict} at all operating points that count.", "good" if met else "bad"),
        *supply_blocks(rig, tuning),
        *pictures(FigureKey("damping")),
        _parameters(rig, tuning),
    ]
    functions = function_tables(rig, tuning)
    parts = [
        Part("Working functions", [*functions, *pictures(FigureKey("function"))]),
        Part("Equivalent mass and gravity force", pictures(FigureKey("equivalents"))),
        Part("Operating points", _operating_points(rig, tuning)),
        Part("The gain", choice),
        Part("Root loci", _by_count(pictures, "locus")),
        Part("Step responses", _by_count(pictures, "step_response")),
        Part("What else was tried", _alternatives(rig, tuning)),
        Part("Draws of the identified parameters", _draws(tuning, pictures)),
    ]
    return SectionContent("met" if met else "missed", _sentence(rig, tuning), parts)


def _sentence(rig: Rig, tuning: Table) -> str:
    gains = sorted(set(tuning["feedback_gain"].values()))
    lead = "One gain" if len(gains) == 1 else f"{len(gains)} gains"
    gain = span([float(shown(rig, "feedback_gain", g)) for g in gains])
    corners = [tuning[key] for key in ("washout", "ramp_washout") if tuning.get(key)]
    washout = "no washout"
    if corners:
        corner_text = " and ".join(
            dict.fromkeys(measure(rig, "washout", corner) for corner in corners)
        )
        washout = f"{'two washouts' if len(corners) > 1 else 'washout'} {corner_text}"
    sentence = (
        f"{lead} K_p = {gain} {pretty(unit_of(rig, 'feedback_gain'))}, {washout}: "
        f"worst damping ratio {number(tuning['damping_ratio'], 2)} over "
        f"{count(len(counted(tuning)), 'operating point')} of {words(tuning['cylinder'])}, "
        f"{undamped(tuning)}; target {number(tuning['target'], 2)}"
    )
    draws = tuning["robustness"]
    if draws["draws"]:
        sentence += f", reached by {percent(draws['share'], 3)} of {draws['draws']} draws"
    return sentence + "."


def _by_count(pictures: Pictures, kind: str) -> list[Block]:
    """Figures of the functions that count and those that a campaign names; the others folded."""
    shown_only = pictures(FigureKey(counts="no"))
    rest = {picture.id for picture in shown_only if picture.named is None}
    drawn = pictures(FigureKey(kind))
    counting = [picture for picture in drawn if picture.id not in rest]
    others = [picture for picture in drawn if picture.id in rest]
    return [*counting, *folded(others, "functions that no load calls for")]


def _operating_points(rig: Rig, tuning: Table) -> list[Block]:
    """A row a function and payload, and every point folded away."""
    points = tuning["points"]
    note = (
        "Speed lost: what the static pressure takes where there is no washout. "
        "Open: without any feedback, that of the off-side (K_o) included."
    )
    every = Grid(_point_head(rig), [_point_row(rig, point) for point in points], note)
    return [
        _points_by_load(rig, tuning),
        Fold(f"All {count(len(points), 'operating point')}", [every]),
    ]


def _points_by_load(rig: Rig, tuning: Table) -> Grid:
    head = [
        "function",
        "payload",
        "points",
        "in the choice",
        axis(rig, "mass", "m_eq"),
        axis(rig, "force", "F_eq"),
        axis(rig, "natural_frequency", "fₙ without feedback"),
        "ζ without any feedback",
        "ζ with K_o alone",
        "ζ with feedback",
        "least gain margin",
        axis(rig, "phase_margin", "least phase margin"),
    ]
    rows = []
    for function in function_names(tuning):
        for payload in payloads_of(tuning):
            group = [
                point
                for point in tuning["points"]
                if (point["point"]["function"], point["point"]["payload"]) == (function, payload)
            ]
            if group:
                rows.append([words(function), load_name(payload), *_group_cells(rig, group)])
    note = (
        "ζ is that of the least damped of all poles, valves and washout among them. "
        "K_o holds the off-side chamber's pressure; without any feedback it is off as well."
    )
    return Grid(head, rows, note, "operating_points", "Operating points.")


def _group_cells(rig: Rig, group: Sequence[Table]) -> list[Cell]:
    """What the operating points of one function and payload come to."""

    def spanned(name: str, values: Sequence[float]) -> Cell:
        return num(span([float(shown(rig, name, value)) for value in values]))

    margins = [item["margins"] for item in group]
    phases = [margin.get("phase_margin") for margin in margins]
    return [
        num(str(len(group))),
        chip("counts" if any(item["counts"] for item in group) else "shown only"),
        spanned("mass", [item["point"]["mass"] for item in group]),
        spanned("force", [item["point"]["gravity_force"] for item in group]),
        spanned("natural_frequency", [item["natural_frequency_open"] for item in group]),
        num(span([item["damping_ratio_open"] for item in group], 2)),
        num(span([item["damping_ratio_held"] for item in group], 2)),
        num(span([item["damping_ratio_closed"] for item in group], 2)),
        num(_least([margin.get("gain_margin") for margin in margins])),
        num(_least([None if v is None else float(shown(rig, "phase_margin", v)) for v in phases])),
    ]


def _least(values: Sequence[float | None], digits: int = 3) -> str:
    known = [value for value in values if value is not None]
    return number(min(known), digits) if known else DASH


def _point_head(rig: Rig) -> list[str]:
    return [
        "function",
        "payload",
        axis(rig, "x", "stroke"),
        axis(rig, "v", "speed"),
        axis(rig, "mass", "m_eq"),
        axis(rig, "force", "F_eq"),
        axis(rig, "damping", "b_eq"),
        axis(rig, "p_head", "head-end pressure"),
        axis(rig, "p_rod", "rod-end pressure"),
        axis(rig, "natural_frequency", "fₙ open"),
        "ζ open",
        "ζ with K_o alone",
        axis(rig, "natural_frequency", "fₙ closed"),
        "ζ closed",
        "ζ without washout",
        axis(rig, "v", "speed lost without washout"),
        axis(rig, "feedback_gain", "stable up to K_p"),
        "in the choice",
    ]


def _point_row(rig: Rig, item: Table) -> list[Cell | str]:
    point, limit = item["point"], item.get("gain_limit")
    stable = "none found"
    if limit is not None:
        stable = number(float(shown(rig, "feedback_gain", limit)), 3)
    return [
        words(point["function"]),
        load_name(point["payload"]),
        quantity_cell(rig, "x", point["x"]),
        quantity_cell(rig, "v", point["v"], 3),
        quantity_cell(rig, "mass", point["mass"]),
        quantity_cell(rig, "force", point["gravity_force"]),
        quantity_cell(rig, "damping", point["damping"]),
        quantity_cell(rig, "p_head", point["p_head"]),
        quantity_cell(rig, "p_rod", point["p_rod"]),
        quantity_cell(rig, "natural_frequency", item["natural_frequency_open"], 3),
        num(number(item["damping_ratio_open"], 2)),
        num(number(item["damping_ratio_held"], 2)),
        quantity_cell(rig, "natural_frequency", item["natural_frequency_closed"], 3),
        num(number(item["damping_ratio_closed"], 2)),
        num(number(item.get("damping_ratio_plain"), 2)),
        quantity_cell(rig, "v", item.get("bias"), 2),
        num(stable),
        chip("counts" if item["counts"] else "shown only"),
    ]


def _parameters(rig: Rig, tuning: Table) -> Grid:
    """Controller parameters (thesis Table B.3), then what was demanded and what is reached at
    worst.
    """
    gains = tuning["feedback_gain"]
    if len(set(gains.values())) == 1:
        gains = {"all functions": next(iter(gains.values()))}
    given = [("feedback_gain", f"feedback gain K_p, {words(name)}", gains[name]) for name in gains]
    crossed = any("regeneration" in function for function in tuning["feedback_gain"])
    needless = {"ramp_washout": not tuning.get("ramp_washout"), "cross_drop": not crossed}
    given += [(name, text, tuning[key]) for name, key, text in _PARAMETERS if not needless.get(key)]
    rows: list[list[Cell | str]] = [
        [text, quantity_cell(rig, name, value), pretty(unit_of(rig, name)), "", ""]
        for name, text, value in given
    ]
    target, reached = (
        num(f"≥ {number(tuning['target'], 3)}"),
        num(number(tuning["damping_ratio"], 3)),
    )
    rows.append(["damping ratio", "", "", target, reached])
    points = counted(tuning)
    rows += [
        _demand_row(rig, points, key, constraint)
        for key, constraint in tuning["constraints"].items()
    ]
    head = ["", "value", "unit", "demanded", "reached at worst"]
    return Grid(head, rows, "", "controller_parameters", "Controller parameters.")


def _demand_row(rig: Rig, points: Sequence[Table], key: str, least: float) -> list[Cell | str]:
    unit = "natural_frequency" if key == "bandwidth" else key
    reached = [value for point in points if (value := point["margins"].get(key)) is not None]
    return [
        words(key),
        "",
        pretty(unit_of(rig, unit)),
        num(f"≥ {number(float(shown(rig, unit, least)), 3)}"),
        quantity_cell(rig, unit, min(reached), 3) if reached else "none found",
    ]


def _alternatives(rig: Rig, tuning: Table) -> list[Block]:
    laws = tuning["alternatives"]
    if not laws:
        return []
    first, *others = laws
    better = [other["what"] for other in others if other["damping_ratio"] > first["damping_ratio"]]
    text = "None of them beats the chosen law by this number."
    if better:
        text = f"Better than the chosen law by this number: {', '.join(better)}."
    second = ["ramp_washout"] if any(law.get("ramp_washout") for law in laws) else []
    head = [
        "law",
        "fed back",
        axis(rig, "washout", "washout"),
        *(axis(rig, name, "second washout") for name in second),
        axis(rig, "off_gain", "K_o"),
        axis(rig, "feedback_gain", "its best K_p"),
        "worst ζ",
    ]
    names = ("washout", *second, "off_gain", "feedback_gain")
    rows = [_law_row(rig, law, names) for law in laws]
    note = "Each law at its own best gain, without the demands on margins and bandwidth."
    return [Text(text), Grid(head, rows, note, "alternatives", "Other laws.")]


def _law_row(rig: Rig, item: Table, names: Sequence[str]) -> list[Cell | str]:
    return [
        item["what"],
        words(item["feedback"]) + (" chamber" if item["feedback"] == "metered" else ""),
        *(quantity_cell(rig, name, item[name], 3) for name in names),
        num(number(item["damping_ratio"], 2)),
    ]


def _draws(tuning: Table, pictures: Pictures) -> list[Block]:
    draws = tuning["robustness"]
    if not draws["draws"]:
        return [Text("No draws were made.", "note")]
    names = [[Cell(name, "code")] for name in draws["parameters"]]
    drawn = Fold(count(len(names), "parameter"), [Grid(["drawn, with their covariance"], names)])
    return [*pictures(FigureKey("draws")), drawn]


REPORT = StageReport(
    "tuning",
    section,
    draw,
    shows=("The gain",),
    numbers=(
        "tuning.json",
        ("met", "feedback_gain", "washout", "damping_ratio", "damping_ratio_open"),
    ),
)
