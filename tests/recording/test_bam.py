import json
from pathlib import Path

import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.model import Model
from concent_warp.recording.formats.bam import JOINT, SENSOR, TICK, read_bam
from concent_warp.recording.load import load_recording
from concent_warp.scene.scene import Scene
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine

MEASURED = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "bam_xl330"
SETUP = {"mass": 0.49, "length": 0.1, "kp": 400, "vin": 7.4, "motor": "xl330", "trajectory": "sin_sin"}


def log(**changes: object) -> dict[str, object]:
    times = 5.0 + np.array([0.0035, 0.009, 0.0135, 0.020])
    entries = [
        {"timestamp": float(t), "position": 0.1 * k, "goal_position": 0.2 * k, "load": 65535, "speed": 0.0}
        for k, t in enumerate(times)
    ]
    return {**SETUP, "entries": entries, **changes}


def written(folder: Path, name: str, **changes: object) -> Path:
    path = folder / f"{name}.json"
    path.write_text(json.dumps(log(**changes)))
    return path


def test_a_log_keeps_its_uneven_times_counted_from_its_first_sample(tmp_path):
    demonstration = read_bam(written(tmp_path, "a"))[0]
    time = demonstration.measured[SENSOR].time
    np.testing.assert_allclose(time, [0.0, 0.0055, 0.01, 0.0165], atol=1e-12)
    np.testing.assert_array_equal(demonstration.action["servo"].time, time)
    np.testing.assert_allclose(demonstration.measured[SENSOR].value[:, 0], [0.0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(demonstration.action["servo"].value, [0.0, 0.2, 0.4, 0.6])
    assert demonstration.task == "sin_sin"
    assert demonstration.measured[SENSOR].noise_std == pytest.approx(2 * np.pi / 4096 / np.sqrt(12))
    assert demonstration.qpos is not None
    assert demonstration.qpos[0] == 0.0


def test_the_drive_pushes_in_proportion_to_the_error_in_ticks_up_to_the_full_duty_cycle(tmp_path):
    m = Scene(read_bam(written(tmp_path, "a")).scene).model
    stall = 0.35 * 7.4 / 4.0
    assert m.actuator_gainprm[0, 0] * TICK == pytest.approx(400 / (256 * 885) * stall)
    np.testing.assert_allclose(m.actuator_forcerange[0], [-stall, stall])
    assert m.joint(JOINT).damping[0] == pytest.approx(0.35**2 / 4.0)


def test_the_payload_hangs_at_zero_and_swings_with_the_period_of_a_pendulum(tmp_path):
    scene = Scene(read_bam(written(tmp_path, "a")).scene)
    spec = scene.spec()
    spec.joint(JOINT).damping[0] = 0.0
    spec.actuator("servo").gainprm[0] = spec.actuator("servo").biasprm[1] = 0.0
    engine = MujocoEngine(Model(Scene.from_spec(spec, "free")))
    steps = 2000
    rollout = engine.run(Variants(1, qpos=np.array([[0.02]])), np.zeros((steps, 1)), record=np.arange(steps + 1))
    angle = rollout.qpos[0, :, 0]
    crossings = np.flatnonzero((angle[:-1] > 0) & (angle[1:] <= 0)) * engine.timestep
    assert np.diff(crossings).mean() == pytest.approx(2 * np.pi * np.sqrt(0.1 / 9.81), rel=2e-3)


def test_a_folder_of_two_gains_is_read_one_gain_at_a_time(tmp_path):
    written(tmp_path, "b", kp=100)
    written(tmp_path, "a", kp=400)
    written(tmp_path, "c", kp=400)
    with pytest.raises(RecordingError, match=r"several set-ups.*different kp.*100\.0, 400\.0"):
        read_bam(tmp_path)
    assert [d.name for d in read_bam(tmp_path, kp=400).demonstrations] == ["demo_a", "demo_c"]
    assert [d.name for d in read_bam(tmp_path, kp=100).demonstrations] == ["demo_b"]
    with pytest.raises(RecordingError, match="no log at kp 200"):
        read_bam(tmp_path, kp=200)


def test_logs_are_recognised_by_their_suffix_and_in_a_folder(tmp_path):
    path = written(tmp_path, "a")
    assert load_recording(path)[0].name == load_recording(tmp_path)[0].name == "demo_a"


def test_logs_of_different_payloads_are_refused_together(tmp_path):
    written(tmp_path, "a")
    written(tmp_path, "b", mass=0.6)
    with pytest.raises(RecordingError, match="different mass"):
        read_bam(tmp_path)


def test_a_log_ends_where_the_motor_is_let_go(tmp_path):
    entries = [{"timestamp": 0.1 * k, "position": 0.0, "goal_position": 1.0, "torque_enable": k < 3} for k in range(6)]
    demonstration = read_bam(written(tmp_path, "a", entries=entries))[0]
    assert len(demonstration.measured[SENSOR].time) == len(demonstration.action["servo"].time) == 3
    for entry in entries:
        entry["torque_enable"] = False
    with pytest.raises(RecordingError, match="off from the start"):
        read_bam(written(tmp_path, "b", entries=entries))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kp": None}, "kp of the set-up"),
        ({"mass": -1.0}, "mass of the set-up"),
        ({"entries": []}, "at least 2 entries"),
        ({"entries": 3}, "list of at least 2 entries"),
        ({"entries": [{"timestamp": 0.0}, {"timestamp": 0.1}]}, "position is not a number"),
        ({"entries": [{"timestamp": 0.1 * k, "position": "1", "goal_position": 0.0} for k in range(3)]}, "entry 0"),
        (
            {"entries": [{"timestamp": -0.1 * k, "position": 0.0, "goal_position": 0.0} for k in range(3)]},
            "time",
        ),
    ],
)
def test_what_is_no_log_is_refused_with_a_sentence(tmp_path, changes, message):
    with pytest.raises(RecordingError, match=message):
        read_bam(written(tmp_path, "a", **changes))


