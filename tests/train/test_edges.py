"""Edge spheres that a training adds to a contact geometry."""

import copy
from dataclasses import replace

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.model import Model
from concent_warp.scene.shapes.surface import Surface
from concent_warp.train.cfg import EdgeCfg
from concent_warp.train.task.edges import displacement, with_edge_spheres
from concent_warp.train.task.task import Task

CFG = EdgeCfg()


def extended(model: Model, touched: np.ndarray | None = None) -> cw.ContactGeometry:
    """Return the spheres of a model with those along edges, near touched ones or near all."""
    assert model.geometry is not None
    touched = np.ones(len(model.geometry), dtype=bool) if touched is None else touched
    found = with_edge_spheres(model, touched, CFG).geometry
    assert found is not None
    return found


@pytest.fixture(scope="module")
def model() -> Model:
    """Return the shape sorter with spheres that no fit has moved."""
    scene = cw.load_policy("shape_sorter").run.model.scene
    return Model(scene, cw.ContactGeometryCfg().build(scene))


def test_small_massless_spheres_lie_within_the_objects_near_touched_ones(model):
    touched = np.zeros(512, dtype=bool)
    touched[model.geometry.of("block")[:20]] = True
    found = extended(model, touched)
    for name in ("body", "position", "radius", "mass", "friction"):
        np.testing.assert_array_equal(getattr(found, name)[:512], getattr(model.geometry, name))
    added = slice(512, None)
    assert len(found) > 530
    assert set(found.body[added]) == {found.bodies.index("block")}  # nothing of the box is touched
    assert (found.mass[added] == 0).all()
    np.testing.assert_allclose(found.radius[added], CFG.radius)
    surface = Surface.of_body(model.scene, "block")
    depth = surface.signed_distance(found.position[added])
    assert (depth <= -CFG.radius + 2e-5).all()
    gaps = np.linalg.norm(found.position[added][:, None] - model.geometry.position[touched], axis=2).min(axis=1)
    assert (gaps < CFG.reach).all()
    # They are near at least two faces of the block, whose half size is 20 mm.
    near_faces = np.abs(found.position[added]) > 0.02 - 2.2 * CFG.radius
    assert (near_faces.sum(axis=1) >= 2).all()


def test_geometry_with_edge_spheres_of_its_own_gets_hardly_more(model):
    scene = model.scene
    own = Model(scene, cw.ContactGeometryCfg(edges=400).build(scene))
    assert own.geometry is not None
    more = len(extended(model)) - len(model.geometry)
    assert more > 300
    assert len(extended(own)) - len(own.geometry) < 0.2 * more


def test_the_same_edge_spheres_are_computed_once_and_others_anew(model, monkeypatch):
    touched = np.zeros(len(model.geometry), dtype=bool)
    touched[model.geometry.of("block")[:30]] = True
    first, again = (extended(copy.deepcopy(model), touched.copy()) for _ in range(2))
    for name in ("body", "position", "radius", "mass", "friction"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    calls, of_body = [], Surface.of_body
    monkeypatch.setattr(Surface, "of_body", lambda *given: calls.append(given) or of_body(*given))
    extended(model, touched)
    assert not calls
    moved = model.geometry.with_position(model.geometry.position + np.array([1e-3, 0, 0]))
    extended(replace(model, geometry=moved), touched)
    assert calls
    touched[model.geometry.of("box")[:30]] = True
    assert len(extended(model, touched)) > len(first)


def test_edges_move_as_the_faces_beside_them(model):
    surface, body = Surface.of_body(model.scene, "block"), model.geometry.of("block")
    centres, radius = model.geometry.position[body].copy(), model.geometry.radius[body]
    top, side = centres[:, 2] > 0.0155, centres[:, 0] > 0.0155
    centres[top & ~side] += [0, 0, 0.001]
    centres[side & ~top] += [0.0005, 0, 0]
    middle = np.linalg.norm(np.array([0.0185, 0, 0.0185]) - centres, axis=1)
    keep = ~(top & side)  # those at the edge itself have two normals, of which one counts
    found = displacement(surface, centres[keep], radius[keep], middle[None, keep])
    np.testing.assert_allclose(found, [[0.0005, 0, 0.001]], atol=1e-4)
    still = displacement(surface, model.geometry.position[body], radius, middle[None])
    np.testing.assert_allclose(still, 0, atol=2e-5)


def test_task_has_them_in_its_physics_beside_the_spheres_of_the_events(model):
    run = cw.load_policy("shape_sorter").run
    (events,) = cw.extract_events(model, run.recording).values()
    without = replace(run.cfg.environment, stage="insert", edges=EdgeCfg(count=0))
    plain, task = (
        Task.build(model, run.recording[0], cfg, events)
        for cfg in (without, replace(without, edges=EdgeCfg(count=200)))
    )
    more = len(task.collidable) - len(plain.collidable)
    assert more > 10
    assert task.collidable[-more:].all()
    np.testing.assert_array_equal(task.collidable[:-more], plain.collidable)
    for name in ("point_a", "radius_a", "point_b", "normal", "active"):
        np.testing.assert_array_equal(getattr(task.table, name), getattr(plain.table, name))
    np.testing.assert_array_equal(task.target_position, plain.target_position)
