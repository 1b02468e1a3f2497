"""Forces of force models in random states against their formulas, written out independently of the engine's arrays."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from concent_warp.effects.library.contact_forces import (
    FADE_SPEED,
    AdhesionForce,
    AnisotropicForce,
    TurningForce,
    _outermost,
)
from concent_warp.effects.library.friction_forces import LoadFriction, StribeckFriction
from concent_warp.effects.library.gear_forces import BacklashForce, Gear
from concent_warp.effects.unknown_force import UnknownBodyForce, UnknownJointForce

SLIDING = """
<mujoco><option timestep="0.002" cone="{cone}"/><worldbody>
  <geom name="a" type="plane" size="5 5 .1" euler="8 -12 0" friction="0.7"/>
  <body name="first" pos="0 0 .03" euler="3 2 40"><freejoint/>
    <geom type="box" size=".05 .04 .03" mass=".4" pos=".01 .02 0" friction="0.5"/>
    <geom type="sphere" size=".03" mass=".1" pos=".06 0 0" condim="1"/></body>
  <body name="other" pos=".12 0 .03"><freejoint/><geom type="box" size=".06 .04 .03" mass=".3"/></body>
  <geom name="step" type="box" pos="0 .07 .02" size=".1 .03 .1" friction="0.9"/>
</worldbody></mujoco>"""


def applied_as_joint_forces(m: mujoco.MjModel, d: mujoco.MjData) -> np.ndarray:
    """Return `xfrc_applied` as generalised forces, shape (nv,)."""
    total = np.zeros(m.nv)
    for b in range(m.nbody):
        mujoco.mj_applyFT(m, d, d.xfrc_applied[b, :3], d.xfrc_applied[b, 3:], d.xipos[b], b, total)
    return total


def grain(m: mujoco.MjModel, d: mujoco.MjData, body: int, ratio: float) -> np.ndarray:
    """Return the generalised forces (nv,) of the additional friction along y at a body's contacts with the world."""
    total = np.zeros(m.nv)
    for i, contact in enumerate(d.contact):
        bodies = m.geom_bodyid[contact.geom].tolist()
        if sorted(bodies) != sorted([0, body]) or contact.dim < 3 or contact.efc_address < 0:
            continue
        force, jacobian = np.zeros(6), np.zeros((3, m.nv))
        mujoco.mj_contactForce(m, d, i, force)
        mujoco.mj_jac(m, d, jacobian, None, contact.pos, body)
        velocity, normal = jacobian @ d.qvel, contact.frame[:3]
        velocity -= normal * (normal @ velocity)
        size = -(ratio - 1) * contact.friction[0] * force[0] * velocity[1]
        total += jacobian.T @ np.array([0, size / np.sqrt(velocity @ velocity + FADE_SPEED**2), 0])
    return total


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
@pytest.mark.parametrize("seed", range(3))
def test_anisotropic_friction_is_the_formula_at_each_contact_with_fixed_geoms(cone, seed):
    m = mujoco.MjModel.from_xml_string(SLIDING.format(cone=cone))
    d, rng = mujoco.MjData(m), np.random.default_rng(seed)
    mujoco.mj_step(m, d, nstep=60)
    while not any(sorted(m.geom_bodyid[c.geom]) == [0, 1] and c.dim == 3 for c in d.contact):
        mujoco.mj_step(m, d)
    d.qvel[:] = rng.normal(0, 0.1, m.nv)
    d.qvel[2] -= 0.2
    mujoco.mj_forward(m, d)
    body = m.body("first").id
    expected = grain(m, d, body, 1.7)
    d.xfrc_applied[:] = 0
    AnisotropicForce(m, np.array([body])).bound(m, d, np.array([1.7]))()
    assert np.abs(expected[:6]).max() > 1e-2
    np.testing.assert_allclose(applied_as_joint_forces(m, d), expected, rtol=0, atol=1e-10)
    assert (d.xfrc_applied[[0, m.body("other").id]] == 0).all()


