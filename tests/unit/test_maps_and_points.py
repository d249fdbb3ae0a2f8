"""Flow maps and operating points on small arrays, against closed forms."""

import math
from dataclasses import astuple, replace
from pathlib import Path
from types import SimpleNamespace as Stub
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.flow_maps import fit, results, shape, step_readings, tables
from ehbench.flow_maps.readings import (
    Cells,
    FlowMapOptions,
    Noise,
    Units,
    gather_cells,
    measure_noise,
    readings_table,
    sort_readings,
)
from ehbench.flow_maps.spline import SETTINGS as SPLINE
from ehbench.parts.cylinder import chamber_oil
from ehbench.parts.line import drop_for
from ehbench.parts.oil import bulk_of
from ehbench.plant.design_point import circuit_of
from ehbench.plant.model import Model
from ehbench.stages.flow_map import FlowMapStage
from ehbench.tune import arc, draws, gains, linear, search, study
from ehbench.tune import loop as loops
from ehbench.tune import operating_point as steady
from ehbench.tune.arc_loop import ArcLoop, LoopMargins, Sampled, Sensing
from ehbench.tune.draws import draw_parameters, uncertain
from ehbench.tune.linear import development_model
from ehbench.tune.loop import Law, Loop, _off_side_flows, close, damping_ratio
from ehbench.tune.operating_point import FED, Aim, equivalent, operating_point
from ehbench.tune.results import functions_of
from ehbench.tune.stability import OpenLoop, gain_margin, phase_margin
from ehbench.tune.study import Study, rail_notes
from ehbench.vocabulary.codes import FUNCTIONS
from ehbench.vocabulary.errors import InputError, InsufficientData
from ehbench.vocabulary.fields import Value
from ehbench.vocabulary.terms import Z95
from tests.settings import answers, first_call
from tests.shared import refused, shipped, slide

TICK = 1e-3


@pytest.mark.parametrize("rise", [-0.004, 0.004])
def test_a_flow_that_warms_is_told_by_its_slope_and_interval(rise):
    """Against the slope and its standard error of scipy's regression."""
    from scipy.stats import linregress

    warm, rng = np.linspace(-5.0, 5.0, 60), np.random.default_rng(1)
    share = rise * warm + 1e-3 * rng.standard_normal(60)
    rows: Any = Stub(temperature=300.0 + warm, flow=1e-4 * (1.0 + share))
    fit: Any = Stub(residuals=1e-4 * share, sigmas=np.zeros(60), map=Stub(rated_flow=1e-4))
    (note,) = (note for note in tables._warm_flow(fit, rows))
    line: Any = linregress(warm, share)
    told: Any = note
    assert told.fields["share"] == pytest.approx(1000.0 * line.slope)
    assert told.fields["half"] == pytest.approx(1000.0 * norm.ppf(0.975) * line.stderr)


@pytest.mark.parametrize("pressure", [1e6, 19e6])
def test_a_reading_of_a_step_has_its_direction_and_a_flow_along_it(pressure):
    """Of the edge from the supply to the head, which oil leaves where the head is the higher."""
    model = Model.of(shipped("slide_servo"))
    head = int(model.plant.cylinders[0].node_head)
    edge = next(
        e
        for e in model.plant.edges
        if head in (e.from_node, e.to_node) and not e.unmetered and e.sign > 0
    )
    start, end = int(edge.from_node), int(edge.to_node)
    other = start if end == head else end
    pressures = dict.fromkeys(range(model.layout.nodes), np.full(80, 10e6))
    pressures |= {head: np.full(80, pressure), other: np.full(80, 10e6)}
    inflow = 1e-4 if pressure < 10e6 else -1e-4
    block = step_readings._Block(0, pressures, {head: inflow})
    commands = {f"{valve}.command": np.full(80, 5.0) for valve in model.layout.valves}
    record: Any = commands
    (reading,) = step_readings._readings(model, record, block)
    forward = pressures[start][0] > pressures[end][0]
    assert reading[1] == ("forward" if forward else "reverse")
    assert reading[2:] == pytest.approx((5.0, abs(pressure - 10e6), 1e-4))


def test_identified_numbers_with_a_finite_error_are_drawn():
    known = {
        "drawn": Value(1.0, "identified", std=0.1),
        "no_error": Value(1.0, "identified"),
        "none": Value(1.0, "identified", std=0.0),
        "endless": Value(1.0, "identified", std=math.inf),
        "of_a_sheet": Value(1.0, "datasheet", std=0.1),
    }
    rig: Any = Stub(parameters=lambda: known)
    assert uncertain(rig) == ("drawn",)


@pytest.mark.parametrize(("above", "near"), [(-2.1, 0), (-1.9, 1), (0.0, 1), (1.9, 1), (2.1, 0)])
def test_points_near_the_end_of_the_low_rail_are_counted(above, near):
    margin, ends = 1e5, 2e6
    rig: Any = Stub(supply=Stub(low_rail=Stub(rail_margin=margin, rail_pressure=ends + margin)))
    path, side = next(iter(FED.items()))
    at = [0.0, 0.0]
    at[side] = ends + above * margin
    paths = [Stub(path=path), Stub(path=max(FED) + 1)]
    points: Any = [Stub(p_head=at[0], p_rod=at[1], paths=paths)] * 3
    told: list[Any] = rail_notes(rig, points)
    assert [note.fields for note in told] == ([{"near": 3, "points": 3}] if near else [])
    none: Any = Stub(supply=Stub(low_rail=None))
    assert rail_notes(none, points) == []


# --- flow maps


@pytest.mark.parametrize(("rest", "level"), [(0.05, 2), (0.9e-3, None)])
def test_a_leak_is_the_sum_of_its_two_parts_without_what_is_far_from_it(rest, level):
    """Two levels pass no more than the valve at rest; one reading of them is a mistake."""
    rng, s = np.random.default_rng(3), np.tile(np.sqrt(np.linspace(0.05, 1.0, 12)), 5)
    at = np.repeat(np.arange(5), 12)
    y = np.where(at < 2, rest * (0.7 * s + 0.3 * s**2), 0.2 * at * s)
    y[:24] += 0.01 * rest * rng.standard_normal(24)
    y[20] += 5.0 * rest
    r: Any = Stub(level=at, command=0.5 * at, silent=np.zeros(60, bool), y=y, s=s, step=at)
    r.cell, r.cell_level = at, np.arange(5)
    found = fit._find_leak(r)
    assert (found and found.level) == level
    if found is None:
        return
    use = (np.arange(60) < 24) & (np.arange(60) != 20)
    design = np.column_stack([s, s**2])[use]
    parts, squares, *_ = np.linalg.lstsq(design, y[use], rcond=None)
    assert (found.root, found.drop) == pytest.approx(tuple(parts))
    error = float(squares[0]) / 21.0 * np.linalg.inv(design.T @ design).sum()
    assert found.std == pytest.approx(math.sqrt(error))
    assert found.flow(np.array([0.0, 0.5, 1.0])) == pytest.approx(
        [0.0, 0.5 * parts[0] + 0.25 * parts[1], sum(parts)]
    )
    moving: Any = Stub(**{**vars(r), "command": 0.5 + 0.5 * at})
    assert fit._find_leak(moving) is None


@pytest.mark.parametrize(("high", "rated"), [([], 1.0), ([50.0], 0.99), ([5.0, 6.0], 6.0)])
def test_one_cell_far_above_all_others_is_not_the_rated_flow(high, rated):
    """Two that bear each other out are."""
    command, drop = (a.ravel() for a in np.meshgrid(np.arange(1.0, 6.0), np.arange(1.0, 7.0)))
    flow = 0.2 * command * (0.94 + 0.01 * drop)
    flow[flow.size - len(high) :] = high
    rows = readings_table(command, 1e6 * drop, 1e-3 * flow)
    found = sort_readings("map", rows, FlowMapOptions(), 0.0)
    assert found.rated == pytest.approx(1e-3 * rated)
    assert found.y == pytest.approx(found.q / found.rated)


def grid_rows(commands, drops, flow, **columns):
    """Readings of a flow(u, Δp) at each of some commands and drops [MPa]."""
    u, drop = (a.ravel() for a in np.meshgrid(commands, 1e6 * np.asarray(drops), indexing="ij"))
    return readings_table(u, drop, flow(u, drop) * np.ones(u.size), **columns)


FOUR, TANK = [1.0, 2.0, 3.0, 4.0], 1e6


@pytest.mark.parametrize(
    ("commands", "drops", "flow", "key"),
    [
        (FOUR[:3], FOUR, lambda u, _: u, "few_commands"),
        (FOUR, FOUR[:3], lambda u, _: u, "few_drops"),
        (FOUR, [math.nan], lambda u, _: u, ""),
        (FOUR[:1], [math.nan], lambda u, _: u, "few_commands"),
        (FOUR, [*FOUR, math.nan], lambda u, _: u, "some_drops"),
        (FOUR, [-1.0, 0.0], lambda u, _: u, "no_drop"),
        (FOUR, [5e-7], lambda u, _: u, "few_drops"),
        (FOUR, FOUR, lambda u, _: 0.0, "no_flow"),
        (FOUR, FOUR, lambda u, _: 1.0 + 0.02 * u, "idle"),
        (FOUR, FOUR, lambda u, _: 1.0 + 0.04 * u, ""),
        (FOUR, FOUR, lambda u, drop: drop - 0.2 * u * TANK, "open_at_rest"),
        # at one drop alone it falls; where few commands are read, nothing is told of them
        (FOUR, FOUR, lambda u, drop: np.where(drop > 3.5 * TANK, u, 5.0 - u), ""),
        (FOUR, FOUR, lambda u, drop: u, ""),
    ],
)
def test_readings_make_no_map_that_are_few_or_do_not_go_with_the_command(
    commands, drops, flow, key
):
    work = lambda: sort_readings("map", grid_rows(commands, drops, flow), FlowMapOptions(), 0.0)  # noqa: E731
    if not key:
        found = work()
        assert found.one_drop == bool(np.isnan(drops).any()) and found.levels.tolist() == FOUR
        return
    with refused(f"flow_maps.{key}", InsufficientData):
        work()


def test_readings_of_a_meter_and_of_a_cylinder_are_cells_of_their_own():
    """Both at each place, none twice."""
    names = np.array(["flowmeter", "cylinder"])[np.tile([0, 1, 0, 1, 1, 0, 1, 0], 4)]
    rows = grid_rows(FOUR, FOUR * 2, lambda u, _: u, method=names)
    found = sort_readings("map", rows, FlowMapOptions(), 0.0)
    assert np.unique(found.cell).size == 32
    assert found.cell_level[found.cell].tolist() == found.level.tolist()


@pytest.mark.parametrize("power", [0.0, 1.0, 2.0, 4.0])
def test_a_curve_bends_towards_low_drops_by_the_likeliest_of_four_powers(power):
    """Whose stiffness over three spans is that of their middles."""
    middles = np.array([1.0, 3.0, 5.0]) / 6.0

    def smoothed(item, *_):
        off = np.log(item.along_s.stiffness / middles**power)
        return item, 99.0 * item.along_s.kink + 9.0 * float(np.sum(off**2))

    axis = shape.Axis(np.linspace(0.0, 1.0, 4), 3)
    plain = shape.Shape(1.0, np.arange(2.0, 9.0), axis, np.ones(2))
    sharp = []
    with answers(shape, likeliest_smoothing=smoothed,
                 roughly_smoothed=lambda *given: sharp.append(1) or smoothed(*given)):  # fmt: skip
        found = shape.bend(plain, None).along_s
    assert len(sharp) == 2  # at each place between three spans
    assert found.stiffness == pytest.approx(middles**power)


@pytest.mark.parametrize(("replicates", "size"), [(0, 2.0), (5, 2.0), (20, 2.0), (20, 0.3)])
def test_a_deviance_has_the_scale_of_the_noise_free_unless_repeats_measure_it(replicates, size):
    """By dense matrices: −2 log of the restricted likelihood of n − 1 numbers, without what hangs
    on the penalties alone."""
    rng = np.random.default_rng(8)
    u, s = (a.ravel() for a in np.meshgrid(np.arange(1.5, 7.0), np.linspace(0.2, 1.0, 5)))
    y, weight = (u - 1.0) * s + 0.01 * size * rng.standard_normal(u.size), np.full(u.size, 1e4)
    weight[3] = 0.0
    cells = Cells(u, s, y, weight, np.ones(u.size), y, replicates)
    spline = shape.Spline(1.0, np.arange(2.0, 8.0), shape.Axis(np.linspace(0, 1, 4), 3))
    design, smoothing = spline.design(u, s), np.array([3.0, 5.0])
    along_u, along_s = spline.along_u, spline.along_s
    penalty = smoothing[0] * np.kron(along_s.mass, along_u.curvature)
    penalty += smoothing[1] * np.kron(along_s.curvature, along_u.mass)
    normal = design.T @ (weight[:, None] * design) + penalty
    best = np.linalg.solve(normal, design.T @ (weight * y))
    free = u.size - 2
    misfit = float(weight @ (y - design @ best) ** 2 + best @ penalty @ best)
    if replicates >= 12 and misfit < free:
        expected = misfit - free
    else:
        share = misfit / free
        expected = free * math.log(share if replicates else (share + 0.25) / 1.25)
    fit = shape.Regression(spline, cells)
    determinant = fit.spline.free(fit.band, fit.right, smoothing)[1]
    assert fit.free(smoothing) - determinant == pytest.approx(expected, rel=1e-6)
    assert (misfit < free) == (size < 1.0)
    # how well a map meets the cells, and those that do not stand alone
    bent = shape.Shape(1.0, np.arange(2.0, 8.0), along_s, smoothing)
    lone = np.arange(u.size) == 7
    r: Any = Stub(u=u, s=s, heard=lambda flow: 2.0 * flow)
    found = shape.judge(r, bent, cells, lone)
    used = np.where(lone, 0.0, weight)
    normal = design.T @ (used[:, None] * design)
    inverse = np.linalg.inv(normal + penalty)
    assert found.parameters == pytest.approx(np.trace(inverse @ normal))
    assert found.variance(design) == pytest.approx(np.diag(design @ inverse @ design.T))
    each = (y - found.flow) ** 2
    for part, count, lack in ((weight, free + 1, found.lack), (used, free, found.widening)):
        assert lack == pytest.approx(max(1.0, float(part @ each) / (count - found.parameters)))
    assert found.flow == pytest.approx(design @ found.coefficients)
    assert found.cells.heard == pytest.approx(2.0 * found.flow)


