"""Measured flow maps Q(Δp, opening): the type, its compiled evaluation and exact inverse, its file.

A map is a tensor-product spline, of degree 2 in the opening from the deadband up and of degree 3 in
s = Δp/(Δp² + δ²)^¼, the root of the drop made smooth and of finite slope at zero; an orifice is a
straight line in s. Its coefficients grow by positive increments along the opening and start from
zero at zero drop, so the flow is zero there, increases strictly with the opening at every drop, and
is free to level off or fall with the drop. A valve whose flow falls again above some opening has
increments of one sign up to there and of the other above; its inverse goes by the rising branch. A
leak at rest, a function of the drop alone, adds to all of it. A deadband that shifts with the drop,
as pressure presses a poppet to its seat, moves the opening: the spline is of the one that does the
same at half of the largest drop."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.runtime.compiled import allocating_kernel, kernel
from ehbench.runtime.disk import DATA, read_bytes, write_text
from ehbench.vocabulary import InputError, message
from ehbench.vocabulary.text import quoted

FORMAT, VERSION = "ehbench flow maps", 1
FILE_NAME = "flow_maps.json"
# header of a packed map, then the opening knots, then the polynomial pieces
_DEADBAND, _RISING, _DELTA, _PER_S, _SPANS_S, _SPANS_U = 0, 1, 2, 3, 4, 5
_LEAK_ROOT, _LEAK_DROP, _SHIFT, _HALF, _HEADER = 6, 7, 8, 9, 10
_PIECE = 12
_OPTIONAL = {"leakage", "leakage_std", "rising_to", "level", "hysteresis", "shift"}


@kernel
def _span(drop, data, at):
    """(span index along s, position in it); the span after the last one holds the extrapolation."""
    delta, spans = data[at + _DELTA], data[at + _SPANS_S]
    x = drop / math.sqrt(math.sqrt(drop * drop + delta * delta)) * data[at + _PER_S]
    i = int(x) if x < spans else int(spans)  # a NaN takes the last span and stays a NaN
    return i, x - i


@kernel
def map_leaks(data, at):
    """Whether the map that starts at ``data[at]`` passes oil at rest."""
    return data[at + _LEAK_ROOT] + data[at + _LEAK_DROP] > 0.0


@kernel
def _leak(x, data, at):
    """Leak at rest [m³/s] at a place in spans along s."""
    if not map_leaks(data, at):
        return 0.0
    share = x / data[at + _SPANS_S]
    return share * (data[at + _LEAK_ROOT] + share * data[at + _LEAK_DROP])


@kernel
def _cubic(data, k, y):
    return data[k] + y * (data[k + 1] + y * (data[k + 2] + y * data[k + 3]))


@kernel
def map_flow(pressure_drop, opening, data, at):
    """Flow [m³/s] at a pressure drop [Pa] and an opening [V] of the map that starts at ``data[at]``
    (see ``pack``).

    Zero at zero drop, the leak alone at rest and up to the deadband; odd in the drop. Beyond the
    largest measured opening the flow goes on along its tangent, or stays level if it falls there;
    beyond the largest drop it grows with s at the rate the whole map shows there, or stays level.
    """
    drop = abs(pressure_drop)
    if drop == 0.0:
        return 0.0
    i, y = _span(drop, data, at)
    leak = _leak(i + y, data, at)
    at_rest = opening <= 0.0
    opening -= data[at + _SHIFT] * (drop - data[at + _HALF])
    if at_rest or opening <= data[at + _DEADBAND]:
        return math.copysign(leak, pressure_drop)
    spans = int(data[at + _SPANS_U])
    knots = at + _HEADER
    low, high = 0, spans + 1
    while high - low > 1:
        middle = (low + high) >> 1
        if opening >= data[knots + middle]:
            low = middle
        else:
            high = middle
    w = opening - data[knots + low]
    k = knots + spans + 1 + (i * (spans + 1) + low) * _PIECE
    flow = _cubic(data, k, y) + w * (_cubic(data, k + 4, y) + w * _cubic(data, k + 8, y))
    return math.copysign(flow + leak, pressure_drop)


@kernel
def map_command(pressure_drop, flow, data, at):
    """Opening [V] at which the map passes ``flow`` [m³/s] at a pressure drop [Pa]: the exact
    inverse of ``map_flow``.

    0 V (shut) for no flow, for no more than the leak and for flow against the drop; where even the
    largest command of the rising branch passes less, that command."""
    drop, required = abs(pressure_drop), math.copysign(flow, flow * pressure_drop)
    if flow == 0.0 or (drop > 0.0 and required < 0.0):
        return 0.0
    i, y = _span(drop, data, at)
    spans, rising = int(data[at + _SPANS_U]), int(data[at + _RISING])
    knots = at + _HEADER
    row = knots + spans + 1 + i * (spans + 1) * _PIECE
    leak = _leak(i + y, data, at)
    required = abs(flow) - leak
    if leak > 0.0 and required <= 0.0:
        return 0.0
    shift = data[at + _SHIFT] * (drop - data[at + _HALF])
    if required >= _cubic(data, row + rising * _PIECE, y):
        return max(data[knots + rising] + shift, 0.0)
    low, high = 0, rising
    while high - low > 1:
        middle = (low + high) >> 1
        if required >= _cubic(data, row + middle * _PIECE, y):
            low = middle
        else:
            high = middle
    k = row + low * _PIECE
    more = required - _cubic(data, k, y)
    slope, curve = _cubic(data, k + 4, y), _cubic(data, k + 8, y)
    root = slope + math.sqrt(max(slope * slope + 4.0 * curve * more, 0.0))
    opening = data[knots + low] + (2.0 * more / root if root > 0.0 else 0.0 * root)
    return max(opening + shift, 0.0)


@kernel
def _flows(drops, openings, data, at, out):
    for i in range(out.size):
        out[i] = map_flow(drops[i], openings[i], data, at)


@kernel
def _commands(drops, flows, data, at, out):
    for i in range(out.size):
        out[i] = map_command(drops[i], flows[i], data, at)


def _each(kernel, first, second, data: np.ndarray):
    """The kernel over two broadcast arrays; a float from two floats."""
    a, b = np.broadcast_arrays(np.asarray(first, float), np.asarray(second, float))
    out = np.empty(a.size)
    kernel(np.ascontiguousarray(a).ravel(), np.ascontiguousarray(b).ravel(), data, 0, out)
    return out.reshape(a.shape) if a.ndim else float(out[0])


def root_drop(pressure_drop, delta: float):
    """s = Δp/(Δp² + δ²)^¼ [√Pa] of a pressure drop [Pa]: √Δp well above δ, Δp/√δ well below."""
    return pressure_drop / np.sqrt(np.hypot(pressure_drop, delta))


@allocating_kernel
def bspline_pieces(breaks, degree):
    """B-splines on clamped knots, shape (spans, splines, degree + 1), powers of x − breaks[span];
    Cox–de Boor recursion on the coefficients."""
    spans = breaks.size - 1
    knots = np.empty(spans + 1 + 2 * degree)
    knots[:degree], knots[degree + spans :] = breaks[0], breaks[spans]
    knots[degree : degree + spans + 1] = breaks
    pieces = np.zeros((spans, spans + 2 * degree, degree + 1))
    for j in range(spans):
        pieces[j, degree + j, 0] = 1.0
        for k in range(1, degree + 1):
            for i in range(degree + j - k, degree + j + 1):  # those that are not zero in this span
                item, other = knots[i + k] - knots[i], knots[i + k + 1] - knots[i + 1]
                # a spline of no width is nowhere
                rising = 1.0 / item if item > 0.0 else 0.0
                falling = 1.0 / other if other > 0.0 else 0.0
                before = 0.0, 0.0
                for p in range(k + 1):
                    up, down = pieces[j, i, p] * rising, pieces[j, i + 1, p] * falling
                    value = up * (breaks[j] - knots[i]) + down * (knots[i + k + 1] - breaks[j])
                    pieces[j, i, p] = value + (before[0] - before[1])
                    before = up, down
    return pieces[:, : spans + degree].copy()


@dataclass(frozen=True, eq=False)
class FlowMap:
    """Flow through one metering edge in one direction, for drops ≥ 0 and openings ≥ 0. All SI.

    ``deadband`` [V]: shut up to here; ``deadband_interval`` its 95 % interval [V, V].
    ``opening_knots`` [V], shape (n + 1,), ascend from the deadband to the largest measured command.
    ``drop_max`` [Pa] is the largest drop of the spline and ``delta`` [Pa] the drop below which s
    turns linear. ``increments`` [m³/s], shape (n + 1, m + 2), all > 0: growth of the spline
    coefficients from one opening to the next (the first opening row and the first drop column of
    coefficients are zero). ``hull_command`` [V], ``hull_low``, ``hull_high`` [Pa]: range of drops
    measured at each command. ``std`` [m³/s] over ``std_command`` [V] × ``std_root`` [√Pa]: standard
    error of the flow. ``rated_flow`` [m³/s]: what percentages refer to. ``samples``: readings used;
    ``outliers``: one sentence for each reading left out; ``source``: the data file.
    ``leakage`` [m³/s, m³/s]: what passes at rest at ``drop_max``, the part that grows with the root
    of the drop and the part that grows with the drop; ``leakage_std`` [m³/s]: standard error of
    their sum. ``rising_to`` [V]: the opening knot up to which the flow grows with the opening;
    above it it falls. ``level``: measured without pressures, so the flow goes by the opening alone.
    ``hysteresis`` [V]: what a rising command lies above a falling one at the same flow, the map
    being the middle of both; 0 where readings did not show it. ``shift`` [V/Pa]: what the deadband
    grows by with the drop; ``deadband``, ``opening_knots`` and ``std_command`` are those at half of
    ``drop_max``.

    Raises:
        InputError: the fields do not describe a map, such as an increment that is not positive.
    """

    valve: str
    direction: str
    deadband: float
    deadband_interval: tuple[float, float]
    opening_knots: np.ndarray
    drop_max: float
    delta: float
    increments: np.ndarray
    hull_command: np.ndarray
    hull_low: np.ndarray
    hull_high: np.ndarray
    std_command: np.ndarray
    std_root: np.ndarray
    std: np.ndarray
    rated_flow: float
    samples: int = 0
    outliers: tuple[str, ...] = ()
    source: str = ""
    leakage: tuple[float, float] = (0.0, 0.0)
    leakage_std: float = 0.0
    rising_to: float = math.inf
    level: bool = False
    hysteresis: float = 0.0
    shift: float = 0.0

    def __post_init__(self) -> None:
        def refuse(why: str) -> None:
            of = {"valve": self.valve, "direction": self.direction}
            raise InputError(message("physics.map_damaged", why=why, **of))

        for f in fields(self):
            if f.type == "np.ndarray":
                value = np.array(getattr(self, f.name), float)
                value.setflags(write=False)
                object.__setattr__(self, f.name, value)
                if not np.all(np.isfinite(value)):
                    refuse(message("physics.map_not_finite", name=f.name))
        knots, steps = self.opening_knots, self.increments
        ascends = knots.ndim == 1 and knots.size > 1 and bool(np.all(np.diff(knots) > 0))
        if not ascends or knots[0] != self.deadband or knots[0] < 0:
            refuse(message("physics.map_knots"))
        if steps.ndim != 2 or steps.shape[0] != knots.size or steps.shape[1] < 3:
            refuse(message("physics.map_increments"))
        if not self.rising_to > knots[0]:
            refuse(message("physics.map_rising"))
        if not np.all(steps[: self.rising + 1] > 0):
            refuse(message("physics.map_falling"))
        if not (min(*self.leakage, self.leakage_std) >= 0 and np.all(np.isfinite(self.leakage))):
            refuse(message("physics.map_negative_leakage"))
        if not 0 <= self.hysteresis < math.inf:
            refuse(message("physics.map_negative_hysteresis"))
        if not math.isfinite(self.shift):
            refuse(message("physics.map_infinite_shift"))
        if not all(0 < x < math.inf for x in (self.delta, self.drop_max, self.rated_flow)):
            refuse(message("physics.map_not_positive"))
        alike = self.hull_command.shape == self.hull_low.shape == self.hull_high.shape
        if not alike or not self.hull_command.size:
            refuse(message("physics.map_hull"))
        if self.std.shape != (self.std_command.size, self.std_root.size) or not self.std.size:
            refuse(message("physics.map_std"))

    @property
    def command_max(self) -> float:
        """Largest measured command [V]."""
        return float(self.opening_knots[-1])

    @property
    def rising(self) -> int:
        """Index of the opening knot up to which the flow grows; the inverse goes no further."""
        return int(np.searchsorted(self.opening_knots, self.rising_to, side="right")) - 1

    @cached_property
    def data(self) -> np.ndarray:
        """This map alone, packed for ``map_flow`` and ``map_command`` at offset 0."""
        knots, columns = self.opening_knots, self.increments.shape[1]
        m = columns - 2
        coefficients = np.zeros((knots.size + 1, columns + 1))
        coefficients[1:, 1:] = np.cumsum(self.increments, axis=0)
        in_u, in_s = bspline_pieces(knots, 2), bspline_pieces(np.arange(m + 1.0), 3)
        pieces = np.einsum("jka,ilb,kl->ijab", in_u, in_s, coefficients)

        width = knots[-1] - knots[-2]
        last = pieces[:, -1]  # one more span beyond the last command: value and slope there
        tangent = np.zeros_like(last)
        tangent[:, 0] = last[:, 0] + width * (last[:, 1] + width * last[:, 2])
        if self.rising == knots.size - 1:
            tangent[:, 1] = last[:, 1] + 2 * width * last[:, 2]
        pieces = np.concatenate([pieces, tangent[:, None]], 1)

        edge = pieces[-1].sum(-1)  # and one beyond the largest drop, growing by one common factor
        slope = pieces[-1] @ np.array([0.0, 1.0, 2.0, 3.0])
        growth = min(max(m * slope[:, 0].sum() / edge[:, 0].sum(), 0.0), 1.0)
        beyond = np.stack([edge, edge * growth / m, np.zeros_like(edge), np.zeros_like(edge)], -1)
        pieces = np.concatenate([pieces, beyond[None]], 0)

        header = np.empty(_HEADER)
        header[_DEADBAND], header[_RISING], header[_DELTA] = self.deadband, self.rising, self.delta
        header[_PER_S] = m / root_drop(self.drop_max, self.delta)
        header[_SPANS_S], header[_SPANS_U] = m, knots.size - 1
        header[_LEAK_ROOT : _LEAK_DROP + 1] = self.leakage
        header[_SHIFT], header[_HALF] = self.shift, 0.5 * self.drop_max
        return np.concatenate([header, knots, pieces.ravel()])

    def flow(self, pressure_drop, command):
        """Flow [m³/s] at pressure drops [Pa] and openings [V], which broadcast (see
        ``map_flow``)."""
        return _each(_flows, pressure_drop, command, self.data)

    def command(self, pressure_drop, flow):
        """Command [V] that passes ``flow`` [m³/s] at pressure drops [Pa], the exact inverse of
        ``flow``; broadcasts.

        0 V for no flow and for flow against the drop; the end of the rising branch, which is
        ``command_max`` but for maps that fall, where even that passes less: ``reachable`` says."""
        return _each(_commands, pressure_drop, flow, self.data)

    def reachable(self, pressure_drop, flow):
        """True where some command of the rising branch passes ``flow`` [m³/s] at the drop [Pa]."""
        drop, flow = np.asarray(pressure_drop, float), np.asarray(flow, float)
        top = self.opening_knots[self.rising] + self._shift_at(np.abs(drop))
        maximum = np.asarray(self.flow(np.abs(drop), top))
        return (flow == 0.0) | ((flow * drop > 0.0) & (np.abs(flow) <= maximum))

    def flow_std(self, pressure_drop, command):
        """Standard error [m³/s] of ``flow``: repeats, lack of fit and deadband together;
        broadcasts.

        Held at the edge of the table beyond it; ``inside`` says where the map is backed by
        readings."""
        drop, command = np.broadcast_arrays(
            np.abs(np.asarray(pressure_drop, float)), np.asarray(command, float)
        )
        x = np.clip(root_drop(drop, self.delta), self.std_root[0], self.std_root[-1])
        command = command - self._shift_at(drop)
        u = np.clip(command, self.std_command[0], self.std_command[-1])
        j, y = _locate(self.std_root, x)
        i, w = _locate(self.std_command, u)
        table = self.std
        low = table[i, j] * (1 - y) + table[i, j + 1] * y
        high = table[i + 1, j] * (1 - y) + table[i + 1, j + 1] * y
        std = np.where(command < self.std_command[0], 0.0, low * (1 - w) + high * w)
        if self.leakage_std:
            std = np.hypot(std, self.leakage_std * x / self.std_root[-1])
        return std if std.ndim else float(std)

    def _shift_at(self, drop):
        """What the deadband [V] is higher at a drop [Pa] than at half of the largest."""
        return self.shift * (drop - 0.5 * self.drop_max)

    def inside(self, pressure_drop, command):
        """True where readings surround the point (pressure drop [Pa], command [V])."""
        drop, command = np.asarray(pressure_drop, float), np.asarray(command, float)
        low, high = (
            np.interp(command, self.hull_command, side) for side in (self.hull_low, self.hull_high)
        )
        among = (command >= self.hull_command[0]) & (command <= self.hull_command[-1])
        return among & (drop >= low) & (drop <= high)

    def to_dict(self) -> dict:
        """Plain values as they stand in the file; defaults are left out."""
        plain = {}
        for f in fields(self):
            value = getattr(self, f.name)
            if f.name in _OPTIONAL and value == f.default:
                continue
            value = list(value) if isinstance(value, tuple) else value
            plain[f.name] = value.tolist() if isinstance(value, np.ndarray) else value
        return plain

    @classmethod
    def from_dict(cls, plain: Mapping) -> FlowMap:
        """The map of ``to_dict``.

        Raises:
            InputError: a field is missing, unknown or makes no map.
        """
        names = [f.name for f in fields(cls)]
        wrong = sorted((set(names) ^ set(plain)) - _OPTIONAL)
        if wrong:
            names_of = {"wrong": ", ".join(wrong), "known": ", ".join(names)}
            raise InputError(message("physics.map_fields", **names_of))
        try:
            named = dict(plain)
            for name in ("deadband", "drop_max", "delta", "rated_flow"):
                named[name] = float(plain[name])
            for name in {"deadband_interval", "leakage"} & set(plain):
                low, high = (float(value) for value in plain[name])
                named[name] = low, high
            named["outliers"] = tuple(str(text) for text in plain["outliers"])
            named["samples"] = int(plain["samples"])
            return cls(**named)
        except (TypeError, ValueError) as error:
            raise InputError(message("physics.map_kind", problem=error)) from error


def _locate(grid: np.ndarray, x: np.ndarray):
    """(index of the cell of ``grid`` that holds x, position in it from 0 to 1)."""
    i = np.clip(np.searchsorted(grid, x, side="right") - 1, 0, grid.size - 2)
    return i, (x - grid[i]) / (grid[i + 1] - grid[i])


def pack(maps: list[FlowMap], factors: Sequence[float] = ()) -> tuple[np.ndarray, np.ndarray]:
    """(data, offsets): all maps in one array, and where each starts; ``factors`` multiply flows."""
    parts = [item.data for item in maps]
    for k, factor in enumerate(factors):
        if factor != 1.0:
            parts[k] = parts[k].copy()
            parts[k][_LEAK_ROOT : _LEAK_DROP + 1] *= factor
            parts[k][_HEADER + maps[k].opening_knots.size :] *= factor
    sizes = [0, *(part.size for part in parts)]
    data = np.concatenate(parts) if parts else np.zeros(1)
    return data, np.cumsum(sizes, dtype=np.int64)[: len(parts)]


@dataclass(frozen=True, eq=False)
class ValveMaps:
    """The maps of one valve or edge. Drops and flows are signed along ``forward``.

    ``reverse`` is None for a valve measured in one direction only; its reverse flow is then taken
    as the mirror of the forward one, and ``inside`` is False there."""

    forward: FlowMap
    reverse: FlowMap | None = None

    def flow(self, pressure_drop, command):
        """Flow [m³/s] at signed pressure drops [Pa] and openings [V]; broadcasts."""
        return self._sided("flow", pressure_drop, command)

    def command(self, pressure_drop, flow):
        """Command [V] of the signed ``flow`` [m³/s] at the signed drop [Pa]."""
        return self._sided("command", pressure_drop, flow)

    def reachable(self, pressure_drop, flow):
        """True where a measured command passes ``flow`` [m³/s] at the drop [Pa]."""
        return self._sided("reachable", pressure_drop, flow).astype(bool)

    def flow_std(self, pressure_drop, command):
        """Standard error [m³/s] of ``flow``; broadcasts."""
        return self._sided("flow_std", pressure_drop, command)

    def relative_std(self, openings: np.ndarray) -> float:
        """rms standard error over the rms flow, at some openings [V] and all drops that were
        measured; the larger of both directions."""
        some = np.quantile(openings, np.linspace(0.0, 1.0, 101))
        shares = []
        for side in filter(None, (self.forward, self.reverse)):
            drops = side.drop_max * np.linspace(0.1, 1.0, 10)[:, None]
            flow = np.asarray(side.flow(drops, some))
            std = np.where(flow > 0.0, side.flow_std(drops, some), 0.0)
            shares.append(math.sqrt(np.sum(std**2) / max(float(np.sum(flow**2)), 1e-300)))
        return max(shares)

    def inside(self, pressure_drop, command):
        """True where readings surround the point, at signed drops [Pa] and openings [V]."""
        measured = (np.asarray(pressure_drop, float) >= 0.0) | (self.reverse is not None)
        return self._sided("inside", pressure_drop, command).astype(bool) & measured

    def _sided(self, what: str, drop, other):
        """``what`` of the map on either side of zero drop; flows flip their sign with the drop."""
        drop, other = np.broadcast_arrays(np.asarray(drop, float), np.asarray(other, float))
        back = drop < 0.0
        result = np.asarray(getattr(self.forward, what)(np.abs(drop), other), float)
        if np.any(back):
            mirrored = -other if what in ("command", "reachable") else other
            reverse = getattr(self.reverse or self.forward, what)(np.abs(drop), mirrored)
            result = np.where(back, -reverse if what == "flow" else reverse, result)
        return result if result.ndim else result[()]


class UnknownValve(InputError, KeyError):
    """No flow map goes by that name."""


class FlowMaps(Mapping):
    """Flow maps by valve or edge name, in the order of the names."""

    def __init__(self, valves: Mapping[str, ValveMaps], file: str | None = None) -> None:
        self._valves = dict(sorted(valves.items()))
        self.file = file

    def __getitem__(self, name: str) -> ValveMaps:
        """The maps of a valve.

        Raises:
            UnknownValve: no such valve; names those there are.
        """
        if name not in self._valves:
            text = message("physics.no_map", name=name, known=", ".join(self._valves) or "none")
            raise UnknownValve(text, file=self.file)
        return self._valves[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._valves)

    def __len__(self) -> int:
        return len(self._valves)

    def __repr__(self) -> str:
        return f"FlowMaps({', '.join(self._valves)})"

    def each(self) -> Iterator[FlowMap]:
        """All maps one by one, forward before reverse."""
        for valve in self._valves.values():
            yield valve.forward
            if valve.reverse is not None:
                yield valve.reverse


def collect(maps: list[FlowMap], file: str | None = None) -> FlowMaps:
    """Maps grouped by valve.

    Raises:
        InputError: two maps of one valve and direction, a direction other than forward or reverse,
            or only a reverse one.
    """
    grouped: dict[str, dict[str, FlowMap]] = {}
    for item in maps:
        sides = grouped.setdefault(item.valve, {})
        if item.direction not in ("forward", "reverse"):
            text = message("physics.map_direction", valve=item.valve, direction=item.direction)
            raise InputError(text, file=file)
        if item.direction in sides:
            text = message("physics.two_maps", valve=item.valve, direction=item.direction)
            raise InputError(text, file=file)
        sides[item.direction] = item
    for name, sides in grouped.items():
        if "forward" not in sides:
            raise InputError(message("physics.reverse_only", valve=name), file=file)
    each = {name: ValveMaps(on["forward"], on.get("reverse")) for name, on in grouped.items()}
    return FlowMaps(each, file)


def dump_flow_maps(maps: FlowMaps) -> str:
    """The file's text: JSON, sorted keys, shortest digits; same maps, same bytes."""
    content = {
        "format": FORMAT,
        "version": VERSION,
        "units": "SI",
        "maps": [item.to_dict() for item in maps.each()],
    }
    return json.dumps(content, sort_keys=True, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def save_flow_maps(maps: FlowMaps, folder: Path) -> None:
    """Write ``flow_maps.json`` into a folder."""
    write_text(folder / FILE_NAME, dump_flow_maps(maps))


def load_flow_maps(path: str | Path) -> FlowMaps:
    """The flow maps of a run folder or of a ``flow_maps.json``.

    Example:
        maps = ehbench.load_flow_maps("reports/flow_maps")
        maps["sh"].flow(2.0e6, 4.0)  # m³/s at 2 MPa and 4 V

    Raises:
        InputError: no such file, or not a flow map file of this version.
    """
    path = Path(path)
    path = path / FILE_NAME if path.is_dir() else path
    hint = message("physics.give_maps", file=FILE_NAME)
    try:
        content = json.loads(read_bytes(path, DATA).decode("utf-8"))
    except FileNotFoundError:
        raise InputError(message("physics.no_file"), file=path, hint=hint) from None
    except RecursionError:
        raise InputError(message("physics.too_deep"), file=path, hint=hint) from None
    except json.JSONDecodeError as error:
        text = message("physics.no_json", problem=error.msg)
        raise InputError(text, file=path, line=error.lineno, hint=hint) from None
    except ValueError:
        raise InputError(message("physics.no_json_text"), file=path, hint=hint) from None
    known = isinstance(content, dict) and content.get("format") == FORMAT
    if not known or not isinstance(content.get("maps"), list):
        raise InputError(message("physics.no_maps"), file=path, hint=hint)
    if content.get("version") != VERSION:
        text = message("physics.map_version", version=content.get("version"), known=VERSION)
        raise InputError(text, file=path)
    try:
        return collect([FlowMap.from_dict(item) for item in content["maps"]], str(path))
    except (InputError, AttributeError, TypeError) as error:
        text, hint = getattr(error, "message", str(error)), getattr(error, "hint", None) or hint
        raise InputError(text, file=path, hint=hint) from error


def table(
    maps: FlowMaps, signs: Mapping[tuple[str, str], int], flow_unit: str, pressure_unit: str
) -> str:
    """CSV text of all maps on a grid, for spreadsheets, in the units asked for.

    Columns ``valve, direction, opening [V], driver_command [V], pressure_drop [..], flow [..],
    flow_std [..], inside`` (1 or 0); the openings are the measured ones, zero or positive, the 25
    drops run from 0 to the largest measured one. ``driver_command`` is what to send for the
    opening: sign·opening, with ``signs`` (−1 or 1) by valve and direction."""
    from ehbench.vocabulary import VOCABULARY, from_si

    lines = [
        "valve,direction,opening [V],driver_command [V],"
        f"pressure_drop [{pressure_unit}],flow [{flow_unit}],flow_std [{flow_unit}],inside",
    ]
    for item in maps.each():
        drop = np.linspace(0.0, item.drop_max, 25)
        for command in item.hull_command:
            driven = signs[item.valve, item.direction] * command + 0.0
            flow, std = item.flow(drop, command), item.flow_std(drop, command)
            columns: tuple[Any, ...] = (
                from_si(drop, pressure_unit, VOCABULARY["pressure_drop"]),
                from_si(flow, flow_unit, VOCABULARY["flow"]),
                from_si(std, flow_unit, VOCABULARY["flow"]),
                item.inside(drop, command),
            )
            names = f"{quoted(item.valve)},{item.direction},{command:.6g},{driven:.6g}"
            lines += [
                f"{names},{p:.6g},{q:.6g},{e:.3g},{int(i)}"
                for p, q, e, i in zip(*columns, strict=True)
            ]
    return "\n".join(lines) + "\n"
