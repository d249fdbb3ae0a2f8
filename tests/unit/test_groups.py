"""Products and ratios that the data know where they do not know each parameter."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from ehbench.identification import uncertainty
from ehbench.identification.groups import _leaders, _percent, _rounded, groups_of, sentence
from ehbench.identification.search import Coordinate
from ehbench.identification.uncertainty import together

NAMES = ("mass", "area", "volume", "bulk_modulus", "damping")
VALUES = (250.0, 2e-3, 1e-3, 9e8, 800.0)


def normal_of(*known):
    """JᵀJ of readings that know each of some products of powers to 1 %."""
    rows = np.array([[power.get(name, 0.0) for name in NAMES] for power in known]) / 0.01
    return rows.T @ rows


def test_unknown_scales_are_told_as_the_products_that_are_known():
    normal = normal_of({"mass": 1, "area": -2}, {"volume": 1, "bulk_modulus": -1}, {"damping": 1})
    found = groups_of(NAMES, VALUES, normal, 1.0)
    powers = [{n: abs(p) for n, p in one.powers.items()} for one in found]
    assert {"mass": 1.0, "area": 2.0} in powers and {"volume": 1.0, "bulk_modulus": 1.0} in powers
    assert len(found) == 2
    for one in found:
        assert one.std == pytest.approx(0.01, rel=0.01) and min(one.alone.values()) > 1e3
        value = math.prod(
            dict(zip(NAMES, VALUES, strict=True))[n] ** p for n, p in one.powers.items()
        )
        assert one.interval[0] < one.value < one.interval[1]
        assert one.value == pytest.approx(value)
    said = sentence(found)
    assert "area^2" in said and "damping" not in said and "unknown" in said


def test_parameters_that_are_known_each_make_no_group():
    assert groups_of(NAMES, VALUES, np.diag([1e4, 2e4, 3e4, 1e4, 1e2]), 2.0) == ()
    # correlated by 0.8: each is known nearly as well as their product
    pair = np.linalg.inv(np.array([[1.0, 0.8], [0.8, 1.0]]))
    assert groups_of(NAMES[:2], VALUES[:2], pair, 1.0) == ()


def test_a_scale_of_all_is_told_against_one():
    """Everything that grows with the size of a cylinder whose forces were not measured."""
    normal = normal_of(
        {"mass": 1, "area": -1}, {"volume": 1, "area": -1}, {"damping": 1, "area": -1}
    ) + np.diag([0.0, 0.0, 0.0, 1e4, 0.0])
    found = groups_of(NAMES, VALUES, normal, 1.0)
    assert len(found) == 3 and not any("bulk_modulus" in one.powers for one in found)
    (leader,) = set.intersection(*(set(one.powers) for one in found))
    assert all(one.powers[leader] == -1.0 for one in found)


def test_parameters_that_hang_together_are_one_note():
    """Chains of pairs are one set; pairs alone keep their sign; what a group says is left out."""
    names = ["a", "b", "c", "d", "e"]
    correlation = np.eye(5)
    for i, j, r in ((0, 1, 0.96), (1, 2, -0.99), (3, 4, -0.97)):
        correlation[i, j] = correlation[j, i] = r
    assert together(names, correlation, []) == [
        "a, b and c are correlated with one another, b and c most, by -0.990: the logs tell them "
        "only together",
        "d and e are correlated by -0.970: the logs tell them only together",
    ]
    (left,) = together(names, correlation, [{"a", "b", "c"}])
    assert left.startswith("d and e")
    assert together(names, correlation, [{"a", "b", "c"}, {"d", "e"}]) == []


@pytest.mark.parametrize("unit", [1.0, 1e-3])
def test_a_product_is_known_by_what_another_parameter_does_not_explain(monkeypatch, unit):
    """Two gains move the readings by a + 3 b, an offset moves them by b: a alone tells of them."""
    columns = np.zeros((40, 3))
    columns[:20] = unit * 5.0 * np.array([1.0, 1.0, 0.0])
    columns[20:] = unit * 4.0 * np.array([3.0, 3.0, 1.0])
    search = [Coordinate(n, True, 1.0, 1.0, 0.1, 9.0) for n in ("a.flow_gain", "b.flow_gain")]
    search.append(Coordinate("press.friction_coulomb", False, 1.0, 0.0, -9.0, 9.0))
    problem = SimpleNamespace(search=search, requested=3, limit_at=lambda *_: "")
    state = SimpleNamespace(live=(0, 1, 2), theta=np.zeros(3), at_bound=(), prior_weight=1.0)
    errors = SimpleNamespace(state=state, blocks=[columns.T @ columns], alone=np.zeros(3))
    monkeypatch.setattr(uncertainty, "eliminate", lambda normal, _: SimpleNamespace(normal=normal))
    errors.alone = 1.0 / np.sqrt(np.diag(errors.blocks[0]))  # no widening
    (group,) = uncertainty._groups(problem, errors)
    assert group.powers == {"a.flow_gain": 1.0, "b.flow_gain": 1.0}
    assert group.std == pytest.approx(1.0 / math.sqrt(20 * 25.0) / unit, rel=1e-3)


@pytest.mark.parametrize("powers", [(1, 1), (1, -1), (2, -1), (1, 0.3)])
@pytest.mark.parametrize("widening", [1.0, 4.0])
def test_a_product_has_its_standard_error_widened(powers, widening):
    """Of a combination told to 1 %; that across it is told to a factor alone."""
    p, q = powers
    rows = np.array([(p / 0.01, q / 0.01), (-q / 2.0, p / 2.0)])
    (group,) = groups_of(["a", "b"], [2.0, 3.0], rows.T @ rows, widening)
    lead = p / group.powers["a"]  # the product may be told by another root of it
    assert lead * group.powers["b"] == pytest.approx(q, rel=0.02)
    assert group.std == pytest.approx(0.01 * widening / abs(lead), rel=0.02)
    assert group.value == pytest.approx((2.0**p * 3.0**q) ** (1.0 / lead), rel=0.02)
    ends = [group.value * np.exp(sign * 1.96 * group.std) for sign in (-1.0, 1.0)]
    assert group.interval == pytest.approx(ends, rel=1e-3)
    size = p * p + q * q
    assert group.alone["a"] == pytest.approx(widening * np.hypot(0.01 * p, 2.0 * q) / size)
    told = sentence([group]).fields
    assert f"± {196.0 * group.std:.2g} %" in told["known"]
    factor = np.exp(1.96 * group.alone["a"])
    if 0.6 < group.alone["a"] < 3.0:
        assert f"a within a factor {factor:.2g}" in told["each"]
    elif group.alone["a"] > 3.0:
        assert "a unknown" in told["each"]


@pytest.mark.parametrize(("correlation", "leads"), [(0.96, 0), (0.98, 1), (-0.98, 1)])
def test_what_leads_would_make_another_four_times_as_sure(correlation, leads):
    """1/(1 - r²) is 12.8 and 25.3; the third hangs together with neither."""
    pair = np.array([[4.0, 2.0 * correlation], [2.0 * correlation, 1.0]])
    three = np.block([[pair, np.zeros((2, 1))], [np.zeros((1, 2)), np.eye(1)]])
    assert len(_leaders(three)) == leads and not {2} & {*_leaders(three)}


@pytest.mark.parametrize(
    ("power", "rounded"),
    [
        ([1.0, -0.34, 0.04], [1.0, -0.34, 0.0]),  # halves would be known no better than a factor
        ([1.0, -0.503, 0.04], [2.0, -1.0, 0.0]),
        ([1.0, -0.997, 0.04], [1.0, -1.0, 0.0]),
    ],
)
def test_exponents_are_of_halves_that_are_known_or_have_two_digits(power, rounded):
    """Of a product that is known to 1 % where all else is not known at all."""
    power = np.array(power)
    known = np.outer(power, power) / (power @ power)
    assert _rounded(power, np.eye(3) - (1.0 - 1e-4) * known).tolist() == rounded


@pytest.mark.parametrize(
    ("std", "shown"), [(0.1, "20 %"), (0.6, "3.2"), (2.9, "2.9e+02"), (3.1, "unknown")]
)
def test_a_factor_is_known_by_its_interval_to_a_percentage_a_factor_or_not_at_all(std, shown):
    assert _percent(std).endswith(shown)


def test_one_parameter_is_no_product():
    assert groups_of(["a"], [2.0], np.array([[1.0]]), 1.0) == ()
