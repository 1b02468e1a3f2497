"""Recordings that cannot be calibrated are refused in one sentence that says what to do."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.perception.calibration.calibrate import calibrate
from concent_warp.perception.calibration.cfg import CalibrateCfg, CalibrationLimitsCfg, CalibrationTargetCfg
from concent_warp.recording.recording import Channel
from tests.perception.calibration.filming import MATRIX, SIZE, Filming, film, with_stream

TAG = CalibrationTargetCfg(tag_size=SIZE)


def refused(recording, cfg=None):
    with pytest.raises(RecordingError) as caught:
        calibrate(recording, cfg or CalibrateCfg(TAG))
    return str(caught.value)


def test_another_dictionary_is_named(on_hand):
    said = refused(on_hand, CalibrateCfg(replace(TAG, dictionary="5X5_100")))
    assert "no tag of dictionary DICT_5X5_100" in said
    assert "give --dictionary APRILTAG_36h11" in said


def test_an_unknown_dictionary_is_refused(on_hand):
    assert "no such tag dictionary" in refused(on_hand, CalibrateCfg(replace(TAG, dictionary="APRILTAG_99")))


def test_mirrored_images_are_recognised():
    assert "mirror" in refused(film(Filming(mirrored=True)))


def test_images_without_a_tag_are_refused(on_hand):
    blank = np.full_like(on_hand[0].image["eye"].rgb, 90)
    assert "single brightness" in refused(with_stream(on_hand, rgb=blank))
    noise = np.random.default_rng(0).normal(120, 25, (1, 1, *blank.shape[2:])).astype(np.uint8) + np.zeros_like(blank)
    assert "--method robot" in refused(with_stream(on_hand, rgb=noise))


def test_other_ids_are_named(on_hand):
    said = refused(on_hand, CalibrateCfg(replace(TAG, ids=(1, 2))))
    assert "expected one of the ids 1, 2, found tag 5" in said


def test_a_wrong_tag_size_is_refused_with_the_right_one(on_hand):
    said = refused(on_hand, CalibrateCfg(replace(TAG, tag_size=0.04)))
    assert "size of the tags is wrong" in said
    assert "as the robot's motion and depth say" in said
    assert "expected edges of 0.0" in said
    size = float(said.split("expected edges of ")[1].split(" m")[0])
    assert abs(size - SIZE) < 5e-4


def test_a_tag_that_is_moved_is_refused():
    said = refused(film(Filming(moved_from=5.2)))
    assert "moved" in said


def test_one_axis_of_rotation_is_named_as_degenerate():
    said = refused(film(Filming(turning=(0.0, 0.0, 0.8))))
    assert "one axis only" in said
    assert "second axis" in said


def test_an_arm_that_stands_still_is_refused(on_hand):
    still = {name: Channel(c.time, np.zeros_like(c.value)) for name, c in on_hand[0].measured.items()}
    said = refused(replace(on_hand, demonstrations=(replace(on_hand[0], measured=still),)))
    assert "do not move against one another" in said


def test_too_few_views_are_refused():
    assert "too few frames show a target; expected 6" in refused(film(Filming(frames=5)))


def test_a_recording_without_joint_readings_is_refused(on_hand):
    said = refused(replace(on_hand, demonstrations=(replace(on_hand[0], measured={}),)))
    assert "no joint of the robot has readings" in said


def test_a_joint_without_readings_on_the_way_to_the_camera_is_named(on_hand):
    some = {name: c for name, c in on_hand[0].measured.items() if name != "pitch"}
    said = refused(replace(on_hand, demonstrations=(replace(on_hand[0], measured=some),)))
    assert "expected readings of pitch" in said


def test_clocks_that_do_not_overlap_are_refused(on_hand):
    said = refused(with_stream(on_hand, time=on_hand[0].image["eye"].time + 1000))
    assert "do not overlap" in said
    assert "9.9" in said


def test_missing_intrinsics_are_refused(on_hand):
    assert "intrinsics are missing" in refused(with_stream(on_hand, intrinsics=np.eye(3)))


def test_a_camera_on_another_body_than_recorded_is_named(on_hand):
    assert "the camera is not on world; expected" in (
        said := refused(with_stream(on_hand, body=None)).split(": ", 2)[2]
    )
    assert "a camera on hand" in said


def test_tags_that_are_too_small_are_refused(on_hand):
    limits = CalibrationLimitsCfg(min_edge=200)
    assert "too small in the images" in refused(on_hand, CalibrateCfg(TAG, limits=limits))


def test_small_images_are_named(on_hand):
    stream = on_hand[0].image["eye"]
    rgb = np.stack([cv2.resize(f, (32, 24), interpolation=cv2.INTER_AREA) for f in stream.rgb])
    matrix = np.diag([0.1, 0.1, 1]) @ MATRIX
    small = with_stream(on_hand, rgb=rgb, depth=np.zeros(rgb.shape[:3], np.float32), intrinsics=matrix)
    said = refused(small)
    assert "32 x 24 px" in said


def test_readings_with_long_gaps_are_refused(on_hand):
    holes = {n: Channel(c.time[::50], c.value[::50]) for n, c in on_hand[0].measured.items()}
    said = refused(replace(on_hand, demonstrations=(replace(on_hand[0], measured=holes),)))
    assert "too few frames lie where the joints have readings" in said


def test_unknown_cameras_bodies_and_boards_are_refused(on_hand):
    assert "no such camera" in refused(on_hand, CalibrateCfg(TAG, cameras=("nose",)))
    assert "body that the scene lacks" in refused(on_hand, CalibrateCfg(replace(TAG, body="nose")))
    assert "size of the charuco board" in refused(on_hand, CalibrateCfg(replace(TAG, method="charuco")))
    board = replace(TAG, method="charuco", board=(6, 4), spacing=0.04)
    assert "smaller than its square" in refused(on_hand, CalibrateCfg(board))


def test_a_recording_without_images_is_refused(on_hand):
    assert "no camera to calibrate" in refused(replace(on_hand, demonstrations=(replace(on_hand[0], image={}),)))


def test_the_robot_itself_does_not_calibrate_a_camera_on_it(on_hand):
    assert "moves with it" in refused(on_hand, CalibrateCfg(replace(TAG, method="robot")))


def test_a_start_that_is_no_pose_is_refused(fixed):
    assert "seven numbers" in refused(fixed, CalibrateCfg(replace(TAG, method="robot"), start=(1.0, 2.0)))
