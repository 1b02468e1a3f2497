"""Maps: what they say, what is proposed, and what is made of numbers."""

from __future__ import annotations

import numpy as np
import pytest
from made_logs import SCENE, messages, motion, write_bag, write_images, write_lerobot

import concent_warp as cw
from concent_warp.recording.logs.cfg import PlausibilityCfg
from concent_warp.recording.logs.log_map import LogMap, NumberEntry, read_map
from concent_warp.recording.logs.numbers import converted
from concent_warp.recording.logs.readers.log import Episode, Signal
from concent_warp.recording.logs.suggest import suggest_map
from concent_warp.recording.logs.targets import targets_of


def value_of(target: str, *raw: float, **entry) -> list[float]:
    """Return what becomes of numbers of a log [SI]."""
    actuators, sensors = targets_of(cw.Scene(SCENE).model)
    known = actuators | sensors
    signals = {"x": Signal("x", np.arange(len(raw)) * 0.1, np.array(raw))}
    made = converted(NumberEntry(("x",), **entry), known[target], Episode(0, signals, {}), LogMap(), PlausibilityCfg())
    return made.value[:, 0].tolist()


def test_units_signs_scales_and_offsets():
    assert value_of("elbow_position", 90, unit="deg") == pytest.approx([np.pi / 2])
    assert value_of("elbow_position", 90, unit="deg", sign=-1.0, offset=0.5) == pytest.approx([0.5 - np.pi / 2])
    assert value_of("elbow", 1024, scale=2 * np.pi / 4096) == pytest.approx([np.pi / 2])
    assert value_of("grip_position", 12, unit="mm") == pytest.approx([0.012])
    assert value_of("elbow_velocity", 60, unit="rpm") == pytest.approx([2 * np.pi])


def test_shares_are_of_the_range_of_the_joint():
    assert value_of("grip_position", 0, 25, 100, unit="percent") == pytest.approx([0, 0.01, 0.04])
    assert value_of("grip_position", 0, 25, 100, unit="percent", sign=-1.0) == pytest.approx([0.04, 0.03, 0])
    assert value_of("grip", -100, 0, 100, unit="signed_percent") == pytest.approx([0, 0.02, 0.04])
    assert value_of("elbow", 0, 0.5, 1, unit="share") == pytest.approx(np.deg2rad([-170, 0, 170]))
    with pytest.raises(cw.RecordingError, match=r"percent of 'elbow_velocity', which has no range"):
        value_of("elbow_velocity", 1, unit="percent")


def test_clocks_go_by_name_then_by_pattern_then_by_what_is_above(tmp_path):
    (tmp_path / "m.toml").write_text(
        """
        [clock]
        "/camera/*" = 0.5
        "/camera/depth" = { unit = "ms" }
        "/joint_states" = { use = "received" }
        [action]
        elbow = "x"
        """
    )
    found = read_map(tmp_path / "m.toml")
    assert found.clock_of("/camera/color").offset == 0.5
    assert (found.clock_of("/camera/depth").offset, found.clock_of("/camera/depth").unit) == (0, "ms")
    assert found.clock_of("/joint_states/position/elbow").use == "received"
    assert found.clock_of("/joint_states2").use == "stamp"
    assert found.action["elbow"].source == ("x",)


def test_stamps_in_milliseconds_since_1970_are_found_and_converted():
    signals = {"x": Signal("x", 1.764e12 + np.arange(50) * 20.0, np.zeros(50))}
    target = targets_of(cw.Scene(SCENE).model)[1]["elbow_position"]

    def time(clock):
        entry = NumberEntry(("x",))
        return converted(entry, target, Episode(0, signals, {}), LogMap(clock=clock), PlausibilityCfg()).time

    with pytest.raises(cw.RecordingError, match=r'stamps look like ms.*write \[clock\] "x" = \{ unit = "ms" \}'):
        time({})
    from concent_warp.recording.logs.log_map import ClockEntry

    np.testing.assert_allclose(np.diff(time({"x": ClockEntry(unit="ms", offset=-1.764e9)})), 0.02, atol=1e-6)


def test_quaternions_are_put_in_order_by_their_names():
    names = ["q/x", "q/y", "q/z", "q/w"]
    raw = [0.1, 0.2, 0.3, np.sqrt(1 - 0.14)]
    signals = {n: Signal(n, np.zeros(1), np.array([v])) for n, v in zip(names, raw, strict=True)}
    target = targets_of(cw.Scene(SCENE).model)[1]["block_orientation"]
    made = converted(NumberEntry(("q",)), target, Episode(0, signals, {}), LogMap(), PlausibilityCfg())
    assert made.value[0].tolist() == [raw[3], *raw[:3]]
    numbered = {str(k): Signal(str(k), np.zeros(1), np.array([v])) for k, v in enumerate(raw)}
    entry = NumberEntry(("0", "1", "2", "3"), order="xyzw")
    made = converted(entry, target, Episode(0, numbered, {}), LogMap(), PlausibilityCfg())
    assert made.value[0].tolist() == [raw[3], *raw[:3]]


