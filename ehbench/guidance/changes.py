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
        requested = sum(sensor[word] is not None for sensor in self.sensors for word in WORDS)
        return len(self.parameters) + requested

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
            lines.append(
                "parameters: add " + ", ".join(f'"{parameter}"' for parameter in self.parameters)
            )
        for name, value in self.upper.items():
            lines.append(f'[upper] "{name}" = "{rig.shown(name, value, 5)}"')
        for sensor in self.sensors:
            words = ", ".join(f'{word} = "{ESTIMATE}"' for word in WORDS if sensor[word])
            words = words or f"sign = {sensor.sign}"
            lines.append(f'[[sensor]] channel = "{sensor.channel}", {words}')
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
    return [_lists(table) for table in tables] if isinstance(tables, list | tuple) else tables


def merged(sensors: Sequence[Sensor], more: Sequence[Sensor]) -> tuple[Sensor, ...]:
    """Sensors with what others say of them, one table a channel."""
    results = {sensor.channel: sensor for sensor in sensors}
    for item in more:
        given = {key: getattr(item, key) for key in item.model_fields_set}
        old = results.get(item.channel)
        results[item.channel] = item if old is None else old.model_copy(update=given)
    return tuple(results.values())


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
    results: list[Change] = []
    for cylinder in (item for item in rig.cylinder if item.name in cylinders):
        moved = [valve for valve in cylinder.valve if _moves(cylinder, valve, records)]
        for valve in moved:
            alike = [item for item in moved if item.series == valve.series]
            results += _of_valve(rig, cylinder, valve, alike, records)
        results += _together(results, [f"{cylinder.name}.{item.name}" for item in moved])
        results += _drives(cylinder, moved, records)
        results += _of_cylinder(rig, cylinder)
    results += _of_oil(rig, records)
    results += _of_sensors(rig, cylinders, channels, records)
    results += [_mount(rig, c) for c in rig.cylinder if c.name in cylinders and c.mount is None]
    results += [_sway(rig, c) for c in rig.cylinder if c.name in cylinders and c.sway is None]
    retained: list[Change] = []
    for item in results:
        names = tuple(name for name in item.parameters if name not in given)
        bare = not names and not item.sensors
        again = item.alter is None and any(
            (item.kind, names, item.sensors) == (old.kind, old.parameters, old.sensors)
            for old in retained
        )
        if bare or again or any(name not in known for name in names if item.alter is None):
            continue
        bounded = {name: item.upper[name] for name in names if name in item.upper}
        bounded = {
            name: maximum
            for name, maximum in bounded.items()
            if name not in uppers and (name not in known or known[name].upper is None)
        }
        simpler = next(
            (old for old in retained if item.simpler and old.name == item.simpler.name), None
        )
        retained.append(replace(item, parameters=names, upper=bounded, simpler=simpler))
    return retained


def _table_of(tables: dict[str, Any], cylinder: str, valve: str = "") -> dict[str, Any]:
    own = next(item for item in tables["cylinder"] if item["name"] == cylinder)
    return next(item for item in own["valve"] if item["name"] == valve) if valve else own


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
    edges = [(f"{cylinder.name}.{valve.edge_name(item)}", item) for item in valve.edge]
    gains = [f"{name}.{key}" for name, _ in edges for key in GAINS if f"{name}.{key}" in known]
    maps = [f"{name}.map_factor" for name, item in edges if item.law == "map"]
    if gains or maps:
        yield Change("gain", about, tuple(gains or maps))
    reach = {sign: max((float((sign * y).max()) for y in logs), default=0.0) for sign in (1, -1)}
    bands = {f"{name}.deadband": SHUTS * reach[e.sign] for name, e in edges if e.law != "map"}
    bands = {name: band for name, band in bands.items() if name in known and band > 0.0}
    if bands:
        start = {name: max(float(known[name]), 0.02 * band) for name, band in bands.items()}
        yield Change("deadband", about, tuple(bands), (start,), bands)
    yield from _underlap(cylinder.name, valve, reach)
    yield from _preload(rig, cylinder, about, [name for name, e in edges if e.to == "tank"])
    plain = [(i, name, e) for i, (name, e) in enumerate(edges) if e.law == "orifice"]
    plain = [item for item in plain if reach[item[2].sign] > 0.0]
    if plain:
        yield _saturation(rig, cylinder.name, valve, plain, reach)
    bent = [(i, name, e) for i, (name, e) in enumerate(edges) if e.law == "saturating"]
    bent = [item for item in bent if item[2].saturation_softness is None]
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
    known, maximum = rig.parameters(), PRELOADS * _reached(rig, cylinder)
    names = [f"{edge}.cracking_pressure" for edge in edges if _metering(rig, edge)]
    if names:
        start = {name: max(float(known[name]), 0.1 * maximum) for name in names}
        upper = dict.fromkeys(names, maximum)
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
        for i, maximum in names.values():
            table["edge"][i]["underlap"] = f"{LAPS * maximum!r} V"

    lines = tuple(f"edge {name.rpartition('.')[0]}: underlap = … V" for name in names)
    upper = {name: maximum for name, (_, maximum) in names.items()}
    start = {name: LAPS * maximum for name, maximum in upper.items()}
    about = f"{cylinder}.{valve.name}"
    yield Change("underlap", about, tuple(names), (start,), upper, alter=alter, rig_lines=lines)