def test_a_kink_between_places_leaves_the_chord_by_its_turn():
    """Slopes 1, 2, 5, 5: half of each turn shows at either end of its gap."""
    places = np.array([0.0, 1.0, 3.0, 4.0, 6.0])
    x = np.array([-1.0, 0.25, 2.0, 2.5, 3.5, 5.0, 6.0, 7.0])

    def flow(at, of):
        return of * np.interp(at, places, [0.0, 1.0, 5.0, 10.0, 20.0])

    share = x - np.array([0.0, 0.0, 1.0, 1.0, 3.0, 4.0, 4.0, 4.0])
    share = share / np.array([1.0, 1.0, 2.0, 2.0, 1.0, 2.0, 2.0, 2.0])
    bow = np.clip(share * (1.0 - share), 0.0, None) * np.array([1, 1, 2, 2, 1, 2, 2, 2])
    of = np.array([1.0, 1.0, 2.0, 1.0, 3.0, 1.0, 1.0, 1.0])
    for reach, turn in ((0, [1, 1, 4, 4, 3, 0, 0, 0]), (1, [4, 4, 4, 4, 4, 3, 3, 3])):
        found = results._chord(flow, places, x, of, reach)
        assert found == pytest.approx(np.array(turn) * of * bow)
    assert not results._chord(flow, places[:3], x, of, 1).any()
    steep = lambda at, of: np.interp(at, places, [0.0, 1.0, 3.0, 5.0, 23.0])  # 1, 1, 2, 9  # noqa: E731
    assert results._chord(steep, places, np.array([0.25, 5.5]), np.ones(2), 1) == pytest.approx(
        [0.25 * 0.75, 8.0 * 2.0 * 0.75 * 0.25]
    )


@pytest.mark.parametrize("flows", [False, True])
def test_a_hull_has_the_drops_of_each_command_or_group_of_them(flows):
    """Many commands go in as many groups as a map has spans, of as many readings."""
    size = 4 * SPLINE.spans
    u, drop = np.arange(1.0, size + 1.0), 1e5 * (1.0 + np.arange(size) % 7)
    r: Any = Stub(level=np.arange(size), command=u, commands=u, drop=drop)
    result: Any = Stub(readings=r, keep=np.ones(size, bool), window=Stub(flows_at_lowest=flows))
    groups = u.reshape(-1, 4).mean(axis=1)
    groups[[0, -1]] = u[[0, -1]]
    lowest, highest = (side(drop.reshape(-1, 4), axis=1) for side in (np.min, np.max))
    table = np.array([groups, lowest, highest])
    if not flows:
        table = np.column_stack([[0.0, lowest[0], highest[0]], table])
    assert results._hull(result) == pytest.approx(table)
    few: Any = Stub(level=np.array([0, 0, 1, 1, 2]), command=np.array([1.0, 1.2, 2.0, 2.2, 3.0]))
    few.commands, few.drop = np.array([1.1, 2.1, 3.0]), np.array([5.0, 6.0, 7.0, 9.0, 8.0])
    result = Stub(readings=few, keep=np.arange(5) != 2, window=Stub(flows_at_lowest=True))
    assert results._hull(result) == pytest.approx(
        np.array([[1.1, 2.2, 3.0], [5.0, 9.0, 8.0], [6.0, 9.0, 8.0]])
    )
    few.commands[0], result.window.flows_at_lowest = 0.0, False  # there is no lower command
    assert results._hull(result)[0] == pytest.approx([0.0, 2.2, 3.0])


def test_a_map_falls_from_its_largest_flow_to_that_of_the_largest_command():
    """By a parabola about 1 V, that ends at 1.5 V."""
    built: Any = Stub(rising=3, opening_knots=np.arange(5), hull_high=[2e6, 8e6], deadband=0.2)
    built.command_max, built.flow = 1.5, lambda drop, u: drop * u * (2.0 - u) + drop - 8e6
    assert results._fall(built) == pytest.approx(0.25, abs=1e-4)
    built.rising = 4
    assert results._fall(built) == 0.0


@pytest.mark.parametrize(
    ("command", "target", "reference", "std", "verdict"),
    [
        (2.5, 2.5 * 6.25, None, 0.1, "met"),
        (2.5, 2.5 * 6.25, None, 0.9, "undecided"),
        (2.5, 14.9, None, 0.1, "undecided"),
        (2.5, 16.4, None, 0.1, "undecided"),
        (1.0, 4.0, 4.0, 0.1, "met"),
        (2.5, 2.5 * 8.0, None, 0.1, "missed"),
        (2.5, 2.5 * 5.0, None, 0.1, "missed"),
        (3.0, 3.0 * 4.0, 4.0, 0.1, "met"),
        (3.1, 3.1 * 4.0, 4.0, 0.1, "not_measured"),
        (0.9, 0.9 * 4.0, 4.0, 0.1, "not_measured"),
    ],
)
def test_a_calibration_point_is_the_mean_over_the_upper_half_of_its_drops(
    command, target, reference, std, verdict
):
    """Or that at its reference; of a flow that goes with the drop."""
    built: Any = Stub(hull_command=[1.0, 2.0, 3.0], hull_low=[1.0] * 3, hull_high=[2.0, 6.0, 10.0])
    built.flow = lambda drop, u: drop * u
    built.flow_std = lambda drop, u: std * np.ones_like(drop)
    item = results.check_calibration(built, command, target, 0.05, reference)
    low, high = (4.5, 8.0) if reference is None else (reference, reference)
    flow = 0.5 * command * (low + high)
    assert item.verdict == verdict and (item.drop_low, item.drop_high) == (low, high)
    assert item.flow == pytest.approx(flow)
    assert (item.low, item.high) == pytest.approx(
        (flow - norm.ppf(0.975) * std, flow + norm.ppf(0.975) * std), rel=1e-4
    )
    assert (item.least, item.most) == pytest.approx((command * low, command * high))


@pytest.mark.parametrize(
    ("gains", "ratio"), [((2e-8, None), 1.5), ((None, 1e-5), 3.0), ((None, None), 1.0)]
)
def test_flows_are_held_against_the_gain_of_the_rig_file(gains, ratio):
    """Of 3e-5 m³/s a volt beyond 1 V at 1 MPa; shut readings and those without flow are no part."""
    edge: Any = Stub(deadband=1.0, flow_gain=gains[0], compensated_gain=gains[1])
    rows: Any = Stub(command=np.array([0.5, 2.0, 3.0, 3.0]), pressure_drop=np.full(4, 1e6))
    rows.flow = 1e-5 * np.array([9.0, 3.0, 6.0, 0.0])
    assert tables.gain_ratio(edge, rows) == pytest.approx(ratio)
    rows.flow[:] = 0.0
    assert tables.gain_ratio(edge, rows) == 1.0


def test_readings_that_stand_alone_are_off_by_their_share_of_the_rated_flow():
    show: Any = Stub(volts=lambda value: value, drop=lambda value: value)
    r: Any = Stub(cell=np.array([0, 0, 1, 1, 2]), y=0.1 * np.array([1.0, 1.0, 3.0, 3.4, 9.0]))
    r.command, r.drop = np.array([1.0, 1.0, 2.0, 2.2, 3.0]), np.array([1e6] * 2 + [3e6] * 3)
    r.show = show
    solution = Stub(lone=np.array([False, True, True]), flow=np.full(5, 0.4), widening=1.0)
    keep = np.array([True, True, True, True, False])
    result: Any = Stub(readings=r, solution=solution, keep=keep, sigmas=np.zeros(5))
    result.noise = Stub(std=lambda _, flow: 0.01 * flow)
    quiet: Any = Stub(outliers=(), replicates=9, status="estimated", trial_scatter=0.0)
    (note,) = results._warnings(result, quiet)
    told: Any = note
    assert told.key == "flow_maps.lone_cell" and told.fields["count"] == 2
    assert told.fields["off"] == pytest.approx(-0.08)
    assert (told.fields["command"], told.fields["drop"]) == pytest.approx((2.1, 3e6))


def root(drop):
    """Of a drop [Pa] whose bend is at 40 kPa."""
    return drop / (drop**2 + 4e4**2) ** 0.25


def fitted(law, drops=(0.5, 1.0, 2.0, 3.0, 4.0), rising=math.inf, shift=0.0, **more: Any):
    """(a fit to readings of law(u) · s, s the root of the drop over that of 4 MPa, above 1 V, with
    so little smoothing that it follows them; its table, whose first row is at no drop)."""
    files = np.repeat(["b.csv", "a.csv"], 11 * len(drops))[::2]
    flow = lambda u, _: 1e-4 * law(u)  # noqa: E731
    rows = grid_rows(np.arange(1.0, 6.1, 0.5), drops, flow, method="cylinder", file=files)
    if len(drops) > 1:
        rows.pressure_drop[0] = 0.0
    r = sort_readings("v", rows, FlowMapOptions(), 0.0).shifted(shift)
    rated = 1e-4 * law(np.linspace(1.0, 6.0, 21)).max()
    y = 1e-4 * np.maximum(law(r.u), 0.0) / rated * r.s
    r, keep = replace(r, y=y, q=rated * y, rated=rated), np.ones(y.size, bool)
    noise = Noise({"cylinder": (1e-3, 2e-3)}, 20)
    cells = gather_cells(r, noise, keep, y)
    smoothing = np.array([1e-8, 1e-2]) * cells.weight.sum()
    bent = shape.Shape(1.0, r.levels[1:], r.axis, smoothing, rising=rising)
    solution = shape.judge(r, bent, cells, np.zeros(cells.u.size, bool))
    keep = np.arange(y.size) != 9
    parts = noise, shape.Deadband(1.0, 0.01, (0.98, 1.02), False), shape.window_of(r, cells, 1.0)
    sigmas = np.where(keep, 0.0, -6.54321)
    return fit.Fit(r, bent, solution, *parts, keep, sigmas, **{"kinks": (), **more}), rows


def test_a_map_is_told_with_all_that_was_seen():
    """Of a plane with a leak, a shift, a kink, a hysteresis and an outlier."""
    result, rows = fitted(
        lambda u: u - 1.0,
        shift=0.20049,
        shift_std=0.01,
        kinks=(shape.Kink(3.204, 0.05, (3.104, 3.304)),),
        leak=fit.Leak(0.01, 0.02, 0.003, 1, True),
        hysteresis=fit.Hysteresis(0.12344, 0.02, True),
    )
    with answers(results, fit_readings=result, _leakage=(0.03, (0.02, 0.04))):
        found = results.fit_flow_map("v", "forward", rows)
    built, rated = found.map, 5e-4
    assert (built.rated_flow, built.drop_max, built.delta) == pytest.approx((rated, 4e6, 4e4))
    for drop, u in ((4e6, 3.0), (1e6, 5.0), (2.5e6, 4.2)):
        s, moved = root(drop) / root(4e6), 0.20049 * (drop / 4e6 - 0.5)
        flow = 0.2 * (u - moved - 1.0) * s + s * (0.01 + 0.02 * s)
        assert float(built.flow(drop, u)) == pytest.approx(rated * flow, rel=1e-4)
    assert built.std_root[[0, -1]] == pytest.approx([0.0, root(4e6)], abs=1e-6)
    between = 0.5 * (root(1e6) + root(2e6))  # of two drops measured
    even = root(4e6) / 16.0  # half of the eight spans that part the closest drops
    for place in (between, even, 15.0 * even):
        assert np.abs(np.asarray(built.std_root) - place).min() < 1e-6 * root(4e6)
    assert built.leakage == pytest.approx((0.01 * rated, 0.02 * rated))
    assert built.leakage_std == pytest.approx(0.003 * rated)
    assert (built.hysteresis, built.shift) == (0.1234, pytest.approx(0.20049 / 4e6, rel=1e-5))
    assert (built.samples, built.source) == (53, "a.csv, b.csv") and len(built.outliers) == 1
    assert (found.status, found.falls, found.readings, found.cells) == ("estimated", 0.0, 53, 54)
    assert (found.bracket, found.deadband_interval) == ((1.0, 1.5), (0.98, 1.02))
    assert found.noise == {"cylinder": pytest.approx((1e-3 * rated, 2e-3))}
    assert found.smoothing == pytest.approx((1e-8, 1e-2)) and found.lack_of_fit == 1.0
    assert found.hysteresis_interval == pytest.approx((0.1234 - 0.0392, 0.1234 + 0.0392), abs=1e-4)
    assert found.shift_interval == pytest.approx((0.2005 - 0.0196, 0.2005 + 0.0196), abs=1e-4)
    assert found.leakage_interval == pytest.approx((0.02 * rated, 0.04 * rated))
    (out,) = found.outliers
    at = result.readings.row[9]
    assert (out.file, out.line, out.sigmas) == (rows.file[at], rows.line[at], -6.54)
    assert (out.command, out.pressure_drop) == (rows.command[at], rows.pressure_drop[at])
    assert np.flatnonzero(np.isnan(found.residuals)).tolist() == [0]
    assert np.flatnonzero(found.sigmas < -6.0).tolist() == [at]
    told: Any = {note.key.partition(".")[2]: note.fields for note in found.warnings}  # type: ignore[attr-defined]
    assert list(told) == ["outliers", "leak_goes_on", "kink", "hysteresis", "shift"]
    assert (told["outliers"]["count"], told["outliers"]["all"]) == (1, 54)
    assert told["kink"] == {"command": "3.2 V", "low": "3.1 V", "high": "3.3 V"}
    assert told["shift"] == {"value": "0.2 V", "low": "0.181 V", "high": "0.22 V"}
    assert told["hysteresis"]["value"] == pytest.approx(0.12344)


@pytest.mark.parametrize(
    ("rest", "level", "deadband", "opens"),
    [(0.0, None, 1.25, 1), (0.3, None, 0.0, 0), (0.5, 3, 2.25, 3), (0.004, 1, 1.25, 1)],
)
def test_a_first_map_begins_between_what_is_shut_and_what_passes_flow(rest, level, deadband, opens):
    """5e-3 of the rated flow is flow, or what is more than a leak, which is taken off what is shut;
    one reading is a mistake."""
    r, rng = fitted(lambda u: u - 1.0)[0].readings, np.random.default_rng(1)
    y = np.maximum(r.y, rest * 0.5 * (r.s + r.s**2)) + 1e-3 * rng.standard_normal(r.y.size)
    y[30], y[40] = y[30] + (0.1 if opens < 3 else 3.0), r.y[40] + 4e-3
    leak = None if level is None else fit.Leak(rest, 0.0, 0.0, level)
    found, bent, flow, keep = fit._first_shape(replace(r, y=y), leak)
    assert not keep[30] and keep[40] and keep.sum() >= keep.size - 3
    assert bent.deadband == pytest.approx(deadband)
    assert bent.above.tolist() == r.levels[opens:].tolist()
    shut = (r.step < opens) & (level is not None)
    assert found.y[~shut].tolist() == y[~shut].tolist()
    assert np.median(np.abs(found.y[shut])) < 2e-3 if shut.any() else level is None
    passes = (r.u > 3.0) & keep
    assert flow[passes] == pytest.approx(y[passes], rel=0.1)


def test_a_map_that_falls_is_told_from_where_and_by_how_much():
    """A parabola about 4.75 V, that is 1 − 12.5/3.75² lower at 6 V."""
    result, rows = fitted(lambda u: (u - 1.0) * (8.5 - u), rising=4.75)
    with answers(results, fit_readings=result):
        found = results.fit_flow_map("v", "forward", rows)
    assert found.map.rising_to == 4.75 and found.falls == pytest.approx(0.1111, abs=2e-4)
    (note,) = (note for note in found.warnings if note.key == "flow_maps.falls")  # type: ignore[attr-defined]
    told: Any = note
    assert (told.fields["above"], told.fields["end"]) == ("4.75 V", "6 V")
    assert (found.hysteresis, found.hysteresis_interval, found.map.shift) == (None, (0.0, 0.0), 0.0)


