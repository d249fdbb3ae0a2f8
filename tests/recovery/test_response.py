"""Frequency response: a known system within intervals that hold; poor data refused."""

import json
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import tomli_w
from scipy import signal

from ehbench import workflow
from ehbench.app import inspection
from ehbench.config import recipe
from ehbench.config.recipe import Sensor, load_rig
from ehbench.data.logs import write_log
from ehbench.data.record import Record
from ehbench.frequency_response.response import Averaging, Signals, estimate, prepare_signals
from ehbench.frequency_response.transfer import notes_of, transfers
from ehbench.guidance.suggestions import suggest
from ehbench.identification.hydraulics import FitOptions, identify_hydraulics, prepare_fit
from ehbench.plant.model import simulate
from ehbench.runs.rundir import read_json
from ehbench.vocabulary.errors import InputError, InsufficientData, LogError
from tests.shared import RIGS, refused

RATE = 1000.0
NATURAL, DAMPING, GAIN = 2.0 * math.pi * 12.0, 0.5, 0.03  # of the system [rad/s, 1, m/s per V]
LATE = 7  # samples of delay
NAMES = ("boom.hect.command", "boom.v")
SYSTEM = signal.cont2discrete(
    ([GAIN * NATURAL**2], [1.0, 2.0 * DAMPING * NATURAL, NATURAL**2]), 1.0 / RATE, "zoh"
)


def truth(frequency: np.ndarray) -> np.ndarray:
    """The sampled system's own response, with its delay."""
    numerator, denominator, _ = SYSTEM
    _, found = signal.freqz(np.squeeze(numerator), denominator, frequency, fs=RATE)
    return found * np.exp(-2j * math.pi * frequency * LATE / RATE)


def held(random: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """Random levels, each for 0.2 … 1 s."""
    ends = np.cumsum(random.uniform(0.2, 1.0, 5 * round(t[-1] + 1.0)))
    return random.uniform(-2.0, 2.0, ends.size)[np.searchsorted(ends, t)]


def tones(random: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """Every 0.5 Hz up to 45 Hz, with a period of 2 s."""
    f, once = 0.5 * np.arange(1, 91)[:, None], t[: round(2.0 * RATE)]
    waves = np.sin(2 * math.pi * f * once + random.uniform(0.0, 6.3, f.shape))
    return np.resize(0.2 * np.sum(waves, axis=0), t.size)


INPUTS = {
    "noise": lambda random, t: random.standard_normal(t.size),
    "chirp": lambda random, t: signal.chirp(t, 0.3, t[-1], 45.0, phi=random.uniform(0.0, 360.0)),
    "steps": held,
    "multisine": tones,
}


def log(
    seed: int, seconds: float = 30.0, noise: float = 0.004, kind: str = "noise"
) -> tuple[str, Record]:
    """Commands held from sample to sample about a working point, the speed with noise."""
    random = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE)) / RATE
    x = INPUTS[kind](random, t)
    y = signal.lfilter(np.squeeze(SYSTEM[0]), SYSTEM[1], np.r_[np.zeros(LATE), x[:-LATE]])
    y += 0.1 + noise * random.standard_normal(x.size)
    return f"log_{seed}", Record(t, dict(zip(NAMES, (2.0 + x, y), strict=True)))


def signals(*logs: tuple[str, Record], **choice) -> Signals:
    return prepare_signals(logs, NAMES, Averaging(**{"segment": 1.0, "coherence": 0.3} | choice))


def test_without_noise_it_is_the_system_itself():
    found = estimate(signals(log(1, noise=0.0), frequency=40.0, segment=4.0))
    exact = truth(found.frequency)
    assert found.coherent.all() and found.frequency[-1] == 40.0
    np.testing.assert_allclose(found.gain, np.abs(exact), rtol=0.02)
    np.testing.assert_allclose(found.phase, np.unwrap(np.angle(exact)), atol=0.02)
    # −3 dB of its first gain and −90° of system and delay, by the closed form on a fine grid
    fine = np.linspace(0.25, 40.0, 100_000)
    curve = truth(fine)
    fallen = fine[np.argmax(np.abs(curve) < GAIN / math.sqrt(2.0))]
    turned = fine[np.argmax(np.unwrap(np.angle(curve)) < -0.5 * math.pi)]
    assert found.bandwidth.value == pytest.approx(fallen, rel=0.02)
    assert found.quadrature.value == pytest.approx(turned, rel=0.01)


