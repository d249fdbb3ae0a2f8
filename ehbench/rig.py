"""The rig: every number of a machine with unit, source and uncertainty, checked when it enters.

Nothing here knows a particular rig. A rig is a mechanism (a serial chain of revolute joints or a
sliding mass), cylinders, the valves on each cylinder, and the supply. A valve is one command and
its metering edges; an edge joins two of supply, tank, head and rod."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    Field,
    field_validator,
    model_validator,
)

from ehbench import units
from ehbench.errors import InputError, UnitError
from ehbench.fields import SURENESS as SURENESS
from ehbench.fields import FileModel, Q, Value, one_of, scalars
from ehbench.fields import read_value as read_value
from ehbench.notebook import label, plural, shown, table
from ehbench.parts.edge import FixedLawFields, FixedLawName, LawFields, LawName, edge_law
from ehbench.parts.edge.law import EdgeLaw
from ehbench.parts.friction import TABLES as FRICTIONS
from ehbench.parts.friction.law import FrictionTable
from ehbench.parts.line import Line
from ehbench.parts.mount import Mount
from ehbench.parts.sway import Sway
from ehbench.parts.valve import TABLES as DYNAMICS
from ehbench.parts.valve.law import DynamicsTable
from ehbench.quantities import VOCABULARY, Quantity


def _of_a_kind(raw: Any) -> Any:
    """Dynamics that do not say of what kind they are, are of second order."""
    return {"kind": "second_order"} | dict(raw) if isinstance(raw, Mapping) else raw


if TYPE_CHECKING:
    Friction = FrictionTable
    Dynamics = DynamicsTable
else:
    Friction = one_of(FRICTIONS, "law")
    Dynamics = Annotated[one_of(DYNAMICS, "kind"), BeforeValidator(_of_a_kind)]
_ROUNDED = 1e-2  # of an inertia that a drawing gives in two or three digits
_MOST_SUPPLY = 1.0e8  # [Pa]
_FASTEST = 20.0  # [m/s] that the full flow of one edge may move a cylinder
NODES = ("supply", "tank", "head", "rod")


class Misplaced(ValueError):
    """What is wrong with several keys together; ``where`` is the key at which to say so, below the
    table that was checked.
    """

    def __init__(self, message: str, *where: str | int) -> None:
        super().__init__(message)
        self.where = where


def _name(name: str) -> str:
    if not re.fullmatch(r"\w[\w-]*", name):
        raise ValueError(
            f"'{name}' is no name (letters, digits, _ and - make one; channels are called by it)"
        )
    return name


def _plain_name(name: str) -> str:
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        plain = unicodedata.normalize("NFKD", name.casefold()).encode("ascii", "ignore").decode()
        plain = re.sub(r"[^a-z0-9]+", "_", plain).strip("_").lstrip("0123456789_") or "my_rig"
        raise ValueError(
            f"'{name}' is no name of a rig: small letters, digits and _ make one, such as '{plain}'"
        )
    return name


Name = Annotated[str, AfterValidator(_name)]


def _solid(inertia: Value) -> Value:
    """An inertia that a body can have: with that of half its polar moment in each direction it is
    the spread of its mass, and no spread is negative (the triangle inequality among others).
    """
    xx, yy, zz, xy, xz, yz = inertia.value  # type: ignore[misc]
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    spread = 0.5 * np.trace(tensor) * np.eye(3) - tensor
    if np.linalg.eigvalsh(spread)[0] < -_ROUNDED * abs(tensor).max():
        raise ValueError(
            "no body has this inertia: of xx, yy, zz none is above the sum of the others, "
            "and xy, xz, yz are small beside them"
        )
    return inertia


Inertia = Annotated[Value, Q("inertia", 6), AfterValidator(_solid)]


class Joint(FileModel):
    """A revolute joint and the link it carries; frame i sits at the end of link i (standard
    Denavit–Hartenberg).
    """

    name: Name
    dh_a: Annotated[Value, Q("dh_a")] = Value(0.0)
    dh_d: Annotated[Value, Q("dh_d")] = Value(0.0)
    dh_alpha: Annotated[Value, Q("dh_alpha")] = Value(0.0)
    dh_theta: Annotated[Value, Q("dh_theta")] = Value(0.0)
    mass: Annotated[Value, Q("mass")]
    com: Annotated[Value, Q("com", 3)]
    inertia: Inertia
    joint_damping: Annotated[Value, Q("joint_damping")] = Value(0.0)


class Chain(FileModel):
    """A serial chain of revolute joints, base first.

    The first joint's axis z0 is vertical (pointing up), or horizontal with y0 pointing up.
    """

    kind: Literal["chain"]
    first_axis: Literal["vertical", "horizontal"] = "vertical"
    joint: tuple[Joint, ...] = Field(min_length=1)


class Slide(FileModel):
    """A mass on a slide, moved directly by one cylinder; ``incline`` is positive where extension
    goes uphill.
    """

    kind: Literal["slide"]
    name: Name
    mass: Annotated[Value, Q("mass")]
    damping: Annotated[Value, Q("damping")] = Value(0.0)
    incline: Annotated[Value, Q("incline")] = Value(0.0)


class LinkLoad(FileModel):
    """What a payload changes of one link (or of the slide); what is not named stays."""

    mass: Annotated[Value, Q("mass")] | None = None
    com: Annotated[Value, Q("com", 3)] | None = None
    inertia: Inertia | None = None


class Pins(FileModel):
    """Cylinder between two pins: c² = l_A² + l_B² − 2 l_A l_B cos θ, θ = sign·q + phase, x = c −
    retracted_length (SPEC 1).
    """

    l_a: Annotated[Value, Q("l_a")]
    l_b: Annotated[Value, Q("l_b")]
    retracted_length: Annotated[Value, Q("retracted_length")]
    sign: Literal[1, -1] = 1
    phase: Annotated[Value, Q("phase")] = Value(0.0)


class Rack(FileModel):
    """Cylinder that turns its joint by a constant lever, a rack on a pinion or the vane of a rotary
    actuator: x = sign·radius·(q − retracted_angle).
    """

    radius: Annotated[Value, Q("radius")]
    sign: Literal[1, -1] = 1
    retracted_angle: Annotated[Value, Q("retracted_angle")] = Value(0.0)


class MeteringEdge(FileModel):
    """One metering edge: flow from ``from`` to ``to`` when upstream pressure is higher.

    ``law`` is one of `ehbench.parts.edge`, which brings keys of its own. law ``map`` is a measured
    flow map, from the recipe's ``flow_maps`` or the run behind the rig; where one is given it goes
    before the other laws, too, its flow multiplied by ``map_factor``. ``sign`` −1 opens the edge on
    negative commands. ``reverse`` says what a reversed drop does: ``mirror`` or ``blocked``."""

    name: Name | None = None
    from_: Literal["supply", "tank", "head", "rod"] = Field(alias="from")
    to: Literal["supply", "tank", "head", "rod"]
    law: LawName
    sign: Literal[1, -1] = 1
    reverse: Literal["mirror", "blocked"] = "mirror"
    deadband: Annotated[Value, Q("deadband")] = Value(0.0)
    map_factor: Annotated[Value, Q("map_factor")] = Value(1.0)


class Edge(LawFields, MeteringEdge):
    """A metering edge with the keys of its law, or a pump with a command."""

    @model_validator(mode="after")
    def _law_is_whole(self) -> Edge:
        law = edge_law(self.law)
        _must_be_whole(self, law, law.needs, set(LawFields.model_fields))
        if not law.metering and self.reverse == "blocked":
            raise Misplaced(
                f"a {self.law} passes oil both ways; put a check valve beside it", "reverse"
            )
        if not law.metering and float(self.deadband) > 0.0:
            raise Misplaced(f"a {self.law} has no deadband", "deadband")
        if (odd := law.odd(self)) is not None:
            raise Misplaced(*odd)
        return self

    @property
    def gain(self) -> Value | None:
        """What its flow goes with: the gain of its law."""
        needs = edge_law(self.law).needs
        return getattr(self, needs[0] if needs else "compensated_gain")


class UnmeteredEdge(FileModel):
    """An edge without a command: oil goes as the pressures have it. ``law`` is one of
    `ehbench.parts.edge`, which brings keys of its own.
    """

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
            raise ValueError(
                "a pilot-operated check valve takes pilot and pilot_ratio, another none"
            )
        if self.pilot == self.from_:
            raise Misplaced("the pilot is at 'from', where it opens nothing", "pilot")
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
    had before it was measured.
    """
    if edge.from_ == edge.to:
        raise ValueError(f"an edge joins two different nodes, not {edge.to} with itself")
    for need in needs:
        if getattr(edge, need) is None:
            raise ValueError(f"law '{law.name}' needs '{need}'")
    if law.name == "map":
        return
    takes = (*needs, *law.takes)
    for key in sorted(edge.model_fields_set & of_laws - set(takes)):
        if getattr(edge, key) is not None:
            own = ", ".join(takes)
            raise Misplaced(f"law '{law.name}' takes no '{key}'; its own keys: {own}", key)


