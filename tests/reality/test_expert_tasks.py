"""Tasks of the scripted expert beside the shape sorter: a round peg in a hole, and a block on another one."""

import mujoco
import numpy as np
import pytest

from concent_warp.cli import main
from concent_warp.errors import SceneError
from concent_warp.reality.record import RealityCfg, Truth, record
from concent_warp.reality.world import WorldCfg, chamfered_cylinder
from concent_warp.recording.load import load_recording
from concent_warp.recording.validation.validate import validate
from concent_warp.scene.round_peg import RoundPegCfg
from concent_warp.scene.scene import Scene
from concent_warp.scene.shape_sorter import ShapeSorterCfg
from concent_warp.scene.stacking import StackingCfg

TASKS = {"round_peg": RoundPegCfg(), "stacking": StackingCfg()}


@pytest.fixture(scope="module", params=list(TASKS))
def shown(request):
    task = TASKS[request.param]
    return task, *record(RealityCfg(), [0, 1], task=task)


def touch(truth: Truth, one: str, another: str) -> np.ndarray:
    return truth.contacts[min(one, another), max(one, another)]


def test_expert_brings_the_object_to_its_place(shown):
    task, recording, truths = shown
    moved, other = task.objects
    assert [d.success for d in recording.demonstrations] == [True, True]
    assert {d.task for d in recording.demonstrations} == {task.text}
    validate(recording)
    for demonstration, truth in zip(recording.demonstrations, truths, strict=True):
        held = touch(truth, "left_finger", moved) & touch(truth, moved, "right_finger")
        touching = touch(truth, moved, other)
        assert 0 < held.argmax() < touching.argmax()
        assert touching[-1]
        assert not held[-1]
        np.testing.assert_allclose(
            demonstration.measured[f"{moved}_position"].value[-1, 2], truth.block_position[-1, 2], atol=4e-3
        )
        # At rest object 2 carries the weight of object 1.
        mass = task.peg_mass if isinstance(task, RoundPegCfg) else task.block_mass
        assert truth.box_force[-200:, 2].mean() == pytest.approx(9.81 * mass, rel=0.05)
    start = [truth.block_position[0, :2] for truth in truths]
    assert np.abs(start[0] - start[1]).max() > 1e-3


def test_places_are_judged_in_the_frame_of_the_other_object(shown):
    task, _, truths = shown
    model = task.build().model
    for truth in truths:
        data = mujoco.MjData(model)
        data.qpos[:] = truth.qpos[-1]
        mujoco.mj_kinematics(model, data)
        moved, other = (data.body(name) for name in task.objects)
        place = other.xmat.reshape(3, 3).T @ (moved.xpos - other.xpos)
        np.testing.assert_allclose(place, task.goal(), atol=3e-3)


def test_a_peg_that_is_too_wide_misses_the_hole():
    _, (truth,) = record(RealityCfg(), [0], task=RoundPegCfg(hole_diameter=0.0295))
    assert not truth.success
    assert truth.block_position[-1, 2] > 0.03


def test_hole_is_as_wide_as_stated_in_every_direction():
    task = RoundPegCfg()
    model = task.build().model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    centre, geom = np.array([*task.holder_position, 0.015]), np.zeros(1, dtype=np.int32)
    distance = [
        mujoco.mj_ray(model, data, centre, np.array([np.cos(a), np.sin(a), 0.0]), None, 1, -1, geom)
        for a in np.linspace(0, 2 * np.pi, 73)
    ]
    assert min(distance) == pytest.approx(task.hole_diameter / 2, abs=1e-6)
    assert max(distance) < 1.02 * task.hole_diameter / 2


def test_reality_has_a_chamfered_peg_of_the_same_mass():
    task = RoundPegCfg()
    world = WorldCfg(chamfer=0.002).build(task.build()).compile()
    nominal = task.build().model
    peg = world.body("peg")
    assert world.geom_type[peg.geomadr[0]] == mujoco.mjtGeom.mjGEOM_MESH
    assert peg.mass == pytest.approx(nominal.body("peg").mass)
    np.testing.assert_allclose(peg.inertia, nominal.body("peg").inertia)
    corners = chamfered_cylinder(np.array([0.015, 0.025, 0.0]), 0.002, 12)
    assert corners.shape == (48, 3)
    radius, height = np.linalg.norm(corners[:, :2], axis=1), np.abs(corners[:, 2])
    np.testing.assert_allclose(np.sort(np.unique(radius.round(9))), [0.013, 0.015])
    np.testing.assert_allclose(height[radius > 0.014], 0.023)
    np.testing.assert_allclose(height[radius < 0.014], 0.025)


def test_reality_chamfers_geoms_without_names_and_those_given_by_the_ends_of_their_axis():
    scene = Scene("""
<mujoco>
  <asset><mesh name="tee_geom0_chamfered" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>
  <worldbody>
    <body name="tee"><freejoint/>
      <geom type="box" size="0.02 0.05 0.02" mass="0.1"/>
      <geom type="box" size="0.03 0.01 0.02" pos="0.05 0 0" mass="0.1"/>
    </body>
    <body name="rod" pos="0 0 1"><freejoint/>
      <geom type="cylinder" size="0.01" fromto="0 0 0 0.1 0 0" mass="0.1"/>
    </body>
  </worldbody>
</mujoco>""")
    nominal, world = scene.model, WorldCfg(chamfer=0.002).build(scene).compile()
    assert (world.geom_type == mujoco.mjtGeom.mjGEOM_MESH).all()
    for m in (nominal, world):
        d = mujoco.MjData(m)
        mujoco.mj_forward(m, d)
        np.testing.assert_allclose(d.geom_xpos, [[0, 0, 0], [0.05, 0, 0], [0.05, 0, 1]], atol=1e-6)
    corners = world.mesh_vert[world.mesh_vertadr[world.geom_dataid[2]] :]
    assert np.ptp(corners, axis=0).max() == pytest.approx(0.1, abs=1e-5)


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_scene_states_the_goal(task):
    np.testing.assert_allclose(task.build().goal(), task.goal())
    assert task.build().objects() == task.objects
    assert ShapeSorterCfg().build().goal() is None


def test_goal_without_three_numbers_is_refused():
    text = '<mujoco><custom><numeric name="concent_goal" data="{}"/></custom><worldbody/></mujoco>'
    np.testing.assert_array_equal(Scene(text.format("1 2 3")).goal(), [1, 2, 3])
    with pytest.raises(SceneError, match="x y z in m"):
        Scene(text.format("1 2")).goal()


def test_command_records_a_task(tmp_path, capsys):
    assert main(["record", "--task", "stacking", "--out", str(tmp_path / "demo.h5")]) == 0
    assert "the block is in its place" in capsys.readouterr().out
    assert load_recording(tmp_path / "demo.h5")[0].task == StackingCfg().text
    options = ["--task", "round_peg", "--reality.task.block-mass", "0.1", "--out", str(tmp_path / "other.h5")]
    assert main(["record", *options]) == 2
    assert "of the shape sorter are given for the task round_peg" in capsys.readouterr().err
    assert not (tmp_path / "other.h5").exists()
