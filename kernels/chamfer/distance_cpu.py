"""CPU kernels of the Chamfer distance, written for vector registers.

Warp runs a CPU kernel on one thread, so each of these takes one pair of sets at a time. The points present in the
second set are gathered into arrays of x, y and z, of which sixteen at a time go through vector arithmetic (Clang's
vector types, so that it does not depend on the compiler's vectoriser).
"""

from __future__ import annotations

import functools
from typing import Any

import warp as wp

GATHERED_POINTS = 4096
"""Most points that the second set of the one-pass kernel may have: they are gathered on the stack."""

COMMON = """
    constexpr float LIMIT = 1.0e15f, FAR = 1.0e18f;
    constexpr int LANES = 16, CAPACITY = @CAPACITY@;
    typedef float floats __attribute__((ext_vector_type(16)));
    typedef int ints __attribute__((ext_vector_type(16)));
    alignas(64) float x[CAPACITY], y[CAPACITY], z[CAPACITY];
    auto set_of = [problem](const wp::vec_t<2, wp::int32>& batch, int size) {
        return size_t((problem / batch.c[0]) % batch.c[1]) * size_t(size);
    };
    auto present = [](const bool* valid, const wp::vec_t<3, wp::float32>* set, int i) {   // false for NaN
        const float* c = set[i].c;
        return (!valid || valid[i]) && wp::abs(c[0]) < LIMIT && wp::abs(c[1]) < LIMIT && wp::abs(c[2]) < LIMIT;
    };
    auto at = [](auto* p) -> auto& { return *reinterpret_cast<floats*>(p); };
"""

ONE_PASS = """
    constexpr int GROUP = 4;
    alignas(64) float least[CAPACITY];
    const auto* A = a.data + set_of(a_batch, n);
    const auto* B = b.data + set_of(b_batch, m);
    const bool* A_valid = a_valid.data ? a_valid.data + set_of(a_valid_batch, n) : nullptr;
    const bool* B_valid = b_valid.data ? b_valid.data + set_of(b_valid_batch, m) : nullptr;

    int n_b = 0, n_a = 0;
    for (int j = 0; j < m; ++j) {
        if (!present(B_valid, B, j)) continue;
        x[n_b] = B[j].c[0]; y[n_b] = B[j].c[1]; z[n_b] = B[j].c[2];
        ++n_b;
    }
    const int padded = (n_b + LANES - 1) / LANES * LANES;
    for (int j = n_b; j < padded; ++j) x[j] = y[j] = z[j] = -FAR;
    for (int j = 0; j < padded; ++j) least[j] = 1.0e36f;

    double sum_a = 0.0, sum_b = 0.0;
    for (int i = 0; i < n;) {
        float q[GROUP][3];
        int filled = 0;
        for (; i < n && filled < GROUP; ++i) {
            if (!present(A_valid, A, i)) continue;
            for (int c = 0; c < 3; ++c) q[filled][c] = A[i].c[c];
            ++filled;
        }
        if (filled == 0) break;
        for (int k = filled; k < GROUP; ++k) {
            for (int c = 0; c < 3; ++c) q[k][c] = q[0][c];
        }
        floats best[GROUP];
        for (int k = 0; k < GROUP; ++k) best[k] = 1.0e36f;
        for (int j = 0; j < padded; j += LANES) {
            const floats px = at(x + j), py = at(y + j), pz = at(z + j);
            floats column = at(least + j);
            #pragma unroll
            for (int k = 0; k < GROUP; ++k) {
                const floats dx = q[k][0] - px, dy = q[k][1] - py, dz = q[k][2] - pz;
                const floats d = dx * dx + dy * dy + dz * dz;
                best[k] = d < best[k] ? d : best[k];
                column = d < column ? d : column;
            }
            at(least + j) = column;
        }
        for (int k = 0; k < filled; ++k) {
            float square = best[k][0];
            for (int l = 1; l < LANES; ++l) square = best[k][l] < square ? best[k][l] : square;
            sum_a += squared ? square : wp::sqrt(square);
        }
        n_a += filled;
    }
    for (int j = 0; j < n_b; ++j) sum_b += squared ? least[j] : wp::sqrt(least[j]);
    const bool both = n_a > 0 && n_b > 0;
    a_to_b.data[problem] = both ? sum_a / n_a : 0.0;
    b_to_a.data[problem] = both ? sum_b / n_b : 0.0;
    a_count.data[problem] = n_a;
    b_count.data[problem] = n_b;
"""

