"""Recordings as other programs write them, by the libraries of their formats."""

import gzip
import json
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

BEGAN = 1772366400  # 2026-03-01 12:00 UTC
T = np.arange(400) / 1000.0  # [s] of the fast channels
SLOW = np.arange(40) / 100.0  # [s] of the slow one
HEAD = 50.0 + 5.0 * np.sin(9.0 * T)  # [bar]
CURRENT = 12.0 + 4.0 * np.sign(np.sin(30.0 * T))  # [mA]
SUPPLY = 200.0 + 10.0 * SLOW  # [bar]


def write_text(path: Path) -> None:
    """As LabVIEW writes it in Germany: facts, a row of units, semicolons, decimal commas."""
    head = "Prüfstand;Holzspalter\r\nDate;21.03.2026\r\nSamples;400;400;400\r\n\r\n"
    head += "Time (s);PT-101 cyl A;Supply;AO0 valve\r\ns;bar;bar;mA\r\n"
    supply = np.interp(T, SLOW, SUPPLY)
    rows = [f"{a:.3f};{b:.6f};{c:.4f};{d:.1f}" for a, b, c, d in zip(T, HEAD, supply, CURRENT)]
    path.write_bytes((head + "\r\n".join(rows).replace(".", ",") + "\r\n").encode("cp1252"))


def write_gzip(path: Path) -> None:
    supply = np.interp(T, SLOW, SUPPLY)
    rows = [f"{a},{b},{c},{d}" for a, b, c, d in zip(T, HEAD, supply, CURRENT)]
    text = "t [s],PT-101 cyl A [bar],Supply [bar],AO0 valve [mA]\n" + "\n".join(rows)
    path.write_bytes(gzip.compress(text.encode(), mtime=0))


