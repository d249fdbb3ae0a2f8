"""Which products and ratios of parameters the data know where they do not know each: directions in
the parameters' logarithms that the logs hardly tell.

A relative change of the parameters by ``d ln p = v`` that changes no channel is a scale that the
logs cannot tell. What they do tell are the products ``Π pᵢ^wᵢ`` with ``w`` orthogonal to all such
``v``."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ehbench.vocabulary import Z95, Message, message, setting


@dataclass(frozen=True)
class GroupSettings:
    """Numbers of products of parameters."""

    better: float = setting(
        0.25, "", "error of a product over that of its parameters up to which it is one", "clear"
    )
    halves: float = setting(2.0, "", "parts of one in which exponents are told", "physics has few")
    largest: float = setting(3.0, "", "largest exponent told so", "cubes")


SETTINGS = GroupSettings()


@dataclass(frozen=True)
class Group:
    """A product of powers that the logs know though they do not know each of its parameters:
    ``text`` as people write it, ``powers`` by name, ``value`` [SI] and its 95 % ``interval``,
    ``std`` of its logarithm and, by name, of each parameter's (``alone``)."""

    text: str
    powers: dict[str, float]
    value: float
    interval: tuple[float, float]
    std: float
    alone: dict[str, float]


def groups_of(
    names: Sequence[str], values: Sequence[float], normal: np.ndarray, widening: float
) -> tuple[Group, ...]:
    """The products that the logs know, each parameter that they do not know by itself in one of
    them or in none.

    Args:
        names, values: of the parameters that are searched by their logarithm, values in SI.
        normal: ``Σ JᵀJ`` of the scaled residuals to the logarithms, all else eliminated, without
            priors, shape (names, names).
        widening: of standard errors because residuals are coloured."""
    count = len(names)
    sizes, vectors = np.linalg.eigh(0.5 * (normal + normal.T))
    sizes = np.maximum(sizes, 1e-13 * sizes[-1])
    covariance = (vectors / sizes) @ vectors.T * widening**2
    leaders = _leaders(covariance)
    groups = []
    for i in (i for i in range(count) if leaders and i not in leaders):
        power = np.zeros(count)
        power[i] = 1.0
        power[leaders] = -np.linalg.solve(
            covariance[np.ix_(leaders, leaders)], covariance[leaders, i]
        )
        power = _rounded(power, covariance)
        std = _std(power, covariance)
        if np.count_nonzero(power) > 1 and std < SETTINGS.better * _smallest(power, covariance):
            powers = {name: float(p) for name, p in zip(names, power, strict=True) if p}
            value = math.exp(sum(p * math.log(v) for p, v in zip(power, values, strict=True) if p))
            reach = math.exp(min(Z95 * std, 50.0))
            alone = {n: math.sqrt(covariance[k, k]) for k, n in enumerate(names) if n in powers}
            ends = (value / reach, value * reach)
            groups.append(Group(_power_product(powers), powers, value, ends, std, alone))
    return tuple(groups)


def _std(power: np.ndarray, covariance: np.ndarray) -> float:
    return float(np.sqrt(power @ covariance @ power))


def _smallest(power: np.ndarray, covariance: np.ndarray) -> float:
    """The least that one factor of a product alone leaves open of its logarithm."""
    return float(
        np.min(np.abs(power) * np.sqrt(np.diag(covariance)), where=power != 0, initial=np.inf)
    )


def _leaders(covariance: np.ndarray) -> list[int]:
    """The parameters that would have to be known for all others to be: one at a time, that whose
    knowledge would sharpen another one most."""
    left, result = covariance.copy(), []
    variances = np.diag(covariance)
    while True:
        rest = [i for i, size in enumerate(variances) if left[i, i] > 1e-9 * size]  # not yet known
        best, gain = None, 1.0 / SETTINGS.better**2
        for i in rest:
            after = np.diag(left) - left[:, i] ** 2 / left[i, i]
            others = [k for k in rest if k != i]
            if not others:
                continue
            more = max(left[k, k] / max(after[k], 1e-12 * variances[k]) for k in others)
            if more > gain:
                best, gain = i, more
        if best is None:
            return sorted(result)
        left = left - np.outer(left[:, best], left[best]) / left[best, best]
        result.append(best)


def _rounded(power: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Exponents in halves where the product stays much better known than its factors, else to two
    digits; whole ones where halves are left."""
    halves = np.round(SETTINGS.halves * power) / SETTINGS.halves
    plain = np.max(np.abs(halves)) <= SETTINGS.largest
    if plain and _std(halves, covariance) < SETTINGS.better * _smallest(halves, covariance):
        return halves if np.all(halves == np.round(halves)) else 2.0 * halves
    return np.where(np.abs(power) < 0.05, 0.0, np.round(power, 2))


def _power_product(powers: dict[str, float]) -> str:
    sides: dict[bool, list[str]] = {True: [], False: []}
    for name, power in powers.items():
        sides[power > 0].append(name if abs(power) == 1.0 else f"{name}^{abs(power):g}")
    above, below = ("·".join(sides[side]) for side in (True, False))
    if not below:
        return above
    return f"{above or '1'}/{below if '·' not in below else f'({below})'}"


def sentence(groups: Sequence[Group]) -> Message:
    """What people read: the products, and that the logs do not know each."""
    known = " and ".join(f"{group.text} ({_percent(group.std)})" for group in groups)
    alone = {name: std for group in groups for name, std in group.alone.items()}
    each = ", ".join(f"{name} {_percent(std)}" for name, std in alone.items())
    return message("identification.groups", known=known, each=each)


def _percent(std: float) -> str:
    """The 95 % interval of a factor whose logarithm has this standard error."""
    if Z95 * std > 1.0:
        return f"within a factor {math.exp(min(Z95 * std, 50.0)):.2g}" if std < 3.0 else "unknown"
    return f"± {100.0 * Z95 * std:.2g} %"
