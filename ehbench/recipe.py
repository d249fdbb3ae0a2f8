"""TOML in: rigs and recipes, with errors that name file, line, key, value and the nearest valid
key.

Paths in a recipe are relative to the recipe. A rig or a flow map may be named by a file, by a run
folder, or by the recipe that makes it: the workflow then makes it first if it is not there."""

from __future__ import annotations

import re
import tomllib
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    Field,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from ehbench.errors import InputError
from ehbench.quantities import VOCABULARY
from ehbench.rig import Model, Rig, Value, _typed, read_value

_HEADER = re.compile(r"\s*(\[\[?)\s*([^\]]+?)\s*\]\]?\s*(?:#.*)?$")
_KEY = re.compile(
    r"""\s*((?:[A-Za-z0-9_-]+|"[^"]*"|'[^']*')(?:\s*\.\s*(?:[A-Za-z0-9_-]+|"[^"]*"|'[^']*'))*)\s*="""
)


class DataFile(Model):
    """A log to use: its path, the payload carried (else what the log's own meta says), a window of
    its time, a note.
    """

    path: str
    payload: str | None = None
    start: _typed("start") | None = None
    stop: _typed("stop") | None = None
    note: str = ""


def _data_file(raw: Any) -> Any:
    return {"path": raw} if isinstance(raw, str) else raw


DataFiles = Annotated[
    tuple[Annotated[DataFile, BeforeValidator(_data_file)], ...], Field(min_length=1)
]


class Recipe(Model):
    """What every recipe has. ``path`` is the recipe's own file; names of other files are relative
    to it.
    """

    title: str = ""
    note: str = ""
    path: Path = Field(default=Path("recipe.toml"), exclude=True)

    @property
    def name(self) -> str:
        """The recipe's name: its file's stem."""
        return self.path.stem

    def file(self, name: str) -> Path:
        """A path of this recipe, as written in it, relative to its folder."""
        return (self.path.parent / name).resolve()

    def at(self, *location: str | int) -> dict[str, Any]:
        """``file`` and ``line`` of a key of this recipe, as the errors take them; no line where the
        file cannot say.
        """
        try:
            line = line_of(self.path.read_text(encoding="utf-8"), location)
        except OSError:
            line = None
        return {"file": self.path, "line": line}


def _flat(raw: Any) -> Any:
    """Tables within a table of parameters as dotted names, as unquoted keys such as
    ``boom.joint_damping`` make them.
    """
    if not isinstance(raw, dict):
        return raw
    found: dict[str, Any] = {}
    for name, value in raw.items():
        inner = (
            {f"{name}.{key}": item for key, item in _flat(value).items()}
            if isinstance(value, dict)
            else {name: value}
        )
        if twice := sorted(set(inner) & set(found)):
            raise ValueError(f"'{twice[0]}' is given twice")
        found |= inner
    return found


ByParameter = Annotated[dict[str, str], BeforeValidator(_flat)]


class CalibrationPoint(Model):
    """A flow that a command is supposed to give, e.g. 2 gpm at 4 V, to be met within ``tolerance``
    of that flow.
    """

    command: _typed("command")
    flow: _typed("flow")
    tolerance: float = Field(default=0.1, gt=0, lt=1)


class FlowMapRecipe(Recipe):
    """Flowmeter readings to flow maps.

    ``calibration`` is checked on every map at ``calibration_drop``. A flowmeter reading below
    ``meter_limit`` only says that the flow lies below it; readings of the method ``cylinder`` have
    no such limit."""

    stage: Literal["identify"]
    what: Literal["flow_map"]
    rig: str
    data: Annotated[tuple[str, ...], Field(min_length=1)]
    calibration: tuple[CalibrationPoint, ...] = ()
    calibration_drop: _typed("pressure_drop") | None = None
    meter_limit: _typed("meter_limit") = Value(0.0)


class HydraulicsRecipe(Recipe):
    """Step logs to bulk modulus, damping, friction and whatever else ``parameters`` names.

    ``compare_dynamics`` names valve dynamics of the rig file; the logs are fitted with each in
    turn, so that the data decide."""

    stage: Literal["identify"]
    what: Literal["hydraulics"]
    method: Literal["thesis", "output_error"] = "output_error"
    rig: str
    flow_maps: str | None = None
    data: DataFiles
    parameters: Annotated[tuple[str, ...], Field(min_length=1)]
    start: ByParameter = {}
    lower: ByParameter = {}
    upper: ByParameter = {}
    channels: tuple[str, ...] = ("qd", "p_head", "p_rod")
    cutoff: _typed("frequency") | None = None
    compare_dynamics: tuple[str, ...] = ()
    max_iterations: int = Field(default=30, ge=1, le=1000)
    workers: int = Field(default=0, ge=0, le=256)


