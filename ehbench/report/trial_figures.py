"""Figures of trials under a controller: one trial in all its channels, estimates, and several
controllers on one motion.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ehbench.codes import ESTIMATES, FUNCTIONS, LIMITS
from ehbench.record import Record
from ehbench.report import energy_figures, series_figures
from ehbench.report.saved import Saved, Table
from ehbench.report.style import ACCENT, CYCLE, INK, MARKS, MUTED, RECORDED, SIMULATED, canvas, thin
from ehbench.report.telling import capital
from ehbench.report.tuning_figures import load_name, measure
from ehbench.report.words import axis, number, shown, words
from ehbench.rig import Rig, Slide
from ehbench.rundir import read_json

if TYPE_CHECKING:
    from ehbench.report.figures import Album

_SHADES = ("#e5e7eb", "#1f3f66", "#5b8fb9", "#a9c8e0", "#8a4b08", "#e08214", "#f3c583", "#2e7d5b")
_LIMIT_SHADES = {1: ACCENT, 2: "#8e4585", 4: "#7a6a4f", 8: "#9ca3af", 16: "#d4a017"}
# what the adaptive law's estimates are shown as: the payload instead of its share
SHOWN_ESTIMATES = ("payload_estimate", *(one for one in ESTIMATES if one != "payload_share"))
MANY = 3  # from so many controllers on, a comparison leaves out the commands
FAR_APART = 8.0  # ratio of largest errors from which a comparison takes a logarithmic axis
SLOW = 0.2  # share by which a steady speed may miss what was asked and still be compared
ROUNDING = 1e-9  # share of its bounds by which a logged estimate may lie outside
WINDOW = 0.1  # [s] over which an envelope takes the largest error
_RUNS = 700


@dataclass(frozen=True)
class Case:
    """One trial under a controller as a run saved it: its row of the table, its log, and its energy
    ledger if there is one.
    """

    row: Table
    stem: str
    log: Path
    ledger: Path

    def record(self) -> Record:
        """Its log."""
        from ehbench.logs import read_record

        return read_record(self.log)

    @property
    def cylinder(self) -> str:
        """The controlled cylinder."""
        return self.row["cylinder"]

    @property
    def steps(self) -> list[Table]:
        """Its steps of desired speed, if it has any."""
        return self.row["steps"]

    @property
    def fit(self) -> bool:
        """Whether it did what was asked, so that it may be compared: not stopped, and no step far
        slower than asked.
        """
        return not self.row.get("stopped") and all(
            abs(one["steady_error"]) < SLOW for one in self.steps
        )

    @property
    def where(self) -> str:
        """What it ran with and on: ``no load, on the virtual bench``."""
        return f"{load_name(self.row['payload'])}, on the {self.row['on']}"

    def energy(self) -> Table | None:
        """Its energy ledger."""
        return Table(read_json(self.ledger), self.ledger) if self.ledger.is_file() else None


def stem_of(text: str) -> str:
    """A text as part of a key: ``30 %`` → ``30``."""
    return re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_") or "x"


def cases_of(run: Saved) -> list[Case]:
    """The trials under a controller that a run holds: one of a ``trial`` run, all of a ``trials``
    run.
    """
    if run.stage == "trials":
        rows = run.json("table.json")["rows"]
        return [
            Case(
                row,
                Path(row["log"]).stem,
                run.folder / row["log"],
                run.folder / "ledgers" / f"{Path(row['log']).stem}.json",
            )
            for row in rows
        ]
    path = run.folder / "trial.json"
    facts = read_json(path)
    if not facts.get("controller"):
        return []
    row = Table({**facts, **facts["measures"], "case": run.title, "motion": ""}, path)
    return [Case(row, facts["cylinder"], run.folder / "log.mcap", run.folder / "ledger.json")]


def groups_of(cases: Sequence[Case]) -> dict[tuple[str, str], list[Case]]:
    """Cases that differ in their controller only, by (payload, motion)."""
    groups: dict[tuple[str, str], list[Case]] = {}
    for case in cases:
        groups.setdefault((case.row["payload"], case.row["motion"]), []).append(case)
    return groups


def draw_trial(run: Saved, album: Album) -> bool:
    """Figures of a single trial under a controller; False where it was run without one."""
    cases = cases_of(run)
    if not cases:
        return False
    record = cases[0].record()
    _alone(run, album, cases[0], record, "")
    for cylinder, channels in series_figures.live(run.rig, record).items():
        if cylinder != cases[0].cylinder:
            path = album.add(
                f"trial_{cylinder}",
                f"{run.title}: {cylinder}",
                "Commands, motion and pressures.",
                kind="trial",
                cylinder=cylinder,
            )
            series_figures.trial(path, run.rig, record, cylinder, channels)
    if (ledger := cases[0].energy()) is not None:
        energy_figures.sankey(
            album.add(
                "sankey", f"Where the energy went: {run.title}", sankey_said(ledger), kind="sankey"
            ),
            ledger,
        )
    return True


def draw_trials(run: Saved, album: Album) -> None:
    """Figures of a set of trials: every controller of a payload and motion in one, energies, then
    each trial alone.
    """
    rig, cases = run.rig, cases_of(run)
    records: dict[str, Record] = {}
    for (payload, motion), mine in groups_of(cases).items():
        if len(mine) > 1:
            records = {case.stem: case.record() for case in mine}
            title = f"{words(mine[0].cylinder).capitalize()}: {words(motion)}, {mine[0].where}"
            key = f"compare_{stem_of(load_name(payload))}_{stem_of(motion)}"
            path = album.add(
                key, title, compared_said(rig, mine), kind="compare", payload=payload, motion=motion
            )
            compare(
                path, rig, [(case.row["controller"], case, records[case.stem]) for case in mine]
            )
    for motion in dict.fromkeys(case.row["motion"] for case in cases):
        mine = [case for case in cases if case.row["motion"] == motion]
        _energies(rig, album, motion, mine)
    for case in cases:
        _alone(run, album, case, case.record(), f"{case.row['case']}, on the {case.row['on']}")
        if (ledger := case.energy()) is not None:
            title = f"Where the energy went: {case.row['case']}, on the {case.row['on']}"
            energy_figures.sankey(
                album.add(
                    f"sankey_{case.stem}",
                    title,
                    sankey_said(ledger),
                    kind="sankey",
                    case=case.row["case"],
                ),
                ledger,
            )


def _alone(run: Saved, album: Album, case: Case, record: Record, name: str) -> None:
    """The figure of one trial, and that of its estimates if they changed."""
    rig, about = run.rig, {"case": case.row["case"], "cylinder": case.cylinder}
    title = name or f"{run.title}: {case.cylinder}"
    controlled(
        album.add(f"trial_{case.stem}", title, case_said(rig, case), kind="trial", **about),
        rig,
        case,
        record,
    )
    if any(
        name in record and np.ptp(record[name]) > 0.0
        for name in (f"{case.cylinder}.{word}" for word in SHOWN_ESTIMATES)
    ):
        path = album.add(
            f"estimates_{case.stem}",
            f"Estimates: {title}",
            estimates_said(rig, case, record),
            kind="estimates",
            **about,
        )
        estimates(path, rig, case, record)


def _energies(rig: Rig, album: Album, motion: str, mine: Sequence[Case]) -> None:
    """The bars of one motion: from the ledgers where all trials have one, else the pump's energy
    alone.
    """
    ledgers = [case.energy() for case in mine]
    names = [f"{case.row['controller']}, {load_name(case.row['payload'])}" for case in mine]
    title = f"Energy: {words(motion)}, on the {mine[0].row['on']}"
    path = album.add(
        f"energy_{stem_of(motion)}", title, energy_said(rig, mine), kind="energy", motion=motion
    )
    if None not in ledgers:
        limits = [[one for one in ledger.get("bounds", []) if one["closed"]] for ledger in ledgers]
        energy_figures.bars(
            path, list(zip(names, ledgers, strict=True)), limits if any(limits) else None
        )
    else:
        pump_energies(path, rig, mine, names)


# --- sentences, computed from the run
# -------------------------------------------------------------------------------------


def percent(share: float | None, digits: int = 2) -> str:
    """A share as percent."""
    return f"{number(None if share is None else 100.0 * share, digits)} %"


def step_said(rig: Rig, one: Table) -> str:
    """What came of a step, with what could not be read off."""
    share = f" ({percent(one['share'], 3)})" if one.get("share") is not None else ""
    said = [
        f"asked for {measure(rig, 'v', one['speed'])}{share}",
        f"steady at {measure(rig, 'v', one['steady_speed'])} ({percent(one['steady_error'])})",
        "overshoot not to be told"
        if one.get("overshoot") is None
        else f"overshoot {percent(one['overshoot'])}",
        "not settled"
        if one.get("settling_time") is None
        else f"settled after {number(one['settling_time'], 2)} s",
    ]
    text = _damping_said(one)
    if one.get("natural_frequency") is not None:
        text += f" at {measure(rig, 'natural_frequency', one['natural_frequency'], 2)}"
    return ", ".join([*said, text])


def tracking_said(rig: Rig, row: Table) -> str:
    """How well a motion was tracked."""
    track = row["tracking"]
    return (
        f"largest error {measure(rig, 'x', track['max_error'])}, rms {measure(rig, 'x', track['rms_error'])}, "
        f"at the end {measure(rig, 'x', track['final_error'])}"
    )


def limits_said(row: Table) -> str:
    """Share of the time that edges were at each limit; nothing where they never were."""
    met = {name: share for name, share in row.get("limits", {}).items() if share > 0.0}
    return (
        "; at a limit: "
        + ", ".join(f"{words(name)} {percent(share)} of the time" for name, share in met.items())
        if met
        else ""
    )


def case_said(rig: Rig, case: Case) -> str:
    """What one trial came to."""
    row = case.row
    steps = (
        "; ".join(step_said(rig, one) for one in case.steps)
        if case.steps
        else tracking_said(rig, row)
    )
    text = f"{load_name(row['payload'])}, {words(row['controller'])}, on the {row['on']}: {steps}"
    text += f"; the pump gave {measure(rig, 'energy', row['energy']['pump'], 4)}"
    stopped = f". Stopped: {row['stopped']}" if row.get("stopped") else ""
    return _sentence(text + limits_said(row) + stopped)


def compared_said(rig: Rig, mine: Sequence[Case]) -> str:
    """What each controller came to on one motion."""
    said = []
    for case in mine:
        if case.steps:
            text = "; ".join(_step_in_short(one) for one in case.steps)
        else:
            text = tracking_said(rig, case.row)
        said.append(
            f"{words(case.row['controller'])}: {text}"
            + (", stopped by a limit" if case.row.get("stopped") else "")
        )
    return _sentence(". ".join(capital(text) for text in said)) + _best(mine)


def _step_in_short(one: Table) -> str:
    overshoot = (
        "no overshoot to be told"
        if one.get("overshoot") is None
        else f"overshoot {percent(one['overshoot'])}"
    )
    settled = (
        "not settled"
        if one.get("settling_time") is None
        else f"settled after {number(one['settling_time'], 2)} s"
    )
    return (
        f"{overshoot}, steady error {percent(one['steady_error'])}, {settled}, {_damping_said(one)}"
    )


def damping(one: Table) -> tuple[float | None, str]:
    """(damping ratio of a step's decay, doubt about it); of a speed that hardly rings it is that of
    the fit.
    """
    return one.get("damping_ratio_fitted", one.get("damping_ratio")), one["ringing"]


def _damping_said(one: Table) -> str:
    ratio, doubt = damping(one)
    if ratio is None:
        return "no damping ratio" + (f": {doubt}" if doubt else "")
    return (
        f"damping ratio about {number(ratio, 2)} ({doubt})"
        if doubt
        else f"damping ratio {number(ratio, 2)}"
    )


def _best(mine: Sequence[Case]) -> str:
    """Which controller does best and which worst by one number, where they differ; one that was
    stopped is no match.
    """
    found = []
    for case in mine:
        values = [one.get("overshoot") for one in case.steps] or [case.row["tracking"]["max_error"]]
        if None not in values and case.fit:
            found.append((max(values), case.row["controller"]))
    if len(found) < 2 or min(found)[0] == max(found)[0]:
        return ""
    (low, best), (high, worst) = min(found), max(found)
    what = "overshoot" if mine[0].steps else "largest error"
    times = f", {number(high / low, 3)} times as much" if low > 0.0 else ""
    return f" Best by {what}: {words(best)}; worst: {words(worst)}{times}."


def energy_said(rig: Rig, mine: Sequence[Case]) -> str:
    """For each payload, who takes least and most from the pump, and how far from where it should be
    it ended.
    """
    said = []

    def one(case: Case) -> str:
        off = measure(rig, "x", case.row["tracking"]["final_error"], 2)
        energy = measure(rig, "energy", case.row["energy"]["pump"], 4)
        return f"{words(case.row['controller'])}, {energy} (ended {off} from the desired stroke)"

    for payload in dict.fromkeys(case.row["payload"] for case in mine):
        found = [case for case in mine if case.row["payload"] == payload and case.fit]
        found.sort(key=lambda case: case.row["energy"]["pump"])
        if found:
            low, high = (case.row["energy"]["pump"] for case in (found[0], found[-1]))
            text = f"least from the pump, {load_name(payload)}: {one(found[0])}"
            if high > low:
                text += f"; {percent(1.0 - low / high)} less than the most, {one(found[-1])}"
            said.append(capital(text))
    if any(case.row.get("stopped") for case in mine):
        said.append("Trials that a limit stopped are left out")
    if slow := list(
        dict.fromkeys(
            words(case.row["controller"])
            for case in mine
            if not case.fit and not case.row.get("stopped")
        )
    ):
        said.append(f"Left out, more than {percent(SLOW)} off the speed asked: {', '.join(slow)}")
    kinds = list(dict.fromkeys(case.row["energy"]["source"] for case in mine))
    return ". ".join([*said, f"Source: {'; '.join(kinds)}"]) + "."


def estimates_said(rig: Rig, case: Case, record: Record) -> str:
    """Where the estimates ended, beside what they should be where that is known."""
    said = []
    for word in SHOWN_ESTIMATES:
        name = f"{case.cylinder}.{word}"
        if name in record:
            said.append(f"{words(word)} {measure(rig, word, float(record[name][-1]))}")
    text = f"At the end: {', '.join(said)}"
    truth, name = true_payload(rig, case.row["payload"]), f"{case.cylinder}.payload_estimate"
    if truth is not None and name in record:
        off = measure(rig, "mass", abs(float(record[name][-1]) - truth))
        text += f". The payload has the moment of {measure(rig, 'mass', truth)} at the end of the last link"
        text += f". The estimate ends {off} from it"
    return text + _bounds_said(case, record) + "."


def _bounds_said(case: Case, record: Record) -> str:
    """Whether the estimates kept to their bounds, and which ended at one."""
    bounds, outside, at_end = case.row.get("estimate_bounds", {}), [], []
    known = [
        word for word in SHOWN_ESTIMATES if word in bounds and f"{case.cylinder}.{word}" in record
    ]
    for word in known:
        values, (low, high) = record[f"{case.cylinder}.{word}"], bounds[word]
        room = ROUNDING * (high - low)
        if values.min() < low - room or values.max() > high + room:
            outside.append(words(word))
        elif values[-1] <= low + room or values[-1] >= high - room:
            at_end.append(words(word))
    said = (
        f". Not within its bounds all the time: {', '.join(outside)}"
        if outside
        else ". All estimates stay within their bounds"
    )
    return (said if known else "") + (
        f"; at its bound in the end: {', '.join(at_end)}" if at_end else ""
    )


def sankey_said(ledger: Table) -> str:
    """How far a ledger closes."""
    share = ledger.get("residual_share")
    kind = (
        "the model's own flows"
        if ledger["source"] == "model"
        else "measured channels and the rig file's maps"
    )
    return f"From {kind}" + (
        "." if share is None else f"; {percent(share)} of the pump's energy is not accounted for."
    )


def _sentence(text: str) -> str:
    return capital(text).rstrip(".") + "."


def true_payload(rig: Rig, payload: str) -> float | None:
    """What a payload estimate should find [kg]: `payload_at_end`, nothing without a payload."""
    return 0.0 if payload == "none" else payload_at_end(rig, payload)


def payload_at_end(rig: Rig, payload: str) -> float | None:
    """Mass [kg] at the end of the last link with the moment that a payload adds about the last
    joint.

    ``(m'(a + r') − m(a + r))/a``, r along the link from its end to the centre of mass. On a slide
    the added mass. None without a payload, or where it changes another link than the last."""
    changes = rig.payload.get(payload, {})
    last = rig.mechanism if isinstance(rig.mechanism, Slide) else rig.mechanism.joint[-1]
    if set(changes) != {last.name}:
        return None
    change, mass = changes[last.name], float(last.mass)
    loaded = mass if change.mass is None else float(change.mass)
    if isinstance(rig.mechanism, Slide):
        return loaded - mass
    length, before = float(last.dh_a), float(last.com.value[0])
    after = before if change.com is None else float(change.com.value[0])
    return (loaded * (length + after) - mass * (length + before)) / length if length else None


# --- drawing
# --------------------------------------------------------------------------------------------------------------


def _plot(ax, rig: Rig, record: Record, name: str, **look: Any) -> None:
    ax.plot(*thin(record.t, np.asarray(shown(rig, name, record[name]))), **look)


def _runs(t: np.ndarray, mask: np.ndarray, least: float) -> list[tuple[float, float]]:
    """(start, length) of the stretches where ``mask`` holds; gaps below ``least`` [s], which nobody
    could see, are closed.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    found: list[list[float]] = []
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        first, last = float(t[start]), float(t[min(stop, t.size - 1)])
        if found and first - found[-1][1] < least:
            found[-1][1] = last
        else:
            found.append([first, last])
    return [(first, max(last - first, least)) for first, last in found]


