"""One trial run with several seeds of the sensors' noise: the medians of its measures, and their
ranges.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ehbench.trial.running import Facts

# measures that noise moves; the others are what the controller was made of
_MOVED = ("steps", "tracking", "tracking_true", "tip", "speed_rms_error", "energy", "limits")


def middle_of(runs: Sequence[Facts]) -> int:
    """The first run that a limit stopped; else that of the median largest error, the lower one of
    two.
    """
    for index, facts in enumerate(runs):
        if facts.stopped:
            return index
    errors = [facts.measures["tracking"]["max_error"] for facts in runs]
    return int(np.argsort(errors, kind="stable")[(len(runs) - 1) // 2])


def over_runs(runs: Sequence[Facts], middle: int) -> Facts:
    """The facts of the ``middle`` run, with the measures of all that came to their end.

    A number is the median of the runs that have it, None where most have not; ``range`` has the
    least and the largest of each, ``seeds`` says how many runs there are. ``limit_cycle`` is the
    worst of all, and what is warned of it. A run that a limit stopped stands for itself."""
    retained = runs[middle]
    if retained.stopped:
        return replace(retained, warnings=(*retained.warnings, _stopped(runs)))
    results = [facts.measures for facts in runs]
    moved = [{name: item[name] for name in _MOVED if name in item} for item in results]
    of_all = _joined(moved, middle, _median)
    worst = max(runs, key=lambda entry: (entry.measures["limit_cycle"] or {}).get("amplitude", 0.0))
    measures = retained.measures | of_all | {"limit_cycle": worst.measures["limit_cycle"]}
    measures |= {"range": _joined(moved, middle, _ends), "seeds": len(runs)}
    return replace(retained, measures=measures, warnings=worst.warnings or retained.warnings)


def _stopped(runs: Sequence[Facts]) -> str:
    count = sum(1 for run in runs if run.stopped)
    return f"a limit stopped {count} of {len(runs)} runs; the numbers are of the first of them"


def _joined(trees: Sequence[Any], middle: int, fold: Callable[[list[float]], Any]) -> Any:
    """One tree of as many, each number the ``fold`` of theirs; texts and lists of unequal length
    are those of the middle one.
    """
    own = trees[middle]
    if isinstance(own, dict):
        return {name: _joined([tree.get(name) for tree in trees], middle, fold) for name in own}
    if isinstance(own, list):
        same = [tree for tree in trees if len(tree) == len(own)]
        at = next(i for i, item in enumerate(same) if item is own)
        return [_joined([item[i] for item in same], at, fold) for i in range(len(own))]
    known = [float(tree) for tree in trees if isinstance(tree, int | float)]
    if isinstance(own, str) or not known:
        return own
    return fold(known) if 2 * len(known) > len(trees) else None


def _median(values: list[float]) -> float:
    return float(np.median(values))


def _ends(values: list[float]) -> list[float]:
    return [min(values), max(values)]
