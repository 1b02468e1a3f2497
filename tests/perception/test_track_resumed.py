from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import replace

import pytest

import concent_warp as cw
from concent_warp.cli import main
from concent_warp.perception.tracking.checkpoint import state_path
from tests.perception.drawn_blocks import POSES, drawn

KILLED = """
import os, signal, sys
import concent_warp as cw
from concent_warp.perception.tracking import checkpoint

checkpoint.PERIOD, checkpoint.MAX_SHARE = 0.0, 1.0
video, out, poses, at = sys.argv[1:]

def progress(share):
    if share > float(at):
        os.kill(os.getpid(), signal.SIGKILL)

cw.track(cw.load_recording(video), bodies=["left"], pose=poses, out=out, progress=progress)
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A video of two demonstrations, a file of first poses, and the recording of a tracking without interruption."""
    folder = tmp_path_factory.mktemp("video")
    recording, _ = drawn(6)
    demonstrations = tuple(replace(recording[0], name=f"demo_{k}") for k in range(2))
    cw.write_hdf5(replace(recording, demonstrations=demonstrations), folder / "video.h5")
    (folder / "poses.toml").write_text(POSES)
    out = folder / "whole.h5"
    assert main(command(folder, out)) == 0
    assert not state_path(out).exists()
    return folder, out.read_bytes()


def command(folder, out, *options: str) -> list[str]:
    """Return the command that tracks one block."""
    poses = str(folder / "poses.toml")
    return ["track", str(folder / "video.h5"), "-o", str(out), "--pose", poses, "--body", "left", *options]


def killed(folder, out, share: float) -> None:
    """Track until a share is done, where the process is killed."""
    arguments = [sys.executable, "-c", KILLED, folder / "video.h5", out, folder / "poses.toml", share]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    ended = subprocess.run(list(map(str, arguments)), env=environment, capture_output=True, check=False)
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    assert not out.exists()


def test_a_tracking_killed_in_its_first_demonstration_is_continued_with_the_same_bytes(made, tmp_path, capsys):
    folder, whole = made
    out = tmp_path / "tracked.h5"
    killed(folder, out, 0.25)
    assert main(command(folder, out)) == 2
    said = capsys.readouterr().err
    assert "interrupted" in said
    assert "--resume" in said
    assert main(command(folder, out, "--resume")) == 0
    assert out.read_bytes() == whole
    assert not state_path(out).exists()
    assert main(command(folder, out, "--resume")) == 2


def test_of_a_later_demonstration_only_the_rest_is_done_and_a_foreign_state_is_refused(made, tmp_path):
    folder, whole = made
    out, shares = tmp_path / "new" / "tracked.h5", []
    killed(folder, out, 0.7)
    recording = cw.load_recording(folder / "video.h5")
    with pytest.raises(cw.RecordingError, match="another recording, or had other settings"):
        cw.track(recording, bodies=["right"], pose="none", out=out, resume=True)
    poses = folder / "poses.toml"
    cw.track(recording, bodies=["left"], pose=poses, out=out, resume=True, progress=shares.append)
    assert shares[0] > 0.7
    assert out.read_bytes() == whole
    state_path(out).write_bytes(b"damaged")
    with pytest.raises(cw.RecordingError, match="not the state of a tracking"):
        cw.track(recording, bodies=["left"], pose=poses, out=out, resume=True)
