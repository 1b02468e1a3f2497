"""Registry of effects: those of the library, and those that installed packages register.

A package adds its own by an entry point of the group ``concent_warp.effects`` that names a subclass of `Effect`.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points

from concent_warp.effects.effect import Effect
from concent_warp.effects.library import (
    contact,
    drives,
    geometry,
    joints,
    limits,
    measurement,
    nominal,
    objects,
    tendons,
    world,
)
from concent_warp.errors import ModelError

GROUP = "concent_warp.effects"
OURS: tuple[type[Effect], ...] = (
    joints.JointFriction,
    joints.JointDamping,
    joints.JointStiffness,
    joints.Stribeck,
    joints.LoadDependentFriction,
    joints.Armature,
    drives.ActuatorGain,
    drives.ActuatorSaturation,
    drives.ActuatorDelay,
    drives.ActuatorLag,
    drives.Backlash,
    drives.JointCompliance,
    joints.JointOffset,
    limits.LimitCompliance,
    limits.LimitOffset,
    drives.GravityCompensation,
    tendons.TendonStiffness,
    tendons.TendonDamping,
    tendons.TendonFriction,
    objects.Mass,
    objects.CenterOfMass,
    objects.Inertia,
    objects.Size,
    geometry.ContactGeometryOffset,
    contact.SlidingFriction,
    contact.AnisotropicFriction,
    contact.TorsionalFriction,
    contact.RollingFriction,
    contact.ContactCompliance,
    contact.Adhesion,
    drives.GripForce,
    contact.PadFriction,
    world.GravityTilt,
    world.AirDrag,
    world.Wind,
    measurement.TimeBase,
    measurement.Latency,
    measurement.LengthScale,
    measurement.FrameOffset,
    measurement.SensorBias,
    measurement.SensorGain,
)

NOMINAL: tuple[type[Effect], ...] = (
    nominal.NominalMass,
    nominal.NominalInertia,
    nominal.NominalLength,
    nominal.NominalSize,
    nominal.NominalArmature,
    nominal.NominalStiffness,
    nominal.NominalTendonStiffness,
    nominal.NominalDamping,
    nominal.NominalFriction,
    nominal.NominalGain,
    nominal.NominalVelocityGain,
    nominal.NominalLatency,
)
"""Nominal values within their tolerance, which a model may have and no diagnosis calls missing."""


@cache
def effect_classes() -> dict[str, type[Effect]]:
    """Return all effects by name: those of the library, then those that packages register.

    Raises:
        ModelError: A package registers what cannot be imported, something else than an effect, or a name that is taken.

    Example:
        >>> import concent_warp as cw
        >>> "joint_friction" in cw.effect_classes()
        True
    """
    found: dict[str, type[Effect]] = {effect.name: effect for effect in OURS}
    for entry in entry_points(group=GROUP):
        try:
            loaded = entry.load()
        except (ImportError, AttributeError) as error:
            raise ModelError(
                "the effect cannot be imported", where=f"entry point {entry.name} = {entry.value}", found=error
            ) from error
        if not (isinstance(loaded, type) and issubclass(loaded, Effect)):
            raise ModelError(
                "not an effect", where=f"entry point {entry.name} = {entry.value}", expected="a subclass of Effect"
            )
        if loaded.name in found or loaded.name in {kind.name for kind in NOMINAL}:
            raise ModelError("the name of an effect is taken", where=f"entry point {entry.value}", found=loaded.name)
        found[loaded.name] = loaded
    return found


def effect_class(name: str) -> type[Effect]:
    """Return the effect of a name.

    Raises:
        ModelError: There is none.

    Example:
        >>> import concent_warp as cw
        >>> cw.effect_class("joint_friction").family
        'joints'
    """
    import difflib

    known = effect_classes() | {kind.name: kind for kind in NOMINAL}
    if name in known:
        return known[name]
    near = [n for n in effect_classes() if name and name in n] or difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean {' or '.join(map(repr, near))}?" if near else f"one of {', '.join(known)}"
    raise ModelError(f"no effect {name!r}", fix=hint)
