"""TAPIR: the code is a user's checkout, which is on no package index.

With ``CONCENT_TAPNET`` set to a checkout of github.com/google-deepmind/tapnet, and dm-tree and einshape installed, the
network runs here with weights that make it compare image features and nothing else.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.perception.backends import tapir

CHECKOUT = os.environ.get("CONCENT_TAPNET", "")


def test_missing_code_and_weights_are_named(tmp_path):
    with pytest.raises(cw.ConcentError, match=r"no code of TAPIR.*no such folder.*clone"):
        cw.TapirTracker(tmp_path / "gone", tmp_path / "weights.pt")
    folder = tmp_path / "tapnet" / "torch"
    folder.mkdir(parents=True)
    for name in ("tapir_model.py", "utils.py"):
        (folder / name).write_text("import package_that_nobody_has\n")
    with pytest.raises(cw.ConcentError, match=r"found no nets\.py"):
        cw.TapirTracker(tmp_path, tmp_path / "weights.pt")
    (folder / "nets.py").write_text("")
    with pytest.raises(cw.ConcentError, match=r"weights\.pt: no weights of TAPIR.*no such file"):
        cw.TapirTracker(tmp_path, tmp_path / "weights.pt")
    (tmp_path / "weights.pt").write_text("")
    with pytest.raises(cw.ConcentError, match=r"package_that_nobody_has.*pip install dm-tree einshape"):
        cw.TapirTracker(tmp_path, tmp_path / "weights.pt")


def test_a_checkout_is_imported_without_its_package_and_leaves_nothing_behind(tmp_path):
    folder = tmp_path / "tapnet" / "torch"
    folder.mkdir(parents=True)
    (tmp_path / "tapnet" / "__init__.py").write_text("raise ImportError('jax')\n")
    (folder / "utils.py").write_text("EDGE = 8\n")
    (folder / "nets.py").write_text("")
    (folder / "tapir_model.py").write_text("from tapnet.torch import utils\nfound = utils.EDGE\n")
    assert tapir._code(tmp_path).found == 8
    assert not [name for name in sys.modules if name.split(".")[0] == "tapnet"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"no checkpoint", "cannot be read"),
        ({"layer.weight": 1}, r"of another network.*layer\.weight"),
        ([1, 2], "of another network.*list"),
    ],
)
def test_files_that_are_no_weights_are_refused(tmp_path, content, message):
    import torch

    path = tmp_path / "weights.pt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    with pytest.raises(cw.ConcentError, match=message):
        tapir._network(sys.modules[__name__], path, cw.TapirTrackerCfg())


def comparing_weights(network) -> dict:
    """Return weights with which points are where the features are most alike, and always seen."""
    weights = {name: value.clone() for name, value in network.state_dict().items()}
    for name in weights:
        if name.startswith(("torch_cost_volume_track_mods", "torch_pips_mixer.linear_1")):
            weights[name].zero_()
    # The cost volume passes unchanged; nothing is added to the first estimate.
    weights["torch_cost_volume_track_mods.hid1.weight"][0, 0, 1, 1] = 1
    weights["torch_cost_volume_track_mods.hid2.weight"][0, 0, 1, 1] = 1
    weights["torch_cost_volume_track_mods.occ_out.bias"][:] = -6
    return weights


@pytest.mark.skipif(not CHECKOUT, reason="CONCENT_TAPNET names no checkout of github.com/google-deepmind/tapnet")
@pytest.mark.parametrize(("levels", "extra"), [(1, True), (0, False)])
def test_the_network_of_a_checkout_follows_points(tmp_path, levels, extra):
    import cv2
    import torch

    module = tapir._code(Path(CHECKOUT))
    torch.manual_seed(0)
    network = module.TAPIR(pyramid_level=levels, extra_convs=extra)
    torch.save(comparing_weights(network), tmp_path / "weights.pt")
    cfg = cw.TapirTrackerCfg(longest_edge=256)
    tracker = cw.TapirTracker(CHECKOUT, tmp_path / "weights.pt", cfg, device="cpu")
    assert tracker._model.pyramid_level == levels
    coarse = np.random.default_rng(0).integers(0, 255, (16, 16, 3), dtype=np.uint8)
    image = cv2.resize(coarse, (256, 256), interpolation=cv2.INTER_CUBIC)
    rgb = np.stack([np.roll(image, (8 * k, -16 * k), axis=(0, 1)) for k in range(3)])
    frames = cw.CameraFrames(rgb, np.zeros(rgb.shape[:3], np.float32))
    chosen = np.array([[100.0, 80.0], [140.0, 130.0], [160.0, 100.0], [90.0, 150.0]])
    tracks = tracker.track(frames, np.column_stack([[0, 0, 1, 0], chosen]))
    assert tracks.visible.all()
    first = np.array([0, 0, 1, 0])
    steps = np.arange(3)[None] - first[:, None]
    expected = chosen[:, None] + steps[..., None] * np.array([-16.0, 8.0])
    error = np.linalg.norm(tracks.pixels - expected, axis=2)
    assert (error[np.arange(4), first] < 1e-6).all()
    # Features lie 8 px apart; their weighted mean is about as good as a quarter of that.
    assert np.median(error) < 2.0
