"""The plant's proofs: order, linear formula, mirror, equilibrium, violence; see test_ledger."""

import math

import numpy as np
import pytest
from scipy.linalg import eigh

from ehbench.config.rig import Rig, Slide
from ehbench.parts.cylinder import linkage_arrays
from ehbench.parts.valve import valve_settle
from ehbench.physics import arm
from ehbench.physics.cylinder import CAVITATION_BAND, RELIEF_GAIN, makeup_flow, relief_flow
from ehbench.plant.derivatives import derivatives
from ehbench.plant.integrate import rk4
from ehbench.plant.model import Model
from ehbench.signals import series
from ehbench.vocabulary.fields import Value
from tests.shared import RIGS, shipped

# those whose shut valves hold their oil; a pump with its check valves is in test_parts_circuit
NAMES = [p.stem for p in sorted(RIGS.glob("*.toml")) if shipped(p.stem).cylinder[0].pump is None]
LEAK = 2.0e-13  # [m³/(s·Pa)]: 1.2 mL/min/bar, a worn cylinder


@pytest.fixture(scope="module", params=NAMES)
def rig(request) -> Rig:
    return shipped(request.param)


def rate(model: Model, y: np.ndarray, command: np.ndarray) -> np.ndarray:
    """ẏ at a state."""
    plant, dy = model.plant, np.empty_like(y)
    work = np.empty(plant.at.work)
    derivatives(np.ascontiguousarray(y), command, plant, dy, work)
    return dy


def gentle(model: Model, samples: int) -> np.ndarray:
    """Commands that extend every cylinder slowly: its edges into the head and out of the rod at a
    tenth of the driver's range beyond the deadband."""
    table = model.rest_commands(samples)
    for index, (cylinder, valve) in enumerate(model.rig.valves()):
        for edge in valve.edge:
            if (edge.from_, edge.to) in (("supply", "head"), ("rod", "tank")):
                span = 0.1 * (float(valve.command_max) - max(0.0, float(valve.command_min)))
                table[:, index] = edge.sign * (float(edge.deadband) + span)
    return table


def test_fourth_order(rig):
    """The error falls by 2⁴ within 0.1, valves open from the start, without substeps."""
    model = Model.of(rig)
    command = gentle(model, 1)[0]
    y0 = model.trim(model.posture(None))
    for valve, volts in zip(model.plant.valves, command, strict=True):
        valve_settle(valve, volts, model.plant, y0)
    span = 0.032
    work = np.empty(model.plant.at.work)

    def after(steps: int) -> np.ndarray:
        y, k = y0.copy(), np.empty((5, y0.size))
        for _ in range(steps):
            assert rk4(y, command, model.plant, span / steps, k, work) == 1
        return y

    exact = after(64 * 512)
    moved = np.abs(exact - y0) > 1e-9 * np.abs(y0)
    scale = np.where(moved, np.abs(exact - y0), 1.0)
    errors = [np.linalg.norm(((after(steps) - exact) / scale)[moved]) for steps in (128, 256, 512)]
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert errors[0] > 1e-9, "the error must stand well above rounding for its order to show"
    assert np.abs(orders - 4.0).max() < 0.1, (errors, orders)


