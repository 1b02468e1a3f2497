"""What is read off a model, a demonstration and its events."""

from dataclasses import replace

import numpy as np
import pytest
from small_insertion import EXACT_STATE, SETTINGS, make_demonstration, make_model, make_task

from concent_warp.errors import TrainError
from concent_warp.model import Model
from concent_warp.reality.record import RealityCfg, record
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.train.cfg import ActionCfg, EnvironmentCfg, TrainCfg
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.observation import ObservationLayout
from concent_warp.train.environment.physics import MujocoPhysics
from concent_warp.train.observation_cfg import ObservationCfg
from concent_warp.train.reset_cfg import ResetCfg
from concent_warp.train.resets.reset_states import ResetSampler
from concent_warp.train.resets.sample import sample_reset_states
from concent_warp.train.task.slots import _select_pairs
from concent_warp.train.task.task import Task


@pytest.fixture(scope="module")
def sorter() -> Task:
    recording, _ = record(RealityCfg(), [0])
    scene = Scene(recording.scene)
    model = Model(scene, ContactGeometryCfg(count=300).build(scene))
    return Task.build(model, recording[0], EnvironmentCfg())


def test_observation_of_the_shape_sorter_is_the_papers_table(sorter):
    layout = ObservationLayout.of(sorter, ObservationCfg(leads=False))
    paper = (
        ("joint angles", 14),
        ("joint velocities", 7),
        ("gripper opening", 1),
        ("gripper command", 1),
        ("end effector", 3),
        ("object 1", 9),
        ("object 2", 9),
        *((f"slot {i}", 13) for i in range(8)),
    )
    assert layout.parts == paper
    assert layout.base == 44
    assert layout.size == 148
    with_leads = ObservationLayout.of(sorter, ObservationCfg())
    assert with_leads.parts == (*paper[:2], ("command leads", 7), *paper[2:])
    assert with_leads.base == 51
    assert with_leads.size == 155
    assert sorter.robot.actions == 8


def test_observation_of_the_shape_sorter_reads_the_state(sorter):
    states = sample_reset_states(sorter, ResetCfg(), 0, count=2)
    physics = MujocoPhysics(sorter.compiled, 2, 10)
    environment = Environment(sorter, EnvironmentCfg(worlds=2, observation=EXACT_STATE), physics, states)
    environment.start_from([0, 1])
    shown, layout = environment.observation.numpy(), environment.layout
    arm = states.qpos[:, :7]
    np.testing.assert_allclose(
        shown[:, layout.columns("joint angles")], np.hstack([np.sin(arm), np.cos(arm)]), atol=1e-6
    )
    leads = (states.ctrl[:, sorter.robot.actuator] - arm) / sorter.robot.lead
    np.testing.assert_allclose(shown[:, layout.columns("command leads")], leads, atol=1e-5)
    fingers = states.qpos[:, 7:9].mean(axis=1)
    np.testing.assert_allclose(shown[:, layout.columns("gripper opening")][:, 0], fingers, atol=1e-6)
    np.testing.assert_allclose(shown[:, layout.columns("gripper command")][:, 0], states.ctrl[:, 7], atol=1e-6)
    np.testing.assert_allclose(shown[:, layout.columns("end effector")], physics.site[:, sorter.robot.tool], atol=1e-6)
    box = sorter.model.scene.model.body("box")
    np.testing.assert_allclose(shown[:, layout.columns("object 2")][:, :3], np.tile(box.pos, (2, 1)), atol=1e-6)
    assert (shown[:, layout.columns("slot 0")][:, 0] == 1).all()


def test_slots_keep_every_pair_of_bodies_and_favour_the_stages_own(sorter):
    stage = sorter.events.stages[sorter.stage]
    chosen = _select_pairs(sorter.events, stage, 8)
    bodies = [(sorter.events.entity[p.a].body, sorter.events.entity[p.b].body) for p in chosen]
    every = {(sorter.events.entity[p.a].body, sorter.events.entity[p.b].body) for p in stage.event.pairs}
    assert len(chosen) == 8
    assert set(bodies) == every
    touching = sum(sorter.events.entity[p.b].body == "box" for p in stage.event.pairs)
    assert bodies.count(("block", "box")) == min(touching, 8 - (len(every) - 1))
    assert len(set(chosen)) == 8
    assert _select_pairs(sorter.events, stage, 1)[0] in stage.event.pairs


