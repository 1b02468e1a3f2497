"""A hidden effect of a rig, and the drives and bodies of rigs that effects act on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np

from concent_warp.reality.rigs.rig import Rig
from concent_warp.reality.world import HiddenEffect


@dataclass(frozen=True)
class HiddenEffectOfRig:
    """A hidden effect of a rig with its true parameters."""

    name: str
    """Canonical name of the effect."""
    effect: HiddenEffect
    truth: Mapping[str, float] = field(default_factory=dict)
    """True values of the parameters by name, with the joint, drive or sensor in brackets if there are several."""
    target: tuple[str, ...] = ()
    """Joints, drives, bodies or sensors that it acts on; empty for an effect that the library lacks."""


Builder = Callable[[Rig, float], HiddenEffectOfRig]
"""Makes an effect of a magnitude, in the unit of its main parameter."""


@dataclass(frozen=True)
class Drive:
    """A position-controlled joint of a rig."""

    actuator: str
    joint: str
    kp: float
    """Stiffness [N m/rad or N/m]."""
    kv: float
    """Damping [N m s/rad or N s/m]."""
    limit: float
    """Largest force [N m or N]."""
    weight: float
    """Strength against that of the strongest drive [-]: what friction and inertia of a size are for one of them."""

    def error_force(self, model: mujoco.MjModel, data: mujoco.MjData) -> float:
        """Return the force that the servo exerts at this state [N m or N]."""
        joint = model.joint(self.joint)
        error = data.ctrl[model.actuator(self.actuator).id] - data.qpos[joint.qposadr[0]]
        return float(np.clip(self.kp * error - self.kv * data.qvel[joint.dofadr[0]], -self.limit, self.limit))


def drives(rig: Rig) -> tuple[Drive, ...]:
    """Return the drives of a rig's arm, its gripper's left out."""
    m = rig.scene.model
    found = []
    for a in range(m.nu):
        if m.actuator(a).name in rig.grippers:
            continue
        joint = m.joint(m.actuator_trnid[a, 0]).name
        kp, kv = m.actuator_gainprm[a, 0], -m.actuator_biasprm[a, 2]
        limit = float(m.actuator_forcerange[a, 1]) if m.actuator_forcelimited[a] else np.inf
        found.append((m.actuator(a).name, joint, float(kp), float(kv), limit))
    # Where a drive has no limit, its strength follows from its stiffness.
    strength = np.array([f[4] for f in found])
    strength = strength if np.isfinite(strength).all() else np.array([f[2] for f in found])
    return tuple(Drive(*f, weight=float(s / strength.max())) for f, s in zip(found, strength, strict=True))


class PerTrialState:
    """State of a hook that begins anew with each trial, that is where time runs back."""

    def __init__(self) -> None:
        self.last = np.inf

    def step(self, now: float) -> float | None:
        """Return the time since the last call [s], None at the first of a trial."""
        elapsed = None if now <= self.last - 1e-9 or not np.isfinite(self.last) else now - self.last
        self.last = now
        return elapsed


def true_values(name: str, owners: tuple[str, ...], values: np.ndarray) -> dict[str, float]:
    """Return true values of a parameter of each owner."""
    return {f"{name}[{owner}]": float(value) for owner, value in zip(owners, values, strict=True)}


def fixed_inertia(spec: mujoco.MjSpec, name: str) -> mujoco.MjsBody:
    """Return a body whose mass and inertia are written out, so that they can be changed."""
    body = spec.body(name)
    if not body.explicitinertial:
        compiled = spec.copy().compile().body(name)
        body.explicitinertial = True
        body.mass, body.inertia = float(compiled.mass[0]), compiled.inertia
        body.ipos, body.iquat = compiled.ipos, compiled.iquat
    return body
