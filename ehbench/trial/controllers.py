"""From a recipe's ``[controller]`` to something that turns samples into commands: a compiled law,
or a user's class.

A controller is designed on the recipe's rig without payload, and is given only the channels that it
is entitled to."""

from __future__ import annotations

import importlib.util
import math
import sys
import traceback
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ehbench.control import arc
from ehbench.control import pressure_feedback as feedback
from ehbench.control.functions import (
    ALLOW_SEVENTH,
    EXTEND_RESISTIVE_REGENERATION,
    FUNCTIONS,
    Circuit,
    circuit,
    pack_rules,
)
from ehbench.control.trajectory import A, J, V, X, pack_shaping
from ehbench.errors import InputError
from ehbench.machines.rows import ARC, FEEDBACK
from ehbench.parts.cylinder import chamber_oil, linkage_arrays
from ehbench.parts.friction.coulomb_viscous import COULOMB_SPEED
from ehbench.parts.nodes import SUPPLY
from ehbench.parts.sample import sample_size
from ehbench.parts.valve import valve_lag
from ehbench.plant.model import Model
from ehbench.quantities import VOCABULARY, Quantity, quantity
from ehbench.recipe import TrialRecipe
from ehbench.rig import Rig, read_value
from ehbench.rundir import read_json
from ehbench.text import shortened

if TYPE_CHECKING:
    from ehbench.plant.build import Maps

OFF_RATE = 10.0  # [rad/s]: how fast the off-side pressure follows where no gain is given
RULES = (
    "speed_start",
    "speed_stop",
    "force_band",
    "drop_start",
    "drop_stop",
    "reserve",
    "supply_margin",
    "supply_band",
    "cross_drop",
    "dwell",
)
SHAPING = ("acceleration_max", "jerk_max", "natural_frequency", "damping_ratio")
_OPEN_LOOP = {
    name: VOCABULARY[name] for name in ("off_gain", "low_pressure", "drop_floor", "load_corner")
}
_FEEDBACK = {
    **_OPEN_LOOP,
    **{name: VOCABULARY[name] for name in ("feedback_gain", "washout", "ramp_washout")},
}
_ARC = {
    **{name: VOCABULARY[name] for name in arc.GAIN_NAMES if name not in ("tick", "adapt")},
    **{name: VOCABULARY[name] for name in ("adaptation", "adaptation_bulk", "lag_budget")},
    "adapt": None,
    "disturbance": VOCABULARY["force"],
    "payload": VOCABULARY["mass"],
    "bulk_modulus": VOCABULARY["bulk_modulus"],
}
_PAIRS = ("payload", "bulk_modulus")  # bounds: a list of two


class Wish(NamedTuple):
    """What the cylinder shall do now: stroke x [m], speed v [m/s], acceleration a [m/s²], jerk j
    [m/s³], extension positive.
    """

    x: float
    v: float
    a: float
    j: float


@dataclass(frozen=True)
class Design:
    """What a controller may know of the machine: the recipe's rig without payload.

    ``model`` is its simulation model on ``maps``; ``cylinder`` the controlled one, number
    ``index``; ``q`` the posture of all joints at the start [rad or m]; ``circuit`` the cylinder's
    metering edges without those of valves the controller shall not use."""

    rig: Rig
    maps: Maps | None
    model: Model
    cylinder: str
    index: int
    q: np.ndarray
    circuit: Circuit

    @property
    def row(self) -> np.record:
        """The cylinder's row of the plant."""
        return self.model.plant.cylinders[self.index]

    @property
    def valves(self) -> tuple[str, ...]:
        """Names of all valves, in the order of the commands."""
        return self.model.layout.valves

    @property
    def x(self) -> float:
        """The cylinder's stroke [m] at the start."""
        joint = int(self.row.joint)
        return float(linkage_arrays(self.row, self.q[joint : joint + 1])[0][0])


