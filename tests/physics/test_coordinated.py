"""Several cylinders at once: what laws count on; one compiled call runs them as ticks do."""

import numpy as np
import pytest

from ehbench import workflow
from ehbench.config.recipe import TrialRecipe
from ehbench.control.coupling import among_others, joint_motion, loads_among
from ehbench.parts.cylinder import joint_of, joint_range_of, linkage_of
from ehbench.physics.arm import bias_turned, energy, mass_matrix, turn, work_size
from ehbench.physics.tip import FOUND, Chain, polish, reach, tip_frames, tip_jacobian, tip_of
from ehbench.plant.model import Model
from ehbench.report.terminal import answer
from ehbench.runs.rundir import read_json
from ehbench.trial import prepare, run
from ehbench.trial.coordination import COORDINATION, joints_of
from ehbench.vocabulary.errors import InputError
from tests.shared import RECIPES, refused, shipped

ARM = shipped("thesis_arm")
TICK = 1e-3


def move(cylinder, start, end, **given):
    motion = {"kind": "point_to_point", "cylinder": cylinder, "waypoints": [start, end]}
    return motion | {"hold": "0.1 s", "speed": "80 mm/s"} | given


THREE = move("boom", "80 mm", "110 mm") | {
    "also": [move("swing", "100 mm", "140 mm"), move("stick", "180 mm", "150 mm")]
}


def trial(folder, motion=THREE, controller=None, **given):
    (folder / "trial.toml").write_text("# the recipe\n")
    given |= {"path": folder / "trial.toml", "motion": motion}
    given |= {"controller": controller or {"kind": "arc"}}
    return TrialRecipe(stage="trial", rig="x.toml", **given)


TWO = THREE | {"also": THREE["also"][:1]}
MIXED = {"kind": "arc", "cylinders": {"swing": {"kind": "position"}}}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("motion", "controller", "limits"),
    [(THREE, {"kind": "arc"}, {}), (TWO, MIXED, {"speed_max": "70 mm/s"})],
    ids=["free", "stopped"],
)
def test_the_compiled_path_of_several_cylinders_is_the_path_tick_by_tick(
    motion, controller, limits, tmp_path
):
    prepared = prepare(trial(tmp_path, motion, controller, limits=limits), ARM)
    many, one = run(prepared), run(prepared, fast=False)
    assert list(many.record.channels) == list(one.record.channels)
    for name, values in many.record.channels.items():
        assert np.array_equal(values, one.record[name]), name
    assert many.facts == one.facts and bool(many.facts.stopped) == bool(limits)
    assert set(many.facts.measures["also"]) == {one["cylinder"] for one in motion["also"]}
    assert ("swing.v_asked" in many.record) == (controller is MIXED)
    assert "boom.payload_estimate" in many.record


def test_what_the_others_add_is_what_the_mechanism_asks_for(tmp_path):
    """The load's gravity and mass together are the whole torque of the equations of motion, but for
    joint damping."""
    prepared = prepare(trial(tmp_path), ARM)
    part = prepared.loop.laws[0]
    axis = part.controller.axis
    n, rng = 3, np.random.default_rng(1)
    links, gravity = axis.mechanism.links, axis.mechanism.gravity
    q, qd, qdd = axis.mechanism.posture.copy(), *rng.uniform(-1.0, 1.0, (2, n))
    row = np.concatenate([np.zeros(4), qd, qdd, qd, qdd])
    work, mass = np.zeros(work_size(n) + n), np.zeros((n, n))
    j = int(axis.cylinder.joint)
    now, _ = loads_among(row, q[j], 0.0, 0.0, axis, q.copy(), mass, work)
    _, lever, curve = linkage_of(axis.cylinder, q[j])
    torque, full = np.zeros(n), np.zeros((n, n))
    turn(links, q, work)
    bias_turned(axis.mechanism.kind, links, gravity, qd, torque, work)
    mass_matrix(axis.mechanism.kind, links, q, full, work)
    wanted = torque[j] + full[j] @ qdd - links[j].damping * qd[j]
    a = lever * qdd[j] + curve * qd[j] ** 2
    kappa = now.curve * (lever * qd[j]) ** 2
    assert (now.gravity + now.mass * (a - kappa)) * lever == pytest.approx(wanted, rel=1e-12)


