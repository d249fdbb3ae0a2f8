"""What may be wrong with a model or a log, each with what it would change and the line that cures
it.

A `Cure` of size δ varies the model, the commands that it is given, or what a sensor makes of its
motion; δ = 0 is the model as it is."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ehbench.config.rig import Cylinder, Rig, Valve
from ehbench.data.record import Record
from ehbench.diagnosis.cases import Case
from ehbench.plant.model import Model
from ehbench.vocabulary.fields import Value

WIDE = ("lag", "load", "damping")  # dynamics and bodies that several cylinders may share
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
    comes first. ``cylinder`` is the one whose logs it changes, '' for all."""

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
    cylinder: str = ""


def cures(rig: Rig, cylinders: Sequence[str], channels: Sequence[str], played: bool) -> list[Cure]:
    """All that may be wrong with a rig's model of these cylinders and with their channels.

    Args:
        rig: of the model.
        cylinders: that are commanded.
        channels: that are compared.
        played: whether the logs have the supply's pressure, which is then known.
    """
    results: list[Cure] = []
    for cylinder in rig.cylinder:
        if cylinder.name in cylinders:
            own = [*_valves(rig, cylinder), *_commands(rig, cylinder), *_cylinder(rig, cylinder)]
            results += [
                cure if cure.kind in WIDE else replace(cure, cylinder=cylinder.name) for cure in own
            ]
    results += _shared(rig, played)
    for channel in channels:
        results += [replace(item, cylinder=channel.partition(".")[0]) for item in _sensor(channel)]
    return list({(cure.kind, cure.about): cure for cure in results}.values())


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


def _free(names: Sequence[str], known: Mapping[str, Value]) -> Words:
    """The line that frees parameters; where all of them were fitted already, what that means."""
    if all(known[name].sure == "identified" for name in names):
        are = "are" if len(names) > 1 else "is"
        return lambda delta: (
            f"{', '.join(names)} {are} fitted already: fit to a log like this one too, or ask "
            "ehbench identify --suggest what else the model lacks"
        )
    quoted = ", ".join(f'"{name}"' for name in names)
    return lambda delta: f"add {quoted} to parameters of the identify recipe"


def _valves(rig: Rig, cylinder: Cylinder) -> Iterator[Cure]:
    known = rig.parameters()
    every: list[str] = []
    shut: list[str] = []
    for valve in cylinder.valve:
        gains, bands = [], []
        for edge in valve.edge:
            name = f"{cylinder.name}.{valve.edge_name(edge)}"
            gains += [f"{name}.{key}" for key in GAINS if f"{name}.{key}" in known]
            word = "deadband" if edge.underlap is None else "underlap"
            bands += [f"{name}.{word}"] if f"{name}.{word}" in known else []
        for gain in gains:
            yield _gain(gain.rpartition(".")[0], [gain], 1, known)
            yield from _preload(gain.rpartition(".")[0], rig)
        if 1 < len(gains):
            yield _gain(f"{cylinder.name}.{valve.name}", gains, 0, known)
        yield from _bands(valve, f"{cylinder.name}.{valve.name}", bands, rig)
        every += gains
        shut += bands
    lags = (f"{item}.natural_frequency" for valve in cylinder.valve for item in valve.series)
    for name in dict.fromkeys(lags):
        if name in known:
            yield _lag(name, known)
    if len(cylinder.valve) > 1:
        yield _gain(cylinder.name, every, 0, known)
        yield _band(cylinder.name, shut, float(cylinder.valve[0].command_max), rig, 2)


def _gain(about: str, names: Sequence[str], rank: int, known: Mapping[str, Value]) -> Cure:
    def says(delta: float) -> str:
        return (
            f"the machine is {_more(delta, 'faster', 'slower')} than the model whatever the "
            f"command: {about} passes {100.0 * abs(delta):.2g} % {_more(delta)} flow"
        )

    return Cure("gain", about, 0.02, -0.6, 1.5, says, _free(names, known), rank, _scaled(names))