class Valve(FileModel):
    """One command, its dynamics (names in the rig's ``dynamics``, from the command on, or none:
    opening follows at once) and its edges. Commands of a size beyond its ``drive_limit`` do what
    one of that size does.
    """

    name: Name
    title: str = ""
    dynamics: str | tuple[str, ...] | None = None
    command_min: Annotated[Value, Q("command_min")]
    command_max: Annotated[Value, Q("command_max")]
    drive_limit: Annotated[Value, Q("drive_limit")] | None = None
    edge: tuple[Edge, ...] = Field(min_length=1)
    calibration: tuple[tuple[str, str], ...] = ()

    @field_validator("dynamics")
    @classmethod
    def _each_once(cls, names: str | tuple[str, ...] | None) -> str | tuple[str, ...] | None:
        if isinstance(names, tuple) and (at := _second(names)) is not None:
            raise ValueError(
                f"'{names[at]}' stands in the series twice; give one a name of its own"
            )
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
            raise Misplaced("command_min must lie below command_max", "command_min")
        lowest, highest = self.given
        if not lowest <= self.rest <= highest:
            raise Misplaced(
                "a drive that gives no more than this never comes to rest", "drive_limit"
            )
        for index, edge in enumerate(self.edge):
            reach = highest if edge.sign > 0 else -lowest
            opens = float(edge.deadband) if edge_law(edge.law).has_deadband else 0.0
            if reach <= opens:
                way = (
                    f"commands above {opens:g} V"
                    if edge.sign > 0
                    else f"commands below {0.0 - opens:g} V"
                )
                raise Misplaced(
                    f"the edge opens on {way}, and the valve takes {lowest:g} to {highest:g} V",
                    "edge",
                    index,
                )
        return self

    @property
    def given(self) -> tuple[float, float]:
        """The lowest and the highest command [V] that its drive passes on."""
        most = math.inf if self.drive_limit is None else float(self.drive_limit)
        return max(float(self.command_min), -most), min(float(self.command_max), most)

    def edge_name(self, edge: Edge) -> str:
        """The name a flow map of this edge goes by: the edge's own, else the valve's (or
        valve_from_to with several).
        """
        if edge.name is not None:
            return edge.name
        return self.name if len(self.edge) == 1 else f"{self.name}_{edge.from_}_{edge.to}"

    @property
    def series(self) -> tuple[str, ...]:
        """The names of its dynamics, from its command to its opening."""
        one = self.dynamics
        return one if isinstance(one, tuple) else () if one is None else (one,)

    def with_dynamics(self, instead_of: Sequence[str], name: str) -> Valve:
        """This valve with the dynamics ``name`` in place of any of others."""
        new = tuple(name if one in instead_of else one for one in self.series)
        if new == self.series:
            return self
        whole = new[0] if isinstance(self.dynamics, str) else tuple(dict.fromkeys(new))
        return self.model_copy(update={"dynamics": whole})

    @property
    def rest(self) -> float:
        """The command [V] nearest to zero that the driver takes: the valve at rest."""
        return min(max(0.0, float(self.command_min)), float(self.command_max))


