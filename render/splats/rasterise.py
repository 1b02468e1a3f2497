"""Images of splats by the project's own rasteriser, for torch: many worlds, cameras and objects at once.

Cameras are MuJoCo's: they look along -z of their frame, with y up. Poses are a position [m] and a quaternion wxyz, as
`xpos` and `xquat` of bodies; depths are planar, along the camera's axis, 0 where there is nothing, as MuJoCo-Warp's ray
tracer gives them. Pixel coordinates are (column, row), (0, 0) the centre of the first pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import torch
import warp as wp

from concent_warp.errors import RenderError
from concent_warp.kernels.splats.splats import PARAMETERS, SplatArrays, SplatPlan
from concent_warp.render.splats.splats import Splats

PAIR_CAPACITY_RATIO = 2.0
"""Size of the buffer for pairs of Gaussian and tile, as a multiple of what the first images take [-]."""


class Layer(NamedTuple):
    """Splats alone, to be composited over a background: image = rgb + (1 - alpha) * background."""

    rgb: torch.Tensor
    """Light of the splats, premultiplied by alpha, shape (W, C, H, W, 3); colours may be above 1."""
    alpha: torch.Tensor
    """Opacity [0 to 1], shape (W, C, H, W)."""
    depth: torch.Tensor
    """Mean planar depth of the splats at a pixel [m], 0 where alpha is 0, shape (W, C, H, W)."""


def intrinsics_of(fovy: float, width: int, height: int, device: str | torch.device = "cpu") -> torch.Tensor:
    """Return the pinhole matrix [px], shape (3, 3), of a MuJoCo camera with a vertical field of view [degrees]."""
    focal = height / 2 / torch.tan(torch.deg2rad(torch.tensor(fovy / 2)))
    matrix = torch.eye(3)
    matrix[0, 0] = matrix[1, 1] = focal
    matrix[0, 2], matrix[1, 2] = (width - 1) / 2, (height - 1) / 2
    return matrix.to(device)


class Rasteriser:
    """Renders the same objects and sizes again and again, with buffers of its own.

    Args:
        objects: splats of each object, in the object's frame.
        width: width of the images [px].
        height: their height [px].
        worlds: W.
        cameras: C, cameras in a world.
        capacity: pairs of Gaussian and 8 or 16 pixel tile that an image has room for on average; all images share them.
            None takes twice what the first images need, and makes room when `render` needs more. See `overflow`.
        device: where to render, "cpu" or "cuda:0".
        tile: edge of a tile [px], by default what is quickest on the device.
        antialias: take back the opacity that Gaussians smaller than a pixel gain where they are blurred to its width.
        margin: how far behind the surface that the simulation sees a Gaussian still shows [m].
        gradient: make the buffers of `differentiable`.
        ground: height [m] of the plane onto which splats are flattened along `light`, to be seen as their shadow; None
            renders the splats themselves.

    Raises:
        RenderError: there are no splats, or the sizes make no image.
    """

    object_poses: torch.Tensor
    """What `launch` reads: positions [m] and quaternions wxyz of the objects, shape (W, O, 7)."""
    camera_poses: torch.Tensor
    """The same of the cameras, shape (W, C, 7)."""
    pinholes: torch.Tensor
    """fx, fy, cx, cy [px], shape (W, C, 4)."""
    hidden: torch.Tensor
    """Planar depth beyond which a pixel shows no splats [m], 0 for none, shape (W, C, H, W)."""
    light: torch.Tensor
    """Directions of light, downwards, shape (W, C, 3); of no effect without `ground`."""

    def __init__(
        self,
        objects: Sequence[Splats],
        width: int,
        height: int,
        worlds: int = 1,
        cameras: int = 1,
        *,
        capacity: int | None = None,
        device: str | torch.device = "cpu",
        tile: int | None = None,
        antialias: bool = True,
        margin: float = 0.003,
        gradient: bool = False,
        ground: float | None = None,
    ) -> None:
        if not objects or min(len(o) for o in objects) < 1 or min(width, height, worlds, cameras) < 1:
            raise RenderError(
                "nothing to rasterise", expected="objects with splats, and at least one pixel, world and camera",
                found=f"{[len(o) for o in objects]} splats, images {(worlds, cameras, height, width)}",
            )  # fmt: skip
        wp.init()
        # "cuda" becomes "cuda:0", as Warp needs a number.
        self.device, self.width, self.height = torch.zeros(0, device=device).device, width, height
        self.worlds, self.cameras = worlds, cameras
        self._options = {"tile": tile, "antialias": antialias, "margin": margin, "gradient": gradient}

        def new(*shape: int) -> torch.Tensor:
            return torch.zeros(shape, device=self.device)

        self.object_poses, self.camera_poses = new(worlds, len(objects), 7), new(worlds, cameras, 7)
        self.object_poses[..., 3] = self.camera_poses[..., 3] = 1
        self.pinholes, self.hidden = new(worlds, cameras, 4), new(worlds, cameras, height, width)
        self.light = new(worlds, cameras, 3)
        self.light[..., 2] = -1
        self.splats = Splats(*(t.detach() for t in _together(objects, self.device).tensors()))
        owner = [torch.full((len(o),), k, dtype=torch.int32) for k, o in enumerate(objects)]
        kinds = dict(zip(PARAMETERS, (wp.vec3, wp.vec4, wp.vec3, wp.float32, wp.vec3), strict=True))
        self._arrays = SplatArrays(
            **{n: wp.from_torch(t, dtype=kinds[n]) for n, t in zip(PARAMETERS, self.splats.tensors(), strict=True)},
            owner=wp.from_torch(torch.cat(owner).to(self.device)),
            object_poses=wp.from_torch(self.object_poses),
            camera_poses=wp.from_torch(self.camera_poses),
            pinholes=wp.from_torch(self.pinholes),
            hidden=wp.from_torch(self.hidden.view(-1, height, width)),
            light=None if ground is None else wp.from_torch(self.light, dtype=wp.vec3),
            ground=ground or 0.0,
        )
        self._measured = self._limited = capacity is not None
        self._make(worlds * cameras * (4 * len(self.splats) if capacity is None else capacity))
        self.launches = 0

    def _make(self, capacity: int) -> None:
        with self._stream():
            self.plan = SplatPlan(self._arrays, self.width, self.height, capacity=max(capacity, 1), **self._options)

    @property
    def pairs(self) -> torch.Tensor:
        """Pairs of Gaussian and tile in the last images, shape (W, C), int32."""
        return wp.to_torch(self.plan.pairs).view(self.worlds, self.cameras)

    @property
    def overflow(self) -> torch.Tensor:
        """Pairs that found no room in the last images, and were left out, shape (W, C), int32."""
        return wp.to_torch(self.plan.overflow).view(self.worlds, self.cameras)

    def check_room(self) -> None:
        """Wait for the last images and raise `RenderError` where pairs found no room."""
        lost = int(self.overflow.sum())
        if lost:
            raise RenderError(
                "splats were left out of images for lack of memory", expected=f"at most {self.plan.capacity} pairs",
                found=self.plan.capacity + lost,
                fix=f"give the rasteriser a capacity of {-(-int(self.pairs.sum()) // self.plan.images)} or more",
            )  # fmt: skip

    def render(
        self,
        object_poses: torch.Tensor,
        camera_poses: torch.Tensor,
        intrinsics: torch.Tensor,
        depth: torch.Tensor | None = None,
    ) -> Layer:
        """Render all worlds.

        Args:
            object_poses: positions [m] and quaternions wxyz, shape (W, O, 7).
            camera_poses: the same of the cameras, shape (W, C, 7) or what broadcasts to it.
            intrinsics: pinhole matrices [px], shape (3, 3) or (W, C, 3, 3) or what broadcasts to it.
            depth: planar depth that the simulation sees [m], shape (W, C, H, W); splats behind it are hidden. 0
                where it hides nothing: there, and where it sees the very object that the splats stand for.

        Returns:
            The layer, in buffers that the next call overwrites.
        """
        self._set(object_poses, camera_poses, intrinsics, depth)
        self.launch()
        # Where a camera comes near, a Gaussian covers many tiles.
        if not self._limited and int(self.overflow.sum()):
            self._make(int(PAIR_CAPACITY_RATIO * int(self.pairs.sum())))
            self.launch()
        return self.layer()

    def launch(self) -> None:
        """Render what the buffers hold; may be recorded in a graph, after a first call outside of it."""
        with self._stream():
            self.plan.launch()
            if not self._measured:
                self._measured = True
                self._make(int(PAIR_CAPACITY_RATIO * int(self.pairs.sum())))
                self.plan.launch()
        self.launches += 1

    def layer(self) -> Layer:
        """Return the last images, without a copy."""
        shape = (self.worlds, self.cameras, self.height, self.width)
        rgb, alpha, depth = (wp.to_torch(a) for a in (self.plan.rgb, self.plan.alpha, self.plan.depth))
        return Layer(rgb.view(*shape, 3), alpha.view(shape), depth.view(shape))

    def differentiable(
        self,
        objects: Sequence[Splats],
        object_poses: torch.Tensor,
        camera_poses: torch.Tensor,
        intrinsics: torch.Tensor,
        depth: torch.Tensor | None = None,
    ) -> Layer:
        """Render other values of the splats, as many as those given at first, differentiable with respect to them.

        Gradients are to be taken before the next images are rendered.
        """
        self._set(object_poses, camera_poses, intrinsics, depth)
        given = _together(objects, self.device)
        if len(given) != len(self.splats) or given.degree != self.splats.degree:
            raise RenderError(
                "other splats than the rasteriser was made for",
                expected=f"{len(self.splats)} of degree {self.splats.degree}",
                found=f"{len(given)} of degree {given.degree}",
            )
        return Layer(*_Rasterise.apply(self, *given.tensors()))  # pyright: ignore[reportArgumentType]

    def _set(
        self,
        object_poses: torch.Tensor,
        camera_poses: torch.Tensor,
        intrinsics: torch.Tensor,
        depth: torch.Tensor | None,
    ) -> None:
        pinholes = torch.stack([intrinsics[..., i, j] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))], dim=-1)
        for name, buffer, given in (
            ("object_poses", self.object_poses, object_poses),
            ("camera_poses", self.camera_poses, camera_poses),
            ("intrinsics", self.pinholes, pinholes),
            ("depth", self.hidden, depth),
        ):
            if given is None:
                buffer.zero_()
                continue
            try:
                buffer.copy_(given)
            except RuntimeError:
                shape, found = tuple(buffer.shape), tuple(given.shape)
                if buffer is self.pinholes:
                    shape, found = (*shape[:2], 3, 3), tuple(intrinsics.shape)
                raise RenderError(
                    f"{name} of the wrong shape", expected=f"what broadcasts to {shape}", found=found
                ) from None

    def _stream(self) -> AbstractContextManager[Any]:
        """On CUDA, Warp launches on torch's current stream, so that neither waits for the other.

        While a graph of Warp's is recorded, that is done on its own stream.
        """
        if self.device.type != "cuda" or wp.get_device(str(self.device)).is_capturing:
            return nullcontext()
        return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(self.device)), sync_enter=False)


class _Rasterise(torch.autograd.Function):
    """Bridges torch's autograd to the kernels."""

    @staticmethod
    def forward(ctx: Any, rasteriser: Rasteriser, *parameters: torch.Tensor) -> tuple[torch.Tensor, ...]:
        for buffer, given in zip(rasteriser.splats.tensors(), parameters, strict=True):
            buffer.copy_(given)
        rasteriser.launch()
        ctx.rasteriser, ctx.launches = rasteriser, rasteriser.launches
        return tuple(t.clone() for t in rasteriser.layer())

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *upstream: torch.Tensor
    ) -> tuple[torch.Tensor | None, ...]:
        rasteriser: Rasteriser = ctx.rasteriser
        if rasteriser.launches != ctx.launches:
            raise RuntimeError("Rasteriser: other images were rendered before these gradients were taken.")
        plan = rasteriser.plan
        given = [
            wp.from_torch(
                g.contiguous().view(plan.images, rasteriser.height, rasteriser.width, *g.shape[4:]), dtype=kind
            )
            for g, kind in zip(upstream, (wp.vec3, wp.float32, wp.float32), strict=True)
        ]
        with rasteriser._stream():
            plan.backward(*given)
        return (None, *(wp.to_torch(plan.gradients[name]).clone() for name in PARAMETERS))


def _together(objects: Sequence[Splats], device: torch.device) -> Splats:
    """Return the splats of all objects in one, harmonics filled up to the highest degree."""
    most = max(o.harmonics.shape[1] for o in objects)
    columns = [[], [], [], [], []]
    for splats in objects:
        for column, tensor in zip(columns, splats.to(device).tensors(), strict=True):
            column.append(tensor.float())
        missing = most - splats.harmonics.shape[1]
        columns[4][-1] = torch.nn.functional.pad(columns[4][-1], (0, 0, 0, missing))
    return Splats(*(torch.cat(column) for column in columns))
