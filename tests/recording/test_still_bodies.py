"""Readings that move of bodies that cannot."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.recording.still_bodies import warn_of_still_bodies

SCENE = """<mujoco><worldbody><body name="target" mocap="true"><geom size="0.1"/></body>
<body name="block" pos="1 0 0"><geom size="0.1"/><site name="marker"/></body>
<body name="free" pos="2 0 0"><freejoint/><geom size="0.1"/></body></worldbody>
<sensor><framepos name="target" objtype="body" objname="target"/>
<framepos name="marker" objtype="site" objname="marker"/>
<framepos name="free" objtype="body" objname="free"/></sensor></mujoco>"""
TIME = np.arange(0, 2, 0.01)


def recorded(distance):
    rng = np.random.default_rng(0)
    value = np.stack([distance * np.sin(3 * TIME), 0 * TIME, 0 * TIME], axis=1) + rng.normal(0, 5e-4, (len(TIME), 3))
    measured = {name: Channel(TIME, value) for name in ("target", "marker", "free")}
    return Recording(SCENE, (Demonstration("demo_0", measured=measured),))


def test_readings_that_move_of_bodies_that_cannot_are_named():
    with pytest.warns(UserWarning, match="moves, but") as said:
        warn_of_still_bodies(recorded(0.2))
    words = [str(one.message) for one in said]
    assert len(words) == 2
    assert "measured/target moves, but target, a mocap body, cannot: simulations leave it" in words[0]
    assert "measured/marker moves, but block cannot: it has no joint" in words[1]


def test_a_fixed_body_is_no_mocap_body_by_its_name():
    scene = SCENE.replace('"block"', '"mocap_base"')
    with pytest.warns(UserWarning, match="measured/marker moves, but mocap_base cannot: it has no joint"):
        warn_of_still_bodies(replace(recorded(0.2), scene=scene))


def test_noise_and_drift_of_a_fixed_marker_are_no_motion():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_still_bodies(recorded(0.003))