class Force(FileModel):
    """A force on the rod from outside, positive where it pushes the rod out.

    kind ``constant``: ``force``. ``by_direction``: ``force_extending`` while the rod goes out,
    ``force_retracting`` while it goes in. ``spring``: −stiffness·(x − free_length). ``channel``:
    played from a log's ``channel``. ``cylinder``: one that stands against the rod, its
    ``area_head`` under ``pressure_head`` pushing the rod in, its ``area_rod`` under
    ``pressure_rod`` pulling it out."""

    name: Name = "force"
    kind: Literal["constant", "by_direction", "spring", "channel", "cylinder"]
    force: Annotated[Value, Q("force")] | None = None
    force_extending: Annotated[Value, Q("force_extending")] | None = None
    force_retracting: Annotated[Value, Q("force_retracting")] | None = None
    stiffness: Annotated[Value, Q("stiffness")] | None = None
    free_length: Annotated[Value, Q("free_length")] | None = None
    channel: str | None = None
    area_head: Annotated[Value, Q("area_head")] | None = None
    area_rod: Annotated[Value, Q("area_rod")] | None = None
    pressure_head: Annotated[Value, Q("pressure_head")] | None = None
    pressure_rod: Annotated[Value, Q("pressure_rod")] | None = None

    @model_validator(mode="after")
    def _kind_is_whole(self) -> Force:
        takes = {
            "constant": ("force",),
            "by_direction": ("force_extending", "force_retracting"),
            "spring": ("stiffness", "free_length"),
            "channel": ("channel",),
            "cylinder": ("area_head", "pressure_head", "area_rod", "pressure_rod"),
        }[self.kind]
        needs = takes[:2]
        for key in needs:
            if getattr(self, key) is None:
                raise ValueError(f"a force of kind '{self.kind}' needs '{key}'")
        for key in set(type(self).model_fields) - {"name", "kind", *takes}:
            if getattr(self, key) is not None:
                raise Misplaced(f"a force of kind '{self.kind}' takes no '{key}'", key)
        if (self.area_rod is None) != (self.pressure_rod is None):
            raise ValueError("give area_rod and pressure_rod together")
        if self.channel is not None:
            row = VOCABULARY.get(self.channel.rsplit(".", 1)[-1])
            if row is None or row.unit != "N" or "." not in self.channel:
                raise Misplaced(
                    f"'{self.channel}' is no channel of a force (such as '<cylinder>.force')",
                    "channel",
                )
        return self


