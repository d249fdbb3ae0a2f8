"""What may be wrong with a model or a log, each with what it would change and the line that cures
it.

A `Cure` of size δ varies the model, the commands that it is given, or what a sensor makes of its
motion; δ = 0 is the model as it is."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ehbench.plant.model import Model
from ehbench.record import Record
from ehbench.rig import Cylinder, Rig, Valve
from ehbench.structure.cases import Case

GAINS = ("flow_gain", "compensated_gain", "displacement")
Vary = Callable[[Case, float], tuple[Model, Record]]
Sense = Callable[[Case, Record, float], Record]
Words = Callable[[float], str]


def as_it_is(case: Case, delta: float) -> tuple[Model, Record]:
    """The case's own model and record."""
    return case.model, case.record


def unsensed(case: Case, simulated: Record, delta: float) -> Record:
    """The simulation as it is."""
    return simulated


@dataclass(frozen=True, eq=False)
class Cure:
    """One thing that may be wrong: its ``kind``, what it is ``about``, and by how much.

    ``step`` is a δ small enough for a slope, ``low`` and ``high`` bound it, ``trials`` are values
    to try where a slope says nothing. ``says`` puts δ in words, ``line`` is the line of the recipe,
    the rig file or the log that cures it. Of two that explain alike the one of lower ``rank``
    comes first."""

    kind: str
    about: str
    step: float
    low: float
    high: float
    says: Words
    line: Words
    rank: int
    vary: Vary = as_it_is
    sense: Sense = unsensed
    trials: tuple[float, ...] = ()


def cures(rig: Rig, cylinders: Sequence[str], channels: Sequence[str], played: bool) -> list[Cure]:
    """All that may be wrong with a rig's model of these cylinders and with their channels.

    Args:
        rig: of the model.
        cylinders: that are commanded.
        channels: that are compared.
        played: whether the logs have the supply's pressure, which is then known.
    """
    found: list[Cure] = []
    for cylinder in rig.cylinder:
        if cylinder.name in cylinders:
            found += [*_valves(rig, cylinder), *_cylinder(rig, cylinder)]
    found += _shared(rig, played)
    for channel in channels:
        found += _sensor(channel)
    return found


def _share(delta: float) -> str:
    return f"{100.0 * abs(delta):.2g} % {'higher' if delta > 0.0 else 'lower'}"


def _more(delta: float, more: str = "more", less: str = "less") -> str:
    return more if delta > 0.0 else less


def _scaled(names: Sequence[str]) -> Vary:
    """Parameters, each times 1 + δ."""

    def vary(case: Case, delta: float) -> tuple[Model, Record]:
        known = case.model.rig.parameters()
        values = {name: float(known[name]) * (1.0 + delta) for name in names}
        return case.varied(case.model.rig.with_values(values)), case.record

    return vary


def _shifted(names: Sequence[str], unit: float) -> Vary:
    """Parameters, each plus δ times ``unit``, and not below zero."""

    def vary(case: Case, delta: float) -> tuple[Model, Record]:
        known = case.model.rig.parameters()
        values = {name: max(0.0, float(known[name]) + delta * unit) for name in names}
        return case.varied(case.model.rig.with_values(values)), case.record

    return vary


def _free(names: Sequence[str]) -> Words:
    quoted = ", ".join(f'"{name}"' for name in names)
    return lambda delta: f"add {quoted} to parameters of the identify recipe"


def _valves(rig: Rig, cylinder: Cylinder) -> Iterator[Cure]:
    known, every = rig.parameters(), []
    for valve in cylinder.valve:
        gains, bands = [], []
        for edge in valve.edge:
            name = f"{cylinder.name}.{valve.edge_name(edge)}"
            gains += [f"{name}.{key}" for key in GAINS if f"{name}.{key}" in known]
            bands += [f"{name}.deadband"] if f"{name}.deadband" in known else []
        every += gains
        for gain in gains:
            yield _gain(gain.rpartition(".")[0], [gain], 1)
        if 1 < len(gains):
            yield _gain(f"{cylinder.name}.{valve.name}", gains, 0)
        yield from _bands(valve, f"{cylinder.name}.{valve.name}", bands, rig)
        yield from _command(cylinder, valve)
        for dynamics in valve.series:
            name = f"{dynamics}.natural_frequency"
            if name in known:
                yield _lag(name)
    if len(cylinder.valve) > 1 and len(every) > 1:
        yield _gain(cylinder.name, every, 0)


def _gain(about: str, names: Sequence[str], rank: int) -> Cure:
    def says(delta: float) -> str:
        return (
            f"the machine is {_more(delta, 'faster', 'slower')} than the model whatever the "
            f"command: {about} passes {100.0 * abs(delta):.2g} % {_more(delta)} flow"
        )

    return Cure("gain", about, 0.02, -0.6, 1.5, says, _free(names), rank, _scaled(names))