@dataclass
class Compiled:
    """A built-in controller as the compiled loops take it. ``notes`` has a row a tick, its columns
    ``channels``.

    ``used`` says what it was made of, SI: see `_feedback_gains` and `_arc_gains`.
    """

    kind: int
    mask: np.ndarray
    given: np.ndarray
    axis: arc.Axis
    gains: np.ndarray
    memory: np.ndarray
    channels: tuple[str, ...]
    wish: np.ndarray
    notes: np.ndarray
    used: dict[str, Any]


@contextmanager
def located(recipe: TrialRecipe, *keys: str | int) -> Iterator[None]:
    """Bad input found inside is said to stand at a key of the recipe, unless it says itself where
    it stands.
    """
    try:
        yield
    except InputError as error:
        if error.file is not None:
            raise
        raise InputError(error.message, **recipe.at(*keys), hint=error.hint) from None


def design(recipe: TrialRecipe, rig: Rig, maps: Maps | None) -> Design:
    """The design model of a trial.

    Raises:
        InputError: no such cylinder or valve, or a posture outside the stroke.
    """
    controller, motion = recipe.controller, recipe.motion
    names = [c.name for c in rig.cylinder]
    name = motion.cylinder if motion is not None else None
    if name is None and len(names) > 1:
        where = recipe.at(*(motion.where if motion is not None else ("controller",)))
        raise InputError(
            "which cylinder is controlled?",
            **where,
            hint='write cylinder = "…" in [motion]: ' + ", ".join(names),
        )
    if name is not None and name not in names:
        raise InputError(
            f"rig '{rig.name}' has no cylinder '{name}'",
            **recipe.at(*motion.where, "cylinder"),
            hint="it has " + ", ".join(names),
        )
    index = names.index(name) if name is not None else 0
    model = Model.of(rig, maps)
    plant, layout = model.plant, model.layout
    measured = [
        (maps or {}).get(edge) or (maps or {}).get(edge.split(".", 1)[1]) for edge in layout.edges
    ]
    edges = plant.edges.copy()
    for valve in controller.unused:
        if valve not in layout.valves:
            raise InputError(
                f"no valve '{valve}'",
                **recipe.at(*controller.where, "unused"),
                hint="there are " + ", ".join(layout.valves),
            )
        # an edge from supply to supply is on no path
        off = edges.valve == layout.valves.index(valve)
        edges.from_node[off] = edges.to_node[off] = SUPPLY
    row = plant.cylinders[index]
    with located(recipe, *controller.where, "unused"):
        reach = np.column_stack([plant.valves.lowest, plant.valves.highest])
        made = circuit(index, row.area_head, row.area_rod, edges, plant.maps, reach, measured)
    with located(recipe, "posture"):
        model.posture(recipe.posture)
    with located(recipe, *(motion.where if motion is not None else ()), "waypoints"):
        q = model.posture(posture_of(recipe, names[index]))
    return Design(rig, maps, model, names[index], index, q, made)


def posture_of(recipe: TrialRecipe, cylinder: str) -> dict[str, str]:
    """The posture of a recipe; the controlled cylinder stands at the first waypoint of its motion
    unless the recipe says otherwise.
    """
    points = recipe.motion.waypoints if recipe.motion is not None else ()
    return ({cylinder: f"{float(points[0])!r} m"} if points else {}) | recipe.posture


def refuse_code(recipe: TrialRecipe, allowed: bool) -> None:
    """Refuse a controller of the user's own unless it is allowed.

    Raises:
        InputError: says why and how.
    """
    if recipe.controller is not None and recipe.controller.code is not None and not allowed:
        raise InputError(
            f"the controller '{recipe.controller.code}' is Python code, and a recipe may not run code by itself",
            **recipe.at(*recipe.controller.where, "class"),
            hint="if you trust it, add --allow-code",
        )


def gains_file(recipe: TrialRecipe) -> str | None:
    """The tune recipe, run folder or file that a recipe takes gains from, as it is written there."""
    gains = recipe.controller.gains if recipe.controller is not None else {}
    return gains if isinstance(gains, str) else gains.get("from")


