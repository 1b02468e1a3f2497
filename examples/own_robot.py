"""A robot, objects and a log of one's own: from arrays to a recording, a fitted model and its contact events.

The robot is a gantry with two fingers; it picks up a block and pushes it into the corner of a bracket. Plain
MuJoCo with exact boxes plays the gantry and keeps the log. With a real one, only `read_log` changes.

    python examples/own_robot.py [FOLDER]
"""

import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from concent_warp.events.extract import extract
from concent_warp.fit.fit_geometry import FitCfg, fit_geometry
from concent_warp.fit.geometry.evolution import EvolutionCfg
from concent_warp.model import Model
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.simulate.mujoco_engine import MujocoEngine

SCENE = """
<mujoco model="gantry">
  <option timestep="0.005" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <custom><text name="concent_objects" data="block bracket"/></custom>
  <default><geom friction="0.5 0.005 0.0001"/></default>
  <worldbody>
    <light pos="0 0 1"/>
    <geom name="table" type="box" size="0.3 0.3 0.01" pos="0 0 -0.01"/>
    <body name="carriage" pos="0 0 0.1" gravcomp="1">
      <joint name="x" type="slide" axis="1 0 0" range="-0.2 0.2" damping="20"/>
      <joint name="z" type="slide" axis="0 0 1" range="-0.09 0.1" damping="20"/>
      <geom type="box" size="0.02 0.05 0.01" pos="0 0 0.06" mass="0.5"/>
      <body name="left" gravcomp="1">
        <joint name="left" type="slide" axis="0 1 0" range="0 0.04" damping="5"/>
        <geom name="left" type="box" size="0.01 0.004 0.03" pos="0 0.004 0.015" mass="0.1" friction="1.5 .01 .0001"/>
      </body>
      <body name="right" gravcomp="1">
        <joint name="right" type="slide" axis="0 -1 0" range="0 0.04" damping="5"/>
        <geom name="right" type="box" size="0.01 0.004 0.03" pos="0 -0.004 0.015" mass="0.1" friction="1.5 .01 .0001"/>
      </body>
    </body>
    <body name="block" pos="0 0 0.02">
      <freejoint/>
      <geom name="block" type="box" size="0.02 0.02 0.02" mass="0.1" rgba="0.9 0.5 0.2 1"/>
    </body>
    <body name="bracket" pos="0.1 0 0">
      <geom name="bracket_floor" type="box" size="0.04 0.04 0.005" pos="0 0 0.005" rgba="0.25 0.5 0.75 1"/>
      <geom name="bracket_wall" type="box" size="0.005 0.04 0.03" pos="0.035 0 0.03" rgba="0.25 0.5 0.75 1"/>
    </body>
  </worldbody>
  <actuator>
    <position name="x" joint="x" kp="2000" kv="60" ctrlrange="-0.2 0.2"/>
    <position name="z" joint="z" kp="2000" kv="60" ctrlrange="-0.09 0.1"/>
    <position name="left" joint="left" kp="600" kv="10" ctrlrange="0 0.04" forcerange="-15 15"/>
    <position name="right" joint="right" kp="600" kv="10" ctrlrange="0 0.04" forcerange="-15 15"/>
  </actuator>
  <sensor>
    <jointpos name="x" joint="x"/>
    <jointpos name="z" joint="z"/>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""
WAYPOINTS = np.array(
    [
        # time [s], x [m], z [m], opening of each finger [m]
        [0.0, 0.0, -0.08, 0.035],
        [0.3, 0.0, -0.08, 0.0],
        [0.6, 0.0, -0.08, 0.0],
        [1.0, 0.0, -0.05, 0.0],
        [1.5, 0.09, -0.05, 0.0],
        [1.9, 0.115, -0.05, 0.0],
        [2.1, 0.115, -0.05, 0.0],
        [2.4, 0.115, -0.072, 0.0],
        [2.7, 0.115, -0.072, 0.035],
    ]
)


def read_log() -> Demonstration:
    """Return commands and measurements with their clocks; every time counts from the start, in seconds."""
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[:4]] = WAYPOINTS[0, [1, 2, 3, 3]]
    qpos, qvel = data.qpos.copy(), data.qvel.copy()
    rng = np.random.default_rng(0)
    time = np.arange(0, WAYPOINTS[-1, 0], model.opt.timestep)
    command = np.stack([np.interp(time, WAYPOINTS[:, 0], WAYPOINTS[:, k]) for k in (1, 2, 3, 3)], axis=1)
    readings = []
    for row in command:
        data.ctrl[:] = row
        mujoco.mj_step(model, data)  # leaves the readings of the state before the step
        readings.append(data.sensordata + rng.normal(0, 2e-4, model.nsensordata))
    measured = {}
    for i in range(model.nsensor):
        rows = slice(model.sensor_adr[i], model.sensor_adr[i] + model.sensor_dim[i])
        measured[model.sensor(i).name] = Channel(time, np.array(readings)[:, rows])
    action = {model.actuator(i).name: Channel(time, command[:, i]) for i in range(model.nu)}
    task = "push the block into the corner of the bracket"
    return Demonstration("demo_0", task, qpos=qpos, qvel=qvel, action=action, measured=measured)


def main(folder: Path) -> None:
    """Write recording, model and events to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    scene = Scene(SCENE)
    recording = Recording(scene.xml, (read_log(),))
    write_hdf5(recording, folder / "gantry.h5")  # checks names, shapes, clocks and units against the scene

    geometry = ContactGeometryCfg(count=160, placement="surface").build(scene)
    model = Model(scene, geometry)
    cfg = FitCfg(generations=6, evolution=replace(EvolutionCfg(), population=8))
    result = fit_geometry(
        model, recording, cfg, progress=lambda p: print(f"generation {p.generation}: {1e3 * p.loss:.2f} mm")
    )
    result.model.save(folder / "model.toml")

    events = extract(result.model, recording["demo_0"], MujocoEngine(result.model))
    events.save(folder / "events.json")
    for stage in events.stages:
        print(f"{stage.name}: {stage.start:.2f} to {stage.end:.2f} s")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/gantry"))
