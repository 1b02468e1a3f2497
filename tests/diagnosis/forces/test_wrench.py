"""Wrenches on bodies, their steady part and the place where it acts, on made-up windows with known answers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from concent_warp.diagnosis.forces.cfg import ForcePlaceCfg, LocateForcesCfg
from concent_warp.diagnosis.forces.contact_state import BodyWindows, Touch, extent
from concent_warp.diagnosis.forces.point_of_action import (
    _at_contact,
    _face_words,
    _lever,
    _line_of_action,
    _surface_points,
    force_place,
)
from concent_warp.diagnosis.forces.wrench import SteadyForce, Wrenches, joined, steady_force, wrenches
from concent_warp.errors import SceneError
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.scene.shapes.surface import Surface
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

CFG = LocateForcesCfg()
PLACE = ForcePlaceCfg(surface_points=2000)


def windows(count: int, rng: np.random.Generator, size: float = 0.05) -> BodyWindows:
    """Return windows of a body that turns at random and is free."""
    rotation = Rotation.random(count, rng).as_matrix()
    free = np.tile(np.eye(6), (count, 1, 1))
    return BodyWindows(
        np.full(count, "free", dtype=object), tuple({} for _ in range(count)), free, size,
        rng.normal(size=(count, 3)), rng.normal(size=(count, 3)), rng.normal(size=(count, 3)),
        rng.normal(size=(count, 3)), rotation,
    )  # fmt: skip


def random_wrenches(
    count: int = 12, seed: int = 0, force: np.ndarray | None = None, std: float = 1e-2, **kw
) -> Wrenches:
    """Return wrenches of forces [N], world frame, without torques."""
    rng = np.random.default_rng(seed)
    state = windows(count, rng)
    values = np.zeros((count, 6))
    values[:, :3] = rng.normal(0, std, (count, 3)) + (0 if force is None else force)
    covariance = np.tile(std**2 * np.eye(6), (count, 1, 1))
    blocks = kw.pop("block", np.arange(count) // 2)
    found = wrenches(values, covariance, state, blocks, np.ones(count, bool), turned=True, min_visible=0.3)
    return replace(found, **kw)


def test_wrenches_are_the_visible_part_with_torques_in_the_world():
    rng, count = np.random.default_rng(0), 5
    state = windows(count, rng)
    axes = np.linalg.qr(rng.normal(size=(count, 6, 4)))[0]
    state = replace(state, free=axes @ axes.transpose(0, 2, 1))
    force, root = rng.normal(size=(count, 6)), rng.normal(size=(count, 6, 6))
    covariance = root @ root.transpose(0, 2, 1)
    valid = np.array([True, False, True, True, True])
    block = np.array([0, 0, 1, 1, 2])
    found = wrenches(force, covariance, state, block, valid, turned=True, min_visible=0.3)
    for i, k in enumerate([0, 2, 3, 4]):
        change = np.zeros((6, 6))
        change[:3, :3] = np.eye(3)
        change[3:, 3:] = state.rotation[k] / state.size
        seen = state.free[k] @ change @ force[k]
        np.testing.assert_allclose(found.force[i], seen[:3], atol=1e-12)
        np.testing.assert_allclose(found.torque[i], seen[3:] * state.size, atol=1e-12)
        through = state.free[k] @ change
        np.testing.assert_allclose(found.covariance[i], through @ covariance[k] @ through.T, rtol=1e-9)
    assert found.block.tolist() == [0, 1, 1, 2]
    np.testing.assert_array_equal(found.sliding, state.sliding[valid])
    np.testing.assert_array_equal(found.rotation, state.rotation[valid])
    assert (found.size, found.turned, found.min_visible) == (0.05, True, 0.3)
    seen = np.trace(found.free[1, :3, :3])
    assert found.std[1] == pytest.approx(np.sqrt(np.trace(found.covariance[1, :3, :3]) / seen))
    alone = wrenches(force, covariance, state, block, valid, turned=False, min_visible=0.3)
    assert (alone.free[:, 3:] == 0).all()
    assert (alone.free[:, :, 3:] == 0).all()
    assert (alone.torque == 0).all()
    np.testing.assert_array_equal(alone.free[:, :3, :3], state.free[valid][:, :3, :3])
    assert np.ptp(state.free[:, 3:, 3:]) > 0


def test_a_hidden_force_counts_with_the_least_visible_share_and_unknown_ones_as_none():
    w = random_wrenches(4)
    hidden = replace(w, free=np.zeros((4, 6, 6)))
    np.testing.assert_allclose(hidden.std, np.sqrt(3e-4 / 0.3))
    values = np.full((2, 6), np.nan)
    state = windows(2, np.random.default_rng(0))
    found = wrenches(values, np.zeros((2, 6, 6)), state, np.arange(2), np.ones(2, bool), turned=True, min_visible=0.3)
    assert (found.force == 0).all()


def test_windows_are_chosen_and_joined():
    w = random_wrenches(6)
    some = w.only(np.array([True, False, True, False, False, True]))
    np.testing.assert_array_equal(some.force, w.force[[0, 2, 5]])
    np.testing.assert_array_equal(some.block, w.block[[0, 2, 5]])
    both = joined([some, w])
    np.testing.assert_array_equal(both.rotation, np.concatenate([some.rotation, w.rotation]))
    assert (both.size, both.turned) == (w.size, w.turned)


FORCE = np.array([0.2, -0.3, 0.1])


def test_a_force_of_the_world_is_the_weighted_mean_with_its_error():
    w = random_wrenches(force=FORCE)
    scale = np.linspace(0.5, 2, 12)
    w = replace(w, covariance=w.covariance * scale[:, None, None] ** 2)
    found = steady_force(w, CFG)
    assert found is not None
    weight = 1 / w.std**2
    mean = (weight[:, None] * w.force).sum(axis=0) / weight.sum()
    assert found.frame == "world"
    np.testing.assert_allclose(found.vector, mean, rtol=1e-9)
    left = ((w.force - mean) ** 2 * weight[:, None]).sum()
    factor = np.sqrt(max(1.0, left / (36 - 3)))
    assert found.scale == pytest.approx(factor)
    np.testing.assert_allclose(found.std, factor / np.sqrt(weight.sum()), rtol=1e-9)
    total = ((w.force**2) * weight[:, None]).sum()
    assert found.share == pytest.approx(1 - left / total)
    np.testing.assert_allclose(found.steady, np.tile(mean, (12, 1)), rtol=1e-9)
    assert (found.taken, found.test, found.smallest_p, found.p) == (0.0, "sign flips", 1 / 32, 1 / 32)
    np.testing.assert_allclose(found.each, found.steady)


def test_a_force_of_the_body_turns_with_it_and_one_of_the_slip_follows_its_direction():
    w = random_wrenches()
    turned = replace(w, force=w.force + np.einsum("nij,j->ni", w.rotation, FORCE))
    found = steady_force(turned, CFG)
    assert found is not None
    assert found.frame == "body"
    np.testing.assert_allclose(found.vector, FORCE, atol=0.02)
    np.testing.assert_allclose(found.steady, np.einsum("nij,j->ni", w.rotation, found.vector), rtol=1e-9)
    slip = w.sliding / np.linalg.norm(w.sliding, axis=1, keepdims=True)
    found = steady_force(replace(w, force=w.force - 0.4 * slip), CFG)
    assert found is not None
    assert found.frame == "sliding"
    np.testing.assert_allclose(found.vector, [-0.4, 0, 0], atol=0.02)
    assert (found.vector[1:] == 0).all()
    assert (found.std[1:] == 0).all()
    np.testing.assert_allclose(found.steady, found.vector[0] * slip, rtol=1e-9)
    assert found.std[0] == pytest.approx(found.scale * 0.01 / np.sqrt(12))


def test_scatter_that_noise_does_not_explain_counts_in_each_window():
    rng = np.random.default_rng(3)
    w = random_wrenches(force=FORCE)
    w = replace(w, force=w.force + rng.normal(0, 0.05, w.force.shape))
    found = steady_force(w, CFG)
    assert found is not None
    assert found.scale > 2
    assert found.taken == pytest.approx(1 - 1 / found.scale**2)
    np.testing.assert_allclose(found.each, found.steady + found.taken * (w.force - found.steady), rtol=1e-9)


def test_few_blocks_are_tested_against_known_noise():
    w = random_wrenches(force=0.004 * np.ones(3), block=np.arange(12) // 3)
    found = steady_force(w, CFG)
    assert found is not None
    assert (found.test, found.smallest_p) == ("known noise", 0.0)
    slip = w.sliding / np.linalg.norm(w.sliding, axis=1, keepdims=True)
    y = w.force / w.std[:, None]
    square = [
        ((y.sum(axis=0) / np.sqrt(12)) ** 2).sum(),
        ((np.einsum("nji,nj->i", w.rotation, y) / np.sqrt(12)) ** 2).sum(),
        ((slip * y).sum() / np.sqrt(12)) ** 2,
    ]
    best = min(chi2.sf(s / found.scale**2, f) for s, f in zip(square, (3, 3, 1), strict=True))
    assert found.p == pytest.approx(min(1.0, 3 * best), rel=1e-6)
    assert 1e-6 < found.p < 1


def test_a_force_that_contacts_hide_is_not_known():
    w = random_wrenches(force=FORCE)
    assert steady_force(replace(w, free=np.zeros((12, 6, 6))), CFG) is None
    free = np.tile(np.diag([1.0, 1, 0, 1, 1, 1]), (12, 1, 1))
    seen = replace(w, free=free, force=w.force * [1, 1, 0], sliding=np.zeros((12, 3)))
    found = steady_force(seen, CFG)
    assert found is not None
    assert found.frame == "world"
    np.testing.assert_allclose(found.vector, [*FORCE[:2], 0], atol=0.01)
    still = replace(w, sliding=np.zeros((12, 3)), force=0 * w.force)
    quiet = steady_force(still, CFG)
    assert quiet is not None
    assert quiet.share == 0.0


def steady_of(w: Wrenches, vector: np.ndarray, each: np.ndarray | None = None, taken: float = 0.0) -> SteadyForce:
    """Return a steady force in the body's frame."""
    steady = np.einsum("nij,j->ni", w.rotation, vector)
    return SteadyForce(
        "body", vector, np.zeros(3), steady if each is None else each, taken, steady, 1.0, 1.0, 0.01, 0.0, "sign flips"
    )


