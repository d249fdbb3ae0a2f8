"""Stored numbers of every method: results that change need a new version of their method, and files
that change need a new schema of their stage (`ehbench/runs/versions.py`).

After such a change:  python -m tests.unit.test_versions"""

import hashlib
import json
import math
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ehbench import load_rig, read_log, simulate, workflow
from ehbench.flow_maps.readings import FlowMapOptions, readings_table
from ehbench.flow_maps.results import fit_flow_map
from ehbench.flow_maps.step_readings import step_readings
from ehbench.plant.model import Model
from ehbench.runs import rundir, versions
from ehbench.runs.versions import METHODS, Versions
from tests import valve_laws as laws
from tests.shared import ROOT, shipped

STORED = Path(__file__).with_name("versions.json")
RIG = ROOT / "recipes" / "rigs" / "slide_servo.toml"
LACKING = ("press", "loader")  # machines whose first models lack something
RECIPES = {
    "flow_map": f"""stage = "identify"
        what = "flow_map"
        rig = "{ROOT}/recipes/rigs/boom_four_valve.toml"
        data = ["{ROOT}/datasets/boom_four_valve/flowmeter/sh.csv"]""",
    "matching": f"""stage = "identify"
        what = "hydraulics"
        method = "thesis"
        rig = "{RIG}"
        data = ["{ROOT}/datasets/slide_servo/steps/press_no_load.mcap",
                "{ROOT}/datasets/slide_servo/steps/press_100kg.mcap"]
        parameters = ["bulk_modulus", "carriage.damping"]""",
    "sensors": f"""stage = "identify"
        what = "hydraulics"
        rig = "{RIG}"
        data = ["{ROOT}/datasets/slide_servo/steps/press_100kg.mcap"]
        parameters = ["bulk_modulus", "carriage.damping", "carriage.mass",
                      "press.leakage_internal", "spool.natural_frequency"]
        sensor = [
            {{ channel = "press.p_head", offset = "estimate" }},
            {{ channel = "press.v", lag = "estimate" }},
        ]""",
    "prior": f"""stage = "identify"
        what = "hydraulics"
        rig = "{ROOT}/recipes/rigs/crane_proportional.toml"
        data = ["{ROOT}/datasets/crane_proportional/steps/lift_no_load.mcap",
                "{ROOT}/datasets/crane_proportional/steps/lift_200kg.mcap"]
        parameters = ["bulk_modulus", "arm.joint_damping", "arm.mass", "lift.friction_coulomb",
                      "lift.spool_pa.flow_gain", "lift.spool_pa.deadband"]
        prior = {{ "arm.mass" = "3 %" }}
        decimate = 2
        cutoff = "60 Hz"
        sensor = [
            {{ channel = "lift.p_rod", offset = "estimate", per_log = true }},
            {{ channel = "lift.qd", lag = "estimate" }},
        ]""",
    "lift": f"""stage = "identify"
        what = "hydraulics"
        rig = "{ROOT}/recipes/rigs/pump_cylinder.toml"
        data = ["{ROOT}/datasets/pump_cylinder/steps/lift_150kg.mcap"]
        parameters = ["bulk_modulus", "table.damping", "lift.pump.slip"]""",
    "boom": f"""stage = "identify"
        what = "hydraulics"
        rig = "{ROOT}/recipes/rigs/boom_four_valve.toml"
        data = ["{ROOT}/datasets/boom_four_valve/steps/boom_bucket.mcap"]
        parameters = ["bulk_modulus", "boom.joint_damping", "boom.friction_coulomb"]
        start = {{ bulk_modulus = "1500 MPa" }}""",
    "band": f"""stage = "identify"
        what = "hydraulics"
        rig = "{RIG}"
        data = ["{ROOT}/datasets/slide_servo/steps/press_no_load.mcap"]
        parameters = ["bulk_modulus", "carriage.damping"]
        response = {{ input = "press.servo.command", coherence_min = 0.5 }}""",
    "tuning_boom": f"""stage = "tune"
        rig = "{ROOT}/recipes/rigs/boom_four_valve.toml"
        payloads = ["bucket"]
        postures = 1
        speed_shares = [0.4]
        damping_ratio = "0.2"
        delay = "2 ms"
        one_gain = false
        draws = 0""",
    "tuning_stick": f"""stage = "tune"
        rig = "{ROOT}/recipes/rigs/thesis_arm.toml"
        cylinder = "stick"
        payloads = ["none"]
        postures = 2
        speed_shares = [0.4]
        draws = 3""",
    "tuning": f"""stage = "tune"
        rig = "{ROOT}/recipes/slide_servo/validation.toml"
        payloads = ["none"]
        postures = 1
        speed_shares = [0.3]
        damping_ratio = "0.15"
        draws = 3""",
    "arc_tuning": f"""stage = "tune"
        what = "arc"
        rig = "{ROOT}/recipes/rigs/boom_four_valve.toml"
        payloads = ["none"]
        postures = 1
        speed_shares = [0.2]
        delay = "1 ms"
        delay_margin = "3 ms" """,
    **{
        name: f"""stage = "validate"
            rig = "{ROOT}/recipes/{name}/first.toml"
            columns = "{ROOT}/recipes/{name}/daq.map.toml"
            data = ["{ROOT}/recipes/{name}/run_3.csv"]"""
        for name in LACKING
    },
    "plain": f"""stage = "validate"
        rig = "{ROOT}/recipes/rigs/boom_four_valve.toml"
        data = ["{ROOT}/datasets/boom_four_valve/heldout/boom_no_load.mcap"]""",
    **{
        f"wrong_{name}": f"""stage = "validate"
            rig = "{ROOT}/recipes/rigs/{name}.toml"
            data = ["{ROOT}/datasets/{name}/heldout/{log}.mcap"]
            channels = ["{word}", "p_head", "p_rod", "{place}"]
            [thresholds]
            max_error = {{ p_head = "3 bar" }}
            damping_ratio_error = 0.3
            whiteness = true
            independence = true"""
        for name, log, word, place in (
            ("slide_servo", "press_no_load", "v", "x"),
            ("crane_proportional", "lift_no_load", "qd", "q"),
            ("pump_cylinder", "lift_no_load", "v", "x"),
        )
    },
    "trial": f"""stage = "trial"
        rig = "{RIG}"
        on = "bench"
        bench = "{ROOT}/recipes/bench/slide_servo.toml"
        posture = {{ press = "200 mm" }}
        [motion]
        kind = "point_to_point"
        waypoints = ["200 mm", "230 mm"]
        speed = "60 mm/s"
        [controller]
        kind = "position"
        gains = {{ integral_bandwidth = "0.8 rad/s" }}""",
    "study": """stage = "study"
        recipe = "trial.toml"
        samples = 4
        measures = [{ name = "largest error", result = "tracking.max_error" }]
        [draw]
        "rig.bulk_modulus" = { low = 0.5, high = 1.5, relative = true }""",
}
FEW = {"drops": laws.DROPS[::2], "commands": laws.COMMANDS[::2], "trials": 2}
STEPS = {"sh": (3.0, 0.0), "rt": (4.0, 0.0), "sr": (0.0, 3.0), "ht": (0.0, 2.0)}  # [V], in turns
VALVES = {
    "levels off": lambda: laws.readings(laws.compensated, 1, **FEW),
    "kink along the drop": lambda: laws.kinked_readings(1, range(11), range(5, 150, 20), 2),
    "no repeats": lambda: laws.kinked_readings(2, range(11), range(5, 150, 20), 1),
    "kink in the opening": lambda: laws.readings(
        laws.kinked_opening(4.43, 4.0), 102, **FEW | {"commands": np.arange(11.0)}
    ),
    "soft start": lambda: laws.readings(laws.soft, 1, **FEW),
    "hysteresis": lambda: laws.swept(laws.poppet, 1, 0.1, laws.COMMANDS[::2]),
    "shift": lambda: laws.readings(laws.pressed, 4, drops=laws.DROPS[1::3], trials=2),
    "lack of fit": lambda: laws.readings(laws.pressed, 4, **FEW | {"trials": 3}),
    "leak": lambda: laws.readings(laws.leaky(True), 40, **FEW),
    "leak that ends": lambda: laws.readings(laws.leaky(False), 40, **FEW),
    "falls": lambda: laws.readings(laws.hump, 51, **FEW | {"commands": laws.COMMANDS[1::2]}),
    "no drop": lambda: without_drop(laws.readings(laws.poppet, 70, drops=laws.DROPS[6:7])),
    "outliers": lambda: with_outliers(laws.readings(laws.compensated, 5, **FEW)),
}
SHIPPED = ("hydraulics", "validation", "response")
RUNS = (*RECIPES, *SHIPPED)
NO_RUN = "library"
NUMBER = re.compile(r"\d+\.?\d*(?:e[-+]?\d+)?")


