"""Sections of tunings and of trials under a controller."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ehbench.report.blocks import Bullets, Cell, Fold, Grid, Part, Text
from ehbench.report.energy_tables import saving_blocks, who
from ehbench.report.saved import Saved, Table
from ehbench.report.telling import Pictures, Told, capital, chip, num, span
from ehbench.report.trial_figures import (
    Case,
    case_said,
    cases_of,
    damping,
    groups_of,
    percent,
    tracking_said,
)
from ehbench.report.tuning_figures import counted, function_names, load_name, measure, payloads_of
from ehbench.report.words import DASH, axis, count, number, pretty, row_of, shown, unit_of, words
from ehbench.rig import Rig


def _in(rig: Rig, name: str, value: float | None, digits: int = 4) -> Cell:
    """An SI number in the rig's unit, as a cell."""
    return num(number(None if value is None else float(shown(rig, name, value)), digits))


def _endless(value: float | None, digits: int = 3) -> str:
    """A margin or limit: null stands for one that was not found."""
    return "none found" if value is None else number(value, digits)


def _folded(found: Sequence[Any], what: str) -> list[Any]:
    return [Fold(f"{count(len(found), 'figure')}: {what}", found)] if found else []


# --- tune
# -----------------------------------------------------------------------------------------------------------------


def tune(run: Saved, pictures: Pictures) -> Told:
    """Equivalent mass and gravity, operating points, gains and what they promise, loci, steps, what
    else was tried, draws.
    """
    rig, tuning = run.rig, run.json("tuning.json")
    points, met = counted(tuning), tuning["met"]
    choice: list[Any] = [
        Text(
            f"Target and demands are {'' if met else 'not '}met at all operating points that count.",
            "good" if met else "bad",
        ),
        *pictures("damping", "", ""),
        _parameters(rig, tuning),
    ]
    parts = [
        Part("Equivalent mass and gravity force", pictures("equivalents", "", "")),
        Part("Operating points", _operating_points(rig, tuning)),
        Part("The gain", choice),
        Part("Root loci", _by_count(pictures, "locus")),
        Part("Step responses", _by_count(pictures, "step_response")),
        Part("What else was tried", _alternatives(rig, tuning)),
        Part("Draws of the identified parameters", _draws(tuning, pictures)),
    ]
    gains = sorted(set(tuning["feedback_gain"].values()))
    corners = [tuning[key] for key in ("washout", "ramp_washout") if tuning.get(key)]
    said = " and ".join(dict.fromkeys(measure(rig, "washout", corner) for corner in corners))
    washout = (
        f"{'two washouts' if len(corners) > 1 else 'washout'} {said}" if corners else "no washout"
    )
    lead = "One gain" if len(gains) == 1 else f"{len(gains)} gains"
    sentence = (
        f"{lead} K_p = {span([float(shown(rig, 'feedback_gain', g)) for g in gains])} {pretty(unit_of(rig, 'feedback_gain'))}"
        f", {washout}: worst damping ratio {number(tuning['damping_ratio'], 2)} over "
        f"{count(len(points), 'operating point')} of {words(tuning['cylinder'])}, without feedback "
        f"{span([tuning['damping_ratio_open'], tuning['damping_ratio_open_most']], 2)}; target {number(tuning['target'], 2)}"
    )
    found = tuning["robustness"]
    sentence += (
        f", reached by {percent(found['share'], 3)} of {found['draws']} draws."
        if found["draws"]
        else "."
    )
    return Told("met" if met else "missed", sentence, parts)


def _by_count(pictures: Pictures, kind: str) -> list[Any]:
    """Figures of the functions that count and those that a campaign names; the others folded."""
    rest = {picture.id for picture in pictures("", "counts", "no") if not picture.named}
    found = pictures(kind, "", "")
    folded = [picture for picture in found if picture.id in rest]
    return [
        *(picture for picture in found if picture.id not in rest),
        *_folded(folded, "functions that no load calls for"),
    ]


