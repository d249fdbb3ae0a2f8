"""Light pistons under strong friction and in end stops, against SciPy's Radau."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ehbench.config.recipe import load_rig
from ehbench.plant.model import Model
from tests.shared import shipped

COULOMB, MASS, TURNING = 7000.0, 20.0, 2.0e-3  # [N], [kg], [m/s]
OPEN, SHUT, LAST = 0.2, 0.9, 1.4  # [s]

STIFF = f"""
name = "light"
oil = {{ bulk_modulus = "800 MPa" }}
supply = {{ pressure = "100 bar", flow_limit = "40 L/min" }}
mechanism = {{ kind = "slide", name = "slide", mass = "{MASS} kg", damping = "500 N*s/m" }}
[[cylinder]]
name = "act"
joint = "slide"
area_head = "20 cm^2"
area_rod = "16 cm^2"
stroke = "200 mm"
volume_head = "200 cm^3"
volume_rod = "520 cm^3"
FRICTION
[[cylinder.valve]]
name = "v"
command_min = "-10 V"
command_max = "10 V"
edge = [
  {{ name = "pa", from = "supply", to = "head", law = "orifice", flow_gain = "0.1 L/min/V/bar^0.5" }},
  {{ name = "bt", from = "rod", to = "tank", law = "orifice", flow_gain = "0.1 L/min/V/bar^0.5" }},
]
"""  # noqa: E501
AS_FRICTION = f'friction_coulomb = "{COULOMB} N"'
AS_FORCE = f"""[[cylinder.force]]
kind = "by_direction"
force_extending = "{-COULOMB} N"
force_retracting = "{COULOMB} N\""""


def by_radau(t: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Stroke, speed and pressures of both chambers, friction as steep as it is."""
    gain = 0.1 / 6.0e4 / np.sqrt(1.0e5)

    def slope(_, y, volts):
        x, v, head, rod = y
        inflow = gain * volts * np.sqrt(100.0e5 - head)
        outflow = gain * volts * np.sqrt(rod)
        force = 20e-4 * head - 16e-4 * rod - 500.0 * v - COULOMB * np.tanh(v / TURNING)
        return [
            v,
            force / MASS,
            800e6 / (200e-6 + 20e-4 * x) * (inflow - 20e-4 * v),
            800e6 / (520e-6 - 16e-4 * x) * (16e-4 * v - outflow),
        ]

    y, parts = start, []
    for begin, end, volts in ((0.0, OPEN, 0.0), (OPEN, SHUT, 3.0), (SHUT, LAST, 0.0)):
        among = t[(t >= begin - 1e-9) & (t <= end + 1e-9)]
        close = {"rtol": 1e-7, "atol": [1e-9, 1e-9, 1.0, 1.0], "args": (volts,)}
        result = solve_ivp(slope, (among[0], among[-1]), y, "Radau", among, **close)
        y = result.y[:, -1]
        parts.append(result.y[:, :-1] if end < LAST else result.y)
    return np.hstack(parts).T


@pytest.mark.parametrize("text", [AS_FRICTION, AS_FORCE])
def test_a_light_piston_moves_as_its_friction_lets_it(tmp_path, text):
    """In a fiftieth of the steps that its friction's slope asks for (175 000 a second)."""
    file = tmp_path / "rig.toml"
    file.write_text(STIFF.replace("FRICTION", text))
    model = Model.of(load_rig(file))
    places = [model.layout.state_names.index(n) for n in ("slide.q", "slide.qd")]
    places += [model.layout.state("p_head"), model.layout.state("p_rod")]
    t = np.arange(round(1000 * LAST) + 1) / 1000.0
    commands = model.rest_commands(t.size)
    commands[(t > OPEN - 5e-4) & (t < SHUT - 5e-4), 0] = 3.0
    start = model.trim(model.posture(None))
    expected = by_radau(t, start[places])
    span = np.ptp(expected, axis=0)
    for step in (5e-4, "auto"):
        off = (model.run(start.copy(), commands, 1e-3, step)[:, places] - expected) / span
        assert np.abs(off[:, [0, 2, 3]]).max(axis=0) == pytest.approx(0.0, abs=1e-3), step
        assert np.sqrt(np.mean(off[:, 1] ** 2)) < 0.003


@pytest.mark.parametrize("mass", ["2 kg", "5 kg"])
def test_a_light_piston_comes_to_rest_in_its_end_stop(mass):
    """It swung for ever: the damping of the stop grows with its depth, and so does its rate."""
    rig = shipped("slide_servo")
    model = Model.of(rig.with_values({"carriage.mass": float(mass.split()[0])}))
    commands = model.rest_commands(3001)
    commands[:, 0] = 3.0
    log = model.run(model.trim(model.posture(None)), commands)
    assert log[-1, 0] > 0.4  # the stroke
    assert np.abs(log[-500:, 1]).max() < 1e-6
