"""The recipe of a set of trials."""

from __future__ import annotations

from itertools import product
from typing import Annotated, Literal

from pydantic import Field, model_validator

from ehbench.config.recipe.base import ByParameter
from ehbench.config.recipe.trial import (
    AnyTrial,
    Controller,
    MachineChange,
    Motion,
    OtherSupply,
    TrialRecipe,
    refuse_unmatched,
)
from ehbench.vocabulary.messages import message


class SetController(Controller):
    """A controller of a set of trials; it may run on a rig of its own, such as the same machine
    with another valve, or one with other ``dynamics`` of its valves, or on a supply of its own.

    What was identified on the set's rig holds for that one as well, by name.
    """

    rig: str | None = None
    flow_maps: str | None = None
    bench: str | None = None
    dynamics: ByParameter = {}
    supply: OtherSupply | None = None


class TrialSetRecipe(AnyTrial):
    """The product of ``payloads`` (``none`` is none) × ``[[motion]]`` × ``[[machine]]`` ×
    ``[[controller]]``: one log each, and one table over all.
    """

    stage: Literal["trials"]
    payloads: Annotated[tuple[str, ...], Field(min_length=1)] = ("none",)
    seeds: int = Field(default=1, ge=1, le=1000)
    motion: Annotated[tuple[Motion, ...], Field(min_length=1)]
    machine: tuple[MachineChange, ...] = ()
    controller: Annotated[tuple[SetController, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _noise_differs(self) -> TrialSetRecipe:
        if self.seeds > 1 and self.on != "bench":
            raise ValueError(message("config.seeds_of_bench"))
        return self

    @model_validator(mode="after")
    def _names_differ(self) -> TrialSetRecipe:
        for what, names in (
            ("payload", list(self.payloads)),
            ("motion", [m.name or m.kind for m in self.motion]),
            ("machine", [m.name for m in self.machine]),
            ("controller", [c.label for c in self.controller]),
        ):
            twice = next((name for i, name in enumerate(names) if name in names[:i]), None)
            if twice is not None:
                raise ValueError(message("config.entry_twice", what=what, twice=twice))
        return self

    @model_validator(mode="after")
    def _nobody_waits(self) -> TrialSetRecipe:
        if any(i.kind == "operator" and not i.file for m in self.motion for i in m.each):
            raise ValueError(message("config.operator_of_set"))
        return self

    @model_validator(mode="after")
    def _controllers_fit(self) -> TrialSetRecipe:
        for law in self.controller:
            refuse_unmatched(law, self.motion)
        return self

    def cases(self) -> tuple[tuple[str, SetController, TrialRecipe], ...]:
        """(name, controller, recipe) of each trial, payloads outermost, controllers innermost."""
        shared = {name: getattr(self, name) for name in AnyTrial.model_fields if name != "path"}
        machines = [*enumerate(self.machine)] or [(0, None)]
        cases = []
        for payload, (m, motion), (n, machine), (c, law) in product(
            self.payloads, enumerate(self.motion), machines, enumerate(self.controller)
        ):
            message = motion.name or motion.kind
            if machine is not None:
                message = f"{message}, {machine.name}"
                machine = machine.model_copy(update={"where": ("machine", n)})
            name = " ".join([payload if payload != "none" else "no load", message, law.label])
            keys = ("rig", "flow_maps", "bench", "dynamics", "supply")
            machine_keys = {key: value for key in keys if (value := getattr(law, key))}
            case = TrialRecipe.model_construct(
                **{**shared, **machine_keys},
                stage="trial",
                payload=None if payload == "none" else payload,
                path=self.path,
                machine=machine,
                controller=law.model_copy(update={"where": ("controller", c)}),
                motion=motion.model_copy(update={"where": ("motion", m), "name": message}),
            )
            cases.append((name, law, case.model_copy(update={"title": name})))
        return tuple(cases)