def test_a_map_without_drops_goes_by_the_command_alone():
    result, rows = fitted(lambda u: u - 1.0, [math.nan])
    with answers(results, fit_readings=result):
        found = results.fit_flow_map("v", "forward", rows)
    assert found.map.flow(np.array([3e6, 1e7]), 3.5) == pytest.approx(2.5e-4, rel=1e-4)
    assert found.map.increments.shape[1] == 26 and found.map.level
    assert found.warnings[-1].key == "flow_maps.level"  # type: ignore[attr-defined]


def test_the_motion_of_a_cylinder_is_that_of_its_rod_or_of_its_joint():
    """A speed is recorded, or that of the position; an angle tells nothing without a linkage."""
    t = TICK * np.arange(200)
    model = Model.of(shipped("slide_servo"))

    def motion(of: Model, **channels: np.ndarray) -> tuple[Any, Any]:
        name = of.layout.cylinders[0]
        record = Record(t, {f"{name}.{word}": values for word, values in channels.items()})
        return step_readings._motion(of, 0, record)

    assert motion(model, q=t, qd=t) == (None, None)
    x, v = motion(model, x=t**2)
    assert x.tolist() == (t**2).tolist() and v[1:-1] == pytest.approx(2.0 * t[1:-1])
    assert motion(model, x=t, v=3.0 * t)[1].tolist() == (3.0 * t).tolist()
    boom, q = Model.of(shipped("boom_four_valve")), 0.3 + 0.2 * np.sin(5.0 * t)
    x, v = motion(boom, q=q, qd=np.cos(5.0 * t))
    slope = np.gradient(x, TICK)
    assert v[1:-1] == pytest.approx(slope[1:-1], abs=1e-4 * float(np.ptp(slope)))
    assert motion(boom, q=q)[1] == pytest.approx(slope)
    assert motion(boom, q=q, x=t)[0].tolist() == t.tolist()


@pytest.mark.parametrize(("more", "blocks"), [(-1, 1), (0, 2), (49, 2)])
def test_a_chamber_takes_what_moves_it_squeezes_its_oil_and_leaks(more, blocks):
    """Q = A v + V/β dP/dt + leakage, in whole blocks of 50 samples."""
    rig = slide().with_values(
        {
            f"press.leakage_{end}": value
            for end, value in (("internal", 2e-12), ("head", 1e-12), ("rod", 3e-12))
        }
    )
    model = Model.of(rig)
    row, t = model.plant.cylinders[0], np.arange(200) * TICK
    x, head, rod = 0.1 + 0.05 * t, 8e6 + 2e6 * t, 3e6 - 1e6 * t
    record = Record(
        t,
        {
            "press.x": x,
            "press.v": np.full(200, 0.05),
            "press.p_head": head,
            "press.p_rod": rod,
            "p_tank": np.full(200, 2e5),
        },
    )
    window = slice(20, 120 + more)
    found = list(step_readings._steady_blocks(model, 0, record, window, 0.05))
    assert [block.first for block in found] == [20, 70][:blocks]
    for block in found:
        at = slice(block.first, block.first + 50)
        p = float(head[at].mean()), float(rod[at].mean())
        lost = 2e-12 * (p[0] - p[1])
        for side, (node, speed, rate, leak) in enumerate(
            (
                (row.node_head, row.area_head * 0.05, 2e6, lost + 1e-12 * (p[0] - 2e5)),
                (row.node_rod, -row.area_rod * 0.05, -1e6, -lost + 3e-12 * (p[1] - 2e5)),
            )
        ):
            volume = chamber_oil(row, side, float(x[at].mean()))
            oil = volume / bulk_of(row, p[side]) * rate
            assert block.inflow[int(node)] == pytest.approx(speed + oil + leak, rel=1e-6)
    for off in ({"press.p_head": 1.01 * row.relief_pressure},
                {"press.p_rod": 0.51 * row.cavitation_pressure}):  # fmt: skip
        given = Record(t, record.channels | {name: np.full(200, p) for name, p in off.items()})
        assert not list(step_readings._steady_blocks(model, 0, given, window, 0.05))


@pytest.mark.parametrize("noise", [0.3, 4.0])
def test_hysteresis_is_what_up_and_down_differ_by_over_the_slope(noise):
    """Of a map 0.1 u² s: a regression through zero, its error no less than that of the noise;
    readings below the deadband, of no way, silent, alone or left out say nothing."""
    rng = np.random.default_rng(4)
    u, s = np.linspace(0.5, 9.5, 60), np.linspace(0.3, 1.0, 60)
    r: Any = Stub(commands=np.array([0.0, 10.0]), u=u, s=s, cell=np.arange(60))
    r.sweep, r.silent = np.tile([1, -1, 0], 20), np.arange(60) == 30
    std = 1e-3 * (1.0 + u)
    lever = np.where(u > 2.0, -0.1 * r.sweep * u * s, 0.0)
    residuals = 0.3 * lever + noise * std * rng.standard_normal(60)
    keep = np.arange(60) != 40
    solution: Any = Stub(at=lambda u, s: 0.1 * u**2 * s, flow=None, lone=np.arange(60) == 50)
    for k in (30, 40, 50):
        residuals[k] += 9.0
    result: Any = Stub(readings=r, solution=solution, keep=keep, residuals=residuals)
    result.deadband, result.noise = Stub(value=2.0), Stub(std=lambda *_: std)
    value, error = fit._hysteresis_of(result)
    use = (r.sweep != 0) & ~np.isin(np.arange(60), [30, 40, 50])
    design, seen = (lever / std)[use], (residuals / std)[use]
    (expected,), squares, *_ = np.linalg.lstsq(design[:, None], seen, rcond=None)
    scatter = max(float(squares[0]) / (use.sum() - 1), 1.0)
    assert (scatter > 1.0) == (noise > 1.0)
    assert value == pytest.approx(expected)
    assert error == pytest.approx(math.sqrt(scatter / (design @ design)))
    for quiet in (Stub(sweep=np.maximum(r.sweep, 0)), Stub(u=np.full(60, 1.0))):
        result.readings = Stub(**vars(r) | vars(quiet))
        assert fit._hysteresis_of(result) == (0.0, 0.0)


def shifting(now: float, value=1.0, one_drop=False) -> Any:
    """A fit whose deadband shifts by so much."""
    r: Any = Stub(shift=now, commands=[0.0, 10.0], one_drop=one_drop, levels=[0.0, 10.0])
    r.shifted = float
    bent: Any = Stub(deadband=1.0, above=np.array([1.5, 9.0]), smoothing=0.0)
    bent.spline = lambda deadband: deadband
    return Stub(readings=r, shape=bent, used=Stub(shifted=lambda more: now + more),
                deadband=Stub(value=value), solution=Stub(widening=1.0))  # fmt: skip


@pytest.mark.parametrize(
    ("true", "value", "found"),
    [(0.2, 1.0, 0.2), (-0.35, 1.0, -0.35), (0.7, 0.2, 0.4), (0.2, 0.0, 0.0)],
)
@pytest.mark.parametrize(("gain", "sure"), [(1e6, True), (0.1, False)])
def test_a_shift_is_sought_within_twice_the_deadband(true, value, found, gain, sure):
    """By halves of its step; one that gains too little over the map without is none."""
    with answers(fit, replace=lambda item, **_: item, start_deadband=None,
                 likeliest_smoothing=lambda _, at, coarse: (None, gain * (at - true) ** 2),
                 regression=lambda *_: Stub(solve=lambda _: (None, 1e9))):  # fmt: skip
        shift, std = fit._shift_of(shifting(0.0, value))
    end, sure = 0.1 * fit.SETTINGS.shift * 10.0, sure and found != 0.0
    assert shift == pytest.approx(found if sure else 0.0, abs=end if sure else 0.0)
    assert std == pytest.approx(end if sure else 0.0)
    assert fit._shift_of(shifting(0.0, one_drop=True)) == (0.0, 0.0)


def test_a_shift_is_found_past_likelihoods_that_rise_before_it():
    def smoothed(_, at, coarse):
        return None, 1e3 * (at + 0.8) ** 2 + 600.0 * (-0.7 < at < -0.1)

    with answers(fit, replace=lambda item, **_: item, start_deadband=None,
                 likeliest_smoothing=smoothed,
                 regression=lambda *_: Stub(solve=lambda _: (None, 1e9))):  # fmt: skip
        assert fit._shift_of(shifting(0.0))[0] == pytest.approx(-0.8, abs=0.05)


@pytest.mark.parametrize("scale", [1e4, 1.0, -1e4])
def test_a_shift_ends_where_its_likelihood_does(scale):
    """−2 log L = 9 a² + 4 a b + 3 b² about its least, times a scale: its error is √(2 H⁻¹); a
    fourth power shows only far from there."""
    end, seen = 0.1 * fit.SETTINGS.shift * 10.0, []
    a, b = 1.0 - 0.3 * end, 0.3 + 0.4 * end

    def likelihood(deadband, shift):
        off = deadband - a, shift - b
        value = 9.0 * off[0] ** 2 + 4.0 * off[0] * off[1] + 3.0 * off[1] ** 2 + 1e3 * off[1] ** 4
        return Stub(solve=lambda _: (None, scale * value))

    with answers(fit, replace=lambda item, above: seen.append(above) or item,
                 regression=likelihood):  # fmt: skip
        shift, std = fit._shift_of(shifting(0.3))
    assert all(above == pytest.approx([1.5, 10.0 + 10.0 * end]) for above in seen)
    error = (
        math.sqrt(2.0 * np.linalg.inv(scale * np.array([[18.0, 4.0], [4.0, 6.0]]))[1, 1])
        if scale > 0
        else end
    )
    expected = (b if scale > 0 else 0.3, error) if scale != 1.0 else (0.0, 0.0)
    assert (shift, std) == pytest.approx(expected, abs=1e-4 if scale < 0 else 6e-5)


@pytest.mark.parametrize(
    ("shifts", "asked", "std"),
    [
        ([(0.0, 0.0)], [0.0], 0.0),
        ([(0.3, 0.01)] * 2, [0.0, 0.3], 0.01),
        ([(0.3, 0.01), (0.3005, 0.01)], [0.0, 0.3], 0.01),
        ([(0.3, 0.01), (0.302, 0.01), (0.302, 0.01)], [0.0, 0.3, 0.302], 0.01),
        ([(0.3, 0.01), (0.0, 0.0), (0.2, 0.01)], [0.0, 0.3, 0.0], 0.0),  # it did not last
    ],
)
def test_a_shift_is_taken_off_until_it_stays(shifts, asked, std):
    result, _ = fitted(lambda u: u - 1.0)
    turns, found = [], iter(shifts)

    def iterate(r, _):
        turns.append(r.shift)
        return replace(result, readings=r)

    with answers(fit, sort_readings=result.readings, _find_leak=lambda _: None, _iterate=iterate,
                 _hysteresis_of=(0.0, 0.0), _shift_of=lambda _: next(found)):  # fmt: skip
        last = fit.fit_readings("map", None, None)
    assert turns == asked and last.shift_std == std
    assert (last.hysteresis, last.readings.shift) == (None, asked[-1])


def test_a_hysteresis_is_taken_off_until_it_stays():
    """While it is sure by four standard errors, or more than a tenth of one."""
    result, _ = fitted(lambda u: u - 1.0)
    r = replace(result.readings, sweep=np.ones(result.readings.u.size, int))
    more, asked = iter([(0.3, 0.01), (0.05, 0.01), (-5e-4, 0.01)]), []
    with answers(fit, sort_readings=lambda *given: asked.append(given[3]) or r,
                 _find_leak=lambda _: None, _iterate=replace(result, readings=r),
                 _hysteresis_of=lambda _: next(more), _shift_of=(0.0, 0.0)):  # fmt: skip
        last = fit.fit_readings("map", None, None)
    assert asked == pytest.approx([0.0, 0.3, 0.35])
    assert last.hysteresis == fit.Hysteresis(pytest.approx(0.3495), 0.01, True)


def test_what_repeats_support_agrees_within_five_deviations():
    """However far from the map; a reading alone is backed by none."""
    r: Any = Stub(cell=np.array([0, 0, 1, 1, 2]))
    noise: Any = Stub(std=lambda *_: np.full(5, 2.0))
    heard = 100.0 + np.array([10.0, 19.0, 0.0, 11.0, 5.0])
    alone = fit.unbacked(r, noise, heard, np.full(5, 100.0))
    assert alone.tolist() == [False, False, True, True, True]


def test_cells_are_means_by_the_noise_of_what_is_kept_and_heard():
    """A silent reading is heard as the map has it, and counts where the map is surely above."""
    r: Any = Stub(cell=np.array([0, 0, 0, 1, 1]), limit=np.array([0.0, 0.0, 0.0, 1.0, 1.0]))
    r.rated, r.u, r.s = 10.0, np.array([1.0, 2.0, 9.0, 3.0, 4.0]), np.ones(5)
    r.heard = lambda flow: np.array([0.2, 0.4, 9.0, 0.5, 0.1])
    noise: Any = Stub(std=lambda *_: np.array([0.1, 0.2, 0.1, 0.1, 0.1]), replicates=7)
    keep = np.arange(5) != 2
    found = gather_cells(r, noise, keep, np.array([0.3, 0.3, 0.3, 0.31, 0.29]))
    assert found.weight == pytest.approx([125.0, 100.0])
    assert found.y == pytest.approx([(100.0 * 0.2 + 25.0 * 0.4) / 125.0, 0.5])
    assert found.u == pytest.approx([1.2, 3.0])
    assert (found.count.tolist(), found.replicates) == ([2.0, 2.0], 7)


@pytest.mark.parametrize(
    ("given", "key"),
    [({}, ""), ({"widening": 1.9}, ""), ({"widening": 2.1}, "lack_of_fit"),
     ({"trial_scatter": 1.9e-3}, ""), ({"trial_scatter": 2.1e-3}, "trial_scatter"),
     ({"replicates": 0}, "no_repeats"), ({"status": "not_excited"}, "not_excited"),
     ({"noise": 0.049}, ""), ({"noise": 0.051}, "scatter"), ({"noise": 0.051, "flow": 0.09}, ""),
     ({"far": 2}, "backed_outliers"), ({"far": 1}, "")],
)  # fmt: skip
def test_a_map_is_doubted_beyond_its_limits(given, key):
    noise, flow = given.pop("noise", 0.01), np.full(150, given.pop("flow", 0.5))
    solution: Any = Stub(lone=np.zeros(1, bool), flow=flow, widening=given.pop("widening", 1.0))
    sigmas = np.where(np.arange(150) < given.pop("far", 0), -5.1, 4.9)
    result: Any = Stub(solution=solution, keep=np.ones(150, bool), sigmas=sigmas)
    result.noise = Stub(std=lambda _, flow: noise * flow)
    result.readings = Stub(cell=np.zeros(150, int), commands=[1.0], show=Units())
    told = Stub(**{"outliers": (), "replicates": 9, "status": "", "trial_scatter": 0.0} | given)
    notes: Any = list(results._warnings(result, told))
    assert [note.key for note in notes] == ([f"flow_maps.{key}"] if key else [])


