"""Elements between a command and its opening: closed forms, series, ledger, linear model."""

import math

import numpy as np
import pytest
from plant_differences import plant_model
from scipy.signal import fftconvolve
from with_parts import closes, point_of

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.ledger import ledger_of_model
from ehbench.machines.simulated import SimulatedMachine
from ehbench.machines.virtual import VirtualMachine
from ehbench.parts.valve import valve_lag
from ehbench.plant.model import Model, simulate
from ehbench.plant.valves import acting_commands, follow_valves
from ehbench.tune.linear import development_model, faster
from tests.shared import shipped

SPOOL = {"natural_frequency": "80 Hz", "damping_ratio": 0.8}
OMEGA, ZETA = 2 * math.pi * 80.0, 0.8
KINDS = {
    "spool": SPOOL,
    "amplifier": {"natural_frequency": "60 Hz", "damping_ratio": 1.0},
    "lag": {"kind": "first_order", "lag": "6 ms"},
    "bus": {"kind": "delay", "delay": "5.3 ms"},
}
SERIES = [("amplifier", "spool"), ("lag",), ("lag", "spool"), ("spool", "lag")]
SERIES += [("bus", "spool"), ("bus", "lag", "spool")]
BUS = 5.3e-3
LAG = 6e-3
AMPLIFIER = 2 * math.pi * 60.0


def rig_with(*series: str, **more) -> Rig:
    """The sliding mass with elements in series in its valve."""
    plain = shipped("slide_servo").as_toml() | {"dynamics": KINDS | more}
    plain["cylinder"][0]["valve"][0]["dynamics"] = list(series)
    return Rig.model_validate(plain)


def step_of(rig: Rig, volts: float = 1.0, samples: int = 101) -> Record:
    """A step of the command at 10 ms."""
    u = np.zeros(samples)
    u[10:] = volts
    return simulate(rig, {"press.servo": u}, (samples - 1) / 1000)


def since(record: Record) -> np.ndarray:
    return np.maximum(record.t - 0.01, 0.0)


def steps(rig: Rig) -> tuple[Model, np.ndarray, Record]:
    """Random levels, each for a hundred ticks."""
    model = Model.of(rig)
    table = np.repeat(np.random.default_rng(1).uniform(-3, 3, (12, 1)), 100, axis=0)
    table[:10] = 0.0
    log = model.run(model.trim(model.posture(None)), table)
    return model, table, model.record(np.arange(1200) * 1e-3, table, log)


def test_a_first_order_valve_is_an_exponential():
    one = step_of(shipped("slide_servo"))
    listed = step_of(rig_with("spool"))
    assert all((one[name] == listed[name]).all() for name in one.channels)
    # To rounding, though the plant takes steps of 500 µs; a corner says the same
    record = step_of(rig_with("lag"))
    expected = 1 - np.exp(-since(record) / LAG)
    assert np.abs(record["press.servo.opening"] - expected).max() < 1e-11
    corner = {"kind": "first_order", "corner": f"{1 / LAG!r} rad/s"}
    other = step_of(rig_with("corner", corner=corner))
    assert np.abs(other["press.x"] - record["press.x"]).max() < 1e-15
    rig = rig_with("corner", corner=corner)
    assert float(rig.parameters()["corner.lag"]) == pytest.approx(LAG, rel=1e-12)
    slower = rig.with_values({"corner.lag": 0.01})
    assert float(slower.parameters()["corner.lag"]) == 0.01


def test_a_whole_delay_is_a_pure_shift():
    """Of the command alone and of what is behind it; a ticked machine says the same."""
    bus = {"kind": "delay", "delay": "5 ms"}
    record = step_of(rig_with("whole", whole=bus))
    assert (record["press.servo.opening"] == np.where(record.t > 0.0149, 1.0, 0.0)).all()
    plain = step_of(rig_with("spool"))
    for series in (("whole", "spool"), ("spool", "whole")):
        late = step_of(rig_with(*series, whole=bus))
        for name in ("press.servo.opening", "press.p_head", "press.x"):
            gap = np.abs(late[name][5:] - plain[name][:-5])
            assert gap.max() < 1e-11 * np.abs(plain[name]).max(), name


