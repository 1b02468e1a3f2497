"""Chamfer distance between many pairs of point sets, with missing points and gradients, on CPU and CUDA.

For sets A of n_a and B of n_b points present,

    chamfer(A, B) = 1/n_a sum_i min_j |a_i - b_j|  +  1/n_b sum_j min_i |a_i - b_j|

the sum of the two directional terms of Fan, Su and Guibas (A Point Set Generation Network, CVPR 2017, section 4.1),
each as a mean, so that the sizes of the sets do not weigh; squared, |a_i - b_j|^2 stands for |a_i - b_j|. This is
D_CD in the paper's equation of contact geometry. Two copies of one set, one shifted by a little, are thus at twice the
shift.

A point is missing where its mask is False or where a coordinate is NaN, infinite or beyond 1e15 m. A pair of which one
set has no point present has distance 0 in both directions, no gradient and, in `ChamferParts`, weight 0.
Sums run in a fixed order: equal inputs give equal results, bit by bit.

`chamfer` and `chamfer_parts` take torch tensors and are differentiable; `ChamferPlan` takes Warp arrays and owns its
buffers, for captured graphs.
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import torch
import warp as wp

from .distance_cuda import Tiling
from .pairs import PointSetPairs, batch_of, broadcast_shape


class ChamferParts(NamedTuple):
    """The directional means of each pair of sets, and how many points they rest on; each of the batch's shape."""

    a_to_b: torch.Tensor
    """Mean distance from the points of a to their nearest in b [m] (squared: [m^2])."""
    b_to_a: torch.Tensor
    """Mean distance from the points of b to their nearest in a [m] (squared: [m^2])."""
    a_count: torch.Tensor
    """Points present in a, int32."""
    b_count: torch.Tensor
    """Points present in b, int32."""

    @property
    def distance(self) -> torch.Tensor:
        """The Chamfer distance, the sum of both directions [m] (squared: [m^2])."""
        return self.a_to_b + self.b_to_a

    @property
    def weight(self) -> torch.Tensor:
        """1 where both sets have points, 0 where the distance is 0 only because a set is empty, float32."""
        return ((self.a_count > 0) & (self.b_count > 0)).float()


def chamfer(
    a: torch.Tensor,
    b: torch.Tensor,
    a_valid: torch.Tensor | None = None,
    b_valid: torch.Tensor | None = None,
    *,
    squared: bool = False,
) -> torch.Tensor:
    """Chamfer distance of each pair of point sets, differentiable with respect to both.

    Args:
        a: points [m], float32, shape (..., n, 3).
        b: points [m], float32, shape (..., m, 3), leading dimensions broadcast against a's: (T, m, 3) is shared by all
            worlds of a (W, T, n, 3), and not copied.
        a_valid: False where a point of a is missing, bool, shape (..., n), leading dimensions broadcast.
        b_valid: likewise for b, shape (..., m).
        squared: squared distances in place of distances.

    Returns:
        Distances [m] (squared: [m^2]), shape: the broadcast leading dimensions; 0 where a set is empty.

    Raises:
        ValueError: if a tensor has another shape, type or device than stated.
    """
    return chamfer_parts(a, b, a_valid, b_valid, squared=squared).distance


def chamfer_parts(
    a: torch.Tensor,
    b: torch.Tensor,
    a_valid: torch.Tensor | None = None,
    b_valid: torch.Tensor | None = None,
    *,
    squared: bool = False,
) -> ChamferParts:
    """Return the two directional means of `chamfer` and the counts behind them; takes the same arguments."""
    _check_tensors(a, b, a_valid, b_valid)
    return ChamferParts(*_Chamfer.apply(a, b, a_valid, b_valid, squared))  # pyright: ignore[reportArgumentType]


