"""Files in the style of real recorders, each with what its columns truly are.

A file has a name, a writer, the rig that it was recorded on, and the truth: the channel of each
column, '' of one that is none or that nobody can know, and the columns that a draft has to find, at
least as likely. Text files are rows of the table beside this file."""

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

T = np.arange(300) / 100.0
SIGNALS = {
    "t": T,
    "ms": 1e3 * T,
    "us": 1e6 * T,
    "wrapping": (2.0**32 - 1e6 + 1e6 * T) % 2.0**32,
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
    """A recorder's file: name, writer, rig, truth, and the columns that a draft has to find."""

    file: str
    write: Callable[[Path], None]
    truth: dict[str, str]
    required: tuple[str, ...]
    two_cylinders: bool = False


RECORDINGS: dict[str, Recording] = {}


def _text(style: str, file: str, columns: list[tuple[str, str, str]], **given: Any) -> None:
    """Register a text file of the table `recorder_files.toml`."""
    names = [name for name, _, _ in columns]
    mark, form = given.get("mark", ","), given.get("form", "{:.4f}")
    decimal, units = "," if mark == ";" else ".", given.get("cells", [""] * len(columns))

    def write(path: Path) -> None:
        rows = [mark.join(names)] + ([given["units"]] if "units" in given else [])
        for n in range(T.size):
            cells = [form.format(SIGNALS[kind][n]).replace(".", decimal) for _, kind, _ in columns]
            rows.append(mark.join(map(str.__add__, cells, units)))
        text = given.get("head", "") + "\r\n".join(rows) + "\r\n"
        path.write_bytes(text.encode(given.get("encoding", "utf-8")))

    truth = {name.replace("\n", " ").strip('"'): channel for name, _, channel in columns}
    needed = tuple(names[int(at)] for at in given.get("required", "").split())
    RECORDINGS[style] = Recording(file, write, truth, needed, given.get("two", False))


for _row in tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))["file"]:
    _text(**_row)


def _rows(kinds: str, mark: str = ",", size: int = T.size, step: int = 1) -> list[str]:
    """Rows of numbers of some signals; '-' is a blank cell."""
    each = [SIGNALS.get(kind, np.full(T.size, np.nan))[:size:step] for kind in kinds.split()]
    return [mark.join(f"{x:.4f}".replace("nan", "") for x in row) for row in zip(*each)]


def _lines(style: str, file: str, lines: list[str], truth: dict[str, str], *given: str) -> None:
    """Register a text file of lines; what is ``given`` has to be found, all else '' not."""
    text = "\r\n".join(lines) + "\r\n"
    RECORDINGS[style] = Recording(file, lambda path: path.write_text(text) and None, truth, given)


HEAD, ROD, Q = "lift.p_head", "lift.p_rod", "lift.q"
_ARM = "Model Root/Arm/"
_TOP = ["descriptions,General,User,x", ",General,DateTime,2026-11-25 10:21:45", ""]


def _section(names: str, paths: str, units: str, kinds: str, step: int) -> list[str]:
    """A time base of ControlDesk."""
    rows = [f",{row}" for row in _rows(f"t {kinds}", step=step)]
    every = ",10ms" * (len(kinds.split()) + 1)
    head = [f"trace_size,{len(rows)}", f"trace_names,,{names}", f"trace_units,,{units}"]
    return [*head, f"raster{every}", f"path,,{paths}", "trace_values" + rows[0], *rows[1:]]


