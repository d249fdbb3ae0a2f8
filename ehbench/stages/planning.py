"""The next test after a fit: what it would tell, as lines, as plain values and as a recipe."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tomli_w

from ehbench.config.recipe import HydraulicsRecipe, load_recipe, load_rig
from ehbench.config.rig import Rig
from ehbench.guidance.next_test import Known, Proposal, must_be_fitted, propose, widest
from ehbench.guidance.profile import profile
from ehbench.report.blocks import Grid
from ehbench.report.content import num
from ehbench.report.provenance import TracedRun, unsupported
from ehbench.report.terminal import Answer
from ehbench.report.words import interval, number, pretty, shown, unit_of, with_interval
from ehbench.runs import rundir
from ehbench.runs.versions import Versions
from ehbench.runtime.disk import write_text
from ehbench.stages.base import DONE, Host, Outcome, write_rig
from ehbench.stages.hydraulics import HydraulicsStage, expect_hydraulics
from ehbench.stages.inputs import Inputs
from ehbench.stages.relocation import relative
from ehbench.vocabulary import InputError, Message, Progress, message


@dataclass(frozen=True)
class NextTest:
    """Tests that would sharpen a parameter, the best first; ``rig_file``: what a recipe names;
    ``changes``: what no longer supports the run."""

    rig: Rig
    known: Known
    proposals: tuple[Proposal, ...]
    rig_file: Path
    changes: tuple[Message, ...]

    def answer(self, run: Path, written: Path | None) -> Answer:
        """What the command says of the ``run`` of a fit; ``written`` is the recipe of the first
        test, if it was."""
        name, unit = self.known.name, pretty(unit_of(self.rig, self.known.name))
        now = self._text(self.known.interval)
        then = self._text(self.proposals[0].interval)
        key = "stages.next_test_changed" if self.changes else "stages.next_test"
        verdict = message(key, name=name, now=now, then=then, unit=unit)
        head = ["cylinder", "test", "amplitude [V]", "starts at [mm]", "payload"]
        head += [f"95 % interval then [{unit}]" if unit else "95 % interval then", "of now"]
        rows = [
            [
                proposal.trial.cylinder,
                proposal.trial.wave,
                num(number(max(abs(entry["amplitude"]) for entry in proposal.trial.commands), 3)),
                num(number(1e3 * proposal.trial.stroke, 3)),
                proposal.trial.payload or "none",
                num(interval(*map(self._shown, proposal.interval))),
                num("–" if proposal.share is None else f"{100.0 * proposal.share:.0f} %"),
            ]
            for proposal in self.proposals[:8]
        ]
        options = " --allow-code" if self.rig.model else ""  # an FMU
        step = message("steps.write_test", run=run, parameter=name, options=options)
        if written is not None:
            step = message("steps.run_test", recipe=written, options=options)
        notes = [message("report.unsupported", change=change) for change in self.changes]
        return Answer(
            verdict, [Grid(head, rows)], [step], notes, place=written, values=self.as_json()
        )

    def _shown(self, value: float) -> float:
        return shown(self.rig, self.known.name, value)

    def _text(self, ends: tuple[float, float] | None) -> str:
        value = self._shown(self.known.value)
        if ends is None:
            return message("stages.unknown_value", value=number(value))
        return with_interval(value, *map(self._shown, ends))

    def as_json(self) -> dict[str, Any]:
        """Plain values for scripts, SI."""
        tests = []
        for proposal in self.proposals:
            trial = proposal.trial
            names = ("cylinder", "wave", "stroke", "payload")
            test = {name: getattr(trial, name) for name in names} | {"duration": trial.seconds}
            test["commands"] = [dict(entry) for entry in trial.commands]
            tests.append(test | {"interval": proposal.interval, "share": proposal.share})
        known = {name: getattr(self.known, name) for name in ("name", "value", "interval")}
        return {**known, "tests": tests, "changes": self.changes}

    def write(self, path: Path) -> Path:
        """The first test as the recipe of a trial on the virtual bench.

        Raises:
            InputError: the file is there already."""
        if path.exists():
            raise InputError(message("stages.exists"), file=path)
        trial = self.proposals[0].trial
        recipe: dict[str, Any] = {
            "stage": "trial",
            "title": f"{trial.wave.capitalize()} of {trial.cylinder}, for {self.known.name}",
            "rig": relative(self.rig_file, path.resolve().parent),
            "on": "bench" if load_rig(self.rig_file).model is None else "model",
            "posture": {trial.cylinder: f"{1e3 * trial.stroke:.4g} mm"},
            "duration": f"{trial.seconds:g} s",
        }
        if trial.payload:
            recipe["payload"] = trial.payload
        units = {"amplitude": "V", "start": "s", "stop": "s"}
        recipe["command"] = [
            {"valve": entry["valve"], "kind": entry["kind"]}
            | {key: f"{entry[key]:g} {unit}" for key, unit in units.items()}
            for entry in trial.commands
        ]
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, tomli_w.dumps(recipe))
        return path


def write_profile(inputs: Inputs, name: str, host: Host) -> Outcome:
    """The profile likelihood of a parameter in a run folder: ``profile.json`` and its picture.

    Raises:
        InputError: another kind of recipe, a parameter that it does not fit."""
    from ehbench.report import draw

    recipe = expect_hydraulics(inputs.recipe)
    prepared = HydraulicsStage().prepare(recipe, inputs)
    assert prepared.fit is not None
    files, versions = prepared.inputs or (), Versions.of("profile")
    digest = rundir.hash_of(recipe.path, files, versions)
    final = host.out or host.root / f"profile_{name}_{recipe.path.stem}_{digest}"
    with rundir.open_run(final, recipe.stage_name, recipe.path, files, versions=versions) as run:
        fit, result = profile(prepared.fit, name, host.progress_of(recipe.name))
        write_rig(run.path, fit.rig, prepared.state.flow_maps)
        rundir.write_json(run.path / "profile.json", asdict(result))
        run.facts |= {"what": "profile", "title": f"Profile of {name}", "rig": fit.rig.name}
        run.facts |= {"warnings": list(fit.warnings), "code": DONE, "notes": list(fit.warnings)}
        run.save()
        draw(run.path)
    return Outcome(final, DONE, (*fit.warnings, *run.left_over))


def recipe_of(run: TracedRun) -> HydraulicsRecipe:
    """The recipe of a run that fitted hydraulics, as the run read it.

    Raises:
        InputError: another kind of run; a recipe that is gone or has changed."""
    if run.run.what != "hydraulics":
        raise InputError(message("stages.no_fit"), file=run.folder)
    if run.recipe.place is None or not run.recipe.is_same:
        text = message("stages.recipe_changed", name=run.recipe.name)
        raise InputError(text, file=run.folder)
    recipe = expect_hydraulics(load_recipe(run.recipe.place))
    if recipe.response is not None:
        raise InputError(message("stages.no_samples_to_add"), file=run.folder)
    return recipe


def plan(run: TracedRun, inputs: Inputs, name: str | None, progress: Progress | None) -> NextTest:
    """The tests that would sharpen a parameter of a run the most.

    Raises:
        InputError: the parameter was not fitted.
        InsufficientData: no test is possible."""
    recipe = expect_hydraulics(inputs.recipe)
    rows = {row["name"]: row for row in run.run.json("parameters.json")["parameters"]}
    if name is not None:
        must_be_fitted(name, rows)  # before anything that the recipe names is run
    prepared = HydraulicsStage().prepare(recipe, inputs)
    assert prepared.fit is not None
    fitted = {}
    for c in prepared.fit.search:
        row = rows[c.name]
        ends = row["interval"] and (float(row["interval"][0]), float(row["interval"][1]))
        fitted[c.name] = Known(c.name, float(row["value"]), ends, float(row.get("from_fixed", 0.0)))
    known = list(fitted.values())
    name = name or widest(known, prepared.fit.search)
    proposals = propose(prepared.fit, known, name, progress)
    rig_file = next(item.place for item in run.sources if item.role == "rig") or run.folder
    changes = tuple(unsupported(run.folder))
    return NextTest(run.run.rig, fitted[name], tuple(proposals), rig_file, changes)
