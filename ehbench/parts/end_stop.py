"""The end stops of a cylinder."""

import math

from ehbench.runtime.compiled import part_kernel

STOP_DEPTH = 1.0e-3  # [m]: how deep full supply pressure sinks a piston into its end stop
# [s/m]: share of the elastic force that a closing speed of 1 m/s adds; a slow bounce at speed v
# returns with about (1 − (2/3)·dissipation·v)·v
STOP_DISSIPATION = 5.0


@part_kernel
def stop_force(row, x, v):
    """Force [N] of the end stops on the rod at stroke x [m] and speed v [m/s], out positive.

    ``stiffness·δ·max(0, 1 + dissipation·δ̇)``, δ the depth into the stop (Hunt & Crossley 1975,
    exponent 1): continuous at contact, never pulls, and takes energy on every bounce."""
    if x < 0.0:
        return -row.stop_stiffness * x * max(0.0, 1.0 - STOP_DISSIPATION * v)
    if x > row.stroke:
        return row.stop_stiffness * (row.stroke - x) * max(0.0, 1.0 + STOP_DISSIPATION * v)
    return 0.0


@part_kernel
def stop_rate(row, x):
    """Fastest rate [1/s] in an end stop at stroke x [m]: its spring's, and its damping's with
    depth."""
    stiff = row.mobility * row.stop_stiffness
    return 2.0 * math.sqrt(stiff) + stiff * STOP_DISSIPATION * max(-x, x - row.stroke, 0.0)


@part_kernel
def stop_stored(row, x):
    """Energy [J] that the end stops hold as springs at stroke x [m]."""
    depth = max(-x, x - row.stroke, 0.0)
    return 0.5 * row.stop_stiffness * depth * depth


@part_kernel
def stop_loss(row, x, v):
    """Power [W] that the end stops take beyond what they hold as springs."""
    if 0.0 <= x <= row.stroke:
        return 0.0
    depth, closing = (-x, -v) if x < 0.0 else (x - row.stroke, v)
    return -stop_force(row, x, v) * v - row.stop_stiffness * depth * closing
