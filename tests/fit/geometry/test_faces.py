import numpy as np
import pytest

from concent_warp.fit.geometry.faces import Faces, flattened
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.scene.spheres.contact_geometry import ContactGeometry
from concent_warp.scene.spheres.disturb import disturb
from tests.fit.conftest import DROP

LENGTH = 0.03
BALL = """<mujoco><worldbody><body name="ball"><geom type="sphere" size="0.03" mass="1"/></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def geometry() -> ContactGeometry:
    return ContactGeometryCfg(count=150).build(Scene(DROP))


def flat(geometry: ContactGeometry, scene: Scene) -> ContactGeometry:
    return flattened(geometry, Faces(geometry, scene, LENGTH))


def test_flat_faces_stay_where_they_are(geometry):
    for placed in (geometry, ContactGeometryCfg(count=150, placement="surface").build(Scene(DROP))):
        inner = np.sort(np.abs(placed.position), axis=1)[:, 1] < 0.013
        moved = flat(placed, Scene(DROP)).position - placed.position
        assert np.linalg.norm(moved[inner], axis=1).max() < 1e-4


def test_faces_at_another_distance_or_slope_than_the_nominal_ones_stay(geometry):
    position = geometry.position.copy()
    top = position[:, 2] > 0.0155
    position[top, 2] += 0.002 + 0.05 * position[top, 0]
    inner = top & (np.abs(position[:, :2]) < 0.013).all(axis=1)
    moved = flat(geometry.with_position(position), Scene(DROP)).position - position
    assert inner.sum() > 5
    assert np.abs(moved[inner, 2]).max() < 1e-4


def test_noise_of_single_spheres_goes_across_faces_and_stays_along_them(geometry):
    rough = disturb(geometry, position_std=1e-3, rng=np.random.default_rng(0))
    smooth = flat(rough, Scene(DROP))
    top = (geometry.position[:, 2] > 0.0155) & (np.abs(geometry.position[:, :2]) < 0.01).all(axis=1)
    assert top.sum() > 5
    assert smooth.position[top, 2].std() < 0.25 * rough.position[top, 2].std()
    np.testing.assert_allclose(smooth.position[top, :2], rough.position[top, :2], atol=1e-9)


def test_a_sphere_that_sticks_out_of_a_flat_face_is_taken_back(geometry):
    middle = np.linalg.norm(geometry.position - [0, 0, 0.016], axis=1).argmin()
    position = geometry.position.copy()
    position[middle, 2] += 0.003
    smooth = flat(geometry.with_position(position), Scene(DROP))
    assert smooth.position[middle, 2] == pytest.approx(geometry.position[middle, 2], abs=1e-5)


def test_a_sphere_that_lies_deeper_than_its_neighbours_stays(geometry):
    middle = np.linalg.norm(geometry.position - [0, 0, 0.016], axis=1).argmin()
    position = geometry.position.copy()
    position[middle, 2] -= 0.006
    smooth = flat(geometry.with_position(position), Scene(DROP))
    assert smooth.position[middle, 2] == position[middle, 2]


def test_a_ball_keeps_its_size():
    way = np.random.default_rng(0).normal(size=(120, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    n = len(way)
    geometry = ContactGeometry(
        ("ball",), np.zeros(n, int), 0.027 * way, np.full(n, 0.004), np.full(n, 1 / n), np.full(n, 0.5)
    )
    rough = disturb(geometry, position_std=5e-4, rng=np.random.default_rng(1))
    radius = np.linalg.norm(flat(rough, Scene(BALL)).position, axis=1)
    assert radius.mean() == pytest.approx(0.027, abs=1e-4)
    assert radius.std() < 0.6 * np.linalg.norm(rough.position, axis=1).std()
