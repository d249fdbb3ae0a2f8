"""The rows of the fault table that a rig and its logs have, without a simulation."""

import tomllib
from types import SimpleNamespace as Stub

import numpy as np
import pytest

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.diagnosis.faults import hypotheses
from ehbench.vocabulary.fields import Value
from tests.shared import shipped, slide

T = np.arange(600) * 1e-3
LEVELS = np.repeat([0.0, 1.0, 3.0, 10.0, -1.0, -3.0, -10.0, 5.0, -5.0, 0.0, 2.0, -2.0], 50)


def rows_of(name, channels, valves, model=None, **changes):
    """Rows by kind and what they are about, where a position and a pressure were recorded."""
    rig, owner = shipped(name), valves[0].partition(".")[0]
    y = {f"{owner}.{channel}": np.sin(9.0 * T) for channel in channels}
    y |= {f"{valve}.command": LEVELS if name == "slide_servo" else abs(LEVELS) for valve in valves}
    records = [Record(T, y | changes)]
    compared = [f"{owner}.{word}" for word in ("v" if owner == "press" else "qd", "p_head")]
    rig = rig.model_copy(update={"model": model})
    return {(row.kind, row.about): row for row in hypotheses(rig, [owner], compared, records)}


def test_valves_of_a_cylinder_share_what_lies_before_them():
    """Two cartridges with the same dynamics: each by itself, both together."""
    rows = rows_of("boom_four_valve", ("q", "p_head"), ("boom.sh", "boom.rt"))
    both = {about: row for (kind, about), row in rows.items() if kind == "saturation"}
    whole = "the drive of boom.sh", "the drive of boom.rt", "the drive of boom.sh+rt"
    assert both.keys() == {*whole, "boom.sh", "boom.rt", "boom.sh+rt"}
    assert not any(row.alike for row in both.values())
    assert both["the drive of boom.sh+rt"].parameters == (
        "boom.sh.drive_limit",
        "boom.rt.drive_limit",
    )
    late, delay, drift = (rows[kind, "boom.sh+rt"] for kind in ("late command", "delay", "drift"))
    commands = ("boom.sh.command", "boom.rt.command")
    assert late.readings == delay.readings == tuple((c, "delay", 1.0) for c in commands)
    assert drift.readings == tuple((c, "drift", 1.0) for c in commands)
    assert (late.cylinder, late.bounds, late.inside) == ("boom", (-0.05, 0.0), -0.001)
    assert delay.remedy(shipped("boom_four_valve"), 0.01).key == "faults.add_lines"
    added, *lines = delay.edits
    assert delay.parameters == ("boom_delay.delay",) and added[:2] == (("dynamics",), "boom_delay")
    rig = shipped("boom_four_valve")
    owner = [c.name for c in rig.cylinder].index("boom")
    for (place, table, content, _), word in zip(lines, ("sh", "rt"), strict=True):
        item = rig.cylinder[owner].valve[place[3]]
        assert (place[:3], table, item.name) == (("cylinder", owner, "valve"), "", word)
        assert content == {"dynamics": [*item.series, "boom_delay"]}
    assert not any(kind in ("neutral", "command sign") for kind, _ in rows)


