"""Studies where samples, workers or the study die: what comes out is the same, byte for byte."""

import json
import os
import shutil
import signal
import subprocess
import threading
import time
from functools import partial
from pathlib import Path

import distributed  # before `config.set`, which else takes its defaults with it as it ends
import pytest
from dask import config

from ehbench import workflow
from ehbench.app import inspection
from ehbench.data import read
from ehbench.runs.rundir import read_json
from ehbench.sampling.cluster import Bundle, Cluster
from ehbench.sampling.pools import POOLS, Processes, in_threads
from ehbench.stages.base import write_rig
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.messages import is_warning, message
from tests.settings import at
from tests.shared import ROOT, refused, shipped

pytestmark = pytest.mark.usefixtures("all_undrawn")
QUICK = {"distributed.comm.timeouts.connect": 0.5}
# what makes samples here: number 5 may die, 6 may hang, and each says in which process it was made
MAKERS = """
import os, time
from pathlib import Path
from ehbench.sampling.sample import Sample

def opened(how, log, root=None):
    def make(index, settings):
        with open(Path(log) / str(os.getpid()), "a") as file:
            file.write(f"{index}\\n")
        if index in how.get("dies", ()):
            os._exit(1)
        if index in how.get("hangs", ()):
            time.sleep(600)
        time.sleep(how.get("takes", 0.0))
        code = 1 if index in how.get("raises", ()) else 0
        return Sample(index, code, "done", "", (index * 0.1, float(settings["x"])), 0.01)
    return make
"""


@pytest.fixture(scope="module")
def makers(tmp_path_factory):
    """A module that other processes can import, as they would the package."""
    folder = tmp_path_factory.mktemp("makers")
    (folder / "study_makers.py").write_text(MAKERS, encoding="utf-8")
    paths = [str(folder), os.environ.get("PYTHONPATH", "")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(path for path in paths if path))
        patch.syspath_prepend(str(folder))
        # pyrefly: ignore[missing-import]
        import study_makers

        yield study_makers.opened


