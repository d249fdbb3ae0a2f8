"""The numbers that are measured, not tested: speed, accuracy, fit time, log time, start-up.
``python -m tools.benchmark``."""

from __future__ import annotations

import pickle
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ehbench.config.recipe import FlowMapRecipe, TrialRecipe, TrialSetRecipe, load_recipe, load_rig
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.plant.derivatives import derivatives
from ehbench.plant.many import map_threads
from ehbench.plant.model import Model, simulate
from ehbench.plant.paced import AUTO
from ehbench.runs.rundir import shipped
from ehbench.runtime.blas import one_thread
from ehbench.runtime.cores import cores
from ehbench.vocabulary.fields import Value

if TYPE_CHECKING:
    from ehbench.physics.flow_map import FlowMaps
    from ehbench.sampling.sample import Run
    from ehbench.stages.study import PreparedStudy

RECIPES = shipped("recipes")
RIG = RECIPES / "rigs" / "thesis_arm.toml"
TRIAL = 10.0  # [s]
FINE = 6.25e-5  # [s]: the step that steps chosen by the guard are judged by


@dataclass(frozen=True)
class Row:
    """One measured number and its limit; ``lower`` says that smaller is better."""

    what: str
    value: float
    limit: float
    unit: str
    lower: bool = True

    @property
    def kept(self) -> bool:
        """Whether the limit is kept."""
        return self.value <= self.limit if self.lower else self.value >= self.limit


def thesis_trial(rig: Rig, rate: float = 1000.0) -> tuple[Model, np.ndarray]:
    """(model, table of commands [V]) of a 10 s trial of the thesis's arm: steps of all three
    cylinders there and back."""
    model = Model.of(rig)
    samples = round(TRIAL * rate) + 1
    table = model.rest_commands(samples)
    t = np.arange(samples) / rate
    for valve, start, stop, volts in (
        ("boom.hepc", 0.5, 1.5, 5.0),
        ("boom.rect", 0.5, 1.5, 9.0),
        ("boom.repc", 5.0, 6.5, 4.0),
        ("boom.hect", 5.0, 6.5, 5.0),
        ("swing.servo", 1.0, 2.5, 1.5),
        ("swing.servo", 5.5, 7.5, -1.5),
        ("stick.servo", 2.0, 3.5, -1.5),
        ("stick.servo", 7.0, 8.5, 1.5),
    ):
        table[
            (t > start - 0.5 / rate) & (t < stop - 0.5 / rate), model.layout.valves.index(valve)
        ] = volts
    return model, table


def radau_error(
    model: Model, table: np.ndarray, tick: float = 1e-3, rtol: float = 1e-9
) -> dict[str, float]:
    """Largest error of `Model.run` against SciPy's Radau, as a share of each state's range, by the
    state's name.

    Radau starts anew wherever a command changes. States that do not move are left out."""
    from scipy.integrate import solve_ivp

    plant, names = model.plant, model.layout
    start = model.trim(model.posture(None))
    log = model.run(start, table, tick)[:, : start.size]
    spans = np.ptp(log, axis=0)
    scale = np.maximum(spans, 1e-9)
    work = np.empty(plant.at.work)
    changes = np.flatnonzero(np.any(np.diff(table, axis=0) != 0.0, axis=1)) + 1
    y, worst = start, np.zeros(start.size)
    for first, last in zip([0, *changes], [*changes, len(table) - 1], strict=True):
        command = table[first].copy()

        def slope(_: float, y: np.ndarray, command: np.ndarray = command) -> np.ndarray:
            dy = np.empty_like(y)
            derivatives(np.ascontiguousarray(y), command, plant, dy, work)
            return dy

        at = tick * np.arange(first, last + 1)
        result = solve_ivp(
            slope, (at[0], at[-1]), y, method="Radau", rtol=rtol, atol=rtol * scale, t_eval=at
        )
        worst = np.maximum(worst, np.abs(log[first : last + 1] - result.y.T).max(axis=0))
        y = result.y[:, -1]
    return {
        label: float(e / s)
        for label, e, s, span in zip(names.state_names, worst, scale, spans, strict=True)
        if span > 1e-6
    }


