"""Datasets that the virtual bench records: ``python -m tools.datasets [NAME...]`` writes them
again, byte for byte.

Each ``recipes/datasets/<name>.toml`` gives ``datasets/<name>/``: flowmeter readings as CSV, step
logs as MCAP, a README."""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path
from zlib import crc32

import numpy as np

from ehbench.config.recipe import (
    BenchRecipe,
    DatasetLog,
    DatasetRecipe,
    Flowmeter,
    TrialRecipe,
    load_recipe,
    load_rig,
)
from ehbench.config.rig import Rig
from ehbench.data.logs import write_log
from ehbench.machines.virtual import VirtualMachine
from ehbench.runtime.blas import one_thread
from ehbench.trial import run_trial
from ehbench.vocabulary.errors import EhbenchError, InputError
from ehbench.vocabulary.fields import read_value
from ehbench.vocabulary.quantities import VOCABULARY
from ehbench.vocabulary.units import from_si


def seed_of(seed: int, name: str) -> int:
    """The seed of one part of a dataset: its bytes do not depend on the other parts."""
    return crc32(f"{seed} {name}".encode()) & 0x7FFFFFFF


def flowmeter_csv(
    bench: VirtualMachine, plan: Flowmeter, edge: str, reverse: bool, seed: int
) -> str:
    """The readings of one edge in one direction as the text of a CSV file.

    A needle valve sets each drop anew for every trial; the command comes up from rest. The turbine
    reads with a noise that is a share of the flow; below its limit the flow is what a cylinder's
    speed says. Repeats differ by a scatter of their own."""
    rng = np.random.default_rng(seed)
    commands = [float(read_value(text, VOCABULARY["command"])) for text in plan.commands]
    drops = [float(read_value(text, VOCABULARY["pressure_drop"])) for text in plan.pressure_drops]
    u, required, trial = (
        a.ravel() for a in np.meshgrid(commands, drops, np.arange(plan.trials) + 1, indexing="ij")
    )
    size = u.size
    drop = required * (1 + plan.drop_scatter * rng.uniform(-1, 1, size))
    flow = bench.static_flow(edge, u, -drop if reverse else drop) * (-1 if reverse else 1)
    flow = flow * (1 + plan.repeat_scatter * rng.standard_normal(size))
    within = flow <= float(
        bench.rig.supply.flow_limit
    )  # more than the pump gives cannot be measured
    u, drop, flow, trial = u[within], drop[within], flow[within], trial[within]
    size = u.size
    by_meter = flow >= float(plan.meter_limit)
    turbine = flow * (1 + plan.meter_noise * rng.standard_normal(size))
    cylinder = flow + float(plan.cylinder_noise) * rng.standard_normal(size)
    read = np.where(by_meter, turbine, cylinder)
    spoilt = rng.choice(
        np.flatnonzero(by_meter), min(plan.outliers, int(by_meter.sum())), replace=False
    )
    read[spoilt] *= rng.choice(
        [0.7, 1.35], spoilt.size
    )  # air in the turbine, or a wheel that stuck
    temperature = 311.15 + rng.uniform(-1.5, 1.5, size)
    units = {name: bench.rig.unit_of(name) for name in ("command", "pressure_drop", "flow")}
    lines = [
        "valve,direction,"
        + ",".join(f"{name} [{units[name]}]" for name in ("command", "pressure_drop", "flow"))
        + ",trial,method,temperature [degC]"
    ]
    columns = {"command": u, "pressure_drop": drop, "flow": read}
    shown = {
        name: from_si(values, units[name], VOCABULARY[name]) for name, values in columns.items()
    }
    celsius = from_si(temperature, "degC", VOCABULARY["temperature"])
    way = "reverse" if reverse else "forward"
    for i in range(size):
        lines.append(
            f"{edge.split('.')[1]},{way},{shown['command'][i]:g},{shown['pressure_drop'][i]:.5g},{_fixed(shown['flow'][i])},"
            f"{trial[i]},{'flowmeter' if by_meter[i] else 'cylinder'},{celsius[i]:.1f}"
        )
    return "\n".join(lines) + "\n"


def _fixed(value: float) -> str:
    """Four decimals, without the sign of a zero."""
    text = f"{value:.4f}"
    return text[1:] if text == "-0.0000" else text


