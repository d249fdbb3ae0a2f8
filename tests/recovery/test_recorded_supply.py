"""A machine on an accumulator that its rig file does not know: the log's supply pressure drives the
replay."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ehbench import simulate
from ehbench.app import inspection
from ehbench.config.rig import Rig
from ehbench.data.logs import write_log
from ehbench.data.record import Record
from ehbench.identification.fixed_numbers import counts_on
from ehbench.identification.hydraulics import HydraulicsFit, identify_hydraulics
from ehbench.plant.model import Model
from ehbench.plant.ties import RECORDED, SUPPLY
from ehbench.preprocessing.observations import supply_off
from ehbench.validation import validate_rig
from tests.shared import RIGS, judged, shipped

VOLUMES = ("volume_head", "volume_rod")
STIFF, LOSS = "bulk_modulus", "carriage.damping"


def rig(**supply: object) -> Rig:
    """The slide, its supply changed."""
    tables = shipped("slide_servo").as_toml()
    return Rig.model_validate(tables | {"supply": {**tables["supply"], **supply}})


@cache
def log(supply: str = "model") -> Record:
    """Steps of the slide on an accumulator with a small pump, with sensors' noise."""
    gas = {"gas_volume": "0.4 L", "precharge": "90 bar"}
    machine = rig(flow_limit="4 L/min", accumulator=gas)
    t = np.arange(1201) / 1000.0
    volts = np.select([t < 0.2, t < 0.5, t < 0.7, t < 1.0], [0.0, 4.0, 0.0, -5.0], 0.0)
    record = simulate(machine, {"press.servo": volts}, 1.2, posture={"press": "120 mm"})
    rng = np.random.default_rng(11)
    size = {"p_head": 1.5e4, "p_rod": 1.5e4, "p_supply": 1.5e4, "x": 2e-5, "v": 1e-3}
    channels = {
        name: y + size.get(name.rpartition(".")[2], 0.0) * rng.standard_normal(y.size)
        for name, y in record.channels.items()
        if name.rpartition(".")[2] in (*size, "command")
    }
    return Record(record.t, channels, {"payload": "none", SUPPLY: supply})


@cache
def fit(supply: str) -> HydraulicsFit:
    return identify_hydraulics(rig(), [("log", log(supply))], [STIFF, LOSS])


def test_a_replay_takes_the_recorded_supply_pressure():
    record, model = log(RECORDED), Model.of(rig())
    replayed = model.replay(record)
    off = replayed["p_supply"] - record["p_supply"]
    assert np.ptp(record["p_supply"]) > 1e6 and np.sqrt(np.mean(off**2)) < 2.5e4
    own = model.replay(log())["p_supply"] - record["p_supply"]
    assert np.abs(own).max() > 1e6


def test_oil_and_damping_are_right_on_a_supply_that_the_rig_file_does_not_know():
    given, own = fit(RECORDED), fit("model")
    truth = rig().parameters()
    for name in (STIFF, LOSS):
        low, high = given[name].interval
        assert low < float(truth[name]) < high, name
    assert given[STIFF].value == pytest.approx(float(truth[STIFF]), rel=2e-3)
    low, high = given[STIFF].interval
    wide = own[STIFF].interval
    assert high - low < 0.2 * (wide[1] - wide[0])
    assert any("bar below the model's" in text and RECORDED in text for text in own.warnings)
    assert not any("below the model's" in text for text in given.warnings)
    assert any("supply's parameters do not show" in text for text in given.warnings)
    assert "p_supply" not in given.logs[0].start_shift
    (text,) = given.counts_on
    assert "press.volume_head and press.volume_rod" in text and "10 % more oil" in text
    assert "on the inertia that moves" in text and "10 % more inertia up to 10 % higher" in text


def test_what_a_bulk_modulus_counts_on_is_by_how_much_more_would_move_it():
    """Against fits with a tenth more oil in the rig file's volumes, and with a tenth more mass."""
    tables = rig().as_toml()
    (press,) = tables["cylinder"]
    more = {key: f"{1.1 * float(getattr(rig().cylinder[0], key))} m^3" for key in VOLUMES}
    mass = f"{1.1 * float(rig().parameters()['carriage.mass'])} kg"
    larger, heavier = (
        identify_hydraulics(
            Rig.model_validate(tables | new), [("log", log(RECORDED))], [STIFF, LOSS]
        )
        for new in (
            {"cylinder": [{**press, **more}]},
            {"mechanism": {**tables["mechanism"], "mass": mass}},
        )
    )
    first = fit(RECORDED)
    said = re.search(r"come out ([\d.]+) %, .* up to ([\d.]+) % higher", first.counts_on[0])
    for share, second in zip(said.groups(), (larger, heavier), strict=True):
        found = 100.0 * (second[STIFF].value / first[STIFF].value - 1.0)
        assert found == pytest.approx(float(share), rel=0.15)
    free = [STIFF, LOSS, *(f"press.{key}" for key in VOLUMES)]
    (text,) = counts_on(rig(), free, {"press": [log()]})
    assert text.startswith("bulk_modulus counts on the inertia that moves: with 10 % more inertia")
    assert counts_on(rig(), [*free, "carriage.mass"], {"press": [log()]}) == ()


def test_a_validation_says_that_the_supply_is_another():
    found = judged(rig(), [("own", log()), ("given", log(RECORDED))])
    own, given = found.logs
    assert any("own: p_supply is up to" in text for text in found.reservations)
    assert not any("p_supply is up to" in text for text in given.warnings)
    fits = [{one.channel: one.fit_percent for one in log.channels} for log in found.logs]
    assert all(fits[1][name] > fits[0][name] for name in fits[0])