def test_a_spool_has_a_neutral_and_parts_that_count_together():
    rows = rows_of("slide_servo", ("x", "p_head"), ("press.servo",))
    assert rows["delay", "press.servo"].parameters == ("press_servo_delay.delay",)
    numbers = {name for row in rows.values() for name in row.parameters}
    assert "press_servo_lag.lag" not in numbers  # of a valve whose dynamics are known
    (number,) = rows["saturation", "the drive of press.servo"].numbers
    assert (number.here, number.unit, number.upper) == (10.0, 10.0, 12.0)
    assert number.starts == (8.5, 6.0)
    assert rows["neutral", "press.servo"].readings == (("press.servo.command", "offset", 10.0),)
    assert rows["command sign", "press.servo"].bounds == (-2.0, 0.0)
    parts = [row for (kind, _), row in rows.items() if kind == "preload"]
    assert [(row.alike, len(row.numbers)) for row in parts] == [(True, 1), (True, 1), (False, 2)]
    assert not rows["overlap", "press.servo"].alike
    # the speed is of the stroke's sensor, whose offset it does not show
    assert ("sensor offset", "press.x") not in rows and ("sensor offset", "press.v") not in rows
    offset = rows["sensor offset", "press.p_head"]
    spread = float(np.std(np.sin(9.0 * T)))
    assert offset.readings == (("press.p_head", "offset", pytest.approx(spread)),)
    scale = rows["sensor scale", "press.x"]
    assert (scale.readings, scale.cylinder) == ((("press.x", "scale", 1.0),), "press")
    assert rows["command sign", "press.servo"].cylinder == "press"
    # an angle's is in weight and levers
    boom = rows_of("crane_proportional", ("q",), ("lift.spool",))
    spread = float(np.std(np.sin(9.0 * T)))
    assert boom["sensor offset", "lift.q"].readings == (
        ("lift.q", "offset", pytest.approx(spread)),
    )
    plain = rows_of("slide_servo", ("p_head",), ("press.servo",))
    assert not any(about in ("press.x", "press.v") for _, about in plain)


@pytest.mark.parametrize(
    ("kind", "bounds", "step", "trials"),
    [  # in spreads of a channel, shares of a scale, seconds, largest commands; a sign is turned
        ("sensor offset", (-3.0, 3.0), 0.02, ()),
        ("sensor scale", (-0.7, 2.0), 0.02, ()),
        ("sensor lag", (0.0, 0.1), 0.002, ()),
        ("sensor sign", (-2.0, 0.0), 0.0, (-2.0,)),
        ("neutral", (-0.2, 0.2), 0.005, ()),
        ("command sign", (-2.0, 0.0), 0.0, (-2.0,)),
        ("late command", (-0.05, 0.0), -0.001, (-0.01, -0.02, -0.04)),
        ("drift", (-0.6, 1.0), 0.02, ()),
    ],
)
def test_how_far_sensors_and_commands_may_be_off(kind, bounds, step, trials):
    rows = rows_of("slide_servo", ("x", "p_head"), ("press.servo",))
    row = next(row for (of, _), row in rows.items() if of == kind)
    assert (row.bounds, abs(row.inside), row.row.trials) == (bounds, abs(step), trials)
    assert row.inside * step >= 0.0


@pytest.mark.parametrize(("share", "drive"), [(1.0, True), (0.0, False)])
def test_a_drive_is_asked_where_commands_of_several_sizes_show_it(share, drive):
    one = np.where(np.abs(LEVELS) == 10.0, LEVELS, share * LEVELS)
    rows = rows_of("slide_servo", ("x",), ("press.servo",), **{"press.servo.command": one})
    assert (("saturation", "the drive of press.servo") in rows) == drive
    still = rows_of("slide_servo", ("x",), ("press.servo",), **{"press.servo.command": 0.0 * T})
    assert not any(about.startswith("press.servo") for _, about in still)


def test_of_an_fmu_is_asked_what_it_takes_and_its_sensors():
    model = Stub(settable=["bulk_modulus"], numbers={})
    rows = rows_of("slide_servo", ("x", "p_head"), ("press.servo",), model=model)
    numbers = {name for row in rows.values() for name in row.parameters}
    assert numbers == {"bulk_modulus"}
    assert {"late command", "sensor lag", "neutral"} <= {kind for kind, _ in rows}
    assert not any(row.edits and not row.readings for row in rows.values())


def test_a_payload_is_asked_of_that_a_log_carries():
    rig, (owner, *_) = shipped("crane_proportional"), shipped("crane_proportional").cylinder
    for load in ("none", *rig.payload):
        log = Record(T, {f"{owner.name}.{owner.valve[0].name}.command": LEVELS}, {"payload": load})
        rows = hypotheses(rig, [owner.name], [], [log])
        about = {row.about.partition(".")[0] for row in rows if row.kind == "payload"}
        assert about == {load} - {"none"}
        assert hypotheses(rig, [], [], [log]) == []


