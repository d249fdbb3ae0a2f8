"""Parameters as search coordinates: where a search starts, between which bounds, in which units."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ehbench.config.recipe.sensor import reading_row
from ehbench.config.rig import Rig
from ehbench.preprocessing.sensors import Term
from ehbench.vocabulary import InputError, Quantity, message, placed, quantity, units
from ehbench.vocabulary.errors import nearest
from ehbench.vocabulary.fields import Value

LEVEL = 0.95
# a standard error of more than this many units of a parameter says nothing: 95 % then span a factor
# of 50 (searched as a logarithm), or its whole range
VAGUE = {True: 1.0, False: 0.5}
_SHARE = re.compile(r"\s*(\d+\.?\d*|\.\d+)\s*%\s*$")
# a sensor's bias is searched in units of so many standard deviations, so that what is known
# before the logs counts as known, up to so many
MANY, FAR = 4.0, 20.0
WIDE = 1.0e3  # factor either way that a positive parameter without bounds is searched over

Where = Callable[..., Mapping[str, Any]]
Given = Mapping[str, str | float]


@dataclass(frozen=True)
class Coordinate:
    """How a parameter is searched: as its logarithm where it is surely positive, else in units of
    its range or of its start.

    ``prior`` is the standard deviation of what is known of it beside the data, about ``centre``,
    both SI; infinite where nothing is."""

    name: str
    log: bool
    unit: float
    start: float
    lower: float
    upper: float
    prior: float = math.inf
    centre: float = 0.0
    quantity: Quantity | None = None

    def at(self, theta: float) -> float:
        low, high = self.bounds
        theta = float(min(max(theta, low), high))
        return min(max(math.exp(theta) if self.log else theta * self.unit, self.lower), self.upper)

    def of(self, value: float) -> float:
        return math.log(value) if self.log else value / self.unit

    @property
    def row(self) -> Quantity:
        """The vocabulary's row of the parameter."""
        return self.quantity or quantity(self.name)

    @property
    def owner(self) -> str:
        """Joint, cylinder or edge that the parameter belongs to; empty for the rig's own."""
        return self.name.rpartition(".")[0]

    @property
    def bounds(self) -> tuple[float, float]:
        return self.of(self.lower), self.of(self.upper)

    @property
    def roams(self) -> bool:
        """Whether nothing says where it lies but where it starts: it may be far off."""
        return self.log or self.unit < self.upper - self.lower

    @property
    def known(self) -> bool:
        """Whether it has a prior."""
        return self.prior < math.inf

    @property
    def sharpness(self) -> float:
        """Inverse standard deviation of the prior in search coordinates."""
        return (self.centre if self.log else self.unit) / self.prior

    @property
    def reach(self) -> float:
        """How far a parameter may sensibly move, in its own units: between its bounds, or a few
        units if they are far apart."""
        low, high = self.bounds
        return min(high - low, 3.0)

    @property
    def begin(self) -> float:
        """Where the search starts."""
        return self.inside(self.start)

    def inside(self, value: float) -> float:
        """The search coordinate of a value, just inside the bounds, as the solver asks."""
        low, high = self.bounds
        margin = 1e-3 * self.reach
        return min(max(self.of(value), low + margin), high - margin)

    def half(self, value: float, interval: tuple[float, float] | None) -> float | None:
        """The longer half of an interval about a value, both SI; None where it has none."""
        if interval is None:
            return None
        low, high = (self.of(min(max(end, self.lower), self.upper)) for end in interval)
        return max(self.of(value) - low, high - self.of(value))

    def spread(
        self, theta: float, std: float, quantile: float
    ) -> tuple[float, tuple[float, float]]:
        """(standard error, interval inside the bounds), SI, from a standard error of theta."""
        value = self.at(theta)
        ends = (self.at(theta - quantile * std), self.at(theta + quantile * std))
        return (value * std if self.log else self.unit * std), ends


