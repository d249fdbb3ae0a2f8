"""Each number by which logs are read and prepared decides an outcome, as in
`test_settings_matter`."""

import math
from pathlib import Path
from types import SimpleNamespace as Stub
from typing import Any

import numpy as np
import pytest

from ehbench.app import mapping
from ehbench.app.mapping import guesses, written
from ehbench.data import channels, flowmeter, rates, readers
from ehbench.data.record import Record
from ehbench.plant.model import Model
from ehbench.preprocessing import initial_states, observations, plausibility, time_base
from ehbench.signals import series, timestamps
from ehbench.validation import transients
from ehbench.vocabulary.errors import InputError
from tests.settings import answers, each, each_shows, first_call, refusal
from tests.shared import shipped

RIG, SLIDE = (shipped(name) for name in ("boom_four_valve", "slide_servo"))
ANY: Any = Stub()
PLAUSIBLE, RINGING, FIRST = plausibility.SETTINGS, series.SETTINGS, initial_states.SETTINGS
WHITE = np.random.default_rng(1).standard_normal(4000)
SIGNS = np.where(np.arange(1000) % 2, 1.0, -1.0)
LATE = np.where(np.arange(1000) == 500, 1.0, 0.0)


# --- what a log can be


def weak(share):
    """The refusal of pressures of a driven slide of which the largest is so much of the
    supply's."""
    p = np.full(100, share * float(SLIDE.supply.pressure))
    y = {"press.servo.command": np.full(100, 5.0), "press.p_head": p, "press.p_rod": 0.5 * p}
    y["press.x"] = np.full(100, 0.1)
    log = Record(np.arange(100) * 1e-3, y)
    model = Model.of(SLIDE)
    return refusal(lambda: plausibility.refuse_pressures("log", log, model, 10, still=False))


def pushes(share):
    way = np.linspace(0.0, share * float(SLIDE.supply.pressure), 100)
    y = {"press.servo.command": np.linspace(0.0, 5.0, 100), "press.p_head": way}
    return plausibility._pushed(Record(np.arange(100) * 1e-3, y), SLIDE, SLIDE.cylinder[0])


def beside_pins(sigmas=0.0, share=0.0):
    """Whether a stroke is off its angle's by so many times its noise, of 5 % of the stroke, or
    without noise by a share of it."""
    model, row = Model.of(RIG), Model.of(RIG).plant.cylinders[0]
    q = np.full(4000, plausibility.joint_of(row, 0.5 * float(row.stroke)))
    noise = 0.05 * float(row.stroke) * WHITE if sigmas else 0.0 * WHITE
    x = plausibility.linkage_arrays(row, q)[0] + noise
    x += sigmas * series.white_noise(x) - float(np.median(noise)) + share * float(row.stroke)
    log = Record(np.arange(4000) * 1e-3, {"boom.x": x, "boom.q": q})
    return bool(plausibility.off_pins(log, model))


def begins_moving(share, count=100, first=50):
    """Whether a slide moves in the first samples, of which the first few are a share of its largest
    speed."""
    rows = np.arange(1000)
    v = np.where(rows < count, share, 0.0) + (rows > 500)
    return bool(plausibility.moving_at_first(Record(rows * 1e-3, {"press.v": v}), SLIDE, first))


def at_end(before=(-20.0, -10.0, -5.0), run=6, others=1):
    """Whether a sensor is at its end, 0, at which it stays for a ``run`` after readings ``before``;
    the smallest step of others, which stay for so many each, is 1."""
    steps = np.repeat([-30.0, -31.0, -29.0, -30.0], others)
    y = np.concatenate([steps, before, np.zeros(run), [-7.0], steps])
    return bool(plausibility.at_limit(y).any())


def gaps_kept(share):
    """Whether a log is filled of which a share of the steps lack samples."""
    steps = np.where(np.arange(2000) < 2000 * share, 4e-3, 1e-3)
    t = np.cumsum(np.random.default_rng(1).permutation(steps))
    log = Record(t, {"press.v": np.zeros(2000)})
    return time_base.parts_of("log", log)[0][0].record is not log


def part_lasts(seconds, other=1.0):
    """How many parts a log has of which one lasts so long before a gap, another one longer."""
    t = np.concatenate([np.arange(0.0, seconds, 1e-3), 10.0 + np.arange(0.0, other, 1e-3)])
    return len(time_base.parts_of("log", Record(t, {"press.v": np.zeros(t.size)}))[0])


def supply_far(share):
    """What is noted of a supply whose pressure is off from the log's and the rig file's."""
    y, t = np.full(100, float(SLIDE.supply.pressure)), np.arange(100) * 1e-3
    log, other = (Record(t, {"p_supply": p}) for p in (y, (1.0 + share) * y))
    return [note.key for note in observations.supply_off(log, other, SLIDE)]


