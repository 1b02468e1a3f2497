import json

import numpy as np

from concent_warp.cli import main
from concent_warp.recording.formats.hdf5 import write_hdf5
from tests.diagnosis.forces.locate_scenes import swing, throw


def test_locate_prints_sentences_and_writes_what_was_asked_for(tmp_path, capsys):
    write_hdf5(throw((0, -0.5, 0.2), (0.02, 0.03, -0.01), fly=True, count=2), tmp_path / "throws.h5")
    files = ["--html", str(tmp_path / "r.html"), "--png", str(tmp_path / "r.png")]
    assert main(["locate", str(tmp_path / "throws.h5"), *files]) == 0
    out = capsys.readouterr().out
    assert "block, free" in out
    assert "+y face" in out
    assert "+y face" in (tmp_path / "r.html").read_text()
    assert (tmp_path / "r.png").stat().st_size > 10_000
    assert main(["locate", str(tmp_path / "throws.h5"), *files]) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_locate_prints_one_json_object_and_nothing_else(tmp_path, capsys):
    recording = swing(lambda d: -0.01 * np.sign(d.qvel[0]), duration=2)
    write_hdf5(recording, tmp_path / "swing.h5")
    (tmp_path / "model.xml").write_text(recording.scene)
    arguments = ["--model", str(tmp_path / "model.xml"), "--window", "0.08", "--json"]
    assert main(["locate", str(tmp_path / "swing.h5"), *arguments]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["window"] == 0.08
    assert document["joints"][0]["significant"]
    assert document["joints"][0]["patterns"][0]["feature"] == "direction of motion"


def test_locate_refuses_windows_without_length(tmp_path, capsys):
    write_hdf5(swing(lambda _: 0.0, duration=0.5), tmp_path / "swing.h5")
    assert main(["locate", str(tmp_path / "swing.h5"), "--window", "0"]) == 2
    assert "--window is out of bounds; expected at least 0.001" in capsys.readouterr().err


def test_locate_refuses_pictures_of_unknown_kinds_before_it_works(tmp_path, capsys):
    write_hdf5(swing(lambda _: 0.0, duration=0.5), tmp_path / "swing.h5")
    assert main(["locate", str(tmp_path / "swing.h5"), "--png", str(tmp_path / "forces.what")]) == 2
    assert "forces.what: unknown kind of picture; expected one of .png, .pdf" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["swing.h5"]
