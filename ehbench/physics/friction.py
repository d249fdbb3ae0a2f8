"""Cylinder friction as a function of speed, smoothed through zero speed; compiled.

The law gives the resistance [N]: odd in v, with the sign of v, so that the rod feels its negative
and v·F ≥ 0 is the power lost. A smoothing speed v_s replaces sticking by fast creep:
tanh(v/v_s) is 0.76 at v_s and 0.96 at 2 v_s, and at rest the law acts as a damper of coulomb/v_s
[N·s/m]. Choose v_s well below the speeds that matter, and above coulomb·step/(2 mass) so that an
explicit step of the integrator stays stable."""

import math

from ehbench.runtime.compiled import kernel


@kernel
def stribeck(v, viscous, coulomb, static, stribeck_speed, smoothing):
    """Resistance [N] with a Stribeck dip: ``viscous·v + (coulomb + (static − coulomb) e^−(v/v_st)²)
    tanh(v/v_s)``.

    Armstrong-Hélouvry, Dupont & Canudas de Wit 1994, exponent 2. The peak comes close to ``static``
    only when the smoothing speed is well below ``stribeck_speed``.

    Args:
        v: cylinder speed, extension positive [m/s].
        viscous: [N·s/m].
        coulomb: friction that remains at speed [N].
        static: break-away friction, ≥ coulomb [N].
        stribeck_speed: v_st > 0, speed over which static falls to coulomb [m/s].
        smoothing: v_s > 0 [m/s].
    """
    ratio = v / stribeck_speed
    return viscous * v + (coulomb + (static - coulomb) * math.exp(-ratio * ratio)) * math.tanh(
        v / smoothing
    )


@kernel
def coulomb_slope(v, viscous, coulomb, smoothing):
    """Slope [N·s/m] of ``viscous·v + coulomb·tanh(v/v_s)`` over speed: `stribeck` without a dip."""
    if coulomb == 0.0:
        return viscous
    turned = math.tanh(v / smoothing)
    return viscous + coulomb * (1.0 - turned * turned) / smoothing


@kernel
def stribeck_slope(v, viscous, coulomb, static, stribeck_speed, smoothing):
    """Slope [N·s/m] of `stribeck` over speed; may be negative."""
    ratio, turned = v / stribeck_speed, math.tanh(v / smoothing)
    dip = (static - coulomb) * math.exp(-ratio * ratio)
    turning = (coulomb + dip) * (1.0 - turned * turned) / smoothing
    return viscous + turning - 2.0 * ratio / stribeck_speed * dip * turned
