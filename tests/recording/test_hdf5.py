import os
import random
import signal
import subprocess
import sys
import textwrap
from dataclasses import asdict
from pathlib import Path

import h5py
import numpy as np
import pytest

from concent_warp import files
from concent_warp.errors import RecordingError
from concent_warp.recording.formats.hdf5 import read_hdf5, write_hdf5
from concent_warp.recording.recording import Recording


def assert_same(a: Recording, b: Recording) -> None:
    assert a.scene == b.scene
    assert [d.name for d in a.demonstrations] == [d.name for d in b.demonstrations]
    for one, other in zip(a.demonstrations, b.demonstrations, strict=True):
        np.testing.assert_equal(asdict(one), asdict(other))


@pytest.fixture
def path(tmp_path, recording) -> Path:
    write_hdf5(recording, tmp_path / "recording.h5")
    return tmp_path / "recording.h5"


def refusal(path: Path) -> str | None:
    try:
        assert read_hdf5(path).demonstrations
    except RecordingError as error:
        return str(error)
    return None


def plain_copy(path: Path, libver: str, **storage) -> Path:
    """Write the same recording as a user of h5py would, with strings of variable length."""
    copy = path.with_name("plain.h5")
    with h5py.File(path) as source, h5py.File(copy, "w", libver=libver) as target:

        def add(name: str, item) -> None:
            if name == "scene":
                target[name] = item[()].decode()
            elif isinstance(item, h5py.Dataset):
                target.create_dataset(name, data=item[()], **(storage if item.ndim else {}))
            else:
                target.require_group(name)
            for key, value in item.attrs.items():
                target[name].attrs[key] = value.decode() if isinstance(value, bytes) else value

        add("/", source)
        source.visititems(add)
    return copy


def test_reading_gives_back_what_was_written(path, recording):
    read = read_hdf5(path)
    assert_same(read, recording)
    assert read.source == str(path)
    assert [d.name for d in read.demonstrations] == ["demo_0", "demo_2", "demo_10"]
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("libver", ["earliest", "latest"])
@pytest.mark.parametrize("storage", [{}, {"compression": "gzip"}, {"compression": "lzf", "shuffle": True}])
def test_files_of_other_writers_are_read(path, recording, libver, storage):
    assert_same(read_hdf5(plain_copy(path, libver, **storage)), recording)


def test_numbers_of_other_widths_are_read_as_doubles(path):
    with h5py.File(path, "r+") as file:
        group = file.require_group("data/demo_0/measured/grip_width")
        value = np.asarray(group["value"])
        del group["value"]
        group["value"] = value.astype("f4")
    read = read_hdf5(path)["demo_0"].measured["grip_width"].value
    assert read.dtype == np.float64
    np.testing.assert_allclose(read, value, rtol=1e-6)


def test_a_long_constant_channel_is_not_taken_for_missing_data(tmp_path, recording):
    long = recording.demonstrations[2]
    channel = type(long.measured["elbow_angle"])(np.arange(300_000) * 1e-3, np.zeros((300_000, 1)))
    one = type(long)("demo_0", measured={"elbow_angle": channel})
    write_hdf5(Recording(recording.scene, (one,)), tmp_path / "long.h5")
    assert len(read_hdf5(tmp_path / "long.h5")[0].measured["elbow_angle"].time) == 300_000


def test_a_scene_beside_the_recording_is_read_with_its_meshes(path, recording):
    (path.parent / "scene.xml").write_text(recording.scene)
    with h5py.File(path, "r+") as file:
        del file["scene"]
        file.attrs["path"] = "scene.xml"
    assert "elbow_angle" in read_hdf5(path).scene
    with h5py.File(path, "r+") as file:
        file.attrs["path"] = "../scene.xml"
    with pytest.raises(RecordingError, match="must lie beside the recording"):
        read_hdf5(path)
    with h5py.File(path, "r+") as file:
        file.attrs["path"] = "gone.xml"
    with pytest.raises(RecordingError, match="no such MJCF file"):
        read_hdf5(path)


def test_an_invalid_recording_is_not_written(tmp_path, recording):
    with pytest.raises(RecordingError, match="no demonstration"):
        write_hdf5(Recording(recording.scene, ()), tmp_path / "recording.h5")
    assert not list(tmp_path.iterdir())
    with pytest.raises(RecordingError, match="folder to write to does not exist"):
        write_hdf5(recording, tmp_path / "gone" / "recording.h5")


