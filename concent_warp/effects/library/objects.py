"""Effects on objects: mass, centre of mass, inertia, size."""

from __future__ import annotations

from itertools import permutations

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.effects.effect import Effect, Parameter
from concent_warp.effects.select import (
    element_name,
    fingers,
    free_bodies,
    moving_as_one,
    outermost_links,
    turning_axes,
    unguided_body_targets,
)

POINT = "point"
"""Second target of a mass that is in a point of the body."""
LOAD_SHARE = 0.1
"""Typical load on a link that is light, unknown to the model, over the mass of the robot [-]."""
LEAST_MOMENT = 0.05
"""Least moment of inertia of a body from which a mass was taken, over the least of the model's [-]."""
EACH_AXIS = "axes"
AXES = ("axis_x", "axis_y", "axis_z", EACH_AXIS)
"""Second targets of an inertia: the moment about one principal axis is off, or each is."""
LEVER_SHARE = 0.2
"""Share of its distance from the hinge that is taken for the size of a body that is small beside it, such as a bob [-]:
its centre of mass may be off by three times as much, that of a rod by its own size."""


class BodyEffect(Effect):
    """An effect on one body: a free one, the last link of an arm, or what is fixed to one of these."""

    family = "objects"
    kind = "body"

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return each free body, each last link of an arm, and what is fixed to these, such as a tool."""
        found = [
            element_name(m, mujoco.mjtObj.mjOBJ_BODY, b)
            for moving in (*free_bodies(m), *outermost_links(m))
            for b in moving_as_one(m, moving)
            if m.body_mass[b] > 0
        ]
        return tuple((n,) for n in found if n)


class Mass(BodyEffect):
    """A body heavier or lighter than the model's.

    The target is a body, or one on joints and `POINT`: it carries another mass, in a point.
    """

    name = "mass"
    summary = (
        "Mass and inertia are the model's times a factor. Or, by a second target, point: a link carries another mass"
        " [kg] in one point of it, such as a tool or a load; its place is given in the body's frame."
    )
    source = "rigid-body dynamics"
    signature = "residual force in proportion to acceleration and gravity; how far pushes and throws carry"
    confusions = ("actuator_gain", "sliding_friction", "armature", "grip_force")
    requirement = "links that turn on joints, where the other mass is in a point"
    parts = (POINT,)

    def has_as_special_case(self, other: Effect) -> bool:
        """Return whether another effect is a factor of a mass, where this one is a mass in a point.

        Also of another body: a tool and the link that carries it move as one.
        """
        return bool(self.part) and isinstance(other, Mass) and not other.part

    @classmethod
    def single_targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the links that turn, but for fingers, each with `POINT`."""
        left_out, found = fingers(m), dict[int, str]()
        for b in range(1, m.nbody):
            link, name = int(m.body_weldid[b]), element_name(m, mujoco.mjtObj.mjOBJ_BODY, b)
            if name and link not in left_out and m.body_mass[b] > 0 and _is_turning_link(m, b):
                found.setdefault(link, name)
        return tuple((name, POINT) for name in found.values())

    def applies_to(self, m: mujoco.MjModel, i: int) -> bool:
        """Return whether a body turns on joints, where the other mass is in a point."""
        return not self.part or _is_turning_link(m, i)

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Let the compiled body have a centre of mass off its origin, where the other mass is in a point."""
        for n in self.elements if self.part else ():
            spec.body(n).simple = False

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return one factor, or the mass of the point and its place, the centre of mass where it has none."""
        if not self.part:
            return (Parameter("mass", "-", 1.0, 0.1, 10.0, 0.3, scan=(0.7, 1.4)),)
        body = self.ids(m)[0]
        own, size = float(m.body_mass[body]), _size(m, body)
        usual = max(own, LOAD_SHARE * float(m.body_subtreemass[m.body_rootid[body]]))
        places = zip("xyz", m.body_ipos[body], strict=True)
        return (
            Parameter("mass", "kg", 0.0, -0.5 * own, 10 * usual, 0.3 * usual, scan=(-0.3 * own, 0.3 * usual, usual)),
            *(Parameter(axis, "m", float(c), float(c) - 6 * size, float(c) + 6 * size, size) for axis, c in places),
        )

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:
        """Mass and inertia, and the share of the weight that is compensated; the principal axes for a point."""
        return (*mass_fields(m, self.ids(m)), *(("body_ipos", "body_iquat") if self.part else ()))

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Scale both, or add the point; a drive goes on compensating the weight that it knows."""
        if self.part:
            for body in self.ids(m):
                _add_point(m, int(body), float(values[0]), values[1:])
            return
        m.body_mass[self.ids(m)] *= values[0]
        m.body_inertia[self.ids(m)] *= values[0]
        m.body_gravcomp[self.ids(m)] /= values[0]


def _is_turning_link(m: mujoco.MjModel, body: int) -> bool:
    """Return whether a body turns on joints, and does not move freely."""
    first = m.body_jntadr[m.body_weldid[body]]
    free = first < 0 or m.jnt_type[first] == int(mujoco.mjtJoint.mjJNT_FREE)
    return not free and turning_axes(m, body) > 0


def _add_point(m: mujoco.MjModel, body: int, mass: float, place: np.ndarray) -> None:
    """Give a body of a compiled model another mass [kg] in a point of its frame [m], shape (3,).

    A mass that is taken away leaves an inertia that a body may have.
    """
    own, centre = float(m.body_mass[body]), m.body_ipos[body].copy()
    if mass == 0.0:
        return
    arm, total = place - centre, own + mass
    turn = Rotation.from_quat(m.body_iquat[body], scalar_first=True).as_matrix()
    inertia = turn @ np.diag(m.body_inertia[body]) @ turn.T
    # Of two masses about the centre of both: their reduced mass at their distance.
    inertia += own * mass / total * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    moments, axes = np.linalg.eigh(inertia)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    m.body_mass[body], m.body_ipos[body] = total, centre + mass / total * arm
    m.body_inertia[body] = np.maximum(moments, LEAST_MOMENT * m.body_inertia[body].min())
    m.body_iquat[body] = Rotation.from_matrix(axes).as_quat(scalar_first=True)
    m.body_gravcomp[body] *= own / total


def mass_fields(m: mujoco.MjModel, bodies: np.ndarray) -> tuple[str, ...]:
    """Return the fields that another mass of some bodies, ids of shape (n,), changes."""
    return ("body_mass", "body_inertia", *(("body_gravcomp",) if m.body_gravcomp[bodies].any() else ()))


class CenterOfMass(BodyEffect):
    """A centre of mass off the model's."""

    name = "center_of_mass"
    summary = "The centre of mass lies off the model's, in the body's frame; the inertia about it is the model's."
    source = "rigid-body dynamics"
    signature = "turns when pushed or dropped straight; tips over one edge before the other"
    confusions = ("gravity_tilt", "frame_offset", "gravity_compensation")

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Let the compiled body have a centre of mass off its origin."""
        for n in self.target:
            spec.body(n).simple = False

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return an offset along each axis of the body."""
        size = _size(m, self.ids(m)[0])
        return tuple(Parameter(axis, "m", 0.0, -3 * size, 3 * size, 0.3 * size) for axis in "xyz")

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Centre of mass."""
        return ("body_ipos",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Shift it."""
        m.body_ipos[self.ids(m)] += values


