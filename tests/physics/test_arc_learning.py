"""What it learns in motion: wrong maps, payloads picked up, put down or wrongly told."""

import numpy as np
import pytest

from ehbench.config.recipe import BenchRecipe, TrialRecipe, load_recipe
from ehbench.config.recipe.trial import Controller, MachineChange
from ehbench.control import functions
from ehbench.control.law import late_of
from ehbench.machines.simulated import SimulatedMachine
from ehbench.machines.virtual import VirtualMachine
from ehbench.plant.model import Model
from ehbench.trial import prepare, run
from ehbench.trial.controllers import Compiled
from tests.shared import RECIPES, cycle, shipped

RIG = shipped("thesis_arm")
BENCH = RECIPES / "bench" / "thesis_arm.toml"
SPEEDS = {"slow": ("60 mm/s", "0.3 m/s^2", "6 m/s^3"), "fast": ("180 mm/s", "1 m/s^2", "20 m/s^3")}
LESS = {"less fast": ("165 mm/s", "1 m/s^2", "20 m/s^3")}
PAYLOAD = 26.016  # [kg] that 50 lb weigh at the end of the last link


def prepared(payload="none", speed="slow", on="model", **given):
    top, acceleration, jerk = (SPEEDS | LESS)[speed]
    given |= {"gains": {"adapt_maps": True} | given.get("gains", {}), "payload": payload, "on": on}
    given |= {"bench": str(BENCH)} if on == "bench" else {}
    move = {"hold": "0.6 s", "acceleration": acceleration, "jerk": jerk}
    return prepare(cycle("boom", ["50 mm", "200 mm", "50 mm"], top, move=move, **given), RIG)


def other_bench(**given):
    """The arm's virtual bench under 50 lb, with other keys in its file."""
    bench = load_recipe(BENCH)
    assert isinstance(bench, BenchRecipe)
    return VirtualMachine(RIG, BenchRecipe.model_validate(bench.model_dump() | given), "50 lb")


def other_valves(factor, shift):
    """Valves that pass ``factor`` as much as the file says and open ``shift`` [V] later."""
    values = {}
    for name, value in RIG.parameters().items():
        if name.startswith("boom.") and name.endswith(".compensated_gain"):
            values[name] = factor * float(value)
        if name.startswith("boom.") and name.endswith(".deadband"):
            values[name] = float(value) + shift
    return SimulatedMachine(Model.of(RIG.with_values(values)))


@pytest.mark.parametrize(("factor", "shift"), [(0.9, 0.0), (1.1, 0.0), (1.0, 0.3), (1.0, -0.3)])
def test_wrong_maps_are_mended_within_one_cycle(factor, shift):
    """Every edge that was used, to a third of its first error; the tracking is better."""
    alone = {"adapt_oil": False}  # which makes up for such maps by itself
    on = run(prepared("50 lb", gains=alone), other_valves(factor, shift)).facts.measures
    given = prepared("50 lb", gains=alone | {"adapt_maps": False})
    off = run(given, other_valves(factor, shift))
    assert len(on["maps"]) >= 3
    default = run(prepared("50 lb"), other_valves(factor, shift)).facts.measures
    assert default["limit_cycle"] is None
    for edge, one in (*on["maps"].items(), *default["maps"].items()):
        assert one["true_gain"] == pytest.approx(factor, abs=2e-3), edge
        assert one["true_shift"] == pytest.approx(shift, abs=6e-3), edge
        assert one["error_after"] < one["error_before"] / 3.0, edge
    tracking = off.facts.measures["tracking"]
    assert "maps" not in off.facts.measures
    assert on["tracking"]["rms_error"] < 0.6 * tracking["rms_error"]
    assert on["limit_cycle"] is None


@pytest.mark.parametrize("shift", ["0.3 V", "-0.3 V"])
def test_wrong_maps_are_mended_on_the_virtual_bench(shift):
    valves = {"all": {"hysteresis": "0.05 V", "driver_gain": 1.0, "driver_offset": shift}}
    measures = run(prepared("50 lb", on="bench"), other_bench(valve=valves)).facts.measures
    first = max(one["error_before"] for one in measures["maps"].values())
    assert first > 0.05
    for edge, one in measures["maps"].items():
        assert one["error_after"] < max(one["error_before"], first) / 3.0, edge


