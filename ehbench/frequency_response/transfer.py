"""Plain transfer functions fitted to an input and an output in time: which form follows best, and
with which numbers.

The output is ``gain · form(input) + offset``, offset and start each log's own. Forms have unit gain
at rest, their input goes straight from sample to sample."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ehbench.preprocessing.sensors import lagged
from ehbench.signals.series import correlation_time, fit_percent
from ehbench.vocabulary.settings import setting

# by form: the poles that it has, whether it has a delay
FORMS = {
    "first order": (1, False),
    "first order and delay": (1, True),
    "two poles": (2, False),
    "two poles and delay": (2, True),
}


@dataclass(frozen=True)
class TransferSettings:
    """Numbers of fitted transfer functions."""

    close: float = setting(
        1.0, "%", "fit by which a form of more numbers must be better", "plain to see"
    )
    spread: float = setting(4.0, "", "factor between two poles where a search begins", "apart")


SETTINGS = TransferSettings()


@dataclass(frozen=True)
class Transfer:
    """One form fitted to all logs: ``poles`` [rad/s], lowest first, ``delay`` [s] and ``gain``
    [output/input], each with its standard error; the NRMSE fit of each log [%], and whether the
    form is the one ``preferred``."""

    form: str
    gain: float
    poles: tuple[float, ...]
    pole_stds: tuple[float, ...]
    delay: float | None
    delay_std: float | None
    fit_percent: tuple[float, ...]
    preferred: bool = False

    @property
    def numbers(self) -> int:
        """How many numbers it has in addition to the gain."""
        return len(self.poles) + (self.delay is not None)

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


Pairs = Sequence[tuple[np.ndarray, np.ndarray]]


def transfers(pairs: Pairs, rate: float) -> tuple[Transfer, ...]:
    """Every form fitted to logs, the preferred first: the best of those with the fewest numbers
    that come within a percent of fit of the best of all.

    Args:
        pairs: input and output of each log.
        rate: samples per second.
    """
    results = [_fit_form(form, pairs, rate) for form in FORMS]
    level = {item.form: float(np.mean(item.fit_percent)) for item in results}
    close = [item for item in results if level[item.form] >= max(level.values()) - SETTINGS.close]
    fewest = min(item.numbers for item in close)
    best = max(
        (item for item in close if item.numbers == fewest), key=lambda entry: level[entry.form]
    )
    rest = sorted(
        (item for item in results if item is not best), key=lambda entry: -level[entry.form]
    )
    return (Transfer(**{**asdict(best), "preferred": True}), *rest)


def _fit_form(form: str, pairs: Pairs, rate: float) -> Transfer:
    from scipy.optimize import least_squares

    poles, late = FORMS[form]
    low, high = 2.0 * math.pi / max(y.size for _, y in pairs) * rate, 2.0 * math.pi * rate
    size = math.sqrt(float(np.mean([np.var(y) for _, y in pairs])))

    def residuals(theta: np.ndarray) -> np.ndarray:
        outputs = _outputs(theta, poles, pairs, rate)[1]
        return np.concatenate([y - s for s, (_, y) in zip(outputs, pairs, strict=True)]) / size

    starts = [math.log(w) for w in np.geomspace(4.0 * low, 0.1 * high, 6)]
    begins = [np.array([w + k * math.log(SETTINGS.spread) for k in range(poles)]) for w in starts]
    if late:
        begins = [np.append(begin, 1.0) for begin in begins]  # [samples]
    begin = min(begins, key=lambda item: float(np.sum(residuals(item) ** 2)))
    bounds = (
        [math.log(low)] * poles + [0.0] * late,
        [math.log(high)] * poles + [0.5 * rate] * late,
    )
    best = least_squares(
        residuals, np.clip(begin, *bounds), bounds=bounds, x_scale="jac", diff_step=1e-5
    )
    gain, seen = _outputs(best.x, poles, pairs, rate)
    tau = float(np.median([correlation_time(y - s) for s, (_, y) in zip(seen, pairs, strict=True)]))
    inverse = np.linalg.pinv(best.jac.T @ best.jac)
    std = np.sqrt(np.maximum(np.diag(inverse), 0.0) * float(np.mean(best.fun**2)) * tau)
    order = np.argsort(best.x[:poles])
    values = np.exp(best.x[:poles])
    return Transfer(
        form,
        gain,
        tuple(float(values[i]) for i in order),
        tuple(float(values[i] * std[i]) for i in order),
        float(best.x[-1]) / rate if late else None,
        float(std[-1]) / rate if late else None,
        tuple(fit_percent(y, s) for s, (_, y) in zip(seen, pairs, strict=True)),
    )


def _outputs(
    theta: np.ndarray, poles: int, pairs: Pairs, rate: float
) -> tuple[float, list[np.ndarray]]:
    """(gain, outputs) of a form: logarithms of its poles [rad/s], then its delay [samples]."""
    bases = []
    for u, y in pairs:
        at = np.arange(u.size, dtype=float)
        s = np.interp(at - theta[poles], at, u) if len(theta) > poles else u
        rates = np.exp(theta[:poles])
        for pole in rates:
            s = lagged(s, 1.0 / rate, 1.0 / float(pole))
        # what the log's own offset and start add: a constant, and a decay of each pole
        additional = np.exp(-np.outer(at / rate, [0.0, *rates]))
        ways, _ = np.linalg.qr(additional)
        bases.append((s - ways @ (ways.T @ s), y - ways @ (ways.T @ y), y))
    along = sum(float(s @ s) for s, _, _ in bases)
    gain = sum(float(s @ y) for s, y, _ in bases) / along if along > 0.0 else 0.0
    return gain, [whole - y + gain * s for s, y, whole in bases]
