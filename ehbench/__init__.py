"""ehbench: the workbench for people who run electrohydraulic test rigs.

    import ehbench
    rig = ehbench.load_rig("recipes/rigs/thesis_arm.toml")
    log = ehbench.simulate(rig, {"boom.hepc": 4.0, "boom.rect": 8.0}, duration=2.0)
    maps = ehbench.load_flow_maps("reports/flow_maps_1a2b3c4d")

Everything is SI inside; `ehbench.quantities` names each quantity with its unit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ehbench.logs import read_log as read_log
    from ehbench.physics.flow_map import load_flow_maps as load_flow_maps
    from ehbench.recipe import load_rig as load_rig
    from ehbench.simulate import simulate as simulate

__all__ = ["identify", "load_flow_maps", "load_rig", "read_log", "simulate", "validate"]

_HOME = {
    "load_flow_maps": "ehbench.physics.flow_map",
    "load_rig": "ehbench.recipe",
    "read_log": "ehbench.logs",
    "simulate": "ehbench.simulate",
}
