import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import concent_warp as cw
from concent_warp.perception.calibration.calibrate import calibrate
from concent_warp.perception.calibration.cfg import CalibrateCfg, CalibrationTargetCfg
from tests.perception.calibration.filming import (
    CAMERA_IN_WORLD,
    CAMERA_ON_HAND,
    MATRIX,
    SIZE,
    TAG_ON_HAND,
    Filming,
    film,
    with_stream,
)


def angle(first, second):
    return np.degrees(Rotation.from_matrix(first[:3, :3].T @ second[:3, :3]).magnitude())


def checks(camera):
    return {check.name: check for check in camera.checks}


@pytest.fixture(scope="module")
def wrist(on_hand):
    return calibrate(on_hand, CalibrateCfg(CalibrationTargetCfg(tag_size=SIZE)))


def test_a_camera_on_the_hand_is_found_from_a_tag_in_the_world(wrist):
    found = wrist.cameras["eye"]
    assert np.linalg.norm(found.pose[:3, 3] - CAMERA_ON_HAND[:3, 3]) < 5e-4
    assert angle(found.pose, CAMERA_ON_HAND) < 0.08
    assert abs(found.clock_offset - 0.03) < 1e-3
    assert found.body == "hand"
    assert found.target_body is None
    assert found.method == "tags"


def test_intervals_are_small_and_hold_the_truth(wrist):
    found = wrist.cameras["eye"]
    assert (found.position_interval < 1e-3).all()
    assert (found.rotation_interval < np.radians(0.2)).all()
    shift = np.abs(found.pose[:3, 3] - CAMERA_ON_HAND[:3, 3])
    assert (shift < 2 * found.position_interval).all()
    assert abs(found.clock_offset - 0.03) < 2 * found.clock_interval < 2e-3


def test_a_recording_without_faults_has_none(wrist):
    assert not [c for c in wrist.cameras["eye"].checks if c.off]
    assert set(checks(wrist.cameras["eye"])) >= {"focal length x", "radial distortion", "target size", "depth"}
    assert not wrist.cameras["eye"].remarks


def test_a_fixed_camera_is_found_from_a_tag_whose_body_is_not_told(fixed, cfg):
    found = calibrate(fixed, cfg).cameras["eye"]
    assert np.linalg.norm(found.pose[:3, 3] - CAMERA_IN_WORLD[:3, 3]) < 5e-4
    assert angle(found.pose, CAMERA_IN_WORLD) < 0.08
    assert found.target_body == "hand"
    assert np.linalg.norm(found.targets["tag 5"][:3, 3] - TAG_ON_HAND[:3, 3]) < 1e-3


@pytest.mark.parametrize("offset", [-0.2, 0.0, 0.35])
def test_clocks_that_differ_by_a_lot_are_brought_together(offset, cfg):
    found = calibrate(film(Filming(offset=offset, seed=3)), cfg).cameras["eye"]
    assert abs(found.clock_offset - offset) < 1e-3
    assert np.linalg.norm(found.pose[:3, 3] - CAMERA_ON_HAND[:3, 3]) < 1e-3


def test_depth_that_reads_too_long_is_said_with_an_interval(cfg):
    found = calibrate(film(Filming(depth_scale=1.018)), cfg).cameras["eye"]
    depth = checks(found)["depth"]
    assert depth.low < 1.8 < depth.high
    assert depth.off
    assert depth.high - depth.low < 0.5
    assert any(r.startswith("depth reads 1.") and "too long" in r for r in found.remarks)


def test_a_wrong_focal_length_is_named_and_fitted_on_demand(cfg):
    wrong = MATRIX.copy()
    wrong[[0, 1], [0, 1]] *= 1.03
    recording = film(Filming(matrix=wrong, frames=24))
    found = calibrate(recording, cfg).cameras["eye"]
    check = checks(found)["focal length x"]
    assert check.off
    assert abs(check.value - 3) < 0.7
    assert any("focal length x" in r and "too long" in r for r in found.remarks)
    assert any("assume" in r for r in found.remarks)
    fitted = calibrate(recording, replace(cfg, fit_intrinsics=True))
    assert (
        np.abs(fitted.cameras["eye"].intrinsics[:2, :2] / np.where(MATRIX == 0, 1, MATRIX)[:2, :2] - np.eye(2)).max()
        < 6e-3
    )
    assert np.linalg.norm(fitted.cameras["eye"].pose[:3, 3] - CAMERA_ON_HAND[:3, 3]) < 1e-3
    assert np.allclose(fitted.recording[0].image["eye"].intrinsics, fitted.cameras["eye"].intrinsics)


def test_distortion_that_is_left_in_the_images_is_named_and_taken_out_on_demand(cfg):
    recording = film(Filming(radial=-0.2))
    found = calibrate(recording, cfg).cameras["eye"]
    assert checks(found)["radial distortion"].off
    assert any("grow with the radius" in r for r in found.remarks)
    fitted = calibrate(recording, replace(cfg, fit_intrinsics=True))
    again = calibrate(fitted.recording, cfg).cameras["eye"]
    assert not checks(again)["radial distortion"].off
    assert abs(again.clock_offset) < 1e-3


def test_outliers_have_no_weight(on_hand, cfg):
    stream = on_hand[0].image["eye"]
    rgb = stream.rgb.copy()
    rgb[[4, 11]] = rgb[[11, 4]]
    found = calibrate(with_stream(on_hand, rgb=rgb), cfg).cameras["eye"]
    assert sum(f.weight < 0.5 for f in found.frames) == 2
    assert np.linalg.norm(found.pose[:3, 3] - CAMERA_ON_HAND[:3, 3]) < 7e-4


def test_the_calibrated_recording_is_written_with_its_json(on_hand, cfg, tmp_path):
    found = calibrate(on_hand, cfg, out=tmp_path / "calibrated.h5")
    stored = cw.load_recording(tmp_path / "calibrated.h5")[0].image["eye"]
    assert np.allclose(stored.pose, found.cameras["eye"].pose)
    assert np.allclose(stored.time, on_hand[0].image["eye"].time + found.cameras["eye"].clock_offset)
    entry = json.loads((tmp_path / "calibration.json").read_text())["cameras"]["eye"]
    assert entry["width"] == 320
    assert entry["height"] == 240
    assert entry["body"] == "hand"
    assert entry["distortion"] == []
    assert np.allclose(entry["pose"], stored.pose)
    assert np.allclose(entry["intrinsics"], MATRIX)


def test_a_pose_in_the_axes_of_opengl_is_recognised(on_hand, cfg):
    found = calibrate(with_stream(on_hand, pose=CAMERA_ON_HAND @ np.diag([1.0, -1, -1, 1])), cfg).cameras["eye"]
    assert any("OpenGL" in remark for remark in found.remarks)
    inverted = calibrate(
        with_stream(film(Filming(camera_on_hand=False, seed=1)), pose=np.linalg.inv(CAMERA_IN_WORLD)), cfg
    )
    assert any("inverse" in remark for remark in inverted.cameras["eye"].remarks)


def test_corners_are_found_to_a_twentieth_of_a_pixel_without_bias(on_hand):
    from concent_warp.perception.calibration.targets import detect

    views = detect(on_hand[0].image["eye"], CalibrationTargetCfg(tag_size=SIZE))
    errors = []
    for view in views:
        _, turn, shift = cv2.solvePnP(view.points, view.pixels, MATRIX, None)
        back, _ = cv2.projectPoints(view.points, turn, shift, MATRIX, None)
        errors.append(back[:, 0] - view.pixels)
    assert len(views) == 20
    assert np.sqrt(np.mean(np.square(errors))) < 0.06
