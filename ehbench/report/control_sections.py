"""Sections of tunings and of trials under a controller."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ehbench.report.blocks import Bullets, Cell, Fold, Grid, Part, Text
from ehbench.report.saved import Saved, Table
from ehbench.report.telling import Pictures, Told, capital, chip, num, span
from ehbench.report.trial_figures import Case, case_said, cases_of, groups_of, percent, tracking_said
from ehbench.report.tuning_figures import counted, draws_said, function_names, load_name, measure, payloads_of
from ehbench.report.words import DASH, axis, count, number, pretty, shown, unit_of, words
from ehbench.rig import Rig


def _in(rig: Rig, name: str, value: float | None, digits: int = 4) -> Cell:
    """An SI number in the rig's unit, as a cell."""
    return num(number(None if value is None else float(shown(rig, name, value)), digits))


def _endless(value: float | None, digits: int = 3) -> str:
    """A margin or limit: null stands for one that was not found."""
    return "none found" if value is None else number(value, digits)


def _folded(found: Sequence[Any], what: str) -> list[Any]:
    return [Fold(f"{count(len(found), 'figure')}: {what}", found)] if found else []


# --- tune -----------------------------------------------------------------------------------------------------------------


def tune(run: Saved, pictures: Pictures) -> Told:
    """Equivalent mass and gravity, operating points, gains and what they promise, loci, steps, what else was tried, draws."""
    rig, tuning = run.rig, run.json("tuning.json")
    points, met = counted(tuning), tuning["met"]
    choice: list[Any] = [
        Text(f"Target and demands are {'' if met else 'not '}met at all operating points that count.", "good" if met else "bad"),
        *pictures("damping", "", ""), _parameters(rig, tuning),
    ]  # fmt: skip
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
    washout = f"washout {measure(rig, 'washout', tuning['washout'])}" if tuning["washout"] else "no washout"
    lead = "One gain" if len(gains) == 1 else f"{len(gains)} gains"
    sentence = (
        f"{lead} K_p = {span([float(shown(rig, 'feedback_gain', g)) for g in gains])} {pretty(unit_of(rig, 'feedback_gain'))}"
        f", {washout}: worst damping ratio {number(tuning['damping_ratio'], 2)} over "
        f"{count(len(points), 'operating point')} of {words(tuning['cylinder'])}, without feedback "
        f"{span([tuning['damping_ratio_open'], tuning['damping_ratio_open_most']], 2)}; target {number(tuning['target'], 2)}"
    )
    found = tuning["robustness"]
    sentence += f", reached by {percent(found['share'], 3)} of {found['draws']} draws." if found["draws"] else "."
    return Told("met" if met else "missed", sentence, parts)


def _by_count(pictures: Pictures, kind: str) -> list[Any]:
    """Figures of the functions that count and those that a campaign names; the others folded."""
    rest = {picture.id for picture in pictures("", "counts", "no") if not picture.named}
    found = pictures(kind, "", "")
    folded = [picture for picture in found if picture.id in rest]
    return [*(picture for picture in found if picture.id not in rest), *_folded(folded, "functions that no load calls for")]


