import time

import mujoco
import numpy as np
import pytest

from concent_warp.errors import ModelError, SceneError
from concent_warp.scene.scene import Scene
from concent_warp.scene.shapes.solid import Box
from concent_warp.scene.shapes.surface import Surface
from concent_warp.scene.spheres.build import ContactGeometryCfg, _apportion
from concent_warp.scene.spheres.disturb import disturb, offset_normal, toward_axis
from concent_warp.scene.spheres.inset import inset
from concent_warp.scene.spheres.sampling import farthest_point_sampling

SCENE = Scene(
    """<mujoco><worldbody>
    <body name="block" pos="0 0 .1"><freejoint/>
      <geom type="box" size=".02 .02 .02" mass=".08" friction=".6 .005 .0001"/></body>
    <body name="box"><freejoint/>
      <geom type="box" size=".007 .035 .02" pos=".028 0 .02"/>
      <geom type="box" size=".007 .035 .02" pos="-.028 0 .02"/>
      <geom type="box" size=".035 .007 .02" pos="0 .028 .02"/>
      <geom type="box" size=".035 .007 .02" pos="0 -.028 .02"/>
      <geom type="box" size=".035 .035 .0025" pos="0 0 .0025" friction=".3 .005 .0001"/>
    </body></worldbody></mujoco>"""
)


@pytest.fixture(scope="module")
def geometry():
    return ContactGeometryCfg().build(SCENE)


def test_inset_spheres_lie_within_their_body(geometry):
    for name in geometry.bodies:
        mine = geometry.of(name)
        depth = -Surface.of_body(SCENE, name).signed_distance(geometry.position[mine])
        assert (depth >= geometry.radius[mine]).all()


def test_inset_spheres_reach_every_face(geometry):
    for name, half in (("block", [0.02, 0.02, 0.02]), ("box", [0.035, 0.035, 0.02])):
        mine = geometry.of(name)
        offset = np.array([0, 0, 0.02 if name == "box" else 0])
        reach = np.abs(geometry.position[mine] - offset) + geometry.radius[mine, None]
        np.testing.assert_allclose(reach.max(axis=0), half, atol=1e-6)
    floor = geometry.position[geometry.of("box")]
    under_hole = (np.abs(floor[:, :2]) < 0.021).all(axis=1)
    # The floor is 5 mm thick, too thin for a radius of 4 mm: its spheres shrink to 2.5 mm and cover it.
    assert under_hole.sum() > 10
    np.testing.assert_allclose(geometry.radius[geometry.of("box")][under_hole], 0.0025, rtol=2e-3)


def test_spheres_are_shared_by_area_and_spread_evenly(geometry):
    assert len(geometry) == 512
    share = len(geometry.of("block")) / 512
    assert share == pytest.approx(9600 / (9600 + 26880), abs=0.01)
    block = geometry.position[geometry.of("block")]
    gaps = np.linalg.norm(block[:, None] - block, axis=2) + np.eye(len(block))
    assert gaps.min() > 0.004
    points = Surface.of_solids([Box(np.full(3, 0.016))]).sample(3000, np.random.default_rng(0))[0]
    assert np.linalg.norm(points[:, None] - block, axis=2).min(axis=1).max() < 0.0065


def test_spheres_weigh_as_much_as_the_body_and_keep_its_inertia(geometry):
    for name in geometry.bodies:
        mine, row = geometry.of(name), SCENE.model.body(name)
        mass, away = geometry.mass[mine], geometry.position[mine] - row.ipos
        assert (mass >= 0).all()
        assert mass.sum() == pytest.approx(float(row.mass[0]), rel=1e-9)
        np.testing.assert_allclose(mass @ away, 0, atol=1e-12)
        tensor = np.einsum(
            "n,nij->ij", mass, np.sum(away**2, 1)[:, None, None] * np.eye(3) - away[:, :, None] * away[:, None]
        )
        tensor += np.eye(3) * 0.4 * (mass @ geometry.radius[mine] ** 2)
        axes = np.empty(9)
        mujoco.mju_quat2Mat(axes, row.iquat)
        expected = axes.reshape(3, 3) @ np.diag(row.inertia) @ axes.reshape(3, 3).T
        np.testing.assert_allclose(tensor, expected, atol=1e-8 * np.trace(expected))


