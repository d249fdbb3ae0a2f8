"""The compiled path is the tick-by-tick path to the bit; a log streamed is that written at once."""

from dataclasses import replace

import numpy as np
import pytest

from ehbench.config.recipe import TrialRecipe
from ehbench.control import LAW_NAMES
from ehbench.data import logs, read
from ehbench.data.logs import write_log
from ehbench.data.record import Record
from ehbench.machines.protocol import advance_of, truth_of
from ehbench.machines.simulated import SimulatedMachine
from ehbench.plant.model import Model
from ehbench.trial import account, prepare, run, session
from ehbench.vocabulary.errors import InputError
from tests.shared import shipped

RIG = shipped("slide_servo")
STEP = {"valve": "press.servo", "kind": "step", "amplitude": "4 V", "start": "0.1 s"}
STEP |= {"stop": "0.6 s"}
MOTION = {"kind": "point_to_point", "waypoints": ["150 mm", "200 mm", "150 mm"], "speed": "80 mm/s"}
MOTION |= {"hold": "0.3 s"}
GAINS = {"pressure_feedback": {"feedback_gain": "5e-12 m^3/(s*Pa)", "washout": "1 Hz"}}
CODE = """
class Mine:
    channels = ["press.x", "press.v"]
    notes = ["press.force"]
    def start(self, rig, tick, sample):
        self.note = [0.0]
    def step(self, t, sample, desired):
        self.note = [1e3 * sample["press.v"]]
        return [40.0 * (desired.x - sample["press.x"]) + 20.0 * desired.v]
"""
LAWS = {"commands": {"command": [STEP], "duration": "1.1 s"}}
LAWS |= {
    name: {"controller": {"kind": name, "gains": GAINS.get(name, {})}, "motion": MOTION}
    for name in LAW_NAMES
}
LAWS |= {"class": {"controller": {"class": "mine:Mine"}, "motion": MOTION}}
SPEED = {"speed_max": "70 mm/s"}


def trial(law, folder, **given):
    (folder / "mine.py").write_text(CODE)
    (folder / "trial.toml").write_text("# the recipe\n")
    given = LAWS[law] | given
    recipe = TrialRecipe(stage="trial", rig="x.toml", path=folder / "trial.toml", seed=3, **given)
    return prepare(recipe, RIG, allow_code=True)


def same(one: Record, other: Record) -> bool:
    alike = np.array_equal(one.t, other.t) and one.meta == other.meta
    alike &= list(one.channels) == list(other.channels)
    return alike and all(np.array_equal(one[name], other[name]) for name in one.channels)


@pytest.mark.slow
@pytest.mark.parametrize("limits", [{}, SPEED], ids=["free", "stopped"])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("on", ["model", "bench"])
def test_the_compiled_path_is_the_path_tick_by_tick(on, law, limits, tmp_path):
    prepared = trial(law, tmp_path, on=on, limits=limits)
    assert advance_of(prepared.machine) is not None
    many, one = run(prepared), run(prepared, fast=False)
    assert same(many.record, one.record) and many.facts == one.facts
    assert bool(many.facts.stopped) == bool(limits) and many.record.t.size > 300


@pytest.mark.slow
def test_a_trial_in_steps_chosen_by_the_guard(tmp_path):
    """To the bit by both paths, and as near to a fine step as such steps promise."""
    chosen = trial("commands", tmp_path, step="auto")
    many, one = run(chosen), run(chosen, fast=False)
    assert same(many.record, one.record)
    fine = run(trial("commands", tmp_path, step="0.0625 ms")).record
    for name in ("press.x", "press.v", "press.p_head", "press.p_rod"):
        missed = np.abs(many.record[name] - fine[name]).max()
        assert 0.0 < missed < 2e-5 * np.ptp(fine[name]), name  # as tests/physics/test_paced.py


LOADED = {
    "payload_change": [{"at": "0.7 s", "payload": "100 kg"}, {"at": "1.4 s", "payload": "none"}],
    "first_pressure_error": {"press.p_head": "-4 bar"},
}


@pytest.mark.parametrize("on", ["model", "bench"])
def test_a_load_picked_up_in_motion(on, tmp_path):
    """To the bit by both paths, and twice over; the ledger has a row of what went with it."""
    prepared = trial("arc", tmp_path, on=on, **LOADED)
    many, one, again = run(prepared), run(prepared, fast=False), run(prepared)
    assert same(many.record, one.record) and same(many.record, again.record)
    without = run(trial("arc", tmp_path, on=on)).record
    v, picked, put = many.record["press.v"], 700, 1400
    heavier = many.record["press.p_head"] - without["press.p_head"]
    assert np.abs(heavier[picked:put]).max() > 1e4
    assert many.facts.as_json()["payload_change"] == ((0.7, "100 kg"), (1.4, "none"))
    ledger = account(prepared, many).ledger
    assert ledger is not None and ledger["payload"] == "none, 100 kg from 0.7 s, none from 1.4 s"
    rows = {row["name"]: row["energy"] for row in ledger["rows"]}
    brought = 50.0 * (v[picked] ** 2 - v[put] ** 2)
    assert abs(brought) > 0.1 and rows["payload"] == pytest.approx(-brought, rel=1e-6)
    if on == "model":
        assert abs(rows["residual"]) < 1e-6 * rows["pump"]


