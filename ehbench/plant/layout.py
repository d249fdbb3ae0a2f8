"""Where everything of a plant lies: states, nodes, valves, workspace; and what it is called.

Nothing else computes an offset. Kernels find states and workspace by ``plant.at`` (`Offsets`) and
by the fields of the parts' rows, Python by `Layout`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from ehbench.parts import friction, valve
from ehbench.parts.nodes import SUPPLY, TANK
from ehbench.physics.arm import work_size
from ehbench.rig import Cylinder, Rig

SIDES = ("head", "rod")


class Offsets(NamedTuple):
    """Where things begin, as kernels need it.

    In the state: joint coordinates stand first, ``joints`` of them; their rates from ``rates`` on;
    the pressure of the supply line at ``supply``; ``states`` in all.

    In the workspace, after that of the mechanism: ``torque`` of each joint [N·m]; ``net`` inflow of
    each node [m³/s]; ``slope`` of the flow over the pressure at each node [m³/(s·Pa)]; ``opening``
    of each valve [V]; ``flow`` of each edge [m³/s], then the ``pump``'s; ``work`` in all.
    """

    joints: int
    rates: int
    supply: int
    states: int
    torque: int
    net: int
    slope: int
    opening: int
    flow: int
    pump: int
    work: int


@dataclass(frozen=True)
class Layout:
    """Names of what a plant's tables hold, in order, and where each of its states stands.

    ``valves`` and ``edges`` are called ``<cylinder>.<valve>`` and ``<cylinder>.<edge>``, those of
    valves first,
    ``elements`` are (valve, number of its law) of each element of the valves' dynamics, and
    ``state_names`` say what each state is, such as ``boom.p_head`` or ``boom.hect.opening``.
    """

    joints: tuple[str, ...]
    cylinders: tuple[str, ...]
    valves: tuple[str, ...]
    edges: tuple[str, ...]
    elements: tuple[tuple[int, int], ...]
    frictions: tuple[int, ...]
    state_names: tuple[str, ...]
    _at: dict[str, int] = field(repr=False)

    @property
    def states(self) -> int:
        """Length of the state vector."""
        return len(self.state_names)

    @property
    def nodes(self) -> int:
        """How many nodes the circuit has."""
        return 2 + len(SIDES) * len(self.cylinders)

    def node(self, cylinder: int, end: str) -> int:
        """The node of a cylinder's ``head`` or ``rod``, or of ``supply`` or ``tank``."""
        if end in SIDES:
            return 2 + len(SIDES) * cylinder + SIDES.index(end)
        return {"supply": SUPPLY, "tank": TANK}[end]

    def state(self, name: str, index: int = 0) -> int:
        """Position in the state of ``q``, ``qd`` of joint ``index``, ``p_head``, ``p_rod`` of a
        cylinder, ``opening``, ``rate`` of a valve, or ``p_supply``.

        Raises:
            KeyError: there is no such state, as of a valve without dynamics.
        """
        if name == "p_supply":
            return self._at[name]
        owners = {"q": self.joints, "qd": self.joints, "opening": self.valves, "rate": self.valves}
        return self._at[f"{owners.get(name, self.cylinders)[index]}.{name}"]

    def offsets(self) -> Offsets:
        """Where things begin, for kernels."""
        n, nodes = len(self.joints), self.nodes
        ends = [int(work_size(n))]
        for size in (n, nodes, nodes, len(self.valves), len(self.edges), 1):
            ends.append(ends[-1] + size)
        return Offsets(n, n, self.state("p_supply"), self.states, *ends)


def layout(rig: Rig) -> Layout:
    """The layout of a rig's plant: ``q, qd, [p_head, p_rod] per cylinder, the states of each
    valve's elements, those of each cylinder's friction, p_supply``.
    """
    valves = tuple(f"{c.name}.{v.name}" for c, v in rig.valves())
    names = [f"{joint}.{key}" for key in ("q", "qd") for joint in rig.joint_names]
    names += [f"{c.name}.p_{side}" for c in rig.cylinder for side in SIDES]
    elements = tuple(
        (index, law) for index, (_, v) in enumerate(rig.valves()) for law in _elements(v)
    )
    for index, law in elements:
        names += [f"{valves[index]}.{key}" for key in valve.LAWS[law].states]
    frictions = tuple(_friction(c) for c in rig.cylinder)
    for cylinder, law in zip(rig.cylinder, frictions, strict=True):
        names += [f"{cylinder.name}.{key}" for key in friction.LAWS[law].states]
    names.append("p_supply")
    return Layout(
        joints=rig.joint_names,
        cylinders=tuple(c.name for c in rig.cylinder),
        valves=valves,
        edges=tuple(rig.all_edges()),
        elements=elements,
        frictions=frictions,
        state_names=tuple(names),
        _at={name: at for at, name in enumerate(names)},
    )


def _elements(item) -> tuple[int, ...]:
    """Numbers of the laws of a valve's elements, from its command to its opening."""
    return () if item.dynamics is None else (valve.BY_NAME["second_order"],)


def _friction(item: Cylinder) -> int:
    """Number of a cylinder's law of friction."""
    return 0
