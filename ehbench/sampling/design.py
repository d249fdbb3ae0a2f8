"""Which samples a study has: every combination of listed values, each on the same points of what is
drawn or swept without a count.

A sample depends only on the study's seed and its number, never on where or when it is made."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ehbench.config.recipe import StudyRecipe
from ehbench.vocabulary import InputError, UnitError, message, shortened
from ehbench.vocabulary.units import split_number

CASE, RECIPE = "case", "recipe"  # columns that no key has


@dataclass(frozen=True)
class Drawn:
    """A drawn key: ``law`` with two numbers in ``unit``, ``relative`` or not, and its ends."""

    key: str
    law: str
    first: float
    second: float
    unit: str = ""
    relative: bool = False
    lower: float = -math.inf
    upper: float = math.inf

    @property
    def text(self) -> str:
        """Its law in words, without the unit."""
        first, second = f"{self.first:.4g}", f"{self.second:.4g}"
        return {
            "uniform": f"{first} … {second}, evenly",
            "log_uniform": f"{first} … {second}, evenly in the logarithm",
            "normal": f"{first}, standard deviation {second}",
            "log_normal": f"{first}, a factor of {second} as standard deviation",
        }[self.law]

    def value(self, z: np.ndarray) -> np.ndarray:
        """The draws at standard normal ``z``."""
        from scipy.special import ndtr

        if self.law == "normal":
            raw = self.first + self.second * z
        elif self.law == "log_normal":
            raw = self.first * self.second**z
        elif self.law == "log_uniform":
            raw = self.first * (self.second / self.first) ** ndtr(z)
        else:
            raw = self.first + (self.second - self.first) * ndtr(z)
        return np.clip(raw, self.lower, self.upper)


@dataclass(frozen=True)
class Listed:
    """A key that goes through values as a recipe would have them; ``relative``: factors."""

    key: str
    values: tuple[Any, ...]
    relative: bool = False


@dataclass(frozen=True)
class Column:
    """A column of inputs: key, unit or '', ``is_text``, ``varied`` by ``draw`` or ``sweep``."""

    key: str
    unit: str = ""
    is_text: bool = False
    varied: str = "sweep"

    @property
    def head(self) -> str:
        """As a table heads it."""
        return f"{self.key} [{self.unit}]" if self.unit else self.key


class Fitted(NamedTuple):
    """Identified parameters as draws of keys of the rig, SI, and their correlation."""

    drawn: list[Drawn]
    correlation: np.ndarray

    @classmethod
    def of(cls, result: Mapping[str, Any], required: Sequence[str], file: Any) -> Fitted:
        """Of a ``parameters.json``.

        Raises:
            InputError: it has no such parameter, or no standard error of it."""
        rows = {row["name"]: row for row in result["parameters"]}
        known = [name for name in rows if rows[name]["std"] is not None]
        names = list(required) or known
        if missing := [name for name in names if name not in known]:
            text = message("sampling.not_fitted", name=missing[0], known=", ".join(known))
            raise InputError(text, file=file)
        if not names:
            raise InputError(message("sampling.nothing_fitted"), file=file)
        drawn = []
        for name in names:
            row = rows[name]
            unit = "" if row["unit"] == "dimensionless" else row["unit"]
            lower = -math.inf if row["lower"] is None else row["lower"]
            upper = math.inf if row["upper"] is None else row["upper"]
            numbers = float(row["value"]), float(row["std"])
            drawn.append(Drawn(f"rig.{name}", "normal", *numbers, unit, False, lower, upper))
        order = [result["correlated_names"].index(name) for name in names]
        return cls(drawn, np.array(result["correlation"], float)[np.ix_(order, order)])


class Design:
    """The samples of a study; ``fitted`` is what its ``identified`` names.

    Raises:
        InputError: numbers without a common unit, a correlation that cannot be, …"""

    def __init__(self, recipe: StudyRecipe, fitted: Fitted | None = None) -> None:
        self.recipe = recipe
        self.listed, self.drawn = _listed(recipe), [] if fitted is None else [*fitted.drawn]
        for key, spread in recipe.draw.items():
            law, ends = spread.kind, spread.ends
            self.drawn.append(_drawn(recipe, ("draw", key), law, ends, spread.relative))
        for key, span in recipe.sweep.items():
            if span.low is not None and span.count is None:
                law, ends = "log_uniform" if span.log else "uniform", (span.low, span.high)
                self.drawn.append(_drawn(recipe, ("sweep", key), law, ends, span.relative))
        twice = [item.key for item in self.drawn if [d.key for d in self.drawn].count(item.key) > 1]
        if twice:
            raise InputError(message("sampling.drawn_twice", key=twice[0]), **recipe.at("draw"))
        self._root = _root(recipe, self.drawn, fitted)
        varied = {**recipe.draw, **recipe.sweep}
        self._also = {key: item.also for key, item in varied.items() if item.also}
        self.combinations = math.prod(len(item.values) for item in self.listed)
        size = len(self.drawn)
        self.points = recipe.samples * (size + 2 if recipe.design == "saltelli" else 1)
        if not size and recipe.samples > 1 and not recipe.seeds:
            raise InputError(message("sampling.nothing_drawn"), **recipe.at("samples"))
        if recipe.design == "saltelli" and not size:
            raise InputError(message("sampling.saltelli_without_draws"), **recipe.at("design"))

    @property
    def size(self) -> int:
        """How many samples there are."""
        return self.combinations * self.points

    @cached_property
    def columns(self) -> tuple[Column, ...]:
        """The inputs, in the order of a sample's."""
        listed = [_column(item) for item in self.listed]
        drawn = [
            Column(item.key, "" if item.relative else item.unit, False, "draw")
            for item in self.drawn
        ]
        return (*listed, *drawn, *(Column(key, varied="seed") for key in self.recipe.seeds))

    @cached_property
    def _normal(self) -> np.ndarray | None:
        """Standard normal points (points, drawn); None for a random design, drawn one by one."""
        if self.recipe.design == "random" or not self.drawn:
            return None
        import warnings

        from scipy.special import ndtri
        from scipy.stats import qmc

        size, rng = len(self.drawn), np.random.default_rng(self.recipe.seed)
        paired = self.recipe.design == "saltelli"
        if self.recipe.design == "latin_hypercube":
            sampler: Any = qmc.LatinHypercube(size, rng=rng)
        else:
            sampler = qmc.Sobol(size * (1 + paired), rng=rng)
        with warnings.catch_warnings():  # the balance of a number that is no power of two
            warnings.simplefilter("ignore")
            u = sampler.random(self.recipe.samples)
        if paired:
            a, b = u[:, :size], u[:, size:]
            mixed = [np.where(np.arange(size) == j, b, a) for j in range(size)]
            u = np.concatenate([a, b, *mixed])
        smallest = np.finfo(float).epsneg  # a normal draw stays finite
        return ndtri(np.clip(u, smallest, 1.0 - smallest))

    def inputs(self, index: int) -> list[Any]:
        """A sample's inputs in the order of the columns: listed values, drawn numbers, seeds."""
        combination, point = divmod(index, self.points)
        values: list[Any] = []
        for item in reversed(self.listed):
            combination, at = divmod(combination, len(item.values))
            values.insert(0, item.values[at])
        if self.drawn:
            if self._normal is None:
                rng = np.random.default_rng([self.recipe.seed, point])
                z = rng.standard_normal(len(self.drawn))
            else:
                z = self._normal[point]
            z = self._root @ z
            values += [float(item.value(z[i])) for i, item in enumerate(self.drawn)]
        return values + [self.recipe.seed + point] * len(self.recipe.seeds)

    def settings(self, index: int) -> dict[str, Any]:
        """What a sample sets, by column: as a recipe would have it; factors as `Factor`."""
        typed: dict[str, Any] = {}
        for column, value in zip(self.columns, self.inputs(index), strict=True):
            typed |= self._typed(column, value)
        return typed

    def quantile(self, item: Drawn, share: float) -> dict[str, Any]:
        """What a sample sets below which a ``share``, between 0 and 1, of a draw lies."""
        from scipy.special import ndtri

        column = next(column for column in self.columns if column.key == item.key)
        return self._typed(column, float(item.value(ndtri(share))))

    def _typed(self, column: Column, value: Any) -> dict[str, Any]:
        """An input as a recipe would have it, by its key and those that get the same."""
        if any(item.key == column.key and item.relative for item in (*self.listed, *self.drawn)):
            value = Factor(float(value))
        elif column.varied == "draw" and column.unit:
            value = f"{value!r} {column.unit}"
        return dict.fromkeys((column.key, *self._also.get(column.key, ())), value)

    def cells(self, inputs: Sequence[Any]) -> list[float | str]:
        """A sample's inputs as cells of a table: numbers in the columns' units, or texts."""
        return [cell(value, column) for value, column in zip(inputs, self.columns, strict=True)]


