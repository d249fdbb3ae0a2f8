"""Tables of trials under a controller: steps of speed, tracking with energy, limits met,
settings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from ehbench.config.rig import Rig
from ehbench.report.blocks import Block, Cell, Fold, Grid, Text
from ehbench.report.captions import (
    capital,
    error_of,
    load_name,
    measure,
    percent,
    range_in,
    ranged,
    span,
)
from ehbench.report.cases import Case, damping, groups_of
from ehbench.report.content import chip, num, quantity_cell
from ehbench.report.saved import Table
from ehbench.report.words import (
    DASH,
    axis,
    number,
    pretty,
    row_of,
    shown,
    symbol_of,
    unit_of,
    words,
)
from ehbench.vocabulary.codes import LIMITS_MEAN, STATUS_MEANS

MEANS = 10.0  # times the errors seen: a guaranteed bound beyond that says nothing
STANDS = 1e-3  # share of the speed asked that counts as standing still


def measure_tables(rig: Rig, cases: Sequence[Case]) -> list[Block]:
    """Steps of speed, tracking with energy, and limits met; each only where it has rows."""
    tables: list[Block] = []
    if any(case.steps for case in cases):
        tables.append(_steps(rig, cases))
    tables.append(_tracking(rig, cases))
    if limits := _limits(cases):
        tables.append(limits)
    return [*tables, *_maps(rig, cases), *_guaranteed(rig, cases)]


def who(case: Case) -> list[Cell | str]:
    """The cells that say which trial a row is of."""
    return [
        load_name(case.row["payload"]),
        words(case.row["motion"]) or DASH,
        words(case.row["controller"]),
    ]


WHO = ("payload", "motion", "controller")


def _ordered(cases: Sequence[Case]) -> list[Case]:
    return [case for group in groups_of(cases).values() for case in group]


def _steps(rig: Rig, cases: Sequence[Case]) -> Grid:
    steps = [(case, step) for case in _ordered(cases) for step in case.steps]
    doubts = list(dict.fromkeys(doubt for _, item in steps if (doubt := damping(item)[1])))
    head = [
        *WHO,
        axis(rig, "v", "asked"),
        axis(rig, "v", "steady"),
        "steady error [%]",
        "overshoot [%]",
        axis(rig, "t", "settling time"),
        axis(rig, "v", "rms error"),
        "damping ratio",
        axis(rig, "natural_frequency", "fₙ"),
        axis(rig, "energy", "pump energy of the trial"),
    ]
    note = (
        "Overshoot beyond the steady speed; settled within 5 %; "
        "damping ratio and fₙ from the decay."
    )
    if doubts:
        reasons = "; ".join(f"({i}) {doubt}" for i, doubt in enumerate(doubts, 1))
        note += f" No damping ratio, or a rough one: {reasons}."
    rows = [_step_row(rig, case, at, doubts) for case in _ordered(cases) for at in _numbers(case)]
    note += runs_note(cases)
    return Grid(head, rows, note, "steps", "Steps of speed.")


def _numbers(case: Case) -> range:
    return range(len(case.steps))


def _step_row(rig: Rig, case: Case, at: int, doubts: Sequence[str]) -> list[Cell | str]:
    item = case.steps[at]
    stands = abs(1.0 + item["steady_error"]) <= STANDS
    ratio, doubt = damping(item)
    mark = f" ({doubts.index(doubt) + 1})" if doubt else ""
    fitted = "damping_ratio_fitted" if "damping_ratio_fitted" in item else "damping_ratio"

    def cell(key: str, text_of: Callable[[float | None], str]) -> str:
        return ranged(text_of, item.get(key), range_in(case.row, "steps", at, key))

    def share(value: float | None) -> str:
        return number(None if value is None else 100.0 * value, 2)

    return [
        *who(case),
        quantity_cell(rig, "v", item["speed"], 3),
        num("0" if stands else cell("steady_speed", _telling(rig, "v", 3))),
        num(cell("steady_error", share)),
        num(cell("overshoot", share)),
        num(cell("settling_time", _telling(rig, "t", 2)))
        if item.get("settling_time") is not None
        else "not settled",
        num(cell("rms_error", _telling(rig, "v", 3))),
        num(ranged(_ratio, ratio, range_in(case.row, "steps", at, fitted)) + mark),
        num(cell("natural_frequency", _telling(rig, "natural_frequency", 2))),
        _energy_cell(rig, case, "pump"),
    ]


def _ratio(value: float | None) -> str:
    return number(value, 2)


def _telling(rig: Rig, name: str, digits: int) -> Callable[[float | None], str]:
    """What writes an SI number of a quantity in the rig's unit."""
    return lambda value: number(None if value is None else float(shown(rig, name, value)), digits)