def _operating_points(rig: Rig, tuning: Table) -> list[Any]:
    """A row a function and payload, and every point folded away."""
    points = tuning["points"]
    rows = []
    for function in function_names(tuning):
        for payload in payloads_of(tuning):
            mine = [
                one
                for one in points
                if (one["point"]["function"], one["point"]["payload"]) == (function, payload)
            ]
            if not mine:
                continue
            at = [one["point"] for one in mine]
            gain, phase = (
                [one["margins"].get(key) for one in mine] for key in ("gain_margin", "phase_margin")
            )
            rows.append(
                [
                    words(function),
                    load_name(payload),
                    num(str(len(mine))),
                    chip("counts" if any(one["counts"] for one in mine) else "shown only"),
                    num(span([float(shown(rig, "mass", p["mass"])) for p in at])),
                    num(span([float(shown(rig, "force", p["gravity_force"])) for p in at])),
                    num(
                        span(
                            [
                                float(
                                    shown(rig, "natural_frequency", one["natural_frequency_open"])
                                )
                                for one in mine
                            ]
                        )
                    ),
                    num(span([one["damping_ratio_open"] for one in mine], 2)),
                    num(span([one["damping_ratio_closed"] for one in mine], 2)),
                    num(_least(gain)),
                    num(
                        _least(
                            [
                                None if v is None else float(shown(rig, "phase_margin", v))
                                for v in phase
                            ]
                        )
                    ),
                ]
            )
    head = [
        "function",
        "payload",
        "points",
        "in the choice",
        axis(rig, "mass", "m_eq"),
        axis(rig, "force", "F_eq"),
        axis(rig, "natural_frequency", "ωₙ without feedback"),
        "ζ without feedback",
        "ζ with feedback",
        "least gain margin",
        axis(rig, "phase_margin", "least phase margin"),
    ]
    every = [
        [
            words(one["point"]["function"]),
            load_name(one["point"]["payload"]),
            _in(rig, "x", one["point"]["x"]),
            _in(rig, "v", one["point"]["v"], 3),
            *(
                _in(rig, unit, one["point"][name])
                for name, unit in (
                    ("mass", "mass"),
                    ("gravity_force", "force"),
                    ("damping", "damping"),
                    ("p_head", "p_head"),
                    ("p_rod", "p_rod"),
                )
            ),
            _in(rig, "natural_frequency", one["natural_frequency_open"], 3),
            num(number(one["damping_ratio_open"], 2)),
            _in(rig, "natural_frequency", one["natural_frequency_closed"], 3),
            num(number(one["damping_ratio_closed"], 2)),
            num(number(one.get("damping_ratio_plain"), 2)),
            _in(rig, "v", one.get("bias"), 2),
            num(
                _endless(
                    None
                    if (v := one.get("gain_limit")) is None
                    else float(shown(rig, "feedback_gain", v))
                )
            ),
            chip("counts" if one["counts"] else "shown only"),
        ]
        for one in points
    ]
    heads = [
        "function",
        "payload",
        axis(rig, "x", "stroke"),
        axis(rig, "v", "speed"),
        axis(rig, "mass", "m_eq"),
        axis(rig, "force", "F_eq"),
        axis(rig, "damping", "b_eq"),
        axis(rig, "p_head", "head-end pressure"),
        axis(rig, "p_rod", "rod-end pressure"),
        axis(rig, "natural_frequency", "ωₙ open"),
        "ζ open",
        axis(rig, "natural_frequency", "ωₙ closed"),
        "ζ closed",
        "ζ without washout",
        axis(rig, "v", "speed lost without washout"),
        axis(rig, "feedback_gain", "stable up to K_p"),
        "in the choice",
    ]
    note = "ζ is that of the least damped of all poles, valves and washout among them."
    return [
        Grid(head, rows, note, "operating_points", "Operating points."),
        Fold(
            f"All {count(len(points), 'operating point')}",
            [
                Grid(
                    heads,
                    every,
                    "Speed lost: what the static pressure takes where there is no washout.",
                )
            ],
        ),
    ]


def _least(values: Sequence[float | None], digits: int = 3) -> str:
    known = [value for value in values if value is not None]
    return number(min(known), digits) if known else DASH


