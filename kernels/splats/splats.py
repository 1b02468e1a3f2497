"""Tile rasteriser of Gaussian splats, batched over worlds, cameras and objects, with gradients, on CPU and CUDA.

After Kerbl et al., "3D Gaussian Splatting" (2023): Gaussians are projected (`splat_projection`), listed for each tile
of each image by depth (`splat_tiles`), and blended (`splat_blend`). The lists share a fixed number of pairs of Gaussian
and tile, so that nothing is read back from the device and `launch` may be recorded in a graph. What finds no room is
left out, from the last images on, and counted in `overflow`.

Images are equal bit by bit for equal inputs. Gradients are sums in any order on CUDA.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from .blend import TileLists, blend, blend_gradient
from .projection import Frame, SplatPoses, project
from .tiles import DEPTH_BITS, count_pairs, fill_unused_keys, find_tiles, write_keys

TILES = {"cpu": 8, "cuda": 16}
"""Edge of a tile that is quickest on a kind of device [px]."""
PARAMETERS = ("means", "quats", "scales", "opacities", "harmonics")
"""What gradients are taken with respect to."""


@dataclass(frozen=True)
class SplatArrays:
    """N Gaussians of O objects, and where these and C cameras are in W worlds."""

    means: wp.array
    """Centres in the frame of their object [m], `wp.vec3`, shape (N,)."""
    quats: wp.array
    """Quaternions wxyz of any length, from their own axes to the object's frame, `wp.vec4`, shape (N,)."""
    scales: wp.array
    """Standard deviations [m], `wp.vec3`, shape (N,)."""
    opacities: wp.array
    """Opacities [0 to 1], float32, shape (N,)."""
    harmonics: wp.array
    """Coefficients of the colour's spherical harmonics, `wp.vec3`, shape (N, K), K = 1, 4, 9 or 16."""
    owner: wp.array
    """The object that a Gaussian belongs to, int32, shape (N,)."""
    object_poses: wp.array
    """Positions [m] and quaternions wxyz, float32, shape (W, O, 7)."""
    camera_poses: wp.array
    """The same of cameras that look along -z with y up, as MuJoCo's, float32, shape (W, C, 7)."""
    pinholes: wp.array
    """fx, fy, cx, cy [px], (0, 0) the centre of the first pixel, float32, shape (W, C, 4)."""
    hidden: wp.array
    """Planar depth [m] beyond which pixels show nothing, 0 for none, float32, shape (W * C, H, W), or (0, 0, 0)."""
    light: wp.array | None = None
    """Directions that are not level, along which the splats of an image are flattened onto the ground, as their shadow,
    `wp.vec3`, shape (W, C). Colours then mean nothing."""
    ground: float = 0.0
    """Height of the ground in the world's frame [m]."""

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        k = self.harmonics.shape[1] if self.harmonics.ndim == 2 else 0
        worlds, cameras = self.camera_poses.shape[:2]
        for name, dtype, shape in (
            ("means", wp.vec3, (n,)),
            ("quats", wp.vec4, (n,)),
            ("scales", wp.vec3, (n,)),
            ("opacities", wp.float32, (n,)),
            ("harmonics", wp.vec3, (n, k)),
            ("owner", wp.int32, (n,)),
            ("object_poses", wp.float32, (worlds, *self.object_poses.shape[1:2], 7)),
            ("camera_poses", wp.float32, (worlds, cameras, 7)),
            ("pinholes", wp.float32, (worlds, cameras, 4)),
            ("hidden", wp.float32, self.hidden.shape if self.hidden.ndim == 3 else "(images, H, W)"),
        ):
            array = getattr(self, name)
            if array.shape != shape or array.dtype != dtype:
                raise ValueError(
                    f"SplatArrays: {name} must be of shape {shape} and type {dtype.__name__}; found {array.shape} of "
                    f"{array.dtype.__name__}."
                )
        if self.light is not None and (self.light.shape != (worlds, cameras) or self.light.dtype != wp.vec3):
            raise ValueError(f"SplatArrays: light must be of shape {(worlds, cameras)}; found {self.light.shape}.")
        if k not in (1, 4, 9, 16):
            raise ValueError(f"SplatArrays: harmonics must have 1, 4, 9 or 16 coefficients; found {k}.")

    def scene(self) -> Any:
        """Return owners and poses as the kernels take them."""
        scene = SplatPoses()
        scene.owner, scene.object_pose = self.owner, self.object_poses
        scene.camera_pose, scene.pinhole, scene.ground = self.camera_poses, self.pinholes, self.ground
        if self.light is not None:
            scene.light = self.light
        return scene


