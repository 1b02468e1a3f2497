"""A rollout on the device: worlds of one shape, their buffers, and the captured graphs that step them.

One step is ``forward`` and then the integrator, as in `mujoco_warp.step`; between the two, everything in the data
belongs to the instant before the step, and that is where records and contacts are taken.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp

from concent_warp.errors import EngineError
from concent_warp.kernels import rollout as kernels
from concent_warp.simulate.engine import Contacts
from concent_warp.simulate.warp_model import WorldModel
from concent_warp.simulate.warp_modules import load_modules

if TYPE_CHECKING:
    from concent_warp.effects.force_model import ForceModel

INTEGRATORS = {
    mujoco.mjtIntegrator.mjINT_EULER: mjw.euler,
    mujoco.mjtIntegrator.mjINT_RK4: mjw.rungekutta4,
    mujoco.mjtIntegrator.mjINT_IMPLICIT: mjw.implicit,
    mujoco.mjtIntegrator.mjINT_IMPLICITFAST: mjw.implicit,
    mujoco.mjtIntegrator.mjINT_DISCRETE: mjw.discrete,
}


@dataclass(frozen=True)
class Plan:
    """What a program is made for. Programs with equal plans are interchangeable."""

    worlds: int
    """N."""
    steps: int
    """K."""
    commands: int
    """n; world i follows row i % n of the commands."""
    records: int
    """R."""
    bodies: tuple[int, ...]
    """Ids of the bodies to record."""
    contacts: Contacts
    spheres: tuple[str, ...]
    """Properties of the spheres that vary, `sphere_position` and so on."""
    fields: tuple[tuple[str, bool], ...]
    """Model fields that vary, each with whether any value is not zero; those that force models edit are among them."""
    force_models: tuple[tuple[ForceModel, int], ...] = ()
    """Force models, each with how many parameters it has."""


@dataclass(frozen=True)
class Buffers:
    """Sizes of what contacts and constraints are kept in."""

    contacts: int
    """Contacts and candidate pairs, per world, of one pool for all worlds."""
    constraints: int
    """Constraint rows of each world."""
    nonzeros: int | None = None
    """Entries of a sparse constraint Jacobian in each world; None for MuJoCo-Warp's own estimate."""
    matches: int | None = None
    """Contacts that one contact sensor can match; None for MuJoCo-Warp's own number."""
    log_rows: int = 0
    """Rows of the contact log, of all worlds and steps."""


@dataclass(frozen=True)
class Demand:
    """What a run would have needed of its buffers, and what it ran into."""

    contacts: int
    """Most contacts or candidate pairs at a time, all worlds together."""
    constraints: int
    """Most constraint rows of one world."""
    logged: int
    """Contacts to log, all worlds and steps."""
    overflow: np.ndarray
    """Bits of `mujoco_warp.OverflowType` of each world, shape (N,) int."""
    unstable_step: np.ndarray
    """First step at which a world is not sane, shape (N,) int; beyond K where it stays so."""


