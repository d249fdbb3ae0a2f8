"""Logs, flow maps and runs as one interactive HTML page that needs no network: zoom, values under
the cursor, curves that can be hidden, two of a kind over one another.

The curves are drawn by uPlot (``uplot/``, MIT), which travels inside the page."""

import base64
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data import read
from ehbench.data.readers import suffixes
from ehbench.data.record import noted_losses
from ehbench.physics.flow_map import FlowMap, load_flow_maps
from ehbench.report.blocks import digest
from ehbench.report.provenance import unsupported
from ehbench.report.saved import Saved, read_points, read_series
from ehbench.report.words import capital, number, pretty, shown, title_of, unit_of, words
from ehbench.vocabulary import InputError, from_si, message, quantity

MOST = 4_000_000  # numbers in a page; with more, curves are thinned to their extremes
MARK = '<meta name="generator" content="ehbench show">'


@dataclass(frozen=True)
class Curve:
    """A curve: name, unit, source (0 or 1), points, quantity; ``dots``: not joined."""

    name: str
    unit: str
    x: np.ndarray
    y: np.ndarray
    of: int = 0
    dots: bool = False
    what: str = ""


@dataclass(frozen=True)
class Sheet:
    """Curves over one axis, in panels by unit; ``still`` lists channels that never change."""

    title: str
    across: str
    curves: tuple[Curve, ...]
    still: tuple[str, ...] = field(default=())

    def as_json(self, sheets: int) -> dict[str, Any]:
        """As a page of so many sheets reads it: panels by unit, arrays as base64 of little-endian
        numbers."""
        maximum = max(MOST // (sheets * len(self.curves)), 2000)
        panels: dict[str, list[dict[str, Any]]] = {}
        axes: dict[tuple[int, int, int], int] = {}
        xs: list[str] = []
        for curve in self.curves:
            x, y = extremes(curve.x, curve.y, maximum)
            key = (id(curve.x), x.size, curve.of)
            if key not in axes:
                axes[key] = len(xs)
                xs.append(_packed(x, "<f8"))
            shape = {"name": curve.name, "of": curve.of, "x": axes[key], "dots": curve.dots}
            panels.setdefault(curve.unit, []).append(shape | {"y": _packed(y, "<f4")})
        titled = []
        for unit, curves in panels.items():
            # what a panel shows, with its unit: ``Head-end pressure, rod-end pressure [kPa]``
            whats = [curve.what for curve in self.curves if curve.unit == unit and curve.what]
            named = [what.lower() for what in dict.fromkeys(whats)]
            label = capital(", ".join(named[:3]) + ", …" * (len(named) > 3))
            title = f"{label} [{unit}]" if unit else label
            titled.append({"title": title, "curves": curves})
        about = {"title": self.title, "across": self.across}
        return about | {"still": list(dict.fromkeys(self.still)), "xs": xs, "panels": titled}


def unsupported_runs(sources: Sequence[Path]) -> list[str]:
    """What no longer supports the run folders among some sources."""
    runs = [source for source in sources if (source / "run.json").is_file()]
    return list(dict.fromkeys(change for run in runs for change in unsupported(run)))


def page(
    sources: Sequence[Path],
    columns: Path | None = None,
    changes: Sequence[str] = (),
    losses: dict[str, Sequence[str]] | None = None,
) -> str:
    """The page of one or two logs, maps or runs; sheets of one name lie over one another. A map of
    ``columns`` is that of logs by others, ``changes`` are those of `unsupported_runs`; notes on
    what a log lost are added to ``losses``, by its name.

    Raises:
        InputError: a file that is no log, map or run; nothing in it that can be drawn."""
    names = [Path(source).resolve().name for source in sources]
    if len(set(names)) < len(names):
        names = ["/".join(Path(source).resolve().parts[-2:]) for source in sources]
    results: dict[tuple[str, str], Sheet] = {}
    losses = {} if losses is None else losses
    for of, source in enumerate(map(Path, sources)):
        if not source.exists():
            raise InputError(message("report.no_file"), file=source)
        if source.is_dir() and not (source / "metadata.yaml").is_file():
            sheets = _run_sheets(source, of)
        elif source.suffix == ".json":
            sheets = (_map(item, None, of) for item in load_flow_maps(source).each())
        elif source.is_dir() or source.name.lower().removesuffix(".gz").endswith(suffixes()):
            record = read(source, check=False, columns=columns)
            losses[names[of]] = record.losses
            sheets = iter([_over_time("", record.t, record.channels, None, of)])
        else:
            raise InputError(message("report.cannot_show", kind=source.suffix), file=source)
        for sheet in sheets:
            title = sheet.title or ("" if len(sources) > 1 else names[0])
            known = results.get((title, sheet.across), Sheet(title, sheet.across, ()))
            still, curves = (*known.still, *sheet.still), (*known.curves, *sheet.curves)
            results[title, sheet.across] = Sheet(title, sheet.across, curves, still)
    drawn = [sheet for sheet in results.values() if sheet.curves]
    if not drawn:
        raise InputError(message("report.nothing_changes"), file=sources[0])
    changes = [message("report.unsupported", change=change) for change in changes]
    notes = [note for name, every in losses.items() for note in noted_losses(name, every)[0]]
    return _render(names, [sheet.as_json(len(drawn)) for sheet in drawn], [*changes, *notes])


def _run_sheets(folder: Path, of: int) -> Iterator[Sheet]:
    """The logs, comparisons and maps of a run folder."""
    run = Saved(folder)
    rig = run.rig if run.has_rig else None
    if run.what == "flow_map":
        points = folder / "points.csv"
        for item in load_flow_maps(folder).each():
            yield _map(item, rig, of, points if points.is_file() else None)
    for path in [*sorted(folder.glob("*.mcap")), *sorted((folder / "logs").glob("*.mcap"))]:
        record = read(path, check=False)
        yield _over_time(words(path.stem), record.t, record.channels, rig, of)
    for path in sorted((folder / "series").glob("*.csv")):
        series = read_series(path)
        channels = {f"{name} recorded": values for name, values in series.recorded.items()}
        channels |= {f"{name} simulated": values for name, values in series.simulated.items()}
        yield _over_time(words(path.stem), series.t, channels, rig, of)


def _over_time(
    title: str, t: np.ndarray, channels: Mapping[str, np.ndarray], rig: Rig | None, of: int
) -> Sheet:
    curves: list[Curve] = []
    still: list[str] = []
    for label, values in channels.items():
        name = label.split(" ")[0]
        unit = unit_of(rig, name)
        y = np.asarray(from_si(values, unit, quantity(name)), float)
        known = y[np.isfinite(y)]
        if known.size and np.ptp(known) > 0.0:
            curves.append(Curve(label, pretty(unit), t, y, of, what=title_of(name)))
        elif known.size:
            still.append(f"{label} = {number(float(known[0]))} {pretty(unit)}".rstrip())
    return Sheet(title, "time [s]", tuple(curves), tuple(still))


def _map(item: FlowMap, rig: Rig | None, of: int, readings: Path | None = None) -> Sheet:
    """Flow over pressure drop, a curve a measured command, and the readings."""
    flow, drops = (pretty(unit_of(rig, name)) for name in ("flow", "pressure_drop"))
    drop = np.linspace(0.0, 1.0, 121) ** 2 * max(item.drop_max, float(item.hull_high.max()))
    curves = []
    for u in item.hull_command[item.hull_command > item.deadband]:
        x, y = shown(rig, "pressure_drop", drop), shown(rig, "flow", np.asarray(item.flow(drop, u)))
        curves.append(Curve(f"{number(u, 3)} V", flow, x, y, of, what="flow"))
    if readings is not None:
        points = read_points(readings)
        points = points[(points.valve == item.valve) & (points.direction == item.direction)]
        order = np.argsort(points.pressure_drop)
        x = shown(rig, "pressure_drop", points.pressure_drop[order])
        y = shown(rig, "flow", points.flow[order])
        curves.append(Curve("readings", flow, x, y, of, dots=True, what="flow"))
    title, across = f"{item.valve}, {item.direction}", f"pressure drop [{drops}]"
    return Sheet(title, across, tuple(curves))


def _packed(values: np.ndarray, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, kind).tobytes()).decode("ascii")


