"""An arm of six joints that carries more than its model knows: the diagnosis names the body and its mass.

    python examples/robots/six_joint_arm.py

Shoulder, upper arm, forearm and a wrist of three joints, with position controllers, as collaborative arms have them.
The log is that of a motion of all joints at once; only the joint encoders are read.
"""

import numpy as np
from simulated_log import record_log

import concent_warp as cw

ARM = """
<mujoco model="six_joint_arm">
  <option timestep="0.002" integrator="implicitfast"/>
  <default>
    <geom type="capsule" contype="0" conaffinity="0"/>
    <joint damping="2" armature="0.1"/>
    <position kp="2000" kv="80"/>
    <default class="wrist"><joint damping="0.5" armature="0.02"/><position kp="400" kv="15"/></default>
  </default>
  <worldbody>
    <light pos="0 0 2"/>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <body name="shoulder" pos="0 0 0.16">
      <joint name="shoulder_pan" axis="0 0 1"/>
      <geom name="shoulder" fromto="0 0 -0.05 0 0.13 0" size="0.06" mass="3.7"/>
      <body name="upper_arm" pos="0 0.13 0">
        <joint name="shoulder_lift" axis="0 1 0"/>
        <geom name="upper_arm" fromto="0 0 0 0.42 0 0" size="0.05" mass="8.4"/>
        <body name="forearm" pos="0.42 -0.12 0">
          <joint name="elbow" axis="0 1 0"/>
          <geom name="forearm" fromto="0 0 0 0.39 0 0" size="0.04" mass="2.3"/>
          <body name="wrist_1" pos="0.39 0.1 0">
            <joint name="wrist_1" axis="0 1 0" class="wrist"/>
            <geom name="wrist_1" fromto="0 -0.04 0 0 0.04 0" size="0.04" mass="1.2"/>
            <body name="wrist_2" pos="0 0.04 -0.05">
              <joint name="wrist_2" axis="0 0 1" class="wrist"/>
              <geom name="wrist_2" fromto="0 0 -0.05 0 0 0" size="0.04" mass="1.2"/>
              <body name="tool" pos="0 0 -0.09">
                <joint name="wrist_3" axis="0 1 0" class="wrist"/>
                <geom name="tool" type="box" size="0.05 0.06 0.08" pos="0 0.06 -0.06" mass="0.8"/>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder_pan" joint="shoulder_pan"/>
    <position name="shoulder_lift" joint="shoulder_lift"/>
    <position name="elbow" joint="elbow"/>
    <position name="wrist_1" joint="wrist_1" class="wrist"/>
    <position name="wrist_2" joint="wrist_2" class="wrist"/>
    <position name="wrist_3" joint="wrist_3" class="wrist"/>
  </actuator>
  <sensor>
    <jointpos name="shoulder_pan" joint="shoulder_pan"/>
    <jointpos name="shoulder_lift" joint="shoulder_lift"/>
    <jointpos name="elbow" joint="elbow"/>
    <jointpos name="wrist_1" joint="wrist_1"/>
    <jointpos name="wrist_2" joint="wrist_2"/>
    <jointpos name="wrist_3" joint="wrist_3"/>
  </sensor>
</mujoco>
"""
LOADED = ARM.replace('mass="0.8"', 'mass="1.6"')
"""The arm as it is: its tool weighs twice what the drawing says."""
HOME = np.array([0.3, -1.2, 1.4, -1.7, -1.5, 0.2])
"""Middle of the motion [rad]."""


def motion() -> np.ndarray:
    """Return commands [rad] of two seconds, shape (1000, 6): a sine for each joint, started and ended softly."""
    time = 0.002 * np.arange(1000)[:, None]
    rates = np.array([0.5, 0.7, 0.9, 1.1, 1.3, 1.5])
    return HOME + 0.35 * np.sin(np.pi * time / 2.0) * np.sin(2 * np.pi * rates * time)


def main() -> None:
    """Record, compare, diagnose."""
    recording = cw.Recording(ARM, (record_log(LOADED, motion(), noise=1e-4),))
    model = cw.Model.from_recording(recording)
    comparison = cw.compare(model, recording)
    for joint in comparison.channels:
        print(f"{joint}: {comparison.summarise('model', joint).ratio:.0f} x noise")
    candidates = ("mass", "center_of_mass", "joint_friction", "joint_damping", "actuator_gain", "gravity_compensation")
    diagnosis = cw.diagnose(model, recording, cw.DiagnoseCfg(effects=candidates, explain=False))
    print(diagnosis.headline)
    for finding in diagnosis.accepted:
        for parameter in finding.parameters:
            print(f"{finding.name} of {finding.target[0]}: {parameter.value:.3f} x the model's")


if __name__ == "__main__":
    main()
