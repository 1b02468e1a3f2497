"""The live view of tracking."""

from __future__ import annotations

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.perception.tracking.geometry.outline import Outline
from concent_warp.report.tracking.live import LOST_COLOUR, LiveTrackView, padded, picture, strip
from tests.cli.live_page import BROWSER, opened
from tests.report.drawn_film import drawn, poses


@pytest.mark.skipif(BROWSER is None, reason="no Chromium to open the page with")
def test_the_page_shows_the_newest_frame_and_the_states_so_far(tmp_path):
    truth = poses(4)
    recording = drawn(truth, np.arange(4) / 20)
    recording[0].image["camera"].depth[2:] = 0.2
    view, shown = LiveTrackView(cw.LiveTrackCfg(port=8795, period=0)), []
    try:
        with opened(view.address, tmp_path) as page:
            page.wait_for("Waiting for the first frame")

            def watch(moment):
                view.show(moment)
                shown.append(page.wait_for(rf"frame {moment.number + 1} of 4[^\0]*frames so far")[0])

            cw.track(recording, pose={"block": truth[0]}, watch=watch)
    finally:
        view.stop()  # with a page open it waits for seconds
    assert page.messages == []
    assert "block: tracked; tracked in 1 of 1 frames so far" in shown[0]
    assert "block: lost: " in shown[3]
    assert "tracked in 2 of 4 frames so far" in shown[3]


def test_outlines_are_drawn_where_they_are_and_a_loss_frames_the_picture():
    frame = np.zeros((360, 480, 3), dtype=np.uint8)
    lines = Outline(np.array([[[100.0, 50.0], [100.0, 250.0]]]), np.array([False]))
    image = picture(frame, [lines], lost=False)
    assert image.shape == (720, 960, 3)  # twice as large
    rows, columns = np.nonzero(image[..., 1] > 200)
    assert np.abs(columns - 200.5).max() <= 2
    assert (rows.min(), rows.max()) == (pytest.approx(100, abs=2), pytest.approx(501, abs=2))
    lost = picture(frame, [], lost=True)
    assert tuple(lost[0, 0]) == LOST_COLOUR
    assert not lost[20:-20, 20:-20].any()


def test_the_strip_shows_states_so_far_and_what_is_to_come():
    colours = strip([True, True, False], 6)[0].astype(int)
    green, red = colours[:, 1] > colours[:, 0], (colours[:, 0] > 200) & (colours[:, 1] < 60)
    assert green.mean() == pytest.approx(2 / 6, abs=0.09)
    assert red.mean() == pytest.approx(1 / 6, abs=0.05)


@pytest.mark.parametrize("aspect", [0.5, 4 / 3, 3.0])
def test_a_picture_is_shown_whole_in_windows_of_any_aspect(aspect):
    image = np.zeros((48, 64, 3), dtype=np.uint8)
    found = padded(image, aspect)
    assert found.shape[1] / found.shape[0] == pytest.approx(aspect, rel=0.02)
    assert (found == 0).all(axis=2).sum() == 48 * 64
