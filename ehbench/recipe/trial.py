"""The recipe of a trial: open-loop commands, or a controller and the motion it shall make."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol

from pydantic import BeforeValidator, Field, model_validator

from ehbench.control import LAW_NAMES
from ehbench.fields import FileModel, Q, Value
from ehbench.recipe.base import ByParameter, Recipe


class Command(FileModel):
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
    offset: Annotated[Value, Q("offset")] = Value(0.0)
    amplitude: Annotated[Value, Q("amplitude")] = Value(0.0)
    start: Annotated[Value, Q("start")] = Value(0.0)
    stop: Annotated[Value, Q("stop")] | None = None
    frequency: Annotated[Value, Q("frequency")] | None = None
    frequency_max: Annotated[Value, Q("frequency")] | None = None
    lines: int = Field(default=20, ge=1, le=1000)
    seed: int = Field(default=0, ge=0, le=2**63 - 1)
    file: str | None = None

    @model_validator(mode="after")
    def _whole(self) -> Command:
        if self.kind in ("sine", "multisine"):
            self._waves()
        if self.kind == "ramp" and self.stop is None:
            raise ValueError("a ramp needs 'stop'")
        if self.kind == "file" and self.file is None:
            raise ValueError("a file command needs 'file'")
        return self

    def _waves(self) -> None:
        if self.frequency is None:
            raise ValueError(f"a {self.kind} needs 'frequency'")
        low = float(self.frequency)
        if not low > 0.0:
            raise ValueError("'frequency' must be above 0 Hz")
        if self.kind == "sine":
            return
        if self.frequency_max is None:
            raise ValueError("a multisine needs 'frequency_max'")
        high = float(self.frequency_max)
        if not high > low:
            raise ValueError(f"frequency_max, {high:g} Hz, must lie above frequency, {low:g} Hz")


class Limits(FileModel):
    """Where a trial stops safely. Pressures are of every chamber; ``stroke_margin`` is kept at both
    ends of every stroke. ``ramp`` is the time in which the valves then go to rest: shut at once,
    they would catch the moving load between them, and the pressure would rise far above its limit.
    """

    pressure_max: Annotated[Value, Q("pressure")] | None = None
    pressure_min: Annotated[Value, Q("pressure")] | None = None
    stroke_margin: Annotated[Value, Q("stroke")] | None = None
    speed_max: Annotated[Value, Q("v")] | None = None
    command_max: Annotated[Value, Q("command_max")] | None = None
    ramp: Annotated[Value, Q("ramp")] = Value(0.05)


def _one_or_more(raw: Any) -> Any:
    return [raw] if isinstance(raw, str) else raw


class Motion(FileModel):
    """What the controlled cylinder shall do.

    kind ``velocity_steps``: each of ``levels`` (a share of the full speed such as ``"70 %"``, or a
    speed; negative retracts) for ``duration`` or until it has covered ``travel``, with a ``rest``
    before and after each; ``full_speed`` is the design model's where it is not given.
    ``point_to_point``: through ``waypoints`` (strokes, from the first of which it starts) with a
    ``hold`` at each, within ``speed``, ``acceleration`` and ``jerk``, ``cycles`` times where the
    way ends where it begins. ``file``: a log with ``<cylinder>.x_desired``. ``cylinder`` may be
    left out where there is one."""

    name: str = ""
    kind: Literal["velocity_steps", "point_to_point", "file"]
    cylinder: str | None = None
    levels: tuple[str, ...] = ()
    full_speed: Annotated[Value, Q("speed")] | None = None
    duration: Annotated[Value, Q("duration")] | None = None
    travel: Annotated[Value, Q("x")] | None = None
    rest: Annotated[Value, Q("hold")] | None = None
    waypoints: tuple[Annotated[Value, Q("x")], ...] = ()
    hold: Annotated[tuple[Annotated[Value, Q("hold")], ...], BeforeValidator(_one_or_more)] = ()
    speed: Annotated[Value, Q("speed")] | None = None
    acceleration: Annotated[Value, Q("acceleration")] | None = None
    jerk: Annotated[Value, Q("jerk")] | None = None
    profile: Literal["ramp", "seventh"] = "ramp"
    cycles: int = Field(
        default=1,
        ge=1,
        le=1000,
        description="how often the way is made; energies are those of the last time, which begins "
        "and ends with the oil in one state",
    )
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
        if self.cycles > 1 and (
            self.kind != "point_to_point" or float(self.waypoints[0]) != float(self.waypoints[-1])
        ):
            raise ValueError("only a point_to_point that ends at its first waypoint makes 'cycles'")
        if self.kind == "file" and self.file is None:
            raise ValueError("a motion of kind file needs 'file'")
        return self


if TYPE_CHECKING:
    LawName = str
else:
    LawName = Literal[LAW_NAMES]


class Controller(FileModel):
    """Who moves the cylinder: ``kind`` of a built-in law, or ``class = "module:Class"`` of the
    user's own.

    ``gains`` by name with units, or ``"<tune recipe or its run>"``, or both: ``{ from = "…",
    washout = "0 rad/s" }``; a class gets them as keywords. ``rules`` of function selection,
    ``shaping`` of speed steps (pressure feedback), ``unused`` valves that stay at rest."""

    name: str = ""
    kind: LawName | None = None
    code: str | None = Field(default=None, alias="class")
    gains: str | dict[str, Any] = {}
    rules: dict[str, Any] = {}
    shaping: dict[str, Any] = {}
    unused: tuple[str, ...] = ()
    where: tuple[str | int, ...] = Field(default=("controller",), exclude=True)

    @property
    def class_name(self) -> str:
        """Name of the user's class; empty for a built-in law."""
        return (self.code or "").partition(":")[2]

    @property
    def label(self) -> str:
        """Its name, else its kind or class."""
        return self.name or self.kind or self.class_name

    @property
    def gains_from(self) -> str | None:
        """The tune recipe, run folder or file that gains come from, as written."""
        return self.gains if isinstance(self.gains, str) else self.gains.get("from")

    @property
    def own_gains(self) -> dict[str, Any]:
        """The gains that stand in the recipe itself, by name, as written."""
        table = {} if isinstance(self.gains, str) else self.gains
        return {name: raw for name, raw in table.items() if name != "from"}

    @model_validator(mode="after")
    def _one_law(self) -> Controller:
        if (self.kind is None) == (self.code is None):
            raise ValueError("give 'kind' or 'class', and not both")
        if self.shaping:
            from ehbench.control.registry import LAWS

            shaped = [name for name, law in LAWS.items() if law.shaped]
            if self.kind not in shaped:
                raise ValueError(f"'shaping' is of {' and '.join(shaped)} only")
        return self


