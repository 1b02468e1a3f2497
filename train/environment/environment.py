"""Vectorised environment with rsl-rl's interface; all arrays stay on the device and a step does not wait for it.

A step consists of: commands from the action; simulation; distances of contact pairs and virtual collisions; rewards,
ends of episodes and their new initial states; poses and distances of the new states; observation. On CUDA each part is
a captured graph.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any, cast

import numpy as np
import torch
import warp as wp
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from concent_warp.checkpoint_file import check_state
from concent_warp.errors import TrainError
from concent_warp.kernels.contact_pairs import ContactPairs
from concent_warp.train.cfg import EnvironmentCfg
from concent_warp.train.environment.first_divergence import FirstDivergence
from concent_warp.train.environment.graphs import Graph, captured
from concent_warp.train.environment.initial_states import InitialStates
from concent_warp.train.environment.observation import BaseObservation, ObservationLayout
from concent_warp.train.environment.physics import Physics
from concent_warp.train.environment.quaternions import invert_quaternion, rotate_vectors
from concent_warp.train.environment.reward import (
    disturbance_penalty,
    effort_penalties,
    engineered_reward,
    relative_pose,
)
from concent_warp.train.environment.state_estimate import StateEstimate
from concent_warp.train.environment.step_log import TERMS, StepLog
from concent_warp.train.environment.virtual_collision import virtual_collision
from concent_warp.train.observation_cfg import SensorErrorsCfg
from concent_warp.train.resets.sample import ResetStates
from concent_warp.train.task.task import Task


class Environment(VecEnv):
    """N worlds of a task.

    In a chain of stages each world has a present stage, whose target event determines observation and reward. The next
    stage follows when the target is met (`ChainCfg`); the episode ends when object 1 is at rest in place.
    """

    def __init__(
        self,
        task: Task,
        cfg: EnvironmentCfg,
        physics: Physics,
        states: ResetStates,
        sensors: SensorErrorsCfg | None = None,
    ) -> None:
        """Create the environment and start an episode in all worlds.

        Args:
            task: The task.
            cfg: Settings.
            physics: The simulated worlds, with the bodies, joints, actuators and sites of the task's model.
            states: Initial states.
            sensors: Errors of the instruments that the policy observes through; those of the settings by default.
        """
        self.task, self.physics, self.layout = task, physics, ObservationLayout.of(task, cfg.observation)
        self.num_envs, self.num_actions, self.device = physics.worlds, task.robot.actions, physics.device
        self.control_step = cfg.decimation * task.replay.timestep
        """Time between actions [s]."""
        self.max_episode_length = max(1, round(cfg.seconds / self.control_step))
        self.cfg = asdict(cfg)
        self._settings, self._is_chain = cfg, task.demonstrated is not None
        self.perturbs_trials = False
        """Whether random forces act on the grasped object in evaluations too."""
        self._initial = InitialStates(states, cfg.reset.stuck, self.num_envs, self.device, self.control_step)
        self._make_tables()
        self._make_buffers()
        self._base = BaseObservation(task, self.device, cfg.observation)
        sensors = sensors or cfg.observation.sensors
        self.estimate = (
            None if sensors.exact else StateEstimate(task, physics, cfg.observation, sensors, self.control_step)
        )
        """State as the policy observes it; None where it observes the true one."""
        warp_device = wp.device_from_torch(self.device)
        with wp.ScopedDevice(warp_device):
            stage = wp.from_torch(self.stage)
            size = self.num_envs, self.layout.size
            truth = wp.zeros(size, dtype=float)
            observation = truth if self.estimate is None else wp.zeros(size, dtype=float)
            self._pairs = self._contact_pairs(physics.poses(), stage, truth)
            self._seen_pairs = self._pairs
            if self.estimate is not None:
                self._seen_pairs = self._contact_pairs(self.estimate.kinematics.poses(), stage, observation)
            penalised = cfg.collision == "vcp" or cfg.virtual.points
            self._virtual = virtual_collision(task, physics, stage, cfg.virtual) if penalised else None
            self._measure()
            capture = cfg.capture != "none"
            self._measured = Graph(self._measure, warp_device, capture)
            self._paired = Graph(self._pairs.launch, warp_device, capture)
            self._seen_paired = Graph(self._seen_pairs.launch, warp_device, capture)
            pairs, virtual = self._pairs, self._virtual
            self._distance, self._worst = wp.to_torch(pairs.distance), wp.to_torch(pairs.worst_distance)
            self._reach, self._finite = wp.to_torch(pairs.reach), wp.to_torch(pairs.finite)
            self._worst_pair = wp.to_torch(pairs.worst)
            self._seen_worst = wp.to_torch(self._seen_pairs.worst_distance)
            self._severe = None if virtual is None else wp.to_torch(virtual.severe)
            self._penalty = self._none if virtual is None else wp.to_torch(virtual.reward)
        wp.synchronize_device(warp_device)
        self._kept_alive = truth, observation
        self.truth, self.observation = wp.to_torch(truth), wp.to_torch(observation)
        """What the policy would observe without sensor errors, and the observation, shape (N, layout.size) each;
        overwritten by the next step, and the same without sensor errors."""
        self.history = self.observation.new_zeros(self.num_envs, cfg.observation.history, self.layout.size)
        """The latest observations, the present one first, shape (N, history, layout.size)."""
        whole = cfg.capture == "step" and self.device.startswith("cuda")
        parts = (
            self._apply_action, self._evaluate_step, self._read_base, self._read_encoders, self._track_objects,
            self._keep_observation,
        )  # fmt: skip
        self._command, self._evaluate, self._observe, self._encoders, self._tracker, self._remember = (
            captured(part, whole, fuse=cfg.fuse) for part in parts
        )
        self.reset()

    def _contact_pairs(self, poses: tuple[wp.array, wp.array], stage: wp.array, observation: wp.array) -> ContactPairs:
        """Return the contact pairs at poses, with their features in an observation."""
        reward = self._settings.reward
        return ContactPairs(
            self.task.table,
            *poses,
            stage,
            amplitude=(reward.far[0], reward.near[0]),
            sigma=(reward.far[1], reward.near[1]),
            features=cast(wp.array, observation[:, self.layout.base :]),
        )

    def _make_tables(self) -> None:
        """Copy constant arrays to the device."""
        task, cfg, m = self.task, self._settings, self.task.compiled
        robot = task.robot

        def real(values: Any) -> torch.Tensor:
            return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=self.device)

        def index(values: Any) -> torch.Tensor:
            return torch.as_tensor(np.asarray(values), dtype=torch.long, device=self.device)

        self._arm, self._arm_qpos, self._arm_dof = index(robot.actuator), index(robot.qpos), index(robot.dof)
        self._gripper = index(robot.gripper)
        self._step, self._lead, self._hold = real(robot.step), real(robot.lead), real(robot.hold)
        ranges = np.where(m.actuator_ctrllimited[:, None], m.actuator_ctrlrange, [-np.inf, np.inf])
        self._range = real(ranges)
        self._objects = index(list(task.objects))
        tool, stages = int(m.site_bodyid[robot.tool]), range(len(task.robot_slots))
        self._frames = index([[tool if grasped else 0 for grasped in task.grasped_objects(s)] for s in stages])
        watched = np.stack([task.grasping_slots(s) for s in stages])
        self._watched = torch.as_tensor(watched, device=self.device)
        self._target = None if task.target_position is None else real(task.target_position)
        self._max_deviation, self._max_grasp_gap, self._max_object_gap = cfg.success, cfg.dropped, cfg.lost
        self._rest = max(1, round(cfg.chain.rest / self.control_step))
        self._worlds = torch.arange(self.num_envs, device=self.device)[:, None]
        force, torque = cfg.randomisation.perturbation
        self._perturbation_std = real([force] * 3 + [torque] * 3) if force or torque else None

    def _make_buffers(self) -> None:
        """Allocate the buffers that captured graphs refer to."""
        n, device, m = self.num_envs, self.device, self.task.compiled
        self.action = torch.zeros(n, self.num_actions, device=device)
        self.reward = torch.zeros(n, device=device)
        self.done = torch.zeros(n, dtype=torch.bool, device=device)
        self.time_out = torch.zeros(n, dtype=torch.bool, device=device)
        """Whether the last step ended by time alone: the value function goes on there, see `rsl_rl`'s PPO."""
        self.failure = torch.zeros(n, 3, dtype=torch.bool, device=device)
        """Whether the last step ended in a drop, a severe virtual collision or divergence, shape (N, 3)."""
        self.success = torch.zeros(n, dtype=torch.bool, device=device)
        """Whether object 1 was in place at the end of the last step."""
        self.reached = torch.zeros(n, dtype=torch.int32, device=device)
        """Number of stage targets met in order by the end of the last step, stages before the initial one included."""
        self.stage = torch.full((n,), self.task.first, dtype=torch.int32, device=device)
        """Present stage of each world."""
        self._from_start = torch.zeros(n, dtype=torch.bool, device=device)
        self._started = torch.ones(n, dtype=torch.bool, device=device)
        self._stages_met = torch.zeros_like(self.stage)
        self._steps_within = torch.zeros_like(self.stage)
        self._steps_at_rest = torch.zeros_like(self.stage)
        self.terms = torch.zeros(n, len(TERMS), device=device)
        """Weighted terms of the last reward before it is scaled, shape (N, len(TERMS))."""
        self.episode_length_buf = torch.zeros(n, dtype=torch.long, device=device)
        self._return = torch.zeros(n, device=device)
        chained = [self.task.events.stages[s].name for s in self.task.chained]
        self._log = StepLog(chained, is_chain=self._is_chain, device=str(device))
        self._before = [torch.zeros_like(t) for t in (self.physics.qpos, self.physics.qvel, self.physics.ctrl)]
        objects = len(self.task.objects)
        self._pose_before = torch.zeros(n, objects, 3, device=device), torch.zeros(n, objects, 4, device=device)
        self._divergence = FirstDivergence(m, str(device))
        self._none = torch.zeros(n, device=device)
        self._success_average = torch.zeros((), device=device)
        self._perturbing = torch.ones((), device=device)

    def reset(self) -> None:
        """Start a training episode in every world, with random elapsed times, so that they do not all end at once."""
        self._perturbing.fill_(1)
        with torch.no_grad():
            self._start(torch.ones_like(self.done))
            self.episode_length_buf.copy_(torch.randint_like(self.episode_length_buf, self.max_episode_length))
            self._return.zero_()
            for value in (self._log.sums, self._success_average, self._divergence.happened):
                value.zero_()
            self.refresh()

    def start_from(self, rows: Sequence[int]) -> None:
        """Start an episode in every world from the initial states of these rows, one each.

        Without random force perturbations, unless `perturbs_trials` is set.
        """
        self._perturbing.fill_(float(self.perturbs_trials))
        index = torch.as_tensor(np.asarray(rows), device=self.device)
        with torch.no_grad():
            self._start(torch.ones_like(self.done), index)
        self.refresh()

    def refresh(self, *, measure: bool = True) -> None:
        """Compute poses, distances and observation of the present state; without `measure` from the last readings."""
        with torch.no_grad():
            self._update_poses_and_pairs()
            self._sense_and_observe(measure)

    def _update_poses_and_pairs(self) -> None:
        """Compute poses and distances of the present state."""
        self.physics.update_poses()
        self._paired.launch()

    def _sense_and_observe(self, measure: bool = True) -> None:
        """Compute the observation of the present state; see `refresh`."""
        if self.estimate is not None:
            if measure:
                self._encoders()
                self.estimate.kinematics.update()
                self._tracker()
            self.estimate.kinematics.update()
            self._seen_paired.launch()
        self._observe()
        if measure:
            self._remember()

    def get_observations(self) -> TensorDict:
        """Return copies of the present observations, which rsl-rl keeps during the next step.

        "policy" is what the policy observes; "truth", with sensor errors only, is the same without them, for the value
        function.
        """
        parts = {"policy": self.history.flatten(1).clone()}
        if self.estimate is not None:
            parts["truth"] = self.truth.clone()
        return TensorDict(parts, batch_size=[self.num_envs], device=self.device)

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Act for one control step; see `rsl_rl.env.VecEnv.step`."""
        with torch.no_grad():
            self.action.copy_(actions)
            self._command()
            self.physics.advance()
            self._measured.launch()
            self._evaluate()
            reward, done, time_out = self.reward.clone(), self.done.clone(), self.time_out.clone()
            means = self.terms.mean(dim=0)
            self.refresh()
        log = {f"/reward/{name}": value for name, value in zip(TERMS, means.unbind(), strict=True)}
        return self.get_observations(), reward, done, {"time_outs": time_out, "log": log}

    def read_log(self, total: Callable[[torch.Tensor], torch.Tensor] | None = None) -> dict[str, float]:
        """Return means since the last call and reset the sums; this waits for the device.

        Terms are means over steps; `success`, `time outs`, `dropped`, `severe` and `diverged` are shares of the ended
        episodes, `return` and `length` [steps] their means; `overflow` is the share of steps in which a world's buffers
        were too small. In a chain of stages, `success` and `met <stage>` are shares of the ended episodes that started
        before the first stage, and `success of all` is the share of all ended episodes.

        Args:
            total: Sums a tensor over ranks; by default only this process's worlds count.
        """
        return self._log.read(total)

    def diverged_state(self) -> dict[str, np.ndarray] | None:
        """Return the state before the step in which a world first diverged, None if none has.

        It has "qpos" (nq,), "qvel" (nv,), "ctrl" (nu,) before the action, the poses of fixed objects, "mocap_pos"
        (nmocap, 3) [m] and "mocap_quat" (nmocap, 4), and the index of the "world", shape ().
        """
        return self._divergence.state()

    @property
    def buffers(self) -> tuple[int, int] | None:
        """Contacts and constraint rows of a world that there is room for; None if the simulator makes room itself."""
        return self.physics.buffers

    def state(self) -> dict[str, torch.Tensor]:
        """Return the state of all worlds by name, without random number generators."""
        return {name: value.clone() for name, value in self._state().items()}

    def restore(self, state: dict[str, torch.Tensor]) -> None:
        """Set the state that `state` returned.

        Raises:
            TrainError: It lacks a part of this environment's state, or a part has another shape.
        """
        parts = self._state()
        if missing := sorted(set(parts) - set(state)):
            raise TrainError("the checkpoint lacks a part of the environment's state", expected=missing)
        check_state(state, parts, "the environment of the checkpoint", where=None, error=TrainError)
        for name, value in parts.items():
            value.copy_(state[name])
        self.refresh(measure=False)

    def _state(self) -> dict[str, torch.Tensor]:
        """Return the tensors of which `state` returns copies."""
        p = self.physics
        parts = {"qpos": p.qpos, "qvel": p.qvel, "ctrl": p.ctrl, "warmstart": p.warmstart}
        parts |= {"mocap position": p.mocap[0], "mocap quaternion": p.mocap[1]}
        parts |= {
            "length": self.episode_length_buf,
            "return": self._return,
            "stage": self.stage,
            "from start": self._from_start,
        }
        parts |= {
            "stages met": self._stages_met,
            "steps within": self._steps_within,
            "steps at rest": self._steps_at_rest,
            "success average": self._success_average,
            "history": self.history,
        }
        estimated = {} if self.estimate is None else self.estimate.memory
        return parts | p.memory | self._initial.memory | estimated

    def parts(self) -> tuple[Callable[[], None], ...]:
        """Return the parts of a step in order, for profiling: commands, physics, distances, rewards and resets, poses
        and distances of the new states, observation.
        """
        return (
            self._command, self.physics.advance, self._measured.launch, self._evaluate, self._update_poses_and_pairs,
            self._sense_and_observe,
        )  # fmt: skip

    def relative_position(self) -> torch.Tensor:
        """Return the position of object 1 in the frame of object 2 [m], shape (N, 3)."""
        position, quaternion = self.physics.position, self.physics.quaternion
        first, second = self.task.objects[:2]
        return rotate_vectors(invert_quaternion(quaternion[:, second]), position[:, first] - position[:, second])

    def _apply_action(self) -> None:
        """Compute commands from the action, and store the state before the step."""
        p = self.physics
        action = self.action.clamp_(-1, 1)
        for copy, value in zip(self._before, (p.qpos, p.qvel, p.ctrl), strict=True):
            copy.copy_(value)
        for copy, value in zip(self._pose_before, self._object_poses(), strict=True):
            copy.copy_(value)
        joints = len(self._arm)
        moved = p.ctrl[:, self._arm] + action[:, :joints] * self._step[:joints]
        at = p.qpos[:, self._arm_qpos].float() + self._hold
        moved = torch.clamp(moved, at - self._lead, at + self._lead)
        p.ctrl[:, self._arm] = moved.clamp(self._range[self._arm, 0], self._range[self._arm, 1])
        if len(self._gripper):
            opened = p.ctrl[:, self._gripper] + action[:, joints:] * self._step[joints:]
            p.ctrl[:, self._gripper] = opened.clamp(self._range[self._gripper, 0], self._range[self._gripper, 1])
        if self._perturbation_std is not None:
            self._perturb_object(self._perturbation_std)

    def _perturb_object(self, deviation: torch.Tensor) -> None:
        """Apply random forces and torques of standard deviations (6,) to object 1 in some worlds that grasp it."""
        grasped = self._frames[self.stage.long(), 0] > 0
        hit = grasped & (
            torch.rand(self.num_envs, device=self.device) < self._settings.randomisation.perturbation_share
        )
        wrench = torch.randn(self.num_envs, 6, device=self.device) * deviation * self._perturbing
        self.physics.wrench[:, self.task.objects[0]] = wrench * hit[:, None]

    def _object_poses(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the objects' poses, relative to the hand if the stage grasps them: (N, O, 3) [m] and (N, O, 4)."""
        position, quaternion = self.physics.position, self.physics.quaternion
        frame = self._frames[self.stage.long()]
        return relative_pose(
            position[:, self._objects],
            quaternion[:, self._objects],
            position[self._worlds, frame],
            quaternion[self._worlds, frame],
        )

    def _measure(self) -> None:
        """Launch the kernels of contact pairs and virtual collisions."""
        self._pairs.launch()
        if self._virtual is not None:
            self._virtual.launch()

    def _evaluate_step(self) -> None:
        """Compute rewards, advance stages, end episodes and start new ones."""
        p, cfg, stage = self.physics, self._settings.reward, self.stage.long()
        valid = (
            (self._finite > 0)
            & (p.qpos.abs() < self._settings.max_position).all(dim=1)
            & (p.qvel.abs() < self._settings.max_velocity).all(dim=1)
        )
        # The simulators replace commands that are not finite.
        valid &= p.ctrl.isfinite().all(dim=1)
        diverged = ~valid
        dropped = ((self._distance > self._max_grasp_gap) & self._watched[stage]).any(dim=1) & valid
        if len(self._objects) > 1:
            dropped |= (torch.linalg.vector_norm(self.relative_position(), dim=1) > self._max_object_gap) & valid
        severe = torch.zeros_like(valid) if self._severe is None else (self._severe > 0) & valid
        failed = diverged | dropped | severe
        self.failure.copy_(torch.stack([dropped, severe & ~dropped, diverged], dim=1))
        if self._target is None:
            self.success.copy_((self._worst < self._max_deviation) & valid)
        else:
            self.success.copy_(((self.relative_position() - self._target).abs() < self._max_deviation).all(dim=1))
        lead = (p.ctrl[:, self._arm] - p.qpos[:, self._arm_qpos].float() - self._hold) / self._lead
        effort = effort_penalties(cfg, self.action, p.qvel[:, self._arm_dof].float(), lead)
        disturb = disturbance_penalty(cfg, self._pose_before, self._object_poses())
        reaching, before = cfg.reach * self._reaching(), (self.stage - self.task.first).float()
        completed = self._advance_stages(valid & ~failed)
        weighted = [reaching, cfg.stage * before + cfg.completion * completed]
        weighted += [cfg.regularisation * t for t in (*effort, disturb)]
        strictness = cfg.lenience + (1 - cfg.lenience) * self._success_average.square()
        weighted += [cfg.vcp * strictness * self._penalty, self._none]
        terms = torch.where(diverged[:, None], 0.0, torch.stack(weighted, dim=1))
        terms[:, -1] = -cfg.failure * strictness * failed
        self.terms.copy_(terms)
        self.reward.copy_(cfg.scale / len(self.task.chained) * terms.sum(dim=1))

        self.episode_length_buf += 1
        self._return += self.reward
        over, rested = self.episode_length_buf >= self.max_episode_length, self._steps_at_rest >= self._rest
        self.time_out.copy_(over & ~rested & ~failed)
        self.done.copy_(failed | rested | over)
        self._divergence.record(diverged, (*self._before, *p.mocap, self._worlds))
        self._count(terms)
        state = p.qpos, p.qvel, p.ctrl, *p.mocap, self.stage
        moving = valid & ~self.done & ~self.success
        self._initial.keep_stuck(state, self._worst, moving, self._perturbing)
        self._started.zero_()
        self._start(self.done)

    def _reaching(self) -> torch.Tensor:
        """Return the reaching reward of each world's stage, shape (N,)."""
        cfg, chained = self._settings.reward, self._is_chain
        reach = self._reach.sum(dim=1)
        if chained:
            reach = reach + (self._worst_pair >= 0) * cfg.wide[0] * torch.exp(-self._worst / cfg.wide[1])
        if cfg.kind != "engineered":
            return reach
        engineered = engineered_reward(cfg.engineered, self.relative_position())
        return torch.where(self.stage == self.task.stage, engineered, reach) if chained else engineered

    def _advance_stages(self, valid: torch.Tensor) -> torch.Tensor:
        """Advance worlds that met their target to the next stage, and count the steps of object 1 in place.

        Args:
            valid: Worlds without failure, shape (N,) bool.

        Returns:
            Whether a stage is completed, shape (N,) bool: of a chain's last stage, whether object 1 has come to rest.
        """
        chain = self._settings.chain
        # The controller moves on by what it observes, not by the truth.
        near = (self._worst_pair >= 0) & (self._seen_worst < chain.tolerance) & valid
        self._steps_within.copy_(torch.where(near, self._steps_within + 1, 0))
        met = self._steps_within >= chain.hold
        self._stages_met.copy_(torch.maximum(self._stages_met, self.stage - self.task.first + met))
        self.reached.copy_(self._stages_met)
        onward = met & (self.stage < self.task.stage)
        self.stage += onward
        self._steps_within.masked_fill_(onward, 0)
        if self._is_chain:
            self._steps_at_rest.copy_(torch.where(self.success & valid, self._steps_at_rest + 1, 0))
        return onward | (self._steps_at_rest >= self._rest)

    def _count(self, terms: torch.Tensor) -> None:
        """Add a step to the sums of the log, and update the running success rate."""
        p, ended = self.physics, self.done.double()
        succeeded = self.success & self.done & ~self.failure.any(dim=1)
        chains = self.done & self._from_start
        # Exponential average: earlier episodes weigh 1 / e once as many episodes as worlds have ended.
        keep = torch.exp(-ended.sum() / self.num_envs)
        share = succeeded.double().sum() / ended.sum().clamp(min=1.0)
        self._success_average.copy_(torch.lerp(share, self._success_average.double(), keep))
        outcomes = [succeeded, self.time_out, *self.failure.unbind(dim=1)]
        sums = [(ended * self._return).sum(), (ended * self.episode_length_buf).sum()]
        counts = [chains, chains & succeeded, *(chains & (self.reached > k) for k in range(len(self.task.chained)))]
        self._log.add(terms, ended, outcomes, sums, [*counts, (p.overflow & p.dropping) != 0])
        p.overflow.zero_()

    def _start(self, mask: torch.Tensor, rows: torch.Tensor | None = None) -> None:
        """Start episodes in the worlds of a mask (N,) bool, from initial states of rows (N,), by default random."""
        p = self.physics
        if rows is None:
            rows = self._initial.sample(self._success_average * self._perturbing)
        states = (p.qpos, p.qvel, p.ctrl, *p.mocap, self.stage, self._from_start)
        for state, given in zip(states, self._initial.at(rows), strict=True):
            shaped = mask.view(-1, *[1] * (state.ndim - 1))
            state.copy_(torch.where(shaped, given.to(state.dtype), state))
        self._started.logical_or_(mask)
        self._initial.forget_progress(mask)
        p.warmstart.copy_(torch.where(mask[:, None], 0.0, p.warmstart))
        self._stages_met.copy_(torch.where(mask, self.stage - self.task.first, self._stages_met))
        for counter in (self._steps_within, self._steps_at_rest, self.episode_length_buf, self._return):
            counter.masked_fill_(mask, 0)
        p.reset_commands(mask)

    def _read_base(self) -> None:
        """Write the parts before the slots to the observations; a kernel has written the slots."""
        self.truth[:, : self.layout.base] = self._base.read(self.physics)
        if self.estimate is not None:
            self.observation[:, : self.layout.base] = self._base.read(self.estimate)

    def _keep_observation(self) -> None:
        """Put the present observation first in the history; where an episode starts, it has always been so."""
        present = self.observation[:, None]
        self.history[:, 1:] = torch.where(self._started[:, None, None], present, self.history[:, :-1])
        self.history[:, :1] = present

    def _read_encoders(self) -> None:
        """Read the joints."""
        if self.estimate is not None:
            self.estimate.read_encoders(self._started)

    def _track_objects(self) -> None:
        """Update the estimated poses of the objects."""
        if self.estimate is not None:
            self.estimate.track_objects(self._started, self._frames[self.stage.long()] > 0)