def _parameters(rig: Rig, tuning: Table) -> Grid:
    """Controller parameters (thesis Table B.3), then what was demanded and what is reached at
    worst.
    """
    gains = tuning["feedback_gain"]
    rows: list[list[Cell | str]] = []
    if len(set(gains.values())) == 1:
        rows.append(
            [
                "feedback gain K_p, all functions",
                _in(rig, "feedback_gain", next(iter(gains.values()))),
                pretty(unit_of(rig, "feedback_gain")),
                "",
                "",
            ]
        )
    else:
        rows += [
            [
                f"feedback gain K_p, {words(name)}",
                _in(rig, "feedback_gain", gain),
                pretty(unit_of(rig, "feedback_gain")),
                "",
                "",
            ]
            for name, gain in gains.items()
        ]
    for name, key, text in (
        ("washout", "washout", "washout corner ω_w"),
        ("washout", "ramp_washout", "corner of the second washout ω_r"),
        ("off_gain", "off_gain", "off-side gain K_o"),
        ("low_pressure", "low_pressure", "off-side set-point above tank"),
        ("cross_drop", "cross_drop", "planned drop across the cross-port edge"),
        ("lag", "tick", "tick"),
        ("lag", "delay", "delay from pressure to command"),
    ):
        if key != "ramp_washout" or tuning.get(key):
            rows.append([text, _in(rig, name, tuning[key]), pretty(unit_of(rig, name)), "", ""])
    points = counted(tuning)
    rows.append(
        [
            "damping ratio",
            "",
            "",
            num(f"≥ {number(tuning['target'], 3)}"),
            num(number(tuning["damping_ratio"], 3)),
        ]
    )
    for key, least in tuning["constraints"].items():
        unit = "natural_frequency" if key == "bandwidth" else key
        reached = [value for one in points if (value := one["margins"].get(key)) is not None]
        rows.append(
            [
                words(key),
                "",
                pretty(unit_of(rig, unit)),
                num(f"≥ {number(float(shown(rig, unit, least)), 3)}"),
                _in(rig, unit, min(reached), 3) if reached else "none found",
            ]
        )
    return Grid(
        ["", "value", "unit", "demanded", "reached at worst"],
        rows,
        "",
        "controller_parameters",
        "Controller parameters.",
    )


def _alternatives(rig: Rig, tuning: Table) -> list[Any]:
    two = ["ramp_washout"] if any(one.get("ramp_washout") for one in tuning["alternatives"]) else []
    rows = [
        [
            one["what"],
            words(one["feedback"]) + (" chamber" if one["feedback"] == "metered" else ""),
            *(
                _in(rig, name, one[name], 3)
                for name in ("washout", *two, "off_gain", "feedback_gain")
            ),
            num(number(one["damping_ratio"], 2)),
        ]
        for one in tuning["alternatives"]
    ]
    if not rows:
        return []
    first, *others = tuning["alternatives"]
    better = [one["what"] for one in others if one["damping_ratio"] > first["damping_ratio"]]
    text = (
        f"Better than the chosen law by this number: {', '.join(better)}."
        if better
        else "None of them beats the chosen law by this number."
    )
    head = [
        "law",
        "fed back",
        axis(rig, "washout", "washout"),
        *(axis(rig, name, "second washout") for name in two),
        axis(rig, "off_gain", "K_o"),
        axis(rig, "feedback_gain", "its best K_p"),
        "worst ζ",
    ]
    return [
        Text(text),
        Grid(
            head,
            rows,
            "Each law at its own best gain, without the demands on margins and bandwidth.",
            "alternatives",
            "Other laws.",
        ),
    ]


def _draws(tuning: Table, pictures: Pictures) -> list[Any]:
    found = tuning["robustness"]
    if not found["draws"]:
        return [Text("No draws were made.", "note")]
    drawn = Grid(
        ["drawn, with their covariance"], [[Cell(name, "code")] for name in found["parameters"]]
    )
    return [*pictures("draws", "", ""), Fold(count(len(found["parameters"]), "parameter"), [drawn])]


STANDS = 1e-3  # share of the speed asked that counts as standing still

# --- trials
# ---------------------------------------------------------------------------------------------------------------