def made(root: Path, name: str) -> Path:
    """The folder of a run, after those that it needs."""
    session = workflow.Session(root=root, keep=True, unvalidated=True)
    recipe = ROOT / "recipes" / "slide_servo" / f"{name}.toml"
    if name in RECIPES:
        for other, text in RECIPES.items():
            (root / f"{other}.toml").write_text(text)
        recipe = root / f"{name}.toml"
    return workflow.run(recipe, session).folder


def numbers_of(name: str, folder: Path) -> dict[str, dict[str, float]]:
    """By method, a few of the results of a run."""

    def saved(file: str, *keys: str, folder: Path = folder) -> dict[str, float]:
        value = json.loads((folder / file).read_text())
        for key in keys:
            value = value[key]
        return leaves(value)

    def fitted(folder: Path = folder) -> dict[str, dict[str, float]]:
        parts = ("parameters", "sensors", "leans", "scales", "warnings", "counts_on", "left_over")
        parts += ("logs", "groups")
        numbers = {part: saved("parameters.json", part, folder=folder) for part in parts}
        return {
            "output_error": {
                f"{part} {key}": value
                for part, values in numbers.items()
                for key, value in values.items()
            }
        }

    def judged() -> dict[str, dict[str, float]]:
        return {
            "validation": saved("validation.json"),
            "diagnosis": saved("validation.json", "structure"),
        }

    if name == "trial":
        bench = read_log(folder / "log.mcap")
        return {
            "bench": {str(name): float(np.std(values)) for name, values in bench.items()},
            "control": {"command": float(np.std(bench["press.servo.command"]))},
            "trial": saved("trial.json", "measures"),
            "ledger": saved("ledger.json"),
        }
    if name in ("hydraulics", "sensors", "prior", "lift", "boom", "band"):
        return fitted()
    if name in LACKING:
        return judged() | fitted(next(folder.parent.glob("first_*")))
    if name == "validation" or name.startswith(("wrong", "plain")):
        return judged()
    if "tuning" in name or name.startswith("arc"):
        return {"tuning": saved("tuning.json")}
    return {
        "flow_map": lambda: {"flow_maps": saved("summary.json")},
        "matching": lambda: {
            "log_decrement": saved("parameters.json", "parameters")
            | saved("parameters.json", "matches")
        },
        "study": lambda: {"sampling": saved("study.json", "measures")},
        "response": lambda: {"frequency_response": saved("response.json")},
    }[name]()


