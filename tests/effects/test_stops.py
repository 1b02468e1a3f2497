"""Effects at the limits of joints, against the formulas of a mass that meets a stop."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import concent_warp as cw
from concent_warp.effects.effect import Effect
from concent_warp.effects.library.limits import LimitCompliance, LimitOffset, reached_stops
from concent_warp.errors import ModelError
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene
from concent_warp.simulate.parallel import limit_simulations

MASS, STOP = 0.5, 0.1
"""Mass of a slide [kg], and where its stop is [m]."""
SLIDE = f"""<mujoco><option timestep="{{step}}" integrator="implicitfast" gravity="0 0 0"/><worldbody>
<body name="slide"><joint name="rail" type="slide" axis="1 0 0" range="-1 {STOP}"{{own}}/>
<inertial pos="0 0 0" mass="{MASS}" diaginertia=".01 .01 .01"/>
<body name="arm"><joint name="free" axis="0 0 1"/>
<inertial pos="0 0 0" mass="1e-4" diaginertia="1e-5 1e-5 1e-5"/></body></body></worldbody>
<actuator><motor name="push" joint="rail"/></actuator>
<sensor><jointpos name="place" joint="rail"/></sensor></mujoco>"""


def model(own: str = "", step: float = 1e-4) -> Model:
    return Model(Scene(SLIDE.format(own=own, step=step)))


def rebound(effect: Effect, values: list[float], own: str = "") -> float:
    """Return the velocity after the stop over that before it."""
    m = model(own).add(effect, values).compile()
    d = mujoco.MjData(m)
    d.qvel[0] = 0.5
    mujoco.mj_step(m, d, 4000)
    return -float(d.qvel[0]) / 0.5


@pytest.mark.parametrize("own", ["", " solreflimit='-10000 -60'"])
def test_the_damping_ratio_of_a_stop_is_how_fast_it_rebounds(own):
    time, ratio = (p.null for p in LimitCompliance("rail").parameters(model(own).compile()))
    for given in (0.3, 0.6):
        # A stop does not pull: the slide leaves it where spring and damper balance.
        left = np.exp(-given / np.sqrt(1 - given**2) * np.arccos(2 * given**2 - 1))
        assert rebound(LimitCompliance("rail"), [time * ratio / given, given], own) == pytest.approx(left, abs=0.05)


def test_the_null_values_are_those_of_the_model_however_it_states_them():
    null = [p.null for p in LimitCompliance("rail").parameters(model(" solreflimit='-10000 -60'").compile())]
    assert null == pytest.approx([2 / 60, 60 / (2 * 100)])
    assert [p.null for p in LimitCompliance("rail").parameters(model().compile())] == [0.02, 1.0]
    for own in ("", " solreflimit='-10000 -60'"):
        m = model(own).compile()
        given = m.jnt_solref[0].copy()
        LimitCompliance("rail").write(m, np.array([p.null for p in LimitCompliance("rail").parameters(m)]))
        np.testing.assert_allclose(m.jnt_solref[0], given)
    undamped = model(" solreflimit='-10000 0'").compile()
    assert (LimitCompliance.targets(undamped), LimitOffset.targets(undamped)) == ((), ())


def test_a_stop_elsewhere_is_where_the_joint_comes_to_rest():
    m = model(" solreflimit='0.002 1' damping='5'").add(LimitOffset("rail"), [-1.0, 0.07]).compile()
    d = mujoco.MjData(m)
    d.ctrl[0] = 0.1
    mujoco.mj_step(m, d, 80_000)
    assert d.qpos[0] == pytest.approx(0.07, abs=1e-4)
    low, high = LimitOffset("rail").parameters(model().compile())
    assert (low.name, low.null, high.name, high.null, high.unit) == ("low[rail]", -1.0, "high[rail]", STOP, "m")


def test_only_joints_with_limits_have_stops_and_only_those_that_come_near_show_them():
    m = model().compile()
    assert LimitCompliance.targets(m) == LimitOffset.targets(m) == (("rail",),)
    with pytest.raises(ModelError, match="hinges and slides with limits"):
        model().add(LimitCompliance("free"), [0.02, 1.0])
    away, near, beyond = (np.array([[-0.3, 0.0], [end, 3.0]]) for end in (-0.2, 0.05, 0.11))
    for courses, found in (([away], set()), ([away, near], {"rail"}), ([beyond], {"rail"}), ([], set())):
        assert reached_stops(m, courses, 0.1) == found
    assert reached_stops(m, [near], 0.01) == set()


def pushed(stop: float, damping: float) -> Recording:
    """Return a slide that is thrown at a stop some times, whose spring swings it at 100 rad/s, by these laws alone."""
    rng, time, step = np.random.default_rng(5), np.arange(300) * 0.01, 1e-5
    command = np.select([time % 1 < 0.3, time % 1 < 0.6], [1.0, -0.8], 0.0) * (1 + 0.3 * (time > 1))
    x, v, rows = 0.0, 0.0, []
    for k in range(300_000):
        if k % 1000 == 0:
            rows.append(x)
        held = -MASS * (1e4 * (x - stop) + 2 * damping * 100 * v) if x > stop else 0.0
        v += step * (command[k // 1000] + min(held, 0.0) - 2.0 * v) / MASS
        x += step * v
    seen = np.array(rows)[:, None] + rng.normal(0, 1e-4, (300, 1))
    demo = Demonstration("d", action={"push": Channel(time, command[:, None])}, measured={"place": Channel(time, seen)})
    return Recording(SLIDE.format(own=" damping='2'", step=0.002), (demo,))


@pytest.mark.parametrize(
    ("recording", "name", "parameter", "true"),
    [
        (pushed(STOP, 0.25), "limit_compliance", "damping_ratio", 0.25),
        (pushed(0.085, 1.0), "limit_offset", "high", 0.085),
    ],
)
def test_what_is_off_at_a_stop_is_named(recording, name, parameter, true):
    effects = ("limit_compliance", "limit_offset", "joint_damping", "joint_friction", "actuator_gain", "backlash")
    with limit_simulations(1):
        cfg = cw.DiagnoseCfg(jobs=1, explain=False, effects=effects)
        found = cw.diagnose(Model.from_recording(recording), recording, cfg)
    assert found.verdict in ("effect", "group")
    assert name in found.groups[0]
    (finding,) = (f for f in found.effects if f.name == name and f.step == 0)
    (value,) = (p for p in finding.parameters if p.name.startswith(parameter))
    assert value.value == pytest.approx(true, rel=0.2 if name == "limit_compliance" else 0.02)
