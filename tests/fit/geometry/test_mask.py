import mujoco
import numpy as np

from concent_warp.fit.geometry.mask import robot_bodies, spheres_near, touched_spheres, with_neighbours
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.scene.shape_sorter import ShapeSorterCfg
from concent_warp.scene.spheres.contact_geometry import ContactGeometry
from tests.fit.conftest import DROP, corner_spheres


def test_arm_hand_and_fingers_are_the_robot():
    model = ShapeSorterCfg().build().model
    robot = {model.body(b).name for b in np.flatnonzero(robot_bodies(model))}
    assert robot == {f"link{i}" for i in range(1, 8)} | {"hand", "left_finger", "right_finger"}


def test_a_finger_coupled_by_an_equality_belongs_to_the_robot():
    spec = mujoco.MjSpec.from_string(
        """<mujoco><worldbody>
        <body name="a"><joint name="a" type="slide"/><geom size=".1"/></body>
        <body name="b"><joint name="b" type="slide"/><geom size=".1"/></body>
        <body name="c"><joint name="c" type="slide"/><geom size=".1"/></body></worldbody>
        <equality><joint joint1="b" joint2="a"/></equality>
        <actuator><position joint="a"/></actuator></mujoco>"""
    )
    assert robot_bodies(spec.compile()).tolist() == [False, True, True, False]


def test_touched_spheres_are_distinguished_by_what_they_touched():
    sphere_geom = np.array([2, 3, -1])
    robot = np.array([False, True, False])
    touched = np.zeros((4, 3), dtype=bool)
    touched[2, 0] = touched[3, 1] = True
    other, gripped = touched_spheres(touched, sphere_geom, robot)
    assert other.tolist() == [True, False, False]
    assert gripped.tolist() == [False, True, False]


def test_neighbours_are_the_nearest_on_the_same_body():
    geometry = corner_spheres(0.02)
    one = np.zeros(8, dtype=bool)
    one[0] = True
    grown = with_neighbours(geometry, one, 3)
    distance = np.linalg.norm(geometry.position - geometry.position[0], axis=1)
    assert set(np.flatnonzero(grown)) == set(np.argsort(distance, kind="stable")[:4])


def test_spheres_near_the_floor_are_found_at_their_distance():
    model = Model(Scene(DROP), corner_spheres(0.02))
    state = model.scene.model.qpos0.copy()
    state[2] = 0.025
    bottom = model.geometry.position[:, 2] < 0
    assert not spheres_near(model, state[None], 0.004).any()
    near = spheres_near(model, state[None], 0.006)
    np.testing.assert_array_equal(near[:, 0], bottom)
    assert not near[:, 1:].any()


def test_two_spheres_are_near_within_the_reach_and_not_within_its_double():
    xml = """<mujoco><worldbody>
      <body name="fixed"><geom name="fixed" type="sphere" size="0.01" mass="1"/></body>
      <body name="free" pos="0 0 0.1"><freejoint/><geom name="free" type="sphere" size="0.01" mass="1"/></body>
    </worldbody></mujoco>"""
    two = np.arange(2)
    geometry = ContactGeometry(
        ("fixed", "free"), two, np.zeros((2, 3)), np.full(2, 0.01), np.full(2, 1.0), np.full(2, 0.5)
    )
    model = Model(Scene(xml), geometry)
    states = np.array([[0, 0, 0.02 + gap, 1, 0, 0, 0] for gap in (0.007, 0.005)])
    assert not spheres_near(model, states[:1], 0.006).any()
    np.testing.assert_array_equal(spheres_near(model, states[1:], 0.006)[:, 1:], [[False, True], [True, False]])
