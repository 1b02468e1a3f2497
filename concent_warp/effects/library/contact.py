"""Effects in contacts: friction of five kinds, softness and rebound, adhesion."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np

from concent_warp.effects.effect import Effect, Parameter
from concent_warp.effects.library.contact_forces import AdhesionForce, AnisotropicForce, TurningForce
from concent_warp.effects.library.drives import GRIP_FACTORS
from concent_warp.effects.library.joints import FRICTION_SCATTER, MUJOCO
from concent_warp.effects.library.solref import as_time_and_ratio, compliance_parameters, scaled
from concent_warp.effects.select import (
    element_name,
    fingers,
    free_bodies,
    geoms_of,
    jointed_contact_targets,
    surfaces,
    unguided_body_targets,
)

if TYPE_CHECKING:
    from concent_warp.effects.force_model import ForceModel

SLIDING, TORSIONAL, ROLLING = 0, 1, 2
MIN_FRICTION = 1e-5
"""MuJoCo's smallest friction coefficient."""
COULOMB = f"Coulomb friction in MuJoCo's contacts, the larger of the two geoms' coefficients ({MUJOCO})"


TURNING = "Coulomb friction: a torque beside MuJoCo's contacts where the model has none, else that of the contacts"


class SurfaceEffect(Effect):
    """An effect on contacts between bodies and static geoms, or between several bodies."""

    family = "contact"
    kind = "body"
    requirement = "bodies with geoms that collide"
    of_joints: ClassVar[bool] = False
    """Whether bodies on joints, such as a finger and the door that it presses on, may lack it too."""

    def applies_to(self, m: mujoco.MjModel, i: int) -> bool:
        """Return whether the body collides."""
        return _collides(m, i)

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return each body without bearings that collides, and bodies on joints that can touch one another."""
        found = (*unguided_body_targets(m), *(jointed_contact_targets(m) if cls.of_joints else ()))
        return tuple(t for t in found if all(cls(*t).applies_to(m, m.body(n).id) for n in t))

    def geoms(self, m: mujoco.MjModel) -> np.ndarray:
        """Return the geoms of the target and of all that stands still, shape (n,) int."""
        return np.unique(np.concatenate([surfaces(m, b) for b in self.ids(m)]))


class FrictionEffect(SurfaceEffect):
    """A friction coefficient of these contacts."""

    column: int
    """Which of MuJoCo's three coefficients."""
    condim: int
    """Dimension that a contact needs to have it."""
    turns: ClassVar[bool] = False
    """Whether it acts against rotation: as a force beside MuJoCo's contacts where the model has no such friction."""

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Give the contacts of all geoms the dimension, with next to no friction where it comes anew."""
        mine = [geom for n in self.target for geom in _colliding(spec.body(n).geoms)]
        raised = [geom for geom in mine if geom.condim < self.condim]
        if not raised or (self.turns and len(raised) == len(mine)):
            return
        for geom in _colliding(spec.geoms):
            for column, needed in ((TORSIONAL, 4), (ROLLING, 6)):
                if geom.condim < needed <= self.condim:
                    geom.friction[column] = MIN_FRICTION
        for geom in raised:
            geom.condim = self.condim

    def null(self, m: mujoco.MjModel) -> float:
        """Return the coefficient that the model has."""
        if self._lacks(m):
            return 0.0
        return float(m.geom_friction[self.geoms(m), self.column].max())

    def _lacks(self, m: mujoco.MjModel) -> bool:
        """Return whether the contacts of a model have no such friction."""
        return bool(m.geom_condim[np.concatenate([geoms_of(m, b) for b in self.ids(m)])].max() < self.condim)

    def _is_new(self, m: mujoco.MjModel) -> bool:
        """Return whether it is a force beside the contacts of a model."""
        return self.turns and self._lacks(m)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:
        """Friction."""
        return () if self._is_new(m) else ("geom_friction",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Set the largest coefficient, and all others in proportion."""
        if self._is_new(m):
            return
        geoms = self.geoms(m)
        share = np.maximum(m.geom_friction[geoms, self.column], MIN_FRICTION)
        m.geom_friction[geoms, self.column] = np.maximum(values[0] * share / share.max(), MIN_FRICTION)


class TurningFriction(FrictionEffect):
    """Friction against rotation.

    In MuJoCo's contacts a small coefficient does not bound the torque: up to tens of rad/s it grows with the rate.
    """

    turns = True

    def force_model(self, m: mujoco.MjModel) -> ForceModel | None:
        """Return the torque of contacts that have no such friction yet."""
        return TurningForce(m, self.ids(m), rolling=self.column == ROLLING) if self._is_new(m) else None


FRICTION_FACTORS = (0.4, 0.7, 1.4, 2.0, 2.8)
"""Coefficients of sliding friction that are tried, over the model's: a box that tumbles, tumbles another way with each,
and a fit does not get from one to the other."""
MAX_FRICTION = 3.0
"""Largest coefficient of sliding friction."""