def test_anisotropy_of_one_adds_no_force_and_acts_on_either_side_of_a_contact():
    m = mujoco.MjModel.from_xml_string(SLIDING.format(cone="elliptic"))
    d = mujoco.MjData(m)
    d.qvel[:] = 0.3
    mujoco.mj_step(m, d, nstep=12)
    mujoco.mj_forward(m, d)
    body = m.body("first").id
    sides = {tuple(m.geom_bodyid[c.geom] == body) for c in d.contact if 0 in m.geom_bodyid[c.geom]}
    assert {(True, False), (False, True)} <= sides
    AnisotropicForce(m, np.array([body])).bound(m, d, np.array([1.0]))()
    assert (d.xfrc_applied == 0).all()
    empty = mujoco.MjData(m)
    empty.qpos[[2, 9]] = 3.0
    mujoco.mj_forward(m, empty)
    AnisotropicForce(m, np.array([body])).bound(m, empty, np.array([2.0]))()
    assert (empty.xfrc_applied == 0).all()


STICKY = """
<mujoco><asset><mesh name="wedge" vertex="-.03 -.02 -.02 .03 -.02 -.02 0 .03 -.02 0 0 .03 0 .002 -.01"/></asset>
<worldbody>
  <geom name="floor" type="plane" size="5 5 .1" euler="5 9 0" pos="0 0 -.001"/>
  <geom name="wall" type="box" pos=".08 0 .05" euler="0 4 20" size=".03 .2 .06"/>
  <geom name="ghost" type="box" pos="0 0 0" size="1 1 1" contype="0" conaffinity="0"/>
  <geom name="pole" type="capsule" fromto="-.1 -.1 0 -.1 -.1 .1" size=".02"/>
  <body name="thing"><freejoint/>
    <geom type="box" size=".02 .03 .01" mass=".1" pos=".01 0 .01" euler="0 10 0"/>
    <geom type="capsule" size=".008 .03" mass=".1" pos="0 -.03 0" euler="70 0 0"/>
    <geom type="cylinder" size=".015 .02" mass=".1" pos="-.04 0 0" euler="30 0 0"/>
    <geom type="sphere" size=".012" mass=".1" pos="0 .05 0"/>
    <geom type="mesh" mesh="wedge" mass=".1" pos=".03 .05 0"/>
    <geom type="sphere" size=".05" mass=".1" contype="0" conaffinity="0"/>
    <geom type="ellipsoid" size=".02 .02 .02" mass=".1"/></body>
  <body name="away" pos="0 0 2"><freejoint/><geom size=".1"/></body>
</worldbody></mujoco>"""
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


def points_of(m: mujoco.MjModel, g: int) -> tuple[np.ndarray, float]:
    """Return the points of a geom that adhesion pulls, shape (P, 3), and their radius."""
    size, kind = m.geom_size[g], mujoco.mjtGeom(m.geom_type[g])
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return np.zeros((1, 3)), size[0]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return np.array([[0, 0, -size[1]], [0, 0, size[1]]]), size[0]
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        r, h = size[:2]
        return np.array([[x, y, z] for z in (-h, h) for x, y in ((r, 0), (0, r), (-r, 0), (0, -r))]), 0.0
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return CORNERS * size, 0.0
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = m.geom_dataid[g]
        vertices = m.mesh_vert[m.mesh_vertadr[mesh] :][: m.mesh_vertnum[mesh]]
        return vertices[sorted({int(np.argmax(vertices @ c)) for c in CORNERS})].astype(float), 0.0
    return np.zeros((0, 3)), 0.0


