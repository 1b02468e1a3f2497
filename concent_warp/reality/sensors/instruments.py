"""Sensors of the rigs: encoders and a pose tracker, with a separate clock for each channel.

The noise is white with a small slow component: the bias of a tracker drifts with light and view, that of an encoder
with the angle. `noise_std` of a channel is the root mean square of both.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np

from concent_warp.recording.recording import Channel

SENSOR = mujoco.mjtSensor


@dataclass(frozen=True)
class Instrument:
    """Rate and noise of one kind of instrument; stds are those of each component."""

    rate: float
    """Readings a second [Hz]."""
    white: float
    """Standard deviation of the white noise [unit of the channel]."""
    slow: float = 0.0
    """Standard deviation of the slow part [unit of the channel]."""
    memory: float = 0.3
    """Correlation time of the slow part [s]."""
    jitter: float = 0.02
    """Standard deviation of the instants of reading over their spacing [-]; recorded times are the true ones."""

    @property
    def std(self) -> float:
        """Standard deviation of the noise in all."""
        return float(np.hypot(self.white, self.slow))

    def times(self, duration: float, rng: np.random.Generator) -> np.ndarray:
        """Return the instants of reading [s] within 0..duration, evenly spaced but for the jitter, shape (T,)."""
        grid = np.arange(rng.uniform(0, 1 / self.rate), duration, 1 / self.rate)
        return np.clip(grid + rng.normal(0, self.jitter / self.rate, len(grid)), 0, duration)

    def noise(self, time: np.ndarray, dim: int, rng: np.random.Generator) -> np.ndarray:
        """Return noise at the instants `time` (T,) [s], shape (T, dim)."""
        white = rng.normal(0, self.white, (len(time), dim))
        kick = rng.normal(0, 1, (len(time), dim))
        keep = np.exp(-np.diff(time, prepend=time[:1]) / self.memory)
        slow = np.empty((len(time), dim))
        state = kick[0]
        for t in range(len(time)):
            state = keep[t] * state + np.sqrt(1 - keep[t] ** 2) * kick[t]
            slow[t] = state
        return white + self.slow * slow


@dataclass(frozen=True)
class Instruments:
    """Instruments by measured quantity."""

    angle: Instrument = field(default_factory=lambda: Instrument(200.0, 7e-4, 1e-4))
    """Encoder of a hinge [rad]."""
    travel: Instrument = field(default_factory=lambda: Instrument(200.0, 1e-4, 1.5e-5))
    """Encoder of a slide [m]."""
    turning: Instrument = field(default_factory=lambda: Instrument(200.0, 0.02))
    """Speed of a hinge, as its drive reports it [rad/s]."""
    speed: Instrument = field(default_factory=lambda: Instrument(200.0, 3e-3))
    """Speed of a slide, as its drive reports it [m/s]."""
    position: Instrument = field(default_factory=lambda: Instrument(100.0, 3e-4, 5e-5))
    """Tracked position [m]."""
    orientation: Instrument = field(default_factory=lambda: Instrument(100.0, 3e-3, 5e-4))
    """Tracked orientation [rad], by component of the rotation vector."""

    def of(self, model: mujoco.MjModel, sensor: int) -> Instrument:
        """Return the instrument that reads a sensor of the world.

        Raises:
            ValueError: None of them does.
        """
        kind, target = SENSOR(int(model.sensor_type[sensor])), int(model.sensor_objid[sensor])
        if kind == SENSOR.mjSENS_FRAMEPOS:
            return self.position
        if kind == SENSOR.mjSENS_FRAMEQUAT:
            return self.orientation
        slides = kind == SENSOR.mjSENS_TENDONPOS or (
            kind in (SENSOR.mjSENS_JOINTPOS, SENSOR.mjSENS_JOINTVEL)
            and model.jnt_type[target] == mujoco.mjtJoint.mjJNT_SLIDE
        )
        if kind in (SENSOR.mjSENS_JOINTPOS, SENSOR.mjSENS_TENDONPOS):
            return self.travel if slides else self.angle
        if kind == SENSOR.mjSENS_JOINTVEL:
            return self.speed if slides else self.turning
        raise ValueError(f"no instrument reads sensor {model.sensor(sensor).name!r} of type {kind.name}")


def instrument_reading(
    instrument: Instrument,
    time: np.ndarray,
    value: np.ndarray,
    rng: np.random.Generator,
    *,
    quaternion: bool = False,
) -> Channel:
    """Return what an instrument writes down.

    Args:
        instrument: It.
        time: Times of the steps [s], shape (K,).
        value: What there was to see at each step, shape (K, dim).
        rng: Source of clock and noise.
        quaternion: Whether the values are orientations, wxyz.
    """
    at = instrument.times(float(time[-1]), rng)
    seen = np.stack([np.interp(at, time, column) for column in value.T], axis=1)
    if quaternion:
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        noise = instrument.noise(at, 3, rng)
        for row, vector in zip(seen, noise, strict=True):
            mujoco.mju_quatIntegrate(row, vector, 1.0)
    else:
        seen = seen + instrument.noise(at, value.shape[1], rng)
    return Channel(at, seen, noise_std=instrument.std)
