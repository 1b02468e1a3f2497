"""Broken recordings, scenes and models: each case breaks one thing in an input that is sound otherwise."""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from concent_warp.model import Model
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.recording import Channel, Demonstration, ImageStream, PointTrack, Recording
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

SCENE = """
<mujoco>
  <worldbody>
    <geom name="table" type="plane" size="1 1 0.1"/>
    <body name="arm" pos="0 0 0.5">
      <joint name="elbow" type="hinge" axis="0 1 0" range="-170 170"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0"/>
    </body>
    <body name="block" pos="0.4 0 0.02"><freejoint/><geom name="block" type="box" size="0.02 0.02 0.02"/></body>
  </worldbody>
  <actuator><position name="elbow" joint="elbow" kp="20" ctrlrange="-2.9 2.9"/></actuator>
  <sensor>
    <jointpos name="elbow_angle" joint="elbow"/>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""
TIME = np.arange(60) * 0.01


@dataclass(frozen=True)
class Case:
    """One broken input."""

    kind: str
    """What is broken: recording, scene or model."""
    name: str
    """What is wrong with it."""
    build: Callable[[Path], tuple[Path, Path]]
    """Writes the input into an empty folder and returns the recording and the model to give to the command."""


def good_recording() -> Recording:
    """Return a sound recording with every kind of channel."""
    angle = 0.5 * np.sin(3 * TIME)
    position = np.tile([0.4, 0.0, 0.02], (len(TIME), 1))
    camera = ImageStream(
        TIME[:3],
        np.full((3, 6, 8, 3), 90, np.uint8),
        np.ones((3, 6, 8), np.float32),
        np.array([[8.0, 0, 4], [0, 8, 3], [0, 0, 1]]),
        np.eye(4),
    )
    demonstration = Demonstration(
        name="demo_0",
        task="push",
        qpos=np.array([0, 0.4, 0, 0.02, 1, 0, 0, 0]),
        qvel=np.zeros(7),
        action={"elbow": Channel(TIME, angle)},
        measured={
            "elbow_angle": Channel(TIME, angle[:, None]),
            "block_position": Channel(TIME, position),
            "block_orientation": Channel(TIME, np.tile([1.0, 0, 0, 0], (len(TIME), 1))),
        },
        points={"block": PointTrack(TIME, np.tile(position[:, None], (1, 4, 1)), np.ones((len(TIME), 4), bool))},
        image={"wrist": camera},
    )
    return Recording(SCENE, (demonstration,))


def write_good(folder: Path) -> tuple[Path, Path]:
    """Write a sound recording and a sound model."""
    write_hdf5(good_recording(), folder / "recording.h5")
    geometry = ContactGeometry(
        bodies=("block",),
        body=np.zeros(2, int),
        position=np.array([[0.01, 0, 0], [-0.01, 0, 0]]),
        radius=np.full(2, 0.01),
        mass=np.full(2, 0.03),
        friction=np.full(2, 0.5),
    )
    Model(Scene(SCENE), geometry).save(folder / "model.toml")
    return folder / "recording.h5", folder / "model.toml"


def file_case(name: str, edit: Callable[[h5py.File], None]) -> Case:
    """Return a case that edits a sound HDF5 file."""

    def build(folder: Path) -> tuple[Path, Path]:
        recording, model = write_good(folder)
        with h5py.File(recording, "r+") as file:
            edit(file)
        return recording, model

    return Case("recording", name, build)


def data_case(name: str, entry: str, change: Callable[[np.ndarray], object]) -> Case:
    """Return a case that replaces one dataset of the demonstration."""

    def edit(file: h5py.File) -> None:
        dataset = file[f"data/demo_0/{entry}"]
        assert isinstance(dataset, h5py.Dataset)
        value = change(dataset[()])
        del file[f"data/demo_0/{entry}"]
        file[f"data/demo_0/{entry}"] = value

    return file_case(name, edit)


def path_case(name: str, suffix: str, write: Callable[[Path], object]) -> Case:
    """Return a case in which `write` makes the whole recording."""

    def build(folder: Path) -> tuple[Path, Path]:
        _, model = write_good(folder)
        broken = folder / f"broken{suffix}"
        write(broken)
        return broken, model

    return Case("recording", name, build)


def put(row: int, number: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return a change that sets one row."""

    def change(value: np.ndarray) -> np.ndarray:
        value = value.copy()
        value[row] = number
        return value

    return change


