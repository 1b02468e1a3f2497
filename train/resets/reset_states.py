"""Initial states of one stage: demonstrated times, displaced with the contact chain kept, and checked to settle."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from concent_warp.errors import TrainError
from concent_warp.simulate.activation import initial_activation
from concent_warp.simulate.inputs import compile_model
from concent_warp.train.reset_cfg import ResetCfg
from concent_warp.train.resets.inverse_kinematics import solve_inverse_kinematics
from concent_warp.train.resets.inverse_kinematics_batch import solve_inverse_kinematics_batch
from concent_warp.train.task.held_arm import holding_commands
from concent_warp.train.task.movable_fixtures import mocap_id
from concent_warp.train.task.task import Task


@dataclass(frozen=True)
class ResetStates:
    """M initial states of episodes, at rest."""

    qpos: np.ndarray
    """Positions, shape (M, nq)."""
    qvel: np.ndarray
    """Velocities, shape (M, nv)."""
    ctrl: np.ndarray
    """Commands that hold the state, shape (M, nu)."""
    mocap: np.ndarray
    """Poses of mocap bodies, position [m] and quaternion, shape (M, nmocap, 7)."""
    stage: np.ndarray
    """Stages of the states, shape (M,) int."""
    begins: np.ndarray
    """Whether a state is before the first stage, the robot as at the start of the demonstration, shape (M,) bool."""
    time: np.ndarray
    """Demonstrated times of the states [s], shape (M,)."""
    case: np.ndarray
    """Case of the paper's appendix D, 1..3, shape (M,) int."""
    discarded: dict[str, int]
    """Number of discarded candidates, by reason."""


@dataclass
class ResetCandidate:
    """A candidate of an initial state."""

    time: float
    """Demonstrated time [s]."""
    case: int
    """Case of the paper's appendix D, 1..3."""
    as_demonstrated: bool
    """Whether it is not displaced."""
    qpos: np.ndarray
    """Positions, shape (nq,); the objects' are final, the arm's where `position` is None."""
    ctrl: np.ndarray
    """Commands, shape (nu,)."""
    stage: int
    """Stage of the state."""
    mocap: np.ndarray
    """Poses of mocap bodies, shape (nmocap, 7)."""
    begins: bool = False
    """Whether it is an initial state of the whole chain."""
    hand_free: bool = False
    """Whether the hand must not touch an object."""
    position: np.ndarray | None = None
    """Target position of the tool [m], shape (3,); None if the joints are final."""
    rotation: np.ndarray | None = None
    """Target orientation of the tool, shape (3, 3)."""


