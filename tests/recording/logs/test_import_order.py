"""Samples a few periods out of order are sorted; a clock that runs back by more is refused where it does."""

import warnings

import numpy as np
import pytest
from made_logs import ROS_MAP, SCENE, messages, motion, write_bag

from concent_warp.cli import main
from concent_warp.errors import RecordingError
from concent_warp.recording.load import load_recording
from concent_warp.recording.logs.import_log import import_log, inspect_log

ARM = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/><geom size="0.1" mass="1"/></body></worldbody>
<actuator><position name="hinge" joint="hinge" kp="5"/></actuator>
<sensor><jointpos name="angle" joint="hinge"/></sensor></mujoco>"""
MAP = '[action]\nhinge = "cmd"\n[measured]\nangle = "q"\n'
START = 1764000000.0
TIME = np.arange(0, 2, 0.01)


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "map.toml").write_text(MAP)
    return tmp_path


def written(place, time, blank=0):
    """Write a table with stamps [s] and a number of blank lines before its 21st row; return its name."""
    rows = [f"{START + t:.4f},{0.3 * np.sin(t):.5f},{0.3 * np.sin(t):.5f}" for t in time]
    (place / "log.csv").write_text("\n".join(["t,q,cmd", *rows[:20], *[""] * blank, *rows[20:]]) + "\n")
    return ["import", "log.csv", "--model", "arm.xml", "--map", "map.toml"]


@pytest.mark.parametrize(
    ("time", "step"),
    [
        (np.where(TIME > 0.995, TIME - 0.5, TIME), 0.49),
        (np.where(TIME > 0.995, TIME - 0.0413, TIME), 0.0313),
        (np.where(TIME > 0.995, TIME - 0.9987, TIME), 0.9887),
    ],
    ids=["set back", "set back a little", "started anew"],
)
def test_a_clock_that_runs_back_is_refused_at_its_line(place, capsys, time, step):
    command = written(place, time, blank=2)
    sentence = (
        f"concent import: log.csv, line 104: time runs back by {step:g} s; expected stamps that increase, but for"
    )
    assert main([*command, "--dry-run"]) == 2
    said = capsys.readouterr().err
    assert sentence in said
    assert "found 17640000" in said
    assert "cut the log there into two, or sort its rows" in said
    assert "things are wrong" not in said
    assert main([*command, "-o", "demo.h5"]) == 2
    assert sentence in capsys.readouterr().err
    assert not (place / "demo.h5").exists()


def test_samples_a_little_out_of_order_are_sorted_with_a_remark(place):
    order = np.arange(len(TIME))
    order[[50, 51]] = order[[51, 50]]
    order[[80, 82]] = order[[82, 80]]
    command = written(place, TIME[order])
    (episode,) = inspect_log("log.csv", "arm.xml", mapping="map.toml")
    assert [one.remark for one in episode.channels] == ["3 misplaced stamps sorted"] * 2
    with pytest.warns(match="demo_0: samples out of order were sorted by their stamps: 3 of action/hinge"):
        assert main([*command, "-o", "demo.h5"]) == 0
    channel = load_recording("demo.h5")[0].measured["angle"]
    np.testing.assert_allclose(channel.time, TIME, atol=1e-6)
    assert channel.value[51, 0] == pytest.approx(0.3 * np.sin(TIME[51]), abs=1e-4)


def test_a_table_in_order_is_imported_without_a_remark(place):
    written(place, TIME)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        import_log("log.csv", "arm.xml", mapping="map.toml")


def test_channels_one_below_the_other_are_each_in_order(place):
    rows = [f"{t:.4f},{0.3 * np.sin(t):.5f}," for t in TIME] + [f"{t:.4f},,{0.3 * np.sin(t):.5f}" for t in TIME]
    (place / "log.csv").write_text("\n".join(["t,q,cmd", *rows]))
    d = import_log("log.csv", "arm.xml", mapping="map.toml")[0]
    np.testing.assert_allclose(d.measured["angle"].time, TIME, atol=1e-6)
    np.testing.assert_allclose(d.action["hinge"].time, TIME, atol=1e-6)


def test_a_topic_whose_stamps_run_back_is_told_to_take_times_of_reception(tmp_path):
    def back(message):
        topic, kind, time, fields = message
        if topic == "/joint_states" and "header" in fields and fields["header"][0] > messages(motion())[0][2] + 1.5:
            fields = fields | {"header": (fields["header"][0] - 1, "")}
        return topic, kind, time, fields

    write_bag(tmp_path / "bag", [back(message) for message in messages(motion())], "mcap")
    (tmp_path / "robot.xml").write_text(SCENE)
    (tmp_path / "robot.toml").write_text(ROS_MAP)
    with pytest.raises(RecordingError, match=r"/joint_states/\S+, sample \d+: time runs back by 0\.9\d+ s") as caught:
        import_log(tmp_path / "bag", tmp_path / "robot.xml", mapping=tmp_path / "robot.toml")
    assert 'or take the times of reception: [clock] "/joint_states/' in str(caught.value)
