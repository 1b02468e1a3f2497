"""Recordings in memory: commands and measurements with time stamps.

Everything is SI (m, s, rad, kg, N), quaternions are wxyz, the angular velocity of a free body is in the body frame.
Each channel has clock readings of its own; a value may be NaN (missing), a time may not.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.recording.arrays import as_array
from concent_warp.scene.payloads import Payload


@dataclass(frozen=True)
class Channel:
    """One commanded or measured signal; lists and whole numbers become arrays of floating-point numbers.

    Example:
        >>> import concent_warp as cw
        >>> import numpy as np
        >>> channel = cw.Channel(np.array([0.0, 0.01]), np.array([[0.0], [0.1]]), noise_std=0.001)
        >>> channel.value.shape
        (2, 1)
    """

    time: np.ndarray
    """Clock readings [s], shape (T,), strictly increasing."""
    value: np.ndarray
    """Values in SI units, shape (T,) for an action, (T, dim) for a measurement; NaN where missing."""
    noise_std: float | None = None
    """Standard deviation of the measurement noise in the channel's unit, where known."""
    frame: str | None = None
    """Name of the frame the values are expressed in, where it is not the world."""
    covariance: np.ndarray | None = None
    """Covariance of each sample's error, shape (T, k, k), where known; NaN where the value is missing. k is the
    dimension of the value, and 3 for quaternions, whose error is a rotation vector [rad] in the body's frame."""
    common: np.ndarray | None = None
    """What of it the samples share, shape (T, k, m): how each error that all samples of the channel have in common
    changes a sample, per standard deviation of that error. ``common @ common.T`` is a part of each covariance."""

    def __post_init__(self) -> None:
        _set_arrays(self, ("time", "value", "covariance", "common"))


@dataclass(frozen=True)
class PointTrack:
    """Tracked surface points of one body, in the world frame.

    Example:
        >>> import concent_warp as cw
        >>> import numpy as np
        >>> track = cw.PointTrack(np.array([0.0, 0.1]), np.zeros((2, 3, 3)), np.ones((2, 3), dtype=bool))
        >>> track.value.shape  # times, points, coordinates
        (2, 3, 3)
    """

    time: np.ndarray
    """Clock readings [s], shape (T,)."""
    value: np.ndarray
    """Point positions [m], world frame, shape (T, M, 3); point m is the same material point in every frame."""
    visible: np.ndarray
    """Whether a point was seen in a frame, shape (T, M), bool."""

    def __post_init__(self) -> None:
        _set_arrays(self, ("time", "value", "visible"))


@dataclass(frozen=True)
class ImageStream:
    """RGB-D frames of one camera, fixed in the world or to a body."""

    time: np.ndarray
    """Clock readings [s], shape (T,)."""
    rgb: np.ndarray
    """Colour, shape (T, H, W, 3), uint8."""
    depth: np.ndarray
    """Planar depth [m], shape (T, H, W), float32; 0 where there is none."""
    intrinsics: np.ndarray
    """Pinhole matrix [px], shape (3, 3)."""
    pose: np.ndarray
    """Camera-to-world transform, shape (4, 4); camera axes x right, y down, z forward."""
    body: str | None = None
    """Body that carries the camera, which `pose` is then relative to; None for a camera fixed in the world."""


@dataclass(frozen=True)
class PolicyLog:
    """What a policy observed and did in each control step of a trial.

    Example:
        >>> import concent_warp as cw
        >>> import numpy as np
        >>> log = cw.PolicyLog(np.array([0.0, 0.05]), np.zeros((2, 155)), np.zeros((2, 8)))
        >>> log.action.shape
        (2, 8)
    """

    time: np.ndarray
    """Times at which it was asked [s], shape (T,), strictly increasing."""
    observation: np.ndarray
    """Its observations, as `concent export` describes them, shape (T, O)."""
    action: np.ndarray
    """Its actions, -1..1, shape (T, A)."""

    def __post_init__(self) -> None:
        _set_arrays(self, ("time", "observation", "action"))


@dataclass(frozen=True)
class Demonstration:
    """One execution of a task, or one toss, swing or push: everything recorded between start and stop.

    Commands given with shape (T, 1) become (T,), measurements given with shape (T,) become (T, 1).

    Example:
        >>> import concent_warp as cw
        >>> demonstration = cw.load_recording(cw.example("servo"))[0]
        >>> demonstration.name, list(demonstration.action), list(demonstration.measured)
        ('demo_0', ['servo'], ['hinge_position', 'marker_position'])
    """

    name: str
    task: str = ""
    success: bool | None = None
    qpos: np.ndarray | None = None
    """Generalised position at time 0, shape (nq,), where known."""
    qvel: np.ndarray | None = None
    """Generalised velocity at time 0, shape (nv,), where known."""
    action: Mapping[str, Channel] = field(default_factory=dict)
    """What was commanded, by actuator name; each value is held until the next sample."""
    measured: Mapping[str, Channel] = field(default_factory=dict)
    """What was measured, by the name of the MJCF sensor that predicts it."""
    points: Mapping[str, PointTrack] = field(default_factory=dict)
    """Tracked points, by body name."""
    image: Mapping[str, ImageStream] = field(default_factory=dict)
    """RGB-D streams, by camera name."""
    policy: PolicyLog | None = None
    """What the policy observed and did, in a trial of one."""
    payloads: tuple[Payload, ...] = ()
    """Known weights that bodies carried, which the scene does not have."""

    def __post_init__(self) -> None:
        _set_arrays(self, ("qpos", "qvel"))
        kinds = {"action": Channel, "measured": Channel, "points": PointTrack, "image": ImageStream}
        for kind, expected in kinds.items():
            streams = getattr(self, kind)
            if not isinstance(streams, Mapping):
                raise RecordingError(
                    f"{kind} of demonstration {self.name!r} is not a dictionary",
                    expected=f"a {expected.__name__} by name",
                    found=type(streams).__name__,
                )
            for name, stream in streams.items():
                if not isinstance(stream, expected):
                    raise RecordingError(
                        f"{kind}/{name} of demonstration {self.name!r} is not a {expected.__name__}",
                        found=type(stream).__name__,
                        fix=f"write {expected.__name__}(time, ...)",
                    )
        if any(one.value.ndim == 2 and one.value.shape[1] == 1 for one in self.action.values()):
            flat = {
                n: replace(c, value=c.value[:, 0]) if c.value.ndim == 2 and c.value.shape[1] == 1 else c
                for n, c in self.action.items()
            }
            object.__setattr__(self, "action", flat)
        if any(one.value.ndim == 1 for one in self.measured.values()):
            columns = {
                n: replace(c, value=c.value[:, None]) if c.value.ndim == 1 else c for n, c in self.measured.items()
            }
            object.__setattr__(self, "measured", columns)

    @property
    def duration(self) -> float:
        """Time of the last sample of any channel [s]."""
        streams = [*self.action.values(), *self.measured.values(), *self.points.values(), *self.image.values()]
        return max((float(s.time[-1]) for s in streams if len(s.time)), default=0.0)


