"""Tables of numbers, as most robots' own loggers write them."""

import tracemalloc

import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.recording.load import load_recording
from concent_warp.recording.logs.import_log import import_log
from concent_warp.recording.logs.pose_columns import pose_columns
from concent_warp.recording.logs.readers.csv_table import table_signals
from concent_warp.recording.logs.readers.kinds import log_sources
from concent_warp.recording.logs.suggest import suggest_map

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
    assert '[measured.block_position]  # guess: the only pose\nsource = ["x", "y", "z"]\n' in text
    assert '[measured.block_orientation]\nsource = ["qw", "qx", "qy", "qz"]\norder = "wxyz"\n' in text


@pytest.mark.parametrize(
    ("position", "orientation", "unit"),
    [
        (["cup_x", "cup_y", "cup_z"], ["cup_qw", "cup_qx", "cup_qy", "cup_qz"], ""),
        (["cup_px_mm", "cup_py_mm", "cup_pz_mm"], ["cup_rw", "cup_rx", "cup_ry", "cup_rz"], "mm"),
        (["cup.pos.x", "cup.pos.y", "cup.pos.z"], ["cup.quat.w", "cup.quat.x", "cup.quat.y", "cup.quat.z"], ""),
        (["x [m]", "y [m]", "z [m]"], ["q_w", "q_x", "q_y", "q_z"], "m"),
    ],
)
def test_poses_are_found_by_the_names_of_their_columns(position, orientation, unit):
    (found,) = pose_columns([*reversed(orientation), "flux", "cup_index", *position])
    assert found.position == tuple(position)
    assert found.orientation == tuple(orientation)
    assert found.unit == unit
    assert pose_columns(position) == pose_columns(orientation) == []


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


@pytest.mark.parametrize(("name", "text"), [("t_ms", "1500"), ("time [us]", "1500000"), ("timestamp_ns", "1500000000")])
def test_the_name_of_the_times_may_state_their_unit(tmp_path, name, text):
    (tmp_path / "a.csv").write_text(f"a,{name}\n1,{text}\n")
    assert table_signals(tmp_path / "a.csv")["a"].time == pytest.approx([1.5])


@pytest.mark.parametrize(
    ("text", "message"),
    [
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
    (tmp_path / "a.mcap").unlink()
    (tmp_path / "b.mcap").unlink()
    assert [one.name for one in log_sources(tmp_path)] == ["notes.csv"]
