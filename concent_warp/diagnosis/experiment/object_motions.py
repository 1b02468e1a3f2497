"""Motions of objects by hand: slides, spins, rolls, drops and throws, also turned or with additional mass."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.comparison.units import channel_text
from concent_warp.diagnosis.experiment.motions import ProposedMotion, RecordedRange, slope_turned
from concent_warp.diagnosis.experiment.payloads import loaded, on_object
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.replay import commands
from concent_warp.simulate.select import EngineName, make_engine

UP = np.array([0.0, 0.0, 1.0])
LOADED = ("slide", "spin in place", "roll", "throw")
"""Kinds of motions by hand of which the fastest is also made with weights on the object."""


@dataclass(frozen=True)
class ThrowableBody:
    """A free body that can be thrown, pushed and dropped by hand."""

    recorded: RecordedRange
    body: int
    engine: EngineName

    @property
    def name(self) -> str:
        """Name of the body."""
        return self.recorded.m.body(self.body).name

    @property
    def at(self) -> int:
        """Index at which its pose begins in qpos."""
        return int(self.recorded.m.jnt_qposadr[self.recorded.m.body_jntadr[self.body]])

    @property
    def dof(self) -> int:
        """Index at which its velocity begins in qvel."""
        return int(self.recorded.m.jnt_dofadr[self.recorded.m.body_jntadr[self.body]])

    @cached_property
    def rest(self) -> np.ndarray | None:
        """Positions after it came to rest from its first pose, shape (nq,); None where it does not come to rest."""
        m, recorded = self.recorded.m, self.recorded
        qpos, _ = recorded.starts[0]
        steps = int(recorded.cfg.settling_time / m.opt.timestep)
        ctrl = np.repeat(commands(m, recorded.recording.demonstrations[0], 1), steps, axis=0)
        variants = Variants(1, qpos=qpos[None], qvel=np.zeros((1, m.nv)))
        rollout = make_engine(self.engine, recorded.model).run(variants, ctrl, record=[steps], bodies=[]).numpy()
        speed = rollout.qvel[0, 0, self.dof : self.dof + 6]
        if not np.isfinite(speed).all() or np.abs(speed).max() > recorded.cfg.rest_speed:
            return None
        found = qpos.copy()
        found[self.at : self.at + 7] = rollout.qpos[0, 0, self.at : self.at + 7]
        return found

    @cached_property
    def speed(self) -> float:
        """Highest recorded speed [m/s]."""
        speeds = [float(np.linalg.norm(v[self.dof : self.dof + 3])) for _, v in self.recorded.states]
        return max(*speeds, self.recorded.cfg.min_launch_speed)

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
        qvel = np.zeros(self.recorded.m.nv)
        turned = Rotation.from_quat(qpos[self.at + 3 : self.at + 7], scalar_first=True)
        qvel[self.dof : self.dof + 3] = velocity
        qvel[self.dof + 3 : self.dof + 6] = turned.inv().apply(spin)
        action = self.recorded.holding(self.recorded.recording.demonstrations[0])
        cfg = self.recorded.cfg
        length = float(np.clip(duration, cfg.min_object_duration, cfg.max_object_duration))
        return ProposedMotion(name, text, length, qpos, qvel, action)


def body_motions(recorded: RecordedRange, engine: EngineName, tilted: bool) -> Iterator[ProposedMotion]:
    """Yield motions of objects; where the table may be `tilted`, with it turned too."""
    for body in recorded.bodies[: recorded.cfg.max_bodies]:
        obj = ThrowableBody(recorded, body, engine)
        moves = [*_surface_motions(obj), *_flights(obj)]
        yield from moves
        yield from _turned_starts(obj)
        speeds = [round(float(np.linalg.norm(motion.qvel)), 9) for motion in moves]
        slowest_first = sorted(range(len(moves)), key=lambda k: (speeds[k], -k))
        kinds = {moves[k].name: moves[k] for k in slowest_first}
        yield from (loaded(kinds[name], on_object(recorded, body)) for name in LOADED if name in kinds)
        for motion in moves[:1]:
            if tilted:
                text = f"turn the table by 180 deg, so that its slope runs the other way, and {motion.text}"
                yield replace(motion, name=f"{motion.name}, turned table", text=text, change=slope_turned)


def _surface_motions(obj: ThrowableBody) -> Iterator[ProposedMotion]:
    """Yield slides, spins, rolls and drops where the body rests on something."""
    rest, what, v, cfg = obj.rest, channel_text(obj.name), obj.speed, obj.recorded.cfg
    if rest is None:
        return
    still = np.zeros(3)
    for speed, heading in ((v, 0), (v, 90), (v, 180), (v, 270), (cfg.slower * v, 0)):
        direction = np.array([np.cos(np.radians(heading)), np.sin(np.radians(heading)), 0.0]).round(12)
        axis = ("+x", "+y", "-x", "-y")[heading // 90]
        text = f"push {what} off along {axis} at {speed:.2g} m/s and let it slide"
        yield obj.motion("slide", text, 0.3 + speed / cfg.deceleration, rest, speed * direction)
    for degrees in (90, 180):
        text = f"turn {what} by {degrees} deg, push it off along +x at {v:.2g} m/s and let it slide"
        turned = obj.pose(rest, still, np.radians(degrees) * UP)
        yield obj.motion("slide of the turned object", text, 0.3 + v / cfg.deceleration, turned, (v, 0, 0))
    for spin in cfg.spin_rates:
        text = f"spin {what} in place at {spin:g} rad/s"
        yield obj.motion("spin in place", text, cfg.max_object_duration, rest, spin=spin * UP)
    text = f"push {what} off along +x at {v:.2g} m/s, spinning at {cfg.spin_rates[1]:g} rad/s"
    yield obj.motion("slide and spin", text, 0.3 + v / cfg.deceleration, rest, (v, 0, 0), cfg.spin_rates[1] * UP)
    if (rolling := _roll(obj, rest)) is not None:
        direction, radius = rolling
        for speed in (v, cfg.slower * v):
            text = f"roll {what} at {speed:.2g} m/s"
            spin = np.cross(UP, direction) * speed / radius
            yield obj.motion("roll", text, cfg.max_object_duration, rest, speed * direction, spin)
    for height in cfg.drop_heights:
        duration = np.sqrt(2 * height / 9.81) + 0.6
        lifted = obj.pose(rest, height * UP, still)
        yield obj.motion("drop", f"drop {what} from {height:g} m above where it rests", duration, lifted)
    lifted = obj.pose(rest, cfg.drop_heights[1] * UP, np.array([cfg.drop_tilt, 0.0, 0.0]))
    tilt = f"tilted by {np.degrees(cfg.drop_tilt):.0f} deg about x"
    text = f"drop {what} from {cfg.drop_heights[1]:g} m above where it rests, {tilt}"
    yield obj.motion("tilted drop", text, np.sqrt(2 * cfg.drop_heights[1] / 9.81) + 0.6, lifted)


def _flights(obj: ThrowableBody) -> Iterator[ProposedMotion]:
    """Yield throws like the fastest recorded one: faster, slower, reversed, with other spins."""
    cfg = obj.recorded.cfg
    thrown = [
        (qpos, qvel)
        for qpos, qvel in obj.recorded.starts
        if obj.rest is None or qpos[obj.at + 2] > obj.rest[obj.at + 2] + cfg.min_flight_height
    ]
    if not thrown:
        return
    qpos, qvel = max(thrown, key=lambda s: float(np.linalg.norm(s[1][obj.dof : obj.dof + 2])))
    velocity = qvel[obj.dof : obj.dof + 3]
    level = velocity * np.array([1.0, 1.0, 0.0])
    spin = Rotation.from_quat(qpos[obj.at + 3 : obj.at + 7], scalar_first=True).apply(qvel[obj.dof + 3 : obj.dof + 6])
    what, fast = channel_text(obj.name), float(np.linalg.norm(level))
    duration = obj.recorded.longest.duration
    ways = (
        (f"throw {what} as before but at {cfg.faster * fast:.2g} m/s", cfg.faster * level, spin),
        (f"throw {what} as before but at {cfg.slower * fast:.2g} m/s", cfg.slower * level, spin),
        (f"throw {what} at {fast:.2g} m/s the other way", -level, spin),
        (
            f"throw {what} as before, spinning at {cfg.spin_rates[1]:g} rad/s about the vertical",
            level,
            cfg.spin_rates[1] * UP,
        ),
        (f"let {what} fall from where it was thrown", 0 * level, 0 * spin),
        (f"throw {what} straight up at {max(fast, 1.0):.2g} m/s", max(fast, 1.0) * UP, 0 * spin),
    )
    for text, launch, turning in ways:
        yield obj.motion("throw", text, duration, qpos, launch + velocity * UP, turning)


def _turned_starts(obj: ThrowableBody) -> Iterator[ProposedMotion]:
    """Yield repetitions of a robot's commands, with the object turned about the vertical or loaded."""
    d, recorded = obj.recorded.longest, obj.recorded
    if not d.action:
        return
    qpos, qvel = recorded.starts[recorded.recording.demonstrations.index(d)]
    for degrees in (90, 180):
        turned = obj.pose(qpos, np.zeros(3), np.radians(degrees) * UP)
        text = f"turn {channel_text(obj.name)} by {degrees} deg and repeat the same commands"
        yield ProposedMotion("repeat with the turned object", text, d.duration, turned, qvel, d.action)
    again = ProposedMotion("repeat", "repeat the same commands", d.duration, qpos, qvel, d.action)
    yield loaded(again, on_object(recorded, obj.body))


def _roll(obj: ThrowableBody, rest: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Return the rolling direction (3,) and radius [m] of a body at rest, None for one that is not round."""
    m = obj.recorded.m
    geoms = np.flatnonzero((m.geom_bodyid == obj.body) & ((m.geom_contype != 0) | (m.geom_conaffinity != 0)))
    if len(geoms) != 1:
        return None
    g = int(geoms[0])
    kind, radius = int(m.geom_type[g]), float(m.geom_size[g, 0])
    if kind == int(mujoco.mjtGeom.mjGEOM_SPHERE):
        return np.array([1.0, 0.0, 0.0]), radius
    if kind not in (int(mujoco.mjtGeom.mjGEOM_CYLINDER), int(mujoco.mjtGeom.mjGEOM_CAPSULE)):
        return None
    body = Rotation.from_quat(rest[obj.at + 3 : obj.at + 7], scalar_first=True)
    axis = (body * Rotation.from_quat(m.geom_quat[g], scalar_first=True)).apply(UP)
    across = np.cross(axis, UP)
    return (across / np.linalg.norm(across), radius) if abs(axis[2]) < 0.1 else None
