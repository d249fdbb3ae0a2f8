"""Which samples a study has, what its keys mean, and what its samples say together."""

import math
from pathlib import Path

import numpy as np
import pytest

from ehbench.config.recipe import StudyRecipe
from ehbench.sampling import statistics
from ehbench.sampling.design import Design, Factor, Fitted
from ehbench.sampling.journal import Journal
from ehbench.sampling.keys import Key, changed_rig, changed_table
from ehbench.sampling.outputs import _parquet
from ehbench.sampling.sample import Sample
from ehbench.vocabulary.errors import InputError
from tests.shared import refused, shipped


def study(**given) -> StudyRecipe:
    return StudyRecipe(stage="study", recipe="trial.toml", measures=["duration"], **given)


# --- samples


def test_combinations_share_their_points():
    law = {"rig.bulk_modulus": {"low": "1 GPa", "high": "2 GPa"}}
    sweep = {"recipe.payload": ["none", "50 lb"], "bench.delay": ["1 ms", "3 ms", "5 ms"]}
    design = Design(study(draw=law, sweep=sweep, seeds=["recipe.seed"], samples=4, seed=7))
    rows = [design.settings(i) for i in range(design.size)]
    assert design.size == 24
    assert [row["bench.delay"] for row in rows[:12:4]] == ["1 ms", "3 ms", "5 ms"]
    drawn = [(row["rig.bulk_modulus"], row["recipe.seed"]) for row in rows]
    assert drawn == drawn[:4] * 6 and [seed for _, seed in drawn[:4]] == [7, 8, 9, 10]
    assert design.cells(design.inputs(5))[:2] == ["none", 3.0]


@pytest.mark.parametrize("way", ["random", "sobol", "latin_hypercube"])
def test_a_sample_hangs_on_its_number_alone(way):
    given = study(draw={"rig.a": {"mean": 1.0, "std": 0.1}}, samples=16, design=way, seed=3)
    first, other = Design(given), Design(given)
    backwards = {i: other.inputs(i) for i in reversed(range(16))}
    assert [first.inputs(i) for i in range(16)] == [backwards[i] for i in range(16)]


def test_draws_reproduce_the_covariance_they_came_from():
    std, shares = np.array([2e7, 0.3, 5e-3]), np.array([[1, 0.9, -0.4], [0.9, 1, 0], [-0.4, 0, 1]])
    mean = (9e8, 4.0, 0.1)
    free = ((-math.inf, math.inf),) * 3
    fitted = Fitted(("a", "b", "c"), mean, tuple(std), free, ("Pa", "", ""), shares)
    for way in ("random", "sobol"):
        count = 4096
        design = Design(study(samples=count, design=way, seed=1), fitted)
        x = np.array([design.inputs(i) for i in range(count)])
        assert np.abs(np.corrcoef(x.T) - shares).max() < 4.0 / math.sqrt(count)
        assert x.std(axis=0) == pytest.approx(std, rel=4.0 / math.sqrt(2 * count))
        assert np.all(np.abs(x.mean(axis=0) - mean) < 4.0 * std / math.sqrt(count))


def test_draws_follow_their_laws_and_a_stated_correlation():
    laws = {
        "rig.u": {"low": "1 MPa", "high": "3 MPa"},
        "rig.g": {"low": 0.01, "high": 1.0, "law": "log_uniform"},
        "rig.n": {"mean": "5 mm", "std": "10 %"},
        "rig.l": {"median": 2, "spread": 1.5},
    }
    share = [["rig.u", "rig.n", 0.7]]
    design = Design(study(draw=laws, samples=2048, design="sobol", correlation=share))
    x = np.array([design.inputs(i) for i in range(2048)])
    assert np.median(x, axis=0) == pytest.approx([2.0, 0.1, 5.0, 2.0], rel=0.02)
    assert x[:, 0].min() >= 1.0 and x[:, 0].max() <= 3.0
    assert x[:, 2].std() == pytest.approx(0.5, rel=0.05)
    assert np.log(x[:, 3]).std() == pytest.approx(math.log(1.5), rel=0.05)
    assert np.corrcoef(x[:, 0], x[:, 2])[0, 1] == pytest.approx(0.7, abs=0.04)
    assert design.settings(0)["rig.u"].endswith(" MPa")