def test_a_misfit_counts_what_both_keep_over_the_noise_of_one():
    """(1/1)² + (4/2)² over a lack of 4, and twice three parameters."""
    one: Any = Stub(
        readings=None,
        residuals=np.array([1.0, 4.0, 3.0, 9.0]),
        keep=np.array([True, True, False, True]),
        solution=Stub(parameters=3.0),
    )
    by: Any = Stub(
        noise=Stub(std=lambda *_: np.array([1.0, 2.0, 1.0, 1.0])),
        keep=np.array([True, True, True, False]),
        solution=Stub(flow=None, lack=4.0),
    )
    assert fit._misfit(one, by) == pytest.approx(1.25 + 6.0)


@pytest.mark.parametrize("least", [(-4.5, -2.25), (-2.25, -4.5), (-12.0, 0.0), (0.0, -11.75)])
@pytest.mark.parametrize("coarse", [True, False])
def test_penalties_are_the_likeliest_of_a_lattice_of_quarter_decades(least, coarse):
    work: Any = Stub(unit=np.array([2.0, 3.0]))
    work.score = lambda p: (p[0] - least[0]) ** 2 + 2.0 * (p[1] - least[1]) ** 2
    plain = shape.Shape(
        1.0, np.arange(2.0, 9.0), shape.Axis(np.linspace(0, 1, 5), 3), np.array([2e-6, 3e-6])
    )
    with answers(shape, regression=work):
        found, value = shape.likeliest_smoothing(plain, None, coarse)
        along = [shape.roughly_smoothed(plain, None, k) for k in (0, 1)]
    if coarse or max(abs(x + 6.0) for x in least) <= 5.0:
        assert np.log10(found.smoothing / work.unit) == pytest.approx(least)
        assert value == 0.0
    for k, (item, score) in enumerate(along):
        at = np.log10(item.smoothing / work.unit)
        assert at[1 - k] == pytest.approx(-6.0)
        nearest = min(shape._COARSE, key=lambda x: abs(x - least[k]))
        assert at[k] == pytest.approx(nearest)
        assert score == pytest.approx(work.score(at))


def rows_of(valve="servo_supply_head", way="forward", size=20, **columns: Any):
    given = {
        "command": np.linspace(0.5, 5.0, size),
        "drop": np.full(size, 1e6),
        "flow": np.linspace(1e-5, 1e-4, size),
    } | columns
    first = [given.pop(name) for name in ("command", "drop", "flow")]
    return readings_table(*first, valve=valve, direction=way, **({"file": "a/b.csv"} | given))


@pytest.mark.parametrize(
    ("rig", "valve", "way", "sign", "name", "side"),
    [
        ("slide_servo", "servo_supply_rod", "forward", -1, "servo_supply_rod", "forward"),
        ("slide_servo", "press.servo_rod_tank", "reverse", 1, "servo_rod_tank", "reverse"),
        ("slide_servo", "servo", "head -> tank", -1, "servo_head_tank", "forward"),
        ("slide_servo", "press.servo", "tank->rod", 1, "servo_rod_tank", "reverse"),
        ("thesis_arm", "stick.servo", "supply->head", 1, "stick.servo_supply_head", "forward"),
        ("thesis_arm", "boom.regen", "reverse", 1, "regen", "reverse"),
        ("thesis_arm", "REGEN", "forward", 1, "regen", "forward"),
        ("slide_servo", "servo", "forward", 1, "flow_maps.several_edges", ""),
        ("slide_servo", "servo", "head->rod", 1, "flow_maps.unknown_direction", ""),
        ("slide_servo", "servo_supply_hed", "forward", 1, "flow_maps.unknown_edge", ""),
        ("slide_servo", "pump", "forward", 1, "flow_maps.unknown_edge", ""),
        ("slide_servo", "servo_supply_rod", "forward", 1, "flow_maps.wrong_sign", ""),
        ("slide_servo", "servo_supply_head", "forward", -1, "flow_maps.wrong_sign", ""),
        ("slide_servo", "servo_supply_head", "forward", -0.3, "flow_maps.wrong_sign", ""),
        ("slide_servo", "servo_supply_head", "forward", 2.03, "", "forward"),
        ("slide_servo", "servo_supply_head", "forward", 2.05, "flow_maps.outside_driver", ""),
    ],
)
def test_readings_go_to_the_edge_that_they_name(rig, valve, way, sign, name, side):
    """With commands as openings, up to a hundredth of 20 V beyond 10 V."""
    rows = rows_of(valve, way, command=sign * np.linspace(0.5, 5.0, 20))
    first = int(rows.line[0])
    if not side:
        with refused(name) as said:
            tables.prepare_readings(shipped(rig), [rows])
        assert (said.value.file, said.value.line) == ("b.csv", 20 if "outside" in name else first)
        near = said.value.hint == "did you mean 'servo_supply_head'?"
        assert near == (valve == "servo_supply_hed")
        return
    (edge,) = tables.prepare_readings(shipped(rig), [rows]).edges
    assert (edge.edge, edge.side) == (name or valve, side)
    assert edge.sign == np.sign(sign) and edge.rows.file[0] == "b.csv"
    assert edge.rows.command == pytest.approx(abs(sign) * np.linspace(0.5, 5.0, 20))


@pytest.mark.parametrize("sign", [1, -1])
def test_a_measured_command_scatters_about_rest(sign):
    """By up to a hundredth of the largest, 10 V."""
    valve = {1: "servo_supply_head", -1: "servo_supply_rod"}[sign]
    command = sign * np.linspace(0.5, 5.0, 20)
    command[:2] = -0.099 * sign, 0.002 * sign
    (edge,) = tables.prepare_readings(
        shipped("slide_servo"), [rows_of(valve, command=command)]
    ).edges
    assert edge.rows.command[:3] == pytest.approx([0.0, 0.002, abs(command[2])])
    command[0] = -0.101 * sign
    with refused("flow_maps.wrong_sign"):
        tables.prepare_readings(shipped("slide_servo"), [rows_of(valve, command=command)])


@pytest.mark.parametrize(
    ("flow", "ratio"), [(1e-4, None), (0.9e-6, None), (0.019, None), (0.022, 20.9)]
)
def test_flows_far_from_what_the_supply_can_give_are_told(flow, ratio):
    """1 L/s: above twenty times nine of ten."""
    flows = flow * np.linspace(0.5, 1.0, 21)[:-1] / 0.975
    with answers(tables, gain_ratio=1.0):
        (edge,) = tables.prepare_readings(shipped("slide_servo"), [rows_of(flow=flows)]).edges
    told: list[Any] = list(edge.notes)
    assert [note.fields["ratio"] for note in told] == pytest.approx(
        [ratio] if ratio else [], rel=2e-3
    )


@pytest.mark.parametrize(("again", "lines"), [(3, "18, 19, 20"), (6, "15, 16, 17, 18, 19, …")])
def test_rows_that_stand_twice_are_told(again, lines):
    """Nothing is of a meter at rest."""
    flow = np.linspace(0.0, 1e-4, 20)
    command = np.linspace(0.5, 5.0, 20)
    for values in (flow, command):
        values[20 - again :] = values[1]
        values[2:4] = values[0]
    (note,) = tables._file_notes(rows_of(flow=flow, command=command))
    told: Any = note
    assert (told.fields["count"], told.fields["lines"]) == (again, lines)


@pytest.mark.parametrize("by", ["drop", "command"])
def test_a_temperature_that_goes_with_the_readings_is_told(by):
    """From 40 to 45 °C, with the root of the drop or with the command; what says nothing of it
    does not count."""
    part = np.linspace(0.0, 1.0, 22)
    rows: Any = Stub(pressure_drop=np.full(22, 4e6), command=np.full(22, 2.0))
    if by == "drop":
        rows.pressure_drop = 1e6 * (1.0 + part) ** 2
    else:
        rows.command = 1.0 + part
    rows.temperature = 273.15 + 40.0 + 5.0 * part
    rows.pressure_drop[7], rows.temperature[7], rows.temperature[8] = 0.0, 400.0, np.nan
    show = tables._units(shipped("slide_servo"), 1)
    (note,) = tables._warming(rows, show, "degC")
    told: Any = note
    assert told.key == f"flow_maps.warm_with_{by}"
    assert told.fields["correlation"] == pytest.approx(1.0)
    assert (told.fields["cold"], told.fields["warm"]) == ("40 degC", "45 degC")
    ends = ("10 bar", "40 bar") if by == "drop" else ("1 V", "2 V")
    assert (told.fields["low"], told.fields["high"]) == ends
    rows.temperature[:] = 313.0
    assert list(tables._warming(rows, show, "degC")) == []


def test_a_table_of_points_has_every_reading_with_its_fitted_flow():
    """A drop that was not measured is the nominal one; at a hysteresis the fitted flow is that of
    the reading's own side."""
    rows = rows_of(
        "servo",
        size=3,
        command=np.array([1.0, 2.0, 3.0]),
        method="meter",
        drop=np.array([1e6, np.nan, 2e6]),
        flow=np.array([1e-4, 2e-4, 4e-4]),
    )
    built: Any = Stub(valve="servo", direction="forward", drop_max=5e6, rated_flow=1e-4)
    built.flow = lambda drop, u: 1e-4 * u + 1e-12 * drop
    fit: Any = Stub(rows=rows, map=built, sign=-1, residuals=np.array([0.0, 1e-5, np.nan]))
    fit.outliers = (Stub(file="a/b.csv", line=2),)
    head, *lines = tables.points_table([fit], shipped("slide_servo")).splitlines()
    assert head.startswith("valve,direction,command [V],driver_command [V],pressure_drop [bar],")
    assert lines == [
        "servo,forward,1,-1,10,6,6.06,meter,0,a/b.csv,1",
        "servo,forward,2,-2,50,12,11.4,meter,1,a/b.csv,2",
        "servo,forward,3,-3,20,24,18.12,meter,0,a/b.csv,3",
    ]


@pytest.mark.parametrize("shift", [0.0, 0.4])
def test_a_meter_shows_nothing_below_its_limit_and_a_shift_moves_openings(shift):
    """By half of it down at the largest drop, as much up at none. The root of a drop bends below a
    hundredth of the largest."""
    command, drop = (a.ravel() for a in np.meshgrid(np.arange(1.0, 6.0), np.arange(1.0, 7.0)))
    flow = 1e-6 * np.arange(1.0, 31.0)
    rows = readings_table(command, 1e6 * drop, flow)
    r = sort_readings("map", rows, FlowMapOptions(meter_limit=3.5e-6), 0.0).shifted(shift)
    assert r.q[r.silent].tolist() == [0.0] * 3 and r.silent.sum() == 3
    assert r.q[~r.silent] == pytest.approx(flow[r.row][~r.silent])
    assert r.u == pytest.approx(r.command - shift * (r.drop / 6e6 - 0.5))
    assert r.shifted(0.0).u == pytest.approx(r.command)
    assert r.delta == pytest.approx(6e4)
    assert (r.step == r.level).all() or shift
    assert (r.levels[r.step] >= r.u - 1e-12).all()


def test_a_display_rounds_by_its_smallest_step_over_the_root_of_twelve():
    """Of each method its own; steps of rounding are none."""
    command, drop = (a.ravel() for a in np.meshgrid(np.arange(1.0, 6.0), np.arange(1.0, 7.0)))
    method = np.where(np.arange(30) % 2, "meter", "cylinder")
    flow = 1e-6 * np.arange(1.0, 31.0) * np.where(method == "meter", 1.0, 2.0)
    flow[3] = flow[5] * (1.0 + 1e-13)
    r = sort_readings(
        "map", readings_table(command, 1e6 * drop, flow, method=method), FlowMapOptions(), 0.0
    )
    assert r.digit == pytest.approx(
        {"cylinder": 4e-6 / r.rated / 12**0.5, "meter": 2e-6 / r.rated / 12**0.5}
    )


@pytest.mark.parametrize("times", [1, 3])
def test_noise_is_the_scatter_of_repeats_or_what_a_map_leaves(times):
    """Over its degrees of freedom: n − 1 of n readings of a cell, or one less the leverage, of
    which a tenth stays; silent readings, left out ones, and a map of no flow."""
    size = 30 * times
    rng = np.random.default_rng(6)
    r: Any = Stub(cell=np.repeat(np.arange(30), times), y=0.01 * rng.standard_normal(size))
    r.method, r.silent = np.full(size, "meter"), np.arange(size) == 2
    keep, leverage = np.arange(size) != 9, np.where(np.arange(size) % 2, 0.3, 0.97)
    found = measure_noise(r, Noise({"meter": (9.0, 9.0)}), keep, leverage, np.zeros(size))
    use = keep & ~r.silent
    if times == 1:
        squares, dof = r.y[use] ** 2, np.maximum(1.0 - leverage, 0.1)[use].sum()
    else:
        groups = [r.y[use & (r.cell == k)] for k in range(30)]
        squares = np.concatenate([(y - y.mean()) ** 2 for y in groups])
        dof = use.sum() - 30.0
    floor, share = found.methods["meter"]
    assert (floor, share) == (pytest.approx(math.sqrt(squares.sum() / dof)), 0.0)
    assert found.replicates == (0 if times == 1 else dof)


@pytest.mark.parametrize("share", [0.03, 0.3])
def test_noise_that_goes_with_the_flow_is_a_share_of_it(share):
    flow = np.repeat(np.linspace(0.1, 1.0, 40), 25)
    rng = np.random.default_rng(7)
    r: Any = Stub(cell=np.repeat(np.arange(40), 25), silent=np.zeros(1000, bool))
    r.y, r.method = flow * (1.0 + share * rng.standard_normal(1000)), np.full(1000, "meter")
    found = measure_noise(r, Noise({"meter": (0.0, 0.0)}), r.y < 9.0, 0.0 * flow, flow)
    # by 960 degrees of freedom to 2.3 %, and the lattice of ratios to as much
    assert found.methods["meter"][1] == pytest.approx(share, rel=0.08)
    assert found.methods["meter"][0] < 0.02 * share and found.replicates == 960


def test_cells_shift_about_half_of_the_largest_drop_and_lose_their_weight():
    s = np.array([0.0, 0.5, 1.0])
    cells = Cells(np.array([1.0, 2.0, 3.0]), s, s, np.ones(3), np.ones(3), s, 0)
    assert cells.shifted(0.2).u == pytest.approx([1.1, 2.05, 2.9])
    assert cells.shifted(0.0) is cells and cells.without(np.zeros(3, bool)) is cells
    some = cells.without(np.array([False, True, False]))
    assert some.weight.tolist() == [1.0, 0.0, 1.0] and some.weighed == 2
    assert cells != some and cells == replace(cells, u=cells.u.copy())
    assert len({cells, some, replace(some)}) == 2


