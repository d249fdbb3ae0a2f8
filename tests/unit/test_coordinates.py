"""Search coordinates of parameters, by hand."""

import math

import numpy as np
import pytest

from ehbench.data.record import Record
from ehbench.identification.means import fastest
from ehbench.identification.search import FAR, MANY, Coordinate, coordinates, of_sensors
from ehbench.plant.model import Model
from ehbench.preprocessing.sensors import Term
from tests.settings import refusal
from tests.shared import shipped

SLIDE = shipped("slide_servo")


def one(name="carriage.damping", **given):
    (result,) = coordinates(SLIDE, [name], **given)
    return result


def test_a_logarithm_reaches_between_its_bounds_or_three():
    for upper, reach in ((2.0, math.log(2.0)), (100.0, 3.0)):
        place = Coordinate("carriage.damping", True, 1.0, 1.0, 1.0, upper)
        assert place.reach == pytest.approx(reach)
        assert place.begin == pytest.approx(1e-3 * reach)  # inside of its lower bound
        assert place.at(place.of(1.5)) == pytest.approx(1.5)
        assert place.at(99.0) == upper


def test_a_number_that_may_be_zero_is_searched_in_parts_of_its_range():
    name = "press.friction_coulomb"
    bounded = one(name, start={name: 50.0}, upper={name: 400.0})
    assert (bounded.log, bounded.unit, bounded.lower) == (False, 400.0, 0.0)
    assert not bounded.roams
    name = "press.leakage_head"
    open_ended = one(name, start={name: 1e-12}, lower={name: 0.0})
    assert (open_ended.log, open_ended.unit, open_ended.roams) == (False, 1e-12, True)


def test_a_positive_number_without_bounds_is_searched_as_a_factor():
    place = one(start={"carriage.damping": 2000.0})
    assert (place.log, place.unit) == (True, 1.0)
    assert place.start == 2000.0
    assert place.of(place.at(math.log(3000.0))) == pytest.approx(math.log(3000.0))


@pytest.mark.parametrize(("prior", "std"), [("3 %", 0.03), (60.0, None)])
def test_a_prior_is_a_share_or_a_number(prior, std):
    name = "carriage.damping"
    value = float(SLIDE.parameters()[name])
    place = one(name, prior={name: prior})
    assert place.known and place.centre == value
    assert place.prior == pytest.approx(60.0 if std is None else std * value)
    # in search coordinates, of a logarithm the relative one
    assert place.sharpness == pytest.approx(value / place.prior)


@pytest.mark.parametrize(("names", "given", "key"), [
    ([], {}, "parameters_once"),
    (["bulk_modulus", "bulk_modulus"], {}, "parameters_once"),
    (["bulk_modulos"], {}, "no_parameter"),
    (["bulk_modulus"], {"start": {"carriage.damping": 1.0}}, "not_fitted"),
    (["bulk_modulus"], {"upper": {"carriage.damping": 1.0}}, "not_fitted"),
    (["bulk_modulus"], {"start": {"bulk_modulus": 9e9}}, "start_outside"),
    (["bulk_modulus"], {"start": {"bulk_modulus": 2e9}, "upper": {"bulk_modulus": 2e9}}, ""),
    (["press.leakage_head"], {"start": {"press.leakage_head": 0.0}}, "zero_start"),
    (["carriage.damping"], {"lower": {"carriage.damping": 9.0},
                            "upper": {"carriage.damping": 9.0}}, "no_range"),
    (["carriage.damping"], {"prior": {"carriage.damping": "0 %"}}, "empty_prior"),
])  # fmt: skip
def test_what_is_no_search_is_refused(names, given, key):
    said = refusal(lambda: coordinates(SLIDE, names, **given))
    assert said == (f"identification.{key}" if key else "")


def test_sensors_of_all_logs_are_searched_and_those_of_a_log_are_not():
    def term(word, std, per_log=False):
        return Term("press.p_head", word, 0.0, 1.0, std, per_log)

    places = of_sensors([term("offset", 2.0), term("scale", 0.0), term("offset", 2.0, True)])
    assert [place.name for place in places] == ["press.p_head.offset"]
    (place,) = places
    assert (place.unit, place.upper, place.prior) == (MANY * 2.0, FAR * 2.0, 2.0)
    assert place.lower == -FAR * 2.0 and place.start == place.centre == 0.0


def test_the_fastest_motion_is_a_valve_s_where_the_oil_is_slow():
    """A spool of 400 Hz on a press whose mass swings far below that."""
    quick = SLIDE.with_values({"spool.natural_frequency": 2.0 * math.pi * 400.0})
    log = Record(np.arange(10) * 1e-3, {"press.x": np.full(10, 0.1)})
    oil = fastest(Model.of(SLIDE.with_values({"spool.natural_frequency": 1.0})), log)
    assert fastest(Model.of(quick), log) == pytest.approx(400.0)
    assert 5.0 < oil < 200.0  # with the valve out of the way
