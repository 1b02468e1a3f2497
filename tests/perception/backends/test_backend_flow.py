from __future__ import annotations

import numpy as np
import pytest

import concent_warp as cw

SHIFT = np.array([3.0, -2.0])


def moving(count: int = 6) -> cw.CameraFrames:
    """Return frames of a smooth random texture that moves by SHIFT from frame to frame."""
    import cv2

    coarse = np.random.default_rng(0).integers(0, 255, (40, 50, 3), dtype=np.uint8)
    image = cv2.resize(coarse, (200, 160), interpolation=cv2.INTER_CUBIC)
    rgb = np.stack([np.roll(image, (round(k * SHIFT[1]), round(k * SHIFT[0])), axis=(0, 1)) for k in range(count)])
    return cw.CameraFrames(rgb, np.ones(rgb.shape[:3], np.float32))


@pytest.fixture(scope="module")
def frames():
    return moving()


def test_points_are_followed_forward_and_backward_from_their_frame(frames):
    tracker, mask = cw.FlowTracker(), np.zeros(frames.size, dtype=bool)
    mask[60:100, 80:120] = True
    chosen = tracker.choose(frames, 2, mask, 20)
    assert 5 < len(chosen) <= 20
    assert mask[tuple(np.round(chosen[:, ::-1]).astype(int).T)].all()
    tracks = tracker.track(frames, np.column_stack([np.full(len(chosen), 2), chosen]))
    assert tracks.visible.all()
    steps = np.arange(frames.count) - 2
    expected = chosen[:, None] + steps[None, :, None] * SHIFT
    assert np.abs(tracks.pixels - expected).max() < 0.15


def test_a_point_that_is_covered_is_lost_and_stays_lost(frames):
    rgb = frames.rgb.copy()
    rgb[3, 50:110, 70:140] = 90
    covered = cw.CameraFrames(rgb, frames.depth)
    near = cw.FlowTracker(cw.FlowTrackerCfg(levels=1))
    tracks = near.track(covered, np.array([[0, 90.0, 90.0], [0, 30.0, 140.0]]))
    assert tracks.visible[0].tolist() == [True, True, True, False, False, False]
    assert tracks.visible[1].all()


def test_a_point_that_leaves_the_image_is_lost(frames):
    tracks = cw.FlowTracker().track(frames, np.array([[0, 193.0, 80.0], [0, 100.0, 80.0]]))
    assert tracks.visible[:, 0].all()
    assert tracks.visible[:, -1].tolist() == [False, True]


def test_frames_of_a_part_are_counted_from_its_start():
    frames = cw.CameraFrames(*(moving().rgb, moving().depth), known=lambda frame: np.full((160, 200), float(frame)))
    part = frames.part(2, 4)
    assert part.count == 2
    assert part.known is not None
    assert part.known(1)[0, 0] == 3.0


def test_settings_out_of_bounds_are_refused():
    with pytest.raises(cw.ConcentError, match="half_window"):
        cw.FlowTracker(cw.FlowTrackerCfg(half_window=0))