def _strip(ax, cases: Sequence[tuple[str, Case, Record]], limits: bool) -> list:
    """Bars over time: the working function of each case, and below one row a limit that was met;
    legend handles.
    """
    from matplotlib.patches import Patch

    rows: list[str] = []
    seen: set[int] = set()
    for name, case, record in cases:
        channel = f"{case.cylinder}.function"
        if channel not in record:
            continue
        t, least = record.t, float(record.t[-1] - record.t[0]) / _RUNS
        numbers = record[channel].round().astype(int)
        for one in np.unique(numbers):
            seen.add(int(one))
            ax.broken_barh(
                _runs(t, numbers == one, least),
                (len(rows) - 0.4, 0.8),
                facecolors=_SHADES[one],
                linewidth=0,
            )
        rows.append(name)
        flags = f"{case.cylinder}.limits"
        if limits and flags in record:
            bits = record[flags].round().astype(int)
            for bit, word in LIMITS.items():
                if (bits & bit).any():
                    ax.broken_barh(
                        _runs(t, bits & bit > 0, least),
                        (len(rows) - 0.3, 0.6),
                        facecolors=_LIMIT_SHADES[bit],
                        linewidth=0,
                    )
                    rows.append(word)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_yticks(range(len(rows)), rows, fontsize=7.5)
    ax.grid(False, axis="y")
    ax.tick_params(axis="y", length=0)
    return [Patch(color=_SHADES[one], label=words(FUNCTIONS[one])) for one in sorted(seen)]


