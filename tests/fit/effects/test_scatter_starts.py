"""Starts of the simulations that numerical scatter is taken from: only contacts that begin in a window scatter."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.fit.effects.observation import Window
from concent_warp.fit.effects.observation_cfg import ObservationCfg
from concent_warp.fit.effects.observe import observe
from concent_warp.fit.effects.scatter import _touching_dofs, touches, with_scatter
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

STEP, NOISE, PERIOD, SECONDS = 0.002, 2e-4, 0.005, 0.4
AT_GRID = ObservationCfg(scatter_offset=1e-6)
"""Scatter by shifts of the time grid alone."""
RADIUS, TARGET = 0.03, 0.5
"""Of each ball [m], and command of the servo [rad]."""
STIFF = 'solref="-40000 -10" mass="0.1" friction="0.3"'
SERVO = '<actuator><position name="servo" joint="hinge" kp="20" kv="0.5"/></actuator>'
ARM = """
    <body name="arm" pos="1 0 2">
      <joint name="hinge" axis="0 0 1"/>
      <geom name="arm" type="capsule" fromto="0 0 0 0.3 0 0" size="0.01" mass="0.5"/>
    </body>"""


def ball(name: str, x: float) -> str:
    """Return a ball that moves up and down, its lowest point on the floor at position zero."""
    return f"""
    <body name="{name}" pos="{x} 0 {RADIUS}">
      <joint name="{name}" type="slide" axis="0 0 1"/>
      <geom name="{name}" type="sphere" size="{RADIUS}" {STIFF}/>
    </body>"""


def scene(*bodies: str, channels: tuple[str, ...], more: str = "") -> str:
    """Return a scene of some bodies over a floor whose joints are measured."""
    sensors = "".join(f'<jointpos name="{name}" joint="{name}"/>' for name in channels)
    return f"""
<mujoco>
  <option timestep="{STEP}"/>
  <worldbody>
    <geom type="plane" size="2 2 0.1" solref="-40000 -10"/>{"".join(bodies)}
  </worldbody>
  {more}
  <sensor>{sensors}</sensor>
