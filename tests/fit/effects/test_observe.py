from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.fit.effects.observation import ObservedRecording, start_spread
from concent_warp.fit.effects.observation_cfg import ObservationCfg
from concent_warp.fit.effects.observe import _calmest, channel_noises, keeps_close, moves_untouched, observe
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene
from tests.scenes.swinging import NOISE, drawing, swing_scene, swung, windows_of
from tests.scenes.tossing import EDGE, toss_scene, tosses


def with_channels(recording, **measured):
    (d,) = recording.demonstrations
    return replace(recording, demonstrations=(replace(d, measured=measured),))


def test_windows_follow_one_another_and_hold_every_sample_once():
    recording = swung()
    windows = windows_of(recording, 0.5)
    assert [w.start for w in windows][1:] == [w.end for w in windows][:-1]
    assert windows[0].start == 0.0
    assert windows[-1].end == pytest.approx(2.0)
    assert all(0.35 * 0.5 <= w.end - w.start <= 0.5 + 0.12 for w in windows)
    samples = np.concatenate([w.start + r.time for w in windows for r in w.readings])
    known = recording.demonstrations[0].measured["angle"].time
    np.testing.assert_allclose(np.unique(samples.round(9)), known.round(9))


def test_a_motion_that_forgets_its_start_is_one_window_and_one_with_impacts_is_several():
    assert len(windows_of(swung())) == 1
    tossed = tosses(1)
    assert len(observe(Model(Scene(toss_scene(EDGE))), tossed)) > 2


FLYING = """<mujoco>
  <option timestep="0.002"/>
  <worldbody><geom type="plane" size="1 1 .1" {}/><body name="ball" pos="0 0 3"><freejoint/><geom size=".05" {}/></body>
  </worldbody>
  <contact>{}</contact>
  <sensor>
    <framepos name="place" objtype="xbody" objname="ball"/><framequat name="turned" objtype="xbody" objname="ball"/>
  </sensor>
</mujoco>"""
NO_MASK = 'contype="0" conaffinity="0"'


def thrown(scene: str, kick: float = 6.0, seconds: float = 1.5) -> tuple[Model, Recording]:
    """Return a model of a ball and a recording of its flight, in which it touches nothing."""
    model, time = Model(Scene(scene)), 0.01 * np.arange(round(100 * seconds) + 1)
    m = model.compile()
    qvel = np.zeros(6)
    qvel[2] = kick
    place = np.stack([0 * time, 0 * time, 3 + kick * time - 9.81 / 2 * time**2], axis=1)
    measured = {
        "place": Channel(time, place + NOISE * np.random.default_rng(0).normal(size=place.shape), NOISE),
        "turned": Channel(time, np.tile([1.0, 0, 0, 0], (len(time), 1)), NOISE),
    }
    return model, Recording(scene, (Demonstration("demo_0", qpos=m.qpos0, qvel=qvel, measured=measured),))


@pytest.mark.parametrize(
    ("scene", "touchable"),
    [
        (FLYING.format("", "", ""), True),
        (FLYING.format('name="floor" ' + NO_MASK, 'name="hull" ' + NO_MASK, ""), False),
        (
            FLYING.format('name="floor" ' + NO_MASK, 'name="hull" ' + NO_MASK, '<pair geom1="floor" geom2="hull"/>'),
            True,
        ),
    ],
)
def test_windows_of_free_bodies_that_can_be_touched_last_two_seconds_at_most(scene, touchable):
    model, recording = thrown(scene, kick=25.0, seconds=5.0)
    longest = ObservationCfg().max_contact_length
    assert longest == 2.0
    windows = observe(model, recording)
    if not touchable:
        assert [(w.start, w.end) for w in windows] == [(0.0, 5.0)]
        return
    assert len(windows) >= 3
    # The last may take over a rest that is shorter than the shortest window.
    assert all(w.end - w.start <= longest + 1e-9 for w in windows[:-1])
    assert windows[-1].end - windows[-1].start <= longest + ObservationCfg().min_length
    assert windows[-1].end == pytest.approx(5.0)
    (asked,) = observe(model, recording, length=5.0)
    assert asked.end == pytest.approx(5.0)
    shorter = observe(model, recording, cfg=ObservationCfg(max_contact_length=0.3))
    assert max(w.end - w.start for w in shorter[:-1]) <= 0.3 + 1e-9


