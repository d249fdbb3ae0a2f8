"""The virtual bench: what it must share with the model, and what it must add."""

import math

import numpy as np
import pytest

from ehbench.config.recipe import BenchRecipe, load_recipe
from ehbench.machines.virtual import VirtualMachine
from ehbench.machines.virtual.drawing import speed_filter
from ehbench.machines.virtual.laws import follow, play
from ehbench.parts.cylinder import linkage_arrays
from ehbench.parts.oil import ATMOSPHERE, bulk
from ehbench.physics.arm import energy, work_size
from ehbench.plant.model import Model
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.fields import Value
from tests.shared import ROOT, shipped
from tools.datasets import main, make

# pump_cylinder sinks by its pump's slip: how quiet it is stands in test_parts_circuit
RIGS = ("thesis_arm", "slide_servo", "crane_proportional", "boom_four_valve")
GPM = 3.785411784e-3 / 60


def bench_file(name):
    return load_recipe(ROOT / "recipes" / "bench" / f"{name}.toml")


def plain(rig, **given):
    """A bench file with all richness off that a file can switch off, on an orifice rig."""
    edges, valves = {}, {}
    for c, v, e in rig.edges():
        curve = {"onset": f"{float(e.deadband)} V", "softness": "0 V", "saturation": "0 V"}
        curve |= {"gain_factor": "1"}
        whole = curve | {"null_leakage": "0 mL/min/bar", "reverse": curve}
        edges[f"{c.name}.{v.edge_name(e)}"] = whole
    for c, v in rig.valves():
        omega, zeta = rig.dynamics[v.dynamics].frequency_and_damping()
        own = {"driver_gain": "1", "driver_offset": "0 V", "hysteresis": "0 V"}
        own |= {"natural_frequency": f"{omega!r} rad/s", "damping_ratio": f"{zeta!r}"}
        valves[f"{c.name}.{v.name}"] = own
    ends = [f"{c.name}.leakage_{key}" for c in rig.cylinder for key in ("internal", "head", "rod")]
    friction = {"friction_coulomb": "0 N", "friction_static": "0 N", "friction_viscous": "0 N*s/m"}
    sensors = {f"pressure_{key}": "0 Pa" for key in ("noise", "offset", "resolution")}
    sensors |= {"pressure_lag": "0 s", "position_noise": "0 m", "position_resolution": "0 m"}
    table = {"truth": dict.fromkeys(ends, "0 mL/min/bar"), "edge": edges, "valve": valves}
    table |= {"air_fraction": "0", "pump_lag": "0 s", "delay": "0 s", "cylinder": {"all": friction}}
    table |= {"sensors": {"all": sensors | {"encoder_counts": 0}}}
    return BenchRecipe(stage="bench", rig="", **(table | given))


def drive(bench, commands):
    """True states of a started bench at each row of commands, and the samples."""
    states, samples = [], []
    for row in commands:
        samples.append(bench.tick(row))
        states.append(bench.state[: bench.size].copy())
    return np.array(states), np.array(samples)


@pytest.mark.parametrize("name", RIGS)
def test_a_shipped_bench_starts_quiet_and_one_without_a_file_is_plausible(name):
    bench = VirtualMachine(shipped(name), bench_file(name))
    bench.start()
    n = len(bench.layout.joints)
    first = bench.state[: bench.size].copy()
    states, samples = drive(bench, bench.model.rest_commands(500))
    supply = bench.bench.supply.pressure
    pressures = slice(2 * n, 2 * n + 2 * len(bench.layout.cylinders))
    for c, joint in enumerate(bench.bench.cylinders.joint):
        _, lever = linkage_arrays(bench.bench.cylinders[c], states[:, joint])
        # leakage lets the load creep and nothing else moves: a hundredth of the slowest step that
        # is recorded
        assert np.abs(states[:, n + joint] * lever).max() < 2e-4
    assert np.abs(states[:, pressures] - first[pressures]).max() < 0.01 * supply
    assert np.isfinite(samples).all()
    rig = shipped(name)
    bench = VirtualMachine(rig)
    bench.start()
    table = bench.model.rest_commands(300)
    valves = [v for _, v in rig.valves()]
    for column, valve in enumerate(valves):
        ends = {valve.edge[0].from_, valve.edge[0].to}
        if len(valve.edge) > 1 or ends in ({"supply", "head"}, {"rod", "tank"}):
            table[20:, column] = 0.4 * float(valve.command_max)
    states, _ = drive(bench, table)
    n = len(bench.layout.joints)
    for c, joint in enumerate(bench.bench.cylinders.joint):
        moved = abs(states[-1, joint] - states[0, joint])
        assert moved > 1e-3, f"cylinder {c} does not move"
    pressures = states[:, 2 * n : 2 * n + 2 * len(bench.layout.cylinders)]
    assert pressures.min() > -ATMOSPHERE and pressures.max() < 3 * bench.bench.supply.pressure


