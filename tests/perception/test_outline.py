"""Outlines of bodies in an image."""

from __future__ import annotations

import numpy as np
import pytest

from concent_warp.perception.pinhole import Pinhole
from concent_warp.perception.tracking.geometry.outline import Outline, outline
from concent_warp.perception.tracking.geometry.pose import moved
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.view import View
from concent_warp.scene.scene import Scene
from tests.report.drawn_film import START, XML, drawn

ROUND = XML.replace('type="box" size=".03 .025 .02" mass', 'type="sphere" size=".03" mass')


def seen(xml: str, pose: np.ndarray) -> tuple[Outline, View]:
    """Return the outline of the block of a scene at a pose, and the frame."""
    stream = drawn(pose[None], np.zeros(1))[0].image["camera"]
    view = View(Pinhole.of(stream), stream.rgb[0], stream.depth[0])
    scene = Scene(xml)
    renderer, shape = RayRenderer(scene.model), TrackedShape.of_body(scene, "block", 0)
    renderer.set_state(scene.model.qpos0)
    renderer.place(shape.row, pose)
    return outline(renderer, view, shape, pose), view


def lengths(found: Outline) -> np.ndarray:
    return np.linalg.norm(found.segments[:, 1] - found.segments[:, 0], axis=1)


def test_a_box_shows_nine_whole_edges():
    found, _ = seen(XML, START)
    assert len(found.segments) == 9
    assert not found.covered.any()


def test_what_another_body_covers_is_marked_and_what_the_body_covers_itself_is_left_out():
    free, _ = seen(XML, START)
    found, _ = seen(XML, moved(START, np.array([0.02, 0.1, 0, 0, 0, 0])))  # partly behind the wall
    total, covered = lengths(found).sum(), lengths(found)[found.covered].sum()
    assert 0.1 < covered / total < 0.9
    assert total == pytest.approx(lengths(free).sum(), rel=0.25)  # farther away


def test_a_sphere_shows_its_contour_alone():
    found, view = seen(ROUND, START)
    camera = view.camera
    centre, distance = camera.project(START[:3, 3])
    off = np.linalg.norm(found.segments.reshape(-1, 2) - centre, axis=1)
    sight = np.linalg.norm(START[:3, 3] - camera.position)
    radius = camera.intrinsics[0, 0] * 0.03 / np.sqrt(sight**2 - 0.03**2)
    assert off == pytest.approx(radius, rel=0.08)
    assert lengths(found).sum() == pytest.approx(2 * np.pi * radius, rel=0.15)
    assert distance > 0.3


def test_a_body_behind_the_camera_has_no_outline():
    behind = START.copy()
    behind[:3, 3] = [1.0, -0.9, 0.9]
    found, _ = seen(XML, behind)
    assert found.segments.shape == (0, 2, 2)
