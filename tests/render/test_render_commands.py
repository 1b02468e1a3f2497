"""The whole way at small size: footage, networks, splats, a data set; on a CPU, in seconds."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small_arm
from small_arm import ball
from small_dataset import read_frames

import concent_warp as cw
from concent_warp.cli.entry import main
from concent_warp.errors import ConcentError
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.logs.readers.calibration import read_calibration
from concent_warp.recording.recording import ImageStream
from concent_warp.render.cameras import Camera
from concent_warp.scene.cameras import with_cameras
from concent_warp.scene.scene import Scene

TRAIN = [
    "--network.size", "16", "--network.width", "16", "--network.factors", "1", "2", "--flow.batch", "8",
    "--flow.learning-rate", "3e-3", "--flow.warm-up", "10", "--flow.ema", "0.97", "--enlarge.batch", "8",
    "--enlarge.learning-rate", "3e-3", "--enlarge.warm-up", "10", "--enlarge.ema", "0.97",
    "--super-resolution.width", "16", "--super-resolution.blocks", "2", "--crop", "10", "--device", "cpu",
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with footage of the arm alone, of a held-out motion with the ball, and splats of the ball."""
    place = tmp_path_factory.mktemp("render")
    write_hdf5(small_arm.recording(range(3), 40), place / "empty.h5")
    write_hdf5(small_arm.recording([9], 16, objects=True), place / "held.h5")
    ball().write(place / "ball.ply")
    assert main(["render-train", str(place / "empty.h5"), "--out", str(place / "net"), "--steps", "80", *TRAIN]) == 0
    return place


def frames(dataset: Path, camera: str) -> np.ndarray:
    """Return the images of a camera in a data set of one file, 0..1."""
    return read_frames(dataset / f"videos/observation.images.{camera}/chunk-000/file-000.mp4") / 255


def test_hybrid_images_are_nearer_to_the_cameras_than_the_simulations(folder):
    common = [
        "render",
        "--recording",
        str(folder / "held.h5"),
        "--size",
        "64",
        "--device",
        "cpu",
        "--cameras",
        "base",
        "wrist",
    ]
    assert main([*common, "--out", str(folder / "raw")]) == 0
    hybrid = ["--networks", str(folder / "net"), "--splats", f"ball={folder / 'ball.ply'}", "--no-shadows"]
    figure = folder / "layers.png"
    assert main([*common, *hybrid, "--out", str(folder / "hybrid"), "--figure", str(figure), "--films", "1"]) == 0
    assert figure.stat().st_size > 10_000
    for camera in ("base", "wrist"):
        raw, hybrid = frames(folder / "raw", camera), frames(folder / "hybrid", camera)
        real = small_arm.filmed(small_arm.states(9, 16), objects=True)[camera][: len(raw)] / 255
        gain = 10 * np.log10(np.square(raw - real).mean() / np.square(hybrid - real).mean())
        assert gain > 6, camera
    film = read_frames(folder / "hybrid" / "films" / "episode_000000.mp4")
    assert film.shape[1:] == (64, 128, 3)
    info = json.loads((folder / "hybrid" / "meta" / "info.json").read_text())
    assert info["features"]["observation.state"]["names"] == ["turn", "bend"]
    assert info["features"]["action"]["names"] == ["turn", "bend"]
    assert info["total_frames"] == len(film)


def test_training_is_gone_on_with_and_other_settings_are_refused(folder, capsys):
    command = ["render-train", str(folder / "empty.h5"), "--out", str(folder / "net"), *TRAIN]
    assert main([*command, "--steps", "80", "--resume"]) == 0
    assert main([*command, "--steps", "260"]) == 2
    assert "holds a run" in capsys.readouterr().err
    assert main([*command, "--steps", "260", "--resume"]) == 2
    assert "other settings" in capsys.readouterr().err


