"""Results of a validation: the verdict on a rig, log by log, as in ``validation.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np

from ehbench.diagnosis import DOMINANT, Structure
from ehbench.frequency_response.response import Curve
from ehbench.preprocessing.observations import rings_clearly
from ehbench.signals.series import Ringing
from ehbench.vocabulary import message
from ehbench.vocabulary.terms import BEYOND


@dataclass(frozen=True)
class Correlation:
    """A correlation over lags [s], the half-width of its 95 % band at each lag, and the share [%]
    of lags outside.

    ``of`` names what the residual is correlated with: itself (lag 0 left out), or a command ``lag``
    seconds earlier."""

    of: str
    lag: tuple[float, ...]
    value: tuple[float, ...]
    band: tuple[float, ...]
    outside_percent: float


@dataclass(frozen=True)
class ChannelResult:
    """One channel of one log, in the SI ``unit``. Errors are simulated minus recorded.

    ``fit_percent`` is the NRMSE fit, None where the recording shows no motion; ``max_error`` the
    error largest in size, with its sign; ``derived`` says that the log has no such channel and both
    sides were taken from the position's rate. ``noise_share`` is the recording's white noise over
    its standard deviation: no model's fit is better than 100 (1 − it). ``note`` says in words why
    something is missing."""

    channel: str
    unit: str
    fit_percent: float | None
    max_error: float
    bias: float
    rms_error: float
    derived: bool = False
    noise_share: float = 0.0
    baseline_percent: float | None = None
    autocorrelation: Correlation | None = None
    cross_correlation: tuple[Correlation, ...] = ()
    note: str = ""


@dataclass(frozen=True)
class Ring:
    """Natural frequency [rad/s] and damping ratio of one side of a transient with their standard
    errors; None: no ringing.

    ``cycles`` pass before it has decayed or the window ends; ``reason`` says why there is none.
    """

    natural_frequency: float | None = None
    natural_frequency_std: float | None = None
    damping_ratio: float | None = None
    damping_ratio_std: float | None = None
    cycles: float = 0.0
    reason: str = ""

    @property
    def clear(self) -> bool:
        """Whether it rings long enough for its frequency to be told from drift, so that a model can
        be judged by it.
        """
        return self.damping_ratio is not None and rings_clearly(self.cycles, self.damping_ratio)

    @classmethod
    def of(cls, result: Ringing) -> Ring:
        """The part of a ringing that is saved."""
        if not result.ok:
            return cls(cycles=result.cycles, reason=result.reason)
        return cls(*(getattr(result, item.name) for item in fields(cls)))


@dataclass(frozen=True)
class Transient:
    """The ringing of a cylinder after a command change, recorded and simulated over the same window
    [s]; ``note`` says why an oscillation that was found is not judged.
    """

    cylinder: str
    start: float
    stop: float
    recorded: Ring
    simulated: Ring
    note: str = ""

    @property
    def judged(self) -> bool:
        """Whether the model is judged by this window."""
        return self.recorded.clear and not self.note


@dataclass(frozen=True)
class Sweep:
    """The frequency response of a channel to a command that sweeps, recorded and simulated.

    ``band`` [Hz] holds the ``frequencies`` that count; ``averages`` is how many independent
    segments there are. Pairs are (recorded, simulated): mean ``coherence`` in the band, and
    ``delay`` [s], the mean slope of the phase there. ``gain_ratio`` is the median of simulated over
    recorded gain; ``gain_error`` (a share) and ``phase_error`` [rad] are root mean squares over the
    band, ``delay_error`` [s] the difference, all beyond what the errors of the recording's response
    make. None: the model does not answer."""

    input: str
    channel: str
    band: tuple[float, float]
    frequencies: int
    averages: float
    coherence: tuple[float, float | None]
    delay: tuple[float, float | None]
    recorded: Curve
    simulated: Curve | None = None
    gain_ratio: float | None = None
    gain_error: float | None = None
    phase_error: float | None = None
    delay_error: float | None = None


@dataclass(frozen=True)
class Check:
    """One requirement on the model on one log: what was reached (None: nothing to compare) and what
    was ``asked``.
    """

    what: str
    reached: float | None
    asked: float
    unit: str
    passed: bool
    sentence: str


@dataclass(frozen=True)
class Overlap:
    """Samples of a log, from ``start`` to ``stop`` [s], that are those of ``log``, which the model
    was fitted to.
    """

    log: str
    start: float
    stop: float
    samples: int


@dataclass(frozen=True)
class LogResult:
    """The result of one log. ``status``: ``held_out`` (it counts), ``fitted`` (the model was fitted
    to it), ``still``, or ``failed``.

    ``scored`` is the part [s] that is judged, None for all of it; ``overlap`` where the model was
    fitted to its very samples. ``moved`` cylinders had a valve commanded and are judged, ``held``
    ones are not. ``failure`` says why a log could not be simulated. ``sensors`` are the numbers of
    its sensors that were estimated [SI], such as ``boom.p_head.offset``. ``series`` are the
    recorded and, as ``simulated.<channel>``, the simulated channels; it is not in the JSON."""

    name: str
    payload: str
    status: str
    duration: float
    sample_time: float
    scored: tuple[float, float] | None = None
    overlap: tuple[Overlap, ...] = ()
    moved: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    channels: tuple[ChannelResult, ...] = ()
    transients: tuple[Transient, ...] = ()
    sweeps: tuple[Sweep, ...] = ()
    checks: tuple[Check, ...] = ()
    failure: str = ""
    warnings: tuple[str, ...] = ()
    sensors: dict[str, float] = field(default_factory=dict)
    series: dict[str, np.ndarray] = field(default_factory=dict, repr=False, compare=False)

    @property
    def passed(self) -> bool:
        """Whether everything asked on this log was reached, and something was asked."""
        return not self.failure and bool(self.checks) and all(check.passed for check in self.checks)


@dataclass(frozen=True)
class BlackBox:
    """The black boxes beside a model: the logs that they were ``fitted`` to, whether the verdict
    ``counts`` them, and by channel their order and sample time [s].
    """

    fitted: tuple[str, ...] = ()
    counts: bool = False
    orders: dict[str, tuple[int, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Validation:
    """The verdict on a rig: ``accepted`` if some held-out log was judged and all of them passed;
    else ``reasons`` say why not. ``structure`` is what the residuals say of the model,
    ``reservations`` are messages on what speaks against its numbers though it follows the logs.
    """

    rig: str
    accepted: bool
    reasons: tuple[str, ...]
    warnings: tuple[str, ...]
    thresholds: dict[str, Any]
    logs: tuple[LogResult, ...]
    structure: Structure = Structure()
    reservations: tuple[str, ...] = ()
    black_box: BlackBox = BlackBox()

    @property
    def verdict(self) -> str:
        """``accepted``, ``accepted with reservation`` or ``rejected``."""
        if not self.accepted:
            return "rejected"
        return "accepted with reservation" if self.reservations else "accepted"

    def with_structure(self, structure: Structure) -> Validation:
        """With what the residuals say: a cause of most of a residual above the noise, or two that
        are so together, is a reservation, and a reason to reject the model where an identified
        number would leave its interval. It is neither where that interval explains everything.
        """
        causes = [cause for cause in structure.causes if not cause.within]
        texts = [
            message("validation.cause", share=c.explains, cause=c.cause, remedy=c.remedy)
            for c in causes
        ]
        reject = [cause.beyond > BEYOND for cause in causes]
        return replace(self, structure=structure).weighed(texts, reject)

    def with_fit(self, leans: Sequence[Mapping[str, Any]]) -> Validation:
        """With what the fit of the rig found: fixed numbers to which it is sensitive, and logs that
        were not recorded as they are said to be. Each is a reservation, and a reason to reject the
        model where it makes most of what the fit leaves, as an estimate then leaves its interval.
        """
        reject = [item["explains"] > DOMINANT for item in leans]
        return self.weighed([item["sentence"] for item in leans], reject)

    def weighed(self, texts: Sequence[str], reject: Sequence[bool]) -> Validation:
        """With texts that speak against the model; some of them reject it."""
        pairs = list(zip(texts, reject, strict=True))
        reasons = (*self.reasons, *(text for text, fatal in pairs if fatal))
        reservations = (*self.reservations, *(text for text, fatal in pairs if not fatal))
        accepted = self.accepted and not any(reject)
        return replace(self, accepted=accepted, reasons=reasons, reservations=reservations)

    def as_json(self) -> dict[str, Any]:
        """Plain values for ``validation.json``."""
        table: dict[str, Any] = asdict(self) | {"verdict": self.verdict}
        for log, result in zip(table["logs"], self.logs, strict=True):
            del log["series"]
            log["passed"] = result.passed
        return table


def speaking_against(fit: Mapping[str, Any]) -> tuple[Mapping[str, Any], ...]:
    """What an identification found that speaks against its numbers, as `Validation.with_fit` takes
    it.

    Args:
        fit: ``fit.as_json()``, or its ``parameters.json``.
    """
    notes = [note for note in fit.get("warnings", ()) if "cause" in getattr(note, "fields", {})]
    of_logs = ({"sentence": note, "explains": note.fields.get("share", 0.0)} for note in notes)
    return (*of_logs, *fit.get("leans", ()))
