from __future__ import annotations

import json
import re
import urllib.request
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
    page = tmp_path / "pages" / "track.html"
    command = ["track", str(video), "-o", str(out), "--pose", "none", "--json", "--report", str(page)]
    assert main([*command, "--page.max-frames", "1"]) == 0
    (figures,) = json.loads(capsys.readouterr().out)["tracks"]
    assert figures["body"] == "block"
    assert figures["frames_lost"] == 0
    channel = cw.load_recording(out)[0].measured["block_position"]
    assert len(channel.time) == 2
    assert channel.covariance is not None
    text = page.read_text()
    assert "poses in all 2 frames. Never lost." in text
    assert "--page.max-frames 1" in text  # how it was made
    assert text.count('"total":2') == 1


def test_nothing_is_written_where_the_first_pose_is_refused(video, tmp_path, capsys):
    from concent_warp.cli import main

    pose, out = tmp_path / "pose.toml", tmp_path / "tracked.h5"
    pose.write_text("[block]\nposition = [0.55, 0.2, 0.02]\nquaternion = [1, 0, 0, 0]\n")
    assert main(["track", str(video), "-o", str(out), "--pose", str(pose)]) == 2
    said = capsys.readouterr().err
    assert "first pose of 'block'" in said
    assert "Traceback" not in said
    assert not out.exists()


def test_recording_and_page_cannot_have_the_same_name(video, tmp_path, capsys):
    from concent_warp.cli import main

    out = str(tmp_path / "tracked.h5")
    assert main(["track", str(video), "-o", out, "--report", out]) == 2
    assert "the same name" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_live_shows_the_tracking_and_ends_with_it(video, tmp_path, capsys):
    from concent_warp.cli import main

    command = ["track", str(video), "-o", str(tmp_path / "tracked.h5"), "--pose", "none", "--json"]
    assert main([*command, "--live", "--view.port", "8790"]) == 0
    said = capsys.readouterr()
    address = re.search(r"(http://\S+) shows the tracking", said.err)
    assert address is not None
    assert json.loads(said.out)["tracks"][0]["frames_lost"] == 0
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(address[1], timeout=5)


def test_an_address_that_cannot_be_served_is_refused_before_anything_is_tracked(video, tmp_path, capsys):
    from concent_warp.cli import main

    out = tmp_path / "tracked.h5"
    assert main(["track", str(video), "-o", str(out), "--live", "--view.host", "203.0.113.1"]) == 2
    assert "no page can be served" in capsys.readouterr().err
    assert not out.exists()
