"""Several cylinders at once: what their laws count on, and that one compiled call runs them as
ticks do.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ehbench.control.coupling import among_others, joint_motion, loads_among
from ehbench.parts.cylinder import joint_of, linkage_of
from ehbench.physics.arm import bias, mass_matrix, work_size
from ehbench.recipe import TrialRecipe, load_rig
from ehbench.trial import prepare, run

RECIPES = Path(__file__).parents[2] / "recipes"
ARM = load_rig(RECIPES / "rigs" / "thesis_arm.toml")
TICK = 1e-3


def move(cylinder, start, end, **given):
    motion = {"kind": "point_to_point", "cylinder": cylinder, "waypoints": [start, end]}
    return motion | {"hold": "0.1 s", "speed": "80 mm/s"} | given


THREE = move("boom", "80 mm", "110 mm") | {
    "also": [move("swing", "100 mm", "140 mm"), move("stick", "180 mm", "150 mm")]
}


def trial(folder, motion=THREE, controller=None, **given):
    (folder / "trial.toml").write_text("# the recipe\n")
    return TrialRecipe(
        stage="trial",
        rig="x.toml",
        path=folder / "trial.toml",
        motion=motion,
        controller=controller or {"kind": "arc"},
        **given,
    )


MIXED = {"kind": "arc", "cylinders": {"swing": {"kind": "position"}}}


@pytest.mark.parametrize("limits", [{}, {"speed_max": "70 mm/s"}], ids=["free", "stopped"])
def test_the_compiled_path_of_three_cylinders_is_the_path_tick_by_tick(limits, tmp_path):
    prepared = prepare(trial(tmp_path, controller=MIXED, limits=limits), ARM)
    many, one = run(prepared), run(prepared, fast=False)
    assert list(many.record.channels) == list(one.record.channels)
    for name, values in many.record.channels.items():
        assert np.array_equal(values, one.record[name]), name
    assert many.facts == one.facts and bool(many.facts.stopped) == bool(limits)
    assert set(many.facts.measures["also"]) == {"swing", "stick"}
    assert "swing.v_asked" in many.record and "boom.payload_estimate" in many.record


def test_what_the_others_add_is_what_the_mechanism_asks_for(tmp_path):
    """The load's gravity and mass together are the whole torque of the equations of motion, but for
    joint damping."""
    prepared = prepare(trial(tmp_path), ARM)
    part = prepared.loop.laws.parts[0]
    axis = part.controller.axis
    n, rng = 3, np.random.default_rng(1)
    links, gravity = axis.mechanism.links, axis.mechanism.gravity
    q, qd, qdd = axis.mechanism.posture.copy(), *rng.uniform(-1.0, 1.0, (2, n))
    row = np.concatenate([np.zeros(4), qd, qdd, qd, qdd])
    work, mass = np.zeros(work_size(n) + n), np.zeros((n, n))
    j = int(axis.cylinder.joint)
    now, _ = loads_among(row, q[j], q[j], 0.0, axis, q.copy(), mass, work)
    _, lever, curve = linkage_of(axis.cylinder, q[j])
    torque, full = np.zeros(n), np.zeros((n, n))
    bias(axis.mechanism.kind, links, gravity, q, qd, torque, work)
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


def test_coupling_makes_the_boom_track_better_while_others_move(tmp_path):
    errors = {}
    for coupling in (True, False):
        recipe = trial(tmp_path, controller={"kind": "arc", "coupling": coupling})
        errors[coupling] = run(prepare(recipe, ARM)).facts.measures["tracking"]["rms_error"]
    assert errors[True] < 0.8 * errors[False]
