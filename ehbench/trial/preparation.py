"""All that is known of a trial before its machine runs: what is asked of it, from where, and where
it stops."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ehbench.config.recipe import TrialRecipe
from ehbench.config.rig import Rig
from ehbench.control.functions import pack_rules
from ehbench.control.trajectory import Reference
from ehbench.machines.protocol import (
    Machine,
    carry_of,
    hidden_of,
    plays_of,
    reason_of,
    seeded_of,
    truth_of,
    unmeasured_of,
)
from ehbench.machines.registry import open_machine
from ehbench.machines.rows import LIMITS, Checks, Rows, violated
from ehbench.plant.model import Model
from ehbench.runtime.memory import MOST_STEPS, refuse_beyond, rows_of
from ehbench.trial import controllers
from ehbench.trial.checks import checks_of, limit_array
from ehbench.trial.code import refuse_code
from ehbench.trial.commands import command_table
from ehbench.trial.controllers import Compiled, Design
from ehbench.trial.coordination import Driven, Plan, as_long, joints_of, planned, tables_of
from ehbench.trial.motion import (
    MOTION,
    References,
    from_its_start,
    lasting,
    references,
    rest,
    starts_of,
)
from ehbench.trial.path import route
from ehbench.trial.user_code import UserCode
from ehbench.vocabulary import InputError, Message, message, placed

if TYPE_CHECKING:
    from ehbench.plant.build import Maps


# quantities of what limits compare, where it is not that of the channel
QUANTITY_OF = {
    "command_rate": "command_rate",
    "sample_age": "delay",
    "overrun": "delay",
    "following_error": "following_error",
    "position_mismatch": "following_error",
}
OWN_SENTENCE = (*QUANTITY_OF, "finite", "pressure_range")
PLACES = 50  # of a motion at which the supply must carry the load
RUN_OUT = 3.0  # [s] that are logged at most after a stop, valves at rest


@dataclass(frozen=True)
class Excess:
    """A limit that a quantity reached, or went beyond after a stop: limit, channel, the value [SI],
    that farthest out, and the bound [SI]."""

    limit: str
    channel: str
    value: float
    bound: float


@dataclass(frozen=True)
class Stop(Excess):
    """Why a trial stopped: the limit that was reached first, and when [s].

    ``sentence`` says so in the units of the rig file."""

    t: float
    sentence: Message


@dataclass(frozen=True)
class Aftermath:
    """What a trial did after a limit had stopped it.

    ``ramp`` [s] in which the valves went to rest; ``seconds`` [s] from the stop to the end of the
    log; ``still`` whether it then stood, None where no sound sensor says; ``beyond`` what went
    beyond a limit, by limit and channel; ``sentence`` says so in the units of the rig file."""

    ramp: float
    seconds: float
    still: bool | None
    beyond: tuple[Excess, ...]
    sentence: Message


@dataclass(frozen=True)
class Loop:
    """A closed loop before there is a machine: the cylinders that it moves, the first of which the
    trial is about, and their laws. ``notes`` are what is to be said of them before they run.

    ``laws`` are packed, one a cylinder; none for a user's class, which is loaded when its trial
    begins.
    ``low_side`` [Pa] is where the off-side chamber stands at the start. ``plan`` is what they do
    together, None of one cylinder by itself."""

    driven: tuple[Driven, ...]
    laws: tuple[Compiled, ...]
    low_side: float
    plan: Plan | None = None
    notes: tuple[str, ...] = ()

    @property
    def design(self) -> Design:
        """That of the first."""
        return self.driven[0].design

    @property
    def references(self) -> References:
        """What the first shall do."""
        return self.driven[0].references

    @property
    def valves(self) -> tuple[str, ...]:
        """Valves that built-in controllers command; a user's class may leave any to the recipe."""
        taken = []
        for item in self.driven if self.laws else ():
            valves = {int(v) for v in item.design.circuit.edges.valve[item.design.at_cylinder]}
            taken += [item.design.valves[i] for i in sorted(valves)]
        return tuple(taken)


