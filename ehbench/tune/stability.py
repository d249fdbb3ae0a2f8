"""Margins of a loop in state space: eigenvalues say where to look, the frequency response with the
exact delay says how far. Where poles and zeros nearly cancel, the roots of polynomials are rounding
errors."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ehbench.vocabulary import setting


@dataclass(frozen=True)
class StabilitySettings:
    """Where a loop's response is looked at."""

    near: float = setting(0.03, "", "real part on the axis, of the size", "double eigenvalues")
    around: float = setting(0.03, "", "share of a frequency to both sides of it", "as near")
    points: int = setting(61, "", "frequencies there", "a thousandth of it each")
    turns: tuple = setting((0.3, 60.0), "rad", "angles of a delay to look at", "Padé is worse")
    spread: int = setting(300, "", "frequencies there", "two percent each")
    jump: float = setting(1e-6, "", "largest level at a crossing, of the response", "a pole jumps")
    calm: float = setting(1e-9, "", "growth that is none, of the largest entry", "a pole at zero")
    slow: float = setting(1e-6, "", "frequency of standstill, of the fastest pole", "chosen")


STABILITY = StabilitySettings()


class OpenLoop(NamedTuple):
    """A loop cut open, ``L(s) = c (s − a)⁻¹ b``; it is closed with a minus sign. Shapes (states,
    states), (states,), (states,). The states ``late`` are those of the Padé form of a ``delay``
    [s] of the second order (`ehbench.tune.loop`)."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    delay: float = 0.0
    late: slice = slice(0)

    def growth(self, factor: float = 1.0) -> float:
        """Growth [1/s] of the fastest pole of the loop closed with a factor; none below
        rounding."""
        poles = np.linalg.eigvals(self.a - factor * np.outer(self.b, self.c))
        return float(poles.real.max()) - STABILITY.calm * float(np.abs(self.a).max())

    def response(self, omega: np.ndarray) -> np.ndarray:
        """L(jω) at frequencies [rad/s], the delay exact: at each the clock of the Padé states goes
        so fast that ``tan(ωT/2) = 6u/(12 − u²)``, the angle of their form at u."""
        size = len(self.a)
        clock = np.repeat(omega[:, None], size, axis=1)
        if self.delay > 0.0:
            tangent = np.tan(0.5 * omega * self.delay)
            turned = 12.0 * tangent / (3.0 + np.sqrt(9.0 + 12.0 * tangent**2))
            clock[:, self.late] = turned[:, None] / self.delay
        inverse = 1j * clock[..., None] * np.eye(size) - self.a
        right = np.broadcast_to(self.b, (omega.size, size))[..., None]
        return np.linalg.solve(inverse, right)[..., 0] @ self.c


def gain_margin(loop: OpenLoop) -> float:
    """The smallest factor above 1 at which the closed loop is no longer stable; inf if there is
    none.

    At such a factor L is real and negative: at the zeros of ``L(s) − L(−s)`` on the imaginary axis,
    which are eigenvalues of a pencil (Laub and Moore 1978), or at standstill."""
    from scipy.linalg import eigvals

    a, b, c = loop[:3]
    size = len(a)
    pencil, mass = np.zeros((2, 2 * size + 1, 2 * size + 1))
    pencil[:size, :size], pencil[size:-1, size:-1] = a, -a
    pencil[:size, -1] = pencil[size:-1, -1] = b
    pencil[-1, :size] = pencil[-1, size:-1] = c
    mass[range(2 * size), range(2 * size)] = 1.0
    zeros = np.asarray(eigvals(pencil, mass))
    real = np.real(_crossings(loop, zeros, np.imag))
    margin = float((-1.0 / real[(real > -1.0) & (real < 0.0)]).min(initial=math.inf))
    start = STABILITY.slow * np.abs(np.linalg.eigvals(a)).max()
    still = float(np.real(loop.response(np.array([start])))[0])
    if -1.0 < still < 0.0 and loop.growth(-1.01 / still) > 0.0 >= loop.growth(-0.99 / still):
        margin = min(margin, -1.0 / still)
    return margin


def phase_margin(loop: OpenLoop) -> float:
    """The smallest angle [rad] between L and −1 where the size of L is 1; inf where it never is.

    Such frequencies are eigenvalues of the loop's Hamiltonian matrix on the imaginary axis (Boyd,
    Balakrishnan and Kabamba 1989)."""
    a, b, c = loop[:3]
    hamiltonian = np.block([[a, np.outer(b, b)], [-np.outer(c, c), -a.T]])
    crossings = _crossings(loop, np.linalg.eigvals(hamiltonian), lambda reply: np.abs(reply) - 1.0)
    return float(np.abs(np.angle(-crossings)).min(initial=math.inf))


def _crossings(
    loop: OpenLoop, eigenvalues: np.ndarray, level: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """L where a level of it changes its sign: near eigenvalues at the imaginary axis, and at the
    angles of a delay that its Padé form misses."""
    known: np.ndarray = eigenvalues[np.isfinite(eigenvalues)]
    places = np.imag(known)[np.abs(np.real(known)) < STABILITY.near * np.imag(known)]
    turns = np.empty(0)
    if loop.delay > 0.0:
        first, last = STABILITY.turns
        turns = np.geomspace(first, last, STABILITY.spread) / loop.delay
        poles: np.ndarray = np.linalg.eigvals(loop.a).imag
        places = np.append(places, poles[poles > 0.0])
    share = np.geomspace(1.0 - STABILITY.around, 1.0 + STABILITY.around, STABILITY.points)
    omega = np.unique(np.append(np.outer(places, share), turns))
    above = level(loop.response(omega)) > 0.0
    at = np.flatnonzero(above[1:] != above[:-1])
    low, high, above = omega[at], omega[at + 1], above[at]
    while np.any((low < (middle := 0.5 * (low + high))) & (middle < high)):
        same = (level(loop.response(middle)) > 0.0) == above
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    reply = loop.response(low)
    return reply[np.abs(level(reply)) <= STABILITY.jump * np.abs(reply)]
