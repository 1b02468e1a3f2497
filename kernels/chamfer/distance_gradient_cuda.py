"""CUDA kernels of the gradient of the Chamfer distance: nearest points, and the gradient at a point.

The search goes through the other set eight points at a time and stores only in which eight the nearest is; the point
itself is found at the end. The gradient at a point is gathered, not added up by atomics, so that sums do not depend on
the order of threads.
"""

from __future__ import annotations

import functools
from typing import Any

import warp as wp

from .distance_cuda import COMMON, DIFFERENCE, filled

NEAREST_THREADS = 128
"""Threads of a block that searches nearest points."""

NEAREST_PER_THREAD = 4
"""Points that a thread of that block searches for at a time."""

GATHER_THREADS = 128
"""Threads of a block of the gradient kernel, one point each."""

NEAREST = """
    constexpr int K = @K@, THREADS = @THREADS@, TILE = 512, GROUP = 8;
    __shared__ float4 tile[TILE];
    const auto* Q = query.data + set_of(query_batch, n);
    const auto* R = reference.data + set_of(reference_batch, m);
    const bool* Q_valid = query_valid.data ? query_valid.data + set_of(query_valid_batch, n) : nullptr;
    const bool* R_valid = reference_valid.data ? reference_valid.data + set_of(reference_valid_batch, m) : nullptr;

    const int first = chunk * THREADS * K + thread;
    float x[K], y[K], z[K];
    int best[K], group[K];
    bool there[K];
    #pragma unroll
    for (int k = 0; k < K; ++k) {
        const int i = first + k * THREADS;
        x[k] = y[k] = z[k] = FAR;
        best[k] = __float_as_int(1.0e36f);
        group[k] = -1;
        there[k] = i < n && (!Q_valid || Q_valid[i]) && present(Q[i]);
        if (there[k]) {
            x[k] = Q[i].c[0]; y[k] = Q[i].c[1]; z[k] = Q[i].c[2];
        }
    }
    auto fetch = [&](int j) {
        float4 p = make_float4(-FAR, -FAR, -FAR, 0.0f);
        if (j < m && (!R_valid || R_valid[j]) && present(R[j])) {
            p = make_float4(R[j].c[0], R[j].c[1], R[j].c[2], 0.0f);
        }
        return p;
    };
    for (int start = 0; start < m; start += TILE) {
        const int size = min(TILE, (m - start + GROUP - 1) / GROUP * GROUP);
        __syncthreads();
        for (int j = thread; j < size; j += THREADS) tile[j] = fetch(start + j);
        __syncthreads();
        for (int j = 0; j < size; j += GROUP) {
            int least[K];
            #pragma unroll
            for (int k = 0; k < K; ++k) least[k] = NONE;
            #pragma unroll
            for (int g = 0; g < GROUP; g += 2) {
                const float4 p = tile[j + g], q = tile[j + g + 1];
                #pragma unroll
                for (int k = 0; k < K; ++k) {
                    const int to_p = distance(x[k], y[k], z[k], 0.0f, p), to_q = distance(x[k], y[k], z[k], 0.0f, q);
                    least[k] = min(min(least[k], to_p), to_q);
                }
            }
            #pragma unroll
            for (int k = 0; k < K; ++k) {
                if (least[k] < best[k]) {
                    best[k] = least[k];
                    group[k] = start + j;
                }
            }
        }
    }
    // Only the group is known so far; the same arithmetic finds the point in it.
    #pragma unroll
    for (int k = 0; k < K; ++k) {
        const int i = first + k * THREADS;
        if (i >= n) continue;
        int found = there[k] ? -2 : -1;
        if (there[k] && group[k] >= 0) {
            for (int j = group[k] + GROUP - 1; j >= group[k]; --j) {
                if (distance(x[k], y[k], z[k], 0.0f, fetch(j)) == best[k]) found = j;
            }
        }
        nearest.data[size_t(problem) * n + i] = found;
    }
"""

