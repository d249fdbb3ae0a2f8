"""Stored numbers of every method: results that change need a new version of their method, and files
that change need a new schema of their stage (`ehbench/runs/versions.py`).

After such a change:  python -m tests.unit.test_versions"""

import hashlib
import json
import math
import tempfile
from pathlib import Path

import numpy as np
import pytest

from ehbench import workflow
from ehbench.runs import versions
from ehbench.runs.versions import METHODS, Versions
from tests.shared import ROOT

STORED = Path(__file__).with_name("versions.json")
RIG = ROOT / "recipes" / "rigs" / "slide_servo.toml"
RECIPES = {
    "flow_map": f"""stage = "identify"
        what = "flow_map"
        rig = "{ROOT}/recipes/rigs/boom_four_valve.toml"
        data = ["{ROOT}/datasets/boom_four_valve/flowmeter/sh.csv"]""",
    "matching": f"""stage = "identify"
        what = "hydraulics"
        method = "thesis"
        rig = "{RIG}"
        data = ["{ROOT}/datasets/slide_servo/steps/press_no_load.mcap"]
        parameters = ["bulk_modulus"]""",
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
SHIPPED = ("hydraulics", "validation", "response", "tuning", "arc_tuning")


def runs(root: Path) -> dict[str, Path]:
    """Run folders by name."""
    session, folders = workflow.Session(root=root, keep=True), {}
    for name, text in RECIPES.items():
        (root / f"{name}.toml").write_text(text)
        folders[name] = workflow.run(root / f"{name}.toml", session).folder
    for name in SHIPPED:
        recipe = ROOT / "recipes" / "slide_servo" / f"{name}.toml"
        folders[name] = workflow.run(recipe, session).folder
    return folders


def numbers_of(runs: dict[str, Path]) -> dict[str, dict[str, float]]:
    """By method, a few of its results."""
    from ehbench import load_rig, read_log, simulate

    def saved(name: str, file: str):
        return json.loads((runs[name] / file).read_text())

    log = simulate(load_rig(RIG), {"press.servo": 2.0}, duration=0.2)
    recorded = read_log(ROOT / "datasets" / "slide_servo" / "steps" / "press_100kg.mcap")
    bench = read_log(runs["trial"] / "log.mcap")
    trial, study = saved("trial", "trial.json"), saved("study", "study.json")
    fits = {name: saved(name, "parameters.json") for name in ("hydraulics", "matching")}
    return {  # pyright: ignore[reportReturnType]
        "logs": {name: float(np.std(values)) for name, values in recorded.items()},
        "plant": {name: float(values[-1]) for name, values in log.channels.items()},
        "bench": {name: float(np.std(values)) for name, values in bench.items()},
        "flow_maps": leaves(saved("flow_map", "summary.json")),
        "output_error": leaves(fits["hydraulics"]["parameters"]),
        "log_decrement": leaves(fits["matching"]["parameters"]),
        "frequency_response": leaves(saved("response", "response.json")),
        "validation": leaves(saved("validation", "validation.json")),
        "diagnosis": leaves(saved("validation", "validation.json")["structure"]),
        "control": {"command": float(np.std(bench["press.servo.command"]))},
        "trial": leaves(trial["measures"]),
        "ledger": leaves(saved("trial", "ledger.json")),
        "tuning": leaves(saved("tuning", "tuning.json"))
        | {f"arc {k}": v for k, v in leaves(saved("arc_tuning", "tuning.json")).items()},
        "sampling": leaves(study["measures"]),
    }


def leaves(value) -> dict[str, float]:
    """The sum of all numbers under each key, by the name of the row that they belong to."""
    sums: dict[str, float] = {}

    def add(item, key: str, row: str = "") -> None:
        if _is_message(item):
            return
        if isinstance(item, dict):
            row = item.get("name") or row
            for name, inner in item.items():
                add(inner, f"{row} {name}".strip(), row)
        elif isinstance(item, list):
            for inner in item:
                add(inner, key, row)
        elif isinstance(item, int | float) and math.isfinite(item):
            sums[key] = sums.get(key, 0.0) + abs(item)

    add(value, "")
    return {name: float(f"{number:.9g}") for name, number in sums.items()}


def _is_message(item) -> bool:
    """Whether a value of a file is a message, which may be put in other words."""
    return isinstance(item, dict) and set(item) == {"key", "text", "fields"}


def schemas_of(runs: dict[str, Path]) -> dict[str, dict[str, str]]:
    """By stage, the names of its files with a digest over the keys in each."""
    names = {"matching": None, "tuning": "tuning", "arc_tuning": "arc_tuning"}
    schemas = {}
    for name, folder in runs.items():
        if (stage := names.get(name, name)) is not None:
            schemas[stage] = {
                path.name: _keys(path) for path in sorted(folder.iterdir()) if path.is_file()
            }
    return schemas


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


pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folders(made_once) -> dict[str, Path]:
    root = made_once("versions", runs)
    return {name: next(root.glob(f"{name}_*")) for name in (*RECIPES, *SHIPPED)}


def test_results_and_files_change_only_with_their_versions(folders):
    stored, numbers = json.loads(STORED.read_text()), numbers_of(folders)
    assert set(numbers) == set(METHODS)
    for method, version in METHODS.items():
        about = f"results of '{method}' changed: raise its version and store them anew"
        assert stored["methods"][method]["version"] == version, "store the results anew"
        # optimisers stop at 1e-8 of their cost, linear algebra differs from machine to machine
        expected = pytest.approx(stored["methods"][method]["numbers"], rel=1e-4, abs=1e-12)
        assert numbers[method] == expected, about
    stored = json.loads(STORED.read_text())["stages"]
    for stage, files in schemas_of(folders).items():
        about = f"files of '{stage}' changed: raise its schema and store them anew"
        assert stored[stage]["schema"] == Versions.of(stage).schema, "store the files anew"
        assert stored[stage]["files"] == files, about


def test_every_stage_that_leaves_a_run_has_versions():
    from ehbench import stages
    from ehbench.stages.base import Stage

    names = {stage.name for stage in stages.REGISTRY.values() if isinstance(stage, Stage)}
    assert names - {"campaign"} <= set(versions.STAGES)


def store() -> None:
    """Write the numbers of this version."""
    with tempfile.TemporaryDirectory() as folder:
        made = runs(Path(folder))
        numbers, schemas = numbers_of(made), schemas_of(made)
    methods = {
        method: {"version": version, "numbers": numbers[method]}
        for method, version in METHODS.items()
    }
    stages = {
        stage: {"schema": Versions.of(stage).schema, "files": files}
        for stage, files in schemas.items()
    }
    text = json.dumps({"methods": methods, "stages": stages}, indent=1)
    STORED.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    store()