@pytest.mark.parametrize("noise", [2e-4, 4e-3])
@pytest.mark.parametrize("kind", list(INPUTS))
def test_gain_and_phase_lie_in_their_intervals_as_often_as_they_should(kind, noise):
    """Over 20 logs: 95 % of all gains and phases; −90° and −3 dB themselves at least as often."""
    hits = {"gain": [], "phase": [], "quadrature": [], "bandwidth": []}
    fine = np.linspace(0.5, 40.0, 100_000)
    curve = truth(fine)
    for seed in range(20):
        found = estimate(signals(log(seed, noise=noise, kind=kind), frequency=40.0, segment=2.0))
        exact, at = truth(found.frequency), found.coherent
        phase = np.unwrap(np.angle(exact))
        gain = np.abs(exact)
        hits["gain"] += list(((found.gain_low < gain) & (gain < found.gain_high))[at])
        hits["phase"] += list(((found.phase_low < phase) & (phase < found.phase_high))[at])
        fallen = np.abs(curve) < gain[at][0] / math.sqrt(2.0)
        turned = np.unwrap(np.angle(curve)) < -0.5 * math.pi
        for name, passed in (("bandwidth", fallen), ("quadrature", turned)):
            if (one := getattr(found, name)) is not None:
                hits[name].append((one.low or 0.0) < fine[np.argmax(passed)] < one.high)
    assert len(hits["gain"]) > 500 and len(hits["quadrature"]) > 10
    assert 0.93 < np.mean(hits["gain"]) < 0.97 and 0.93 < np.mean(hits["phase"]) < 0.97
    assert np.mean(hits["quadrature"]) >= 0.9 and np.mean(hits["bandwidth"] or 1.0) >= 0.9


@pytest.mark.parametrize(("segment", "told"), [(1.0, True), (4.0, False)])
def test_a_resonance_sharper_than_the_frequencies_is_told_and_widens_the_intervals(segment, told):
    """A pair of 5 Hz and damping ratio 0.1, 1 Hz wide, in frequencies 1 Hz apart and closer."""
    omega = 2.0 * math.pi * 5.0
    pair = [omega**2], [1.0, 2.0 * 0.1 * omega, omega**2]
    num, den, _ = signal.cont2discrete(pair, 1.0 / RATE)
    holds = []
    for seed in range(10):
        random = np.random.default_rng(seed)
        x = INPUTS["noise"](random, np.arange(round(40.0 * RATE)) / RATE)
        y = signal.lfilter(np.squeeze(num), den, x)
        y += 0.02 * y.std() * random.standard_normal(x.size)
        noisy = Record(np.arange(x.size) / RATE, dict(zip(NAMES, (x, y), strict=True)))
        found = estimate(signals((f"log_{seed}", noisy), frequency=15.0, segment=segment))
        texts = [text for text in found.warnings if text.key == "frequency_response.coarse"]
        assert len(texts) == told and (not told or texts[0].fields["longer"] == 2.0 * segment)
        _, exact = signal.freqz(np.squeeze(num), den, found.frequency, fs=RATE)
        near = np.abs(found.frequency - 5.0) < 2.5
        holds += list(
            (found.gain_low < np.abs(exact))[near] & (np.abs(exact) < found.gain_high)[near]
        )
    assert np.mean(holds) > 0.9


def delayed(seed: int, delay: int, noise: float = 0.5) -> tuple[str, Record]:
    """A pure delay behind a gain of −2, with noise."""
    random = np.random.default_rng(seed)
    x = random.standard_normal(20_000)
    y = -2.0 * np.r_[np.zeros(delay), x[:-delay]] + noise * random.standard_normal(x.size)
    return f"log_{seed}", Record(np.arange(x.size) / RATE, dict(zip(NAMES, (x, y), strict=True)))