def test_points_of_each_shape_are_those_that_may_touch_first():
    m = mujoco.MjModel.from_xml_string(STICKY)
    for g in range(m.ngeom):
        if m.geom_type[g] != mujoco.mjtGeom.mjGEOM_PLANE:
            found, expected = _outermost(m, g), points_of(m, g)[0]
            assert found.shape == expected.shape
            order = [rows[np.lexsort(rows.round(9).T)] for rows in (found, expected)]
            np.testing.assert_allclose(order[0], order[1], atol=1e-12)
    mesh = int(np.flatnonzero(m.geom_type == mujoco.mjtGeom.mjGEOM_MESH)[0])
    assert len(_outermost(m, mesh)) == 4


def pull(m: mujoco.MjModel, d: mujoco.MjData, body: int, strength: float, gap: float) -> tuple[np.ndarray, int]:
    """Return force and torque about the centre of mass (6,) of adhesion to floor and wall, and how many points act."""
    total, count = np.zeros(6), 0
    floor, wall = m.geom("floor").id, m.geom("wall").id
    for g in np.flatnonzero(m.geom_bodyid == body):
        if not m.geom_contype[g]:
            continue
        points, radius = points_of(m, int(g))
        turn = d.geom_xmat[g].reshape(3, 3)
        for point in d.geom_xpos[g] + points @ turn.T:
            normals = []
            up = d.geom_xmat[floor].reshape(3, 3)[:, 2]
            if up @ (point - d.geom_xpos[floor]) - radius < gap:
                normals.append(up)
            axes, half = d.geom_xmat[wall].reshape(3, 3), m.geom_size[wall]
            local = axes.T @ (point - d.geom_xpos[wall])
            outside = np.abs(local) - half
            if (outside > 0).sum() <= 1 and outside.max() - radius < gap:
                face = int(outside.argmax())
                normals.append(np.sign(local[face]) * axes[:, face])
            for normal in normals:
                arm = point - radius * normal - d.xipos[body]
                total += np.concatenate([-strength * normal, np.cross(arm, -strength * normal)])
                count += 1
    return total, count


def test_adhesion_pulls_each_point_within_its_reach_of_planes_and_boxes():
    m = mujoco.MjModel.from_xml_string(STICKY)
    d, rng, acting, seen = mujoco.MjData(m), np.random.default_rng(0), [], 0
    body = m.body("thing").id
    model = AdhesionForce(m, np.array([body]), 0.004)
    act = model.bound(m, d, np.array([2.5]))
    for _ in range(60):
        d.qpos[:3] = [rng.uniform(0, 0.05), rng.uniform(-0.05, 0.05), rng.uniform(0.01, 0.07)]
        d.qpos[3:7] = rng.normal(size=4)
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        d.time, d.xfrc_applied[:] = 0.1, 0
        act()
        expected, count = pull(m, d, body, 2.5, 0.004)
        np.testing.assert_allclose(d.xfrc_applied[body], expected, atol=1e-7)  # points are in single precision
        acting.append(count)
        seen += count > 0
    assert seen > 20
    assert len(set(acting)) > 4
    assert (d.xfrc_applied[m.body("away").id] == 0).all()


def test_adhesion_waits_for_the_first_poses_and_pulls_only_with_a_force():
    m = mujoco.MjModel.from_xml_string(STICKY)
    d, body = mujoco.MjData(m), m.body("thing").id
    model = AdhesionForce(m, np.array([body]), 0.004)
    d.qpos[2] = 0.0
    mujoco.mj_forward(m, d)
    model.apply(m, d, np.array([1.0]))
    assert (d.xfrc_applied == 0).all()
    d.time = 0.002
    model.apply(m, d, np.array([0.0]))
    assert (d.xfrc_applied == 0).all()
    model.apply(m, d, np.array([1.0]))
    assert np.abs(d.xfrc_applied[body]).max() > 0.5
    assert model.still.tolist() == [m.geom("floor").id, m.geom("wall").id]


