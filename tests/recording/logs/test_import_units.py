"""Units that the names of channels state: written by a suggested map, and asked for where a map has none."""

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.cli import main
from concent_warp.recording.logs.suggest import suggest_map
from concent_warp.recording.logs.targets import targets_of
from concent_warp.recording.logs.units import contrary_unit, named_unit, stated_unit

TURNTABLE = """<mujoco><worldbody><body><joint name="axis" {kind}/><geom size="0.1" mass="1"/></body></worldbody>
<actuator>{actuator}</actuator><sensor><jointpos name="encoder" joint="axis"/></sensor></mujoco>"""
HINGE, SLIDE = 'type="hinge" axis="0 0 1"', 'type="slide" axis="0 0 1"'
TIME = np.arange(0, 2, 0.01)
COMMAND = ["import", "log.csv", "--model", "robot.xml", "--map", "map.toml"]


def scene(actuator: str, kind: str = HINGE) -> str:
    """Return the MJCF of one joint with an actuator, such as ``velocity kv="1"``."""
    name, _, more = actuator.partition(" ")
    return TURNTABLE.format(kind=kind, actuator=f'<{name} name="drive" joint="axis" {more}/>')


def write(place, column: str, actuator: str, kind: str = HINGE, measured: str = "angle_rad") -> None:
    (place / "robot.xml").write_text(scene(actuator, kind))
    rows = [f"{t:.2f},{30 * np.sin(3 * t):.4f},{0.3 * np.sin(3 * t):.5f}" for t in TIME]
    (place / "log.csv").write_text("\n".join([f"t,{column},{measured}", *rows]))


@pytest.mark.parametrize(
    ("actuator", "kind", "quantity"),
    [
        ('position kp="3"', HINGE, "angle"),
        ('position kp="3" kv="1"', SLIDE, "length"),
        ('position kp="3" timeconst="0.1"', HINGE, "angle"),
        ('velocity kv="2"', HINGE, "angular velocity"),
        ('velocity kv="2"', SLIDE, "velocity"),
        ('intvelocity kp="3" actrange="-1 1"', HINGE, "angular velocity"),
        ("motor", HINGE, "torque"),
        ("motor", SLIDE, "force"),
        ('motor gear="50"', HINGE, "any"),
        ('velocity kv="2" gear="50"', HINGE, "any"),
        ('general gainprm="3"', HINGE, "any"),
        ('general gainprm="3" biastype="affine" biasprm="0 -2 0"', HINGE, "any"),
        ('damper kv="2" ctrlrange="0 1"', HINGE, "any"),
    ],
)
def test_a_command_has_the_quantity_that_its_actuator_sets(actuator, kind, quantity):
    target = targets_of(cw.Scene(scene(actuator, kind)).model)[0]["drive"]
    assert (target.quantity, target.position) == (quantity, quantity in ("angle", "length"))


@pytest.mark.parametrize(
    ("column", "actuator", "kind", "unit", "si"),
    [
        ("speed_cmd_rpm", 'velocity kv="2"', HINGE, "rpm", "rad/s"),
        ("drive_cmd_deg_s", 'velocity kv="2"', HINGE, "deg/s", "rad/s"),
        ("cmd (deg/s)", 'velocity kv="2"', HINGE, "deg/s", "rad/s"),
        ("cmd_mm_per_sec", 'velocity kv="2"', SLIDE, "mm/s", "m/s"),
        ("cmd_deg", 'position kp="2"', HINGE, "deg", "rad"),
        ("cmd_mm", 'position kp="2"', SLIDE, "mm", "m"),
        ("cmd_mNm", "motor", HINGE, "mNm", "Nm"),
        ("cmd_mN", "motor", SLIDE, "mN", "N"),
        ("cmd_rpm", 'velocity kv="2" gear="50"', HINGE, "rpm", ""),
    ],
)
def test_a_unit_in_the_name_of_a_command_is_suggested_and_must_be_stated(
    tmp_path, monkeypatch, capsys, column, actuator, kind, unit, si
):
    monkeypatch.chdir(tmp_path)
    write(tmp_path, column, actuator, kind, measured="encoder")
    text = suggest_map("log.csv", "robot.xml")
    assert f'source = "{column}"\nunit = "{unit}"\n' in text
    (tmp_path / "map.toml").write_text(text)
    assert main([*COMMAND, "--dry-run"]) == 0
    assert "nothing is wrong" in capsys.readouterr().out
    (tmp_path / "map.toml").write_text(text.replace(f'unit = "{unit}"\n', ""))
    other = f'unit = "{si}" if its values are in {si}' if si else "the unit that holds"
    for option in (["--dry-run"], ["-o", "demo.h5"]):
        assert main([*COMMAND, *option]) == 2
        assert (
            f"map.toml, [action.drive]: its name states {unit}, and the map no unit; expected a unit or a scale, found "
            f'{column}; write unit = "{unit}" in the map, or {other}.'
        ) in capsys.readouterr().err
    scaled = text.replace(f'unit = "{unit}"\n', "scale = 0.01\n")
    (tmp_path / "map.toml").write_text(scaled)
    assert main([*COMMAND, "-o", "demo.h5"]) == 0


