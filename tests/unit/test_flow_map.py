"""The flow map type: kernel against SciPy, exact inverse, shape, ranges, file."""

import json
import math
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.interpolate import BSpline

from ehbench.flow_maps import readings as readings_module
from ehbench.flow_maps import results
from ehbench.flow_maps import shape as shapes
from ehbench.flow_maps.readings import FlowMapOptions, few, readings_table, sort_readings
from ehbench.flow_maps.spline import Axis, OneColumn, Spline, full, pivoted
from ehbench.flow_maps.tables import fitted_flow
from ehbench.physics.flow_map import (
    FlowMap,
    UnknownValve,
    ValveMaps,
    collect,
    dump_flow_maps,
    load_flow_maps,
    map_command,
    map_flow,
    pack,
    root_drop,
    save_flow_maps,
    table,
)
from ehbench.plant.model import simulate
from ehbench.vocabulary.errors import InputError
from tests.shared import shipped

GPM = 3.785411784e-3 / 60.0


def a_map(seed: int = 0, valve: str = "hect", direction: str = "forward", **changes) -> FlowMap:
    """A map with random positive increments over uneven knots: nothing about it is an orifice."""
    rng = np.random.default_rng(seed)
    knots = np.array([1.62, 1.75, 2.0, 2.25, 2.5, 3.0, 4.0, 6.0, 8.0, 10.0])
    steps = rng.exponential(0.8 * GPM, (knots.size, 9)) * np.linspace(0.2, 1.0, 9) + 1e-9
    fields = {"valve": valve, "direction": direction, "deadband": 1.62, "rated_flow": 8 * GPM}
    fields |= {"deadband_interval": (1.6, 1.64), "opening_knots": knots, "increments": steps}
    fields |= {"drop_max": 6.5e6, "delta": 2e4, "hull_command": np.array([0.0, 2.0, 10.0])}
    fields |= {"hull_low": np.array([1e5, 1e5, 2e5]), "hull_high": np.array([6.5e6, 6.5e6, 3e6])}
    fields |= {"std_command": np.array([1.6, 5.0, 10.0]), "std_root": np.array([0.0, 1e3, 2549.0])}
    fields |= {"std": GPM * np.array([[0, 0.01, 0.02], [0, 0.03, 0.05], [0, 0.06, 0.08]])}
    fields |= {"samples": 500, "outliers": ("line 3: odd",), "source": "maps.csv"}
    return FlowMap(**{**fields, **changes})


def test_a_leak_at_rest_adds_to_the_flow_and_is_taken_off_by_the_inverse():
    plain, leaky = a_map(), a_map(leakage=(2e-6, 1e-6), leakage_std=1e-7)
    drop, command = np.meshgrid([1e5, 1e6, 6.5e6], [0.0, 1.0, 1.7, 5.0, 10.0])
    share = root_drop(drop, 2e4) / root_drop(6.5e6, 2e4)
    leak = share * (2e-6 + 1e-6 * share)
    np.testing.assert_allclose(leaky.flow(drop, command), plain.flow(drop, command) + leak)
    assert leaky.flow(-1e6, 0.0) == -leaky.flow(1e6, 0.0) < 0.0 == plain.flow(1e6, 0.0)
    assert leaky.command(1e6, 5e-7) == 0.0
    assert leaky.command(1e6, leaky.flow(1e6, 5.0)) == pytest.approx(5.0, rel=1e-12)
    assert leaky.flow_std(6.5e6, 0.0) == pytest.approx(1e-7, rel=1e-3)
    assert FlowMap.from_dict(leaky.to_dict()).leakage == (2e-6, 1e-6)
    assert "leakage" not in plain.to_dict()
    data, offsets = pack([leaky], [2.0])
    assert map_flow(1e6, 0.0, data, offsets[0]) == pytest.approx(2.0 * leaky.flow(1e6, 0.0))


def test_a_deadband_that_shifts_with_the_drop_moves_the_opening():
    plain, moved = a_map(), a_map(shift=2e-7)
    drop, command = np.array([[5e5], [3.25e6], [6e6]]), np.linspace(2.5, 8.0, 9)
    more = 2e-7 * (drop - 3.25e6)
    flow = moved.flow(drop, command + more)
    np.testing.assert_allclose(flow, plain.flow(drop, command), rtol=1e-12)
    np.testing.assert_allclose(moved.command(drop, flow), command + more, rtol=1e-9)
    np.testing.assert_allclose(
        moved.flow_std(drop, command + more), plain.flow_std(drop, command), rtol=1e-12
    )
    assert moved.reachable(6e6, plain.flow(6e6, 10.0)) and not moved.reachable(6e6, 1.0)
    assert FlowMap.from_dict(moved.to_dict()).shift == 2e-7 and "shift" not in plain.to_dict()
    open_at_rest = a_map(shift=6e-7)  # by the line, at small drops
    assert open_at_rest.flow(1e5, 0.0) == 0.0 < open_at_rest.flow(1e5, 1e-6)
    assert open_at_rest.command(1e5, 1e-12) == 0.0