def _energy_cell(rig: Rig, case: Case, key: str) -> Cell:
    value, ends = case.row["energy"][key], range_in(case.row, "energy", key)
    return num(ranged(_telling(rig, "energy", 4), value, ends))


def rail_cell(rig: Rig, case: Case) -> Cell | str:
    """What of a trial's pump energy the low rail gave, where it has one."""
    return _energy_cell(rig, case, "low_rail") if "low_rail" in case.row["energy"] else DASH


def runs_note(cases: Sequence[Case]) -> str:
    """That the numbers are of several runs, where they are."""
    runs = {case.row.get("seeds", 1) for case in cases} - {1}
    if not runs:
        return ""
    return (
        f" Medians of {', '.join(map(str, sorted(runs)))} runs with other noise of the sensors, "
        "in brackets the least and the largest."
    )


def _tracking(rig: Rig, cases: Sequence[Case]) -> Grid:
    groups = groups_of(cases)
    several = any(len(group) > 1 for group in groups.values())
    swings = any(case.row.get("limit_cycle") for case in cases)
    true = any(case.row.get("tracking_true") for case in cases)
    tips = any(case.row.get("tip") for case in cases)
    rails = any("low_rail" in case.row["energy"] for case in cases)
    shown_of = _Columns(swings, tips, true, rails)
    head = [
        *WHO,
        *([axis(rig, "tip_error", f"{word} tip error") for word in ("largest", "rms")] * tips),
        axis(rig, "x", "largest error"),
        axis(rig, "x", "rms error"),
        axis(rig, "x", "final error"),
        *([axis(rig, "x", "largest true error"), axis(rig, "x", "rms true error")] if true else []),
        *([axis(rig, "x", "swings by ±"), axis(rig, "t", "its period")] if swings else []),
        axis(rig, "v", "rms error of speed"),
        axis(rig, "energy", "pump energy"),
        *([axis(rig, "energy", "of it low rail")] if rails else []),
        *(["relative to the least"] if several else []),
        axis(rig, "energy", "cylinder work"),
        "",
    ]
    rows = [
        _tracking_row(rig, case, group if several else [], shown_of)
        for group in groups.values()
        for case in group
    ]
    sources = "; ".join(dict.fromkeys(case.row["energy"]["source"] for case in cases))
    note = f"Stroke against the desired stroke. Pump energy: {sources}." + valves_note(rig, cases)
    if true:
        note += (
            " True: of the stroke as it is, which only the virtual bench knows and no log holds."
        )
    note += runs_note(cases)
    if swings:
        note += " What swings without an end does so by itself: a limit cycle."
    return Grid(head, rows, note, "tracking", "Tracking and energy.")


class _Columns(NamedTuple):
    """What some trial of a table has: a limit cycle, a tip's error, errors of the true stroke, a
    low rail.
    """

    swings: bool
    tips: bool
    true: bool
    rails: bool


