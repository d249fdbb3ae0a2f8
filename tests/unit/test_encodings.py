"""Known numbers in every encoding of each format's library are read back or refused."""

import datetime
import decimal
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from ehbench.data.readers import open_source
from ehbench.data.readers.mdf import evaluate
from ehbench.vocabulary.errors import LogError

NAN = float("nan")
COUNTS = (0, 1, 2, 3, 40, 50, 60, 1000)  # as a recorder stores them
HALVES = [0.5 * count - 3.0 for count in COUNTS]
PLAIN = [float(count) for count in COUNTS]
HOLES = [*PLAIN[:-2], NAN, NAN]
READ = Mapping[str, Sequence[float] | None]  # None: refused


def hdf5(path: Path) -> READ:
    h5py = pytest.importorskip("h5py")
    counts, scaled = np.array(COUNTS, np.int16), {"scale_factor": 0.5, "add_offset": -3.0}
    sets = {
        "int16": (counts, {}, PLAIN),
        "big endian": (counts.astype(">i4"), {}, PLAIN),
        "float32": (counts.astype("f4"), {}, PLAIN),
        "float16": (counts.astype("f2"), {}, PLAIN),
        "scaled": (counts, scaled, HALVES),
        "scaled float32": (counts.astype("f4"), scaled, HALVES),
        "scale in an array": (counts, {"scale_factor": [0.5], "add_offset": [-3]}, HALVES),
        "fill": (counts, {"_FillValue": np.int16(1000), "missing_value": np.int16(60)}, HOLES),
        "several missing": (counts, {"missing_value": np.array([60, 1000], "i2")}, HOLES),
        "fill of floats": (np.array([*COUNTS[:-2], 1e20, 1e20], "f4"), {"_FillValue": 1e20}, HOLES),
        "range": (counts, {"valid_range": np.array([0, 50], "i2")}, HOLES),
        "maximum": (counts, {"valid_max": np.int16(50), "valid_min": np.int16(0)}, HOLES),
        "unsigned": (
            np.array([*COUNTS[:-2], -56, -2]).astype("i1"),
            {"_Unsigned": "true", "_FillValue": np.int8(-2)},
            [*PLAIN[:-2], 200.0, NAN],
        ),
        "odd scale": (counts, {"scale_factor": "a half"}, None),
        "logical": (counts > 2, {}, [0.0] * 3 + [1.0] * 5),
    }
    with h5py.File(path, "w") as file:
        for name, (values, attributes, _) in sets.items():
            file[name] = values
            file[name].attrs.update(attributes)
        packing = {"compression": "gzip", "shuffle": True, "chunks": (4,), "fletcher32": True}
        file.create_dataset("packed", data=counts, **packing)
        file.create_dataset("rounded", data=counts, scaleoffset=0, chunks=(8,))
        unknown = {"compression": 32001, "allow_unknown_filter": True, "chunks": (8,)}
        blosc = file.create_dataset("blosc", (8,), "i2", **unknown)
        blosc.id.write_direct_chunk((0,), b"packed")
        kind = h5py.enum_dtype({"OFF": 0, "ON": 1})
        file.create_dataset("enumeration", data=[0, 1] * 4, dtype=kind)
        file["words"] = ["a"] * 8
        file["time"] = np.arange(8)
        file["time"].attrs["units"] = "minutes since 2026-03-01 12:00:00"
        layout = h5py.VirtualLayout((8,), "i2")
        layout[:] = h5py.VirtualSource(path, "int16", (8,))
        file.create_virtual_dataset("virtual", layout)
        (path.parent / "other").write_bytes(bytes(64))
        other = [(str(path.parent / "other"), 0, 64)]
        file.create_dataset("external", (8,), "f8", external=other)
        file["linked"] = h5py.ExternalLink("other.h5", "int16")
    rest = dict.fromkeys(("enumeration", "words", "virtual", "external", "linked", "blosc"))
    times = {"time": [60.0 * n for n in range(8)]}
    both = {"packed": PLAIN, "rounded": PLAIN, **times, **rest}
    return {name: read for name, (_, _, read) in sets.items()} | both