def extremes(x: np.ndarray, y: np.ndarray, maximum: int) -> tuple[np.ndarray, np.ndarray]:
    """At most ``maximum`` points that keep every extreme: the first and the second half of each
    stretch stand for its least and largest sample, in the order in which these come."""
    if x.size <= maximum:
        return x, y
    size = -(-2 * x.size // maximum)
    count = x.size // size
    blocks = np.where(np.isfinite(y), y, np.nan)[: count * size].reshape(count, size)
    empty = np.isnan(blocks).all(axis=1)
    filled = np.where(np.expand_dims(empty, 1), 0.0, blocks)
    low, high = np.nanargmin(filled, axis=1), np.nanargmax(filled, axis=1)
    rows = np.arange(count)
    pair = np.stack([filled[rows, np.minimum(low, high)], filled[rows, np.maximum(low, high)]], 1)
    pair[empty] = np.nan
    starts = x[: count * size].reshape(count, size)
    retained = np.stack([starts[:, 0], starts[:, size // 2]], 1).ravel()
    return np.append(retained, x[count * size :]), np.append(pair.ravel(), y[count * size :])


def _render(names: Sequence[str], sheets: Sequence[Mapping[str, Any]], notes: Sequence[str]) -> str:
    from jinja2 import Environment, StrictUndefined

    files = resources.files("ehbench.report") / "viewer"

    def text(name: str) -> str:
        return (files / name).read_text(encoding="utf-8").strip()

    scripts = [text("uplot/uPlot.iife.min.js"), text("show.js")]
    data = json.dumps({"names": list(names), "sheets": list(sheets)}, separators=(",", ":"))
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    return environment.from_string(text("show.html")).render(
        title=" and ".join(names),
        names=names,
        notes=notes,
        mark=MARK,
        allowed=" ".join(f"'sha256-{digest(script)}'" for script in scripts),
        style=text("uplot/uPlot.min.css") + "\n" + text("show.css"),
        data=data.replace("<", "\\u003c"),
        scripts=scripts,
        licence=text("uplot/LICENSE"),
    )


def place(sources: Sequence[Path], out: Path | None) -> Path:
    """Where the page goes: ``out``, or ``<name>.html`` in the current folder.

    Raises:
        InputError: something stands there that is no page of this command."""
    path = out or Path("_and_".join(Path(source).resolve().stem for source in sources) + ".html")
    if path.is_dir():
        raise InputError(message("report.out_is_folder"), file=path)
    if path.exists() and MARK not in path.read_text(encoding="utf-8", errors="replace")[:2000]:
        raise InputError(message("report.not_our_page"), file=path)
    return path