def test_a_write_that_fails_leaves_the_old_file(path, recording, monkeypatch):
    before = path.read_bytes()

    def full(*_):
        raise OSError("No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(RecordingError, match="cannot be written; found No space left"):
        write_hdf5(recording, path)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def test_a_killed_write_leaves_the_old_file(path):
    before = path.read_bytes()
    script = f"""
        import os, signal
        from pathlib import Path
        from concent_warp import files
        from concent_warp.recording.formats import hdf5
        recording = hdf5.read_hdf5(Path({str(path)!r}))
        files.os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL)
        hdf5.write_hdf5(recording, Path({str(path)!r}))
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], check=False)
    assert done.returncode == -signal.SIGKILL
    assert path.read_bytes() == before
    write_hdf5(read_hdf5(path), path)
    assert os.listdir(path.parent) == [path.name]


def test_nothing_outside_the_file_is_read(path, tmp_path):
    value = "data/demo_0/measured/grip_width/value"
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["value"] = np.full((50, 1), 0.02)
    (tmp_path / "raw").write_bytes(np.full(50, 0.02).tobytes())
    layout = h5py.VirtualLayout((50, 1), "f8")
    layout[:] = h5py.VirtualSource(tmp_path / "other.h5", "value", (50, 1))

    def replaced(make) -> Path:
        with h5py.File(path, "r+") as file:
            del file[value]
            make(file)
        return path

    for link in (h5py.ExternalLink("other.h5", "/value"), h5py.SoftLink("/data/demo_0/measured/elbow_angle/value")):
        with pytest.raises(RecordingError, match="links are not followed"):
            read_hdf5(replaced(lambda file, link=link: file.__setitem__(value, link)))
    with pytest.raises(RecordingError, match="lie in another file"):
        read_hdf5(replaced(lambda file: file.create_virtual_dataset(value, layout)))
    raw = [(str(tmp_path / "raw"), 0, 400)]
    with pytest.raises(RecordingError, match="lie in another file"):
        read_hdf5(replaced(lambda file: file.create_dataset(value, (50, 1), "f8", external=raw)))


@pytest.mark.parametrize(
    ("storage", "message"),
    [
        ({"shape": (10**6, 10**6), "chunks": (10, 10)}, "the recording is too large"),
        ({"shape": (10**9, 1), "chunks": (10, 1)}, "wrong shape"),
        ({"shape": (10**6, 10), "chunks": (10, 10)}, "not in the file, or only in part"),
        ({"shape": (50, 1), "maxshape": (None, None), "chunks": (10**5, 10**3)}, "chunks are too large"),
    ],
)
def test_absurd_sizes_are_refused_before_they_are_loaded(path, storage, message):
    value = "data/demo_0/measured/grip_width/value"
    with h5py.File(path, "r+") as file:
        del file[value]
        file.create_dataset(value, dtype="f8", compression="gzip", **storage)
    with pytest.raises(RecordingError, match=message):
        read_hdf5(path)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda f: f.attrs.__delitem__("format"), "not a recording"),
        (lambda f: f.attrs.__setitem__("version", 2), "unknown version"),
        (lambda f: f.attrs.__setitem__("version", [1, 1]), "unknown version"),
        (lambda f: f.__delitem__("data"), "/data: an entry is missing; expected a group"),
        (lambda f: f.__delitem__("scene"), "the recording has no scene"),
        (lambda f: f.move("data/demo_0/measured", "data/demo_0/mesured"), r"unknown entries; .*'mesured'"),
        (
            lambda f: f.__delitem__("data/demo_0/action/elbow/time"),
            "/data/demo_0/action/elbow/time: an entry is missing",
        ),
        (lambda f: f["data/demo_0"].attrs.__setitem__("success", 7), "success is not a truth value"),
        (lambda f: f["data/demo_0/image/wrist"].attrs.__delitem__("pose"), "pose is not a matrix"),
        (
            lambda f: f["data/demo_0/measured/elbow_angle"].attrs.__setitem__("noise_std", "x"),
            "noise_std is not a numb",
        ),
    ],
)
def test_broken_entries_are_refused(path, edit, message):
    with h5py.File(path, "r+") as file:
        edit(file)
    with pytest.raises(RecordingError, match=message):
        read_hdf5(path)


@pytest.mark.parametrize("kind", ["own", "earliest", "latest"])
def test_damaged_files_give_a_recording_or_an_error_that_says_so(path, kind):
    """Truncated and overwritten files; those with strings of variable length made the HDF5 library hang and crash."""
    sound = (path if kind == "own" else plain_copy(path, kind)).read_bytes()
    rng = random.Random(f"{kind} 1")
    heap = max(sound.find(b"GCOL"), 0)
    refused = 0
    for trial in range(75):
        damaged = bytearray(sound)
        if trial % 5 == 0:
            del damaged[rng.randrange(len(damaged)) :]
        for _ in range(rng.choice([1, 2, 8, 64]) if trial % 5 else 0):
            place = heap + rng.randrange(600) if trial % 2 else rng.randrange(len(damaged))
            damaged[place % len(damaged)] = rng.choice([0, 255, rng.randrange(256)])
        path.write_bytes(damaged)
        message = refusal(path)
        refused += message is not None
        assert message is None or len(message.splitlines()) == 1
    assert refused > 15


def test_damage_to_measured_values_is_noticed(path):
    with h5py.File(path) as file:
        chunk = file["data/demo_0/measured/block_position/value"].id.get_chunk_info(0)
    damaged = bytearray(path.read_bytes())
    damaged[chunk.byte_offset + chunk.size // 2] ^= 0x10
    path.write_bytes(damaged)
    with pytest.raises(RecordingError, match="damaged"):
        read_hdf5(path)
