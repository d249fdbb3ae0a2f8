"""Several cylinders at once: the motion of each, as long as the longest, and what each law is told
of the others'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ehbench.control.coupling import among_others, joint_motion
from ehbench.control.registry import LAWS
from ehbench.control.trajectory import ORDERS, X
from ehbench.parts.cylinder import joint_of
from ehbench.recipe import TrialRecipe
from ehbench.trial.controllers import Design, controller_of
from ehbench.trial.motion import References


@dataclass(frozen=True)
class Driven:
    """A cylinder that a controller moves: the trial as it would be for it alone, its design, and
    what it shall do.
    """

    recipe: TrialRecipe
    design: Design
    references: References

    @property
    def cylinder(self) -> str:
        """Its name."""
        return self.design.cylinder


def as_long(motions: Sequence[References]) -> list[References]:
    """Motions that all last as long as the longest: the others stand where they end."""
    count = max(len(one.table) for one in motions)
    longer = []
    for one in motions:
        still = np.zeros((count - len(one.table), ORDERS))
        still[:, X] = one.table[-1, X]
        longer.append(replace(one, table=np.ascontiguousarray(np.concatenate([one.table, still]))))
    return longer


def told(driven: Sequence[Driven]) -> list[np.ndarray]:
    """The table that each law runs over: its own motion and, for a law that counts on the others',
    that of all joints behind it.
    """
    tables = [one.references.table for one in driven]
    if len(driven) == 1:
        return tables
    design = driven[0].design
    joints = np.zeros((3, len(tables[0]), design.q.size))
    for one, table in zip(driven, tables, strict=True):
        row = one.design.row
        moved = joint_motion(row, joint_of(row, table[:, X]), table)
        joints[:, :, int(row.joint)] = moved.T
    widened = []
    for one, table in zip(driven, tables, strict=True):
        chosen = controller_of(one.recipe)
        ahead = 0.0 if chosen.kind is None else LAWS[chosen.kind].ahead
        coupled = chosen.coupling and ahead > 0.0
        widened.append(among_others(table, joints, ahead) if coupled else table)
    return widened
