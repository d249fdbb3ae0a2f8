"""Versions of results. A stored run stays valid while the schema of its stage and the versions of
the methods that produced it are current.

Raise the number of a method when its results change, and the schema of a stage when the files that
it writes change their form. `tests/unit/test_versions.py` fails when results change without it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

METHODS: Mapping[str, int] = {
    "logs": 7,  # reading of logs and files, gaps, sensor terms, initial states
    "plant": 5,  # equations of the plant, its parts and their integration
    "bench": 2,  # virtual bench: delays, noise, quantisation
    "flow_maps": 12,
    "output_error": 19,  # identification, its intervals, what `--suggest` and profiles tell
    "log_decrement": 2,  # identification by frequency and decay
    "frequency_response": 5,
    "diagnosis": 18,
    "validation": 15,
    "control": 4,  # controllers and their monitor
    "tuning": 6,
    "trial": 3,  # the loop and what is measured of it
    "ledger": 4,
    "sampling": 2,  # designs of studies and their statistics
}

_SIMULATED = ("logs", "plant")
_TRIAL = (*_SIMULATED, "bench", "control", "trial", "ledger")
# by stage: its schema and the methods that it uses
STAGES: Mapping[str, tuple[int, tuple[str, ...]]] = {
    "flow_map": (3, (*_SIMULATED, "flow_maps")),
    "hydraulics": (4, (*_SIMULATED, "output_error", "log_decrement", "frequency_response")),
    "profile": (1, (*_SIMULATED, "output_error")),
    "response": (4, (*_SIMULATED, "frequency_response")),
    "validation": (7, (*_SIMULATED, "diagnosis", "validation")),
    "tuning": (1, ("plant", "control", "tuning")),
    "arc_tuning": (3, ("plant", "control", "tuning")),
    "trial": (3, _TRIAL),
    "trials": (2, _TRIAL),
    "study": (2, ("sampling",)),
    "export": (2, ("plant", "control", "trial")),
    "report": (1, ()),
}


@dataclass(frozen=True)
class Versions:
    """The schema of a run's files and the methods that produced them, each with its version."""

    schema: int = 0
    methods: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, stage: str, further: Iterable[Versions] = ()) -> Versions:
        """The current ones of a stage.

        Args:
            stage: its name.
            further: of the stages that this one runs itself.
        """
        schema, names = STAGES.get(stage, (0, ()))
        methods = {name: METHODS[name] for name in names}
        for item in further:
            methods |= item.methods
        return cls(schema, dict(sorted(methods.items())))

    def __str__(self) -> str:
        return ", ".join(f"{name} {number}" for name, number in self.rows())

    def rows(self) -> Iterator[tuple[str, int]]:
        """(name, version) of the schema and of each method."""
        yield "schema", self.schema
        yield from self.methods.items()


def read_versions(facts: Mapping[str, Any]) -> Versions:
    """What a ``run.json`` says of its versions; of one that says nothing, schema 0."""
    return Versions(facts.get("schema", 0), dict(facts.get("methods", {})))


def outdated(facts: Mapping[str, Any]) -> list[str]:
    """What is not current in a run, as ``plant 1, now 2``; nothing without a schema."""
    run = read_versions(facts)
    now = Versions.of(str(facts.get("what") or facts["stage"]))
    current = {"schema": now.schema, **now.methods}
    current |= {name: METHODS.get(name, 0) for name in run.methods}
    before = dict(run.rows())
    return [
        f"{name} {before.get(name, 0)}, now {number}"
        for name, number in current.items()
        if before.get(name, 0) != number
    ]
