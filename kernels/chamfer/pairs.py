"""A batch of pairs of point sets in Warp arrays, and the kernel launches that serve it on its device.

Leading dimensions of the two sets and their masks broadcast against each other. They are flattened to one index of
pairs; which set a pair uses follows from a divisor and a modulus, so that a shared set is not copied.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import warp as wp

from . import distance_cpu, distance_cuda, distance_gradient, distance_gradient_cuda
from .distance_cuda import Tiling

MEAN_THREADS = 128
"""Threads of a block that averages the nearest distances of one pair."""


def broadcast_shape(shapes: Sequence[Sequence[int]]) -> tuple[int, ...]:
    """Return the shape that the shapes broadcast to.

    Raises:
        ValueError: if two sizes of a dimension differ and neither is 1.
    """
    rank = max(map(len, shapes))
    padded = [(1,) * (rank - len(shape)) + tuple(shape) for shape in shapes]
    result = []
    for sizes in zip(*padded, strict=True):
        others = set(sizes) - {1}
        if len(others) > 1:
            found = ", ".join(str(tuple(shape)) for shape in shapes)
            raise ValueError(f"chamfer: leading dimensions must broadcast against each other; found {found}.")
        result.append(others.pop() if others else 1)
    return tuple(result)


def batch_of(leading: Sequence[int], whole: Sequence[int]) -> tuple[int, int] | None:
    """Divisor and modulus that take a flat index of `whole` to one of `leading`, where two numbers suffice.

    That is so where the dimensions that `leading` spreads over lie before or after those it has, not between them.
    """
    padded = (1,) * (len(whole) - len(leading)) + tuple(leading)
    sizes = [(own, full) for own, full in zip(padded, whole, strict=True) if full != 1]
    divisor = 1
    while sizes and sizes[-1][0] == 1:
        divisor *= sizes.pop()[1]
    modulus = 1
    while sizes and sizes[-1][0] == sizes[-1][1]:
        modulus *= sizes.pop()[1]
    return (divisor, modulus) if all(own == 1 for own, _ in sizes) else None


@dataclass(frozen=True)
class PointSetPairs:
    """Point sets of `count` pairs: arrays of sets (sets, points), and which set each pair uses."""

    a: wp.array
    b: wp.array
    a_valid: wp.array | None
    b_valid: wp.array | None
    a_batch: wp.vec2i
    b_batch: wp.vec2i
    a_valid_batch: wp.vec2i
    b_valid_batch: wp.vec2i
    count: int

    @classmethod
    def of(
        cls,
        a: wp.array,
        b: wp.array,
        a_valid: wp.array | None = None,
        b_valid: wp.array | None = None,
        leading: Sequence[int] = (),
    ) -> PointSetPairs:
        """Pairs of contiguous arrays of shape (..., points), `wp.vec3` for sets and `wp.bool` for masks.

        Args:
            a: First sets.
            b: Second sets.
            a_valid: False where a point of a is missing.
            b_valid: Likewise for b.
            leading: Leading dimensions of the pairs where these are more than those of the arrays: all are repeated.

        Raises:
            ValueError: if an array has another shape, type or device.
        """
        named = {"a": a, "b": b, "a_valid": a_valid, "b_valid": b_valid}
        arrays = {name: array for name, array in named.items() if array is not None}
        for name, array in arrays.items():
            dtype = wp.bool if name.endswith("valid") else wp.vec3
            partner = a if name.startswith("a") else b
            if array.dtype is not dtype or not array.is_contiguous or array.device != a.device:
                raise ValueError(
                    f"chamfer: {name} must be a contiguous array of {dtype.__name__} on {a.device}; "
                    f"found {array.dtype.__name__} on {array.device}, contiguous: {array.is_contiguous}."
                )
            if array.shape[-1] == 0 or array.shape[-1] != partner.shape[-1]:
                raise ValueError(
                    f"chamfer: a set needs at least one point and a mask as many as its set; "
                    f"found {name} of shape {tuple(array.shape)} and its set of shape {tuple(partner.shape)}."
                )
        whole = broadcast_shape([*(array.shape[:-1] for array in arrays.values()), leading])
        flat: dict[str, Any] = {}
        for name, array in named.items():
            batch = (1, 1) if array is None else batch_of(array.shape[:-1], whole)
            if batch is None:
                raise ValueError(
                    f"chamfer: {name} of leading shape {tuple(arrays[name].shape[:-1])} is broadcast in the middle "
                    f"of {whole}; expand it to the whole shape first."
                )
            flat[f"{name}_batch"] = wp.vec2i(*batch)
            flat[name] = None if array is None else array.reshape((math.prod(array.shape[:-1]), array.shape[-1]))
        return cls(**flat, count=math.prod(whole))

    @property
    def device(self) -> Any:
        """The Warp device of all arrays."""
        return self.a.device

    @property
    def n(self) -> int:
        """Points of each first set."""
        return self.a.shape[1]

    @property
    def m(self) -> int:
        """Points of each second set."""
        return self.b.shape[1]

    @property
    def fits_one_pass(self) -> bool:
        """Whether one of the sets fits in the fast memory of the one-pass kernel."""
        return min(self.n, self.m) <= self._most_second_points

    @property
    def _most_second_points(self) -> int:
        return distance_cuda.SHARED_POINTS if self.device.is_cuda else distance_cpu.GATHERED_POINTS

    def swapped(self) -> PointSetPairs:
        """Return the same pairs with first and second set exchanged."""
        return PointSetPairs(
            self.b, self.a, self.b_valid, self.a_valid,
            self.b_batch, self.a_batch, self.b_valid_batch, self.a_valid_batch, self.count,
        )  # fmt: skip

    def nearest_buffers(self) -> list[wp.array]:
        """New buffers for `search`."""
        device = self.device
        dtype: Any = wp.int32
        return [wp.empty((self.count, k), dtype=dtype, device=device) for k in (self.n, self.m)]

    def kernels(self, tiling: Tiling | None, gradient: bool) -> list[tuple[Any, int]]:
        """Return the kernels that a batch like this launches, each with its threads per block, to load beforehand."""
        cuda = self.device.is_cuda
        found: list[tuple[Any, int]] = []
        if self.fits_one_pass:
            tiling = tiling or self._ordered()[1]
            one_pass = (distance_cuda.one_pass_kernel(tiling), tiling.threads)
            found.append(one_pass if cuda else (distance_cpu.one_pass_kernel(), 1))
        else:
            found.append((distance_gradient.mean_distance, MEAN_THREADS if cuda else 1))
        if gradient or not self.fits_one_pass:
            search = (distance_gradient_cuda.nearest_kernel(), distance_gradient_cuda.NEAREST_THREADS)
            found.append(search if cuda else (distance_cpu.nearest_kernel(), 1))
        if gradient:
            gathering = (distance_gradient_cuda.gradient_kernel(), distance_gradient_cuda.GATHER_THREADS)
            found.append(gathering if cuda else (distance_gradient.gradient_by_scattering, 1))
        return found

    def _ordered(self) -> tuple[bool, Tiling]:
        """Return whether to exchange the sets for the one-pass kernel, and the tiling to use."""
        most = self._most_second_points
        orders = [swap for swap, second in ((False, self.m), (True, self.n)) if second <= most]
        sizes = {False: (self.n, self.m), True: (self.m, self.n)}
        swap = min(orders, key=lambda order: distance_cuda.instructions(*sizes[order]))
        return swap, distance_cuda.best_tiling(sizes[swap][0])

    def distances(
        self,
        squared: bool,
        outputs: Sequence[wp.array],
        nearest: Sequence[wp.array] | None = None,
        tiling: Tiling | None = None,
    ) -> None:
        """Write the directional means and counts of each pair: a to b, b to a, points of a, points of b.

        `nearest` is scratch of `nearest_buffers`, needed where `fits_one_pass` is False.
        """
        if not self.fits_one_pass:
            if not nearest:
                raise ValueError("Pairs.distances: sets of this size need `nearest`.")
            self.search(nearest)
            self._means(squared, outputs, nearest)
            return
        swap, best = self._ordered()
        tiling = tiling or best
        first = self.swapped() if swap else self
        if swap:
            outputs = (outputs[1], outputs[0], outputs[3], outputs[2])
        if self.device.is_cuda:
            kernel, dim, threads = distance_cuda.one_pass_kernel(tiling), (self.count, tiling.threads), tiling.threads
        else:
            kernel, dim, threads = distance_cpu.one_pass_kernel(), (self.count,), 1
        inputs = [*first._sets(), first.n, first.m, squared]
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=[*outputs], device=self.device, block_dim=threads)

    def search(self, nearest: Sequence[wp.array]) -> None:
        """Write the index of each point's nearest in the other set; -1 for a missing point, -2 where there is none."""
        device = self.device
        for pairs, found in ((self, nearest[0]), (self.swapped(), nearest[1])):
            inputs = [*pairs._sets(), pairs.n, pairs.m]
            if device.is_cuda:
                threads = distance_gradient_cuda.NEAREST_THREADS
                chunks = -(-pairs.n // (threads * distance_gradient_cuda.NEAREST_PER_THREAD))
                kernel, dim = distance_gradient_cuda.nearest_kernel(), (self.count, chunks, threads)
            else:
                kernel, dim, threads = distance_cpu.nearest_kernel(), (self.count,), 1
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=[found], device=device, block_dim=threads)

    def gradients(
        self,
        squared: bool,
        nearest: Sequence[wp.array],
        counts: Sequence[wp.array],
        upstream: Sequence[wp.array],
        gradients: Sequence[wp.array | None],
    ) -> None:
        """Write the gradient with respect to each pair's points, (pairs, points) of `wp.vec3`; None is left out."""
        device = self.device
        for pairs, own, other in ((self, 0, 1), (self.swapped(), 1, 0)):
            gradient = gradients[own]
            if gradient is None:
                continue
            if device.is_cuda:
                threads = distance_gradient_cuda.GATHER_THREADS
                kernel, dim = distance_gradient_cuda.gradient_kernel(), (self.count, -(-pairs.n // threads), threads)
            else:
                kernel, dim, threads = distance_gradient.gradient_by_scattering, (self.count,), 1
            inputs = [
                pairs.a, pairs.b, pairs.a_batch, pairs.b_batch,
                nearest[own], nearest[other], counts[own], counts[other], upstream[own], upstream[other], squared,
            ]  # fmt: skip
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=[gradient], device=device, block_dim=threads)

    def _means(self, squared: bool, outputs: Sequence[wp.array], nearest: Sequence[wp.array]) -> None:
        device = self.device
        threads = MEAN_THREADS if device.is_cuda else 1
        for k, pairs in enumerate((self, self.swapped())):
            inputs = [pairs.a, pairs.b, pairs.a_batch, pairs.b_batch, nearest[k], squared, threads]
            wp.launch(
                distance_gradient.mean_distance,
                dim=(self.count, threads),
                inputs=inputs,
                outputs=[outputs[k], outputs[2 + k]],
                device=device,
                block_dim=threads,
            )

    def _sets(self) -> list[Any]:
        return [
            self.a, self.b, self.a_valid, self.b_valid,
            self.a_batch, self.b_batch, self.a_valid_batch, self.b_valid_batch,
        ]  # fmt: skip
