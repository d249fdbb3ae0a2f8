"""Rigs and recipes from TOML, one file a kind of recipe."""

from ehbench.config.recipe.base import ByParameter, DataFile, DataFiles, Recipe
from ehbench.config.recipe.bench import (
    BenchCurve,
    BenchCylinder,
    BenchEdge,
    BenchRecipe,
    BenchSensors,
    BenchValve,
    DatasetLog,
    DatasetRecipe,
    Flowmeter,
)
from ehbench.config.recipe.campaign import Campaign, TextSection
from ehbench.config.recipe.columns import (
    AnyColumns,
    ColumnMap,
    Columns,
    MappedColumn,
    load_columns,
    whole_map,
)
from ehbench.config.recipe.export import ExportRecipe
from ehbench.config.recipe.identify import CalibrationPoint, FlowMapRecipe, HydraulicsRecipe
from ehbench.config.recipe.loading import kind_of, load_recipe, load_rig, recipe_kinds
from ehbench.config.recipe.response import ResponseRecipe
from ehbench.config.recipe.sensor import Sensor
from ehbench.config.recipe.study import Measure, Span, Spread, StudyRecipe, Target
from ehbench.config.recipe.toml import line_of, read_toml, validated
from ehbench.config.recipe.trial import (
    AnyTrial,
    Command,
    Controller,
    CylinderMotion,
    Fault,
    Limits,
    MachineChange,
    Motion,
    SetController,
    TrialRecipe,
    TrialSetRecipe,
)
from ehbench.config.recipe.tune import AnyTuning, ArcTuneRecipe, TuneRecipe
from ehbench.config.recipe.validate import JudgedFile, Thresholds, ValidateRecipe
