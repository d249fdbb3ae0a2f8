"""Rigs side by side in lanes: each as when it is alone, to the bit."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest

from ehbench.app import warm
from ehbench.config.recipe import StudyRecipe, load_recipe, load_rig
from ehbench.config.rig import LoadSensing, LowRail, Rig
from ehbench.diagnosis import Case, ask
from ehbench.identification.hydraulics import FitOptions, identify_hydraulics
from ehbench.physics.flow_map import FlowMap, ValveMaps
from ehbench.plant.lanes import many
from ehbench.plant.lanes.convert import Unconverted, converted, of
from ehbench.plant.lanes.many import (
    LEAST,
    Job,
    Run,
    go_together,
    pace_together,
    replays_fixed,
    run_together,
    tempo,
)
from ehbench.plant.lanes.vectors import LANES
from ehbench.plant.many import run_many
from ehbench.plant.model import Model, simulate
from ehbench.preprocessing.initial_states import estimated_start
from ehbench.runtime.compiled import Kernel, allocating_kernel, part_kernel
from ehbench.sampling.sample import samples_of
from ehbench.stages import REGISTRY
from ehbench.stages.findings import Findings
from ehbench.stages.inputs import Inputs
from ehbench.stages.samples import open_sampler
from ehbench.trial import ahead
from ehbench.vocabulary.errors import SimulationError
from ehbench.vocabulary.fields import Value
from ehbench.workflow import Session

sys.path.insert(0, str(Path(__file__).parent))
from with_parts import noisy, steps  # noqa: E402

RIGS = Path(__file__).parents[2] / "recipes" / "rigs"
SHIPPED = [path.stem for path in sorted(RIGS.glob("*.toml"))]
TICK, STEPS = 1e-3, 2

RUB = {"friction_coulomb": "200 N", "friction_viscous": "400 N*s/m"}
STATIC = {"friction_static": "400 N", "stribeck_speed": "20 mm/s"}
# of the sliding mass: further keys of its cylinder, of its dynamics or of the rig
PARTS = {
    "bristles on a mount": {
        **RUB,
        "mount": {"stiffness": "10 kN/mm", "damping": "6000 N*s/m"},
        "sway": {"mass": "80 kg", "stiffness": "300 N/mm", "damping": "400 N*s/m"},
        "friction": {
            "law": "lugre",
            **STATIC,
            "bristle_stiffness": "2 kN/mm",
            "bristle_damping": "4 kN*s/m",
        },
    },
    "stribeck on lines": {
        **RUB,
        "friction": {"law": "stribeck", **STATIC},
        "line": [
            {"end": "head", "volume": "0.2 l", "resistance": "2e9 Pa*s/m^3"},
            {"end": "rod", "volume": "0.1 l", "orifice_gain": "2e-7 m^3/(s*Pa^0.5)"},
        ],
        "force": [
            {
                "name": "rub",
                "kind": "by_direction",
                "force_extending": "-300 N",
                "force_retracting": "200 N",
            },
            {"name": "spring", "kind": "spring", "stiffness": "20 N/mm", "free_length": "50 mm"},
        ],
    },
}
LATE = {
    "bus": {"kind": "delay", "delay": "5.3 ms"},
    "lag": {"kind": "first_order", "lag": "6 ms"},
    "spool": {"natural_frequency": "80 Hz", "damping_ratio": 0.8},
}


def rig_of(name: str) -> Rig:
    """A shipped rig, or the sliding mass with other parts."""
    if name in SHIPPED:
        return load_rig(RIGS / f"{name}.toml")
    slide = load_rig(RIGS / "slide_servo.toml")
    if name == "load sensing":
        sensing = LoadSensing(load_margin=Value(1.5e6), load_lag=Value(0.05))
        return slide.with_supply(load_sensing=sensing)
    if name == "two rails":
        rail = Value(0.4 * float(slide.supply.pressure))
        return slide.with_supply(low_rail=LowRail(rail_pressure=rail, rail_margin=Value(1e6)))
    plain = slide.as_toml()
    (cylinder,) = plain["cylinder"]
    if name == "late series":
        (valve,) = cylinder["valve"]
        plain["dynamics"], cylinder["valve"] = LATE, [valve | {"dynamics": list(LATE)}]
    if name == "preloaded":
        (valve,) = cylinder["valve"]
        edges = [edge | {"cracking_pressure": "2 MPa"} for edge in valve["edge"]]
        cylinder["valve"] = [valve | {"edge": edges}]
    if name == "limited drive":
        (valve,) = cylinder["valve"]
        cylinder["valve"] = [valve | {"drive_limit": "2 V"}]
    if name == "air in the oil":
        plain["oil"] = plain.get("oil", {}) | {"air_fraction": "0.5 %"}
    return Rig.model_validate(plain | {"cylinder": [cylinder | PARTS.get(name, {})]})


def jobs_of(rig: Rig, samples: int, seed: int = 0, same: bool = False, maps=None) -> list[Job]:
    """As many runs as there are lanes, each of a rig whose numbers are 10 % off, from another
    posture, under random commands of its own or the ``same`` for all.
    """
    rng, known, jobs = np.random.default_rng(seed), rig.parameters(), []
    while len(jobs) < LANES:
        off = {
            name: float(value) * math.exp(0.1 * rng.standard_normal())
            for name, value in known.items()
            if float(value) > 0.0 and name.split(".")[-1] in VARIED
        }
        model = Model.of(rig.with_values(off, known), maps(rng) if maps else None)
        table = jobs[0].commands if same and jobs else lively(model, samples, rng)
        place = [rng.uniform(0.3, 0.7) for _ in rig.cylinder]
        q = {
            c.name: f"{share * float(c.stroke)} m"
            for c, share in zip(rig.cylinder, place, strict=True)
        }
        start = model.trim(model.posture(q), None, table[0])
        jobs.append(Job(model, start, table))
    return jobs


VARIED = (
    *("bulk_modulus", "joint_damping", "damping", "flow_gain", "friction_coulomb", "mass"),
    *("friction_viscous", "leakage_internal", "natural_frequency", "delay", "lag", "deadband"),
    *("drive_limit", "cracking_pressure"),
)


def lively(model: Model, samples: int, rng: np.random.Generator) -> np.ndarray:
    """Levels of all valves and forces that change at random; half of the time at rest."""
    table = model.rest_commands(samples)
    for column, valve in enumerate(model.plant.valves):
        for first in range(5, samples, 60):
            if rng.random() < 0.5:
                table[first : first + 60, column] = rng.uniform(valve.lowest, valve.highest)
    table[5:, model.plant.valves.shape[0] :] = rng.normal(0.0, 100.0)
    return table


ODD = [*PARTS, "late series", "limited drive", "air in the oil", "load sensing", "two rails"]
ODD += ["preloaded"]


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    warm.lanes("lanes")


@pytest.mark.parametrize("name", [*SHIPPED, *ODD])
def test_lanes_equal_single_runs_to_the_bit(name):
    jobs = jobs_of(rig_of(name), 300)
    assert all(go_together(jobs[0], job) for job in jobs)
    alone = [job.model.run(job.start, job.commands, TICK, TICK / STEPS) for job in jobs]
    for log, one in zip(run_together(jobs, TICK, STEPS), alone, strict=True):
        assert np.array_equal(log, one)
    assert np.ptp(alone[0][:, 0]) > 0.0  # they move
    assert not np.array_equal(alone[0], alone[1])


def paced(job: Job, each: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """A job done alone in steps that it chooses, or of its mesh."""
    model, start, commands, mesh, slack = job
    return model.paced(start, commands, TICK, mesh, False, slack, each)


@pytest.mark.parametrize("each", [1, 4], ids=["samples", "means"])
@pytest.mark.parametrize("name", [*SHIPPED, *ODD])
def test_lanes_at_times_of_their_own_equal_single_runs_to_the_bit(name, each):
    """Of other lengths and commands, along meshes of their own and in steps that they choose."""
    jobs = jobs_of(rig_of(name), 300, 1)
    for i in (1, 4):
        jobs[i] = jobs[i]._replace(mesh=paced(jobs[0])[1])
    for i in (2, 4, 5):
        jobs[i] = jobs[i]._replace(slack=100.0, commands=jobs[i].commands[: 300 - 37 * i])
    assert len({tempo(job) for job in jobs}) == 1
    some = jobs if each == 1 else jobs[:5]
    for job, (log, mesh) in zip(some, pace_together(some, TICK, each), strict=True):
        one, chosen = paced(job, each)
        assert np.array_equal(log, one) and np.array_equal(mesh, chosen)


def some_maps(rng: np.random.Generator) -> dict[str, ValveMaps]:
    """Flow maps of two of the boom's edges, one with a leak and a reverse side."""

    def one(direction: str, leakage: tuple[float, float] = (0.0, 0.0)) -> FlowMap:
        knots = np.cumsum(rng.uniform(0.3, 3.0, 5))
        return FlowMap(
            valve="sh",
            direction=direction,
            deadband=float(knots[0]),
            deadband_interval=(0.0, 1.0),
            opening_knots=knots,
            drop_max=1.0e7,
            delta=2.0e4,
            increments=rng.uniform(0.5e-5, 5e-5, (5, 6)),
            hull_command=np.array([0.0, 10.0]),
            hull_low=np.zeros(2),
            hull_high=np.full(2, 1e7),
            std_command=np.array([0.0, 10.0]),
            std_root=np.array([0.0, 3e3]),
            std=np.zeros((2, 2)),
            rated_flow=1e-4,
            leakage=leakage,
        )

    return {
        "boom.sh": ValveMaps(one("forward", (1e-7, 2e-7)), one("reverse")),
        "boom.rt": ValveMaps(one("forward")),
    }


