from itertools import pairwise

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from concent_warp.errors import SceneError
from concent_warp.scene.scene import Scene
from concent_warp.scene.shapes.cloud import PointCloud, without_outliers
from concent_warp.scene.shapes.mesh import MeshSolid
from concent_warp.scene.shapes.solid import Box, Capsule, Cylinder, Ellipsoid
from concent_warp.scene.shapes.surface import Surface

SOLIDS = {
    "box": Box(np.array([0.02, 0.03, 0.04])),
    "sphere": Capsule(0.03),
    "capsule": Capsule(0.02, 0.03),
    "cylinder": Cylinder(0.03, 0.02),
    "ellipsoid": Ellipsoid(np.array([0.02, 0.03, 0.045])),
}
BOX_AREA = 4 * 70 * 40 + 4 * 42 * 35 + 2 * 70**2 - 42**2 + 42**2


def body(geoms: str) -> Surface:
    xml = f'<mujoco><worldbody><body name="b"><freejoint/>{geoms}</body></worldbody></mujoco>'
    return Surface.of_body(Scene(xml), "b")


def hollow_box() -> Surface:
    return body(
        '<geom type="box" size=".007 .035 .02" pos=".028 0 .02"/>'
        '<geom type="box" size=".007 .035 .02" pos="-.028 0 .02"/>'
        '<geom type="box" size=".035 .007 .02" pos="0 .028 .02"/>'
        '<geom type="box" size=".035 .007 .02" pos="0 -.028 .02"/>'
        '<geom type="box" size=".035 .035 .0025" pos="0 0 .0025"/>'
    )


@pytest.mark.parametrize("name", SOLIDS)
def test_samples_lie_on_the_surface_with_outward_normals(name):
    solid = SOLIDS[name]
    points, normals = solid.sample(2000, np.random.default_rng(0))
    np.testing.assert_allclose(solid.distance(points)[0], 0, atol=1e-9)
    np.testing.assert_allclose(solid.distance(points + 1e-3 * normals)[0], 1e-3, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)


@pytest.mark.parametrize("name", SOLIDS)
def test_signed_distance_is_the_distance_to_the_nearest_of_many_samples(name):
    solid, rng = SOLIDS[name], np.random.default_rng(1)
    samples = solid.sample(100_000, rng)[0]
    points = rng.uniform(-0.06, 0.06, (200, 3))
    distance, gradient = solid.distance(points)
    nearest = KDTree(samples).query(points)[0]
    assert (np.abs(distance) <= nearest + 1e-9).all()
    np.testing.assert_allclose(np.abs(distance), nearest, atol=4e-4)
    # Walking the distance back along the gradient ends on the surface.
    np.testing.assert_allclose(solid.distance(points - distance[:, None] * gradient)[0], 0, atol=1e-8)
    assert (distance < 0).any()
    assert (distance > 0).any()


@pytest.mark.parametrize("name", SOLIDS)
def test_samples_are_uniform_over_the_surface(name):
    solid = SOLIDS[name]
    counts, areas = [], []
    points = solid.sample(60_000, np.random.default_rng(2))[0]
    edges = np.quantile(points[:, 2], np.linspace(0, 1, 7))
    edges = np.unique(np.round(edges, 9))
    for low, high in pairwise(edges):
        inside = (points[:, 2] > low + 1e-9) & (points[:, 2] < high - 1e-9)
        counts.append(inside.mean())
        areas.append(band_area(name, low, high) / solid.area)
    np.testing.assert_allclose(counts, areas, atol=0.01)


