"""A controller of the user's own: proportional position feedback with the speed fed forward. The
protocol is in docs/howto/run_trials.md.
"""

from __future__ import annotations


class PositionFeedback:
    """Commands ``u = k_v (v_d + loop_gain·(x_d − x))`` to the one valve of a cylinder, k_v from the
    valve's full flow.
    """

    channels = ["*.x"]  # the only ones it is given; all others are nan

    def __init__(self, loop_gain: float = 10.0) -> None:
        self.loop_gain = loop_gain  # [1/s]

    def start(self, rig, tick, sample) -> None:
        """``rig`` is the design model: its Rig, its simulation model, the cylinder that is
        controlled.
        """
        (self.valve,) = (name for name in rig.valves if name.startswith(rig.cylinder + "."))
        edge = next(e for c, v, e in rig.rig.edges() if c.name == rig.cylinder and (e.from_, e.to) == ("supply", "head"))
        drop = 0.5 * float(rig.rig.supply.pressure)
        self.volts = rig.circuit.area_head / (float(edge.flow_gain) * drop**0.5)  # [V per m/s] at half the supply pressure
        self.position = rig.cylinder + ".x"

    def step(self, t, sample, desired) -> dict[str, float]:
        """Volts by valve; a valve that is not named keeps its rest or its open-loop command."""
        speed = desired.v + self.loop_gain * (desired.x - sample[self.position])
        return {self.valve: self.volts * speed}
