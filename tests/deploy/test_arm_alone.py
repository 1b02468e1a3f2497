"""The arm taken out of its scene."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import concent_warp as cw
from concent_warp.deploy.explain.arm_alone import arm_alone, in_whole_scene, readings_alone, with_arm_alone
from concent_warp.recording.recording import Recording
from concent_warp.train.task.task import Task

GRASPED = (np.array([0.001, 0.002, 0.01]), Rotation.from_rotvec([0.0, 0.0, 0.3]))


@pytest.fixture(scope="module")
def policy() -> cw.Policy:
    return cw.load_policy("shape_sorter")


@pytest.fixture(scope="module")
def task(policy: cw.Policy) -> Task:
    return policy.run.task()


@pytest.fixture(scope="module")
def alone(policy: cw.Policy, task: Task) -> cw.Model:
    return arm_alone(policy.run.model, task, GRASPED)


def joint_forces(m: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, dofs: np.ndarray) -> np.ndarray:
    """Return gravity, velocity and passive forces and the inertia of some joints."""
    data = mujoco.MjData(m)
    data.qpos, data.qvel = qpos, qvel
    mujoco.mj_forward(m, data)
    inertia = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, data, inertia)
    return np.concatenate([(data.qfrc_bias - data.qfrc_passive)[dofs], inertia[np.ix_(dofs, dofs)].ravel()])


def test_only_the_joints_of_the_arm_move_and_nothing_touches(alone: cw.Model) -> None:
    m = alone.compile()
    assert (m.nv, m.nu, m.ngeom) == (7, 7, 0)
    assert [m.joint(j).name for j in range(m.njnt)] == [f"joint{k}" for k in range(1, 8)]


def test_the_arm_is_as_heavy_as_with_the_object_in_its_hand(policy: cw.Policy, task: Task, alone: cw.Model) -> None:
    m, one = task.compiled, alone.compile()
    arm, block = task.robot, task.objects[0]
    rng = np.random.default_rng(0)
    qpos, qvel = m.qpos0.copy(), np.zeros(m.nv)
    qpos[arm.qpos], qvel[arm.dof] = rng.uniform(-1, 1, 7), rng.uniform(-1, 1, 7)
    empty = arm_alone(policy.run.model, task, None).compile()
    found = joint_forces(one, qpos[arm.qpos], qvel[arm.dof], np.arange(7))
    without = joint_forces(empty, qpos[arm.qpos], qvel[arm.dof], np.arange(7))
    # The load at the grasp, by the Jacobian of its centre of mass: without rotation it adds J' (m I) J to the inertia.
    data = mujoco.MjData(m)
    data.qpos = qpos
    mujoco.mj_forward(m, data)
    turn = data.site_xmat[arm.tool].reshape(3, 3)
    centre = data.site_xpos[arm.tool] + turn @ (GRASPED[0] + GRASPED[1].apply(m.body_ipos[block]))
    place, angle = np.zeros((3, m.nv)), np.zeros((3, m.nv))
    mujoco.mj_jac(m, data, place, angle, centre, int(m.site_bodyid[arm.tool]))
    place, angle = place[:, arm.dof], angle[:, arm.dof]
    frame = turn @ GRASPED[1].as_matrix() @ Rotation.from_quat(m.body_iquat[block], scalar_first=True).as_matrix()
    inertia = frame @ np.diag(m.body_inertia[block]) @ frame.T
    expected = m.body_mass[block] * place.T @ place + angle.T @ inertia @ angle
    np.testing.assert_allclose((found - without)[7:].reshape(7, 7), expected, atol=1e-9)
    # What the fingers' own joints, held at their zero here, and the arm have is that of the scene.
    bare = joint_forces(m, qpos, qvel, arm.dof)
    np.testing.assert_allclose(without, bare, atol=1e-9)


def test_readings_and_commands_of_the_arm_are_kept(policy: cw.Policy, alone: cw.Model) -> None:
    found = readings_alone(policy.run.recording, alone)
    d = found[0]
    assert set(d.action) == {f"joint{k}" for k in range(1, 8)}
    assert set(d.measured) == {f"joint{k}_position" for k in range(1, 8)}
    assert d.qpos is None
    alone.check_recording(found)


def test_whatever_else_is_in_the_scene_is_left_out(policy: cw.Policy, task: Task) -> None:
    model, free = policy.run.model, policy.run.recording
    found, recording = with_arm_alone(model, task, GRASPED, free)
    assert found.compile().nv == 7
    assert recording.scene == found.scene.xml
    touched = '<contact><exclude body1="hand" body2="link1"/></contact><sensor><touch site="tcp" name="felt"/></sensor>'
    bound = replace(model, scene=cw.Scene(model.scene.xml.replace("</mujoco>", f"{touched}</mujoco>")))
    assert with_arm_alone(bound, task, GRASPED, free)[0].compile().nsensor == found.compile().nsensor
    hung = '<body name="hanging"><joint name="swing"/><geom size=".1"/></body></worldbody>'
    loose = replace(model, scene=cw.Scene(model.scene.xml.replace("</worldbody>", hung)))
    assert with_arm_alone(loose, task, GRASPED, free)[0].compile().nv == 7


def test_a_scene_that_lacks_a_part_stays_whole(policy: cw.Policy, task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise ValueError("a plugin has lost its joint")

    monkeypatch.setattr("concent_warp.deploy.explain.arm_alone._carry", refuse)
    model, free = policy.run.model, policy.run.recording
    assert with_arm_alone(model, task, GRASPED, free) == (model, free)


def test_effects_come_back_into_the_whole_scene(policy: cw.Policy, task: Task) -> None:
    whole = policy.run.model.add_effect("pad_friction", values={"coefficient": 0.8})
    whole = whole.add_effect("mass", ("block",), {"mass": 1.5}).add_effect("mass", ("link6",), {"mass": 1.2})
    whole = whole.add_effect("gravity_tilt", values={"x": 0.01})
    alone = arm_alone(whole, task, GRASPED)
    assert [a.effect.name for a in alone.effects] == ["mass", "mass", "gravity_tilt"]
    nominal, heavier = policy.run.model.compile(), alone.compile()
    for name, factor in (("block", 1.5), ("link6", 1.2)):
        assert heavier.body(name).mass[0] == pytest.approx(factor * nominal.body(name).mass[0])
    for kind in cw.effect_classes().values():
        if kind.kind == "body":  # what acts on a part of the arm alone acts on one of the whole
            targets = {name for group in kind.targets(heavier) for name in kind(*group).elements}
            assert all(policy.run.model.scene.spec().body(name) for name in targets)
    refitted = replace(alone.effects[2], values=(0.02, 0.0))
    damped = replace(alone, effects=(*alone.effects[:2], refitted)).add_effect("actuator_delay", values={"delay": 0.02})
    recording = Recording(alone.scene.xml, readings_alone(policy.run.recording, alone).demonstrations)
    cfg = cw.DiagnoseCfg(effects=("gravity_tilt",), jobs=1, explain=False, seconds=1.0)
    diagnosis = replace(cw.diagnose(alone, recording, cfg), models=(alone, damped))
    found = in_whole_scene(diagnosis, whole)
    names = [a.effect.name for a in found.model.effects]
    assert names == ["pad_friction", "mass", "mass", "gravity_tilt", "actuator_delay"]
    assert found.model.effects[3].values == (0.02, 0.0)
    assert found.model.scene is whole.scene
    assert found.models[0].effects == whole.effects
