"""A policy in one world, step by step, with the states that a viewer shows."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from concent_warp.simulate.inputs import compile_model
from concent_warp.train.environment.environment import Environment
from concent_warp.train.task.task import Task
from concent_warp.train.trials.episodes import Episodes, PolicyFunction


@dataclass(frozen=True)
class PlayedState:
    """State of the world between two steps."""

    position: np.ndarray
    """Body origins [m], world frame, shape (nbody, 3)."""
    quaternion: np.ndarray
    """Body orientations, wxyz, shape (nbody, 4)."""
    touching: np.ndarray
    """Which spheres of the model touch another body, shape (S,) bool."""
    stage: str
    """Name of the present stage."""
    pairs: np.ndarray
    """Contact points of the stage's target event and their target points [m], world frame, shape (P, 2, 3)."""
    time: float
    """Time since the episode began [s]."""


class Player:
    """Runs episodes of a policy in the first world of an environment."""

    def __init__(self, environment: Environment, policy: PolicyFunction, states: int, touch_gap: float = 5e-4) -> None:
        """Start the first episode.

        Args:
            environment: The worlds.
            policy: From observations to actions, without exploration.
            states: Number of the environment's initial states, from which episodes start in turn.
            touch_gap: Gap below which a sphere counts as touching a body [m].
        """
        self.environment, self.policy = environment, policy
        self.touches = TouchingSpheres(environment.task, touch_gap)
        self.ended: list[str] = []
        """Outcomes of the ended episodes, in order."""
        self._states, self._next = states, 0
        self.begin()

    def begin(self) -> None:
        """Begin an episode from the next initial state."""
        rows = [(self._next + k) % self._states for k in range(self._states)]
        self._episodes = Episodes(self.environment, self.policy, rows)
        self._next = (self._next + 1) % self._states

    def step(self) -> str | None:
        """Act once; return the outcome of the episode if it ends by that, and begin the next one."""
        outcome = self._episodes.step().outcome.get(0)
        if outcome is not None:
            self.ended.append(outcome)
            self.begin()
        return outcome

    def state(self) -> PlayedState:
        """Return the present state."""
        environment, task = self.environment, self.environment.task
        position = environment.physics.position[0].cpu().numpy().astype(float)
        quaternion = environment.physics.quaternion[0].cpu().numpy().astype(float)
        stage = int(environment.stage[0])
        return PlayedState(
            position=position,
            quaternion=quaternion,
            touching=self.touches.of(environment.physics.qpos[0].cpu().numpy(), position, quaternion),
            stage=task.events.stages[stage].name,
            pairs=_pairs(task, stage, position, quaternion),
            time=self._episodes.length * environment.control_step,
        )


class TouchingSpheres:
    """Computes which spheres of a model touch a body, those outside the physics included."""

    def __init__(self, task: Task, gap: float) -> None:
        """Compile the model with all of its spheres; `gap` is the distance that counts as contact [m]."""
        self._m, sphere_geom = compile_model(task.model, None)
        self._d = mujoco.MjData(self._m)
        self._m.geom_margin[sphere_geom] = gap
        self._sphere = np.full(self._m.ngeom, -1)
        self._sphere[sphere_geom] = np.arange(len(sphere_geom))
        self._count = len(sphere_geom)

    def of(self, qpos: np.ndarray, position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
        """Return which spheres touch another body, shape (S,) bool.

        Args:
            qpos: Positions, shape (nq,).
            position: Body origins [m], shape (nbody, 3); read for mocap bodies.
            quaternion: Body orientations, shape (nbody, 4), likewise.
        """
        m, d = self._m, self._d
        d.qpos[:] = qpos
        for body in np.flatnonzero(m.body_mocapid >= 0):
            d.mocap_pos[m.body_mocapid[body]], d.mocap_quat[m.body_mocapid[body]] = position[body], quaternion[body]
        mujoco.mj_kinematics(m, d)
        mujoco.mj_collision(m, d)
        touching = np.zeros(self._count, dtype=bool)
        spheres = self._sphere[d.contact.geom]
        touching[spheres[spheres >= 0]] = True
        return touching


def _pairs(task: Task, stage: int, position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Return contact points and target points of a stage's target event [m], world frame, shape (P, 2, 3)."""
    table = task.table
    slots = np.flatnonzero(table.used[stage])
    found = np.zeros((len(slots), 2, 3))
    sides = (table.body_a[stage], table.point_a[stage]), (table.body_b[stage], table.point_b[stage])
    for row, slot in enumerate(slots):
        for side, (body, point) in enumerate(sides):
            turned = np.zeros(3)
            mujoco.mju_rotVecQuat(turned, point[slot], quaternion[body[slot]])
            found[row, side] = position[body[slot]] + turned
    return found
