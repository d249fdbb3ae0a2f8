"""Steps chosen by the guard: at the error of fixed ones, fewer of them, the same each time."""

import math

import numpy as np
import pytest

from ehbench.config.rig import Rig
from ehbench.plant.integrate import STEP
from ehbench.plant.many import Replay, map_threads, replay_many
from ehbench.plant.model import Model
from ehbench.plant.paced import AUTO, CLOSE, Step, pace_of
from ehbench.vocabulary.errors import SimulationError
from tests.shared import RIGS, shipped

SHIPPED = [path.stem for path in sorted(RIGS.glob("*.toml"))]
FINE = STEP / 8.0
ERROR = 2.0e-5  # share of a state's range, which counts as no less than SMALL of its scale
SMALL = 0.02


LUGRE = {"law": "lugre", "friction_static": "400 N", "stribeck_speed": "20 mm/s"}
LUGRE |= {"bristle_stiffness": "2 kN/mm", "bristle_damping": "4 kN*s/m"}
SOFT = {"friction_coulomb": "200 N", "friction_viscous": "400 N*s/m", "friction": LUGRE}
SOFT |= {"mount": {"stiffness": "10 kN/mm", "damping": "6000 N*s/m"}}
# of the sliding mass, with parts that are stiff, and with a command that is late
PARTS = {"bristles on a mount": SOFT, "late series": {}}
LATE = {"bus": {"kind": "delay", "delay": "5.3 ms"}, "lag": {"kind": "first_order", "lag": "6 ms"}}
LATE |= {"spool": {"natural_frequency": "80 Hz", "damping_ratio": 0.8}}


def made(name: str) -> Model:
    """A shipped rig, or the sliding mass with one of PARTS."""
    if name not in PARTS:
        return Model.of(shipped(name))
    plain = shipped("slide_servo").as_toml()
    (cylinder,) = plain["cylinder"]
    if name == "late series":
        (valve,) = cylinder["valve"]
        plain["dynamics"], cylinder["valve"] = LATE, [valve | {"dynamics": list(LATE)}]
    return Model.of(Rig.model_validate(plain | {"cylinder": [cylinder | PARTS[name]]}))


def commands(model: Model, samples: int = 1500, smooth: bool = False) -> np.ndarray:
    """A pulse of every valve at random, or half a wave of it."""
    rng, table = np.random.default_rng(samples), model.rest_commands(samples)
    for index, valve in enumerate(model.plant.valves):
        first, last = (rng.uniform([0.05, 0.5], [0.4, 0.9]) * samples).astype(int)
        end = valve.highest if rng.random() < 0.5 or valve.lowest >= valve.before else valve.lowest
        shape = np.sin(np.linspace(0.0, np.pi, last - first)) if smooth else 1.0
        table[first:last, index] += rng.uniform(0.15, 0.4) * (end - valve.before) * shape
    return table


def missed(model: Model, table: np.ndarray, step: Step, tick: float = 1e-3) -> np.ndarray:
    """The largest error of each state whose error is looked at, as a share of its range."""
    start = model.trim(model.posture(None))
    looked = pace_of(model.plant, model.layout, tick).weights
    fine, found = (model.run(start, table, tick, one)[:, : start.size] for one in (FINE, step))
    scale = SMALL / (CLOSE * looked[looked > 0.0])
    spans = np.maximum(np.ptp(fine, axis=0)[looked > 0.0], scale)
    return np.abs(found - fine).max(axis=0)[looked > 0.0] / spans


@pytest.mark.parametrize("smooth", [False, True], ids=["pulses", "waves"])
@pytest.mark.parametrize("name", [*SHIPPED, "bristles on a mount", "late series"])
def test_the_error_is_that_of_a_fine_step_to_a_hundred_thousandth(name, smooth):
    model = made(name)
    table = commands(model, smooth=smooth)
    chosen, fixed = missed(model, table, AUTO).max(), missed(model, table, STEP).max()
    assert chosen < max(ERROR, 1.1 * fixed), (chosen, fixed)


