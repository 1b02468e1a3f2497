from dataclasses import replace

import numpy as np
import pytest
import torch

from concent_warp.errors import RenderError
from concent_warp.render.cameras import Camera
from concent_warp.render.networks.cfg import (
    AugmentCfg,
    FlowNetworkCfg,
    NetworkTrainCfg,
    RenderTrainCfg,
    SuperResolutionCfg,
)
from concent_warp.render.networks.flow import flow_loss, sample_images
from concent_warp.render.networks.flow_network import FlowNetwork
from concent_warp.render.networks.painter import Painter
from concent_warp.render.networks.pairs import ImagePairs, _columns, _frames_before
from concent_warp.render.networks.super_resolution import SuperResolution, _enlarged, downsampled
from concent_warp.render.networks.train import RenderTraining

SMALL = FlowNetworkCfg(size=16, width=8, factors=(1, 2))
CFG = RenderTrainCfg(
    flow=NetworkTrainCfg(steps=6, batch=4, warm_up=2),
    enlarge=NetworkTrainCfg(steps=4, batch=2, warm_up=2),
    network=SMALL,
    super_resolution=SuperResolutionCfg(width=8, blocks=1),
    crop=8,
)


@pytest.fixture(autouse=True)
def one_thread():
    """Threads that wait for one another take minutes for these small networks where other work is on the cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def pairs(name="base", body=None, count=12) -> ImagePairs:
    """Return frames of a bright square that moves; the simulation shows it dark."""
    camera = Camera(name, body, (0, 0, 1), (1, 0, 0, 0), 45.0)
    real = torch.full((count, 3, 64, 64), 120, dtype=torch.uint8)
    simulated = torch.full((count, 3, 64, 64), 30, dtype=torch.uint8)
    for k in range(count):
        real[k, 0, 16:32, 4 * k : 4 * k + 16] = 250
        simulated[k, :, 16:32, 4 * k : 4 * k + 16] = 80
    return ImagePairs(camera, real, simulated, torch.rand(count, 9), _frames_before([count]))


def test_flow_of_a_perfect_network_ends_at_its_image():
    image = torch.rand(2, 3, 8, 8) * 2 - 1

    class Knows(torch.nn.Module):
        def forward(self, *_):
            return image

    for steps in (1, 3, 7):
        assert torch.allclose(sample_images(Knows(), image, image, None, steps=steps), image, atol=1e-6)
    assert float(flow_loss(Knows(), image, image, image, None)) == 0


def test_velocity_of_the_steps_is_that_of_the_straight_line():
    """A network that only knows x_t leaves a point on its line where the line leads."""
    noise = torch.randn(1, 3, 4, 4, generator=torch.Generator().manual_seed(3))
    image = torch.ones(1, 3, 4, 4) * 0.5
    seen = []

    class Watches(torch.nn.Module):
        def forward(self, noised, time, *_):
            seen.append((float(time[0]), noised.clone()))
            return image

    sample_images(Watches(), image, image, None, steps=4, generator=torch.Generator().manual_seed(3))
    for time, noised in seen:
        assert torch.allclose(noised, (1 - time) * noise + time * image, atol=1e-6)


def test_network_takes_nine_channels_and_the_pose_where_the_camera_moves():
    plain, posed = FlowNetwork(SMALL), FlowNetwork(replace(SMALL, posed=True))
    assert plain.entry.in_channels == 9
    for parameter in posed.parameters():  # much of it starts at zero, so that nothing would follow from the pose
        torch.nn.init.normal_(parameter, std=0.1)
    x, time = torch.randn(2, 3, 16, 16), torch.rand(2)
    assert plain(x, time, x, x).shape == (2, 3, 16, 16)
    here, there = posed(x, time, x, x, torch.zeros(2, 9)), posed(x, time, x, x, torch.ones(2, 9))
    assert not torch.allclose(here, there)


def test_super_resolution_starts_as_bicubic_and_enlarges_four_times():
    network = SuperResolution(SuperResolutionCfg(width=8, blocks=2))
    small = torch.rand(2, 3, 10, 12)
    assert network(small).shape == (2, 3, 40, 48)
    assert torch.allclose(network(small), _enlarged(small))
    flat = torch.full((1, 3, 32, 32), 0.3)
    assert torch.allclose(downsampled(flat, 8), torch.full((1, 3, 8, 8), 0.3))


def test_training_that_goes_on_comes_to_the_same_weights(tmp_path):
    given = [pairs(), pairs("wrist", "hand")]
    whole = RenderTraining(given, CFG)
    whole.learn()
    calls = 0

    def interrupting(*_):
        nonlocal calls
        calls += 1
        if calls == 2:  # after the first network, within the second
            raise KeyboardInterrupt

    cut = RenderTraining(given, CFG, tmp_path)
    with pytest.raises(KeyboardInterrupt):
        cut.learn(interrupting)
    again = RenderTraining(given, CFG, tmp_path)
    again.resume()
    assert 0 < sum(t.done for t in again.trainings.values()) < 16
    again.learn()
    for name, training in whole.trainings.items():
        for key, value in training.mean.state_dict().items():
            assert torch.equal(value, again.trainings[name].mean.state_dict()[key]), (name, key)


def test_other_settings_are_refused(tmp_path):
    RenderTraining([pairs()], CFG, tmp_path).save()
    with pytest.raises(RenderError, match=r"other settings.*flow.batch 4"):
        RenderTraining([pairs()], replace(CFG, flow=replace(CFG.flow, batch=3)), tmp_path).resume()


def test_images_of_another_size_are_refused():
    with pytest.raises(RenderError, match=r"another size.*128 x 128.*64 x 64"):
        RenderTraining([pairs()], replace(CFG, network=replace(SMALL, size=32)))


def test_networks_that_are_not_there_or_broken_are_reported_in_a_sentence(tmp_path):
    with pytest.raises(RenderError, match="no trained networks"):
        Painter.load(tmp_path)
    (tmp_path / "checkpoint.pt").write_bytes(b"no networks")
    with pytest.raises(RenderError, match="not a checkpoint"):
        Painter.load(tmp_path)


def test_training_learns_what_the_camera_sees_and_paints_it_from_the_simulation(tmp_path):
    # The square of a held-out row is where the simulation has it, not where the previous image had it.
    cfg = replace(
        CFG,
        flow=NetworkTrainCfg(steps=150, batch=8, warm_up=5, learning_rate=3e-3, ema=0.95),
        enlarge=NetworkTrainCfg(steps=20, batch=4, warm_up=2),
        augment=AugmentCfg(blank=0.5),
    )
    given = pairs()
    training = RenderTraining([given], cfg, tmp_path)
    training.learn()
    painter = Painter.load(tmp_path, steps=2)
    painter.begin(1)
    errors = []
    for k in range(8):
        simulated = given.simulated[k].permute(1, 2, 0)[None, None] / 255
        painted = painter.paint(["base"], simulated, [torch.zeros(1, 9)])[0, 0].permute(2, 0, 1)
        errors.append(float((painted - given.real[k] / 255).square().mean()))
    raw = (given.simulated[:8] / 255 - given.real[:8] / 255).square().mean()
    assert 10 * np.log10(float(raw) / np.mean(errors)) > 10


def test_painting_begins_anew_in_the_worlds_asked_for(tmp_path):
    training = RenderTraining([pairs()], CFG, tmp_path)
    training.learn()
    painter = Painter.load(tmp_path)
    painter.begin(2)
    first = painter.small("base").clone()
    painter.paint(["base"], torch.rand(2, 1, 64, 64, 3), [torch.zeros(2, 9)])
    second = painter.small("base").clone()
    painter.begin(2, torch.tensor([True, False]))
    assert torch.equal(painter.small("base")[0], first[0])
    assert torch.equal(painter.small("base")[1], second[1])
    with pytest.raises(RenderError, match="no network was trained"):
        painter.paint(["side"], torch.rand(2, 1, 64, 64, 3), [torch.zeros(2, 9)])


def test_columns_are_those_of_the_rotation():
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_euler("xyz", [[0.3, -1.0, 2.0], [0, 0.5, 0], [-2.0, 1.2, 0.1]])
    quaternion = torch.tensor(turns.as_quat()[:, [3, 0, 1, 2]])
    matrices = turns.as_matrix()
    expected = np.concatenate([matrices[:, :, 0], matrices[:, :, 1]], axis=1)
    assert np.allclose(_columns(quaternion).numpy(), expected)


def test_frame_before_the_first_is_none():
    assert _frames_before([3, 2]).tolist() == [-1, 0, 1, -1, 3]


@pytest.mark.gpu
def test_training_on_a_gpu_goes_on_and_paints(tmp_path):
    cfg = replace(CFG, half=True)
    training = RenderTraining([pairs("wrist", "hand")], cfg, tmp_path, device="cuda:0")
    training.learn()
    again = RenderTraining([pairs("wrist", "hand")], cfg, tmp_path, device="cuda:0")
    again.resume()
    assert again.trainings["wrist"].done == cfg.flow.steps
    painter = Painter.load(tmp_path, device="cuda:0", half=True)
    painter.begin(2)
    painted = painter.paint(["wrist"], torch.rand(2, 1, 64, 64, 3, device="cuda:0"), [torch.zeros(2, 9)])
    assert painted.shape == (2, 1, 64, 64, 3)
    assert painted.device.type == "cuda"