def _flagged(record: Record, cylinder: str) -> Iterator[str]:
    """Limits that a case met."""
    name = f"{cylinder}.limits"
    if name in record:
        bits = int(np.bitwise_or.reduce(record[name].round().astype(int)))
        yield from (word for bit, word in LIMITS.items() if bits & bit)


def _saturated(ax, record: Record, cylinder: str) -> bool:
    """Shade a panel where an edge is saturated."""
    name = f"{cylinder}.limits"
    if name not in record:
        return False
    mask = record[name].round().astype(int) & 1 > 0
    if mask.any():
        span = float(record.t[-1] - record.t[0])
        ax.broken_barh(
            _runs(record.t, mask, span / _RUNS),
            (0, 1),
            transform=ax.get_xaxis_transform(),
            facecolors=ACCENT,
            alpha=0.13,
            linewidth=0,
            zorder=0,
        )
    return bool(mask.any())


def _beside(ax, **more: Any) -> None:
    ax.legend(
        loc="center left", bbox_to_anchor=(1.005, 0.5), borderaxespad=0.0, handlelength=1.8, **more
    )


def _commands(ax, rig: Rig, record: Record, cylinder: str) -> None:
    """The commands of a cylinder's valves that change."""
    names = [c for c in record.channels if c.startswith(f"{cylinder}.") and c.endswith(".command")]
    for index, name in enumerate(names):
        if np.ptp(record[name]) > 0.0:
            short = name.removeprefix(f"{cylinder}.").removesuffix(".command")
            _plot(
                ax,
                rig,
                record,
                name,
                color=CYCLE[index % len(CYCLE)],
                linestyle=MARKS[index % len(MARKS)],
                linewidth=1.1,
                label=short,
            )
    ax.margins(y=0.08)


