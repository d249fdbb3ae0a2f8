"""Run one prepared trial on its machine, and state the facts about it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ehbench.config.recipe import TrialRecipe
from ehbench.config.rig import Rig
from ehbench.control.arc import ARC
from ehbench.data.logs import check_record
from ehbench.data.record import Record, payloads_of
from ehbench.ledger.readings import least_step
from ehbench.machines.protocol import Machine, heard_of, in_real_time, truth_of
from ehbench.plant.build import links_of
from ehbench.plant.model import Start
from ehbench.plant.paced import AUTO
from ehbench.plant.stiffness import short_steps
from ehbench.preprocessing.observations import SETTINGS as OBSERVED
from ehbench.preprocessing.observations import commanded
from ehbench.preprocessing.time_base import SEQUENCE
from ehbench.trial.controllers import Compiled, controller_of, valve_fault
from ehbench.trial.coordination import Driven
from ehbench.trial.limit_cycle import limit_cycle
from ehbench.trial.measures import (
    function_measures,
    learnt_maps,
    short_measures,
    step_measures,
    tracking_measures,
    unmoved_measures,
)
from ehbench.trial.operator import OperatorInput
from ehbench.trial.preparation import Aftermath, Prepared, Stop, prepare
from ehbench.trial.session import LiveLog, Session, Watcher
from ehbench.vocabulary import InputError, Message, Progress, SimulationError, message, quantity
from ehbench.vocabulary.codes import LIMITS as LIMIT_BITS
from ehbench.vocabulary.codes import SATURATED

if TYPE_CHECKING:
    from ehbench.plant.build import Maps
    from ehbench.plant.model import Model

SELDOM = ("payload_change", "first_pressure_error")  # facts only of trials that have them


@dataclass(frozen=True)
class Facts:
    """What is to be said of a trial beside its record.

    ``stopped`` is empty, or says which limit stopped it and what came of it; ``stop`` and ``after``
    have the same as numbers. ``measures`` says how well a controlled cylinder did and with which
    gains (docs/reference), SI; empty without a controller. Its energies are the ledger's: see
    `ehbench.trial.cases`. ``payload_change``: (time [s], payload from then on);
    ``first_pressure_error`` [Pa] by channel."""

    on: str
    rig: str
    payload: str
    posture: dict[str, str]
    seed: int
    duration: float
    samples: int
    rate: float
    stop: Stop | None = None
    after: Aftermath | None = None
    warnings: tuple[str, ...] = ()
    controller: str = ""
    cylinder: str = ""
    measures: dict[str, Any] = field(default_factory=dict)
    payload_change: tuple[tuple[float, str], ...] = ()
    first_pressure_error: Mapping[str, float] = field(default_factory=dict)

    @property
    def stopped(self) -> str:
        """Why the trial stopped and what came of it, or ''."""
        sentences = [each.sentence for each in (self.stop, self.after) if each is not None]
        return "; ".join(sentences)

    @property
    def cylinders(self) -> tuple[str, ...]:
        """The controlled cylinders, the one that the trial is about first."""
        return (self.cylinder, *self.measures.get("also", {})) if self.cylinder else ()

    def with_energy(self, energy: Mapping[str, Mapping[str, Any]]) -> Facts:
        """The same with the energies of each controlled cylinder among its measures."""
        known = dict(self.measures)
        also = {
            name: _with_energy(item, energy[name]) for name, item in known.pop("also", {}).items()
        }
        measures = _with_energy(known, energy[self.cylinder])
        return replace(self, measures=measures | ({"also": also} if also else {}))

    def as_json(self) -> dict[str, Any]:
        """Plain values for a JSON file."""
        plain = {**asdict(self), "stopped": self.stopped, "warnings": list(self.warnings)}
        return {name: value for name, value in plain.items() if value or name not in SELDOM}


def _with_energy(measures: Mapping[str, Any], energy: Mapping[str, Any]) -> dict[str, Any]:
    known = dict(measures)
    last = {"limits": known.pop("limits")} if "limits" in known else {}
    return {**known, "energy": dict(energy), **last}


class Result(NamedTuple):
    """What a trial leaves: its record, the facts about it, and the model whose states are in the
    record, where the machine could tell them."""

    record: Record
    facts: Facts
    model: Model | None


def run_trial(
    rig: Rig,
    recipe: TrialRecipe,
    maps: Maps | None = None,
    progress: Progress | None = None,
    *,
    gains: Path | None = None,
    allow_code: bool = False,
) -> tuple[Record, Facts]:
    """The record and the facts of one trial: `prepare`, then `run`."""
    record, facts, _ = run(prepare(recipe, rig, maps, gains, allow_code), progress=progress)
    return record, facts


def run(
    prepared: Prepared,
    machine: Machine | None = None,
    log: Path | None = None,
    progress: Progress | None = None,
    fast: bool = True,
    watcher: Watcher | None = None,
    operator: OperatorInput | None = None,
) -> Result:
    """Run a prepared trial from rest.

    On the model the record has all that `Model.record` gives; on the virtual bench only what a
    machine measures, and the commands; under a controller also its notes. When a limit is reached
    the valves go to rest from that very tick on, in the recipe's ramp, and what follows is logged
    until the machine stands, for RUN_OUT seconds at most.

    Args:
        prepared: the trial.
        machine: that it runs on, closed afterwards; by default the one that the recipe names.
        log: where to write the log, sample by sample, with recipe and rig attached; none by
            default.
        progress: told the share done, from 0 to 1.
        fast: advance many rows at a time where the machine can; the same bits either way.
        watcher: sees each row as it is logged; a log is then written beside the trial.
        operator: holds the levers of the trial's motions.

    Raises:
        InputError: a limit reached before the start; a user's class that raised.
        SimulationError: the numbers left the finite range.
    """
    at_work = prepared.machine if machine is None else machine
    with ExitStack() as logging:
        with closing(at_work):  # at once, not when all is written
            session = Session(prepared, at_work, fast, watcher, operator)
            meta, live = prepared.meta(at_work), None
            if log is not None:
                import tomli_w

                names = list(session.channels(slice(0, 0)))
                rig_file = tomli_w.dumps(prepared.rig.as_toml()).encode()
                files = {"recipe.toml": prepared.recipe.path.read_bytes(), "rig.toml": rig_file}
                aside = in_real_time(at_work) or watcher is not None
                live = logging.enter_context(closing(LiveLog(log, names, meta, files, aside)))
            session.run(live, progress)
        record = _record(session, meta)
        if live is not None:
            live.finish(record)
    truth, facts = truth_of(at_work), _run_facts(prepared, session, record)
    if truth is None:
        return Result(record, facts, None)
    # what makes its simulation slow, by its commands and its first payload
    model = replace(truth.model, plant=truth.model.plant._replace(links=links_of(truth.model.rig)))
    start = Start(model.trim(model.posture(prepared.posture), prepared.low_side))
    rate = math.inf if prepared.recipe.step == AUTO else truth.rate
    notes = short_steps(model, record, start, rate)
    return Result(record, replace(facts, warnings=(*facts.warnings, *notes)), truth.model)


def log_channels(prepared: Prepared) -> tuple[str, ...]:
    """The channels that the log of a prepared trial will have; its machine is closed.

    Raises:
        EhbenchError: as `run`, before the first tick; a user's class is loaded.
    """
    with closing(prepared.machine) as machine:
        return tuple(Session(prepared, machine).channels(slice(0, 0)))


def _record(session: Session, meta: dict[str, str]) -> Record:
    if not np.isfinite(session.rows.commands[: session.end]).all():
        raise SimulationError(message("trial.no_number"))
    if session.stop is not None:
        meta = meta | {"stopped": session.stop.sentence}
    whole = slice(0, session.end)
    record = _on_beats(
        Record(session.rows.t[whole], session.channels(whole), meta), session.machine
    )
    try:
        check_record(record)
    except InputError as error:
        raise SimulationError(message("trial.diverged", problem=error.message)) from None
    return record


def _on_beats(record: Record, machine: Machine) -> Record:
    """A record of a machine in real time with a row for each of its ticks, those that a late host
    left out among them: samples and commands as the machine sent them, by straight lines where a
    sample was lost; what only the host knows as it was in the row before."""
    heard = heard_of(machine)
    if heard is None:
        return record
    times, sent = heard
    t = np.arange(round(float(record.t[-1]) * machine.rate) + 1) / machine.rate
    row = np.clip(np.searchsorted(record.t, t + 0.5 / machine.rate) - 1, 0, None)
    channels = {name: values[row] for name, values in record.channels.items()}
    after = np.minimum(np.searchsorted(times, t + 0.5 / machine.rate), len(times) - 1)
    last = np.clip(np.searchsorted(times, t + 0.5 / machine.rate) - 1, 0, None)
    channels[SEQUENCE] = np.round(times[last] * machine.rate)
    known = t <= times[-1]  # a link that is lost says nothing of what acted
    for i, name in enumerate(machine.channels):
        sound = quantity(name).holds(sent[:, i])
        if name in channels and sound.any():
            channels[name] = np.interp(t, times[sound], sent[sound, i])
    for i, valve in enumerate(machine.commands.names, len(machine.channels)):
        name = f"{valve}.command"
        acted = sent[after, i]
        said = known & quantity(name).holds(acted)
        channels[name] = np.where(said, acted, channels[name])
    return replace(record, t=t, channels=channels)


def _run_facts(prepared: Prepared, session: Session, record: Record) -> Facts:
    recipe, stop, rate = prepared.recipe, session.stop, session.machine.rate
    warnings = list(prepared.notes)
    for channel, count in zip(session.machine.channels, session.gaps.tolist(), strict=True):
        if count:
            warnings.append(message("trial.sensor_gaps", channel=channel, count=count))
    measures = {}
    if session.user_code is not None and session.user_code.beyond:
        counts = {"count": session.user_code.beyond, "ticks": session.end}
        warnings.append(message("trial.beyond_driver", label=session.user_code.label, **counts))
    if prepared.loop is not None:
        rows = session.end if stop is None else max(round(stop.t * rate) + 1, 2)
        results = {}
        for item, part in zip(prepared.loop.driven, session.laws, strict=True):
            results[item.cylinder] = known = part.used | _measures(
                record, item, rows, session.true_strokes
            )
            if isinstance(part, Compiled) and part.law.after is not None:
                known |= part.law.after(part.used, part.controller)
            known["valves"] = item.design.valve_frequencies
            if part.used.get("gains", {}).get("adapt_maps"):
                known["maps"] = learnt_maps(item.design, session.machine, record, rows)
            measured = f"{item.cylinder}.v" in record
            if isinstance(part, Compiled) and part.law.warns_saturated and measured:
                v, desired, met = (
                    record[f"{item.cylinder}.{name}"][:rows]
                    for name in ("v", "v_desired", "limits")
                )
                saturated = met.astype(int) & SATURATED > 0
                known["short"] = short_measures(record.t[:rows], v, desired, saturated)
            unmoved = unmoved_of(record, item, rows)
            warnings += _trial_warnings(known, prepared.rig, item.cylinder, unmoved)
            warnings += _coarse_stroke(record, known, prepared.rig, item.cylinder)
            code = record.channels.get(f"{item.cylinder}.valve_fault", np.zeros(1))
            if code.any():
                known["valve_fault"] = fault = valve_fault(item.design, record.t, code)
                warnings.append(message(f"trial.valve_{fault['stays']}", **fault))
        measures = results.pop(prepared.loop.design.cylinder)
        if prepared.loop.plan is not None:
            measures |= prepared.loop.plan.measures(record, rows)
        if results:
            measures["also"] = results
    return Facts(
        session.machine.name,
        prepared.rig.name,
        record.meta["payload"],
        prepared.posture,
        recipe.seed,
        float(record.t[-1]),
        record.t.size,
        rate,
        stop,
        session.after,
        (*warnings, *_shown_by(record, measures, prepared.rig)),
        record.meta.get("controller", ""),
        record.meta.get("cylinder", ""),
        measures,
        tuple((at, name or "none") for at, name in payloads_of(record)[1:]),
        {name: float(error) for name, error in recipe.first_pressure_error.items()},
    )


def unmoved_of(record: Record, item: Driven, rows: int) -> dict[str, float] | None:
    """`unmoved_measures` up to a row, of a cylinder whose valves were commanded; None where its
    speed says otherwise."""
    name, t = item.cylinder, record.t[:rows]
    if name not in commanded(item.design.model, record):
        return None
    strokes = [record[f"{name}.x"][:rows]]
    if f"{name}.v" in record:
        strokes.append(np.cumsum(record[f"{name}.v"][:rows]) * (t[1] - t[0]))
    said = [unmoved_measures(t, x, record[f"{name}.x_desired"][:rows]) for x in strokes]
    return None if None in said else said[0]


def _trial_warnings(
    measures: Mapping[str, Any], rig: Rig, cylinder: str, unmoved: Mapping[str, float] | None
) -> list[Message]:
    """Warnings of a cylinder that stood still, of saturated valves, limit cycles and missing
    working functions."""
    warnings, known = [], {"cylinder": cylinder}
    short, cycle = measures.get("short"), measures["limit_cycle"]
    share = measures["limits"]["saturated"] if "short" in measures else 0.0
    if unmoved is not None:
        wanted = {"duration": unmoved["duration"], "desired": rig.shown("v", unmoved["desired"])}
        warnings.append(message("trial.unmoved", **wanted, **known))
    elif short is not None and share > 0.0:
        speeds = {name: rig.shown("v", short[name]) for name in ("reached", "desired")}
        since = {name: short[name] for name in ("duration", "start")}
        warnings.append(message("trial.saturated_short", share=share, **since, **speeds, **known))
    elif share > 0.0:
        warnings.append(message("trial.saturated", share=share, **known))
    if cycle is not None:
        since = {name: cycle[name] for name in ("period", "start", "duration")}
        amplitude = rig.shown("x", cycle["amplitude"], 3)
        warnings.append(message("trial.swings", amplitude=amplitude, **since, **known))
    shares = measures.get("functions", {})
    return warnings + [
        message({"stalled": "trial.stalled", "unable": "trial.unable"}[word], share=share, **known)
        for word in ("stalled", "unable")
        if (share := shares.get(word, 0.0)) > 0.0
    ]


def _shown_by(record: Record, measures: Mapping[str, Any], rig: Rig) -> Iterator[Message]:
    """A warning where the pump's flow made a motion of several cylinders take longer, and of each
    chamber that cavitated, with how long it did in all."""
    sharing = measures.get("sharing", {})
    if sharing.get("slowed", 0.0) > 0.0:
        flows = {name: rig.shown("flow", sharing[f"flow_{name}"]) for name in ("demand", "limit")}
        yield message("trial.slowed", longer=sharing["longer"], **flows)
    limit = OBSERVED.empty * float(rig.oil.cavitation_pressure)
    for item, word in product(rig.cylinder, ("p_head", "p_rod")):
        name = f"{item.name}.{word}"
        if name in record and (void := record[name] < limit).any():
            times = {"start": float(record.t[void][0]), "duration": void.sum() * record.sample_time}
            yield message("trial.cavitates", channel=name, **times)


def _coarse_stroke(
    record: Record, known: Mapping[str, Any], rig: Rig, cylinder: str
) -> Iterator[Message]:
    """A warning where a sensor's counts are coarser than the controller takes them to be."""
    finest, x = known.get("gains", {}).get("stroke_resolution", 0.0), f"{cylinder}.x"
    count = least_step(record[x]) if finest and x in record else 0.0
    if count > ARC.counts * finest:
        sizes = {"count": rig.shown("x", count, 3), "finest": rig.shown("x", finest, 3)}
        yield message("trial.coarse_stroke", channel=x, **sizes)