def locked_modes(model: Model, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(ω [rad/s], mode shapes), all valves shut: K φ = ω² D φ, K = Jᵀ diag(β (A1²/V1 + A2²/V2))
    J and what trim forces do as the linkage turns and gravity's stiffness, by central
    differences.
    """
    plant, n = model.plant, len(q)
    mass, work = np.empty((n, n)), np.empty(arm.work_size(n))
    arm.mass_matrix(plant.kind, plant.links, q, mass, work)
    y = model.trim(q)
    stiffness = np.zeros((n, n))
    for index, (row, joint) in enumerate(zip(plant.cylinders, plant.cylinders.joint, strict=True)):
        at = q[joint] + np.array([-1e-6, 0.0, 1e-6])
        x, lever = linkage_arrays(row, at)
        volumes = row.volume_head + row.area_head * x[1], row.volume_rod - row.area_rod * x[1]
        spring = row.bulk_modulus * (row.area_head**2 / volumes[0] + row.area_rod**2 / volumes[1])
        ends = [y[model.layout.state(f"p_{side}", index)] for side in ("head", "rod")]
        force = ends[0] * row.area_head - ends[1] * row.area_rod
        stiffness[joint, joint] += spring * lever[1] ** 2 - force * (lever[2] - lever[0]) / 2e-6
    for joint in range(n):
        torque = []
        for sign in (1, -1):
            moved, out = q.copy(), np.empty(n)
            moved[joint] += sign * 1e-6
            arm.gravity_torque(plant.kind, plant.links, plant.gravity, moved, out, work)
            torque.append(out)
        stiffness[:, joint] += (torque[0] - torque[1]) / 2e-6
    squares, shapes = eigh(0.5 * (stiffness + stiffness.T), mass)
    # pyrefly: ignore[bad-return]
    return np.sqrt(squares), shapes


def test_natural_frequency_is_that_of_the_linear_formula(rig):
    """No damping: an excited mode of a few µm rings at ω² = β (A1²/V1 + A2²/V2)·lever²/inertia."""
    word = "damping" if isinstance(rig.mechanism, Slide) else "joint_damping"
    still = rig.with_values({f"{body}.{word}": 0.0 for body in rig.joint_names})
    for load in (None, *rig.payload):
        model = Model.of(still, payload=load)
        q = model.posture(None)
        omegas, shapes = locked_modes(model, q)
        for omega, shape in zip(omegas, shapes.T, strict=True):
            y = model.trim(q)
            y[len(q) : 2 * len(q)] += shape / np.abs(shape).max() * 1e-5 * omega
            samples = int(6 * 2 * math.pi / omega / 5e-4)
            log = model.run(y, model.rest_commands(samples), 5e-4)
            at = len(q) + int(np.argmax(np.abs(shape)))
            t, guess = 5e-4 * np.arange(samples), (0.9 * omega, 0.01)
            found = series.ringing(t, log[:, at], guess=guess, trim=False)
            assert found.ok, found.reason
            assert found.natural_frequency == pytest.approx(omega, rel=1e-4)
            assert abs(found.damping_ratio) < 1e-4


def slide(flip: bool) -> Model:
    """A loaded through-rod slide, or its mirror image: ends, stroke and slope exchanged."""
    rig = shipped("slide_servo")
    body, cylinder = rig.mechanism, rig.cylinder[0]
    area, dead = 1.2e-3, 2.0e-4
    full = dead + area * float(cylinder.stroke)
    swap = {"head": "rod", "rod": "head", "supply": "supply", "tank": "tank"}

    # no edge can stand in for another
    shares = {"supplyhead": 1.0, "rodtank": 0.8, "supplyrod": 1.3, "headtank": 0.6}

    def edge(one):
        gain = Value(float(one.flow_gain) * shares[one.from_ + one.to])
        ends = {"from_": swap[one.from_], "to": swap[one.to]} if flip else {}
        return one.model_copy(update={"flow_gain": gain, **ends})

    def mirrored(valve):
        return valve.model_copy(update={"edge": tuple(edge(e) for e in valve.edge)})

    leaks = ("leakage_head", "leakage_rod")
    given = {"area_head": area, "area_rod": area, "volume_head": dead, "volume_rod": full}
    given |= {leaks[flip]: 2 * LEAK, leaks[not flip]: LEAK, "leakage_internal": LEAK}
    given |= {"friction_coulomb": 120.0, "friction_viscous": 300.0}
    update = {key: Value(value) for key, value in given.items()} | {"bore": None, "rod": None}
    valves = tuple(mirrored(v) for v in cylinder.valve)
    changed = cylinder.model_copy(update=update | {"valve": valves})
    slope = body.model_copy(update={"incline": Value(-0.3 if flip else 0.3)})
    return Model.of(rig.model_copy(update={"mechanism": slope, "cylinder": (changed,)}))


def test_head_and_rod_are_mirror_images():
    """Into an end stop and out of it again. Sums of three terms may round in another order, and the
    contact divides what is left by its stiffness: 1e-9 of the range.
    """
    right, left = slide(False), slide(True)
    stroke = right.plant.cylinders[0].stroke
    table = right.rest_commands(3000)
    table[100:1500], table[1500:] = 6.0, -4.0
    start = right.trim(np.array([0.3 * stroke]))
    log = right.run(start, table)
    mirrored = left.trim(np.array([0.7 * stroke]))
    assert mirrored[2:4] == pytest.approx(start[3:1:-1], rel=1e-12)
    image = left.run(mirrored, table)
    assert log[:, 0].max() > stroke, "the trial must reach the end stop"
    ways = ((0, 0, -1.0, stroke), (1, 1, -1.0, 0.0), (2, 3, 1.0, 0.0), (3, 2, 1.0, 0.0))
    pairs = ((log[:, a], by * image[:, b] + more) for a, b, by, more in ways)
    for mine, other in pairs:
        assert np.abs(mine - other).max() < 1e-9 * np.ptp(mine)


def test_trim_is_an_equilibrium(rig):
    """Derivatives vanish, and 2 s later it stands there still. Rounding leaves forces of 1e-15
    of the load's: accelerations below 1e-9 of gravity's and pressures to 1e-9.
    """
    rng = np.random.default_rng(7)
    for load in (None, *rig.payload):
        model = Model.of(rig, payload=load)
        for _ in range(10):
            q = model.posture(None)
            for index, joint in enumerate(model.plant.cylinders.joint):
                low, high = model.stroke_range(index)
                q[joint] = low + (high - low) * rng.uniform(0.02, 0.98)
            y = model.trim(q)
            dy = rate(model, y, model.rest_commands(1)[0])
            assert np.abs(dy[: 2 * len(q)]).max() < 1e-9
            assert np.abs(dy[2 * len(q) :]).max() < 1e-9 * y.max()
        log = model.run(y, model.rest_commands(2001))
        assert np.abs(log[-1, : y.size] - y).max() < 1e-9 * np.abs(y).max()
        assert np.abs(log[-1, : len(q)] - q).max() < 1e-9


def test_trim_carries_the_load_with_no_chamber_below_the_low_side(rig):
    model = Model.of(rig)
    y = model.trim(model.posture(None), low_side=5e5)
    pressures = y[2 * len(model.layout.joints) :][: 2 * len(model.layout.cylinders)].reshape(-1, 2)
    assert pressures.min(axis=1) == pytest.approx(5e5)


def test_violent_commands_stay_finite_and_bounded(rig):
    """Random full-scale switching every 5 to 200 ms. Above relief, the piston presses A·v through
    RELIEF_GAIN; below the floor nothing is lost, as outflow fades in the band. The stops give
    STOP_DEPTH at full supply pressure, more under a falling load: 10 mm are allowed.
    """
    for seed in range(3):
        rng = np.random.default_rng(seed)
        model = Model.of(rig, payload=[None, *rig.payload][seed % (1 + len(rig.payload))])
        plant, n = model.plant, len(model.layout.joints)
        table = model.rest_commands(6001)
        for column in range(table.shape[1]):
            at = 0
            while at < len(table):
                until = at + int(rng.integers(5, 200))
                valve = plant.valves[column]
                table[at:until, column] = rng.choice([valve.lowest, 0.0, valve.highest])
                at = until
        log = model.run(model.trim(model.posture(None)), table)
        assert np.isfinite(log).all()
        reached = False
        for index, row in enumerate(plant.cylinders):
            joint = plant.cylinders[index].joint
            x, lever = linkage_arrays(row, log[:, joint])
            v = np.abs(lever * log[:, n + joint]).max()
            reached |= np.ptp(x) > 0.02 and v > 0.1
            assert x.min() > -0.01 and x.max() < row.stroke + 0.01
            pressures = log[:, 2 * n + 2 * index : 2 * n + 2 * index + 2]
            inflow = np.abs(log[:, model.layout.states :]).sum(axis=1).max()
            assert pressures.min() > row.cavitation_pressure - 1e3
            relieved = (row.area_head * v + inflow) / RELIEF_GAIN
            assert pressures.max() < row.relief_pressure + relieved
        assert reached, "the commands must throw the machine about"


def test_chambers_hold_the_cavitation_floor_and_the_relief_pressure():
    """Shut valves: its head end empties to the floor, its rod end opens its relief. 250 kg at 3 m/s
    cross the cavitation band in 10 µs: the substeps must be there before the band is.
    """
    model = Model.of(shipped("slide_servo"))
    row = model.plant.cylinders[0]
    y = model.trim(np.array([0.2]))
    y[1] = 3.0
    log = model.run(y, model.rest_commands(400), tick=1e-3)
    head, rod = log[:, 2], log[:, 3]
    assert head[:20].max() <= y[2], "a chamber that only loses oil cannot gain pressure"
    assert head.min() == pytest.approx(row.cavitation_pressure, abs=1e3)
    assert rod.max() > row.relief_pressure
    assert relief_flow(rod.max(), row.relief_pressure) <= row.area_rod * 3.0
    assert makeup_flow(-1e-3, float(head.min()), row.cavitation_pressure) > 0.9e-3


def test_the_stop_holds_full_supply_pressure():
    """A piston sinks into its stop by STOP_DEPTH at most: supply·area_head/STOP."""
    model = Model.of(shipped("slide_servo"))
    row = model.plant.cylinders[0]
    log = model.run(model.trim(np.array([0.38])), np.full((1500, 1), 10.0))
    depth = (log[-1, 2] * row.area_head - log[-1, 3] * row.area_rod) / row.stop_stiffness
    assert log[-1, 0] - row.stroke == pytest.approx(depth, rel=1e-3)
    assert 0 < depth <= 1.001e-3
    assert abs(log[-1, 1]) < 1e-6


def test_order_and_names_of_cylinders_do_not_matter(rig):
    """Listed backwards they move alike; sums round in another order: 1e-9 of each range."""
    back = rig.model_copy(update={"cylinder": rig.cylinder[::-1]})
    one, two = Model.of(rig), Model.of(back)
    table = gentle(one, 1500)
    order = [one.layout.valves.index(name) for name in two.layout.valves]
    t = np.arange(1500) * 1e-3
    a = one.record(t, table, one.run(one.trim(one.posture(None)), table))
    b = two.record(t, table[:, order], two.run(two.trim(two.posture(None)), table[:, order]))
    assert set(a.channels) == set(b.channels)
    for name, values in a.channels.items():
        assert np.abs(values - b[name]).max() <= 1e-9 * max(np.ptp(values), 1e-12), name
    first = rig.cylinder[0]
    other = (first.model_copy(update={"name": "zz"}), *rig.cylinder[1:])
    one, two = Model.of(rig), Model.of(rig.model_copy(update={"cylinder": other}))
    table = gentle(one, 300)
    assert (
        one.run(one.trim(one.posture(None)), table).tobytes()
        == two.run(two.trim(two.posture(None)), table).tobytes()
    )


def test_the_guard_sees_relief_and_cavitation():
    """Relief adds RELIEF_GAIN·β/V to the fastest rate, outflow β·|inflow|/(V·(p − floor))."""
    model = Model.of(shipped("slide_servo"))
    row, command = model.plant.cylinders[0], np.zeros(1)
    work, dy = np.empty(200), np.empty(model.layout.states)
    volume = row.volume_head + row.area_head * 0.2

    def fastest(p_head: float, v: float) -> float:
        y = model.trim(np.array([0.2]))
        y[1:4] = v, p_head, 1e7
        return derivatives(y, command, model.plant, dy, work)

    stiff, floor = row.bulk_modulus / volume, row.cavitation_pressure
    open_relief, per_flow = RELIEF_GAIN * stiff, stiff * row.area_head
    assert open_relief > fastest(1e6, 0.0)
    # what it lets out also nears the floor
    assert fastest(row.relief_pressure + 1e5, 0.0) == pytest.approx(open_relief, rel=0.01)
    # relief opens within the step
    assert fastest(row.relief_pressure - 1e5, -2.0) == pytest.approx(open_relief)
    assert fastest(floor + 1e4, 2.0) == pytest.approx(per_flow * 2.0 / CAVITATION_BAND)
    # the floor is one step away
    assert fastest(floor + 1e6, 2.0) == pytest.approx(per_flow * 2.0 / 1e6)


def test_maps_and_laws_are_asked_for_by_name(rig):
    """An edge that follows a map, without one: the error names the edge and the rig."""
    from ehbench.vocabulary.errors import InputError

    cylinder = rig.cylinder[0]
    valve = cylinder.valve[0]
    mapped = valve.edge[0].model_copy(update={"law": "map", "map": "some"})
    changed = valve.model_copy(update={"edge": (mapped, *valve.edge[1:])})
    whole = cylinder.model_copy(update={"valve": (changed, *cylinder.valve[1:])})
    broken = rig.model_copy(update={"cylinder": (whole, *rig.cylinder[1:])})
    with pytest.raises(InputError, match=f"edge '{changed.edge_name(mapped)}' of rig '{rig.name}'"):
        Model.of(broken)


@pytest.mark.parametrize("numbers", [{}, {"com_x": -1.2}, {"com_y": 0.6}, {"inertia_zz": 192.0}])
def test_a_crane_is_a_pendulum_of_its_numbers(numbers):
    """At rest the cylinder's lever carries m g (r_x cos q − r_y sin q), r from the joint; free, the
    joint turns by the torque over I_zz + m r² (a physical pendulum)."""
    known = {"com_x": -1.9, "com_y": 0.05, "inertia_zz": 190.0} | numbers
    model = Model.of(
        shipped("crane_proportional").with_values({f"arm.{k}": v for k, v in numbers.items()})
    )
    mass, g, q = 180.0, 9.80665, 0.3
    along, across = 3.5 + known["com_x"], known["com_y"]
    weight = mass * g * (along * math.cos(q) - across * math.sin(q))
    theta = q + math.radians(80.0)  # l_a = 1.1 m, l_b = 0.7 m
    lever = (
        1.1 * 0.7 * math.sin(theta) / math.sqrt(1.1**2 + 0.7**2 - 2.0 * 1.1 * 0.7 * math.cos(theta))
    )
    head = 0.25 * math.pi * 0.08**2
    areas = head, head - 0.25 * math.pi * 0.045**2
    y = model.trim(model.posture({"lift": q}))
    p_head, p_rod = (float(y[model.layout.state(f"p_{end}", 0)]) for end in ("head", "rod"))
    assert (p_head * areas[0] - p_rod * areas[1]) * lever == pytest.approx(weight, rel=1e-6)
    y[model.layout.state("p_head", 0)] += 1e5
    turned = rate(model, y, model.rest_commands(1)[0])[model.plant.at.rates]
    about = known["inertia_zz"] + mass * (along**2 + across**2)
    assert turned == pytest.approx(1e5 * areas[0] * lever / about, rel=1e-6)