@pytest.fixture(scope="module")
def cluster(makers):
    """A Dask scheduler and two worker processes on loopback."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        quiet = {"dashboard_address": None, "silence_logs": 50, "host": "127.0.0.1"}
        with distributed.LocalCluster(n_workers=2, threads_per_worker=1, **quiet) as made:
            made.wait_for_workers(2, timeout=60)
            yield made


def samples(run, count=40):
    """What is made, in order of the numbers, and the order in which it came."""
    tasks = ((i, {"x": str(i)}) for i in range(count))
    came = [one for some in run(tasks) for one in some]
    return sorted(one._replace(seconds=0.0) for one in came), [one.index for one in came]


def test_a_sample_that_hangs_or_dies_costs_itself_only(makers, tmp_path):
    how = {"dies": (5,), "hangs": (16,), "takes": 0.01}
    pool = Processes(partial(makers, how, tmp_path), 2, 2, 0.3)
    # what hangs may be the first sample of a new process
    with at(POOLS, "grace", 0.3), at(POOLS, "first_grace", 10.0):
        made, _ = samples(pool.run)
    assert [one.index for one in made] == list(range(40))
    bad = {one.index: (one.code, one.status, one.message.key) for one in made if one.code}
    assert bad[5] == (1, "failed", "sampling.died")
    assert bad[16] == (5, "late", "sampling.ended")
    assert len(bad) == 2 and not pool.workers
    whole, _ = samples(partial(in_threads, makers({}, tmp_path), workers=3))
    good = [one for one in made if one.index not in bad]
    assert repr(good) == repr([one for one in whole if one.index not in bad])
    tried = [line for path in tmp_path.iterdir() for line in path.read_text().split()]
    assert tried.count("5") == 3  # twice in processes, once in the thread that does not die


def test_a_cluster_whose_worker_is_killed_loses_nothing(makers, cluster, tmp_path):
    how = {"takes": 0.02}
    bundle = Bundle({}, partial(makers, how, tmp_path))
    assert len(cluster.scheduler_info["workers"]) == 2

    def kill():
        while not any(tmp_path.iterdir()):
            time.sleep(0.02)
        time.sleep(0.3)
        os.kill(int(next(tmp_path.iterdir()).name), signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    made, came = samples(Cluster(workflow.Workers(cluster.scheduler_address), bundle, 2).run, 120)
    killer.join()
    whole, _ = samples(partial(in_threads, makers({}, tmp_path), workers=1), 120)
    assert repr(made) == repr(whole)
    assert len(came) == 120


def test_workers_are_so_many_here_or_those_of_a_scheduler():
    for said, scheduler in (
        ("tcp://127.0.0.1:8786", "tcp://127.0.0.1:8786"),
        ("localhost:8786", "tcp://localhost:8786"),
        ("tcp://[::1]:8786", "tcp://[::1]:8786"),
        ("10.1.2.3:8786", "tls://10.1.2.3:8786"),
        ("host:8786", "tls://host:8786"),
        ("wss://host:8786", "wss://host:8786"),
    ):
        assert workflow.Workers.of(said) == workflow.Workers(scheduler=scheduler)
    assert workflow.Workers.of("") == workflow.Workers()
    assert workflow.Workers.of("3") == workflow.Workers(count=3)


OPEN = "tcp://host:8786 tcp://10.1.2.3:8786 ws://host:8786 tcp://[fe80::1]:8786 ucx://host:1"
OPEN += " tcp://localhost.example.org:1 tcp://127.0.0.1@host:1 tcp://[bad:1"


@pytest.mark.parametrize("said", OPEN.split())
def test_pickles_go_to_no_other_machine_unencrypted_unless_it_is_said(said):
    with refused("sampling.not_encrypted"):
        workflow.Workers.of(said)
    assert workflow.Workers.of(said, insecure=True).scheduler == said


def test_certificates_are_files_and_come_together(tmp_path):
    (tmp_path / "a.pem").write_text("")
    for given, key in (
        ((tmp_path / "a.pem", None, None), "sampling.some_certificates"),
        ((tmp_path / "a.pem", tmp_path / "a.pem", tmp_path), "sampling.no_certificate"),
    ):
        with refused(key):
            workflow.Workers.of("tls://host:8786", given)


def authority(folder: Path, name: str) -> workflow.Certificates:
    """A certificate with its key, and the authority that signed it."""
    ca, ca_key, cert, key, wish = (folder / f"{name}_{i}.pem" for i in range(5))
    new = ("openssl", "req", "-newkey", "rsa:2048", "-nodes", "-batch", "-subj")
    for line in (
        (*new, "/CN=ca", "-x509", "-days", "2", "-keyout", ca_key, "-out", ca),
        (*new, "/CN=us", "-keyout", key, "-out", wish),
        ("openssl", "x509", "-req", "-in", wish, "-CA", ca, "-CAkey", ca_key)
        + ("-CAcreateserial", "-days", "2", "-out", cert),
    ):
        subprocess.run(line, check=True, capture_output=True)
    return workflow.Certificates(ca, cert, key)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="there is no openssl here")
def test_an_encrypted_cluster_works_for_who_has_a_certificate_of_its_authority(makers, tmp_path):
    ours, strange = authority(tmp_path, "ours"), authority(tmp_path, "strange")
    ca, cert, key = map(str, ours)
    files = {"tls_ca_file": ca, "require_encryption": True}
    for role in ("scheduler", "worker", "client"):
        files |= {f"tls_{role}_cert": cert, f"tls_{role}_key": key}
    (tmp_path / "made").mkdir()
    bundle = Bundle({}, partial(makers, {}, tmp_path / "made"))
    with distributed.LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        protocol="tls",
        host="tls://127.0.0.1",
        security=distributed.Security(**files),
        dashboard_address="127.0.0.1:0",
        silence_logs=50,
    ) as cluster:
        address = cluster.scheduler_address
        made, _ = samples(Cluster(workflow.Workers.of(address, ours), bundle, 2).run, 9)
        assert [one.index for one in made] == list(range(9))
        for workers, key in (
            (workflow.Workers.of(address, strange), "sampling.no_scheduler"),
            (workflow.Workers.of(address), "sampling.certificates_missing"),
            (workflow.Workers.of(address.replace("tls:", "tcp:")), "sampling.no_scheduler"),
        ):
            with refused(key), config.set(QUICK):
                Cluster(workers, bundle, 2)


def test_the_hint_starts_no_scheduler_that_others_reach():
    hint = message("sampling.no_scheduler", address="", reason="").hint
    assert "--host 127.0.0.1 --dashboard-address 127.0.0.1:" in hint


@pytest.mark.parametrize("said", ["0", "-2", "1.5", "many", " "])
def test_workers_that_are_neither_are_refused(said):
    with pytest.raises(InputError, match="a number from 1 on, or the address of a Dask scheduler"):
        workflow.Workers.of(said)


def test_nobody_answers(makers):
    with refused("sampling.no_scheduler"), config.set(QUICK):
        Cluster(workflow.Workers("tcp://127.0.0.1:9"), Bundle({}, None), 2)


# --- a real study


TRIAL = """
stage = "trial"
rig = "{rig}"
duration = "0.1 s"
posture = {{ press = "60 mm" }}