NEAREST = """
    alignas(64) int id[CAPACITY];
    const auto* Q = query.data + set_of(query_batch, n);
    const auto* R = reference.data + set_of(reference_batch, m);
    const bool* Q_valid = query_valid.data ? query_valid.data + set_of(query_valid_batch, n) : nullptr;
    const bool* R_valid = reference_valid.data ? reference_valid.data + set_of(reference_valid_batch, m) : nullptr;
    int* found = nearest.data + size_t(problem) * n;

    for (int i = 0; i < n; ++i) found[i] = present(Q_valid, Q, i) ? -2 : -1;
    for (int j = 0; j < m;) {
        int size = 0;
        for (; j < m && size < CAPACITY; ++j) {
            if (!present(R_valid, R, j)) continue;
            x[size] = R[j].c[0]; y[size] = R[j].c[1]; z[size] = R[j].c[2];
            id[size++] = j;
        }
        const int padded = (size + LANES - 1) / LANES * LANES;
        for (int k = size; k < padded; ++k) {
            x[k] = y[k] = z[k] = -FAR;
            id[k] = m;
        }
        for (int i = 0; i < n; ++i) {
            if (found[i] == -1) continue;
            floats best = 1.0e36f;
            ints which = -2;
            for (int k = 0; k < padded; k += LANES) {
                const floats dx = Q[i].c[0] - at(x + k), dy = Q[i].c[1] - at(y + k), dz = Q[i].c[2] - at(z + k);
                const floats d = dx * dx + dy * dy + dz * dz;
                which = d < best ? *reinterpret_cast<ints*>(id + k) : which;
                best = d < best ? d : best;
            }
            float square = 1.0e36f;
            if (found[i] >= 0) {   // from an earlier part of the reference set
                const float* c = R[found[i]].c;
                const float dx = Q[i].c[0] - c[0], dy = Q[i].c[1] - c[1], dz = Q[i].c[2] - c[2];
                square = dx * dx + dy * dy + dz * dz;
            }
            for (int l = 0; l < LANES; ++l) {
                if (which[l] < 0 || best[l] > square) continue;
                if (best[l] == square && found[i] >= 0 && which[l] > found[i]) continue;
                square = best[l];
                found[i] = which[l];
            }
        }
    }
"""


@functools.cache
def one_pass_kernel() -> Any:
    """Return the kernel of both directions in one pass; launch with dim `problems`."""

    @wp.func_native((COMMON + ONE_PASS).replace("@CAPACITY@", str(GATHERED_POINTS)))
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

    @wp.kernel(module="unique", enable_backward=False)
    def chamfer_one_pass_cpu(
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
        problem = wp.tid()
        both_directions(
            problem, a, b, a_valid, b_valid, a_batch, b_batch, a_valid_batch, b_valid_batch,
            n, m, squared, a_to_b, b_to_a, a_count, b_count,
        )  # fmt: skip

    return chamfer_one_pass_cpu


@functools.cache
def nearest_kernel() -> Any:
    """Return the kernel of nearest points; launch with dim `problems`."""

    @wp.func_native((COMMON + NEAREST).replace("@CAPACITY@", str(GATHERED_POINTS)))
    def search(
        problem: int,
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

    @wp.kernel(module="unique", enable_backward=False)
    def chamfer_nearest_cpu(
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
        problem = wp.tid()
        search(
            problem, query, reference, query_valid, reference_valid,
            query_batch, reference_batch, query_valid_batch, reference_valid_batch, n, m, nearest,
        )  # fmt: skip

    return chamfer_nearest_cpu
