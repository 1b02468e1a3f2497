"""Conventions of the names of columns by which a first map is suggested, and what is left out as not clear."""

import pytest

from concent_warp.cli import main
from concent_warp.recording.logs.channel_names import agreement, parsed
from concent_warp.recording.logs.suggest import suggest_map

LEG = """<mujoco><worldbody><body name="thigh"><joint name="hip" axis="0 1 0"/><geom size="0.1" mass="1"/>
<site name="ft"/><body name="shank"><joint name="knee" axis="0 1 0"/><geom size="0.1" mass="1"/></body></body>
</worldbody><actuator>{actuators}</actuator><sensor>{sensors}</sensor></mujoco>"""
MOTORS = '<motor name="hip" joint="hip"/><motor name="knee" joint="knee"/>'
SERVOS = '<position name="hip" joint="hip" kp="9"/><position name="knee" joint="knee" kp="9"/>'
POSITIONS = '<jointpos name="hip_position" joint="hip"/><jointpos name="knee_position" joint="knee"/>'
VELOCITIES = '<jointvel name="hip_velocity" joint="hip"/><jointvel name="knee_velocity" joint="knee"/>'
WRENCH = '<force name="ft_force" site="ft"/><torque name="ft_torque" site="ft"/>'
NONE = "no channel found"


def suggested(place, columns: str, actuators: str = "", sensors: str = POSITIONS + VELOCITIES) -> str:
    (place / "leg.xml").write_text(LEG.format(actuators=actuators, sensors=sensors))
    names = columns.split(",")
    rows = [",".join([f"{0.01 * t:.2f}", *(f"{0.001 * t + 0.1 * k:.4f}" for k in range(len(names)))]) for t in range(9)]
    (place / "log.csv").write_text("\n".join([f"t,{columns}", *rows]))
    return suggest_map(place / "log.csv", place / "leg.xml")


@pytest.mark.parametrize(
    "column",
    ["q_hip", "qpos_hip", "hip.pos", "hip-position", "hipAngle", "theta hip", "HipPos", "hip/q", "q_hip_meas",
     "act_hip_pos", "hip_actual_position", "state_hip", "hip_fb", "feedback.hip", "hip_enc", "hipEncoder_deg",
     "hip_joint_pos", "current_hip_position", "hip_rad", "joint_hip"],
)  # fmt: skip
def test_columns_of_positions(tmp_path, column):
    text = suggested(tmp_path, f"{column},other,more")
    assert f'[measured.hip_position]\nsource = "{column}"\n' in text
    assert ('unit = "deg"' in text) == column.endswith("deg")


@pytest.mark.parametrize(
    "column",
    ["dq_hip", "qd_hip", "hip_qvel", "velHip", "hip.velocity", "hip-speed", "omega hip", "hip_vel_meas", "q_dot_hip",
     "hip_rpm", "hip_deg_s", "rpm_hip", "hip_vel_rad_s", "act_speed_hip_deg", "hipThetaDot", "encoder_vel_hip"],
)  # fmt: skip
def test_columns_of_velocities_are_those_of_velocity_sensors_alone(tmp_path, column):
    text = suggested(tmp_path, f"{column},q_hip,other,more")
    assert f'[measured.hip_velocity]\nsource = "{column}"\n' in text
    assert '[measured.hip_position]\nsource = "q_hip"\n' in text
    assert f"# [measured.hip_position]  # {NONE}" in suggested(tmp_path, f"{column},other", "", POSITIONS)


@pytest.mark.parametrize(
    "column",
    ["cmd_hip", "hip_command", "hip.target", "desHip", "hip_desired", "hip_ref", "q_ref_hip", "hip-setpoint",
     "setPoint hip", "action/hip.pos", "u_hip", "hip_q_des", "pos_cmd_hip", "hipGoal", "hip_ctrl"],
)  # fmt: skip
def test_columns_of_commands_are_those_of_actuators_alone(tmp_path, column):
    text = suggested(tmp_path, f"{column},q_hip,other", SERVOS)
    assert f'[action.hip]\nsource = "{column}"\n' in text
    assert '[measured.hip_position]\nsource = "q_hip"\n' in text
    assert f"# [measured.hip_position]  # {NONE}" in suggested(tmp_path, f"{column},other", SERVOS)


@pytest.mark.parametrize("column", ["tau_hip", "hip_torque", "hipEffort", "force_hip", "hip_Nm", "hip_torque_mNm"])
def test_torques_are_those_of_motors_where_none_is_called_a_command(tmp_path, column):
    text = suggested(tmp_path, f"{column},q_hip,other", MOTORS)
    assert f'[action.hip]  # guess: no name says command\nsource = "{column}"\n' in text
    for columns, actuators in ((column, SERVOS), (f"{column}_meas", MOTORS), (f"{column},hip_cmd", MOTORS)):
        text = suggested(tmp_path, f"{columns},q_hip,other", actuators)
        assert f'source = "{column}' not in text


