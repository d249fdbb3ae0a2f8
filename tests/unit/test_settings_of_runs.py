"""Each number of trials, views, links, studies, exports and foreign code decides an outcome, as in
`test_settings_matter`."""

import json
from collections import Counter
from concurrent.futures import Future
from contextlib import nullcontext, suppress
from functools import cache
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace as Stub
from typing import Any

import numpy as np

from ehbench.config.recipe import Limits, TrialRecipe
from ehbench.export import parts
from ehbench.links import client, quality
from ehbench.links.transport import SEQUENCE, STATE, TIME, TOKEN
from ehbench.live import board, screen, view, viewer
from ehbench.machines import fmu as fmu_machine
from ehbench.machines import paced
from ehbench.plant import stiffness
from ehbench.plant.model import Model
from ehbench.runtime import fmu
from ehbench.sampling import cluster, pools
from ehbench.sampling.sample import Sample
from ehbench.stages import study
from ehbench.trial import prepare, run, session, user_code
from ehbench.vocabulary.errors import InputError
from tests.settings import answers, each, each_shows, first_call, refusal
from tests.shared import shipped

ANY: Any = Stub()
SLIDE = shipped("slide_servo")
SESSION, CODE, VIEW = session.SESSION, user_code.CODE, board.VIEW
LINK, QUALITY, FMU = client.LINK, quality.QUALITY, fmu.FMU


class Clock:
    """Time that passes only where something waits, or by ``tick`` [s] at each look."""

    def __init__(self, tick=0.0):
        self.now, self.tick = 0.0, tick

    def monotonic(self):
        self.now += self.tick
        return self.now

    def sleep(self, seconds):
        self.now += seconds


def of(kind, **fields) -> Any:
    """An object without its beginning."""
    made = object.__new__(kind)
    vars(made).update(fields)
    return made


# --- trials


def reports(rows):
    """How often a trial of so many rows tells its progress."""
    told, prepared = [], Stub(payloads={})
    trial = of(session.Session, user_code=None, end=rows, prepared=prepared, machine=ANY)
    trial._truth, trial._next_look = ANY, rows
    trial._through = lambda first, until: (-1, until)
    trial._look = trial._log = lambda *_: None
    trial._run(None, lambda *_: told.append(1))
    return len(told)


def logged_after():
    """Rows of 10 ms until they are logged, and the time between syncs of the log."""
    clock = Clock()
    trial = of(session.Session, machine=ANY, watcher=None, stamps=None)
    trial._advance = trial._step = trial._packed = trial._operator = None
    trial._tick = lambda _: clock.sleep(0.01)
    trial.rows = ANY
    with answers(session, time=clock):
        return trial._through(0, 1000)[1]


def pace(seconds, done):
    """Whether a class is slow that took so long for the first of 1000 rows, or its refusal."""
    code, said = Stub(label="C", code=Stub(file=None)), []
    trial = of(session.Session, user_code=code, end=1000)
    return refusal(lambda: said.append(bool(trial._pace(done, seconds)))) or said[0]


def looks(speed):
    """Rows from one look at a machine that moves to the next; 0 where it stands."""
    rows = Stub(samples=np.full((500, 1), speed), sample=np.zeros(1), limits=np.full(99, 9.0))
    rows.checks, rows.t = Stub(stamp=np.zeros(5)), 1e-3 * np.arange(500)
    trial = of(session.Session, machine=Stub(channels=["a.v"]), rows=rows, stop=None, end=9999)
    recipe = Stub(limits=Stub(ramp=0.05))
    trial.prepared = Stub(aftermath=lambda *_: None, recipe=recipe)
    trial._stretch, trial._halted = 100, 0
    trial._look(500)
    return trial._next_look - 500