def _lag(name: str) -> Cure:
    def says(delta: float) -> str:
        return (
            f"the machine answers {_more(-delta, 'later', 'earlier')} than the model, the more so "
            f"the faster: {name} is {_share(delta)}"
        )

    return Cure("lag", name, -0.05, -0.8, 2.0, says, _free([name]), 4, _scaled([name]))


def _bands(valve: Valve, about: str, names: Sequence[str], rig: Rig) -> Iterator[Cure]:
    unit = float(valve.command_max)
    known = rig.parameters()
    groups = [(about, list(names))] if len(names) > 1 else []
    groups += [(name.rpartition(".")[0], [name]) for name in names]
    for index, (who, group) in enumerate(groups):
        least = min(float(known[name]) for name in group) / unit

        def says(delta: float, who: str = who) -> str:
            return (
                f"the machine is {_more(-delta, 'faster', 'slower')} by the same at every command: "
                f"{who} has a dead band {abs(delta) * unit:.2g} V "
                f"{_more(delta, 'wider', 'narrower')}"
            )

        vary = _shifted(group, unit)
        yield Cure("deadband", who, 0.01, -least, 0.4, says, _free(group), 2 + (index > 0), vary)


def _with_command(channel: str, change: Callable[[np.ndarray, float, Case], np.ndarray]) -> Vary:
    def vary(case: Case, delta: float) -> tuple[Model, Record]:
        if channel not in case.record:
            return case.model, case.record
        given = change(case.record[channel], delta, case)
        return case.model, replace(case.record, channels=case.record.channels | {channel: given})

    return vary


def _command(cylinder: Cylinder, valve: Valve) -> Iterator[Cure]:
    """What is wrong between the recorded command and the valve."""
    about = f"{cylinder.name}.{valve.name}"
    low, high = float(valve.command_min), float(valve.command_max)

    def clipped(u: np.ndarray, delta: float, case: Case) -> np.ndarray:
        most = (1.0 - delta) * float(np.max(np.abs(u)))
        return np.clip(u, -most, most)

    def later(u: np.ndarray, delta: float, case: Case) -> np.ndarray:
        t = case.record.t
        return np.interp(t - delta, t, u)

    def moved(u: np.ndarray, delta: float, case: Case) -> np.ndarray:
        return np.clip(u + np.where(u == valve.rest, 0.0, delta * high), low, high)

    def warmer(u: np.ndarray, delta: float, case: Case) -> np.ndarray:
        s = (case.record.t - case.record.t[0]) / max(float(np.ptp(case.record.t)), 1.0e-9)
        return u * (1.0 + delta * s)

    for kind, change, step, (least, most), says, line, rank, trials in (
        (
            "saturation",
            clipped,
            0.05,
            (0.0, 0.8),
            lambda d: (
                f"flow falls short at large commands only: {about} opens no further beyond "
                f"{100.0 * (1.0 - d):.2g} % of the largest command"
            ),
            lambda d: f'law = "saturating" with its opening_max for {about} in the rig file',
            5,
            (0.1, 0.2, 0.35, 0.5),
        ),
        (
            "delay",
            later,
            0.001,
            (-0.05, 0.2),
            lambda d: (
                f"the machine answers {1e3 * abs(d):.2g} ms {_more(d, 'later', 'earlier')}, "
                f"however fast: a delay of {about}"
            ),
            lambda d: f'kind = "delay" among the dynamics of {about} in the rig file',
            5,
            (),
        ),
        (
            "neutral",
            moved,
            0.005,
            (-0.2, 0.2),
            lambda d: (
                f"one direction is faster than the other: {about} is neutral at {-d * high:.2g} V"
            ),
            lambda d: f"correct the command of {about} in the log by {d * high:.2g} V",
            5,
            (),
        ),
        (
            "drift",
            warmer,
            0.02,
            (-0.6, 1.0),
            lambda d: (
                f"the error grows with time: flow of {about} is {_share(d)} at the end of a "
                "log than at its begin"
            ),
            lambda d: "fit windows of the logs apart, and look at oil temperature and supply",
            6,
            (),
        ),
        (
            "command sign",
            lambda u, d, case: u * (1.0 - d),
            0.0,
            (0.0, 2.0),
            lambda d: f"the machine moves the other way: the command of {about} has the other sign",
            lambda d: f"turn the sign of {about}.command in the log, or of its edges",
            7,
            (2.0,) if low < 0.0 else (),
        ),
    ):
        vary = _with_command(f"{about}.command", change)
        yield Cure(kind, about, step, least, most, says, line, rank, vary, trials=trials)


