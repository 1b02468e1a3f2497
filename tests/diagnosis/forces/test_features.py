"""Features of unexplained forces, what they depend on, and figures over several joints, against formulas."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from concent_warp.diagnosis.forces import features
from concent_warp.diagnosis.forces.body_forces import _projected, _spans_of
from concent_warp.diagnosis.forces.cfg import DependenceCfg, FeatureCfg, LocateForcesCfg
from concent_warp.diagnosis.forces.contact_state import (
    BodyWindows,
    _body_size,
    _free_motions,
    _lasting_share,
    _moved_by_joints,
    _speed_at,
    extent,
)
from concent_warp.diagnosis.forces.dependence import (
    Dependences,
    _correlation,
    _explains_as_much,
    _slope_of,
    blocks_of,
    dependences,
    flips,
    min_share,
)
from concent_warp.diagnosis.forces.features import (
    _contact_shares,
    _varies,
    body_force_features,
    body_torque_features,
    joint_features,
)
from concent_warp.diagnosis.forces.locate import (
    _all_bodies,
    _all_joints,
    _detectable,
    _holm,
    _joint_force,
    _root_mean_square,
)
from concent_warp.diagnosis.forces.window_forces import INSTANT_WEIGHTS, INSTANTS, Windows
from concent_warp.simulate.engine import ContactLog

CFG = LocateForcesCfg()
NOTHING = Dependences((), ())


def windows(count: int, **changes: Any) -> Windows:
    """Return windows of 0.1 s that overlap by half, of two degrees of freedom."""
    empty = np.zeros(0, int)
    log = ContactLog(empty, empty, np.zeros((0, 2), int), np.zeros((0, 3)), np.zeros((0, 3)), empty, np.zeros((0, 3)))
    base = Windows(
        "d0", 0.05 * np.arange(count), 0.1, np.zeros((count, 2)), np.zeros((count, 2)), np.zeros((2, count, 2)),
        np.zeros((count, 2)), np.zeros((count, 2, 2)), log, np.zeros((count, 11, 2)),
    )  # fmt: skip
    return replace(base, **changes)


def test_spans_are_runs_of_windows():
    chosen = np.array([True, True, False, True, False, False, True])
    spans = _spans_of(windows(7), chosen)
    assert [name for name, _, _ in spans] == ["d0"] * 3
    assert [pytest.approx(times) for _, *times in spans] == [[0.0, 0.15], [0.15, 0.25], [0.3, 0.4]]
    assert _spans_of(windows(7), np.zeros(7, bool)) == []


def test_features_are_seen_where_contacts_leave_them_visible():
    sight = np.array([np.diag([1.0, 0, 1]), np.eye(3)])
    found = _projected(sight, [{"a": np.ones((1, 3))}, {"a": 2 * np.ones((1, 3))}])
    np.testing.assert_array_equal(found["a"], [[1, 0, 1], [2, 2, 2]])


def test_hypotheses_are_rejected_one_after_the_other():
    assert _holm([0.01, 0.04, 0.02], 0.05) == [True, True, True]
    assert _holm([0.01, 0.04, 0.03], 0.05) == [True, False, False]
    assert _holm([0.02, 0.9], 0.05) == [True, False]
    assert _holm([0.03, 0.03], 0.05) == [False, False]
    assert _holm([0.05], 0.05) == [True]
    assert _holm([], 0.05) == []


def test_the_smallest_detectable_force_is_so_many_errors_of_the_mean_or_a_share_of_the_square():
    std = np.array([0.1, 0.2, 0.2, 0.1])
    mean = 1 / np.sqrt((1 / std**2).sum())
    assert _detectable(std, 0.1, 3.0) == pytest.approx(3 * mean)
    assert _detectable(std, 0.9, 3.0) == pytest.approx(np.sqrt(9 * 4) * mean)
    assert np.isnan(_detectable(np.zeros(0), 0.1, 3.0))
    assert _root_mean_square(np.array([3.0, 4.0])) == pytest.approx(np.sqrt(12.5))
    assert np.isnan(_root_mean_square(np.zeros(0)))


def test_joints_and_bodies_of_all_demonstrations_are_listed_once():
    def motion(joints, bodies) -> Any:
        return SimpleNamespace(
            joints=[SimpleNamespace(name=n, unit=u, dof=d) for n, u, d in joints],
            bodies=[SimpleNamespace(name=n) for n in bodies],
        )

    motions = [motion([("b", "m", 1)], ["y", "x"]), motion([("a", "rad", 0), ("b", "m", 1)], ["x", "z"])]
    assert _all_joints(motions) == [("a", "N m", 0), ("b", "N", 1)]
    assert _all_bodies(motions) == ["y", "x", "z"]


def test_force_of_a_joint_is_taken_together_over_demonstrations():
    rng, count = np.random.default_rng(0), 30
    parts, tables, contact = [], [], 0.2
    for k in range(3):
        force, covariance = rng.normal(0, 0.1, (count, 2)), np.tile(np.diag([1.0, 0.01]), (count, 1, 1))
        force[0, 1], covariance[1, 1, 1] = np.nan, 0.0
        parts.append(windows(count, demonstration=f"d{k}", force=force, covariance=covariance))
        table = {"x": rng.normal(size=(count, 1)), features.CONTACT: np.full((count, 1), contact)}
        tables.append({"b": table | ({"only here": np.ones((count, 1))} if k == 0 else {})} if k < 2 else {})
    found = _joint_force("b", "N", 1, parts, tables, CFG)
    force = np.concatenate([p.force[:, 1] for p in parts[:2]])
    valid = np.isfinite(force) & (np.arange(60) % count != 1)
    assert found.rms == pytest.approx(np.sqrt(np.mean(force[valid] ** 2)))
    assert found.noise == pytest.approx(0.1)
    assert found.ratio == pytest.approx(found.rms / 0.1)
    assert found.detectable == pytest.approx(_detectable(np.full(56, 0.1), 0.25, 3.0))
    assert {d.feature for d in found.dependences.all} == {"x", features.CONTACT}
    assert [s.demonstration for s in found.series] == ["d0", "d1"]
    np.testing.assert_array_equal(found.series[1].force, parts[1].force[:, 1])
    np.testing.assert_allclose(found.series[1].time, parts[1].start + 0.05)
    table = {n: np.concatenate([t["b"][n] for t in tables[:2]]) for n in ("x", features.CONTACT)}
    std = np.concatenate([p.std[:, 1] for p in parts[:2]])
    blocks = blocks_of([count, count], CFG.dependence)
    assert found.dependences == dependences(force[:, None], std, table, blocks, 0, CFG.dependence, in_contact=True)
    assert found.p == found.dependences.p
    rare = [{"b": {**t["b"], features.CONTACT: np.full((count, 1), 0.05)}} if t else {} for t in tables]
    assert _joint_force("b", "N", 1, parts, rare, CFG).detectable == pytest.approx(
        _detectable(np.full(56, 0.1), 0.1, 3.0)
    )


def test_slopes_have_the_scatter_between_blocks():
    rng = np.random.default_rng(1)
    x, block = rng.normal(size=20), np.repeat(np.arange(5), 4)
    y = 0.7 * x + rng.normal(0, 0.1, 20)
    slope, std = _slope_of(y, x, block)
    assert slope == pytest.approx((x @ y) / (x @ x))
    left = x * (y - slope * x)
    scores = np.array([left[block == b].sum() for b in range(5)])
    assert std == pytest.approx(np.sqrt((scores**2).sum() * 5 / 4) / (x @ x))
    assert _slope_of(y[:4], x[:4], block[:4])[1] == pytest.approx(0, abs=1e-12)
    assert _correlation(y, x) == pytest.approx((x @ y) / np.linalg.norm(x) / np.linalg.norm(y))
    assert _correlation(y, 0 * x) == 0.0


def test_a_feature_explains_as_much_within_the_scatter_between_blocks():
    rng = np.random.default_rng(2)
    x, block = rng.normal(size=40), np.repeat(np.arange(10), 4)
    y = x + rng.normal(0, 0.5, 40)
    other = x + rng.normal(0, 0.4, 40)
    left = [y - z * (z @ y) / (z @ z) for z in (x, other)]
    gain = np.array([((left[1] ** 2 - left[0] ** 2)[block == b]).sum() for b in range(10)])
    errors = gain.sum() / (np.sqrt(10) * gain.std(ddof=1))
    assert errors > 0
    assert _explains_as_much(y, x, other, block, errors * 1.001)
    assert not _explains_as_much(y, x, other, block, errors * 0.999)
    assert not _explains_as_much(y, x, 0 * x, block, 1e9)
    assert _explains_as_much(y, x, other, 0 * block, 0.0)


def test_flips_are_all_of_them_or_random_ones_after_the_unflipped():
    cfg = replace(DependenceCfg(), exact_blocks=3, flips=7)
    exact = flips(3, np.random.default_rng(0), cfg)
    np.testing.assert_array_equal(exact, [[1, 1, 1], [-1, 1, 1], [1, -1, 1], [-1, -1, 1]])
    drawn = flips(4, np.random.default_rng(0), cfg)
    assert drawn.shape == (8, 4)
    np.testing.assert_array_equal(drawn[1:], np.random.default_rng(0).choice([-1.0, 1.0], size=(7, 4)))


def test_blocks_have_lengths_between_two_bounds():
    cfg = replace(DependenceCfg(), wanted_blocks=4, min_windows_per_block=2, max_windows_per_block=5)
    assert blocks_of([12], cfg).tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3]
    assert np.bincount(blocks_of([100], cfg)).tolist() == [5] * 20
    assert blocks_of([5], cfg).tolist() == [0, 0, 0, 1, 1]
    assert blocks_of([1, 0, 3], cfg).tolist() == [0, 2, 2, 3]
    assert blocks_of([], cfg).tolist() == []
    assert (min_share(cfg, False), min_share(cfg, True)) == (0.1, 0.25)


def test_dependences_leave_out_what_is_unknown_and_constant_zero():
    rng, count = np.random.default_rng(3), 40
    x = rng.normal(size=(count, 1))
    force, std = 2 * x + rng.normal(0, 0.1, (count, 1)), np.full(count, 0.1)
    std[0], force[1] = 0.0, np.nan
    blocks = np.arange(count) // 4
    hole = x.copy()
    hole[5] = np.nan
    found = dependences(force, std, {"x": x, "zero": 0 * x, "hole": hole}, blocks)
    assert [d.feature for d in found.all] == ["x"]
    kept = slice(2, None)
    first = found.all[0]
    assert first.correlation == pytest.approx(_correlation(force[kept, 0], x[kept, 0]))
    assert first.slope == pytest.approx((force[kept, 0] @ x[kept, 0]) / (x[kept, 0] @ x[kept, 0]))
    assert first.slope_std == pytest.approx(_slope_of(force[kept, 0], x[kept, 0], blocks[kept])[1], rel=1e-6)
    assert first.p == pytest.approx(1 / 512)
    assert found.patterns[0].smallest_p == pytest.approx(1 / 512)
    assert found.patterns[0].share == pytest.approx(found.all[0].correlation ** 2)
    assert dependences(force, std, {"x": x}, np.arange(count) // 10) == NOTHING
    assert NOTHING.p == 1.0


def test_speeds_at_a_contact_are_without_what_is_along_the_normal():
    up = np.array([0, 0, 1.0])
    velocity, spin, point = np.array([0.3, 0, 0.4]), np.array([0, 2.0, 5.0]), np.array([0, 0, -0.1])
    travel, slip = _speed_at(velocity, spin, point, up, 0.02)
    assert travel == pytest.approx(0.5)
    assert slip == pytest.approx(np.hypot(0.3 - 0.2, 5 * 0.02))


def test_lasting_contacts_have_short_interruptions_only():
    assert _lasting_share(np.array([2, 3, 6]), 10, 2) == pytest.approx(0.7)
    assert _lasting_share(np.array([2, 3, 6]), 10, 1) == pytest.approx(0.3)
    assert _lasting_share(np.array([2, 3, 6]), 10, 3) == 1.0


def test_contacts_constrain_motions_along_their_mean_push():
    push = np.zeros((4, 6))
    push[:, 2] = [1.0, 1.0, 0, 0]
    push[2:, 0] = 0.3
    assert np.diag(_free_motions(push, 4, 0.4)) == pytest.approx([1, 1, 0, 1, 1, 1])
    assert np.diag(_free_motions(push, 4, 0.04)) == pytest.approx([0, 1, 0, 1, 1, 1])
    assert np.diag(_free_motions(push, 4, 0.6)) == pytest.approx([1] * 6)


BODIES = """<mujoco><worldbody><geom type="plane" size="1 1 .1"/><body name="fixed"><geom size=".1"/></body>
  <body name="base"><geom size=".1"/><body name="link"><joint/><geom size=".1"/>
    <body name="tip"><geom size=".1"/></body>
  </body></body>
  <body name="block"><freejoint/><geom type="box" size=".1 .2 .3" pos=".1 0 0" euler="0 0 90"/>
    <geom size=".05" pos="0 .5 0"/><body name="part"><joint/><geom size=".1"/></body></body>
  <body name="slider"><joint type="slide"/><geom size=".1"/></body><body name="frame"/></worldbody></mujoco>"""


def test_robots_are_distinguished_from_free_and_fixed_bodies():
    m = mujoco.MjModel.from_xml_string(BODIES)
    moved = {m.body(b).name for b in range(1, m.nbody) if _moved_by_joints(m, b)}
    assert moved == {"link", "tip", "slider"}


def test_extent_is_the_box_about_the_geoms_of_a_body():
    m = mujoco.MjModel.from_xml_string(BODIES)
    low, high = extent(m, m.body("block").id)
    np.testing.assert_allclose([low, high], [[-0.1, -0.1, -0.3], [0.3, 0.55, 0.3]], atol=1e-9)
    assert _body_size(m, m.body("block").id) == pytest.approx((0.4 + 0.65 + 0.6) / 6)
    np.testing.assert_array_equal(extent(m, m.body("frame").id), np.zeros((2, 3)))
    assert _body_size(m, m.body("frame").id) == 1e-3


def states(count: int) -> BodyWindows:
    """Return random windows of a body."""
    rng = np.random.default_rng(0)
    phases = np.array(["free", "pushed", "slide", "grasped"] * count, dtype=object)[:count]
    vectors = rng.normal(size=(4, count, 3))
    turns, free = rng.normal(size=(count, 3, 3)), np.zeros((count, 6, 6))
    return BodyWindows(phases, (), free, 0.1, vectors[0], vectors[1], vectors[2], vectors[3], turns)


def test_features_of_bodies_are_vectors_in_the_world():
    state, acceleration = states(4), np.arange(12.0).reshape(4, 3)
    found = body_force_features(state, acceleration, "block")
    speed = np.linalg.norm(state.velocity, axis=1, keepdims=True)
    np.testing.assert_array_equal(found[features.SLIDING], state.heading)
    np.testing.assert_array_equal(found[features.SPEED], state.velocity)
    np.testing.assert_allclose(found[features.DRAG], state.velocity * speed)
    np.testing.assert_array_equal(found[features.ACCELERATION], acceleration * [[0], [1], [0], [1]])
    turning = body_torque_features(state, "block")
    rate = np.linalg.norm(state.spin, axis=1, keepdims=True)
    np.testing.assert_allclose(turning["direction of turning"], state.spin / np.sqrt(rate**2 + 0.01))
    np.testing.assert_array_equal(turning["angular velocity"], state.spin)
    for table in (found, turning):
        for i, axis in enumerate("xyz"):
            np.testing.assert_array_equal(table[f"world {axis}"], np.tile(np.eye(3)[i], (4, 1)))
            np.testing.assert_array_equal(table[f"block {axis}"], state.rotation[:, :, i])


def test_a_feature_varies_beyond_rounding():
    assert _varies(features.CONSTANT, np.ones(3))
    assert not _varies("x", np.ones(3))
    assert not _varies("x", np.zeros(3))
    assert not _varies("x", np.array([1.0, 1.0 + 5e-7]))
    assert _varies("x", np.array([1.0, 1.0 + 2e-6]))


ARM = """<mujoco><option timestep=".01"/><worldbody><geom name="floor" type="plane" size="1 1 .1"/>
  <body name="upper" gravcomp=".25"><joint name="a" axis="0 1 0" damping=".3" frictionloss=".1"/>
    <geom size=".05" mass="1.5" pos=".1 0 0"/>
    <body pos=".2 0 0"><joint name="b" axis="0 1 0"/><geom size=".05" mass=".5" pos=".1 0 0"/></body></body>
