"""Tuning on supplies that follow the load: points, linear models, promises kept."""

from functools import cache

import numpy as np
import pytest
from delayed_loop import Bench
from plant_differences import plant_model, points, steady_rates
from test_tuned_damping import damped, damped_as_promised

from ehbench.config.recipe import ArcTuneRecipe, TuneRecipe
from ehbench.config.rig import LoadSensing, LowRail
from ehbench.control import functions as fn
from ehbench.control.measured import Pressures
from ehbench.parts.supply import beside_change, from_rail
from ehbench.plant.derivatives import derivatives
from ehbench.plant.design_point import circuit_of
from ehbench.plant.model import Model
from ehbench.trial import prepare, run
from ehbench.tune.arc import tune_arc
from ehbench.tune.arc_loop import SampledPlant, Sensing
from ehbench.tune.gains import tune_pressure_feedback
from ehbench.tune.linear import development_model
from ehbench.tune.operating_point import state_of
from ehbench.tune.study import prepare_tuning
from ehbench.vocabulary.fields import Value
from tests.shared import cycle, refused, shipped

FOLLOWING = ("load sensing", "two rails")
LAG = 0.05
OFF = "5e-11 m^3/(s*Pa)"
CYLINDERS = {"thesis_arm": "boom", "boom_four_valve": "boom", "crane_proportional": "lift"}
CYLINDERS |= {"slide_servo": "press"}


@cache
def rig_on(kind, name, rail=0.35):
    """A shipped rig on another supply; ``rail`` as a share of its highest pressure."""
    rig = shipped(name)
    most = float(rig.supply.pressure)
    if kind == "load sensing":
        margin = Value(0.1 * most)
        return rig.with_supply(load_sensing=LoadSensing(load_margin=margin, load_lag=Value(LAG)))
    rail, margin = Value(rail * most), Value(0.05 * most)
    return rig.with_supply(low_rail=LowRail(rail_pressure=rail, rail_margin=margin))


def steady(rig, cylinder, strokes=(0.15, 0.85)):
    """(model, point) of every steady motion that the load calls for."""
    for payload in (None, *rig.payload):
        model = Model.of(rig, None, payload)
        index = model.layout.cylinders.index(cylinder)
        for point in points(model, index, circuit_of(model, index), (0.5,), strokes):
            if point.fits:
                yield model, point


@pytest.mark.parametrize("name", CYLINDERS)
@pytest.mark.parametrize("kind", FOLLOWING)
def test_equations_agree_with_differences_about_a_steady_motion(kind, name):
    """States at rest, and matrices to 1e-7 of a row: differences are good to 1e-8."""
    count = 0
    for model, point in steady(rig_on(kind, name), CYLINDERS[name]):
        rate = steady_rates(model, point)
        assert abs(rate[model.plant.at.supply]) < 1e-6 * point.p_supply / LAG, point.name
        ours, theirs = development_model(model, point), plant_model(model, point)
        assert ours.states == theirs.states
        size = np.array([1e6 if "p_" in s else 100.0 if "rate" in s else 1.0 for s in ours.states])
        a, b = (one.a * size / size[:, None] for one in (ours, theirs))
        assert (np.abs(a - b) <= 1e-7 * np.abs(a).max(axis=1, keepdims=True)).all(), point.name
        count += 1
    assert count >= 4


def test_the_supply_stands_a_margin_above_what_it_feeds():
    """Up to its highest pressure; where it feeds nothing, above tank."""
    rig = rig_on("load sensing", "thesis_arm")
    most, margin = float(rig.supply.pressure), 0.1 * float(rig.supply.pressure)
    for model, point in steady(rig, "boom"):
        load = {fn.SUPPLY_HEAD: point.p_head, fn.SUPPLY_ROD: point.p_rod}
        felt = [load[path.path] for path in point.paths if path.path in load] or [point.p_tank]
        assert point.p_supply == pytest.approx(min(felt[0] + margin, most))
        follows = felt[0] > point.p_tank and point.p_supply < most
        assert ("p_supply" in development_model(model, point).states) is follows
    # a margin that leaves hardly any range
    high = rig.with_supply(load_sensing=LoadSensing(load_margin=Value(0.95 * most)))
    ends = [point.p_supply for _, point in steady(high, "boom", strokes=(0.5,))]
    assert max(ends) == most and all(end <= most for end in ends)


