"""What the first screen says of each kind of run: its few numbers that people ask for, the figure
that shows them, and what to do next.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ehbench.config.rig import Rig
from ehbench.report.captions import (
    MODEL,
    as_fitted,
    capital,
    load_name,
    measure,
    percent,
    range_of,
    span,
)
from ehbench.report.cases import Case, cases_of, damping
from ehbench.report.energy_tables import Saving, four_way, savings_of
from ehbench.report.index import FigureKey
from ehbench.report.saved import Saved, Table
from ehbench.report.words import count, interval, number, pretty, shown, title_of, unit_of, words
from ehbench.vocabulary.messages import Message, message
from ehbench.vocabulary.terms import BEYOND

DOUBTFUL = "estimated, doubtful"  # as it leans on a held number that the logs deny


@dataclass(frozen=True)
class Headline:
    """A number that people ask for. ``rank``: its place among those of a report, which shows one
    of each rank below `OFTEN`; ``on_model``: found on the model, so that a machine's wins.
    """

    rank: int
    label: str
    value: str
    about: str = ""
    on_model: bool = False


OFTEN = 6  # the first rank of which a report may show several
PARAMETER, FIT, DAMPING, TRACKING, SAVED, STEPS = range(6)


@dataclass(frozen=True)
class Findings:
    """What a run gives to the first screen: numbers, the figures to choose from (the first that is
    there), what speaks against its result, and what to do next.
    """

    numbers: Sequence[Headline] = ()
    figures: Sequence[FigureKey] = ()
    against: Sequence[str] = ()
    next: Sequence[Message] = ()


def names(run: Saved) -> dict[str, str]:
    """What steps call a run: its folder ``run``, its ``recipe``, and the ``name`` that a recipe
    beside it takes for the run.
    """
    recipe = run.facts["recipe"]["path"]
    return {"run": run.folder.name, "recipe": recipe, "name": recipe}


def findings_of(run: Saved) -> Findings:
    """What a run gives to the first screen; nothing where its kind is not known."""
    finder = _FINDERS.get(run.what)
    return finder(run) if finder else Findings()


def _flow_maps(run: Saved) -> Findings:
    maps, rig = run.rows("summary.json"), run.rig
    bands = [float(shown(rig, "command", item["deadband"])) for item in maps]
    points = [(item, point) for item in maps for point in item["calibration"]]
    numbers = [
        Headline(
            OFTEN,
            "Deadbands",
            f"{span(bands)} {pretty(unit_of(rig, 'command'))}",
            count(len(maps), "flow map"),
        )
    ]
    missing = (
        f"calibration {words(point['verdict'])}: {item['valve']}, {item['direction']}"
        for item, point in points
        if point["verdict"] != "met"
    )
    against = list(dict.fromkeys(missing))
    steps = [message("steps.calibrate", **names(run))] if against else []
    return Findings(numbers, [FigureKey("flow_map")], against, steps)


def _hydraulics(run: Saved) -> Findings:
    rig, fit = run.rig, run.json("parameters.json")
    leans, parameters = fit.get("leans", []), estimates_of(fit)
    known = [parameter for parameter in parameters if parameter.number("value") is not None]
    known.sort(key=lambda entry: (entry["status"] != "estimated", entry["name"] != "bulk_modulus"))
    numbers = [
        _parameter(rig, item, PARAMETER if i == 0 else OFTEN) for i, item in enumerate(known)
    ]
    weak = [parameter for parameter in parameters if parameter["status"] != "estimated"]
    left = str(fit.get("left_over") or "").partition(":")[0]  # what it means stands in the chapter
    against = [lean["sentence"] for lean in leans[:1]] + [left] * bool(left)
    weak = [item for item in weak if item["status"] != DOUBTFUL]  # said by what it leans on
    against += [f"{item['name']} is {words(item['status'])}" for item in weak]
    steps = [_remedy_step(lean["remedy"]) for lean in leans[:1]]
    steps += [message("steps.suggest", **names(run))] if left else []
    first = {item["status"]: item["name"] for item in reversed(weak)}
    for status, parameter in first.items():
        key = "steps.bound" if status == "at_bound" else "steps.settle"
        steps.append(message(key, **names(run), parameter=parameter))
    return Findings(numbers, [FigureKey("parameters")], against, steps)


def estimates_of(fit: Table) -> list[Table]:
    """The parameters of a fit; those estimated are doubtful that would come out beyond their
    intervals if a number that the fit holds were as the logs would have it.
    """
    moved = [item for lean in fit.get("leans", []) for item in lean["moved"]]
    far = {item["name"] for item in moved if item["halves"] > BEYOND}
    return [
        parameter.having("status", DOUBTFUL)
        if parameter["name"] in far and parameter["status"] == "estimated"
        else parameter
        for parameter in fit["parameters"]
    ]


def _remedy_step(remedy: str) -> Message:
    """The step that a remedy asks for, with the line to paste where it names one."""
    if freed := re.match(r'add ("[^\[\]]+") to parameters', remedy):
        return message("steps.free", line=freed[1])
    if sensed := re.match(r"add \[\[sensor\]\] (.+?)( to the recipe|$)", remedy):
        return message("steps.sense", line=sensed[1].replace(", ", "\n"))
    if written := re.match(r'(\w+ = "[^"]+") (.+)', remedy):
        return message("steps.write", line=written[1], where=written[2])
    return message("steps.remedy", remedy=remedy)


def _parameter(rig: Rig, item: Table, rank: int) -> Headline:
    name, unit = item["name"], pretty(unit_of(rig, item["name"]))
    ends = range_of(rig, name, item.get("interval"))
    about = f"95 % interval {ends} {unit}".rstrip() if item.get("interval") else "no interval"
    if item["status"] != "estimated":
        about += f"; {words(item['status'])}"
    label = "effective bulk modulus" if name == "bulk_modulus" else words(name).replace(".", " ")
    return Headline(rank, capital(label), f"{as_fitted(rig, name, item)} {unit}".rstrip(), about)


def held_out(table: Table) -> list[Table]:
    """The logs that a verdict goes by."""
    return [log for log in table["logs"] if log["status"] == "held_out"]


def _validation(run: Saved) -> Findings:
    table = run.json("validation.json")
    logs = held_out(table)
    fits = [
        (item["fit_percent"], item["channel"], log["name"])
        for log in logs
        for item in log.get("channels", [])
        if item.get("fit_percent") is not None
    ]
    numbers, figures = [], [FigureKey("validation")]
    if fits:
        worst, channel, log = min(fits)
        about = f"{channel}, {words(log)}; best {number(max(fits)[0], 2)} %"
        if channel.rpartition(".")[2] not in judged(table):
            about += "; not judged"
        label = f"Worst fit on {count(len(logs), 'held-out log')}"
        numbers = [Headline(FIT, label, f"{number(worst, 2)} %", about)]
        figures = [FigureKey("validation", log=log), *figures]
    remedies = [finding["remedy"] for finding in (table.get("structure") or {}).get("findings", [])]
    steps = [_remedy_step(item) for item in dict.fromkeys(filter(None, remedies))][:3]
    if not table["accepted"] and not steps:
        checks = "; ".join(_failed(logs))
        steps = [message("steps.failing", **names(run), checks=checks)]
    return Findings(
        numbers,
        figures,
        table["reasons"] or [*table.get("reservations", []), *left_over(table)],
        steps,
    )


def left_over(table: Table) -> list[str]:
    """What the likeliest fault is that the residuals of a validation show, in a sentence with its
    remedy; none where they show none, or a reservation gives it.
    """
    reservations = " ".join(table.get("reservations", []))
    findings = (table.get("structure") or {}).get("findings", [])
    results = [finding for finding in findings if finding["sentence"] not in reservations]
    return [
        f"{percent(item['explains'])} of what is left over has one likely cause: "
        f"{item['sentence']}; {item['remedy']}"
        for item in results[:1]
    ]


def _failed(logs: Sequence[Table]) -> list[str]:
    checks = (check for log in logs for check in log.get("checks", []))
    failed = dict.fromkeys(check["what"] for check in checks if not check["passed"])
    return list(failed)[:3] or ["no log was judged"]


def judged(table: Table) -> list[str]:
    """The channels whose fit or error a verdict goes by."""
    requested = table.get("thresholds", {})
    return [word for key in ("fit_percent", "max_error") for word in requested.get(key, {})]


def silence(table: Table) -> str:
    """What a verdict does not go by, with what it would have found there; empty if it goes by
    all.
    """
    channels = [channel for log in held_out(table) for channel in log.get("channels", [])]
    requested, parts = judged(table), []
    fits: dict[str, list[float]] = {}
    for channel in channels:
        word = channel["channel"].rpartition(".")[2]
        if channel.get("fit_percent") is not None and word not in requested:
            fits.setdefault(word, []).append(channel["fit_percent"])
    parts += [f"{title_of(word).lower()} (fit {span(fit, 2)} %)" for word, fit in fits.items()]
    limit = table.get("thresholds", {}).get("outside_percent")
    for key, text in _TESTS.items():
        tested = [shares for channel in channels if (shares := _outside(channel, key))]
        beyond = sum(max(shares) > limit for shares in tested) if limit is not None else 0
        if beyond and not table.get("thresholds", {}).get(key):
            parts.append(
                f"{text} (outside of their band at more than {number(limit, 3)} % of the lags "
                f"in {beyond} of {count(len(tested), 'channel')})"
            )
    return f"The verdict does not go by {'; '.join(parts)}." if parts else ""


_TESTS = {
    "whiteness": "correlation of the residuals with themselves",
    "independence": "correlation of the residuals with the commands",
}


def _outside(item: Table, key: str) -> list[float]:
    if key == "whiteness":
        own = item.get("autocorrelation")
        return [own["outside_percent"]] if own else []
    return [other["outside_percent"] for other in item.get("cross_correlation", [])]


def _tuning(run: Saved) -> Findings:
    rig, tuning = run.rig, run.json("tuning.json")
    draws = tuning["robustness"]
    about = f"without any feedback {number(tuning['damping_ratio_open'], 2)}"
    if draws["draws"]:
        low, _, high = draws["quantiles"]
        about += f"; 90 % of {draws['draws']} draws {interval(low, high)}"
    label = f"Worst damping ratio, {words(tuning['cylinder'])}"
    gains = sorted(set(tuning["feedback_gain"].values()))
    unit = pretty(unit_of(rig, "feedback_gain"))
    gain = f"{span([float(shown(rig, 'feedback_gain', g)) for g in gains])} {unit}"
    numbers = [
        Headline(DAMPING, label, number(tuning["damping_ratio"], 2), about),
        Headline(OFTEN, "Feedback gain K_p", gain),
    ]
    against = [] if tuning["met"] else ["target or demands of the tuning are not met"]
    reached = number(tuning["damping_ratio"], 2)
    steps = [message("steps.less_damping", reached=reached)] if against else []
    share = draws["share"] if draws["draws"] else 1.0
    if share < 1.0:
        against.append(f"{percent(1.0 - share)} of the draws miss the target")
    return Findings(numbers, [FigureKey("damping")], against, steps)


def _arc_tuning(run: Saved) -> Findings:
    rig, tuning = run.rig, run.json("tuning.json")
    label = f"Delay margin, stated, {words(tuning['cylinder'])}"
    about = (
        f"gain margin {number(tuning.get('gain_margin'), 2)}, phase margin "
        f"{measure(rig, 'phase_margin', tuning['phase_margin'], 2)}, at worst"
    )
    numbers = [
        Headline(OFTEN, label, measure(rig, "delay_margin", tuning["delay_margin"], 2), about)
    ]
    against = [] if tuning["met"] else ["the demanded margins are not kept"]
    reached = measure(rig, "delay_margin", tuning["delay_margin"], 2)
    steps = [message("steps.smaller_margins", reached=reached)] if against else []
    return Findings(numbers, [FigureKey("margins")], against, steps)


def _trials(run: Saved) -> Findings:
    rig, cases = run.rig, cases_of(run)
    stopped = [case for case in cases if case.row.get("stopped")]
    against = [f"{case.row['case']}: stopped, {case.row['stopped']}" for case in stopped]
    numbers = [*_tracked(rig, cases), *_saved(cases), *_damped(cases)]
    kinds = ("energy", "compare", "trial")
    steps = [message("steps.stopped", **names(run))] if stopped else []
    if cases and all(case.row["on"] == MODEL for case in cases):
        steps.append(message("steps.on_machine"))
    return Findings(numbers, [FigureKey(kind) for kind in kinds], against, steps)


def by_controller(cases: Sequence[Case]) -> dict[str, list[Case]]:
    """Trials by their controller, in the order of the run."""
    groups: dict[str, list[Case]] = {}
    for case in cases:
        groups.setdefault(case.row["controller"], []).append(case)
    return groups


def _tracked(rig: Rig, cases: Sequence[Case]) -> list[Headline]:
    """The largest error of the controller that tracks best, of motions that are no steps."""

    fit = [case for case in cases if case.fit and not case.steps]
    if tips := [case for case in fit if case.row.get("tip")]:
        best = min(tips, key=lambda case: case.row["tip"]["max_error"])
        value = measure(rig, "tip_error", best.row["tip"]["max_error"], 2)
        about = f"{words(best.row['controller'].removesuffix(f', {best.cylinder}'))}, {best.where}"
        return [Headline(TRACKING, "Largest tip error", value, about, _modelled([best]))]

    def most(group: Sequence[Case]) -> float:
        return max(case.row["tracking"]["max_error"] for case in group)

    groups = by_controller(fit)
    if not groups:
        return []
    name = min(groups, key=lambda key: most(groups[key]))
    group = groups[name]
    errors = [float(shown(rig, "x", case.row["tracking"]["max_error"])) for case in group]
    worst = max(group, key=lambda case: case.row["tracking"]["max_error"])
    about = f"{words(name)}, {worst.where}"
    if len(group) > 1:
        unit = pretty(unit_of(rig, "x"))
        about += f"; {span(errors, 2)} {unit} over {count(len(group), 'trial')}"
    value = measure(rig, "x", most(group), 2)
    return [Headline(TRACKING, "Largest tracking error", value, about, _modelled(group))]


def _saved(cases: Sequence[Case]) -> list[Headline]:
    """What the controller that saves most draws less than a four-way valve."""
    groups: dict[str, list[Saving]] = {}
    for item in savings_of(cases):
        if not four_way(item.ledger, item.case.cylinder):
            groups.setdefault(item.case.row["controller"], []).append(item)
    if not groups:
        return []
    against = all(item.reference is not None for group in groups.values() for item in group)

    def share(entry: Saving) -> float:
        if not against or entry.reference is None:
            return entry.limits["saving"]
        return 1.0 - entry.used / entry.reference

    name = max(groups, key=lambda key: min(map(share, groups[key])))
    group = groups[name]
    value = span([100.0 * share(item) for item in group], 2)
    whole = "the four-way valve" if against else "a four-way valve must draw"
    about = f"less than {whole}; {words(name)}, on the {group[0].case.row['on']}"
    halves = [100.0 * item.half / item.limits["standard"] for item in group if item.half]
    if halves:
        about += f"; ± {number(max(halves), 2)} % each"
    on_model = _modelled([item.case for item in group])
    return [Headline(SAVED, "Pump energy saved", f"{value} %", about, on_model)]


def _damped(cases: Sequence[Case]) -> list[Headline]:
    """The damping ratio of steps under the best damped controller, and under the least damped."""
    ratios: dict[str, list[float]] = {}
    for case in cases:
        for ratio, _ in map(damping, case.steps if case.fit else []):
            if ratio is not None:
                ratios.setdefault(case.row["controller"], []).append(ratio)
    if not ratios:
        return []
    best, minimum = (pick(ratios, key=lambda key: min(ratios[key])) for pick in (max, min))
    about = f"{words(best)}, on the {cases[0].row['on']}"
    if best != minimum:
        about += f"; {words(minimum)} {span(ratios[minimum], 2)}"
    value = span(ratios[best], 2)
    return [Headline(STEPS, "Damping ratio of steps", value, about, _modelled(cases))]


def _modelled(cases: Sequence[Case]) -> bool:
    return all(case.row["on"] == MODEL for case in cases)


def _trial(run: Saved) -> Findings:
    facts = run.json("trial.json")
    if facts.get("controller"):
        return _trials(run)
    stopped = facts.get("stopped", "")
    against = [f"{run.title}: stopped, {stopped}"] if stopped else []
    label = f"Trial on the {facts['on']}"
    payload = load_name(facts.get("payload", "none"))
    numbers = [Headline(OFTEN, label, f"{number(facts['duration'])} s", payload)]
    key = "steps.stopped" if stopped else "steps.fit_log"
    return Findings(numbers, [FigureKey("trial")], against, [message(key, **names(run))])


_RESPONSE = (
    ("delay", "Delay by the phase's slope", "ms", 1.0e3),
    ("bandwidth", "Gain 3 dB below its first", "Hz", 1.0),
    ("quadrature", "Phase passes −90°", "Hz", 1.0),
)


def _response(run: Saved) -> Findings:
    table, numbers = run.json("response.json"), []
    for key, label, unit, factor in _RESPONSE:
        if (result := table.get(key)) is not None:
            low, high = (None if end is None else factor * end for end in result["interval"])
            value = f"{number(factor * result['value'], 3)} {unit}"
            about = f"95 % interval {interval(low, high)} {unit}" if low is not None else ""
            numbers.append(Headline(OFTEN, label, value, about))
    return Findings(numbers, [FigureKey("response")], table["warnings"])


def _study(run: Saved) -> Findings:
    study = run.json("study.json")
    numbers = [_share_met(target) for target in study["targets"]]
    aimed = [target["measure"] for target in study["targets"]]
    spread = [item for item in study["measures"] if item.get("quantiles")]
    numbers += [_spread(item) for item in spread if item["name"] not in aimed]
    figures = [FigureKey("spread", case=name) for name in aimed]
    figures += [FigureKey("map"), *(FigureKey("spread", case=item["name"]) for item in spread)]
    lost = [
        f"{n} of {study['samples']} samples {words(word)}"
        for word, n in study["status"].items()
        if word in _LOST
    ]
    steps = [
        message("steps.lost_samples", **names(run), status=words(word))
        for word in study["status"]
        if word in _LOST
    ]
    return Findings(numbers, figures, lost, steps)


_LOST = ("failed", "refused", "late")


def ends_of(target: Table) -> str:
    """What a target asks: ``at most 20 mm``."""
    unit = f" {pretty(target['unit'])}" if target["unit"] else ""
    parts = [
        f"{word} {number(target[key])}{unit}"
        for key, word in (("at_most", "at most"), ("at_least", "at least"))
        if target.get(key) is not None
    ]
    return " and ".join(parts)


def _share_met(target: Table) -> Headline:
    span = interval(100.0 * target["low"], 100.0 * target["high"])
    return Headline(
        OFTEN,
        f"{capital(words(target['measure']))} {ends_of(target)}",
        f"{number(100.0 * target['share'], 3)} %",
        f"of {count(target['of'], 'sample')}; 95 % interval {span} %",
    )


def _spread(item: Table) -> Headline:
    unit = f" {pretty(item['unit'])}" if item["unit"] else ""
    middle, ends = (
        next((q for q in item["quantiles"] if q["share"] == share), None) for share in (0.5, 0.95)
    )
    assert middle is not None and ends is not None  # every summary has them
    return Headline(
        OFTEN,
        f"{capital(words(item['name']))}, median",
        f"{number(middle['value'], 3)}{unit}",
        f"95 % of {count(item['samples'], 'sample')} up to {number(ends['value'], 3)}{unit}",
    )


_FINDERS: dict[str, Callable[[Saved], Findings]] = {
    "flow_map": _flow_maps,
    "hydraulics": _hydraulics,
    "response": _response,
    "validation": _validation,
    "tuning": _tuning,
    "arc_tuning": _arc_tuning,
    "trial": _trial,
    "trials": _trials,
    "study": _study,
}
