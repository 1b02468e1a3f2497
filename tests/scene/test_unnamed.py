"""Scenes with bodies and joints that have no name, as most MJCF files have."""

from __future__ import annotations

import mujoco
import numpy as np

import concent_warp as cw
from concent_warp.diagnosis.candidates.candidates import candidates
from concent_warp.recording.recording import Channel, Demonstration, Recording

BOX = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body pos="0 0 0.3">
      <freejoint/>
      <geom type="box" size="0.03 0.03 0.03" mass="0.1"/>
      <site name="tag" pos="0.01 0 0.03"/>
    </body>
  </worldbody>
  <sensor>
    <framepos name="place" objtype="site" objname="tag"/>
    <framequat name="turn" objtype="site" objname="tag"/>
  </sensor>
</mujoco>"""
TREE = """
<mujoco>
  <worldbody>
    <body>
      <joint type="hinge"/><geom size="0.1"/>
      <body name="body3"><joint name="a" type="slide"/><joint axis="1 0 0"/><geom size="0.1"/></body>
    </body>
    <frame pos="0 0 1"><body><freejoint/><geom size="0.1"/><body><geom size="0.1"/></body></body></frame>
  </worldbody>
</mujoco>"""


def thrown(seconds: float = 0.3) -> Recording:
    """Return the recording of a box that is thrown, with noise."""
    m = mujoco.MjModel.from_xml_string(BOX)
    d, rng, rows = mujoco.MjData(m), np.random.default_rng(0), []
    d.qvel[:] = [0.5, 0.0, 0.5, 1.0, 2.0, 3.0]
    for _ in range(round(seconds / m.opt.timestep)):
        mujoco.mj_forward(m, d)
        rows.append(d.sensordata.copy())
        mujoco.mj_step(m, d)
    seen = np.array(rows)[::5]
    time = 0.01 * np.arange(len(seen))
    place = Channel(time, seen[:, :3] + 3e-4 * rng.normal(size=(len(seen), 3)), 3e-4)
    return Recording(
        BOX, (Demonstration("throw", measured={"place": place, "turn": Channel(time, seen[:, 3:], 3e-3)}),)
    )


def test_names_are_those_of_indices_and_differ():
    m = cw.Scene(TREE).model
    plain = mujoco.MjModel.from_xml_string(TREE)
    assert [m.body(i).name for i in range(m.nbody)] == ["world", "body1", "body3", "body3_", "body4"]
    assert [m.joint(i).name for i in range(m.njnt)] == ["joint0", "a", "joint2", "joint3"]
    np.testing.assert_array_equal(m.body_parentid, plain.body_parentid)
    np.testing.assert_array_equal(m.jnt_bodyid, plain.jnt_bodyid)
    assert cw.Scene(TREE).objects() == ("body3_",)


def test_a_deep_chain_is_named_too():
    depth = 60
    link = '<body><joint/><geom size="0.1"/>'
    m = cw.Scene(f"<mujoco><worldbody>{link * depth}{'</body>' * depth}</worldbody></mujoco>").model
    assert [m.body(i).name for i in range(1, m.nbody)] == [f"body{i}" for i in range(1, depth + 1)]


def test_what_acts_on_a_single_body_or_joint_is_considered():
    found = candidates(cw.Model(cw.Scene(BOX)), {"place", "turn"}, ())
    assert ("body1",) in {e.target for e in found if e.name == "mass"}
    assert ("body1",) in {e.target for e in found if e.name == "sliding_friction"}


def test_a_body_without_name_is_compared_and_diagnosed():
    recording = thrown()
    model = cw.Model.from_recording(recording)
    ratio = cw.compare(model, recording).summarise("model", "place").ratio
    assert ratio is not None
    assert ratio < 1.3
    cfg = cw.DiagnoseCfg(jobs=1, explain=False, effects=("mass", "gravity_tilt"))
    found = cw.diagnose(model, recording, cfg)
    assert found.verdict == "none_needed"
    assert not [sentence for sentence in found.issues if "starts" in sentence]
