"""One self-contained HTML page over several runs; the same files give the same text."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

from ehbench.config.recipe import Campaign
from ehbench.config.rig import Rig
from ehbench.report.blocks import (
    Block,
    Bullets,
    Cell,
    Fold,
    Grid,
    Part,
    Picture,
    Section,
    Text,
    digest,
    inline,
    prose,
    slug,
)
from ehbench.report.content import chip, num
from ehbench.report.first_screen import Chapter, chapters_of, first_screen, overview
from ehbench.report.provenance import TracedRun, unsupported
from ehbench.report.saved import Saved, Table
from ehbench.report.stages import place_of
from ehbench.report.words import (
    as_fitted,
    capital,
    number,
    plus,
    pretty,
    row_of,
    shown,
    unit_of,
    words,
)
from ehbench.runs import rundir
from ehbench.runs.versions import outdated, read_versions
from ehbench.runtime.disk import DATA, read_bytes
from ehbench.vocabulary import Z95, EhbenchError, InputError, grouped, message, plural
from ehbench.vocabulary.errors import nearest


def build(folders: Sequence[Path], campaign: Campaign | None = None) -> str:
    """The HTML of a report over run folders, in the order of the data; ``campaign`` gives title,
    notes, sections, figure titles.

    Raises:
        InputError: a folder is no run, or a file lacks what its section needs; names file and key.
    """
    try:
        runs = sorted((Saved(folder) for folder in folders), key=place_of)
        titles, looks = Titles(campaign), {}
        pictures = [RunPictures(run, f"run-{i}", titles, looks) for i, run in enumerate(runs, 1)]
        chapters = chapters_of(runs, pictures)
        sections = [_run_section(chapter, titles) for chapter in chapters]
        titles.refuse_unused()
        written = enumerate(campaign.section if campaign else [], 1)
        sections = [
            Section("At a glance", first_screen(chapters), "glance"),
            Section("Chapters", [overview(chapters)], "chapters"),
            *(Section(i.title, prose(i.text), f"section-{n}-{slug(i.title)}") for n, i in written),
            *sections,
            *_rigs(chapters),
            _provenance(runs),
        ]
        rigs = [chapter.run.rig for chapter in chapters if chapter.run.has_rig]
        return _render(*heading(campaign, rigs), sections, looks)
    except EhbenchError:
        raise
    except Exception as error:
        for folder in folders:  # of another version, or damaged
            if outdated(rundir.read_json(folder / "run.json")) or not rundir.is_whole(folder):
                text = message("report.not_ours", error=type(error).__name__)
                raise InputError(text, file=folder) from error
        raise


def _run_section(chapter: Chapter, titles: Titles) -> Section:
    run, anchor, content = chapter.run, chapter.anchor, chapter.content
    parts = []
    for part in (part for part in content.parts if part.inside and part.title):
        pieces = _titled(part.inside, run, titles)
        drawn = [(i, piece) for i, piece in enumerate(pieces) if isinstance(piece, Picture)]
        for i, piece in drawn[:1]:  # print shows the first of them
            pieces[i] = replace(piece, paper=True)
        if more := len(drawn[1:]):
            text = message("report.more_figures", figures=plural(more, "more figure"))
            pieces.append(Text(text, "paper note"))
        paper = part.paper and not all(isinstance(piece, Fold) for piece in part.inside)
        place = f"{anchor}-{len(parts) + 1}-{slug(part.title)}"
        parts.append(Part(part.title, pieces, place, paper))
    inside: list[Block] = [Text(content.sentence, "lead")]
    if gone := unsupported(run.folder):
        inside.append(
            Bullets([message("report.unsupported", change=text) for text in gone], "warn")
        )
    if content.more:
        inside.append(Bullets(content.more))
    if recorded := run.facts.get("recorded_on"):
        machines = [recorded] if isinstance(recorded, str) else recorded
        text = message("report.recorded_on", machines=", the ".join(machines))
        inside.append(Text(text, "note"))
    if warnings := run.facts.get("warnings", []):
        inside.append(Fold(plural(len(warnings), "warning"), [Bullets(warnings, "warn")]))
    return Section(run.title, inside, anchor, chip(content.status), parts)


class RunPictures:
    """A run's figures, inlined, under a campaign's titles; styles grow in ``looks``."""

    def __init__(self, run: Saved, anchor: str, titles: Titles, looks: dict[str, str]) -> None:
        self._run, self._anchor, self._titles, self._looks = run, anchor, titles, looks
        self._entries = run.figures()

    def __call__(self, **shows: str) -> list[Picture]:
        """The figures that show something, such as ``kind="trial"``: those that the campaign names
        in its order, then the others in that of the index.

        Raises:
            InputError: the index names a file that is not there.
        """
        results = []
        for place, entry in enumerate(self._entries, 1):
            if not shows.items() <= entry["about"].items():
                continue
            path = self._run.folder / "figures" / Path(entry["file"]).name
            given = self._titles.of(self._run, entry["key"])
            title, named = (entry["title"], None) if given is None else given
            try:
                svg = read_bytes(path, DATA).decode("utf-8")
                drawn = inline(svg, f"{self._anchor}f{place}-", title, self._looks)
            except FileNotFoundError:
                raise InputError(message("report.no_figure"), file=path) from None
            except ValueError as error:
                raise InputError(message("report.bad_figure", reason=error), file=path) from None
            anchor = f"{self._anchor}-figure-{place}"
            results.append(Picture(drawn, title, entry["caption"], anchor, named))
        return sorted(results, key=lambda item: sys.maxsize if item.named is None else item.named)


def _titled(inside: Sequence[Block], run: Saved, titles: Titles) -> list[Block]:
    """The pieces of a part, every table with a key under the campaign's title."""
    pieces: list[Block] = []
    for piece in inside:
        if isinstance(piece, Fold):
            piece = replace(piece, inside=_titled(piece.inside, run, titles))
        elif isinstance(piece, Grid) and piece.key:
            given = titles.of(run, piece.key)
            piece = replace(piece, title=given[0] if given else piece.title)
        pieces.append(piece)
    return pieces