def _log(recipe: DatasetRecipe, rig: Rig, item: DatasetLog, path: Path) -> None:
    """Record one log.

    Raises:
        InputError: a limit stopped it, so the dataset would not be what its recipe says."""
    trial = TrialRecipe(
        stage="trial",
        title=item.title,
        rig=recipe.bench,
        on="bench",
        bench=recipe.bench,
        payload=item.payload,
        posture=item.posture,
        duration=item.duration,
        rate=item.rate,
        seed=seed_of(recipe.seed, item.name),
        command=item.command,
        limits=item.limits,
        path=recipe.path,
    )
    record, facts = run_trial(rig, trial)
    if facts.stop is not None:
        raise InputError(
            f"log '{item.name}': {facts.stopped}",
            file=recipe.path,
            hint="a dataset holds no stopped trials",
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_log(path, record)


def _readings(
    bench: VirtualMachine, plan: Flowmeter, seed: int, folder: Path
) -> list[tuple[str, str]]:
    """Write the flowmeter readings; (file, what it holds) of each."""
    rows = []
    for edge in plan.edges:
        both = edge in plan.reverse
        for reverse in (False, True) if both else (False,):
            ending = ("_reverse" if reverse else "_forward") if both else ""
            name = f"flowmeter/{edge.split('.')[1]}{ending}.csv"
            target = folder / name
            target.parent.mkdir(exist_ok=True)
            text = flowmeter_csv(bench, plan, edge, reverse, seed_of(seed, name))
            target.write_text(text, encoding="utf-8", newline="\n")
            way = ", back through it" if reverse else ""
            rows.append((name, f"{text.count(chr(10)) - 1} readings of `{edge}`{way}"))
    return rows


@one_thread()
def make(path: Path, out: Path) -> Path:
    """Record the dataset of a recipe file into ``out/<its stem>`` (replaced when whole); returns
    that folder.

    Raises:
        InputError: the recipe, its bench or rig is wrong, or a limit stopped a log."""
    recipe = load_recipe(path)
    if not isinstance(recipe, DatasetRecipe):
        raise InputError(
            "is no dataset recipe", file=path, hint='a dataset recipe has stage = "dataset"'
        )
    bench = load_recipe(recipe.file(recipe.bench))
    if not isinstance(bench, BenchRecipe):
        raise InputError(
            "is no bench file", file=bench.path, hint='a bench file has stage = "bench"'
        )
    rig = load_rig(bench.file(bench.rig))
    final, scratch = out / recipe.name, out / f".{recipe.name}.part"
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    try:
        rows = []
        if recipe.flowmeter is not None:
            rows += _readings(VirtualMachine(rig, bench), recipe.flowmeter, recipe.seed, scratch)
        for item in recipe.log:
            _log(recipe, rig, item, scratch / f"{item.name}.mcap")
            facts = [
                f"{float(item.duration):g} s at {float(item.rate):g} Hz",
                f"payload {item.payload or 'none'}",
            ]
            posture = ", ".join(f"{name} {value}" for name, value in item.posture.items())
            rows.append(
                (
                    f"{item.name}.mcap",
                    "; ".join([item.title, *facts, f"from {posture or 'mid-stroke'}"]),
                )
            )
        (scratch / "README.md").write_text(
            _readme(recipe, rig, rows), encoding="utf-8", newline="\n"
        )
        if final.exists():
            shutil.rmtree(final)
        scratch.rename(final)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return final


def _readme(recipe: DatasetRecipe, rig: Rig, rows: list[tuple[str, str]]) -> str:
    table = "\n".join(f"| `{name}` | {what} |" for name, what in rows)
    note = f"\n{recipe.note.strip()}\n" if recipe.note else ""
    return (
        f"# {rig.title or rig.name}: recorded on the virtual bench, not a measurement\n\n"
        "A simulated machine, richer than the model that is fitted to it, recorded this: "
        "air in the oil, leakage, Stribeck friction,\n"
        "valves of which no two are alike, hysteresis, a pump that droops, "
        "sensors with noise, steps, lag and delay.\n"
        f"{note}\n| file | what |\n| --- | --- |\n{table}\n\n"
        "`make datasets` records it again, byte for byte, "
        f"from `recipes/datasets/{recipe.path.name}` (seed {recipe.seed}) and the bench\n"
        "file that it names.\n"
    )


def main(arguments: list[str] | None = None) -> int:
    """Record the named datasets, or all of them; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.datasets", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("names", nargs="*", help="datasets to record; all by default")
    parser.add_argument(
        "--recipes",
        type=Path,
        default=Path("recipes/datasets"),
        help="folder of the dataset recipes",
    )
    parser.add_argument("--out", type=Path, default=Path("datasets"), help="folder of the datasets")
    given = parser.parse_args(arguments)
    try:
        there = sorted(path.stem for path in given.recipes.glob("*.toml"))
        for name in given.names or there:
            if name not in there:
                raise InputError(
                    f"there is no dataset '{name}'", hint="there are " + ", ".join(there)
                )
            print(make(given.recipes / f"{name}.toml", given.out))
    except EhbenchError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
