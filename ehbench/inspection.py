"""Look at one file and say what it holds and whether it will do, without running anything.

A recipe is looked at through the very functions that its run begins with, on a desk at which runs
are found and never made."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterator, Sized
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ehbench import rundir, workflow
from ehbench.errors import EhbenchError, InputError, InsufficientData, LogError
from ehbench.quantities import quantity
from ehbench.recipe import (
    BenchRecipe,
    Campaign,
    DatasetRecipe,
    FlowMapRecipe,
    HydraulicsRecipe,
    Recipe,
    TrialRecipe,
    TrialSetRecipe,
    TuneRecipe,
    ValidateRecipe,
    kind_of,
    load_recipe,
    load_rig,
)
from ehbench.rig import NODES, Edge, Rig, Value, Valve
from ehbench.units import from_si

STUDIED = 0.1  # share of a tuning done when its operating points are there and the search for gains begins
STANDS = "which stands"
_WRITES = {
    FlowMapRecipe: "flow_maps.json, flow_maps.csv, summary.json, points.csv, rig.toml, figures",
    HydraulicsRecipe: "rig.toml, parameters.json, a series for each log, figures",
    ValidateRecipe: "validation.json, rig.toml, a series for each log, figures",
    TuneRecipe: "tuning.json, rig.toml, figures",
    TrialRecipe: "log.mcap, trial.json, ledger.json, rig.toml, figures",
    TrialSetRecipe: "a log and a ledger for each trial, table.json, table.csv, rig.toml, figures",
    Campaign: "one report.html over all runs, each of which has a folder of its own",
}


@dataclass(frozen=True)
class Inspection:
    """What was found: lines to read, mistakes, and the exit code: that of the first mistake, else 3
    with data loss, else 0.
    """

    lines: tuple[str, ...]
    code: int = 0
    errors: tuple[EhbenchError, ...] = ()


def check(path: Path) -> Inspection:
    """Inspect a rig or recipe (TOML), a flowmeter CSV, or a log (MCAP or CSV).

    Raises:
        InputError: the file cannot be taken for what it is; says what, where and what would be
            right. Mistakes in what a recipe asks for are collected in ``errors``.
    """
    if not path.exists():
        raise InputError("no such file", file=path)
    if path.suffix == ".toml":
        return _rig(path) if kind_of(path) == "rig" else _recipe(path)
    if path.suffix == ".csv" and _is_flowmeter(path):
        return _flowmeter(path)
    if path.suffix in (".csv", ".mcap"):
        return _log(path)
    kind = path.suffix or path.name
    raise InputError(
        f"ehbench does not know '{kind}' files", file=path, hint="it reads .toml, .csv and .mcap"
    )


# --- recipes
# --------------------------------------------------------------------------------------------------------------


class _NotRun(Exception):
    """A recipe has no run with its present inputs; ``recipe`` is its file and ``folder`` where the
    run would go.
    """

    def __init__(self, recipe: Path, folder: Path) -> None:
        self.recipe, self.folder = recipe, folder


class _Circle(InputError):
    """A recipe needs itself (exit 2)."""


class _Begun(Exception):
    """A stage has taken in its inputs and begins to work."""


@dataclass(frozen=True)
class _Looking(workflow.Desk):
    """A desk at which a run that stands is found, and none is made."""

    def place(self, recipe: Recipe, inputs: Any) -> Path:
        folder = super().place(recipe, inputs)
        if not rundir.is_whole(folder):
            raise _NotRun(recipe.path, folder)
        return folder


@dataclass
class _Found:
    """What is to be said of one recipe."""

    recipe: Recipe
    does: str = ""
    reads: list[str] = field(default_factory=list)
    first: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    open: list[str] = field(default_factory=list)
    losses: list[str] = field(default_factory=list)
    errors: list[EhbenchError] = field(default_factory=list)
    writes: str = ""

    def say(self, kind: str, text: str) -> None:
        """Add a sentence once."""
        lines = getattr(self, kind)
        if text not in lines:
            lines.append(text)

    @contextmanager
    def noting(self) -> Iterator[None]:
        """Mistakes found inside are kept, once each; those that do not say where are placed in this
        recipe.
        """
        try:
            yield
        except EhbenchError as error:
            if error.file is None or (error.line is None and error.file == str(self.recipe.path)):
                line = _line_naming(self.recipe.path, error.message)
                error = type(error)(
                    error.message, file=self.recipe.path, line=line, hint=error.hint
                )
            if str(error) not in map(str, self.errors):
                self.errors.append(error)


def _recipe(path: Path) -> Inspection:
    desk = _Look(_Looking(keep=True, allow_code=True))
    found = desk.at(load_recipe(path))
    recipe = found.recipe
    what = (
        f"{recipe.stage} {recipe.what.replace('_', ' ')}"
        if hasattr(recipe, "what")
        else recipe.stage
    )
    lines = [f"recipe '{recipe.name}': {what}" + (f", '{recipe.title}'" if recipe.title else "")]
    lines += [f"  it {found.does}"] if found.does else []
    for word, texts in (
        ("runs" if isinstance(recipe, Campaign) else "reads", found.reads),
        ("runs first", [", ".join(found.first)]),
        ("writes", [found.writes]),
        ("note", [*found.losses, *found.notes]),
        ("not checked", found.open),
    ):
        lines += [f"  {word}: {text}" for text in texts if text]
    if found.errors:
        return Inspection(
            (*lines, _count(found.errors, "mistake")),
            found.errors[0].exit_code,
            tuple(found.errors),
        )
    return Inspection((*lines, "ok"), 3 if found.losses else 0)


class _Look:
    """A walk over a recipe and all recipes behind it, each looked at once."""

    def __init__(self, desk: _Looking) -> None:
        self.desk = desk  # its `done` are the runs that stand
        self.found: dict[Path, _Found] = {}
        self.walk: list[Path] = []
        self.unvalidated: set[Path] = set()

    def at(self, recipe: Recipe) -> _Found:
        """What is to be said of a recipe.

        Raises:
            InputError: it needs itself.
        """
        path = recipe.path
        if path in self.walk:
            circle = " → ".join(one.name for one in [*self.walk[self.walk.index(path) :], path])
            raise _Circle(
                f"needs itself: {circle}",
                file=path,
                hint="name a rig file or a run folder where the circle shall end",
            )
        if path in self.found:
            return self.found[path]
        found = self.found[path] = _Found(recipe)
        self.walk.append(path)
        for kind, look in (
            (FlowMapRecipe, self._flow_maps),
            (HydraulicsRecipe, self._hydraulics),
            (ValidateRecipe, self._validation),
            (TuneRecipe, self._tuning),
            (TrialRecipe, self._trial),
            (TrialSetRecipe, self._trial),
            (Campaign, self._campaign),
            (BenchRecipe, self._bench),
            (DatasetRecipe, self._dataset),
        ):
            if isinstance(recipe, kind):
                with found.noting():
                    look(recipe, found)
                if kind in _WRITES:
                    found.writes = f"{self._place(found)}: {_WRITES[kind]}"
        self.walk.pop()
        return found

    def _place(self, found: _Found) -> str:
        """The run folder of a recipe, as far as its name is known; a run that stands there is kept
        in the desk's ``done``.
        """
        recipe = found.recipe
        if not (
            found.first
            or found.errors
            or recipe.path in self.unvalidated
            or isinstance(recipe, Campaign)
        ):
            try:
                with found.noting():
                    self.desk.done[recipe.path] = workflow.run(recipe.path, self.desk)
                    return f"{self.desk.done[recipe.path].folder}, {STANDS}"
            except _NotRun as none:
                return str(none.folder)
        return f"{self.desk.root / recipe.name}_<hash>"

    def has_run(self, path: Path, found: _Found) -> bool:
        """Whether a recipe that another one names has its run; if not, that and its mistakes are
        noted.
        """
        behind = self.at(load_recipe(path))
        if path in self.desk.done:
            return True
        for error in behind.errors:
            if isinstance(error, _Circle):
                raise error
            with found.noting():
                raise error
        found.losses += [text for text in behind.losses if text not in found.losses]
        for name in behind.first:
            found.say("first", _shown_path(found.recipe, behind.recipe.file(name)))
        found.say("first", _shown_path(found.recipe, path))
        if path in self.unvalidated:
            found.say(
                "notes",
                f"'{_shown_path(found.recipe, path)}' is refused as it stands: its rig is not validated",
            )
        return False

    def source(
        self, recipe: Recipe, rig: str, maps: str | None, found: _Found
    ) -> tuple[str, str | None]:
        """(rig, flow maps) that a recipe has now: as it names them, or those at the root of a chain
        that has not been run.
        """
        place = recipe.file(rig)
        if place.is_file() and kind_of(place) == "recipe" and not self.has_run(place, found):
            behind = load_recipe(place)
            if not hasattr(behind, "rig") or isinstance(behind, BenchRecipe):
                hint = "name a rig file, or a recipe that has one"
                raise InputError(
                    f"names '{rig}', which leaves no rig behind", **recipe.at("rig"), hint=hint
                )
            inner = _Found(behind)
            root, inherited = self.source(
                behind, behind.rig, getattr(behind, "flow_maps", None), inner
            )
            found.open += [text for text in inner.open if text not in found.open]
            if isinstance(behind, FlowMapRecipe):
                found.say("open", f"what hangs on the flow maps: '{rig}' has not been run")
            found.say(
                "notes",
                f"'{rig}' has not been run: checked against {_shown_path(recipe, behind.file(root))}",
            )
            rig, maps = str(behind.file(root)), maps or (inherited and str(behind.file(inherited)))
        flow = None if maps is None else recipe.file(maps)
        if (
            flow is not None
            and flow.is_file()
            and flow.suffix == ".toml"
            and not self.has_run(flow, found)
        ):
            found.say(
                "open",
                f"what hangs on the flow maps: '{_shown_path(recipe, flow)}' has not been run",
            )
            maps = None
        return rig, maps

    def machine(self, recipe: Recipe, found: _Found) -> tuple[workflow.Machine, bool]:
        """(the machine that a recipe works on, whether measured edges without their maps had to be
        stood in for).
        """
        rig, maps = self.source(recipe, recipe.rig, getattr(recipe, "flow_maps", None), found)
        machine = workflow.machine_of(recipe, rig, maps, self.desk)
        found.say(
            "reads",
            f"{_shown_path(recipe, machine.origin)} (rig '{machine.rig.name}', {machine.stage})",
        )
        if maps is not None:
            found.say(
                "reads", f"{_shown_path(recipe, dict(machine.inputs)['flow_maps'])} (flow maps)"
            )
        whole, blind = _with_laws(machine.rig, machine.flow_maps)
        if blind:
            found.say("open", f"what hangs on the flow maps of {', '.join(blind)}: none is given")
        return replace(machine, rig=whole), bool(blind)

    def logs(self, recipe: Any, found: _Found) -> list[tuple[str, Any]]:
        """Name and record of each log that is there."""
        import numpy as np

        there = []
        for item in recipe.data:
            path = recipe.file(item.path)
            if path.is_file() and path.suffix == ".toml" and not self.has_run(path, found):
                found.say("open", f"the log of '{item.path}': it has not been run")
            else:
                there.append(item)
        logs, _, losses = workflow.logs_of(recipe, there, self.desk)
        found.losses += [f"lost: {loss}" for loss in losses]
        for item, (name, record) in zip(there, logs, strict=True):
            found.say(
                "reads",
                f"{item.path} ({np.ptp(record.t):.4g} s, payload {record.meta.get('payload') or 'not said'})",
            )
        return logs

    # --- one method a stage
    # -----------------------------------------------------------------------------------------------

    def _flow_maps(self, recipe: FlowMapRecipe, found: _Found) -> None:
        from ehbench.identification import readings
        from ehbench.readers import read_flowmeter

        machine, _ = self.machine(recipe, found)
        parts = []
        for name in recipe.data:
            with found.noting():
                part = read_flowmeter(
                    workflow.existing(recipe, name),
                    supply_pressure=float(machine.rig.supply.pressure),
                )
                parts.append(part)
                found.say(
                    "reads",
                    f"{name} ({len(part)} readings of {', '.join(' '.join(group) for group in part.groups())})",
                )
                found.notes += [str(text) for text in part.warnings]
        if parts:
            _until_work(lambda tell: readings.fit_readings(machine.rig, parts, progress=tell))
        count = len({group for part in parts for group in part.groups()})
        found.does = f"fits {count} flow map{'s' * (count != 1)} to {sum(map(len, parts))} readings"
        found.say("open", "whether the readings carry a map")

    def _hydraulics(self, recipe: HydraulicsRecipe, found: _Found) -> None:
        from ehbench.identification import hydraulics
        from ehbench.identification.search import coordinates

        machine, _ = self.machine(recipe, found)
        coordinates(
            machine.rig, recipe.parameters, recipe.start, recipe.lower, recipe.upper, recipe.at
        )
        logs = self.logs(recipe, found)
        options = hydraulics.FitOptions(
            method=recipe.method,
            start=recipe.start,
            lower=recipe.lower,
            upper=recipe.upper,
            channels=recipe.channels,
            cutoff=None if recipe.cutoff is None else float(recipe.cutoff),
            workers=1,
        )
        if logs:
            given = (machine.rig, logs, recipe.parameters)
            _until_work(
                lambda tell: hydraulics.identify_hydraulics(
                    *given, options, machine.flow_maps, tell, recipe.at
                )
            )
            if recipe.compare_dynamics:
                _until_work(
                    lambda tell: hydraulics.compare_dynamics(
                        *given,
                        recipe.compare_dynamics,
                        options,
                        machine.flow_maps,
                        tell,
                        recipe.at,
                    )
                )
        way = "matching frequency and decay" if recipe.method == "thesis" else "output error"
        found.does = f"fits {', '.join(recipe.parameters)} to {_count(recipe.data, 'log')} by {way}"
        if recipe.compare_dynamics:
            found.does += f", with each of the dynamics {', '.join(recipe.compare_dynamics)}"
        found.say("open", "whether the logs carry these parameters")

    def _validation(self, recipe: ValidateRecipe, found: _Found) -> None:
        from ehbench import validation
        from ehbench.observations import payload_of
        from ehbench.preprocessing import preprocess

        machine, _ = self.machine(recipe, found)
        logs = self.logs(recipe, found)
        models = (
            validation.models_of(machine.rig, logs, recipe.channels, machine.flow_maps, recipe.at)
            if logs
            else {}
        )
        for name, record in logs:
            with found.noting():
                found.notes += [
                    f"{name}: {text}"
                    for text in preprocess(name, record, models[payload_of(record) or ""])[1]
                ]
        fitted = {rundir.sha256(path): recipe_path for recipe_path, path in self._fitted(recipe)}
        for item in recipe.data:
            path = recipe.file(item.path)
            if path.is_file() and (by := fitted.get(rundir.sha256(path))):
                found.say(
                    "notes",
                    f"{item.path} does not count: {_shown_path(recipe, by)} fits the rig to it",
                )
        asked = recipe.thresholds
        words = [f"fit of {name} at least {least:g} %" for name, least in asked.fit_percent.items()]
        words += [
            f"error of {name} at most {_shown(machine.rig, name, float(most))}"
            for name, most in asked.max_error.items()
        ]
        for name in ("natural_frequency", "damping_ratio"):
            if share := getattr(asked, f"{name}_error"):
                words.append(f"{name.replace('_', ' ')} within {100.0 * share:g} %")
        words += [word for word in ("whiteness", "independence") if getattr(asked, word)]
        found.does = f"judges the rig on {_count(recipe.data, 'log')}: {', '.join(words) or 'nothing is asked'}"

    def _fitted(self, recipe: Recipe) -> Iterator[tuple[Path, Path]]:
        """(recipe, log) of every log that the recipes behind this one fit its rig to."""
        path = recipe.file(recipe.rig)
        while path.is_file() and kind_of(path) == "recipe":
            behind = load_recipe(path)
            if isinstance(behind, HydraulicsRecipe):
                logs = (behind.file(item.path) for item in behind.data)
                yield from ((path, log) for log in logs if log.is_file() and log.suffix != ".toml")
            if not hasattr(behind, "rig"):
                return
            path = behind.file(behind.rig)

    def _tuning(self, recipe: TuneRecipe, found: _Found) -> None:
        from ehbench.tune.gains import tune_pressure_feedback

        machine, blind = self.machine(recipe, found)
        behind = recipe.file(recipe.rig)
        to_be = (
            behind in self.found
            and behind not in self.desk.done
            and isinstance(self.found[behind].recipe, ValidateRecipe)
        )
        if not (to_be or isinstance(machine, workflow.ValidatedMachine)):
            self.unvalidated.add(recipe.path)
            found.say(
                "notes",
                f"the rig is not validated ({machine.stage}): tune refuses it without --unvalidated",
            )
        try:
            _until_work(
                lambda tell: tune_pressure_feedback(machine, recipe, progress=tell), STUDIED
            )
        except InsufficientData:
            if not blind:
                raise
        cylinder = recipe.cylinder or machine.rig.cylinder[0].name
        loads = recipe.payloads or (None, *machine.rig.payload)
        factors = {
            "stroke": recipe.strokes or range(recipe.postures),
            "payload": loads,
            "speed": recipe.speed_shares,
        }
        points = " × ".join(
            [*(_count(items, word) for word, items in factors.items()), "working functions"]
        )
        found.does = f"chooses the pressure feedback of '{cylinder}' over {points}, and tries {recipe.draws} draws"

    def _trial(self, recipe: TrialRecipe | TrialSetRecipe, found: _Found) -> None:
        many = isinstance(recipe, TrialSetRecipe)
        base, blind = self.machine(recipe, found)
        machines, lengths = {(recipe.rig, recipe.flow_maps): (base, blind)}, []
        for one in (one for _, _, one in recipe.cases()) if many else (recipe,):
            with found.noting():
                key = (one.rig, one.flow_maps)
                if key not in machines:
                    other, blind = self.machine(one, found)
                    machines[key] = (
                        replace(other, rig=workflow.with_identified(other.rig, base.rig)),
                        blind,
                    )
                length = self._prepared(one, *machines[key], found)
                lengths += [] if length is None else [length]
        ends = (
            [f"{length:.4g}" for length in sorted({min(lengths), max(lengths)})] if lengths else []
        )
        facts = [
            (" to ".join(ends) + " s" if ends else "as long as the motion")
            + f" at {float(recipe.rate):g} Hz"
        ]
        if many:
            factors = {
                "payload": recipe.payloads,
                "motion": recipe.motion,
                "controller": recipe.controller,
            }
            counts = [_count(items, word) for word, items in factors.items()]
            what = _count(recipe.cases(), "trial") + f" ({' × '.join(counts)})"
        else:
            what = "one trial, " + (
                "open loop"
                if recipe.controller is None
                else f"controller '{recipe.controller.label}'"
            )
            facts.append(f"payload {recipe.payload or 'none'}")
        found.does = f"runs {what} on {'the model' if recipe.on == 'model' else 'the virtual bench'}, {', '.join(facts)}"

    def _prepared(
        self, recipe: TrialRecipe, machine: workflow.Machine, blind: bool, found: _Found
    ) -> float | None:
        """Prepare one trial as its run does, without a tick; its length [s], None where only the
        flow maps tell.

        Raises:
            EhbenchError: what the run would refuse before it begins.
        """
        from ehbench import trial
        from ehbench.machines.protocol import truth_of
        from ehbench.trial import controllers

        for name in (
            recipe.bench,
            *(command.file for command in recipe.command),
            recipe.motion and recipe.motion.file,
        ):
            if name:
                found.say("reads", name)
                workflow.existing(recipe, name)
        tuning, motion = None, recipe.motion
        if recipe.controller is not None:
            made = controllers.design(recipe, machine.rig, machine.flow_maps)
            tuning = self._gains(recipe, made.cylinder, found)
        shares = motion is not None and any("%" in level for level in motion.levels)
        blind = blind and shares and motion.full_speed is None
        if blind:
            found.say(
                "open",
                "whether the motion stays in the stroke: its speeds are shares of what the flow "
                "maps allow",
            )
        prepared = trial.prepare(recipe, machine.rig, machine.flow_maps, tuning, True, blind)
        if truth_of(prepared.machine) is None and recipe.limits != type(recipe.limits)():
            found.say(
                "open", "whether a limit is reached at the start: the virtual bench settles first"
            )
        if recipe.controller is not None and recipe.controller.code is not None:
            found.say("reads", _shown_path(recipe, trial.code_file(recipe)))
            found.say(
                "notes",
                f"'{recipe.controller.code}' is Python code: it runs only with --allow-code",
            )
            found.say("open", f"what '{recipe.controller.code}' does: code is not run here")
        return None if blind else prepared.duration

    def _gains(self, recipe: TrialRecipe, cylinder: str, found: _Found) -> dict[str, Any] | None:
        """What the tune run says that a recipe names; of one that has not been run only what its
        recipe says.

        Raises:
            InputError: it is no tune run or recipe.
        """
        from ehbench import trial
        from ehbench.trial import controllers

        name = trial.gains_file(recipe)
        if name is None:
            return None
        place = workflow.existing(recipe, name)
        if not (place.is_file() and place.suffix == ".toml"):
            found.say("reads", f"{name} (gains)")
            return controllers.read_tuning(recipe, place)
        behind = load_recipe(place)
        if not isinstance(behind, TuneRecipe):
            where, hint = (
                recipe.at(*recipe.controller.where, "gains"),
                "name a tune recipe or its run",
            )
            raise InputError(
                f"gains come from '{name}', a recipe of stage '{behind.stage}'", **where, hint=hint
            )
        if self.has_run(place, found):
            folder = workflow.make(place, self.desk).folder
            found.say("reads", f"{folder} (gains)")
            return controllers.read_tuning(recipe, folder)
        found.say("open", f"what hangs on the gains: '{name}' has not been run")
        given = ("washout", "ramp_washout", "off_gain", "low_pressure", "cross_drop")
        said = {key: float(value) for key in given if (value := getattr(behind, key)) is not None}
        tuned = cylinder if self.found[place].errors else behind.cylinder or cylinder
        return {"cylinder": tuned, "feedback_gain": 0.0, **said}

    def _campaign(self, recipe: Campaign, found: _Found) -> None:
        said: dict[str, dict[str, list[str]]] = {"notes": {}, "open": {}}
        for index, name in enumerate(recipe.recipes):
            with found.noting():
                behind = self.at(load_recipe(workflow.existing(recipe, name)))
                if type(behind.recipe) not in _WRITES or behind.recipe.stage == "campaign":
                    where = recipe.at("recipes", index)
                    raise InputError(
                        f"'{name}' is of stage '{behind.recipe.stage}', which no campaign runs",
                        **where,
                    )
                found.reads.append(
                    f"{name}: {behind.does}"
                    + f", {STANDS}" * (behind.recipe.path in self.desk.done)
                )
                for kind, texts in said.items():
                    for text in getattr(behind, kind):
                        texts.setdefault(text, []).append(name)
                found.losses += [text for text in behind.losses if text not in found.losses]
                for error in behind.errors:
                    with found.noting():
                        raise error
        for kind, texts in said.items():
            getattr(found, kind).extend(
                f"{', '.join(names)}: {text}" for text, names in texts.items()
            )
        if recipe.figures:
            found.open.append("the names under [figures]: the runs make them")
        found.does = f"runs {_count(recipe.recipes, 'recipe')} in order; those that stand are kept"

    def _bench(self, recipe: BenchRecipe, found: _Found) -> None:
        from ehbench.machines.registry import open_machine

        rig = load_rig(workflow.existing(recipe, recipe.rig))
        own = {"on": "bench", "bench": recipe.path.name, "rig": recipe.rig, "path": recipe.path}
        open_machine(TrialRecipe(stage="trial", duration=Value(1.0), **own), rig)
        found.reads.append(f"{recipe.rig} (rig '{rig.name}')")
        found.does = 'is a virtual bench for trials with on = "bench"'

    def _dataset(self, recipe: DatasetRecipe, found: _Found) -> None:
        behind = self.at(load_recipe(workflow.existing(recipe, recipe.bench)))
        found.errors += behind.errors
        found.reads.append(f"{recipe.bench} (virtual bench)")
        found.does = f"is recorded on the virtual bench: {_count(recipe.log, 'log')}" + (
            f", flowmeter readings of {_count(recipe.flowmeter.edges, 'edge')}"
            if recipe.flowmeter
            else ""
        )


def _until_work(start: Callable[[Callable[[str, float], None]], Any], share: float = 0.0) -> None:
    """Let a stage take in its inputs, and stop it where it tells that it begins to work (``share``
    of it done).

    Raises:
        EhbenchError: what the stage refuses.
    """

    def tell(_: str, done: float) -> None:
        if done >= share:
            raise _Begun

    with suppress(_Begun):
        start(tell)


def _with_laws(rig: Rig, maps: Any) -> tuple[Rig, tuple[str, ...]]:
    """(the rig with an orifice in place of each edge whose measured map is not given, the names of
    those edges).

    The orifice passes the pump's flow limit at full command and supply pressure; only its sign and
    place are of use."""
    known = set(maps or ())
    names = [
        {f"{c.name}.{v.edge_name(e)}", v.edge_name(e)} for c, v, e in rig.edges() if e.law == "map"
    ]
    blind = sorted(max(pair, key=len) for pair in names if not pair & known)
    if not blind:
        return rig, ()

    def lawful(cylinder: str, valve: Valve, edge: Edge) -> Edge:
        if f"{cylinder}.{valve.edge_name(edge)}" not in blind:
            return edge
        most = max(abs(float(valve.command_min)), abs(float(valve.command_max)))
        gain = Value(float(rig.supply.flow_limit) / (most * math.sqrt(float(rig.supply.pressure))))
        return edge.model_copy(update={"law": "orifice", "flow_gain": gain})

    cylinders = tuple(
        c.model_copy(
            update={
                "valve": tuple(
                    v.model_copy(update={"edge": tuple(lawful(c.name, v, e) for e in v.edge)})
                    for v in c.valve
                )
            }
        )
        for c in rig.cylinder
    )
    return rig.model_copy(update={"cylinder": cylinders}), tuple(blind)


def _line_naming(path: Path, message: str) -> int | None:
    """The first line of a recipe that has one of the quoted words of a message as a text or key,
    the last word first.
    """
    lines = path.read_text(encoding="utf-8").splitlines()
    for word in reversed(re.findall(r"'([^']+)'", message)):
        known = re.compile(rf"""["']{re.escape(word)}["']|(?<![\w.-]){re.escape(word)}\s*=""")
        if at := next(
            (
                number
                for number, line in enumerate(lines, 1)
                if known.search(line.partition("#")[0])
            ),
            None,
        ):
            return at
    return None


def _shown_path(recipe: Recipe, path: Path) -> str:
    """A file as the recipe would name it; a run folder as the user would."""
    if path.is_dir():
        return str(path)
    return Path(os.path.relpath(path, recipe.path.parent)).as_posix()


def _count(items: Sized, word: str) -> str:
    return f"{len(items)} {word}{'s' * (len(items) != 1)}"


# --- rigs and data
# --------------------------------------------------------------------------------------------------------


def _shown(rig: Rig, name: str, value: float) -> str:
    unit = rig.unit_of(name)
    return f"{float(f'{from_si(value, unit, quantity(name)):.4g}'):g} {unit}"


def _rig(path: Path) -> Inspection:
    from ehbench.simulation import Model

    rig = load_rig(path)
    whole, _ = _with_laws(rig, None)
    supply = float(rig.supply.pressure)
    parts = {
        "joint": rig.joint_names,
        "cylinder": rig.cylinder,
        "valve": [*rig.valves()],
        "metering edge": [*rig.edges()],
    }
    most = _shown(rig, "flow_limit", float(rig.supply.flow_limit))
    lines = [f"rig '{rig.name}'" + (f": {rig.title}" if rig.title else "")]
    counts = ", ".join(_count(items, word) for word, items in parts.items())
    lines.append(f"  {counts}, supply {_shown(rig, 'pressure', supply)} up to {most}")
    notes = _cut_off(rig)
    loads: list[str | None] = [None, *rig.payload]
    for load in loads:
        try:
            model = Model.of(whole, payload=load)
            state = model.trim(model.posture({}))
        except EhbenchError as error:
            raise type(error)(
                error.message, file=path, line=_line_naming(path, error.message), hint=error.hint
            ) from None
        for index, cylinder in enumerate(rig.cylinder):
            ends = model.stroke_range(index)
            slide = rig.mechanism.kind == "slide"
            span = " to ".join(
                f"{v * 1e3:.0f}" if slide else f"{math.degrees(v):.1f}" for v in ends
            )
            span += " mm" if slide else " deg"
            head, rod = (float(state[model.layout.state(p, index)]) for p in ("p_head", "p_rod"))
            lines.append(
                f"  {load or 'no payload'}: {cylinder.name} moves {span}; at mid-stroke it rests at "
                f"{_shown(rig, 'p_head', head)} head, {_shown(rig, 'p_rod', rod)} rod"
            )
            if max(head, rod) > supply:
                notes.append(
                    f"{load or 'no payload'}: the supply cannot carry the load of '{cylinder.name}' at mid-stroke"
                )
    lines += [f"  note: {text}" for text in notes]
    sure: dict[str, int] = {}
    for value in rig.parameters().values():
        if value.source:
            sure[value.sure] = sure.get(value.sure, 0) + 1
    said = ", ".join(f"{n} {word}" for word, n in sorted(sure.items())) or "no sources given"
    lines.append(f"  how sure the numbers are: {said}")
    return Inspection((*lines, "ok"))


def _cut_off(rig: Rig) -> list[str]:
    """A sentence for each node that the edges of a cylinder leave out: odd, and now and then meant."""
    told = []
    for cylinder in rig.cylinder:
        joined = {
            end for valve in cylinder.valve for edge in valve.edge for end in (edge.from_, edge.to)
        }
        for node in NODES:
            if node not in joined:
                what = f"the {node} end" if node in ("head", "rod") else f"the {node}"
                told.append(
                    f"no metering edge of '{cylinder.name}' touches {what}: is one missing?"
                )
    return told


def _is_flowmeter(path: Path) -> bool:
    for line in path.read_text(encoding="utf-8-sig", errors="replace").splitlines():
        if line.strip() and not line.startswith("#"):
            names = [
                cell.split("[")[0].strip().lower()
                for cell in line.replace(";", ",").replace("\t", ",").split(",")
            ]
            return "valve" in names or ("flow" in names and "t" not in names)
    return False


def _flowmeter(path: Path) -> Inspection:
    from ehbench.readers import read_flowmeter

    data = read_flowmeter(path)
    lines = [f"flowmeter readings: {data.flow.size} rows"]
    for valve, direction in data.groups():
        rows = data.select(valve, direction)
        lines.append(
            f"  {valve} {direction}: {rows.flow.size} readings at {len(set(rows.command.tolist()))} commands, "
            f"drops {rows.pressure_drop.min() / 1e3:.0f} to {rows.pressure_drop.max() / 1e3:.0f} kPa, "
            f"flow up to {abs(rows.flow).max() * 6e4:.3g} L/min"
        )
    return Inspection((*lines, "ok"))


def _log(path: Path) -> Inspection:
    from ehbench.preprocessing import LEAST_SAMPLES, evened
    from ehbench.logs import read_record

    record = read_record(path)
    lines = [
        f"log: {record.t.size} samples of {len(record.channels)} channels, {record.t[0]:g} to {record.t[-1]:g} s, "
        f"every {record.sample_time * 1e3:.4g} ms"
    ]
    lines += [f"  {key}: {value}" for key, value in record.meta.items() if len(value) < 200]
    for name, values in record.channels.items():
        row = quantity(name)
        low, high = (from_si(float(v), row.display, row) for v in (values.min(), values.max()))
        lines.append(f"  {name}: {low:.4g} to {high:.4g} {row.display}")
    lines += [f"  lost: {loss}" for loss in record.losses]
    if record.t.size < LEAST_SAMPLES:
        lines.append(
            f"  unfit for identification: it has only {record.t.size} sample{'s' * (record.t.size != 1)}"
        )
        return Inspection((*lines, "ok, with losses"), 3)
    try:
        lines += [f"  {said}" for said in evened(path.name, record)[1]]
    except LogError as error:
        lines.append(f"  unfit for identification: {error}")
        return Inspection((*lines, "ok, with losses"), 3)
    return Inspection(
        (*lines, "ok, with losses" if record.losses else "ok"), 3 if record.losses else 0
    )
