"""An export: what was written, and how it was checked."""

from ehbench.report.blocks import Cell, Grid, Part
from ehbench.report.content import Pictures, SectionContent
from ehbench.report.saved import Saved
from ehbench.vocabulary import plural


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """The files with what they are."""
    written = run.json("export.json")["written"]
    rows = [
        [Cell(item["file"], "code"), item["check"] or item["note"] or "–", item["about"]]
        for item in written
    ]
    table = Grid(["file", "check on this machine", "what"], rows)
    sentence = f"{plural(len(written), 'export')} written."
    return SectionContent("done", sentence, [Part("Results", [table])])
