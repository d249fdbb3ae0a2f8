"""Figures of a run folder, drawn from its saved files: ``figures/*.svg``, and
``figures/index.json`` that says what they are.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

from ehbench.report import map_figures, series_figures, trial_figures, tuning_figures
from ehbench.report.saved import INDEX, Points, Saved, read_points
from ehbench.report.words import words
from ehbench.rundir import write_json

_TWINS = {"x": "q", "v": "qd"}


@dataclass(frozen=True)
class Figure:
    """A figure in a run's index. ``key`` is what a campaign names it by; ``about`` says what it
    shows, for the page.
    """

    file: str
    key: str
    title: str
    caption: str = ""
    about: dict[str, str] = field(default_factory=dict)


class Album:
    """The figures of a run as they are drawn: hands out file names that do not collide."""

    def __init__(self, run: Saved) -> None:
        self.run, self.figures = run, []

    def add(self, key: str, title: str, caption: str = "", **about: str) -> Path:
        """The path to draw the figure ``key`` to."""
        stem = re.sub(r"[^A-Za-z0-9_.-]+", "_", key)
        taken = {figure.file for figure in self.figures}
        file = next(
            name
            for i in range(len(taken) + 1)
            if (name := f"{stem}{f'_{i + 1}' if i else ''}.svg") not in taken
        )
        self.figures.append(Figure(file, key, title, caption, about))
        return self.run.folder / "figures" / file


def draw(folder: Path) -> None:
    """Draw a run folder's figures; which ones, its ``run.json`` says. A stage without figures
    leaves an empty index.

    Raises:
        InputError: a saved file is missing or lacks what its figure needs.
    """
    run = Saved(folder)
    album = Album(run)
    (run.folder / "figures").mkdir(exist_ok=True)
    drawer = _DRAWERS.get((run.stage, run.what)) or _DRAWERS.get((run.stage, ""))
    if drawer is not None:
        drawer(run, album)
    write_json(
        run.folder / "figures" / INDEX, {"figures": [asdict(figure) for figure in album.figures]}
    )


def _flow_map(run: Saved, album: Album) -> None:
    from ehbench.physics.flow_map import load_flow_maps

    maps, points = load_flow_maps(run.folder), read_points(run.folder / "points.csv")
    for one in maps.each():
        about = {"valve": one.valve, "direction": one.direction}
        who = f"{one.valve}, {one.direction}"
        mine: Points = points.of(one.valve, one.direction)
        caption = (
            "Flow over pressure drop, one curve a command; below, readings minus curves. Bands are 95 % intervals of the curves; "
            "dashed and pale where no readings surround the curve."
        )
        map_figures.flow_map(
            album.add(
                f"flow_map_{one.valve}_{one.direction}",
                f"Flow map of {who}",
                caption,
                kind="flow_map",
                **about,
            ),
            run.rig,
            one,
            mine,
        )
    for one in maps.each():
        about = {"valve": one.valve, "direction": one.direction}
        caption = "Command that passes a flow, one curve a pressure drop; the exact inverse of the flow map, with its 95 % band."
        path = album.add(
            f"inverse_map_{one.valve}_{one.direction}",
            f"Inverse map of {one.valve}, {one.direction}",
            caption,
            kind="inverse_map",
            **about,
        )
        map_figures.inverse_map(path, run.rig, one)


def _hydraulics(run: Saved, album: Album) -> None:
    fit = run.json("parameters.json")
    parameters = [one for one in fit["parameters"] if one.number("value") is not None]
    if parameters:
        caption = "Dot and bar: value and 95 % interval. Grey: the bounds of the search. Hollow: where the search started."
        series_figures.parameters(
            album.add("parameters", "Parameters within their bounds", caption, kind="parameters"),
            run.rig,
            parameters,
        )
    for log in fit["logs"]:
        _comparison(run, album, log["name"], "fit", "Fitted to")


def _validation(run: Saved, album: Album) -> None:
    for log in run.json("validation.json")["logs"]:
        name = log["name"]
        _comparison(
            run,
            album,
            name,
            "validation",
            "Held out"
            if log.get("status", "held_out") == "held_out"
            else words(log["status"]).capitalize(),
        )
        by_cylinder: dict[str, list] = {}
        for channel in log["channels"]:
            if channel.get("autocorrelation") is not None:
                by_cylinder.setdefault(channel["channel"].rpartition(".")[0], []).append(channel)
        for cylinder, channels in by_cylinder.items():
            key = f"residuals_{name}_{cylinder}"
            caption = "Correlation of the residual with itself and with earlier commands. Shaded: 95 % band, which allows for colour."
            path = album.add(
                key,
                f"Residuals of {words(name)}, {cylinder}",
                caption,
                kind="residuals",
                log=name,
                cylinder=cylinder,
            )
            series_figures.correlations(path, channels)


def _comparison(run: Saved, album: Album, name: str, kind: str, lead: str) -> None:
    series = run.series(name)
    if series is None:
        return
    for cylinder, channels in series.cylinders().items():
        if kind == "fit":  # a joint's angle and its cylinder's stroke say the same
            channels = [
                c
                for c in channels
                if f"{cylinder}.{_TWINS.get(c.rpartition('.')[2])}" not in channels
            ]
        caption = (
            "Solid: recorded. Dashed: simulated. The narrow strips show simulated minus recorded."
        )
        if not any(channel in series.simulated for channel in channels):
            caption = "Recorded only: this log could not be simulated."
        title = f"{lead}: {words(name)}" + (f", {cylinder}" if cylinder else "")
        path = album.add(
            f"{kind}_{name}_{cylinder}", title, caption, kind=kind, log=name, cylinder=cylinder
        )
        series_figures.comparison(path, run.rig, series, channels)


def _trial(run: Saved, album: Album) -> None:
    from ehbench.logs import read_record

    if trial_figures.draw_trial(run, album):
        return
    record = read_record(run.folder / "log.mcap")
    for cylinder, channels in series_figures.live(run.rig, record).items():
        title = f"{run.title}: {cylinder}"
        path = album.add(
            f"trial_{cylinder}",
            title,
            "Commands, motion and pressures.",
            kind="trial",
            cylinder=cylinder,
        )
        series_figures.trial(path, run.rig, record, cylinder, channels)


_DRAWERS: dict[tuple[str, str], Callable[[Saved, Album], None]] = {
    ("identify", "flow_map"): _flow_map,
    ("identify", "hydraulics"): _hydraulics,
    ("validate", ""): _validation,
    ("tune", ""): tuning_figures.draw_tuning,
    ("trial", ""): _trial,
    ("trials", ""): trial_figures.draw_trials,
}
