"""The states of a scene over a demonstration of which only a part was measured.

Joints and free bodies are estimated from their own readings by local polynomials, positions of a body component by
component, and of joints of which the velocity alone was read, that; joints without a sensor follow from tendons,
equalities and poses of the bodies on them, as far as these determine them. What was not measured stands as the
recording's initial state or the model's reference pose has it, at rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.estimation.ball_signals import ball_signals
from concent_warp.estimation.joint_signals import (
    MIN_SINGULAR,
    CoupledJoints,
    determined_joints,
    joint_rates,
    joint_signals,
)
from concent_warp.estimation.local_polynomial import LocalPolynomialCfg
from concent_warp.estimation.object_tracks import frame_channel
from concent_warp.estimation.signals import worst_scatter
from concent_warp.recording.recording import Channel
from concent_warp.simulate.replay import initial_state

if TYPE_CHECKING:
    from concent_warp.estimation.signals import MeasuredJoint, OrientationSignal, Signal
    from concent_warp.recording.recording import Demonstration


@dataclass(frozen=True)
class PartialState:
    """A state, and which part of it was measured."""

    qpos: np.ndarray
    """Shape (nq,) [m, rad]; quaternions wxyz of unit length."""
    qvel: np.ndarray
    """Shape (nv,) [m/s, rad/s]; 0 where it was not measured."""
    measured: np.ndarray
    """Of which degrees of freedom positions were measured, shape (nv,) bool."""


@dataclass(frozen=True)
class _Component:
    """A measured coordinate of a free body's position."""

    qpos: int
    dof: int
    signal: Signal


@dataclass(frozen=True)
class _Turning:
    """What turns about all axes: a ball joint or a free body."""

    qpos: int
    """Address of its quaternion in qpos."""
    dof: int
    """Address of its angular velocity in qvel."""
    signal: OrientationSignal


@dataclass(frozen=True)
class PartialStateEstimator:
    """States of a scene over one demonstration, as far as they were measured."""

    compiled: mujoco.MjModel
    demonstration: Demonstration
    cfg: LocalPolynomialCfg
    joints: tuple[MeasuredJoint, ...]
    """Hinges and slides whose position a sensor measured."""
    coupled: CoupledJoints
    """All hinges and slides, with those that follow from the others."""
    others: np.ndarray
    """Which of these are told by others only, indices."""
    rates: dict[int, Signal]
    """Velocities of joints of which a sensor measured the velocity alone, by their degrees of freedom."""
    components: tuple[_Component, ...]
    turning: tuple[_Turning, ...]

    @staticmethod
    def of(
        m: mujoco.MjModel, demonstration: Demonstration, cfg: LocalPolynomialCfg | None = None
    ) -> PartialStateEstimator:
        """Return the estimator of a demonstration.

        Args:
            m: The compiled scene.
            demonstration: What was measured.
            cfg: How readings are smoothed.
        """
        cfg = cfg or LocalPolynomialCfg()
        joints = joint_signals(m, demonstration, cfg)
        coupled, loose = determined_joints(m, demonstration, cfg, joints, MIN_SINGULAR)
        own = np.isin(coupled.dof, [joint.dof for joint in joints])
        rates = {int(m.jnt_dofadr[j]): rate for j, rate in joint_rates(m, demonstration, cfg).items()}
        components: list[_Component] = []
        turning = [_Turning(ball.qpos, ball.dof, ball.orientation) for ball in ball_signals(m, demonstration, cfg)]
        for joint in np.flatnonzero(m.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)):
            body = m.body(int(m.jnt_bodyid[joint])).name
            place, dof = int(m.jnt_qposadr[joint]), int(m.jnt_dofadr[joint])
            position = frame_channel(m, demonstration, body, mujoco.mjtSensor.mjSENS_FRAMEPOS)
            for k in range(3):
                signal = None if position is None else cfg.signal(Channel(position.time, position.value[:, [k]]))
                if signal is not None:
                    components.append(_Component(place + k, dof + k, signal))
            turned = frame_channel(m, demonstration, body, mujoco.mjtSensor.mjSENS_FRAMEQUAT)
            if turned is not None and (orientation := cfg.orientation(turned)) is not None:
                turning.append(_Turning(place + 3, dof + 3, orientation))
        others = np.flatnonzero(~loose & ~own)
        return PartialStateEstimator(
            m, demonstration, cfg, joints, coupled, others, rates, tuple(components), tuple(turning)
        )

    @cached_property
    def measured(self) -> np.ndarray:
        """Of which degrees of freedom positions were measured, shape (nv,) bool."""
        found = np.zeros(self.compiled.nv, dtype=bool)
        found[[joint.dof for joint in self.joints]] = True
        found[self.coupled.dof[self.others]] = True
        found[[part.dof for part in self.components]] = True
        for one in self.turning:
            found[one.dof : one.dof + 3] = True
        return found

    @cached_property
    def signals(self) -> list[Signal | OrientationSignal]:
        """What states are estimated from."""
        joints = self.coupled.readings if len(self.others) else [joint.position for joint in self.joints]
        return [*joints, *(part.signal for part in self.components), *(one.signal for one in self.turning)]

    def state(self, time: float) -> PartialState:
        """Return the state at a time [s]."""
        qpos, qvel = self.states(np.array([time]))
        return PartialState(qpos[0], qvel[0], self.measured)

    def states(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the states at `time` (T,) [s], shapes (T, nq) and (T, nv)."""
        first, begun = initial_state(self.compiled, self.demonstration)
        qpos, qvel = np.tile(first, (len(time), 1)), np.tile(begun, (len(time), 1))
        for joint in self.joints:
            found = joint.position.estimate(time)
            qpos[:, joint.qpos], qvel[:, joint.dof] = found.value[:, 0], found.rate[:, 0]
        if len(self.others):
            found = self.coupled.estimate(time)
            qpos[:, self.coupled.qpos[self.others]] = found.value[:, self.others]
            qvel[:, self.coupled.dof[self.others]] = found.rate[:, self.others]
        stated = self.demonstration.qvel is not None
        for dof, rate in self.rates.items():
            read = rate.estimate(time).value[:, 0]
            qvel[:, dof] = np.where(time > 0.0, read, qvel[:, dof]) if stated else read
        for part in self.components:
            found = part.signal.estimate(time)
            qpos[:, part.qpos], qvel[:, part.dof] = found.value[:, 0], found.rate[:, 0]
        for one in self.turning:
            seen = one.signal.estimate(time)
            qpos[:, one.qpos : one.qpos + 4], qvel[:, one.dof : one.dof + 3] = seen.quaternion, seen.velocity
        return qpos, qvel

    def scatter_of_both_sides(self, time: np.ndarray) -> np.ndarray:
        """Return the scatter of the readings on both sides of each of `time` (T,), see `worst_scatter`, shape (T,)."""
        return worst_scatter([s.scatter_of_both_sides(time) for s in self.signals])


def partial_state(m: mujoco.MjModel, demonstration: Demonstration, time: float) -> PartialState:
    """Return the state of a demonstration at one time [s], as far as it was measured."""
    return PartialStateEstimator.of(m, demonstration).state(time)
