"""Validation: verdict, reasons, checks, and each log's errors, ringing, correlations."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.report import content
from ehbench.report.blocks import Block, Bullets, Fold, Part, Text
from ehbench.report.comparisons import draw_comparisons, draw_responses
from ehbench.report.saved import FigureIndex, Saved, Table
from ehbench.report.style import MUTED, RECORDED, canvas, cycled, key, legend
from ehbench.report.template import Template
from ehbench.report.words import number, title_of, words
from ehbench.vocabulary import Message, grouped, message


def draw(run: Saved, index: FigureIndex) -> None:
    """For each log recorded against simulated, then the correlations of its residuals."""
    caption = Template("validation").text("residuals")
    table = run.json("validation.json")
    coherence = table.get("thresholds", {}).get("response_coherence", 0.0)
    for log in table["logs"]:
        name, status = log["name"], log.get("status", "held_out")
        lead = "Held out" if status == "held_out" else words(status).capitalize()
        draw_comparisons(run, index, name, "validation", lead)
        whole = (item for item in log["channels"] if item.get("autocorrelation") is not None)
        by_cylinder = grouped(whole, lambda item: item["channel"].rpartition(".")[0])
        for cylinder, channels in by_cylinder.items():
            about = {"log": name, "cylinder": cylinder}
            key, title = f"residuals_{name}_{cylinder}", f"Residuals of {words(name)}, {cylinder}"
            draw_correlations(index.add(key, title, caption, "residuals", **about), channels)
        for command, result in grouped(log.get("sweeps", []), lambda item: item["input"]).items():
            key = f"sweep_{name}_{command.replace('.', '_')}"
            draw_responses(run, index, "sweep", name, key, result, coherence)


def draw_correlations(path: Path, channels: Sequence[Table]) -> None:
    """Each residual's correlation with itself and with earlier commands, with bands."""
    crossed = [item for channel in channels for item in channel.get("cross_correlation", [])]
    commands = dict.fromkeys(item["of"] for item in crossed)
    looks = {name: cycled(i) for i, name in enumerate(commands)}
    rows = 2 if crossed else 1
    shape = {"sharex": True, "sharey": True, "squeeze": False}
    with canvas(path, rows, len(channels), (7.4, 1.75 * rows + 0.5), **shape) as (figure, axes):
        for column, channel in enumerate(channels):
            top, auto = axes[0, column], channel["autocorrelation"]
            _banded(top, [auto], {auto["of"]: {"color": RECORDED, "linestyle": "-"}})
            top.set_title(title_of(channel["channel"]), fontsize=8.5)
            if crossed:
                _banded(axes[1, column], channel.get("cross_correlation", []), looks)
            axes[-1, column].set_xlabel("lag [s]")
        axes[0, 0].set_ylim(-1.05, 1.05)
        axes[0, 0].set_ylabel("with itself [1]")
        if crossed:
            axes[1, 0].set_ylabel("with commands [1]")
            legend(figure, [key(n.removesuffix(".command"), **look) for n, look in looks.items()])


def _banded(ax, correlations: Sequence[Table], looks: dict) -> None:
    for correlation in correlations:
        lag, value, band = (np.array(correlation[key], float) for key in ("lag", "value", "band"))
        ax.fill_between(
            lag, -band, band, color=MUTED, alpha=0.22 / len(correlations) ** 0.5, linewidth=0
        )
        ax.plot(lag, value, linewidth=1.1, **looks[correlation["of"]])
    ax.axhline(0.0, color=MUTED, linewidth=0.6)


def section(run: Saved, pictures: content.Pictures) -> content.SectionContent:
    """Verdict, checks, errors by channel, ringing side by side, and a figure a log."""
    table, page = run.json("validation.json"), Template("validation", run.rig)
    status = "accepted" if table["accepted"] else "rejected"
    if table["accepted"] and table.get("reservations"):
        status = "accepted_with_reservation"
    diagnosis = table.get("structure") or {"findings": [], "follows": []}
    diagnosed: list[Block] = []
    if faults := diagnosis["findings"]:
        diagnosed = [Text(page.text("faults")), page.table("fault_table", faults)]
    if follows := diagnosis["follows"]:
        title = page.text("follows_title", follows=follows)
        diagnosed = diagnosed or [Text(page.text("no_faults"))]
        diagnosed.append(Fold(title, [page.table("follows", follows)]))
    others = page.table("others", others_rows(table))
    parts = [
        Part("Verdict", _verdict(page, table, status)),
        Part("Compared with what others reached", [others] if others.rows else []),
        Part("What the residuals follow", diagnosed),
        *(
            Part(words(log["name"]).capitalize(), _log_blocks(page, log, pictures))
            for log in table["logs"]
        ),
    ]
    logs, fits = held_out(table), {}
    for channel in (channel for log in logs for channel in log.get("channels", [])):
        if channel.get("fit_percent") is not None:
            word = channel["channel"].rsplit(".", 1)[1]
            fits.setdefault(word, []).append(channel["fit_percent"])
    checks = [bool(check["passed"]) for log in logs for check in log.get("checks", [])]
    fields: dict[str, Any] = {"checks": len(checks), "failed": checks.count(False)}
    fields["doubt"] = next(iter(doubts(table)), {})
    fields["reservation"] = next(iter(table.get("reservations", [])), "")
    sentence = page.text("sentence", status=status, logs=logs, fits=fits, **fields)
    return content.SectionContent(status, sentence, parts)


