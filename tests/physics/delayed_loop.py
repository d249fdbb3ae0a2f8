"""The adaptive robust controller on the noise-free model, tick by tick, its samples late and those
of pressure lagging: what its margins are judged by.
"""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np

from ehbench.compiled import bound
from ehbench.control import arc
from ehbench.control.arc_gains import Adaptation, pack_arc
from ehbench.control.functions import pack_rules
from ehbench.control.law import Controller
from ehbench.control.registry import tick as law_tick
from ehbench.machines.simulated import model_sample, model_tick
from ehbench.parts.sample import OF, entry, sample_channels
from ehbench.parts.valve.delay import line_of
from ehbench.plant.model import Model
from ehbench.plant.site import site_of
from ehbench.recipe import TuneRecipe
from ehbench.tune.arc_loop import SampledPlant, steady_memory
from ehbench.tune.linear import circuit_of, state_of
from ehbench.tune.study import prepare_tuning

TICK = 1.0e-3


class Bench:
    """A cylinder of a rig, its operating points and the controller designed for it."""

    def __init__(self, rig, cylinder, postures=3, shares=(0.2, 0.5), payloads=()):
        recipe = TuneRecipe(
            stage="tune",
            rig="x",
            cylinder=cylinder,
            postures=postures,
            speed_shares=shares,
            payloads=payloads,
            draws=0,
        )
        study = prepare_tuning(SimpleNamespace(rig=rig, flow_maps=None), recipe)
        counted = [site for site in study.sites if site.counts]
        self.design = Model.of(rig)
        index = self.design.layout.cylinders.index(cylinder)
        circuit = circuit_of(self.design, index)
        self.site = site_of(self.design, circuit, self.design.posture({}), TICK)
        self.rules = pack_rules(circuit.area_rod, self.site.supply_pressure)
        usual = self.gains()
        self.points = [
            one
            for one in counted
            if SampledPlant.of(one.model, one.point, TICK).stays(self.site, usual)
        ]

    def gains(self, unsure=None, **given):
        """The controller's gains: the defaults but for what is given."""
        return pack_arc(self.site, self.rules, Adaptation(**(unsure or {})), given)

    def loop(self, at, gains):
        """The linearised loop at an operating point."""
        return SampledPlant.of(at.model, at.point, TICK).loop(self.site, gains)

    def stroke(self, at, gains, delay, push, span=1.6, louder=1.0):
        """Strokes [m] of a steady motion that begins with a push of the speed [m/s], its samples
        ``delay`` [s] late, what it commands ``louder`` [1] than it is.
        """
        model, point, site = at.model, at.point, self.site
        plant, layout = model.plant, model.layout
        y, command = state_of(model, point)
        given, steady = command.copy(), command.copy()
        valves = sorted({path.valve for path in point.paths})
        row = plant.cylinders[site.axis.circuit.cylinder]
        y[plant.at.rates + row.joint] += push / point.lever
        memory = arc.memory_of(site.axis)
        start = steady_memory(model, point, site, gains)
        for name in arc.STATE.names:
            memory.state[name] = start[name]
        sample = np.empty(len(sample_channels(layout.cylinders)))
        model_sample(y, plant, sample)
        observed = arc.observed(site.axis, sample.size)
        law = Controller(site.axis, gains, memory, observed, np.zeros(sample.size))
        telemetry = np.zeros(arc.COLUMNS + 4 * site.axis.circuit.count)
        line = line_of(plant, TICK)
        k, work = np.empty((5, y.size)), np.empty(plant.at.work)
        reference = np.array([point.x, point.v, 0.0, 0.0])
        control = bound(law_tick, 0.0, sample, reference, law, command, telemetry)
        tick = bound(model_tick, y, given, plant, line, 2, k, work, sample)
        whole = int(delay / TICK)
        share, joint = delay / TICK - whole, row.joint
        # before the start it moved steadily as well
        past = []
        for i in range(whole + 2):
            before = sample.copy()
            own = site.axis.circuit.cylinder
            before[entry(own, OF.x)] -= i * TICK * point.v
            before[entry(own, OF.q)] -= i * TICK * point.v / point.lever
            past.append(before)
        memory.state.x -= delay * point.v
        strokes = np.empty(round(span / TICK))
        for i in range(strokes.size):
            seen = (1.0 - share) * past[whole] + share * past[whole + 1]
            reference[0] = point.x + (i * TICK) * point.v
            control(i * TICK, seen, reference, law, command, telemetry)
            strokes[i] = sample[entry(site.axis.circuit.cylinder, OF.x)]
            given[:] = command
            given[valves] += (louder - 1.0) * (command - steady)[valves]
            tick(y, given, plant, line, 2, k, work, sample)
            past = [sample.copy(), *past[:-1]]
        assert math.isfinite(y[joint])
        return strokes

    def grows(self, at, gains, delay, push=2.0e-4, louder=1.0):
        """Whether what a push leaves swings more and more: the second differences of stroke over
        the last third of the time against those of the third before.
        """
        ends = (self.stroke(at, gains, delay, one, louder=louder) for one in (push, -push))
        apart = next(ends) - next(ends)
        swing = np.diff(apart, 2)
        third = swing.size // 3
        early, late = swing[third : 2 * third], swing[2 * third :]
        return bool(np.linalg.norm(late) > np.linalg.norm(early))

    def onset(self, at, gains, first=2.0e-4, most=0.03):
        """The delay [s] at which a swing begins to grow, to 3 %: the first of a rising row, then
        bisection; inf beyond ``most``.
        """
        delay, before = first, 0.0
        while not self.grows(at, gains, delay):
            delay, before = 1.2 * delay, delay
            if delay > most:
                return math.inf
        for _ in range(3):
            middle = 0.5 * (before + delay)
            before, delay = (before, middle) if self.grows(at, gains, middle) else (middle, delay)
        return 0.5 * (before + delay)