def mat(path: Path) -> READ:
    from scipy.io import savemat

    kinds = ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "f4", "f8")
    small = np.array([*COUNTS[:-1], 100])
    content = {f"kind_{kind}": small.astype(kind) for kind in kinds}
    units = {"values": np.array(PLAIN), "label": "labelled", "unit": "bar"}
    content |= {
        "logical": np.array(COUNTS) > 2,
        "row": np.array(PLAIN)[None, :],
        "columns": np.array([PLAIN, HALVES]).T,
        "scope": {"time": np.arange(8.0), "signals": [units, units | {"label": "second"}]},
        "alone": {"Data": np.array(PLAIN), "Name": "a name"},
        "cells": np.array(["a", 1.0], object),
    }
    savemat(path, content, do_compression=True)
    expected: dict[str, Sequence[float] | None] = {
        f"kind_{kind}": [*PLAIN[:-1], 100.0] for kind in kinds
    }
    expected |= {"logical": [0.0] * 3 + [1.0] * 5, "row": PLAIN, "a name": PLAIN}
    expected |= {"columns.1": PLAIN, "columns.2": HALVES, "cells": None}
    return expected | {"labelled": PLAIN, "second": PLAIN, "scope.time": list(range(8))}


def controldesk(path: Path) -> READ:
    """Two clocks of one length."""
    from scipy.io import savemat

    clocks = [{"Name": f"t{n}", "Data": n * np.arange(8.0), "Unit": "s"} for n in (1, 2)]
    names = [{"Name": name, "Data": np.array(PLAIN), "Unit": "bar"} for name in ("p", "q")]
    channels = [{**channel, "XIndex": n} for n, channel in enumerate(names, 1)]
    savemat(path, {"run": {"X": clocks, "Y": channels, "Description": "x"}})
    (one, two) = open_source(path).tables
    names = [[column.name for column in table.columns] for table in (one, two)]
    assert names == [["t1", "p"], ["t2", "q"]]
    return {"t1": list(range(8)), "t2": list(range(0, 16, 2)), "p": PLAIN, "q": PLAIN}


def parquet(path: Path) -> READ:
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as pq

    began = datetime.datetime(2026, 3, 1, 12, tzinfo=datetime.UTC)
    moments = [began + datetime.timedelta(seconds=count) for count in COUNTS]
    holes = [None if value != value else value for value in HOLES]
    whole = [None if value is None else int(value) for value in holes]
    columns = {
        **{kind: pa.array(COUNTS, kind) for kind in ("int16", "uint32", "int64", "float32")},
        "float16": pa.array(np.array(COUNTS, "f2")),
        "masked floats": pa.array(holes),
        "masked integers": pa.array(whole, "int32"),
        "masked truths": pa.array([None, True, False, True] * 2),
        "decimal": pa.array([decimal.Decimal(count) / 2 - 3 for count in COUNTS]),
        "dictionary": pa.array(HALVES).dictionary_encode(),
        "nothing": pa.nulls(8),
        "duration": pa.array([datetime.timedelta(seconds=count) for count in COUNTS]),
        "time of day": pa.array([moment.time() for moment in moments]),
        "moment": pa.array(moments, pa.timestamp("ms", "UTC")),
        "day": pa.array([moment.date() for moment in moments]),
        "words": pa.array(["a"] * 8),
        "numbers as words": pa.array([str(half) for half in HALVES]),
        "grouped": pa.array(["1,000"] * 8),
        "list": pa.array([[1.0]] * 8),
        "period": pa.array(COUNTS, "int64"),
    }
    table = pa.table(columns)
    fields = [field.with_metadata({"unit": "bar"}) for field in table.schema]
    kind = {"ARROW:extension:name": "pandas.period", "ARROW:extension:metadata": '{"freq": "s"}'}
    fields[-1] = fields[-1].with_metadata(kind)
    pq.write_table(table.cast(pa.schema(fields)), path)
    seconds = [value - PLAIN[0] for value in PLAIN]
    expected: dict[str, Sequence[float] | None] = dict.fromkeys(columns, PLAIN)
    expected |= {"masked floats": HOLES, "masked integers": HOLES, "nothing": [NAN] * 8}
    expected |= {"masked truths": [NAN, 1.0, 0.0, 1.0] * 2, "decimal": HALVES, "dictionary": HALVES}
    expected |= {"duration": seconds, "time of day": seconds, "moment": seconds, "day": [0.0] * 8}
    expected |= dict.fromkeys(("words", "numbers as words", "grouped", "list", "period"))
    return expected


