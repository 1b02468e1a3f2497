"""Time steps that are too long for impacts or for a stiff drive, on motions by equations written here."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import concent_warp as cw
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene
from concent_warp.simulate.parallel import limit_simulations

REBOUND = 0.55
"""Velocity after an impact over that before [-]."""
BALL = """<mujoco><option timestep="0.002"/><worldbody>
<geom name="floor" type="plane" size="2 2 0.1" solref="0.02 0.1"/>
<body name="ball" pos="0 0 0.5"><freejoint/><geom name="ball" type="sphere" size="0.03" mass="0.05" solref="0.02 0.1"/>
</body></worldbody><sensor><framepos name="position" objtype="body" objname="ball"/></sensor></mujoco>"""
MASS, GAIN, DAMPING = 3.0, 600.0, 8.0
"""Of a slide [kg], of its drive of velocity [N s/m], and of its bearing [N s/m]."""
SLIDE = f"""<mujoco><option timestep="0.002"/><worldbody><body name="carriage">
<joint name="rail" type="slide" axis="1 0 0" damping="{DAMPING}"/>
<geom name="carriage" type="box" size="0.08 0.08 0.02" mass="{MASS}" contype="0" conaffinity="0"/></body></worldbody>
<actuator><velocity name="drive" joint="rail" kv="{GAIN}"/></actuator>
<sensor><jointpos name="encoder" joint="rail"/></sensor></mujoco>"""


def bounced(height: float, seconds: float = 0.95, rate: float = 120.0) -> np.ndarray:
    """Return when and where a ball is that falls from a height and leaves the floor with `REBOUND`, shape (T, 2)."""
    clock, z, v, rows = 0.0, height, 0.0, []
    for t in np.arange(0, seconds, 1 / rate):
        while True:
            fall = (v + np.sqrt(v**2 + 2 * 9.81 * max(z - 0.03, 0.0))) / 9.81
            if clock + fall > t:
                break
            clock, z, v = clock + fall, 0.03, REBOUND * (9.81 * fall - v)
        rows.append((t, z + v * (t - clock) - 0.5 * 9.81 * (t - clock) ** 2))
    return np.array(rows)


def thrown() -> Recording:
    """Return a recording of three balls, tracked by position."""
    rng, demos = np.random.default_rng(1), []
    for k, height in enumerate((0.42, 0.5, 0.61)):
        clock, z = bounced(height).T
        track = np.stack([np.zeros_like(z), np.zeros_like(z), z], axis=1) + rng.normal(0, 5e-4, (len(z), 3))
        start = np.array([0, 0, height, 1, 0, 0, 0.0])
        demos.append(Demonstration(f"demo_{k}", measured={"position": Channel(clock, track)}, qpos=start))
    return Recording(BALL, tuple(demos))


def rebound(model: Model) -> float:
    """Return the velocity after an impact over that before in a model, the mean of a few falls."""
    m, found = model.compile(), []
    for height in np.linspace(0.4, 0.62, 40):
        d = mujoco.MjData(m)
        d.qpos[2] = height
        fastest, leaves = 0.0, 0.0
        while d.time < 0.6 and leaves <= 0.0:
            mujoco.mj_step(m, d)
            fastest = min(fastest, d.qvel[2])
            leaves = d.qvel[2] if d.qvel[2] > 0 and d.ncon == 0 else 0.0
        found.append(leaves / -fastest)
    return float(np.mean(found))


def test_the_ball_rebounds_by_its_share():
    clock, z = bounced(0.5, rate=1000.0).T
    assert z.min() >= 0.03 - 1e-9
    top = z[(clock > 0.32) & (clock < 0.62)].max()
    assert top - 0.03 == pytest.approx(REBOUND**2 * 0.47, rel=1e-3)


def test_constants_of_contacts_are_those_of_a_step_that_resolves_impacts():
    with limit_simulations(1):
        found = cw.diagnose(Model(Scene(BALL)), thrown(), cw.DiagnoseCfg(jobs=1, explain=False))
    assert found.groups == (("contact_compliance",),)
    assert found.time_step is not None
    assert found.time_step.impacts
    assert found.time_step.used < 0.5 * found.time_step.given
    assert found.time_step.error < 0.7 * found.time_step.change
    assert found.model.scene.model.opt.timestep == pytest.approx(found.time_step.used)
    assert rebound(found.model) == pytest.approx(REBOUND, abs=0.02)
    assert "too long for its impacts" in " ".join(found.sentences())


def driven() -> Recording:
    """Return a recording of the slide, whose damping is 3 % above the model's."""
    clock, h, rng = np.arange(0, 8, 0.004), 1e-4, np.random.default_rng(2)
    command = 0.1 * np.sign(np.sin(1.7 * clock)) * np.minimum(np.abs(np.sin(1.7 * clock)) * 4, 1)
    x, v, rows = 0.0, 0.0, []
    for u in command:
        rows.append(x)
        final = GAIN * u / (GAIN + 1.03 * DAMPING)
        for _ in range(40):  # exact where the command is held
            share = np.exp(-(GAIN + 1.03 * DAMPING) / MASS * h)
            x, v = (
                x + final * h + (v - final) * (1 - share) * MASS / (GAIN + 1.03 * DAMPING),
                final + (v - final) * share,
            )
    read = np.round(np.array(rows) + rng.normal(0, 2e-6, len(rows)), 6)
    demo = Demonstration(
        "demo_0",
        action={"drive": Channel(clock, command[:, None])},
        measured={"encoder": Channel(clock, read[:, None])},
    )
    return Recording(SLIDE, (demo,))


def test_the_error_of_a_long_step_in_a_stiff_drive_is_no_inertia():
    """Euler's method takes the drive's gain explicitly, which amounts to an inertia of gain * step / 2 less: 0.6 kg."""
    with limit_simulations(1):
        found = cw.diagnose(Model(Scene(SLIDE)), driven(), cw.DiagnoseCfg(jobs=1, explain=False))
    assert found.verdict == "none_needed"
    assert found.time_step is not None
    assert found.time_step.used < found.time_step.given
    assert not found.time_step.impacts
