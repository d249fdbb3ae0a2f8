"""Where everything of a plant lies: states, nodes, valves, workspace; and what it is called.

Nothing else computes an offset. Kernels find states and workspace by ``plant.at`` (`Offsets`) and
by the fields of the parts' rows, Python by `Layout`."""

from dataclasses import dataclass, field
from typing import NamedTuple

from ehbench.config.rig import Rig
from ehbench.parts import friction, valve
from ehbench.parts.nodes import SUPPLY, TANK
from ehbench.parts.sway import SWAY
from ehbench.physics.arm import work_size

SIDES = ("head", "rod")


class Offsets(NamedTuple):
    """Where things begin, as kernels need it.

    In the state: joint coordinates stand first, ``joints`` of them; their rates from ``rates`` on;
    the pressure of the supply line at ``supply``; ``states`` in all.

    In the workspace, after that of the mechanism: ``torque`` of each joint [N·m]; ``inertia`` that
    friction adds to it [kg·m²]; ``net`` inflow of each node [m³/s]; ``slope`` of the flow over the
    pressure at each node [m³/(s·Pa)]; ``opening`` of each valve [V]; ``flow`` of each edge [m³/s],
    then the ``pump``'s; ``work`` in all."""

    joints: int
    rates: int
    supply: int
    states: int
    torque: int
    inertia: int
    net: int
    slope: int
    opening: int
    flow: int
    pump: int
    work: int


class Element(NamedTuple):
    """An element of a valve's dynamics: its ``valve``, number of its ``law``, name of its
    ``dynamics`` in the rig, place of its first ``state``."""

    valve: int
    law: int
    dynamics: str
    state: int


@dataclass(frozen=True)
class Layout:
    """Names of what a plant's tables hold, in order, and where each of its states stands.

    ``valves`` and ``edges`` are called ``<cylinder>.<valve>`` and ``<cylinder>.<edge>``, those of
    valves first, ``elements`` are those of the valves' dynamics, in order, ``several`` the valves
    with more than one dynamics, ``frictions`` the numbers of the cylinders' laws, ``lines`` the
    cylinder and the end of each line, ``mounts`` the cylinders whose mount gives way, ``sways``
    those with a load that sways, ``played`` the channels of forces that stand behind the valves'
    commands in a row of commands, and ``state_names`` say what each state is, such as
    ``boom.p_head`` or ``boom.hect.opening``."""

    joints: tuple[str, ...]
    cylinders: tuple[str, ...]
    valves: tuple[str, ...]
    edges: tuple[str, ...]
    elements: tuple[Element, ...]
    several: tuple[int, ...]
    frictions: tuple[int, ...]
    lines: tuple[tuple[int, str], ...]
    mounts: tuple[int, ...]
    sways: tuple[int, ...]
    played: tuple[str, ...]
    state_names: tuple[str, ...]
    _at: dict[str, int] = field(repr=False)

    @property
    def states(self) -> int:
        """Length of the state vector."""
        return len(self.state_names)

    @property
    def nodes(self) -> int:
        """How many nodes the circuit has."""
        return 2 + len(SIDES) * len(self.cylinders) + len(self.lines)

    def node(self, cylinder: int, end: str) -> int:
        """The node of a cylinder's ``head`` or ``rod``, or of ``supply`` or ``tank``."""
        if end in SIDES:
            return 2 + len(SIDES) * cylinder + SIDES.index(end)
        return {"supply": SUPPLY, "tank": TANK}[end]

    def port(self, cylinder: int, end: str) -> int:
        """The node that edges of an end join: as `node`, but the line's where that end has one."""
        if (cylinder, end) in self.lines:
            return self.nodes - len(self.lines) + self.lines.index((cylinder, end))
        return self.node(cylinder, end)

    def state(self, name: str, index: int = 0) -> int:
        """Position in the state of ``q``, ``qd`` of joint ``index``, ``p_head``, ``p_rod`` of a
        cylinder or of a state of its friction, lines or mount, ``opening``, ``rate`` of a valve, or
        ``p_supply``.

        Raises:
            KeyError: there is no such state, as of a valve without dynamics."""
        if name == "p_supply":
            return self._at[name]
        owners = {"q": self.joints, "qd": self.joints, "opening": self.valves, "rate": self.valves}
        return self._at[f"{owners.get(name, self.cylinders)[index]}.{name}"]

    @property
    def inner_states(self) -> tuple[tuple[str, int], ...]:
        """(channel, position) of the states of valves with several dynamics, but for the
        opening."""
        results = []
        for element in self.elements:
            for at in range(element.state, element.state + len(valve.LAWS[element.law].states)):
                name, outer = self.state_names[at], f"{self.valves[element.valve]}.opening"
                if element.valve in self.several and name != outer:
                    results.append((name.replace(".rate", ".opening_rate"), at))
        return tuple(results)

    @property
    def friction_states(self) -> tuple[tuple[int, str], ...]:
        """(cylinder, name) of each state of the laws of friction."""
        laws = (friction.LAWS[law] for law in self.frictions)
        return tuple((index, key) for index, law in enumerate(laws) for key in law.states)

    @property
    def part_states(self) -> tuple[tuple[int, str], ...]:
        """(cylinder, name) of each state of the frictions, lines, mounts and what sways."""
        lines = ((cylinder, f"p_line_{end}") for cylinder, end in self.lines)
        mounts = ((cylinder, "mount_deflection") for cylinder in self.mounts)
        sways = ((cylinder, key) for cylinder in self.sways for key in SWAY)
        return (*self.friction_states, *lines, *mounts, *sways)

    def friction_state(self, cylinder: int) -> int:
        """Where the states of a cylinder's friction begin, −1 where it has none."""
        states = friction.LAWS[self.frictions[cylinder]].states
        return self.state(states[0], cylinder) if states else -1

    def offsets(self) -> Offsets:
        """Where things begin, for kernels."""
        n, nodes = len(self.joints), self.nodes
        ends = [int(work_size(n))]
        for size in (n, n, nodes, nodes, len(self.valves), len(self.edges), 1):
            ends.append(ends[-1] + size)
        return Offsets(n, n, self.state("p_supply"), self.states, *ends)