def _operating_points(rig: Rig, tuning: Table) -> list[Any]:
    """A row a function and payload, and every point folded away."""
    points = tuning["points"]
    rows = []
    for function in function_names(tuning):
        for payload in payloads_of(tuning):
            mine = [one for one in points if (one["point"]["function"], one["point"]["payload"]) == (function, payload)]
            if not mine:
                continue
            at = [one["point"] for one in mine]
            gain, phase = ([one["margins"].get(key) for one in mine] for key in ("gain_margin", "phase_margin"))
            rows.append([
                words(function), load_name(payload), num(str(len(mine))),
                chip("counts" if any(one["counts"] for one in mine) else "shown only"),
                num(span([float(shown(rig, "mass", p["mass"])) for p in at])),
                num(span([float(shown(rig, "force", p["gravity_force"])) for p in at])),
                num(span([float(shown(rig, "natural_frequency", one["natural_frequency_open"])) for one in mine])),
                num(span([one["damping_ratio_open"] for one in mine], 2)),
                num(span([one["damping_ratio_closed"] for one in mine], 2)),
                num(_least(gain)), num(_least([None if v is None else float(shown(rig, "phase_margin", v)) for v in phase])),
            ])  # fmt: skip
    head = [
        "function", "payload", "points", "in the choice", axis(rig, "mass", "m_eq"), axis(rig, "force", "F_eq"),
        axis(rig, "natural_frequency", "ωₙ without feedback"), "ζ without feedback", "ζ with feedback", "least gain margin",
        axis(rig, "phase_margin", "least phase margin"),
    ]  # fmt: skip
    every = [[
        words(one["point"]["function"]), load_name(one["point"]["payload"]), _in(rig, "x", one["point"]["x"]),
        _in(rig, "v", one["point"]["v"], 3),
        *(_in(rig, unit, one["point"][name]) for name, unit in (
            ("mass", "mass"), ("gravity_force", "force"), ("damping", "damping"), ("p_head", "p_head"), ("p_rod", "p_rod"))),
        _in(rig, "natural_frequency", one["natural_frequency_open"], 3), num(number(one["damping_ratio_open"], 2)),
        _in(rig, "natural_frequency", one["natural_frequency_closed"], 3), num(number(one["damping_ratio_closed"], 2)),
        num(number(one.get("damping_ratio_plain"), 2)), _in(rig, "v", one.get("bias"), 2),
        num(_endless(None if (v := one.get("gain_limit")) is None else float(shown(rig, "feedback_gain", v)))),
        chip("counts" if one["counts"] else "shown only"),
    ] for one in points]  # fmt: skip
    heads = [
        "function", "payload", axis(rig, "x", "stroke"), axis(rig, "v", "speed"), axis(rig, "mass", "m_eq"),
        axis(rig, "force", "F_eq"),
        axis(rig, "damping", "b_eq"), axis(rig, "p_head", "head-end pressure"), axis(rig, "p_rod", "rod-end pressure"),
        axis(rig, "natural_frequency", "ωₙ open"), "ζ open", axis(rig, "natural_frequency", "ωₙ closed"), "ζ closed",
        "ζ without washout",
        axis(rig, "v", "speed lost without washout"), axis(rig, "feedback_gain", "stable up to K_p"), "in the choice",
    ]  # fmt: skip
    note = "ζ is that of the least damped of all poles, valves and washout among them."
    return [
        Grid(head, rows, note, "operating_points", "Operating points."),
        Fold(
            f"All {count(len(points), 'operating point')}",
            [Grid(heads, every, "Speed lost: what the static pressure takes where there is no washout.")],
        ),
    ]


def _least(values: Sequence[float | None], digits: int = 3) -> str:
    known = [value for value in values if value is not None]
    return number(min(known), digits) if known else DASH


def _parameters(rig: Rig, tuning: Table) -> Grid:
    """Controller parameters (thesis Table B.3), then what was demanded and what is reached at worst."""
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
            [f"feedback gain K_p, {words(name)}", _in(rig, "feedback_gain", gain), pretty(unit_of(rig, "feedback_gain")), "", ""]
            for name, gain in gains.items()
        ]
    for name, key, text in (
        ("washout", "washout", "washout corner ω_w"), ("off_gain", "off_gain", "off-side gain K_o"),
        ("low_pressure", "low_pressure", "off-side set-point above tank"),
        ("cross_drop", "cross_drop", "planned drop across the cross-port edge"),
        ("lag", "tick", "tick"), ("lag", "delay", "delay from pressure to command"),
    ):  # fmt: skip
        rows.append([text, _in(rig, name, tuning[key]), pretty(unit_of(rig, name)), "", ""])
    points = counted(tuning)
    rows.append(["damping ratio", "", "", num(f"≥ {number(tuning['target'], 3)}"), num(number(tuning["damping_ratio"], 3))])
    for key, least in tuning["constraints"].items():
        unit = "natural_frequency" if key == "bandwidth" else key
        reached = [value for one in points if (value := one["margins"].get(key)) is not None]
        rows.append([
            words(key), "", pretty(unit_of(rig, unit)), num(f"≥ {number(float(shown(rig, unit, least)), 3)}"),
            _in(rig, unit, min(reached), 3) if reached else "none found",
        ])  # fmt: skip
    return Grid(
        ["", "value", "unit", "demanded", "reached at worst"], rows, "", "controller_parameters", "Controller parameters."
    )


def _alternatives(rig: Rig, tuning: Table) -> list[Any]:
    rows = [
        [
            one["what"], words(one["feedback"]) + (" chamber" if one["feedback"] == "metered" else ""),
            *(_in(rig, name, one[name], 3) for name in ("washout", "off_gain", "feedback_gain")),
            num(number(one["damping_ratio"], 2)),
        ]
        for one in tuning["alternatives"]
    ]  # fmt: skip
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
    drawn = Grid(["drawn, with their covariance"], [[Cell(name, "code")] for name in found["parameters"]])
    return [Text(draws_said(tuning)), *pictures("draws", "", ""), Fold(count(len(found["parameters"]), "parameter"), [drawn])]


# --- trials ---------------------------------------------------------------------------------------------------------------