def _lag(name: str, known: Mapping[str, Value]) -> Cure:
    def says(delta: float) -> str:
        return (
            f"the machine answers {_more(-delta, 'later', 'earlier')} than the model, the more so "
            f"the faster: {name} is {_share(delta)}"
        )

    trials = (-0.6, -0.4, -0.2, 0.5)
    vary = _scaled([name])
    line = _free([name], known)
    return Cure("lag", name, -0.05, -0.8, 2.0, says, line, 4, vary, trials=trials)


def _bands(valve: Valve, about: str, names: Sequence[str], rig: Rig) -> Iterator[Cure]:
    unit = float(valve.command_max)
    if len(names) > 1 and len({name.rpartition(".")[2] for name in names}) == 1:
        yield _band(about, names, unit, rig, 2)
    for name in names:
        yield _band(name.rpartition(".")[0], [name], unit, rig, 3)


def _band(about: str, names: Sequence[str], unit: float, rig: Rig, rank: int) -> Cure:
    """Of dead bands, or of underlaps, in shares of the largest command [V]."""
    known = rig.parameters()
    minimum = min((float(known[name]) / unit for name in names), default=0.0)
    lapped = names[0].endswith(".underlap")
    word, way = ("an underlap", -1.0) if lapped else ("a dead band", 1.0)

    def says(delta: float) -> str:
        return (
            f"the machine is {_more(-way * delta, 'faster', 'slower')} by the same at every "
            f"command: {about} has {word} {abs(delta) * unit:.2g} V "
            f"{_more(delta, 'wider', 'narrower')}"
        )

    vary = _shifted(names, unit)
    return Cure("deadband", about, 0.01, -minimum, 0.4, says, _free(names, known), rank, vary)


def _preload(edge: str, rig: Rig) -> Iterator[Cure]:
    """Of a way to the tank, in shares of the supply's pressure."""
    name, unit = f"{edge}.cracking_pressure", float(rig.supply.pressure)
    known, own = rig.parameters(), rig.all_edges()[edge]
    if own.to != "tank" or unit <= 0.0 or name not in known:
        return
    minimum = float(known[name])

    def says(delta: float) -> str:
        return (
            f"pressure stands {_more(delta, 'higher', 'lower')} than the model's as long as oil "
            f"returns: {edge} opens above {rig.shown(name, minimum + delta * unit, 3)} only"
        )

    line, vary = _free([name], known), _shifted([name], unit)
    yield Cure("preload", edge, 0.01, -minimum / unit, 0.8, says, line, 3, vary)


def _with_commands(
    channels: Sequence[str], change: Callable[[np.ndarray, float, Case], np.ndarray]
) -> Vary:
    """Commands altered on their way to the valves."""

    def vary(case: Case, delta: float) -> tuple[Model, Record]:
        given = {
            name: change(case.record[name], delta, case) for name in channels if name in case.record
        }
        return case.model, replace(case.record, channels=case.record.channels | given)

    return vary


def _clipped(u: np.ndarray, delta: float, case: Case) -> np.ndarray:
    maximum = (1.0 - delta) * float(np.max(np.abs(u)))
    return np.clip(u, -maximum, maximum)


def _later(u: np.ndarray, delta: float, case: Case) -> np.ndarray:
    return np.interp(case.record.t - delta, case.record.t, u)


def _warmer(u: np.ndarray, delta: float, case: Case) -> np.ndarray:
    t = case.record.t
    return u * (1.0 + delta * (t - t[0]) / max(float(np.ptp(t)), 1.0e-9))


