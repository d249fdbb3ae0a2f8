"""What must hold before a trial moves a machine: a dry run within the same limits, a stopping
distance that fits the margin, a link that keeps time, whose delays and clocks are estimated, and a
person who says so."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w

from ehbench.data.record import Record
from ehbench.diagnosis import likely_cause
from ehbench.links.client import LinkMachine
from ehbench.links.opening import Address, open_machine
from ehbench.links.quality import QUALITY, measure
from ehbench.machines.protocol import Machine, unmeasured_of
from ehbench.runtime.realtime import punctual
from ehbench.trial.operator import (
    OperatorInput,
    Replayed,
    both_ends,
    levers_of,
    logged,
    refuse_unmanned,
)
from ehbench.trial.preparation import RUN_OUT, Prepared
from ehbench.trial.running import Result, run
from ehbench.trial.session import SESSION, Watcher
from ehbench.vocabulary import InputError, Progress, SimulationError, message

Ask = Callable[[str, str], str]  # (what is about to happen, the token) → what was typed
PROBE = 2.0  # [s] for which a link is measured before each trial


class Remote(NamedTuple):
    """A trial over a link: its result, what is to be said of the link, of the dry run beside it,
    and warnings."""

    result: Result
    link: dict[str, Any]
    dry_run: dict[str, Any]
    warnings: list[str]


def token_of(prepared: Prepared, url: str) -> str:
    """Six letters and digits that stand for a rig, a recipe and a link."""
    recipe = prepared.recipe.path
    parts = [tomli_w.dumps(prepared.rig.as_toml()).encode(), url.encode()]
    parts += [recipe.read_bytes()] if recipe.is_file() else []
    return sha256(b"\0".join(parts)).hexdigest()[:6].upper()


def stopping_distances(prepared: Prepared, record: Record, watchdog: float) -> dict[str, float]:
    """How far each cylinder of the model goes on [m] after its fastest row when the link dies: the
    last command stays for ``watchdog`` [s], then the valves go to rest by the recipe's ramp."""
    machine, rest = prepared.machine, prepared.machine.commands.rest
    names = machine.commands.names
    commands = np.column_stack([record[f"{name}.command"] for name in names])
    hold, ramp = (
        round(seconds * machine.rate) for seconds in (watchdog, float(prepared.recipe.limits.ramp))
    )
    reached = {}
    for cylinder in prepared.rig.cylinder:
        v = np.abs(record[f"{cylinder.name}.v"])
        row, place = int(np.argmax(v)), machine.channels.index(f"{cylinder.name}.x")
        if v[row] < SESSION.still:
            continue
        sample = machine.start(prepared.posture, prepared.low_side)
        for command in commands[:row]:
            sample = machine.tick(command)
        first, strokes, last = sample[place], [], commands[max(row - 1, 0)]
        for tick in range(hold + ramp + round(0.5 * RUN_OUT * machine.rate)):
            share = np.clip((tick - hold + 1) / (ramp + 1), 0.0, 1.0)
            strokes.append(machine.tick((1.0 - share) * last + share * rest)[place])
        reached[cylinder.name] = float(np.abs(np.array(strokes) - first).max())
    return reached


def rehearsed(prepared: Prepared, watchdog: float) -> tuple[Result, dict[str, float]]:
    """The trial on the model, tick by tick so that all its kernels are compiled, and the stopping
    distances [m] there.

    Raises:
        InputError: a limit stops the dry run; no ``stroke_margin``, or a smaller one.
    """
    recipe, levers, operator = prepared.recipe, levers_of(prepared), None
    if levers:
        given = both_ends([*levers.values()])
        prepared, operator = _as_long(prepared, len(given)), Replayed(given)
    dry = run(prepared, fast=False, operator=operator)
    if dry.facts.stopped:
        raise InputError(message("links.dry_run", stopped=dry.facts.stopped), **recipe.at("limits"))
    margin = recipe.limits.stroke_margin
    if margin is None:
        raise InputError(message("links.no_margin"), **recipe.at("limits"))
    distances = stopping_distances(prepared, dry.record, watchdog)
    for cylinder, distance in distances.items():
        if distance > float(margin):
            shown = (prepared.rig.shown("x", value) for value in (distance, float(margin)))
            fields = dict(zip(("distance", "margin"), shown, strict=True))
            problem = message("links.stopping", cylinder=cylinder, **fields)
            raise InputError(problem, **recipe.at("limits", "stroke_margin"))
    return dry, distances


def _as_long(prepared: Prepared, rows: int) -> Prepared:
    return replace(prepared, t=prepared.t[:rows], table=prepared.table[:rows])


