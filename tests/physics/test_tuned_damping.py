"""Gains chosen on linear models, tried on the non-linear one: it damps as promised."""

import math

import numpy as np
import pytest

from ehbench.config.recipe import TuneRecipe
from ehbench.control import pressure_feedback as pf
from ehbench.control.functions import pack_rules
from ehbench.control.records import blank
from ehbench.machines.simulated import model_tick
from ehbench.parts.cylinder import linkage_of
from ehbench.parts.sample import perfect_sample
from ehbench.parts.valve.delay import line_of
from ehbench.plant.design_point import circuit_of
from ehbench.plant.model import Model
from ehbench.tune.gains import tune_pressure_feedback
from ehbench.tune.operating_point import state_of
from ehbench.tune.study import NONE, prepare_tuning
from ehbench.vocabulary.codes import FUNCTIONS
from tests.shared import shipped

TICK = 1e-3


class Running:
    """A rig at an operating point, running under tuned pressure feedback."""

    def __init__(self, rig, tuning, result):
        point = result.point
        self.model = Model.of(rig, None, None if point.payload == NONE else point.payload)
        self.plant, self.layout, self.point = self.model.plant, self.model.layout, point
        self.index = self.layout.cylinders.index(point.cylinder)
        self.circuit = circuit_of(self.model, self.index)
        low = tuning.low_pressure
        rules = pack_rules(self.circuit.area_rod, point.p_supply, low_pressure=low)
        names = ("tick", "feedback_gain", "washout", "ramp_washout", "off_gain", "low_pressure")
        given = {name: getattr(tuning, name) for name in names}
        self.gains = pf.pack_pressure_feedback(rules=rules, **given)
        self.start, self.command = state_of(self.model, point)
        # as the pressures of both ends, behind one washout, behind both: there at rest is nothing
        last = (point.p_head, point.p_rod)
        self.memory = np.array([*last, *((0.0, 0.0) if tuning.washout > 0 else last), 0.0, 0.0])
        n = len(self.layout.joints)
        # steps of a state for differences: rad or m, per second, Pa, V, V/s, Pa of the supply and
        # of the controller's memory
        valves, ends = len(self.layout.valves), 2 * len(self.layout.cylinders)
        sizes = [(n, 1e-6), (n, 1e-5), (ends, 300.0), (valves, 1e-4), (valves, 1e-2)]
        sizes += [(1 + self.memory.size, 300.0)]
        self.sizes = np.concatenate([np.full(count, size) for count, size in sizes])

    def after(self, push, ticks):
        """State of machine and controller after some ticks from the operating point and a push."""
        size, c = self.layout.states, self.circuit
        y, command = self.start + push[:size], self.command.copy()
        memory, telemetry = blank(pf.MEMORY), np.zeros(pf.COLUMNS + 2 * c.count)
        function = FUNCTIONS.index(self.point.function)
        memory.started, memory.function, memory.slow_load = 1, function, self.point.load_force
        for name, ends in zip(pf.END.names, (self.memory + push[size:]).reshape(3, 2), strict=True):
            memory.ends[name] = ends
        k, sample = np.empty((5, size)), np.empty(6 * len(self.layout.cylinders) + 2)
        work = np.empty(self.plant.at.work)
        perfect_sample(y, self.plant, sample)
        reference = (0.0, self.point.v, 0.0, 0.0)
        for i in range(ticks):
            pf.step(i * TICK, sample, reference, c, self.gains, memory, command, telemetry)
            assert telemetry[5] == function and not telemetry[-c.count :].any()
            model_tick(y, command, self.plant, line_of(self.plant, TICK), 2, k, work, sample)
        return np.concatenate([y, *(memory.ends[name] for name in pf.END.names)])

    def speeds(self, y):
        """∂(x, v)/∂(q, q̇) of the cylinder: what swings is judged as speed."""
        row, n = self.plant.cylinders[self.index], len(self.layout.joints)
        j = int(row.joint)
        _, lever, curve = linkage_of(row, y[j])
        turn = np.eye(y.size)
        turn[j, j] = turn[n + j, n + j] = lever
        turn[n + j, j] = curve * y[n + j]
        return turn

    def modes(self, ticks):
        """(poles [rad/s], share of each in this cylinder, its valves and its controller)."""
        pushes = np.diag(self.sizes)
        columns = [(self.after(p, ticks) - self.after(-p, ticks)) / 2.0 for p in pushes]
        still = 0.0 * self.sizes
        first, last = (self.speeds(self.after(still, count)) for count in (0, ticks))
        # columns are answers to whole steps: in units of the steps the matrix is well scaled
        before = np.linalg.inv(first * self.sizes / self.sizes[:, None])
        matrix = last @ np.array(columns).T @ before / self.sizes[:, None]
        grown, right = np.linalg.eig(matrix)
        part = np.abs(np.linalg.pinv(right).T * right)
        layout, n = self.layout, len(self.layout.joints)
        j = int(self.plant.cylinders[self.index].joint)
        own = [j, n + j, layout.state("p_head", self.index), layout.state("p_rod", self.index)]
        for i, valve in enumerate(layout.valves):
            if valve.startswith(self.point.cylinder + "."):
                own += [layout.state("opening", i), layout.state("rate", i)]
        own += range(layout.states, self.sizes.size)
        left = np.abs(grown) > 1e-9  # what is forgotten within the ticks has no logarithm
        shares = (part / part.sum(axis=0))[own][:, left].sum(axis=0)
        return np.log(grown[left].astype(complex)) / (ticks * TICK), shares