def _commands(rig: Rig, cylinder: Cylinder) -> Iterator[Cure]:
    """What is wrong between recorded commands and valves: of all of a cylinder, and of each."""
    names = [f"{cylinder.name}.{valve.name}" for valve in cylinder.valve]
    groups = [(cylinder.name, names)] if len(names) > 1 else []
    for about, group in [*groups, *((name, [name]) for name in names)]:
        given = [f"{name}.command" for name in group]
        yield Cure(
            "saturation",
            about,
            0.05,
            0.0,
            0.8,
            lambda d, about=about: (
                f"flow falls short at large commands only: {about} opens no further beyond "
                f"{100.0 * (1.0 - d):.2g} % of the largest command"
            ),
            lambda d, about=about: (
                f"a drive_limit for {about} in the rig file, or where valves come to their stops, "
                'law = "saturating" with its opening_max'
            ),
            5,
            _with_commands(given, _clipped),
            trials=(0.1, 0.25, 0.4, 0.55),
        )
    whole, given = cylinder.name if groups else names[0], [f"{name}.command" for name in names]
    known = rig.parameters()
    delays = (f"{item}.delay" for valve in cylinder.valve for item in valve.series)
    yield _late(whole, given, [delay for delay in dict.fromkeys(delays) if delay in known], known)
    yield Cure(
        "drift",
        whole,
        0.02,
        -0.6,
        1.0,
        lambda d: (
            f"the error grows with time: flow of {whole} is {_share(d)} at the end of a log than "
            "at its begin"
        ),
        lambda d: "fit windows of the logs apart, and look at oil temperature and supply",
        6,
        _with_commands(given, _warmer),
    )
    for valve, name in zip(cylinder.valve, names, strict=True):
        yield from _level(valve, name)


def _late(
    whole: str, given: Sequence[str], delays: Sequence[str], known: Mapping[str, Value]
) -> Cure:
    """What is wrong with when commands were given, or written; ``delays`` are those there are."""
    line, more = _free(delays, known), "more delay" if delays else "a delay"
    return Cure(
        "delay",
        whole,
        0.001,
        -0.05,
        0.2,
        lambda d: (
            f"the machine answers {1e3 * abs(d):.2g} ms {_more(d, 'later', 'earlier')}, however "
            f"slow the command: "
            + (f"{more} of {whole}" if d > 0.0 else f"{', '.join(given)} was written late")
        ),
        lambda d: (
            f'late = "{-1e3 * d:.2g} ms" to that column in the map, or as much more'
            if d <= 0.0
            else line(d)
            if delays
            else f'kind = "delay" among the dynamics of {whole} in the rig file'
        ),
        5,
        _with_commands(given, _later),
        trials=(0.005, 0.01, 0.02, 0.04),
    )


def _level(valve: Valve, about: str) -> Iterator[Cure]:
    """What is wrong with the zero and the sign of a recorded command."""
    low, high, rest = float(valve.command_min), float(valve.command_max), float(valve.rest)

    def moved(u: np.ndarray, delta: float, case: Case) -> np.ndarray:
        return np.clip(u + np.where(u == rest, 0.0, delta * high), low, high)

    def turned(u: np.ndarray, delta: float, case: Case) -> np.ndarray:
        return u * (1.0 - delta)

    yield Cure(
        "neutral",
        about,
        0.005,
        -0.2,
        0.2,
        lambda d: (
            f"one direction is faster than the other: {about} is neutral at {-d * high:.2g} V"
        ),
        lambda d: _sensed_by(f"{about}.command", 'offset = "estimate"'),
        5,
        _with_commands([f"{about}.command"], moved),
    )
    if low < 0.0:
        yield Cure(
            "command sign",
            about,
            0.0,
            0.0,
            2.0,
            lambda d: f"the machine moves the other way: the command of {about} is turned",
            lambda d: _sensed_by(f"{about}.command", "sign = -1") + ", or turn its edges",
            7,
            _with_commands([f"{about}.command"], turned),
            trials=(2.0,),
        )


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
            yield _scale(kind, f"{cylinder.joint}.{key}", step, why, rank, known)


def _from_zero(known: dict, kind: str, name: str, unit: float, why: str) -> Cure:
    minimum = float(known[name]) / unit

    def says(delta: float) -> str:
        return f"{why}: {name} is {_more(delta, 'larger', 'smaller')}"

    line = _free([name], known)
    return Cure(kind, name, 0.01, -minimum, 30.0, says, line, 3, _shifted([name], unit))


