"""Forces at surfaces beside MuJoCo's contacts: friction of a surface with a grain or against rotation, adhesion."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import product
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from concent_warp.effects.compiled_forces import Row, pull_to_plane
from concent_warp.effects.force_model import ForceModel
from concent_warp.effects.select import static_geoms

if TYPE_CHECKING:
    import mujoco_warp as mjw
    import warp as wp

GEOM = mujoco.mjtGeom
FADE_SPEED = 2e-3
"""Sliding speed below which the force fades out [m/s], v0 of its formula: friction without it is discontinuous."""

SHARE_OF_STOP = 4.0
"""Contacts that together stop a turning body in one step at most [-]: the corners of a box, four points of a rim."""


class ContactForce(ForceModel):
    """A force at each contact of a body with what stands still."""

    def __init__(self, m: mujoco.MjModel, bodies: np.ndarray) -> None:
        """Act on the contacts of some bodies, ids of shape (n,)."""
        self.moving = np.zeros(m.ngeom, dtype=bool)
        self.moving[np.isin(m.geom_bodyid, bodies)] = True
        self.still = np.zeros(m.ngeom, dtype=bool)
        self.still[static_geoms(m)] = True
        self._device: tuple[wp.array[Any], wp.array[Any]] | None = None

    def contacts(self, m: mujoco.MjModel, d: mujoco.MjData) -> Callable[[], Iterator[tuple[int, int, int, float]]]:
        """Return a function that yields the present contacts: index, dimension, body and normal force [N]."""
        moving, still, body_of = self.moving.tolist(), self.still.tolist(), m.geom_bodyid.tolist()
        elliptic = m.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC

        def present() -> Iterator[tuple[int, int, int, float]]:
            if not d.ncon:
                return
            # A handful of contacts: plain numbers are several times faster than arrays of them.
            pairs, address, dims = (v.tolist() for v in (d.contact.geom, d.contact.efc_address, d.contact.dim))
            for i, (first, second) in enumerate(pairs):
                geom = first if moving[first] and still[second] else second if moving[second] and still[first] else -1
                if geom < 0 or address[i] < 0:
                    continue
                # A pyramid's edges each carry a share of the normal force.
                rows = 1 if elliptic or dims[i] == 1 else 2 * (dims[i] - 1)
                yield i, dims[i], body_of[geom], sum(d.efc_force[address[i] : address[i] + rows].tolist())

        return present

    def on_device(self) -> tuple[wp.array[Any], wp.array[Any]]:
        """Return which geoms are the body's and which stand still, on the device."""
        import warp as wp

        if self._device is None:
            self._device = (wp.array(self.moving, dtype=bool), wp.array(self.still, dtype=bool))
        return self._device


class AnisotropicForce(ContactForce):
    """-(ratio - 1) mu N v_y / sqrt(|v|^2 + v0^2) along y at each contact of a body with what stands still.

    v is the sliding velocity [m/s], N the normal force [N] of the step before. The parameter is the ratio, shape (1,).
    """

    def bound(self, m: mujoco.MjModel, d: mujoco.MjData, values: np.ndarray) -> Callable[[], None]:
        """See `ForceModel.bound`."""
        extra = float(values[0]) - 1.0
        if not extra:
            return lambda: None
        contacts, root_of = self.contacts(m, d), m.body_rootid.tolist()
        twist, middle, about, applied = d.cvel, d.xipos, d.subtree_com, d.xfrc_applied

        def act() -> None:
            contact = d.contact
            for i, dim, body, load in contacts():
                if dim < 3:
                    continue
                (px, py, pz), (nx, ny, nz) = contact.pos[i].tolist(), contact.frame[i, :3].tolist()
                wx, wy, wz, vx, vy, vz = twist[body].tolist()
                cx, cy, cz = about[root_of[body]].tolist()
                rx, ry, rz = px - cx, py - cy, pz - cz
                vx, vy, vz = vx + wy * rz - wz * ry, vy + wz * rx - wx * rz, vz + wx * ry - wy * rx
                into = nx * vx + ny * vy + nz * vz
                vx, vy, vz = vx - into * nx, vy - into * ny, vz - into * nz
                speed = math.sqrt(vx * vx + vy * vy + vz * vz + FADE_SPEED**2)
                force = -extra * float(contact.friction[i, 0]) * load * vy / speed
                x, _, z = middle[body].tolist()
                applied[body] += (0.0, force, 0.0, (z - pz) * force, 0.0, (px - x) * force)

        return act

    def launch(self, m: mjw.Model, d: mjw.Data, values: wp.array[Any]) -> None:
        """See `ForceModel.launch`."""
        from concent_warp.kernels import contact_force_models

        contact_force_models.add_anisotropic_friction(m, d, *self.on_device(), values, FADE_SPEED)


