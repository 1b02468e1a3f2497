"""Spring between rotor and link of a servo as a force."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from concent_warp.effects.compiled_forces import Row, drive_by_spring
from concent_warp.effects.force_model import ForceModel
from concent_warp.effects.select import driven_joints

if TYPE_CHECKING:
    import mujoco_warp as mjw
    import warp as wp

DAMPING_RATIO = 0.05
"""Damping ratio of the rotor on its spring, without the servo [-]: strain wave gears and belts have a few percent."""
LEAST_DAMPING = 0.25
"""Least relaxation time of the spring, damping over stiffness, in time steps [-]: it damps what a step cannot resolve,
as a rotor without inertia, and takes the velocity at the end of the step."""
SLOTS = 4
"""User data of an actuator."""
IMPLICIT = (mujoco.mjtIntegrator.mjINT_IMPLICIT, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
"""Integrators that take the servo's velocity at the end of a step."""


class ElasticGearForce(ForceModel):
    """Drives links by rotors behind springs.

    A rotor has the joint's armature J as its inertia and is ahead of the link by the twist x. The servo's force f0, for
    a rotor that is where the link is, drives it against the spring [Spong, J. Dyn. Sys. Meas. Control 109(4), 1987]:

        J (q'' + x'') = f0 - (kp + K) x - (kv + D) x',    torque on the link T = K x + D x'

    A step takes x as (x_before + 2 x + x_after) / 4 and x' as the mean of the velocities before and after it (Newmark's
    method with beta = 1/4: no numerical damping, stable for any stiffness) and everything else as MuJoCo does. Then x''
    and T are linear in q'':

        T = S f0 - S (J + h kv) q'' + (K - S (kp + K)) x + (D - S (kv + D)) x',
        S = (h^2 K / 4 + h D / 2) / (J + h^2 (kp + K) / 4 + h (kv + D) / 2)

    with h the step, and the term h kv where the integrator takes kv q' at the end of a step. So the servo and the
    armature are weakened to the share S, and the rest is applied as a force. For a stiff spring S is 1 and x is 0: the
    model without the effect, to the last term. A servo at a limit of its force gives that one, whatever x and q' are in
    the step: kp and kv are then left out, and its share is applied as a force too.

    Of the servo's damping, a share may act on the rotor and the rest on the link, where a servo takes the speed from an
    encoder behind the gear: kv in the terms with x' and S is then that share of it.

    The parameters are compliances 1 / K at the joints and that share, shape (n + 1,). The user data have x, x' and
    what makes the next x' of the link's velocity; a site for each actuator shows x, x' and the servo's force.
    """

    edits = ("dof_armature", "actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "site_pos")
    acts = staticmethod(drive_by_spring)

    def __init__(self, actuators: np.ndarray, sites: np.ndarray, first: int) -> None:
        """Act on position-controlled actuators of single joints.

        Args:
            actuators: Their ids, shape (n,).
            sites: Ids of the sites whose positions show the twists, shape (n,).
            first: Place of actuator 0 in the user data.
        """
        self.actuators = np.asarray(actuators, dtype=np.int32)
        self.sites = np.asarray(sites, dtype=np.int32)
        self.first = first
        self._device: tuple[wp.array[Any], wp.array[Any]] | None = None

    def rows(self, m: mujoco.MjModel, values: np.ndarray) -> list[Row]:
        """See `ForceModel.rows`."""
        every, side = zip(self.actuators, self.sites, values[:-1], strict=True), float(values[-1])
        gears = [ElasticGear.of(m, int(a), int(site), 1 / float(c), side) for a, site, c in every if c > 0]
        return [([g.actuator, g.site, g.place, g.dof, self.first + SLOTS * g.actuator], g.numbers()) for g in gears]

    def launch(self, m: mjw.Model, d: mjw.Data, values: wp.array[Any]) -> None:
        """See `ForceModel.launch`."""
        import warp as wp

        from concent_warp.kernels import force_models

        if self._device is None:
            self._device = wp.array(self.actuators, dtype=int), wp.array(self.sites, dtype=int)
        force_models.apply_elastic_gear(m, d, *self._device, self.first, values, DAMPING_RATIO, LEAST_DAMPING)


@dataclass(frozen=True)
class ElasticGear:
    """The numbers of one elastic gear, see `ElasticGearForce`; all at the joint but the servo's own."""

    actuator: int
    site: int
    place: int
    """Of the joint's position."""
    dof: int
    gear: float
    lowest: float
    """Of the command; infinite where it is not limited."""
    highest: float
    weakest: float
    """Of the servo's force."""
    strongest: float
    gain: float
    bias: tuple[float, float, float]
    kp: float
    kv: float
    """Of the servo's damping, what acts on the rotor."""
    stiffness: float
    damping: float
    inertia: float
    """Of the rotor."""
    implicit: float
    """What the integrator adds to that by taking kv q' at the end of a step."""
    spring: float
    """Inertia that stands for spring and damper in a step."""
    servo: float
    """That which stands for the servo's stiffness and damping."""
    timestep: float

    @classmethod
    def of(cls, m: mujoco.MjModel, actuator: int, site: int, stiffness: float, on_rotor: float) -> ElasticGear:
        """Return those of an actuator of a compiled model, with a stiffness [N m/rad or N/m] at the joint.

        `on_rotor` is the share of the servo's damping that acts on the rotor [-].
        """
        joint = driven_joints(m, actuator)[0]
        dof, dt = int(m.jnt_dofadr[joint]), float(m.opt.timestep)
        gear, gain = float(m.actuator_gear[actuator, 0]), float(m.actuator_gainprm[actuator, 0])
        constant, position, velocity = (float(b) for b in m.actuator_biasprm[actuator, :3])
        kp, kv, inertia = -(gear**2) * position, -(gear**2) * velocity, float(m.dof_armature[dof])
        centred = 2 * DAMPING_RATIO * math.sqrt(stiffness * inertia)
        late = max(LEAST_DAMPING * dt * stiffness - centred, 0.0)
        lowest, highest = limits_of(m.actuator_ctrllimited[actuator], m.actuator_ctrlrange[actuator])
        weakest, strongest = limits_of(m.actuator_forcelimited[actuator], m.actuator_forcerange[actuator])
        return cls(
            actuator,
            site,
            int(m.jnt_qposadr[joint]),
            dof,
            gear,
            lowest,
            highest,
            weakest,
            strongest,
            gain,
            (constant, position, velocity),
            kp,
            on_rotor * kv,
            stiffness,
            centred + late,
            inertia,
            dt * kv if m.opt.integrator in IMPLICIT else 0.0,
            0.25 * dt**2 * stiffness + 0.5 * dt * centred + dt * late,
            0.25 * dt**2 * kp + 0.5 * dt * max(on_rotor, 0.0) * kv,
            dt,
        )

    @property
    def share(self) -> float:
        """S, while no limit of the servo's force is reached."""
        return self.spring / (self.inertia + self.spring + self.servo)

    def numbers(self) -> list[float]:
        """Return what a step needs, for `drive_by_spring`."""
        weak = [self.share * number for number in (self.gain, *self.bias)]
        command = [self.gear, self.lowest, self.highest, self.weakest, self.strongest, self.gain, *self.bias]
        inertias = [self.inertia, self.implicit, self.spring, self.servo]
        return [*command, self.kp, self.kv, self.stiffness, self.damping, *inertias, self.timestep, *weak]


def limits_of(limited: bool, bounds: np.ndarray) -> tuple[float, float]:
    """Return the bounds, shape (2,), infinite where there are none."""
    return (float(bounds[0]), float(bounds[1])) if limited else (-math.inf, math.inf)