def test_measured_maps_go_in_lanes_each_its_own():
    jobs = jobs_of(rig_of("boom_four_valve"), 300, 2, maps=some_maps)
    for log, job in zip(run_together(jobs, TICK, STEPS), jobs, strict=True):
        assert np.array_equal(log, job.model.run(job.start, job.commands, TICK, TICK / STEPS))


@pytest.mark.parametrize("along", [False, True], ids=["fixed", "mesh"])
def test_a_lane_that_fails_harms_no_other(along):
    jobs = jobs_of(rig_of("slide_servo"), 200, 3, same=True)
    mesh = paced(jobs[0])[1]
    jobs = [job._replace(mesh=mesh) for job in jobs[:-1]] + jobs[-1:]
    jobs[2].start[jobs[2].model.layout.state("p_head")] = math.nan
    jobs[5].start[jobs[5].model.layout.state("qd")] = 1e200
    if along:
        made = [log for log, _ in pace_together(jobs, TICK)]
    else:
        made = run_together(jobs, TICK, STEPS)
    failed = []
    for i, (log, job) in enumerate(zip(made, jobs, strict=True)):
        try:
            if along:
                one, _ = paced(job)
            else:
                one = job.model.run(job.start, job.commands, TICK, TICK / STEPS)
        except SimulationError:
            failed.append(i)
            assert not np.isfinite(log[-1]).all()
        else:
            assert np.array_equal(log, one)
    assert 2 in failed and set(failed) <= {2, 5}