@dataclass(frozen=True)
class Prepared:
    """A trial ready to run: all that can be known of it before the first tick.

    ``machine`` is the one that the recipe names, not started; ``t`` [s], shape (samples,);
    ``table`` the open-loop commands [V], shape (samples, valves); ``limits`` as in
    `ehbench.machines.rows`; ``posture`` where it starts; ``loop`` None for open loop; ``payloads``
    what it carries from which row on, where that changes; ``cylinders`` are the rig's rows of the
    plant; ``again`` prepares the trial of another recipe with all else; ``notes`` what is said of
    its controllers, their tuning and its loads. It may run again, and gives the same bytes."""

    recipe: TrialRecipe
    rig: Rig
    maps: Maps | None
    machine: Machine
    t: np.ndarray
    table: np.ndarray
    limits: np.ndarray
    posture: dict[str, str]
    loop: Loop | None
    payloads: dict[int, str | None]
    cylinders: np.ndarray
    again: Callable[[TrialRecipe], Prepared]
    notes: tuple[str, ...] = ()

    def standing_at(self, sample: np.ndarray) -> Prepared:
        """The same trial of a machine that stands where a sample says; where that has no stroke,
        as it is."""
        names, strokes = self.machine.channels, iter(self.machine.strokes.tolist())
        posture = dict(self.recipe.posture)
        for name, value in zip(names, sample.tolist(), strict=True):
            if name.endswith(".x"):
                x = min(max(value, 0.0), next(strokes))
                posture |= {name.removesuffix(".x"): f"{x!r} m"} if math.isfinite(value) else {}
        return self.again(self.recipe.model_copy(update={"posture": posture}))

    @property
    def duration(self) -> float:
        """Length [s] where no limit stops it."""
        return float(self.t[-1])

    def shut_at_once(self, stop: Stop, command: np.ndarray) -> np.ndarray:
        """True for the valves that go to rest without a ramp when a limit stopped the trial under a
        command [V]: those that only bring oil, so that no load is caught, and those that bring it
        to the chamber whose pressure is too high."""
        full = stop.channel if stop.limit == "pressure_max" else ""
        shut = []
        for (cylinder, valve), volts in zip(self.rig.valves(), command.tolist(), strict=True):
            edges = [(edge.sign * volts > 0.0, {edge.from_, edge.to}) for edge in valve.edge]
            fed = set().union(*(ends for is_open, ends in edges if is_open and "supply" in ends))
            drains = any("tank" in ends for _, ends in edges)
            into = full.removeprefix(f"{cylinder.name}.p_")
            shut.append(bool(fed) and not drains or into in fed)
        return np.array(shut)

    def seeded(self, seed: int) -> Prepared:
        """The same trial with other noise of its machine's sensors."""
        recipe, machine = self.recipe.model_copy(update={"seed": seed}), seeded_of(self.machine)
        assert machine is not None  # the recipe's model sees to it
        return replace(self, recipe=recipe, machine=machine(seed))

    def meta(self, machine: Machine) -> dict[str, str]:
        """The facts of a run on a machine, as far as they are known before it, as a log has
        them.
        """
        recipe = self.recipe
        meta = {
            "rig": self.rig.name,
            "payload": recipe.payload or "none",
            "on": machine.name,
            "seed": str(recipe.seed),
            "posture": ", ".join(f"{name} {value}" for name, value in self.posture.items())
            or "mid-stroke",
            "title": recipe.title,
        }
        if recipe.payload_change:
            changes = [(float(change.at), change.payload) for change in recipe.payload_change]
            meta["payload_change"] = json.dumps(changes)
        if self.loop is not None and recipe.controller is not None:
            label, cylinder = recipe.controller.label, self.loop.design.cylinder
            meta |= {"controller": label, "cylinder": cylinder}
        return meta

    @property
    def low_side(self) -> dict[str, float]:
        """Pressure [Pa] of the unloaded chambers at the start, by cylinder; those that nobody
        drives are the machine's own choice, as in the points that gains are tuned at."""
        loop = self.loop
        return {} if loop is None else {item.design.cylinder: loop.low_side for item in loop.driven}

    @property
    def telemetry(self) -> tuple[str, ...]:
        """Channels that the controllers leave, but for the notes of a user's class."""
        if self.loop is None or not self.loop.laws:
            cylinder = None if self.loop is None else self.loop.design.cylinder
            return tuple(f"{cylinder}.{name}_desired" for name in Reference._fields if cylinder)
        return tuple(name for part in self.loop.laws for name in part.channels)

    def law(self, machine: Machine) -> tuple[Compiled, ...] | tuple[UserCode]:
        """The controllers at their beginning, for one run on a machine; none for open loop.

        Raises:
            InputError: a user's class that cannot be loaded, or raised.
        """
        if self.loop is None:
            return ()
        design, table, plays = self.loop.design, self.loop.references.table, plays_of(machine)
        if not self.loop.laws:
            return (UserCode(self.recipe, design, machine.channels, machine.rate, table),)
        return tuple(law.afresh(plays) for law in self.loop.laws)

    def rows(self, machine: Machine, sample: np.ndarray, count: int | None = None) -> Rows:
        """Rows as they are before the first tick; arguments as in `first_rows`, ``sample`` is the
        present one."""
        known, t = truth_of(machine) or hidden_of(machine), self.t[:count]
        return Rows(
            t,
            self.table[:count].copy(),
            np.empty((t.size, sample.size)),
            np.empty((t.size, 0 if known is None else known.width)),
            sample,
            self.limits.copy(),
            machine.strokes,
            self.checks(machine, t.size),
            np.zeros(3, dtype=np.int64),
            np.zeros(2),
        )

    def first_rows(self, machine: Machine, count: int | None = None) -> Rows:
        """The rows before the first tick, the machine at rest.

        Args:
            machine: is started.
            count: how many of the trial's rows; by default all.

        Raises:
            InputError: a posture that the machine cannot take; a limit reached before the start.
        """
        recipe = self.recipe
        with placed(recipe.at("posture")):
            sample = machine.start(self.posture, self.low_side)
        rows = self.rows(machine, sample, count)
        if violated(rows, 0):
            reached = self.reached(machine, rows, 0)
            problem = message("trial.start_limit", stop=reached.sentence)
            raise InputError(problem, **recipe.at("limits", reached.limit))
        for channel, error in recipe.first_pressure_error.items():
            sample[machine.channels.index(channel)] += float(error)
        return rows

    def checks(self, machine: Machine, rows: int) -> Checks:
        """What every sample is compared with, from the first on."""
        loop, absent = self.loop, unmeasured_of(machine)
        measured = np.array([name not in absent for name in machine.channels])
        driven, laws = ((), ()) if loop is None else (loop.driven, loop.laws)
        return checks_of(self.recipe.limits, measured, self.cylinders, rows, driven, laws)

    def reached(self, machine: Machine, rows: Rows, row: int) -> Stop:
        """The limit that `violated` met in a row."""
        which, index, entry = (int(v) for v in rows.reached)
        (value, bound), t = rows.by.tolist(), float(rows.t[row])
        limit, word = LIMITS[which], LIMITS[which]
        if limit == "machine":
            reason = reason_of(machine, int(value))
            sentence = message("trial.stop_machine", machine=machine.name, reason=reason, t=t)
            return Stop(limit, "", value, bound, t, sentence)
        channel = machine.channels[entry] if entry >= 0 else ""
        if index >= 0 and entry < 0:
            channel = f"{machine.commands.names[index]}.command"
        if limit in QUANTITY_OF:
            word = QUANTITY_OF[limit]
        elif channel:
            word = channel.rsplit(".", 1)[-1]
        shown, edge = (self.rig.shown(word, number) for number in (value, bound))
        fields = {"channel": channel, "value": shown, "bound": edge, "limit": limit, "t": t}
        if limit == "monitor":
            sentence = message("trial.stop_sensor" if entry >= 0 else "trial.stop_valve", **fields)
        elif limit in OWN_SENTENCE:
            sentence = message(f"trial.stop_{limit}", **fields)
        else:
            sentence = message("trial.limit_passed", **fields)
        return Stop(limit, channel, value, bound, t, sentence)

    def aftermath(self, machine: Machine, rows: Rows, span: slice, still: bool | None) -> Aftermath:
        """What the rows ``span`` after a stop say; ``still`` whether it stood at their end."""
        ramp, beyond, sentences = float(self.recipe.limits.ramp), [], ""
        samples = rows.samples[span]
        bounds: dict[str, float] = dict(zip(LIMITS, self.limits.tolist(), strict=True))
        strokes, margin = iter(rows.strokes.tolist()), bounds["stroke_margin"]
        for column, channel in enumerate(machine.channels):
            word, ends = channel.rsplit(".", 1)[-1], []  # limit, value, bound: the least or largest
            values = samples[:, column]
            if word in ("p_head", "p_rod"):
                ends.append(("pressure_max", values.max(), bounds["pressure_max"], False))
                ends.append(("pressure_min", values.min(), bounds["pressure_min"], True))
            elif word == "x":
                ends.append(("stroke_margin", values.min(), margin, True))
                ends.append(("stroke_margin", values.max(), next(strokes) - margin, False))
            elif word == "v":
                fastest = values[np.argmax(np.abs(values))]
                ends.append(("speed_max", fastest, bounds["speed_max"], False))
            for limit, value, bound, is_least in ends:
                if value < bound if is_least else abs(value) > bound:
                    beyond.append(Excess(limit, channel, float(value), bound))
                    shown, edge = (self.rig.shown(word, float(x)) for x in (value, bound))
                    fields = {"channel": channel, "value": shown, "bound": edge, "limit": limit}
                    sentences += message("trial.beyond_limit", **fields)
        seconds = float(rows.t[span.stop - 1] - rows.t[span.start])
        stood = {True: "it stood still", False: "it still moved"}
        sentence = message(
            "trial.after_stop",
            shut=f"within {ramp:.3g} s" if ramp else "at once",
            seconds=seconds,
            stood="no sound sensor says whether it stands" if still is None else stood[still],
            beyond=sentences,
        )
        return Aftermath(ramp, seconds, still, tuple(beyond), sentence)