@pytest.mark.parametrize("name", ("slide_servo", "crane_proportional", "boom_four_valve"))
def test_with_all_richness_off_the_bench_is_the_model(name):
    rig = shipped(name)
    # the model takes its valves to order 8, the bench to order 4: small enough for 80 Hz valves to
    # agree
    step = 1.25e-4
    bench = VirtualMachine(rig, plain(rig), step=step)
    bench.start()
    model = Model.of(rig)
    y = bench.state[: bench.bench.at.pump].copy()
    table = model.rest_commands(400)
    table[50:200, 0] = 4.0
    table[250:, 0] = 3.0 if float(next(rig.valves())[1].command_min) == 0 else -3.0
    states, samples = drive(bench, table[:-1])
    log = model.run(y, table, 1e-3, step)[1:, : y.size]
    span = np.maximum(np.ptp(log, axis=0), 1e-9 * np.abs(log).max(axis=0) + 1e-12)
    # the same laws, written twice: what is left is the integrators' own error
    assert (np.abs(states[:, : y.size] - log) / span).max() < 1e-6
    assert np.ptp(log[:, 0]) > 5e-3
    head = log[:, bench.layout.state("p_head", 0)]
    assert np.allclose(samples[:, 4], head, rtol=1e-9, atol=1.0)


def test_lossless_chambers_give_back_what_they_take():
    rig = shipped("slide_servo").with_values({"carriage.damping": 0.0})
    bench = VirtualMachine(rig, plain(rig, air_fraction="0.5 %"), rate=4000.0, step=1.25e-4)
    bench.start({"press": "200 mm"})
    bench.state[1] = 0.05
    speed = drive(bench, bench.model.rest_commands(4000))[0][:, 1]
    swings = [np.abs(speed[i : i + 500]).max() for i in range(0, 4000, 500)]
    # RK4 at 1.25e-4 s loses 1e-6 of the amplitude a cycle at 40 Hz; the peak is sampled within 2e-4
    # of its top
    assert max(swings) / min(swings) < 1.001 and min(swings) > 0.0499


def test_friction_and_damping_only_take_energy():
    bench = VirtualMachine(shipped("thesis_arm"), bench_file("thesis_arm"), rate=4000.0)
    bench.start()
    plant, n = bench.model.plant, 3
    bench.state[n : 2 * n] = 0.3, 0.4, -0.5
    states, _ = drive(bench, bench.model.rest_commands(4000))
    work = np.empty(work_size(n))
    of = plant.kind, plant.links, plant.gravity
    mechanical = np.array([sum(energy(*of, y[:n], y[n : 2 * n], work)) for y in states])
    rows = bench.bench.cylinders
    power = np.zeros(len(states))
    for c in range(3):
        _, lever = linkage_arrays(rows[c], states[:, c])
        head, rod = states[:, 2 * n + 2 * c], states[:, 2 * n + 2 * c + 1]
        force = head * rows[c].area_head - rod * rows[c].area_rod
        power += force * lever * states[:, n + c]
    done = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]))]) / 4000.0
    lost = mechanical[0] - mechanical + done
    # the trapezoid of the oil's work is good to (ωh)²/12 = 1e-4 of what swings to and fro
    assert np.diff(lost).min() > -1e-4 * np.ptp(mechanical)
    assert lost[-1] > 0.5 * np.ptp(mechanical)


def test_air_is_a_polytropic_gas_and_hysteresis_a_backlash():
    p, n, alpha, h = np.linspace(-0.9e5, 7e6, 50), 1.3, 0.004, 1.0
    for gauge in p:
        low, high = (((gauge + ATMOSPHERE + side * h) / ATMOSPHERE) ** (-1 / n) for side in (-1, 1))
        air = alpha * (low - high) / (2 * h)
        assert 1 / bulk(gauge, 3e8, alpha, n) == pytest.approx(1 / 3e8 + air, rel=1e-6)
    assert bulk(1e5, 3e8, 0.0, n) == 3e8
    stiff = [bulk(gauge, 3e8, alpha, n) for gauge in p]
    assert np.all(np.diff(stiff) > 0)
    out, path = 0.0, []
    for u in (0.0, 1.0, 2.0, 1.9, 1.5, 0.0, 0.1, 1.0):
        out = play(out, u, 0.4)
        path.append(out)
    assert path == pytest.approx([0.0, 0.8, 1.8, 1.8, 1.7, 0.2, 0.2, 0.8])


