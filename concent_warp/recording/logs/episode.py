"""One episode of a log as a demonstration of a scene, with a table of what was read and a list of what is wrong."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.recording.logs.camera_checks import check_camera
from concent_warp.recording.logs.cameras import Camera, find_camera
from concent_warp.recording.logs.cfg import ImportCfg
from concent_warp.recording.logs.log_map import BodyEntry, LogMap, NumberEntry
from concent_warp.recording.logs.numbers import Numbers, converted, expanded
from concent_warp.recording.logs.plausibility import check_delays, check_numbers, check_overlap
from concent_warp.recording.logs.readers.calibration import Calibration
from concent_warp.recording.logs.readers.log import Episode
from concent_warp.recording.logs.scene_gaps import nameless_actuators
from concent_warp.recording.logs.targets import Target, body_sensors, joint_positions, targets_of
from concent_warp.recording.logs.units import SI
from concent_warp.recording.naming import PREFIX
from concent_warp.recording.recording import Channel, Demonstration, ImageStream


@dataclass(frozen=True)
class ReadChannel:
    """One line of the table of what is read."""

    name: str
    """Kind and name in the recording, such as ``action/elbow``."""
    source: str
    samples: int
    rate: float
    """Median samples a second [Hz]; NaN for a single one."""
    low: float
    high: float
    unit: str
    """Of low and high."""
    range: tuple[float, float] | None = None
    """Range of the scene's joint or control, where it has one."""
    remark: str = ""


@dataclass(frozen=True)
class ReadEpisode:
    """What an episode becomes."""

    demonstration: Demonstration
    """With the frames that were checked, if any."""
    start: float
    """Time 0 on the log's clock [s]."""
    channels: list[ReadChannel] = field(default_factory=list)
    cameras: list[Camera] = field(default_factory=list)
    problems: list[RecordingError] = field(default_factory=list)
    unused: list[str] = field(default_factory=list)
    """Channels of the log that the map does not name."""
    unmeasured: list[str] = field(default_factory=list)
    """Named sensors of the scene without a channel."""
    left: list[Target] = field(default_factory=list)
    """Named actuators and sensors of the scene without a channel or constant."""
    behind: dict[str, int] = field(default_factory=dict)
    """Samples that were out of order and were sorted, by kind and name of their channel."""

    def with_images(self, tick: Callable[[str, int], None]) -> Demonstration:
        """Decode all frames; `tick` is called with a camera and its number of frames done."""
        image = {
            one.name: one.stream(self.start, tick=lambda done, name=one.name: tick(name, done)) for one in self.cameras
        }
        return replace(self.demonstration, image=image)


def read_episode(
    episode: Episode, mapping: LogMap, m: mujoco.MjModel, file: Mapping[str, Calibration], cfg: ImportCfg
) -> ReadEpisode:
    """Map an episode to a scene.

    Args:
        episode: The episode.
        mapping: The map.
        m: The compiled scene.
        file: Cameras of ``calibration.json``.
        cfg: Settings.

    Returns:
        The demonstration and all that is wrong, in the order in which it is best mended.
    """
    problems: list[RecordingError] = []
    channels, constants, wrong = _numbers(episode, mapping, m, cfg, problems)
    cameras: list[Camera] = []
    for name, entry in mapping.image.items():
        try:
            cameras.append(find_camera(name, entry, episode, mapping, file, m, cfg))
        except RecordingError as error:
            problems.append(error)
    times = {f"{one.label} ({one.source})": one.time for one in channels}
    times |= {f"image/{one.name} ({one.color.name})": one.time for one in cameras}
    if times:
        problems += [e for e in (check_overlap(times),) if e]
    delays = {f"{c.label} ({c.source})": c.delay for c in channels}
    delays |= {f"image/{c.name} ({c.color.name})": c.delay for c in cameras}
    problems += [e for e in (check_delays(delays, cfg.plausibility),) if e]
    problems += list(check_numbers(channels, cfg.plausibility))
    start = min((float(time[0]) for time in times.values()), default=0.0)
    action, measured = _channels(channels, constants, start)
    lines = _lines(channels, constants)
    image = _checked_frames(cameras, start, measured, m, cfg, lines, problems)
    if nameless := nameless_actuators(m):
        problems.append(RecordingError(nameless, where=mapping.source))
    elif missing := [m.actuator(i).name for i in range(m.nu) if m.actuator(i).name not in (*action, *wrong)]:
        problems.append(
            RecordingError(
                "commands are missing", where=mapping.source, expected="an [action.*] for every actuator of the scene",
                found=f"none for {missing}",
                fix="map them, write constant = VALUE for one that stays, or remove the actuator from the scene",
            )
        )  # fmt: skip
    name = f"{PREFIX}{episode.number}"
    made = Demonstration(name, episode.task, episode.success, None, None, action, measured, image=image)
    distinct = list({str(error): error for error in problems}.values())
    behind = {one.label: one.behind for one in channels if one.behind}
    actuators, sensors = targets_of(m)
    unmeasured = [name for name in sensors if name not in measured]
    left = [one for one in actuators.values() if one.name not in (*action, *wrong)]
    left += [sensors[name] for name in unmeasured]
    unused = _unused(episode, mapping, channels)
    return ReadEpisode(made, start, lines, cameras, distinct, unused, unmeasured, left, behind)


