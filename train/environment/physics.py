"""Simulated worlds of an environment: states as torch tensors, one interface for C MuJoCo and MuJoCo-Warp."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import mujoco
import numpy as np
import torch
import warp as wp

from concent_warp.scene.quiet_mujoco import quiet_mujoco
from concent_warp.simulate.activation import FOLLOWING
from concent_warp.simulate.fields import apply_fields
from concent_warp.train.environment.command_dynamics import CommandDynamics, CommandFilter
from concent_warp.train.environment.graphs import Graph, captured
from concent_warp.train.environment.kinematics import Kinematics, MujocoKinematics, WarpKinematics

if TYPE_CHECKING:
    from concent_warp.effects.force_model import ForceModel


UNSTABLE = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
"""Warnings after which MuJoCo resets a world to its reference pose."""
DROPPED = (mujoco.mjtWarning.mjWARN_CONTACTFULL, mujoco.mjtWarning.mjWARN_CNSTRFULL)
"""Warnings that contacts or constraints were dropped for lack of memory."""
MIN_WORLDS_OF_THREAD = 4
"""Worlds that are worth a thread."""


class Physics(Protocol):
    """N worlds of one model; the tensors are views of the simulator's memory, so writing to them sets the state."""

    model: mujoco.MjModel
    worlds: int
    device: str
    """Torch's name of the device."""
    qpos: torch.Tensor
    """Shape (N, nq)."""
    qvel: torch.Tensor
    """Shape (N, nv)."""
    ctrl: torch.Tensor
    """Shape (N, nu)."""
    wrench: torch.Tensor
    """Force [N] and torque [N m] on each body about its centre of mass, world frame, shape (N, nbody, 6)."""
    mocap: tuple[torch.Tensor, torch.Tensor]
    """Positions [m] (N, nmocap, 3) and orientations (N, nmocap, 4) of fixed objects, which differ between worlds."""
    warmstart: torch.Tensor
    """Initial accelerations of the solver, shape (N, nv)."""
    position: torch.Tensor
    """Body origins [m], world frame, shape (N, nbody, 3)."""
    quaternion: torch.Tensor
    """Body orientations, wxyz, shape (N, nbody, 4)."""
    site: torch.Tensor
    """Site positions [m], world frame, shape (N, nsite, 3)."""
    overflow: torch.Tensor
    """Overflow flags of the simulator, shape (N,) int."""
    dropping: int
    """Mask of the flags of contacts dropped for lack of buffer capacity."""
    buffers: tuple[int, int] | None
    """Contacts and constraint rows of a world that there is room for; None where the simulator makes room itself."""
    memory: dict[str, torch.Tensor]
    """Further state by name, for checkpoints."""

    def reset_commands(self, mask: torch.Tensor) -> None:
        """Set delays, lags and filters to the steady state of the present commands in worlds of a mask (N,) bool."""
        ...

    def poses(self) -> tuple[wp.array, wp.array]:
        """Return positions and orientations as Warp arrays, of `wp.vec3` and `wp.quat`, shape (N, nbody)."""
        ...

    def advance(self) -> None:
        """Simulate the steps of one action with constant commands, and update the poses."""
        ...

    def update_poses(self) -> None:
        """Compute the poses from the generalised positions."""
        ...

    def kinematics(self) -> Kinematics:
        """Return kinematics of the same bodies, at the model's reference positions until others are written."""
        ...


def fill_filters(m: mujoco.MjModel, activation: torch.Tensor, mask: torch.Tensor, ctrl: torch.Tensor) -> None:
    """Set the filters of actuators to where their commands would hold them, in place.

    Args:
        m: The compiled model.
        activation: States of the actuators, shape (N, na).
        mask: Worlds, shape (N,) bool.
        ctrl: Commands, shape (N, nu).
    """
    for i in np.flatnonzero(np.isin(m.actuator_dyntype, FOLLOWING)).tolist():
        held = ctrl[:, i].clamp(*m.actuator_ctrlrange[i].tolist()) if m.actuator_ctrllimited[i] else ctrl[:, i]
        last = int(m.actuator_actadr[i] + m.actuator_actnum[i]) - 1
        activation[:, last] = torch.where(mask, held.to(activation.dtype), activation[:, last])