class ChamferPlan:
    """Chamfer distances of Warp arrays with buffers of its own: nothing is allocated or compiled in `launch`.

    Both `launch` and `backward` may be recorded by `wp.ScopedCapture`; they read the arrays given to the constructor.

    Args:
        a: points [m], `wp.vec3`, shape (..., n), contiguous.
        b: points [m], `wp.vec3`, shape (..., m), contiguous; leading dimensions broadcast against a's, without a copy.
        a_valid: False where a point is missing, `wp.bool`, shape (..., n).
        b_valid: likewise for b, shape (..., m).
        squared: squared distances in place of distances.
        gradient: also make the buffers of `backward`.
        tiling: how the CUDA kernel divides its work, the best known by default; no effect on a CPU.

    Raises:
        ValueError: if an array has another shape, type or device than stated.
    """

    a_to_b: wp.array
    """Mean distance from a to b of each pair [m] (squared: [m^2]), shape (pairs,), leading dimensions flattened."""
    b_to_a: wp.array
    """Mean distance from b to a, likewise."""
    a_count: wp.array
    """Points present in a, int32, shape (pairs,)."""
    b_count: wp.array
    """Points present in b, int32, shape (pairs,)."""
    a_gradient: wp.array | None
    """Written by `backward`: gradient with respect to a for each pair, `wp.vec3`, shape (pairs, n). Where pairs share
    a set, its gradient is the sum over them."""
    b_gradient: wp.array | None
    """Gradient with respect to b, likewise, shape (pairs, m)."""

    def __init__(
        self,
        a: wp.array,
        b: wp.array,
        a_valid: wp.array | None = None,
        b_valid: wp.array | None = None,
        *,
        squared: bool = False,
        gradient: bool = False,
        tiling: Tiling | None = None,
    ) -> None:
        self._pairs = pairs = PointSetPairs.of(a, b, a_valid, b_valid)
        self._squared = squared
        self._tiling = tiling
        count, device = pairs.count, pairs.a.device
        self.a_to_b, self.b_to_a = (wp.zeros(count, dtype=wp.float32, device=device) for _ in range(2))
        self.a_count, self.b_count = (wp.zeros(count, dtype=wp.int32, device=device) for _ in range(2))
        self._nearest = pairs.nearest_buffers() if gradient or not pairs.fits_one_pass else None
        self.a_gradient = wp.zeros((count, pairs.n), dtype=wp.vec3, device=device) if gradient else None
        self.b_gradient = wp.zeros((count, pairs.m), dtype=wp.vec3, device=device) if gradient else None
        for kernel, threads in pairs.kernels(tiling, gradient):
            wp.load_module(kernel.module, device=device, block_dim=threads)

    def launch(self) -> None:
        """Write `a_to_b`, `b_to_a`, `a_count` and `b_count`."""
        outputs = (self.a_to_b, self.b_to_a, self.a_count, self.b_count)
        self._pairs.distances(self._squared, outputs, self._nearest, self._tiling)

    def backward(self, a_to_b_upstream: wp.array, b_to_a_upstream: wp.array) -> None:
        """Write `a_gradient` and `b_gradient`, after `launch`.

        Args:
            a_to_b_upstream: gradient of the loss with respect to `a_to_b`, float32, shape (pairs,).
            b_to_a_upstream: gradient of the loss with respect to `b_to_a`, float32, shape (pairs,).

        Raises:
            ValueError: if the plan was made without `gradient`.
        """
        if self._nearest is None or self.a_gradient is None:
            raise ValueError("ChamferPlan.backward: the plan has no gradient buffers; make it with gradient=True.")
        self._pairs.search(self._nearest)
        upstream = (a_to_b_upstream, b_to_a_upstream)
        counts = (self.a_count, self.b_count)
        gradients = (self.a_gradient, self.b_gradient)
        self._pairs.gradients(self._squared, self._nearest, counts, upstream, gradients)


