import os

import pytest

from concent_warp.errors import RecordingError
from concent_warp.recording.formats.contactnets import read_contactnets
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.load import load_recording


def test_the_kind_follows_from_the_path(tmp_path, recording):
    import torch

    rows = torch.zeros(5, 13)
    rows[:, 0], rows[:, 6] = 1, 0.3
    for folder in ("csv", "tosses"):
        (tmp_path / folder).mkdir()
    (tmp_path / "csv" / "scene.xml").write_text(recording.scene)
    (tmp_path / "csv" / "measured_elbow_angle.csv").write_text("time,angle\n0,0.1\n")
    torch.save(rows, tmp_path / "tosses" / "4.pt")
    write_hdf5(recording, tmp_path / "a.h5")
    write_hdf5(recording, tmp_path / "a.hdf5")
    assert len(load_recording(tmp_path / "a.h5").demonstrations) == 3
    assert len(load_recording(str(tmp_path / "a.hdf5")).demonstrations) == 3
    assert load_recording(tmp_path / "csv")[0].measured["elbow_angle"].value == 0.1
    assert load_recording(tmp_path / "tosses").scene == read_contactnets(tmp_path / "tosses" / "4.pt").scene
    assert load_recording(tmp_path / "tosses" / "4.pt")[0].name == "demo_4"


def test_what_is_no_recording_is_refused_with_the_kinds_there_are(tmp_path):
    for name, message in {"gone.h5": "no such recording", "a.mat": "unknown kind", "bare": "found no suffix"}.items():
        if name != "gone.h5":
            (tmp_path / name).touch()
        with pytest.raises(RecordingError, match=message) as caught:
            load_recording(tmp_path / name)
        assert ".hdf5" in str(caught.value)
    (tmp_path / "empty.h5").mkdir()
    with pytest.raises(RecordingError, match="the folder holds no recording"):
        load_recording(tmp_path / "empty.h5")
    os.mkfifo(tmp_path / "pipe.h5")
    with pytest.raises(RecordingError, match="no such recording file"):
        load_recording(tmp_path / "pipe.h5")
