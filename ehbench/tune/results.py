"""What tuning leaves: the gains, and what they rest on at every operating point."""

from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np

from ehbench.config.rig import Rig
from ehbench.control.functions import (
    CROSS,
    DIRECTION,
    METERED,
    METERING,
    OVERRUNNING,
    PATH_FLOWS,
    PATHS,
    Circuit,
    supply_draw,
)
from ehbench.tune.operating_point import OperatingPoint
from ehbench.vocabulary.codes import FUNCTIONS

DIGITS = 9  # of the numbers in the file


@dataclass(frozen=True)
class EdgeUse:
    """An edge under a working function: ``way`` ±1 of the oil, 0 shut; ``meters``: it sets the
    motion; ``shares`` of A1 |v| and A2 |v| that it carries."""

    name: str
    ends: tuple[str, str]
    way: int
    meters: bool
    shares: tuple[int, int]


@dataclass(frozen=True)
class FunctionUse:
    """A working function on a circuit: ``direction`` ±1, ``along`` of the load, ``cross`` path
    between the ends or '', ``metered`` chamber, oil that it ``draws`` per stroke [m²]."""

    name: str
    direction: int
    along: bool
    cross: str
    metered: str
    draws: float
    edges: tuple[EdgeUse, ...]


def functions_of(rig: Rig, circuit: Circuit) -> tuple[FunctionUse, ...]:
    """The working functions that a cylinder's circuit can do, hold left out."""
    return tuple(_use(rig, circuit, f) for f in range(1, len(FUNCTIONS)) if circuit.able[f])


def _use(rig: Rig, circuit: Circuit, function: int) -> FunctionUse:
    paths = np.flatnonzero(PATH_FLOWS[function].any(axis=1)).tolist()
    by_edge = {int(circuit.paths[path]): path for path in paths}
    edges = []
    for at, (_, valve, edge) in enumerate(rig.edges()):
        if not circuit.first <= at < circuit.first + circuit.count:
            continue
        path = by_edge.get(at, -1)
        label = valve.title if valve.title and len(valve.edge) == 1 else valve.edge_name(edge)
        shares = (0, 0)
        if path >= 0:
            head, rod = (int(DIRECTION[function] * share) for share in PATH_FLOWS[function, path])
            shares = (head, rod)
        edges.append(
            EdgeUse(
                label,
                (edge.from_, edge.to),
                int(circuit.along[path]) if path >= 0 else 0,
                path == METERING[function],
                shares,
            )
        )
    cross = int(CROSS[function])
    return FunctionUse(
        FUNCTIONS[function],
        int(DIRECTION[function]),
        bool(OVERRUNNING[function]),
        dict(enumerate(PATHS)).get(cross, ""),
        ("", "head", "rod")[METERED[function]],
        float(supply_draw(function, circuit)),
        tuple(edges),
    )


@dataclass(frozen=True)
class Margins:
    """``gain_margin`` (factor), ``phase_margin`` [rad], the least of the feedback loop and the
    off-side's, each with the other closed; ``bandwidth`` [rad/s] of speed over desired speed, −3
    dB."""

    gain_margin: float
    phase_margin: float
    bandwidth: float


@dataclass(frozen=True)
class PointResult:
    """One operating point. Poles [rad/s] as (real, imaginary); ``curve`` is the least damping ratio
    over ``Tuning.gains``.

    ``counts``: the gain was chosen on it. Others are shown only: no load makes the controller use
    that function there. ``open``: no feedback at all; ``held``: the off-side's alone, where the
    root locus begins. ``natural_frequency_*`` [rad/s] and ``damping_ratio_*`` of the least damped
    pair. ``gain_limit`` [m³/(s·Pa)]: where the
    loop becomes unstable, inf if not in the range looked at. ``bias`` [m/s]: what feedback without
    a washout would take from the steady speed, and ``damping_ratio_plain`` what it would reach."""

    name: str
    point: OperatingPoint
    counts: bool
    open_poles: tuple[tuple[float, float], ...]
    closed_poles: tuple[tuple[float, float], ...]
    natural_frequency_open: float
    natural_frequency_closed: float
    damping_ratio_open: float
    damping_ratio_held: float
    damping_ratio_closed: float
    damping_ratio_plain: float
    bias: float
    gain_limit: float
    margins: Margins
    curve: tuple[float, ...]


