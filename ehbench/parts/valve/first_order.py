"""A first-order valve: ``τ ẋ = u − x``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import model_validator

from ehbench.parts.fault import Fault
from ehbench.parts.valve.law import SETTLED, DynamicsTable, ValveElement
from ehbench.runtime.compiled import part_kernel
from ehbench.vocabulary.fields import Q, Value, scalars


class FirstOrder(DynamicsTable):
    """First-order valve dynamics ``τ ẋ = u − x``, by ``lag`` τ or by its ``corner`` 1/τ."""

    kind: Literal["first_order"]
    lag: Annotated[Value, Q("lag")] | None = None
    corner: Annotated[Value, Q("corner")] | None = None

    @model_validator(mode="after")
    def _one_form(self) -> FirstOrder:
        if (self.lag is None) == (self.corner is None):
            raise ValueError("give lag or corner")
        if self.lag is not None and float(self.lag) <= 0.0:
            raise ValueError("lag must be positive")
        return self

    def time(self) -> float:
        """τ [s]."""
        return float(self.lag) if self.lag is not None else 1.0 / float(self.corner)  # type: ignore[arg-type]

    def row(self) -> dict[str, float]:
        return {"tau": self.time(), "fastest": 1.0 / self.time()}

    def period(self) -> float:
        """As `DynamicsTable.period`: 2π τ."""
        return 2.0 * math.pi * self.time()

    def parameters(self) -> dict[str, Value]:
        """As `DynamicsTable.parameters`: the lag also where the file gives the corner."""
        result = dict(scalars(self))
        if self.corner is not None:
            result["lag"] = Value(self.time(), sure=self.corner.sure, source=self.corner.source)
        return result

    def with_values(self, new: Mapping[str, Value]) -> FirstOrder:
        """As `DynamicsTable.with_values`; a corner turns into a lag where that is given."""
        form = {"corner": None} if "lag" in new else {}
        return self.model_copy(update=form | dict(new))


@part_kernel
def rates(element, signal, y, dy):
    """Write the opening's rate [V/s]; gives the opening [V]."""
    at = element.state
    dy[at] = (signal - y[at]) / element.tau
    return y[at]


@part_kernel
def settle(element, value, y):
    """The opening stands at ``value`` [V]."""
    y[element.state] = value


@part_kernel
def advance(element, signal, dt, y):
    """The exact answer over ``dt`` [s] under a held signal [V]."""
    at = element.state
    y[at] = signal + (y[at] - signal) * math.exp(-dt / element.tau)


@part_kernel
def recover(element, signal, dt, y, later):
    """The opening is all there is."""


@part_kernel
def finish(element, signal, y, slope, d):
    """The exact answer in place of the Runge–Kutta step's."""
    at = element.state
    off = element.tau * slope[at] * math.exp(-d / element.tau)
    # an exponential tail would end in subnormal numbers, with which processors are slow
    y[at] = signal if abs(off) < SETTLED else signal - off


@part_kernel
def lag(element):
    """τ [s]."""
    return element.tau


LAW = ValveElement(
    name="first_order",
    table=FirstOrder,
    columns=("tau",),
    states=("opening",),
    rates=rates,
    settle=settle,
    advance=advance,
    finish=finish,
    recover=recover,
    lag=lag,
)

FAULTS = (Fault("lag", ("lag",), step=0.05, trials=(0.5, 1.5), rank=4, wide=True),)