def test_every_cartridge_is_tuned_to_its_calibration_and_none_is_like_another():
    bench = VirtualMachine(shipped("thesis_arm"), bench_file("thesis_arm"))
    edges = [f"boom.{name}" for name in ("hect", "hepc", "regen", "repc", "rect")]
    middle = []
    for edge in edges:
        # tuned by bisection to 1e-15 of the flow; the unit of the rig file is the US gallon
        assert bench.static_flow(edge, 4.0, 2e6) == pytest.approx(2 * GPM, rel=1e-9)
        assert bench.static_flow(edge, 8.0, 2e6) == pytest.approx(6 * GPM, rel=1e-9)
        middle.append(float(bench.static_flow(edge, 10.0, 2e6)) / GPM)
        u = np.linspace(0, 10, 201)
        for drop in (2e5, 2e6, 6.5e6):
            flow = bench.static_flow(edge, u, drop)
            rising = flow > 1e-3 * GPM
            assert rising.any() and np.all(np.diff(flow[rising]) > 0)
        assert bench.static_flow(edge, 8.0, 0.0) == 0.0
        fall = bench.static_flow(edge, 8.0, 6.5e6) / bench.static_flow(edge, 8.0, 1e6)
        assert 0.8 < fall < 0.97, "the compensator's flow falls slowly at high drop"
    assert np.diff(sorted(middle)).min() > 0.01
    back = -bench.static_flow("boom.regen", 8.0, -2e6) / GPM
    assert 3.0 < back < 5.5, "valve 3 gives less from rod to head"


def test_noise_has_the_stated_spread_and_no_memory():
    rig = shipped("slide_servo")
    noise, step = 5e3, 4e3
    own = {"pressure_noise": f"{noise} Pa", "pressure_resolution": f"{step} Pa"}
    sensors = {"all": own | {"pressure_offset": "0 Pa"}}
    bench = VirtualMachine(rig, BenchRecipe(stage="bench", rig="", sensors=sensors), seed=3)
    bench.start()
    _, samples = drive(bench, bench.model.rest_commands(4000))
    p = samples[:, bench.channels.index("p_supply")]
    spread = math.sqrt(noise**2 + step**2 / 12)
    # 4000 samples: the standard deviation is known to 1.1 %, a correlation to 1.6 %; four of those
    assert np.std(p) == pytest.approx(spread, rel=0.045)
    assert abs(np.corrcoef(p[1:], p[:-1])[0, 1]) < 0.064
    near = pytest.approx(bench.state[bench.bench.at.supply], abs=4 * spread / math.sqrt(4000))
    assert np.mean(p) == near
    x = samples[:, bench.channels.index("press.x")] / 2.54e-5
    assert np.abs(x - np.round(x)).max() < 1e-6
    assert abs(np.mean(samples[:, bench.channels.index("press.v")])) < 1e-4


def test_delay_and_lag_are_late_by_what_they_say():
    rig = shipped("slide_servo")
    table = np.zeros((300, 1))
    table[20:] = 3.0

    def heads(delay, lag):
        quiet = plain(rig)
        sensors = {"all": quiet.sensors["all"].model_copy(update={"pressure_lag": Value(lag)})}
        changed = {"sensors": sensors, "delay": Value(delay)}
        bench = VirtualMachine(rig, quiet.model_copy(update=changed))
        bench.start()
        return drive(bench, table)[1][:, 4]

    now, late, half = heads(0.0, 0.0), heads(3e-3, 0.0), heads(0.5e-3, 0.0)
    assert np.array_equal(now[:-3], late[3:])
    assert half[1:] == pytest.approx(0.5 * (now[1:] + now[:-1]), rel=1e-12)
    lagged = heads(0.0, 4e-3)
    rise = (now[150:] - lagged[150:]).sum() * 1e-3
    assert abs(rise) < 4e-3 * np.ptp(now), "a lag has unit gain"
    area = (now - lagged).sum() * 1e-3
    # the area between a signal and its lag is the time constant times the rise; the tail is still
    # moving a little
    assert area == pytest.approx(4e-3 * (now[-1] - now[0]), rel=0.05)


