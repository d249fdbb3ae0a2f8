"""Payloads that change during a record: what is stored with each, and what goes with them."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np

from ehbench.data.record import Record, payloads_of
from ehbench.ledger.quadrature import stores_at
from ehbench.plant.build import Plant
from ehbench.plant.model import Model


@dataclass(frozen=True)
class Loads:
    """What a record says was carried: ``first``, then (time [s], payload) of each change."""

    first: str | None
    changes: tuple[tuple[float, str | None], ...]

    @classmethod
    def of(cls, record: Record, first: str | None = None) -> Self:
        """Those of a record; ``first`` instead of the one that it names first."""
        (_, message), *changes = payloads_of(record)
        return cls(first or message, tuple(changes))

    def spans(self, model: Model, t: np.ndarray) -> Iterator[tuple[slice, Plant]]:
        """Rows with one payload and its plant; each begins with the last row of the one before."""
        rows = [0, *(int(np.searchsorted(t, at - 1e-9)) for at, _ in self.changes), t.size - 1]
        payloads = [self.first, *(name for _, name in self.changes)]
        for first, last, payload in zip(rows, rows[1:], payloads, strict=False):
            links = model.links(payload) if self.changes else model.plant.links
            yield slice(first, last + 1), model.plant._replace(links=links)

    def stored(self, model: Model, t: np.ndarray, states: np.ndarray, columns: int) -> np.ndarray:
        """Stored energy [J] less the first, (samples, columns); last what went with payloads."""
        fixed = np.empty((t.size, columns))
        gone = np.zeros((t.size, 1))
        for n, (rows, plant) in enumerate(self.spans(model, t)):
            before = fixed[rows.start].sum() if n else 0.0
            stores_at(states[rows], plant, fixed[rows])
            if n:
                gone[rows.start :] += before - fixed[rows.start].sum()
        fixed -= fixed[0].copy()
        return np.concatenate([fixed, gone], axis=1) if self.changes else fixed