def _verdict(page: Template, table: Table, status: str) -> list[Block]:
    blocks: list[Block] = [Text(page.text("verdict", status=status), content.look_of(status))]
    if table["reasons"]:
        blocks.append(Bullets(table["reasons"]))
    if reservations := table.get("reservations", []):
        blocks += [Text(page.text("reservations")), Bullets(reservations, "warn")]
    if table["accepted"] and (left := left_over(table)):
        blocks.append(Bullets(left, "warn"))
    if unjudged := silence(table):
        blocks.append(Text(unjudged, "note"))
    blocks.append(page.table("logs", table["logs"], result=_result))
    channels = [(log, item) for log in table["logs"] for item in log.get("channels", [])]
    channels = [row for row in channels if row[1].get("baseline_percent") is not None]
    if channels:
        blocks.append(page.table("black_box", channels, box=table["black_box"]))
    checks = [(log, check) for log in table["logs"] for check in log.get("checks", [])]
    if checks:
        title = page.text("checks", checks=checks)
        blocks.append(Fold(title, [page.table("check_table", checks)]))
    return blocks


def _result(log: Table) -> str:
    """How a log counts; a model is rejected by more than its thresholds."""
    if log.get("failure"):
        return "failed"
    if log["status"] != "held_out":
        return "shown only"
    return "checks passed" if log.get("passed") else "checks failed"


def others_rows(table: Table) -> list[dict[str, Any]]:
    """What others and this model reached on the same recordings, the best first."""
    others, rows = table.get("references", []), []
    for channel, measure in dict.fromkeys((other["channel"], other["measure"]) for other in others):
        results = [
            (other["value"], other["name"], other["source"])
            for other in others
            if (other["channel"], other["measure"]) == (channel, measure)
        ]
        results += [
            (item[measure], "this model", words(log["name"]))
            for log in table["logs"]
            for item in log.get("channels", [])
            if item["channel"] == channel and item.get(measure) is not None
        ]
        fit = measure == "fit_percent"
        rows += [
            {"value": value, "name": name, "source": source, "channel": channel, "fit": fit}
            for value, name, source in sorted(results, reverse=fit)
        ]
    return rows


def _log_blocks(page: Template, log: Table, pictures: content.Pictures) -> list[Block]:
    """One log: figures, errors by channel, ringing, residual correlations, warnings."""
    blocks: list[Block] = []
    if log.get("failure"):
        blocks.append(Text(page.text("unsimulated", reason=log["failure"]), "bad"))
    if scored := log.get("scored"):
        blocks.append(Text(page.text("scored", ends=scored)))
    blocks += pictures(kind="validation", log=log["name"])
    if channels := log.get("channels", []):
        blocks.append(page.table("channels", channels))
    if sensors := log.get("sensors", {}):
        blocks.append(Text(page.text("sensors", sensors=sensors), "note"))
    if rings := log.get("transients", []):
        ringing = Template("comparisons", page.rig)
        blocks.append(ringing.table("ringing", rings, with_log=False))
        if notes := [page.text("unjudged", ring=ring) for ring in rings if ring.get("note")]:
            blocks.append(Bullets(notes, "note"))
    if swept := log.get("sweeps", []):
        blocks += pictures(kind="sweep", log=log["name"])
        blocks.append(page.table("sweeps", swept))
    if residuals := pictures(kind="residuals", log=log["name"]):
        blocks.append(Fold("Residual correlations", residuals))
    if log.get("warnings"):
        blocks.append(Bullets(log["warnings"], "note"))
    return blocks


