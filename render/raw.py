"""The raw simulation image: colour, depth and segmentation by MuJoCo-Warp's ray tracer, for all worlds at once.

The first layer of the hybrid rendering (paper, section 3.2.3 and appendix E). What is returned are views of the ray
tracer's own memory, overwritten by the next image.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import mujoco
import numpy as np

from concent_warp.errors import RenderError
from concent_warp.scene.spheres.contact_geometry import SPHERE_GEOM_GROUP

if TYPE_CHECKING:
    import torch

VISIBLE_GROUP, HIDDEN_GROUP = 0, 5
"""Groups that geoms are put in for a camera that shows or leaves out some."""


@dataclass(frozen=True)
class RawImages:
    """Images of W worlds by C cameras, views of the ray tracer's memory on its device."""

    rgb: torch.Tensor
    """Colour 0..1, shape (W, C, H, W', 3) float32."""
    depth: torch.Tensor
    """Distance along the camera's axis [m], 0 where nothing is, shape (W, C, H, W') float32."""
    segmentation: torch.Tensor
    """MuJoCo's geom id, -1 where nothing is, shape (W, C, H, W') int32."""


class PosedWorlds:
    """Worlds of a model, posed for cameras: MuJoCo-Warp's model and data without a simulation."""

    def __init__(self, model: mujoco.MjModel, worlds: int, *, varied: Sequence[str] = (), device: str = "cpu") -> None:
        """Put a model on a device.

        Args:
            model: Compiled model with its cameras.
            worlds: W.
            varied: Fields of the model with values of their own in each world, see `field`.
            device: Warp's name of the device.
        """
        import mujoco_warp as mjw
        import warp as wp

        self.model, self.worlds, self.device = model, worlds, wp.get_device(device)
        with wp.ScopedDevice(self.device):
            visible_model = _bare(model)
            data = mjw.make_data(visible_model, nworld=worlds, nconmax=1, njmax=1)
            try:
                placed = mjw.put_model(visible_model, batch_sizes=dict.fromkeys(varied, worlds))
                self.simulator: tuple[Any, Any] = placed, data
            except NotImplementedError as error:
                found = " ".join(str(error).split())
                raise RenderError("MuJoCo-Warp, which traces the images, cannot hold this scene", found=found) from None
            self.qpos = wp.to_torch(data.qpos)
            """Positions, shape (W, nq)."""
            self.mocap = (wp.to_torch(data.mocap_pos), wp.to_torch(data.mocap_quat)) if model.nmocap else None
            """Places of what is fixed where a world has it [m] (W, nmocap, 3) and wxyz (W, nmocap, 4)."""
            self.position, self.quaternion = wp.to_torch(data.xpos), wp.to_torch(data.xquat)
            """Body origins [m] (W, nbody, 3) and orientations wxyz (W, nbody, 4), world frame, after `_place`."""
            self.camera_position, self._camera_matrix = wp.to_torch(data.cam_xpos), wp.to_torch(data.cam_xmat)
        self._place = Launches(self._pose, self.device)

    def place(
        self,
        qpos: torch.Tensor | np.ndarray,
        mocap: tuple[torch.Tensor | np.ndarray, torch.Tensor | np.ndarray] | None = None,
    ) -> None:
        """Put the worlds into states, qpos (W, nq), mocap positions (W, nmocap, 3) [m] and wxyz (W, nmocap, 4)."""
        import torch

        self.qpos.copy_(torch.as_tensor(qpos))
        if mocap is not None and self.mocap is not None:
            for target, value in zip(self.mocap, mocap, strict=True):
                target.copy_(torch.as_tensor(value))
        self._place()

    def field(self, name: str) -> torch.Tensor:
        """Return a field of the model that varies, shape (W, ...); what is written to it is seen in the next image."""
        import warp as wp

        return wp.to_torch(getattr(self.simulator[0], name))

    def camera_poses(self, cameras: Sequence[str]) -> torch.Tensor:
        """Return poses of cameras, position [m] and wxyz, looking along -z with y up, shape (W, C, 7)."""
        import torch

        rows = camera_ids(self.model, cameras)
        return torch.cat([self.camera_position[:, rows], _matrix_quaternions(self._camera_matrix[:, rows])], dim=-1)

    def _pose(self) -> None:
        """Launch what poses follow from the positions."""
        import mujoco_warp as mjw

        mjw.kinematics(*self.simulator)
        mjw.camlight(*self.simulator)


