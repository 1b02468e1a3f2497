"""State of robot and objects as a controller knows it: encoder readings, and poses from a tracker.

Frames of the tracker arrive late, with errors and gaps. The estimate of an object is an exponential average of its
tracked poses, carried along with the hand while the stage grasps the object: a pose that the tracker measured in the
past counts relative to where the hand was then.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
import torch

from concent_warp.errors import TrainError
from concent_warp.train.environment.physics import Physics
from concent_warp.train.environment.quaternions import (
    invert_quaternion,
    multiply_quaternions,
    rotate_vectors,
    rotation_from_vector,
)
from concent_warp.train.observation_cfg import ObservationCfg, SensorErrorsCfg
from concent_warp.train.task.movable_fixtures import mocap_id
from concent_warp.train.task.task import Task

Pose = tuple[torch.Tensor, torch.Tensor]
"""Positions (..., 3) [m] and unit quaternions (..., 4)."""
FrameWatch = Callable[[torch.Tensor, torch.Tensor, Pose], None]
"""Called with the times of frames since the episodes began [s], shape (N,), whether each shows an object, shape (N, O)
bool, and the tracked poses, world frame."""
SINGLE = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
FIRST_FRAMES = 15
"""Frames of a fixed object that the tracker has seen before an episode begins."""


class StateEstimate:
    """Estimated states of N worlds; its operations can be captured in CUDA graphs."""

    def __init__(
        self, task: Task, physics: Physics, cfg: ObservationCfg, sensors: SensorErrorsCfg, control_step: float
    ) -> None:
        """Allocate the buffers.

        Args:
            task: The task.
            physics: The true worlds.
            cfg: How tracked poses are averaged.
            sensors: Errors of the instruments.
            control_step: Time between updates [s].
        """
        m, n, device = task.compiled, physics.worlds, physics.device
        self._physics, self._sensors, self._dt = physics, sensors, control_step
        self.kinematics = physics.kinematics()
        """Forward kinematics of the estimated positions."""
        k = self.kinematics
        self.qpos, self.position, self.quaternion, self.site = k.qpos, k.position, k.quaternion, k.site
        self.qvel = torch.zeros(n, m.nv, device=device)
        """Velocities of the arm's joints as differences of their readings, shape (N, nv); of others 0."""

        def index(values: Any) -> torch.Tensor:
            return torch.as_tensor(np.asarray(values), dtype=torch.long, device=device)

        single = np.isin(m.jnt_type, SINGLE)
        self._joints = index(m.jnt_qposadr[single])
        self._arm, self._dof = index(task.robot.qpos), index(task.robot.dof)
        self._objects, self._tool = index(list(task.objects)), int(m.site_bodyid[task.robot.tool])
        self._placed = [_address(m, body) for body in task.objects]
        objects = len(task.objects)
        fixed = torch.as_tensor([mocap is not None for _, mocap in self._placed], device=device)
        self._fixed = fixed
        period = 1 / sensors.rate
        self._gain = 1 - math.exp(-period / cfg.smoothing) if cfg.smoothing > 0 else 1.0
        self._frames = max(1, math.ceil(control_step * sensors.rate))
        oldest = (sensors.latency[1] + 1 + self._frames) * period
        rows = math.ceil(oldest / control_step) + 2
        self._past = torch.zeros(rows, n, objects, 3, device=device), torch.zeros(rows, n, objects, 4, device=device)
        self._past_hand = torch.zeros(rows, n, 1, 3, device=device), torch.zeros(rows, n, 1, 4, device=device)
        self._pose = torch.zeros(n, objects, 3, device=device), torch.zeros(n, objects, 4, device=device)
        self._constant = torch.zeros(n, objects, 6, device=device)
        self._seen = torch.zeros(n, objects, device=device)
        self._read = torch.zeros(n, len(self._arm), device=device)
        self._clock, self._newest = torch.zeros(n, device=device), torch.zeros(n, device=device)
        self._latency, self._phase = torch.zeros(n, device=device), torch.zeros(n, device=device)
        self._bias = _bias(sensors, [m.body(body).name for body in task.objects]).to(device)
        self.watch: FrameWatch | None = None
        """Called with each frame of the tracker as it comes; only where steps are not captured in graphs."""
        self._deviation = torch.tensor([sensors.position_std] * 3 + [sensors.orientation_std] * 3, device=device)

    @property
    def ctrl(self) -> torch.Tensor:
        """The commands, shape (N, nu), which the controller knows."""
        return self._physics.ctrl

    @property
    def memory(self) -> dict[str, torch.Tensor]:
        """State by name, for checkpoints."""
        parts = {
            "past position": self._past[0], "past orientation": self._past[1], "past hand": self._past_hand[0],
            "past turn": self._past_hand[1], "position": self._pose[0], "orientation": self._pose[1],
            "constant": self._constant, "seen": self._seen, "read": self._read, "clock": self._clock,
            "newest": self._newest, "latency": self._latency, "phase": self._phase, "qpos": self.qpos,
            "qvel": self.qvel, "mocap position": self.kinematics.mocap[0],
            "mocap orientation": self.kinematics.mocap[1],
        }  # fmt: skip
        return {f"estimated {name}": value for name, value in parts.items()}

    def read_encoders(self, started: torch.Tensor) -> None:
        """Read the joints; in the worlds of a mask (N,) bool an episode starts."""
        errors = self._sensors
        angle = self._physics.qpos[:, self._joints].float()
        angle = angle + errors.encoder_std * torch.randn_like(angle)
        if errors.encoder_step:
            angle = torch.round(angle / errors.encoder_step) * errors.encoder_step
        self.qpos[:, self._joints] = angle.to(self.qpos.dtype)
        arm = self.qpos[:, self._arm].float()
        before = torch.where(started[:, None], arm, self._read)
        self.qvel[:, self._dof] = (arm - before) / self._dt
        self._read.copy_(arm)

    def track_objects(self, started: torch.Tensor, grasped: torch.Tensor) -> None:
        """Update the objects' poses; the kinematics are those of the present readings.

        Args:
            started: Whether an episode starts, shape (N,) bool.
            grasped: Whether the stage holds an object in the hand, shape (N, O) bool.
        """
        p = self._physics
        tool = slice(self._tool, self._tool + 1)
        self._remember(self._past, (p.position[:, self._objects], p.quaternion[:, self._objects]), started)
        self._remember(self._past_hand, (self.position[:, tool], self.quaternion[:, tool]), started)
        self._clock.copy_(torch.where(started, 0.0, self._clock + 1))
        now = self._past_hand[0][0], self._past_hand[1][0]
        before = self._past_hand[0][1], self._past_hand[1][1]
        pose = _carried(self._pose, before, now, grasped)
        newest = torch.floor((self._clock * self._dt - self._latency - self._phase) * self._sensors.rate)
        for back in reversed(range(self._frames)):
            frame = newest - back
            fresh = (frame > self._newest) & ~started
            age = self._clock * self._dt - self._phase - frame / self._sensors.rate
            found = fresh[:, None] & (torch.rand_like(self._seen) >= self._sensors.dropout)
            tracked = self._measured(age)
            if self.watch is not None:
                self.watch(self._clock * self._dt - age, found, tracked)
            measured = _carried(tracked, _at(self._past_hand, age / self._dt), now, grasped)
            self._seen += found
            gain = torch.where(self._fixed, 1 / self._seen.clamp(min=1.0), self._gain) * found
            pose = _mixed(pose, measured, gain)
        self._newest.copy_(torch.maximum(newest, self._newest))
        self._begin(started)
        settled = math.sqrt(self._gain / (2 - self._gain))
        white = torch.where(self._fixed, FIRST_FRAMES**-0.5, settled)[:, None]
        first = self._with_errors((self._past[0][0], self._past[1][0]), white)
        for kept, begun, updated in zip(self._pose, first, pose, strict=True):
            kept.copy_(torch.where(started[:, None, None], begun, updated))
        self._write()

    def _remember(self, past: Pose, present: Pose, started: torch.Tensor) -> None:
        """Shift the past by one update and put the present first; where an episode starts, it has always been so."""
        for kept, value in zip(past, present, strict=True):
            kept[1:] = torch.where(started[:, None, None], value.float(), kept[:-1])
            kept[0] = value.float()

    def _begin(self, started: torch.Tensor) -> None:
        """Sample what is constant in an episode, where one starts."""
        errors, n = self._sensors, len(started)
        constant = self._bias + math.sqrt(errors.constant_share) * self._deviation * torch.randn_like(self._constant)
        self._constant.copy_(torch.where(started[:, None, None], constant, self._constant))
        low, high = errors.latency
        chances = torch.rand(2, n, device=started.device)
        self._latency.copy_(torch.where(started, (low + (high - low) * chances[0]) / errors.rate, self._latency))
        self._phase.copy_(torch.where(started, chances[1] / errors.rate, self._phase))
        newest = torch.floor((-self._latency - self._phase) * errors.rate)
        self._newest.copy_(torch.where(started, newest, self._newest))
        self._seen.copy_(torch.where(started[:, None], float(FIRST_FRAMES), self._seen))

    def _measured(self, age: torch.Tensor) -> Pose:
        """Return tracked poses of the objects of so long ago [s], shape (N,)."""
        return self._with_errors(_at(self._past, age / self._dt), torch.ones_like(self._seen)[0][:, None])

    def _with_errors(self, pose: Pose, white: torch.Tensor) -> Pose:
        """Return poses with the tracker's errors; `white` scales the part that differs between frames, shape (O, 1)."""
        spread = math.sqrt(1 - self._sensors.constant_share) * self._deviation
        error = self._constant + white * spread * torch.randn_like(self._constant)
        return pose[0] + error[..., :3], multiply_quaternions(rotation_from_vector(error[..., 3:]), pose[1])

    def _write(self) -> None:
        """Write the objects' poses to the estimated positions."""
        mocap = self.kinematics.mocap
        for i, (address, fixture) in enumerate(self._placed):
            place, turn = self._pose[0][:, i], self._pose[1][:, i]
            if address is not None:
                self.qpos[:, address : address + 3] = place.to(self.qpos.dtype)
                self.qpos[:, address + 3 : address + 7] = turn.to(self.qpos.dtype)
            elif fixture is not None:
                mocap[0][:, fixture] = place.to(mocap[0].dtype)
                mocap[1][:, fixture] = turn.to(mocap[1].dtype)