def band_area(name: str, low: float, high: float) -> float:
    """Area of the side between two heights, by rotating or scaling a fine profile."""
    heights = np.linspace(low, high, 2001)
    middle = (heights[1:] + heights[:-1]) / 2
    if name == "box":
        return (high - low) * 4 * (0.02 + 0.03)
    if name == "ellipsoid":
        angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
        ring = np.sqrt(1 - (heights / 0.045) ** 2)
        curve = np.stack(
            [0.02 * ring[:, None] * np.cos(angle), 0.03 * ring[:, None] * np.sin(angle), heights[:, None] + 0 * angle],
            -1,
        )
        along = np.roll(curve, -1, axis=1)[:-1] - curve[:-1]
        return float(np.linalg.norm(np.cross(along, curve[1:] - curve[:-1]), axis=2).sum())
    radius = {
        "sphere": lambda z: np.sqrt(np.maximum(0.03**2 - z**2, 0)),
        "capsule": lambda z: np.sqrt(np.maximum(0.02**2 - np.maximum(np.abs(z) - 0.03, 0) ** 2, 0)),
        "cylinder": lambda z: np.full_like(z, 0.03),
    }[name]
    slope = np.hypot(np.diff(heights), np.diff(radius(heights)))
    return float(np.sum(2 * np.pi * radius(middle) * slope))


def test_union_has_the_outer_area_and_no_inner_points():
    surface = hollow_box()
    assert surface.area == pytest.approx(BOX_AREA * 1e-6, rel=0.02)
    points, normals = surface.sample(5000, np.random.default_rng(0))
    np.testing.assert_allclose(surface.signed_distance(points), 0, atol=1e-9)
    assert (surface.signed_distance(points + 1e-4 * normals) > 0).all()
    top = np.isclose(points[:, 2], 0.04)
    corners = top & (np.abs(points[:, :2]) > 0.021).all(axis=1)
    # The four 14 mm corner squares belong to two walls each and must not be drawn twice.
    assert corners.sum() / top.sum() == pytest.approx(4 * 14**2 / (70**2 - 42**2), abs=0.04)


def test_faces_where_two_boxes_just_touch_are_no_surface():
    surface = body(
        '<geom type="box" size=".01 .01 .01" pos="-.01 0 0"/><geom type="box" size=".01 .01 .01" pos=".01 0 0"/>'
    )
    points = surface.sample(4000, np.random.default_rng(0))[0]
    assert not (np.abs(points[:, 0]) < 1e-9).any()
    assert surface.area == pytest.approx(10 * 0.02**2, rel=0.02)


def test_union_never_claims_more_depth_than_there_is():
    surface, rng = hollow_box(), np.random.default_rng(3)
    points = rng.uniform([-0.035, -0.035, 0], [0.035, 0.035, 0.04], (1000, 3))
    depth = -surface.signed_distance(points)
    points, depth = points[depth > 0], depth[depth > 0]
    samples = surface.sample(30_000, rng)[0]
    nearest = KDTree(samples).query(points)[0]
    assert (depth <= nearest + 1e-9).all()
    # Away from seams it is exact: here within a wall, half way up.
    np.testing.assert_allclose(surface.signed_distance(np.array([[0.024, 0.01, 0.02]])), [-0.003], atol=1e-12)


def test_geoms_are_placed_in_the_body_frame():
    surface = body('<geom type="cylinder" size=".01 .03" pos=".1 .2 .3" euler="90 0 0"/>')
    inside, beside = surface.signed_distance(np.array([[0.1, 0.225, 0.3], [0.1, 0.2, 0.325]]))
    assert inside == pytest.approx(-0.005)
    assert beside == pytest.approx(0.015)


def test_geoms_that_cannot_collide_are_left_out():
    surface = body('<geom type="box" size=".01 .01 .01"/><geom type="sphere" size=".05" contype="0" conaffinity="0"/>')
    assert surface.signed_distance(np.array([[0.02, 0, 0]]))[0] == pytest.approx(0.01)


def test_plane_is_refused():
    scene = Scene('<mujoco><worldbody><body name="b"><geom type="plane" size="1 1 1"/></body></worldbody></mujoco>')
    with pytest.raises(SceneError, match=r"no closed surface.*found plane"):
        Surface.of_body(scene, "b")


