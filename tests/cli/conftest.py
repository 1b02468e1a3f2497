import mujoco
import numpy as np
import pytest

from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.recording import Channel, Demonstration, Recording

XML = """
<mujoco>
  <option timestep="0.005"/>
  <custom><text name="concent_objects" data="block stop"/></custom>
  <worldbody>
    <geom name="table" type="plane" size="1 1 .1"/>
    <body name="pusher" pos="-.13 0 .04">
      <joint name="rail" type="slide" axis="1 0 0"/><geom type="capsule" fromto="0 -.03 0 0 .03 0" size=".02" mass="1"/>
    </body>
    <body name="block" pos="0 0 .03"><freejoint/><geom type="box" size=".03 .03 .03" mass=".1"/></body>
    <body name="stop" pos=".15 0 .03"><geom type="box" size=".02 .06 .03"/></body>
  </worldbody>
  <actuator><position name="drive" joint="rail" kp="300" kv="30"/></actuator>
  <sensor>
    <jointpos name="rail" joint="rail"/>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""


def push(name, far):
    m = mujoco.MjModel.from_xml_string(XML)
    d = mujoco.MjData(m)
    time = np.arange(0, 1.2, 0.02)
    command = np.clip(time, 0, 1) * far
    rows = []
    for value in command:
        d.ctrl[0] = value
        mujoco.mj_forward(m, d)
        rows.append(d.sensordata.copy())
        mujoco.mj_step(m, d, nstep=4)
    rows = np.array(rows)
    measured = {
        "rail": Channel(time, rows[:, :1], 1e-4),
        "block_position": Channel(time, rows[:, 1:4], 1e-4),
        "block_orientation": Channel(time, rows[:, 4:8], 1e-3),
    }
    return Demonstration(
        name,
        "push",
        qpos=m.qpos0.copy(),
        qvel=np.zeros(m.nv),
        action={"drive": Channel(time, command)},
        measured=measured,
    )


@pytest.fixture(scope="session")
def bench(tmp_path_factory):
    """A folder with a recording of two pushes and two models of it."""
    from concent_warp.cli import main

    folder = tmp_path_factory.mktemp("bench")
    write_hdf5(Recording(XML, (push("demo_0", 0.2), push("demo_1", 0.19))), folder / "demo.h5")
    spheres = ["--count", "60", "--radius", "0.008"]
    assert main(["geometry", str(folder / "demo.h5"), "--out", str(folder / "inset.toml"), *spheres]) == 0
    surface = ["--placement", "surface", "--out", str(folder / "surface.toml")]
    assert main(["geometry", str(folder / "demo.h5"), *surface, *spheres]) == 0
    return folder