def speed(rig: Rig, repeats: int = 30) -> Iterator[Row]:
    """How many times faster than the machine the model runs once warm, on the analytic laws and on
    measured maps."""
    for label, maps in (
        ("flow laws of the rig file", None),
        ("flow maps fitted to the dataset", _maps(rig)),
    ):
        model, table = thesis_trial(rig)
        model = Model.of(rig, maps)
        start = model.trim(model.posture(None))
        best = _best(lambda model=model, start=start, table=table: model.run(start, table), repeats)
        yield Row(
            f"10 s trial, 1 kHz log, 500 µs steps, {label}",
            TRIAL / best,
            200.0,
            "× real time",
            lower=False,
        )


def exported(ticks: int = 3000) -> Iterator[Row]:
    """Time of a tick of the slide's model in C, as FMU and in ehbench, called from Python."""
    from fmpy import extract, read_model_description
    from fmpy.fmi2 import FMU2Slave

    from ehbench import workflow
    from ehbench.machines.simulated import SimulatedMachine

    source = RECIPES / "rigs" / "slide_servo.toml"
    with tempfile.TemporaryDirectory() as scratch:
        session = workflow.Session(root=Path(scratch), unvalidated=True)
        done = workflow.export(source, {"formats": ("c", "fmu2")}, session)
        in_c = re.search(r"took (\S+) us, the longest (\S+) us", " ".join(done.notes))
        unit = str(done.folder / done.json("export")["written"][1]["file"])
        about = read_model_description(unit)
        slave = FMU2Slave(
            guid=about.guid,
            unzipDirectory=extract(unit, scratch),
            modelIdentifier=about.modelName,
            instanceName="unit",
        )
        slave.instantiate()
        slave.setupExperiment()
        as_unit = _best(lambda: [slave.doStep(0.0, 1e-3) for _ in range(ticks)], 3) / ticks
        slave.freeInstance()
    machine = SimulatedMachine(Model.of(load_rig(source)))
    machine.start()
    rest = machine.commands.rest
    here = _best(lambda: [machine.tick(rest) for _ in range(ticks)], 3) / ticks
    assert in_c is not None
    yield Row("a tick of the slide's model in C", float(in_c[1]), 50.0, "µs")
    yield Row("the longest of them", float(in_c[2]), 1e5, "µs")
    yield Row("the same as FMU, called from Python", 1e6 * as_unit, 100.0, "µs")
    yield Row("the same in ehbench, called from Python", 1e6 * here, 500.0, "µs")


def chosen_steps(rig: Rig, repeats: int = 10) -> Iterator[Row]:
    """What steps chosen by the guard take of the time of fixed ones, what they miss, and how long a
    thousand trials take with them on all cores, each of a rig of its own."""
    model, table = thesis_trial(rig)
    start = model.trim(model.posture(None))
    fixed = _best(lambda: model.run(start, table), repeats)
    chosen = _best(lambda: model.run(start, table, step=AUTO), repeats)
    yield Row("10 s trial, steps chosen by the guard", chosen / fixed, 0.8, "of fixed ones' time")
    fine, result = (model.run(start, table, step=step)[:, : start.size] for step in (FINE, AUTO))
    spans = np.ptp(fine, axis=0)
    share = np.abs(result - fine).max(axis=0)[spans > 1e-6] / spans[spans > 1e-6]
    yield Row("their error against a fine step", float(share.max()), 1e-5, "of range")
    models = [
        Model.of(rig.with_values({"bulk_modulus": float(value)}))
        for value in np.linspace(0.9, 1.1, 1000) * float(rig.parameters()["bulk_modulus"])
    ]
    began = time.perf_counter()
    map_threads(lambda each: float(each.run(start, table, step=AUTO)[-1, 0]), models)
    yield Row(
        "1000 trials of 10 s, a rig each (made before), all cores",
        time.perf_counter() - began,
        10.0,
        "s",
    )


