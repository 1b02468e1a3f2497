"""Hidden effects of an object: mass, centre of mass, inertia, size, shape."""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.reality.hidden.hidden_effect import Builder, HiddenEffectOfRig, fixed_inertia
from concent_warp.reality.rigs.rig import Rig
from concent_warp.reality.world import HiddenEffect, chamfered_box


def mass(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of a factor [-] on mass and inertia."""

    def edit(spec: mujoco.MjSpec) -> None:
        body = fixed_inertia(spec, rig.body)
        body.mass *= magnitude
        body.inertia = magnitude * np.array(body.inertia)

    return HiddenEffectOfRig("mass", HiddenEffect("mass", edit=edit), {"mass": magnitude}, (rig.body,))


def center_of_mass(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return a centre of mass displaced along x [m], and half as much along -y, body frame."""
    shift = magnitude * np.array([1.0, -0.5, 0.0])

    def edit(spec: mujoco.MjSpec) -> None:
        body = fixed_inertia(spec, rig.body)
        body.ipos = np.array(body.ipos) + shift

    truth = dict(zip("xyz", map(float, shift), strict=True))
    return HiddenEffectOfRig("center_of_mass", HiddenEffect("center_of_mass", edit=edit), truth, (rig.body,))


def inertia(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of a factor [-] on the inertia at the same mass."""

    def edit(spec: mujoco.MjSpec) -> None:
        body = fixed_inertia(spec, rig.body)
        body.inertia = magnitude * np.array(body.inertia)

    return HiddenEffectOfRig("inertia", HiddenEffect("inertia", edit=edit), {"inertia": magnitude}, (rig.body,))


def size(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of a factor [-] on lengths at the same mass and inertia."""

    def edit(spec: mujoco.MjSpec) -> None:
        body = fixed_inertia(spec, rig.body)
        for geom in body.geoms:
            geom.size = magnitude * np.array(geom.size)
            geom.pos = magnitude * np.array(geom.pos)

    return HiddenEffectOfRig("size", HiddenEffect("size", edit=edit), {"size": magnitude}, (rig.body,))


def contact_geometry(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of a box wider on one side [m], with worn edges; mass and inertia are nominal."""

    def edit(spec: mujoco.MjSpec) -> None:
        body = fixed_inertia(spec, rig.body)
        for geom in body.geoms:
            if geom.type != mujoco.mjtGeom.mjGEOM_BOX:
                continue
            corners = chamfered_box(np.array(geom.size), 0.5 * magnitude)
            corners[:, 0] += np.where(corners[:, 0] > 0, magnitude * (1 + np.sign(corners[:, 1])) / 2, 0.0)
            corners[:, 2] -= np.where((corners[:, 2] < 0) & (corners[:, 0] > 0), magnitude, 0.0)
            mesh = spec.add_mesh(name=f"{geom.name}_worn")
            mesh.uservert = corners.ravel()
            geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, mesh.name

    return HiddenEffectOfRig("contact_geometry", HiddenEffect("contact_geometry", edit=edit), {}, (rig.body,))


OBJECTS: dict[str, Builder] = {f.__name__: f for f in (mass, center_of_mass, inertia, size, contact_geometry)}
