"""Recordings of given motions in Reality: initial states and commands, as ``concent suggest`` writes them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace

import mujoco
import numpy as np

from concent_warp.checks import check_seed, check_settings
from concent_warp.errors import ConcentError, RecordingError
from concent_warp.reality.expert.plan import Task
from concent_warp.reality.record import RealityCfg, sensed_motion
from concent_warp.reality.rigs.rig import Rig, RigTrial, recorded_trial
from concent_warp.reality.run import simulate, simulate_to_rest
from concent_warp.reality.world import HiddenEffect
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.payloads import fasten
from concent_warp.scene.scene import Scene

SETTLING_TIME = 0.3
"""Time for which the first commands act before a robot's motion, so that it comes to rest [s]."""
NEAR = 1e-3
"""Distance within which something carries a body [m]."""
STREAM = 7
"""Of the random numbers, apart from those of demonstrations with the same seed."""


def record_rig_motion(rig: Rig, motion: Recording, effects: Sequence[HiddenEffect] = (), seed: int = 0) -> Recording:
    """Return what a rig's instruments record of given motions.

    Args:
        rig: The experiment.
        motion: Initial states and commands, a demonstration each.
        effects: Hidden effects.
        seed: Seed of clocks and noise.

    Raises:
        ConcentError: The motion is of another scene, or the rig performs no given motions.
    """
    check_seed(seed)
    if rig.recorder is not None:
        raise ConcentError(f"the rig {rig.name} performs the motions of its scripted expert only", fix="take --task")
    _check_scene(motion, rig.scene)
    taken = []
    for k, d in enumerate(motion.demonstrations):
        model = _loaded(rig.world(effects), d).compile()
        trial = RigTrial(
            d.duration,
            {name: (c.time, np.asarray(c.value, dtype=float).ravel()) for name, c in d.action.items()},
            qpos=_by_joint(rig.scene.model, d.qpos, velocity=False),
            qvel=_by_joint(rig.scene.model, d.qvel, velocity=True),
            settling_time=SETTLING_TIME if d.action and _is_carried(rig.scene.model, d) else 0.0,
        )
        rng = np.random.default_rng([seed, STREAM, k])
        taken.append(replace(recorded_trial(rig, model, trial, effects, rng, f"demo_{k}"), payloads=d.payloads))
    return Recording(rig.scene.xml, tuple(taken), source=f"reality rig {rig.name}")


