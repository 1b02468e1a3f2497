"""Initial states of a chain of stages: displaced objects, and the demonstration deformed to fit them.

Object 1 is displaced by a planar rigid motion A, object 2 by another, B. A demonstrated state is displaced accordingly:
before the grasp, the hand by a share of A that grows from 0 at the start to 1 at object 1; during transport, hand and
object 1 by an interpolation from A to B; from the first contact of the objects, all by B. Relative poses are thus kept
wherever there is contact, as in cases 1, 2 and 3 of the paper's appendix D. Each state is displaced individually
besides, as in the training of one stage.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from concent_warp.train.reset_cfg import ResetCfg
from concent_warp.train.resets.reset_states import ResetCandidate, ResetSampler, move_body, vertical_rotation
from concent_warp.train.task.task import Task


@dataclass(frozen=True)
class PlanarMotion:
    """A rotation about a vertical axis and a translation."""

    pivot: np.ndarray
    """Point on the axis of rotation [m], shape (3,)."""
    shift: np.ndarray
    """Translation [m], shape (3,)."""
    turn: float
    """Rotation about the vertical [rad]."""

    def displacement_of(self, point: np.ndarray) -> np.ndarray:
        """Return the displacement of a point [m], shape (3,)."""
        return self.pivot + vertical_rotation(self.turn) @ (point - self.pivot) + self.shift - point


class ChainedResetSampler(ResetSampler):
    """Samples states of all stages of a chain, and initial states of the whole chain."""

    def __init__(self, task: Task, cfg: ResetCfg, seed: int, device: str) -> None:
        """Prepare models, addresses and demonstrated poses."""
        super().__init__(task, cfg, seed, device)
        assert task.demonstrated is not None
        self.stages = task.demonstrated
        self.grasp, self.touch = self.contact_times()
        self.key_positions = [self.positions(time) for time in (0.0, self.grasp, self.touch)]
        self.paths = {stage: self.path(self.stages.start[stage], self.stages.end[stage]) for stage in task.chained}
        self.owed: list[tuple[int, bool]] = []

    def contact_times(self) -> tuple[float, float]:
        """Return the times of the grasp of object 1 and of its first contact with object 2 [s].

        The end of the demonstration if they do not occur.
        """
        contacts, end = self.task.events.body_contacts, self.task.events.duration
        names = [self.m.body(body).name for body in self.task.objects]
        grasped = [c.start for c in contacts if c.a in self.robot_bodies and c.b == names[0]]
        touched = [c.start for c in contacts if len(names) > 1 and {c.a, c.b} == set(names[:2])]
        first = min(grasped, default=end)
        return first, min((t for t in touched if t > first), default=end)

    def positions(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions of tool and object 1 at a demonstrated time [m], shape (3,) each."""
        self.d.qpos[:] = self.task.replay.qpos[self.task.replay.row(time)]
        mujoco.mj_kinematics(self.m, self.d)
        return self.d.site_xpos[self.task.robot.tool].copy(), self.d.xpos[self.task.objects[0]].copy()

    def path(self, start: float, end: float) -> tuple[np.ndarray, np.ndarray]:
        """Return demonstrated times [s] and the length of the hand's path up to each [m], shape (T,) each."""
        times = np.append(np.arange(start, end, self.task.replay.timestep), end)
        places = np.array([self.positions(time)[0] for time in times])
        return times, np.append(0.0, np.linalg.norm(np.diff(places, axis=0), axis=1).cumsum())

    def candidate(self) -> ResetCandidate:
        """Sample a moment of a stage, or an initial state of the chain, and poses of the objects."""
        begins = bool(self.rng.random() < self.cfg.free) and self.task.first == 0
        stage = self.task.first if begins else int(self.rng.choice(self.task.chained))
        if self.owed:
            stage, begins = self.owed.pop()
        along_path, as_demonstrated = self.rng.random(2) < (self.cfg.along_path, self.cfg.demonstrated)
        time = 0.0 if begins else self.moment(stage, along_path=bool(along_path))
        # In a hole, for example, almost every displaced state overlaps.
        together = bool(along_path) and time >= self.touch
        candidate = self.demonstrated(time, bool(as_demonstrated) or together, stage)
        candidate.begins, candidate.hand_free = begins, candidate.case == 1
        self.deform(candidate, self.displace_objects(candidate))
        # Elsewhere relative poses differ from the demonstration, so overlaps must be checked.
        candidate.as_demonstrated = candidate.as_demonstrated and candidate.case > 1 and time >= self.touch
        return candidate

    def moment(self, stage: int, *, along_path: bool) -> float:
        """Sample a moment of a stage, uniform along the hand's path or in time [s]."""
        times, lengths = self.paths[stage]
        if along_path and lengths[-1] > 0:
            return float(np.interp(self.rng.uniform(0, lengths[-1]), lengths, times))
        return float(self.rng.uniform(times[0], times[-1]))

    def discard(self, candidate: ResetCandidate, reason: str) -> None:
        """Count a candidate that is discarded; another one of its stage is sampled in its place."""
        super().discard(candidate, reason)
        self.owed.append((candidate.stage, candidate.begins))

    def displace_objects(self, candidate: ResetCandidate) -> tuple[PlanarMotion, PlanarMotion]:
        """Displace object 2, and return the motions of objects 1 and 2."""
        motions = []
        for k in (0, 1):
            aside = self.rng.uniform(-self.cfg.place[k], self.cfg.place[k], 2)
            shift, turn = np.array([*aside, 0.0]), self.rng.uniform(-self.cfg.heading[k], self.cfg.heading[k])
            motions.append(PlanarMotion(self.key_positions[0][1], shift, turn))
        if len(self.task.objects) < 2:
            return motions[0], motions[0]
        free, mocap = self.free[1], self.mocap[1]
        if free is None and mocap is None:
            return motions[0], PlanarMotion(np.zeros(3), np.zeros(3), 0.0)
        poses, address = (candidate.mocap.ravel(), 7 * mocap) if mocap is not None else (candidate.qpos, free)
        assert address is not None
        second = PlanarMotion(poses[address : address + 3].copy(), motions[1].shift, motions[1].turn)
        move_body(poses, address, second.pivot, (second.shift, second.turn))
        return motions[0], second

    def deform(self, candidate: ResetCandidate, motions: tuple[PlanarMotion, PlanarMotion]) -> None:
        """Displace hand and object 1 according to the motions of the objects."""
        first, second = motions
        tool, grasped = self.positions(candidate.time)
        pivot, turn_matrix = tool, self.d.site_xmat[self.task.robot.tool].reshape(3, 3).copy()
        address, factor = self.free[0], 1.0
        if candidate.case == 1:
            share = self.progress(tool, 0, at=0)
            moved = PlanarMotion(first.pivot, share * first.shift, share * first.turn)
            if address is not None:
                move_body(candidate.qpos, address, first.pivot, (first.shift, first.turn))
            if candidate.begins:
                return
            factor += self.cfg.approach * (1 - share)
            self.scatter_joints(candidate, 1 - share)
        else:
            share = self.progress(grasped, 1, at=1) if candidate.case == 2 and candidate.time < self.touch else 1.0
            shift = (1 - share) * first.displacement_of(grasped) + share * second.displacement_of(grasped)
            moved = PlanarMotion(grasped, shift, (1 - share) * first.turn + share * second.turn)
        own, own_turn = (np.zeros(3), 0.0) if candidate.as_demonstrated else self.displacement(lift=True)
        shift, turn = moved.displacement_of(pivot) + factor * own, moved.turn + own_turn
        candidate.position, candidate.rotation = pivot + shift, vertical_rotation(turn) @ turn_matrix
        if candidate.case > 1 and address is not None:
            move_body(candidate.qpos, address, pivot, (shift, turn))

    def progress(self, point: np.ndarray, body: int, at: int) -> float:
        """Return the share of the path from key position `at` to the next that a point has covered, 0..1."""
        start, end = self.key_positions[at][body], self.key_positions[at + 1][body]
        whole = float(np.linalg.norm(end - start))
        return float(np.clip(1 - np.linalg.norm(end - point) / whole, 0, 1)) if whole > 1e-6 else 1.0

    def scatter_joints(self, candidate: ResetCandidate, share: float) -> None:
        """Displace the initial posture of inverse kinematics, so that redundant arms take various postures."""
        robot, reach = self.task.robot, share * self.cfg.joints
        candidate.qpos[robot.qpos] += self.rng.uniform(-reach, reach, len(robot.qpos))
