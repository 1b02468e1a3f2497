"""Residuals: what was measured less what a model predicts, channel by channel, at the measurement's own times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.checks import Count
from concent_warp.errors import RecordingError
from concent_warp.estimation.noise import Noise, Source, channel_noise, pooled_noise
from concent_warp.estimation.noise_ratio import rms_noise
from concent_warp.estimation.rotations import (
    continuous_quaternions,
    rotation_between,
    rotation_matrices,
    rotation_vectors,
)
from concent_warp.estimation.sample_noise import relative_whitening, whitened
from concent_warp.estimation.sensors import LOCAL, Kind, body_of, kind_and_unit
from concent_warp.recording.recording import Channel
from concent_warp.simulate.replay import interpolate, predict

if TYPE_CHECKING:
    from concent_warp.effects.effect import AddedEffect, Reader
    from concent_warp.recording.recording import Demonstration, PointTrack
    from concent_warp.simulate.engine import Rollout


@dataclass(frozen=True)
class ResidualCfg:
    """How residuals are computed."""

    anchor_frames: Count = 5
    """First frames of a point track from which the points' positions on the body are estimated [-]: few, because the
    model's own motion carries them; several, so that their scatter gives the noise."""


@dataclass(frozen=True)
class Residual:
    """Measurement less model of one channel of one demonstration."""

    channel: str
    """Sensor name, or ``<body> points`` of a point track."""
    kind: Kind
    unit: str
    """Unit of `value`, `error` and `noise`."""
    body: str | None
    """Body that the channel is about, where it is about one; of a joint the body that it moves."""
    time: np.ndarray
    """Times of the measurements [s], shape (T,)."""
    value: np.ndarray
    """Measured less predicted, shape (T, dim); of an orientation the rotation vector from predicted to measured, in
    the predicted frame; of points the mean over the visible points; NaN where nothing was measured."""
    error: np.ndarray
    """How far off, shape (T,): Euclidean norm, rotation angle, mean distance of the visible points from where the model
    has them; NaN where nothing was measured, infinite where the model has diverged."""
    noise: float | None
    """Root mean square of `error` that noise alone leaves with a perfect model; None where the noise is not known."""
    std: float | None = None
    """Standard deviation of the noise of each component of `value`, where it is known; of points that of one."""
    source: Source = "unknown"
    """Where the noise is from."""
    extent: float = 0.0
    """How far the measured values move: diagonal of the box that holds them, largest turn of an orientation."""
    local: bool = False
    """Whether `value` is in a frame that moves along with the body, rather than in the world frame."""
    weight: np.ndarray | None = None
    """How much more an error counts where the channel's covariances say that it is surer than on average, in the
    error's own direction [-], shape (T,); None where all samples are alike."""

    @property
    def weighted(self) -> np.ndarray:
        """Error as `noise` measures it, which is the error itself where all samples are alike, shape (T,)."""
        return self.error if self.weight is None else self.error * self.weight

    @property
    def moves(self) -> bool:
        """Whether the measured values move by more than noise alone spans; true where the noise is not known.

        The extremes of n normal deviates are, in most cases, within sqrt(2 ln n) standard deviations.
        """
        count, dim = int(np.isfinite(self.error).sum()), self.value.shape[1]
        spanned = 2 * np.sqrt(2 * dim * np.log(max(count, 2)))
        return self.std is None or self.extent > spanned * self.std

    @property
    def ratio(self) -> np.ndarray | None:
        """Error over noise [-], shape (T,); root mean square 1 where only noise is left. None without noise."""
        return self.weighted / self.noise if self.noise else None


def residuals(
    compiled: mujoco.MjModel,
    rollout: Rollout,
    demonstration: Demonstration,
    noise: Mapping[str, Noise] | None = None,
    effects: Sequence[AddedEffect] = (),
    cfg: ResidualCfg | None = None,
) -> tuple[Residual, ...]:
    """Return the residuals of every measured channel and every point track.

    Args:
        compiled: The model as the engine compiled it.
        rollout: Replay of the demonstration, one variant, NumPy, all bodies recorded.
        demonstration: What was measured.
        noise: Noise by channel (`instrument_noise`); estimated from this demonstration alone where there is none.
        effects: Those of the model; what they do to the instruments is in what is predicted.
        cfg: Settings.

    Raises:
        RecordingError: A channel names a sensor or a body that the model lacks, or has another dimension.
    """
    known = noise or {}
    read: Reader = lambda sensor, time: predict(compiled, rollout, sensor, Channel(time, time))  # noqa: E731
    for added in effects:
        read = added.effect.measure(compiled, read, added.array)
    found = [
        _sensor_residual(compiled, read, name, channel, demonstration.name, known.get(name))
        for name, channel in demonstration.measured.items()
    ]
    for body, track in demonstration.points.items():
        if body not in rollout.bodies:
            raise RecordingError(
                f"points of a body {body!r} that the model lacks",
                where=demonstration.name,
                expected=f"one of {list(rollout.bodies)}",
            )
        found.append(_point_residual(rollout, body, track, (cfg or ResidualCfg()).anchor_frames))
    return tuple(found)