def tank_far(share):
    """How often a tank's pressure is noted that is off from the rig file's by so much of the
    supply's."""
    off = float(SLIDE.supply.tank_pressure) + share * float(SLIDE.supply.pressure)
    log = Record(np.arange(9) * 1e-3, {"p_tank": np.full(9, off)})
    return len(observations.supply_off(log, log, SLIDE))


def rate_of(position):
    """How much of a swing of 20 Hz of a position is left in its rate [mm/s]."""
    t = np.arange(2000) * 1e-3
    log = Record(t, {"press.x": position * np.sin(40.0 * np.pi * t)})
    rate = observations.column(log, "press.v", log)
    assert rate is not None
    return round(1e3 * float(np.abs(rate[500:1500]).max()))


def ticks(step):
    """The refusal of a log of the slide whose samples are so far apart [s]."""
    log = Record(step * np.arange(9), {"press.v": np.zeros(9)})
    return refusal(lambda: plausibility.refuse_sample_time("log", log, SLIDE))


def slow_valve(times):
    """The refusal of samples so many periods of a valve of 1 kHz apart."""
    rig = SLIDE.with_values({"spool.natural_frequency": 2.0 * math.pi * 1e3})
    log = Record(1e-3 * times * np.arange(9), {"press.v": np.zeros(9)})
    return refusal(lambda: plausibility.refuse_sample_time("log", log, rig))


def beyond_driver(share):
    """The refusal of a command beyond its driver's range by a share of it."""
    valve = SLIDE.cylinder[0].valve[0]
    low, high = float(valve.command_min), float(valve.command_max)
    u = np.full(9, high + share * (high - low))
    log = Record(np.arange(9) * 1e-3, {"press.servo.command": u})
    return refusal(lambda: plausibility.refuse_commands("log", log, SLIDE))


def travels(share):
    """Whether a stroke that changes by a share of it travels."""
    x = np.linspace(0.0, share * float(SLIDE.cylinder[0].stroke), 9)
    return plausibility._travels(Record(np.arange(9) * 1e-3, {"press.x": x}), SLIDE.cylinder[0])


def stands_still(share):
    """Notes on a stroke that changes by so little of it while the speed is that of a motion."""
    stroke = float(SLIDE.cylinder[0].stroke)
    x = np.linspace(0.0, share * stroke, 1000)
    log = Record(np.arange(1000) * 1e-3, {"press.x": x, "press.v": np.full(1000, stroke)})
    notes = plausibility.notes_on_channels(log, Model.of(SLIDE))
    return sum(note.key == "preprocessing.stands_still" for note in notes)


def comes_late(by, stray=0.0):
    """Whether a way is late that goes out and back so many seconds after its commands, 0.3 s each,
    and goes on by a share of all of it without one."""
    t = np.arange(1000) * 0.01
    back = [0.3, 0.3, 0.6 * stray / (1.0 - stray)]
    y = sum(
        sign * np.clip(t - start - by, 0.0, span)
        for sign, start, span in zip((1.0, -1.0, 1.0), (3.0, 3.8, 5.0), back, strict=True)
    )
    places, each = np.array([300, 330, 380, 410]), np.array([1.0, 0.0, -1.0])
    return bool(plausibility._late(y, places, each, 0.01))


def noisy_place(share):
    """Notes on a position whose noise is worth so much of a pressure's spread."""
    model = Model.of(SLIDE)
    row = model.plant.cylinders[0]
    x = 0.5 * float(row.stroke) + 1e-6 * WHITE[:1000]
    volume = float(row.volume_head + row.area_head * 0.5 * row.stroke)
    worth = float(row.bulk_modulus * row.area_head) / volume * series.white_noise(x)
    y = {"press.x": x, "press.p_head": 1e7 + worth / share * SIGNS}
    log = Record(np.arange(1000) * 1e-3, y)
    return len(list(plausibility._coarse(log, model)))


def at_valve(share):
    """Whether a command is on at first that stands so much of its range beyond its onset."""
    valve = SLIDE.cylinder[0].valve[0]
    span = float(valve.command_max) - float(valve.command_min)
    volts = max(float(valve.onset(edge)) for edge in valve.edge) + share * span
    log = Record(np.arange(9) * 1e-3, {"press.servo.command": np.full(9, volts)})
    return bool(plausibility.on_at_first(log, SLIDE, 5))


def high(times):
    """The refusal of a pressure so many times the largest that the rig can make."""
    cylinder = SLIDE.cylinder[0]
    top = max(float(SLIDE.supply.pressure), float(cylinder.relief_pressure or 0.0))
    seen, supply = {"p_head": np.full(9, times * top)}, float(SLIDE.supply.pressure)
    return refusal(lambda: plausibility._peak("log", SLIDE, cylinder, seen, supply, 0.0))


