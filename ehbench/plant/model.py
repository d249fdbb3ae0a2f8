"""A rig ready to simulate, and its simulation from rest or along a recording."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations
from typing import NamedTuple, Self

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import BlockAverages, Record
from ehbench.parts.cylinder import joint_of, joint_range_of, linkage_arrays, linkage_of
from ehbench.parts.load import force_on
from ehbench.parts.supply import sensed
from ehbench.parts.valve import valve_settle
from ehbench.parts.valve.delay import line_of
from ehbench.physics.arm import SLIDE, gravity_torque, work_size
from ehbench.plant.build import Kept, Maps, Plant, build, links_of
from ehbench.plant.gauges import gauged
from ehbench.plant.integrate import STEP, run
from ehbench.plant.layout import SIDES, Layout, layout
from ehbench.plant.paced import AUTO, Step, pace_of, run_paced
from ehbench.plant.rest import CREEPS, carrying, creep, resting
from ehbench.plant.ties import late_of, supplied, tied_words, ties_of
from ehbench.plant.trim import LowSide, carry, settle_parts, start_key
from ehbench.plant.valves import acting_commands
from ehbench.signals.series import first_of
from ehbench.vocabulary import VOCABULARY, InputError, LogError, Message, SimulationError, message
from ehbench.vocabulary.fields import read_value

FREE = np.zeros(0, dtype=np.int64)  # no mesh: steps are chosen
# what of a recording tells where it starts
PLACES = ("q", "x")
TELLS = (*PLACES, "p_supply", *(f"p{line}_{side}" for line in ("", "_line") for side in SIDES))
MOVED = 0.005  # share of a driver's range by which a command must change to be more than noise


class Start(NamedTuple):
    """Where a replay starts: the state, set and tank pressure [Pa], None for the rig's."""

    y: np.ndarray
    supply: float | None = None
    tank: float | None = None


Seen = Mapping[str, float]  # what a recording tells of a machine [SI], by channel


def seen_of(record: Record, rest: int) -> Seen:
    """What the first ``rest`` samples show [SI]: mean pressures, places by `first_of`."""
    return {
        channel: first_of(y, rest) if word in PLACES else float(np.mean(y[:rest]))
        for channel, y in record.channels.items()
        if (word := channel.rpartition(".")[2]) in TELLS
    }


def finite(log: np.ndarray, tick: float) -> np.ndarray:
    """A log table as it is.

    Raises:
        SimulationError: the state stopped being finite; says when."""
    if not np.isfinite(log[-1]).all():
        bad = int(np.argmin(np.isfinite(log).all(axis=1)))
        raise SimulationError(message("plant.not_finite", t=bad * tick))
    return log


