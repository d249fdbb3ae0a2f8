"""The next test after a fit: what it would tell, as lines, as plain values and as a recipe."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ehbench.config.recipe import HydraulicsRecipe, load_recipe
from ehbench.config.rig import Rig
from ehbench.guidance.next_test import Known, Proposal, must_be_fitted, propose, widest
from ehbench.report.bearing import Made
from ehbench.report.blocks import Grid
from ehbench.report.content import num
from ehbench.report.terminal import table
from ehbench.report.words import estimate, interval, number, pretty, shown, unit_of
from ehbench.runs import rundir
from ehbench.runs.versions import Versions
from ehbench.stages.base import DONE, Host, Outcome, write_rig
from ehbench.stages.hydraulics import HydraulicsStage
from ehbench.stages.inputs import Inputs
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.progress import Progress

_SHOWN = 8


@dataclass(frozen=True)
class NextTest:
    """Tests that would sharpen a parameter, the best first; ``rig_file``: what a recipe names."""

    rig: Rig
    known: Known
    proposals: tuple[Proposal, ...]
    rig_file: Path

    def lines(self, width: int) -> Iterator[str]:
        """What people read."""
        name, unit = self.known.name, pretty(unit_of(self.rig, self.known.name))
        now = f"{self._text(self.known.value, self.known.interval)} {unit}".strip()
        best = self.proposals[0]
        then = self._text(self.known.value, best.interval)
        yield f"{name} is {now} now; the first of these tests would leave {then} {unit}".rstrip()
        yield ""
        head = ["cylinder", "test", "amplitude [V]", "starts at [mm]", "payload"]
        head += [f"95 % interval then [{unit}]" if unit else "95 % interval then", "of now"]
        rows = [
            [
                proposal.trial.cylinder,
                proposal.trial.wave,
                num(number(max(abs(entry["amplitude"]) for entry in proposal.trial.commands), 3)),
                num(number(1e3 * proposal.trial.stroke, 3)),
                proposal.trial.payload or "none",
                num(self._ends(proposal.interval)),
                num("–" if proposal.share is None else f"{100.0 * proposal.share:.0f} %"),
            ]
            for proposal in self.proposals[:_SHOWN]
        ]
        yield from table(Grid(head, rows), (), width)

    def _text(self, value: float, ends: tuple[float, float] | None) -> str:
        name = self.known.name
        if ends is None:
            return f"not known ({number(float(shown(self.rig, name, value)))} is where it starts)"
        low, high = (float(shown(self.rig, name, end)) for end in ends)
        text = estimate(float(shown(self.rig, name, value)), low, high)
        return text if "±" in text else f"{text} ({interval(low, high)})"

    def _ends(self, ends: tuple[float, float]) -> str:
        return interval(*(float(shown(self.rig, self.known.name, end)) for end in ends))

    def as_json(self) -> dict[str, Any]:
        """Plain values for scripts, SI."""
        return {
            "name": self.known.name,
            "value": self.known.value,
            "interval": self.known.interval,
            "tests": [
                {
                    "cylinder": proposal.trial.cylinder,
                    "wave": proposal.trial.wave,
                    "stroke": proposal.trial.stroke,
                    "payload": proposal.trial.payload,
                    "duration": proposal.trial.seconds,
                    "commands": [dict(entry) for entry in proposal.trial.commands],
                    "interval": proposal.interval,
                    "share": proposal.share,
                }
                for proposal in self.proposals
            ],
        }

    def write(self, path: Path) -> Path:
        """The first test as the recipe of a trial on the virtual bench.

        Raises:
            InputError: the file is there already.
        """
        import tomli_w

        if path.exists():
            raise InputError("is there already; nothing was written", file=path)
        trial = self.proposals[0].trial
        recipe: dict[str, Any] = {
            "stage": "trial",
            "title": f"{trial.wave.capitalize()} of {trial.cylinder}, for {self.known.name}",
            "rig": Path(os.path.relpath(self.rig_file, path.resolve().parent)).as_posix(),
            "on": "bench",
            "posture": {trial.cylinder: f"{1e3 * trial.stroke:.4g} mm"},
            "duration": f"{trial.seconds:g} s",
        }
        if trial.payload:
            recipe["payload"] = trial.payload
        recipe["command"] = [
            {
                "valve": entry["valve"],
                "kind": entry["kind"],
                "amplitude": f"{entry['amplitude']:g} V",
                "start": f"{entry['start']:g} s",
                "stop": f"{entry['stop']:g} s",
            }
            for entry in trial.commands
        ]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(tomli_w.dumps(recipe), encoding="utf-8")
        return path


def write_profile(inputs: Inputs, name: str, host: Host) -> Outcome:
    """The profile likelihood of a parameter in a run folder: ``profile.json`` and its picture.

    Raises:
        InputError: another kind of recipe, a parameter that it does not fit.
    """
    from ehbench.guidance.profile import profile
    from ehbench.report import draw

    recipe = inputs.recipe
    if not isinstance(recipe, HydraulicsRecipe):
        raise InputError(
            "has no parameters to profile",
            file=recipe.path,
            hint='name a recipe of stage "identify", what = "hydraulics"',
        )
    prepared = HydraulicsStage().prepare(recipe, inputs)
    assert prepared.fit is not None
    files, versions = prepared.inputs or (), Versions.of("profile")
    digest = rundir.hash_of(recipe.path, files, versions)
    final = host.out or host.root / f"profile_{name}_{recipe.path.stem}_{digest}"
    with rundir.open_run(final, recipe.stage_name, recipe.path, files, versions=versions) as run:
        fit, result = profile(prepared.fit, name, host.tell(recipe.name))
        write_rig(run.path, fit.rig, prepared.state.flow_maps)
        rundir.write_json(run.path / "profile.json", result.as_json())
        run.facts |= {"what": "profile", "title": f"Profile of {name}", "rig": fit.rig.name}
        run.facts |= {"warnings": list(fit.warnings), "code": DONE, "notes": list(fit.warnings)}
        run.save()
        draw(run.path)
    return Outcome(final, DONE, (*fit.warnings, *run.left_over))


def fit_behind(built: Made) -> HydraulicsRecipe:
    """The recipe of a run that fitted hydraulics, as the run read it.

    Raises:
        InputError: another kind of run; a recipe that is gone or has changed.
    """
    if built.run.what != "hydraulics":
        raise InputError(
            "fitted no hydraulics",
            file=built.folder,
            hint='name a run of stage "identify", what = "hydraulics"',
        )
    if built.recipe.place is None or not built.recipe.is_same:
        why = "is not found" if built.recipe.place is None else "has changed since"
        raise InputError(
            f"the run's recipe '{built.recipe.name}' {why}",
            file=built.folder,
            hint="run it again: ehbench identify RECIPE",
        )
    recipe = load_recipe(built.recipe.place)
    assert isinstance(recipe, HydraulicsRecipe)  # by what the run says and the recipe's digest
    if recipe.response is not None:
        raise InputError(
            "compared frequency responses, beside which a test's samples cannot stand",
            file=built.folder,
            hint="run the recipe without [response]",
        )
    return recipe


def plan(built: Made, inputs: Inputs, name: str | None, progress: Progress | None) -> NextTest:
    """The tests that would sharpen a parameter of a run most.

    Raises:
        InputError: the parameter was not fitted.
        InsufficientData: no test is possible.
    """
    recipe = inputs.recipe
    assert isinstance(recipe, HydraulicsRecipe)
    rows = {
        parameter["name"]: parameter
        for parameter in built.run.json("parameters.json")["parameters"]
    }
    if name is not None:
        must_be_fitted(name, rows)  # before anything that the recipe names is run
    prepared = HydraulicsStage().prepare(recipe, inputs)
    assert prepared.fit is not None
    fitted = []
    for c in prepared.fit.search:
        row = rows[c.name]
        ends = row["interval"]
        known = None if ends is None else (float(ends[0]), float(ends[1]))
        fitted.append(Known(c.name, float(row["value"]), known, row["status"]))
    name = name or widest(fitted, prepared.fit.search)
    proposals = propose(prepared.fit, fitted, name, progress)
    known = next(item for item in fitted if item.name == name)
    source = next(item.place for item in built.sources if item.role == "rig")
    rig_file = source or built.folder
    return NextTest(built.run.rig, known, tuple(proposals), rig_file)