def record_motion(
    cfg: RealityCfg,
    motion: Recording,
    *,
    task: Task | None = None,
    effects: tuple[HiddenEffect, ...] = (),
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> Recording:
    """Return a recording of given motions in the scene of a task.

    Args:
        cfg: Settings.
        motion: Initial states and commands, a demonstration each.
        task: The task whose scene it is; the shape sorter `cfg.task` by default.
        effects: Hidden effects.
        seed: Seed of the noise.
        progress: Called with the share done, 0..1.

    Raises:
        ConcentError: The motion is of another scene, or a setting is out of bounds.
    """
    check_settings(cfg)
    check_seed(seed)
    scene = (task or cfg.task).build()
    _check_scene(motion, scene)
    world = cfg.world.build(scene, effects)
    taken, count = [], len(motion.demonstrations)
    for k, d in enumerate(motion.demonstrations):
        loaded = _loaded(world, d)
        model = loaded.compile()
        rng, data = np.random.default_rng([seed, STREAM, k]), mujoco.MjData(model)
        nominal = scene.model
        for joint, value in _by_joint(nominal, d.qpos, velocity=False).items():
            data.qpos[model.joint(joint).qposadr[0] :][: len(value)] = value
        mujoco.mj_forward(model, data)
        time, action = _sampled(model, d)
        if d.action and _is_carried(nominal, d):
            simulate_to_rest(model, data, action[0], effects, SETTLING_TIME)
        for joint, value in _by_joint(nominal, d.qvel, velocity=True).items():
            if any(value):
                data.qvel[model.joint(joint).dofadr[0] :][: len(value)] = value
        qpos, qvel = _nominal_state(nominal, model, data)
        log = simulate(
            cfg.sensing, scene, model, data, time, action, effects, rng,
            None if progress is None else lambda share, k=k: progress((k + share) / count),
        )  # fmt: skip
        sensed = sensed_motion(cfg, scene, loaded, model, log, effects, rng)
        actions = {model.actuator(i).name: Channel(time, action[:, i]) for i in range(model.nu)}
        made = Demonstration(f"demo_{k}", d.task, None, qpos, qvel, actions, *sensed)
        taken.append(replace(made, payloads=d.payloads))
    return Recording(scene.xml, tuple(taken), source="reality")


def _loaded(world: mujoco.MjSpec, d: Demonstration) -> mujoco.MjSpec:
    """Return Reality in which bodies carry the payloads of a motion."""
    if not d.payloads:
        return world
    loaded = world.copy()
    fasten(loaded, d.payloads)
    return loaded


def renumbered(recordings: Sequence[Recording]) -> Recording:
    """Return the demonstrations of recordings of the same scene as one recording, named by number."""
    every = [d for recording in recordings for d in recording.demonstrations]
    named = tuple(replace(d, name=f"demo_{k}") for k, d in enumerate(every))
    return replace(recordings[0], demonstrations=named)


def _check_scene(motion: Recording, scene: Scene) -> None:
    """Check that motions are of a scene.

    Raises:
        RecordingError: Joints or actuators differ, or a motion has no initial state.
    """
    own, theirs = scene.model, Scene(motion.scene, source=motion.source).model
    for kind, count in (("joint", "njnt"), ("actuator", "nu")):
        names = [[getattr(m, kind)(i).name for i in range(getattr(m, count))] for m in (own, theirs)]
        if names[0] != names[1]:
            raise RecordingError(
                "the motion is of another scene than Reality's",
                where=motion.source,
                expected=f"{kind}s {names[0]}",
                found=names[1],
                fix="give the --task or --rig, and the --robot, of the first recording",
            )
    for d in motion.demonstrations:
        if d.qpos is None or d.duration <= 0:
            raise RecordingError(
                "the motion has no initial positions or no duration",
                where=f"{motion.source}: {d.name}",
                fix="give a motion file as concent suggest writes it",
            )
        if d.action and sorted(d.action) != sorted(own.actuator(i).name for i in range(own.nu)):
            raise RecordingError(
                "the motion does not command every actuator", where=f"{motion.source}: {d.name}", found=sorted(d.action)
            )


def _by_joint(m: mujoco.MjModel, state: np.ndarray | None, *, velocity: bool) -> dict[str, list[float]]:
    """Return the part of each joint of a state, qpos (nq,) or qvel (nv,)."""
    if state is None:
        return {}
    sizes = {0: (7, 6), 1: (4, 3)}
    address = m.jnt_dofadr if velocity else m.jnt_qposadr
    return {
        m.joint(j).name: np.asarray(state)[address[j] :][: sizes.get(int(m.jnt_type[j]), (1, 1))[velocity]].tolist()
        for j in range(m.njnt)
    }


def _is_carried(m: mujoco.MjModel, d: Demonstration) -> bool:
    """Return whether every free body rests on something at the start of a motion, and so may be left to settle."""
    near = copy(m)
    near.geom_margin[:] = np.maximum(near.geom_margin, NEAR)
    data = mujoco.MjData(near)
    data.qpos[:] = d.qpos
    mujoco.mj_forward(near, data)
    touching = {int(b) for b in m.geom_bodyid[data.contact.geom].ravel()}
    free = m.jnt_bodyid[m.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)]
    still = d.qvel is None or not np.any(np.asarray(d.qvel)[_free_dofs(m)])
    return still and all(int(b) in touching for b in free)


def _free_dofs(m: mujoco.MjModel) -> np.ndarray:
    """Return the degrees of freedom of free bodies."""
    free = m.jnt_dofadr[m.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)]
    return (free[:, None] + np.arange(6)).ravel()


def _sampled(model: mujoco.MjModel, d: Demonstration) -> tuple[np.ndarray, np.ndarray]:
    """Return the commands of all actuators at common times (T,) [s], shape (T, nu)."""
    time = np.unique(np.concatenate([np.array([0.0, d.duration]), *(c.time for c in d.action.values())]))
    action = np.zeros((len(time), model.nu))
    for i in range(model.nu):
        c = d.action.get(model.actuator(i).name)
        if c is not None:
            rows = np.maximum(np.searchsorted(c.time, time + 1e-9, side="right") - 1, 0)
            action[:, i] = np.asarray(c.value).ravel()[rows]
    return time, action


def _nominal_state(
    nominal: mujoco.MjModel, model: mujoco.MjModel, data: mujoco.MjData
) -> tuple[np.ndarray, np.ndarray]:
    """Return the state of the nominal scene's joints in Reality, qpos (nq,) and qvel (nv,)."""
    qpos, qvel = np.zeros(nominal.nq), np.zeros(nominal.nv)
    for j in range(nominal.njnt):
        name = nominal.joint(j).name
        own = model.joint(name)
        size = len(own.qpos0)
        width = {7: 6, 4: 3}.get(size, 1)
        qpos[nominal.jnt_qposadr[j] :][:size] = data.qpos[own.qposadr[0] :][:size]
        qvel[nominal.jnt_dofadr[j] :][:width] = data.qvel[own.dofadr[0] :][:width]
    return qpos, qvel