def test_where_a_body_has_its_centre_is_asked_of_joints_and_what_they_carry():
    """To either side by as much as its cylinder is long, also where it is at zero; a slide has
    none. What a payload changes is asked of the logs with it alone."""
    rig = shipped("crane_proportional")
    for load, owners in ((None, ("arm",)), ("200 kg", ("arm", "200 kg.arm"))):
        meta = {} if load is None else {"payload": load}
        log = Record(T, {"lift.spool.command": LEVELS}, meta)
        rows = {
            row.about: row for row in hypotheses(rig, ["lift"], [], [log]) if "centre" in row.kind
        }
        assert list(rows) == [f"{owner}.com_{axis}" for owner in owners for axis in "xyz"]
        for about, row in rows.items():
            (number,) = row.numbers
            assert row.bounds == (-1.0, 1.0) and number.unit == number.upper == 0.6
            moved = row.rig(rig, -0.5).parameters()[about]
            assert float(moved) == pytest.approx(number.here - 0.3)
    kinds = {
        row.kind
        for row in hypotheses(slide(), ["press"], [], [Record(T, {"press.servo.command": LEVELS})])
    }
    assert "load" in kinds and not {"inertia", "centre of mass"} & kinds


@pytest.mark.parametrize(
    ("given", "kind", "keys"),
    [
        (None, "air", ["air", "air"]),
        (0.02, "air fraction", ["air_fraction_less", "air_fraction_more"]),
    ],
)
def test_free_air_is_asked_as_what_the_rig_file_has_of_it(given, kind, keys):
    """None yet, or more or less than what is written."""
    share = None if given is None else Value(given, "dimensionless")
    rig = shipped("slide_servo")
    rig = rig.model_copy(update={"oil": rig.oil.model_copy(update={"air_fraction": share})})
    rows = hypotheses(rig, ["press"], [], [Record(T, {"press.servo.command": LEVELS})])
    (row,) = [row for row in rows if row.kind.startswith("air")]
    assert row.kind == kind
    assert [row.sentence(rig, d).key for d in (-0.1, 0.1)] == [f"faults.{key}" for key in keys]


def test_of_a_spool_whose_flows_are_measured_the_other_edge_is_asked():
    """A gain is of the valve, what no more opening adds is of the edge; an underlap stands for a
    deadband."""
    rig = shipped("slide_servo")
    names = [rig.cylinder[0].valve[0].edge_name(edge) for edge in rig.cylinder[0].valve[0].edge]
    log = Record(T, {"press.servo.command": LEVELS})
    rows = hypotheses(rig, ["press"], [], [log], dict.fromkeys(names[1:], Stub()))
    about = {row.kind: [] for row in rows}
    for row in rows:
        about[row.kind].append(row.about)
    assert about["deadband"] == ["press.servo"] and "overlap" not in about
    assert about["gain"][0] == "press.servo" and len(about["gain"]) == len(names)
    assert {*about["saturation"]} == {f"press.{names[0]}", "the drive of press.servo"}
    whole = rig.as_toml()
    for edge in whole["cylinder"][0]["valve"][0]["edge"][:1]:
        edge.pop("deadband", None)
        edge["underlap"] = "0.2 V"
    rows = hypotheses(Rig.model_validate(whole), ["press"], [], [log])
    numbers = {kind: {n for row in rows if row.kind == kind for n in row.parameters}
               for kind in ("deadband", "underlap")}  # fmt: skip
    assert numbers["underlap"] == {f"press.{names[0]}.underlap"}
    assert numbers["deadband"] == {f"press.{name}.deadband" for name in names[1:]}


