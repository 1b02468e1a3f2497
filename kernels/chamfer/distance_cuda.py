"""CUDA kernels of the Chamfer distance, written for the instruction count of their inner loops.

A block of threads takes one pair of sets. Each thread keeps some points of the first set in registers and walks
through the second set, which is in shared memory; one distance serves both directions. The first set's minima stay in
registers; the second set's go through one warp reduction (`redux`) per point of the second set. Squared distances are
never negative, so their bits order like integers: minima are taken on the bits, three operands an instruction on
Hopper (`VIMNMX3`). With 16 points a thread that makes 7.5 instructions a pair for both directions, counted in the
machine code for sm_90: 6 for the distance, 1 for the minima, 0.5 for the loop. Differences are formed before they are
squared; |a|^2 + |b|^2 - 2 a.b would need 4 for the distance, but in float32 that form is off by percents at a distance
of 1 mm with coordinates of 1 m.

A missing point moves to a far place, +FAR for the first set and -FAR for the second, so that the inner loop need not
ask whether it is there.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

SHARED_POINTS = 1024
"""Most points that the second set of the one-pass kernel may have: they are stored in a block's shared memory."""


@dataclass(frozen=True)
class Tiling:
    """How the one-pass kernel divides a pair of sets among the threads of a block."""

    points_per_lane: int = 16
    """Points of the first set that a thread keeps in registers, an even number; a warp covers 32 times as many."""

    warps: int = 4
    """Warps of a block; each takes an equal share of the second set."""

    unroll: int = 1
    """How often the loop over the second set, two points at a time, is unrolled."""

    expanded: bool = False
    """|a|^2 + |b|^2 - 2 a.b about the second set's first point: fewer instructions, but imprecise; to compare only."""

    blocks: int = 1
    """Blocks that an SM must be able to hold at once, which bounds the registers of a thread."""

    @property
    def threads(self) -> int:
        """Threads of a block."""
        return 32 * self.warps

    @property
    def name(self) -> str:
        """A short name for tables."""
        form = "expanded" if self.expanded else "difference"
        return f"K{self.points_per_lane} W{self.warps} U{self.unroll} B{self.blocks} {form}"


