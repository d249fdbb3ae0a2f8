"""What the samples of a study say together, as ``study.json`` states it."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from functools import cached_property
from typing import Any

import numpy as np

from ehbench.config.recipe import StudyRecipe
from ehbench.sampling import statistics
from ehbench.sampling.design import Design, label_of
from ehbench.sampling.outputs import MeasureColumn, Rows
from ehbench.sampling.sample import STATUS, WHOLE
from ehbench.vocabulary import InputError, message


@dataclass(frozen=True)
class Summary:
    """The samples of a study with what it asks of them; numbers in the columns' units."""

    recipe: StudyRecipe
    design: Design
    measures: tuple[MeasureColumn, ...]
    targets: Sequence[Mapping[str, Any]]
    rows: Rows

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        size = self.rows.codes.size
        return {
            "inputs": list(self._inputs()),
            "measures": [self._measure(index) for index in range(len(self.measures))],
            "targets": [
                {**target, **statistics.share(int(met.sum()), size, self._alike)._asdict()}
                for target, met in zip(self.targets, self._met, strict=True)
            ],
            "groups": self._groups(),
            "sensitivity": list(self._sensitivity()),
        }

    def row(self, index: int) -> dict[str, Any]:
        """What a sample set, what became of it, and its measures."""
        return {
            "status": self.rows.status[index],
            "inputs": self.design.cells(self.design.inputs(index)),
            "measures": self.rows.measures[index].tolist(),
        }

    def worst(self) -> list[int]:
        """The samples to retain: the worst by the measure that decides, and the first of each
        status without an end.

        Raises:
            InputError: no such measure."""
        recipe = self.recipe
        names = [column.name for column in self.measures]
        first = self.targets[0]["measure"] if self.targets else names[0]
        name = recipe.worst or first
        if name not in names:
            near = get_close_matches(name, names, 1, 0.3) or names
            text = message("sampling.no_measure", name=name, near=", ".join(near))
            raise InputError(text, **recipe.at("worst"))
        low = any(
            t["measure"] == name and "at_least" in t and "at_most" not in t for t in self.targets
        )
        y = self._values(names.index(name))
        order = np.argsort(y if low else -y, kind="stable")
        picked = [int(i) for i in order[: recipe.keep] if np.isfinite(y[i])]
        for status in (STATUS[5], STATUS[2], STATUS[1]):
            if recipe.keep and status in self.rows.status:
                index = self.rows.status.index(status)
                picked += [index] if index not in picked else []
        return picked

    def _values(self, index: int) -> np.ndarray:
        """A measure of each sample; nan where it lacks, or of a sample without an end."""
        whole = np.isin(self.rows.codes, WHOLE) | self.measures[index].of_stops
        y = self.rows.measures[:, index]
        return np.where(np.isfinite(y) & whole, y, np.nan)

    @property
    def _alike(self) -> float:
        """Samples to each that is drawn by itself: all combinations have the same points."""
        drawn = self.recipe.samples * (2 if self.recipe.design == "saltelli" else 1)
        return self.design.size / drawn

    @cached_property
    def _met(self) -> list[np.ndarray]:
        """Of each target, the samples that meet it; one without the measure does not."""
        names = [column.name for column in self.measures]
        results = []
        for target in self.targets:
            y = self._values(names.index(target["measure"]))
            upper, lower = target.get("at_most", math.inf), target.get("at_least", -math.inf)
            results.append((y <= upper) & (y >= lower))
        return results

    def _inputs(self) -> Iterator[dict[str, Any]]:
        """Of each input: its column, how it is varied, whether its numbers are factors."""
        design = self.design
        listed = {item.key: [label_of(value) for value in item.values] for item in design.listed}
        laws = {item.key: item.text for item in design.drawn}
        factors = {item.key for item in (*design.listed, *design.drawn) if item.relative}
        for column in design.columns:
            key = column.key
            about = {"values": listed.get(key, []), "law": laws.get(key, "")}
            yield asdict(column) | about | {"factor": key in factors}

    def _measure(self, index: int) -> dict[str, Any]:
        """How many samples have a measure, its mean, spread, ends, quantiles with limits."""
        column, y = self.measures[index], self._values(index)
        y = y[np.isfinite(y)]
        about = {"name": column.name, "unit": column.unit, "samples": int(y.size)}
        if y.size:
            off = y - y[0]  # the spread of equal numbers is none, not their rounding
            about |= {"mean": y[0] + off.mean(), "std": off.std(ddof=1) if y.size > 1 else None}
            about |= {"minimum": y.min(), "maximum": y.max()}
            about["quantiles"] = [
                statistics.quantile(y, share, self._alike)._asdict()
                for share in statistics.QUANTILES
            ]
        return about

    def _groups(self) -> list[dict[str, Any]]:
        """Medians, quantiles and shares of each combination; none for one, or too many to read."""
        design = self.design
        if not 1 < design.combinations <= 400:  # a table of more is not read
            return []
        keys, results = [item.key for item in design.listed], []
        alike = self._alike / design.combinations
        values = [self._values(index) for index in range(len(self.measures))]
        for first in range(0, design.size, design.points):
            span, inputs = slice(first, first + design.points), design.inputs(first)
            measures = []
            for y in (y[span][np.isfinite(y[span])] for y in values):
                about: dict[str, Any] = {"samples": int(y.size)}
                about |= dict.fromkeys(("mean", "median", "q95", "maximum"))
                if y.size:
                    median, upper = np.quantile(y, (0.5, 0.95)).tolist()
                    about |= {"mean": float(y.mean()), "median": median, "q95": upper}
                    about["maximum"] = float(y.max())
                measures.append(about)
            results.append(
                {
                    "values": dict(zip(keys, map(label_of, inputs[: len(keys)]), strict=True)),
                    "cells": design.cells(inputs)[: len(keys)],
                    "samples": design.points,
                    "whole": int(np.isin(self.rows.codes[span], WHOLE).sum()),
                    "measures": measures,
                    "targets": [
                        statistics.share(int(met[span].sum()), design.points, alike)._asdict()
                        for met in self._met
                    ],
                }
            )
        return results

    def _sensitivity(self) -> Iterator[dict[str, Any]]:
        """Of each measure, how much each input moves it."""
        design, recipe, x = self.design, self.recipe, self.rows.inputs
        varied = [
            i
            for i, item in enumerate(design.columns)
            if item.varied != "seed" and np.ptp(x[:, i]) > 0.0
        ]
        keys = [design.columns[i].key for i in varied]
        for index, column in enumerate(self.measures):
            values = self._values(index)
            counts = np.isfinite(values)
            y = values[counts]
            if not keys or y.size < 10 or np.ptp(y) == 0.0:
                continue
            if recipe.design == "saltelli" and design.combinations == 1 and counts.all():
                drawn = [item.key for item in design.drawn]
                table = statistics.sobol(drawn, y, recipe.samples, recipe.seed)
                explained, method = None, "sobol"
            else:
                columns = [
                    statistics.scores(x[counts, i], y)
                    if design.columns[i].is_text
                    else x[counts, i]
                    for i in varied
                ]
                table, explained = statistics.rank_regression(keys, np.stack(columns, axis=1), y)
                method = "rank"
            inputs = [item._asdict() for item in table]
            about = {"measure": column.name, "method": method, "explained": explained}
            yield about | {"inputs": inputs}
