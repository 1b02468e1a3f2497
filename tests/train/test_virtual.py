"""Spheres left out of the physics count no farther than the surface of their object, points of it up to its edges."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_insertion import SETTINGS

from concent_warp.errors import SceneError
from concent_warp.scene.shapes.solid import Box
from concent_warp.scene.shapes.surface import Surface
from concent_warp.train.cfg import CollisionCfg
from concent_warp.train.environment.virtual_collision import _surface_points, _within
from concent_warp.train.environment.worlds import make_environment

HALF, RADIUS, SLACK = 0.02, 0.004, 0.0005
CUBE = Surface.of_solids([Box(np.full(3, HALF))])


def test_spheres_within_an_object_shrink_by_the_slack():
    centre = np.array([[HALF - RADIUS, 0, 0], [0.0, 0.0, 0.0]])
    moved, radius = _within(CUBE, centre, np.full(2, RADIUS), SLACK)
    np.testing.assert_allclose(moved, centre)
    np.testing.assert_allclose(radius, RADIUS - SLACK)


@pytest.mark.parametrize("out", [-0.001, 0.0, 0.002])
def test_spheres_that_stand_out_end_the_slack_below_the_surface(out):
    centre = np.array([[HALF + out, 0.005, -0.003], [0.001, -HALF - out, 0.004]])
    moved, radius = _within(CUBE, centre, np.full(2, RADIUS), SLACK)
    np.testing.assert_allclose(CUBE.signed_distance(moved) + radius, -SLACK, atol=1e-12)
    np.testing.assert_allclose(radius, max(-out - SLACK, 0.0), atol=1e-12)
    aside = [[1, 2], [0, 2]]
    for row in range(2):
        np.testing.assert_array_equal(moved[row, aside[row]], centre[row, aside[row]])


def test_points_lie_just_below_the_surface_and_reach_into_the_corners():
    cfg = CollisionCfg(points=300, slack=SLACK)
    points = _surface_points(CUBE, cfg)
    assert points.shape == (300, 3)
    depth = -CUBE.signed_distance(points)
    assert depth.min() > -1e-6
    assert depth.max() < SLACK + 1e-6
    assert np.median(depth) == pytest.approx(SLACK, abs=1e-6)
    corners = HALF * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    assert np.linalg.norm(points[None] - corners[:, None], axis=2).min(axis=1).max() < 0.003


def test_points_tell_of_an_object_that_stands_in_another_where_its_spheres_do_not(task, states):
    def penalty(points: int) -> torch.Tensor:
        cfg = replace(SETTINGS, virtual=replace(SETTINGS.virtual, points=points))
        environment = make_environment(task, cfg, states, device="cpu")
        environment.start_from(list(range(environment.num_envs)))
        free = task.compiled.jnt_qposadr[task.compiled.body_jntadr[task.objects[0]]]
        environment.physics.qpos[:, free] += 0.003
        environment.refresh()
        environment._measured.launch()
        return environment._penalty.clone()

    plain, pointed = penalty(0), penalty(300)
    assert (pointed <= plain + 1e-6).all()
    assert (pointed < plain - 0.01).any()


def test_an_object_without_a_surface_needs_all_its_spheres_in_the_physics(task, states, monkeypatch):
    def missing(_scene, body: str):
        raise SceneError(f"body {body!r} has no geoms")

    monkeypatch.setattr(Surface, "of_body", missing)
    pointed = replace(SETTINGS, virtual=replace(SETTINGS.virtual, points=20))
    with pytest.raises(SceneError):
        make_environment(task, pointed, states, device="cpu")
    whole = replace(task, collidable=np.ones_like(task.collidable))
    environment = make_environment(whole, replace(pointed, collision="full"), states, device="cpu")
    assert not environment._penalty.any()
