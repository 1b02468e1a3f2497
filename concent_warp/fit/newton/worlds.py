"""Rollouts of many candidates in Newton, with gradients, in captured graphs.

World p * n + s is candidate p on segment s. A rollout is simulated in chunks of a few hundred steps, by one graph whose
buffers hold the states and contacts of a chunk; states between chunks are kept. The backward run simulates each chunk
once more, from the last to the first, and pulls the gradient through it. So memory and the time to capture do not grow
with the length of a recording. On CUDA all stays on the device.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from concent_warp.fit.newton.scene import NewtonScene

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class Parameters:
    """What P candidates are made of; what is None is as in the model."""

    position: np.ndarray
    """Sphere centres [m], body frame, shape (P, S, 3)."""
    radius: np.ndarray | None = None
    """Radii [m], shape (P, S)."""
    friction: np.ndarray | None = None
    """Friction of the spheres [-], shape (P, S)."""
    friction_scale: np.ndarray | None = None
    """Factor on the friction of all contacts [-], shape (P,)."""
    stiffness_scale: np.ndarray | None = None
    """Factor on the stiffness of all contacts in Newton [-], shape (P,)."""
    mass_scale: np.ndarray | None = None
    """Factor on mass and inertia of each simulated body [-], shape (P, D)."""


CHUNK_STEPS = 200
"""Steps whose states are stored at a time, for gradients: memory grows with it, and the time to repeat steps falls."""
NAMES = ("position", "radius", "friction", "friction_scale", "stiffness_scale", "mass_scale")
"""Of the parameters."""


class NewtonWorlds:
    """Buffers and graphs for P candidates on the segments of a scene."""

    def __init__(self, scene: NewtonScene, count: int, device: str | None = None) -> None:
        """Allocate and capture.

        Args:
            scene: What to simulate.
            count: P.
            device: "cpu" or "cuda:0"; by default CUDA where there is a device.
        """
        import newton
        import warp as wp

        self.scene, self.count = scene, count
        self.device = wp.get_device(device or ("cuda:0" if wp.is_cuda_available() else "cpu"))
        self.segments = len(scene.segments)
        self.worlds = count * self.segments
        self.chunk = min(CHUNK_STEPS, scene.steps)
        self.chunks = -(-scene.steps // self.chunk)
        with wp.ScopedDevice(self.device):
            self._model = self._build(newton)
            self._control = self._model.control()
            self._solver = newton.solvers.SolverSemiImplicit(self._model, angular_damping=0.0)
            self._allocate(newton)
        self._graphs: dict[str, Any] = {}

    def _build(self, newton: Any) -> Any:
        """Return Newton's model: bodies, each with one shape that has the material."""
        import warp as wp

        scene, physics = self.scene, self.scene.physics
        gravity = tuple(float(g) for g in scene.gravity)
        material = newton.ModelBuilder.ShapeConfig(
            density=0.0, ke=float(physics.stiffness.max()), kd=0.0, kf=physics.friction_slope, ka=0.0, mu=1.0
        )
        one = newton.ModelBuilder(gravity=gravity)
        for b, name in enumerate(scene.bodies):
            if b < len(scene.moving):
                body = scene.moving[b]
                row = one.add_link(
                    mass=body.mass,
                    inertia=wp.mat33(body.inertia),
                    com=wp.vec3(*body.com),
                    lock_inertia=True,
                    label=name,
                )
            else:
                unit = wp.mat33(np.eye(3))
                row = one.add_link(mass=1.0, inertia=unit, is_kinematic=True, lock_inertia=True, label=name)
            one.add_shape_sphere(row, radius=1e-3, cfg=material)
        every = newton.ModelBuilder(gravity=gravity)
        every.replicate(one, self.worlds)
        return every.finalize(requires_grad=True)

    def _allocate(self, newton: Any) -> None:
        """Allocate what a rollout reads and writes."""
        import warp as wp

        scene, pairs, physics = self.scene, self.scene.pairs, self.scene.physics
        geometry = scene.model.geometry
        assert geometry is not None
        p, s, d, c, steps = self.count, len(geometry), len(scene.moving), len(pairs), self.chunk
        rows = self.worlds * len(scene.bodies)

        def constant(values: np.ndarray, dtype: Any) -> Any:
            return wp.array(np.ascontiguousarray(values), dtype=dtype)

        def free(shape: Any, dtype: Any) -> Any:
            return wp.zeros(shape, dtype=dtype, requires_grad=True)

        self.parameters = {
            "position": free((p, s), wp.vec3),
            "radius": free((p, s), float),
            "friction": free((p, s), float),
            "friction_scale": free(p, float),
            "stiffness_scale": free(p, float),
            "mass_scale": free((p, d), float),
        }
        body0, body1 = pairs.body.T
        pick = np.minimum(
            np.where(body1 < d, physics.stiffness[np.minimum(body1, d - 1)], np.inf), physics.stiffness[body0]
        )
        damp = np.minimum(
            np.where(body1 < d, physics.damping[np.minimum(body1, d - 1)], np.inf), physics.damping[body0]
        )
        self._pairs = {
            name: constant(values, dtype)
            for name, values, dtype in (
                ("sphere", pairs.sphere, int), ("other", pairs.other, int), ("kind", pairs.kind, int),
                ("rule", pairs.rule, int), ("body0", body0, int), ("body1", body1, int),
                ("frame", pairs.frame, wp.transform), ("size", pairs.size, wp.vec3), ("round", pairs.round, float),
                ("friction", pairs.friction, float), ("stiffness", pick, float), ("damping", damp, float),
            )
        }  # fmt: skip
        self._replayed = constant(np.arange(d, len(scene.bodies)), int)
        # The last chunk goes on beyond the end, where nothing moves that is replayed.
        beyond = ((0, self.chunks * steps - scene.steps), (0, 0), (0, 0), (0, 0))
        self._replay_q = constant(np.pad(scene.replayed, beyond, mode="edge"), wp.transform)
        self._replay_qd = constant(np.pad(scene.replayed_velocity, beyond, mode="edge"), wp.spatial_vector)
        window = (steps + 1, self.segments, len(scene.bodies) - d)
        self._window_q: Any = wp.zeros(window, dtype=wp.transform)
        self._window_qd: Any = wp.zeros(window, dtype=wp.spatial_vector)
        self._moving = constant(np.arange(d), int)
        self._mass = constant(np.array([b.mass for b in scene.moving]), float)
        self._inertia = constant(np.stack([b.inertia for b in scene.moving]), wp.mat33)
        self._body_q: Any = free((steps + 1, rows), wp.transform)
        self._body_qd: Any = free((steps + 1, rows), wp.spatial_vector)
        self._force: Any = free((steps, rows), wp.spatial_vector)
        self._point1, self._normal = free((steps, self.worlds * c), wp.vec3), free((steps, self.worlds * c), wp.vec3)
        self._damping: Any = free((steps, self.worlds * c), float)
        self._fixed = {"point0": free(self.worlds * c, wp.vec3)} | {
            name: free(self.worlds * c, float) for name in ("margin0", "margin1", "stiffness", "damping", "mu")
        }
        start = (
            np.tile(scene.start, (p, 1, 1)).reshape(rows, 7),
            np.tile(scene.start_velocity, (p, 1, 1)).reshape(rows, 6),
        )
        self._kept_q: Any = wp.zeros((self.chunks + 1, rows), dtype=wp.transform)
        self._kept_qd: Any = wp.zeros((self.chunks + 1, rows), dtype=wp.spatial_vector)
        self._kept_q[0].assign(start[0].astype(np.float32))
        self._kept_qd[0].assign(start[1].astype(np.float32))
        self._path: Any = wp.zeros((self.chunks * steps + 1, rows), dtype=wp.transform)
        self._states, self._contacts = self._views(newton)

    def _views(self, newton: Any) -> tuple[list[Any], list[Any]]:
        """Return Newton's states and contacts of all steps, as views of the arrays."""
        import warp as wp

        scene, c = self.scene, len(self.scene.pairs)
        offset = np.arange(self.worlds)[:, None] * len(scene.bodies)
        shape = [wp.array((offset + scene.pairs.body[:, k]).ravel(), dtype=int) for k in (0, 1)]
        # Body b of world w has the one shape w * nb + b, so that shapes count like bodies.
        contact = newton.Contacts(self.worlds * c, 0, per_contact_shape_properties=True)
        contact.rigid_contact_count.assign(np.array([self.worlds * c], dtype=np.int32))
        contact.rigid_contact_shape0, contact.rigid_contact_shape1 = shape
        contact.rigid_contact_point0 = self._fixed["point0"]
        contact.rigid_contact_margin0, contact.rigid_contact_margin1 = self._fixed["margin0"], self._fixed["margin1"]
        contact.rigid_contact_stiffness = self._fixed["stiffness"]
        contact.rigid_contact_friction = self._fixed["mu"]
        state = self._model.state(requires_grad=False)
        states, contacts = [], []
        for k in range(self.chunk + 1):
            now = copy.copy(state)
            now.body_q, now.body_qd = self._body_q[k], self._body_qd[k]
            if k < self.chunk:
                now.body_f = self._force[k]
                here = copy.copy(contact)
                here.rigid_contact_point1, here.rigid_contact_normal = self._point1[k], self._normal[k]
                here.rigid_contact_damping = self._damping[k]
                contacts.append(here)
            states.append(now)
        return states, contacts

    def _prepare(self) -> None:
        """Launch what is the same for all steps: contacts as the parameters make them, masses."""
        import warp as wp

        from concent_warp.kernels import newton_contacts as kernels

        scene, pairs, fixed, given, model = self.scene, self._pairs, self._fixed, self.parameters, self._model
        wp.launch(
            kernels.gather_contacts,
            dim=(self.worlds, len(scene.pairs)),
            inputs=[
                self.segments, pairs["sphere"], pairs["other"], pairs["rule"], pairs["round"], pairs["friction"],
                pairs["stiffness"], pairs["damping"], given["position"], given["radius"], given["friction"],
                given["friction_scale"], given["stiffness_scale"],
            ],
            outputs=[fixed[name] for name in ("point0", "margin0", "margin1", "stiffness", "damping", "mu")],
        )  # fmt: skip
        wp.launch(
            kernels.scale_masses,
            dim=(self.worlds, len(scene.moving)),
            inputs=[len(scene.bodies), self.segments, self._moving, given["mass_scale"], self._mass, self._inertia],
            outputs=[model.body_mass, model.body_inertia, model.body_inv_mass, model.body_inv_inertia],
        )

    def _simulate(self, steps: int) -> None:
        """Launch so many steps of a chunk."""
        import warp as wp

        from concent_warp.kernels import newton_contacts as kernels

        scene, pairs, fixed, position = self.scene, self._pairs, self._fixed, self.parameters["position"]
        bodies, control = len(scene.bodies), self._control
        self._force.zero_()
        for k in range(steps):
            contacts = self._contacts[k]
            wp.launch(
                kernels.write_contacts,
                dim=(self.worlds, len(scene.pairs)),
                inputs=[
                    bodies, self.segments, pairs["body0"], pairs["body1"], pairs["other"], pairs["kind"],
                    pairs["frame"], pairs["size"], position, fixed["point0"], fixed["margin0"], fixed["margin1"],
                    fixed["damping"], scene.physics.onset, self._states[k].body_q,
                ],
                outputs=[contacts.rigid_contact_point1, contacts.rigid_contact_normal, contacts.rigid_contact_damping],
            )  # fmt: skip
            self._solver.step(self._states[k], self._states[k + 1], control, contacts, scene.physics.timestep)
            if len(self._replayed):
                wp.launch(
                    kernels.replay_bodies,
                    dim=(self.worlds, len(self._replayed)),
                    inputs=[bodies, self.segments, k + 1, self._replayed, self._window_q, self._window_qd],
                    outputs=[self._states[k + 1].body_q, self._states[k + 1].body_qd],
                )

    def _run(self, name: str) -> None:
        """Launch a graph: "prepare" or "simulate", or one of them backward; all are captured at the first call."""
        import warp as wp

        if not self._graphs:
            with wp.ScopedDevice(self.device):
                # A step with its gradients compiles and loads everything: nothing may be loaded during a capture.
                with wp.Tape() as first:
                    self._prepare()
                    self._simulate(1)
                first.backward()
                self._tapes = []  # they own what the graphs work on
                for part, launch in (("prepare", self._prepare), ("simulate", lambda: self._simulate(self.chunk))):
                    tape = wp.Tape()
                    with wp.ScopedCapture() as forward, tape:
                        launch()
                    with wp.ScopedCapture() as backward:
                        tape.backward()
                    self._tapes.append(tape)
                    self._graphs |= {part: forward.graph, f"{part} backward": backward.graph}
        wp.capture_launch(self._graphs[name])

    def _chunk(self, c: int) -> None:
        """Simulate one chunk from the state that was kept before it."""
        import warp as wp

        window = slice(c * self.chunk, (c + 1) * self.chunk + 1)
        wp.copy(self._window_q, self._replay_q[window])
        wp.copy(self._window_qd, self._replay_qd[window])
        wp.copy(self._body_q[0], self._kept_q[c])
        wp.copy(self._body_qd[0], self._kept_qd[c])
        self._run("simulate")

    def forward(self, parameters: Parameters) -> torch.Tensor:
        """Simulate candidates.

        Returns:
            Poses of the simulated bodies at all steps, position [m] and quaternion xyzw, on the device, shape
            (K + 1, W, D, 7). Not to be kept: the next call overwrites them.
        """
        import warp as wp

        geometry = self.scene.model.geometry
        assert geometry is not None
        shape = {
            "radius": (geometry.radius, len(geometry)), "friction": (geometry.friction, len(geometry)),
            "friction_scale": (1.0, None), "stiffness_scale": (1.0, None), "mass_scale": (1.0, len(self.scene.moving)),
        }  # fmt: skip
        for name in NAMES:
            value = getattr(parameters, name)
            if value is None:
                default, width = shape[name]
                value = np.broadcast_to(default, (self.count,) if width is None else (self.count, width))
            self.parameters[name].assign(np.ascontiguousarray(value, dtype=np.float32))
        self._run("prepare")
        wp.copy(self._path[0], self._kept_q[0])
        for c in range(self.chunks):
            self._chunk(c)
            wp.copy(self._path[c * self.chunk + 1 : (c + 1) * self.chunk + 1], self._body_q[1:])
            wp.copy(self._kept_q[c + 1], self._body_q[self.chunk])
            wp.copy(self._kept_qd[c + 1], self._body_qd[self.chunk])
        return self._poses(self._path)[: self.scene.steps + 1]

    def backward(self, seed: torch.Tensor, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Return the gradients with respect to the parameters of the last `forward`, each of its parameter's shape.

        Args:
            seed: Gradient of what is asked for with respect to the poses of the simulated bodies at some steps, as
                `forward` gives them, shape (R, W, D, 7). NaN counts as no gradient.
            rows: Those steps, increasing, shape (R,) int.
        """
        import torch
        import warp as wp

        seed = torch.nan_to_num(seed, 0.0, 0.0, 0.0)
        model = self._model
        masses = (model.body_mass, model.body_inertia, model.body_inv_mass, model.body_inv_inertia)
        for array in (*self.parameters.values(), *self._fixed.values(), *masses):
            array.grad.zero_()
        states: tuple[Any, Any] = self._body_q.grad, self._body_qd.grad
        carried = wp.zeros_like(states[0][0]), wp.zeros_like(states[1][0])
        for c in reversed(range(self.chunks)):
            self._chunk(c)
            written = (self._force, self._point1, self._normal, self._damping)
            for array in (*states, *(a.grad for a in written)):
                array.zero_()
            for state, end in zip(states, carried, strict=True):
                wp.copy(state[self.chunk], end)
            mine = np.flatnonzero((rows > c * self.chunk) & (rows <= (c + 1) * self.chunk))
            if len(mine):
                local = torch.as_tensor(rows[mine] - c * self.chunk, device=seed.device)
                self._poses(states[0])[local] += seed[torch.as_tensor(mine, device=seed.device)]
            self._run("simulate backward")
            for state, end in zip(states, carried, strict=True):
                wp.copy(end, state[0])
        self._run("prepare backward")
        return {name: self.parameters[name].grad.numpy().copy() for name in NAMES}

    def _poses(self, array: Any) -> torch.Tensor:
        """Return the rows of the simulated bodies in an array of poses, without a copy."""
        import warp as wp

        # Torch's default stream and Warp's wait for one another, so that neither needs to be synchronised.
        shape = (array.shape[0], self.worlds, len(self.scene.bodies), 7)
        return wp.to_torch(array, requires_grad=False).view(shape)[:, :, : len(self.scene.moving)]

    @property
    def torch_device(self) -> torch.device:
        """Where the poses lie."""
        import torch
        import warp as wp

        return torch.device(wp.device_to_torch(self.device))

    @property
    def memory(self) -> int:
        """Bytes that a step of all worlds takes within a chunk: states, forces, contacts, and their gradients."""
        arrays = (self._body_q, self._body_qd, self._force, self._point1, self._normal, self._damping)
        return 2 * sum(a.strides[0] for a in arrays)