def plain_bench(factor):
    """Edges like the rig file's but for their ``factor``, behind a hysteresis of 0.05 V."""
    edges = {}
    for name, value in RIG.parameters().items():
        if name.startswith("boom.") and name.endswith(".deadband"):
            edge = name.removesuffix(".deadband")
            setting = float(RIG.parameters()[f"{edge}.compensation_drop"])
            plain = {"onset": f"{float(value)} V", "softness": "0 V", "saturation": "0 V"}
            plain |= {"gain_factor": 1.0, "compensation_drop": f"{setting} Pa"}
            plain |= {"compensator_opening": "1000 V", "flow_force": "0 1/V"}
            edges[edge] = plain | {"reverse": plain}
    valves = {"all": {"hysteresis": "0.05 V", "driver_gain": 1.0, "driver_offset": "0 V"}}
    machine = other_bench(valve=valves, edge=edges)
    machine.bench.curves.gain *= factor
    return machine


def test_a_hysteresis_that_is_known_is_not_taken_for_a_wrong_map(monkeypatch):
    """With its width in the maps, less is left of every edge that was the worst."""

    def left():
        measures = run(prepared("50 lb", on="bench"), plain_bench(1.1)).facts.measures
        return max(one["error_after"] for one in measures["maps"].values())

    without = left()
    monkeypatch.setattr(functions, "_plays", lambda own, measured: np.full(len(own), 0.05))
    assert left() < 0.85 * without


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_hysteresis_that_nobody_knows_cancels(factor):
    """Gain and deadband are told apart, every edge to a fifth of the first error; less is left of
    a wrong gain than half of the hysteresis is in flow."""
    machine = plain_bench(factor)
    command, drop = np.array([3.0]), np.array([2.0e6])
    late = machine.static_flow("boom.hepc", command, drop)
    half = float((1.0 - late / machine.mean_flow("boom.hepc", command, drop))[0])
    measures = run(prepared("50 lb", on="bench"), machine).facts.measures
    first = max(one["error_before"] for one in measures["maps"].values())
    assert half > 0.02 and first > 0.08
    for edge, one in measures["maps"].items():
        assert one["error_after"] < first / 5.0, edge
    assert measures["maps"]["boom.hepc"]["error_after"] < half


def test_a_machine_says_whether_its_valves_play(monkeypatch):
    monkeypatch.setattr(functions, "_plays", lambda own, measured: np.full(len(own), 0.05))
    trial = prepared("50 lb")
    for machine, width in ((other_valves(1.0, 0.0), 0.0), (plain_bench(1.0), 0.05)):
        laws = trial.law(machine)
        (law,) = laws
        assert isinstance(law, Compiled)
        play = law.controller.axis.circuit.play
        assert play.size == 5 and (play == width).all()


def test_corrections_stay_in_their_bounds():
    """By bounds of nothing: what is not doubted is not corrected, and no number is lost by it."""
    gains = {"map_error": "0 %", "deadband_error": "0 V"}
    record = run(prepared("50 lb", gains=gains), other_valves(0.9, 0.1)).record
    for edge in ("hect", "hepc", "regen", "repc", "rect"):
        assert (record[f"boom.{edge}.map_gain"] == 1.0).all()
        assert (record[f"boom.{edge}.map_shift"] == 0.0).all()
    # Maps that are wronger than the bounds allow
    gains = {"map_error": "4 %", "deadband_error": "0.1 V"}
    record = run(prepared("50 lb", gains=gains), other_valves(0.8, 0.4)).record
    for edge in ("hect", "hepc", "regen", "repc", "rect"):
        gain, shift = record[f"boom.{edge}.map_gain"], record[f"boom.{edge}.map_shift"]
        assert gain.min() >= 1.0 / 1.04 - 1e-12 and gain.max() <= 1.04 + 1e-12
        assert np.abs(shift).max() <= 0.1 + 1e-12
    assert record["boom.hepc.map_shift"].max() == pytest.approx(0.1)


def test_maps_are_judged_in_the_mean_of_both_directions():
    machine = plain_bench(1.0)
    command, drop = np.linspace(2.0, 4.0, 5), np.full(5, 2.0e6)
    late, soon = (machine.static_flow("boom.hepc", command + side * 0.025, drop) for side in (0, 2))
    mean = machine.mean_flow("boom.hepc", command, drop)
    assert mean == pytest.approx(0.5 * (late + soon), rel=1e-12)
    assert (late < mean).all() and (mean < soon).all()


