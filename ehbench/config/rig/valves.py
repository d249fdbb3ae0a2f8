"""Metering edges, and the valves that open them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from ehbench.config.rig.names import Misplaced, Name, second
from ehbench.parts.edge import FixedLawFields, FixedLawName, LawFields, LawName, edge_law
from ehbench.parts.edge.law import EdgeLaw
from ehbench.vocabulary import VOCABULARY, UnitError, message, units
from ehbench.vocabulary.fields import FileModel, Q, Value


class Rated(FileModel):
    """A point of a data sheet: at ``command`` so much ``flow`` passes an edge, with a ``drop``
    across it where its law goes by the drop."""

    flow: Annotated[Value, Q("flow")]
    command: Annotated[Value, Q("command")]
    drop: Annotated[Value, Q("pressure_drop")] | None = None

    def gain(self, name: str, deadband: float, widest: float) -> Value:
        """The gain ``name`` of an edge that passes this: flow/((command − deadband)·√drop), no
        more of the command counting than ``widest`` [V]; for ``compensated_gain`` without the drop.

        Raises:
            Misplaced: the drop is missing or too much, nothing flows, or the edge is shut."""
        if (self.drop is None) == (name == "flow_gain"):
            words = "takes the drop across the edge" if self.drop is None else "goes by no drop"
            text = message("config.rated_flow_law", messages=words)
            raise Misplaced(text, *([] if self.drop is None else ["drop"]))
        drop = 1.0 if self.drop is None else float(self.drop)
        for key, size in (("flow", float(self.flow)), ("drop", drop)):
            if not size > 0.0:
                raise Misplaced(message("config.rated_not_positive", key=key), key)
        wide = min(abs(float(self.command)), widest) - deadband
        if not wide > 0.0:
            raise Misplaced(message("config.rated_in_deadband", deadband=deadband), "command")
        each = 1.0 / (wide * math.sqrt(drop))
        unit = f"{self.flow.unit or 'm^3/s'}/V"
        rated = f"rated {self.flow.like('flow', float(self.flow))} at {float(self.command):g} V"
        if self.drop is not None:
            unit += f"/{self.drop.unit or 'Pa'}^0.5"
            rated += f" and {self.drop.like('pressure_drop', drop)}"
        limits = {key: getattr(self.flow, key) for key in ("lower", "upper", "std")}
        limits = {key: x if x is None else x * each for key, x in limits.items()}
        source = ", ".join(filter(None, (self.flow.source, rated)))
        unit = unit if units.is_of(unit, VOCABULARY[name]) else ""
        return Value(float(self.flow) * each, self.flow.sure, source, unit=unit, **limits)


class MeteringEdge(FileModel):
    """One metering edge: flow from ``from`` to ``to`` when upstream pressure is higher.

    ``law`` is one of `ehbench.parts.edge`, which brings keys of its own. law ``map`` is a measured
    flow map, from the recipe's ``flow_maps`` or the run behind the rig; where one is given it goes
    before the other laws, too, its flow multiplied by ``map_factor``. ``sign`` −1 opens the edge on
    negative commands. ``reverse`` says what a reversed drop does: ``mirror`` or ``blocked``.
    ``cracking_pressure`` is what a valve that a spring holds shut takes in series with it.
    ``underlap`` is a deadband below zero: how far on the other side of rest the edge is open still.
    """

    name: Name | None = None
    from_: Literal["supply", "tank", "head", "rod"] = Field(alias="from")
    to: Literal["supply", "tank", "head", "rod"]
    law: LawName
    sign: Literal[1, -1] = 1
    reverse: Literal["mirror", "blocked"] = "mirror"
    deadband: Annotated[Value, Q("deadband")] = Value(0.0)
    underlap: Annotated[Value, Q("underlap")] | None = None
    cracking_pressure: Annotated[Value, Q("cracking_pressure")] = Value(0.0)
    map_factor: Annotated[Value, Q("map_factor")] = Value(1.0)
    rated: Rated | None = None


class Edge(LawFields, MeteringEdge):
    """A metering edge with the keys of its law, or a pump with a command."""

    @model_validator(mode="after")
    def _by_its_rated_point(self) -> Edge:
        """Its gain in place of the rated point, so that one number says how wide it is."""
        if self.rated is None:
            return self
        gains = {"flow_gain", "compensated_gain"} & set(edge_law(self.law).needs)
        if not gains:
            raise Misplaced(message("config.no_rated", law=self.law), "rated")
        (name,) = gains
        if getattr(self, name) is not None:
            raise Misplaced(message("config.gain_or_rated", name=name), "rated")
        widest = math.inf if self.opening_max is None else float(self.opening_max)
        try:
            gain = self.rated.gain(name, self.onset, widest)
        except Misplaced as error:
            raise Misplaced(str(error), "rated", *error.where) from None
        return self.model_copy(update={name: gain, "rated": None})

    @model_validator(mode="after")
    def _law_is_whole(self) -> Edge:
        law = edge_law(self.law)
        _must_be_whole(self, law, law.needs, set(LawFields.model_fields))
        if not law.metering and self.reverse == "blocked":
            raise Misplaced(message("config.passes_both_ways", law=self.law), "reverse")
        if not law.metering and float(self.deadband) > 0.0:
            raise Misplaced(message("config.no_deadband", law=self.law), "deadband")
        if self.underlap is not None and not law.has_deadband:
            raise Misplaced(message("config.no_underlap", law=self.law), "underlap")
        if float(self.underlap or 0.0) > 0.0 and float(self.deadband) > 0.0:
            raise Misplaced(message("config.deadband_or_underlap"), "underlap")
        if not law.metering and float(self.cracking_pressure) > 0.0:
            text = message("config.no_cracking_pressure", law=self.law)
            raise Misplaced(text, "cracking_pressure")
        if (odd := law.odd(self)) is not None:
            raise Misplaced(*odd)
        return self

    @property
    def onset(self) -> float:
        """Command [V], counted in the direction that opens it, from which on it passes oil: its
        deadband; below zero by as much as its underlap."""
        return float(self.deadband) - float(self.underlap or 0.0)

    @property
    def gain(self) -> Value | None:
        """What its flow goes with: the gain of its law."""
        needs = edge_law(self.law).needs
        return getattr(self, needs[0] if needs else "compensated_gain")


class UnmeteredEdge(FileModel):
    """An edge without a command: oil goes as the pressures have it. ``law`` is one of
    `ehbench.parts.edge`, which brings keys of its own."""

    name: Name
    from_: Literal["supply", "tank", "head", "rod"] = Field(alias="from")
    to: Literal["supply", "tank", "head", "rod"]
    law: FixedLawName


class FixedEdge(FixedLawFields, UnmeteredEdge):
    """An edge without a command, with the keys of its law."""

    @model_validator(mode="after")
    def _law_is_whole(self) -> FixedEdge:
        law = edge_law(self.law)
        _must_be_whole(self, law, law.needs_fixed, set(FixedLawFields.model_fields))
        if (self.pilot is None) != (self.pilot_ratio is None):
            raise ValueError(message("config.pilot_ratio"))
        if self.pilot == self.from_:
            raise Misplaced(message("config.pilot_at_from"), "pilot")
        return self

    @property
    def gain(self) -> Value | None:
        """What its flow goes with."""
        return self.displacement if self.law == "pump" else self.orifice_gain


def _must_be_whole(
    edge: Edge | FixedEdge, law: EdgeLaw, needs: Sequence[str], of_laws: set[str]
) -> None:
    """Refuse an edge from a node to itself, without a number that its law needs, or with one of
    the keys ``of_laws`` that only another law takes. An edge on a map may keep the gain that it
    had before it was measured."""
    if edge.from_ == edge.to:
        raise ValueError(message("config.edge_to_itself", to=edge.to))
    for need in needs:
        if getattr(edge, need) is None:
            raise ValueError(message("config.law_needs", name=law.name, need=need))
    if law.name == "map":
        return
    takes = (*needs, *law.takes)
    for key in sorted(edge.model_fields_set & of_laws - set(takes)):
        if getattr(edge, key) is not None:
            text = message("config.law_without_key", name=law.name, key=key, own=", ".join(takes))
            raise Misplaced(text, key)


class Valve(FileModel):
    """One command, its dynamics (names in the rig's ``dynamics``, from the command on, or none:
    opening follows at once) and its edges. Commands of a size beyond its ``drive_limit`` do what
    one of that size does. Of a spool ``overlap`` is added to the deadband of each edge, below zero
    an underlap; at the command ``null`` it stands in its middle."""

    name: Name
    title: str = ""
    dynamics: str | tuple[str, ...] | None = None
    command_min: Annotated[Value, Q("command_min")]
    command_max: Annotated[Value, Q("command_max")]
    drive_limit: Annotated[Value, Q("drive_limit")] | None = None
    overlap: Annotated[Value, Q("overlap")] | None = None
    null: Annotated[Value, Q("null")] | None = None
    edge: tuple[Edge, ...] = Field(min_length=1)
    calibration: tuple[tuple[str, str], ...] = ()

    @field_validator("dynamics")
    @classmethod
    def _each_once(cls, names: str | tuple[str, ...] | None) -> str | tuple[str, ...] | None:
        if isinstance(names, tuple) and (at := second(names)) is not None:
            raise ValueError(message("config.dynamics_twice", names=names[at]))
        return names

    @field_validator("calibration")
    @classmethod
    def _readable(cls, points: tuple[tuple[str, str], ...]) -> tuple[tuple[str, str], ...]:
        for at, point in enumerate(points):
            for name, text in zip(("command", "flow"), point, strict=True):
                try:
                    units.parse(text, VOCABULARY[name])
                except UnitError as error:
                    raise Misplaced(str(error), at) from None
        return points

    @model_validator(mode="after")
    def _range(self) -> Valve:
        if float(self.command_min) >= float(self.command_max):
            raise Misplaced(message("config.command_range"), "command_min")
        lowest, highest = self.given
        if self.drive_limit is not None and float(self.drive_limit) == 0.0:
            raise Misplaced(message("config.drive_zero"), "drive_limit")
        if not lowest <= self.rest <= highest:
            raise Misplaced(message("config.drive_never_rests"), "drive_limit")
        for index, edge in enumerate(self.edge):
            reach = highest if edge.sign > 0 else -lowest
            shared = "overlap" if self.overlap is not None else "null"
            if not edge_law(edge.law).has_deadband and getattr(self, shared) is not None:
                raise Misplaced(message("config.no_deadband", law=edge.law), shared)
            opens = max(self.onset(edge), 0.0) if edge_law(edge.law).has_deadband else 0.0
            if reach <= opens:
                side, volts = ("above", opens) if edge.sign > 0 else ("below", 0.0 - opens)
                fields = {"lowest": lowest, "highest": highest}
                way = f"commands {side} {volts:g} V"
                text = message("config.edge_never_opens", way=way, **fields)
                raise Misplaced(text, "edge", index)
        return self

    @property
    def largest(self) -> float:
        """The largest size of its command [V]."""
        return max(abs(float(self.command_min)), abs(float(self.command_max)))

    @property
    def given(self) -> tuple[float, float]:
        """The lowest and the highest command [V] that its drive passes on."""
        maximum = math.inf if self.drive_limit is None else float(self.drive_limit)
        return max(float(self.command_min), -maximum), min(float(self.command_max), maximum)

    def onset(self, edge: Edge) -> float:
        """Command [V], counted in the direction that opens it, from which on an edge passes oil."""
        return edge.onset + float(self.overlap or 0.0) + edge.sign * float(self.null or 0.0)

    def edge_name(self, edge: Edge) -> str:
        """What its flow map is called: its name, else the valve's, or valve_from_to of several."""
        if edge.name is not None:
            return edge.name
        return self.name if len(self.edge) == 1 else f"{self.name}_{edge.from_}_{edge.to}"

    @property
    def series(self) -> tuple[str, ...]:
        """The names of its dynamics, from its command to its opening."""
        item = self.dynamics
        return item if isinstance(item, tuple) else () if item is None else (item,)

    def with_dynamics(self, instead_of: Sequence[str], name: str) -> Valve:
        """This valve with the dynamics ``name`` in place of any of others."""
        new = tuple(name if item in instead_of else item for item in self.series)
        if new == self.series:
            return self
        whole = new[0] if isinstance(self.dynamics, str) else tuple(dict.fromkeys(new))
        return self.model_copy(update={"dynamics": whole})

    @property
    def rest(self) -> float:
        """The command [V] nearest to zero that the driver takes: the valve at rest."""
        return min(max(0.0, float(self.command_min)), float(self.command_max))