def _scale(
    kind: str, name: str, step: float, why: str, rank: int, known: Mapping[str, Value]
) -> Cure:
    def says(delta: float) -> str:
        return f"{why}: {name} is {_share(delta)}"

    trials = (-0.3, -0.15, 0.15, 0.4) if kind in ("bulk modulus", "load") else ()
    vary = _scaled([name])
    line = _free([name], known)
    return Cure(kind, name, step, -0.8, 4.0, says, line, rank, vary, trials=trials)


def _shared(rig: Rig, played: bool) -> Iterator[Cure]:
    why, known = "pressure rings at another frequency", rig.parameters()
    yield _scale("bulk modulus", "bulk_modulus", 0.02, why, 2, known)
    if not played and float(rig.supply.pressure) > 0.0:
        why = "flow falls short the more, the higher the load"
        yield _scale("supply", "supply.pressure", 0.02, why, 5, known)


Reading = Callable[[np.ndarray, float, Case], np.ndarray]


def _corrected(channel: str, change: Reading) -> Vary:
    """The log with a channel as a sound sensor would have given it: the model starts from it."""

    def vary(case: Case, delta: float) -> tuple[Model, Record]:
        if channel not in case.record:
            return case.model, case.record
        channels = case.record.channels
        true = change(channels[channel], delta, case)
        return case.model, replace(case.record, channels=channels | {channel: true})

    return vary


def _sensed(channel: str, change: Reading) -> Sense:
    """The simulation as the faulty sensor would have shown it."""

    def sense(case: Case, simulated: Record, delta: float) -> Record:
        if channel not in simulated:
            return simulated
        channels = simulated.channels
        seen = change(channels[channel], delta, case)
        return replace(simulated, channels=channels | {channel: seen})

    return sense


def _lagged(y: np.ndarray, delta: float, case: Case) -> np.ndarray:
    if delta <= 0.0:
        return y
    from scipy.signal import lfilter

    pole = math.exp(-case.record.sample_time / delta)
    return lfilter([1.0 - pole], [1.0, -pole], y, zi=[pole * y[0]])[0]


def _sensed_by(channel: str, says: str) -> str:
    """The recipe's lines about a channel's sensor."""
    return f'add [[sensor]] channel = "{channel}", {says} to the recipe'


def _sensor(channel: str) -> Iterator[Cure]:
    """What a channel's sensor may do: δ in spreads of the channel, in shares of itself, in time."""

    def spread(case: Case) -> float:
        return float(np.std(case.record[channel])) if channel in case.record else 0.0

    yield Cure(
        "sensor offset",
        channel,
        0.02,
        -3.0,
        3.0,
        lambda d: f"{channel} is off by the same all the time ({_more(d, 'high', 'low')})",
        lambda d: _sensed_by(channel, 'offset = "estimate"'),
        4,
        _corrected(channel, lambda y, d, case: y - d * spread(case)),
        _sensed(channel, lambda y, d, case: y + d * spread(case)),
    )
    yield Cure(
        "sensor scale",
        channel,
        0.02,
        -0.7,
        2.0,
        lambda d: f"{channel} reads {_share(d)} than the model in proportion",
        lambda d: _sensed_by(channel, 'scale = "estimate"'),
        5,
        _corrected(channel, lambda y, d, case: y / (1.0 + d)),
        _sensed(channel, lambda y, d, case: y * (1.0 + d)),
    )
    yield Cure(
        "sensor lag",
        channel,
        0.002,
        0.0,
        0.1,
        lambda d: f"{channel} is {1e3 * d:.2g} ms behind the model, and no other channel is",
        lambda d: _sensed_by(channel, 'lag = "estimate"'),
        5,
        sense=_sensed(channel, _lagged),
    )
    yield Cure(
        "sensor sign",
        channel,
        0.0,
        -2.0,
        0.0,
        lambda d: f"{channel} goes the other way than the model",
        lambda d: _sensed_by(channel, "sign = -1"),
        6,
        _corrected(channel, lambda y, d, case: y * (1.0 + d)),
        _sensed(channel, lambda y, d, case: y * (1.0 + d)),
        (-2.0,),
    )
