"""One trial: where it ran, how it ended, its figures; under a controller also how it did."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from ehbench.config.rig import Rig
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
from ehbench.report.figures import trial as figures
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved, Table
from ehbench.report.standstill import standstill_caption
from ehbench.report.template import Template
from ehbench.report.trial_captions import (
    ESTIMATES,
    case_caption,
    estimates_caption,
)
from ehbench.report.trial_headlines import trials_findings
from ehbench.report.trial_tables import measure_tables, settings_blocks
from ehbench.report.words import number, words
from ehbench.vocabulary.messages import message


def draw(run: Saved, index: FigureIndex) -> None:
    """Channels of every cylinder that moved; under a controller also estimates and energies."""
    cases = cases_of(run)
    if not cases:
        _draw_cylinders(run, index, _log_of(run))
        return
    record = cases[0].record()
    for case in cases:
        draw_case(run, index, case, record, f"{run.title}: {case.cylinder}")
    _draw_cylinders(run, index, record, but={case.cylinder for case in cases})
    draw_sankey(index, cases[0], "sankey", run.title, FigureKey("sankey"))


def _log_of(run: Saved) -> Record:
    from ehbench.data import read

    return read(run.folder / "log.mcap")


def _draw_cylinders(
    run: Saved, index: FigureIndex, record: Record, but: Collection[str] = ()
) -> None:
    """Commands, motion and pressures of the cylinders that moved, but for some."""
    for cylinder, drawn in channels.live(run.rig, record).items():
        if cylinder not in but:
            title, about = f"{run.title}: {cylinder}", FigureKey("trial", cylinder=cylinder)
            caption = "Commands, motion and pressures."
            path = index.add(f"trial_{cylinder}", title, caption, about)
            channels.trial(path, run.rig, record, cylinder, drawn)


def draw_case(run: Saved, index: FigureIndex, case: Case, record: Record, title: str) -> None:
    """The figure of one trial under a controller, and that of its estimates if they changed."""
    rig = run.rig

    def about(kind: str) -> FigureKey:
        return FigureKey(kind, case=case.row["case"], cylinder=case.cylinder)

    if case.row.get("tip"):
        _draw_tip(rig, index, case, record, title)

    caption = f"{case_caption(rig, case)} {standstill_caption(rig, [case], [record])}".rstrip()
    path = index.add(f"trial_{case.stem}", title, caption, about("trial"))
    figures.controlled(path, rig, case, record)
    learnt = [name for word in ESTIMATES if (name := f"{case.cylinder}.{word}") in record]
    if any(np.ptp(record[name]) > 0.0 for name in learnt):
        caption = estimates_caption(rig, case, record)
        key = f"estimates_{case.stem}"
        path = index.add(key, f"Estimates: {title}", caption, about("estimates"))
        figures.estimates(path, rig, case, record)


def _draw_tip(rig: Rig, index: FigureIndex, case: Case, record: Record, title: str) -> None:
    """Where the tip went, and the oil that it took."""
    page = Template("trial", rig)
    text = f"{page.text('tip', row=case.row)} {page.text('sharing', row=case.row)}"
    about = FigureKey("tip", case=case.row["case"])
    tip.tip(index.add(f"tip_{case.stem}", f"Tip: {title}", text, about), rig, case, record)


def draw_sankey(index: FigureIndex, case: Case, key: str, title: str, about: FigureKey) -> None:
    """Where the energy of a trial went, if it has a ledger."""
    if (ledger := case.energy()) is not None:
        caption = Template("trial").text("sankey", ledger=ledger)
        path = index.add(key, f"Where the energy went: {title}", caption, about)
        sankey.sankey(path, ledger)


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """Where it ran, how it ended, and its figures."""
    facts = run.json("trial.json")
    if facts.get("controller"):
        return _controlled_section(run, facts, pictures)
    stopped, on = facts.get("stopped", ""), facts["on"]
    payload = facts.get("payload", "none")
    table = Grid(["", ""], [["on", on], ["payload", payload], *_circumstances(facts)])
    inside = [*_stopped_text(stopped), *pictures(FigureKey("trial")), table]
    sentence = f"{number(facts['duration'])} s on the {on}, payload {payload}"
    sentence += f"; stopped: {stopped}." if stopped else "."
    return SectionContent(stopped_status(stopped), sentence, [Part("Trial", inside)])


def _stopped_text(stopped: str) -> list[Block]:
    return [Text(f"Stopped by a limit: {stopped}.", "bad")] if stopped else []


def _circumstances(facts: Table) -> list[list[Cell | str]]:
    posture = ", ".join(f"{name} {value}" for name, value in facts.get("posture", {}).items())
    return [
        ["posture", posture or "mid-stroke"],
        ["lasted", f"{number(facts['duration'])} s"],
        ["samples", str(facts["samples"])],
        ["seed", str(facts.get("seed", 0))],
    ]


def _controlled_section(run: Saved, facts: Table, pictures: Pictures) -> SectionContent:
    """One trial under a controller: how it did, its figures, its numbers."""
    cases = cases_of(run)
    case = cases[0]
    rig, row = run.rig, case.row
    stopped = row.get("stopped") or ""
    inside = [
        *_stopped_text(stopped),
        *pictures(FigureKey("tip")),
        *pictures(FigureKey("trial")),
        *pictures(FigureKey("estimates")),
    ]
    parts = [Part("Trial", inside), Part("Measures", measure_tables(rig, cases))]
    if energy := pictures(FigureKey("sankey")):
        parts.append(Part("Energy", [*saving_blocks(rig, [case]), *energy]))
    rows: list[list[Cell | str]] = [
        ["on", facts["on"]],
        ["controller", words(facts["controller"])],
        ["cylinder", ", ".join(item.cylinder for item in cases)],
        ["payload", load_name(row["payload"])],
        *_circumstances(facts),
    ]
    settings = [Grid(["", ""], rows), *settings_blocks(rig, cases)]
    parts.append(Part("Settings", settings, paper=False))
    return SectionContent(stopped_status(stopped), case_caption(rig, case), parts)


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
