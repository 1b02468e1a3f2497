"""Nominal scene of a ball, nominal values of bodies and contacts, and the sensors of a tracked body."""

from __future__ import annotations

import numpy as np

from benchmarks.independent.foreign.rig import Sensor

BALL = """
<mujoco model="{model}">
  <compiler angle="radian"/>
  <option timestep="0.0005" integrator="implicitfast" cone="elliptic"/>
  <default>
    <geom friction="{{friction}} 0.005 0.0001" {contact}/>
  </default>
  <worldbody>
    <geom name="table" type="plane" size="3 3 0.1"{table}/>
    <body name="ball" pos="0 0 {height}">
      <freejoint/>
      <inertial pos="0 0 0" mass="{{mass}}" diaginertia="{{inertia}} {{inertia}} {{inertia}}"/>
      <geom name="ball" type="sphere" size="{{radius}}"/>
    </body>
  </worldbody>
  <sensor>
    <framepos name="ball_position" objtype="xbody" objname="ball"/>{extra}
  </sensor>
</mujoco>
"""
"""Nominal scene of a ball on a table, given model, contact, height, and what else the table and the sensors have."""


def block(x: float, y: float, z: float, mass: float) -> dict[str, float]:
    """Return half sizes and mass."""
    return {"half_x": x, "half_y": y, "half_z": z, "mass": mass}


def ball(radius: float, mass: float, share: float) -> dict[str, float]:
    """Return radius, mass, and inertia as a share of that of all mass at the surface's distance."""
    return {"radius": radius, "mass": mass, "inertia": share * mass * radius**2}


def nominal_contact(stiffness: float, damping_ratio: float, mass: float) -> dict[str, float]:
    """Return a contact's values and MuJoCo's time constant for a linear spring [N/m] and damper on a mass [kg]."""
    frequency = np.sqrt(stiffness / mass)
    return {
        "stiffness": stiffness,
        "damping_ratio": damping_ratio,
        "time_constant": float(1 / (frequency * damping_ratio)),
    }


def tracked(body: str) -> tuple[Sensor, ...]:
    """Return the sensors of position and orientation of a body."""
    return (Sensor(f"{body}_position", "position", body), Sensor(f"{body}_orientation", "orientation", body))