def _where_it_stands(prepared: Prepared, machine: LinkMachine) -> Prepared:
    """The trial from where its machine stands now, and not up to a tolerance beside."""
    machine.reach(prepared.posture, prepared.low_side)
    machine.prepared = prepared = prepared.standing_at(machine.sample())
    return prepared


def _permitted(
    prepared: Prepared, address: Address, ask: Ask | None
) -> tuple[Prepared, Machine, Result, dict[str, float]]:
    """(a trial from where its machine stands, the machine, which a person says may move now, the
    dry run, the stopping distances [m]). Where it may not, the link is let go.

    Raises:
        InputError: as `run_remote`.
    """
    recipe, url, watchdog = prepared.recipe, address.url, 0.0
    for key in ("payload_change", "fault", "machine"):
        if getattr(recipe, key):
            raise InputError(message("links.simulated", key=key, url=url), **recipe.at(key))
    machine = open_machine(prepared, url)
    with ExitStack() as refusal:
        refusal.callback(machine.close)
        if isinstance(machine, LinkMachine):  # it must keep time, and stand where the trial begins
            if not address.virtual:
                with punctual() as refused:
                    quality = measure(address.link(), url, PROBE, tuple(refused))
                for problem in quality.problems():
                    raise InputError(problem)
            prepared = _where_it_stands(prepared, machine)
            watchdog = machine.watchdog
        dry, distances = rehearsed(prepared, watchdog)
        token, farthest = token_of(prepared, url), max(distances.values(), default=0.0)
        shown = prepared.rig.shown("x", farthest)
        about = message("links.about", rig=prepared.rig.name, url=url, distance=shown)
        if blind := [name for name in unmeasured_of(machine) if name.endswith(".x")]:
            about += "; " + message("links.blind", channels=", ".join(blind))
        if ask is None:
            raise InputError(message("links.unarmed", about=about, token=token))
        if ask(about, token).strip().upper() != token:
            raise InputError(message("links.wrong_token", token=token))
        if isinstance(machine, LinkMachine):  # it may have crept since
            prepared = _where_it_stands(prepared, machine)
        refusal.pop_all()
    return prepared, machine, dry, distances


def run_remote(
    prepared: Prepared,
    url: str,
    ask: Ask | None,
    log: Path | None = None,
    progress: Progress | None = None,
    watcher: Watcher | None = None,
    operator: OperatorInput | None = None,
) -> Remote:
    """Run a prepared trial on the machine at the other end of a URL.

    Args:
        prepared: the trial; its machine is the model of the dry run.
        url: of the link.
        ask: gets the token from a person; without it the trial ends after the dry run.
        log: as for `ehbench.trial.run`.
        progress: told the share done.
        watcher: sees each row.
        operator: holds the levers of the trial's motions.

    Raises:
        InputError: what `rehearsed` refuses; a link that does not keep time; the wrong token; what
            a recipe can change on a simulation alone.
    """
    refuse_unmanned(prepared, operator)
    address = Address.of(url)
    prepared, machine, dry, distances = _permitted(prepared, address, ask)
    fast = address.mode == "buffered"
    with punctual() as refused:
        result = run(prepared, machine, log, progress, fast, watcher, operator)
    record, stop, warnings, counted = result.record, result.facts.stop, [], {}
    late = unheeded = 0
    ticks = record.t.size if stop is None else int((record.t <= stop.t).sum())
    if isinstance(machine, LinkMachine):
        gaps = record.channels.get("missed_ticks", np.zeros(1))  # none of a table
        late, unheeded = machine.missed + int(gaps[:ticks].sum()), machine.unheeded
        counted = {"unheeded": unheeded, "rejected": dict(sorted(machine.rejected.items()))}
        counted |= estimated(exchanges_in(record) or machine.exchanges)
    for key, count in (("late", late), ("unheeded", unheeded)):
        if count > QUALITY.late * ticks:
            warnings.append(message(f"links.{key}", share=count / ticks, most=QUALITY.late))
    warnings += causes_of_stop(prepared, result)
    link = {
        "url": url,
        "mode": address.mode,
        "ticks": ticks,
        "late": late,
        "not_allowed": list(refused),
        **counted,
    }
    if levers := levers_of(prepared):  # what an operator does is known now
        given = logged(result.record, levers)
        with suppress(SimulationError):
            dry = run(_as_long(prepared, len(given)), fast=False, operator=Replayed(given))
    compared = compare(dry.record, result.record)
    compared["stopping_distance"] = distances
    compared["tracking"] = dry.facts.measures.get("tracking", {})
    return Remote(result, link, compared, warnings)