@pytest.mark.parametrize("change", [{"delay": "5 ms"}, {"valve_lag": 2.0}, {"flow": 0.9}])
def test_learning_maps_costs_no_margin_on_the_virtual_bench(change):
    """Late samples, slow valves, other flow: no swing, and no worse than with the given maps."""
    oil = "flow" not in change  # planned flows make up for a share that lacks by themselves

    def on_bench(**gains):
        return run(prepared("50 lb", on="bench", machine=change, gains=gains)).facts.measures

    with_maps, without = (on_bench(adapt_maps=on, adapt_oil=oil) for on in (True, False))
    assert with_maps["limit_cycle"] is None
    assert with_maps["tracking"]["rms_error"] < 1.05 * without["tracking"]["rms_error"]
    if "flow" in change:
        default, given = (on_bench(adapt_maps=on) for on in (True, False))
        assert default["limit_cycle"] is None
        assert default["tracking"]["rms_error"] < 0.9 * given["tracking"]["rms_error"]
        for one in (with_maps, default):
            assert one["tracking"]["rms_error"] < 0.7 * without["tracking"]["rms_error"]


def test_a_motion_beyond_the_valves_is_told():
    """With a tenth less flow the boom's supply edge cannot give 180 mm/s to 50 lb, but 165 mm/s."""
    change = {"on": "bench", "machine": {"flow": 0.9}, "gains": {"adapt_maps": False}}
    beyond = run(prepared("50 lb", "fast", **change)).facts
    short = beyond.measures["short"]
    assert short["reached"] < short["desired"] == pytest.approx(0.18, rel=0.01)
    assert any(w.key == "trial.saturated_short" for w in beyond.warnings)
    within = run(prepared("50 lb", "less fast", **change)).facts
    assert within.measures["short"] is None
    assert within.measures["limits"]["saturated"] == 0.0


@pytest.mark.parametrize("speed", SPEEDS)
@pytest.mark.parametrize("payload", ["none", "50 lb"])
def test_the_payload_in_motion_carries_an_interval_that_holds_it(payload, speed):
    truth = PAYLOAD if payload == "50 lb" else 0.0
    for seed in range(2):
        record = run(prepared(payload, speed, on="bench", seed=seed)).record
        measured = record["boom.payload_measured"]
        assert np.abs(measured - truth).max() < 0.1 * PAYLOAD
        low, high = record["boom.payload_low"], record["boom.payload_high"]
        assert (low <= truth).all() and (truth <= high).all()
        assert np.median(high - low) < 0.6 * PAYLOAD


@pytest.mark.parametrize("on", ["model", "bench"])
def test_a_load_picked_up_in_motion_is_learnt(on):
    """Half a second later it is known within the interval, and the boom is where it should be."""
    change = [{"at": "2 s", "payload": "50 lb"}]
    result = run(prepared(on=on, payload_change=change))
    record, t = result.record, result.record.t
    before, after = t < 2.0, t > 2.5
    low, high = record["boom.payload_low"], record["boom.payload_high"]
    assert (low[before] <= 0.0).all() and (high[before] >= 0.0).all()
    assert (low[after] <= PAYLOAD).all() and (high[after] >= PAYLOAD).all()
    assert abs(record["boom.payload_estimate"][-1] - PAYLOAD) < 0.1 * PAYLOAD
    error = np.abs(record["boom.x"] - record["boom.x_desired"])
    assert error[t > 3.5].max() < 0.4 * error.max()


def test_a_wrong_first_pressure_is_unlearnt_and_a_guarantee_holds():
    """The pressures at rest tell the payload at the first tick; where they lie, motion tells it."""
    true = run(prepared("50 lb", on="bench"))
    assert true.record["boom.payload_estimate"][0] == pytest.approx(PAYLOAD, rel=0.1)
    wrong = {"boom.p_head": "-4 bar"}
    lied = run(prepared("50 lb", on="bench", first_pressure_error=wrong)).record
    told = lied["boom.payload_estimate"]
    assert abs(told[0] - PAYLOAD) > 0.25 * PAYLOAD
    assert abs(told[-1] - PAYLOAD) < 0.1 * PAYLOAD
    measures = true.facts.measures
    assert measures["guaranteed"]["stroke"] > measures["tracking"]["max_error"]


# --- what it learns of its oil: told from late samples, slow valves and wrong flows, and used

DESIGN = float(RIG.oil.bulk_modulus)


def ran(machine, payload="50 lb", **gains):
    """A fast cycle of the boom on the model of a changed machine, its maps as they are."""
    return run(prepared(payload, "fast", machine=machine, gains={"adapt_maps": False} | gains))