@pytest.mark.parametrize(
    ("y", "lack", "first", "low", "high", "bracket"),
    [
        ([1e-4, 1e-3, 1.9e-3, 0.3, 0.5, 0.9], 1.0, 3, 1.0, 3.98, (3.0, 4.0)),
        ([1e-4, 1e-3, 2.1e-3, 0.3, 0.5, 0.9], 1.0, 2, 1.0, 2.98, (2.0, 3.0)),
        ([1e-4, 1e-3, 2.1e-3, 0.3, 0.5, 0.9], 4.0, 3, 1.0, 3.98, (3.0, 4.0)),
        ([1e-4, 5e-3, 1.9e-3, 0.3, 0.5, 0.9], 1.0, 3, 1.0, 3.98, (3.0, 4.0)),
        ([1e-4, 5e-3, 0.1, 0.3, 0.5, 0.9], 1.0, 1, 0.0, 1.98, (1.0, 2.0)),
        ([5e-3, 5e-3, 0.1, 0.3, 0.5, 0.9], 1.0, 0, 0.0, 0.98, (0.0, 1.0)),
        ([1e-4, 2e-3, 1e-3, 1e-3, 0.5, 0.9], 1.0, None, 0.0, 0.0, None),
    ],
)  # fmt: skip
def test_a_deadband_lies_below_the_first_command_that_surely_passes(
    y, lack, first, low, high, bracket
):
    """By four errors, which are 10⁻³ of a reading, half of that of four, and more with a lack of
    fit; it lies above the last but one of the commands below the last that is shut."""
    readings: Any = Stub(levels=np.arange(1.0, 7.0), cell_level=np.arange(6), who="map")
    readings.show = Units()
    cells: Any = Stub(weight=np.full(6, 4e6), y=np.array(y), count=np.full(6, 4.0))
    if first is None:
        with refused("flow_maps.mostly_shut", InsufficientData):
            shape.window_of(readings, cells, lack)
        return
    found = shape.window_of(readings, cells, lack)
    assert (found.opens, found.low, found.bracket) == (first, low, bracket)
    assert found.high == pytest.approx(high) and found.flows_at_lowest == (first == 0)


def test_errors_that_a_recipe_states_count_for_a_flowmeter_too():
    """The drop is of two sensors."""
    recipe = Stub(method="flowmeter", calibration=(), calibration_drop=None, meter_limit=1e-5)
    recipe.pressure_error, recipe.command_error = 1e4, 0.1
    edges = [Stub(edge="sh", side="forward")]
    prepared: Any = Stub(recipe=recipe, state=Stub(rig=None), readings=Stub(edges=edges))
    given = first_call(tables, "fit_edge", lambda: FlowMapStage().work(prepared, Path(), None))
    options = given[2]
    assert (options.meter_limit, options.command_std) == (1e-5, 0.1)
    assert options.drop_std == pytest.approx(2.0**0.5 * 1e4)


@pytest.mark.parametrize(
    ("at", "shut"),
    [(2.0, True), (2.013, True), (2.013, False), (0.0, True), (0.06, True), (4.0, True)],
)
def test_a_deadband_is_where_its_likelihood_is_largest_with_its_spread(at, shut):
    """A parabola of 0.5 V, between the places looked at; at 95 % or, extrapolated, 99.9 %."""
    grid = np.linspace(0.0, 4.0, 81)
    window = shape.Window(0.0, 4.0, 1, (0.0, 4.0), not shut)
    readings: Any = Stub(levels=np.linspace(0.0, 10.0, 11))
    plain = shape.Shape(1.0, np.arange(2.0, 9.0), shape.Axis(np.linspace(0, 1, 5), 3), np.ones(2))
    with answers(shape, window_of=window, profile_deadband=(grid, ((grid - at) / 0.5) ** 2)):
        found, built = shape.find_deadband(readings, plain, None, 1.0)
    assert found.value == built.deadband == pytest.approx(at, abs=1e-4)
    assert found.at_bound == (at < 0.1) and built.above.tolist() == list(range(1, 11))
    half = 0.5 * math.sqrt(shape.SETTINGS.level_95 if shut else shape.SETTINGS.level_999)
    high = 4.005 if at == 4.0 else at + half  # by 5e-4 of the commands, where nothing is beyond
    assert found.interval == pytest.approx((max(at - half, 0.0), high), abs=2e-3)
    weight = np.exp(-0.5 * ((grid - at) / 0.5) ** 2)
    spread = np.average((grid - found.value) ** 2, weights=weight) + 0.05**2 / 12.0
    assert found.std == pytest.approx(math.sqrt(spread))
    narrow = shape.Window(2.0, 2.0, 1, (0.0, 4.0), False)
    with answers(shape, window_of=narrow, profile_deadband=None):
        none, built = shape.find_deadband(readings, plain, None, 1.0)
    assert none == shape.Deadband() and built.deadband == 0.0


@pytest.mark.parametrize(
    ("at", "low"),
    [(1.7, 1.7 - 0.2 * math.sqrt(6.635)), (1.6, 1.6 - 0.2 * math.sqrt(6.885)), (0.4, 0)],
)
def test_a_soft_start_lies_where_the_logs_deny_it_at_99_in_a_hundred(at, low):
    """Of a parabola of 0.2 V, above that of the kink found at 1.7 V; at the lowest place where it
    is not denied there, and no higher than the interval was."""

    def likelihood(spline, _):
        return Stub(solve=lambda _: (None, ((spline - at) / 0.2) ** 2 + 7.0, None))

    bent: Any = Stub(spline=lambda u, soft: u if soft else math.nan, smoothing=None)
    window = shape.Window(0.0, 3.0, 1, (0.0, 3.0), False)
    given = shape.Deadband(1.7, 0.1, (1.6, 1.8), False)
    with answers(shape, regression=likelihood):
        found = shape.soften(None, bent, None, given, window)
        lower = shape.soften(None, bent, None, replace(given, interval=(-1.0, 1.8)), window)
    assert found == replace(given, interval=(pytest.approx(low, abs=1e-4), 1.8))
    assert lower.interval == (-1.0, 1.8)
    shut = replace(window, high=0.0)
    assert shape.soften(None, bent, None, given, shut) is given


def test_a_maps_error_has_what_trials_commands_and_drops_are_off_by():
    """Of a flow u·d: two trials, of which one reads the larger commands; what a command and a drop
    are off by goes with the slopes; half of what the root of a small drop differs by; what a number
    makes of it from one end of its interval to the other, that of a shift by the drop."""
    d, more = np.array([0.3, 0.5, 0.8]), 0.2
    s, u = d / (d**2 + more**2) ** 0.25, np.array([1.0, 1.5, 2.0])
    r: Any = Stub(commands=np.array([1.0, 2.0]), level=np.array([0, 0, 1, 1]), delta=2e5)
    r.trial, r.drop_max, r.command_std, r.drop_std = np.array([1, 2, 1, 2]), 1e6, 0.01, 0.02
    design = lambda u, s: (u * np.repeat(d[None], 3, axis=0).ravel())[:, None]  # noqa: E731
    solution = Stub(spline=Stub(design=design), coefficients=np.ones(1), widening=3.0)
    solution.variance = lambda design: np.full(9, 1e-4)
    result: Any = Stub(readings=r, solution=solution, used=Stub(shifted=lambda more: None))
    result.keep = np.array([True, True, True, False])
    low, high = (Stub(design=design, size=np.array([size])) for size in (1.0, 1.3))
    sides = [(((low, 0.0), (high, 0.0)), 1.0), (((low, -0.2), (low, 0.2)), 2.0)]
    solved = lambda spline, _: Stub(solve=lambda smoothing: (spline.size * smoothing,))  # noqa: E731
    parts = {"_missed": np.full(9, 2e-4), "_between": np.full(9, 3e-4)}
    with answers(results, **parts, _uncertain=lambda _: sides, regression=solved):
        found = results._flow_std(result, u, s, 0.05)
    flow, few = np.outer(u, d), np.sqrt(2.0 / np.array([2.0, 1.5, 1.0]))[:, None]
    square = 3e-4 + 5e-4 + (0.05 * few * flow) ** 2
    square = square + (0.5 * flow * (np.sqrt(d) / s - 1.0)) ** 2
    square += (0.01 * d) ** 2 + (0.02 * u[:, None]) ** 2
    square += ((0.3 * flow) ** 2 + (0.8 * (s**2 - 0.5) * d) ** 2) / (2.0 * Z95) ** 2
    assert found == pytest.approx(np.sqrt(square))


def test_a_map_is_drawn_with_each_number_at_either_end_of_its_interval():
    """Also softly from below the deadband; a deadband is not below zero. The deadband's ends are
    smoothed as its error was found, the others as the map."""

    class Shape(Stub):
        def spline(self, *at, **how):
            return (self.kinks, *at, *how)

    kinks = [Stub(value=3.0, std=0.2), Stub(value=5.0, std=0.1)]

    def fit(value, std, low, shift, some):
        return Stub(
            shape=Shape(kinks=(), smoothing=1),
            kinks=some,
            shift_std=shift,
            deadband=Stub(value=value, std=std, interval=(low, 9.0), smoothing=2),
        )

    def drawn(*given) -> Any:
        with answers(results, replace=lambda _, kinks: Shape(kinks=kinks)):
            return list(results._uncertain(fit(*given)))

    assert drawn(1.0, 0.0, 1.0, 0.0, []) == []
    (drawing,) = drawn(1.0, 0.3, 1.0, 0.0, [])
    assert drawing == (((((), 1.0 - 0.3 * Z95), 0.0), (((), 1.0 + 0.3 * Z95), 0.0)), 2)
    ((sides, _),) = drawn(1.0, 0.6, 1.0, 0.0, [])
    assert sides[0] == (((), 0.0), 0.0)
    (drawing,) = drawn(1.0, 0.0, 0.7, 0.0, [])
    assert drawing == (((((), 0.7, "soft"), 0.0), (((),), 0.0)), 1)
    (drawing,) = drawn(1.0, 0.0, 1.0, 0.1, [])
    assert drawing == (((((),), -0.1 * Z95), (((),), 0.1 * Z95)), 1)
    ends = [
        [(1.0 * end[0][0][1], end[1]) for end in sides]
        for sides, smoothing in drawn(1.0, 0.0, 1.0, 0.0, kinks)
        if smoothing == 1
    ]
    assert ends == [
        [(3.0 - 0.2 * Z95, 0.0), (3.0 + 0.2 * Z95, 0.0)],
        [(5.0 - 0.1 * Z95, 0.0), (5.0 + 0.1 * Z95, 0.0)],
    ]


# --- loops of operating points


@pytest.mark.parametrize(
    ("function", "q1", "q2"),
    [
        ("extend_resistive", (0, 0), (0, 1)),
        ("extend_overrunning", (-1, 0), (0, 0)),
        ("extend_resistive_regeneration", (0, 0), (-1, 1)),
        ("retract_resistive", (-1, 0), (0, 0)),
        ("retract_overrunning", (0, 0), (0, 1)),
    ],
)
def test_the_off_side_lets_more_out_the_higher_its_pressure(function, q1, q2):
    """Of the head end less goes in; in regeneration it is held above the head end."""
    seen = np.array([[0.0, 1.0, 0.0, 0.5], [0.0, 0.0, 1.0, 2.0]])
    flows = _off_side_flows(Law(1.0, 3e-9, 0.0), seen, FUNCTIONS.index(function))
    assert flows == pytest.approx(3e-9 * np.array([q1, q2]) @ seen)


def test_a_fast_stable_pole_is_left_out_however_little_it_is_damped():
    poles = np.array([-0.5 + 1e3j, -0.5 - 1e3j, -3.0 + 4.0j, -3.0 - 4.0j])
    assert float(damping_ratio(poles, 100.0)) == pytest.approx(0.6)
    assert float(damping_ratio(poles, 2e3)) == pytest.approx(5e-4)
    poles[:2] += 1.0
    assert float(damping_ratio(poles, 100.0)) == pytest.approx(-5e-4)


def test_the_margins_of_a_loop_that_too_little_gain_makes_unstable_as_well():
    """K (s + 1)²/((s + 0.01)³ (s/50 + 1)²): stable between two factors, of which one is below 1."""
    from scipy.optimize import brentq
    from scipy.signal import tf2ss

    bottom = np.polymul(np.poly([-0.01] * 3), np.polymul([0.02, 1.0], [0.02, 1.0]))

    def growth(gain: float) -> float:
        return float(np.roots(np.polyadd(bottom, gain * np.poly([-1.0, -1.0]))).real.max())

    ends: Any = [brentq(growth, *about, xtol=1e-12) for about in ((0.2, 2.0), (10.0, 500.0))]
    gain = 1.5 * ends[0]
    a, b, c, _ = tf2ss(gain * np.poly([-1.0, -1.0]), bottom)
    loop = OpenLoop(a, b[:, 0], c[0])
    assert loop.growth(0.6) > 0.0 > loop.growth(0.7)
    assert gain_margin(loop) == pytest.approx(ends[1] / gain, rel=1e-6)
    omega = np.geomspace(1e-3, 1e3, 200_001)
    reply = gain * np.polyval(np.poly([-1.0, -1.0]), 1j * omega) / np.polyval(bottom, 1j * omega)
    at = np.flatnonzero(np.diff(np.abs(reply) > 1.0))
    assert phase_margin(loop) == pytest.approx(np.abs(np.angle(-reply[at])).min(), abs=1e-3)


def test_a_mount_gives_way_and_a_load_sways_by_their_equations():
    """At any state: (c + f) u = c v + A₁P₁ − A₂P₂ − k δ, and m ẇ = −(k z + c (w − v))."""
    row: Any = Stub(mount_damping=3.0, mount_stiffness=50.0, area_head=2.0, area_rod=1.5)
    names, x = ("v", "p_head", "p_rod", "a.mount_deflection", "a.opening"), np.arange(1.0, 6.0)
    a, inflow = np.zeros((5, 5)), np.zeros((2, 5))
    point: Any = Stub(mass=4.0, v=0.2)
    with answers(linear, friction_slope=0.7):
        linear._give_way(row, point, names, a, inflow)
    slip = (3.0 * x[0] + 2.0 * x[1] - 1.5 * x[2] - 50.0 * x[3]) / 3.7 - x[0]
    assert a @ x == pytest.approx([-0.7 * slip / 4.0, 0.0, 0.0, slip, 0.0])
    assert inflow @ x == pytest.approx([-2.0 * slip, 1.5 * slip])
    load: Any = Stub(sway_damping=0.3, sway_stiffness=7.0, sway_mass=2.5)
    names, a = ("v", "p_head", "p_rod", "a.sway", "a.sway_speed"), np.zeros((5, 5))
    linear._swaying(load, point, names, a)
    pull = 7.0 * x[3] + 0.3 * (x[4] - x[0])
    assert a @ x == pytest.approx([pull / 4.0, 0.0, 0.0, x[4] - x[0], -pull / 2.5])


