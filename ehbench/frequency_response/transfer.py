"""Plain transfer functions fitted to an input and an output in time: which form follows best, and
with which numbers.

The output is ``gain · form(input) + offset``, offset and start each log's own. Forms have unit gain
at rest, their input is held from sample to sample, as commands are, or goes straight."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ehbench.signals.series import correlation_time, fit_percent
from ehbench.vocabulary import Z95, Message, message, setting

# by form: the real poles that it has, whether it has a pair of natural frequency and damping ratio,
# whether it has a delay
FORMS = {
    "first order": (1, False, False),
    "first order and delay": (1, False, True),
    "two poles": (2, False, False),
    "two poles and delay": (2, False, True),
    "second order": (0, True, False),
    "second order and delay": (0, True, True),
    "second order, a pole and delay": (1, True, True),
}


@dataclass(frozen=True)
class TransferSettings:
    """Numbers of fitted transfer functions."""

    close: float = setting(1.0, "%", "better fit of a form with more numbers", "plain to see")
    spread: float = setting(4.0, "", "factor between two poles where a search begins", "apart")
    damping: tuple = setting((1e-3, 1.0), "", "damping ratios of a pair", "beyond: two poles")
    damped: tuple = setting((0.1, 0.5), "", "damping ratios where a search begins", "chosen")
    edge: float = setting(0.01, "", "distance to a bound, of a pole, or in samples", "on it")


SETTINGS = TransferSettings()


@dataclass(frozen=True)
class Transfer:
    """One form fitted to all logs: real ``poles`` [rad/s], lowest first, ``natural_frequency``
    [rad/s] and ``damping_ratio`` of a pair, ``delay`` [s], below 0 where the output is ahead, and
    ``gain`` [output/input], each with its standard error; the NRMSE fit of each log [%], and
    whether the form is the one ``preferred``."""

    form: str
    gain: float
    poles: tuple[float, ...]
    pole_stds: tuple[float, ...]
    natural_frequency: float | None
    natural_frequency_std: float | None
    damping_ratio: float | None
    damping_ratio_std: float | None
    delay: float | None
    delay_std: float | None
    fit_percent: tuple[float, ...]
    preferred: bool = False

    @property
    def numbers(self) -> int:
        """How many numbers it has in addition to the gain."""
        poles, pair, late = FORMS[self.form]
        return poles + 2 * pair + late

    def is_within(self, other: "Transfer") -> bool:
        """Whether another form has every number of this one, and more."""
        ours, theirs = FORMS[self.form], FORMS[other.form]
        return ours != theirs and all(a <= b for a, b in zip(ours, theirs, strict=True))

    def widened(self, richer: "Transfer") -> "Transfer":
        """With standard errors that also hold by how much a richer form has its numbers otherwise,
        the lack of fit of this one. Where this one is true, they are the richer one's on average:
        its numbers scatter about those here by what they are less certain (Hausman 1978)."""
        stds: dict[str, Any] = {
            f"{name}_std": math.hypot(std, getattr(self, name) - getattr(richer, name))
            for name in ("natural_frequency", "damping_ratio", "delay")
            if (std := getattr(self, f"{name}_std")) is not None
        }
        both = zip(self.pole_stds, self.poles, richer.poles, strict=False)
        poles = tuple(math.hypot(std, pole - other) for std, pole, other in both)
        return replace(self, pole_stds=poles, **stds)


Pairs = Sequence[tuple[np.ndarray, np.ndarray]]


def transfers(pairs: Pairs, rate: float, held: bool = False) -> tuple[Transfer, ...]:
    """Every form fitted to logs, the preferred first: the best of those with the fewest numbers
    that come within a percent of fit of the best of all, its standard errors widened by what the
    best of those with more numbers has otherwise. A form with a pole or a delay at a bound, or with
    a pole that the logs do not show, is left out.

    Args:
        pairs: input and output of each log.
        rate: samples per second.
        held: whether the input is held from sample to sample; else it goes straight."""
    results = [item for form in FORMS if (item := _fit_form(form, pairs, rate, held)) is not None]
    if not results:
        return ()
    level = {item.form: float(np.mean(item.fit_percent)) for item in results}
    close = [item for item in results if level[item.form] >= max(level.values()) - SETTINGS.close]
    fewest = min(item.numbers for item in close)
    ranked = sorted(results, key=lambda item: -level[item.form])
    best = next(item for item in ranked if item in close and item.numbers == fewest)
    others = [item for item in ranked if item is not best]
    richer = next((item for item in others if best.is_within(item)), best)
    return (replace(best.widened(richer), preferred=True), *others)


def notes_of(forms: Sequence[Transfer]) -> tuple[Message, ...]:
    """What a reader of fitted forms must know of the first: that there is none, or that the output
    is surely ahead."""
    first = next(iter(forms), None)
    if first is None:
        return (message("frequency_response.no_form"),)
    if first.delay is None or first.delay_std is None:
        return ()
    sure = first.delay + Z95 * first.delay_std < 0.0
    fields = {"early": -1e3 * first.delay, "error": 1e3 * Z95 * first.delay_std}
    return (message("frequency_response.early_form", **fields),) if sure else ()


def _fit_form(form: str, pairs: Pairs, rate: float, held: bool) -> Transfer | None:
    """A form's best fit; None where a number lies on its bound or the logs do not show a pole."""
    from scipy.optimize import least_squares

    poles, pair, late = FORMS[form]
    count = poles + 2 * pair
    low, high = 2.0 * math.pi / max(y.size for _, y in pairs) * rate, 2.0 * math.pi * rate
    size = math.sqrt(float(np.mean([np.var(y) for _, y in pairs])))

    def residuals(theta: np.ndarray) -> np.ndarray:
        outputs = _outputs(theta, form, pairs, rate, held)[1]
        return np.concatenate([y - s for s, (_, y) in zip(outputs, pairs, strict=True)]) / size

    starts = np.geomspace(4.0 * low, 0.1 * high, 6)
    begins = [
        [w, ratio][: 2 * pair] + [w * SETTINGS.spread ** (k + pair) for k in range(poles)]
        for w in starts
        for ratio in SETTINGS.damped[: None if pair else 1]
    ]
    begins = [np.append(np.log(begin), [1.0] * late) for begin in begins]  # delay [samples]
    begin = min(begins, key=lambda item: float(np.sum(residuals(item) ** 2)))
    ends = np.array([(low, high), SETTINGS.damping] * pair + [(low, high)] * poles)
    bounds = np.array([*np.log(ends), *[(-0.5 * rate, 0.5 * rate)] * late]).T
    best = least_squares(
        residuals, np.clip(begin, *bounds), bounds=bounds, x_scale="jac", diff_step=1e-5
    )
    gain, seen = _outputs(best.x, form, pairs, rate, held)
    tau = float(np.median([correlation_time(y - s) for s, (_, y) in zip(seen, pairs, strict=True)]))
    inverse = np.linalg.pinv(best.jac.T @ best.jac)
    std = np.sqrt(np.maximum(np.diag(inverse), 0.0) * float(np.mean(best.fun**2)) * tau)
    values = [(float(v), float(v * e)) for v, e in zip(np.exp(best.x[:count]), std, strict=False)]
    if np.abs(best.x - bounds).min() < SETTINGS.edge or any(error > v for v, error in values):
        return None
    real = tuple(sorted(values[2 * pair :]))
    (omega, omega_std), (zeta, zeta_std) = values[:2] if pair else [(None, None)] * 2
    return Transfer(
        form,
        gain,
        tuple(value for value, _ in real),
        tuple(error for _, error in real),
        omega,
        omega_std,
        zeta,
        zeta_std,
        float(best.x[-1]) / rate if late else None,
        float(std[-1]) / rate if late else None,
        tuple(fit_percent(y, s) for s, (_, y) in zip(seen, pairs, strict=True)),
    )


