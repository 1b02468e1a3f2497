from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.recording.validation.validate import validate


def edited(recording: Recording, kind: str, name: str, **changes) -> Recording:
    """Change fields of one channel of the first demonstration; a callable is given the old value."""
    demonstration = recording.demonstrations[0]
    streams = dict(getattr(demonstration, kind))
    stream = streams[name]
    new = {key: change(getattr(stream, key)) if callable(change) else change for key, change in changes.items()}
    streams[name] = replace(stream, **new)
    return replace(recording, demonstrations=(replace(demonstration, **{kind: streams}),))


def renamed(recording: Recording, kind: str, old: str, new: str) -> Recording:
    demonstration = recording.demonstrations[0]
    streams = {new if name == old else name: stream for name, stream in getattr(demonstration, kind).items()}
    return replace(recording, demonstrations=(replace(demonstration, **{kind: streams}),))


def with_initial(recording: Recording, **state) -> Recording:
    return replace(recording, demonstrations=(replace(recording.demonstrations[0], **state),))


def put(row, number):
    def change(array):
        array = np.array(array)
        array[row] = number
        return array

    return change


def only(recording: Recording, **kinds) -> Recording:
    return replace(recording, demonstrations=(Demonstration("demo_0", **kinds),))


def is_sound(recording: Recording) -> bool:
    """Return whether a recording passes the check."""
    try:
        validate(recording)
    except RecordingError:
        return False
    return True


def test_a_sound_recording_passes(recording):
    assert is_sound(recording)
    assert not is_sound(replace(recording, demonstrations=()))