class TurningForce(ContactForce):
    """A torque -min(c N, I w / (4 dt)) against turning about the normal, or across it, at each contact of a body.

    The contacts are those with what stands still; N is the normal force [N] of the step before, w the rate [rad/s], I
    the free body's inertia about that axis, dt the time step: `SHARE_OF_STOP` contacts together stop the body in a step
    at most. The parameter is the coefficient c [m], shape (1,).
    """

    def __init__(self, m: mujoco.MjModel, bodies: np.ndarray, *, rolling: bool) -> None:
        """Act on the contacts of some bodies, ids of shape (n,), against rolling or against turning in place."""
        super().__init__(m, bodies)
        self.rolling = rolling

    def bound(self, m: mujoco.MjModel, d: mujoco.MjData, values: np.ndarray) -> Callable[[], None]:
        """See `ForceModel.bound`."""
        coefficient = float(values[0])
        if coefficient <= 0:
            return lambda: None
        contacts, rolling = self.contacts(m, d), self.rolling
        stop = 1 / (SHARE_OF_STOP * m.opt.timestep)
        least = np.maximum(m.body_inertia, mujoco.mjMINVAL).tolist()
        twist, axes, applied = d.cvel, d.ximat, d.xfrc_applied

        def act() -> None:
            contact = d.contact
            for i, _, body, load in contacts():
                (nx, ny, nz), (wx, wy, wz) = contact.frame[i, :3].tolist(), twist[body, :3].tolist()
                about = nx * wx + ny * wy + nz * wz
                ax, ay, az = about * nx, about * ny, about * nz
                if rolling:
                    ax, ay, az = wx - ax, wy - ay, wz - az
                rate = math.sqrt(ax * ax + ay * ay + az * az)
                if rate <= 0:
                    continue
                ax, ay, az = ax / rate, ay / rate, az / rate
                xx, xy, xz, yx, yy, yz, zx, zy, zz = axes[body].tolist()
                ix, iy, iz = least[body]
                turned = (ax * xx + ay * yx + az * zx) ** 2 / ix
                turned += (ax * xy + ay * yy + az * zy) ** 2 / iy + (ax * xz + ay * yz + az * zz) ** 2 / iz
                torque = -min(coefficient * load, rate * stop / turned)
                applied[body] += (0.0, 0.0, 0.0, torque * ax, torque * ay, torque * az)

        return act

    def launch(self, m: mjw.Model, d: mjw.Data, values: wp.array[Any]) -> None:
        """See `ForceModel.launch`."""
        from concent_warp.kernels import contact_force_models

        contact_force_models.add_turning_friction(m, d, *self.on_device(), values, SHARE_OF_STOP, rolling=self.rolling)


