"""Tunings in words: their functions, payloads and operating points, and what the figures show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report.blocks import Block, Text
from ehbench.report.captions import capital, load_name, measure, span
from ehbench.report.saved import Table
from ehbench.report.words import count, number, pretty, shown, unit_of, words


def function_names(tuning: Table) -> list[str]:
    """Working functions of a tuning, in its order."""
    return list(dict.fromkeys(point["point"]["function"] for point in tuning["points"]))


def payloads_of(tuning: Table) -> list[str]:
    """Payloads of a tuning, in its order."""
    return [equivalent["payload"] for equivalent in tuning["equivalents"]]


def counted(tuning: Table) -> list[Table]:
    """The operating points that the gain was chosen on."""
    return [point for point in tuning["points"] if point["counts"]]


def equivalents_caption(rig: Rig, tuning: Table, key: str, quantity: str, title: str) -> str:
    """The spans of an equivalent mass or force over the stroke, by payload."""
    unit = pretty(unit_of(rig, quantity))
    spans = "; ".join(
        f"{load_name(equivalent['payload'])}: "
        f"{span([float(shown(rig, quantity, v)) for v in equivalent[key]])} {unit}"
        for equivalent in tuning["equivalents"]
    )
    return (
        f"{title} of the {words(tuning['cylinder'])} at its cylinder over the stroke, "
        f"other joints held; dots: operating points. {capital(spans)}."
    )


def damping_caption(rig: Rig, tuning: Table) -> str:
    """The worst damping ratio at the choice, where it is, and what it is without feedback."""
    gains = sorted(set(tuning["feedback_gain"].values()))
    chosen = (
        " and ".join(measure(rig, "feedback_gain", gain) for gain in gains)
        if len(gains) < 4
        else f"{len(gains)} gains"
    )
    points = counted(tuning)
    minimum = min(points, key=lambda item: item["damping_ratio_closed"])
    dotted = (
        "; dotted: points that no load calls for" if len(points) < len(tuning["points"]) else ""
    )
    return (
        "Least damping ratio of all poles, a line an operating point; "
        f"black: the worst of the {len(points)} that count{dotted}. "
        f"At K_p = {chosen} the worst is {number(tuning['damping_ratio'], 2)} "
        f"({point_name(rig, minimum['point'])}); {undamped(tuning)}."
    )


def undamped(tuning: Table) -> str:
    """The damping ratios without any feedback, and with that of the off-side alone."""
    none, fixed = (
        span([tuning[f"damping_ratio_{loop}"], tuning[f"damping_ratio_{loop}_most"]], 2)
        for loop in ("open", "held")
    )
    text = f"without any feedback {none}"
    return text + (f", with the off-side held {fixed}" if tuning["off_gain"] else "")


def point_name(rig: Rig, point: Table) -> str:
    """An operating point in words: function, payload, stroke and speed in the rig's units."""
    v = float(shown(rig, "v", point["v"]))
    return (
        f"{words(point['function'])}, {load_name(point['payload'])}, "
        f"x = {measure(rig, 'x', point['x'])}, "
        f"v = {'+' if v > 0 else ''}{number(v, 3)} {pretty(unit_of(rig, 'v'))}"
    )


def locus_caption(
    rig: Rig, loci: Sequence[Table], by_name: Mapping[str, Table], counts: bool
) -> str:
    """What each payload's root locus comes to."""
    lead = (
        "At the operating point of each payload that is least damped with feedback. "
        "Dark: up to the choice; pale: beyond, towards the zeros (circles); "
        "× with K_p = 0, the off-side held, orange dot: at the choice. "
    )
    if not counts:
        lead = "No load calls for this function here; shown, not counted. " + lead
    sentences = [_locus_sentence(rig, item, by_name[item["name"]]) for item in loci]
    return lead + capital("; ".join(sentences)) + "."


def _locus_sentence(rig: Rig, locus: Table, result: Table) -> str:
    load, closed = load_name(result["point"]["payload"]), number(result["damping_ratio_closed"], 2)
    if locus["parameter"] == "feedback_gain":
        text = (
            f"{load}: damping ratio {number(result['damping_ratio_held'], 2)} at K_p = 0, "
            f"{closed} at K_p = {measure(rig, 'feedback_gain', locus['chosen'])}"
        )
        if locus.get("crossing") is None:
            return text + ", stable over the whole range looked at"
        return (
            text + f", unstable above {number(locus['crossing'] / locus['chosen'], 3)} times that"
        )
    corner = measure(rig, "washout", locus["chosen"])
    text = f"{load}: corner chosen at {corner}, damping ratio {closed}"
    plain = result.get("damping_ratio_plain")
    return text + (f" (without a washout {number(plain, 2)})" if plain is not None else "")


def overshoot_of(values: Sequence[float]) -> float | None:
    """Overshoot of a response over its last value, as a share of it; None where it ends at zero."""
    y = np.asarray(values, float)
    return None if y[-1] == 0.0 else max(0.0, float((y * np.sign(y[-1])).max() / abs(y[-1]) - 1.0))


def steps_caption(steps: Sequence[Table], by_name: Mapping[str, Table]) -> str:
    """Overshoot and damping ratio of each payload, without any feedback and with it."""
    sentences = []
    for step in steps:
        result = by_name[step["name"]]
        ends = [overshoot_of(step[key]) for key in ("v_open", "v_closed")]
        shares = [number(None if end is None else 100.0 * end, 2) for end in ends]
        ratios = [number(result[f"damping_ratio_{loop}"], 2) for loop in ("open", "closed")]
        sentences.append(
            f"{load_name(result['point']['payload'])}: overshoot over the last value "
            f"{shares[0]} % without any feedback, {shares[1]} % with; "
            f"damping ratio {ratios[0]} and {ratios[1]}"
        )
    return (
        "Linear model at the operating point that is least damped with feedback: "
        "speed after a step of desired speed, as a share of it. "
        + capital("; ".join(sentences))
        + "."
    )


def supply_blocks(rig: Rig, tuning: Table) -> list[Block]:
    """The supply that was tuned on, where its pressure is not constant."""
    supply = tuning.get("supply", {})
    if len(supply) <= 2:  # its kind and one pressure
        return []
    values = (
        f"{words(name)} {measure(rig, name, value)}"
        for name, value in supply.items()
        if name != "kind"
    )
    text = f"Tuned on {supply['kind']}: {', '.join(values)}. "
    text += "Each operating point has the pressure that the supply takes there."
    return [Text(text, "note")]


def draws_caption(tuning: Table) -> str:
    """What the draws say of the choice."""
    draws = tuning["robustness"]
    low, _, high = draws["quantiles"]
    return (
        f"{number(100.0 * draws['share'], 3)} % of {draws['draws']} draws of "
        f"{count(len(draws['parameters']), 'identified parameter')} "
        f"reach a damping ratio of {number(tuning['target'], 2)} "
        f"at the {draws['points']} least damped operating points; 90 % of them lie from "
        f"{number(low, 2)} to {number(high, 2)}."
    )