[[command]]
valve = "press.servo"
kind = "step"
amplitude = "3 V"
start = "10 ms"

[limits]
speed_max = "200 mm/s"
"""
STUDY = """
stage = "study"
recipe = "trial.toml"
samples = 8
seed = 3
keep = 1
measures = [
    "duration",
    { name = "speed", channel = "press.v", take = "max", unit = "mm/s" },
]

[draw]
"rig.bulk_modulus" = { low = 0.5, high = 1.5, relative = true }
"rig.supply.pressure" = { low = 0.2, high = 1.2, relative = true }

[sweep]
"recipe.payload" = ["none", "100 kg"]

[[target]]
measure = "speed"
at_most = "150 mm/s"
"""


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """The recipe of a small study, and its run on this machine."""
    folder = tmp_path_factory.mktemp("study")
    rig = ROOT / "recipes/rigs/slide_servo.toml"
    (folder / "trial.toml").write_text(TRIAL.format(rig=rig), encoding="utf-8")
    path = folder / "study.toml"
    path.write_text(STUDY, encoding="utf-8")
    return path, workflow.run(path, workflow.Session(out=folder / "here")).folder


def same(first: Path, second: Path) -> None:
    """Two runs of a study are the same, byte for byte."""
    names = [path.relative_to(first) for path in sorted(first.rglob("*")) if path.is_file()]
    for name in names:
        if name.name != "volatile.json":
            assert (first / name).read_bytes() == (second / name).read_bytes(), name


@pytest.mark.slow
def test_a_cluster_makes_the_same_bytes(study, cluster, tmp_path):
    path, here = study
    workers = workflow.Workers(scheduler=cluster.scheduler_address)
    there = workflow.run(path, workflow.Session(out=tmp_path / "there", workers=workers))
    same(here, there.folder)


def test_where_nobody_answers_nothing_is_left(study, tmp_path):
    workers = workflow.Workers.of("tcp://127.0.0.1:9")
    with refused("sampling.no_scheduler"), config.set(QUICK):
        workflow.run(study[0], workflow.Session(out=tmp_path / "run", workers=workers))
    assert not list(tmp_path.iterdir())


@pytest.mark.filterwarnings("ignore")
def test_a_scheduler_without_workers_is_named(study, tmp_path):
    quiet = {"dashboard_address": None, "silence_logs": 50, "host": "127.0.0.1"}
    with distributed.LocalCluster(n_workers=0, **quiet) as idle, config.set(QUICK):
        workers = workflow.Workers(scheduler=idle.scheduler_address)
        with refused("sampling.no_worker"):
            workflow.run(study[0], workflow.Session(out=tmp_path / "run", workers=workers))
    assert not list(tmp_path.iterdir())


def test_a_killed_study_goes_on(study, tmp_path):
    path, here = study
    out = tmp_path / "run"
    journal = tmp_path / "run.samples.jsonl"
    seen = []

    def stop(what, share):
        seen.append(what)
        if len(seen) == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        session = workflow.Session(out=out, progress=stop, workers=workflow.Workers(count=1))
        workflow.run(path, session)
    kept = [json.loads(line) for line in journal.read_text().splitlines()[1:]]
    assert 0 < len(kept) < 16 and not out.exists()
    lines = journal.read_text().splitlines(keepends=True)
    journal.write_text("".join(lines) + '{"i":9,"c":', encoding="utf-8")  # torn by the kill
    told = []
    workers = workflow.Workers(count=1)
    tell = lambda *said: told.append(said[0])
    session = workflow.Session(out=out, workers=workers, resume=True, progress=tell)
    outcome = workflow.run(path, session)
    assert int(told[0].split()[1]) > len(kept) and not journal.exists()
    assert "left" not in told[0]  # its time is that of compilers
    assert "stages.begun_anew" not in [getattr(note, "key", "") for note in outcome.notes]
    same(here, out)
    another = path.with_name("another.toml")
    another.write_text(path.read_text(encoding="utf-8").replace("seed = 3", "seed = 4"))
    (tmp_path / "other.samples.jsonl").write_text("".join(lines), encoding="utf-8")
    outcome = workflow.run(another, workflow.Session(out=tmp_path / "other", resume=True))
    (note,) = [note for note in outcome.notes if getattr(note, "key", "") == "stages.begun_anew"]
    assert is_warning(note)


def test_a_sample_is_made_again_bit_for_bit(study, tmp_path):
    path, here = study
    kept = read_json(here / "study.json")["worst"][0]
    session = workflow.Session(root=tmp_path)
    recipe = workflow.sample(here, kept["sample"], session)
    assert recipe.step == "auto"
    made = workflow.run(recipe, session)
    for name in ("log.mcap", "ledger.json", "rig.toml"):
        assert (made.folder / name).read_bytes() == (here / kept["folder"] / name).read_bytes()
    row = (here / "samples.csv").read_text(encoding="utf-8").splitlines()[kept["sample"] + 1]
    fastest = float(read(made.folder / "log.mcap")["press.v"].max())
    assert repr(1e3 * fastest)[:12] in row
    with pytest.raises(InputError, match="has no sample 16 "):
        workflow.sample(path, 16, session)


def test_unknown_keys_and_measures_are_named_at_check(study, tmp_path):
    path, _ = study
    text = path.read_text(encoding="utf-8")
    for old, new, said in (
        ("rig.bulk_modulus", "rig.bulk_modulos", "nearest is 'rig.bulk_modulus'"),
        ('"duration",', '"duratoin",', "nearest: duration"),
        ("recipe.payload", "recipe.pay", "unknown key 'pay'"),
        ('measure = "speed"', 'measure = "sped"', "nearest: speed"),
        ('"press.v"', '"pres.v"', "nearest: press.v"),
        ('"100 kg"', '"100 kgs"', "no payload '100 kgs'"),
        ("samples = 8", "samples = 90_000_000", "GB of memory"),
    ):
        wrong = path.with_name("wrong.toml")
        wrong.write_text(text.replace(old, new), encoding="utf-8")
        found = inspection.check(wrong)
        assert found.code == 2 and said in str(found.errors[0]), found.errors
        assert found.errors[0].line, found.errors[0]


@pytest.mark.slow
def test_an_outer_draw_that_a_rig_refuses_is_noted(study):
    path, _ = study
    wide = path.with_name("wide.toml")
    wide.write_text(path.read_text(encoding="utf-8").replace("low = 0.2", "low = -0.2"))
    found = inspection.check(wide)
    assert found.code == 0
    note = next(line for line in found.lines if "note" in line)
    assert "a sample with rig.supply.pressure = -0.172 times is refused" in note


@pytest.mark.slow
@pytest.mark.parametrize(("key", "is_redesigned"), [("rig", True), ("recipe.machine", False)])
def test_a_controller_that_is_designed_on_what_was_drawn_is_noted(key, is_redesigned, tmp_path):
    """The open loop of `study` needs no note."""
    rig, _, _ = TRIAL.format(rig=ROOT / "recipes/rigs/slide_servo.toml").partition("[[command]]")
    motion = """[motion]