</mujoco>"""


def window_of(xml: str, qpos: list[float], ctrl: float | None = None) -> tuple[Model, Window]:
    """Return the model and the one window, without scatter, of a simulation from some positions at rest."""
    m = mujoco.MjModel.from_xml_string(xml)
    d = mujoco.MjData(m)
    d.qpos[:] = qpos
    rows = []
    for _ in range(round((SECONDS + STEP) / STEP) + 1):
        d.ctrl[:] = 0.0 if ctrl is None else ctrl
        mujoco.mj_forward(m, d)
        rows.append(d.sensordata.copy())
        mujoco.mj_step(m, d)
    time, clock, seen = PERIOD * np.arange(round(SECONDS / PERIOD) + 1), STEP * np.arange(len(rows)), np.array(rows)
    measured = {
        m.sensor(k).name: Channel(time, np.interp(time, clock, seen[:, k])[:, None], NOISE) for k in range(m.nsensor)
    }
    action = {} if ctrl is None else {"servo": Channel(np.zeros(1), np.array([ctrl]))}
    start = {"qpos": np.array(qpos), "qvel": np.zeros(m.nv)}
    demonstration = Demonstration("demo_0", **start, action=action, measured=measured)
    model = Model(Scene(xml))
    cfg = replace(AT_GRID, scatter_samples=0)
    (window,) = observe(model, Recording(xml, (demonstration,)), length=10.0, cfg=cfg)
    return model, window


def sizes(model: Model, window: Window) -> dict[str, np.ndarray]:
    """Return the scatter of each channel over the noise, (n,); zero where there is none."""
    (found,) = with_scatter(model, [window], cfg=AT_GRID)
    size = np.zeros(window.count) if found.scatter is None else np.linalg.norm(found.scatter.deviations, axis=1)
    return {r.channel: size[r.rows] for r in window.readings}


def sunk() -> float:
    """Return the position at which a ball rests on the floor [m]."""
    m = mujoco.MjModel.from_xml_string(scene(ball("low", 0.0), channels=("low",)))
    d = mujoco.MjData(m)
    for _ in range(3000):
        mujoco.mj_step(m, d)
    return float(d.qpos[0])


def test_a_ball_in_flight_beside_a_resting_body_has_no_scatter():
    model, window = window_of(scene(ball("low", 0.0), ball("high", 0.5), channels=("low", "high")), [sunk(), 1.5])
    assert touches(model, window, "mujoco")
    found = sizes(model, window)
    assert found["high"].max() < 0.05
    assert found["low"].max() < 0.05


def test_a_ball_that_lands_beside_a_resting_body_scatters_from_its_impact_on():
    model, window = window_of(scene(ball("low", 0.0), ball("high", 0.5), channels=("low", "high")), [sunk(), 0.2])
    found, impact = sizes(model, window), float(np.sqrt(2 * 0.2 / 9.81))
    time = next(r.time for r in window.readings if r.channel == "high")
    assert found["high"][time < impact - STEP].max() < 0.05
    assert found["high"][time > impact + 0.05].max() > 1.0
    assert found["low"].max() < 0.05


@pytest.mark.parametrize("start", [TARGET, TARGET - 0.2])
def test_a_servo_has_no_scatter_at_its_set_point_nor_on_the_way_to_it_while_a_ball_rebounds(start):
    xml = scene(ARM, ball("high", 0.0), channels=("hinge", "high"), more=SERVO)
    model, window = window_of(xml, [start, 0.2], TARGET)
    found = sizes(model, window)
    assert found["high"].max() > 1.0
    # Without the commands of the recording it would be taken to accelerate towards zero.
    assert found["hinge"].max() < (0.05 if start == TARGET else 1.0)


def test_a_recording_without_commands_has_no_scatter():
    xml = scene(ARM, ball("high", 0.0), channels=("hinge", "high"), more=SERVO)
    model, window = window_of(xml, [TARGET, 0.2], TARGET)
    (known,) = with_scatter(model, [window], cfg=AT_GRID)
    assert known.scatter is not None
    lost = replace(window, demonstration=replace(window.demonstration, action={}))
    assert not touches(model, lost, "mujoco")
    assert with_scatter(model, [lost], cfg=AT_GRID) == [lost]


def test_a_motion_touches_something_only_where_it_does_within_its_window():
    xml = scene(ball("high", 0.0), channels=("high",))
    for height, touched in ((0.2, True), (1.5, False), (sunk(), True)):
        model, window = window_of(xml, [height])
        assert touches(model, window, "mujoco") == touched
        assert with_scatter(model, [replace(window, end=0.1)], cfg=AT_GRID)[0].scatter is None


def test_all_joints_of_a_mechanism_touch_where_one_of_its_links_does_and_no_others():
    m = mujoco.MjModel.from_xml_string("""
<mujoco>
  <worldbody>
    <geom type="plane" size="5 5 0.1"/>
    <body name="upper" pos="0 0 0.41">
      <joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>
      <body name="lower" pos="0.3 0 0">
        <joint axis="0 1 0"/><geom name="lower" type="capsule" fromto="0.1 0 0 0.4 0 0" size="0.02"/>
      </body>
    </body>
    <body name="block" pos="2 0 0.1"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>
    <body name="upon" pos="2 0 0.3"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>
    <body name="near" pos="-2 0 0.11"><freejoint/><geom type="box" size="0.1 0.1 0.1" margin="0.05"/></body>
  </worldbody>
</mujoco>""")
    names = ("arm", "arm", *(name for name in ("block", "upon", "near") for _ in range(6)))

    def touching(**moved: tuple[int, float]) -> set[str]:
        qpos = m.qpos0.copy()
        for index, value in moved.values():
            qpos[index] = value
        found = _touching_dofs(m, qpos)
        assert found.dtype == bool
        said = {name for name, touched in zip(names, found, strict=True) if touched}
        # All degrees of freedom of a mechanism, or none.
        assert all(touched == (name in said) for name, touched in zip(names, found, strict=True))
        return said

    down, clear, pressed = (1, np.pi / 2), (4, 0.2), (4, 0.0999)
    assert touching(block=clear, upon=(11, 1.0)) == set()  # within the margin of the near one, but apart
    assert touching(elbow=down, block=clear, upon=(11, 1.0)) == {"arm"}
    assert touching(block=pressed, upon=(11, 1.0)) == {"block"}
    assert touching(block=(4, 0.2), upon=(11, 0.3999)) == {"block", "upon"}
    assert touching(near=(18, 0.0999), block=clear, upon=(11, 1.0)) == {"near"}
