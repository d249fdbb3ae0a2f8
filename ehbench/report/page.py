"""One self-contained HTML page over several runs: saved files in, text out, the same text from the
same files.
"""

from __future__ import annotations

import base64
import hashlib
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from ehbench.config.recipe import Campaign
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
    inline,
    prose,
    slug,
)
from ehbench.report.content import chip
from ehbench.report.dark import dark
from ehbench.report.first_screen import Chapter, chapters_of, first_screen, overview
from ehbench.report.index import FigureKey
from ehbench.report.provenance import TracedRun, unsupported
from ehbench.report.rig_table import rig_table
from ehbench.report.saved import Saved, Table
from ehbench.report.stages import place_of
from ehbench.report.stages.campaign import Titles, campaign_sections, heading
from ehbench.report.svg import sound
from ehbench.report.words import count, words
from ehbench.runs import rundir
from ehbench.runs.versions import outdated, read_versions
from ehbench.runtime.disk import DATA, read_bytes
from ehbench.vocabulary.errors import EhbenchError, InputError
from ehbench.vocabulary.messages import message

if TYPE_CHECKING:
    from jinja2 import Template


def build(folders: Sequence[Path], campaign: Campaign | None = None) -> str:
    """The HTML of a report over run folders, in the order of the data; ``campaign`` gives title,
    notes, sections, figure titles.

    Raises:
        InputError: a folder is no run, or a file lacks what its section needs; names file and key.
    """
    try:
        return _built(folders, campaign)
    except EhbenchError:
        raise
    except Exception as error:
        odd = next((folder for folder in folders if not _is_ours(folder)), None)
        if odd is None:
            raise
        raise InputError(
            f"is not as this version leaves a run: {type(error).__name__}",
            file=odd,
            hint="make the run again",
        ) from error


def _is_ours(folder: Path) -> bool:
    """Whether a run is whole and of the current versions."""
    return not outdated(rundir.read_json(folder / "run.json")) and rundir.is_whole(folder)


def _built(folders: Sequence[Path], campaign: Campaign | None) -> str:
    runs = sorted((Saved(folder) for folder in folders), key=place_of)
    titles, looks = Titles(campaign), {}
    pictures = [RunPictures(run, f"run-{i}", titles, looks) for i, run in enumerate(runs, 1)]
    chapters = chapters_of(runs, pictures)
    sections = [_run_section(chapter, titles) for chapter in chapters]
    titles.refuse_unused()
    before = [
        Section("At a glance", first_screen(chapters), "glance"),
        Section("Chapters", [overview(chapters)], "chapters"),
        *campaign_sections(campaign),
    ]
    rigs = [chapter.run.rig for chapter in chapters if chapter.has_rig]
    title, note = heading(campaign, rigs)
    return _render(title, note, [*before, *sections, *_rigs(chapters), _provenance(runs)], looks)


def _run_section(chapter: Chapter, titles: Titles) -> Section:
    run, anchor, content = chapter.run, chapter.anchor, chapter.content
    parts = [
        Part(
            part.title,
            _on_paper(_titled(part.inside, run, titles)),
            f"{anchor}-{i}-{slug(part.title)}",
            part.paper and not all(isinstance(piece, Fold) for piece in part.inside),
        )
        for i, part in enumerate(content.parts, 1)
        if part.inside and part.title
    ]
    inside: list[Block] = [Text(content.sentence, "lead")]
    if gone := unsupported(run.folder):
        inside.append(
            Bullets([message("report.unsupported", change=text) for text in gone], "warn")
        )
    if content.more:
        inside.append(Bullets(content.more))
    if recorded := run.facts.get("recorded_on"):
        machines = [recorded] if isinstance(recorded, str) else recorded
        inside.append(Text("Recorded on the " + ", the ".join(machines) + ".", "note"))
    if warnings := run.facts.get("warnings", []):
        inside.append(Fold(count(len(warnings), "warning"), [Bullets(warnings, "warn")]))
    return Section(run.title, inside, anchor, chip(content.status), parts)


def _on_paper(inside: Sequence[Block]) -> list[Block]:
    """The pieces of a part, of which print shows the first figure."""
    pieces = list(inside)
    at = next((i for i, piece in enumerate(pieces) if isinstance(piece, Picture)), None)
    if at is not None:
        piece = pieces[at]
        assert isinstance(piece, Picture)
        pieces[at] = replace(piece, paper=True)
        if more := sum(isinstance(piece, Picture) for piece in pieces) - 1:
            pieces.append(Text(f"{count(more, 'more figure')} in the file.", "paper note"))
    return pieces


