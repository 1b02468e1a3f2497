"""The 3D viewer in the browser: a scene at given poses, its contact spheres, targets and controls.

It is a server of viser's: it needs no window and no graphics card, whoever opens its page draws.
"""

from __future__ import annotations

import contextlib
import io
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from concent_warp.errors import ConcentError
from concent_warp.report.live_server import started_server
from concent_warp.report.scene_data import SHAPES, VISIBLE_GROUPS, mesh_arrays
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

COLLIDABLE_COLOUR, EXCLUDED_COLOUR, CONTACT_COLOUR = (20, 60, 150), (95, 100, 110), (185, 20, 0)
"""Colours of spheres: simulated, not simulated, and in contact."""
TARGET_COLOUR, PAIR_COLOUR = (20, 150, 60), (240, 170, 0)
"""Colours of target points, and of the points to be moved there, each with its line."""
HULL_OPACITY = 0.35
"""Opacity of geoms that contain spheres."""
TARGET_RADIUS = 0.003
"""Radius of target points [m]."""
PLANE_HALF_SIZE = 1.0
"""Half size at which an infinite plane is drawn [m]."""
BRIGHTNESS = 0.25
"""Intensity of the environment light, relative to viser's default."""
FIELD_OF_VIEW = 0.5
"""Field of view [rad]."""
SPEEDS = (0.1, 4.0)
"""Slowest and fastest replay, relative to simulated time."""


@dataclass
class ViewerControls:
    """State of the page's controls; written by the page, requests reset by the caller."""

    running: bool = True
    """Whether the simulation runs."""
    step: bool = False
    """Request for one step."""
    reset: bool = False
    """Request for a new episode."""
    speed: float = 1.0
    """Speed relative to simulated time."""