TWO = """
<mujoco><option timestep="0.004"/><worldbody>
  <body><joint name="a" axis="0 1 0" frictionloss=".3"/><geom size=".05" mass="1" pos=".1 0 0"/>
    <body pos=".2 0 0"><joint name="b" type="slide" axis="1 0 0" frictionloss=".1"/><geom size=".05" mass="1"/></body>
  </body></worldbody>
<actuator><motor joint="a"/><position name="servo" joint="b" gear="{gear}" kp="50" kv="4" {limits}/></actuator>
</mujoco>"""


def test_stribeck_friction_adds_its_extra_at_the_speed_in_the_middle_of_the_step():
    m = mujoco.MjModel.from_xml_string(TWO.format(gear=1, limits=""))
    d, rng = mujoco.MjData(m), np.random.default_rng(0)
    d.qvel[:], d.qacc[:] = rng.normal(0, 0.2, 2), rng.normal(0, 9.0, 2)
    extra, speed = np.array([0.5, 0.7]), 0.25
    middle = d.qvel[[1, 0]] + 0.002 * d.qacc[[1, 0]]
    StribeckFriction(np.array([1, 0])).apply(m, d, np.array([*extra, speed]))
    expected = np.array([0.1, 0.3]) + extra * np.exp(-((middle / speed) ** 2))
    np.testing.assert_allclose(m.dof_frictionloss[[1, 0]], expected, rtol=1e-12)


def test_stribeck_friction_of_no_extra_or_no_speed_is_that_of_the_joint_in_motion():
    m = mujoco.MjModel.from_xml_string(TWO.format(gear=1, limits=""))
    d = mujoco.MjData(m)
    d.qvel[:] = [0.1, 0.0]
    StribeckFriction(np.array([0, 1])).apply(m, d, np.array([-2.0, 0.4, 0.0]))
    np.testing.assert_allclose(m.dof_frictionloss, [0.3, 0.5], rtol=1e-12)
    StribeckFriction(np.array([0])).apply(m, d, np.array([0.4, 0.0]))
    np.testing.assert_allclose(m.dof_frictionloss, [0.3, 0.5], rtol=1e-12)


def test_load_friction_adds_a_share_of_the_mean_of_what_motor_and_weight_exert():
    m = mujoco.MjModel.from_xml_string(TWO.format(gear=1, limits=""))
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:], d.ctrl[:] = [0.3, 0.1], [0.4, -0.7], [2.0, 0.5]
    mujoco.mj_forward(m, d)
    load = (np.abs(d.qfrc_actuator) + np.abs(d.qfrc_bias)) / 2
    assert (load > 0.5).all()
    LoadFriction(np.array([1, 0])).apply(m, d, np.array([0.3, -1.0]))
    np.testing.assert_allclose(m.dof_frictionloss, [0.3, 0.1 + 0.3 * load[1]], rtol=1e-12)


def test_friction_needs_a_value_for_each_joint():
    m = mujoco.MjModel.from_xml_string(TWO.format(gear=1, limits=""))
    d, both = mujoco.MjData(m), np.array([0, 1])
    stribeck, load = StribeckFriction(both), LoadFriction(both)
    for model, values in ((stribeck, [0.1, 0.2]), (load, [0.1]), (load, [0.1] * 3)):
        with pytest.raises(ValueError, match="zip"):
            model.bound(m, d, np.array(values))


def rotor(m: mujoco.MjModel, command: float, q: float, speed: float, ahead: float, play: float) -> tuple[float, float]:
    """Return force of a servo through loose gears (as the link feels it, on average over a step) and the rotor's lead.

    The rotor's motion within the step is integrated in small ones: kv (l' + x') = kp (e - x), stopped at the ends.
    """
    gear, kp, kv, dt, steps = m.actuator_gear[1, 0], 50.0, 4.0, m.opt.timestep, 20_000
    half, error, speed = 0.5 * play * abs(gear), command - gear * q, gear * speed
    x, pressed = ahead, 0
    for _ in range(steps):
        x += dt / steps * (kp * (error - x) / kv - speed)
        pressed += abs(x) > half
        x = min(max(x, -half), half)
    return gear * pressed / steps * (kp * (error - x) - kv * speed), x