FLAT = {"low": 1, "high": 2}
TIED = {"draw": {"rig.a": FLAT, "rig.b": FLAT}, "correlation": [["rig.a", "rig.b", 0.5]]}
IMPOSSIBLE = [
    ({"draw": {"rig.a": {"low": "1 mm", "high": "2 m"}}}, "units_differ"),
    ({"draw": {"rig.a": {"low": 2, "high": 1}}}, "bad_law"),
    ({"samples": 5}, "nothing_drawn"),
    ({"draw": {"rig.a": FLAT}, "correlation": [["rig.a", "rig.b", 1.0]]}, "not_drawn"),
    (TIED | {"design": "saltelli"}, "saltelli_correlated"),
]


@pytest.mark.parametrize(("given", "key"), IMPOSSIBLE)
def test_a_design_that_cannot_be_is_refused(given, key):
    with refused(f"sampling.{key}"):
        Design(study(**given))


# --- keys


@pytest.fixture(scope="module")
def rig():
    return shipped("thesis_arm")


def test_a_rig_takes_parameters_factors_and_places_of_its_file(rig):
    changes = {"bulk_modulus": "0.7 GPa", "boom.*.compensated_gain": Factor(1.1)}
    changed = changed_rig(rig, changes | {"payload.50 lb.stick.mass": "30 kg"})
    old, new = rig.parameters(), changed.parameters()
    assert float(new["bulk_modulus"]) == 0.7e9
    gains = [n for n in old if n.startswith("boom.") and n.endswith(".compensated_gain")]
    assert gains
    for name in gains:
        assert float(new[name]) == pytest.approx(1.1 * float(old[name]), rel=1e-12)
    assert float(changed.payload["50 lb"]["stick"].mass) == 30.0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"bulk_modulos": "1 GPa"}, "nearest is 'rig.bulk_modulus'"),
        ({"bulk_modulus": "1 mm"}, "cannot be turned into Pa"),
        ({"cylinder.bom.stroke": "1 m"}, "nearest is 'rig.cylinder.boom.stroke'"),
    ],
)
def test_an_unknown_number_of_a_rig_is_named_with_the_nearest(rig, change, said):
    with pytest.raises(InputError, match=said):
        changed_rig(rig, change)


def test_a_recipe_takes_keys_through_lists_and_tables():
    table = {
        "motion": [{"name": "slow", "speed": "60 mm/s"}, {"speed": "1 mm/s"}],
        "controller": {"kind": "arc", "gains": "tuning.toml"},
        "payload": "50 lb",
    }
    changes = {"motion.slow.speed": Factor(2.0), "motion.1.speed": "3 mm/s", "payload": "none"}
    changes |= {"controller.gains.washout": "0 rad/s", "limits.speed_max": "1 m/s"}
    assert changed_table(table, changes, "recipe") == {
        "motion": [{"name": "slow", "speed": "120.0 mm/s"}, {"speed": "3 mm/s"}],
        "controller": {"kind": "arc", "gains": {"from": "tuning.toml", "washout": "0 rad/s"}},
        "limits": {"speed_max": "1 m/s"},
    }
    with pytest.raises(InputError, match="recipe.motion.fast.speed.*nearest"):
        changed_table(table, {"motion.fast.speed": "1 m/s"}, "recipe")


def test_a_key_may_be_of_a_recipe_behind():
    assert Key.of("steps.bench.delay", ["steps"]) == ("steps", "bench", "delay")
    with pytest.raises(InputError, match="did you mean 'recipe.seed'"):
        Key.of("recipes.seed")


# --- what they say together


def test_intervals_of_quantiles_and_shares_hold_as_often_as_they_say():
    rng = np.random.default_rng(0)
    for share in (0.5, 0.9):
        held = 0
        for _ in range(400):
            found = statistics.quantile(rng.random(60), share)
            low = -math.inf if found.low is None else found.low
            held += low <= share <= (math.inf if found.high is None else found.high)
        assert 375 <= held <= 398  # conservative, as order statistics are discrete
    none, some = statistics.share(0, 20), statistics.share(19, 20)
    assert (none.low, none.high) == (0.0, pytest.approx(1.0 - 0.025 ** (1 / 20)))
    assert some.low == pytest.approx(0.7513, abs=1e-4)  # tables of Clopper and Pearson
    assert some.high == pytest.approx(0.99873, abs=1e-5)


