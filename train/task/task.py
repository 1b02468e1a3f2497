"""What is trained: a model, a demonstration, and the contact events that the policy is to bring about."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np

from concent_warp.errors import TrainError
from concent_warp.events.extract import extract
from concent_warp.events.sequence import ContactEventSequence
from concent_warp.kernels.contact_pairs import PairTable
from concent_warp.model import Model
from concent_warp.recording.recording import Demonstration
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.inputs import compile_model
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.replay import commands, initial_state, step_count
from concent_warp.train.cfg import ALL, EnvironmentCfg
from concent_warp.train.task.movable_fixtures import movable
from concent_warp.train.task.robot import Robot
from concent_warp.train.task.slots import slot_table
from concent_warp.train.task.stages import DemonstratedStages, demonstrated_stages


@dataclass(frozen=True)
class Replay:
    """The demonstration as the model replays it; K steps."""

    timestep: float
    """[s]."""
    qpos: np.ndarray
    """Positions, shape (K + 1, nq)."""
    qvel: np.ndarray
    """Velocities, shape (K + 1, nv)."""
    ctrl: np.ndarray
    """Commands, shape (K, nu)."""
    contacts: int
    """Most contacts at a time."""
    constraints: int
    """Most constraint rows at a time."""

    def row(self, time: float) -> int:
        """Return the step at a time [s]."""
        return min(max(round(time / self.timestep), 0), len(self.ctrl) - 1)


@dataclass(frozen=True)
class Task:
    """What is to be trained, a stage or a chain of them, with everything about it that does not change."""

    model: Model
    """Objects that are fixed in the scene are mocap bodies here, so that worlds can have them in different places."""
    events: ContactEventSequence
    first: int
    """The stage that a chain begins with; `stage` itself where it is trained alone."""
    stage: int
    """The stage whose target event ends the task."""
    compiled: mujoco.MjModel
    """The model with the collidable spheres alone."""
    collidable: np.ndarray
    """Spheres in the physics, shape (S,) bool."""
    replay: Replay
    robot: Robot
    objects: tuple[int, ...]
    """Body ids of the objects; object 1 first, the one that the robot handles most, then object 2, and so on."""
    table: PairTable
    """Contact pairs of all stages."""
    held: np.ndarray
    """Whether a slot's pair is of the robot, shape (stages, slots) bool."""
    place: np.ndarray | None
    """Where object 1 is to be in the frame of object 2 [m], shape (3,); None in a stage of the robot alone."""
    demonstrated: DemonstratedStages | None = None
    """Which stage the demonstration is in, where several are trained."""

    @staticmethod
    def build(
        model: Model,
        demonstration: Demonstration,
        cfg: EnvironmentCfg,
        events: ContactEventSequence | None = None,
    ) -> Task:
        """Make a task.

        Args:
            model: Scene, spheres and effects.
            demonstration: What the policy is to reproduce.
            cfg: Stage, collisions, action and observation.
            events: Contact events of the demonstration; extracted here where they are not given.

        Raises:
            TrainError: The model has no spheres, an effect that cannot be trained with, or no such stage.
        """
        if model.geometry is None:
            raise TrainError("the model has no contact geometry to train with", fix="make one with concent fit")
        events = extract(model, demonstration, MujocoEngine(model, threads=1)) if events is None else events
        first, stage = _chain(events, cfg.stage)
        collidable = np.ones(len(model.geometry), dtype=bool)
        if cfg.collision == "vcp":
            touched = [e.sphere for e in events.entities if e.sphere is not None]
            collidable[:] = False
            collidable[touched] = True
        replayer, model = model, replace(model, scene=movable(model.scene))
        compiled, _ = compile_model(model, collidable)
        odd = [a.effect for a in model.effects if a.effect.commands and a.effect.late(compiled, a.array) is None]
        if odd:
            raise TrainError(
                "effects on the commands can be trained with where they are delays and lags",
                found=[effect.name for effect in odd],
            )
        table, held = slot_table(compiled, events, cfg.observation.slots)
        objects = tuple(int(compiled.body(name).id) for name in _ranked(model, events))
        replay = _replayed(compiled, replayer, demonstration, collidable)
        task = Task(
            model=model,
            events=events,
            first=first,
            stage=stage,
            compiled=compiled,
            collidable=collidable,
            replay=replay,
            robot=Robot.of(compiled, cfg.action),
            objects=objects,
            table=table,
            held=held,
            place=_place(compiled, replay, events, stage, objects),
        )
        if first == stage:
            return task
        shown = demonstrated_stages(
            compiled, table, events.stages, replay.qpos, replay.timestep, cfg.chain, cfg.decimation
        )
        return replace(task, demonstrated=shown)

    @property
    def chained(self) -> tuple[int, ...]:
        """The stages that are trained, in their order."""
        return tuple(range(self.first, self.stage + 1))

    def keeps(self, stage: int) -> bool:
        """Return whether a stage begins with object 1 in the hand, which is to stay there."""
        return self.events.stages[stage].bodies[0] != "robot" and bool(self.held[stage].any())

    def holds(self, stage: int) -> tuple[bool, ...]:
        """Return whether the target event of a stage that begins with something in the hand has it hold each object."""
        touched = self.table.body_b[stage][self.held[stage]]
        return tuple(self.keeps(stage) and body in touched for body in self.objects)


