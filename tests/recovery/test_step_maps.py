"""Flow maps from step logs without a flowmeter, also where chambers ring and leak."""

import numpy as np
import pytest

from ehbench import workflow
from ehbench.config.recipe import load_recipe
from ehbench.data.logs import write_log
from ehbench.data.record import Record
from ehbench.flow_maps.step_readings import step_readings
from ehbench.flow_maps.tables import fit_edge, prepare_readings
from ehbench.machines.virtual import VirtualMachine
from ehbench.parts.edge import edge_flow
from ehbench.plant.model import Model, simulate
from ehbench.vocabulary.errors import InputError, InsufficientData
from tests.shared import RIGS, shipped
from tools import datasets
from tools.virtual_logs import noisy

LEVELS = [1.5, 2.0, 2.5, 3.0, 4.0, 5.0]
LEAKS = {"boom.leakage_internal": 2e-12, "boom.leakage_head": 1e-12}


@pytest.fixture(scope="module")
def rig():
    return shipped("boom_four_valve").with_values(LEAKS)


def steps(rig, seed):
    """The boom stepped out through `sh` and `rt`, at levels of their own, and back at one."""
    order = np.random.default_rng(seed)
    t = np.arange(int(1000 * (0.3 + 1.2 * len(LEVELS))) + 1) * 1e-3
    commands = {f"boom.{valve}": np.zeros_like(t) for valve in ("sh", "rt", "sr", "ht")}
    pairs = zip(order.permutation(LEVELS), order.permutation(LEVELS), strict=True)
    for at, (inlet, outlet) in zip(0.3 + 1.2 * np.arange(len(LEVELS)), pairs, strict=True):
        out, back = (t >= at) & (t < at + 0.6), (t >= at + 0.6) & (t < at + 1.2)
        commands["boom.sh"][out], commands["boom.rt"][out] = inlet, outlet
        commands["boom.sr"][back], commands["boom.ht"][back] = 3.0, 3.0
    load = [None, "bucket"][seed % 2]
    return noisy(
        simulate(rig, commands, t[-1], posture={"boom": "250 mm"}, payload=load), seed, load
    )


@pytest.fixture(scope="module")
def logs(rig):
    return [steps(rig, seed) for seed in range(2)]


def true_flow(model, name, drop, command):
    edge = model.plant.edges[model.layout.edges.index(name)]
    pairs = zip(np.ravel(drop), np.ravel(command), strict=True)
    flows = [edge_flow(one, edge.sign * volts, edge, model.plant.maps) for one, volts in pairs]
    return np.reshape(flows, np.shape(drop))


def test_a_map_from_steps_holds_the_edge_s_law(rig, logs):
    model = Model.of(rig)
    parts = [step_readings(f"log {i}", log, model, 0.2, 0.1) for i, log in enumerate(logs)]
    for part in parts:
        for edge, way in part.groups():
            rows = part.select(edge, way)
            left = rows.flow - true_flow(model, edge, rows.pressure_drop, rows.command)
            # the speed's noise alone is 0.02 L/min; the chamber's compression is up to 3 L/min
            assert np.sqrt(np.mean(left**2)) < 0.05e-3 / 60.0
    rows = [part.select("boom.rt") for part in parts]
    (edge,) = prepare_readings(rig, rows).edges
    fit = fit_edge(rig, edge).map
    drop, command = np.meshgrid(np.linspace(1e6, 15e6, 30), np.linspace(1.5, 5.0, 30))
    inside = fit.inside(drop, command)
    left = (fit.flow(drop, command) - true_flow(model, "boom.rt", drop, command))[inside]
    assert inside.sum() > 100  # of 900
    assert np.mean(np.abs(left) < 1.96 * fit.flow_std(drop, command)[inside]) > 0.9
    assert np.max(fit.flow_std(drop, command)[inside]) < 0.02 * fit.rated_flow


