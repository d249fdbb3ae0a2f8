"""Flow maps: maps, inverse maps, deadbands, calibration, readings left out."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.config.rig import Rig
from ehbench.physics.flow_map import FlowMap
from ehbench.report import content
from ehbench.report.blocks import Part
from ehbench.report.saved import FigureIndex, Saved, Table, read_points
from ehbench.report.style import (
    ACCENT,
    INK,
    MUTED,
    Look,
    canvas,
    key,
    legend,
    legend_right,
    shades,
    spread,
    swatch,
    tag,
)
from ehbench.report.template import Template
from ehbench.report.words import axis, measure, number, shown
from ehbench.vocabulary import Z95, message, plural


def draw(run: Saved, index: FigureIndex) -> None:
    """A figure for each flow map, then one for each inverse map."""
    from ehbench.physics.flow_map import load_flow_maps

    page, points = Template("flow_maps"), read_points(run.folder / "points.csv")

    def place(kind: str, title: str, caption: str, item: FlowMap) -> Path:
        about = {"valve": item.valve, "direction": item.direction}
        key = f"{kind}_{item.valve}_{item.direction}"
        title = f"{title} of {item.valve}, {item.direction}"
        return index.add(key, title, page.text(caption), kind, **about)

    maps = [*load_flow_maps(run.folder).each()]
    for item in maps:
        path = place("flow_map", "Flow map", "level" if item.level else "map", item)
        picture = draw_level_map if item.level else draw_map
        rows = (points.valve == item.valve) & (points.direction == item.direction)
        picture(path, run.rig, item, points[rows])
    for item in maps:
        if not item.level:
            draw_inverse(place("inverse_map", "Inverse map", "inverse", item), run.rig, item)


_METERS = {"flowmeter": ("o", "flowmeter"), "cylinder": ("D", "cylinder speed")}

Ends = dict[str, tuple[float, Any]]  # label of a curve → (where it ends, its colour)


def draw_map(path: Path, rig: Rig, item: FlowMap, points: np.recarray) -> None:
    """Flow over pressure drop by command: readings, outliers, bands; residuals below."""
    commands = item.hull_command[item.hull_command > item.deadband]
    colours = dict(zip(commands, shades(commands.size), strict=True))
    drop = np.linspace(0.0, 1.0, 161) ** 2 * max(item.drop_max, float(item.hull_high.max()))
    retained = points.flow.size and not points.outlier.all()
    ratios = [4.2, 1] if retained else [1]

    def colour_of(command: float) -> Any:
        """That of the nearest curve, grey where the valve is shut."""
        if not colours or command <= item.deadband:
            return MUTED
        return colours[min(colours, key=lambda known: abs(known - command))]

    look = {"sharex": True, "squeeze": False, "height_ratios": ratios}
    with canvas(path, len(ratios), 1, (7.2, 5.6), **look) as (figure, axes):
        main = axes[0, 0]
        ends, tops = _map_curves(main, rig, item, drop, colours)
        flows = shown(rig, "flow", points.flow[~points.outlier]).tolist()
        high = max([*(y for y, _ in ends.values()), *tops, *flows, 1e-12])
        low = min([0.0, *flows])
        limits = low - 0.025 * (high - low), high + 0.05 * (high - low)
        main.set_ylim(*limits)
        main.set_xlim(0.0, 1.01 * shown(rig, "pressure_drop", drop[-1]))
        handles = _readings(main, rig, points, colour_of)
        handles += _outliers(main, rig, points, limits)
        tall = limits[1] - limits[0]
        names = [y for y, _ in ends.values()]
        places = spread(names, 0.034 * tall, limits[0] - 0.007 * tall, limits[1] + 0.017 * tall)
        across = main.get_yaxis_transform()
        for (text, (y, colour)), place in zip(ends.items(), places, strict=True):
            leader: Look = {"color": colour, "linewidth": 0.7, "transform": across}
            main.plot([1.0, 1.018], [y, place], clip_on=False, **leader)
            look = {"transform": across, "va": "center", "fontsize": 7.5}
            main.text(1.023, place, text, color=INK, **look)
        main.set_ylabel(axis(rig, "flow"))
        beyond = any(not item.inside(drop[1:], command).all() for command in commands)
        handles += _band_handles(beyond)
        if retained:
            ax = axes[1, 0]
            used = ~points.outlier & np.isfinite(points.fitted)
            drop = shown(rig, "pressure_drop", points.pressure_drop)
            error = shown(rig, "flow", points.flow - points.fitted)
            for command in np.unique(points.command):
                rows = used & (points.command == command)
                if rows.any():
                    ax.plot(drop[rows], error[rows], ".", markersize=2.2, color=colour_of(command))
            ax.axhline(0.0, color=MUTED, linewidth=0.8)
            maximum = 1.08 * float(np.max(np.abs(error[used]), initial=1e-12))
            ax.set_ylim(-maximum, maximum)
            ax.set_ylabel(axis(rig, "flow", "residual\n").replace("\n ", "\n"), fontsize=8)
        axes[-1, 0].set_xlabel(axis(rig, "pressure_drop"))
        legend(figure, handles)


def draw_level_map(path: Path, rig: Rig, item: FlowMap, points: np.recarray) -> None:
    """Flow over command of a map without pressures, with readings, outliers and band."""
    command = np.unique(np.append(np.linspace(0.0, item.command_max, 241), item.deadband))
    flow = shown(rig, "flow", item.flow(item.drop_max, command))
    band = shown(rig, "flow", Z95 * item.flow_std(item.drop_max, command))
    used, read = ~points.outlier, shown(rig, "flow", points.flow)
    with canvas(path, size=(7.2, 4.2)) as (figure, ax):
        colour = shades(2)[0]
        ax.axvspan(*item.deadband_interval, color=MUTED, alpha=0.25, linewidth=0)
        ax.fill_between(command, flow - band, flow + band, color=colour, alpha=0.22, linewidth=0)
        ax.plot(command, flow, color=colour, linewidth=1.4)
        ax.plot(points.command[used], read[used], "D", color=colour, markersize=2.6, alpha=0.7)
        ax.plot(points.command[~used], read[~used], "x", color=ACCENT, markersize=6)
        ax.set_xlim(0.0, 1.01 * item.command_max)
        ax.set_xlabel("command [V]")
        ax.set_ylabel(axis(rig, "flow"))
        legend(figure, [swatch("95 % band", colour, alpha=0.3, linewidth=0)])


def _map_curves(
    ax, rig: Rig, item: FlowMap, drop: np.ndarray, colours: dict
) -> tuple[Ends, list[float]]:
    """Draw a curve and band a command; (where they end, tops of the bands)."""
    ends: Ends = {}
    tops: list[float] = []
    x = shown(rig, "pressure_drop", drop)
    for command, colour in colours.items():
        inside = item.inside(drop, command)
        y = shown(rig, "flow", item.flow(drop, command))
        band = shown(rig, "flow", Z95 * item.flow_std(drop, command))
        ax.fill_between(x, y - band, y + band, where=inside, color=colour, alpha=0.22, linewidth=0)
        tops.append(float(np.max(np.where(inside, y + band, y))))
        _in_and_out(ax, x, y, inside, colour)
        ends[f"{number(command, 3)} V"] = (float(y[-1]), colour)
    ax.axhline(0.0, color=MUTED, linewidth=0.8)
    shut = item.hull_command[item.hull_command <= item.deadband]
    if shut.size:
        maximum = f"{number(shut[-1], 3)} V"
        ends[(f"≤ {maximum}" if shut.size > 1 else maximum) + ", shut"] = (0.0, MUTED)
    return ends, tops


def _band_handles(beyond: bool) -> list:
    """Legend handles of bands, and of curves beyond the readings."""
    look: Look = {"color": MUTED, "alpha": 0.6, "linestyle": (0, (3, 2)), "linewidth": 1.1}
    band = swatch("95 % band", MUTED, alpha=0.3, linewidth=0)
    return [band, key("beyond the readings", **look)] if beyond else [band]


def draw_inverse(path: Path, rig: Rig, item: FlowMap) -> None:
    """Command over flow at several pressure drops: the curves a controller looks up."""
    passing = item.hull_command > item.deadband
    low = float(np.median(item.hull_low[passing])) if passing.any() else item.drop_max / 50
    high = float(np.quantile(item.hull_high[passing], 0.1)) if passing.any() else item.drop_max
    low = min(max(low, high / 50), high / 2)
    per = item.drop_max / shown(rig, "pressure_drop", item.drop_max)
    even = np.geomspace(low / per, high / per, 6)
    step = 10.0 ** (np.floor(np.log10(even)) - 1.0)
    drops = [float(drop) * per for drop in dict.fromkeys(np.floor(even / step + 1e-9) * step)]
    span = np.linspace(item.deadband, item.command_max, 121)
    with canvas(path, size=(7.2, 4.2)) as (figure, ax):
        beyond = False
        for i, (drop, colour) in enumerate(zip(drops, shades(len(drops)), strict=True)):
            inside = item.inside(drop, span)
            x = shown(rig, "flow", item.flow(drop, span))
            band = shown(rig, "flow", Z95 * item.flow_std(drop, span))
            look: Look = {"where": inside, "color": colour, "alpha": 0.2, "linewidth": 0}
            ax.fill_betweenx(span, x - band, x + band, **look)
            mark = ("-", (0, (6, 1, 1, 1)))[i % 2]
            _in_and_out(ax, x, span, inside, colour, mark)
            beyond |= not inside.all()
            label = measure(rig, "pressure_drop", drop)
            ax.plot([], [], label=label, color=colour, linestyle=mark)
        ax.axhspan(*item.deadband_interval, color=MUTED, alpha=0.25, linewidth=0)
        ax.axhline(item.deadband, color=MUTED, linewidth=0.9, linestyle=(0, (4, 3)))
        text, look = f"deadband {number(item.deadband, 3)} V", {"ha": "right", "va": "bottom"}
        tag(ax, text, 1.0, item.deadband, (0, 2), "x", color=MUTED, **look)
        low = 0.94 * min(item.deadband_interval[0], item.deadband)
        ax.set_ylim(low, item.command_max + 0.02 * (item.command_max - low))
        ax.set_xlim(left=0.0)
        ax.set_xlabel(axis(rig, "flow"))
        ax.set_ylabel("command [V]")
        legend(figure, _band_handles(beyond), handlelength=2.6)
        look = {"title": "pressure drop", "title_fontsize": 8, "alignment": "left"}
        legend_right(ax, handlelength=2.6, **look)


def _in_and_out(
    ax, x: np.ndarray, y: np.ndarray, inside: np.ndarray, colour, mark: Any = "-"
) -> None:
    """A curve, solid where readings surround it, dashed and pale elsewhere; the two touch."""
    grown = inside | np.append(inside[1:], False) | np.insert(inside[:-1], 0, False)
    # an empty line counts as a point at the figure's corner and would upset the layout
    if not grown.all():
        look: Look = {"color": colour, "alpha": 0.45, "linewidth": 1.1, "linestyle": (0, (3, 2))}
        ax.plot(x, np.where(grown, np.nan, y), **look)
    if inside.any():
        ax.plot(x, np.where(inside, y, np.nan), color=colour, linewidth=1.4, linestyle=mark)


def _readings(ax, rig: Rig, points: np.recarray, colour: Callable) -> list:
    """Readings by method in the colour of their curve; legend handles."""
    x, y = shown(rig, "pressure_drop", points.pressure_drop), shown(rig, "flow", points.flow)
    handles = []
    for method in dict.fromkeys(points.method.tolist()):
        marker, text = _METERS.get(method, ("s", method))
        look: Look = {"marker": marker, "linestyle": "", "markerfacecolor": "none"}
        for command in np.unique(points.command):
            rows = (points.method == method) & (points.command == command) & ~points.outlier
            if rows.any():
                edge = {"markersize": 2.6, "markeredgewidth": 0.6, "alpha": 0.8}
                ax.plot(x[rows], y[rows], color=colour(command), **look, **edge)
        handles.append(key(text, markersize=4, color=MUTED, **look))
    return handles


def _outliers(ax, rig: Rig, points: np.recarray, limits: tuple[float, float]) -> list:
    """Readings left out, crossed; at the edge where they lie outside; legend handles."""
    out = points.outlier
    if not out.any():
        return []
    x = shown(rig, "pressure_drop", points.pressure_drop)[out]
    y = shown(rig, "flow", points.flow)[out]
    seen = np.clip(y, *limits)
    gone = seen != y
    look: Look = {"color": ACCENT, "markersize": 6, "markeredgewidth": 1.6}
    for marker, rows in (("x", ~gone), ("^", y > limits[1]), ("v", y < limits[0])):
        if rows.any():
            ax.plot(x[rows], seen[rows], marker, zorder=5, clip_on=marker == "x", **look)
    handles = [key(f"left out ({out.sum()})", marker="x", linestyle="", **look)]
    if gone.any():
        moved: Look = {"marker": "^", "linestyle": "", "markersize": 5, "color": ACCENT}
        handles.append(key("left out, off the scale", **moved))
    return handles


def section(run: Saved, pictures: content.Pictures) -> content.SectionContent:
    """Maps, inverse maps, deadbands, calibration, readings left out."""
    maps, page = run.rows("summary.json"), Template("flow_maps", run.rig)
    calibration = [(item, point) for item in maps for point in item["calibration"]]
    left_out = [(item, reading) for item in maps for reading in item["outliers"]]
    ways: list[tuple[Table, str, Any]] = []  # what a valve does besides opening smoothly
    for item in maps:
        if item.get("leakage_interval", (0.0, 0.0))[0] > 0.0:
            ways.append((item, "leak", [item["leakage"], *item["leakage_interval"]]))
        if item.get("hysteresis") is not None:
            ways.append((item, "hysteresis", [item["hysteresis"], *item["hysteresis_interval"]]))
        if item.get("shift"):
            ways.append((item, "shift", [item["shift"], *item["shift_interval"]]))
        ways += [(item, "kink", kink) for kink in item.get("kinks", ())]
        ways += [(item, "falls", [falls]) for falls in [item.get("falls")] if falls]
    tables = {
        "Deadbands": page.table("deadbands", maps),
        "Beyond the opening": page.table("ways", ways),
        "Calibration": page.table("calibration", calibration),
        "Readings left out": page.table("outliers", left_out),
    }
    parts = [
        Part("Flow maps", pictures(kind="flow_map")),
        Part("Inverse maps", pictures(kind="inverse_map")),
        *(Part(title, [table]) for title, table in tables.items() if table.rows),
    ]
    sentence = page.text(
        "sentence",
        maps=maps,
        valves={item["valve"] for item in maps},
        readings=sum(item["readings"] for item in maps) + len(left_out),
        left_out=len(left_out),
        verdicts=[point["verdict"] for _, point in calibration],
    )
    return content.SectionContent("done", sentence, parts)


def findings(run: Saved) -> content.Findings:
    maps, page = run.rows("summary.json"), Template("headlines", run.rig)
    value, about = page.text("deadbands", maps=maps), plural(len(maps), "flow map")
    missing = [
        page.text("calibration", item=item, point=point)
        for item in maps
        for point in item["calibration"]
        if point["verdict"] != "met"
    ]
    against = list(dict.fromkeys(missing))
    steps = [message("steps.calibrate", **content.names(run))] if against else []
    numbers = [content.Headline(content.OFTEN, "Deadbands", value, about)]
    return content.Findings(numbers, [{"kind": "flow_map"}], against, steps)
