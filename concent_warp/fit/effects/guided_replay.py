"""Replays that follow what was measured of a motion, for the states of what was not.

A camera that looks down does not see how high an object stands, and a gripper may have an encoder on one finger only.
A model that is set to the readings again and again knows the rest well, where that is held by contacts or drives
(direct insertion: Hoke and Anthes, "The initialization of numerical models by a dynamic-initialization technique",
Monthly Weather Review 104, 1976). How well is shown by replays from other initial states that are set to the same
readings: where they come together, the rest does not depend on what nobody knows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.errors import EngineError, RecordingError
from concent_warp.estimation.partial_state import PartialState, PartialStateEstimator
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.replay import commands, interpolate
from concent_warp.simulate.select import make_engine

if TYPE_CHECKING:
    from concent_warp.model import Model
    from concent_warp.recording.recording import Demonstration

PERIOD = 0.02
"""Time after which a replay is set to the readings again [s]: that of a camera of 50 Hz."""
SAMPLES = 4
"""Replays from other initial states."""


@dataclass(frozen=True)
class GuidedReplay:
    """States over a demonstration: as measured, and the rest as in replays that follow the measured part."""

    partial: PartialStateEstimator
    time: np.ndarray
    """Times at which the replays are set to the readings, just before, shape (R,) [s]."""
    qpos: np.ndarray
    """States of the replay from the first state, shape (R, nq)."""
    qvel: np.ndarray
    """Shape (R, nv)."""
    known: np.ndarray
    """Whether the replays from other initial states agree in what was not measured, shape (R,) bool."""

    @staticmethod
    def of(
        model: Model,
        d: Demonstration,
        partial: PartialStateEstimator,
        spread: np.ndarray,
        agreement: np.ndarray,
        *,
        seed: int = 0,
    ) -> GuidedReplay | None:
        """Return the replays of a demonstration; None where it cannot be simulated.

        Args:
            model: The model.
            d: What was commanded and measured.
            partial: The states, as far as they were measured.
            spread: Standard deviation of the first state, positions and then velocities, shape (2 nv,).
            agreement: Standard deviation of states that counts as agreement, likewise.
            seed: Seed of the other initial states.
        """
        m = model.compile()
        last = max((float(c.time[-1]) for c in d.measured.values() if len(c.time)), default=0.0)
        every = max(round(PERIOD / m.opt.timestep), 1)
        time = np.arange(0.0, last, every * m.opt.timestep)
        try:
            ctrl = commands(m, d, every * max(len(time) - 1, 1))
            engine = make_engine("mujoco", model.with_payloads(d.payloads))
        except (RecordingError, EngineError):
            return None
        seen, moved = partial.states(time)
        places, rates = _measured_coordinates(partial)
        rng = np.random.default_rng(seed)
        positions, velocities = np.tile(seen[0], (1 + SAMPLES, 1)), np.tile(moved[0], (1 + SAMPLES, 1))
        for k in range(1, 1 + SAMPLES):
            offset = rng.normal(size=2 * m.nv) * spread
            mujoco.mj_integratePos(m, positions[k], offset[: m.nv], 1.0)
            velocities[k] += offset[m.nv :]
        course = [(positions.copy(), velocities.copy())]
        for row in range(len(time) - 1):
            positions[:, places], velocities[:, rates] = seen[row, places], moved[row, rates]
            part = Variants(1 + SAMPLES, qpos=positions, qvel=velocities)
            found = engine.run(part, ctrl[row * every : (row + 1) * every], record=[every], bodies=[]).numpy()
            if found.diverged[0]:
                return None
            positions, velocities = np.array(found.qpos[:, -1]), np.array(found.qvel[:, -1])
            for state, of_first in ((positions, positions[0]), (velocities, velocities[0])):
                state[found.diverged] = of_first
            course.append((positions.copy(), velocities.copy()))
        return GuidedReplay(
            partial,
            time,
            np.array([qpos[0] for qpos, _ in course]),
            np.array([qvel[0] for _, qvel in course]),
            np.array([(_deviation(m, *states) <= agreement)[~np.tile(partial.measured, 2)].all() for states in course]),
        )

    def state(self, time: float) -> PartialState:
        """Return the state at a time [s]."""
        m, at = self.partial.compiled, np.array([time])
        qpos, qvel = interpolate(self.time, self.qpos, at)[0], interpolate(self.time, self.qvel, at)[0]
        mujoco.mj_normalizeQuat(m, qpos)
        seen, moved = self.partial.states(at)
        places, rates = _measured_coordinates(self.partial)
        qpos[places], qvel[rates] = seen[0, places], moved[0, rates]
        return PartialState(qpos, qvel, self.partial.measured)

    def is_known(self, time: np.ndarray) -> np.ndarray:
        """Return whether the replays tell what was not measured at `time` (T,) [s], shape (T,) bool."""
        row = np.clip(np.searchsorted(self.time, time), 0, len(self.time) - 1)
        return self.known[row] & self.known[np.maximum(row - 1, 0)]

    def scatter_of_both_sides(self, time: np.ndarray) -> np.ndarray:
        """Return the scatter of the readings on both sides of each of `time` (T,), see `worst_scatter`, shape (T,)."""
        return self.partial.scatter_of_both_sides(time)


def _measured_coordinates(partial: PartialStateEstimator) -> tuple[np.ndarray, np.ndarray]:
    """Return which coordinates and which velocities were measured, shapes (nq,) and (nv,) bool."""
    m, rates = partial.compiled, partial.measured.copy()
    rates[list(partial.rates)] = True
    places = np.zeros(m.nq, dtype=bool)
    for joint in range(m.njnt):
        place, dof = int(m.jnt_qposadr[joint]), int(m.jnt_dofadr[joint])
        kind = int(m.jnt_type[joint])
        if kind == int(mujoco.mjtJoint.mjJNT_FREE):
            places[place : place + 3] = partial.measured[dof : dof + 3]
            places[place + 3 : place + 7] = partial.measured[dof + 3]
        elif kind == int(mujoco.mjtJoint.mjJNT_BALL):
            places[place : place + 4] = partial.measured[dof]
        else:
            places[place] = partial.measured[dof]
    return places, rates


def _deviation(m: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Return the standard deviation of some states (K, nq) and (K, nv) about the first, shape (2 nv,)."""
    away = np.zeros((len(qpos) - 1, m.nv))
    for k in range(1, len(qpos)):
        mujoco.mj_differentiatePos(m, away[k - 1], 1.0, qpos[0], qpos[k])
    return np.sqrt((np.hstack([away, qvel[1:] - qvel[0]]) ** 2).mean(axis=0))
