"""What the report knows of each kind of run, by the ``what`` of its ``run.json``.

A new section is one file here and one row of ``SECTIONS``; the order is that of the page."""

from importlib import import_module
from typing import Any

from ehbench.report.blocks import Cell, Grid, Part
from ehbench.report.content import Pictures, SectionContent, StageReport
from ehbench.report.saved import Saved
from ehbench.report.stages.arc_tuning import MARGINS
from ehbench.report.words import words
from ehbench.vocabulary import plural


def _report(
    module: str,
    label: str,
    shows: tuple[str, ...],
    file: str,
    keys: tuple[str, ...] = (),
    **others: Any,
) -> StageReport:
    """How a run is reported by a module here: by its ``section``, and by its ``draw`` and
    ``findings`` where it has them; other arguments as in `StageReport`."""
    calls, here = ("section", "draw", "findings"), import_module(f"{__name__}.{module}")
    known = {name: getattr(here, name) for name in calls if hasattr(here, name)}
    return StageReport(label, **known, shows=shows, numbers=(file, keys), **others)


_GAINS = ("met", "feedback_gain", "washout", "damping_ratio", "damping_ratio_open")
_VERDICT = ("accepted", "reasons", "reservations", "black_box", "thresholds")
_FITTED = ("parameter", "value", "unit", "95 % interval", "status", "bounds")
_MARGINS = ("met", "gains", *MARGINS)
_ENDED = ("duration", "stopped", "measures")
SECTIONS: dict[str, StageReport] = {
    "flow_map": _report("flow_maps", "flow maps", ("Deadbands",), "summary.json", standing=1),
    "hydraulics": _report(
        *("hydraulics", "identification", ("Parameters",), "parameters.json"),
        keys=("parameters", "warnings"),
        standing=1,
        columns=_FITTED,
    ),
    "profile": _report("profile", "profile likelihood", ("Profile",), "profile.json"),
    "response": _report("response", "frequency response", ("Numbers",), "response.json"),
    "validation": _report(
        *("validation", "validation", ("Verdict",), "validation.json"),
        keys=_VERDICT,
        standing=2,
        columns=("log", "check", "result"),
    ),
    "tuning": _report("tuning", "tuning", ("The gain",), "tuning.json", _GAINS),
    "arc_tuning": _report("arc_tuning", "tuning", ("The bandwidths",), "tuning.json", _MARGINS),
    "trial": _report("trial", "trial", ("Measures", "Trial"), "trial.json", _ENDED),
    "trials": _report("trials", "trials", ("Measures",), "table.json", ("rows",)),
    "study": _report("study", "study", ("Results",), "study.json"),
    "export": _report("export", "export", ("Results",), "export.json", ("written",)),
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