def pushed(point: np.ndarray, forces: np.ndarray, std: float = 1e-4, seed: int = 0) -> Wrenches:
    """Return wrenches of forces (n, 3) [N], world frame, that act at a point of the body [m]."""
    w = random_wrenches(len(forces), seed, std=std)
    arm = np.einsum("nij,j->ni", w.rotation, point)
    rng = np.random.default_rng(seed + 1)
    torque = np.cross(arm, forces) + rng.normal(0, std, forces.shape)
    return replace(w, force=forces, torque=torque)


def test_the_lever_of_a_force_is_its_torque_about_the_origin():
    rng = np.random.default_rng(0)
    force, point, turn = rng.normal(size=3), rng.normal(size=3), Rotation.random(rng=rng).as_matrix()
    np.testing.assert_allclose(_lever(force, turn) @ point, np.cross(turn @ point, force))


def test_forces_of_several_directions_meet_in_a_point_with_its_error():
    point, rng = np.array([0.01, 0.02, -0.03]), np.random.default_rng(5)
    each = rng.normal(0, 1.0, (12, 3))
    w = pushed(point, each)
    found, axes, std = _line_of_action(w, steady_of(w, FORCE, each))
    np.testing.assert_allclose(found, point, atol=2e-4)
    normal, right, square = np.zeros((3, 3)), np.zeros(3), 0.0
    for k in range(12):
        rows, seen = _lever(each[k], w.rotation[k]) / 1e-4, w.torque[k] / 1e-4
        normal, right, square = normal + rows.T @ rows, right + rows.T @ seen, square + seen @ seen
    expected = np.linalg.solve(normal, right)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    left = square - right @ expected
    known = np.sqrt(max(1.0, left / 33)) / np.sqrt(np.linalg.eigvalsh(normal))
    np.testing.assert_allclose(std, known, rtol=1e-6)
    np.testing.assert_allclose(axes.T @ normal @ axes, np.diag(np.linalg.eigvalsh(normal)), atol=1e-3)