def test_a_map_that_falls_is_inverted_up_to_its_largest_flow():
    steps = np.array(a_map().increments)
    steps[8:] *= -0.3
    one = a_map(increments=steps, rising_to=6.0)
    command = np.linspace(1.7, 6.0, 30)
    np.testing.assert_allclose(one.command(3e6, one.flow(3e6, command)), command, rtol=1e-9)
    assert one.flow(3e6, 10.0) < one.flow(3e6, 6.0)
    assert one.command(3e6, 1.0) == 6.0 and one.flow(3e6, 12.0) == one.flow(3e6, 10.0)
    assert FlowMap.from_dict(one.to_dict()).rising_to == 6.0
    with pytest.raises(InputError, match="increments must be positive"):
        a_map(increments=steps)


def test_an_edge_with_a_leaky_map_lets_its_cylinder_sink():
    rig = shipped("boom_four_valve")
    maps = {"boom.ht": ValveMaps(a_map(valve="ht", leakage=(2e-6, 0.0)))}
    sunk = simulate(rig, {}, 0.5, flow_maps=maps)["boom.x"]
    held = simulate(rig, {}, 0.5, flow_maps={"boom.ht": ValveMaps(a_map(valve="ht"))})["boom.x"]
    assert sunk[-1] < sunk[0] - 1e-5 and abs(held[-1] - held[0]) < 1e-9


def by_scipy(one: FlowMap, drop: np.ndarray, opening: np.ndarray) -> np.ndarray:
    """The tensor-product spline of the class docstring, evaluated by SciPy."""
    m = one.increments.shape[1] - 2
    c = np.zeros((one.opening_knots.size + 1, m + 3))
    c[1:, 1:] = np.cumsum(one.increments, axis=0)
    u, s = one.opening_knots, np.arange(m + 1.0)
    x = root_drop(drop, one.delta) * m / root_drop(one.drop_max, one.delta)
    in_u = BSpline.design_matrix(opening, np.r_[[u[0]] * 2, u, [u[-1]] * 2], 2).toarray()
    in_s = BSpline.design_matrix(x, np.r_[[s[0]] * 3, s, [s[-1]] * 3], 3).toarray()
    return np.einsum("xk,kl,xl->x", in_u, c, in_s)


def test_kernel_is_the_tensor_product_spline():
    one, rng = a_map(), np.random.default_rng(1)
    drop, opening = rng.uniform(0, one.drop_max, 5000), rng.uniform(one.deadband, 10.0, 5000)
    # both are sums of a dozen products in double precision
    exact, least = by_scipy(one, drop, opening), 1e-13 * one.rated_flow
    np.testing.assert_allclose(one.flow(drop, opening), exact, rtol=0, atol=least)


def test_packed_maps_keep_apart_and_match_the_arrays():
    maps, rng = [a_map(k) for k in range(4)], np.random.default_rng(2)
    data, at = pack(maps)
    assert data.dtype == np.float64 and at.tolist() == sorted(at) and at[0] == 0
    for one, start in zip(maps, at, strict=True):
        for drop, opening in zip(rng.uniform(0, 9e6, 50), rng.uniform(0, 12, 50), strict=True):
            flow = map_flow(drop, opening, data, start)
            assert flow == one.flow(drop, opening)
            assert map_command(drop, flow, data, start) == one.command(drop, flow)
    assert len({one.flow(1e6, 5.0) for one in maps}) == 4
    assert pack([])[1].size == 0


def test_a_million_round_trips():
    one, rng = a_map(), np.random.default_rng(3)
    drop = rng.uniform(1.0, 1.2 * one.drop_max, 10**6)
    command = rng.uniform(one.deadband, one.command_max, 10**6)
    flow = one.flow(drop, command)
    # the bench asks 1e-3 of rated flow; the closed form gives rounding
    assert np.abs(one.flow(drop, one.command(drop, flow)) - flow).max() < 1e-12 * one.rated_flow
    wanted = rng.uniform(0.0, 1.0, 10**6) * one.flow(drop, one.command_max)
    assert np.abs(one.flow(drop, one.command(drop, wanted)) - wanted).max() < 1e-12 * one.rated_flow


def test_a_map_is_odd_rises_broadcasts_and_keeps_nan():
    one = a_map()
    assert np.all(one.flow(0.0, np.linspace(0, 12, 50)) == 0.0)
    assert np.all(one.flow(np.linspace(-7e6, 7e6, 50), one.deadband) == 0.0)
    drop = np.linspace(0, 8e6, 50)
    np.testing.assert_array_equal(one.flow(-drop, 6.0), -one.flow(drop, 6.0))
    drop, opening = np.linspace(1e3, 9e6, 200), np.linspace(one.deadband, 13.0, 3000)
    assert np.all(np.diff(one.flow(drop[:, None], opening), axis=1) > 0)
    for drop, other in ((math.nan, 5.0), (1e6, math.nan), (math.nan, math.nan)):
        assert math.isnan(one.flow(drop, other))
        assert math.isnan(one.command(drop, other))
    assert isinstance(one.flow(1e6, 5.0), float) and isinstance(one.flow_std(1e6, 5.0), float)
    grid = (np.linspace(0, 1e6, 4)[:, None], np.linspace(0, 10, 3))
    for what in (one.flow, one.command, one.flow_std, one.inside, one.reachable):
        assert what(*grid).shape == (4, 3)


