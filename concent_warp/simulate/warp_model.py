"""MuJoCo-Warp's model with values that differ between worlds."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp

from concent_warp.errors import EngineError
from concent_warp.kernels import rollout as kernels
from concent_warp.simulate.fields import CONSTANTS, SOURCES_OF_CONSTANTS, apply_fields, derived_constants
from concent_warp.simulate.inputs import to_host

SPHERE_ARRAYS = {
    "sphere_position": ("geom_pos",),
    "sphere_radius": ("geom_size", "geom_rbound", "geom_aabb"),
    "sphere_friction": ("geom_friction",),
}
"""Model arrays that each property of the spheres lives in."""

OPTIONS = ("gravity", "wind", "magnetic", "density", "viscosity", "impratio")
"""Options that may differ between worlds."""

SWITCHES = (
    "stiffness",
    "stiffnesspoly",
    "damping",
    "dampingpoly",
    "frictionloss",
    "gravcomp",
    "adhesion",
    "surfacevel",
)
SWITCHES = (*SWITCHES, "armature", "density", "viscosity", "wind")
"""Endings of field names whose physics MuJoCo-Warp compiles away where the model's values are all zero."""

NEGLIGIBLE_OFFSET = 1e-4
"""Lengths [m] that drag does not notice."""

FOLDED = ("dof_damping", "dof_dampingpoly", "tendon_damping", "tendon_dampingpoly")
"""Fields to which MuJoCo-Warp adds the damping of actuators."""


class WorldModel:
    """The model of N worlds in which some spheres and fields vary."""

    def __init__(
        self,
        compiled: mujoco.MjModel,
        sphere_geom: np.ndarray,
        worlds: int,
        spheres: Sequence[str],
        fields: Mapping[str, np.ndarray],
    ) -> None:
        """Put the model on Warp's current device.

        Args:
            compiled: The model.
            sphere_geom: Geom id of each sphere, shape (S,) int, -1 for those left out.
            worlds: N.
            spheres: Properties of the spheres that vary, keys of `SPHERE_ARRAYS`.
            fields: Fields that vary, each with a typical value: not zero where any world's value is not.
        """
        self.typical = _typical_model(compiled, fields)
        self.device = wp.device_to_torch(wp.get_device())
        self._compiled, self._worlds = compiled, worlds
        self._spheres = torch.as_tensor(np.flatnonzero(sphere_geom >= 0), device=self.device)
        self._geoms = torch.as_tensor(sphere_geom[sphere_geom >= 0], device=self.device)
        names = {name for name in fields if not name.startswith("opt.")}
        self._derived = bool(names & set(SOURCES_OF_CONSTANTS))
        arrays = {array for sphere in spheres for array in SPHERE_ARRAYS[sphere]}
        arrays |= names | (set(CONSTANTS) if self._derived else set())
        self.mjw = mjw.put_model(self.typical, batch_sizes=dict.fromkeys(sorted(arrays), worlds))
        self.mjw.opt.warn_overflow = 0
        for name in fields:
            if name.startswith("opt."):
                self._widen(_option_name(name))
        self._folded = {name: self._target(name)[:1].clone() - self._typical(name) for name in names & set(FOLDED)}
        moved = np.arange(compiled.ngeom)
        if not names & {"body_pos", "body_quat"}:
            moved = sphere_geom[sphere_geom >= 0] if "sphere_position" in spheres else moved[:0]
        body = compiled.geom_bodyid[moved]
        static = (compiled.body_weldid[body] == 0) & (compiled.body_mocapid[compiled.body_rootid[body]] == -1)
        self._static = wp.array(moved[static].astype(np.int32), dtype=int)

    def load(self, spheres: Mapping[str, Any], fields: Mapping[str, Any]) -> None:
        """Set what varies, in place.

        Args:
            spheres: Each property of the spheres that varies, shape (N, S, ...).
            fields: Each field that varies, shape (N, ...).
        """
        for name, value in spheres.items():
            self._load_spheres(name, self.tensor(value)[:, self._spheres])
        for name, value in fields.items():
            target = self._target(name)
            values = self.tensor(value).reshape(target.shape)
            if name == "opt.impratio":
                values = values.rsqrt()
            target.copy_(values + self._folded[name] if name in self._folded else values)
        if self._derived:
            names = (*SOURCES_OF_CONSTANTS, *CONSTANTS)
            sources = {name: to_host(value) for name, value in fields.items() if name in names}
            for name, value in derived_constants(self._compiled, sources, self._worlds).items():
                wp.to_torch(getattr(self.mjw, name)).copy_(self.tensor(value))

    def place(self, data: mjw.Data) -> None:
        """Launch what places the geoms of static bodies by the loaded values."""
        m = self.mjw
        if len(self._static):
            mjw.kinematics(m, data)
            wp.launch(
                kernels.place_geoms_kernel,
                dim=(self._worlds, len(self._static)),
                inputs=[self._static, m.geom_bodyid, m.geom_pos, m.geom_quat, data.xpos, data.xquat],
                outputs=[data.geom_xpos, data.geom_xmat],
            )

    def tensor(self, value: Any) -> torch.Tensor:
        """Return a value as a float32 tensor on the device."""
        return torch.as_tensor(value, dtype=torch.float32, device=self.device)

    def _load_spheres(self, name: str, value: torch.Tensor) -> None:
        """Set a property of the collidable spheres, shape (N, S', ...)."""
        m, geoms = self.mjw, self._geoms
        if name == "sphere_position":
            wp.to_torch(m.geom_pos)[:, geoms] = value
        elif name == "sphere_friction":
            wp.to_torch(m.geom_friction)[:, geoms, 0] = value
        else:
            wp.to_torch(m.geom_size)[:, geoms, 0] = value
            wp.to_torch(m.geom_rbound)[:, geoms] = value
            wp.to_torch(m.geom_aabb)[:, geoms, 1] = value[..., None]

    def _widen(self, option: str) -> None:
        """Give an option one value for each world."""
        wide = wp.zeros(self._worlds, dtype=getattr(self.mjw.opt, option).dtype)
        wide._is_batched = True  # pyright: ignore[reportAttributeAccessIssue]
        setattr(self.mjw.opt, option, wide)

    def _target(self, name: str) -> torch.Tensor:
        """Return the device array of a field, shape (N, ...)."""
        if name.startswith("opt."):
            return wp.to_torch(getattr(self.mjw.opt, _option_name(name)))
        return wp.to_torch(getattr(self.mjw, name))

    def _typical(self, name: str) -> torch.Tensor:
        """Return the typical value of a field, shape (1, ...)."""
        return self.tensor(getattr(self.typical, name)).reshape(1, *self._target(name).shape[1:])


