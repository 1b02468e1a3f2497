"""Play between drive and link as a force."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from concent_warp.effects.compiled_forces import Row, pass_play, through_play
from concent_warp.effects.force_model import ForceModel
from concent_warp.effects.select import driven_joints

if TYPE_CHECKING:
    import mujoco_warp as mjw
    import warp as wp


class BacklashForce(ForceModel):
    """Lets a servo's force through to the link only where its rotor presses on an end of the play.

    The rotor, without mass, is ahead of the link by x, |x| <= |g| play / 2, with g the gear. With e the error of the
    link, l its length, kp and kv the gains, the servo's force on it is f(x) = kp (e - x) - kv l'. Within the play
    kv (l' + x') = kp (e - x) and nothing gets through; at the ends f(x) does while it presses that way. A step in which
    the rotor arrives counts in proportion to the time that is left. The parameter is the width of the play at the
    joint, shape (1,); x is kept in the user data.
    """

    acts = staticmethod(pass_play)

    def __init__(self, actuators: np.ndarray, first: int) -> None:
        """Act on position-controlled actuators of single joints, ids of shape (n,); user data begin at `first`."""
        self.actuators = np.asarray(actuators, dtype=np.int32)
        self.first = first
        self._device: wp.array[Any] | None = None

    def rows(self, m: mujoco.MjModel, values: np.ndarray) -> list[Row]:
        """See `ForceModel.rows`."""
        play = float(values[0])
        gears = [Gear.of(m, int(a), play) for a in self.actuators] if play > 0 else []
        return [([g.actuator, g.place, g.dof, self.first + g.actuator], g.numbers()) for g in gears]

    def launch(self, m: mjw.Model, d: mjw.Data, values: wp.array[Any]) -> None:
        """See `ForceModel.launch`."""
        import warp as wp

        from concent_warp.kernels import force_models

        if self._device is None:
            self._device = wp.array(self.actuators, dtype=int)
        force_models.apply_loose_gear(m, d, self._device, self.first, values)


@dataclass(frozen=True)
class Gear:
    """The numbers of one loose gear, see `BacklashForce`; positions and forces as the actuator sees them."""

    actuator: int
    place: int
    """Of the joint's position."""
    dof: int
    gear: float
    kp: float
    kv: float
    lowest: float
    """Of the command; infinite where it is not limited."""
    highest: float
    weakest: float
    """Of the force."""
    strongest: float
    offset: float
    """Error of the link at command and position 0, over kp."""
    slope: float
    """Change of that error with the joint's position."""
    half: float
    """Half the play."""
    fading: float
    """Share of the error that the rotor keeps over a free step."""
    timestep: float

    @classmethod
    def of(cls, m: mujoco.MjModel, actuator: int, play: float) -> Gear:
        """Return those of an actuator of a compiled model, with play [rad or m]."""
        joint = driven_joints(m, actuator)[0]
        gear, kp = float(m.actuator_gear[actuator, 0]), float(m.actuator_gainprm[actuator, 0])
        constant, position, damping = (float(b) for b in m.actuator_biasprm[actuator, :3])
        kv, dt = max(-damping, 1e-9 * kp), float(m.opt.timestep)
        lowest, highest = _limits_of(m.actuator_ctrllimited[actuator], m.actuator_ctrlrange[actuator])
        weakest, strongest = _limits_of(m.actuator_forcelimited[actuator], m.actuator_forcerange[actuator])
        return cls(
            actuator,
            int(m.jnt_qposadr[joint]),
            int(m.jnt_dofadr[joint]),
            gear,
            kp,
            -damping,
            lowest,
            highest,
            weakest,
            strongest,
            constant / kp,
            position * gear / kp,
            0.5 * play * abs(gear),
            math.exp(-dt * kp / kv),
            dt,
        )

    def numbers(self) -> list[float]:
        """Return what a step needs, for `through_play`."""
        servo = [self.gear, self.kp, self.kv, self.lowest, self.highest, self.weakest, self.strongest]
        return [*servo, self.offset, self.slope, self.half, self.fading, self.timestep]

    def through(self, error: float, speed: float, ahead: float | None) -> tuple[float, float]:
        """Return what `through_play` does; the rotor's lead is None before the first step."""
        return through_play(self.numbers(), error, speed, ahead is not None, ahead or 0.0)


def _limits_of(limited: bool, bounds: np.ndarray) -> tuple[float, float]:
    """Return the bounds, shape (2,), infinite where there are none."""
    return (float(bounds[0]), float(bounds[1])) if limited else (-math.inf, math.inf)
