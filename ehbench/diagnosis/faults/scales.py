"""What amounts of the fault table are measured by: forces, pressures, commands of a machine."""

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from ehbench.config.rig import Cylinder, Rig
from ehbench.config.rig.valves import Edge, Valve
from ehbench.data.record import Record
from ehbench.parts.fault import Amount
from ehbench.plant.build import load_of

LOWEST = 1.0e6  # [Pa] that an end of a cylinder comes to at least
CREEP = 0.01  # [m/s] of a piston whose leakage is a unit
# shares of the largest command between which some of those that open a valve must lie, and how many
LITTLE, MUCH, SOME = 0.1, 0.8, 0.05
RUBS = 0.006  # share of a cylinder's force that its friction has where a search begins at least


class Scales:
    """Scales [SI] by name, of a cylinder, of a valve, and of a channel of some logs.

    ``unit``, ``second``: 1 · ``command``: the largest of the valve · ``reach``: the largest in the
    logs in the direction that opens an edge · ``travel``: of a saturating edge · ``pressure``: that
    an end comes to · ``force``: of that pressure · ``leakage``: of 10 mm/s at it · ``spring``: of
    the oil at mid-stroke [N/m] · ``load``: the least mass that moves · ``damper``: their impedance
    [N·s/m] · ``friction``: where a search begins · ``coulomb``: of the rig · ``swept``: by the
    piston at its head end [m³] · ``stroke``: of the cylinder · ``spread``: of the channel.
    """

    def __init__(
        self,
        rig: Rig,
        cylinder: Cylinder | None,
        valve: Valve | None,
        records: Sequence[Record],
        channel: str = "",
        part: Any = None,
    ) -> None:
        self.rig, self.valve, self.records, self.channel = rig, valve, records, channel
        self.part, self._cylinder = part, cylinder

    @property
    def cylinder(self) -> Cylinder:
        assert self._cylinder is not None  # a channel's scale alone has none
        return self._cylinder

    def __getitem__(self, name: str) -> float:
        return 1.0 if name in ("unit", "second") else float(getattr(self, name))

    def of(self, amount: Amount, which: int = 0) -> float:
        """An amount [SI], by its first factor or another."""
        return amount.factors[min(which, len(amount.factors) - 1)] * self[amount.scale]

    def written(self, amount: Amount | str | bool) -> Any:
        """An amount as a rig file has it, with its bounds."""
        if not isinstance(amount, Amount):
            return amount
        value = self.of(amount)
        if not amount.unit:
            return value
        if amount.span is None:
            return f"{value!r} {amount.unit}"
        low, high = (factor * value for factor in amount.span)
        each = {"value": value, "lower": low, "upper": high}
        return {key: f"{item!r} {amount.unit}" for key, item in each.items()}

    @property
    def empty(self) -> bool:
        """Whether no log commands the valve in the direction that opens the edge."""
        return self.valve is not None and self.reach <= 0.0

    @property
    def graded(self) -> bool:
        """Whether commands of several sizes open the valve: no log of one size tells a drive that
        gives no more from a gain.
        """
        assert self.valve is not None
        channel = f"{self.cylinder.name}.{self.valve.name}.command"
        logs = [abs(log[channel]) for log in self.records if channel in log]
        sizes = np.concatenate(logs) / self.reach
        between = np.mean((sizes > LITTLE) & (sizes < MUCH))
        starts, ends = self.valve.given
        return bool(between > SOME * np.mean(sizes > LITTLE)) and starts <= 0.0 <= ends

    @cached_property
    def command(self) -> float:
        assert self.valve is not None
        return max(float(self.valve.command_max), -float(self.valve.command_min))

    @cached_property
    def reach(self) -> float:
        assert self.valve is not None
        channel = f"{self.cylinder.name}.{self.valve.name}.command"
        logs = [log[channel] for log in self.records if channel in log]
        signs = (self.part.sign,) if isinstance(self.part, Edge) else (1, -1)
        return max(float(np.max(sign * y)) for y in logs for sign in signs)

    @cached_property
    def travel(self) -> float:
        return float(self.part.opening_max) - float(self.part.deadband)

    @cached_property
    def pressure(self) -> float:
        supply, relief = float(self.rig.supply.pressure), self.cylinder.relief_pressure
        pumped = [] if self.cylinder.pump is None or relief is None else [float(relief)]
        return max(supply, LOWEST, *pumped)

    @cached_property
    def force(self) -> float:
        return self.cylinder.areas()[0] * self.pressure

    @cached_property
    def leakage(self) -> float:
        return self.cylinder.areas()[0] * CREEP / self.pressure

    @cached_property
    def swept(self) -> float:
        return self.cylinder.areas()[0] * float(self.cylinder.stroke)

    @cached_property
    def stroke(self) -> float:
        return float(self.cylinder.stroke)

    @cached_property
    def coulomb(self) -> float:
        return float(self.cylinder.friction_coulomb)

    @cached_property
    def friction(self) -> float:
        return max(self.coulomb, RUBS * self.force)

    @cached_property
    def spring(self) -> float:
        item = self.cylinder
        half = 0.5 * float(item.stroke)
        bulk = float(item.bulk_modulus or self.rig.oil.bulk_modulus)
        volumes = (item.volume_head, half), (item.volume_rod, -half)
        ends = zip(item.areas(), volumes, strict=True)
        return sum(bulk * area**2 / max(float(v) + x * area, 1e-9) for area, (v, x) in ends)

    @cached_property
    def load(self) -> float:
        return load_of(self.rig, self.rig.cylinder.index(self.cylinder))

    @cached_property
    def damper(self) -> float:
        return math.sqrt(self.spring * self.load)

    @cached_property
    def spread(self) -> float:
        logs = [log[self.channel] for log in self.records if self.channel in log]
        return max(float(np.std(y)) for y in logs) or 1.0
