"""Faces, their roughness and the growth of bodies against loops over places, on surfaces that are written down."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.fit.geometry import faces as of_faces
from concent_warp.fit.geometry import offset as of_offset
from concent_warp.fit.geometry.faces import FaceCfg, Faces, _face_memberships, _neighbourhoods, flattened
from concent_warp.fit.geometry.mask import touched_spheres, with_neighbours
from concent_warp.fit.geometry.offset import offset_directions
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.contact_geometry import ContactGeometry
from tests.fit.conftest import DROP

SCENE = Scene(DROP)
CFG = FaceCfg()
RIDGE, SETTLED = 1e-3, 1e-9


def spheres(position: Any, body: Any = None, bodies: tuple[str, ...] = ("block",)) -> ContactGeometry:
    position = np.array(position, dtype=float)
    n = len(position)
    body = np.zeros(n, int) if body is None else np.array(body)
    return ContactGeometry(bodies, body, position, np.full(n, 0.004), np.full(n, 0.1), np.full(n, 0.5))


def surface_of(monkeypatch: Any, module: Any, points: Any, normals: Any) -> list[Any]:
    """Make a body's surface these points; returns what was asked for."""
    asked: list[Any] = []

    def sample(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        asked.append((count, rng.random()))
        return np.array(points, dtype=float), np.array(normals, dtype=float)

    monkeypatch.setattr(module.Surface, "of_body", lambda *_: SimpleNamespace(sample=sample))
    return asked


X, Y, Z = np.eye(3)


def test_a_sphere_has_a_place_in_each_face_that_it_is_near(monkeypatch):
    centre = np.array([0.01, 0.02, 0.03])
    points = [
        centre + 4.0e-3 * X,  # the nearest face
        centre + 4.1e-3 * X + 1e-4 * Y,  # the same face
        centre + 5.0e-3 * Y,  # another face, straight below
        centre + 5.5e-3 * Z + 1.5e-3 * Y,  # a third, but beside its end
        centre + 6.1e-3 * -X,  # too far
    ]
    tilted = np.array([np.cos(0.4), np.sin(0.4), 0.0])  # 23 degrees
    asked = surface_of(monkeypatch, of_faces, points, [X, tilted, Y, Z, -X])
    found = _face_memberships(spheres([[9.0, 9.0, 9.0], centre]), SCENE, "block", CFG)[-2:]
    assert [(row, first) for row, _, _, first in found] == [(1, True), (1, False)]
    np.testing.assert_array_equal([normal for _, normal, _, _ in found], [X, Y])
    np.testing.assert_array_equal([foot for _, _, foot, _ in found], [points[0], points[2]])
    assert asked == [(40_000, np.random.default_rng(0).random())]


@pytest.mark.parametrize(("degrees", "other"), [(24.0, False), (26.0, True)])
def test_a_face_ends_where_its_normal_turns_by_25_degrees(monkeypatch, degrees, other):
    angle = np.radians(degrees)
    turned = np.array([np.cos(angle), np.sin(angle), 0.0])
    surface_of(monkeypatch, of_faces, [4e-3 * X, 4.5e-3 * turned], [X, turned])
    assert len(_face_memberships(spheres([[0.0, 0.0, 0.0]]), SCENE, "block", CFG)) == 1 + other


@pytest.mark.parametrize(("beside", "counted"), [(0.9e-3, True), (1.1e-3, False)])
def test_a_second_face_counts_where_its_foot_is_hardly_beside_it_and_the_nearest_always(monkeypatch, beside, counted):
    surface_of(monkeypatch, of_faces, [4e-3 * X + 3e-3 * Y, 5.5e-3 * -Z + beside * Y], [X, -Z])
    found = _face_memberships(spheres([[0.0, 0.0, 0.0]]), SCENE, "block", CFG)
    assert [first for *_, first in found] == [True, False][: 1 + counted]


def random_face_memberships(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return feet, normals and bodies of places on two faces of two bodies."""
    rng = np.random.default_rng(seed)
    foot = rng.normal(0, 0.02, (30, 3))
    normal = np.where(rng.random((30, 1)) < 0.6, Z, X) + rng.normal(0, 0.1, (30, 3))
    foot[:, 2] *= 0.2
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return foot, normal, rng.integers(2, size=30)


def test_neighbours_are_face_memberships_of_the_same_face_weighed_by_their_distance():
    foot, normal, body = random_face_memberships()
    basis, weight = _neighbourhoods(foot, normal, body, 0.03, CFG)
    for i, j in np.ndindex(30, 30):
        offset = foot[j] - foot[i]
        distance = np.linalg.norm(offset)
        same = body[i] == body[j] and normal[i] @ normal[j] > np.cos(np.radians(25.0))
        same = same and abs(offset @ normal[i]) <= 0.35 * distance + SETTLED
        expected = np.exp(-((distance / 0.03) ** 2) / 2) if same else 0.0
        assert weight[i, j] == pytest.approx(expected if expected >= 1e-3 else 0.0)
        assert basis[i, j, 0] == 1.0
        # The tangential part of the offset, in any two axes across the normal.
        tangential = offset - (offset @ normal[i]) * normal[i]
        assert np.linalg.norm(basis[i, j, 1:]) == pytest.approx(np.linalg.norm(tangential) / 0.03, abs=1e-12)
    for i in range(30):
        away = (foot - foot[i]) / 0.03
        coordinates = np.column_stack([basis[i, :, 1:], away @ normal[i]])
        axes = np.linalg.lstsq(coordinates, away, rcond=None)[0]
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-9)
        np.testing.assert_allclose(axes[2], normal[i], atol=1e-9)
    assert (np.diag(weight) == 1.0).all()


def test_far_neighbours_do_not_count():
    foot = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.112, 0.0, 0.0]])
    _, weight = _neighbourhoods(foot, np.tile(Z, (3, 1)), np.zeros(3, int), 0.03, CFG)
    assert weight[0, 1] > 1e-3
    assert weight[0, 2] == 0.0


def made_faces(seed: int = 1) -> Faces:
    """Return faces of 30 places of 20 spheres."""
    foot, normal, body = random_face_memberships(seed)
    rng = np.random.default_rng(seed)
    faces: Any = object.__new__(Faces)
    faces.cfg, faces.count = CFG, 20
    faces.sphere = np.concatenate([np.arange(20), rng.permutation(20)[:10]])
    faces.first = np.arange(30) < 20
    faces.normal = normal
    faces.height = rng.normal(0, 1e-4, 30)
    faces.height[[3, 11]] += 5e-3
    faces.height[[7, 25]] -= 5e-3
    faces.height[28] += 5e-3
    faces.basis, faces.weight = _neighbourhoods(foot, normal, body, 0.03, CFG)
    return faces


def expected_roughness(faces: Faces, displacement: np.ndarray) -> np.ndarray:
    """Return the roughness by a loop over places."""
    height = faces.height + np.sum(displacement[faces.sphere] * faces.normal, axis=1)
    found = []
    for i in range(len(height)):
        weight, rough, limit = faces.weight[i], 0.0, 0.0
        for _ in range(3):
            root = np.sqrt(weight)[:, None]
            ridge = np.sqrt(RIDGE) * np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
            rows = np.vstack([root * faces.basis[i], ridge])
            course = np.linalg.lstsq(rows, np.concatenate([root[:, 0] * height, [0.0, 0.0]]), rcond=None)[0]
            deviation = np.abs(height - faces.basis[i] @ course)
            limit = 4.5 * np.median(deviation[faces.weight[i] > 0]) + SETTLED
            weight = np.where(deviation <= limit, faces.weight[i], 0.0)
            rough = height[i] - course[0]
        belongs = abs(rough) <= limit or (faces.first[i] and rough > 0)
        found.append(rough if belongs and abs(rough) > SETTLED else 0.0)
    return np.array(found)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_roughness_is_the_distance_from_a_plane_through_the_neighbours_without_outliers(seed):
    faces = made_faces(seed)
    rng = np.random.default_rng(seed)
    displacement = rng.normal(0, 1e-4, (20, 3))
    found = faces.roughness(displacement)
    np.testing.assert_allclose(found, expected_roughness(faces, displacement), rtol=1e-6, atol=1e-12)
    assert (found == 0).any()
    assert (np.abs(found) > 1e-3).any()


def test_what_is_smooth_but_for_rounding_has_no_roughness():
    faces = made_faces()
    faces.height[:] = 1e-3
    assert (faces.roughness(np.zeros((20, 3))) == 0.0).all()
    faces.height[4] += 1e-7
    assert faces.roughness(np.zeros((20, 3)))[4] != 0.0


def test_flattening_moves_each_sphere_onto_its_faces():
    faces = made_faces()
    displacement = np.random.default_rng(4).normal(0, 1e-4, (20, 3))
    rough = faces.roughness(displacement)
    found = faces.flattening(displacement)
    for s in range(20):
        mine = faces.sphere == s
        rows = np.vstack([faces.normal[mine], np.sqrt(RIDGE) * np.eye(3)])
        expected = np.linalg.lstsq(rows, np.concatenate([-rough[mine], np.zeros(3)]), rcond=None)[0]
        np.testing.assert_allclose(found[s], expected, rtol=1e-6, atol=1e-12)


def test_a_whole_geometry_is_flattened_in_three_rounds():
    geometry = spheres(np.random.default_rng(5).normal(0, 0.02, (20, 3)))
    faces = made_faces()
    moved = np.zeros((20, 3))
    for _ in range(3):
        moved = moved + faces.flattening(moved)
    np.testing.assert_array_equal(flattened(geometry, faces).position, geometry.position + moved)


def test_heights_are_measured_from_the_nominal_faces(monkeypatch):
    geometry = spheres([[0.0, 0.0, 0.010], [0.005, 0.0, 0.012]])
    points = np.array([[x, y, 0.015] for x in np.linspace(-0.01, 0.01, 21) for y in (-0.005, 0.0, 0.005)])
    surface_of(monkeypatch, of_faces, points, np.tile(Z, (len(points), 1)))
    faces = Faces(geometry, SCENE, 0.03)
    assert faces.count == 2
    np.testing.assert_array_equal(faces.sphere, [0, 1])
    np.testing.assert_allclose(faces.height, [-0.005 + 0.004, -0.003 + 0.004])
    assert faces.first.all()
    np.testing.assert_array_equal(faces.normal, [Z, Z])


def test_growth_is_the_shortest_displacement_that_moves_all_near_faces(monkeypatch):
    points = [0.010 * X, 0.0105 * Y, 0.0108 * Y, 0.0115 * Z]
    asked = surface_of(monkeypatch, of_offset, points, [X, Y, Y, Z])
    found = offset_directions(spheres([[0.0, 0.0, 0.0], [0.0, 0.0, 0.011]]), SCENE)
    # The first sphere is near X once and Y twice; the second near Z alone.
    ridge = RIDGE
    np.testing.assert_allclose(found[0], [(1 / 3) / (1 / 3 + ridge), (2 / 3) / (2 / 3 + ridge), 0.0], atol=1e-12)
    np.testing.assert_allclose(found[1], [0.0, 0.0, 1 / (1 + ridge)], atol=1e-12)
    assert asked == [(40_000, np.random.default_rng(0).random())]


def test_neighbours_are_those_of_the_same_body():
    rng = np.random.default_rng(6)
    body = rng.integers(2, size=24)
    geometry = spheres(rng.normal(size=(24, 3)), body, ("block", "other"))
    one = np.zeros(24, dtype=bool)
    one[np.flatnonzero(body == 1)[:2]] = True
    for k in (0, 1, 3, 100):
        expected = one.copy()
        for i in np.flatnonzero(one):
            mine = np.flatnonzero(body == body[i])
            near = mine[np.argsort(np.linalg.norm(geometry.position[mine] - geometry.position[i], axis=1))]
            expected[near[: k + 1]] = True
        found = with_neighbours(geometry, one, k)
        np.testing.assert_array_equal(found, expected)
        assert found is not one
    assert one.sum() == 2


@pytest.mark.parametrize("row", [0, 1])
def test_a_sphere_at_the_place_of_another_is_no_neighbour_where_none_is_asked_for(row):
    geometry, one = spheres(np.zeros((2, 3))), np.arange(2) == row
    np.testing.assert_array_equal(with_neighbours(geometry, one, 0), one)
    assert with_neighbours(geometry, one, 1).all()


def test_spheres_that_are_not_collidable_touch_nothing():
    touched = np.zeros((5, 3), dtype=bool)
    touched[0] = True  # of a geom that is no sphere
    touched[3, 1] = touched[4, 2] = True
    other, gripped = touched_spheres(touched, np.array([-1, 3, 4, 2]), np.array([False, False, True]))
    assert other.tolist() == [False, True, False, False]
    assert gripped.tolist() == [False, False, True, False]