def overdue(seconds, started=False):
    """Whether a call of a class is ended that takes so long."""
    guard, clock = user_code.Guard(), Clock()
    law = of(user_code.UserCode, code=Stub(guard=guard, call=lambda *_: None), rate=1.0)
    law.object, law.design, law._seen, guard._since = Stub(start=None), None, lambda _: None, 1.0
    if started:
        law.start(ANY)
    clock.sleep(1.0 + seconds)
    with answers(user_code, time=clock), suppress(user_code.Overdue):
        return bool(guard._look())
    return True


def looked():
    """How often in 12 s a class's time is looked at."""
    timers: list[float] = []
    with answers(user_code.signal, setitimer=lambda _, *given: timers.append(given[-1])):
        with user_code.Guard().watched():
            return round(12.0 / timers[0])


def listed():
    """How many names a class's list of 5000 gives."""
    code = of(user_code._Code, call=lambda _, work: work())
    return len(code.names_of(Stub(notes=["a"] * 5000), "notes"))


# --- live views


def red(used):
    """Whether a limit is red of which so much is used."""
    row = {"used": used, "limit": "", "channel": "", "value": 0.0, "margin": 0.0, "unit": ""}
    frame = {"t": 0.0, "late": 0, "held": None, "state": "", "cylinders": [], "margins": [row]}
    facts: Any = Stub(title="", machine="", duration=1.0, rate=1.0, units={})
    shown: Any = screen.screen(facts, frame)
    return bool(shown.renderables[-1].rows[0].style)


def frames():
    """Frames of a trial of a second."""
    clock, sent = Clock(), []
    page = of(viewer.Page, _path=lambda: "events", _send=lambda *given: sent.append(given))
    page.send_response = page.send_header = page.end_headers = lambda *_: None
    frame = property(lambda _: {"state": "ended" if clock.now > 0.999 else "running"})
    page.server = type("Server", (), {"facts": None, "frame": frame})()
    with answers(viewer, time=clock):
        page.do_GET()
    return len(sent) - 2


def words(size):
    """The answer to so many bytes that a page says."""
    said, told = json.dumps({"held": True, "levers": []}).encode().ljust(size), []
    page = of(viewer.Page, headers={"Content-Length": size}, rfile=BytesIO(said))
    page._path, page._answer = lambda: "levers", told.append
    page.server = Stub(facts={"levers": [], "device": board.PAGE}, put=lambda _: None)
    page.do_POST()
    return told[0]


def holds(seconds):
    """Whether a lever holds that was silent for so long."""
    seen = of(view.View, _inputs=np.array([0.0, 1.0, 0.5]))
    with answers(view.time, monotonic=lambda: seconds):
        return seen.read() is not None


def ended(seconds):
    """Whether a view ends by itself that needs so long."""
    process = Stub(wait=max)
    shown = of(view.View, numbers=np.zeros(9), process=process)
    return first_call(process, "wait", shown.close)[0] >= seconds


# --- links


def link_of(**fields):
    """A link to a target of 1 kHz that says nothing, on a virtual clock."""
    link = Stub(virtual=True, receive=lambda _: [], send=lambda _: None)
    link = of(client.LinkMachine, link=link, name="", mode="stream", rate=1e3, **fields)
    link.rejected, link._number, link._up = Counter(), 0, len(client.HEADER)
    link._begin()
    return link


def silence(kind):
    """How long a target may say nothing [s], to a trial and where it must say its layout."""
    link = link_of()
    if kind == "answer":
        link._refuse_other_layout()
    else:
        link._refuse_other_layout = lambda: None
        with suppress(InputError):
            link.connect()
    return round(link.now(), 2)


def measured_for():
    """How long the measurement of a link waits for its target [s]."""
    clock = Clock()
    link: Any = Stub(virtual=False, send=lambda _: None, close=lambda: None)
    link.receive = lambda _: clock.sleep(0.01) or []
    with answers(quality, time=clock), suppress(InputError):
        quality.measure(link, "", 0.0)
    return round(clock.now, 1)