@pytest.mark.parametrize(
    ("command", "q", "speed", "ahead"),
    [
        (0.03, 0.0, 0.0, 0.0),
        (0.3, 0.1, 0.2, 0.0),
        (-0.5, 0.05, -0.1, 0.01),
        (0.4, 0.0, 0.0, -0.01),
        (0.03, 0.1, 0.4, 0.02),
    ],
    ids=["within", "arrives up", "arrives down", "crosses", "leaves"],
)
@pytest.mark.parametrize("gear", [1.0, -2.0])
def test_gear_lets_through_what_its_rotor_presses_with(gear, command, q, speed, ahead):
    m = mujoco.MjModel.from_xml_string(TWO.format(gear=gear, limits="").replace("0.004", "0.001"))
    play = 0.04
    found = Gear.of(m, 1, play)
    error = command - gear * q
    change, after = found.through(error, gear * speed, ahead)
    felt, lead = rotor(m, command, q, speed, ahead, play)
    servo = gear * (50 * error - 4 * gear * speed)
    assert after == pytest.approx(lead, abs=1e-5)
    assert change + servo == pytest.approx(felt, rel=2e-2, abs=2e-3)


def test_rotor_begins_where_the_servo_is_at_rest_within_the_play():
    found = Gear.of(mujoco.MjModel.from_xml_string(TWO.format(gear=1, limits="")), 1, 0.04)
    for error, speed, lead in ((0.01, 0.0, 0.01), (0.01, 0.05, 0.006), (0.5, 0.0, 0.02), (-0.5, 0.0, -0.02)):
        assert found.through(error, speed, None)[1] == found.through(error, speed, lead)[1]


def test_numbers_of_a_gear_are_those_of_the_actuator():
    limits = 'ctrlrange="-.1 .2" ctrllimited="true" forcerange="-3 5" forcelimited="true"'
    found = Gear.of(mujoco.MjModel.from_xml_string(TWO.format(gear=-2, limits=limits)), 1, 0.04)
    assert (found.actuator, found.place, found.dof, found.gear) == (1, 1, 1, -2)
    assert (found.kp, found.kv, found.timestep) == (50, 4, 0.004)
    assert (found.lowest, found.highest, found.weakest, found.strongest) == (-0.1, 0.2, -3, 5)
    assert (found.offset, found.slope, found.half) == (0, 2, 0.04)
    assert found.fading == pytest.approx(np.exp(-0.004 * 50 / 4))
    free = Gear.of(mujoco.MjModel.from_xml_string(TWO.format(gear=1, limits="")), 1, 0.04)
    assert (free.lowest, free.highest, free.weakest, free.strongest) == (-np.inf, np.inf, -np.inf, np.inf)
    undamped = mujoco.MjModel.from_xml_string(TWO.format(gear=1, limits="").replace('kv="4"', ""))
    assert Gear.of(undamped, 1, 0.04).fading == 0
    assert Gear.of(undamped, 1, 0.04).kv == 0


def test_limits_bound_what_gets_through_and_what_the_servo_does():
    limits = 'forcerange="-3 5" forcelimited="true"'
    found = Gear.of(mujoco.MjModel.from_xml_string(TWO.format(gear=1, limits=limits)), 1, 0.04)
    # The rotor rests on an end: error 0.2 would press with 9 N, error -0.2 with -9 N, and the servo does 5 or -3.
    assert found.through(0.2, 0.0, 0.02) == (pytest.approx(0.0), 0.02)
    assert found.through(-0.2, 0.0, -0.02) == (pytest.approx(0.0), -0.02)
    # Error 0.11 presses with 4.5 N of the servo's 5.
    assert found.through(0.11, 0.0, 0.02)[0] == pytest.approx(-0.5)
    # Within the play nothing gets through of the servo's 0.5 N.
    assert found.through(0.01, 0.0, 0.01)[0] == pytest.approx(-0.5)


