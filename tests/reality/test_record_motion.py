"""Given motions are performed in Reality with the same hidden effects, and recorded by the same instruments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from concent_warp.errors import ConcentError, RecordingError
from concent_warp.reality.expert.plan import ExpertCfg
from concent_warp.reality.hidden.registry import hidden
from concent_warp.reality.record import RealityCfg, record
from concent_warp.reality.record_motion import record_motion, record_rig_motion, renumbered
from concent_warp.reality.rigs.registry import RIGS
from concent_warp.reality.rigs.rig import record_rig
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.recording.validation.validate import validate

PENDULUM = RIGS["pendulum"]


def swing(scene: str = PENDULUM.scene.xml, actuator: str = "servo") -> Recording:
    time = np.arange(0, 1.5, 0.01)
    motion = Demonstration(
        "demo_0", qpos=np.zeros(1), qvel=np.zeros(1), action={actuator: Channel(time, 0.8 * np.sin(4 * time))}
    )
    return Recording(scene, (motion,))


def angle(recording: Recording) -> Channel:
    return recording[0].measured["hinge_position"]


def test_a_rig_follows_given_commands_and_hides_its_effects():
    free = record_rig_motion(PENDULUM, swing())
    validate(free)
    rubbed = record_rig_motion(PENDULUM, swing(), [hidden("joint_friction", 0.2, PENDULUM).effect])
    assert np.abs(np.interp(free[0].action["servo"].time, angle(free).time, angle(free).value[:, 0])).max() > 0.7
    assert np.abs(angle(rubbed).value - angle(free).value).max() > 0.02
    assert np.array_equal(free[0].action["servo"].value, swing()[0].action["servo"].value)


def test_noise_is_that_of_the_seed_and_not_that_of_the_demonstration():
    first, again = record_rig_motion(PENDULUM, swing(), seed=1), record_rig_motion(PENDULUM, swing(), seed=1)
    other = record_rig_motion(PENDULUM, swing(), seed=2)
    assert np.array_equal(angle(first).value, angle(again).value)
    assert not np.array_equal(angle(first).value, angle(other).value)
    assert not np.array_equal(angle(first).time, angle(record_rig(PENDULUM, (), 1, 1)).time[: len(angle(first).time)])


def test_a_thrown_object_starts_as_given():
    rig = RIGS["slide"]
    thrown = record_rig(rig)[0]
    state = replace(thrown, qpos=np.array([0, 0, 0.3, 1, 0, 0, 0]), qvel=np.array([0.5, 0, 0, 0, 0, 0]))
    seen = record_rig_motion(rig, Recording(rig.scene.xml, (state,)))[0].measured["block_position"]
    falling = seen.time < 0.2
    expected = np.stack([0.5 * seen.time, 0 * seen.time, 0.3 - 4.905 * seen.time**2], axis=1)
    assert np.abs(seen.value - expected)[falling].max() < 0.005


def test_motions_of_another_scene_are_refused():
    with pytest.raises(RecordingError, match="another scene than Reality's"):
        record_rig_motion(RIGS["push"], swing())
    with pytest.raises(RecordingError, match="does not command every actuator"):
        record_rig_motion(PENDULUM, swing(actuator="motor"))
    with pytest.raises(RecordingError, match="no initial positions"):
        record_rig_motion(PENDULUM, replace(swing(), demonstrations=(replace(swing()[0], qpos=None),)))
    with pytest.raises(ConcentError, match="scripted expert only"):
        record_rig_motion(RIGS["insertion"], swing())


def test_a_demonstration_of_a_task_is_performed_again():
    cfg = RealityCfg(expert=ExpertCfg(speed=2.0))
    recording, _ = record(cfg, [0])
    again = record_motion(cfg, recording)
    validate(again)
    both = renumbered([recording, again])
    assert [d.name for d in both.demonstrations] == ["demo_0", "demo_1"]
    first, second = (d.measured["block_position"] for d in both.demonstrations)
    count = min(len(first.time), len(second.time))
    assert np.abs(first.value[:count] - second.value[:count]).max() < 0.02
    assert not np.array_equal(first.value[:count], second.value[:count])
