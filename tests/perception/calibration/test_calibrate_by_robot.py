"""A fixed camera is aligned with the arm itself, in small images of Reality."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from concent_warp.errors import RecordingError
from concent_warp.perception.calibration.calibrate import calibrate
from concent_warp.perception.calibration.cfg import CalibrateCfg, RobotViewCfg
from concent_warp.reality.calibration import CalibrationSceneCfg, record_calibration

CFG = CalibrateCfg(robot=RobotViewCfg(pixels=4000, coarse_rounds=15, fine_rounds=8))
SCENE = CalibrationSceneCfg(camera="world", target="none", frames=9, image_size=(144, 192), exposure=0.0)


@pytest.fixture(scope="module")
def filmed():
    return record_calibration(SCENE, 2001)


def test_the_pose_is_found_from_the_robot_alone(filmed):
    recording, truth = filmed
    found = calibrate(recording, CFG).cameras["camera"]
    assert found.method == "robot"
    assert np.linalg.norm(found.correction[0]) > 0.01
    assert np.linalg.norm(found.pose[:3, 3] - truth.pose[:3, 3]) < 2e-3
    assert np.degrees(Rotation.from_matrix(found.pose[:3, :3].T @ truth.pose[:3, :3]).magnitude()) < 0.2
    assert abs(found.clock_offset - truth.clock_offset) < 3e-3
    assert (found.position_interval < 3e-3).all()
    assert not found.checks[0].off


@pytest.mark.slow
def test_depth_that_reads_too_long_is_found_and_does_not_move_the_pose(filmed):
    recording, truth = filmed
    demonstration = recording[0]
    stream = demonstration.image["camera"]
    longer = replace(stream, depth=(1.02 * stream.depth).astype(np.float32))
    changed = replace(recording, demonstrations=(replace(demonstration, image={"camera": longer}),))
    found = calibrate(changed, CFG).cameras["camera"]
    assert abs(found.checks[0].value - 2) < 0.3
    assert found.checks[0].off
    assert np.linalg.norm(found.pose[:3, 3] - truth.pose[:3, 3]) < 3e-3


def test_a_start_that_is_far_off_is_refused_or_right_but_never_wrong(filmed):
    recording, truth = filmed
    quaternion = Rotation.from_matrix(
        truth.pose[:3, :3] @ Rotation.from_euler("y", 50, degrees=True).as_matrix()
    ).as_quat()
    start = (*(truth.pose[:3, 3] + [0.3, -0.3, 0.2]), quaternion[3], *quaternion[:3])
    with pytest.raises(RecordingError, match="does not come to agree"):
        calibrate(recording, replace(CFG, start=tuple(map(float, start))))


def test_images_without_depth_and_without_tag_are_refused(filmed):
    recording, _ = filmed
    demonstration = recording[0]
    stream = demonstration.image["camera"]
    flat = replace(stream, depth=np.zeros_like(stream.depth))
    with pytest.raises(RecordingError, match="no tag of dictionary"):
        calibrate(replace(recording, demonstrations=(replace(demonstration, image={"camera": flat}),)), CFG)