_FAST = (
    "In1,In1,Duty,In1",
    f"{_ARM}p_head,{_ARM}p_rod,Model Root/PWM,{_ARM}angle",
    "bar,bar,%,deg",
)
_SLOW = ("Out1,p_pump", "Model Root/Supply,Model Root/Supply", "degC,bar")
_PATHS = {f"{_ARM}p_head": HEAD, f"{_ARM}p_rod": ROD, "Model Root/PWM": "", f"{_ARM}angle": Q}
_fast, _slow = _section(*_FAST, "a b pct q", 1), _section(*_SLOW, "temp s", 5)
_lines("ControlDesk CSV", "a.csv", [*_TOP, *_fast], _PATHS, f"{_ARM}p_head", f"{_ARM}angle")
_lines(
    "ControlDesk CSV, two rasters",
    "a.csv",
    [*_TOP, *_fast, "", *_slow],
    {**_PATHS, "1/column 2": "t", "2/column 2": "t", "Out1": "", "p_pump": "p_supply"},
    *(f"{_ARM}p_head", "1/column 2", "2/column 2", "p_pump"),
)
_SCOPE = ["Name\tcrane", "Starttime of export\t132959733843760000\tMontag, 2. Mai 2022", "", ""]
_FACTS = {
    "Name": "p_head p_rod angle cmd",
    "Data-Type": "REAL64 REAL64 REAL64 REAL64",
    "SampleTime[ms]": "10 10 10 10",
    "IndexOffset": "385000 385008 385016 385024",
    "BitMask": "0xff 0xff 0xff 0xff",
    "Unit": "bar_(Pressure) bar_(Pressure) °_(Angle) V_(Voltage)",
    "Unit Offset": "0 0 0 0",
}
_CHANNELS = {"p_head": HEAD, "p_rod": ROD, "angle": Q, "cmd": "lift.spool.command"}
for _style, _kinds in (("a time a channel", "ms a ms b ms q ms u"), ("one time", "ms a b q u")):
    _each = "\t" if _kinds.count("ms") == 1 else "\t{title}\t"
    _head = [
        f"{title}\t" + _each.format(title=title).join(cells.split()).replace("_(", " (")
        for title, cells in _FACTS.items()
    ]
    _lines(
        f"TwinCAT scope, {_style}",
        "a.csv",
        [*_SCOPE, *_head, "", *(row.replace(".", ",") for row in _rows(_kinds, "\t"))],
        {**_CHANNELS, "SampleTime[ms]": "t"},
        *("SampleTime[ms]", "p_head", "p_rod", "angle", "cmd"),
    )
_LVM = ["LabVIEW Measurement\t", "Multi_Headings\tYes", "***End_of_Header***\t", "\t"]
_BLOCK = ["Channels\t2\t\t", "Samples\t300\t300\t", "Y_Unit_Label\tbar\tdeg\t", "X0\t0.5\t0.5\t"]
_BLOCK += [
    "Delta_X\t1.0E-2\t1.0E-2\t",
    "***End_of_Header***\t\t\t",
    "X_Value\tp_head\tangle\tComment",
]
_lines(
    "LabVIEW .lvm without X",
    "a.lvm",
    [*_LVM, *_BLOCK, *_rows("- a q", "\t")],
    {"p_head": HEAD, "angle": Q},
    *("p_head", "angle"),
)
_lines(
    "LabVIEW .lvm, segments",
    "a.lvm",
    [*_LVM, *_BLOCK, *_rows("t a q", "\t")[:150], "", *_BLOCK, *_rows("t a q", "\t")[150:]],
    {"X_Value": "t", "p_head": HEAD, "angle": Q},
    *("X_Value", "p_head", "angle"),
)
_STATION = [
    "Data Header:\tTime:\t12.5\tSec\t11/25/2026 10:00:00 AM",
    "Data Acquisition\t2\tsegments",
]
_STATION += ["Running Time\tDisplacement\tForce\tHead Pressure", "Sec\tmm\tN\tMPa"]
_station = _rows("t x force r", "\t")
_lines(
    "MTS blocks",
    "a.txt",
    [
        "MTS793|MPT|ENU|1|2|.|/|:|1|0|0|A",
        "",
        *_STATION,
        *_station[:99],
        "",
        *_STATION,
        *_station[99:],
    ],
    {
        "Running Time": "t",
        "Displacement": "lift.x",
        "Force": "lift.rod_force",
        "Head Pressure": HEAD,
    },
    *("Running Time", "Displacement", "Force", "Head Pressure"),
)
_SETUP = ['"Model Name","DL850EV"', '"TraceName"," p_head "," angle "', '"BlockSize","300","300"']
_SETUP += ['"VUnit","bar","deg"', '"HResolution","1.0E-02","1.0E-02"', '"HOffset","0.0","0.0"']
_SETUP += ['"Date","2026/11/25","2026/11/25"', '"Time","10:00:00.123","10:00:00.123"', ""]
_lines(
    "Yokogawa",
    "a.csv",
    [*_SETUP, *(f"{row}," for row in _rows("- a q"))],
    {"p_head": HEAD, "angle": Q},
    *("p_head", "angle"),
)