def _option_name(name: str) -> str:
    """Return MuJoCo-Warp's name of the option ``opt.<name>``."""
    return "impratio_invsqrt" if name == "opt.impratio" else name[4:]


def _typical_model(compiled: mujoco.MjModel, fields: Mapping[str, np.ndarray]) -> mujoco.MjModel:
    """Return a model in which no physics is switched off that any world needs."""
    switches = {name: value for name, value in fields.items() if is_switch(name)}
    if not switches:
        return compiled
    m = copy.copy(compiled)
    apply_fields(m, switches, mujoco.MjData(m))
    return m


def is_switch(name: str) -> bool:
    """Return whether physics may be switched off where all values of a field are zero."""
    return name.split("_")[-1].split(".")[-1] in SWITCHES


def check_drag(compiled: mujoco.MjModel, fields: Mapping[str, Any]) -> None:
    """Check that MuJoCo-Warp's drag of ellipsoids holds: it forgets the torque of shapes off their centre of mass.

    Raises:
        EngineError: A body meets a medium with such a shape, or with a centre of mass that varies.
    """
    if max(compiled.opt.density, compiled.opt.viscosity) <= 0 and not {"opt.density", "opt.viscosity"} & set(fields):
        return
    wet = np.flatnonzero((compiled.geom_fluid[:, 0] > 0) & (compiled.geom_rbound > NEGLIGIBLE_OFFSET))
    body = compiled.geom_bodyid[wet]
    centred = np.abs(compiled.geom_pos[wet] - compiled.body_ipos[body]).max(axis=1, initial=0) < NEGLIGIBLE_OFFSET
    moving = compiled.body_weldid[body] != 0
    if (moving & (~centred | ("body_ipos" in fields))).any():
        names = sorted({compiled.body(b).name for b in body[moving]})
        raise EngineError(
            "MuJoCo-Warp's drag is wrong on shapes off their centre of mass", found=names, fix="use MujocoEngine"
        )


def batchable(name: str) -> bool:
    """Return whether a model field may differ between worlds."""
    if name.startswith("opt."):
        return name[4:] in OPTIONS
    kinds = {field.name: field.type for field in dataclasses.fields(mjw.Model)}
    shape = getattr(kinds.get(name), "shape", None)
    return bool(shape) and shape[0] == "*"