def _rigs(chapters: Sequence[Chapter]) -> list[Section]:
    """For each rig, the machine as last judged, else identified, else given."""
    furthest: dict[str, Chapter] = {}
    for chapter in (chapter for chapter in chapters if chapter.run.has_rig):
        fixed = furthest.get(chapter.run.rig.name)
        if fixed is None or chapter.stage.standing >= fixed.stage.standing:
            furthest[chapter.run.rig.name] = chapter
    fits = [
        parameter
        for chapter in chapters
        if (chapter.run.folder / "parameters.json").is_file()
        for parameter in chapter.run.json("parameters.json")["parameters"]
    ]
    sections = []
    for name, chapter in furthest.items():
        rig = chapter.run.rig
        lead = Text(message("report.rig", title=chapter.run.title), "note")
        table = Fold("All parameters", rig_table(rig, fits))
        inside = [lead, *prose(rig.note), table]
        sections.append(Section(f"Rig: {rig.title or words(name)}", inside, f"rig-{slug(name)}"))
    return sections


def _provenance(runs: Sequence[Saved]) -> Section:
    """Checksums of files, inputs and upstream runs as they are now; versions and seeds."""
    changes = [change for run in runs for change in TracedRun(run.folder).changes()]
    missing = sum(change.key == "report.input_missing" for change in changes)
    differ = len(changes) - missing
    state = "report.checksums_differ" if differ else "report.checksums_agree"
    inside: list[Block] = [Text(message("report.provenance"))]
    inside.append(Text(message(state, count=differ), "warn" if differ else "good"))
    if missing:
        inside.append(Text(message("report.checksums_missing", count=missing), "note"))
    commits = dict.fromkeys(run.facts["commit"] for run in runs)
    if len(commits) > 1:
        text = message("report.commits_differ", commits=", ".join(commits))
        inside.append(Text(text, "warn"))
    for run in runs:
        facts = run.facts
        files = [("recipe", facts["recipe"]["path"], facts["recipe"]["sha256"])]
        files += [(item["role"], item["path"], item["sha256"]) for item in facts["inputs"]]
        files += [("output", name, digest) for name, digest in facts["outputs"].items()]
        rows = [
            ["run", "", Cell(facts["hash"], "hash")],
            ["commit", "", Cell(facts["commit"], "hash")],
            *([role, Cell(path, "code"), Cell(digest, "hash")] for role, path, digest in files),
        ]
        versions = ", ".join(f"{name} {version}" for name, version in facts["versions"].items())
        versions += f"; {read_versions(facts)}"
        seeds = ", ".join(f"{name} {seed}" for name, seed in facts.get("seeds", {}).items())
        note = message("report.versions", versions=versions, seeds=seeds or "none")
        table = Grid(["role", "file", "SHA-256"], rows)
        inside.append(Fold(run.title, [table, Text(note, "note")]))
    return Section("Provenance", inside, "provenance")


