"""The worlds that an environment acts on: states as torch tensors, either simulator behind one interface."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import mujoco
import numpy as np
import torch
import warp as wp

from concent_warp.simulate.fields import apply_fields
from concent_warp.simulate.mujoco_engine import quiet_warnings
from concent_warp.train.environment.command_dynamics import CommandDynamics, CommandFilter

if TYPE_CHECKING:
    from concent_warp.effects.force_model import ForceModel


UNSTABLE = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
"""Warnings after which MuJoCo resets a world to its reference pose."""


class Physics(Protocol):
    """N worlds of one model. The tensors are the simulator's own memory: what is written to them is the state."""

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
    """Positions [m] (N, nmocap, 3) and orientations (N, nmocap, 4) of what is fixed where a world has it."""
    warmstart: torch.Tensor
    """Accelerations that the solver starts from, shape (N, nv)."""
    position: torch.Tensor
    """Body origins [m], world frame, shape (N, nbody, 3)."""
    quaternion: torch.Tensor
    """Body orientations, wxyz, shape (N, nbody, 4)."""
    site: torch.Tensor
    """Site positions [m], world frame, shape (N, nsite, 3)."""
    overflow: torch.Tensor
    """Bits of what went wrong in the simulator, shape (N,) int."""
    dropping: int
    """Those of the bits that say that contacts were dropped because a buffer was too small."""
    memory: dict[str, torch.Tensor]
    """What the future depends on besides positions, velocities, commands and warm start."""

    def begin(self, where: torch.Tensor) -> None:
        """Take the present commands as having been held for long in the worlds of a mask, shape (N,) bool."""
        ...

    def poses(self) -> tuple[wp.array, wp.array]:
        """Return positions and orientations as Warp arrays, of `wp.vec3` and `wp.quat`, shape (N, nbody)."""
        ...

    def advance(self) -> None:
        """Simulate the steps of one action, the commands held, and compute the poses that follow."""
        ...

    def place(self) -> None:
        """Compute the poses that follow from the positions."""
        ...


@dataclass(frozen=True)
class Actor:
    """What acts on a world of C MuJoCo besides its commands: a hidden effect, say."""

    force: Callable[[mujoco.MjModel, mujoco.MjData], None] | None = None
    """Called before every step; adds to `qfrc_applied` and `xfrc_applied`, of which nothing is left from before."""
    command: Callable[[float, np.ndarray], np.ndarray] | None = None
    """Maps time [s] and the command (nu,) to the one that acts."""


