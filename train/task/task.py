"""The task of a training: model, demonstration, and the contact events that the policy is to bring about."""

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
from concent_warp.train.cfg import ALL, LAST, EnvironmentCfg
from concent_warp.train.task.edges import with_edge_spheres
from concent_warp.train.task.movable_fixtures import with_movable_fixtures
from concent_warp.train.task.robot import Robot
from concent_warp.train.task.slots import slot_table
from concent_warp.train.task.stages import DemonstratedStages, demonstrated_stages

REPLAY_STRIDE = 4
"""Steps of a replay of which one is looked at."""


@dataclass(frozen=True)
class Replay:
    """The demonstration replayed by the model, K steps."""

    timestep: float
    """Time between steps [s]."""
    qpos: np.ndarray
    """Positions, shape (K + 1, nq)."""
    qvel: np.ndarray
    """Velocities, shape (K + 1, nv)."""
    ctrl: np.ndarray
    """Commands, shape (K, nu)."""
    contacts: int
    """Largest number of simultaneous contacts."""
    constraints: int
    """Largest number of simultaneous constraint rows."""

    def row(self, time: float) -> int:
        """Return the index of the step at a time [s]."""
        return min(max(round(time / self.timestep), 0), len(self.ctrl) - 1)


@dataclass(frozen=True)
class Task:
    """A stage or a chain of stages to be trained, with all that does not depend on the worlds' state."""

    model: Model
    """The model; its fixed objects are mocap bodies, so that their poses can differ between worlds."""
    events: ContactEventSequence
    first: int
    """First stage of a chain; equal to `stage` if one stage is trained."""
    stage: int
    """Stage whose target event ends the task."""
    compiled: mujoco.MjModel
    """Compiled model with only the collidable spheres."""
    collidable: np.ndarray
    """Spheres in the physics, shape (S,) bool."""
    replay: Replay
    robot: Robot
    objects: tuple[int, ...]
    """Body ids of the objects by the time for which the robot touches them; object 1 is the most handled one."""
    table: PairTable
    """Contact pairs of all stages."""
    robot_slots: np.ndarray
    """Whether a slot's pair has a robot link, shape (stages, slots) bool."""
    target_position: np.ndarray | None
    """Target position of object 1 in the frame of object 2 [m], shape (3,); None without a contact of both."""
    demonstrated: DemonstratedStages | None = None
    """Stages along the demonstration; None if one stage is trained."""

    @staticmethod
    def build(
        model: Model,
        demonstration: Demonstration,
        cfg: EnvironmentCfg,
        events: ContactEventSequence | None = None,
    ) -> Task:
        """Return a task.

        Args:
            model: Scene, contact geometry and effects.
            demonstration: The demonstration.
            cfg: Stage, collisions, action and observation.
            events: Contact events of the demonstration; extracted by default.

        Raises:
            TrainError: The model has no contact geometry or an effect that training does not support, or the
                demonstration lacks the stage.
        """
        if model.geometry is None:
            raise TrainError("the model has no contact geometry", fix="fit one with concent fit")
        events = extract(model, demonstration, MujocoEngine(model, threads=1)) if events is None else events
        first, stage = _chain(events, cfg.stage)
        collidable = np.ones(len(model.geometry), dtype=bool)
        if cfg.collision == "vcp":
            touched = [e.sphere for e in events.entities if e.sphere is not None]
            collidable[:] = False
            collidable[touched] = True
        replayer, replayed = model, collidable
        if cfg.edges.count:
            model = with_edge_spheres(model, collidable, cfg.edges)
            added = len(model.geometry) - len(collidable) if model.geometry is not None else 0
            collidable = np.append(collidable, np.ones(added, dtype=bool))
        model = replace(model, scene=with_movable_fixtures(model.scene))
        compiled, _ = compile_model(model, collidable)
        unsupported = [
            a.effect for a in model.effects if a.effect.commands and a.effect.delay_and_lag(compiled, a.array) is None
        ]
        if unsupported:
            raise TrainError(
                "training supports delays and lags of commands, but no other effects on them",
                found=[effect.name for effect in unsupported],
            )
        table, robot_slots = slot_table(compiled, events, cfg.observation.slots)
        objects = tuple(int(compiled.body(name).id) for name in _objects_by_handling(model, events))
        replay = _replay(compiled, replayer, demonstration, replayed)
        task = Task(
            model=model,
            events=events,
            first=first,
            stage=stage,
            compiled=compiled,
            collidable=collidable,
            replay=replay,
            robot=Robot.of(compiled, cfg.action).holding(compiled, _trained_positions(replay, events, first, stage)),
            objects=objects,
            table=table,
            robot_slots=robot_slots,
            target_position=_target_position(compiled, replay, events, stage, objects),
        )
        if first == stage:
            return task
        shown = demonstrated_stages(
            compiled, table, events.stages, replay.qpos, replay.timestep, cfg.chain, cfg.decimation
        )
        return replace(task, demonstrated=shown)

    @property
    def chained(self) -> tuple[int, ...]:
        """The trained stages, in order."""
        return tuple(range(self.first, self.stage + 1))

    def starts_grasped(self, stage: int) -> bool:
        """Return whether a stage starts with an object grasped, and keeps it grasped."""
        return bool(self.grasping_slots(stage).any())

    def grasped_objects(self, stage: int) -> tuple[bool, ...]:
        """Return whether each object is grasped from the start of a stage to its target event."""
        touched = self.table.body_b[stage][self.grasping_slots(stage)]
        return tuple(body in touched for body in self.objects)

    def grasping_slots(self, stage: int) -> np.ndarray:
        """Return the slots of a stage by whose pairs the robot grasps an object from the start on, shape (slots,) bool.

        A contact of the robot that only the target event has, as of a finger that comes to rest on the box, is none.
        """
        of = self.events.stages[stage]
        if of.bodies[0] == "robot":
            return np.zeros_like(self.robot_slots[stage])
        robot = {e.body for e in self.events.entities if e.role == "robot"}
        held = {c.b for c in self.events.body_contacts if c.a in robot and c.start <= of.start < c.end}
        bodies = [self.compiled.body(name).id for name in held]
        return self.robot_slots[stage] & np.isin(self.table.body_b[stage], bodies)