def test_a_delay_between_ticks_is_one_of_many_short_ticks():
    """Against ticks of 0.1 ms: the mean over 500 µs leaves what the spool does not smooth."""
    rig = rig_with("bus", "spool")
    record = step_of(rig)
    late = np.where(np.arange(1001) >= 100, 1.0, 0.0)
    fine = simulate(rig, {"press.servo": late}, 0.1, rate=1e4, step=1e-4)
    for name, share in (("press.servo.opening", 0.01), ("press.x", 1e-4)):
        gap = np.abs(record[name] - fine[name][::10])
        assert gap.max() < share * np.ptp(fine[name]), name
    after = record.t > 0.0165  # the impulse is exact, so nothing is left behind but of second order
    gap = np.abs(record["press.servo.opening"] - fine["press.servo.opening"][::10])[after]
    assert gap.max() < 2e-3
    record = step_of(rig_with("short", short={"kind": "delay", "delay": "0.2 ms"}))
    assert record["press.servo.opening"][9:12] == pytest.approx([0.0, 0.6, 1.0], abs=1e-12)


@pytest.mark.parametrize("series", [("bus",), ("bus", "lag", "spool")])
def test_ticks_and_replays_say_the_same(series):
    model, table, record = steps(rig_with(*series))
    machine = SimulatedMachine(model)
    machine.start()
    log = model.run(model.trim(model.posture(None)), table)
    for i in range(200):
        assert (machine.state == log[i, : machine.state.size]).all(), i
        machine.tick(table[i])
    again = model.replay(record, start=model.rest_start(record, 10))
    for name in ("press.x", "press.p_head", "press.servo.opening"):
        gap = np.abs(again[name] - record[name])
        assert gap.max() < 1e-6 * np.ptp(record[name]), name


def test_the_virtual_rig_is_as_late():
    """Its valve too: what it logs of a step moves by the whole delay."""
    made = []
    for series in (("spool",), ("whole", "spool")):
        rig = rig_with(*series, whole={"kind": "delay", "delay": "5 ms"})
        machine = VirtualMachine(rig)
        machine.start()
        at = machine.channels.index("press.p_head")
        made.append([machine.tick(np.array([2.0]))[at] for _ in range(40)])
    plain, late = np.array(made)
    start = plain[0]
    assert np.abs(late[:4] - start).max() < 0.05 * np.ptp(plain)
    assert np.abs(late[5:] - plain[:-5]).max() < 0.1 * np.ptp(plain)


def test_a_series_is_the_convolution():
    """The step response of both is that of one convolved with the impulse response of the other."""
    record = step_of(rig_with("amplifier", "spool"))
    fine = np.arange(0.0, 0.09, 1e-6)
    w = OMEGA * math.sqrt(1 - ZETA**2)
    impulse = OMEGA**2 / w * np.exp(-ZETA * OMEGA * fine) * np.sin(w * fine)
    before = 1 - np.exp(-AMPLIFIER * fine) * (1 + AMPLIFIER * fine)
    whole = fftconvolve(impulse, before)[: fine.size] * 1e-6
    expected = np.interp(since(record), fine, whole)
    # RK4's at 500 µs on the second element; the convolution is good to 1e-5
    assert np.abs(record["press.servo.opening"] - expected).max() < 1e-4
    inner = np.interp(since(record), fine, before)
    assert np.abs(record["press.servo.amplifier.opening"] - inner).max() < 1e-6


@pytest.mark.parametrize("series", [*SERIES, ("bus",)])
def test_the_ledger_closes(series):
    model, _, record = steps(rig_with(*series))
    ledger = ledger_of_model(model, record)
    assert ledger.notes == ()
    closes(ledger)


@pytest.mark.parametrize("series", SERIES)
def test_openings_follow_from_commands(series):
    """Without the plant, to what RK4 leaves over in the simulation."""
    model, table, record = steps(rig_with(*series))
    states, row = np.zeros((1200, model.layout.states)), model.plant.valves[0]
    felt = acting_commands(model.plant, table, 1e-3, 1e-3)
    follow_valves(record.t, felt, model.plant, False, states)
    gap = np.abs(states[:, row.output] - record["press.servo.opening"])
    # behind a delay, a tick feels the mean of what the model's steps tell apart
    assert gap.max() < (0.15 if "bus" in series else 3e-4)


