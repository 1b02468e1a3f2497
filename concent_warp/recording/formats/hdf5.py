"""The recording file: HDF5, one or more demonstrations, after robomimic's ``data/demo_i`` layout.

Names of channels are filed as `naming` says. How entries are read without trusting the file is in `hdf5_access`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import h5py
import numpy as np

from concent_warp.errors import ConcentError, RecordingError, SceneError
from concent_warp.hdf5_output import new_hdf5
from concent_warp.limits import limits, raising
from concent_warp.recording.formats.hdf5_access import CHECKSUM, SafeFile, sign
from concent_warp.recording.formats.hdf5_heap import check_heaps
from concent_warp.recording.naming import by_number, entry_of, name_of
from concent_warp.recording.recording import Channel, Demonstration, ImageStream, PointTrack, PolicyLog, Recording
from concent_warp.recording.time_zero import counted_from_first_sample
from concent_warp.recording.validation.validate import validate
from concent_warp.scene.payloads import PAYLOAD_NUMBERS, Payload
from concent_warp.scene.scene import Scene

FORMAT = "concent-recording"
VERSION = 1
Stream = TypeVar("Stream")


def read_hdf5(path: Path) -> Recording:
    """Read and validate a recording file.

    Raises:
        RecordingError: The file is missing, damaged, no recording, too large, or breaks a rule of `validate`.
    """
    path = Path(path)
    if not path.is_file():
        raise RecordingError("no such recording file", where=path, expected="an HDF5 file", fix="check the path")
    try:
        check_heaps(path)
        with h5py.File(path, "r") as file:
            recording = Reader(path).recording(file)
    except RecordingError:
        raise
    except MemoryError:
        raise RecordingError("the recording does not fit into memory", where=path, fix="split it") from None
    except Exception as error:  # h5py reports damage as OSError, KeyError, RuntimeError, ValueError, TypeError and more
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RecordingError(
            "the HDF5 file is damaged", where=path, found=reason, fix="copy or record it again"
        ) from error
    recording = counted_from_first_sample(recording)
    validate(recording)
    return recording


def write_hdf5(recording: Recording, path: str | Path) -> None:
    """Validate a recording and write it, in one piece or not at all.

    The file appears under its name only when it is whole; a killed process leaves at most a hidden ``.partial`` file,
    which the next call replaces. Its metadata and its data carry checksums.

    Raises:
        RecordingError: The recording breaks a rule of `validate`, or the file cannot be written.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> cw.write_hdf5(recording, "copy.h5")
        >>> cw.load_recording("copy.h5")[0].name
        'demo_0'
    """
    path = Path(path)
    validate(recording)
    if not path.parent.is_dir():
        raise RecordingError("the folder to write to does not exist", where=path.parent, fix="create it")
    try:
        with new_hdf5(path) as file:
            _write_file(file, recording)
    except ConcentError as error:
        raise RecordingError(str(error)) from None
    except RuntimeError as error:
        raise RecordingError("the recording cannot be written", where=path, found=error) from error


def _write_file(file: h5py.File, recording: Recording) -> None:
    """Fill an open file."""
    file.attrs["format"], file.attrs["version"] = _text(FORMAT), VERSION
    sign(file.create_dataset("scene", data=_text(recording.scene)))
    data = file.create_group("data")
    for demonstration in recording.demonstrations:
        group = data.create_group(demonstration.name)
        group.attrs["task"] = _text(demonstration.task)
        if demonstration.success is not None:
            group.attrs["success"] = bool(demonstration.success)
        for name, value in (("qpos", demonstration.qpos), ("qvel", demonstration.qvel)):
            if value is not None and len(value):
                sign(group.require_group("initial").create_dataset(name, data=np.asarray(value, dtype=float)))
        for kind in ("action", "measured", "points", "image"):
            for name, stream in getattr(demonstration, kind).items():
                _write_stream(group.require_group(kind).create_group(entry_of(name)), stream)
        for body in dict.fromkeys(payload.body for payload in demonstration.payloads):
            rows = np.array([payload.numbers for payload in demonstration.payloads if payload.body == body])
            sign(group.require_group("payloads").create_dataset(entry_of(body), data=rows))
        if demonstration.policy is not None:
            log = group.create_group("policy")
            for name in ("time", "observation", "action"):
                _store(log, name, np.asarray(getattr(demonstration.policy, name), dtype=float))


def _write_stream(group: h5py.Group, stream: Channel | PointTrack | ImageStream) -> None:
    """Fill the group of one channel, point track or camera."""
    _store(group, "time", np.asarray(stream.time, dtype=float))
    if isinstance(stream, ImageStream):
        _store(group, "rgb", stream.rgb)
        _store(group, "depth", stream.depth)
        group.attrs["intrinsics"] = np.asarray(stream.intrinsics, dtype=float)
        group.attrs["pose"] = np.asarray(stream.pose, dtype=float)
        if stream.body is not None:
            group.attrs["body"] = _text(stream.body)
        return
    _store(group, "value", np.asarray(stream.value, dtype=float))
    if isinstance(stream, PointTrack):
        _store(group, "visible", stream.visible)
    else:
        if stream.noise_std is not None:
            group.attrs["noise_std"] = float(stream.noise_std)
        if stream.frame is not None:
            group.attrs["frame"] = _text(stream.frame)
        if stream.covariance is not None:
            _store(group, "covariance", np.asarray(stream.covariance, dtype=float))
        if stream.common is not None:
            _store(group, "common", np.asarray(stream.common, dtype=float))


def _text(value: str) -> np.ndarray:
    """Return a string of fixed length: unlike one of variable length, it is covered by the file's checksums."""
    encoded = value.encode()
    return np.array(encoded, dtype=h5py.string_dtype("utf-8", max(1, len(encoded))))