@pytest.mark.parametrize(
    "column", ["current_hip", "hip_current_cmd", "hip_temp", "hip_vel_cmd", "hip_pos_cmd", "speed_hip"]
)
def test_what_is_no_torque_is_no_command_of_a_motor(tmp_path, column):
    text = suggested(tmp_path, f"{column},q_hip,other,more", MOTORS, POSITIONS)
    assert f"# [action.hip]  # {NONE}\n" in text
    assert f"#   {column}\n" in text


def test_a_leg_is_mapped_by_prefixes(tmp_path):
    text = suggested(tmp_path, "tau_hip,tau_knee,q_hip,q_knee,dq_hip,dq_knee", MOTORS)
    assert NONE not in text
    assert "not mapped" not in text
    assert text.count("guess") == 2


def test_numbers_of_joints_match_where_they_count_from_the_same(tmp_path):
    sensors = POSITIONS.replace('joint="hip"', 'joint="joint1"').replace('joint="knee"', 'joint="joint_2"')
    leg = LEG.replace('"hip"', '"joint1"').replace('"knee"', '"joint_2"')
    for columns, guess in (("q1,q2", ""), ("q0,q1", "  # guess: by order"), ("q2,q1", "")):
        suggested(tmp_path, columns)
        (tmp_path / "leg.xml").write_text(leg.format(actuators="", sensors=sensors))
        text = suggest_map(tmp_path / "log.csv", tmp_path / "leg.xml")
        one = "q0" if guess else "q1"
        assert f'[measured.hip_position]{guess}\nsource = "{one}"\n' in text


def test_names_that_differ_in_their_unit_alone_match_though_they_name_a_role_or_a_load(tmp_path):
    sensors = '<jointpos name="motor_encoder" joint="hip"/><jointpos name="load_encoder" joint="knee"/>'
    text = suggested(tmp_path, "load_encoder_deg,cmd_servo,motor_encoder_deg", "", sensors)
    for name in ("motor", "load"):
        assert f'[measured.{name}_encoder]\nsource = "{name}_encoder_deg"\nunit = "deg"\n' in text


def test_order_does_not_give_a_channel_to_one_joint_that_is_named_after_another(tmp_path):
    text = suggested(tmp_path, "hip_cmd,tau_hip,q_hip,q_knee", MOTORS, POSITIONS)
    assert f"# [action.knee]  # {NONE}\n" in text
    assert "#   tau_hip\n" in text
    text = suggested(tmp_path, "hip_cmd,q_hip,hip_position_2,hip_position", SERVOS, POSITIONS)
    assert f"# [measured.knee_position]  # {NONE}\n" in text


def test_a_letter_that_is_also_a_unit_tells_names_apart(tmp_path):
    sensors = POSITIONS.replace("hip_position", "finger_n").replace("knee_position", "finger_m")
    text = suggested(tmp_path, "finger_m,finger_n", "", sensors)
    for name in ("finger_m", "finger_n"):
        assert f'[measured.{name}]\nsource = "{name}"\n' in text


@pytest.mark.parametrize(
    ("columns", "sensors", "said"),
    [
        ("q_hip,hip_angle,other", POSITIONS, "[measured.hip_position]  # {}: q_hip and hip_angle fit equally well"),
        ("hip,q_hip,hip_fb", POSITIONS, "[measured.hip_position]  # {}: hip, q_hip and 1 more fit equally well"),
        ("a/hip,b/hip,c", POSITIONS, "[measured.hip_position]  # {}: a/hip and b/hip fit equally well"),
        (
            "q_hip,other",
            '<jointpos name="p" joint="hip"/><jointpos name="r" joint="hip"/>',
            "[measured.p]  # {}: q_hip fits [measured.p] and [measured.r] equally well",
        ),
        (
            "tau_hip,q_hip,other",
            '<jointactuatorfrc name="hip_load" joint="hip"/>',
            "[action.hip]  # {}: tau_hip fits [measured.hip_load] and [action.hip] equally well",
        ),
        ("cmd_hip,hip_des,other", POSITIONS, "[action.hip]  # {}: cmd_hip and hip_des fit equally well"),
        ("a_fx,a_fy,a_fz,b_fx,b_fy,b_fz", WRENCH, "[measured.ft_force]  # {}: a_fx and b_fx fit equally well"),
        (
            "fx,fy,fz,ft_l_tx,ft_l_ty,ft_l_tz,ft_r_tx,ft_r_ty,ft_r_tz",
            WRENCH,
            "[measured.ft_torque]  # {}: ft_l_tx and ft_r_tx fit equally well",
        ),
    ],
)
def test_of_two_equally_good_matches_none_is_taken_and_both_are_said(tmp_path, columns, sensors, said):
    text = suggested(tmp_path, columns, MOTORS, sensors)
    entry = said.format(NONE)
    if "and [action.hip]" in said:
        entry = entry.replace("[measured.hip_load] and [action.hip]", "[action.hip] and [measured.hip_load]")
    assert f"# {entry}\n" in text
    assert f'source = "{columns.split(",")[0]}"' not in text


