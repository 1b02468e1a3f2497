"""Effects in tendons: springs, cables and belts along them, and what rubs in their sheaths."""

from __future__ import annotations

from typing import ClassVar

import mujoco
import numpy as np

from concent_warp.effects.effect import Effect, Parameter
from concent_warp.effects.library.joints import FRICTION_SCATTER, MUJOCO, USUAL_SHARE, let_friction_hold
from concent_warp.effects.select import element_name, typical_torque

SCANNED = (0.5, 0.7, 1.4, 2.0)
"""Stiffnesses that are tried, over the model's [-]: what swings on a spring soon is in another phase."""
USUAL_LENGTH = 0.05
"""Typical difference of a rest length from the model's, relative to it [-]."""
LEAST_LENGTH = 0.01
"""Least such difference [m or rad]."""
LEAST_ARM = 1e-6
"""Least arm of a tendon about a joint that it moves [m or -]."""


class TendonEffect(Effect):
    """An effect in tendons, by default in those along which a model has a spring or a damper."""

    family = "joints"
    kind = "tendon"
    needed: ClassVar[tuple[str, ...]]
    """Fields of the compiled model of which one is above 0 for the tendons on which it acts."""

    @classmethod
    def suits(cls, m: mujoco.MjModel, i: int) -> bool:
        """Return whether it may act on a tendon."""
        return any(float(getattr(m, name)[i]) > 0 for name in cls.needed)

    def applies_to(self, m: mujoco.MjModel, i: int) -> bool:
        """Return whether it may act on a tendon."""
        return self.suits(m, i)

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return all such tendons with a name."""
        found = (t for t in range(m.ntendon) if cls.suits(m, t))
        names = tuple(n for t in found if (n := element_name(m, mujoco.mjtObj.mjOBJ_TENDON, t)))
        return (names,) if names else ()

    def units(self, m: mujoco.MjModel) -> list[tuple[str, str]]:
        """Return for each tendon the unit of its length and of its force per length."""
        return [("rad", "N m/rad") if _turns(m, int(t)) else ("m", "N/m") for t in self.ids(m)]


class TendonStiffness(TendonEffect):
    """Another spring along a tendon than the model's."""

    name = "tendon_stiffness"
    summary = "The spring along the tendon has another stiffness k or rest length L: F = -k (l - L) along it."
    source = f"Hooke's law; MuJoCo's tendon stiffness and springlength ({MUJOCO})"
    signature = "residual force along the tendon that is linear in its length; sag and frequency of what hangs on it"
    confusions = ("mass", "joint_stiffness", "gravity_compensation", "actuator_gain")
    requirement = "tendons with a stiffness"
    needed = ("tendon_stiffness",)

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return the stiffness of each tendon, then its rest length, the middle of a range without force."""
        ids = self.ids(m)
        stiffness, rest = m.tendon_stiffness[ids], m.tendon_lengthspring[ids].mean(axis=1)
        rows = list(zip(self.target, self.units(m), stiffness, rest, strict=True))
        stiffnesses = []
        for n, (_, unit), k, _ in rows:
            k = float(k)
            scan = tuple(k * factor for factor in SCANNED)
            stiffnesses.append(Parameter(f"stiffness[{n}]", unit, k, 0.0, 10 * k, USUAL_SHARE * k, scan=scan))
        lengths = []
        for n, (unit, _), _, length in rows:
            usual = max(USUAL_LENGTH * abs(float(length)), LEAST_LENGTH)
            lengths.append(
                Parameter(f"length[{n}]", unit, float(length), length - 10 * usual, length + 10 * usual, usual)
            )
        return (*stiffnesses, *lengths)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Stiffness and rest length."""
        return ("tendon_stiffness", "tendon_lengthspring")

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Set both; a range of lengths without force is shifted."""
        ids = self.ids(m)
        stiffness, length = np.split(np.asarray(values, dtype=float), 2)
        m.tendon_stiffness[ids] = np.maximum(stiffness, 0.0)
        m.tendon_lengthspring[ids] += (length - m.tendon_lengthspring[ids].mean(axis=1))[:, None]


class TendonDamping(TendonEffect):
    """Another damper along a tendon than the model's."""

    name = "tendon_damping"
    summary = "The tendon's damping is another one: F = -d dl/dt along it."
    source = f"viscous friction; MuJoCo's tendon damping ({MUJOCO})"
    signature = "residual force along the tendon in proportion to the speed at which it lengthens"
    confusions = ("tendon_stiffness", "joint_damping", "air_drag")
    requirement = "tendons with a stiffness or a damping"
    needed = ("tendon_stiffness", "tendon_damping")

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return one coefficient for each tendon; a spring typically swings what it holds for some periods."""
        found = []
        for n, t, (_, unit) in zip(self.target, self.ids(m), self.units(m), strict=True):
            null, usual = float(m.tendon_damping[t]), 0.01 * float(m.tendon_stiffness[t])
            scale = max(USUAL_SHARE * null, usual)
            unit = unit.replace("N m/", "N m s/").replace("N/", "N s/")
            found.append(Parameter(f"damping[{n}]", unit, null, 0.0, max(10 * null, 30 * scale), scale))
        return tuple(found)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Damping."""
        return ("tendon_damping",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Set the damping."""
        m.tendon_damping[self.ids(m)] = np.maximum(values, 0.0)


class TendonFriction(TendonEffect):
    """Dry friction along tendons, as of a cable in its sheath."""

    name = "tendon_friction"
    summary = "A force of constant size along the tendon against its motion, which holds it at rest: |F| <= force."
    source = f"Coulomb friction; MuJoCo's frictionloss of tendons ({MUJOCO})"
    signature = "residual force along the tendon like -sign(speed of its length); what it moves sticks together"
    confusions = ("joint_friction", "tendon_damping", "load_friction", "actuator_gain")
    requirement = "tendons that move joints"
    variables = ("joint velocity",)
    formula_error = FRICTION_SCATTER

    @classmethod
    def suits(cls, m: mujoco.MjModel, i: int) -> bool:
        """Return whether the tendon moves joints."""
        return len(_typical_forces(m, i)) > 0

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Let it hold stiffly, where the tendon has no friction of its own yet."""
        for n in self.target:
            let_friction_hold(spec.tendon(n), spec.option.timestep)

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return one force for each tendon; typically what moves the lightest of its joints at 3 rad/s^2."""
        found = []
        for n, t, (_, unit) in zip(self.target, self.ids(m), self.units(m), strict=True):
            null, usual = float(m.tendon_frictionloss[t]), float(_typical_forces(m, int(t)).min())
            scale = max(USUAL_SHARE * null, USUAL_SHARE * usual)
            unit = "N m" if unit.startswith("N m") else "N"
            found.append(Parameter(f"force[{n}]", unit, null, 0.0, max(5 * null, 60 * usual), scale))
        return tuple(found)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Friction loss."""
        return ("tendon_frictionloss",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Set the friction loss."""
        m.tendon_frictionloss[self.ids(m)] = np.maximum(values, 0.0)


def _typical_forces(m: mujoco.MjModel, tendon: int) -> np.ndarray:
    """Return the force along a tendon that moves each of its joints at 10 rad/s^2 or m/s^2 [N or N m], shape (n,)."""
    d = mujoco.MjData(m)
    mujoco.mj_fwdPosition(m, d)
    row = slice(m.ten_J_rowadr[tendon], m.ten_J_rowadr[tendon] + m.ten_J_rownnz[tendon])
    arms, dofs = np.abs(d.ten_J[row]), m.ten_J_colind[row]
    joints = m.dof_jntid[dofs[arms > LEAST_ARM]]
    return typical_torque(m, joints) / arms[arms > LEAST_ARM]


def _turns(m: mujoco.MjModel, tendon: int) -> bool:
    """Return whether the length of a tendon is a sum of angles."""
    first = m.tendon_adr[tendon]
    wraps = range(first, first + m.tendon_num[tendon])
    joints = [int(m.wrap_objid[w]) for w in wraps if m.wrap_type[w] == int(mujoco.mjtWrap.mjWRAP_JOINT)]
    return bool(joints) and all(m.jnt_type[j] == int(mujoco.mjtJoint.mjJNT_HINGE) for j in joints)