_FACTS_BESIDE = ["Record Length,3.0E+02", "Source,CH1", "Vertical Units,V", "Yzero,0"]
_FACTS_BESIDE += ["," for _ in _rows("t")[4:]]
_lines(
    "Tektronix, facts beside",
    "a.csv",
    [f"{fact},,{row}," for fact, row in zip(_FACTS_BESIDE, _rows("t a"))],
    {"column 2": "", "column 4": "t", "column 5": ""},
    "column 4",
)
_lines(
    "R",
    "a.txt",
    ['"time_s" "p_head_bar" "angle_deg"']
    + [f'"{n}" {row}' for n, row in enumerate(_rows("t a q", " "), 1)],
    {"column 1": "", "time_s": "t", "p_head_bar": HEAD, "angle_deg": Q},
    *("time_s", "p_head_bar", "angle_deg"),
)
_lines(
    "pandas, two rows of names",
    "a.csv",
    [",p_head,angle", "unit,bar,deg", "time,,", *_rows("t a q")],
    {"column 1": "t", "column 2": "", "column 3": Q},
    *("column 1", "column 3"),
)
_RESTARTED = ["t [s],p_head [bar],angle [deg]"]
_lines(
    "a logger that goes on below a second head",
    "a.csv",
    [*_RESTARTED, *_rows("t a q")[:99], *_RESTARTED, *_rows("t a q")[99:]],
    {"t [s]": "t", "p_head [bar]": HEAD, "angle [deg]": Q},
    *("t [s]", "p_head [bar]", "angle [deg]"),
)

_lines(
    "remarks below the names",
    "a.csv",
    [*_RESTARTED, "# started by hand", "# 2", *_rows("t a q")],
    {"t [s]": "t", "p_head [bar]": HEAD, "angle [deg]": Q},
    *("t [s]", "p_head [bar]", "angle [deg]"),
)
_lines(
    "Octave",
    "a.txt",
    ["# Created by Octave 8.4.0", "# name: data", "# rows: 300", "# columns: 3"]
    + _rows("t a q", " "),
    {"column 1": "t", "column 2": "", "column 3": ""},
    "column 1",
)
_lines(
    "Rigol",
    "a.csv",
    ["X,CH1,CH2,Start,Increment,", "Sequence,Volt,Volt,-1.500000e-01,1.000000e-02"]
    + [f"{row},," for row in _rows("n a b")],
    {"X": "", "CH1": "", "CH2": ""},
)
_lines(
    "Rigol, one line",
    "a.csv",
    ["CH1V,CH2V,t0 =-0.15s, tInc = 10ms,", *(f"{row},,," for row in _rows("a b"))],
    {"CH1V": "", "CH2V": ""},
)
_lines(
    "names and values above the numbers",
    "a.txt",
    ["Sample rate: 100 Hz", "Operator: Meier", "", "p_head [bar]\tangle [deg]"]
    + _rows("a q", "\t"),
    {"p_head [bar]": HEAD, "angle [deg]": Q},
    *("p_head [bar]", "angle [deg]"),
)
_lines(
    "start and increment in a table of their own",
    "a.mat",
    ["start,increment", "-0.15,0.01", "p_head [bar],angle [deg]", *_rows("a q")],
    {"p_head [bar]": HEAD, "angle [deg]": Q},
    *("p_head [bar]", "angle [deg]"),
)
_lines(
    "Siglent",
    "a.csv",
    ["Vertical Units,CH1:V,CH2:V", "Model,SDS1204", "Second,Volt,Volt", *_rows("t u a")],
    {"Second": "t", "Volt": "", "Volt 2": ""},
    "Second",
)
_lines(
    "two runs below one another",
    "a.csv",
    ["t [s],pressure [bar]", *_rows("t a"), "", "t [s],pressure [bar],rpm", *_rows("t b count")],
    {"1/t [s]": "t", "1/pressure [bar]": "", "2/t [s]": "t", "2/pressure [bar]": "", "rpm": ""},
    *("1/t [s]", "2/t [s]"),
)
_lines(
    "a listing of a database",
    "a.txt",
    [" t [s] | p_rod [bar] | angle [deg] ", *_rows("t b q", " | ")],
    {"t [s]": "t", "p_rod [bar]": ROD, "angle [deg]": Q},
    *("t [s]", "p_rod [bar]", "angle [deg]"),
)
_lines(
    "quotients of quantity and unit",
    "a.csv",
    ["t/s;p_rod/bar;Winkel/deg;mV/V", *_rows("t b q u", ";")],
    {"t/s": "t", "p_rod/bar": ROD, "Winkel/deg": Q, "mV/V": ""},
    *("t/s", "p_rod/bar", "Winkel/deg"),
)
_lines(
    "one name for all sensors",
    "a.csv",
    ["time,press,press,press", "s,bar,bar,bar", *_rows("t a b u")],
    {"time": "t", "press": "", "press 2": "", "press 3": ""},
    "time",
)


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
_mat(
    "fields of a struct",
    lambda: {"log": {"t": T, "x": SIGNALS["q"], "y": SIGNALS["a"], "p_rod": SIGNALS["b"]}},
    {"log.t": "t", "log.x": "", "log.y": "", "log.p_rod": ""},
)