def test_fewer_than_a_registerful_and_other_layouts():
    slide, arm = jobs_of(rig_of("slide_servo"), 100, 4), jobs_of(rig_of("crane_proportional"), 100)
    assert not go_together(slide[0], arm[0])
    assert not go_together(slide[0], slide[1]._replace(commands=slide[1].commands[:-1]))
    for count in (1, 3):
        for log, job in zip(run_together(slide[:count], TICK, STEPS), slide, strict=False):
            assert np.array_equal(log, job.model.run(job.start, job.commands, TICK, TICK / STEPS))
    mixed = [*slide[:5], *arm[:5], *slide[5:]]
    alone = [job.model.run(job.start, job.commands) for job in mixed]
    for workers, lanes in ((1, True), (3, True), (2, False)):
        logs = list(run_many(iter(mixed), workers=workers, lanes=lanes))
        assert all(map(np.array_equal, logs, alone)) and len(logs) == len(alone)
    mixed[7].start[0] = math.nan
    with pytest.raises(SimulationError, match="finite"):
        list(run_many(iter(mixed)))


# --- what goes in lanes by itself


STUDY = """stage = "study"
recipe = "trial.toml"
samples = 9
keep = 0
measures = ["duration", {{ channel = "boom.p_head", take = "max" }}]
[draw]
"rig.bulk_modulus" = {{ low = 0.5, high = 1.5, relative = true }}
"recipe.limits.pressure_max" = {{ low = "{low} MPa", high = "{high} MPa" }}
"""
TRIAL = """stage = "trial"
rig = "{rig}"
duration = "0.6 s"
command = [{{ valve = "boom.ht", kind = "step", amplitude = "5 V", start = "50 ms" }},
           {{ valve = "boom.sr", kind = "step", amplitude = "5 V", start = "50 ms" }}]
[limits]
pressure_max = "15 MPa"
"""


