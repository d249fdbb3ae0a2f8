"""Machines and controllers stepped from Python: `open_machine`, `open_controller`, `run_on`."""

import copy
import math

import numpy as np
import pytest

import ehbench
from ehbench.vocabulary.errors import InputError
from tests.shared import RECIPES, refused

RIG = RECIPES / "rigs" / "slide_servo.toml"
OWN = RECIPES / "trials" / "own_controller.toml"
MOTION = """
[motion]
kind = "point_to_point"
waypoints = ["100 mm", "130 mm"]
hold = "0.1 s"
speed = "150 mm/s"
"""
LAWS = {
    "open loop": 'duration = "0.3 s"\n[[command]]\nvalve = "press.servo"\nkind = "step"\n'
    'amplitude = "3 V"\nstart = "0.1 s"\n',
    "position": MOTION + '[controller]\nkind = "position"\n',
    "feedback": MOTION
    + '[controller]\nkind = "pressure_feedback"\ngains = { feedback_gain = "2e-11 m^3/(s*Pa)" }\n',
    "arc": MOTION + '[controller]\nkind = "arc"\n',
}


class Integrator:
    """A plant that shares nothing with ehbench: ``v = gain·u`` of its valve at once."""

    name, latency, gain = "integrator", 0.0, 0.05

    def __init__(self, rate: float = 1000.0) -> None:
        like = ehbench.open_machine(RIG)
        self.channels, self.commands, self.strokes = like.channels, like.commands, like.strokes
        self.rate, self.closed = rate, False

    def check_posture(self, posture):
        pass

    def start(self, posture=None, low_side=None):
        self.x = 1e-3 * 100.0
        return self.sample(0.0)

    def sample(self, v):
        known = {"press.x": self.x, "press.v": v, "press.q": self.x, "press.qd": v}
        return np.array([known.get(name, 1e6) for name in self.channels])

    def tick(self, command):
        v = self.gain * float(command[0])
        self.x += v / self.rate
        return self.sample(v)

    def close(self):
        self.closed = True


@pytest.mark.parametrize("law", LAWS)
def test_stepping_by_hand_is_the_trial_to_the_bit(law, tmp_path):
    recipe = tmp_path / "trial.toml"
    recipe.write_text(f'stage = "trial"\nrig = "{RIG}"\n{LAWS[law]}')
    machine, controller = ehbench.open_machine(recipe), ehbench.open_controller(recipe)
    for _ in range(2):  # it begins anew
        sample = machine.start(controller.posture, controller.low_side)
        controller.start(sample)
        samples, commands = [], []
        for _ in range(controller.ticks):
            samples.append(sample)
            commands.append(controller.step(sample))
            sample = machine.tick(commands[-1])
    record, facts = ehbench.run_on(recipe, ehbench.open_machine(recipe))
    assert not facts.stopped and np.ptp(record["press.x"]) > 1e-3
    assert np.array_equal(np.array(commands)[:, 0], record["press.servo.command"])
    for name in ("press.x", "press.p_head", "press.p_rod"):
        column = machine.channels.index(name)
        assert np.array_equal(np.array(samples)[:, column], record[name])
    with refused("trial.no_step", InputError):
        controller.step(sample)


def test_a_controller_drives_a_plant_of_the_users(tmp_path):
    """``v = gain·u`` under ``u = k (v_d + 12 (x_d − x))``: the error decays with 12·k·gain."""
    machine, log = Integrator(), tmp_path / "log.mcap"
    record, _ = ehbench.run_on(OWN, machine, log=log, allow_code=True)
    assert machine.closed and ehbench.read_log(log).t.size == record.t.size
    end = record["press.x_desired"][-1] - record["press.x"][-1]
    assert abs(end) < 1e-4 and record["press.x"].max() == pytest.approx(0.25, abs=5e-3)


def test_a_copy_of_a_machine_goes_its_own_way():
    machine = ehbench.open_machine(RIG, payload="100 kg", rate=500.0)
    machine.start({"press": "100 mm"})
    machine.tick(np.array([3.0]))
    ahead = copy.deepcopy(machine)
    there = [ahead.tick(np.array([5.0])) for _ in range(20)]
    here = [machine.tick(np.array([5.0])) for _ in range(20)]
    assert np.array_equal(there, here) and isinstance(machine, ehbench.Machine)


@pytest.mark.parametrize("change", [{"rate": 500.0}, {"channels": ("press.x",)}], ids=str)
def test_a_machine_that_does_not_fit_is_refused(change):
    machine = Integrator()
    vars(machine).update(change)
    with refused("trial.other_machine", InputError) as caught:
        ehbench.run_on(OWN, machine, allow_code=True)
    assert caught.value.hint


class Half:
    """A machine of somebody who stopped reading early."""

    channels, rate = ("press.x",), 1000.0


def test_half_a_machine_and_what_is_no_command_are_refused(tmp_path):
    recipe = tmp_path / "trial.toml"
    recipe.write_text(f'stage = "trial"\nrig = "{RIG}"\n{LAWS["position"]}')
    with refused("trial.no_machine", InputError) as error:
        ehbench.run_on(recipe, Half())
    missing = error.value.fields["names"].split(", ")
    expected = ["name", "commands", "strokes", "latency", "check_posture", "start", "tick", "close"]
    assert missing == expected
    machine = ehbench.open_machine(RIG)
    before = machine.start()
    for wrong in ([], [1.0, 2.0], [[1.0]], [math.nan], ["1 V"], {"press.servo": 1.0}):
        with refused("machines.other_command", InputError):
            machine.tick(wrong)
    assert np.isfinite(before).all() and np.isfinite(machine.tick([0.0])).all()
    for pressure in (math.nan, -1e7, "9 bar"):
        with pytest.raises(InputError, match="Pa"):
            machine.start(None, pressure)
    for rate in (0.0, -1.0, math.nan, None, "500 Hz"):
        with pytest.raises(InputError, match="rate"):
            ehbench.open_machine(RIG, rate=rate)


def test_what_is_no_sample_or_no_trial_is_refused():
    controller = ehbench.open_controller(OWN, allow_code=True)
    for take, key in (
        (lambda: controller.start(np.zeros(3)), "trial.other_sample"),
        (lambda: controller.start("sample"), "trial.other_sample"),
        (lambda: controller.step(np.zeros(len(controller.channels))), "trial.no_step"),
        (
            lambda: ehbench.open_controller(RECIPES / "slide_servo" / "tuning.toml"),
            "stages.no_trial",
        ),
        (lambda: ehbench.open_controller(OWN), "trial.code_not_allowed"),
    ):
        with refused(key, InputError):
            take()
    assert math.isfinite(controller.rate)
