"""Frames of a recording, by a camera and of an object that both move, become splats in the frame of the body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import concent_warp as cw
from benchmarks.perception.bop_scene import SENSING, Orbit, write_bop_scene
from concent_warp.cli import main
from concent_warp.recording.recording import ImageStream
from concent_warp.render.splats.recorded_views import RecordedViewsCfg, recorded_views
from concent_warp.render.splats.splats import Splats

BODY, EDGES = "obj_000002", np.array([0.066, 0.066, 0.1])
"""The can, which is plain and blue; the other objects carry a pattern."""
COUNT = 12
ALL = RecordedViewsCfg(max_gap=10.0)


@pytest.fixture(scope="module")
def orbit(tmp_path_factory) -> cw.Recording:
    """Objects once around, in the frame of the camera."""
    sensing = replace(SENSING, image_size=(120, 160))
    motion = Orbit(images=COUNT, speed=2 * np.pi * 30 / COUNT)
    return cw.import_log(write_bop_scene(tmp_path_factory.mktemp("bop") / "own", 1, motion, sensing))


def with_stream(recording: cw.Recording, stream: ImageStream) -> cw.Recording:
    return replace(recording, demonstrations=(replace(recording[0], image={"camera": stream}),))


def test_masks_cover_the_object_and_cameras_are_around_it(orbit):
    views, points = recorded_views(orbit, BODY, (), ALL)
    assert len(views) >= 8
    assert views.masked
    assert views.known is not None
    assert np.allclose(np.ptp(points, axis=0), EDGES, atol=1e-3)
    # The can alone is blue: where the mask says so, and not beside it.
    inside = (views.rgba[..., 3] > 0) & views.known
    outside = (views.rgba[..., 3] == 0) & views.known
    blue = views.rgba[..., 2].astype(int) - views.rgba[..., 0]
    assert (blue[inside] > 15).mean() > 0.95
    assert (blue[outside] > 15).mean() < 0.05
    distance = np.linalg.norm(views.poses[:, :3, 3], axis=1)
    assert ((distance > 0.5) & (distance < 1.2)).all()
    # They stand above the table and look at the object, along -z.
    assert (views.poses[:, 2, 3] > 0.3).all()
    ahead = -views.poses[:, :3, 2]
    assert (np.einsum("vk,vk->v", ahead, -views.poses[:, :3, 3] / distance[:, None]) > 0.97).all()


def test_what_hides_the_object_is_not_fitted(orbit):
    before, _ = recorded_views(orbit, BODY, (), ALL)
    stream = orbit[0].image["camera"]
    depth = stream.depth.copy()
    depth[:, :, 70:90] = 0.3  # a pole before the camera
    after, _ = recorded_views(with_stream(orbit, replace(stream, depth=depth)), BODY, (), replace(ALL, min_visible=0.0))
    assert after.known is not None
    assert before.known is not None
    assert len(after) == len(before)
    mask = before.rgba[..., 3] > 0
    assert (after.known & mask).sum() < 0.9 * (before.known & mask).sum()
    assert not (after.known & ~before.known).any()


def test_a_recording_becomes_splats_of_the_size_of_the_object(orbit, tmp_path, capsys):
    cw.write_hdf5(orbit, tmp_path / "orbit.h5")
    command = ["splat-fit", str(tmp_path / "orbit.h5"), "-o", str(tmp_path / "run"), "--frames.max-gap", "1"]
    quick = ["--fit.start", "400", "--fit.iterations", "30", "--fit.held-out", "4"]
    assert main([*command, *quick]) == 2
    assert "which object is meant is not clear; expected one of ['obj_000001'" in capsys.readouterr().err
    assert main([*command, *quick, "--body", BODY]) == 0
    assert "images that were not fitted" in capsys.readouterr().out
    splats = Splats.read(tmp_path / "run" / "splats.ply")
    low, high = (splats.means.quantile(q, dim=0).numpy() for q in (0.02, 0.98))
    assert np.allclose(high - low, EDGES, atol=0.008)
    assert np.allclose(high + low, 0, atol=0.008)
    colour = 0.5 + 0.28209479 * splats.harmonics[:, 0].median(dim=0).values.numpy()
    assert colour[2] > colour[0] + 0.1
    for wrong, sentence in (
        (["--body", "nobody"], "no such body"),
        (["--body", BODY, "--camera", "other"], "no such camera"),
        (["--body", BODY, "--frames.min-visible", "2"], "--frames.min-visible"),
    ):
        assert main([*command[:3], str(tmp_path / "other"), *quick, *wrong]) == 2
        assert sentence in capsys.readouterr().err
    assert main(["splat-fit", str(tmp_path), "-o", str(tmp_path / "other"), "--body", BODY]) == 2
    assert "neither bodies nor cameras" in capsys.readouterr().err


def test_frames_without_a_pose_are_left_out(orbit):
    measured = {**orbit[0].measured}
    channel = measured[f"{BODY}_position"]
    value = channel.value.copy()
    value[3:] = np.nan
    measured[f"{BODY}_position"] = replace(channel, value=value)
    short = replace(orbit, demonstrations=(replace(orbit[0], measured=measured),))
    whole, _ = recorded_views(orbit, BODY, (), ALL)
    few, _ = recorded_views(short, BODY, (), ALL)
    assert len(few) <= 3 < len(whole)
    del measured[f"{BODY}_position"]
    with pytest.raises(cw.RenderError, match="hardly ever in view with a known pose"):
        recorded_views(replace(orbit, demonstrations=(replace(orbit[0], measured=measured),)), BODY, (), ALL)
