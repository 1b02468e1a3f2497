"""Nominal values of a model within their tolerance: masses, lengths, gains, friction and the clocks of instruments.

They are no effects that a model lacks: data sheets, rulers and time stamps are no better. A diagnosis fits them before
it looks for an effect, each with a normal prior about the nominal value, so that small errors of several are not taken
for one.
"""

from __future__ import annotations

from typing import ClassVar

import mujoco
import numpy as np

from concent_warp.effects.effect import Effect, Parameter, Reader
from concent_warp.effects.library.drives import KV, ActuatorGain
from concent_warp.effects.library.joints import BearingEffect, JointEffect
from concent_warp.effects.library.measurement import MeasurementEffect
from concent_warp.effects.library.objects import Size, mass_fields
from concent_warp.effects.select import dofs_of, element_name, free_bodies

TOLERANCE = 0.01
"""Standard deviation of a nominal value over the value [-]: what scales, rulers and data sheets state as a rule."""
CLOCK_TOLERANCE = 5e-4
"""Standard deviation of a channel's latency [s]: stamps are given when a bus is polled, at 1 kHz as a rule (a frame of
USB 2.0 takes 1 ms)."""
FRICTION_TOLERANCE = 0.05
"""Standard deviation of the friction and damping of joints over the model's [-]: several per cent between repeated
measurements of one machine (`FRICTION_SCATTER`), and as much between machines of one make."""
BOUND = 2.0
"""Bounds, in standard deviations: 95 % of a normal distribution."""
PRIOR_SCALES = 10.0
"""Standard deviations of a parameter's prior over its scale (`LeastSquaresCfg.prior`)."""


def nominal_parameters(name: str, targets: tuple[str, ...], tolerance: float = TOLERANCE) -> tuple[Parameter, ...]:
    """Return one factor a target, 1 by default, within the tolerance."""
    low, high, scale = 1 - BOUND * tolerance, 1 + BOUND * tolerance, tolerance / PRIOR_SCALES
    return tuple(Parameter(f"{name}[{t}]", "-", 1.0, low, high, scale) for t in targets)


class NominalBodyValue(Effect):
    """A nominal value of bodies that move."""

    family = "objects"
    kind = "body"
    nominal = True
    source = "tolerance of nominal values"

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return all bodies that move and have a mass and a name."""
        found = tuple(
            n
            for b in range(1, m.nbody)
            if m.body_weldid[b] and m.body_mass[b] > 0 and (n := element_name(m, mujoco.mjtObj.mjOBJ_BODY, b))
        )
        return (found,) if found else ()


class NominalMass(NominalBodyValue):
    """Mass of bodies within their tolerance.

    Of free bodies, whose shape and density say both, the inertia is off by as much. That of links is a nominal value of
    its own (`NominalInertia`): a catalogue or a CAD model states each, and they need not be off together.
    """

    name = "nominal_mass"
    summary = (
        "The mass is the model's times a factor within the tolerance of nominal values; that of free bodies with the "
        "inertia."
    )
    signature = "residual force in proportion to acceleration and gravity"
    confusions = ("mass",)
    part_of = "mass"

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one factor a body."""
        return nominal_parameters("mass", self.target)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:
        """Mass, inertia of free bodies, and the share of the weight that is compensated."""
        ids = self.ids(m)
        scaled = mass_fields(m, ids)
        return scaled if np.isin(ids, free_bodies(m)).any() else tuple(f for f in scaled if f != "body_inertia")

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Scale them; a drive goes on compensating the weight that it knows."""
        ids = self.ids(m)
        m.body_mass[ids] *= values
        m.body_gravcomp[ids] /= values
        free = np.isin(ids, free_bodies(m))
        m.body_inertia[ids[free]] *= values[free, None]


class NominalLinkValue(NominalBodyValue):
    """A nominal value of links."""

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the bodies that hang on others by joints."""
        free = {element_name(m, mujoco.mjtObj.mjOBJ_BODY, b) for b in free_bodies(m)}
        found = tuple(n for names in super().targets(m) for n in names if n not in free)
        return (found,) if found else ()


