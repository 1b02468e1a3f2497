"""Diagnoses of balls of which the height alone was measured, in logs that no engine of the library made."""

from __future__ import annotations

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.recording.recording import Channel, Demonstration, Recording

MASS, RADIUS, GRAVITY = 0.0027, 0.05, 9.81
DRAG = 0.5 * 1.2 * 0.47 * np.pi * RADIUS**2
"""Resistance of a sphere in air over the square of the speed [N s^2/m^2]."""
SCENE = f"""
<mujoco><option timestep="0.004" integrator="implicitfast"/><worldbody>
  <body name="ball" pos="0 0 0.3"><freejoint/>
    <geom type="sphere" size="{RADIUS}" mass="{MASS}" contype="0" conaffinity="0"/></body></worldbody>
<sensor><framepos name="place" objtype="body" objname="ball"/></sensor></mujoco>"""


def thrown_up(speed: float) -> Recording:
    """Return heights of a light ball that is thrown up, slowed by the air, and falls."""
    limit = np.sqrt(MASS * GRAVITY / DRAG)
    time, rng = np.arange(0, 0.9, 1 / 60), np.random.default_rng(1)
    rise = limit / GRAVITY * np.arctan(speed / limit)
    up = np.cos(np.arctan(speed / limit) - GRAVITY * np.minimum(time, rise) / limit)
    height = limit**2 / GRAVITY * np.log(up / np.cos(np.arctan(speed / limit)))
    height -= limit**2 / GRAVITY * np.log(np.cosh(GRAVITY * np.maximum(time - rise, 0.0) / limit))
    place = np.full((len(time), 3), np.nan)
    place[:, 2] = np.round(0.3 + height + 4e-4 * rng.normal(size=len(time)), 4)
    return Recording(SCENE, (Demonstration("throw", measured={"place": Channel(time, place)}),))


def test_the_drag_of_a_light_ball_that_the_air_stops_is_found_with_its_value():
    recording = thrown_up(6.0)
    cfg = cw.DiagnoseCfg(effects=("air_drag",), jobs=1, explain=False, max_additions=1)
    found = cw.diagnose(cw.Model.from_recording(recording), recording, cfg)
    assert (found.verdict, found.groups) == ("effect", (("air_drag",),))
    # MuJoCo's ellipsoid has a drag coefficient of 1 in place of a sphere's 0.47.
    assert found.accepted[0].parameters[0].value == pytest.approx(0.47 * 1.2, rel=0.03)
