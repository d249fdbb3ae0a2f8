"""Time: integrate the plant, start it in equilibrium, and give what happened as a record."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ehbench.compiled import allocating_kernel, kernel
from ehbench.errors import InputError, LogError, SimulationError
from ehbench.physics.arm import gravity_torque, work_size
from ehbench.physics.cylinder import joint_angle, joint_range, linkage
from ehbench.physics.flow_map import ValveMaps
from ehbench.plant import (
    AREA_HEAD,
    AREA_ROD,
    DAMPING,
    GEOMETRY,
    HIGHEST,
    L_A,
    L_B,
    LOWEST,
    PHASE,
    RETRACTED,
    SIDE,
    STIFFNESS,
    STROKE,
    Layout,
    Plant,
    build,
    derivatives,
    layout,
    workspace_size,
)
from ehbench.quantities import VOCABULARY
from ehbench.record import Record
from ehbench.rig import Rig, read_value

STEP = 5.0e-4  # [s]
STIFF = 1.0  # substeps are taken so that rate·step stays below this
MOST_SUBSTEPS = 400
SETTLED = 1.0e-12  # [V]: a valve this near to its command has arrived
MOVED = (
    0.005  # share of a driver's range that a recorded command must change by to be more than noise
)
Maps = Mapping[str, ValveMaps]


@kernel
def rk4(y, command, plant, h, k, work):
    """One classical Runge–Kutta step of ``h`` [s] in place, more substeps where the plant is stiff;
    returns the substeps.

    ``k`` is a (5, states) scratch. ``k[0]`` holds the derivatives at the step's start and ``work``
    the edge flows there only if one substep was taken."""
    return advance(y, command, plant, h, k, work, derivatives(y, command, plant, k[0], work))


@kernel
def advance(y, command, plant, h, k, work, rate):
    """`rk4` where ``k[0]`` and ``rate`` already hold what `derivatives` gives at ``y``."""
    size = y.shape[0]
    substeps = 1
    if rate * h > STIFF:
        substeps = min(MOST_SUBSTEPS, math.ceil(rate * h / STIFF))
    d = h / substeps
    for s in range(substeps):
        if s > 0:
            derivatives(y, command, plant, k[0], work)
        for i in range(size):
            k[4, i] = y[i] + 0.5 * d * k[0, i]
        derivatives(k[4], command, plant, k[1], work)
        for i in range(size):
            k[4, i] = y[i] + 0.5 * d * k[1, i]
        derivatives(k[4], command, plant, k[2], work)
        for i in range(size):
            k[4, i] = y[i] + d * k[2, i]
        derivatives(k[4], command, plant, k[3], work)
        for i in range(size):
            y[i] += d / 6.0 * (k[0, i] + 2.0 * (k[1, i] + k[2, i]) + k[3, i])
        _finish_valves(y, command, plant, d, k[0])
    return substeps


@kernel
def _finish_valves(y, command, plant, d, slope):
    """Bring the valves from the fourth to the eighth order of ``d`` [s], in place, and set down
    those that have arrived.

    A valve is linear and its command is held, so a Runge–Kutta step is the Taylor series of its
    exact answer up to d⁴; the next four terms follow from ``x⁽ⁿ⁺²⁾ = −ω² x⁽ⁿ⁾ − 2ζω x⁽ⁿ⁺¹⁾``.
    ``slope`` holds the derivatives where the step began."""
    nv = plant.valves.shape[0]
    at_open = 2 * plant.links.shape[0] + 2 * plant.cylinders.shape[0]
    for i in range(nv):
        low, high = slope[at_open + i], slope[at_open + nv + i]
        if low == 0.0 and high == 0.0:
            continue
        k, c = plant.valves[i, STIFFNESS], plant.valves[i, DAMPING]
        for _ in range(3):
            low, high = high, -k * low - c * high
        share, more, rate = d * d * d * d / 24.0, 0.0, 0.0
        for n in range(5, 9):
            low, high = high, -k * low - c * high
            share *= d / n
            more += share * low
            rate += share * high
        y[at_open + i] += more
        y[at_open + nv + i] += rate
        # an exponential tail would end in subnormal numbers, with which processors are slow
        u = min(max(command[i], plant.valves[i, LOWEST]), plant.valves[i, HIGHEST])
        if abs(y[at_open + i] - u) < SETTLED and abs(y[at_open + nv + i]) < SETTLED * math.sqrt(k):
            y[at_open + i], y[at_open + nv + i] = u, 0.0


@allocating_kernel
def run(y, commands, plant, tick, steps, log):
    """Integrate from ``y`` (in place) through a table of commands, held over each tick; returns the
    most substeps.

    Args:
        y: state at the first sample.
        commands: [V], shape (samples, valves); row i acts from sample i on.
        tick: time between samples [s].
        steps: integration steps a tick.
        log: out, shape (samples, states + edges + 1): the state, the edge flows and the pump flow
            at each sample, before the tick that starts there.
    """
    size, flows = y.shape[0], plant.edges.shape[0] + 1
    k = np.empty((5, size))
    work = np.empty(
        workspace_size(plant.links.shape[0], plant.cylinders.shape[0], plant.edges.shape[0])
    )
    at = work.shape[0] - flows
    most = 1
    for sample in range(commands.shape[0]):
        command = commands[sample]
        rate = derivatives(y, command, plant, k[0], work)
        for i in range(size):
            log[sample, i] = y[i]
        for i in range(flows):
            log[sample, size + i] = work[at + i]
        if sample + 1 < commands.shape[0]:
            most = max(most, advance(y, command, plant, tick / steps, k, work, rate))
            for _ in range(1, steps):
                most = max(most, rk4(y, command, plant, tick / steps, k, work))
    return most


@dataclass(frozen=True)
class Model:
    """A rig ready to simulate: its numbers, their compiled form, and the names in it."""

    rig: Rig
    plant: Plant
    layout: Layout

    @classmethod
    def of(cls, rig: Rig, maps: Maps | None = None, payload: str | None = None) -> Model:
        """The model of a rig carrying ``payload``, its edges on measured ``maps`` where given.

        Raises:
            InputError: no such payload, or an edge without its map.
        """
        loaded = rig.with_payload(payload)
        return cls(loaded, build(loaded, maps), layout(loaded))

    def stroke_range(self, index: int) -> tuple[float, float]:
        """Joint angle [rad] (or position [m]) at zero and at full stroke of cylinder ``index``."""
        row = self.plant.cylinders[index]
        return joint_range(
            int(row[GEOMETRY]), *row[[L_A, L_B, SIDE, PHASE, RETRACTED]], row[STROKE]
        )

    def posture(self, wanted: Mapping[str, str | float] | None) -> np.ndarray:
        """Joint coordinates [rad or m], shape (n,), from postures by cylinder or joint name.

        A number or text with an angle is a joint angle, a text with a length a stroke; what is not
        named stands at mid-stroke.

        Raises:
            InputError: unknown name, or a posture outside the stroke; says what the stroke allows.
        """
        q = np.zeros(len(self.layout.joints))
        for index, joint in enumerate(self.plant.joints):
            row = self.plant.cylinders[index]
            q[joint] = joint_angle(
                int(row[GEOMETRY]), *row[[L_A, L_B, SIDE, PHASE, RETRACTED]], 0.5 * row[STROKE]
            )
        slide = self.plant.cylinders.shape[0] and self.rig.mechanism.kind == "slide"
        for name, value in (wanted or {}).items():
            if name in self.layout.cylinders:
                index = self.layout.cylinders.index(name)
                joint = int(self.plant.joints[index])
            elif name in self.layout.joints:
                joint = self.layout.joints.index(name)
                index = next((i for i, j in enumerate(self.plant.joints) if j == joint), -1)
            else:
                raise InputError(
                    f"posture names '{name}', which is no cylinder or joint",
                    hint="there are " + ", ".join(self.layout.cylinders),
                )
            if isinstance(value, str):
                try:
                    number = float(read_value(value, VOCABULARY["x" if slide else "q"]))
                except InputError:
                    row = self.plant.cylinders[index]
                    stroke = float(read_value(value, VOCABULARY["x"]))
                    if not 0 <= stroke <= row[STROKE]:
                        raise InputError(
                            f"posture {name} = {value} lies outside the stroke",
                            hint=f"0 to {row[STROKE] * 1e3:.1f} mm",
                        ) from None
                    number = float(
                        joint_angle(
                            int(row[GEOMETRY]), *row[[L_A, L_B, SIDE, PHASE, RETRACTED]], stroke
                        )
                    )
            else:
                number = float(value)
            if index >= 0:
                ends = self.stroke_range(index)
                low, high = min(ends), max(ends)
                if not low - 1e-9 <= number <= high + 1e-9:
                    shown = (
                        f"{low * 1e3:.1f} to {high * 1e3:.1f} mm"
                        if slide
                        else f"{math.degrees(low):.2f} to {math.degrees(high):.2f} deg"
                    )
                    at = f"{number * 1e3:.1f} mm" if slide else f"{math.degrees(number):.2f} deg"
                    raise InputError(
                        f"posture {name} = {at} lies outside the stroke",
                        hint=f"the stroke allows {shown}",
                    )
            q[joint] = number
        return q

    def trim(self, q: np.ndarray, low_side: float | None = None) -> np.ndarray:
        """The state at rest at joint coordinates ``q``: valves shut, supply at its set pressure,
        loads carried.

        The chamber that the load does not press on stands at ``low_side`` [Pa], by default a tenth
        of the supply pressure.

        Raises:
            SimulationError: a cylinder has no lever there, so no pressure holds the load.
        """
        plant, names = self.plant, self.layout
        n = len(names.joints)
        y = np.zeros(names.states)
        y[:n] = q
        torque = np.empty(n)
        gravity_torque(plant.kind, plant.links, plant.gravity, q, torque, np.empty(work_size(n)))
        low = 0.1 * plant.supply[0] if low_side is None else low_side
        for index, joint in enumerate(plant.joints):
            row = plant.cylinders[index]
            _, lever, _ = linkage(
                int(row[GEOMETRY]), *row[[L_A, L_B, SIDE, PHASE, RETRACTED]], q[joint]
            )
            if abs(lever) < 1e-6:
                raise SimulationError(
                    f"cylinder '{names.cylinders[index]}' has no lever at this posture, so nothing holds the load"
                )
            force = torque[joint] / lever
            head, rod = low, low
            if force + low * row[AREA_ROD] >= low * row[AREA_HEAD]:
                head = (force + low * row[AREA_ROD]) / row[AREA_HEAD]
            else:
                rod = (low * row[AREA_HEAD] - force) / row[AREA_ROD]
            y[names.state("p_head", index)], y[names.state("p_rod", index)] = head, rod
        for index, (_, valve) in enumerate(self.rig.valves()):
            y[names.state("opening", index)] = valve.rest
        y[names.state("p_supply", 0)] = plant.supply[0]
        return y

    def rest_commands(self, samples: int) -> np.ndarray:
        """A table of commands [V], shape (samples, valves), that leaves every valve at rest."""
        return np.tile([valve.rest for _, valve in self.rig.valves()], (samples, 1))

    def commands_of(self, record: Record) -> np.ndarray:
        """A recording's commands [V], shape (samples, valves); valves that it lacks stay at rest."""
        table = self.rest_commands(record.t.size)
        for index, valve in enumerate(self.layout.valves):
            if f"{valve}.command" in record:
                table[:, index] = record[f"{valve}.command"]
        return table

    def rest_samples(self, commands: np.ndarray) -> int:
        """How many samples pass before a command [V], shape (samples, valves), changes by more than
        noise; at least one.
        """
        span = MOVED * (self.plant.valves[:, HIGHEST] - self.plant.valves[:, LOWEST])
        moved = np.flatnonzero(np.any(np.abs(commands - commands[0]) > span, axis=1))
        return max(1, int(moved[0]) if moved.size else commands.shape[0])

    def run(
        self, y: np.ndarray, commands: np.ndarray, tick: float = 1e-3, step: float = STEP
    ) -> np.ndarray:
        """Integrate from state ``y`` (left as it is) through ``commands``; returns the log table of
        `run`.

        Raises:
            SimulationError: the state stopped being finite; says when.
        """
        steps = max(1, round(tick / step))
        log = np.empty((commands.shape[0], y.shape[0] + self.plant.edges.shape[0] + 1))
        run(y.copy(), np.ascontiguousarray(commands, dtype=float), self.plant, tick, steps, log)
        if not np.isfinite(log[-1]).all():
            bad = int(np.argmin(np.isfinite(log).all(axis=1)))
            raise SimulationError(
                f"the simulation left finite numbers at t = {bad * tick:.4g} s",
                hint="take a smaller step",
            )
        return log

    def start_of(self, record: Record, rest: int) -> np.ndarray:
        """The state at the first sample of a recording, from the mean of its first ``rest``
        samples.

        Joint angles (or strokes), chamber and supply pressures are the recording's where it has
        them, else those of `trim`. The two pressures of a cylinder are moved, as little as possible
        together, until they carry the load exactly: friction and sensor offsets would otherwise
        start the simulation with a jolt that the machine did not make. Rates are zero.

        Raises:
            InputError: a posture outside the stroke.
        """
        plant, names = self.plant, self.layout

        def first(channel: str) -> float | None:
            return float(np.mean(record[channel][:rest])) if channel in record else None

        wanted: dict[str, str | float] = {}
        for index, name in enumerate(names.cylinders):
            angle, stroke = first(f"{name}.q"), first(f"{name}.x")
            if angle is not None:
                low, high = sorted(self.stroke_range(index))
                slack = 0.01 * (high - low)
                wanted[name] = (
                    min(max(angle, low), high) if low - slack <= angle <= high + slack else angle
                )
            elif stroke is not None:
                wanted[name] = f"{min(max(stroke, 0.0), float(plant.cylinders[index, STROKE]))!r} m"
        for joint in names.joints:
            angle = first(f"{joint}.q")
            if joint not in wanted and angle is not None:
                wanted[joint] = angle
        y = self.trim(self.posture(wanted))
        for index, name in enumerate(names.cylinders):
            head, rod = names.state("p_head", index), names.state("p_rod", index)
            area_head, area_rod = plant.cylinders[index, [AREA_HEAD, AREA_ROD]]
            force = y[head] * area_head - y[rod] * area_rod
            p_head, p_rod = first(f"{name}.p_head"), first(f"{name}.p_rod")
            if p_head is None and p_rod is None:
                continue
            if p_head is None:
                p_head = (force + p_rod * area_rod) / area_head
            elif p_rod is None:
                p_rod = (p_head * area_head - force) / area_rod
            missing = (force - p_head * area_head + p_rod * area_rod) / (area_head**2 + area_rod**2)
            y[head], y[rod] = p_head + missing * area_head, p_rod - missing * area_rod
        for index, valve in enumerate(names.valves):
            if f"{valve}.command" in record:
                y[names.state("opening", index)] = record[f"{valve}.command"][0]
        supply = first("p_supply")
        if supply is not None:
            y[names.state("p_supply", 0)] = supply
        return y

    def replay(self, record: Record, step: float = STEP, rest: int | None = None) -> Record:
        """Simulate what a recording's commands do, from the recording's own start.

        Commands of valves that the recording lacks stay at rest; each recorded command acts from
        its sample on. Where the recording has ``p_supply`` and ``p_tank``, their means over the
        ``rest`` samples are the set and the tank pressure.

        Args:
            record: evenly sampled.
            step: integration step [s].
            rest: samples at the start over which nothing moves yet; found from the commands by
                default.

        Raises:
            LogError: uneven time.
            SimulationError: the numbers left the finite range.
        """
        tick = record.sample_time
        if record.t.size < 3 or np.abs(np.diff(record.t) - tick).max() > 0.01 * tick:
            raise LogError(
                "the recording is not evenly sampled, so it cannot be replayed",
                hint="resample it to one rate",
            )
        table = self.commands_of(record)
        rest = self.rest_samples(table) if rest is None else rest
        supply = self.plant.supply.copy()
        for channel, column in (("p_supply", 0), ("p_tank", 1)):
            if channel in record:
                supply[column] = float(np.mean(record[channel][:rest]))
        model = replace(self, plant=self.plant._replace(supply=supply))
        log = model.run(model.start_of(record, rest), table, tick, step)
        return model.record(record.t, table, log, record.meta)

    def record(
        self,
        t: np.ndarray,
        commands: np.ndarray,
        log: np.ndarray,
        meta: Mapping[str, str] | None = None,
    ) -> Record:
        """The log table as a record of named SI channels."""
        names, plant = self.layout, self.plant
        n = len(names.joints)
        channels: dict[str, np.ndarray] = {}
        driven = {int(j): i for i, j in enumerate(plant.joints)}
        for joint, joint_name in enumerate(names.joints):
            name = names.cylinders[driven[joint]] if joint in driven else joint_name
            channels[f"{name}.q"], channels[f"{name}.qd"] = log[:, joint], log[:, n + joint]
            if joint not in driven:
                continue
            index = driven[joint]
            x, lever = linkage_arrays(plant.cylinders[index], log[:, joint])
            channels[f"{name}.x"], channels[f"{name}.v"] = x, lever * log[:, n + joint]
            for key in ("p_head", "p_rod"):
                channels[f"{name}.{key}"] = log[:, names.state(key, index)]
        for index, valve in enumerate(names.valves):
            channels[f"{valve}.command"] = commands[:, index]
        for index, valve in enumerate(names.valves):
            static = plant.valves[index, 0] == 0.0
            channels[f"{valve}.opening"] = (
                commands[:, index] if static else log[:, names.state("opening", index)]
            )
        for index, edge in enumerate(names.edges):
            channels[f"{edge}.flow"] = log[:, names.states + index]
        channels["p_supply"] = log[:, names.state("p_supply", 0)]
        channels["p_tank"] = np.full(len(t), plant.supply[1])
        channels["flow_supply"] = log[:, -1]
        return Record(t, channels, dict(meta or {}))


