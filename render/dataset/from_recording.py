"""A recording as a LeRobot data set: ``concent_warp.write_lerobot``.

A data set has one clock: every channel is resampled at a rate. It gets beside it what the format has no place for:
``calibration.json`` (intrinsics and poses of the cameras), ``scene.xml`` and ``map.toml``, by which `import_log` reads
the recording back.
"""

from __future__ import annotations

import json
import shutil
import tempfile
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np

from concent_warp.checks import Bounds, check_settings
from concent_warp.errors import RenderError, printable
from concent_warp.files import write_text
from concent_warp.recording.logs.readers.calibration import FILE, Calibration, write_calibration
from concent_warp.recording.recording import Channel, Demonstration, ImageStream, Recording
from concent_warp.render.dataset.layout import STAGING, EpisodeLayout
from concent_warp.render.dataset.lerobot import LeRobotWriter
from concent_warp.render.dataset.video import Codec
from concent_warp.run_folder import make_folder
from concent_warp.scene.scene import Scene

SCENE_FILE, MAP_FILE = "scene.xml", "map.toml"
NO_IMAGES = (16, 16)
"""Size of images of a data set that has none [px]."""
DEFAULT_RATE = 30
"""Rate where there are no images that state one [Hz]."""
COMPONENTS = {1: ("",), 3: ("x", "y", "z"), 4: ("w", "x", "y", "z")}
"""Names of a channel's numbers by their count."""
PARTS = {mujoco.mjtSensor.mjSENS_FRAMEPOS: "position", mujoco.mjtSensor.mjSENS_FRAMEQUAT: "orientation"}
CLOCK_ROUNDING = 1e-9
"""Difference of times that rounding explains [s]."""
POSE = "observation.pose"
"""Features of tracked bodies, each followed by the name of its body."""


@dataclass(frozen=True)
class WriteLeRobotCfg:
    """How a recording becomes a LeRobot data set.

    Example:
        >>> import concent_warp as cw
        >>> cw.WriteLeRobotCfg(rate=50).rate
        50
    """

    rate: Annotated[int, Bounds(1, 10_000)] | None = None
    """Frames a second; by default that of the first camera, else 30."""
    depth: bool = True
    """Whether depths are written, as 12-bit codes: a step is 1.2 mm at 0.3 m."""
    codec: Codec = "h264"
    """Codec of the colours."""


def write_lerobot(
    recording: Recording,
    out: Path | str,
    cfg: WriteLeRobotCfg | None = None,
    *,
    progress: Callable[[float], None] | None = None,
) -> int:
    """Write a recording as a LeRobot v3 data set, with calibration, scene and map beside it.

    Commands are held until the next one; measurements are interpolated linearly; images are the nearest in time. Poses
    of bodies are features of their own, NaN where a body is lost. Covariances and point tracks have no place there, nor
    have payloads, of which a warning is given.

    Args:
        recording: The recording; its demonstrations have the same channels and cameras.
        out: Folder, empty or not there yet.
        cfg: Settings.
        progress: Called with the share done, 0..1.

    Returns:
        How many episodes were written.

    Raises:
        RenderError: The folder is not empty, demonstrations differ in their channels, or there are no commands or no
            joint measurements, which the format needs.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> cw.write_lerobot(recording, "servo_lerobot")
        1
    """
    cfg, out = cfg or WriteLeRobotCfg(), Path(out)
    check_settings(cfg, RenderError)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise RenderError("the folder is not empty", where=out, fix="choose another one")
    scene = Scene(recording.scene, recording.source)
    first = recording[0]
    _check_alike(recording)
    if loaded := [d.name for d in recording.demonstrations if d.payloads]:
        warnings.warn(
            printable(
                f"{out}: payloads have no place in a LeRobot data set: that bodies carry weights in "
                f"{', '.join(loaded[:3])}{', ...' * (len(loaded) > 3)} is not written"
            ),
            stacklevel=2,
        )
    rate = cfg.rate or _image_rate(first)
    sensors = _Sensors.of(scene.model, first)
    cameras = tuple(first.image)
    size = first.image[cameras[0]].rgb.shape[1:3] if cameras else NO_IMAGES
    layout = EpisodeLayout(
        rate,
        cameras,
        (int(size[0]), int(size[1])),
        sensors.state_names(first),
        tuple(first.action),
        depths=tuple(c for c in cameras if cfg.depth and (first.image[c].depth > 0).any()),
        more=tuple(sensors.pose_features(first).items()),
    )
    make_folder(out.parent)
    place = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    try:
        writer = LeRobotWriter(place, layout, codec=cfg.codec)
        count = len(recording.demonstrations)
        for k, demonstration in enumerate(recording.demonstrations):
            step = None if progress is None else lambda share, k=k: progress((k + share) / count)
            _write_episode(writer, k, demonstration, sensors, step)
        written = writer.finish()
        shutil.rmtree(place / STAGING)
        write_text(place / SCENE_FILE, recording.scene)
        write_text(place / MAP_FILE, _map_of(first, sensors, layout))
        if cameras:
            write_calibration(place / FILE, {name: _calibration(one) for name, one in first.image.items()})
        place.chmod(0o755)
        place.replace(out)
    except BaseException:
        shutil.rmtree(place, ignore_errors=True)
        raise
    return written