def instrument_noise(compiled: mujoco.MjModel, demonstrations: Sequence[Demonstration]) -> dict[str, Noise]:
    """Return the noise of each sensor that the model has, from all demonstrations together."""
    found = {}
    for name in dict.fromkeys(name for d in demonstrations for name in d.measured):
        if (row := mujoco.mj_name2id(compiled, mujoco.mjtObj.mjOBJ_SENSOR, name)) >= 0:
            channels = [d.measured[name] for d in demonstrations if name in d.measured]
            found[name] = pooled_noise(channels, kind_and_unit(compiled, row)[0])
    return found


def _sensor_residual(
    compiled: mujoco.MjModel, read: Reader, name: str, channel: Channel, where: str, noise: Noise | None = None
) -> Residual:
    """Return the residual of one sensor; `read` returns its readings at given times in the model's world."""
    row = mujoco.mj_name2id(compiled, mujoco.mjtObj.mjOBJ_SENSOR, name)
    if row < 0:
        names = [compiled.sensor(i).name for i in range(compiled.nsensor)]
        raise RecordingError(
            f"a measurement of a sensor {name!r} that the model lacks",
            where=where,
            expected=f"one of {names}",
            fix="add that sensor to the model's MJCF, or leave the channel out",
        )
    if channel.value.shape[1] != compiled.sensor_dim[row]:
        raise RecordingError(
            f"sensor {name!r} measures another number of values than the model's",
            where=where,
            expected=int(compiled.sensor_dim[row]),
            found=channel.value.shape[1],
        )
    predicted = read(name, channel.time)
    kind, unit = kind_and_unit(compiled, row)
    value = rotation_between(predicted, channel.value) if kind == "orientation" else channel.value - predicted
    known = np.isfinite(channel.value)
    size = int(known.any(axis=0).sum()) if kind != "orientation" else value.shape[1]
    error = np.linalg.norm(value, axis=1) if kind == "orientation" else _norm(value, size)
    if noise is None or channel.noise_std or channel.covariance is not None:
        noise = channel_noise(channel, kind)
    std = noise.std if np.isfinite(noise.std) else None
    return Residual(
        channel=name,
        kind=kind,
        unit=unit,
        body=body_of(compiled, row),
        time=channel.time,
        value=value,
        error=_lost(error, predicted, np.asarray(known.any(axis=1))),
        noise=None if std is None else rms_noise(std, size),
        std=std,
        source=noise.source,
        extent=_extent(channel.value, kind),
        local=int(compiled.sensor_type[row]) in LOCAL,
        weight=_weight(value, channel),
    )


def _weight(value: np.ndarray, channel: Channel) -> np.ndarray | None:
    """Return the length of whitened residuals over theirs, shape (T,), 1 where there is none; None without covariances.

    Args:
        value: Residuals, shape (T, k).
        channel: The channel.
    """
    matrices = relative_whitening(channel)
    if matrices is None:
        return None
    length = np.linalg.norm(value, axis=1)
    usable = np.isfinite(length) & (length > 0)
    return np.where(usable, np.linalg.norm(whitened(value, matrices), axis=1) / np.where(usable, length, 1.0), 1.0)


def _norm(value: np.ndarray, size: int) -> np.ndarray:
    """Return the lengths of vectors (T, dim), NaN where nothing is known of one, shape (T,).

    Of a vector that is known in part, the length is what all `size` components would have if those that are missing
    were like those that are not.
    """
    length = np.linalg.norm(value, axis=1)
    count = np.isfinite(value).sum(axis=1)
    part = (count > 0) & ~np.isfinite(length) & ~np.isinf(value).any(axis=1)
    length[part] = np.sqrt(np.nansum(value[part] ** 2, axis=1) * (size / count[part]))
    return length