</worldbody><actuator><position joint="a" kp="30" kv="2"/><position joint="b" kp="9" kv="1"/></actuator></mujoco>"""


def test_a_contact_counts_for_the_joints_that_carry_it():
    m = mujoco.MjModel.from_xml_string(ARM)
    log = ContactLog(
        np.array([0, 0, 0, 2, 2]), np.array([1, 1, 4, 2, 3]), np.array([[0, 1], [0, 2], [0, 2], [0, 2], [0, 1]]),
        np.zeros((5, 3)), np.zeros((5, 3)), np.zeros(5), np.zeros((5, 3)),
    )  # fmt: skip
    found = _contact_shares(m, windows(3, contacts=log))
    np.testing.assert_allclose(found, [[0.2, 0.2], [0, 0], [0.2, 0.1]])
    assert (_contact_shares(m, windows(3)) == 0).all()


def test_features_of_joints_are_weighted_means_over_each_window():
    m = mujoco.MjModel.from_xml_string(ARM)
    count, cfg = 6, FeatureCfg(rate_step=0.018)  # nearly two steps
    ctrl = np.random.default_rng(0).normal(0, 0.3, (40, 2))

    def path(time):
        return np.stack([np.sin(9 * time), 0.3 * np.cos(7 * time)], 1), np.stack([9 * np.cos(9 * time), -2 * time], 1)

    def state(time):
        qpos, qvel = path(time)
        return SimpleNamespace(qpos=qpos, qvel=qvel, qacc=np.stack([time**2, np.cos(time)], axis=1))

    std = np.array([0.4, 0.1])
    joints = [
        SimpleNamespace(
            name=n, dof=i, qpos=i,
            position=SimpleNamespace(covariance=lambda t, s=std[i]: np.tile(np.diag([9.0, s**2, 9.0]), (len(t), 1, 1))),
        )
        for i, n in enumerate("ab")
    ]  # fmt: skip
    motion: Any = SimpleNamespace(compiled=m, states=state, ctrl=ctrl, joints=joints)
    found = joint_features(windows(count), motion, cfg)
    d = mujoco.MjData(m)
    instants = (0.05 * np.arange(count)[:, None] + 0.1 * INSTANTS).ravel()
    qpos, qvel = path(instants)
    drive, rate, load = (np.zeros((len(instants), 2)) for _ in range(3))
    for k, t in enumerate(instants):
        now = int(t / 0.01)
        forces = []
        for row in (max(now - 2, 0), now):
            error = ctrl[row] - qpos[k]
            forces.append(np.array([30, 9]) * error - np.array([2, 1]) * qvel[k])
        drive[k], rate[k] = forces[1], (forces[1] - forces[0]) / 0.02
        d.qpos[:], d.qvel[:] = qpos[k], 0
        mujoco.mj_forward(m, d)
        load[k] = d.qfrc_bias - d.qfrc_gravcomp

    def mean(values):
        return values.reshape(count, 5) @ INSTANT_WEIGHTS

    for i, name in enumerate("ab"):
        v = qvel[:, i]
        direction = v / np.sqrt(v**2 + (2 * std[i]) ** 2)
        slow, size = np.percentile(np.abs(v), 25), np.abs(drive[:, i])
        expected = {
            features.DIRECTION: direction,
            features.SLOW: direction * np.exp(-((v / slow) ** 2)),
            features.LIMIT: np.sign(drive[:, i]) * np.maximum(size - 0.75 * size.max(), 0),
            features.SPEED: v,
            features.ACCELERATION: state(instants).qacc[:, i],
            features.LOADED: direction * np.abs(load[:, i]),
            features.GRAVITY: load[:, i],
            features.DRIVE: drive[:, i],
            features.COMMAND_RATE: rate[:, i],
            features.POSITION: qpos[:, i] - qpos[:, i].mean(),
            features.CONSTANT: np.ones(len(instants)),
        }
        assert set(found[name]) == set(expected)
        for feature, values in expected.items():
            np.testing.assert_allclose(found[name][feature][:, 0], mean(values), rtol=1e-6, atol=1e-9, err_msg=feature)