class SlidingFriction(FrictionEffect):
    """Another coefficient of sliding friction."""

    name = "sliding_friction"
    summary = "The tangential force is at most a coefficient times the normal force."
    source = COULOMB
    signature = "residual force against sliding, whatever the speed, in proportion to the normal force"
    confusions = ("anisotropic_friction", "mass", "grip_force", "gravity_tilt", "torsional_friction")
    formula_error = FRICTION_SCATTER
    of_joints = True
    column, condim = SLIDING, 3

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return one coefficient."""
        null = self.null(m)
        scan = tuple(value for x in FRICTION_FACTORS if (value := null * x) <= MAX_FRICTION)
        return (Parameter("coefficient", "-", null, 0.0, MAX_FRICTION, 0.15, scan=scan),)


class TorsionalFriction(TurningFriction):
    """Friction against spinning in place."""

    name = "torsional_friction"
    summary = "The torque about the contact normal is at most a coefficient times the normal force."
    source = TURNING
    signature = "spin about the normal that dies away too soon, while sliding is right"
    confusions = ("sliding_friction", "inertia", "rolling_friction")
    formula_error = FRICTION_SCATTER
    column, condim = TORSIONAL, 4

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return one coefficient, a length."""
        return (Parameter("coefficient", "m", self.null(m), 0.0, 0.2, 0.005, scan=(0.002, 0.01)),)


class RollingFriction(TurningFriction):
    """Friction against rolling."""

    name = "rolling_friction"
    summary = "The torque about tangents of a contact is at most a coefficient times the normal force."
    source = TURNING
    signature = "rolling that slows down at a constant rate"
    confusions = ("sliding_friction", "air_drag", "gravity_tilt")
    formula_error = FRICTION_SCATTER
    column, condim = ROLLING, 6

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return one coefficient, a length."""
        return (Parameter("coefficient", "m", self.null(m), 0.0, 0.1, 0.002, scan=(0.0005, 0.002)),)


class AnisotropicFriction(SurfaceEffect):
    """Friction that depends on the sliding direction."""

    name = "anisotropic_friction"
    summary = (
        "Sliding along the world's y meets ratio times the friction of sliding along x: (ratio - 1) mu N more of it, "
        "in proportion to the share of the sliding velocity along y."
    )
    source = "orthotropic Coulomb friction: Goyal, Ruina, Papadopoulos, Wear 143(2), 1991, as a force beside MuJoCo's"
    signature = "residual force against sliding in one direction of the table only"
    confusions = ("sliding_friction", "gravity_tilt")
    rarity = 6.0
    formula_error = FRICTION_SCATTER

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one ratio."""
        return (Parameter("ratio", "-", 1.0, 0.05, 10.0, 0.4),)

    def force_model(self, m: mujoco.MjModel) -> ForceModel:
        """Return the additional force along y."""
        return AnisotropicForce(m, self.ids(m))