class NominalInertia(NominalLinkValue):
    """Inertia of links about their centre of mass within its tolerance."""

    name = "nominal_inertia"
    summary = "The inertia is the model's times a factor within the tolerance of nominal values; the mass stays."
    signature = "residual torque in proportion to angular acceleration"
    confusions = ("inertia", "armature")
    part_of = "inertia"

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one factor a link."""
        return nominal_parameters("inertia", self.target)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Inertia."""
        return ("body_inertia",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Scale it."""
        m.body_inertia[self.ids(m)] *= values[:, None]


class NominalLength(NominalLinkValue):
    """Lengths of links within their tolerance."""

    name = "nominal_length"
    summary = (
        "What a link carries (centre of mass, sites, further links) lies at the model's place in its frame times a "
        "factor within the tolerance of nominal values."
    )
    signature = "residuals in proportion to distances from the joint"
    confusions = ("length_scale", "mass")

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Let the compiled bodies have a centre of mass off their origin."""
        for n in self.target:
            spec.body(n).simple = False

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one factor a link."""
        return nominal_parameters("length", self.target)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Positions in bodies."""
        return ("body_ipos", "body_pos", "site_pos")

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Scale them."""
        for b, factor in zip(self.ids(m), values, strict=True):
            m.body_ipos[b] *= factor
            m.body_pos[m.body_parentid == b] *= factor
            m.site_pos[m.site_bodyid == b] *= factor


class NominalSize(Size):
    """Size of a free body within its tolerance."""

    name = "nominal_size"
    nominal = True
    summary = "The geoms of the body are the model's times a factor within the tolerance of nominal values."
    source = "tolerance of nominal values"
    confusions = ("size", "length_scale")
    part_of = "size"

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one factor."""
        return nominal_parameters("size", self.target)


class NominalStiffness(JointEffect):
    """Stiffness of the springs that a model has in its joints, within its tolerance."""

    name = "nominal_stiffness"
    nominal = True
    summary = (
        "The stiffness of the joint's spring is the model's times a factor within the tolerance of nominal values."
    )
    source = "tolerance of nominal values"
    signature = "residual torque in proportion to the spring's"
    confusions = ("joint_stiffness", "actuator_gain")
    part_of = "joint_stiffness"

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the hinges and slides with a spring."""
        found = tuple(n for names in super().targets(m) for n in names if m.jnt_stiffness[m.joint(n).id])
        return (found,) if found else ()

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one factor a joint."""
        return nominal_parameters("stiffness", self.target)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Stiffness."""
        return ("jnt_stiffness",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Scale it."""
        m.jnt_stiffness[self.ids(m)] *= values


class NominalBearingValue(BearingEffect):
    """A nominal value of joints that a model has, one a joint, of rotors or bearings."""

    nominal = True
    source = "tolerance of nominal values"
    field: ClassVar[str]
    """Field of the compiled model with a value a degree of freedom."""
    tolerance: ClassVar[float] = FRICTION_TOLERANCE
    """Standard deviation of the value over the model's [-]."""

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the joints that have any of it."""
        found = tuple(
            n for names in super().targets(m) for n in names if getattr(m, cls.field)[m.joint(n).dofadr].any()
        )
        return (found,) if found else ()

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one factor a joint."""
        return nominal_parameters(self.part_of.removeprefix("joint_"), self.target, self.tolerance)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """See `field`."""
        return (self.field,)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Scale it."""
        dofs, rows = dofs_of(m, self.ids(m))
        getattr(m, self.field)[dofs] *= values[rows]


class NominalDamping(NominalBearingValue):
    """Viscous friction that a model has in its joints, within its tolerance."""

    name = "nominal_damping"
    summary = "The damping of the joint is the model's times a factor within the tolerance of friction."
    signature = "residual torque in proportion to velocity"
    confusions = ("joint_damping",)
    part_of = "joint_damping"
    field = "dof_damping"


class NominalFriction(NominalBearingValue):
    """Dry friction that a model has in its joints, within its tolerance."""

    name = "nominal_friction"
    summary = "The friction loss of the joint is the model's times a factor within the tolerance of friction."
    signature = "residual torque against the motion, whatever its speed"
    confusions = ("joint_friction", "stribeck_friction", "load_friction")
    part_of = "joint_friction"
    field = "dof_frictionloss"


class NominalArmature(NominalBearingValue):
    """Inertia of rotors that a model has in its joints, within its tolerance."""

    name = "nominal_armature"
    summary = "The armature of the joint is the model's times a factor within the tolerance of nominal values."
    signature = "residual torque in proportion to acceleration"
    confusions = ("armature", "inertia")
    part_of = "armature"
    field = "dof_armature"
    tolerance = TOLERANCE


class NominalTendonStiffness(Effect):
    """Stiffness of springs that a model has along tendons, within its tolerance."""

    name = "nominal_tendon_stiffness"
    family = "joints"
    kind = "tendon"
    nominal = True
    summary = (
        "The stiffness of the tendon's spring is the model's times a factor within the tolerance of nominal values."
    )
    source = "tolerance of nominal values"
    signature = "residual force along the tendon in proportion to its spring's"
    confusions = ("joint_stiffness", "joint_friction", "actuator_gain")
    part_of = "tendon_stiffness"

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the tendons with a name and a spring."""
        sprung = np.flatnonzero(m.tendon_stiffness)
        found = tuple(n for t in sprung if (n := element_name(m, mujoco.mjtObj.mjOBJ_TENDON, int(t))))
        return (found,) if found else ()

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one factor a tendon."""
        return nominal_parameters("stiffness", self.target)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Stiffness."""
        return ("tendon_stiffness",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Scale it."""
        m.tendon_stiffness[self.ids(m)] *= values


class NominalGain(ActuatorGain):
    """Gains of actuators within their tolerance."""

    name = "nominal_gain"
    nominal = True
    summary = "The drive's force is the model's times a factor within the tolerance of nominal values."
    confusions = ("actuator_gain",)
    part_of = "actuator_gain"
    parts = ()

    @classmethod
    def is_within(cls, other: Effect) -> bool:
        """Return whether another effect is the gains of actuators, or their position gains."""
        return super().is_within(other) and other.part != KV

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one factor an actuator."""
        return nominal_parameters("gain", self.target)


class NominalVelocityGain(ActuatorGain):
    """Gains of velocity feedback within their tolerance."""

    name = "nominal_velocity_gain"
    nominal = True
    summary = "The drive's velocity feedback is the model's times a factor within the tolerance of nominal values."
    confusions = ("joint_damping", "latency")
    parts = ()

    @classmethod
    def is_within(cls, other: Effect) -> bool:
        """Return whether another effect is the velocity gains of actuators."""
        return other.name == ActuatorGain.name and other.part == KV

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the actuators with velocity feedback."""
        fed_back = {m.actuator(a).name for a in range(m.nu) if m.actuator_biasprm[a, 2]}
        found = tuple(n for names in super().targets(m) for n in names if n in fed_back)
        return (found,) if found else ()

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one factor an actuator."""
        return nominal_parameters("velocity_gain", self.target)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Bias."""
        return ("actuator_biasprm",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Scale the velocity feedback."""
        m.actuator_biasprm[self.ids(m), 2] *= values


class NominalLatency(MeasurementEffect):
    """Latencies of channels within the tolerance of clocks, each by itself."""

    name = "nominal_latency"
    nominal = True
    summary = "What a channel stamps t was seen at t - delay, with a delay within the tolerance of clocks."
    signature = "residuals in proportion to velocity, at the same delay in all phases"
    confusions = ("latency", "actuator_delay")
    part_of = "latency"

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return all sensors of poses and joints together."""
        found = tuple(n for group in super().targets(m) for n in group)
        return (found,) if found else ()

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one delay a sensor."""
        bound, scale = BOUND * CLOCK_TOLERANCE, CLOCK_TOLERANCE / PRIOR_SCALES
        return tuple(Parameter(f"delay[{t}]", "s", 0.0, -bound, bound, scale) for t in self.target)

    def measure(self, m: mujoco.MjModel, read: Reader, values: np.ndarray) -> Reader:  # noqa: ARG002
        """Read earlier."""
        delays = dict(zip(self.target, map(float, values), strict=True))
        return lambda sensor, time: read(sensor, time - delays.get(sensor, 0.0))