def test_a_spring_on_the_rod_that_nobody_wrote_down():
    """Asked of a cylinder without forces, and gone where its rig file has one."""
    rows = rows_of("slide_servo", ("x", "p_head"), ("press.servo",))
    row, rig = rows["outer spring", "press"], shipped("slide_servo")
    assert row.parameters == ("press.force.stiffness", "press.force.free_length")
    (spring,) = row.rig(rig, 0.01).cylinder[0].force
    assert (spring.kind, float(spring.free_length)) == ("spring", pytest.approx(0.2))
    assert float(spring.stiffness) == pytest.approx(0.01 * row.numbers[0].unit)
    assert row.rig_lines(rig)[0].startswith("# in [[cylinder]] press:\nforce = [{ kind =")
    record = Record(T, {"press.servo.command": LEVELS})
    asked = hypotheses(row.altered(rig), ["press"], [], [record])
    kinds = {(item.kind, item.about) for item in asked if "spring" in item.kind}
    assert kinds == {("spring", "press.force.stiffness"), ("spring", "press.force.free_length")}


def test_an_overlap_leaves_the_null_that_the_rig_file_has():
    record = Record(T, {"press.servo.command": LEVELS})
    valve = slide().as_toml()["cylinder"][0]["valve"][0]
    rig = slide(valve=[valve | {"null": "0.05 V"}])
    rows = {row.kind: row for row in hypotheses(rig, ["press"], [], [record])}
    altered = rows["overlap"].rig(rig, 0.02).cylinder[0].valve[0]
    assert float(altered.null or 0.0) == 0.05 and float(altered.overlap or 0.0) > 0.1
    assert rows["overlap"].starts[0]["press.servo.null"] == 0.05


def test_a_rod_through_both_ends_that_nobody_wrote_down():
    """Asked of a bore and a rod, and gone where the rig file has it."""
    rows, rig = rows_of("slide_servo", ("x",), ("press.servo",)), shipped("slide_servo")
    row = rows["through rod", "press"]
    head, rod = row.rig(rig, 1.0).cylinder[0].areas()
    assert head == rod == rig.cylinder[0].areas()[1]
    assert row.rig_lines(rig) == ("# in [[cylinder]] press:\nthrough_rod = true",)
    log = Record(T, {"press.servo.command": LEVELS})
    written = hypotheses(slide(through_rod=True), ["press"], [], [log])
    assert all(item.kind != "through rod" for item in written)


@pytest.mark.parametrize("coulomb", [0.0, 300.0, 900.0])
@pytest.mark.parametrize("kind", ["friction law", "sticking"])
def test_the_lines_of_a_friction_law_make_a_rig_file(kind, coulomb):
    """As they are: friction in motion is no more than at break-away, whatever the rig has of it."""
    rig, log = slide(friction_coulomb=f"{coulomb} N"), Record(T, {"press.servo.command": LEVELS})
    row = next(row for row in hypotheses(rig, ["press"], [], [log]) if row.kind == kind)
    (number,) = (n for n in row.numbers if n.unit)
    (block,) = row.rig_lines(rig, (700.0 - number.here) / number.unit)
    owner, lines = rig.as_toml()["cylinder"][0], tomllib.loads(block)
    written = Rig.model_validate(rig.as_toml() | {"cylinder": [owner | lines]}).cylinder[0]
    assert float(written.friction.friction_static) == pytest.approx(700.0)
    assert float(written.friction_coulomb) == pytest.approx(min(coulomb or 700.0, 700.0))


def test_a_link_that_was_weighed_wrongly_is_wrong_under_its_loads_too():
    """By as many kilograms: each payload states the mass of the link with it."""
    rig = shipped("slide_servo")
    logs = [
        Record(T, {"press.servo.command": LEVELS}, {"payload": load} if load else {})
        for load in (None, "100 kg")
    ]
    row = {row.kind: row for row in hypotheses(rig, ["press"], [], logs)}["load"]
    before, after = rig.parameters(), row.rig(rig, -0.1).parameters()
    names = "carriage.mass", "100 kg.carriage.mass"
    assert row.parameters == names
    less = [float(before[name]) - float(after[name]) for name in names]
    assert less == pytest.approx(2 * [0.1 * float(before["carriage.mass"])])
    alone = {row.kind: row for row in hypotheses(rig, ["press"], [], logs[:1])}["load"]
    assert alone.parameters == names[:1]
