"""The first screen of a report: five numbers, the verdict, one figure, what to do next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ehbench.report.blocks import Block, Bullets, Card, Cards, Cell, Grid, Picture, Text
from ehbench.report.captions import capital, sentence
from ehbench.report.content import Pictures, SectionContent, StageReport, chip
from ehbench.report.headlines import (
    OFTEN,
    SAVED,
    STEPS,
    TRACKING,
    Findings,
    Headline,
    findings_of,
    names,
)
from ehbench.report.saved import Saved
from ehbench.report.words import count, words
from ehbench.vocabulary.messages import Message, message, ranked

MANY = 5  # numbers on the first screen
MEASURED = (TRACKING, SAVED, STEPS)  # ranks of numbers that trials give
SHOWN = 4  # reasons and next steps on it
# what makes a chain whole, in its order, and how to go on where it ends
_CHAIN = {
    "flow_map": "steps.with_maps",
    "hydraulics": "steps.judge",
    "validation": "steps.tune",
    "tuning": "steps.try_gains",
    "arc_tuning": "steps.try_gains",
}


def first_screen(
    runs: Sequence[Saved], contents: Sequence[SectionContent], pictures: Sequence[Pictures]
) -> list[Block]:
    """Cards, verdict, figure, next steps, and the table of the chapters.

    Args:
        runs: in the order of the page; their anchors are ``run-1``, ``run-2``, ….
        contents: what each of them tells.
        pictures: the figures of each.
    """
    results = [findings_of(run) for run in runs]
    blocks: list[Block] = []
    if cards := _cards(runs, results):
        blocks.append(Cards(cards))
    blocks += _verdict(runs, contents, results)
    blocks += _figure(runs, results, pictures)
    if steps := next_steps(runs, contents, results)[:SHOWN]:
        texts = [f"{capital(step)}: {step.hint}" if step.hint else sentence(step) for step in steps]
        blocks += [Text("What to do next", "head"), Bullets(texts)]
    return blocks


def summary(
    runs: Sequence[Saved], contents: Sequence[SectionContent]
) -> tuple[str, Grid, list[Message]]:
    """Verdict, main numbers and next steps over several runs."""
    results = [findings_of(run) for run in runs]
    verdict = next((b.text for b in _verdict(runs, contents, results) if isinstance(b, Text)), "")
    rows = [[card.label, card.value, card.about] for card in _cards(runs, results)]
    return verdict, Grid(["number", "value", "about"], rows), next_steps(runs, contents, results)


def chapters(
    runs: Sequence[Saved], contents: Sequence[SectionContent], reports: Sequence[StageReport]
) -> Grid:
    """A row a run: its stage, its status and its first numbers."""
    rows: list[list[Cell | str]] = []
    for place, (run, content, stage) in enumerate(zip(runs, contents, reports, strict=True), 1):
        numbers = findings_of(run).numbers[:2]
        results = "; ".join(
            f"{number.label[:1].lower()}{number.label[1:]} {number.value}" for number in numbers
        )
        link = Cell(run.title, link=f"#run-{place}")
        rows.append([link, stage.label, chip(content.status), results or content.sentence])
    return Grid(["run", "stage", "status", "in short"], rows, look="stack")


def _cards(runs: Sequence[Saved], result: Sequence[Findings]) -> list[Card]:
    """One number a rank, from a machine where one was found on it and from the run that others
    build on, then others of the last ranks.
    """
    used = {
        Path(item["path"]).name
        for run in runs
        if run.what == "validation"
        for item in run.facts["inputs"]
    }
    rigs = {run.rig.name for run in runs if _has_rig(run)}
    best: dict[int, tuple[tuple[bool, bool, int], int, Headline]] = {}
    others: list[tuple[int, Headline]] = []
    for place, (run, findings) in enumerate(zip(runs, result, strict=True), 1):
        for number in findings.numbers:
            weight = (not number.on_model, run.folder.name in used, place)
            if number.rank >= OFTEN:
                others.append((place, number))
            elif number.rank not in best or weight >= best[number.rank][0]:
                best[number.rank] = (weight, place, number)
    chosen = [(place, item) for _, (_, place, item) in sorted(best.items())]
    chosen = (chosen + others)[:MANY]
    return [
        Card(
            item.label,
            item.value,
            item.about
            if len(rigs) < 2 or not _has_rig(runs[place - 1])
            else f"{words(runs[place - 1].rig.name)}: {item.about}",
            f"#run-{place}",
        )
        for place, item in chosen
    ]


def _has_rig(run: Saved) -> bool:
    return (run.folder / "rig.toml").is_file()


def _verdict(
    runs: Sequence[Saved], contents: Sequence[SectionContent], result: Sequence[Findings]
) -> list[Block]:
    """What validation says of the model, then what speaks against any result."""
    judged = [
        (run, content)
        for run, content in zip(runs, contents, strict=True)
        if run.what == "validation"
    ]
    if not judged:
        text, look = "No verdict: no model was judged on held-out logs in these runs.", "warn"
    elif rejected := [run.title for run, content in judged if content.status == "rejected"]:
        text, look = f"Model rejected: {', '.join(rejected)}.", "bad"
    else:
        logs = set().union(*(_held_out(run) for run, _ in judged))
        text = f"Model accepted on {count(len(logs), 'log')} that it was not fitted to."
        look = "good"
        reserved = [run.title for run, content in judged if content.status != "accepted"]
        if reserved:
            text, look = f"{text[:-1]}, with reservation: {', '.join(reserved)}.", "warn"
    doubts, message = [], set()
    for run, findings in zip(runs, result, strict=True):
        # what a fit leans on is a reservation of its validations too
        against = [item for item in findings.against if item not in message]
        message |= set(against)
        if against:
            more = f"; {len(against) - 2} more" if len(against) > 2 else ""
            doubts.append(f"{run.title}: {'; '.join(against[:2])}{more}")
    blocks: list[Block] = []
    if any(run.what != "study" for run in runs):
        blocks.append(Text(text, look))
    if doubts:
        blocks.append(Text("Against it, or open", "head"))
        blocks.append(Bullets([sentence(doubt) for doubt in doubts[:SHOWN]], "warn"))
    return blocks


def _held_out(run: Saved) -> set[str]:
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


def _figure(
    runs: Sequence[Saved], result: Sequence[Findings], pictures: Sequence[Pictures]
) -> list[Block]:
    """The first figure of the furthest run that has one, of a machine where one ran."""
    order = [i for i, item in enumerate(result) if item.figures]
    machine = [i for i in order if not any(number.on_model for number in result[i].numbers)]
    for i in [*reversed(machine), *reversed(order)]:
        for key in result[i].figures:
            if drawn := pictures[i](key):
                return [_again(drawn[0], runs[i].title)]
    return []


def _again(picture: Picture, title: str) -> Picture:
    """A figure that stands a second time, under ids of its own."""
    prefix = "first-"
    svg = picture.svg.replace('id="', f'id="{prefix}').replace('href="#', f'href="#{prefix}')
    svg = svg.replace("url(#", f"url(#{prefix}")
    where = f"From the chapter '{title}'."
    return replace(picture, svg=svg, id=f"{prefix}figure", caption=where, paper=True)


def next_steps(
    runs: Sequence[Saved], contents: Sequence[SectionContent], result: Sequence[Findings]
) -> list[Message]:
    """What the runs ask for, and the next link of the chain, the most valuable first."""
    steps = [step for item in result for step in item.next]
    kinds = {run.what for run in runs}
    on_machine = any(
        number.rank in MEASURED and not number.on_model
        for item in result
        for number in item.numbers
    )
    if on_machine:
        steps = [step for step in steps if step.key != "steps.on_machine"]
    failing = any(content.status in ("rejected", "missed", "stopped") for content in contents)
    last = next((kind for kind in reversed(_CHAIN) if kind in kinds), None)
    if last is not None and not failing and not kinds & {"trial", "trials"}:
        run = next(run for run in reversed(runs) if run.what == last)
        steps.append(message(_CHAIN[last], **names(run)))
    if not steps and on_machine and kinds & {"validation"}:
        steps.append(message("steps.other_conditions"))
    return ranked(steps)
