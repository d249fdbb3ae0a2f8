"""What an interval of a bulk modulus counts on: oil volumes and inertia, which the rig file has."""

from collections.abc import Mapping, Sequence

import numpy as np

from ehbench.config.rig import Cylinder, Rig
from ehbench.data.record import Record
from ehbench.vocabulary import message

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
        replays: simulated logs by cylinder that moves in them."""
    results = []
    for name in (n for n in fitted if n.rpartition(".")[2] == WORD):
        owners = [
            c
            for c in rig.cylinder
            if c.name in replays
            and (WORD if c.bulk_modulus is None else f"{c.name}.{WORD}") == name
        ]
        volumes = [f"{c.name}.{key}" for c in owners for key in ("volume_head", "volume_rod")]
        fixed = [volume for volume in volumes if volume not in fitted]
        inertia = any(c.linkage is not None or f"{c.joint}.mass" not in fitted for c in owners)
        fields = {"name": name, "volumes": " and ".join(fixed), "more": 100.0 * MORE}
        if fixed:
            fields["share"] = 100.0 * MORE * _share(owners, replays, fixed)
            key = "identification.counts_on_both" if inertia else "identification.counts_on_volumes"
            results.append(message(key, **fields))
        elif inertia:
            results.append(message("identification.counts_on_inertia", **fields))
    return tuple(results)


def _share(
    cylinders: Sequence[Cylinder], replays: Mapping[str, Sequence[Record]], fixed: Sequence[str]
) -> float:
    """By how much the bulk modulus grows with fixed volumes, as a share of a share."""
    stiff, moved = 0.0, 0.0
    for cylinder in cylinders:
        strokes = [replay[f"{cylinder.name}.x"] for replay in replays[cylinder.name]]
        x = float(np.mean([np.mean(stroke) for stroke in strokes]))
        ends = zip(("volume_head", "volume_rod"), cylinder.areas(), (1.0, -1.0), strict=True)
        for key, area, sign in ends:
            dead = float(getattr(cylinder, key))
            volume = max(dead + sign * area * x, 1e-9)
            stiff += area**2 / volume
            if f"{cylinder.name}.{key}" in fixed:
                moved += area**2 / volume * dead / volume
    return moved / stiff