def test_a_steady_force_leaves_the_place_along_its_line_open():
    point = np.array([0.01, 0.02, -0.03])
    w = random_wrenches(12)
    each = np.einsum("nij,j->ni", w.rotation, FORCE)
    w = pushed(point, each)
    found, axes, std = _line_of_action(w, steady_of(w, FORCE))
    assert np.isinf(std).sum() == 1
    along = axes[:, np.isinf(std)][:, 0]
    assert abs(along @ FORCE) == pytest.approx(np.linalg.norm(FORCE))
    known = axes[:, np.isfinite(std)]
    np.testing.assert_allclose(known.T @ (found - point), 0, atol=1e-4)
    shaken = each + 1e-4 * np.random.default_rng(0).normal(size=each.shape)
    _, _, certain = _line_of_action(w, steady_of(w, FORCE, shaken, taken=1.0))
    assert np.isinf(certain).sum() == 1


def test_contacts_that_hide_torques_leave_all_open():
    w = pushed(np.zeros(3), np.tile(FORCE, (12, 1)))
    free = w.free.copy()
    free[:, 3:], free[:, :, 3:] = 0, 0
    _, _, std = _line_of_action(replace(w, free=free, covariance=w.covariance * 0), steady_of(w, FORCE))
    assert np.isinf(std).all()