def test_friction_is_that_of_the_nearest_geom_unless_given(geometry):
    assert set(geometry.friction[geometry.of("block")]) == {0.6}
    box = geometry.of("box")
    low = geometry.position[box, 2] < 0.0026
    assert set(geometry.friction[box[low]]) == {0.3}
    assert set(geometry.friction[box[geometry.position[box, 2] > 0.01]]) == {1.0}
    assert set(ContactGeometryCfg(count=20, friction=0.4).build(SCENE).friction) == {0.4}


def test_same_seed_gives_the_same_geometry_and_another_another(geometry):
    again = ContactGeometryCfg().build(SCENE)
    np.testing.assert_array_equal(again.position, geometry.position)
    np.testing.assert_array_equal(again.mass, geometry.mass)
    other = ContactGeometryCfg(seed=1).build(SCENE)
    assert np.abs(other.position - geometry.position).max() > 1e-3


def test_surface_placement_centres_spheres_on_the_surface():
    geometry = ContactGeometryCfg(placement="surface", radius=0.003).build(SCENE)
    for name in geometry.bodies:
        distance = Surface.of_body(SCENE, name).signed_distance(geometry.position[geometry.of(name)])
        np.testing.assert_allclose(distance, 0, atol=1e-9)
    assert set(geometry.radius) == {0.003}


def test_thin_object_is_refused_with_the_largest_radius_that_fits():
    with pytest.raises(ModelError, match=r"'box' is too thin.*at most 0\.0025 m, found 0\.004 m"):
        ContactGeometryCfg(thin="refuse").build(SCENE)
    assert len(ContactGeometryCfg(thin="refuse", radius=0.00249).build(SCENE)) == 512


def test_counts_by_name_and_equal_split_hold():
    geometry = ContactGeometryCfg(count=100, counts={"block": 30}).build(SCENE)
    assert [len(geometry.of(name)) for name in ("block", "box")] == [30, 70]
    geometry = ContactGeometryCfg(count=101, split="equal").build(SCENE)
    assert sorted(len(geometry.of(name)) for name in geometry.bodies) == [50, 51]
    assert len(ContactGeometryCfg(count=20).build(SCENE, ["block"])) == 20


@pytest.fixture(scope="module")
def edged():
    return ContactGeometryCfg(edges=120).build(SCENE)


def test_without_edges_spheres_are_inset_surface_points_far_apart(geometry):
    cfg, names = ContactGeometryCfg(edges=0), ("block", "box")
    assert cfg.radius != "auto"
    found = cfg.build(SCENE)
    for field in ("body", "position", "radius", "mass", "friction"):
        np.testing.assert_array_equal(getattr(found, field), getattr(geometry, field))
    for name, seed in zip(names, np.random.SeedSequence(cfg.seed).spawn(2), strict=True):
        surface = Surface.of_body(SCENE, name)
        points, _ = surface.sample(cfg.candidates, np.random.default_rng(seed))
        centres, radius = inset(surface, points, cfg.radius)
        roomy = radius > cfg.min_radius_share * cfg.radius
        mine = found.of(name)
        chosen = farthest_point_sampling(centres[roomy], len(mine))
        np.testing.assert_array_equal(found.position[mine], centres[roomy][chosen])
        np.testing.assert_array_equal(found.radius[mine], radius[roomy][chosen])