def _metering(rig: Rig, edge: str) -> bool:
    """Whether an edge is one that a command opens, not a pump."""
    return edge_law(rig.all_edges()[edge].law).metering


def _together(result: Sequence[Change], valves: Sequence[str]) -> Iterator[Change]:
    """What may be wrong with every valve of a cylinder at once, as where all are of one make or on
    one driver: of each kind that all of several have, one change for all of them.
    """
    own = [item for item in result if item.about in valves and item.parameters]
    for kind in dict.fromkeys(item.kind for item in own):
        same = [item for item in own if item.kind == kind]
        if len(valves) > 1 and [item.about for item in same] == list(valves):
            yield _joined(same)


def _joined(several: Sequence[Change]) -> Change:
    """Several changes of one kind as one, each search from the same start of all."""
    first, alters = several[0], [item.alter for item in several if item.alter is not None]

    def alter(tables: dict[str, Any]) -> None:
        for each in alters:
            each(tables)

    cylinder = first.about.partition(".")[0]
    begun = zip(*(item.starts for item in several), strict=True)
    return Change(
        first.kind,
        f"{cylinder}.{'+'.join(item.about.partition('.')[2] for item in several)}",
        tuple(name for item in several for name in item.parameters),
        tuple(
            {name: value for start in starts for name, value in start.items()} for starts in begun
        ),
        {name: maximum for item in several for name, maximum in item.upper.items()},
        alter=alter if alters else None,
        rig_lines=tuple(line for item in several for line in item.rig_lines),
    )


def _saturation(
    rig: Rig, cylinder: str, valve: Valve, edges: Sequence[tuple], reach: Mapping[int, float]
) -> Change:
    names = {f"{name}.opening_max": (i, float(reach[edge.sign])) for i, name, edge in edges}

    def alter(tables: dict[str, Any]) -> None:
        table = _table_of(tables, cylinder, valve.name)
        for i, maximum in names.values():
            table["edge"][i] |= {"law": "saturating", "opening_max": f"{OPENS[0] * maximum!r} V"}

    starts = tuple(
        {name: share * maximum for name, (_, maximum) in names.items()} for share in OPENS
    )
    line = 'law = "saturating", opening_max = … V'
    lines = tuple(f"edge {name.rpartition('.')[0]}: {line}" for name in names)
    upper = {name: 1.2 * maximum for name, (_, maximum) in names.items()}
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
        message = np.mean((sizes > less) & (sizes < more)) > SOME * np.mean(sizes > less)
        if message and valve.drive_limit is None and valve.given[0] <= 0.0 <= valve.given[1]:
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
    about = f"{cylinder}.{'+'.join(item.partition('.')[2] for item in valves)}"
    return Change(
        "saturation",
        f"the drive of {about}",
        tuple(names),
        tuple({name: share * maximum for name, maximum in names.items()} for share in OPENS),
        {name: 1.2 * maximum for name, maximum in names.items()},
        alter=alter,
        rig_lines=tuple(f"valve {valve}: drive_limit = … V" for valve in valves),
    )


