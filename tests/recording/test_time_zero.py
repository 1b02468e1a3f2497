"""Logs that begin later than their clock."""

import h5py
import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.load import load_recording
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.recording.time_zero import counted_from_first_sample

SCENE = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/><geom size="0.1" mass="1"/></body>
</worldbody>
<actuator><motor name="drive" joint="hinge"/></actuator>
<sensor><jointpos name="angle" joint="hinge"/></sensor></mujoco>"""


def write(folder, start, unit=1.0):
    (folder / "scene.xml").write_text(SCENE)
    for name, late, period in (("measured_angle", 0.0, 0.01), ("action_drive", 0.3, 0.05)):
        rows = "".join(f"{(start + late + period * k) * unit!r},{0.1 * np.sin(k)}\n" for k in range(200))
        (folder / f"{name}.csv").write_text("time,value\n" + rows)


def test_times_are_counted_from_the_first_sample_of_a_log_that_begins_late(tmp_path):
    write(tmp_path, 37.2)
    with pytest.warns(UserWarning, match=r"counted from the first sample: demo_0 from 37.2 s on"):
        (d,) = load_recording(tmp_path).demonstrations
    np.testing.assert_allclose(d.measured["angle"].time[:2], [0.0, 0.01], atol=1e-9)
    assert d.action["drive"].time[0] == pytest.approx(0.3)


@pytest.mark.parametrize(("start", "initial"), [(0.8, ""), (37.2, "qpos,0.1\nqvel,0\n")])
def test_a_short_pause_and_a_stated_beginning_stay(tmp_path, start, initial):
    write(tmp_path, start)
    if initial:
        (tmp_path / "initial.csv").write_text(initial)
    assert load_recording(tmp_path)[0].measured["angle"].time[0] == pytest.approx(start)


@pytest.mark.parametrize("start", [5000.0, 1764000000.25])
@pytest.mark.parametrize("stored", ["CSV", "HDF5"])
def test_uptime_and_seconds_since_1970_are_counted_from_the_first_sample(tmp_path, start, stored):
    path = tmp_path
    write(tmp_path, 0.0 if stored == "HDF5" else start)
    if stored == "HDF5":
        path = tmp_path / "demo.h5"
        write_hdf5(load_recording(tmp_path), path)
        with h5py.File(path, "r+") as file:
            found: list[h5py.Dataset] = []
            file.visititems(lambda name, item: found.append(item) if name.endswith("/time") else None)
            for times in found:
                times[...] = times[()] + start
    with pytest.warns(UserWarning, match="counted from the first sample: demo_0 from"):
        (d,) = load_recording(path).demonstrations
    np.testing.assert_allclose(d.measured["angle"].time[:2], [0.0, 0.01], atol=1e-6)
    assert d.action["drive"].time[0] == pytest.approx(0.3, abs=1e-6)


def test_a_stated_beginning_far_from_the_first_sample_is_refused(tmp_path):
    write(tmp_path, 1764000000.25)
    (tmp_path / "initial.csv").write_text("qpos,0.1\nqvel,0\n")
    with pytest.raises(RecordingError, match="does not begin with the demonstration"):
        load_recording(tmp_path)


@pytest.mark.parametrize("time", [np.zeros(0), np.array([np.nan, 5.0]), np.array(["5", "6"]), np.full((2, 2), 5.0)])
def test_times_that_are_none_are_left_to_validation(time):
    measured = {"angle": Channel(time, np.zeros((len(time), 1)))}
    recording = Recording(SCENE, (Demonstration("demo_0", measured=measured),))
    assert counted_from_first_sample(recording) is recording


@pytest.mark.parametrize("unit", [1e3, 1e6, 1e9])
def test_other_units_since_1970_are_named(tmp_path, unit):
    write(tmp_path, 1.7e9, unit)
    with pytest.raises(RecordingError, match=r"its time looks like ms, us or ns; expected seconds, found 1.7e\+"):
        load_recording(tmp_path)