@pytest.mark.parametrize("zeta", (0.5, 1.0, 1.4))
def test_the_speed_filter_gives_the_slope_of_a_ramp_and_its_own_gain_at_a_sine(zeta):
    omega, tick = 2 * math.pi * 60, 1e-3
    speed = speed_filter(omega, zeta, tick)

    def slopes(z):
        a, b, before, out = z[0], 0.0, z[0], []
        for now in z:
            a, b = follow(a, b, before, now, speed)
            before = now
            out.append(b)
        return np.array(out)

    t = np.arange(2000) * tick
    assert slopes(0.07 * t)[-1] == pytest.approx(0.07, rel=1e-9)
    w = 2 * math.pi * 5
    s = 1j * w
    gain = s * omega**2 / (s**2 + 2 * zeta * omega * s + omega**2)
    expected = np.imag(gain * np.exp(1j * w * t))
    # joining the samples of a 5 Hz sine by straight lines loses (wT)²/12 = 8e-5 of it
    assert np.abs(slopes(np.sin(w * t)) - expected)[1000:].max() < 2e-4 * w


def test_the_pump_droops_and_gives_in_above_its_limit():
    rig = shipped("slide_servo")
    bench = VirtualMachine(rig, bench_file("slide_servo"))
    bench.start({"press": "20 mm"})
    place, limit, droop = bench.bench.at, bench.bench.supply.flow_limit, bench.bench.fluid.droop
    p_set = bench.bench.supply.pressure
    small, _ = drive(bench, np.full((250, 1), 2.5))
    flow = small[-1, place.pump]
    assert 0.1 * limit < flow < 0.5 * limit
    # a quasi-static compensator: the drop of pressure is the flow's share of the droop
    assert p_set - small[-1, place.supply] == pytest.approx(droop * flow / limit, rel=0.03)
    large, _ = drive(bench, np.full((200, 1), 10.0))
    assert large[-1, place.supply] < p_set - 1.5 * droop
    assert large[-1, place.pump] == pytest.approx(limit, rel=1e-3)


def test_the_step_is_fine_enough():
    rig, file = shipped("thesis_arm"), bench_file("thesis_arm")
    runs = []
    for step in (2.5e-4, 6.25e-5):
        bench = VirtualMachine(rig, file, step=step)
        bench.start()
        table = bench.model.rest_commands(600)
        for valve, volts in {"boom.hepc": 5.0, "boom.rect": 5.0, "swing.servo": 3.0}.items():
            table[100:, bench.layout.valves.index(valve)] = volts
        runs.append(drive(bench, table)[0])
    span = np.maximum(np.ptp(runs[1], axis=0), 1e-3)
    # a tenth of the sensors' resolution: the switching of friction and area limits the order
    assert (np.abs(runs[0] - runs[1]) / span).max() < 1e-3


@pytest.mark.parametrize("name", (*RIGS, "pump_cylinder"))
def test_a_dataset_is_recorded_again_byte_for_byte(name, tmp_path):
    made = make(ROOT / "recipes" / "datasets" / f"{name}.toml", tmp_path)
    stored = ROOT / "datasets" / name
    files = sorted(p.relative_to(made) for p in made.rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(stored) for p in stored.rglob("*") if p.is_file())
    same = [(made / path).read_bytes() == (stored / path).read_bytes() for path in files]
    assert all(same), "run `make datasets`"


def test_datasets_are_small_and_an_unknown_one_is_named(tmp_path, capsys):
    assert sum(p.stat().st_size for p in (ROOT / "datasets").rglob("*") if p.is_file()) < 10e6
    recipes = str(ROOT / "recipes" / "datasets")
    assert main(["nowhere", "--recipes", recipes, "--out", str(tmp_path)]) == 2
    assert "slide_servo" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


SLIPS = [
    ('[edge."press.nothing"]\nonset = "1 V"\n', 3, "press.nothing"),
    ('[truth]\n"press.bulk" = "1 GPa"\n', 3, "press.bulk"),
    ('[truth]\nbulk_modulus = "1 kg"\n', 4, "kg"),
    ('[cylinder.press]\nfriction_coulomb = "9 N"\nfriction_static = "1 N"\n', 3, "friction_static"),
]


@pytest.mark.parametrize(("text", "line", "says"), SLIPS)
def test_a_wrong_bench_file_is_refused_with_its_line(tmp_path, text, line, says):
    path = tmp_path / "bench.toml"
    path.write_text(
        f'stage = "bench"\nrig = "{ROOT / "recipes" / "rigs" / "slide_servo.toml"}"\n' + text
    )
    with pytest.raises(InputError, match=says) as error:
        VirtualMachine(shipped("slide_servo"), load_recipe(path))
    assert error.value.file == str(path) and error.value.line == line