def test_the_joints_move_as_their_strokes_do(tmp_path):
    """Within what central differences leave where the jerk has a kink."""
    prepared = prepare(trial(tmp_path), ARM)
    for one in prepared.loop.driven:
        table, row = one.references.table, one.design.row
        q = joint_of(row, table[:, 0])
        motion = joint_motion(row, q, table)
        for order, values in enumerate([q, *motion.T[:2]]):
            slope = np.gradient(values, TICK)[2:-2]
            scale = np.abs(motion[:, order]).max()
            assert np.abs(slope - motion[2:-2, order]).max() < 2e-2 * scale
    assert among_others(table, np.zeros((3, len(table), 3)), TICK).shape == (len(table), 16)


@pytest.mark.slow
def test_coupling_makes_the_boom_track_better_while_others_move(tmp_path):
    errors = {}
    for coupling in (True, False):
        recipe = trial(tmp_path, controller={"kind": "arc", "coupling": coupling})
        errors[coupling] = run(prepare(recipe, ARM)).facts.measures["tracking"]["rms_error"]
    assert errors[True] < 0.8 * errors[False]


# --- a path of the tip, and the pump's flow

POINTS = [["1.10 m", "-0.40 m", "-0.40 m"], ["1.50 m", "0.50 m", "-0.10 m"]]


def path(points=POINTS, **given):
    motion = {"kind": "path", "points": points, "hold": "0.1 s", "speed": "300 mm/s"}
    return motion | given


FAST = path(speed="1.6 m/s", acceleration="5 m/s^2", jerk="100 m/s^3")


def tip_planned(prepared):
    """The tip by forward kinematics of the strokes that the cylinders shall make."""
    q, _ = joints_of(prepared.loop.driven)
    return tip_of(prepared.loop.plan.chain, q)


def off_the_line(tip, points=POINTS):
    first, last = (np.array([float(one.split()[0]) for one in point]) for point in points)
    way = (last - first) / np.linalg.norm(last - first)
    return np.linalg.norm(np.cross(tip - first, way), axis=1).max()


@pytest.mark.parametrize("motion", [path(), FAST], ids=["slow", "slowed down"])
def test_the_strokes_of_a_path_bring_the_tip_along_its_line(motion, tmp_path):
    prepared = prepare(trial(tmp_path, motion), ARM)
    tip = tip_planned(prepared)
    assert off_the_line(tip) < 1e-5
    assert np.abs(tip[[0, -1]] - np.array([[1.1, -0.4, -0.4], [1.5, 0.5, -0.1]])).max() < 1e-5
    assert np.abs(tip - prepared.loop.plan.tip).max() < 1e-5
    for one in prepared.loop.driven:
        table = one.references.table
        for order, least in enumerate((1e-3, 1e-3, 2e-2)):
            slope = np.gradient(table[:, order], TICK)[3:-3]
            most = least * np.abs(table[:, order + 1]).max()
            # each column is the slope of the one before
            assert np.abs(slope - table[3:-3, order + 1]).max() < most


def test_where_the_pump_has_not_enough_time_runs_slower_and_no_more(tmp_path):
    plan = prepare(trial(tmp_path, FAST), ARM).loop.plan
    limit = float(ARM.supply.flow_limit)
    assert plan.required.max() > limit and plan.limit == limit
    planned, given = plan.required * plan.pace, (1.0 - COORDINATION.reserve) * limit
    assert 0.97 * given < planned.max() <= given * (1.0 + 1e-6), "hardly less than it must be"
    assert plan.longer > 0.1 and plan.pace[[0, -1]] == pytest.approx(1.0)
    free = prepare(trial(tmp_path, FAST | {"share_flow": False}), ARM).loop.plan
    assert (free.pace == 1.0).all() and free.longer == 0.0
    assert prepare(trial(tmp_path, path()), ARM).loop.plan.pace.min() == 1.0