CHANNELS = {
    "unsorted time": (("measured", "elbow_angle", {"time": lambda t: t[::-1]}), "row 1: time does not increase"),
    "repeated time": (("measured", "elbow_angle", {"time": put(5, 0.042)}), "row 5: time does not increase"),
    "NaN time": (("action", "elbow", {"time": put(3, np.nan)}), "action/elbow, row 3: time is not finite"),
    "negative time": (("measured", "elbow_angle", {"time": lambda t: t - 1}), "time is negative"),
    "time in two axes": (("measured", "elbow_angle", {"time": lambda t: t[:, None]}), "wrong shape of time"),
    "no samples": (("action", "elbow", {"time": np.zeros(0), "value": np.zeros(0)}), "wrong number of samples"),
    "infinity": (("measured", "block_position", {"value": put((9, 1), -np.inf)}), "row 9: a value is infinite"),
    "absurd value": (("measured", "block_velocity", {"value": put(9, 1e200)}), "row 9: a value is absurdly large"),
    "all missing": (("measured", "elbow_angle", {"value": lambda v: v * np.nan}), "every value is missing"),
    "NaN command": (("action", "elbow", {"value": put(slice(8, 12), np.nan)}), "row 8: 4 of 50 values are missing"),
    "wrong dimension": (
        ("measured", "block_position", {"value": lambda v: v[:, :2]}),
        r"\(50, 3\), found \(50, 2\)",
    ),
    "two columns": (
        ("measured", "elbow_angle", {"value": lambda v: np.hstack([v, v])}),
        r"\(50, 1\), found \(50, 2\)",
    ),
    "short values": (("action", "elbow", {"value": lambda v: v[:-1]}), r"expected \(50,\), found \(49,\)"),
    "text values": (("action", "elbow", {"value": lambda v: v.astype("U8")}), "wrong shape of the values"),
    "negative noise": (("measured", "elbow_angle", {"noise_std": -1.0}), "noise_std"),
    "long quaternion": (
        ("measured", "block_orientation", {"value": put(4, [2, 0, 0, 0])}),
        "row 4: a quaternion is n",
    ),
    "half a quaternion": (
        ("measured", "block_orientation", {"value": put((4, 1), np.nan)}),
        "row 4: a quaternion is m",
    ),
    "millimetres": (("measured", "block_position", {"value": lambda v: 1e3 * v}), "look like millimetres"),
    "mm/s": (
        ("measured", "block_velocity", {"value": put(5, [0, 0, -1200])}),
        "row 5: its speeds look like",
    ),
    "degrees": (("measured", "elbow_angle", {"value": lambda v: np.degrees(v)}), "look like degrees"),
    "slide in mm": (("measured", "grip_width", {"value": lambda v: 1e3 * v}), "look like millimetres"),
    "tendon in mm": (("measured", "opening", {"value": lambda v: 1e3 * v}), "range 0 to 0.08 m of tendon 'opening'"),
    "tendon command in mm": (("action", "opening", {"value": lambda v: 1e3 * v}), "look like millimetres"),
    "command in degrees": (("action", "elbow", {"value": lambda v: np.degrees(v)}), "look like degrees"),
    "command in mm": (
        ("action", "left/grip", {"value": lambda v: 1e3 * v}),
        "action/left/grip, row 0: its v",
    ),
    "milliseconds": (("measured", "elbow_angle", {"time": lambda t: 1e3 * t}), "looks like milliseconds"),
    "command in ms": (
        ("action", "elbow", {"time": lambda t: 1e3 * t}),
        "action/elbow: its time looks like mill",
    ),
    "nanosecond steps": (("measured", "elbow_angle", {"time": lambda t: 1e-6 * t}), "does not look like seconds"),
    "clock apart": (("measured", "elbow_angle", {"time": lambda t: t + 1000}), "does not overlap"),
    "points of two": (("points", "block", {"value": lambda p: p[..., :2]}), "wrong shape of the points"),
    "visible of one": (("points", "block", {"visible": lambda v: v[:, :1]}), "visible does not fit"),
    "visible as numbers": (("points", "block", {"visible": lambda v: v.astype(int)}), "visible does not fit"),
    "nothing visible": (("points", "block", {"visible": lambda v: v & False}), "no point is visible"),
    "visible but missing": (("points", "block", {"value": put((6, 2), np.nan)}), "row 6: point 2 is visible but"),
    "points in mm": (("points", "block", {"value": lambda p: 1e3 * p}), "look like millimetres"),
    "grey images": (("image", "wrist", {"rgb": lambda c: c[..., 0]}), "rgb is not right"),
    "float images": (("image", "wrist", {"rgb": lambda c: c / 255}), "rgb is not right"),
    "depth size": (("image", "wrist", {"depth": lambda d: d[:, :-1]}), "depth is not right"),
    "NaN depth": (("image", "wrist", {"depth": put((1, 2, 3), np.nan)}), "row 1: a depth is not a distance"),
    "depth in mm": (("image", "wrist", {"depth": lambda d: 1000 * d}), "look like millimetres"),
    "focal length in metres": (("image", "wrist", {"intrinsics": put((0, 0), 0.004)}), "focal length is not in pixels"),
    "transposed intrinsics": (("image", "wrist", {"intrinsics": lambda k: k.T}), "not a pinhole matrix"),
    "transposed pose": (("image", "wrist", {"pose": put((3, 0), 0.5)}), "not a transform"),
    "mirrored pose": (("image", "wrist", {"pose": put((0, 0), -1)}), "not a rotation and a translation"),
    "scaled pose": (("image", "wrist", {"pose": put((0, 0), 1.1)}), "not a rotation and a translation"),
}


