import mujoco
import numpy as np
import pytest

from concent_warp.comparison.compare import compare_replays
from concent_warp.comparison.no_contact import without_object_contact
from concent_warp.events.extract import extract
from concent_warp.fit.geometry.search import FitResult
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, PointTrack, Recording
from concent_warp.report.report import write_report
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.simulate.mujoco_engine import MujocoEngine

XML = """
<mujoco>
  <option timestep="0.005"/>
  <custom><text name="concent_objects" data="block stop"/></custom>
  <worldbody>
    <geom name="table" type="plane" size="0 0 .1" rgba=".8 .8 .7 1"/>
    <body name="pusher" pos="-.13 0 .04">
      <joint name="rail" type="slide" axis="1 0 0"/><geom type="capsule" fromto="0 -.03 0 0 .03 0" size=".02" mass="1"/>
    </body>
    <body name="block" pos="0 0 .03">
      <freejoint/><geom type="box" size=".03 .03 .03" mass=".1" rgba=".9 .5 .2 1"/>
    </body>
    <body name="stop" pos=".15 0 .03"><geom type="box" size=".02 .06 .03" rgba=".2 .5 .8 1"/></body>
  </worldbody>
  <actuator><position name="drive" joint="rail" kp="300" kv="30"/></actuator>
  <sensor>
    <jointpos name="rail" joint="rail"/>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""


DIAGNOSIS = {
    "verdict": "group",
    "effects": [
        {
            "name": name,
            "family": "contact",
            "gain": {"value": gain, "interval": [gain - 0.1, gain + 0.1]},
            "p": p,
            "p_smallest": 0.001,
            "accepted": p < 0.05,
            "parameters": [{"name": "coefficient[block]", "value": 0.31, "interval": [0.28, 0.35], "unit": "-"}],
        }
        for name, gain, p in (("sliding_friction", 0.5, 0.001), ("grip_force", 0.48, 0.001), ("air_drag", -0.02, 1.0))
    ],
    "groups": [["sliding_friction", "grip_force"]],
    "next_experiment": {"sentence": "Push the block without grasping it."},
}


LOCATION = {
    "arrows": [
        {
            "body": "block",
            "phase": "slide",
            "point": [-0.03, 0.02, 0.0],
            "vector": [0.4, 0.0, 0.1],
            "std": [0.002, 0.001, 0.003],
            "label": "0.412 N, slide",
        }
    ],
    "sentences": ["block: 0.4 N along +x during slide, at its <-x> face"],
}


def push(name, far):
    """The pusher drives the block against the stop; measured with exact boxes."""
    m = mujoco.MjModel.from_xml_string(XML)
    d = mujoco.MjData(m)
    time = np.arange(0, 1.5, 0.02)
    command = np.clip(time, 0, 1) * far
    rows = []
    for value in command:
        d.ctrl[0] = value
        mujoco.mj_forward(m, d)
        rows.append(d.sensordata.copy())
        mujoco.mj_step(m, d, nstep=4)
    rows = np.array(rows)
    noisy = rows + np.random.default_rng(0).normal(0, 2e-4, rows.shape)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.03
    points = rows[:, None, 1:4] + corners
    return Demonstration(
        name,
        task="push the <block> & stop",
        qpos=m.qpos0.copy(),
        qvel=np.zeros(m.nv),
        action={"drive": Channel(time, command)},
        measured={
            "rail": Channel(time, noisy[:, :1], 2e-4),
            "block_position": Channel(time, noisy[:, 1:4], 2e-4),
            "block_orientation": Channel(time, rows[:, 4:8], 2e-4),
        },
        points={"block": PointTrack(time, points, np.ones(points.shape[:2], dtype=bool))},
    )


class Case:
    """A report of two demonstrations, with all that it was made from."""

    def __init__(self, path):
        self.path = path
        self.recording = Recording(XML, (push("demo_0", 0.2), push("demo_1", 0.195)), source="bench")
        scene = Scene(XML)
        geometry = ContactGeometryCfg(count=96, radius=0.006).build(scene)
        shift = np.where((geometry.position[:, :1] > 0.01) & (geometry.body[:, None] == 0), [[0.006, 0, 0]], 0.0)
        self.after = Model(scene, geometry)
        self.before = Model(scene, geometry.with_position(geometry.position + shift))
        self.moved = int((shift[:, 0] > 0).sum())
        null = without_object_contact(self.after)
        self.models = {"before": self.before, "no contact": null, "after": self.after}
        engine = MujocoEngine(self.after)
        self.events = {d.name: extract(self.after, d, engine) for d in self.recording.demonstrations}
        stages = {name: sequence.stages for name, sequence in self.events.items()}
        self.comparison = compare_replays(self.models, self.recording, "mujoco", phases=stages)
        keys = ("loss", "held_out", "best", "candidates")
        history = [
            {"generation": k + 1, **dict.fromkeys(keys, 0.005 / (k + 1)), "simulations": 8 * k, "seconds": 0.1 * k}
            for k in range(5)
        ]
        self.fit = FitResult(self.after, self.before, history, np.asarray(shift.any(axis=1)), "all 5 generations done")
        write_report(
            path,
            self.recording,
            self.comparison,
            events=self.events,
            fit=self.fit,
            fitted=("demo_0",),
            overlap={"before": {"demo_0": 0.41}, "after": {"demo_0": 0.93}},
            diagnosis=DIAGNOSIS,
            location=LOCATION,
            settings={"command": "concent fit <demo.h5>", "versions": {"mujoco": "3"}, "settings": {"seed": 7}},
        )


@pytest.fixture(scope="session")
def case(tmp_path_factory):
    return Case(tmp_path_factory.mktemp("report") / "report.html")
