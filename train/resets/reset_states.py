"""How initial states are drawn: a demonstrated moment, a displacement that keeps the contact chain, and a trial."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from concent_warp.errors import TrainError
from concent_warp.simulate.inputs import compile_model
from concent_warp.train.cfg import ResetCfg
from concent_warp.train.resets.inverse_kinematics import reach
from concent_warp.train.resets.inverse_kinematics_batch import solve_inverse_kinematics_batch
from concent_warp.train.task.movable_fixtures import mocap_id
from concent_warp.train.task.task import Task

ROUNDS = 20
"""Rounds, of as many drafts as states are wanted, after which the search is given up."""


@dataclass(frozen=True)
class ResetStates:
    """M states at rest to start episodes from."""

    qpos: np.ndarray
    """Shape (M, nq)."""
    qvel: np.ndarray
    """Shape (M, nv)."""
    ctrl: np.ndarray
    """Commands that hold the state, shape (M, nu)."""
    mocap: np.ndarray
    """Poses of mocap bodies, position [m] and quaternion, shape (M, nmocap, 7)."""
    stage: np.ndarray
    """Stage that they belong to, shape (M,) int."""
    begins: np.ndarray
    """Whether all stages are still to come, the robot being where the demonstration begins, shape (M,) bool."""
    time: np.ndarray
    """Demonstrated moments that they came from [s], shape (M,)."""
    case: np.ndarray
    """Case of the paper's, 1..3, shape (M,) int."""
    discarded: dict[str, int]
    """How many were discarded, by reason."""


@dataclass
class ResetCandidate:
    """A state on its way."""

    time: float
    """Demonstrated moment [s]."""
    case: int
    kept: bool
    """Whether it stays as demonstrated."""
    qpos: np.ndarray
    """Positions so far, objects already where they are to be, shape (nq,)."""
    ctrl: np.ndarray
    """Commands, shape (nu,)."""
    stage: int
    """Stage that it belongs to."""
    mocap: np.ndarray
    """Poses of mocap bodies, shape (nmocap, 7)."""
    begins: bool = False
    """Whether it is a start of the whole chain."""
    apart: bool = False
    """Whether the hand must not touch an object."""
    position: np.ndarray | None = None
    """Where the tool is to be [m], shape (3,); None where the joints are decided already."""
    rotation: np.ndarray | None = None
    """The tool's orientation there, shape (3, 3)."""