def test_errors_of_a_free_bodys_state_stay_in_proportion_for_longer_than_its_windows():
    model, recording = thrown(FLYING.format("", "", ""))
    source = ObservedRecording(model, recording, {"place": NOISE, "turned": NOISE})
    assert keeps_close(source, recording[0], 0.0, 1.5, "mujoco", 0) == pytest.approx(1.5)


def dropped(timestep: float = 0.004) -> tuple[Model, Recording]:
    """Return a model of a ball and a recording of its fall on the floor and rebounds, at steps of a tenth of that."""
    scene = FLYING.format('solref="-40000 -10"', 'mass="0.1" solref="-40000 -10"', "")
    m = mujoco.MjModel.from_xml_string(scene)
    m.opt.timestep = timestep / 10
    d = mujoco.MjData(m)
    d.qpos[2], d.qvel[:3] = 0.3, [0.3, 0.1, 0.5]
    qpos, qvel, read = d.qpos.copy(), d.qvel.copy(), []
    for _ in range(151):
        mujoco.mj_forward(m, d)
        read.append(d.sensordata.copy())
        mujoco.mj_step(m, d, round(0.01 / m.opt.timestep))
    time, seen = 0.01 * np.arange(len(read)), np.array(read)
    seen[:, :3] += NOISE * np.random.default_rng(0).normal(size=(len(seen), 3))
    measured = {"place": Channel(time, seen[:, :3], NOISE), "turned": Channel(time, seen[:, 3:], NOISE)}
    xml = scene.replace('timestep="0.002"', f'timestep="{timestep}"')
    return Model(Scene(xml)), Recording(xml, (Demonstration("demo_0", qpos=qpos, qvel=qvel, measured=measured),))


def test_windows_of_a_ball_that_rebounds_have_numerical_scatter_and_those_of_a_swing_have_none():
    assert all(w.scatter is None for w in windows_of(swung(), 0.5))
    model, recording = dropped()
    windows = observe(model, recording)
    assert windows[0].scatter is not None
    # The long steps of the model are within it, and well beyond the noise.
    both = [windows[0], replace(windows[0], scatter=None)]
    trials = [SimulationRequest(k, np.zeros(0)) for k in range(2)]
    whitened, plain = (np.sqrt(np.mean(r**2)) for r in Prediction(model, (), both).residuals(trials))
    assert whitened == pytest.approx(1.0, abs=0.15)
    assert plain > 2.5


def test_the_numerical_scatter_of_a_rebound_does_not_end_a_window():
    model, recording = dropped()
    reach = []
    for cfg in (ObservationCfg(), ObservationCfg(max_scatter_noise=1e-6)):
        source = ObservedRecording(model, recording, {"place": NOISE, "turned": NOISE}, cfg)
        reach.append(keeps_close(source, recording[0], 0.0, 1.5, "mujoco", 0))
    assert reach[0] > 1.3 * reach[1]


def test_the_state_at_the_start_of_a_window_is_the_measured_one():
    recording = swung(damping=0.0)
    later = windows_of(recording, 0.5)[1]
    m = mujoco.MjModel.from_xml_string(recording.scene)
    d = mujoco.MjData(m)
    d.qpos[0] = 0.3
    action = recording.demonstrations[0].action["servo"]
    while d.time < later.start - 1e-9:
        d.ctrl[0] = action.value[np.searchsorted(action.time, d.time + 1e-9, side="right") - 1]
        mujoco.mj_step(m, d)
    assert abs(later.qpos[0] - d.qpos[0]) < ObservationCfg().state_noise * NOISE
    assert later.qvel[0] == pytest.approx(d.qvel[0], rel=0.1)  # a command changes there, and with it the acceleration


def test_motion_from_the_top_keeps_close_to_its_start_for_a_shorter_time():
    xml = swing_scene(kp=1e-6)
    time = 0.01 * np.arange(200)
    reach = []
    for angle in (0.05, np.pi - 0.001):
        d = Demonstration(
            "demo_0",
            qpos=np.array([angle]),
            qvel=np.zeros(1),
            action={"servo": Channel(np.zeros(1), np.zeros(1))},
            measured={"angle": Channel(time, 0 * time[:, None])},
        )
        model = Model(Scene(xml))
        source = ObservedRecording(model, Recording(xml, (d,)), {"angle": NOISE})
        reach.append(keeps_close(source, d, 0.0, 1.99, "mujoco", 0))
    assert reach[0] == pytest.approx(1.99)
    assert reach[1] < 1.5