def prepare(
    recipe: TrialRecipe,
    rig: Rig,
    maps: Maps | None = None,
    gains: Path | Mapping[str, Any] | None = None,
    allow_code: bool = False,
    standing: bool = False,
) -> Prepared:
    """Take in what a trial needs, without a tick and without a user's code.

    Args:
        recipe, rig: what to do, and the rig as the recipe names it.
        maps: measured flow maps of the rig, for the model and for the controller.
        gains: the run folder of the tune run that the recipe takes gains from, or what it says; by
            default where the recipe points.
        allow_code: allows a user's controller to run.
        standing: leave the desired motion out, where its speeds cannot be known.

    Raises:
        InputError: a command, posture, payload, motion, gain or bench file that does not fit the
            rig; on a machine that stands at its start at once, a limit reached there; code that is
            not allowed.
    """
    again = partial(
        prepare, rig=rig, maps=maps, gains=gains, allow_code=allow_code, standing=standing
    )
    with placed(recipe.at("supply")):
        rig = rig.with_supply(recipe.supply.load_sensing, recipe.supply.low_rail)
    loop, posture, chosen = None, recipe.posture, recipe.controller
    # of a controller of a set
    where = chosen.where if chosen is not None and getattr(chosen, "dynamics", None) else ()
    with placed(recipe.at(*where, "dynamics")):
        rig = rig.with_dynamics(recipe.dynamics)
    if chosen is not None:
        refuse_code(recipe, allow_code)
        loop = _loop(recipe, rig, maps, gains, standing)
        posture = loop.driven[0].recipe.posture
    t = np.arange(_length(recipe, rig, loop)) / float(recipe.rate)
    table = command_table(recipe, rig, t, () if loop is None else loop.valves)
    machine = open_machine(recipe, rig, maps)
    known = [name for name in machine.channels if name.rsplit(".", 1)[-1].startswith("p_")]
    for name in recipe.first_pressure_error:
        if name not in known:
            problem = message("trial.unknown_pressure", name=name, known=", ".join(known))
            raise InputError(problem, **recipe.at("first_pressure_error", name))
    payloads = _payloads(recipe, machine, t)
    model = Model.of(rig, maps) if loop is None else loop.design.model
    limits = limit_array(recipe.limits, rig, t[1])
    given = recipe, rig, maps, machine, t, table, limits, posture, loop
    prepared = Prepared(*given, payloads, model.plant.cylinders, again)
    if truth_of(machine) is not None:
        prepared.first_rows(machine, 1)
    else:
        with placed(recipe.at("posture")):
            machine.check_posture(posture)
    return replace(prepared, notes=_notes(prepared, model))