def with_outliers(data):
    """Some readings a fifth high, and a cell of which all are."""
    far = (np.arange(data["flow"].size) % 37 == 5) | (
        (data["command"] == 5.0) & (abs(data["pressure_drop"] - 1e6) < 5e5)
    )
    return data | {"flow": np.where(far, 1.2, 1.0) * data["flow"]}


def without_drop(data):
    """Speeds of a cylinder by the command alone."""
    nothing = np.full(data["flow"].size, np.nan)
    return data | {"pressure_drop": nothing, "method": np.full(nothing.size, "cylinder")}


def numbers_of_a_map(name: str) -> dict[str, dict[str, float]]:
    """All that is said of a flow map."""
    options = FlowMapOptions(
        drop_std=4e4, command_std=0.02, nominal_drop=7e6, calibration=((5.0, 1e-4, 0.1),)
    )
    fit = fit_flow_map("v", "forward", readings_table(**VALVES[name]()), options)
    said = fit.to_dict() | {"map": fit.map.to_dict()}
    return {"flow_maps": leaves(rundir.plain(said))}


def numbers_without_a_run() -> dict[str, dict[str, float]]:
    """Of a log that is read, one that is simulated, and one whose steps are readings of flow."""
    log = simulate(load_rig(RIG), {"press.servo": 2.0}, duration=0.2)
    boom, t = shipped("boom_four_valve"), np.arange(1601) * 1e-3
    ways = np.select([t < 0.2, t < 0.9], [0, 1], 2)
    steps = {f"boom.{v}": np.array([0.0, *u])[ways] for v, u in STEPS.items()}
    stepped = simulate(boom, steps, float(t[-1]), posture={"boom": "250 mm"})
    readings = step_readings("log", stepped, Model.of(boom), 0.2, 0.1)
    recorded = read_log(ROOT / "datasets" / "slide_servo" / "steps" / "press_100kg.mcap")
    return {
        "logs": {str(name): float(np.std(values)) for name, values in recorded.items()},
        "plant": {name: float(values[-1]) for name, values in log.channels.items()},
        "flow_maps": {
            f"{valve} {way} {word}": float(np.sum(getattr(readings.select(valve, way), word)))
            for valve, way in readings.groups()
            for word in ("command", "pressure_drop", "flow", "line")
        },
    }


