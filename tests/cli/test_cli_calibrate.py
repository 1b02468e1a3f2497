import json

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.cli import main
from tests.perception.calibration.filming import CAMERA_ON_HAND, SIZE, Filming, film


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    path = tmp_path_factory.mktemp("calibrate") / "film.h5"
    cw.write_hdf5(film(Filming(frames=14)), path)
    return path


def test_recording_json_and_picture_are_written(filmed, tmp_path, capsys):
    out, picture = tmp_path / "new" / "calibrated.h5", tmp_path / "calibration.png"
    arguments = ["calibrate", str(filmed), "--tag-size", str(SIZE), "-o", str(out), "--picture", str(picture)]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert "clock offset" in said
    assert "recorded pose off by" in said
    pose = cw.load_recording(out)[0].image["eye"].pose
    assert np.linalg.norm(pose[:3, 3] - CAMERA_ON_HAND[:3, 3]) < 1e-3
    assert json.loads((out.parent / "calibration.json").read_text())["cameras"]["eye"]["body"] == "hand"
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert main(arguments) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_json_has_all_figures(filmed, capsys):
    assert main(["calibrate", str(filmed), "--tag-size", str(SIZE), "--json"]) == 0
    entry = json.loads(capsys.readouterr().out)["cameras"]["eye"]
    assert len(entry["intervals"]["position"]) == 3
    assert abs(entry["clock_offset"] - 0.03) < 2e-3


def test_what_cannot_be_calibrated_ends_in_one_sentence_and_leaves_nothing(filmed, tmp_path, capsys):
    out = tmp_path / "calibrated.h5"
    assert main(["calibrate", str(filmed), "--tag-size", "0.03", "-o", str(out)]) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "the size of the tags is wrong" in error
    assert "--tag-size" in error
    assert not list(tmp_path.iterdir())
    assert main(["calibrate", str(filmed), "--picture", "calibration.what"]) == 2
    assert "unknown kind of picture" in capsys.readouterr().err
    assert main(["calibrate", str(filmed), "--tag-size", "-1"]) == 2
    assert "--tag-size is out of bounds" in capsys.readouterr().err