class Cylinder(FileModel):
    """A cylinder, the joint it drives, its oil volumes, losses, valves and the edges that have no
    command. Areas, or bore and rod diameters.
    """

    name: Name
    joint: str
    area_head: Annotated[Value, Q("area_head")] | None = None
    area_rod: Annotated[Value, Q("area_rod")] | None = None
    bore: Annotated[Value, Q("bore")] | None = None
    rod: Annotated[Value, Q("rod")] | None = None
    stroke: Annotated[Value, Q("stroke")]
    volume_head: Annotated[Value, Q("volume_head")]
    volume_rod: Annotated[Value, Q("volume_rod")]
    pins: Pins | None = None
    rack: Rack | None = None
    bulk_modulus: Annotated[Value, Q("bulk_modulus")] | None = None
    leakage_internal: Annotated[Value, Q("leakage_internal")] = Value(0.0)
    leakage_head: Annotated[Value, Q("leakage_head")] = Value(0.0)
    leakage_rod: Annotated[Value, Q("leakage_rod")] = Value(0.0)
    friction_viscous: Annotated[Value, Q("friction_viscous")] = Value(0.0)
    friction_coulomb: Annotated[Value, Q("friction_coulomb")] = Value(0.0)
    friction: Friction | None = None
    relief_pressure: Annotated[Value, Q("relief_pressure")] | None = None
    valve: tuple[Valve, ...] = Field(min_length=1)
    force: tuple[Force, ...] = ()
    edge: tuple[FixedEdge, ...] = ()
    line: tuple[Line, ...] = ()
    mount: Mount | None = None
    sway: Sway | None = Field(None, description="a part of the load that sways, `[cylinder.sway]`")

    @model_validator(mode="after")
    def _areas(self) -> Cylinder:
        pairs = {
            (self.area_head is not None, self.area_rod is not None),
            (self.bore is not None, self.rod is not None),
        }
        if pairs != {(True, True), (False, False)}:
            raise ValueError("give area_head and area_rod, or bore and rod")
        head, rod = self.areas()
        by = "area_rod" if self.area_rod is not None else "rod"
        if not 0 < rod <= head:
            raise Misplaced(
                "area_rod must be positive and not above area_head (head end = full-bore side)", by
            )
        swept = rod * float(self.stroke)
        if float(self.volume_rod) <= swept:
            given = f"{float(self.volume_rod) * 1e6:g} cm^3"
            raise Misplaced(
                f"volume_rod at x = 0 is {given}, "
                f"but the full stroke displaces {swept * 1e6:.6g} cm^3",
                "volume_rod",
            )
        return self

    @model_validator(mode="after")
    def _friction_fits(self) -> Cylinder:
        if self.friction is not None:
            found = self.friction.misfit(float(self.friction_coulomb))
            if found is not None:
                key, words = found
                raise Misplaced(words, "friction", key)
        return self

    @model_validator(mode="after")
    def _linkage_reaches(self) -> Cylinder:
        if self.pins is not None:
            low, high = (abs(float(self.pins.l_a) + way * float(self.pins.l_b)) for way in (-1, 1))
            ends = (
                float(self.pins.retracted_length),
                float(self.pins.retracted_length) + float(self.stroke),
            )
            if not (low < ends[0] and ends[1] < high):
                raise Misplaced(
                    f"from pin to pin the cylinder is {ends[0] * 1e3:g} mm long retracted "
                    f"and {ends[1] * 1e3:g} mm extended, while l_a and l_b allow "
                    f"{low * 1e3:g} to {high * 1e3:g} mm, the ends excluded",
                    "pins",
                    "retracted_length",
                )
        return self

    @model_validator(mode="after")
    def _one_linkage(self) -> Cylinder:
        if self.pins is not None and self.rack is not None:
            raise Misplaced("a cylinder sits on 'pins' or drives a 'rack', not both", "rack")
        return self

    @property
    def linkage(self) -> Pins | Rack | None:
        """What joins it to its joint, None on a slide."""
        return self.pins if self.rack is None else self.rack

    @property
    def linkage_word(self) -> str:
        """The rig file's word for it."""
        return "pins" if self.rack is None else "rack"

    @model_validator(mode="after")
    def _one_line_an_end(self) -> Cylinder:
        if (at := _second([line.end for line in self.line])) is not None:
            raise Misplaced(
                f"the {self.line[at].end} end has a line already; give their volumes and "
                "resistances in one",
                *("line", at, "end"),
            )
        return self

    @model_validator(mode="after")
    def _names_differ(self) -> Cylinder:
        valves = list(enumerate(self.valve))
        own = [(("line", i), line.name) for i, line in enumerate(self.line)]
        own += [((key,), key) for key in ("mount", "sway") if getattr(self, key) is not None]
        for what, places in (
            ("valves", [(("valve", i), v.name) for i, v in valves]),
            (
                "edges",
                own
                + [
                    (("valve", i, "edge", j), v.edge_name(e))
                    for i, v in valves
                    for j, e in enumerate(v.edge)
                ]
                + [(("edge", j), e.name) for j, e in enumerate(self.edge)],
            ),
            ("forces", own + [(("force", i), f.name) for i, f in enumerate(self.force)]),
        ):
            if (at := _second([name for _, name in places])) is not None:
                where, name = places[at]
                raise Misplaced(
                    f"two {what} are called '{name}'; give each a name of its own", *where
                )
        return self

    def parts(self) -> Iterator[tuple[str, FileModel]]:
        """Its further parts with what their parameters' names begin with, after the cylinder's."""
        for key, own in _tables(self).items():
            yield _prefix(key), own
        for part in (*self.force, *self.line):
            yield f"{part.name}.", part

    @property
    def unmodelled(self) -> tuple[str, ...]:
        """Its tables that a controller's model of a cylinder does not have."""
        lists = tuple(f"[[cylinder.{key}]]" for key in ("force", "line") if getattr(self, key))
        single = (key for key in ("mount", "sway") if getattr(self, key) is not None)
        return (*lists, *(f"[cylinder.{key}]" for key in single))

    @property
    def pump(self) -> str | None:
        """Name of a pump that feeds or drains an end of it, None where valves meter all its oil."""
        for edge in (*(e for v in self.valve for e in v.edge), *self.edge):
            if edge.law == "pump" and {edge.from_, edge.to} & {"head", "rod"}:
                return edge.name or next(v.edge_name(edge) for v in self.valve if edge in v.edge)
        return None

    def areas(self) -> tuple[float, float]:
        """(area_head, area_rod) [m²]."""
        if self.area_head is not None:
            return float(self.area_head), float(self.area_rod)  # type: ignore[arg-type]
        bore, rod = float(self.bore), float(self.rod)  # type: ignore[arg-type]
        return math.pi / 4 * bore**2, math.pi / 4 * (bore**2 - rod**2)


class Accumulator(FileModel):
    """A gas-charged accumulator on the supply line: ``p V_gas^n`` stays, p absolute; ``gas_volume``
    at ``precharge``, without oil.
    """

    gas_volume: Annotated[Value, Q("gas_volume")]
    precharge: Annotated[Value, Q("precharge")]
    polytropic_exponent: Annotated[Value, Q("polytropic_exponent")] = Value(1.2)