class ResetSampler:
    """Samples states of one stage and checks them in C MuJoCo.

    Times are sampled from shortly before the preceding stage to the stage's first contact; for states that are not
    displaced, to the middle of the target event's window, so that some have almost met the target. In a stage that
    starts with object 1 grasped, all states have it grasped.
    """

    def __init__(self, task: Task, cfg: ResetCfg, seed: int, device: str) -> None:
        """Prepare models and addresses; `device` is Warp's name of the device of Newton's solver."""
        self.task, self.cfg, self.device = task, cfg, device
        self.newton = cfg.solver == "newton"
        self.rng = np.random.default_rng([seed, 1])
        self.discarded: dict[str, int] = {"unreachable": 0, "overlapping": 0, "chain broken": 0}
        self.m = task.compiled
        self.d = mujoco.MjData(self.m)
        # Overlaps are checked with all spheres: those outside the physics must not start inside another object either.
        self.full, sphere_geom = compile_model(task.model, None)
        self.full_data = mujoco.MjData(self.full)
        self.is_sphere = np.zeros(self.full.ngeom, dtype=bool)
        self.is_sphere[sphere_geom] = True
        self.free = [self.free_joint(body) for body in task.objects]
        self.mocap = [mocap_id(self.m, body) for body in task.objects]
        self.fixture_poses = np.hstack([self.d.mocap_pos, self.d.mocap_quat])
        stage = task.events.stages[task.stage]
        self.starts_grasped = task.starts_grasped(task.stage)
        earlier = task.events.stages[task.stage - 1].start if task.stage else 0.0
        self.window = min(max(earlier - cfg.before, 0.0), stage.start), stage.start, stage.event.time
        self.robot_bodies = {e.body for e in task.events.entities if e.role == "robot"}

    def free_joint(self, body: int) -> int | None:
        """Return the address of a free body's position in qpos, None for other bodies."""
        joint = self.m.body_jntadr[body]
        free = joint >= 0 and self.m.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
        return int(self.m.jnt_qposadr[joint]) if free else None

    def sample(self, count: int, progress: Callable[[float], None] | None) -> ResetStates:
        """Return `count` states.

        Raises:
            TrainError: Too many candidates were discarded.
        """
        found: list[tuple[np.ndarray, ResetCandidate]] = []
        left = self.cfg.passes * count
        while left > 0 and len(found) < count:
            sampled = [self.candidate() for _ in range(min(count - len(found), left))]
            left -= len(sampled)
            for candidate in self.with_joints(sampled):
                if (settled := self.checked(candidate)) is not None:
                    found.append((settled, candidate))
                    if progress is not None and len(found) % 32 == 0:
                        progress(len(found) / count)
        if len(found) == count:
            return self.stacked(found)
        raise TrainError(
            "too few initial states keep the contact chain",
            expected=count,
            found=f"{len(found)}, and discarded {self.discarded}",
            fix="lower the displacements --environment.reset.position and .turn, in chains of stages also .place and "
            ".heading",
        )

    def stacked(self, found: list[tuple[np.ndarray, ResetCandidate]]) -> ResetStates:
        """Return settled positions and candidates as arrays."""
        candidates = [candidate for _, candidate in found]
        return ResetStates(
            qpos=np.array([qpos for qpos, _ in found]),
            qvel=np.zeros((len(found), self.m.nv)),
            ctrl=np.array([candidate.ctrl for candidate in candidates]),
            mocap=np.array([candidate.mocap for candidate in candidates]),
            stage=np.array([candidate.stage for candidate in candidates]),
            begins=np.array([candidate.begins for candidate in candidates]),
            time=np.array([candidate.time for candidate in candidates]),
            case=np.array([candidate.case for candidate in candidates]),
            discarded=self.discarded,
        )

    def candidate(self) -> ResetCandidate:
        """Sample a time and a displacement."""
        start, onset, end = self.window
        as_demonstrated = self.rng.random() < self.cfg.demonstrated
        time = self.rng.uniform(start, end if as_demonstrated else onset)
        while self.starts_grasped and self.case(time) == 1:
            time = self.rng.uniform(start, end if as_demonstrated else onset)
        candidate = self.demonstrated(time, as_demonstrated, self.task.stage)
        if not as_demonstrated and candidate.case == 1:
            self.scatter(candidate)
        elif not as_demonstrated:
            self.displace(candidate)
            self.rotate_in_grasp(candidate)
        return candidate

    def demonstrated(self, time: float, as_demonstrated: bool, stage: int) -> ResetCandidate:
        """Return the state at a demonstrated time."""
        row = self.task.replay.row(time)
        qpos, ctrl = self.task.replay.qpos[row].copy(), self.task.replay.ctrl[row].copy()
        return ResetCandidate(time, self.case(time), as_demonstrated, qpos, ctrl, stage, self.fixture_poses.copy())

    def with_joints(self, candidates: list[ResetCandidate]) -> Iterator[ResetCandidate]:
        """Yield candidates with joint positions by inverse kinematics; discard unreachable ones."""
        robot = self.task.robot
        targets = [i for i, candidate in enumerate(candidates) if candidate.position is not None]
        if self.newton:
            angles, fine = solve_inverse_kinematics_batch(
                self.m,
                robot,
                np.array([candidates[i].qpos for i in targets]).reshape(-1, self.m.nq),
                np.array([candidates[i].position for i in targets]).reshape(-1, 3),
                np.array([candidates[i].rotation for i in targets]).reshape(-1, 3, 3),
                self.cfg.newton_solver,
                device=self.device,
            )
            solutions = {i: angles[k] if fine[k] else None for k, i in enumerate(targets)}
        else:
            solutions = {}
        for i, candidate in enumerate(candidates):
            if candidate.position is not None and candidate.rotation is not None:
                if not self.newton:
                    self.d.qpos[:] = candidate.qpos
                    solutions[i] = solve_inverse_kinematics(
                        self.m, self.d, robot, candidate.position, candidate.rotation, self.cfg.posture_solver
                    )
                joints = solutions[i]
                if joints is None:
                    self.discard(candidate, "unreachable")
                    continue
                candidate.qpos[robot.qpos] = joints
            yield candidate

    def checked(self, candidate: ResetCandidate) -> np.ndarray | None:
        """Return the settled positions of a candidate, shape (nq,), None if it is discarded; sets its commands."""
        if not candidate.as_demonstrated and self.overlap(candidate) > self.cfg.overlap:
            self.discard(candidate, "overlapping")
            return None
        # Demonstrated commands differ from the joints by lag and contact forces as well.
        robot = self.task.robot
        (candidate.ctrl[robot.actuator],) = holding_commands(self.m, self.d, robot.actuator, candidate.qpos[None])
        settled = self.settled_state(candidate)
        if settled is None:
            self.discard(candidate, "chain broken")
        return settled

    def discard(self, candidate: ResetCandidate, reason: str) -> None:
        """Count a candidate that is discarded."""
        del candidate
        self.discarded[reason] += 1

    def case(self, time: float) -> int:
        """Return the case of a demonstrated time [s], 1..3."""
        names = [self.m.body(body).name for body in self.task.objects]
        grasped = touching = False
        for contact in self.task.events.body_contacts:
            if contact.start <= time < contact.end:
                grasped |= contact.a in self.robot_bodies and contact.b == names[0]
                touching |= len(names) > 1 and {contact.a, contact.b} == set(names[:2])
        return 1 + grasped + (grasped and touching)

    def scatter(self, candidate: ResetCandidate) -> None:
        """Displace the robot's joints and every free object independently (case 1)."""
        robot, cfg, moved = self.task.robot, self.cfg, candidate.qpos
        moved[robot.qpos] += self.rng.uniform(-cfg.joints, cfg.joints, len(robot.qpos))
        limited = self.m.jnt_limited[robot.joint].astype(bool)
        low, high = self.m.jnt_range[robot.joint].T
        moved[robot.qpos] = np.where(limited, np.clip(moved[robot.qpos], low, high), moved[robot.qpos])
        for address in self.free:
            if address is not None:
                move_body(moved, address, moved[address : address + 3], self.displacement(lift=False))

    def displace(self, candidate: ResetCandidate) -> None:
        """Displace objects, and the target pose of the hand with them (cases 2 and 3)."""
        if self.free[0] is None:  # an object on a joint cannot move with the hand
            candidate.as_demonstrated = True
            return
        together = candidate.case == 3 and self.free[1] is not None
        shift, turn = self.displacement(lift=not together)
        d, tool = self.d, self.task.robot.tool
        d.qpos[:] = candidate.qpos
        mujoco.mj_kinematics(self.m, d)
        pivot = d.site_xpos[tool].copy()
        candidate.position, candidate.rotation = (
            pivot + shift,
            vertical_rotation(turn) @ d.site_xmat[tool].reshape(3, 3),
        )
        for address in self.free[: 1 + together]:
            assert address is not None
            move_body(candidate.qpos, address, pivot, (shift, turn))

    def rotate_in_grasp(self, candidate: ResetCandidate) -> None:
        """Rotate object 1 in the hand about the axis between the fingers, as contact at an edge rotates it."""
        address, table, stage = self.free[0], self.task.table, candidate.stage
        grasped = self.task.robot_slots[stage] & (table.body_b[stage] == self.task.objects[0])
        if not self.cfg.grasp_turn or address is None or not grasped.any():
            return
        axis = np.linalg.svd(table.normal[stage][grasped])[2][0]
        half = 0.5 * self.rng.uniform(-self.cfg.grasp_turn, self.cfg.grasp_turn)
        turned = np.zeros(4)
        mujoco.mju_mulQuat(
            turned, candidate.qpos[address + 3 : address + 7], np.array([np.cos(half), *np.sin(half) * axis])
        )
        candidate.qpos[address + 3 : address + 7] = turned

    def displacement(self, *, lift: bool) -> tuple[np.ndarray, float]:
        """Return a sampled translation [m], shape (3,), and rotation about the vertical [rad]."""
        cfg = self.cfg
        aside = self.rng.uniform(-cfg.position, cfg.position, 2)
        up = self.rng.uniform(0, cfg.lift) if lift else 0.0
        return np.array([*aside, up]), float(self.rng.uniform(-cfg.turn, cfg.turn))

    def overlap(self, candidate: ResetCandidate) -> float:
        """Return the deepest penetration of a sphere in another object or the surroundings [m], 0 for none.

        The hand counts only if it must not touch an object.
        """
        d = self.full_data
        d.qpos[:], d.qvel[:] = candidate.qpos, 0
        d.mocap_pos[:], d.mocap_quat[:] = candidate.mocap[:, :3], candidate.mocap[:, 3:]
        mujoco.mj_fwdPosition(self.full, d)
        robot = self.task.robot
        hand = {int(self.full.site_bodyid[robot.tool])} | {self.full.body(n).id for n in self.robot_bodies}
        deepest = 0.0
        for contact in d.contact:
            bodies = {int(self.full.geom_bodyid[g]) for g in contact.geom}
            if self.is_sphere[contact.geom].any() and (candidate.hand_free or not bodies & hand):
                deepest = max(deepest, -float(contact.dist))
        return deepest

    def settled_state(self, candidate: ResetCandidate) -> np.ndarray | None:
        """Return positions after the settling time, None where the state fell apart."""
        m, d = self.m, self.d
        mujoco.mj_resetData(m, d)
        d.qpos[:], d.ctrl[:] = candidate.qpos, candidate.ctrl
        d.mocap_pos[:], d.mocap_quat[:] = candidate.mocap[:, :3], candidate.mocap[:, 3:]
        d.act[:] = initial_activation(m, d, candidate.ctrl)
        mujoco.mj_kinematics(m, d)
        before = self.monitored_position(candidate)
        for _ in range(round(self.cfg.settling_time / m.opt.timestep)):
            mujoco.mj_step(m, d)
        mujoco.mj_kinematics(m, d)
        if d.warning[mujoco.mjtWarning.mjWARN_BADQACC].number or not np.isfinite(d.qpos).all():
            return None
        if np.linalg.norm(self.monitored_position(candidate) - before) > self.cfg.slip:
            return None
        return d.qpos.copy()

    def monitored_position(self, candidate: ResetCandidate) -> np.ndarray:
        """Return the position that must not move while a candidate settles [m], shape (3,).

        It is that of object 1 in the hand, or in the world if the hand must not touch it.
        """
        if candidate.case > 1:
            return self.position_in_hand()
        return self.d.xpos[self.task.objects[0]].copy() if candidate.hand_free else np.zeros(3)

    def position_in_hand(self) -> np.ndarray:
        """Return the origin of object 1 in the frame of the tool [m], shape (3,)."""
        d, tool = self.d, self.task.robot.tool
        return d.site_xmat[tool].reshape(3, 3).T @ (d.xpos[self.task.objects[0]] - d.site_xpos[tool])


def move_body(qpos: np.ndarray, address: int, pivot: np.ndarray, move: tuple[np.ndarray, float]) -> None:
    """Rotate a free body about the vertical through a pivot [m], shape (3,), and translate it, in place."""
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