def turned(alike):
    """Notes on a gauge that is so much alike the force of the pressures."""
    way = np.sin(np.arange(400) * 0.1)
    rest = np.cos(np.arange(400) * 0.1)
    y = {"press.p_head": 1e7 + 1e6 * way, "press.p_rod": np.full(400, 1e6)}
    y[f"press.{plausibility.GAUGES[0]}"] = alike * way + math.sqrt(1.0 - alike**2) * rest
    log = Record(np.arange(400) * 1e-3, y)
    notes = plausibility.notes_on_channels(log, Model.of(SLIDE))
    return sum(note.key == "preprocessing.turned" for note in notes)


def even(share, gap=0.0):
    """Whether steps are even that are off by a share; the refusal of a step too long by a gap."""
    steps = np.full(9, 1e-3)
    steps[4] += 1e-3 * (share + gap)
    steps[5] -= 1e-3 * share
    t = np.concatenate([[0.0], np.cumsum(steps)])
    log = Record(t, {"press.v": np.zeros(10)})
    return refusal(lambda: time_base.evened("log", log)) or bool(time_base.evened("log", log)[1])


def driven(share):
    """How many parts of a log are kept whose command changes by so much of its range in one."""
    t = np.concatenate([np.arange(0.0, 1.0, 1e-3), 10.0 + np.arange(0.0, 1.0, 1e-3)])
    u = np.where(t < 0.5, 0.0, 1.0) + np.where(t > 10.5, -share, 0.0)
    log = Record(t, {"press.servo.command": u})
    return len(time_base.parts_of("log", log, driven=True)[0])


# --- first states


def priors(moves=True, compared=(), **y):
    """The priors of pressure, position and speed of a slide, as shares."""
    log, model = Record(np.arange(100) * 1e-3, y), Model.of(SLIDE)
    numbers = initial_states._of_cylinder(model, log, "press", compared, 50, moves)
    stroke, supply = float(SLIDE.cylinder[0].stroke), float(SLIDE.supply.pressure)
    units = {"press.p_head": supply, "press.q": stroke, "press.qd": 1.0}
    return [round(n.std / units[n.name], 9) for n in numbers if n.name in units]


def opened():
    """The prior of a valve's opening in motion, of its range, and that of the supply."""
    y = {"press.v": 1.0 + np.arange(100.0), "press.servo.command": np.full(100, 5.0)}
    y["p_supply"] = np.full(100, 1e7)
    log, model = Record(np.arange(100) * 1e-3, y), Model.of(SLIDE)
    numbers = initial_states.initial_state_of(model, log, ("press",), ()).uncertain
    supply = float(SLIDE.supply.pressure)
    valve = SLIDE.cylinder[0].valve[0]
    span = float(valve.command_max) - float(valve.command_min)
    units = {"press.servo.opening": span, "p_supply": supply}
    return [round(n.std / units[n.name], 9) for n in numbers if n.name in units]


def follows_on(gain):
    """Rounds of an estimate of a first state of which each gains so much of the cost."""
    count = []

    class Follow(initial_states._Follow):
        def __init__(self):
            self.floor = np.ones(1)

        # pyrefly: ignore[bad-override]
        def residual(self, shifts):
            return np.ones((2, 1))

        def cost(self, shifts, residual):
            return 1.0

        def step(self, shifts, residual):
            count.append(1)
            return shifts, gain

        def tries(self, shifts, move, before):
            yield shifts, np.ones((2, 1))

    with answers(initial_states, prior_weight=lambda _: 1.0):
        Follow().best(np.zeros(1))
    return len(count)


def least_scale():
    """The least scale of a channel of unit spread in an estimate of a first state."""
    record = Record(np.arange(1000) * 1e-3, {"press.v": SIGNS})
    start: Any = Stub(record=record)
    return round(float(initial_states._Follow(ANY, start, ("press.v",)).floor[0]), 9)


def creep_counts(share):
    """Whether a creep of so much of the fastest speed is an uncertain number."""
    v = np.where(np.arange(100) < 50, share, 0.0)
    v[99] = 1.0
    log, model = Record(np.arange(100) * 1e-3, {"press.v": v}), Model.of(SLIDE)
    numbers = initial_states._of_cylinder(model, log, "press", (), 50, False)
    return any(number.name == "press.qd" for number in numbers)


def place_of(**y):
    """Prior of the stroke of a slide at rest, in ppb of it."""
    log, model = Record(np.arange(100) * 1e-3, y), Model.of(SLIDE)
    numbers = initial_states._of_cylinder(model, log, "press", (), 50, False)
    (number,) = (item for item in numbers if item.name == "press.q")
    return round(number.std / float(SLIDE.cylinder[0].stroke) * 1e9)


def step_of(prior):
    """The step of a number of a prior, both in its range's ppb."""
    return round(1e9 * initial_states._uncertain("a", 0, 1e-9 * prior, 1.0).step)


