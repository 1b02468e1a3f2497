"""What instruments show of a motion: noise, rounding, lost readings, clocks that jitter, and what is off in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.foreign.log import Table

Rng = np.random.Generator


def at(time: np.ndarray, values: np.ndarray, when: np.ndarray) -> np.ndarray:
    """Return values, of shape (steps,) or (steps, n), at other times; the first and last one beyond the ends."""
    if values.ndim == 1:
        return np.interp(when, time, values)
    return np.stack([np.interp(when, time, column) for column in values.T], axis=1)


def smooth_step(t: np.ndarray) -> np.ndarray:
    """Return the path of least jerk from 0 at time 0 to 1 at time 1 (Flash and Hogan, J. Neurosci. 5, 1985)."""
    s = np.clip(t, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)


@dataclass(frozen=True)
class Command:
    """Set-points at a fixed rate, each held until the next one."""

    time: np.ndarray
    value: np.ndarray

    def __call__(self, t: float) -> float:
        """Return the set-point at a time [s]; the first one before the beginning."""
        rate = (len(self.time) - 1) / self.time[-1]
        k = int(t * rate + 1e-6)
        return float(self.value[min(max(k, 0), len(self.value) - 1)])

    def table(self) -> Table:
        """Return what was logged."""
        return Table(self.time, {"command": self.value})


def command_times(duration: float, rate: float = 100.0) -> np.ndarray:
    """Return times of set-points [s]."""
    return np.arange(round(duration * rate) + 1) / rate


@dataclass(frozen=True)
class Encoder:
    """An encoder of a joint."""

    rate: float = 250.0
    step: float = 2e-5
    """Resolution [m or rad]."""
    noise: float = 3e-5
    """Standard deviation before quantisation [m or rad]."""

    @property
    def deviation(self) -> float:
        """Standard deviation of a reading, that of rounding included."""
        return float(np.hypot(self.noise, self.step / np.sqrt(12)))

    def read(self, rng: Rng, time: np.ndarray, position: np.ndarray, name: str = "position") -> Table:
        """Return readings over a motion."""
        when = np.arange(1, int(time[-1] * self.rate) + 1) / self.rate
        value = at(time, position, when) + rng.normal(0, self.noise, len(when))
        return Table(when, {name: np.round(value / self.step) * self.step})


@dataclass(frozen=True)
class Camera:
    """A tracker of poses."""

    rate: float = 90.0
    noise: float = 4e-4
    """Standard deviation of each coordinate [m]."""
    turn_noise: float = 0.004
    """Standard deviation of each component of the rotation vector [rad]."""
    lost: float = 0.0
    """Share of the frames in which the object is not found."""
    jitter: float = 0.0
    """Half width of the scatter of true times about the stamped ones [s]."""
    latency: float = 0.0
    clock: float = 0.0
    """The clock shows t (1 + clock) at time t."""
    scale: float = 0.0
    """Positions are shown times 1 + scale."""
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the camera's idea of the world's origin is [m]."""
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """By which rotation vector the camera's idea of the world is turned [rad]."""

    def clocks(self, rng: Rng, duration: float) -> tuple[np.ndarray, np.ndarray]:
        """Return stamped and true times [s] of frames within a motion."""
        first = rng.uniform(0.002, 0.008)
        stamped = np.arange(first, duration * (1 + self.clock) - 1e-3, 1 / self.rate)
        true = stamped / (1 + self.clock) - self.latency + rng.uniform(-1, 1, len(stamped)) * self.jitter
        return stamped, true

    def read(
        self,
        rng: Rng,
        time: np.ndarray,
        position: np.ndarray,
        orientation: np.ndarray | None = None,
        seen: str = "xyz",
    ) -> tuple[Table, Table]:
        """Return positions and orientations as shown.

        Args:
            rng: Source of noise.
            time: Times of the motion [s].
            position: Positions [m], shape (steps, 3).
            orientation: Quaternions, w first, shape (steps, 4); upright where absent.
            seen: Axes that are read; the others are empty.
        """
        stamped, true = self.clocks(rng, time[-1])
        p = at(time, position, true)
        if orientation is None:
            q = np.tile([1.0, 0.0, 0.0, 0.0], (len(true), 1))
        else:
            q = at(time, orientation, true)
            q /= np.linalg.norm(q, axis=1)[:, None]
        turn = rotation(np.array(self.turn))
        p = turned(conjugate(turn), p - np.array(self.shift)) * (1 + self.scale)
        q = product(conjugate(turn), q)
        p = p + rng.normal(0, self.noise, p.shape)
        q = product(q, rotation(rng.normal(0, self.turn_noise, (len(true), 3))))
        gone = rng.random(len(true)) < self.lost
        gone[:3] = False
        p[gone] = np.nan
        q[gone] = np.nan
        p[:, [axis not in seen for axis in "xyz"]] = np.nan
        return Table(stamped, dict(zip("xyz", p.T, strict=True))), Table(stamped, dict(zip("wxyz", q.T, strict=True)))


def rotation(vector: np.ndarray) -> np.ndarray:
    """Return quaternions, w first, of rotation vectors [rad], shape (..., 3)."""
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * vector], axis=-1)


def conjugate(q: np.ndarray) -> np.ndarray:
    """Return the inverse rotation of a unit quaternion."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the product of quaternions: first b, then a."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def turned(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return vectors, turned by quaternions."""
    pure = np.concatenate([np.zeros((*v.shape[:-1], 1)), v], axis=-1)
    return product(product(q, pure), conjugate(q))[..., 1:]
