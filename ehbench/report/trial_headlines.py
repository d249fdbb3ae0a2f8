"""What the first screen says of trials under a controller."""

from __future__ import annotations

from collections.abc import Sequence

from ehbench.config.rig import Rig
from ehbench.report.captions import MODEL, measure, span
from ehbench.report.cases import Case, by_controller, cases_of, damping
from ehbench.report.content import SAVED, STEPS, TRACKING, Findings, Headline, names
from ehbench.report.energy_tables import Saving, savings_of
from ehbench.report.index import FigureKey
from ehbench.report.saved import Saved, grouped
from ehbench.report.template import Template
from ehbench.vocabulary.messages import message


def trials_findings(run: Saved) -> Findings:
    rig, cases, page = run.rig, cases_of(run), Template("headlines", run.rig)
    against = [
        page.text("stopped", name=case.row["case"], reason=case.row["stopped"])
        for case in cases
        if case.row.get("stopped")
    ]
    numbers = [*_tracked(rig, cases), *_saved(page, cases), *_damped(page, cases)]
    figures = [FigureKey(kind) for kind in ("energy", "compare", "trial")]
    steps = [message("steps.stopped", **names(run))] if against else []
    steps += [message("steps.on_machine")] * (bool(cases) and _modelled(cases))
    return Findings(numbers, figures, against, steps)


def _tracked(rig: Rig, cases: Sequence[Case]) -> list[Headline]:
    """The largest error of the controller that tracks best, of motions that are no steps: that of
    the tip where there is one, of the true stroke where it is known. A four-way valve that others
    are compared with is no choice.
    """
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
    return [Headline(TRACKING, label, value, about, _modelled(group))]


def _saved(page: Template, cases: Sequence[Case]) -> list[Headline]:
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
    return [Headline(SAVED, "Pump energy saved", value, page.text("saved", **fields), on_model)]


def _damped(page: Template, cases: Sequence[Case]) -> list[Headline]:
    """The damping ratio of steps under the best damped controller, and under the least damped."""
    ratios = {
        law: [ratio for case in group for ratio, _ in map(damping, case.steps) if ratio is not None]
        for law, group in by_controller([case for case in cases if case.fit]).items()
    }
    ratios = {law: values for law, values in ratios.items() if values}
    if not ratios:
        return []
    best, worst = (pick(ratios, key=lambda law: min(ratios[law])) for pick in (max, min))
    fields = {"best": best, "worst": worst, "ratios": ratios[worst], "on": cases[0].row["on"]}
    about, value = page.text("damped", **fields), span(ratios[best], 2)
    return [Headline(STEPS, "Damping ratio of steps", value, about, _modelled(cases))]


def _modelled(cases: Sequence[Case]) -> bool:
    return all(case.row["on"] == MODEL for case in cases)