def write_json(path: Path) -> None:
    """A record a line, the supply in every tenth."""
    lines = []
    for n, (t, head, current) in enumerate(zip(T.tolist(), HEAD.tolist(), CURRENT.tolist())):
        record = {"t [s]": t, "PT-101 cyl A [bar]": head, "AO0 valve [mA]": current}
        lines.append(record | ({} if n % 10 else {"Supply [bar]": SUPPLY[n // 10].item()}))
    path.write_text("\n".join(map(json.dumps, lines)), encoding="utf-8")


def write_mdf(path: Path) -> None:
    from asammdf import MDF, Signal

    with MDF(version="4.10") as file:
        file.start_time = datetime.fromtimestamp(BEGAN, UTC)
        fast = [
            Signal(HEAD, T, unit="bar", name="PT-101 cyl A"),
            Signal(CURRENT, T, unit="mA", name="AO0 valve"),
            Signal(np.array([b"RUN"] * T.size), T, name="state", encoding="utf-8"),
        ]
        file.append(fast, acq_name="fast")
        file.append([Signal(SUPPLY, SLOW, unit="bar", name="Supply")], acq_name="slow")
        file.save(path, overwrite=True)


def write_tdms(path: Path) -> None:
    from nptdms import ChannelObject, TdmsWriter

    start = np.datetime64(datetime.fromtimestamp(BEGAN, UTC).replace(tzinfo=None), "us")

    def said(unit: str, tick: float) -> dict[str, object]:
        about = {"wf_increment": tick, "wf_start_time": start, "wf_start_offset": 0.0}
        return {**about, "unit_string": unit}

    with TdmsWriter(path) as file:
        half = T.size // 2
        for part in (slice(0, half), slice(half, None)):  # as segments come from a running program
            channels = [
                ChannelObject("Rig", "PT-101 cyl A", HEAD[part], said("bar", 1e-3)),
                ChannelObject("Rig", "AO0 valve", CURRENT[part], said("mA", 1e-3)),
            ]
            file.write_segment(channels)
        file.write_segment([ChannelObject("Rig", "Supply", SUPPLY, said("bar", 1e-2))])


def write_mat(path: Path) -> None:
    from scipy.io import savemat

    slow = {"time": SLOW, "Supply": SUPPLY}
    savemat(path, {"time": T, "cyl_A": HEAD, "AO0_valve": CURRENT[:, None], "slow": slow})


def write_mat73(path: Path) -> None:
    """As MATLAB writes it: an HDF5 file behind a head of 512 bytes."""
    import h5py

    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (("time", T), ("cyl_A", HEAD), ("AO0_valve", CURRENT)):
            file[name] = values[None, :]
        file["slow/time"], file["slow/Supply"] = SLOW[None, :], SUPPLY[None, :]
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    data = path.read_bytes()
    path.write_bytes(head.ljust(512, b"\0") + data[512:])


def write_hdf5(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        for place, name, values, unit in (
            ("fast", "time", T, "s"),
            ("fast", "PT-101 cyl A", HEAD, "bar"),
            ("fast", "AO0 valve", CURRENT, "mA"),
            ("slow", "time", SLOW, "s"),
            ("slow", "Supply", SUPPLY, "bar"),
        ):
            file[f"{place}/{name}"] = values
            file[f"{place}/{name}"].attrs["unit"] = unit
        file["words"] = ["a", "b"]


def write_parquet(path: Path) -> None:
    import pandas as pd

    moments = pd.to_datetime(BEGAN * 10**9 + np.rint(T * 1e9).astype(np.int64), utc=True)
    columns = {"PT-101 cyl A [bar]": HEAD, "Supply [bar]": np.interp(T, SLOW, SUPPLY)}
    own = {"time": moments, **columns, "AO0 valve [mA]": CURRENT, "state": "RUN"}
    pd.DataFrame(own).to_parquet(path)


def write_excel(path: Path) -> None:
    import openpyxl

    book = openpyxl.Workbook()
    sheet: Any = book.active
    sheet.title = "Log"
    for row in (["Operator", "me"], [], ["Time", "PT-101 cyl A", "AO0 valve"], ["s", "bar", "mA"]):
        sheet.append(row)
    for row in zip(T.tolist(), HEAD.tolist(), CURRENT.tolist()):
        sheet.append(row)
    slow = book.create_sheet("Slow")
    slow.append(["Time [s]", "Supply [bar]"])
    for row in zip(SLOW.tolist(), SUPPLY.tolist()):
        slow.append(row)
    book.create_sheet("Notes").append(["nothing to see"])
    book.save(path)


def write_npz(path: Path) -> None:
    fast = {"time": T, "PT-101 cyl A [bar]": HEAD, "AO0 valve [mA]": CURRENT}
    slow = {"slow/time": SLOW, "slow/Supply [bar]": SUPPLY}
    np.savez_compressed(path, **fast, **slow)


def write_bag(path: Path, plugin: str = "MCAP") -> None:
    """A ROS 2 bag: joints, a pressure, a command; the supply at a tenth of the rate."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    kinds = store.types
    time = kinds["builtin_interfaces/msg/Time"]
    header = kinds["std_msgs/msg/Header"]
    joints, pressure = kinds["sensor_msgs/msg/JointState"], kinds["sensor_msgs/msg/FluidPressure"]
    number, text = kinds["std_msgs/msg/Float64"], kinds["std_msgs/msg/String"]
    with Writer(path, version=9, storage_plugin=StoragePlugin[plugin]) as file:
        topics = {
            name: (file.add_connection(name, kind.__msgtype__, typestore=store), kind)
            for name, kind in {
                "/joint_states": joints,
                "/cyl_A": pressure,
                "/supply": pressure,
                "/AO0_valve": number,
                "/words": text,
            }.items()
        }

        def put(name: str, stamp: int, message: object) -> None:
            connection, kind = topics[name]
            file.write(connection, stamp, store.serialize_cdr(message, kind.__msgtype__))

        for i in range(T.size):
            stamp = BEGAN * 10**9 + round(T[i] * 1e9)
            at = header(stamp=time(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="")
            angles = np.array([0.1 * T[i], 0.5])
            late = stamp + 300_000 * (i % 3)  # the recorder is late, the header is not
            own = joints(at, ["boom", "stick"], angles, np.array([0.1, 0.0]), np.array([]))
            put("/joint_states", late, own)
            put("/cyl_A", late, pressure(at, HEAD[i] * 1e5, 0.0))
            put("/AO0_valve", stamp, number(CURRENT[i]))
            if i % 10 == 0:
                put("/supply", late, pressure(at, SUPPLY[i // 10] * 1e5, 0.0))
        put("/words", stamp, text("done"))


WRITERS: dict[str, Callable[[Path], None]] = {
    "a.csv": write_text,
    "a.csv.gz": write_gzip,
    "a.jsonl": write_json,
    "a.mf4": write_mdf,
    "a.tdms": write_tdms,
    "a.mat": write_mat,
    "a73.mat": write_mat73,
    "a.h5": write_hdf5,
    "a.parquet": write_parquet,
    "a.xlsx": write_excel,
    "a.npz": write_npz,
    "a_bag": write_bag,
    "a_db3": lambda path: write_bag(path, "SQLITE3"),
}
PACKAGES = {
    "a.mf4": "asammdf",
    "a.tdms": "nptdms",
    "a73.mat": "h5py",
    "a.h5": "h5py",
    "a.parquet": "pyarrow",
    "a.xlsx": "openpyxl",
    "a_bag": "rosbags",
    "a_db3": "rosbags",
}
CURRENTS = 'from = ["4 mA", "20 mA"], to = ["-10 V", "10 V"]'


def map_of(name: str) -> str:
    """The map of columns of a file that one of the writers made."""
    command = f'{{ channel = "ram.spool.command", {CURRENTS} }}'
    if name.endswith(".mat"):
        return (
            f'[names]\n"time" = "t [s]"\n"slow.time" = "t [s]"\n"cyl_A" = "ram.p_head [bar]"\n'
            f'"slow.Supply" = "p_supply [bar]"\nAO0_valve = {command}\n'
            if name == "a.mat"
            else f'[names]\n"/time" = "t [s]"\n"slow/time" = "t [s]"\n'
            f'cyl_A = "ram.p_head [bar]"\nSupply = "p_supply [bar]"\nAO0_valve = {command}\n'
        )
    if name.startswith("a_"):
        return (
            '[names]\n"/cyl_A/fluid_pressure" = "ram.p_head"\n"/supply/fluid_pressure" = "p_supply"'
            f'\n"/AO0_valve/data" = {command}\n"position.boom" = "ram.q [rad]"\n'
        )
    times = {
        "a.csv": ("Time (s)",),
        "a.csv.gz": ("t [s]",),
        "a.jsonl": ("t [s]",),
        "a.h5": ("fast/time", "slow/time"),
        "a.parquet": ("time",),
        "a.npz": ("/time", "slow/time"),
        "a.xlsx": ("Time", "Time [s]"),
    }.get(name, ())
    ends = " [bar]" if name in ("a.csv.gz", "a.jsonl", "a.parquet", "a.npz") else ""
    supply = " [bar]" if name == "a.xlsx" else ends
    current = ends and " [mA]"
    lines = [f'"{time}" = "t [s]"' for time in times]
    lines.append(f'"PT-101 cyl A{ends}" = "ram.p_head"')
    lines.append(f'"Supply{supply}" = "p_supply"')
    lines.append(f'"AO0 valve{current}" = {command}')
    return "[names]\n" + "\n".join(lines) + "\n"
