"""A cart on a rail whose recording, at one speed, cannot distinguish friction from damping."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from concent_warp.diagnosis.experiment.motions import RecordedRange
from concent_warp.diagnosis.suggestion.hypotheses import Hypothesis
from concent_warp.effects.library.joints import JointDamping, JointFriction
from concent_warp.fit.effects.observe import channel_noises
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

NOISE = 3e-4
"""Standard deviation of a position [m]."""
CART = """
<mujoco><option timestep="0.004" integrator="implicitfast" gravity="0 0 0"/><worldbody>
  <body name="cart"><joint name="rail" type="slide" axis="1 0 0"/><geom name="cart" size=".1" mass="1"/></body>{more}
</worldbody>
<actuator><position name="drive" joint="rail" kp="100" dampratio="1"/></actuator>
<sensor><jointpos name="rail_position" joint="rail"/></sensor></mujoco>"""


def one_speed(friction: float = 0.0, more: str = "") -> Recording:
    """Return a recording of a cart that is moved to and fro at 0.1 m/s against a friction [N]."""
    time = np.arange(0, 4, 0.01)
    command = 0.1 * np.abs((time + 1) % 4 - 2) - 0.1
    m = mujoco.MjModel.from_xml_string(CART.format(more=more))
    d, read, rng = mujoco.MjData(m), [], np.random.default_rng(0)
    m.dof_frictionloss[0] = friction
    for u in command:
        d.ctrl[0] = u
        read.append(d.qpos[0])
        mujoco.mj_step(m, d, nstep=2)
        mujoco.mj_step(m, d) if len(read) % 2 else None
    value = np.array(read)[:, None] + NOISE * rng.normal(size=(len(read), 1))
    demonstration = Demonstration(
        "demo_0",
        qpos=np.zeros(1),
        qvel=np.zeros(1),
        action={"drive": Channel(time, command)},
        measured={"rail_position": Channel(time, value, noise_std=NOISE)},
    )
    return Recording(CART.format(more=more), (demonstration,))


def friction_or_damping(recording: Recording, std: float = 0.0) -> list[Hypothesis]:
    """Return two hypotheses of the same drag at 0.1 m/s, each with a standard deviation of its size [its unit]."""
    model = Model(Scene(recording.scene))
    return [
        Hypothesis("joint_friction", model.add(JointFriction("rail"), [0.2]), np.array([std])),
        Hypothesis("joint_damping", model.add(JointDamping("rail"), [2.0]), np.array([std])),
    ]


def recorded_range(recording: Recording) -> RecordedRange:
    """Return the range of a recording as its own scene reads it."""
    model = Model(Scene(recording.scene))
    return RecordedRange(model, recording, channel_noises(model, recording))


def open_group(**more: Any) -> dict[str, Any]:
    """Return a diagnosis, as JSON has it, that cannot distinguish friction from damping of the cart."""

    def finding(name: str, parameter: str, value: float, accepted: bool) -> dict[str, Any]:
        row = {"name": f"{parameter}[rail]", "value": value, "interval": [0.9 * value, 1.1 * value], "null": 0.0}
        return {"name": name, "target": ["rail"], "accepted": accepted, "step": 0, "parameters": [row | {"unit": "-"}]}

    effects = [finding("joint_friction", "torque", 0.2, True), finding("joint_damping", "damping", 2.0, False)]
    return {"verdict": "group", "groups": [["joint_friction", "joint_damping"]], "effects": effects} | more


def with_limits(cfg: Any, **limits: Any) -> Any:
    """Return settings of a suggestion with other limits."""
    return replace(cfg, limits=replace(cfg.limits, **limits))
