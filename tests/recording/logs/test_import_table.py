"""Tables of numbers, as most robots' own loggers write them."""

import tracemalloc

import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.recording.load import load_recording
from concent_warp.recording.logs.import_log import import_log
from concent_warp.recording.logs.readers.csv_table import table_signals
from concent_warp.recording.logs.readers.kinds import log_sources
from concent_warp.recording.logs.suggest import suggest_map
from concent_warp.recording.logs.units import named_unit

SCENE = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0" range="-2 2"/><geom size="0.1" mass="1"/></body>
<body name="block" pos="0 0 1"><freejoint/><geom size="0.1"/></body></worldbody>
<actuator><position name="hinge" joint="hinge" kp="5"/></actuator>
<sensor><jointpos name="hinge_position" joint="hinge"/><framepos name="block_position" objtype="xbody" objname="block"/>
<framequat name="block_orientation" objtype="xbody" objname="block"/></sensor></mujoco>"""
MAP = """[action.hinge]
source = "cmd_hinge"
unit = "deg"
[measured.hinge_position]
source = "hinge"
unit = "deg"
[measured.block_position]
source = ["x", "y", "z"]
[measured.block_orientation]
source = ["qx", "qy", "qz", "qw"]
order = "xyzw"
"""
TIME = np.arange(0, 2, 0.01)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "robot.xml").write_text(SCENE)
    (tmp_path / "map.toml").write_text(MAP)
    rows = [f"{1764000000 + t:.6f};{20 * np.sin(t):.5f};{20 * np.sin(t):.5f};0.1;0;;0;0;0;1;push" for t in TIME]
    rows[50], rows[51] = rows[51], rows[50]
    rows.insert(70, rows[70])
    header = "timestamp;hinge;cmd_hinge;x;y;z;qx;qy;qz;qw;mode"
    (tmp_path / "log.csv").write_text("\n".join([header, *rows]))
    return tmp_path


def test_a_table_becomes_a_recording(folder):
    with pytest.raises(RecordingError, match="this is a table, not yet a recording; read it with `concent import"):
        load_recording(folder / "log.csv")
    (d,) = import_log(folder / "log.csv", folder / "robot.xml", mapping=folder / "map.toml").demonstrations
    np.testing.assert_allclose(d.measured["hinge_position"].time, TIME, atol=1e-5)
    np.testing.assert_allclose(d.measured["hinge_position"].value[:, 0], np.radians(20 * np.sin(TIME)), atol=1e-6)
    np.testing.assert_allclose(d.action["hinge"].value, np.radians(20 * np.sin(TIME)), atol=1e-6)
    assert np.isnan(d.measured["block_position"].value[:, 2]).all()
    np.testing.assert_allclose(d.measured["block_orientation"].value[0], [1, 0, 0, 0])


def test_a_map_is_suggested_from_the_names_of_columns(folder):
    text = suggest_map(folder / "log.csv", folder / "robot.xml")
    assert 'source = "cmd_hinge"\nunit = "deg"' in text
    assert 'source = "hinge"\nunit = "deg"' in text
    assert '[measured.block_position]  # guess: the only ones\nsource = ["x", "y", "z"]\n' in text


@pytest.mark.parametrize(
    ("position", "orientation", "unit"),
    [
        (["block_x", "block_y", "block_z"], ["block_qx", "block_qy", "block_qz", "block_qw"], ""),
        (["block_px_mm", "block_py_mm", "block_pz_mm"], ["block_rx", "block_ry", "block_rz", "block_rw"], "mm"),
        (["block.pos.x", "block.pos.y", "block.pos.z"], ["block.q.x", "block.q.y", "block.q.z", "block.q.w"], ""),
        (["x [m]", "y [m]", "z [m]"], ["q_x", "q_y", "q_z", "q_w"], ""),
        (["x", "y", "z"], ["qx", "qy", "qz", "qw"], "mm"),
    ],
)
def test_poses_are_found_by_the_names_of_their_columns(folder, position, orientation, unit):
    names = [*reversed(orientation), "flux", "block_index", *position]
    value = 400 if unit else 0.4
    (folder / "log.csv").write_text(f"t,{','.join(names)}\n0,1,0,0,0,7,3,{value},{value},{value}\n")
    text = suggest_map(folder / "log.csv", folder / "robot.xml")

    def listed(columns: list[str]) -> str:
        return ", ".join(f'"{name}"' for name in columns)

    stated = f'unit = "{unit}"\n' if unit else ""
    assert f"source = [{listed(position)}]\n{stated}\n" in text
    assert f'source = [{listed(orientation)}]\norder = "xyzw"\n' in text
    assert ("values up to 400" in text) == (unit == "mm" and position[0] == "x")


def test_units_in_names_are_taken_and_negative_lengths_are_judged_by_their_size(tmp_path):
    scene = SCENE.replace('name="hinge" axis="0 1 0" range="-2 2"', 'name="hinge" type="slide" range="-0.2 0.1"')
    (tmp_path / "robot.xml").write_text(scene)
    for ending in ("_mm", ""):
        (tmp_path / "log.csv").write_text(f"t,hinge{ending},hinge_target{ending}\n0,-50,-50\n0.1,-55,-56\n")
        text = suggest_map(tmp_path / "log.csv", tmp_path / "robot.xml")
        guess = "" if ending else "  # guess: values from -56 to -50"
        assert f'[action.hinge]{guess}\nsource = "hinge_target{ending}"\nunit = "mm"\n' in text
        assert f'source = "hinge{ending}"\nunit = "mm"\n' in text


def test_rows_of_two_rates_in_one_table_are_told_apart(folder):
    arm = [f"{t:.4f},{10 * t:.3f},{10 * t:.3f},,,,,,," for t in np.arange(0, 1, 0.1)]
    block = [f"{t:.4f},,,0.1,0,1,1,0,0,0" for t in np.arange(0, 1, 0.05)]  # every second at the stamp of an arm's row
    rows = sorted([*arm, *block], key=lambda row: float(row.split(",")[0]))
    (folder / "log.csv").write_text("\n".join(["t,hinge,cmd_hinge,x,y,z,qw,qx,qy,qz", *rows]))
    (d,) = import_log(folder / "log.csv", folder / "robot.xml", mapping=folder / "map.toml").demonstrations
    np.testing.assert_allclose(d.action["hinge"].time, np.arange(0, 1, 0.1))
    np.testing.assert_allclose(np.degrees(d.measured["hinge_position"].value[:, 0]), 10 * np.arange(0, 1, 0.1))
    np.testing.assert_allclose(d.measured["block_position"].time, np.arange(0, 1, 0.05))


def test_a_folder_of_tables_without_common_columns_is_one_episode(folder):
    run = folder / "runs" / "first"
    run.mkdir(parents=True)
    arm = [f"{t:.4f},{t:.3f},{t:.3f}" for t in np.arange(0, 1, 0.1)]
    block = [f"{t:.4f},0.1,0,1,1,0,0,0" for t in np.arange(0.02, 1, 0.05)]
    (run / "joints.csv").write_text("\n".join(["t,hinge,cmd_hinge", *arm]))
    (run / "mocap.csv").write_text(
        "\n".join(["time,block_x,block_y,block_z,block_qw,block_qx,block_qy,block_qz", *block])
    )
    text = suggest_map(run, folder / "robot.xml")
    assert 'source = "joints/cmd_hinge"' in text
    assert '"mocap/block_qw"' in text
    (folder / "map.toml").write_text(text)
    (d,) = import_log(run, folder / "robot.xml", mapping=folder / "map.toml").demonstrations
    np.testing.assert_allclose(d.measured["block_position"].time, np.arange(0.02, 1, 0.05))
    assert log_sources(folder / "runs") == [run]
    (run / "mocap.csv").rename(folder / "runs" / "second.csv")
    (run / "again.csv").write_text((run / "joints.csv").read_text())
    assert log_sources(run) == [run / "again.csv", run / "joints.csv"]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("t_ms", "1500"),
        ("time [us]", "1500000"),
        ("timestamp_ns", "1500000000"),
        ("Time (Seconds)", "1.5"),
        ("%time", "1.5"),
        ("__time", "1.5"),
        ("field.header.stamp", "1.5"),
        ("sim_time_ms", "1500"),
        ("ts", "1970-01-01T00:00:01.5"),
        ("timestamp", "1970-01-01 00:00:01.5"),
        ("timestamp", "1970-01-01T01:00:01.5+01:00"),
    ],
)
def test_the_name_of_the_times_may_state_their_unit(tmp_path, name, text):
    (tmp_path / "a.csv").write_text(f"a,{name}\n1,{text}\n")
    assert table_signals(tmp_path / "a.csv")["a"].time == pytest.approx([1.5])


@pytest.mark.parametrize(
    "names",
    [
        ("time_sec", "time_nsec"),
        ("header.stamp.secs", "header.stamp.nsecs"),
        ("/js/header.stamp.sec", "/js/header.stamp.nanosec"),
        ("sec", "nsec"),
        ("stamp_s", "stamp_ns"),
    ],
)
def test_stamps_of_whole_seconds_and_nanoseconds_are_put_together(tmp_path, names):
    (tmp_path / "a.csv").write_text(f"a,{names[1]},{names[0]}\n1,500000000,1700000000\n2,20,1700000001\n")
    found = table_signals(tmp_path / "a.csv")
    assert list(found) == ["a"]
    np.testing.assert_array_equal(found["a"].time, [1700000000.5, 1700000001 + 2e-8])


@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("%time,field.header.stamp,a", "1764000000500000000,1764000000400000000,3"),
        ("stats,status,ts,a", "1,0.25,1764000000500,3"),
        ("time_from_start.secs,time_from_start.nsecs,timestamp,a", "0,7,1764000000.5,3"),
        ("__time,/js/header.stamp.sec,/js/header.stamp.nanosec,a", "1764000000.5,1764000000,300000000,3"),
    ],
)
def test_the_column_that_is_named_time_is_the_time_beside_others_that_end_so(tmp_path, header, row):
    (tmp_path / "a.csv").write_text(f"{header}\n{row}\n")
    np.testing.assert_array_equal(table_signals(tmp_path / "a.csv")["a"].time, [1764000000.5])


@pytest.mark.parametrize("rows", ["1,1500000000,1\n2,2000000000,2\n", "1.5,1500000000,1\n2.0,2000000000,2\n"])
def test_nanoseconds_that_count_all_of_the_time_are_not_added_to_the_seconds(tmp_path, rows):
    (tmp_path / "a.csv").write_text(f"time_s,time_ns,a\n{rows}")
    np.testing.assert_array_equal(table_signals(tmp_path / "a.csv")["a"].time, [1.5, 2])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sim_time,wall_time\n1,2\n", r"several columns of a table may be the time.*rename the one that is meant"),
        ("t,a\nyesterday,2\n", "line 2: a time is not a number; found 'yesterday'"),
        ("a,b\n1,2\n", "a table has no times; expected names in the first line, one of them time or timestamp"),
        ("t,a,a\n1,2,3\n", r"two columns of a table have the same name.*\['a'\]"),
        ("t,a\n1,2,3\n", "line 2: wrong number of columns; expected 2, found 3"),
        ("t,a\nx,2\n", "line 2: a time is not a number"),
        ("t,a\n1,2\n2,x\n", "line 3: a cell of column 'a' is not a number; found 'x'"),
        ("t,a\n", "no rows below its header"),
        ("t;a;b\n0;1,5;2\n", "line 2: a cell of column 'a' is not a number; found '1,5'; write decimals with a point"),
        ("t;a\n0,5;1\n", "line 2: a time is not a number; found '0,5'; write decimals with a point"),
    ],
)
def test_what_is_no_table_of_numbers_is_refused(tmp_path, text, message):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(RecordingError, match=message):
        table_signals(tmp_path / "a.csv")


def test_columns_of_texts_are_left_out_and_empty_ones_are_missing_throughout(tmp_path):
    (tmp_path / "a.csv").write_text("t,a,b,c\n0,1,,push\n1,,,\n")
    found = table_signals(tmp_path / "a.csv")
    assert list(found) == ["a", "b"]
    np.testing.assert_array_equal(found["a"].value, [1.0, np.nan])
    assert np.isnan(found["b"].value).all()


def test_commands_are_known_by_their_names(tmp_path):
    (tmp_path / "a.csv").write_text("t,action_1,q1_cmd,jointAction,reaction_force,traction\n0,1,1,1,1,1\n")
    found = table_signals(tmp_path / "a.csv")
    assert [name for name, signal in found.items() if signal.command] == ["action_1", "q1_cmd", "jointAction"]


def test_a_long_table_takes_little_more_memory_than_its_numbers(tmp_path):
    rows, columns = 5000, 20
    text = "t," + ",".join(f"q{k}" for k in range(columns)) + "\n"
    text += "".join(f"{row * 0.01:.2f}" + ",0.123456" * columns + "\n" for row in range(rows))
    (tmp_path / "a.csv").write_text(text)
    tracemalloc.start()
    table_signals(tmp_path / "a.csv")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * 8 * rows * columns


def test_notes_in_a_folder_of_bags_are_no_log(tmp_path):
    for name in ("a.mcap", "b.mcap", "notes.csv"):
        (tmp_path / name).write_text("")
    assert [one.name for one in log_sources(tmp_path)] == ["a.mcap", "b.mcap"]
    (tmp_path / "notes.csv").write_text("time,temperature\n0,1\n")
    (tmp_path / "phases.csv").write_text("time,phase\n0,1\n")
    assert [one.name for one in log_sources(tmp_path)] == ["a.mcap", "b.mcap"]
    (tmp_path / "phases.csv").unlink()
    (tmp_path / "a.mcap").unlink()
    (tmp_path / "b.mcap").unlink()
    assert [one.name for one in log_sources(tmp_path)] == ["notes.csv"]


def test_a_unit_that_the_name_of_a_column_states_is_not_taken_for_si(tmp_path):
    (tmp_path / "robot.xml").write_text(SCENE)
    rows = "\n".join(f"{t:.2f},{20 * np.sin(t):.5f},{0.03 * np.sin(t):.5f},1,2,{t:.2f}" for t in TIME)
    (tmp_path / "a.csv").write_text("t,hinge_deg,cmd_hinge,p_x_mm,p_y_mm,p_z_mm\n" + rows)
    position = '[measured.block_position]\nsource = ["p_x_mm", "p_y_mm", "p_z_mm"]\n'
    (tmp_path / "map.toml").write_text(f'[action]\nhinge = "cmd_hinge"\n{position}')
    with pytest.raises(RecordingError, match=r"block_position.*its name states mm, and the map no unit"):
        import_log(tmp_path / "a.csv", tmp_path / "robot.xml", mapping=tmp_path / "map.toml")
    (tmp_path / "map.toml").write_text(f'[action]\nhinge = "cmd_hinge"\n{position}unit = "mm"\n')
    (d,) = import_log(tmp_path / "a.csv", tmp_path / "robot.xml", mapping=tmp_path / "map.toml").demonstrations
    np.testing.assert_allclose(d.measured["block_position"].value[-1], [1e-3, 2e-3, TIME[-1] * 1e-3])


@pytest.mark.parametrize(
    ("name", "unit"), [("elbow_deg", "deg"), ("run_deg/elbow", "deg"), ("run_deg/elbow_rad", None), ("elbow_mm", None)]
)
def test_the_unit_of_a_name_is_that_of_its_last_word_that_states_one(name, unit):
    assert named_unit(name, "angle") == unit


def test_a_suggested_map_has_the_units_that_names_state(tmp_path):
    (tmp_path / "robot.xml").write_text(SCENE)
    (tmp_path / "a.csv").write_text("t,seq,arm.position.hinge_deg,arm.command.hinge_deg\n0,1,2,1\n1,2,2.5,2\n")
    text = suggest_map(tmp_path / "a.csv", tmp_path / "robot.xml")
    assert '[measured.hinge_position]\nsource = "arm.position.hinge_deg"\nunit = "deg"\n' in text
    assert '[action.hinge]\nsource = "arm.command.hinge_deg"\nunit = "deg"\n' in text


def test_stamps_that_stand_still_are_not_told_to_take_times_of_reception_that_a_table_has_not(tmp_path):
    (tmp_path / "robot.xml").write_text(SCENE)
    (tmp_path / "map.toml").write_text('[action]\nhinge = "cmd"\n[measured]\nhinge_position = "q"\n')
    (tmp_path / "a.csv").write_text("t,q,cmd\n" + "\n".join(f"{t // 1:.0f},{t},{t}" for t in TIME))
    with pytest.raises(RecordingError, match=r"198 of 200 stamps are repeated or missing; mend the log(?!, or)"):
        import_log(tmp_path / "a.csv", tmp_path / "robot.xml", mapping=tmp_path / "map.toml")


def test_rows_that_a_table_of_several_rates_has_for_other_channels_are_no_missing_samples(tmp_path):
    (tmp_path / "robot.xml").write_text(SCENE)
    (tmp_path / "map.toml").write_text('[action]\nhinge = "cmd"\n[measured]\nhinge_position = "q"\n')
    rows = [f"{t:.3f},,{0.02 * np.sin(t):.5f}" for t in TIME]
    rows += [f"{t + 0.003:.3f},{0.02 * np.sin(t):.5f}," for t in TIME[::8]]
    (tmp_path / "a.csv").write_text("t,q,cmd\n" + "\n".join(rows))
    (d,) = import_log(tmp_path / "a.csv", tmp_path / "robot.xml", mapping=tmp_path / "map.toml").demonstrations
    np.testing.assert_allclose(d.measured["hinge_position"].time, TIME[::8] + 0.003, atol=1e-6)
    np.testing.assert_allclose(d.measured["hinge_position"].value[:, 0], 0.02 * np.sin(TIME[::8]), atol=1e-5)
    np.testing.assert_allclose(d.action["hinge"].time, TIME, atol=1e-6)


def test_a_suggested_map_has_the_components_of_positions_and_orientations(tmp_path):
    (tmp_path / "robot.xml").write_text(SCENE)
    (tmp_path / "a.csv").write_text("t,q1,block:X_mm,block:Y_mm,block:Z_mm,qx,qy,qz,qw\n0,1,2,1,3,0,0,0,1\n")
    text = suggest_map(tmp_path / "a.csv", tmp_path / "robot.xml")
    position = '[measured.block_position]\nsource = ["block:X_mm", "block:Y_mm", "block:Z_mm"]\nunit = "mm"\n'
    turn = '[measured.block_orientation]  # guess: the only ones\nsource = ["qx", "qy", "qz", "qw"]\norder = "xyzw"\n'
    assert position in text
    assert turn in text
    (tmp_path / "a.csv").write_text("t,q1,cmd\n0,1,2\n")
    text = suggest_map(tmp_path / "a.csv", tmp_path / "robot.xml")
    assert "# [measured.block_position]  # no channel found" in text


def test_a_finger_that_cannot_follow_since_it_holds_an_object_is_in_metres(tmp_path):
    (tmp_path / "robot.xml").write_text(
        """<mujoco><worldbody><body><joint name="x" type="slide" range="0 0.1"/><geom size="0.1"/></body></worldbody>
        <actuator><position name="x" joint="x"/></actuator><sensor><jointpos name="p" joint="x"/></sensor></mujoco>"""
    )
    (tmp_path / "map.toml").write_text('[action]\nx = "cmd"\n[measured]\np = "p"\n')
    rows = [f"{t:.2f},{0.05 + 4e-5 * np.sin(9 * t):.7f},{0.04 + 0.04 * np.sin(9 * t):.5f}" for t in TIME]
    (tmp_path / "a.csv").write_text("t,p,cmd\n" + "\n".join(rows))
    assert import_log(tmp_path / "a.csv", tmp_path / "robot.xml", mapping=tmp_path / "map.toml").demonstrations


def test_velocities_forces_and_markers_of_a_body_are_not_suggested_for_its_position(tmp_path):
    (tmp_path / "robot.xml").write_text(SCENE)
    names = ["block_velocity", "block_marker", "block", "force", "block_accel"]
    columns = [f"{name}_{axis}" for name in names for axis in "xyz"]
    (tmp_path / "a.csv").write_text(f"t,q1,{','.join(columns)}\n0,1{15 * ',0'}\n")
    text = suggest_map(tmp_path / "a.csv", tmp_path / "robot.xml")
    assert '[measured.block_position]\nsource = ["block_x", "block_y", "block_z"]\n' in text
    (tmp_path / "a.csv").write_text("t,q1,force_x,force_y,force_z\n0,1,0,0,0\n")
    assert "# [measured.block_position]  # no channel found" in suggest_map(tmp_path / "a.csv", tmp_path / "robot.xml")


def test_millimetres_of_a_slide_are_noticed_beside_its_velocity(tmp_path):
    (tmp_path / "robot.xml").write_text(
        """<mujoco><worldbody><body><joint name="x" type="slide"/><geom size="0.1"/></body></worldbody>
        <sensor><jointpos name="p" joint="x"/><jointvel name="v" joint="x"/></sensor></mujoco>"""
    )
    (tmp_path / "map.toml").write_text('[measured]\np = "p"\nv = "v"\n')
    (tmp_path / "a.csv").write_text("t,p,v\n" + "\n".join(f"{t:.2f},{5 * np.sin(t)},{5e-3 * np.cos(t)}" for t in TIME))
    with pytest.raises(RecordingError, match=r"it moves as much as millimetres beside metres"):
        import_log(tmp_path / "a.csv", tmp_path / "robot.xml", mapping=tmp_path / "map.toml")
    (tmp_path / "map.toml").write_text('[measured]\np = { source = "p", unit = "mm" }\nv = "v"\n')
    assert import_log(tmp_path / "a.csv", tmp_path / "robot.xml", mapping=tmp_path / "map.toml").demonstrations


@pytest.mark.parametrize("limits", ["", ' range="-110 110"'])
def test_counts_of_an_encoder_are_told_from_degrees(tmp_path, limits):
    (tmp_path / "robot.xml").write_text(
        f"""<mujoco><worldbody><body><joint name="q" axis="0 1 0"{limits}/><geom size="0.1"/></body></worldbody>
        <sensor><jointpos name="angle" joint="q"/></sensor></mujoco>"""
    )
    rows = [f"{t:.2f},{round(16384 / 6.283 * np.sin(3 * t))}" for t in TIME]
    (tmp_path / "a.csv").write_text("t,ticks\n" + "\n".join(rows))
    entry = '[measured.angle]\nsource = "ticks"\n'
    (tmp_path / "map.toml").write_text(entry)
    with pytest.raises(
        RecordingError, match=r'counts of an encoder, write unit = "turn" and scale = 1 / \(counts a turn'
    ):
        import_log(tmp_path / "a.csv", tmp_path / "robot.xml", mapping=tmp_path / "map.toml")
    (tmp_path / "map.toml").write_text(f'{entry}unit = "turn"\nscale = {1 / 16384}\n')
    (d,) = import_log(tmp_path / "a.csv", tmp_path / "robot.xml", mapping=tmp_path / "map.toml").demonstrations
    np.testing.assert_allclose(d.measured["angle"].value[:, 0], np.sin(3 * TIME), atol=1e-3)


def test_torques_are_suggested_for_motors_where_nothing_is_called_a_command(tmp_path):
    model = """<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size="0.1"/>
    <body><joint name="b" axis="0 1 0"/><geom size="0.1"/></body></body></worldbody><actuator>{}</actuator>
    <sensor><jointpos name="a" joint="a"/><jointpos name="b" joint="b"/></sensor></mujoco>"""
    (tmp_path / "robot.xml").write_text(model.format('<motor name="a" joint="a"/><motor name="b" joint="b"/>'))
    (tmp_path / "a.csv").write_text("t,a (deg),b (deg),torque1 (Nm),torque2 (Nm)\n0,1,2,3,4\n")
    text = suggest_map(tmp_path / "a.csv", tmp_path / "robot.xml")
    assert '[action.a]  # guess: by order, no name says command\nsource = "torque1 (Nm)"\n' in text
    assert '[measured.b]\nsource = "b (deg)"\nunit = "deg"\n' in text
    servos = '<position name="a" joint="a" kp="1"/><position name="b" joint="b" kp="1"/>'
    (tmp_path / "robot.xml").write_text(model.format(servos))
    assert "# [action.a]  # no channel found" in suggest_map(tmp_path / "a.csv", tmp_path / "robot.xml")