@pytest.mark.parametrize("kept", [True, False], ids=["compiled", "not yet"])
def test_a_study_has_the_same_samples_in_lanes_and_alone(kept, tmp_path, monkeypatch):
    """Also those that a limit stops."""
    monkeypatch.setattr(Kernel, "is_kept", kept)
    (tmp_path / "trial.toml").write_text(TRIAL.format(rig=RIGS / "boom_four_valve.toml"))
    (tmp_path / "study.toml").write_text(STUDY.format(low=2.0, high=20.0))
    recipe = load_recipe(tmp_path / "study.toml")
    inputs = Inputs(recipe, Findings(recipe), Session())
    prepared = REGISTRY[StudyRecipe.kind()].prepare(recipe, inputs)
    design, make = prepared.design, open_sampler(prepared.plan)
    tasks = [(i, design.settings(i)) for i in range(9)]
    calls = []
    monkeypatch.setattr(ahead, "run_together", lambda *a: calls.append(a) or run_together(*a))
    made = [one._replace(seconds=0.0) for one in samples_of(make, tasks)]
    assert len(calls) == kept
    alone = [make(*task)._replace(seconds=0.0) for task in tasks]
    assert made == alone and {one.status for one in made} == {"done", "stopped"}


def test_a_fit_is_the_same_in_lanes_and_alone(monkeypatch):
    rig, table = rig_of("slide_servo"), steps((2.0, -3.0), 100)
    logs = [("log", noisy(simulate(rig, {"press.servo": table}, 1e-3 * (table.size - 1)), 1))]
    names = [
        *("bulk_modulus", "carriage.damping", "spool.natural_frequency", "spool.damping_ratio"),
    ]
    start = {name: 1.3 * float(rig.parameters()[name]) for name in names}
    calls, fits, asked = [], [], []
    monkeypatch.setattr(many, "pace_together", lambda *a: calls.append(a) or pace_together(*a))
    for kept in (True, False):
        monkeypatch.setattr(Kernel, "is_kept", kept)
        fits.append(identify_hydraulics(rig, logs, names, FitOptions(start=start)))
        asked.append(len(calls))
    assert 0 < asked[0] == asked[1]
    assert [fits[0][name] for name in names] == [fits[1][name] for name in names]