def closed_loop(rig: Rig, repeats: int = 10) -> Iterator[Row]:
    """How many times faster than the machine a trial under a controller runs once warm: all that
    `run_trial` does.

    The boom up and down under the adaptive robust controller, the same while swing and stick move
    under theirs, and the stick under the Python class of the example recipe."""
    from ehbench.trial import run_trial

    up_down = _lasting_as_long("arc_slow.toml", "boom")
    own = _lasting_as_long("own_controller.toml", "stick")
    for label, maps in (
        ("flow laws of the rig file", None),
        ("flow maps fitted to the dataset", _maps(rig)),
    ):
        for recipe, what, limit in (
            (up_down, "adaptive robust control", 150.0),
            (_three_at_once(), "the same on three cylinders at once", 60.0),
            (own, "a user's Python class", 20.0),
        ):

            def trial(recipe: TrialRecipe = recipe, maps: FlowMaps | None = maps) -> None:
                _, facts = run_trial(rig, recipe, maps, allow_code=True)
                if facts.stopped or facts.duration != TRIAL:
                    raise AssertionError(
                        f"{recipe.name} lasted {facts.duration} s: {facts.stopped}"
                    )

            best = _best(trial, repeats)
            yield Row(
                f"10 s closed-loop trial, 1 kHz, {what}, {label}",
                TRIAL / best,
                limit,
                "× real time",
                lower=False,
            )


def together(rig: Rig, repeats: int = 5) -> Iterator[Row]:
    """How many times faster than the machine the model follows a path with all three cylinders."""
    from ehbench.trial import run_trial

    recipe = load_recipe(RECIPES / "trials" / "tip_line.toml")
    if not isinstance(recipe, TrialSetRecipe):
        raise AssertionError("tip_line.toml is no set of trials")
    item = recipe.cases()[0].model_copy(update={"on": "model", "bench": None})
    _, facts = run_trial(rig, item)
    if facts.stopped:
        raise AssertionError(f"{recipe.name}: {facts.stopped}")
    best = _best(lambda: run_trial(rig, item), repeats)
    what = f"{facts.duration:.3g} s along a path, 1 kHz, three cylinders under adaptive control"
    yield Row(what, facts.duration / best, 80.0, "× real time", lower=False)


def accuracy(rig: Rig) -> Iterator[Row]:
    """The worst state's error in that trial."""
    errors = radau_error(*thesis_trial(rig))
    worst = max(errors, key=errors.__getitem__)
    yield Row(
        f"error against SciPy Radau, rtol 1e-9 (worst: {worst})", errors[worst], 1e-5, "of range"
    )


def fitting(rig: Rig) -> Iterator[Row]:
    """Time of an output-error fit of six parameters on six noisy logs of 3 s, started well off the
    truth."""
    from ehbench.identification.hydraulics import FitOptions, identify_hydraulics

    t = np.arange(3001) * 1e-3
    pulse = ((t >= 0.3) & (t < 1.6)).astype(float)
    steps = (
        ("swing.servo", 1.5),
        ("swing.servo", -2.0),
        ("stick.servo", 1.5),
        ("stick.servo", -2.0),
    )
    commands = [{name: volts * pulse} for name, volts in steps]
    commands += [
        {"boom.hepc": 4.0 * pulse, "boom.rect": 8.0 * pulse},
        {"boom.repc": 4.0 * pulse, "boom.hect": 5.0 * pulse},
    ]
    rng = np.random.default_rng(1)
    logs = []
    for index, command in enumerate(commands):
        built = simulate(rig, command, 3.0)
        logs.append((f"log_{index}", _noisy(built, rng)))
    truth = {
        name: float(rig.parameters()[name])
        for name in ("bulk_modulus", *(f"{joint}.joint_damping" for joint in rig.joint_names))
    }
    free = {"boom.leakage_internal": 1e-13, "swing.leakage_internal": 1e-13}
    began = time.perf_counter()
    identify_hydraulics(
        rig,
        logs,
        [*truth, *free],
        FitOptions(start={name: 1.6 * value for name, value in truth.items()} | free),
    )
    yield Row("fit of 6 parameters on 6 logs of 3 s", time.perf_counter() - began, 2.0, "s")