def test_place_of_success_is_the_seat_in_the_hole(task):
    np.testing.assert_allclose(task.target_position, [0.0, 0.0, 0.023], atol=0.0025)


def test_unknown_stage_site_and_delays_are_refused():
    model = make_model()
    demonstration = make_demonstration(model)
    with pytest.raises(TrainError, match="no such stage"):
        Task.build(model, demonstration, replace(SETTINGS, stage="fly"))
    with pytest.raises(TrainError, match="tool-site"):
        make_task(replace(SETTINGS, action=replace(SETTINGS.action, tool_site="nose")))
    with pytest.raises(TrainError, match="contact geometry"):
        Task.build(model.with_geometry(None), demonstration, SETTINGS)
    assert len(make_task(replace(SETTINGS, action=ActionCfg(gripper_actuators=()))).robot.step) == 4


def test_displaced_states_keep_the_block_in_the_hand(task, states):
    import mujoco

    d = mujoco.MjData(task.compiled)

    def in_hand(qpos: np.ndarray) -> np.ndarray:
        d.qpos[:] = qpos
        mujoco.mj_kinematics(task.compiled, d)
        return d.xpos[task.objects[0]] - d.site_xpos[task.robot.tool]

    for qpos, time in zip(states.qpos, states.time, strict=True):
        demonstrated = task.replay.qpos[task.replay.row(time)]
        assert np.abs(in_hand(qpos) - in_hand(demonstrated)).max() < SETTINGS.reset.slip
    shift = [q[:2] - task.replay.qpos[task.replay.row(t)][:2] for q, t in zip(states.qpos, states.time, strict=True)]
    assert np.abs(shift).max() > 0.5 * SETTINGS.reset.position
    assert set(states.case) <= {2, 3}


def test_what_is_held_is_turned_about_the_axis_along_which_it_is_held(task):
    cfg = replace(SETTINGS.reset, demonstrated=0.0, turn=0.0, grasp_turn=0.2)
    found = sample_reset_states(task, cfg, 0, count=24)
    # The fingers close along y: the block turns about y by up to 0.2 rad, and about nothing else.
    angles = 2 * np.arcsin(found.qpos[:, 4:7] * np.sign(found.qpos[:, 3:4]))
    assert np.abs(angles[:, 1]).max() > 0.1
    assert np.ptp(angles[:, 1]) > 0.2
    assert np.abs(angles[:, 1]).max() < 0.25
    assert np.abs(angles[:, [0, 2]]).max() < 0.05


def test_states_follow_from_the_seed_and_arms_reach_theirs(sorter):
    first, again, other = (sample_reset_states(sorter, ResetCfg(), seed, count=8) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.qpos, again.qpos)
    assert np.abs(first.qpos - other.qpos).max() > 1e-3
    assert sum(first.discarded.values()) < 20


def test_states_are_sampled_from_before_the_preceding_stage_or_from_a_time_after_its_start(sorter):
    earlier, stage = sorter.events.stages[sorter.stage - 1 : sorter.stage + 1]
    assert sorter.stage > 0
    for before, start in ((0.3, earlier.start - 0.3), (1e3, 0.0), (-0.1, earlier.start + 0.1), (-1e3, stage.start)):
        window = ResetSampler(sorter, ResetCfg(before=before), 0, "cpu").window
        np.testing.assert_allclose(window, (start, stage.start, stage.event.time))
    states = sample_reset_states(sorter, ResetCfg(before=-1e3), 0, count=4)
    assert len(states.qpos) == 4


def test_impossible_displacements_are_given_up_with_counts(task):
    with pytest.raises(TrainError, match="unreachable"):
        sample_reset_states(task, replace(SETTINGS.reset, turn=1.0, demonstrated=0.0), 0, count=3)


def test_configuration_comes_back_from_its_file(tmp_path):
    cfg = TrainCfg(seed=3, environment=SETTINGS)
    cfg.save(tmp_path / "train.toml")
    assert TrainCfg.load(tmp_path / "train.toml") == cfg
    (tmp_path / "train.toml").write_text("seeds = 3\n")
    with pytest.raises(TrainError, match="unknown entries"):
        TrainCfg.load(tmp_path / "train.toml")
    with pytest.raises(TrainError, match="worlds"):
        TrainCfg(environment=EnvironmentCfg(worlds=0))
