"""Forward kinematics of many worlds at positions of one's own, beside their simulation."""

from __future__ import annotations

from typing import Any, Protocol

import mujoco
import numpy as np
import torch
import warp as wp

from concent_warp.train.environment.graphs import Graph


class Kinematics(Protocol):
    """Forward kinematics of N worlds at positions of one's own; the tensors are views of what the kinematics read."""

    qpos: torch.Tensor
    """Shape (N, nq)."""
    mocap: tuple[torch.Tensor, torch.Tensor]
    """Positions [m] (N, nmocap, 3) and orientations (N, nmocap, 4) of fixed objects."""
    position: torch.Tensor
    """Body origins [m], world frame, shape (N, nbody, 3)."""
    quaternion: torch.Tensor
    """Body orientations, wxyz, shape (N, nbody, 4)."""
    site: torch.Tensor
    """Site positions [m], world frame, shape (N, nsite, 3)."""

    def poses(self) -> tuple[wp.array, wp.array]:
        """Return positions and orientations as Warp arrays, of `wp.vec3` and `wp.quat`, shape (N, nbody)."""
        ...

    def update(self) -> None:
        """Compute the poses from the generalised positions."""
        ...


class MujocoKinematics:
    """Forward kinematics in C MuJoCo."""

    def __init__(self, model: mujoco.MjModel, worlds: int) -> None:
        """Start at the model's reference positions."""
        self._model, self._data = model, mujoco.MjData(model)
        self._xpos = wp.zeros((worlds, model.nbody), dtype=wp.vec3, device="cpu")
        self._xquat = wp.zeros((worlds, model.nbody), dtype=wp.quat, device="cpu")
        self.position, self.quaternion = wp.to_torch(self._xpos), wp.to_torch(self._xquat)
        self.qpos = torch.from_numpy(np.tile(model.qpos0, (worlds, 1)))
        places = [np.tile(values, (worlds, 1, 1)) for values in (self._data.mocap_pos, self._data.mocap_quat)]
        self.mocap = torch.from_numpy(places[0]), torch.from_numpy(places[1])
        self.site = torch.zeros(worlds, model.nsite, 3)

    def poses(self) -> tuple[wp.array, wp.array]:
        """Return positions and orientations as Warp arrays."""
        return self._xpos, self._xquat

    def update(self) -> None:
        """Compute the poses from the generalised positions."""
        m, d = self._model, self._data
        given = self.qpos.numpy(), self.mocap[0].numpy(), self.mocap[1].numpy()
        found = self.position.numpy(), self.quaternion.numpy(), self.site.numpy()
        for i, (qpos, place, turn) in enumerate(zip(*given, strict=True)):
            d.qpos[:], d.mocap_pos[:], d.mocap_quat[:] = qpos, place, turn
            mujoco.mj_kinematics(m, d)
            for array, value in zip(found, (d.xpos, d.xquat, d.site_xpos), strict=True):
                array[i] = value


class WarpKinematics:
    """Forward kinematics in MuJoCo-Warp, captured in a graph."""

    def __init__(self, model: mujoco.MjModel, warp_model: Any, worlds: int, device: wp.Device, capture: bool) -> None:
        """Start at the model's reference positions; `warp_model` is MuJoCo-Warp's model."""
        import mujoco_warp as mjw

        with wp.ScopedDevice(device):
            # Kinematics read no contacts; these are the smallest buffers there are.
            self._data = d = mjw.make_data(model, nworld=worlds, nconmax=1, njmax=1)
            self.qpos, self.site = wp.to_torch(d.qpos), wp.to_torch(d.site_xpos)
            self.position, self.quaternion = wp.to_torch(d.xpos), wp.to_torch(d.xquat)
            torch_device = self.qpos.device
            self.mocap = (
                (wp.to_torch(d.mocap_pos), wp.to_torch(d.mocap_quat))
                if model.nmocap
                else (torch.zeros(worlds, 0, 3, device=torch_device), torch.zeros(worlds, 0, 4, device=torch_device))
            )
            mjw.kinematics(warp_model, d)  # loads the module
            self._update = Graph(lambda: mjw.kinematics(warp_model, d), device, capture)

    def poses(self) -> tuple[wp.array, wp.array]:
        """Return positions and orientations as Warp arrays."""
        return self._data.xpos, self._data.xquat

    def update(self) -> None:
        """Compute the poses from the generalised positions."""
        self._update.launch()