def _tracking_row(
    rig: Rig, case: Case, rivals: Sequence[Case], columns: _Columns
) -> list[Cell | str]:
    """A trial's row; its energy relative to the least of its rivals, itself among them, where there
    are any; what only some trials have where ``columns`` say so.
    """
    row, pump = case.row, case.row["energy"]["pump"]
    known = bool(row.get("tracking_true"))
    errors = [error_of(rig, row, "tracking", f"{key}_error") for key in ("max", "rms", "final")]
    if columns.true:
        errors += [
            error_of(rig, row, "tracking_true", f"{key}_error") if known else DASH
            for key in ("max", "rms")
        ]
    relative = []
    if rivals:
        minimum = min((rival.row["energy"]["pump"] for rival in rivals if rival.fit), default=0.0)
        ratio = number(pump / minimum, 3) if case.fit and minimum > 0.0 else DASH
        relative = [num(ratio)]
    return [
        *who(case),
        *(_tip_cells(rig, case) if columns.tips else []),
        *map(num, errors),
        *(_cycle_cells(rig, case) if columns.swings else []),
        num(
            ranged(_telling(rig, "v", 3), row["speed_rms_error"], range_in(row, "speed_rms_error"))
        ),
        _energy_cell(rig, case, "pump"),
        *([rail_cell(rig, case)] if columns.rails else []),
        *relative,
        _energy_cell(rig, case, "cylinder_work"),
        chip("stopped") if case.row.get("stopped") else "",
    ]


def _tip_cells(rig: Rig, case: Case) -> list[Cell | str]:
    """Largest and rms error of a trial's tip."""
    tip = case.row.get("tip")
    if not tip:
        return [DASH, DASH]
    return [quantity_cell(rig, "tip_error", tip[key], 3) for key in ("max_error", "rms_error")]


def valves_note(rig: Rig, cases: Sequence[Case]) -> str:
    """How fast each controller's valves are, where they are not equally fast."""
    speeds: dict[str, list[str]] = {}
    for case in cases:
        if ends := case.row.get("valves", {}).get("natural_frequency"):
            speed_text = span([float(shown(rig, "natural_frequency", end)) for end in ends])
            names = speeds.setdefault(speed_text, [])
            names += [words(case.row["controller"])] * (words(case.row["controller"]) not in names)
    if len(speeds) < 2:
        return ""
    unit = pretty(unit_of(rig, "natural_frequency"))
    speed_text = "; ".join(f"{speed} {unit}: {', '.join(names)}" for speed, names in speeds.items())
    return (
        f" Natural frequency of the valves: {speed_text}. "
        "Errors at unlike frequencies compare valves, not laws or circuits."
    )


def _cycle_cells(rig: Rig, case: Case) -> list[Cell | str]:
    """Amplitude and period of a trial's limit cycle."""
    cycle = case.row.get("limit_cycle")
    if not cycle:
        return [DASH, DASH]
    return [
        quantity_cell(rig, "x", cycle["amplitude"], 2),
        quantity_cell(rig, "t", cycle["period"], 2),
    ]


def limits_of(row: Table) -> dict[str, float]:
    """Shares of the time at the limits of the valve level, and without a function that can move the
    load.
    """
    functions = row.get("functions", {})
    return dict(row.get("limits", {})) | {
        name: functions[name] for name in STATUS_MEANS if name in functions
    }


def _limits(cases: Sequence[Case]) -> Grid | None:
    means = LIMITS_MEAN | STATUS_MEANS
    shares = [(case, limits_of(case.row)) for case in _ordered(cases)]
    met = dict.fromkeys(name for _, item in shares for name, share in item.items() if share > 0.0)
    if not met:
        return None
    rows = [
        [*who(case), *(num(number(100.0 * limits.get(name, 0.0), 2)) for name in met)]
        for case, limits in shares
    ]
    head = [*WHO, *(f"{words(name)} [%]" for name in met)]
    means_text = "; ".join(f"{words(name)}: {means[name]}" for name in met if name in means)
    note = f"Share of the time at a limit. {capital(means_text)}."
    return Grid(head, rows, note, "limits", "Limits met.")