def test_speeds_of_single_motions_are_cut_in_one_proportion(tmp_path):
    """Each cylinder ends where it should, and at every moment all run at the same share."""
    fast = {"speed": "500 mm/s", "acceleration": "4 m/s^2"}
    motion = move("boom", "60 mm", "200 mm", **fast)
    others = (("stick", "250 mm", "80 mm"), ("swing", "60 mm", "200 mm"))
    motion["also"] = [move(*other, **fast) for other in others]
    both = (trial(tmp_path, motion | {"share_flow": share}) for share in (True, False))
    shared, free = (prepare(recipe, ARM).loop for recipe in both)
    assert shared.plan.pace.min() < 0.8
    for one, other in zip(shared.driven, free.driven, strict=True):
        table, desired = one.references.table, other.references.table
        assert table[-1, 0] == pytest.approx(desired[-1, 0], abs=1e-9)
        assert np.abs(table[:, 1]).max() < 0.95 * np.abs(desired[:, 1]).max()


def test_with_the_pump_limit_met_the_tip_keeps_to_its_line(tmp_path):
    """Slowed down, the supply holds its pressure; as desired, it does not."""
    recipes = {share: trial(tmp_path, FAST | {"share_flow": share}) for share in (True, False)}
    results = {share: run(prepare(recipe, ARM)) for share, recipe in recipes.items()}
    held, lost = (results[share].record["p_supply"].min() for share in (True, False))
    full = float(ARM.supply.pressure)
    assert held > 0.98 * full and lost < 0.9 * full
    tips = {share: results[share].facts.measures["tip"] for share in (True, False)}
    assert tips[True]["max_error"] < tips[False]["max_error"]
    sharing = results[True].facts.measures["sharing"]
    assert sharing["slowed"] > 0.2 and sharing["pace"] < 0.9 and sharing["longer"] > 0.1
    said = {share: {n.key: n for n in results[share].facts.warnings} for share in results}
    assert "trial.slowed" not in said[False]
    assert said[True]["trial.slowed"].fields["longer"] == sharing["longer"]
    record = results[True].record
    gone = np.column_stack([record[f"tip_{way}"] for way in "xyz"])
    assert off_the_line(gone) == pytest.approx(tips[True]["max_across"], rel=1e-2)


@pytest.mark.parametrize(
    ("points", "said"),
    [
        ([["3 m", "0 m", "0 m"], ["1.5 m", "0 m", "0 m"]], "point 1, (3, 0, 0) m, is out of reach"),
        ([["1.2 m", "0 m", "-0.4 m"], ["1.2 m", "1.3 m", "-0.4 m"]], "'swing' at its 279.4 mm end"),
        ([["1.2 m", "0 m", "-0.4 m"], ["0 m", "0 m", "-0.4 m"]], "point 2, (0, 0, -0.4) m"),
        ([["1.2 m", "0 m", "-0.4 m"], ["1.2 m", "0 m", "-0.4 m"]], "point 2 of the path is where"),
        ([["10 ft", "0 ft", "0 ft"], ["5 ft", "0 ft", "0 ft"]], "point 1, (10, 0, 0) ft, is out"),
    ],
)
def test_a_point_out_of_reach_is_refused_with_its_reason(points, said, tmp_path):
    with pytest.raises(InputError) as refused:
        prepare(trial(tmp_path, path(points)), ARM)
    assert said in refused.value.message


LINE = path([["0.1 m", "0 m", "0 m"], ["0.2 m", "0 m", "0 m"]])
SWING = {"kind": "arc", "cylinders": {"swing": {"kind": "arc"}}}