def damped(cylinder, payloads, postures, shares, **more):
    """A recipe of pressure feedback without draws."""
    given = {"cylinder": cylinder, "payloads": payloads, "postures": postures, "draws": 0}
    given |= {"speed_shares": shares, "delay": "0.5 ms"} | more
    return TuneRecipe(stage="tune", rig="x", **given)


def damped_as_promised(rig, tuning, result):
    """Whether a point promises a steady motion; fail unless its pair swings within 15 % of that.

    A lever that changes by more than half in one swing is no steady motion."""
    ratio, size = result.damping_ratio_closed, result.natural_frequency_closed
    if not result.counts or 0.5 * abs(result.point.bend) * 2.0 * math.pi / size > 0.5:
        return False
    pair = size * complex(-ratio, math.sqrt(1.0 - ratio**2))
    promised = min((complex(*p) for p in result.closed_poles), key=lambda p: abs(p - pair))
    poles, share = Running(rig, tuning, result).modes(5)
    poles = poles[(share > 0.5) & (poles.imag > 0.0)]
    seen = poles[np.argmin(np.abs(np.log(poles / promised)))]
    assert -seen.real / abs(seen) == pytest.approx(ratio, rel=0.15), result.name
    assert abs(seen) == pytest.approx(abs(promised), rel=0.15), result.name
    return True


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "cylinder", "payloads"),
    [
        ("thesis_arm", "boom", ("none",)),
        ("boom_four_valve", "boom", ()),
        ("crane_proportional", "lift", ()),
        ("slide_servo", "press", ()),
    ],
)
def test_the_running_machine_is_damped_as_promised(name, cylinder, payloads, unlocused):
    """From the answer to small pushes of every state, over 5 ms under the compiled controller, the
    other joints free on their oil; the promise holds them. Left out are most of the arm's points
    with 100 lb: slow pairs feel its weight change with the posture (docs/explanation/tuning.md)."""
    rig = shipped(name)
    recipe = damped(cylinder, payloads, 2, (0.3, 0.7))
    tuning = tune_pressure_feedback(prepare_tuning(rig, None, recipe))
    tried = sum(damped_as_promised(rig, tuning, result) for result in tuning.points)
    assert tried >= 0.75 * sum(result.counts for result in tuning.points)