class RawCamera:
    """Cameras of a stage, and what they are to show."""

    def __init__(
        self,
        stage: PosedWorlds,
        cameras: Sequence[str],
        size: tuple[int, int],
        *,
        leave_out: Sequence[str] = (),
        objects: Literal["visual", "spheres"] = "visual",
        shadows: bool = False,
        samples: int = 1,
    ) -> None:
        """Set cameras up.

        Args:
            stage: The worlds.
            cameras: Names of C cameras of the model.
            size: Height and width of an image [px].
            leave_out: Bodies that are not shown.
            objects: Whether bodies with contact spheres show these or their own shapes.
            shadows: Whether lights cast shadows.
            samples: Colour samples along each edge of a pixel; depth and segmentation are those of the first.

        Raises:
            RenderError: The model has no such camera, or a size is not right.
        """
        import mujoco_warp as mjw
        import warp as wp

        if min(size) < 1:
            raise RenderError("the size of images is not right", expected="at least 1 x 1", found=size)
        rows = camera_ids(stage.model, cameras)
        self.stage, self.cameras, self.size = stage, tuple(cameras), size
        height, width = size
        shown = _grouped(stage.model, leave_out, objects)
        with wp.ScopedDevice(stage.device):
            self._context = mjw.create_render_context(
                shown, nworld=stage.worlds, cam_res=(width, height), cam_active=rows, render_rgb=True,
                render_depth=True, render_seg=True, use_shadows=shadows, enabled_geom_groups=[VISIBLE_GROUP],
                samples_per_pixel=samples,
            )  # fmt: skip
            shape = (stage.worlds, len(rows), height, width)
            self._colour: Any = wp.zeros(shape, dtype=wp.vec3)
            segmentation = wp.to_torch(self._context.seg_data).view(*shape, 2)[..., 0]
            self._images = RawImages(
                wp.to_torch(self._colour), wp.to_torch(self._context.depth_data).view(shape), segmentation
            )
        self._render = Launches(self._trace, stage.device)

    def render(self) -> RawImages:
        """Return images of the stage as it is placed; the next call overwrites them."""
        self._render()
        return self._images

    def intrinsics(self) -> np.ndarray:
        """Return the pinhole matrices of the cameras [px], shape (C, 3, 3)."""
        return _intrinsics(self.stage.model, self.cameras, self.size)

    def _trace(self) -> None:
        """Launch the ray tracer."""
        import mujoco_warp as mjw

        mjw.refit_bvh(*self.stage.simulator, self._context)
        mjw.render(*self.stage.simulator, self._context)
        for c in range(len(self.cameras)):
            mjw.get_rgb(self._context, c, self._colour[:, c])


class Launches:
    """Warp launches on fixed memory; on CUDA they are recorded after the first time and replayed from then on."""

    def __init__(self, launches: Any, device: Any) -> None:
        """Keep what launches."""
        self._launches, self._device = launches, device
        self._graph: Any = None

    def __call__(self) -> None:
        """Launch, on the stream that torch works on."""
        import warp as wp

        if not self._device.is_cuda:
            with wp.ScopedDevice(self._device):
                self._launches()
            return
        import torch

        stream = wp.stream_from_torch(torch.cuda.current_stream(wp.device_to_torch(self._device)))
        with wp.ScopedDevice(self._device), wp.ScopedStream(stream):
            if self._graph is not None:
                wp.capture_launch(self._graph, stream=stream)
                return
            self._launches()
            wp.synchronize_device(self._device)
        # On a stream of Warp's own: torch's may be the one that cannot be captured.
        with wp.ScopedDevice(self._device), wp.ScopedCapture() as captured:
            self._launches()
        self._graph = captured.graph


