"""Machines that a trial can run on, behind one protocol (`ehbench.machines.protocol`)."""