def _notes(prepared: Prepared, model: Model) -> tuple[str, ...]:
    """What is said of a trial's controllers, of cylinders far off the start of their motion, and
    of loads on its way that the supply cannot carry."""
    loop, loads = prepared.loop, (prepared.recipe.payload, *prepared.payloads.values())
    q = model.posture(prepared.posture)[None] if loop is None else joints_of(loop.driven)[0]
    notes = () if loop is None else loop.notes
    for item in () if loop is None else loop.driven:
        motion = item.references
        if motion.way > MOTION.speed_up:  # which takes as long as it takes to full speed
            apart = item.design.rig.shown("x", abs(motion.apart))
            given = {"cylinder": item.cylinder, "apart": apart, "seconds": motion.way}
            notes += (message("trial.off_start", **given),)
    for load in dict.fromkeys(loads):
        loaded = Model.of(prepared.rig, prepared.maps, load)
        notes += tuple(loaded.weak_supply(load, q[:: max(1, len(q) // PLACES)]))
    return notes


def _payloads(recipe: TrialRecipe, machine: Machine, t: np.ndarray) -> dict[int, str | None]:
    """What the machine carries from which row on, where the recipe changes it.

    Raises:
        InputError: a time behind the end, no such payload, or a machine that cannot change it.
    """
    results: dict[int, str | None] = {}
    for i, change in enumerate(recipe.payload_change):
        carry, row = carry_of(machine), int(np.searchsorted(t, float(change.at) - 1e-9))
        if row >= t.size:
            problem = message("trial.late_payload", end=float(t[-1]))
            raise InputError(problem, **recipe.at("payload_change", i, "at"))
        if carry is None:
            problem = message("trial.payload_by_hand", machine=machine.name)
            raise InputError(problem, **recipe.at("payload_change"))
        results[row] = None if change.payload == "none" else change.payload
        with placed(recipe.at("payload_change", i, "payload")):
            carry(results[row])
    return results


# [numbers] of a row beside those of each cylinder, valve and edge, in all copies of it
_ROW, _EACH = 100, 30


def _length(recipe: TrialRecipe, rig: Rig, loop: Loop | None) -> int:
    """The rows of a trial.

    Raises:
        InputError: fewer than two; more than any memory holds, or that would compute for hours."""
    tick, after = 1.0 / float(recipe.rate), 0
    parts = len(rig.cylinder) + sum(1 for _ in rig.valves()) + sum(1 for _ in rig.edges())
    waves = sum(entry.lines for entry in recipe.command if entry.kind == "multisine")
    if recipe.limits != type(recipe.limits)():
        after = round((float(recipe.limits.ramp) + RUN_OUT) / tick)
    with placed(recipe.at("duration")):
        if loop is not None:
            count = len(loop.references.table)
        else:
            assert recipe.duration is not None  # the recipe's model sees to it
            count = rows_of(float(recipe.duration), float(recipe.rate)) + 1
        if count < 2:
            raise InputError(message("trial.too_short"))
        needed = 8.0 * (count + after) * (_ROW + _EACH * parts + 3 * waves)
        refuse_beyond(needed, message("trial.trial_of", count=count + after))
        step = tick if recipe.step == "auto" else min(tick, float(recipe.step))
        steps = (count + after) * tick / step
        if steps > MOST_STEPS:
            fields = {"steps": steps, "step": step, "maximum": MOST_STEPS}
            raise InputError(message("trial.too_many_steps", **fields))
    return count


def _loop(
    recipe: TrialRecipe,
    rig: Rig,
    maps: Maps | None,
    gains: Path | Mapping[str, Any] | None,
    standing: bool,
) -> Loop:
    model, tables = Model.of(rig, maps), None  # one for all: nobody writes into it
    with placed(recipe.at("posture")):
        model.posture(recipe.posture)
    if recipe.motion is not None and recipe.motion.kind == "path":
        starts, tables = route(recipe, model)
    else:
        starts = starts_of(recipe, rig)
    singles = recipe.singles(starts)
    if isinstance(gains, Mapping):
        tuning = dict(gains)
    else:
        tuning = controllers.read_tuning(recipe, gains)
    _refuse_misfit(recipe, singles, tuning)
    low = controllers.low_pressure(singles[0], rig, tuning)
    level = float(rig.supply.tank_pressure) + low
    notes = controllers.not_as_tuned(recipe, rig, tuning)
    designs = [controllers.design(single, rig, maps, model) for single in singles]
    notes += tuple(text for item in designs for text in model.creeping(item.cylinder))
    if tables is None and len(singles) == 1:
        motion = rest(designs[0]) if standing else references(singles[0], designs[0], low)
        driven = (Driven(singles[0], designs[0], motion),)
        return Loop(driven, _over(_laws(recipe, driven, tuning), driven), level, notes=notes)
    motions = []
    for single, design in zip(singles, designs, strict=True):
        # it may run slower than it is desired: its length is the recipe's only then
        operated = single.motion is not None and single.motion.kind == "operator"
        desired = single.model_copy(update={} if operated else {"duration": None})
        if standing:
            motions.append(rest(design))
        elif tables is None:
            motions.append(references(desired, design, low))
        else:
            motions.append(from_its_start(single, References(tables[design.cylinder]), design))
    driven = tuple(Driven(*item) for item in zip(singles, designs, as_long(motions), strict=True))
    laws = _laws(recipe, driven, tuning)
    supply = float(rig.supply.pressure)  # of a user's class, whose rules are not known
    rules = [law.rules for law in laws]
    rules = rules or [pack_rules(item.design.circuit.area_rod, supply) for item in driven]
    share, plan = recipe.motion is not None and recipe.motion.share_flow, None
    if all(item.references.lever is None for item in driven):  # no operator moves them
        driven, plan = planned(driven, rules, level, share)
    driven = tuple(
        replace(item, references=lasting(item.recipe, item.design, item.references))
        for item in driven
    )
    return Loop(driven, _over(laws, driven), level, plan, notes)


def _refuse_misfit(
    recipe: TrialRecipe, singles: Sequence[TrialRecipe], tuning: Mapping[str, Any] | None
) -> None:
    """Refuse a class for several cylinders, a law or tuned gains of one that does not move."""
    chosen = recipe.controller
    names = [single.motion.cylinder for single in singles if single.motion is not None]
    if chosen is None or len(singles) == 1 and not chosen.cylinders:
        return
    moved = ", ".join(name for name in names if name)
    if chosen.code is not None:
        problem = message("trial.class_moves_one", code=chosen.code, count=len(singles))
        raise InputError(problem, **recipe.at(*chosen.where, "class"))
    for name in chosen.cylinders:
        if name not in names:
            problem = message("trial.law_without_motion", cylinder=name, moved=moved)
            raise InputError(problem, **recipe.at(*chosen.where, "cylinders", name))
    if tuning is not None and tuning.get("cylinder") not in names:
        tuned = tuning.get("cylinder")
        problem = message("trial.gains_without_motion", cylinder=tuned, moved=moved)
        raise InputError(problem, **recipe.at(*chosen.where, "gains"))


def _laws(
    recipe: TrialRecipe, driven: Sequence[Driven], tuning: Mapping[str, Any] | None
) -> tuple[Compiled, ...]:
    """The built-in law of each cylinder, over its own motion; none for a user's class."""
    if recipe.controller is None or recipe.controller.code is not None:
        return ()
    built = []
    for item in driven:
        tuned_for = None if tuning is None else tuning.get("cylinder")
        known = tuning if len(driven) == 1 or tuned_for == item.cylinder else None
        table, rate = item.references.table, float(recipe.rate)
        built.append(controllers.compiled(item.recipe, item.design, known, table, rate))
    return tuple(built)


def _over(laws: tuple[Compiled, ...], driven: Sequence[Driven]) -> tuple[Compiled, ...]:
    """The laws over what their cylinders shall do, with what each uses of the others' motions."""
    return tuple(
        replace(law, references=table) for law, table in zip(laws, tables_of(driven), strict=False)
    )
