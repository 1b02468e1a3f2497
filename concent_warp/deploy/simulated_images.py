"""Images of simulated worlds for a student: ray traced under random looks, or the hybrid rendering.

Both are `ImageSource`s of `train.distil`; this room sees training and renderer, which do not know one another.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import torch
import warp as wp

from concent_warp.deploy.cfg import splat_files
from concent_warp.deploy.cut_edges import CutEdges, add_parts, cut_edges
from concent_warp.errors import RenderError
from concent_warp.kernels.patterns import WAVES, paint_patterns
from concent_warp.model import Model
from concent_warp.render.cameras import place_cameras
from concent_warp.render.composite import HybridCamera, Layers
from concent_warp.render.networks.painter import Painter
from concent_warp.render.networks.pairs import to_bytes
from concent_warp.render.raw import Launches, PosedWorlds, RawCamera, camera_ids
from concent_warp.render.shadow_cfg import ShadowCfg
from concent_warp.render.splats.splats import Splats
from concent_warp.scene.cameras import BASE, with_cameras
from concent_warp.train.distil.cfg import ImagesCfg, LooksCfg
from concent_warp.train.distil.images import ImageSource
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.quaternions import multiply_quaternions, rotation_from_vector
from concent_warp.train.task.task import Task

PATTERNS = 8
"""Patterns of a world, among which its geoms are divided."""
VARIED = (
    "geom_rgba", "geom_size", "geom_pos", "cam_pos", "cam_quat", "light_pos", "light_dir", "light_diffuse",
    "light_ambient",
)  # fmt: skip
"""Fields of the model that differ between worlds."""
WIDEST = 0.5
"""Largest width of a cut [least size of the geom]."""
FLATTEST = 1e-6
"""Least size of what is drawn [m]: a bar of no width is not to be seen."""
HEADLIGHT = {"ambient": [0.1] * 3, "diffuse": [0.15] * 3, "specular": [0.1] * 3}
"""Light from the camera itself, the same in all worlds."""


def simulated_images(environment: Environment, images: ImagesCfg, looks: LooksCfg) -> ImageSource:
    """Return the cameras of an environment's worlds, as in the settings.

    Raises:
        RenderError: A camera or a body is not there, or the networks paint other cameras.
    """
    if images.networks is not None or images.splats:
        return HybridImages(environment, images)
    return RandomisedImages(environment.task, environment.num_envs, images, looks, str(environment.device))


class RandomisedImages:
    """Ray-traced images of N worlds; colours, patterns, lamps and camera poses are sampled for each episode."""

    def __init__(self, task: Task, worlds: int, images: ImagesCfg, looks: LooksCfg, device: str) -> None:
        """Put the scene on a device.

        Args:
            task: The task, whose scene is rendered.
            worlds: N.
            images: Cameras and size of the images.
            looks: Ranges of what is random.
            device: Torch's name of the device.

        Raises:
            RenderError: The scene has no such camera.
        """
        self.cameras, self.size, self._looks = images.cameras, images.size, looks
        objects = [task.compiled.body(body).name for body in task.objects]
        model, edges = _lit_model(task.model, images, looks.lights, objects)
        self._stage = PosedWorlds(model, worlds, varied=VARIED, device=_warp_name(device))
        self._camera = RawCamera(
            self._stage, images.cameras, (images.size, images.size), shadows=images.shadows, samples=images.samples
        )
        self._fields = {name: self._stage.field(name) for name in VARIED}
        self._nominal = {name: value.clone() for name, value in self._fields.items()}
        self._body_of = torch.as_tensor(model.geom_bodyid, dtype=torch.int32, device=device)
        of_objects = [[float(model.body(body).name in objects)] for body in model.geom_bodyid]
        self._of_objects = torch.tensor(of_objects, device=device)
        self._whole = torch.as_tensor(edges.whole, dtype=torch.int32, device=device)
        linear = (edges.size, edges.size_cut, edges.place, edges.place_cut)
        self._parts = [torch.as_tensor(one, dtype=torch.float32, device=device) for one in linear]
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        self._middle = torch.as_tensor(data.xpos[list(task.objects)].mean(axis=0), dtype=torch.float32, device=device)
        self._device, self._worlds, self._bodies = device, worlds, model.nbody
        n, count = worlds, len(images.cameras)
        self._waves = torch.zeros(n, PATTERNS, WAVES, 4, device=device)
        self._contrast = torch.zeros(n, PATTERNS, device=device)
        self._grain = torch.zeros(n, PATTERNS, 3, device=device)
        self._background = torch.zeros(n, count, 2, 3, device=device)
        self._image = torch.zeros(n, count, 3, images.size, images.size, dtype=torch.uint8, device=device)
        self._paint = Launches(self._painting(model), self._stage.device)

    def begin(self, which: torch.Tensor) -> None:
        """Sample the looks of the worlds of a mask (N,) bool."""
        for target, value in zip(self._random(), self._sampled(), strict=True):
            target.copy_(torch.where(which.view(-1, *[1] * (target.ndim - 1)), value, target))

    def render(self, qpos: torch.Tensor, mocap: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """Return the images, see `ImageSource.render`; the next call overwrites them."""
        self._stage.place(qpos, mocap)
        self._camera.render()
        self._paint()
        return self._image

    def state(self) -> dict[str, torch.Tensor]:
        """Return the looks by name."""
        names = (*VARIED, "waves", "contrast", "grain", "background")
        return {name: value.clone() for name, value in zip(names, self._random(), strict=True)}

    def restore(self, state: dict[str, torch.Tensor]) -> None:
        """Set the looks that `state` returned."""
        for target, value in zip(self._random(), state.values(), strict=True):
            target.copy_(value)

    def _random(self) -> list[torch.Tensor]:
        """Return the tensors of what is random."""
        return [*self._fields.values(), self._waves, self._contrast, self._grain, self._background]

    def _sampled(self) -> list[torch.Tensor]:
        """Return random looks of all worlds, in the order of `_random`."""
        cfg, n = self._looks, self._worlds
        nominal = self._nominal
        return [
            self._colours(nominal["geom_rgba"]),
            *self._shapes(nominal["geom_size"], nominal["geom_pos"]),
            nominal["cam_pos"] + cfg.camera_position * self._signed(*nominal["cam_pos"].shape),
            multiply_quaternions(
                nominal["cam_quat"],
                rotation_from_vector(np.radians(cfg.camera_angle) * self._signed(*nominal["cam_pos"].shape)),
            ),
            *self._lamps(nominal["light_pos"].shape[1]),
            self._wave_vectors(),
            cfg.pattern * self._uniform((0.0, 1.0), n, PATTERNS),
            self._grains(),
            self._uniform((0.0, 1.0), n, len(self.cameras), 1, 3) * self._uniform((0.6, 1.0), n, 1, 2, 3),
        ]

    def _colours(self, nominal: torch.Tensor) -> torch.Tensor:
        """Return colours of the geoms, the same change for all of a body, shape (N, ngeom, 4)."""
        cfg, bodies = self._looks, self._body_of.long()
        change = cfg.colour * self._signed(self._worlds, self._bodies, 3)
        other = self._uniform((0.0, 1.0), self._worlds, self._bodies, 3)
        replaced = self._uniform((0.0, 1.0), self._worlds, self._bodies, 1) < cfg.hue_share
        moved = (nominal[..., :3] + change[:, bodies]).clamp(0, 1)
        return torch.cat([torch.where(replaced[:, bodies], other[:, bodies], moved), nominal[..., 3:]], dim=-1)

    def _shapes(self, size: torch.Tensor, place: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return sizes and places of the geoms, those of the objects changed and their edges cut, shape (N, ngeom, 3).

        Args:
            size: Sizes, of parts that of the whole.
            place: Places, likewise.
        """
        cfg = self._looks
        changed = size * (1 + cfg.size * self._signed(*size.shape) * self._of_objects)
        whole = changed[:, self._whole.long()]
        least = whole.masked_fill(whole <= 0, torch.inf).amin(dim=-1, keepdim=True)
        cut = torch.minimum(self._uniform(cfg.chamfer, self._worlds, 1, 1), WIDEST * least)
        by_size, by_cut, place_by_size, place_by_cut = self._parts
        sizes = torch.einsum("gij,ngj->ngi", by_size, whole) + cut * by_cut
        drawn = torch.where(size > 0, sizes.clamp(min=FLATTEST), sizes)
        return drawn, place + torch.einsum("gij,ngj->ngi", place_by_size, whole) + cut * place_by_cut

    def _lamps(self, count: int) -> list[torch.Tensor]:
        """Return positions, directions, light and ambient light of the lamps, shape (N, lamps, 3) each."""
        cfg, shape = self._looks, (self._worlds, count, 1)
        low, high = cfg.light_elevation
        elevation = torch.deg2rad(self._uniform((low, high), *shape))
        around = 2 * np.pi * self._uniform((0.0, 1.0), *shape)
        towards = torch.cat([elevation.cos() * around.cos(), elevation.cos() * around.sin(), elevation.sin()], dim=-1)
        tint = 1 + cfg.light_tint * self._signed(self._worlds, count, 3)
        strength = self._uniform(cfg.light_strength, *shape) * tint
        ambient = self._uniform(cfg.ambient, *shape) * tint
        return [self._middle + self._uniform(cfg.light_distance, *shape) * towards, -towards, strength, ambient]

    def _wave_vectors(self) -> torch.Tensor:
        """Return wave vectors [rad/m] and phases of the patterns, shape (N, PATTERNS, WAVES, 4)."""
        shape = self._waves.shape[:3]
        low, high = self._looks.pattern_length
        direction = torch.randn(*shape, 3, device=self._device)
        striped = self._uniform((0.0, 1.0), *shape[:2], 1, 1) < self._looks.stripe_share
        direction = torch.where(striped, direction[:, :, :1], direction)
        direction = direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True).clamp(min=1e-6)
        # The waves of a pattern have lengths of about one size.
        length = low * (high / low) ** self._uniform((0.0, 1.0), *shape[:2], 1, 1)
        length = length * self._uniform((0.5, 2.0), *shape, 1)
        return torch.cat([2 * np.pi / length * direction, 2 * np.pi * self._uniform((0.0, 1.0), *shape, 1)], dim=-1)

    def _grains(self) -> torch.Tensor:
        """Return cells per length [1/m], contrasts and seeds of the grains, shape (N, PATTERNS, 3)."""
        cfg, shape = self._looks, (self._worlds, PATTERNS)
        low, high = cfg.grain_length
        length = low * (high / low) ** self._uniform((0.0, 1.0), *shape)
        grained = self._uniform((0.0, 1.0), *shape) < cfg.grain_share
        contrast = grained * cfg.grain * self._uniform((0.0, 1.0), *shape)
        return torch.stack([1 / length, contrast, self._uniform((0.0, 1e6), *shape).floor()], dim=-1)

    def _uniform(self, bounds: tuple[float, float], *shape: int) -> torch.Tensor:
        low, high = bounds
        return low + (high - low) * torch.rand(*shape, device=self._device)

    def _signed(self, *shape: int) -> torch.Tensor:
        return 2 * torch.rand(*shape, device=self._device) - 1

    def _painting(self, model: mujoco.MjModel) -> object:
        """Return what launches the patterns, on fixed memory."""
        where, data = self._stage.device, self._stage.simulator[1]
        seen = self._camera.render()
        focal = [float(matrix[0, 0]) for matrix in self._camera.intrinsics()]
        with wp.ScopedDevice(where):
            inputs = [
                wp.from_torch(seen.rgb, dtype=wp.vec3), wp.from_torch(seen.depth), wp.from_torch(seen.segmentation),
                wp.array(camera_ids(model, self.cameras), dtype=int), wp.array(focal, dtype=float),
                data.cam_xpos, data.cam_xmat, wp.from_torch(self._body_of), wp.from_torch(self._whole),
                data.xpos, data.xquat,
                wp.from_torch(self._waves, dtype=wp.vec4), wp.from_torch(self._contrast),
                wp.from_torch(self._grain, dtype=wp.vec3),
                wp.from_torch(self._background, dtype=wp.vec3),
            ]  # fmt: skip
            image = wp.from_torch(self._image.flatten(0, 1))
        return lambda: paint_patterns(inputs, image, where)