def tdms(path: Path) -> READ:
    nptdms = pytest.importorskip("nptdms")

    def scale(kind: str, n: int = 0, **about: float) -> dict[str, object]:
        named = {f"NI_Scale[{n}]_{kind}_{key}": value for key, value in about.items()}
        return {f"NI_Scale[{n}]_Scale_Type": kind, **named}

    linear = scale("Linear", Slope=0.5, Y_Intercept=-3.0, Input_Source=0xFFFFFFFF)
    polynomial = scale(
        "Polynomial",
        **{"Coefficients_Size": 3, "Coefficients[0]": -3.0, "Coefficients[1]": 0.5},
        **{"Coefficients[2]": 0.0, "Input_Source": 0xFFFFFFFF},
    )
    status = {"NI_Scaling_Status": "unscaled", "NI_Number_Of_Scales": 1}
    counts = np.array(COUNTS, np.int16)
    channels: dict[str, tuple[np.ndarray, dict[str, object], Sequence[float] | None]] = {
        "int16": (counts, {}, PLAIN),
        "float32": (counts.astype("f4"), {}, PLAIN),
        "linear": (counts, {**status, **linear}, HALVES),
        "polynomial": (counts, {**status, **polynomial}, HALVES),
        "already scaled": (counts, {**status, **linear, "NI_Scaling_Status": "scaled"}, PLAIN),
        "reciprocal": (counts, {**status, **scale("Reciprocal", Slope=2.0)}, None),
        "half a scale": (counts, {**status, **scale("Linear", Slope=2.0)}, None),
        "of no scale": (counts, {**status, **linear, "NI_Scale[0]_Linear_Input_Source": 7}, None),
        "logical": (counts > 2, {}, [0.0] * 3 + [1.0] * 5),
        "words": (np.array(["a"] * 8), {}, None),
    }
    with nptdms.TdmsWriter(path) as file:
        file.write_segment(
            [nptdms.ChannelObject("g", name, *what[:2]) for name, what in channels.items()]
        )
    return {name: read for name, (_, _, read) in channels.items()}


def mdf(path: Path, version: str) -> READ:
    asammdf = pytest.importorskip("asammdf")
    from asammdf.blocks.conversion_utils import from_dict

    counts, t = np.array(COUNTS, np.int32), np.arange(8.0)
    polynomial = {"P1": 0.0, "P2": 0.5, "P3": -3.0, "P4": 0.0, "P5": 0.0, "P6": 1.0}
    square = {"P1": 1.0, "P2": 0.0, "P3": 0.0, "P4": 0.0, "P5": 1.0, "P6": 1.0}
    table = {f"raw_{n}": float(c) for n, c in enumerate(COUNTS)}
    table |= {f"phys_{n}": half for n, half in enumerate(HALVES)}
    ranges = {"lower_0": 0.0, "upper_0": 3.0, "phys_0": 1.0}
    ranges |= {"lower_1": 4.0, "upper_1": 2000.0, "phys_1": 2.0, "default": 0.0}
    states = {"val_0": 0.0, "text_0": "OFF", "val_1": 1.0, "text_1": "ON"}
    rows: dict[str, tuple[Mapping[str, object], Sequence[float] | None]] = {
        "plain": ({}, PLAIN),
        "linear": ({"a": 0.5, "b": -3.0}, HALVES),
        "rational": (polynomial, HALVES),
        "quotient": (square, [count**2 / (count + 1) for count in COUNTS]),
        "formula": ({"formula": "0.5*X-3"}, HALVES),
        "power": ({"formula": "X^2 + pow(X, 2)"}, [2.0 * count**2 for count in COUNTS]),
        "logarithm": ({"formula": "ln(X+1)"}, [float(np.log(count + 1)) for count in COUNTS]),
        "condition": ({"formula": "if(X>2, 1, 0)"}, None),
        "table": (table, HALVES),
        "line": ({**table, "interpolation": True}, HALVES),
        "ranges": (ranges, [1.0] * 4 + [2.0] * 4),
        "states": (states, None),
    }
    if version[0] == "3":
        rows.pop("ranges")  # version 3 has none
    large = counts * 100  # their squares are beyond 32 bits
    expected = {name: read for name, (_, read) in rows.items()}
    signals = [
        asammdf.Signal(counts, t, name=name, conversion=from_dict(dict(conversion)))
        for name, (conversion, _) in rows.items()
    ]
    # pyrefly: ignore[no-matching-overload]
    signals.append(asammdf.Signal(large, t, name="large", conversion=from_dict(dict(square))))
    expected["large"] = [(100.0 * c) ** 2 / (100.0 * c + 1.0) for c in COUNTS]
    for kind in ("u1", "i2", "u4", "f4", "f8"):
        signals.append(asammdf.Signal(counts.astype(kind), t, name=kind))
        expected[kind] = [float(value) for value in counts.astype(kind)]
    if version[0] == "4":
        invalid = np.array([False] * 6 + [True] * 2)
        signals.append(asammdf.Signal(counts, t, name="masked", invalidation_bits=invalid))
        expected["masked"] = HOLES
    with asammdf.MDF(version=version) as file:
        file.append(signals)
        Path(file.save(path.with_suffix(".mdf"), overwrite=True)).rename(path)
    return expected