def _extent(value: np.ndarray, kind: Kind) -> float:
    """Return how far readings (T, dim) move: diagonal of their box, of orientations the largest turn from the first."""
    known = np.isfinite(value)
    if kind != "orientation":
        ranges = [float(np.ptp(column[here])) for column, here in zip(value.T, known.T, strict=True) if here.any()]
        return float(np.linalg.norm(ranges)) if ranges else 0.0
    valid = value[np.asarray(known.all(axis=1))]
    if not len(valid):
        return 0.0
    if kind == "orientation":
        return float(np.linalg.norm(rotation_vectors(np.broadcast_to(valid[0], valid.shape), valid), axis=1).max())
    return float(np.linalg.norm(np.ptp(valid, axis=0)))


def _point_residual(rollout: Rollout, body: str, track: PointTrack, anchor_frames: int) -> Residual:
    """Return the residual of a point track: each material point against where the model's body carries it.

    Where a point sits on the body is the mean of its first `anchor_frames` observations, brought into the body frame by
    the model's own pose at these times; points not seen then take no part. Their scatter gives the
    noise.
    """
    row = rollout.bodies.index(body)
    position = interpolate(rollout.time, rollout.body_position[0][:, row], track.time)
    quaternion = interpolate(rollout.time, continuous_quaternions(rollout.body_quaternion[0][:, row]), track.time)
    rotation = rotation_matrices(quaternion)
    seen = np.where(track.visible[..., None], track.value, np.nan)
    first = slice(anchor_frames)
    local = np.einsum("tji,tmj->tmi", rotation[first], seen[first] - position[first, None])
    there = np.isfinite(local).all(axis=2)
    sightings = there.sum(axis=0)
    anchor = np.where(there[..., None], local, 0).sum(axis=0) / np.maximum(sightings, 1)[:, None]
    anchor[sightings == 0] = np.nan
    offset = seen - (position[:, None] + np.einsum("tij,mj->tmi", rotation, anchor))
    measured = np.isfinite(seen).all(axis=2) & (sightings > 0)
    share = measured / np.maximum(measured.sum(axis=1), 1)[:, None]
    distance = np.where(measured, np.linalg.norm(offset, axis=2), 0)
    value = (share[..., None] * np.where(measured[..., None], offset, 0)).sum(axis=1)
    some = np.asarray(measured.any(axis=1))
    value[~some] = np.nan
    error = np.where(some, (share * distance).sum(axis=1), np.nan)
    std = _point_noise(local, anchor, sightings)
    noise = None if std is None else std * _rms_mean_distance(measured.sum(axis=1)[some])
    return Residual(
        channel=f"{body} points",
        kind="points",
        unit="m",
        body=body,
        time=track.time,
        value=value,
        error=_lost(error, position, some),
        noise=noise,
        std=std,
        source="unknown" if noise is None else "points",
        extent=_extent(value + position, "points"),
    )


def _point_noise(local: np.ndarray, anchor: np.ndarray, sightings: np.ndarray) -> float | None:
    """Return the standard deviation of a component of a point's residual [m] that noise alone leaves; None if unknown.

    Args:
        local: The first observations of each point, body frame [m], shape (F, M, 3).
        anchor: Their means, shape (M, 3), whose error is part of the residual.
        sightings: Number of these observations, shape (M,).
    """
    several = sightings > 1
    if not several.any():
        return None
    square = np.nansum((local[:, several] - anchor[several]) ** 2)
    std = np.sqrt(square / (3 * (sightings[several] - 1).sum()))
    return float(std * np.sqrt(1 + np.mean(1 / sightings[several])))


def _lost(error: np.ndarray, predicted: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return `error` (T,), infinite where something was `measured` (T,) and `predicted` (T, dim) is not finite."""
    diverged = measured & ~np.isfinite(predicted).all(axis=1)
    return np.where(diverged, np.inf, np.where(measured, error, np.nan))


def _rms_mean_distance(count: np.ndarray) -> float:
    """Return the root mean square of the mean length of noise vectors in three dimensions of unit standard deviation.

    The length has the mean sqrt(8 / pi) and the second moment 3 (Maxwell distribution).

    Args:
        count: Numbers of vectors that are averaged, shape (T,).
    """
    square = 8 / np.pi
    return float(np.sqrt(np.mean(square + (3 - square) / np.maximum(count, 1)))) if len(count) else np.sqrt(3)
