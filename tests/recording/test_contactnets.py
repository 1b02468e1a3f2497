import pickle
from pathlib import Path

import mujoco
import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.recording.formats.contactnets import EDGE, INERTIA, MASS, PERIOD, _toss_scene, read_contactnets

TOSSES = Path(__file__).parents[3] / "shared" / "data" / "contactnets_cube"
torch = pytest.importorskip("torch")


@pytest.fixture
def model():
    return mujoco.MjModel.from_xml_string(_toss_scene())


def fly(model, qpos, qvel, time):
    """Return the sensors of a flight at given times, shape (T, 13)."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    clock, sensors = [], []
    while not clock or clock[-1] < time[-1]:
        mujoco.mj_forward(model, data)
        assert data.ncon == 0
        clock.append(data.time)
        sensors.append(data.sensordata.copy())
        mujoco.mj_step(model, data)
    return np.stack([np.interp(time, clock, column) for column in np.array(sensors).T], axis=1)


def measured_toss(model, rows=12) -> np.ndarray:
    """Return a flight as ContactNets would record it: poses, and velocities as backward differences."""
    time = PERIOD * np.arange(rows)
    sensors = fly(model, [0.1, -0.2, 0.4, 0.8, 0.6, 0, 0], [1, 0.5, 0.3, 6, -3, 2], time)
    position, quaternion = sensors[:, :3], sensors[:, 3:7]
    toss = np.zeros((rows, 13))
    toss[:, :4], toss[:, 4:7] = quaternion, position
    toss[1:, 10:] = np.diff(position, axis=0) / PERIOD
    for k in range(1, rows):
        mujoco.mju_subQuat(toss[k, 7:10], quaternion[k], quaternion[k - 1])
        toss[k, 7:10] /= PERIOD
    toss[0, 7:] = 2 * toss[1, 7:] - toss[2, 7:]
    return toss


def test_the_scene_is_the_published_cube(model):
    cube = model.body("cube")
    assert cube.mass == MASS
    np.testing.assert_allclose(cube.inertia, INERTIA)
    np.testing.assert_allclose(2 * model.geom("cube").size, EDGE)
    assert model.geom("cube").friction[0] == model.geom("board").friction[0] == 0.15
    assert model.opt.timestep <= 0.002


def test_the_angular_velocity_is_read_in_the_body_frame(model):
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[3:] = [0, 0, 1, 0.6, 0, 0.8, 0], [1, 2, 3]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.sensor("cube_angular_velocity").data, [1, 2, 3], atol=1e-12)


def test_a_simulated_toss_comes_back_from_its_file(tmp_path, model):
    torch.save(torch.from_numpy(measured_toss(model)), tmp_path / "7.pt")
    recording = read_contactnets(tmp_path / "7.pt")
    (toss,) = recording.demonstrations
    assert toss.name == "demo_7"
    assert toss.qvel is not None
    np.testing.assert_allclose(toss.qvel, [1, 0.5, 0.3, 6, -3, 2], atol=6e-3)
    for name, columns in {"position": slice(0, 3), "velocity": slice(7, 10), "angular_velocity": slice(10, 13)}.items():
        channel = toss.measured[f"cube_{name}"]
        predicted = fly(model, toss.qpos, toss.qvel, channel.time)[:, columns]
        np.testing.assert_allclose(channel.value, predicted, atol=6e-3)


def test_a_folder_is_read_in_the_order_of_its_numbers(tmp_path, model):
    for number in (10, 2, 33):
        torch.save(torch.from_numpy(measured_toss(model)).float(), tmp_path / f"{number}.pt")
    assert [d.name for d in read_contactnets(tmp_path).demonstrations] == ["demo_2", "demo_10", "demo_33"]
    assert [d.name for d in read_contactnets(tmp_path, limit=2).demonstrations] == ["demo_2", "demo_10"]
    assert read_contactnets(tmp_path, period=0.01)[0].duration == pytest.approx(0.11)
    assert 'pos="0 0 -0.0012"' in read_contactnets(tmp_path, board_height=-0.0012).scene


class Code:
    def __reduce__(self):
        return Path.touch, (Path("executed"),)


@pytest.mark.parametrize("write", [torch.save, lambda thing, path: path.write_bytes(pickle.dumps(thing))])
def test_a_pickle_is_refused_and_not_run(tmp_path, monkeypatch, write):
    monkeypatch.chdir(tmp_path)
    write({"toss": Code()}, tmp_path / "0.pt")
    with pytest.raises(RecordingError, match="is not a plain tensor and is not run"):
        read_contactnets(tmp_path / "0.pt")
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (lambda: torch.zeros(50, 12), r"expected \(T, 13\) floats, found \(50, 12\)"),
        (lambda: torch.zeros(50, 13, dtype=torch.int32), "wrong shape of a toss"),
        (lambda: torch.zeros(50, 13, dtype=torch.complex64), "wrong shape of a toss"),
        (lambda: torch.zeros(50, 13).to_sparse(), "wrong shape of a toss"),
        (lambda: torch.zeros(1, 13).expand(10**11, 13), r"found \(100000000000, 13\)"),
        (lambda: {"a": torch.zeros(50, 13)}, "expected one tensor, found dict"),
        (lambda: torch.zeros(50, 13), "quaternion of joint 'cube' is not of unit length"),
        (lambda: torch.full((50, 13), torch.nan), "every value is missing"),
    ],
)
def test_a_file_that_is_no_toss_is_refused(tmp_path, content, message):
    torch.save(content(), tmp_path / "0.pt")
    with pytest.raises(RecordingError, match=message):
        read_contactnets(tmp_path / "0.pt")


def test_damaged_tosses_give_an_error_that_says_so(tmp_path, model):
    path = tmp_path / "0.pt"
    torch.save(torch.from_numpy(measured_toss(model)), path)
    sound = path.read_bytes()
    for length in range(0, len(sound) - 30, 97):
        path.write_bytes(sound[:length])
        with pytest.raises(RecordingError):
            read_contactnets(path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"limit": 0}, "the limit leaves no toss"), ({"period": 0.0}, "not a time"), ({}, "no tosses in the folder")],
)
def test_arguments_that_leave_nothing_are_refused(tmp_path, arguments, message):
    with pytest.raises(RecordingError, match=message):
        read_contactnets(tmp_path, **arguments)


@pytest.mark.skipif(not TOSSES.is_dir(), reason="the measured tosses are not on this machine")
def test_measured_flights_agree_with_their_simulation(model):
    """50 ms of free flight from the initial state: 3 mm, 3 degrees, and velocities without bias."""
    bias = []
    for toss in read_contactnets(TOSSES, limit=40).demonstrations:
        position, orientation = toss.measured["cube_position"], toss.measured["cube_orientation"]
        rows = position.time <= 0.05
        if position.value[rows, 2].min() < EDGE:
            continue
        predicted = fly(model, toss.qpos, toss.qvel, position.time[rows])
        assert np.linalg.norm(predicted[:, :3] - position.value[rows], axis=1).max() < 3e-3
        cosine = np.abs((predicted[:, 3:7] * orientation.value[rows]).sum(axis=1))
        assert np.degrees(2 * np.arccos(np.minimum(cosine, 1))).max() < 3
        velocity = toss.measured["cube_velocity"]
        rows = velocity.time <= 0.05
        error = fly(model, toss.qpos, toss.qvel, velocity.time[rows])[:, 7:10] - velocity.value[rows]
        bias.append(error.mean(axis=0))
    assert len(bias) >= 30
    assert np.abs(np.mean(bias, axis=0)).max() < 0.01  # half a step of gravity, 0.033 m/s, would show