def test_a_recipe_maps_what_the_logs_step(rig, logs, undrawn, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kept = [name for name in logs[0].channels if name not in ("boom.v", "boom.qd")]
    for i, log in enumerate(logs):
        write_log(tmp_path / f"steps{i}.mcap", Record(log.t, {n: log[n] for n in kept}, log.meta))
    recipe = tmp_path / "maps.toml"
    recipe.write_text(
        f'stage = "identify"\nwhat = "flow_map"\nmethod = "steps"\nspan = "150 ms"\n'
        f'rig = "{RIGS}/boom_four_valve.toml"\ndata = ["steps0.mcap", "steps1.mcap"]\n'
    )
    made = workflow.run(recipe)
    maps = made.flow_maps
    assert maps is not None and set(maps) == {"rt", "sh"}
    assert any("no map of sr" in note for note in made.notes)  # stepped at one command
    assert maps["sh"].flow(9e6, 3.0) == pytest.approx(
        true_flow(Model.of(rig), "boom.sh", [9e6], [3.0])[0], rel=0.03
    )


def test_logs_that_tell_no_flow_are_refused(rig, logs):
    log = logs[0]
    short = Record(log.t[:400], {name: y[:400] for name, y in log.channels.items()}, log.meta)
    with pytest.raises(InsufficientData, match="nowhere do the commands stand"):
        step_readings("log", short, Model.of(rig), 0.2, 0.1)


def recorded(folder, seed):
    """What a virtual bench records of the boom stepped out through `sh` and `rt`, and the bench."""
    told = [f'stage = "dataset"\nbench = "bench.toml"\nseed = {seed}']
    (folder / "bench.toml").write_text(
        f'stage = "bench"\nrig = "{RIGS}/boom_four_valve.toml"\nseed = {seed}\n'
    )
    for index, load in enumerate(('payload = "bucket"', "")):
        order = np.random.default_rng(index)
        told.append(
            f'[[log]]\nname = "s{index}"\ntitle = "s"\nposture = {{ boom = "200 mm" }}\n{load}\n'
            'duration = "9 s"\nlimits = { stroke_margin = "1 mm", pressure_max = "400 bar" }'
        )
        levels = zip(order.permutation(LEVELS), order.permutation(LEVELS), strict=True)
        for k, (inlet, outlet) in enumerate(levels):
            for at, valves in (
                (0.3 + 1.4 * k, {"sh": inlet, "rt": outlet}),
                (1.0 + 1.4 * k, {"sr": 2.5, "ht": 2.5}),
            ):
                told += [
                    f'[[log.command]]\nvalve = "boom.{valve}"\nkind = "step"\n'
                    f'amplitude = "{volts} V"\nstart = "{at:.2f} s"\nstop = "{at + 0.6:.2f} s"'
                    for valve, volts in valves.items()
                ]
    (folder / "d.toml").write_text("\n".join(told) + "\n")
    made = datasets.make(folder / "d.toml", folder)
    bench = VirtualMachine(shipped("boom_four_valve"), load_recipe(folder / "bench.toml"))
    return [str(made / f"s{index}.mcap") for index in range(2)], bench


@pytest.mark.parametrize("key", ["pressure_error", "command_error"])
def test_a_standard_error_is_not_negative(key, tmp_path):
    unit = {"pressure_error": "bar", "command_error": "V"}[key]
    recipe = tmp_path / "r.toml"
    recipe.write_text(
        f'stage = "identify"\nwhat = "flow_map"\nmethod = "steps"\nrig = "r.toml"\n'
        f'data = ["a.csv"]\n{key} = "-0.1 {unit}"\n'
    )
    with pytest.raises(InputError, match=key) as raised:
        load_recipe(recipe)
    assert "outside" in str(raised.value) and raised.value.line == 6


@pytest.mark.slow
def test_a_map_from_steps_holds_what_a_virtual_bench_passes(undrawn, tmp_path):
    """With air, leakage, hysteresis and sensors of its own, none of which the rig file has."""
    names, bench = recorded(tmp_path, 2)
    head = (
        f'stage = "identify"\nwhat = "flow_map"\nmethod = "steps"\n'
        f'rig = "{RIGS}/boom_four_valve.toml"\ndata = {names}\n'.replace("'", '"')
    )
    told = {"as it is": "", "sure": 'pressure_error = "0 bar"\ncommand_error = "0 V"\n'}
    held = {}
    for name, more in told.items():
        recipe = tmp_path / f"{name.replace(' ', '_')}.toml"
        recipe.write_text(head + more)
        maps = workflow.run(recipe, workflow.Session(root=tmp_path / "runs")).flow_maps
        drop, command = np.meshgrid(np.linspace(1e6, 15e6, 30), np.linspace(1.5, 5.0, 30))
        hits = []
        for edge in ("sh", "rt"):
            inside = maps[edge].inside(drop, command)
            at = drop[inside], command[inside]
            left = np.abs(maps[edge].flow(*at) - bench.static_flow(f"boom.{edge}", *at[::-1]))
            hits += list(left < 1.96 * maps[edge].flow_std(*at))
            assert np.median(maps[edge].flow_std(*at) / maps[edge].flow(*at)) < 0.02
        held[name] = np.mean(hits)
    assert held["as it is"] >= 0.92 > held["sure"], held
