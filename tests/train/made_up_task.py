"""A task made up by hand: two arm joints, two fingers, a loose block, a box and a peg, with states that tests choose.

Building it takes some milliseconds: nothing is replayed, extracted or sampled.
"""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import torch

from concent_warp.events.cfg import StagingCfg
from concent_warp.events.sequence import ContactEvent, ContactEventSequence, ContactInterval, ContactPair, Entity, Stage
from concent_warp.kernels.contact_pairs import PairTable
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.contact_geometry import ContactGeometry
from concent_warp.simulate.inputs import compile_model
from concent_warp.train.cfg import (
    ActionCfg,
    ChainCfg,
    CollisionCfg,
    EngineeredCfg,
    EnvironmentCfg,
    RewardCfg,
)
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.physics import MujocoPhysics
from concent_warp.train.resets.sample import ResetStates
from concent_warp.train.task.movable_fixtures import with_movable_fixtures
from concent_warp.train.task.robot import Robot
from concent_warp.train.task.stages import DemonstratedStages
from concent_warp.train.task.task import Replay, Task
from tests.train.small_insertion import EXACT_STATE, NOTHING_VARIES

XML = """
<mujoco>
  <option timestep="0.02"/>
  <custom><text name="concent_objects" data="block box peg"/></custom>
  <worldbody>
    <body name="block" pos="0 0 0.3"><freejoint/><geom type="box" size="0.04 0.03 0.02" mass="0.1"/></body>
    <body name="box" pos="0.3 0 0">
      <geom type="box" size="0.1 0.08 0.05" pos="0.01 0.02 -0.03" quat="0.8 0 0 0.6"/>
    </body>
    <body name="arm">
      <joint name="turn" type="hinge" axis="0 0 1"/>
      <geom type="box" size="0.02 0.02 0.1" pos="0 0 0.9" mass="1"/>
      <body name="hand" pos="0.27 0 0.15">
        <joint name="lift" type="slide" axis="0 0 1"/>
        <geom type="box" size="0.03 0.05 0.02" pos="0 0 0.1" mass="0.5"/>
        <geom type="sphere" size="0.3" contype="0" conaffinity="0" mass="0.1"/>
        <site name="other"/>
        <site name="tcp" pos="0.01 0 -0.05"/>
        <body name="left">
          <joint name="left" type="slide" axis="0 1 0"/>
          <geom type="box" size="0.01 0.005 0.02" pos="0 0.04 0" mass="0.1"/>
        </body>
        <body name="right">
          <joint name="right" type="slide" axis="0 -1 0"/>
          <geom type="box" size="0.01 0.005 0.02" pos="0 -0.04 0" mass="0.1"/>
        </body>
      </body>
    </body>
    <body name="peg" pos="0 0.4 0.2"><freejoint/><geom type="box" size="0.02 0.02 0.04" mass="0.1"/></body>
  </worldbody>
  <actuator>
    <position name="grip_left" joint="left" kp="100" ctrllimited="true" ctrlrange="-0.01 0.03"/>
    <position name="lift" joint="lift" kp="1000" ctrllimited="true" ctrlrange="-0.1 0.12"/>
    <position name="grip_right" joint="right" kp="100"/>
    <position name="turn" joint="turn" kp="1000"/>
  </actuator>
</mujoco>
"""
STAGES = ("pick", "align", "insert")
SLOTS = 3
SPHERES = (("block", (0.03, 0.02, -0.01), 0.01), ("block", (-0.03, 0.0, 0.01), 0.008), ("box", (0.0, 0.05, 0.0), 0.012))
"""Body, centre [m, body frame] and radius [m]; the first is in the physics, the others are not."""

