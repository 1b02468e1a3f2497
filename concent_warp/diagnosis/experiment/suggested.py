"""A suggested experiment: the motion as arrays over time, and how well it distinguishes the hypotheses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from concent_warp.scene.payloads import Payload


@dataclass(frozen=True)
class TimeSeries:
    """Values over time."""

    time: np.ndarray
    """[s], shape (T,)."""
    value: np.ndarray
    """In `unit`, shape (T,) or (T, dim)."""
    unit: str
    """SI unit; "-" for none."""

    def to_json(self) -> dict[str, Any]:
        """Return the series in plain types."""
        return {"time": self.time.tolist(), "value": self.value.tolist(), "unit": self.unit}


@dataclass(frozen=True)
class ObjectMotion:
    """Motion of an object, T samples, in the world frame."""

    time: np.ndarray
    """[s], shape (T,)."""
    position: np.ndarray
    """Of the body's origin [m], shape (T, 3)."""
    orientation: np.ndarray
    """Unit quaternions w, x, y, z, shape (T, 4)."""
    velocity: np.ndarray
    """Of the body's origin [m/s], shape (T, 3)."""
    angular_velocity: np.ndarray
    """[rad/s], shape (T, 3)."""

    def to_json(self) -> dict[str, Any]:
        """Return the motion in plain types."""
        units = {"time": "s", "position": "m", "orientation": "-", "velocity": "m/s", "angular_velocity": "rad/s"}
        return {**{name: value.tolist() for name, value in vars(self).items()}, "units": units}


@dataclass(frozen=True)
class SuggestedMotion:
    """What to do: commands to the actuators, and the motion that the likeliest hypothesis predicts.

    An object that is pushed, thrown or dropped by hand starts with the first row of its motion.
    """

    duration: float
    """[s]."""
    commands: Mapping[str, TimeSeries]
    """Commands by actuator, each valid from its time on."""
    joints: Mapping[str, TimeSeries]
    """Positions of hinge and slide joints by name."""
    objects: Mapping[str, ObjectMotion]
    """Motions of free bodies by name, without those in `away`."""
    away: tuple[str, ...] = ()
    """Objects that are moved out of the way before."""
    payloads: tuple[Payload, ...] = ()
    """Known weights that bodies carry."""

    def to_json(self) -> dict[str, Any]:
        """Return the motion in plain types."""
        series = {
            key: {name: item.to_json() for name, item in getattr(self, key).items()}
            for key in ("commands", "joints", "objects")
        }
        carried = [asdict(payload) for payload in self.payloads]
        return {"duration": self.duration, "away": list(self.away), "payloads": carried, **series}


@dataclass(frozen=True)
class SuggestedExperiment:
    """A motion that distinguishes hypotheses.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> model = cw.Model.from_recording(recording)
        >>> models = {
        ...     "joint_damping": model.add(cw.effect_class("joint_damping")("hinge"), [0.015]),
        ...     "joint_friction": model.add(cw.effect_class("joint_friction")("hinge"), [0.03]),
        ... }
        >>> experiment = cw.suggest_experiment(models, recording)
        >>> experiment.pair, sorted(experiment.predictions)
        (('joint_damping', 'joint_friction'), ['joint_damping', 'joint_friction'])
    """

    name: str
    """Kind of motion."""
    sentence: str
    """What to do, and how far the hypotheses then differ."""
    separation: float
    """RMS difference of the predictions of `pair` over the noise, in the channel where it is largest [-]."""
    pair: tuple[str, str]
    """The two hypotheses that it distinguishes best."""
    channel: str
    """Channel in which these differ most."""
    separations: Mapping[tuple[str, str], float]
    """The same as `separation` for every pair."""
    motion: SuggestedMotion
    """The motion itself."""
    predictions: Mapping[str, TimeSeries]
    """Predicted readings of `channel` by hypothesis."""

    def summary(self) -> dict[str, Any]:
        """Return the experiment in plain types, without arrays."""
        return {
            "name": self.name,
            "sentence": self.sentence,
            "separation": self.separation,
            "pair": list(self.pair),
            "channel": self.channel,
            "separations": [{"pair": list(pair), "separation": value} for pair, value in self.separations.items()],
            "duration": self.motion.duration,
        }

    def to_json(self) -> dict[str, Any]:
        """Return the experiment in plain types, SI units."""
        predictions = {name: series.to_json() for name, series in self.predictions.items()}
        return {**self.summary(), "motion": self.motion.to_json(), "predictions": predictions}