class LoadSensing(FileModel):
    """The pump's pressure follows the highest chamber that an open edge feeds: its pressure and
    ``load_margin``, up to the supply's ``pressure``, with a first-order lag.
    """

    load_margin: Annotated[Value, Q("load_margin")]
    load_lag: Annotated[Value, Q("load_lag")] = Value(0.05)


class LowRail(FileModel):
    """A second line, of constant ``rail_pressure``: an edge from the supply takes from it while
    that is ``rail_margin`` or more above the chamber which it feeds.
    """

    rail_pressure: Annotated[Value, Q("rail_pressure")]
    rail_margin: Annotated[Value, Q("rail_margin")]


class Supply(FileModel):
    """Constant-pressure supply: holds ``pressure`` up to ``flow_limit``, above which the pressure
    falls. With an accumulator and no ``flow_limit`` it is a charge line, at ``pressure`` when a
    motion begins. With ``load_sensing`` the pressure follows the load, with ``low_rail`` there is a
    second, lower one.
    """

    pressure: Annotated[Value, Q("pressure")]
    tank_pressure: Annotated[Value, Q("tank_pressure")] = Value(0.0)
    flow_limit: Annotated[Value, Q("flow_limit")]
    volume: Annotated[Value, Q("volume")] = Value(2.0e-3)
    accumulator: Accumulator | None = None
    load_sensing: LoadSensing | None = None
    low_rail: LowRail | None = None

    @property
    def constant(self) -> bool:
        """Whether there is one pressure, whatever the load."""
        return self.load_sensing is None and self.low_rail is None

    @property
    def kind(self) -> str:
        """What it is, in words."""
        if self.load_sensing is not None:
            return "load sensing"
        return "constant pressure" if self.low_rail is None else "two rails"

    def facts(self) -> dict[str, Any]:
        """Its kind in words and what makes its pressure, SI."""
        found: dict[str, Any] = {"kind": self.kind, "pressure": float(self.pressure)}
        for own in (self.load_sensing, self.low_rail):
            if own is not None:
                found |= {name: float(getattr(own, name)) for name in type(own).model_fields}
        return found

    def tables(self) -> dict[str, FileModel]:
        """The tables that it has beside its own values."""
        return _tables(self)

    @model_validator(mode="after")
    def _one_way_to_follow_the_load(self) -> Supply:
        self.check_following()
        return self

    def check_following(self) -> None:
        """Refuse a way to follow the load that does not go with the rest.

        Raises:
            Misplaced: says what would.
        """
        load, low = self.load_sensing, self.low_rail
        most = float(self.pressure) - float(self.tank_pressure)
        if load is not None and not 0.0 < float(load.load_margin) < most:
            raise Misplaced(
                "the margin of load sensing must lie between 0 and the supply's pressure",
                *("load_sensing", "load_margin"),
            )
        if load is not None and not float(load.load_lag) > 0.0:
            raise Misplaced("the lag of load sensing must be above 0", "load_sensing", "load_lag")
        if low is not None and not 0.0 < float(low.rail_margin) < float(low.rail_pressure) < most:
            raise Misplaced(
                "the low rail's pressure must lie between its margin and the supply's pressure",
                *("low_rail", "rail_pressure"),
            )
        if load is not None and (low is not None or self.accumulator is not None):
            other = "low_rail" if low is not None else "accumulator"
            raise Misplaced(
                f"'{other}' holds a pressure, which load sensing is to change: leave one out", other
            )

    @model_validator(mode="after")
    def _above_tank(self) -> Supply:
        if float(self.pressure) > _MOST_SUPPLY:
            raise Misplaced(
                f"a supply of {float(self.pressure) / 1e5:g} bar is beyond any hydraulics: "
                f"{_MOST_SUPPLY / 1e5:g} bar at most",
                "pressure",
            )
        if float(self.pressure) <= float(self.tank_pressure):
            raise Misplaced("the supply's pressure must lie above tank_pressure", "pressure")
        gas = self.accumulator
        if gas is not None and float(self.pressure) <= float(gas.precharge):
            raise Misplaced(
                "the accumulator holds no oil: its precharge must lie below the supply's pressure",
                *("accumulator", "precharge"),
            )
        return self


class Oil(FileModel):
    """The oil. ``bulk_modulus`` is effective: oil, entrained air and hose together; with
    ``air_fraction`` it is of what the air leaves over, and softens as the pressure falls."""

    bulk_modulus: Annotated[Value, Q("bulk_modulus")]
    air_fraction: Annotated[Value, Q("air_fraction")] | None = None
    polytropic_exponent: Annotated[Value, Q("polytropic_exponent")] | None = None
    cavitation_pressure: Annotated[Value, Q("cavitation_pressure")] = Value(-9.0e4)

    @model_validator(mode="after")
    def _air_is_whole(self) -> Oil:
        if self.polytropic_exponent is not None and self.air_fraction is None:
            raise Misplaced("an exponent of air needs 'air_fraction'", "polytropic_exponent")
        return self