SETTINGS = EnvironmentCfg(
    worlds=10,
    engine="mujoco",
    decimation=3,
    episode=0.5,
    success=0.15,
    dropped=0.35,
    lost=0.6,
    max_position=50.0,
    max_velocity=40.0,
    action=ActionCfg(
        turn=0.03, slide=0.005, gripper=0.004, turn_lead=0.05, slide_lead=0.02,
        gripper_actuators=("grip_left", "grip_right"),
    ),
    reward=RewardCfg(
        reach=1.3, regularisation=0.7, vcp=0.9, far=(1.1, 0.2), near=(2.2, 0.09), wide=(0.8, 0.5), stage=4.0,
        action=0.02, velocity=0.003, press=0.05, disturb_position=2.5, disturb_rotation=0.6, failure=3.0, lenience=0.3,
        scale=0.07,
        engineered=EngineeredCfg(
            hole=(0.02, -0.01, 0.0), seat=0.1, far=(1.2, 0.2), near=(0.9, 0.05), gate=0.15, gate_width=0.05,
            reached=0.2, bonus=7.0,
        ),
    ),
    virtual=CollisionCfg(margin=0.05, severe=0.005, slack=0.001, depth=20.0, band=0.3, points=0),
    chain=ChainCfg(tolerance=0.25, hold=2, rest=0.12),
    observation=EXACT_STATE,
    randomisation=NOTHING_VARIES,
)  # fmt: skip


def make_model() -> Model:
    """Return scene and spheres."""
    bodies = ("block", "box")
    geometry = ContactGeometry(
        bodies=bodies,
        body=np.array([bodies.index(body) for body, _, _ in SPHERES]),
        position=np.array([centre for _, centre, _ in SPHERES]),
        radius=np.array([radius for _, _, radius in SPHERES]),
        mass=np.array([0.05, 0.05, 1.0]),
        friction=np.full(3, 0.5),
    )
    return Model(with_movable_fixtures(Scene(XML)), geometry)