@pytest.mark.parametrize("series", SERIES)
def test_the_linear_model_has_every_element(series):
    """Equations and differences agree, the steady gain is one, the lag that of low frequency."""
    model = Model.of(rig_with(*series))
    point = point_of(model, low=7e5, cross=7e5, speed=0.05)
    ours, plant = development_model(model, point), plant_model(model, point)
    assert ours.states == plant.states
    scale = np.ones(len(ours.states))
    scale[1:3] = 1e6
    scale[[name.endswith("rate") for name in ours.states]] = 100.0
    for one, other in ((ours.a, plant.a * 1.0), (ours.b, plant.b * 1.0)):
        columns = scale if one.shape[1] == scale.size else np.ones(1)
        gap = np.abs((one - other) * columns / scale[:, None])
        size = np.abs(one * columns / scale[:, None]).max(axis=1, keepdims=True)
        assert (gap <= 1e-6 * np.maximum(size, 1e-9)).all()

    def opening(linear, s):
        a, b = linear.a[3:, 3:], linear.b[3:, 0]
        found = np.linalg.solve(s * np.eye(b.size) - a, b)
        return found[[name.endswith("servo.opening") for name in linear.states[3:]]][0]

    assert opening(ours, 0.0) == pytest.approx(1.0, rel=1e-9)
    if "bus" in series:
        assert ours.fastest == pytest.approx(2.5 / BUS)
        bare = opening(development_model(Model.of(rig_with(*series[1:])), point), 80j)
        exact = bare * np.exp(-80j * BUS)
        assert opening(ours, 80j) == pytest.approx(exact, rel=1e-4)
    s = 1e-3j
    lag = valve_lag(model.plant.valves[0], model.plant)
    assert -np.angle(opening(ours, s)) / 1e-3 == pytest.approx(lag, rel=1e-5)
    quick = faster(ours, 10.0)
    assert opening(quick, 10 * 50j) == pytest.approx(opening(ours, 50j), rel=1e-9)


def test_a_rig_with_a_series_is_written_and_read_again():
    rig = rig_with("amplifier", "spool")
    assert Rig.model_validate(rig.as_toml()) == rig
    valve = rig.cylinder[0].valve[0]
    assert valve.with_dynamics(["spool"], "quick").series == ("amplifier", "quick")


# --- a drive that gives no more beyond some command


def with_limit(limit: str, name: str = "slide_servo") -> Rig:
    """A shipped rig whose drives give no more than a limit."""
    plain = shipped(name).as_toml()
    for cylinder in plain["cylinder"]:
        cylinder["valve"] = [one | {"drive_limit": limit} for one in cylinder["valve"]]
    return Rig.model_validate(plain)


def test_a_drive_gives_no_more_than_its_limit():
    """The motion is that of the clipped command, to the bit, and not that of a clipped opening;
    the log keeps what was commanded."""
    rig = with_limit("2 V")
    u = np.concatenate([np.zeros(50), np.full(200, 3.5), np.full(200, -2.5), np.full(50, 1.0)])
    seconds = 1e-3 * (u.size - 1)
    limited = simulate(rig, {"press.servo": u}, seconds)
    clipped = simulate(rig_with("spool"), {"press.servo": np.clip(u, -2.0, 2.0)}, seconds)
    for name in ("x", "v", "p_head", "p_rod"):
        assert np.array_equal(limited[f"press.{name}"], clipped[f"press.{name}"]), name
    assert np.array_equal(limited["press.servo.command"], u)
    assert np.ptp(limited["press.x"]) > 1e-3
    opening = limited["press.servo.opening"]
    behind = rig_with("spool")
    wide = simulate(behind, {"press.servo": u}, seconds)["press.servo.opening"]
    late = np.flatnonzero(opening[50:60] < 0.8 * np.minimum(wide[50:60], 2.0))
    assert late.size > 1  # it opens no faster than a step to its limit does


def test_a_design_and_the_rig_file_know_the_drives_limit():
    """Full speed is that of the limit: with 4 V of 10, that of a driver that takes 4 V."""
    speeds = []
    for rig in (with_limit("4 V"), rig_with("spool")):
        point = point_of(Model.of(rig), share=1.0)
        assert point.possible
        speeds.append(point.v)
    assert speeds[0] < 0.7 * speeds[1]
    rig = with_limit("4 V", "pump_cylinder")
    assert float(rig.parameters()["lift.drive.drive_limit"]) == 4.0
    less = rig.with_values({"lift.drive.drive_limit": 3.0})
    valve = Model.of(less).plant.valves[0]
    assert (valve.lowest, valve.highest) == (-3.0, 3.0) == less.cylinder[0].valve[0].given
    assert Rig.model_validate(less.as_toml()).cylinder[0].valve[0].given == (-3.0, 3.0)
    assert "lift.drive.drive_limit" not in shipped("pump_cylinder").parameters()
