"""Chatter: a body that slides hops in the simulation, and no model is better for hopping less."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np

from concent_warp.fit.effects.observation import NumericalScatter, Window
from concent_warp.fit.effects.observation_cfg import ObservationCfg
from concent_warp.fit.effects.observe import observe
from concent_warp.fit.effects.scatter import _of_single_bodies
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

NOISE, SPEED, FRICTION = 5e-5, 0.9, 0.3
SCENE = f"""
<mujoco>
  <option timestep="0.002" integrator="implicitfast" cone="elliptic" impratio="3"/>
  <worldbody>
    <geom type="plane" size="2 2 0.1" friction="{FRICTION}" solref="0.006 1"/>
    <body name="block" pos="0 0 0.01">
      <freejoint/><geom type="box" size="0.08 0.06 0.01" mass="0.4" friction="{FRICTION}" solref="0.006 1"/>
    </body>
  </worldbody>
  <sensor><framepos name="place" objtype="xbody" objname="block"/></sensor>
</mujoco>"""


def slid(cfg: ObservationCfg) -> Window:
    """Return the window of a block that slides to rest without a hop, of exact readings."""
    time = np.arange(0.0, 0.36, 1 / 60)
    moving = np.minimum(time, SPEED / (FRICTION * 9.81))
    place = SPEED * moving - FRICTION * 9.81 / 2 * moving**2
    value = np.column_stack([place, np.zeros(len(time)), np.full(len(time), 0.01)])
    start = np.array([0, 0, 0.01, 1, 0, 0, 0.0]), np.array([SPEED, 0, 0, 0, 0, 0.0])
    channel = Channel(time, value, NOISE)
    demonstration = Demonstration("demo_0", qpos=start[0], qvel=start[1], measured={"place": channel})
    (window,) = observe(Model(Scene(SCENE)), Recording(SCENE, (demonstration,)), length=1.0, cfg=cfg)
    return window


def test_hops_of_a_sliding_block_are_noise_of_each_reading_for_itself():
    window = slid(ObservationCfg())
    assert window.scatter is not None
    assert window.scatter.own is not None
    own = window.scatter.own.reshape(-1, 3)
    early, late = window.readings[0].time < 0.2, window.readings[0].time > 0.33
    assert own[early, 2].min() > 3.0  # across the table
    assert own[late].max() < 1.0
    # A hop of half a millimetre leaves next to nothing, a block that stops elsewhere as much as before.
    hop, farther = np.zeros((len(own), 3)), np.zeros((len(own), 3))
    hop[early, 2], farther[late, 0] = 5e-4 / NOISE, 5e-4 / NOISE
    assert np.linalg.norm(window.scatter.whitened(hop.ravel())) < 0.3 * np.linalg.norm(hop)
    plain = replace(window.scatter, own=None)
    assert np.linalg.norm(plain.whitened(hop.ravel())) > 0.4 * np.linalg.norm(hop)


def test_there_is_none_where_it_is_switched_off():
    scatter = slid(ObservationCfg(chatter=0.0)).scatter
    assert scatter is not None
    assert scatter.own is None


def test_only_bodies_that_move_freely_and_alone_have_any():
    m = mujoco.MjModel.from_xml_string("""
    <mujoco>
      <worldbody>
        <body name="block"><freejoint/><geom size="0.1"/></body>
        <body name="walker"><freejoint/><geom size="0.1"/>
          <body name="leg"><joint name="knee"/><geom size="0.1" pos="0 0 1"/></body>
        </body>
        <body name="door"><joint/><geom size="0.1" pos="1 0 0"/></body>
      </worldbody>
      <sensor>
        <framepos name="a" objtype="xbody" objname="block"/><framepos name="b" objtype="body" objname="walker"/>
        <jointpos name="c" joint="knee"/><framepos name="d" objtype="xbody" objname="door"/>
        <framepos name="e" objtype="body" objname="block"/><framepos name="f" objtype="xbody" objname="leg"/>
      </sensor>
    </mujoco>""")
    names = "abcdefg"
    readings = [SimpleNamespace(channel=n, rows=slice(2 * k, 2 * k + 2)) for k, n in enumerate(names)]
    window: Any = SimpleNamespace(readings=readings)
    found = _of_single_bodies(m, window, 2 * len(names)).reshape(-1, 2)
    assert (found[:, 0] == found[:, 1]).all()
    assert found[:, 0].tolist() == [True, False, False, False, True, False, False]


def test_whitening_is_the_inverse_root_of_noise_chatter_and_scatter():
    rng = np.random.default_rng(0)
    deviations, own, residual = 3 * rng.normal(size=(9, 3)), rng.uniform(0, 5, 9), rng.normal(size=9)
    found = NumericalScatter(deviations, own)
    covariance = np.diag(1 + own**2) + deviations @ deviations.T
    white = found.whitened(residual)
    assert np.isclose(white @ white, residual @ np.linalg.solve(covariance, residual))
    part = found.rows(np.array([7, 2]))
    np.testing.assert_array_equal(part.own, own[[7, 2]])
