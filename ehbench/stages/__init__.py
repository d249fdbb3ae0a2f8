"""The stages, one file each; a run, a check and the command line look them up in `REGISTRY`."""

from ehbench.stages.base import REGISTRY, Checked, Stage, stage_of
from ehbench.stages.bench import BenchFile, Dataset
from ehbench.stages.campaign import CampaignStage
from ehbench.stages.export import ExportStage
from ehbench.stages.flow_map import FlowMapStage
from ehbench.stages.hydraulics import HydraulicsStage
from ehbench.stages.response import ResponseStage
from ehbench.stages.study import StudyStage
from ehbench.stages.trial import TrialStage
from ehbench.stages.trials import TrialsStage
from ehbench.stages.tuning import ArcTuningStage, TuningStage
from ehbench.stages.validation import ValidationStage

__all__ = ["REGISTRY", "Checked", "Stage", "stage_of"]
REGISTRY.update(
    (stage.recipe.kind(), stage)
    for stage in (  # in the order of the data
        FlowMapStage(),
        HydraulicsStage(),
        ResponseStage(),
        ValidationStage(),
        TuningStage(),
        ArcTuningStage(),
        TrialStage(),
        TrialsStage(),
        StudyStage(),
        ExportStage(),
        CampaignStage(),
        BenchFile(),
        Dataset(),
    )
)