def code_file(recipe: TrialRecipe) -> Path | None:
    """The Python file behind the recipe's ``class``: beside the recipe, else that of an importable
    module; None without class.

    Raises:
        InputError: there is none.
    """
    text = recipe.controller.code if recipe.controller is not None else None
    if text is None:
        return None
    where = recipe.at(*recipe.controller.where, "class")
    module, _, name = text.partition(":")
    if not (module and name.isidentifier()):
        raise InputError(
            f"class = '{text}' is no class of a module",
            **where,
            hint='write it like "my_module:MyController"',
        )
    beside = recipe.path.parent / (module.replace(".", "/") + ".py")
    if beside.is_file():
        return beside.resolve()
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        spec = None
    if spec is None or not spec.origin or not Path(spec.origin).is_file():
        raise InputError(
            f"no module '{module}'",
            **where,
            hint=f"looked for {beside.name} beside the recipe, and among the installed modules",
        )
    return Path(spec.origin).resolve()


# --- built-in controllers
# -------------------------------------------------------------------------------------------------


def compiled(
    recipe: TrialRecipe,
    made: Design,
    tuning: Mapping[str, Any] | None,
    wish: np.ndarray,
    rate: float,
) -> Compiled:
    """A built-in controller, ready to run over the rows of ``wish``.

    Raises:
        InputError: a gain or rule that is unknown or wrong.
    """
    chosen, model = recipe.controller, made.model
    plant, row, tick = model.plant, made.row, 1.0 / rate
    supply = float(plant.supply.pressure)
    rows = {"open_loop": _FEEDBACK, "pressure_feedback": _FEEDBACK, "arc": _ARC}[chosen.kind]
    gains, rules = _taken(recipe, rows, tuning, made.cylinder)
    low = gains.setdefault("low_pressure", supply / 20.0)
    with located(recipe, *chosen.where, "rules"):
        packed = pack_rules(made.circuit.area_rod, supply, low_pressure=low, **rules)
    with located(recipe, *chosen.where, "shaping"):
        shaping = pack_shaping(
            **_quantities(
                recipe, "shaping", chosen.shaping, {name: VOCABULARY[name] for name in SHAPING}
            )
        )
    axis = arc.axis(
        made.circuit,
        plant.kind,
        plant.gravity,
        plant.links,
        plant.cylinders.joint,
        made.q,
        (row.geometry, row.l_a, row.l_b, row.side, row.phase, row.retracted_length),
        (
            row.volume_head,
            row.volume_rod,
            row.bulk_modulus,
            row.leakage_internal,
            row.leakage_head,
            row.leakage_rod,
        ),
        (row.friction_viscous, row.friction_coulomb, COULOMB_SPEED),
    )
    own = slice(made.circuit.first, made.circuit.first + made.circuit.count)
    unused = np.isin(plant.edges.valve[own], [made.valves.index(name) for name in chosen.unused])
    axis = axis._replace(onset=np.where(unused, 0.0, axis.onset))  # no standing by for them
    channels = sample_size(len(model.layout.cylinders))
    edges = model.layout.edges[own]
    with located(recipe, *chosen.where, "gains"):
        if chosen.kind == "arc":
            kind, mask, names, memory = (
                ARC,
                arc.entitled(axis, channels),
                arc.note_channels(made.cylinder, edges),
                arc.memory_size(axis),
            )
            more = {
                name: gains.pop(name)
                for name in list(gains)
                if name == "adapt" or name not in arc.GAIN_NAMES
            }
            limit = float(plant.supply.flow_limit)
            limit = (
                limit if math.isfinite(limit) else 0.5 * made.circuit.area_head
            )  # half a metre a second
            known = {
                "tick": tick,
                "supply_pressure": supply,
                "flow_limit": limit,
                "valve_lag": _valve_lag(made),
                "gains": gains,
            }
            values = arc.pack_arc(axis, packed, **known, **more)
            slow = arc.pack_arc(
                axis, packed, **known, **more | {"adaptation": 1.0, "adaptation_bulk": 1.0}
            )
            used = _arc_gains(values, slow)
        else:
            kind, mask, memory = (
                FEEDBACK,
                feedback.entitled(made.circuit, channels),
                feedback.MEMORY,
            )
            names = feedback.note_channels(made.cylinder, edges)
            volume = max(
                chamber_oil(row, 0, made.x),
                chamber_oil(row, 1, made.x),
            )
            gains.setdefault("off_gain", OFF_RATE * volume / row.bulk_modulus)
            if chosen.kind == "open_loop":
                gains |= {"feedback_gain": 0.0, "washout": 0.0, "ramp_washout": 0.0}
            elif "feedback_gain" not in gains:
                hint = 'write gains = { feedback_gain = "…", washout = "…" }, or gains = "<a tune recipe or its run>"'
                raise InputError(
                    "pressure feedback needs its gain", **recipe.at(*chosen.where), hint=hint
                )
            values = feedback.pack_pressure_feedback(
                tick=tick, rules=packed, shaping=shaping, **gains
            )
            used = _feedback_gains(values, made.circuit)
    used["rules"] = dict(zip((*RULES, "allow_seventh"), packed.tolist(), strict=True))
    return Compiled(
        kind,
        mask,
        np.zeros(channels),
        axis,
        values,
        np.zeros(memory),
        names,
        wish,
        np.zeros((len(wish), len(names))),
        used,
    )


