"""Two machines from textbook equations (Merritt, Hydraulic Control Systems, 1967), which share
nothing with the package: what their recorders write for `recipes/press` and `recipes/loader`.

    python -m tests.strangers press DIRECTORY"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

HOLD, TICK = 5.0e-3, 1.0e-3  # [s] that a controller holds its command; between samples


@dataclass(frozen=True)
class Stranger:
    """A mass that one cylinder moves through a four-way spool. SI, gauge pressures.

    ``lap`` [V] opens each edge of the spool about its ``middle`` [V]; ``spring`` [N/m] is at rest
    in mid-stroke, ``load`` [N] pushes the rod in."""

    mass: float
    damping: float
    coulomb: float
    areas: tuple[float, float]
    stroke: float
    dead: float  # volume of oil at either end [m³]
    bulk: float
    leakage: float
    supply: float
    gain: float
    corner: float  # of the spool [rad/s], damping ratio 0.8
    lap: float = 0.0
    middle: float = 0.0
    spring: float = 0.0
    load: float = 0.0
    stop: float = 0.0  # stiffness of its end stops [N/m]

    def slope(self, t: float, y: np.ndarray, volts: float) -> list[float]:
        """Rates of stroke, speed, both pressures, opening and its rate."""
        x, v, head, rod, opening, rate = y
        wide = opening - self.middle

        def edge(reach: float, drop: float) -> float:
            root = drop / (drop * drop + 1.0e8) ** 0.25
            return self.gain * max(reach - self.lap, 0.0) * root

        leak = self.leakage * (head - rod)
        into_head = edge(wide, self.supply - head) - edge(-wide, head) - leak
        into_rod = edge(-wide, self.supply - rod) - edge(wide, rod) + leak
        force = head * self.areas[0] - rod * self.areas[1] - self.load
        force -= self.spring * (x - 0.5 * self.stroke) + self.damping * v
        force -= self.coulomb * np.tanh(v / 2.0e-3)
        force -= self.stop * (max(x - self.stroke, 0.0) + min(x, 0.0))
        room = (self.dead + self.areas[0] * x, self.dead + self.areas[1] * (self.stroke - x))
        return [
            v,
            force / self.mass,
            self.bulk * (into_head - self.areas[0] * v) / room[0],
            self.bulk * (into_rod + self.areas[1] * v) / room[1],
            rate,
            self.corner**2 * (volts - opening) - 1.6 * self.corner * rate,
        ]

    def recorded(self, law: Callable[[float, float], float], seconds: float, seed: int) -> str:
        """A log as a recorder writes it, with semicolons; ``law`` is (time, stroke) → volts."""
        between = 0.5 * self.supply
        head = (between * self.areas[1] + self.load) / self.areas[0]
        y = np.array([0.5 * self.stroke, 0.0, head, between, self.middle, 0.0])
        rows, count = [], round(HOLD / TICK)
        for k in range(round(seconds / HOLD)):
            volts = float(np.clip(law(k * HOLD, y[0]), -10.0, 10.0)) if k else self.middle
            at = np.linspace(0.0, HOLD, count + 1)
            y_at = solve_ivp(
                self.slope, (0.0, HOLD), y, "LSODA", at, args=(volts,), rtol=1e-7, atol=1e-9
            ).y
            rows += [
                (k * HOLD + t, volts, *column[:4])
                for t, column in zip(at, y_at.T[:-1], strict=False)
            ]
            y = y_at[:, -1]
        table = np.array(rows)
        noise = np.random.default_rng(seed).standard_normal((len(table), 4))
        table[:, 2:] += noise * (2.0e-5, 1.0e-3, 1.5e4, 1.5e4)
        table *= (1.0, 1.0, 1.0e3, 1.0e3, 1.0e-5, 1.0e-5)
        lines = [";".join(f"{cell:.7g}" for cell in row).replace(".", ",") for row in table]
        return "\n".join(["t (s);u (V);x (mm);v (mm/s);PA (bar);PB (bar)", *lines, ""])


PRESS = Stranger(
    mass=900.0,
    damping=2600.0,
    coulomb=150.0,
    areas=(2.1e-3, 2.1e-3),
    stroke=0.2,
    dead=6.0e-5,
    bulk=1.207e9,
    leakage=1.3e-12,
    supply=2.1e7,
    gain=2.0e-8,
    corner=380.0,
    spring=2.0e5,
)
LOADER = Stranger(
    mass=1500.0,
    damping=1800.0,
    coulomb=400.0,
    areas=(5.0e-3, 3.2e-3),
    stroke=0.6,
    dead=2.0e-4,
    bulk=9.0e8,
    leakage=0.0,
    supply=1.6e7,
    gain=3.0e-8,
    corner=95.0,
    lap=0.9,
    middle=0.15,
    load=1.5e4,
)
TIMES = (0.3, 0.8, 1.3, 1.8, 2.3)  # [s] of a step in a log of 2.8 s


def steps(levels: tuple[float, ...]) -> Callable[[float], float]:
    """A signal that steps to each level at its time, from nothing."""
    return lambda t: (0.0, *levels)[int(np.searchsorted(TIMES, t + 1e-9))]


def logs_of(name: str, seconds: float = 2.8) -> dict[str, str]:
    """The logs of a machine by file name; the last one is for the judgement."""
    results = {}
    if name == "press":  # a position loop, whose setpoint steps [m]
        moves = (0.02, -0.01, 0.015, -0.02, 0.01), (-0.015, 0.02, -0.005, 0.01, -0.02)
        moves = (*moves, (0.01, 0.025, -0.02, 0.005, -0.01))
        for k, levels in enumerate(moves, 1):
            wished = steps(levels)
            law = lambda t, x, wished=wished: 250.0 * (0.1 + wished(t) - x)
            results[f"run_{k}.csv"] = PRESS.recorded(law, seconds, k)
    else:  # an operator's lever [V]
        moves = (3.0, -2.5, 0.0, 4.0, -3.0), (-2.0, 2.5, 4.5, -3.5, 1.6)
        moves = (*moves, (2.2, -3.2, 3.5, 0.0, -2.4))
        for k, levels in enumerate(moves, 1):
            lever = steps(levels)
            results[f"run_{k}.csv"] = LOADER.recorded(
                lambda t, x, lever=lever: lever(t), seconds, k
            )
    return results


if __name__ == "__main__":
    for file, text in logs_of(sys.argv[1]).items():
        Path(sys.argv[2], file).write_text(text, encoding="utf-8")