class AdhesionForce(ForceModel):
    """Pulls the points of a body that lie within a gap of a plane or box that stands still towards it.

    The points are corners of boxes, ends of capsules, four points of each rim of cylinders, the outermost vertices of
    meshes, and the nearest point of a sphere. The parameter is the force at each of them, shape (1,). It is not a
    matter of MuJoCo's contacts, which a sliding body loses and finds again from step to step.
    """

    def __init__(self, m: mujoco.MjModel, bodies: np.ndarray, gap: float) -> None:
        """Act on bodies, ids of shape (n,), within `gap` [m]."""
        self.gap = gap
        colliding = (m.geom_contype != 0) | (m.geom_conaffinity != 0)
        geoms = np.flatnonzero(np.isin(m.geom_bodyid, bodies) & colliding)
        points = [_outermost(m, int(g)) for g in geoms]
        self.geom = np.repeat(geoms, [len(p) for p in points]).astype(np.int32)
        self.point = np.concatenate([np.zeros((0, 3)), *points]).astype(np.float32)
        """In the frame of its geom [m], shape (P, 3)."""
        self.round = np.isin(m.geom_type[self.geom], [GEOM.mjGEOM_SPHERE, GEOM.mjGEOM_CAPSULE])
        """Whether the geom's first size is a radius about the point, shape (P,)."""
        flat = np.isin(m.geom_type, [GEOM.mjGEOM_PLANE, GEOM.mjGEOM_BOX]) & colliding
        self.still = np.intersect1d(static_geoms(m), np.flatnonzero(flat)).astype(np.int32)
        if np.all(m.geom_type[self.still] == GEOM.mjGEOM_PLANE):
            self.acts = pull_to_plane
        self._device: tuple[wp.array[Any], wp.array[Any], wp.array[Any], wp.array[Any]] | None = None

    def rows(self, m: mujoco.MjModel, values: np.ndarray) -> list[Row]:
        """See `ForceModel.rows`; a row for each geom and plane."""
        strength = float(values[0])
        if strength <= 0:
            return []
        found: list[Row] = []
        for g in np.unique(self.geom).tolist():
            points, radius, reach = self._points(m, g)
            numbers = [strength, self.gap, radius, reach, *points.ravel().tolist()]
            found += [([g, plane, int(m.geom_bodyid[g]), len(points)], numbers) for plane in self.still.tolist()]
        return found

    def _points(self, m: mujoco.MjModel, geom: int) -> tuple[np.ndarray, float, float]:
        """Return the points of a geom in its frame [m], shape (P, 3), its radius and how far it reaches [m]."""
        mine = self.geom == geom
        radius = float(m.geom_size[geom, 0]) if self.round[mine][0] else 0.0
        points = self.point[mine].astype(float)
        return points, radius, float(np.linalg.norm(points, axis=1).max()) + radius + self.gap

    def bound(self, m: mujoco.MjModel, d: mujoco.MjData, values: np.ndarray) -> Callable[[], None]:
        """See `ForceModel.bound`."""
        strength = float(values[0])
        if strength <= 0:
            return lambda: None
        parts = []
        for g in np.unique(self.geom):
            points, radius, reach = self._points(m, g)
            body = m.geom_bodyid[g]
            pose = d.geom_xpos[g], d.geom_xmat[g]
            parts.append((*pose, points, points.tolist(), radius, reach, d.xipos[body], d.xfrc_applied[body]))
        flat = [int(g) for g in self.still if m.geom_type[g] == GEOM.mjGEOM_PLANE]
        boxes = [
            (d.geom_xpos[g], d.geom_xmat[g].reshape(3, 3), m.geom_size[g].copy())
            for g in self.still
            if m.geom_type[g] != GEOM.mjGEOM_PLANE
        ]
        planes: list[tuple[float, float, float, float]] = []

        def act() -> None:
            if not d.time:
                return
            if len(planes) < len(flat):  # poses of what stands still are known from the first step on
                for g in flat:
                    (nx, ny, nz), (x, y, z) = d.geom_xmat[g, 2::3].tolist(), d.geom_xpos[g].tolist()
                    planes.append((nx, ny, nz, x * nx + y * ny + z * nz))
            for centre, turn, points, listed, radius, reach, middle, applied in parts:
                # A handful of points: plain numbers are several times faster than arrays of them.
                cx, cy, cz = centre.tolist()
                xx, xy, xz, yx, yy, yz, zx, zy, zz = turn.tolist()
                for nx, ny, nz, level in planes:
                    height = cx * nx + cy * ny + cz * nz - level
                    if height > reach:
                        continue
                    ax, ay, az = nx * xx + ny * yx + nz * zx, nx * xy + ny * yy + nz * zy, nx * xz + ny * yz + nz * zz
                    below, count, sx, sy, sz = self.gap + radius - height, 0, 0.0, 0.0, 0.0
                    for px, py, pz in listed:
                        if px * ax + py * ay + pz * az < below:
                            count, sx, sy, sz = count + 1, sx + px, sy + py, sz + pz
                    if count:
                        # All pull alike, so that their forces act as one at the sum of their arms.
                        mx, my, mz = middle.tolist()
                        x = xx * sx + xy * sy + xz * sz + count * (cx - radius * nx - mx)
                        y = yx * sx + yy * sy + yz * sz + count * (cy - radius * ny - my)
                        z = zx * sx + zy * sy + zz * sz + count * (cz - radius * nz - mz)
                        fx, fy, fz = -strength * nx, -strength * ny, -strength * nz
                        twist = y * fz - z * fy, z * fx - x * fz, x * fy - y * fx
                        applied += (count * fx, count * fy, count * fz, *twist)
                for origin, axes, half in boxes:
                    away = (centre - origin) @ axes
                    if (np.abs(away) > half + reach).any():
                        continue
                    about = turn.reshape(3, 3)
                    local = points @ (about.T @ axes) + away
                    beyond = np.abs(local) - half
                    face = beyond.argmax(axis=1)
                    row = np.arange(len(local))
                    over = (beyond > 0).sum(axis=1) <= 1
                    for i in np.flatnonzero(over & (beyond[row, face] - radius < self.gap)):
                        normal = np.sign(local[i, face[i]]) * axes[:, face[i]]
                        x, y, z = centre + about @ points[i] - radius * normal - middle
                        fx, fy, fz = -strength * normal
                        applied += (fx, fy, fz, y * fz - z * fy, z * fx - x * fz, x * fy - y * fx)

        return act

    def launch(self, m: mjw.Model, d: mjw.Data, values: wp.array[Any]) -> None:
        """See `ForceModel.launch`."""
        import warp as wp

        from concent_warp.kernels import contact_force_models

        if self._device is None:
            self._device = (
                wp.array(self.geom, dtype=int),
                wp.array(self.point, dtype=wp.vec3),
                wp.array(self.round, dtype=bool),
                wp.array(self.still, dtype=int),
            )
        contact_force_models.add_adhesion(m, d, *self._device, values, self.gap)


def _outermost(m: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return the points of a geom that may touch a plane first, in its frame [m], shape (P, 3)."""
    kind, (x, y, z) = int(m.geom_type[geom]), m.geom_size[geom]
    sides = np.array(list(product((-1.0, 1.0), repeat=3)))
    if kind == GEOM.mjGEOM_SPHERE:
        return np.zeros((1, 3))
    if kind == GEOM.mjGEOM_CAPSULE:
        return np.array([[0, 0, -y], [0, 0, y]])
    if kind == GEOM.mjGEOM_CYLINDER:
        return np.array([[x * np.cos(a), x * np.sin(a), s * y] for s in (-1, 1) for a in np.arange(4) * np.pi / 2])
    if kind == GEOM.mjGEOM_BOX:
        return sides * [x, y, z]
    if kind == GEOM.mjGEOM_MESH:
        first = m.mesh_vertadr[m.geom_dataid[geom]]
        vertices = m.mesh_vert[first : first + m.mesh_vertnum[m.geom_dataid[geom]]]
        return vertices[np.unique((vertices @ sides.T).argmax(axis=0))].astype(float)
    return np.zeros((0, 3))