def _feedback_gains(values: np.ndarray, made: Circuit) -> dict[str, Any]:
    """``gains`` by name [SI]: all that `pack_pressure_feedback` packed but its rules.

    The feedback gain is one number, or ``<working function>.feedback_gain`` of each that may be
    chosen where they differ. Shaping is named where there is some."""
    gains = {
        name: float(values[getattr(feedback, name.upper())])
        for name in ("tick", *_FEEDBACK)
        if name != "feedback_gain"
    }
    seventh = bool(values[feedback.AT_RULES + ALLOW_SEVENTH])
    may = [
        f
        for f in range(1, len(FUNCTIONS))
        if made.able[f] and (seventh or f != EXTEND_RESISTIVE_REGENERATION)
    ]
    by_function = {
        f"{FUNCTIONS[f]}.feedback_gain": float(values[feedback.FEEDBACK_GAIN + f]) for f in may
    }
    one = set(by_function.values())
    gains |= {"feedback_gain": one.pop()} if len(one) == 1 else by_function
    shaping = zip(SHAPING, values[feedback.AT_SHAPING : feedback.AT_RULES].tolist(), strict=True)
    return {"gains": gains | {name: value for name, value in shaping if value > 0.0}}


def _arc_gains(values: np.ndarray, slow: np.ndarray) -> dict[str, Any]:
    """``gains`` by name [SI] and ``estimate_bounds``, (lower, upper) [SI] of each estimate, of what
    `pack_arc` packed.

    ``slow`` is the same packed for adaptation at 1 rad/s, in which the rates are proportional.
    Projected are the estimates of the law; ``payload_estimate`` is payload_share/inverse_inertia,
    so its bounds are those of the quotient."""
    gains = dict(zip(arc.GAIN_NAMES, values[: arc.AT_LOWER].tolist(), strict=True))
    for name, which in (("adaptation", arc.INVERSE_INERTIA), ("adaptation_bulk", arc.INVERSE_BULK)):
        gains[name] = float(values[arc.AT_RATE + which] / slow[arc.AT_RATE + which])
    lower, upper = (
        values[arc.AT_LOWER : arc.AT_UPPER].tolist(),
        values[arc.AT_UPPER : arc.AT_RATE].tolist(),
    )
    bounds = {
        name: [low, high] for name, low, high in zip(arc.ESTIMATES, lower, upper, strict=True)
    }
    share, inverse = bounds["payload_share"], bounds["inverse_inertia"]
    bounds["payload_estimate"] = [share[0] / inverse[1], share[1] / inverse[0]]
    return {"gains": gains, "estimate_bounds": bounds}