def test_a_file_that_is_no_json_and_a_path_that_is_not_there_are_refused(tmp_path):
    (tmp_path / "a.json").write_text("{")
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(RecordingError, match="not a JSON file"):
        read_bam(tmp_path / "a.json")
    with pytest.raises(RecordingError, match="no such log"):
        read_bam(tmp_path / "b.json")
    with pytest.raises(RecordingError, match="no logs"):
        read_bam(empty)


@pytest.mark.skipif(not MEASURED.is_dir(), reason="measured logs of the servo are not here")
@pytest.mark.parametrize("kp", [100, 400])
def test_measured_logs_are_read_at_each_gain(kp):
    recording = read_bam(MEASURED, kp=kp)
    assert len(recording.demonstrations) == 4
    for demonstration in recording.demonstrations:
        channel = demonstration.measured[SENSOR]
        lasts = 2.0 if demonstration.task == "lift_and_drop" else 6.0
        assert channel.time[-1] == pytest.approx(lasts, abs=0.02)
        assert 0.003 < np.median(np.diff(channel.time)) < 0.007


@pytest.mark.parametrize(("key", "value"), [("mass", 1e300), ("length", 1e3), ("kp", 1e7), ("vin", 1e4)])
def test_a_set_up_beyond_what_a_servo_moves_is_refused(tmp_path, key, value):
    entries = [{"timestamp": t / 100, "position": 0.0, "goal_position": 0.0} for t in range(9)]
    log = {"mass": 0.1, "length": 0.1, "kp": 32, "vin": 7.5, "entries": entries}
    path = tmp_path / "log.json"
    path.write_text(json.dumps(log))
    assert len(read_bam(path).demonstrations) == 1
    path.write_text(json.dumps({**log, key: value}))
    with pytest.raises(RecordingError, match=f"{key} of the set-up is not right; expected above 0 and at most"):
        read_bam(path)
