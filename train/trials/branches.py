"""What a policy would do from the present states on: chunks of commands, by branching the worlds.

A policy that predicts chunks needs, in a state that it got into by itself, the actions that its teacher would take from
there on, which no episode shows. The worlds are copied, stepped with the teacher, and set back (Ross et al., AISTATS
2011, with chunks for labels).
"""

from __future__ import annotations

import torch

from concent_warp.train.environment.environment import Environment
from concent_warp.train.learning.random_state import random_state, restore_random_state
from concent_warp.train.trials.episodes import PolicyFunction


def branched_commands(environment: Environment, policy: PolicyFunction, length: int) -> torch.Tensor:
    """Return the commands that a policy would give in the next steps of all worlds, which stay as they are.

    After the end of an episode its last commands are repeated, as those of a data set are. Random numbers are those
    that the worlds would go on with, and are set back as well.

    Args:
        environment: N worlds.
        policy: From observations to actions, without exploration and without memory of its own.
        length: Steps C.

    Returns:
        Commands of the nu actuators, shape (N, C, nu), on the environment's device.
    """
    device, physics = str(environment.device), environment.physics
    kept, random = environment.state(), random_state(device)
    command, ended = physics.ctrl.clone(), torch.zeros(environment.num_envs, dtype=torch.bool, device=device)
    chunk = command[:, None].repeat(1, length, 1)
    try:
        for step in range(length):
            environment.step(policy(environment.get_observations()))
            ended |= environment.done  # commands of a world that has ended an episode are those of its next one
            command = torch.where(ended[:, None], command, physics.ctrl)
            chunk[:, step] = command
    finally:
        environment.restore(kept)
        restore_random_state(random, device)
    return chunk