@pytest.mark.parametrize("rate", [200.0, 4000.0])
def test_ticks_of_any_length_keep_the_error(rate):
    model = made("thesis_arm")
    assert missed(model, commands(model, round(rate)), AUTO, 1.0 / rate).max() < ERROR


def test_a_smooth_motion_takes_few_steps_to_the_same_bits():
    model = made("thesis_arm")
    table, start = commands(model), model.trim(model.posture(None))
    log, mesh = model.paced(start, table)
    assert mesh.size < 0.8 * len(table)
    assert np.array_equal(log, model.run(start, table, step=AUTO))
    states, same = model.paced(start, table, flows=False)
    assert np.array_equal(states, log[:, : start.size]) and np.array_equal(same, mesh)


@pytest.mark.parametrize("name", ["thesis_arm", "late series"])
def test_the_steps_of_another_run_are_taken_again(name):
    """To the same bits; and what a small change does is smooth then, where chosen steps are not."""
    model = made(name)
    table, start = commands(model, smooth=name == "late series"), model.trim(model.posture(None))
    log, mesh = model.paced(start, table)
    assert np.array_equal(model.paced(start, table, mesh=mesh)[0], log)
    value = float(model.rig.parameters()["bulk_modulus"])
    moved = [{"bulk_modulus": value * math.exp(change)} for change in (1e-5, 1e-3)]
    near = [Model.of(model.rig.with_values(values)) for values in moved]
    small, large = (
        (one.paced(start, table, mesh=mesh, flows=False)[0] - log[:, : start.size]) / change
        for one, change in zip(near, (1e-5, 1e-3), strict=True)
    )
    effect = np.ptp(large, axis=0)
    moved = effect > 1e-3 * np.ptp(log[:, : start.size], axis=0)
    assert moved.any()
    assert np.all(np.abs(small - large).max(axis=0)[moved] < 0.05 * effect[moved])


def test_every_sample_has_a_row_where_a_step_is_no_whole_number_of_ticks():
    """As one that was cut at the end of a tick, and doubled, may be."""
    model = made("slide_servo")
    start, table = model.trim(model.posture(None)), model.rest_commands(50)
    units = pace_of(model.plant, model.layout, 1e-3).units
    log, steps = model.paced(start, table, mesh=np.array([units + units // 4]))
    assert np.all(log[:, model.plant.at.supply] > 0.0)
    assert int(steps.sum()) == 49 * units


def test_many_runs_on_threads_equal_single_runs():
    rig = shipped("slide_servo")
    models = [Model.of(rig.with_values({"bulk_modulus": 1e9 * (1 + i)})) for i in range(9)]
    jobs = [(m, m.trim(m.posture(None)), commands(m, 200 + i)) for i, m in enumerate(models)]
    alone = [m.run(start, table, step=AUTO) for m, start, table in jobs]
    for workers in (1, 2):
        logs = map_threads(lambda job: job[0].run(*job[1:], step=AUTO), jobs, workers)
        assert all(map(np.array_equal, logs, alone)) and len(logs) == len(alone)


def test_a_replay_that_fails_is_none_and_the_others_are_as_alone():
    model = made("slide_servo")
    table = commands(model, 200)
    log = model.run(model.trim(model.posture(None)), table)
    record = model.record(1e-3 * np.arange(200), table, log)
    start = model.rest_start(record)
    failed = start._replace(y=np.full_like(start.y, np.nan))
    first, none, last = replay_many([Replay(model, record, y) for y in (start, failed, start)])
    alone = model.replay(record, start=start)
    assert none is None
    for replayed in (first, last):
        assert all(np.array_equal(replayed[name], alone[name]) for name in alone.channels)


def test_errors_of_threads_and_of_numbers_are_said():
    begun = []

    def fail(task: int) -> None:
        begun.append(task)
        raise ValueError

    with pytest.raises(ValueError):
        map_threads(fail, range(9), 2)
    assert len(begun) <= 2
    model = made("slide_servo")
    start = model.trim(model.posture(None))
    start[model.layout.state("p_head")] = np.nan
    with pytest.raises(SimulationError, match="finite"):
        model.run(start, commands(model, 50), step=AUTO)
