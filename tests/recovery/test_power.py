"""The power study in small: its plant is an oracle of the model; its verdicts are of users."""

import pytest

from tools.power.machine import WAVES
from tools.power.study import ERRORS, Outcome, Trial, exact_table, judged, miss, wrong_table


@pytest.mark.parametrize(("seed", "wave"), list(enumerate(WAVES)))
def test_plant_and_model_agree_on_equal_numbers(seed, wave):
    assert miss(Trial(seed, wave, 0.0)) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("error", "verdict"),
    [("", "accepted"), ("bulk modulus +20 %", "accepted with reservation")],
)
def test_an_exact_model_is_accepted_and_a_wrong_one_is_not_plainly(error, verdict):
    outcome = judged(Trial(0, "steps", 1.0, error))
    assert (outcome.verdict, outcome.named) == (verdict, bool(error)), outcome


def test_tables_count_shares():
    wrong = [
        Outcome(Trial(0, "steps", 1.0, "no friction"), verdict, named=named, shows=shows)
        for verdict, named, shows in (
            ("accepted", False, False),
            ("rejected", True, True),
            ("accepted with reservation", True, True),
        )
    ]
    row = "| 3 | 66.7 % | 33.3 % | 66.7 % | 100.0 % of 2 |"
    assert wrong_table(wrong).splitlines()[-1] == f"| all {row}"
    assert f"| no friction {row}" in wrong_table(wrong)
    assert len(wrong_table(wrong).splitlines()) == 3 + len(ERRORS)
    exact = [Outcome(Trial(0, "sine", 1.0), "accepted", blamed=("friction",))]
    assert exact_table(exact).splitlines()[-1] == "| all | 1 | 0 | 0 | 1 |"
