"""One trial: where it ran, how it ended, its figures; under a controller also how it did."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ehbench.data.record import Record
from ehbench.report.blocks import Block, Cell, Grid, Part, Text
from ehbench.report.captions import load_name
from ehbench.report.cases import Case, cases_of
from ehbench.report.content import (
    OFTEN,
    Findings,
    Headline,
    Pictures,
    SectionContent,
    StageReport,
    names,
    stopped_status,
)
from ehbench.report.energy_tables import saving_blocks
from ehbench.report.figures import channels, sankey, tip
from ehbench.report.figures import load_plane as plane
from ehbench.report.figures import trial as figures
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved
from ehbench.report.standstill import standstill_caption
from ehbench.report.template import Template
from ehbench.report.trial_captions import ESTIMATES, case_caption, estimates_caption
from ehbench.report.trial_headlines import trials_findings
from ehbench.report.trial_tables import measure_tables, settings_blocks
from ehbench.report.words import number, pretty, shown, unit_of, words
from ehbench.vocabulary.messages import message


def draw(run: Saved, index: FigureIndex) -> None:
    """Channels of every cylinder that moved; under a controller also estimates and energies."""
    from ehbench.data import read

    cases, record = cases_of(run), read(run.folder / "log.mcap")
    for case in cases:
        draw_case(run, index, case, record, f"{run.title}: {case.cylinder}")
    controlled = {case.cylinder for case in cases}
    for cylinder, drawn in channels.live(run.rig, record).items():
        if cylinder not in controlled:
            title, about = f"{run.title}: {cylinder}", FigureKey("trial", cylinder=cylinder)
            caption = Template("trial").text("channels")
            path = index.add(f"trial_{cylinder}", title, caption, about)
            channels.trial(path, run.rig, record, cylinder, drawn)
    for case in cases[:1]:
        draw_sankey(index, case, "sankey", run.title, FigureKey("sankey"))
        if all(f"{case.cylinder}.{word}" in record for word in ("v", "p_head", "p_rod")):
            about = FigureKey("load", cylinder=case.cylinder)
            caption = Template("trial").text("load")
            path = index.add("load", f"Load and speed: {run.title}", caption, about)
            plane.load_plane(path, run.rig, record, case.cylinder)


def draw_case(run: Saved, index: FigureIndex, case: Case, record: Record, title: str) -> None:
    """The figure of one trial under a controller, and that of its estimates if they changed."""
    rig, case_name = run.rig, case.row["case"]
    if case.row.get("tip"):
        page = Template("trial", rig)
        text = f"{page.text('tip', row=case.row)} {page.text('sharing', row=case.row)}"
        path = index.add(
            f"tip_{case.stem}", f"Tip: {title}", text, FigureKey("tip", case=case_name)
        )
        tip.tip(path, rig, case, record)
    caption = f"{case_caption(rig, case)} {standstill_caption(rig, [case], [record])}".rstrip()
    about = FigureKey("trial", case=case_name, cylinder=case.cylinder)
    path = index.add(f"trial_{case.stem}", title, caption, about)
    figures.controlled(path, rig, case, record)
    learnt = [name for word in ESTIMATES if (name := f"{case.cylinder}.{word}") in record]
    if any(np.ptp(record[name]) > 0.0 for name in learnt):
        caption = estimates_caption(rig, case, record)
        key = f"estimates_{case.stem}"
        about = FigureKey("estimates", case=case_name, cylinder=case.cylinder)
        path = index.add(key, f"Estimates: {title}", caption, about)
        figures.estimates(path, rig, case, record)


def draw_sankey(index: FigureIndex, case: Case, key: str, title: str, about: FigureKey) -> None:
    """Where the energy of a trial went, if it has a ledger."""
    if (ledger := case.energy()) is not None:
        caption = Template("trial").text("sankey", ledger=ledger)
        path = index.add(key, f"Where the energy went: {title}", caption, about)
        sankey.sankey(path, ledger)


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """Where it ran, how it ended, and its figures; under a controller also how it did."""
    facts, cases, page = run.json("trial.json"), cases_of(run), Template("trial", run.rig)
    stopped, on = facts.get("stopped", ""), facts["on"]
    payload = facts.get("payload", "none")
    posture = ", ".join(f"{name} {value}" for name, value in facts.get("posture", {}).items())
    rows: list[list[Cell | str]] = [
        ["on", on],
        ["payload", load_name(payload) if cases else payload],
        ["posture", posture or "mid-stroke"],
        ["lasted", f"{number(facts['duration'])} s"],
        ["samples", str(facts["samples"])],
        ["seed", str(facts.get("seed", 0))],
    ]
    inside: list[Block] = [Text(page.text("stopped", reason=stopped), "bad")] if stopped else []
    for kind in ("tip", "trial", "load", "estimates"):
        inside += pictures(FigureKey(kind))
    if not cases:
        parts = [Part("Trial", [*inside, Grid(["", ""], rows)]), *_link_parts(run, facts)]
        fields = {"duration": facts["duration"], "on": on, "payload": payload, "stopped": stopped}
        return SectionContent(stopped_status(stopped), page.text("open_loop", **fields), parts)
    rows.insert(1, ["controller", words(facts["controller"])])
    rows.insert(2, ["cylinder", ", ".join(item.cylinder for item in cases)])
    parts = [Part("Trial", inside), Part("Measures", measure_tables(run.rig, cases))]
    parts += _link_parts(run, facts)
    if energy := pictures(FigureKey("sankey")):
        parts.append(Part("Energy", [*saving_blocks(run.rig, cases[:1]), *energy]))
    settings = [Grid(["", ""], rows), *settings_blocks(run.rig, cases)]
    parts.append(Part("Settings", settings, paper=False))
    return SectionContent(stopped_status(stopped), case_caption(run.rig, cases[0]), parts)


def _link_parts(run: Saved, facts: Mapping[str, Any]) -> list[Part]:
    """How a machine behind a link differed from its dry run on the model, and how the link did;
    nothing of a trial in this process.
    """
    if "link" not in facts:
        return []
    link, rows, lines = facts["link"], [], []
    for name, apart in facts["dry_run"]["differences"].items():
        values = (number(shown(run.rig, name, apart[key]), 3) for key in ("largest", "rms"))
        rows.append([name, *values, pretty(unit_of(run.rig, name))])
    for name in ("command_delay", "sample_delay"):
        if name in link:
            value, low, high = (number(1e3 * item, 3) for item in link[name])
            lines.append([name.replace("_", " "), f"{value} ms ({low} … {high})"])
    packets = ", ".join(f"{n} {why}" for why, n in link.get("rejected", {}).items()) or "none"
    lines.append(["late ticks", f"{link['late']} of {link['ticks']}"])
    lines.append(["packets that did not count", packets])
    head = ["machine less dry run", "largest", "rms", ""]
    return [Part("Dry run and machine", [Grid(head, rows), Grid(["link", ""], lines)])]


def findings(run: Saved) -> Findings:
    facts = run.json("trial.json")
    if facts.get("controller"):
        return trials_findings(run)
    stopped, page = facts.get("stopped", ""), Template("headlines")
    against = [page.text("stopped", name=run.title, reason=stopped)] if stopped else []
    value, payload = f"{number(facts['duration'])} s", load_name(facts.get("payload", "none"))
    numbers = [Headline(OFTEN, f"Trial on the {facts['on']}", value, payload)]
    step = message("steps.stopped" if stopped else "steps.fit_log", **names(run))
    return Findings(numbers, [FigureKey("trial")], against, [step])


REPORT = StageReport(
    "trial",
    section,
    draw,
    findings,
    shows=("Measures", "Trial"),
    numbers=("trial.json", ("duration", "stopped", "measures")),
)