@pytest.mark.parametrize("factor", [0.5, 1.0, 1.5])
def test_the_bulk_modulus_is_told_in_one_cycle(factor):
    record = ran({"bulk_modulus": factor}).record
    told = record["boom.bulk_measured"]
    assert told[0] == pytest.approx(DESIGN)
    assert told[-1] == pytest.approx(factor * DESIGN, rel=0.07)


OTHERS = {
    "late samples": ({"delay": "5 ms"}, 0.2),
    "slow valves": ({"valve_lag": 2.0}, 0.2),
    "quick valves": ({"valve_lag": 0.33}, 0.12),
    "friction": ({"friction": 3.0}, 0.05),
    "less flow": ({"flow": 0.9}, 0.08),
    "more flow": ({"flow": 1.1}, 0.08),
}


@pytest.mark.parametrize("other", OTHERS)
def test_what_is_not_oil_is_not_taken_for_it(other):
    machine, within = OTHERS[other]
    assert ran(machine).record["boom.bulk_measured"][-1] == pytest.approx(DESIGN, rel=within)


@pytest.mark.parametrize("payload", ["50 lb", "100 lb"])
def test_soft_oil_is_followed_the_better_for_it(payload):
    errors = []
    for on in (True, False):
        measures = ran({"bulk_modulus": 0.5}, payload, adapt_oil=on).facts.measures
        assert measures["limit_cycle"] is None
        errors.append(measures["tracking"]["max_error"])
    assert errors[0] < 0.85 * errors[1] and errors[0] < 1.0e-3


@pytest.mark.parametrize("off", [{"adapt_oil": False}, {"adapt": False}])
def test_without_it_the_design_stands(off):
    told = ran({"bulk_modulus": 0.5}, **off).record["boom.bulk_measured"]
    assert np.array_equal(told, np.full(told.size, told[0]))
    assert told[0] == pytest.approx(DESIGN)


def test_what_is_taken_has_bounds():
    """Oil four times as soft is followed up to two and a half times."""
    told = ran({"bulk_modulus": 0.25}).record["boom.bulk_measured"]
    assert told.min() > 0.999 * DESIGN / 2.5
    assert told[-1] == pytest.approx(DESIGN / 2.5, rel=0.1)


@pytest.mark.parametrize(("factor", "share"), [(0.9, 0.8), (1.1, 0.4)])
def test_flow_that_lacks_is_asked_for_within_the_first_ramp(factor, share):
    """Of 10 % less flow a valve at its end is left, of 10 % more hardly anything."""
    with_it, without = (ran({"flow": factor}, adapt_oil=on).facts.measures for on in (True, False))
    assert with_it["limit_cycle"] is None
    assert with_it["tracking"]["max_error"] < share * without["tracking"]["max_error"]
    assert with_it["tracking"]["max_error"] < 1.5e-3


def test_valves_that_are_late_are_asked_ahead():
    with_it, without = (
        ran({"valve_lag": 2.0}, adapt_oil=on).facts.measures for on in (True, False)
    )
    assert with_it["tracking"]["rms_error"] < 0.8 * without["tracking"]["rms_error"]


# --- samples that come late by a known time


def errors(told: str) -> tuple[float, float]:
    """rms errors [m], by the sensor and true, of ARC on a bench whose samples are 6 ms late."""
    loaded = load_recipe(RECIPES / "trials/arc_fast_bench.toml")
    assert isinstance(loaded, TrialRecipe)
    law = Controller.model_validate({"kind": "arc", "delay": told})
    machine = MachineChange.model_validate({"delay": "5 ms"})
    changes = {"controller": law, "machine": machine, "payload": "50 lb"}
    measures = run(prepare(loaded.model_copy(update=changes), shipped("thesis_arm"))).facts.measures
    return measures["tracking"]["rms_error"], measures["tracking_true"]["rms_error"]


def test_the_true_error_loses_what_the_delay_adds():
    """It does not keep speed times delay, and the sensor's error is the true one."""
    measured, true = errors("0 ms")
    assert true > 2.5 * measured
    measured, true = errors("6 ms")
    assert true == pytest.approx(measured, rel=0.1) and true < 0.2e-3


@pytest.mark.parametrize(
    ("delay", "ticks", "share"), [(0.0, 1, 0.0), (2e-3, 3, 0.0), (2.3e-3, 4, 0.7)]
)
def test_a_delay_is_whole_ticks_and_a_share(delay, ticks, share):
    late = late_of(delay, 1e-3)
    assert late.desired.shape == (ticks, 2) and np.isnan(late.desired).all()
    assert late.share == pytest.approx(share, abs=1e-9)