def test_slopes_are_continuous_above_the_deadband_and_finite_at_zero_drop():
    one = a_map()
    h = 1e-6
    for knot in one.opening_knots[1:]:
        q = one.flow(2.2e6, knot + h * np.array([-1, 0, 1]))
        # one-sided slopes differ by h times the curvature, some 1e-6 of them
        assert math.isclose(q[1] - q[0], q[2] - q[1], rel_tol=1e-4)
    edges = np.linspace(0, root_drop(one.drop_max, one.delta), one.increments.shape[1] - 1)[1:-1]
    for s in edges:
        drop = s * math.sqrt(0.5 * s**2 + math.sqrt(0.25 * s**4 + one.delta**2))
        q = one.flow(drop * (1 + 1e-6 * np.array([-1, 0, 1])), 5.0)
        assert abs((q[2] - q[1]) - (q[1] - q[0])) < 1e-5 * one.rated_flow * 1e-6
    slope = one.flow(np.array([1e-3, 1e-2, 1e-1]), 5.0) / np.array([1e-3, 1e-2, 1e-1])
    np.testing.assert_allclose(slope, slope[0], rtol=1e-4)


def test_beyond_the_largest_drop_the_flow_joins_on_and_grows_no_faster_than_an_orifice():
    falling = np.ones((10, 9)) * GPM * np.linspace(1.0, 0.5, 9)
    for one in (a_map(), a_map(increments=falling)):
        edge = one.flow(one.drop_max, 7.0)
        assert math.isclose(one.flow(one.drop_max * (1 + 1e-9), 7.0), edge, rel_tol=1e-6)
        ratio = one.flow(4 * one.drop_max, 7.0) / edge
        # twice the root of the drop, δ and rounding aside
        assert 1.0 - 1e-12 <= ratio <= 2.0 + 1e-4
    assert a_map(increments=falling).flow(4 * one.drop_max, 7.0) == pytest.approx(edge, rel=1e-12)


def test_inverse_saturates_shuts_and_says_so():
    one = a_map()
    most = one.flow(1e6, one.command_max)
    flows = most * np.array([0.0, 0.5, 1.01, -0.1])
    commands = np.asarray(one.command(1e6, flows))[[0, 2, 3]]
    np.testing.assert_array_equal(commands, [0.0, one.command_max, 0.0])
    np.testing.assert_array_equal(one.reachable(1e6, flows), [True, True, False, False])
    assert one.command(0.0, 1e-4) == one.command_max and not one.reachable(0.0, 1e-4)
    assert one.deadband < one.command(1e6, 1e-9 * most) < one.deadband + 1e-3


def test_range_and_error_follow_their_tables():
    one = a_map()
    places = np.array([[2e6, 4e6, 1e6, 5e4], [10.0, 10.0, 10.1, 3.0]])
    assert one.inside(*places).tolist() == [True, False, False, False]
    high = 6.5e6 + (3e6 - 6.5e6) * (6.0 - 2.0) / 8.0
    assert one.inside(high - 1.0, 6.0) and not one.inside(high + 1.0, 6.0)
    # s = 1000 there
    drop = float(np.sqrt(0.5 * 1e12 + np.sqrt(0.25 * 1e24 + 1e6**2 * one.delta**2)))
    assert one.flow_std(drop, 5.0) == pytest.approx(0.03 * GPM, rel=1e-9)
    assert one.flow_std(drop, 0.5 * (1.6 + 5.0)) == pytest.approx(0.02 * GPM, rel=1e-9)
    assert one.flow_std(drop, 0.0) == 0.0 and one.flow_std(0.0, 5.0) == 0.0
    assert one.flow_std(1e9, 50.0) == pytest.approx(0.08 * GPM, rel=1e-9)


def test_both_directions_take_signed_drops():
    both = ValveMaps(a_map(0), a_map(1, direction="reverse"))
    drop = np.array([-2e6, 0.0, 2e6])
    flow = both.flow(drop, 5.0)
    ends = [-both.reverse.flow(2e6, 5.0), 0.0, both.forward.flow(2e6, 5.0)]
    np.testing.assert_array_equal(flow, ends)
    np.testing.assert_allclose(both.command(drop[[0, 2]], flow[[0, 2]]), 5.0, rtol=1e-12)
    assert both.inside(-2e6, 5.0) and both.command(-2e6, flow[2]) == 0.0
    assert both.reachable(-2e6, flow[0]) and not both.reachable(-2e6, -flow[0])
    alone = ValveMaps(a_map(0))
    assert alone.flow(-2e6, 5.0) == -alone.flow(2e6, 5.0)
    assert alone.inside(2e6, 5.0) and not alone.inside(-2e6, 5.0)