def creeps(sigmas):
    """Whether a mean speed so many times its error is a creep."""
    noise = WHITE[:400] - WHITE[:400].mean()
    y = noise + sigmas * initial_states.mean_error(noise, 400)
    log = Record(np.arange(400) * 1e-3, {"press.v": y})
    return initial_states._creep(log, "press", 400, 1.0) > 0.0


def first_of(tick):
    """How many samples show the first state of a motion of a parabola with a bend after them."""
    t = np.arange(1000) * tick
    return round(1e3 * initial_states._first(np.cos(60.0 * t), 1000, tick)[0], 3)


def step_of_bias():
    term: Any = Stub(per_log=True, std=2.0, name="press.v.zero")
    y = {"press.v": np.zeros(100), "press.servo.command": np.zeros(100)}
    log = Record(np.arange(100) * 1e-3, y)
    numbers = initial_states.initial_state_of(Model.of(SLIDE), log, (), (), (term,)).uncertain
    return [number.step for number in numbers if number.bias]


# --- ringings


def silent(damping=0.1, evidence=99.0, share=0.5, loud=math.inf, omega=60.0, error=0.0):
    """Why an oscillation does not ring, of a damping ratio and frequency [rad/s], known to a share
    of it, so much likelier than none, that explains a share of what moves, of energy 1."""
    t, lefts = np.arange(1000) * 1e-3, iter(np.sqrt([1.0 / share - 1.0, 1.0 / share]))
    time = 1000.0 * math.log(1.0 / (1.0 - share)) / evidence
    with answers(series, project=lambda *_: (None, np.full((1000, 1), next(lefts))),
                 correlation_time=time, _standard_errors=(omega * error, 0.0)):  # fmt: skip
        seen = series._judge(t, np.ones((1000, 1)), np.ones(1), omega, damping, 0.0, 0.0, loud)
    return getattr(seen.reason, "key", "").partition(".")[2]


def also_rings(share):
    """Whether a series is heard of so much of another's energy, in ten times more noise."""
    t = np.arange(1000) * 1e-3
    y = np.exp(-3.0 * t) * np.sin(60.0 * t)
    like = series.ringing(t, y)
    energies = []
    with answers(series, _judge=lambda *given: energies.append(given[-1]) or like):
        series.ringing_like(t, y, like)
    return energies[0] / like.energy < share


def starts(apart):
    """How many starts the last searches have where the first ends ``apart`` in log ω."""
    t, counts = np.arange(1000) * 1e-3, []

    def refine(s, y, starts, taus):
        counts.append(len(starts))
        return 60.0 * math.exp(apart), 0.1, 0.0

    with answers(series, _refine=refine, _search=(60.0, 0.1, 1000)):
        series.ringing(t, np.sin(60.0 * t))
    return counts[-1]


def few_samples(count):
    t = np.arange(count) * 1e-3
    return getattr(series.ringing(t, np.sin(300.0 * t)).reason, "key", "").partition(".")[2]


def coarse_search():
    """Samples of the search on a grid of a window of 1000."""
    seen = []

    def waves(count, _):
        seen.append(count)
        return np.ones(1), np.zeros((1, 5, 2, count))

    with answers(series.oscillation, waves=waves):
        series._search(np.arange(1000) * 1e-3, np.sin(np.arange(1000.0))[:, None])
    return seen


def first_start():
    """How far below half of the sampling rate a search begins, in log ω."""
    given = np.arange(100) * 1e-3, np.ones((100, 1)), [(1e9, 0.1)], [0.0]
    begin = first_call(series.oscillation, "fit", lambda: series._refine(*given))[3]
    return round(math.log(math.pi / 1e-3) - begin[0], 9)


# --- stamps


def is_even(off):
    """Whether a clock is even whose stamps are off by so many periods."""
    return timestamps.Timestamps(1.0, np.arange(off.size), off).even


def enough(count):
    return timestamps.timestamps_of(np.arange(count) * 1.0) is not None


def beyond(share):
    """Whether the stamps of a clock get an even rate back of which one is off by so much of what
    they are rounded to."""
    t = np.floor((np.arange(200) + 0.25) / 0.8 + 1e-9) * 0.8
    even = np.polyval(np.polyfit(np.arange(200), t, 1), np.arange(200))
    t[100] = even[100] + 0.8 * share
    return timestamps.unrounded(t, 0.8) is not t


def lossy(step):
    """Whether rows that a clock of 1 s lacks show in stamps rounded to ``step``."""
    seen = []
    t = np.delete(np.arange(200) + 0.25, np.arange(20, 180, 9))
    with answers(timestamps, timestamps_of=lambda _: seen.append(1)):
        timestamps.unrounded(np.floor(t / step + 1e-9) * step, step)
    return bool(seen)


