"""Tables of trials under a controller: measures, corrected maps, settings."""

import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

from ehbench.config.rig import Rig
from ehbench.report.blocks import Block, Cell, Fold, Grid, Text
from ehbench.report.cases import Case, by_controller, damping, groups_of, limits_of
from ehbench.report.content import num
from ehbench.report.template import Template
from ehbench.report.words import DASH, pretty, row_of, shown, span, symbol_of, unit_of, words
from ehbench.vocabulary.codes import LIMITS_MEAN, STATUS_MEANS


def measure_tables(rig: Rig, cases: Sequence[Case]) -> list[Block]:
    """Steps, tracking and energy, limits, corrected maps, guarantees; those with rows."""
    page = Template("trial", rig)
    ordered = [case for group in groups_of(cases).values() for case in group]
    runs = page.text("runs", runs=sorted({case.row.get("seeds", 1) for case in cases} - {1}))
    tables: list[Block] = []
    if any(case.steps for case in cases):
        tables.append(_steps_table(page, ordered, runs))
    groups = groups_of(ordered)

    def relative(case: Case) -> float | None:
        """The energy of a trial over the least of its rivals."""
        rivals = groups[case.row["payload"], case.row["motion"], case.cylinder]
        known = [pump for rival in rivals if rival.fit and (pump := rival.row["energy"]["pump"])]
        own = case.row["energy"]["pump"]
        return own / min(known) if case.fit and own and min(known) > 0.0 else None

    tables.append(
        page.table(
            "tracking",
            ordered,
            several=any(len(group) > 1 for group in groups.values()),
            swings=any(case.row.get("limit_cycle") for case in ordered),
            truth=any(case.row.get("tracking_true") for case in ordered),
            tips=any(case.row.get("tip") for case in ordered),
            rails=any("low_rail" in case.row["energy"] for case in ordered),
            relative=relative,
            sources=list(dict.fromkeys(case.row["energy"]["source"] for case in ordered)),
            valves=valves_note(rig, ordered),
            runs=runs,
        )
    )
    shares = [share for case in ordered for share in limits_of(case.row).items()]
    if met := list(dict.fromkeys(name for name, share in shares if share > 0.0)):
        means = LIMITS_MEAN | STATUS_MEANS
        tables.append(page.table("limits", ordered, met=met, means=means, limits_of=limits_of))
    rows = [
        {"case": case, "edge": edge.partition(".")[2], "item": item}
        for case in cases
        for edge, item in case.row.get("maps", {}).items()
    ]
    if rows:
        grid = page.table("maps", rows, several=len(cases) > 1)
        tables.append(Fold(grid.title.rstrip("."), [grid]) if len(cases) > 1 else grid)
    known = [case.row for case in cases if case.row.get("guaranteed")]
    pairs = [(row["guaranteed"]["stroke"], row["tracking"]["max_error"]) for row in known]
    if ratios := [bound / seen for bound, seen in pairs if seen > 0.0]:
        bounds, seen = (list(values) for values in zip(*pairs, strict=True))
        worst = max(known, key=lambda row: row["guaranteed"]["acceleration"])
        fields = {"bounds": bounds, "seen": seen, "ratios": ratios, "worst": worst}
        tables.append(Text(page.text("guaranteed", **fields, limit=10.0)))
    return tables


def _steps_table(page: Template, cases: Sequence[Case], runs: str) -> Grid:
    """A row a step; one that misses less than 0.1 % of its speed to stand still, stands."""
    doubts = dict.fromkeys(doubt for case in cases for s in case.steps if (doubt := damping(s)[1]))
    places = {doubt: place for place, doubt in enumerate(doubts, 1)}
    rows = [
        {
            "case": case,
            "step": step,
            "place": place,
            "stands": abs(1.0 + step["steady_error"]) <= 1e-3,
            "ratio": "damping_ratio_fitted" if "damping_ratio_fitted" in step else "damping_ratio",
            "mark": f" ({places[step['ringing']]})" if step["ringing"] else "",
        }
        for case in cases
        for place, step in enumerate(case.steps)
    ]
    return page.table("steps", rows, doubts=list(doubts), runs=runs)