class Program:
    """Worlds, record buffers and graphs for one plan; used again and again with other values."""

    def __init__(
        self,
        compiled: mujoco.MjModel,
        sphere_geom: np.ndarray,
        plan: Plan,
        buffers: Buffers,
        fields: dict[str, np.ndarray],
        device: str,
    ) -> None:
        """Allocate everything and capture the graphs.

        Args:
            compiled: The model.
            sphere_geom: Geom id of each sphere, shape (S,) int, -1 for those left out.
            plan: What to make.
            buffers: Sizes.
            fields: Typical value of each field that varies, not zero where any world's value is not.
            device: Warp's name of the device.
        """
        self.plan = plan
        self.buffers = buffers
        self.device = wp.get_device(device)
        with wp.ScopedDevice(self.device):
            try:
                self._world_model = WorldModel(compiled, sphere_geom, plan.worlds, plan.spheres, fields)
                self.model = self._world_model.mjw
                if buffers.matches is not None:
                    self.model.opt.contact_sensor_maxmatch = buffers.matches
                self.data = mjw.make_data(
                    self._world_model.typical,
                    nworld=plan.worlds,
                    nconmax=buffers.contacts,
                    njmax=buffers.constraints,
                    njmax_nnz=buffers.nonzeros,
                )
                self._make_records()
                self._force_models = [
                    (force_model, wp.zeros((plan.worlds, count), dtype=float))
                    for force_model, count in plan.force_models
                ]
                edited = sorted({name for force_model, _ in plan.force_models for name in force_model.edits})
                self._unedited = [(getattr(self.model, name), wp.clone(getattr(self.model, name))) for name in edited]
                self._integrate = INTEGRATORS[mujoco.mjtIntegrator(compiled.opt.integrator)]
                load_modules(self._all_parts)
                self._all_parts()
            except EngineError:
                raise
            except (NotImplementedError, ValueError) as error:
                raise EngineError(
                    "MuJoCo-Warp cannot simulate this model", found=error, fix="use MujocoEngine"
                ) from error
            self._graphs = [_capture(part) for part in (self._begin, self._step, self._end)]

    def _make_records(self) -> None:
        """Create the buffers of commands, records and contacts."""
        plan, m, d = self.plan, self.model, self.data
        n, r, b = plan.worlds, plan.records, len(plan.bodies)
        self._commands = wp.zeros((plan.commands, max(plan.steps, 1), m.nu), dtype=float)
        self._qpos, self._qvel, self._act = wp.clone(d.qpos), wp.zeros_like(d.qvel), wp.zeros_like(d.act)
        self._clock = wp.zeros(2, dtype=int)
        self._peak = wp.zeros(kernels.PEAKS, dtype=int)
        self._unstable = wp.zeros(n, dtype=int)
        self._all = wp.ones(n, dtype=bool)
        self._row_of = wp.full(plan.steps + 1, -1, dtype=int)
        self._bodies = wp.array(np.array(plan.bodies, dtype=np.int32), dtype=int)
        self._records = [
            wp.zeros((n, r, m.nq), dtype=float),
            wp.zeros((n, r, m.nv), dtype=float),
            wp.zeros((n, r, m.nsensordata), dtype=float),
            wp.zeros((n, r, b), dtype=wp.vec3),
            wp.zeros((n, r, b), dtype=wp.quat),
        ]
        if plan.contacts == "touched":
            self._touched = wp.zeros((n, m.ngeom, m.nbody), dtype=wp.uint8)
        elif plan.contacts == "all":
            self._ids = wp.array(np.arange(d.naconmax, dtype=np.int32), dtype=int)
            self._force: Any = wp.zeros(d.naconmax, dtype=wp.spatial_vector)
            self._key = wp.zeros((self.buffers.log_rows, 4), dtype=int)
            self._value = wp.zeros((self.buffers.log_rows, 10), dtype=float)

    def load(
        self,
        spheres: dict[str, Any],
        fields: dict[str, Any],
        force_models: Sequence[Any],
        qpos: Any,
        qvel: Any,
        ctrl: Any,
        record: np.ndarray,
        act: np.ndarray | None = None,
    ) -> None:
        """Set the values of the next run.

        Args:
            spheres: The properties that the plan names, shape (N, S, ...).
            fields: The fields that the plan names, shape (N, ...).
            force_models: Parameters of the force models that the plan names, shape (N, P) each.
            qpos: Shape (N, nq) or None for the model's own.
            qvel: Shape (N, nv) or None for zero.
            ctrl: Shape (n, K, nu).
            record: Steps to record, shape (R,) int.
            act: Activations at the start, shape (N, na), or None for zero.
        """
        m, tensor = self.model, self._world_model.tensor
        self._world_model.load(spheres, fields)
        for field, unedited in self._unedited:
            wp.copy(unedited, field)
        for (_, values), given in zip(self._force_models, force_models, strict=True):
            wp.to_torch(values).copy_(tensor(given))
        initial = wp.to_torch(m.qpos0) if qpos is None else tensor(qpos)
        wp.to_torch(self._qpos).copy_(initial.expand(self.plan.worlds, -1))
        if qvel is None:
            self._qvel.zero_()
        else:
            wp.to_torch(self._qvel).copy_(tensor(qvel))
        if act is not None:
            wp.to_torch(self._act).copy_(tensor(act))
        if self.plan.steps and m.nu:
            wp.to_torch(self._commands).copy_(tensor(ctrl).reshape(self._commands.shape))
        row_of = np.full(self.plan.steps + 1, -1, dtype=np.int32)
        row_of[record] = np.arange(len(record))
        self._row_of.assign(row_of)

    def run(self) -> Demand:
        """Simulate what was loaded, and wait for it."""
        if self.device.is_cuda:
            torch.cuda.synchronize(self._world_model.device)
        begin, step, end = self._graphs
        with wp.ScopedDevice(self.device):
            wp.capture_launch(begin)
            for _ in range(self.plan.steps):
                wp.capture_launch(step)
            wp.capture_launch(end)
        wp.synchronize_device(self.device)
        peak = self._peak.numpy()
        return Demand(
            contacts=int(max(peak[kernels.PEAK_CONTACTS], peak[kernels.PEAK_PAIRS])),
            constraints=int(peak[kernels.PEAK_CONSTRAINTS]),
            logged=int(peak[kernels.PEAK_LOGGED]),
            overflow=self.data.overflow.numpy().copy(),
            unstable_step=self._unstable.numpy().copy(),
        )

    def records(self) -> list[torch.Tensor]:
        """Return copies of qpos, qvel, sensordata, body positions and quaternions, shape (N, R, ...), NaN if lost."""
        step = torch.full((self.plan.records,), -1, device=self._world_model.device)
        row_of = wp.to_torch(self._row_of)
        recorded = torch.nonzero(row_of >= 0)[:, 0]
        step[row_of[recorded].long()] = recorded
        lost = step[None] >= wp.to_torch(self._unstable)[:, None]
        copies = [wp.to_torch(record).clone() for record in self._records]
        for values in copies:
            values[lost] = torch.nan
        return copies

    def touched(self) -> torch.Tensor:
        """Return a copy of which geom touched which body, shape (N, ngeom, nbody) bool."""
        return wp.to_torch(self._touched).bool()

    def log(self, demand: Demand) -> tuple[np.ndarray, np.ndarray]:
        """Return the logged contacts of the sane steps, in no order.

        Returns:
            Keys (world, step, geom, geom), shape (C, 4) int, and values (position, normal, distance, force), shape
            (C, 10).
        """
        key: np.ndarray = self._key.numpy()[: demand.logged].copy()
        value: np.ndarray = self._value.numpy()[: demand.logged].copy()
        sane = key[:, 1] < demand.unstable_step[key[:, 0]]
        return key[sane], value[sane]

    def _begin(self) -> None:
        """Bring the worlds to the initial state, and the counters to zero."""
        m, d = self.model, self.data
        mjw.reset_data(m, d, self._all)
        wp.copy(d.qpos, self._qpos)
        wp.copy(d.qvel, self._qvel)
        wp.copy(d.act, self._act)
        self._world_model.place(d)
        if self._force_models:
            d.qfrc_actuator.zero_()
            d.qfrc_bias.zero_()
        self._clock.zero_()
        self._peak.zero_()
        self._unstable.fill_(self.plan.steps + 1)
        if self.plan.contacts == "touched":
            self._touched.zero_()

    def _all_parts(self) -> None:
        """Launch all that is captured."""
        for part in (self._begin, self._step, self._begin, self._end):
            part()

    def _step(self) -> None:
        """Hold the commands, evaluate, record, integrate."""
        self._evaluate()
        self._take_contacts()
        self._integrate(self.model, self.data)

    def _end(self) -> None:
        """Evaluate and record the final state."""
        self._evaluate()

    def _evaluate(self) -> None:
        """Compute all that follows from the state and the commands of this step, and record it."""
        plan, m, d = self.plan, self.model, self.data
        wp.launch(
            kernels.command_kernel,
            dim=(plan.worlds, max(m.nu, 1)),
            inputs=[plan.steps, self._commands, self._clock],
            outputs=[d.ctrl],
        )
        self._apply_force_models()
        mjw.forward(m, d)
        widest = max(m.nq, m.nv, m.nsensordata, len(plan.bodies), 1)
        wp.launch(
            kernels.record_kernel,
            dim=(plan.worlds, widest),
            inputs=[
                self._row_of,
                self._bodies,
                d.qpos,
                d.qvel,
                d.qacc,
                d.sensordata,
                d.xpos,
                d.xquat,
                d.nacon,
                d.ncollision,
                d.nefc,
                self._clock,
                self._peak,
                self._unstable,
            ],
            outputs=self._records,
        )

    def _apply_force_models(self) -> None:
        """Let force models act on the coming step, from fields as they were loaded and no applied force."""
        if not self._force_models:
            return
        m, d = self.model, self.data
        for field, unedited in self._unedited:
            wp.copy(field, unedited)
        d.qfrc_applied.zero_()
        d.xfrc_applied.zero_()
        for force_model, values in self._force_models:
            force_model.launch(m, d, values)

    def _take_contacts(self) -> None:
        """Keep what the plan asks for of this step's contacts."""
        m, d = self.model, self.data
        contact = d.contact
        which = [d.nacon, contact.worldid, contact.geom, contact.efc_address]
        if self.plan.contacts == "touched":
            wp.launch(kernels.touch_kernel, dim=d.naconmax, inputs=[*which, m.geom_bodyid], outputs=[self._touched])
        elif self.plan.contacts == "all":
            mjw.contact_force(m, d, self._ids, True, self._force)
            wp.launch(
                kernels.log_kernel,
                dim=d.naconmax,
                inputs=[*which, contact.dist, contact.pos, contact.frame, self._force, self._clock, self._peak],
                outputs=[self._key, self._value],
            )


def _capture(part: Any) -> Any:
    """Return the launches of a function as a graph."""
    with wp.ScopedCapture() as captured:
        part()
    return captured.graph


def world_bytes(compiled: mujoco.MjModel, buffers: Buffers) -> int:
    """Return the memory that the data of one world take [bytes], measured on a world of its own."""

    def total(owner: Any) -> int:
        values = [getattr(owner, field.name) for field in dataclasses.fields(owner)]
        arrays = sum(value.capacity for value in values if isinstance(value, wp.array))
        return arrays + sum(total(value) for value in values if dataclasses.is_dataclass(value))

    with wp.ScopedDevice("cpu"):
        return total(
            mjw.make_data(compiled, nconmax=buffers.contacts, njmax=buffers.constraints, njmax_nnz=buffers.nonzeros)
        )
