"""What an interval of a bulk modulus counts on: oil volumes and inertia, which the rig file has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ehbench.config.rig import Cylinder, Rig
from ehbench.data.record import Record

WORD = "bulk_modulus"
MORE = 0.1  # share by which volumes and inertia are thought larger


def counts_on(
    rig: Rig, fitted: Sequence[str], replays: Mapping[str, Sequence[Record]]
) -> tuple[str, ...]:
    """A sentence for each fitted bulk modulus whose cylinders' volumes or inertia are held.

    A chamber of the volume V gives the stiffness β A²/V, so that logs tell V/β: with volumes that
    are larger by the share d the stiffness of Σ β A²/V is kept by a β larger by
    d·Σ (A²/V)(V₀/V) / Σ A²/V, V₀ being that part of V which is the rig file's. Where a log tells
    the stiffness by the frequency √(stiffness/m) of what rides on it, β grows with the inertia m.

    Args:
        rig: as it was fitted.
        fitted: names of the parameters with an interval.
        replays: simulated logs by cylinder that moves in them.
    """
    results = []
    for name in fitted:
        if name.rpartition(".")[2] != WORD:
            continue
        own = [
            c
            for c in rig.cylinder
            if c.name in replays
            and (WORD if c.bulk_modulus is None else f"{c.name}.{WORD}") == name
        ]
        fixed = [
            volume
            for c in own
            for volume in (f"{c.name}.volume_head", f"{c.name}.volume_rod")
            if volume not in fitted
        ]
        on, more = [], []
        if fixed:
            on.append(f"{' and '.join(fixed)} of the rig file")
            share = 100.0 * MORE * _share(own, replays, fixed)
            more.append(f"with {100.0 * MORE:g} % more oil there it would come out {share:.2g} %")
        if any(c.linkage is not None or f"{c.joint}.mass" not in fitted for c in own):
            on.append("the inertia that moves")
            more.append(f"with {100.0 * MORE:g} % more inertia up to {100.0 * MORE:g} %")
        if on:
            results.append(
                f"{name} counts on {' and on '.join(on)}: {', '.join(more)} higher, which its "
                "interval does not hold"
            )
    return tuple(results)


def _share(
    cylinders: Sequence[Cylinder], replays: Mapping[str, Sequence[Record]], held: Sequence[str]
) -> float:
    """By how much the bulk modulus grows with the volumes that are held, as a share of a share."""
    stiff, moved = 0.0, 0.0
    for cylinder in cylinders:
        head, rod = cylinder.areas()
        x = float(
            np.mean([np.mean(replay[f"{cylinder.name}.x"]) for replay in replays[cylinder.name]])
        )
        for key, area, sign in (("volume_head", head, 1.0), ("volume_rod", rod, -1.0)):
            own = float(getattr(cylinder, key))
            volume = max(own + sign * area * x, 1e-9)
            stiff += area**2 / volume
            if f"{cylinder.name}.{key}" in held:
                moved += area**2 / volume * own / volume
    return moved / stiff