@pytest.mark.parametrize(("edit", "message"), CHANNELS.values(), ids=CHANNELS.keys())
def test_a_broken_channel_is_refused_with_its_place(recording, edit, message):
    kind, name, changes = edit
    with pytest.raises(RecordingError, match=message) as caught:
        validate(edited(recording, kind, name, **changes))
    assert str(caught.value).startswith("<memory>, demo_0, ")
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("kind", "old", "message"),
    [
        (
            "action",
            "elbow",
            r"no such actuator; expected one of \['opening', 'elbow', 'left/grip', 'push'\], found 'shoulder'",
        ),
        ("measured", "elbow_angle", "no such sensor; expected one of .*'grip_width'.*found 'shoulder'"),
        ("points", "block", r"no such body; expected one of \['arm', 'finger', 'block'\], found 'shoulder'"),
    ],
)
def test_names_that_the_scene_lacks_are_refused_with_those_it_has(recording, kind, old, message):
    with pytest.raises(RecordingError, match=message):
        validate(renamed(recording, kind, old, "shoulder"))


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"qpos": np.zeros(7)}, r"initial/qpos: wrong shape of the values; expected \(9,\), found \(7,\)"),
        ({"qvel": np.zeros(9)}, r"initial/qvel: wrong shape of the values; expected \(8,\), found \(9,\)"),
        ({"qvel": np.full(8, np.nan)}, "every value is missing"),
        ({"qpos": np.array([0, 0, 0, 0, 0, 0.5, 0, 0, 0])}, "row 5: the quaternion of joint 'block' is not of unit"),
        ({"qpos": np.array([57, 0, 0, 0, 0, 1, 0, 0, 0])}, "look like degrees"),
        ({"qpos": np.array([0, 0, 400, 0, 20, 1, 0, 0, 0])}, "look like millimetres"),
    ],
)
def test_a_broken_initial_state_is_refused(recording, state, message):
    with pytest.raises(RecordingError, match=message):
        validate(with_initial(recording, **state))


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        ("", "the scene is empty"),
        ("a robot", "the scene is not XML"),
        ("<mujoco><robot/></mujoco>", "MuJoCo cannot read this MJCF"),
        ('<mujoco><include file="arm.xml"/></mujoco>', "its <include> reads a file; found arm.xml"),
        ('<mujoco><asset><mesh file="arm.stl"/></asset></mujoco>', "its <mesh> reads a file"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><mujoco/>', "XML entities"),
        ('<mujoco><option timestep="nan"/></mujoco>', "not finite"),
        ('<mujoco><worldbody><replicate count="99999999"/></worldbody></mujoco>', "too many copies"),
        (
            '<mujoco><worldbody><replicate count="900"><replicate count="900"/></replicate></worldbody></mujoco>',
            "too many copies; expected at most 100000, found 810000",
        ),
    ],
)
def test_a_scene_that_cannot_stand_alone_is_refused(recording, scene, message):
    with pytest.raises(RecordingError, match=message):
        validate(replace(recording, scene=scene))


def test_demonstrations_need_a_name_of_their_own(recording):
    first = recording.demonstrations[0]
    with pytest.raises(RecordingError, match="same name"):
        validate(replace(recording, demonstrations=(first, first)))
    with pytest.raises(RecordingError, match="unusable name"):
        validate(replace(recording, demonstrations=(replace(first, name="pick/0"),)))
    with pytest.raises(RecordingError, match="no demonstration"):
        validate(replace(recording, demonstrations=()))
    with pytest.raises(RecordingError, match="the demonstration is empty"):
        validate(only(recording))


def test_a_clock_since_1970_is_refused(recording):
    time = 1.7e9 + np.arange(50) * 0.01
    with pytest.raises(RecordingError, match="does not begin with the demonstration"):
        validate(only(recording, measured={"elbow_angle": Channel(time, np.zeros((50, 1)))}))


def falling(t, height=0.02):
    return np.stack([0 * t, 0 * t, height - 4.9 * t**2], axis=1)


def with_drag(t):
    """Return a fall from 47 m that reaches 95 % of a final speed of 35 m/s."""
    return np.stack([0 * t, 0 * t, 47 - 35**2 / 9.81 * np.log(np.cosh(9.81 * t / 35))], axis=1)


DROP = np.arange(300) * 0.01
NOISE = 2e-3 * np.random.default_rng(0).normal(size=(300, 3))
FRAMES = np.arange(90) / 30
FALLS = {
    "a ball that falls from 47 m": (DROP, falling(DROP, 47)),
    "with air drag and noise": (DROP, with_drag(DROP) + NOISE),
    "seen by a camera at 30 Hz": (FRAMES, falling(FRAMES, 47) + NOISE[:90]),
    "whose height alone was measured": (DROP, falling(DROP, 47) * [np.nan, np.nan, 1]),
    "with missing components": (DROP, np.where(np.arange(900).reshape(300, 3) % 7, falling(DROP, 47), np.nan)),
    "thrown up 60 m": (DROP * 2.3, np.stack([0 * DROP, 0 * DROP, 2 + 34 * DROP * 2.3 - 4.9 * (DROP * 2.3) ** 2], 1)),
}