def stamped(step, lost=(), count=200):
    """Whether the stamps of a clock of 1 s, rounded to ``step``, get its even rate back."""
    t = np.delete(np.arange(count) + 0.25, lost)
    rounded = np.floor(t / step + 1e-9) * step
    return timestamps.unrounded(rounded, step) is not rounded


def off_stamps(share):
    """Notes on 1000 rows that last so much longer than their stamps."""
    t = np.arange(1000) * 1e-3
    group: Any = Stub(t=(1.0 + share) * t, stamped=t, title="rows")
    return len(rates.Group.wrong_rate(group))


def twice(share):
    """Rows that repeat the one before, of which a time shows so many."""
    again = np.arange(round(1000.0 * share / (1.0 - share)))
    t = np.sort(np.concatenate([np.arange(1000.0), again]))
    return bool(rates.Group("", t).repeated.any())


def own_rate(*every):
    """Whether two signals, each in every so many rows, are of different messages."""
    one, other = (np.arange(100) % n == 0 for n in every)
    return rates._take_turns(one, other)


def turns(both):
    """Whether two signals take turns of which so many of a hundred rows hold both."""
    one = np.arange(200) % 2 == 0
    other = ~one
    other[: 2 * both : 2] = True
    return rates._take_turns(one, other)


def rate_of_few(count):
    """Whether a signal of so few values has a rate of its own."""
    one, other = np.zeros(40, bool), np.ones(40, bool)
    one[: 3 * count : 3] = True
    return rates._take_turns(one, other)


def held(hole):
    """Whether rows are left out where another table has a hole of so many of its samples."""
    t = np.concatenate([np.arange(20.0), 19.0 + hole + np.arange(20.0)])
    fast = np.arange(0.0, t[-1], 0.1)
    each = ((fast, "press.v"), (t, "press.x"))
    groups, losses = [rates.Group("", time, channels={name: time}) for time, name in each], []
    rates.joined(groups, losses)
    return bool(losses)


def bridged():
    """The longest gap that a note says is bridged."""
    t = np.concatenate([np.arange(50.0), 55.0 + np.arange(50.0), 111.0 + np.arange(50.0)])
    group: Any = Stub(t=t, period=1.0, resolution=0.0, title="a")
    (note,) = rates.gaps(group, None)
    return note.fields["longest"]


# --- readings


def readings(flows, drops, direction=""):
    same = {"valve": "a", "direction": direction, "file": "f", "command": 1.0}
    pairs = enumerate(zip(flows, drops, strict=True))
    rows = [same | {"flow": q, "pressure_drop": p, "line": n} for n, (q, p) in pairs]
    left = flowmeter.LeftOut("f")
    return flowmeter._signs(rows, left), left


def against(share):
    """Readings left out of which one's flow, so much of the largest, runs against its drop."""
    return len(readings([1.0, 1.0, -share], [1.0, 1.0, 1.0], "forward")[1].errors)


def reverse(count):
    """Readings left out where so many have both signs turned."""
    sign = np.where(np.arange(40) < count, -1.0, 1.0)
    return len(readings(sign, sign)[1].errors)


def against_supply(times):
    """Readings left out, and doubts, of a drop so many times the supply's pressure."""
    row = {"pressure_drop": times * 1e7, "valve": "a", "file": "f", "line": 1}
    left = flowmeter.LeftOut("f")
    doubts = flowmeter._within_supply([row], 1e7, {"pressure_drop": "bar"}, left)[1]
    return len(left.errors), len(doubts)


def left_out(count):
    """The refusal of a valve of 30 readings of which so many are slips."""
    left = flowmeter.LeftOut("f")
    for line in range(count):
        left.take("a", InputError("data.few_reverse", file="f", line=line))
    return refusal(lambda: left.sentences(["a"] * (30 - count)))


# --- drafts, and children that read


def ends_of(*readings):
    """The readings in mA that are taken for the ends of a driver of 0 to 10 V."""
    return guesses._span_of("mA", np.array(readings), 0.0)


def unit_of(step):
    """How sure it is that the steps of a time without a unit are seconds."""
    return guesses._time_unit(step * (0.5 + np.arange(9)))


def drafted(bad):
    """Whether a draft leaves bad cells out, of which a column of a hundred has so many."""
    column = Stub(values=np.where(np.arange(1000) < bad, np.nan, 1.0))
    source: Any = Stub(tables=[Stub(columns=[column], size=1000)], names=lambda: {"p": (0, 0)})
    guess: Any = Stub(channel="press.p_head", sure=True)
    with answers(written, own_rows=lambda *_: {"p": np.ones(1000, bool)}):
        (line,) = written._policy(source, {"p": guess})
    return not line.startswith("#")


