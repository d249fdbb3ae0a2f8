"""What is exported, and what a format leaves of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ehbench.config.recipe import ExportRecipe
from ehbench.config.rig import Rig
from ehbench.export.component import distinct
from ehbench.vocabulary import Z95
from ehbench.vocabulary.errors import one_line

if TYPE_CHECKING:
    from ehbench.export.component import Component
    from ehbench.export.kernels import Kernels
    from ehbench.plant.build import Maps
    from ehbench.trial import Prepared


class Written(NamedTuple):
    """A file or folder that a format wrote, by its name in the run folder.

    ``about`` what it is, ``check`` how it was checked on this machine, ``note`` what the user
    should know of it."""

    file: str
    about: str
    check: str = ""
    note: str = ""


@dataclass(frozen=True)
class Export:
    """What is exported.

    Attributes:
        recipe: what to export, and how.
        rig: without payload.
        maps: its measured flow maps.
        origin: file or run folder that the rig is from.
        trial: that the exported parts are of, and are checked by.
        fitted: what identification says of some parameters, rows of ``parameters.json`` by name."""

    recipe: ExportRecipe
    rig: Rig
    maps: Maps | None
    origin: Path
    trial: Prepared
    fitted: Mapping[str, Mapping[str, Any]]

    @property
    def about(self) -> dict[str, str]:
        """Source and 95 % interval of each parameter, in words."""
        about = {}
        for name, value in self.rig.parameters().items():
            interval = self.fitted.get(name, {}).get("interval")
            if interval is None and value.std:
                half = Z95 * value.std
                interval = [float(value) - half, float(value) + half]
            about[name] = one_line(value.source or value.sure)
            if interval:
                about[name] += "; 95 % interval {:.6g} to {:.6g}".format(*interval)
        return about

    @cached_property
    def components(self) -> tuple[Component, ...]:
        """The parts as compiled code; the trial is run."""
        from ehbench.export.parts import controller_part, model_part, valves_part
        from ehbench.trial import Session

        trial, loop = self.trial, self.trial.loop
        session = Session(trial, trial.machine)
        session.run()
        parts, contents = [], self.recipe.parts or ("model" if loop is None else "both")
        if contents != "controller":
            parts.append(model_part(trial, session, self.about))
        if contents != "model" and loop is not None:
            for law, item in zip(loop.laws, loop.driven, strict=False):
                parts.append(controller_part(trial, session, law, item.design))
                parts.append(valves_part(trial, item.design))
        names = distinct(part.name for part in parts)
        return tuple(replace(part, name=name) for part, name in zip(parts, names, strict=True))

    @cached_property
    def kernels(self) -> list[Kernels]:
        """The C text of each part's kernel."""
        from ehbench.export.kernels import kernels_of

        return kernels_of(self.components)


# writes an export into a folder
Writer = Callable[[Export, Path], list[Written]]
