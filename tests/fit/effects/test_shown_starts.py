"""A window starts at the state that its instruments show; effects on measurements tell the true one and its time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from concent_warp.effects.effect import Effect
from concent_warp.effects.library.measurement import FrameOffset, Latency, LengthScale, SensorBias, SensorGain, TimeBase
from concent_warp.effects.registry import effect_classes
from concent_warp.effects.select import shown_dofs, shown_free_joint
from concent_warp.fit.effects.observation import Reading, Window
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.scene.scene import Scene
from tests.scenes.swinging import drawing, swung, windows_of

NOISE = 1e-3
"""Standard deviation of a position [m] and of an orientation [rad]."""
START, LENGTH = 0.4, 0.3
"""When the instruments say that the window starts, and how long it lasts [s]."""
PLACE, SPEED = np.array([0.5, -0.3, 1.2]), np.array([1.5, 0.8, 2.0])
"""Position [m] and velocity [m/s] of the ball at the true time 0."""
TURNED, SPIN = Rotation.from_rotvec([0.3, -0.2, 0.9]), np.array([2.0, -1.0, 3.0])
"""Orientation at that time, and velocity of rotation in the ball's frame [rad/s]."""
BALL = """
<mujoco>
  <option timestep="0.002" integrator="RK4" gravity="0 0 {gravity}"/>
  <worldbody>
    <body name="ball" pos="0 0 1"><freejoint/><geom size="0.05" mass="0.1" contype="0" conaffinity="0"/></body>
    <body name="arm" pos="3 0 1">
      <joint name="hinge" axis="0 1 0"/><geom size="0.05" pos="0 0 -0.2" mass="0.1" contype="0" conaffinity="0"/>
      <site name="tip" pos="0 0 -0.2"/>
    </body>
  </worldbody>
  <sensor>
    <framepos name="place" objtype="xbody" objname="ball"/><framequat name="turn" objtype="xbody" objname="ball"/>
    <framepos name="middle" objtype="body" objname="ball"/><framepos name="tip" objtype="site" objname="tip"/>
    <framepos name="arm" objtype="xbody" objname="arm"/><jointpos name="angle" joint="hinge"/>
    <jointvel name="rate" joint="hinge"/>
  </sensor>
</mujoco>"""
POSES = ("place", "turn")


@dataclass(frozen=True)
class State:
    """Of the ball."""

    place: np.ndarray
    turn: Rotation
    speed: np.ndarray
    spin: np.ndarray


def true(time: float, gravity: float = -9.81) -> State:
    """Return the state of a ball in flight at a true time [s]."""
    g = np.array([0.0, 0.0, gravity])
    place, speed = PLACE + time * SPEED + time**2 / 2 * g, SPEED + time * g
    return State(place, TURNED * Rotation.from_rotvec(time * SPIN), speed, SPIN)


def shown_window(m: mujoco.MjModel, show: Callable[[float], State]) -> Window:
    """Return a window that starts at what instruments show, which is a function of the time that they stamp it with."""
    time = np.arange(0.0, LENGTH, 0.005)
    states, rng = [show(START + t) for t in time], np.random.default_rng(0)
    place = np.array([s.place for s in states]) + NOISE * rng.normal(size=(len(time), 3))
    turn = [s.turn * Rotation.from_rotvec(NOISE * rng.normal(size=3)) for s in states]
    rows = [slice(0, 3 * len(time)), slice(3 * len(time), 6 * len(time))]
    readings = (
        Reading("place", rows[0], time, place, NOISE, False),
        Reading("turn", rows[1], time, np.array([r.as_quat(scalar_first=True) for r in turn]), NOISE, True),
    )
    first = show(START)
    qpos, qvel = m.qpos0.copy(), np.zeros(m.nv)
    qpos[:7] = [*first.place, *first.turn.as_quat(scalar_first=True)]
    qvel[:6] = [*first.speed, *first.spin]
    clock = START + np.tile(np.repeat(time, 3), 2)
    d = Demonstration("flight")
    spread = np.ones(2 * m.nv)
    return Window(d, 0, START, START + LENGTH, qpos, qvel, spread, readings, 6 * len(time), clock)