def _size(m: mujoco.MjModel, body: int) -> float:
    """Return the size of a body [m]: its radius of gyration, or a share of its distance from its hinges."""
    extent = float(np.sqrt(m.body_inertia[body].max() / max(m.body_mass[body], 1e-9)))
    return max(extent, LEVER_SHARE * _lever(m, body))


def _lever(m: mujoco.MjModel, body: int) -> float:
    """Return the distance of the centre of mass from the body's hinges [m], 0 without any.

    A small bob on a long cable is as far off as the cable may be longer.
    """
    found = [0.0]
    for j in range(m.body_jntadr[body], m.body_jntadr[body] + m.body_jntnum[body]):
        arm = m.body_ipos[body] - m.jnt_pos[j]
        if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE:
            found.append(float(np.linalg.norm(np.cross(m.jnt_axis[j], arm))))
        elif m.jnt_type[j] == mujoco.mjtJoint.mjJNT_BALL:
            found.append(float(np.linalg.norm(arm)))
    return max(found)


class Inertia(BodyEffect):
    """An inertia that is not the model's.

    The target is a body, or, where it turns about several axes, a body and one of `AXES`: one moment alone is off, or
    each has a factor of its own.
    """

    name = "inertia"
    summary = (
        "The inertia is the model's times a factor; the mass stays. Or, by a second target, one of"
        f" {', '.join(AXES)}: the moment about one principal axis is, or each is by a factor of its own. Axes are named"
        " by the nearest one of the body's frame."
    )
    source = "rigid-body dynamics"
    signature = "residual torque in proportion to angular acceleration; spins and rebounds too fast or too slow"
    confusions = ("armature", "size", "center_of_mass")
    requirement = "bodies that turn about several axes, where one moment of inertia is off"
    parts = AXES

    def has_as_special_case(self, other: Effect) -> bool:
        """Return whether another inertia of the same bodies has one factor, where this one has three."""
        if not isinstance(other, Inertia) or other.elements != self.elements:
            return False
        return self.part == EACH_AXIS != other.part

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the bodies; those that turn about several axes also with each of `AXES`."""
        found = super().targets(m)
        several = [n for (n,) in found if turning_axes(m, m.body(n).id) > 1]
        return (*found, *((n, part) for n in several for part in AXES))

    def applies_to(self, m: mujoco.MjModel, i: int) -> bool:
        """Return whether a body turns about several axes, where one moment is off."""
        return not self.part or turning_axes(m, i) > 1

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one factor, or one for each axis."""
        names = "xyz" if self.part == EACH_AXIS else (self.part[-1:] or self.name,)
        scan = (0.7, 1.4) if self.part else ()
        return tuple(Parameter(name, "-", 1.0, 0.1, 10.0, 0.3, scan=scan) for name in names)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Inertia."""
        return ("body_inertia",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Scale it."""
        changed = np.array([self.part in ("", EACH_AXIS, axis) for axis in AXES[:3]])
        factors = np.ones(3)
        factors[changed] = values
        for b in self.ids(m):
            m.body_inertia[b] *= factors[_nearest_axes(m, b)]


