"""Validation: the verdict with its reasons, every check, and each log with errors, ringing and
residual correlations.
"""

from __future__ import annotations

from collections.abc import Sequence

from ehbench.report.blocks import Block, Bullets, Cell, Fold, Grid, Part, Text
from ehbench.report.captions import span
from ehbench.report.comparisons import draw_comparisons, log_cell, ringing_table
from ehbench.report.content import Pictures, SectionContent, StageReport, chip, look_of, num
from ehbench.report.figures import validation as figures
from ehbench.report.figures.channels import title_of
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved, Table
from ehbench.report.words import count, number, pretty, shown, unit_of, words
from ehbench.rig import Rig

_RESIDUALS_CAPTION = (
    "Correlation of the residual with itself and with earlier commands. "
    "Shaded: 95 % band, which allows for colour."
)


def draw(run: Saved, index: FigureIndex) -> None:
    """For each log recorded against simulated, then the correlations of its residuals."""
    for log in run.json("validation.json")["logs"]:
        name, status = log["name"], log.get("status", "held_out")
        lead = "Held out" if status == "held_out" else words(status).capitalize()
        draw_comparisons(run, index, name, "validation", lead)
        by_cylinder: dict[str, list[Table]] = {}
        for channel in log["channels"]:
            if channel.get("autocorrelation") is not None:
                by_cylinder.setdefault(channel["channel"].rpartition(".")[0], []).append(channel)
        for cylinder, channels in by_cylinder.items():
            path = index.add(
                f"residuals_{name}_{cylinder}",
                f"Residuals of {words(name)}, {cylinder}",
                _RESIDUALS_CAPTION,
                FigureKey("residuals", log=name, cylinder=cylinder),
            )
            figures.correlations(path, channels)


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """The verdict with its reasons, every check, the errors by channel, ringing side by side, and a
    figure a log.
    """
    table = run.json("validation.json")
    status = "accepted" if table["accepted"] else "rejected"
    parts = [
        Part("Verdict", _verdict(table, status)),
        *(
            Part(words(log["name"]).capitalize(), _log_blocks(run.rig, log, pictures))
            for log in table["logs"]
        ),
    ]
    return SectionContent(status, _sentence(table["logs"], status), parts)


def _sentence(logs: Sequence[Table], status: str) -> str:
    held_out = [log for log in logs if log["status"] == "held_out"]
    fits: dict[str, list[float]] = {}
    for log in held_out:
        for channel in log.get("channels", []):
            if channel.get("fit_percent") is not None:
                word = channel["channel"].rsplit(".", 1)[1]
                fits.setdefault(word, []).append(channel["fit_percent"])
    sentence = f"{status.capitalize()} on {count(len(held_out), 'held-out log')}"
    checks = [check for log in held_out for check in log.get("checks", [])]
    if failed := [check for check in checks if not check["passed"]]:
        sentence += f", {len(failed)} of {count(len(checks), 'check')} failed"
    told = ", ".join(f"{title_of(word).lower()} {span(fit, 2)} %" for word, fit in fits.items())
    return sentence + (f": fit of {told}." if told else ".")


def _verdict(table: Table, status: str) -> list[Block]:
    look = "good" if status == "accepted" else "bad"
    blocks: list[Block] = [Text(f"The model is {status}.", look)]
    if table["reasons"]:
        blocks.append(Bullets(table["reasons"]))
    rows = [_log_row(log) for log in table["logs"]]
    blocks.append(Grid(["log", "payload", "how it counts", "moved", "result"], rows))
    checks = [(log, check) for log in table["logs"] for check in log.get("checks", [])]
    if checks:
        passed = sum(bool(check["passed"]) for _, check in checks)
        rows = [
            [log_cell(log), check["sentence"], chip("passed" if check["passed"] else "failed")]
            for log, check in checks
        ]
        title = f"{count(len(checks), 'check')}, {passed} passed"
        blocks.append(Fold(title, [Grid(["log", "check", "result"], rows)]))
    return blocks


def _log_row(log: Table) -> list[Cell | str]:
    if log.get("failure"):
        result = "failed"
    elif log["status"] == "held_out":
        result = "passed" if log.get("passed") else "not passed"
    else:
        result = "shown only"
    return [
        log_cell(log),
        log.get("payload", "none"),
        chip(log["status"]),
        ", ".join(log.get("moved", [])) or "–",
        Cell(result, "bad" if result == "not passed" else look_of(result)),
    ]


def _log_blocks(rig: Rig, log: Table, pictures: Pictures) -> list[Block]:
    """One log: figures, errors by channel, ringing, residual correlations, warnings."""
    blocks: list[Block] = []
    if log.get("failure"):
        blocks.append(Text(f"Could not be simulated: {log['failure']}", "bad"))
    blocks += pictures(FigureKey("validation", log=log["name"]))
    blocks += _channel_table(rig, log)
    if rings := log.get("transients", []):
        blocks.append(ringing_table(rig, rings))
    if residuals := pictures(FigureKey("residuals", log=log["name"])):
        blocks.append(Fold("Residual correlations", residuals))
    if log.get("warnings"):
        blocks.append(Bullets(log["warnings"], "note"))
    return blocks


def _channel_table(rig: Rig, log: Table) -> list[Block]:
    rows = [_channel_row(rig, one) for one in log.get("channels", [])]
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
    note = (
        "Errors are simulated minus recorded. "
        "Lags outside: where the residual correlates beyond the 95 % band."
    )
    return [Grid(head, rows, note)] if rows else []


def _channel_row(rig: Rig, one: Table) -> list[Cell | str]:
    name = one["channel"]
    with_itself, with_commands = one.get("autocorrelation"), one.get("cross_correlation", [])
    worst = max(with_commands, key=lambda c: c["outside_percent"]) if with_commands else None
    label = name + (" (derived)" if one.get("derived") else "")
    outside = "–" if worst is None else f"{worst['outside_percent']:.0f} %"
    return [
        Cell(label, "code", hint=one.get("note", "")),
        pretty(unit_of(rig, name)),
        num(number(one.number("fit_percent"), 3)),
        *(
            num(number(float(shown(rig, name, one[key])), 3))
            for key in ("max_error", "bias", "rms_error")
        ),
        num(f"{with_itself['outside_percent']:.0f} %" if with_itself else "–"),
        Cell(outside, "number", hint="" if worst is None else worst["of"]),
    ]


REPORT = StageReport(
    "validation",
    section,
    draw,
    standing=2,
    shows=("Verdict",),
    columns=("log", "check", "result"),
    numbers=("validation.json", ("accepted", "reasons", "thresholds")),
)
