"""The Chamfer kernels against float64 references: SciPy's k-d tree for distances, central differences for gradients."""

import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial import KDTree

from concent_warp.kernels.chamfer import distance_cpu, distance_cuda, distance_gradient, distance_gradient_cuda
from concent_warp.kernels.chamfer.distance import ChamferPlan, chamfer, chamfer_parts
from concent_warp.kernels.chamfer.pairs import batch_of


def points(rng, *shape):
    """Points of about a metre's spread, float32, shape (*shape, 3)."""
    return torch.from_numpy(rng.normal(size=(*shape, 3)).astype(np.float32))


def reference_parts(a, b, a_valid=None, b_valid=None, squared=False):
    """Directional means of one pair in float64 by k-d tree; zeros where a set is empty."""
    present = []
    for points_of, valid in ((a, a_valid), (b, b_valid)):
        keep = np.isfinite(points_of.numpy()).all(-1)
        if valid is not None:
            keep &= valid.numpy()
        present.append(points_of.numpy()[keep].astype(np.float64))
    if not len(present[0]) or not len(present[1]):
        return 0.0, 0.0
    power = 2 if squared else 1
    ab = (KDTree(present[1]).query(present[0])[0] ** power).mean()
    ba = (KDTree(present[0]).query(present[1])[0] ** power).mean()
    return ab, ba


@pytest.mark.parametrize("squared", [False, True])
@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 50), (17, 16), (33, 130), (257, 100), (600, 4100)])
def test_distance_matches_kd_tree(n, m, squared):
    rng = np.random.default_rng(n * m)
    a, b = points(rng, 3, n), points(rng, 3, m)
    parts = chamfer_parts(a, b, squared=squared)
    expected = np.array([reference_parts(x, y, squared=squared) for x, y in zip(a, b, strict=True)])
    np.testing.assert_allclose(parts.a_to_b, expected[:, 0], rtol=2e-6)
    np.testing.assert_allclose(parts.b_to_a, expected[:, 1], rtol=2e-6)
    np.testing.assert_allclose(chamfer(a, b, squared=squared), expected.sum(1), rtol=2e-6)


def test_sets_too_large_for_one_pass_match_kd_tree():
    rng = np.random.default_rng(5)
    n, m = distance_cpu.GATHERED_POINTS + 5, distance_cpu.GATHERED_POINTS + 90
    a, b = points(rng, n), points(rng, m)
    a_valid = torch.from_numpy(rng.random(n) > 0.3)
    parts = chamfer_parts(a, b, a_valid)
    np.testing.assert_allclose((parts.a_to_b, parts.b_to_a), reference_parts(a, b, a_valid), rtol=2e-6)
    assert parts.a_count == a_valid.sum()
    assert parts.b_count == m


def test_millimetre_distances_at_metre_coordinates_keep_a_thousandth():
    rng = np.random.default_rng(0)
    a = points(rng, 64) + 1.0
    for offset in (1e-4, 1e-3):
        step = torch.from_numpy(rng.normal(size=(64, 3)))
        b = (a.double() + offset * step / step.norm(dim=-1, keepdim=True)).float()
        expected = sum(reference_parts(a, b))
        assert abs(float(chamfer(a, b)) / expected - 1) < 1e-5


def test_missing_points_are_left_out_of_both_directions():
    rng = np.random.default_rng(1)
    a, b = points(rng, 4, 40), points(rng, 4, 23)
    a_valid, b_valid = torch.from_numpy(rng.random((4, 40)) > 0.4), torch.from_numpy(rng.random((4, 23)) > 0.4)
    a[:, ::7, 1] = torch.nan
    a[0, 3, 0] = torch.inf
    a_valid[3] = False
    parts = chamfer_parts(a, b, a_valid, b_valid)
    expected = np.array([reference_parts(*pair) for pair in zip(a, b, a_valid, b_valid, strict=True)])
    np.testing.assert_allclose(torch.stack((parts.a_to_b, parts.b_to_a), 1), expected, rtol=2e-6)
    assert torch.equal(parts.a_count.long(), (a_valid & a.isfinite().all(-1)).sum(-1))
    assert torch.equal(parts.b_count.long(), b_valid.sum(-1))
    assert parts.weight.tolist() == [1, 1, 1, 0]