def _softness(cylinder: str, valve: Valve, edges: Sequence[tuple]) -> Change:
    """Edges that saturate bit by bit."""
    maximum = {
        f"{name}.saturation_softness": (i, float(e.opening_max) - float(e.deadband))
        for i, name, e in edges
    }

    def alter(tables: dict[str, Any]) -> None:
        table = _table_of(tables, cylinder, valve.name)
        for i, wide in maximum.values():
            table["edge"][i]["saturation_softness"] = f"{SOFT * wide!r} V"

    lines = tuple(f"edge {name.rpartition('.')[0]}: saturation_softness = … V" for name in maximum)
    upper = {name: 0.5 * wide for name, (_, wide) in maximum.items()}
    about = f"{cylinder}.{valve.name}"
    return Change("softness", about, tuple(maximum), upper=upper, alter=alter, rig_lines=lines)


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
    about = f"{cylinder}.{'+'.join(valve.name for valve in valves)}"
    name = f"{cylinder}_{word}" if several else f"{cylinder}_{valves[0].name}_{word}"

    def alter(tables: dict[str, Any]) -> None:
        dynamics = tables.setdefault("dynamics", {})
        dynamics[name] = {"kind": kind, word: f"{value!r} s"}
        for valve in valves:
            _table_of(tables, cylinder, valve.name)["dynamics"] = [*series, name]

    listed = ", ".join(f'"{item}"' for item in (*series, name))
    lines = (
        f'[dynamics.{name}] kind = "{kind}", {word} = "{1e3 * value:g} ms"',
        *(f"valve {cylinder}.{valve.name}: dynamics = [{listed}]" for valve in valves),
    )
    free = f"{name}.{word}"
    upper = {free: LONGEST}
    return Change(word, about, (free,), upper=upper, alter=alter, rig_lines=lines)


def _of_cylinder(rig: Rig, cylinder: Cylinder) -> Iterator[Change]:
    known, name = rig.parameters(), cylinder.name
    area, pressure = cylinder.areas()[0], _reached(rig, cylinder)
    maximum, rubs = LEAKS * area * 0.01 / pressure, RUBS * area * pressure
    for key in LOSSES:
        upper = {f"{name}.{key}": maximum}
        yield Change("leakage", f"{name}.{key}", (f"{name}.{key}",), upper=upper)
    coulomb = f"{name}.friction_coulomb"
    some = {coulomb: max(float(cylinder.friction_coulomb), 0.02 * rubs)}
    friction = Change("friction", name, (coulomb,), (some,), {coulomb: rubs})
    yield friction
    for key in ("damping", "joint_damping"):
        if (item := f"{cylinder.joint}.{key}") in known:
            start = {} if float(known[item]) > 0.0 else {item: 1.0}
            yield Change("damping", cylinder.joint, (item,), (start,))
    yield Change("load", cylinder.joint, (f"{cylinder.joint}.mass",))
    if cylinder.friction is None:
        yield replace(_stribeck(rig, cylinder, rubs), simpler=friction)


def _reached(rig: Rig, cylinder: Cylinder) -> float:
    """What pressure [Pa] an end of a cylinder comes to: the supply's, or what a pump of its own may
    come up to.
    """
    supply, relief = max(float(rig.supply.pressure), 1.0e6), cylinder.relief_pressure
    return supply if cylinder.pump is None or relief is None else max(supply, float(relief))


def _stribeck(rig: Rig, cylinder: Cylinder, maximum: float) -> Change:
    name, level = cylinder.name, max(float(cylinder.friction_coulomb), 0.02 * maximum)

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
    upper = dict.fromkeys(parameters, maximum)
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
    return {key: f"{item!r} {unit}" for key, item in each.items()}


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
        tuple({f"{name}.sway.{key}": value for key, value in item.items()} for item in values),
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
    recorded = [
        item if all(item in log for log in records) else position_of(item) for item in channels
    ]
    for channel in dict.fromkeys(item for item in recorded if all(item in log for log in records)):
        words = ("offset", "scale", "lag") if channel in channels else ("scale", "lag")
        for word in words:
            sensor = Sensor.model_validate({"channel": channel, word: ESTIMATE})
            yield Change(f"sensor {word}", channel, sensors=(sensor,))
        yield Change(TURNED, channel, sensors=(Sensor(channel=channel, sign=-1),))