def _maps(rig: Rig, cases: Sequence[Case]) -> list[Block]:
    """How flow maps were corrected in motion, beside the truth where the machine tells it; folded
    away where there are several trials.
    """
    results = [
        (case, edge, item) for case in cases for edge, item in case.row.get("maps", {}).items()
    ]
    if not results:
        return []
    several = len(cases) > 1
    volt = pretty(unit_of(rig, "map_shift"))
    head = [
        *(WHO if several else ()),
        "edge",
        "gain",
        "true gain",
        f"shift of the deadband [{volt}]",
        f"true shift [{volt}]",
        "largest error of the map [%]",
        "after correction [%]",
    ]
    rows: list[list[Cell | str]] = []
    for case, edge, item in results:
        shifts = (item.get(key) for key in ("shift", "true_shift"))
        shift, true = (None if v is None else float(shown(rig, "map_shift", v)) for v in shifts)
        errors = (item.get(f"error_{when}") for when in ("before", "after"))
        shares = (num(number(None if v is None else 100.0 * v, 2)) for v in errors)
        rows.append(
            [
                *(who(case) if several else ()),
                words(edge.partition(".")[2]),
                num(number(item["gain"], 3)),
                num(number(item.get("true_gain"), 3)),
                num(number(shift, 2)),
                num(number(true, 2)),
                *shares,
            ]
        )
    note = (
        "What an edge passes is gain × its map at the command less the shift. The truth fits what "
        "the machine's own edge passes at rest, where the trial used it; errors are shares of the "
        "largest flow there."
    )
    grid = Grid(head, rows, note, "maps", "Corrections of the flow maps.")
    return [Fold("Corrections of the flow maps", [grid])] if several else [grid]


def _guaranteed(rig: Rig, cases: Sequence[Case]) -> list[Block]:
    """What the transient of an adaptive law is guaranteed to stay within, against what was seen."""
    known = [case for case in cases if case.row.get("guaranteed")]
    if not known:
        return []
    seen = [case.row["tracking"]["max_error"] for case in known]
    bounds = [case.row["guaranteed"]["stroke"] for case in known]
    ratios = [bound / item for bound, item in zip(bounds, seen, strict=True) if item > 0.0]
    if not ratios:
        return []
    worst = max(known, key=lambda case: case.row["guaranteed"]["acceleration"]).row
    unsure = measure(rig, "acceleration", worst["guaranteed"]["acceleration"], 2)
    maximum = measure(rig, "x", max(bounds), 3)
    text = (
        "Whatever the estimates do inside of their bounds, the law guarantees a stroke error of at "
        f"most {maximum} after the transient; the largest errors seen are "
        f"{span([float(shown(rig, 'x', item)) for item in seen], 2)} {pretty(unit_of(rig, 'x'))}, "
        f"{span(ratios, 2)} times less. "
    )
    if max(ratios) <= MEANS:
        return [Text(text + "The bound is within ten times of what was seen.")]
    share = percent(worst["gains"]["robust_limit"])
    text += (
        "The bound is vacuous: it is made for payload, inertia and disturbance at the worst corner "
        f"of their bounds at once, which leaves {unsure} open, and the lag of the valves lets "
        f"the robust terms add no more than {share} to the gains that hold it down."
    )
    return [Text(text)]


def settings_blocks(rig: Rig, cases: Sequence[Case]) -> list[Block]:
    """Gains really used (thesis Tables B.3, C.1, C.3); motions and controllers as the recipe has
    them (Table B.2).
    """
    if not cases:
        return []
    recipe = _recipe_of(cases[0])
    blocks: list[Block] = []
    if motions := _recipe_rows(recipe, "motion"):
        blocks.append(_recipe_table(motions, "settings_motion", "Trajectories."))
    gains = _by_controller(rig, cases, "gains")
    if gains:
        note = "As they were designed, defaults and what follows from them included."
        blocks.append(Grid(*gains, note, "settings_controller", "Gains."))
    if eased := _by_controller(rig, cases, "gains_under_load"):
        blocks.append(Grid(*eased, _eased_note(rig, cases), "settings_eased", "Gains under load."))
    if bounds := _by_controller(rig, cases, "estimate_bounds"):
        note, title = "The estimates are projected onto these.", "Bounds of the estimates."
        blocks.append(Grid(*bounds, note, "estimate_bounds", title))
    if valves := _by_controller(rig, cases, "valves"):
        note = "Of the slowest and the fastest valve of the cylinder."
        blocks.append(Grid(*valves, note, "settings_valves", "Valves."))
    if rules := _by_controller(rig, cases, "rules"):
        blocks.append(Fold("Rules by which working functions are chosen", [Grid(*rules)]))
    if controllers := _recipe_rows(recipe, "controller"):
        if gains:
            table = _recipe_table(controllers)
            blocks.append(Fold("Controllers as the recipe has them", [table]))
        else:
            blocks.append(_recipe_table(controllers, "settings_controller", "Controllers."))
    return blocks


