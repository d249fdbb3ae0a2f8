"""Margins of a loop in state space by eigenvalues. Where poles and zeros nearly cancel, the roots
of its polynomials are rounding errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ehbench.vocabulary.settings import setting


@dataclass(frozen=True)
class StabilitySettings:
    """Where a loop's response is looked at."""

    near: float = setting(
        0.03, "", "real part of an eigenvalue on the axis, of its size", "rounding of double ones"
    )
    beside: float = setting(0.03, "", "share of a frequency to both sides of it", "as near")
    points: int = setting(61, "", "frequencies there", "a thousandth of it each")
    calm: float = setting(
        1e-9, "", "growth that is none, of the largest entry", "a pole at zero, rounded"
    )
    slow: float = setting(1e-6, "", "frequency of standstill, of the fastest pole", "chosen")


STABILITY = StabilitySettings()


class OpenLoop(NamedTuple):
    """A loop cut open, ``L(s) = c (s − a)⁻¹ b``; it is closed with a minus sign. Shapes (states,
    states), (states,), (states,).
    """

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray

    def growth(self, factor: float = 1.0) -> float:
        """Growth [1/s] of the fastest growing pole of the loop closed with a factor on it; none
        below rounding.
        """
        poles = np.linalg.eigvals(self.a - factor * np.outer(self.b, self.c))
        return float(poles.real.max()) - STABILITY.calm * float(np.abs(self.a).max())

    def response(self, omega: np.ndarray) -> np.ndarray:
        """L(jω) at frequencies [rad/s]."""
        size = self.a.shape[0]
        inverse = 1j * omega[:, None, None] * np.eye(size) - self.a
        right = np.broadcast_to(self.b, (omega.size, size))[..., None]
        return np.linalg.solve(inverse, right)[..., 0] @ self.c


def gain_margin(loop: OpenLoop) -> float:
    """The smallest factor above 1 at which the closed loop is no longer stable; inf if there is
    none.

    At such a factor L is real and negative: at the zeros of ``L(s) − L(−s)`` on the imaginary axis,
    which are eigenvalues of a pencil (Laub and Moore 1978), or at standstill."""
    from scipy.linalg import eigvals

    a, b, c = loop
    size = len(a)
    pencil, mass = np.zeros((2, 2 * size + 1, 2 * size + 1))
    pencil[:size, :size], pencil[size:-1, size:-1] = a, -a
    pencil[:size, -1] = pencil[size:-1, -1] = b
    pencil[-1, :size] = pencil[-1, size:-1] = c
    mass[range(2 * size), range(2 * size)] = 1.0
    zeros = np.asarray(eigvals(pencil, mass))
    margin = math.inf
    for reply in _crossings(loop, zeros, np.imag):
        if -1.0 < reply.real < 0.0:
            margin = min(margin, -1.0 / reply.real)
    start = STABILITY.slow * np.abs(np.linalg.eigvals(a)).max()
    still = float(np.real(loop.response(np.array([start])))[0])
    if -1.0 < still < 0.0 and loop.growth(-1.01 / still) > 0.0 >= loop.growth(-0.99 / still):
        margin = min(margin, -1.0 / still)
    return margin


def phase_margin(loop: OpenLoop) -> float:
    """The smallest angle [rad] between L and −1 where the size of L is 1; inf where it never is.

    Such frequencies are eigenvalues of the loop's Hamiltonian matrix on the imaginary axis (Boyd,
    Balakrishnan and Kabamba 1989)."""
    a, b, c = loop
    hamiltonian = np.block([[a, np.outer(b, b)], [-np.outer(c, c), -a.T]])
    crossings = _crossings(loop, np.linalg.eigvals(hamiltonian), lambda reply: np.abs(reply) - 1.0)
    return min((abs(float(np.angle(-reply))) for reply in crossings), default=math.inf)


def _crossings(
    loop: OpenLoop, eigenvalues: np.ndarray, level: Callable[[np.ndarray], np.ndarray]
) -> Iterator[complex]:
    """L where a level of it changes its sign, about each eigenvalue close to the imaginary axis."""
    known: np.ndarray = eigenvalues[np.isfinite(eigenvalues) & (np.imag(eigenvalues) > 0.0)]
    share = np.geomspace(1.0 - STABILITY.beside, 1.0 + STABILITY.beside, STABILITY.points)
    near = np.abs(np.real(known)) < STABILITY.near * np.imag(known)
    for omega in np.imag(known[near]):
        reply = loop.response(omega * share)
        height = level(reply)
        for i in np.flatnonzero(np.sign(height[1:]) != np.sign(height[:-1])):
            part = height[i] / (height[i] - height[i + 1])
            yield complex(reply[i] + part * (reply[i + 1] - reply[i]))