@dataclass(frozen=True)
class Recording:
    """One or more demonstrations in the same scene.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> [demonstration.name for demonstration in recording.demonstrations]
        ['demo_0']
    """

    scene: str
    """Self-contained MJCF text of the scene."""
    demonstrations: tuple[Demonstration, ...]
    source: str = "<memory>"
    """File or folder that it came from, for messages."""

    def __post_init__(self) -> None:
        if not isinstance(self.scene, str):
            raise RecordingError(
                "the scene of a recording is not text", where=self.source, expected="MJCF text, such as Scene.xml",
                found=type(self.scene).__name__,
            )  # fmt: skip
        given = self.demonstrations
        if not isinstance(given, Sequence) or not all(isinstance(one, Demonstration) for one in given):
            kinds = [type(one).__name__ for one in given] if isinstance(given, list | tuple) else type(given).__name__
            raise RecordingError(
                "the demonstrations of a recording are not a tuple of Demonstration", where=self.source, found=kinds,
                fix="write Recording(scene, (demonstration,))",
            )  # fmt: skip
        object.__setattr__(self, "demonstrations", tuple(given))

    def __getitem__(self, name: str | int) -> Demonstration:
        """Return a demonstration by name or by position."""
        if isinstance(name, int):
            return self.demonstrations[name]
        for demonstration in self.demonstrations:
            if demonstration.name == name:
                return demonstration
        raise KeyError(f"{self.source}: no demonstration {name!r}; it has {[d.name for d in self.demonstrations]}")

    def with_noise(self, noise: Mapping[str, float]) -> Recording:
        """Return the recording with the noise of some channels stated.

        Args:
            noise: Standard deviation of a component by the name of the channel, or by a pattern of names such as
                ``*_position``, in the channel's unit; of an orientation per component of the rotation vector
                [rad].

        Raises:
            RecordingError: No channel has such a name, or a value is not above 0.
        """
        names = {name for d in self.demonstrations for name in d.measured}
        stated: dict[str, float] = {}
        for pattern, std in noise.items():
            if not (std > 0 and np.isfinite(std)):
                raise RecordingError(f"noise of {pattern!r} makes no sense", expected="a number above 0", found=std)
            meant = sorted(fnmatch.filter(names, pattern))
            if not meant:
                raise RecordingError(
                    "noise of a channel that was not measured",
                    where=self.source,
                    expected=f"one of {sorted(names)}, or a pattern",
                    found=pattern,
                )
            stated |= dict.fromkeys(meant, float(std))
        demonstrations = []
        for d in self.demonstrations:
            measured = {n: replace(c, noise_std=stated.get(n, c.noise_std)) for n, c in d.measured.items()}
            demonstrations.append(replace(d, measured=measured))
        return replace(self, demonstrations=tuple(demonstrations))

    def only(self, names: Sequence[str]) -> Recording:
        """Return the recording with some of its demonstrations, in its own order; with all where `names` is empty.

        Raises:
            RecordingError: There is no such demonstration.
        """
        known = [d.name for d in self.demonstrations]
        if unknown := sorted(set(names) - set(known)):
            raise RecordingError("no such demonstration", where=self.source, expected=f"some of {known}", found=unknown)
        return replace(self, demonstrations=tuple(d for d in self.demonstrations if not names or d.name in names))

    def check_unloaded(self, purpose: str) -> None:
        """Check that no body carried a payload.

        Args:
            purpose: What the demonstrations are wanted for, such as "a fit of contact geometry".

        Raises:
            RecordingError: One did.
        """
        if loaded := [d.name for d in self.demonstrations if d.payloads]:
            raise RecordingError(
                f"a body carried a payload, which {purpose} does not take into account",
                where=self.source,
                expected="demonstrations in the scene as it is",
                found=loaded,
                fix="leave these demonstrations out",
            )


def _set_arrays(owner: object, names: Sequence[str]) -> None:
    """Replace what the fields of a frozen dataclass hold by arrays, None excepted.

    Raises:
        RecordingError: A field holds what is no array, such as rows of unequal length.
    """
    for name in names:
        if (given := getattr(owner, name)) is not None:
            object.__setattr__(owner, name, as_array(given, f"{name} of a {type(owner).__name__}"))
