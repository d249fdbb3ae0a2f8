"""Rigs and recipes from TOML, one file a kind of recipe."""

from ehbench.config.recipe.base import DataFile, Recipe
from ehbench.config.recipe.bench import BenchRecipe, DatasetLog, DatasetRecipe, Flowmeter
from ehbench.config.recipe.campaign import Campaign
from ehbench.config.recipe.columns import ColumnMap, MappedColumn, load_columns, whole_map
from ehbench.config.recipe.export import ExportRecipe
from ehbench.config.recipe.identify import FlowMapRecipe, HydraulicsRecipe
from ehbench.config.recipe.loading import kind_of, load_recipe, load_rig, recipe_kinds
from ehbench.config.recipe.response import ResponseRecipe
from ehbench.config.recipe.sensor import Sensor
from ehbench.config.recipe.study import Measure, StudyRecipe
from ehbench.config.recipe.toml import read_toml, validated
from ehbench.config.recipe.trial import (
    AnyTrial,
    Command,
    CylinderMotion,
    Fault,
    Limits,
    MachineChange,
    Motion,
    TrialRecipe,
    TrialSetRecipe,
)
from ehbench.config.recipe.tune import AnyTuning, ArcTuneRecipe, TuneRecipe
from ehbench.config.recipe.validate import Thresholds, ValidateRecipe
