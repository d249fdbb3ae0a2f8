"""Rigs and recipes from TOML, one file a kind of recipe."""

from __future__ import annotations

from ehbench.recipe.base import ByParameter, DataFile, DataFiles, Recipe
from ehbench.recipe.bench import (
    BenchCurve,
    BenchCylinder,
    BenchEdge,
    BenchRecipe,
    BenchSensors,
    BenchValve,
)
from ehbench.recipe.campaign import Campaign, TextSection
from ehbench.recipe.columns import (
    AnyColumns,
    ColumnMap,
    Columns,
    MappedColumn,
    load_columns,
    whole_map,
)
from ehbench.recipe.dataset import DatasetLog, DatasetRecipe, Flowmeter
from ehbench.recipe.flow_map import CalibrationPoint, FlowMapRecipe
from ehbench.recipe.hydraulics import HydraulicsRecipe
from ehbench.recipe.loading import kind_of, load_recipe, load_rig, recipe_kinds
from ehbench.recipe.sensor import Sensor
from ehbench.recipe.study import Measure, Span, Spread, StudyRecipe, Target
from ehbench.recipe.toml import line_of, read_toml, validated
from ehbench.recipe.trial import (
    AnyTrial,
    Command,
    Controller,
    CylinderMotion,
    Limits,
    MachineChange,
    Motion,
    TrialRecipe,
)
from ehbench.recipe.trials import SetController, TrialSetRecipe
from ehbench.recipe.tune import AnyTuning, ArcTuneRecipe, TuneRecipe
from ehbench.recipe.validate import JudgedFile, Thresholds, ValidateRecipe

__all__ = [
    "AnyColumns",
    "ColumnMap",
    "Columns",
    "MappedColumn",
    "load_columns",
    "whole_map",
    "AnyTrial",
    "AnyTuning",
    "ArcTuneRecipe",
    "BenchCurve",
    "BenchCylinder",
    "BenchEdge",
    "BenchRecipe",
    "BenchSensors",
    "BenchValve",
    "ByParameter",
    "CalibrationPoint",
    "Campaign",
    "Command",
    "Controller",
    "CylinderMotion",
    "DataFile",
    "DataFiles",
    "DatasetLog",
    "DatasetRecipe",
    "FlowMapRecipe",
    "Flowmeter",
    "HydraulicsRecipe",
    "JudgedFile",
    "Measure",
    "Limits",
    "MachineChange",
    "Motion",
    "Recipe",
    "Sensor",
    "SetController",
    "Span",
    "Spread",
    "StudyRecipe",
    "Target",
    "TextSection",
    "Thresholds",
    "TrialRecipe",
    "TrialSetRecipe",
    "TuneRecipe",
    "ValidateRecipe",
    "kind_of",
    "line_of",
    "load_recipe",
    "load_rig",
    "read_toml",
    "recipe_kinds",
    "validated",
]
