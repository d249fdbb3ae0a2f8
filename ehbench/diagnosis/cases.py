"""What is asked of: a log with the model that is to follow it, and what the model leaves over."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ehbench.data.record import Record, block_averages
from ehbench.diagnosis.faults.hypothesis import Hypothesis
from ehbench.plant.build import Maps
from ehbench.plant.foreign import model_of
from ehbench.plant.many import Replay
from ehbench.plant.model import Model
from ehbench.plant.paced import AUTO
from ehbench.plant.ties import supplied, tied_words
from ehbench.preprocessing.initial_states import InitialState, best_shifts, initial_state_of
from ehbench.preprocessing.observations import SETTINGS as OBSERVED
from ehbench.preprocessing.observations import column, empty_chambers, noise_of
from ehbench.preprocessing.sensors import Term, corrected, sensed
from ehbench.signals.series import correlation_time, rms
from ehbench.vocabulary.quantities import GAUGES

CERTAIN = 30.0  # log-likelihood ratio that the best of all faults hardly reaches by chance
MATTERS = 0.1  # share of the squares beyond the noise that a fault must explain
QUIET = 1.3  # mean square of residuals, in those of noise, up to which hardly anything is left
DOMINANT = 0.5  # share of the residuals' squares from which a cause speaks against the model
BLOCK = 0.005  # [s]: residuals are averaged over it
FINE = 0.005  # share of a channel's spread below which an error does not matter, whatever the noise


@dataclass(frozen=True)
class Case:
    """A log and the model, with the log's payload, that is to follow it; ``cylinders`` are those
    that are commanded, ``scored`` the part [s] that counts, None for all of it, ``terms`` and
    ``bias`` what its sensors are known to make of it. Where not ``refined`` it starts from what its
    standstill shows."""

    name: str
    record: Record
    model: Model
    cylinders: tuple[str, ...]
    maps: Maps | None = None
    scored: tuple[float, float] | None = None
    terms: tuple[Term, ...] = ()
    bias: Mapping[str, float] = field(default_factory=dict)
    refined: bool = True

    def simulated(self) -> Record:
        """What the model does on the record from the estimated initial state, as its sensors show
        it."""
        true = self._start.record
        start, _ = self._start.begin(self.model, self._shifts)
        return sensed(self.model.replay(true, AUTO, start=start), self.terms, self.bias)

    def run_of(self, fault: Hypothesis, delta: float) -> Replay:
        """(the model with a fault of size δ, the record as sound sensors would have it, the start).

        Raises:
            EhbenchError, ValueError: there is no such rig."""
        rig = fault.rig(self.model.rig, delta)
        model = self.model if rig is self.model.rig else model_of(rig, self.maps)
        record = fault.record(self.record, delta)
        true = corrected(record, *fault.terms(self.terms, self.bias, delta))
        begin = self._start if true is self._start.record else replace(self._start, record=true)
        start, _ = begin.begin(model, self._shifts)
        return Replay(model, true, start)

    def seen(self, replayed: Record, fault: Hypothesis, delta: float) -> Record:
        """A simulation with a fault of size δ as the log's sensors show it."""
        return sensed(replayed, *fault.terms(self.terms, self.bias, delta))

    @cached_property
    def _start(self) -> InitialState:
        """Where the log starts, with the uncertainty of each number of its initial state."""
        true = corrected(self.record, self.terms, self.bias)
        return initial_state_of(self.model, true, self.cylinders, self._of_cylinders)

    @cached_property
    def _shifts(self) -> np.ndarray:
        """The initial state from which the model follows the log best: the mean of a standstill is
        not the state of a chamber that leaks."""
        if not self.refined:
            return np.zeros(len(self._start.uncertain))
        return best_shifts(self.model, self._start, self._of_cylinders)

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """Rate and pressures of each cylinder and the pressure of the supply, as far as the log has
        them moving and does not give them to the simulation."""
        free = self.model.rig.model is None and not supplied(self.record)
        line = ("p_supply",) if free and self._moves("p_supply") else ()
        return (*self._of_cylinders, *line)

    @cached_property
    def _of_cylinders(self) -> tuple[str, ...]:
        """Those by which a log's start is told."""
        results = []
        for cylinder in self.cylinders:
            rates = [f"{cylinder}.{word}" for word in ("v", "qd")]
            rate = next((name for name in rates if name in self.record), None)
            rate = rate or next(
                (name for name in rates if column(self.record, name, self.record) is not None), None
            )
            ends = [f"{cylinder}.{word}" for word in ("p_head", "p_rod")]
            ends = [name for name in ends if self._moves(name)]
            gauges = [f"{cylinder}.{word}" for word in GAUGES]
            results += [rate] if rate and self._moves(rate) else []
            results += ends or [name for name in gauges if self._moves(name)]
        given = tied_words(self.record)
        return tuple(name for name in results if name.rpartition(".")[2] not in given)

    def _moves(self, channel: str) -> bool:
        values = column(self.record, channel, self.record)
        return values is not None and float(np.ptp(values)) > 0.0

    @cached_property
    def keep(self) -> np.ndarray:
        """Which samples count: as in a fit, of an empty chamber none, unless that leaves none."""
        t = self.record.t
        low, high = self.scored or (-math.inf, math.inf)
        inside = (t >= low) & (t <= high)
        void = [empty for _, empty in empty_chambers(self.model.rig, self.record)]
        full = inside & ~np.any(void, axis=0)
        return full if np.any(full) else inside

    @cached_property
    def block(self) -> int:
        """Samples to a block."""
        return max(1, round(BLOCK / self.record.sample_time))

    def blocks(self, values: np.ndarray) -> np.ndarray:
        """Means of what counts of a channel over blocks."""
        return block_averages(values[self.keep], self.block)

    @cached_property
    def recorded(self) -> dict[str, np.ndarray]:
        """Blocks of each channel, as recorded."""
        results = {}
        for channel in self.channels:
            values = column(self.record, channel, self.record)
            assert values is not None  # `channels` has only those
            results[channel] = self.blocks(values)
        return results

    @cached_property
    def noise(self) -> dict[str, float]:
        """Standard deviation that white noise gives a block of each channel."""
        return {name: noise_of(self.record, name, self.block) for name in self.recorded}

    @cached_property
    def scales(self) -> dict[str, float]:
        """What an error of each channel is measured by: the noise of a block, and a share of the
        channel's spread; of the supply's pressure the share of its level that is told."""
        results = {}
        for channel, values in self.recorded.items():
            slight = FINE * float(np.std(values))
            if channel == "p_supply":  # it drives flows by its level
                slight = OBSERVED.supply_off * rms(values)
            results[channel] = math.hypot(self.noise[channel], slight)
        return results

    @property
    def noise_squares(self) -> float:
        """Sum of the squares that noise alone leaves of `left`."""
        return sum(
            values.size * (self.noise[channel] / self.scales[channel]) ** 2
            for channel, values in self.recorded.items()
        )

    def left(self, simulated: Record) -> np.ndarray:
        """Blocks of simulated minus recorded of all channels, one after the other, in their scales;
        shape (blocks · channels,)."""
        parts = []
        for channel, recorded in self.recorded.items():
            values = column(simulated, channel, self.record)
            assert values is not None
            parts.append((self.blocks(values) - recorded) / self.scales[channel])
        return np.concatenate(parts)

    def independent(self, left: np.ndarray) -> float:
        """How many independent numbers what is left over is worth."""
        parts = np.split(left, len(self.recorded))
        return sum(part.size / correlation_time(part) for part in parts)


def total(parts: Sequence[np.ndarray]) -> float:
    """Sum of squares."""
    return float(sum(float(part @ part) for part in parts))


def counts(gain: float, of: float, noise: float, independent: float) -> bool:
    """Whether so much less in a sum of squares ``of`` is more than chance, by the noise and by what
    is left, and more than a trifle of what exceeds the noise.

    Args:
        gain: by how much the sum is less.
        of: the sum.
        noise: what noise alone makes of it.
        independent: numbers that the residuals are worth."""
    if gain <= max(MATTERS * (of - noise), 2.0 * CERTAIN):
        return False
    return independent * math.log(of / max(of - gain, 1.0e-12 * of)) > CERTAIN