def test_starts_and_residuals_say_the_same_in_lanes_and_alone(monkeypatch):
    """Also where a lane fails: what it says then is what it says alone."""
    rig = rig_of("slide_servo")
    table = steps((2.0, -3.0), 80)
    made = simulate(rig, {"press.servo": table}, 1e-3 * (table.size - 1))
    log, model = noisy(made, 1), Model.of(rig.with_values({"bulk_modulus": 5e8}))
    calls, found, asked = [], [], []
    monkeypatch.setattr(many, "run_together", lambda *a: calls.append(a) or run_together(*a))
    for kept in (True, False):
        monkeypatch.setattr(Kernel, "is_kept", kept)
        start = estimated_start(model, log, ["press"], ["press.v", "press.p_head", "press.p_rod"])
        found.append((start.y.tolist(), repr(ask([Case("log", log, model, ("press",))]))))
        asked.append(len(calls))
    assert asked[0] == asked[1] > 1
    assert found[0] == found[1] and "Finding(" in found[0][1]
    runs = [Run(model, log, start._replace(y=start.y.copy())) for _ in range(LEAST)]
    runs[1].start.y[model.layout.state("p_head")] = math.nan
    monkeypatch.setattr(Kernel, "is_kept", True)
    ends = replays_fixed(runs, TICK / STEPS)
    assert ends[1] is None and len(calls) == asked[1] + 1
    alone = model.replay(log, TICK / STEPS, start=start)
    for one in (ends[0], *ends[2:]):
        assert all(np.array_equal(one[name], alone[name]) for name in alone.channels)


# --- the second form of a kernel


@part_kernel
def _early(x, i, out):
    if i == 0:
        return x, 1
    if x < 0.0:
        if x < -2.0:
            out[0] = x
            return -x, 2
        x = x - 1.0
    elif x > 3.0 and math.sqrt(x) > 2.0:
        out[1] += 1.0
        return 3.0, 3
    return (x if x != 1.0 else 7.0) ** 2, 4


@part_kernel
def _looped(x, i, out):
    low, high, steps = 0, 100, 0
    while high - low > 1:
        middle = (low + high) >> 1
        steps += 1
        if x * x >= out[2] + middle:
            low = middle
        else:
            high = middle
    total = 0.0
    for n in range(low):
        total += out[n % 3] + max(min(x, n), -x)
    for n in range(10):
        if total > 50.0 + n or not x > 0.0:
            break
        total += math.exp(-n) * math.copysign(int(abs(x) + 0.5), -x)
    return total, steps + int(math.floor(x)) % 4


EARLY, LOOPED = of(_early), of(_looped)


@allocating_kernel
def _numbers(x, which, out):
    for lane in range(x.shape[0]):
        if which < 2:
            out[3, lane], out[4, lane] = _early(x[lane], which, out[:3, lane])
        else:
            out[3, lane], out[4, lane] = _looped(x[lane], which, out[:3, lane])


@part_kernel
def _both(x, which, out):
    if which < 2:
        first, second = _early(x[0], which, out)
    else:
        first, second = _looped(x[0], which, out)
    out[3], out[4] = first, second


BOTH = of(_both)


@allocating_kernel
def _lanes(x, which, out):
    BOTH(True, x, which, out)


@pytest.mark.parametrize("which", [0, 1, 2])
def test_branches_returns_and_loops_are_those_of_numbers(which):
    x = np.array([-3.0, -2.0, -0.5, 0.0, 1.0, 3.5, 5.0, 17.0])
    alone = np.zeros((5, LANES))
    alone[2] = np.arange(LANES)
    lanes = alone.copy()
    _numbers(x, which, alone)
    _lanes(x[None], which, lanes)
    assert np.array_equal(lanes, alone)


def test_what_has_no_form_in_lanes_is_said():
    def odd(x):
        with x:
            return 1.0

    def out_of_a_loop(x):
        for i in range(3):
            if x > i:
                return i
        return 3

    for function in (odd, out_of_a_loop):
        with pytest.raises(Unconverted, match=function.__name__):
            converted(function)
