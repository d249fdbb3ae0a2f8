"""Machines that a trial can run on, all behind one protocol (`ehbench.machines.protocol`): the
model, and the virtual bench."""
