"""Limits of a motion: joint range, joint speed, actuator force, workspace, and what may touch what."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from concent_warp.diagnosis.experiment.motions import ProposedMotion, RecordedRange
from concent_warp.diagnosis.suggestion.cfg import MotionLimitsCfg
from concent_warp.diagnosis.suggestion.forecast import Course
from concent_warp.effects.select import SINGLE, free_bodies, robot_bodies
from concent_warp.errors import ConcentError
from concent_warp.recording.recording import Demonstration
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.replay import commands
from concent_warp.simulate.select import EngineName, make_engine

SAMPLING = 0.02
"""Time between the instants at which forces, places and contacts of a motion are looked at [s]."""


@dataclass(frozen=True)
class Excess:
    """By how much a motion exceeds the limits."""

    size: float
    """Sum of the excesses, each over its limit [-]; 0 within all limits."""
    words: tuple[str, ...]
    """What is exceeded, in words."""


@dataclass(frozen=True)
class _Extremes:
    """What motions reach."""

    low: np.ndarray
    """Smallest positions of the joints with one degree of freedom, shape (J,)."""
    high: np.ndarray
    """Largest positions, shape (J,)."""
    speed: np.ndarray
    """Highest speeds, shape (J,)."""
    force: np.ndarray
    """Largest forces of the actuators, shape (nu,)."""
    box: np.ndarray
    """Lowest and highest corner of where moving links are [m], shape (2, 3)."""
    bodies: np.ndarray
    """The same of free bodies."""
    pairs: frozenset[tuple[int, int]]
    """Bodies of which one is a moving link that touched, by ids in ascending order."""

    @staticmethod
    def joined(parts: Sequence[_Extremes]) -> _Extremes:
        """Return what several motions reach together."""
        boxes = [
            np.stack(
                [
                    np.min([getattr(p, name)[0] for p in parts], axis=0),
                    np.max([getattr(p, name)[1] for p in parts], axis=0),
                ]
            )
            for name in ("box", "bodies")
        ]
        return _Extremes(
            np.min([p.low for p in parts], axis=0),
            np.max([p.high for p in parts], axis=0),
            np.max([p.speed for p in parts], axis=0),
            np.max([p.force for p in parts], axis=0),
            boxes[0],
            boxes[1],
            frozenset().union(*(p.pairs for p in parts)),
        )


def check_workspace(cfg: MotionLimitsCfg) -> None:
    """Check that a stated workspace is a box.

    Raises:
        ConcentError: It is none.
    """
    box = cfg.workspace
    if box and (len(box) != 6 or not np.all(np.array(box[:3]) < np.array(box[3:]))):
        raise ConcentError(
            "the workspace is no box", expected="x, y, z of its lowest and of its highest corner", found=list(box)
        )


@dataclass(frozen=True)
class MotionLimits:
    """Limits of motions in a scene."""

    recorded: RecordedRange
    cfg: MotionLimitsCfg
    engine: EngineName

    def __post_init__(self) -> None:
        check_workspace(self.cfg)

    @property
    def m(self) -> mujoco.MjModel:
        """The compiled scene."""
        return self.recorded.m

    @cached_property
    def joints(self) -> np.ndarray:
        """Ids of the joints with one degree of freedom, shape (J,)."""
        return np.flatnonzero(np.isin(self.m.jnt_type, SINGLE))

    @cached_property
    def links(self) -> frozenset[int]:
        """Ids of the bodies that joints of one degree of freedom move."""
        moved = set()
        for b in range(1, self.m.nbody):
            at = b
            while at and not any(int(self.m.jnt_bodyid[j]) == at for j in self.joints):
                at = int(self.m.body_parentid[at])
            if at:
                moved.add(b)
        return frozenset(moved | (set(robot_bodies(self.m)) & moved))

    @cached_property
    def recording(self) -> _Extremes:
        """What the present recording reaches, simulated with the likeliest hypothesis."""
        simulator, found = make_engine(self.engine, self.recorded.model), []
        for d, (qpos, qvel) in zip(self.recorded.recording.demonstrations, self.recorded.starts, strict=True):
            steps = max(int(np.ceil(d.duration / simulator.timestep - 1e-9)), 1)
            ctrl = commands(simulator.compiled, d, steps)
            rollout = (
                simulator.carrying(d.payloads)
                .run(Variants(1, qpos=qpos[None], qvel=qvel[None]), ctrl, bodies=[])
                .numpy()
            )
            found.append(self._extremes(rollout.qpos[0], rollout.qvel[0], ctrl))
        return _Extremes.joined(found)

    @cached_property
    def position(self) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest positions of the joints, shape (J,) each."""
        middle, half = (self.recording.low + self.recording.high) / 2, (self.recording.high - self.recording.low) / 2
        slack = self.cfg.tolerance * half + 1e-3
        low, high = middle - self.cfg.reach * half - slack, middle + self.cfg.reach * half + slack
        limited = self.m.jnt_limited[self.joints].astype(bool)
        low = np.where(limited, np.maximum(low, np.minimum(self.m.jnt_range[self.joints, 0], self.recording.low)), low)
        high = np.where(
            limited, np.minimum(high, np.maximum(self.m.jnt_range[self.joints, 1], self.recording.high)), high
        )
        return low, high

    @cached_property
    def speed(self) -> np.ndarray:
        """Highest speeds of the joints, shape (J,)."""
        return self.cfg.speed * (1 + self.cfg.tolerance) * self.recording.speed + 1e-3

    @cached_property
    def force(self) -> np.ndarray:
        """Largest forces of the actuators, shape (nu,)."""
        limit = self.cfg.unlimited_force * self.recording.force + 1e-6
        limited = self.m.actuator_forcelimited.astype(bool)
        share = self.cfg.force * np.abs(self.m.actuator_forcerange).max(axis=1)
        return np.where(limited, np.maximum(share, self.recording.force * (1 + 1e-6)), limit)

    @cached_property
    def workspace(self) -> np.ndarray:
        """Lowest and highest corner of the box of moving links [m], shape (2, 3)."""
        if self.cfg.workspace:
            return np.array(self.cfg.workspace, dtype=float).reshape(2, 3)
        margin = self.cfg.workspace_margin
        return self.recording.box + np.array([[-margin], [margin]])  # infinite where nothing is a link

    def excess(self, motion: ProposedMotion, course: Course) -> Excess:
        """Return by how much a motion exceeds the limits, whichever hypothesis is true.

        Args:
            motion: The motion.
            course: What each hypothesis predicts of it.
        """
        ctrl = commands(self.m, Demonstration(motion.name, action=motion.action), len(course.time))
        far = {self.m.body(name).id for name in motion.away}
        found = [self._extremes(qpos, qvel, ctrl, far) for qpos, qvel in zip(course.qpos, course.qvel, strict=True)]
        reached, sizes = _Extremes.joined(found), dict[str, float]()
        low, high = self.position
        span = np.maximum(high - low, 1e-6)
        over = np.maximum(np.maximum(low - reached.low, reached.high - high), 0) / span
        sizes |= {f"range of {self._joint(k)}": float(v) for k, v in enumerate(over)}
        over = np.maximum(reached.speed / self.speed - 1, 0)
        sizes |= {f"speed of {self._joint(k)}": float(v) for k, v in enumerate(over)}
        over = np.maximum(reached.force / self.force - 1, 0)
        sizes |= {f"force of {self.m.actuator(k).name}": float(v) for k, v in enumerate(over)}
        boxes = [reached.box] + ([reached.bodies] if self.cfg.workspace else [])
        space = self.workspace
        size = np.maximum(space[1] - space[0], 1e-6) if np.isfinite(space).all() else np.ones(3)
        for box in boxes if np.isfinite(space).all() else ():
            out = np.maximum(np.maximum(space[0] - box[0], box[1] - space[1]), 0)
            sizes["workspace"] = max(sizes.get("workspace", 0.0), float((out / size).max()))
        if not self.cfg.contacts:
            for a, b in reached.pairs - self.recording.pairs:
                sizes[f"contact of {self.m.body(a).name} and {self.m.body(b).name}"] = 1.0
        exceeded = {name: size for name, size in sizes.items() if size > 1e-9}
        return Excess(sum(exceeded.values()), tuple(exceeded))

    def used(self, motions: Iterable[tuple[ProposedMotion, Course]]) -> dict[str, float]:
        """Return the largest shares of the limits of speed and force that motions use [-]."""
        parts = [
            self._extremes(c.qpos[0], c.qvel[0], commands(self.m, Demonstration("", action=motion.action), len(c.time)))
            for motion, c in motions
        ]
        reached = _Extremes.joined(parts)
        shares = {"speed": (reached.speed / self.speed).max(initial=0.0)}
        shares["force"] = (reached.force / self.force).max(initial=0.0)
        return {name: float(value) for name, value in shares.items()}

    def _joint(self, k: int) -> str:
        """Return the name of the k-th joint of one degree of freedom."""
        joint = int(self.joints[k])
        return self.m.joint(joint).name or f"joint {joint}"

    def _extremes(self, qpos: np.ndarray, qvel: np.ndarray, ctrl: np.ndarray, away: Iterable[int] = ()) -> _Extremes:
        """Return what a motion reaches, from positions (T, nq), velocities (T, nv) and commands (K, nu)."""
        m, far = self.m, set(away)
        data = mujoco.MjData(m)
        links = sorted(self.links)
        geoms = np.flatnonzero(np.isin(m.geom_bodyid, links))
        free = [b for b in free_bodies(m) if b not in far]
        force, low, high = np.zeros(m.nu), np.full(3, np.inf), np.full(3, -np.inf)
        low_body, high_body, pairs = np.full(3, np.inf), np.full(3, -np.inf), set()
        for k in range(0, len(qpos), max(int(SAMPLING / m.opt.timestep), 1)):
            data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[k], qvel[k], ctrl[min(k, len(ctrl) - 1)]
            mujoco.mj_forward(m, data)
            force = np.maximum(force, np.abs(data.actuator_force))
            places = np.concatenate([data.xpos[links], data.geom_xpos[geoms]])
            low, high = (
                np.minimum(low, places.min(axis=0, initial=np.inf)),
                np.maximum(high, places.max(axis=0, initial=-np.inf)),
            )
            if free:
                low_body = np.minimum(low_body, data.xpos[free].min(axis=0))
                high_body = np.maximum(high_body, data.xpos[free].max(axis=0))
            for a, b in m.geom_bodyid[data.contact.geom].reshape(-1, 2)[data.contact.dist < 0]:
                if (int(a) in self.links) or (int(b) in self.links):
                    pairs.add((min(int(a), int(b)), max(int(a), int(b))))
        address, dof = m.jnt_qposadr[self.joints], m.jnt_dofadr[self.joints]
        return _Extremes(
            qpos[:, address].min(axis=0),
            qpos[:, address].max(axis=0),
            np.abs(qvel[:, dof]).max(axis=0),
            force,
            np.stack([low, high]),
            np.stack([low_body, high_body]),
            frozenset(pairs),
        )