def _cylinder(rig: Rig, cylinder: Cylinder) -> Iterator[Cure]:
    known, name = rig.parameters(), cylinder.name
    area, supply = cylinder.areas()[0], float(rig.supply.pressure)
    force, flow = area * supply, area * 0.01 / supply  # of 10 mm/s at the supply's pressure
    for key in ("leakage_internal", "leakage_head", "leakage_rod"):
        if f"{name}.{key}" in known:
            yield _from_zero(known, "leakage", f"{name}.{key}", flow, "it creeps under load")
    flips = "the error flips with the direction of motion"
    yield _from_zero(known, "friction", f"{name}.friction_coulomb", force, flips)
    for kind, key, step, rank, why in (
        ("damping", "joint_damping", 0.1, 3, "the error follows the speed, and ringing decays"),
        ("damping", "damping", 0.1, 3, "the error follows the speed, and ringing decays"),
        ("load", "mass", 0.05, 4, "pressures are off with weight and acceleration"),
    ):
        if f"{cylinder.joint}.{key}" in known:
            yield _scale(kind, f"{cylinder.joint}.{key}", step, why, rank)


def _from_zero(known: dict, kind: str, name: str, unit: float, why: str) -> Cure:
    least = float(known[name]) / unit

    def says(delta: float) -> str:
        return f"{why}: {name} is {_more(delta, 'larger', 'smaller')}"

    return Cure(kind, name, 0.01, -least, 1.0, says, _free([name]), 3, _shifted([name], unit))


def _scale(kind: str, name: str, step: float, why: str, rank: int) -> Cure:
    def says(delta: float) -> str:
        return f"{why}: {name} is {_share(delta)}"

    return Cure(kind, name, step, -0.8, 4.0, says, _free([name]), rank, _scaled([name]))


def _shared(rig: Rig, played: bool) -> Iterator[Cure]:
    why = "pressure rings at another frequency"
    yield _scale("bulk modulus", "bulk_modulus", 0.02, why, 2)
    if not played and float(rig.supply.pressure) > 0.0:
        why = "flow falls short the more, the higher the load"
        yield _scale("supply", "supply.pressure", 0.02, why, 5)


def _sensor(channel: str) -> Iterator[Cure]:
    """What a channel's sensor may do: δ in units of the channel's spread, of itself, or of time."""

    def corrected(change: Callable[[np.ndarray, float, Case], np.ndarray]) -> Vary:
        def vary(case: Case, delta: float) -> tuple[Model, Record]:
            if channel not in case.record:
                return case.model, case.record
            channels = case.record.channels
            true = change(channels[channel], delta, case)
            return case.model, replace(case.record, channels=channels | {channel: true})

        return vary

    def sensed(change: Callable[[np.ndarray, float, Case], np.ndarray]) -> Sense:
        def sense(case: Case, simulated: Record, delta: float) -> Record:
            if channel not in simulated:
                return simulated
            channels = simulated.channels
            seen = change(channels[channel], delta, case)
            return replace(simulated, channels=channels | {channel: seen})

        return sense

    def spread(case: Case) -> float:
        return float(np.std(case.record[channel])) if channel in case.record else 0.0

    def lagged(y: np.ndarray, delta: float, case: Case) -> np.ndarray:
        if delta <= 0.0:
            return y
        from scipy.signal import lfilter

        pole = math.exp(-case.record.sample_time / delta)
        return lfilter([1.0 - pole], [1.0, -pole], y, zi=[pole * y[0]])[0]

    yield Cure(
        "sensor offset",
        channel,
        0.02,
        -3.0,
        3.0,
        lambda d: f"{channel} is off by the same all the time ({_more(d, 'high', 'low')})",
        lambda d: f"correct the offset of {channel} in the log",
        4,
        corrected(lambda y, d, case: y - d * spread(case)),
        sensed(lambda y, d, case: y + d * spread(case)),
    )
    yield Cure(
        "sensor scale",
        channel,
        0.02,
        -0.7,
        2.0,
        lambda d: f"{channel} reads {_share(d)} than the model in proportion",
        lambda d: f"check the scale of {channel}: its readings over {1.0 + d:.3g}",
        5,
        corrected(lambda y, d, case: y / (1.0 + d)),
        sensed(lambda y, d, case: y * (1.0 + d)),
    )
    yield Cure(
        "sensor sign",
        channel,
        0.0,
        -2.0,
        0.0,
        lambda d: f"{channel} goes the other way than the model",
        lambda d: f"turn the sign of {channel} in the log",
        6,
        corrected(lambda y, d, case: y * (1.0 + d)),
        sensed(lambda y, d, case: y * (1.0 + d)),
        (-2.0,),
    )
    yield Cure(
        "sensor lag",
        channel,
        0.002,
        0.0,
        0.1,
        lambda d: f"{channel} is {1e3 * d:.2g} ms behind the model, and no other channel is",
        lambda d: f"shift {channel} in the log, or ask the sensor's maker for its filter",
        5,
        sense=sensed(lagged),
    )
