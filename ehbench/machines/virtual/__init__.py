"""The virtual bench: a separate, richer plant that plays the machine; only trials and datasets may
import it.

It shares the mechanism, the cylinder's geometry, the valves' dynamics and the integrator with the
model, and has its own laws for all that a model leaves out: air in the oil, leakage, Stribeck
friction, valves that are no two alike, hysteresis, a pump that droops, and sensors that are late,
noisy and coarse. Its parameters are read by nothing but itself.

`plant` says what it is made of, `laws` how it moves, `drawing` what numbers it has, `machine` is
what a trial drives."""

from ehbench.machines.virtual.machine import NAME, VirtualMachine, bench_of
