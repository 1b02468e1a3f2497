from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.recording.cut import beginning
from concent_warp.recording.formats.hdf5 import read_hdf5, write_hdf5
from concent_warp.recording.recording import Recording
from concent_warp.recording.validation.validate import validate
from tests.recording.conftest import sound_recording

NAMES = ("block_position", "block_orientation")


def with_covariance(edit=None) -> Recording:
    """Return a recording whose pose channels have covariances, after a change of those of the position."""
    recording = sound_recording()
    first = recording[0]
    measured = dict(first.measured)
    for name in NAMES:
        channel = measured[name]
        covariance = np.tile(np.diag([1e-6, 2e-6, 3e-6]), (len(channel.time), 1, 1))
        covariance[np.isnan(channel.value).any(axis=1)] = np.nan
        if edit is not None and name == NAMES[0]:
            covariance = edit(covariance)
        measured[name] = replace(channel, covariance=covariance)
    return replace(recording, demonstrations=(replace(first, measured=measured), *recording.demonstrations[1:]))


def test_covariances_are_read_as_they_were_written(tmp_path):
    recording = with_covariance()
    write_hdf5(recording, tmp_path / "a.h5")
    read = read_hdf5(tmp_path / "a.h5")
    for name in NAMES:
        np.testing.assert_array_equal(read[0].measured[name].covariance, recording[0].measured[name].covariance)
    assert read[0].measured["elbow_angle"].covariance is None


def test_files_without_covariances_are_read_as_before(tmp_path):
    write_hdf5(sound_recording(), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        names: list[str] = []
        file.visit(names.append)
    assert "data/demo_0/measured/block_position/value" in names
    assert not any("covariance" in name for name in names)
    assert all(c.covariance is None for c in read_hdf5(tmp_path / "a.h5")[0].measured.values())


def set_at(row, value):
    def edit(covariance):
        covariance[row] = value
        return covariance

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda c: c[:-1], "wrong shape of covariance"),
        (lambda c: c[:, :2, :2], "wrong shape of covariance"),
        (set_at(3, np.nan), "row 3.*a covariance is missing|a covariance is missing"),
        (set_at(3, np.diag([1.0, 1.0, -1.0])), "negative variance"),
        (set_at(3, np.array([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]])), "not symmetric"),
        (set_at(3, np.inf), "covariance"),
    ],
)
def test_what_is_no_covariance_is_refused(edit, message):
    with pytest.raises(RecordingError, match=message) as caught:
        validate(with_covariance(edit))
    assert "block_position" in str(caught.value)


def with_common(edit=None) -> Recording:
    """Return the recording whose position has errors in common, after a change of these."""
    recording = with_covariance()
    first = recording[0]
    channel = first.measured[NAMES[0]]
    common = np.tile(np.array([[1e-3, 0.0], [0.0, 1e-3], [0.0, 1e-4]]), (len(channel.time), 1, 1))
    common[np.isnan(channel.value).any(axis=1)] = np.nan
    measured = {**first.measured, NAMES[0]: replace(channel, common=common if edit is None else edit(common))}
    return replace(recording, demonstrations=(replace(first, measured=measured), *recording.demonstrations[1:]))


def test_errors_in_common_are_read_as_they_were_written_and_cut_with_the_samples(tmp_path):
    recording = with_common()
    write_hdf5(recording, tmp_path / "a.h5")
    read = read_hdf5(tmp_path / "a.h5")
    np.testing.assert_array_equal(read[0].measured[NAMES[0]].common, recording[0].measured[NAMES[0]].common)
    assert read[0].measured[NAMES[1]].common is None
    validate(read)
    half = beginning(read, read[0].measured[NAMES[0]].time[2])[0].measured[NAMES[0]]
    assert half.common is not None
    assert len(half.common) == len(half.time) == 3


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda c: c[:-1], "wrong shape of common"),
        (lambda c: c[:, :2], "wrong shape of common"),
        (set_at(3, np.nan), "an error in common is missing"),
        (lambda c: 1.1 * c, "errors in common exceed the covariance"),
    ],
)
def test_errors_in_common_that_are_no_part_of_the_covariance_are_refused(edit, message):
    with pytest.raises(RecordingError, match=message) as caught:
        validate(with_common(edit))
    assert "block_position" in str(caught.value)


def test_errors_in_common_without_a_covariance_are_refused():
    recording = with_common()
    first = recording[0]
    measured = {**first.measured, NAMES[0]: replace(first.measured[NAMES[0]], covariance=None)}
    with pytest.raises(RecordingError, match="errors in common without a covariance"):
        validate(replace(recording, demonstrations=(replace(first, measured=measured), *recording.demonstrations[1:])))