def test_a_window_ends_late_but_before_an_impact():
    class Rough:
        def scatter_of_both_sides(self, times):
            return np.where(times > 0.8, 10.0, 1.0)

    found = _calmest(Rough(), 0.0, 1.0, ObservationCfg())  # pyright: ignore[reportArgumentType]
    assert 0.75 < found <= 0.8


def test_an_initial_state_is_as_uncertain_as_what_was_seen_of_it():
    m = mujoco.MjModel.from_xml_string(swing_scene())
    np.testing.assert_allclose(
        start_spread(m, {"angle": NOISE}), [3 * NOISE, 3 * NOISE / ObservationCfg().velocity_time]
    )
    unseen = start_spread(m, {})
    cube = mujoco.MjModel.from_xml_string(toss_scene(EDGE))
    seen = start_spread(cube, {"position": 1e-4, "orientation": 2e-3})
    np.testing.assert_allclose(seen[:6], [3e-4] * 3 + [6e-3] * 3)
    assert unseen.tolist() == [1e-3, 1e-2]


def test_stated_noise_is_used_and_other_noise_is_estimated():
    recording = swung()
    assert channel_noises(drawing(recording), recording) == {"angle": NOISE}
    channel = replace(recording.demonstrations[0].measured["angle"], noise_std=None)
    silent = with_channels(recording, angle=channel)
    assert channel_noises(drawing(recording), silent)["angle"] == pytest.approx(NOISE, rel=0.5)


def test_a_channel_that_the_model_cannot_predict_is_named():
    recording = swung(quaternion=True)
    with pytest.raises(RecordingError, match="'turned' that the model lacks"):
        channel_noises(Model(Scene(swing_scene())), recording)


def test_a_channel_of_another_size_than_its_sensor_is_named():
    recording = swung()
    channel = recording.demonstrations[0].measured["angle"]
    wide = with_channels(recording, angle=replace(channel, value=np.tile(channel.value, (1, 2))))
    with pytest.raises(RecordingError, match="another number of values"):
        channel_noises(drawing(recording), wide)


@pytest.mark.parametrize("count", [0, 1, 5])
def test_a_few_samples_are_too_little(count):
    recording = swung()
    channel = recording.demonstrations[0].measured["angle"]
    few = {"angle": Channel(channel.time[:count], channel.value[:count], NOISE)} if count else {}
    with pytest.raises(RecordingError, match="too little was measured"):
        observe(drawing(recording), with_channels(recording, **few))


TOUCHING = """<mujoco><worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 .2"><joint type="slide" axis="0 0 1"/>
<geom size=".05" {}/></body></worldbody></mujoco>"""

TOUCHING_PAIR = (
    TOUCHING.format('name="ball" contype="0" conaffinity="0"')
    .replace('type="plane"', 'name="floor" type="plane" contype="0" conaffinity="0"')
    .replace("</mujoco>", '<contact><pair geom1="floor" geom2="ball"/></contact></mujoco>')
)


@pytest.mark.parametrize(
    ("scene", "seconds", "untouched"),
    [
        (TOUCHING.format(""), 0.1, True),
        (TOUCHING.format(""), 0.3, False),
        (TOUCHING.format('contype="0" conaffinity="0"'), 0.3, True),
        (TOUCHING_PAIR, 0.1, True),
        (TOUCHING_PAIR, 0.3, False),
        (TOUCHING.format("").replace('type="slide" axis="0 0 1"', 'type="free"'), 0.1, False),
    ],
)
def test_motion_is_smooth_where_nothing_moves_freely_or_touches_anything(scene, seconds, untouched):
    model = Model(Scene(scene))
    m = model.compile()
    d = Demonstration("demo", measured={})
    window: Any = SimpleNamespace(demonstration=d, start=0.0, end=seconds, qpos=m.qpos0, qvel=np.zeros(m.nv))
    assert moves_untouched(model, [window], "mujoco") is untouched