def test_edge_spheres_come_on_top_and_are_shared_by_area(geometry, edged):
    added = {}
    for name in geometry.bodies:
        before, after = geometry.of(name), edged.of(name)
        added[name] = len(after) - len(before)
        np.testing.assert_array_equal(edged.position[after][: len(before)], geometry.position[before])
        np.testing.assert_array_equal(edged.radius[after][: len(before)], geometry.radius[before])
    assert sum(added.values()) == pytest.approx(120, abs=1)
    assert added["block"] / 120 == pytest.approx(9600 / (9600 + 26880), abs=0.01)


def test_edge_spheres_lie_within_the_object_along_its_edges(geometry, edged):
    small, half = 0.0015, 0.02
    for name in geometry.bodies:
        extra = edged.of(name)[len(geometry.of(name)) :]
        depth = -Surface.of_body(SCENE, name).signed_distance(edged.position[extra])
        assert (depth >= edged.radius[extra] * (1 - 1e-9)).all()
        np.testing.assert_allclose(edged.radius[extra], small, rtol=1e-9)
    block = edged.of("block")
    away = half - np.abs(edged.position[block])  # from the faces
    extra = away[len(geometry.of("block")) :]
    # Within the least distance from two faces, or hardly more: nearest to an edge.
    np.testing.assert_allclose(np.sort(extra, axis=1)[:, 0], small, rtol=0.02)
    assert np.sort(extra, axis=1)[:, 1].max() < 1.3 * small
    # They reach farther into the edges than others, and are on all twelve.
    gap = np.linalg.norm(np.sort(away, axis=1)[:, :2], axis=1) - edged.radius[block]
    others = slice(0, len(geometry.of("block")))
    assert gap[len(geometry.of("block")) :].max() < gap[others].min()
    sides = np.where(extra < 2 * small, np.sign(edged.position[block][len(geometry.of("block")) :]), 0)
    along = {tuple(side) for side in sides if (side != 0).sum() == 2}
    assert len(along) == 12


def test_edge_spheres_have_their_radius_and_are_not_of_spheres_on_the_surface():
    geometry = ContactGeometryCfg(count=60, edges=20, edge_radius=0.002).build(SCENE, ["block"])
    assert len(geometry) == 80
    np.testing.assert_allclose(geometry.radius[60:], 0.002)
    row = SCENE.model.body("block")
    assert geometry.mass.sum() == pytest.approx(float(row.mass[0]))
    np.testing.assert_allclose(geometry.mass @ (geometry.position - row.ipos), 0, atol=1e-9)
    assert set(geometry.friction) == {0.6}
    assert len(ContactGeometryCfg(count=60, edges=20, placement="surface").build(SCENE, ["block"])) == 60
    # Spheres that reach farther into edges and corners themselves leave nothing out.
    assert len(ContactGeometryCfg(count=60, edges=20, radius=0.0008).build(SCENE, ["block"])) == 60


def test_auto_radius_makes_neighbours_touch():
    geometry = ContactGeometryCfg(count=100, radius="auto", placement="surface").build(SCENE, ["block"])
    position = geometry.position
    gaps = np.sort(np.linalg.norm(position[:, None] - position, axis=2), axis=1)[:, 1]
    assert 2 * geometry.radius[0] == pytest.approx(np.mean(gaps), rel=0.3)


def test_given_surface_replaces_the_geoms():
    surface = Surface.of_solids([Box(np.full(3, 0.01))], friction=0.7)
    geometry = ContactGeometryCfg(count=50, radius=0.002).build(SCENE, ["block"], surfaces={"block": surface})
    assert np.abs(geometry.position).max() == pytest.approx(0.008)
    assert set(geometry.friction) == {0.7}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"radius": -1.0}, "radius is out of bounds; expected above 0"),
        ({"radius": float("nan")}, "radius is not a number"),
        ({"edges": -1}, "edges is out of bounds; expected at least 0"),
        ({"edge_radius": 0.0}, "edge_radius is out of bounds; expected above 0"),
        ({"count": 0}, "count is out of bounds; expected at least 1"),
        ({"friction": -0.1}, "friction is out of bounds; expected at least 0"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, message):
    with pytest.raises(ModelError, match=message):
        ContactGeometryCfg(**settings)