def controlled_trial(run: Saved, pictures: Pictures) -> Told:
    """One trial under a controller: how it did, its figures, its numbers."""
    (case,) = cases_of(run)
    rig, row, facts = run.rig, case.row, run.json("trial.json")
    stopped = row.get("stopped") or ""
    inside: list[Any] = [Text(f"Stopped by a limit: {stopped}.", "bad")] if stopped else []
    inside += [*pictures("trial", "", ""), *pictures("estimates", "", "")]
    parts = [Part("Trial", inside), Part("Measures", _tables(rig, [case]))]
    if energy := pictures("sankey", "", ""):
        parts.append(Part("Energy", energy))
    posture = ", ".join(f"{name} {value}" for name, value in facts.get("posture", {}).items()) or "mid-stroke"
    rows = [
        ["on", facts["on"]], ["controller", words(row["controller"])], ["cylinder", case.cylinder],
        ["payload", load_name(row["payload"])],
        ["posture", posture], ["lasted", f"{number(facts['duration'])} s"], ["samples", str(facts["samples"])],
        ["seed", str(facts.get("seed", 0))],
    ]  # fmt: skip
    parts.append(Part("Settings", [Grid(["", ""], rows), *_settings(case)]))
    return Told("stopped" if stopped else "done", case_said(rig, case), parts)


def trials(run: Saved, pictures: Pictures) -> Told:
    """A set of trials: controllers compared, one table over all, energies, and each trial folded away."""
    rig, cases = run.rig, cases_of(run)
    stopped = [case for case in cases if case.row.get("stopped")]
    first: list[Any] = []
    if stopped:
        first = [Text("Stopped by a limit:", "bad"), Bullets([f"{case.row['case']}: {case.row['stopped']}" for case in stopped])]
    parts = [
        Part("Compared", [*first, *pictures("compare", "", "")]),
        Part("Measures", _tables(rig, cases)),
        Part(
            "Energy", [*pictures("energy", "", ""), *_folded(pictures("sankey", "", ""), "where the energy of each trial went")]
        ),
    ]
    alone: list[Any] = []
    folds: list[Any] = []
    for case in cases:
        found = [*pictures("trial", "case", case.row["case"]), *pictures("estimates", "case", case.row["case"])]
        if any(picture.named for picture in found):
            alone += found
        else:
            folds.append(Fold(f"{case.row['case']}, on the {case.row['on']}", found))
    parts += [Part("Each trial", [*alone, *folds]), Part("Settings", _settings(cases[0]) if cases else [])]
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
            for key, name, factor, unit in (("overshoot", "overshoot", 100.0, " %"), ("damping_ratio", "damping ratio", 1.0, "")):
                known = [factor * one[key] for one in steps if one.get(key) is not None]
                text.append(
                    f"{name} {span(known, 2)}{unit}" + (f" ({len(known)} of {len(steps)})" if len(known) < len(steps) else "")
                    if known
                    else f"no {name} to read"
                )
            said.append(f"{capital(words(controller))}: {', '.join(text)}")
        elif len(mine) == 1:
            said.append(f"{capital(words(controller))}: {tracking_said(rig, mine[0].row)}")
        else:
            most = span([float(shown(rig, "x", case.row["tracking"]["max_error"])) for case in mine])
            energy = span([float(shown(rig, "energy", case.row["energy"]["pump"])) for case in mine], 4)
            said.append(
                f"{capital(words(controller))}: largest error {most} {pretty(unit_of(rig, 'x'))}, "
                f"{energy} {pretty(unit_of(rig, 'energy'))} from the pump"
            )
    payloads = count(len({case.row["payload"] for case in cases}), "payload")
    motions = count(len({case.row["motion"] for case in cases}), "motion")
    return f"{count(len(cases), 'trial')} on the {on}: {payloads}, {motions}. " + ". ".join(said) + "."


def _tables(rig: Rig, cases: Sequence[Case]) -> list[Any]:
    """Steps of speed, tracking with energy, and limits met; each only where it has rows."""
    found: list[Any] = []
    if any(case.steps for case in cases):
        found.append(_steps(rig, cases))
    found.append(_tracking(rig, cases))
    if limits := _limits(cases):
        found.append(limits)
    return found


def _who(case: Case) -> list[Cell | str]:
    row = case.row
    return [load_name(row["payload"]), words(row["motion"]) or DASH, words(row["controller"])]


def _ordered(cases: Sequence[Case]) -> list[Case]:
    return [case for group in groups_of(cases).values() for case in group]


