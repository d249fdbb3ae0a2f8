"""What a fit of a flow map leaves: the map with its intervals, outliers and calibration, and the
sentences people read."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

import numpy as np

from ehbench.physics.flow_map import FlowMap
from ehbench.vocabulary.quantities import VOCABULARY
from ehbench.vocabulary.terms import Z95
from ehbench.vocabulary.units import from_si


@dataclass(frozen=True)
class Units:
    """How sentences show flows, drops and openings; ``sign``: of the commands that open the edge,
    as the driver gets them.
    """

    flow_unit: str = VOCABULARY["flow"].display
    pressure_unit: str = VOCABULARY["pressure_drop"].display
    sign: int = 1

    def volts(self, opening: float) -> str:
        return f"{self.sign * opening + 0.0:g} V"

    def flow(self, value: float, digits: int = 4) -> str:
        value = value if abs(value) > 1e-12 else 0.0  # m³/s, a nanolitre a second: below any meter
        return f"{from_si(value, self.flow_unit, VOCABULARY['flow']):.{digits}g} {self.flow_unit}"

    def drop(self, value: float) -> str:
        shown = from_si(value, self.pressure_unit, VOCABULARY["pressure_drop"])
        return f"{shown:.4g} {self.pressure_unit}"


@dataclass(frozen=True)
class Outlier:
    """A reading left out of the fit: file and line, command [V], drop [Pa], flow [m³/s], distance
    from the map in sigmas.
    """

    file: str
    line: int
    command: float
    pressure_drop: float
    flow: float
    sigmas: float

    def sentence(self, show: Units) -> str:
        where = f"{self.file}:{self.line}" if self.file else f"line {self.line}"
        place = f"{show.volts(self.command)} and {show.drop(self.pressure_drop)}"
        point = f"{show.flow(self.flow)} at {place}"
        return f"{where}: {point} lies {self.sigmas:+.1f} sigma from the map"


@dataclass(frozen=True)
class Calibration:
    """A flow [m³/s] that a command [V] should give, and what the map gives there.

    ``flow`` is the mean over the drops from ``drop_low`` to ``drop_high`` [Pa], ``low`` and
    ``high`` its 95 % interval, ``least`` and ``most`` the range of the map over those drops.
    ``verdict``: ``met`` or ``missed`` where the whole interval lies inside or outside of target·(1
    ± tolerance), else ``undecided``; ``not_measured`` outside the commands."""

    command: float
    target: float
    tolerance: float
    flow: float
    low: float
    high: float
    least: float
    most: float
    drop_low: float
    drop_high: float
    verdict: str

    def sentence(self, show: Units) -> str:
        volts, target = show.volts(self.command), show.flow(self.target)
        if self.verdict == "not_measured":
            return f"{volts} lies outside the measured commands: {target} there cannot be checked"
        ends = f"{show.flow(self.low)} to {show.flow(self.high)}"
        gives = f"{volts} gives {show.flow(self.flow)} ({ends})"
        drops = show.drop(self.drop_low)
        drops = (
            f"at {drops}"
            if self.drop_low == self.drop_high
            else f"from {drops} to {show.drop(self.drop_high)}"
        )
        requested = f"asked {target} ± {100 * self.tolerance:.3g} %"
        return f"{gives} {drops}, {requested}: {self.verdict}"


@dataclass(frozen=True)
class FlowMapFit:
    """A map and how it was found. SI.

    ``deadband`` [V] with ``deadband_std``, if the flow starts with a kink there; its 95 % interval
    also holds where a flow would start that grows softly, no softer than a parabola. ``bracket``
    [V, V]: the highest command at which no flow is seen (under 0.1 % of the rated one, or within
    the noise) and the lowest with some, whatever the shape. ``status`` of the
    deadband: ``estimated``, ``at_bound`` (0 V) or ``not_excited`` (flow at the lowest command
    measured). ``noise``: per method (floor [m³/s], share of the flow), the standard deviation of
    one reading being √(floor² + (share·flow)²). ``replicates``: degrees of freedom behind the
    noise; 0 means that it was taken from the residuals. ``lack_of_fit``: variance of cell means
    about the map over what the noise explains, at least 1; every interval is widened by its root,
    and further near the cells missed. ``smoothing``: penalty along opening and root of drop;
    ``parameters``: effective number of them. ``rms`` [m³/s]: of the residuals of the readings used.
    ``leakage`` [m³/s]: mean flow at commands below the deadband, with its interval. Where it ends
    with the opening the map takes the valve as shut there; where it goes on, the map has it.
    ``hysteresis`` [V]: what the commands of rising readings lie above those of falling ones at the
    same flow, with its interval; the map is the middle of both. None where the readings go one way
    only. ``kinks`` [V]: openings where the slope jumps, each with its interval. ``falls``: what the
    flow falls by from its largest to the largest command [1]; 0 where it does not.
    ``trial_scatter``: standard error [1] of the mean of the trials' common factors beyond the
    noise. ``residuals`` [m³/s] and ``sigmas`` [1]: one a reading in the order given, NaN at drops
    of zero or less. ``warnings``: plain sentences."""

    map: FlowMap
    deadband: float
    deadband_interval: tuple[float, float]
    deadband_std: float
    bracket: tuple[float, float]
    status: str
    noise: dict[str, tuple[float, float]]
    replicates: int
    lack_of_fit: float
    smoothing: tuple[float, float]
    parameters: float
    readings: int
    cells: int
    outliers: tuple[Outlier, ...]
    rms: float
    leakage: float
    leakage_interval: tuple[float, float]
    hysteresis: float | None
    hysteresis_interval: tuple[float, float]
    kinks: tuple[tuple[float, float, float], ...]
    falls: float
    trial_scatter: float
    calibration: tuple[Calibration, ...]
    residuals: np.ndarray = field(repr=False)
    sigmas: np.ndarray = field(repr=False)
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict:
        """The summary without map and residuals, for a JSON file."""
        skip = ("map", "residuals", "sigmas")
        plain = {
            name: getattr(self, name) for name in self.__dataclass_fields__ if name not in skip
        }
        plain["outliers"] = [asdict(outlier) for outlier in self.outliers]
        plain["calibration"] = [asdict(item) for item in self.calibration]
        return {
            "valve": self.map.valve,
            "direction": self.map.direction,
            "rated_flow": self.map.rated_flow,
            **plain,
        }


def check_calibration(
    result: FlowMap,
    command: float,
    target: float,
    tolerance: float,
    reference: float | tuple[float, float] | None,
) -> Calibration:
    """A calibration point against the map, over the reference drops."""
    low, high = (
        float(np.interp(command, result.hull_command, side))
        for side in (result.hull_low, result.hull_high)
    )
    if reference is None:
        low = 0.5 * (low + high)
    else:
        low, high = reference if isinstance(reference, tuple) else (reference, reference)
    drops = np.linspace(low, high, 21)
    flows = result.flow(drops, command)
    flow, std = float(np.mean(flows)), float(np.mean(result.flow_std(drops, command)))
    bounds = flow - Z95 * std, flow + Z95 * std
    band = target * (1 - tolerance), target * (1 + tolerance)
    if not result.hull_command[0] <= command <= result.hull_command[-1]:
        verdict = "not_measured"
    elif band[0] <= bounds[0] and bounds[1] <= band[1]:
        verdict = "met"
    else:
        verdict = "missed" if bounds[1] < band[0] or bounds[0] > band[1] else "undecided"
    return Calibration(
        command,
        target,
        tolerance,
        flow,
        *bounds,
        float(np.min(flows)),
        float(np.max(flows)),
        low,
        high,
        verdict,
    )