class _Chamfer(torch.autograd.Function):
    """Bridges torch's autograd to the kernels; memory from torch, launches on torch's current stream."""

    @staticmethod
    def forward(
        ctx: Any,
        a: torch.Tensor,
        b: torch.Tensor,
        a_valid: torch.Tensor | None,
        b_valid: torch.Tensor | None,
        squared: bool,
    ) -> tuple[torch.Tensor, ...]:
        shape = _leading_shape(a, b, a_valid, b_valid)
        real = [torch.empty(shape, dtype=torch.float32, device=a.device) for _ in range(2)]
        whole = [torch.empty(shape, dtype=torch.int32, device=a.device) for _ in range(2)]
        if math.prod(shape):
            pairs = _pairs_of_tensors(a, b, a_valid, b_valid)
            scratch = [] if pairs.fits_one_pass else _nearest_tensors(pairs, a.device)
            with _on_torch_stream(a.device):
                outputs = [wp.from_torch(t.view(-1)) for t in (*real, *whole)]
                pairs.distances(squared, outputs, [wp.from_torch(t) for t in scratch])
        ctx.squared = squared
        ctx.save_for_backward(a, b, a_valid, b_valid, *whole)
        ctx.mark_non_differentiable(*whole)
        return (*real, *whole)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *upstream: torch.Tensor
    ) -> tuple[torch.Tensor | None, ...]:
        a, b, a_valid, b_valid, *counts = ctx.saved_tensors
        shape = counts[0].shape
        results: list[torch.Tensor | None] = [
            torch.empty((*shape, *t.shape[-2:]), device=a.device) if needed else None
            for t, needed in zip((a, b), ctx.needs_input_grad[:2], strict=True)
        ]
        if math.prod(shape):
            pairs = _pairs_of_tensors(a, b, a_valid, b_valid)
            given = [g.contiguous().view(-1) for g in upstream[:2]]
            scratch = _nearest_tensors(pairs, a.device)
            with _on_torch_stream(a.device):
                nearest = [wp.from_torch(t) for t in scratch]
                pairs.search(nearest)
                pairs.gradients(
                    ctx.squared,
                    nearest,
                    [wp.from_torch(c.view(-1)) for c in counts],
                    [wp.from_torch(g) for g in given],
                    [None if r is None else wp.from_torch(r.view(-1, *r.shape[-2:]), dtype=wp.vec3) for r in results],
                )
        summed = (r if r is None else r.sum_to_size(t.shape) for r, t in zip(results, (a, b), strict=True))
        return (*summed, None, None, None)


def _check_tensors(*tensors: torch.Tensor | None) -> None:
    device = tensors[0].device if tensors[0] is not None else None
    for name, tensor in zip(("a", "b", "a_valid", "b_valid"), tensors, strict=True):
        if tensor is None:
            continue
        mask = name.endswith("valid")
        dtype, last = (torch.bool, "points") if mask else (torch.float32, "points, 3")
        shaped = tensor.dim() >= (1 if mask else 2) and (mask or tensor.shape[-1] == 3)
        if tensor.dtype != dtype or not shaped or tensor.device != device:
            raise ValueError(
                f"chamfer: {name} must be a {dtype} tensor of shape (..., {last}) on {device}; "
                f"found {tensor.dtype} of shape {tuple(tensor.shape)} on {tensor.device}."
            )


def _leading_shape(
    a: torch.Tensor, b: torch.Tensor, a_valid: torch.Tensor | None, b_valid: torch.Tensor | None
) -> tuple[int, ...]:
    shapes = [a.shape[:-2], b.shape[:-2], *(v.shape[:-1] for v in (a_valid, b_valid) if v is not None)]
    return broadcast_shape(shapes)


def _pairs_of_tensors(
    a: torch.Tensor, b: torch.Tensor, a_valid: torch.Tensor | None, b_valid: torch.Tensor | None
) -> PointSetPairs:
    wp.init()
    whole = _leading_shape(a, b, a_valid, b_valid)

    def compact(tensor: torch.Tensor | None, own: int) -> torch.Tensor | None:
        """Return the tensor in contiguous memory, dimensions that an expand() only repeats taken once."""
        if tensor is None:
            return None
        tensor = tensor.detach()
        for k in range(tensor.dim() - own):
            if tensor.stride(k) == 0:
                tensor = tensor.narrow(k, 0, 1)
        leading, rest = tensor.shape[: tensor.dim() - own], tensor.shape[tensor.dim() - own :]
        if batch_of(leading, whole) is None:
            tensor = tensor.expand(*whole, *rest)
        # Flat once, so that dimensions of size 1 get the strides that Warp expects.
        return tensor.contiguous().view(-1).view(tensor.shape)

    sets = [wp.from_torch(t, dtype=wp.vec3) for t in (compact(a, 2), compact(b, 2)) if t is not None]
    masks = [None if t is None else wp.from_torch(t) for t in (compact(a_valid, 1), compact(b_valid, 1))]
    return PointSetPairs.of(sets[0], sets[1], masks[0], masks[1], whole)


def _nearest_tensors(pairs: PointSetPairs, device: torch.device) -> list[torch.Tensor]:
    return [torch.empty((pairs.count, size), dtype=torch.int32, device=device) for size in (pairs.n, pairs.m)]


def _on_torch_stream(device: torch.device) -> AbstractContextManager[Any]:
    """Return a context in which Warp launches on torch's current CUDA stream, so that neither waits for the other."""
    if device.type != "cuda":
        return nullcontext()
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device)), sync_enter=False)
