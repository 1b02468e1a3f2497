"""Flipped bits, misspelt attributes, files that unpack to gigabytes, clocks of years."""

import random
import warnings
from dataclasses import replace
from typing import Any

import h5py
import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.recording.formats.hdf5 import read_hdf5, write_hdf5
from concent_warp.recording.recording import Channel, Recording
from concent_warp.recording.validation.validate import validate
from tests.recording.test_hdf5 import assert_same


@pytest.fixture
def path(tmp_path, recording):
    write_hdf5(recording, tmp_path / "recording.h5")
    return tmp_path / "recording.h5"


def span(path, entry: str) -> range:
    """Return the bytes of the file in which a dataset's data lie."""
    with h5py.File(path) as file:
        dataset: Any = file[entry]
        return range(dataset.id.get_offset(), dataset.id.get_offset() + dataset.id.get_storage_size())


@pytest.mark.parametrize("entry", ["scene", "data/demo_0/initial/qpos", "data/demo_0/initial/qvel"])
def test_each_flipped_bit_in_scene_and_initial_state_is_noticed(path, entry):
    sound, places = path.read_bytes(), span(path, entry)
    for place in places if len(places) < 80 else random.Random(0).sample(places, 80):
        damaged = bytearray(sound)
        damaged[place] ^= 1 << place % 8
        path.write_bytes(damaged)
        with pytest.raises(RecordingError, match=f"{entry}: .*data are damaged|{entry}: not UTF-8"):
            read_hdf5(path)


def test_a_flipped_bit_anywhere_is_noticed_or_without_effect(path, recording):
    sound, rng = path.read_bytes(), random.Random(1)
    harmless = 0
    for _ in range(160):
        damaged = bytearray(sound)
        place = rng.randrange(len(damaged))
        damaged[place] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        try:
            read = read_hdf5(path)
        except RecordingError:
            continue
        harmless += 1
        assert_same(read, recording)
    assert harmless < 80


def test_a_file_without_checksums_is_read(path, recording):
    with h5py.File(path, "r+") as file:
        del file["scene"].attrs["sha256"]
        for name in ("qpos", "qvel"):
            del file[f"data/demo_0/initial/{name}"].attrs["sha256"]
    assert_same(read_hdf5(path), recording)


def test_a_change_without_its_checksum_is_refused_with_what_to_do(path):
    with h5py.File(path, "r+") as file:
        qpos: Any = file["data/demo_0/initial/qpos"]
        qpos[0] = 0.2
    with pytest.raises(RecordingError, match=r"qpos: the data are damaged.*delete the attribute 'sha256'"):
        read_hdf5(path)


@pytest.mark.parametrize(
    ("entry", "name", "message"),
    [
        ("data/demo_0/measured/elbow_angle", "noise_stdd", "attribute noise_stdd: unknown .*did you mean 'noise_std'?"),
        ("data/demo_0/measured/elbow_angle", "Noise_Std", "did you mean 'noise_std'?"),
        ("data/demo_0/measured/elbow_angle/value", "noise_std", "'noise_std' belongs to another entry"),
        ("data/demo_0", "succes", "did you mean 'success'?"),
        ("data/demo_0/image/wrist", "intrinsic", "did you mean 'intrinsics'?"),
        ("/", "formats", "did you mean 'format'?"),
    ],
)
def test_a_misspelt_attribute_is_refused_with_the_nearest_name(path, entry, name, message):
    with h5py.File(path, "r+") as file:
        file[entry].attrs[name] = 0.5
    with pytest.raises(RecordingError, match=message):
        read_hdf5(path)


def test_attributes_that_are_not_read_are_named_in_a_warning(path, recording):
    with h5py.File(path, "r+") as file:
        file["data/demo_0"].attrs["operator\x1b[31m"] = "Ada"
        file["data/demo_0"].attrs["CLASS"] = "GROUP"
    with pytest.warns(UserWarning, match=r"attributes that are not read: /data/demo_0, operator\\x1b\[31m$"):
        assert_same(read_hdf5(path), recording)


