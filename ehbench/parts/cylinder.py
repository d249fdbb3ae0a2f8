"""A cylinder: how it sits on its joint, its two chambers, its relief valves."""

from functools import lru_cache
from typing import Any

import numpy as np

from ehbench.parts.fault import Amount, Fault
from ehbench.parts.friction import COLUMNS as FRICTION
from ehbench.parts.nodes import node_pressure
from ehbench.parts.oil import OIL_COLUMNS
from ehbench.physics.cylinder import (
    CAVITATION_BAND,
    RELIEF_GAIN,
    joint_angle,
    joint_range,
    linkage,
    relief_flow,
)
from ehbench.runtime.compiled import part_kernel, record

# share of a chamber's dead volume that is left at the least: far outside of the stroke, where it
# keeps the chamber's rate finite
VOLUME_MARGIN = 0.02

# A cylinder. The number of the ``joint`` it drives; how it sits there, `ehbench.physics.cylinder`:
# ``geometry`` DIRECT, PINS or RACK, ``l_a, l_b, retracted_length`` [m], ``side`` ±1,
# ``phase`` [rad]; ``stroke`` [m]; areas [m²]; dead volumes [m³], hoses included; the oil's
# OIL_COLUMNS; leakages C_tm, C_em1, C_em2 [m³/(s·Pa)]; ``relief_pressure`` [Pa], inf for none;
# ``cavitation_pressure`` [Pa], −inf for none; ``stop_stiffness`` [N/m]; ``mobility`` [1/kg], the
# largest acceleration per force on it, ``joint_mobility`` [1/(kg·m²)] that of its joint per torque
# there; the number of its law of ``friction``, where that law's
# states stand (``friction_states`` of them from ``friction_state`` on, −1), and the columns of the
# laws, as the rig file has them; where the deflection of its mount stands (``mount_state``, −1: it
# has none), ``mount_stiffness`` [N/m], ``mount_damping`` [N·s/m]; where among the commands the
# rates of its joint's coordinate and speed stand when these are given (``tied_position``,
# ``tied_rate``, −1).
CYLINDER = record(
    *((name, "i8") for name in ("joint", "geometry")),
    *((name, "f8") for name in ("l_a", "l_b", "side", "phase", "retracted_length", "stroke")),
    *((name, "f8") for name in ("area_head", "area_rod", "volume_head", "volume_rod")),
    *OIL_COLUMNS,
    *((name, "f8") for name in ("leakage_internal", "leakage_head", "leakage_rod")),
    *((name, "f8") for name in ("relief_pressure", "cavitation_pressure", "stop_stiffness")),
    *(("mobility", "f8"), ("joint_mobility", "f8")),
    *((name, "i8") for name in ("node_head", "node_rod")),
    *((name, "i8") for name in ("friction", "friction_state", "friction_states")),
    *((name, "f8") for name in FRICTION),
    *(("mount_state", "i8"), ("mount_stiffness", "f8"), ("mount_damping", "f8")),
    *(("sway_state", "i8"), ("sway_mass", "f8")),
    *(("sway_stiffness", "f8"), ("sway_damping", "f8")),
    *(("tied_position", "i8"), ("tied_rate", "i8")),
)
# fields that are those of the rig file, and those that `linkage` takes before the angle
CYLINDER_FIELDS = (
    *("stroke", "volume_head", "volume_rod"),
    *("leakage_internal", "leakage_head", "leakage_rod"),
)
PINS_OF = ("geometry", "l_a", "l_b", "side", "phase", "retracted_length")


@part_kernel
def linkage_of(row, q):
    """(stroke x [m], lever ∂x/∂q [m/rad], ∂lever/∂q [m/rad²]) of a cylinder at its joint's q."""
    return linkage(row.geometry, row.l_a, row.l_b, row.side, row.phase, row.retracted_length, q)


def joint_of(row: Any, x: Any) -> Any:
    """Joint coordinate q [rad], or [m] of a slide, at stroke x [m], scalar or array.

    Raises:
        InputError: the pins cannot be that far apart, or that near.
    """
    return joint_angle(*(row[name] for name in PINS_OF), x=x)


def joint_range_of(row: Any) -> tuple[float, float]:
    """(q at x = 0, q at full stroke) [rad], or [m] of a slide."""
    return _range(*(row[name].item() for name in (*PINS_OF, "stroke")))


_range = lru_cache(256)(joint_range)  # of a cylinder that is asked again and again