def test_sobol_indices_are_those_of_ishigami():
    keys, count = ("rig.a", "rig.b", "rig.c"), 1024
    spans = {key: {"low": -math.pi, "high": math.pi} for key in keys}
    design = Design(study(sweep=spans, design="saltelli", samples=count))
    x = np.array([design.inputs(i) for i in range(design.size)])
    y = np.sin(x[:, 0]) + 7.0 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])
    found = statistics.sobol(keys, y, count, 0)
    assert [one.first for one in found] == pytest.approx([0.3139, 0.4424, 0.0], abs=0.03)
    assert [one.total for one in found] == pytest.approx([0.5576, 0.4424, 0.2437], abs=0.03)


def test_rank_regression_sees_kinds_and_through_a_bend():
    """Two kinds of rig, of which the second gives more; what is drawn adds a little."""
    rng = np.random.default_rng(5)
    kind, x = np.repeat([1.0, 0.0], 100), rng.normal(size=200)
    y = np.exp(3.0 * (kind == 0.0) + 0.2 * x)
    columns = np.stack([statistics.scores(kind, y), x], axis=1)
    (first, second), explained = statistics.rank_regression(("kind", "x"), columns, y)
    assert first.rank > 0.7 and 0.2 < second.rank < first.rank and explained > 0.95  # pyright: ignore[reportOperatorIssue]
    alone, share = statistics.rank_regression(("x",), x[:, None], y)
    assert share < 0.5 < explained and alone[0].rank > 0.0
    x = np.random.default_rng(0).random((400, 3))
    rows, explained = statistics.rank_regression(("a", "b", "c"), x, np.exp(5 * x[:, 0]) - x[:, 1])
    assert rows[0].rank == pytest.approx(1.0, abs=0.1) and abs(rows[2].rank) < 0.1
    assert explained > 0.9


# --- on disk


def test_parquet_is_read_by_others(tmp_path):
    import pandas

    names = [("a [mm]", "float"), ("n", "int"), ("t", "text")]
    names += [(f"c{i}", "float") for i in range(15)]
    with _parquet(tmp_path / "x.parquet", names) as add:
        add([[1.5, math.nan], [1, -(2**60)], ["", "ü,\n"], *([[1.0, 2.0]] * 15)])
        add([[3.0], [2], ["z"], *([[3.0]] * 15)])
    table = pandas.read_parquet(tmp_path / "x.parquet")
    assert list(table) == [name for name, _ in names]
    assert table["n"].tolist() == [1, -(2**60), 2] and table["t"].tolist() == ["", "ü,\n", "z"]
    assert np.array_equal(table["a [mm]"], [1.5, math.nan, 3.0], equal_nan=True)


def test_a_torn_journal_goes_on_where_it_was_whole(tmp_path):
    path = tmp_path / "s.jsonl"
    made = [Sample(i, 0, "done", "ä" * i, (0.1 * i, math.nan)) for i in range(5)]
    first = Journal(path, "k", 5, resume=False)
    first.add([made[3], made[0], made[4]])
    first.close()
    path.write_bytes(path.read_bytes()[:-4])
    again = Journal(path, "k", 5, resume=True)
    assert again.taken == 2 and again.done.tolist() == [True, False, False, True, False]
    again.add(made)
    assert repr(list(again.samples())) == repr(made)
    again.close()
    with refused("sampling.left_samples") as caught:
        Journal(path, "k", 5, resume=False)
    assert caught.value.fields["count"] == 5
    other = Journal(path, "of another study", 5, resume=True)
    other.close()
    assert other.taken == 0


def test_a_full_disk_says_how_many_samples_are_kept(tmp_path):
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("the system has no /dev/full")
    journal = Journal(tmp_path / "s.jsonl", "k", 3, resume=False)
    journal.add([Sample(0, 0, "done", "", (1.0,))])
    journal.close()
    journal._file = full.open("wb", buffering=0)
    with refused("sampling.disk_full") as caught:
        journal.add([Sample(1, 0, "done", "", (1.0,))])
    assert caught.value.fields["count"] == 1
    journal.close()
    again = Journal(tmp_path / "s.jsonl", "k", 3, resume=True)
    again.close()
    assert again.taken == 1