@pytest.mark.parametrize("empty", ["a", "b", "both"])
def test_pair_with_an_empty_set_has_no_distance_weight_or_gradient(empty):
    rng = np.random.default_rng(2)
    a, b = points(rng, 5).requires_grad_(), points(rng, 6).requires_grad_()
    masks = [torch.full((k,), empty not in (name, "both")) for name, k in (("a", 5), ("b", 6))]
    parts = chamfer_parts(a, b, *masks)
    gradients = torch.autograd.grad(parts.distance, (a, b))
    assert parts.distance == 0
    assert parts.weight == 0
    assert not any(gradient.any() for gradient in gradients)


@pytest.mark.parametrize(
    ("a_shape", "b_shape", "mask_shape"),
    [
        ((3, 4, 9), (4, 7), (7,)),
        ((3, 4, 9), (3, 1, 7), (4, 7)),
        ((9,), (3, 4, 7), (3, 1, 7)),
        ((2, 1, 2, 9), (1, 3, 2, 7), (2, 3, 1, 7)),
        ((2, 3, 2, 9), (2, 1, 2, 7), (7,)),
    ],
)
def test_leading_dimensions_broadcast(a_shape, b_shape, mask_shape):
    rng = np.random.default_rng(3)
    a, b = points(rng, *a_shape), points(rng, *b_shape)
    b_valid = torch.from_numpy(rng.random(mask_shape) > 0.3)
    whole = torch.broadcast_shapes(a_shape[:-1], b_shape[:-1], mask_shape[:-1])
    expanded = [a.expand(*whole, *a.shape[-2:]), b.expand(*whole, *b.shape[-2:]), b_valid.expand(*whole, 7)]
    shared = [t.clone().requires_grad_() for t in (a, b)]
    separate = [t.clone().requires_grad_() for t in expanded[:2]]
    result = chamfer(*shared, b_valid=b_valid)
    assert result.shape == whole
    alone = [
        sum(reference_parts(x, y, None, valid))
        for x, y, valid in zip(*(t.flatten(0, len(whole) - 1) for t in expanded), strict=True)
    ]
    np.testing.assert_allclose(result.detach().flatten(), alone, rtol=2e-6)
    weights = torch.from_numpy(rng.normal(size=whole))
    at_once = torch.autograd.grad((result * weights).sum(), shared)
    each = torch.autograd.grad((chamfer(*separate, b_valid=expanded[2]) * weights).sum(), separate)
    for one, many in zip(at_once, each, strict=True):
        torch.testing.assert_close(one, many.sum_to_size(one.shape), rtol=1e-5, atol=1e-7)


def test_set_shared_by_all_worlds_is_not_copied():
    assert batch_of((6,), (5, 6)) == (1, 6)
    assert batch_of((5, 1), (5, 6)) == (6, 5)
    assert batch_of((), (5, 6)) == (30, 1)
    assert batch_of((5, 6), (5, 6)) == (1, 30)
    assert batch_of((5, 1, 2), (5, 6, 2)) is None


def central_differences(a, b, weights, squared, step=1e-6):
    """Gradient of weights . (a_to_b, b_to_a) with respect to both sets by central differences in float64."""
    sets = [a.numpy().astype(np.float64), b.numpy().astype(np.float64)]

    def value():
        d = ((sets[0][:, None] - sets[1]) ** 2).sum(-1)
        d = d if squared else np.sqrt(d)
        return weights[0] * d.min(1).mean() + weights[1] * d.min(0).mean()

    gradients = []
    for points_of in sets:
        gradient = np.zeros_like(points_of)
        for k in np.ndindex(points_of.shape):
            kept = points_of[k]
            points_of[k] = kept + step
            above = value()
            points_of[k] = kept - step
            gradient[k] = (above - value()) / (2 * step)
            points_of[k] = kept
        gradients.append(gradient)
    return gradients


