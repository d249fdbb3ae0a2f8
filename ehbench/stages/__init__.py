"""The stages, one file each; a run, a check and the command line look them up by `stage_of`."""

from ehbench.stages.base import STAGES, Stage, stage_of

__all__ = ["STAGES", "Stage", "stage_of"]