def relink(link: h5py.SoftLink | h5py.ExternalLink) -> Callable[[h5py.File], None]:
    """Return an edit that puts a link in place of a channel's values."""

    def edit(file: h5py.File) -> None:
        del file["data/demo_0/measured/elbow_angle/value"]
        file["data/demo_0/measured/elbow_angle/value"] = link

    return edit


def move(old: str, new: str) -> Callable[[h5py.File], None]:
    """Return an edit that renames an entry of the demonstration."""
    return lambda file: file.require_group("data/demo_0").move(old, new)


def set_scene(text: str) -> Callable[[h5py.File], None]:
    """Return an edit that replaces the scene."""

    def edit(file: h5py.File) -> None:
        del file["scene"]
        file["scene"] = text

    return edit


def set_pose(pose: np.ndarray) -> Callable[[h5py.File], None]:
    """Return an edit that replaces the pose of the camera."""
    return lambda file: file["data/demo_0/image/wrist"].attrs.modify("pose", pose)


def absurd_size(file: h5py.File) -> None:
    """Declare a channel of 10^12 numbers, of which none is written."""
    del file["data/demo_0/measured/elbow_angle/value"]
    file.create_dataset("data/demo_0/measured/elbow_angle/value", shape=(10**6, 10**6), dtype="f8", chunks=(100, 100))


def hdf5_cases() -> Iterator[Case]:
    """Yield broken HDF5 recordings."""
    elbow, block = "measured/elbow_angle", "measured/block_position"
    yield file_case("wrong format attribute", lambda f: f.attrs.__setitem__("format", "robomimic"))
    yield file_case("version of the future", lambda f: f.attrs.__setitem__("version", 99))
    yield file_case("no scene", lambda f: f.__delitem__("scene"))
    yield file_case("MJCF that does not compile", set_scene(SCENE.replace('joint="elbow" kp', 'joint="knee" kp')))
    yield file_case("MJCF that includes a file", set_scene('<mujoco><include file="/etc/hostname"/></mujoco>'))
    yield file_case("no demonstrations", lambda f: f.require_group("data").__delitem__("demo_0"))
    yield file_case("misspelt group", move("measured", "mesured"))
    yield file_case("unknown sensor", move(elbow, "measured/knee_angle"))
    yield file_case("unknown actuator", move("action/elbow", "action/knee"))
    yield file_case("points of an unknown body", move("points/block", "points/brick"))
    yield data_case("times not sorted", f"{elbow}/time", lambda t: t[::-1])
    yield data_case("a time twice", f"{elbow}/time", put(5, TIME[4]))
    yield data_case("a time is NaN", f"{elbow}/time", put(5, np.nan))
    yield data_case("negative time", f"{elbow}/time", lambda t: t - 0.5)
    yield data_case("times in milliseconds", f"{elbow}/time", lambda t: t * 1e3)
    yield data_case("times since 1970", f"{elbow}/time", lambda t: t + 1.7e9)
    yield data_case("an infinite value", f"{elbow}/value", put(7, np.inf))
    yield data_case("a channel of NaN", f"{elbow}/value", lambda v: v * np.nan)
    yield data_case("a run of NaN in a command", "action/elbow/value", put(slice(20, 40), np.nan))  # type: ignore[arg-type]
    yield data_case("too few numbers per sample", f"{block}/value", lambda v: v[:, :2])
    yield data_case("fewer values than times", f"{block}/value", lambda v: v[:-3])
    yield data_case("text for numbers", f"{block}/value", lambda v: v.astype("S"))
    yield data_case("quaternions not of unit length", "measured/block_orientation/value", lambda q: q * 3)
    yield data_case("positions in millimetres", f"{block}/value", lambda v: v * 1e3)
    yield data_case("angles in degrees", f"{elbow}/value", np.degrees)
    yield data_case("commands in degrees", "action/elbow/value", np.degrees)
    yield data_case("wrong size of qpos", "initial/qpos", lambda q: q[:-1])
    yield data_case("points of a wrong shape", "points/block/value", lambda p: p[..., :2])
    yield data_case("visible of a wrong shape", "points/block/visible", lambda v: v[:, :1])
    yield data_case("depth in integer millimetres", "image/wrist/depth", lambda d: (d * 1000).astype("u2"))
    yield file_case(
        "camera pose no rotation", lambda f: f["data/demo_0/image/wrist"].attrs.modify("pose", np.ones((4, 4)))
    )
    yield file_case("10^12 numbers declared", absurd_size)
    yield file_case("external link", relink(h5py.ExternalLink("/etc/other.h5", "/value")))
    yield file_case("soft link", relink(h5py.SoftLink("/data/demo_0/action/elbow/value")))


