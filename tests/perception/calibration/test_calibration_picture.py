"""What the picture of a calibration plots."""

from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from concent_warp.perception.calibration.picture import _draw_radius, _draw_time
from concent_warp.perception.calibration.result import CameraCalibration, FrameError


def camera(frames: list[FrameError]) -> CameraCalibration:
    fields = dict.fromkeys(CameraCalibration.__dataclass_fields__)
    whole = CameraCalibration(**fields)  # pyright: ignore[reportArgumentType]
    return replace(whole, name="camera", method="robot", intrinsics=np.eye(3), frames=tuple(frames))


def test_frames_without_an_error_are_left_out_and_counted():
    good = FrameError("demo_0", 0, 0.1, np.ones((3, 2)), np.full((3, 1), 2e-3), 1.0)
    poor = FrameError("demo_0", 1, 0.2, np.ones((2, 2)), np.full((2, 1), 4e-3), 0.2)
    unseen = FrameError("demo_0", 2, 0.3, np.zeros((0, 2)), np.zeros((0, 1)), 0.0)
    first, second = Figure().subplots(2)
    _draw_time(first, camera([good, poor, unseen, unseen]))
    _draw_radius(second, camera([good, poor, unseen, unseen]))
    np.testing.assert_allclose([line.get_xydata()[0] for line in first.lines], [[0.1, 2], [0.2, 4]])
    assert "left out: 2 of 4 frames" in first.get_xlabel()
    assert [len(line.get_xdata()) for line in second.lines] == [3, 2, 2]  # the last is the axis
    alone = Figure().subplots()
    _draw_time(alone, camera([good, poor]))
    assert "left out" not in alone.get_xlabel()