def test_the_delay_is_found_and_its_interval_holds():
    """A gain below 0 is a constant turn: the slope is the delay alone. 95 % of 150 intervals."""
    inside, errors, halves = [], [], []
    for seed in range(150):
        found = estimate(signals(delayed(seed, 5), segment=0.5, frequency=100.0))
        delay = found.delay
        inside.append(delay.low < 5e-3 < delay.high)
        errors.append(delay.value - 5e-3)
        halves.append(0.5 * (delay.high - delay.low))
    assert 0.9 <= np.mean(inside) <= 0.99
    assert np.std(errors) * 1.96 == pytest.approx(np.mean(halves), rel=0.2)
    assert "frequency_response.curved_phase" not in [note.key for note in found.warnings]


def test_logs_are_averaged_and_each_costs_its_beginning_and_end():
    found = estimate(signals(log(3), frequency=40.0))
    assert "frequency_response.curved_phase" in [note.key for note in found.warnings]
    many = signals(*(log(seed, 16.0) for seed in range(4)))
    one = signals(log(9, 64.0))
    # two lines a segment without the log's ends; a parabola each of the answer and of every end
    assert (one.freedom, many.freedom) == (2 * 64 - 1 - 6, 4 * (2 * 16 - 1 - 3) - 3)
    assert one.averages == 1.0 + one.freedom / 2.0
    # four logs of 16 s weigh as one of 64 s
    widths = [
        np.median((r.gain_high - r.gain_low)[r.coherent]) for r in (estimate(many), estimate(one))
    ]
    assert widths[0] == pytest.approx(widths[1], rel=0.15)
    # of two segments nothing but their ends is seen
    assert signals(log(1), log(2, 2.5)).segments == (30, 0)


def test_frequencies_without_power_or_coherence_are_told():
    """A multisine on the segment's own lines excites these and no others."""
    t = np.arange(16_000) / RATE
    lines = (4.0, 8.0, 16.0)
    x = sum(np.sin(2 * math.pi * f * t + f) for f in lines)
    y = 0.5 * x + np.where(t < 8.0, 0.0, 0.2 * np.random.default_rng(2).standard_normal(t.size))
    record = Record(t, dict(zip(NAMES, (x, y), strict=True)))
    found = estimate(signals(("lines", record), segment=1.0, coherence=0.8))
    assert found.frequency[found.coherent].tolist() == list(lines)
    np.testing.assert_allclose(found.gain[found.coherent], 0.5, rtol=0.05)
    assert "frequency_response.no_power" in [note.key for note in found.warnings]
    assert found.delay is None
    assert "frequency_response.no_delay" in [note.key for note in found.warnings]
    noisy = estimate(signals(log(4, noise=0.02), coherence=0.8, frequency=100.0))
    assert "frequency_response.low_coherence" in [note.key for note in noisy.warnings]


def test_a_drift_beside_an_input_that_repeats_is_no_answer():
    """Lines of 2 s, and an output that drifts in a segment by a tenth of what it swings."""
    t, lines = np.arange(16_000) / RATE, np.arange(2, 20, 2)
    x = sum(np.sin(2 * math.pi * f * t + f**2) for f in lines)
    record = Record(t, dict(zip(NAMES, (x + 0.3 * t, 0.5 * x - 0.1 * t), strict=True)))
    found = estimate(signals(("drift", record), segment=2.0))
    at = np.isin(found.frequency, lines)
    np.testing.assert_allclose(found.gain[at], 0.5, rtol=1e-9)
    np.testing.assert_allclose(found.phase[at] - found.phase[at][0], 0.0, atol=1e-9)
    assert at[found.coherent].all()  # between them there is nothing but the drift