@pytest.mark.parametrize(
    ("margin", "supply", "follows"), [(0.0, 1e6, False), (1e5, 3e6, False), (1e5, 2e6, True)]
)
def test_a_pump_that_follows_others_is_constant_at_a_point(margin, supply, follows):
    model = Model.of(shipped("slide_servo"))
    row = model.plant.supply.copy()
    row.margin, row.pressure = margin, 9e6
    model = replace(model, plant=model.plant._replace(supply=row))
    point, recipe = Stub(p_supply=supply), Stub(also_moving=())
    # pyrefly: ignore[bad-specialization]
    given: Any = Study(model.rig, None, recipe, "press", 0.0, 0.0)
    with answers(study, operating_point=point, sensed_pressure=2e6):
        found, at = given.steady(model, None, 1, None, 0, Aim(0.0, 0.0))
    assert at is point and (found is not model) == follows
    told = found.plant.supply
    assert (told.pressure, told.margin) == ((supply, 0.0) if follows else (9e6, margin))
    assert (row.pressure, row.margin) == (9e6, margin)


@pytest.mark.parametrize(("limit", "more"), [(0.05, True), (math.inf, False), (0.0, False)])
def test_the_largest_budget_that_keeps_the_demands_is_closed_in_on(limit, more):
    """Where none does, that which comes closest; what is done goes on and is below 1."""
    settings, done, seen = arc.ARC_SEARCH, [], {}
    first = np.geomspace(*settings.budgets)
    limit = limit and (math.sqrt(first[2] * first[3]) * 1.01 if more else limit)

    def candidate(budget: float) -> Any:
        return Stub(met=budget <= limit, closeness=-abs(math.log(budget / first[1])))

    search = Stub(candidate=candidate, share=lambda reached: reached["closeness"])
    with answers(arc, Search=lambda _: search,
                 _result=lambda _, __, budget, tried: seen.update(tried) or budget):  # fmt: skip
        found: Any = arc.tune_arc(None, lambda _, share: done.append(share))
    assert len(seen) == first.size + more * settings.refinements
    assert done == sorted(done) and 0.0 <= done[0] < done[-1] < 1.0
    if not more:
        assert found == pytest.approx(first[-1] if limit else first[1])
    else:
        width = math.log(first[3] / first[2]) / 2**settings.refinements
        assert 0.0 <= math.log(limit / found) <= width


def test_draws_of_correlations_that_cannot_be_together_are_of_the_nearest():
    """Three that all go against each other by 0.8: 1 + 2ρ < 0, so that their sum is fixed."""
    known = {n: Value(5.0, "identified", std=0.1) for n in "abc"}
    rig: Any = Stub(parameters=lambda: known)
    matrix = np.where(np.eye(3) > 0.0, 1.0, -0.8)
    rows = draw_parameters(rig, tuple("abc"), ("abc", matrix), 4000, np.random.default_rng(2))
    assert rows.sum(axis=1) == pytest.approx(np.full(4000, 15.0))
    # by 4000 draws to 3 · 0.01
    assert np.corrcoef(rows.T)[0, 1] == pytest.approx(-0.5, abs=0.03)
    given: Any = Stub(rig=rig, recipe=Stub(draws=0, seed=0))
    with answers(draws, draw_parameters=None):
        found = draws.robustness(given, [], Law(0.0, 0.0, 0.0), {}, None, lambda share: None)
    assert (found.draws, found.parameters) == (0, ("a", "b", "c"))


# --- sampled loops


def sampled(a, b, c, d) -> Sampled:
    return Sampled(*(np.atleast_2d(np.asarray(item, float)) for item in (a, b, c, d)))


@pytest.mark.parametrize(("late", "lag"), [(0.0, 0.0), (0.25, 0.0), (1.0, 2.0), (2.4, 3.0)])
def test_a_sampled_loop_swings_by_its_polynomial(late, lag):
    """Of one state under one of the law's: (z − a)(z − a₂)z³ of all that stands between; a delay
    of parts of a tick lies on the line between two samples, a lag is that of the pressure."""
    plant = sampled(0.9, 0.5, [[1.0], [2.0]], [[0.0], [0.0]])
    law = sampled(0.6, [[0.3, 0.1]], -1.0, [[-0.2, -0.05]])
    loop = ArcLoop(plant, law, TICK, np.array([False, True]))
    sensing = Sensing(late * TICK, lag * TICK)
    keep, whole = math.exp(-1.0 / lag) if lag else 0.0, int(late)
    share = late - whole
    between = np.polymul([1.0 - share, share], [0.5])  # over z^(whole + 1)
    at_law = [np.array([d, -0.6 * d - b]) for d, b in ((-0.2, 0.3), (-0.05, 0.1))]
    seen = np.polyadd(
        np.polymul(at_law[0], [1.0, -keep]), np.polymul(at_law[1], [2.0 * (1.0 - keep), 0.0])
    )
    left = np.polymul(np.polymul([1.0, -0.9], [1.0, -0.6]), [1.0, -keep])
    left = np.append(left, np.zeros(whole + 1))
    roots = np.roots(np.polysub(left, np.polymul(between, seen)))
    roots = np.log(roots[np.abs(roots) > 1e-6].astype(complex)) / TICK
    poles = loop.poles(sensing)
    poles = poles[poles.real * TICK > -5.0]  # others are 0 but for rounding
    assert np.sort_complex(poles) == pytest.approx(np.sort_complex(roots), rel=1e-6, abs=1e-3)
    swings = roots[np.abs(roots.imag) > 3.0]
    assert swings.size == 0 or loop.growth(sensing) == pytest.approx(swings.real.max(), rel=1e-6)
    omega, loci = loop.loci(sensing)
    z = np.exp(1j * omega * TICK)
    through = np.polyval(at_law[0], z) + 2.0 * np.polyval(at_law[1], z) * (1.0 - keep) * z / (
        z - keep
    )
    expected = through / (z - 0.6) * 0.5 / (z - 0.9) * np.exp(-1j * omega * late * TICK)
    assert loci[:, 0] == pytest.approx(expected)
    assert (omega[0], omega[-1]) == pytest.approx((3.0, 0.98 * math.pi / TICK))


@pytest.mark.parametrize("gains", [(0.3,), (0.3, 0.2), (0.2, 0.35)])
def test_the_margins_of_sampled_integrators_a_tick_late(gains):
    """Each z² − z + k: |L| = k/(2 sin ωT/2), which turns by π/2 − 3ωT/2."""
    one, none = np.eye(len(gains)), np.zeros((len(gains), 0))
    plant = Sampled(one, one, one, 0.0 * one)
    sensing, lagged = Sensing(TICK), np.zeros(len(gains), bool)

    def loop(factor: float) -> ArcLoop:
        law = Sampled(np.zeros((0, 0)), none.T, none, -factor * np.diag(gains))
        return ArcLoop(plant, law, TICK, lagged)

    k = max(gains)
    omega = 2.0 * math.asin(0.5 * k) / TICK
    turn = 0.5 * math.pi - 1.5 * omega * TICK
    found = loop(1.0).margins(sensing)
    expected = (1.0 / k, turn, turn / omega, omega, math.inf)
    assert found == pytest.approx(expected, rel=1e-4)
    assert found.stated == pytest.approx(turn / omega / 1.5, rel=1e-4)
    assert loop(1.0).growth(sensing) == pytest.approx(0.5 * math.log(k) / TICK)
    assert loop(1.02 / k).margins(sensing) == (0.0,) * 5
    assert min(loop(0.99 / k).margins(sensing)) > 0.0


# --- points

EXTEND = FUNCTIONS.index("extend_resistive")


def motion_of(model: Model, function: int = EXTEND, **more: Any) -> Any:
    here = equivalent(model, 0, np.array([0.2]))
    return steady._Motion(model, circuit_of(model, 0), function, here, 0, Aim(5e5, 5e5, **more))


@pytest.mark.parametrize("v", [0.05, -0.02])
def test_a_force_on_the_rod_carries_and_damps_a_motion(v):
    """One that falls by 30 N a m/s from 100 N at rest; both ends of the cylinder balance it."""
    rig = slide().with_values({"press.leakage_rod": 3e-12, "press.leakage_head": 1e-12})
    motion = motion_of(Model.of(rig), speed=abs(v))
    function = next(
        f
        for f in range(1, 5)
        if motion.circuit.able[f]
        and steady.DIRECTION[f] == np.sign(v)
        and not steady.OVERRUNNING[f]
    )
    given = motion.model, motion.circuit, function, motion.here, 0, motion.aim
    free = operating_point(*given)
    with answers(steady, force_on=lambda at, x, v, *_: 100.0 - 30.0 * v):
        point = operating_point(*given)
    row = motion.row
    assert point.v == v and point.friction == pytest.approx(free.friction + 30.0)
    assert point.load_force == pytest.approx(free.load_force - 100.0 + 30.0 * v)
    force = row.area_head * point.p_head - row.area_rod * point.p_rod
    assert force == pytest.approx(point.load_force)
    flows = np.zeros(2)
    for path in point.paths:
        flows += path.flow * steady.INTO[path.path]
    lost = 1e-12 * (point.p_head - point.p_tank), 3e-12 * (point.p_rod - point.p_tank)
    across = row.leakage_internal * (point.p_head - point.p_rod)
    assert flows == pytest.approx(
        [row.area_head * v + across + lost[0], -row.area_rod * v - across + lost[1]], rel=1e-9
    )


@pytest.mark.parametrize(
    ("rail", "zero", "found"),
    [
        (None, 3e6, 3e6),
        (1e6, 3e6, 3e6),
        (1e6, 4e5, 4e5),
        (4e6, 3e6, 3e6),
        (None, 2e7, 1e7),
        (None, -1e7, 1e5),
        (1e6, 2e7, 1e7),
        (None, 1e5 + 1.5, 1e5 + 1.5),
        (None, 1e7 - 1.5, 1e7 - 1.5),
    ],
)
def test_a_common_opening_is_on_the_rail_or_on_the_line(rail, zero, found):
    """Surplus of 1 a Pa from ``zero`` on, and on the line above the rail, where it is far below
    zero or far above it, as the root lies on the other side."""
    tank, line = 1e5, 1e7
    jump = 0.0 if rail is None else 1e9 * np.sign(rail - zero) * -1.0

    def railed(at: Any) -> bool:
        return rail is not None and at < rail

    def surplus(at: float) -> float:
        other = rail is not None and (at < rail) != (zero < rail)
        return at - zero + other * jump

    plant = Stub(supply=Stub(pressure=line))
    motion: Any = Stub(
        circuit=None,
        function=EXTEND,
        p_tank=tank,
        model=Stub(plant=plant),
        railed=railed,
        chambers=lambda force, off: (force, off),
        ports=lambda v, head, off: (off, np.full(9, 0.5)),
    )
    with answers(
        steady,
        path_drop=lambda path, at, _: at,
        _command=lambda _, path, need, drop: (need, path),
        _flow=lambda _, path, at, command: 0.5 + surplus(at),
    ):
        off = steady._Motion.common_opening(motion, 0.1, 5.0)
    assert off == pytest.approx(found, rel=1e-9)


@pytest.mark.parametrize(
    ("limit", "rail", "top"), [(9.0, 0.0, 0.8), (0.5, 0.0, 0.5 / 2.0), (0.5, 1.0, 0.8)]
)
@pytest.mark.parametrize("most", [9.0, 0.15])
def test_full_speed_is_what_valves_pump_and_pressures_carry(limit, rail, top, most):
    """Of valves 0.8 m/s, of the pump its flow over 2 m²; where that is impossible, halved in."""
    motion: Any = Stub(
        function=EXTEND,
        circuit=None,
        settle=lambda v: Stub(p_head=0.0, p_rod=0.0),
        at_ports=lambda *at: at,
        railed=lambda at: rail > 0.0,
        impossible=lambda v: v > most,
    )
    with answers(steady, top_speed=0.8, pump_speed=limit / 2.0):
        found = steady._Motion.largest_speed(motion)
    within = 0.8 * 2.0**-steady.POINT.halvings
    assert found == top if top < most else most - within <= found <= most


@pytest.mark.parametrize(
    ("limit", "rail", "railed", "short"),
    [
        (0.9, 1.0, False, True),
        (1.1, 1.0, False, False),
        (0.9, 0.0, False, False),
        (0.9, 1.0, True, False),
    ],
)
def test_a_pump_is_short_of_what_it_feeds_beside_a_rail(limit, rail, railed, short):
    fed, other = next(iter(FED)), next(p for p in range(9) if p not in FED)
    paths: Any = [Stub(path=fed, flow=1.0), Stub(path=other, flow=5.0)]
    supply = Stub(rail=rail, flow_limit=limit)
    motion: Any = Stub(
        model=Stub(plant=Stub(supply=supply)), railed=lambda at: railed, ports=lambda *_: (0, 0)
    )
    settled: Any = Stub(p_head=0.0, p_rod=0.0)
    assert steady._Motion.short(motion, 0.1, settled, paths) == short


def test_a_line_lies_between_valve_and_chamber():
    """Its drop is that of the flow into its end; its slope that of its law."""
    pipe = {"end": "rod", "volume": "0.2 L", "resistance": "2 bar*min/L"}
    model = Model.of(slide(line=[pipe | {"orifice_gain": "10 gpm/MPa^0.5"}]))
    motion = motion_of(model)
    at, _ = motion.ports(0.1, 6e6, 3e6)
    row, line = motion.row, model.plant.lines[0]
    into = (
        -row.area_rod * 0.1 - row.leakage_internal * 3e6 + row.leakage_rod * (3e6 - motion.p_tank)
    )
    assert (at.head, at.rod) == pytest.approx((6e6, 3e6 + drop_for(into, line)))
    for flow in (1e-4, -2e-5, 3e-7):
        slope = (drop_for(1.0001 * flow, line) - drop_for(0.9999 * flow, line)) / (2e-4 * flow)
        hose = steady.Hose(1, 0, line, drop_for(flow, line))
        assert hose.slope == pytest.approx(1.0 / slope, rel=1e-3)


def test_what_no_valve_can_do_is_refused():
    model = Model.of(slide())
    circuit = circuit_of(model, 0)
    for function in (0, FUNCTIONS.index("extend_resistive_regeneration")):
        with pytest.raises(InputError):
            steady._check(model, circuit, function)


