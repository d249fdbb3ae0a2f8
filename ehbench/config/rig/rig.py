"""A rig as a whole: what its tables must agree in, and its numbers as parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from difflib import get_close_matches
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, field_validator, model_validator

from ehbench.config.rig.cylinder import Cylinder
from ehbench.config.rig.fmu import ForeignModel
from ehbench.config.rig.mechanism import Chain, Joint, LinkLoad, Slide
from ehbench.config.rig.names import Misplaced, Name, plain_name, second, tables_of
from ehbench.config.rig.supply import LoadSensing, LowRail, Oil, Supply
from ehbench.config.rig.valves import Edge, FixedEdge, Valve
from ehbench.parts.valve import TABLES as DYNAMICS
from ehbench.parts.valve.law import DynamicsTable
from ehbench.vocabulary import VOCABULARY, from_si, message, plural, quantity, units
from ehbench.vocabulary.errors import InputError, UnitError, nearest
from ehbench.vocabulary.fields import FileModel, Q, Value, one_of, scalars, with_scalars
from ehbench.vocabulary.messages import digits
from ehbench.vocabulary.notebook import label, shown, table
from ehbench.vocabulary.units import factor

if TYPE_CHECKING:
    Dynamics = DynamicsTable
else:
    # dynamics that do not say of what kind they are, are of second order
    Dynamics = Annotated[
        one_of(DYNAMICS, "kind"),
        BeforeValidator(lambda raw: {"kind": "second_order", **raw} if type(raw) is dict else raw),
    ]


_FASTEST = 20.0  # [m/s] that the full flow of one edge may move a cylinder


class Rig(FileModel):
    """A whole machine, as its file gives it."""

    name: Annotated[str, AfterValidator(plain_name)]
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
    model: ForeignModel | None = None

    @field_validator("display")
    @classmethod
    def _display_units(cls, display: dict[str, str]) -> dict[str, str]:
        for name, unit in display.items():
            if name not in VOCABULARY:
                near = nearest(name, VOCABULARY, "; nearest is '{}'") or ""
                raise Misplaced(f"there is no quantity '{name}'{near}", name)
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
            if (at := second(names)) is not None:
                pair = "; equal ones side by side on the same edges are one, with count = 2"
                raise Misplaced(f"{what} '{names[at]}'{pair * ('drive' in what)}", *place, at)
        for at, cylinder in enumerate(self.cylinder):
            if cylinder.joint not in joints:
                text = message("config.no_joint", joint=cylinder.joint, joints=", ".join(joints))
                raise Misplaced(text, "cylinder", at, "joint")
            if (cylinder.linkage is None) != (self.mechanism.kind == "slide"):
                raise Misplaced(message("config.linkage_needed"), *("cylinder", at))
            series = ((i, name) for i, valve in enumerate(cylinder.valve) for name in valve.series)
            for i, name in series:
                if name not in self.dynamics:
                    there = ", ".join(self.dynamics) or "none"
                    text = message("config.no_dynamics", name=name, there=there)
                    raise Misplaced(text, "cylinder", at, "valve", i, "dynamics")
        if "none" in self.payload:
            raise Misplaced(message("config.payload_none"), "payload", "none")
        for load, link, _ in self.loads():
            if link not in joints:
                text = message("config.no_link", link=link, joints=", ".join(joints))
                raise Misplaced(text, "payload", load, link)
        return self

    @model_validator(mode="after")
    def _model_names_what_there_is(self) -> Rig:
        if self.model is None:
            return self
        words = ("q", "qd", "x", "v", "p_head", "p_rod")
        channels = [f"{c.name}.{word}" for c in self.cylinder for word in words]
        channels += ["p_supply", "p_tank"]
        valves = [f"{c.name}.{valve.name}" for c, valve in self.valves()]
        for key, known in (
            ("channels", channels),
            ("commands", valves),
            ("parameters", [*self.parameters()]),
            ("start", channels),
        ):
            for name in getattr(self.model, key):
                if name not in known:
                    near = get_close_matches(name, known, 1) or known[:8]
                    text = message("config.model_name", key=key, name=name, known=", ".join(near))
                    raise Misplaced(text, "model", key, name)
        if missing := [name for name in valves if name not in self.model.commands]:
            text = message("config.model_valve", valves=", ".join(missing))
            raise Misplaced(text, "model", "commands")
        return self

    @model_validator(mode="after")
    def _masses_are_positive(self) -> Rig:
        bodies: tuple[Slide | Joint, ...]
        if isinstance(self.mechanism, Slide):
            bodies, where = (self.mechanism,), ("mechanism",)
        else:
            bodies = self.mechanism.joint
            where = ("mechanism", "joint", len(bodies) - 1)
        if not float(bodies[-1].mass) > 0.0:
            raise Misplaced(message("config.no_mass", name=bodies[-1].name), *where, "mass")
        empty = {body.name: float(body.mass) for body in bodies}
        for load, link, change in self.loads():
            if change.mass is not None and float(change.mass) < empty[link]:
                fields = {"mass": float(change.mass), "empty": empty[link]}
                text = message("config.payload_light", load=load, link=link, **fields)
                raise Misplaced(text, "payload", load, link, "mass")
        return self

    @model_validator(mode="after")
    def _edges_pass_what_a_cylinder_takes(self) -> Rig:
        root = math.sqrt(float(self.supply.pressure) - float(self.supply.tank_pressure))
        for at, cylinder in enumerate(self.cylinder):
            area = min(cylinder.areas())
            for i, valve in enumerate(cylinder.valve):
                reach = max(-float(valve.command_min), float(valve.command_max))
                gains = {"flow_gain": reach * root, "compensated_gain": reach}
                for (j, edge), key in product(enumerate(valve.edge), gains):
                    gain = getattr(edge, key) or Value(0.0)
                    speed = float(gain) * gains[key] / area
                    if speed > _FASTEST:
                        fields = {"edge": valve.edge_name(edge), "name": cylinder.name}
                        fields |= {"most": gain.like(key, float(gain) * _FASTEST / speed)}
                        fields |= {"speed": speed, "fastest": _FASTEST, "key": key}
                        text = message("config.edge_too_wide", **fields)
                        raise Misplaced(text, "cylinder", at, "valve", i, "edge", j, key)
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
            number, error = (shown(item, name, unit) for item in (float(value), value.std))
            rows.append((name, number, error, label(unit), value.sure, value.source))
        header = ("parameter", "value", "standard error", "unit", "sure", "source")
        return table(header, rows, self.title or self.name)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joint names, base first (one name for a slide)."""
        if isinstance(self.mechanism, Slide):
            return (self.mechanism.name,)
        return tuple(joint.name for joint in self.mechanism.joint)

    def cylinder_named(self, name: str) -> Cylinder:
        """The cylinder of that name.

        Raises:
            InputError: there is none; names those there are.
        """
        for cylinder in self.cylinder:
            if cylinder.name == name:
                return cylinder
        there = "it has " + ", ".join(c.name for c in self.cylinder)
        raise InputError(message("config.no_cylinder", name=self.name, name2=name), hint=there)

    def valves(self) -> Iterator[tuple[Cylinder, Valve]]:
        """Every valve with its cylinder, in the order of the file and of all command vectors."""
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
        else that in which the rig file has it, else for pressures and flows that in which it has
        those of the supply, else the vocabulary's.
        """
        word = name.rpartition(".")[2]
        row, typed = VOCABULARY[word], self.typed_units

        def of_kind(units: Mapping[str, str]) -> str:
            """That of the first quantity of the same kind; '' of none."""
            rows = ((VOCABULARY[other], unit) for other, unit in units.items())
            alike = (unit for x, unit in rows if (x.unit, x.display) == (row.unit, row.display))
            return next(alike, "")

        names = (n for n in ("supply.pressure", "supply.flow_limit") if n in typed)
        supply = {n.removeprefix("supply."): typed[n] for n in names}
        given = self.display.get(word) or of_kind(self.display) or typed.get(name)
        return given or typed.get(word) or of_kind(supply) or row.display

    def shown(self, name: str, value: float, count: int = 4) -> str:
        """A value [SI] of a quantity, channel or parameter, in the unit that people see, to
        ``count`` digits.
        """
        unit = self.unit_of(name)
        number = digits(float(from_si(value, unit, quantity(name))), count)
        return number if unit == "dimensionless" else f"{number} {unit}"

    def text(self, name: str, value: float, decimals: int, sign: str = "") -> str:
        """A value [SI] in the unit that people see, as finely as so many ``decimals`` tell it in
        the vocabulary's own unit; ``sign`` is "+" where that is always said.
        """
        unit, row = self.unit_of(name), quantity(name)
        coarser = factor(unit, row.unit) / factor(row.display, row.unit)
        decimals += max(0, math.ceil(math.log10(coarser) - 1e-9))
        return f"{float(from_si(value, unit, row)):{sign}.{decimals}f} {unit}"

    @cached_property
    def typed_units(self) -> dict[str, str]:
        """The unit of each parameter not in SI, and of each word whose parameters all share it."""
        words: dict[str, set[str]] = {}
        written = {n: v for n, v in self.parameters().items() if v.unit or v.text is not None}
        for name, value in written.items():
            words.setdefault(name.rsplit(".", 1)[-1], set()).add(value.unit)
        words |= {name: {value.unit} for name, value in written.items()}
        return {name: min(units) for name, units in words.items() if len(units) == 1 and any(units)}

    def with_payload(self, load: str | None) -> Rig:
        """This rig carrying the named payload.

        Raises:
            InputError: no such payload; names those there are.
        """
        if load is None:
            return self
        return self.model_copy(update={"mechanism": self.loaded(load)})

    def loaded(self, load: str | None) -> Chain | Slide:
        """Its mechanism carrying the named payload.

        Raises:
            InputError: as `with_payload`.
        """
        if load is None:
            return self.mechanism
        if load not in self.payload:
            there = "it has " + (", ".join(self.payload) or "none")
            raise InputError(message("config.no_payload", name=self.name, load=load), hint=there)
        changes = self.payload[load]

        def changed(body: Any) -> Any:
            change = changes.get(body.name)
            if change is None:
                return body
            keys = LinkLoad.model_fields.keys() & type(body).model_fields
            given = {key: getattr(change, key) for key in keys}
            return body.model_copy(update={k: v for k, v in given.items() if v is not None})

        if isinstance(self.mechanism, Slide):
            return changed(self.mechanism)
        joints = tuple(changed(joint) for joint in self.mechanism.joint)
        return self.mechanism.model_copy(update={"joint": joints})

    def with_supply(
        self, load_sensing: LoadSensing | None = None, low_rail: LowRail | None = None
    ) -> Rig:
        """This rig on a supply that follows the load; as it is without either.

        Raises:
            InputError: a margin, or a rail, that does not go with the supply.
        """
        if load_sensing is None and low_rail is None:
            return self
        margins = {"load_sensing": load_sensing, "low_rail": low_rail}
        supply = self.supply.model_copy(update=margins)
        try:
            supply.check_following()
        except Misplaced as error:
            raise InputError(str(error)) from None
        return self.model_copy(update={"supply": supply})

    def loads(self) -> Iterator[tuple[str, str, LinkLoad]]:
        """(payload, link, what it changes of it) of each link of each payload."""
        for load, links in self.payload.items():
            for link, part in links.items():
                yield load, link, part

    def parts(self) -> Iterator[tuple[str, tuple[str | int, ...], Any]]:
        """(name prefix, location, table) of each part of the rig, a part before those inside it."""
        yield "", (), self
        yield "", ("oil",), self.oil
        yield "supply.", ("supply",), self.supply
        for key, part in tables_of(self.supply).items():
            yield "supply.", ("supply", key), part
        if isinstance(self.mechanism, Slide):
            yield f"{self.mechanism.name}.", ("mechanism",), self.mechanism
        else:
            for i, joint in enumerate(self.mechanism.joint):
                yield f"{joint.name}.", ("mechanism", "joint", i), joint
        for load, link, part in self.loads():
            yield f"{load}.{link}.", ("payload", load, link), part
        for i, cylinder in enumerate(self.cylinder):
            yield f"{cylinder.name}.", ("cylinder", i), cylinder
            for key, part in tables_of(cylinder).items():
                own = f"{key}." if key in ("mount", "sway") else ""
                yield f"{cylinder.name}.{own}", ("cylinder", i, key), part
            for key in ("force", "line"):
                for j, part in enumerate(getattr(cylinder, key)):
                    yield f"{cylinder.name}.{part.name}.", ("cylinder", i, key, j), part
        valves = [
            (cylinder.name, ("cylinder", i, "valve", j), valve)
            for i, cylinder in enumerate(self.cylinder)
            for j, valve in enumerate(cylinder.valve)
        ]
        for owner, place, valve in valves:
            yield f"{owner}.{valve.name}.", place, valve
        for name, dynamics in self.dynamics.items():
            yield f"{name}.", ("dynamics", name), dynamics
        numbers = {} if self.model is None else self.model.numbers
        yield from ((f"{name}.", ("model", "numbers", name), numbers[name]) for name in numbers)
        for owner, place, valve in valves:
            for k, edge in enumerate(valve.edge):
                yield f"{owner}.{valve.edge_name(edge)}.", (*place, "edge", k), edge
        for i, cylinder in enumerate(self.cylinder):
            for j, edge in enumerate(cylinder.edge):
                yield f"{cylinder.name}.{edge.name}.", ("cylinder", i, "edge", j), edge

    def parameters(self) -> dict[str, Value]:
        """Every scalar parameter by the name recipes use.

        ``bulk_modulus``, ``supply.pressure``, ``<joint>.joint_damping``, ``<joint>.mass``,
        ``<joint>.com_x``, ``<payload>.<joint>.mass``,
        ``<cylinder>.leakage_internal``, ``<dynamics>.natural_frequency`` (also where the file gives
        s1 and s2), ``<edge>.flow_gain``, ``<cylinder>.<force>.stiffness`` and so on."""
        results: dict[str, Value] = {}
        for prefix, _, part in self.parts():
            numbers = part.parameters() if isinstance(part, DynamicsTable) else dict(scalars(part))
            if isinstance(part, Valve):
                known = ("drive_limit", "overlap", "null")
                numbers = {key: value for key, value in numbers.items() if key in known}
            results |= {f"{prefix}{key}": value for key, value in numbers.items()}
        return results

    def with_values(
        self, values: Mapping[str, Value | float], known: Mapping[str, Value] | None = None
    ) -> Rig:
        """This rig with parameters replaced, addressed as in ``parameters``.

        Args:
            values: by name [SI].
            known: its ``parameters()``, where they are at hand: to gather them takes longest.

        Raises:
            InputError: no such parameter; names the nearest.
        """
        known = self.parameters() if known is None else known
        new: dict[str, dict[str, Value]] = {}
        for name, value in values.items():
            if name not in known:
                text = message("config.no_parameter", rig=self.name, name=name)
                raise InputError(text, hint=nearest(name, known, "nearest is '{}'"))
            prefix, dot, key = name.rpartition(".")
            if isinstance(value, Value):
                number = replace(value, unit=value.unit or known[name].unit)
            else:
                number = replace(known[name], value=float(value), text=None)
            new.setdefault(prefix + dot, {})[key] = number
        rig = self
        for prefix, place, part in self.parts():
            if prefix not in new:
                continue
            if isinstance(part, DynamicsTable):
                rig = _with_part(rig, place, part.with_values(new[prefix]))
                continue
            changed = with_scalars(part, new[prefix])
            if changed is not part:
                rig = _with_part(rig, place, changed)
        return rig

    def refuse_misfits(self) -> None:
        """Check what numbers of a table must be to one another, as in a file: `with_values` does
        not.

        Raises:
            InputError: says where, and what is wrong.
        """
        for _, place, part in self.parts():
            for check in type(part).__pydantic_decorators__.model_validators.values():
                try:
                    check.func(part)
                except ValueError as error:
                    where = ".".join(map(str, (*place, *getattr(error, "where", ()))))
                    raise InputError(f"{where}: {error}") from None

    def with_dynamics(self, by_valve: Mapping[str, str]) -> Rig:
        """This rig with valves, named ``<cylinder>.<valve>``, that have other dynamics of its file.

        Raises:
            InputError: no such valve or dynamics.
        """
        if not by_valve:
            return self
        valves = [f"{cylinder.name}.{valve.name}" for cylinder, valve in self.valves()]
        for requested, known, what in (
            (by_valve, valves, "valve"),
            (by_valve.values(), self.dynamics, "[dynamics]"),
        ):
            wrong = next((name for name in requested if name not in known), None)
            if wrong is not None:
                text = message("config.no_such_part", name=self.name, what=what, wrong=wrong)
                raise InputError(text, hint="there are " + (", ".join(known) or "none"))

        def changed(cylinder: Cylinder, valve: Valve) -> Valve:
            name = by_valve.get(f"{cylinder.name}.{valve.name}")
            return valve.model_copy(update={"dynamics": name}) if name else valve

        return self.with_valves(changed)

    def with_valves(self, changed: Callable[[Cylinder, Valve], Valve]) -> Rig:
        """This rig with each valve as ``changed(cylinder, valve)`` has it."""
        cylinders = (
            c.model_copy(update={"valve": tuple(changed(c, valve) for valve in c.valve)})
            for c in self.cylinder
        )
        return self.model_copy(update={"cylinder": tuple(cylinders)})

    def as_toml(self) -> dict[str, Any]:
        """The rig as nested plain values for a TOML writer; read back, they give the same rig."""
        return self.model_dump(by_alias=True, exclude_none=True, exclude_defaults=True)


def _with_part(model: Any, place: tuple[str | int, ...], part: Any) -> Any:
    """A table with another part at a place; its other parts stay the very same objects, by which
    `plant.build` finds what it has built of them.
    """
    if not place:
        return part
    key: Any = place[0]
    rest = place[1:]
    if isinstance(model, tuple):
        inner = _with_part(model[key], rest, part)
        return (*model[:key], inner, *model[key + 1 :])  # type: ignore[operator]
    if isinstance(model, dict):
        return {**model, key: _with_part(model[key], rest, part)}
    return model.model_copy(update={key: _with_part(getattr(model, str(key)), rest, part)})
