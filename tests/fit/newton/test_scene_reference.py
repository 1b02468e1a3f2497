"""A scene for Newton, and its worlds, against loops and MuJoCo's own figures."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from concent_warp.errors import EngineError, ModelError
from concent_warp.estimation.object_tracks import BodyTarget, Segment
from concent_warp.fit.newton import scene as of_scene
from concent_warp.fit.newton import worlds as of_worlds
from concent_warp.fit.newton.loss import NewtonLoss, mujoco_loss
from concent_warp.fit.newton.physics import NewtonCfg, coupling
from concent_warp.fit.newton.scene import (
    _inertia_of,
    _moving_bodies,
    _near_pairs,
    _padded_commands,
    _pair_states,
    _resampled,
    _strength,
    _touches,
    _velocity_of,
    newton_scene,
)
from concent_warp.fit.newton.worlds import NAMES, NewtonWorlds, Parameters
from concent_warp.model import ContactParameters, Model
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

TEXT = """
<mujoco>
  <option timestep="0.002" cone="elliptic"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" friction="0.3"/>
    <geom name="post" type="capsule" pos="0.06 0.016 0.02" size="0.01 0.02" friction="0.6"/>
    <geom name="ball" type="sphere" pos="-0.06 0.016 0.036" size="0.012" friction="0.7" priority="2"/>
    <body name="pusher" pos="0 -0.05 0.02">
      <joint name="slide" type="slide" axis="0 1 0"/>
      <geom name="pusher" type="box" pos="0 0.01 0" quat="0.8 0 0 0.6" size="0.03 0.01 0.01" mass="0.3" friction="0.5"/>
    </body>
    <body name="first" pos="0 0 0.0198">
      <freejoint/>
      <inertial pos="0.003 -0.002 0.001" mass="0.08" quat="0.9 0.1 0.2 0.3" diaginertia="3e-5 2.5e-5 2e-5"/>
      <geom name="first" type="box" size="0.02 0.02 0.02" friction="0.4"/>
    </body>
    <body name="second" pos="0 0.041 0.0298">
      <freejoint/>
      <inertial pos="0 0 0" mass="0.05" diaginertia="1.5e-5 1.5e-5 1.5e-5"/>
      <geom name="second" type="box" size="0.02 0.02 0.02" friction="0.8"/>
    </body>
  </worldbody>
  <actuator><position name="drive" joint="slide" kp="500" kv="20"/></actuator>
