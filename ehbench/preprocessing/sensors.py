"""Errors of sensors and drivers, known and estimated.

``reading = scale · late(sign · true) + offset``. What a recipe knows of it is taken out of a log
before anything else sees it (`known_taken_out`); what it wants estimated, and every lag and delay,
is a `Term`. Its bias e is what the number is off from the known one:

    log, known taken out = (1 + e_scale) · late(true) + e_offset"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ehbench.config.recipe.sensor import ESTIMATE, WORDS, Sensor
from ehbench.data.record import Record
from ehbench.plant.ties import DELAY, tied_words, without_noise
from ehbench.vocabulary import InputError, grouped, message
from ehbench.vocabulary.fields import Value
from ehbench.vocabulary.quantities import like_channel

ATMOSPHERE = 101_325.0  # [Pa]
# standard deviations of what is only said to be estimated: an offset's as a share of the channel's
# range, a scale's, those of a lag and a delay [s]
VAGUE = {"offset": 0.25, "scale": 0.2, "lag": 0.01, "delay": 0.01}
Bias = Mapping[str, float]  # by name of the term


@dataclass(frozen=True)
class Term:
    """One number of a channel's sensor: ``word`` is offset, scale, lag or delay.

    Its value is ``known`` + ``per`` · bias [SI]; ``std`` is the bias's standard deviation
    before the logs are asked, 0 where nothing is estimated; ``per_log`` says that each log has its
    own."""

    channel: str
    word: str
    known: float
    per: float
    std: float
    per_log: bool

    @property
    def name(self) -> str:
        """Such as ``boom.p_head.offset``."""
        return f"{self.channel}.{self.word}"

    @property
    def lowest(self) -> float:
        """The lowest bias: no reading comes before its time has lagged by nothing."""
        return {"lag": -self.known, "scale": -0.99}.get(self.word, -math.inf)

    def value(self, bias: float) -> float:
        """The number itself [SI]."""
        return self.known + self.per * bias

    def bias(self, value: float) -> float:
        """The bias at which the number is ``value`` [SI]."""
        return (value - self.known) / self.per


def _known(sensor: Sensor) -> dict[str, float]:
    """The numbers of a sensor as far as they are known: ``offset`` is what it reads at zero,
    ``scale`` has its sign."""
    plain = {"offset": 0.0, "scale": 1.0, "lag": 0.0, "delay": 0.0}
    given = {word: sensor[word] for word in WORDS}
    known = plain | {word: float(x) for word, x in given.items() if isinstance(x, Value)}
    known["offset"] += ATMOSPHERE * (sensor.pressure == "absolute")
    known["scale"] *= sensor.sign
    return known


def known_taken_out(name: str, record: Record, sensors: Sequence[Sensor]) -> Record:
    """A log as sound sensors would have given it, as far as sign, scale and offset are known.

    Raises:
        InputError: the log has no such channel."""
    channels = dict(record.channels)
    for sensor in sensors:
        if sensor.channel not in channels:
            text = message("preprocessing.unknown_sensor", log=name, channel=sensor.channel)
            raise InputError(text, hint=like_channel(sensor.channel, list(channels)))
        known = _known(sensor)
        reading = channels[sensor.channel]
        channels[sensor.channel] = (reading - known["offset"]) / known["scale"]
    return replace(record, channels=channels) if sensors else record


def terms_of(sensors: Sequence[Sensor], records: Sequence[Record]) -> tuple[Term, ...]:
    """What is left to estimate, and known lags and delays, of logs without their known errors."""
    results = []
    for sensor in sensors:
        known = _known(sensor)
        span = max(float(np.ptp(log[sensor.channel])) for log in records)
        span = span or max(float(np.max(np.abs(log[sensor.channel]))) for log in records) or 1.0
        for word in WORDS:
            given = sensor[word]
            if given is None:
                continue
            per = known["scale"] if word in ("offset", "scale") else 1.0
            std = 0.0
            if given == ESTIMATE:
                std = VAGUE[word] * (span if word == "offset" else 1.0)
            elif isinstance(given, Value) and given.std:
                std = given.std / abs(per)
            if std > 0.0 or (word in ("lag", "delay") and known[word] != 0.0):
                results.append(Term(sensor.channel, word, known[word], per, std, sensor.per_log))
    return tuple(results)


def corrected(record: Record, terms: Sequence[Term], bias: Bias) -> Record:
    """A log whose known errors are taken out, as sound sensors would have given it by what is
    estimated as well: commands as the valves get them, to the sample, with what is left of a delay
    as a fact; readings by their level and scale, a motion that is tied as much earlier as its
    sensor is late. It is the log itself where nothing is."""
    channels, given, meta = {}, tied_words(record), dict(record.meta)
    for name, item in grouped(terms, lambda term: term.channel).items():
        if name not in record:
            continue
        e = {term.word: bias.get(term.name, 0.0) for term in item}
        moved = name.endswith(".command") or name.rpartition(".")[2] in given
        if not moved and e.get("offset", 0.0) == e.get("scale", 0.0) == 0.0:
            continue
        true = (record[name] - e.get("offset", 0.0)) / (1.0 + e.get("scale", 0.0))
        late = {t.word: t.value(max(bias.get(t.name, 0.0), t.lowest)) for t in item}
        if name.endswith(".command"):
            tick, delay = record.sample_time, late.get("delay", 0.0)
            whole = math.floor(delay / tick + 1e-9)
            meta[f"{name}.{DELAY}"] = repr(max(delay - whole * tick, 0.0))
            true = true[np.clip(np.arange(true.size) - whole, 0, true.size - 1)]
            true = lagged(true, tick, late.get("lag", 0.0))
        elif name.rpartition(".")[2] in given:
            at, tick = np.arange(true.size, dtype=float), record.sample_time
            true = np.interp(at + late.get("delay", 0.0) / tick, at, true)
            true += late.get("lag", 0.0) * np.gradient(without_noise(true, tick), tick)
        channels[name] = true
    return replace(record, channels=record.channels | channels, meta=meta) if channels else record


def sensed(replayed: Record, terms: Sequence[Term], bias: Bias) -> Record:
    """A simulation as the log's sensors would have shown it, known errors taken out."""
    channels = dict(replayed.channels)
    for name, item in grouped(terms, lambda term: term.channel).items():
        if name not in channels or name.endswith(".command"):
            continue
        e = {term.word: bias.get(term.name, 0.0) for term in item}
        seen = _delayed(channels[name], replayed.sample_time, item, bias)
        channels[name] = (1.0 + e.get("scale", 0.0)) * seen + e.get("offset", 0.0)
    return replace(replayed, channels=channels) if terms else replayed


def _delayed(y: np.ndarray, tick: float, terms: Sequence[Term], bias: Bias) -> np.ndarray:
    """A series behind the lag and the delay among some terms of its channel."""
    times = {t.word: t.value(max(bias.get(t.name, 0.0), t.lowest)) for t in terms}
    lag, delay = times.get("lag", 0.0), times.get("delay", 0.0)
    if delay != 0.0:
        at = np.arange(y.size, dtype=float)
        y = np.interp(at - delay / tick, at, y)
    return lagged(y, tick, lag)


def lagged(y: np.ndarray, tick: float, lag: float) -> np.ndarray:
    """A series behind a first-order lag [s], exact for what goes straight from sample to sample."""
    if lag <= 0.0:
        return y
    from scipy.signal import lfilter

    a = tick / lag
    pole = math.exp(-a)
    old, new = (1.0 - pole) / a - pole, 1.0 - (1.0 - pole) / a
    return lfilter([new, old], [1.0, -pole], y, zi=[(1.0 - new) * y[0]])[0]