class ContactCompliance(SurfaceEffect):
    """Contacts softer, harder or bouncier than the model's."""

    name = "contact_compliance"
    summary = "Time constant and damping ratio of the contact as a mass on a spring: softness and rebound."
    source = f"MuJoCo's solref ({MUJOCO})"
    signature = "height of rebounds; sinking in at rest and at impacts"
    confusions = ("size", "adhesion", "air_drag")
    null_error = 0.025  # rebounds of one ball from one floor scatter by 2 to 3 %
    of_joints = True
    requirement = "bodies that collide, in contacts that are damped"

    def applies_to(self, m: mujoco.MjModel, i: int) -> bool:
        """Return whether its contacts are damped."""
        return super().applies_to(m, i) and bool(np.isfinite(_mean_solref(m, np.array([i]))).all())

    def mean(self, m: mujoco.MjModel) -> np.ndarray:
        """Return time constant [s] and damping ratio of body and surroundings, as they act together, shape (2,)."""
        return _mean_solref(m, self.ids(m))

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Time constant and damping ratio; the null values are the means of body and surroundings."""
        time, ratio = map(float, self.mean(m))
        return compliance_parameters(time, ratio, float(m.opt.timestep))

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Reference of the contact's spring."""
        return ("geom_solref",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Set the mean, and all others in proportion."""
        geoms = self.geoms(m)
        m.geom_solref[geoms] = scaled(m.geom_solref[geoms], values / self.mean(m))


def _mean_solref(m: mujoco.MjModel, bodies: np.ndarray) -> np.ndarray:
    """Return time constant [s] and damping ratio of contacts of bodies (n,) with all that stands still, shape (2,).

    MuJoCo takes the mean of two geoms; stiffness and damping that are given directly, by negative numbers, come before
    a time constant, and the larger ones of two geoms act. An undamped contact has an infinite time constant.
    """
    mine = np.concatenate([geoms_of(m, b) for b in bodies])
    geoms = np.unique(np.concatenate([surfaces(m, b) for b in bodies]))
    direct = m.geom_solref[geoms, 0] <= 0
    acting = geoms[direct] if direct.any() else geoms
    sides = [np.intersect1d(acting, mine), np.setdiff1d(acting, mine)]
    means = [m.geom_solref[ids].mean(axis=0) for ids in sides if len(ids)]
    if not direct.any():
        return np.mean(means, axis=0)
    return as_time_and_ratio(np.min(means, axis=0))


class Adhesion(SurfaceEffect):
    """Adhesion between surfaces."""

    name = "adhesion"
    summary = (
        "A force that pulls each corner or end of the body towards planes and boxes that stand still, within 1 mm of "
        "them."
    )
    source = "constant pull over a short reach, in place of Dugdale's cohesive zone"
    signature = "lift-off and first slip too late; residual friction that does not go with the weight"
    confusions = ("sliding_friction", "mass")
    rarity = 6.0
    GAP = 0.001

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return one force for each point."""
        weight = float(m.body_mass[self.ids(m)].sum() * np.linalg.norm(m.opt.gravity))
        scan = tuple(weight * x for x in (0.1, 0.3, 1.0, 3.0))
        return (Parameter("force", "N", 0.0, 0.0, 30 * weight, 0.3 * weight, scan=scan),)

    def force_model(self, m: mujoco.MjModel) -> ForceModel:
        """Return the pull."""
        moving = np.flatnonzero(np.isin(m.body_weldid, m.body_weldid[self.ids(m)]))
        return AdhesionForce(m, moving, self.GAP)


class PadFriction(Effect):
    """Another coefficient of friction of the finger pads."""

    name = "pad_friction"
    family = "contact"
    kind = "body"
    summary = "Sliding friction between the fingers and the grasped object."
    source = f"Coulomb friction in MuJoCo's contacts, the pads' coefficient by priority ({MUJOCO})"
    signature = "the grasped object slips or does not"
    confusions = ("grip_force", "mass")
    formula_error = FRICTION_SCATTER
    requirement = "bodies with geoms that collide"

    def applies_to(self, m: mujoco.MjModel, i: int) -> bool:
        """Return whether the finger collides."""
        return _collides(m, i)

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the fingers that collide."""
        found = tuple(n for b in fingers(m) if _collides(m, b) and (n := element_name(m, mujoco.mjtObj.mjOBJ_BODY, b)))
        return (found,) if found else ()

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Let the pads' friction count, and not the larger of the two; the same as before at the null value.

        With priority the pads' other parameters count alone, too, so they take on what the contact had.
        """
        held = _colliding(geom for body in _loose(spec) for geom in body.geoms)
        for n in self.target:
            for pad in _colliding(_tree_geoms(spec.body(n))):
                pad.priority += 1
                if held:
                    pad.friction = np.max([pad.friction, *(geom.friction for geom in held)], axis=0)
                    pad.condim = max(pad.condim, *(geom.condim for geom in held))
                    pad.solref = 0.5 * (np.array(pad.solref) + np.mean([geom.solref for geom in held], axis=0))
                    pad.solimp = 0.5 * (np.array(pad.solimp) + np.mean([geom.solimp for geom in held], axis=0))

    def geoms(self, m: mujoco.MjModel) -> np.ndarray:
        """Return the fingers' geoms, shape (n,) int."""
        return np.unique(np.concatenate([geoms_of(m, b) for b in self.ids(m)]))

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return one coefficient."""
        held = [geoms_of(m, b) for b in free_bodies(m)]
        among = np.concatenate([self.geoms(m), *held])
        among = among[(m.geom_contype[among] != 0) | (m.geom_conaffinity[among] != 0)]
        null = float(m.geom_friction[among, SLIDING].max())
        scan = tuple(null * x for x in GRIP_FACTORS)
        return (Parameter("coefficient", "-", null, 0.0, 5.0, 0.3 * null, scan=scan),)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Friction."""
        return ("geom_friction",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Set it."""
        m.geom_friction[self.geoms(m), SLIDING] = max(float(values[0]), MIN_FRICTION)


def _collides(m: mujoco.MjModel, body: int) -> bool:
    """Return whether any geom of a body takes part in collisions."""
    geoms = geoms_of(m, body)
    return bool(((m.geom_contype[geoms] != 0) | (m.geom_conaffinity[geoms] != 0)).any())


def _colliding(geoms: Iterable[mujoco.MjsGeom]) -> list[mujoco.MjsGeom]:
    """Return those of some geoms that take part in collisions."""
    return [geom for geom in geoms if geom.contype or geom.conaffinity]


def _loose(spec: mujoco.MjSpec) -> list[mujoco.MjsBody]:
    """Return the bodies of an MJCF that have a free joint."""
    return [body for body in spec.bodies if any(j.type == mujoco.mjtJoint.mjJNT_FREE for j in body.joints)]


def _tree_geoms(body: mujoco.MjsBody) -> list[mujoco.MjsGeom]:
    """Return the geoms of a body and of those fixed to it."""
    return [*body.geoms, *(geom for child in body.bodies if not child.joints for geom in _tree_geoms(child))]