def allowed(name, size=10**9):
    """What a reader of a file of so many bytes may use."""
    file: Any = Stub(absolute=lambda: Path("x"), is_dir=lambda: False)
    file.lstat, reader = lambda: Stub(st_size=size), Stub(module="mdf", name="", package="")
    with answers(readers, available=1e15):
        call = first_call(readers, "confined", lambda: readers._confined(reader, file, ANY))
    return getattr(call[1], name)


def time_of(values, unit=""):
    """(unit, remark) of a column called time."""
    column: Any = Stub(values=np.asarray(values), name="time")
    table: Any = Stub(columns=[column], t=None)
    guess = guesses._time(column, unit, {"time"}, table)
    return ("", "") if guess is None else (guess.unit, guess.remark.key.partition(".")[2])


def begins_again(count):
    """What is said of a time of a thousand steps that goes back in so many of them."""
    steps = np.where(np.arange(1000) < count, -0.5, 1.5)
    return time_of(np.concatenate([[0.25], 0.25 + np.cumsum(steps)]), "s")[1]


def rate_said(share):
    """Whether the rate of a table is that of its usual steps, whose mean is longer by a share."""
    steps = np.where(np.arange(1000) == 500, 1e-3 * (1.0 + 1000.0 * share), 1e-3)
    table: Any = Stub(t=np.cumsum(steps), began=None, daytime=None)
    return ", 1000 Hz" in mapping._span(table, 0, {}, {})


def out_of_range(share):
    """Whether a pressure is sure of whose values so many are none."""
    values = np.where(np.arange(1000) < 1000 * share, 1e9, 100.0)
    table: Any = Stub(columns=[Stub(values=values, doubt=None)])
    source: Any = Stub(tables=[table], names=lambda: {"p": (0, 0)})
    seen = guesses.Guess("press.p_head", "bar", guesses.CERTAIN)
    with answers(guesses, _guess=lambda *_: seen):
        return guesses.guessed(source, SLIDE)["p"].sure


def loads(share):
    """The refusal of pressures far from those of a load of so much of the supply's."""
    model, supply = Model.of(SLIDE), float(SLIDE.supply.pressure)
    head, rod = (model.layout.state(word, 0) for word in ("p_head", "p_rod"))
    y = {"press.p_head": np.full(9, 0.5 * supply), "press.p_rod": np.zeros(9)}
    log = Record(np.arange(9) * 1e-3, y)
    with answers(type(model), start_of={head: share * supply, rod: 0.0}):
        return refusal(lambda: plausibility.refuse_pressures("log", log, model, 9, still=True))


def runs_empty(share):
    """Notes on a supply whose pressure is so much below its accumulator's precharge."""
    supply = Stub(accumulator=Stub(precharge=1e7))
    rig: Any = Stub(supply=supply, shown=lambda *_: "")
    t = np.arange(9) * 1e-3
    simulated = Record(t, {"p_supply": np.full(9, 1e7 * (1.0 - share))})
    return len(observations.supply_off(Record(t, {"press.v": t}), simulated, rig))


def transient(late=0, error=0.0):
    """Why transients are not judged: of a step so many samples before another, of a model that is
    so many times the noise off."""
    t = np.arange(1000) * 1e-3
    y = {"press.servo.command": np.where(np.arange(1000) < 500 - late, 0.0, 5.0), "press.v": t}
    rings = series.Ringing(60.0, 0.1, 0.0, 0.0, stop=9.0, ok=True)
    pairs: Any = {"press.v": Stub(recorded=t, simulated=t + math.sqrt(error) * SIGNS)}
    with (answers(series, transients=[slice(500, 900)], ringing=rings, ringing_like=rings),
          answers(transients, why_not_judged="", noise_of=1.0)):  # fmt: skip
        seen = transients.transients_of(Record(t, y), Model.of(SLIDE), "press", pairs)
    return [bool(item.note) for item in seen]


def follows_beats(drift):
    """Whether every row has its beat whose stamps run away by so many periods each."""
    return int(timestamps._beats(np.arange(2000) * (1.0 + drift), 1.0)[-1]) == 1999


