"""A leg that hops on a rail: the contact of its foot is softer than in its model, and a fit finds how soft.

    python examples/robots/leg.py

The trunk slides up and down, hip and knee are position-controlled, the foot is a sphere. Encoders and the height of the
trunk are read. The diagnosis tries effects of contacts on free bodies; on the foot of a robot one adds them by hand.
"""

import numpy as np
from simulated_log import record_log

import concent_warp as cw

LEG = """
<mujoco model="leg">
  <option timestep="0.002" integrator="implicitfast" cone="elliptic"/>
  <default>
    <geom contype="0" conaffinity="0"/>
    <joint axis="0 1 0" damping="0.2" armature="0.01"/>
    <position kp="150" kv="4"/>
  </default>
  <worldbody>
    <light pos="0 0 2"/>
    <geom name="ground" type="plane" size="1 1 0.1" contype="1" conaffinity="1"/>
    <body name="trunk" pos="0 0 0.5">
      <joint name="rail" type="slide" axis="0 0 1" damping="1" armature="0"/>
      <geom name="trunk" type="box" size="0.1 0.06 0.05" mass="3"/>
      <body name="thigh">
        <joint name="hip"/>
        <geom name="thigh" type="capsule" fromto="0 0 0 0 0 -0.25" size="0.025" mass="0.6"/>
        <body name="shank" pos="0 0 -0.25">
          <joint name="knee"/>
          <geom name="shank" type="capsule" fromto="0 0 0 0 0 -0.23" size="0.015" mass="0.2"/>
          <body name="foot" pos="0 0 -0.25">
            <geom name="foot" type="sphere" size="0.02" mass="0.05" contype="1" conaffinity="1" solref="0.01 1"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="hip" joint="hip"/>
    <position name="knee" joint="knee"/>
  </actuator>
  <sensor>
    <jointpos name="height" joint="rail"/>
    <jointpos name="hip" joint="hip"/>
    <jointpos name="knee" joint="knee"/>
  </sensor>
</mujoco>
"""
ON_SOFT_GROUND = LEG.replace('solref="0.01 1"', 'solref="0.03 1"')
"""The leg as it is: foot and ground touch with a time constant of 25 ms, the mean of both, in place of 15 ms."""


def motion() -> np.ndarray:
    """Return commands [rad] of three seconds, shape (1500, 2): crouch and stretch, faster each time, until it hops."""
    time = 0.002 * np.arange(1500)
    crouch = 0.45 - 0.3 * np.cos(2 * np.pi * (0.8 * time + 0.35 * time**2))
    return np.stack([-crouch, 2 * crouch], axis=1)


def main() -> None:
    """Record, compare, fit the contact of the foot, compare again."""
    recording = cw.Recording(LEG, (record_log(ON_SOFT_GROUND, motion(), noise=2e-4),))
    model = cw.Model.from_recording(recording)
    fitted = cw.fit_effects(model.add_effect("contact_compliance", ["foot"]), recording)
    for parameter in fitted.parameters[0]:
        print(f"{parameter.name} = {parameter.value:.4f} [{parameter.low:.4f}, {parameter.high:.4f}] {parameter.unit}")
    comparison = cw.compare({"nominal": model, "fitted": fitted.model}, recording)
    for channel in comparison.channels:
        before, after = (comparison.summarise(name, channel).ratio for name in comparison.models)
        print(f"{channel}: {before:.1f} -> {after:.1f} x noise")


if __name__ == "__main__":
    main()
