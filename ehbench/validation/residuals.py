"""One channel of one log: the error of the model, and whether the residual is noise."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ehbench.data.record import Record, block_averages
from ehbench.plant.model import Model
from ehbench.preprocessing.observations import column, noise_of
from ehbench.preprocessing.plausibility import LIMITED, at_limit, held
from ehbench.signals import series
from ehbench.validation.results import ChannelResult, Correlation
from ehbench.vocabulary import message, quantity, setting


@dataclass(frozen=True)
class ResidualSettings:
    """Numbers of the comparison of a channel."""

    noise: float = setting(
        0.5, "", "von Neumann ratio above which a channel is noise", "1 if white, 0 if smooth"
    )
    lag_step: float = setting(0.01, "s", "step of the lags of residuals", "faster than any valve")
    lag_span: float = setting(0.5, "s", "largest lag of residuals", "some periods of a swing")


SETTINGS = ResidualSettings()


class Pair(NamedTuple):
    """A channel recorded and simulated [SI]; ``derived``: both are the position's rate."""

    recorded: np.ndarray
    simulated: np.ndarray
    derived: bool

    def part(self, keep: np.ndarray) -> Pair:
        """The samples that are marked."""
        return Pair(self.recorded[keep], self.simulated[keep], self.derived)


def pair_of(record: Record, simulated: Record, channel: str) -> Pair | None:
    """Both sides of a channel, None if the log cannot give it. Where a pressure or force was
    recorded at the end of its sensor's range, the simulation ends there too; where a recorder held
    its readings, it is what they are."""
    recorded, shown = (column(item, channel, record) for item in (record, simulated))
    if recorded is None or shown is None:
        return None
    if channel in record and quantity(channel).unit in LIMITED:
        limit = at_limit(recorded)
        inside = np.clip(shown, np.min(recorded), np.max(recorded))
        shown = np.where(limit, inside, shown)
    shown = np.where(held(record, channel), recorded, shown)
    return Pair(recorded, shown, channel not in record)


def compare_channel(record: Record, model: Model, channel: str, pair: Pair) -> ChannelResult:
    """How a channel is followed."""
    recorded, error = pair.recorded, pair.simulated - pair.recorded
    plain = ChannelResult(
        channel=channel,
        unit=quantity(channel).unit,
        fit_percent=None,
        max_error=float(error[np.argmax(np.abs(error))]),
        bias=float(np.mean(error)),
        rms_error=series.rms(error),
        derived=pair.derived,
    )
    variance = float(np.var(recorded))
    if math.sqrt(variance) <= 1e-9 * float(np.max(np.abs(recorded))):
        return replace(plain, note=message("validation.constant"))
    if float(np.mean(np.diff(recorded) ** 2)) > 2.0 * SETTINGS.noise * variance:
        return replace(plain, note=message("validation.only_noise"))
    share = noise_of(record, channel) / math.sqrt(variance)
    fit = series.fit_percent(recorded, pair.simulated)
    plain = replace(plain, fit_percent=fit, noise_share=min(1.0, float(share)))
    block = max(1, round(SETTINGS.lag_step / record.sample_time))
    residual = block_averages(error, block)
    lags = min(round(SETTINGS.lag_span / (block * record.sample_time)), len(residual) // 4)
    if lags < 2 or float(np.ptp(residual)) <= 1e-12 * float(np.max(np.abs(recorded))):
        return plain
    lag = block * record.sample_time * np.arange(lags + 1)
    both = (series.autocorrelation, series.autocorrelation_band)
    values, band = (of(residual, lags)[1:] for of in both)
    auto = _rounded_correlation(channel, lag[1:], values, band)
    cross = []
    cylinder = channel.partition(".")[0]
    for valve in model.layout.valves:
        name = f"{valve}.command"
        if not valve.startswith(f"{cylinder}.") or name not in record:
            continue
        command = block_averages(record[name], block)
        if float(np.ptp(command)) > 0.0:
            band = np.full(lags + 1, series.correlation_band(residual, command))
            values = series.correlation(residual, command, lags)[lags:]
            cross.append(_rounded_correlation(name, lag, values, band))
    return replace(plain, autocorrelation=auto, cross_correlation=tuple(cross))


def _rounded_correlation(
    of: str, lag: np.ndarray, value: np.ndarray, band: np.ndarray
) -> Correlation:
    rounded = [
        tuple(float(f"{number:.6g}") for number in numbers) for numbers in (lag, value, band)
    ]
    return Correlation(of, *rounded, outside_percent=100.0 * float(np.mean(np.abs(value) > band)))
