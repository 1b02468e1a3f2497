from __future__ import annotations

import json
from dataclasses import replace

import pytest

import concent_warp as cw
from tests.perception.conftest import filmed


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """A recording with two frames of an untextured block."""
    from concent_warp.reality.record import RealityCfg, record

    film = filmed(record(RealityCfg(), [1000]), pattern=False)
    stream = film.recording[0].image["camera"]
    stream = replace(stream, time=stream.time[:2], rgb=stream.rgb[:2], depth=stream.depth[:2])
    path = tmp_path_factory.mktemp("video") / "video.h5"
    demonstration = replace(film.recording[0], image={"camera": stream})
    cw.write_hdf5(replace(film.recording, demonstrations=(demonstration,)), path)
    return path


def test_a_video_becomes_a_recording_with_poses(video, tmp_path, capsys):
    from concent_warp.cli import main

    out = tmp_path / "tracked.h5"
    assert main(["track", str(video), "-o", str(out), "--pose", "none", "--json"]) == 0
    (figures,) = json.loads(capsys.readouterr().out)["tracks"]
    assert figures["body"] == "block"
    assert figures["frames_lost"] == 0
    channel = cw.load_recording(out)[0].measured["block_position"]
    assert len(channel.time) == 2
    assert channel.covariance is not None


def test_nothing_is_written_where_the_first_pose_is_refused(video, tmp_path, capsys):
    from concent_warp.cli import main

    pose, out = tmp_path / "pose.toml", tmp_path / "tracked.h5"
    pose.write_text("[block]\nposition = [0.55, 0.2, 0.02]\nquaternion = [1, 0, 0, 0]\n")
    assert main(["track", str(video), "-o", str(out), "--pose", str(pose)]) == 2
    said = capsys.readouterr().err
    assert "first pose of 'block'" in said
    assert "Traceback" not in said
    assert not out.exists()