@pytest.mark.parametrize(
    ("rig", "controller", "motion", "key"),
    [
        ("thesis_arm", {"class": "mine:Mine"}, path(), "trial.class_moves_one"),
        ("thesis_arm", {"kind": "arc"}, path(cylinders=["bucket"]), "config.no_cylinder"),
        ("slide_servo", SWING, LINE, "trial.law_without_motion"),
    ],
)
def test_what_a_controller_says_must_fit_the_cylinders(rig, controller, motion, key, tmp_path):
    with refused(key):
        prepare(trial(tmp_path, motion, controller), shipped(rig), allow_code=True)


@pytest.mark.parametrize(
    ("motion", "said"),
    [
        (THREE | {"also": [move("boom", "1 mm", "2 mm")]}, "has two motions at a time"),
        (THREE | {"cylinder": None}, "names its 'cylinder'"),
        (path() | {"also": THREE["also"]}, "omit 'cylinder' and 'also'"),
        (path(points=POINTS[:1]), "needs 'points', two or more"),
    ],
)
def test_a_motion_that_makes_no_sense_is_refused(motion, said, tmp_path):
    with pytest.raises(ValueError, match=said):
        trial(tmp_path, motion)


def test_one_joint_follows_no_line_and_a_slide_follows_its_own(tmp_path):
    crane = shipped("crane_proportional")
    with refused("trial.out_of_reach") as caught:
        upright = path([["3.4 m", "0 m", "-0.6 m"], ["3.4 m", "0 m", "0.4 m"]])
        prepare(trial(tmp_path, upright), crane)
    assert caught.value.fields["reason"].key == "trial.one_line"
    slide = shipped("slide_servo")
    (press,) = prepare(trial(tmp_path, LINE), slide).loop.driven
    assert press.references.table[[0, -1], 0] == pytest.approx([0.1, 0.2], abs=1e-9)


RECIPE = """
stage = "trial"
title = "A short line"
rig = "{rig}"

[motion]
kind = "path"
points = [["1.40 m", "-0.10 m", "-0.30 m"], ["1.45 m", "0.00 m", "-0.25 m"]]
hold = "0.1 s"
speed = "1.6 m/s"
acceleration = "8 m/s^2"

[controller]
kind = "arc"
[controller.cylinders.stick]
kind = "position"
"""


@pytest.fixture
def tip_alone(monkeypatch):
    """Of the figures of a run that of the tip alone is painted."""
    from matplotlib.text import Text

    from ehbench.report import style

    paint = style.painted

    def painted(page):
        words = [text.get_text() for text in page.figure.findobj(Text)]
        return paint(page) if any("From above" in word for word in words) else ""

    monkeypatch.setattr(style, "painted", painted)


def test_a_run_tells_and_draws_the_tip(tmp_path, tip_alone):
    """From the recipe to figure, caption and table, all by saved files."""
    file = tmp_path / "short.toml"
    file.write_text(RECIPE.format(rig=RECIPES / "rigs" / "thesis_arm.toml"))
    outcome = workflow.run(file, workflow.Session(root=tmp_path / "reports"))
    facts = outcome.json("trial")
    assert facts["cylinder"] == "swing" and set(facts["measures"]["also"]) == {"boom", "stick"}
    tip = facts["measures"]["tip"]
    assert 0.0 < tip["rms_error"] < tip["max_error"] < 0.02
    index = read_json(outcome.folder / "figures" / "index.json")["figures"]
    figures = {one["about"]["kind"]: one for one in index}
    assert "the tip: largest error" in figures["tip"]["caption"].lower()
    drawn = (outcome.folder / "figures" / figures["tip"]["file"]).read_text()
    assert all(word in drawn for word in ("From above", "travelled", "the pump's limit", "stick"))
    said = "\n".join(answer(outcome.folder).lines(120, whole=True))
    assert "largest tip error" in said and "arc, boom" in said and "position, stick" in said