@kernel
def _linkages(row, q, x, lever):
    for i in range(q.shape[0]):
        x[i], lever[i], _ = linkage(
            int(row[GEOMETRY]), row[L_A], row[L_B], row[SIDE], row[PHASE], row[RETRACTED], q[i]
        )


def linkage_arrays(row: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(x [m], lever [m/rad]) of a cylinder's row over an array of joint coordinates."""
    x, lever = np.empty(q.shape[0]), np.empty(q.shape[0])
    _linkages(row, np.ascontiguousarray(q), x, lever)
    return x, lever


def simulate(
    rig: Rig,
    commands: Mapping[str, np.ndarray | float],
    duration: float,
    *,
    posture: Mapping[str, str | float] | None = None,
    payload: str | None = None,
    flow_maps: Maps | None = None,
    rate: float = 1000.0,
    step: float = STEP,
) -> Record:
    """Simulate a rig from rest under open-loop commands.

    Example:
        rig = ehbench.load_rig("recipes/rigs/slide_servo.toml")
        record = ehbench.simulate(rig, {"press.servo": 2.0}, duration=0.5, posture={"press": "50 mm"})
        record.frame()["press.x"].iloc[-1]

    Args:
        rig: the machine.
        commands: [V] by ``<cylinder>.<valve>``: a number, or an array of one value a sample; others
            stay at rest.
        duration: [s].
        posture: where the joints start, as in `Model.posture`.
        payload: a payload of the rig file.
        flow_maps: measured maps by edge name, as ``load_flow_maps`` gives them.
        rate: samples per second.
        step: integration step [s].

    Returns:
        A record of ``rate·duration + 1`` samples: joints, cylinders, commands, openings, edge
        flows, supply.

    Raises:
        InputError: unknown valve or posture, wrong array length.
        SimulationError: the numbers left the finite range.
    """
    model = Model.of(rig, flow_maps, payload)
    samples = round(duration * rate) + 1
    t = np.arange(samples) / rate
    table = model.rest_commands(samples)
    for name, values in commands.items():
        if name not in model.layout.valves:
            raise InputError(
                f"rig '{rig.name}' has no valve '{name}'",
                hint="it has " + ", ".join(model.layout.valves),
            )
        if np.ndim(values) and np.shape(values) != (samples,):
            raise InputError(
                f"the command of '{name}' has {np.shape(values)[0]} values, the trial {samples} samples"
            )
        table[:, model.layout.valves.index(name)] = values
    log = model.run(model.trim(model.posture(posture)), table, 1.0 / rate, step)
    return model.record(t, table, log, {"rig": rig.name, "payload": payload or "none"})
