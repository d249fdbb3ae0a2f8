"""Machines out of this process, behind the protocol of `ehbench.machines.protocol`: a rig's target
over UDP, Modbus, CAN or a card, and the virtual bench served as such a target."""
