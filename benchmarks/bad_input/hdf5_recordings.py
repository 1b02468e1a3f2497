"""HDF5 recordings that are broken in one place each, for all commands that read a recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np

from benchmarks.bad_input.case import READERS, Case, Rotation, crossed, flip_byte, truncate, write
from benchmarks.bad_input.sound_inputs import SCENE, TIME

FILE = "recording.h5"
DEMO = "data/demo_0"
Change = Callable[[Path], None]
Named = tuple[str, Change]


def edited(name: str, edit: Callable[[h5py.File], object]) -> Named:
    """Return a change of the sound file."""

    def change(folder: Path) -> None:
        with h5py.File(folder / FILE, "r+") as file:
            edit(file)

    return name, change


def data(name: str, entry: str, change: Callable[[np.ndarray], object]) -> Named:
    """Return a change that replaces one dataset of the demonstration; its checksum goes with it."""

    def edit(file: h5py.File) -> None:
        dataset = file[f"{DEMO}/{entry}"]
        assert isinstance(dataset, h5py.Dataset)
        value = change(dataset[()])
        del file[f"{DEMO}/{entry}"]
        file[f"{DEMO}/{entry}"] = value

    return edited(name, edit)


def created(name: str, entry: str, shape: tuple[int, ...], dtype: str, **options: object) -> Named:
    """Return a change that declares a dataset and writes none of it."""

    def edit(file: h5py.File) -> None:
        del file[f"{DEMO}/{entry}"]
        file.create_dataset(f"{DEMO}/{entry}", shape=shape, dtype=dtype, **options)

    return edited(name, edit)


def put(row: int | slice, number: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return a change that sets rows."""

    def change(value: np.ndarray) -> np.ndarray:
        value = value.copy()
        value[row] = number
        return value

    return change


def relink(link: h5py.SoftLink | h5py.ExternalLink) -> Callable[[h5py.File], None]:
    """Return an edit that puts a link in place of a channel's values."""

    def edit(file: h5py.File) -> None:
        del file[f"{DEMO}/measured/elbow_angle/value"]
        file[f"{DEMO}/measured/elbow_angle/value"] = link

    return edit


def move(old: str, new: str) -> Callable[[h5py.File], None]:
    """Return an edit that renames an entry of the demonstration."""
    return lambda file: file.require_group(DEMO).move(old, new)


def scene(text: str) -> Callable[[h5py.File], None]:
    """Return an edit that replaces the scene."""

    def edit(file: h5py.File) -> None:
        del file["scene"]
        file["scene"] = text

    return edit


def attribute(entry: str, name: str, value: object) -> Callable[[h5py.File], None]:
    """Return an edit that sets an attribute."""
    return lambda file: file[entry].attrs.__setitem__(name, value)


def flipped_scene(folder: Path) -> None:
    """Flip one bit in the text of the scene."""
    content = (folder / FILE).read_bytes()
    assert b'kp="20"' in content
    (folder / FILE).write_bytes(content.replace(b'kp="20"', b'kp="00"'))


def bomb(file: h5py.File) -> None:
    """Write 4 GiB of zeros that gzip packs into some megabytes' worth of empty chunks."""
    del file[f"{DEMO}/image/wrist/rgb"]
    shape = (4096, 1024, 1024)
    file.create_dataset(
        f"{DEMO}/image/wrist/rgb", shape=(*shape, 3), dtype="u1", chunks=(1, 1024, 1024, 3), compression="gzip"
    )
    time = np.arange(4096) * 1e-4
    for name in ("time", "depth"):
        del file[f"{DEMO}/image/wrist/{name}"]
    file[f"{DEMO}/image/wrist/time"] = time


def ring(file: h5py.File) -> None:
    """Let a group contain itself."""
    file[f"{DEMO}/measured/elbow_angle/again"] = file[f"{DEMO}/measured"]