def coordinates(
    rig: Rig,
    names: Sequence[str],
    start: Given | None = None,
    lower: Given | None = None,
    upper: Given | None = None,
    where: Where = lambda *location: {},
    prior: Given | None = None,
) -> list[Coordinate]:
    """The search coordinates of parameters; start and bounds as given (SI or text with unit), else
    the rig's, else some; ``prior`` standard deviations about the rig's value, also as ``"3 %"`` of
    it.

    A positive start without any bound is searched as a logarithm, a factor `WIDE` either way.
    ``where`` gives file and line of a recipe's key, for the errors.

    Raises:
        InputError: unknown or repeated parameter, a start outside its bounds, a zero start without
            an upper bound, a prior that is not positive or a share of zero."""
    given = {"start": dict(start or {}), "lower": dict(lower or {}), "upper": dict(upper or {})}
    given["prior"] = dict(prior or {})
    known = rig.parameters()
    for key, table in {"parameters": names, **given}.items():
        for name in table:
            place = where(key) if key == "parameters" else where(key, name)
            if name not in known:
                text = message("identification.no_parameter", rig=rig.name, name=name)
                hint = nearest(name, known, "nearest is '{}'")
                raise InputError(text, **place, hint=hint)
            if name not in names:
                fields = {"key": key, "name": name, "fitted": ", ".join(names)}
                raise InputError(message("identification.not_fitted", **fields), **place)
    if not names or len(set(names)) < len(names):
        raise InputError(message("identification.parameters_once"), **where("parameters"))
    return [_coordinate(rig, name, known[name], given, where) for name in names]


def of_sensors(terms: Sequence[Term]) -> list[Coordinate]:
    """The search coordinates of the bias of sensors that all logs share, each held by its
    standard deviation."""
    return [
        Coordinate(
            term.name,
            False,
            MANY * term.std,
            0.0,
            max(term.lowest, -FAR * term.std),
            FAR * term.std,
            term.std,
            0.0,
            reading_row(term.channel, term.word),
        )
        for term in terms
        if term.std > 0.0 and not term.per_log
    ]


def _coordinate(
    rig: Rig, name: str, value: Value, given: Mapping[str, Given], where: Where
) -> Coordinate:
    row = quantity(name)

    def bound(key: str, default: float | None) -> float | None:
        return _number(given[key][name], name, where(key, name)) if name in given[key] else default

    first = _number(given["start"].get(name, float(value)), name, where("start", name))
    low, high = bound("lower", value.lower), bound("upper", value.upper)
    bounded = high is not None
    if first > 0.0 and row.lower >= 0.0 and low is None and high is None:
        low, high = max(row.lower, first / WIDE), min(row.upper, first * WIDE)
    low = row.lower if low is None else low
    high = row.upper if high is None else high
    place = where("start", name) if name in given["start"] else where("parameters")
    shown = {"low": low, "high": high, "start": first}
    fields = {key: rig.shown(name, x) for key, x in shown.items()}
    fields |= {"name": name, "unit": row.display}
    if not low < high:
        key = "upper" if name in given["upper"] else "lower"
        raise InputError(message("identification.no_range", **fields), **where(key, name))
    if not low <= first <= high:
        raise InputError(message("identification.start_outside", **fields), **place)
    log = low > 0.0
    unit = high - low if bounded and math.isfinite(high - low) else abs(first)
    if unit == 0.0:
        raise InputError(message("identification.zero_start", **fields), **place)
    std, centre = math.inf, math.nan
    if name in given["prior"]:
        centre = min(max(float(value), low), high)
        raw, place = given["prior"][name], where("prior", name)
        share = _SHARE.match(raw) if isinstance(raw, str) else None
        std = abs(centre) * float(share[1]) / 100.0 if share else _number(raw, name, place, False)
        if not 0.0 < std < math.inf:
            fields |= {"raw": raw, "centre": centre}
            raise InputError(message("identification.empty_prior", **fields), **place)
    return Coordinate(name, log, 1.0 if log else unit, first, low, high, std, centre)


def _number(raw: str | float, name: str, at: Mapping[str, Any], check: bool = True) -> float:
    """A number in SI; ``check`` holds it against the plausible range of the parameter."""
    if not isinstance(raw, str):
        return float(raw)
    row = quantity(name)
    with placed(at):
        return units.parse(raw, row if check else replace(row, lower=-math.inf, upper=math.inf))