def _store(group: h5py.Group, name: str, value: np.ndarray) -> None:
    """Write one array, compressed and with checksums; images frame by frame."""
    chunks = (1, *value.shape[1:]) if name in ("rgb", "depth") else True
    group.create_dataset(
        name, data=value, chunks=chunks, compression="gzip", compression_opts=1, shuffle=True, fletcher32=True
    )


class Reader(SafeFile):
    """Reads a recording from an open file, without validating it."""

    def recording(self, file: h5py.File) -> Recording:
        """Read the whole file."""
        found = self.text_attribute(file, "format")
        if found != FORMAT:
            raise self.error("not a recording", "attribute format", expected=repr(FORMAT), found=repr(found))
        version = self.attribute(file, "version")
        if version is None or np.shape(version) != () or version != VERSION:
            raise self.error("unknown version of the format", "attribute version", expected=VERSION, found=version)
        self.refuse_unknown(file, {"scene", "data"}, {"format", "version", "path"})
        scene = self.scene(file)
        data = self.group(file, "data")
        self.check_attributes(data, set())
        if len(data) > limits().demonstrations:
            raise self.error(
                "too many demonstrations",
                "data",
                expected=f"at most {limits().demonstrations}",
                fix=raising("demonstrations"),
                found=len(data),
            )
        names = sorted(data.keys(), key=by_number)
        demonstrations = tuple(self.demonstration(self.group(data, n), n) for n in names)
        self.warn_unread()
        return Recording(scene, demonstrations, str(self.path))

    def scene(self, file: h5py.File) -> str:
        """Read the MJCF, from the file or from one beside it."""
        beside = self.text_attribute(file, "path")
        if beside is not None:
            if Path(beside).name != beside:
                raise self.error(
                    "the scene must lie beside the recording", "attribute path", expected="a file name", found=beside
                )
            try:
                return Scene.from_mjcf(self.path.parent / beside, warn_outside=False).xml
            except SceneError as error:
                raise self.error("its scene cannot be read", "attribute path", found=str(error).rstrip(".")) from None
        if "scene" not in file:
            raise self.error("the recording has no scene", "scene", expected="MJCF text, or an attribute 'path'")
        dataset = self.dataset(file, "scene")
        kind = h5py.check_string_dtype(dataset.dtype)
        if kind is None or dataset.shape != ():
            raise self.error(
                "the scene is not text", "scene", expected="one string", found=f"{dataset.shape} {dataset.dtype}"
            )
        if (kind.length or 0) > limits().scene_bytes:
            raise self.error(
                "the scene is too long",
                "scene",
                expected=f"{limits().scene_bytes} bytes",
                fix=raising("scene_bytes"),
                found=kind.length,
            )
        self.check_attributes(dataset, {CHECKSUM})
        stored = self.bounded(lambda: dataset[()], "scene")
        self.check_sum(dataset, stored if isinstance(stored, bytes) else str(stored).encode())
        return self.decode(stored, "scene")

    def demonstration(self, group: h5py.Group, name: str) -> Demonstration:
        """Read one demonstration."""
        self.refuse_unknown(
            group, {"initial", "action", "measured", "points", "image", "policy", "payloads"}, {"task", "success"}
        )
        success = self.attribute(group, "success")
        if success is not None and (np.shape(success) != () or success not in (0, 1)):
            raise self.error("success is not a truth value", group.name, expected="true or false", found=success)
        state: dict[str, np.ndarray | None] = {"qpos": None, "qvel": None}
        if "initial" in group:
            initial = self.group(group, "initial")
            self.refuse_unknown(initial, set(state))
            state |= {key: self.array(initial, key) for key in state if key in initial}
        return Demonstration(
            name=name,
            task=self.text_attribute(group, "task") or "",
            success=None if success is None else bool(success),
            action=self.streams(group, "action", self.channel),
            measured=self.streams(group, "measured", self.channel),
            points=self.streams(group, "points", self.points),
            image=self.streams(group, "image", self.image),
            policy=self.policy(self.group(group, "policy")) if "policy" in group else None,
            payloads=self.payloads(self.group(group, "payloads")) if "payloads" in group else (),
            **state,
        )

    def streams(self, group: h5py.Group, kind: str, read: Callable[[h5py.Group], Stream]) -> dict[str, Stream]:
        """Read all channels of one kind."""
        if kind not in group:
            return {}
        parent = self.group(group, kind)
        if len(parent) > limits().channels:
            raise self.error(
                "too many channels",
                parent.name,
                expected=f"at most {limits().channels}",
                fix=raising("channels"),
                found=len(parent),
            )
        return {name_of(str(name)): read(self.group(parent, str(name))) for name in parent}

    def channel(self, group: h5py.Group) -> Channel:
        """Read a commanded or measured channel."""
        self.refuse_unknown(group, {"time", "value", "covariance", "common"}, {"noise_std", "frame"})
        noise = self.attribute(group, "noise_std")
        if noise is not None and (np.shape(noise) != () or np.asarray(noise).dtype.kind not in "fiu"):
            raise self.error("noise_std is not a number", group.name, expected="one number", found=noise)
        return Channel(
            self.array(group, "time"),
            self.array(group, "value"),
            None if noise is None else float(noise),
            self.text_attribute(group, "frame"),
            self.array(group, "covariance") if "covariance" in group else None,
            self.array(group, "common") if "common" in group else None,
        )

    def policy(self, group: h5py.Group) -> PolicyLog:
        """Read what a policy observed and did."""
        names = ("time", "observation", "action")
        self.refuse_unknown(group, set(names))
        return PolicyLog(*(self.array(group, name) for name in names))

    def payloads(self, group: h5py.Group) -> tuple[Payload, ...]:
        """Read what bodies carried: by body a row of `Payload.numbers` for each weight."""
        found = []
        for name in group:
            rows = self.array(group, str(name))
            if rows.ndim != 2 or rows.shape[1] != PAYLOAD_NUMBERS:
                raise self.error(
                    "not rows of payloads",
                    f"{group.name}/{name}",
                    expected=f"{PAYLOAD_NUMBERS} numbers each: mass, position and moments of inertia",
                    found=rows.shape,
                )
            found += [Payload.of(name_of(str(name)), row) for row in rows]
        return tuple(found)

    def points(self, group: h5py.Group) -> PointTrack:
        """Read the point track of one body."""
        self.refuse_unknown(group, {"time", "value", "visible"})
        return PointTrack(self.array(group, "time"), self.array(group, "value"), self.array(group, "visible", bool))

    def image(self, group: h5py.Group) -> ImageStream:
        """Read the frames of one camera."""
        self.refuse_unknown(group, {"time", "rgb", "depth"}, {"intrinsics", "pose", "body"})
        matrices = {name: self.attribute(group, name) for name in ("intrinsics", "pose")}
        for name, shape in (("intrinsics", (3, 3)), ("pose", (4, 4))):
            if np.shape(matrices[name]) != shape:
                found = np.shape(matrices[name]) if name in group.attrs else "no such attribute"
                raise self.error(f"{name} is not a matrix", group.name, expected=shape, found=found)
        return ImageStream(
            self.array(group, "time"),
            self.array(group, "rgb", np.uint8),
            self.array(group, "depth", np.float32),
            np.asarray(matrices["intrinsics"]),
            np.asarray(matrices["pose"]),
            self.text_attribute(group, "body"),
        )