def make_events() -> ContactEventSequence:
    """Return a sequence of three stages; the block is grasped from the second on."""
    pair = ContactPair("hand", "block_sphere0", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 1.0)
    opened = (("robot", "block"), ("block", "box"), ("block", "box"))
    stages = tuple(
        Stage(name, float(k), k + 1.0, opened[k], ContactEvent(k + 0.5, ("hand",), ("block_sphere0",), (pair,)))
        for k, name in enumerate(STAGES)
    )
    entities = (Entity("block_sphere0", "object", "block", 0), Entity("hand", "robot", "hand"))
    held = ContactInterval("hand", "block", 0.5, 3.0, 1.0, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    return ContactEventSequence("demo", 0.02, 150, StagingCfg(), entities, (held,), (), stages)


def make_table(m: mujoco.MjModel, empty: int | None = None) -> tuple[PairTable, np.ndarray]:
    """Return contact pairs in slots, and whether side a is the robot; stage `empty` has none."""
    rng = np.random.default_rng(5)
    hand, block, box = (m.body(name).id for name in ("hand", "block", "box"))
    pairs = [
        [(hand, block), (hand, block), None],
        [(block, box), (hand, block), None],
        [(block, box), (block, box), (hand, block)],
    ]
    shape = (len(STAGES), SLOTS)
    active, robot, body = np.zeros(shape, bool), np.zeros(shape, bool), np.zeros((2, *shape), int)
    for s, row in enumerate(pairs):
        for k, bodies in enumerate(row):
            if bodies is not None and s != empty:
                active[s, k], robot[s, k], body[:, s, k] = True, bodies[0] == hand, bodies
    points = rng.uniform(-0.05, 0.05, (2, *shape, 3))
    normal = rng.normal(size=(*shape, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    none = np.zeros(shape)
    return PairTable(body[0], points[0], none, body[1], points[1], none, normal, active), robot


def make_task(
    cfg: EnvironmentCfg = SETTINGS,
    *,
    first: int = 0,
    last: int = 2,
    objects: tuple[str, ...] = ("block", "box", "peg"),
    target: tuple[float, float, float] | None = (0.05, -0.02, 0.1),
    empty: int | None = None,
) -> Task:
    """Return the task of the stages `first` to `last`."""
    model, collidable = make_model(), np.array([True, False, False])
    compiled, _ = compile_model(model, collidable)
    table, robot_slots = make_table(compiled, empty)
    steps = 150
    replay = Replay(
        0.02,
        np.tile(compiled.qpos0, (steps + 1, 1)),
        np.zeros((steps + 1, compiled.nv)),
        np.zeros((steps, compiled.nu)),
        contacts=2,
        constraints=8,
    )
    shown = DemonstratedStages(
        np.repeat(np.arange(3), 50), {k: float(k) for k in range(3)}, {k: k + 1.0 for k in range(3)}
    )
    return Task(
        model=model,
        events=make_events(),
        first=first,
        stage=last,
        compiled=compiled,
        collidable=collidable,
        replay=replay,
        robot=Robot.of(compiled, cfg.action),
        objects=tuple(compiled.body(name).id for name in objects),
        table=table,
        robot_slots=robot_slots,
        target_position=None if target is None else np.array(target),
        demonstrated=shown if first < last else None,
    )


def made_up_qpos(task: Task, rng: np.random.Generator, count: int) -> np.ndarray:
    """Return positions with the objects about the box and the hand about the block, shape (count, nq)."""
    m = task.compiled
    qpos = np.tile(m.qpos0, (count, 1))
    block, peg = (m.jnt_qposadr[m.body(name).jntadr[0]] for name in ("block", "peg"))
    qpos[:, block : block + 3] = [0.3, 0.0, 0.1]
    for start, spread in ((block, 0.12), (peg, 0.3)):
        qpos[:, start : start + 3] += rng.normal(size=(count, 3)) * spread * rng.choice([0.2, 0.7, 2.0], (count, 1))
        turn = rng.normal(size=(count, 4)) * [1.0, 0.4, 0.4, 0.4]
        qpos[:, start + 3 : start + 7] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    qpos[rng.random(count) < 0.3, block + 3 : block + 7] = [1.0, 0.0, 0.0, 0.0]
    for name, spread in (("turn", 0.3), ("lift", 0.05), ("left", 0.01), ("right", 0.01)):
        qpos[:, m.joint(name).qposadr[0]] += rng.normal(size=count) * spread
    return qpos


def made_up_states(task: Task, count: int = 5, seed: int = 0) -> ResetStates:
    """Return initial states that all differ, of the trained stages in turn; the first two begin the whole task."""
    rng, m = np.random.default_rng([seed, 7]), task.compiled
    turn = np.linspace(-0.2, 0.2, count)
    box = np.column_stack(
        [np.linspace(0.28, 0.32, count), np.zeros(count), rng.uniform(-0.01, 0.01, count),
         np.cos(turn / 2), np.zeros((count, 2)), np.sin(turn / 2)]
    )  # fmt: skip
    stage = np.array(task.chained)[np.arange(count) % len(task.chained)]
    return ResetStates(
        qpos=made_up_qpos(task, rng, count),
        qvel=rng.normal(size=(count, m.nv)) * 0.1,
        ctrl=rng.uniform(-0.01, 0.03, (count, m.nu)),
        mocap=box[:, None],
        stage=stage,
        begins=(np.arange(count) % 2 == 0) & (stage == task.first),
        time=np.zeros(count),
        case=np.ones(count, int),
        discarded={},
    )


class ChosenPhysics(MujocoPhysics):
    """Worlds whose next state is chosen instead of simulated."""

    chosen: tuple[np.ndarray, np.ndarray] | None = None
    """Positions (N, nq) and velocities (N, nv) after the next actions; by default they stay as they are."""
    flags: torch.Tensor | None = None
    """Overflow flags that the next actions raise, shape (N,)."""

    def advance(self) -> None:
        """Take the chosen state over."""
        if self.chosen is not None:
            self.qpos[:], self.qvel[:] = (torch.as_tensor(value) for value in self.chosen)
        if self.flags is not None:
            self.overflow[:] = self.flags
        self.update_poses()


def make_environment(
    task: Task, cfg: EnvironmentCfg = SETTINGS, states: ResetStates | None = None
) -> tuple[Environment, ChosenPhysics]:
    """Return an environment in which all episodes have just begun, and its physics."""
    physics = ChosenPhysics(task.compiled, cfg.worlds, cfg.decimation)
    states = made_up_states(task) if states is None else states
    environment = Environment(task, cfg, physics, states)
    environment.start_from([k % len(states.qpos) for k in range(cfg.worlds)])
    environment.read_log()
    return environment, physics


def changed(cfg: EnvironmentCfg = SETTINGS, **parts: object) -> EnvironmentCfg:
    """Return settings with fields changed; those of a part are given as a mapping."""
    fields = {
        name: replace(getattr(cfg, name), **value) if isinstance(value, dict) else value
        for name, value in parts.items()
    }
    return replace(cfg, **fields)  # pyright: ignore[reportArgumentType]
