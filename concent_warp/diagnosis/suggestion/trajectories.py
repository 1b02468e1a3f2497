"""Parametrised motions for the search: Fourier series of joint setpoints, recorded commands at another speed with
offsets, and throws, pushes and drops of objects. Parameters are unbounded; what they stand for is within the limits of
position and speed by construction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np

from concent_warp.comparison.units import channel_text
from concent_warp.diagnosis.experiment.joint_motions import Drives, commanded_motion
from concent_warp.diagnosis.experiment.motions import ProposedMotion, RecordedRange
from concent_warp.diagnosis.experiment.object_motions import UP, ThrowableBody
from concent_warp.diagnosis.experiment.payloads import loaded, on_link, on_object, payload_links, payload_text
from concent_warp.diagnosis.suggestion.candidate import Candidate
from concent_warp.diagnosis.suggestion.cfg import SuggestCfg
from concent_warp.effects.select import gripper_actuators
from concent_warp.recording.recording import Channel
from concent_warp.scene.payloads import Payload
from concent_warp.simulate.select import EngineName

Source = Literal["optimised", "random"]


class Family(Protocol):
    """Motions by parameters."""

    @property
    def name(self) -> str:
        """Of the kind of motion."""
        ...

    @property
    def size(self) -> int:
        """Number of parameters."""
        ...

    @property
    def starts(self) -> bool:
        """Whether initial states have to be estimated in the search already: bodies move, or are met, unobserved."""
        ...

    @property
    def carriers(self) -> tuple[tuple[Payload, ...], ...]:
        """What may be fastened to a link or an object, each set of weights for itself."""
        ...

    def candidate(self, parameters: np.ndarray, source: Source) -> Candidate:
        """Return the motion of parameters, shape (size,), which are about 1 in size."""
        ...


def families(recorded: RecordedRange, cfg: SuggestCfg, engine: EngineName) -> list[Family]:
    """Return the kinds of motion that a scene allows."""
    found: list[Family] = []
    drives = Drives.of(recorded) if recorded.m.nu else None
    if drives is not None and not recorded.bodies:
        found.append(FourierFamily(recorded, drives, cfg))
    if drives is not None and recorded.bodies:
        found += [RepeatFamily(recorded, drives, cfg), FourierFamily(recorded, drives, cfg)]
    if not recorded.longest.action:
        found += [
            ThrowFamily(ThrowableBody(recorded, body, engine), cfg)
            for body in recorded.bodies[: recorded.cfg.max_bodies]
        ]
    return found


@dataclass(frozen=True)
class LoadedFamily:
    """Motions of another kind with weights on a body."""

    family: Family
    payloads: tuple[Payload, ...]
    carriers: tuple[tuple[Payload, ...], ...] = ()

    @property
    def name(self) -> str:
        """Of the kind of motion."""
        return f"{self.family.name} with {payload_text(self.payloads)}"

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.family.size

    @property
    def starts(self) -> bool:
        """See `Family.starts`."""
        return self.family.starts

    def candidate(self, parameters: np.ndarray, source: Source) -> Candidate:
        """Return the motion of parameters."""
        plain = self.family.candidate(parameters, source)
        motions = tuple(loaded(motion, self.payloads) for motion in plain.motions)
        text = f"with {payload_text(self.payloads)}, {plain.text}"
        return replace(plain, name=f"{plain.name} with payload", text=text, motions=motions)


def loaded_families(family: Family) -> list[LoadedFamily]:
    """Return a kind of motion with each of the weights that its bodies may carry."""
    return [LoadedFamily(family, payloads) for payloads in family.carriers]


def _on_links(recorded: RecordedRange, drives: Drives) -> tuple[tuple[Payload, ...], ...]:
    """Return weights on each last link that drives move."""
    return tuple(on_link(recorded, link) for link in payload_links(recorded, drives.ids))


def _squashed(value: float | np.ndarray) -> np.ndarray:
    """Return numbers from 0 to 1 for unbounded ones; 0.5 for 0."""
    return 0.5 * (1 + np.tanh(np.asarray(value)))


def _between(low: float, high: float, value: float) -> float:
    """Return a number between two, in proportion to logarithms."""
    return float(low * (high / low) ** _squashed(value))


def _series(coefficients: np.ndarray, frequency: float, time: np.ndarray) -> np.ndarray:
    """Return a Fourier series of unit height, shape (T,); higher harmonics are weaker, as in integrals of series.

    Args:
        coefficients: Of sines and cosines, shape (2, N).
        frequency: Base frequency [Hz].
        time: Times [s], shape (T,).
    """
    order = np.arange(1, coefficients.shape[1] + 1)
    phase = 2 * np.pi * frequency * order * time[:, None]
    value = (np.sin(phase) * coefficients[0] / order + np.cos(phase) * coefficients[1] / order).sum(axis=1)
    return value / max(float(np.abs(value).max()), 1e-9)


def _fade(time: np.ndarray, blend: float) -> np.ndarray:
    """Return a factor that rises from 0 to 1 and falls to 0 at the end along minimum-jerk profiles, shape (T,)."""
    edge = np.clip(np.minimum(time, time[-1] - time) / blend, 0.0, 1.0)
    return edge**3 * (10 - 15 * edge + 6 * edge**2)


@dataclass(frozen=True)
class FourierFamily:
    """All drives follow Fourier series about a pose, from and to rest, with objects out of the way."""

    recorded: RecordedRange
    drives: Drives
    cfg: SuggestCfg
    name: str = "Fourier series"
    starts: bool = False

    @property
    def size(self) -> int:
        """Number of parameters: frequency, and of each drive height, middle and coefficients."""
        return 1 + len(self.drives.ids) * (2 + 2 * self.cfg.trajectory.harmonics)

    @property
    def carriers(self) -> tuple[tuple[Payload, ...], ...]:
        """See `Family.carriers`."""
        return _on_links(self.recorded, self.drives)

    def candidate(self, parameters: np.ndarray, source: Source) -> Candidate:
        """Return the motion of parameters."""
        recorded, drives, shape = self.recorded, self.drives, self.cfg.trajectory
        frequency = _between(*shape.frequencies, parameters[0])
        time = np.arange(int(self.cfg.duration * recorded.cfg.rate)) / recorded.cfg.rate
        fade, columns = _fade(time, shape.blend_time), []
        for d, row in enumerate(parameters[1:].reshape(len(drives.ids), -1)):
            half, first = self.cfg.limits.reach * drives.half[d], drives.first[d]
            height = half * float(0.1 + 0.9 * _squashed(row[0]))
            middle = drives.middle[d] + (half - height) * float(np.tanh(row[1]))
            series = _series(row[2:].reshape(2, -1), frequency, time)
            away = fade * (middle + height * series - first)
            fastest = np.abs(np.diff(away)).max() * recorded.cfg.rate
            columns.append(first + away * min(1.0, self.cfg.limits.speed * drives.speed[d] / max(fastest, 1e-9)))
        who = channel_text(recorded.m.actuator(drives.ids[0]).name) if len(drives.ids) == 1 else "all drives together"
        cleared = [channel_text(recorded.m.body(b).name) for b in recorded.bodies]
        away = f", with {' and '.join(cleared)} out of the way" if cleared else ""
        text = f"move {who} along Fourier series of {frequency:.2g} Hz and {shape.harmonics - 1} harmonics{away}"
        motion = commanded_motion(recorded, drives, self.name, text, np.stack(columns, axis=1))
        return Candidate(self.name, text, (motion,), source)


@dataclass(frozen=True)
class RepeatFamily:
    """The longest recorded demonstration at another speed, with offsets of its commands and another grip."""

    recorded: RecordedRange
    drives: Drives
    cfg: SuggestCfg
    name: str = "varied repetition"
    starts: bool = True

    @property
    def size(self) -> int:
        """Number of parameters: speed, frequency, grip, and of each drive height and coefficients."""
        return 3 + len(self.drives.ids) * (1 + 2 * self.cfg.trajectory.harmonics)

    @property
    def carriers(self) -> tuple[tuple[Payload, ...], ...]:
        """See `Family.carriers`."""
        objects = self.recorded.bodies[: self.recorded.cfg.max_bodies]
        return (*_on_links(self.recorded, self.drives), *(on_object(self.recorded, b) for b in objects))

    def candidate(self, parameters: np.ndarray, source: Source) -> Candidate:
        """Return the motion of parameters."""
        recorded, drives, shape, d = self.recorded, self.drives, self.cfg.trajectory, self.recorded.longest
        slow, fast = shape.time_scales
        fast = max(min(fast, self.cfg.limits.speed), slow)
        scale = _between(slow, fast, parameters[0]) if fast > slow else slow
        frequency = _between(*shape.frequencies, parameters[1])
        hands = {recorded.m.actuator(a).name for a in gripper_actuators(recorded.m)}
        lightest = recorded.cfg.lighter_grip
        grip = float(lightest + (1 - lightest) * _squashed(parameters[2]))
        duration = min(d.duration / scale, self.cfg.duration)
        time = np.arange(max(int(duration * recorded.cfg.rate), 2)) / recorded.cfg.rate
        fade, action = _fade(time, shape.blend_time), {}
        for name, channel in d.action.items():
            held = np.searchsorted(channel.time, time * scale + 1e-9, side="right") - 1
            value = channel.value[np.maximum(held, 0)].ravel()
            if name in hands and recorded.bodies:
                value = value[0] + grip * (value - value[0])
            action[name] = value
        for k, row in enumerate(parameters[3:].reshape(len(drives.ids), -1)):
            name = recorded.m.actuator(drives.ids[k]).name
            height = 2 * shape.offset * drives.half[k] * float(np.tanh(row[0]))
            moved = action[name] + height * fade * _series(row[1:].reshape(2, -1), frequency, time)
            half = self.cfg.limits.reach * drives.half[k]
            action[name] = np.clip(moved, drives.middle[k] - half, drives.middle[k] + half)
        qpos, qvel = recorded.starts[recorded.recording.demonstrations.index(d)]
        text = f"repeat the commands of {d.name} at {scale:.2f} times the speed, with smooth offsets"
        if hands and recorded.bodies:
            text += f", and grip with {100 * grip:.0f} % of the commanded closing"
        sent = {name: Channel(time, value) for name, value in action.items()}
        return Candidate(self.name, text, (ProposedMotion(self.name, text, float(time[-1]), qpos, qvel, sent),), source)


@dataclass(frozen=True)
class ThrowFamily:
    """An object is pushed, spun, dropped or thrown by hand, a few times."""

    thrown: ThrowableBody
    cfg: SuggestCfg
    name: str = "throws"
    starts: bool = True
    each: int = 8

    @property
    def size(self) -> int:
        """Number of parameters: of each throw speed, heading (2), rise, height, tilt (2) and spin."""
        return self.each * self.cfg.trajectory.throws

    @property
    def carriers(self) -> tuple[tuple[Payload, ...], ...]:
        """See `Family.carriers`."""
        return (on_object(self.thrown.recorded, self.thrown.body),)

    def candidate(self, parameters: np.ndarray, source: Source) -> Candidate:
        """Return the motions of parameters."""
        motions = tuple(self._throw(row) for row in parameters.reshape(-1, self.each))
        return Candidate(self.name, "; then ".join(motion.text for motion in motions), motions, source)

    def _throw(self, row: np.ndarray) -> ProposedMotion:
        """Return one throw."""
        thrown, shape = self.thrown, self.cfg.trajectory
        what, rest = channel_text(thrown.name), thrown.rest
        start = thrown.recorded.starts[0][0] if rest is None else rest
        heights = [qpos[thrown.at + 2] - start[thrown.at + 2] for qpos, _ in thrown.recorded.starts]
        highest = max([shape.height, *heights] if rest is not None else [0.0])
        # Half of the parameters leave an object where it rests.
        height = highest * max(float(np.tanh(row[4])), 0.0)
        speed = self.cfg.limits.speed * thrown.speed * float(_squashed(row[0]))
        heading = float(np.arctan2(row[2], row[1]))
        turn = np.array([*(shape.tilt * np.tanh(row[5:7]) * (height > 0)), np.pi * np.tanh(row[3])])
        spin = shape.spin * float(np.tanh(row[7]))
        pose = thrown.pose(start, height * UP, turn)
        direction = np.array([np.cos(heading), np.sin(heading), 0.0])
        text = f"push {what} off" if height == 0 else f"throw {what} from {height:.2f} m above where it rests"
        text += f" at {speed:.2g} m/s, {np.degrees(heading):.0f} deg from +x, turned by {np.degrees(turn[2]):.0f} deg"
        text += f" and spinning at {spin:.1f} rad/s"
        return thrown.motion(
            self.name, text, thrown.recorded.cfg.max_object_duration, pose, speed * direction, spin * UP
        )
