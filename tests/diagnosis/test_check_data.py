from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.diagnosis.cfg import CheckDataCfg
from concent_warp.diagnosis.check_data import _is_white, check_data, start_remarks
from concent_warp.recording.recording import Channel, Demonstration, PointTrack, Recording
from tests.scenes.swinging import swung


def spoiled(change):
    recording = swung(seconds=1.0)
    (d,) = recording.demonstrations
    return replace(recording, demonstrations=(replace(d, measured={"angle": change(d.measured["angle"])}),))


def paused(channel):
    kept = (channel.time < 0.3) | (channel.time > 0.6)
    return Channel(channel.time[kept], channel.value[kept], channel.noise_std)


def lost(channel):
    return replace(channel, value=np.where(channel.time[:, None] % 0.05 < 0.02, np.nan, channel.value))


def stuck(channel):
    return replace(channel, value=np.full_like(channel.value, 0.1))


def scattered(channel):
    return replace(channel, value=np.random.default_rng(0).normal(0, 0.5, channel.value.shape))


def alone(channel):
    return Channel(channel.time[:1], channel.value[:1], channel.noise_std)


def test_clean_data_are_not_remarked_on():
    assert check_data(swung(seconds=1.0)) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (paused, "demo_0, angle: 1 gaps of up to 0.32 s between samples 0.01 s apart."),
        (lost, "demo_0, angle: 42 % of the samples are missing."),
        (stuck, "demo_0, angle: the reading never changes."),
        (scattered, "demo_0, angle: the readings scatter like noise, no motion shows in them."),
        (alone, "demo_0, angle: only 1 sample, which carries no information."),
    ],
)
def test_doubtful_data_are_reported_with_their_place(change, words):
    assert check_data(spoiled(change)) == [words]


def said_of(time: np.ndarray, value: np.ndarray, noise: float | None = 1e-3, more: bool = False) -> list[str]:
    """Return what is said of a channel."""
    recording = swung(seconds=0.5)
    (d,) = recording.demonstrations
    measured = {"x": Channel(time, value, noise)}
    if more:
        measured["clean"] = d.measured["angle"]
    return check_data(replace(recording, demonstrations=(replace(d, measured=measured),)))


def test_thresholds_of_the_check_of_the_data():
    time = np.arange(40) * 0.01
    swing = np.sin(9 * time)[:, None]
    late = time.copy()
    late[20:] += 0.09
    assert said_of(late, swing) == []
    late[20:] += 0.0011
    late[30:] += 0.5
    assert said_of(late, swing) == ["demo_0, x: 2 gaps of up to 0.51 s between samples 0.01 s apart."]
    lost = swing.copy()
    lost[:8] = np.nan
    assert said_of(time, lost) == []
    lost[:9] = np.nan
    assert said_of(time, lost) == ["demo_0, x: 22 % of the samples are missing."]
    assert said_of(time[:10], 0 * swing[:10]) == []
    assert said_of(time[:11], 0 * swing[:11]) == ["demo_0, x: the reading never changes."]
    two = np.concatenate([0 * swing, swing], axis=1)
    assert said_of(time, two) == []
    assert said_of(time[:2], swing[:2]) == []
    assert said_of(time[:1], swing[:1]) == ["demo_0, x: only 1 sample, which carries no information."]
    white = np.where(np.arange(40) % 2, 1.0, -1.0)[:, None] * np.random.default_rng(0).uniform(0.5, 1, (40, 1))
    said = ["demo_0, x: the readings scatter like noise, no motion shows in them."]
    std = float(white.std())
    assert said_of(time, white, std / 3.01) == said
    assert said_of(time, white, std / 2.99) == []
    assert said_of(time, white, None) == said
    assert said_of(time, white, None, more=True) == []
    assert said_of(time[:29], white[:29], None) == []
    assert said_of(time[:30], white[:30], None) == said


def test_readings_are_white_where_all_that_move_differ_as_independent_ones():
    cfg, rng = CheckDataCfg(), np.random.default_rng(1)
    white, swing = rng.normal(size=(100, 1)), np.sin(np.arange(100) / 9)[:, None]
    assert _is_white(white, cfg)
    assert _is_white(np.hstack([white, 0 * white]), cfg)
    assert not _is_white(np.hstack([white, swing]), cfg)
    assert not _is_white(0 * white, cfg)
    ratio = np.mean(np.diff(white, axis=0) ** 2) / white.var()
    assert _is_white(white, replace(cfg, white_noise_ratio=ratio / 2 * 0.999))
    assert not _is_white(white, replace(cfg, white_noise_ratio=ratio / 2 * 1.001))


BALLS = """
<mujoco>
  <worldbody>
    <body name="seen"><freejoint/><geom size="0.1"/><site name="mark" pos="0.1 0 0"/></body>
    <body name="other" pos="1 0 0"><freejoint/><geom size="0.1"/></body>
  </worldbody>
  <sensor>
    <framepos name="seen" objtype="xbody" objname="seen"/>
    <framepos name="mark" objtype="site" objname="mark"/>
    <framepos name="other" objtype="xbody" objname="other"/>
  </sensor>
</mujoco>"""


def fallen(*names: str, **given) -> Recording:
    channel = Channel(np.arange(10) / 100, np.zeros((10, 3)))
    return Recording(BALLS, (Demonstration("drop", measured=dict.fromkeys(names, channel), **given),))


def test_a_body_of_which_nothing_says_where_it_starts_is_remarked_on():
    m = mujoco.MjModel.from_xml_string(BALLS)
    (said,) = start_remarks(m, fallen("seen"))
    assert "where other starts" in said
    # A marker beside the origin tells nothing without the orientation.
    (said,) = start_remarks(m, fallen("mark", "other"))
    assert "where seen starts" in said
    assert start_remarks(m, fallen("seen", "other")) == []
    assert start_remarks(m, fallen("seen", qpos=m.qpos0, qvel=np.zeros(m.nv))) == []
    track = PointTrack(np.arange(2.0), np.zeros((2, 3, 3)), np.ones((2, 3), dtype=bool))
    assert start_remarks(m, fallen("seen", points={"other": track})) == []


def test_orientations_of_either_sign_do_not_scatter():
    scene = """<mujoco><worldbody><body><joint name="socket" type="ball"/><geom size="0.1"/></body></worldbody>
    <sensor><ballquat name="turn" joint="socket"/></sensor></mujoco>"""
    time = np.arange(0, 2, 0.01)
    angle = 0.4 * np.sin(3 * time)
    value = np.stack([np.cos(angle), np.sin(angle), 0 * angle, 0 * angle], axis=1)
    value *= np.random.default_rng(0).choice([-1.0, 1.0], (len(time), 1))
    assert check_data(Recording(scene, (Demonstration("demo_0", measured={"turn": Channel(time, value)}),))) == []
