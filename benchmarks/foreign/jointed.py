"""Machines with joints: how their logs are made from equations of motion, true values, hidden causes and sensors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np

from benchmarks.foreign.integrate import Derivative, Held, integrate
from benchmarks.foreign.log import Case, Kind, Log, Recorded, Table

TOLERANCE = (0.003, 0.02)
"""Share by which a true value differs from the nominal one: least and most."""
LENGTH_TOLERANCE = (0.003, 0.006)
"""The same of lengths, which a laboratory measures best."""
LOOSE_TOLERANCE = (0.003, 0.04)
"""The same of friction and damping, which it knows worst."""


class Motion(NamedTuple):
    """What is commanded in one motion."""

    duration: float
    """How long is recorded [s]."""
    commands: Mapping[str, Held]
    """Commands by name of the actuator."""
    initial: np.ndarray | None = None
    """State from which the machine is released, where it does not start from rest."""


@dataclass(frozen=True)
class Sensor:
    """An instrument."""

    name: str
    columns: tuple[str, ...]
    rate: float
    """Readings a second [Hz]."""
    noise: float
    """Standard deviation of the white noise of a component."""
    read: Callable[[np.ndarray, Any], np.ndarray]
    """True readings, shape (times, components), by states of shape (times, states) and the true values."""
    quantum: float = 0.0
    """Step of the readings."""

    @property
    def spread(self) -> float:
        """Standard deviation of noise and rounding together."""
        return float(np.hypot(self.noise, self.quantum / np.sqrt(12)))


@dataclass(frozen=True)
class Hidden:
    """How a machine and its instruments differ from the model, beyond tolerances."""

    factors: Mapping[str, float] = field(default_factory=dict)
    """Factors of true values, by their names."""
    added: Mapping[str, float] = field(default_factory=dict)
    """What is added to true values, by their names."""
    delay: Mapping[str, float] = field(default_factory=dict)
    """By actuator, how much later commands act [s]."""
    lag: Mapping[str, float] = field(default_factory=dict)
    """By actuator, time constant of the first-order lag of what acts [s]."""
    latency: Mapping[str, float] = field(default_factory=dict)
    """By sensor, how long before its stamp a reading is taken [s]."""
    clock: Mapping[str, float] = field(default_factory=dict)
    """By sensor, share by which its clock is fast."""
    gain: Mapping[str, float] = field(default_factory=dict)
    """By sensor, factor of the readings."""
    bias: Mapping[str, float | tuple[float, ...]] = field(default_factory=dict)
    """By sensor, what is added to the readings."""

    def apply(self, true: Any) -> Any:
        """Return true values with the hidden ones among them."""
        true = true._replace(**{name: factor * getattr(true, name) for name, factor in self.factors.items()})
        return true._replace(**{name: more + getattr(true, name) for name, more in self.added.items()})


@dataclass(frozen=True)
class Habits:
    """How a laboratory records."""

    stated: bool = False
    """Whether it states the noise."""
    lost: float = 0.0
    """Share of readings that are lost."""
    jitter: float = 0.0
    """Largest error of a time stamp [s]."""


@dataclass(frozen=True)
class Machine:
    """A machine, by its model, its equations of motion and its instruments."""

    name: str
    model: str
    """MJCF of the laboratory."""
    nominal: Any
    """A named tuple of the values in the model, and of values that are hidden causes, which are 0 or 1 in it."""
    lengths: tuple[str, ...]
    """Values of the nominal ones that are known best."""
    loose: tuple[str, ...]
    """Values of the nominal ones that are known worst."""
    exact: tuple[str, ...]
    """Values that are what they are: gains that a controller computes, hidden causes, constants of nature."""
    derivative: Derivative
    rest: Callable[[Any, np.ndarray], np.ndarray]
    """State from which the machine settles, by true values and first commands."""
    actuators: tuple[str, ...]
    sensors: tuple[Sensor, ...]
    motions: Callable[[np.random.Generator], Sequence[Motion]]
    settle: float = 2.0
    """How long it stands with its first commands before the recording [s]."""

    def true_values(self, rng: np.random.Generator) -> Any:
        """Return values of one exemplar of the machine."""
        off = {}
        for name in self.nominal._fields:
            least, most = TOLERANCE
            if name in self.lengths:
                least, most = LENGTH_TOLERANCE
            if name in self.loose:
                least, most = LOOSE_TOLERANCE
            factor = 1 + rng.choice([-1, 1]) * rng.uniform(least, most)
            if name not in self.exact:
                off[name] = factor * getattr(self.nominal, name)
        return self.nominal._replace(**off)

    def readings(
        self,
        motion: Motion,
        true: Any,
        hidden: Hidden,
        stamps: Mapping[str, np.ndarray],
    ) -> dict[str, np.ndarray]:
        """Return readings without noise, by sensor, each of shape (times, components).

        Args:
            motion: What is commanded.
            true: True values, the hidden ones among them.
            hidden: Hidden causes; those of drives' timing and of instruments are applied here.
            stamps: Times at which readings are due, by sensor [s].
        """
        seen = {s.name: stamps[s.name] / (1 + hidden.clock.get(s.name, 0.0)) for s in self.sensors}
        seen = {name: t - hidden.latency.get(name, 0.0) for name, t in seen.items()}
        settle = self.settle if motion.initial is None else 0.0
        seen = {name: np.maximum(t, -0.5 * settle) for name, t in seen.items()}
        times = np.unique(np.concatenate(list(seen.values())))
        commands = []
        for name in self.actuators:
            held = motion.commands[name]
            commands.append(Held(held.time + hidden.delay.get(name, 0.0), held.value))
        first = np.array([c.value[0] for c in commands])
        initial = self.rest(true, first) if motion.initial is None else motion.initial
        lags = [hidden.lag.get(name, 0.0) for name in self.actuators]
        states = integrate(self.derivative, true, initial, commands, lags, times, settle)
        found = {}
        for s in self.sensors:
            clean = s.read(states[np.searchsorted(times, seen[s.name])], true)
            found[s.name] = clean * hidden.gain.get(s.name, 1.0) + np.asarray(hidden.bias.get(s.name, 0.0))
        return found

    def stamps(self, duration: float) -> dict[str, np.ndarray]:
        """Return the times of all readings of a motion, by sensor [s]."""
        return {s.name: np.arange(round(duration * s.rate)) / s.rate for s in self.sensors}

    def log(self, cause: str, hidden: Hidden, habits: Habits) -> Log:
        """Return the log of one exemplar with one cause."""
        rng = np.random.default_rng(crc32(f"{self.name}-{cause}".encode()))
        true = hidden.apply(self.true_values(rng))
        recorded = []
        for motion in self.motions(rng):
            stamps = self.stamps(motion.duration)
            taken = {name: t + rng.uniform(0, habits.jitter, len(t)) for name, t in stamps.items()}
            clean = self.readings(motion, true, hidden, taken)
            measured = {}
            for s in self.sensors:
                noisy = clean[s.name] + rng.normal(0, s.noise, clean[s.name].shape)
                if s.quantum:
                    noisy = s.quantum * np.round(noisy / s.quantum) + 0.0
                noisy[rng.random(len(noisy)) < habits.lost] = np.nan
                measured[s.name] = Table(stamps[s.name], dict(zip(s.columns, noisy.T, strict=True)))
            actions = {name: Table(c.time, {"command": c.value}) for name, c in motion.commands.items()}
            recorded.append(Recorded(measured, actions))
        noise = {s.name: s.spread for s in self.sensors} if habits.stated else {}
        return Log(self.model.strip() + "\n", recorded, noise)

    def case(
        self,
        cause: str,
        kind: Kind,
        accepted: tuple[tuple[str, ...], ...] = (),
        hidden: Hidden | None = None,
        habits: Habits | None = None,
    ) -> Case:
        """Return a case of this machine."""
        acts, how = hidden or Hidden(), habits or Habits()
        return Case(self.name, cause, kind, accepted, lambda: self.log(cause, acts, how))


def clock(duration: float, rate: float) -> np.ndarray:
    """Return the times of commands [s]."""
    return np.arange(round(duration * rate)) / rate


def sines(t: np.ndarray, *parts: tuple[float, float, float]) -> np.ndarray:
    """Return a sum of sines of amplitude, frequency [Hz] and phase [rad], which fades in over half a second."""
    fade = np.clip(t / 0.5, 0, 1) ** 2 * (3 - 2 * np.clip(t / 0.5, 0, 1))
    return fade * sum(a * np.sin(2 * np.pi * f * t + phase) for a, f, phase in parts)


def chirp(t: np.ndarray, amplitude: float, low: float, high: float) -> np.ndarray:
    """Return a sine whose frequency [Hz] rises linearly from low to high."""
    return amplitude * np.sin(2 * np.pi * (low + 0.5 * (high - low) * t / t[-1]) * t)


def reach(t: np.ndarray, points: Sequence[tuple[float, float]], lasts: float) -> np.ndarray:
    """Return a path of minimum jerk to each value, which it leaves for at a time [s] and reaches `lasts` [s] later."""
    path = np.full(len(t), float(points[0][1]))
    for (_, old), (at, new) in pairwise(points):
        s = np.clip((t - at) / lasts, 0, 1)
        path += (new - old) * (10 * s**3 - 15 * s**4 + 6 * s**5)
    return path


def steps(t: np.ndarray, points: Sequence[tuple[float, float]]) -> np.ndarray:
    """Return a command that jumps to each value at a time [s]; the first is held from the beginning."""
    path = np.full(len(t), float(points[0][1]))
    for at, new in points[1:]:
        path[t >= at] = new
    return path