class LiveView:
    """A server with a scene and its controls."""

    def __init__(
        self,
        drawn: mujoco.MjModel,
        geometry: ContactGeometry,
        kept: np.ndarray,
        *,
        host: str,
        port: int,
        speed: float = 1.0,
    ) -> None:
        """Start the server.

        Args:
            drawn: Model whose geoms are drawn.
            geometry: Spheres of its bodies, S of them.
            kept: Which of them are simulated, shape (S,) bool.
            host: Address to serve on; 127.0.0.1 is this machine alone.
            port: Port; the next free one where it is taken.
            speed: Initial speed, relative to simulated time.

        Raises:
            ConcentError: The address cannot be served on, or the speed is not among those of the page.
        """
        if not SPEEDS[0] <= speed <= SPEEDS[1]:
            raise ConcentError("the speed is not right", expected=f"{SPEEDS[0]:g} to {SPEEDS[1]:g}", found=speed)
        self.controls, self.changed = ViewerControls(speed=speed), threading.Event()
        self._geometry, self._kept = geometry, np.asarray(kept, dtype=bool)
        self._server = started_server(host, port)
        self._server.scene.set_up_direction("+z")
        # Viser's default lights desaturate colours.
        self._server.scene.configure_environment_map(environment_intensity=BRIGHTNESS)
        self._server.scene.configure_default_lights(cast_shadow=False)
        self._frames: dict[int, Any] = {}
        self._shapes: list[Any] = []
        self._spheres: dict[str, Any] = {}
        self._colour = np.zeros((len(geometry), 3), dtype=np.uint8)
        self._targets: list[Any] = []
        self._draw_bodies(drawn)
        self._draw_spheres(drawn)
        self._make_controls()

    @property
    def address(self) -> str:
        """URL of the page."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    @property
    def watched(self) -> bool:
        """Whether a client has the page open."""
        return bool(self._server.get_clients())

    def stop(self) -> None:
        """Stop the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def look_at(self, point: Sequence[float], offset: Sequence[float]) -> None:
        """Set the initial view: the target point [m], and the camera's offset from it [m]."""
        camera = self._server.initial_camera
        camera.look_at = np.asarray(point, dtype=float)
        camera.position = np.add(point, offset)
        camera.fov = FIELD_OF_VIEW

    def show(self, position: np.ndarray, quaternion: np.ndarray, touching: np.ndarray, pairs: np.ndarray) -> None:
        """Draw one state.

        Args:
            position: Body origins [m], shape (nbody, 3).
            quaternion: Body orientations, wxyz, shape (nbody, 4).
            touching: Which spheres touch something, shape (S,) bool.
            pairs: Points and their targets [m], world frame, shape (P, 2, 3).
        """
        with self._server.atomic():
            for body, frame in self._frames.items():
                frame.position, frame.wxyz = position[body], quaternion[body]
            self._colour_spheres(touching)
            self._move_targets(pairs)

    def set_message(self, text: str) -> None:
        """Show a message in Markdown on the page."""
        if self._message.content != text:
            self._message.content = text

    def _draw_bodies(self, m: mujoco.MjModel) -> None:
        """Draw the geoms of every body in a frame of its own."""
        glass = set(self._geometry.bodies)
        for body in range(m.nbody):
            first = m.body_geomadr[body]
            rows = range(first, first + m.body_geomnum[body]) if first >= 0 else range(0)
            visible = [g for g in rows if int(m.geom_type[g]) in SHAPES and m.geom_group[g] < VISIBLE_GROUPS]
            name = m.body(body).name
            if not visible and name not in glass:
                continue
            self._frames[body] = self._server.scene.add_frame(f"/body{body}", show_axes=False)
            for g in visible:
                vertices, faces = _surface(m, g)
                rgba = _colour_of(m, g)
                opacity = HULL_OPACITY if name in glass else float(rgba[3])
                handle = self._server.scene.add_mesh_simple(
                    f"/body{body}/geom{g}",
                    vertices.astype(np.float32),
                    faces.astype(np.uint32),
                    color=np.round(255 * rgba[:3]).astype(np.uint8),
                    opacity=None if opacity > 0.99 else opacity,
                    flat_shading=True,
                    position=m.geom_pos[g],
                    wxyz=m.geom_quat[g],
                    cast_shadow=False,
                    visible=name not in glass,
                )
                if name in glass:
                    self._shapes.append(handle)

    def _draw_spheres(self, m: mujoco.MjModel) -> None:
        """Draw the spheres of each object in the frame of its body."""
        import trimesh

        unit = trimesh.creation.icosphere(subdivisions=1)
        self._colour[:] = np.where(self._kept[:, None], COLLIDABLE_COLOUR, EXCLUDED_COLOUR)
        for name in self._geometry.bodies:
            rows = self._geometry.of(name)
            self._spheres[name] = self._server.scene.add_batched_meshes_simple(
                f"/body{m.body(name).id}/spheres",
                np.asarray(unit.vertices, dtype=np.float32),
                np.asarray(unit.faces, dtype=np.uint32),
                batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(rows), 1)),
                batched_positions=self._geometry.position[rows],
                batched_scales=self._geometry.radius[rows],
                batched_colors=self._colour[rows],
                cast_shadow=False,
            )

    def _colour_spheres(self, touching: np.ndarray) -> None:
        """Update the colours of spheres whose contact has changed."""
        colour = np.where(self._kept[:, None], COLLIDABLE_COLOUR, EXCLUDED_COLOUR)
        colour = np.where(np.asarray(touching)[:, None], CONTACT_COLOUR, colour).astype(np.uint8)
        for name, handle in self._spheres.items():
            rows = self._geometry.of(name)
            if not np.array_equal(colour[rows], self._colour[rows]):
                handle.batched_colors = colour[rows]
        self._colour = colour

    def _move_targets(self, pairs: np.ndarray) -> None:
        """Draw the pairs, in handles that are kept while their number stays."""
        points = pairs.reshape(-1, 3).astype(np.float32)
        if self._targets and len(points) == len(self._targets[0].batched_positions):
            dots, lines = self._targets
            dots.batched_positions, lines.points = points, pairs.astype(np.float32)
            return
        for handle in self._targets:
            handle.remove()
        self._targets = []
        if not len(points):
            return
        import trimesh

        unit = trimesh.creation.icosphere(subdivisions=1, radius=TARGET_RADIUS)
        dots = self._server.scene.add_batched_meshes_simple(
            "/targets/points",
            np.asarray(unit.vertices, dtype=np.float32),
            np.asarray(unit.faces, dtype=np.uint32),
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1)),
            batched_positions=points,
            batched_colors=np.tile(np.array([PAIR_COLOUR, TARGET_COLOUR], dtype=np.uint8), (len(pairs), 1)),
            cast_shadow=False,
            visible=self._shows_targets.value,
        )
        lines = self._server.scene.add_line_segments(
            "/targets/lines",
            pairs.astype(np.float32),
            np.tile(np.array([PAIR_COLOUR, TARGET_COLOUR], dtype=np.uint8), (len(pairs), 1, 1)),
            thickness=2.0,
            thickness_units="screen",
            visible=self._shows_targets.value,
        )
        self._targets = [dots, lines]

    def _make_controls(self) -> None:
        """Add the controls to the page."""
        gui, controls = self._server.gui, self.controls
        self._message = gui.add_markdown("")
        running = gui.add_checkbox("Running", controls.running)
        step, reset = gui.add_button("Step"), gui.add_button("Reset")
        speed = gui.add_slider("Speed", min=SPEEDS[0], max=SPEEDS[1], step=0.1, initial_value=controls.speed)
        spheres = gui.add_checkbox("Spheres", True)
        shapes = gui.add_checkbox("Shapes of objects", False)
        self._shows_targets = gui.add_checkbox("Targets", True)

        @running.on_update
        def _(_: object) -> None:
            controls.running = running.value
            self.changed.set()

        @step.on_click
        def _(_: object) -> None:
            running.value = controls.running = False
            controls.step = True
            self.changed.set()

        @reset.on_click
        def _(_: object) -> None:
            controls.reset = True
            self.changed.set()

        @speed.on_update
        def _(_: object) -> None:
            controls.speed = float(speed.value)
            self.changed.set()

        @spheres.on_update
        def _(_: object) -> None:
            for handle in self._spheres.values():
                handle.visible = spheres.value

        @shapes.on_update
        def _(_: object) -> None:
            for handle in self._shapes:
                handle.visible = shapes.value

        @self._shows_targets.on_update
        def _(_: object) -> None:
            for handle in self._targets:
                handle.visible = self._shows_targets.value