def _unused(episode: Episode, mapping: LogMap, channels: list[Numbers]) -> list[str]:
    """Return the channels of an episode that the map does not name."""
    named = {one for entry in (*mapping.action.values(), *mapping.measured.values()) for one in entry.source if one}
    named |= {entry.source for entry in mapping.body.values()}
    named |= {part for one in channels for part in one.source.split(", ")}
    under = tuple(f"{one}/" for one in named)
    pictures = {one for entry in mapping.image.values() for one in (entry.color, entry.depth)}
    unused = [name for name in episode.signals if name not in named and not name.startswith(under)]
    return unused + [name for name in episode.images if name not in pictures]


def _numbers(
    episode: Episode, mapping: LogMap, m: mujoco.MjModel, cfg: ImportCfg, problems: list[RecordingError]
) -> tuple[list[Numbers], dict[str, float], list[str]]:
    """Return the channels in SI, the constant commands, and names of channels with an error, added to `problems`."""
    actuators, sensors = targets_of(m)
    channels: list[Numbers] = []
    constants: dict[str, float] = {}
    wrong: list[str] = []
    entries: list[tuple[NumberEntry, Target]] = []
    for kind, stated, known in (("action", mapping.action, actuators), ("measured", mapping.measured, sensors)):
        try:
            entries += [(e, known[n]) for n, e in expanded(stated, known, episode, mapping, kind).items()]
        except RecordingError as error:
            problems.append(error)
    for name, body in mapping.body.items():
        try:
            channels += _pose_channels(name, body, episode, mapping, m, sensors, cfg)
        except RecordingError as error:
            problems.append(error)
    for entry, target in entries:
        try:
            one = converted(entry, target, episode, mapping, cfg.plausibility)
        except RecordingError as error:
            problems.append(error)
            wrong += [target.name] if target.command else []
            continue
        if one is None:
            assert entry.constant is not None
            constants[target.name] = entry.constant
        else:
            channels.append(one)
    return channels, constants, wrong


