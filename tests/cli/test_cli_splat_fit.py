import json

import cv2
import pytest

from concent_warp.cli import main
from concent_warp.reality.sensors.photographs import PhotographsCfg, photographs
from concent_warp.reality.world import WorldCfg
from concent_warp.render.splats.splats import Splats
from concent_warp.render.splats.views import SplatViews
from concent_warp.scene.shape_sorter import ShapeSorterCfg

QUICK = ["--fit.start", "300", "--fit.held-out", "4"]


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    """Photographs of the stand-in's block, in a folder."""
    folder = tmp_path_factory.mktemp("block")
    world = WorldCfg().build(ShapeSorterCfg().build())
    SplatViews(*photographs(world, "block", PhotographsCfg(count=16, size=40)), masked=True).write(folder)
    return folder


def test_photographs_become_splats_of_the_size_of_the_block(block, tmp_path, capsys):
    assert main(["splat-fit", str(block), "--out", str(tmp_path / "run"), *QUICK, "--fit.iterations", "120"]) == 0
    splats = Splats.read(tmp_path / "run" / "splats.ply")
    spread = splats.means.quantile(0.95, dim=0) - splats.means.quantile(0.05, dim=0)
    assert spread.tolist() == pytest.approx([0.04] * 3, abs=0.008)
    scores = json.loads((tmp_path / "run" / "scores.json").read_text())
    assert [score["view"] for score in scores] == [3, 7, 11, 15]
    assert min(score["psnr"] for score in scores) > 22
    assert cv2.imread(str(tmp_path / "run" / "held_out.png")).shape == (80, 160, 3)
    assert "4 images that were not fitted" in capsys.readouterr().out


def test_finished_fit_is_kept_unless_asked_and_resumes_to_nothing(block, tmp_path, capsys):
    command = ["splat-fit", str(block), "--out", str(tmp_path / "run"), *QUICK, "--fit.iterations", "3"]
    assert main(command) == 0
    written = (tmp_path / "run" / "splats.ply").read_bytes()
    assert main(command) == 2
    assert "--overwrite or --resume" in capsys.readouterr().err
    assert main([*command, "--resume"]) == 0
    assert (tmp_path / "run" / "splats.ply").read_bytes() == written
    assert main([*command[:-1], "4", "--resume"]) == 2
    assert "other settings" in capsys.readouterr().err


def test_what_is_no_image_folder_is_reported_in_one_sentence(tmp_path, capsys):
    assert main(["splat-fit", str(tmp_path), "--out", str(tmp_path / "run")]) == 2
    message = capsys.readouterr().err
    assert "no posed images" in message
    assert "Traceback" not in message
    assert not (tmp_path / "run").exists()


def test_device_that_is_not_there_is_reported_in_one_sentence(block, tmp_path, capsys):
    assert main(["splat-fit", str(block), "--out", str(tmp_path / "run"), "--device", "toaster:7"]) == 2
    message = capsys.readouterr().err
    assert "no such device" in message
    assert "'toaster:7'" in message
    assert message.count("\n") == 1
    assert not (tmp_path / "run").exists()