ROWS = [
    (PLAUSIBLE, "far_apart", lambda n: weak(1.0 / n), (48.0, 52.0),
     ["", "preprocessing.low_pressures"]),
    (PLAUSIBLE, "pushed", pushes, (0.095, 0.105), [False, True]),
    (PLAUSIBLE, "noises", beside_pins, (5.7, 6.3), [False, True]),
    (PLAUSIBLE, "ongoing", begins_moving, (0.095, 0.105), [False, True]),
    (PLAUSIBLE, "limit_run", lambda n: at_end(run=n), (3, 4), [False, True]),
    (PLAUSIBLE, "limit_share", lambda n: at_end(run=n, others=4), (8, 9), [False, True]),
    (PLAUSIBLE, "limit_rise", at_end, ((-9.0, -4.0, -2.0), (-9.0, -6.0, -3.0)), [False, True]),
    (PLAUSIBLE, "limit_steps", lambda n: at_end((-20.0, -n, -2.0)), (4.8, 5.2), [False, True]),
    (time_base.SETTINGS, "rare", gaps_kept, (0.37, 0.43), [True, False]),
    (time_base.SETTINGS, "shortest", part_lasts, (0.23, 0.27), [1, 2]),
    (observations.SETTINGS, "supply_off", supply_far, (0.028, 0.032),
     [[], ["preprocessing.level_off", "preprocessing.supply_off"]]),
    (observations.SETTINGS, "rate_cutoff", lambda: rate_of(0.01), 627),
    (observations.SETTINGS, "clear_cycles",
     lambda: [observations.rings_clearly(n, 0.1) for n in (1.4, 1.6)], [False, True]),
    (observations.SETTINGS, "clear_damping",
     lambda: [observations.rings_clearly(9.0, z) for z in (0.33, 0.37)], [True, False]),
    (FIRST, "fine_place", lambda: place_of(**{"press.x": np.full(100, 0.1)}), 10_000),
    (FIRST, "least_step", lambda: step_of(1), 1000),
    (FIRST, "largest_step", lambda: step_of(1e9), 200_000),
    (FIRST, "creep_sigmas", creeps, (2.8, 3.2), [False, True]),
    (FIRST, "beginning", lambda: first_of(1e-3), 1025.851),
    (FIRST, "sensed", step_of_bias, [0.02]),
    (PLAUSIBLE, "coarse", ticks, (0.049, 0.051), ["", "preprocessing.too_coarse"]),
    (PLAUSIBLE, "fine", ticks, (1.1e-5, 0.9e-5), ["", "preprocessing.too_fine"]),
    (PLAUSIBLE, "periods", slow_valve, (4.9, 5.1), ["", "preprocessing.too_coarse"]),
    (PLAUSIBLE, "overshoot", beyond_driver, (0.009, 0.011), ["", "preprocessing.outside_driver"]),
    (PLAUSIBLE, "travel", travels, (0.019, 0.021), [False, True]),
    (PLAUSIBLE, "still", stands_still, (0.9e-4, 1.1e-4), [1, 0]),
    (PLAUSIBLE, "latest", comes_late, (1.9, 2.2), [True, False]),
    (PLAUSIBLE, "stray", lambda s: comes_late(0.5, s), (0.09, 0.11), [True, False]),
    (PLAUSIBLE, "worth", noisy_place, (0.095, 0.105), [0, 1]),
    (timestamps.SETTINGS, "rms", lambda x: is_even(x * SIGNS), (0.24, 0.26), [True, False]),
    (timestamps.SETTINGS, "fewest", enough, (19, 20), [False, True]),
    (timestamps.SETTINGS, "coarse", stamped, (0.09, 0.11), [False, True]),
    (RINGING, "samples", few_samples, (23, 24), ["few_samples", ""]),
    (RINGING, "cycles", lambda n: silent(0.0, omega=n * 2 * math.pi), (0.95, 1.05),
     ["few_cycles", ""]),
    (RINGING, "share", lambda s: silent(share=s), (0.29, 0.31), ["no_oscillation", ""]),
    (rates.SETTINGS, "fewest", rate_of_few, (3, 4), [False, True]),
    (PLAUSIBLE, "on", at_valve, (0.009, 0.011), [False, True]),
    (PLAUSIBLE, "first", lambda h: begins_moving(h, 3, 400), (0.6, 0.8), [False, True]),
    (PLAUSIBLE, "off_pins", lambda s: beside_pins(share=s), (0.0047, 0.0053), [False, True]),
    (PLAUSIBLE, "apart", high, (4.9, 5.1), ["", "preprocessing.high_pressure"]),
    (PLAUSIBLE, "against", turned, (-0.47, -0.53), [0, 1]),
    (time_base.SETTINGS, "even", even, (0.009, 0.011), [False, True]),
    (time_base.SETTINGS, "jitter", even, (0.48, 0.54), [True, "preprocessing.not_even"]),
    (time_base.SETTINGS, "change", driven, (0.018, 0.022), [1, 2]),
    *each(FIRST, "pressure place", priors, [0.2, 0.25]),
    (FIRST, "compared", lambda: priors(compared=("press.p_head",)), [0.05, 0.25]),
    (FIRST, "sensor", lambda: priors(**{"press.p_head": np.full(100, 1e7)}), [0.005, 0.25]),
    (FIRST, "speed", lambda: priors(**{"press.v": np.ones(100)}), [0.2, 0.25, 0.2]),
    *each(FIRST, "opening supply", opened, [0.25, 1e-5]),
    (FIRST, "creep", creep_counts, (0.9e-3, 1.1e-3), [False, True]),
    (RINGING, "error", lambda s: silent(error=s), (0.14, 0.16), ["", "vague_frequency"]),
    (RINGING, "clear", lambda s: silent(evidence=1.0, share=s), (0.89, 0.91),
     ["no_oscillation", ""]),
    (RINGING, "grid", coarse_search, [200, 250, 250, 125, 62]),
    (RINGING, "inside", first_start, 0.05),
    (timestamps.SETTINGS, "largest", lambda s: is_even(s * LATE), (0.98, 1.02), [True, False]),
    (timestamps.SETTINGS, "rounded", beyond, (0.58, 0.64), [True, False]),
    (timestamps.SETTINGS, "lossy", lossy, (0.77, 0.87), [True, False]),
    (rates.SETTINGS, "shared", turns, (9, 11), [True, False]),
    (rates.SETTINGS, "gap", held, (6.2, 6.8), [False, True]),
    (rates.SETTINGS, "bridged", bridged, 6.0),
    (flowmeter.SETTINGS, "supply_margin", lambda n: against_supply(n)[0], (1.45, 1.55), [0, 1]),
    (RINGING, "damped", lambda z: silent(z, omega=4.0), (0.57, 0.63), ["few_cycles", "damped"]),
    (RINGING, "significant", lambda e: silent(evidence=e), (38.0, 42.0), ["no_oscillation", ""]),
    (RINGING, "loud", also_rings, (0.095, 0.105), [False, True]),
    (RINGING, "astray", starts, (0.47, 0.53), [1, 2]),
    (RINGING, "cycle", lambda: series._block(np.arange(9999) * 1e-3, 2.0 * math.pi), 41),
    (timestamps.SETTINGS, "coarsest", stamped, (3.8, 4.2), [True, False]),
    (timestamps.SETTINGS, "fewest_long", lambda n: stamped(0.8, count=n), (38, 45), [False, True]),
    (channels.SETTINGS, "wrong_rate", off_stamps, (0.0115, 0.0125), [0, 1]),
    (rates.SETTINGS, "repeated", twice, (0.047, 0.053), [True, False]),
    (rates.SETTINGS, "slower", lambda: [own_rate(3, 4), own_rate(2, 3)], [False, True]),
    (flowmeter.SETTINGS, "zero_share", against, (0.019, 0.021), [0, 1]),
    (flowmeter.SETTINGS, "fewest_reverse", reverse, (3, 4), [3, 0]),
    (flowmeter.SETTINGS, "supply_share", lambda s: against_supply(s)[1], (0.0053, 0.0047), [0, 1]),
    (guesses.LIMITS, "loop", lambda x: ends_of(0.0, x)[1], (24.0, 26.0), [20.0, 50.0]),
    (guesses.LIMITS, "slow", unit_of, (0.085, 0.095),
     [("s", guesses.LIKELY), ("s", guesses.UNDECIDED)]),
    (FIRST, "gain", follows_on, (1.1e-3, 0.9e-3), [20, 1]),
    (FIRST, "rounds", lambda: follows_on(1.0), 20),
    (FIRST, "floor", least_scale, 0.005),
    (guesses.LIMITS, "few", drafted, (9, 11), [True, False]),
    *((readers.SETTINGS, name, lambda: allowed("memory"), 102e9) for name in ("memory", "swells")),
    *((readers.SETTINGS, name, lambda: allowed("wait"), pytest.approx(200_200.0))
      for name in ("seconds", "slowness", "patience")),
    (flowmeter.SETTINGS, "most_left_out", left_out, (10, 11), ["", "data.too_many_left_out"]),
    (guesses.LIMITS, "again", begins_again, (9, 11), ["time_goes_back", ""]),
    (guesses.LIMITS, "days", lambda d: time_of(45e3 + d * np.arange(9))[0], (19e-6, 21e-6),
     ["d", "s"]),
    (guesses.LIMITS, "even", rate_said, (0.009, 0.011), [False, True]),
    (guesses.LIMITS, "few", out_of_range, (0.009, 0.011), [True, False]),
    (PLAUSIBLE, "loaded", loads, (0.028, 0.032), ["", "preprocessing.load_pressure"]),
    (time_base.SETTINGS, "share", lambda s: part_lasts(s, 5.0), (0.48, 0.52), [1, 2]),
    (FIRST, "difference", lambda: step_of(1e5), 30_000),
    (observations.SETTINGS, "together", transient, (19, 23), [[True], []]),
    (observations.SETTINGS, "slack", runs_empty, (0.009, 0.011), [0, 1]),
    (observations.SETTINGS, "slack", tank_far, (0.009, 0.011), [0, 1]),
    (transients.SETTINGS, "quiet", lambda x: transient(9, x), (1.2, 1.4), [[True], [False]]),
    (timestamps.SETTINGS, "block", follows_beats, (0.0085, 0.0115), [True, False]),
]  # fmt: skip

test_a_third_more_or_less_shows = each_shows(ROWS)
