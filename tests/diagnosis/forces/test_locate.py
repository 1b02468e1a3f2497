import json

import numpy as np
import pytest

from concent_warp.diagnosis.forces import features
from concent_warp.diagnosis.forces.cfg import LocateForcesCfg
from concent_warp.diagnosis.forces.locate import locate_forces
from concent_warp.errors import RecordingError
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene
from tests.diagnosis.forces.locate_scenes import PENDULUM, swing, throw

QUICK = LocateForcesCfg(extra_starts=2)
FORCE, POINT = np.array([0.0, -0.5, 0.2]), np.array([0.02, 0.03, -0.01])


def located(recording, cfg=QUICK):
    return locate_forces(Model(Scene(recording.scene)), recording, cfg)


def of(body, name):
    return next(phase for phase in body.phases if phase.phase == name)


def angle_between(a, b):
    return np.degrees(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)))


@pytest.fixture(scope="module")
def rubbing():
    """A pendulum with Coulomb friction of 0.01 N m."""
    return located(swing(lambda d: -0.01 * np.tanh(d.qvel[0] / 1e-2)))


@pytest.fixture(scope="module")
def pushed_in_flight():
    return located(throw(FORCE, POINT, fly=True, count=3))


def test_friction_of_a_joint_opposes_motion_whatever_its_speed(rubbing):
    joint = rubbing.joints[0]
    assert joint.significant
    pattern = joint.dependences.patterns[0]
    assert pattern.feature == features.DIRECTION
    assert pattern.slope == pytest.approx(-0.01, abs=max(3 * pattern.slope_std, 3e-4))
    assert pattern.share > 0.9
    assert features.SPEED not in pattern.alternatives
    assert "opposes motion, whatever its speed" in rubbing.sentences()[0]


def test_force_of_a_joint_is_the_friction_at_each_time(rubbing):
    series = rubbing.joints[0].series[0]
    steady = np.abs(np.abs(series.force) - 0.01) < 3 * series.std
    assert steady.mean() > 0.6
    assert rubbing.joints[0].rms > 5 * rubbing.joints[0].noise


@pytest.mark.parametrize(
    ("torque", "feature", "slope"),
    [
        (lambda d: -0.005 * d.qvel[0], features.SPEED, -0.005),
        (lambda _: 0.008, features.CONSTANT, 0.008),
        (lambda d: -0.1 * d.qfrc_actuator[0], features.DRIVE, -0.1),
    ],
    ids=["viscous", "constant", "weaker drive"],
)
def test_what_a_force_depends_on_is_reported_with_its_size(torque, feature, slope):
    pattern = located(swing(torque, rate=True)).joints[0].dependences.patterns[0]
    assert pattern.feature == feature
    assert pattern.slope == pytest.approx(slope, rel=0.1)


def test_without_anything_hidden_false_alarms_of_a_joint_are_rare():
    found = [located(swing(lambda _: 0.0, seed=seed, duration=2.5)).joints[0] for seed in range(12)]
    assert sum(joint.p <= 0.05 for joint in found) <= 3
    assert sum(joint.significant for joint in found) <= 1
    assert np.mean([joint.ratio for joint in found]) == pytest.approx(1, abs=0.1)


def test_force_on_a_flying_block_is_found_at_its_point(pushed_in_flight):
    phase = of(pushed_in_flight.bodies[0], "free")
    assert phase.significant
    assert phase.frame == "block"
    assert angle_between(phase.vector, FORCE) < 3
    assert phase.size == pytest.approx(np.linalg.norm(FORCE), abs=3 * phase.size_std)
    assert phase.place.point == pytest.approx(POINT, abs=3e-3)
    assert phase.place.face == "+y face"
    assert phase.place.hidden == ()


def test_arrows_are_in_the_frame_of_the_body(pushed_in_flight):
    arrow = pushed_in_flight.arrows()[0]
    assert arrow["body"] == "block"
    assert arrow["point"] == pytest.approx(POINT, abs=3e-3)
    assert angle_between(np.array(arrow["vector"]), FORCE) < 3


def test_push_on_a_sliding_block_is_found_on_its_face_and_its_height_is_not_reported():
    phase = of(located(throw((-0.4, 0, 0), (0.045, 0.012, 0.0), speed=1.2), LocateForcesCfg()).bodies[0], "slide")
    assert phase.significant
    assert phase.frame == "block"
    assert angle_between(phase.vector, np.array([-1.0, 0, 0])) < 8
    assert phase.place.face.startswith("+x face")
    assert phase.place.point[:2] == pytest.approx([0.045, 0.012], abs=5e-3)
    assert phase.place.hidden == ("z",)
    assert phase.place.against is None


def test_friction_of_a_sliding_block_is_at_its_contact_and_against_the_sliding():
    body = located(throw(friction=0.4, speed=1.2), LocateForcesCfg()).bodies[0]
    phase = of(body, "slide")
    assert phase.significant
    assert phase.frame == "sliding"
    assert phase.vector[0] == pytest.approx(-0.1 * 0.25 * 9.81, abs=0.06)
    assert phase.place.against == "world"
    assert phase.place.face == "-z face"


def test_force_on_all_of_a_body_passes_through_its_centre():
    phase = of(located(throw((0.1, -0.3, 0), fly=True, world=True, count=3)).bodies[0], "free")
    assert phase.frame == "world"
    assert angle_between(phase.vector, np.array([0.1, -0.3, 0])) < 4
    assert phase.place.through_center


def test_without_anything_hidden_a_block_shows_no_force():
    found = [located(throw(fly=fly, seed=seed, count=3)).bodies[0] for seed in range(3) for fly in (False, True)]
    assert sum(body.significant for body in found) <= 1
    assert all(body.ratio < 1.5 for body in found)


def test_nothing_found_is_reported_with_what_would_have_been_seen():
    found = located(swing(lambda _: 0.0, duration=2))
    assert found.arrows() == []
    assert "no more than noise; smallest detectable steady force:" in found.sentences()[0]


def test_json_is_valid(rubbing, pushed_in_flight):
    for found in (rubbing, pushed_in_flight):
        document = json.loads(json.dumps(found.to_json(), allow_nan=False))
        assert document["sentences"] == found.sentences()
    assert document["bodies"][0]["phases"][0]["place"]["face"] == "+y face"
    assert document["arrows"][0]["body"] == "block"


def test_picture_shows_the_object_and_the_joint(rubbing, pushed_in_flight, tmp_path):
    from matplotlib.image import imread

    from concent_warp.diagnosis.forces.plot import plot_location

    for name, found, recording in (("joint", rubbing, PENDULUM), ("block", pushed_in_flight, throw(count=0).scene)):
        path = tmp_path / f"{name}.png"
        plot_location(found, Model(Scene(recording)), path)
        red = np.abs(imread(path)[..., :3] - [0.84, 0.15, 0.16]).max(axis=2) < 0.05
        assert red.sum() > 50


def test_a_recording_without_motion_is_refused():
    time = np.arange(0, 1, 0.01)
    action = {"drive": Channel(time, 0 * time)}
    with pytest.raises(RecordingError, match="no measured motion"):
        located(Recording(PENDULUM, (Demonstration("demo_0", action=action),)))


def test_a_recording_shorter_than_a_window_is_refused():
    with pytest.raises(RecordingError, match="too short"):
        located(swing(lambda _: 0.0, duration=0.1))