def long_fitting(rate: float = 1000.0) -> Iterator[Row]:
    """Time of an output-error fit of eight parameters on two noisy logs of 31 s, written at a
    ``rate`` [Hz], started well off the truth; at a high one by means of several samples."""
    from ehbench.identification.hydraulics import FitOptions, identify_hydraulics

    rig = load_rig(RIG.with_name("boom_four_valve.toml"))
    t, rng, logs = np.arange(round(31.0 * rate) + 1) / rate, np.random.default_rng(1), []
    for load in (None, "bucket"):
        u, at, sign = np.zeros_like(t), 0.5, 1.0
        while at < t[-1] - 2.5:
            long, first, second = rng.uniform((0.2, 0.3, 0.3), (0.4, 0.9, 0.9))
            size = rng.uniform(0.4, 1.0)
            u[(t >= at) & (t < at + long)] = sign * size
            at += long + first
            u[(t >= at) & (t < at + long)] = -sign * size
            at, sign = at + long + second, -sign
        up, down = np.maximum(u, 0.0), np.maximum(-u, 0.0)
        volts = {"boom.sh": 4.0 * up, "boom.rt": 5.0 * up, "boom.sr": 3.0 * down}
        volts["boom.ht"] = 3.5 * down
        given = {"posture": {"boom": "250 mm"}, "payload": load, "rate": rate, "step": AUTO}
        built = simulate(rig, volts, 31.0, **given)
        logs.append((f"log {load}", _noisy(built, rng)))
    known = rig.parameters()
    gains = [f"boom.{valve}.flow_gain" for valve in ("sh", "rt", "sr", "ht")]
    names = ["bulk_modulus", "boom.joint_damping", *gains]
    start = {name: float(known[name]) * 1.6 ** (-1) ** k for k, name in enumerate(names)}
    start |= {"boom.friction_coulomb": 200.0, "boom.leakage_internal": 1e-13}
    began = time.perf_counter()
    identify_hydraulics(rig, logs, list(start), FitOptions(start=start))
    took = time.perf_counter() - began
    yield Row(f"fit of 8 parameters on 2 logs of 31 s at {rate:g} Hz", took, 30.0, "s")


def stiff_fitting(friction: float = 7e3, mass: float = 20.0) -> Iterator[Row]:
    """Time of a fit of seven parameters on a noisy log of 31 s at 1 kHz: a piston of ``mass``
    [kg] that its ``friction`` [N] stops at once."""
    from ehbench.identification.hydraulics import FitOptions, identify_hydraulics

    rig = load_rig(RIG.with_name("slide_servo.toml"))
    rig = rig.with_values({"carriage.mass": mass, "press.friction_coulomb": friction})
    t, rng = np.arange(31_001) / 1000.0, np.random.default_rng(1)
    u = 1.5 * np.sign(np.sin(2.0 * np.pi * t / 3.1)) * (np.sin(2.0 * np.pi * t / 1.55) > 0.0)
    log = _noisy(simulate(rig, {"press.servo": u}, 31.0, step=AUTO), rng)
    known = rig.parameters()
    names = ["bulk_modulus", "press.friction_coulomb"]
    names += [name for name in known if name.endswith(".flow_gain")]
    start = {name: float(known[name]) * 1.3 ** (-1) ** k for k, name in enumerate(names)}
    start["press.leakage_internal"] = 1e-13
    began = time.perf_counter()
    options = FitOptions(start=start, upper={"press.friction_coulomb": 5.0 * friction})
    identify_hydraulics(rig, [("log", log)], list(start), options)
    took = time.perf_counter() - began
    what = f"fit of 7 parameters on 31 s at 1 kHz, {friction:g} N of friction on {mass:g} kg"
    yield Row(what, took, 60.0, "s")


