"""Which samples a study has, what its keys mean, and what its samples say together."""

import csv
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas
import pytest

from ehbench.config.recipe import Measure, StudyRecipe
from ehbench.sampling import statistics
from ehbench.sampling.design import Design, Drawn, Factor, Fitted
from ehbench.sampling.journal import Journal
from ehbench.sampling.keys import changed_rig, changed_table, key_of
from ehbench.sampling.outputs import MeasureColumn, Rows, hash_of, write_tables
from ehbench.sampling.sample import Sample
from ehbench.sampling.summary import Summary
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
    units = zip("abc", mean, std, ("Pa", "", ""), strict=True)
    fitted = Fitted([Drawn(f"rig.{key}", "normal", *about) for key, *about in units], shares)
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
    assert key_of("steps.bench.delay", ["steps"]) == ("steps", "bench", "delay")
    with pytest.raises(InputError, match="did you mean 'recipe.seed'"):
        key_of("recipes.seed")


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


def test_intervals_hold_where_combinations_share_what_is_drawn():
    """Four combinations on the same 30 draws say hardly more than one."""
    rng, held = np.random.default_rng(1), np.zeros(2)
    for _ in range(400):
        values = (rng.random(30) + [[0.0], [0.01], [0.02], [0.03]]).ravel()
        found = statistics.quantile(values, 0.5, alike=4.0)
        met = statistics.share(int((values < 0.8).sum()), 120, alike=4.0)
        assert found.low is not None and found.high is not None
        held += [found.low <= 0.515 <= found.high, met.low <= 0.785 <= met.high]
    assert np.all((375 <= held) & (held <= 398))


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
    assert first.rank > 0.7 and 0.2 < second.rank < first.rank and explained > 0.95
    alone, share = statistics.rank_regression(("x",), x[:, None], y)
    assert share < 0.5 < explained and alone[0].rank > 0.0
    x = np.random.default_rng(0).random((400, 3))
    rows, explained = statistics.rank_regression(("a", "b", "c"), x, np.exp(5 * x[:, 0]) - x[:, 1])
    assert rows[0].rank == pytest.approx(1.0, abs=0.1) and abs(rows[2].rank) < 0.1
    assert explained > 0.9


SPEED = [1.0, 2.0, 3.0, math.nan, 5.0, 6.0, 7.0, 100.0, 8.0]
CODES = [0, 0, 0, 3, 4, 0, 2, 5, 1]  # the fourth is incomplete: it has no speed, and counts