def _outputs(
    theta: np.ndarray, form: str, pairs: Pairs, rate: float, held: bool
) -> tuple[float, list[np.ndarray]]:
    """(gain, outputs) of a form: logarithms of natural frequency and damping ratio, of its poles
    [rad/s], then its delay [samples]."""
    from scipy.signal import cont2discrete, lfilter, lfilter_zi, ss2tf, tf2ss

    poles, pair, late = FORMS[form]
    roots = -np.exp(theta[2 * pair : 2 * pair + poles]).astype(complex)
    if pair:
        omega, zeta = np.exp(theta[:2])
        root = omega * (-zeta + 1j * math.sqrt(max(1.0 - zeta**2, 0.0)))
        roots = np.append(roots, [root, root.conjugate()])
    whole, delay = np.real(np.poly(roots)), float(theta[-1]) if late else 0.0
    parts: list[tuple[np.ndarray, float]]  # of the answer: numerator, delay of its input [samples]
    if held:  # exact: within a sample the last input but one acts first, for a part of it
        a, b, c, _ = tf2ss([whole[-1]], whole)
        share = delay - math.floor(delay)
        steps: Any = [
            cont2discrete((a, b, c, 0.0), part / rate, "zoh") for part in (share, 1.0 - share)
        ]
        (first, before, *_), (last, now, *_) = steps
        inputs = np.hstack([now, last @ before])
        tops = [ss2tf(last @ first, inputs, c, np.zeros((1, 2)), input=i) for i in range(2)]
        below = tops[0][1]
        parts = [(top[0], math.floor(delay) + i) for i, (top, _) in enumerate(tops)]
    else:
        discrete: Any = cont2discrete(([whole[-1]], whole), 1.0 / rate, "foh")
        below, parts = discrete[1], [(discrete[0][0], delay)]
    stills = [lfilter_zi(above, below) for above, _ in parts]
    bases = []
    for u, y in pairs:
        at, s = np.arange(u.size, dtype=float), np.zeros(u.size)
        for (above, shift), still in zip(parts, stills, strict=True):
            moved = np.interp(at - shift, at, u)
            s = s + lfilter(above, below, moved, zi=still * moved[0])[0]
        # what the log's own offset and start add: a constant, and how the form comes to rest
        fading: Any = np.exp(np.outer(at / rate, roots[: poles + pair]))
        ends = [fading.real, fading.imag[:, poles:]]
        ways, _ = np.linalg.qr(np.column_stack([np.ones(at.size), *ends]))
        bases.append((s - ways @ (ways.T @ s), y - ways @ (ways.T @ y), y))
    along = sum(float(s @ s) for s, _, _ in bases)
    gain = sum(float(s @ y) for s, y, _ in bases) / along if along > 0.0 else 0.0
    return gain, [whole - y + gain * s for s, y, whole in bases]
