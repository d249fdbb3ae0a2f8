"""The recipes of a trial, open-loop commands or a controller with a motion, and of a set."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from ehbench.config.recipe.base import ByParameter, Payload, Recipe
from ehbench.config.recipe.toml import as_list
from ehbench.config.rig import LoadSensing, LowRail
from ehbench.config.rig.names import Misplaced, second
from ehbench.control import LAW_NAMES
from ehbench.vocabulary import message
from ehbench.vocabulary.fields import FileModel, Internal, Q, Value, Vector


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
        window = "amplitude", "start", "stop"
        needs, takes = {
            "constant": ((), ()),
            "step": ((), window),
            "ramp": (("stop",), window),
            "sine": (("frequency",), window),
            "multisine": (("frequency", "frequency_max"), (*window, "lines", "seed")),
            "file": (("file",), ("start",)),
        }[self.kind]
        for name, item in type(self).model_fields.items():
            fields = {"what": "command", "kind": self.kind, "key": name}
            given = getattr(self, name) != item.default
            if name in needs and not given:
                raise ValueError(message("config.kind_needs", **fields))
            if given and name not in ("valve", "kind", "offset", *needs, *takes):
                raise Misplaced(message("config.kind_takes", **fields), name)
        if self.frequency is not None:
            low = float(self.frequency)
            high = math.inf if self.frequency_max is None else float(self.frequency_max)
            if not low > 0.0:
                raise ValueError(message("config.frequency_not_positive"))
            if not high > low:
                raise ValueError(message("config.frequency_max_low", high=high, low=low))
        return self


class Limits(FileModel):
    """Where a trial stops safely. Pressures are of every chamber; ``stroke_margin`` is kept at both
    ends of every stroke. ``ramp`` is the time in which the valves then go to rest: shut at once,
    they would catch the moving load between them, and the pressure would rise far above its limit.

    What is not finite always stops a trial, and so does a sensor that says what its machine cannot
    do. A bound that is ``"auto"`` follows from the rig, see `ehbench.trial.checks`."""

    pressure_max: Annotated[Value, Q("pressure")] | None = None
    pressure_min: Annotated[Value, Q("pressure")] | None = None
    stroke_margin: Annotated[Value, Q("stroke")] | None = None
    speed_max: Annotated[Value, Q("v")] | None = None
    command_max: Annotated[Value, Q("command_max")] | None = None
    command_rate: Annotated[Value, Q("command_rate")] | None = None
    following_error: Annotated[Value | Literal["auto"], Q("following_error", word="auto")] = "auto"
    following_time: Annotated[Value, Q("hold")] = Value(0.1)
    position_mismatch: Annotated[Value | Literal["auto"], Q("following_error", word="auto")] = (
        "auto"
    )
    pressure_range: Annotated[Value | Literal["auto"], Q("pressure", word="auto")] = "auto"
    sample_age: Annotated[Value | Literal["auto"], Q("delay", word="auto")] = "auto"
    overrun: Annotated[Value | Literal["auto"], Q("delay", word="auto")] = "auto"
    ramp: Annotated[Value, Q("ramp")] = Value(0.05)


class Fault(FileModel):
    """Something that fails on the model or the virtual bench during a trial, from ``start`` to
    ``stop``, by default to the end.

    A sensor, ``target`` a channel such as ``boom.p_head`` or ``boom.x``: ``stuck`` at its last
    value, ``offset`` by ``value``, ``drift`` by ``value`` each second, ``scale`` by the factor
    ``value``, ``nan``, ``zero``, ``dropouts`` (it repeats its last value for ``duration`` every
    ``period``), ``spikes`` (of ``value`` for one sample every ``period``). A valve, ``target`` such
    as ``boom.hepc``: ``stuck_open`` at ``value``, by default the end of its range,
    ``stuck_closed``, ``slow`` by a lag of ``duration``. Without target: ``supply_lost``,
    ``link_delayed`` by ``duration``, ``link_lost``, ``link_reordered``, ``controller_late`` by
    ``duration``."""

    kind: Literal[
        "stuck",
        "offset",
        "drift",
        "scale",
        "nan",
        "zero",
        "dropouts",
        "spikes",
        "stuck_open",
        "stuck_closed",
        "slow",
        "supply_lost",
        "link_delayed",
        "link_lost",
        "link_reordered",
        "controller_late",
    ]
    target: str = ""
    start: Annotated[Value, Q("start")] = Value(0.0)
    stop: Annotated[Value, Q("stop")] | None = None
    value: str | None = None
    duration: Annotated[Value, Q("hold")] = Value(0.02)
    period: Annotated[Value, Q("hold")] = Value(0.5)


class MachineChange(FileModel):
    """What is otherwise on the machine than on that which the controller was designed for.

    ``delay`` of all samples (on the model, whose sensors are exact, of all commands) and
    ``pressure_lag`` are added; ``valve_lag`` (the valves' periods), ``bulk_modulus``, ``friction``,
    ``flow`` of every edge and ``supply_pressure`` are factors; ``deadband`` is added to every
    edge's. ``fault`` is what fails on it, as `Fault`."""

    name: str = ""
    fault: tuple[Fault, ...] = ()
    delay: Annotated[Value, Q("delay")] = Value(0.0)
    pressure_lag: Annotated[Value, Q("lag")] = Value(0.0)
    valve_lag: float = Field(default=1.0, gt=0.0, le=100.0)
    bulk_modulus: float = Field(default=1.0, gt=0.0, le=100.0)
    friction: float = Field(default=1.0, ge=0.0, le=100.0)
    flow: float = Field(default=1.0, gt=0.0, le=100.0)
    deadband: Annotated[Value, Q("map_shift")] = Value(0.0)
    supply_pressure: float = Field(default=1.0, gt=0.0, le=100.0)
    where: Annotated[tuple[str | int, ...], Internal] = Field(default=("machine",), exclude=True)


class PayloadChange(FileModel):
    """A load that the machine takes up or puts down on its way: from ``at`` on it carries
    ``payload``, which moves with its link at once.
    """

    at: Annotated[Value, Q("start")]
    payload: str


class CylinderMotion(FileModel):
    """What one cylinder shall do.

    kind ``velocity_steps``: each of ``levels`` (a share of the full speed such as ``"70 %"``, or a
    speed; negative retracts) for ``duration`` or until it has covered ``travel``, with a ``rest``
    before and after each; ``full_speed`` is the design model's where it is not given.
    ``point_to_point``: through ``waypoints`` (strokes, from the first of which it starts) with a
    ``hold`` at each, within ``speed``, ``acceleration`` and ``jerk``, ``cycles`` times where the
    way ends where it begins. ``file``: a log with ``<cylinder>.x_desired``. ``operator``: a person
    commands its speed, at most ``speed``, by a lever, or, with ``file``, what the lever said in
    that log or run. ``path``, and more of ``operator``: see `Motion`.
    ``cylinder`` may be left out where there is one."""

    kind: Literal["velocity_steps", "point_to_point", "file", "path", "operator"]
    cylinder: str | None = None
    levels: tuple[str, ...] = ()
    full_speed: Annotated[Value, Q("speed")] | None = None
    duration: Annotated[Value, Q("duration")] | None = None
    travel: Annotated[Value, Q("x")] | None = None
    rest: Annotated[Value, Q("hold")] | None = None
    waypoints: tuple[Annotated[Value, Q("x")], ...] = ()
    hold: Annotated[tuple[Annotated[Value, Q("hold")], ...], BeforeValidator(as_list)] = ()
    speed: Annotated[Value, Q("speed")] | None = None
    acceleration: Annotated[Value, Q("acceleration")] | None = None
    jerk: Annotated[Value, Q("jerk")] | None = None
    profile: Literal["ramp", "seventh"] = "ramp"
    cycles: int = Field(default=1, ge=1, le=1000)
    file: str | None = None
    dead_zone: Annotated[Value, Q("dead_zone")] = Value(0.05)
    axis: str = ""
    where: Annotated[tuple[str | int, ...], Internal] = Field(default=("motion",), exclude=True)

    @model_validator(mode="after")
    def _whole(self) -> CylinderMotion:
        if self.kind == "velocity_steps":
            if not self.levels:
                raise ValueError(message("config.steps_need_levels"))
            if (self.duration is None) == (self.travel is None):
                raise ValueError(message("config.steps_need_duration"))
        if self.kind == "point_to_point":
            if len(self.waypoints) < 2:
                raise ValueError(message("config.waypoints_needed"))
        if self.kind in ("point_to_point", "operator") and self.speed is None:
            raise ValueError(message("config.motion_needs_speed", kind=self.kind))
        rates = [float(rate) for rate in (self.speed, self.acceleration) if rate is not None]
        if self.kind == "operator" and not all(rate > 0.0 for rate in rates):
            raise ValueError(message("config.operator_stands"))
        if self.cycles > 1 and (
            self.kind != "point_to_point" or float(self.waypoints[0]) != float(self.waypoints[-1])
        ):
            raise ValueError(message("config.no_cycles"))
        if self.kind == "file" and self.file is None:
            raise ValueError(message("config.motion_file"))
        return self


class Motion(CylinderMotion):
    """What the controlled cylinder shall do, as `CylinderMotion`; ``also`` are the motions of
    others at the same time, each with its ``cylinder``.

    kind ``path``: the tip of the mechanism goes along straight lines through ``points``, with a
    ``hold`` at each, within ``speed``, ``acceleration`` and ``jerk``; the ``cylinders``, by default
    all, follow by inverse kinematics. Where several cylinders would draw more than the pump gives,
    time along the motion runs slower, unless ``share_flow`` is false.

    kind ``operator``: ``device`` is the live ``page``, or the name or path of a joystick, whose
    ``axis`` is the lever of a cylinder. Beyond its ``dead_zone`` a lever asks for a share of
    ``speed``, which changes by ``acceleration`` at most. Without the dead-man switch, ``button``
    of the joystick, the speed goes to zero and the trial does what ``release`` says."""

    name: str = ""
    also: tuple[CylinderMotion, ...] = ()
    points: tuple[Annotated[Vector, Q("tip", "x y z")], ...] = ()
    cylinders: tuple[str, ...] = ()
    share_flow: bool = True
    device: str = "page"
    button: str = ""
    release: Literal["continue", "end"] = "continue"

    @model_validator(mode="after")
    def _of_its_kind(self) -> Motion:
        if self.kind == "path":
            if len(self.points) < 2:
                raise ValueError(message("config.path_needs_points_two"))
            if self.speed is None:
                raise ValueError(message("config.path_needs_speed"))
            if self.cylinder is not None or self.also:
                raise ValueError(message("config.path_names_cylinders"))
            return self
        if self.points or self.cylinders:
            raise ValueError(message("config.points_of_path"))
        if any(item.kind == "path" for item in self.also):
            raise ValueError(message("config.path_under_also"))
        names = [item.cylinder or "" for item in self.each] if self.also else []
        if "" in names:
            raise ValueError(message("config.also_needs_cylinder"))
        if (at := second(names)) is not None:
            raise ValueError(message("config.cylinder_twice", twice=names[at]))
        return self

    @property
    def each(self) -> tuple[CylinderMotion, ...]:
        """The motion of each cylinder, its own first."""
        also = (
            item.model_copy(update={"where": (*self.where, "also", i)})
            for i, item in enumerate(self.also)
        )
        return (self, *also)


if TYPE_CHECKING:
    LawName = str
else:
    LawName = Literal[LAW_NAMES]


def _refuse_shaping(kind: str | None) -> None:
    from ehbench.control.registry import LAWS

    shaped = [name for name, law in LAWS.items() if law.shaped]
    if kind not in shaped:
        raise ValueError(message("config.shaping_only", shaped=" and ".join(shaped)))


class CylinderController(FileModel):
    """The built-in law of one cylinder, where several move and they have not all the same:
    ``kind``, ``gains`` and ``rules`` as in ``[controller]``.
    """

    kind: LawName
    gains: dict[str, Any] = {}
    rules: dict[str, Any] = {}
    shaping: dict[str, Any] = {}

    @model_validator(mode="after")
    def _single_law(self) -> CylinderController:
        if self.shaping:
            _refuse_shaping(self.kind)
        if "from" in self.gains:
            raise ValueError(message("config.from_of_cylinder"))
        return self


class Controller(FileModel):
    """Who moves the cylinder: ``kind`` of a built-in law, or ``class = "module:Class"`` of the
    user's own.

    ``gains`` by name with units, or ``"<tune recipe or its run>"``, or both: ``{ from = "…",
    washout = "0 rad/s" }``; a class gets them as keywords. ``rules`` of function selection,
    ``shaping`` of speed steps (pressure feedback), ``unused`` valves that stay at rest. Where
    several cylinders move, all have this law but for those named under ``cylinders``, and
    ``coupling`` says whether a law with a model of the mechanism counts on the others' motion.
    ``monitor`` watches for valves that do not follow, and moves the load by the others. ``delay``
    is how late the samples come as far as it is known: the law compares them with the reference of
    their time."""

    name: str = ""
    kind: LawName | None = None
    code: str | None = Field(default=None, alias="class")
    gains: str | dict[str, Any] = {}
    rules: dict[str, Any] = {}
    shaping: dict[str, Any] = {}
    unused: tuple[str, ...] = ()
    coupling: bool = True
    monitor: bool = False
    delay: Annotated[Value, Q("delay")] = Value(0.0)
    cylinders: dict[str, CylinderController] = {}
    where: Annotated[tuple[str | int, ...], Internal] = Field(default=("controller",), exclude=True)

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
    def written_gains(self) -> dict[str, Any]:
        """The gains that stand in the recipe itself, by name, as written."""
        table = {} if isinstance(self.gains, str) else self.gains
        return {name: raw for name, raw in table.items() if name != "from"}

    def of(self, cylinder: str) -> Controller:
        """The controller of one of several cylinders."""
        law = self.cylinders.get(cylinder)
        if law is None:
            return self.model_copy(update={"cylinders": {}})
        taken = {name: getattr(law, name) for name in CylinderController.model_fields}
        place = (*self.where, "cylinders", cylinder)
        return self.model_copy(update=taken | {"cylinders": {}, "name": "", "where": place})

    @model_validator(mode="after")
    def _single_law(self) -> Controller:
        if (self.kind is None) == (self.code is None):
            raise ValueError(message("config.kind_or_class"))
        if self.code is not None and (self.monitor or float(self.delay)):
            raise ValueError(message("config.monitor_of_class"))
        if self.shaping:
            _refuse_shaping(self.kind)
        return self


def refuse_unmatched(controller: Controller, motions: Sequence[Motion]) -> None:
    """Refuse a controller that does not fit the motions of several cylinders.

    Raises:
        ValueError: says what does not.
    """
    if controller.code is not None and any(motion.also for motion in motions):
        raise ValueError(message("config.code_moves_one"))
    if any(motion.kind == "path" for motion in motions):
        return  # only the rig knows which cylinders it moves
    names = {item.cylinder for motion in motions for item in motion.each}
    for name in controller.cylinders:
        if name not in names:
            raise ValueError(message("config.controller_without_motion", name=name))


def refuse_fast_waves(commands: Sequence[Command], rate: Value) -> None:
    """Refuse sines that samples at a rate [Hz] cannot hold.

    Raises:
        ValueError: names the first.
    """
    half = 0.5 * float(rate)
    for command in commands:
        for key in ("frequency", "frequency_max"):
            requested = getattr(command, key)
            if command.kind not in ("sine", "multisine") or requested is None:
                continue
            if float(requested) >= half:
                fields = {"valve": command.valve, "key": key, "requested": float(requested)}
                raise ValueError(message("config.command_too_fast", half=half, **fields))


class OtherSupply(FileModel):
    """How the supply follows the load in a trial, where the rig file says otherwise or nothing."""

    load_sensing: LoadSensing | None = None
    low_rail: LowRail | None = None


class AnyTrial(Recipe):
    """What one trial and a set of trials have in common."""

    rig: str
    flow_maps: str | None = None
    on: Literal["model", "bench"] = "model"
    bench: str | None = None
    dynamics: ByParameter = {}
    posture: dict[str, str] = {}
    duration: Annotated[Value, Q("duration")] | None = None
    rate: Annotated[Value, Q("rate")] = Value(1000.0)
    step: Annotated[Value | Literal["auto"], Q("step", word="auto")] = Value(5.0e-4)
    seed: int = Field(default=0, ge=0, le=2**63 - 1)
    payload_change: tuple[PayloadChange, ...] = ()
    first_pressure_error: dict[str, Annotated[Value, Q("pressure_error")]] = {}
    command: tuple[Command, ...] = ()
    limits: Limits = Limits()
    fault: tuple[Fault, ...] = ()
    supply: OtherSupply = OtherSupply()

    @model_validator(mode="after")
    def _in_time(self) -> AnyTrial:
        refuse_fast_waves(self.command, self.rate)
        times = [0.0, *(float(change.at) for change in self.payload_change)]
        if any(later <= sooner for sooner, later in zip(times, times[1:], strict=False)):
            raise ValueError(message("config.payload_times"))
        return self


class TrialRecipe(AnyTrial):
    """One trial on the model or on the virtual bench: open-loop ``command``, or a ``controller``
    and the ``motion`` it shall make.

    Under a controller ``duration`` may be left out: it is then that of the motion; other cylinders
    may take open-loop commands."""

    stage: Literal["trial"]
    # pyrefly: ignore[bad-override]
    on: Annotated[str, Field(pattern="^(model|bench|[a-z]+://.+)$")] = Field(
        default="model",
        description="`model`, `bench`, or the address of a machine: `udp://host:port`",
    )
    payload: Payload = None
    machine: MachineChange | None = None
    controller: Controller | None = None
    motion: Motion | None = None

    @model_validator(mode="after")
    def _whole(self) -> TrialRecipe:
        if self.controller is None and self.motion is not None:
            raise ValueError(message("config.motion_without_controller"))
        if self.controller is not None and self.motion is None and self.controller.code is None:
            raise ValueError(message("config.controller_needs_motion", label=self.controller.label))
        if self.motion is None and self.duration is None:
            raise ValueError("'duration' is missing")
        levers = [] if self.motion is None else self.motion.each
        if self.duration is None and any(i.kind == "operator" and not i.file for i in levers):
            raise ValueError(message("config.operator_needs_duration"))
        if self.controller is not None and self.motion is not None:
            refuse_unmatched(self.controller, (self.motion,))
        return self

    def singles(self, starts: Mapping[str, float]) -> tuple[TrialRecipe, ...]:
        """This trial for each of its cylinders alone, as its motions and controllers say; they
        stand at the strokes ``starts`` [m] where the posture does not say otherwise.
        """
        controller, motion = self.controller, self.motion
        if controller is None or motion is None:
            return (self,)
        each = motion.each
        if motion.kind == "path":
            each = tuple(motion.model_copy(update={"cylinder": name}) for name in starts)
        posture = {name: f"{x!r} m" for name, x in starts.items()} | self.posture
        laws = [controller.of(item.cylinder or "") for item in each]
        return tuple(
            self.model_copy(update={"motion": item, "controller": law, "posture": posture})
            for item, law in zip(each, laws, strict=True)
        )


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
    def _whole(self) -> TrialSetRecipe:
        if self.seeds > 1 and self.on != "bench":
            raise ValueError(message("config.seeds_of_bench"))
        for what, names in (
            ("payload", list(self.payloads)),
            ("motion", [m.name or m.kind for m in self.motion]),
            ("machine", [m.name for m in self.machine]),
            ("controller", [c.label for c in self.controller]),
        ):
            if (at := second(names)) is not None:
                raise ValueError(message("config.entry_twice", what=what, twice=names[at]))
        if any(i.kind == "operator" and not i.file for m in self.motion for i in m.each):
            raise ValueError(message("config.operator_of_set"))
        for law in self.controller:
            refuse_unmatched(law, self.motion)
        return self

    def cases(self) -> tuple[TrialRecipe, ...]:
        """The recipe of each trial by its name, payloads outermost, controllers innermost."""
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
            keys = ("rig", "flow_maps", "bench", "dynamics", "supply")
            own = {key: value for key in keys if (value := getattr(law, key))}
            load = payload if payload != "none" else "no load"
            own["title"] = " ".join([load, message, law.label])
            case = TrialRecipe.model_construct(
                **{**shared, **own},
                stage="trial",
                payload=None if payload == "none" else payload,
                path=self.path,
                machine=machine,
                controller=law.model_copy(update={"where": ("controller", c)}),
                motion=motion.model_copy(update={"where": ("motion", m), "name": message}),
            )
            cases.append(case)
        return tuple(cases)
