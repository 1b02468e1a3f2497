"""A model and segments of recordings as Newton simulates them: objects as sphere bodies, all else replayed.

Bodies with a free joint and contact geometry are simulated. Everything else, robot links and fixtures, stands where the
MuJoCo rollout of the recorded commands with the starting geometry has it: kinematic bodies. Pairs that may collide are
found once, by MuJoCo's own collision filter, in that rollout and where things were observed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from concent_warp.errors import EngineError, ModelError
from concent_warp.estimation.object_tracks import Segment, observed_states
from concent_warp.fit.newton.physics import BodyInertia, NewtonCfg, NewtonPhysics, choose_physics, coupling
from concent_warp.model import Model
from concent_warp.simulate.engine import Rollout, Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine


@dataclass(frozen=True)
class CollisionPairs:
    """C pairs that may collide; the first shape is a fitted sphere of a simulated body."""

    sphere: np.ndarray
    """Index of the sphere, shape (C,) int."""
    other: np.ndarray
    """Index of the other fitted sphere, -1 where it is a geom, shape (C,) int."""
    body: np.ndarray
    """Bodies by index in `NewtonScene.bodies`, shape (C, 2) int."""
    kind: np.ndarray
    """Kind of the other shape, a number of `mujoco.mjtGeom`, shape (C,) int."""
    frame: np.ndarray
    """Pose of the other geom in its body, position [m] and quaternion xyzw, shape (C, 7); none for fitted spheres."""
    size: np.ndarray
    """MuJoCo's size of the other geom [m], shape (C, 3)."""
    friction: np.ndarray
    """Friction of the other geom [-], shape (C,)."""
    rule: np.ndarray
    """Whose friction counts, shape (C,) int."""

    def __len__(self) -> int:
        return len(self.sphere)

    @property
    def round(self) -> np.ndarray:
        """Radius of the other geom where it is a sphere or a capsule, else 0 [m], shape (C,)."""
        from concent_warp.kernels.newton_contacts import CAPSULE, SPHERE

        return np.where(np.isin(self.kind, (SPHERE, CAPSULE)), self.size[:, 0], 0.0)


@dataclass(frozen=True)
class NewtonScene:
    """All that a rollout in Newton needs, on the host."""

    model: Model
    segments: tuple[Segment, ...]
    physics: NewtonPhysics
    bodies: tuple[str, ...]
    """Names of the bodies of a world: first those simulated, then those replayed."""
    moving: tuple[BodyInertia, ...]
    """The simulated ones, D of them."""
    pairs: CollisionPairs
    start: np.ndarray
    """Poses at the start of each of n segments, position and quaternion xyzw, shape (n, nb, 7)."""
    start_velocity: np.ndarray
    """Linear velocity of the centre of mass, then angular, world frame [m/s, rad/s], shape (n, nb, 6)."""
    replayed: np.ndarray
    """Poses of the replayed bodies at each step, shape (K + 1, n, B, 7)."""
    replayed_velocity: np.ndarray
    """Their velocities, shape (K + 1, n, B, 6)."""
    gravity: np.ndarray
    """[m/s^2], shape (3,)."""
    rollout: Rollout
    """The MuJoCo rollout that was replayed, all steps."""

    @property
    def steps(self) -> int:
        """Newton's steps, K."""
        return len(self.replayed) - 1


def newton_scene(
    model: Model, segments: Sequence[Segment], cfg: NewtonCfg | None = None, *, lightest: float = 1.0
) -> NewtonScene:
    """Prepare a model for gradients of segments of recordings.

    Args:
        model: Model with contact geometry.
        segments: What is simulated.
        cfg: How contacts are simulated.
        lightest: Smallest factor on mass and inertia with which it must be stable, 1 at most.

    Raises:
        ModelError: The model has no contact geometry on a free body, or a shape that Newton's contacts lack comes near.
        EngineError: The scene cannot be simulated stably.
    """
    cfg = cfg or NewtonCfg()
    if model.geometry is None:
        raise ModelError("the model has no contact geometry to fit", fix="build one with `concent geometry`")
    engine = MujocoEngine(model)
    m = engine.compiled
    moving = _moving_bodies(model, m)
    rollout = engine.run(
        Variants(len(segments), qpos=np.stack([s.qpos for s in segments]), qvel=np.stack([s.qvel for s in segments])),
        _padded_commands(segments),
        contacts="all",
    )
    if np.any(rollout.diverged):
        raise EngineError("the starting geometry diverges in MuJoCo, so that nothing can be replayed", fix="change it")
    ids, pairs = _near_pairs(model, moving, _pair_states(m, segments, rollout, cfg.pair_states), cfg.reach)
    inertias = tuple(_inertia_of(m, b) for b in ids[: len(moving)])
    friction = np.concatenate([pairs.friction, model.geometry.friction])
    strengths = [_strength(m, model, b, body, rollout, cfg) / lightest for b, body in zip(ids, inertias, strict=False)]
    gravity = m.opt.gravity.copy()
    physics = choose_physics(
        cfg, m.opt.timestep, inertias, strengths, float(friction.max()), float(np.linalg.norm(gravity))
    )
    pose = np.concatenate([rollout.body_position[:, :, ids], rollout.body_quaternion[:, :, ids][..., [1, 2, 3, 0]]], -1)
    replayed, velocity = _resampled(pose[:, :, len(moving) :], m.opt.timestep, physics.substeps)
    speed = np.zeros((len(segments), len(ids), 6))
    speed[:, len(moving) :] = velocity[0]
    for n, segment in enumerate(segments):
        for b, body in enumerate(inertias):
            speed[n, b] = _velocity_of(m, segment.qvel, ids[b], pose[n, 0, b], body)
            if not _touches(m, rollout, n, ids[b]):
                # Steps of dt fall by g dt t / 2 too far; so do these, with a shorter dt.
                speed[n, b, :3] += gravity * (m.opt.timestep - physics.timestep) / 2
    names = tuple(m.body(b).name for b in ids)
    return NewtonScene(
        model, tuple(segments), physics, names, inertias, pairs, pose[:, 0], speed, replayed, velocity, gravity, rollout
    )