def causes_of_stop(prepared: Prepared, result: Result) -> list[str]:
    """What a trial that stopped on a machine says of the cause, by the model of its rig: such as a
    turned command or exchanged sensors. Nothing of one that ended, or did not move at all.
    """
    stop, told = result.facts.stop, result.facts.warnings
    if stop is None or any(getattr(note, "key", "") == "trial.unmoved" for note in told):
        return []
    record = result.record.between(0.0, stop.t)
    cause = likely_cause("the trial", record, prepared.rig, prepared.maps)
    return [message("links.likely", cause=cause)] if cause else []


def compare(dry: Record, real: Record) -> dict[str, Any]:
    """How far a machine was from its dry run: largest and rms difference [SI] of each stroke and
    pressure, over the time that both have."""
    end = min(dry.t[-1], real.t[-1])
    t = dry.t[dry.t <= end]
    differences = {}
    for name in real.channels:
        if name.rsplit(".", 1)[-1] in ("x", "p_head", "p_rod") and name in dry:
            apart = np.interp(t, real.t, real[name]) - dry[name][: t.size]
            rms = float(np.sqrt(np.mean(apart**2)))
            differences[name] = {"largest": float(np.abs(apart).max()), "rms": rms}
    return {"differences": differences}


def exchanges_in(record: Record) -> list[tuple[float, ...]]:
    """The exchanges of a log, for `estimated`; none of one that has no packets."""
    names = ("packet", "packet_sent", "packet_received", "sample_time", "packet_acknowledged")
    if names[0] not in record:
        return []
    table = np.column_stack([record[name] for name in names])
    table = table[table[:, 0] > 0.0]  # before the first there is none
    return table[np.unique(table[:, 0], return_index=True)[1]].tolist()


def estimated(exchanges: Sequence[Sequence[float]]) -> dict[str, Any]:
    """Clock offset, drift and transport delays, each with its interval, of a link.

    A packet never comes before it left. A sample taken at t by the target and received at h by the
    host bounds the offset θ of the host's clock from above, θ ≤ h − t. A command sent at h and
    acknowledged by the sample of t bounds it from below, θ ≥ h − t. The offset's interval is that
    of the bounds that 95 % of the ticks keep, for a target stamps its ticks as they were due.
    Delays are medians, their intervals those of the median (95 %, order statistics) widened by the
    offset's.

    Args:
        exchanges: (number of the command, host time sent, host time received, target time,
            number acknowledged) of each tick [s].

    Returns:
        ``clock_offset``, ``command_delay``, ``sample_delay`` [s] and ``clock_drift`` as (value,
        low, high); empty of fewer than ten ticks.
    """
    table = np.array(exchanges)
    if len(table) < 10:
        return {}
    number, sent, came, t, acknowledged = table.T
    span = np.linspace(t[0], t[-1], 11)
    parts = [(t >= a) & (t <= b) for a, b in zip(span[:-1], span[1:], strict=True)]
    # of each part the sample that came soonest after it was taken, and the line through these
    waits = [np.where(part, came - t, np.inf) for part in parts if part.any()]
    soonest = [int(np.argmin(wait)) for wait in waits]
    taken, waited = t[soonest], (came - t)[soonest]
    taken, waited = taken - taken.mean(), waited - waited.mean()
    spread = float(taken @ taken)
    slope = float(taken @ waited) / spread
    rest = waited - slope * taken
    error = float(np.sqrt(rest @ rest / max(len(taken) - 2, 1) / spread))
    base = t[0]
    first = np.searchsorted(acknowledged, number)  # the sample that acknowledges a command
    known = first < len(t)
    up, down = came - t - slope * (t - base), np.full(len(t), np.nan)
    acted = t[first[known]]
    down[known] = sent[known] - acted - slope * (acted - base)
    low, high = float(np.nanquantile(down, 0.95)), float(np.quantile(up, 0.05))
    offset, half = 0.5 * (low + high), 0.5 * abs(high - low)
    return {
        "clock_offset": (offset, offset - half, offset + half),
        "clock_drift": (slope, slope - 2.0 * error, slope + 2.0 * error),
        "command_delay": _median(offset - down[known], half),
        "sample_delay": _median(up - offset, half),
    }


def _median(values: np.ndarray, half: float) -> tuple[float, float, float]:
    """(median, the ends of its 95 % interval widened by ``half``)."""
    ordered, n = np.sort(values), len(values)
    reach = 0.98 * np.sqrt(n)
    low, high = (int(np.clip(round(0.5 * n + side * reach), 0, n - 1)) for side in (-1, 1))
    middle = float(np.median(ordered))
    return middle, float(ordered[low]) - half, float(ordered[high]) + half
