"""Offsets of the faces of bodies, against shapes that are known."""

import mujoco
import numpy as np
import pytest
from small_worlds import BALL, BLOCK, move, world

from concent_warp.effects.library.geometry import FACES, ContactGeometryOffset, Offsets, _extent, _resized
from concent_warp.errors import ModelError
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

MM = 1e-3
EFFECT = ContactGeometryOffset("thing")
OFFSETS = np.array([1.0, 2.0, 3.0, 0.5, -1.0, 4.0]) * MM
"""Of the faces x+, y+, z+, x-, y-, z-."""


def body(geoms: str, offsets: np.ndarray = OFFSETS) -> mujoco.MjModel:
    """A free body of some geoms whose faces are off."""
    xml = f'<mujoco><worldbody><body name="thing"><freejoint/>{geoms}</body></worldbody></mujoco>'
    return Model(Scene(xml)).add(EFFECT, list(offsets)).compile()


def faces(m: mujoco.MjModel, geom: int) -> np.ndarray:
    """Where the faces of a box are [m], body frame: low and high corner, shape (2, 3)."""
    turned = np.empty(9)
    mujoco.mju_quat2Mat(turned, m.geom_quat[geom])
    half = np.abs(turned.reshape(3, 3)) @ m.geom_size[geom]
    return np.stack([m.geom_pos[geom] - half, m.geom_pos[geom] + half])


@pytest.mark.parametrize(
    "geom",
    [
        '<geom type="box" size="0.05 0.04 0.02" pos="0.01 0 0"/>',
        '<geom type="box" size="0.04 0.05 0.02" pos="0.01 0 0" euler="0 0 90"/>',
        '<frame pos="0.01 0 0" euler="0 90 0"><geom type="box" size="0.02 0.04 0.05"/></frame>',
    ],
    ids=["straight", "turned", "in a turned frame"],
)
def test_each_face_of_a_box_moves_outward_by_its_offset(geom):
    low, high = faces(body(geom), 0)
    np.testing.assert_allclose(high, np.array([0.06, 0.04, 0.02]) + OFFSETS[:3], atol=1e-9)
    np.testing.assert_allclose(low, np.array([-0.04, -0.04, -0.02]) - OFFSETS[3:], atol=1e-9)


@pytest.mark.parametrize(("offset", "height"), [(1 * MM, 0.021), (-2 * MM, 0.018)])
def test_block_rests_higher_by_the_offset_of_its_lower_face(offset, height):
    values = {"z-": offset, "x+": 3 * MM}
    model = world(BLOCK).add(EFFECT, values)
    rest = move(model, 0.5, qpos=[0, 0, height, 1, 0, 0, 0]).qpos[-1]
    plain = move(world(BLOCK), 0.5, qpos=[0, 0, 0.02, 1, 0, 0, 0]).qpos[-1]
    assert rest[2] - plain[2] == pytest.approx(offset, abs=2e-5)


def test_block_wider_on_one_side_meets_a_wall_earlier():
    wall = '<geom name="wall" type="box" pos="0.2 0 0.05" size="0.02 0.2 0.1" friction="0"/><body name="thing"'
    xml = BLOCK.replace('<body name="thing"', wall).replace('friction="0.3"', 'friction="0"')
    speed = {"qpos": [0, 0, 0.02, 1, 0, 0, 0], "qvel": [0.2, 0, 0, 0, 0, 0]}
    times = []
    for offset in (0.0, 2 * MM):
        motion = move(Model(Scene(xml)).add(EFFECT, {"x+": offset, "x-": MM}), 0.8, **speed)
        times.append(motion.time[np.argmax(motion.qvel[:, 0] < 0.19)])
    assert times[0] == pytest.approx(0.13 / 0.2, abs=0.01)
    assert times[0] - times[1] == pytest.approx(2 * MM / 0.2, abs=2e-3)


def test_cylinder_grows_in_length_by_its_ends_and_in_radius_by_the_mean_of_its_sides():
    m = body('<geom type="cylinder" size="0.03 0.05"/>')
    np.testing.assert_allclose(m.geom_size[0, :2], [0.03 + 2.5 / 4 * MM, 0.05 + 3.5 * MM], atol=1e-9)
    np.testing.assert_allclose(m.geom_pos[0], [0.25 * MM, 1.5 * MM, -0.5 * MM], atol=1e-9)


def test_capsule_keeps_its_caps_round_and_reaches_as_far_as_its_ends_lie():
    m = body('<geom type="capsule" fromto="0 0 -0.05 0 0 0.05" size="0.03"/>')
    assert m.geom_size[0, 0] + m.geom_size[0, 1] == pytest.approx(0.08 + 3.5 * MM)
    assert m.geom_size[0, 0] == pytest.approx(0.03 + 2.5 / 4 * MM)