def other_rate(share):
    """The refusal of a target whose rate is off by a share."""
    link = link_of(channels=(), sample=lambda: np.zeros(0))

    def exchange(*_):
        link.newest[[SEQUENCE, TIME]] += 1.0, 1e-3 / (1.0 + share)
        return True

    link.exchange = exchange
    return refusal(link.connect)


def elsewhere(share):
    """The refusal of a stroke so far from where the trial begins, of a stroke of 1 m."""
    link = link_of(strokes=np.ones(1), channels=("a.x",), connect=lambda: None)
    link.prepared = Stub(machine=Stub(start=lambda *_: [0.0]), rig=Stub(shown=lambda *_: ""))
    link.sample = lambda: [share]
    return refusal(link.reach)


def without_supply(share):
    """The refusal of a machine with a share of the pressure that its supply begins at."""
    machine: Any = Stub(channels=("p_supply",))
    rig: Any = Stub(shown=lambda *_: "")
    pressures = np.array([2e7]), np.array([share * 2e7])
    return refusal(lambda: client.refuse_other_supply(machine, rig, *pressures))


def clock_jumps(seconds):
    """Whether a sample counts whose clock is so far beyond its count."""
    link = link_of()
    link.row, link._offset, numbers = 1, link.now(), link.newest.copy()
    numbers[[TOKEN, SEQUENCE, TIME]] = link.token, 1.0, 1e-3 + seconds
    return link._take(numbers)


def freezes(volts=10.0, seconds=1.0, rate=1000.0):
    """Whether samples that stay as they are for so long under a command are a stop."""
    link = link_of()
    link.rate = rate
    link.prepared, link.commands = Stub(loop=None), Stub(lowest=-10.0, highest=10.0, rest=0.0)
    link.channels, link.newest = ("press.x",), np.zeros(len(client.HEADER) + 1)
    return [link._frozen(np.full(1, volts), at) for at in (0.0, seconds)][1]


def drifts():
    """By how much a target's clock may run away in 1000 ticks of 1 ms [ms]."""
    link = link_of()
    link._offset = 0.0
    for _ in range(1000):
        link.exchange(STATE, np.empty(0))
    return round(1e3 * link._offset, 6)


def problems(late=0, gap=0.0, rate=1e3):
    """Why no trial may run over a link with so many late ticks of 1000, and such a gap of a
    watchdog's time; the time that would be enough [ms]."""
    seen = quality.Quality("", 1000, 0, late, (0.0, 0.0, 0.0), gap, 1.0, rate).problems()
    return [(item.key, item.fields.get("longer")) for item in seen]


# --- studies


def worker_waits(seconds, first=True):
    """Whether a sample of a limit of 1 s is waited for that takes so much longer."""
    pipe = Stub(send=lambda _: None, recv=lambda: 1, poll=lambda _: True)
    worker = of(pools._Worker, pipe=pipe, _grace=pools.POOLS.first_grace)
    if not first:
        worker.make(ANY, 1.0)
    pipe.poll = lambda wait: wait >= 1.0 + seconds
    return worker.make(ANY, 1.0) is not None


def died():
    """How many processes a sample ends that ends each."""
    began, pool = [], pools.Processes(ANY, 1, 1)
    pool._idle.put(None)

    def make(*_):
        began.append(1)
        raise EOFError

    with answers(pools, _Worker=lambda _: of(Clock, make=make, end=lambda: None)):
        pool._make(0, ANY)
    return len(began)