@dataclass(frozen=True)
class Locus:
    """A root locus at one operating point: poles [rad/s], shape (parameters, poles), over
    ``parameter``, ``feedback_gain`` or ``washout``.

    ``chosen`` the parameter used and its poles; ``crossing`` the parameter at the stability limit
    and its poles there, None where it has none; ``frame`` (least real, most real, most imaginary
    part) that shows the poles that matter."""

    name: str
    parameter: str
    values: tuple[float, ...]
    real: tuple[tuple[float, ...], ...]
    imag: tuple[tuple[float, ...], ...]
    chosen: float
    chosen_poles: tuple[tuple[float, float], ...]
    crossing: float | None
    crossing_poles: tuple[tuple[float, float], ...]
    frame: tuple[float, float, float]


@dataclass(frozen=True)
class StepResponse:
    """Speed [m/s] over ``t`` [s] after a step of 1 m/s, without feedback and with it."""

    name: str
    t: tuple[float, ...]
    v_open: tuple[float, ...]
    v_closed: tuple[float, ...]


@dataclass(frozen=True)
class Alternative:
    """Another law at its best gain, and its least damping ratio."""

    what: str
    washout: float
    ramp_washout: float
    off_gain: float
    feedback: str
    feedback_gain: float
    damping_ratio: float


@dataclass(frozen=True)
class Curves:
    """Equivalent mass, gravity force, damping over the stroke for one payload (thesis B.1–B.4)."""

    payload: str
    x: tuple[float, ...]
    q: tuple[float, ...]
    mass: tuple[float, ...]
    gravity_force: tuple[float, ...]
    damping: tuple[float, ...]


@dataclass(frozen=True)
class Robustness:
    """Draws of the identified parameters at the ``points`` least damped: the share that reaches the
    target, the range of the worst damping ratio (5, 50, 95 %)."""

    draws: int
    parameters: tuple[str, ...]
    points: int
    share: float | None
    quantiles: tuple[float, ...]
    damping_ratios: tuple[float, ...]


@dataclass(frozen=True)
class Tuning:
    """Gains of the pressure feedback and what they rest on; all SI.

    ``feedback_gain`` K_p [m³/(s·Pa)] by working function, ``washout`` ω_w and ``ramp_washout`` ω_r
    [rad/s] (0 for none), ``off_gain`` [m³/(s·Pa)], ``low_pressure`` and ``cross_drop`` [Pa],
    ``tick`` and ``delay`` [s], ``supply`` by `ehbench.config.rig.Supply.facts`. ``damping_ratio``
    the
    least over the operating points that count, ``damping_ratio_open`` and ``_open_most`` the range
    without any feedback, ``_held`` and ``_held_most`` with the off-side's alone. ``met``: target
    and constraints hold at each of them. ``gains`` the abscissa of the curves; ``functions`` what
    the circuit can do."""

    rig: str
    supply: dict[str, Any]
    cylinder: str
    feedback_gain: dict[str, float]
    washout: float
    ramp_washout: float
    off_gain: float
    low_pressure: float
    cross_drop: float
    tick: float
    delay: float
    target: float
    damping_ratio: float
    damping_ratio_open: float
    damping_ratio_open_most: float
    damping_ratio_held: float
    damping_ratio_held_most: float
    met: bool
    constraints: dict[str, float]
    gains: tuple[float, ...]
    worst_curve: tuple[float, ...]
    functions: tuple[FunctionUse, ...]
    points: tuple[PointResult, ...]
    equivalents: tuple[Curves, ...]
    loci: tuple[Locus, ...]
    steps: tuple[StepResponse, ...]
    alternatives: tuple[Alternative, ...]
    robustness: Robustness
    warnings: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Plain numbers, texts and lists, for `rundir.write_json`; numbers to DIGITS digits."""
        return _rounded(self)


def _rounded(value: Any) -> Any:
    if is_dataclass(value):
        return {field.name: _rounded(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(item) for item in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def pairs(poles: np.ndarray) -> tuple[tuple[float, float], ...]:
    """Poles as (real, imaginary), sorted."""
    order = np.lexsort((np.imag(poles), np.real(poles)))
    return tuple((float(p.real), float(p.imag)) for p in poles[order])
