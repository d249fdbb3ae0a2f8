"""What the report knows of each kind of run, by the ``what`` of its ``run.json``.

A new section is one file here and one line in ``SECTIONS``; the order is that of the page."""

from ehbench.report.blocks import Cell, Grid, Part
from ehbench.report.content import Pictures, SectionContent, StageReport
from ehbench.report.saved import Saved
from ehbench.report.stages import (
    arc_tuning,
    export,
    flow_maps,
    hydraulics,
    profile,
    response,
    study,
    trial,
    trials,
    tuning,
    validation,
)
from ehbench.report.words import words
from ehbench.vocabulary import plural

SECTIONS: dict[str, StageReport] = {
    "flow_map": flow_maps.REPORT,
    "hydraulics": hydraulics.REPORT,
    "profile": profile.REPORT,
    "response": response.REPORT,
    "validation": validation.REPORT,
    "tuning": tuning.REPORT,
    "arc_tuning": arc_tuning.REPORT,
    "trial": trial.REPORT,
    "trials": trials.REPORT,
    "study": study.REPORT,
    "export": export.REPORT,
}


def report_of(run: Saved) -> StageReport:
    """How a run is drawn and reported; one of a kind this version does not know by its figures and
    files."""

    def section(run: Saved, pictures: Pictures) -> SectionContent:
        files = [[Cell(name, "code")] for name in run.facts.get("outputs", {})]
        parts = [Part("Results", [*pictures(), Grid(["file"], files)])]
        return SectionContent("done", f"{plural(len(files), 'file')}.", parts)

    return SECTIONS.get(run.what, StageReport(words(run.stage), section))


def place_of(run: Saved) -> int:
    """The place of a run on the page; unknown kinds come last."""
    return [*SECTIONS, run.what].index(run.what)
