from dataclasses import replace

import numpy as np
import pytest

from concent_warp.diagnosis.experiment.joint_motions import Drives, commanded_motion
from concent_warp.diagnosis.suggestion.cfg import MotionLimitsCfg
from concent_warp.diagnosis.suggestion.forecast import courses
from concent_warp.diagnosis.suggestion.limits import MotionLimits
from concent_warp.errors import ConcentError
from tests.diagnosis.suggestion.carts import friction_or_damping, one_speed, recorded_range

WALL = '<body name="wall" pos=".3 0 0"><geom size=".1" /></body>'


def excess(command, cfg=None, more=""):
    recording = one_speed(more=more)
    recorded = recorded_range(recording)
    drives = Drives.of(recorded)
    assert drives is not None
    motion = commanded_motion(recorded, drives, "m", "m", np.asarray(command)[:, None])
    (course,) = courses(friction_or_damping(recording), recorded, [motion], "mujoco")
    assert course is not None
    return MotionLimits(recorded, cfg or MotionLimitsCfg(), "mujoco").excess(motion, course)


TIME = np.arange(0, 2, 0.01)
SLOW = 0.05 * np.sin(1.0 * TIME)


def test_a_motion_like_the_recorded_one_is_within_the_limits():
    assert excess(SLOW).size == 0
    assert excess(SLOW).words == ()


@pytest.mark.parametrize(
    ("command", "word"),
    [(0.09 * np.sin(6 * TIME), "speed of rail"), (0.15 * np.sin(0.5 * TIME), "range of rail")],
)
def test_what_is_exceeded_is_named(command, word):
    found = excess(command)
    assert found.size > 0
    assert word in found.words


def test_force_is_limited_where_the_actuator_has_no_limit():
    assert "force of drive" in excess(np.where(TIME < 1, -0.09, 0.09)).words


def test_wider_limits_allow_more():
    fast = 0.09 * np.sin(3 * TIME)
    assert excess(fast).size > 0
    assert excess(fast, MotionLimitsCfg(speed=4, unlimited_force=10)).size == 0


def test_links_stay_in_a_stated_workspace():
    box = MotionLimitsCfg(workspace=(-0.02, -1, -1, 0.02, 1, 1))
    assert excess(SLOW, box).words == ("workspace",)
    with pytest.raises(ConcentError, match="workspace is no box"):
        excess(SLOW, replace(box, workspace=(1.0, 2.0)))


def test_links_touch_nothing_that_they_do_not_touch_in_the_recording():
    cfg = MotionLimitsCfg(reach=3, speed=5, unlimited_force=10, workspace_margin=1)
    far = 0.15 * np.sin(1.5 * TIME)
    assert excess(far, cfg).size == 0
    assert excess(far, cfg, more=WALL).words == ("contact of cart and wall",)
    assert excess(far, replace(cfg, contacts=True), more=WALL).size == 0
