from dataclasses import replace

import numpy as np
import pytest
import torch

from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.render.networks.cfg import FlowNetworkCfg, NetworkTrainCfg, RenderTrainCfg, SuperResolutionCfg
from tests.render import small_arm
from tests.render.test_networks import pairs


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def weights():
    """Weights of the shapes that the network has, drawn at random."""
    generator = torch.Generator().manual_seed(0)
    widths = [32, 16, 24, 24, 40, 40, 80, 80, 80, 112, 112, 112]
    edges = [3, 3, 3, 5, 5, 3, 3, 3, 5, 5, 5]
    found = {}

    def norm(name, count):
        for part, value in (("weight", 1.0), ("bias", 0.0), ("running_mean", 0.0), ("running_var", 1.0)):
            found[f"{name}.{part}"] = torch.full((count,), value)

    def convolution(name, out, into, edge):
        spread = (into * edge**2) ** -0.5
        found[f"{name}.weight"] = spread * torch.randn(out, into, edge, edge, generator=generator)

    convolution("_conv_stem", 32, 3, 3)
    norm("_bn0", 32)
    for k, edge in enumerate(edges):
        name, into = f"_blocks.{k}", widths[k]
        wide = 6 * into if k else into
        if k:
            convolution(f"{name}._expand_conv", wide, into, 1)
            norm(f"{name}._bn0", wide)
        convolution(f"{name}._depthwise_conv", wide, 1, edge)
        norm(f"{name}._bn1", wide)
        convolution(f"{name}._project_conv", widths[k + 1], wide, 1)
        norm(f"{name}._bn2", widths[k + 1])
    return found | {"_fc.bias": torch.zeros(5), "_bn0.num_batches_tracked": torch.tensor(3)}


def test_distance_of_features_is_zero_for_the_same_image_and_grows_with_noise(script, tmp_path):
    features = script("benchmarks.render.feature_distance")
    given = weights()
    assert "_fc.bias" not in features.needed(given)
    torch.save({name: value.half() for name, value in features.needed(given).items()}, tmp_path / "cut.pt")
    distance = features.feature_distance(tmp_path / "cut.pt")
    image, noise = torch.rand(2, 3, 40, 48), torch.randn(2, 3, 40, 48)
    shapes = [f.shape[1:] for f in distance.features(image)]
    assert shapes == [(16, 20, 24), (24, 10, 12), (40, 5, 6), (112, 3, 3)]
    found = [distance(image, (image + s * noise).clamp(0, 1)).tolist() for s in (0.0, 0.02, 0.2)]
    assert found[0] == [0, 0]
    assert all(0 < little < much < 4 for little, much in zip(found[1], found[2], strict=True))


def test_packed_footage_has_the_recording_and_nearly_its_frames(script, tmp_path):
    module = script("benchmarks.render.footage")
    recording = small_arm.recording([0, 1], 3)
    cameras = tuple(recording.demonstrations[0].image)
    module.CAMERAS, module.OBJECTS = cameras, ()
    smooth = np.linspace(0, 200, 64 * 64 * 3).reshape(64, 64, 3).astype(np.uint8)
    demonstrations = []
    for d, one in enumerate(recording.demonstrations):
        frames = {
            c: np.stack([smooth + np.uint8(10 * d + k) for k in range(len(s.time))]) for c, s in one.image.items()
        }
        image = {
            c: replace(s, rgb=frames[c], depth=np.zeros(frames[c].shape[:3], np.float32)) for c, s in one.image.items()
        }
        demonstrations.append(replace(one, image=image))
    recording = replace(recording, demonstrations=tuple(demonstrations))
    (tmp_path / "whole").mkdir()
    for name in module.QUALITY:
        write_hdf5(recording, tmp_path / "whole" / name)
    module.pack(tmp_path / "whole", tmp_path / "packed")
    for name in module.QUALITY:
        found = module.footage(tmp_path / "packed", name)
        for mine, theirs in zip(found.demonstrations, recording.demonstrations, strict=True):
            assert mine.measured.keys() == theirs.measured.keys()
            for camera in cameras:
                off = mine.image[camera].rgb.astype(float) - theirs.image[camera].rgb
                assert off.shape == theirs.image[camera].rgb.shape
                assert np.abs(off).mean() < 3


CFG = RenderTrainCfg(
    flow=NetworkTrainCfg(steps=50, batch=2, warm_up=2),
    enlarge=NetworkTrainCfg(steps=40, batch=2, warm_up=2),
    network=FlowNetworkCfg(size=16, width=8, factors=(1, 2)),
    super_resolution=SuperResolutionCfg(width=8, blocks=1),
    crop=8,
)


def test_steps_within_a_time_are_at_most_those_of_the_settings_and_some_at_least(script):
    gap = script("benchmarks.render.gap")
    assert gap.steps_within(1e6, CFG, [pairs()], "cpu") == (50, 40)
    assert gap.steps_within(0.0, CFG, [pairs()], "cpu") == (20, 20)


def test_flow_at_the_size_of_the_images_learns_and_paints_without_enlarging(script):
    direct = script("benchmarks.render.direct")
    one = pairs()
    cfg = replace(CFG, network=replace(CFG.network, size=64))
    training = direct.WholeTraining(one, cfg, "cpu")
    spent = direct.learn(training, "base", 60.0)
    assert spent["steps"] == 50
    paint = direct.painting(training, "base")
    reference = training.reference[0]
    assert reference.shape == (3, 64, 64)
    nowhere = torch.zeros(len(one), 64, 64, dtype=torch.bool)
    found = direct.judged(paint, one, reference, nowhere, 1, None)
    plain = direct.judged(lambda seen, previous, *_: ((seen + 1) / 2, previous), one, reference, nowhere, 1, None)
    assert found["psnr"] > plain["psnr"]
    assert direct.judged(paint, one, reference, ~nowhere, 1, None)["ssim"] == pytest.approx(1)
    assert direct.seconds_of(paint, one, reference, 1, 2) > 0


def test_training_stops_when_its_time_is_over(script):
    direct = script("benchmarks.render.direct")
    training = direct.WholeTraining(pairs(), replace(CFG, network=replace(CFG.network, size=64)), "cpu")
    assert direct.learn(training, "base", 0.0)["steps"] == 1


def test_rasteriser_benchmark_reports_why_gsplat_is_missing(script, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "gsplat", None)
    rasteriser = script("benchmarks.render.rasteriser")
    poses, matrix = rasteriser.cameras(1), rasteriser.intrinsics_of(15.0, 16, 16)
    row = rasteriser.against_gsplat(rasteriser.cube(10), poses, matrix, torch.zeros(1, 16, 16, 3), "cpu")
    assert "gsplat" in row.pop("gsplat_missing")
    assert not row