class SplatPlan:
    """Images of splats with buffers of its own: nothing is allocated or compiled in `launch` and `backward`.

    Both may be recorded by `wp.ScopedCapture`, after a first `launch`; they read the arrays given to the constructor.

    Args:
        arrays: what to render.
        width: width of the images [px].
        height: their height [px].
        capacity: most pairs of Gaussian and tile in all images together; `pairs` has the number used.
        tile: edge of a tile [px], by default what is quickest.
        antialias: take back the opacity that small Gaussians gain where they are blurred to the width of a pixel.
        margin: largest distance of a Gaussian behind the surface in `hidden` [m].
        gradient: also make the buffers of `backward`.
    """

    rgb: wp.array
    """Light of the splats, not yet that of what shines through: premultiplied by `alpha`, `wp.vec3`, shape (images, H,
    W), images W * C, world by world."""
    alpha: wp.array
    """Opacity [0 to 1], float32, shape (images, H, W)."""
    depth: wp.array
    """Mean planar depth of the splats at a pixel [m], 0 where there are none, float32, shape (images, H, W)."""
    pairs: wp.array
    """Pairs of Gaussian and tile in an image, int32, shape (images,)."""
    overflow: wp.array
    """How many of them did not fit, int32, shape (images,)."""
    gradients: dict[str, wp.array]
    """Written by `backward`: means, quats, scales, opacities, harmonics, as in `SplatArrays`; and `pixels`, that of the
    projected places, `wp.vec4`, shape (images * N,): x, y [1/px], depth and opacity."""

    def __init__(
        self,
        arrays: SplatArrays,
        width: int,
        height: int,
        *,
        capacity: int,
        tile: int | None = None,
        antialias: bool = True,
        margin: float = 0.0,
        gradient: bool = False,
    ) -> None:
        device: Any = arrays.means.device
        worlds, cameras = arrays.camera_poses.shape[:2]
        images, self._splats = worlds * cameras, arrays.means.size
        frame = Frame()
        frame.width, frame.height, frame.antialias = width, height, int(antialias)
        frame.tile = edge = tile or TILES["cuda" if device.is_cuda else "cpu"]
        frame.columns, frame.rows = -(-width // edge), -(-height // edge)
        if min(width, height, capacity, images, self._splats) < 1:
            raise ValueError(
                "SplatPlan: width, height, capacity, worlds, cameras and Gaussians must be at least 1; found "
                f"{(width, height, capacity, worlds, cameras, self._splats)}."
            )
        if arrays.hidden.shape not in ((0, 0, 0), (images, height, width)):
            raise ValueError(
                f"SplatPlan: hidden must be of shape {(images, height, width)}; found {arrays.hidden.shape}."
            )
        self.arrays, self.device, self.images, self.capacity = arrays, device, images, capacity
        self._frame, self._tiles, self._margin = frame, images * frame.columns * frame.rows, float(margin)
        self._scene = arrays.scene()

        def new(shape: int | tuple[int, ...], dtype: Any = wp.float32) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        rows = images * self._splats
        self._lists = TileLists()
        self._lists.place, self._lists.shape, self._lists.colour = (
            new(rows, wp.vec4),
            new(rows, wp.vec4),
            new(rows, wp.vec3),
        )
        self._bounds, self._count, self._end = new(rows, wp.vec4i), new(rows, wp.int32), new(rows, wp.int32)
        # The sort needs room for as many again.
        self._key, self._order = new(2 * capacity, wp.int64), new(2 * capacity, wp.int32)
        self._lists.order, self._lists.first = self._order, new(self._tiles + 1, wp.int32)
        self._bits = DEPTH_BITS + (self._tiles + 1).bit_length()
        size = (images, height, width)
        self.rgb, self.alpha, self.depth = new(size, wp.vec3), new(size), new(size)
        self._left, self._last = new(size), new(size, wp.int32)
        self.pairs, self.overflow = new(images, wp.int32), new(images, wp.int32)
        self.gradients = {}
        if gradient:
            for name in PARAMETERS:
                self.gradients[name] = wp.zeros_like(getattr(arrays, name))
            self.gradients["pixels"] = new(rows, wp.vec4)
            self._shape_gradient, self._colour_gradient = new(rows, wp.vec4), new(rows, wp.vec3)

    def launch(self) -> None:
        """Render: write `rgb`, `alpha`, `depth`, `pairs` and `overflow`."""
        lists, device, splats, frame = self._lists, self.device, self._splats, self._frame
        wp.launch(project, (self.images, splats), self._projection(), device=device)
        wp.utils.array_scan(self._count, self._end, inclusive=True)
        wp.launch(
            count_pairs, self.images, [self._end, splats, self.capacity, self.pairs, self.overflow], device=device
        )
        wp.launch(
            write_keys,
            (self.images, splats),
            [frame, splats, self.capacity, lists.place, self._bounds, self._count, self._end, self._key, self._order],
            device=device,
        )
        used = self.capacity
        if device.is_cpu and not device.is_capturing:
            used = min(used, max(1, int(self._end.numpy()[-1])))
        wp.launch(fill_unused_keys, used, [self._end, self._tiles, self._key], device=device)
        wp.utils.radix_sort_pairs(self._key, self._order, used, 0, self._bits)
        wp.launch(find_tiles, self._tiles + 1, [self._key, used, lists.first], device=device)
        self._on_pixels(
            blend,
            [self.arrays.hidden, self._margin, self.rgb, self.alpha, self.depth, self._left, self._last],
        )

    def backward(self, rgb: wp.array, alpha: wp.array, depth: wp.array) -> None:
        """Write `gradients`, after `launch`.

        Args:
            rgb: gradient of a loss with respect to `rgb`, of its type and shape.
            alpha: with respect to `alpha`.
            depth: with respect to `depth`.

        Raises:
            ValueError: the plan was made without `gradient`.
        """
        if not self.gradients:
            raise ValueError("SplatPlan.backward: the plan has no gradient buffers; make it with gradient=True.")
        for array in (*self.gradients.values(), self._shape_gradient, self._colour_gradient):
            array.zero_()
        to_place = self.gradients["pixels"]
        upstream = [rgb, alpha, depth, to_place, self._shape_gradient, self._colour_gradient]
        self._on_pixels(blend_gradient, [self.alpha, self.depth, self._left, self._last, *upstream])
        adjoint = [self.gradients[name] for name in PARAMETERS]
        adjoint += [SplatPoses(), Frame(), to_place, self._shape_gradient, self._colour_gradient, None, None]
        wp.launch(
            project,
            (self.images, self._splats),
            self._projection(),
            adj_inputs=adjoint,
            adjoint=True,
            device=self.device,
        )

    def _projection(self) -> list[Any]:
        lists = self._lists
        parameters = [getattr(self.arrays, name) for name in PARAMETERS]
        written = [lists.place, lists.shape, lists.colour, self._bounds, self._count]
        return [*parameters, self._scene, self._frame, *written]

    def _on_pixels(self, kernel: wp.Kernel, inputs: list[Any]) -> None:
        threads = self._frame.tile**2
        wp.launch(
            kernel, (self._tiles, threads), [self._frame, self._lists, *inputs], device=self.device, block_dim=threads
        )