def chunks():
    """(chunks under way at first, samples in a later one) of a study on a cluster of two threads
    that makes each sample in 10 ms."""
    sizes = []

    def submit(_, __, chunk, **___):
        job: Any = Future()
        job.status = "finished"
        job.set_result([Sample(i, 0, "done", "", (), 0.01) for i, _ in chunk])
        sizes.append(len(chunk))
        return job

    here = Stub(scatter=lambda *_, **__: None, cancel=lambda *_, **__: None, submit=submit)
    here.nthreads = lambda: {"a": 2}
    work = of(cluster.Cluster, _client=nullcontext(here), _sent=None, _limit=None, _jobs={})
    work._done, work._seconds, work._count, work._alone = cluster.SimpleQueue(), 0.0, 0.0, []
    came = work.run((i, {}) for i in range(200))
    next(came)
    first = len(sizes)
    list(came)
    return first, max(sizes)


def stuck(seconds):
    """Whether a chunk of one sample of 1 s is given up after so long on a cluster."""
    clock, restarted = Clock(), []
    job: Any = Future()
    job.key = "a"
    here = Stub(processing=lambda: {"w": ["a"]}, cancel=lambda *_, **__: None)
    here.restart_workers = lambda *_, **__: restarted.append(1)
    work = of(cluster.Cluster, _client=here, _limit=1.0, _measures=1, _alone=[])
    work._jobs = {job: ([(0, {})], 0.0)}
    work._done = Stub(get=lambda timeout: (_ for _ in ()).throw(cluster.Empty))
    clock.sleep(seconds)
    with answers(cluster, time=clock):
        list(work._ready())
    return bool(restarted)


def in_threads():
    """How many samples of a second are made in threads before processes make the others."""
    clock, plan = Clock(), Stub(limit=None, allow_code=False, opened=ANY)
    prepared: Any = Stub(workers=Stub(scheduler="", count=1), plan=plan, measures=())
    with answers(study, time=clock):
        _, tasks = next(study._pools(prepared, iter([ANY] * 99)))
        return sum(1 for _ in tasks if clock.sleep(1.0) is None)


def table():
    """The bytes that a study of ten samples with one drawn key needs."""
    recipe: Any = Stub(recipe=(), identified=None, measures=(), at=lambda *_: {})
    inputs: Any = Stub(notes=Stub(collected=nullcontext))
    with answers(study, Design=lambda *_: Stub(columns=["a"], size=10)):
        work = lambda: study.StudyStage().prepare(recipe, inputs)  # noqa: E731
        return first_call(study, "refuse_beyond", work)[0]


def tried(edge):
    """Outer draws that are refused where a key takes no draw nearer to an end than this."""
    noted = []

    def refuse(settings):
        if not edge <= settings.get("a", 0.5) <= 1.0 - edge:
            raise InputError("sampling.no_dask")

    notes = Stub(add=lambda *_: noted.append(1), errors=(), collected=nullcontext)
    design: Any = Stub(settings=lambda _: {}, quantile=lambda _, share: {"a": share})
    design.drawn, recipe, inputs = [Stub(key="a")], Stub(recipe=("b",)), Stub(notes=notes)
    with answers(study, Sampler=lambda *_: Stub(refuse=refuse), _single_keys=()):
        study._try_keys(recipe, ANY, design, inputs)
    return len(noted)


# --- machines, exports and foreign code


def catches_up():
    """Ticks of 10 ms that end late after one of a second."""
    clock: Any = Clock()
    machine = paced.PacedMachine(Stub(rate=100.0, tick=lambda _: clock.monotonic()))
    with answers(paced, time=clock):
        for clock.tick in (5e-7, 0.5, *[5e-4] * 99):
            machine.tick(np.zeros(1))
    return machine.missed


def starts_off(share):
    """The refusal of an FMU whose stroke, of 1 m, begins so far from its posture."""
    layout, zero = Stub(cylinders=["a"]), np.zeros(1)
    model = Stub(layout=layout, rig=Stub(shown=lambda *_: ""), posture=lambda _: None)
    model.trim, model.record = lambda *_: zero, lambda *_: {"a.x": zero}
    model.commanded = model.values_at = lambda _: zero
    machine = of(fmu_machine.FmuMachine, model=model, channels=("a.x",), strokes=np.ones(1))
    machine.commands, machine._process = Stub(rest=zero), Stub(start=lambda _: zero + share)
    machine._sample = lambda x: x
    return refusal(machine.start)