def test_a_delay_that_is_long_for_the_segment_is_told():
    """The phase turns too far for a parabola: the interval has what that lowers the gain."""
    found = estimate(signals(delayed(1, 60, 0.01), segment=0.2, frequency=100.0))
    assert "frequency_response.late" in [note.key for note in found.warnings]
    # what a parabola over ±1 segment has of its middle, of a phase that turns by 0.6 π each way
    u = np.linspace(-1.0, 1.0, 2001)
    lowered = 2.0 * np.mean((9.0 - 15.0 * u**2) / 4.0 * np.cos(0.6 * math.pi * u))
    assert np.mean(found.gain) == pytest.approx(lowered, rel=0.005) and lowered < 1.95
    assert np.mean((found.gain_low < 2.0) & (found.gain_high > 2.0)) > 0.93


def test_a_command_that_a_controller_set_is_told():
    """Of the controller's own cylinder, and of no other nor of an open loop."""
    for cylinder, controller, count in (
        ("boom", "arc", 1),
        ("stick", "arc", 0),
        ("boom", "open_loop", 0),
    ):
        name, record = log(1)
        meta = {"cylinder": cylinder, "controller": controller}
        keys = [note.key for note in signals((name, replace(record, meta=meta))).warnings]
        assert keys == ["frequency_response.closed_loop"] * count


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_an_output_cut_at_the_end_of_its_range_is_told(share):
    """A count of a fiftieth of what it swings is no such end."""
    name, record = log(1, noise=0.0)
    y = record[NAMES[1]]
    y = np.round(y / (0.02 * y.std())) * 0.02 * y.std()
    cut = replace(
        record, channels={**record.channels, NAMES[1]: np.minimum(y, np.quantile(y, 1.0 - share))}
    )
    notes = signals((name, cut)).warnings
    assert [note.key for note in notes] == ["frequency_response.limited"] * (share > 0.0)
    for note in notes:
        assert note.fields["share"] == pytest.approx(100.0 * share, rel=0.2)


def still(name, record):
    held = {NAMES[0]: np.full(record.t.size, 2.0), NAMES[1]: record[NAMES[1]]}
    return name, Record(record.t, held)


def slower(name, record):
    return name, Record(record.t[::2], {key: v[::2] for key, v in record.channels.items()})


def gap(name, record):
    keep = np.ones(record.t.size, bool)
    keep[100:200] = False
    return name, Record(record.t[keep], {key: v[keep] for key, v in record.channels.items()})


@pytest.mark.parametrize(
    ("logs", "error", "words"),
    [
        ([log(1, 2.0)], InsufficientData, "only 0 segments of 1 s"),
        ([log(1, 0.02)], InsufficientData, "only 0 segments"),
        ([still(*log(1))], InsufficientData, "stays at 2"),
        ([log(1), slower(*log(2))], InputError, "sampled at 500 and at 1000 Hz"),
        ([gap(*log(1))], LogError, "not evenly sampled"),
    ],
)
def test_logs_that_cannot_carry_a_response_are_refused(logs, error, words):
    with pytest.raises(error, match=words):
        signals(*logs)


def test_noise_alone_is_refused_and_short_segments_too():
    name, record = log(1)
    other = np.random.default_rng(5).standard_normal(record.t.size)
    both = {NAMES[0]: record[NAMES[0]], NAMES[1]: other}
    with pytest.raises(InsufficientData, match="no frequency reaches a coherence of 0.8"):
        estimate(signals((name, Record(record.t, both)), coherence=0.8))
    once = {NAMES[0]: 1.0 * (record.t > 0.3), NAMES[1]: other}
    with refused("frequency_response.at_the_ends", InsufficientData):
        estimate(signals((name, Record(record.t, once))))
    with pytest.raises(InsufficientData, match="only 10 samples"):
        signals(log(1), segment=0.01)
    with pytest.raises(InsufficientData, match="no frequency up to 0.5 Hz"):
        estimate(signals(log(1), frequency=0.5))


TEXT = """# a response
stage = "response"
rig = "{rig}"
data = ["log.mcap"]
input = "boom.hect.command"
output = "boom.v"
segment = "1 s"
frequency_max = "40 Hz"
coherence_min = 0.3
"""


@pytest.fixture
def folder(tmp_path):
    write_log(tmp_path / "log.mcap", log(1)[1])
    text = TEXT.format(rig=RIGS / "thesis_arm.toml")
    (tmp_path / "response.toml").write_text(text, encoding="utf-8")
    return tmp_path