@pytest.mark.parametrize(
    ("sign", "command", "most", "reachable"),
    [(1, None, 5.0, True), (1, None, 4.9, False), (1, 5.1, 6.0, True), (1, 4.9, 6.0, False),
     (-1, None, -5.0, True), (-1, None, -4.9, False)],
)  # fmt: skip
@pytest.mark.parametrize("along", [1.0, -1.0])
def test_a_path_has_the_slopes_of_its_law_and_a_command_within_reach(
    sign, command, most, reachable, along
):
    """Q = 10⁻⁸ u √Δp along it: 5 V for 10⁻⁴ m³/s at 4 MPa; its slopes Q/(2 Δp) and Q/u."""
    lead = int(steady.METERING[EXTEND])
    circuit: Any = Stub(paths={lead: 2, 7: 2}, along={lead: along, 7: along}, maps=None)
    circuit.edges = {2: Stub(sign=sign, valve=3)}
    law = lambda drop, u: 1e-8 * abs(u) * np.sign(drop) * math.sqrt(abs(drop))  # noqa: E731
    asked = []
    with answers(steady, edge_flow=lambda drop, u, *_: law(drop, u),
                 edge_command=lambda drop, flow, *_: sign * flow / law(drop, 1.0),
                 widest=lambda _, edge, drop: asked.append(drop) or most):  # fmt: skip
        found = steady._path(circuit, EXTEND, lead, 1e-4, 4e6, ("a", "b", "c"), command)
        other = steady._path(circuit, EXTEND, 7, 1e-4, 4e6, ("a", "b", "c"), command)
    u = command or 5.0 * sign
    assert (found.edge, found.valve, found.command) == ("c", 3, pytest.approx(u))
    assert (found.metering, other.metering) == (True, False)
    assert found.slope == pytest.approx(2e-5 * abs(u) / 8e6, rel=1e-4)
    assert found.gain == pytest.approx(2e-5 * sign, rel=1e-6)
    assert found.reachable == reachable and asked[0] == along * 4e6
    with answers(steady, edge_flow=lambda *_: along, widest=most):
        shut = steady._path(circuit, EXTEND, lead, 1e-4, 4e6, ("a", "b", "c"), 1.0 * sign)
    assert shut.gain == 0.0 and not shut.reachable


# --- loops about points


def test_a_late_valve_moves_a_state_by_the_pade_form_of_its_delay():
    """ẋ = −3 x + 2 u₁ + 5 u₂, of whose valves the second is 0.1 s late: e^(−sT) to (ωT)⁵/720."""
    plain = linear.LinearModel(
        ("x",), (1, 0), np.array([[-3.0]]), np.array([[2.0, 5.0]]), np.ones(1)
    )
    names = Stub(valves=["late", "soon"])
    model: Any = Stub(layout=names, plant=Stub(valves=Stub(delay=np.array([0.1, 0.0]))))
    found = linear.with_delays(plain, model)
    assert found.states == ("x", "late.late_1", "late.late_2") and found.fastest == 25.0
    for s in (0.0, 2j, 8j):
        first, second = np.linalg.solve(s * np.eye(3) - found.a, found.b)[0]
        assert first == pytest.approx(2.0 / (s + 3.0))
        turn, off = second * (s + 3.0) / 5.0, abs(0.1 * s) ** 5 / 720.0
        assert abs(turn - np.exp(-0.1 * s)) == pytest.approx(off, rel=0.1, abs=1e-12)
    assert found.e.tolist() == [1.0, 0.0, 0.0]
    assert (
        linear.with_delays(plain, Stub(layout=names, plant=Stub(valves=Stub(delay=np.zeros(2)))))
        is plain
    )


def loop_of(a, b, c, off=None, delay=0.0) -> Loop:
    a, b, c = (np.asarray(item, float) for item in (a, b, c))
    off = np.zeros(a.shape) if off is None else off
    return Loop(a, b, c, b, b, off, math.inf, delay, slice(0))


@pytest.mark.parametrize(
    ("a", "b", "limit"),
    [
        ([[-2.0]], [1.0], 2.0),
        ([[1.0]], [1.0], 0.0),
        ([[-2.0]], [-1.0], math.inf),
        ([[-1, 1, 0], [0, -1, 1], [0, 0, -1]], [0, 0, -1.0], 8.0),
    ],
)
def test_a_loop_is_stable_up_to_its_limit(a, b, limit):
    """Of one state its own pole; of three that follow each other eight times it."""
    c = np.eye(len(b))[0]
    assert loops.gain_limit(loop_of(a, b, c), np.geomspace(1e-3, 1e3, 61)) == pytest.approx(limit)


@pytest.mark.parametrize(("damping", "gain"), [(0.1, 0.0), (0.1, 2.4), (0.5, 1.0)])
def test_a_bandwidth_is_that_of_a_second_order_speed(damping, gain):
    """5 ω/(s² + 2ζωs + ω²), whose power is half at ω√(1 − 2ζ² + √((1 − 2ζ²)² + 1)); feedback adds
    to the damping. One pole far above the poles without feedback ends it nowhere."""
    omega = 3.0
    a = [[-2.0 * damping * omega, omega], [-omega, 0.0]]
    loop = replace(loop_of(a, [1.0, 0.0], [-1.0, 0.0]), d=np.array([0.0, 5.0]))
    part = 1.0 - 2.0 * (damping + 0.5 * gain / omega) ** 2
    expected = omega * math.sqrt(part + math.sqrt(part**2 + 1.0))
    assert loops.bandwidth(loop, gain) == pytest.approx(expected, rel=1e-3)
    assert loops.bandwidth(loop_of([[-1.0]], [1.0], [-1.0]), 99.0) == math.inf


def test_a_loop_is_cut_at_its_feedback_and_at_its_off_side():
    a = np.array([[-1.0, 2.0, 0.5], [0.0, -3.0, 1.0], [0.3, 0.0, -2.0]])
    off = np.outer([1.0, -2.0, 0.5], [0.0, 0.7, 0.4])
    loop = loop_of(a, [0.2, 0.0, 1.0], [1.0, -1.0, 0.0], off)
    first, second = loops._open_loops(loop, 0.5)
    assert np.outer(first.b, first.c) == pytest.approx(-0.5 * np.outer(loop.b, loop.c))
    assert first.a is loop.a and np.outer(second.b, second.c) == pytest.approx(-off)
    assert second.a == pytest.approx(a + 0.5 * np.outer(loop.b, loop.c) - off)
    assert len(loops._open_loops(loop, 0.0)) == 1
    assert len(loops._open_loops(replace(loop, off=0.0 * off), 0.5)) == 1


@pytest.mark.parametrize("function", ["extend_resistive", "retract_resistive"])
@pytest.mark.parametrize("feedback", ["metered", "load"])
@pytest.mark.parametrize("delay", [0.0, 4e-3])
def test_a_loop_about_a_point_is_its_law_and_its_linear_model(function, feedback, delay):
    """In frequencies: the valve inverts its metering edge at a late drop; fed back is the metered
    pressure, or A₁P₁ − A₂P₂ over its area, washed out twice."""
    motion = motion_of(Model.of(slide()), FUNCTIONS.index(function), share=0.5)
    point = operating_point(
        motion.model, motion.circuit, motion.function, motion.here, 0, motion.aim
    )
    linear = development_model(motion.model, point)
    loop = close(linear, point, motion.circuit, Law(3.0, 0.0, delay, 7.0, feedback))
    assert loop.fastest == (2.5 / delay if delay else math.inf)
    (path,) = (item for item in point.paths if item.metering)
    areas, own = np.array([motion.row.area_head, -motion.row.area_rod]), 0 if point.v > 0.0 else 1
    size = len(linear.a)
    fed, back, drop = np.zeros((3, size))
    fed[0], back[1:3] = 1.0, np.eye(2)[own] if feedback == "metered" else areas / areas[own]
    drop[1:3] = steady.INTO[path.path]
    for s in (0.1 + 2.0j, 5.0 + 90.0j, 400.0j):
        first = 6.0 / delay if delay else 0.0
        late = 1.0 - 2.0 * first * s / (s**2 + first * s + first * first / 3.0)
        order = np.outer(linear.b[:, 0], path.slope / path.gain * late * drop)
        rest = s * np.eye(size) - linear.a - order
        flow, push = (np.linalg.solve(rest, side) for side in (linear.b[:, 0], linear.e))
        scaled = s * np.eye(len(loop.a)) - loop.a
        washed = late * s**2 / ((s + 3.0) * (s + 7.0)) * back
        for c, b, expected in (
            (loop.c, loop.b, -washed @ flow / path.gain),
            (np.eye(len(loop.a))[0], loop.d, fed @ flow * areas[own] / path.gain),
            (np.eye(len(loop.a))[0], loop.e, fed @ push),
        ):
            assert c @ np.linalg.solve(scaled, b) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("demand", "gain", "key"), [(0.0, 1.0, ""), (5.0, 0.5, "limited_gain"), (1e3, 1.0, "no_gain")]
)
def test_a_gain_has_the_best_worst_damping_that_keeps_the_demands(demand, gain, key):
    """0.5 + 0.2 z and 1 − 0.3 z over z = ln K meet at 1; a margin of 10/K."""

    def loop(level, slope):
        z = lambda gain: np.log(np.maximum(gain, 1e-9))  # noqa: E731
        return Stub(damping_ratio=lambda gain: level + slope * z(gain))

    motions: Any = [Stub(loop=lambda _, of=of: loop(*of)) for of in ((0.5, 0.2), (1.0, -0.3))]
    gains = np.concatenate([[0.0], np.exp(np.arange(-2.0, 3.1, 0.5))])
    notes: list[Any] = []
    with answers(search, margins=lambda loop, gain: Stub(gain_margin=10.0 / gain)):
        found = search.choose_gain(motions, Law(0, 0, 0), gains, {"gain_margin": demand}, notes)
    assert math.log(found) == pytest.approx(gain, abs=2e-3)
    assert [note.key for note in notes] == ([f"tune.{key}"] if key else [])
    if key == "limited_gain":
        assert notes[0].fields["share"] == pytest.approx(math.exp(-0.5), rel=2e-3)
        assert notes[0].fields["damping"] == pytest.approx(0.7, abs=1e-3)
    best = search.best_gain(motions, Law(0, 0, 0), gains)
    assert best == pytest.approx((0.7, math.e))


# --- what is told of a circuit


def test_a_function_is_told_with_its_edges():
    """Each by the title of its valve, if that has no other."""
    arm = shipped("thesis_arm")
    circuit = circuit_of(Model.of(arm), 1)
    uses = {use.name: use for use in functions_of(arm, circuit)}
    crosses = {name: use.cross for name, use in uses.items() if use.cross}
    back = ("extend_overrunning_regeneration", "extend_resistive_regeneration")
    assert crosses == dict.fromkeys(back, "rod_head") | {
        "retract_overrunning_regeneration": "head_rod"
    }
    draws = circuit.area_head, circuit.area_head - circuit.area_rod
    assert (uses["extend_resistive"].draws, uses[back[0]].draws) == pytest.approx(draws)
    out, feed, across, *_ = uses[back[1]].edges
    assert (out.way, feed.way, across.way) == (0, 1, -1)
    assert (out.meters, feed.meters, across.meters) == (False, True, False)
    assert (out.shares, feed.shares, feed.name) == ((0, 0), (1, -1), "Valve 2: HEPC")
    for name, title in (("slide_servo", "Servo"), ("boom_four_valve", "")):
        plain = shipped(name).as_toml()
        for valve in plain["cylinder"][0]["valve"]:
            valve["title"] = title
        rig = Rig.model_validate(plain)
        (use, *_) = functions_of(rig, circuit_of(Model.of(rig), 0))
        names = [valve.edge_name(edge) for _, valve, edge in rig.edges()]
        assert [edge.name for edge in use.edges] == names


# --- gains, draws, margins


@pytest.mark.parametrize("matrix", [[[1, 0.5], [0.3, 1]], [[1, 1.2], [1.2, 1]], [[1, 0.5]]])
def test_a_matrix_of_correlations_is_square_even_and_at_most_one(matrix):
    rig: Any = Stub(parameters=lambda: {n: Value(5.0, "identified", std=0.1) for n in "ab"})
    with refused("tune.wrong_correlation", InputError):
        draw_parameters(rig, ("a", "b"), (("a", "b"), matrix), 3, np.random.default_rng(1))


@pytest.mark.parametrize(
    ("minimum", "single", "washout", "ramp"),
    [(0.5, True, 3.0, False), (0.5, False, 1.5, True), (0.71, False, 0.9, False),
     (0.9, True, 1.0, False), (0.9, False, 1.0, False)],
)  # fmt: skip
def test_a_law_has_the_fastest_washouts_that_reach_the_target(minimum, single, washout, ramp):
    """0.8 − (ω_w + ω_r)/10 less what the off-side and K_p are off by: one washout to a sixteenth of
    an octave, or two, if no slower than a quarter of it. Where none reaches it, the fastest that
    keeps 0.95 of the best."""
    work = search.LawSearch.__new__(search.LawSearch)
    least = math.log(2.0) / 16.0

    def loop(law: Law) -> Any:
        level = 0.8 - 0.1 * (law.washout + law.ramp_washout) - 0.02 * (law.off_gain - 2.0) ** 2
        return Stub(
            damping_ratio=lambda gain: level - np.log(np.maximum(gain, 1e-9)) ** 2, gain=law
        )

    motions: Any = [Stub(loop=loop), Stub(loop=loop)]
    work.motions, work.gains, work.demands = motions, np.array([0.0, 0.5, 1.0, 2.0]), {}
    corners = [8.0, 4.0, 2.0, 1.0, *((0.5,) if minimum < 0.9 else ())]
    work.corners, work.offs, work.delay, work.ramp = corners, [1.0, 2.0, 3.0], 1e-3, 0.0
    work.free, work.single, work.minimum = True, single, minimum
    work._queue, work._known = list(motions), {}
    with answers(search, margins=lambda *_: None):
        law = work.law()
    assert law.off_gain == 2.0 and law.delay == 1e-3
    assert 0.0 <= math.log(washout / law.washout) <= least + 1e-9
    assert law.ramp_washout == (law.washout if ramp else 0.0)
    work.demands = {"gain_margin": 2.0}
    with answers(search, margins=lambda loop, gain: Stub(gain_margin=8.0 / loop.gain.washout)):
        limited = work.law()
    kept = min(washout, 4.0)
    assert minimum > 0.8 or 0.0 <= math.log(kept / limited.washout) <= least + 1e-9
    work.free = False
    work.corners = [4.0]
    assert work.law() == Law(4.0, 2.0, 1e-3, 0.0)


@pytest.mark.parametrize("one", [True, False])
def test_each_function_has_its_gain_or_all_have_one(one):
    """One that no load calls for has the least."""
    motions = [Stub(point=Stub(function=f), counts=f != "c") for f in "aabc"]
    given: Any = Stub(motions=motions, recipe=Stub(one_gain=one))
    with answers(gains, choose_gain=lambda group, *_: float(len(group))):
        found = gains._gains_by_function(given, *[None] * 4)
    assert found == (dict.fromkeys("abc", 3.0) if one else {"a": 2.0, "b": 1.0, "c": 1.0})
    results: Any = [Stub(damping_ratio_open=a, damping_ratio_held=b) for a, b in ((1, 5), (3, 4))]
    assert gains._ranges(results) == {
        "damping_ratio_open": 1,
        "damping_ratio_open_most": 3,
        "damping_ratio_held": 4,
        "damping_ratio_held_most": 5,
    }