@dataclass(frozen=True)
class Model:
    """A rig ready to simulate: its numbers, compiled form and names, and the rig without
    payload."""

    rig: Rig
    plant: Plant
    layout: Layout
    bare: Rig

    @classmethod
    def of(
        cls,
        rig: Rig,
        maps: Maps | None = None,
        payload: str | None = None,
        shared: Kept | None = None,
    ) -> Self:
        """The model of a rig carrying ``payload``, its edges on measured ``maps`` where given; what
        it has in common with others of the same rig, but for its numbers, may be ``shared``.

        Raises:
            InputError: no such payload, or an edge without its map."""
        shared = shared or Kept()
        body = shared.of(Rig.loaded, [rig.mechanism, rig.payload, payload], rig, payload)
        loaded = rig if payload is None else rig.model_copy(update={"mechanism": body})
        names = shared.of(layout, [], loaded)
        return cls(loaded, build(loaded, names, maps, shared), names, rig)

    def start_key(self, moves: bool) -> Hashable:
        """All that its start along a recording depends on (`trim.start_key`)."""
        if moves not in self._keys:
            self._keys[moves] = start_key(self.plant, moves)
        return self._keys[moves]

    @cached_property
    def _keys(self) -> dict[bool, Hashable]:
        return {}

    def starts(self, number: str) -> bool:
        """Whether a replay begins with a number of an initial state; an FMU takes some only."""
        return True

    def shows(self, channel: str) -> bool:
        """Whether a replay may have a channel; of an FMU those alone that it gives."""
        return True

    def links(self, payload: str | None) -> np.recarray:
        """The links (or the slide) of the plant while they carry another payload.

        Raises:
            InputError: no such payload."""
        return links_of(self.bare.with_payload(payload))

    def stroke_range(self, index: int) -> tuple[float, float]:
        """Joint angle [rad] (or position [m]) at zero and at full stroke of cylinder ``index``."""
        return joint_range_of(self.plant.cylinders[index])

    def posture(self, required: Mapping[str, str | float] | None) -> np.ndarray:
        """Joint coordinates [rad or m], shape (n,), from postures by cylinder or joint name.

        A number or text with an angle is a joint angle, a text with a length a stroke; what is not
        named stands at mid-stroke.

        Raises:
            InputError: unknown name, or a posture outside the stroke; says what the stroke allows.
        """
        plant, names = self.plant, self.layout
        q = np.zeros(len(names.joints))
        for row in plant.cylinders:
            q[row.joint] = joint_of(row, 0.5 * row.stroke)
        if required is not None and not isinstance(required, Mapping):
            example = f'{{"{names.cylinders[0]}": "120 mm"}}'
            raise InputError(message("plant.no_posture", given=repr(required), example=example))
        for name, value in (required or {}).items():
            if name in names.cylinders:
                index = names.cylinders.index(name)
                joint = int(plant.cylinders[index].joint)
            elif name in names.joints:
                joint = names.joints.index(name)
                index = next(iter(np.flatnonzero(plant.cylinders.joint == joint).tolist()), -1)
            else:
                known = ", ".join(names.cylinders)
                raise InputError(message("plant.posture_of_nothing", name=name, known=known))
            given = isinstance(value, str)
            q[joint] = self._coordinate(index, name, value) if given else float(value)
            if index < 0:
                continue
            low, high = sorted(joint_range_of(plant.cylinders[index]))
            if not low - 1e-9 <= q[joint] <= high + 1e-9:
                word, decimals = ("x", 1) if plant.kind == SLIDE else ("q", 2)
                ends = (low, high, q[joint])
                first, last, at = (self.rig.text(word, number, decimals) for number in ends)
                fields = {"first": first.partition(" ")[0], "last": last, "value": at}
                raise InputError(message("plant.outside_stroke", name=name, **fields))
        return q

    def _coordinate(self, index: int, name: str, text: str) -> float:
        """A joint coordinate from a text: an angle, or a length that is a stroke."""
        try:
            return float(read_value(text, VOCABULARY["x" if self.plant.kind == SLIDE else "q"]))
        except InputError:
            row = self.plant.cylinders[index]
            stroke = float(read_value(text, VOCABULARY["x"]))
            if not 0 <= stroke <= row.stroke:
                ends = {"first": "0", "last": self.rig.text("x", row.stroke, 1)}
                refusal = message("plant.outside_stroke", name=name, value=text, **ends)
                raise InputError(refusal) from None
            return float(joint_of(row, stroke))

    def carrying_forces(self, q: np.ndarray, command: np.ndarray | None = None) -> np.ndarray:
        """The forces of the pistons [N], extension positive, that carry the loads at rest at joint
        coordinates ``q``, shape (cylinders,).

        Args:
            command: a row of commands and forces to play [N], by default none of these.

        Raises:
            SimulationError: a cylinder has no lever there, so no pressure holds the load."""
        plant, names = self.plant, self.layout
        torque = np.empty(len(names.joints))
        gravity_torque(
            plant.kind, plant.links, plant.gravity, q, torque, np.empty(work_size(torque.size))
        )
        played = np.zeros(len(names.valves) + len(names.played)) if command is None else command
        forces = np.empty(len(names.cylinders))
        for index, row in enumerate(plant.cylinders):
            x, lever, _ = linkage_of(row, q[row.joint])
            if abs(lever) < 1e-6:
                raise SimulationError(message("plant.no_lever", cylinder=names.cylinders[index]))
            forces[index] = torque[row.joint] / lever
            if plant.forces.shape[0]:
                forces[index] -= force_on(index, x, 0.0, played, plant)
        return forces

    def trim(
        self, q: np.ndarray, low_side: LowSide = None, command: np.ndarray | None = None
    ) -> np.ndarray:
        """The state at rest at joint coordinates ``q``: valves shut, supply at its set pressure,
        loads carried.

        The chamber that the load does not press on stands at ``low_side`` [Pa], of all cylinders or
        by name of some, by default where `ehbench.plant.rest.resting` has it. Forces that are
        played are those of a row of commands, by default none.

        Raises:
            SimulationError: a cylinder has no lever there, so no pressure holds the load.
            InputError: ``low_side`` is no pressure."""
        plant, names = self.plant, self.layout
        y = np.zeros(names.states)
        y[: len(names.joints)] = q
        forces = self.carrying_forces(q, command)
        for index, (row, force) in enumerate(zip(plant.cylinders, forces, strict=True)):
            name = names.cylinders[index]
            low = low_side.get(name) if isinstance(low_side, Mapping) else low_side
            if low is not None:
                read_value(f"{low} Pa", VOCABULARY["p_head"])  # refuses no pressure
            fixed = resting(plant, row, force) if low is None else carrying(row, force, low)
            y[names.state("p_head", index)], y[names.state("p_rod", index)] = fixed
        for valve, (_, item) in zip(plant.valves, self.rig.valves(), strict=True):
            valve_settle(valve, item.rest, plant, y)
        y[plant.at.supply] = sensed(plant.tank_pressure, plant.supply)
        settle_parts(plant, y)
        return y

    def weak_supply(self, load: str | None, postures: np.ndarray) -> Iterator[Message]:
        """Notes on cylinders without a pump whose load at rest is more than their areas under the
        supply's pressure give in one of ``postures``, each in its worst.

        Args:
            load: name of the payload that it carries.
            postures: joint coordinates [rad or m], shape (postures, joints)."""
        table, names = self.plant.cylinders, self.layout
        supply, tank = float(self.plant.supply.pressure), self.plant.tank_pressure
        forces = np.array([self.carrying_forces(q) for q in postures])
        for index, (row, force) in enumerate(zip(table, forces.T, strict=True)):
            out, back = (
                supply * a - tank * b for a, b in permutations((row.area_head, row.area_rod))
            )
            limit = np.where(force > 0.0, out, back)
            worst = int(np.argmax(np.abs(force) - limit))
            if self.rig.cylinder[index].pump is None and abs(force[worst]) > limit[worst]:
                places = [linkage_of(each, postures[worst, each.joint])[0] for each in table]
                at = (f"{n} {self.rig.shown('x', x, 3)}" for n, x in zip(names.cylinders, places))
                sizes = {"need": abs(force[worst]), "limit": limit[worst]}
                fields = {key: self.rig.shown("force", size, 3) for key, size in sizes.items()}
                fields |= {"cylinder": names.cylinders[index], "at": ", ".join(at)}
                fields["load"] = load or "no payload"
                yield message("plant.weak_supply", **fields)

    def creep(self, index: int, state: np.ndarray) -> float:
        """Speed [m/s] of a cylinder, out positive, at a state of `trim` while its valves are at
        rest."""
        head, rod = (float(state[self.layout.state(name, index)]) for name in ("p_head", "p_rod"))
        return float(creep(self.plant, self.plant.cylinders[index], head, rod))

    def creeping(self, name: str) -> list[str]:
        """A sentence where valves at rest do not hold a cylinder, at mid-stroke."""
        index = self.layout.cylinders.index(name)
        speed = self.creep(index, self.trim(self.posture(None)))
        if abs(speed) < CREEPS:
            return []
        way = "out" if speed > 0.0 else "in"
        shown = self.rig.shown("v", abs(speed), 2)
        return [message("plant.creeps", cylinder=name, way=way, speed=shown)]

    def rest_commands(self, samples: int) -> np.ndarray:
        """Commands [V], shape (samples, valves + played), with valves at rest and no force [N]."""
        rest = [valve.rest for _, valve in self.rig.valves()]
        return np.tile([*rest, *(0.0 for _ in self.layout.played)], (samples, 1))

    def commands_of(self, record: Record) -> np.ndarray:
        """A recording's commands [V] and forces to play [N], shape (samples, valves + played);
        valves that it lacks stay at rest.

        Raises:
            LogError: it lacks a force."""
        rest = [
            (f"{name}.command", float(valve.rest))
            for name, (_, valve) in zip(self.layout.valves, self.rig.valves(), strict=True)
        ]
        return record.table((*rest, *((channel, None) for channel in self.layout.played)))

    def played(self, table: np.ndarray) -> np.ndarray:
        """A table of `commands_of` in which forces, readings on straight lines, have their mean
        until the next sample: held, they would come half a sample late, which undamps a stop."""
        forces = table[:, len(self.layout.valves) :]
        forces[:-1] = 0.5 * (forces[:-1] + forces[1:])
        return table

    def rest_samples(self, commands: np.ndarray) -> int:
        """Samples before a command [V], shape (samples, valves or more), changes; at least one."""
        commands = commands[:, : len(self.layout.valves)]
        span = MOVED * (self.plant.valves.highest - self.plant.valves.lowest)
        moved = np.flatnonzero(np.any(np.abs(commands - commands[0]) > span, axis=1))
        return max(1, int(moved[0]) if moved.size else commands.shape[0])

    def run(
        self, y: np.ndarray, commands: np.ndarray, tick: float = 1e-3, step: Step = STEP
    ) -> np.ndarray:
        """Integrate from state ``y`` (left as it is) through ``commands``; returns the log table of
        `ehbench.plant.integrate.run`.

        Args:
            y: state at the first sample.
            commands: [V], shape (samples, valves + played); row i acts from sample i on.
            tick: time between samples [s].
            step: of the integration [s], or ``"auto"``: chosen by the guard (see
                `ehbench.plant.paced`).

        Raises:
            SimulationError: the state stopped being finite; says when."""
        if step == AUTO:
            return self.paced(y, commands, tick)[0]
        log = np.empty((commands.shape[0], y.shape[0] + self.plant.edges.shape[0] + 1))
        table = np.ascontiguousarray(commands, dtype=float)
        line = line_of(self.plant, tick, table.shape[1])
        run(y.copy(), table, self.plant, line, max(1, round(tick / step)), log)
        return finite(log, tick)

    def paced(
        self,
        y: np.ndarray,
        commands: np.ndarray,
        tick: float = 1e-3,
        mesh: np.ndarray = FREE,
        flows: bool = True,
        slack: float = 1.0,
        each: int = 1,
    ) -> tuple[np.ndarray, np.ndarray]:
        """(the log table of `run` with ``step = "auto"``, the steps that were chosen).

        Args:
            mesh: the steps of another run, to be taken again, so that no choice of steps is in what
                the two differ by.
            flows: whether the table has edge and pump flows; the states alone take less time.
            slack: how many times as much as by default a step may miss the state by; 100 is good to
                some 1e-4 of a channel's range, 1000 to 1e-3.
            each: samples of which a row is the mean, without flows if more than one; those at the
                end that fill no row are left out. Of valves with an error, which are taken for a
                cubic within a step.

        Raises:
            SimulationError: as `run`."""
        extra = self.plant.edges.shape[0] + 1 if flows else 0
        log = np.zeros((commands.shape[0] // each, y.shape[0] + extra))
        table = np.ascontiguousarray(commands, dtype=float)
        line = line_of(self.plant, tick, table.shape[1])
        pace = pace_of(self.plant, self.layout, tick)
        pace = pace._replace(weights=1.0 / slack * pace.weights)
        steps, count = run_paced(y.copy(), table, self.plant, line, pace, mesh, each, log)
        return finite(log, each * tick), steps[:count].copy()

    def start_of(self, record: Record, rest: int, seen: Seen | None = None) -> np.ndarray:
        """The state at the first sample of a recording, from its first ``rest`` samples: pressures
        by their mean, places as `first_of` has them. What `seen_of` gives may be handed in.

        Joint angles (or strokes), chamber and supply pressures are the recording's where it has
        them, else those of `trim`. The two pressures of a cylinder are moved, as little as possible
        together, until they carry the load exactly: friction and sensor offsets would otherwise
        start the simulation with a jolt that the machine did not make. Rates are zero.

        Raises:
            InputError: a posture outside the stroke."""
        seen = seen_of(record, rest) if seen is None else seen
        command = self.commands_of(record)[:rest].mean(axis=0) if self.layout.played else None
        y = self.posed(seen, command)
        for index, name in enumerate(self.layout.cylinders):
            head, rod = (self.layout.state(f"p_{side}", index) for side in SIDES)
            measured = [
                seen.get(f"{name}.p_{side}", seen.get(f"{name}.p_line_{side}")) for side in SIDES
            ]
            if "qd" in tied_words(record) and None not in measured:
                y[head], y[rod] = measured  # no load is needed for a motion that is given
                continue
            y[head], y[rod] = carry(self.plant.cylinders[index], (y[head], y[rod]), measured)
        settle_parts(self.plant, y)
        for valve, name in zip(self.plant.valves, self.layout.valves, strict=True):
            if f"{name}.command" in record:
                valve_settle(valve, float(record[f"{name}.command"][0]), self.plant, y)
        return y

    def posed(self, seen: Mapping[str, float], command: np.ndarray | None = None) -> np.ndarray:
        """The state at rest in the posture and at the supply pressure that are seen [SI], by
        channel; chamber pressures and what is not seen are those of `trim`, which takes
        ``command``.

        Raises:
            InputError: a posture outside the stroke."""
        plant, names = self.plant, self.layout
        required: dict[str, str | float] = {}
        for index, name in enumerate(names.cylinders):
            angle, stroke = seen.get(f"{name}.q"), seen.get(f"{name}.x")
            if angle is not None:
                low, high = sorted(self.stroke_range(index))
                slack = 0.01 * (high - low)
                near = low - slack <= angle <= high + slack
                required[name] = min(max(angle, low), high) if near else angle
            elif stroke is not None:
                row = plant.cylinders[index]
                required[name] = float(joint_of(row, min(max(stroke, 0.0), float(row.stroke))))
        for joint in names.joints:
            angle = seen.get(f"{joint}.q")
            if joint not in required and angle is not None:
                required[joint] = angle
        y = self.trim(self.posture(required), None, command)
        y[plant.at.supply] = seen.get("p_supply", y[plant.at.supply])
        return y

    def rest_start(
        self, record: Record, rest: int | None = None, seen: Seen | None = None
    ) -> Start:
        """Where a recording starts that begins at rest: `start_of`, and the means of ``p_supply``
        and ``p_tank`` over its first ``rest`` samples, found from the commands by default.

        Args:
            seen: what `seen_of` gives of these samples.

        Raises:
            InputError: a posture outside the stroke."""
        rest = self.rest_samples(self.commands_of(record)) if rest is None else rest
        supply, tank = (
            float(np.mean(record[channel][:rest])) if channel in record else None
            for channel in ("p_supply", "p_tank")
        )
        model = replace(self, plant=self.plant.at_pressures(supply, tank))
        return Start(model.start_of(record, rest, seen), supply, tank)

    def replay(self, record: Record, step: Step = STEP, start: Start | None = None) -> Record:
        """Simulate what a recording's commands do, from the recording's own start.

        Commands of valves that the recording lacks stay at rest; each recorded command acts from
        its sample on.

        Args:
            record: evenly sampled.
            step: integration step [s], or ``"auto"`` as `run` takes it.
            start: `rest_start` by default.

        Raises:
            LogError: uneven time.
            SimulationError: the numbers left the finite range."""
        start = start or self.rest_start(record)
        model, table, y = self.along(record, start)
        log = model.run(y, table, record.sample_time, step)
        return self.replayed(record, table, log, start)

    def replay_paced(
        self,
        record: Record,
        start: Start,
        mesh: np.ndarray = FREE,
        slack: float = 1.0,
        means: BlockAverages | None = None,
    ) -> tuple[Record, np.ndarray]:
        """(`replay` with ``step = "auto"`` from a start, without flows; the steps that were
        chosen), ``mesh`` and ``slack`` as `paced` takes them; where ``means`` of the recording are
        given, such means of the replay, but for commands and openings.

        Raises:
            LogError, SimulationError: as `replay`."""
        model, table, y = self.along(record, start)
        each = 1 if means is None else means.each
        log, mesh = model.paced(y, table, record.sample_time, mesh, False, slack, each)
        return self.replayed(record, table, log, start, means), mesh

    def replayed(
        self,
        record: Record,
        commands: np.ndarray,
        log: np.ndarray,
        start: Start,
        means: BlockAverages | None = None,
    ) -> Record:
        """The log table of a replay, or of its ``means``, as a record with the recording's
        gauges."""
        t, table = (record.t, commands) if means is None else (means.record.t, None)
        built = self.record(t, table, log, record.meta, start.tank)
        shown = gauged(self.plant, self.layout, log, record.channels)
        return replace(built, channels={**built.channels, **shown}) if shown else built

    def along(self, record: Record, start: Start) -> tuple[Model, np.ndarray, np.ndarray]:
        """(the model at a start's pressures, a recording's commands and the rates of what is tied
        to it, the first state).

        Raises:
            LogError: uneven time."""
        if not record.even:
            raise LogError(message("plant.uneven"))
        table = self.played(self.commands_of(record))
        late = late_of(record, self.layout.valves)
        plant = self.plant.at_pressures(start.supply, start.tank).commanded_before(table[0], late)
        if not tied_words(record) and not supplied(record):
            return replace(self, plant=plant), table, start.y
        ties, y = ties_of(plant, self.layout, record), start.y.copy()
        for state, value in ties.first.items():
            y[state] = value
        plant = plant._replace(cylinders=ties.cylinders, supply=ties.supply)
        return replace(self, plant=plant), np.column_stack([table, ties.rates]), y

    def record(
        self,
        t: np.ndarray,
        commands: np.ndarray | None,
        log: np.ndarray,
        meta: Mapping[str, str] | None = None,
        tank: float | None = None,
    ) -> Record:
        """The log table as a record of SI channels; commands and openings only with
        ``commands``."""
        names, plant = self.layout, self.plant
        n = plant.at.rates
        channels: dict[str, np.ndarray] = {}
        driven = {int(j): i for i, j in enumerate(plant.cylinders.joint)}
        for joint, joint_name in enumerate(names.joints):
            name = names.cylinders[driven[joint]] if joint in driven else joint_name
            if plant.kind != SLIDE:  # which has no angle: its coordinate is the stroke
                channels[f"{name}.q"], channels[f"{name}.qd"] = log[:, joint], log[:, n + joint]
            if joint not in driven:
                continue
            index = driven[joint]
            x, lever = linkage_arrays(plant.cylinders[index], log[:, joint])
            channels[f"{name}.x"], channels[f"{name}.v"] = x, lever * log[:, n + joint]
            for key in (f"p_{side}" for side in SIDES):
                channels[f"{name}.{key}"] = log[:, names.state(key, index)]
        for index, key in names.part_states:
            channels[f"{names.cylinders[index]}.{key}"] = log[:, names.state(key, index)]
        if commands is not None:
            columns = [f"{valve}.command" for valve in names.valves] + list(names.played)
            channels |= {channel: commands[:, i] for i, channel in enumerate(columns)}
            tick = float(t[1] - t[0]) if len(t) > 1 else STEP
            acting = acting_commands(plant, commands, tick, tick / max(1, round(tick / STEP)))
            for index, valve in enumerate(names.valves):
                output = plant.valves[index].output
                channels[f"{valve}.opening"] = acting[:, index] if output < 0 else log[:, output]
        for channel, at in names.inner_states:
            channels[channel] = log[:, at]
        channels["p_supply"] = log[:, plant.at.supply]
        channels["p_tank"] = np.full(len(t), plant.tank_pressure if tank is None else tank)
        if log.shape[1] > names.states:
            for index, edge in enumerate(names.edges):
                channels[f"{edge}.flow"] = log[:, names.states + index]
            channels["flow_supply"] = log[:, -1]
        return Record(t, channels, dict(meta or {}))


def simulate(
    rig: Rig,
    commands: Mapping[str, np.ndarray | float],
    duration: float,
    *,
    posture: Mapping[str, str | float] | None = None,
    payload: str | None = None,
    flow_maps: Maps | None = None,
    rate: float = 1000.0,
    step: Step = STEP,
) -> Record:
    """Simulate a rig from rest under open-loop commands.

    Example:
        rig = ehbench.load_rig("recipes/rigs/slide_servo.toml")
        start = {"press": "50 mm"}
        record = ehbench.simulate(rig, {"press.servo": 2.0}, duration=0.5, posture=start)
        record.frame()["press.x"].iloc[-1]

    Args:
        rig: the machine.
        commands: [V] by ``<cylinder>.<valve>``: a number, or an array of one value a sample; others
            stay at rest. Forces that are played [N] likewise by their channel.
        duration: [s].
        posture: where the joints start, as in `Model.posture`.
        payload: a payload of the rig file.
        flow_maps: measured maps by edge name, as ``load_flow_maps`` gives them.
        rate: samples per second.
        step: integration step [s], or ``"auto"``: as long as the motion is smooth, at the error of
            the default.

    Returns:
        A record of ``rate·duration + 1`` samples: joints, cylinders, commands, openings, edge
        flows, supply.

    Raises:
        InputError: unknown valve or posture, wrong array length.
        SimulationError: the numbers left the finite range."""
    model = Model.of(rig, flow_maps, payload)
    samples = round(duration * rate) + 1
    t = np.arange(samples) / rate
    table = model.rest_commands(samples)
    columns = (*model.layout.valves, *model.layout.played)
    for name, values in commands.items():
        if name not in columns:
            fields = {"rig": rig.name, "name": name, "known": ", ".join(columns)}
            raise InputError(message("plant.no_valve", **fields))
        if np.ndim(values) and np.shape(values) != (samples,):
            fields = {"name": name, "count": np.shape(values)[0], "samples": samples}
            raise InputError(message("plant.command_length", **fields))
        table[:, columns.index(name)] = values
    first = model.trim(model.posture(posture), None, table[0])
    log = model.run(first, model.played(table.copy()), 1.0 / rate, step)
    return model.record(t, table, log, {"rig": rig.name, "payload": payload or "none"})
