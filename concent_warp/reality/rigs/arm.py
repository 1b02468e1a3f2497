"""The embedded arm moves in free space: sweeps, chirps and holds of all its joints. A tracker sees its hand."""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.reality.rigs.rig import Rig, RigTrial, of_coarser_step
from concent_warp.reality.rigs.signals import COMMAND_RATE, chirp, hold, minimum_jerk_profile
from concent_warp.scene.robot import FINGER_TRAVEL, HOME_ANGLES, panda
from concent_warp.scene.scene import Scene

DURATION = 10.0
SWING = (0.7, 0.45, 0.6, 0.5, 0.8, 0.6, 0.9)
"""How far each joint sweeps [rad]."""


def _nominal_scene() -> Scene:
    """Return the arm alone, with the pose of its hand tracked."""
    spec = panda()
    spec.modelname = "arm"
    spec.option.timestep = 0.002
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    kinds = {"position": mujoco.mjtSensor.mjSENS_FRAMEPOS, "orientation": mujoco.mjtSensor.mjSENS_FRAMEQUAT}
    for suffix, kind in kinds.items():
        spec.add_sensor(name=f"hand_{suffix}", type=kind, objtype=mujoco.mjtObj.mjOBJ_XBODY, objname="hand")
    spec.delete(spec.sensor("gripper_opening"))
    return Scene.from_spec(spec, source="arm rig")


def _plan(rng: np.random.Generator, k: int) -> RigTrial:
    """Sweep every joint there and back at its own speed, swing all with rising frequency, hold in between."""
    del k
    action = {}
    for joint, home in enumerate(HOME_ANGLES):
        reach = SWING[joint] * rng.uniform(0.7, 1.0) * rng.choice([-1, 1])
        there, back = rng.uniform(1.0, 1.6), rng.uniform(1.0, 1.8)
        a, b = home + reach, home - 0.6 * reach
        parts = [
            hold(home, 0.3),
            minimum_jerk_profile(home, a, there),
            hold(a, 0.3),
            minimum_jerk_profile(a, b, back),
            hold(b, 0.3),
        ]
        parts += [minimum_jerk_profile(b, home, 0.8)]
        parts += [chirp(home, 0.12 * rng.uniform(0.6, 1.0), 0.3, rng.uniform(1.5, 3.0), 2.5), hold(home, 0.2)]
        parts += [minimum_jerk_profile(home, home - 0.3 * reach, 0.7), hold(home - 0.3 * reach, 3.0)]
        value = np.concatenate(parts)[: round(DURATION * COMMAND_RATE)]
        action[f"joint{joint + 1}"] = (np.arange(len(value)) / COMMAND_RATE, value)
    time = np.arange(round(DURATION * COMMAND_RATE)) / COMMAND_RATE
    action["gripper"] = (time, np.full(len(time), FINGER_TRAVEL / 2))
    qpos = {f"joint{joint + 1}": [angle] for joint, angle in enumerate(HOME_ANGLES)}
    qpos |= {f"{side}_finger_joint": [FINGER_TRAVEL / 2] for side in ("left", "right")}
    return RigTrial(DURATION, action, qpos=qpos, settling_time=0.5)


SCENE = _nominal_scene()
ARM = Rig("arm", SCENE, _plan, of_coarser_step(SCENE), start="resting", body="link7", grippers=("gripper",))
