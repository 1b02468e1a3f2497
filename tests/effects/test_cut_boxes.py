"""Tilted faces and cut edges of boxes and of spheres, against geometry worked out by hand."""

import mujoco
import numpy as np
import pytest
from small_worlds import BLOCK, move, world

from concent_warp.diagnosis.candidates.candidates import candidates, label
from concent_warp.effects.library.cut_box import EDGE_PARTS, FACE_PARTS, PAIR_PARTS, PARTS, CutBox, largest, names
from concent_warp.effects.library.geometry import ContactGeometryOffset
from concent_warp.effects.registry import effect_class
from concent_warp.errors import ModelError
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

MM = 1e-3
HALF = np.array([50.0, 40.0, 20.0]) * MM
BOX = HALF * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
SPHERES = ContactGeometry(
    ("thing",), np.zeros(8, dtype=int), 0.8 * BOX, np.full(8, 4 * MM), np.full(8, 0.05), np.full(8, 0.3)
)


def rows(points: np.ndarray) -> set[tuple[float, ...]]:
    """Points as a set [mm]."""
    return {tuple(round(float(x) / MM, 5) + 0.0 for x in point) for point in points}


def cut(part: str, *values: float) -> np.ndarray:
    """Corners of a box whose part has some values."""
    return CutBox.of(HALF, part, np.array(values)).corners()


@pytest.mark.parametrize("part", PARTS)
def test_box_with_nothing_off_has_its_own_corners(part):
    plain = CutBox.of(HALF, part, np.zeros(len(names(part))))
    assert plain.is_plain
    assert rows(plain.corners()) == rows(BOX)
    assert not CutBox.of(HALF, part, np.full(len(names(part)), 1e-6)).is_plain


def test_cut_edge_has_two_corners_in_the_place_of_each():
    edge = (BOX[:, 0] > 0) & (BOX[:, 2] < 0)
    expected = [*BOX[~edge], *(BOX[edge] - [7 * MM, 0, 0]), *(BOX[edge] + [0, 0, 7 * MM])]
    assert rows(cut("edge_x+z-", 7 * MM)) == rows(np.array(expected))


def test_tilted_face_lies_further_out_at_one_end_and_the_opposite_one_stays():
    lower = BOX[:, 2] < 0
    expected = BOX - lower[:, None] * np.array([0, 0, 1]) * 3 * MM * np.sign(BOX[:, :1])
    assert rows(cut("face_z-", 3 * MM, 0.0)) == rows(expected)


def test_skew_box_has_opposite_faces_that_are_tilted_alike():
    expected = BOX + np.sign(BOX[:, 1:2]) * np.array([3 * MM, 0, 0])
    assert rows(cut("faces_x", 3 * MM, 0.0)) == rows(expected)


def test_box_with_all_edges_cut_lies_within_each_cut():
    found = cut("edges", 5 * MM)
    assert len(found) == 32  # four on each face, and one where three cuts meet
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert (np.abs(found[:, a]) + np.abs(found[:, b])).max() == pytest.approx(HALF[a] + HALF[b] - 5 * MM)


@pytest.mark.parametrize("part", PARTS)
def test_largest_values_leave_a_box_about_its_middle(part):
    most = np.full(len(names(part)), largest(HALF, part))
    box = CutBox.of(HALF, part, most)
    assert len(box.corners()) >= 8
    assert (np.abs(box.corners()) < 2 * HALF).all()


def test_parts_are_named_after_the_faces():
    assert len(FACE_PARTS) == 6
    assert len(PAIR_PARTS) == 3
    assert len(EDGE_PARTS) == len(set(EDGE_PARTS)) == 12
    assert names("face_y+") == ("tilt_x", "tilt_z")
    assert names("faces_x") == ("tilt_y", "tilt_z")
    assert names("edge_x+y-") == names("edges") == ("cut",)


def test_spheres_follow_a_tilted_face_and_stay_within_a_cut():
    radius = np.full(8, 4 * MM)
    tilted = CutBox.of(HALF, "face_z-", np.array([5 * MM, 0.0])).moved(0.8 * BOX, radius, 1.5)
    lower = BOX[:, 2] < 0
    np.testing.assert_allclose((tilted - 0.8 * BOX)[lower, 2], -4 * MM * np.sign(BOX[lower, 0]), atol=1e-12)
    np.testing.assert_allclose((tilted - 0.8 * BOX)[~lower], 0, atol=1e-12)
    worn = CutBox.of(HALF, "edge_x+z-", np.array([20 * MM])).moved(0.8 * BOX, radius, 1.5)
    edge = (BOX[:, 0] > 0) & (BOX[:, 2] < 0)
    reach = worn[edge] @ [1, 0, -1] + np.sqrt(2) * 4 * MM
    np.testing.assert_allclose(reach, HALF[0] + HALF[2] - 20 * MM)
    np.testing.assert_array_equal(worn[~edge], 0.8 * BOX[~edge])


