"""Errors of what compares fits, against noise drawn many times."""

import math
from types import SimpleNamespace as Stub
from typing import Any

import numpy as np
import pytest

from ehbench.identification.hydraulics import _doubt


def fit_of(rng, sizes, length, shared=None):
    """A fit whose residuals of two logs are noise of these sizes, by channel."""
    recordings, logs = [], []
    for log in range(2):
        columns = {"t": np.arange(length) * 1e-3}
        for channel, size in sizes.items():
            noise = rng.standard_normal(length) if shared is None else shared[log]
            columns |= {channel: noise * size + 9.0, f"simulated.{channel}": np.full(length, 9.0)}
        rms = {c: float(np.sqrt(np.mean((columns[c] - 9.0) ** 2))) for c in sizes}
        recordings.append((str(log), columns))
        logs.append(Stub(residual_rms=rms))
    built: Any = Stub(recordings=recordings, logs=logs)
    return built


def level(fit) -> float:
    """The mean over logs and channels of ln(rms)."""
    return float(np.mean([math.log(x) for log in fit.logs for x in log.residual_rms.values()]))


@pytest.mark.parametrize("together", [False, True])
def test_the_error_of_a_comparison_is_its_scatter(together):
    """Channels whose residuals go together tell less than as many that do not."""
    rng, sizes = np.random.default_rng(1), {"a": 1.0, "b": 5.0}
    ratios, errors = [], []
    for _ in range(300):
        shared = rng.standard_normal((2, 2, 400)) if together else (None, None)
        first, other = (fit_of(rng, sizes, 400, noise) for noise in shared)
        ratios.append(level(first) - level(other))
        errors.append(_doubt(first, other))
    assert np.mean(errors) == pytest.approx(np.std(ratios), rel=0.1)


def test_fits_that_are_the_same_do_not_differ():
    one = fit_of(np.random.default_rng(2), {"a": 1.0}, 50)
    assert _doubt(one, one) == 0.0
