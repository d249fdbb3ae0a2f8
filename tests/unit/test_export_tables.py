"""MATLAB files, linear models and mechanisms, read by other programs."""

import io
import math
import re

import numpy as np
import pytest
from scipy.io import loadmat

import ehbench
from ehbench import workflow
from ehbench.config.recipe import load_rig
from ehbench.export.linear import state_spaces
from ehbench.export.mechanism import mjcf, urdf
from ehbench.export.tables import matlab_files
from ehbench.physics import arm
from ehbench.plant.model import Model
from tests.shared import RIGS, shipped

SLIDE = RIGS / "slide_servo.toml"
FITTED = {"bulk_modulus": {"interval": [8.7e8, 9.4e8], "status": "estimated"}}


@pytest.fixture(scope="module")
def slide():
    """Files of the slide, and its linear models."""
    rig = load_rig(SLIDE)
    spaces = state_spaces(rig, None)
    return rig, spaces, matlab_files(rig, FITTED, spaces)


def test_the_script_and_the_mat_file_say_the_rigs_numbers(slide):
    rig, _, files = slide
    script = files["slide_servo_parameters.m"].decode()
    said = dict(re.findall(r"^p\.([\w.]+) = (\S+);", script, re.M))
    known = loadmat(io.BytesIO(files["slide_servo.mat"]), simplify_cells=True)
    for name, value in rig.parameters().items():
        name = name.replace("100 kg", "c100_kg")  # a payload's, as MATLAB takes a name
        inner = known["p"]
        for word in name.split("."):
            inner = inner[word]
        assert float(said[name]) == float(value) == inner
    info = known["info"]
    assert info["bulk_modulus"]["interval"].tolist() == FITTED["bulk_modulus"]["interval"]
    assert info["bulk_modulus"]["unit"] == "Pa" and info["bulk_modulus"]["status"] == "estimated"
    assert np.isnan(info["press"]["stroke"]["interval"]).all()
    (line,) = re.findall(r"^info\.bulk_modulus = (.*);", script, re.M)
    assert "[870000000.0, 940000000.0]" in line and "'unit', 'Pa'" in line
    assert matlab_files(rig, FITTED, slide[1]) == files  # whenever it is written


ODD = """name = "end"
[oil]
bulk_modulus = { value = "750 MPa", source = "said\\nby 'X' */ \\u0007" }
[supply]
pressure = "160 bar"
flow_limit = "80 L/min"
[mechanism]
kind = "chain"
first_axis = "horizontal"
[payload."*/\\n2".world]
mass = "30 kg"
"""
for joint, cylinder in (("world", "gravity"), ("base", "öl-1"), ("hub", "ol_1")):
    ODD += f"""
[[mechanism.joint]]
name = "{joint}"
dh_a = "1 m"
mass = "20 kg"
com = ["-0.5 m", "0 m", "0 m"]
inertia = ["1 kg*m^2", "2 kg*m^2", "2 kg*m^2", "0 kg*m^2", "0 kg*m^2", "0 kg*m^2"]
[[cylinder]]
name = "{cylinder}"
joint = "{joint}"
bore = "40 mm"
rod = "25 mm"
stroke = "0.3 m"
volume_head = "0.2 L"
volume_rod = "0.5 L"
pins = {{ l_a = "1 m", l_b = "0.4 m", retracted_length = "0.8 m", phase = "60 deg" }}
[[cylinder.valve]]
name = "case"
command_min = "0 V"
command_max = "5 V"
edge = [{{ from = "supply", to = "head", law = "orifice", flow_gain = "1 L/min/V/bar^0.5" }}]
"""


def test_names_of_any_kind_stay_apart(tmp_path):
    (tmp_path / "rig.toml").write_text(ODD)
    rig = load_rig(tmp_path / "rig.toml")
    script, file = matlab_files(rig, {}, []).values()
    known = loadmat(io.BytesIO(file), simplify_cells=True)
    places = re.findall(r"^p\.([\w.]+) = .*$", script.decode(), re.M | re.A)
    assert len(places) == len(set(places)) == len(rig.parameters())
    assert all(row.startswith(("%", "p.", "info.")) for row in script.decode().splitlines())
    read = []
    for place in places:
        inner = known["p"]
        for word in place.split("."):
            assert word != "case"  # a word of MATLAB's own
            inner = inner[word]
        read.append((word, inner))
    expected = [(name.rpartition(".")[2], float(v)) for name, v in rig.parameters().items()]
    assert sorted(read) == sorted(expected)
    assert known["info"]["ol_1_2"]["stroke"]["unit"] == "m"
    mujoco = pytest.importorskip("mujoco")
    for write in (urdf, mjcf):
        model = mujoco.MjModel.from_xml_string(write(rig.with_payload("*/\n2")).decode())
        assert model.body_mass.tolist() == [0.0, 30.0, 20.0, 20.0]


