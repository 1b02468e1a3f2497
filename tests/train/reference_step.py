"""One step of the environment in plain NumPy, world by world, as the paper's appendices C and G and docs/train.md say.

It shares nothing with the environment but the task's tables and MuJoCo's forward kinematics.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.train.cfg import EnvironmentCfg
from concent_warp.train.resets.sample import ResetStates
from concent_warp.train.task.task import Task


@dataclass
class WorldState:
    """State of a world in the simulator."""

    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    mocap: np.ndarray
    """Poses of mocap bodies, shape (nmocap, 7)."""


@dataclass
class EpisodeState:
    """What the environment counts in a world."""

    stage: int
    from_start: bool
    met: int
    """Targets met in order."""
    within: int = 0
    """Steps for which the present target has been met."""
    at_rest: int = 0
    """Steps for which object 1 has been in place."""
    length: int = 0
    total: float = 0.0
    """Sum of the rewards."""
    shown: tuple[np.ndarray, ...] = ()
    """The latest observations, the present one first."""


@dataclass
class StepResult:
    """What a step gives in one world."""

    ctrl: np.ndarray
    """Commands of the step."""
    terms: dict[str, float]
    reward: float
    failure: tuple[bool, bool, bool]
    """Dropped, severe, diverged."""
    success: bool
    time_out: bool
    """Whether the episode ended by time alone."""
    rested: bool
    """Whether it ended since object 1 has come to rest."""
    episode: EpisodeState
    """After the step, before a new episode."""

    @property
    def done(self) -> bool:
        """Whether the episode has ended."""
        return any(self.failure) or self.time_out or self.rested


@dataclass
class Reference:
    """The environment of a task in plain NumPy."""

    task: Task
    cfg: EnvironmentCfg
    success_average: float = 0.0
    sums: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.m = self.task.compiled
        self.chained = self.task.first != self.task.stage
        self.period = self.cfg.decimation * self.m.opt.timestep
        self.steps = max(1, round(self.cfg.episode / self.period))  # pyright: ignore[reportOptionalOperand]
        self.rest = max(1, round(self.cfg.chain.rest / self.period))
        self.data = mujoco.MjData(self.m), mujoco.MjData(self.m)

    def begin(self, states: ResetStates, row: int) -> tuple[WorldState, EpisodeState]:
        """Return a world at the start of an episode."""
        stage = int(states.stage[row])
        world = WorldState(
            *(np.array(v[row], dtype=float) for v in (states.qpos, states.qvel, states.ctrl, states.mocap))
        )
        return world, EpisodeState(stage, bool(states.begins[row]), stage - self.task.first)

    def kinematics(self, state: WorldState, buffer: int = 0) -> mujoco.MjData:
        """Return body and site poses of a state, in one of two buffers."""
        d = self.data[buffer]
        d.qpos[:] = state.qpos
        d.mocap_pos[:], d.mocap_quat[:] = state.mocap[:, :3], state.mocap[:, 3:]
        mujoco.mj_kinematics(self.m, d)
        return d

    def command(self, state: WorldState, action: np.ndarray) -> np.ndarray:
        """Return the commands of an action: steps of the setpoints, within their lead and their range."""
        robot, ctrl = self.task.robot, state.ctrl.copy()
        action = np.clip(action, -1, 1)
        for k, actuator in enumerate(robot.actuator):
            hinge = self.m.jnt_type[robot.joint[k]] == mujoco.mjtJoint.mjJNT_HINGE
            step, lead = self.cfg.action.turn if hinge else self.cfg.action.slide, robot.lead[k]
            at = state.qpos[robot.qpos[k]] + robot.hold[k]
            ctrl[actuator] = np.clip(ctrl[actuator] + action[k] * step, at - lead, at + lead)
        for actuator in robot.gripper:
            ctrl[actuator] += action[-1] * self.cfg.action.gripper
        for i in (*robot.actuator, *robot.gripper):
            if self.m.actuator_ctrllimited[i]:
                ctrl[i] = np.clip(ctrl[i], *self.m.actuator_ctrlrange[i])
        return ctrl

    def pair_points(self, d: mujoco.MjData, stage: int) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
        """Yield slot, contact point, its target and the target's normal in the world, of each contact pair."""
        table = self.task.table
        for k in np.flatnonzero(table.used[stage]):
            a, b = table.body_a[stage, k], table.body_b[stage, k]
            turn_a, turn_b = d.xmat[a].reshape(3, 3), d.xmat[b].reshape(3, 3)
            contact = d.xpos[a] + turn_a @ table.point_a[stage, k]
            goal = d.xpos[b] + turn_b @ table.point_b[stage, k]
            yield int(k), contact, goal, turn_b @ table.normal[stage, k]

    def observe(self, state: WorldState, episode: EpisodeState) -> np.ndarray:
        """Return what the policy observes at a state; before its first observation an episode has always had it."""
        present, count = self.observation(state, episode.stage), self.cfg.observation.history
        episode.shown = (present, *(episode.shown or (present,) * count))[:count]
        return np.concatenate(episode.shown)

    def observation(self, state: WorldState, stage: int) -> np.ndarray:
        """Return the observation of a state."""
        d, robot = self.kinematics(state), self.task.robot
        hinge = [k for k in range(len(robot.joint)) if self.m.jnt_type[robot.joint[k]] == mujoco.mjtJoint.mjJNT_HINGE]
        slide = [k for k in range(len(robot.joint)) if k not in hinge]
        angles = state.qpos[robot.qpos[hinge]]
        parts = [np.sin(angles), np.cos(angles), state.qpos[robot.qpos[slide]], state.qvel[robot.dof]]
        if self.cfg.observation.leads:
            parts.append((state.ctrl[robot.actuator] - state.qpos[robot.qpos] - robot.hold) / robot.lead)
        if len(robot.gripper):
            driven = [self.m.jnt_qposadr[self.m.actuator_trnid[i, 0]] for i in robot.gripper]
            parts += [[state.qpos[driven].mean()], [state.ctrl[robot.gripper].mean()]]
        parts.append(d.site("tcp").xpos)
        for body in self.task.objects:
            parts += [d.xpos[body], d.xmat[body].reshape(3, 3)[:, 0], d.xmat[body].reshape(3, 3)[:, 1]]
        slots = np.zeros((self.task.table.used.shape[1], 13))
        for k, contact, goal, normal in self.pair_points(d, stage):
            away = goal - contact
            slots[k] = [1, *contact, *away, *(away / np.linalg.norm(away)), *normal]
        return np.concatenate([*parts, slots.ravel()])

    def distances(self, d: mujoco.MjData, stage: int) -> dict[int, float]:
        """Return the distance of each contact pair by slot."""
        return {k: float(np.linalg.norm(goal - at)) for k, at, goal, _ in self.pair_points(d, stage)}

    def virtual(self, d: mujoco.MjData, stage: int) -> tuple[float, bool]:
        """Return virtual collision penalty and whether a penetration is severe; all shapes are single boxes."""
        if self.cfg.collision == "full":
            return 0.0, False
        cfg, geometry, table = self.cfg.virtual, self.task.model.geometry, self.task.table
        assert geometry is not None
        touching = {
            frozenset((table.body_a[stage, k], table.body_b[stage, k])) for k in np.flatnonzero(table.used[stage])
        }
        shape = self.task.model.scene.model
        targets = {*self.task.objects, *(self.m.body(name).id for name in ("arm", "hand", "left", "right"))}
        depth, band = [0.0], 0.0
        for i in np.flatnonzero(~self.task.collidable):
            body = self.m.body(geometry.bodies[geometry.body[i]]).id
            centre = d.xpos[body] + d.xmat[body].reshape(3, 3) @ geometry.position[i]
            for target in targets - {body}:
                g = shape.body_geomadr[target]
                frame = Rotation.from_quat(shape.geom_quat[g][[1, 2, 3, 0]]).as_matrix()
                local = frame.T @ (d.xmat[target].reshape(3, 3).T @ (centre - d.xpos[target]) - shape.geom_pos[g])
                out = np.abs(local) - shape.geom_size[g]
                distance = np.linalg.norm(np.maximum(out, 0)) + min(out.max(), 0.0)
                gap = distance - (geometry.radius[i] - cfg.slack)
                depth.append(max(-gap, 0.0))
                if frozenset((body, target)) not in touching:
                    band += np.clip((cfg.margin - gap) / cfg.margin, 0, 1) ** 2
        return -(cfg.depth * sum(depth) + cfg.band * band), max(depth) > cfg.severe

    def relative(self, d: mujoco.MjData) -> np.ndarray:
        """Return the position of object 1 in the frame of object 2."""
        first, second = self.task.objects[:2]
        return d.xmat[second].reshape(3, 3).T @ (d.xpos[first] - d.xpos[second])

    def reach(self, d: mujoco.MjData, stage: int) -> float:
        """Return the reaching reward, or the engineered one."""
        cfg, gaps = self.cfg.reward, self.distances(d, stage)
        if cfg.kind == "engineered" and stage == self.task.stage:
            return self.engineered(self.relative(d))
        if not gaps:
            return 0.0
        scales = [cfg.far, cfg.near, *([cfg.wide] if self.chained else [])]
        return sum(amplitude * np.exp(-max(gaps.values()) / length) for amplitude, length in scales)

    def engineered(self, place: np.ndarray) -> float:
        """Return the engineered reward of object 1's place in the frame of object 2."""
        cfg = self.cfg.reward.engineered
        aside, above = np.linalg.norm(place[:2] - cfg.hole[:2]), max(place[2] - cfg.seat, 0.0)
        align, depth = (sum(a * np.exp(-x / s) for a, s in (cfg.far, cfg.near)) for x in (aside, above))
        gate = 1 / (1 + np.exp(-(cfg.gate - aside) / cfg.gate_width))
        return align + gate * depth + cfg.bonus * (aside < cfg.reached and above == 0)

    def disturbance(self, before: mujoco.MjData, after: mujoco.MjData, stage: int) -> float:
        """Return the penalty of motion of the objects, in the hand for those that the stage grasps."""
        events, table = self.task.events, self.task.table
        hand = np.flatnonzero(self.task.robot_slots[stage])
        grasps = events.stages[stage].bodies[0] != "robot" and len(hand) > 0
        total = 0.0
        for body in self.task.objects:
            grasped = grasps and body in table.body_b[stage, hand]
            poses = []
            for d in (before, after):
                frame = int(self.m.site_bodyid[self.task.robot.tool]) if grasped else 0
                back = d.xmat[frame].reshape(3, 3).T
                poses.append((back @ (d.xpos[body] - d.xpos[frame]), back @ d.xmat[body].reshape(3, 3)))
            moved = np.linalg.norm(poses[1][0] - poses[0][0])
            turned = Rotation.from_matrix(poses[0][1].T @ poses[1][1]).magnitude()
            total += self.cfg.reward.disturb_position * moved + self.cfg.reward.disturb_rotation * turned
        return -total

    def step(self, before: WorldState, after: WorldState, action: np.ndarray, episode: EpisodeState) -> StepResult:
        """Return what a step gives in one world; `after` has the positions and velocities that it ends with."""
        cfg, reward, task, stage = self.cfg, self.cfg.reward, self.task, episode.stage
        ctrl = self.command(before, action)
        failure, success, result = [False, False, False], False, EpisodeState(**vars(episode))
        terms: dict[str, float] = dict.fromkeys(
            ("reach", "stages", "action", "velocity", "press", "disturb", "vcp", "failure"), 0.0
        )
        strict = reward.lenience + (1 - reward.lenience) * self.success_average**2
        failure[2] = not (
            (np.abs(after.qpos) < cfg.max_position).all()
            and (np.abs(after.qvel) < cfg.max_velocity).all()
            and np.isfinite(ctrl).all()
        )
        worst, gaps = np.inf, {}
        if not failure[2]:
            d = self.kinematics(after, 1)
            gaps = self.distances(d, stage)
            worst = max(gaps.values(), default=np.inf)
            grasped = task.events.stages[stage].bodies[0] != "robot"
            failure[0] = grasped and any(gap > cfg.dropped for k, gap in gaps.items() if task.robot_slots[stage, k])
            if len(task.objects) > 1:
                failure[0] |= bool(np.linalg.norm(self.relative(d)) > cfg.lost)
            penalty, severe = self.virtual(d, stage)
            failure[1] = severe and not failure[0]
            if task.target_position is None:
                success = worst < cfg.success
            else:
                success = bool((np.abs(self.relative(d) - task.target_position) < cfg.success).all())
            lead = ctrl[task.robot.actuator] - after.qpos[task.robot.qpos] - task.robot.hold
            terms |= {
                "reach": reward.reach * self.reach(d, stage),
                "stages": reward.stage * (stage - task.first),
                "action": -reward.regularisation * reward.action * (np.clip(action, -1, 1) ** 2).sum(),
                "velocity": -reward.regularisation * reward.velocity * (after.qvel[task.robot.dof] ** 2).sum(),
                "press": -reward.regularisation * reward.press * ((lead / task.robot.lead) ** 2).sum(),
                "disturb": reward.regularisation * self.disturbance(self.kinematics(before), d, stage),
                "vcp": reward.vcp * strict * penalty,
            }
        failed = any(failure)
        terms["failure"] = -reward.failure * strict * failed
        result.within = episode.within + 1 if worst < cfg.chain.tolerance and not failed else 0
        met = result.within >= cfg.chain.hold
        result.met = max(episode.met, stage - task.first + met)
        if met and stage < task.stage:
            result.stage, result.within = stage + 1, 0
        if self.chained:
            result.at_rest = episode.at_rest + 1 if success and not failed else 0
        completed = (met and stage < task.stage) or result.at_rest >= self.rest
        terms["stages"] += reward.completion * completed
        value = reward.scale * sum(terms.values()) / len(task.chained)
        result.length, result.total = episode.length + 1, episode.total + value
        rested = result.at_rest >= self.rest
        over = result.length >= self.steps and not rested and not any(failure)
        dropped, severe, diverged = failure
        return StepResult(ctrl, terms, value, (dropped, severe, diverged), success, over, rested, result)

    def count(self, results: list[StepResult], overflow: int) -> None:
        """Add the results of a step in all worlds to the log."""
        ended = [one for one in results if one.done]
        good = [one for one in ended if one.success and not any(one.failure)]
        if ended:
            keep = np.exp(-len(ended) / len(results))
            self.success_average = keep * self.success_average + (1 - keep) * len(good) / len(ended)
        chains = [one for one in ended if one.episode.from_start]
        found = {name: sum(one.terms[name] for one in results) for name in results[0].terms}
        found |= {
            "steps": len(results), "episodes": len(ended), "success": len(good), "overflow": overflow,
            "time outs": sum(one.time_out for one in ended),
            **{name: sum(one.failure[k] for one in ended) for k, name in enumerate(("dropped", "severe", "diverged"))},
            "return": sum(one.episode.total for one in ended), "length": sum(one.episode.length for one in ended),
            "chains": len(chains), "chain success": sum(one.episode.from_start for one in good),
        }  # fmt: skip
        for k, s in enumerate(self.task.chained):
            name = f"met {self.task.events.stages[s].name}"
            found[name] = sum(one.episode.met > k for one in chains)
        for name, value in found.items():
            self.sums[name] = self.sums.get(name, 0.0) + value

    def log(self) -> dict[str, float]:
        """Return means since the last call."""
        sums, self.sums = self.sums, {}
        steps, episodes, chains = (max(sums[name], 1.0) for name in ("steps", "episodes", "chains"))
        means = {name: sums[name] / steps for name in (*TERM_NAMES, "overflow")}
        for name in ("success", "time outs", "dropped", "severe", "diverged", "return", "length"):
            means[name] = sums[name] / episodes
        if self.chained:
            means["success of all"], means["success"] = means["success"], sums["chain success"] / chains
            means |= {name: value / chains for name, value in sums.items() if name.startswith("met ")}
            means["chains"] = sums["chains"]
        return {**means, "steps": sums["steps"], "episodes": sums["episodes"], "diverged worlds": sums["diverged"]}


TERM_NAMES = ("reach", "stages", "action", "velocity", "press", "disturb", "vcp", "failure")
