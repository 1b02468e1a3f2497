import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.recording.formats.csv import read_csv


@pytest.fixture
def folder(tmp_path, recording):
    (tmp_path / "scene.xml").write_text(recording.scene)
    (tmp_path / "measured_elbow_angle.csv").write_text("time,angle\n0,0.1\n0.01,\n0.02,0.3\n")
    return tmp_path


def test_a_folder_is_one_demonstration(folder):
    (folder / "measured_block_position.csv").write_text(
        "\ufefftime, x, y, z\r\n0,0.4,0,0.02\r\n0.5,0.4,1e-3,0.02\r\n\r\n"
    )
    (folder / "action_left%2Fgrip.csv").write_text("time,width\n0,0.03\n")
    (folder / "initial.csv").write_text("qpos,0.1,0.02,0.4,0,0.02,1,0,0,0\nqvel,0,0,0,0,0,0,0,0.5\n")
    (folder / "notes.txt").write_text("a windy day")
    recording = read_csv(folder)
    (demonstration,) = recording.demonstrations
    assert recording.source == str(folder)
    assert demonstration.name == "demo_0"
    np.testing.assert_equal(demonstration.measured["elbow_angle"].value, [[0.1], [np.nan], [0.3]])
    np.testing.assert_equal(demonstration.measured["block_position"].time, [0, 0.5])
    np.testing.assert_equal(demonstration.measured["block_position"].value, [[0.4, 0, 0.02], [0.4, 1e-3, 0.02]])
    np.testing.assert_equal(demonstration.action["left/grip"].value, [0.03])
    np.testing.assert_equal(demonstration.qpos, [0.1, 0.02, 0.4, 0, 0.02, 1, 0, 0, 0])
    assert demonstration.qvel is not None
    assert demonstration.qvel[7] == 0.5


def test_subfolders_are_demonstrations_in_the_order_of_their_numbers(folder):
    for number in (10, 2):
        (folder / f"demo_{number}").mkdir()
        text = f"time,angle\n0,{number / 10}\n"
        (folder / f"demo_{number}" / "measured_elbow_angle.csv").write_text(text)
    with pytest.raises(RecordingError, match="CSV files of its own"):
        read_csv(folder)
    (folder / "measured_elbow_angle.csv").unlink()
    recording = read_csv(folder)
    assert [d.name for d in recording.demonstrations] == ["demo_2", "demo_10"]
    assert recording["demo_10"].measured["elbow_angle"].value == 1.0
    (folder / "demo_2" / "scene.xml").write_text(recording.scene)
    with pytest.raises(RecordingError, match="a scene of its own"):
        read_csv(folder)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: the header row is missing; .* found an empty file"),
        ("0,0.1\n", "line 1: the header row is missing; expected time,<name>,.* found '0,0.1'"),
        ("angle,time\n0,0.1\n", "the header row is missing"),
        ("time;angle\n0;0,1\n", "separated by commas, found 'time;angle'"),
        ("time,angle\n", "no rows below its header"),
        ("time,angle\n0,0.1\n0.01,0.2,0.3\n", "line 3: a row has the wrong number of cells; expected 2, found 3"),
        ("time,angle\n0,open\n", "line 2: a cell of column 'angle' is not a number; .*found 'open'"),
        ("time,angle\n0,1_0\n", "found '1_0'"),
        ("time,angle\n0,inf\n", "row 0: a value is infinite"),
        ("time,angle\n,0.1\n0.1,0.1\n", "row 0: time is not finite"),
        ("time,angle,speed\n0,0.1,0\n", r"expected \(1, 1\), found \(1, 2\)"),
        ("time,angle\n0,\xff\n", "not a CSV file; expected UTF-8 text"),
        ('time,angle\n0,"' + "1" * 200_000, "not a CSV file"),
    ],
)
def test_a_broken_table_is_refused_with_its_line(folder, text, message):
    (folder / "measured_elbow_angle.csv").write_text(text, encoding="latin-1")
    with pytest.raises(RecordingError, match=message) as caught:
        read_csv(folder)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("elbow.csv", "time,angle\n", "a name that says nothing"),
        ("measured_.csv", "time,angle\n", "a name that says nothing"),
        ("action_elbow.csv", "time,a,b\n0,1,2\n", "wrong number of columns"),
        ("action_elbow.csv", "time,a\n0,\n", "every value is missing"),
        ("measured_knee.csv", "time,a\n0,1\n", "no such sensor"),
        ("initial.csv", "position,0\n", "line 1: unknown or repeated row"),
        ("initial.csv", "qpos,0,0\n", "initial/qpos: wrong shape"),
        ("scene.xml", "<mujoco><robot/></mujoco>", "the scene of the recording cannot be read"),
    ],
)
def test_a_broken_folder_is_refused(folder, name, text, message):
    (folder / name).write_text(text)
    with pytest.raises(RecordingError, match=message):
        read_csv(folder)


def test_a_folder_needs_a_scene_and_a_channel(folder):
    (folder / "measured_elbow_angle.csv").unlink()
    with pytest.raises(RecordingError, match="has no CSV files"):
        read_csv(folder)
    (folder / "scene.xml").unlink()
    with pytest.raises(RecordingError, match="has no scene"):
        read_csv(folder)
    with pytest.raises(RecordingError, match="no such folder"):
        read_csv(folder / "gone")


def test_actuators_with_dangling_names_in_the_scene_are_not_dropped(folder, recording):
    (folder / "scene.xml").write_text(recording.scene.replace('joint="elbow" kp', 'joint="knee" kp'))
    with pytest.raises(RecordingError, match="unknown transmission target 'knee'"):
        read_csv(folder)
