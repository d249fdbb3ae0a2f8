"""The rows of the fault table that a rig and its logs have, without a simulation."""

from types import SimpleNamespace as Stub

import numpy as np
import pytest

from ehbench.data.record import Record
from ehbench.diagnosis.faults import hypotheses
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
    assert {about: row.level for about, row in both.items()} == {
        "the drive of boom.sh": 1, "the drive of boom.rt": 1, "the drive of boom.sh+rt": 2,
        "boom.sh": 1, "boom.rt": 1, "boom.sh+rt": 2,
    }  # fmt: skip
    assert both["the drive of boom.sh+rt"].parameters == (
        "boom.sh.drive_limit",
        "boom.rt.drive_limit",
    )
    late, delay, drift = (rows[kind, "boom.sh+rt"] for kind in ("late command", "delay", "drift"))
    commands = ("boom.sh.command", "boom.rt.command")
    assert late.readings == delay.readings == tuple((c, "delay", 1.0) for c in commands)
    assert drift.readings == tuple((c, "drift", 1.0) for c in commands)
    assert (late.cylinder, late.bounds, late.inside) == ("boom", (-0.05, 0.0), -0.001)
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
    assert rows["neutral", "press.servo"].readings == (("press.servo.command", "offset", 10.0),)
    assert rows["command sign", "press.servo"].bounds == (-2.0, 0.0)
    parts = [row for (kind, _), row in rows.items() if kind == "preload"]
    assert [(row.level, len(row.numbers)) for row in parts] == [(0, 1), (0, 1), (1, 2)]
    assert rows["overlap", "press.servo"].level == 1
    # the speed is of the stroke's sensor, whose offset it does not show
    assert ("sensor offset", "press.x") not in rows and ("sensor offset", "press.v") not in rows
    offset = rows["sensor offset", "press.p_head"]
    spread = float(np.std(np.sin(9.0 * T)))
    assert offset.readings == (("press.p_head", "offset", pytest.approx(spread)),)
    assert rows["sensor scale", "press.x"].readings == (("press.x", "scale", 1.0),)
    plain = rows_of("slide_servo", ("p_head",), ("press.servo",))
    assert not any(about in ("press.x", "press.v") for _, about in plain)


@pytest.mark.parametrize(("share", "drive"), [(1.0, True), (0.0, False)])
def test_a_drive_is_asked_where_commands_of_several_sizes_show_it(share, drive):
    one = np.where(np.abs(LEVELS) == 10.0, LEVELS, share * LEVELS)
    rows = rows_of("slide_servo", ("x",), ("press.servo",), **{"press.servo.command": one})
    assert (("saturation", "the drive of press.servo") in rows) == drive
    still = rows_of("slide_servo", ("x",), ("press.servo",), **{"press.servo.command": 0.0 * T})
    assert not any(about.startswith("press.servo") for _, about in still)


def test_of_an_fmu_is_asked_what_it_takes_and_its_sensors():
    model = Stub(settable=["bulk_modulus", "carriage.mass"], numbers={})
    rows = rows_of("slide_servo", ("x", "p_head"), ("press.servo",), model=model)
    numbers = {name for row in rows.values() for name in row.parameters}
    assert numbers == {"bulk_modulus", "carriage.mass"}
    assert {"late command", "sensor lag", "neutral"} <= {kind for kind, _ in rows}
    assert not any(row.edits and not row.readings for row in rows.values())


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