BLOCK = """<mujoco><worldbody><body name="block"><freejoint/>
  <geom type="box" size=".04 .03 .02" pos=".01 0 0" mass=".2"/></body></worldbody></mujoco>"""


def placed(point, vector, *, touches=None, slides=None, w=None, cfg=PLACE):
    """Return where a steady force in the body's frame at a point of a block is found."""
    model = Model(Scene(BLOCK))
    m = model.compile()
    vector = np.array(vector, float)
    if w is None:
        turned = random_wrenches(12)
        w = pushed(np.array(point, float), np.einsum("nij,j->ni", turned.rotation, vector))
    if slides is not None:
        w = replace(w, sliding=slides)
    return force_place(model, m, 1, w, steady_of(w, vector), touches or [{}] * len(w.force), cfg), w


def test_a_push_is_placed_where_its_line_meets_the_face_that_it_presses():
    found, _ = placed([0.05, 0.01, -0.005], [-1.0, 0, 0])
    assert found is not None
    np.testing.assert_allclose(found.point, [0.05, 0.01, -0.005], atol=2e-3)
    np.testing.assert_allclose(found.normal, [1, 0, 0], atol=0.05)
    assert (found.face, found.hidden, found.off, found.against) == ("+x face", (), 0.0, None)
    assert not found.through_center
    assert (found.std < 0.01).all()
    pull, _ = placed([0.05, 0.025, -0.005], [1.0, 0, 0])
    assert pull is not None
    assert pull.face == "-x face, near its +y edge"
    np.testing.assert_allclose(pull.point, [-0.03, 0.025, -0.005], atol=2e-3)


def test_a_push_through_the_centre_of_mass_is_reported_to_be():
    found, _ = placed([0.05, 0.0, 0.0], [-1.0, 0, 0])
    assert found is not None
    assert found.through_center


def test_the_distance_of_a_line_that_misses_the_body_is_reported():
    found, _ = placed([0.0, 0.0, 0.08], [-1.0, 0, 0])
    assert found is not None
    low, high = np.array([-0.03, -0.03, -0.02]), np.array([0.05, 0.03, 0.02])
    spacing = np.linalg.norm(high - low) / 60
    assert found.off == pytest.approx(0.06 - spacing, abs=2e-3)


def test_without_torques_there_is_no_place():
    w = random_wrenches(12, turned=False)
    assert placed([0, 0, 0], [1.0, 0, 0], w=w)[0] is None


def touching(point, normal, count=12, name="world", noise=0.0):
    """Return contacts at a point of the body in some windows."""
    rng = np.random.default_rng(0)
    return [
        {name: Touch(np.array(point) + noise * rng.normal(size=3), np.array(normal, float), 1.0)} for _ in range(count)
    ]


def test_a_force_along_the_slip_or_the_normal_of_a_contact_is_put_there():
    turned = random_wrenches(12)
    vector = np.array([0, 1.0, 0])
    each = np.einsum("nij,j->ni", turned.rotation, vector)
    bottom = [0.01, 0.0, -0.02]
    found, _ = placed(bottom, vector, touches=touching(bottom, [0, 0, 1]), slides=-each)
    assert found is not None
    assert (found.against, found.face, found.hidden) == ("world", "-z face", ())
    np.testing.assert_allclose(found.point, bottom, atol=1e-9)
    np.testing.assert_allclose(found.normal, [0, 0, -1])
    across, _ = placed(bottom, vector, touches=touching(bottom, [0, 0, 1]), slides=turned.sliding)
    assert across is not None
    assert across.against is None
    side = [0.01, -0.03, 0.0]
    found, _ = placed(side, vector, touches=touching(side, [0, 1, 0]), slides=turned.sliding)
    assert found is not None
    assert (found.against, found.face) == ("world", "-y face")