@dataclass(frozen=True)
class _Sensors:
    """Which measured channels are the state, and which are poses of bodies."""

    state: tuple[str, ...]
    poses: Mapping[str, Mapping[str, str]]
    """Channels by body and part of the pose."""

    @staticmethod
    def of(model: mujoco.MjModel, demonstration: Demonstration) -> _Sensors:
        """Sort the measured channels of a demonstration."""
        state: list[str] = []
        poses: dict[str, dict[str, str]] = {}
        for name in demonstration.measured:
            row = model.sensor(name).id
            part = PARTS.get(mujoco.mjtSensor(int(model.sensor_type[row])))
            of_body = model.sensor_objtype[row] == mujoco.mjtObj.mjOBJ_XBODY and model.sensor_refid[row] < 0
            body = model.body(int(model.sensor_objid[row])).name if of_body else ""
            if part is not None and body and part not in poses.get(body, {}):
                poses.setdefault(body, {})[part] = name
            else:
                state.append(name)
        return _Sensors(tuple(state), poses)

    def state_names(self, demonstration: Demonstration) -> tuple[str, ...]:
        """Return the names of the state's numbers."""
        return tuple(
            f"{name}/{part}".rstrip("/") for name in self.state for part in _parts(demonstration.measured[name])
        )

    def pose_features(self, demonstration: Demonstration) -> dict[str, tuple[str, ...]]:
        """Return the names of the numbers of each body's pose by feature."""
        return {
            f"{POSE}.{body}": tuple(
                f"{part}/{axis}" for part, name in parts.items() for axis in _parts(demonstration.measured[name])
            )
            for body, parts in self.poses.items()
        }


def _parts(channel: Channel) -> tuple[str, ...]:
    """Return the names of a channel's numbers."""
    count = channel.value.shape[1]
    return COMPONENTS.get(count, tuple(map(str, range(count))))


def _check_alike(recording: Recording) -> None:
    """Raise an error unless all demonstrations have the same channels and the same calibrated cameras."""
    first = recording[0]
    if not first.action or not first.measured:
        raise RenderError(
            "a data set needs commands and measurements", where=f"{recording.source}, {first.name}",
            found=f"{len(first.action)} commands, {len(first.measured)} measured channels",
        )  # fmt: skip
    for other in recording.demonstrations[1:]:
        for kind, mine, theirs in (
            ("commands", first.action, other.action),
            ("measured channels", first.measured, other.measured),
            ("cameras", first.image, other.image),
        ):
            if list(mine) != list(theirs):
                raise RenderError(
                    f"the demonstrations have other {kind}", where=f"{recording.source}, {other.name}",
                    expected=list(mine), found=list(theirs), fix="write those that are alike, each to a folder",
                )  # fmt: skip
        for name, stream in first.image.items():
            that = other.image[name]
            same = stream.rgb.shape[1:] == that.rgb.shape[1:] and stream.body == that.body
            if not (
                same and np.array_equal(stream.pose, that.pose) and np.array_equal(stream.intrinsics, that.intrinsics)
            ):
                raise RenderError(
                    "a camera is calibrated otherwise than in the first demonstration", where=f"{other.name}, {name}",
                    fix="write those that are alike, each to a folder",
                )  # fmt: skip


def _image_rate(demonstration: Demonstration) -> int:
    """Return the rate of the first camera, to a whole number [Hz]."""
    for stream in demonstration.image.values():
        if len(stream.time) > 1:
            return max(1, round(1 / float(np.median(np.diff(stream.time)))))
    return DEFAULT_RATE