class RandomisedCamera:
    """Cameras under random looks, for a data set: what films episodes begins all worlds at once."""

    def __init__(self, task: Task, worlds: int, images: ImagesCfg, looks: LooksCfg, device: str) -> None:
        """Put the scene on a device; see `RandomisedImages`."""
        self._source, self._worlds, self._device = RandomisedImages(task, worlds, images, looks, device), worlds, device
        self.cameras, self.size = self._source.cameras, (images.size, images.size)

    def begin(self) -> None:
        """Sample other looks for all worlds."""
        self._source.begin(torch.ones(self._worlds, dtype=torch.bool, device=self._device))

    def shoot(self, qpos: torch.Tensor | np.ndarray, mocap: tuple[torch.Tensor, torch.Tensor] | None = None) -> Layers:
        """Return the images of all worlds, qpos (W, nq) and mocap as for `HybridCamera.shoot`; of one layer only."""
        assert mocap is not None
        image = self._source.render(torch.as_tensor(qpos), mocap).permute(0, 1, 3, 4, 2).float() / 255
        nothing = torch.zeros_like(image)
        return Layers(image, image, nothing, nothing[..., 0], nothing[..., 0], image)


class HybridImages:
    """The hybrid rendering of N worlds, made smaller: robot and background by networks, objects as splats."""

    def __init__(self, environment: Environment, images: ImagesCfg) -> None:
        """Load networks and splats.

        Raises:
            RenderError: They cannot be read, or do not fit the scene, the cameras or the size of the images.
        """
        device, task, worlds = str(environment.device), environment.task, environment.num_envs
        self.cameras, self.size = images.cameras, images.size
        half = device.startswith("cuda")
        painter = None
        if images.networks is not None:
            painter = Painter.load(Path(images.networks), device=device, steps=1, half=half)
        edge = images.size if painter is None else 4 * painter.size
        if edge % images.size:
            raise RenderError(
                "the painted images cannot be made so small", expected=f"a divisor of {edge}", found=images.size
            )
        self._factor = edge // images.size
        own = [] if painter is None else [painter.cameras[name] for name in self.cameras if name in painter.cameras]
        named = [camera.name for camera in own]
        scene = with_cameras(task.model.scene, [name for name in self.cameras if name not in named])
        spec = Model(scene, task.model.geometry).spec()
        place_cameras(spec, own)
        splats = {body: Splats.read(file, device=device) for body, file in splat_files(images.splats).items()}
        self._camera = HybridCamera(
            spec.compile(), self.cameras, (edge, edge), worlds, objects=task.model.scene.objects(), splats=splats,
            painter=painter, shadows=ShadowCfg() if images.shadows else None, device=_warp_name(device),
        )  # fmt: skip

    def begin(self, which: torch.Tensor) -> None:
        """Begin painting anew, under other lights, in the worlds of a mask (N,) bool."""
        self._camera.begin(which)

    def render(self, qpos: torch.Tensor, mocap: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """Return the images, see `ImageSource.render`."""
        image = self._camera.shoot(qpos, mocap).image.permute(0, 1, 4, 2, 3)
        small = torch.nn.functional.avg_pool2d(image.flatten(0, 1), self._factor)
        return to_bytes(small).view(*image.shape[:3], self.size, self.size)

    def state(self) -> dict[str, torch.Tensor]:
        """Return nothing: an image that was painted before an interruption is painted anew."""
        return {}

    def restore(self, state: dict[str, torch.Tensor]) -> None:
        """Begin painting anew in all worlds."""
        del state
        self._camera.begin()


def base_fovy(images: ImagesCfg, have: Sequence[str]) -> dict[str, float]:
    """Return the field of view [degrees] of the base camera by its name, empty where it is the scene's own.

    Args:
        images: The student's cameras.
        have: Names of the scene's cameras before others are added.
    """
    return {BASE: images.base_fovy} if BASE in images.cameras and BASE not in have else {}


def _lit_model(model: Model, images: ImagesCfg, lamps: int, objects: Sequence[str]) -> tuple[mujoco.MjModel, CutEdges]:
    """Return a scene with the student's cameras, its lights replaced by lamps, compiled; and parts of its objects."""
    spec = Model(with_cameras(model.scene, images.cameras), model.geometry).spec()
    for name, angle in base_fovy(images, [camera.name for camera in model.scene.spec().cameras]).items():
        spec.camera(name).fovy = angle
    for light in list(spec.lights):
        spec.delete(light)
    for k in range(lamps):
        spec.worldbody.add_light(
            pos=[0, 0, 1.5], dir=[0, 0, -1], castshadow=k == 0, cutoff=60.0, specular=[0.1, 0.1, 0.1]
        )
    for name, value in HEADLIGHT.items():
        setattr(spec.visual.headlight, name, value)
    parts = add_parts(spec, objects)
    compiled = spec.compile()
    return compiled, cut_edges(compiled, parts)


def _warp_name(device: str) -> str:
    """Return Warp's name of a device by torch's."""
    return str(wp.device_from_torch(device))