@pytest.mark.parametrize("geometry", [None, SPHERES], ids=["box", "spheres"])
@pytest.mark.parametrize("part", ["face_z-", "faces_x", "edge_x+z-", "edges"])
def test_mass_and_inertia_stay_and_the_null_value_changes_nothing(geometry, part):
    plain = Model(Scene(BLOCK), geometry)
    effect = ContactGeometryOffset("thing", part)
    null, off = plain.add(effect).compile(), plain.add(effect, {names(part)[0]: 4 * MM}).compile()
    for name in ("geom_type", "geom_pos", "geom_quat", "geom_size"):
        np.testing.assert_array_equal(getattr(null, name), getattr(plain.compile(), name))
    for name in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        np.testing.assert_allclose(getattr(off, name), getattr(plain.compile(), name), atol=1e-9)
    assert (off.ngeom, off.nv) == (null.ngeom, null.nv)
    collides = (off.geom_type == mujoco.mjtGeom.mjGEOM_MESH).any()
    assert collides if geometry is None else not collides


def test_block_rests_on_its_tilted_lower_face():
    model = world(BLOCK).add(ContactGeometryOffset("thing", "face_z-"), {"tilt_x": 2 * MM})
    rest = move(model, 1.0, qpos=[0, 0, 0.023, 1, 0, 0, 0]).qpos[-1]
    pitch = 2 * np.arcsin(rest[5])
    assert abs(pitch) == pytest.approx(np.arctan(2 / 50), abs=2e-3)
    # The face's end at x+ lies lower in the body, which is turned with this end up.
    assert pitch < 0


def test_a_small_value_moves_a_block_nearly_as_none_does():
    start = {"qpos": [0, 0, 0.04, 0.995, 0.06, 0.08, 0], "qvel": [0.3, 0.1, 0, 0.3, 0.5, 0.2]}
    plain = move(world(BLOCK), 0.12, **start).qpos
    for part in ("faces_x", "edge_x+z-"):
        effect = ContactGeometryOffset("thing", part)
        moved = move(world(BLOCK).add(effect, {names(part)[0]: 1e-6}), 0.12, **start).qpos
        np.testing.assert_allclose(moved, plain, atol=1e-3)


@pytest.mark.parametrize(("values", "gap"), [({}, 0.0), ({"cut": 5 * MM}, 5 * MM / np.sqrt(2))])
def test_block_above_the_floor_on_a_worn_edge_is_further_away_by_the_depth_of_the_cut(values, gap):
    m = world(BLOCK).add(ContactGeometryOffset("thing", "edge_x+z-"), values).compile()
    m.geom_margin[:] = 0.1
    data = mujoco.MjData(m)
    for sign, expected in ((1, gap), (-1, 0.0)):  # its edge between x+ and z- is the lowest, or that between x- and z-
        data.qpos[:] = [0, 0, 0.06, np.cos(np.pi / 8), 0, sign * np.sin(np.pi / 8), 0]
        mujoco.mj_forward(m, data)
        nearest = 0.06 - (HALF[0] + HALF[2]) / np.sqrt(2)
        assert data.contact.dist.min() == pytest.approx(nearest + expected, abs=1e-6)


def test_only_a_single_box_or_spheres_alone_have_parts():
    xml = """<mujoco><worldbody>
    <body name="box"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
    <body name="two"><freejoint/><geom type="box" size=".1 .1 .1"/><geom type="box" size=".2 .05 .1"/></body>
    <body name="rod"><freejoint/><geom type="capsule" size=".1 .1"/></body>
    <body name="ball"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
    m = Model(Scene(xml)).compile()
    found = ContactGeometryOffset.targets(m)
    assert {t[0] for t in found} == {"box", "two", "rod", "ball"}
    assert [t for t in found if len(t) > 1] == [("box", part) for part in PARTS]
    with pytest.raises(ModelError, match="one box"):
        Model(Scene(xml)).add(ContactGeometryOffset("two", "edges"))
    with pytest.raises(ModelError, match="unknown target"):
        Model(Scene(xml)).add(ContactGeometryOffset("box", "edge_x+x-"))
    assert ("thing", "edges") in ContactGeometryOffset.targets(Model(Scene(BLOCK), SPHERES).compile())


def test_a_body_has_one_part_off_at_a_time():
    model = Model(Scene(BLOCK))
    first = model.add(ContactGeometryOffset("thing", "edges"), [2 * MM])
    with pytest.raises(ModelError, match="thing"):
        first.add(ContactGeometryOffset("thing", "face_x+"))
    spheres = Model(Scene(BLOCK), SPHERES).add(ContactGeometryOffset("thing", "edges"), [2 * MM])
    with pytest.raises(ModelError, match="already"):
        spheres.add(ContactGeometryOffset("thing", "face_x+"))
    assert not [e for e in candidates(first, ()) if e.name == "contact_geometry"]
    (added,) = model.add_effect("contact_geometry").effects
    assert added.effect.target == ("thing",)
    (added,) = model.add_effect("contact_geometry", ("thing", "edge_y+z-"), {"cut": 3 * MM}).effects
    assert (added.effect.target, added.values) == (("thing", "edge_y+z-"), (3 * MM,))


def test_candidates_are_told_apart_by_their_parts():
    found = candidates(Model(Scene(BLOCK)), (), ["contact_geometry"])
    said = [label(e, found) for e in found]
    assert said[0] == "contact_geometry(thing)"
    assert "contact_geometry(thing, edge_x+z-)" in said
    assert len(set(said)) == len(found) == 1 + len(PARTS)
    assert [e.is_part for e in found] == [False] + [True] * len(PARTS)
    assert not effect_class("mass")("thing", "other").is_part