@pytest.mark.slow
def test_a_run_leaves_numbers_curves_and_a_figure(folder):
    with (folder / "response.toml").open("a") as recipe_of_former_versions:
        recipe_of_former_versions.write('window = "hann"\n')
    made = workflow.run(folder / "response.toml", workflow.Session(out=folder / "run"))
    saved = made.json("response")
    assert made.notes[0].key == "frequency_response.window"
    found = estimate(signals(log(1), frequency=40.0))
    assert made.code == workflow.DONE and saved["gain_unit"] == "(m/s)/(V)"
    assert saved["delay"]["value"] == pytest.approx(found.delay.value, rel=1e-9)
    assert list(made.notes) == saved["warnings"]
    head, *rows = (folder / "run" / "response.csv").read_text().splitlines()
    assert head.startswith("frequency [Hz],gain [(m/s)/(V)],") and len(rows) == 40
    assert float(rows[9].split(",")[1]) == pytest.approx(found.gain[9], rel=1e-8)
    index = json.loads((folder / "run" / "figures" / "index.json").read_text())
    assert [one["key"] for one in index["figures"]] == ["response"]
    page = workflow.report([folder / "run"], workflow.Session(out=folder / "page")).folder
    text = (page / "report.html").read_text()
    assert "frequency at −90°" in text and f"Gain [({made.rig.unit_of('v')})/V]" in text


def test_a_check_names_a_channel_that_is_not_there(folder):
    path = folder / "response.toml"
    assert inspection.check(path).lines[-1] == "ok"
    path.write_text(path.read_text().replace('"boom.v"', '"boom.w"'))
    found = inspection.check(path)
    assert "no channel 'boom.w'" in str(found.errors[0]) and f"{path}:6" in str(found.errors[0])
    assert recipe.load_recipe(path).kind() == ("response", None)