@pytest.mark.parametrize(
    ("column", "actuator", "kind", "unit"),
    [
        ("motor_N", "motor", SLIDE, "N"),
        ("cmd_Nm", "motor", HINGE, "Nm"),
        ("cmd_rad", 'position kp="2"', HINGE, None),
        ("cmd_rad_s", 'velocity kv="2"', HINGE, "rad/s"),
        ("cmd_ms", 'velocity kv="2"', SLIDE, "m/s"),
    ],
)
def test_a_unit_of_si_in_a_name_is_suggested_unless_the_values_contradict_it(tmp_path, column, actuator, kind, unit):
    measured, si = ("angle_rad", "rad") if kind == HINGE else ("place_m", "m")
    write(tmp_path, column, actuator, kind, measured)
    text = suggest_map(tmp_path / "log.csv", tmp_path / "robot.xml")
    if unit is None:
        assert f', may be a percentage\nsource = "{column}"\nunit = "deg"' in text
    else:
        assert f'source = "{column}"\nunit = "{unit}"\n' in text
    assert f'source = "{measured}"\nunit = "{si}"\n' in text


def test_a_unit_of_another_quantity_is_said_and_refused(tmp_path):
    write(tmp_path, "cmd_rpm", "motor")
    text = suggest_map(tmp_path / "log.csv", tmp_path / "robot.xml")
    assert "[action.drive]  # guess: by order, its name states rpm, which is no unit of torque\n" in text
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(
        cw.RecordingError,
        match=r"\[action.drive\]: its name states rpm, which is no unit of torque, and the map no unit; "
        r'expected a channel in Nm, or a scale, found cmd_rpm; map another channel, or write unit = "Nm" if',
    ):
        cw.import_log(tmp_path / "log.csv", tmp_path / "robot.xml", mapping=tmp_path / "map.toml")


@pytest.mark.parametrize(("drive", "unit"), [("motor", ""), ('motor ctrlrange="-1 1"', "signed_percent")])
def test_a_percentage_is_of_the_range_of_the_control(tmp_path, drive, unit):
    write(tmp_path, "cmd_percent", drive)
    text = suggest_map(tmp_path / "log.csv", tmp_path / "robot.xml")
    stated = unit or "signed_percent"
    assert f'source = "cmd_percent"\nunit = "{stated}"\n' in text
    assert ("the scene has no range" in text) == (not unit)


@pytest.mark.parametrize(
    ("name", "quantity", "unit"),
    [
        ("v_deg_s", "angular velocity", "deg/s"),
        ("v_deg", "angular velocity", "deg/s"),
        ("wheel/deg/s", "angular velocity", "deg/s"),
        ("w_rev_min", "angular velocity", "rpm"),
        ("a_deg_s2", "angular acceleration", "deg/s^2"),
        ("a (m/s^2)", "acceleration", "m/s^2"),
        ("acc_g", "acceleration", "g"),
        ("torque_mNm", "torque", "mNm"),
        ("torqueNm", "torque", "Nm"),
        ("torque_N_m", "torque", "Nm"),
        ("axis_turns", "angle", "turn"),
        ("turn", "angle", None),
        ("grip_g", "force", None),
        ("deg", "angle", "deg"),
        ("cell_N", "any", None),
    ],
)
def test_units_of_one_or_several_words_are_read(name, quantity, unit):
    assert stated_unit(name, quantity) == unit
    assert named_unit(name, quantity) == (None if unit in ("Nm", "m/s^2") else unit)
    assert contrary_unit(name, quantity) is None


def test_words_that_may_say_other_things_contradict_no_quantity():
    assert contrary_unit("finger_n", "angle") is None
    assert contrary_unit("camera_turn", "length") is None
    assert contrary_unit("delay_ms", "angle") is None
    assert contrary_unit("speed_rpm", "angle") == "rpm"
    assert contrary_unit("q_deg", "orientation") is None
    assert contrary_unit("speed_rpm", "any") is None