def test_each_point_takes_from_the_rail_that_is_enough_or_is_told():
    rig = rig_on("two rails", "thesis_arm")
    most = float(rig.supply.pressure)
    rail, taken = 0.35 * most, set()
    for _, point in steady(rig, "boom"):
        assert point.p_supply == most
        for path in point.paths:
            if path.path in (fn.SUPPLY_HEAD, fn.SUPPLY_ROD):
                chamber = point.p_head if path.path == fn.SUPPLY_HEAD else point.p_rod
                low = chamber + 0.05 * most <= rail
                assert path.drop == pytest.approx((rail if low else most) - chamber)
                taken.add(low)
    assert taken == {True, False}
    # The boom's head end carries the bucket at 40 bar: 8 bar below the change, or 32
    notes = {}
    for rail in (0.35, 0.5):
        about = {"postures": 1, "payloads": ("bucket",), "functions": ("extend_resistive",)}
        recipe = TuneRecipe(stage="tune", rig="x", **about)
        rig = rig_on("two rails", "boom_four_valve", rail)
        study = prepare_tuning(rig, None, recipe)
        notes[rail] = [note.fields for note in study.notes if note.key == "tune.near_rail"]
    assert notes[0.35] == [{"near": 2, "points": 2}]
    assert notes[0.5] == []


def test_what_valves_are_opened_by_has_no_kink_at_the_steady_motion():
    """The measured pressure, as long as half its margin is there; below, that half."""
    rig = rig_on("load sensing", "slide_servo")
    model, margin = Model.of(rig), 0.1 * float(rig.supply.pressure)
    circuit, head = circuit_of(model, 0), 3e6
    for there, drop in ((margin, margin), (0.6 * margin, 0.6 * margin), (-1e6, 0.5 * margin)):
        at = Pressures(head, 1e6, head + there, 0.0)
        assert fn.metering_drop(fn.SUPPLY_HEAD, at, circuit) == pytest.approx(drop)
        assert fn.path_drop(fn.SUPPLY_HEAD, at, circuit) == pytest.approx(margin)


def test_what_others_hold_is_felt_where_they_move_as_well():
    """The pressure is theirs and the margin where it is higher; the sampled plant holds it."""
    rig = rig_on("load sensing", "thesis_arm")
    margin = 0.1 * float(rig.supply.pressure)
    about = {"cylinder": "stick", "payloads": ("50 lb",), "postures": 2, "also_moving": ("boom",)}
    recipe = TuneRecipe(stage="tune", rig="x", **about)
    study = prepare_tuning(rig, None, recipe)
    model = Model.of(rig, None, "50 lb")
    low = float(rig.supply.tank_pressure) + study.low
    y = model.trim(model.posture({}), low)
    held = max(y[model.layout.state(key, 1)] for key in ("p_head", "p_rod"))
    theirs = 0
    for site in study.motions:
        point = site.point
        assert point.p_supply >= held + margin - 1.0
        if point.p_supply < held + margin + 1.0:
            theirs += 1
            assert "p_supply" not in site.linear.states
            assert SampledPlant.of(site.model, point, 1e-3).plant.a[model.plant.at.supply].any()
            rate = np.empty(model.layout.states)
            y, command = state_of(site.model, point)
            derivatives(y, command, site.model.plant, rate, np.empty(model.plant.at.work))
            assert rate[model.plant.at.supply] == pytest.approx(0.0, abs=1.0)
    assert 0 < theirs
    alone = recipe.model_copy(update={"also_moving": ()})
    without = prepare_tuning(rig, None, alone)
    assert min(site.point.p_supply for site in without.motions) < held + 0.9 * margin
    with refused("tune.tuned_also_moving"):
        prepare_tuning(rig, None, recipe.model_copy(update={"also_moving": ("stick",)}))


@pytest.mark.parametrize(
    ("kind", "name"), [("load sensing", "slide_servo"), ("two rails", "boom_four_valve")]
)
def test_the_running_machine_is_damped_as_promised(kind, name, unlocused):
    """Within 15 %, as on constant pressure: see `test_tuned_damping`."""
    rig = rig_on(kind, name)
    load = next(iter(rig.payload))
    recipe = damped(CYLINDERS[name], (load,), 2, (0.5,), washout="5 rad/s", off_gain=OFF)
    tuning = tune_pressure_feedback(prepare_tuning(rig, None, recipe))
    assert tuning.supply["kind"] == kind
    tried = sum(damped_as_promised(rig, tuning, result) for result in tuning.points)
    assert tried >= 4