def stiff(rate):
    """How many of so many steps in a second are examined for what makes them short."""
    looks, zeros = [], np.zeros((2, 1))
    model: Any = Stub(plant=Stub(at=Stub(work=1)), layout=Stub(state_names=["a"]))
    model.along = lambda *_: (model, zeros, None)
    model.paced = lambda *_, **__: (zeros, np.ones(rate, int))
    log: Any = Stub(sample_time=1.0, t=np.arange(2.0))
    with answers(stiffness, pace_of=lambda *_: Stub(units=rate + 1, weights=np.ones(1)),
                 derivatives=lambda *_: looks.append(1)):  # fmt: skip
        stiffness.stiffness_of(model, log, ANY)
    return len(looks) // 5


def child(name):
    """What the process of an FMU may take."""
    unit: Any = Stub(folder="")
    words = first_call(fmu.subprocess, "Popen", lambda: fmu.FmuProcess(unit, {"channels": []}))[0]
    return json.loads(words[-1])[name]


def hangs():
    """How long an FMU's answer is waited for [s]."""
    clock, pipe = Clock(), Stub(write=lambda _: None, flush=lambda: None, fileno=lambda: 0)
    process = of(fmu.FmuProcess, _child=Stub(stdin=pipe, stdout=pipe), fmu=Stub(file=None))
    process.close = lambda: None
    poll = Stub(register=lambda *_: None, poll=lambda wait: clock.sleep(1e-3 * wait))
    with answers(fmu, time=clock), answers(fmu.select, poll=lambda: poll):
        assert refusal(lambda: process._ask(0, np.zeros((1, 1)), 0.0)) == "runtime.fmu_hung"
    return clock.now


def requests():
    """Steps in each request of 1200 to an FMU."""
    asked, process = [], of(fmu.FmuProcess, width=1)
    process._ask = lambda _, table, __: asked.append(len(table)) or table
    process.steps(np.zeros((1200, 1)), 1e-3)
    return asked


def unpacked(size):
    """The refusal of an FMU whose files take so many bytes, and which is none."""
    archive = Stub(infolist=lambda: [Stub(file_size=size)])
    with answers(fmu, ZipFile=lambda _: nullcontext(archive)):
        return refusal(lambda: fmu.Fmu(ANY))


@cache
def long_trial():
    """A trial of the slide of 6 s, and its session, run."""
    step = {"valve": "press.servo", "kind": "step", "amplitude": "1 V", "start": "0.1 s"}
    recipe = TrialRecipe(
        stage="trial", rig="x.toml", path=Path("x.toml"), duration="6 s", command=[step]
    )
    prepared = prepare(recipe, SLIDE)
    ran = session.Session(prepared, prepared.machine)
    ran.run()
    return prepared, ran


def checked():
    """(steps of a trial of 6 s that the check of an exported model holds, drops of a valve's)."""
    prepared, ran = long_trial()
    layout = Model.of(SLIDE).layout
    with answers(parts, _rig_parameters=()):
        model = parts.model_part(prepared, ran, {})
        circuit = Stub(first=0, count=len(layout.edges))
        design: Any = Stub(model=Model.of(SLIDE), circuit=circuit, cylinder="press")
        return model.rows.shape[0], parts.valves_part(prepared, design).rows.shape[0]


def stopped():
    """Rows of a trial that a limit stops."""
    prepared, _ = long_trial()
    recipe = prepared.recipe.model_copy(update={"limits": Limits(speed_max="1 mm/s")})
    return run(prepare(recipe, SLIDE)).record.t.size