def findings(run: Saved) -> content.Findings:
    table, page = run.json("validation.json"), Template("headlines", run.rig)
    logs = held_out(table)
    fits = [
        (item["fit_percent"], item["channel"], log["name"])
        for log in logs
        for item in log.get("channels", [])
        if item.get("fit_percent") is not None
    ]
    numbers, figures = [], [{"kind": "validation"}]
    if fits:
        worst, channel, log = min(fits)
        is_judged = channel.rpartition(".")[2] in judged(table)
        fields = {"channel": channel, "log": log, "best": max(fits)[0], "judged": is_judged}
        label, about = page.text("worst_fit_label", logs=logs), page.text("worst_fit", **fields)
        numbers = [content.Headline(content.FIT, label, f"{number(worst, 2)} %", about)]
        figures = [{"kind": "validation", "log": log}, *figures]
    first: dict[str, Message] = {}  # by what each one changes
    for doubt in [*doubts(table), *(table.get("structure") or {}).get("findings", [])]:
        if "where" in doubt:
            first.setdefault(doubt["line"], content.written_step(doubt))
        elif remedy := doubt.get("remedy"):
            changes = getattr(remedy, "fields", {}).get("names") or remedy
            first.setdefault(changes, content.remedy_step(remedy))
    steps = [*first.values()][:3]
    if not table["accepted"] and not steps:
        checks = (check for log in logs for check in log.get("checks", []))
        failed = dict.fromkeys(check["what"] for check in checks if not check["passed"])
        text = "; ".join([*failed][:3]) or page.text("not_judged")
        steps = [message("steps.failing", **content.names(run), checks=text)]
    against = table["reasons"] or [*table.get("reservations", []), *left_over(table)]
    return content.Findings(numbers, figures, against, steps)


def held_out(table: Table) -> list[Table]:
    """The logs that a verdict goes by."""
    return [log for log in table["logs"] if log["status"] == "held_out"]


def doubts(table: Table) -> list[Mapping[str, Any]]:
    """The fields of what speaks against a model and can be put right: what is odd about its logs,
    then what explains a tenth more of a residual before what explains less. A cause that moves no
    number comes after a fixed number for which a model is rejected."""
    reasons, others = (
        [getattr(item, "fields", {}) for item in table.get(key, [])]
        for key in ("reasons", "reservations")
    )
    denied = min(
        (content.weight(fields) for fields in reasons if "estimate" in fields), default=math.inf
    )
    caps = [math.inf] * len(reasons) + [
        denied if "cause" in fields else math.inf for fields in others
    ]
    every = zip([*reasons, *others], caps, strict=True)
    able = [(item, cap) for item, cap in every if item.keys() & {"remedy", "where"}]
    able.sort(key=lambda pair: -min(content.weight(pair[0]), pair[1]))
    return [item for item, _ in able]


def left_over(table: Table) -> list[str]:
    """The likeliest fault in the residuals with its remedy, if no reservation has it."""
    reservations = " ".join(table.get("reservations", []))
    findings = (table.get("structure") or {}).get("findings", [])
    results = [finding for finding in findings if finding["sentence"] not in reservations]
    return [Template("headlines").text("residual", item=item) for item in results[:1]]


def judged(table: Table) -> list[str]:
    """The channels whose fit or error a verdict goes by."""
    limits = table.get("thresholds", {})
    return [word for key in ("fit_percent", "max_error") for word in limits.get(key, {})]


def silence(table: Table) -> str:
    """What a verdict does not go by, and what it would give; empty if it goes by all."""
    page, limits = Template("headlines"), table.get("thresholds", {})
    channels = [channel for log in held_out(table) for channel in log.get("channels", [])]
    fits: dict[str, list[float]] = {}
    for channel in channels:
        word = channel["channel"].rpartition(".")[2]
        if channel.get("fit_percent") is not None and word not in judged(table):
            fits.setdefault(word, []).append(channel["fit_percent"])
    parts = [page.text("silent_fit", word=word, fits=fit) for word, fit in fits.items()]
    limit = limits.get("outside_percent")
    for test in ("whiteness", "independence"):
        shares = [
            [item["outside_percent"] for item in channel.get("cross_correlation", [])]
            if test == "independence"
            else [item["outside_percent"] for item in [channel.get("autocorrelation")] if item]
            for channel in channels
        ]
        tested = [item for item in shares if item]
        beyond = sum(max(item) > limit for item in tested) if limit is not None else 0
        if beyond and not limits.get(test):
            fields = {"key": test, "limit": limit, "beyond": beyond, "tested": len(tested)}
            parts.append(page.text("silent_test", **fields))
    return page.text("silence", parts=parts)