def layout(rig: Rig) -> Layout:
    """The layout of a rig's plant: ``q, qd, [p_head, p_rod] per cylinder, the states of each
    valve's elements, those of each cylinder's friction, lines, mount and sway, p_supply``."""
    valves = tuple(f"{c.name}.{v.name}" for c, v in rig.valves())
    names = [f"{joint}.{key}" for key in ("q", "qd") for joint in rig.joint_names]
    names += [f"{c.name}.p_{side}" for c in rig.cylinder for side in SIDES]
    elements: list[Element] = []
    for index, (_, item) in enumerate(rig.valves()):
        kinds = ((entry, type(rig.dynamics[entry])) for entry in item.series)
        laws = ((entry, kind) for entry, kind in kinds if kind in valve.ELEMENTS)
        series = [(entry, valve.ELEMENTS.index(kind)) for entry, kind in laws]
        for entry, law in series:
            elements.append(Element(index, law, entry, len(names)))
            owner = valves[index] if entry == series[-1][0] else f"{valves[index]}.{entry}"
            names += [f"{owner}.{key}" for key in valve.LAWS[law].states]
    given = (type(c.friction) for c in rig.cylinder)
    frictions = tuple(friction.TABLES.index(k) if k in friction.TABLES else 0 for k in given)
    for cylinder, law in zip(rig.cylinder, frictions, strict=True):
        names += [f"{cylinder.name}.{key}" for key in friction.LAWS[law].states]
        names += [f"{cylinder.name}.p_{line.name}" for line in cylinder.line]
        names += [f"{cylinder.name}.mount_deflection"] if cylinder.mount is not None else []
        names += [f"{cylinder.name}.{key}" for key in SWAY if cylinder.sway is not None]
    names.append("p_supply")
    return Layout(
        joints=rig.joint_names,
        cylinders=tuple(c.name for c in rig.cylinder),
        valves=valves,
        edges=tuple(rig.all_edges()),
        elements=tuple(elements),
        several=tuple(i for i, (_, item) in enumerate(rig.valves()) if len(item.series) > 1),
        frictions=frictions,
        lines=tuple((i, line.end) for i, c in enumerate(rig.cylinder) for line in c.line),
        mounts=tuple(i for i, c in enumerate(rig.cylinder) if c.mount is not None),
        sways=tuple(i for i, c in enumerate(rig.cylinder) if c.sway is not None),
        played=tuple(dict.fromkeys(f.channel for c in rig.cylinder for f in c.force if f.channel)),
        state_names=tuple(names),
        _at={name: at for at, name in enumerate(names)},
    )