ROWS = [
    (SESSION, "chunk", lambda: reports(12_000), 12),
    (SESSION, "wait", logged_after, 40),
    (SESSION, "patience", lambda t: pace(t, 100), (19.0, 21.0), [False, True]),
    (SESSION, "longest", lambda t: pace(t, 1), (35.0, 37.0), [True, "trial.slow_class"]),
    (SESSION, "still", looks, (4.8e-3, 5.2e-3), [0, 100]),
    (SESSION, "look", stopped, 1754),
    (CODE, "start", overdue, (590.0, 610.0), [False, True]),
    (CODE, "step", lambda t: overdue(t, True), (59.0, 61.0), [False, True]),
    (CODE, "look", looked, 12),
    (CODE, "names", listed, 1000),
    (VIEW, "near", red, (0.89, 0.91), [False, True]),
    (VIEW, "width", lambda: screen._bar(0.5), "████████░░░░░░░░"),
    (VIEW, "frames", frames, 20),
    (VIEW, "longest", words, (4000, 4200), [204, 400]),
    (VIEW, "silence", holds, (0.24, 0.26), [True, False]),
    (VIEW, "end", ended, (1.9, 2.1), [True, False]),
    (LINK, "patience", lambda: (silence(""), measured_for()), (3.0, 3.0)),
    (LINK, "answer", lambda: silence("answer"), 0.5),
    (LINK, "rate", other_rate, (0.019, 0.021), ["", "links.other_rate"]),
    (LINK, "posture", elsewhere, (0.029, 0.031), ["", "links.stands"]),
    (LINK, "jump", clock_jumps, (0.09, 0.11), [True, False]),
    (LINK, "frozen", lambda t: freezes(seconds=t), (0.09, 0.11), [False, True]),
    (LINK, "frozen_samples", lambda n: freezes(seconds=n, rate=1.0), (9, 11), [False, True]),
    (LINK, "moving", freezes, (1.9, 2.1), [False, True]),
    (LINK, "supply", without_supply, (0.009, 0.011), ["links.supply", ""]),
    (LINK, "drift", drifts, 0.2),
    (QUALITY, "late", problems, (9, 11), [[], [("links.late", None)]]),
    (QUALITY, "gap", lambda s: problems(gap=s), (0.48, 0.52), [[], [("links.gap", 1040.0)]]),
    (QUALITY, "samples", lambda: problems(gap=0.9, rate=1.0), [("links.gap", 4000.0)]),
    (pools.POOLS, "first_grace", lambda t: (worker_waits(t), stuck(t + 9.0)), (119.0, 121.0),
     [(True, False), (False, True)]),
    (pools.POOLS, "grace", lambda t: worker_waits(t, False), (1.9, 2.1), [True, False]),
    (pools.POOLS, "attempts", died, 2),
    *each(cluster.CLUSTER, "under_way chunk", chunks, (6, 30)),
    (study.SETTINGS, "cells", table, 960.0),
    (study.SETTINGS, "short", in_threads, 10),
    (study.SETTINGS, "outer_draws", tried, (0.019, 0.021), [0, 2]),
    (paced.PACE, "lag", catches_up, 12),
    (fmu_machine.SETTINGS, "off", starts_off, (0.009, 0.011), ["", "machines.fmu_elsewhere"]),
    (stiffness.SETTINGS, "steps", stiff, (19_000, 21_000), [0, 100]),
    (stiffness.SETTINGS, "examined", stiff, (19_000, 21_000), [0, 100]),
    (FMU, "memory", lambda: child("memory"), 4e9),
    (FMU, "wait", lambda: (child("seconds"), hangs()), (30.0, 30.0)),
    (FMU, "rows", requests, [1000, 200]),
    (FMU, "unpacked", unpacked, (1.9e9, 2.1e9), ["runtime.fmu_unreadable", "runtime.fmu_large"]),
    *each(parts.EXPORT, "rows pairs", checked, (4000, 500)),
]  # fmt: skip

test_a_third_more_or_less_shows = each_shows(ROWS)