def _share(raw: Any) -> Any:
    if raw is True:
        raise ValueError("a share of the recorded value such as 0.15, or false to ask for none")
    return None if raw is False else raw


_Share = Annotated[Annotated[float, Field(gt=0)] | None, BeforeValidator(_share)]


class Thresholds(Model):
    """What a model must reach on every held-out log to be accepted; a quantity not named is only
    reported.

    ``fit_percent`` is the least NRMSE fit by quantity (100 exact, 0 no better than the mean),
    ``max_error`` the largest error by quantity, with unit. ``natural_frequency_error`` and
    ``damping_ratio_error`` are shares of the recorded value; ``false`` asks for none. ``whiteness``
    and ``independence`` ask that at most ``outside_percent`` of the lags of the residual's
    autocorrelation, and of its correlation with earlier commands, lie outside of their 95 % bands.
    """

    fit_percent: dict[str, float] = {"qd": 50.0, "p_head": 30.0, "p_rod": 30.0}
    max_error: dict[str, Any] = {}
    natural_frequency_error: _Share = 0.15
    damping_ratio_error: _Share = None
    whiteness: bool = False
    independence: bool = False
    outside_percent: float = Field(default=15.0, gt=0, lt=100)

    @field_validator("fit_percent", "max_error")
    @classmethod
    def _quantities(cls, asked: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        for name, value in asked.items():
            if name not in VOCABULARY:
                near = get_close_matches(name, VOCABULARY, 1)
                raise ValueError(
                    f"no quantity '{name}'" + (f"; nearest is '{near[0]}'" if near else "")
                )
            if info.field_name == "fit_percent" and not value < 100.0:
                raise ValueError(f"{name} = {value:g} cannot be reached: 100 % is an exact match")
        if info.field_name == "fit_percent":
            return asked
        try:
            return {name: read_value(value, VOCABULARY[name]) for name, value in asked.items()}
        except InputError as error:
            raise ValueError(str(error)) from None


class ValidateRecipe(Recipe):
    """An identified rig against logs it was not fitted to."""

    stage: Literal["validate"]
    rig: str
    flow_maps: str | None = None
    data: DataFiles
    channels: tuple[str, ...] = ("q", "qd", "p_head", "p_rod")
    thresholds: Thresholds = Thresholds()


class Command(Model):
    """An open-loop command to one valve; several entries for one valve add up. ``valve`` is
    ``<cylinder>.<valve>``.

    kind ``constant``: ``offset``. ``step``: ``offset``, and ``offset + amplitude`` from ``start``
    to ``stop``. ``ramp``: linear from ``offset`` at ``start`` to ``offset + amplitude`` at
    ``stop``, which it keeps. ``sine``: ``amplitude`` at ``frequency`` about ``offset`` from
    ``start`` to ``stop``. ``multisine``: ``lines`` sines from ``frequency`` to ``frequency_max``
    with phases drawn from ``seed``, scaled to ``amplitude``. ``file``: plays the channel
    ``<valve>.command`` of a log from ``start`` on."""

    valve: str
    kind: Literal["constant", "step", "ramp", "sine", "multisine", "file"]
    offset: _typed("offset") = Value(0.0)
    amplitude: _typed("amplitude") = Value(0.0)
    start: _typed("start") = Value(0.0)
    stop: _typed("stop") | None = None
    frequency: _typed("frequency") | None = None
    frequency_max: _typed("frequency") | None = None
    lines: int = Field(default=20, ge=1, le=1000)
    seed: int = Field(default=0, ge=0)
    file: str | None = None

    @model_validator(mode="after")
    def _whole(self) -> Command:
        if self.kind in ("sine", "multisine") and self.frequency is None:
            raise ValueError(f"a {self.kind} needs 'frequency'")
        if self.kind in ("sine", "multisine") and not float(self.frequency) > 0.0:
            raise ValueError("'frequency' must be above 0 Hz")
        if self.kind == "multisine" and self.frequency_max is None:
            raise ValueError("a multisine needs 'frequency_max'")
        if self.kind == "multisine" and not float(self.frequency_max) > float(self.frequency):
            raise ValueError(
                f"frequency_max, {float(self.frequency_max):g} Hz, must lie above frequency, {float(self.frequency):g} Hz"
            )
        if self.kind == "ramp" and self.stop is None:
            raise ValueError("a ramp needs 'stop'")
        if self.kind == "file" and self.file is None:
            raise ValueError("a file command needs 'file'")
        return self


class Limits(Model):
    """Where a trial stops safely. Pressures are of every chamber; ``stroke_margin`` is kept at both
    ends of every stroke.
    """

    pressure_max: _typed("pressure") | None = None
    pressure_min: _typed("pressure") | None = None
    stroke_margin: _typed("stroke") | None = None
    speed_max: _typed("v") | None = None
    command_max: _typed("command_max") | None = None

    @field_validator("stroke_margin", mode="before")
    @classmethod
    def _margin(cls, raw: Any) -> Any:
        return raw


def _one_or_more(raw: Any) -> Any:
    return [raw] if isinstance(raw, str) else raw


class Motion(Model):
    """What the controlled cylinder shall do.

    kind ``velocity_steps``: each of ``levels`` (a share of the full speed such as ``"70 %"``, or a
    speed; negative retracts) for ``duration`` or until it has covered ``travel``, with a ``rest``
    before and after each; ``full_speed`` is the design model's where it is not given.
    ``point_to_point``: through ``waypoints`` (strokes, from the first of which it starts) with a
    ``hold`` at each, within ``speed``, ``acceleration`` and ``jerk``. ``file``: a log with
    ``<cylinder>.x_desired``. ``cylinder`` may be left out where there is one."""

    name: str = ""
    kind: Literal["velocity_steps", "point_to_point", "file"]
    cylinder: str | None = None
    levels: tuple[str, ...] = ()
    full_speed: _typed("speed") | None = None
    duration: _typed("duration") | None = None
    travel: _typed("x") | None = None
    rest: _typed("hold") | None = None
    waypoints: tuple[_typed("x"), ...] = ()
    hold: Annotated[tuple[_typed("hold"), ...], BeforeValidator(_one_or_more)] = ()
    speed: _typed("speed") | None = None
    acceleration: _typed("acceleration") | None = None
    jerk: _typed("jerk") | None = None
    profile: Literal["ramp", "seventh"] = "ramp"
    file: str | None = None
    where: tuple[str | int, ...] = Field(default=("motion",), exclude=True)

    @model_validator(mode="after")
    def _whole(self) -> Motion:
        if self.kind == "velocity_steps":
            if not self.levels:
                raise ValueError(
                    'velocity_steps need \'levels\', such as ["30 %", "70 %", "100 %"]'
                )
            if (self.duration is None) == (self.travel is None):
                raise ValueError("velocity_steps need 'duration' or 'travel', and not both")
        if self.kind == "point_to_point":
            if len(self.waypoints) < 2:
                raise ValueError("point_to_point needs 'waypoints', two strokes or more")
            if self.speed is None:
                raise ValueError("point_to_point needs 'speed'")
        if self.kind == "file" and self.file is None:
            raise ValueError("a motion of kind file needs 'file'")
        return self


class Controller(Model):
    """Who moves the cylinder: ``kind`` of a built-in law, or ``class = "module:Class"`` of the
    user's own.

    ``gains`` by name with units, or ``"<tune recipe or its run>"``, or both: ``{ from = "…",
    washout = "0 rad/s" }``; a class gets them as keywords. ``rules`` of function selection,
    ``shaping`` of speed steps (pressure feedback), ``unused`` valves that stay at rest."""

    name: str = ""
    kind: Literal["open_loop", "pressure_feedback", "arc"] | None = None
    code: str | None = Field(default=None, alias="class")
    gains: str | dict[str, Any] = {}
    rules: dict[str, Any] = {}
    shaping: dict[str, Any] = {}
    unused: tuple[str, ...] = ()
    where: tuple[str | int, ...] = Field(default=("controller",), exclude=True)

    @property
    def label(self) -> str:
        """Its name, else its kind or class."""
        return self.name or self.kind or (self.code or "").partition(":")[2]

    @model_validator(mode="after")
    def _one_law(self) -> Controller:
        if (self.kind is None) == (self.code is None):
            raise ValueError("give 'kind' or 'class', and not both")
        if self.shaping and self.kind not in ("open_loop", "pressure_feedback"):
            raise ValueError("'shaping' is of open_loop and pressure_feedback only")
        return self


def _sampled(trial: Any) -> Any:
    """Refuse sines that samples at the trial's rate cannot hold."""
    for command in trial.command:
        for key in ("frequency", "frequency_max"):
            asked = getattr(command, key)
            if (
                command.kind in ("sine", "multisine")
                and asked is not None
                and float(asked) >= 0.5 * float(trial.rate)
            ):
                raise ValueError(
                    f"command to {command.valve}: {key}, {float(asked):g} Hz, must lie below half the rate, {0.5 * float(trial.rate):g} Hz"
                )
    return trial


class _AnyTrial(Recipe):
    """What one trial and a set of trials have in common."""

    rig: str
    flow_maps: str | None = None
    on: Literal["model", "bench"] = "model"
    bench: str | None = None
    posture: dict[str, str] = {}
    duration: _typed("duration") | None = None
    rate: _typed("rate") = Value(1000.0)
    step: _typed("step") = Value(5.0e-4)
    seed: int = Field(default=0, ge=0)
    command: tuple[Command, ...] = ()
    limits: Limits = Limits()

    @model_validator(mode="after")
    def _below_half_the_rate(self) -> _AnyTrial:
        return _sampled(self)


class TrialRecipe(_AnyTrial):
    """One trial on the model or on the virtual bench: open-loop ``command``, or a ``controller``
    and the ``motion`` it shall make.

    Under a controller ``duration`` may be left out: it is then that of the motion; other cylinders
    may take open-loop commands."""

    stage: Literal["trial"]
    payload: str | None = None
    controller: Controller | None = None
    motion: Motion | None = None

    @model_validator(mode="after")
    def _whole(self) -> TrialRecipe:
        if self.controller is None and self.motion is not None:
            raise ValueError("a motion needs a [controller] that makes it")
        if self.controller is not None and self.motion is None and self.controller.code is None:
            raise ValueError(f"controller '{self.controller.label}' needs a [motion]")
        if self.motion is None and self.duration is None:
            raise ValueError("'duration' is missing")
        return self


class SetController(Controller):
    """A controller of a set of trials; it may run on a rig of its own, such as the same machine
    with another valve.

    What was identified on the set's rig holds for that one as well, by name.
    """

    rig: str | None = None
    flow_maps: str | None = None
    bench: str | None = None


class TrialSetRecipe(_AnyTrial):
    """The product of ``payloads`` (``none`` is none) × ``[[motion]]`` × ``[[controller]]``: one log
    each, and one table over all.
    """

    stage: Literal["trials"]
    payloads: Annotated[tuple[str, ...], Field(min_length=1)] = ("none",)
    motion: Annotated[tuple[Motion, ...], Field(min_length=1)]
    controller: Annotated[tuple[SetController, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _names_differ(self) -> TrialSetRecipe:
        for what, names in (
            ("payload", list(self.payloads)),
            ("motion", [m.name or m.kind for m in self.motion]),
            ("controller", [c.label for c in self.controller]),
        ):
            twice = next((name for i, name in enumerate(names) if name in names[:i]), None)
            if twice is not None:
                raise ValueError(
                    f"two entries of {what} are called '{twice}'; give each its own name"
                )
        return self

    def cases(self) -> tuple[tuple[str, SetController, TrialRecipe], ...]:
        """(name, controller, recipe) of each trial, payloads outermost and controllers innermost."""
        shared = {name: getattr(self, name) for name in _AnyTrial.model_fields if name != "path"}
        made = []
        for payload in self.payloads:
            for m, motion in enumerate(self.motion):
                for c, law in enumerate(self.controller):
                    name = " ".join(
                        [
                            payload if payload != "none" else "no load",
                            motion.name or motion.kind,
                            law.label,
                        ]
                    )
                    own = {
                        key: value
                        for key in ("rig", "flow_maps", "bench")
                        if (value := getattr(law, key)) is not None
                    }
                    case = TrialRecipe.model_construct(
                        **{**shared, **own},
                        stage="trial",
                        payload=None if payload == "none" else payload,
                        path=self.path,
                        controller=law.model_copy(update={"where": ("controller", c)}),
                        motion=motion.model_copy(update={"where": ("motion", m)}),
                    )
                    made.append((name, law, case.model_copy(update={"title": name})))
        return tuple(made)


class BenchCylinder(Model):
    """Friction of a cylinder of the virtual bench; what is not given follows from the rig's supply
    and areas.
    """

    friction_coulomb: _typed("friction_coulomb") | None = None
    friction_static: _typed("friction_static") | None = None
    friction_viscous: _typed("friction_viscous") | None = None
    stribeck_speed: _typed("stribeck_speed") | None = None


class BenchValve(Model):
    """Driver and dynamics of a valve of the virtual bench: spool = driver_gain·(command after
    hysteresis) + driver_offset.

    Where the rig file gives the valve's ``calibration``, gain and offset are tuned to it unless
    given here."""

    driver_gain: _typed("driver_gain") | None = None
    driver_offset: _typed("driver_offset") | None = None
    hysteresis: _typed("hysteresis") | None = None
    natural_frequency: _typed("natural_frequency") | None = None
    damping_ratio: _typed("damping_ratio") | None = None


class BenchCurve(Model):
    """What an edge of the virtual bench does in one direction of flow."""

    onset: _typed("onset") | None = None
    softness: _typed("softness") | None = None
    saturation: _typed("saturation") | None = None
    gain_factor: _typed("gain_factor") | None = None
    compensation_drop: _typed("compensation_drop") | None = None
    compensator_opening: _typed("compensator_opening") | None = None
    flow_force: _typed("flow_force") | None = None


class BenchEdge(BenchCurve):
    """An edge of the virtual bench; ``reverse`` is what differs when oil flows back through it."""

    null_leakage: _typed("null_leakage") | None = None
    reverse: BenchCurve = BenchCurve()


class BenchSensors(Model):
    """Sensors of a cylinder of the virtual bench (or of all: ``sensors.all``; of the lines:
    ``sensors.supply``).
    """

    pressure_noise: _typed("pressure") | None = None
    pressure_offset: _typed("pressure") | None = None
    pressure_resolution: _typed("pressure") | None = None
    pressure_lag: _typed("lag") | None = None
    position_noise: _typed("x") | None = None
    position_resolution: _typed("x") | None = None
    encoder_counts: int | None = Field(default=None, ge=0)


class BenchRecipe(Recipe):
    """A virtual bench: a machine like ``rig``, with what no model of it knows.

    ``truth`` replaces parameters of the rig by name (as a recipe names them); ``bulk_modulus`` is
    then that of oil and hose without air. In ``cylinder``, ``valve``, ``edge`` and ``sensors`` the
    entry ``all`` holds for every one that has no own value. What is given nowhere is drawn about a
    plausible value from ``seed``."""

    stage: Literal["bench"]
    rig: str
    seed: int = Field(default=0, ge=0)
    truth: ByParameter = {}
    air_fraction: _typed("air_fraction") = Value(0.003)
    polytropic_exponent: _typed("polytropic_exponent") = Value(1.3)
    droop: _typed("droop") | None = None
    pump_lag: _typed("lag") = Value(0.005)
    supply_relief: _typed("relief_pressure") | None = None
    calibration_drop: _typed("pressure_drop") = Value(2.0e6)
    delay: _typed("delay") = Value(0.001)
    velocity_cutoff: _typed("frequency") = Value(60.0)
    velocity_damping: _typed("damping_ratio") = Value(0.8)
    cylinder: dict[str, BenchCylinder] = {}
    valve: dict[str, BenchValve] = {}
    edge: dict[str, BenchEdge] = {}
    sensors: dict[str, BenchSensors] = {}


class Flowmeter(Model):
    """Flowmeter readings to record on the virtual bench, one CSV an edge and direction of
    ``edges``, e.g. ``boom.hect``.

    A needle valve sets each drop up to ``drop_scatter`` (a share). The turbine's noise is a share
    of the reading; below ``meter_limit`` the flow is taken from the cylinder's speed instead.
    ``outliers`` readings a file are spoilt."""

    edges: Annotated[tuple[str, ...], Field(min_length=1)]
    reverse: tuple[str, ...] = ()
    commands: Annotated[tuple[str, ...], Field(min_length=1)]
    pressure_drops: Annotated[tuple[str, ...], Field(min_length=1)]
    trials: int = Field(default=3, ge=1)
    drop_scatter: float = Field(default=0.03, ge=0, lt=1)
    meter_noise: float = Field(default=0.007, ge=0, lt=1)
    repeat_scatter: float = Field(default=0.005, ge=0, lt=1)
    meter_limit: _typed("meter_limit") = Value(1.9e-5)
    cylinder_noise: _typed("flow") = Value(2.0e-7)
    outliers: int = Field(default=2, ge=0)


class DatasetLog(Model):
    """A log to record on the virtual bench, as a trial gives it."""

    name: str
    title: str = ""
    payload: str | None = None
    posture: dict[str, str] = {}
    duration: _typed("duration")
    rate: _typed("rate") = Value(1000.0)
    command: Annotated[tuple[Command, ...], Field(min_length=1)]
    limits: Limits = Limits()

    @model_validator(mode="after")
    def _below_half_the_rate(self) -> DatasetLog:
        return _sampled(self)


class DatasetRecipe(Recipe):
    """What the virtual bench records for a dataset, into ``datasets/<name of this file>/``."""

    stage: Literal["dataset"]
    bench: str
    seed: int = Field(default=0, ge=0)
    flowmeter: Flowmeter | None = None
    log: tuple[DatasetLog, ...] = ()


class TuneRecipe(Recipe):
    """A validated rig to the gain of the pressure feedback of one cylinder.

    Operating points: ``postures`` strokes from 10 to 90 % (or those of ``strokes``) × ``payloads``
    (``none`` and all of the rig file by default) × ``functions`` (by default the thesis's six, as
    far as the valves are able) × ``speed_shares`` of the full speed there; other joints as in
    ``posture``, else at mid-stroke. ``delay`` lies between pressure and command: half a tick of
    hold, the rest for the sensor. ``washout`` (alone, or with an equal ``ramp_washout``) and
    ``off_gain`` are found where they are not given; ``washout = "0 rad/s"`` is none. ``one_gain =
    false`` lets each working function have its own gain. ``damping_ratio`` is the target that the
    share of ``draws`` is counted against."""

    stage: Literal["tune"]
    rig: str
    flow_maps: str | None = None
    cylinder: str | None = None
    payloads: tuple[str, ...] = ()
    postures: int = Field(default=5, ge=1, le=50)
    strokes: tuple[str, ...] = ()
    posture: dict[str, str] = {}
    functions: tuple[str, ...] = ()
    speed_shares: tuple[Annotated[float, Field(gt=0, le=1)], ...] = Field(
        default=(0.3, 0.7), min_length=1
    )
    rate: _typed("rate") = Value(1000.0)
    delay: _typed("delay") = Value(1.0e-3)
    washout: _typed("washout") | None = None
    ramp_washout: _typed("ramp_washout") | None = None
    off_gain: _typed("off_gain") | None = None
    low_pressure: _typed("low_pressure") | None = None
    cross_drop: _typed("cross_drop") | None = None
    one_gain: bool = True
    damping_ratio: _typed("damping_ratio") = Value(0.5)
    gain_margin: _typed("gain_margin") = Value(2.0)
    phase_margin: _typed("phase_margin") = Value(0.7853981633974483)
    bandwidth: _typed("frequency") = Value(0.5)
    draws: int = Field(default=200, ge=0, le=100000)
    seed: int = Field(default=0, ge=0)


class TextSection(Model):
    """A section of a report in the user's own words; blank lines part paragraphs, lines that begin
    with ``- `` make a list.
    """

    title: str
    text: str


class Campaign(Recipe):
    """Several recipes in order and one report over all of them.

    ``section`` are texts that stand before the runs; ``figures`` gives figures and tables titles by
    their key (of a figure as in a run's ``figures/index.json``), or by ``<recipe's name>/<key>``
    where several runs have the key."""

    stage: Literal["campaign"]
    recipes: Annotated[tuple[str, ...], Field(min_length=1)]
    section: tuple[TextSection, ...] = ()
    figures: dict[str, str] = {}


_STAGES: dict[tuple[str, str | None], type[Recipe]] = {
    ("identify", "flow_map"): FlowMapRecipe,
    ("identify", "hydraulics"): HydraulicsRecipe,
    ("validate", None): ValidateRecipe,
    ("tune", None): TuneRecipe,
    ("trial", None): TrialRecipe,
    ("trials", None): TrialSetRecipe,
    ("bench", None): BenchRecipe,
    ("dataset", None): DatasetRecipe,
    ("campaign", None): Campaign,
}


def line_of(text: str, location: tuple[Any, ...]) -> int | None:
    """The line of a TOML text at which the key at ``location`` (names and list indices) stands, or
    its nearest parent.
    """
    lines: dict[tuple[Any, ...], int] = {}
    counts: dict[tuple[Any, ...], int] = {}
    prefix: tuple[Any, ...] = ()

    def words(dotted: str) -> list[str]:
        return [
            part[1:-1] if part[:1] in "\"'" else part
            for part in re.findall(r'"[^"]*"|\'[^\']*\'|[A-Za-z0-9_-]+', dotted)
        ]

    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            path: tuple[Any, ...] = ()
            parts = words(header[2])
            for index, part in enumerate(parts):
                path += (part,)
                last = index == len(parts) - 1
                if last and header[1] == "[[":
                    counts[path] = counts.get(path, -1) + 1
                if path in counts:
                    path += (counts[path],)
            for known in [
                key
                for key in counts
                if len(key) >= len(path) and key[: len(path)] == path and key != path[:-1]
            ]:
                del counts[known]
            prefix = path
            lines.setdefault(prefix, number)
            if isinstance(prefix[-1], int):
                lines.setdefault(prefix[:-1], number)
        elif key := _KEY.match(line):
            lines.setdefault(prefix + tuple(words(key[1])), number)
    flat: dict[tuple[Any, ...], int] = {}
    for known, number in lines.items():
        flat.setdefault(_pieces(known), number)
    wanted = _pieces(location)
    return next(
        (flat[wanted[:size]] for size in range(len(wanted), 0, -1) if wanted[:size] in flat), None
    )


def _pieces(location: tuple[Any, ...]) -> tuple[Any, ...]:
    """A key's parts, dotted names taken apart, so that quoted and unquoted keys are the same."""
    return tuple(
        piece
        for part in location
        for piece in (part.split(".") if isinstance(part, str) else (part,))
    )


def read_toml(path: Path) -> tuple[dict[str, Any], str]:
    """The table and the text of a TOML file.

    Raises:
        InputError: no such file, not UTF-8, or not TOML, with the line.
    """
    try:
        text = path.read_bytes().decode("utf-8")
    except FileNotFoundError:
        near = (
            get_close_matches(path.name, [p.name for p in path.parent.glob("*.toml")], 1)
            if path.parent.is_dir()
            else []
        )
        raise InputError(
            "no such file", file=path, hint=f"did you mean '{near[0]}'?" if near else None
        ) from None
    except (UnicodeDecodeError, IsADirectoryError, PermissionError) as error:
        raise InputError(
            f"cannot be read as a text file: {type(error).__name__}", file=path
        ) from None
    if not text.strip():
        raise InputError("the file is empty", file=path)
    try:
        return tomllib.loads(text), text
    except tomllib.TOMLDecodeError as error:
        found = re.search(r"\(at line (\d+)", str(error))
        reason = str(error).split(" (at ")[0]
        raise InputError(
            f"not TOML: {reason}", file=path, line=int(found[1]) if found else None
        ) from None


def _validated(model: Any, table: dict[str, Any], text: str, path: Path) -> Any:
    try:
        return TypeAdapter(model).validate_python(table)
    except ValidationError as error:
        found = error.errors()
        first = next((e for e in found if e["type"] == "extra_forbidden"), found[0])
        reason = first.get("ctx", {}).get("error")
        location = tuple(
            part for part in first["loc"] if part not in ("chain", "slide", "[key]")
        ) + getattr(reason, "where", ())
        kind, hint, given = first["type"], None, first["input"]
        if kind.startswith("union_tag"):
            given, location = (
                given.get("kind") if isinstance(given, dict) else given,
                (*location, "kind"),
            )
            kind = "missing" if kind == "union_tag_not_found" else "literal_error"
            first = {
                **first,
                "ctx": {"expected": first["ctx"].get("expected_tags", "'chain', 'slide'")},
            }
        place, key = _spoken(table, location)
        if kind == "extra_forbidden":
            message = f"unknown key '{key}'"
            valid = _valid_keys(model, first["loc"][:-1])
            ends = range(len(location) - 2, 0, -1)
            above = next(
                (at for at in ends if location[-1] in _valid_keys(model, location[:at])), None
            )
            near = get_close_matches(str(location[-1]), valid, 1, 0.6)
            if above is not None and not near:
                hint = f"a key of {_spoken(table, location[:above])[0]}: put it above the table [{_header(location[:-1])}]"
            else:
                hint = (
                    f"did you mean '{near[0]}'?"
                    if near
                    else ("valid keys: " + ", ".join(valid) if valid else None)
                )
        elif kind == "missing":
            message = f"'{key}' is missing"
            location = location[:-1] or location
        elif kind == "value_error":
            message = str(reason) if not key or str(reason).startswith(key) else f"{key}: {reason}"
        elif kind == "literal_error":
            message = (
                f"{key} = {given!r} is none of {first['ctx']['expected'].replace(' or ', ', ')}"
            )
            near = get_close_matches(
                str(given), re.findall(r"'([^']*)'", first["ctx"]["expected"]), 1
            )
            hint = f"did you mean '{near[0]}'?" if near else None
        elif kind == "tuple_type":
            message = f"{key} is no list"
            hint = (
                f"write [[{_header(location)}]] for each entry" if isinstance(given, dict) else None
            )
        else:
            message = f"{key} = {_short(given)}: {first['msg'][0].lower() + first['msg'][1:]}"
        message = ": ".join(part for part in (place, message) if part)
        raise InputError(message, file=path, line=line_of(text, location), hint=hint) from None


def _spoken(table: Any, location: tuple[Any, ...]) -> tuple[str, str]:
    """(the entries of lists that a location lies in, by name or number; the key below them)."""
    places, words = [], []
    for part in location:
        try:
            table = table[part]
        except (KeyError, IndexError, TypeError):
            table = None
        if not isinstance(part, int):
            words.append(str(part))
            continue
        name = table.get("name") if isinstance(table, dict) else None
        places.append(".".join(words) + (f" '{name}'" if isinstance(name, str) else f" {part + 1}"))
        words = []
    return ", ".join(places), ".".join(words)


def _header(location: tuple[Any, ...]) -> str:
    """The header of a table in TOML."""
    return ".".join(part for part in location if isinstance(part, str))


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) < 60 else text[:57] + "…"


def _valid_keys(model: Any, location: tuple[Any, ...]) -> list[str]:
    """Keys that the model at ``location`` takes, as the file spells them."""
    from typing import get_args

    def models(annotation: Any) -> list[Any]:
        if isinstance(annotation, type) and issubclass(annotation, Model):
            return [annotation]
        return [found for part in get_args(annotation) for found in models(part)]

    here = [model]
    for part in location:
        if isinstance(part, int) or part in ("chain", "slide"):
            continue
        deeper = []
        for candidate in here:
            for name, field in candidate.model_fields.items():
                if part in (name, field.alias):
                    deeper += models(field.annotation)
        here = deeper or here
    return sorted(
        {
            field.alias or name
            for candidate in here
            for name, field in candidate.model_fields.items()
            if name != "path"
        }
    )


def load_rig(path: str | Path) -> Rig:
    """The rig of a TOML file, or of a run folder that holds an identified rig (``rig.toml``).

    Example:
        rig = ehbench.load_rig("recipes/rigs/slide_servo.toml")
        rig.parameters()["bulk_modulus"]

    Raises:
        InputError: with file, line, key, value and the nearest valid key.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "rig.toml"
    table, text = read_toml(path)
    return _validated(Rig, table, text, path)


def load_recipe(path: str | Path) -> Recipe:
    """The recipe of a TOML file, of the type its ``stage`` (and ``what``) names.

    Raises:
        InputError: with file, line, key, value and the nearest valid key.
    """
    path = Path(path)
    table, text = read_toml(path)
    stage, what = table.get("stage"), table.get("what")
    kinds = sorted({s for s, _ in _STAGES})
    if stage not in kinds:
        reason = "'stage' is missing" if stage is None else f"unknown stage '{stage}'"
        raise InputError(
            reason,
            file=path,
            line=line_of(text, ("stage",)),
            hint="stage is one of " + ", ".join(kinds),
        )
    model = _STAGES.get((stage, what)) or _STAGES.get((stage, None))
    if model is None:
        options = ", ".join(w for s, w in _STAGES if s == stage and w)
        reason = "'what' is missing" if what is None else f"unknown what = '{what}'"
        raise InputError(
            reason, file=path, line=line_of(text, ("what",)), hint="what is one of " + options
        )
    return _validated(model, table, text, path).model_copy(update={"path": path.resolve()})


def kind_of(path: Path) -> Literal["rig", "recipe"]:
    """Whether a TOML file is a rig (has a mechanism) or a recipe (has a stage)."""
    table, _ = read_toml(path)
    return "recipe" if "stage" in table or "mechanism" not in table else "rig"