def test_a_transform_moves_a_body_from_the_frame_of_the_log(tmp_path):
    bag = write_bag(tmp_path / "bag", messages(motion()), "mcap")
    (tmp_path / "robot.xml").write_text(SCENE)
    (tmp_path / "robot.toml").write_text(
        """
        [action]
        elbow = "/arm/commands/data/0"
        grip = "/arm/commands/data/1"
        [body.block]
        source = "/block/pose"
        transform = [[0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        position_noise_std = 0.001
        """
    )
    found = cw.import_log(bag, tmp_path / "robot.xml", mapping=tmp_path / "robot.toml")[0].measured
    block = motion().block
    np.testing.assert_allclose(
        found["block_position"].value, np.stack([1 - block[:, 1], block[:, 0], block[:, 2]], axis=1), atol=1e-12
    )
    np.testing.assert_allclose(found["block_orientation"].value[0], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-12)
    assert found["block_position"].noise_std == 0.001


def suggested(place, source) -> str:
    (place / "robot.xml").write_text(SCENE)
    text = suggest_map(place / source, place / "robot.xml")
    (place / "robot.toml").write_text(text)
    return text


def test_the_map_proposed_for_a_bag_reads_it(tmp_path):
    write_bag(tmp_path / "bag", messages(motion()), "mcap")
    text = suggested(tmp_path, "bag")
    assert "[action.elbow]  # guess: by order" in text
    assert "[body.block]\n" in text
    text = text.replace('# reference = "world"', 'reference = "world"')
    (tmp_path / "robot.toml").write_text(text)
    found = cw.import_log(tmp_path / "bag", tmp_path / "robot.xml", mapping=tmp_path / "robot.toml")[0]
    assert set(found.action) == {"elbow", "grip"}
    assert set(found.measured) == {
        "elbow_position", "elbow_velocity", "grip_position", "block_position", "block_orientation"
    }  # fmt: skip
    np.testing.assert_array_equal(found.measured["elbow_position"].value[:, 0], motion().elbow)


def test_the_map_proposed_for_a_data_set_has_units(tmp_path):
    write_lerobot(tmp_path / "data", 1)
    text = suggested(tmp_path, "data")
    assert "[measured.elbow_position]  # guess: values from -" in text
    assert 'source = "observation.state/elbow.pos"\nunit = "deg"' in text
    assert 'source = "action/grip.pos"\nunit = "percent"' in text
    assert "[image.front]" in text
    assert read_map(tmp_path / "robot.toml").action["elbow"].unit == "deg"


def test_the_map_proposed_for_a_folder_names_what_has_no_channel(tmp_path):
    write_images(tmp_path / "log", motion())
    (tmp_path / "log" / "command.csv").unlink()
    text = suggested(tmp_path, "log")
    assert "# [action.elbow]  # no channel found" in text
    assert 'color = "color"\ndepth = "depth"' in text


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "the map is empty"),
        ("[actions.elbow]\nsource = 'x'", "unknown entries in the map"),
        ("[action]\nelbow = 3", "not an entry of the map; expected a table"),
        ("[action.elbow]\nsource = 3", "source is not right; expected a name or a list of names"),
        ("[action.elbow]\nsource = 'x'\nsign = 2", "sign is not right; expected 1 or -1, found 2"),
        ("[action.elbow]\nsource = 'x'\nscale = 0", "scale is not right"),
        ("[clock.x]\nunit = 'min'", "unknown unit; expected one of s, ms, us, ns"),
        ("[image.x]\ncolor = 'x'\npose = [[1, 0], [0, 1]]", "pose is not right; expected numbers of shape (4, 4)"),
        ("[body.x]\nsource = 'x'\nunit = 'deg'", "unknown unit; expected one of m, cm, mm"),
        ("calibration = 3\n[action]\nelbow = 'x'", "calibration is not the name of a file"),
    ],
)
def test_maps_that_make_no_sense_are_refused(tmp_path, text, sentence):
    (tmp_path / "m.toml").write_text(text)
    with pytest.raises(cw.RecordingError) as caught:
        read_map(tmp_path / "m.toml")
    assert sentence in str(caught.value)


@pytest.mark.parametrize(("arm", "quantity"), [("-0.010", "any"), ("0.5", "angle"), ("1", "angle")])
def test_the_length_of_a_fixed_tendon_with_moment_arms_may_be_in_metres(arm, quantity):
    scene = f"""<mujoco><worldbody><body><joint name="knuckle" type="hinge"/><geom size=".1"/></body></worldbody>
    <tendon><fixed name="flexor"><joint joint="knuckle" coef="{arm}"/></fixed></tendon>
    <sensor><tendonpos name="excursion" tendon="flexor"/><jointpos name="turn" joint="knuckle"/></sensor></mujoco>"""
    sensors = targets_of(cw.Scene(scene).model)[1]
    assert (sensors["excursion"].quantity, sensors["turn"].quantity) == (quantity, "angle")