class ResetSampler:
    """Draws states of one stage and tries them in C MuJoCo.

    Moments are drawn from shortly before the stage that precedes it to the stage's first contact; for states that are
    not displaced, to the middle of the target event's window, so that some have all but reached it. Where the stage
    begins with object 1 in the hand, so do all its states.
    """

    def __init__(self, task: Task, cfg: ResetCfg, seed: int, device: str) -> None:
        """Prepare to draw."""
        self.task, self.cfg, self.device = task, cfg, device
        self.newton = cfg.solver == "newton" or (cfg.solver == "auto" and device.startswith("cuda"))
        self.rng = np.random.default_rng([seed, 1])
        self.discarded: dict[str, int] = {"unreachable": 0, "overlapping": 0, "chain broken": 0}
        self.m = task.compiled
        self.d = mujoco.MjData(self.m)
        # Overlaps are judged with all spheres: those left out of the physics must not start within another object.
        self.full, sphere_geom = compile_model(task.model, None)
        self.full_data = mujoco.MjData(self.full)
        self.is_sphere = np.zeros(self.full.ngeom, dtype=bool)
        self.is_sphere[sphere_geom] = True
        self.free = [self.free_joint(body) for body in task.objects]
        self.mocap = [mocap_id(self.m, body) for body in task.objects]
        self.places = np.hstack([self.d.mocap_pos, self.d.mocap_quat])
        stage = task.events.stages[task.stage]
        self.keeps = task.keeps(task.stage)
        earlier = task.events.stages[task.stage - 1].start if task.stage else 0.0
        self.window = max(earlier - cfg.before, 0.0), stage.start, stage.event.time
        self.robot_bodies = {e.body for e in task.events.entities if e.role == "robot"}

    def free_joint(self, body: int) -> int | None:
        """Return where the position of a free body starts in qpos; None of a body that is not free."""
        joint = self.m.body_jntadr[body]
        free = joint >= 0 and self.m.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
        return int(self.m.jnt_qposadr[joint]) if free else None

    def states(self, count: int, progress: Callable[[float], None] | None) -> ResetStates:
        """Return `count` states."""
        found: list[tuple[np.ndarray, ResetCandidate]] = []
        for _ in range(ROUNDS):
            for draft in self.solved([self.draft() for _ in range(count)]):
                if (settled := self.tried(draft)) is not None:
                    found.append((settled, draft))
                    if progress is not None and len(found) % 32 == 0:
                        progress(len(found) / count)
                if len(found) == count:
                    return self.collected(found)
        raise TrainError(
            "too few initial states keep the contact chain",
            expected=count,
            found=f"{len(found)}, and discarded {self.discarded}",
            fix="displace them less, with --environment.reset.position and .turn",
        )

    def collected(self, found: list[tuple[np.ndarray, ResetCandidate]]) -> ResetStates:
        """Return settled states in one."""
        drafts = [draft for _, draft in found]
        return ResetStates(
            qpos=np.array([qpos for qpos, _ in found]),
            qvel=np.zeros((len(found), self.m.nv)),
            ctrl=np.array([draft.ctrl for draft in drafts]),
            mocap=np.array([draft.mocap for draft in drafts]),
            stage=np.array([draft.stage for draft in drafts]),
            begins=np.array([draft.begins for draft in drafts]),
            time=np.array([draft.time for draft in drafts]),
            case=np.array([draft.case for draft in drafts]),
            discarded=self.discarded,
        )

    def draft(self) -> ResetCandidate:
        """Draw a moment and a displacement."""
        start, onset, end = self.window
        kept = self.rng.random() < self.cfg.demonstrated
        time = self.rng.uniform(start, end if kept else onset)
        while self.keeps and self.case(time) == 1:
            time = self.rng.uniform(start, end if kept else onset)
        draft = self.demonstrated(time, kept, self.task.stage)
        if not kept and draft.case == 1:
            self.scatter(draft)
        elif not kept:
            self.displace(draft)
            self.turn_in_hand(draft)
        return draft

    def demonstrated(self, time: float, kept: bool, stage: int) -> ResetCandidate:
        """Return a demonstrated moment as it is."""
        row = self.task.replay.row(time)
        qpos, ctrl = self.task.replay.qpos[row].copy(), self.task.replay.ctrl[row].copy()
        return ResetCandidate(time, self.case(time), kept, qpos, ctrl, stage, self.places.copy())

    def solved(self, drafts: list[ResetCandidate]) -> Iterator[ResetCandidate]:
        """Give the drafts with their joints decided, those left out that the hand cannot reach."""
        robot = self.task.robot
        asked = [i for i, draft in enumerate(drafts) if draft.position is not None]
        if self.newton:
            angles, fine = solve_inverse_kinematics_batch(
                self.m,
                robot,
                np.array([drafts[i].qpos for i in asked]).reshape(-1, self.m.nq),
                np.array([drafts[i].position for i in asked]).reshape(-1, 3),
                np.array([drafts[i].rotation for i in asked]).reshape(-1, 3, 3),
                device=self.device,
            )
            answers = {i: angles[k] if fine[k] else None for k, i in enumerate(asked)}
        else:
            answers = {}
        for i, draft in enumerate(drafts):
            if draft.position is not None and draft.rotation is not None:
                if not self.newton:
                    self.d.qpos[:] = draft.qpos
                    answers[i] = reach(self.m, self.d, robot, draft.position, draft.rotation)
                joints = answers[i]
                if joints is None:
                    self.discarded["unreachable"] += 1
                    continue
                draft.qpos[robot.qpos] = joints
            yield draft

    def tried(self, draft: ResetCandidate) -> np.ndarray | None:
        """Return positions of a draft at rest, shape (nq,), None where it is discarded; sets its commands."""
        if not draft.kept and self.overlap(draft) > self.cfg.overlap:
            self.discarded["overlapping"] += 1
            return None
        # What the demonstrated commands lead the joints by is lag and pressing; at rest, they are where the joints are.
        robot = self.task.robot
        draft.ctrl[robot.actuator] = np.clip(draft.qpos[robot.qpos], *self.range_of(robot.actuator))
        settled = self.settle(draft)
        if settled is None:
            self.discarded["chain broken"] += 1
        return settled

    def range_of(self, actuators: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the limits of commands."""
        limited = self.m.actuator_ctrllimited[actuators].astype(bool)
        low, high = self.m.actuator_ctrlrange[actuators].T
        return np.where(limited, low, -np.inf), np.where(limited, high, np.inf)

    def case(self, time: float) -> int:
        """Return the case of a demonstrated moment."""
        names = [self.m.body(body).name for body in self.task.objects]
        holding = touching = False
        for contact in self.task.events.body_contacts:
            if contact.start <= time < contact.end:
                holding |= contact.a in self.robot_bodies and contact.b == names[0]
                touching |= len(names) > 1 and {contact.a, contact.b} == set(names[:2])
        return 1 + holding + (holding and touching)

    def scatter(self, draft: ResetCandidate) -> None:
        """Displace the robot's joints and every free object by themselves (case 1)."""
        robot, cfg, moved = self.task.robot, self.cfg, draft.qpos
        moved[robot.qpos] += self.rng.uniform(-cfg.joints, cfg.joints, len(robot.qpos))
        limited = self.m.jnt_limited[robot.joint].astype(bool)
        low, high = self.m.jnt_range[robot.joint].T
        moved[robot.qpos] = np.where(limited, np.clip(moved[robot.qpos], low, high), moved[robot.qpos])
        for address in self.free:
            if address is not None:
                place(moved, address, moved[address : address + 3], self.displacement(lift=False))

    def displace(self, draft: ResetCandidate) -> None:
        """Move hand and objects as one; where the hand is to be is left to inverse kinematics (cases 2 and 3)."""
        if self.free[0] is None:  # what is held hangs on a joint of its own, and cannot be moved along
            draft.kept = True
            return
        together = draft.case == 3 and self.free[1] is not None
        shift, turn = self.displacement(lift=not together)
        d, tool = self.d, self.task.robot.tool
        d.qpos[:] = draft.qpos
        mujoco.mj_kinematics(self.m, d)
        pivot = d.site_xpos[tool].copy()
        draft.position, draft.rotation = pivot + shift, vertical_rotation(turn) @ d.site_xmat[tool].reshape(3, 3)
        for address in self.free[: 1 + together]:
            assert address is not None
            place(draft.qpos, address, pivot, (shift, turn))

    def turn_in_hand(self, draft: ResetCandidate) -> None:
        """Turn object 1 in the hand about the axis along which it is held, as it turns where an edge of it catches."""
        address, table, stage = self.free[0], self.task.table, draft.stage
        held = self.task.held[stage] & (table.body_b[stage] == self.task.objects[0])
        if not self.cfg.held or address is None or not held.any():
            return
        axis = np.linalg.svd(table.normal[stage][held])[2][0]
        half = 0.5 * self.rng.uniform(-self.cfg.held, self.cfg.held)
        turned = np.zeros(4)
        mujoco.mju_mulQuat(
            turned, draft.qpos[address + 3 : address + 7], np.array([np.cos(half), *np.sin(half) * axis])
        )
        draft.qpos[address + 3 : address + 7] = turned

    def displacement(self, *, lift: bool) -> tuple[np.ndarray, float]:
        """Return a drawn shift [m], shape (3,), and a turn about the vertical [rad]."""
        cfg = self.cfg
        aside = self.rng.uniform(-cfg.position, cfg.position, 2)
        up = self.rng.uniform(0, cfg.lift) if lift else 0.0
        return np.array([*aside, up]), float(self.rng.uniform(-cfg.turn, cfg.turn))

    def overlap(self, draft: ResetCandidate) -> float:
        """Return the deepest penetration of a sphere in another object or the surroundings [m], 0 for none.

        The hand counts only where it is to be clear of the objects.
        """
        d = self.full_data
        d.qpos[:], d.qvel[:] = draft.qpos, 0
        d.mocap_pos[:], d.mocap_quat[:] = draft.mocap[:, :3], draft.mocap[:, 3:]
        mujoco.mj_fwdPosition(self.full, d)
        robot = self.task.robot
        hand = {int(self.full.site_bodyid[robot.tool])} | {self.full.body(n).id for n in self.robot_bodies}
        deepest = 0.0
        for contact in d.contact:
            bodies = {int(self.full.geom_bodyid[g]) for g in contact.geom}
            if self.is_sphere[contact.geom].any() and (draft.apart or not bodies & hand):
                deepest = max(deepest, -float(contact.dist))
        return deepest

    def settle(self, draft: ResetCandidate) -> np.ndarray | None:
        """Return positions after the settling time, None where the state fell apart."""
        m, d = self.m, self.d
        mujoco.mj_resetData(m, d)
        d.qpos[:], d.ctrl[:] = draft.qpos, draft.ctrl
        d.mocap_pos[:], d.mocap_quat[:] = draft.mocap[:, :3], draft.mocap[:, 3:]
        mujoco.mj_kinematics(m, d)
        before = self.watched(draft)
        for _ in range(round(self.cfg.settle / m.opt.timestep)):
            mujoco.mj_step(m, d)
        mujoco.mj_kinematics(m, d)
        if d.warning[mujoco.mjtWarning.mjWARN_BADQACC].number or not np.isfinite(d.qpos).all():
            return None
        if np.linalg.norm(self.watched(draft) - before) > self.cfg.slip:
            return None
        return d.qpos.copy()

    def watched(self, draft: ResetCandidate) -> np.ndarray:
        """Return what must not move while a draft settles [m]: object 1 in the hand, or where the hand is clear."""
        if draft.case > 1:
            return self.in_hand()
        return self.d.xpos[self.task.objects[0]].copy() if draft.apart else np.zeros(3)

    def in_hand(self) -> np.ndarray:
        """Return object 1's origin in the frame of the tool [m], shape (3,)."""
        d, tool = self.d, self.task.robot.tool
        return d.site_xmat[tool].reshape(3, 3).T @ (d.xpos[self.task.objects[0]] - d.site_xpos[tool])


def place(qpos: np.ndarray, address: int, pivot: np.ndarray, move: tuple[np.ndarray, float]) -> None:
    """Turn and shift a free body in place, about a pivot [m], shape (3,)."""
    shift, turn = move
    pivot = np.array(pivot)
    qpos[address : address + 3] = pivot + vertical_rotation(turn) @ (qpos[address : address + 3] - pivot) + shift
    turned = np.zeros(4)
    mujoco.mju_mulQuat(turned, np.array([np.cos(turn / 2), 0, 0, np.sin(turn / 2)]), qpos[address + 3 : address + 7])
    qpos[address + 3 : address + 7] = turned


def vertical_rotation(angle: float) -> np.ndarray:
    """Return the rotation by an angle [rad] about the vertical, shape (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