def _chain(events: ContactEventSequence, name: str) -> tuple[int, int]:
    """Return the first and the last of the stages that a name asks for.

    Raises:
        TrainError: There is no such stage, or none at all.
    """
    names = [stage.name for stage in events.stages]
    if name == ALL and names:
        return 0, len(names) - 1
    if name not in names:
        raise TrainError("the demonstration has no such stage", expected=f"one of {[*names, ALL]}", found=name)
    return names.index(name), names.index(name)


def _ranked(model: Model, events: ContactEventSequence) -> list[str]:
    """Return the names of the objects, those first that robot links touched for longest."""
    assert model.geometry is not None
    robot = {e.body for e in events.entities if e.role == "robot"}
    held = dict.fromkeys(model.geometry.bodies, 0.0)
    for contact in events.body_contacts:
        if contact.a in robot and contact.b in held:
            held[contact.b] += contact.end - contact.start
    return sorted(held, key=lambda name: -held[name])


def _replayed(m: mujoco.MjModel, model: Model, demonstration: Demonstration, collidable: np.ndarray) -> Replay:
    """Replay a demonstration in C MuJoCo and count what contact buffers it needs.

    Raises:
        TrainError: The replay does not stay finite.
    """
    engine = MujocoEngine(model, collidable=collidable, threads=1)
    steps = step_count(demonstration, engine.timestep)
    qpos, qvel = initial_state(m, demonstration)
    ctrl = commands(m, demonstration, steps)
    rollout = engine.run(Variants(1, qpos=qpos[None], qvel=qvel[None]), ctrl).numpy()
    if rollout.diverged[0]:
        raise TrainError("the replay of the demonstration does not stay finite", where=demonstration.name)
    d = mujoco.MjData(m)
    contacts = constraints = 0
    for k in range(0, steps, 4):
        d.qpos[:], d.qvel[:], d.ctrl[:] = rollout.qpos[0][k], rollout.qvel[0][k], ctrl[k]
        mujoco.mj_forward(m, d)
        contacts, constraints = max(contacts, d.ncon), max(constraints, d.nefc)
    return Replay(engine.timestep, rollout.qpos[0], rollout.qvel[0], ctrl, contacts, constraints)


def _place(
    m: mujoco.MjModel, replay: Replay, events: ContactEventSequence, stage: int, objects: tuple[int, ...]
) -> np.ndarray | None:
    """Return the demonstrated origin of object 1 in the frame of object 2 at a stage's target event [m], shape (3,).

    None where the stage's target event has no contact between the two.
    """
    pairs = events.stages[stage].event.pairs
    bodies = {(m.body(events.entity[p.a].body).id, m.body(events.entity[p.b].body).id) for p in pairs}
    if len(objects) < 2 or not {objects[:2], objects[1::-1]} & bodies:
        return None
    d = mujoco.MjData(m)
    d.qpos[:] = replay.qpos[replay.row(events.stages[stage].event.time)]
    mujoco.mj_kinematics(m, d)
    return d.xmat[objects[1]].reshape(3, 3).T @ (d.xpos[objects[0]] - d.xpos[objects[1]])