@pytest.mark.parametrize(
    ("force", "torque", "guess"),
    [
        ("fx,fy,fz", "tx,ty,tz", True),
        ("Fx,Fy,Fz", "Mx,My,Mz", True),
        ("fx_N,fy_N,fz_N", "tx_Nm,ty_Nm,tz_Nm", True),
        ("force_x,force_y,force_z", "torque_x,torque_y,torque_z", True),
        ("x_force,y_force,z_force", "torqueX,torqueY,torqueZ", True),
        (
            "wrench_force_x,wrench_force_y,wrench_force_z",
            "wrench.torque.x,wrench.torque.y,wrench.torque.z",
            True,
        ),
        (
            "/ft/wrench/force/x,/ft/wrench/force/y,/ft/wrench/force/z",
            "/ft/wrench/torque/x,/ft/wrench/torque/y,/ft/wrench/torque/z",
            False,
        ),
        ("ft_fx [mN],ft_fy [mN],ft_fz [mN]", "ft_tx [mNm],ft_ty [mNm],ft_tz [mNm]", False),
    ],
)
def test_columns_of_a_wrench(tmp_path, force, torque, guess):
    text = suggested(tmp_path, f"q_hip,q_knee,{torque},{force}", "", POSITIONS + WRENCH) + "\n"
    remark = "  # guess: the only ones" if guess else ""
    for kind, columns, unit in (("force", force, "mN"), ("torque", torque, "mNm")):
        listed = ", ".join(f'"{one}"' for one in columns.split(","))
        stated = f'unit = "{unit}"\n' if "mN" in columns else ""
        assert f"[measured.ft_{kind}]{remark}\nsource = [{listed}]\n{stated}\n" in text


@pytest.mark.parametrize(
    ("columns", "sensor", "source"),
    [
        ("fz", WRENCH, '[measured.ft_force]  # guess: the only ones, not all components are in the log\n{}"fz"]'),
        ("ft_torque_z", WRENCH, '[measured.ft_torque]  # guess: not all components are in the log\n{}"ft_torque_z"]'),
        ("imu_acc_z", '<accelerometer name="imu" site="ft"/>',
         '[measured.imu]  # guess: not all components are in the log\n{}"imu_acc_z"]'),
        ("shank_z_mm", '<framepos name="end" objtype="body" objname="shank"/>',
         '[measured.end]  # guess: not all components are in the log\n{}"shank_z_mm"]\nunit = "mm"'),
        ("height_mm", '<framepos name="end" objtype="body" objname="shank"/>',
         '[measured.end]  # guess: the only ones, not all components are in the log\n{}"height_mm"]\nunit = "mm"'),
    ],
)  # fmt: skip
def test_one_part_of_a_vector_is_enough(tmp_path, columns, sensor, source):
    text = suggested(tmp_path, f"q_hip,q_knee,{columns}", "", POSITIONS + sensor)
    assert source.format('source = ["", "", ') in text


@pytest.mark.parametrize(
    ("prefix", "tag"),
    [("gyro_", "gyro"), ("w", "gyro"), ("angular_velocity_", "gyro"), ("twist.angular.", "gyro"),
     ("a", "accelerometer"), ("linear_acceleration.", "accelerometer"), ("v", "velocimeter"),
     ("twist.linear.", "velocimeter"), ("vel_", "velocimeter")],
)  # fmt: skip
def test_columns_of_other_vectors(tmp_path, prefix, tag):
    sensors = "".join(f'<{one} name="s_{one}" site="ft"/>' for one in ("gyro", "accelerometer", "velocimeter"))
    text = suggested(tmp_path, f"{prefix}x,{prefix}y,{prefix}z,other", "", sensors)
    listed = ", ".join(f'"{prefix}{axis}"' for axis in "xyz")
    assert f"[measured.s_{tag}]" in text.partition(f"source = [{listed}]\n")[0][-60:]
    assert text.count(NONE) == 2