def leaves(value) -> dict[str, float]:
    """The sum of all numbers under each key, by the name of the row that they belong to, or the
    message; how a message is put counts for nothing."""
    sums: dict[str, float] = {}

    def add(item, key: str, row: Any = "") -> None:
        if _is_message(item):
            row, item = item["key"], {k: _said(v) for k, v in item["fields"].items()}
        if isinstance(item, dict):
            row = next((item[k] for k in ("name", "kind", "channel") if item.get(k)), row)
            for name, inner in item.items():
                add(inner, f"{row} {name}".strip(), row)
        elif isinstance(item, list):
            for inner in item:
                add(inner, key, row)
        elif isinstance(item, int | float) and math.isfinite(item):
            sums[key] = sums.get(key, 0.0) + abs(item)

    add(value, "")
    return {name: float(f"{number:.9g}") for name, number in sums.items()}


def _said(value):
    """A value of a message, or the numbers in its text."""
    return [float(x) for x in NUMBER.findall(value)] if isinstance(value, str) else value


def _is_message(item) -> bool:
    """Whether a value of a file is a message, which may be put in other words."""
    return isinstance(item, dict) and set(item) == {"key", "text", "fields"}


def files_of(folder: Path) -> dict[str, str]:
    """The files of a run with a digest over the keys in each."""
    return {path.name: _keys(path) for path in sorted(folder.iterdir()) if path.is_file()}


def _keys(path: Path) -> str:
    if path.suffix != ".json" or path.name == "volatile.json":
        return ""
    keys: set[str] = set()

    def add(item) -> None:
        if _is_message(item):
            return
        if isinstance(item, dict):
            keys.update(map(str, item))
            item = list(item.values())
        for inner in item if isinstance(item, list) else ():
            add(inner)

    add(json.loads(path.read_text()))
    return hashlib.sha256("\n".join(sorted(keys)).encode()).hexdigest()[:8]


def agree(name: str, numbers: dict[str, dict[str, float]]) -> None:
    """Fail unless numbers are those that are stored of the versions of today."""
    stored = json.loads(STORED.read_text())
    assert set(numbers) == set(stored["numbers"][name])
    for method, values in numbers.items():
        about = f"results of '{method}' changed: raise its version and store them anew"
        assert stored["methods"][method] == METHODS[method], "store the results anew"
        # optimisers stop at 1e-8 of their cost, linear algebra differs from machine to machine
        expected = pytest.approx(stored["numbers"][name][method], rel=1e-4, abs=1e-12)
        assert values == expected, about


def test_logs_and_plant_change_only_with_their_versions():
    agree(NO_RUN, numbers_without_a_run())


@pytest.mark.parametrize("name", VALVES)
def test_maps_change_only_with_their_version(name):
    agree(name, numbers_of_a_map(name))


@pytest.mark.parametrize("name", RUNS)
def test_results_and_files_change_only_with_their_versions(made_once, slide_runs, request, name):
    request.getfixturevalue("unpainted" if name in versions.STAGES else "undrawn")

    def fill(root):
        shutil.copytree(slide_runs, root, dirs_exist_ok=True)  # some need its validated rig
        made(root, name)

    of_campaign = name in ("hydraulics", "validation")
    root = slide_runs if of_campaign else made_once(f"v_{name}", fill)
    folder = next(path for path in root.glob(f"{name}_*") if path.is_dir())
    agree(name, numbers_of(name, folder))
    if name in versions.STAGES:
        stored = json.loads(STORED.read_text())["files"][name]
        about = f"files of '{name}' changed: raise its schema and store them anew"
        assert stored["schema"] == Versions.of(name).schema, "store the files anew"
        assert stored["names"] == files_of(folder), about


def test_every_method_has_numbers():
    stored = json.loads(STORED.read_text())
    assert set(METHODS) == {method for item in stored["numbers"].values() for method in item}


def test_every_stage_that_leaves_a_run_has_versions():
    from ehbench.config.recipe import recipe_kinds
    from ehbench.stages import stage_of

    every = map(stage_of, recipe_kinds().values())
    names = {stage.name for stage in every if stage.command}
    assert names - {"campaign"} <= set(versions.STAGES)


def store() -> None:
    """Write the numbers of this version."""
    numbers = {NO_RUN: numbers_without_a_run()} | {v: numbers_of_a_map(v) for v in VALVES}
    files = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in RUNS:
            (root := Path(folder) / name).mkdir()  # as in the tests: others have a `first` too
            run = made(root, name)
            numbers[name] = numbers_of(name, run)
            if name in versions.STAGES:
                files[name] = {"schema": Versions.of(name).schema, "names": files_of(run)}
    table = {"methods": dict(METHODS), "numbers": numbers, "files": files}
    STORED.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    store()