def excel(path: Path) -> READ:
    openpyxl = pytest.importorskip("openpyxl")
    began = datetime.datetime(2026, 3, 1, 12)
    book = openpyxl.Workbook()
    book.active.append(["whole", "float", "moment", "duration", "logical", "formula", "masked"])
    for count, half in zip(COUNTS, HALVES, strict=True):
        later = datetime.timedelta(seconds=count)
        hole = None if count > 50 else count
        book.active.append([count, half, began + later, later, count > 2, "=A2*2", hole])
    book.save(path)
    return {
        **{"whole": PLAIN, "float": HALVES, "moment": PLAIN, "duration": PLAIN},
        **{"logical": [0.0] * 3 + [1.0] * 5, "Sheet!F": None, "masked": HOLES},
    }


def write_bag(path: Path, lines: Sequence[str], messages: Iterable[Mapping[str, object]]) -> None:
    """A topic of messages of one kind, which has the fields of some lines."""
    pytest.importorskip("rosbags")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("\n".join(lines), "a_msgs/msg/All"))
    content = store.types["a_msgs/msg/All"]
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as file:
        topic = file.add_connection("/all", content.__msgtype__, typestore=store)
        for n, given in enumerate(messages):
            data = store.serialize_cdr(content(**given), content.__msgtype__)
            file.write(topic, 10**9 * n, data)


def bag(path: Path) -> READ:
    small = [*COUNTS[:-1], 100]
    kinds = [f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)]
    kinds += ["float32", "float64"]
    lines = [f"{kind} a_{kind}" for kind in kinds]
    lines += ["bool logical", "float32[2] fixed", "float64[] several", "string word", "int32 ON=1"]
    messages = []
    for count, half in zip(small, HALVES, strict=True):
        lists = {"fixed": np.array([count, half], "f4"), "several": np.array([half])}
        plain = {f"a_{kind}": count for kind in kinds} | {"logical": count > 2, "word": "a"}
        messages.append(plain | lists)
    write_bag(path, lines, messages)
    numbers = [*PLAIN[:-1], 100.0]
    expected: dict[str, Sequence[float] | None] = {f"a_{kind}": numbers for kind in kinds}
    expected |= {"logical": [0.0] * 3 + [1.0] * 5, "fixed.0": numbers, "fixed.1": HALVES}
    return expected | {"several.0": HALVES}


def npz(path: Path) -> READ:
    small = np.array([*COUNTS[:-1], 100])
    kinds = ("i1", ">u2", "<i4", "u8", "f2", ">f4", "f8")
    began = np.datetime64("2026-03-01T12:00:00", "ms")
    content = {f"kind {kind}": small.astype(kind) for kind in kinds} | {
        "moment": began + small.astype("m8[s]"),
        "duration": small.astype("m8[s]"),
        "records": np.array([*zip(PLAIN, HALVES)], [("p", "f4"), ("q", "f8")]),
        "fortran": np.asfortranarray(np.array([PLAIN, HALVES]).T),
        "logical": np.array(COUNTS) > 2,
        "scalar": np.array(5.0),
        "words": np.array(["a"] * 8),
        "objects": np.array([1.0, "a"], object),
        "complex": np.array(PLAIN, complex),
        "place/inside": np.array(HALVES),
    }
    np.savez_compressed(path, **content)
    numbers = [*PLAIN[:-1], 100.0]
    expected: dict[str, Sequence[float] | None] = {f"kind {kind}": numbers for kind in kinds}
    expected |= {"moment": numbers, "duration": numbers, "records.p": PLAIN, "records.q": HALVES}
    expected |= {"fortran.1": PLAIN, "fortran.2": HALVES, "logical": [0.0] * 3 + [1.0] * 5}
    return expected | dict.fromkeys(("words", "objects", "complex")) | {"inside": HALVES}