def test_of_contacts_the_nearest_to_the_line_counts_where_it_lasts_half_the_windows():
    w, known = random_wrenches(4), np.eye(3)
    steady = steady_of(w, np.array([0, 0, 1.0]))
    up = np.array([0, 0, 1.0])
    near, far = Touch(np.array([0.001, 0, 0]), up, 1.0), Touch(np.array([0.0015, 0, 0]), up, 1.0)

    def against(touches, point=(0.0, 0.0, 0.0), std=0.0):
        return _at_contact(w, steady, touches, np.array(point), known, np.full(3, std), up, PLACE)

    found = against([{"a": far, "b": near}] * 4)
    assert found is not None
    assert found[0] == "b"
    np.testing.assert_allclose(found[1], near.point)
    np.testing.assert_allclose(found[2], up)
    np.testing.assert_allclose(found[3], 0)
    assert against([{"a": near}, {}, {}, {}]) is None
    half = against([{"a": near}, {}, {"a": far}, {}])
    assert half is not None
    np.testing.assert_allclose(half[1], [0.00125, 0, 0])
    np.testing.assert_allclose(half[3], [0.00025, 0, 0], atol=1e-12)
    assert against([{"a": near}] * 4, (0.0031, 0, 0)) is None
    assert against([{"a": near}] * 4, (0.0029, 0, 0)) is not None
    assert against([{"a": near}] * 4, (0.0059, 0, 0), 0.001) is not None
    assert against([{"a": near}] * 4, (0.0061, 0, 0), 0.001) is None
    tilted = Touch(near.point, np.array([np.sin(0.5), 0, np.cos(0.5)]), 1.0)
    assert against([{"a": tilted}] * 4) is None


def test_points_on_a_surface_are_of_its_shapes_its_spheres_or_the_box_about_it(monkeypatch):
    model = Model(Scene(BLOCK))
    m = model.compile()
    points, normals = _surface_points(model, m, 1, 500)
    offsets = np.abs(points - [0.01, 0, 0]) - [0.04, 0.03, 0.02]
    np.testing.assert_allclose(offsets.max(axis=1), 0, atol=1e-9)
    assert (np.abs(normals).max(axis=1) > 0.99).all()

    def refuse(*_: Any) -> None:
        raise SceneError("not closed")

    monkeypatch.setattr(Surface, "of_body", refuse)
    bare, name = model, "block"
    points, normals = _surface_points(bare, bare.compile(), 1, 600)
    low, high = extent(bare.compile(), 1)
    half = (high - low) / 2
    place = (points - (low + high) / 2) / half
    axis = np.abs(normals).argmax(axis=1)
    np.testing.assert_allclose(np.abs(normals).sum(axis=1), 1)
    np.testing.assert_allclose(place[np.arange(600), axis], normals[np.arange(600), axis])
    assert set(axis) == {0, 1, 2}
    assert np.abs(place).max() <= 1 + 1e-12
    assert (np.abs(place) < 0.99).any(axis=0).all()
    centres = np.array([[0, 0, 0], [0.03, 0, 0]])
    spheres = ContactGeometry(
        (name,), np.zeros(2, int), centres, np.array([0.02, 0.03]), np.full(2, 0.5), np.full(2, 0.3)
    )
    points, normals = _surface_points(bare.with_geometry(spheres), bare.compile(), 1, 600)
    gap = np.linalg.norm(points[:, None] - centres, axis=2) - [0.02, 0.03]
    assert 300 < len(points) < 600
    np.testing.assert_allclose(gap.min(axis=1), 0, atol=1e-9)
    owner = gap.argmin(axis=1)
    np.testing.assert_allclose(points - centres[owner], normals * np.array([0.02, 0.03])[owner][:, None], atol=1e-9)
    assert set(owner) == {0, 1}


@pytest.mark.parametrize(
    ("place", "normal", "hidden", "words"),
    [
        ((0.9, -0.9, 0.9), (0, 0, -1), (), "-z face, near its +x -y corner"),
        ((0.9, -0.9, 0.9), (0, 0, -1), ("y",), "-z face, near its +x edge"),
        ((0.76, 0.0, 0.9), (0, -1, 0), (), "-y face, near its +x +z corner"),
        ((0.74, 0.0, -0.76), (0, 2, 0), (), "+y face, near its -z edge"),
        ((0.0, 0.0, 0.0), (1, 0, 0), (), "+x face"),
        ((0.0, 0.0, 0.0), (0.71, 0.70, 0), (), "+x face"),
        ((0.0, 0.0, 0.0), (0.6, 0.58, 0.55), (), "its surface"),
        ((0.0, 0.0, 0.0), (0, 0, 0), (), "its surface"),
    ],
)
def test_faces_are_named_by_their_normal_and_edges(place, normal, hidden, words):
    assert _face_words(np.array(place, float), np.array(normal, float), hidden, 0.75) == words


def test_a_place_is_plain_in_json():
    found, _ = placed([0.05, 0.01, -0.005], [-1.0, 0, 0])
    assert found is not None
    document = found.to_json()
    assert document["point"] == found.point.tolist()
    assert document["hidden"] == []
    assert document["face"] == "+x face"
    assert set(document) == {"point", "std", "normal", "face", "hidden", "off", "against", "through_center"}
