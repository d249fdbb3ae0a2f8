"""Flow maps and operating points on small arrays, against closed forms."""

import math
from types import SimpleNamespace as Stub
from typing import Any

import numpy as np
import pytest

from ehbench.flow_maps import step_readings, tables
from ehbench.plant.model import Model
from ehbench.tune.draws import uncertain
from ehbench.tune.operating_point import FED
from ehbench.tune.study import rail_notes
from ehbench.vocabulary.fields import Value
from tests.shared import shipped


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
    assert told.fields["half"] == pytest.approx(1000.0 * 1.96 * line.stderr)


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