# --- the tip of a mechanism, and the search for joint coordinates that bring it somewhere

NAMES = ("thesis_arm", "crane_proportional", "boom_four_valve", "slide_servo")


def chain_of(name):
    plant = Model.of(shipped(name)).plant
    low, high = np.array([sorted(joint_range_of(row)) for row in plant.cylinders]).T
    return Chain(plant.kind, plant.links, plant.gravity, low, high)


@pytest.fixture(scope="module", params=NAMES)
def chain(request):
    return chain_of(request.param)


def postures(chain, count, seed=1):
    share = np.random.default_rng(seed).uniform(0.05, 0.95, (count, chain.low.size))
    return chain.low + share * (chain.high - chain.low)


def test_the_jacobian_is_the_slope_of_the_tip(chain):
    for q in postures(chain, 5):
        for j, column in enumerate(tip_jacobian(chain, tip_frames(chain, q)).T):
            step = 1e-6 * np.eye(q.size)[j]
            slope = (tip_of(chain, q + step) - tip_of(chain, q - step)) / 2e-6
            assert np.abs(slope - column).max() < 1e-8


def test_the_tip_is_as_high_as_a_mass_there_weighs():
    """By the potential energy of the equations of motion, of 1 kg at the end of the last link."""
    from ehbench.control.axis import _tip

    for name in NAMES:
        chain = chain_of(name)
        tip, n = _tip(chain.kind, chain.links), chain.low.size
        g, work = np.linalg.norm(chain.gravity), np.zeros(work_size(n))
        for q in postures(chain, 3):
            _, potential = energy(chain.kind, tip, chain.gravity, q, np.zeros(n), work)
            assert tip_of(chain, q)[2] == pytest.approx(potential / g, abs=1e-12)


def test_what_forward_kinematics_reach_is_found_again(chain):
    free = np.ones(chain.low.size, bool)
    middle = 0.5 * (chain.low + chain.high)
    for q in postures(chain, 20):
        found = reach(chain, tip_of(chain, q), middle, free)
        assert found.there and found.miss <= FOUND and not found.beyond.any()
        assert np.abs(found.q - q).max() < 1e-6, "within the strokes there is one posture"
    free, q = np.ones(chain.low.size, bool), postures(chain, 10)
    found, miss = polish(chain, tip_of(chain, q), q + 1e-2 * (chain.high - chain.low), free)
    assert miss.max() <= FOUND and np.abs(found - q).max() < 1e-6


def test_six_joints_find_their_tip_and_stay_near_where_they_were():
    links = np.concatenate([chain_of("thesis_arm").links] * 2).view(np.recarray)
    wide = np.full(6, 2.0)
    chain = Chain(0, links, np.array([0.0, 0.0, 9.8]), -wide, wide)
    q = np.random.default_rng(2).uniform(-0.8, 0.8, 6)
    target = tip_of(chain, q) + (0.01, -0.01, 0.01)
    found = reach(chain, target, q, np.ones(6, bool))
    assert found.there and np.linalg.norm(tip_of(chain, found.q) - target) <= FOUND
    assert np.abs(found.q - q).max() < 0.1


def test_out_of_reach_it_comes_as_near_as_it_can():
    chain = chain_of("thesis_arm")
    middle, free = 0.5 * (chain.low + chain.high), np.ones(3, bool)
    far = np.array([5.0, 0.0, 0.5])
    found = reach(chain, far, middle, free)
    assert not found.there
    grid = [np.linspace(a, b, 25) for a, b in zip(chain.low, chain.high)]
    places = tip_of(chain, np.stack(np.meshgrid(*grid), -1).reshape(-1, 3))
    nearest = np.linalg.norm(places - far, axis=1).min()
    assert found.miss == pytest.approx(nearest, abs=2e-2) and found.miss <= nearest
    held = reach(chain, tip_of(chain, chain.low), middle, np.array([False, True, True]))
    assert not held.there and held.q[0] == middle[0]