@pytest.mark.parametrize("squared", [False, True])
def test_gradient_matches_central_differences(squared):
    rng = np.random.default_rng(4)
    a, b = points(rng, 13), points(rng, 21)
    expected = central_differences(a, b, (0.7, -1.3), squared)
    a.requires_grad_()
    b.requires_grad_()
    parts = chamfer_parts(a, b, squared=squared)
    found = torch.autograd.grad(0.7 * parts.a_to_b - 1.3 * parts.b_to_a, (a, b))
    for gradient, by_differences in zip(found, expected, strict=True):
        np.testing.assert_allclose(gradient, by_differences, rtol=1e-4, atol=1e-6)


def test_gradient_leaves_missing_points_alone():
    rng = np.random.default_rng(6)
    a, b = points(rng, 20), points(rng, 30)
    a_valid, b_valid = torch.from_numpy(rng.random(20) > 0.4), torch.from_numpy(rng.random(30) > 0.4)
    expected = central_differences(a[a_valid], b[b_valid], (1, 1), False)
    a[~a_valid] = torch.nan
    a.requires_grad_()
    b.requires_grad_()
    found = torch.autograd.grad(chamfer(a, b, None, b_valid), (a, b))
    for gradient, valid, by_differences in zip(found, (a_valid, b_valid), expected, strict=True):
        np.testing.assert_allclose(gradient[valid], by_differences, rtol=1e-4, atol=1e-6)
        assert not gradient[~valid].any()


@pytest.mark.parametrize("squared", [False, True])
def test_gradient_is_finite_and_zero_at_coincident_points(squared):
    a = points(np.random.default_rng(7), 3, 10)
    b = a.clone().requires_grad_()
    a.requires_grad_()
    gradients = torch.autograd.grad(chamfer(a, b, squared=squared).sum(), (a, b))
    assert not any(gradient.any() for gradient in gradients)


def test_captured_plan_follows_its_inputs_on_replay():
    rng = np.random.default_rng(9)
    a = wp.array(rng.normal(size=(3, 2, 20, 3)).astype(np.float32), dtype=wp.vec3)
    b = wp.array(rng.normal(size=(2, 31, 3)).astype(np.float32), dtype=wp.vec3)
    plan = ChamferPlan(a, b, gradient=True)
    ones = wp.full(6, 1.0, dtype=wp.float32)
    with wp.ScopedCapture() as capture:
        plan.launch()
        plan.backward(ones, ones)
    assert capture.graph is not None
    assert plan.a_gradient is not None
    for _ in range(2):
        a.assign(rng.normal(size=(3, 2, 20, 3)).astype(np.float32))
        wp.capture_launch(capture.graph)
        x = wp.to_torch(a).clone().requires_grad_()
        parts = chamfer_parts(x, wp.to_torch(b))
        (gradient,) = torch.autograd.grad(parts.distance.sum(), x)
        np.testing.assert_array_equal(plan.a_to_b.numpy(), parts.a_to_b.detach().flatten())
        np.testing.assert_array_equal(plan.b_to_a.numpy(), parts.b_to_a.detach().flatten())
        np.testing.assert_array_equal(plan.a_gradient.numpy(), gradient.flatten(0, 1))


def test_plan_without_gradient_buffers_says_how_to_get_them():
    a = wp.zeros((2, 5), dtype=wp.vec3)
    plan = ChamferPlan(a, a)
    with pytest.raises(ValueError, match="gradient=True"):
        plan.backward(plan.a_to_b, plan.b_to_a)


def test_empty_batch_gives_empty_result():
    assert chamfer(torch.zeros(0, 4, 3), torch.zeros(5, 3)).shape == (0,)


def test_results_repeat_bit_by_bit():
    rng = np.random.default_rng(10)
    a, b = points(rng, 8, 100).requires_grad_(), points(rng, 8, 90)
    runs = []
    for _ in range(3):
        value = chamfer(a, b)
        runs.append((value.detach(), torch.autograd.grad(value.sum(), a)[0]))
    for value, gradient in runs[1:]:
        assert torch.equal(value, runs[0][0])
        assert torch.equal(gradient, runs[0][1])


