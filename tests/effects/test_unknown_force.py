import mujoco
import numpy as np
import pytest

from concent_warp.effects.registry import effect_classes
from concent_warp.effects.unknown_force import UnknownBodyForce, UnknownForce, UnknownJointForce

LOOSE = """
<mujoco>
  <option timestep="0.001" gravity="0 0 0"/>
  <worldbody>
    <body name="ball"><freejoint/><geom type="sphere" size="0.1" mass="2"/></body>
    <body pos="1 0 0"><joint name="rail" type="slide" axis="0 1 0"/><geom type="sphere" size="0.1" mass="0.5"/></body>
  </worldbody>
</mujoco>"""
MASS, INERTIA = 2.0, 0.4 * 2.0 * 0.1**2


def applied(force_model, values, qpos=None, qvel=None):
    """Return the acceleration (nv,) in a state, and the data."""
    m = mujoco.MjModel.from_xml_string(LOOSE)
    d = mujoco.MjData(m)
    d.qpos[:] = m.qpos0 if qpos is None else qpos
    d.qvel[:] = 0.0 if qvel is None else qvel
    force_model.bound(m, d, np.asarray(values, dtype=float))()
    mujoco.mj_forward(m, d)
    return d.qacc.copy()


def body_force_model(centre, way, width=0.5, scale=3.0):
    return UnknownBodyForce(1, 0, 0, np.asarray(centre, dtype=float), width, scale, way)


def test_a_force_by_place_pushes_along_the_axes_and_fades_with_distance():
    force_model = body_force_model([[0, 0, 0], [1, 0, 0]], "field")
    assert force_model.count == 6
    here = applied(force_model, [1, 0, -2, 0, 0, 0])
    assert here[:3] == pytest.approx(np.array([1, 0, -2]) * 3.0 / MASS)
    assert here[3:] == pytest.approx(0.0)
    assert applied(force_model, [0, 0, 0, 1, 0, 0])[0] == pytest.approx(np.exp(-0.5 * 4) * 3.0 / MASS)


def test_a_resistance_acts_against_the_velocity_whatever_its_size():
    force_model = body_force_model([[0, 0, 0]], "brake")
    for speed in (0.5, 2.0):
        velocity = np.array([speed, 0, 0, 0, 0, 0, 0])
        assert applied(force_model, [1.0], qvel=velocity)[0] == pytest.approx(-3.0 / MASS, rel=1e-4)
    assert applied(force_model, [1.0])[:6] == pytest.approx(0.0)


def test_a_resistance_by_speed_is_of_that_speed_alone():
    force_model = body_force_model([[0.0], [1.0]], "drag", width=0.25)
    fast = applied(force_model, [0, 1], qvel=[0, 1.0, 0, 0, 0, 0, 0])
    slow = applied(force_model, [0, 1], qvel=[0, 0.1, 0, 0, 0, 0, 0])
    assert fast[1] == pytest.approx(-3.0 / MASS, rel=1e-4)
    assert abs(slow[1]) < 0.01 * abs(fast[1])


def test_a_resistance_to_turning_is_a_torque():
    force_model = body_force_model([[2.0]], "turning", scale=0.1)
    found = applied(force_model, [1.0], qvel=[0, 0, 0, 0, 0, 2.0, 0])
    assert found[5] == pytest.approx(-0.1 / INERTIA, rel=1e-3)
    assert found[:3] == pytest.approx(0.0)


@pytest.mark.parametrize("moving", [False, True])
def test_a_joint_force_depends_on_the_joint_alone(moving):
    of, dof = np.array([6 if moving else 7]), np.array([6])
    force_model = UnknownJointForce(of, dof, np.array([[-0.2, 0.0, 0.2]]), np.array([4.0]), moving=moving)
    state = {"qvel" if moving else "qpos": [0, 0, 0, 0, 0, 0, 0.2] if moving else [0, 0, 0, 1, 0, 0, 0, 0.2]}
    assert applied(force_model, [0, 0, 1], **state)[6] == pytest.approx(4.0 / 0.5)
    assert applied(force_model, [0, 1, 0], **state)[6] == pytest.approx(4.0 / 0.5 * np.exp(-0.5))


def test_at_size_null_it_does_nothing_and_it_is_not_registered():
    force_model = body_force_model([[0, 0, 0]], "field")
    effect = UnknownForce("a force", force_model)
    parameters = effect.parameters(mujoco.MjModel.from_xml_string(LOOSE))
    assert len(parameters) == force_model.count
    assert applied(force_model, [p.null for p in parameters]) == pytest.approx(0.0)
    assert effect.name not in effect_classes()
