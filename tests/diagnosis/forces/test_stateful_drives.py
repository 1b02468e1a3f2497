"""Forces in joints of which a drive's filter or integrator is not measured."""

import mujoco
import numpy as np
import pytest

from concent_warp.diagnosis.forces.cfg import LocateForcesCfg
from concent_warp.diagnosis.forces.locate import locate_forces
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

SCENE = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body><joint name="pan" axis="0 0 1" damping="0.05"/><geom size="0.05" pos="0.2 0 0" mass="1"/></body>
    <body pos="0 0 1"><joint name="lift" axis="0 0 1" damping="0.05"/><geom size="0.05" pos="0.2 0 0" mass="1"/></body>
  </worldbody>
  <actuator>{drive}<position name="lift" joint="lift" kp="5" kv="0.3"/></actuator>
  <sensor><jointpos name="pan" joint="pan"/><jointpos name="lift" joint="lift"/></sensor>
</mujoco>
"""


@pytest.mark.parametrize(
    ("drive", "joints"),
    [
        ('<intvelocity name="pan" joint="pan" kp="5" kv="0.3"/>', {"lift"}),
        ('<position name="pan" joint="pan" kp="5" kv="0.3" timeconst="0.05"/>', {"lift"}),
        ('<position name="pan" joint="pan" kp="5" kv="0.3"/>', {"pan", "lift"}),
    ],
)
def test_forces_are_not_given_for_joints_whose_drive_has_a_state(drive, joints):
    xml, rng = SCENE.format(drive=drive), np.random.default_rng(0)
    m = mujoco.MjModel.from_xml_string(xml)
    d, time, seen = mujoco.MjData(m), 0.01 * np.arange(200), []
    command = 0.5 * np.sin(4 * time)
    for u in command:
        seen.append(d.qpos + 1e-4 * rng.normal(size=2))
        d.ctrl[:] = u
        mujoco.mj_step(m, d, nstep=5)
    measured = {n: Channel(time, np.array(seen)[:, [k]], 1e-4) for k, n in enumerate(("pan", "lift"))}
    action = {n: Channel(time, command) for n in ("pan", "lift")}
    recording = Recording(xml, (Demonstration("demo_0", action=action, measured=measured),))
    found = locate_forces(Model(Scene(xml)), recording, LocateForcesCfg(extra_starts=2))
    assert {joint.joint for joint in found.joints} == joints
    assert not any(joint.significant for joint in found.joints)