def controlled(path: Path, rig: Rig, case: Case, record: Record) -> None:
    """One trial: desired and actual motion, pressures, commands with saturation shaded, working
    function and limits over time.
    """
    from matplotlib.patches import Patch

    own = case.cylinder
    motion = ["v", "x"] if case.steps else ["x", "error", "v"]
    strip = f"{own}.function" in record
    bars = 1 + len(list(_flagged(record, own)))
    panels = [*motion, "pressure", "command", *(["strip"] if strip else [])]
    heights = [{"strip": 0.16 * bars + 0.12}.get(panel, 1.0) for panel in panels]
    tall = 1.25 * sum(heights) + 0.28 * len(panels) + 0.5
    with canvas(
        path, len(panels), 1, (7.4, tall), sharex=True, squeeze=False, height_ratios=heights
    ) as (figure, axes):
        places = dict(zip(panels, axes[:, 0], strict=True))
        for word, text in (("x", "Stroke"), ("v", "Cylinder speed")):
            ax = places[word]
            _plot(ax, rig, record, f"{own}.{word}", color=RECORDED, linewidth=1.2, label="actual")
            _plot(
                ax,
                rig,
                record,
                f"{own}.{word}_desired",
                color=SIMULATED,
                linewidth=1.5,
                linestyle=(0, (4, 1.6)),
                label="desired",
            )
            if (
                word == "v"
                and f"{own}.v_shaped" in record
                and not np.array_equal(record[f"{own}.v_shaped"], record[f"{own}.v_desired"])
            ):
                _plot(
                    ax,
                    rig,
                    record,
                    f"{own}.v_shaped",
                    color=MUTED,
                    linewidth=1.0,
                    linestyle=":",
                    label="shaped",
                )
            ax.set_title(axis(rig, word, text))
            ax.margins(y=0.08)
            _beside(ax)
        if "error" in places:
            ax = places["error"]
            ax.plot(
                *thin(
                    record.t,
                    np.asarray(shown(rig, "x", record[f"{own}.x"] - record[f"{own}.x_desired"])),
                ),
                color=RECORDED,
                linewidth=1.0,
            )
            ax.axhline(0.0, color=MUTED, linewidth=0.7)
            ax.set_title(axis(rig, "x", "Tracking error, actual minus desired"))
        _pressures(places["pressure"], rig, record, own)
        _beside(places["pressure"])
        _commands(places["command"], rig, record, own)
        saturated = _saturated(places["command"], record, own)
        places["command"].set_title(axis(rig, "command", "Commands"))
        if places["command"].get_legend_handles_labels()[0]:
            _beside(places["command"])
        handles = _strip(places["strip"], [("function", case, record)], True) if strip else []
        if saturated:
            handles.append(Patch(facecolor=ACCENT, alpha=0.2, label="an edge is saturated"))
        _stop_line(axes[:, 0], record)
        axes[-1, 0].set_xlabel("time [s]")
        axes[-1, 0].set_xlim(record.t[0], record.t[-1])
        if handles:
            figure.legend(handles=handles, loc="outside lower center", ncols=3)


