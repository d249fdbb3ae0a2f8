"""What a motion must cost on a constant-pressure supply, and what it did cost."""

from dataclasses import dataclass

import numpy as np

from ehbench.config.rig import Cylinder, Rig
from ehbench.data.record import Record
from ehbench.ledger.sheet import Ledger, function_of
from ehbench.parts.oil import bulk
from ehbench.physics.cylinder import linkage
from ehbench.plant.build import oil_fields, pins_of
from ehbench.vocabulary import InsufficientData, message, setting
from ehbench.vocabulary.codes import EXTEND_RESISTIVE_REGENERATION, FUNCTIONS


@dataclass(frozen=True)
class BoundSettings:
    """Numbers by which a motion is held against what it must cost."""

    travel: float = setting(
        0.005, "", "part of the stroke below which a motion to and fro is none", "noise"
    )
    closed: float = setting(
        0.02, "", "part of the travel by which the ends of a closed cycle may differ", "chosen"
    )
    oil: float = setting(
        0.003, "", "part of a four-way valve's bound that oil left pressed may cost", "chosen"
    )
    loaded: float = setting(
        0.02, "", "part of the supply's force below which a mean force is no load", "friction"
    )


SETTINGS = BoundSettings()


@dataclass(frozen=True)
class Beyond:
    """What a cylinder drew beyond its bound while one working function was at work [J].

    ``drawn`` is Ps·Q drawn, ``bound`` what the bound pays for the way [m] made meanwhile, out
    positive; ``compression`` is ``Ps Σ ∫ V/β dp`` of both chambers: the part of what was drawn that
    pressed their oil together, negative where it expanded."""

    function: str
    way: float
    drawn: float
    bound: float
    compression: float


@dataclass(frozen=True)
class Bounds:
    """What a constant-pressure supply pays for the motion of one cylinder, against what was drawn
    (SPEC 4), all [J].

    ``standard``: a four-way valve draws A1 for every metre out and A2 for every metre in. ``six``:
    lifting as before, lowering with regeneration. ``seventh``: lifting with regeneration as well,
    None where the supply cannot carry the load on the area difference, or where the load hangs on
    the rod end. ``work``: lifting itself, ``∫ P_L v dt`` where positive. ``used`` is Ps·Q drawn,
    None where nothing says it; ``saving`` its share below ``standard``. ``carries`` is the chamber
    that holds the load, or none; ``closed`` says whether the motion ended where it began, its oil
    in the same state: only then do the bounds mean a cycle. ``retained`` is what the oil cost
    that is more pressed together at the end than at the beginning, Ps Σ V Δp/β of both
    chambers, negative for less. ``against`` names the least bound that the working functions at
    work can reach, ``beyond`` what was drawn on top of it by each; empty and () where no
    controller logged its functions. A supply of constant pressure is paid for volume: load,
    friction and a low pressure on the off-side say where energy is lost, compression and oil
    let to tank say how much is drawn."""

    cylinder: str
    travel_out: float
    travel_in: float
    closed: bool
    retained: float
    carries: str
    standard: float
    six: float
    seventh: float | None
    work: float
    used: float | None
    saving: float | None
    against: str = ""
    beyond: tuple[Beyond, ...] = ()


def travels(x: np.ndarray, apart: float) -> tuple[float, float]:
    """(way out, way in) [m] of a stroke, between turning points ``apart`` [m] or more."""
    anchor, extreme, going = float(x[0]), float(x[0]), 0
    ways = [0.0, 0.0]
    for value in x:
        value = float(value)
        if going == 0:
            going = 1 if value - anchor > apart else (-1 if anchor - value > apart else 0)
            extreme = value
        elif going * (value - extreme) > 0.0:
            extreme = value
        elif going * (extreme - value) > apart:
            ways[0 if going > 0 else 1] += abs(extreme - anchor)
            anchor, extreme, going = extreme, value, -going
    if going:
        ways[0 if going > 0 else 1] += abs(extreme - anchor)
    return ways[0], ways[1]


def bounds(rig: Rig, record: Record, cylinder: str, ledger: Ledger | None = None) -> Bounds:
    """What a record's motion of a cylinder must cost on a constant-pressure supply, and did cost.

    With Ps the pressure of the supply while the cylinder moves that way (the set one where it is
    not measured), L+ and L− the ways out and in: standard ``Ps (A1 L+ + A2 L−)``. A load on the
    head end: six ``Ps A1 L+``, seventh ``Ps (A1 − A2) L+``. One that hangs on the rod end: six
    ``Ps (A2 L− + (A1 − A2) L+)``. No load: six as standard, seventh ``Ps ((A1 − A2) L+ + A2 L−)``.

    The record has ``.p_head``, ``.p_rod`` and ``.x`` or ``.q`` of the cylinder, the ledger of the
    same record the energy drawn.

    Raises:
        InputError: no such cylinder.
        LogError: a channel is missing.
        InsufficientData: the cylinder did not move, or the supply has not one pressure."""
    item = rig.cylinder_named(cylinder)
    if not rig.supply.constant:
        raise InsufficientData(message("ledger.no_one_pressure", supply=rig.supply.kind))
    if f"{cylinder}.x" in record:
        x = record[f"{cylinder}.x"]
    else:
        pins = pins_of(item)
        x = np.array([linkage(*pins, angle)[0] for angle in record[f"{cylinder}.q"]])
    ways = travels(x, SETTINGS.travel * float(item.stroke))
    if ways == (0.0, 0.0):
        raise InsufficientData(message("ledger.did_not_move", cylinder=cylinder))
    head, rod = item.areas()
    force = record[f"{cylinder}.p_head"] * head - record[f"{cylinder}.p_rod"] * rod
    supply, each = float(rig.supply.pressure), np.full(2, float(rig.supply.pressure))
    if "p_supply" in record:  # a pump's compensator gives way under flow, an accumulator runs down
        pressure, steps = record["p_supply"][1:], np.diff(x)
        gone = np.maximum([steps, -steps], 0.0)
        supply = float(np.average(pressure, weights=np.abs(steps)))
        each = gone @ pressure / np.maximum(gone.sum(axis=1), 1e-300)
    carries, work, prices = _load(record.t, x, force, supply, (head, rod))
    paid = {name: float(each * areas @ ways) for name, areas in prices.items()}
    used = None if ledger is None else ledger[f"{cylinder}.drawn"].energy
    retained = supply * float(_squeezed(rig, record.at([0, -1]), item, x[[0, -1]]).sum())
    back, against, beyond = abs(ways[0] - ways[1]) <= SETTINGS.closed * max(ways), "", ()
    if ledger is not None:
        against, beyond = _beyond(rig, record, item, x, prices, each, ways, ledger)
    return Bounds(
        cylinder=cylinder,
        travel_out=ways[0],
        travel_in=ways[1],
        closed=back and abs(retained) <= SETTINGS.oil * paid["standard"],
        retained=retained,
        carries=carries,
        standard=paid["standard"],
        six=paid["six"],
        seventh=paid.get("seventh"),
        work=work,
        used=used,
        saving=None if used is None else 1.0 - used / paid["standard"],
        against=against,
        beyond=beyond,
    )