def npy(path: Path) -> READ:
    """One array, known by how it begins."""
    np.save(path, np.array([PLAIN, HALVES], "f4").T)
    return {"a.1": PLAIN, "a.2": HALVES}


WRITERS = {
    "a_bag": bag,
    "a.npz": npz,
    "workbook.xlsx.npz": npz,
    "a.npy": npy,
    "a.h5": hdf5,
    "a.mat": mat,
    "controldesk.mat": controldesk,
    "a.parquet": parquet,
    "a.tdms": tdms,
    "a.mf4": lambda path: mdf(path, "4.10"),
    "a.mdf": lambda path: mdf(path, "3.30"),
    "a.xlsx": excel,
}


LONG = {  # integers of 64 bits; the second are moments [ns]
    "exact": np.array([2**54 + 4 * n for n in range(8)]),
    "stamps": 1772366400_000000001 + 1001 * np.arange(8),
    "rounded": np.array([2**53 + 1 + n for n in range(8)]),
}


def long_text(path: Path) -> None:
    rows = [",".join(map(str, row)) for row in zip(*LONG.values(), strict=True)]
    path.write_text("\n".join([",".join(LONG), *rows]))


def long_hdf5(path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for name, values in LONG.items():
            file[name] = values


def long_parquet(path: Path) -> None:
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as pq

    pq.write_table(pa.table(LONG), path)


def long_mat(path: Path) -> None:
    from scipy.io import savemat

    savemat(path, LONG)


def long_tdms(path: Path) -> None:
    nptdms = pytest.importorskip("nptdms")
    with nptdms.TdmsWriter(path) as file:
        file.write_segment([nptdms.ChannelObject("g", *item) for item in LONG.items()])


def long_mdf(path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF(version="4.10") as file:
        t = np.arange(8.0)
        file.append([asammdf.Signal(values, t, name=name) for name, values in LONG.items()])
        file.save(path, overwrite=True)


def long_bag(path: Path) -> None:
    rows = (dict(zip(LONG, map(int, row))) for row in zip(*LONG.values(), strict=True))
    write_bag(path, [f"int64 {name}" for name in LONG], rows)


LONG_WRITERS = {
    "a.csv": long_text,
    "a.npz": lambda path: np.savez(path, **LONG),
    "a.h5": long_hdf5,
    "a.parquet": long_parquet,
    "a.mat": long_mat,
    "a.tdms": long_tdms,
    "a.mf4": long_mdf,
    "a_bag": long_bag,
}


@pytest.mark.parametrize("name", LONG_WRITERS)
def test_an_integer_that_no_float_is_is_refused_and_never_rounded(name, tmp_path):
    LONG_WRITERS[name](tmp_path / name)
    source = open_source(tmp_path / name)
    columns = {column.name: column for table in source.tables for column in table.columns}
    assert [int(value) for value in columns["exact"].values] == LONG["exact"].tolist()
    if "rounded" in columns:  # of text, which says so where it is asked for
        doubtful = columns["rounded"].doubt
        assert doubtful is not None
        row, doubt = doubtful
        assert (row, doubt.key) == (0, "data.integer_rounded")
        assert doubt.fields["number"] == str(2**53 + 1)
    else:
        assert any("rounded" in loss and str(2**53 + 1) in loss for loss in source.losses)
    if "stamps" in columns:
        stamps = columns["stamps"]
        assert stamps.unit == "ns" and stamps.values.tolist() == (1001.0 * np.arange(8)).tolist()
        assert source.tables[0].began == pytest.approx(1772366400.0, abs=1e-6)
    else:
        assert name in ("a.tdms", "a.mf4", "a_bag")  # which have a time by themselves
        assert any("stamps" in loss for loss in source.losses)


def test_structs_by_reference_and_objects_of_matlab_are_refused_by_name(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.mat", "w") as file:
        refs = [file.create_dataset(f"#refs#/{n}", data=np.arange(8.0)).ref for n in range(2)]
        file["run/Data"] = np.array(refs, h5py.ref_dtype)
        file["series"] = np.array([3707764736, 2, 1, 1, 1, 1], "u4")
        file["series"].attrs["MATLAB_object_decode"] = 3
        file["t"] = np.arange(8.0)
    source = open_source(tmp_path / "a.mat")
    assert [column.name for table in source.tables for column in table.columns] == ["t"]
    losses = {loss.fields["name"]: loss.key for loss in source.losses}
    assert losses == {"run/Data": "data.matlab_structs", "series": "data.matlab_object"}


EXCEL_TEXTS = {  # cells of one column: their numbers, or the row of a cell that stays in doubt
    "grouped": ([1.5, "1,000", 999.0], 1),
    "three decimals": ([1.002, 12.345, 7.125], [1.002, 12.345, 7.125]),
    "groups that decide": ([1.5, "1,234.5", "1,000"], [1.5, 1234.5, 1000.0]),
    "decimal commas": (["0,5", "1,25", 2], [0.5, 1.25, 2.0]),
    "a comma beside points": ([*HALVES, "0,5", *HALVES], [*HALVES, NAN, *HALVES]),
}


@pytest.mark.parametrize("name", EXCEL_TEXTS)
def test_text_in_a_workbook_follows_the_grammar_of_numbers(name, tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    cells, expected = EXCEL_TEXTS[name]
    book = openpyxl.Workbook()
    for row in (["t", "p"], *enumerate(cells)):
        book.active.append(row)
    book.save(tmp_path / "a.xlsx")
    column = open_source(tmp_path / "a.xlsx").tables[0].columns[1]
    if isinstance(expected, int):
        assert column.doubt[0] == expected
    else:
        assert column.doubt is None
        np.testing.assert_array_equal(column.values, expected)


@pytest.mark.parametrize("name", WRITERS)
def test_every_encoding_of_a_format_is_read_back_or_refused_by_name(name, tmp_path):
    expected = WRITERS[name](tmp_path / name)
    source = open_source(tmp_path / name)
    columns = {column.name: column.values for table in source.tables for column in table.columns}
    for channel, numbers in expected.items():
        if numbers is None:
            assert channel not in columns
            assert any(channel in str(loss) for loss in source.losses), channel
        else:
            np.testing.assert_allclose(columns[channel], numbers, rtol=1e-6, err_msg=channel)
    assert set(columns) <= set(expected)


@pytest.mark.parametrize(
    ("text", "result"),
    [
        ("25*(X1-0.4)", 40.0),
        ("-X1^2", -4.0),
        ("2**3**2 * X / 512", 2.0),
        ("POW(X, 3) + sqrt(X1 + 2)", 10.0),
        ("abs(-X) + log10(100) + exp(0)", 5.0),
        ("1.5e2", 150.0),
        ("X/(X-2)", NAN),
    ],
)
def test_a_formula_is_worked_out(text, result):
    np.testing.assert_allclose(evaluate(text, np.array([2, 2])), [result, result])


@pytest.mark.parametrize(
    "text",
    [
        *("", "log(X)", "if(X > 2, 1, 0)", "X(1)", "sin(X, X)", "lambda: X", "X if X else X"),
        *("X; X", "X, X", "X > 2"),
        *"Y X.real X[0] sin 'X' 1_0*X 0x1*X 25,5*X X1*( True*X 1j*X X=1 sin(*X) exp(x=X)".split(),
        *("__import__('os')", "X" * 9, "X+" * 300 + "X", "(" * 150 + "X"),
        *("X\n*2", "X\uff11", "9" * 400),
    ],
)
def test_what_is_no_formula_is_refused(text):
    with pytest.raises(LogError) as error:
        evaluate(text, np.array([2.0, 3.0]))
    word = {"log(X)": "log", "if(X > 2, 1, 0)": "condition"}.get(text, "not_understood")
    assert error.value.key == f"data.formula_{word}"