def _moving_bodies(model: Model, m: mujoco.MjModel) -> list[int]:
    """Return the ids of the bodies to simulate: with contact geometry and a free joint."""
    assert model.geometry is not None
    movable = [m.body(name).id for name in model.geometry.bodies if m.body(name).weldid[0] != 0]
    free = int(mujoco.mjtJoint.mjJNT_FREE)
    bound = [b for b in movable if m.body_jntnum[b] != 1 or m.jnt_type[m.body_jntadr[b]] != free]
    if bound or not movable:
        raise ModelError(
            "gradients are for objects that move freely",
            expected="contact geometry on bodies with a free joint",
            found=[m.body(b).name for b in bound] or "none",
            fix="fit with the evolution strategy (--method es)",
        )
    return movable


def _padded_commands(segments: Sequence[Segment]) -> np.ndarray:
    """Return the commands of all segments, padded with the last, shape (n, K, nu)."""
    steps = max(len(s.ctrl) for s in segments)
    return np.stack([np.pad(s.ctrl, ((0, steps - len(s.ctrl)), (0, 0)), mode="edge") for s in segments])


def _pair_states(m: mujoco.MjModel, segments: Sequence[Segment], rollout: Rollout, count: int) -> np.ndarray:
    """Return simulated and observed states, about `count` of each segment, shape (T, nq)."""
    every = slice(None, None, max(rollout.qpos.shape[1] // count, 1))
    simulated = rollout.qpos[:, every]
    observed = [observed_states(m, s, rollout.time[every], q) for s, q in zip(segments, simulated, strict=True)]
    return np.concatenate([simulated, np.stack(observed)]).reshape(-1, m.nq)


def _near_pairs(model: Model, moving: list[int], states: np.ndarray, reach: float) -> tuple[list[int], CollisionPairs]:
    """Return the ids of all bodies that take part, simulated ones first, and the pairs that may collide.

    Args:
        model: Model with contact geometry.
        moving: Ids of the simulated bodies.
        states: States in which pairs are searched for, shape (T, nq).
        reach: Distance between surfaces [m].
    """
    from concent_warp.kernels.newton_contacts import KINDS, LARGER_FRICTION, SHAPE_FRICTION, SPHERE, SPHERE_FRICTION

    assert model.geometry is not None
    names = model.geometry.names()
    spec = model.spec()
    for geom in spec.geoms:
        if geom.name in set(names):
            geom.gap = reach  # contacts within margin + gap are found
    m = model.finish(spec.compile())
    sphere = np.full(m.ngeom, -1)
    sphere[[m.geom(name).id for name in names]] = np.arange(len(names))
    data, found = mujoco.MjData(m), set()
    for qpos in states:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(m, data)
        mujoco.mj_collision(m, data)
        found |= {(int(a), int(b)) for a, b in data.contact.geom[data.contact.dist <= reach]}
    chosen = []
    for a, b in sorted(found):
        simulated = [sphere[g] >= 0 and m.geom_bodyid[g] in moving for g in (a, b)]
        if any(simulated):
            chosen.append((a, b) if simulated[0] else (b, a))
    if not chosen:
        raise ModelError("no sphere of a moving object comes near anything", fix="look whether the scene is right")
    first, second = np.array(chosen).T
    kind = m.geom_type[second]
    if len(odd := np.flatnonzero(~np.isin(kind, KINDS))):
        geom = int(second[odd[0]])
        raise ModelError(
            "a shape comes near an object that gradients cannot collide with",
            where=m.geom(geom).name or m.body(m.geom_bodyid[geom]).name,
            expected="planes, boxes, spheres, capsules or cylinders",
            found=mujoco.mjtGeom(int(kind[odd[0]])).name,
            fix="fit with the evolution strategy (--method es)",
        )
    ids = list(moving) + sorted({int(b) for b in m.geom_bodyid[second]} - set(moving))
    row = {b: k for k, b in enumerate(ids)}
    frame = np.concatenate([m.geom_pos[second], m.geom_quat[second][:, [1, 2, 3, 0]]], axis=1)
    still = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    priority = np.sign(m.geom_priority[second] - m.geom_priority[first])
    return ids, CollisionPairs(
        sphere=sphere[first],
        other=sphere[second],
        body=np.array([[row[int(b)] for b in m.geom_bodyid[g]] for g in (first, second)]).T,
        kind=np.where(sphere[second] >= 0, SPHERE, kind),
        frame=np.where(sphere[second, None] >= 0, still, frame),
        size=m.geom_size[second],
        friction=m.geom_friction[second, 0],
        rule=np.choose(priority + 1, [SPHERE_FRICTION, LARGER_FRICTION, SHAPE_FRICTION]),
    )


def _inertia_of(m: mujoco.MjModel, body: int) -> BodyInertia:
    """Return the inertia of a body."""
    turn = Rotation.from_quat(m.body_iquat[body], scalar_first=True).as_matrix()
    inertia = turn @ np.diag(m.body_inertia[body]) @ turn.T
    return BodyInertia(m.body(body).name, float(m.body_mass[body]), inertia, m.body_ipos[body].copy())


def _strength(
    m: mujoco.MjModel, model: Model, body: int, inertia: BodyInertia, rollout: Rollout, cfg: NewtonCfg
) -> float:
    """Return how strongly the contacts of a body act on it, at the worst step of a rollout with all contacts [1/kg]."""
    assert model.geometry is not None
    assert rollout.contacts is not None
    spheres = model.geometry.position[model.geometry.of(inertia.name)]
    each = [coupling(inertia, point[None]) for point in spheres]
    worst = cfg.min_contacts * float(np.mean(each))
    log = rollout.contacts
    mine = np.flatnonzero((m.geom_bodyid[log.geom] == body).any(axis=1))
    step, count = np.unique(np.stack([log.variant[mine], log.step[mine]]), axis=1, return_counts=True)
    for v, k in step[:, np.argsort(count)[-cfg.pair_states :]].T:
        at = mine[(log.variant[mine] == v) & (log.step[mine] == k)]
        turn = Rotation.from_quat(rollout.body_quaternion[v, k, body], scalar_first=True)
        points = turn.inv().apply(log.position[at] - rollout.body_position[v, k, body])
        worst = max(worst, coupling(inertia, points))
    return worst


def _touches(m: mujoco.MjModel, rollout: Rollout, variant: int, body: int) -> bool:
    """Return whether a body is in contact at the start of a rollout with all contacts."""
    log = rollout.contacts
    assert log is not None
    first = (log.variant == variant) & (log.step == 0)
    return bool((m.geom_bodyid[log.geom[first]] == body).any())


def _velocity_of(m: mujoco.MjModel, qvel: np.ndarray, body: int, pose: np.ndarray, inertia: BodyInertia) -> np.ndarray:
    """Return the velocity of a free body's centre of mass and its turning, world frame, shape (6,)."""
    address = m.jnt_dofadr[m.body_jntadr[body]]
    turn = Rotation.from_quat(pose[3:])
    turning = turn.apply(qvel[address + 3 : address + 6])
    return np.concatenate([qvel[address : address + 3] + np.cross(turning, turn.apply(inertia.com)), turning])


def _resampled(pose: np.ndarray, timestep: float, substeps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return poses and velocities at Newton's steps, of poses at MuJoCo's.

    Args:
        pose: Position [m] and quaternion xyzw, shape (n, T + 1, B, 7).
        timestep: MuJoCo's step [s].
        substeps: Newton's steps in one of them.

    Returns:
        Poses, shape (T * substeps + 1, n, B, 7), and velocities, constant between MuJoCo's steps, (..., 6).
    """
    n, count, b, _ = pose.shape
    coarse = np.arange(count) * timestep
    fine = np.minimum(np.arange((count - 1) * substeps + 1) * (timestep / substeps), coarse[-1])
    result, velocity = np.zeros((len(fine), n, b, 7)), np.zeros((len(fine), n, b, 6))
    row = np.minimum(np.arange(len(fine)) // substeps, count - 2)
    share = (fine - coarse[row]) / timestep
    for i in range(n):
        for k in range(b):
            place, turn = pose[i, :, k, :3], Rotation.from_quat(pose[i, :, k, 3:])
            result[:, i, k, :3] = place[row] + share[:, None] * (place[row + 1] - place[row])
            result[:, i, k, 3:] = Slerp(coarse, turn)(fine).as_quat()
            velocity[:, i, k, :3] = ((place[1:] - place[:-1]) / timestep)[row]
            velocity[:, i, k, 3:] = ((turn[1:] * turn[:-1].inv()).as_rotvec() / timestep)[row]
    return result, velocity