class Factor(float):
    """A number by which what the rig or recipe has is multiplied."""


def cell(value: Any, column: Column) -> float | str:
    """An input as a cell of a table."""
    if column.is_text:
        return label_of(value)
    return split_number(value)[0] if isinstance(value, str) else float(value)


def label_of(value: Any) -> str:
    """A value of a recipe as people tell it from others."""
    if isinstance(value, Mapping):
        return str(value.get("name") or value.get("kind") or shortened(dict(value), 60))
    if isinstance(value, list | tuple):
        return " + ".join(label_of(item) for item in value)
    return str(value)


def _listed(recipe: StudyRecipe) -> list[Listed]:
    """What goes through values, in the order of the file."""
    results = []
    if len(recipe.recipe) > 1:
        results.append(Listed(RECIPE, recipe.recipe))
    if recipe.case:
        results.append(Listed(CASE, tuple(case.name for case in recipe.case)))
    for key, span in recipe.sweep.items():
        if span.values:
            results.append(Listed(key, span.values, span.relative))
        elif span.count is not None:
            first, second, unit = _pair(recipe, ("sweep", key), span.low, span.high)
            whole = isinstance(span.low, int) and isinstance(span.high, int)
            numbers = (np.geomspace if span.log else np.linspace)(first, second, span.count)
            values = [
                int(number)
                if whole and number.is_integer()
                else (f"{number!r} {unit}" if unit else number)
                for number in numbers.tolist()
            ]
            results.append(Listed(key, tuple(values), span.relative))
    return results