</mujoco>"""
"""A pusher with two free boxes before it, between a post and a ball."""


def corners(half: float) -> np.ndarray:
    return np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * half


@pytest.fixture(scope="module")
def model() -> Model:
    position = np.concatenate([corners(0.016), corners(0.016)])
    rng = np.random.default_rng(0)
    geometry = ContactGeometry(
        ("first", "second"), np.repeat([0, 1], 8), position, np.full(16, 0.004), np.full(16, 0.01),
        rng.uniform(0.3, 0.6, 16),
    )  # fmt: skip
    return Model(Scene(TEXT), geometry, ContactParameters(condim=3))


def segment(model: Model, name: str, steps: int, seed: int) -> Segment:
    m, rng = model.scene.model, np.random.default_rng(seed)
    qpos, qvel = m.qpos0.copy(), rng.normal(0, 0.05, m.nv)
    qpos[4:8] = Rotation.from_rotvec([0, 0, 0.1 * seed]).as_quat(scalar_first=True)
    time = 0.008 * np.arange(steps // 4 + 1)
    anchor = rng.normal(0, 0.01, (6, 3))
    targets = tuple(
        BodyTarget(body, anchor, time, anchor + place + rng.normal(0, 1e-4, (len(time), 6, 3)))
        for body, place in (("first", [0, 0, 0.02]), ("second", [0, 0.041, 0.03]))
    )
    return Segment(name, qpos, qvel, np.linspace(0, 0.01 * seed, steps)[:, None], targets)


@pytest.fixture(scope="module")
def segments(model) -> list[Segment]:
    return [segment(model, "one", 24, 1), segment(model, "two", 16, 2)]


@pytest.fixture(scope="module")
def scene(model, segments):
    return newton_scene(model, segments, NewtonCfg(shortest_step=2e-5), lightest=0.8)


def test_a_scene_is_the_mujoco_rollout_with_free_bodies_left_out(scene, model, segments):
    m = scene.rollout
    assert scene.bodies[:2] == ("first", "second")
    assert set(scene.bodies[2:]) == {"world", "pusher"}
    assert [b.name for b in scene.moving] == ["first", "second"]
    ids = [m.bodies.index(name) for name in scene.bodies]
    np.testing.assert_array_equal(scene.start[:, :, :3], m.body_position[:, 0][:, ids])
    np.testing.assert_array_equal(scene.start[:, :, 3:], m.body_quaternion[:, 0][:, ids][..., [1, 2, 3, 0]])
    substeps, dt = scene.physics.substeps, model.scene.model.opt.timestep
    assert scene.steps == 24 * substeps
    assert scene.physics.timestep == pytest.approx(dt / substeps)
    np.testing.assert_allclose(scene.replayed[::substeps, :, :, :3], m.body_position[:, :, ids[2:]].swapaxes(0, 1))
    np.testing.assert_array_equal(scene.gravity, [0, 0, -9.81])
    np.testing.assert_array_equal(scene.start_velocity[:, 2:], scene.replayed_velocity[0])
    assert scene.replayed.shape[1:3] == (2, 2)
    compiled = model.compile()
    for n, one in enumerate(segments):
        for b, name in enumerate(("first", "second")):
            body = compiled.body(name).id
            expected = _velocity_of(compiled, one.qvel, body, scene.start[n, b], scene.moving[b])
            if name == "second":  # in the air
                expected[2] -= 9.81 * (dt - scene.physics.timestep) / 2
            np.testing.assert_allclose(scene.start_velocity[n, b], expected, atol=1e-12)


def test_the_physics_holds_for_the_lightest_body(model, segments, scene):
    plain = newton_scene(model, segments, NewtonCfg(shortest_step=2e-5))
    assert scene.physics.friction_slope == pytest.approx(0.8 * plain.physics.friction_slope) or (
        scene.physics.substeps != plain.physics.substeps
    )
    rule = scene.physics.timestep * scene.physics.friction_slope
    strengths = [_strength(model.compile(), model, model.compile().body(b.name).id, b, scene.rollout, NewtonCfg())
                 for b in scene.moving]  # fmt: skip
    assert rule * max(strengths) / 0.8 == pytest.approx(0.8)


def test_friction_counts_of_spheres_and_of_other_shapes(model, segments, monkeypatch):
    seen: list[Any] = []
    plain = of_scene.choose_physics

    def choose(*given: Any) -> Any:
        seen.append(given)
        return plain(*given)

    monkeypatch.setattr(of_scene, "choose_physics", choose)
    newton_scene(model, segments[:1], NewtonCfg(shortest_step=2e-5))
    cfg, timestep, bodies, couplings, friction, gravity = seen[0]
    assert (timestep, len(bodies), len(couplings), gravity) == (0.002, 2, 2, pytest.approx(9.81))
    assert cfg.shortest_step == 2e-5
    assert friction in (0.7, 0.6, pytest.approx(model.geometry.friction.max()))
    slippery = replace(model, geometry=replace(model.geometry, friction=np.full(16, 2.5)))
    newton_scene(slippery, segments[:1], NewtonCfg(shortest_step=2e-5, creep=0.2))
    assert seen[1][4] == 2.5


def test_a_model_without_geometry_or_a_rollout_that_diverges_is_refused(model, segments, monkeypatch):
    with pytest.raises(ModelError, match="no contact geometry to fit"):
        newton_scene(replace(model, geometry=None), segments)
    plain = of_scene.MujocoEngine.run
    monkeypatch.setattr(
        of_scene.MujocoEngine,
        "run",
        lambda self, *a, **k: replace(plain(self, *a, **k), diverged=np.array([False, True])),
    )
    with pytest.raises(EngineError, match="diverges in MuJoCo"):
        newton_scene(model, segments)


def test_commands_are_padded_by_holding_the_last():
    given: Any = [SimpleNamespace(ctrl=np.arange(6.0).reshape(3, 2)), SimpleNamespace(ctrl=np.ones((5, 2)))]
    found = _padded_commands(given)
    np.testing.assert_array_equal(found[0], [[0, 1], [2, 3], [4, 5], [4, 5], [4, 5]])
    np.testing.assert_array_equal(found[1], np.ones((5, 2)))


@pytest.mark.parametrize(("count", "every"), [(4, 5), (7, 3), (20, 1), (50, 1)])
def test_states_for_pairs_are_simulated_and_observed_ones(monkeypatch, count, every):
    rng = np.random.default_rng(0)
    rollout: Any = SimpleNamespace(qpos=rng.normal(size=(2, 21, 7)), time=0.1 * np.arange(21))
    monkeypatch.setattr(of_scene, "observed_states", lambda _, s, time, q: q + s + time[:, None])
    m: Any = SimpleNamespace(nq=7)
    found = _pair_states(m, [10.0, 20.0], rollout, count)  # pyright: ignore[reportArgumentType]
    simulated = rollout.qpos[:, ::every]
    shift = np.array([10.0, 20.0])[:, None, None] + rollout.time[::every][None, :, None]
    np.testing.assert_allclose(found, np.concatenate([simulated, simulated + shift]).reshape(-1, 7))


def states(model: Model, *offsets: Any) -> np.ndarray:
    """Return states with the first body moved by some offsets [m]."""
    found = np.tile(model.scene.model.qpos0, (len(offsets), 1))
    found[:, 1:4] += np.array(offsets, dtype=float)
    return found


def test_pairs_are_of_spheres_and_what_comes_near_them(model):
    m = model.compile()
    moving = [m.body("first").id, m.body("second").id]
    places = states(model, [0, 0, 0], [0.03, 0, 0], [-0.029, 0, 0])
    places[0, 10] -= 0.01  # the second body, down to the first one
    ids, pairs = _near_pairs(model, moving, places, 2e-3)
    names = [m.body(b).name for b in ids]
    assert names[:2] == ["first", "second"]
    assert names[2:] == ["world", "pusher"]
    spheres = model.geometry.names()
    rows = {}
    for c in range(len(pairs)):
        frame = [names[b] for b in pairs.body[c]]
        kind = mujoco.mjtGeom(int(pairs.kind[c])).name.removeprefix("mjGEOM_")
        rows.setdefault((frame[0], frame[1], kind, pairs.other[c] >= 0), []).append(c)
        assert spheres[pairs.sphere[c]].startswith(frame[0])
    kinds = {key: len(value) for key, value in rows.items()}
    assert kinds[("first", "world", "PLANE", False)] == 4
    assert kinds[("first", "pusher", "BOX", False)] == 2
    assert kinds[("first", "world", "CAPSULE", False)] >= 2
    assert kinds[("first", "world", "SPHERE", False)] >= 1
    assert kinds[("first", "second", "SPHERE", True)] >= 4
    assert len(pairs) == sum(kinds.values())
    for (_, _, kind, fitted), chosen in rows.items():
        for c in chosen:
            if fitted:
                np.testing.assert_array_equal(pairs.frame[c], [0, 0, 0, 0, 0, 0, 1])
                assert pairs.friction[c] == model.geometry.friction[pairs.other[c]]
                assert pairs.round[c] == pytest.approx(0.004)
                continue
            name = {"PLANE": "floor", "BOX": "pusher", "CAPSULE": "post", "SPHERE": "ball"}[kind]
            geom = m.geom(name)
            np.testing.assert_allclose(pairs.frame[c], [*geom.pos, *geom.quat[1:], geom.quat[0]])
            np.testing.assert_array_equal(pairs.size[c], geom.size)
            assert pairs.friction[c] == geom.friction[0]
            assert pairs.round[c] == (geom.size[0] if kind in ("CAPSULE", "SPHERE") else 0.0)
    from concent_warp.kernels.newton_contacts import LARGER_FRICTION, SHAPE_FRICTION, SPHERE_FRICTION

    higher = m.geom(spheres[0]).priority[0] - m.geom("floor").priority[0]
    assert {int(pairs.rule[c]) for c in rows[("first", "world", "PLANE", False)]} == {
        {0: LARGER_FRICTION, 1: SPHERE_FRICTION, -1: SHAPE_FRICTION}[int(np.sign(higher))]
    }
    assert {int(pairs.rule[c]) for c in rows[("first", "second", "SPHERE", True)]} == {LARGER_FRICTION}
    against = m.geom(spheres[0]).priority[0] - m.geom("ball").priority[0]
    assert {int(pairs.rule[c]) for c in rows[("first", "world", "SPHERE", False)]} == {
        {0: LARGER_FRICTION, 1: SPHERE_FRICTION, -1: SHAPE_FRICTION}[int(np.sign(against))]
    }


def test_pairs_are_found_within_the_reach_alone(model):
    m = model.compile()
    first = [m.body("first").id]
    lifted = states(model, [0, 0, 0.0032])  # 3 mm above the floor
    ids, pairs = _near_pairs(model, first, lifted, 4e-3)
    assert 0 in [ids[b] for b in pairs.body[:, 1]]
    _, fewer = _near_pairs(model, first, lifted, 2.9e-3)
    assert not (fewer.kind == int(mujoco.mjtGeom.mjGEOM_PLANE)).any()
    with pytest.raises(ModelError, match="no sphere of a moving object comes near anything"):
        _near_pairs(model, first, states(model, [0, 0, 0.5]), 4e-3)


def test_a_shape_that_newton_cannot_collide_is_named(model):
    text = TEXT.replace('name="post" type="capsule"', 'name="egg" type="ellipsoid"').replace(
        '"0.01 0.02"', '"0.01 0.02 0.02"'
    )
    odd, there = replace(model, scene=Scene(text)), states(model, [0.03, 0, 0])
    first = [odd.compile().body("first").id]
    with pytest.raises(ModelError, match="ELLIPSOID") as error:
        _near_pairs(odd, first, there, 4e-3)
    assert "egg" in str(error.value)
    unnamed = replace(model, scene=Scene(text.replace('name="egg" ', "")))
    with pytest.raises(ModelError, match="world"):
        _near_pairs(unnamed, first, there, 4e-3)


BOUND = """<mujoco><worldbody>
  <body name="fixed"><geom size="0.01"/></body>
  <body name="free"><freejoint/><geom size="0.01"/></body>
  <body name="hinged"><joint/><geom size="0.01"/></body>
  <body name="ball"><joint type="ball"/><geom size="0.01"/></body>
  <body name="two"><joint/><joint axis="0 1 0"/><geom size="0.01"/></body>
  <body name="other"><freejoint/><geom size="0.01"/></body>