@pytest.mark.parametrize(
    ("kind", "name"), [("load sensing", "crane_proportional"), ("two rails", "boom_four_valve")]
)
def test_the_delay_margin_is_where_the_model_begins_to_swing(kind, name):
    """Of adaptive robust control, within 20 %, at the point with the least margin."""
    rig = rig_on(kind, name)
    loads = (next(iter(rig.payload)),)
    rig = Bench(rig, CYLINDERS[name], postures=1, shares=(0.06,), payloads=loads)
    gains = rig.gains()
    margins, worst = rig.worst(gains)
    assert margins.delay > 0.0
    assert rig.onset(worst, gains) == pytest.approx(margins.delay, rel=0.2), worst.point.name


def test_load_sensing_costs_gain_margin_on_a_stiff_rig():
    """A tenth below the margin nothing swings, a fifth above it does: valves by measured drop."""
    rig = Bench(rig_on("load sensing", "slide_servo"), "press", postures=2, shares=(0.06,))
    gains = rig.gains(drop_corner=0.0)
    (margin, *_), worst = rig.worst(gains, "gain")
    assert 1.3 < margin < 3.0
    assert not rig.grows(worst, gains, 0.0, louder=0.9 * margin)
    assert rig.grows(worst, gains, 0.0, louder=1.2 * margin)


@pytest.mark.parametrize("name", ["crane_proportional", "slide_servo", "boom_four_valve"])
@pytest.mark.parametrize("kind", FOLLOWING)
def test_defaults_keep_their_gain_margin_where_drops_are_small_and_their_tracking(kind, name):
    """At least that on constant pressure, and 2; by the measured drop it is less."""

    def margins(rig, **given):
        loads = (next(iter(rig.payload)),)
        bench = Bench(rig, CYLINDERS[name], postures=2, shares=(0.7,), payloads=loads)
        gains = bench.gains(**given)
        found = [bench.loop(at, gains).margins(Sensing()) for at in bench.points]
        return min(one.gain for one in found), min(one.delay for one in found)

    constant, following = shipped(name), rig_on(kind, name)
    (usual, _), (kept, late) = margins(constant), margins(following)
    measured, before = margins(following, drop_corner=0.0)
    assert kept > 1.5 * max(usual, 2.0)
    assert measured < usual and kept > 2.0 * measured
    assert late > 0.8 * before
    # What is planned of a change of load counts at once
    measured = followed(kind, name, drop_corner="0 Hz")
    assert followed(kind, name) < 1.05 * measured + 1e-5


@cache
def followed(kind, name, **given):
    """Largest error [m] of a cycle on the model."""
    cylinder, strokes, speed = {
        "crane_proportional": ("lift", ["120 mm", "480 mm", "120 mm"], "40 mm/s"),
        "slide_servo": ("press", ["60 mm", "340 mm", "60 mm"], "150 mm/s"),
        "boom_four_valve": ("boom", ["100 mm", "350 mm", "100 mm"], "70 mm/s"),
    }[name]
    rig = rig_on(kind, name)
    load, move = next(iter(rig.payload)), {"acceleration": "0.4 m/s^2", "jerk": "8 m/s^3"}
    recipe = cycle(cylinder, strokes, speed, gains=given, move=move, payload=load)
    measures = run(prepare(recipe, rig)).facts.measures
    assert measures["limit_cycle"] is None
    return measures["tracking"]["max_error"]


@pytest.mark.parametrize("chamber", [7.9e6, 8.1e6])
def test_a_calm_pressure_is_on_the_rail_that_the_measured_one_is_on(chamber):
    """However far the swing is from the change of rails."""
    rig = rig_on("two rails", "boom_four_valve", 0.55)
    supply = Model.of(rig).plant.supply
    assert float(supply.rail - supply.rail_margin) == pytest.approx(8e6)
    for calm in (6e6, 8e6, 1e7):
        taken = from_rail(beside_change(calm, chamber, supply), supply)
        assert taken == from_rail(chamber, supply) == (chamber < 8e6)