def check_start(prediction: Prediction, values: Sequence[float], time: float, state: State) -> None:
    """Check that a simulation starts at a true time in a true state, and that this leaves nothing but noise."""
    (window,), given = prediction.windows, np.array(values)
    qpos, qvel = prediction.first_state(window, given)
    assert prediction.first_time(window, given) == pytest.approx(time, abs=1e-12)
    np.testing.assert_allclose(qpos[:3], state.place, atol=1e-12)
    assert (Rotation.from_quat(qpos[3:7], scalar_first=True).inv() * state.turn).magnitude() < 1e-9
    np.testing.assert_allclose(qvel[:6], [*state.speed, *state.spin], atol=1e-12)
    (residual,) = prediction.residuals([SimulationRequest(0, given)])
    assert np.sqrt(np.mean(residual**2)) == pytest.approx(1.0, abs=0.1)


def left_without_correction(prediction: Prediction, values: Sequence[float]) -> float:
    """Return the residual over the noise where the state that is shown is taken for the true one."""
    window = replace(prediction.windows[0], start_shown=False)
    assert prediction.first_time(window, np.array(values)) == window.start
    assert prediction.first_state(window, np.array(values)) == (window.qpos, window.qvel)
    prediction.windows, prediction._kept = [window], {}
    (residual,) = prediction.residuals([SimulationRequest(0, np.array(values))])
    return float(np.sqrt(np.mean(residual**2)))


SHIFT, TILT = np.array([0.02, -0.03, 0.01]), np.array([0.02, 0.05, -0.03])


def late(time: float) -> State:
    """Return what a clock shows that is 0.02 s late."""
    return true(time - 0.02)


def fast(time: float) -> State:
    """Return what a clock shows that runs 3 % fast: all happens later by it, and more slowly."""
    s = true(time / 1.03)
    return replace(s, speed=s.speed / 1.03, spin=s.spin / 1.03)


def large(time: float) -> State:
    """Return what is seen where lengths are taken to be 4 % larger."""
    s = true(time)
    return replace(s, place=1.04 * s.place, speed=1.04 * s.speed)


def moved(time: float, state: Callable[[float], State] = true) -> State:
    """Return what a camera shows that is taken to be elsewhere."""
    s, turn = state(time), Rotation.from_rotvec(TILT)
    return State(turn.apply(s.place) + SHIFT, turn * s.turn, turn.apply(s.speed), s.spin)


@pytest.mark.parametrize(
    ("effect", "values", "show", "time", "left"),
    [
        (TimeBase(*POSES), [0.03], fast, START / 1.03, 10.0),
        (Latency(*POSES), [0.02], late, START - 0.02, 20.0),
        (LengthScale("place"), [0.04], large, START, 20.0),
        (FrameOffset(*POSES), [*SHIFT, *TILT], moved, START, 20.0),
    ],
    ids=lambda value: value.name if isinstance(value, Effect) else "",
)
def test_a_free_body_starts_in_its_true_state_at_the_true_time(effect, values, show, time, left):
    model = Model(Scene(BALL.format(gravity=-9.81)))
    prediction = Prediction(model, (effect,), [shown_window(model.compile(), show)])
    assert not prediction.measured_only.any()
    check_start(prediction, values, time, true(time))
    assert left_without_correction(prediction, values) > left


def test_the_state_is_corrected_by_all_effects_the_last_one_first():
    def show(time):
        seen = moved(time, fast)  # the camera turns and shifts, then the lengths are scaled
        return replace(seen, place=1.04 * seen.place, speed=1.04 * seen.speed)

    model = Model(Scene(BALL.format(gravity=-9.81))).add(TimeBase(*POSES), [0.0]).add(FrameOffset(*POSES))
    prediction = Prediction(model, (LengthScale("place"),), [shown_window(model.scene.model, show)])
    check_start(prediction, [0.03, *SHIFT, *TILT, 0.04], START / 1.03, true(START / 1.03))


def test_what_some_channels_show_late_is_moved_along_its_velocity():
    def show(time):
        return replace(true(time, 0.0), place=true(time - 0.02, 0.0).place)

    model = Model(Scene(BALL.format(gravity=0.0)))
    prediction = Prediction(model, (Latency("place"),), [shown_window(model.compile(), show)])
    check_start(prediction, [0.02], START, true(START, 0.0))
    assert left_without_correction(prediction, [0.02]) > 20


def test_what_a_fast_clock_of_some_channels_shows_is_moved_along_its_velocity():
    def show(time):
        s, turning = true(time, 0.0), true(time / 1.03, 0.0)
        return replace(s, turn=turning.turn, spin=turning.spin / 1.03)

    model = Model(Scene(BALL.format(gravity=0.0)))
    prediction = Prediction(model, (TimeBase("turn"),), [shown_window(model.compile(), show)])
    check_start(prediction, [0.03], START, true(START, 0.0))
    assert left_without_correction(prediction, [0.03]) > 10


