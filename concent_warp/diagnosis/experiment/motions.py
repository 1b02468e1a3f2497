"""Motions that could be recorded next: initial state, commands, payloads, and changes of the surroundings.

Speeds, commands and positions stay within the range of the present recording. Motions of drives are in `joint_motions`,
those of objects in `object_motions`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.diagnosis.experiment.cfg import MotionMenuCfg
from concent_warp.effects.select import POSES, free_bodies
from concent_warp.errors import RecordingError
from concent_warp.fit.effects.observation import ObservedRecording
from concent_warp.fit.effects.observation_cfg import ObservationCfg
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.payloads import Payload
from concent_warp.simulate.replay import commands, initial_state

if TYPE_CHECKING:
    from concent_warp.model import Model

Change = Callable[["Model"], "Model"]
"""A change of the surroundings: takes the model of the present one, returns that of the changed one."""


def _unchanged(model: Model) -> Model:
    """Return the model itself, see `Change`."""
    return model


@dataclass(frozen=True)
class ProposedMotion:
    """A motion that could be recorded."""

    name: str
    """Kind of motion."""
    text: str
    """What to do."""
    duration: float
    """Length [s]."""
    qpos: np.ndarray
    """Initial positions [m, rad], shape (nq,)."""
    qvel: np.ndarray
    """Initial velocities [m/s, rad/s], shape (nv,)."""
    action: Mapping[str, Channel] = field(default_factory=dict)
    """Commands by actuator."""
    away: tuple[str, ...] = ()
    """Bodies that are moved out of the way and not measured."""
    change: Change = _unchanged
    """Change of the surroundings."""
    payloads: tuple[Payload, ...] = ()
    """Known weights that bodies carry."""


def changes_set_up(motion: ProposedMotion) -> bool:
    """Return whether the surroundings have to be changed for a motion: the table turned."""
    return motion.change is not _unchanged


@dataclass(frozen=True)
class RecordedRange:
    """Range of states, commands and sampling intervals in the present recording."""

    model: Model
    recording: Recording
    noise: Mapping[str, float]
    """Standard deviation of a component of each channel."""
    cfg: MotionMenuCfg = field(default_factory=MotionMenuCfg)
    """Settings of the motions."""
    observation: ObservationCfg = field(default_factory=ObservationCfg)
    """Noise of readings and uncertainty of initial states."""

    @cached_property
    def m(self) -> mujoco.MjModel:
        """The compiled scene."""
        return self.model.compile()

    @cached_property
    def source(self) -> ObservedRecording:
        """The recording as the model reads it."""
        return ObservedRecording(self.model, self.recording, self.noise, self.observation)

    @cached_property
    def starts(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """State at the start of each demonstration."""
        return [self.state(d, 0.0) for d in self.recording.demonstrations]

    @cached_property
    def states(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """States at `cfg.instants` instants of all demonstrations, and at their starts."""
        found = list(self.starts)
        for d in self.recording.demonstrations:
            if (measured := self.source.measured(d)) is not None:
                states = measured.states(np.linspace(0, d.duration, self.cfg.instants + 2)[1:-1])
                found += list(zip(states.qpos, states.qvel, strict=True))
        return found

    def state(self, d: Demonstration, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the measured state of a demonstration; its initial one where it was not measured."""
        try:
            found = self.source.state(d, time)
            return found.qpos, found.qvel
        except RecordingError:
            return initial_state(self.m, d)

    @cached_property
    def period(self) -> dict[str, float]:
        """Time between samples of each channel [s]."""
        found = {}
        for name in self.noise:
            steps = [
                np.diff(d.measured[name].time) for d in self.recording.demonstrations if len(_channel(d, name).time) > 1
            ]
            found[name] = float(np.median(np.concatenate(steps))) if steps else 0.01
        return found

    @cached_property
    def bodies(self) -> list[int]:
        """Free bodies whose pose is measured."""
        poses = [c for c in self.noise if int(self.m.sensor_type[self.m.sensor(c).id]) in POSES]
        return [b for b in free_bodies(self.m) if b in {self.body_of(c) for c in poses}]

    def body_of(self, channel: str) -> int:
        """Return the body whose site or frame a channel measures, -1 for another kind of channel."""
        row = self.m.sensor(channel).id
        kind, target = int(self.m.sensor_objtype[row]), int(self.m.sensor_objid[row])
        if kind == int(mujoco.mjtObj.mjOBJ_SITE):
            return int(self.m.site_bodyid[target])
        return target if kind in (int(mujoco.mjtObj.mjOBJ_BODY), int(mujoco.mjtObj.mjOBJ_XBODY)) else -1

    def channels(self, away: Collection[str]) -> list[str]:
        """Return the channels that are measured while some bodies are away."""
        gone = {self.m.body(name).id for name in away}
        return [c for c in self.noise if self.body_of(c) not in gone]

    @cached_property
    def longest(self) -> Demonstration:
        """The demonstration that lasts longest."""
        return max(self.recording.demonstrations, key=lambda d: d.duration)

    def holding(self, d: Demonstration) -> dict[str, Channel]:
        """Return constant commands, the first ones of a demonstration."""
        first = commands(self.m, d, 1)[0]
        return {self.m.actuator(i).name: Channel(np.zeros(1), first[i : i + 1]) for i in range(self.m.nu)}


def _channel(d: Demonstration, channel: str) -> Channel:
    """Return a channel of a demonstration, empty where it has none."""
    return d.measured.get(channel, Channel(np.zeros(0), np.zeros((0, 1))))


def slope_turned(model: Model) -> Model:
    """Return the model with the table's slope reversed, see `Change`."""
    turned = tuple(
        replace(a, values=tuple(-v for v in a.values)) if a.effect.name == "gravity_tilt" else a for a in model.effects
    )
    return replace(model, effects=turned)
