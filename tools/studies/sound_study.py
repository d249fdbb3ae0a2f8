"""Trials of all shipped recipes on sound machines: how many a limit or the monitor stops, and how
many are said to swing.

python -m tools.studies.sound_study 1000"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import cycle, islice
from pathlib import Path
from tempfile import TemporaryDirectory

from ehbench import workflow
from ehbench.config.recipe import TrialRecipe, TrialSetRecipe, load_recipe
from ehbench.runs.rundir import shipped
from ehbench.runtime.cores import cores
from ehbench.stages.trial import prepared_case
from ehbench.stages.trials import TrialsStage
from ehbench.trial import Case, run

STOPPING = "stopping_trial.toml"  # it is made to stop


def cases(root: Path) -> Iterator[Case]:
    """Every trial of every recipe but those of faults; what they take in is run in ``root``."""
    session = workflow.Session(allow_code=True, unvalidated=True, root=root)
    for path in sorted(shipped("recipes").rglob("*.toml")):
        if path.parent.name in ("faults", "datasets", "bench", "rigs") or path.name == STOPPING:
            continue
        if not path.read_text(encoding="utf-8").count('\nstage = "trial'):
            continue
        recipe = load_recipe(path)
        if isinstance(recipe, TrialSetRecipe):
            for case in TrialsStage().prepare(recipe, session.inputs(recipe)).cases:
                yield replace(case, name=f"{path.stem}: {case.name}")
        elif isinstance(recipe, TrialRecipe):
            inputs = session.inputs(recipe)
            state = inputs.rig_state(recipe.rig, recipe.flow_maps)
            yield prepared_case(path.stem, recipe, state, inputs)[0]


def monitored(case: Case) -> Case | None:
    """The same trial with a monitor, where its controllers can have one."""
    controller = case.recipe.controller
    if controller is None or controller.kind is None:
        return None
    changed = controller.model_copy(update={"monitor": True})
    recipe = case.recipe.model_copy(update={"controller": changed})
    return replace(case, recipe=recipe, name=f"{case.name}, monitored")


def outcome(task: tuple[int, Case]) -> tuple[str, str, bool]:
    """(name of a trial, what stopped it or "", whether it is said to swing) with the noise of a
    number."""
    number, case = task
    recipe = case.recipe.model_copy(update={"seed": case.recipe.seed + number})
    facts = run(replace(case, recipe=recipe).prepare(allow_code=True)).facts
    swings = any(getattr(text, "key", "") == "trial.swings" for text in facts.warnings)
    return case.name, facts.stopped, swings


def main(arguments: Sequence[str] = ()) -> None:
    """Run so many trials, a thousand by default, and print those that were stopped or swing."""
    count = int(arguments[0]) if arguments else 1000
    with TemporaryDirectory() as folder:
        plain = list(cases(Path(folder)))
        every = plain + [item for case in plain if (item := monitored(case)) is not None]
        with ThreadPoolExecutor(cores()) as pool:
            outcomes = list(pool.map(outcome, islice(enumerate(cycle(every)), count)))
    stopped = Counter((name, text) for name, text, _ in outcomes if text)
    swinging = Counter(name for name, _, swings in outcomes if swings)
    watched = len(every) - len(plain)
    print(f"{len(outcomes)} trials of {len(plain)} plain and {watched} monitored ones")
    print(f"{stopped.total()} stopped")
    for (name, text), number in sorted(stopped.items()):
        print(number, name, text, sep=" | ")
    print(f"{swinging.total()} said to swing")
    for name, number in sorted(swinging.items()):
        print(number, name, sep=" | ")


if __name__ == "__main__":
    main(sys.argv[1:])
