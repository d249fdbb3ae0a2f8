"""A cylinder with its valves, and forces on its rod from outside."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, model_validator

from ehbench.config.rig.mechanism import Pins, Rack
from ehbench.config.rig.names import Misplaced, Name, second
from ehbench.config.rig.valves import FixedEdge, Valve
from ehbench.parts.friction import TABLES as FRICTIONS
from ehbench.parts.friction.coulomb_viscous import COULOMB_SPEED
from ehbench.parts.friction.law import FrictionTable
from ehbench.parts.line import Line
from ehbench.parts.mount import Mount
from ehbench.parts.sway import Sway
from ehbench.vocabulary import VOCABULARY, message
from ehbench.vocabulary.fields import FileModel, Q, Value, one_of

if TYPE_CHECKING:
    Friction = FrictionTable
else:
    Friction = one_of(FRICTIONS, "law")


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
                fields = {"what": "force", "kind": self.kind, "key": key}
                raise ValueError(message("config.kind_needs", **fields))
        for key in set(type(self).model_fields) - {"name", "kind", *takes}:
            if getattr(self, key) is not None:
                fields = {"what": "force", "kind": self.kind, "key": key}
                raise Misplaced(message("config.kind_takes", **fields), key)
        if (self.area_rod is None) != (self.pressure_rod is None):
            raise ValueError(message("config.area_with_pressure"))
        if self.channel is not None:
            row = VOCABULARY.get(self.channel.rsplit(".", 1)[-1])
            if row is None or row.unit != "N" or "." not in self.channel:
                raise Misplaced(message("config.no_force_channel", channel=self.channel), "channel")
        return self


class Cylinder(FileModel):
    """A cylinder, the joint it drives, its oil volumes, losses, valves and the edges that have no
    command. Areas, or bore and rod diameters."""

    name: Name
    joint: str
    area_head: Annotated[Value, Q("area_head")] | None = None
    area_rod: Annotated[Value, Q("area_rod")] | None = None
    bore: Annotated[Value, Q("bore")] | None = None
    rod: Annotated[Value, Q("rod")] | None = None
    through_rod: bool = False
    count: int = Field(default=1, ge=1, le=16)
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
    coulomb_speed: Annotated[Value, Q("coulomb_speed")] = Value(COULOMB_SPEED)
    friction: Friction | None = None
    relief_pressure: Annotated[Value, Q("relief_pressure")] | None = None
    valve: tuple[Valve, ...] = Field(min_length=1)
    force: tuple[Force, ...] = ()
    edge: tuple[FixedEdge, ...] = ()
    line: tuple[Line, ...] = ()
    mount: Mount | None = None
    sway: Sway | None = None

    @model_validator(mode="after")
    def _areas(self) -> Cylinder:
        pairs = {
            (self.area_head is not None, self.area_rod is not None),
            (self.bore is not None, self.rod is not None),
        }
        if pairs != {(True, True), (False, False)}:
            raise ValueError(message("config.areas_or_bore"))
        for key in ("count", "through_rod"):
            if self.bore is None and getattr(self, key) != type(self).model_fields[key].default:
                raise Misplaced(message("config.only_with_bore", key=key), key)
        head, rod = self.areas()
        by = "area_rod" if self.area_rod is not None else "rod"
        if not 0 < rod <= head:
            raise Misplaced(message("config.area_rod_range"), by)
        swept = rod * float(self.stroke)
        if float(self.volume_rod) <= swept:
            sizes = {"volume_rod": float(self.volume_rod), "swept": swept}
            fields = {key: self.volume_rod.like("volume_rod", x) for key, x in sizes.items()}
            raise Misplaced(message("config.volume_rod_small", **fields), "volume_rod")
        return self

    @model_validator(mode="after")
    def _parts_fit(self) -> Cylinder:
        if self.friction and (misfit := self.friction.misfit(float(self.friction_coulomb))):
            key, words = misfit
            raise Misplaced(words, "friction", key)
        if self.pins is not None:
            low, high = (abs(float(self.pins.l_a) + way * float(self.pins.l_b)) for way in (-1, 1))
            length = self.pins.retracted_length
            first, last = float(length), float(length) + float(self.stroke)
            if not (low < first and last < high):
                ends = {"ends": first, "ends2": last, "low": low, "high": high}
                fields = {key: length.like("retracted_length", end) for key, end in ends.items()}
                text = message("config.linkage_reach", **fields)
                raise Misplaced(text, "pins", "retracted_length")
            if self.rack is not None:
                raise Misplaced(message("config.pins_and_rack"), "rack")
        if (at := second([line.end for line in self.line])) is not None:
            text = message("config.line_twice", end=self.line[at].end)
            raise Misplaced(text, "line", at, "end")
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
    def _names_differ(self) -> Cylinder:
        valves = [(("valve", i), valve.name) for i, valve in enumerate(self.valve)]
        parts = [(("line", i), line.name) for i, line in enumerate(self.line)]
        parts += [((key,), key) for key in ("mount", "sway") if getattr(self, key) is not None]
        forces = parts + [(("force", i), force.name) for i, force in enumerate(self.force)]
        edges = parts + [(("edge", j), edge.name) for j, edge in enumerate(self.edge)]
        for i, valve in enumerate(self.valve):
            each = enumerate(valve.edge)
            edges += [(("valve", i, "edge", j), valve.edge_name(edge)) for j, edge in each]
        for what, places in (("valves", valves), ("edges", edges), ("forces", forces)):
            if (at := second([name for _, name in places])) is not None:
                where, name = places[at]
                raise Misplaced(message("config.name_twice", what=what, name=name), *where)
        return self

    @property
    def unmodelled(self) -> tuple[str, ...]:
        """Its tables that a controller's model of a cylinder does not have."""
        lists = ("[[cylinder.line]]",) if self.line else ()
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
        """(area_head, area_rod) [m²], of all cylinders side by side."""
        if self.area_head is not None:
            return float(self.area_head), float(self.area_rod)  # type: ignore[arg-type]
        bore, rod = float(self.bore), float(self.rod)  # type: ignore[arg-type]
        full, annulus = (self.count * math.pi / 4 * area for area in (bore**2, bore**2 - rod**2))
        return annulus if self.through_rod else full, annulus