class Sampled(Protocol):
    """What samples open-loop commands at a rate."""

    @property
    def command(self) -> tuple[Command, ...]: ...

    @property
    def rate(self) -> Value: ...


def refuse_fast_waves(trial: Sampled) -> None:
    """Refuse sines that samples at the trial's rate cannot hold.

    Raises:
        ValueError: names the first.
    """
    half = 0.5 * float(trial.rate)
    for command in trial.command:
        for key in ("frequency", "frequency_max"):
            asked = getattr(command, key)
            if command.kind not in ("sine", "multisine") or asked is None:
                continue
            if float(asked) >= half:
                raise ValueError(
                    f"command to {command.valve}: {key}, {float(asked):g} Hz, "
                    f"must lie below half the rate, {half:g} Hz"
                )


class AnyTrial(Recipe):
    """What one trial and a set of trials have in common."""

    rig: str
    flow_maps: str | None = None
    on: Literal["model", "bench"] = "model"
    bench: str | None = None
    dynamics: ByParameter = Field(
        default={},
        description="other `[dynamics]` of the rig file for valves, by `<cylinder>.<valve>`; on "
        "the bench as well",
    )
    posture: dict[str, str] = {}
    duration: Annotated[Value, Q("duration")] | None = None
    rate: Annotated[Value, Q("rate")] = Value(1000.0)
    step: Annotated[Value, Q("step")] = Value(5.0e-4)
    seed: int = Field(default=0, ge=0, le=2**63 - 1)
    command: tuple[Command, ...] = ()
    limits: Limits = Limits()

    @model_validator(mode="after")
    def _below_half_the_rate(self) -> AnyTrial:
        refuse_fast_waves(self)
        return self


class TrialRecipe(AnyTrial):
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