def answered(ratio: float, delay: float, lag: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A multisine and what a pair of 3 Hz and a lag [s] make of it by SciPy's simulation, which
    knows nothing of forms; a delay [s] below 0 logs it too early."""
    rng = np.random.default_rng(5)
    t, omega = np.arange(4000) / 100.0, 6.0 * np.pi
    tones = [(f, rng.uniform(0, 6.3)) for f in np.arange(0.1, 8.0, 0.1)]
    u, late = (np.sum([np.sin(2 * np.pi * f * s + p) for f, p in tones], 0) for s in (t, t - delay))
    pair = [1.0, 2 * ratio * omega, omega**2]
    _, y, _ = signal.lsim(([2.0 * omega**2], np.polymul(pair, [lag, 1.0])), late, t)
    return u, 1.0 + y + 0.05 * y.std() * rng.standard_normal(t.size)


@pytest.mark.parametrize("delay", [-0.02, 0.0, 0.02])
@pytest.mark.parametrize("ratio", [0.05, 0.3, 0.8])
def test_a_second_order_is_found_with_its_interval(ratio, delay):
    """The interval holds, also where the output is logged too early, which is said."""
    best, *others = transfers([answered(ratio, delay)], 100.0)
    assert best.preferred and best.form == ("second order and delay" if delay else "second order")
    for value, std, true in (
        (best.natural_frequency, best.natural_frequency_std, 6.0 * np.pi),
        (best.damping_ratio, best.damping_ratio_std, ratio),
        *([(best.delay, best.delay_std, delay)] if delay else []),
    ):
        assert std is not None and abs(value - true) < 3.0 * std < 0.05 * abs(true)
    # real poles do not follow it, and such as the logs do not show are not offered
    assert all(max(o.pole_stds, default=0.0) <= max(o.poles, default=0.0) for o in others)
    notes = notes_of((best, *others))
    assert [note.key for note in notes] == ["frequency_response.early_form"] * (delay < 0.0)
    assert all(note.fields["early"] == pytest.approx(20.0, abs=1.0) for note in notes)


@pytest.mark.parametrize(("omega", "delay"), [(6.0 * np.pi, 0.0), (24.0 * np.pi, 0.015)])
def test_the_answer_to_held_commands_is_found_with_its_interval(omega, delay):
    """Steps, held over each sample, and SciPy's simulation of them between the samples."""
    rng, fine = np.random.default_rng(3), 50
    u = np.repeat(rng.uniform(-1.0, 1.0, 60), 25)
    t = np.arange(u.size * fine) / (100.0 * fine)
    acting = np.concatenate([np.full(round(delay * 100.0 * fine), u[0]), np.repeat(u, fine)])
    pair = ([omega**2], [1.0, 0.4 * omega, omega**2])
    rest = signal.tf2ss(*pair)
    start = -np.linalg.solve(rest[0], rest[1]).ravel() * u[0]
    _, y, _ = signal.lsim(rest, acting[: t.size], t, X0=start, interp=False)
    seen = y[::fine] + 0.01 * rng.standard_normal(u.size)
    best, *_ = transfers([(u, seen)], 100.0, held=True)
    assert best.form == ("second order and delay" if delay else "second order")
    for value, std, true in (
        (best.natural_frequency, best.natural_frequency_std, omega),
        (best.damping_ratio, best.damping_ratio_std, 0.2),
        *([(best.delay, best.delay_std, delay)] if delay else []),
    ):
        assert std is not None and abs(value - true) < 2.5 * std < 0.05 * abs(true)
    straight, *_ = transfers([(u, seen)], 100.0)
    assert straight.delay == pytest.approx(delay + 0.005, abs=1e-3)  # half a sample later


@pytest.mark.parametrize("delay", [-0.02, 0.0])
@pytest.mark.parametrize("ratio", [0.1, 0.3])
def test_a_lack_of_fit_widens_the_intervals_of_the_preferred_form(ratio, delay):
    """A lag of 10 ms is in the delay of the preferred form: its numbers hold none the less."""
    best, *_ = transfers([answered(ratio, delay, 0.01)], 100.0)
    for value, std, true in (
        (best.natural_frequency, best.natural_frequency_std, 6.0 * np.pi),
        (best.damping_ratio, best.damping_ratio_std, ratio),
        (best.delay, best.delay_std, delay),
    ):
        assert value is not None and std is not None and abs(value - true) < 1.96 * std
    assert best.natural_frequency_std is not None and best.natural_frequency is not None
    assert best.natural_frequency_std < 0.02 * best.natural_frequency


def test_that_no_form_follows_is_told():
    assert [note.key for note in notes_of(())] == ["frequency_response.no_form"]


def test_an_output_ahead_of_its_input_is_said_by_the_slope():
    name, record = delayed(1, 5)
    early = Record(record.t, dict(zip(NAMES, (record[NAMES[1]], record[NAMES[0]]), strict=True)))
    found = estimate(signals((name, early), segment=0.5, frequency=100.0))
    (note,) = [note for note in found.warnings if note.key == "frequency_response.early"]
    assert note.fields["early"] == pytest.approx(5.0, abs=note.fields["error"])
    assert note.fields["error"] < 0.5


# --- parameters from the frequency response of logs, in place of their samples

RIG = RIGS / "slide_servo.toml"
TRUE = {"bulk_modulus": 720e6, "spool.natural_frequency": 2.0 * math.pi * 60.0}
COMMAND = "press.servo.command"
NOISE = {"press.v": 2e-3, "press.p_head": 15e3, "press.p_rod": 15e3, "p_supply": 9e3}
RESPONSE = (COMMAND, Averaging(segment=0.4))
CHANNELS = ("v", "p_head", "p_rod")
DELAYED = 4  # samples


@cache
def swept(late: int = 0) -> Record:
    """A multisine of the command up to 30 Hz, all channels some samples late."""
    rng, t = np.random.default_rng(4), np.arange(1001) * 2e-3
    tones = [np.sin(2.0 * math.pi * f * t + rng.uniform(0.0, 6.3)) for f in range(1, 31)]
    command = 0.12 * np.sum(tones, axis=0) * (t > 0.1)
    rig = load_rig(RIG).with_values(TRUE)
    start = {"press": "200 mm"}
    made = simulate(rig, {"press.servo": command}, t[-1], posture=start, rate=500.0)
    channels = {COMMAND: command}
    for name, size in NOISE.items():
        y = np.concatenate([np.full(late, made[name][0]), made[name][: t.size - late]])
        channels[name] = y + size * rng.standard_normal(t.size)
    return Record(t, channels, {"payload": "none"})


def fitted(late: int, parameters=tuple(TRUE), **options):
    given = FitOptions(channels=CHANNELS, response=RESPONSE, **options)
    return identify_hydraulics(load_rig(RIG), [("sweep", swept(late))], parameters, given)


def test_stiffness_and_valve_come_from_the_response(tmp_path, unpainted):
    write_log(tmp_path / "sweep.mcap", swept())
    recipe = {"stage": "identify", "what": "hydraulics", "rig": str(RIG), "data": ["sweep.mcap"]}
    recipe |= {"parameters": list(TRUE), "channels": list(CHANNELS)}
    recipe["response"] = {"input": COMMAND, "segment": "0.4 s"}
    (tmp_path / "fit.toml").write_text(tomli_w.dumps(recipe))
    run = workflow.run(tmp_path / "fit.toml", workflow.Session(root=tmp_path / "runs"))
    found = read_json(run.folder / "parameters.json")
    for one in found["parameters"]:
        low, high = one["interval"]
        assert low <= TRUE[one["name"]] <= high and high - low < 0.03 * TRUE[one["name"]]
    (log,) = found["logs"]
    assert log["samples"] < 150  # numbers of a response, not samples
    assert min(log["fit_percent"].values()) > 98.0
    assert not any("by the slope of its phase" in text for text in found["warnings"])
    assert [one["channel"] for one in log["responses"]] == list(log["fit_percent"])
    for one in log["responses"]:
        seen, made = one["recorded"], one["simulated"]
        at = np.array(seen["coherent"])
        assert at.sum() > 2 and max(np.array(seen["frequency"])[at]) == 30.0
        assert np.array(made["gain"])[at] == pytest.approx(np.array(seen["gain"])[at], rel=0.05)
    index = read_json(run.folder / "figures" / "index.json")
    assert ["Response to press.servo in sweep"] == [
        one["title"] for one in index["figures"] if one["about"]["kind"] == "response"
    ]


def test_a_delay_that_nobody_modelled_shows_up():
    fit = fitted(DELAYED, ("bulk_modulus",))
    said = [text for text in fit.warnings if "by the slope of its phase" in text]
    assert any(f"press.v answers {COMMAND}" in text for text in said)
    late = float(said[0].split(COMMAND)[1].split()[0])
    assert (
        "behind" in said[0] and 4.0 < late < 12.0
    )  # 8 ms, and the valve's own lag is not the rig file's
    free = fitted(DELAYED, sensors=(Sensor(channel=COMMAND, delay="estimate"),))
    (delay,) = free.sensors
    assert abs(delay.value - 0.008) < 3.0 * delay.std + 1e-4 and delay.std < 1e-3
    low, high = free["bulk_modulus"].interval
    assert low <= TRUE["bulk_modulus"] <= high


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (FitOptions(response=RESPONSE, cutoff=20.0), "without a low-pass"),
        (FitOptions(response=RESPONSE, method="thesis"), "no response to a sweep"),
        (FitOptions(response=("press.pa.command", Averaging())), "does not have"),
        (FitOptions(response=("p_supply", Averaging())), "none of them answers"),
    ],
)
def test_what_has_no_response_is_refused(options, said):
    with pytest.raises(InputError, match=said):
        prepare_fit(load_rig(RIG), [("sweep", swept())], ["bulk_modulus"], options)


def test_no_suggestions_without_windows():
    options = FitOptions(channels=CHANNELS, response=RESPONSE)
    prepared = prepare_fit(load_rig(RIG), [("sweep", swept())], ["bulk_modulus"], options)
    with pytest.raises(InputError, match="windows left out"):
        suggest(prepared, [("sweep", swept())])
