"""The fault table: what may be wrong with a rig's model, with commands and with sensors.

Each part of the plant declares its rows (`ehbench.parts.fault`); those of commands and sensors
stand here. `hypotheses` applies the rows to a rig and its logs. Residual diagnosis, the sensitivity
to fixed parameters and ``--suggest`` read what it gives, and no other list of faults exists.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ehbench.config.rig import Cylinder, Joint, LinkLoad, Pins, Rack, Rig, Slide
from ehbench.config.rig.cylinder import Force
from ehbench.config.rig.supply import Accumulator, Oil, Supply
from ehbench.config.rig.valves import Edge, FixedEdge, Valve
from ehbench.data.record import Record
from ehbench.diagnosis.faults.hypothesis import Hypothesis, Number, joined
from ehbench.diagnosis.faults.scales import Scales
from ehbench.parts import (
    accumulator,
    cylinder,
    edge,
    friction,
    line,
    load,
    mount,
    oil,
    supply,
    sway,
    valve,
)
from ehbench.parts.edge import edge_law
from ehbench.parts.fault import Amount, Fault
from ehbench.parts.line import Line
from ehbench.parts.valve import delay, first_order, second_order
from ehbench.parts.valve.law import DynamicsTable
from ehbench.plant.build import Maps, map_of
from ehbench.plant.ties import supplied
from ehbench.preprocessing.observations import least_change, payload_of, position_of, read_off

__all__ = ["TABLE", "Hypothesis", "hypotheses"]

# δ of an offset counts spreads of the channel, or largest commands; that of a sign is -2
LAG = Fault("sensor lag", ("lag",), "second", 0.002, 0.0, 0.1, rank=5)
SENSORS = (
    Fault("sensor offset", ("offset",), "spread", low=-3.0, high=3.0, rank=4),
    Fault("sensor scale", ("scale",), "unit", low=-0.7, high=2.0, rank=5),
    LAG,
    Fault("sensor sign", ("scale",), "unit", 0.0, -2.0, 0.0, (-2.0,), rank=6),
)
COMMANDS = (
    Fault("neutral", ("offset",), "command", 0.005, -0.2, 0.2, rank=5),
    Fault("command sign", ("scale",), "unit", 0.0, -2.0, 0.0, (-2.0,), rank=7),
)
LATE = Fault("late command", ("delay",), "second", 0.001, -0.05, 0.0, (-0.01, -0.02, -0.04), rank=5)
DRIFT = Fault("drift", ("drift",), "unit", low=-0.6, high=1.0, rank=6)
TABLE: dict[type, tuple[Fault, ...]] = {
    Oil: oil.FAULTS,
    Supply: supply.FAULTS,
    Accumulator: accumulator.FAULTS,
    Joint: load.FAULTS,
    Slide: load.FAULTS,
    Force: load.FAULTS,
    LinkLoad: load.PAYLOAD,
    Cylinder: (
        *friction.FAULTS,
        *cylinder.FAULTS,
        *mount.FAULTS,
        *sway.FAULTS,
        load.PUSH,
        load.SPRING,
    ),
    Pins: cylinder.LINKAGE,
    Rack: cylinder.LINKAGE,
    Line: line.FAULTS,
    Valve: (*valve.FAULTS, *valve.SPOOL),
    DynamicsTable: (*second_order.FAULTS, *first_order.FAULTS),
    Edge: edge.FAULTS,
    FixedEdge: edge.FAULTS,
}


def hypotheses(
    rig: Rig,
    cylinders: Sequence[str],
    channels: Sequence[str],
    records: Sequence[Record],
    maps: Maps | None = None,
) -> list[Hypothesis]:
    """All that may be wrong with a rig's model of some cylinders and with their channels.

    Args:
        rig: of the model.
        cylinders: that are commanded.
        channels: that are compared.
        records: of the logs.
        maps: measured flow maps by edge name.
    """
    table = _Rows(rig, [c for c in rig.cylinder if c.name in cylinders], records, maps)
    results = [*table.of_parts(), *table.of_commands(), *table.of_sensors(channels)]
    if rig.model is not None:  # of which nobody knows more than its sensors and what it takes
        taken = {*rig.model.settable}
        results = [item for item in results if item.readings or not item.edits]
        results = [item for item in results if {*item.parameters} <= taken]
    # of two that do the same the one that concerns more comes last, and stays
    return list({(item.kind, item.about): item for item in results}.values())


class _Rows:
    """The rows of the table as they apply to a rig and its logs."""

    def __init__(
        self, rig: Rig, cylinders: Sequence[Cylinder], records: Sequence[Record], maps: Maps | None
    ) -> None:
        self.rig, self.known, self.records, self.maps = rig, rig.parameters(), records, maps
        self.cylinders = cylinders
        self.moved = {
            cylinder.name: [v for v in cylinder.valve if self._moves(cylinder, v)]
            for cylinder in cylinders
        }

    def of_parts(self) -> Iterator[Hypothesis]:
        """Of each part, of the edges of a valve together, of the valves of a cylinder together."""
        together: dict[tuple[Any, ...], dict[str, list[Hypothesis]]] = {}
        for prefix, place, part in self.rig.parts():
            base = DynamicsTable if isinstance(part, DynamicsTable) else type(part)
            if base not in TABLE or (scales := self._scales(prefix, place, part)) is None:
                continue
            for fault in TABLE[base]:
                item = self._row(fault, prefix, place, part, scales)
                if item is None:
                    continue
                if not fault.joined or scales.valve is None:
                    yield item
                    yield from self._laden(item, scales)
                    continue
                owner = scales.cylinder.name
                per_valve = together.setdefault((fault.kind, owner, fault.keys), {})
                per_valve.setdefault(f"{owner}.{scales.valve.name}", []).append(item)
        for (kind, owner, _), by_valve in together.items():
            wholes = []
            for name, parts in by_valve.items():
                about = parts[0].about if kind == "saturation" and len(parts) == 1 else name
                if len(parts) > 1:
                    yield from (replace(item, alike=True) for item in parts)
                wholes.append(joined(parts, about))
            yield from wholes
            if len(wholes) > 1 and len(wholes) == len(self.moved[owner]):
                names = "+".join(name.partition(".")[2] for name in by_valve)
                drive = "the drive of " if wholes[0].about.startswith("the drive") else ""
                yield joined(wholes, f"{drive}{owner}.{names}")

    def _laden(self, item: Hypothesis, scales: Scales) -> Iterator[Hypothesis]:
        """A load of a link together with the masses that payloads of the logs state with it: a link
        that was weighed wrongly is in each of them, by as many kilograms.
        """
        loads = dict.fromkeys(payload_of(log) for log in self.records if item.kind == "load")
        names = [f"{load}.{name}" for name in item.parameters for load in loads]
        with_it = [
            Number.of(item.row, "mass", name, self.known[name], scales)
            for name in names
            if name in self.known
        ]
        if with_it:
            more = (replace(number, unit=item.numbers[0].unit) for number in with_it)
            about = f"{item.about}, also under loads"
            yield replace(item, about=about, numbers=(*item.numbers, *more))

    def of_commands(self) -> Iterator[Hypothesis]:
        """Of what lies between recorded commands and valves."""
        for owner in self.cylinders:
            valves = self.moved[owner.name]
            for item in valves:
                about = f"{owner.name}.{item.name}"
                scales = Scales(self.rig, owner, item, self.records)
                for fault in COMMANDS if float(item.command_min) < 0.0 else ():
                    yield self._reading(fault, f"{about}.command", scales, about)
            for alike in {item.series: item for item in valves}:
                same = [item for item in valves if item.series == alike]
                yield from self._times(owner, same)
            if valves:
                names = [f"{owner.name}.{item.name}.command" for item in valves]
                readings = tuple((name, "drift", 1.0) for name in names)
                yield Hypothesis(DRIFT, _about(owner, valves), readings=readings)

    def of_sensors(self, channels: Sequence[str]) -> Iterator[Hypothesis]:
        """Of the sensors of what is compared; a rate that is derived from a position is read by the
        sensor of that, whose offset shows where a posture has weight and levers of its own.
        """
        linked = [owner.name for owner in self.cylinders if owner.linkage]
        for channel in channels:
            direct = all(channel in log for log in self.records)
            seen = channel if direct else position_of(channel)
            if all(seen in log for log in self.records):
                scales = Scales(self.rig, None, None, self.records, seen)
                shown = direct or seen.partition(".")[0] in linked
                for fault in SENSORS[0 if shown else 1 :]:
                    yield self._reading(fault, seen, scales, seen)
        for owner in self.cylinders:  # whose amplifiers have one filter
            ends = [f"{owner.name}.{word}" for word in ("p_head", "p_rod")]
            if all(end in log for end in ends for log in self.records) and {*ends} <= {*channels}:
                readings = tuple((end, "lag", 1.0) for end in ends)
                about = f"{owner.name}.p_head+p_rod"
                yield Hypothesis(LAG, about, readings=readings, cylinder=owner.name)

    def _reading(self, fault: Fault, channel: str, scales: Scales, about: str) -> Hypothesis:
        owner = channel.rpartition(".")[0].partition(".")[0]
        (word,) = fault.keys
        reading = (channel, word, scales[fault.unit])
        return Hypothesis(fault, about, readings=(reading,), cylinder=owner)

    def _moves(self, owner: Cylinder, item: Valve) -> bool:
        """Whether a valve is commanded in a log."""
        channel = f"{owner.name}.{item.name}.command"
        logs = [log[channel] for log in self.records if channel in log]
        return any(float(np.ptp(y)) > least_change(item) for y in logs)

    def _scales(self, prefix: str, place: tuple[Any, ...], part: Any) -> Scales | None:
        """What amounts of a part are measured by; None where no log shows the part."""
        if place[0] == "cylinder":
            owner = self.rig.cylinder[place[1]]
            valve = owner.valve[place[3]] if "valve" in place else None
            shown = owner in self.cylinders and (valve is None or valve in self.moved[owner.name])
            return Scales(self.rig, owner, valve, self.records, part=part) if shown else None
        if place[0] == "supply" and all(supplied(log) for log in self.records):
            return None
        carried = {("payload", payload_of(log)) for log in self.records}
        wide = place[0] in ("oil", "supply") or place[:2] in carried
        name = prefix.removesuffix(".")
        for owner in self.cylinders:
            series = [item for valve in self.moved[owner.name] for item in valve.series]
            if wide or name in (owner.joint, *series):
                return Scales(self.rig, owner, None, self.records, part=part)
        return None

    def _row(
        self, fault: Fault, prefix: str, place: tuple[Any, ...], part: Any, scales: Scales
    ) -> Hypothesis | None:
        """A row of a part; None where it does not apply."""
        names = tuple(f"{prefix}{key}" for key in fault.keys)
        if any(read_off(name, self.records) for name in names):
            return None
        if not self._applies(fault, prefix, part, scales):
            return None
        adds = bool(fault.adds)
        given = [name.rpartition(".")[2] in fault.adds or name in self.known for name in names]
        if not all(given):
            return None
        there = getattr(part, fault.table) if adds and fault.table else None
        if adds and (scales.empty or there):
            return None
        numbers = tuple(
            Number.of(fault, key, name, self.known.get(name), scales)
            for key, name in zip(fault.keys, names, strict=True)
        )
        edits = ()
        if adds:
            has = {k for k in fault.keys if f"{prefix}{k}" in self.known}  # stays as it is
            new = {key: item for key, item in fault.adds.items() if key not in has}
            content = {key: scales.written(item) for key, item in new.items()}
            also = {
                key: scales.written(Amount((1.0,), "friction", "N"))
                for key in fault.keys
                if key == "friction_coulomb"
            }
            content = {fault.table: [content]} if there == () else content
            edits = ((place, fault.table, content, also),)
        about = self._about(prefix, part, fault, names)
        owner = "" if fault.wide else scales.cylinder.name
        return Hypothesis(fault, about, numbers, (), edits, owner)

    def _about(self, prefix: str, part: Any, fault: Fault, names: Sequence[str]) -> str:
        """What a fault is about, in words: a part, or a number of it where several are alike."""
        if isinstance(part, Oil | Supply | Accumulator):
            return f"the {type(part).__name__.lower()}"
        if isinstance(part, Valve) and fault.kind == "saturation":
            return f"the drive of {prefix.removesuffix('.')}"
        rows = [row for row in TABLE.get(type(part), ()) if row.kind == fault.kind and not row.adds]
        alike = [row for row in rows if f"{prefix}{row.keys[0]}" in self.known]
        return names[0] if len(alike) > 1 and not fault.joined else prefix.removesuffix(".")

    def _applies(self, fault: Fault, prefix: str, part: Any, scales: Scales) -> bool:
        """Whether a row is of a part: of the law that an edge goes by; of a valve what its drive
        gives where commands of several sizes show it, an overlap of a spool that opens to both
        sides by laws with deadbands.
        """
        if isinstance(part, Valve) and fault not in valve.SPOOL:
            return scales.graded
        if isinstance(part, Valve):
            names = [f"{scales.cylinder.name}.{part.edge_name(edge)}" for edge in part.edge]
            laws = all(edge_law(edge.law).has_deadband for edge in part.edge)
            mapped = any(map_of(self.maps, name) is not None for name in names)
            return laws and not mapped and len({edge.sign for edge in part.edge}) == 2
        if not isinstance(part, Edge | FixedEdge):
            return True
        name = prefix.removesuffix(".")
        law = "map" if map_of(self.maps, name) is not None else part.law
        key, rules = fault.keys[0], edge_law(law)
        if fault.law:
            return fault.law == law
        if key == "cracking_pressure":
            return rules.metering and part.to == "tank"
        underlaps = f"{name}.underlap" in self.known
        return rules.has_deadband and not (key == "deadband" and underlaps)

    def _times(self, owner: Cylinder, valves: Sequence[Valve]) -> Iterator[Hypothesis]:
        """A delay, and a lag where they have none, between the commands of valves with the same
        dynamics and their openings, or commands that were written late: they share it.
        """
        first, *others = valves
        series, about = first.series, _about(owner, valves)
        commands = [f"{owner.name}.{item.name}.command" for item in valves]
        scales = Scales(self.rig, owner, first, self.records)
        late = tuple((name, "delay", 1.0) for name in commands)
        yield Hypothesis(LATE, about, readings=late, cylinder=owner.name)
        for fault in delay.FAULTS:
            (key,) = fault.keys
            names = [f"{item}.{key}" for item in series if f"{item}.{key}" in self.known]
            slow = any(f"{item}.natural_frequency" in self.known for item in series)
            if key == "lag" and (names or slow):
                continue
            readings = tuple((name, key, 1.0) for name in commands) if fault.step else ()
            if names:
                numbers = tuple(
                    Number.of(replace(fault, adds={}), key, n, self.known[n], scales) for n in names
                )
                yield Hypothesis(fault, about, numbers, readings, cylinder=owner.name)
                continue
            short = "" if others else first.name
            name = "_".join(filter(None, (owner.name, short, key)))
            content = {key: scales.written(item) for key, item in fault.adds.items()}
            edits: list[Any] = [(("dynamics",), name, content, {})]
            index = self.rig.cylinder.index(owner)
            for item in valves:
                place = ("cylinder", index, "valve", owner.valve.index(item))
                edits.append((place, "", {"dynamics": [*series, name]}, {}))
            number = Number.of(fault, key, f"{name}.{key}", None, scales)
            yield Hypothesis(fault, about, (number,), readings, tuple(edits), owner.name)


def _about(owner: Cylinder, valves: Sequence[Valve]) -> str:
    return f"{owner.name}.{'+'.join(item.name for item in valves)}"