def test_ball_grows_by_the_mean_of_all_faces():
    assert body('<geom type="sphere" size="0.03"/>').geom_size[0, 0] == pytest.approx(0.03 + 9.5 / 6 * MM)


def test_thin_plate_does_not_turn_inside_out():
    m = body('<geom type="box" size="0.05 0.05 0.001"/>', np.array([0, 0, -5, 0, 0, -5]) * MM)
    assert m.geom_size[0, 2] == pytest.approx(1e-4)


def test_shape_askew_moves_as_a_whole():
    block = '<geom type="box" size="0.05 0.04 0.02"/>'
    m = body(block + '<geom type="box" size="0.01 0.01 0.03" pos="0.05 0 0" euler="0 30 0"/>')
    np.testing.assert_array_equal(m.geom_size[1], [0.01, 0.01, 0.03])
    assert m.geom_pos[1, 0] == pytest.approx(0.05 + MM)


SHELL = np.array([[x, y, z] for x in (-45, 0, 45) for y in (-35, 0, 35) for z in (-15, 15)]) * MM
SPHERES = ContactGeometry(
    ("thing",), np.zeros(18, dtype=int), SHELL, np.full(18, 5 * MM), np.full(18, 0.4 / 18), np.full(18, 0.3)
)


def test_spheres_at_a_face_move_with_it_and_those_between_by_less():
    model = Model(Scene(BLOCK), SPHERES)
    m = model.add(EFFECT, list(OFFSETS)).compile()
    ids = [m.geom(f"thing_sphere{k}").id for k in range(18)]
    moved = m.geom_pos[ids] - SHELL
    np.testing.assert_allclose(m.geom_size[ids, 0], 5 * MM)
    for axis in range(3):
        side = SHELL[:, axis]
        np.testing.assert_allclose(moved[side > 0, axis], OFFSETS[axis], atol=1e-9)
        np.testing.assert_allclose(moved[side < 0, axis], -OFFSETS[3 + axis], atol=1e-9)
        middle = (OFFSETS[axis] - OFFSETS[3 + axis]) / 2
        np.testing.assert_allclose(moved[side == 0, axis], middle, atol=1e-9)
    drawn = m.geom("thing").id
    np.testing.assert_array_equal(m.geom_size[drawn], model.compile().geom_size[drawn])


@pytest.mark.parametrize("geometry", [None, SPHERES], ids=["box", "spheres"])
def test_mass_and_inertia_stay(geometry):
    plain = Model(Scene(BLOCK), geometry)
    off = plain.add(EFFECT, list(OFFSETS)).compile()
    for name in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        np.testing.assert_allclose(getattr(off, name), getattr(plain.compile(), name), atol=1e-9)


def test_contact_geometry_acts_only_on_free_bodies_with_shapes_of_known_size():
    mesh = '<geom type="mesh" mesh="wedge"/>'
    xml = f"""<mujoco><asset><mesh name="wedge" vertex="-1 -1 -1 1 -1 -1 0 1 -1 0 0 1" scale=".02 .02 .02"/></asset>
    <worldbody><body name="wedge"><freejoint/>{mesh}</body><body name="ghost"><freejoint/>
    <geom size="0.1" contype="0" conaffinity="0"/></body><body name="thing"><freejoint/><geom size="0.1"/></body>
    </worldbody></mujoco>"""
    model = Model(Scene(xml))
    assert ContactGeometryOffset.targets(model.compile()) == (("thing",),)
    for other in ("wedge", "ghost"):
        with pytest.raises(ModelError, match="colliding"):
            model.add(ContactGeometryOffset(other))


def test_ball_with_all_faces_out_rests_higher():
    plain = move(world(BALL), 0.5, qpos=[0, 0, 0.05, 1, 0, 0, 0]).qpos[-1, 2]
    grown = move(world(BALL).add(EFFECT, [2 * MM] * 6), 0.5, qpos=[0, 0, 0.052, 1, 0, 0, 0]).qpos[-1, 2]
    assert grown - plain == pytest.approx(2 * MM, abs=2e-5)