def controlled_trial(run: Saved, pictures: Pictures) -> Told:
    """One trial under a controller: how it did, its figures, its numbers."""
    (case,) = cases_of(run)
    rig, row, facts = run.rig, case.row, run.json("trial.json")
    stopped = row.get("stopped") or ""
    inside: list[Any] = [Text(f"Stopped by a limit: {stopped}.", "bad")] if stopped else []
    inside += [*pictures("trial", "", ""), *pictures("estimates", "", "")]
    parts = [Part("Trial", inside), Part("Measures", _tables(rig, [case]))]
    if energy := pictures("sankey", "", ""):
        parts.append(Part("Energy", [*saving_blocks(rig, [case]), *energy]))
    posture = (
        ", ".join(f"{name} {value}" for name, value in facts.get("posture", {}).items())
        or "mid-stroke"
    )
    rows = [
        ["on", facts["on"]],
        ["controller", words(row["controller"])],
        ["cylinder", case.cylinder],
        ["payload", load_name(row["payload"])],
        ["posture", posture],
        ["lasted", f"{number(facts['duration'])} s"],
        ["samples", str(facts["samples"])],
        ["seed", str(facts.get("seed", 0))],
    ]
    parts.append(Part("Settings", [Grid(["", ""], rows), *_settings(rig, [case])]))
    return Told("stopped" if stopped else "done", case_said(rig, case), parts)


def trials(run: Saved, pictures: Pictures) -> Told:
    """A set of trials: controllers compared, one table over all, energies, and each trial folded
    away.
    """
    rig, cases = run.rig, cases_of(run)
    stopped = [case for case in cases if case.row.get("stopped")]
    first: list[Any] = []
    if stopped:
        first = [
            Text("Stopped by a limit:", "bad"),
            Bullets([f"{case.row['case']}: {case.row['stopped']}" for case in stopped]),
        ]
    parts = [
        Part("Compared", [*first, *pictures("compare", "", "")]),
        Part("Measures", _tables(rig, cases)),
        Part(
            "Energy",
            [
                *saving_blocks(rig, cases),
                *pictures("energy", "", ""),
                *_folded(pictures("sankey", "", ""), "where the energy of each trial went"),
            ],
        ),
    ]
    alone: list[Any] = []
    folds: list[Any] = []
    for case in cases:
        found = [
            *pictures("trial", "case", case.row["case"]),
            *pictures("estimates", "case", case.row["case"]),
        ]
        if any(picture.named for picture in found):
            alone += found
        else:
            folds.append(Fold(f"{case.row['case']}, on the {case.row['on']}", found))
    parts += [Part("Each trial", [*alone, *folds]), Part("Settings", _settings(rig, cases))]
    return Told("stopped" if stopped else "done", _trials_said(rig, cases), parts)


def _trials_said(rig: Rig, cases: Sequence[Case]) -> str:
    """Counts, then for each controller how it did over all payloads and motions."""
    if not cases:
        return "No trial."
    on = ", ".join(dict.fromkeys(case.row["on"] for case in cases))
    said = []
    for controller in dict.fromkeys(case.row["controller"] for case in cases):
        mine = [case for case in cases if case.row["controller"] == controller]
        steps = [one for case in mine for one in case.steps]
        if steps:
            text = [f"steady error {span([100.0 * one['steady_error'] for one in steps], 2)} %"]
            known = [100.0 * one["overshoot"] for one in steps if one.get("overshoot") is not None]
            text.append(
                f"overshoot {span(known, 2)} %{_of(known, steps)}"
                if known
                else "no overshoot to read"
            )
            clear = [
                ratio
                for one in steps
                if (ratio := damping(one)[0]) is not None and not damping(one)[1]
            ]
            rough = [
                ratio for one in steps if (ratio := damping(one)[0]) is not None and damping(one)[1]
            ]
            ratios = [f"{span(clear, 2)}{_of(clear, steps)}"] if clear else []
            ratios += (
                [f"about {span(rough, 2)} where it hardly rings{_of(rough, steps)}"]
                if rough
                else []
            )
            text.append(
                f"damping ratio {', '.join(ratios)}" if ratios else "no damping ratio to read"
            )
            said.append(f"{capital(words(controller))}: {', '.join(text)}")
        elif len(mine) == 1:
            said.append(f"{capital(words(controller))}: {tracking_said(rig, mine[0].row)}")
        else:
            most = span(
                [float(shown(rig, "x", case.row["tracking"]["max_error"])) for case in mine]
            )
            energy = span(
                [float(shown(rig, "energy", case.row["energy"]["pump"])) for case in mine], 4
            )
            said.append(
                f"{capital(words(controller))}: largest error {most} {pretty(unit_of(rig, 'x'))}, "
                f"{energy} {pretty(unit_of(rig, 'energy'))} from the pump"
            )
    payloads = count(len({case.row["payload"] for case in cases}), "payload")
    motions = count(len({case.row["motion"] for case in cases}), "motion")
    return (
        f"{count(len(cases), 'trial')} on the {on}: {payloads}, {motions}. " + ". ".join(said) + "."
    )