def test_simulations_may_start_when_windows_do():
    model = Model(Scene(BALL.format(gravity=0.0)))
    show = lambda time: true(time - 0.02, 0.0)  # noqa: E731
    window = shown_window(model.compile(), show)
    check_start(Prediction(model, (Latency(*POSES),), [window], at_true_time=True), [0.02], START, true(START, 0.0))


def test_commands_are_those_of_the_true_time():
    xml = BALL.format(gravity=0.0).replace(
        "<sensor>", '<actuator><motor name="motor" joint="hinge"/></actuator><sensor>'
    )
    model = Model(Scene(xml))
    pushed = Channel(np.array([0.0, START - 0.01]), np.array([0.0, 1.0]))
    window = shown_window(model.compile(), late)
    window = replace(window, demonstration=Demonstration("flight", action={"motor": pushed}))
    prediction = Prediction(model, (Latency(*POSES),), [window])
    trials = [SimulationRequest(0, np.array([delay])) for delay in (0.0, 0.02)]
    for course, at_rest in zip(prediction.courses(trials), (0, 5), strict=True):
        rate = np.abs(course.qvel[:, 6])
        assert not rate[: at_rest + 1].any()  # 0.01 s of the earlier start pass before the push
        assert rate[at_rest + 1 :].all()


def test_joints_beside_a_free_body_start_without_the_bias_and_gain_of_their_sensors():
    model = Model(Scene(BALL.format(gravity=0.0)))
    window = shown_window(model.compile(), true)
    window.qpos[7], window.qvel[6] = 1.2 * 0.3 + 0.05, 1.2 * 2.0
    bias, gain = SensorBias("angle"), SensorGain("angle", "rate")
    both = Prediction(model.add(gain), (bias,), [window])
    qpos, qvel = both.first_state(window, np.array([0.2, 0.7, 0.05]))
    assert (qpos[7], qvel[6]) == pytest.approx((0.3, 2.0))  # that of the velocity's sensor is another one
    np.testing.assert_array_equal(qpos[:7], window.qpos[:7])
    np.testing.assert_array_equal(qvel[:6], window.qvel[:6])
    assert both.first_time(window, np.array([0.2, 0.7, 0.05])) == START
    assert window.qpos[7] == 1.2 * 0.3 + 0.05  # as it was


@pytest.mark.parametrize(
    ("effect", "values"),
    [
        (TimeBase("angle"), [0.1]),
        (Latency("angle"), [0.02]),
        (SensorBias("angle"), [0.1]),
        (SensorGain("angle"), [0.3]),
    ],
    ids=lambda value: value.name if isinstance(value, Effect) else "",
)
def test_joints_alone_start_as_they_are_shown_and_one_simulation_serves_all_values(effect, values):
    recording = swung(seconds=1.0)
    window = windows_of(recording, 0.5)[1]
    prediction, given = Prediction(drawing(recording), (effect,), [window]), np.array(values)
    assert prediction.first_time(window, given) == window.start > 0
    assert prediction.first_state(window, given) == (window.qpos, window.qvel)
    assert prediction.measured_only.all()
    trials = [SimulationRequest(0, share * given) for share in (0.0, 0.5, 1.0)]
    null, _, full = prediction.residuals(trials)
    assert prediction.simulated == pytest.approx(window.end - window.start, abs=0.01)
    assert np.abs(full - null).max() > 5


def test_sensors_show_the_degrees_of_freedom_of_their_joint_or_free_body():
    m = mujoco.MjModel.from_xml_string(BALL.format(gravity=0.0))
    for names, dofs in (
        (("place",), [0, 1, 2]),
        (("middle", "place"), [0, 1, 2]),
        (("turn",), [3, 4, 5]),
        (("turn", "angle"), [3, 4, 5, 6]),
        (("rate", "tip", "arm"), []),  # a velocity, a site and a body that does not move freely
        ((), []),
    ):
        assert shown_dofs(m, names).tolist() == dofs
    joints = {name: shown_free_joint(m, m.sensor(name).id) for name in ("place", "middle", "turn", "tip", "arm")}
    assert joints == {"place": 0, "middle": 0, "turn": 0, "tip": None, "arm": None}


def test_which_effects_mislead_the_start():
    expected = {e.name for e in (TimeBase, Latency, LengthScale, FrameOffset, SensorBias, SensorGain)}
    assert {name for name, kind in effect_classes().items() if kind().misleads_start} == expected
