"""Encoders and a pose tracker with the imperfections of real ones, for all worlds.

White and slow noise, quantisation, time stamps that jitter, a small constant latency, lost packets, occlusions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.recording.recording import Channel


@dataclass(frozen=True)
class Instrument:
    """One kind of instrument; stds are those of each component."""

    rate: float
    """Readings a second [Hz]."""
    white: float
    """Standard deviation of the white noise [unit of the channel]."""
    slow: float = 0.0
    """Standard deviation of the slow noise [unit of the channel]."""
    memory: float = 0.3
    """Correlation time of the slow noise [s]."""
    step: float = 0.0
    """Quantisation step [unit of the channel]; none for an orientation."""
    latency: float = 0.0
    """Time by which stamps are later than the instant of reading [s], constant."""
    jitter: float = 0.0
    """Standard deviation of the stamps' error [s]."""
    lost: float = 0.0
    """Share of single readings that are lost; they leave no row [-]."""
    occlusions: float = 0.0
    """Mean number of occlusions a second [1/s]; their readings are NaN."""
    occluded: tuple[float, float] = (0.03, 0.1)
    """Shortest and longest duration of an occlusion [s]."""

    @property
    def std(self) -> float:
        """Standard deviation of the noise, quantisation included [unit of the channel]."""
        return float(np.sqrt(self.white**2 + self.slow**2 + self.step**2 / 12))

    def read(self, time: np.ndarray, value: np.ndarray, rng: np.random.Generator) -> Channel:
        """Return the readings of a signal.

        Args:
            time: Times [s], shape (K,), from before 0 or from 0 on; the recording has stamps within 0..time[-1].
            value: Values, shape (K, dim); of dimension 4, unit quaternions wxyz.
            rng: Source of clock and noise.
        """
        stamp = np.arange(rng.uniform(0, 1 / self.rate), float(time[-1]), 1 / self.rate)
        at = stamp - self.latency - np.clip(rng.normal(0, self.jitter, len(stamp)), -0.4 / self.rate, 0.4 / self.rate)
        seen = np.stack([np.interp(at, time, column) for column in value.T], axis=1)
        if value.shape[1] == 4:
            turned = Rotation.from_rotvec(self._noise(stamp, 3, rng))
            truth = Rotation.from_quat(seen, scalar_first=True)
            seen = (truth * turned).as_quat(scalar_first=True)
        else:
            seen = seen + self._noise(stamp, value.shape[1], rng)
            if self.step:
                seen = self.step * np.round(seen / self.step)
        for start in np.flatnonzero(rng.uniform(size=len(stamp)) < self.occlusions / self.rate):
            end = stamp[start] + rng.uniform(*self.occluded)
            if start > 2:  # the tracker has seen the body before the recording begins
                seen[(stamp >= stamp[start]) & (stamp < end)] = np.nan
        kept = rng.uniform(size=len(stamp)) >= self.lost
        kept[:3] = True
        return Channel(stamp[kept], seen[kept], noise_std=self.std)

    def _noise(self, time: np.ndarray, dim: int, rng: np.random.Generator) -> np.ndarray:
        """Return noise at times (T,) [s], shape (T, dim)."""
        white = rng.normal(0, self.white, (len(time), dim))
        kick = rng.normal(0, 1, (len(time), dim))
        keep = np.exp(-np.diff(time, prepend=time[:1]) / self.memory)
        slow = np.empty((len(time), dim))
        state = kick[0] if len(time) else np.zeros(dim)
        for t in range(len(time)):
            state = keep[t] * state + np.sqrt(1 - keep[t] ** 2) * kick[t]
            slow[t] = state
        return white + self.slow * slow


@dataclass(frozen=True)
class Instruments:
    """Instruments by measured quantity."""

    angle: Instrument = Instrument(200.0, 7e-4, 1e-4, step=2 * np.pi / 4096, jitter=1e-4, lost=0.01)
    """12-bit encoder of a small servo [rad]."""
    fine_angle: Instrument = Instrument(200.0, 5e-4, 1e-4, step=2 * np.pi / 16384, jitter=1e-4, lost=0.01)
    """14-bit encoder of an arm's joint [rad]."""
    travel: Instrument = Instrument(200.0, 8e-5, 1.5e-5, step=1e-4, jitter=1e-4, lost=0.01)
    """Encoder of a slide [m]."""
    position: Instrument = Instrument(100.0, 3e-4, 5e-5, jitter=5e-5, occlusions=0.15)
    """Tracked position [m]."""
    orientation: Instrument = Instrument(100.0, 3e-3, 5e-4, jitter=5e-5, occlusions=0.15)
    """Tracked orientation [rad], by component of the rotation vector, body frame."""

    @staticmethod
    def of(seed: int, *, video: bool = False) -> Instruments:
        """Return instruments with latencies drawn by a seed: 0.05-0.2 ms of encoders, 0.2-0.5 ms of the tracker.

        Args:
            seed: The seed.
            video: Whether poses are tracked in a large volume, as throws are: with three times the noise.
        """
        rng = np.random.default_rng([seed, 77])
        encoder, tracker = rng.uniform(5e-5, 2e-4), rng.uniform(2e-4, 5e-4)
        plain, noisier = Instruments(), 3.0 if video else 1.0

        def tracked(i: Instrument) -> Instrument:
            return replace(i, latency=tracker, white=noisier * i.white, slow=noisier * i.slow)

        return Instruments(
            replace(plain.angle, latency=encoder),
            replace(plain.fine_angle, latency=encoder),
            replace(plain.travel, latency=encoder),
            tracked(plain.position),
            tracked(plain.orientation),
        )