def _render(
    title: str, note: Sequence[Block], sections: Sequence[Section], looks: dict[str, str]
) -> str:
    from jinja2 import Environment, StrictUndefined

    package = resources.files("ehbench.report")
    page, style, script = (
        (package / f"page.{kind}").read_text(encoding="utf-8") for kind in ("html", "css", "js")
    )
    style += "".join(f".{name}{{{look}}}\n" for look, name in looks.items())
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["signed"] = lambda value: (
        # pyrefly: ignore[bad-argument-type]
        "0.00" if abs(value) < 0.005 else f"{value:+.2f}".replace("-", "−")
    )
    environment.filters["digest"] = digest
    # pyrefly: ignore[missing-attribute]
    environment.filters["soft"] = lambda name: name.replace(".", ".\u200b").replace("_", "_\u200b")
    template = environment.from_string(page)
    return template.render(title=title, note=note, sections=sections, style=style, script=script)


def rig_table(rig: Rig, fits: Sequence[Table] = ()) -> list[Block]:
    """Every parameter of a rig, with value, unit, how sure it is, and source; the notes on its
    valve dynamics before. A value that came from one of the ``fits``, rows of ``parameters.json``,
    has its interval; the others have 1.96 of their standard error.
    """
    known: dict[tuple[str, Any], Table] = {(fit["name"], fit.number("value")): fit for fit in fits}
    every = rig.parameters().items()
    groups = grouped(every, lambda item: item[0].rpartition(".")[0])
    rows: list[list[Cell | str]] = []
    for group, name, value in ((group, *item) for group, items in groups.items() for item in items):
        fit = known.get((name, value.value))
        if fit is not None:
            text = num(as_fitted(rig, name, fit))
        elif value.std:
            text = num(plus(rig, name, value.value, Z95 * value.std))
        else:
            text = num(number(shown(rig, name, value.value), 6))
        source = value.source.removeprefix(value.sure).lstrip(":, ")
        label = Cell(name.rsplit(".", 1)[-1], "code", hint=row_of(name).meaning)
        rows.append([group, label, text, pretty(unit_of(rig, name)), value.sure, source])
    notes = [f"{name}: {dynamics.note}" for name, dynamics in rig.dynamics.items() if dynamics.note]
    head = ["of", "parameter", "value", "unit", "how sure", "source"]
    return [*([Bullets(notes)] if notes else []), Grid(head, rows)]


class Titles:
    """Titles that a campaign gives by ``key`` or ``run/key``; remembers which keys exist."""

    def __init__(self, campaign: Campaign | None) -> None:
        self._campaign = campaign
        self._given = dict(campaign.figures) if campaign else {}
        self._keys: set[str] = set()

    def of(self, run: Saved, key: str) -> tuple[str, int] | None:
        """(the campaign's title of a figure or table, its place among all), if it has one."""
        names = (f"{run.name}/{key}", key)
        self._keys.update(names)
        name = next((name for name in names if name in self._given), None)
        return None if name is None else (self._given[name], [*self._given].index(name))

    def refuse_unused(self) -> None:
        """See that every title found its figure.

        Raises:
            InputError: one did not; names the nearest key.
        """
        for key in self._given:
            if key not in self._keys:
                place = self._campaign.at("figures", key) if self._campaign else {}
                hint = nearest(key, self._keys, "nearest is '{}'", 0.3)
                raise InputError(message("report.no_title", key=key), hint=hint, **place)


def heading(campaign: Campaign | None, rigs: Sequence[Rig]) -> tuple[str, Sequence[Block]]:
    """(title, note) of the page: the campaign's, else those of the rigs."""
    if campaign is not None:
        return campaign.title or words(campaign.name).capitalize(), prose(campaign.note)
    titles = dict.fromkeys(rig.title or capital(words(rig.name)) for rig in rigs)
    notes = prose(rigs[0].note) if len(titles) == 1 else []
    return ", ".join(titles) or "Report", notes[:1]