def structures() -> Iterator[Named]:
    """Yield wrong structures."""
    elbow = f"{DEMO}/measured/elbow_angle"
    yield edited("wrong format attribute", attribute("/", "format", "robomimic"))
    yield edited("format that is an array", attribute("/", "format", np.arange(4)))
    yield edited("version of the future", attribute("/", "version", 99))
    yield edited("version that is text", attribute("/", "version", "first"))
    yield edited("version NaN", attribute("/", "version", np.nan))
    yield edited("no scene", lambda f: f.__delitem__("scene"))
    yield edited("scene that is a group", lambda f: (f.__delitem__("scene"), f.create_group("scene")))
    yield edited("empty scene", scene(""))
    yield edited("MJCF that does not compile", scene(SCENE.replace('joint="elbow" kp', 'joint="knee" kp')))
    yield edited("MJCF that includes a file", scene('<mujoco><include file="/etc/hostname"/></mujoco>'))
    yield edited("MJCF without an end", scene(SCENE[: len(SCENE) // 2]))
    yield edited(
        "scene with a time step of -1", scene(SCENE.replace("<worldbody>", '<option timestep="-1"/><worldbody>'))
    )
    yield edited(
        "scene with a time step of 1e300", scene(SCENE.replace("<worldbody>", '<option timestep="1e300"/><worldbody>'))
    )
    yield edited(
        "scene 3,000 deep", scene(SCENE.replace("</worldbody>", "<body>" * 3000 + "</body>" * 3000 + "</worldbody>"))
    )
    yield edited("no data", lambda f: f.__delitem__("data"))
    yield edited("no demonstrations", lambda f: f.require_group("data").__delitem__("demo_0"))
    yield edited("demonstration that is a dataset", lambda f: (f.__delitem__(DEMO), f.__setitem__(DEMO, 1.0)))
    yield edited("misspelt group", move("measured", "mesured"))
    yield edited("unknown sensor", move("measured/elbow_angle", "measured/knee_angle"))
    yield edited("unknown actuator", move("action/elbow", "action/knee"))
    yield edited("points of an unknown body", move("points/block", "points/brick"))
    yield edited("channel without times", lambda f: f.__delitem__(f"{elbow}/time"))
    yield edited("channel without values", lambda f: f.__delitem__(f"{elbow}/value"))
    yield edited("channel with an unknown entry", lambda f: f.__setitem__(f"{elbow}/values", 1.0))
    yield edited("misspelt noise_std", attribute(elbow, "noise_stdd", 0.1))
    yield edited("negative noise_std", attribute(elbow, "noise_std", -0.1))
    yield edited("noise_std NaN", attribute(elbow, "noise_std", np.nan))
    yield edited("noise_std that is text", attribute(elbow, "noise_std", "small"))
    yield edited("escape sequence in the task", attribute(DEMO, "task", "\x1b[2J"))
    yield edited("group that contains itself", ring)
    yield edited("external link", relink(h5py.ExternalLink("/etc/other.h5", "/value")))
    yield edited("soft link", relink(h5py.SoftLink(f"/{DEMO}/action/elbow/value")))
    yield edited("soft link to itself", relink(h5py.SoftLink(f"/{elbow}/value")))
    yield "one digit changed in the scene", flipped_scene


def values() -> Iterator[Named]:
    """Yield wrong values."""
    elbow, block, turn = "measured/elbow_angle", "measured/block_position", "measured/block_orientation"
    yield data("times not sorted", f"{elbow}/time", lambda t: t[::-1])
    yield data("a time twice", f"{elbow}/time", put(5, float(TIME[4])))
    yield data("a time is NaN", f"{elbow}/time", put(5, np.nan))
    yield data("negative time", f"{elbow}/time", lambda t: t - 0.5)
    yield data("times in milliseconds", f"{elbow}/time", lambda t: t * 1e3)
    yield data("times since 1970", f"{elbow}/time", lambda t: t + 1.7e9)
    yield data("a last time of 1e9 s", f"{elbow}/time", put(-1, 1e9))
    yield data("a last command at 5e4 s", "action/elbow/time", put(-1, 5e4))
    yield data("times of 1e300 s", f"{elbow}/time", lambda t: t * 1e300)
    yield data("one sample", f"{elbow}/time", lambda t: t[:1])
    yield data("no samples", f"{elbow}/time", lambda t: t[:0])
    yield data("times of two columns", f"{elbow}/time", lambda t: np.stack([t, t], 1))
    yield data("complex times", f"{elbow}/time", lambda t: t + 1j)
    yield data("an infinite value", f"{elbow}/value", put(7, np.inf))
    yield data("a value of 1e300", f"{elbow}/value", put(7, 1e300))
    yield data("a channel of NaN", f"{elbow}/value", lambda v: v * np.nan)
    yield data("a run of NaN in a command", "action/elbow/value", put(slice(20, 40), np.nan))
    yield data("a command of two columns", "action/elbow/value", lambda v: np.stack([v, v], 1))
    yield data("too few numbers per sample", f"{block}/value", lambda v: v[:, :2])
    yield data("fewer values than times", f"{block}/value", lambda v: v[:-3])
    yield data("text for numbers", f"{block}/value", lambda v: v.astype("S"))
    yield data("truth values for numbers", f"{block}/value", lambda v: v > 0)
    yield data("a single number for a channel", f"{block}/value", lambda _: 3.0)
    yield data("quaternions not of unit length", f"{turn}/value", lambda q: q * 3)
    yield data("quaternions of length 0", f"{turn}/value", lambda q: q * 0)
    yield data("positions in millimetres", f"{block}/value", lambda v: v * 1e3)
    yield data("angles in degrees", f"{elbow}/value", np.degrees)
    yield data("commands in degrees", "action/elbow/value", np.degrees)
    yield data("wrong size of qpos", "initial/qpos", lambda q: q[:-1])
    yield data("NaN in qpos", "initial/qpos", put(0, np.nan))
    yield data("qpos with a quaternion of length 0", "initial/qpos", put(4, 0.0))
    yield data("wrong size of qvel", "initial/qvel", lambda _: np.zeros(99))
    yield data("infinite qvel", "initial/qvel", put(0, np.inf))
    yield data("points of a wrong shape", "points/block/value", lambda p: p[..., :2])
    yield data("visible of a wrong shape", "points/block/visible", lambda v: v[:, :1])
    yield data("infinite points", "points/block/value", put(3, np.inf))
    yield data("depth in integer millimetres", "image/wrist/depth", lambda d: (d * 1000).astype("u2"))
    yield data("images of floats", "image/wrist/rgb", lambda v: v / 255)
    yield data("images with four colours", "image/wrist/rgb", lambda v: np.concatenate([v, v[..., :1]], -1))
    camera = f"{DEMO}/image/wrist"
    yield edited("camera pose no rotation", lambda f: f[camera].attrs.modify("pose", np.ones((4, 4))))
    yield edited("camera pose NaN", lambda f: f[camera].attrs.modify("pose", np.full((4, 4), np.nan)))
    yield edited("camera of focal length 0", lambda f: f[camera].attrs.modify("intrinsics", np.zeros((3, 3))))


def sizes() -> Iterator[Named]:
    """Yield files that declare or unpack to more than there is."""
    elbow = "measured/elbow_angle"
    yield created("10^12 numbers declared", f"{elbow}/value", (10**6, 10**6), "f8", chunks=(100, 100))
    yield created("10^10 times declared", f"{elbow}/time", (10**10,), "f8", chunks=(10**6,))
    yield created("a chunk of 2 GiB", f"{elbow}/value", (60, 1 << 22), "f8", chunks=(60, 1 << 22))
    yield created("60 values, none written", f"{elbow}/value", (60, 1), "V1000000")
    yield edited("gzip bomb of images", bomb)


def broken_files() -> Iterator[tuple[str, str, Callable[[Path], object]]]:
    """Yield files and folders that are broken as a whole: name, path for the command, build."""
    for share in (0.0, 0.05, 0.5, 0.9, 0.999):
        yield f"truncated to {share:.1%}", FILE, truncate(FILE, share)
    for share in (0.0005, 0.01, 0.02):
        yield f"a byte at {share:.2%} flipped", FILE, flip_byte(FILE, share)
    yield "no HDF5 in it", "broken.h5", write("broken.h5", "time,value\n" * 100)
    yield "missing file", "broken.h5", lambda _: None
    yield "unknown suffix", "broken.mat", write("broken.mat", "")
    yield "no suffix", "broken", write("broken", "x")
    yield "empty folder", "broken", lambda folder: (folder / "broken").mkdir()
    yield "folder in place of a file", "broken.h5", lambda folder: (folder / "broken.h5").mkdir()
    yield "link to /dev/zero", "broken.h5", lambda folder: (folder / "broken.h5").symlink_to("/dev/zero")
    yield "link to itself", "broken.h5", lambda folder: (folder / "broken.h5").symlink_to("broken.h5")
    yield "below a file", "scene.xml/broken.h5", lambda _: None
    yield "a name of 5,000 letters", "x" * 5000 + ".h5", lambda _: None
    yield "an XML file", "scene.xml", lambda _: None


def cases() -> Iterator[Case]:
    """Yield broken HDF5 recordings for all commands that read one."""
    rotation = Rotation(READERS)
    inputs = [(name, FILE, change) for make in (structures, values, sizes) for name, change in make()]
    yield from crossed("recordings (HDF5)", rotation, [*inputs, *broken_files()])
