"""Validation: the verdict with its reasons, every check, and each log with errors, ringing and
residual correlations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from ehbench.config.rig import Rig
from ehbench.report.blocks import Block, Bullets, Cell, Fold, Grid, Part, Text
from ehbench.report.captions import span
from ehbench.report.comparisons import draw_comparisons, log_cell, ringing_table
from ehbench.report.content import Pictures, SectionContent, StageReport, chip, look_of, num
from ehbench.report.figures import validation as figures
from ehbench.report.figures.channels import title_of
from ehbench.report.figures.sweeps import CAPTION, sweeps
from ehbench.report.headlines import left_over, silence
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved, Table
from ehbench.report.words import count, interval, number, pretty, shown, unit_of, words

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
        _draw_sweeps(run, index, log)


def _draw_sweeps(run: Saved, index: FigureIndex, log: Table) -> None:
    """A figure for each command of a log that sweeps."""
    minimum = run.json("validation.json").get("thresholds", {}).get("response_coherence", 0.0)
    by_command: dict[str, list[Table]] = {}
    for sweep in log.get("sweeps", []):
        by_command.setdefault(sweep["input"], []).append(sweep)
    for command, result in by_command.items():
        path = index.add(
            f"sweep_{log['name']}_{command.replace('.', '_')}",
            f"Response to {command.removesuffix('.command')} in {words(log['name'])}",
            CAPTION,
            FigureKey("sweep", log=log["name"]),
        )
        sweeps(path, run.rig, result, minimum)


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """The verdict with its reasons, every check, the errors by channel, ringing side by side, and a
    figure a log.
    """
    table = run.json("validation.json")
    status = "accepted" if table["accepted"] else "rejected"
    if table["accepted"] and table.get("reservations"):
        status = "accepted_with_reservation"
    parts = [
        Part("Verdict", _verdict(table, status)),
        *_beside_others(run.rig, table),
        *_structure(table),
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
    sentence = f"{words(status).capitalize()} on {count(len(held_out), 'held-out log')}"
    checks = [check for log in held_out for check in log.get("checks", [])]
    if failed := [check for check in checks if not check["passed"]]:
        sentence += f", {len(failed)} of {count(len(checks), 'check')} failed"
    fitted = ", ".join(f"{title_of(word).lower()} {span(fit, 2)} %" for word, fit in fits.items())
    return sentence + (f": fit of {fitted}." if fitted else ".")


def _verdict(table: Table, status: str) -> list[Block]:
    blocks: list[Block] = [Text(f"The model is {words(status)}.", look_of(status))]
    if table["reasons"]:
        blocks.append(Bullets(table["reasons"]))
    if reservations := table.get("reservations", []):
        blocks.append(Text("Reservations:"))
        blocks.append(Bullets(reservations, "warn"))
    if table["accepted"] and (left := left_over(table)):
        blocks.append(Bullets(left, "warn"))
    if unasked := silence(table):
        blocks.append(Text(unasked, "note"))
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


def _beside_others(rig: Rig, table: Table) -> list[Part]:
    """What others reached on the same recordings, with this model's figures among theirs, the
    nearest to the recording first.
    """
    others = table.get("references", [])
    rows = []
    for channel, measure in dict.fromkeys((other["channel"], other["measure"]) for other in others):
        results = [
            (other["value"], other["name"], other["source"])
            for other in others
            if (other["channel"], other["measure"]) == (channel, measure)
        ]
        for log in table["logs"]:
            for item in log.get("channels", []):
                if item["channel"] == channel and item.get(measure) is not None:
                    results.append((item[measure], "this model", words(log["name"])))
        results.sort(reverse=measure == "fit_percent")
        fit = measure == "fit_percent"
        unit = "%" if fit else pretty(unit_of(rig, channel))
        for value, who, source in results:
            text = number(value if fit else float(shown(rig, channel, value)), 3)
            name = Cell(who, "name") if who == "this model" else who
            cells = (name, Cell(channel, "code"), "fit" if fit else "rms error", num(text), unit)
            rows.append([*cells, source])
    if not rows:
        return []
    head = ["model", "channel", "measure", "value", "unit", "source or log"]
    caption = "Figures of others are as the recipe quotes them; none is made again here."
    return [Part("Beside what others reached", [Grid(head, rows, caption)])]


def _structure(table: Table) -> list[Part]:
    """What the residuals say of the model: the likeliest cures, and what each channel follows."""
    requested = table.get("structure")
    if requested is None or not (requested["findings"] or requested["follows"]):
        return []
    lead = (
        "Each likely fault was built into the model or the log. These explain the residuals, the "
        "likeliest first; several that explain much alike are alternatives, not a sum."
    )
    blocks: list[Block] = [Text(lead)]
    rows = [
        [finding["sentence"], finding["cure"], num(f"{100.0 * finding['explains']:.0f} %")]
        for finding in requested["findings"]
    ]
    if rows:
        blocks.append(Grid(["what is seen", "what cures it", "of the residuals' squares"], rows))
    else:
        blocks = [Text("No likely fault explains the residuals better than chance.")]
    if requested["follows"]:
        results = [
            [
                words(follow["log"]),
                Cell(follow["channel"], "code"),
                follow["what"],
                num(number(follow["correlation"], 2)),
                num(number(follow["band"], 2)),
            ]
            for follow in requested["follows"]
        ]
        head = ["log", "residual of", "follows", "correlation", "95 % band"]
        title = f"What the residuals go along with: {count(len(results), 'pair')} outside the band"
        blocks.append(Fold(title, [Grid(head, results)]))
    return [Part("What the residuals follow", blocks)]


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
    if scored := log.get("scored"):
        blocks.append(Text(f"Simulated as a whole; judged is {interval(*scored)} s."))
    blocks += pictures(FigureKey("validation", log=log["name"]))
    blocks += _channel_table(rig, log)
    if sensors := log.get("sensors", {}):
        estimates = (_sensor(rig, name, value) for name, value in sensors.items())
        blocks.append(Text(f"Estimated of its sensors: {', '.join(estimates)}.", "note"))
    if rings := log.get("transients", []):
        blocks.append(ringing_table(rig, rings))
        blocks += _unjudged(rings)
    if result := log.get("sweeps", []):
        blocks += pictures(FigureKey("sweep", log=log["name"]))
        blocks.append(_sweep_table(result))
    if residuals := pictures(FigureKey("residuals", log=log["name"])):
        blocks.append(Fold("Residual correlations", residuals))
    if log.get("warnings"):
        blocks.append(Bullets(log["warnings"], "note"))
    return blocks


def _sensor(rig: Rig, name: str, value: float) -> str:
    """``offset of boom.p_head 2 bar``."""
    channel, _, word = name.rpartition(".")
    row = {"offset": channel, "scale": "sensor_scale"}.get(word, word)
    text = f"{word} of {channel} {number(float(shown(rig, row, value)), 3)}"
    return f"{text} {pretty(unit_of(rig, row))}".strip()


def _unjudged(rings: Sequence[Table]) -> list[Block]:
    """The windows whose ringing was found and is not judged, with the reason."""
    sentences = [
        f"{ring['cylinder']}, {interval(ring['start'], ring['stop'])} s: not judged, {ring['note']}"
        for ring in rings
        if ring.get("note")
    ]
    return [Bullets(sentences, "note")] if sentences else []


def _sweep_table(result: Sequence[Table]) -> Grid:
    """Recording and model compared over the coherent band, a row a channel."""
    head = [
        "response of",
        "band [Hz]",
        "frequencies",
        "gain, model/recording",
        "gain error [%]",
        "phase error [°]",
        "delay recorded [ms]",
        "delay simulated [ms]",
        "coherence recorded",
        "coherence simulated",
    ]
    rows = [
        [
            Cell(item["channel"], "code", hint=item["input"]),
            num(interval(*item["band"])),
            num(str(item["frequencies"])),
            *(
                num("–" if value is None else number(factor * value, 3))
                for value, factor in (
                    (item.get("gain_ratio"), 1.0),
                    (item.get("gain_error"), 100.0),
                    (item.get("phase_error"), 180.0 / math.pi),
                    *((value, 1e3) for value in item["delay"]),
                    *((value, 1.0) for value in item["coherence"]),
                )
            ),
        ]
        for item in result
    ]
    note = "Errors are root mean squares over the band, beyond what noise makes of them."
    return Grid(head, rows, note)


def _channel_table(rig: Rig, log: Table) -> list[Block]:
    rows = [_channel_row(rig, channel) for channel in log.get("channels", [])]
    head = [
        "channel",
        "unit",
        "fit [%]",
        "black box [%]",
        "max error",
        "bias",
        "rms error",
        "residual lags outside",
        "command lags outside",
    ]
    note = (
        "Errors are simulated minus recorded. Black box: the fit of a linear ARX fitted to the "
        "same logs as the model. Lags outside: where the residual correlates beyond the 95 % band."
    )
    return [Grid(head, rows, note)] if rows else []


def _channel_row(rig: Rig, item: Table) -> list[Cell | str]:
    name = item["channel"]
    with_itself, with_commands = item.get("autocorrelation"), item.get("cross_correlation", [])
    worst = max(with_commands, key=lambda c: c["outside_percent"]) if with_commands else None
    label = name + (" (derived)" if item.get("derived") else "")
    outside = "–" if worst is None else f"{worst['outside_percent']:.0f} %"
    return [
        Cell(label, "code", hint=item.get("note", "")),
        pretty(unit_of(rig, name)),
        *(num(number(item.get(key), 3)) for key in ("fit_percent", "baseline_percent")),
        *(
            num(number(float(shown(rig, name, item[key])), 3))
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