def test_translations_are_not_taken_for_torques_nor_parts_of_a_wrench_for_joints(tmp_path):
    place = '<framepos name="end" objtype="body" objname="shank"/>'
    text = suggested(tmp_path, "tx,ty,tz", "", WRENCH + place)
    assert f"# [measured.ft_torque]  # {NONE}: tx fits [measured.ft_torque] and [measured.end] equally well\n" in text
    assert f"# [measured.end]  # {NONE}" in text
    text = suggested(tmp_path, "tx_mm,ty_mm,tz_mm", "", WRENCH + place)
    assert '[measured.end]  # guess: the only ones\nsource = ["tx_mm", "ty_mm", "tz_mm"]\nunit = "mm"' in text
    sensors = POSITIONS + '<jointpos name="third" joint="hip"/>'
    assert text != (text := suggested(tmp_path, "fx,fy,fz", "", sensors))
    assert '"fx"' not in text
    assert '"fx"' not in suggested(tmp_path, "fx,q_hip", "", POSITIONS.replace("knee_position", "other"))


def test_channels_of_other_quantities_do_not_hinder_the_one_left_for_the_one_actuator(tmp_path):
    motor = '<motor name="force" joint="hip"/>'
    text = suggested(tmp_path, "motor_N,q_hip,q_knee,dq_hip,temp_hip,mode", motor, POSITIONS)
    assert '[action.force]  # guess: by order, no name says command\nsource = "motor_N"\n' in text
    for columns in ("motor_N,spring_N", "motor_N,cmd_a,cmd_b", "motor_N_meas", "u,v"):
        text = suggested(tmp_path, f"{columns},q_hip,q_knee,dq_hip", motor, POSITIONS)
        assert f"# [action.force]  # {NONE}" in text, columns


@pytest.mark.parametrize(
    ("name", "quantity", "role"),
    [
        ("hip_pos_deg_s", "other", ""),
        ("position_error", "other", ""),
        ("current", "other", ""),
        ("current_position", "position", "measured"),
        ("Present_Load", "effort", "measured"),
        ("load_pos", "position", ""),
        ("/joint_states/velocity/hip", "velocity", ""),
        ("observation.state/hip.pos", "position", "measured"),
        ("u", "", ""),
        ("reaction_force", "effort", ""),
        ("speed_deg", "velocity", ""),
        ("target_actual", "", "command"),
    ],
)
def test_what_a_name_says(name, quantity, role):
    assert (parsed(name).quantity, parsed(name).role) == (quantity, role)


def test_agreement_is_graded():
    graded = ["shoulder_q", "q_shoulder", "shoulder_angle", "shoulder_motor_pos", "elbow_q"]
    assert [agreement(one, "shoulder_q", "shoulder") for one in graded] == [0, 1, 2, 4, None]


def test_a_suggestion_says_what_is_not_clear(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "300")
    suggested(tmp_path, "q_hip,hip_angle,q_knee", "", POSITIONS)
    assert main(["import", "log.csv", "--model", "leg.xml", "--map", "map.toml", "--suggest"]) == 0
    said = "no channel for [measured.hip_position]: q_hip and hip_angle fit equally well\n1 guesses or gaps"
    assert said in capsys.readouterr().out


def test_a_dry_run_says_what_is_left_and_what_to_write(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "500")
    suggested(tmp_path, "a,b,fx,fy,fz", '<motor name="hip" joint="hip"/>', POSITIONS + WRENCH)
    command = ["import", "log.csv", "--model", "leg.xml", "--map", "map.toml"]
    write = (
        'for each that the log has, write [action.hip] and below it source = "CHANNEL", '
        '[measured.ft_force] and below it source = ["CHANNEL_X", "CHANNEL_Y", "CHANNEL_Z"]'
    )
    left = "[measured.knee_position], [measured.ft_force], [measured.ft_torque]"
    (tmp_path / "map.toml").write_text("# nothing yet\n")
    for option in (["--dry-run"], ["-o", "demo.h5"]):
        assert main([*command, *option]) == 2
        said = (
            f"map.toml: the map is empty; expected [action.hip], [measured.hip_position], {left}, "
            f"found no entry, and in the log a, b, fx, fy, fz; {write}.\n"
        )
        assert said in capsys.readouterr().err
    (tmp_path / "map.toml").write_text('[measured]\nhip_position = "a"\n')
    assert main([*command, "--dry-run"]) == 2
    said = f"not mapped: b, fx, fy, fz\nwithout a channel: [action.hip], {left}; {write}\n"
    assert said in capsys.readouterr().out