@pytest.mark.parametrize(
    ("a", "b", "a_valid", "message"),
    [
        (torch.zeros(4, 3, dtype=torch.float64), torch.zeros(4, 3), None, "float32"),
        (torch.zeros(4, 2), torch.zeros(4, 3), None, r"\(4, 2\)"),
        (torch.zeros(4, 3), torch.zeros(0, 3), None, "at least one point"),
        (torch.zeros(4, 3), torch.zeros(4, 3), torch.ones(5, dtype=torch.bool), r"a_valid of shape \(5,\)"),
        (torch.zeros(4, 3), torch.zeros(4, 3), torch.ones(4), "a_valid must be a torch.bool"),
        (torch.zeros(2, 4, 3), torch.zeros(3, 4, 3), None, r"broadcast.*\(2,\), \(3,\)"),
    ],
)
def test_wrong_input_is_named(a, b, a_valid, message):
    with pytest.raises(ValueError, match=message):
        chamfer(a, b, a_valid)


def test_best_tiling_wastes_little_on_padding():
    for n in (1, 64, 100, 128, 200, 512, 600, 1024):
        tiling = distance_cuda.best_tiling(n)
        padded = -(-n // (32 * tiling.points_per_lane)) * 32 * tiling.points_per_lane
        assert padded < max(2 * n, 65)


def reference_gradients(a, b, b_valid):
    """Gradients of the mean distance, both directions added, of one pair with respect to both sets, in float64: along
    the line to the nearest point, from either side.
    """
    sets = [a.numpy().astype(np.float64), b.numpy().astype(np.float64)]
    present = [np.flatnonzero(np.isfinite(sets[0]).all(-1)), np.flatnonzero(b_valid.numpy())]
    gradients = [np.zeros_like(points_of) for points_of in sets]
    for one, other in ((0, 1), (1, 0)):
        here, there = present[one], present[other]
        distance, nearest = KDTree(sets[other][there]).query(sets[one][here])
        pull = (sets[one][here] - sets[other][there[nearest]]) / (distance[:, None] * len(here))
        np.add.at(gradients[one], here, pull)
        np.add.at(gradients[other], there[nearest], -pull)
    return gradients


@pytest.mark.parametrize(
    "device",
    [
        "cpu",
        pytest.param(
            "cuda",
            marks=[
                pytest.mark.gpu,
                pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
            ],
        ),
    ],
)
@pytest.mark.parametrize(("n", "m"), [(1, 1), (33, 130), (512, 512), (600, 1100), (2000, 1500)])
def test_values_and_gradients_of_many_pairs_match_kd_tree(device, n, m):
    rng = np.random.default_rng(11)
    a, b = points(rng, 3, 2, n), points(rng, 2, m)
    if n > 1:
        a[0, 0, 0] = torch.nan
    b_valid = torch.from_numpy(rng.random((2, m)) > 0.3)
    b_valid[:, 0] = True
    x, y = (points_of.to(device, copy=True).requires_grad_() for points_of in (a, b))
    parts = chamfer_parts(x, y, None, b_valid.to(device))
    found_a, found_b = (g.cpu() for g in torch.autograd.grad(parts.distance.sum(), (x, y)))
    of_b = np.zeros((2, m, 3))
    for k in np.ndindex(3, 2):
        expected = reference_parts(a[k], b[k[1]], None, b_valid[k[1]])
        values = [float(part.detach()[k]) for part in (parts.a_to_b, parts.b_to_a)]
        np.testing.assert_allclose(values, expected, rtol=2e-6)
        by_a, by_b = reference_gradients(a[k], b[k[1]], b_valid[k[1]])
        np.testing.assert_allclose(found_a[k], by_a, rtol=1e-4, atol=1e-6)
        of_b[k[1]] += by_b
    np.testing.assert_allclose(found_b, of_b, rtol=1e-4, atol=1e-6)


def test_cuda_kernels_compile_without_a_gpu(tmp_path):
    kernels = [
        distance_cuda.one_pass_kernel(distance_cuda.best_tiling(512)),
        distance_gradient_cuda.nearest_kernel(),
        distance_gradient.mean_distance,
        distance_gradient_cuda.gradient_kernel(),
    ]
    for k, kernel in enumerate(kernels):
        folder = tmp_path / str(k)
        folder.mkdir()
        (code,) = wp.compile_aot_module(kernel.module, arch=90, module_dir=folder, use_ptx=True)
        assert code.stat().st_size > 0
        if k == 0:
            assert "redux.sync.min.s32" in code.read_text()