GATHER = """
    constexpr int THREADS = @THREADS@, TILE = 1024;
    __shared__ int4 follows[TILE / 4];
    const auto* X = own.data + set_of(own_batch, n);
    const auto* Y = other.data + set_of(other_batch, m);
    const int* near_own = own_nearest.data + size_t(problem) * n;
    const int* near_other = other_nearest.data + size_t(problem) * m;
    const int i = chunk * THREADS + thread;

    const int near = i < n ? near_own[i] : -1;
    float total[3] = {0.0f, 0.0f, 0.0f};
    auto pull = [&](int j, float weight) {
        float d[3], square = 0.0f;
        for (int c = 0; c < 3; ++c) {
            d[c] = X[i].c[c] - Y[j].c[c];
            square = fmaf(d[c], d[c], square);
        }
        weight *= squared ? 2.0f : (square > 0.0f ? 1.0f / sqrtf(square) : 0.0f);
        for (int c = 0; c < 3; ++c) total[c] = fmaf(weight, d[c], total[c]);
    };
    if (near >= 0) pull(near, own_upstream.data[problem] / own_count.data[problem]);
    const float weight = other_upstream.data[problem] / max(other_count.data[problem], 1);
    for (int start = 0; start < m; start += TILE) {
        const int size = min(TILE, (m - start + 3) / 4 * 4);
        __syncthreads();
        for (int j = thread; j < size; j += THREADS) {
            reinterpret_cast<int*>(follows)[j] = start + j < m ? near_other[start + j] : -1;
        }
        __syncthreads();
        if (near < 0) continue;
        #pragma unroll 4
        for (int j = 0; j < size; j += 4) {
            const int4 f = follows[j / 4];
            if (f.x == i || f.y == i || f.z == i || f.w == i) {
                #pragma unroll 1
                for (int g = j; g < j + 4; ++g) {
                    if (reinterpret_cast<const int*>(follows)[g] == i) pull(start + g, weight);
                }
            }
        }
    }
    if (i < n) {
        for (int c = 0; c < 3; ++c) gradient.data[size_t(problem) * n + i].c[c] = total[c];
    }
"""


@functools.cache
def nearest_kernel() -> Any:
    """Return the kernel of nearest points; launch with dim (problems, chunks of queries, NEAREST_THREADS)."""

    @wp.func_native(filled(COMMON + DIFFERENCE + NEAREST, k=NEAREST_PER_THREAD, threads=NEAREST_THREADS))
    def search(
        problem: int,
        chunk: int,
        query: wp.array2d[wp.vec3],
        reference: wp.array2d[wp.vec3],
        query_valid: wp.array2d[wp.bool],
        reference_valid: wp.array2d[wp.bool],
        query_batch: wp.vec2i,
        reference_batch: wp.vec2i,
        query_valid_batch: wp.vec2i,
        reference_valid_batch: wp.vec2i,
        n: int,
        m: int,
        nearest: wp.array2d[int],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, launch_bounds=NEAREST_THREADS)
    def chamfer_nearest(
        query: wp.array2d[wp.vec3],
        reference: wp.array2d[wp.vec3],
        query_valid: wp.array2d[wp.bool],
        reference_valid: wp.array2d[wp.bool],
        query_batch: wp.vec2i,
        reference_batch: wp.vec2i,
        query_valid_batch: wp.vec2i,
        reference_valid_batch: wp.vec2i,
        n: int,
        m: int,
        nearest: wp.array2d[int],
    ):
        problem, chunk, _thread = wp.tid()
        search(
            problem, chunk, query, reference, query_valid, reference_valid,
            query_batch, reference_batch, query_valid_batch, reference_valid_batch, n, m, nearest,
        )  # fmt: skip

    return chamfer_nearest


@functools.cache
def gradient_kernel() -> Any:
    """Return the kernel of the gradient; launch with dim (problems, chunks of points, GATHER_THREADS)."""

    @wp.func_native(filled(COMMON + GATHER, threads=GATHER_THREADS))
    def gather(
        problem: int,
        chunk: int,
        n: int,
        m: int,
        own: wp.array2d[wp.vec3],
        other: wp.array2d[wp.vec3],
        own_batch: wp.vec2i,
        other_batch: wp.vec2i,
        own_nearest: wp.array2d[int],
        other_nearest: wp.array2d[int],
        own_count: wp.array[int],
        other_count: wp.array[int],
        own_upstream: wp.array[float],
        other_upstream: wp.array[float],
        squared: bool,
        gradient: wp.array2d[wp.vec3],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, launch_bounds=GATHER_THREADS)
    def chamfer_gradient(
        own: wp.array2d[wp.vec3],
        other: wp.array2d[wp.vec3],
        own_batch: wp.vec2i,
        other_batch: wp.vec2i,
        own_nearest: wp.array2d[int],
        other_nearest: wp.array2d[int],
        own_count: wp.array[int],
        other_count: wp.array[int],
        own_upstream: wp.array[float],
        other_upstream: wp.array[float],
        squared: bool,
        gradient: wp.array2d[wp.vec3],
    ):
        problem, chunk, _thread = wp.tid()
        n, m = own_nearest.shape[1], other_nearest.shape[1]
        gather(
            problem, chunk, n, m, own, other, own_batch, other_batch,
            own_nearest, other_nearest, own_count, other_count, own_upstream, other_upstream, squared, gradient,
        )  # fmt: skip

    return chamfer_gradient