def test_play_acts_on_the_joint_and_keeps_the_lead_in_the_user_data():
    xml = TWO.format(gear=1, limits='ctrlrange="-.1 .2" ctrllimited="true"').replace(
        "<worldbody>", '<size nuserdata="5"/><worldbody>'
    )
    m = mujoco.MjModel.from_xml_string(xml)
    d, gear = mujoco.MjData(m), Gear.of(m, 1, 0.04)
    d.qpos[1], d.qvel[1], d.ctrl[1] = 0.05, 0.1, 7.0
    d.userdata[:] = 0.013
    model = BacklashForce(np.array([1]), 2)
    model.apply(m, d, np.array([0.04]))
    first = gear.through(0.15, 0.1, None)
    assert (d.qfrc_applied[1], d.userdata[3]) == pytest.approx(first)
    d.time, d.qfrc_applied[:], d.userdata[3] = 0.004, 0, -0.011
    model.apply(m, d, np.array([0.04]))
    assert (d.qfrc_applied[1], d.userdata[3]) == pytest.approx(gear.through(0.15, 0.1, -0.011))
    assert d.qfrc_applied[0] == 0
    assert d.userdata[[0, 1, 2, 4]].tolist() == [0.013] * 4
    d.qfrc_applied[:], d.ctrl[1] = 0, -7.0
    model.apply(m, d, np.array([0.0]))
    assert (d.qfrc_applied == 0).all()
    d.userdata[3] = 0.0
    model.apply(m, d, np.array([0.04]))
    assert (d.qfrc_applied[1], d.userdata[3]) == pytest.approx(gear.through(-0.15, 0.1, 0.0))


FREE = """<mujoco><worldbody>
  <body pos="1 0 0"><joint name="rail" type="slide" axis="0 1 0"/><geom size=".1" mass=".5"/></body>
  <body name="ball"><freejoint/><geom size=".1" mass="2"/></body></worldbody></mujoco>"""


def free_state(seed: int) -> tuple[mujoco.MjModel, mujoco.MjData, np.random.Generator]:
    """Return a random state of a free body behind a slide."""
    m, rng = mujoco.MjModel.from_xml_string(FREE), np.random.default_rng(seed)
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:] = rng.normal(0, 0.3, m.nq), rng.normal(0, 0.7, m.nv)
    return m, d, rng


@pytest.mark.parametrize("way", ["field", "brake", "drag", "turning"])
def test_force_on_a_body_is_the_sum_of_its_bumps(way):
    m, d, rng = free_state(1)
    count, width, scale = 4, 0.4, 3.0
    centre = rng.normal(0, 0.4, (count, 3 if way in ("field", "brake") else 1))
    values = rng.normal(size=3 * count if way == "field" else count)
    values[-1] = 0.0
    position, velocity, rate = d.qpos[1:4].copy(), d.qvel[1:4].copy(), d.qvel[4:7].copy()
    moved = rate if way == "turning" else velocity
    at = position if way in ("field", "brake") else np.array([np.linalg.norm(moved)])
    bumps = np.exp(-0.5 * (((at - centre) / width) ** 2).sum(axis=1))
    if way == "field":
        expected = scale * bumps @ values.reshape(count, 3)
    else:
        still = 10 * 2e-3 if way == "turning" else 2e-3
        expected = -scale * (bumps @ values) * moved / np.sqrt(moved @ moved + still**2)
    model = UnknownBodyForce(2, 1, 1, centre, width, scale, way)
    model.apply(m, d, values)
    found = d.qfrc_applied[4:7] if way == "turning" else d.xfrc_applied[2, :3]
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    if way == "turning":
        assert (d.xfrc_applied == 0).all()
    else:
        assert (d.qfrc_applied == 0).all()
    assert (d.xfrc_applied[2, 3:] == 0).all()


