"""A ball that bounces on a hard floor, simulated in steps of a millisecond, its initial states told wrongly."""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.recording.recording import Channel, Demonstration, Recording

NOISE = 2e-4
"""Standard deviation of a position [m]."""
SPREAD = np.array([3 * NOISE, 3 * NOISE, 100 * NOISE, 100 * NOISE])
"""What a fit takes an initial state told to be off by, positions [m] and then velocities [m/s]."""
SCENE = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <geom type="plane" size="1 1 0.1" solref="-40000 -10"/>
    <body name="ball" pos="0 0 0.3">
      <joint name="along" type="slide" axis="1 0 0"/>
      <joint name="up" type="slide" axis="0 0 1"/>
      <geom type="sphere" size="0.03" mass="0.1" friction="0.3" solref="-40000 -10"/>
    </body>
  </worldbody>
  <sensor><jointpos name="along" joint="along"/><jointpos name="up" joint="up"/></sensor>
</mujoco>"""


def bounced(count: int, *, off: float, seed: int = 0) -> tuple[Recording, list[np.ndarray]]:
    """Return falls with one bounce each, and by what their initial states are told wrongly.

    Args:
        count: How many.
        off: By how many spreads each component of a state is off, either way.
        seed: Of the motions, the noise and the signs.
    """
    rng = np.random.default_rng(seed)
    m = mujoco.MjModel.from_xml_string(SCENE)
    demonstrations, errors = [], []
    for k in range(count):
        state = np.array([0.0, rng.uniform(-0.05, 0.05), rng.uniform(0.2, 0.5), rng.uniform(-0.3, 0.0)])
        d = mujoco.MjData(m)
        d.qpos[:], d.qvel[:] = state[:2], state[2:]
        rows = []
        for _ in range(351):
            mujoco.mj_forward(m, d)
            rows.append(d.sensordata.copy())
            mujoco.mj_step(m, d)
        seen = np.array(rows)[::5]
        time = 0.005 * np.arange(len(seen))
        seen += rng.normal(0, NOISE, seen.shape)
        measured = {name: Channel(time, seen[:, i : i + 1], NOISE) for i, name in enumerate(("along", "up"))}
        errors.append(off * rng.choice([-1.0, 1.0], 4))
        told = state - errors[-1] * SPREAD
        demonstrations.append(Demonstration(f"demo_{k}", qpos=told[:2], qvel=told[2:], measured=measured))
    return Recording(SCENE, tuple(demonstrations)), errors
