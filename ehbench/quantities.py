"""The vocabulary: one row per name, read by log schemas, plot labels, docs and reports.

SI inside. A channel is named ``<cylinder>.<quantity>`` or ``<cylinder>.<valve>.<quantity>``; its row is
that of the last word. A float field of a rig or recipe has the row of its own name.
"""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches


@dataclass(frozen=True)
class Quantity:
    """One name of the vocabulary.

    ``unit`` is the SI unit used inside, ``display`` the unit people see unless their rig file says otherwise,
    ``lower`` and ``upper`` [SI] the range outside of which a value is surely a slip of unit or sign.
    """

    name: str
    symbol: str
    unit: str
    display: str
    meaning: str
    lower: float = float("-inf")
    upper: float = float("inf")


_INF = float("inf")
_ROWS = [
    # time series
    Quantity("t", "t", "s", "s", "time since the log began"),
    Quantity("q", "q", "rad", "deg", "joint angle, right-handed about the joint axis", -50, 50),
    Quantity("qd", "q̇", "rad/s", "deg/s", "joint rate", -100, 100),
    Quantity("qdd", "q̈", "rad/s^2", "deg/s^2", "joint acceleration", -1e5, 1e5),
    Quantity("x", "x", "m", "mm", "cylinder stroke from fully retracted, extension positive", -20, 20),
    Quantity("v", "v", "m/s", "mm/s", "cylinder speed, extension positive", -20, 20),
    Quantity("a", "a", "m/s^2", "m/s^2", "cylinder acceleration, extension positive", -1e4, 1e4),
    Quantity("p_head", "P1", "Pa", "kPa", "gauge pressure in the head end (the full-bore side)", -2e5, 2e8),
    Quantity("p_rod", "P2", "Pa", "kPa", "gauge pressure in the rod end (the annular side)", -2e5, 2e8),
    Quantity("p_supply", "Ps", "Pa", "kPa", "gauge supply pressure", -2e5, 2e8),
    Quantity("p_tank", "Pt", "Pa", "kPa", "gauge tank pressure", -2e5, 1e7),
    Quantity("command", "u", "V", "V", "voltage commanded to the valve driver", -100, 100),
    Quantity("opening", "x_v", "V", "V", "valve opening after the valve dynamics, in volts of command", -100, 100),
    Quantity("flow", "Q", "m^3/s", "gpm", "flow along a metering edge, upstream to downstream positive", -1, 1),
    Quantity("flow_head", "Q1", "m^3/s", "gpm", "flow into the head end", -1, 1),
    Quantity("flow_rod", "Q2", "m^3/s", "gpm", "flow out of the rod end", -1, 1),
    Quantity("flow_supply", "Qs", "m^3/s", "gpm", "flow drawn from the supply", -1, 1),
    Quantity("pressure_drop", "Δp", "Pa", "kPa", "pressure upstream minus pressure downstream", -2e8, 2e8),
    Quantity("upstream_pressure", "p_up", "Pa", "kPa", "gauge pressure upstream of the valve", -2e5, 2e8),
    Quantity("downstream_pressure", "p_dn", "Pa", "kPa", "gauge pressure downstream of the valve", -2e5, 2e8),
    Quantity("load_force", "P_L", "N", "N", "cylinder force p_head·area_head − p_rod·area_rod, extension positive", -1e8, 1e8),
    Quantity("temperature", "T", "K", "degC", "oil temperature", 200, 500),
    Quantity("force", "F", "N", "N", "force, extension positive", -1e8, 1e8),
    # machine parameters
    Quantity("gravity", "g", "m/s^2", "m/s^2", "acceleration of free fall", 0, 30),
    Quantity("bulk_modulus", "β_e", "Pa", "MPa", "effective bulk modulus of oil, air and hose together", 1e6, 1e10),
    Quantity("pressure", "p", "Pa", "kPa", "gauge pressure", -2e5, 2e8),
    Quantity("tank_pressure", "Pt", "Pa", "kPa", "gauge tank pressure", -2e5, 1e7),
    Quantity("relief_pressure", "p_rel", "Pa", "kPa", "gauge pressure at which a relief valve opens", 0, 2e8),
    Quantity("cavitation_pressure", "p_cav", "Pa", "kPa", "gauge pressure below which a chamber fills with vapour", -1.1e5, 1e6),
    Quantity("flow_limit", "Q_max", "m^3/s", "gpm", "pump flow above which the supply pressure falls", 0, 1),
    Quantity("volume", "V", "m^3", "L", "oil volume", 0, 10),
    Quantity("area_head", "A1", "m^2", "cm^2", "piston area of the head end (full bore)", 1e-6, 10),
    Quantity("area_rod", "A2", "m^2", "cm^2", "piston area of the rod end (annulus)", 1e-6, 10),
    Quantity("bore", "D", "m", "mm", "cylinder bore diameter", 1e-3, 3),
    Quantity("rod", "d", "m", "mm", "piston rod diameter", 0, 3),
    Quantity("stroke", "s", "m", "mm", "full cylinder stroke", 1e-3, 20),
    Quantity("volume_head", "V_h1", "m^3", "cm^3", "head-end oil volume at x = 0, hose included", 1e-9, 10),
    Quantity("volume_rod", "V_h2", "m^3", "cm^3", "rod-end oil volume at x = 0, hose included", 1e-9, 10),
    Quantity("leakage_internal", "C_tm", "m^3/(s*Pa)", "mL/min/bar", "leakage head end to rod end", 0, 1e-6),
    Quantity("leakage_head", "C_em1", "m^3/(s*Pa)", "mL/min/bar", "leakage head end to tank", 0, 1e-6),
    Quantity("leakage_rod", "C_em2", "m^3/(s*Pa)", "mL/min/bar", "leakage rod end to tank", 0, 1e-6),
    Quantity("friction_viscous", "b_c", "N*s/m", "N*s/m", "viscous friction of the cylinder", 0, 1e8),
    Quantity("friction_coulomb", "F_c", "N", "N", "Coulomb friction of the cylinder", 0, 1e7),
    Quantity("joint_damping", "b", "N*m*s/rad", "N*m*s/rad", "viscous damping at the joint", 0, 1e8),
    Quantity("damping", "b", "N*s/m", "N*s/m", "viscous damping of a sliding mass", 0, 1e8),
    Quantity("lever", "∂x/∂q", "m/rad", "mm/rad", "cylinder stroke per joint angle", -20, 20),
    Quantity("l_a", "l_A", "m", "mm", "distance from the joint to the cylinder's fixed pin", 1e-3, 50),
    Quantity("l_b", "l_B", "m", "mm", "distance from the joint to the cylinder's moving pin", 1e-3, 50),
    Quantity("retracted_length", "x_i", "m", "mm", "pin-to-pin length of the retracted cylinder", 0, 50),
    Quantity("phase", "φ", "rad", "deg", "angle between the pins at q = 0", -10, 10),
    Quantity("dh_a", "a", "m", "mm", "Denavit–Hartenberg link length", -100, 100),
    Quantity("dh_d", "d", "m", "mm", "Denavit–Hartenberg link offset", -100, 100),
    Quantity("dh_alpha", "α", "rad", "deg", "Denavit–Hartenberg twist", -10, 10),
    Quantity("dh_theta", "θ0", "rad", "deg", "Denavit–Hartenberg angle at q = 0", -10, 10),
    Quantity("incline", "γ", "rad", "deg", "slope of a slide, extension uphill positive", -1.6, 1.6),
    Quantity("mass", "m", "kg", "kg", "mass", 0, 1e7),
    Quantity("com", "r", "m", "mm", "centre of mass in the link-end frame", -100, 100),
    Quantity("inertia", "I", "kg*m^2", "kg*m^2", "inertia about the centre of mass, in the link-end frame", -1e9, 1e9),
    Quantity("natural_frequency", "ω_n", "rad/s", "Hz", "undamped natural frequency", 1e-3, 1e5),
    Quantity("damping_ratio", "ζ", "dimensionless", "dimensionless", "damping ratio", 0, 100),
    Quantity("s1", "s1", "s", "ms", "first-order coefficient of a valve's denominator", 0, 100),
    Quantity("s2", "s2", "s^2", "s^2", "second-order coefficient of a valve's denominator", 0, 1e4),
    Quantity("flow_gain", "k_q", "m^3/(s*V*Pa^0.5)", "gpm/V/MPa^0.5", "flow coefficient of the orifice law", 0, 1),
    Quantity("compensated_gain", "k_c", "m^3/(s*V)", "gpm/V", "flow per volt of a pressure-compensated valve", 0, 1),
    Quantity("compensation_drop", "Δp0", "Pa", "kPa", "drop at which a pressure compensator takes over", 1e2, 1e8),
    Quantity("deadband", "u0", "V", "V", "command below which a valve stays shut", 0, 100),
    Quantity("command_min", "u_min", "V", "V", "lowest command the driver takes", -100, 100),
    Quantity("command_max", "u_max", "V", "V", "highest command the driver takes", -100, 100),
    Quantity("rated_flow", "Q_r", "m^3/s", "gpm", "rated flow", 0, 1),
    # recipe numbers
    Quantity("duration", "T", "s", "s", "how long a trial lasts", 0, 1e6),
    Quantity("step", "h", "s", "us", "integration step", 1e-7, 1),
    Quantity("rate", "f", "Hz", "Hz", "samples per second", 1e-3, 1e6),
    Quantity("start", "t0", "s", "s", "when something starts", -1e6, 1e6),
    Quantity("stop", "t1", "s", "s", "when something stops", -1e6, 1e6),
    Quantity("amplitude", "â", "V", "V", "amplitude of a command", -100, 100),
    Quantity("offset", "u_b", "V", "V", "constant part of a command", -100, 100),
    Quantity("frequency", "f", "Hz", "Hz", "frequency", 0, 1e5),
    Quantity("energy", "E", "J", "J", "energy", -1e12, 1e12),
    Quantity("power", "P", "W", "W", "power", -1e12, 1e12),
]

VOCABULARY: dict[str, Quantity] = {row.name: row for row in _ROWS}


def quantity(channel: str) -> Quantity:
    """The row of a channel or field name: that of its last dotted word.

    Raises:
        KeyError: no such row; the message names the nearest one.
    """
    word = channel.rsplit(".", 1)[-1]
    if word not in VOCABULARY:
        near = get_close_matches(word, VOCABULARY, 1)
        raise KeyError(f"no quantity '{word}'" + (f"; nearest is '{near[0]}'" if near else ""))
    return VOCABULARY[word]
