from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import concent_warp as cw
from concent_warp.perception.tracking.geometry.pose import pose_of, rotation_angle
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.symmetry import symmetry_of

SCENE = "<mujoco><worldbody><body name='thing'><freejoint/>{}</body></worldbody></mujoco>"
SHAPES = {
    "cube": ('<geom type="box" size=".02 .02 .02" pos=".01 0 0" euler="10 20 30"/>', 24),
    "brick": ('<geom type="box" size=".03 .02 .012"/>', 4),
    "square brick": ('<geom type="box" size=".03 .03 .012"/>', 8),
    "tee": ('<geom type="box" size=".03 .01 .012"/><geom type="box" pos="0 .02 0" size=".01 .02 .008"/>', 2),
    "ell": ('<geom type="box" size=".03 .01 .012"/><geom type="box" pos=".02 .02 0" size=".01 .02 .008"/>', 1),
}


def shape(geoms: str) -> TrackedShape:
    return TrackedShape.of_body(cw.Scene(SCENE.format(geoms)), "thing", 0)


@pytest.mark.parametrize("name", SHAPES)
def test_rotations_that_leave_a_shape_are_counted(name):
    geoms, count = SHAPES[name]
    assert len(symmetry_of(shape(geoms), 0.01).turns) == count


@pytest.mark.parametrize(
    ("geoms", "name"),
    [
        ('<geom type="sphere" size=".02"/>', "sphere"),
        ('<geom type="cylinder" size=".02 .03"/>', "round about the axis (0, 0, 1), and may be turned over"),
        (
            '<geom type="cylinder" size=".02 .03"/><geom type="sphere" size=".03" pos="0 0 .03"/>',
            "round about the axis (0, 0, 1)",
        ),
    ],
)
def test_round_shapes_are_named(geoms, name):
    assert symmetry_of(shape(geoms), 0.01).name.startswith(name)


@pytest.mark.parametrize("geoms", [SHAPES["cube"][0], '<geom type="cylinder" size=".02 .03" pos=".1 0 0"/>'])
def test_the_nearest_representative_is_the_same_solid_and_near(geoms):
    body = shape(geoms)
    symmetry = symmetry_of(body, 0.01)
    rng = np.random.default_rng(0)
    pose = pose_of(rng.normal(size=3), rng.normal(size=4))
    turn = np.eye(4)
    turn[:3, :3] = symmetry.turns[1]
    turn[:3, 3] = symmetry.centre - turn[:3, :3] @ symmetry.centre
    little = pose @ turn
    little[:3, :3] = Rotation.from_rotvec([0.02, -0.01, 0.03]).as_matrix() @ little[:3, :3]
    nearest = symmetry.nearest(pose, little)
    assert rotation_angle(nearest, little) < 0.04
    moved = (body.points @ nearest[:3, :3].T + nearest[:3, 3] - pose[:3, 3]) @ pose[:3, :3]
    assert np.abs(body.surface.signed_distance(moved)).max() < 1e-4