class RunPictures:
    """The figures of a run, inlined as they are asked for; a campaign's title wins over the
    figure's own. Every style grows a class in ``looks``.
    """

    def __init__(self, run: Saved, anchor: str, titles: Titles, looks: dict[str, str]) -> None:
        self._run, self._anchor, self._titles, self._looks = run, anchor, titles, looks
        self._entries = run.figures()

    def __call__(self, required: FigureKey) -> list[Picture]:
        """The figures that answer a question: those that the campaign names in its order, then the
        others in that of the index.

        Raises:
            InputError: the index names a file that is not there.
        """
        results = [
            self._inlined(place, entry)
            for place, entry in enumerate(self._entries, 1)
            if required.takes(FigureKey.of(entry["about"]))
        ]
        return sorted(results, key=lambda item: sys.maxsize if item.named is None else item.named)

    def _inlined(self, place: int, entry: Table) -> Picture:
        path = self._run.folder / "figures" / Path(entry["file"]).name
        try:
            svg = sound(read_bytes(path, DATA).decode("utf-8"))
        except FileNotFoundError:
            raise InputError(
                "no such file, but the run's figures/index.json names it", file=path
            ) from None
        except ValueError as error:
            raise InputError(f"is no figure: {error}", file=path) from None
        given = self._titles.of(self._run, entry["key"])
        title, named = (entry["title"], None) if given is None else given
        drawn = inline(svg, f"{self._anchor}f{place}-", title, self._looks)
        anchor = f"{self._anchor}-figure-{place}"
        return Picture(drawn, title, entry["caption"], anchor, named)


def _titled(inside: Sequence[Block], run: Saved, titles: Titles) -> list[Block]:
    """The pieces of a part, with the campaign's title on every table that has a key, folded ones as
    well.
    """
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
    """The machine as far as the runs brought it: for each rig, the last one judged, else
    identified, else given.
    """
    furthest: dict[str, Chapter] = {}
    for chapter in (chapter for chapter in chapters if chapter.has_rig):
        fixed = furthest.get(chapter.run.rig.name)
        if fixed is None or chapter.stage.standing >= fixed.stage.standing:
            furthest[chapter.run.rig.name] = chapter
    fits = [
        parameter
        for chapter in chapters
        if (chapter.run.folder / "parameters.json").is_file()
        for parameter in chapter.run.json("parameters.json")["parameters"]
    ]
    return [_rig_section(name, chapter.run, fits) for name, chapter in furthest.items()]


def _rig_section(name: str, run: Saved, fits: Sequence[Table]) -> Section:
    lead = (
        f"As the run '{run.title}' left it. How sure a value is, the rig file says; "
        "identified is what was found here. ± is half the width of the 95 % interval."
    )
    inside = [
        Text(lead, "note"),
        *prose(run.rig.note),
        Fold("All parameters", rig_table(run.rig, fits)),
    ]
    return Section(f"Rig: {run.rig.title or words(name)}", inside, f"rig-{slug(name)}")


def _provenance(runs: Sequence[Saved]) -> Section:
    counts = Counter(run.facts["commit"] for run in runs)
    lead = (
        "Every input and output of every run with its SHA-256; "
        "the same inputs give the same bytes again."
    )
    inside: list[Block] = [Text(lead), *_checksums(runs)]
    if len(counts) > 1:
        commits = ", ".join(counts)
        inside.append(Text(f"The runs were made at different commits: {commits}.", "warn"))
    return Section("Provenance", [*inside, *map(_origins, runs)], "provenance")


def _checksums(runs: Sequence[Saved]) -> list[Block]:
    """Whether files, inputs and upstream runs are as they were, by their checksums now."""
    changes = [change for run in runs for change in TracedRun(run.folder).changes()]
    missing = sum(change.key == "report.input_missing" for change in changes)
    differ = len(changes) - missing
    state = "report.checksums_differ" if differ else "report.checksums_agree"
    blocks: list[Block] = [Text(message(state, count=differ), "warn" if differ else "good")]
    if missing:
        blocks.append(Text(message("report.checksums_missing", count=missing), "note"))
    return blocks


def _origins(run: Saved) -> Fold:
    """Files of a run with their hashes, versions and seeds."""
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
    versions += f"; {read_versions(facts.plain())}"
    seeds = ", ".join(f"{name} {seed}" for name, seed in facts.get("seeds", {}).items()) or "none"
    note = Text(f"Versions: {versions}. Seeds: {seeds}.", "note")
    return Fold(run.title, [Grid(["role", "file", "SHA-256"], rows), note])


def _render(
    title: str, note: Sequence[Block], sections: Sequence[Section], looks: dict[str, str]
) -> str:
    package = resources.files("ehbench.report")
    style = (package / "page.css").read_text(encoding="utf-8") + "".join(
        f".{name}{{{look}}}\n" for look, name in looks.items()
    )
    style += "@media screen and (prefers-color-scheme: dark) {\n"
    style += "".join(
        f".{name}{{{result}}}\n" for look, name in looks.items() if (result := dark(look))
    )
    script = (package / "page.js").read_text(encoding="utf-8")
    return _template().render(
        title=title, note=note, sections=sections, style=style + "}\n", script=script
    )


@cache
def _template() -> Template:
    """The page without what is on it."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["signed"] = lambda value: (
        "0.00" if abs(value) < 0.005 else f"{value:+.2f}".replace("-", "−")
    )
    environment.filters["digest"] = lambda text: base64.b64encode(
        hashlib.sha256(text.encode("utf-8")).digest()
    ).decode()
    environment.filters["soft"] = lambda name: name.replace(".", ".\u200b").replace("_", "_\u200b")
    page = resources.files("ehbench.report") / "page.html"
    return environment.from_string(page.read_text(encoding="utf-8"))
