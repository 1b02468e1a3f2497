"""Hidden effects of the worlds on other engines that the library lacks. Nothing here imports an engine."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks.independent.data_set import Truth
from benchmarks.independent.foreign.hidden import Hidden
from benchmarks.independent.foreign.rig import BodyState, ForeignRig, Friction, JointForce, Physics

POLES = 11
"""Periods of cogging in a turn of a joint."""
POLE_PITCH = 0.025
"""Period of cogging of a linear motor [m]."""
PLACE = np.array([0.02, 0.01])
"""Place on the table of the magnet, and of the sticky spot [m]."""
REACH = 0.06
"""How far magnet and sticky spot reach [m]."""


def cogging(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Add a torque with two harmonics of the motor's poles [N m or N]."""
    pitch = POLES if rig.hinges else 2 * np.pi / POLE_PITCH

    def of(weight: float) -> JointForce:
        def force(time: float, position: float, speed: float) -> float:
            del time, speed
            return magnitude * weight * (np.sin(pitch * position) + 0.4 * np.cos(2 * pitch * position))

        return force

    _on_joints(rig, physics, of)
    return _outside("cogging", rig)


def warming(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Add Coulomb friction [N m or N] that falls to a third within 2.5 s, as grease gets warm."""
    for d in rig.drives:
        friction = physics.friction.setdefault(d.joint, Friction(0.0))
        cold, warm = friction.coulomb + magnitude * d.weight, friction.coulomb
        friction.coulomb = cold

        def scale(time: float, cold: float = cold, warm: float = warm) -> float:
            return (warm + (cold - warm) * float(np.exp(-max(time, 0.0) / 2.5))) / cold

        friction.scale = scale
    return _outside("warming", rig)


def cable(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Add the torque of a cable that stiffens as it is bent [N m/rad^3 or N/m^3], about a position off zero."""
    middle = 0.4 if rig.hinges else 0.03

    def of(weight: float) -> JointForce:
        def force(time: float, position: float, speed: float) -> float:
            del time, speed
            return -magnitude * weight * (position - middle) ** 3

        return force

    _on_joints(rig, physics, of)
    return _outside("cable", rig)


def faltering(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Add a torque [N m or N] in single pulses of 0.25 s at four times, as of a failing amplifier."""

    def of(weight: float) -> JointForce:
        def force(time: float, position: float, speed: float) -> float:
            del position, speed
            pulses = ((1.1, 1.0), (2.9, -1.0), (4.2, 1.0), (5.6, -1.0))
            return sum(sign * magnitude * weight for start, sign in pulses if start <= time < start + 0.25)

        return force

    _on_joints(rig, physics, of)
    return _outside("faltering", rig)


def magnet(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Add the pull of a magnet under the table [N], horizontal, largest at `REACH`."""

    def force(time: float, state: BodyState) -> tuple[np.ndarray, np.ndarray]:
        del time
        way = np.append(PLACE - state.center[:2], 0.0) / REACH
        pull = magnitude * way * np.exp(0.5 - 0.5 * float(way @ way))
        return pull, np.zeros(3)

    physics.body_forces.append(force)
    return _outside("magnet", rig)


def sticky_spot(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Add viscous drag [N s/m] within `REACH` of a place on the table."""

    def force(time: float, state: BodyState) -> tuple[np.ndarray, np.ndarray]:
        del time
        near = np.linalg.norm(PLACE - state.center[:2]) < REACH
        return -magnitude * near * state.velocity * np.array([1.0, 1.0, 0.0]), np.zeros(3)

    physics.body_forces.append(force)
    return _outside("sticky_spot", rig)


def gust(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Add a sideways force [N] that comes and goes at 2 Hz."""

    def force(time: float, state: BodyState) -> tuple[np.ndarray, np.ndarray]:
        del state
        return magnitude * np.sin(4 * np.pi * time) * np.array([0.8, 0.6, 0.0]), np.zeros(3)

    physics.body_forces.append(force)
    return _outside("gust", rig)


def slosh(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Let a share of the body's mass [-] swing in it on springs, about a place off its centre."""
    physics.slosh = magnitude
    return _outside("slosh", rig)


def _on_joints(rig: ForeignRig, physics: Physics, of: Callable[[float], JointForce]) -> None:
    """Add a force on each driven joint, given the drive's weight."""
    for d in rig.drives:
        physics.joint_forces.setdefault(d.joint, []).append(of(d.weight))


def _outside(name: str, rig: ForeignRig) -> Truth:
    target = (rig.body,) if rig.free and not rig.drives else tuple(d.joint for d in rig.drives)
    return Truth(name, {}, target, known=False)


OUTSIDE: dict[str, Hidden] = {
    f.__name__: f for f in (cogging, warming, cable, faltering, magnet, sticky_spot, gust, slosh)
}
"""Effects that the library lacks, by name."""