def path_cases() -> Iterator[Case]:
    """Yield recordings whose file or folder is broken as a whole."""

    def truncated(path: Path) -> None:
        write_hdf5(good_recording(), path)
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])

    yield path_case("truncated HDF5", ".h5", truncated)
    yield path_case("no HDF5 in it", ".h5", lambda p: p.write_text("time,value\n" * 100))
    yield path_case("empty file", ".h5", Path.touch)
    yield path_case("missing file", ".h5", lambda _: None)
    yield path_case("unknown suffix", ".mat", Path.touch)
    yield path_case("empty folder", "", Path.mkdir)
    yield path_case("folder in place of a file", ".h5", Path.mkdir)


def csv_case(name: str, text: str | None, file: str = "measured_elbow_angle.csv", scene: bool = True) -> Case:
    """Return a case of a CSV folder with one file of the given text."""

    def write(folder: Path) -> None:
        folder.mkdir()
        if scene:
            (folder / "scene.xml").write_text(SCENE)
        if text is not None:
            (folder / file).write_text(text)

    return path_case(name, "", write)


def csv_cases() -> Iterator[Case]:
    """Yield broken folders of CSV files."""
    yield csv_case("CSV with text in a cell", "time,angle\n0,0.1\n0.01,open\n")
    yield csv_case("CSV without a header", "0,0.1\n0.01,0.2\n")
    yield csv_case("CSV without time", "angle,speed\n0.1,0\n")
    yield csv_case("CSV with a ragged row", "time,angle\n0,0.1\n0.01,0.2,0.3\n")
    yield csv_case("CSV with semicolons and commas", "time;angle\n0;0,1\n")
    yield csv_case("CSV file of an unknown name", "time,angle\n0,0.1\n", file="elbow.csv")
    yield csv_case("CSV folder without a scene", "time,angle\n0,0.1\n", scene=False)
    yield csv_case("CSV folder without CSV files", None)


class Code:
    """An object whose pickle would run code when loaded."""

    def __reduce__(self) -> tuple[Callable[[str], object], tuple[str]]:
        return Path.touch, (Path("executed"),)  # type: ignore[return-value]


def toss_cases() -> Iterator[Case]:
    """Yield broken tosses."""
    import torch

    def pickled(path: Path) -> None:
        path.write_bytes(pickle.dumps(Code()))

    def zipped(path: Path) -> None:
        torch.save({"toss": Code()}, path)

    def stretched(path: Path) -> None:
        torch.save(torch.zeros(1, 13).expand(10**11, 13), path)

    def truncated(path: Path) -> None:
        torch.save(torch.zeros(100, 13), path)
        path.write_bytes(path.read_bytes()[:-900])

    def archive(path: Path) -> None:
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("readme", "no tensor")

    def nan_rows(path: Path) -> None:
        rows = torch.zeros(100, 13)
        rows[:, 0], rows[40:, 4] = 1, torch.inf
        torch.save(rows, path)

    yield path_case("pickle that names code in a .pt", ".pt", pickled)
    yield path_case("pickle that names code in a zipped .pt", ".pt", zipped)
    yield path_case("toss of a wrong shape", ".pt", lambda p: torch.save(torch.zeros(50, 7), p))
    yield path_case("toss of 10^12 numbers", ".pt", stretched)
    yield path_case("truncated toss", ".pt", truncated)
    yield path_case("zip without a tensor", ".pt", archive)
    yield path_case("infinite positions in a toss", ".pt", nan_rows)
    yield path_case("empty .pt file", ".pt", Path.touch)
    yield path_case("folder named .pt without tosses", ".pt", Path.mkdir)


