"""Phases of a demonstration: named spans of time.

Contact stages (`concent_warp.events`) describe how a robot brings objects together. Where it does not (`has_task`) - a
toss, a push, a pendulum - the replay is parted by how things move: the contacts that it has and how fast they slip.

| phase | an object, or without any the whole machine: all links that joints connect |
|---|---|
| free | touches nothing |
| impact | is in contact and is jolted harder than any drive would |
| slide | slips over what it touches |
| stick | moves on what it touches without slipping: it rolls, or is carried along |
| grasped | is held: the robot presses on it from opposite sides |
| rest | does not move |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from concent_warp.checks import PositiveDuration, Share
from concent_warp.events.adhesion import adhesion_pull
from concent_warp.events.filter import drop_short_contacts, steps_of, true_runs, window_sums
from concent_warp.events.grasp import forces_cancel
from concent_warp.events.roles import Roles
from concent_warp.events.staging import ROBOT
from concent_warp.events.touches import BodyPoses, ReplayContacts

if TYPE_CHECKING:
    import mujoco

    from concent_warp.model import Model
    from concent_warp.simulate.engine import Rollout

IMPACT, SLIDE, GRASPED, FREE, STICK, REST = "impact", "slide", "grasped", "free", "stick", "rest"
MOTIONS: tuple[str, ...] = (IMPACT, SLIDE, GRASPED, FREE, STICK, REST)
"""What a body may do. With several bodies, a demonstration does what comes first here of what any of them does."""


@dataclass(frozen=True)
class MotionPhaseCfg:
    """Settings of the division of a replay by how bodies move.

    Example:
        >>> import concent_warp as cw
        >>> cw.CompareCfg().motion_phases.slide_speed
        0.005
    """

    slide_speed: float = 0.005
    """Tangential speed above which a contact slips [m/s]."""
    rest_speed: float = 0.004
    """A body rests while its fastest point is slower than this [m/s]."""
    min_rest: float = 0.1
    """Shortest rest [s]; a shorter one is a reversal of the motion."""
    impact_acceleration: float = 25.0
    """Mean acceleration over `impact_window` of the fastest point of a body in contact that is an impact [m/s^2]; more
    than drives reach."""
    impact_window: PositiveDuration = 0.01
    """Length of the windows over which that acceleration is averaged [s]."""
    impact_extension: float = 0.02
    """Time by which an impact lasts longer than the acceleration [s], so that measurements fall within it."""
    majority_window: PositiveDuration = 0.03
    """Length of the windows whose most frequent phase each instant takes, impacts excepted [s]."""
    grasp_window: PositiveDuration = 0.1
    """Length of the windows over which forces of the robot on an object are added [s]."""
    grasp_share: Share = 0.5
    """Forces of the robot that add up to less than this share of their magnitudes grasp an object [-]."""


@dataclass(frozen=True)
class Phase:
    """A span of a demonstration: a contact stage, what comes before the first, or a way of moving."""

    name: str
    start: float
    """First instant [s]; the first phase has no beginning."""
    end: float
    """First instant after it [s]; the last phase has no end."""


class StageLike(Protocol):
    """A named span of time, such as a stage of a contact event sequence."""

    @property
    def name(self) -> str:
        """Name."""
        ...

    @property
    def start(self) -> float:
        """First instant [s]."""
        ...

    @property
    def end(self) -> float:
        """First instant after it [s]."""
        ...


class ContactStage(StageLike, Protocol):
    """A stage of a contact event sequence."""

    @property
    def bodies(self) -> tuple[str, str]:
        """Who opened it by touching whom; "robot" for any of its links."""
        ...


def has_task(stages: Mapping[str, Sequence[ContactStage]]) -> bool:
    """Return whether contact stages, by demonstration, part what a robot does: it opens one of two or more of them."""
    return any(len(found) > 1 and any(ROBOT in s.bodies for s in found) for found in stages.values())


def phases_by_body(
    model: Model,
    compiled: mujoco.MjModel,
    rollout: Rollout,
    cfg: MotionPhaseCfg | None = None,
    ctrl: np.ndarray | None = None,
) -> dict[str | None, tuple[Phase, ...]]:
    """Return the phases of motion over a replay, without gaps: of each object, or of each machine, under the names of
    its links, where there is no object, and under None of all of them together.

    A machine is in contact where any of its links is, and rests where all do.

    Args:
        model: The model.
        compiled: The same as the engine compiled it.
        rollout: One variant, NumPy, all steps and bodies recorded, contacts "all".
        cfg: Settings.
        ctrl: Commands, shape (K, nu), of which those of suction cups say when they hold an object; none by default.
    """
    cfg = cfg or MotionPhaseCfg()
    steps = len(rollout.step) - 1
    if rollout.diverged[0] or rollout.contacts is None or steps < 1:
        return {None: (Phase(FREE, -np.inf, np.inf),)}
    roles = Roles.of(compiled, model)
    motion = BodyPoses.of(rollout, roles.bodies, float(rollout.time[1] - rollout.time[0]), steps)
    pull = None if ctrl is None else adhesion_pull(compiled, rollout.contacts, ctrl)
    touches = ReplayContacts.of(rollout.contacts, roles, pull=pull)
    movable, speeds = np.flatnonzero(compiled.body_weldid != 0), Speeds.of(motion, compiled)
    groups = [[b] for b in roles.ids("object") if b in movable] or _machines(compiled, movable)
    found, together = {}, np.full(motion.steps, MOTIONS.index(REST))
    for bodies in groups:
        state = _state(bodies, touches, motion, speeds, roles, cfg)
        together = np.minimum(together, state)
        spans = _spans(state, motion.timestep)
        found |= {roles.bodies[b]: spans for b in bodies}
    return {None: _spans(together, motion.timestep), **found}


def _machines(compiled: mujoco.MjModel, movable: np.ndarray) -> list[list[int]]:
    """Return movable bodies by what joints connect: those with the same first moving body below them."""
    root = np.zeros(compiled.nbody, dtype=int)
    for b in movable:
        parent = int(compiled.body_parentid[b])
        root[b] = root[parent] or b
    return [movable[root[movable] == r].tolist() for r in np.unique(root[movable])]


@dataclass(frozen=True)
class Speeds:
    """Velocities of all bodies at every step, from the poses at the ends of the step."""

    linear: np.ndarray
    """Of the body frames' origins [m/s], world frame, shape (K, nbody, 3)."""
    angular: np.ndarray
    """[rad/s], world frame, shape (K, nbody, 3)."""
    reach: np.ndarray
    """Distance of the farthest point of each body from its frame's origin [m], shape (nbody,), see `_reaches`."""

    @staticmethod
    def of(motion: BodyPoses, compiled: mujoco.MjModel) -> Speeds:
        """Differentiate the poses; the last step repeats the one before it."""
        linear = np.diff(motion.position, axis=0) / motion.timestep
        turn = np.einsum("kbij,kblj->kbil", motion.rotation[1:], motion.rotation[:-1])
        skew = (
            np.stack(
                [
                    turn[..., 2, 1] - turn[..., 1, 2],
                    turn[..., 0, 2] - turn[..., 2, 0],
                    turn[..., 1, 0] - turn[..., 0, 1],
                ],
                axis=-1,
            )
            / 2
        )
        angular = skew / motion.timestep
        if not len(linear):
            linear = angular = np.zeros((1, *motion.position.shape[1:]))
        else:
            linear, angular = (np.concatenate([v, v[-1:]]) for v in (linear, angular))
        return Speeds(linear, angular, _reaches(compiled))

    def at(self, body: np.ndarray, step: np.ndarray, arm: np.ndarray) -> np.ndarray:
        """Return velocities [m/s], shape (C, 3), of points at `arm` (C, 3) [m] from the origins of `body` (C,)."""
        return self.linear[step, body] + np.cross(self.angular[step, body], arm)

    def fastest(self, body: int) -> np.ndarray:
        """Return a bound on the speed of any point of a body [m/s], shape (K,)."""
        spin = np.linalg.norm(self.angular[:, body], axis=1)
        return np.linalg.norm(self.linear[:, body], axis=1) + self.reach[body] * spin

    def jolt(self, body: int, width: int) -> np.ndarray:
        """Return the change of velocity over windows of `width` steps [m/s], shape (K,), that any point may feel."""
        change = np.zeros(len(self.linear))
        for v, arm in ((self.linear[:, body], 1.0), (self.angular[:, body], self.reach[body])):
            padded = np.pad(v, ((width // 2, width - width // 2), (0, 0)), mode="edge")
            change += arm * np.linalg.norm(padded[width:] - padded[:-width], axis=1)
        return change


def _reaches(compiled: mujoco.MjModel) -> np.ndarray:
    """Return how far the geoms of each body reach from its frame's origin [m], shape (nbody,).

    A body without geoms reaches as far as its radius of gyration beyond its centre of mass.
    """
    reach = np.zeros(compiled.nbody)
    far = np.linalg.norm(compiled.geom_pos, axis=1) + compiled.geom_rbound
    np.maximum.at(reach, compiled.geom_bodyid, np.where(compiled.geom_rbound > 0, far, 0.0))
    gyration = np.sqrt(compiled.body_inertia.max(axis=1) / np.maximum(compiled.body_mass, 1e-12))
    bare = (compiled.body_geomnum == 0) & (compiled.body_mass > 0)
    return np.where(bare, np.linalg.norm(compiled.body_ipos, axis=1) + gyration, reach)


def _state(
    bodies: Sequence[int],
    touches: ReplayContacts,
    motion: BodyPoses,
    speeds: Speeds,
    roles: Roles,
    cfg: MotionPhaseCfg,
) -> np.ndarray:
    """Return what bodies that joints connect do at each step, shape (K,) int: index into `MOTIONS`."""
    dt, steps = motion.timestep, motion.steps
    rows = touches[np.asarray(np.isin(touches.body, bodies).any(axis=1))]
    near = steps_of(cfg.majority_window / 2, dt)
    touching = window_sums(rows.frames(steps).astype(float), near) > 0
    state = np.full(steps, MOTIONS.index(FREE))
    state[touching] = MOTIONS.index(STICK)
    state[touching & (_slip(rows, motion, speeds, cfg.majority_window) > cfg.slide_speed)] = MOTIONS.index(SLIDE)
    fastest = np.max([speeds.fastest(b) for b in bodies], axis=0)
    state[drop_short_contacts(fastest < cfg.rest_speed, steps_of(cfg.min_rest, dt))] = MOTIONS.index(REST)
    hands = rows[np.asarray(np.isin(rows.body, roles.ids("robot")).any(axis=1))]
    if len(hands.step) and all(roles.body_role[b] != "robot" for b in bodies):
        held = hands.frames(steps) & forces_cancel(hands, steps, steps_of(cfg.grasp_window, dt), cfg.grasp_share)
        state[held] = MOTIONS.index(GRASPED)
    state = _prevailing(state, steps_of(cfg.majority_window, dt))
    width = steps_of(cfg.impact_window, dt)
    lasting, jolted = steps_of(cfg.impact_extension, dt), np.zeros(steps, dtype=bool)
    for b in np.intersect1d(bodies, rows.body):
        mine = rows[np.asarray((rows.body == b).any(axis=1))]
        touched = window_sums(mine.frames(steps).astype(float), near) > 0
        jolted |= touched & (speeds.jolt(int(b), width) > cfg.impact_acceleration * width * dt)
    for start, end in true_runs(jolted):
        state[max(start - width, 0) : end + lasting] = MOTIONS.index(IMPACT)
    return state


def _slip(rows: ReplayContacts, motion: BodyPoses, speeds: Speeds, window: float) -> np.ndarray:
    """Return the mean tangential speed of contacts [m/s], weighted by force, over `window` [s], shape (K,)."""
    total = np.zeros((motion.steps, 2))
    if len(rows.step):
        a, b = rows.body.T
        points = (speeds.at(body, rows.step, rows.point - motion.position[rows.step, body]) for body in (a, b))
        relative = np.subtract(*points)
        tangential = relative - np.einsum("ci,ci->c", relative, rows.normal)[:, None] * rows.normal
        weight = rows.force + 1e-9
        np.add.at(total, rows.step, np.stack([weight * np.linalg.norm(tangential, axis=1), weight], axis=1))
    total = window_sums(total, steps_of(window, motion.timestep))
    return total[:, 0] / np.maximum(total[:, 1], 1e-12)


def _prevailing(state: np.ndarray, width: int) -> np.ndarray:
    """Return for each step the state (K,) that most of the `width` steps about it are in."""
    return window_sums(np.eye(len(MOTIONS))[state], width).argmax(axis=1)


def _spans(state: np.ndarray, timestep: float) -> tuple[Phase, ...]:
    """Return the spans of equal `state` (K,); the first has no beginning and the last no end."""
    edges = np.flatnonzero(np.diff(state)) + 1
    starts = [-np.inf, *(edges * timestep).tolist()]
    ends = [*starts[1:], np.inf]
    first = state[np.concatenate([[0], edges])]
    return tuple(Phase(MOTIONS[s], a, b) for s, a, b in zip(first, starts, ends, strict=True))


def stage_phases(stages: Sequence[StageLike], duration: float) -> tuple[Phase, ...]:
    """Return the phases of a demonstration with contact stages: what comes before the first, then they."""
    first = stages[0].start if stages else duration
    found = [Phase(FREE, -np.inf, first)] if first > 0 else []
    found += [Phase(s.name, s.start, s.end) for s in stages]
    found[-1] = Phase(found[-1].name, found[-1].start, np.inf)
    return tuple(found)
