"""One self-contained HTML page over several runs: saved files in, text out, the same text from the
same files.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

from ehbench.errors import InputError
from ehbench.recipe import Campaign
from ehbench.report.blocks import (
    Bullets,
    Cell,
    Fold,
    Grid,
    Part,
    Picture,
    Section,
    Text,
    inline,
    prose,
    slug,
)
from ehbench.report.saved import Saved
from ehbench.report.sections import Pictures, chip, rig_table, stage_of
from ehbench.report.words import count, words

_STANDING = {"validate": 2, "identify": 1}


def build(folders: Sequence[Path], campaign: Campaign | None = None) -> str:
    """The HTML of a report over run folders, in the order of the data; ``campaign`` gives title,
    notes, sections, figure titles.

    Raises:
        InputError: a folder is no run, or a file lacks what its section needs; names file and key.
    """
    runs = sorted((Saved(folder) for folder in folders), key=lambda run: stage_of(run)[0])
    titles = dict(campaign.figures) if campaign else {}
    used: set[str] = set()
    looks: dict[str, str] = {}
    sections, glance = [], []
    for index, run in enumerate(runs, 1):
        anchor = f"run-{index}"
        stage = stage_of(run)[1]
        story = stage.render(run, _pictures(run, anchor, titles, used, looks))
        warnings = run.facts.get("warnings", [])
        parts = [
            Part(
                part.title,
                _named(part.inside, run, titles, used),
                f"{anchor}-{i}-{slug(part.title)}",
            )
            for i, part in enumerate(story.parts, 1)
            if part.inside
        ]
        inside: list[Any] = [Text(story.sentence, "lead")]
        if recorded := run.facts.get("recorded_on"):
            inside.append(
                Text(
                    "Recorded on the "
                    + ", the ".join([recorded] if isinstance(recorded, str) else recorded)
                    + ".",
                    "note",
                )
            )
        inside += (
            [Fold(count(len(warnings), "warning"), [Bullets(warnings, "warn")])] if warnings else []
        )
        sections.append(Section(run.title, inside, anchor, chip(story.status), parts))
        glance.append(
            [Cell(run.title, link=f"#{anchor}"), stage.kind, chip(story.status), story.sentence]
        )
    _refuse_unused(campaign, used)
    before = [
        Section(
            "At a glance", [Grid(["run", "stage", "status", "in a sentence"], glance)], "glance"
        )
    ]
    if campaign:
        before += [
            Section(one.title, prose(one.text), f"section-{i}-{slug(one.title)}")
            for i, one in enumerate(campaign.section, 1)
        ]
    title = (campaign.title or words(campaign.name).capitalize()) if campaign else "Report"
    note = prose(campaign.note) if campaign else []
    return _render(title, note, [*before, *sections, *_rigs(runs), _provenance(runs)], looks)


def _pictures(
    run: Saved, anchor: str, titles: dict[str, str], used: set[str], looks: dict[str, str]
) -> Pictures:
    """A function that gives the run's figures of a kind, inlined; a campaign's title wins over the
    figure's own.
    """
    index = run.figures()

    def pick(kind: str, key: str, value: str) -> list[Picture]:
        found = []
        for place, one in enumerate(index, 1):
            about = one["about"]
            if (kind and about.get("kind") != kind) or (key and about.get(key) != value):
                continue
            path = run.folder / "figures" / one["file"]
            try:
                svg = path.read_text(encoding="utf-8")
            except FileNotFoundError:
                raise InputError(
                    "no such file, but the run's figures/index.json names it", file=path
                ) from None
            names = (f"{run.name}/{one['key']}", one["key"])
            title = next((titles[name] for name in names if name in titles), one["title"])
            used.update(names)
            drawn = inline(svg, f"{anchor}f{place}-", title, looks)
            found.append(
                Picture(
                    drawn,
                    title,
                    one["caption"],
                    f"{anchor}-figure-{place}",
                    any(name in titles for name in names),
                )
            )
        return found

    return pick


def _named(inside: Sequence[Any], run: Saved, titles: dict[str, str], used: set[str]) -> list[Any]:
    """The pieces of a part, with the campaign's title on every table that has a key, folded ones as
    well.
    """
    found = []
    for one in inside:
        if isinstance(one, Fold):
            found.append(replace(one, inside=_named(one.inside, run, titles, used)))
        elif isinstance(one, Grid) and one.key:
            names = (f"{run.name}/{one.key}", one.key)
            used.update(names)
            found.append(
                replace(
                    one, title=next((titles[name] for name in names if name in titles), one.title)
                )
            )
        else:
            found.append(one)
    return found


def _refuse_unused(campaign: Campaign | None, used: set[str]) -> None:
    for key in campaign.figures if campaign else ():
        if key not in used:
            from difflib import get_close_matches

            near = get_close_matches(key, used, 1, 0.3)
            raise InputError(
                f"'figures' names '{key}', which no run of the report has",
                hint=f"nearest is '{near[0]}'" if near else None,
                **campaign.at("figures", key),
            )


def _rigs(runs: Sequence[Saved]) -> list[Section]:
    """The machine as far as the runs brought it: for each rig, the last one judged, else
    identified, else given.
    """
    best: dict[str, Saved] = {}
    for run in runs:
        if (run.folder / "rig.toml").is_file():
            held = best.get(run.rig.name)
            if held is None or _STANDING.get(run.stage, 0) >= _STANDING.get(held.stage, 0):
                best[run.rig.name] = run
    found = []
    for name, run in best.items():
        lead = f"As the run '{run.title}' left it. How sure a value is, the rig file says; identified is what was found here."
        found.append(
            Section(
                f"Rig: {run.rig.title or words(name)}",
                [
                    Text(lead, "note"),
                    *prose(run.rig.note),
                    Fold("All parameters", rig_table(run.rig)),
                ],
                f"rig-{slug(name)}",
            )
        )
    return found


def _provenance(runs: Sequence[Saved]) -> Section:
    folds = []
    for run in runs:
        facts = run.facts
        recipe = facts["recipe"]
        inputs = [["recipe", Cell(recipe["path"], "code"), Cell(recipe["sha256"], "hash")]]
        inputs += [
            [one["role"], Cell(one["path"], "code"), Cell(one["sha256"], "hash")]
            for one in facts["inputs"]
        ]
        outputs = [
            ["output", Cell(name, "code"), Cell(digest, "hash")]
            for name, digest in facts["outputs"].items()
        ]
        versions = ", ".join(f"{name} {version}" for name, version in facts["versions"].items())
        seeds = (
            ", ".join(f"{name} {seed}" for name, seed in facts.get("seeds", {}).items()) or "none"
        )
        rows = [
            ["run", "", Cell(facts["hash"], "hash")],
            ["commit", "", Cell(facts["commit"], "hash")],
            ["code", "all sources", Cell(facts["code_sha256"], "hash")],
            *inputs,
            *outputs,
        ]
        folds.append(
            Fold(
                run.title,
                [
                    Grid(["role", "file", "SHA-256"], rows),
                    Text(f"Versions: {versions}. Seeds: {seeds}.", "note"),
                ],
            )
        )
    counts = Counter(run.facts["commit"] for run in runs)
    lead = "Every input and output of every run with its SHA-256; the same inputs give the same bytes again."
    more = (
        [Text("The runs were made at different commits: " + ", ".join(counts) + ".", "warn")]
        if len(counts) > 1
        else []
    )
    return Section("Provenance", [Text(lead), *more, *folds], "provenance")


def _render(
    title: str, note: Sequence[Any], sections: Sequence[Section], looks: dict[str, str]
) -> str:
    from jinja2 import Environment, StrictUndefined

    package = resources.files("ehbench.report")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["signed"] = lambda value: (
        "0.00" if abs(value) < 0.005 else f"{value:+.2f}".replace("-", "−")
    )
    environment.filters["soft"] = lambda name: name.replace(".", ".\u200b").replace("_", "_\u200b")
    template = environment.from_string((package / "page.html").read_text(encoding="utf-8"))
    style = (package / "page.css").read_text(encoding="utf-8") + "".join(
        f".{name}{{{look}}}\n" for look, name in looks.items()
    )
    return template.render(title=title, note=note, sections=sections, style=style)
