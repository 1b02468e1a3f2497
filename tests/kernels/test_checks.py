"""What the kernels are given: index tables, broadcasting and refusals, by loops and one wrong thing at a time."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

from concent_warp.kernels import virtual_collision
from concent_warp.kernels.chamfer import distance_cpu, distance_gradient
from concent_warp.kernels.chamfer.distance import (
    ChamferParts,
    ChamferPlan,
    _check_tensors,
    _leading_shape,
    _pairs_of_tensors,
    chamfer_parts,
)
from concent_warp.kernels.chamfer.pairs import PointSetPairs, batch_of, broadcast_shape
from concent_warp.kernels.contact_pairs import ContactPairs, PairTable, check_poses
from concent_warp.kernels.splats.splats import SplatArrays, SplatPlan
from concent_warp.kernels.virtual_collision import (
    SphereSet,
    TargetMesh,
    VirtualPair,
    bounding_box,
    build_tables,
    check_pair,
)

CPU: Any = "cpu"


def vectors(*shape: int) -> wp.array:
    return wp.zeros(shape, dtype=wp.vec3, device="cpu")


def numbers(*shape: int, dtype: Any = wp.float32) -> wp.array:
    return wp.zeros(shape, dtype=dtype, device="cpu")


@pytest.mark.parametrize("shapes", [[(3, 1), (4,)], [(2, 1, 5), (1, 3, 1), ()], [(1,), (1, 1)], [(0,), (1,)], [(7,)]])
def test_leading_dimensions_broadcast_as_numpy_does(shapes):
    assert broadcast_shape(shapes) == np.broadcast_shapes(*shapes)


def test_dimensions_that_differ_are_refused():
    for shapes in ([(2,), (3,)], [(2, 3), (3, 2)], [(0,), (2,)]):
        with pytest.raises(ValueError, match="must broadcast against each other"):
            broadcast_shape(shapes)


def test_a_flat_index_of_the_whole_leads_to_one_of_the_part():
    checked = 0
    for whole in ((2, 3), (2, 1, 3), (1,), (4,), (2, 3, 2)):
        for own in product(*[{1, size} for size in whole]):
            for leading in {own, own[1:] if own[0] == 1 else own}:
                batch = batch_of(leading, whole)
                count = int(np.prod(leading))
                rows = np.broadcast_to(np.arange(count).reshape(leading), whole).ravel()
                given = [[(k // d) % m for k in range(rows.size)] for d in range(1, 13) for m in range(1, 13)]
                if batch is None:
                    assert rows.tolist() not in given
                    continue
                divisor, modulus = batch
                assert [(k // divisor) % modulus for k in range(rows.size)] == rows.tolist()
                checked += 1
    assert checked > 20


def test_points_are_shared_and_not_copied_where_an_expansion_repeats_them():
    a = torch.arange(24.0).reshape(1, 8, 3).expand(5, 8, 3)
    b = torch.arange(36.0).reshape(2, 1, 6, 3).expand(2, 5, 6, 3)
    valid = torch.ones(1, 1, 6, dtype=torch.bool).expand(2, 5, 6)
    pairs = _pairs_of_tensors(a, b, None, valid)
    assert (pairs.a.shape, pairs.b.shape) == ((1, 8), (2, 6))
    assert pairs.b_valid is not None
    assert pairs.b_valid.shape == (1, 6)
    assert (pairs.count, pairs.n, pairs.m) == (10, 8, 6)
    # One in the middle is copied, for two numbers cannot say where it lies.
    middle = torch.randn(2, 1, 2, 4, 3).expand(2, 5, 2, 4, 3)
    assert _pairs_of_tensors(middle, torch.randn(2, 5, 2, 6, 3), None, None).a.shape == (20, 4)
    turned = torch.randn(8, 5, 3).transpose(0, 1)
    found = _pairs_of_tensors(turned, torch.randn(6, 3), None, None).a.numpy()
    np.testing.assert_array_equal(found, turned.numpy())


def test_where_all_tensors_repeat_a_set_each_pair_has_its_distance_and_gradient():
    rng = torch.Generator().manual_seed(0)
    a, b = torch.randn(8, 3, generator=rng, requires_grad=True), torch.randn(6, 3, generator=rng, requires_grad=True)
    alone = chamfer_parts(a, b)
    repeated = chamfer_parts(a.expand(2, 5, 8, 3), b.expand(2, 5, 6, 3), torch.ones(8, dtype=torch.bool).expand(5, 8))
    for one, many in zip(alone, repeated, strict=True):
        assert many.shape == (2, 5)
        assert (many == one).all()
    one = torch.autograd.grad(alone.distance, (a, b))
    ten = torch.autograd.grad(repeated.distance.sum(), (a, b))
    for single, summed in zip(one, ten, strict=True):
        torch.testing.assert_close(summed, 10 * single)


def test_leading_shapes_count_masks_too():
    a, b = torch.zeros(3, 1, 4, 3), torch.zeros(2, 6, 3)
    assert _leading_shape(a, b, None, None) == (3, 2)
    assert _leading_shape(a[0], b, torch.ones(3, 1, 4) > 0, None) == (3, 2)
    assert _leading_shape(a[0, 0], b[0], None, torch.ones(7, 5, 6) > 0) == (7, 5)


POINTS, MASK = torch.zeros(2, 4, 3), torch.ones(2, 4, dtype=torch.bool)


@pytest.mark.parametrize(
    ("tensors", "name"),
    [
        ((POINTS.double(), POINTS, None, None), "a must"),
        ((POINTS[0, 0], POINTS, None, None), "a must"),
        ((torch.zeros(4, 4), POINTS, None, None), "a must"),
        ((POINTS, POINTS.int(), None, None), "b must"),
        ((POINTS, torch.zeros(3), None, None), "b must"),
        ((POINTS, torch.zeros(2, 4, 3, device="meta"), None, None), "b must"),
        ((POINTS, POINTS, MASK.float(), None), "a_valid must be a torch.bool"),
        ((POINTS, POINTS, torch.tensor(True), None), "a_valid must"),
        ((POINTS, POINTS, None, MASK.int()), "b_valid must be a torch.bool"),
    ],
)
def test_tensors_of_another_kind_are_refused_by_name(tensors, name):
    with pytest.raises(ValueError, match=f"chamfer: {name}"):
        _check_tensors(*tensors)


def test_tensors_as_they_should_be_pass():
    _check_tensors(POINTS, POINTS[0], MASK, MASK[0])
    _check_tensors(POINTS, POINTS, None, None)


def test_parts_have_a_weight_where_both_sets_have_points():
    count = torch.tensor([0, 1, 0, 3], dtype=torch.int32)
    other = torch.tensor([0, 0, 2, 5], dtype=torch.int32)
    parts = ChamferParts(torch.tensor([1.0, 2, 3, 4]), torch.tensor([10.0, 20, 30, 40]), count, other)
    assert parts.weight.tolist() == [0, 0, 0, 1]
    assert parts.weight.dtype == torch.float32
    assert parts.distance.tolist() == [11, 22, 33, 44]


def test_arrays_of_another_kind_are_refused_by_name():
    a, valid = vectors(2, 4), numbers(2, 4, dtype=wp.bool)
    strided: Any = vectors(2, 8)[:, ::2]
    PointSetPairs.of(a, a, valid, valid)
    for match, call in (
        ("a must be a contiguous", lambda: PointSetPairs.of(numbers(2, 4), a)),
        ("b must be a contiguous", lambda: PointSetPairs.of(a, strided)),
        ("a_valid must be a contiguous", lambda: PointSetPairs.of(a, a, numbers(2, 4))),
        ("b_valid of shape", lambda: PointSetPairs.of(a, vectors(2, 5), None, valid)),
        ("a_valid of shape", lambda: PointSetPairs.of(vectors(2, 5), a, valid)),
        ("at least one point", lambda: PointSetPairs.of(vectors(2, 0), a)),
        ("broadcast in the middle", lambda: PointSetPairs.of(vectors(2, 1, 2, 4), vectors(2, 3, 2, 4))),
    ):
        with pytest.raises(ValueError, match=match):
            call()


def test_sets_are_exchanged_with_all_that_goes_with_them():
    pairs: Any = PointSetPairs.of(vectors(2, 4), vectors(3, 1, 5), numbers(4, dtype=wp.bool))
    assert (pairs.count, pairs.n, pairs.m) == (6, 4, 5)
    swapped: Any = pairs.swapped()
    assert (swapped.n, swapped.m, swapped.count) == (5, 4, 6)
    assert swapped.a_valid is None
    assert swapped.b_valid is pairs.a_valid
    assert (tuple(swapped.a_batch), tuple(swapped.b_batch)) == (tuple(pairs.b_batch), tuple(pairs.a_batch))
    assert tuple(swapped.b_valid_batch) == tuple(pairs.a_valid_batch) == (6, 1)
    assert [b.shape for b in pairs.nearest_buffers()] == [(6, 4), (6, 5)]


def test_kernels_are_those_that_a_batch_launches():
    small, most = vectors(3), distance_cpu.GATHERED_POINTS
    for other, one_pass in ((small, True), (vectors(most + 1), True)):
        pairs = PointSetPairs.of(other, small)
        assert pairs.fits_one_pass is one_pass
        assert pairs.kernels(None, False) == [(distance_cpu.one_pass_kernel(), 1)]
        assert pairs.kernels(None, True) == [
            (distance_cpu.one_pass_kernel(), 1),
            (distance_cpu.nearest_kernel(), 1),
            (distance_gradient.gradient_by_scattering, 1),
        ]
    large = PointSetPairs.of(vectors(most + 1), vectors(most + 1))
    assert not large.fits_one_pass
    assert PointSetPairs.of(vectors(most), vectors(most + 9)).fits_one_pass
    searched = [(distance_gradient.mean_distance, 1), (distance_cpu.nearest_kernel(), 1)]
    assert large.kernels(None, False) == searched
    assert large.kernels(None, True) == [*searched, (distance_gradient.gradient_by_scattering, 1)]
    outputs = [numbers(1) for _ in range(2)] + [numbers(1, dtype=wp.int32) for _ in range(2)]
    with pytest.raises(ValueError, match="need `nearest`"):
        large.distances(False, outputs)


@pytest.mark.parametrize("squared", [False, True])
def test_a_plan_gives_what_tensors_give_and_loads_its_kernels_beforehand(squared, monkeypatch):
    loaded: list[Any] = []
    plain = wp.load_module

    def load(module: Any, *, device: Any, block_dim: int) -> None:
        loaded.append((module, block_dim))
        plain(module, device=device, block_dim=block_dim)

    monkeypatch.setattr(wp, "load_module", load)
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 1, 6, 3)).astype(np.float32), rng.normal(size=(3, 9, 3)).astype(np.float32)
    plan = ChamferPlan(
        wp.array(a, dtype=wp.vec3, device=CPU), wp.array(b, dtype=wp.vec3, device=CPU), squared=squared, gradient=True
    )
    assert [threads for _, threads in loaded] == [1, 1, 1]
    assert plan.a_gradient is not None
    assert plan.b_gradient is not None
    assert (plan.a_gradient.shape, plan.b_gradient.shape) == ((6, 6), (6, 9))
    plan.launch()
    x, y = torch.tensor(a, requires_grad=True), torch.tensor(b, requires_grad=True)
    parts = chamfer_parts(x, y, squared=squared)
    for name in ("a_to_b", "b_to_a", "a_count", "b_count"):
        np.testing.assert_allclose(getattr(plan, name).numpy(), getattr(parts, name).detach().flatten(), rtol=1e-6)
    one, two = rng.normal(size=6).astype(np.float32), rng.normal(size=6).astype(np.float32)
    plan.backward(wp.array(one, device=CPU), wp.array(two, device=CPU))
    given = torch.tensor(one).view(2, 3), torch.tensor(two).view(2, 3)
    found = torch.autograd.grad([parts.a_to_b, parts.b_to_a], (x, y), given)
    summed = plan.a_gradient.numpy().reshape(2, 3, 6, 3).sum(axis=1, keepdims=True)
    np.testing.assert_allclose(summed, found[0], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(plan.b_gradient.numpy().reshape(2, 3, 9, 3).sum(axis=0), found[1], rtol=1e-4, atol=1e-6)
    (alone,) = torch.autograd.grad(chamfer_parts(x, y.detach(), squared=squared).distance.sum(), (x,))
    (both, _) = torch.autograd.grad(chamfer_parts(x, y, squared=squared).distance.sum(), (x, y))
    np.testing.assert_array_equal(alone, both)


def table(**options: Any) -> PairTable:
    given: dict[str, Any] = {
        "body_a": np.array([[0, 1]]), "point_a": np.zeros((1, 2, 3)), "radius_a": np.zeros((1, 2)),
        "body_b": np.array([[1, 2]]), "point_b": np.zeros((1, 2, 3)), "radius_b": np.zeros((1, 2)),
        "normal": np.array([[[0, 0, 1.0], [0, 0, 0]]]), "active": np.array([[True, True]]),
    }  # fmt: skip
    return PairTable(**(given | options))


def test_a_table_is_refused_by_the_name_of_what_is_wrong():
    for name in ("body_a", "radius_a", "body_b", "radius_b"):
        with pytest.raises(ValueError, match=rf"{name} must be of shape \(1, 2\)"):
            table(**{name: np.zeros((1, 2, 3))})
    for name in ("point_a", "point_b", "normal"):
        with pytest.raises(ValueError, match=rf"{name} must be of shape \(1, 2, 3\)"):
            table(**{name: np.zeros((1, 2))})
        with pytest.raises(ValueError, match=f"{name} has values that are not finite"):
            table(**{name: np.full((1, 2, 3), np.inf)})
    for active in (np.ones(2), np.ones((0, 2)), np.ones((2, 0)), np.ones((1, 1, 2))):
        with pytest.raises(ValueError, match="active must be of shape"):
            table(active=active)
    unused = np.array([[[0.0, 0.0, 1.0], [np.nan] * 3]])
    assert table(normal=unused, active=np.array([[1, 0]])).used.tolist() == [[True, False]]


@pytest.mark.parametrize(
    ("length", "fine"), [(1.0009, True), (0.9991, True), (1.0011, False), (0.5, False), (0.0, True)]
)
def test_a_normal_is_of_length_one_or_zero(length, fine):
    normal = np.array([[[0.0, 0.6, 0.8], [0.0, 0.6 * length, 0.8 * length]]])
    if fine:
        table(normal=normal)
        return
    with pytest.raises(ValueError, match="normal must be of length 1"):
        table(normal=normal)


def poses(worlds: int = 2, bodies: int = 3) -> tuple[wp.array, wp.array, wp.array]:
    return vectors(worlds, bodies), numbers(worlds, bodies, dtype=wp.quat), numbers(worlds, dtype=wp.int32)


def test_poses_are_refused_by_the_name_of_what_is_wrong():
    xpos, xquat, stage = poses()
    check_poses("Name", xpos, xquat, stage)
    for match, given in (
        ("Name: xpos must be of shape", (vectors(6), xquat, stage)),
        ("Name: xpos must be vec3", (numbers(2, 3), xquat, stage)),
        ("Name: xquat must be quat", (xpos, numbers(2, 4, dtype=wp.quat), stage)),
        ("Name: xquat must be quat", (xpos, numbers(2, 3, dtype=wp.vec4), stage)),
        ("Name: stage must be int32", (xpos, xquat, numbers(3, dtype=wp.int32))),
        ("Name: stage must be int32", (xpos, xquat, numbers(2, 1, dtype=wp.int32))),
        ("Name: stage must be int32", (xpos, xquat, numbers(2))),
    ):
        with pytest.raises(ValueError, match=match):
            check_poses("Name", *given)


def test_pairs_name_bodies_that_there_are():
    ContactPairs(table(), *poses())
    for name, bodies in (("body_a", [[0, 3]]), ("body_b", [[3, 1]]), ("body_a", [[-1, 0]]), ("body_b", [[0, -1]])):
        with pytest.raises(ValueError, match=rf"{name} must be in 0..2, found"):
            ContactPairs(table(**{name: np.array(bodies)}), *poses())
    idle = table(body_a=np.array([[9, 9]]), active=np.zeros((1, 2)))
    assert ContactPairs(idle, *poses()).features.shape == (2, 26)
    for sigma in ((0.0, 1.0), (1.0, 0.0), (1.0, -1.0)):
        with pytest.raises(ValueError, match="sigma must be above 0 m"):
            ContactPairs(table(), *poses(), sigma=sigma)
    for features in (numbers(2, 25), numbers(3, 26), numbers(2, 26, dtype=wp.int32)):
        with pytest.raises(ValueError, match="features must be float32"):
            ContactPairs(table(), *poses(), features=features)
    mine = numbers(2, 26)
    found = ContactPairs(table(), *poses(), features=mine)
    assert found.features is mine
    assert [found.distance.shape, found.worst.shape, found.reach.shape] == [(2, 2), (2,), (2, 2)]


def test_sphere_sets_are_refused_where_shapes_or_numbers_are_wrong():
    SphereSet(0, np.zeros((2, 3)), np.zeros(2))
    for centre, radius in (
        (np.zeros((2, 2)), np.zeros(2)),
        (np.zeros((3, 3)), np.zeros(2)),
        (np.zeros((2, 3)), np.zeros((2, 1))),
        (np.zeros((0, 3)), np.zeros(0)),
    ):
        with pytest.raises(ValueError, match=r"must be of shapes \(n, 3\) and \(n,\)"):
            SphereSet(0, centre, radius)
    for centre, radius in (
        (np.full((1, 3), np.nan), np.ones(1)),
        (np.zeros((1, 3)), np.full(1, np.inf)),
        (np.zeros((2, 3)), np.array([1.0, -1e-9])),
    ):
        with pytest.raises(ValueError, match="must be finite, and radii not negative"):
            SphereSet(0, centre, radius)


CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) + np.array([3.0, -2.0, 5.0])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def test_meshes_are_refused_where_shapes_numbers_or_sides_are_wrong():
    TargetMesh(0, CORNERS, FACES)
    for vertices, faces in (
        (CORNERS[:, :2], FACES), (CORNERS.ravel(), FACES), (CORNERS[None], FACES), (CORNERS, FACES[:, :2]),
        (CORNERS, FACES.ravel()), (CORNERS, FACES[None]), (CORNERS, FACES[:0]),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"must be of shapes \(v, 3\) and \(f, 3\)"):
            TargetMesh(0, vertices, faces)
    holed = CORNERS.copy()
    holed[1, 1] = np.inf
    for vertices, faces in ((holed, FACES), (CORNERS, FACES - 1), (CORNERS, FACES + 1), (CORNERS[:3], FACES)):
        with pytest.raises(ValueError, match="must be finite, and faces must index them"):
            TargetMesh(0, vertices, faces)
    with pytest.raises(ValueError, match="point inwards"):
        TargetMesh(0, CORNERS, FACES[:, ::-1])
    TargetMesh(0, CORNERS - 100.0, FACES)
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    TargetMesh(0, flat, np.array([[0, 1, 2]]))


def test_pairs_of_spheres_and_targets_are_refused_where_they_cannot_be():
    fine = VirtualPair(1, 2, gate=(0.0, 1.0, 1.0))
    check_pair(fine, 2, 3, 3)
    check_pair(VirtualPair(0, 0, margin=0.0, severe=0.0), 1, 1, 9)
    for wrong in ({"spheres": 2}, {"spheres": -1}, {"target": 3}, {"target": -1}):
        with pytest.raises(ValueError, match="there are 2 sets and 3 targets"):
            check_pair(replace(fine, **wrong), 2, 3, 3)
    for wrong in ({"margin": -1e-9}, {"severe": -1e-9}, {"margin": np.nan}):
        with pytest.raises(ValueError, match="must be 0 m or more"):
            check_pair(replace(fine, **wrong), 2, 3, 3)
    with pytest.raises(ValueError, match="must have 4 stages, found 3"):
        check_pair(fine, 2, 3, 4)


def test_tables_list_sets_targets_and_pairs_in_order():
    rng = np.random.default_rng(0)
    spheres = [SphereSet(4, rng.normal(size=(n, 3)), rng.uniform(0, 1, n)) for n in (2, 5)]
    mesh = TargetMesh(1, np.concatenate([CORNERS, [[99.0, 99, 99]]]), FACES)
    targets = [mesh, SphereSet(2, rng.normal(size=(3, 3)), rng.uniform(0, 1, 3)), replace(spheres[0], body=3)]
    pairs = [VirtualPair(1, 0, 0.1, 0.2, (0.0, 0.5)), VirtualPair(0, 2, 0.3, 0.4), VirtualPair(1, 1)]
    built = wp.Mesh(wp.array(CORNERS, dtype=wp.vec3, device=CPU), wp.array(FACES.ravel(), dtype=wp.int32, device=CPU))
    found = build_tables(spheres, targets, pairs, [built, None, None], 2, CPU)

    def same(name: str, expected: Any) -> None:
        np.testing.assert_allclose(
            getattr(found, name).numpy(), np.array(expected, dtype=float), rtol=1e-6, err_msg=name
        )

    same("pair_set", [1, 0, 1])
    same("pair_target", [0, 2, 1])
    same("pair_row", [0, 5, 7])
    same("margin", [0.1, 0.3, 0.002])
    same("severe", [0.2, 0.4, 0.01])
    same("gate", [[0.0, 1.0, 1.0], [0.5, 1.0, 1.0]])
    same("set_body", [4, 4])
    same("set_first", [0, 2, 7])
    same("centre", np.concatenate([s.centre for s in spheres]))
    same("radius", np.concatenate([s.radius for s in spheres]))
    for k, one in enumerate(spheres):
        middle = 0.5 * (one.centre.min(axis=0) + one.centre.max(axis=0))
        np.testing.assert_allclose(found.set_centre.numpy()[k], middle, rtol=1e-6)
        reach = max(np.linalg.norm(c - middle) + r for c, r in zip(one.centre, one.radius, strict=True))
        assert found.set_radius.numpy()[k] == pytest.approx(reach, rel=1e-6)
    same("target_body", [1, 2, 3])
    assert found.mesh.numpy().tolist() == [int(built.id), 0, 0]
    same("target_first", [0, 0, 3, 5])
    same("target_sphere", np.concatenate([np.column_stack([t.centre, t.radius]) for t in targets[1:]]))
    boxes = [bounding_box(target) for target in targets]
    same("lower", [low for low, _ in boxes])
    same("upper", [high for _, high in boxes])
    same("inside", [0.501 * (high - low).min() for low, high in boxes])
    np.testing.assert_array_equal(boxes[0], [[3.0, -2.0, 5.0], [4.0, -1.0, 6.0]])
    one = targets[1]
    np.testing.assert_allclose(boxes[1][0], (one.centre - one.radius[:, None]).min(axis=0))
    np.testing.assert_allclose(boxes[1][1], (one.centre + one.radius[:, None]).max(axis=0))
    empty = build_tables([], [], [], [], 2, CPU)
    assert (empty.gate.shape, empty.centre.shape, empty.pair_row.shape) == ((2, 0), (0,), (0,))


def test_a_body_that_there_is_not_is_refused_and_rows_of_gaps_are_counted():
    one = [SphereSet(2, np.zeros((3, 3)), np.ones(3)), SphereSet(0, np.zeros((1, 3)), np.ones(1))]
    pairs = [VirtualPair(0, 1), VirtualPair(1, 0), VirtualPair(0, 0)]
    found = virtual_collision.VirtualCollision(one, one, pairs, *poses(), stages=1, gaps=True)
    assert found.gap is not None
    assert found.gap.shape == (2, 7)
    assert virtual_collision.VirtualCollision(one, one, pairs, *poses(), stages=1).gap is None
    for body in (3, -1):
        wrong = [replace(one[0], body=body)]
        for spheres, targets in ((wrong, one), (one, wrong)):
            with pytest.raises(ValueError, match=rf"a body must be in 0..2, found {body}"):
                virtual_collision.VirtualCollision(spheres, targets, [], *poses(), stages=1)


def arrays(**options: Any) -> SplatArrays:
    given: dict[str, Any] = {
        "means": vectors(5), "quats": numbers(5, dtype=wp.vec4), "scales": vectors(5), "opacities": numbers(5),
        "harmonics": vectors(5, 4), "owner": numbers(5, dtype=wp.int32), "object_poses": numbers(2, 3, 7),
        "camera_poses": numbers(2, 4, 7), "pinholes": numbers(2, 4, 4), "hidden": numbers(0, 0, 0),
    }  # fmt: skip
    return SplatArrays(**(given | options))


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("means", numbers(5)), ("quats", numbers(4, dtype=wp.vec4)), ("quats", vectors(5)), ("scales", vectors(6)),
        ("opacities", vectors(5)), ("opacities", numbers(5, 1)), ("harmonics", vectors(5)),
        ("harmonics", vectors(4, 4)),
        ("owner", numbers(5)), ("object_poses", numbers(3, 3, 7)), ("object_poses", numbers(2, 3, 6)),
        ("camera_poses", numbers(2, 4, 6)), ("pinholes", numbers(2, 3, 4)), ("pinholes", numbers(2, 4, 3)),
        ("hidden", numbers(4, 4)), ("hidden", numbers(8, 6, 5, dtype=wp.int32)),
    ],
)  # fmt: skip
def test_splats_are_refused_by_the_name_of_what_is_wrong(name, wrong):
    with pytest.raises(ValueError, match=f"SplatArrays: {name} must be of shape"):
        arrays(**{name: wrong})


def test_splats_have_a_whole_number_of_bands_and_a_light_for_each_image():
    for count in (1, 4, 9, 16):
        arrays(harmonics=vectors(5, count))
    for count in (0, 2, 3, 5, 8, 15, 17):
        with pytest.raises(ValueError, match="harmonics must have 1, 4, 9 or 16 coefficients"):
            arrays(harmonics=vectors(5, count))
    arrays(light=vectors(2, 4))
    for light in (vectors(2, 3), vectors(8), numbers(2, 4)):
        with pytest.raises(ValueError, match="light must be of shape"):
            arrays(light=light)


def test_a_plan_of_splats_has_room_for_its_images():
    plan = SplatPlan(arrays(), 17, 9, capacity=50, tile=8, gradient=True)
    assert (plan.images, plan.capacity) == (8, 50)
    assert plan.rgb.shape == plan.alpha.shape == plan.depth.shape == (8, 9, 17)
    assert plan.pairs.shape == plan.overflow.shape == (8,)
    assert (plan._frame.columns, plan._frame.rows, plan._frame.tile) == (3, 2, 8)
    assert (plan._tiles, plan._bits) == (48, 24 + 6)
    assert plan._lists.first.shape == (49,)
    assert plan._key.shape == plan._order.shape == (100,)
    assert plan._bounds.shape == plan._count.shape == plan._lists.place.shape == (40,)
    assert set(plan.gradients) == {"means", "quats", "scales", "opacities", "harmonics", "pixels"}
    assert plan.gradients["pixels"].shape == (40,)
    assert SplatPlan(arrays(), 16, 8, capacity=1)._frame.tile == 8
    assert SplatPlan(arrays(), 16, 8, capacity=1)._frame.columns == 2
    one = arrays(object_poses=numbers(1, 3, 7), camera_poses=numbers(1, 1, 7), pinholes=numbers(1, 1, 4))
    assert SplatPlan(one, 56, 8, capacity=1, tile=8)._bits == 24 + 4  # 7 tiles, and one after the last
    SplatPlan(arrays(hidden=numbers(8, 9, 17)), 17, 9, capacity=50)
    with pytest.raises(ValueError, match=r"hidden must be of shape \(8, 9, 17\)"):
        SplatPlan(arrays(hidden=numbers(8, 17, 9)), 17, 9, capacity=50)
    for wrong in ((0, 9, 50), (17, 0, 50), (17, 9, 0)):
        with pytest.raises(ValueError, match="must be at least 1"):
            SplatPlan(arrays(), wrong[0], wrong[1], capacity=wrong[2])
    with pytest.raises(ValueError, match="gradient=True"):
        SplatPlan(arrays(), 17, 9, capacity=50).backward(plan.rgb, plan.alpha, plan.depth)
