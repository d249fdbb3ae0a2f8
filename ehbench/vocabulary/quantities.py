"""The vocabulary: one row per name, read by log schemas, plot labels, docs and reports.

SI inside. A channel is named ``<cylinder>.<quantity>`` or ``<cylinder>.<valve>.<quantity>``; its
row is that of the last word. A float field of a rig or recipe has the row of its own name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches

# readings of a cylinder that its pressures and speed imply, where a log has them in place of these
GAUGES = ("load_pressure", "load_force", "rod_force")
_ALIKE = 0.75  # likeness from which a word is surely a slip of another


@dataclass(frozen=True)
class Quantity:
    """One name of the vocabulary.

    ``unit`` is the SI unit used inside, ``display`` the unit people see unless their rig file says
    otherwise, ``lower`` and ``upper`` [SI] the range outside of which a value is surely a slip of
    unit or sign. ``rings`` says of a parameter what it sets where a cylinder rings: its
    ``frequency`` or its ``decay``."""

    name: str
    symbol: str
    unit: str
    display: str
    meaning: str
    lower: float = float("-inf")
    upper: float = float("inf")
    rings: str = ""


_INF = float("inf")
_ROWS = [
    # time series
    Quantity("t", "t", "s", "s", "time since the log began"),
    Quantity("q", "q", "rad", "deg", "joint angle, right-handed about the joint axis", -50, 50),
    Quantity("qd", "q̇", "rad/s", "deg/s", "joint rate", -100, 100),
    Quantity("qdd", "q̈", "rad/s^2", "deg/s^2", "joint acceleration", -1e5, 1e5),
    Quantity(
        "x", "x", "m", "mm", "cylinder stroke from fully retracted, extension positive", -20, 20
    ),
    Quantity("v", "v", "m/s", "mm/s", "cylinder speed, extension positive", -20, 20),
    Quantity("a", "a", "m/s^2", "m/s^2", "cylinder acceleration, extension positive", -1e4, 1e4),
    Quantity(
        "p_head",
        "P1",
        "Pa",
        "kPa",
        "gauge pressure in the head end (the full-bore side)",
        -2e5,
        2e8,
    ),
    Quantity(
        "p_rod", "P2", "Pa", "kPa", "gauge pressure in the rod end (the annular side)", -2e5, 2e8
    ),
    Quantity(
        "p_line_head", "P1l", "Pa", "kPa", "gauge pressure in the line of the head end", -2e5, 2e8
    ),
    Quantity(
        "p_line_rod", "P2l", "Pa", "kPa", "gauge pressure in the line of the rod end", -2e5, 2e8
    ),
    Quantity("p_supply", "Ps", "Pa", "kPa", "gauge supply pressure", -2e5, 2e8),
    Quantity("p_tank", "Pt", "Pa", "kPa", "gauge tank pressure", -2e5, 1e7),
    Quantity("command", "u", "V", "V", "voltage commanded to the valve driver", -100, 100),
    Quantity(
        "opening",
        "x_v",
        "V",
        "V",
        "valve opening after the valve dynamics, in volts of command",
        -100,
        100,
    ),
    Quantity(
        "flow",
        "Q",
        "m^3/s",
        "gpm",
        "flow along a metering edge, upstream to downstream positive",
        -1,
        1,
    ),
    Quantity("flow_head", "Q1", "m^3/s", "gpm", "flow into the head end", -1, 1),
    Quantity("flow_rod", "Q2", "m^3/s", "gpm", "flow out of the rod end", -1, 1),
    Quantity("flow_supply", "Qs", "m^3/s", "gpm", "flow drawn from the supply", -1, 1),
    Quantity(
        "pressure_drop", "Δp", "Pa", "kPa", "pressure upstream minus pressure downstream", -2e8, 2e8
    ),
    Quantity(
        "upstream_pressure", "p_up", "Pa", "kPa", "gauge pressure upstream of the valve", -2e5, 2e8
    ),
    Quantity(
        "downstream_pressure",
        "p_dn",
        "Pa",
        "kPa",
        "gauge pressure downstream of the valve",
        -2e5,
        2e8,
    ),
    Quantity(
        "load_force",
        "P_L",
        "N",
        "N",
        "cylinder force p_head·area_head − p_rod·area_rod, extension positive",
        -1e8,
        1e8,
    ),
    Quantity(
        "load_pressure",
        "P_l",
        "Pa",
        "kPa",
        "pressure across the piston, p_head − p_rod",
        -2e8,
        2e8,
    ),
    Quantity(
        "rod_force",
        "F_c",
        "N",
        "N",
        "force of the rod on what it moves, load_force less the friction of the seals; push "
        "positive",
        -1e8,
        1e8,
    ),
    Quantity(
        "tip",
        "r",
        "m",
        "m",
        "where the tip of the mechanism is: ahead of its base, to the left, up",
        -1e3,
        1e3,
    ),
    *(
        Quantity(f"tip_{axis}{of}", f"{axis}_t", "m", "m", f"tip of the mechanism{word}: {way}")
        for of, word in (("", ""), ("_desired", ", as it shall be"))
        for axis, way in (("x", "ahead of its base"), ("y", "to the left"), ("z", "up"))
    ),
    Quantity("tip_error", "e_t", "m", "mm", "distance of the tip from where it shall be", 0, 1e3),
    Quantity("tip_across", "e_n", "m", "mm", "part of the tip's error across its way", 0, 1e3),
    Quantity(
        "flow_demand",
        "Q_w",
        "m^3/s",
        "gpm",
        "flow that the motion as it is desired would draw from the supply",
        0,
        10,
    ),
    Quantity(
        "flow_planned",
        "Q_p",
        "m^3/s",
        "gpm",
        "the same at the pace that the pump allows",
        0,
        10,
    ),
    Quantity("pace", "σ", "dimensionless", "dimensionless", "pace of a motion, 1 as desired", 0, 1),
    Quantity("temperature", "T", "K", "degC", "oil temperature", 200, 500),
    Quantity("force", "F", "N", "N", "force, extension positive", -1e8, 1e8),
    # machine parameters
    Quantity("gravity", "g", "m/s^2", "m/s^2", "acceleration of free fall", 0, 30),
    Quantity(
        "bulk_modulus",
        "β_e",
        "Pa",
        "MPa",
        "effective bulk modulus of oil, air and hose together",
        1e6,
        1e10,
        rings="frequency",
    ),
    Quantity("pressure", "p", "Pa", "kPa", "gauge pressure", -2e5, 2e8),
    Quantity("pressure_error", "Δp", "Pa", "kPa", "what a sensor says too much", -2e8, 2e8),
    Quantity("zero_error", "σ_p", "Pa", "kPa", "standard error of a sensor's zero", 0, 2e8),
    Quantity("tank_pressure", "Pt", "Pa", "kPa", "gauge tank pressure", -2e5, 1e7),
    Quantity(
        "relief_pressure",
        "p_rel",
        "Pa",
        "kPa",
        "gauge pressure at which a relief valve opens",
        0,
        2e8,
    ),
    Quantity(
        "cavitation_pressure",
        "p_cav",
        "Pa",
        "kPa",
        "gauge pressure below which a chamber fills with vapour",
        -1.1e5,
        1e6,
    ),
    Quantity(
        "flow_limit",
        "Q_max",
        "m^3/s",
        "gpm",
        "pump flow above which the supply pressure falls",
        0,
        1,
    ),
    Quantity("volume", "V", "m^3", "L", "oil volume", 0, 10),
    Quantity("area_head", "A1", "m^2", "cm^2", "piston area of the head end (full bore)", 1e-6, 10),
    Quantity("area_rod", "A2", "m^2", "cm^2", "piston area of the rod end (annulus)", 1e-6, 10),
    Quantity("bore", "D", "m", "mm", "cylinder bore diameter", 1e-3, 3),
    Quantity("rod", "d", "m", "mm", "piston rod diameter", 0, 3),
    Quantity("stroke", "s", "m", "mm", "full cylinder stroke", 1e-3, 20),
    Quantity(
        "volume_head",
        "V_h1",
        "m^3",
        "cm^3",
        "head-end oil volume at x = 0, hose included",
        1e-9,
        10,
    ),
    Quantity(
        "volume_rod", "V_h2", "m^3", "cm^3", "rod-end oil volume at x = 0, hose included", 1e-9, 10
    ),
    Quantity(
        "leakage_internal",
        "C_tm",
        "m^3/(s*Pa)",
        "mL/min/bar",
        "leakage head end to rod end",
        0,
        1e-6,
    ),
    Quantity(
        "leakage_head", "C_em1", "m^3/(s*Pa)", "mL/min/bar", "leakage head end to tank", 0, 1e-6
    ),
    Quantity(
        "leakage_rod", "C_em2", "m^3/(s*Pa)", "mL/min/bar", "leakage rod end to tank", 0, 1e-6
    ),
    Quantity(
        "friction_viscous", "b_c", "N*s/m", "N*s/m", "viscous friction of the cylinder", 0, 1e8
    ),
    Quantity("force_extending", "F_out", "N", "N", "force on the rod while it goes out", -1e8, 1e8),
    Quantity("force_retracting", "F_in", "N", "N", "force on the rod while it goes in", -1e8, 1e8),
    Quantity("stiffness", "k", "N/m", "kN/mm", "stiffness of a spring or a mount", 0, 1e13),
    Quantity(
        "free_length", "x_0", "m", "mm", "stroke at which a spring on the rod is free", -100, 100
    ),
    Quantity("pressure_head", "p_1", "Pa", "kPa", "known pressure in another head end", -2e5, 2e8),
    Quantity("pressure_rod", "p_2", "Pa", "kPa", "known pressure in another rod end", -2e5, 2e8),
    Quantity("friction_coulomb", "F_c", "N", "N", "Coulomb friction of the cylinder", 0, 1e7),
    Quantity(
        "bristle_stiffness", "σ0", "N/m", "N/mm", "stiffness of friction before it slides", 1, 1e12
    ),
    Quantity(
        "bristle_damping", "σ1", "N*s/m", "N*s/m", "damping of friction before it slides", 0, 1e8
    ),
    Quantity("opening_rate", "ẋ_v", "V/s", "V/s", "rate of a valve's opening", -1e9, 1e9),
    Quantity(
        "mount_deflection",
        "δ",
        "m",
        "mm",
        "how far a cylinder's mount has given way, positive where the rod pushes",
        -1,
        1,
    ),
    Quantity(
        "sway", "z", "m", "mm", "how far what sways is ahead of the rod, positive outward", -10, 10
    ),
    Quantity(
        "sway_speed",
        "w",
        "m/s",
        "mm/s",
        "speed of what sways at a rod, positive outward",
        -100,
        100,
    ),
    Quantity("bristle", "z", "m", "um", "how far the bristles of friction are bent", -1, 1),
    Quantity(
        "joint_damping",
        "b",
        "N*m*s/rad",
        "N*m*s/rad",
        "viscous damping at the joint",
        0,
        1e8,
        rings="decay",
    ),
    Quantity(
        "damping",
        "b",
        "N*s/m",
        "N*s/m",
        "viscous damping of a sliding mass or a mount",
        0,
        1e8,
        rings="decay",
    ),
    Quantity("lever", "∂x/∂q", "m/rad", "mm/rad", "cylinder stroke per joint angle", -20, 20),
    Quantity(
        "l_a", "l_A", "m", "mm", "distance from the joint to the cylinder's fixed pin", 1e-3, 50
    ),
    Quantity(
        "l_b", "l_B", "m", "mm", "distance from the joint to the cylinder's moving pin", 1e-3, 50
    ),
    Quantity(
        "retracted_length", "x_i", "m", "mm", "pin-to-pin length of the retracted cylinder", 0, 50
    ),
    Quantity("phase", "φ", "rad", "deg", "angle between the pins at q = 0", -10, 10),
    Quantity("radius", "r", "m", "mm", "constant lever of a rack or a rotary actuator", 1e-4, 50),
    Quantity("retracted_angle", "q_0", "rad", "deg", "joint angle at x = 0", -50, 50),
    Quantity("dh_a", "a", "m", "mm", "Denavit–Hartenberg link length", -100, 100),
    Quantity("dh_d", "d", "m", "mm", "Denavit–Hartenberg link offset", -100, 100),
    Quantity("dh_alpha", "α", "rad", "deg", "Denavit–Hartenberg twist", -10, 10),
    Quantity("dh_theta", "θ0", "rad", "deg", "Denavit–Hartenberg angle at q = 0", -10, 10),
    Quantity(
        "incline", "γ", "rad", "deg", "slope of a slide, extension uphill positive", -1.6, 1.6
    ),
    Quantity("mass", "m", "kg", "kg", "mass", 0, 1e7),
    Quantity("com", "r", "m", "mm", "centre of mass in the link-end frame", -100, 100),
    Quantity(
        "inertia",
        "I",
        "kg*m^2",
        "kg*m^2",
        "inertia about the centre of mass, in the link-end frame",
        -1e9,
        1e9,
    ),
    Quantity("natural_frequency", "ω_n", "rad/s", "Hz", "undamped natural frequency", 1e-3, 1e5),
    Quantity("damping_ratio", "ζ", "dimensionless", "dimensionless", "damping ratio", 0, 100),
    Quantity("s1", "s1", "s", "ms", "first-order coefficient of a valve's denominator", 0, 100),
    Quantity("s2", "s2", "s^2", "s^2", "second-order coefficient of a valve's denominator", 0, 1e4),
    Quantity(
        "map_factor",
        "k_m",
        "dimensionless",
        "dimensionless",
        "what the flow of an edge's measured map is multiplied by",
        0,
        100,
    ),
    Quantity(
        "flow_gain",
        "k_q",
        "m^3/(s*V*Pa^0.5)",
        "gpm/V/MPa^0.5",
        "flow coefficient of the orifice law",
        1e-14,
        1e-4,
    ),
    Quantity(
        "compensated_gain",
        "k_c",
        "m^3/(s*V)",
        "gpm/V",
        "flow per volt of a pressure-compensated valve",
        0,
        1,
    ),
    Quantity(
        "compensation_drop",
        "Δp0",
        "Pa",
        "kPa",
        "drop at which a pressure compensator takes over",
        1e2,
        1e8,
    ),
    Quantity("displacement", "D", "m^3/rad", "mL/rev", "oil that a pump moves a turn", 1e-12, 1e-2),
    Quantity(
        "speed_gain", "k_ω", "rad/(s*V)", "rpm/V", "pump speed per volt of command", 1e-3, 1e4
    ),
    Quantity("pump_speed", "ω", "rad/s", "rpm", "speed of a pump without a command", -1e4, 1e4),
    Quantity(
        "slip", "C_s", "m^3/(s*Pa)", "mL/min/bar", "oil that slips back through a pump", 0, 1e-6
    ),
    Quantity(
        "resistance",
        "R",
        "Pa*s/m^3",
        "bar*min/L",
        "laminar resistance of a line, drop over flow",
        0,
        1e16,
    ),
    Quantity(
        "orifice_gain", "k_o", "m^3/(s*Pa^0.5)", "gpm/MPa^0.5", "flow per root of drop", 0, 10
    ),
    Quantity(
        "cracking_pressure",
        "p_c",
        "Pa",
        "kPa",
        "drop at which a valve that a spring holds shut begins to open",
        0,
        5e7,
    ),
    Quantity(
        "opening_range",
        "p_o",
        "Pa",
        "kPa",
        "pressure from a check valve's cracking to where it stands open",
        1e2,
        1e7,
    ),
    Quantity(
        "pilot_ratio",
        "r_p",
        "dimensionless",
        "dimensionless",
        "area of a check valve's pilot over that of its seat",
        0,
        100,
    ),
    Quantity(
        "precharge", "p_0", "Pa", "kPa", "gauge gas pressure of an accumulator without oil", 0, 1e8
    ),
    Quantity("gas_volume", "V_g", "m^3", "L", "gas of an accumulator without oil", 1e-6, 10),
    Quantity("load_margin", "p_m", "Pa", "kPa", "what load sensing holds above the load", 0, 2e8),
    Quantity("load_lag", "T_LS", "s", "ms", "time constant of load sensing", 0, 100),
    Quantity("rail_pressure", "p_low", "Pa", "kPa", "gauge pressure of the low rail", 0, 2e8),
    Quantity(
        "rail_margin",
        "p_m",
        "Pa",
        "kPa",
        "what the low rail must have above the chamber that it feeds",
        0,
        2e8,
    ),
    Quantity("deadband", "u0", "V", "V", "command below which a valve stays shut", 0, 100),
    Quantity(
        "underlap",
        "u_u",
        "V",
        "V",
        "command of the other sign up to which an edge stays open",
        0,
        100,
    ),
    Quantity(
        "opening_max", "u_s", "V", "V", "opening beyond which an edge passes nothing more", 0, 100
    ),
    Quantity(
        "saturation_softness",
        "w_s",
        "V",
        "V",
        "half the travel over which an edge's saturation rounds off",
        0,
        100,
    ),
    Quantity(
        "drive_limit",
        "u_d",
        "V",
        "V",
        "size of a command beyond which a valve's driver, or a pump's drive, gives no more",
        0,
        100,
    ),
    Quantity("command_min", "u_min", "V", "V", "lowest command the driver takes", -100, 100),
    Quantity("command_max", "u_max", "V", "V", "highest command the driver takes", -100, 100),
    Quantity("rated_flow", "Q_r", "m^3/s", "gpm", "rated flow", 0, 1),
    Quantity(
        "meter_limit", "Q_min", "m^3/s", "gpm", "flow below which a flowmeter cannot be read", 0, 1
    ),
    # what only the virtual bench has
    Quantity(
        "air_fraction",
        "α",
        "dimensionless",
        "%",
        "share of free air in the oil, by volume at atmospheric pressure",
        0,
        0.5,
    ),
    Quantity(
        "polytropic_exponent",
        "n",
        "dimensionless",
        "dimensionless",
        "exponent of a gas's compression",
        1,
        1.7,
    ),
    Quantity("friction_static", "F_s", "N", "N", "break-away friction of the cylinder", 0, 1e7),
    Quantity(
        "stribeck_speed",
        "v_st",
        "m/s",
        "mm/s",
        "speed over which static friction falls to Coulomb friction",
        1e-6,
        10,
    ),
    Quantity(
        "droop",
        "Δp_s",
        "Pa",
        "kPa",
        "fall of supply pressure from no flow to the pump's flow limit",
        0,
        1e8,
    ),
    Quantity("corner", "1/τ", "rad/s", "Hz", "corner frequency of a first-order lag", 1e-3, 1e5),
    Quantity("lag", "τ", "s", "ms", "time constant of a first-order lag", 0, 100),
    Quantity("delay", "T_d", "s", "ms", "time by which a reading or a command is late", 0, 1),
    Quantity("sensor_scale", "s", "dimensionless", "dimensionless", "reading over what is", 0, 1e9),
    Quantity(
        "driver_gain", "g", "dimensionless", "dimensionless", "gain of a valve's driver", 0.01, 100
    ),
    Quantity("driver_offset", "o", "V", "V", "offset of a valve's driver", -100, 100),
    Quantity("hysteresis", "w", "V", "V", "width of a valve's hysteresis", 0, 100),
    Quantity("onset", "s0", "V", "V", "spool position at which an edge begins to open", 0, 100),
    Quantity("softness", "s_r", "V", "V", "travel over which an edge's opening rounds off", 0, 100),
    Quantity(
        "saturation", "s_max", "V", "V", "opening that an edge cannot exceed", 0, float("inf")
    ),
    Quantity(
        "gain_factor",
        "γ",
        "dimensionless",
        "dimensionless",
        "an edge's flow gain against the rig file's",
        0,
        10,
    ),
    Quantity(
        "compensator_opening",
        "s_c",
        "V",
        "V",
        "opening whose area is that of the wide open compensator",
        0,
        1e3,
    ),
    Quantity(
        "flow_force", "κ", "1/V", "1/V", "flow force that closes a compensator, per opening", 0, 10
    ),
    Quantity("null_leakage", "C_0", "m^3/(s*Pa)", "mL/min/bar", "leakage of a shut edge", 0, 1e-6),
    # what controllers log
    Quantity("x_desired", "x_d", "m", "mm", "desired cylinder stroke", -20, 20),
    Quantity(
        "v_desired", "v_d", "m/s", "mm/s", "desired cylinder speed, extension positive", -20, 20
    ),
    Quantity(
        "a_desired",
        "a_d",
        "m/s^2",
        "m/s^2",
        "desired cylinder acceleration, extension positive",
        -1e4,
        1e4,
    ),
    Quantity(
        "j_desired", "j_d", "m/s^3", "m/s^3", "desired cylinder jerk, extension positive", -1e7, 1e7
    ),
    Quantity(
        "v_shaped",
        "v_s",
        "m/s",
        "mm/s",
        "desired cylinder speed after the shaping of its steps",
        -20,
        20,
    ),
    Quantity(
        "function",
        "n_f",
        "dimensionless",
        "dimensionless",
        "number of the working function: 0 holds",
        0,
        7,
    ),
    Quantity(
        "function_status",
        "n_s",
        "dimensionless",
        "dimensionless",
        "0 as it should be, 1 stalled, 2 the circuit is unable",
        0,
        2,
    ),
    Quantity("flow_desired", "Q_d", "m^3/s", "gpm", "desired flow along a metering edge", -1, 1),
    Quantity("flow_head_desired", "Q1_d", "m^3/s", "gpm", "desired flow into the head end", -1, 1),
    Quantity("flow_rod_desired", "Q2_d", "m^3/s", "gpm", "desired flow out of the rod end", -1, 1),
    Quantity(
        "feedback_flow",
        "Q_f",
        "m^3/s",
        "gpm",
        "what pressure feedback takes from the inflow of the chamber",
        -1,
        1,
    ),
    Quantity(
        "limits",
        "n_l",
        "dimensionless",
        "dimensionless",
        "sum of 1 saturated, 2 against, 4 reversed, 8 faint, 16 outside",
        0,
        31,
    ),
    Quantity(
        "x_error",
        "z1",
        "m",
        "mm",
        "cylinder stroke minus the desired one, as the controller sees it",
        -20,
        20,
    ),
    Quantity(
        "v_asked",
        "v_c",
        "m/s",
        "mm/s",
        "cylinder speed that a position controller asks for, extension positive",
        -20,
        20,
    ),
    Quantity(
        "v_integral",
        "v_i",
        "m/s",
        "mm/s",
        "part of the speed asked for that leads a lasting stroke error back",
        -20,
        20,
    ),
    Quantity(
        "v_error",
        "ė",
        "m/s",
        "mm/s",
        "cylinder speed minus the desired one, as the controller sees it",
        -20,
        20,
    ),
    Quantity(
        "v_observed",
        "v̂",
        "m/s",
        "mm/s",
        "cylinder speed that a controller observes, extension positive",
        -20,
        20,
    ),
    Quantity(
        "load_force_desired",
        "P_L,d",
        "N",
        "N",
        "cylinder force that a controller asks for, extension positive",
        -1e8,
        1e8,
    ),
    Quantity(
        "pressure_set",
        "p_set",
        "Pa",
        "kPa",
        "set-point of the off-side chamber's pressure",
        -2e5,
        2e8,
    ),
    Quantity(
        "inverse_inertia",
        "θ1",
        "dimensionless",
        "dimensionless",
        "estimate: mass without payload over true mass",
        0,
        100,
    ),
    Quantity(
        "payload_share", "θ2", "kg", "kg", "estimate: payload times the inverse inertia", -1e7, 1e7
    ),
    Quantity(
        "disturbance",
        "θ3",
        "N",
        "N",
        "estimate: unknown force times the inverse inertia, against extension positive",
        -1e8,
        1e8,
    ),
    Quantity(
        "inverse_bulk",
        "θ4",
        "dimensionless",
        "dimensionless",
        "estimate: the design's bulk modulus over the true one",
        0,
        100,
    ),
    Quantity(
        "payload_estimate",
        "m_p",
        "kg",
        "kg",
        "estimate of the payload at the end of the last link",
        -1e7,
        1e7,
    ),
    Quantity(
        "payload_measured",
        "m_w",
        "kg",
        "kg",
        "payload by least squares over pressures and motion",
        -1e7,
        1e7,
    ),
    Quantity(
        "payload_low",
        "m_w,min",
        "kg",
        "kg",
        "lower end of the interval of the payload that pressures and motion tell",
        -1e7,
        1e7,
    ),
    Quantity(
        "payload_high",
        "m_w,max",
        "kg",
        "kg",
        "upper end of the interval of the payload that pressures and motion tell",
        -1e7,
        1e7,
    ),
    Quantity(
        "bulk_measured",
        "β_w",
        "Pa",
        "MPa",
        "bulk modulus by least squares over pressures and flows",
        0,
        1e13,
    ),
    Quantity(
        "map_gain",
        "g",
        "dimensionless",
        "dimensionless",
        "what an edge passes, over what its map says",
        0,
        100,
    ),
    Quantity(
        "map_shift", "δ_u", "V", "V", "how much later than its map says an edge opens", -100, 100
    ),
    Quantity(
        "learning",
        "n_l",
        "dimensionless",
        "dimensionless",
        "how estimates learn: 0 from tracking, 1 frozen, 2 from the load at rest",
        0,
        2,
    ),
    # gains and rules of controllers, trajectories
    Quantity("speed", "v_max", "m/s", "mm/s", "largest speed of a trajectory", 0, 20),
    Quantity(
        "acceleration", "a_max", "m/s^2", "m/s^2", "largest acceleration of a trajectory", 0, 1e4
    ),
    Quantity("jerk", "j_max", "m/s^3", "m/s^3", "largest jerk of a trajectory", 0, 1e7),
    Quantity("hold", "T_h", "s", "s", "rest at a waypoint", 0, 1e6),
    Quantity(
        "acceleration_max",
        "a_max",
        "m/s^2",
        "m/s^2",
        "largest acceleration of a shaped speed step",
        0,
        1e4,
    ),
    Quantity("jerk_max", "j_max", "m/s^3", "m/s^3", "largest jerk of a shaped speed step", 0, 1e7),
    Quantity(
        "feedback_gain",
        "K_p",
        "m^3/(s*Pa)",
        "mL/min/bar",
        "pressure feedback: flow per pressure",
        0,
        1e-6,
    ),
    Quantity("washout", "ω_w", "rad/s", "Hz", "corner of the washout of pressure feedback", 0, 1e4),
    Quantity(
        "ramp_washout",
        "ω_r",
        "rad/s",
        "Hz",
        "corner of a second washout of pressure feedback, which forgets a ramp",
        0,
        1e4,
    ),
    Quantity(
        "off_gain",
        "K_o",
        "m^3/(s*Pa)",
        "mL/min/bar",
        "off-side chamber: flow per pressure off its set-point",
        0,
        1e-6,
    ),
    Quantity(
        "low_pressure", "p_low", "Pa", "kPa", "set-point of the off-side chamber above tank", 0, 2e8
    ),
    Quantity(
        "gain_margin",
        "g_m",
        "dimensionless",
        "dimensionless",
        "factor by which a loop gain may grow before it swings",
        1,
        1e6,
    ),
    Quantity(
        "phase_margin", "φ_m", "rad", "deg", "lag that a loop bears where its gain is 1", 0, 3.15
    ),
    Quantity(
        "delay_margin", "T_m", "s", "ms", "extra delay that a loop bears before it swings", 0, 1
    ),
    Quantity(
        "drop_floor", "Δp_min", "Pa", "kPa", "least drop at which a valve is inverted", 1, 1e7
    ),
    Quantity(
        "drop_corner",
        "ω_Δ",
        "rad/s",
        "Hz",
        "corner above which load forces that are not planned open no valve, 0 for none",
        0,
        1e5,
    ),
    Quantity(
        "load_corner",
        "ω_l",
        "rad/s",
        "Hz",
        "corner of the low-pass of the load force that chooses the function",
        0,
        1e5,
    ),
    Quantity(
        "speed_start", "v_on", "m/s", "mm/s", "desired speed above which a motion begins", 0, 20
    ),
    Quantity("speed_stop", "v_off", "m/s", "mm/s", "desired speed at which a motion ends", 0, 20),
    Quantity("force_band", "F_h", "N", "N", "half the hysteresis of the load's sign", 0, 1e8),
    Quantity(
        "drop_start",
        "Δp_on",
        "Pa",
        "kPa",
        "drop between the ends above which regeneration begins",
        0,
        2e8,
    ),
    Quantity(
        "drop_stop",
        "Δp_off",
        "Pa",
        "kPa",
        "drop between the ends below which regeneration ends",
        0,
        2e8,
    ),
    Quantity(
        "reserve",
        "r",
        "dimensionless",
        "%",
        "share by which the edges must carry more to begin regeneration",
        0,
        10,
    ),
    Quantity(
        "supply_margin",
        "p_m",
        "Pa",
        "kPa",
        "what the seventh function must leave of the supply pressure",
        0,
        2e8,
    ),
    Quantity("supply_band", "p_h", "Pa", "kPa", "what it must leave on top to begin", 0, 2e8),
    Quantity(
        "cross_drop",
        "Δp3",
        "Pa",
        "kPa",
        "planned drop across the cross-port edge in the seventh function",
        0,
        2e8,
    ),
    Quantity("ramp", "T_r", "s", "ms", "time in which valves go to rest after a limit", 0, 10),
    Quantity(
        "dwell", "T_w", "s", "ms", "least time between two changes of the working function", 0, 1e3
    ),
    Quantity(
        "speed_sure",
        "v_sure",
        "m/s",
        "mm/s",
        "desired speed above which it is no noise",
        0,
        20,
    ),
    Quantity(
        "desired_corner",
        "ω_v",
        "rad/s",
        "rad/s",
        "low-pass of a desired speed below speed_sure",
        0,
        1e5,
    ),
    Quantity(
        "power_band",
        "h_P",
        "dimensionless",
        "%",
        "share by which another function must take less power",
        0,
        1,
    ),
    Quantity(
        "choice",
        "n_c",
        "dimensionless",
        "dimensionless",
        "how functions are chosen: 0 ranked, 1 by least pump power",
        0,
        1,
    ),
    Quantity(
        "allow_seventh",
        "n_7",
        "dimensionless",
        "dimensionless",
        "1 where the seventh function may be chosen",
        0,
        1,
    ),
    Quantity("tick", "T_s", "s", "ms", "time between two samples of a controller", 0, 1e3),
    Quantity(
        "adapt",
        "n_a",
        "dimensionless",
        "dimensionless",
        "1 where the estimates follow, 0 where they stay",
        0,
        1,
    ),
    Quantity(
        "position_bandwidth", "k_1", "rad/s", "rad/s", "bandwidth of the stroke error", 0, 1e5
    ),
    Quantity(
        "integral_bandwidth",
        "ω_i",
        "rad/s",
        "rad/s",
        "how fast the integral of the stroke error follows, 0 for none",
        0,
        1e5,
    ),
    Quantity("speed_bandwidth", "k_2", "rad/s", "rad/s", "bandwidth of the speed error", 0, 1e5),
    Quantity(
        "force_bandwidth", "k_3", "rad/s", "rad/s", "bandwidth of the load force error", 0, 1e5
    ),
    Quantity(
        "bandwidth_limit",
        "Ω_max",
        "rad/s",
        "rad/s",
        "Ω at most without payload; with one it falls as the rig's frequency does; 0 for none",
        0,
        1e5,
    ),
    Quantity(
        "coupling_frequency",
        "ω_3",
        "rad/s",
        "rad/s",
        "how fast the load force acts on the speed",
        0,
        1e5,
    ),
    Quantity(
        "speed_tolerance", "e_2", "m/s", "mm/s", "speed error that a robust term holds to", 0, 20
    ),
    Quantity(
        "force_tolerance", "e_3", "N", "N", "load force error that a robust term holds to", 0, 1e8
    ),
    Quantity(
        "robust_limit",
        "r_s",
        "dimensionless",
        "dimensionless",
        "robust gain at most, as a share of its bandwidth",
        0,
        1e3,
    ),
    Quantity(
        "pressure_bandwidth", "k_p", "rad/s", "rad/s", "bandwidth of the off-side pressure", 0, 1e5
    ),
    Quantity(
        "pressure_rate",
        "ṗ_set",
        "Pa/s",
        "kPa/s",
        "largest rate of the off-side pressure's set-point",
        0,
        1e12,
    ),
    Quantity(
        "observer_bandwidth",
        "ω_o",
        "rad/s",
        "rad/s",
        "bandwidth of the observer of speed, 0 for none",
        0,
        1e5,
    ),
    Quantity(
        "speed_correction",
        "v_c",
        "m/s",
        "mm/s",
        "speed that a stroke error asks for at most",
        0,
        20,
    ),
    Quantity(
        "speed_nudge",
        "v_n",
        "m/s",
        "mm/s",
        "least speed at which a remaining error is led back at rest",
        0,
        20,
    ),
    Quantity("stroke_resolution", "x_r", "m", "mm", "stroke error that counts as none", 0, 1),
    Quantity(
        "standby",
        "r_u",
        "dimensionless",
        "dimensionless",
        "share of its deadband at which a shut valve waits",
        0,
        1,
    ),
    Quantity(
        "flow_reserve",
        "r_Q",
        "dimensionless",
        "dimensionless",
        "share of the desired flow that the supply's edge shall have left",
        0,
        10,
    ),
    Quantity("valve_lead", "T_v", "s", "ms", "time by which desired flows lead", 0, 10),
    Quantity("weighing_time", "S", "s", "ms", "gain of adaptation at rest", 0, 1e3),
    Quantity("reference_mass", "m_r", "kg", "kg", "mass that scales the load force error", 0, 1e7),
    Quantity(
        "adaptation",
        "γ",
        "rad/s",
        "rad/s",
        "how fast the mechanical estimates together follow",
        0,
        1e5,
    ),
    Quantity(
        "adaptation_bulk",
        "γ_4",
        "rad/s",
        "rad/s",
        "how fast the estimate of the bulk modulus follows",
        0,
        1e5,
    ),
    Quantity(
        "adapt_oil",
        "adapt_oil",
        "dimensionless",
        "dimensionless",
        "whether plans go by the oil, lateness and lacking flow that pressures tell",
        0,
        1,
    ),
    Quantity(
        "adapt_maps",
        "adapt_maps",
        "dimensionless",
        "dimensionless",
        "whether flow maps are corrected in motion",
        0,
        1,
    ),
    Quantity(
        "map_bandwidth",
        "ω_g",
        "rad/s",
        "rad/s",
        "the rate at which flow maps are corrected in motion",
        0,
        1e5,
    ),
    Quantity(
        "map_error",
        "g_max",
        "dimensionless",
        "dimensionless",
        "share of its flow by which a map may be wrong",
        0,
        10,
    ),
    Quantity(
        "deadband_error", "δ_max", "V", "V", "what the deadband of a map may be wrong by", 0, 100
    ),
    Quantity(
        "lag_budget",
        "φ_l",
        "rad",
        "rad",
        "lag of valves and sampling at the sum of the bandwidths",
        0,
        10,
    ),
    # recipe numbers
    Quantity("duration", "T", "s", "s", "how long a trial lasts", 0, 1e6),
    Quantity("step", "h", "s", "us", "integration step", 1e-7, 1),
    Quantity("rate", "f", "Hz", "Hz", "samples per second", 1e-3, 1e6),
    Quantity("start", "t0", "s", "s", "when something starts", -1e6, 1e6),
    Quantity("stop", "t1", "s", "s", "when something stops", -1e6, 1e6),
    Quantity("settle", "t_s", "s", "ms", "wait after a change of a command", 0, 60),
    Quantity("span", "T", "s", "ms", "time over which a reading is taken", 1e-3, 60),
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
        KeyError: no such row; the message says what may be meant.
    """
    word = channel.rsplit(".", 1)[-1]
    if word not in VOCABULARY:
        raise KeyError(f"no quantity '{word}'{meant(channel)}")
    return VOCABULARY[word]


def meant(channel: str, more: Sequence[str] = ()) -> str:
    """What may be meant by a channel whose last word is none of the vocabulary's, nor of ``more``,
    as the end of a sentence; '' where nothing is near.
    """
    head, _, word = channel.rpartition(".")
    # behind a dot a word that is hardly alike is rather the name of a valve
    near = get_close_matches(word, [*VOCABULARY, *more], 1, _ALIKE if head else 0.6)
    if near:
        return f"; nearest is '{head + '.' if head else ''}{near[0]}'"
    return f"; if '{word}' is a valve, its command is '{channel}.command'" if head else ""


def like_channel(name: str, channels: Sequence[str]) -> str:
    """Which of a log's channels may be meant by a name, and else all of them, as a hint."""
    longer = [
        channel
        for channel in channels
        if channel.startswith(f"{name}.") or channel.endswith(f".{name}")
    ]
    inside = [channel for channel in channels if f".{name}." in channel]
    near = longer or inside or get_close_matches(name, channels, 1, _ALIKE)
    first = f"did you mean '{near[0]}'? " if len(near) == 1 else ""
    return f"{first}it has {', '.join(channels)}"