def test_file_reads_back_exactly_and_writes_the_same_bytes(tmp_path):
    maps = collect([a_map(1, direction="reverse"), a_map(0), a_map(2, valve="boom.repc")])
    text = dump_flow_maps(maps)
    again = collect([a_map(2, valve="boom.repc"), a_map(0), a_map(1, direction="reverse")])
    assert dump_flow_maps(again) == text
    save_flow_maps(maps, tmp_path)
    path = tmp_path / "flow_maps.json"
    assert path.read_text(encoding="utf-8") == text
    for loaded in (load_flow_maps(tmp_path), load_flow_maps(path)):
        assert dump_flow_maps(loaded) == text and list(loaded) == ["boom.repc", "hect"]
        np.testing.assert_array_equal(loaded["hect"].reverse.data, maps["hect"].reverse.data)
        assert loaded["hect"].forward.outliers == ("line 3: odd",)
        assert loaded["boom.repc"].reverse is None


def test_unknown_valve_names_those_there_are(tmp_path):
    maps = collect([a_map(), a_map(valve="repc")])
    with pytest.raises(UnknownValve, match="no flow map of 'rect'.*hect, repc"):
        maps["rect"]
    assert "rect" not in maps and maps.get("rect") is None and len(maps) == 2


@pytest.mark.parametrize(
    "changes, word",
    [
        ({"deadband": 1.7}, "opening_knots"),
        ({"increments": np.zeros((10, 9))}, "increments must be positive"),
        ({"increments": np.ones((9, 9))}, "one row for each"),
        ({"increments": np.full((10, 9), math.nan)}, "not finite"),
        ({"rated_flow": 0.0}, "positive"),
        ({"hull_low": np.zeros(2)}, "hull_command"),
        ({"std": np.zeros((2, 2))}, "std"),
    ],
)
def test_damaged_maps_are_refused(changes, word):
    with pytest.raises(InputError, match=word):
        a_map(**changes)


def test_damaged_files_are_refused_by_name(tmp_path):
    path = tmp_path / "flow_maps.json"
    with pytest.raises(InputError, match="no such file"):
        load_flow_maps(tmp_path)
    good = json.loads(dump_flow_maps(collect([a_map()])))

    def refused(content, word):
        text = content if isinstance(content, str) else json.dumps(content)
        path.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=word) as caught:
            load_flow_maps(path)
        assert caught.value.file == str(path)

    refused("{", "no JSON")
    refused([], "no flow maps")
    refused({**good, "version": 99}, "version 99")
    refused({**good, "maps": [3]}, "fields|flow map|argument|iterable")
    one = good["maps"][0]
    refused({**good, "maps": [{k: v for k, v in one.items() if k != "std"}]}, "wrong fields: std")
    refused({**good, "maps": [{**one, "increments": "x"}]}, "wrong kind|damaged|could not convert")
    refused({**good, "maps": [one, one]}, "two forward maps")
    refused({**good, "maps": [{**one, "direction": "up"}]}, "direction 'up'")
    refused({**good, "maps": [{**one, "direction": "reverse"}]}, "reverse map only")
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="no JSON text"):
        load_flow_maps(path)


def test_table_is_the_map_in_the_units_asked_for():
    one = a_map(valve='my "boom", left')
    text = table(collect([one]), {(one.valve, one.direction): -1}, "L/min", "bar")
    import csv

    rows = list(csv.DictReader(text.splitlines()))
    assert len(rows) == 25 * one.hull_command.size and rows[0]["valve"] == 'my "boom", left'
    row = rows[-2]
    drop, command = float(row["pressure_drop [bar]"]) * 1e5, float(row["opening [V]"])
    # six digits in the table
    assert float(row["flow [L/min]"]) == pytest.approx(one.flow(drop, command) * 6e4, rel=1e-5)
    assert row["inside"] == str(int(one.inside(drop, command)))
    for row in rows:
        assert float(row["driver_command [V]"]) == -float(row["opening [V]"])


def non_negative(gram, right, guess):
    def least(zero):
        x, used = np.zeros(right.size), ~zero
        x[used] = np.linalg.solve(gram[np.ix_(used, used)], right[used])
        return x

    return pivoted(least, lambda x: x, lambda x: gram @ x - right, guess)


@pytest.mark.parametrize("guess", [False, True])
def test_non_negative_least_squares_are_those_of_scipy(guess):
    from scipy.optimize import nnls

    rng = np.random.default_rng(4)
    for _ in range(20):
        rows = rng.standard_normal((30, 20))
        wanted = rng.standard_normal(30)
        found, zero = non_negative(rows.T @ rows, rows.T @ wanted, np.full(20, guess))
        np.testing.assert_array_equal(found == 0.0, zero)
        # the normal matrix squares the condition, some 10², of twenty random columns
        # pyrefly: ignore[no-matching-overload]
        np.testing.assert_allclose(found, nnls(rows, wanted)[0], atol=1e-10)