def many_fitting(seconds: float = 25.0, rate: float = 100.0) -> Iterator[Row]:
    """Time of a fit of 21 parameters of two cylinders of the thesis's arm to four noisy logs."""
    from ehbench.identification.hydraulics import FitOptions, identify_hydraulics

    rig = load_rig(RIG)
    t, rng, logs = np.arange(round(seconds * rate) + 1) / rate, np.random.default_rng(1), []
    drives = {"swing.servo": 1.5, "stick.servo": 1.5}
    for k in range(4):
        volts = {
            valve: size * np.repeat(rng.uniform(-1.0, 1.0, t.size // 50 + 1), 50)[: t.size]
            for valve, size in drives.items()
        }
        for u in volts.values():
            u[: round(rate)] = 0.0
            u -= np.where(t > 1.0, np.mean(u[t > 1.0]), 0.0)
        built = simulate(rig, volts, seconds, rate=rate, step=AUTO)
        logs.append((f"log {k}", _noisy(built, rng)))
    known, names = rig.parameters(), ["bulk_modulus", "servo.natural_frequency"]
    for who in ("swing", "stick"):
        names += [f"{who}.joint_damping", f"{who}.friction_coulomb", f"{who}.leakage_internal"]
        names += [f"{who}.volume_head", f"{who}.volume_rod"]
        names += [name for name in known if re.match(rf"{who}\.servo_\w+\.flow_gain", name)]
    names.append("stick.mass")
    start = {name: float(known[name]) * 1.2 ** (-1) ** k for k, name in enumerate(names)}
    start |= {name: 1e-13 for name in names if name.endswith("leakage_internal")}
    start |= {name: 50.0 for name in names if name.endswith("friction_coulomb")}
    upper = {name: 3e3 for name in names if name.endswith("friction_coulomb")}
    began = time.perf_counter()
    identify_hydraulics(rig, logs, names, FitOptions(start=start, upper=upper))
    took = time.perf_counter() - began
    what = f"fit of {len(names)} parameters, two cylinders, 4 logs of {seconds:g} s at {rate:g} Hz"
    yield Row(what, took, 30.0, "s")


def suggesting() -> Iterator[Row]:
    """Time of ``identify --suggest`` on the tutorial's first fit, from its logs as they ship."""
    from ehbench import workflow

    logs = shipped("datasets") / "slide_servo" / "steps"
    text = f"""stage = "identify"
what = "hydraulics"
rig = "{RIG.with_name("slide_servo.toml")}"
data = ["{logs / "press_no_load.mcap"}", "{logs / "press_100kg.mcap"}"]
parameters = ["bulk_modulus", "carriage.damping", "press.friction_coulomb"]
"""
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch, "first.toml")
        path.write_text(text)
        began = time.perf_counter()
        workflow.suggest(path, workflow.Session(root=Path(scratch)))
    yield Row("identify --suggest on the tutorial", time.perf_counter() - began, 30.0, "s")


def logging(samples: int = 600_000, channels: int = 40) -> Iterator[Row]:
    """Time to write a long log as MCAP and to read it into pandas, which is imported before."""
    import pandas  # noqa: F401

    from ehbench.data import read_log
    from ehbench.data.logs import write_log
    from ehbench.data.record import Record

    t = np.arange(samples) * 1e-3
    rng = np.random.default_rng(1)
    values = {
        f"c{i}.p_head": 1e6 * (2.0 + np.sin(0.1 * i * t)) + rng.normal(0.0, 1e3, samples)
        for i in range(channels)
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        began = time.perf_counter()
        write_log(path, Record(t, values))
        written = time.perf_counter()
        frame = read_log(path)
        read = time.perf_counter()
    if frame.shape != (samples, channels + 1):
        raise AssertionError(f"the log came back with shape {frame.shape}")
    yield Row(f"MCAP log of {samples} × {channels} written", written - began, 8.0, "s")
    yield Row(f"MCAP log of {samples} × {channels} read into pandas", read - written, 0.7, "s")


def links(seconds: float = 10.0) -> Iterator[Row]:
    """The served bench over UDP on loopback: both ends share the cores."""
    from ehbench.links.quality import measure
    from ehbench.links.transport import UdpLink
    from ehbench.runtime.realtime import punctual

    for port, rate, most in ((47911, 1000, 0.5), (47912, 250, 0.2)):
        url = f"udp://127.0.0.1:{port}"
        bench = str(RECIPES / "bench" / "thesis_arm.toml")
        line = [sys.executable, "-m", "ehbench", "serve", bench, "--at", url, "--rate", str(rate)]
        with subprocess.Popen(line, stderr=subprocess.PIPE, text=True) as served:
            assert served.stderr is not None
            served.stderr.readline()
            try:
                with punctual() as refused:
                    quality = measure(UdpLink("127.0.0.1", port), url, seconds, tuple(refused))
            finally:
                served.terminate()
        what = f"link at {rate} Hz" + (f", without {', '.join(refused)}" if refused else "")
        yield Row(f"{what}: late ticks", 100.0 * quality.late_share, most, "%")
        yield Row(f"{what}: lost samples", 100.0 * quality.lost / quality.ticks, most, "%")
        median, most_trips, longest = (1e3 * value for value in quality.round_trip)
        yield Row(f"{what}: round trip, median", median, 1.2e3 / rate, "ms")
        yield Row(f"{what}: round trip, 99.9 %", most_trips, 10.0, "ms")
        yield Row(f"{what}: longest gap", 1e3 * quality.gap, 15.0, "ms")


def start_up() -> Iterator[Row]:
    """Time of ``ehbench --help`` in a process of its own."""
    command = [str(Path(sys.executable).with_name("ehbench")), "--help"]
    best = _best(lambda: subprocess.run(command, check=True, capture_output=True), 5)
    yield Row("ehbench --help", best, 0.4, "s")


_SHORT = """stage = "trial"
rig = "{rig}"
duration = "0.5 s"
command = [{{ valve = "boom.hepc", kind = "step", amplitude = "4 V", start = "50 ms" }}]
"""
_STUDY = """stage = "study"
recipe = "short.toml"
samples = {samples}
keep = 0
measures = ["duration", {{ channel = "boom.v", take = "max" }}]
[draw]
"rig.bulk_modulus" = {{ low = 0.5, high = 1.5, relative = true }}
"rig.boom.joint_damping" = {{ low = 0.5, high = 1.5, relative = true }}
"""
SAMPLES, ROWS, WORKERS = 1500, 100_000, 2


def studies() -> Iterator[Row]:
    """What a study adds to its samples, in processes and on a Dask cluster of this machine; what a
    sample costs on the wire and on disk; how many this process can hand out; memory."""
    from ehbench.sampling.cluster import Cluster
    from ehbench.sampling.pools import Processes
    from ehbench.sampling.sample import Workers
    from ehbench.stages import stage_of
    from ehbench.stages.study import PreparedStudy
    from ehbench.workflow import Session

    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "short.toml").write_text(_SHORT.format(rig=RIG))
        path = Path(folder, "study.toml")
        path.write_text(_STUDY.format(samples=ROWS))
        recipe = load_recipe(path)
        prepared = stage_of(recipe).prepare(recipe, Session().inputs(recipe))
        assert isinstance(prepared, PreparedStudy)
        plan, count = prepared.plan, len(prepared.measures)
        pool = Processes(plan.opened, WORKERS, count)
        yield from _overhead("here", pool.run, prepared)
        bundle = plan.bundle()
        yield Row("a study's files, sent once", len(pickle.dumps(bundle)) / 1e3, 1e3, "kB")
        with _workers() as address:
            if address:
                run = Cluster(Workers(address), bundle, count).run
                yield from _overhead("on Dask", run, prepared)
        yield from _kept(prepared, Path(folder))


def _overhead(where: str, run: Run, prepared: PreparedStudy) -> Iterator[Row]:
    """Of SAMPLES short trials, the share of the workers' time that went into anything else; counted
    from when every worker is at work."""
    design, came = prepared.design, []
    tasks = ((i, design.settings(i)) for i in range(SAMPLES))
    for some in run(tasks):
        came.append((time.perf_counter(), some))
    first = len(came) // 4
    wall = came[-1][0] - came[first][0]
    built = [item.seconds for _, some in came[first + 1 :] for item in some]
    yield Row(
        f"study of trials of 0.5 s {where}, {WORKERS} workers: time beside the samples",
        100.0 * (1.0 - sum(built) / (WORKERS * wall)),
        5.0,
        "%",
    )
    yield Row(f"the same: a sample {where}", 1e3 * float(np.median(built)), 20.0, "ms")


@contextmanager
def _workers() -> Iterator[str]:
    """The address of a Dask scheduler with WORKERS processes here; '' where Dask is not there."""
    try:
        from distributed import LocalCluster
    except ImportError:
        yield ""
        return
    where = {"host": "127.0.0.1", "dashboard_address": None, "silence_logs": 50}
    built: Any = LocalCluster(n_workers=WORKERS, threads_per_worker=1, **where)
    with built as cluster:
        yield cluster.scheduler_address


def _kept(prepared: PreparedStudy, folder: Path) -> Iterator[Row]:
    """What ROWS samples cost the process that hands them out and keeps them."""
    import resource

    from ehbench.sampling.journal import Journal
    from ehbench.sampling.outputs import write_tables
    from ehbench.sampling.sample import Sample

    design = prepared.design
    journal = Journal(folder / "rows.jsonl", "k", ROWS, resume=False)
    began, wire = time.process_time(), 0
    for first in range(0, ROWS, 50):
        span = range(first, first + 50)
        sent = pickle.dumps([(i, design.settings(i)) for i in span])
        back = pickle.dumps([Sample(i, 0, "done", "", (0.5, 0.1 / (i + 1)), 0.005) for i in span])
        wire += len(sent) + len(back)
        journal.add(pickle.loads(back))
    spent = time.process_time() - began
    yield Row(
        "samples that one process hands out and keeps, by its processor time",
        ROWS / spent,
        2e3,
        "/s",
        lower=False,
    )
    yield Row("a sample on the wire", wire / ROWS, 500.0, "B")
    write_tables(folder, design, prepared.measures, journal, "k")
    journal.close()
    for name in ("rows.jsonl", "samples.csv", "samples.parquet"):
        yield Row(f"a sample in {name}", (folder / name).stat().st_size / ROWS, 500.0, "B")
    maximum = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    yield Row(f"memory with {ROWS} rows", maximum, 1.0, "GB")


def _noisy(built: Record, rng: np.random.Generator) -> Record:
    """A simulation with noise of a thousandth of its range on each channel but the commands."""
    channels = {
        name: y if "command" in name else y + 1e-3 * np.ptp(y) * rng.standard_normal(y.shape)
        for name, y in built.channels.items()
    }
    return Record(built.t, channels, built.meta)


def _best(call: Callable[[], object], repeats: int) -> float:
    """Least time [s] of some calls, after one that does not count: the least disturbed one."""
    call()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return min(times)


def _lasting_as_long(name: str, cylinder: str) -> TrialRecipe:
    """A shipped trial of the thesis's arm made to last TRIAL seconds with the payload, of a given
    cylinder."""
    recipe = load_recipe(RECIPES / "trials" / name)
    if not (isinstance(recipe, TrialRecipe) and recipe.motion is not None):
        raise AssertionError(f"{name} is no trial with a motion")
    motion = recipe.motion.model_copy(update={"cylinder": cylinder})
    return recipe.model_copy(
        update={"duration": Value(TRIAL), "payload": "50 lb", "motion": motion}
    )


def _three_at_once() -> TrialRecipe:
    """The shipped trial in which swing and stick disturb the boom, on the model for TRIAL
    seconds."""
    recipe = load_recipe(RECIPES / "trials" / "disturbed_boom.toml")
    if not isinstance(recipe, TrialSetRecipe):
        raise AssertionError("disturbed_boom.toml is no set of trials")
    moving = next(item for item in recipe.cases() if item.motion and item.motion.also)
    return moving.model_copy(update={"duration": Value(TRIAL), "on": "model", "bench": None})


def _maps(rig: Rig) -> FlowMaps:
    """Flow maps of the thesis arm's valves from the shipped dataset."""
    from ehbench.data.flowmeter import read_flowmeter
    from ehbench.flow_maps.results import fit_flow_map
    from ehbench.physics.flow_map import collect

    recipe = load_recipe(RECIPES / "thesis" / "flow_maps.toml")
    if not isinstance(recipe, FlowMapRecipe):
        raise AssertionError("flow_maps.toml makes no flow maps")
    readings = [
        read_flowmeter(recipe.file(item.path), supply_pressure=float(rig.supply.pressure))
        for item in recipe.data
    ]
    groups = [(group, data.select(*group)) for data in readings for group in data.groups()]
    return collect([fit_flow_map(*group, rows).map for group, rows in groups])


@one_thread()
def main(arguments: Sequence[str] = ()) -> None:
    """Measure everything, or what is named (``studies``), and print the table."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    rig = load_rig(RIG)
    table = Table("what", "measured", "wanted", "", title=f"ehbench, {cores()} cores")
    for part in (
        studies,  # first: its peak of memory is the process's
        lambda: speed(rig),
        exported,
        lambda: chosen_steps(rig),
        lambda: closed_loop(rig),
        lambda: together(rig),
        lambda: accuracy(rig),
        lambda: fitting(rig),
        long_fitting,
        lambda: long_fitting(10_000.0),
        stiff_fitting,
        many_fitting,
        suggesting,
        logging,
        links,
        start_up,
    ):
        if arguments and getattr(part, "__name__", "") not in arguments:
            continue
        with console.status("measuring"):
            rows = list(part())
        for row in rows:
            required = f"{'at most' if row.lower else 'at least'} {row.limit:g} {row.unit}"
            table.add_row(
                row.what,
                f"{row.value:.3g} {row.unit}",
                required,
                "kept" if row.kept else "[red]missed",
            )
    console.print(table)


if __name__ == "__main__":
    main(sys.argv[1:])
