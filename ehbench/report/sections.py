"""One section a run: what a reader wants to know of it, from its saved files. A new stage is a row
in ``STAGES``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from ehbench.report import control_sections
from ehbench.report.blocks import Bullets, Cell, Fold, Grid, Heat, Part, Picture, Text
from ehbench.report.saved import Saved, Table
from ehbench.report.series_figures import title_of
from ehbench.report.telling import Pictures, Told, chip, look_of, num, plus, range_of, span
from ehbench.report.words import (
    axis,
    count,
    interval,
    number,
    pretty,
    row_of,
    shown,
    unit_of,
    with_error,
    words,
)
from ehbench.rig import Rig, Value

_METHODS = {"thesis": "matching frequency and decay"}
CORRELATED = 0.95


def _name(log: Table) -> Cell:
    return Cell(words(log["name"]), "name")


def flow_maps(run: Saved, pictures: Pictures) -> Told:
    """Maps, inverse maps, deadbands, calibration, readings left out."""
    rig, maps = run.rig, run.rows("summary.json")
    unit = pretty(unit_of(rig, "flow"))
    deadbands, calibration, left = [], [], []
    for one in maps:
        who = [one["valve"], one["direction"]]
        noise = "; ".join(
            f"{words(method)} {number(float(shown(rig, 'flow', floor)), 2)} {unit} and {number(100 * share, 2)} %"
            for method, (floor, share) in one.get("noise", {}).items()
        )
        deadbands.append(
            [
                *who,
                num(with_error(one.number("deadband"), one.get("deadband_std"))),
                num(interval(*one["deadband_interval"])),
                chip(one.get("status", "estimated")),
                num(number(one["readings"], 9)),
                num(str(len(one["outliers"]))),
                num(
                    number(float(shown(rig, "flow", one["rms"])), 2)
                    if one.get("rms") is not None
                    else "–"
                ),
                noise,
            ]
        )
        for point in one["calibration"]:
            target = float(shown(rig, "flow", point["target"]))
            measured = point["verdict"] != "not_measured"
            calibration.append(
                [
                    *who,
                    num(number(point["command"])),
                    num(f"{number(target)} ± {number(target * point['tolerance'], 2)}"),
                    num(number(float(shown(rig, "flow", point["flow"])), 3) if measured else "–"),
                    num(range_of(rig, "flow", (point["low"], point["high"])) if measured else "–"),
                    num(_drops(rig, point) if measured else "–"),
                    chip(point["verdict"]),
                ]
            )
        left += [
            [
                Cell(
                    f"{out['file']}:{out['line']}" if out["file"] else f"line {out['line']}", "code"
                ),
                *who,
                num(number(out["command"])),
                num(number(float(shown(rig, "pressure_drop", out["pressure_drop"])))),
                num(number(float(shown(rig, "flow", out["flow"])))),
                num(f"{out['sigmas']:+.1f}".replace("-", "−")),
            ]
            for out in one["outliers"]
        ]
    parts = [
        Part("Flow maps", pictures("flow_map", "", "")),
        Part("Inverse maps", pictures("inverse_map", "", "")),
    ]
    head = [
        "valve",
        "direction",
        "deadband [V]",
        "95 % interval [V]",
        "status",
        "readings used",
        "left out",
        f"rms residual [{unit}]",
        "noise of one reading",
    ]
    parts.append(Part("Deadbands", [Grid(head, deadbands, "± is one standard error.")]))
    if calibration:
        head = [
            "valve",
            "direction",
            "command [V]",
            f"asked [{unit}]",
            f"gives [{unit}]",
            "95 % interval",
            axis(rig, "pressure_drop", "over drops"),
            "verdict",
        ]
        note = "Met or missed: the whole interval lies inside or outside of what is asked; undecided: it straddles."
        parts.append(Part("Calibration", [Grid(head, calibration, note)]))
    if left:
        head = [
            "reading",
            "valve",
            "direction",
            "command [V]",
            axis(rig, "pressure_drop"),
            axis(rig, "flow"),
            "sigmas from the map",
        ]
        parts.append(Part("Readings left out", [Grid(head, left)]))
    readings = sum(one["readings"] for one in maps) + len(left)
    met = [row[-1].text for row in calibration]
    valves = {one["valve"] for one in maps}
    sentence = f"{count(len(maps), 'map')} of {count(len(valves), 'valve')} from {readings} readings, {len(left)} left out"
    sentence += f"; deadbands {span([one['deadband'] for one in maps])} V"
    sentence += (
        f"; calibration met at {met.count('met')} of {count(len(met), 'point')}." if met else "."
    )
    return Told("done", sentence, parts)


def _drops(rig: Rig, point: Table) -> str:
    low, high = (
        number(float(shown(rig, "pressure_drop", point[key]))) for key in ("drop_low", "drop_high")
    )
    return low if low == high else f"{low} … {high}"


def hydraulics(run: Saved, pictures: Pictures) -> Told:
    """Parameters with intervals, correlation, what was matched, and the fit to each log."""
    rig, fit = run.rig, run.json("parameters.json")
    known = rig.parameters()
    rows = []
    for one in fit["parameters"]:
        name = one["name"]
        value = known.get(name)
        low, high = (plus(rig, name, one.number(key), None) for key in ("lower", "upper"))
        rows.append(
            [
                Cell(name, "code", hint=row_of(name).meaning),
                num(plus(rig, name, one.number("value"), one.number("std"))),
                pretty(unit_of(rig, name)),
                num(range_of(rig, name, one.get("interval"))),
                num(f"{low} … {high}"),
                num(plus(rig, name, one.number("start"), None)),
                chip(one["status"]),
                value.sure if value is not None else "–",
                num(str(one["samples"])),
                words(one.get("error_from") or "–"),
            ]
        )
    head = [
        "parameter",
        "value",
        "unit",
        "95 % interval",
        "bounds",
        "start",
        "status",
        "how sure",
        "samples",
        "error from",
    ]
    inside: list[Any] = [
        Grid(head, rows, "± is one standard error, corrected for residuals that are not white."),
        *pictures("parameters", "", ""),
    ]
    parts = [Part("Parameters", inside)]
    names, matrix = fit.get("correlated_names", []), fit.get("correlation", [])
    if len(names) > 1:
        strong = [
            f"{names[b]} and {names[a]} correlate by {number(matrix[a][b], 3)}: the logs tell them only together."
            for a in range(len(names))
            for b in range(a)
            if matrix[a][b] is not None and abs(matrix[a][b]) > CORRELATED
        ]
        parts.append(
            Part(
                "Correlation of the estimates",
                [*([Bullets(strong, "warn")] if strong else []), Heat(names, matrix)],
            )
        )
    if matches := fit.get("matches", []):
        rows = [_match_row(rig, one, one.get("log", "")) for one in matches]
        parts.append(
            Part(
                "What was matched",
                [
                    Grid(
                        _match_head(rig),
                        rows,
                        "Ringing of recorded and simulated transients over the same window.",
                    )
                ],
            )
        )
    parts.append(
        Part("Fit to each log", [*_log_fits(rig, fit["logs"]), *_folded(pictures("fit", "", ""))])
    )
    if variants := fit.get("dynamics_comparison", []):
        parts.append(Part("Valve dynamics compared", [_dynamics(rig, variants)]))
    return Told(*_hydraulics_said(rig, fit), parts)


def _hydraulics_said(rig: Rig, fit: Table) -> tuple[str, str]:
    parameters = fit["parameters"]
    weak = [one for one in parameters if one["status"] != "estimated"]
    first = next((one for one in parameters if one not in weak), parameters[0])
    value = f"{plus(rig, first['name'], first.number('value'), first.number('std'))} {pretty(unit_of(rig, first['name']))}".strip()
    method = _METHODS.get(fit["method"], words(fit["method"]))
    sentence = f"{count(len(parameters), 'parameter')} from {count(len(fit['logs']), 'log')} by {method}: {words(first['name'])} {value}"
    if weak:
        sentence += "; not simply estimated: " + ", ".join(
            f"{one['name']} ({words(one['status'])})" for one in weak
        )
    return ("done" if not weak else "partly_estimated"), sentence + "."


def _folded(found: Sequence[Picture]) -> list[Any]:
    return [Fold(f"{count(len(found), 'figure')}: recorded and simulated", found)] if found else []


def _log_fits(rig: Rig, logs: Sequence[Table]) -> list[Any]:
    found = list(
        dict.fromkeys(channel.rsplit(".", 1)[1] for log in logs for channel in log["fit_percent"])
    )
    head = [
        "log",
        "payload",
        "cylinder",
        *(f"{title_of(w).lower()} [%]" for w in found),
        *(axis(rig, w, f"rms error, {title_of(w).lower()}") for w in found),
    ]
    rows = []
    for log in logs:
        cylinders = dict.fromkeys(channel.rpartition(".")[0] for channel in log["fit_percent"])
        for cylinder in cylinders:
            names = [f"{cylinder}.{word}" for word in found]
            fits = [num(number(log["fit_percent"].get(name), 3)) for name in names]
            errors = [
                log["residual_rms"].get(name) if log.get("residual_rms") else None for name in names
            ]
            shown_errors = [
                num(number(None if e is None else float(shown(rig, name, e)), 3))
                for name, e in zip(names, errors, strict=True)
            ]
            rows.append([_name(log), log.get("payload", "none"), cylinder, *fits, *shown_errors])
    return (
        [Grid(head, rows, "Fit: 100 % is exact, 0 % no better than the mean of the recording.")]
        if rows
        else []
    )


def _dynamics(rig: Rig, variants: Sequence[Table]) -> Grid:
    fits = [
        {one["name"]: one for one in variant["fit"]["parameters"]} if variant.get("fit") else {}
        for variant in variants
    ]
    rows = [
        [
            "error relative to the best",
            *(num(number(variant["relative_rms"], 4)) for variant in variants),
        ]
    ]
    for name in dict.fromkeys(name for fitted in fits for name in fitted):
        ones = [fitted.get(name) for fitted in fits]
        values = (
            num("–" if one is None else plus(rig, name, one.number("value"), one.number("std")))
            for one in ones
        )
        rows.append([axis(rig, name, name), *values])
    return Grid(
        ["", *(variant["dynamics"] for variant in variants)],
        rows,
        "The same logs, fitted with each valve dynamics in turn.",
    )


def _match_head(rig: Rig) -> list[str]:
    omega = f"ωₙ{_bracket(rig, 'natural_frequency')}"
    return [
        "log",
        "cylinder",
        "window [s]",
        f"{omega} recorded",
        f"{omega} simulated",
        "ζ recorded",
        "ζ simulated",
    ]


def _bracket(rig: Rig, name: str) -> str:
    unit = pretty(unit_of(rig, name))
    return f" [{unit}]" if unit else ""


def _match_row(rig: Rig, one: Table, log: str) -> list[Cell | str]:
    cells: list[Cell | str] = [
        Cell(words(log), "name"),
        one["cylinder"],
        num(interval(one["start"], one["stop"])),
    ]
    for key in ("natural_frequency", "damping_ratio"):
        for side in ("recorded", "simulated"):
            ring = one[side]
            value = ring.get(key)
            text = plus(rig, key, value, ring.get(f"{key}_std")) if value is not None else "–"
            cells.append(Cell(text, "number", hint=ring.get("reason", "")))
    return cells


def validation(run: Saved, pictures: Pictures) -> Told:
    """The verdict with its reasons, every check, the errors by channel, ringing side by side, and a
    figure a log.
    """
    rig, table = run.rig, run.json("validation.json")
    accepted, logs = table["accepted"], table["logs"]
    status = "accepted" if accepted else "rejected"
    verdict: list[Any] = [Text(f"The model is {status}.", "good" if accepted else "bad")]
    if table["reasons"]:
        verdict.append(Bullets(table["reasons"]))
    head = ["log", "payload", "how it counts", "moved", "result"]
    rows = []
    for log in logs:
        result = (
            "failed"
            if log.get("failure")
            else ("passed" if log.get("passed") else "not passed")
            if log["status"] == "held_out"
            else "shown only"
        )
        rows.append(
            [
                _name(log),
                log.get("payload", "none"),
                chip(log["status"]),
                ", ".join(log.get("moved", [])) or "–",
                Cell(result, "bad" if result == "not passed" else look_of(result)),
            ]
        )
    verdict.append(Grid(head, rows))
    checks = [
        [_name(log), check["sentence"], chip("passed" if check["passed"] else "failed")]
        for log in logs
        for check in log.get("checks", [])
    ]
    if checks:
        verdict.append(
            Fold(
                f"{count(len(checks), 'check')}, {sum(row[-1].text == 'passed' for row in checks)} passed",
                [Grid(["log", "check", "result"], checks)],
            )
        )
    parts = [Part("Verdict", verdict)]
    for log in logs:
        inside: list[Any] = (
            [Text(f"Could not be simulated: {log['failure']}", "bad")] if log.get("failure") else []
        )
        inside += pictures("validation", "log", log["name"])
        inside += _channel_table(rig, log)
        rings = [_match_row(rig, one, log["name"])[1:] for one in log.get("transients", [])]
        if rings:
            inside.append(Grid(_match_head(rig)[1:], rings))
        inside += (
            [Fold("Residual correlations", found)]
            if (found := pictures("residuals", "log", log["name"]))
            else []
        )
        if log.get("warnings"):
            inside.append(Bullets(log["warnings"], "note"))
        parts.append(Part(words(log["name"]).capitalize(), inside))
    held = [log for log in logs if log["status"] == "held_out"]
    by_word: dict[str, list[float]] = {}
    for log in held:
        for channel in log.get("channels", []):
            if channel.get("fit_percent") is not None:
                by_word.setdefault(channel["channel"].rsplit(".", 1)[1], []).append(
                    channel["fit_percent"]
                )
    fits = ", ".join(
        f"{title_of(word).lower()} {span(values, 2)} %" for word, values in by_word.items()
    )
    sentence = f"{status.capitalize()} on {count(len(held), 'held-out log')}"
    if failed := [check for log in held for check in log.get("checks", []) if not check["passed"]]:
        sentence += f", {len(failed)} of {count(sum(len(log.get('checks', [])) for log in held), 'check')} failed"
    sentence += f": fit of {fits}." if fits else "."
    return Told(status, sentence, parts)


def _channel_table(rig: Rig, log: Table) -> list[Grid]:
    rows = []
    for one in log.get("channels", []):
        name = one["channel"]
        errors = [
            num(number(float(shown(rig, name, one[key])), 3))
            for key in ("max_error", "bias", "rms_error")
        ]
        auto, cross = one.get("autocorrelation"), one.get("cross_correlation", [])
        worst = max(cross, key=lambda c: c["outside_percent"]) if cross else None
        rows.append(
            [
                Cell(
                    name + (" (derived)" if one.get("derived") else ""),
                    "code",
                    hint=one.get("note", ""),
                ),
                pretty(unit_of(rig, name)),
                num(number(one.number("fit_percent"), 3)),
                *errors,
                num(f"{auto['outside_percent']:.0f} %" if auto else "–"),
                Cell(
                    f"{worst['outside_percent']:.0f} %" if worst else "–",
                    "number",
                    hint=worst["of"] if worst else "",
                ),
            ]
        )
    head = [
        "channel",
        "unit",
        "fit [%]",
        "max error",
        "bias",
        "rms error",
        "residual lags outside",
        "command lags outside",
    ]
    note = "Errors are simulated minus recorded. Lags outside: where the residual correlates beyond the 95 % band."
    return [Grid(head, rows, note)] if rows else []


def trial(run: Saved, pictures: Pictures) -> Told:
    """Where it ran, how it ended, and its figures."""
    facts = run.json("trial.json")
    if facts.get("controller"):
        return control_sections.controlled_trial(run, pictures)
    stopped, on = facts.get("stopped", ""), facts["on"]
    posture = (
        ", ".join(f"{name} {value}" for name, value in facts.get("posture", {}).items())
        or "mid-stroke"
    )
    rows = [
        ["on", on],
        ["payload", facts.get("payload", "none")],
        ["posture", posture],
        ["lasted", f"{number(facts['duration'])} s"],
        ["samples", str(facts["samples"])],
        ["seed", str(facts.get("seed", 0))],
    ]
    inside: list[Any] = [Text(f"Stopped by a limit: {stopped}.", "bad")] if stopped else []
    inside += [*pictures("trial", "", ""), Grid(["", ""], rows)]
    sentence = (
        f"{number(facts['duration'])} s on the {on}, payload {facts.get('payload', 'none')}"
        + (f"; stopped: {stopped}." if stopped else ".")
    )
    return Told("stopped" if stopped else "done", sentence, [Part("Trial", inside)])


def anything(run: Saved, pictures: Pictures) -> Told:
    """A run of a stage this version knows no section for: its figures and its files."""
    found = pictures("", "", "")
    files = [[Cell(name, "code")] for name in run.facts.get("outputs", {})]
    return Told(
        "done", f"{count(len(files), 'file')}.", [Part("Results", [*found, Grid(["file"], files)])]
    )


@dataclass(frozen=True)
class Stage:
    """How runs of a stage are called in the glance, and what writes their section."""

    kind: str
    render: Callable[[Saved, Pictures], Told]


# in the order of the page; an empty second word takes whatever the stage made
STAGES: dict[tuple[str, str], Stage] = {
    ("identify", "flow_map"): Stage("flow maps", flow_maps),
    ("identify", "hydraulics"): Stage("identification", hydraulics),
    ("validate", ""): Stage("validation", validation),
    ("tune", ""): Stage("tuning", control_sections.tune),
    ("trial", ""): Stage("trial", trial),
    ("trials", ""): Stage("trials", control_sections.trials),
}


def stage_of(run: Saved) -> tuple[int, Stage]:
    """(place on the page, stage) of a run; unknown ones come last."""
    for place, (key, stage) in enumerate(STAGES.items()):
        if key in ((run.stage, run.what), (run.stage, "")):
            return place, stage
    return len(STAGES), Stage(words(run.stage), anything)


def rig_table(rig: Rig) -> list[Any]:
    """Every parameter of a rig, with value, unit, how sure it is, and source; the notes on its
    valve dynamics before.
    """
    groups: dict[str, list] = {}
    for name, value in _values(rig):
        groups.setdefault(name.rpartition(".")[0], []).append(_value_row(rig, name, value))
    rows = [[group, *row] for group, found in groups.items() for row in found]
    notes = [f"{name}: {dynamics.note}" for name, dynamics in rig.dynamics.items() if dynamics.note]
    return [
        *([Bullets(notes)] if notes else []),
        Grid(["of", "parameter", "value", "unit", "how sure", "source"], rows),
    ]


def _values(rig: Rig):
    """(name, value) of all scalars, then of all vectors and payloads, in the order of the rig's own
    parts.
    """
    from ehbench.rig import Slide

    vectors: dict[str, Value] = {}
    bodies = [rig.mechanism] if isinstance(rig.mechanism, Slide) else rig.mechanism.joint
    for body in bodies:
        vectors |= {
            f"{body.name}.{key}": getattr(body, key)
            for key in ("com", "inertia")
            if hasattr(body, key)
        }
    for load, links in rig.payload.items():
        for link, change in links.items():
            for key in ("mass", "com", "inertia"):
                if getattr(change, key) is not None:
                    vectors[f"payload {load}: {link}.{key}"] = getattr(change, key)
    heads = {name.rpartition(".")[0] for name in rig.parameters()}
    seen = set()
    for name, value in rig.parameters().items():
        yield name, value
        head = name.rpartition(".")[0]
        if head not in seen:
            seen.add(head)
            yield from (
                (other, one) for other, one in vectors.items() if other.rpartition(".")[0] == head
            )
    yield from (
        (name, value) for name, value in vectors.items() if name.rpartition(".")[0] not in heads
    )


def _value_row(rig: Rig, name: str, value: Value) -> list[Cell | str]:
    if isinstance(value.value, tuple):
        text = "(" + ", ".join(number(float(shown(rig, name, v)), 5) for v in value.value) + ")"
    else:
        text = (
            plus(rig, name, value.value, value.std)
            if value.std
            else number(float(shown(rig, name, value.value)), 6)
        )
    source = value.source.removeprefix(value.sure).lstrip(":, ")
    return [
        Cell(name.rsplit(".", 1)[-1], "code", hint=row_of(name).meaning),
        text if isinstance(value.value, tuple) else num(text),
        pretty(unit_of(rig, name)),
        value.sure,
        source,
    ]
