"""A second-order valve: ``ẍ = ω_n² (u − x) − 2 ζ ω_n ẋ`` (thesis 2.12)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import model_validator

from ehbench.parts.fault import Fault
from ehbench.parts.valve.law import SETTLED, DynamicsTable, ValveElement
from ehbench.runtime.compiled import part_kernel
from ehbench.vocabulary.fields import Q, Value, scalars


class SecondOrder(DynamicsTable):
    """Second-order dynamics opening/command, by ω_n and ζ or the denominator s2·s² + s1·s + 1."""

    kind: Literal["second_order"] = "second_order"
    natural_frequency: Annotated[Value, Q("natural_frequency")] | None = None
    damping_ratio: Annotated[Value, Q("damping_ratio")] | None = None
    s2: Annotated[Value, Q("s2")] | None = None
    s1: Annotated[Value, Q("s1")] | None = None

    @model_validator(mode="after")
    def _one_form(self) -> SecondOrder:
        pair = self.natural_frequency is not None and self.damping_ratio is not None
        poly = self.s2 is not None and self.s1 is not None
        keys = ("natural_frequency", "damping_ratio", "s2", "s1")
        if sum(getattr(self, key) is not None for key in keys) != 2 or pair == poly:
            raise ValueError("give natural_frequency and damping_ratio, or s2 and s1")
        if poly and float(self.s2) <= 0:  # type: ignore[arg-type]
            raise ValueError("s2 must be positive")
        return self

    def frequency_and_damping(self) -> tuple[float, float]:
        """(ω_n [rad/s], ζ)."""
        if self.natural_frequency is not None:
            return float(self.natural_frequency), float(self.damping_ratio)  # type: ignore[arg-type]
        omega = 1.0 / math.sqrt(float(self.s2))  # type: ignore[arg-type]
        return omega, 0.5 * omega * float(self.s1)  # type: ignore[arg-type]

    def row(self) -> dict[str, float]:
        return second_order(*self.frequency_and_damping())

    def period(self) -> float:
        return 2.0 * math.pi / self.frequency_and_damping()[0]

    def parameters(self) -> dict[str, Value]:
        """As `DynamicsTable.parameters`: ω_n and ζ also where the file gives s1 and s2."""
        result = dict(scalars(self))
        if self.s1 is not None and self.s2 is not None:
            omega, zeta = self.frequency_and_damping()
            for key, value, given in (
                ("natural_frequency", omega, self.s2),
                ("damping_ratio", zeta, self.s1),
            ):
                result[key] = Value(value, sure=given.sure, source=given.source)
        return result

    def with_values(self, new: Mapping[str, Value]) -> SecondOrder:
        """As `DynamicsTable.with_values`; s1 and s2 turn into ω_n and ζ where one is given."""
        if not new:
            return self
        if self.natural_frequency is not None or {"s1", "s2"} & set(new):
            return self.model_copy(update=dict(new))
        omega, zeta = self.frequency_and_damping()
        base = {"natural_frequency": Value(omega), "damping_ratio": Value(zeta)}
        values: dict[str, Any] = {"note": self.note, **base, **new}
        return SecondOrder.model_construct(None, **values)


def second_order(omega: float, zeta: float) -> dict[str, float]:
    """Columns of an element of natural frequency [rad/s] and damping ratio."""
    stiffness = omega**2
    return {"stiffness": stiffness, "damping": 2 * zeta * omega, "fastest": math.sqrt(stiffness)}


@part_kernel
def rates(element, signal, y, dy):
    """Write opening rate [V/s] and acceleration [V/s²]; gives the opening [V]."""
    at = element.state
    dy[at] = y[at + 1]
    dy[at + 1] = element.stiffness * (signal - y[at]) - element.damping * y[at + 1]
    return y[at]


@part_kernel
def settle(element, value, y):
    """The opening stands at ``value`` [V]."""
    y[element.state], y[element.state + 1] = value, 0.0


@part_kernel
def transition(stiffness, damping, dt):
    """The 2 × 2 transition (row by row) of ``ë + damping ė + stiffness e = 0`` over ``dt`` [s].

    Args:
        stiffness: ω_n² > 0 [1/s²].
        damping: 2 ζ ω_n [1/s].
    """
    s = 0.5 * damping
    root = s * s - stiffness
    if root < 0.0:
        w = math.sqrt(-root)
        c, z = math.exp(-s * dt) * math.cos(w * dt), math.exp(-s * dt) * math.sin(w * dt) / w
    elif root == 0.0:
        c, z = math.exp(-s * dt), math.exp(-s * dt) * dt
    else:
        w = math.sqrt(root)
        slow, fast = math.exp((w - s) * dt), math.exp(-(w + s) * dt)
        c, z = 0.5 * (slow + fast), 0.5 * (slow - fast) / w
    return c + s * z, z, -stiffness * z, c - s * z


@part_kernel
def advance(element, signal, dt, y):
    """The exact answer over ``dt`` [s] under a held signal [V]."""
    at = element.state
    a, b, c, d = transition(element.stiffness, element.damping, dt)
    off, rate = y[at] - signal, y[at + 1]
    y[at], y[at + 1] = signal + a * off + b * rate, c * off + d * rate


@part_kernel
def recover(element, signal, dt, y, later):
    """The rate [V/s] that brings the opening to ``later`` [V] within ``dt`` [s]."""
    at = element.state
    a, b, _, _ = transition(element.stiffness, element.damping, dt)
    if b > 0.0:
        y[at + 1] = (later - signal - a * (y[at] - signal)) / b


@part_kernel
def finish(element, signal, y, slope, d):
    """From the fourth to the eighth order of ``d`` [s]; a valve that has arrived is set down.

    The valve is linear and its signal is held, so a Runge–Kutta step is the Taylor series of its
    exact answer up to d⁴; the next four terms follow from ``x⁽ⁿ⁺²⁾ = −ω² x⁽ⁿ⁾ − 2ζω x⁽ⁿ⁺¹⁾``."""
    at = element.state
    low, high = slope[at], slope[at + 1]
    if low == 0.0 and high == 0.0:
        return
    k, c = element.stiffness, element.damping
    for _ in range(3):
        low, high = high, -k * low - c * high
    share, more, rate = d * d * d * d / 24.0, 0.0, 0.0
    for n in range(5, 9):
        low, high = high, -k * low - c * high
        share *= d / n
        more += share * low
        rate += share * high
    y[at] += more
    y[at + 1] += rate
    # an exponential tail would end in subnormal numbers, with which processors are slow
    if abs(y[at] - signal) < SETTLED and abs(y[at + 1]) < SETTLED * element.fastest:
        y[at], y[at + 1] = signal, 0.0


@part_kernel
def lag(element):
    """2 ζ/ω_n [s]."""
    return element.damping / element.stiffness


LAW = ValveElement(
    name="second_order",
    table=SecondOrder,
    columns=("stiffness", "damping"),
    states=("opening", "rate"),
    rates=rates,
    settle=settle,
    advance=advance,
    finish=finish,
    recover=recover,
    lag=lag,
)

FAULTS = (
    Fault(
        "lag",
        ("natural_frequency",),
        step=-0.05,
        high=2.0,
        trials=(-0.6, -0.4, -0.2, 0.5),
        rank=4,
        wide=True,
    ),
    Fault("damping ratio", ("damping_ratio",), step=0.05, high=2.0, rank=5, wide=True),
)
