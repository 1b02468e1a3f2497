"""An arm of two joints in a plane with a hose on its elbow: where is a force missing, and which?

    python examples/robots/planar_arm.py

`locate_forces` says on which joint the model lacks a torque and what it depends on, without a list of effects.
`diagnose` then names the effect.
"""

import numpy as np
from simulated_log import record_log

import concent_warp as cw

ARM = """
<mujoco model="planar_arm">
  <option timestep="0.002" integrator="implicitfast" gravity="0 0 0"/>
  <default>
    <geom type="capsule" size="0.02" contype="0" conaffinity="0"/>
    <joint axis="0 0 1" armature="0.01"/>
    <position kp="60" kv="3"/>
  </default>
  <worldbody>
    <light pos="0 0 2"/>
    <body name="upper_arm" pos="0 0 0.1">
      <joint name="shoulder"/>
      <geom name="upper_arm" fromto="0 0 0 0.3 0 0" mass="0.8"/>
      <body name="forearm" pos="0.3 0 0">
        <joint name="elbow"/>
        <geom name="forearm" fromto="0 0 0 0.25 0 0" mass="0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder"/>
    <position name="elbow" joint="elbow"/>
  </actuator>
  <sensor>
    <jointpos name="shoulder" joint="shoulder"/>
    <jointpos name="elbow" joint="elbow"/>
  </sensor>
</mujoco>
"""
WITH_HOSE = ARM.replace('name="elbow"/>', 'name="elbow" damping="0.4"/>', 1)
"""The arm as it is: a hose damps the elbow by 0.4 N m s/rad."""


def motion() -> np.ndarray:
    """Return commands [rad] of two seconds, shape (1000, 2)."""
    time = 0.002 * np.arange(1000)
    envelope = np.sin(np.pi * time / 2.0)
    return np.stack([0.8 * envelope * np.sin(5 * time), 0.9 * envelope * np.sin(8 * time)], axis=1)


def main() -> None:
    """Record, locate, diagnose."""
    recording = cw.Recording(ARM, (record_log(WITH_HOSE, motion(), noise=2e-4),))
    model = cw.Model.from_recording(recording)
    for joint in cw.locate_forces(model, recording).joints:
        print(f"{joint.joint}: {'lacks a torque' if joint.significant else 'complete'}")
    diagnosis = cw.diagnose(model, recording, cw.DiagnoseCfg(explain=False))
    print(diagnosis.headline)
    print(*diagnosis.sentences(), sep="\n")


if __name__ == "__main__":
    main()
