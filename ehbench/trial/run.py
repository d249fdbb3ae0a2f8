"""Run one trial: open-loop commands or a controller, on the model or the virtual bench, stopped
safely at a limit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ehbench.codes import HOLD
from ehbench.codes import LIMITS as LIMIT_BITS
from ehbench.errors import InputError, SimulationError
from ehbench.plant.model import Model
from ehbench.plant.valves import opening_over
from ehbench.quantities import VOCABULARY
from ehbench.recipe import BenchRecipe, TrialRecipe, load_recipe, load_rig
from ehbench.record import Record
from ehbench.rig import Rig
from ehbench.rigs.bench import BenchRig
from ehbench.rigs.model import ModelRig
from ehbench.trial import controllers
from ehbench.trial.commands import command_table
from ehbench.trial.controllers import Compiled, Design, located
from ehbench.trial.loops import COMMAND, LIMITS, MARGIN, NO_LIMITS, Machine, Runner, limit_array
from ehbench.trial.measures import edge_flows, integral, step_measures, tracking_measures
from ehbench.trial.motion import References, references
from ehbench.trial.user_code import UserCode
from ehbench.units import from_si

if TYPE_CHECKING:
    from ehbench.plant.build import Maps

RUN_OUT = 0.3  # [s] logged after a stop, valves at rest
CHUNK = 1000  # ticks between two reports of progress
WISHED = ("x_desired", "v_desired", "a_desired", "j_desired")


@dataclass(frozen=True)
class Stop:
    """Why a trial stopped: which limit, on which channel, the value [SI] that reached it, its bound
    [SI] and when [s].

    ``sentence`` says so in the units of the rig file.
    """

    limit: str
    channel: str
    value: float
    bound: float
    t: float
    sentence: str


@dataclass(frozen=True)
class Facts:
    """What is to be said of a trial beside its record.

    ``stopped`` is empty, or the sentence that says which limit stopped it; ``stop`` has the same as
    numbers. ``measures`` says how well a controlled cylinder did and with which gains
    (docs/trials.md), SI; empty without a controller."""

    on: str
    rig: str
    payload: str
    posture: dict[str, str]
    seed: int
    duration: float
    samples: int
    rate: float
    stop: Stop | None = None
    warnings: tuple[str, ...] = ()
    controller: str = ""
    cylinder: str = ""
    measures: dict[str, Any] = field(default_factory=dict)

    @property
    def stopped(self) -> str:
        """Why the trial stopped, or ''."""
        return "" if self.stop is None else self.stop.sentence

    def as_json(self) -> dict[str, Any]:
        """Plain values for a JSON file."""
        return {**asdict(self), "stopped": self.stopped, "warnings": list(self.warnings)}


def run_trial(
    rig: Rig,
    recipe: TrialRecipe,
    maps: Maps | None = None,
    progress: Callable[[str, float], None] | None = None,
    *,
    gains: Path | None = None,
    allow_code: bool = False,
) -> tuple[Record, Facts]:
    """Run one trial from rest: its record and the facts about it.

    On the model the record has all that `Model.record` gives; on the virtual bench only what a
    machine measures, and the commands; under a controller also its notes. When a limit is reached
    the valves go to rest in that very tick, and RUN_OUT seconds more are logged.

    Args:
        rig: as the recipe names it.
        recipe: what to do; its ``bench`` names the bench file, without which the bench is a
            plausible one of this rig.
        maps: measured flow maps of the rig, for the model and for the controller.
        progress: told what is at work and the share done, from 0 to 1.
        gains: the run folder of the tune run that the recipe takes gains from; by default where the
            recipe points.
        allow_code: lets a controller of the user's own run.

    Raises:
        InputError: a command, posture, payload, motion, gain or bench file that does not fit the
            rig; a limit reached before the start; code that is not allowed, or raised.
        SimulationError: the numbers left the finite range.
    """
    rate = float(recipe.rate)
    closed = (
        _Closed.of(recipe, rig, maps, gains, allow_code) if recipe.controller is not None else None
    )
    count = (
        round(float(recipe.duration) * rate) + 1 if closed is None else len(closed.references.table)
    )
    if count < 2:
        raise InputError(
            "the trial is shorter than one sample",
            **recipe.at("duration"),
            hint="raise duration or rate",
        )
    t = np.arange(count) / rate
    table = command_table(recipe, rig, t, closed.valves if closed is not None else ())
    machine = _machine(rig, recipe, maps)
    posture = (
        recipe.posture if closed is None else controllers.posture_of(recipe, closed.design.cylinder)
    )
    with located(recipe, "posture"):
        sample = (
            machine.start(posture)
            if closed is None
            else machine.start(posture, low_side=closed.low_side)
        )
    run = Runner(machine, sample, t, table, limit_array(recipe.limits))
    if run.reached(0):
        reached = _stop_of(run, 0)
        where = recipe.at("limits", reached.limit)
        raise InputError(
            "the trial cannot start: " + reached.sentence,
            **where,
            hint="change the posture or the limit",
        )
    law = None if closed is None else closed.law(machine)
    stop, end = _go(run, law, progress)
    table = run.commands
    if not np.isfinite(table[:end]).all():
        raise SimulationError(
            "the controller asked for no number", hint="a gain, or a channel that it was not given"
        )
    carried = {name: table[:end, i].copy() for i, name in enumerate(machine.layout.valves)}
    meta = {
        "rig": rig.name,
        "payload": recipe.payload or "none",
        "on": machine.name,
        "seed": str(recipe.seed),
        "posture": ", ".join(f"{name} {value}" for name, value in posture.items()) or "mid-stroke",
        "title": recipe.title,
    }
    warnings: list[str] = []
    if law is not None:
        meta |= {"controller": recipe.controller.label, "cylinder": closed.design.cylinder}
        if isinstance(law, UserCode) and law.beyond:
            warnings.append(
                f"{law.label} asked for more than a driver takes in {law.beyond} of {end} ticks, and got the end of its range"
            )
    if stop is not None:
        meta["stopped"] = stop.sentence
    if isinstance(machine, ModelRig):
        record = machine.model.record(t[:end], table[:end], run.log[:end], meta)
    else:
        columns = {name: run.samples[:end, i].copy() for i, name in enumerate(machine.channels)}
        lines = {name: columns.pop(name) for name in ("p_supply", "p_tank")}
        commands = {f"{name}.command": values for name, values in carried.items()}
        record = Record(t[:end], {**columns, **commands, **lines}, meta)
    measures = {}
    if law is not None:
        notes = {name: law.telemetry[:end, i].copy() for i, name in enumerate(law.channels)}
        record = Record(record.t, {**record.channels, **notes}, record.meta)
        measures = law.used | _measures(
            record, closed, machine, end if stop is None else round(stop.t * rate) + 1
        )
        if (
            isinstance(law, Compiled)
            and law.law.warns_saturated
            and (share := measures["limits"]["saturated"]) > 0.0
        ):
            warnings.append(
                f"the valves of '{closed.design.cylinder}' were at their end in {100.0 * share:.2g} % of the ticks "
                "and gave less than the controller asked for"
            )
    facts = Facts(
        machine.name,
        rig.name,
        meta["payload"],
        posture,
        recipe.seed,
        float(t[end - 1]),
        end,
        rate,
        stop,
        tuple(warnings),
        meta.get("controller", ""),
        meta.get("cylinder", ""),
        measures,
    )
    return record, facts


def _go(
    run: Runner, law: Compiled | UserCode | None, progress: Callable[[str, float], None] | None
) -> tuple[Stop | None, int]:
    """Run to the end, or to RUN_OUT after a limit; returns the stop, if any, and how many rows
    there are.
    """
    count, rate = run.t.size, run.machine.rate
    rest = run.machine.model.rest_commands(1)[0]
    stop, at, end = None, 0, count
    if isinstance(law, UserCode):
        law.start(run.sample)
    while at < end:
        upto = min(at + CHUNK, end)
        if stop is None and isinstance(law, UserCode):
            row = -1
            for i in range(at, upto):
                law.step(i, float(run.t[i]), run.sample, run.commands[i])
                row = run.go(i, i + 1)
                if row >= 0:
                    break
        else:
            row = run.go(at, upto, law if stop is None else None)
        if not np.isfinite(run.sample).all():
            raise SimulationError(
                f"the trial left finite numbers before t = {upto / rate:.4g} s",
                hint="take a smaller step",
            )
        if row >= 0:
            stop = _stop_of(run, row)
            run.limits = np.array(NO_LIMITS)
            end = min(count, row + 1 + round(RUN_OUT * rate))
            run.commands[row:] = rest
            if law is not None:
                _let_go(law, row, end)
            upto = row
        at = upto
        if progress is not None:
            progress("", at / end)
    return stop, end


def _let_go(law: Compiled | UserCode, row: int, end: int) -> None:
    """Notes after a stop: the last estimates and the desired stroke stay, nothing is asked for any
    more.
    """
    law.telemetry[row:end] = law.telemetry[row]
    for column, name in enumerate(law.channels):
        word = name.rsplit(".", 1)[-1]
        if (
            word in WISHED[1:]
            or word in ("v_shaped", "function_status", "limits", "feedback_flow")
            or word.startswith("flow")
        ):
            law.telemetry[row:end, column] = 0.0
        elif word == "function":
            law.telemetry[row:end, column] = HOLD


@dataclass(frozen=True)
class _Closed:
    """The closed loop of a recipe before there is a machine: design model, references, where the
    off-side stands at the start.
    """

    recipe: TrialRecipe
    design: Design
    references: References
    tuning: dict[str, Any] | None
    low_side: float

    @classmethod
    def of(
        cls, recipe: TrialRecipe, rig: Rig, maps: Maps | None, gains: Path | None, allow_code: bool
    ) -> _Closed:
        controllers.refuse_code(recipe, allow_code)
        made = controllers.design(recipe, rig, maps)
        tuning = controllers.read_tuning(recipe, gains)
        low = controllers.low_pressure(recipe, rig, tuning)
        return cls(
            recipe,
            made,
            references(recipe, made, low),
            tuning,
            float(rig.supply.tank_pressure) + low,
        )

    @property
    def valves(self) -> tuple[str, ...]:
        """Valves that the controller commands by itself; a user's class may leave any of them to
        the recipe.
        """
        if self.recipe.controller.code is not None:
            return ()
        c = self.design.circuit
        return tuple(
            self.design.valves[i]
            for i in sorted({int(v) for v in c.edges.valve[c.first : c.first + c.count]})
        )

    def law(self, machine: Machine) -> Compiled | UserCode:
        table = self.references.table
        if self.recipe.controller.code is not None:
            return UserCode(self.recipe, self.design, machine.channels, machine.rate, table)
        return controllers.compiled(self.recipe, self.design, self.tuning, table, machine.rate)


def _measures(record: Record, closed: _Closed, machine: Machine, rows: int) -> dict[str, Any]:
    """Steps, tracking and energy of the controlled cylinder, up to the row at which a limit stopped
    the trial.
    """
    own, t = closed.design.cylinder, record.t[:rows]
    v, x, p_head, p_rod = (record[f"{own}.{name}"][:rows] for name in ("v", "x", "p_head", "p_rod"))
    found: dict[str, Any] = {"steps": []}
    for level in closed.references.levels:
        stop = min(level.stop, rows)
        if stop - level.first >= 3:
            part = slice(level.first, stop)
            before = float(closed.references.table[level.first - 1, 1]) if level.first else 0.0
            one = step_measures(
                t[part], v[part], level.speed, before, (p_head[part], p_rod[part]), level.share
            )
            found["steps"].append(asdict(one))
    found["tracking"] = tracking_measures(t, x, record[f"{own}.x_desired"][:rows])
    found["speed_rms_error"] = float(np.sqrt(np.mean((v - record[f"{own}.v_desired"][:rows]) ** 2)))
    force = p_head * closed.design.row.area_head - p_rod * closed.design.row.area_rod
    flow, source = _drawn(record, closed.design, machine)
    found["energy"] = {
        "pump": integral(t, record["p_supply"][:rows] * flow[:rows]),
        "cylinder_work": integral(t, force * v),
        "oil_drawn": integral(t, flow[:rows]),
        "source": source,
    }
    if f"{own}.limits" in record:
        met = record[f"{own}.limits"][:rows].astype(int)
        found["limits"] = {name: float(np.mean(met & bit > 0)) for bit, name in LIMIT_BITS.items()}
    return found


def _drawn(record: Record, design: Design, machine: Machine) -> tuple[np.ndarray, str]:
    """(flow drawn from the supply by all edges [m³/s], where it is from)."""
    plant, names = design.model.plant, design.model.layout
    total = np.zeros(record.t.size)
    own = isinstance(machine, ModelRig)
    for e, edge in enumerate(names.edges):
        row = plant.edges[e]
        ends = row.from_node, row.to_node
        if 0 not in ends:
            continue
        sign = 1.0 if ends[0] == 0 else -1.0
        if own:
            total += sign * record[f"{edge}.flow"]
            continue
        valve = int(row.valve)
        opening = opening_over(plant, valve, record.t, record[f"{names.valves[valve]}.command"])
        pressures = [_node(record, names.cylinders, node) for node in ends]
        drop = pressures[0] - pressures[1]
        flow = np.empty(drop.size)
        edge_flows(drop, opening, row, plant.maps, flow)
        total += sign * flow
    return (
        total,
        "edge flows of the model"
        if own
        else "estimated: measured pressures and commands through the design model's maps",
    )


def _node(record: Record, cylinders: tuple[str, ...], node: int) -> np.ndarray:
    if node < 2:
        return record["p_supply" if node == 0 else "p_tank"]
    return record[f"{cylinders[(node - 2) // 2]}.{'p_head' if node % 2 == 0 else 'p_rod'}"]


def _stop_of(run: Runner, row: int) -> Stop:
    which, index, entry = (int(v) for v in run.found)
    machine, bound, t = run.machine, float(run.limits[which]), float(run.t[row])
    if which == COMMAND:
        channel, value = f"{machine.layout.valves[index]}.command", float(run.commands[row, index])
    else:
        channel, value = machine.channels[entry], float(run.sample[entry])
    if which == MARGIN and value >= bound:  # then it is the far end that came too near
        bound = float(machine.model.plant.cylinders[index].stroke) - bound
    word = channel.rsplit(".", 1)[-1]
    unit = machine.model.rig.unit_of(word)
    shown, edge = (from_si(v, unit, VOCABULARY[word]) for v in (value, bound))
    sentence = f"{channel} = {shown:.4g} {unit} passed {LIMITS[which]}, which sets in at {edge:.4g} {unit}, at t = {t:.4g} s"
    return Stop(LIMITS[which], channel, value, bound, t, sentence)


def _machine(rig: Rig, recipe: TrialRecipe, maps: Maps | None) -> Machine:
    with located(recipe, "payload"):
        rig.with_payload(recipe.payload)
    if recipe.on == "model":
        return ModelRig(Model.of(rig, maps, recipe.payload), float(recipe.rate), float(recipe.step))
    if recipe.bench is None:
        return BenchRig(rig, None, recipe.payload, float(recipe.rate), seed=recipe.seed)
    bench = load_recipe(recipe.file(recipe.bench))
    if not isinstance(bench, BenchRecipe):
        raise InputError(
            "is no bench file", file=bench.path, hint='a bench file has stage = "bench"'
        )
    own = load_rig(bench.file(bench.rig))
    for what, mine, its in (
        ("cylinders", [c.name for c in rig.cylinder], [c.name for c in own.cylinder]),
        (
            "valves",
            [f"{c.name}.{v.name}" for c, v in rig.valves()],
            [f"{c.name}.{v.name}" for c, v in own.valves()],
        ),
    ):
        if mine != its:
            raise InputError(
                f"the bench of rig '{own.name}' has other {what} than rig '{rig.name}'",
                **recipe.at("bench"),
                hint=f"the bench has {', '.join(its)}",
            )
    return BenchRig(own, bench, recipe.payload, float(recipe.rate), seed=recipe.seed)