def instructions(n: int, m: int, tiling: Tiling | None = None) -> int:
    """Instructions a warp needs for sets of n and m points, roughly: what decides between tilings, padding included."""
    width = (tiling or best_tiling(n)).points_per_lane
    # Counted in machine code for sm_90: per point of the second set 7 a pair and 8 whatever the width.
    return -(-n // (32 * width)) * (7 * width + 8) * m


def best_tiling(n: int) -> Tiling:
    """Return the tiling with the fewest instructions for a first set of `n` points."""
    candidates = (Tiling(16, blocks=4), Tiling(8), Tiling(4), Tiling(2))
    return min(candidates, key=lambda tiling: instructions(n, 1, tiling))


COMMON = """
    constexpr float LIMIT = 1.0e15f, FAR = 1.0e18f;
    constexpr int NONE = 0x7fffffff;
    const int thread = threadIdx.x;
    auto present = [](const wp::vec_t<3, wp::float32>& q) {   // false for NaN
        return fabsf(q.c[0]) < LIMIT && fabsf(q.c[1]) < LIMIT && fabsf(q.c[2]) < LIMIT;
    };
    auto set_of = [problem](const wp::vec_t<2, wp::int32>& batch, int size) {
        return size_t((problem / batch.c[0]) % batch.c[1]) * size_t(size);
    };
    auto warp_minimum = [](int bits) {
#if __CUDA_ARCH__ >= 800
        return __reduce_min_sync(0xffffffffu, bits);
#else
        for (int offset = 16; offset > 0; offset /= 2) bits = min(bits, __shfl_xor_sync(0xffffffffu, bits, offset));
        return bits;
#endif
    };
"""

DIFFERENCE = """
    auto distance = [](float x, float y, float z, float, const float4& p) {
        const float dx = x - p.x, dy = y - p.y, dz = z - p.z;
        return __float_as_int(fmaf(dx, dx, fmaf(dy, dy, dz * dz)));
    };
"""

EXPANDED = """
    auto distance = [](float x, float y, float z, float w, const float4& p) {
        return __float_as_int(fmaf(x, p.x, fmaf(y, p.y, fmaf(z, p.z, w + p.w))));
    };
"""

ONE_PASS = """
    constexpr int K = @K@, WARPS = @WARPS@, THREADS = 32 * WARPS, CHUNK = 32 * K, CAPACITY = @CAPACITY@;
    constexpr bool EXPANDED = @EXPANDED@;
    __shared__ float4 second[CAPACITY];   // x, y, z and 1 where present (|b|^2 in the expanded form)
    __shared__ int second_best[CAPACITY];
    __shared__ int first_best[WARPS][CHUNK];
    __shared__ float partial[4][WARPS];

    const int lane = thread & 31, warp = thread >> 5;
    const auto* A = a.data + set_of(a_batch, n);
    const auto* B = b.data + set_of(b_batch, m);
    const bool* A_valid = a_valid.data ? a_valid.data + set_of(a_valid_batch, n) : nullptr;
    const bool* B_valid = b_valid.data ? b_valid.data + set_of(b_valid_batch, m) : nullptr;

    float centre[3] = {0.0f, 0.0f, 0.0f};
    if (EXPANDED && present(B[0])) {
        for (int c = 0; c < 3; ++c) centre[c] = B[0].c[c];
    }
    float sums[4] = {0.0f, 0.0f, 0.0f, 0.0f};   // distances a to b, b to a; points present in a, in b

    const int share = (m + 2 * WARPS - 1) / (2 * WARPS) * 2;
    for (int j = thread; j < share * WARPS; j += THREADS) {
        float4 p = make_float4(-FAR, -FAR, -FAR, EXPANDED ? 3.0e36f : 0.0f);
        if (j < m && (!B_valid || B_valid[j])) {
            const auto q = B[j];
            if (present(q)) {
                p = make_float4(q.c[0] - centre[0], q.c[1] - centre[1], q.c[2] - centre[2], 1.0f);
                if (EXPANDED) p.w = fmaf(p.x, p.x, fmaf(p.y, p.y, p.z * p.z));
                sums[3] += 1.0f;
            }
        }
        if (EXPANDED) {
            p.x *= -2.0f; p.y *= -2.0f; p.z *= -2.0f;
        }
        second[j] = p;
        second_best[j] = NONE;
    }

    for (int start = 0; start < n; start += CHUNK) {
        float x[K], y[K], z[K], w[K];
        int best[K];
        unsigned missing = 0;
        #pragma unroll
        for (int k = 0; k < K; ++k) {
            const int i = start + lane + 32 * k;
            x[k] = FAR; y[k] = FAR; z[k] = FAR; w[k] = 3.0e36f;
            best[k] = NONE;
            bool there = false;
            if (i < n && (!A_valid || A_valid[i])) {
                const auto q = A[i];
                if (present(q)) {
                    there = true;
                    x[k] = q.c[0]; y[k] = q.c[1]; z[k] = q.c[2];
                    if (EXPANDED) {
                        x[k] -= centre[0]; y[k] -= centre[1]; z[k] -= centre[2];
                        w[k] = fmaf(x[k], x[k], fmaf(y[k], y[k], z[k] * z[k]));
                    }
                }
            }
            if (!there) missing |= 1u << k;
        }
        __syncthreads();

        const int from = warp * share;
        #pragma unroll @UNROLL@
        for (int j = from; j < from + share; j += 2) {
            const float4 p = second[j], q = second[j + 1];
            int2* slot = reinterpret_cast<int2*>(&second_best[j]);
            int to_p = slot->x, to_q = slot->y;
            #pragma unroll
            for (int k = 0; k < K; k += 2) {
                const int p0 = distance(x[k], y[k], z[k], w[k], p);
                const int q0 = distance(x[k], y[k], z[k], w[k], q);
                const int p1 = distance(x[k + 1], y[k + 1], z[k + 1], w[k + 1], p);
                const int q1 = distance(x[k + 1], y[k + 1], z[k + 1], w[k + 1], q);
                best[k] = min(min(best[k], p0), q0);
                best[k + 1] = min(min(best[k + 1], p1), q1);
                to_p = min(min(to_p, p0), p1);
                to_q = min(min(to_q, q0), q1);
            }
            to_p = warp_minimum(to_p);
            to_q = warp_minimum(to_q);
            *slot = make_int2(to_p, to_q);   // by all lanes, the same value: cheaper than a branch
        }

        #pragma unroll
        for (int k = 0; k < K; ++k) first_best[warp][lane + 32 * k] = (missing >> k) & 1u ? NONE : best[k];
        __syncthreads();
        for (int i = thread; i < CHUNK; i += THREADS) {
            int bits = NONE;
            #pragma unroll
            for (int k = 0; k < WARPS; ++k) bits = min(bits, first_best[k][i]);
            if (bits != NONE) {
                const float square = __int_as_float(max(bits, 0));
                sums[0] += squared ? square : sqrtf(square);
                sums[2] += 1.0f;
            }
        }
        __syncthreads();
    }

    for (int j = thread; j < m; j += THREADS) {
        const bool there = EXPANDED ? second[j].w < 3.0e36f : second[j].w > 0.0f;
        if (there) {
            const float square = __int_as_float(max(second_best[j], 0));
            sums[1] += squared ? square : sqrtf(square);
        }
    }

    #pragma unroll
    for (int s = 0; s < 4; ++s) {
        #pragma unroll
        for (int offset = 16; offset > 0; offset /= 2) sums[s] += __shfl_xor_sync(0xffffffffu, sums[s], offset);
        if (lane == 0) partial[s][warp] = sums[s];
    }
    __syncthreads();
    if (thread == 0) {
        for (int s = 0; s < 4; ++s) {
            sums[s] = 0.0f;
            for (int k = 0; k < WARPS; ++k) sums[s] += partial[s][k];
        }
        const bool both = sums[2] > 0.0f && sums[3] > 0.0f;
        a_to_b.data[problem] = both ? sums[0] / sums[2] : 0.0f;
        b_to_a.data[problem] = both ? sums[1] / sums[3] : 0.0f;
        a_count.data[problem] = (int)sums[2];
        b_count.data[problem] = (int)sums[3];
    }
"""


def filled(template: str, **fields: object) -> str:
    """Return the source with a value for each @FIELD@."""
    for name, value in fields.items():
        template = template.replace(f"@{name.upper()}@", str(value))
    return template


@functools.cache
def one_pass_kernel(tiling: Tiling) -> Any:
    """Return the kernel of both directions in one pass; launch with dim (problems, tiling.threads)."""
    source = filled(
        COMMON + (EXPANDED if tiling.expanded else DIFFERENCE) + ONE_PASS,
        k=tiling.points_per_lane,
        warps=tiling.warps,
        unroll=tiling.unroll,
        capacity=SHARED_POINTS,
        expanded="true" if tiling.expanded else "false",
    )

    @wp.func_native(source)
    def both_directions(
        problem: int,
        a: wp.array2d[wp.vec3],
        b: wp.array2d[wp.vec3],
        a_valid: wp.array2d[wp.bool],
        b_valid: wp.array2d[wp.bool],
        a_batch: wp.vec2i,
        b_batch: wp.vec2i,
        a_valid_batch: wp.vec2i,
        b_valid_batch: wp.vec2i,
        n: int,
        m: int,
        squared: bool,
        a_to_b: wp.array[float],
        b_to_a: wp.array[float],
        a_count: wp.array[int],
        b_count: wp.array[int],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, launch_bounds=(tiling.threads, tiling.blocks))
    def chamfer_one_pass(
        a: wp.array2d[wp.vec3],
        b: wp.array2d[wp.vec3],
        a_valid: wp.array2d[wp.bool],
        b_valid: wp.array2d[wp.bool],
        a_batch: wp.vec2i,
        b_batch: wp.vec2i,
        a_valid_batch: wp.vec2i,
        b_valid_batch: wp.vec2i,
        n: int,
        m: int,
        squared: bool,
        a_to_b: wp.array[float],
        b_to_a: wp.array[float],
        a_count: wp.array[int],
        b_count: wp.array[int],
    ):
        problem, _thread = wp.tid()
        both_directions(
            problem, a, b, a_valid, b_valid, a_batch, b_batch, a_valid_batch, b_valid_batch,
            n, m, squared, a_to_b, b_to_a, a_count, b_count,
        )  # fmt: skip

    return chamfer_one_pass