def test_a_pump_has_numbers_without_linear_models(tmp_path):
    session = workflow.Session(out=tmp_path / "out", unvalidated=True)
    options = {"formats": ("matlab", "urdf"), "payload": "150 kg"}
    done = workflow.export(RIGS / "pump_cylinder.toml", options, session)
    assert [note.key for note in done.notes] == ["export.no_linear"]
    known = loadmat(done.folder / "matlab" / "pump_cylinder.mat", simplify_cells=True)
    assert known["p"]["lift"]["stroke"] == 0.4 and len(known["linear"]) == 0
    assert '<mass value="500.0"' in (done.folder / "mechanism" / "pump_cylinder.urdf").read_text()


def test_linear_models_are_the_closed_form_of_a_cylinder_on_a_servo_valve(slide):
    """DC gain and poles of ``m v̇ = A1 p1 − A2 p2 − b v``, ``V ṗ/β = Q − A v`` with orifices
    ``Q = g u √Δp`` behind a valve of second order (Merritt), from the numbers of the MAT file."""
    rig, _, files = slide
    known = loadmat(io.BytesIO(files["slide_servo.mat"]), simplify_cells=True)
    gain, beta, mass, b = 2.4e-3 / 60 / 1e3, 9e8, 250.0, 800.0  # flow in m³/s, at √Pa
    a1, a2 = 0.25 * math.pi * 0.05**2, 0.25 * math.pi * (0.05**2 - 0.028**2)
    checked = 0
    for item in known["linear"]:
        if "extend_resistive, none" not in item["name"] or "regen" in item["name"]:
            continue
        at, checked = item["at"], checked + 1
        v1, v2 = 150e-6 + a1 * at["x"], 700e-6 - a2 * at["x"]
        drops = 14e6 - at["p_head"], at["p_rod"] - 2e5
        u = a1 * at["v"] / (gain * math.sqrt(drops[0]))
        # the law's root is smooth at no drop: 4e-6 off at these
        assert a2 * at["v"] == pytest.approx(gain * u * math.sqrt(drops[1]), rel=1e-4)
        k = [gain * math.sqrt(drop) for drop in drops]
        c = [0.5 * gain * u / math.sqrt(drop) for drop in drops]
        w, z = 2.0 * math.pi * 80.0, 0.8
        a = np.array(
            [
                [-b / mass, a1 / mass, -a2 / mass, 0, 0],
                [-a1 * beta / v1, -c[0] * beta / v1, 0, k[0] * beta / v1, 0],
                [a2 * beta / v2, 0, -c[1] * beta / v2, -k[1] * beta / v2, 0],
                [0, 0, 0, 0, 1],
                [0, 0, 0, -(w**2), -2 * z * w],
            ]
        )
        expected = np.sort_complex(np.linalg.eigvals(a))
        assert np.sort_complex(np.linalg.eigvals(item["A"])) == pytest.approx(expected, rel=1e-4)
        inputs = np.column_stack([[0, 0, 0, 0, w**2], [1 / mass, 0, 0, 0, 0]])
        dc = -np.eye(5)[:3] @ np.linalg.solve(a, inputs)
        # per volt of full command and per newton of full load, in shares of full scale
        scale = np.outer([0.3, 14e6, 14e6], [0.1, 1.0 / (14e6 * a1)])
        found = -item["C"] @ np.linalg.solve(item["A"], item["B"])
        assert found / scale == pytest.approx(dc / scale, rel=0, abs=1e-4)
    assert checked == 10


def test_python_control_has_the_same_models(slide):
    models = ehbench.linear_models(SLIDE)
    assert len(models) == len(slide[1]) == 80
    for space in slide[1]:
        model = models[space.name]
        assert np.array_equal(model.A, space.a) and np.array_equal(model.B, space.b)
        assert model.input_labels == ["press_servo", "press_force"]


@pytest.mark.parametrize("write", [urdf, mjcf])
@pytest.mark.parametrize(
    ("name", "payload"),
    [("thesis_arm", None), ("thesis_arm", "50 lb"), ("crane_proportional", None),
     ("slide_servo", "100 kg")],
)  # fmt: skip
def test_mujoco_weighs_the_mechanism_alike(name, payload, write):
    mujoco = pytest.importorskip("mujoco")
    rig = shipped(name).with_payload(payload)
    model = mujoco.MjModel.from_xml_string(write(rig).decode())
    model.opt.gravity[:] = 0.0, 0.0, -float(rig.gravity)
    data, plant = mujoco.MjData(model), Model.of(rig).plant
    n, rng = model.nq, np.random.default_rng(3)
    work = np.empty(arm.work_size(n))
    for _ in range(5):
        data.qpos[:] = q = rng.uniform(*np.array(model.jnt_range).T)
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full := np.empty((n, n)))
        arm.mass_matrix(plant.kind, plant.links, q, mass := np.empty((n, n)), work)
        arm.gravity_torque(plant.kind, plant.links, plant.gravity, q, weight := np.empty(n), work)
        assert mass == pytest.approx(full, rel=1e-9, abs=1e-9 * np.abs(full).max())
        size = np.abs(data.qfrc_bias).max() + 1e-6
        assert weight == pytest.approx(data.qfrc_bias, rel=1e-9, abs=1e-9 * size)
    assert model.dof_damping == pytest.approx(plant.links["damping"])