</worldbody></mujoco>"""


def bodies_with_spheres(*names: str) -> tuple[Any, mujoco.MjModel]:
    m = mujoco.MjModel.from_xml_string(BOUND)
    return SimpleNamespace(geometry=SimpleNamespace(bodies=names)), m


def test_bodies_to_simulate_are_free_or_stand_still():
    given, m = bodies_with_spheres("fixed", "free", "other")
    assert _moving_bodies(given, m) == [m.body("free").id, m.body("other").id]
    for names, found in ((("fixed",), "none"), (("free", "hinged"), "hinged"), (("ball", "two"), "['ball', 'two']")):
        given, m = bodies_with_spheres(*names)
        with pytest.raises(ModelError, match="objects that move freely") as error:
            _moving_bodies(given, m)
        assert found in str(error.value)
        assert "'free'" not in str(error.value)


def test_inertias_are_about_the_body_axes(model):
    m = model.compile()
    for name in ("first", "second"):
        found = _inertia_of(m, m.body(name).id)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, m.body(name).iquat)
        turn = turn.reshape(3, 3)
        np.testing.assert_allclose(found.inertia, turn @ np.diag(m.body(name).inertia) @ turn.T)
        assert (found.name, found.mass) == (name, m.body(name).mass[0])
        np.testing.assert_array_equal(found.com, m.body(name).ipos)


def test_velocities_of_the_centre_of_mass_are_mujocos(model):
    m, rng = model.compile(), np.random.default_rng(1)
    d = mujoco.MjData(m)
    d.qpos[4:8] = Rotation.random(rng=rng).as_quat(scalar_first=True)
    d.qpos[11:15] = Rotation.random(rng=rng).as_quat(scalar_first=True)
    d.qvel[:] = rng.normal(size=m.nv)
    mujoco.mj_forward(m, d)
    for name in ("first", "second"):
        body = m.body(name).id
        pose = np.concatenate([d.xpos[body], d.xquat[body][[1, 2, 3, 0]]])
        found = _velocity_of(m, d.qvel, body, pose, _inertia_of(m, body))
        seen = np.zeros(6)
        mujoco.mj_objectVelocity(m, d, mujoco.mjtObj.mjOBJ_BODY, body, seen, 0)
        np.testing.assert_allclose(found, [*seen[3:], *seen[:3]], atol=1e-9)


@pytest.mark.parametrize("substeps", [1, 3])
def test_poses_are_resampled_by_lines_and_slerps(substeps):
    rng = np.random.default_rng(2)
    pose = np.concatenate(
        [rng.normal(size=(2, 5, 3, 3)), Rotation.random(30, rng=rng).as_quat().reshape(2, 5, 3, 4)], -1
    )
    found, velocity = _resampled(pose, 0.02, substeps)
    assert found.shape == (4 * substeps + 1, 2, 3, 7)
    assert velocity.shape == (4 * substeps + 1, 2, 3, 6)
    for i, b in np.ndindex(2, 3):
        turns = Rotation.from_quat(pose[i, :, b, 3:])
        slerp = Slerp(np.arange(5), turns)
        for k in range(4 * substeps + 1):
            at, row = k / substeps, min(k // substeps, 3)
            place = pose[i, row, b, :3] + (at - row) * (pose[i, row + 1, b, :3] - pose[i, row, b, :3])
            np.testing.assert_allclose(found[k, i, b, :3], place, atol=1e-12)
            turn = Rotation.from_quat(found[k, i, b, 3:])
            assert (turn.inv() * slerp(min(at, 4.0))).magnitude() < 1e-6
            np.testing.assert_allclose(velocity[k, i, b, :3], (pose[i, row + 1, b, :3] - pose[i, row, b, :3]) / 0.02)
            spin = (turns[row + 1] * turns[row].inv()).as_rotvec() / 0.02
            np.testing.assert_allclose(velocity[k, i, b, 3:], spin, atol=1e-9)


def logged(m: mujoco.MjModel, rows: list[tuple[int, int, str, str, Any]]) -> Any:
    """Return a rollout with contacts of variant, step, geoms and place; bodies turn from step to step."""
    rng = np.random.default_rng(3)
    quaternion = Rotation.random(2 * 6 * m.nbody, rng=rng).as_quat(scalar_first=True).reshape(2, 6, m.nbody, 4)
    log = SimpleNamespace(
        variant=np.array([r[0] for r in rows]), step=np.array([r[1] for r in rows]),
        geom=np.array([[m.geom(r[2]).id, m.geom(r[3]).id] for r in rows]), position=np.array([r[4] for r in rows]),
    )  # fmt: skip
    return SimpleNamespace(contacts=log, body_quaternion=quaternion, body_position=rng.normal(size=(2, 6, m.nbody, 3)))


def test_a_body_is_as_strongly_held_as_at_its_worst_step(model):
    m = model.compile()
    body, inertia = m.body("first").id, _inertia_of(m, m.body("first").id)
    rng = np.random.default_rng(4)
    mine, others = model.geometry.names()[:8], model.geometry.names()[8:]
    rows = [(0, 1, "floor", mine[k], 0.1 * rng.normal(size=3)) for k in range(3)]
    rows += [(1, 1, "floor", mine[k], 0.2 * rng.normal(size=3)) for k in range(2)]
    rows += [(0, 2, mine[k], others[k], 0.3 * rng.normal(size=3)) for k in range(4)]
    rows += [(0, 2, "floor", others[5], 9.0 * rng.normal(size=3))]  # of another body
    rollout = logged(m, rows)

    def at(v: int, k: int) -> float:
        turn = Rotation.from_quat(rollout.body_quaternion[v, k, body], scalar_first=True).as_matrix()
        points = [p for a, b, *_, p in rows if (a, b) == (v, k)][: 4 if k == 2 else None]
        return coupling(inertia, (np.array(points) - rollout.body_position[v, k, body]) @ turn)

    resting = np.mean([coupling(inertia, p[None]) for p in model.geometry.position[:8]])
    steps = {(0, 1): at(0, 1), (1, 1): at(1, 1), (0, 2): at(0, 2)}
    found = _strength(m, model, body, inertia, rollout, NewtonCfg())
    assert found == pytest.approx(max(4 * resting, *steps.values()))
    few = _strength(m, model, body, inertia, rollout, NewtonCfg(pair_states=1))
    assert few == pytest.approx(max(4 * resting, steps[(0, 2)]))
    heavy = _strength(m, model, body, inertia, rollout, NewtonCfg(min_contacts=10**6))
    assert heavy == pytest.approx(1e6 * resting)


def test_a_body_touches_where_a_contact_is_logged_at_the_first_step(model):
    m = model.compile()
    mine, others = model.geometry.names()[0], model.geometry.names()[8]
    body, second = m.body("first").id, m.body("second").id
    rollout = logged(
        m, [(0, 1, "floor", mine, np.zeros(3)), (1, 0, "floor", mine, np.zeros(3)), (1, 0, mine, others, np.zeros(3))]
    )
    assert [_touches(m, rollout, v, body) for v in (0, 1)] == [False, True]
    assert [_touches(m, rollout, v, second) for v in (0, 1)] == [False, True]
    alone = logged(m, [(1, 0, "floor", others, np.zeros(3)), (0, 0, "floor", others, np.zeros(3))])
    assert not _touches(m, alone, 0, body)


def poses(worlds: NewtonWorlds, **parameters: Any) -> np.ndarray:
    return worlds.forward(Parameters(**parameters)).cpu().numpy().copy()


@pytest.fixture(scope="module")
def simulated(scene, model) -> dict[str, Any]:
    """Three candidates at once, with gradients of some poses."""
    rng = np.random.default_rng(5)
    given = {
        "position": model.geometry.position + rng.normal(0, 2e-4, (3, 16, 3)),
        "radius": model.geometry.radius * rng.uniform(0.98, 1.02, (3, 16)),
        "friction": model.geometry.friction * rng.uniform(0.9, 1.1, (3, 16)),
        "friction_scale": np.array([0.9, 1.0, 1.1]), "stiffness_scale": np.array([0.9, 1.0, 0.8]),
        "mass_scale": rng.uniform(0.9, 1.1, (3, 2)),
    }  # fmt: skip
    import torch

    worlds = NewtonWorlds(scene, 3, "cpu")
    found = poses(worlds, **given)
    rows = np.array([0, 1, scene.steps // 2, scene.steps])
    seed = rng.normal(size=(4, 6, 2, 7)).astype(np.float32)
    seed[1, 2, 0, 3] = np.nan
    gradient = worlds.backward(torch.as_tensor(seed), rows)
    return {"given": given, "poses": found, "rows": rows, "seed": seed, "gradient": gradient, "worlds": worlds}


def test_candidates_do_not_influence_one_another(scene, simulated):
    import torch

    worlds = NewtonWorlds(scene, 1, "cpu")
    for p in (0, 2):
        one = {name: value[p : p + 1] for name, value in simulated["given"].items()}
        np.testing.assert_allclose(poses(worlds, **one), simulated["poses"][:, 2 * p : 2 * p + 2], atol=1e-6)
        seed = torch.as_tensor(simulated["seed"][:, 2 * p : 2 * p + 2])
        found = worlds.backward(seed, simulated["rows"])
        for name in NAMES:
            expected = simulated["gradient"][name][p]
            assert found[name].shape == (1, *expected.shape)
            np.testing.assert_allclose(found[name][0], expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max() + 1e-9)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_seed_that_is_not_finite_counts_as_no_gradient(simulated, value):
    import torch

    worlds, rows = simulated["worlds"], simulated["rows"]
    poses(worlds, **simulated["given"])
    seed = simulated["seed"].copy()
    seed[3, 1, 1, 2] = 0.0
    expected = worlds.backward(torch.as_tensor(seed), rows)
    seed[3, 1, 1, 2] = value
    found = worlds.backward(torch.as_tensor(seed), rows)
    for name in NAMES:
        np.testing.assert_array_equal(found[name], expected[name])


def test_chunks_do_not_change_a_rollout_nor_its_gradients(scene, simulated, monkeypatch):
    import torch

    monkeypatch.setattr(of_worlds, "CHUNK_STEPS", scene.steps // 3 + 1)
    worlds = NewtonWorlds(scene, 3, "cpu")
    assert (worlds.chunk, worlds.chunks) == (scene.steps // 3 + 1, 3)
    found = poses(worlds, **simulated["given"])
    assert found.shape == (scene.steps + 1, 6, 2, 7)
    np.testing.assert_allclose(found, simulated["poses"], atol=1e-6)
    gradient = worlds.backward(torch.as_tensor(simulated["seed"]), simulated["rows"])
    for name in NAMES:
        expected = simulated["gradient"][name]
        np.testing.assert_allclose(gradient[name], expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max() + 1e-9)


def test_gradients_are_those_of_central_differences(simulated):
    rows, seed = simulated["rows"], np.nan_to_num(simulated["seed"])
    worlds = simulated["worlds"]
    for name, step in (("radius", 1e-6), ("friction_scale", 0.01), ("mass_scale", 0.01), ("stiffness_scale", 0.01)):
        value = simulated["given"][name]
        assert np.abs(simulated["gradient"][name]).max() > 0
        towards = np.sign(simulated["gradient"][name]) * step
        sums = []
        for sign in (1, -1):
            changed = poses(worlds, **(simulated["given"] | {name: value + sign * towards}))[rows]
            sums.append((changed.astype(float) * seed).sum(axis=(0, 2, 3)).reshape(3, -1).sum(axis=1))
        slope = (sums[0] - sums[1]) / 2
        expected = (simulated["gradient"][name] * towards).reshape(3, -1).sum(axis=1)
        np.testing.assert_allclose(slope, expected, rtol=0.25, atol=0.05 * np.abs(expected).max() + 2e-5, err_msg=name)


def test_what_is_not_given_is_as_in_the_model(scene, model, simulated):
    worlds = simulated["worlds"]
    position = np.repeat(model.geometry.position[None], 3, axis=0)
    explicit = poses(
        worlds, position=position, radius=np.repeat(model.geometry.radius[None], 3, axis=0),
        friction=np.repeat(model.geometry.friction[None], 3, axis=0), friction_scale=np.ones(3),
        stiffness_scale=np.ones(3), mass_scale=np.ones((3, 2)),
    )  # fmt: skip
    found = poses(worlds, position=position)
    np.testing.assert_array_equal(found, explicit)
    np.testing.assert_allclose(found[0, :2], scene.start[:, :2], atol=1e-6)
    for p in (1, 2):
        np.testing.assert_array_equal(found[:, :2], found[:, 2 * p : 2 * p + 2])


def test_newton_stays_close_to_mujoco_and_replays_what_it_does_not_simulate(scene, model, simulated):
    worlds = simulated["worlds"]
    found = poses(worlds, position=np.repeat(model.geometry.position[None], 3, axis=0))
    ids = [scene.rollout.bodies.index(name) for name in scene.bodies]
    seen = found[:: scene.physics.substeps, :2, :, :3]
    expected = scene.rollout.body_position[:, :, ids[:2]].swapaxes(0, 1)
    assert np.abs(seen - expected).max() < 1e-3
    moved = np.abs(expected - expected[0]).max()
    assert moved > 2e-3
    path = worlds._path.numpy().reshape(-1, 6, len(scene.bodies), 7)[: scene.steps + 1]
    for p in range(3):
        np.testing.assert_allclose(path[:, 2 * p : 2 * p + 2, 2:], scene.replayed, atol=1e-6)
    fall = found[: scene.steps // 2, 0, 1, 2]
    assert fall[0] > fall[-1]


def test_contacts_have_the_weaker_stiffness_and_damping_of_their_bodies(scene, simulated):
    worlds, physics = simulated["worlds"], scene.physics
    for name, of_body in (("stiffness", physics.stiffness), ("damping", physics.damping)):
        expected = [min(of_body[a], of_body[b]) if b < 2 else of_body[a] for a, b in scene.pairs.body]
        np.testing.assert_allclose(worlds._pairs[name].numpy(), expected, rtol=1e-6)
    assert len({tuple(row) for row in scene.pairs.body.tolist()}) >= 4
    np.testing.assert_array_equal(worlds._pairs["body1"].numpy(), scene.pairs.body[:, 1])
    np.testing.assert_array_equal(worlds._replayed.numpy(), [2, 3])
    np.testing.assert_allclose(worlds._mass.numpy(), [0.08, 0.05], rtol=1e-6)


def test_memory_counts_states_forces_contacts_and_their_gradients(scene, simulated):
    worlds = simulated["worlds"]
    bodies, contacts = 6 * len(scene.bodies), 6 * len(scene.pairs)
    floats = bodies * (7 + 6 + 6) + contacts * (3 + 3 + 1)
    assert worlds.memory == 2 * 4 * floats


def test_losses_are_means_over_both_bodies_and_segments(scene, model, segments):
    loss = NewtonLoss(scene, 2, held_out=0.5, block=0.016, device="cpu")
    position = np.stack([model.geometry.position, model.geometry.position + 1e-4])
    found = loss(Parameters(position))
    assert loss.simulations == 2 * 4
    np.testing.assert_allclose(loss.losses(Parameters(position)), found.loss, rtol=1e-5)
    assert loss.simulations == 3 * 4
    assert loss.bodies == [0, 1]
    np.testing.assert_array_equal(loss.rows, loss.objective.record * scene.physics.substeps)
    assert set(found.by) == set(NAMES)
    moved = loss.worlds.forward(Parameters(position)).cpu().numpy()
    for p in range(2):
        fit = []
        for s, one in enumerate(segments):
            for b, target in enumerate(one.targets):
                rows = np.minimum(np.round(target.time / scene.physics.timestep).astype(int), scene.steps)
                distances = []
                for frame, row in enumerate(rows):
                    turn = Rotation.from_quat(moved[row, 2 * p + s, b, 3:])
                    predicted = turn.apply(target.anchor) + moved[row, 2 * p + s, b, :3]
                    apart = np.linalg.norm(predicted[:, None] - target.points[frame][None], axis=2)
                    distances.append(apart.min(axis=0).mean() + apart.min(axis=1).mean())
                fit.append(np.mean(np.array(distances)[~target.held_out(0.5, 0.016)]))
        assert found.loss[p] == pytest.approx(np.mean(fit), rel=2e-3)
    assert not np.allclose(found.loss, found.held_out)
    everything = mujoco_loss(loss.objective, scene)
    assert everything == pytest.approx(found.loss[0], rel=0.2)


def test_a_candidate_that_diverges_is_lost_and_the_others_are_not(scene, model):
    loss = NewtonLoss(scene, 2, device="cpu")
    radius = np.repeat(model.geometry.radius[None], 2, axis=0)
    radius[1] = np.nan
    found = loss(Parameters(np.repeat(model.geometry.position[None], 2, axis=0), radius=radius))
    assert np.isfinite(found.loss[0])
    assert np.isinf([found.loss[1], found.held_out[1]]).all()
    for value in found.by.values():
        assert np.isfinite(value[0]).all()
        assert np.isnan(value[1]).all()