@pytest.mark.parametrize(
    ("gas", "kind", "size"),
    [("0.4 L", None, 0.0), ("0.5 L", "gas volume", -0.2), (None, "accumulator", None)],
)
def test_what_an_accumulator_has_is_told_by_the_supplys_pressure(gas, kind, size):
    """The machine has 0.4 L at 90 bar."""
    given = {"accumulator": {"gas_volume": gas, "precharge": "90 bar"}} if gas else {}
    found = validate_rig(rig(flow_limit="4 L/min", **given), [("log", log())])
    assert (found.verdict == "accepted") == (kind is None), found.reservations
    if kind is None:
        return
    first = found.structure.findings[0]
    assert first.kind == kind and first.explains > 0.9
    assert any(first.sentence in text for text in found.reservations)
    if size is None:
        assert "[supply.accumulator] gas_volume" in first.remedy
    else:
        assert first.size == pytest.approx(size, abs=0.02)


@pytest.mark.parametrize(
    ("channel", "key", "share"), [("p_supply", "pressure", 0.05), ("p_tank", "tank_pressure", 0.02)]
)
def test_a_pressure_of_the_rig_file_that_is_not_the_logs_is_a_reservation(channel, key, share):
    """The replay goes by the log, so that nothing else shows it."""
    machine = rig(tank_pressure="3 bar")
    supply = float(machine.supply.pressure)
    known = float(getattr(machine.supply, key))
    other = rig(**{"tank_pressure": "3 bar", key: f"{known - share * supply} Pa"})
    shows = {"p_supply": "psi", "p_tank": "psi"}
    other = Rig.model_validate(other.as_toml() | {"display": shows})
    volts = np.where(np.arange(601) < 200, 0.0, 4.0)
    record = simulate(machine, {"press.servo": volts}, 0.6, posture={"press": "120 mm"})
    assert judged(machine, [("log", record)]).reservations == ()
    for meta in ({}, {SUPPLY: RECORDED}):
        (told,) = judged(other, [("log", replace(record, meta=meta))] * 2).reservations
        assert told.key == "preprocessing.level_off"
        line = told.fields["line"]
        assert line.startswith(f'{key} = "') and written(line) == pytest.approx(known, rel=5e-3)
        assert "psi" in line and "e+" not in line
    fitted = identify_hydraulics(other, [("log", record)], [STIFF])
    assert line in [getattr(text, "fields", {}).get("line") for text in fitted.warnings]


@pytest.mark.parametrize("wrong", [{}, {"load_margin": 3e6}, {"load_lag": 0.1}])
def test_a_number_of_load_sensing_is_named(wrong):
    sensing = {"load_margin": 2e6, "load_lag": 0.05}
    machine, model = (rig(load_sensing=written_table(sensing | off)) for off in ({}, wrong))
    volts = np.where(np.arange(1201) % 600 < 200, 0.0, 4.0)
    record = simulate(machine, {"press.servo": volts}, 1.2, posture={"press": "80 mm"})
    findings = validate_rig(model, [("log", record)]).structure.findings
    assert [item.remedy.fields["names"] for item in findings[:1]] == [f"supply.{n}" for n in wrong]


def written_table(sensing):
    """Load sensing as a rig file has it, of numbers in SI."""
    margin, lag = sensing.values()
    return {"load_margin": f"{margin} Pa", "load_lag": f"{lag} s"}


def test_a_supply_that_rises_with_the_load_has_no_level():
    """The first reading of a pump that goes with the load is no pressure of the rig file."""
    machine, model = rig(), Model.of(rig())
    record = log()
    low = {"p_supply": 0.2 * record["p_supply"]}
    rises = {"p_supply": record["p_supply"] * np.linspace(0.2, 0.8, record.t.size)}
    for given, keys in ((low, ["preprocessing.level_off"]), (rises, [])):
        seen = replace(record, channels=record.channels | given)
        notes = supply_off(seen, model.replay(seen), machine)
        assert [note.key for note in notes if note.key.endswith("level_off")] == keys
    level = 0.9 * float(machine.supply.pressure)
    jolt = {"p_supply": level * (1.0 + 0.1 * np.exp(-(((record.t - 0.3) / 0.05) ** 2)))}
    seen = replace(record, channels=record.channels | jolt)  # oil comes back, in the model too
    assert [note.key for note in supply_off(seen, seen, machine)] == ["preprocessing.level_off"]


def written(line: str) -> float:
    """The pressure [Pa] of a line of the rig file."""
    return float(rig(**{"pressure": line.split('"')[1]}).supply.pressure)


def test_a_recipe_asks_for_it_and_needs_the_pressure(tmp_path):
    def checked(record: Record) -> inspection.Inspection:
        (tmp_path / "log.mcap").unlink(missing_ok=True)
        write_log(tmp_path / "log.mcap", record)
        return inspection.check(tmp_path / "fit.toml")

    (tmp_path / "fit.toml").write_text(
        f'stage = "identify"\nwhat = "hydraulics"\nrig = "{RIGS}/slide_servo.toml"\n'
        'data = ["log.mcap"]\nparameters = ["bulk_modulus"]\nsupply = "recorded"\n'
    )
    assert not checked(log()).errors
    bare = {name: y for name, y in log().channels.items() if name != "p_supply"}
    (error,) = checked(replace(log(), channels=bare)).errors
    assert "no p_supply" in str(error) and error.line == 4