def low_pressure(recipe: TrialRecipe, rig: Rig, tuning: Mapping[str, Any] | None) -> float:
    """Set-point of the off-side chamber above tank [Pa] that a recipe's controller has, at which
    its trial starts.
    """
    gains = recipe.controller.gains
    given = gains.get("low_pressure") if isinstance(gains, Mapping) else None
    if given is not None:
        return _quantities(
            recipe, "gains", {"low_pressure": given}, {"low_pressure": VOCABULARY["low_pressure"]}
        )["low_pressure"]
    return float((tuning or {}).get("low_pressure") or float(rig.supply.pressure) / 20.0)


def read_tuning(recipe: TrialRecipe, folder: Path | None) -> dict[str, Any] | None:
    """What the tune run says that a recipe names, from ``folder`` or, without one, from where the
    recipe points.

    Raises:
        InputError: there is no ``tuning.json``.
    """
    name = gains_file(recipe)
    if name is None:
        return None
    path = recipe.file(name) if folder is None else folder
    if path.is_dir():
        path = path / "tuning.json"
    if path.suffix != ".json":
        raise InputError(
            f"gains come from '{name}', which is a recipe",
            **recipe.at(*recipe.controller.where, "gains"),
            hint="name its run folder",
        )
    return read_json(path)


def _taken(
    recipe: TrialRecipe,
    rows: Mapping[str, Quantity],
    tuning: Mapping[str, Any] | None,
    cylinder: str,
):
    """(gains, rules) of a recipe, SI: those of the tune run, and over them those that stand in the
    recipe.
    """
    chosen = recipe.controller
    gains, rules = {}, {}
    if tuning is not None:
        if tuning.get("cylinder") != cylinder:
            raise InputError(
                f"the gains are tuned for cylinder '{tuning.get('cylinder')}', not '{cylinder}'",
                **recipe.at(*chosen.where, "gains"),
            )
        gains |= {name: tuning[name] for name in rows if name in tuning}
        rules |= {name: tuning[name] for name in RULES if name in tuning}
    if isinstance(chosen.gains, Mapping):
        gains |= _quantities(
            recipe, "gains", {k: v for k, v in chosen.gains.items() if k != "from"}, rows
        )
    rules |= _quantities(
        recipe,
        "rules",
        chosen.rules,
        {**{name: VOCABULARY[name] for name in RULES}, "allow_seventh": None},
    )
    return gains, rules


def _quantities(
    recipe: TrialRecipe, table: str, given: Mapping[str, Any], rows: Mapping[str, Quantity | None]
) -> dict[str, Any]:
    """The numbers [SI] of a table of the controller, by name; a row of None is yes or no.

    Raises:
        InputError: an unknown name, a wrong unit, with the line.
    """
    found: dict[str, Any] = {}
    for name, raw in given.items():
        where = recipe.at(*recipe.controller.where, table, name)
        if name not in rows:
            near = get_close_matches(name, rows, 1)
            hint = f"did you mean '{near[0]}'?" if near else "it has " + ", ".join(rows)
            raise InputError(
                f"controller '{recipe.controller.label}' has no {table} '{name}'",
                **where,
                hint=hint,
            )
        row = rows[name]
        try:
            if row is None:
                if not isinstance(raw, bool):
                    raise InputError(f"{name} = {raw!r}", hint="it is true or false")
                found[name] = raw
            elif name == "feedback_gain" and isinstance(raw, Mapping):
                found[name] = {
                    function: float(read_value(value, row)) for function, value in raw.items()
                }
            elif name in _PAIRS:
                found[name] = read_value(raw, row, 2).value
            else:
                found[name] = float(read_value(raw, row))
        except InputError as error:
            raise InputError(f"{name}: {error.message}", **where, hint=error.hint) from None
    return found


def _valve_lag(made: Design) -> float:
    """Lag 2ζ/ω_n [s] of the slowest valve that the controller uses."""
    own = range(made.circuit.first, made.circuit.first + made.circuit.count)
    plant = made.model.plant
    used = {int(made.circuit.edges[e].valve) for e in own if e in made.circuit.paths}
    return max((valve_lag(plant.valves[i], plant) for i in used), default=0.0)


