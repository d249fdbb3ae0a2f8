"""Adaptive robust control on the noise-free model, its samples late: what judges its margins."""

import math

import numpy as np
from closed_loop import TICK, Drive, Seen, on_model, trace_of

from ehbench.config.recipe import TuneRecipe
from ehbench.control import arc
from ehbench.control.arc_gains import pack_arc
from ehbench.control.functions import pack_rules
from ehbench.control.law import Controller, late_of
from ehbench.parts.sample import OF, entry, perfect_sample, sample_channels
from ehbench.parts.valve.delay import line_of
from ehbench.plant.design_point import circuit_of, design_point_of
from ehbench.plant.model import Model
from ehbench.tune.arc_loop import SampledPlant, Sensing, steady_memory
from ehbench.tune.operating_point import state_of
from ehbench.tune.study import prepare_tuning

GAINS = {
    "defaults": {},
    "livelier": {"lag_budget": 0.6, "robust_limit": 0.3},
    "slow observer": {"lag_budget": 0.5, "observer_bandwidth": 90.0},
    "fast adaptation": {"adaptation": 3.5},
}


class Bench:
    """A cylinder of a rig, its operating points and the controller designed for it."""

    def __init__(self, rig, cylinder, postures=3, shares=(0.2, 0.5), payloads=()):
        given = {"postures": postures, "speed_shares": shares, "payloads": payloads, "draws": 0}
        recipe = TuneRecipe(stage="tune", rig="x", cylinder=cylinder, **given)
        study = prepare_tuning(rig, None, recipe)
        counted = [site for site in study.motions if site.counts]
        self.design = Model.of(rig)
        index = self.design.layout.cylinders.index(cylinder)
        circuit = circuit_of(self.design, index)
        self.site = design_point_of(self.design, circuit, self.design.posture({}), TICK)
        self.rules = pack_rules(circuit.area_rod, self.site.supply_pressure)
        usual = self.gains()
        self.points = [
            one
            for one in counted
            if SampledPlant.of(one.model, one.point, TICK).stays(self.site, usual)
        ]

    def gains(self, **given):
        """The controller's gains: the defaults but for what is given."""
        return pack_arc(self.site, self.rules, given)[0]

    def loop(self, at, gains):
        """The linearised loop at an operating point."""
        return SampledPlant.of(at.model, at.point, TICK).loop(self.site, gains)

    def worst(self, gains, margin="delay", *sensing):
        """(margins, operating point) where one margin is least, with a `Sensing`."""
        told = [(self.loop(at, gains).margins(Sensing(*sensing)), at) for at in self.points]
        return min(told, key=lambda one: getattr(one[0], margin))

    def stroke(self, at, gains, delay, push, span=1.6, louder=1.0):
        """Strokes [m] after a push of the speed [m/s], ``delay`` [s] late, ``louder`` commands."""
        model, point, site = at.model, at.point, self.site
        plant, layout = model.plant, model.layout
        y, command = state_of(model, point)
        valves = np.array(sorted({path.valve for path in point.paths}))
        own = site.axis.circuit.cylinder
        row = plant.cylinders[own]
        y[plant.at.rates + row.joint] += push / point.lever
        memory = arc.memory_of(site.axis)
        start = steady_memory(model, point, site, gains)
        for name in arc.STATE.names:
            memory.state[name] = start[name]
        memory.state.x -= delay * point.v
        sample = np.empty(len(sample_channels(layout.cylinders)))
        perfect_sample(y, plant, sample)
        observed = arc.observed(site.axis, sample.size)
        law = Controller(site.axis, gains, memory, observed, np.zeros(sample.size), late_of())
        whole = int(delay / TICK)
        # before the start it moved steadily as well
        past = np.tile(sample, (whole + 2, 1))
        before = np.arange(whole + 2) * TICK * point.v
        past[:, entry(own, OF.x)] -= before
        past[:, entry(own, OF.q)] -= before / point.lever
        reference = np.zeros((round(span / TICK), 4))
        reference[:, 0] = point.x + (np.arange(len(reference)) * TICK) * point.v
        reference[:, 1] = point.v
        drive = Drive(command, command.copy(), valves, float(louder), 2)
        names = arc.LAW.channels("c", ("",) * site.axis.circuit.count)
        trace = trace_of(model, names, len(reference))
        seen, line = Seen(past, delay / TICK - whole), line_of(plant, TICK)
        on_model(y, reference, law, seen, drive, plant, line, trace)
        assert math.isfinite(y[row.joint])
        return trace.log[:, entry(own, OF.x)]

    def grows(self, at, gains, delay, push=2.0e-4, louder=1.0, span=1.6):
        """Whether a push swings more and more: the last third of the time against that before."""
        ends = (self.stroke(at, gains, delay, one, span, louder) for one in (push, -push))
        apart = next(ends) - next(ends)
        swing = np.diff(apart, 2)
        third = swing.size // 3
        early, late = swing[third : 2 * third], swing[2 * third :]
        return bool(np.linalg.norm(late) > np.linalg.norm(early))

    def onset(self, at, gains, first=2.0e-4, most=0.03):
        """Delay [s] at which a swing begins to grow, to 3 %, by bisection; inf beyond ``most``."""
        delay, before = first, 0.0
        while not self.grows(at, gains, delay):
            delay, before = 1.2 * delay, delay
            if delay > most:
                return math.inf
        for _ in range(3):
            middle = 0.5 * (before + delay)
            before, delay = (before, middle) if self.grows(at, gains, middle) else (middle, delay)
        return 0.5 * (before + delay)