class MujocoPhysics:
    """Worlds of C MuJoCo, one after the other: for CPUs, and for worlds that are no model of ours."""

    def __init__(
        self,
        model: mujoco.MjModel,
        worlds: int,
        decimation: int,
        laws: Sequence[tuple[ForceModel, np.ndarray]] = (),
        actors: Sequence[Sequence[Actor]] = (),
        fields: Mapping[str, np.ndarray] | None = None,
        following: CommandDynamics | None = None,
    ) -> None:
        """Make the worlds.

        Args:
            model: Compiled model.
            worlds: N.
            decimation: Steps of one action.
            laws: Force laws with their parameters, shape (N, P) each.
            actors: What else acts, for each world its own, for they may have a state; none where empty.
            fields: Values of model fields that differ between worlds, shape (N, ...) each.
            following: How what acts follows the commands; at once by default.
        """
        self.model, self.worlds, self.device = model, worlds, "cpu"
        self._follower = following and CommandFilter(following, model.opt.timestep, decimation, self.device)
        self.memory = {} if self._follower is None else self._follower.memory
        self._decimation, self._actors = decimation, tuple(actors) or ((),) * worlds
        self._models = [self._model_of(i, fields or {}) for i in range(worlds)]
        self._data = [mujoco.MjData(m) for m in self._models]
        rows = list(enumerate(zip(self._models, self._data, strict=True)))
        self._laws = [[law.bound(m, d, values[i]) for law, values in laws] for i, (m, d) in rows]
        edited = sorted({name for law, _ in laws for name in law.edits})
        self._unedited = [[(getattr(m, name), getattr(m, name).copy()) for name in edited] for m in self._models]
        self._xpos = wp.zeros((worlds, model.nbody), dtype=wp.vec3, device="cpu")
        self._xquat = wp.zeros((worlds, model.nbody), dtype=wp.quat, device="cpu")
        self.position, self.quaternion = wp.to_torch(self._xpos), wp.to_torch(self._xquat)
        # Double precision, so that nothing of a state is lost on the way to the simulator and back.
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
        self.overflow, self.dropping = torch.zeros(worlds, dtype=torch.int32), 0
        arrays = (self.qpos, self.qvel, self.warmstart, self.position, self.quaternion, self.site)
        self._arrays = [tensor.numpy() for tensor in arrays]

    def _model_of(self, world: int, fields: Mapping[str, np.ndarray]) -> mujoco.MjModel:
        """Return the model of a world, one for all where none differs."""
        if not fields:
            return self.model
        m = copy.copy(self.model)
        apply_fields(m, {name: values[world] for name, values in fields.items()}, mujoco.MjData(m))
        return m

    def poses(self) -> tuple[wp.array, wp.array]:
        """Return positions and orientations as Warp arrays."""
        return self._xpos, self._xquat

    def begin(self, where: torch.Tensor) -> None:
        """See `Physics.begin`."""
        if self._follower is not None:
            self._follower.begin(where, self.ctrl)

    def advance(self) -> None:
        """Simulate the steps of one action. A world that MuJoCo resets as unstable is left not finite instead."""
        if self._follower is None:
            acting = np.broadcast_to(self.ctrl.numpy(), (self._decimation, *self.ctrl.shape))
        else:
            self._follower.follow(self.ctrl)
            acting = self._follower.acting.numpy()
        with quiet_warnings():
            self._advance(acting.astype(float))

    def _advance(self, ctrl: np.ndarray) -> None:
        """Simulate the steps of one action under the commands of each, shape (D, N, nu)."""
        wrench = self.wrench.numpy().astype(float)
        for i, (m, d) in enumerate(zip(self._models, self._data, strict=True)):
            self._write(i, m, d)
            d.xfrc_applied[:] = wrench[i]
            for command in ctrl[:, i]:
                for actor in self._actors[i]:
                    command = command if actor.command is None else actor.command(d.time, command)
                d.ctrl[:] = command
                if self._laws[i] or self._actors[i]:
                    d.qfrc_applied[:] = 0
                    d.xfrc_applied[:] = wrench[i]
                    for target, values in self._unedited[i]:
                        target[:] = values
                    for law in self._laws[i]:
                        law()
                    for actor in self._actors[i]:
                        if actor.force is not None:
                            actor.force(m, d)
                mujoco.mj_step(m, d)
            mujoco.mj_kinematics(m, d)
            self._read(i, d)
            if any(d.warning[kind].number for kind in UNSTABLE):
                self._arrays[0][i] = np.nan

    def place(self) -> None:
        """Compute the poses that follow from the positions."""
        for i, (m, d) in enumerate(zip(self._models, self._data, strict=True)):
            self._write(i, m, d)
            mujoco.mj_kinematics(m, d)
            self._read(i, d)

    def _write(self, i: int, m: mujoco.MjModel, d: mujoco.MjData) -> None:
        """Put the tensors of a world into its data, if they have been changed since they were read off it."""
        given = [array[i] for array in (*self._arrays[:2], *self._places)]
        held = d.qpos, d.qvel, d.mocap_pos, d.mocap_quat
        if not all(map(np.array_equal, given, held)):
            mujoco.mj_resetData(m, d)
            for target, value in zip(held, given, strict=True):
                target[:] = value
            d.qacc_warmstart[:] = self._arrays[2][i]

    def _read(self, i: int, d: mujoco.MjData) -> None:
        """Put the data of a world into its tensors."""
        values = (d.qpos, d.qvel, d.qacc_warmstart, d.xpos, d.xquat, d.site_xpos)
        for array, value in zip(self._arrays, values, strict=True):
            array[i] = value


