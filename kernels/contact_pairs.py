"""Contact pairs of the stage that each world is in: features of every slot and the reaching reward.

From the paper, appendix C. Slot i of a stage has a pair: a robot link or a sphere a, and the spot b of an object that
it touches in the demonstration. With x_a, x_b the pair's local points in the world, r_a, r_b their radii and n the
outward unit normal of the target surface in the world,

    c = x_a - r_a n        contact point: the spot of a's sphere that faces the target
    b = x_b + r_b n        its target: the spot of b's sphere that the normal leaves
    delta = b - c          displacement                          d = |delta|   distance of the pair
    u = delta / |delta|    approach direction

so that d = 0 exactly where the pair touches as demonstrated. A radius of 0 makes its point the contact point itself.
The observation's table gives the end effector in the world, and names no frame for the slots: all vectors of a slot
are in the world frame too. The reward of a world is that of its worst pair, at two scales,

    A_far exp(-max_i d_i / sigma_far) + A_near exp(-max_i d_i / sigma_near)

Quaternions are wxyz, stored in `wp.quat` as four plain numbers, as in MuJoCo-Warp.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from .rollout import UNSTABLE, rotate_by_quaternion

wp.set_module_options({"enable_backward": False})

MASK, POINT, DISPLACEMENT, DIRECTION, NORMAL = 0, 1, 4, 7, 10
"""First column of each feature within a slot."""
SLOT_SIZE = 13
"""Numbers a slot: mask 1, contact point, displacement, approach direction and target normal 3 each."""
SLOT_COUNT = 8
"""Slots of the paper's observation: 8 x 13 = 104 of its 148 numbers."""
COINCIDENT = wp.constant(1.0e-6)
"""Distance [m] below which the approach direction shrinks towards 0, so that it has no jump where points coincide."""


@dataclass(frozen=True)
class PairTable:
    """The contact pairs of S stages in N slots each; what is in an inactive slot is not read."""

    body_a: np.ndarray
    """Body of the robot link, or of the sphere that is moved, shape (S, N) int."""
    point_a: np.ndarray
    """Its contact point, or the centre of its sphere [m], frame of `body_a`, shape (S, N, 3)."""
    radius_a: np.ndarray
    """Radius of its sphere [m], 0 where `point_a` is the contact point itself, shape (S, N)."""
    body_b: np.ndarray
    """Body of the target, shape (S, N) int."""
    point_b: np.ndarray
    """Its contact point, or the centre of its sphere [m], frame of `body_b`, shape (S, N, 3)."""
    radius_b: np.ndarray
    """Radius of its sphere [m], 0 where `point_b` is the contact point itself, shape (S, N)."""
    normal: np.ndarray
    """Outward unit normal of the target surface, frame of `body_b`, shape (S, N, 3); zero where it is not known."""
    active: np.ndarray
    """Whether the slot has a pair, shape (S, N) bool."""

    def __post_init__(self) -> None:
        stages_slots = np.shape(self.active)
        if len(stages_slots) != 2 or 0 in stages_slots:
            raise ValueError(f"PairTable: active must be of shape (stages, slots), found {stages_slots}.")
        for name in ("body_a", "point_a", "radius_a", "body_b", "point_b", "radius_b", "normal"):
            value = np.asarray(getattr(self, name))
            expected = (*stages_slots, 3) if name in ("point_a", "point_b", "normal") else stages_slots
            if value.shape != expected:
                raise ValueError(f"PairTable: {name} must be of shape {expected}, found {value.shape}.")
            if not np.isfinite(value[self.used]).all():
                raise ValueError(f"PairTable: {name} has values that are not finite.")
        length = np.linalg.norm(np.asarray(self.normal)[self.used], axis=-1)
        if not ((np.abs(length - 1) < 1e-3) | (length == 0)).all():
            raise ValueError("PairTable: normal must be of length 1, or zero where it is not known.")

    @property
    def used(self) -> np.ndarray:
        """Where slots are active, shape (S, N) bool."""
        return np.asarray(self.active, dtype=bool)