def test_a_bench_has_the_supply_of_its_trial():
    """With a bench file of its own as well."""
    sensing = {"load_sensing": {"load_margin": "16 bar", "load_lag": "50 ms"}}
    rig = shipped("boom_four_valve")
    record = run(prepare(trial("bench", supply=sensing), rig)).record
    assert record["p_supply"].max() < 0.8 * float(rig.supply.pressure)


@cache
def tuned(kind):
    about = {"what": "arc", "postures": 1, "payloads": ("bucket",), "speed_shares": (0.06,)}
    recipe = ArcTuneRecipe(stage="tune", rig="x", **about)
    rig = rig_on(kind, "boom_four_valve", 0.5)
    study = prepare_tuning(rig, None, recipe)
    return tune_arc(study)


def trial(on, delay=0.0, **more):
    given = {"on": on, "bench": "bench/boom_four_valve.toml", "payload": "bucket"}
    given |= {"machine": {"delay": f"{float(delay)!r} s"} if delay else None} | more
    return cycle("boom", ["100 mm", "300 mm", "100 mm"], "80 mm/s", **given)


@pytest.mark.parametrize("on", ["model", "bench"])
@pytest.mark.parametrize("kind", FOLLOWING)
def test_a_tuned_trial_keeps_its_stated_delay_margin(kind, on):
    tuning = tuned(kind)
    assert tuning.delay_margin > 2.0e-3
    recipe = trial(on, tuning.delay_margin)
    gains = tuning.as_json()
    facts = run(prepare(recipe, rig_on(kind, "boom_four_valve", 0.5), gains=gains)).facts
    assert not facts.stopped and facts.measures["limit_cycle"] is None
    assert facts.measures["tracking"]["max_error"] < 3e-3
    assert not any(text.key == "trial.other_supply" for text in facts.warnings)


def test_a_trial_on_another_supply_than_the_tuned_says_so():
    gains, rig = tuned("load sensing").as_json(), rig_on("load sensing", "boom_four_valve", 0.5)

    def notes(rig, gains=gains, **more):
        loop = prepare(trial("model", **more), rig, gains=gains).loop
        assert loop is not None
        return loop.notes

    assert notes(rig) == ()
    # what a rig file rounds is the same supply: 1000 psi are 6.89475729 MPa there
    rounded = gains["supply"] | {"pressure": gains["supply"]["pressure"] * (1.0 + 1e-9)}
    assert notes(rig, gains | {"supply": rounded}) == ()
    wider = {"load_sensing": {"load_margin": "50 bar", "load_lag": "50 ms"}}
    (note,) = notes(rig, supply=wider)
    supply = note.fields["supply"]
    assert supply.startswith("load sensing, pressure 160 bar, load_margin 16 bar (here 50)")
    (note,) = notes(shipped("boom_four_valve"))
    assert note.fields["supply"].fields == {"tuned": "load sensing", "kind": "constant pressure"}


def test_gains_of_another_tick_or_law_or_short_of_their_demands_say_so():
    gains, rig = tuned("load sensing").as_json(), rig_on("load sensing", "boom_four_valve", 0.5)
    feedback = {"cylinder": "boom", "feedback_gain": 1e-11, "washout": 1.0, "low_pressure": 8e5}

    def notes(gains, kind="arc", **more):
        loop = prepare(trial("model", controller={"kind": kind}, **more), rig, gains=gains).loop
        assert loop is not None
        return [(note.key, note.fields) for note in loop.notes]

    assert gains["tick"] == 1e-3 and notes(gains | {"met": True}) == []
    assert notes(gains | {"met": False}) == [("stages.demands_missed", {})]
    slow = ("trial.other_tick", {"tuned": 1.0, "tick": pytest.approx(10.0)})
    assert notes(gains, rate="100 Hz") == [slow]
    for kind, missing in (("pressure_feedback", 0), ("open_loop", 0), ("position", 0), ("arc", 2)):
        found = notes(feedback, kind)
        assert len(found) == bool(missing)
        for key, fields in found:
            assert key == "trial.other_law" and fields["lost"] == "feedback_gain, washout"
    ((key, fields),) = notes(gains, "position")
    assert key == "trial.other_law" and "force_bandwidth" in fields["lost"]
    assert fields["tuned"] == "arc" and "position_bandwidth" not in fields["lost"]
