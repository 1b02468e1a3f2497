"""Initial states of a chain of stages: objects anywhere, and the demonstration bent to lead from one to the other.

Object 1 is put elsewhere by a rigid motion A about the vertical, object 2 by another, B. A demonstrated moment becomes
one of the task with these places: until object 1 is grasped, the hand's pose is moved by a part of A that grows from
none at the start to all of it at the object; hand and object together are then moved by what leads from A to B on the
way; and all by B from their first contact on. So are relative poses kept where there is contact, as the paper's
appendix D wants it in its cases 1, 2 and 3. On top come displacements of each state by itself, as in the training of
one stage.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from concent_warp.train.cfg import ResetCfg
from concent_warp.train.resets.reset_states import ResetCandidate, ResetSampler, place, vertical_rotation
from concent_warp.train.task.task import Task

FARTHER = 3.0
"""By how much more the hand is displaced at the start of its way to object 1 than at its end, as a factor."""


@dataclass(frozen=True)
class PlanarMotion:
    """A rigid motion about the vertical."""

    pivot: np.ndarray
    """Point that is turned about and shifted [m], shape (3,)."""
    shift: np.ndarray
    """[m], shape (3,)."""
    turn: float
    """[rad]."""

    def of(self, point: np.ndarray) -> np.ndarray:
        """Return the shift of a point [m], shape (3,)."""
        return self.pivot + vertical_rotation(self.turn) @ (point - self.pivot) + self.shift - point


class ChainedResetSampler(ResetSampler):
    """Draws states of all stages of a chain, and starts of the whole."""

    def __init__(self, task: Task, cfg: ResetCfg, seed: int, device: str) -> None:
        """Prepare to draw."""
        super().__init__(task, cfg, seed, device)
        assert task.demonstrated is not None
        self.stages = task.demonstrated
        self.grasp, self.touch = self.moments()
        self.held_at = [self.poses(time) for time in (0.0, self.grasp, self.touch)]

    def moments(self) -> tuple[float, float]:
        """Return when the robot first holds object 1, and when object 1 first touches object 2 [s].

        The end of the demonstration where that does not happen.
        """
        contacts, end = self.task.events.body_contacts, self.task.events.duration
        names = [self.m.body(body).name for body in self.task.objects]
        grasped = [c.start for c in contacts if c.a in self.robot_bodies and c.b == names[0]]
        touched = [c.start for c in contacts if len(names) > 1 and {c.a, c.b} == set(names[:2])]
        first = min(grasped, default=end)
        return first, min((t for t in touched if t > first), default=end)

    def poses(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return where the tool and object 1 are at a demonstrated moment [m], shape (3,) each."""
        self.d.qpos[:] = self.task.replay.qpos[self.task.replay.row(time)]
        mujoco.mj_kinematics(self.m, self.d)
        return self.d.site_xpos[self.task.robot.tool].copy(), self.d.xpos[self.task.objects[0]].copy()

    def draft(self) -> ResetCandidate:
        """Draw a moment of some stage, or a start, and places of the objects."""
        begins = bool(self.rng.random() < self.cfg.free) and self.task.first == 0
        stage = self.task.first if begins else int(self.rng.choice(self.task.chained))
        time = 0.0 if begins else self.rng.uniform(self.stages.start[stage], self.stages.end[stage])
        draft = self.demonstrated(time, bool(self.rng.random() < self.cfg.demonstrated), stage)
        draft.begins, draft.apart = begins, draft.case == 1
        self.bend(draft, self.rearranged(draft))
        # Elsewhere than in contact it is not as demonstrated, so that overlaps have to be looked for.
        draft.kept = draft.kept and draft.case == 3
        return draft

    def rearranged(self, draft: ResetCandidate) -> tuple[PlanarMotion, PlanarMotion]:
        """Put object 2 elsewhere, and return what is done to objects 1 and 2."""
        motions = []
        for k in (0, 1):
            aside = self.rng.uniform(-self.cfg.place[k], self.cfg.place[k], 2)
            shift, turn = np.array([*aside, 0.0]), self.rng.uniform(-self.cfg.heading[k], self.cfg.heading[k])
            motions.append(PlanarMotion(self.held_at[0][1], shift, turn))
        if len(self.task.objects) < 2:
            return motions[0], motions[0]
        free, mocap = self.free[1], self.mocap[1]
        if free is None and mocap is None:
            return motions[0], PlanarMotion(np.zeros(3), np.zeros(3), 0.0)
        poses, address = (draft.mocap.ravel(), 7 * mocap) if mocap is not None else (draft.qpos, free)
        assert address is not None
        second = PlanarMotion(poses[address : address + 3].copy(), motions[1].shift, motions[1].turn)
        place(poses, address, second.pivot, (second.shift, second.turn))
        return motions[0], second

    def bend(self, draft: ResetCandidate, motions: tuple[PlanarMotion, PlanarMotion]) -> None:
        """Move hand and object 1 to where they are on the way between objects that stand elsewhere."""
        first, second = motions
        tool, held = self.poses(draft.time)
        pivot, turn_matrix = tool, self.d.site_xmat[self.task.robot.tool].reshape(3, 3).copy()
        address, farther = self.free[0], 1.0
        if draft.case == 1:
            share = self.progress(tool, 0, at=0)
            moved = PlanarMotion(first.pivot, share * first.shift, share * first.turn)
            if address is not None:
                place(draft.qpos, address, first.pivot, (first.shift, first.turn))
            if draft.begins:
                return
            farther += FARTHER * (1 - share)
            self.wander(draft, 1 - share)
        else:
            share = self.progress(held, 1, at=1) if draft.case == 2 and draft.time < self.touch else 1.0
            shift = (1 - share) * first.of(held) + share * second.of(held)
            moved = PlanarMotion(held, shift, (1 - share) * first.turn + share * second.turn)
        own, own_turn = (np.zeros(3), 0.0) if draft.kept else self.displacement(lift=True)
        shift, turn = moved.of(pivot) + farther * own, moved.turn + own_turn
        draft.position, draft.rotation = pivot + shift, vertical_rotation(turn) @ turn_matrix
        if draft.case > 1 and address is not None:
            place(draft.qpos, address, pivot, (shift, turn))

    def progress(self, point: np.ndarray, which: int, at: int) -> float:
        """Return how far a point is on its way from the demonstrated moment `at` to the one that follows, 0..1."""
        start, end = self.held_at[at][which], self.held_at[at + 1][which]
        whole = float(np.linalg.norm(end - start))
        return float(np.clip(1 - np.linalg.norm(end - point) / whole, 0, 1)) if whole > 1e-6 else 1.0

    def wander(self, draft: ResetCandidate, share: float) -> None:
        """Start the search for joint positions elsewhere, so that arms with joints to spare take other postures too."""
        robot, reach = self.task.robot, share * self.cfg.joints
        draft.qpos[robot.qpos] += self.rng.uniform(-reach, reach, len(robot.qpos))