def test_data_set_is_gone_on_with(folder, capsys):
    command = ["render", "--recording", str(folder / "held.h5"), "--size", "32", "--out", str(folder / "on")]
    command += ["--cameras", "base", "--device", "cpu", "--format", "robomimic"]
    assert main(command) == 0
    assert main(command) == 2
    assert "holds a run" in capsys.readouterr().err
    assert main([*command, "--resume"]) == 0
    assert "holds 1 episode" in capsys.readouterr().out
    assert main([*command, "--rate", "5", "--resume"]) == 2
    assert "begun with other settings" in capsys.readouterr().err
    assert main([*command, "--seed", "3", "--resume"]) == 2
    assert "seed 3" in capsys.readouterr().err
    assert main([*command, "--splats", "cup=none.ply", "--overwrite"]) == 2  # before anything is taken away
    assert main([*command, "--resume", "--figure", str(folder / "none.png")]) == 0
    assert "no frame was rendered in this call" in capsys.readouterr().out
    assert not (folder / "none.png").exists()
    assert main([*command, "--rate", "5", "--overwrite"]) == 0
    assert main([*command, "--out", str(folder / "net"), "--overwrite"]) == 2
    assert "no data set" in capsys.readouterr().err
    assert (folder / "net").is_dir()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ((), "one thing is to be rendered"),
        (("--checkpoint", "nowhere"), "nowhere: no such training"),
        (("--recording", "held.h5", "--pretrained"), "one thing is to be rendered"),
        (("--recording", "held.h5", "--cameras", "side"), "no such camera"),
        (("--recording", "held.h5", "--splats", "ball"), "body=file.ply"),
        (("--recording", "held.h5", "--splats", "cup=ball.ply", "--cameras", "base"), "no such body"),
        (("--recording", "held.h5", "--networks", "nowhere"), "no trained networks"),
        (("--recording", "held.h5", "--networks", "net", "--size", "96"), "images of another size"),
        (("--recording", "held.h5", "--randomise"), "random looks are those of a policy's task"),
        (("--pretrained", "--randomise", "--splats", "ball=ball.ply"), "random looks are of the ray-traced scene"),
    ],
)
def test_what_cannot_be_rendered_is_reported_in_one_sentence(folder, options, said, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main(["render", "--out", "bad", "--device", "cpu", *options]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert said in lines[-1]
    assert not (folder / "bad").exists()


def test_policy_is_rendered_to_the_frames_of_its_episodes(tmp_path, capsys):
    out = tmp_path / "policy"
    command = [
        "render",
        "--pretrained",
        "--episodes",
        "2",
        "--size",
        "32",
        "--keep",
        "all",
        "--device",
        "cpu",
        "--out",
        str(out),
    ]
    assert main(command) == 0
    assert "holds 2 episodes" in capsys.readouterr().out
    info = json.loads((out / "meta" / "info.json").read_text())
    assert info["fps"] == 20
    assert info["total_frames"] == 2 * 60
    assert set(info["features"]) >= {
        "observation.images.base",
        "observation.images.wrist",
        "observation.state",
        "action",
    }
    assert len(info["features"]["action"]["names"]) == 8
    assert frames(out, "wrist").shape == (120, 32, 32, 3)
    # The calibration beside it is that of the scene's cameras.
    calibrations = read_calibration(out / "calibration.json")
    assert set(calibrations) == {"base", "wrist"}
    scene = Scene(cw.load_policy("shape_sorter").run.recording.scene)
    true = with_cameras(scene, list(calibrations))
    for name, one in calibrations.items():
        assert one.size == (32, 32)
        assert one.pose is not None
        blank = np.zeros((1, 32, 32))
        stream = ImageStream(blank[:, 0, 0], blank[..., None], blank, one.intrinsics, one.pose, one.body)
        found, expected = Camera.of(name, stream), Camera.in_scene(true, name)
        assert found.body == expected.body
        assert found.position == pytest.approx(expected.position, abs=1e-6)
        assert found.fovy == pytest.approx(expected.fovy, abs=1e-6)


def test_random_looks_differ_from_episode_to_episode_and_stay_within_one(tmp_path):
    out, policy = tmp_path / "random", cw.load_policy("shape_sorter")
    cfg = cw.RenderCfg(episodes=2, worlds=2, size=32, cameras=("base",), keep="all", randomise=True)
    assert cw.render(policy, out, cfg, device="cpu").episodes == 2
    seen = frames(out, "base")
    first, second = seen[:60], seen[60:]
    within = max(float(np.abs(one[1] - one[0]).mean()) for one in (first, second))
    assert within < 0.3 * float(np.abs(first[0] - second[0]).mean())
    still = replace(cfg.looks, colour=0.0, hue_share=0.0, pattern=0.0, grain_share=0.0, light_strength=(0.5, 0.5))
    with pytest.raises(ConcentError, match="other settings"):
        cw.render(policy, out, replace(cfg, looks=still, episodes=3), device="cpu", resume=True)