def test_unknown_body_is_refused():
    scene = Scene('<mujoco><worldbody><body name="b"><geom size=".01"/></body></worldbody></mujoco>')
    with pytest.raises(SceneError, match="no body 'c'"):
        Surface.of_body(scene, "c")


def test_mesh_distance_matches_the_box_that_it_is_a_mesh_of():
    box = SOLIDS["box"]
    solid = MeshSolid.of(trimesh.creation.box([0.04, 0.06, 0.08]))
    points = np.random.default_rng(0).uniform(-0.06, 0.06, (2000, 3))
    distance, gradient = solid.distance(points)
    expected, direction = box.distance(points)
    np.testing.assert_allclose(distance, expected, atol=1e-8)
    assert solid.area == pytest.approx(box.area)
    clear = np.abs(expected) > 1e-4
    ties = np.einsum("nd,nd->n", gradient, direction) < 0.999
    assert ties[clear].mean() < 0.005


def test_mesh_geom_of_a_scene_keeps_its_hole():
    ring = trimesh.creation.annulus(0.01, 0.03, 0.02)
    vertices, faces = " ".join(map(str, ring.vertices.ravel())), " ".join(map(str, ring.faces.ravel()))
    xml = (
        f'<mujoco><asset><mesh name="m" vertex="{vertices}" face="{faces}"/></asset><worldbody><body name="b">'
        '<geom type="mesh" mesh="m" pos="0 0 .1"/></body></worldbody></mujoco>'
    )
    surface = Surface.of_body(Scene(xml), "b")
    hole, wall = surface.signed_distance(np.array([[0.0, 0, 0.1], [0.02, 0, 0.1]]))
    assert hole == pytest.approx(0.01, abs=2e-4)
    assert wall == pytest.approx(-0.01, abs=2e-4)


def test_open_mesh_becomes_its_convex_hull_with_a_warning():
    mesh = trimesh.creation.box([0.02, 0.02, 0.02])
    mesh.update_faces(np.arange(12) > 1)
    with pytest.warns(UserWarning, match="not watertight"):
        solid = MeshSolid.of(mesh)
    assert solid.distance(np.zeros((1, 3)))[0][0] == pytest.approx(-0.01, abs=1e-8)


def test_point_cloud_tells_inside_from_outside_of_a_box_with_a_hole():
    surface, rng = hollow_box(), np.random.default_rng(4)
    points = surface.sample(5000, rng)[0]
    cloud = PointCloud.of(points + rng.normal(0, 2e-4, points.shape))
    probes, directions = surface.sample(1000, rng)
    for depth in (-0.003, 0.003):
        error = cloud.distance(probes + depth * directions)[0] - surface.signed_distance(probes + depth * directions)
        assert np.median(np.abs(error)) < 2.5e-4
        assert np.mean(np.abs(error) > 1.5e-3) < 0.06
    assert cloud.area == pytest.approx(surface.area, rel=0.12)


def test_point_cloud_takes_given_normals():
    points, normals = SOLIDS["sphere"].sample(3000, np.random.default_rng(5))
    cloud = PointCloud.of(points, normals)
    inner, outer = cloud.distance(np.array([[0.02, 0, 0], [0, 0, 0.04]]))[0]
    assert inner == pytest.approx(-0.01, abs=3e-4)
    assert outer == pytest.approx(0.01, abs=3e-4)


def test_few_points_are_no_surface():
    with pytest.raises(SceneError, match="too few points"):
        PointCloud.of(np.zeros((10, 3)))
    with pytest.raises(SceneError, match="too few different points"):
        PointCloud.of(np.zeros((100, 3)))


def test_floaters_are_outliers():
    points = SOLIDS["box"].sample(2000, np.random.default_rng(6))[0]
    points = np.concatenate([points, [[0.2, 0, 0], [0, 0.3, 0.1]]])
    kept = without_outliers(points)
    assert not kept[-2:].any()
    assert kept[:-2].mean() > 0.97