def _measures(record: Record, loop: Driven, rows: int, true: np.ndarray | None) -> dict[str, Any]:
    """Steps and tracking of a controlled cylinder, up to the row at which a limit stopped the
    trial; tracking by its sensor, as late as its samples are known to be, and, where the machine
    knows it, of the ``true`` strokes [m].
    Without a sensor the speed is the stroke's slope, and pressures are not a number."""
    prefix = f"{loop.cylinder}."
    channels = {
        name.removeprefix(prefix): record[name][:rows]
        for name in record.channels
        if name.startswith(prefix)
    }
    t, x, desired = record.t[:rows], channels["x"], channels["x_desired"]
    v = channels["v"] if "v" in channels else np.gradient(x, t)
    p_head, p_rod = (channels.get(name, np.full(rows, np.nan)) for name in ("p_head", "p_rod"))
    measures: dict[str, Any] = {"steps": []}
    for level in loop.references.levels:
        stop = min(level.stop, rows)
        if stop - level.first >= 3:
            part = slice(level.first, stop)
            before = float(loop.references.table[level.first - 1, 1]) if level.first else 0.0
            asked = channels.get("v_shaped", channels["v_desired"])[part]
            others = p_head[part], p_rod[part]
            step = step_measures(t[part], v[part], level.speed, before, others, level.share, asked)
            measures["steps"].append(asdict(step))
    # a sample is compared with what was desired then
    late = float(controller_of(loop.recipe).delay)
    measures["tracking"] = tracking_measures(t, x, np.interp(t - late, t, desired))
    if true is not None:
        measures["tracking_true"] = tracking_measures(t, true[:rows, loop.design.index], desired)
    if loop.references.last_cycle and rows == len(loop.references.table):
        first = loop.references.last_cycle
        measures["cycle"] = {"start": float(t[first]), "stop": float(t[-1])}
    measures["speed_rms_error"] = float(np.sqrt(np.mean((v - channels["v_desired"]) ** 2)))
    stroke = float(loop.design.row.stroke)
    valves = [valve for valve in loop.design.valves if valve.startswith(prefix)]
    commands = np.column_stack([record[f"{valve}.command"][:rows] for valve in valves])
    cycle = limit_cycle(t, x, desired, commands, stroke)
    measures["limit_cycle"] = None if cycle is None else asdict(cycle)
    if "function_status" in channels:
        names = ("function", "function_status", "v_desired")
        measures["functions"] = function_measures(t, *(channels[name] for name in names))
    if "limits" in channels:
        met = channels["limits"].astype(int)
        measures["limits"] = {
            name: float(np.mean(met & bit > 0)) for bit, name in LIMIT_BITS.items()
        }
    return measures
