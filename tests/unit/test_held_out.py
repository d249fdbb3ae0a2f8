"""What is held out goes by samples: windows, copies, formats, shifted time; scored windows."""

from pathlib import Path

import numpy as np
import pytest

from ehbench.config.recipe import load_recipe
from ehbench.data import read
from ehbench.data.record import Record
from ehbench.plant.model import Model
from ehbench.validation import PreparedValidation, prepare_log, run_validation
from ehbench.validation.held_out import FittedSamples, _aligned, _sample_means, overlaps
from ehbench.vocabulary.errors import InputError
from ehbench.workflow import Session, run
from tests.shared import RIGS, ROOT, refused, shipped
from tools.virtual_logs import virtual_log

LOG = ROOT / "datasets" / "slide_servo" / "steps" / "press_no_load.mcap"
FILES = {"rig": RIGS / "slide_servo.toml"}


@pytest.fixture(scope="module")
def rig():
    return shipped("slide_servo")


@pytest.fixture(scope="module")
def log(rig) -> Record:
    return virtual_log("slide_servo", rig, "steps", 3)


def part(record: Record, start: float, stop: float) -> Record:
    keep = (record.t >= start) & (record.t <= stop)
    return Record(record.t[keep], {n: v[keep] for n, v in record.channels.items()}, record.meta)


def read_at(record: Record, t: np.ndarray) -> dict[str, np.ndarray]:
    return {name: np.interp(t, record.t, y) for name, y in record.channels.items()}


def rows_of(record: Record, digits: int = 9) -> FittedSamples:
    """As a run of an identification saves what it was fitted to."""
    names = ("press.x", "press.v", "press.p_head", "press.p_rod")
    saved = {n: np.array([float(f"{y:.{digits}g}") for y in record[n]]) for n in names}
    return FittedSamples("steps", np.array([float(f"{t:.9g}") for t in record.t]), saved, "abc")


def test_a_log_is_itself_and_another_window_of_it_is_not(log):
    fitted = [rows_of(part(log, 0.0, 2.0))]
    (found,) = overlaps(log, fitted)
    assert (found.start, found.stop) == pytest.approx((0.0, 2.0)) and found.log == "steps"
    assert not overlaps(part(log, 2.0, 4.0), fitted), "they share one sample, the boundary"
    assert not overlaps(part(log, 2.0, 4.0), fitted, "abc"), "the same file, another window"
    (found,) = overlaps(part(log, 1.5, 4.0), fitted, "abc")
    assert (found.start, found.stop) == pytest.approx((1.5, 2.0))


def test_a_copy_with_more_samples_or_a_shifted_time_is_no_other_log(log, rig):
    fitted = [rows_of(part(log, 0.5, 2.0))]
    assert overlaps(log, fitted)[0].samples == pytest.approx(1501, abs=2)
    late = Record(log.t + 17.25, log.channels, log.meta)
    (found,) = overlaps(late, fitted)
    assert (found.start, found.stop) == pytest.approx((17.75, 19.25))
    few = Record(log.t[::2], {n: v[::2] for n, v in log.channels.items()}, log.meta)
    (found,) = overlaps(few, fitted)
    assert (found.start, found.stop) == pytest.approx((0.5, 2.0))
    t = np.arange(2 * log.t.size - 1) * 5e-4
    (found,) = overlaps(Record(t, read_at(log, t), log.meta), fitted)
    assert (found.start, found.stop) == pytest.approx((0.5, 2.0))
    bare = Record(log.t, {"press.x": log["press.x"], "press.p_rod": log["press.p_rod"]})
    assert len(overlaps(bare, fitted)) == 1, "a copy may lack channels"


@pytest.mark.parametrize(
    ("rate", "digits", "late"), [(1000, 4, 0.0), (1700, 12, 0.0), (1700, 5, 5.0031), (730, 5, 0.0)]
)
def test_a_rounded_or_resampled_copy_is_no_other_log(log, rate, digits, late):
    """None of its rows is one of the log's."""
    fitted = [rows_of(part(log, 0.5, 2.0))]
    t = np.arange(0.0, log.t[-1], 1.0 / rate)
    made = read_at(log, t).items()
    copy = {n: np.array([float(f"{v:.{digits}g}") for v in y]) for n, y in made}
    (found,) = overlaps(Record(t + late, copy, log.meta), fitted)
    assert (found.start, found.stop) == pytest.approx((0.5 + late, 2.0 + late), abs=0.1)
    assert not overlaps(part(Record(t, copy, log.meta), 2.0, 4.0), fitted), "another window"


def test_a_standstill_with_the_noise_of_another_is_no_copy(log):
    """Two simulations of one seed share it; a copy that begins with its standstill is one still."""
    begins = float(log.t[np.flatnonzero(log["press.servo.command"] != 0.0)[0]])
    other = {name: y.copy() for name, y in log.channels.items()}
    rng = np.random.default_rng(3)
    for name, y in other.items():
        y[log.t >= begins] *= 1.3 if name.endswith("command") else rng.uniform(1.2, 1.4)
    fitted = [rows_of(log)]
    assert begins > 0.2 and overlaps(log, fitted)
    assert not overlaps(Record(log.t, other, log.meta), fitted)
    assert overlaps(part(log, 0.0, begins + 0.1), fitted)


def test_a_log_is_seen_in_the_means_of_its_samples(log):
    """A fit of a fast log saves the means that it compared."""
    whole = log.t.size // 10 * 10
    tens = {n: y[:whole].reshape(-1, 10).mean(axis=1) for n, y in log.channels.items()}
    means = rows_of(Record(log.t[:whole].reshape(-1, 10).mean(axis=1), tens, log.meta))
    (found,) = overlaps(log, [means])
    assert found.stop - found.start > 3.5