def _steps(rig: Rig, cases: Sequence[Case]) -> Grid:
    rows = []
    for case in _ordered(cases):
        for one in case.steps:
            rows.append([
                *_who(case), _in(rig, "v", one["speed"], 3), _in(rig, "v", one["steady_speed"], 3),
                num(number(100.0 * one["steady_error"], 2)),
                num(number(None if one.get("overshoot") is None else 100.0 * one["overshoot"], 2)),
                _in(rig, "t", one["settling_time"], 2) if one.get("settling_time") is not None else "not settled",
                _in(rig, "v", one["rms_error"], 3), num(number(one.get("damping_ratio"), 2)),
                _in(rig, "natural_frequency", one.get("natural_frequency"), 2),
                _in(rig, "energy", case.row["energy"]["pump"]), one["ringing"],
            ])  # fmt: skip
    head = [
        "payload", "motion", "controller", axis(rig, "v", "asked"), axis(rig, "v", "steady"), "steady error [%]", "overshoot [%]",
        axis(rig, "t", "settling time"), axis(rig, "v", "rms error"), "damping ratio", axis(rig, "natural_frequency", "ωₙ"),
        axis(rig, "energy", "pump energy of the trial"), "why no damping ratio",
    ]  # fmt: skip
    note = "Overshoot beyond the steady speed; settled within 5 %; damping ratio and ωₙ from the decay."
    return Grid(head, rows, note, "steps", "Steps of speed.")


def _tracking(rig: Rig, cases: Sequence[Case]) -> Grid:
    rows, groups = [], groups_of(cases)
    several = any(len(mine) > 1 for mine in groups.values())
    for case in _ordered(cases):
        row, track, energy = case.row, case.row["tracking"], case.row["energy"]
        least = min(one.row["energy"]["pump"] for one in groups[row["payload"], row["motion"]])
        relative = [num(number(energy["pump"] / least, 3) if least > 0.0 else DASH)] if several else []
        rows.append([
            *_who(case), *(_in(rig, "x", track[key], 3) for key in ("max_error", "rms_error", "final_error")),
            _in(rig, "v", row["speed_rms_error"], 3),
            _in(rig, "energy", energy["pump"]), *relative, _in(rig, "energy", energy["cylinder_work"]),
            chip("stopped") if row.get("stopped") else "",
        ])  # fmt: skip
    head = [
        "payload", "motion", "controller", axis(rig, "x", "largest error"), axis(rig, "x", "rms error"),
        axis(rig, "x", "final error"),
        axis(rig, "v", "rms error of speed"), axis(rig, "energy", "pump energy"),
        *(["relative to the least"] if several else []), axis(rig, "energy", "cylinder work"), "",
    ]  # fmt: skip
    sources = "; ".join(dict.fromkeys(case.row["energy"]["source"] for case in cases))
    return Grid(head, rows, f"Stroke against the desired stroke. Pump energy: {sources}.", "tracking", "Tracking and energy.")


def _limits(cases: Sequence[Case]) -> Grid | None:
    names = list(dict.fromkeys(name for case in cases for name, share in case.row.get("limits", {}).items() if share > 0.0))
    if not names:
        return None
    rows = [
        [*_who(case), *(num(number(100.0 * case.row.get("limits", {}).get(name, 0.0), 2)) for name in names)]
        for case in _ordered(cases)
    ]
    return Grid(
        ["payload", "motion", "controller", *(f"{words(name)} [%]" for name in names)],
        rows,
        "Share of the time with an edge at a limit.",
        "limits",
        "Limits met.",
    )


def _settings(case: Case) -> list[Any]:
    """Motions and controllers as the recipe in the log has them (thesis Tables B.2, C.1, C.3); the rest has its defaults."""
    import tomllib

    text = case.record().attachments.get("recipe.toml")
    recipe = tomllib.loads(text.decode("utf-8")) if text else {}
    found: list[Any] = []
    for key, title in (("motion", "Trajectories."), ("controller", "Controllers.")):
        entries = recipe.get(key, [])
        rows: list[list[Cell | str]] = []
        for entry in entries if isinstance(entries, list) else [entries]:
            rows.append([Cell(f"{key}: {entry.get('name') or entry.get('kind') or entry.get('class', '')}", "name"), ""])
            rows += [[Cell(name, "code"), Cell(_plain(value), "code")] for name, value in entry.items() if name != "name"]
        if rows:
            found.append(Grid(["", "as the recipe has it"], rows, "What is not named has its default.", f"settings_{key}", title))
    return found


def _plain(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} = {_plain(one)}" for name, one in value.items())
    if isinstance(value, list):
        return ", ".join(_plain(one) for one in value)
    return {True: "yes", False: "no"}.get(value, str(value)) if isinstance(value, bool) else str(value)