def summary(targets=(), speed=SPEED, **given) -> Summary:
    """Three payloads of three samples each, with a speed and a time since the stop."""
    draw = {"rig.a": {"low": 1, "high": 2}}
    sweep = {"recipe.payload": ["none", "50 lb", "70 lb"]}
    recipe = study(draw=draw, sweep=sweep, samples=len(speed) // 3, **given)
    columns = (MeasureColumn("speed", "mm/s", None, False), MeasureColumn("stop", "s", None, True))
    names = ("done", "failed", "refused", "incomplete", "rejected", "stopped")
    codes = np.array([*CODES, *[0] * len(speed)][: len(speed)])
    rising = np.arange(1.0, len(speed) + 1.0)
    inputs = np.stack([np.repeat([0.0, 1.0, 2.0], len(speed) // 3), rising], axis=1)
    table = np.stack([speed, 0.1 * rising], axis=1)
    rows = Rows(inputs, table, codes, tuple(names[code] for code in codes))
    return Summary(recipe, Design(recipe), columns, targets, rows)


@pytest.mark.parametrize(
    ("targets", "given", "worst"),
    [
        ([{"measure": "speed", "at_most": 5.0}], {}, [5, 4, 7, 6, 8]),
        ([{"measure": "speed", "at_most": 5.0, "at_least": 2.0}], {}, [5, 4, 7, 6, 8]),
        ([{"measure": "speed", "at_least": 2.0}], {}, [0, 1, 7, 6, 8]),
        ([{"measure": "speed", "at_least": 2.0}], {"worst": "stop"}, [8, 7, 6]),
        ([], {}, [5, 4, 7, 6, 8]),
        ([], {"keep": 0}, []),
    ],
)
def test_the_worst_samples_are_those_by_the_measure_that_decides(targets, given, worst):
    """Then the first that a limit stopped, that was refused, that failed."""
    assert summary(targets, **{"keep": 2} | given).worst() == worst


def test_a_worst_measure_that_is_not_there_is_refused():
    with refused("sampling.no_measure"):
        summary(worst="sped").worst()


def test_a_summary_counts_what_came_to_its_end():
    targets = [{"measure": "speed", "at_most": 5.0, "at_least": 2.0}]
    result = summary([*targets, {"measure": "stop", "at_most": 0.25}]).as_json()
    speed, stop = result["measures"]
    assert (speed["samples"], stop["samples"]) == (5, 9)  # a stopped trial has a time of its stop
    assert [speed[k] for k in ("mean", "minimum", "maximum")] == [3.4, 1.0, 6.0]
    assert speed["std"] == pytest.approx(math.sqrt(17.2 / 4.0))
    assert [q["value"] for q in speed["quantiles"][:2]] == pytest.approx([1.2, 3.0])
    assert [(t["count"], t["of"]) for t in result["targets"]] == [(3, 9), (2, 9)]
    first = result["targets"][0]  # of three points: Clopper and Pearson's table for 1 of 3
    assert (first["low"], first["high"]) == pytest.approx((0.0084, 0.9057), abs=1e-4)
    groups = [(g["values"]["recipe.payload"], g["samples"], g["whole"]) for g in result["groups"]]
    assert groups == [("none", 3, 3), ("50 lb", 3, 3), ("70 lb", 3, 0)]
    assert [g["targets"][0]["count"] for g in result["groups"]] == [2, 1, 0]
    assert result["groups"][1]["measures"][0] == {
        **{"samples": 2, "mean": 5.5, "median": 5.5, "maximum": 6.0},
        "q95": pytest.approx(5.95),
    }
    assert result["groups"][2]["measures"][0]["mean"] is None
    assert [(i["key"], i["values"]) for i in result["inputs"]][0][1] == ["none", "50 lb", "70 lb"]


def test_equal_numbers_have_no_spread():
    """Nine times the same: the sum of such is rounded."""
    known = summary()
    rows = replace(known.rows, measures=np.full_like(known.rows.measures, 0.95))
    speed = replace(known, rows=rows).as_json()["measures"][1]
    assert (speed["samples"], speed["mean"], speed["std"]) == (9, 0.95, 0.0)
    assert np.full(9, 0.95).std() > 0.0


@pytest.mark.parametrize(("count", "rows"), [(9, []), (10, ["speed"])])
def test_inputs_matter_by_ten_samples_or_more(count, rows):
    """Four payloads' worth of samples, of which ``count`` have a speed: it rises with a alone."""
    speed = np.where(np.isin(np.arange(24), np.arange(9, 9 + count)), np.arange(24.0) ** 3, np.nan)
    result = summary(speed=speed).as_json()["sensitivity"]
    assert [row["measure"] for row in result if row["measure"] == "speed"] == rows
    for row in result[: len(rows)]:
        ranks = {item["key"]: item["rank"] for item in row["inputs"]}
        assert row["method"] == "rank" and row["explained"] == pytest.approx(1.0)
        assert ranks["rig.a"] == pytest.approx(1.0) and abs(ranks["recipe.payload"]) < 1e-9


# --- on disk


@pytest.mark.parametrize(
    ("measure", "unit", "of_stops", "shown"),
    [
        ({"channel": "boom.v", "unit": "mm/s"}, "mm/s", False, 1500.0),
        ({"channel": "boom.v", "since": "stop"}, "mm/s", True, 1500.0),
        ({"channel": "boom.v", "stopped": True}, "mm/s", True, 1500.0),
        ({"result": "stop.boom.x"}, "mm", True, 1500.0),
        ({"result": "tracking.gain_margin"}, "", False, 1.5),
        ({"result": "what.nobody.knows"}, "", False, 1.5),
    ],
)
def test_a_column_of_measures_has_its_unit(rig, measure, unit, of_stops, shown):
    column = MeasureColumn.of(Measure(**measure), rig)
    assert (column.unit, column.of_stops) == (unit, of_stops)
    assert column.shown(1.5) == pytest.approx(shown)
    assert column.head.endswith(f" [{unit}]" if unit else column.name)


def test_the_table_of_a_study_is_in_the_columns_units(tmp_path):
    sweep = {"recipe.payload": ["none", "50 lb"], "rig.a": ["1 mm", "2 mm", "3 mm"]}
    design = Design(study(sweep=sweep, samples=1))
    measures = [MeasureColumn.of(Measure(channel="boom.v", unit="mm/s"), None)]
    journal = Journal(tmp_path / "s.jsonl", "k", 6, resume=False)
    late = Sample(4, 5, "stopped", 'a "limit", met', (math.nan,))
    journal.add([late, *(Sample(i, 0, "done", "", (0.1 * i,)) for i in (5, 3, 2, 1, 0))])
    rows = write_tables(tmp_path, design, measures, journal, "k")
    journal.close()
    assert rows.inputs[:, 0].tolist() == [0, 0, 0, 1, 1, 1]
    assert rows.inputs[:, 1].tolist() == [1.0, 2.0, 3.0] * 2
    assert rows.codes.tolist() == [0, 0, 0, 0, 5, 0] and rows.status[4] == "stopped"
    speeds = [0.0, 100.0, 200.0, 300.0, math.nan, 500.0]
    assert rows.measures[:, 0] == pytest.approx(speeds, nan_ok=True)
    with (tmp_path / "samples.csv").open(newline="", encoding="utf-8") as file:
        head, *lines = csv.reader(file)
    assert head[:4] == ["sample", "hash", "code", "status"] and "[mm/s]" in head[6]
    assert lines[4][2:] == ["5", "stopped", "50 lb", "2.0", "", 'a "limit", met']
    assert [line[1] for line in lines] == [hash_of("k", design.settings(i)) for i in range(6)]
    assert len({line[1] for line in lines}) == 6 and float(lines[5][6]) == pytest.approx(500.0)
    table = pandas.read_parquet(tmp_path / "samples.parquet")
    cells = [
        ["" if cell != cell else str(cell) for cell in row] for row in table.to_numpy().tolist()
    ]
    assert [list(table), *cells] == [head, *lines]


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
    # pyrefly: ignore[bad-assignment]
    journal._file = full.open("wb", buffering=0)
    with refused("sampling.disk_full") as caught:
        journal.add([Sample(1, 0, "done", "", (1.0,))])
    assert caught.value.fields["count"] == 1
    journal.close()
    again = Journal(tmp_path / "s.jsonl", "k", 3, resume=True)
    again.close()
    assert again.taken == 1