# --- a user's class
# -------------------------------------------------------------------------------------------------------


class UserCode:
    """A controller of the user's own: loads the class, asks it tick by tick, and says where it went
    wrong.

    Args:
        recipe: names the class.
        made: what the class is designed on.
        channels: of the machine's sample.
        rate: [Hz].

    Raises:
        InputError: the file or class is not right, or its code raised.
    """

    def __init__(
        self,
        recipe: TrialRecipe,
        made: Design,
        channels: Sequence[str],
        rate: float,
        wish: np.ndarray,
    ) -> None:
        self.recipe, self.made, self.rate, self.names = recipe, made, rate, tuple(channels)
        chosen = recipe.controller
        self.file, self.label = code_file(recipe), chosen.code.partition(":")[2]
        for table, foreign in (
            ("rules", bool(chosen.rules)),
            ("gains", gains_file(recipe) is not None),
        ):
            if foreign:
                what = "rules of function selection" if table == "rules" else "gains of a tune run"
                hint = "it chooses for itself; give it numbers by gains = { name = value }"
                raise InputError(
                    f"a controller of your own is given no {what}",
                    **recipe.at(*chosen.where, table),
                    hint=hint,
                )
        kind = self._load()
        gains = {name: self._gain(name, raw) for name, raw in chosen.gains.items()}
        numbers = {
            name: value
            for name, value in gains.items()
            if isinstance(value, int | float) and math.isfinite(value)
        }
        self.used = {"gains": {name: float(value) for name, value in numbers.items()}}
        self.object = self._call("()", kind, **gains)
        for method in ("start", "step"):
            if not callable(getattr(self.object, method, None)):
                raise self._error(
                    f"has no method '{method}'",
                    hint="docs/trials.md has the protocol of a controller",
                )
        self.mask = self._entitled(getattr(self.object, "channels", None))
        extra = tuple(getattr(self.object, "notes", ()))
        for name in extra:
            try:
                quantity(name)
            except KeyError as error:
                raise self._error(
                    f"notes '{name}': {error.args[0]}",
                    hint="a note has a name of the vocabulary, like boom.load_force",
                ) from None
        own = f"{made.cylinder}."
        self.channels = (
            *(own + name for name in ("x_desired", "v_desired", "a_desired", "j_desired")),
            *extra,
        )
        self.wish, self.notes = wish, np.zeros((len(wish), len(self.channels)))
        self.low, self.high = (
            made.model.plant.valves.lowest.copy(),
            made.model.plant.valves.highest.copy(),
        )
        self.beyond = 0
        self._columns = {name: i for i, name in enumerate(made.valves) if name not in chosen.unused}
        self._unused = [made.valves.index(name) for name in chosen.unused]

    def start(self, sample: np.ndarray) -> None:
        """Hand the class its rig, the time between samples and the first sample."""
        self._call(".start", self.object.start, self.made, 1.0 / self.rate, self._seen(sample))

    def step(self, row: int, t: float, sample: np.ndarray, command: np.ndarray) -> None:
        """One tick: write what the class asks for into ``command``, where it asks, and its notes
        into their row.
        """
        wish = self.wish[row]
        answer = self._call(
            ".step", self.object.step, t, self._seen(sample), Wish(*wish.tolist()), t=t
        )
        kept = command[self._unused] if self._unused else None
        try:
            if isinstance(answer, Mapping):
                for name, value in answer.items():
                    command[self._columns[name]] = value
            elif (
                np.shape(answer) == command.shape
            ):  # numpy would spread one number, or None, over all valves
                command[:] = answer
            else:
                raise TypeError
        except KeyError as error:
            name = error.args[0]
            which = (
                "which the recipe leaves unused"
                if name in self.made.valves
                else "which is no valve"
            )
            raise self._error(
                f".step names '{name}', {which}", hint="valves are " + ", ".join(self._columns)
            ) from None
        except (TypeError, ValueError):
            hint = f"a dict of volts by valve, or {len(self.made.valves)} numbers: " + ", ".join(
                self.made.valves
            )
            raise self._error(
                f".step gave {shortened(answer, 80)} at t = {t:.4g} s, which is no set of commands",
                hint=hint,
            ) from None
        if kept is not None:
            command[self._unused] = kept
        if not (
            (command >= self.low) & (command <= self.high)
        ).all():  # one look a tick; nan is in no range
            if not np.isfinite(command).all():
                hint = "channels that it does not name in `channels` are nan"
                raise self._error(
                    f".step gave {shortened(answer, 80)} at t = {t:.4g} s, which is not finite",
                    hint=hint,
                )
            self.beyond += 1
            np.clip(command, self.low, self.high, out=command)
        note = self.notes[row]
        note[:4] = wish[[X, V, A, J]]
        if note.size > 4:
            try:
                note[4:] = self.object.note
            except (AttributeError, TypeError, ValueError):
                raise self._error(
                    f".note does not hold {note.size - 4} numbers",
                    hint="one for each name in `notes`",
                ) from None

    def _seen(self, sample: np.ndarray) -> dict[str, float]:
        return dict(zip(self.names, np.where(self.mask, sample, math.nan).tolist(), strict=True))

    def _gain(self, name: str, raw: Any) -> Any:
        if isinstance(raw, str) and name in VOCABULARY:
            return _quantities(self.recipe, "gains", {name: raw}, {name: VOCABULARY[name]})[name]
        return raw

    def _load(self) -> Callable[..., Any]:
        module = types.ModuleType(f"ehbench_user_{self.file.stem}")
        module.__file__ = str(self.file)
        sys.modules[module.__name__] = module  # where dataclasses and pickles look for it
        try:
            source = self.file.read_bytes()
            exec(compile(source, str(self.file), "exec"), module.__dict__)  # noqa: S102
        except SyntaxError as error:
            raise InputError(
                f"not Python: {error.msg}", file=self.file, line=error.lineno
            ) from None
        except (Exception, SystemExit) as error:
            raise self._raised("", error) from error
        found = getattr(module, self.label, None)
        if not isinstance(found, type):
            there = [
                name
                for name, item in vars(module).items()
                if isinstance(item, type) and item.__module__ == module.__name__
            ]
            raise InputError(
                f"has no class '{self.label}'",
                file=self.file,
                hint="it has " + (", ".join(there) or "none"),
            )
        return found

    def _entitled(self, patterns: Any) -> np.ndarray:
        if isinstance(patterns, str) or not isinstance(patterns, Sequence) or not patterns:
            hint = (
                'like channels = ["boom.p_head", "p_supply"]; boom.* are all of a cylinder; there are '
                + ", ".join(self.names)
            )
            raise self._error("does not say which channels it is given", hint=hint)
        for pattern in patterns:
            if not any(fnmatchcase(name, pattern) for name in self.names):
                raise self._error(
                    f"asks for channel '{pattern}', which the machine does not measure",
                    hint="it has " + ", ".join(self.names),
                )
        return np.array(
            [any(fnmatchcase(name, pattern) for pattern in patterns) for name in self.names]
        )

    def _call(
        self,
        what: str,
        function: Callable[..., Any],
        *given: Any,
        t: float | None = None,
        **named: Any,
    ) -> Any:
        try:
            return function(*given, **named)
        except (Exception, SystemExit) as error:
            raise self._raised(what, error, t) from error

    def _raised(self, what: str, error: BaseException, t: float | None = None) -> InputError:
        frames = [
            f for f in traceback.extract_tb(error.__traceback__) if f.filename == str(self.file)
        ]
        line, text = (frames[-1].lineno, f": {frames[-1].line}") if frames else (None, "")
        at = "" if t is None else f" at t = {t:.4g} s"
        return InputError(
            f"{self.label}{what} raised {type(error).__name__}{at}: {error}",
            file=self.file,
            line=line,
            hint=f"in the line{text}" if text else None,
        )

    def _error(self, message: str, hint: str) -> InputError:
        return InputError(
            f"{self.label}{'' if message[0] == '.' else ' '}{message}", file=self.file, hint=hint
        )