class ContactPairs:
    """Features and reaching reward of W worlds, with buffers of its own: nothing is allocated in `launch`.

    `launch` may be recorded by `wp.ScopedCapture`; it reads the arrays given to the constructor, and never waits.

    Args:
        table: pairs of all stages.
        xpos: body origins [m], `wp.vec3`, shape (W, nbody), as in MuJoCo-Warp's data.
        xquat: body orientations, `wp.quat` holding wxyz, shape (W, nbody).
        stage: stage of each world, int32, shape (W,). A stage outside of 0..S-1 has no active slot.
        amplitude: A_far and A_near [-].
        sigma: sigma_far and sigma_near [m].
        features: where to write the features, float32, shape (W, N * SLOT), on the device of `xpos`; may be a strided
            view, say columns 44 to 147 of an observation. By default a buffer is made.

    Raises:
        ValueError: if an array has another shape, type or device than stated, or a body or scale cannot be.
    """

    features: wp.array
    """Of each slot the mask, contact point [m], displacement [m], approach direction and target normal, world frame,
    float32, shape (W, N * SLOT); all zero for inactive slots, and for pairs with a pose that is not finite."""
    distance: wp.array
    """Distance of each pair [m], float32, shape (W, N); -1 in inactive slots, NaN where a pose is not finite."""
    worst: wp.array
    """Slot of the pair farthest apart, the first of equals, int32, shape (W,); -1 where no slot is active or a pose is
    not finite."""
    worst_distance: wp.array
    """Its distance [m], float32, shape (W,); 0 where `worst` is -1."""
    reach: wp.array
    """Far and near term of the reaching reward, float32, shape (W, 2); 0 where `worst` is -1, for a world without a
    target has reached nothing."""
    finite: wp.array
    """1 where the poses that the active pairs hang on are all sane, 0 where one is not finite or beyond 1e10 m, int32,
    shape (W,)."""

    def __init__(
        self,
        table: PairTable,
        xpos: wp.array,
        xquat: wp.array,
        stage: wp.array,
        *,
        amplitude: tuple[float, float] = (1.0, 2.0),
        sigma: tuple[float, float] = (0.05, 0.008),
        features: wp.array | None = None,
    ) -> None:
        device, worlds = xpos.device, xpos.shape[0]
        used = table.used
        slots = used.shape[1]
        self.features = (
            wp.zeros((worlds, slots * SLOT_SIZE), dtype=float, device=device) if features is None else features
        )
        check_poses("ContactPairs", xpos, xquat, stage)
        if not (
            self.features.dtype == wp.float32
            and self.features.shape == (worlds, slots * SLOT_SIZE)
            and self.features.device == device
        ):
            raise ValueError(
                f"ContactPairs: features must be float32 of shape {(worlds, slots * SLOT_SIZE)} on {device}, found "
                f"{self.features.dtype.__name__} of shape {self.features.shape} on {self.features.device}."
            )
        for name in ("body_a", "body_b"):
            bodies = np.asarray(getattr(table, name))[used]
            if len(bodies) and not (bodies.min() >= 0 and bodies.max() < xpos.shape[1]):
                raise ValueError(f"ContactPairs: {name} must be in 0..{xpos.shape[1] - 1}, found {bodies.max()}.")
        if not min(sigma) > 0:
            raise ValueError(f"ContactPairs: sigma must be above 0 m, found {sigma}.")

        def on_device(values: np.ndarray, dtype: type) -> wp.array:
            values = np.asarray(values)
            whole = used if values.ndim == 2 else used[..., None]
            return wp.array(np.where(whole, values, 0), dtype=dtype, device=device)

        self._poses = (xpos, xquat, stage)
        self._table = (
            wp.array(used, dtype=wp.bool, device=device),
            on_device(table.body_a, wp.int32),
            on_device(table.point_a, wp.vec3),
            on_device(table.radius_a, wp.float32),
            on_device(table.body_b, wp.int32),
            on_device(table.point_b, wp.vec3),
            on_device(table.radius_b, wp.float32),
            on_device(table.normal, wp.vec3),
        )
        self._scales = (*map(float, amplitude), *map(float, sigma))
        self.distance = wp.zeros((worlds, slots), dtype=float, device=device)
        self.worst = wp.zeros(worlds, dtype=wp.int32, device=device)
        self.worst_distance = wp.zeros(worlds, dtype=float, device=device)
        self.reach = wp.zeros((worlds, 2), dtype=float, device=device)
        self.finite = wp.zeros(worlds, dtype=wp.int32, device=device)
        wp.load_module(slot_kernel.module, device=device)

    def launch(self) -> None:
        """Write all outputs, on the current stream of the device."""
        wp.launch(
            slot_kernel,
            self.distance.shape,
            inputs=[*self._poses, *self._table],
            outputs=[self.features, self.distance],
            device=self.distance.device,
        )
        wp.launch(
            reach_kernel,
            self.distance.shape[0],
            inputs=[self.distance, *self._scales],
            outputs=[self.worst, self.worst_distance, self.reach, self.finite],
            device=self.distance.device,
        )