def _of(some: Sequence[float], steps: Sequence[Table]) -> str:
    """How many of the steps a range is of, where not of all."""
    return f" ({len(some)} of {len(steps)})" if len(some) < len(steps) else ""


def _tables(rig: Rig, cases: Sequence[Case]) -> list[Any]:
    """Steps of speed, tracking with energy, and limits met; each only where it has rows."""
    found: list[Any] = []
    if any(case.steps for case in cases):
        found.append(_steps(rig, cases))
    found.append(_tracking(rig, cases))
    if limits := _limits(cases):
        found.append(limits)
    return found


def _ordered(cases: Sequence[Case]) -> list[Case]:
    return [case for group in groups_of(cases).values() for case in group]


def _steps(rig: Rig, cases: Sequence[Case]) -> Grid:
    rows, reasons = (
        [],
        list(
            dict.fromkeys(
                doubt
                for case in _ordered(cases)
                for one in case.steps
                if (doubt := damping(one)[1])
            )
        ),
    )
    for case in _ordered(cases):
        for one in case.steps:
            rows.append(
                [
                    *who(case),
                    _in(rig, "v", one["speed"], 3),
                    _in(
                        rig,
                        "v",
                        one["steady_speed"] if abs(1.0 + one["steady_error"]) > STANDS else 0.0,
                        3,
                    ),
                    num(number(100.0 * one["steady_error"], 2)),
                    num(
                        number(
                            None if one.get("overshoot") is None else 100.0 * one["overshoot"], 2
                        )
                    ),
                    _in(rig, "t", one["settling_time"], 2)
                    if one.get("settling_time") is not None
                    else "not settled",
                    _in(rig, "v", one["rms_error"], 3),
                    num(
                        number(damping(one)[0], 2)
                        + (f" ({reasons.index(damping(one)[1]) + 1})" if damping(one)[1] else "")
                    ),
                    _in(rig, "natural_frequency", one.get("natural_frequency"), 2),
                    _in(rig, "energy", case.row["energy"]["pump"]),
                ]
            )
    head = [
        "payload",
        "motion",
        "controller",
        axis(rig, "v", "asked"),
        axis(rig, "v", "steady"),
        "steady error [%]",
        "overshoot [%]",
        axis(rig, "t", "settling time"),
        axis(rig, "v", "rms error"),
        "damping ratio",
        axis(rig, "natural_frequency", "ωₙ"),
        axis(rig, "energy", "pump energy of the trial"),
    ]
    note = "Overshoot beyond the steady speed; settled within 5 %; damping ratio and ωₙ from the decay."
    if reasons:
        note += (
            " No damping ratio, or a rough one: "
            + "; ".join(f"({i}) {reason}" for i, reason in enumerate(reasons, 1))
            + "."
        )
    return Grid(head, rows, note, "steps", "Steps of speed.")


def _tracking(rig: Rig, cases: Sequence[Case]) -> Grid:
    rows, groups = [], groups_of(cases)
    several = any(len(mine) > 1 for mine in groups.values())
    for case in _ordered(cases):
        row, track, energy = case.row, case.row["tracking"], case.row["energy"]
        least = min(
            (one.row["energy"]["pump"] for one in groups[row["payload"], row["motion"]] if one.fit),
            default=0.0,
        )
        relative = (
            [num(number(energy["pump"] / least, 3) if case.fit and least > 0.0 else DASH)]
            if several
            else []
        )
        rows.append(
            [
                *who(case),
                *(
                    _in(rig, "x", track[key], 3)
                    for key in ("max_error", "rms_error", "final_error")
                ),
                _in(rig, "v", row["speed_rms_error"], 3),
                _in(rig, "energy", energy["pump"]),
                *relative,
                _in(rig, "energy", energy["cylinder_work"]),
                chip("stopped") if row.get("stopped") else "",
            ]
        )
    head = [
        "payload",
        "motion",
        "controller",
        axis(rig, "x", "largest error"),
        axis(rig, "x", "rms error"),
        axis(rig, "x", "final error"),
        axis(rig, "v", "rms error of speed"),
        axis(rig, "energy", "pump energy"),
        *(["relative to the least"] if several else []),
        axis(rig, "energy", "cylinder work"),
        "",
    ]
    sources = "; ".join(dict.fromkeys(case.row["energy"]["source"] for case in cases))
    return Grid(
        head,
        rows,
        f"Stroke against the desired stroke. Pump energy: {sources}.",
        "tracking",
        "Tracking and energy.",
    )


