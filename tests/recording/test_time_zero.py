"""Logs that begin later than their clock."""

import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.recording.load import load_recording

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


def test_nanoseconds_since_1970_are_named(tmp_path):
    write(tmp_path, 1.7e9, 1e9)
    with pytest.raises(RecordingError, match=r"its time looks like nanoseconds; expected seconds, found 1.7e\+18"):
        load_recording(tmp_path)