@pytest.mark.parametrize(("time", "value"), FALLS.values(), ids=FALLS.keys())
def test_a_fall_from_a_height_is_no_unit_error(recording, time, value):
    start: dict[str, Any] = {"qpos": np.array([0.1, 0.02, 0.0, 0, 47, 1, 0, 0, 0])}
    fall = only(recording, measured={"block_position": Channel(time, value)}, **start)
    assert is_sound(fall)
    for factor in (0.3, 3.0, 1000.0):
        scaled = Channel(time, value * factor)
        beyond = float(np.nanquantile(np.abs(scaled.value[:, 2]), 0.25)) > 30
        if beyond:
            assert not is_sound(only(recording, measured={"block_position": scaled}))
    still = Channel(time, np.tile([0.0, 0, 47], (len(time), 1)))
    assert not is_sound(only(recording, measured={"block_position": still}, **start))


def test_a_recording_of_heights_alone_is_read(recording):
    heights = Channel(DROP, falling(DROP, 3) * [np.nan, np.nan, 1])
    assert is_sound(only(recording, measured={"block_position": heights}))
    in_millimetres = Channel(DROP, np.tile([np.nan, np.nan, 400.0], (300, 1)))
    assert not is_sound(only(recording, measured={"block_position": in_millimetres}))


def test_a_slide_without_limits_is_in_metres():
    rail = """<mujoco><worldbody><body><joint name="rail" type="slide"/><geom size="0.1"/></body></worldbody>
    <sensor><jointpos name="rail" joint="rail"/></sensor></mujoco>"""
    for size, sound in ((0.3, True), (300.0, False)):
        reading = Channel(np.arange(20) * 0.1, np.full((20, 1), -size))
        assert is_sound(Recording(rail, (Demonstration("demo_0", measured={"rail": reading}),))) == sound


SLOW, LONG = np.arange(40) * 2.0, np.arange(800) * 0.1
SOUND = {
    "a block that falls for five seconds": {"block_position": Channel(LONG / 16, falling(LONG / 16))},
    "a state before and one after": {"elbow_angle": Channel(np.array([0.0, 30.0]), np.zeros((2, 1)))},
    "a slow sensor beside a fast one": {
        "elbow_angle": Channel(SLOW, np.zeros((40, 1))),
        "grip_width": Channel(LONG, np.zeros((800, 1))),
    },
    "one sensor after another": {
        "elbow_angle": Channel(np.arange(200) * 0.01, np.zeros((200, 1))),
        "grip_width": Channel(3 + np.arange(200) * 0.01, np.zeros((200, 1))),
    },
    "an encoder that wraps": {"elbow_angle": Channel(np.arange(20) * 0.01, np.linspace(2.9, 2.9 + 6.2, 20)[:, None])},
    "rounded quaternions": {
        "block_orientation": Channel(np.arange(2) * 0.01, np.array([[0.71, 0.71, 0, 0], [np.nan] * 4]))
    },
}


@pytest.mark.parametrize("measured", SOUND.values(), ids=SOUND.keys())
def test_unusual_but_sound_recordings_pass(recording, measured):
    sound = only(recording, measured=measured)
    assert is_sound(sound)
    name, channel = next(iter(measured.items()))
    assert not is_sound(only(recording, measured={**measured, name: replace(channel, time=channel.time[::-1])}))


def test_commands_may_come_seldom_and_end_before_the_measurement(recording):
    action = {"elbow": Channel(np.array([0.0, 0.5]), np.zeros(2)), "push": Channel(np.zeros(1), np.array([-900.0]))}
    measured = {"elbow_angle": Channel(5 + np.arange(100) * 0.01, np.zeros((100, 1)))}
    assert is_sound(only(recording, action=action, measured=measured))
    late = {"elbow": replace(action["elbow"], time=np.array([0.5, 0.0]))}
    assert not is_sound(only(recording, action=late, measured=measured))