def _write_episode(
    writer: LeRobotWriter,
    number: int,
    demonstration: Demonstration,
    sensors: _Sensors,
    progress: Callable[[float], None] | None,
) -> None:
    """Write a demonstration from its first image, else from its start, to its end."""
    layout = writer.layout
    streams = list(demonstration.image.values())
    start = min((float(s.time[0]) for s in streams), default=0.0)
    end = min((float(s.time[-1]) for s in streams), default=demonstration.duration)
    time = start + np.arange(int((end - start) * layout.rate + 1e-6) + 1) / layout.rate
    measured = demonstration.measured
    state = np.concatenate(
        [_at(measured[name], time, held=True) for name in sensors.state] or [np.zeros((len(time), 0))], axis=1
    )
    action = np.stack([_held(channel, time) for channel in demonstration.action.values()], axis=1)
    more = {
        f"{POSE}.{body}": np.concatenate([_at(measured[name], time, held=False) for name in parts.values()], axis=1)
        for body, parts in sensors.poses.items()
    }
    rows = {name: _nearest(stream.time, time) for name, stream in demonstration.image.items()}
    episode = writer.begin(number, demonstration.task or "do the task")
    try:
        for t in range(len(time)):
            episode.add(
                {name: demonstration.image[name].rgb[rows[name][t]] for name in layout.cameras},
                state[t],
                action[t],
                depths={name: demonstration.image[name].depth[rows[name][t]] for name in layout.depths},
                more={name: values[t] for name, values in more.items()},
            )
            if progress is not None:
                progress((t + 1) / len(time))
    except BaseException:
        episode.discard()
        raise
    episode.save(success=bool(demonstration.success))


def _at(channel: Channel, time: np.ndarray, *, held: bool) -> np.ndarray:
    """Return a channel's values at times (T,) [s], interpolated linearly, shape (T, n).

    Args:
        channel: The channel; of quaternions the short way is taken.
        time: The times.
        held: Whether missing values, and those before the first and after the last sample, are filled; else NaN.
    """
    value = np.array(channel.value, float)
    if value.shape[1] == 4:
        known = np.flatnonzero(np.isfinite(value).all(axis=1))
        for last, k in pairwise(known):
            value[k] *= 1.0 if value[k] @ value[last] >= 0 else -1.0
    columns = []
    for column in value.T:
        if held:
            known = np.isfinite(column)
            columns.append(np.interp(time, channel.time[known], column[known]))
        else:
            # np.interp mixes NaN in wherever a neighbour is missing, even with no weight.
            found = np.interp(time, channel.time, column, left=np.nan, right=np.nan)
            near = _nearest(channel.time, time)
            exact = np.abs(channel.time[near] - time) < CLOCK_ROUNDING
            columns.append(np.where(exact, column[near], found))
    result = np.stack(columns, axis=1)
    return result / np.linalg.norm(result, axis=1, keepdims=True) if value.shape[1] == 4 else result


def _held(channel: Channel, time: np.ndarray) -> np.ndarray:
    """Return the commands that hold at times (T,) [s]; before the first that one, shape (T,)."""
    row = np.searchsorted(channel.time, time + CLOCK_ROUNDING, side="right") - 1
    return channel.value[np.clip(row, 0, None)]


def _nearest(known: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return the rows of ascending times that are nearest to times (T,) [s], shape (T,) int."""
    after = np.clip(np.searchsorted(known, time), 1, max(len(known) - 1, 1))
    before = after - 1
    if len(known) == 1:
        return np.zeros(len(time), int)
    return np.where(time - known[before] <= known[after] - time, before, after)


def _calibration(stream: ImageStream) -> Calibration:
    """Return the calibration of a camera."""
    height, width = stream.rgb.shape[1:3]
    pose, none = np.asarray(stream.pose, float), np.zeros(0)
    return Calibration(np.asarray(stream.intrinsics, float), none, pose, stream.body, (int(height), int(width)))


def _map_of(demonstration: Demonstration, sensors: _Sensors, layout: EpisodeLayout) -> str:
    """Return the map by which the data set is imported."""
    lines = [f"# concent import FOLDER --model FOLDER/{SCENE_FILE} --map FOLDER/{MAP_FILE} -o demo.h5"]

    def entry(kind: str, name: str, **values: str | float | None) -> None:
        lines.append(f"\n[{kind}.{json.dumps(name)}]")
        lines.extend(f"{key} = {json.dumps(value)}" for key, value in values.items() if value is not None)

    for name in layout.action:
        entry("action", name, source=f"action/{name}")
    sources = {name: f"observation.state/{name}" for name in sensors.state}
    sources |= {name: f"{POSE}.{body}/{part}" for body, parts in sensors.poses.items() for part, name in parts.items()}
    for name, source in sources.items():
        entry("measured", name, source=source, noise_std=demonstration.measured[name].noise_std)
    for name in layout.cameras:
        depth = f"observation.images.{name}_depth" if name in layout.depths else None
        entry("image", name, color=f"observation.images.{name}", depth=depth)
    return "\n".join(lines) + "\n"