def test_points_between_faces_move_by_shares_and_those_at_a_face_with_it():
    offsets = Offsets(np.array([-1.0, -2.0, 0.0]), np.array([1.0, 2.0, 0.0]), np.array([[1, 2, 3], [4, 5, 6]]) * 0.1)
    middle = np.array([0.1 - 0.4, 0.2 - 0.5, 0.3 - 0.6]) / 2
    np.testing.assert_allclose(offsets.at(np.zeros(3)), middle)
    np.testing.assert_allclose(offsets.at(np.array([1.0, 9.0, 0.0])), [0.1, 0.2, middle[2]])
    np.testing.assert_allclose(offsets.at(np.array([-1.0, -9.0, 0.0])), [-0.4, -0.5, middle[2]])
    np.testing.assert_allclose(offsets.at(np.array([0.5, 0.0, 0.0]))[0], 0.75 * 0.1 - 0.25 * 0.4)
    np.testing.assert_allclose(offsets.at(np.array([0.4, 1.5, 0.0]), 0.5), [0.9 * 0.1 - 0.1 * 0.4, 0.2, middle[2]])
    np.testing.assert_allclose(offsets.at(np.array([0.9, 0.0, 0.0]), 1.0)[0], middle[0])
    assert FACES == ("x+", "y+", "z+", "x-", "y-", "z-")


def test_shapes_of_each_kind_grow_by_the_change_of_their_reach():
    size, change, kind = np.array([0.1, 0.2, 0.3]), np.array([0.01, 0.03, 0.05]), mujoco.mjtGeom
    grown = {k: _resized(int(k), size, change) - size for k in (kind.mjGEOM_SPHERE, kind.mjGEOM_BOX)}
    np.testing.assert_allclose(grown[kind.mjGEOM_SPHERE], [0.03, 0, 0])
    np.testing.assert_allclose(grown[kind.mjGEOM_BOX], change)
    np.testing.assert_allclose(_resized(int(kind.mjGEOM_CYLINDER), size, change) - size, [0.02, 0.05, 0])
    np.testing.assert_allclose(_resized(int(kind.mjGEOM_CAPSULE), size, change) - size, [0.02, 0.03, 0])
    np.testing.assert_allclose(_resized(int(kind.mjGEOM_ELLIPSOID), size, change) - size, change)


def test_a_shape_moves_by_what_its_ends_do_and_a_small_one_as_a_whole():
    geoms = """<geom type="box" size=".1 .2 .3"/><geom type="box" size=".01 .01 .01" pos=".05 .1 .1"/>
      <geom type="sphere" size=".06" pos=".02 0 0"/><geom type="box" size=".2 .1 .3" euler="0 0 90"/>
      <geom type="cylinder" size=".1 .15" euler="90 0 0"/>"""
    m = Model(Scene(f'<mujoco><worldbody><body name="t"><freejoint/>{geoms}</body></worldbody></mujoco>')).compile()
    values = np.array([1.0, 2.0, 3.0, 0.5, -1.0, 4.0]) * 1e-3
    offsets = Offsets.of(m, m.body("t").id, values)
    np.testing.assert_allclose([offsets.low, offsets.high], [[-0.1, -0.2, -0.3], [0.1, 0.2, 0.3]])
    center = (values[:3] - values[3:]) / 2
    grown = (values[:3] + values[3:]) / 2
    position, quaternion, size = offsets.moved(m, 0)
    np.testing.assert_allclose(position, center)
    np.testing.assert_allclose(size, np.array([0.1, 0.2, 0.3]) + grown)
    np.testing.assert_array_equal(quaternion, [1, 0, 0, 0])
    position, _, size = offsets.moved(m, 1)
    np.testing.assert_allclose(position - [0.05, 0.1, 0.1], offsets.at(np.array([0.05, 0.1, 0.1]), 0.015))
    np.testing.assert_allclose(size, 0.01)
    position, _, size = offsets.moved(m, 2)
    ends = [offsets.at(np.array([0.02, 0, 0]) + s * 0.06) for s in (1, -1)]
    np.testing.assert_allclose(position - [0.02, 0, 0], (ends[0] + ends[1]) / 2)
    assert size[0] == pytest.approx(0.06 + np.mean(ends[0] - ends[1]) / 2)
    _, quaternion, size = offsets.moved(m, 3)
    np.testing.assert_allclose(size, np.array([0.2, 0.1, 0.3]) + grown[[1, 0, 2]])
    np.testing.assert_array_equal(quaternion, m.geom_quat[3])
    _, _, size = offsets.moved(m, 4)
    ends = [offsets.at(s * np.array([0.1, 0.15, 0.1])) for s in (1, -1)]
    change = (ends[0] - ends[1]) / 2
    np.testing.assert_allclose(size[:2], [0.1 + (change[0] + change[2]) / 2, 0.15 + change[1]])
    np.testing.assert_allclose(_extent(m, 4), [0.1, 0.15, 0.1], atol=1e-9)
    np.testing.assert_allclose(_extent(m, 2), [0.06] * 3)
