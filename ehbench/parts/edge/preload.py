"""A counterbalance, overcentre or preload valve in series with a metering edge."""

from ehbench.parts.fault import Amount, Fault
from ehbench.runtime.compiled import part_kernel


@part_kernel
def preload(edge):
    """Pressure [Pa] that the spring takes of a drop; none of oil that goes back."""
    return 0.0 if edge.unmetered == 1 else edge.cracking_pressure


@part_kernel
def metered(drop, edge):
    """A drop [Pa] less the preload: ``Δp − cracking_pressure``, 0 up to there."""
    return drop - min(max(drop, 0.0), preload(edge))


# of a metering edge that leads to the tank
FAULTS = (
    Fault(
        "preload",
        ("cracking_pressure",),
        unit="pressure",
        step=0.01,
        high=0.8,
        start=Amount((0.05,), "pressure"),
        upper=Amount((0.5,), "pressure"),
        joined=True,
    ),
)