@pytest.mark.parametrize(
    ("given", "volts", "soft", "sharp"),
    [
        ({}, [1, 2.5, 3.5, 4.5, 5.5, 6], [], []),
        ({"soft": True}, [1, 2, 2.5, 3.5, 4.5, 5.5, 6], [0, 1], []),
        ({"kinks": (3.2,)}, [1, 2.5, 3.19, 3.21, 4.5, 5.5, 6], [], [2]),
        ({"kinks": (3.2, 5.8)}, [1, 2.5, 3.19, 3.21, 4.5, 5.79, 5.81, 6], [], [2, 5]),
        ({"kinks": (0.9, 1.9, 6.5)}, [1, 2.5, 3.5, 4.5, 5.5, 6], [], []),
        ({"deadband": 2.6}, [2.6, 3.5, 4.5, 5.5, 6], [], []),
    ],
)
def test_a_spline_breaks_between_commands_and_about_its_kinks(given, volts, soft, sharp):
    """At a hundredth of the gap to either side; softly over two spans from the deadband."""
    above, axis = np.arange(2.0, 7.0), Axis(np.linspace(0.0, 1.0, 4), 3)
    spline = Spline(given.pop("deadband", 1.0), above, axis, **given)
    assert spline.volts == pytest.approx(volts)
    free = np.ones(len(volts) - 1)
    free[soft], free[sharp] = 1e-9, 1e-7
    assert spline.along_u.stiffness == pytest.approx(free, rel=1e-9)
    assert (spline.sign > 0.0).all()
    falls = Spline(1.0, above, axis, rising=4.4).sign.reshape(spline.columns, -1)
    assert falls[0].tolist() == [1, 1, 1, 1, -1, -1] and (falls == falls[0]).all()