def test_a_sound_file_gives_no_warning(path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_hdf5(path)


def test_a_small_file_that_unpacks_to_gigabytes_is_refused_unless_it_is_meant(path, monkeypatch):
    with h5py.File(path, "r+") as file:
        group: Any = file["data/demo_0/measured/elbow_angle"]
        for name, value in (("time", np.arange(600_000) / 1e4), ("value", np.zeros((600_000, 1)))):
            del group[name]
            group.create_dataset(name, data=value, compression="gzip", shuffle=True)
    monkeypatch.setenv("CONCENT_MAX_UNPACKED_BYTES", "1000000")
    monkeypatch.setenv("CONCENT_MAX_INFLATION", "1")
    with pytest.raises(RecordingError, match=r"too large; .*once unpacked, .*CONCENT_MAX_UNPACKED_BYTES higher"):
        read_hdf5(path)
    monkeypatch.setenv("CONCENT_MAX_UNPACKED_BYTES", "100000000")
    assert len(read_hdf5(path)["demo_0"].measured["elbow_angle"].time) == 600_000


def test_the_default_limits_refuse_a_bomb_before_it_is_unpacked(path):
    count = 8_000_000
    with h5py.File(path, "r+") as file:
        group: Any = file["data/demo_0/points/block"]
        del group["value"]
        block = np.zeros((100_000, 5, 3))
        values = group.create_dataset("value", (count, 5, 3), chunks=(100_000, 5, 3), compression="gzip")
        values[: len(block)] = block
        _, stored = values.id.read_direct_chunk((0, 0, 0))
        for k in range(1, count // len(block)):
            values.id.write_direct_chunk((k * len(block), 0, 0), stored)
    assert path.stat().st_size < 2_000_000
    with pytest.raises(RecordingError, match="the recording is too large"):
        read_hdf5(path)


@pytest.mark.parametrize(
    ("kind", "name", "dtype"),
    [
        ("measured", "elbow_angle", "c16"),
        ("measured", "elbow_angle", "V8"),
        ("measured", "elbow_angle", "S4"),
        ("measured", "elbow_angle", [("a", "f8")]),
        ("points", "block", "c8"),
    ],
)
def test_numbers_of_odd_kinds_are_refused(path, kind, name, dtype):
    with h5py.File(path, "r+") as file:
        group: Any = file[f"data/demo_0/{kind}/{name}"]
        shape = group["value"].shape
        del group["value"]
        group["value"] = np.zeros(shape, dtype)
    with pytest.raises(RecordingError, match="value: wrong kind of data"):
        read_hdf5(path)


@pytest.mark.parametrize("shape", [(), (0,), None, (50, 1, 1, 1, 1)])
def test_arrays_of_odd_shapes_are_refused(path, shape):
    with h5py.File(path, "r+") as file:
        group: Any = file["data/demo_0/measured/elbow_angle"]
        del group["value"]
        group["value"] = h5py.Empty("f8") if shape is None else np.zeros(shape)
    with pytest.raises(RecordingError, match=r"elbow_angle.*wrong shape"):
        read_hdf5(path)


def with_channel(recording: Recording, kind: str, name: str, channel: Channel) -> Recording:
    first = recording.demonstrations[0]
    streams = {**getattr(first, kind), name: channel}
    return replace(recording, demonstrations=(replace(first, **{kind: streams}),))


@pytest.mark.parametrize(
    ("time", "message"),
    [
        (1e9, r"action/elbow: .*too long to be simulated; expected at most 86,400 s, found a sample at 1e\+09 s"),
        (5e4, "action/elbow: .*at most 4,000,000 steps of the scene, found a sample at 50,000 s; .*CONCENT_MAX_STEPS"),
    ],
)
def test_a_command_after_hours_is_refused(recording, time, message):
    late = Channel(np.array([0.0, time]), np.zeros(2))
    with pytest.raises(RecordingError, match=message):
        validate(with_channel(recording, "action", "elbow", late))
