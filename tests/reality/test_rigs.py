"""Rigs record what their world does, the same for the same seed, and like their drawing where nothing is hidden."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from concent_warp.reality.hidden.registry import hidden
from concent_warp.reality.rigs.registry import RIGS
from concent_warp.reality.rigs.rig import perform, record_rig
from concent_warp.reality.sensors.instruments import Instrument
from concent_warp.recording.recording import Recording
from concent_warp.recording.validation.validate import validate

QUICK = ("pendulum", "drop", "tumble", "spin", "push")


def same(first: Recording, second: Recording) -> bool:
    return all(
        np.array_equal(a.measured[name].value, b.measured[name].value)
        for a, b in zip(first.demonstrations, second.demonstrations, strict=True)
        for name in a.measured
    )


@pytest.mark.parametrize("name", QUICK)
def test_recording_is_valid_and_repeats_itself(name: str):
    rig = RIGS[name]
    recording = record_rig(rig, seed=3)
    validate(recording)
    assert len(recording.demonstrations) == rig.throws
    assert same(recording, record_rig(rig, seed=3))
    assert not same(recording, record_rig(rig, seed=4))


def test_channels_have_clocks_of_their_own_and_tell_their_noise():
    measured = record_rig(RIGS["push"])[0].measured
    clocks = {name: channel.time for name, channel in measured.items()}
    assert len({float(t[0]) for t in clocks.values()}) == len(clocks)
    assert all(channel.noise_std for channel in measured.values())


def test_noise_has_the_stated_std():
    instrument = Instrument(100.0, 3e-3, 1e-3)
    time = np.arange(40000) / 100
    noise = instrument.noise(time, 3, np.random.default_rng(0))
    assert noise.std() == pytest.approx(instrument.std, rel=0.03)
    slow = noise.reshape(-1, 50, 3).mean(axis=1)
    assert slow.std() > 1.5 * 3e-3 / np.sqrt(50)


def test_pendulum_drawing_replays_to_within_the_noise_where_nothing_is_hidden_and_not_with_friction():
    rig = RIGS["pendulum"]
    model = rig.scene.model

    def ratio(*names: tuple[str, float]) -> float:
        recording = record_rig(rig, [hidden(n, v, rig).effect for n, v in names], seed=1)
        demonstration = recording[0]
        data = mujoco.MjData(model)
        at, value = demonstration.action["servo"].time, demonstration.action["servo"].value
        seen = demonstration.measured["hinge_position"]
        data.qpos[0] = seen.value[0, 0]
        steps = int(demonstration.duration / model.opt.timestep) + 1
        angle = np.empty(steps)
        for k in range(steps):
            angle[k] = data.qpos[0]
            data.ctrl[0] = value[np.searchsorted(at, k * model.opt.timestep + 1e-9, side="right") - 1]
            mujoco.mj_step(model, data)
        error = seen.value[:, 0] - np.interp(seen.time, np.arange(steps) * model.opt.timestep, angle)
        return float(np.sqrt(np.mean(error**2)) / seen.noise_std)

    assert ratio() < 1.1
    assert 3.0 < ratio(("joint_friction", 0.0156)) < 6.0


def test_grasped_block_is_lifted_shaken_and_put_back():
    height = record_rig(RIGS["grasp"])[0].measured["block_position"].value[:, 2]
    assert height.max() > 0.08
    assert height[-1] == pytest.approx(0.02, abs=2e-3)


def test_slide_stops_after_the_distance_that_friction_leaves():
    rig = RIGS["slide"]
    trial = rig.plan(np.random.default_rng(0), 0)
    motion, _, qvel = perform(rig.world().compile(), trial, (), rig.physics)
    way = motion.sensordata[-1, :2] - motion.sensordata[0, :2]
    assert np.linalg.norm(way) == pytest.approx(qvel[:2] @ qvel[:2] / (2 * 0.3 * 9.81), rel=0.02)


def test_effects_without_hooks_that_act_leave_the_data_as_they_were():
    rig = RIGS["drop"]
    assert same(record_rig(rig), record_rig(rig, [hidden("air_drag", 0.0, rig).effect]))