@part_kernel
def _linkages(row, q, x, lever):
    for i in range(q.shape[0]):
        x[i], lever[i], _ = linkage_of(row, q[i])


def linkage_arrays(row: Any, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(x [m], lever [m/rad]) of a cylinder over an array of joint coordinates."""
    x, lever = np.empty(q.shape[0]), np.empty(q.shape[0])
    _linkages(row, np.ascontiguousarray(q), x, lever)
    return x, lever


@part_kernel
def chamber_of(row, side):
    """(node, signed area [m²], dead volume [m³], leakage to tank [m³/(s·Pa)]) of head (0) or rod
    end (1); area > 0 where the chamber grows with the stroke."""
    if side == 0:
        return row.node_head, row.area_head, row.volume_head, row.leakage_head
    return row.node_rod, -row.area_rod, row.volume_rod, row.leakage_rod


@part_kernel
def chamber_oil(row, side, x):
    """Oil volume [m³] of a chamber at stroke x [m]."""
    _, area, dead, _ = chamber_of(row, side)
    return max(dead + area * x, VOLUME_MARGIN * dead)


@part_kernel
def chamber_inflow(row, side, v, net, y, plant):
    """What compresses the oil of a chamber [m³/s]: the right-hand sides of thesis 2.4 and 2.5.

    ``net − relief − A v ∓ C_tm (P1 − P2) − C_em (P − Pt)``, A signed.

    Args:
        v: speed [m/s], extension positive.
        net: what the edges bring [m³/s].
    """
    node, area, _, leakage = chamber_of(row, side)
    p = node_pressure(y, plant, node)
    across = row.leakage_internal * (
        node_pressure(y, plant, row.node_head) - node_pressure(y, plant, row.node_rod)
    )
    drained = leakage * (p - node_pressure(y, plant, 1))
    inflow = net - relief_flow(p, row.relief_pressure) - area * v
    return (inflow - across if side == 0 else inflow + across) - drained


@part_kernel
def chamber_slope(row, pressure, inflow, slope):
    """How fast a chamber's inflow changes with its pressure [m³/(s·Pa)], for the substep guard.

    To ``slope``, that of its edges, comes what the chamber would run into within the step, as soon
    as it is that near: the cavitation floor and the relief valve."""
    if inflow < 0.0:
        slope -= inflow / max(pressure - row.cavitation_pressure, CAVITATION_BAND)
    elif pressure < row.relief_pressure:
        slope += min(inflow / (row.relief_pressure - pressure), RELIEF_GAIN)
    if pressure > row.relief_pressure:
        slope += RELIEF_GAIN
    return slope


@part_kernel
def leakage_slope(row, side):
    """Bound of the slope of leakages over both pressures [m³/(s·Pa)]."""
    return 2.0 * row.leakage_internal + chamber_of(row, side)[3]


FAULTS = (
    *(
        Fault(
            "leakage",
            (key,),
            unit="leakage",
            step=0.01,
            high=30.0,
            rank=rank,
            upper=Amount((30.0,), "leakage"),
        )
        # past the piston nobody sees it; what leaks to the outside lies on the floor
        for key, rank in (("leakage_internal", 3), ("leakage_head", 4), ("leakage_rod", 4))
    ),
    Fault("volume", ("volume_head",), step=0.05, rank=5),
    Fault("volume", ("volume_rod",), step=0.05, rank=5),
    Fault("area", ("bore",), step=0.002, low=-0.1, high=0.1, trials=(-0.03, 0.03), rank=5),
    Fault("area", ("rod",), step=0.005, low=-0.4, high=0.4, rank=5),
    Fault("area", ("area_head",), step=0.005, low=-0.5, high=0.5, trials=(-0.3,), rank=5),
    Fault("area", ("area_rod",), step=0.005, low=-0.5, high=0.5, trials=(0.3,), rank=5),
    Fault(
        "through rod",
        ("rod",),
        step=0.0,
        trials=(1.0,),
        rank=5,
        table="through_rod",
        adds={"through_rod": True},
        moved=("through_rod",),
    ),
    Fault("bulk modulus", ("bulk_modulus",), trials=(-0.3, -0.15, 0.15, 0.4), rank=2),
)
# of pins and racks, by which levers and volumes go
LINKAGE = (
    *(
        Fault("linkage", (key,), step=0.005, low=-0.2, high=0.2, rank=5)
        for key in ("l_a", "l_b", "retracted_length", "radius")
    ),
    Fault("linkage", ("phase",), "unit", step=0.005, low=-0.3, high=0.3, rank=5),
)