@pytest.mark.parametrize("washout", [0.0, 0.5])
def test_curves_are_of_the_least_damped_point_of_each_function_and_payload(washout):
    points = [Stub(function=f, payload=p) for f, p in ("ax", "ax", "ay", "ax", "bx")]
    results: Any = [
        Stub(point=point, damping_ratio_closed=d, gain_limit=10.0 * i)
        for i, (point, d) in enumerate(zip(points, (0.5, 0.3, 0.9, 0.4, 0.2), strict=True))
    ]
    given: Any = Stub(motions=[Stub(point=point, at=i) for i, point in enumerate(points)])
    with answers(
        gains,
        locus=lambda motion, law, *rest: (motion.at, *rest),
        step_response=lambda motion, law, result, gain: (motion.at, gain),
    ):
        found: Any = gains._curves(given, results, Law(washout, 0.0, 0.0), {"a": 2.0, "b": 3.0})
    loci, steps = found
    assert steps == ((1, 2.0), (2, 2.0), (4, 3.0))
    both = ("feedback_gain", "washout")[: 2 if washout else 1]
    assert loci == tuple((i, gain, name, 10.0 * i) for i, gain in steps for name in both)


@pytest.mark.parametrize(
    ("damping", "bandwidth", "met", "keys"),
    [(0.6, 7.0, True, []), (0.6, 6.0, False, []), (0.7, 7.0, True, []),
     (0.5, 7.0, False, ["below_target"])],
)  # fmt: skip
@pytest.mark.parametrize("drawn", [(), ("oil",)])
def test_a_tuning_is_met_that_keeps_its_target_and_its_demands(
    damping, bandwidth, met, keys, drawn
):
    """0.6 and 1 Hz, at the points that count."""
    recipe = Stub(gain_margin=2.0, phase_margin=0.5, bandwidth=1.0, damping_ratio=0.6, rate=500.0)
    motions = [
        Stub(counts=one, point=Stub(function="f"), circuit=None) for one in (True, True, False)
    ]
    rig = Stub(name="slide", supply=Stub(facts=dict))
    given: Any = Stub(recipe=recipe, motions=motions, notes=(), rig=rig, cylinder="press",
                      low=1.0, cross=2.0, curves=())  # fmt: skip
    work = Stub(
        law=lambda: Law(1.0, 2.0, 3e-3, 4.0), grid=np.arange(3.0), alternatives=lambda _: ()
    )
    numbers = iter([(0.9, 8.0, 0.4), (damping, bandwidth, 0.3), (0.1, 1.0, 0.2)])

    def result(motion, *_):
        value, reached, curve = next(numbers)
        margins = Stub(gain_margin=2.0, phase_margin=0.6, bandwidth=reached)
        return Stub(counts=motion.counts, damping_ratio_closed=value, margins=margins, name="it",
                    damping_ratio_open=value, damping_ratio_held=value,
                    curve=np.full(3, curve))  # fmt: skip

    done: list[float] = []
    with answers(gains, LawSearch=lambda *_: work, _gains_by_function={"f": 1.0}, _result=result,
                 _curves=((), ()), robustness=Stub(parameters=drawn), functions_of=()):  # fmt: skip
        found = gains.tune_pressure_feedback(given, None, lambda _, share: done.append(share))
    assert (found.met, found.damping_ratio) == (met, damping) and found.tick == 2e-3
    assert [text.key for text in found.warnings] == [
        f"tune.{key}" for key in (*keys, *(() if drawn else ("no_draws",)))
    ]
    assert found.worst_curve == (0.3,) * 3
    assert done == sorted(done) and 0.0 < done[0] and done[-1] < 1.0


def test_a_point_is_told_without_feedback_with_the_off_side_and_at_its_gain():
    """Of a swing of 3 rad/s, which a gain damps by a sixth of it."""
    law = Law(1.0, 2.0, 3e-3, 4.0)

    def loop(given: Law) -> Loop:
        washed = given.washout == given.ramp_washout == 0.0
        damping = 0.1 + 0.1 * washed + 0.2 * (given.off_gain == 0.0)
        return loop_of([[0.0, 1.0], [-9.0, -6.0 * damping]], [0.0, 1.0], [0.0, -1.0])

    point = Stub(name="it", function="extend_resistive", p_head=2e6)
    motion: Any = Stub(loop=loop, point=point, counts=True)
    found = gains._result(motion, law, 0.6, np.array([0.0, 1.2]))
    assert found.natural_frequency_open == pytest.approx(3.0)
    assert found.natural_frequency_closed == pytest.approx(3.0)
    assert found.damping_ratio_open == pytest.approx(0.4)
    assert found.damping_ratio_held == pytest.approx(0.1)
    assert found.damping_ratio_closed == pytest.approx(0.2)
    assert found.curve == pytest.approx((0.1, 0.3)) and found.gain_limit == math.inf
    assert found.damping_ratio_plain == pytest.approx(0.3)
    assert found.bias == pytest.approx(0.6 * 2e6 / 9.0)


@pytest.mark.parametrize(
    ("function", "pressure"), [("extend_resistive", 2e6), ("retract_resistive", 5e6)]
)
def test_a_static_pressure_moves_the_rod_where_nothing_washes_it_out(function, pressure):
    """ẋ = (a + K b c) x + K b p at rest."""
    a, b, c = np.array([[-1.0, 2.0], [0.0, -3.0]]), np.array([0.5, 1.0]), np.array([0.0, -1.0])
    point: Any = Stub(function=function, p_head=2e6, p_rod=5e6)
    expected = -np.linalg.inv(a + 0.7 * np.outer(b, c)) @ b * 0.7 * pressure
    assert gains._bias(loop_of(a, b, c), point, 0.7) == pytest.approx(expected[0])
    assert math.isnan(gains._bias(loop_of(a, b, -9.0 * c), point, 0.7))


@pytest.mark.parametrize("counts", [(True, True, True), (True, False, True)])
def test_draws_are_of_the_least_damped_points_that_count(counts):
    """Of the worst of each draw the quantiles, and the share that keeps the target."""
    known = {"oil": Value(1.0, "identified", std=0.5)}
    rig: Any = Stub(parameters=lambda: known, with_values=lambda values: values["oil"])
    results: Any = [
        Stub(counts=one, damping_ratio_closed=d)
        for one, d in zip(counts, (0.3, 0.1, 0.2), strict=True)
    ]
    recipe = Stub(draws=5, seed=3, damping_ratio=0.6)
    given: Any = Stub(rig=rig, recipe=recipe, motions=["first", "second", "third"])
    table, done, asked = np.array([[0.5], [0.6], [0.8], [0.9], [0.1]]), [], []

    def worst(_, drawn, motions, *__):
        asked.append(motions)
        return drawn

    with answers(draws, draw_parameters=table, _worst_of_draw=worst):
        found = draws.robustness(given, results, Law(0, 0, 0), {}, None, done.append)
    assert asked[0] == (["second", "third", "first"] if counts[1] else ["third", "first"])
    assert done == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8]) and found.draws == 5
    assert (found.share, found.points) == (pytest.approx(0.6), len(asked[0]))
    assert found.quantiles == pytest.approx(
        np.quantile([0.5, 0.6, 0.8, 0.9, 0.1], [0.05, 0.5, 0.95])
    )


@pytest.mark.parametrize(("possible", "worst"), [("ab", 0.1), ("a", 0.4), ("", 1.0)])
def test_a_draw_is_as_damped_as_its_least_damped_point_that_it_takes_up(possible, worst):
    points = [
        Stub(payload=p, function=f, x=0.1, v=v)
        for p, f, v in (("a", "extend_resistive", 0.2), ("b", "retract_resistive", -0.3))
    ]
    motions: Any = [Stub(point=point) for point in points]
    aims = []

    def steady(model, circuit, function, here, index, aim):
        aims.append((function, index, aim.speed, aim.payload, aim.low_pressure, aim.cross_drop))
        return model, Stub(possible=aim.payload in possible, payload=aim.payload)

    given: Any = Stub(recipe=Stub(posture=None), maps=None, cylinder="press", low=5e5, cross=6e5)
    given.steady = steady
    model = Stub(layout=Stub(cylinders=["boom", "press"]))
    loops = {
        "a": Stub(damping_ratio=lambda gain: 0.1 * gain),
        "b": Stub(damping_ratio=lambda gain: 0.02 * gain),
    }
    with answers(
        draws,
        model_under=model,
        circuit_of=lambda _, at, __: Stub(cylinder=at),
        equivalent=lambda _, at, x, __: (at, x),
        development_model=None,
        close=lambda _, point, *__: loops[point.payload],
    ):
        found = draws._worst_of_draw(
            given, None, motions, Law(0, 0, 0), {"extend_resistive": 4.0, "retract_resistive": 5.0}
        )
    assert found == pytest.approx(worst)
    codes = [FUNCTIONS.index(p.function) for p in points]
    assert aims == [(codes[0], 0, 0.2, "a", 5e5, 6e5), (codes[1], 0, 0.3, "b", 5e5, 6e5)]


def test_a_tuning_of_margins_tells_its_worst_point_and_what_it_misses():
    """By delay; the loci stand about −1."""
    found = [LoopMargins(2.0, 0.5, 6e-3, 30.0), LoopMargins(3.0, 0.7, 3e-3, 40.0)]
    loci = np.array([[1.0 + 2.0j], [3.0 - 1.0j]])
    loops_ = [
        Stub(margins=lambda _, item=item: item, loci=lambda _: (None, loci)) for item in found
    ]
    points = [Stub(name=n, function="f", payload="none", x=0.1, v=0.2, paths=()) for n in "ab"]
    gain = dict.fromkeys(arc.CHOSEN, 4.0)
    demands = {"gain_margin": 2.0, "phase_margin": 0.6, "delay_margin": 3e-3}
    work: Any = Stub(loops=lambda _: loops_, sensing=Sensing(1e-3, 2e-3), demands=demands, lag=0.01)
    work.design_point = Stub(tick=1e-3)
    work.gains, work.plants = lambda _: (None, None), [Stub(point=point) for point in points]
    work.judged = lambda budget, results: arc.Search.judged(work, budget, results)
    work.share = lambda margins: arc.Search.share(work, margins)
    rig = Stub(name="slide", supply=Stub(facts=dict, low_rail=None))
    given: Any = Stub(rig=rig, cylinder="press")
    with answers(arc, named_gains={"gains": gain}):
        # pyrefly: ignore[bad-assignment]
        told = arc._result(given, work, 0.4, {0.5: "second", 0.4: "first"})
    assert (told.worst, told.met, told.candidates) == ("b", False, ("first", "second"))
    assert (told.gain_margin, told.phase_margin, told.delay_margin) == (2.0, 0.5, 2e-3)
    (note,) = told.warnings
    fields: Any = note.fields
    assert fields == {"margins": "phase margin and delay margin", "point": "b"}
    assert [p.delay_margin for p in told.points] == pytest.approx([4e-3, 2e-3])
    assert told.locus == (((-1.0, -3.0), (-2.0, 1.0)),)
    assert arc.Search.judged(work, 0.4, found).sum == pytest.approx(40.0)


@pytest.mark.parametrize(("limit", "way"), [(0.6, 1.0), (math.inf, -1.0)])
def test_a_root_locus_lies_densely_about_its_gain_and_its_limit(limit, way):
    """s² + (0.6 ∓ K) s + 9, up to ten times the larger; shown is what swings."""
    motion: Any = Stub(loop=lambda _: loop_of([[0.0, 1.0], [-9.0, -0.6]], [0.0, 1.0], [0.0, way]))
    motion.point = Stub(name="it")
    found = gains.locus(motion, Law(0.0, 0.0, 0.0), 0.3, "feedback_gain", limit)
    name, parameter, values, real, imag, chosen, at, crossing, cross, frame = astuple(found)
    assert (name, parameter, chosen) == ("it", "feedback_gain", 0.3)
    assert values[0] == 0.0 and values[1] == pytest.approx(3e-4)
    assert values[-1] == pytest.approx(6.0 if way > 0.0 else 3.0)
    centre = [0.3, 0.6] if way > 0.0 else [0.3]
    dense = [c * part for c in centre for part in np.linspace(0.8, 1.2, 60)]
    assert np.isclose(np.array(values)[:, None], np.array(dense)).any(axis=0).all()
    for k, value in enumerate(values):
        poles = np.sort_complex(np.array(real[k]) + 1j * np.array(imag[k]))
        roots = np.sort_complex(np.roots([1.0, 0.6 - way * value, 9.0]).astype(complex))
        assert poles == pytest.approx(roots, abs=1e-6)
    swing = math.sqrt(9.0 - (0.3 - 0.15 * way) ** 2)
    assert sorted(at) == [pytest.approx((0.15 * way - 0.3, s * swing)) for s in (-1.0, 1.0)]
    assert crossing == (0.6 if way > 0.0 else None)
    assert sorted(cross) == (
        [pytest.approx((0.0, s * 3.0)) for s in (-1.0, 1.0)] if way > 0.0 else []
    )
    assert frame == pytest.approx((-4.8, 1.2, 4.2))


def test_a_locus_over_the_washout_is_that_of_the_washed_loop():
    """At 2 rad/s the poles are those with a washout of 2; it goes to ten times it, or to twice the
    swing."""

    def loop(law: Law) -> Loop:
        a = np.zeros((3, 3))
        a[:2, :2], c = [[0.0, 1.0], [-900.0, -3.0]], np.array([0.0, -1.0, 0.0])
        if not law.washout:
            return loop_of(a[:2, :2], [0.0, 1.0], c[:2])
        a[2], c[2] = [0.0, -law.washout, -law.washout], -1.0
        return loop_of(a, [0.0, 1.0, 0.0], c)

    motion: Any = Stub(loop=loop, point=Stub(name="it"))
    for washout, top in ((2.0, 60.0), (7.0, 70.0)):
        law = Law(washout, 0.0, 0.0)
        found = gains.locus(motion, law, 4.0, "washout", 9.0)
        *_, values, real, imag, chosen, at, crossing, cross, frame = astuple(found)
        assert (chosen, crossing, cross) == (washout, None, ())
        assert values[-1] == pytest.approx(top, rel=1e-2)
        poles = np.sort_complex(np.array([complex(*pole) for pole in at]))
        assert poles == pytest.approx(np.sort_complex(np.linalg.eigvals(loop(law).closed(4.0))))


def test_a_step_of_speed_is_shown_for_ten_swings():
    """(1 − e^(−ζωt)(cos ω't + ζω/ω' sin ω't))/ω² at 0.9 rad/s, without feedback and with a
    gain."""
    motion: Any = Stub(loop=lambda _: loop_of([[0.0, 1.0], [-0.81, -0.2]], [0.0, 1.0], [0.0, -1.0]))
    result: Any = Stub(natural_frequency_open=0.9, name="it")
    found = gains.step_response(motion, Law(0.0, 0.0, 0.0), result, 1.2)
    name, t, *speeds = astuple(found)
    t = np.array(t)
    assert name == "it" and t[-1] == pytest.approx(20.0 * math.pi / 0.9)
    for speed, decay in zip(speeds, (0.1, 0.7), strict=True):
        omega = math.sqrt(0.81 - decay**2)
        swing = np.exp(-decay * t) * (np.cos(omega * t) + decay / omega * np.sin(omega * t))
        assert speed == pytest.approx((1.0 - swing) / 0.81, abs=1e-6)