kind = "point_to_point"
waypoints = ["60 mm", "62 mm"]
speed = "50 mm/s"
[controller]
kind = "position"
"""
    (tmp_path / "trial.toml").write_text(rig.replace('posture = { press = "60 mm" }', "") + motion)
    text = f"""stage = "study"
recipe = "trial.toml"
samples = 1
measures = ["tracking.max_error"]
[draw]
"{key}.bulk_modulus" = {{ low = 0.5, high = 0.6, relative = {str(is_redesigned).lower()} }}
"""
    (tmp_path / "study.toml").write_text(text)
    outcome = workflow.run(tmp_path / "study.toml", workflow.Session(out=tmp_path / "run"))
    noted = [note.key for note in outcome.notes]
    assert noted == ["stages.redesigned"] * is_redesigned


@pytest.mark.slow
def test_gains_of_a_rig_of_other_numbers_are_noted_wherever_they_are_used(tmp_path):
    """The trial, its check, its study and its export, in plain sight; not on the very rig."""
    known = {"carriage.mass": 340.0, "bulk_modulus": 1e9, "supply.pressure": 1.3e7}
    rig = shipped("slide_servo")
    (tmp_path / "tuned").mkdir()
    write_rig(tmp_path / "tuned", rig.with_values(known), None)
    tuning = {"cylinder": "press", "feedback_gain": {"extend_resistive": 3e-12}, "washout": 5.0}
    facts = {"validated": False, "reservations": ["mass: 3 % more", "bore: 1 % more"]}
    (tmp_path / "tuned" / "tuning.json").write_text(json.dumps(tuning))
    (tmp_path / "tuned" / "run.json").write_text(json.dumps(facts))
    # in even steps: kernels of this law in others would be compiled for this alone
    text = """stage = "trial"
