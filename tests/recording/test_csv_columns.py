import os

import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.recording.formats.csv import read_csv
from concent_warp.recording.load import load_recording

QUATERNION = {"w": 0.6, "x": 0.0, "y": 0.8, "z": 0.0}
POSITION = {"x": 0.4, "y": 0.1, "z": 0.02}


@pytest.fixture
def folder(tmp_path, recording):
    (tmp_path / "scene.xml").write_text(recording.scene)
    (tmp_path / "measured_elbow_angle.csv").write_text("time,angle\n0,0.1\n0.01,0.2\n")
    return tmp_path


def read(folder, sensor: str, header: str, values: list[float]) -> np.ndarray:
    (folder / f"measured_{sensor}.csv").write_text(f"time,{header}\n0,{','.join(map(str, values))}\n")
    return read_csv(folder)["demo_0"].measured[sensor].value[0]


@pytest.mark.parametrize("order", ["wxyz", "xyzw", "zwyx"])
@pytest.mark.parametrize("name", ["{}", "q{}", "Q{}", "quat_{}", "orientation.{}", "block rotation {}", " {} "])
def test_a_quaternion_is_read_by_the_names_of_its_columns(folder, order, name):
    header = ",".join(name.format(c) for c in order)
    read_values = read(folder, "block_orientation", header, [QUATERNION[c] for c in order])
    np.testing.assert_equal(read_values, [0.6, 0, 0.8, 0])


@pytest.mark.parametrize("order", ["xyz", "zyx", "yzx"])
@pytest.mark.parametrize("name", ["{}", "p{}", "pos_{}", "{} [m]", "block_{}_m"])
def test_a_position_is_read_by_the_names_of_its_columns(folder, order, name):
    header = ",".join(name.format(c) for c in order)
    read_values = read(folder, "block_position", header, [POSITION[c] for c in order])
    np.testing.assert_equal(read_values, [0.4, 0.1, 0.02])


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("a,b,c,d", [0.6, 0, 0.8, 0]),
        ("q0,q1,q2,q3", [0.6, 0, 0.8, 0]),
        ("q1,q2,q3,q4", [0.6, 0, 0.8, 0]),
        ("q0,q3,q2,q1", [0.6, 0, 0.8, 0]),
        ("q0,q2,q1,q3", [0.6, 0.8, 0, 0]),
    ],
)
def test_numbered_columns_are_read_by_number_and_others_as_they_stand(folder, header, expected):
    np.testing.assert_equal(read(folder, "block_orientation", header, [0.6, 0, 0.8, 0]), expected)


@pytest.mark.parametrize(
    ("file", "header", "message"),
    [
        (
            "measured_block_orientation",
            "w,x,y,a",
            "not the components of sensor .*w, x, y, z, in any order, found w, x",
        ),
        ("measured_block_orientation", "x,y,z,x", "two columns have the same name; found x"),
        ("measured_block_orientation", "qx,qy,qz,px", "not the components"),
        ("measured_block_position", "w,x,y", "not the components of sensor 'block_position'"),
        ("measured_block_position", "x,y,height", "not the components"),
        ("measured_block_position", "x_mm,y_mm,z_mm", "a column is in mm; expected SI units"),
        ("measured_elbow_angle", "angle [deg]", r"a column is in deg; .*found 'angle \[deg\]'"),
        ("measured_elbow_angle", "grip_width", "called after something else .*'elbow', 'elbow_angle'.*'grip_width'"),
        ("measured_elbow_angle", "grip", "called after something else in the scene"),
        ("action_elbow", "opening", "called after something else in the scene"),
        ("action_elbow", "target_deg", "a column is in deg"),
    ],
)
def test_names_that_contradict_the_channel_are_refused(folder, file, header, message):
    values = ",".join("0" for _ in header.split(","))
    (folder / f"{file}.csv").write_text(f"time,{header}\n0,{values}\n")
    with pytest.raises(RecordingError, match=message):
        read_csv(folder)


@pytest.mark.parametrize("name", ["elbow", "elbow_angle", "value", "Elbow", "position_rad"])
def test_a_single_column_may_have_its_own_name_or_any_word(folder, name):
    assert read(folder, "elbow_angle", name, [0.3]) == 0.3


@pytest.mark.parametrize("kind", ["fifo", "device", "folder", "socket"])
def test_what_is_no_file_is_refused_at_once(folder, kind):
    path = folder / "measured_grip_width.csv"
    make = {
        "fifo": lambda: os.mkfifo(path),
        "device": lambda: path.symlink_to("/dev/zero"),
        "folder": path.mkdir,
        "socket": lambda: os.mknod(path, 0o140600),
    }
    make[kind]()
    with pytest.raises(
        RecordingError, match=r"width\.csv: not a CSV file; expected a file, found a folder, device or pipe"
    ):
        read_csv(folder)


@pytest.mark.parametrize("name", ["r.json", "r.h5", "r.pt"])
def test_a_pipe_in_place_of_a_recording_is_refused_at_once(tmp_path, name):
    os.mkfifo(tmp_path / name)
    with pytest.raises(RecordingError):
        load_recording(tmp_path / name)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"time,angle\n0,\x000.1\n", "not a CSV file|not a number"),
        (b"\x7fELF" + bytes(range(256)), "not a CSV file"),
        ("time,angle\n0,0.1\n".encode("utf-16"), "not a CSV file; expected UTF-8"),
        (b"time,angle\n0," + b"9" * 5000 + b"\n", "a value is infinite"),
        (b'time,angle\n0,"0,1"\n', "is not a number; .*found '0,1'"),
        (b"time;angle\n0;0,1\n", "separated by commas"),
        (b"time\tangle\n0\t0.1\n", "separated by commas"),
        (b"time,angle\n0,0x10\n", "not a number"),
        (b"time,angle\n0,\x1b[31m\n", r"found '\\x1b\[31m'"),
        ("time,angle\n0,٣\n".encode(), "not a number"),
    ],
)
def test_odd_bytes_are_refused_in_one_printable_line(folder, content, message):
    (folder / "measured_elbow_angle.csv").write_bytes(content)
    with pytest.raises(RecordingError, match=message) as caught:
        read_csv(folder)
    assert str(caught.value).isprintable()
