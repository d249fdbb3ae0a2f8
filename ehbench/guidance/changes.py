"""What may be tried on a fit that is not good enough: parameters to free, laws and elements to add
to the rig, sensors to estimate, each as lines of the recipe and of the rig file."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ehbench.config.recipe.sensor import ESTIMATE, WORDS, Sensor
from ehbench.config.rig import Cylinder, Rig, Valve
from ehbench.data.record import Record
from ehbench.identification.search import WIDE, Given
from ehbench.parts.edge import edge_law
from ehbench.plant.build import load_of
from ehbench.preprocessing.observations import least_change, position_of

GAINS = ("flow_gain", "compensated_gain", "displacement")
TIMES = ("natural_frequency", "lag", "corner", "delay")  # of a valve's dynamics
LOSSES = ("leakage_internal", "leakage_head", "leakage_rod")
# where searches begin, and how far they may go: shares of the largest command, of the supply's
# force, of the flow at 10 mm/s and the supply's pressure
OPENS, SHUTS, RUBS, LEAKS = (0.85, 0.6), 0.5, 0.3, 30.0
SOFT, LAPS = 0.1, 0.1  # of those ranges, where searches of a rounding and of an underlap begin
# shares of the largest command between which some of those that open a valve must lie, and how many
# of them, for logs to tell a drive that is full from a gain
BETWEEN, SOME = (0.1, 0.8), 0.05
PRELOADS = 0.5  # share of the pressure that a cylinder comes to
SWAYS, SPRINGS = 0.3, (1.0, 0.3, 3.0)  # shares of the load, and of the oil's spring
# by what factor a spring may be stiffer and what hangs on it lighter than where its search starts:
# beyond they only move with the rest, and take ever shorter steps to simulate
STIFFER = 10.0
DELAY, LONGEST, LAG = 0.003, 0.1, 0.01  # [s]
AIR, MOST_AIR = 0.005, 0.1
TURNED = "sign"  # the kind of what turns a channel
Alter = Callable[[dict[str, Any]], None]


@dataclass(frozen=True)
class Change:
    """One thing to try: its ``kind``, what it is ``about``; ``parameters`` that it frees, with
    where their search starts (each of ``starts`` is tried) and their upper bounds [SI]; what it
    estimates of ``sensors``; how it alters the rig file's tables, and the lines that say so;
    ``simpler``, a change of which it is an elaboration."""

    kind: str
    about: str
    parameters: tuple[str, ...] = ()
    starts: tuple[Mapping[str, float], ...] = ({},)
    upper: Mapping[str, float] = field(default_factory=dict)
    sensors: tuple[Sensor, ...] = ()
    alter: Alter | None = None
    rig_lines: tuple[str, ...] = ()
    simpler: Change | None = None

    @property
    def name(self) -> str:
        """Such as ``deadband of press.servo``."""
        return f"{self.kind} of {self.about}"

    @property
    def freedom(self) -> int:
        """How many numbers it frees."""
        asked = sum(one[word] is not None for one in self.sensors for word in WORDS)
        return len(self.parameters) + asked

    def altered(self, rig: Rig) -> Rig:
        """The rig with it.

        Raises:
            ValueError: there is no such rig.
        """
        if self.alter is None:
            return rig
        tables = _lists(rig.as_toml())
        self.alter(tables)
        return Rig.model_validate(tables)

    def recipe_lines(self, rig: Rig) -> tuple[str, ...]:
        """What it adds to the recipe."""
        lines = []
        if self.parameters:
            lines.append("parameters: add " + ", ".join(f'"{one}"' for one in self.parameters))
        for name, value in self.upper.items():
            lines.append(f'[upper] "{name}" = "{rig.shown(name, value, 5)}"')
        for one in self.sensors:
            words = ", ".join(f'{word} = "{ESTIMATE}"' for word in WORDS if one[word])
            words = words or f"sign = {one.sign}"
            lines.append(f'[[sensor]] channel = "{one.channel}", {words}')
        return tuple(lines)

    def apart(self) -> Iterator[Change]:
        """The simpler change that it elaborates; each of its parameters freed alone, where it frees
        several without altering the rig.
        """
        if self.simpler is not None:
            yield self.simpler
        if len(self.parameters) > 1 and self.alter is None:
            for name in self.parameters:
                upper = {name: self.upper[name]} if name in self.upper else {}
                yield replace(self, about=name.rpartition(".")[0], parameters=(name,), upper=upper)


def _lists(tables: Any) -> Any:
    """Nested plain values whose lists can be altered."""
    if isinstance(tables, Mapping):
        return {key: _lists(value) for key, value in tables.items()}
    return [_lists(one) for one in tables] if isinstance(tables, list | tuple) else tables


def merged(sensors: Sequence[Sensor], more: Sequence[Sensor]) -> tuple[Sensor, ...]:
    """Sensors with what others say of them, one table a channel."""
    found = {one.channel: one for one in sensors}
    for one in more:
        given = {key: getattr(one, key) for key in one.model_fields_set}
        old = found.get(one.channel)
        found[one.channel] = one if old is None else old.model_copy(update=given)
    return tuple(found.values())


def changes(
    rig: Rig,
    cylinders: Sequence[str],
    channels: Sequence[str],
    records: Sequence[Record],
    given: Sequence[str],
    uppers: Given,
) -> list[Change]:
    """Everything that is likely, the likelier first.

    Args:
        rig: as it is.
        cylinders: that are commanded.
        channels: that are compared.
        records: of the logs.
        given: parameters that are free already.
        uppers: bounds that the recipe has.
    """
    known = rig.parameters()
    found: list[Change] = []
    for cylinder in (one for one in rig.cylinder if one.name in cylinders):
        moved = [valve for valve in cylinder.valve if _moves(cylinder, valve, records)]
        for valve in moved:
            alike = [one for one in moved if one.series == valve.series]
            found += _of_valve(rig, cylinder, valve, alike, records)
        found += _together(found, [f"{cylinder.name}.{one.name}" for one in moved])
        found += _drives(cylinder, moved, records)
        found += _of_cylinder(rig, cylinder)
    found += _of_oil(rig, records)
    found += _of_sensors(rig, cylinders, channels, records)
    found += [_mount(rig, c) for c in rig.cylinder if c.name in cylinders and c.mount is None]
    found += [_sway(rig, c) for c in rig.cylinder if c.name in cylinders and c.sway is None]
    kept: list[Change] = []
    for one in found:
        names = tuple(name for name in one.parameters if name not in given)
        bare = not names and not one.sensors
        again = one.alter is None and any(
            (one.kind, names, one.sensors) == (old.kind, old.parameters, old.sensors)
            for old in kept
        )
        if bare or again or any(name not in known for name in names if one.alter is None):
            continue
        bounded = {name: one.upper[name] for name in names if name in one.upper}
        bounded = {
            name: most
            for name, most in bounded.items()
            if name not in uppers and (name not in known or known[name].upper is None)
        }
        simpler = next((old for old in kept if one.simpler and old.name == one.simpler.name), None)
        kept.append(replace(one, parameters=names, upper=bounded, simpler=simpler))
    return kept


def _table_of(tables: dict[str, Any], cylinder: str, valve: str = "") -> dict[str, Any]:
    own = next(one for one in tables["cylinder"] if one["name"] == cylinder)
    return next(one for one in own["valve"] if one["name"] == valve) if valve else own


def _moves(cylinder: Cylinder, valve: Valve, records: Sequence[Record]) -> bool:
    """Whether a valve is commanded in a log."""
    channel = f"{cylinder.name}.{valve.name}.command"
    logs = [log[channel] for log in records if channel in log]
    return any(float(y.max() - y.min()) > least_change(valve) for y in logs)


def _of_valve(
    rig: Rig, cylinder: Cylinder, valve: Valve, alike: Sequence[Valve], records: Sequence[Record]
) -> Iterator[Change]:
    """What may be wrong with a valve; what may be with the dynamics that it shares with others
    ``alike`` stands with the first of them.
    """
    known, about = rig.parameters(), f"{cylinder.name}.{valve.name}"
    channel = f"{about}.command"
    logs = [log[channel] for log in records if channel in log]
    edges = [(f"{cylinder.name}.{valve.edge_name(one)}", one) for one in valve.edge]
    gains = [f"{name}.{key}" for name, _ in edges for key in GAINS if f"{name}.{key}" in known]
    maps = [f"{name}.map_factor" for name, one in edges if one.law == "map"]
    if gains or maps:
        yield Change("gain", about, tuple(gains or maps))
    reach = {sign: max((float((sign * y).max()) for y in logs), default=0.0) for sign in (1, -1)}
    bands = {f"{name}.deadband": SHUTS * reach[e.sign] for name, e in edges if e.law != "map"}
    bands = {name: most for name, most in bands.items() if name in known and most > 0.0}
    if bands:
        start = {name: max(float(known[name]), 0.02 * most) for name, most in bands.items()}
        yield Change("deadband", about, tuple(bands), (start,), bands)
    yield from _underlap(cylinder.name, valve, reach)
    yield from _preload(rig, cylinder, about, [name for name, e in edges if e.to == "tank"])
    plain = [(i, name, e) for i, (name, e) in enumerate(edges) if e.law == "orifice"]
    plain = [one for one in plain if reach[one[2].sign] > 0.0]
    if plain:
        yield _saturation(rig, cylinder.name, valve, plain, reach)
    bent = [(i, name, e) for i, (name, e) in enumerate(edges) if e.law == "saturating"]
    bent = [one for one in bent if one[2].saturation_softness is None]
    if bent:
        yield _softness(cylinder.name, valve, bent)
    if valve is alike[0]:
        yield from _times(rig, cylinder.name, alike)
    if float(valve.command_min) < 0.0:
        neutral = Sensor(channel=channel, offset=ESTIMATE)
        yield Change("neutral", about, sensors=(neutral,))
        yield Change(TURNED, about, sensors=(Sensor(channel=channel, sign=-1),))


def _preload(rig: Rig, cylinder: Cylinder, about: str, edges: Sequence[str]) -> Iterator[Change]:
    """A valve that a spring holds shut in the ways of a valve to the tank."""
    known, most = rig.parameters(), PRELOADS * _reached(rig, cylinder)
    names = [f"{one}.cracking_pressure" for one in edges if _metering(rig, one)]
    if names:
        start = {name: max(float(known[name]), 0.1 * most) for name in names}
        upper = dict.fromkeys(names, most)
        yield Change("preload", about, tuple(names), (start,), upper)


def _underlap(cylinder: str, valve: Valve, reach: Mapping[int, float]) -> Iterator[Change]:
    """Edges of a spool that are open at rest still: of one that has some for either way."""
    names = {
        f"{cylinder}.{valve.edge_name(edge)}.underlap": (i, SHUTS * reach[edge.sign])
        for i, edge in enumerate(valve.edge)
        if edge_law(edge.law).has_deadband and edge.underlap is None and float(edge.deadband) == 0.0
    }
    if len(names) < len(valve.edge) or min(reach.values()) <= 0.0:
        return
    if {edge.sign for edge in valve.edge} != {1, -1}:
        return

    def alter(tables: dict[str, Any]) -> None:
        table = _table_of(tables, cylinder, valve.name)
        for i, most in names.values():
            table["edge"][i]["underlap"] = f"{LAPS * most!r} V"

    lines = tuple(f"edge {name.rpartition('.')[0]}: underlap = … V" for name in names)
    upper = {name: most for name, (_, most) in names.items()}
    start = {name: LAPS * most for name, most in upper.items()}
    about = f"{cylinder}.{valve.name}"
    yield Change("underlap", about, tuple(names), (start,), upper, alter=alter, rig_lines=lines)


def _metering(rig: Rig, edge: str) -> bool:
    """Whether an edge is one that a command opens, not a pump."""
    return edge_law(rig.all_edges()[edge].law).metering


def _together(found: Sequence[Change], valves: Sequence[str]) -> Iterator[Change]:
    """What may be wrong with every valve of a cylinder at once, as where all are of one make or on
    one driver: of each kind that all of several have, one change for all of them.
    """
    own = [one for one in found if one.about in valves and one.parameters]
    for kind in dict.fromkeys(one.kind for one in own):
        same = [one for one in own if one.kind == kind]
        if len(valves) > 1 and [one.about for one in same] == list(valves):
            yield _joined(same)


def _joined(several: Sequence[Change]) -> Change:
    """Several changes of one kind as one, each search from the same start of all."""
    first, alters = several[0], [one.alter for one in several if one.alter is not None]

    def alter(tables: dict[str, Any]) -> None:
        for each in alters:
            each(tables)

    cylinder = first.about.partition(".")[0]
    begun = zip(*(one.starts for one in several), strict=True)
    return Change(
        first.kind,
        f"{cylinder}.{'+'.join(one.about.partition('.')[2] for one in several)}",
        tuple(name for one in several for name in one.parameters),
        tuple({name: value for one in starts for name, value in one.items()} for starts in begun),
        {name: most for one in several for name, most in one.upper.items()},
        alter=alter if alters else None,
        rig_lines=tuple(line for one in several for line in one.rig_lines),
    )


def _saturation(
    rig: Rig, cylinder: str, valve: Valve, edges: Sequence[tuple], reach: Mapping[int, float]
) -> Change:
    names = {f"{name}.opening_max": (i, float(reach[edge.sign])) for i, name, edge in edges}

    def alter(tables: dict[str, Any]) -> None:
        table = _table_of(tables, cylinder, valve.name)
        for i, most in names.values():
            table["edge"][i] |= {"law": "saturating", "opening_max": f"{OPENS[0] * most!r} V"}

    starts = tuple({name: share * most for name, (_, most) in names.items()} for share in OPENS)
    line = 'law = "saturating", opening_max = … V'
    lines = tuple(f"edge {name.rpartition('.')[0]}: {line}" for name in names)
    upper = {name: 1.2 * most for name, (_, most) in names.items()}
    about = f"{cylinder}.{valve.name}"
    return Change("saturation", about, tuple(names), starts, upper, alter=alter, rig_lines=lines)


def _drives(
    cylinder: Cylinder, valves: Sequence[Valve], records: Sequence[Record]
) -> Iterator[Change]:
    """Drives that give no more beyond some command, so that what follows them is late for less:
    each alone, and all of a cylinder. Where every command is as large as the next, no log tells
    that from a lower gain, which is likelier.
    """
    reach, plain = {}, []
    for valve in valves:
        name = f"{cylinder.name}.{valve.name}"
        logs = [abs(log[f"{name}.command"]) for log in records if f"{name}.command" in log]
        sizes = np.concatenate(logs)
        reach[name] = float(sizes.max())
        less, more = (share * reach[name] for share in BETWEEN)
        told = np.mean((sizes > less) & (sizes < more)) > SOME * np.mean(sizes > less)
        if told and valve.drive_limit is None and valve.given[0] <= 0.0 <= valve.given[1]:
            plain.append(name)
    each = [_drive([name], reach) for name in plain]
    yield from each
    if len(each) > 1 and len(each) == len(valves):
        yield _drive(plain, reach)


def _drive(valves: Sequence[str], reach: Mapping[str, float]) -> Change:
    """Valves whose drives give no more than some share of the largest command."""
    names = {f"{valve}.drive_limit": reach[valve] for valve in valves}

    def alter(tables: dict[str, Any]) -> None:
        for valve in valves:
            cylinder, _, own = valve.partition(".")
            table = _table_of(tables, cylinder, own)
            table["drive_limit"] = f"{OPENS[0] * reach[valve]!r} V"

    cylinder = valves[0].partition(".")[0]
    about = f"{cylinder}.{'+'.join(one.partition('.')[2] for one in valves)}"
    return Change(
        "saturation",
        f"the drive of {about}",
        tuple(names),
        tuple({name: share * most for name, most in names.items()} for share in OPENS),
        {name: 1.2 * most for name, most in names.items()},
        alter=alter,
        rig_lines=tuple(f"valve {valve}: drive_limit = … V" for valve in valves),
    )


def _softness(cylinder: str, valve: Valve, edges: Sequence[tuple]) -> Change:
    """Edges that saturate bit by bit."""
    most = {
        f"{name}.saturation_softness": (i, float(e.opening_max) - float(e.deadband))
        for i, name, e in edges
    }

    def alter(tables: dict[str, Any]) -> None:
        table = _table_of(tables, cylinder, valve.name)
        for i, wide in most.values():
            table["edge"][i]["saturation_softness"] = f"{SOFT * wide!r} V"

    lines = tuple(f"edge {name.rpartition('.')[0]}: saturation_softness = … V" for name in most)
    upper = {name: 0.5 * wide for name, (_, wide) in most.items()}
    about = f"{cylinder}.{valve.name}"
    return Change("softness", about, tuple(most), upper=upper, alter=alter, rig_lines=lines)


def _times(rig: Rig, cylinder: str, valves: Sequence[Valve]) -> Iterator[Change]:
    """Lags and delays between the commands of valves with the same dynamics and their openings:
    they share them.
    """
    known, series = rig.parameters(), valves[0].series
    own = {kind: [f"{o}.{kind}" for o in series if f"{o}.{kind}" in known] for kind in TIMES}
    for kind in TIMES[:3]:
        for name in own[kind]:
            yield Change("lag", name.rpartition(".")[0], (name,))
    if not any(own[kind] for kind in TIMES[:3]):
        yield _element(cylinder, valves, "lag", "first_order", LAG)
    if own["delay"]:
        yield Change("delay", f"{cylinder}.{valves[0].name}", tuple(own["delay"]))
    else:
        yield _element(cylinder, valves, "delay", "delay", DELAY)


def _element(cylinder: str, valves: Sequence[Valve], word: str, kind: str, value: float) -> Change:
    """An element that comes behind those which valves have, one for all of them."""
    several, series = len(valves) > 1, valves[0].series
    about = f"{cylinder}.{'+'.join(one.name for one in valves)}"
    name = f"{cylinder}_{word}" if several else f"{cylinder}_{valves[0].name}_{word}"

    def alter(tables: dict[str, Any]) -> None:
        dynamics = tables.setdefault("dynamics", {})
        dynamics[name] = {"kind": kind, word: f"{value!r} s"}
        for one in valves:
            _table_of(tables, cylinder, one.name)["dynamics"] = [*series, name]

    listed = ", ".join(f'"{one}"' for one in (*series, name))
    lines = (
        f'[dynamics.{name}] kind = "{kind}", {word} = "{1e3 * value:g} ms"',
        *(f"valve {cylinder}.{one.name}: dynamics = [{listed}]" for one in valves),
    )
    free = f"{name}.{word}"
    upper = {free: LONGEST}
    return Change(word, about, (free,), upper=upper, alter=alter, rig_lines=lines)


def _of_cylinder(rig: Rig, cylinder: Cylinder) -> Iterator[Change]:
    known, name = rig.parameters(), cylinder.name
    area, pressure = cylinder.areas()[0], _reached(rig, cylinder)
    most, rubs = LEAKS * area * 0.01 / pressure, RUBS * area * pressure
    for key in LOSSES:
        upper = {f"{name}.{key}": most}
        yield Change("leakage", f"{name}.{key}", (f"{name}.{key}",), upper=upper)
    coulomb = f"{name}.friction_coulomb"
    some = {coulomb: max(float(cylinder.friction_coulomb), 0.02 * rubs)}
    friction = Change("friction", name, (coulomb,), (some,), {coulomb: rubs})
    yield friction
    for key in ("damping", "joint_damping"):
        if (one := f"{cylinder.joint}.{key}") in known:
            start = {} if float(known[one]) > 0.0 else {one: 1.0}
            yield Change("damping", cylinder.joint, (one,), (start,))
    yield Change("load", cylinder.joint, (f"{cylinder.joint}.mass",))
    if cylinder.friction is None:
        yield replace(_stribeck(rig, cylinder, rubs), simpler=friction)


def _reached(rig: Rig, cylinder: Cylinder) -> float:
    """What pressure [Pa] an end of a cylinder comes to: the supply's, or what a pump of its own may
    come up to.
    """
    supply, relief = max(float(rig.supply.pressure), 1.0e6), cylinder.relief_pressure
    return supply if cylinder.pump is None or relief is None else max(supply, float(relief))


def _stribeck(rig: Rig, cylinder: Cylinder, most: float) -> Change:
    name, level = cylinder.name, max(float(cylinder.friction_coulomb), 0.02 * most)

    def alter(tables: dict[str, Any]) -> None:
        table = _table_of(tables, name)
        table["friction_coulomb"] = f"{level!r} N"
        table["friction"] = {
            "law": "stribeck",
            "friction_static": f"{1.5 * level!r} N",
            "stribeck_speed": "20 mm/s",
        }

    parameters = (f"{name}.friction_coulomb", f"{name}.friction_static")
    static = rig.shown("friction_static", 1.5 * level, 5)
    lines = (
        f'[cylinder.friction] of {name}: law = "stribeck", friction_static = "{static}", '
        'stribeck_speed = "20 mm/s"',
    )
    upper = dict.fromkeys(parameters, most)
    return Change("friction law", name, parameters, upper=upper, alter=alter, rig_lines=lines)


def _mount(rig: Rig, cylinder: Cylinder) -> Change:
    """A mount that is stiffer than the oil behind it by some."""
    name, stiff = cylinder.name, 4.0 * _oil_spring(rig, cylinder)

    def alter(tables: dict[str, Any]) -> None:
        _table_of(tables, name)["mount"] = {"stiffness": _no_faster(stiff, "N/m", 1)}

    line = f'[cylinder.mount] of {name}: stiffness = "{rig.shown("stiffness", stiff, 5)}"'
    free = f"{name}.mount.stiffness"
    return Change("mount", name, (free,), alter=alter, rig_lines=(line,))


def _no_faster(value: float, unit: str, faster: int) -> dict[str, str]:
    """A value [SI] as a rig file has it, with bounds: near where it makes a motion faster, which a
    larger value does where ``faster`` is 1, a smaller where it is −1.
    """
    down, up = (WIDE, STIFFER) if faster > 0 else (STIFFER, WIDE)
    each = {"value": value, "lower": value / down, "upper": value * up}
    return {key: f"{one!r} {unit}" for key, one in each.items()}


def _oil_spring(rig: Rig, cylinder: Cylinder) -> float:
    """Stiffness [N/m] of the oil at both sides of a piston in the middle of its stroke."""
    head, rod = cylinder.areas()
    half = 0.5 * float(cylinder.stroke)
    bulk = float(cylinder.bulk_modulus or rig.oil.bulk_modulus)
    ends = (
        (head, float(cylinder.volume_head) + half * head),
        (rod, float(cylinder.volume_rod) - half * rod),
    )
    return sum(bulk * area**2 / max(volume, 1e-9) for area, volume in ends)


def _sway(rig: Rig, cylinder: Cylinder) -> Change:
    """Part of the load on a spring, as stiff as the oil, or by some softer or stiffer."""
    name, index = cylinder.name, rig.cylinder.index(cylinder)
    mass = SWAYS * load_of(rig, index)
    values = [
        {"mass": mass, "stiffness": stiff, "damping": 0.2 * (stiff * mass) ** 0.5}
        for stiff in (share * _oil_spring(rig, cylinder) for share in SPRINGS)
    ]
    units = {"mass": "kg", "stiffness": "N/m", "damping": "N*s/m"}
    written = {
        key: _no_faster(values[0][key], unit, -1 if key == "mass" else 1)
        for key, unit in units.items()
    }

    def alter(tables: dict[str, Any]) -> None:
        _table_of(tables, name)["sway"] = dict(written)

    said_of = ", ".join(f'{key} = "{rig.shown(key, values[0][key], 5)}"' for key in units)
    return Change(
        "sway",
        name,
        tuple(f"{name}.sway.{key}" for key in units),
        tuple({f"{name}.sway.{key}": value for key, value in one.items()} for one in values),
        alter=alter,
        rig_lines=(f"[cylinder.sway] of {name}: {said_of}",),
    )


def _of_oil(rig: Rig, records: Sequence[Record]) -> Iterator[Change]:
    yield Change("bulk modulus", "the oil", ("bulk_modulus",))
    if not all("p_supply" in log for log in records):
        yield Change("supply", "the supply", ("supply.pressure",))
    if rig.oil.air_fraction is None:

        def alter(tables: dict[str, Any]) -> None:
            tables["oil"]["air_fraction"] = AIR

        lines = (f"[oil] air_fraction = {AIR:g}",)
        upper = {"air_fraction": MOST_AIR}
        yield Change("air", "the oil", ("air_fraction",), upper=upper, alter=alter, rig_lines=lines)


def _of_sensors(
    rig: Rig, cylinders: Sequence[str], channels: Sequence[str], records: Sequence[Record]
) -> Iterator[Change]:
    recorded = [one if all(one in log for log in records) else position_of(one) for one in channels]
    for channel in dict.fromkeys(one for one in recorded if all(one in log for log in records)):
        words = ("offset", "scale", "lag") if channel in channels else ("scale", "lag")
        for word in words:
            sensor = Sensor.model_validate({"channel": channel, word: ESTIMATE})
            yield Change(f"sensor {word}", channel, sensors=(sensor,))
        yield Change(TURNED, channel, sensors=(Sensor(channel=channel, sign=-1),))
