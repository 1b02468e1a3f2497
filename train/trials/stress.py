"""The stress test: success of a policy in the model's best physics under worse conditions than in training.

Success in the physics of the training says little about Reality: all policies reach it. What differs is how a policy
fares where edges catch: sharp edges, stiff contacts and short steps, with friction high or low. Objects collide as the
geoms of the scene do: fitted spheres differ from model to model in how hard they are, so that success among them says
little about the policy. The test uses the model alone, so that a policy can be chosen by it before any trial.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

from concent_warp.train.cfg import EnvironmentCfg, StressCfg, TrainCfg
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.worlds import make_environment
from concent_warp.train.resets.sample import sample_reset_states
from concent_warp.train.task.nominal_shapes import with_nominal_shapes
from concent_warp.train.task.task import Task
from concent_warp.train.trials.episodes import PolicyFunction
from concent_warp.train.trials.evaluate import Evaluation, run_episodes

SEED, OTHER_SEED = 2_000_000, 3_000_000
"""Added to a training's seed, or to another one, for the initial states and worlds of a test."""


class StressTest:
    """A stress test of the policies of one training; the worlds are made when they are first needed."""

    def __init__(
        self,
        cfg: TrainCfg,
        make_task: Callable[[EnvironmentCfg], Task],
        *,
        device: str | None = None,
        episodes: int | None = None,
        seed: int | None = None,
    ) -> None:
        """Sample the initial states.

        Args:
            cfg: Settings of the training.
            make_task: Builds its task with other settings of the environment.
            device: Warp's name of the device; by default the first CUDA device, or the CPU.
            episodes: Number of episodes; that of the settings by default.
            seed: Seed of initial states and worlds; by default that of the training, by which its policy was chosen.
        """
        self._stress, self._device = cfg.stress, device
        self._made: Environment | None = None
        self._episodes = cfg.stress.episodes if episodes is None else episodes
        self._cfg = stressed(cfg.environment, cfg.stress)
        self._task = make_task(self._cfg)
        self._physical = with_shapes(self._task, cfg.stress)
        self._seed = SEED + cfg.seed if seed is None else OTHER_SEED + seed
        reset = replace(self._cfg.reset, demonstrated=0.0, grasp_turn=0.0, free=1.0)  # as in evaluations
        self._states = sample_reset_states(self._task, reset, self._seed, count=self._episodes)

    @property
    def environment(self) -> Environment:
        """The worlds."""
        if self._made is None:
            cfg = replace(self._cfg, worlds=self._episodes)
            stress = self._stress
            self._made = make_environment(
                self._physical, cfg, self._states, device=self._device, seed=self._seed, refine=stress.refine,
                time_constant=stress.time_constant,
            )  # fmt: skip
            self._made.perturbs_trials = True
        return self._made

    def __call__(self, policy: PolicyFunction, progress: Callable[[float], None] | None = None) -> Evaluation:
        """Return the outcomes of a policy's episodes; they are repeated where the simulator had dropped contacts."""
        while True:
            environment = self.environment
            environment.read_log()
            found = run_episodes(environment, policy, self._states, progress=progress)
            buffers = environment.buffers
            if not environment.read_log()["overflow"] or buffers is None:
                return found
            warnings.warn("contacts were dropped in the stress test: the episodes are repeated", stacklevel=2)
            self._cfg = replace(self._cfg, nconmax=2 * buffers[0], njmax=2 * buffers[1])
            self._made = None


def with_shapes(task: Task, stress: StressCfg) -> Task:
    """Return a task whose objects have the shapes of the test."""
    return (with_nominal_shapes(task) if stress.shapes == "nominal" else None) or task


def stressed(cfg: EnvironmentCfg, stress: StressCfg) -> EnvironmentCfg:
    """Return the settings of the test's environment; conditions are those of the test, however a policy was trained."""
    r, t = cfg.randomisation, stress
    harder = replace(
        r, friction=t.friction, grip=t.grip, stiffness=t.stiffness, mass=t.mass, perturbation=t.perturbation,
        extremes=True,
    )  # fmt: skip
    return replace(
        cfg,
        collision="full",
        virtual=replace(cfg.virtual, points=0),
        cone="elliptic",
        stride=1,
        nconmax=None,  # what was enough for fewer spheres
        njmax=None,
        edges=t.edges,
        randomisation=harder,
        observation=replace(cfg.observation, sensors=t.sensors),
        reset=replace(cfg.reset, stuck=replace(cfg.reset.stuck, share=0.0)),
    )