class Rig(FileModel):
    """A whole machine, as its file gives it."""

    name: Annotated[str, AfterValidator(_plain_name)]
    title: str = ""
    note: str = ""
    display: dict[str, str] = {}
    gravity: Annotated[Value, Q("gravity")] = Value(9.80665)
    oil: Oil
    supply: Supply
    mechanism: Annotated[Chain | Slide, Field(discriminator="kind")]
    cylinder: tuple[Cylinder, ...] = Field(min_length=1)
    dynamics: dict[Name, Dynamics] = {}
    payload: dict[str, dict[str, LinkLoad]] = {}

    @field_validator("display")
    @classmethod
    def _display_units(cls, display: dict[str, str]) -> dict[str, str]:
        for name, unit in display.items():
            if name not in VOCABULARY:
                near = get_close_matches(name, VOCABULARY, 1)
                raise Misplaced(
                    f"there is no quantity '{name}'"
                    + (f"; nearest is '{near[0]}'" if near else ""),
                    name,
                )
            try:
                units.to_si(1.0, unit, VOCABULARY[name])
            except UnitError as error:
                raise Misplaced(str(error), name) from None
        return display

    @model_validator(mode="after")
    def _names_agree(self) -> Rig:
        joints = self.joint_names
        chain = ("mechanism", "joint")
        for what, names, place in (
            ("two joints are called", joints, chain),
            ("two cylinders are called", [c.name for c in self.cylinder], ("cylinder",)),
            ("two cylinders drive joint", [c.joint for c in self.cylinder], ("cylinder",)),
        ):
            if (at := _second(names)) is not None:
                raise Misplaced(f"{what} '{names[at]}'", *place, at)
        for at, cylinder in enumerate(self.cylinder):
            if cylinder.joint not in joints:
                raise Misplaced(
                    f"there is no joint '{cylinder.joint}'; there are {', '.join(joints)}",
                    "cylinder",
                    at,
                    "joint",
                )
            if (cylinder.linkage is None) != (self.mechanism.kind == "slide"):
                raise Misplaced(
                    "on a joint a cylinder needs 'pins' or a 'rack', on a slide it has none",
                    *("cylinder", at),
                )
            for i, valve in enumerate(cylinder.valve):
                for name in valve.series:
                    if name not in self.dynamics:
                        there = ", ".join(self.dynamics) or "none"
                        where = ("cylinder", at, "valve", i, "dynamics")
                        raise Misplaced(f"there is no [dynamics.{name}]; there are {there}", *where)
        if "none" in self.payload:
            raise Misplaced("'none' is no payload: name this one otherwise", "payload", "none")
        for load, links in self.payload.items():
            for link in links:
                if link not in joints:
                    raise Misplaced(
                        f"there is no link '{link}'; there are {', '.join(joints)}",
                        "payload",
                        load,
                        link,
                    )
        return self

    @model_validator(mode="after")
    def _bodies_weigh(self) -> Rig:
        bodies: tuple[Slide | Joint, ...]
        if isinstance(self.mechanism, Slide):
            bodies, where = (self.mechanism,), ("mechanism",)
        else:
            bodies = self.mechanism.joint
            where = ("mechanism", "joint", len(bodies) - 1)
        if not float(bodies[-1].mass) > 0.0:
            raise Misplaced(f"'{bodies[-1].name}' has no mass to move", *where, "mass")
        empty = {body.name: float(body.mass) for body in bodies}
        for load, links in self.payload.items():
            for link, change in links.items():
                if change.mass is not None and float(change.mass) < empty[link]:
                    raise Misplaced(
                        f"with '{load}' '{link}' has {float(change.mass):g} kg, less than its "
                        f"{empty[link]:g} kg without: give the whole link with what it carries",
                        *("payload", load, link, "mass"),
                    )
        return self

    @model_validator(mode="after")
    def _edges_pass_what_a_cylinder_takes(self) -> Rig:
        root = math.sqrt(float(self.supply.pressure) - float(self.supply.tank_pressure))
        for at, cylinder in enumerate(self.cylinder):
            area = min(cylinder.areas())
            for i, valve in enumerate(cylinder.valve):
                reach = max(-float(valve.command_min), float(valve.command_max))
                for j, edge in enumerate(valve.edge):
                    if edge.flow_gain is None:
                        continue
                    speed = float(edge.flow_gain) * reach * root / area
                    if speed > _FASTEST:
                        raise Misplaced(
                            f"wide open '{valve.edge_name(edge)}' moves '{cylinder.name}' at "
                            f"{speed:.3g} m/s: check the unit of flow_gain",
                            *("cylinder", at, "valve", i, "edge", j, "flow_gain"),
                        )
        return self

    def __repr__(self) -> str:
        counts = (
            (len(self.joint_names), "slide" if isinstance(self.mechanism, Slide) else "joint"),
            (len(self.cylinder), "cylinder"),
            (sum(1 for _ in self.valves()), "valve"),
            (sum(1 for _ in self.edges()), "metering edge"),
            (len(self.payload), "payload"),
        )
        return f"<Rig '{self.name}': {', '.join(plural(*item) for item in counts)}>"

    __str__ = __repr__

    def _repr_html_(self) -> str:
        """Its parameters by name, in the units of its file, each with where it came from."""
        rows = []
        for name, value in self.parameters().items():
            unit = self.unit_of(name)
            number, error = (shown(one, name, unit) for one in (float(value), value.std))
            rows.append((name, number, error, label(unit), value.sure, value.source))
        header = ("parameter", "value", "standard error", "unit", "sure", "source")
        return table(header, rows, self.title or self.name)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joint names, base first (one name for a slide)."""
        return (
            (self.mechanism.name,)
            if isinstance(self.mechanism, Slide)
            else tuple(j.name for j in self.mechanism.joint)
        )

    def cylinder_named(self, name: str) -> Cylinder:
        """The cylinder of that name.

        Raises:
            InputError: there is none; names those there are.
        """
        for cylinder in self.cylinder:
            if cylinder.name == name:
                return cylinder
        raise InputError(
            f"rig '{self.name}' has no cylinder '{name}'",
            hint="it has " + ", ".join(c.name for c in self.cylinder),
        )

    def valves(self) -> Iterator[tuple[Cylinder, Valve]]:
        """Every valve with its cylinder, in the order of the file: the order of all command
        vectors.
        """
        for cylinder in self.cylinder:
            for valve in cylinder.valve:
                yield cylinder, valve

    def edges(self) -> Iterator[tuple[Cylinder, Valve, Edge]]:
        """Every metering edge with its valve and cylinder, in the order of the file."""
        for cylinder, valve in self.valves():
            for edge in valve.edge:
                yield cylinder, valve, edge

    def fixed_edges(self) -> Iterator[tuple[Cylinder, FixedEdge]]:
        """Every edge without a command with its cylinder, in the order of the file."""
        for cylinder in self.cylinder:
            for edge in cylinder.edge:
                yield cylinder, edge

    def all_edges(self) -> dict[str, Edge | FixedEdge]:
        """Every edge by ``<cylinder>.<edge>``: those of valves, then those without a command."""
        metering = {f"{c.name}.{v.edge_name(e)}": e for c, v, e in self.edges()}
        return metering | {f"{c.name}.{e.name}": e for c, e in self.fixed_edges()}

    def unit_of(self, name: str) -> str:
        """The unit people see for a quantity, channel or parameter: the choice of ``[display]``,
        else that in which the rig file has it, else the vocabulary's.
        """
        word = name.rsplit(".", 1)[-1]
        chosen = self.display.get(word) or self._display_like(word)
        return (
            chosen
            or self.typed_units.get(name)
            or self.typed_units.get(word)
            or VOCABULARY[word].display
        )

    def _display_like(self, word: str) -> str:
        row = VOCABULARY[word]
        for other, unit in self.display.items():
            if VOCABULARY[other].unit == row.unit and VOCABULARY[other].display == row.display:
                return unit
        return ""

    @cached_property
    def typed_units(self) -> dict[str, str]:
        """The unit of each parameter that the file has in another than SI, and of each word whose
        parameters all have the same.
        """
        own = {name: value.unit for name, value in self.parameters().items() if value.unit}
        words: dict[str, set[str]] = {}
        for name, unit in own.items():
            words.setdefault(name.rsplit(".", 1)[-1], set()).add(unit)
        return {word: min(units) for word, units in words.items() if len(units) == 1} | own

    def with_payload(self, load: str | None) -> Rig:
        """This rig carrying the named payload.

        Raises:
            InputError: no such payload; names those there are.
        """
        if load is None:
            return self
        if load not in self.payload:
            raise InputError(
                f"rig '{self.name}' has no payload '{load}'",
                hint="it has " + (", ".join(self.payload) or "none"),
            )
        changes = self.payload[load]

        def loaded(body: Any) -> Any:
            change = changes.get(body.name)
            if change is None:
                return body
            given = {
                key: getattr(change, key)
                for key in LinkLoad.model_fields
                if getattr(change, key) is not None
            }
            return body.model_copy(
                update={k: v for k, v in given.items() if k in type(body).model_fields}
            )

        if isinstance(self.mechanism, Slide):
            return self.model_copy(update={"mechanism": loaded(self.mechanism)})
        joints = tuple(loaded(joint) for joint in self.mechanism.joint)
        return self.model_copy(
            update={"mechanism": self.mechanism.model_copy(update={"joint": joints})}
        )

    def with_supply(
        self, load_sensing: LoadSensing | None = None, low_rail: LowRail | None = None
    ) -> Rig:
        """This rig on a supply that follows the load; as it is without either.

        Raises:
            InputError: a margin, or a rail, that does not go with the supply.
        """
        if load_sensing is None and low_rail is None:
            return self
        own = {"load_sensing": load_sensing, "low_rail": low_rail}
        supply = self.supply.model_copy(update=own)
        try:
            supply.check_following()
        except Misplaced as error:
            raise InputError(str(error)) from None
        return self.model_copy(update={"supply": supply})

    def parameters(self) -> dict[str, Value]:
        """Every scalar parameter by the name recipes use.

        ``bulk_modulus``, ``supply.pressure``, ``<joint>.joint_damping``, ``<joint>.mass``,
        ``<cylinder>.leakage_internal``, ``<dynamics>.natural_frequency`` (also where the file gives
        s1 and s2), ``<edge>.flow_gain``, ``<cylinder>.<force>.stiffness`` and so on."""
        found: dict[str, Value] = {"gravity": self.gravity}
        found |= {name: value for name, value in scalars(self.oil)}
        for line in (self.supply, *self.supply.tables().values()):
            found |= {f"supply.{name}": value for name, value in scalars(line)}
        bodies = (
            [self.mechanism] if isinstance(self.mechanism, Slide) else list(self.mechanism.joint)
        )
        for body in bodies:
            found |= {f"{body.name}.{name}": value for name, value in scalars(body)}
        for cylinder in self.cylinder:
            found |= {f"{cylinder.name}.{name}": value for name, value in scalars(cylinder)}
            for prefix, part in cylinder.parts():
                found |= {f"{cylinder.name}.{prefix}{name}": value for name, value in scalars(part)}
        for cylinder, valve in self.valves():
            if valve.drive_limit is not None:
                found[f"{cylinder.name}.{valve.name}.drive_limit"] = valve.drive_limit
        for name, dynamics in self.dynamics.items():
            found |= {f"{name}.{key}": value for key, value in dynamics.parameters().items()}
        for edge_name, edge in self.all_edges().items():
            found |= {f"{edge_name}.{name}": value for name, value in scalars(edge)}
        return found

    def with_values(
        self, values: Mapping[str, Value | float], known: Mapping[str, Value] | None = None
    ) -> Rig:
        """This rig with parameters replaced, addressed as in ``parameters``.

        Args:
            known: its ``parameters()``, where they are at hand: to gather them takes longest.

        Raises:
            InputError: no such parameter; names the nearest.
        """
        known = self.parameters() if known is None else known
        for name in values:
            if name not in known:
                near = get_close_matches(name, known, 1)
                raise InputError(
                    f"rig '{self.name}' has no parameter '{name}'",
                    hint=f"nearest is '{near[0]}'" if near else None,
                )
        new = {
            name: replace(value, unit=value.unit or known[name].unit)
            if isinstance(value, Value)
            else replace(known[name], value=float(value), text=None)
            for name, value in values.items()
        }

        def own(prefix: str, model: Any) -> Any:
            return _replaced(model, prefix, new)

        mechanism = (
            own(f"{self.mechanism.name}.", self.mechanism)
            if isinstance(self.mechanism, Slide)
            else self.mechanism.model_copy(
                update={"joint": tuple(own(f"{j.name}.", j) for j in self.mechanism.joint)}
            )
        )
        tables = {key: own("supply.", part) for key, part in self.supply.tables().items()}
        supply = own("supply.", self.supply).model_copy(update=tables)
        return own("", self).model_copy(
            update={
                "oil": own("", self.oil),
                "supply": supply,
                "mechanism": mechanism,
                "cylinder": tuple(_cylinder_with(c, new) for c in self.cylinder),
                "dynamics": {
                    name: model.with_values(_below(f"{name}.", new))
                    for name, model in self.dynamics.items()
                },
            }
        )

    def with_dynamics(self, by_valve: Mapping[str, str]) -> Rig:
        """This rig with valves, named ``<cylinder>.<valve>``, that have other dynamics of its file.

        Raises:
            InputError: no such valve or dynamics.
        """
        if not by_valve:
            return self
        valves = [f"{cylinder.name}.{valve.name}" for cylinder, valve in self.valves()]
        for asked, known, what in (
            (by_valve, valves, "valve"),
            (by_valve.values(), self.dynamics, "[dynamics]"),
        ):
            wrong = next((name for name in asked if name not in known), None)
            if wrong is not None:
                raise InputError(
                    f"rig '{self.name}' has no {what} '{wrong}'",
                    hint="there are " + (", ".join(known) or "none"),
                )

        def own(cylinder: Cylinder) -> Cylinder:
            valves = tuple(
                valve.model_copy(update={"dynamics": name})
                if (name := by_valve.get(f"{cylinder.name}.{valve.name}"))
                else valve
                for valve in cylinder.valve
            )
            return cylinder.model_copy(update={"valve": valves})

        return self.model_copy(update={"cylinder": tuple(map(own, self.cylinder))})

    def as_toml(self) -> dict[str, Any]:
        """The rig as nested plain values that a TOML writer takes; reading them back gives the same
        rig.
        """
        return self.model_dump(
            mode="python",
            by_alias=True,
            exclude_none=True,
            exclude_unset=False,
            exclude_defaults=True,
        )


def _second(names: Sequence[str]) -> int | None:
    """Where a name stands for the second time."""
    return next((at for at, name in enumerate(names) if name in names[:at]), None)


def _replaced(model: Any, prefix: str, new: Mapping[str, Value]) -> Any:
    """A part with those of its own fields replaced that ``new`` names with ``prefix``."""
    update = {key: new[prefix + key] for key in type(model).model_fields if prefix + key in new}
    return model.model_copy(update=update) if update else model


def _below(prefix: str, new: Mapping[str, Value]) -> dict[str, Value]:
    """The values whose names begin with ``prefix``, by the rest of their names."""
    return {name[len(prefix) :]: value for name, value in new.items() if name.startswith(prefix)}


def _cylinder_with(model: Cylinder, new: Mapping[str, Value]) -> Cylinder:
    """A cylinder with new values of its own, of its tables and its edges."""
    prefix = f"{model.name}."
    valves = []
    for valve in model.valve:
        edges = (_replaced(e, f"{prefix}{valve.edge_name(e)}.", new) for e in valve.edge)
        whole = _replaced(valve, f"{prefix}{valve.name}.", new)
        valves.append(whole.model_copy(update={"edge": tuple(edges)}))
    tables = {
        key: _replaced(part, prefix + _prefix(key), new) for key, part in _tables(model).items()
    }
    named: dict[str, tuple[Any, ...]] = {
        "force": model.force,
        "edge": model.edge,
        "line": model.line,
    }
    lists = {
        key: tuple(_replaced(part, f"{prefix}{part.name}.", new) for part in parts)
        for key, parts in named.items()
    }
    whole = _replaced(model, prefix, new)
    return whole.model_copy(update=tables | {"valve": tuple(valves)} | lists)


def _tables(model: BaseModel) -> dict[str, FileModel]:
    """The tables that a part of the rig has beside its own values."""
    own = {name: getattr(model, name) for name in type(model).model_fields}
    return {name: part for name, part in own.items() if isinstance(part, FileModel)}


def _prefix(table: str) -> str:
    """What the parameters of a cylinder's table begin with, after the cylinder's name."""
    return f"{table}." if table in ("mount", "sway") else ""


def parameter_row(name: str) -> Quantity:
    """The vocabulary row of a parameter name such as ``boom.joint_damping``."""
    return VOCABULARY[name.rsplit(".", 1)[-1]]