def _limits(cases: Sequence[Case]) -> Grid | None:
    names = list(
        dict.fromkeys(
            name
            for case in cases
            for name, share in case.row.get("limits", {}).items()
            if share > 0.0
        )
    )
    if not names:
        return None
    rows = [
        [
            *who(case),
            *(num(number(100.0 * case.row.get("limits", {}).get(name, 0.0), 2)) for name in names),
        ]
        for case in _ordered(cases)
    ]
    return Grid(
        ["payload", "motion", "controller", *(f"{words(name)} [%]" for name in names)],
        rows,
        "Share of the time with an edge at a limit.",
        "limits",
        "Limits met.",
    )


def _settings(rig: Rig, cases: Sequence[Case]) -> list[Any]:
    """Gains really used (thesis Tables B.3, C.1, C.3); motions and controllers as the recipe has
    them (Table B.2).
    """
    import tomllib

    if not cases:
        return []
    text = cases[0].record().attachments.get("recipe.toml")
    recipe = tomllib.loads(text.decode("utf-8")) if text else {}
    found: dict[str, Grid] = {}
    gains = _by_controller(rig, cases, "gains")
    for key, title in (("motion", "Trajectories."), ("controller", "Controllers.")):
        entries = recipe.get(key, [])
        rows: list[list[Cell | str]] = []
        for entry in entries if isinstance(entries, list) else [entries]:
            rows.append(
                [
                    Cell(
                        f"{key}: {entry.get('name') or entry.get('kind') or entry.get('class', '')}",
                        "name",
                    ),
                    "",
                ]
            )
            rows += [
                [Cell(name, "code"), Cell(_plain(value), "code")]
                for name, value in entry.items()
                if name != "name"
            ]
        if rows:
            name = f"settings_{key}" if key == "motion" or not gains else ""
            found[key] = Grid(
                ["", "as the recipe has it"],
                rows,
                "What is not named has its default.",
                name,
                title if name else "",
            )
    blocks: list[Any] = [found["motion"]] if "motion" in found else []
    if gains:
        head, rows = gains
        blocks.append(
            Grid(
                head,
                rows,
                "As they were really used, defaults and what follows from them included.",
                "settings_controller",
                "Gains.",
            )
        )
    if bounds := _by_controller(rig, cases, "estimate_bounds"):
        blocks.append(
            Grid(
                *bounds,
                "The estimates are projected onto these.",
                "estimate_bounds",
                "Bounds of the estimates.",
            )
        )
    if rules := _by_controller(rig, cases, "rules"):
        blocks.append(Fold("Rules by which working functions are chosen", [Grid(*rules)]))
    if "controller" in found:
        blocks.append(
            Fold("Controllers as the recipe has them", [found["controller"]])
            if gains
            else found["controller"]
        )
    return blocks


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
    rows: list[list[Cell | str]] = []
    for name in dict.fromkeys(name for mine in tables.values() for table in mine for name in table):
        of, _, word = name.rpartition(".")
        row = row_of(name)
        cells = [
            _values(rig, name, [table[name] for table in mine if name in table])
            for mine in tables.values()
        ]
        said = f"{words(of)}: {row.meaning}" if of else row.meaning
        rows.append([Cell(row.symbol, "name"), said, *cells, pretty(unit_of(rig, word))])
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
    low, high = (span([float(shown(rig, name, one)) for one in ends]) for ends in (lows, highs))
    return num(low if lows == highs else f"{low} … {high}")


def _plain(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} = {_plain(one)}" for name, one in value.items())
    if isinstance(value, list):
        return ", ".join(_plain(one) for one in value)
    return (
        {True: "yes", False: "no"}.get(value, str(value)) if isinstance(value, bool) else str(value)
    )
