import cv2
import numpy as np
import pytest

from concent_warp.perception.calibration.cfg import CalibrationTargetCfg
from concent_warp.perception.calibration.targets import detect
from concent_warp.recording.recording import ImageStream

SCALE = 2000.0
"""Pixels a metre of the printed board."""
EDGE = 40
"""White edge around the print [px]."""


def stream_of(board, width, height):
    """Return a stream of one frame that shows the print of a board, a little blurred."""
    size = (round(width * SCALE) + 2 * EDGE, round(height * SCALE) + 2 * EDGE)
    image = cv2.GaussianBlur(board.generateImage(size, marginSize=EDGE), (0, 0), 0.8)
    rgb = np.repeat(image[None, :, :, None], 3, axis=3)
    return ImageStream(np.zeros(1), rgb, np.zeros(rgb.shape[:3], np.float32), np.eye(3), np.eye(4))


@pytest.mark.parametrize("method", ["charuco", "grid"])
def test_corners_of_a_board_lie_where_it_is_printed(method):
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    if method == "charuco":
        cfg = CalibrationTargetCfg("charuco", "5X5_100", tag_size=0.03, board=(5, 4), spacing=0.04)
        stream = stream_of(cv2.aruco.CharucoBoard((5, 4), 0.04, 0.03, family), 0.2, 0.16)
    else:
        cfg = CalibrationTargetCfg("grid", "5X5_100", tag_size=0.03, board=(4, 3), spacing=0.01)
        stream = stream_of(cv2.aruco.GridBoard((4, 3), 0.03, 0.01, family), 0.15, 0.11)
    (view,) = detect(stream, cfg)
    assert view.target == "board"
    assert len(view.points) == (12 if method == "charuco" else 48)
    expected = SCALE * view.points[:, :2] + EDGE - 0.5
    assert np.abs(view.pixels - expected).max() < 1.0
    assert np.abs((view.pixels - view.pixels.mean(axis=0)) - (expected - expected.mean(axis=0))).max() < 0.6