rig = "{rig}"
step = "0.5 ms"
[motion]
kind = "point_to_point"
waypoints = ["60 mm", "62 mm"]
speed = "50 mm/s"
[controller]
kind = "pressure_feedback"
gains = "tuned/tuning.json"
"""
    (tmp_path / "same.toml").write_text(text.format(rig="tuned/rig.toml"))
    (tmp_path / "trial.toml").write_text(text.format(rig=ROOT / "recipes/rigs/slide_servo.toml"))
    study = """stage = "study"
recipe = "trial.toml"
samples = 1
measures = ["tracking.max_error"]
[draw]
"recipe.motion.speed" = { low = "40 mm/s", high = "50 mm/s" }
"""
    (tmp_path / "study.toml").write_text(study)

    def of_tuning(notes):
        """What they say of the rig's numbers; what its validation said is always there."""
        by_key = {getattr(note, "key", ""): note for note in notes}
        assert is_warning(by_key["stages.tuned_unvalidated"])
        reserved = by_key["stages.tuned_with_reservation"]
        assert is_warning(reserved) and reserved.fields["reason"] == "mass: 3 % more"
        return [note for note in notes if getattr(note, "key", "") == "trial.other_rig"]

    def noted(work, name):
        outcome = work(workflow.Session(out=tmp_path / name, unvalidated=True))
        return of_tuning(outcome.notes)

    def checked(name):
        notes = inspection.check(tmp_path / name).notes
        assert notes is not None
        return of_tuning(notes.remarks)

    assert noted(lambda session: workflow.run(tmp_path / "same.toml", session), "same") == []
    assert checked("same.toml") == []
    options = {"formats": ["matlab"]}
    for name, work in {
        "trial": lambda session: workflow.run(tmp_path / "trial.toml", session),
        "study": lambda session: workflow.run(tmp_path / "study.toml", session),
        "export": lambda session: workflow.export(tmp_path / "trial.toml", options, session),
    }.items():
        (note,) = noted(work, name)
        assert [note] == checked("trial.toml") and is_warning(note)
        # the shipped file has 250 kg and 900 MPa; the supply has a note of its own
        assert note.fields["count"] == 2 and note.fields["name"] == "carriage.mass"
        assert (note.fields["tuned"], note.fields["here"]) == ("340 kg", "250 kg")