def model_case(kind: str, name: str, change: Callable[[Path], object]) -> Case:
    """Return a case that edits the files of a sound model."""

    def build(folder: Path) -> tuple[Path, Path]:
        recording, model = write_good(folder)
        change(folder)
        return recording, model

    return Case(kind, name, build)


def replace_text(file: str, old: str, new: str) -> Callable[[Path], None]:
    """Return a change that replaces text in a file, which must be there."""

    def change(folder: Path) -> None:
        text = (folder / file).read_text()
        assert old in text, f"{file} does not hold {old!r}"
        (folder / file).write_text(text.replace(old, new))

    return change


def replace_geometry(**arrays: object) -> Callable[[Path], None]:
    """Return a change that replaces arrays of the contact geometry."""

    def change(folder: Path) -> None:
        path = folder / "model.geometry.npz"
        with np.load(path) as data:
            changed = {**dict(data), **arrays}
        np.savez(path, **changed)  # type: ignore[arg-type]

    return change


def flip_byte(file: str) -> Callable[[Path], None]:
    """Return a change that flips the byte in the middle of a file."""

    def change(folder: Path) -> None:
        data = bytearray((folder / file).read_bytes())
        data[len(data) // 2] ^= 255
        (folder / file).write_bytes(data)

    return change


def model_cases() -> Iterator[Case]:
    """Yield broken scenes and models."""
    toml, xml, npz = "model.toml", "model.scene.xml", "model.geometry.npz"
    mesh = '<asset><mesh name="m" file="gone.stl"/></asset><worldbody><geom type="mesh" mesh="m"/>'
    yield model_case("scene", "missing file", lambda f: (f / xml).unlink())
    yield model_case("scene", "not XML", lambda f: (f / xml).write_text("a robot"))
    yield model_case("scene", "missing mesh", replace_text(xml, "<worldbody>", mesh))
    yield model_case("scene", "unknown joint in an actuator", replace_text(xml, 'joint="elbow"', 'joint="knee"'))
    yield model_case("model", "missing file", lambda f: (f / toml).unlink())
    yield model_case("model", "broken TOML", replace_text(toml, "[contact]", "[contact"))
    yield model_case("model", "wrong format", replace_text(toml, "concent-model", "urdf"))
    yield model_case("model", "version of the future", replace_text(toml, "version = 1", "version = 9"))
    yield model_case("model", "unknown key", replace_text(toml, "version = 1", "version = 1\ncolour = 3"))
    yield model_case("model", "unknown key in [contact]", replace_text(toml, "condim", "condym"))
    yield model_case("model", "bad solimp", replace_text(toml, "0.95", "'stiff'"))
    yield model_case("model", "geometry missing", lambda f: (f / npz).unlink())
    yield model_case("model", "truncated geometry", lambda f: (f / npz).write_bytes((f / npz).read_bytes()[:-40]))
    yield model_case("model", "geometry with a flipped byte", flip_byte(npz))
    yield model_case("model", "geometry is a pickle", replace_geometry(radius=np.array([Code(), Code()], dtype=object)))
    yield model_case("model", "geometry without radii", replace_geometry(radius=np.zeros(0)))
    yield model_case("model", "negative radius", replace_geometry(radius=np.array([0.01, -0.01])))
    yield model_case("model", "body that the scene lacks", replace_geometry(bodies=np.array(["brick"])))


def cases() -> list[Case]:
    """Return all cases."""
    return [*hdf5_cases(), *path_cases(), *csv_cases(), *toss_cases(), *model_cases()]