@pytest.mark.parametrize("spans", [3, 5, 12, None])
@pytest.mark.parametrize("rising", [np.inf, 3.0])
def test_a_splines_bands_and_increments_are_those_of_the_full_matrices(spans, rising):
    rng = np.random.default_rng(5)
    along_s = Axis(np.linspace(0, 1, spans + 1), 3) if spans else OneColumn()
    above = np.array([1.5, 2.0, 3.0, 5.0, 8.0])
    spline = Spline(1.2, above, along_s, rising=rising)
    u, s, smoothing = rng.uniform(1.2, 8, 200), rng.uniform(0, 1, 200), np.array([1e-2, 1e-3])
    u[:3], s[:3] = (1.2, 8.0, 2.0), (0.0, 1.0, 0.0)
    design, weight = spline.design(u, s), rng.uniform(0.5, 2.0, 200)
    # with noise so large that the free fit falls somewhere
    wanted = (1.0 if spans else 40.0) * rng.standard_normal(200) + 4 * s * (u - 1.2)
    gram, right = design.T @ (weight[:, None] * design), design.T @ (weight * wanted)
    band, pull = spline.normal(spline.factors(u, s), weight, wanted)
    np.testing.assert_allclose(full(band), gram, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(pull, right, rtol=1e-12, atol=1e-12)
    along_u = spline.along_u
    whole = gram + smoothing[0] * np.kron(along_s.mass, along_u.curvature)
    whole += smoothing[1] * np.kron(along_s.curvature, along_u.mass)
    np.testing.assert_allclose(
        full(spline.penalised(band, smoothing)), whole, rtol=1e-12, atol=1e-12
    )
    free, determinant = spline.free(band, right, smoothing)
    np.testing.assert_allclose(free, np.linalg.solve(whole, right), rtol=1e-8, atol=1e-8)
    rough = free @ (whole - gram) @ free
    assert spline.roughness(free, smoothing) == pytest.approx(rough, rel=1e-9)
    # a penalty's eigenvalues are those of its pencil with the mass, one of which is zero: the plane
    # u·s
    mass = np.kron(along_s.mass, along_u.mass)
    prior = np.linalg.eigvals(np.linalg.solve(mass, whole - gram)).real
    least = np.argmin(np.abs(prior))
    exact = np.linalg.slogdet(whole)[1] - np.linalg.slogdet(mass)[1]
    exact -= np.log(np.delete(prior, least)).sum()
    assert determinant == pytest.approx(exact, abs=1e-6)
    held, _, tied = spline.solve(band, right, smoothing)
    steps = spline.sign * spline.increments(free).T.ravel()
    above_floor = spline.sign * spline.increments(held - spline.floor).T.ravel()
    assert steps.min() < 0 <= above_floor.min() + 1e-12
    # no step in a direction that the constraint allows makes it better
    slope = spline.sign * spline.over_steps(whole @ held - right)
    at_floor = above_floor < 1e-9
    assert np.abs(slope[~at_floor]).max() < 1e-8 and slope[at_floor].min() > -1e-8
    # a first guess of what is tied, right or wrong, changes nothing
    for near in (tied, ~tied, np.zeros_like(tied)):
        again, _, found = spline.solve(band, right, smoothing, near)
        np.testing.assert_allclose(again, held, rtol=1e-9, atol=1e-11)
        np.testing.assert_array_equal(found, tied)
    # the slower way comes to the same
    rest = right - whole @ spline.floor
    slower = spline.by_nnls(spline.penalised(band, smoothing), rest)
    np.testing.assert_allclose(spline.floor + slower, held, rtol=1e-7, atol=1e-9)


def test_a_reading_is_compared_on_its_side_of_the_hysteresis():
    """``fitted`` is what the fit makes of a reading; the map where the fit has nothing."""
    one = a_map()
    command, drop = np.array([4.0, 4.0, 6.0, 6.0]), np.full(4, 2.0e6)
    level = np.asarray(one.flow(drop, command))
    side = np.array([-0.03, 0.03, 0.0, 0.0]) * one.rated_flow
    error = np.array([1e-3, -1e-3, 0.0, np.nan]) * one.rated_flow
    flow = level + side + error
    flow[2:] = 0.5 * level[2:]  # below the meter's limit; at a drop of which there is no residual
    fit = SimpleNamespace(map=one, residuals=error)
    found = fitted_flow(fit, SimpleNamespace(command=command, flow=flow), drop)
    np.testing.assert_allclose(found[:2], (level + side)[:2], rtol=1e-9)
    np.testing.assert_array_equal(found[2:], level[2:])


# --- standard errors in closed form


def test_readings_have_levels_and_drops_that_differ():
    """Drops by 3 % and by 0.3 % of the largest, commands by 0.5 % of theirs; between many drops
    there are no gaps."""
    command, drop = np.repeat([0.02, 0.03, 0.04, 0.05], 5), np.tile([1e4, 3e4, 1e6, 4e6, 8e6], 4)
    flow = 5e-3 * command * np.sqrt(drop / 8e6)
    readings = sort_readings("v", readings_table(command, drop, flow), FlowMapOptions(), 0.0)
    assert np.unique(readings.level).size == 4 and readings.places_read.size == 4
    assert np.unique(readings.cell).size == 16
    assert readings.delta == pytest.approx(8e3)  # 1e-3 of the largest drop
    with pytest.raises(ValueError, match="negative"):
        sort_readings("v", readings_table(command - 0.025, drop, flow), FlowMapOptions(), 0.0)
    first = readings_module.first_noise(readings)
    assert first == readings_module.Noise({"flowmeter": (3e-3, 1e-2)}, 0)
    assert readings.roots == pytest.approx([0.0, *readings.places_read])
    command = np.repeat([2.0, 3.0, 4.0, 5.0], 90)
    drop = np.tile(8e6 * np.linspace(0.05, 1.0, 90) ** 2, 4)
    many = readings_table(command, drop, 1e-4 * command * np.sqrt(drop / 8e6))
    assert sort_readings("v", many, FlowMapOptions(), 0.0).roots.size == 0


def test_readings_know_from_where_their_command_came():
    """The first of a trial came from nowhere known; one that stands goes on as the last moved."""
    up = [1.0, 2.0, 3.0, 4.0, 5.0, 5.0, 6.0]
    u = np.array([*up, *up[::-1]])
    way = readings_module._sweeps(u, np.ones(14, int), np.arange(14))
    assert way.tolist() == [0, *[1] * 7, *[-1] * 6]
    assert not readings_module._sweeps(u[:8], np.ones(8, int), np.arange(8)[::-1]).tolist()[-1]
    turned = readings_module._sweeps(u, np.repeat([1, 2], 7), np.arange(14)[::-1])
    assert turned.tolist() == [*[-1] * 6, 0, *[1] * 6, 0]


def test_a_hysteresis_moves_commands_by_half_of_it_but_not_below_zero():
    up = [0.0, 0.1, 2.0, 3.0, 4.0, 5.0]
    command, drop = np.tile([*up, *up[::-1]], 4), np.repeat([1e6, 2e6, 3e6, 4e6], 12)
    rows = readings_table(command, drop, 1e-5 * command, trial=np.repeat(np.arange(4), 12))
    readings = sort_readings("v", rows, FlowMapOptions(), 0.4)
    moved = [0.0, 0.0, 1.8, 2.8, 3.8, 4.8, 4.8, 4.2, 3.2, 2.2, 0.3, 0.2]
    assert readings.u == pytest.approx(np.tile(moved, 4)[readings.row])


@pytest.mark.parametrize(("least", "silent"), [(0.0, 5), (-1e-6, 0)])
def test_a_meter_that_reads_nothing_below_its_first_reading_is_silent_there(least, silent):
    """One that also reads less than nothing shows its noise about zero instead."""
    command, drop = np.repeat([1.0, 2.0, 3.0, 4.0, 5.0], 5), np.tile([1e6, 2e6, 3e6, 4e6, 5e6], 5)
    flow = np.where(command < 1.5, 0.0, 1e-5 * command * np.sqrt(drop / 1e6))
    flow[0] = least
    readings = sort_readings("v", readings_table(command, drop, flow), FlowMapOptions(), 0.0)
    assert np.count_nonzero(readings.silent) == silent
    assert set(readings.limit.tolist()) == {2e-5 if silent else 0.0}


def test_medians_are_those_of_each_group():
    rng, group = np.random.default_rng(3), np.repeat([2, 0, 3, 1], [1, 4, 7, 2])
    values = rng.standard_normal(14)
    expected = [np.median(values[group == k]) for k in range(4)]
    assert readings_module.medians(values, group) == pytest.approx(expected)


def test_the_farthest_three_readings_may_always_be_left_out():
    size = np.arange(40.0)
    assert np.flatnonzero(few(size > 30.0, size)).tolist() == [37, 38, 39]
    assert np.flatnonzero(few(size == 3.0, size)).tolist() == [3]
    size = np.arange(400.0)
    assert np.count_nonzero(few(size > 30.0, size)) == 20


@pytest.mark.parametrize(("bends", "share"), [(True, 0.5), (False, 0.25)])
def test_a_kink_between_two_drops_is_in_the_standard_error(bends, share):
    """Slope 2 more from 0.37 on: the chord over its gap is off by κ·h·w·(1 − w) at most."""
    roots = np.array([0.1, 0.2, 0.3, 0.5, 0.6, 0.7, 0.8])
    kinked = lambda u, s: u + 2.0 * np.maximum(s - 0.37, 0.0)
    result = SimpleNamespace(
        readings=SimpleNamespace(roots=roots, levels=np.arange(4.0)),
        solution=SimpleNamespace(at=kinked),
        shape=SimpleNamespace(along_s=SimpleNamespace(kink=bends)),
        window=SimpleNamespace(opens=1),
    )
    s = np.array([0.3, 0.37, 0.45, 0.55, 0.65, 0.75, 0.95])
    std = np.sqrt(results._between(result, np.full(s.size, 3.0), s))
    inside = np.array([0.0, 0.35 * 0.65, 0.75 * 0.25])
    assert std[:3] == pytest.approx(share * 2.0 * 0.2 * inside)
    assert std[3] == pytest.approx(share * 2.0 * 0.1 * 0.25)  # its neighbour may hold it
    assert std[4] == pytest.approx(share * 0.7 * 0.1 * 0.25)  # 1.3 and 2 before and behind 0.5
    assert std[5:] == pytest.approx(0.0, abs=1e-12)
    result.readings.roots = roots[:3]
    assert results._between(result, s, s) == pytest.approx(0.0, abs=1e-20)


@pytest.mark.parametrize(("opens", "told"), [(0, [0]), (1, [0, 2]), (2, [2, 4])])
def test_how_a_flow_starts_between_two_commands_is_in_the_standard_error(opens, told):
    """Flow 2 a volt from 1.4 V on: its slope is 1.2 from 1 to 2 V and 2 beyond, so a kink of 2 in
    the gap below 2 V, one of 1.2 and of 0.8 in those next to it. Only what is next to the lowest
    command with flow is told."""
    starts = lambda u, s: 2.0 * np.maximum(u - 1.4, 0.0) + 5.0 * np.maximum(u - 4.0, 0.0)
    result = SimpleNamespace(
        readings=SimpleNamespace(roots=np.array([0.2, 0.5]), levels=np.arange(7.0)),
        solution=SimpleNamespace(at=starts),
        shape=SimpleNamespace(along_s=SimpleNamespace(kink=False)),
        window=SimpleNamespace(opens=opens),
    )
    u = np.array([0.5, 1.0, 1.4, 2.0, 2.5, 3.5, 4.5])
    std = np.sqrt(results._between(result, u, np.full(u.size, 0.3)))
    every = np.array([1.2 * 0.25, 0.0, 2.0 * 0.4 * 0.6, 0.0, 0.8 * 0.25, 5.0 * 0.25, 5.0 * 0.25])
    assert std == pytest.approx(0.25 * every * np.isin(np.arange(7), told), abs=1e-12)


def test_a_miss_beyond_chance_is_in_the_standard_error():
    """Of one cell its square less 1 + 1.6 √2 variances of its noise; of two the nearer counts."""
    cells = SimpleNamespace(
        weight=np.array([1e4, 1e4, 0.0, 1e4]),
        u=np.array([3.0, 9.0, 3.0, 1.0]),
        s=np.array([0.5, 0.5, 0.5, 0.5]),
        y=np.array([1.1, 1.02, 9.0, 9.0]),
    )
    places = lambda u, s: np.stack([100.0 * u, s], axis=1)
    result = SimpleNamespace(
        readings=SimpleNamespace(places=places),
        solution=SimpleNamespace(cells=cells, at=lambda u, s: np.ones(u.size)),
        deadband=SimpleNamespace(value=1.5),
    )
    variance = results._missed(result, np.array([3.0, 9.0, 3.0]), np.full(3, 0.5))
    sure = 1.0 + 1.6 * math.sqrt(2.0)
    assert variance == pytest.approx(np.array([0.01, 0.02**2, 0.01]) - sure * 1e-4)
    cells.y[:] = 1.015
    assert not results._missed(result, np.array([3.0]), np.array([0.5])).any()
    result.deadband.value = 10.0
    assert not results._missed(result, np.array([3.0]), np.array([0.5])).any()


def test_trials_scatter_as_dersimonian_and_laird_have_it():
    """Of equal weights p: τ² is the variance of the factors less 1/p."""
    factors, each = np.array([0.02, -0.05, 0.04, 0.03]), 50
    trial = np.repeat(np.arange(4), each)
    flow = np.tile(np.linspace(0.2, 1.0, each), 4)
    solution = SimpleNamespace(flow=flow, lone=np.zeros(1, bool))
    cell = np.zeros(trial.size, int)
    result = SimpleNamespace(
        readings=SimpleNamespace(trial=trial, cell=cell),
        solution=solution,
        keep=np.ones(trial.size, bool),
        residuals=factors[trial] * flow,
        noise=SimpleNamespace(std=lambda readings, flow: np.full(flow.size, 0.1)),
    )
    precision = float(np.sum(flow[:each] ** 2)) / 0.01
    between = np.var(factors, ddof=1) - 1.0 / precision
    assert results._trial_scatter(result) == pytest.approx(math.sqrt(between / 4.0))
    result.keep[5], result.residuals[5] = False, 99.0  # what is left out counts nowhere
    assert results._trial_scatter(result) == pytest.approx(math.sqrt(between / 4.0), rel=0.01)
    result.keep[5], result.residuals[5] = True, factors[0] * flow[5]
    result.keep = trial < 3
    between = np.var(factors[:3], ddof=1) - 1.0 / precision
    assert results._trial_scatter(result) == pytest.approx(math.sqrt(between / 3.0))
    result.keep = trial < 2
    between = np.var(factors[:2], ddof=1) - 1.0 / precision
    assert results._trial_scatter(result) == pytest.approx(math.sqrt(max(between, 0.0) / 2.0))
    result.residuals *= 0.1
    assert results._trial_scatter(result) == 0.0
    result.keep = trial < 1
    assert results._trial_scatter(result) == 0.0


def test_a_leak_is_the_mean_below_the_deadband_and_never_negative():
    u = np.array([0.0, 0.5, 1.0, 1.1, 2.0])
    readings = SimpleNamespace(
        u=u, q=np.array([1.0, 3.0, 2.0, 9.0, 9.0]), rated=10.0, y=np.array([0.1, 0.3, 0.2, 9, 9])
    )
    result = SimpleNamespace(
        readings=readings,
        keep=np.ones(5, bool),
        deadband=SimpleNamespace(interval=(1.0, 1.2)),
        solution=SimpleNamespace(flow=np.full(5, 0.1)),
    )
    mean, (low, high) = results._leakage(result)
    std = math.sqrt(0.05 / 3.0 / 3.0)  # of residuals 0, 0.2 and 0.1
    assert (mean, low) == (pytest.approx(0.2), pytest.approx(0.2 - 1.959964 * std))
    assert high == pytest.approx(0.2 + 1.959964 * std)
    assert results._interval(0.1, 1.0) == (0.0, pytest.approx(2.059964))
    result.keep = u > 1.0
    assert results._leakage(result) == (0.0, (0.0, 0.0))
    np.testing.assert_array_equal(results._digits([1.23456, -98765.4], 3), [1.23, -98800.0])


@dataclass(frozen=True)
class Bend:
    """A shape that knows its commands and kinks."""

    above: np.ndarray
    kinks: tuple[float, ...]

    def spline(self):
        return self


@pytest.mark.parametrize("spread", [0.05, 0.2])
def test_a_kink_is_placed_by_its_likelihood(monkeypatch, spread):
    """Normal about 5.03 V: its error, that of the grid, and 95 % with a step to spare."""
    square = lambda shape, moved, cells: np.array(
        [((m.kinks[-1] - 5.03) / spread) ** 2 for m in moved]
    )
    monkeypatch.setattr(shapes, "likelihoods", square)
    above = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 9.0])
    kink = shapes._place(Bend(above, (2.5, 5.4)), None)
    step = 3.0 / 61.0
    assert kink.value == pytest.approx(5.03, abs=0.5 * step)
    assert kink.std == pytest.approx(math.sqrt(spread**2 + step**2 / 12.0), rel=0.02)
    assert kink.interval == pytest.approx(
        (5.03 - 1.96 * spread, 5.03 + 1.96 * spread), abs=1.6 * step
    )
    assert kink.interval[1] - kink.interval[0] > 2.0 * 1.96 * spread
    gaps = shapes.gaps_of(above, (kink,))
    ends = [(gap[0], gap[-1]) for gap in gaps]
    inner = [(2.0, 3.0), (3.0, 4.0), (4.0, 5.0), (6.0, 7.0)]
    assert ends == [pytest.approx((a + 1 / 9, a + 8 / 9)) for a, _ in inner]
    assert all(gap.size == 8 for gap in gaps)


def test_a_deadbands_profile_closes_in_on_what_is_likely(monkeypatch):
    """Deadbands within √14 standard errors fill at least eight points of fifteen in the end."""
    monkeypatch.setattr(shapes, "likelihoods", lambda shape, tried, cells: np.array([*tried]))
    shape = SimpleNamespace(spline=lambda u: ((u - 1.37) / 0.01) ** 2 + 7.0)
    readings, window = SimpleNamespace(levels=np.array([10.0])), SimpleNamespace(low=0.0, high=3.0)
    grid, rise = shapes.profile_deadband(readings, shape, None, window)
    assert grid.size == 15 and rise.min() == 0.0
    far = math.sqrt(14.0) * 0.01
    assert np.count_nonzero(np.abs(grid - 1.37) < far) > 5
    assert grid[0] < 1.37 - 0.02 and grid[-1] > 1.37 + 0.02 and np.ptp(grid) < 0.2
    readings.levels[0] = 1e4
    assert np.ptp(shapes.profile_deadband(readings, shape, None, window)[0]) == 3.0