def _load(
    t: np.ndarray, x: np.ndarray, force: np.ndarray, supply: float, areas: tuple[float, float]
) -> tuple[str, float, dict[str, tuple[float, float]]]:
    """What a motion x [m] under a force of the pressures [N] worked against: (the chamber that
    carries the load, or none; the work of lifting it [J]; oil for a metre (out, in) [m²] by each
    bound, the seventh where the supply [Pa] carries the load on the area difference)."""
    head, rod = areas
    steps, middle = np.diff(x), 0.5 * (force[1:] + force[:-1])
    mean = float(np.trapezoid(force, t) / (t[-1] - t[0]))
    work = float((middle * steps)[middle * steps > 0.0].sum())
    lifting = force[:-1][steps > 0.0]
    carries = "none"
    if abs(mean) > SETTINGS.loaded * supply * head:
        carries = "head" if mean > 0.0 else "rod"
    six = {"head": (head, 0.0), "rod": (head - rod, rod), "none": (head, rod)}
    prices = {"standard": (head, rod), "six": six[carries]}
    light = lifting.size > 0 and float(np.median(lifting)) < supply * (head - rod)
    if head > rod and light and carries != "rod":
        prices["seventh"] = (head - rod, 0.0 if carries == "head" else rod)
    return carries, work, prices


def _beyond(
    rig: Rig,
    record: Record,
    item: Cylinder,
    x: np.ndarray,
    prices: dict[str, tuple[float, float]],
    supply: np.ndarray,
    ways: tuple[float, float],
    ledger: Ledger,
) -> tuple[str, tuple[Beyond, ...]]:
    """(the least bound that the working functions at work can reach, what each of them drew against
    its share of ``ways`` [m] by that bound); nothing where none is logged."""
    if (function := function_of(record, item.name)) is None:
        return "", ()
    at_work = {FUNCTIONS[f] for f in np.unique(function)}
    regains = any(name.endswith("overrunning_regeneration") for name in at_work)
    lifts = FUNCTIONS[EXTEND_RESISTIVE_REGENERATION] in at_work and "seventh" in prices
    against = "seventh" if lifts else "six" if regains else "standard"
    price = supply * prices[against]
    squeezed, drawn = _squeezed(rig, record, item, x), ledger.functions[item.name]
    turns = np.flatnonzero(np.diff(function, prepend=-1))
    net, whose = np.add.reduceat(np.diff(x), turns), function[turns]
    shares = []
    for sign, way in zip((1.0, -1.0), ways, strict=True):
        gone = np.maximum(sign * net, 0.0)
        shares.append(gone * (way / gone.sum() if gone.sum() > 0.0 else 0.0))
    results = []
    for f in np.unique(function):
        out, back = (float(share[whose == f].sum()) for share in shares)
        energy = drawn[FUNCTIONS[f]].get(f"{item.name}.drawn", 0.0)
        pressed = float(rig.supply.pressure) * float(squeezed[function == f].sum())
        results.append(
            Beyond(FUNCTIONS[f], out - back, energy, price[0] * out + price[1] * back, pressed)
        )
    return against, tuple(results)


def _squeezed(rig: Rig, record: Record, item: Cylinder, x: np.ndarray) -> np.ndarray:
    """Compressed volume of both chambers [m³] from sample to sample, ``∫ V/β dp``."""
    areas, dead = item.areas(), (float(item.volume_head), float(item.volume_rod))
    oil = oil_fields(rig, item.bulk_modulus)
    squeezed = np.zeros(x.size - 1)
    for key, area, volume, sign in zip(("p_head", "p_rod"), areas, dead, (1.0, -1.0), strict=True):
        fixed, p = volume + sign * area * x, record[f"{item.name}.{key}"]
        stiffness = oil["bulk_modulus"]
        if oil["air"]:
            stiffness = np.array([bulk(at, *oil.values()) for at in 0.5 * (p[1:] + p[:-1])])
        squeezed += 0.5 * (fixed[1:] + fixed[:-1]) * np.diff(p) / stiffness
    return squeezed