def valves_note(rig: Rig, cases: Sequence[Case]) -> str:
    """How fast each controller's valves are, where they are not equally fast."""
    speeds: dict[str, list[str]] = {}
    for case in cases:
        if ends := case.row.get("valves", {}).get("natural_frequency"):
            speed = span([shown(rig, "natural_frequency", end) for end in ends])
            names, name = speeds.setdefault(speed, []), words(case.row["controller"])
            names += [name] * (name not in names)
    return Template("trial", rig).text("valves", speeds=speeds)


def settings_blocks(rig: Rig, cases: Sequence[Case]) -> list[Block]:
    """Gains in use (thesis Tables B.3, C.1, C.3), motions (B.2) and controllers as written."""
    if not cases:
        return []
    page, text = Template("trial", rig), cases[0].record().attachments.get("recipe.toml", b"")
    recipe = tomllib.loads(text.decode("utf-8"))
    blocks: list[Block] = []
    recipe_head, recipe_note = ["", "as the recipe has it"], page.text("recipe_note")
    if motions := _recipe_rows(recipe, "motion"):
        key, title = "settings_motion", "Trajectories."
        blocks.append(Grid(recipe_head, motions, recipe_note, key, title))
    eased = [case.row["eased"] for case in cases if case.row.get("eased")]
    shares = [100.0 * item["share"] for item in eased]
    for name, note, key, title in (
        ("gains", "gains_note", "settings_controller", "Gains."),
        ("gains_under_load", "eased_note", "settings_eased", "Gains under load."),
        ("estimate_bounds", "bounds_note", "estimate_bounds", "Bounds of the estimates."),
        ("valves", "valves_note", "settings_valves", "Valves."),
    ):
        if table := _by_controller(rig, cases, name):
            text = page.text(note, eased=eased, shares=shares)
            blocks.append(Grid(*table, text, key, title))
    if rules := _by_controller(rig, cases, "rules"):
        blocks.append(Fold("Rules by which working functions are chosen", [Grid(*rules)]))
    if controllers := _recipe_rows(recipe, "controller"):
        if any(isinstance(block, Grid) and block.key == "settings_controller" for block in blocks):
            table = Grid(recipe_head, controllers, recipe_note)
            blocks.append(Fold("Controllers as the recipe has them", [table]))
        else:
            key, title = "settings_controller", "Controllers."
            blocks.append(Grid(recipe_head, controllers, recipe_note, key, title))
    return blocks


def _recipe_rows(recipe: Mapping[str, Any], key: str) -> list[list[Cell | str]]:
    """The entries of a table or a list of tables, each under its name."""
    entries = recipe.get(key, [])
    rows: list[list[Cell | str]] = []
    for entry in entries if isinstance(entries, list) else [entries]:
        name = entry.get("name") or entry.get("kind") or entry.get("class", "")
        rows.append([Cell(f"{key}: {name}", "name"), ""])
        for field, value in entry.items():
            if field != "name":
                rows.append([Cell(field, "code"), Cell(_toml_text(value), "code")])
    return rows


def _by_controller(
    rig: Rig, cases: Sequence[Case], key: str
) -> tuple[list[str], list[list[Cell | str]]] | None:
    """(head, rows) of the numbers under ``key``, a column a controller; None without."""
    known = by_controller([case for case in cases if len(case.row.get(key, {}))])
    tables = {name: [case.row[key] for case in group] for name, group in known.items()}
    names = dict.fromkeys(name for item in tables.values() for table in item for name in table)
    rows: list[list[Cell | str]] = []
    for name in names:
        of, _, word = name.rpartition(".")
        row = row_of(name)
        cells = []
        for item in tables.values():
            values = [table[name] for table in item if name in table]
            pairs = [value if isinstance(value, list) else (value, value) for value in values]
            # over all trials; a pair as ``low … high``
            spans = [span([shown(rig, name, e) for e in ends]) for ends in zip(*pairs, strict=True)]
            cells.append(num(" … ".join(dict.fromkeys(spans)) or DASH))
        meaning = f"{words(of)}: {row.meaning}" if of else row.meaning
        unit = pretty(unit_of(rig, word))
        rows.append([Cell(symbol_of(rig, word), "name"), meaning, *cells, unit])
    return (["", "", *(words(name) for name in tables), "unit"], rows) if rows else None


def _toml_text(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} = {_toml_text(item)}" for name, item in value.items())
    if isinstance(value, list):
        return ", ".join(_toml_text(item) for item in value)
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value)