def _bare(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy without what only moves a model, as the ray tracer's simulator may not know it."""
    visible_model = copy.copy(model)
    visible_model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    visible_model.opt.noslip_iterations = 0
    return visible_model


def _grouped(model: mujoco.MjModel, leave_out: Sequence[str], objects: Literal["visual", "spheres"]) -> mujoco.MjModel:
    """Return a copy whose geoms are in group SHOWN where they are to be seen, in HIDDEN otherwise.

    Geoms in MuJoCo's groups 0 to 2 are seen as a rule; of bodies with contact spheres, the spheres where that is asked.
    """
    shown = copy.copy(model)
    spheres = (model.geom_group == SPHERE_GEOM_GROUP) & (model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE)
    covered = np.isin(model.geom_bodyid, np.unique(model.geom_bodyid[spheres])) if objects == "spheres" else False
    seen = (model.geom_group < 3) & ~np.asarray(covered)
    if objects == "spheres":
        seen |= spheres
        shown.geom_rgba[spheres, 3] = 1.0
    out = [body_id(model, name) for name in leave_out]
    seen &= ~np.isin(model.geom_bodyid, out)
    shown.geom_group[:] = np.where(seen, VISIBLE_GROUP, HIDDEN_GROUP)
    return shown


def body_id(model: mujoco.MjModel, name: str) -> int:
    """Return the id of a body.

    Raises:
        RenderError: There is none of that name.
    """
    found = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if found < 0:
        raise RenderError(
            "the scene has no such body", expected=[model.body(i).name for i in range(model.nbody)], found=name
        )
    return found


def camera_ids(model: mujoco.MjModel, cameras: Sequence[str]) -> list[int]:
    """Return the ids of cameras.

    Raises:
        RenderError: There is none of a name.
    """
    names = [model.camera(i).name for i in range(model.ncam)]
    if unknown := [name for name in cameras if name not in names]:
        raise RenderError("the scene has no such camera", expected=f"some of {names}", found=unknown)
    return [names.index(name) for name in cameras]


def _intrinsics(model: mujoco.MjModel, cameras: Sequence[str], size: tuple[int, int]) -> np.ndarray:
    """Return pinhole matrices [px] of cameras given by their field of view, shape (C, 3, 3).

    (0, 0) is the centre of the first pixel.
    """
    height, width = size
    found = np.tile(np.eye(3), (len(cameras), 1, 1))
    for matrix, row in zip(found, camera_ids(model, cameras), strict=True):
        focal = height / 2 / np.tan(np.radians(float(model.cam_fovy[row])) / 2)
        matrix[0, 0] = matrix[1, 1] = focal
        matrix[:2, 2] = (width - 1) / 2, (height - 1) / 2
    return found


def _matrix_quaternions(matrices: torch.Tensor) -> torch.Tensor:
    """Return unit quaternions wxyz (..., 4) of rotation matrices (..., 3, 3).

    Of the four rows of q q^T, each 4 q_i q, that of the largest number is taken (Shepperd, J. Guid. Control 1, 1978).
    """
    import torch

    m = matrices
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    rows = [
        torch.stack([1 + xx + yy + zz, wx, wy, wz], dim=-1),
        torch.stack([wx, 1 + xx - yy - zz, xy, xz], dim=-1),
        torch.stack([wy, xy, 1 - xx + yy - zz, yz], dim=-1),
        torch.stack([wz, xz, yz, 1 - xx - yy + zz], dim=-1),
    ]
    largest = torch.stack([row[..., i] for i, row in enumerate(rows)], dim=-1).argmax(dim=-1)
    choice = largest[..., None, None].expand(*largest.shape, 1, 4)
    chosen = torch.stack(rows, dim=-2).gather(-2, choice).squeeze(-2)
    return chosen / chosen.norm(dim=-1, keepdim=True)