def _pose_channels(
    name: str, entry: BodyEntry, episode: Episode, mapping: LogMap, m: mujoco.MjModel,
    sensors: Mapping[str, Target], cfg: ImportCfg,
) -> list[Numbers]:  # fmt: skip
    """Return position and orientation of a body in the world of the scene."""
    where = mapping.where("body", name)
    if mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, name) < 0:
        known = [m.body(i).name for i in range(1, m.nbody)]
        raise RecordingError("the scene has no such body", where=where, expected=f"one of {known}")
    place, turn = body_sensors(m, name)
    if place is None or turn is None:
        lines = " ".join(f'<{kind} objtype="xbody" objname="{name}"/>' for kind in ("framepos", "framequat"))
        raise RecordingError("the scene does not measure the pose of the body", where=where, fix=f"add {lines}")
    parts = (
        (place, "position", entry.unit, entry.position_noise_std),
        (turn, "orientation", None, entry.orientation_noise_std),
    )
    found: list[Numbers] = []
    for sensor, part, unit, noise in parts:
        number = NumberEntry((f"{entry.source.rstrip('/')}/{part}",), unit=unit, noise_std=noise)
        one = converted(number, sensors[sensor], episode, mapping, cfg.plausibility)
        assert one is not None
        found.append(replace(one, where=where))
    rotation, shift = entry.transform[:3, :3], entry.transform[:3, 3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise RecordingError(
            "transform is not a rotation and a translation", where=where, found=entry.transform.tolist()
        )
    turned = np.zeros(4)
    mujoco.mju_mat2Quat(turned, np.ascontiguousarray(rotation).ravel())
    quaternions = np.array([_product(turned, q) for q in found[1].value])
    return [replace(found[0], value=found[0].value @ rotation.T + shift), replace(found[1], value=quaternions)]


def _product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the product of two quaternions (4,), wxyz."""
    found = np.zeros(4)
    mujoco.mju_mulQuat(found, first, second)
    return found


def _channels(
    channels: list[Numbers], constants: Mapping[str, float], start: float
) -> tuple[dict[str, Channel], dict[str, Channel]]:
    """Return commands and measurements by name, their times from `start` [s]."""
    action = {name: Channel(np.zeros(1), np.array([value])) for name, value in constants.items()}
    measured: dict[str, Channel] = {}
    for one in channels:
        time = one.time - start
        if one.target.command:
            action[one.target.name] = Channel(time, one.value[:, 0])
        else:
            measured[one.target.name] = Channel(time, one.value, one.noise_std)
    return action, measured


def _lines(channels: list[Numbers], constants: Mapping[str, float]) -> list[ReadChannel]:
    """Return the lines of the table for numbers."""
    found = []
    for one in channels:
        done = {
            "repeated stamps dropped": one.repeated,
            "empty rows dropped": one.empty,
            "misplaced stamps sorted": one.behind,
        }
        remark = ", ".join(f"{count} {what}" for what, count in done.items() if count)
        low, high = float(np.nanmin(one.value)), float(np.nanmax(one.value))
        unit = SI[one.target.quantity]
        found.append(
            ReadChannel(
                one.label, one.source, len(one.time), _rate(one.time), low, high, unit, one.target.range, remark
            )
        )
    found += [ReadChannel(f"action/{n}", "constant", 1, float("nan"), v, v, "") for n, v in constants.items()]
    return found


def _rate(time: np.ndarray) -> float:
    """Return the median samples a second [Hz], NaN for a single one."""
    return 1 / float(np.median(np.diff(time))) if len(time) > 1 else float("nan")


def _checked_frames(
    cameras: list[Camera], start: float, measured: Mapping[str, Channel], m: mujoco.MjModel, cfg: ImportCfg,
    lines: list[ReadChannel], problems: list[RecordingError],
) -> dict[str, ImageStream]:  # fmt: skip
    """Return some frames of each camera, compared with the scene; what is found is added to `lines` and `problems`."""
    first = {
        name: float(one.value[np.isfinite(one.value[:, 0]), 0][0])
        for name, one in measured.items()
        if np.isfinite(one.value[:, 0]).any()
    }
    qpos = joint_positions(m, first)
    image: dict[str, ImageStream] = {}
    for camera in cameras:
        count = len(camera.time)
        rows = np.unique(np.linspace(0, count - 1, min(cfg.checked_frames, count)).round().astype(int))
        try:
            stream, unit = camera.stream(start, rows), camera.unit()
        except RecordingError as error:
            problems.append(error)
            continue
        image[camera.name] = stream
        problems += check_camera(stream, unit, m, qpos, camera.where, cfg.plausibility)
        depths = stream.depth[stream.depth > 0]
        if camera.depth and not depths.size:
            problems.append(
                RecordingError(
                    "every depth is missing", where=camera.where, expected=f"depths above {cfg.depth_from:g} m",
                    found=f"none in {len(rows)} frames, taken to be in {unit}", fix="check depth_unit in the map",
                )
            )  # fmt: skip
        low, high = (float(depths.min()), float(depths.max())) if depths.size else (float("nan"), float("nan"))
        height, width = camera.color.size
        remark = f"{width} x {height}" + ("" if camera.depth else ", no depth")
        source = camera.color.name + (f", {camera.depth.name}" if camera.depth else "")
        name = f"image/{camera.name}"
        lines.append(ReadChannel(name, source, count, _rate(camera.time), low, high, "m", None, remark))
    return image