def _eased_note(rig: Rig, cases: Sequence[Case]) -> str:
    """Under which load the bandwidths went down, and how far."""
    known = [case.row["eased"] for case in cases if case.row.get("eased")]
    shares = span([100.0 * item["share"] for item in known], 3)
    loads = span([float(shown(rig, "payload_estimate", item["payload"])) for item in known], 3)
    unit = pretty(unit_of(rig, "payload_estimate"))
    return (
        f"What of the design was in force while the payload, as the law estimated it, was largest: "
        f"{loads} {unit}. The bandwidths then went down to {shares} % of the design's."
    )


def _recipe_of(case: Case) -> dict[str, Any]:
    """The recipe that a trial's log holds; empty where it holds none."""
    import tomllib

    text = case.record().attachments.get("recipe.toml")
    return tomllib.loads(text.decode("utf-8")) if text else {}


def _recipe_rows(recipe: Mapping[str, Any], key: str) -> list[list[Cell | str]]:
    """The entries of a table or a list of tables, each under its name."""
    entries = recipe.get(key, [])
    rows: list[list[Cell | str]] = []
    for entry in entries if isinstance(entries, list) else [entries]:
        name = entry.get("name") or entry.get("kind") or entry.get("class", "")
        rows.append([Cell(f"{key}: {name}", "name"), ""])
        for field, value in entry.items():
            if field != "name":
                rows.append([Cell(field, "code"), Cell(_plain(value), "code")])
    return rows


def _recipe_table(rows: Sequence[Sequence[Cell | str]], key: str = "", title: str = "") -> Grid:
    note = "What is not named has its default."
    return Grid(["", "as the recipe has it"], rows, note, key, title)


def _by_controller(
    rig: Rig, cases: Sequence[Case], key: str
) -> tuple[list[str], list[list[Cell | str]]] | None:
    """(head, rows) of the numbers by name that trials hold under ``key``, a column a controller;
    None where none has any.
    """
    tables: dict[str, list[Table]] = {}
    for case in cases:
        if len(case.row.get(key, {})):
            tables.setdefault(case.row["controller"], []).append(case.row[key])
    names = dict.fromkeys(name for item in tables.values() for table in item for name in table)
    rows: list[list[Cell | str]] = []
    for name in names:
        of, _, word = name.rpartition(".")
        row = row_of(name)
        cells = [
            _values(rig, name, [table[name] for table in item if name in table])
            for item in tables.values()
        ]
        meaning = f"{words(of)}: {row.meaning}" if of else row.meaning
        rows.append(
            [Cell(symbol_of(rig, word), "name"), meaning, *cells, pretty(unit_of(rig, word))]
        )
    return (["", "", *(words(name) for name in tables), "unit"], rows) if rows else None


def _values(rig: Rig, name: str, values: Sequence[Any]) -> Cell:
    """A number that a controller had in all trials, or from the least to the largest; a pair of
    bounds as ``low … high``.
    """
    if not values:
        return num(DASH)
    lows, highs = zip(
        *(value if isinstance(value, list) else (value, value) for value in values), strict=True
    )
    low, high = (span([float(shown(rig, name, end)) for end in ends]) for ends in (lows, highs))
    return num(low if lows == highs else f"{low} … {high}")


def _plain(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} = {_plain(item)}" for name, item in value.items())
    if isinstance(value, list):
        return ", ".join(_plain(item) for item in value)
    return (
        {True: "yes", False: "no"}.get(value, str(value)) if isinstance(value, bool) else str(value)
    )
