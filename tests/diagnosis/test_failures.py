import time
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from concent_warp.diagnosis import failures as module
from concent_warp.diagnosis.cfg import FailureCfg, SearchCfg
from concent_warp.diagnosis.failures import (
    _force_entries,
    _span_entry,
    _unexplained_forces,
    _with_starts,
    locate_failures,
)
from concent_warp.diagnosis.forces.locate import locate_forces
from concent_warp.errors import RecordingError
from concent_warp.fit.effects.observe import observe
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene
from tests.scenes.swinging import drawing, swung, windows_of

XML = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody><body name="cart">
    <joint name="rail" type="slide" axis="1 0 0" damping="{damping}"/><geom size=".1" mass="1"/>
  </body></worldbody>
  <actuator><position name="drive" joint="rail" kp="40" dampratio="0.5"/></actuator>
  <sensor><jointpos name="rail_position" joint="rail"/></sensor>
</mujoco>
"""
TIME = np.arange(0, 2, 0.01)
NOISE = 1e-4
NO_FORCES = FailureCfg(max_seconds=0.0)


def recorded(damping: float, start: float = 0.0) -> Recording:
    """What a cart with some damping does on a square wave."""
    m = mujoco.MjModel.from_xml_string(XML.format(damping=damping))
    d = mujoco.MjData(m)
    d.qpos[0] = start
    command = 0.1 * np.sign(np.sin(2 * np.pi * TIME))
    position = np.zeros(len(TIME))
    for i in range(len(TIME)):
        d.ctrl[0], position[i] = command[i], d.qpos[0]
        mujoco.mj_step(m, d, nstep=2)
    read = position + np.random.default_rng(0).normal(0, NOISE, len(TIME))
    channels = {"rail_position": Channel(TIME, read[:, None], noise_std=NOISE)}
    demonstration = Demonstration(
        "swing", qpos=np.zeros(1), qvel=np.zeros(1), action={"drive": Channel(TIME, command)}, measured=channels
    )
    return Recording(XML.format(damping=0.5), (demonstration,))


def model() -> Model:
    return Model(Scene(XML.format(damping=0.5)))


def test_spans_of_a_wrong_model_name_channel_time_and_size():
    found = locate_failures(model(), recorded(3.0), NO_FORCES)
    assert 1 <= len(found) <= 5
    worst = found[0]
    assert (worst["channel"], worst["body"]) == ("rail_position", "cart")
    assert 0 <= worst["start"] < worst["end"] <= 2
    assert worst["ratio"] > 20
    assert "x noise" in worst["sentence"]


def test_right_model_has_no_span():
    assert locate_failures(model(), recorded(0.5), NO_FORCES) == []


def test_missing_force_is_named_after_the_spans(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "_unexplained_forces", lambda *args: locate_forces(*args[:2], engine=args[2]))
    found = locate_failures(model(), recorded(3.0))
    assert found[0]["start"] is not None
    assert found[-1]["channel"] == "rail"
    assert found[-1]["start"] is None
    assert "opposes" in found[-1]["sentence"]


def test_search_for_forces_ends_at_its_time_limit():
    before = time.monotonic()
    assert _unexplained_forces(model(), recorded(3.0), "mujoco", FailureCfg(max_seconds=0.01)) is None
    assert time.monotonic() - before < 5


def test_recording_that_cannot_be_compared_has_no_spans(monkeypatch: pytest.MonkeyPatch):
    def refuse(*_, **__):
        raise RecordingError("nothing was measured")

    monkeypatch.setattr(module, "compare_replays", refuse)
    assert locate_failures(model(), recorded(3.0), NO_FORCES) == []


def test_replay_starts_where_the_window_was_fitted_to_start():
    started_off = recorded(0.5, start=0.004)
    windows = observe(model(), started_off)
    offset = np.array([0.004, 0.0]) / windows[0].spread
    moved = _with_starts(model(), started_off, windows, [offset] * len(windows))
    np.testing.assert_allclose(np.asarray(moved.demonstrations[0].qpos, dtype=float), [0.004])
    assert locate_failures(model(), started_off, NO_FORCES) != []
    assert locate_failures(model(), started_off, NO_FORCES, windows=windows, offsets=[offset] * len(windows)) == []


def test_failures_name_spans_and_significant_forces_by_size():
    span: Any = SimpleNamespace(
        demonstration="d", channels=("angle", "rate"), phase="all", start=0.1, end=0.2, body="arm", direction="",
        ratio=3.0, sentence=lambda demonstration: f"said {demonstration}",
    )  # fmt: skip
    assert _span_entry(span, True) == {
        "demonstration": "d", "channel": "angle", "phase": "all", "start": 0.1, "end": 0.2, "body": "arm",
        "direction": None, "ratio": 3.0, "sentence": "said True",
    }  # fmt: skip
    from tests.diagnosis.forces.test_describe import body, joint, phase

    forces: Any = SimpleNamespace(
        joints=[joint(ratio=2.0), joint(joint="other", ratio=9.0, significant=False)],
        bodies=[body(phase(), phase(phase="free", significant=False), ratio=5.0), body(phase(), ratio=1.0)],
    )
    found = _force_entries(forces)
    assert [(f["channel"], f["body"], f["phase"], f["ratio"]) for f in found] == [
        (None, "block", "slide", 5.0), ("hinge", None, None, 2.0), (None, "block", "slide", 1.0),
    ]  # fmt: skip
    assert found[1]["sentence"].startswith("hinge: ")
    assert found[0]["sentence"].startswith("block, slide")
    assert all(f["start"] is None and f["end"] is None and f["demonstration"] is None for f in found)


def test_replays_start_where_the_first_window_of_a_demonstration_was_fitted_to():
    recording = swung(seconds=0.5)
    windows = windows_of(recording, length=0.25)
    (d,) = recording.demonstrations
    assert len(windows) > 1
    offsets = [np.array([0.5, -2.0]) + k for k in range(len(windows))]
    (moved,) = _with_starts(drawing(recording), recording, windows, offsets).demonstrations
    first = windows[0]
    np.testing.assert_allclose(np.asarray(moved.qpos), first.qpos + 0.5 * first.spread[0])
    np.testing.assert_allclose(np.asarray(moved.qvel), first.qvel - 2.0 * first.spread[1])
    (same,) = _with_starts(drawing(recording), recording, windows[1:], offsets[1:]).demonstrations
    assert same.qpos is d.qpos
    assert same.qvel is d.qvel
    assert SearchCfg().max_rounds == 3