def _drawn(
    recipe: StudyRecipe, where: tuple[str, str], law: str, ends: Sequence[Any], relative: bool
) -> Drawn:
    """What is drawn between or about two numbers; refuses those of no law."""
    first, second, unit = _pair(recipe, where, *ends, law=law)
    item = Drawn(where[1], law, first, second, unit, relative)
    valid = {
        "uniform": item.first <= item.second,
        "log_uniform": 0.0 < item.first <= item.second,
        "normal": item.second >= 0.0,
        "log_normal": item.first > 0.0 and item.second >= 1.0,
    }[item.law]
    if not valid:
        numbers = {"law": item.law, "first": item.first, "second": item.second}
        raise InputError(message("sampling.bad_law", key=item.key, **numbers), **recipe.at(*where))
    return item


def _pair(
    recipe: StudyRecipe, where: tuple[str, str], first: Any, second: Any, law: str = "uniform"
) -> tuple[float, float, str]:
    """(two numbers, their unit) of a law."""
    try:
        (a, unit), (b, other) = (
            split_number(item) if isinstance(item, str) else (float(item), "")
            for item in (first, second)
        )
    except UnitError as error:
        raise InputError(f"{where[1]}: {error.message}", **recipe.at(*where)) from None
    if law == "log_normal":
        return a, b, unit
    if law == "normal" and other == "%" != unit:
        return a, abs(a) * b / 100.0, unit
    if unit != other:
        text = message("sampling.units_differ", key=where[1], first=first, second=second)
        raise InputError(text, **recipe.at(*where))
    return a, b, unit


def _column(item: Listed) -> Column:
    """A column of listed values: of numbers where all have the same unit."""
    units = set()
    for value in item.values:
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            return Column(item.key, is_text=True)
        try:
            units.add(split_number(value)[1] if isinstance(value, str) else "")
        except UnitError:
            return Column(item.key, is_text=True)
    if len(units) > 1 or item.key in (CASE, RECIPE):
        return Column(item.key, is_text=True)
    return Column(item.key, units.pop())


def _root(recipe: StudyRecipe, drawn: Sequence[Drawn], fitted: Fitted | None) -> np.ndarray:
    """The lower triangle that makes independent normal draws correlated, shape (drawn, drawn)."""
    matrix, keys = np.eye(len(drawn)), [item.key for item in drawn]
    if fitted is not None:
        n = len(fitted.drawn)
        matrix[:n, :n] = fitted.correlation
    for index, (first, second, share) in enumerate(recipe.correlation):
        for key in (first, second):
            if key not in keys:
                text = message("sampling.not_drawn", key=key, drawn=", ".join(keys) or "none")
                raise InputError(text, **recipe.at("correlation", index))
        i, j = keys.index(first), keys.index(second)
        matrix[i, j] = matrix[j, i] = share
    if recipe.design == "saltelli" and not np.array_equal(matrix, np.eye(len(drawn))):
        raise InputError(message("sampling.saltelli_correlated"), **recipe.at("design"))
    values, vectors = np.linalg.eigh(matrix)
    if not np.all(np.abs(matrix) <= 1.0 + 1e-9) or values.min(initial=1.0) < -1e-8:
        raise InputError(message("sampling.no_correlation"), **recipe.at("correlation"))
    lifted = (vectors * np.maximum(values, 1e-14)) @ vectors.T
    return np.linalg.cholesky(lifted)
