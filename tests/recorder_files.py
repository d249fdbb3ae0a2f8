"""Files in the style of real recorders, each with what its columns truly are.

A file has a name, a writer, the rig that it was recorded on, and the truth: the channel of each
column, '' of one that is none or that nobody can know. Columns of the truth in capitals of
`REQUIRED` have to be drafted, at least as likely."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

T = np.arange(300) / 100.0
SIGNALS = {
    "t": T,
    "ms": 1e3 * T,
    "us": 1e6 * T,
    "n": np.arange(300.0),
    "q": -8.0 + 5.0 * np.sin(2.0 * T),
    "q2": 30.0 + 4.0 * np.cos(3.0 * T),
    "a": 60.0 + 8.0 * np.sin(3.0 * T),
    "b": 30.0 + 4.0 * np.cos(2.0 * T),
    "c": 45.0 + 3.0 * np.cos(5.0 * T),
    "s": 180.0 + 2.0 * np.sin(1.0 * T),
    "r": 2.0 + 0.2 * np.sin(4.0 * T),
    "u": np.round(3.0 * np.sin(2.5 * T), 3),
    "mA": 12.0 + 4.0 * np.sin(3.0 * T),
    "coil": 40.0 * np.sign(np.sin(2.0 * T)),
    "pct": 50.0 + 40.0 * np.sin(2.0 * T),
    "x": 120.0 + 40.0 * np.sin(1.5 * T),
    "v": 60.0 * np.cos(1.5 * T),
    "w": 10.0 * np.cos(2.0 * T),
    "temp": 42.0 + 0.1 * T,
    "count": np.round(2000.0 + 500.0 * np.sin(2.0 * T)),
    "flow": 12.0 + 3.0 * np.sin(2.0 * T),
    "force": 900.0 * np.sin(2.0 * T),
}


class Recording(NamedTuple):
    """A file of a recorder: its name, who writes it, the rig, the truth, and the columns that a
    draft has to find.
    """

    file: str
    write: Callable[[Path], None]
    truth: dict[str, str]
    required: tuple[str, ...]
    two_cylinders: bool = False


RECORDINGS: dict[str, Recording] = {}


def _text(  # noqa: PLR0913 -- each file is one call with what is special of it
    style: str,
    file: str,
    head: str,
    columns: list[tuple[str, str, str]],
    required: str = "",
    mark: str = ",",
    *,
    units: str = "",
    first: str = "",
    form: str = "{:.4f}",
    encoding: str = "utf-8",
    two: bool = False,
) -> None:
    """Register a text file: ``columns`` are (name, signal, channel); ``units`` a row of units;
    ``first`` a cell before each row.
    """
    names = [name for name, _, _ in columns]
    decimal = "," if mark == ";" else "."

    def write(path: Path) -> None:
        rows = [f"{first}{mark}" * bool(first) + mark.join(names)] + [units] * bool(units)
        for n in range(T.size):
            cells = [form.format(SIGNALS[kind][n]).replace(".", decimal) for _, kind, _ in columns]
            rows.append(f"{mark}" * bool(first) + mark.join(cells))
        path.write_bytes((head + "\r\n".join(rows) + "\r\n").encode(encoding))

    truth = {name.replace("\n", " ").strip('"'): channel for name, _, channel in columns}
    needed = tuple(names[int(at)] for at in required.split())
    RECORDINGS[style] = Recording(file, write, truth, needed, two)


HEAD, ROD, Q, X, U = "lift.p_head", "lift.p_rod", "lift.q", "lift.x", "lift.spool.command"
SUPPLY, TANK = "p_supply", "p_tank"

LVM = "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\n***End_of_Header***\t\n"
_text(
    "LabVIEW .lvm",
    "a.lvm",
    LVM,
    [
        ("X_Value", "t", "t"),
        ("Druck A [bar]", "a", HEAD),
        ("Druck B [bar]", "b", ROD),
        ("Winkel [deg]", "q", Q),
        ("Comment", "n", ""),
    ],
    "0 1 2 3",
    "\t",
)
_text(
    "LabVIEW channels",
    "a.txt",
    "",
    [("Time", "t", "t"), ("Dev1/ai0", "a", ""), ("Dev1/ai1", "b", ""), ("Dev1/ao0", "u", "")],
    "0",
    "\t",
)
_text(
    "LabVIEW analog inputs",
    "a.csv",
    "",
    [
        ("Time (s)", "t", "t"),
        ("Analog Input 1 (V)", "u", ""),
        ("Analog Input 2 (V)", "u", ""),
        ("Analog Output 0 (V)", "u", ""),
    ],
    "0",
)
_text(
    "LabVIEW German",
    "a.txt",
    "Prüfstand;Kran\r\nDatum;25.11.2026\r\n\r\n",
    [
        ("Zeit", "t", "t"),
        ("Kolbendruck", "a", HEAD),
        ("Stangendruck", "b", ROD),
        ("Systemdruck", "s", SUPPLY),
        ("Ventil Sollwert", "u", U),
    ],
    "0 1 2 3 4",
    ";",
    units="s;bar;bar;bar;V",
    encoding="cp1252",
)
_text(
    "HBM catman",
    "a.txt",
    "HBM_CATMAN_DATAFILE_40\nT0 = 25.11.2026 10:00\n",
    [
        ("Time  1 - default sample rate [s]", "t", "t"),
        ("P_A [bar]", "a", HEAD),
        ("P_B [bar]", "b", ROD),
        ("Kraft [N]", "force", "lift.rod_force"),
        ("Weg [mm]", "x", X),
    ],
    "0 1 2 4",
    "\t",
)
_text(
    "HBM catman, a time a channel",
    "b.txt",
    "",
    [
        ("Time P [s]", "t", "t"),
        ("P rod [bar]", "b", ROD),
        ("Time Q [s]", "t", "t"),
        ("Angle [deg]", "q", Q),
    ],
    "0 1 2 3",
    "\t",
)
_text(
    "HBM mA sensors",
    "a.csv",
    "",
    [
        ("Time [s]", "t", "t"),
        ("Pressure A [mA]", "mA", ""),
        ("Pressure B [mA]", "mA", ""),
        ("Valve command [mA]", "mA", U),
    ],
    "0 3",
)
_text(
    "HBM percent",
    "a.csv",
    "",
    [
        ("Time [s]", "t", "t"),
        ("Oil level [%]", "pct", ""),
        ("Angle [%]", "pct", ""),
        ("Humidity [%]", "pct", ""),
    ],
    "0",
)
CONTROLDESK = "descriptions,General,User,x\n,General,DateTime,2026-11-25 10:21:45\n\n"
RECORDINGS["ControlDesk CSV"] = Recording(
    "a.csv",
    lambda path: _controldesk(path),
    {
        "Model Root/Arm/p_head": HEAD,
        "Model Root/Arm/p_rod": ROD,
        "Model Root/PWM": "",
        "Model Root/Arm/angle": Q,
    },
    ("Model Root/Arm/p_head", "Model Root/Arm/angle"),
)
_text(
    "CANape CSV",
    "a.csv",
    "",
    [
        ("timestamps", "t", "t"),
        ("HYD_Press_Pump_bar", "s", SUPPLY),
        ("HYD_Press_Head_bar", "a", HEAD),
        ("HYD_Temp_Oil", "temp", ""),
        ("ENG_Speed_rpm", "count", ""),
    ],
    "0 1 2",
    ";",
)
_text(
    "CANape raw bits",
    "b.csv",
    "",
    [
        ("time [s]", "t", "t"),
        ("ArmAngle [bit]", "count", ""),
        ("PressA [counts]", "count", ""),
        ("ValvePWM [%]", "pct", U),
    ],
    "0",
)
_text(
    "CANape two cylinders",
    "a.csv",
    "",
    [
        ("time [s]", "t", "t"),
        ("boom_p_head [bar]", "a", "left.p_head"),
        ("boom_p_rod [bar]", "b", "left.p_rod"),
        ("stick_p_head [bar]", "c", "right.p_head"),
        ("stick_angle [deg]", "q", "right.q"),
        ("boom_angle [deg]", "q2", "left.q"),
        ("cmd boom [V]", "u", "left.spool.command"),
    ],
    "0 1 2 3 4 5 6",
    two=True,
)
_text(
    "numbered pressures of two cylinders",
    "b.csv",
    "",
    [
        ("t_s", "t", "t"),
        ("p1_bar", "a", "left.p_head"),
        ("p2_bar", "b", "left.p_rod"),
        ("p3_bar", "c", "right.p_head"),
        ("p4_bar", "s", "right.p_rod"),
        ("U1_V", "u", "left.spool.command"),
    ],
    "0",
    two=True,
)
_text(
    "Simulink CSV",
    "a.csv",
    "",
    [
        ("time", "t", "t"),
        ("theta_deg", "q", Q),
        ("dtheta_deg_s", "w", "lift.qd"),
        ("pA_bar", "a", HEAD),
        ("pB_bar", "b", ROD),
        ("u_ref_V", "u", U),
    ],
    "0 1 3 4",
)
_text(
    "Simulink numbered",
    "b.csv",
    "",
    [
        ("t_s", "t", "t"),
        ("s1_mm", "x", X),
        ("p1_Pa", "a", HEAD),
        ("p2_Pa", "b", ROD),
        ("v_mm_s", "v", "lift.v"),
        ("omega_deg_s", "w", "lift.qd"),
    ],
    "0 1 4 5",
)
_text(
    "PicoScope CSV",
    "a.csv",
    "",
    [("Time", "ms", "t"), ("Channel A", "u", ""), ("Channel B", "b", ""), ("Channel C", "a", "")],
    "0",
    units="(ms),(V),(bar),(bar)\n",
)
_text(
    "PicoScope renamed",
    "b.csv",
    "",
    [
        ("Time", "ms", "t"),
        ("Supply", "s", SUPPLY),
        ("Tank return", "r", TANK),
        ("Coil", "coil", ""),
    ],
    "0 1 2",
    units="(ms),(bar),(bar),(mA)\n",
)
_text(
    "Vector CAN seconds",
    "a.asc.csv",
    "",
    [
        ("Time[s]", "t", "t"),
        ("Hydraulics::PumpPressure[bar]", "s", SUPPLY),
        ("Hydraulics::BoomAngle[deg]", "q", Q),
        ("Hydraulics::JoystickX[%]", "pct", ""),
    ],
    "0 1 2",
)
_text(
    "Vector CAN psi",
    "b.csv",
    "",
    [
        ("Time[s]", "t", "t"),
        ("RodPress (PSI)", "b", ROD),
        ("HeadPress (PSI)", "a", HEAD),
        ("Flow (GPM)", "flow", ""),
        ("Pump (RPM)", "count", ""),
    ],
    "0 1 2",
)
_text(
    "OpenLog",
    "OPENLOG.TXT",
    "",
    [
        ("micros", "us", "t"),
        ("aX", "q", ""),
        ("gX (dps)", "w", ""),
        ("tempC", "temp", ""),
        ("analog_11 (V)", "u", ""),
    ],
    "",
    form="{:.2f}",
)
_text(
    "OpenLog counter",
    "LOG0001.TXT",
    "",
    [("sample", "n", ""), ("A0", "count", ""), ("A1", "count", ""), ("A2", "count", "")],
    "",
)
_text(
    "Testlab",
    "a.txt",
    "Testlab export\n",
    [
        ("Time (s)", "t", "t"),
        ("PressureRod:+X (bar)", "b", ROD),
        ("Accel:+Z (m/s^2)", "v", ""),
        ("Force (N)", "force", "lift.rod_force"),
    ],
    "0 1",
    "\t",
)
_text(
    "Testlab line breaks",
    "b.csv",
    "",
    [('"Time\n[s]"', "t", "t"), ('"Head\n[bar]"', "a", HEAD), ('"Stroke\n[mm]"', "x", X)],
    "",
)
_text(
    "spreadsheet capitals",
    "a.csv",
    "",
    [
        ("TIME (SEC)", "t", "t"),
        ("ANGLE (DEG)", "q", Q),
        ("CAP PRESSURE (PSI)", "a", HEAD),
        ("VALVE (VDC)", "u", U),
    ],
    "0 1 2",
)
_text(
    "coil driver",
    "a.csv",
    "",
    [("Time [s]", "t", "t"), ("Solenoid current [mA]", "coil", U), ("Pressure T [bar]", "r", TANK)],
    "0 2",
)
_text(
    "spool feedback",
    "a.csv",
    "",
    [
        ("Time [s]", "t", "t"),
        ("Valve command [V]", "u", U),
        ("Spool position [V]", "u", "lift.spool.opening"),
        ("Spool position [mm]", "x", ""),
    ],
    "0 1",
)
_text(
    "two of each",
    "a.csv",
    "",
    [
        ("Time [s]", "t", "t"),
        ("Angle 1 [deg]", "q", ""),
        ("Angle 2 [deg]", "q2", ""),
        ("Pressure [bar]", "a", ""),
        ("Pressure [bar] 2", "b", ""),
    ],
    "0",
)
_text(
    "grad",
    "a.csv",
    "",
    [("Time [s]", "t", "t"), ("Winkel [grad]", "q", ""), ("Neigung [°]", "q2", Q)],
    "0",
)
_text(
    "references",
    "a.csv",
    "",
    [
        ("Time [s]", "t", "t"),
        ("Ref position [mm]", "x", ""),
        ("Position [mm]", "x", X),
        ("Setpoint [V]", "u", U),
        ("V_ref [V]", "u", ""),
    ],
    "0 2",
)
_text(
    "monitoring",
    "a.csv",
    "",
    [
        ("t [s]", "t", "t"),
        ("Monitoring [bar]", "a", ""),
        ("Measuring spring [bar]", "b", ""),
        ("Accumulator [bar]", "c", ""),
        ("Pilot pressure [bar]", "r", ""),
    ],
    "0",
)
_text(
    "UTF-16 export",
    "a.txt",
    "",
    [("Time [s]", "t", "t"), ("Rücklauf [bar]", "r", TANK), ("Kolben [bar]", "a", HEAD)],
    "0 1 2",
    "\t",
    encoding="utf-16-le",
)


def _controldesk(path: Path) -> None:
    rows = [
        CONTROLDESK + "trace_size,300",
        "trace_types,5,4,4,4,4",
        "trace_names,,In1,In1,Duty,In1",
    ]
    rows += ["trace_units,,bar,bar,%,deg", "raster,10ms,10ms,10ms,10ms,10ms"]
    rows += ["path,,Model Root/Arm/p_head,Model Root/Arm/p_rod,Model Root/PWM,Model Root/Arm/angle"]
    for n in range(T.size):
        cells = [f"{SIGNALS[kind][n]:.3f}" for kind in ("t", "a", "b", "pct", "q")]
        rows.append(f"{'trace_values' if n == 0 else ''},{','.join(cells)}")
    path.write_text("\n".join(rows) + "\n")


def _mat(style: str, variables: Callable[[], dict], truth: dict[str, str], *required: str) -> None:
    def write(path: Path) -> None:
        from scipy.io import savemat

        savemat(path, variables())

    RECORDINGS[style] = Recording("a.mat", write, truth, required)


def _structs(*items: dict) -> np.ndarray:
    result = np.empty(len(items), dtype=[(key, object) for key in items[0]])
    for at, item in enumerate(items):
        result[at] = tuple(item.values())
    return result


_mat(
    "dSPACE MAT",
    lambda: {
        "exp": {
            "X": {"Name": "t", "Data": T, "Unit": "s"},
            "Y": _structs(
                {"Name": "Platform()/pHead", "Data": SIGNALS["a"], "Unit": "bar"},
                {"Name": "Platform()/angle", "Data": SIGNALS["q"], "Unit": "deg"},
                {"Name": "Platform()/Out1", "Data": SIGNALS["u"], "Unit": "V"},
            ),
        }
    },
    {"t": "t", "Platform()/pHead": HEAD, "Platform()/angle": Q, "Platform()/Out1": ""},
    "Platform()/pHead",
    "Platform()/angle",
)
_mat(
    "Simulink structure with time",
    lambda: {
        "ScopeData": {
            "time": T,
            "signals": _structs(
                {"values": SIGNALS["a"], "label": "p_head [bar]"},
                {"values": SIGNALS["q"], "label": "angle [deg]"},
                {"values": SIGNALS["u"], "label": "Gain3"},
            ),
        }
    },
    {"p_head [bar]": HEAD, "angle [deg]": Q, "Gain3": ""},
    "p_head [bar]",
    "angle [deg]",
)
_mat(
    "PicoScope MAT",
    lambda: {"A": SIGNALS["a"], "B": SIGNALS["u"], "Tstart": 0.0, "Tinterval": 0.01},
    {"A": "", "B": ""},
)
_mat(
    "vectors of a workspace",
    lambda: {"t": T, "p_rod": SIGNALS["b"], "theta": SIGNALS["q"]},
    {"t": "t", "p_rod": "", "theta": ""},
)
