"""The rig: every number of a machine with unit, source and uncertainty, checked when it enters.

Nothing here knows a particular rig. A rig is a mechanism (a serial chain of revolute joints or a
sliding mass), cylinders, the valves on each cylinder, and the supply. A valve is one command and
its metering edges; an edge joins two of supply, tank, head and rod."""

from ehbench.config.rig.cylinder import Cylinder, Force
from ehbench.config.rig.mechanism import Joint, LinkLoad, Pins, Rack, Slide
from ehbench.config.rig.names import NODES
from ehbench.config.rig.rig import Rig
from ehbench.config.rig.supply import LoadSensing, LowRail
from ehbench.config.rig.valves import Edge, FixedEdge, Valve
