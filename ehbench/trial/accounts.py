"""Where a trial's energy went, by the ledger alone: a trial's numbers are those of its ledger."""

from __future__ import annotations

from contextlib import suppress
from typing import Any, NamedTuple

from ehbench.ledger import Accuracy, Ledger, bounds, ledger_of_log, ledger_of_model
from ehbench.trial.preparation import Prepared
from ehbench.trial.running import Facts, Result
from ehbench.vocabulary.errors import EhbenchError, InsufficientData

MODEL = "edge flows of the model"
LOG = "estimated: measured pressures and commands through the design model's maps"


class Account(NamedTuple):
    """A trial's facts with its energies, its ledger with its bounds as plain values, and why there
    is none.
    """

    facts: Facts
    ledger: dict[str, Any] | None
    doubts: tuple[str, ...] = ()


def account(prepared: Prepared, result: Result, sure: bool = True) -> Account:
    """The account of a trial: exact where the machine told its states, else as it was measured.

    ``sure`` asks for the intervals of what was measured, which take longer than the trial."""
    recipe, record, facts = prepared.recipe, result.record, result.facts
    if (cycle := facts.measures.get("cycle")) is not None:  # the last of several
        record = record.between(cycle["start"], cycle["stop"])
    try:
        if result.model is not None:
            ledger = ledger_of_model(result.model, record)
        else:
            accuracy = Accuracy() if sure else None
            ledger = ledger_of_log(
                prepared.rig, prepared.maps, record, payload=recipe.payload, accuracy=accuracy
            )
    except EhbenchError as error:
        return Account(facts, None, (f"no energy ledger: {error.message}",))
    limits = []
    if facts.cylinder:
        facts = facts.with_energy(
            {
                name: _energy(ledger, name) | {"supply": prepared.rig.supply.kind}
                for name in facts.cylinders
            }
        )
        with suppress(InsufficientData):  # it did not move, or its supply has not one pressure
            limits = [bounds(prepared.rig, record, facts.cylinder, ledger).as_json()]
    return Account(facts, ledger.as_json() | {"bounds": limits})


def _energy(ledger: Ledger, cylinder: str) -> dict[str, Any]:
    """Energies [J] of a trial under a controller, and the oil [m³] that all valves drew."""
    return {
        "pump": ledger.pump,
        **({} if ledger.low_rail is None else {"low_rail": ledger.low_rail}),
        "cylinder_work": ledger[f"{cylinder}.work"].energy,
        "oil_drawn": ledger.oil_drawn,
        "source": MODEL if ledger.source == "model" else LOG,
    }
