"""Diagnoses of a ball whose rebounds differ from any law of contact, each by itself, as those of real balls do."""

from __future__ import annotations

from functools import cache

import mujoco
import numpy as np
import pytest

import concent_warp as cw
from concent_warp.diagnosis.cfg import SearchCfg
from concent_warp.diagnosis.result import Diagnosis
from concent_warp.recording.recording import Channel, Demonstration, Recording

STEP, NOISE, TURN_NOISE, SECONDS, RATE = 0.002, 4e-4, 4e-3, 0.5, 100
RADIUS, MASS, DRAG = 0.03, 0.02, 0.001
"""Radius [m], mass [kg] and resistance over the square of the speed [N s^2/m^2] of the ball."""
SCENE = f"""
<mujoco>
  <option timestep="{STEP}"/>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 0.1" solref="-40000 -20" friction="0.3"/>
    <body name="ball" pos="0 0 1">
      <freejoint/>
      <geom name="ball" type="sphere" size="{RADIUS}" mass="{MASS}" solref="-40000 -20" friction="0.3"/>
    </body>
  </worldbody>
  <sensor>
    <framepos name="place" objtype="body" objname="ball"/>
    <framequat name="orientation" objtype="body" objname="ball"/>
  </sensor>
</mujoco>"""
CANDIDATES = ("air_drag", "wind", "gravity_tilt", "contact_compliance", "sliding_friction", "inertia", "time_base")


def thrown(drag: float, error: float, seed: int) -> Demonstration:
    """Return a throw that rebounds once.

    Args:
        drag: Resistance over the square of the speed [N s^2/m^2].
        error: Standard deviation of the velocity after an impact over its change [-].
        seed: Of the throw, of its impacts and of the noise.
    """
    rng = np.random.default_rng(seed)
    m = mujoco.MjModel.from_xml_string(SCENE)
    d = mujoco.MjData(m)
    d.qpos[2] = rng.uniform(0.35, 0.6)
    d.qvel[:3], d.qvel[3:] = rng.uniform([1.5, -0.5, -1.0], [3.0, 0.5, 0.5]), rng.normal(0, 6, 3)
    rows, before = [], None
    for _ in range(round(SECONDS / STEP) + 1):
        rows.append(np.concatenate([d.qpos, d.qvel]))
        d.xfrc_applied[1, :3] = -drag * np.linalg.norm(d.qvel[:3]) * d.qvel[:3]
        mujoco.mj_step(m, d)
        if d.ncon and before is None:
            before = rows[-1][7:10].copy()
        elif not d.ncon and before is not None:
            change = float(np.linalg.norm(d.qvel[:3] - before))
            d.qvel[:3] += error * change * rng.normal(size=3)
            d.qvel[3:] += error * change / RADIUS * rng.normal(size=3)
            before = None
    path = np.array(rows[:: round(1 / RATE / STEP)])
    time = np.arange(len(path)) / RATE
    turned = path[:, 3:7] + TURN_NOISE / 2 * rng.normal(size=(len(path), 4))
    seen = {
        "place": Channel(time, path[:, :3] + NOISE * rng.normal(size=(len(path), 3)), NOISE),
        "orientation": Channel(time, turned / np.linalg.norm(turned, axis=1, keepdims=True), TURN_NOISE),
    }
    return Demonstration(f"throw_{seed}", measured=seen)


def dropped(restitution: float, seed: int) -> Demonstration:
    """Return a throw that rebounds at once, by Newton's law, of which the position is tracked.

    Args:
        restitution: Speed after over speed before an impact [-].
        seed: Of the throw and of the noise.
    """
    rng = np.random.default_rng(seed)
    time, g = np.arange(round(0.6 * RATE)) / RATE, 9.81
    height, up, begun = rng.uniform(0.15, 0.4), rng.uniform(-0.3, 0.5), 0.0
    z = np.empty(len(time))
    while begun <= time[-1]:
        t = time - begun
        z[t >= 0] = (height + up * t - g * t**2 / 2)[t >= 0]
        speed = float(np.sqrt(up**2 + 2 * g * height))
        begun, height, up = begun + (up + speed) / g, 0.0, restitution * speed
    x, y = (rng.uniform(-0.2, 0.2) + rng.uniform(-1, 1) * time for _ in range(2))
    place = np.stack([x, y, RADIUS + z], axis=1) + NOISE * rng.normal(size=(len(time), 3))
    return Demonstration(f"throw_{seed}", measured={"place": Channel(time, place, NOISE)})


@cache
def throws(drag: float, error: float, count: int = 5) -> Recording:
    return Recording(SCENE, tuple(thrown(drag, error, seed) for seed in range(count)))


def diagnosed(recording: Recording, effects: tuple[str, ...], search: SearchCfg | None = None) -> Diagnosis:
    cfg = cw.DiagnoseCfg(jobs=1, explain=False, effects=effects, search=search or SearchCfg())
    return cw.diagnose(cw.Model.from_recording(recording), recording, cfg)


@pytest.mark.slow
def test_drag_is_found_beside_rebounds_that_no_law_foretells():
    found = diagnosed(throws(DRAG, 0.01), CANDIDATES)
    assert found.verdict == "effect"
    assert [f.name for f in found.accepted] == ["air_drag"]
    assert any("impacts" in sentence for sentence in found.issues)
    # Without an allowance for them they count as missing physics.
    strict = diagnosed(throws(DRAG, 0.01), ("air_drag",), SearchCfg(impact_error=0.0))
    assert (strict.verdict, [f.name for f in strict.accepted]) != ("effect", ["air_drag"])


def test_rebounds_that_are_as_the_model_has_them_need_no_allowance():
    found = diagnosed(throws(DRAG, 0.0, 3), CANDIDATES)
    assert found.verdict == "effect"
    assert [f.name for f in found.accepted] == ["air_drag"]
    assert not any("impacts" in sentence for sentence in found.issues)


def test_rebounds_of_a_rigid_contact_are_no_effect_of_anything_else():
    # The simulated contact of the model lasts 8 ms: with it a ball seems to rebound from a floor that lies higher.
    scene = SCENE.replace('<framequat name="orientation" objtype="body" objname="ball"/>', "")
    scene = scene.replace("-40000 -20", "-160000 -56").replace('friction="0.3"', 'condim="1"')
    recording = Recording(scene, tuple(dropped(0.8, seed) for seed in range(3)))
    found = diagnosed(recording, ("frame_offset", "size", "wind"))
    assert (found.verdict, [f.name for f in found.accepted]) == ("none_needed", [])
    assert any("impacts" in sentence for sentence in found.issues)
