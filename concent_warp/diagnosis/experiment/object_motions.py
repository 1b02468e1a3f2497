"""Motions of objects by hand: slides, spins, rolls, drops and throws, from other sides and with another weight."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.comparison.units import words
from concent_warp.diagnosis.experiment.motions import EXTRA, ProposedMotion, RecordedRange, heavier, slope_turned
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.replay import commands
from concent_warp.simulate.select import EngineName, make_engine

MOST_BODIES = 2
"""Objects that motions are proposed for."""
SETTLING = 3.0
"""Time in which an object comes to rest [s]."""
RESTING = 0.05
"""Speed below which it has [m/s and rad/s]."""
LIFTED = 0.02
"""An object that starts this far above where it rests is in flight [m]."""
SPINS = (3.0, 10.0)
"""Speeds of spinning in place [rad/s]."""
HEIGHTS = (0.05, 0.2, 0.6)
"""Heights of drops above the place of rest [m]."""
TILT = np.pi / 6
"""By which an object is tilted that is to land on an edge [rad]."""
SLOW, FAST = 0.5, 1.5
"""Speeds of a motion that is done again, over its own."""
LEAST_SPEED = 0.1
"""Slowest launch [m/s]."""
DECELERATION = 1.5
"""That a launched object is given time for to come to rest [m/s^2]."""
MOMENT = (0.5, 2.5)
"""Shortest and longest motion [s]."""
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class ThrowableBody:
    """A free body that may be thrown, pushed and dropped by hand."""

    bench: RecordedRange
    body: int
    engine: EngineName

    @property
    def name(self) -> str:
        """Name of the body."""
        return self.bench.m.body(self.body).name

    @property
    def at(self) -> int:
        """Where its pose begins in qpos."""
        return int(self.bench.m.jnt_qposadr[self.bench.m.body_jntadr[self.body]])

    @property
    def dof(self) -> int:
        """Where its velocity begins in qvel."""
        return int(self.bench.m.jnt_dofadr[self.bench.m.body_jntadr[self.body]])

    @cached_property
    def rest(self) -> np.ndarray | None:
        """State in which it rests, let go of where it first was, shape (nq,); None where it comes to no rest."""
        m, bench = self.bench.m, self.bench
        qpos, _ = bench.starts[0]
        steps = int(SETTLING / m.opt.timestep)
        ctrl = np.repeat(commands(m, bench.recording.demonstrations[0], 1), steps, axis=0)
        variants = Variants(1, qpos=qpos[None], qvel=np.zeros((1, m.nv)))
        rollout = make_engine(self.engine, bench.model).run(variants, ctrl, record=[steps], bodies=[]).numpy()
        speed = rollout.qvel[0, 0, self.dof : self.dof + 6]
        if not np.isfinite(speed).all() or np.abs(speed).max() > RESTING:
            return None
        found = qpos.copy()
        found[self.at : self.at + 7] = rollout.qpos[0, 0, self.at : self.at + 7]
        return found

    @cached_property
    def speed(self) -> float:
        """Highest speed that it was seen at [m/s]."""
        return max(max(float(np.linalg.norm(v[self.dof : self.dof + 3])) for _, v in self.bench.states), LEAST_SPEED)

    def pose(self, qpos: np.ndarray, shift: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """Return a state with the body moved by `shift` (3,) [m] and turned by the rotation vector `turn` (3,)."""
        moved, a = qpos.copy(), self.at
        moved[a : a + 3] += shift
        now = Rotation.from_quat(qpos[a + 3 : a + 7], scalar_first=True)
        moved[a + 3 : a + 7] = (Rotation.from_rotvec(turn) * now).as_quat(scalar_first=True)
        return moved

    def motion(
        self,
        name: str,
        text: str,
        duration: float,
        qpos: np.ndarray,
        velocity: Sequence[float] | np.ndarray = (0, 0, 0),
        spin: Sequence[float] | np.ndarray = (0, 0, 0),
    ) -> ProposedMotion:
        """Return a motion from a state, at a velocity [m/s] and spin [rad/s] of the body, both in the world frame."""
        qvel = np.zeros(self.bench.m.nv)
        turned = Rotation.from_quat(qpos[self.at + 3 : self.at + 7], scalar_first=True)
        qvel[self.dof : self.dof + 3] = velocity
        qvel[self.dof + 3 : self.dof + 6] = turned.inv().apply(spin)
        action = self.bench.holding(self.bench.recording.demonstrations[0])
        return ProposedMotion(name, text, float(np.clip(duration, *MOMENT)), qpos, qvel, action)


def body_motions(bench: RecordedRange, engine: EngineName, tilted: bool) -> Iterator[ProposedMotion]:
    """Yield what could be done with objects; where the table may be `tilted`, with it turned too."""
    for body in bench.bodies[:MOST_BODIES]:
        toy = ThrowableBody(bench, body, engine)
        moves = [*_surface_motions(toy), *_flights(toy)]
        yield from moves
        yield from _turned_starts(toy)
        first = moves[:1]
        for motion in first:
            text = f"with {100 * EXTRA:.0f} % more mass on {words(toy.name)}, {motion.text}"
            yield replace(motion, name=f"{motion.name}, heavier", text=text, change=heavier(toy.name))
            if tilted:
                text = f"turn the table by 180 deg, so that its slope runs the other way, and {motion.text}"
                yield replace(motion, name=f"{motion.name}, turned table", text=text, change=slope_turned)


def _surface_motions(toy: ThrowableBody) -> Iterator[ProposedMotion]:
    """Yield slides, spins, rolls and drops where there is a place on which the body rests."""
    rest, what, v = toy.rest, words(toy.name), toy.speed
    if rest is None:
        return
    still = np.zeros(3)
    for speed, heading in ((v, 0), (v, 90), (v, 180), (v, 270), (SLOW * v, 0)):
        direction = np.array([np.cos(np.radians(heading)), np.sin(np.radians(heading)), 0.0]).round(12)
        axis = ("+x", "+y", "-x", "-y")[heading // 90]
        text = f"push {what} off along {axis} at {speed:.2g} m/s and let it slide"
        yield toy.motion("slide", text, 0.3 + speed / DECELERATION, rest, speed * direction)
    for degrees in (90, 180):
        text = f"turn {what} by {degrees} deg, push it off along +x at {v:.2g} m/s and let it slide"
        turned = toy.pose(rest, still, np.radians(degrees) * UP)
        yield toy.motion("slide of the turned object", text, 0.3 + v / DECELERATION, turned, (v, 0, 0))
    for spin in SPINS:
        text = f"spin {what} in place at {spin:g} rad/s"
        yield toy.motion("spin in place", text, MOMENT[1], rest, spin=spin * UP)
    text = f"push {what} off along +x at {v:.2g} m/s, spinning at {SPINS[1]:g} rad/s"
    yield toy.motion("slide and spin", text, 0.3 + v / DECELERATION, rest, (v, 0, 0), SPINS[1] * UP)
    if (rolling := _roll(toy, rest)) is not None:
        direction, radius = rolling
        for speed in (v, SLOW * v):
            text = f"roll {what} at {speed:.2g} m/s"
            spin = np.cross(UP, direction) * speed / radius
            yield toy.motion("roll", text, MOMENT[1], rest, speed * direction, spin)
    for height in HEIGHTS:
        duration = np.sqrt(2 * height / 9.81) + 0.6
        lifted = toy.pose(rest, height * UP, still)
        yield toy.motion("drop", f"drop {what} from {height:g} m above where it rests", duration, lifted)
    lifted = toy.pose(rest, HEIGHTS[1] * UP, np.array([TILT, 0.0, 0.0]))
    text = f"drop {what} from {HEIGHTS[1]:g} m above where it rests, tilted by {np.degrees(TILT):.0f} deg about x"
    yield toy.motion("tilted drop", text, np.sqrt(2 * HEIGHTS[1] / 9.81) + 0.6, lifted)


def _flights(toy: ThrowableBody) -> Iterator[ProposedMotion]:
    """Yield throws as the fastest one of those recorded, faster, slower and the other way."""
    thrown = [
        (qpos, qvel)
        for qpos, qvel in toy.bench.starts
        if toy.rest is None or qpos[toy.at + 2] > toy.rest[toy.at + 2] + LIFTED
    ]
    if not thrown:
        return
    qpos, qvel = max(thrown, key=lambda s: float(np.linalg.norm(s[1][toy.dof : toy.dof + 2])))
    velocity = qvel[toy.dof : toy.dof + 3]
    level = velocity * np.array([1.0, 1.0, 0.0])
    spin = Rotation.from_quat(qpos[toy.at + 3 : toy.at + 7], scalar_first=True).apply(qvel[toy.dof + 3 : toy.dof + 6])
    what, fast = words(toy.name), float(np.linalg.norm(level))
    duration = toy.bench.longest.duration
    ways = (
        (f"throw {what} as before but at {FAST * fast:.2g} m/s", FAST * level, spin),
        (f"throw {what} as before but at {SLOW * fast:.2g} m/s", SLOW * level, spin),
        (f"throw {what} at {fast:.2g} m/s the other way", -level, spin),
        (f"throw {what} as before, spinning at {SPINS[1]:g} rad/s about the vertical", level, SPINS[1] * UP),
        (f"let {what} fall from where it was thrown", 0 * level, 0 * spin),
        (f"throw {what} straight up at {max(fast, 1.0):.2g} m/s", max(fast, 1.0) * UP, 0 * spin),
    )
    for text, launch, turning in ways:
        yield toy.motion("throw", text, duration, qpos, launch + velocity * UP, turning)


def _turned_starts(toy: ThrowableBody) -> Iterator[ProposedMotion]:
    """Yield what was commanded to a robot, with the object turned about the vertical before."""
    d, bench = toy.bench.longest, toy.bench
    if not d.action:
        return
    qpos, qvel = bench.starts[bench.recording.demonstrations.index(d)]
    for degrees in (90, 180):
        turned = toy.pose(qpos, np.zeros(3), np.radians(degrees) * UP)
        text = f"turn {words(toy.name)} by {degrees} deg and repeat the same commands"
        yield ProposedMotion("repeat with the turned object", text, d.duration, turned, qvel, d.action)
    text = f"with {100 * EXTRA:.0f} % more mass on {words(toy.name)}, repeat the same commands"
    yield ProposedMotion("repeat, heavier", text, d.duration, qpos, qvel, d.action, change=heavier(toy.name))


def _roll(toy: ThrowableBody, rest: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Return direction (3,) and radius [m] of the body's rolling from its rest, None for one that is not round."""
    m = toy.bench.m
    geoms = np.flatnonzero((m.geom_bodyid == toy.body) & ((m.geom_contype != 0) | (m.geom_conaffinity != 0)))
    if len(geoms) != 1:
        return None
    g = int(geoms[0])
    kind, radius = int(m.geom_type[g]), float(m.geom_size[g, 0])
    if kind == int(mujoco.mjtGeom.mjGEOM_SPHERE):
        return np.array([1.0, 0.0, 0.0]), radius
    if kind not in (int(mujoco.mjtGeom.mjGEOM_CYLINDER), int(mujoco.mjtGeom.mjGEOM_CAPSULE)):
        return None
    body = Rotation.from_quat(rest[toy.at + 3 : toy.at + 7], scalar_first=True)
    axis = (body * Rotation.from_quat(m.geom_quat[g], scalar_first=True)).apply(UP)
    across = np.cross(axis, UP)
    return (across / np.linalg.norm(across), radius) if abs(axis[2]) < 0.1 else None