def _pressures(ax, rig: Rig, record: Record, own: str) -> None:
    for name, text, look in (
        (f"{own}.p_head", "head end", {"color": CYCLE[0]}),
        (f"{own}.p_rod", "rod end", {"color": CYCLE[1]}),
        (
            f"{own}.pressure_set",
            "set-point",
            {"color": MUTED, "linestyle": (0, (3, 2)), "linewidth": 1.0},
        ),
    ):
        if name in record:
            _plot(ax, rig, record, name, label=text, **({"linewidth": 1.1} | look))
    ax.set_title(axis(rig, "p_head", "Chamber pressures"))
    ax.margins(y=0.08)


def _stop_line(axes: Sequence[Any], record: Record) -> None:
    if "stopped" in record.meta and (t := series_figures.stop_time(record)) is not None:
        for ax in axes:
            ax.axvline(t, color=ACCENT, linewidth=1.1, linestyle=(0, (2, 2)))
        axes[0].annotate(
            "stopped",
            (t, 1.0),
            (0, 3),
            ("data", "axes fraction"),
            "offset points",
            color=ACCENT,
            fontsize=8,
            ha="center",
        )


def estimates(path: Path, rig: Rig, case: Case, record: Record) -> None:
    """What a controller has learnt over time, each within its bounds, the payload beside the true
    one.
    """
    own, bounds = case.cylinder, case.row.get("estimate_bounds", {})
    words_of = [word for word in SHOWN_ESTIMATES if f"{own}.{word}" in record]
    rows = -(-len(words_of) // 2)
    with canvas(path, rows, 2, (7.4, 1.95 * rows + 0.4), sharex=True, squeeze=False) as (_, axes):
        for ax in axes.flat[len(words_of) :]:
            ax.remove()
        for place, (ax, word) in enumerate(zip(axes.flat, words_of, strict=False)):
            _plot(ax, rig, record, f"{own}.{word}", color=RECORDED, linewidth=1.4)
            marks = (
                [("truth, from the rig file", true_payload(rig, case.row["payload"]), CYCLE[2])]
                if word == "payload_estimate"
                else []
            )
            marks += [
                (f"{text} bound", end, ACCENT)
                for text, end in zip(("lower", "upper"), bounds.get(word, ()), strict=False)
            ]
            for text, value, colour in marks:
                if value is None:
                    continue
                y = float(shown(rig, word, value))
                ax.axhline(y, color=colour, linewidth=1.1, linestyle=(0, (5, 3)))
                below, bound = (
                    text == "lower bound",
                    colour == ACCENT,
                )  # bounds outside of them, at the right; the truth at the left
                look = {
                    "color": colour,
                    "fontsize": 7.5,
                    "ha": "right" if bound else "left",
                    "va": "top" if below else "bottom",
                }
                said, place_of = (
                    f"{text} {number(y, 3)}" if bound else text,
                    ("axes fraction", "data"),
                )
                ax.annotate(
                    said,
                    (float(bound), y),
                    (-3 if bound else 3, -2 if below else 2),
                    place_of,
                    "offset points",
                    **look,
                )
            ax.margins(y=0.2)
            ax.set_title(axis(rig, word, capital(words(word))), fontsize=8.5)
            if place + 2 >= len(words_of):
                ax.tick_params(labelbottom=True)
                ax.set_xlabel("time [s]")


def compare(path: Path, rig: Rig, cases: Sequence[tuple[str, Case, Record]]) -> None:
    """Several controllers on one motion: speed (steps) or tracking error, both pressures,
    functions, and their commands.
    """
    from matplotlib.lines import Line2D

    own, steps = cases[0][1].cylinder, bool(cases[0][1].steps)
    looks = [
        {
            "color": CYCLE[i % len(CYCLE)],
            "linestyle": MARKS[i // len(CYCLE) % len(MARKS)],
            "linewidth": 1.2,
        }
        for i in range(len(cases))
    ]
    strip = any(f"{own}.function" in record for _, _, record in cases)
    top = ["v", "x"] if steps else ["error", "v"]
    panels = [*top, "p_head", "p_rod", *(["strip"] if strip else [])]
    commands = len(cases) <= MANY
    heights = [
        1.7 if panel == top[0] else 0.2 * len(cases) + 0.12 if panel == "strip" else 1.0
        for panel in panels
    ] + [1.1] * commands
    columns = len(cases) if commands else 1
    tall = 1.15 * sum(heights) + 0.3 * len(heights) + 0.6
    with canvas(path, len(heights), columns, (7.4, tall), squeeze=False, height_ratios=heights) as (
        figure,
        axes,
    ):
        grid = axes[0, 0].get_gridspec()
        places: dict[str, Any] = {}
        for row, panel in enumerate(panels):
            for ax in axes[row]:
                ax.remove()
            first = next(iter(places.values()), None)
            places[panel] = figure.add_subplot(grid[row, :], sharex=first)
        for word, ax in places.items():
            if word != panels[-1]:
                ax.tick_params(labelbottom=False)
            if word in ("error", "strip"):
                continue
            for (_, _, record), look in zip(cases, looks, strict=True):
                _plot(ax, rig, record, f"{own}.{word}", **look)
            if f"{own}.{word}_desired" in cases[0][2]:
                _plot(
                    ax,
                    rig,
                    cases[0][2],
                    f"{own}.{word}_desired",
                    color=INK,
                    linewidth=1.1,
                    linestyle=(0, (4, 2)),
                    zorder=1.5,
                )
            ax.set_title(axis(rig, word, series_figures.title_of(word)))
            ax.margins(y=0.06)
        if "error" in places:
            _errors(places["error"], rig, cases, looks)
        handles = _strip(places["strip"], cases, False) if strip else []
        places[panels[-1]].set_xlabel("time [s]")
        places[panels[-1]].set_xlim(min(r.t[0] for *_, r in cases), max(r.t[-1] for *_, r in cases))
        if commands:
            for index, (ax, (name, _, record)) in enumerate(zip(axes[-1], cases, strict=True)):
                _commands(ax, rig, record, own)
                _saturated(ax, record, own)
                ax.set_title(words(name), fontsize=8.5)
                ax.set_xlabel("time [s]")
                if index:
                    ax.sharey(axes[-1, 0])
                    ax.tick_params(labelleft=False)
            axes[-1, 0].set_ylabel(axis(rig, "command", "commands"))
            labelled = {
                label: handle
                for ax in axes[-1]
                for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
            }
            if labelled:
                axes[-1, -1].legend(
                    labelled.values(),
                    labelled.keys(),
                    loc="center left",
                    bbox_to_anchor=(1.01, 0.5),
                    handlelength=1.8,
                )
        lines = [
            Line2D([], [], **look, label=words(name))
            for (name, _, _), look in zip(cases, looks, strict=True)
        ]
        lines.append(
            Line2D([], [], color=INK, linewidth=1.1, linestyle=(0, (4, 2)), label="desired")
        )
        figure.legend(handles=lines, loc="outside upper center", ncols=min(len(lines), 4))
        if handles:
            figure.legend(handles=handles, loc="outside lower center", ncols=3)


def _errors(
    ax, rig: Rig, cases: Sequence[tuple[str, Case, Record]], looks: Sequence[dict[str, Any]]
) -> None:
    """Tracking errors; where they are far apart the largest of each WINDOW on a logarithmic axis."""
    found = []
    for _, case, record in cases:
        error = np.asarray(
            shown(rig, "x", record[f"{case.cylinder}.x"] - record[f"{case.cylinder}.x_desired"])
        )
        found.append((record.t, error))
    most = [float(np.abs(error).max()) for _, error in found]
    far = max(most) > FAR_APART * max(min(most), 1e-12)
    for (t, error), look in zip(found, looks, strict=True):
        if far:
            cut = np.arange(0, t.size, max(1, round(WINDOW / float(t[1] - t[0]))))
            ax.semilogy(
                t[cut],
                np.maximum(np.maximum.reduceat(np.abs(error), cut), 1e-3 * min(most)),
                drawstyle="steps-post",
                **look,
            )
        else:
            ax.plot(*thin(t, error), **look)
    if far:
        ax.yaxis.set_major_formatter(lambda tick, _: number(tick))
    else:
        ax.axhline(0.0, color=MUTED, linewidth=0.7)
    ax.set_title(
        axis(
            rig,
            "x",
            f"Tracking error, largest in every {number(WINDOW)} s"
            if far
            else "Tracking error, actual minus desired",
        )
    )


def pump_energies(path: Path, rig: Rig, mine: Sequence[Case], names: Sequence[str]) -> None:
    """A bar a trial: what it took from the pump."""
    values = [float(shown(rig, "energy", case.row["energy"]["pump"])) for case in mine]
    controllers = list(dict.fromkeys(case.row["controller"] for case in mine))
    with canvas(path, size=(7.4, 0.3 * len(mine) + 0.9)) as (_, ax):
        colours = [CYCLE[controllers.index(case.row["controller"]) % len(CYCLE)] for case in mine]
        ax.barh(range(len(mine)), values, height=0.66, color=colours, zorder=2)
        for place, value in enumerate(values):
            ax.annotate(
                number(value, 4),
                (max(value, 0.0), place),
                (4, 0),
                textcoords="offset points",
                va="center",
                fontsize=8,
            )
        ax.set_yticks(range(len(mine)), [words(name) for name in names])
        ax.set_ylim(len(mine) - 0.4, -0.6)
        ax.set_xlim(min(0.0, *values), 1.12 * max(*values, 1e-12))
        ax.grid(False, axis="y")
        ax.set_xlabel(axis(rig, "energy", "energy from the pump"))