def _with_activation(memory: dict[str, torch.Tensor], activation: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return what a checkpoint keeps, with the states of the actuators where there are any."""
    return memory | ({"activation": activation} if activation.shape[1] else {})


@dataclass(frozen=True)
class Actor:
    """Forces and commands that act on a world of C MuJoCo beyond its model, as of a hidden effect."""

    force: Callable[[mujoco.MjModel, mujoco.MjData], None] | None = None
    """Called before every step; adds to `qfrc_applied` and `xfrc_applied`, which are zero before."""
    command: Callable[[float, np.ndarray], np.ndarray] | None = None
    """Maps time [s] and the command (nu,) to the one that acts."""


class MujocoPhysics:
    """Worlds of C MuJoCo, in threads where nothing of them is computed in Python: on CPUs, and for Reality."""

    def __init__(
        self,
        model: mujoco.MjModel,
        worlds: int,
        decimation: int,
        force_models: Sequence[tuple[ForceModel, np.ndarray]] = (),
        actors: Sequence[Sequence[Actor]] = (),
        fields: Mapping[str, np.ndarray] | None = None,
        command_dynamics: CommandDynamics | None = None,
    ) -> None:
        """Create the worlds.

        Args:
            model: Compiled model.
            worlds: N.
            decimation: Simulation steps per action.
            force_models: Force models with their parameters, shape (N, P) each.
            actors: Actors of each world, since they may have a state; none if empty.
            fields: Values of model fields that differ between worlds, shape (N, ...) each.
            command_dynamics: Delays and lags of the commands; none by default.
        """
        self.model, self.worlds, self.device = model, worlds, "cpu"
        self._filter = command_dynamics and CommandFilter(command_dynamics, model.opt.timestep, decimation, self.device)
        self.activation = torch.zeros(worlds, model.na, dtype=torch.float64)
        self.memory = _with_activation({} if self._filter is None else self._filter.memory, self.activation)
        self._decimation, self._actors = decimation, tuple(actors) or ((),) * worlds
        self._models = [self._model_of(i, fields or {}) for i in range(worlds)]
        self._data = [mujoco.MjData(m) for m in self._models]
        rows = list(enumerate(zip(self._models, self._data, strict=True)))
        self._force_models = [
            [force_model.bound(m, d, values[i]) for force_model, values in force_models] for i, (m, d) in rows
        ]
        edited = sorted({name for force_model, _ in force_models for name in force_model.edits})
        self._unedited = [[(getattr(m, name), getattr(m, name).copy()) for name in edited] for m in self._models]
        self._xpos = wp.zeros((worlds, model.nbody), dtype=wp.vec3, device="cpu")
        self._xquat = wp.zeros((worlds, model.nbody), dtype=wp.quat, device="cpu")
        self.position, self.quaternion = wp.to_torch(self._xpos), wp.to_torch(self._xquat)
        # Double precision, so that states are exact between tensors and simulator.
        self.qpos = torch.from_numpy(np.tile(model.qpos0, (worlds, 1)))
        self.qvel = torch.zeros(worlds, model.nv, dtype=torch.float64)
        self.warmstart = torch.zeros_like(self.qvel)
        self.ctrl = torch.zeros(worlds, model.nu)
        self.wrench = torch.zeros(worlds, model.nbody, 6)
        fixed = np.flatnonzero(model.body_mocapid >= 0)[np.argsort(model.body_mocapid[model.body_mocapid >= 0])]
        places = [np.tile(values[fixed], (worlds, 1, 1)) for values in (model.body_pos, model.body_quat)]
        self.mocap = torch.from_numpy(places[0]), torch.from_numpy(places[1])
        self._places = places
        self.site = torch.zeros(worlds, model.nsite, 3)
        self.overflow, self.dropping = torch.zeros(worlds, dtype=torch.int32), 1
        self.buffers: tuple[int, int] | None = None
        arrays = (self.qpos, self.qvel, self.warmstart, self.position, self.quaternion, self.site)
        self._arrays = [tensor.numpy() for tensor in arrays]
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
        # What is computed in Python takes turns anyway.
        alone = bool(force_models) or any(self._actors)
        threads = 1 if alone else min(cores, worlds // MIN_WORLDS_OF_THREAD)
        self._threads = ThreadPoolExecutor(threads) if threads > 1 else None

    def _model_of(self, world: int, fields: Mapping[str, np.ndarray]) -> mujoco.MjModel:
        """Return the model of a world; the same object for all worlds without varied fields."""
        if not fields:
            return self.model
        m = copy.copy(self.model)
        apply_fields(m, {name: values[world] for name, values in fields.items()}, mujoco.MjData(m))
        return m

    def poses(self) -> tuple[wp.array, wp.array]:
        """Return positions and orientations as Warp arrays."""
        return self._xpos, self._xquat

    def reset_commands(self, mask: torch.Tensor) -> None:
        """See `Physics.reset_commands`."""
        if self._filter is not None:
            self._filter.reset(mask, self.ctrl)
        fill_filters(self.model, self.activation, mask, self.ctrl)

    def advance(self) -> None:
        """Simulate the steps of one action; the positions of a world that MuJoCo resets as unstable become NaN."""
        if self._filter is None:
            acting = np.broadcast_to(self.ctrl.numpy(), (self._decimation, *self.ctrl.shape))
        else:
            self._filter.apply(self.ctrl)
            acting = self._filter.acting.numpy()
        with quiet_mujoco():
            self._advance(acting.astype(float))

    def _advance(self, ctrl: np.ndarray) -> None:
        """Simulate the steps of one action under the commands of each, shape (D, N, nu)."""
        wrench = self.wrench.numpy().astype(float)
        work = (range(self.worlds), ctrl.swapaxes(0, 1), wrench)
        # Worlds do not depend on one another, so that the result is the same.
        for _ in (map if self._threads is None else self._threads.map)(self._advance_world, *work):
            pass

    def _advance_world(self, i: int, ctrl: np.ndarray, wrench: np.ndarray) -> None:
        """Simulate the steps of one action in a world, under the commands of each (D, nu) and wrenches (nbody, 6)."""
        m, d = self._models[i], self._data[i]
        self._write(i, m, d)
        d.xfrc_applied[:] = wrench
        if self._filter is None and not self._force_models[i] and not self._actors[i]:
            d.ctrl[:] = ctrl[0]
            mujoco.mj_step(m, d, nstep=len(ctrl))
        else:
            for command in ctrl:
                self._step_world(i, command, wrench)
        mujoco.mj_kinematics(m, d)
        self._read(i, d)
        if any(d.warning[kind].number for kind in UNSTABLE):
            self._arrays[0][i] = np.nan
        for kind in DROPPED:
            if d.warning[kind].number:
                d.warning[kind].number, self.overflow[i] = 0, 1

    def _step_world(self, i: int, command: np.ndarray, wrench: np.ndarray) -> None:
        """Simulate one step of a world under a command (nu,)."""
        m, d = self._models[i], self._data[i]
        for actor in self._actors[i]:
            command = command if actor.command is None else actor.command(d.time, command)
        d.ctrl[:] = command
        if self._force_models[i] or self._actors[i]:
            d.qfrc_applied[:] = 0
            d.xfrc_applied[:] = wrench
            for target, values in self._unedited[i]:
                target[:] = values
            for force_model in self._force_models[i]:
                force_model()
            for actor in self._actors[i]:
                if actor.force is not None:
                    actor.force(m, d)
        mujoco.mj_step(m, d)

    def update_poses(self) -> None:
        """Compute the poses from the generalised positions."""
        for i, (m, d) in enumerate(zip(self._models, self._data, strict=True)):
            self._write(i, m, d)
            mujoco.mj_kinematics(m, d)
            self._read(i, d)

    def kinematics(self) -> Kinematics:
        """See `Physics.kinematics`."""
        return MujocoKinematics(self.model, self.worlds)

    def _write(self, i: int, m: mujoco.MjModel, d: mujoco.MjData) -> None:
        """Copy the tensors of a world to its data, if they changed since they were read from it."""
        given = [array[i] for array in (*self._arrays[:2], *self._places)]
        present = d.qpos, d.qvel, d.mocap_pos, d.mocap_quat
        if not all(map(np.array_equal, given, present)):
            mujoco.mj_resetData(m, d)
            for target, value in zip(present, given, strict=True):
                target[:] = value
            d.qacc_warmstart[:] = self._arrays[2][i]
        d.act[:] = self.activation[i].numpy()

    def _read(self, i: int, d: mujoco.MjData) -> None:
        """Copy the data of a world to its tensors."""
        values = (d.qpos, d.qvel, d.qacc_warmstart, d.xpos, d.xquat, d.site_xpos)
        for array, value in zip(self._arrays, values, strict=True):
            array[i] = value
        self.activation[i] = torch.from_numpy(d.act)


class WarpPhysics:
    """Worlds of MuJoCo-Warp; a captured CUDA graph steps them."""

    def __init__(
        self,
        model: mujoco.MjModel,
        worlds: int,
        decimation: int,
        force_models: Sequence[tuple[ForceModel, np.ndarray]] = (),
        *,
        device: str,
        nconmax: int,
        njmax: int,
        fields: Mapping[str, np.ndarray] | None = None,
        command_dynamics: CommandDynamics | None = None,
        capture: bool = True,
    ) -> None:
        """Create the worlds and capture their step.

        Args:
            model: Compiled model.
            worlds: N.
            decimation: Simulation steps per action.
            force_models: Force models with their parameters, shape (N, P) each.
            device: Warp's name of the device.
            nconmax: Contact capacity per world, of a pool shared by all.
            njmax: Constraint capacity of each world.
            fields: Values of model fields that differ between worlds, shape (N, ...) each.
            command_dynamics: Delays and lags of the commands; none by default.
            capture: Whether steps are captured in a graph.
        """
        import mujoco_warp as mjw

        from concent_warp.simulate.warp_engine import largest_by_magnitude
        from concent_warp.simulate.warp_model import WorldModel, check_drag
        from concent_warp.simulate.warp_modules import load_modules

        self.model, self.worlds = model, worlds
        self.buffers: tuple[int, int] | None = (nconmax, njmax)
        self.device = str(wp.device_to_torch(wp.get_device(device)))
        self._warp_device, self._decimation, self._mjw = wp.get_device(device), decimation, mjw
        self._capture = capture
        edited = sorted({name for force_model, _ in force_models for name in force_model.edits})
        varied = dict(fields or {})
        for name in set(edited) - set(varied):
            value = getattr(model, name)
            varied[name] = np.tile(value, (worlds, *[1] * value.ndim))
        check_drag(model, varied)
        # A field that a force model edits can be zero at times, which must not disable it.
        typical = {name: largest_by_magnitude(values) + (name in edited) for name, values in varied.items()}
        with wp.ScopedDevice(self._warp_device):
            made = WorldModel(model, np.zeros(0, dtype=int), worlds, (), typical)
            made.load({}, varied)
            self._model = made.mjw
            wp.synchronize_device(self._warp_device)
            self._unedited = [(getattr(self._model, n), wp.clone(getattr(self._model, n))) for n in edited]
            self._force_models: list[tuple[ForceModel, Any]] = [
                (force_model, wp.array(values, dtype=float)) for force_model, values in force_models
            ]
            self._data = d = mjw.make_data(made.typical, nworld=worlds, nconmax=nconmax, njmax=njmax)
            self.qpos, self.qvel, self.ctrl = wp.to_torch(d.qpos), wp.to_torch(d.qvel), wp.to_torch(d.ctrl)
            self.activation = wp.to_torch(d.act) if model.na else torch.zeros(worlds, 0, device=self.device)
            self._make_filter(command_dynamics, capture)
            self.memory = _with_activation(self.memory, self.activation)
            self._wrench = wp.zeros_like(d.xfrc_applied) if force_models else d.xfrc_applied
            self.wrench = wp.to_torch(self._wrench)
            self.position, self.quaternion = wp.to_torch(d.xpos), wp.to_torch(d.xquat)
            self.site, self.warmstart = wp.to_torch(d.site_xpos), wp.to_torch(d.qacc_warmstart)
            self.mocap = (
                (wp.to_torch(d.mocap_pos), wp.to_torch(d.mocap_quat))
                if model.nmocap
                else (torch.zeros(worlds, 0, 3, device=self.device), torch.zeros(worlds, 0, 4, device=self.device))
            )
            self.overflow, bits = wp.to_torch(d.overflow), mjw.OverflowType
            self.dropping = int(bits.NEFC | bits.NJMAX_NNZ | bits.BROADPHASE | bits.NARROWPHASE | bits.CCD)
            made.place(d)
            start = wp.clone(d.qpos)
            load_modules(self._steps)  # which is impossible while a graph is captured
            self._steps()
            self._advance = Graph(self._steps, self._warp_device, capture)
            self._update_poses = Graph(lambda: mjw.kinematics(self._model, self._data), self._warp_device, capture)
            wp.copy(d.qpos, start)
            d.qvel.zero_()
            d.qacc_warmstart.zero_()
            self.activation.zero_()
            d.overflow.zero_()
        wp.synchronize_device(self._warp_device)

    def _make_filter(self, dynamics: CommandDynamics | None, capture: bool) -> None:
        """Separate commands from what acts, if there are delays or lags."""
        self._filter, self.memory, self._acting = None, {}, None
        if dynamics is None:
            return
        self.ctrl = torch.zeros_like(self.ctrl)
        command_filter = CommandFilter(dynamics, float(self.model.opt.timestep), self._decimation, self.device)
        self._filter, self.memory = command_filter, command_filter.memory
        self._acting = [wp.from_torch(acts) for acts in command_filter.acting]
        self._apply_filter = captured(lambda: command_filter.apply(self.ctrl), capture and self._warp_device.is_cuda)

    @property
    def simulator(self) -> tuple[Any, Any]:
        """MuJoCo-Warp's model and data, for benchmarks."""
        return self._model, self._data

    def poses(self) -> tuple[wp.array, wp.array]:
        """Return positions and orientations as Warp arrays."""
        return self._data.xpos, self._data.xquat

    def reset_commands(self, mask: torch.Tensor) -> None:
        """See `Physics.reset_commands`."""
        if self._filter is not None:
            self._filter.reset(mask, self.ctrl)
        fill_filters(self.model, self.activation, mask, self.ctrl)

    def advance(self) -> None:
        """Simulate the steps of one action."""
        if self._filter is not None:
            self._apply_filter()
        self._advance.launch()

    def update_poses(self) -> None:
        """Compute the poses from the generalised positions."""
        self._update_poses.launch()

    def kinematics(self) -> Kinematics:
        """See `Physics.kinematics`."""
        return WarpKinematics(self.model, self._model, self.worlds, self._warp_device, self._capture)

    def _steps(self) -> None:
        """Launch the steps of one action."""
        for k in range(self._decimation):
            if self._acting is not None:
                wp.copy(self._data.ctrl, self._acting[k])
            if self._force_models:
                for target, values in self._unedited:
                    wp.copy(target, values)
                self._data.qfrc_applied.zero_()
                wp.copy(self._data.xfrc_applied, self._wrench)
                for force_model, values in self._force_models:
                    force_model.launch(self._model, self._data, values)
            self._mjw.step(self._model, self._data)
        self._mjw.kinematics(self._model, self._data)
