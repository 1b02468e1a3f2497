"""What a trial says about the policy itself: limits of its commands, unusual observations, actions asked again."""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDict

from concent_warp.recording.recording import Demonstration
from concent_warp.train.policy.load import Policy
from concent_warp.train.task.task import Task
from concent_warp.train.trials.episodes import PolicyFunction

SATURATED = 0.99
"""Magnitude of an action from which on it is at its limit."""
UNUSUAL = 4.0
"""Standard deviations of the observations in training from which on one is unusual."""


def limits_reached(task: Task, demonstration: Demonstration, joints: np.ndarray, at: float) -> dict[str, float | None]:
    """Return the shares of a trial in which commands, leads and actions were at their limits.

    Args:
        task: The policy's task.
        demonstration: The trial.
        joints: Readings of the arm's joints at the times of the commands, shape (T, J).
        at: Share of a limit from which on it counts as reached.
    """
    m, robot = task.compiled, task.robot
    names = [m.actuator(int(a)).name for a in robot.actuator]
    command = np.stack([demonstration.action[name].value for name in names], axis=1)
    lead = np.abs(command - joints) / robot.lead
    low, high = m.actuator_ctrlrange[robot.actuator].T
    limited = m.actuator_ctrllimited[robot.actuator].astype(bool)
    ranged = ((command <= low + 1e-6) | (command >= high - 1e-6)) & limited
    log = demonstration.policy
    saturated = None if log is None else float((np.abs(log.action) > SATURATED).mean())
    return {
        "lead at limit": float((lead > at).any(axis=1).mean()),
        "command at limit": float(ranged.any(axis=1).mean()),
        "action at limit": saturated,
    }


def unusual_observations(policy: Policy, demonstration: Demonstration) -> float | None:
    """Return the share of observed numbers far from those of training; None without a log or a normalisation."""
    log, weights = demonstration.policy, policy.weights["actor_state_dict"]
    if log is None or "obs_normalizer._mean" not in weights:
        return None
    mean, std = (weights[f"obs_normalizer.{name}"].cpu().numpy()[0] for name in ("_mean", "_std"))
    if log.observation.shape[1] != len(mean):
        return None
    return float((np.abs(log.observation - mean) > UNUSUAL * np.maximum(std, 1e-3)).mean())


def other_action(act: PolicyFunction, observations: int, demonstration: Demonstration) -> float | None:
    """Return by how much the policy, asked again, would act otherwise than logged [-]; None without a log."""
    log = demonstration.policy
    if log is None:
        return None
    if log.observation.shape[1] != observations:
        return float("inf")
    observed = torch.as_tensor(log.observation, dtype=torch.float32)
    with torch.inference_mode():
        action = act(TensorDict({"policy": observed}, batch_size=[len(observed)])).clamp(-1, 1).numpy()
    return float(np.abs(action - log.action).max()) if action.shape == log.action.shape else float("inf")