def check_biased(sensors: SensorErrorsCfg, objects: Sequence[str]) -> None:
    """Check that the objects whose poses have an error are known.

    Raises:
        TrainError: The settings name an object that the task lacks.
    """
    if unknown := sorted(set(sensors.biased) - set(objects)):
        known = f"some of {list(objects)}"
        raise TrainError("the poses of an unknown object are biased", expected=known, found=unknown)


def _bias(sensors: SensorErrorsCfg, objects: list[str]) -> torch.Tensor:
    """Return the bias of each object's poses: position [m], rotation vector [rad], shape (O, 6).

    Raises:
        TrainError: The settings name an object that the task lacks.
    """
    check_biased(sensors, objects)
    bias = torch.tensor([*sensors.position_bias, *sensors.orientation_bias])
    return torch.stack([bias * (not sensors.biased or name in sensors.biased) for name in objects])


def _address(m: mujoco.MjModel, body: int) -> tuple[int | None, int | None]:
    """Return the address of a free body in qpos, or the index of a fixed one among the mocap bodies; else None."""
    joint = int(m.body_jntadr[body])
    if joint >= 0 and m.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
        return int(m.jnt_qposadr[joint]), None
    return None, mocap_id(m, body)


def _at(past: Pose, ago: torch.Tensor) -> Pose:
    """Return the poses of so many updates ago, shape (N,), between those that are known."""
    ago = ago.clamp(0.0, len(past[0]) - 1.001)
    row = ago.floor().long()
    share = (ago - row)[:, None, None]
    world = torch.arange(len(ago), device=ago.device)
    later, earlier = (tuple(kept[r, world] for kept in past) for r in (row, row + 1))
    return _mixed((later[0], later[1]), (earlier[0], earlier[1]), share[..., 0])


def _mixed(a: Pose, b: Pose, share: torch.Tensor) -> Pose:
    """Return poses between a and b, at a share of the way, shape (N, O) or (N, 1)."""
    share = share[..., None]
    aligned = torch.where((a[1] * b[1]).sum(-1, keepdim=True) < 0, -b[1], b[1])
    turn = a[1] + share * (aligned - a[1])
    return a[0] + share * (b[0] - a[0]), turn / torch.linalg.vector_norm(turn, dim=-1, keepdim=True).clamp(min=1e-9)


def _carried(pose: Pose, before: Pose, now: Pose, grasped: torch.Tensor) -> Pose:
    """Return poses (N, O) moved as the hand moved from `before` to `now`, (N, 1) each, where it grasps the object."""
    back = invert_quaternion(before[1])
    turn = multiply_quaternions(now[1], back).expand_as(pose[1])
    place = now[0] + rotate_vectors(turn, pose[0] - before[0])
    held = grasped[..., None]
    return torch.where(held, place, pose[0]), torch.where(held, multiply_quaternions(turn, pose[1]), pose[1])
