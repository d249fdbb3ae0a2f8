"""Rigs that a trial can run on. Every rig speaks one protocol: only what a real machine could
measure.

Once a tick a rig takes a command for each valve and gives a sample: ``[q, qd, x, v, p_head,
p_rod]`` of each cylinder in the rig file's order, then ``p_supply, p_tank``, all SI. Controllers
see nothing else."""