def test_a_wrong_first_pressure_is_told_once(tmp_path):
    prepared = trial("arc", tmp_path, on="bench", **LOADED)
    right = trial("arc", tmp_path, on="bench")
    told, true = (one.first_rows(one.machine).sample for one in (prepared, right))
    off = dict(zip(prepared.machine.channels, (told - true).tolist(), strict=True))
    wrong = {name: value for name, value in off.items() if value}
    assert wrong == {"press.p_head": pytest.approx(-4e5)}
    log = run(prepared).record["press.p_head"]
    assert log[0] < log[1] - 3e5


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"payload_change": [{"at": "1 s", "payload": "7 t"}]}, "no payload '7 t'"),
        ({"payload_change": [{"at": "99 s", "payload": "none"}]}, "before its payload changes"),
        ({"first_pressure_error": {"boom.p_head": "1 bar"}}, "no pressure 'boom.p_head'"),
    ],
)
def test_a_change_that_cannot_be_is_refused(given, message, tmp_path):
    with pytest.raises(InputError, match=message):
        trial("arc", tmp_path, **given)


class Plain:
    """A machine that only knows the protocol, as hardware would: the model without the rest."""

    def __init__(self) -> None:
        self._model = SimulatedMachine(Model.of(RIG))
        self.name, self.latency, self.closed = "plain", 0.0, 0
        for name in ("channels", "commands", "strokes", "rate"):
            setattr(self, name, getattr(self._model, name))

    def check_posture(self, posture):
        self._model.check_posture(posture)

    def start(self, posture=None, low_side=None):
        return self._model.start(posture, low_side)

    def tick(self, command):
        return self._model.tick(command)

    def close(self):
        self.closed += 1


@pytest.mark.parametrize("law", LAWS)
def test_a_machine_needs_no_more_than_the_protocol(law, tmp_path):
    """What it measures is what the model measures, and the log has no more than that."""
    prepared, machine = trial(law, tmp_path), Plain()
    assert advance_of(machine) is None and truth_of(machine) is None
    model, result = run(prepared), run(prepared, machine)
    assert {"press.q", "press.qd"}.isdisjoint(result.record.channels), "a slide has no angle"
    for name in set(machine.channels) - {"press.q", "press.qd"}:
        if name != "p_tank":
            # the model's log has stroke and speed from the same linkage, over arrays
            assert np.allclose(result.record[name], model.record[name], rtol=1e-12, atol=1e-15)
    assert "press.servo.opening" in model.record and "press.servo.opening" not in result.record
    assert machine.closed == 1 and result.model is None and result.facts.on == "plain"


def test_a_machine_is_let_go_when_its_trial_fails(tmp_path):
    machine = Plain()
    prepared = trial("class", tmp_path)
    (tmp_path / "mine.py").write_text(CODE.replace("return [", "return [1 / 0, "))
    with pytest.raises(InputError, match="ZeroDivisionError"):
        run(prepared, machine, log=tmp_path / "log.mcap")
    assert machine.closed == 1


@pytest.mark.parametrize("limits", [{}, SPEED], ids=["free", "stopped"])
@pytest.mark.parametrize("sync", [1e9, 0.0], ids=["at leisure", "each chunk"])
@pytest.mark.parametrize("on", ["model", "bench"])
def test_the_log_of_a_trial_is_the_log_of_its_record(on, sync, limits, tmp_path, monkeypatch):
    """Byte for byte, whether syncs cut it up or not, and also where its facts were known late."""
    monkeypatch.setattr(session, "SESSION", replace(session.SESSION, wait=sync))
    prepared = trial("arc", tmp_path, on=on, limits=limits)
    record = run(prepared, log=tmp_path / "live.mcap").record
    back = read(tmp_path / "live.mcap")
    assert same(back, record) and not back.losses
    attached = back.attachments
    assert attached["recipe.toml"] == b"# the recipe\n" and b"press" in attached["rig.toml"]
    write_log(tmp_path / "once.mcap", Record(record.t, record.channels, record.meta, attached))
    assert (tmp_path / "live.mcap").read_bytes() == (tmp_path / "once.mcap").read_bytes()


def test_rows_of_a_slow_controller_are_in_the_log_while_it_runs(tmp_path, monkeypatch):
    """Not a thousand ticks later."""
    monkeypatch.setattr(session, "SESSION", replace(session.SESSION, wait=0.01))
    writer = logs.LogWriter  # what is logged is synced at once
    monkeypatch.setattr(logs, "LogWriter", lambda *a, **more: writer(*a, **more | {"sync": 0.0}))
    short = MOTION | {"waypoints": ["150 mm", "170 mm"], "hold": "0.1 s"}
    prepared, seen = trial("class", tmp_path, motion=short), []
    pause = "        import time; time.sleep(5e-4)\n"
    slow = CODE.replace("        return [", f"{pause}        return [")
    (tmp_path / "mine.py").write_text(slow)

    def told(_: str, share: float) -> None:
        seen.append((share * prepared.t.size, read(tmp_path / "live.mcap").t.size))

    run(prepared, log=tmp_path / "live.mcap", progress=told)
    assert len(seen) > 20
    assert all(rows == pytest.approx(asked) for asked, rows in seen)