@pytest.mark.parametrize("moving", [False, True])
def test_force_on_joints_is_the_sum_of_their_bumps(moving):
    m = mujoco.MjModel.from_xml_string(TWO.format(gear=1, limits=""))
    d, rng = mujoco.MjData(m), np.random.default_rng(2)
    d.qpos[:], d.qvel[:] = rng.normal(0, 0.3, 2), rng.normal(0, 0.7, 2)
    centre = np.array([[-0.5, 0.0, 0.5, 1.0], [-0.3, -0.1, 0.1, 0.3]])
    scale, values = np.array([2.0, 5.0]), rng.normal(size=8)
    at = (d.qvel if moving else d.qpos)[[1, 0]]
    bumps = np.exp(-0.5 * ((at[:, None] - centre) / np.array([[0.5], [0.2]])) ** 2)
    expected = scale * (bumps * values.reshape(2, 4)).sum(axis=1)
    order = np.array([1, 0])
    model = UnknownJointForce(order, order, centre, scale, moving=moving)
    assert model.count == 8
    model.apply(m, d, values)
    np.testing.assert_allclose(d.qfrc_applied[[1, 0]], expected, rtol=1e-12)


def turning(m: mujoco.MjModel, d: mujoco.MjData, body: int, coefficient: float, *, rolling: bool) -> np.ndarray:
    """Return the generalised forces (nv,) of friction against rotation at a body's contacts with the world."""
    total, jacobian, stiff = np.zeros(m.nv), np.zeros((3, m.nv)), d.ximat[body].reshape(3, 3)
    mujoco.mj_jac(m, d, None, jacobian, d.xipos[body], body)
    spin = jacobian @ d.qvel
    for i, contact in enumerate(d.contact):
        if sorted(m.geom_bodyid[contact.geom].tolist()) != sorted([0, body]) or contact.efc_address < 0:
            continue
        force, normal = np.zeros(6), contact.frame[:3]
        mujoco.mj_contactForce(m, d, i, force)
        part = normal * (normal @ spin)
        part = spin - part if rolling else part
        axis = part / np.linalg.norm(part)
        inertia = 1 / (axis @ stiff @ np.diag(1 / m.body_inertia[body]) @ stiff.T @ axis)
        most = inertia * np.linalg.norm(part) / (4 * m.opt.timestep)
        total -= jacobian.T @ axis * min(coefficient * force[0], most)
    return total


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
@pytest.mark.parametrize("rolling", [False, True])
@pytest.mark.parametrize(("speed", "coefficient"), [(3.0, 2e-4), (0.01, 0.1)])
def test_friction_against_rotation_is_the_formula_at_each_contact_with_fixed_geoms(cone, rolling, speed, coefficient):
    m = mujoco.MjModel.from_xml_string(SLIDING.format(cone=cone))
    d, rng = mujoco.MjData(m), np.random.default_rng(5)
    mujoco.mj_step(m, d, nstep=60)
    while not any(sorted(m.geom_bodyid[c.geom]) == [0, 1] and c.dim == 3 for c in d.contact):
        mujoco.mj_step(m, d)
    d.qvel[:] = rng.normal(0, speed, m.nv)
    d.qvel[2] = -0.2
    mujoco.mj_forward(m, d)
    body = m.body("first").id
    expected = turning(m, d, body, coefficient, rolling=rolling)
    assert np.abs(expected[3:6]).max() > 1e-6
    d.xfrc_applied[:] = 0
    TurningForce(m, np.array([body]), rolling=rolling).bound(m, d, np.array([coefficient]))()
    np.testing.assert_allclose(applied_as_joint_forces(m, d), expected, rtol=1e-9, atol=1e-12)
    assert (d.xfrc_applied[[0, m.body("other").id]] == 0).all()
