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


def _text(style: str, file: str, columns: list[tuple[str, str, str]], **given: Any) -> None:
    """Register a text file of the table `recorder_files.toml`."""
    names = [name for name, _, _ in columns]
    mark, form = given.get("mark", ","), given.get("form", "{:.4f}")
    decimal = "," if mark == ";" else "."

    def write(path: Path) -> None:
        rows = [mark.join(names)] + ([given["units"]] if "units" in given else [])
        for n in range(T.size):
            cells = [form.format(SIGNALS[kind][n]).replace(".", decimal) for _, kind, _ in columns]
            rows.append(mark.join(cells))
        text = given.get("head", "") + "\r\n".join(rows) + "\r\n"
        path.write_bytes(text.encode(given.get("encoding", "utf-8")))

    truth = {name.replace("\n", " ").strip('"'): channel for name, _, channel in columns}
    needed = tuple(names[int(at)] for at in given.get("required", "").split())
    RECORDINGS[style] = Recording(file, write, truth, needed, given.get("two", False))


for _row in tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))["file"]:
    _text(**_row)


def _controldesk(path: Path) -> None:
    rows = ["descriptions,General,User,x", ",General,DateTime,2026-11-25 10:21:45", ""]
    rows += ["trace_size,300", "trace_types,5,4,4,4,4", "trace_names,,In1,In1,Duty,In1"]
    rows += ["trace_units,,bar,bar,%,deg", "raster,10ms,10ms,10ms,10ms,10ms"]
    rows += ["path,,Model Root/Arm/p_head,Model Root/Arm/p_rod,Model Root/PWM,Model Root/Arm/angle"]
    for n in range(T.size):
        cells = [f"{SIGNALS[kind][n]:.3f}" for kind in ("t", "a", "b", "pct", "q")]
        rows.append(f"{'trace_values' if n == 0 else ''},{','.join(cells)}")
    path.write_text("\n".join(rows) + "\n")


HEAD, Q = "lift.p_head", "lift.q"
_ARM = "Model Root/Arm/"
RECORDINGS["ControlDesk CSV"] = Recording(
    "a.csv",
    _controldesk,
    {f"{_ARM}p_head": HEAD, f"{_ARM}p_rod": "lift.p_rod", "Model Root/PWM": "", f"{_ARM}angle": Q},
    (f"{_ARM}p_head", f"{_ARM}angle"),
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