def _nearest_axes(m: mujoco.MjModel, body: int) -> np.ndarray:
    """Return the axis of a body's frame that is nearest to each of its principal axes, none twice, shape (3,) int."""
    principal = np.empty(9)
    mujoco.mju_quat2Mat(principal, m.body_iquat[body])
    towards = np.abs(principal.reshape(3, 3))
    orders = [list(order) for order in permutations(range(3))]
    return np.array(max(orders, key=lambda order: float(towards[order, range(3)].sum())))


class Size(BodyEffect):
    """Another size of a body."""

    name = "size"
    summary = (
        "All geoms of the body, their sizes and places in it, are the model's times a factor; mass and inertia stay."
    )
    source = "geometry"
    signature = "offset of the resting height; contacts come early or late"
    confusions = ("length_scale", "frame_offset", "contact_geometry")

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return each body without bearings."""
        return unguided_body_targets(m)

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one factor."""
        return (Parameter("size", "-", 1.0, 0.5, 2.0, 0.02),)

    def edit(self, spec: mujoco.MjSpec, values: np.ndarray) -> None:
        """Scale the geoms of the body; what MuJoCo would derive from them is fixed first."""
        compiled = spec.copy().compile()
        scale = float(values[0])
        for n in self.target:
            body = spec.body(n)
            keep_inertia(body, compiled)
            for geom in body.geoms:
                geom.pos = scale * np.array(geom.pos)
                if geom.type == mujoco.mjtGeom.mjGEOM_MESH:
                    _scale_mesh(spec, geom, scale)
                else:
                    geom.size = scale * np.array(geom.size)
                    geom.fromto = scale * np.array(geom.fromto)


def keep_inertia(body: mujoco.MjsBody, compiled: mujoco.MjModel) -> None:
    """Set mass and inertia of a body to those it was compiled with, however the MJCF gives them."""
    b = compiled.body(body.name).id
    body.explicitinertial, body.fullinertia = True, np.full(6, np.nan)
    body.mass, body.inertia = float(compiled.body_mass[b]), compiled.body_inertia[b]
    body.ipos, body.iquat = compiled.body_ipos[b], compiled.body_iquat[b]


def _scale_mesh(spec: mujoco.MjSpec, geom: mujoco.MjsGeom, scale: float) -> None:
    """Give a geom a scaled copy of its mesh."""
    mesh = spec.mesh(geom.meshname)
    copy = spec.add_mesh(name=f"{mesh.name}_{geom.name or geom.id}_scaled")
    copy.uservert, copy.userface = list(mesh.uservert), list(mesh.userface)
    copy.scale = scale * np.array(mesh.scale)
    copy.refpos, copy.refquat = mesh.refpos, mesh.refquat
    copy.inertia = mesh.inertia
    geom.meshname = copy.name
