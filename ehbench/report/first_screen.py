"""The first screen of a report: five numbers, the verdict, one figure, what to do next."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ehbench.report.blocks import Block, Bullets, Card, Cards, Cell, Grid, Text
from ehbench.report.content import (
    OFTEN,
    SAVED,
    STEPS,
    TRACKING,
    Findings,
    Headline,
    Pictures,
    SectionContent,
    StageReport,
    chip,
    names,
)
from ehbench.report.saved import Saved
from ehbench.report.stages import report_of
from ehbench.report.template import Template
from ehbench.report.words import capital, sentence, words
from ehbench.vocabulary import Message, message
from ehbench.vocabulary.messages import ranked

_PAGE = Template("headlines")
# kinds of runs in their order, and how to go on where they end
_CHAIN = {
    "flow_map": "steps.with_maps",
    "hydraulics": "steps.judge",
    "validation": "steps.tune",
    "tuning": "steps.try_gains",
    "arc_tuning": "steps.try_gains",
}


def chapters_of(runs: Sequence[Saved], pictures: Sequence[Pictures]) -> list[Chapter]:
    """The runs of a page with what their sections say, in their order; their figures by run."""
    chapters = []
    for place, (run, drawn) in enumerate(zip(runs, pictures, strict=True), 1):
        stage = report_of(run)
        content, findings = stage.section(run, drawn), stage.findings(run)
        chapters.append(Chapter(run, stage, content, drawn, findings, f"run-{place}"))
    return chapters


@dataclass(frozen=True)
class Chapter:
    """A run of the page with what its section says and its figures; its anchor is ``run-1``, …."""

    run: Saved
    stage: StageReport
    content: SectionContent
    pictures: Pictures
    findings: Findings
    anchor: str


def first_screen(chapters: Sequence[Chapter]) -> list[Block]:
    """Cards, verdict, figure and next steps; at most four reasons and steps."""
    cards = cards_of(chapters)
    blocks: list[Block] = [Cards(cards)] if cards else []
    blocks += _verdict(chapters, 4)
    # the first figure of the furthest run with one, preferring machines
    drawn = [chapter for chapter in reversed(chapters) if chapter.findings.figures]
    machine = [c for c in drawn if not any(number.on_model for number in c.findings.numbers)]
    pictures = (
        (picture, chapter.run.title)
        for chapter in [*machine, *drawn]
        for key in chapter.findings.figures
        for picture in chapter.pictures(**key)[:1]
    )
    if first := next(pictures, None):
        picture, title = first
        svg = re.sub(r'id="|href="#|url\(#', r"\g<0>first-", picture.svg)  # ids of its own
        caption = _PAGE.text("again", name=title)
        again = {"id": "first-figure", "caption": caption, "paper": True}
        blocks.append(replace(picture, svg=svg, **again))
    if steps := next_steps(chapters)[:4]:
        texts = [f"{capital(step)}: {step.hint}" if step.hint else sentence(step) for step in steps]
        blocks += [Text(_PAGE.text("next_head"), "head"), Bullets(texts)]
    return blocks


def summary(chapters: Sequence[Chapter]) -> tuple[str, Grid, list[Message]]:
    """Verdict, main numbers and next steps over several runs."""
    verdict = next((b.text for b in _verdict(chapters, 0) if isinstance(b, Text)), "")
    rows = [[card.label, card.value, card.about] for card in cards_of(chapters)]
    return verdict, Grid(["number", "value", "about"], rows), next_steps(chapters)


def overview(chapters: Sequence[Chapter]) -> Grid:
    """A row a run: its stage, its status and its first numbers."""
    rows: list[list[Cell | str]] = []
    for item in chapters:
        numbers = "; ".join(
            f"{number.label[:1].lower()}{number.label[1:]} {number.value}"
            for number in item.findings.numbers[:2]
        )
        link = Cell(item.run.title, link=f"#{item.anchor}")
        status = chip(item.content.status)
        rows.append([link, item.stage.label, status, numbers or item.content.sentence])
    return Grid(["run", "stage", "status", "in short"], rows, look="stack")


def cards_of(chapters: Sequence[Chapter]) -> list[Card]:
    """Five numbers: one of each rank, of machines and runs others build on first, then others."""
    inputs = [i for c in chapters if c.run.what == "validation" for i in c.run.facts["inputs"]]
    used = {Path(item["path"]).name for item in inputs}
    best: dict[int, tuple[tuple[bool, bool, int], Chapter, Headline]] = {}
    others: list[tuple[Chapter, Headline]] = []
    for place, chapter in enumerate(chapters):
        for number in chapter.findings.numbers:
            weight = (not number.on_model, chapter.run.folder.name in used, place)
            if number.rank >= OFTEN:
                others.append((chapter, number))
            elif number.rank not in best or weight >= best[number.rank][0]:
                best[number.rank] = (weight, chapter, number)
    chosen = [(chapter, item) for _, (_, chapter, item) in sorted(best.items())]
    several = len({chapter.run.rig.name for chapter in chapters if chapter.run.has_rig}) > 1
    cards = []
    for chapter, item in (chosen + others)[:5]:
        rig = f"{words(chapter.run.rig.name)}: " if several and chapter.run.has_rig else ""
        cards.append(Card(item.label, item.value, rig + item.about, f"#{chapter.anchor}"))
    return cards


def _verdict(chapters: Sequence[Chapter], maximum: int) -> list[Block]:
    """What validation says of the model, then what speaks against any result."""
    judged = [chapter for chapter in chapters if chapter.run.what == "validation"]
    statuses = {chapter.run.title: chapter.content.status for chapter in judged}
    rejected = [title for title, status in statuses.items() if status == "rejected"]
    if not judged:
        text, look = _PAGE.text("no_verdict"), "warn"
    elif rejected:
        text, look = _PAGE.text("rejected", names=rejected), "bad"
    else:
        logs = set().union(*(logs_judged(chapter.run) for chapter in judged))
        reserved = [title for title, status in statuses.items() if status != "accepted"]
        text = _PAGE.text("accepted", count=len(logs), names=reserved)
        look = "warn" if reserved else "good"
    doubts: list[str] = []
    stated: set[str] = set()
    for chapter in chapters:
        # what a fit is sensitive to is a reservation of its validations too
        against = [item for item in chapter.findings.against if item not in stated]
        stated |= set(against)
        if against:
            doubts.append(_PAGE.text("against", name=chapter.run.title, reasons=against))
    blocks: list[Block] = []
    if any(chapter.run.what != "study" for chapter in chapters):
        blocks.append(Text(text, look))
    if doubts:
        items = [sentence(doubt) for doubt in doubts[:maximum]]
        blocks += [Text(_PAGE.text("against_head"), "head"), Bullets(items, "warn")]
    return blocks


def logs_judged(run: Saved) -> set[str]:
    """The logs that count, by their bytes and windows: several runs may judge the same."""
    logs = run.json("validation.json")["logs"]
    inputs = run.facts.get("inputs", [])
    digests = [item["sha256"] for item in inputs if item.get("role") == "log"]
    if len(digests) != len(logs):
        digests = [f"{run.folder} {index}" for index in range(len(logs))]
    return {
        f"{digest} {log.get('scored')}"
        for digest, log in zip(digests, logs)
        if log["status"] == "held_out"
    }


def next_steps(chapters: Sequence[Chapter]) -> list[Message]:
    """What the runs ask for, and the next link of the chain, the most valuable first."""
    steps = [step for chapter in chapters for step in chapter.findings.next]
    kinds = {chapter.run.what: chapter.run for chapter in chapters}
    numbers = [number for chapter in chapters for number in chapter.findings.numbers]
    measured = (TRACKING, SAVED, STEPS)  # ranks of numbers that trials give
    on_machine = any(number.rank in measured and not number.on_model for number in numbers)
    if on_machine:
        steps = [step for step in steps if step.key != "steps.on_machine"]
    failing = any(c.content.status in ("rejected", "missed", "stopped") for c in chapters)
    last = next((kind for kind in reversed(_CHAIN) if kind in kinds), None)
    if last is not None and not failing and not {"trial", "trials"} & {*kinds}:
        steps.append(message(_CHAIN[last], **names(kinds[last])))
    if not steps and on_machine and "validation" in kinds:
        steps.append(message("steps.other_conditions"))
    return ranked(steps)