def test_means_and_shifts_of_samples_in_closed_form():
    """The mean of t² over a sample of the slower series is t² + (h² + 2k²)/12 by trapezia of k."""
    t, at = np.arange(0.0, 1.0, 1e-3), np.arange(0.1, 0.9, 1e-2)
    found = _sample_means(at, t, np.column_stack([t, t**2]))
    assert found[:, 0] == pytest.approx(at, abs=1e-9)
    assert found[:, 1] == pytest.approx(at**2 + (1e-4 + 2e-6) / 12.0, abs=1e-9)
    y = np.column_stack([np.sin(20.0 * t) + np.sin(47.0 * t), 0.1 * t])
    for late in (0.0, 0.2034, -0.1507):
        mine = np.column_stack([np.interp(t - late, t, column) for column in y.T])
        assert _aligned(t, mine, t, y) == pytest.approx(late, abs=2e-4)


@pytest.mark.parametrize("kind", ["steps", "sine"])
@pytest.mark.parametrize("rate", [1000, 1700, 500])
def test_no_noise_is_taken_for_another(rig, kind, rate):
    """Two recordings of one test, which differ by their sensors' noise alone."""
    one, other = (virtual_log("slide_servo", rig, kind, seed) for seed in (1, 2))
    t = np.arange(0.0, other.t[-1], 1.0 / rate)
    assert not overlaps(Record(t, read_at(other, t), other.meta), [rows_of(one)])


def test_another_recording_of_the_same_test_is_held_out(log, rig):
    again = virtual_log("slide_servo", rig, "steps", 4)
    assert not overlaps(again, [rows_of(log)])
    still = {n: np.full(log.t.shape, v[0]) for n, v in log.channels.items()}
    assert not overlaps(Record(log.t, still), [rows_of(Record(log.t, still))]), "rest says nothing"


def test_only_the_scored_part_is_judged(log, rig):
    """A disturbance that the model cannot know, before what is scored, costs nothing but drift."""
    model = Model.of(rig)
    bad = log["press.p_head"] + np.where(log.t < 0.25, 4e6 * np.sin(300.0 * log.t), 0.0)
    odd = Record(log.t, log.channels | {"press.p_head": bad}, log.meta)
    channels = ("x", "v", "p_head", "p_rod")

    def judged(scored):
        log_ = prepare_log("odd", odd, model, scored=scored)
        prepared = PreparedValidation(rig, channels, (log_,))
        return run_validation(prepared, diagnose=False).logs[0]

    whole, late = judged(None), judged((2.0, float("inf")))
    assert late.scored == pytest.approx((2.0, 4.0)) and whole.scored is None
    assert late.duration == pytest.approx(2.0)
    assert late.series["t"].size == log.t.size, "the figure shows the whole run"
    assert min(w.start for w in late.transients) >= 2.0
    error = late.series["simulated.press.p_head"] - late.series["press.p_head"]
    channel = next(c for c in late.channels if c.channel == "press.p_head")
    assert channel.rms_error == pytest.approx(np.sqrt(np.mean(error[log.t >= 2.0] ** 2)))
    with refused("validation.nothing_scored", InputError) as error:
        prepare_log("odd", odd, model, scored=(9.0, 10.0))
    fields = error.value.message.fields
    assert (fields["log"], fields["start"], fields["stop"]) == ("odd", log.t[0], log.t[-1])


def recipe(folder: Path, name: str, *lines: str) -> Path:
    path = folder / f"{name}.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.slow
def test_windows_of_one_file_fit_and_judge(undrawn, undiagnosed, tmp_path):
    """Fitted to the first second, judged on the second: held out; an overlap is named."""
    recipe(
        tmp_path,
        "fit",
        'stage = "identify"\nwhat = "hydraulics"',
        f'rig = "{FILES["rig"]}"',
        f'data = [{{ path = "{LOG}", stop = "1 s" }}]',
        'parameters = ["carriage.damping"]',
    )
    record = read(LOG)
    table = np.column_stack([record.t, *record.channels.values()])
    units = {"x": "m", "q": "rad", "v": "m/s", "qd": "rad/s", "command": "V"}
    heads = [f"{n} [{units.get(n.rsplit('.', 1)[-1], 'Pa')}]" for n in record.channels]
    np.savetxt(
        tmp_path / "copy.csv", table, "%.12g", ",", header=",".join(["t [s]", *heads]), comments=""
    )
    judge = recipe(
        tmp_path,
        "judge",
        'stage = "validate"\nrig = "fit.toml"\nchannels = ["x", "v", "p_head", "p_rod"]',
        f'data = [{{ path = "{LOG}", score_start = "1 s" }}, {{ path = "{LOG}", start = "0.5 s" }},'
        ' { path = "copy.csv" }]',
    )
    assert load_recipe(judge).data[0].scored == (1.0, float("inf"))
    done = run(judge, Session(root=tmp_path / "reports"))
    found = done.json("validation")
    assert [log["status"] for log in found["logs"]] == ["held_out", "fitted", "fitted"]
    spans = [(one["start"], one["stop"]) for log in found["logs"] for one in log["overlap"]]
    assert spans == [pytest.approx((0.5, 1.0)), pytest.approx((0.0, 1.0), abs=0.01)]
    assert any("TO ITS" in text.upper() and "0.5 … 1 s" in text for text in found["warnings"])
    reasons = "\n".join(found["reasons"])
    assert "copy" not in reasons