class WarpPhysics:
    """Worlds of MuJoCo-Warp, stepped by a captured graph."""

    def __init__(
        self,
        model: mujoco.MjModel,
        worlds: int,
        decimation: int,
        laws: Sequence[tuple[ForceModel, np.ndarray]] = (),
        *,
        device: str,
        nconmax: int,
        njmax: int,
        fields: Mapping[str, np.ndarray] | None = None,
        following: CommandDynamics | None = None,
        capture: bool = True,
    ) -> None:
        """Make the worlds and capture their step.

        Args:
            model: Compiled model.
            worlds: N.
            decimation: Steps of one action.
            laws: Force laws with their parameters, shape (N, P) each.
            device: Warp's name of the device.
            nconmax: Contacts a world, of a pool for all.
            njmax: Constraint rows of each world.
            fields: Values of model fields that differ between worlds, shape (N, ...) each.
            following: How what acts follows the commands; at once by default.
            capture: Whether steps are captured in a graph.
        """
        import mujoco_warp as mjw

        from concent_warp.simulate.warp_engine import largest
        from concent_warp.simulate.warp_model import WorldModel, check_drag

        self.model, self.worlds, self.nconmax, self.njmax = model, worlds, nconmax, njmax
        self.device = str(wp.device_to_torch(wp.get_device(device)))
        self._warp_device, self._decimation, self._mjw = wp.get_device(device), decimation, mjw
        edited = sorted({name for law, _ in laws for name in law.edits})
        varied = dict(fields or {})
        for name in set(edited) - set(varied):
            value = getattr(model, name)
            varied[name] = np.tile(value, (worlds, *[1] * value.ndim))
        check_drag(model, varied)
        # What a law edits is zero now and then, and must not be taken for switched off.
        typical = {name: largest(values) + (name in edited) for name, values in varied.items()}
        with wp.ScopedDevice(self._warp_device):
            made = WorldModel(model, np.zeros(0, dtype=int), worlds, (), typical)
            made.load({}, varied)
            self._model = made.mjw
            wp.synchronize_device(self._warp_device)
            self._unedited = [(getattr(self._model, n), wp.clone(getattr(self._model, n))) for n in edited]
            self._laws: list[tuple[ForceModel, Any]] = [(law, wp.array(values, dtype=float)) for law, values in laws]
            self._data = d = mjw.make_data(made.typical, nworld=worlds, nconmax=nconmax, njmax=njmax)
            self.qpos, self.qvel, self.ctrl = wp.to_torch(d.qpos), wp.to_torch(d.qvel), wp.to_torch(d.ctrl)
            self._follow(following, capture)
            self._wrench = wp.zeros_like(d.xfrc_applied) if laws else d.xfrc_applied
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
            self._steps()  # loads the modules, which cannot be done while a graph is captured
            self._advance = Graph(self._steps, self._warp_device, capture)
            self._place = Graph(lambda: mjw.kinematics(self._model, self._data), self._warp_device, capture)
            wp.copy(d.qpos, start)
            d.qvel.zero_()
            d.qacc_warmstart.zero_()
            d.overflow.zero_()
        wp.synchronize_device(self._warp_device)

    def _follow(self, following: CommandDynamics | None, capture: bool) -> None:
        """Keep the commands apart from what acts, where the one follows the other."""
        self._follower, self.memory, self._acting = None, {}, None
        if following is None:
            return
        self.ctrl = torch.zeros_like(self.ctrl)
        follower = CommandFilter(following, float(self.model.opt.timestep), self._decimation, self.device)
        self._follower, self.memory = follower, follower.memory
        self._acting = [wp.from_torch(acts) for acts in follower.acting]
        self._filter = captured(lambda: follower.follow(self.ctrl), capture and self._warp_device.is_cuda)

    @property
    def simulator(self) -> tuple[Any, Any]:
        """MuJoCo-Warp's model and data, for measurements of its own."""
        return self._model, self._data

    def poses(self) -> tuple[wp.array, wp.array]:
        """Return positions and orientations as Warp arrays."""
        return self._data.xpos, self._data.xquat

    def begin(self, where: torch.Tensor) -> None:
        """See `Physics.begin`."""
        if self._follower is not None:
            self._follower.begin(where, self.ctrl)

    def advance(self) -> None:
        """Simulate the steps of one action."""
        if self._follower is not None:
            self._filter()
        self._advance.launch()

    def place(self) -> None:
        """Compute the poses that follow from the positions."""
        self._place.launch()

    def _steps(self) -> None:
        """Launch the steps of one action."""
        for k in range(self._decimation):
            if self._acting is not None:
                wp.copy(self._data.ctrl, self._acting[k])
            if self._laws:
                for target, values in self._unedited:
                    wp.copy(target, values)
                self._data.qfrc_applied.zero_()
                wp.copy(self._data.xfrc_applied, self._wrench)
                for law, values in self._laws:
                    law.launch(self._model, self._data, values)
            self._mjw.step(self._model, self._data)
        self._mjw.kinematics(self._model, self._data)


class Graph:
    """Warp launches, recorded once and replayed on the stream that torch works on."""

    def __init__(self, launches: Callable[[], None], device: Any, capture: bool) -> None:
        """Record `launches`, which must have run before, or keep them to be called as they are."""
        self._launches, self._device, self._graph = launches, device, None
        self._streams: dict[int, wp.Stream] = {}
        if capture:
            with wp.ScopedDevice(device), wp.ScopedCapture() as captured:
                launches()
            self._graph = captured.graph

    def launch(self) -> None:
        """Launch."""
        stream = None
        if self._device.is_cuda:
            current = torch.cuda.current_stream(wp.device_to_torch(self._device))
            if current.cuda_stream not in self._streams:
                self._streams[current.cuda_stream] = wp.stream_from_torch(current)
            stream = self._streams[current.cuda_stream]
        with wp.ScopedDevice(self._device), wp.ScopedStream(stream):
            if self._graph is None:
                self._launches()
            else:
                wp.capture_launch(self._graph, stream=stream)


def _compiled_or_plain(part: Callable[[], None]) -> Callable[[], None]:
    """Do torch operations on fixed buffers; return them compiled into few kernels, or as they are where that fails."""
    from torch._dynamo.exc import TorchDynamoException

    compiled = torch.compile(part, fullgraph=True, dynamic=False)
    try:
        with torch.no_grad():
            compiled()
    except TorchDynamoException as error:
        said = str(error).strip().splitlines()
        warnings.warn(f"operations are not fused: {said[0] if said else type(error).__name__}", stacklevel=2)
        return part
    return compiled


def captured(part: Callable[[], None], capture: bool, *, fuse: bool = False) -> Callable[[], None]:
    """Return torch operations on fixed buffers as a CUDA graph, of few fused kernels if wanted, or as they are."""
    if not capture:
        return part
    if fuse:
        part = _compiled_or_plain(part)
    with torch.no_grad():
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(2):
                part()
        torch.cuda.current_stream().wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            part()
    recorded = part, graph  # what was compiled has to live as long as its kernels are launched
    return lambda: recorded[1].replay()
