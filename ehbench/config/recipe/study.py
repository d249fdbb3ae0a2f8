"""The recipe of a study: one recipe over many samples of what is not known, or not chosen yet."""

from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from ehbench.config.recipe.base import Recipe, dotted
from ehbench.config.recipe.toml import as_list, as_table
from ehbench.config.rig.names import second
from ehbench.vocabulary import message
from ehbench.vocabulary.fields import FileModel, Q, Value

Number = str | int | float
LAWS = {  # law: the two numbers that give it
    "uniform": ("low", "high"),
    "log_uniform": ("low", "high"),
    "normal": ("mean", "std"),
    "log_normal": ("median", "spread"),
}


class Spread(FileModel):
    """How a key is drawn: ``law`` with its two numbers, which decide the law where it is not said.

    ``uniform`` and ``log_uniform`` between ``low`` and ``high``, ``normal`` about ``mean`` by
    ``std``, ``log_normal`` about ``median`` by a factor of ``spread`` in one standard deviation.
    ``relative``: all numbers are factors on what the rig or recipe has. ``also`` are keys that get
    the same."""

    law: Literal["uniform", "log_uniform", "normal", "log_normal"] | None = None
    low: Number | None = None
    high: Number | None = None
    mean: Number | None = None
    std: Number | None = None
    median: Number | None = None
    spread: Number | None = None
    relative: bool = False
    also: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _whole(self) -> Self:
        numbers = {name for names in LAWS.values() for name in names}
        given = {name for name in numbers if getattr(self, name) is not None}
        fitting = [law for law, names in LAWS.items() if given == set(names)]
        if not fitting or (self.law is not None and self.law not in fitting):
            required = "low and high, mean and std, or median and spread"
            if self.law is not None:
                required = " and ".join(LAWS[self.law])
            raise ValueError(message("config.draw_needs", required=required))
        return self

    @property
    def kind(self) -> str:
        """Its law."""
        given = self.low is not None, self.mean is not None, self.median is not None
        return self.law or ("uniform", "normal", "log_normal")[given.index(True)]

    @property
    def ends(self) -> tuple[Number, Number]:
        """The two numbers of its law, as written."""
        first, second = (getattr(self, name) for name in LAWS[self.kind])
        return first, second


class Span(FileModel):
    """What a key is swept over: ``values``, or ``low`` to ``high``: ``count`` of them evenly, or as
    the study's ``design`` fills it. ``relative`` and ``also`` as in `Spread`; ``log``: evenly in
    the logarithm."""

    values: tuple[Any, ...] = ()
    low: Number | None = None
    high: Number | None = None
    count: int | None = Field(default=None, ge=2, le=100_000)
    relative: bool = False
    log: bool = False
    also: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _whole(self) -> Self:
        both = self.low is not None and self.high is not None
        if bool(self.values) == both or (self.values and self.count is not None):
            raise ValueError(message("config.sweep_needs"))
        return self


def _by_key(raw: Any) -> Any:
    return dotted(raw, {"values", "low", "mean", "median"})


def _listed(raw: Any) -> Any:
    raw = _by_key(raw)
    if not isinstance(raw, dict):
        return raw
    return {k: {"values": item} if isinstance(item, list) else item for k, item in raw.items()}


class Case(FileModel):
    """Several keys that change together: ``set`` gives each its value, as a recipe would."""

    name: str
    set: dict[str, Any]


class Identified(FileModel):
    """Parameters drawn from what an identification found: its values with their covariance.

    ``run`` is an identify recipe of hydraulics or its run; ``parameters`` of it, by default all
    that have a standard error."""

    run: str
    parameters: tuple[str, ...] = ()


class Measure(FileModel):
    """A measure of a sample: by the ``result``'s name, or taken of a ``channel`` of a trial's log.

    ``take`` says what of the channel, less the channel ``minus`` where that is given, ``since`` the
    start of the trial or the tick at which a limit stopped it; ``stopped`` counts it of samples
    that a limit stopped as well. ``over``: another result that it is divided by. ``inside``: 1
    where an interval, the result, holds the value that the key of that name has in the sample, else
    0."""

    name: str = ""
    result: str | None = None
    channel: str | None = None
    minus: str | None = None
    take: Literal["max", "min", "mean", "rms", "final", "range", "largest"] = "largest"
    since: Literal["start", "stop"] = "start"
    stopped: bool = False
    over: str | None = None
    inside: str | None = None
    unit: str | None = None

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if (self.result is None) == (self.channel is None):
            raise ValueError(message("config.measure_needs"))
        if self.result is None and not (self.over is None and self.inside is None):
            raise ValueError(message("config.over_of_results"))
        return self

    @property
    def label(self) -> str:
        """Its name in tables."""
        if self.name or self.channel is None:
            return self.name or self.result or ""
        what = self.channel if self.minus is None else f"{self.channel} - {self.minus}"
        return f"{self.take} {what}" + (" since stop" if self.since == "stop" else "")


class Target(FileModel):
    """What a measure shall keep to: ``at_most``, ``at_least``, or both, with units."""

    measure: str
    at_most: Number | None = None
    at_least: Number | None = None

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.at_most is None and self.at_least is None:
            raise ValueError(message("config.target_needs"))
        return self


class StudyRecipe(Recipe):
    """``recipe`` run over many samples.

    ``identified`` and ``draw`` say what is not known, ``sweep`` and ``case`` what is chosen. Keys
    begin with ``rig``, ``recipe`` or ``bench``, and then go as these files do; one that begins
    with the name of a recipe behind means that one's. Every combination of listed values and
    cases is tried on the same ``samples`` points, which ``design`` lays in what is drawn and in
    what is swept without a count. ``measures`` are what is taken of each sample.
    Trials whose recipe has no ``step`` take an adaptive one."""

    stage: Literal["study"]
    recipe: Annotated[tuple[str, ...], BeforeValidator(as_list), Field(min_length=1)]
    identified: Identified | None = None
    draw: Annotated[dict[str, Spread], BeforeValidator(_by_key)] = {}
    sweep: Annotated[dict[str, Span], BeforeValidator(_listed)] = {}
    case: tuple[Case, ...] = ()
    correlation: tuple[tuple[str, str, float], ...] = ()
    design: Literal["random", "sobol", "latin_hypercube", "saltelli"] = "random"
    samples: int = Field(default=1, ge=1, le=100_000_000)
    seed: int = Field(default=0, ge=0, le=2**62)
    seeds: tuple[str, ...] = ()
    measures: Annotated[tuple[Annotated[Measure, as_table("result")], ...], Field(min_length=1)]
    target: tuple[Target, ...] = ()
    worst: str | None = None
    keep: int = Field(default=3, ge=0, le=1000)
    time_limit: Annotated[Value, Q("duration")] | None = None

    @model_validator(mode="after")
    def _agree(self) -> Self:
        labels = [measure.label for measure in self.measures]
        if (at := second(labels)) is not None:
            raise ValueError(message("config.measure_twice", label=labels[at]))
        keys = [*self.draw, *self.sweep, *self.seeds]
        if (at := second(keys)) is not None:
            raise ValueError(message("config.varied_twice", key=keys[at]))
        return self