def test_scene_and_settings_that_do_not_match_are_refused():
    with pytest.raises(ModelError, match="counts names bodies"):
        ContactGeometryCfg(counts={"ball": 3}).build(SCENE)
    with pytest.raises(ModelError, match="too few spheres"):
        ContactGeometryCfg(count=5, counts={"block": 5}).build(SCENE)
    with pytest.raises(SceneError, match="no objects"):
        ContactGeometryCfg().build(Scene("<mujoco/>"))


def test_default_geometry_takes_less_than_three_seconds():
    begin = time.process_time()
    ContactGeometryCfg().build(SCENE)
    assert time.process_time() - begin < 3


def test_apportioned_parts_sum_to_the_whole():
    parts = _apportion(10, np.array([1.0, 1.0, 1.0]))
    assert parts.sum() == 10
    assert parts.max() - parts.min() == 1


def test_noise_moves_the_named_bodies_alone(geometry):
    moved = disturb(geometry, position_std=1e-3, rng=np.random.default_rng(0), bodies=["box"])
    shift = moved.position - geometry.position
    assert not shift[geometry.of("block")].any()
    assert shift[geometry.of("box")].std() == pytest.approx(1e-3, rel=0.1)
    both = disturb(geometry, position_std=1e-3, rng=np.random.default_rng(0))
    np.testing.assert_array_equal((both.position - geometry.position)[geometry.of("box")], shift[geometry.of("box")])
    with pytest.raises(ModelError, match="no body 'ball'"):
        disturb(geometry, position_std=1e-3, rng=np.random.default_rng(0), bodies=["ball"])


def test_walls_of_the_hole_move_inward_and_nothing_else(geometry):
    tighter = offset_normal(geometry, SCENE, 1.5e-3, toward_axis(), body="box")
    box = geometry.of("box")
    before, shift = geometry.position[box], (tighter.position - geometry.position)[box]
    moved = np.abs(shift).max(axis=1) > 0
    np.testing.assert_allclose(np.linalg.norm(shift[moved], axis=1), 1.5e-3)
    assert (np.abs(shift[moved]) > 1e-9).sum(axis=1).max() == 1
    assert (np.einsum("nd,nd->n", shift[moved], before[moved] * [1, 1, 0]) < 0).all()
    across = np.sort(np.abs(before[:, :2]), axis=1)
    walls = (np.abs(across[:, 1] - 0.025) < 1e-6) & (across[:, 0] < 0.021)
    assert walls.sum() > 50
    assert moved[walls].all()
    outer = np.abs(before[:, :2]).max(axis=1) > 0.028
    assert not moved[outer].any()
    clear = np.abs(tighter.position[box][walls][:, :2]).max(axis=1) - tighter.radius[box][walls]
    np.testing.assert_allclose(clear, 0.0195, atol=1e-6)


def test_selection_without_spheres_is_refused(geometry):
    with pytest.raises(ModelError, match="no faces"):
        offset_normal(geometry, SCENE, 1e-3, lambda points, _: np.zeros(len(points), dtype=bool), body="box")
    lone = ContactGeometryCfg(count=1, radius=1e-4).build(SCENE, ["block"])
    with pytest.raises(ModelError, match="no sphere"):
        offset_normal(lone, SCENE, 1e-3, lambda _, n: n @ -np.sign(lone.position[0]) > 0.9, body="block", slack=0)


def test_an_object_in_millimetres_is_refused():
    scene = Scene("<mujoco><worldbody><body name='cup'><freejoint/><geom size='45'/></body></worldbody></mujoco>")
    with pytest.raises(
        SceneError, match=r"'cup' is larger .* at most 10 m, found 90 m; .* scale=\"0.001 0.001 0.001\""
    ):
        ContactGeometryCfg(count=8, candidates=5000).build(scene)
