"""Compile the kernels before they are needed: ``python -m ehbench.app.warm``, as ``make setup``
does.

Every machine runs a short trial under every law, at once and tick by tick, and an arm moves several
cylinders at a time. What that compiled stays until a kernel changes. Python's own byte code is
written too: where the environment forbids it (PYTHONDONTWRITEBYTECODE, as in containers), each
start would compile the package anew, half a second."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from compileall import compile_dir
from concurrent.futures import ProcessPoolExecutor, as_completed
from inspect import signature
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from ehbench.app import starter
from ehbench.config.recipe import TrialRecipe, TrialSetRecipe, load_rig
from ehbench.config.rig import Cylinder, Rig
from ehbench.control import LAW_NAMES
from ehbench.control.registry import LAWS
from ehbench.runs.rundir import shipped
from ehbench.runtime.compiled import PACKAGE
from ehbench.runtime.cores import cores

if TYPE_CHECKING:
    from ehbench.trial import Prepared

DURATION = "20 ms"


def short_motion(cylinder: Cylinder) -> dict[str, Any]:
    """What a trial's recipe says of a short motion."""
    points = [f"{share * float(cylinder.stroke)!r} m" for share in (0.4, 0.401)]
    motion = {"kind": "point_to_point", "cylinder": cylinder.name, "waypoints": points}
    return motion | {"speed": "50 mm/s"}


def recipes(rig: Rig, machine: str) -> Iterator[dict[str, Any]]:
    """What a trial's recipe says, for every law on a machine; the open loop first."""
    motion = short_motion(rig.cylinder[0])
    yield {"on": machine, "duration": DURATION}
    for name in LAW_NAMES:
        need = LAWS[name].required
        row = None if need is None else LAWS[name].gains[need.gain]
        gains = {} if row is None else {row.name: f"{1e-12} {row.unit}"}
        controller = {"kind": name, "gains": gains}
        yield {"on": machine, "duration": DURATION, "motion": motion, "controller": controller}


def prepared(rig: Rig, keys: dict[str, Any]) -> Prepared:
    """A trial of a rig, of what its recipe says."""
    from ehbench.trial import prepare

    return prepare(TrialRecipe(stage="trial", rig="rig.toml", path=Path("x"), **keys), rig)


def started() -> Rig:
    """The rig of a new workspace."""
    with TemporaryDirectory() as folder:
        starter.init(Path(folder) / "rig")
        return load_rig(Path(folder) / "rig" / "rig.toml")


def trials(machine: str, *laws: str) -> str:
    """Run the short trials of one machine under some laws, "" for none; gives back what they are
    called."""
    from ehbench.trial import run
    from ehbench.trial.cases import account

    rig = started()
    for keys in recipes(rig, machine):
        if keys.get("controller", {"kind": ""})["kind"] in laws:
            trial = prepared(rig, keys)
            account(trial, run(trial))
            run(trial, fast=False)  # as under a class of the user's own
    return f"trials on the {machine}: {', '.join(law or 'commands' for law in laws)}"


def replays(what: str) -> str:
    """Integrate in fixed and in adaptive steps; gives back what it is called."""
    from ehbench.plant.integrate import STEP
    from ehbench.plant.model import Model
    from ehbench.plant.paced import AUTO
    from ehbench.trial import run

    rig = started()
    trial = prepared(rig, next(recipes(rig, "model")) | {"step": AUTO})
    for step in (STEP, AUTO):
        Model.of(rig).replay(run(trial).record, step)
    return what


def together(what: str) -> str:
    """Move all cylinders of an arm at once; gives back what it is called."""
    from ehbench.trial import run

    rig = load_rig(shipped("recipes") / "rigs" / "thesis_arm.toml")
    motion, *others = map(short_motion, rig.cylinder)
    run(prepared(rig, {"motion": motion | {"also": others}, "controller": {"kind": "arc"}}))
    return what


def exports(what: str) -> str:
    """Compile and translate what an export writes; gives back what it is called."""
    from ehbench.config.recipe import ExportRecipe
    from ehbench.export import Export

    rig = started()
    recipe = ExportRecipe(stage="export", rig="rig.toml", path=Path("x"))
    for keys in recipes(rig, "model"):
        _ = Export(recipe, rig, None, Path("x"), prepared(rig, keys), {}).kernels
    return what


def fits(what: str) -> str:
    """Compile what fits flow maps; gives back what it is called."""
    from ehbench.flow_maps.readings import readings_table
    from ehbench.flow_maps.results import fit_flow_map

    command, drop = (a.ravel() for a in np.meshgrid(np.arange(9.0), np.geomspace(1e5, 6e6, 6)))
    flow = 1e-8 * np.maximum(command - 1.2, 0.0) * np.sqrt(drop)
    noise = np.random.default_rng(0).standard_normal(flow.size)
    fit_flow_map("v", "forward", readings_table(command, drop, flow * (1.0 + 0.1 * noise)))
    return what


def ahead() -> None:
    """Compile what a first trial needs, from its end on, while another process runs it."""
    from ehbench.ledger.loads import Loads
    from ehbench.ledger.model_account import ledger_of_model, states_of
    from ehbench.ledger.powers import powers
    from ehbench.ledger.sheet import Sheet
    from ehbench.plant import derivatives as equations
    from ehbench.plant.integrate import STEP
    from ehbench.plant.model import Model

    model = Model.of(started())
    plant, names = model.plant, model.layout
    y, sheet, t = np.zeros(names.states), Sheet(model, "residual"), np.array([0.0, STEP])
    given = {"plant": plant, "owner": sheet.owner}
    for part in (*equations.LAST, powers):
        part.compile(*(given.get(name, y) for name in signature(part).parameters))
    commands, log = np.zeros((2, len(names.valves))), np.zeros((2, names.states))
    record = model.record(t, commands, log)
    states, _ = states_of(model, record)
    Loads.of(record).stored(model, t, states, sheet.stores)
    ledger_of_model(model, record)


def main() -> None:
    """Compile for all machines, a process each processor, and say how far it is.

    The plant comes first, as processes that need it at once would each compile it; beside it what
    an export compiles for any processor, which takes longest and shares nothing with it."""
    if sys.argv[1:] == ["--ahead"]:
        return ahead()
    model, *others = get_args(TrialSetRecipe.model_fields["on"].annotation)
    compile_dir(PACKAGE, quiet=2)
    print("compiling the kernels, once …", file=sys.stderr, flush=True)
    with ProcessPoolExecutor(cores(), mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(trials, model, ""), pool.submit(exports, "exports")]
        jobs[0].result()
        jobs += [pool.submit(trials, model, law) for law in reversed(LAW_NAMES)]
        jobs += [pool.submit(replays, "replays")]
        jobs += [pool.submit(trials, machine, "", *LAW_NAMES) for machine in others]
        jobs += [pool.submit(together, "trials of several cylinders")]
        jobs += [pool.submit(fits, "fits of flow maps")]
        for job in as_completed(jobs):
            print(f"compiled: {job.result()}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