def check_poses(name: str, xpos: wp.array, xquat: wp.array, stage: wp.array) -> None:
    """Raise `ValueError` unless poses and stages of W worlds are arrays of the right types, shapes and device."""
    if xpos.ndim != 2:
        raise ValueError(f"{name}: xpos must be of shape (worlds, bodies), found {xpos.shape}.")
    given = (
        ("xpos", xpos, wp.vec3, xpos.shape),
        ("xquat", xquat, wp.quat, xpos.shape),
        ("stage", stage, wp.int32, xpos.shape[:1]),
    )
    for what, array, dtype, shape in given:
        if array.dtype != dtype or array.shape != shape or array.device != xpos.device:
            raise ValueError(
                f"{name}: {what} must be {dtype.__name__} of shape {shape} on {xpos.device}, found "
                f"{array.dtype.__name__} of shape {array.shape} on {array.device}."
            )


@wp.func
def write_vector(features: wp.array2d[float], world: int, column: int, value: wp.vec3):
    """Write three columns."""
    for k in range(3):
        features[world, column + k] = value[k]


@wp.kernel
def slot_kernel(
    xpos: wp.array2d[wp.vec3],
    xquat: wp.array2d[wp.quat],
    stage: wp.array[int],
    active: wp.array2d[wp.bool],
    body_a: wp.array2d[int],
    point_a: wp.array2d[wp.vec3],
    radius_a: wp.array2d[float],
    body_b: wp.array2d[int],
    point_b: wp.array2d[wp.vec3],
    radius_b: wp.array2d[float],
    normal: wp.array2d[wp.vec3],
    features: wp.array2d[float],
    distance: wp.array2d[float],
):
    """Write the features of one slot and the distance of its pair; dim (W, N). Arguments as in `ContactPairs`."""
    world, i = wp.tid()
    s = stage[world]
    contact = wp.vec3()
    delta = wp.vec3()
    direction = wp.vec3()
    outward = wp.vec3()
    mask = wp.float32(0.0)
    apart = wp.float32(-1.0)
    # The clamp keeps the table from being read out of bounds: both sides of an `and` are evaluated.
    row = wp.clamp(s, 0, active.shape[0] - 1)
    if s == row and active[row, i]:
        a = body_a[row, i]
        b = body_b[row, i]
        n = rotate_by_quaternion(xquat[world, b], normal[row, i])
        c = xpos[world, a] + rotate_by_quaternion(xquat[world, a], point_a[row, i]) - radius_a[row, i] * n
        d = xpos[world, b] + rotate_by_quaternion(xquat[world, b], point_b[row, i]) + radius_b[row, i] * n - c
        apart = wp.length(d)
        # The second sum catches a pose that is huge or not a number where the first cancels.
        if apart + wp.length(c) < UNSTABLE:
            mask = 1.0
            contact = c
            delta = d
            direction = d / wp.max(apart, COINCIDENT)
            outward = n
        else:
            apart = wp.nan
    first = i * SLOT_SIZE
    features[world, first + MASK] = mask
    write_vector(features, world, first + POINT, contact)
    write_vector(features, world, first + DISPLACEMENT, delta)
    write_vector(features, world, first + DIRECTION, direction)
    write_vector(features, world, first + NORMAL, outward)
    distance[world, i] = apart


@wp.kernel
def reach_kernel(
    distance: wp.array2d[float],
    far: float,
    near: float,
    sigma_far: float,
    sigma_near: float,
    worst: wp.array[int],
    worst_distance: wp.array[float],
    reach: wp.array2d[float],
    finite: wp.array[int],
):
    """Write the worst pair of a world and its reaching reward; dim W. Arguments as in `ContactPairs`."""
    world = wp.tid()
    slot = wp.int32(-1)
    most = wp.float32(0.0)
    sane = wp.int32(1)
    for i in range(distance.shape[1]):
        apart = distance[world, i]
        if wp.isnan(apart):
            sane = 0
        elif apart >= 0.0 and (slot < 0 or apart > most):
            slot = i
            most = apart
    if sane == 0:
        slot = -1
    worst[world] = slot
    worst_distance[world] = wp.where(slot < 0, 0.0, most)
    reach[world, 0] = wp.where(slot < 0, 0.0, far * wp.exp(-most / sigma_far))
    reach[world, 1] = wp.where(slot < 0, 0.0, near * wp.exp(-most / sigma_near))
    finite[world] = sane