def _colour_of(m: mujoco.MjModel, g: int) -> np.ndarray:
    """Return the colour of a geom, red, green, blue and opacity in 0..1, shape (4,)."""
    material = m.geom_matid[g]
    return np.array(m.mat_rgba[material] if material >= 0 else m.geom_rgba[g])


def _surface(m: mujoco.MjModel, g: int) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [m], shape (V, 3), in the geom's frame, and triangles, shape (F, 3), of a geom."""
    import trimesh

    kind, size = mujoco.mjtGeom(int(m.geom_type[g])), np.array(m.geom_size[g])
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return mesh_arrays(m, int(m.geom_dataid[g]))
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        made = trimesh.creation.box(extents=2 * size)
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        made = trimesh.creation.capsule(radius=size[0], height=2 * size[1], count=(12, 12))
        made.apply_translation([0, 0, -made.bounds.mean(axis=0)[2]])
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        made = trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=24)
    elif kind == mujoco.mjtGeom.mjGEOM_PLANE:
        half = np.where(size[:2] > 0, np.minimum(size[:2], PLANE_HALF_SIZE), PLANE_HALF_SIZE)
        made = trimesh.creation.box(extents=[*(2 * half), 2e-3])
        made.apply_translation([0, 0, -1e-3])
    else:
        radii = size if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID else np.full(3, size[0])
        made = trimesh.creation.icosphere(subdivisions=2)
        made.apply_scale(radii)
    return np.asarray(made.vertices), np.asarray(made.faces)