def _chain(events: ContactEventSequence, name: str) -> tuple[int, int]:
    """Return the indices of the first and the last trained stage.

    Raises:
        TrainError: The demonstration has no such stage.
    """
    names = [stage.name for stage in events.stages]
    if not names:
        raise TrainError(
            "the demonstration has no stage to train",
            where=events.demonstration,
            expected="a grasp, a push by the robot, or a contact of two objects that begins during it",
            found=_unstaged(events),
            fix="record from before the first contact; check what concent events prints, and concent_objects",
        )
    if name == ALL and names:
        return 0, len(names) - 1
    if name == LAST and names:
        return len(names) - 1, len(names) - 1
    if name not in names:
        raise TrainError("the demonstration has no such stage", expected=f"one of {[*names, LAST, ALL]}", found=name)
    return names.index(name), names.index(name)


def _unstaged(events: ContactEventSequence) -> str:
    """Return what contacts there are of a sequence without stages."""
    shown = [f"{one.a} and {one.b} from {one.start:.2f} s" for one in events.body_contacts]
    return f"{', '.join(shown[:4])}{' and more' if len(shown) > 4 else ''}" or "no contacts"


def _trained_positions(replay: Replay, events: ContactEventSequence, first: int, stage: int) -> np.ndarray:
    """Return positions of a replay (K, nq) from the start of the stage before the first trained one to its end."""
    begin = events.stages[first - 1].start if first else 0.0
    return replay.qpos[replay.row(begin) : replay.row(events.stages[stage].event.time) + 1 : REPLAY_STRIDE]


def _objects_by_handling(model: Model, events: ContactEventSequence) -> list[str]:
    """Return the names of the objects, in descending order of the time for which robot links touch them."""
    assert model.geometry is not None
    robot = {e.body for e in events.entities if e.role == "robot"}
    touched = dict.fromkeys(model.geometry.bodies, 0.0)
    for contact in events.body_contacts:
        if contact.a in robot and contact.b in touched:
            touched[contact.b] += contact.end - contact.start
    return sorted(touched, key=lambda name: -touched[name])


def _replay(m: mujoco.MjModel, model: Model, demonstration: Demonstration, collidable: np.ndarray) -> Replay:
    """Return a demonstration replayed in C MuJoCo, with the largest numbers of contacts and constraints.

    Raises:
        TrainError: The replay diverges.
    """
    engine = MujocoEngine(model, collidable=collidable, threads=1)
    steps = step_count(demonstration, engine.timestep)
    qpos, qvel = initial_state(m, demonstration)
    ctrl = commands(m, demonstration, steps)
    rollout = engine.run(Variants(1, qpos=qpos[None], qvel=qvel[None]), ctrl).numpy()
    if rollout.diverged[0]:
        raise TrainError("the replay of the demonstration diverges", where=demonstration.name)
    d = mujoco.MjData(m)
    contacts = constraints = 0
    for k in range(0, steps, REPLAY_STRIDE):
        d.qpos[:], d.qvel[:], d.ctrl[:] = rollout.qpos[0][k], rollout.qvel[0][k], ctrl[k]
        mujoco.mj_forward(m, d)
        contacts, constraints = max(contacts, d.ncon), max(constraints, d.nefc)
    return Replay(engine.timestep, rollout.qpos[0], rollout.qvel[0], ctrl, contacts, constraints)


def _target_position(
    m: mujoco.MjModel, replay: Replay, events: ContactEventSequence, stage: int, objects: tuple[int, ...]
) -> np.ndarray | None:
    """Return the demonstrated origin of object 1 in the frame of object 2 at a stage's target event [m], shape (3,).

    None if the stage's target event has no contact between the two.
    """
    pairs = events.stages[stage].event.pairs
    bodies = {(m.body(events.entity[p.a].body).id, m.body(events.entity[p.b].body).id) for p in pairs}
    if len(objects) < 2 or not {objects[:2], objects[1::-1]} & bodies:
        return None
    d = mujoco.MjData(m)
    d.qpos[:] = replay.qpos[replay.row(events.stages[stage].event.time)]
    mujoco.mj_kinematics(m, d)
    return d.xmat[objects[1]].reshape(3, 3).T @ (d.xpos[objects[0]] - d.xpos[objects[1]])
