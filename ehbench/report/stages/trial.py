"""One trial: where it ran, how it ended, its figures; under a controller also how it did."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.report import content
from ehbench.report.blocks import Block, Cell, Grid, Part, Text
from ehbench.report.cases import Case, by_controller, cases_of, damping
from ehbench.report.energy_tables import Saving, saving_blocks, savings_of
from ehbench.report.figures import sankey
from ehbench.report.figures import trial as figures
from ehbench.report.saved import FigureIndex, Saved
from ehbench.report.template import Template
from ehbench.report.trial_captions import (
    ESTIMATES,
    case_caption,
    estimates_caption,
    standstill_caption,
)
from ehbench.report.trial_tables import measure_tables, settings_blocks
from ehbench.report.words import (
    MODEL,
    load_name,
    measure,
    number,
    pretty,
    shown,
    span,
    unit_of,
    words,
)
from ehbench.vocabulary import grouped, message


def draw(run: Saved, index: FigureIndex) -> None:
    """Channels of every cylinder that moved; under a controller also estimates and energies."""
    from ehbench.data import read

    cases, record = cases_of(run), read(run.folder / "log.mcap")
    for case in cases:
        draw_case(run, index, case, record, f"{run.title}: {case.cylinder}")
    controlled = {case.cylinder for case in cases}
    for cylinder, drawn in figures.moving(run.rig, record).items():
        if cylinder not in controlled:
            key, title = f"trial_{cylinder}", f"{run.title}: {cylinder}"
            caption = Template("trial").text("channels")
            path = index.add(key, title, caption, "trial", cylinder=cylinder)
            figures.uncontrolled(path, run.rig, record, cylinder, drawn)
    for case in cases[:1]:
        draw_sankey(index, case, "sankey", run.title)
        if all(f"{case.cylinder}.{word}" in record for word in ("v", "p_head", "p_rod")):
            title, caption = f"Load and speed: {run.title}", Template("trial").text("load")
            path = index.add("load", title, caption, "load", cylinder=case.cylinder)
            figures.load_plane(path, run.rig, record, case.cylinder)


def draw_case(run: Saved, index: FigureIndex, case: Case, record: Record, title: str) -> None:
    """The figure of one trial under a controller, and that of its estimates if they changed."""
    rig, case_name = run.rig, case.row["case"]
    if case.row.get("tip"):
        page = Template("trial", rig)
        text = f"{page.text('tip', row=case.row)} {page.text('sharing', row=case.row)}"
        path = index.add(f"tip_{case.stem}", f"Tip: {title}", text, "tip", case=case_name)
        figures.tip(path, rig, case, record)
    caption = f"{case_caption(rig, case)} {standstill_caption(rig, [case], [record])}".rstrip()
    about = {"case": case_name, "cylinder": case.cylinder}
    path = index.add(f"trial_{case.stem}", title, caption, "trial", **about)
    figures.controlled(path, rig, case, record)
    learnt = [name for word in ESTIMATES if (name := f"{case.cylinder}.{word}") in record]
    if any(np.ptp(record[name]) > 0.0 for name in learnt):
        caption = estimates_caption(rig, case, record)
        key = f"estimates_{case.stem}"
        path = index.add(key, f"Estimates: {title}", caption, "estimates", **about)
        figures.estimates(path, rig, case, record)


def draw_sankey(index: FigureIndex, trial: Case, key: str, title: str, **about: str) -> None:
    """Where the energy of a trial went, if its ledger knows."""
    if (ledger := trial.energy()) is not None and sankey.is_known(ledger):
        caption = Template("trial").text("sankey", ledger=ledger)
        path = index.add(key, f"Where the energy went: {title}", caption, "sankey", **about)
        sankey.sankey(path, ledger)


def section(run: Saved, pictures: content.Pictures) -> content.SectionContent:
    """Where it ran, how it ended, and its figures; under a controller also how it did."""
    facts, cases, page = run.json("trial.json"), cases_of(run), Template("trial", run.rig)
    stopped, on, payload = facts.get("stopped", ""), facts["on"], facts.get("payload", "none")
    status = "stopped" if stopped else "done"
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
        inside += pictures(kind=kind)
    if not cases:
        parts = [Part("Trial", [*inside, Grid(["", ""], rows)]), *_link_parts(run, facts)]
        fields = {"duration": facts["duration"], "on": on, "payload": payload, "stopped": stopped}
        return content.SectionContent(status, page.text("open_loop", **fields), parts)
    rows.insert(1, ["controller", words(facts["controller"])])
    rows.insert(2, ["cylinder", ", ".join(item.cylinder for item in cases)])
    parts = [Part("Trial", inside), Part("Measures", measure_tables(run.rig, cases))]
    parts += _link_parts(run, facts)
    if energy := pictures(kind="sankey"):
        parts.append(Part("Energy", [*saving_blocks(run.rig, cases[:1]), *energy]))
    settings = [Grid(["", ""], rows), *settings_blocks(run.rig, cases)]
    parts.append(Part("Settings", settings, paper=False))
    return content.SectionContent(status, case_caption(run.rig, cases[0]), parts)


def _link_parts(run: Saved, facts: Mapping[str, Any]) -> list[Part]:
    """How a linked machine differed from its dry run, and how the link did, if any."""
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


def findings(run: Saved) -> content.Findings:
    facts = run.json("trial.json")
    if facts.get("controller"):
        return trials_findings(run)
    stopped, page = facts.get("stopped", ""), Template("headlines")
    against = [page.text("stopped", name=run.title, reason=stopped)] if stopped else []
    value, payload = f"{number(facts['duration'])} s", load_name(facts.get("payload", "none"))
    numbers = [content.Headline(content.OFTEN, f"Trial on the {facts['on']}", value, payload)]
    key = "stopped" if stopped else "fit_machine" if "link" in facts else "fit_log"
    return content.Findings(
        numbers, [{"kind": "trial"}], against, [message(f"steps.{key}", **content.names(run))]
    )


def trials_findings(run: Saved) -> content.Findings:
    rig, cases, page = run.rig, cases_of(run), Template("headlines", run.rig)
    against = [
        page.text("stopped", name=case.row["case"], reason=case.row["stopped"])
        for case in cases
        if case.row.get("stopped")
    ]
    numbers = [*_tracked(rig, cases), *_saved(page, cases)]
    ratios = {
        law: [ratio for case in group for ratio, _ in map(damping, case.steps) if ratio is not None]
        for law, group in by_controller([case for case in cases if case.fit]).items()
    }
    ratios = {law: values for law, values in ratios.items() if values}
    if ratios:  # of steps under the best damped controller, and under the least damped
        best, worst = (pick(ratios, key=lambda law: min(ratios[law])) for pick in (max, min))
        fields = {"best": best, "worst": worst, "ratios": ratios[worst], "on": cases[0].row["on"]}
        about, value = page.text("damped", **fields), span(ratios[best], 2)
        label = "Damping ratio of steps"
        numbers.append(content.Headline(content.STEPS, label, value, about, _modelled(cases)))
    figures = [{"kind": kind} for kind in ("energy", "compare", "trial")]
    steps = [message("steps.stopped", **content.names(run))] if against else []
    if cases and _modelled(cases) and not against:  # what stopped here would stop there
        steps = [message("steps.on_machine")]
    return content.Findings(numbers, figures, against, steps)


def _tracked(rig: Rig, cases: Sequence[Case]) -> list[content.Headline]:
    """The largest error of the controller that tracks best, of motions that are no steps: that of
    the tip where there is one, of the true stroke where it is known. A four-way valve that others
    are compared with is no choice."""
    spools = [item.case for item in savings_of(cases) if item.is_spool]
    fit = [case for case in cases if case.fit and not case.steps]
    fit = [case for case in fit if case not in spools] or fit
    tips = [case for case in fit if case.row.get("tip")]
    kind, quantity = ("tip", "tip_error") if tips else ("tracking", "x")

    def error(case: Case) -> float:
        return (case.row.get(f"{kind}_true") or case.row[kind])["max_error"]

    groups = {case.row["case"]: [case] for case in tips} if tips else by_controller(fit)
    if not groups:
        return []
    group = min(groups.values(), key=lambda group: max(map(error, group)))
    worst = max(group, key=error)
    law = worst.row["controller"]
    law = law.removesuffix(f", {worst.cylinder}") if tips else law
    page, errors = Template("headlines", rig), [error(case) for case in group]
    about = page.text("tracked", law=law, case=worst, errors=errors)
    label = "Largest tip error" if tips else "Largest tracking error"
    value = measure(rig, quantity, error(worst), 2)
    return [content.Headline(content.TRACKING, label, value, about, _modelled(group))]


def _saved(page: Template, cases: Sequence[Case]) -> list[content.Headline]:
    """What the controller that saves most draws less than a four-way valve."""
    savings = [item for item in savings_of(cases) if not item.is_spool]
    groups = grouped(savings, lambda item: item.case.row["controller"])
    if not groups:
        return []
    compared = all(item.reference is not None for group in groups.values() for item in group)

    def share(item: Saving) -> float:
        return item.saved if compared and item.saved is not None else item.limits["saving"]

    law = max(groups, key=lambda key: min(map(share, groups[key])))
    group = groups[law]
    halves = [100.0 * item.half / item.limits["standard"] for item in group if item.half]
    fields = {"compared": compared, "law": law, "on": group[0].case.row["on"], "halves": halves}
    value = f"{span([100.0 * share(item) for item in group], 2)} %"
    on_model = _modelled([item.case for item in group])
    return [
        content.Headline(
            content.SAVED, "Pump energy saved", value, page.text("saved", **fields), on_model
        )
    ]


def _modelled(cases: Sequence[Case]) -> bool:
    return all(case.row["on"] == MODEL for case in cases)
