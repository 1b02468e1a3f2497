"""Augmentation, samples, delay and network of a student, each by itself."""

from types import SimpleNamespace

import pytest
import torch

import concent_warp as cw
from concent_warp.errors import TrainError
from concent_warp.train.distil.augmentation import augmented
from concent_warp.train.distil.cfg import DistilCfg
from concent_warp.train.distil.images import DelayedImages
from concent_warp.train.distil.network import CameraEncoder, StudentNetwork
from concent_warp.train.distil.samples import Samples

NOTHING = cw.AugmentCfg(
    shift=0, brightness=0.0, contrast=0.0, balance=0.0, gamma=(1.0, 1.0), vignette=0.0, noise=0.0, blur=0.0
)


def test_augmentation_without_changes_leaves_images():
    images = torch.rand(3, 2, 3, 8, 8).clamp(0.01, 1)
    assert torch.allclose(augmented(images, NOTHING), images, atol=1e-6)


def test_a_shift_moves_whole_images_by_at_most_its_bound():
    images = torch.zeros(64, 1, 3, 9, 9)
    images[..., 4, 4] = 1
    moved = augmented(images, cw.AugmentCfg(**{**NOTHING.__dict__, "shift": 2}))
    place = moved[:, 0, 0].flatten(1).argmax(dim=1)
    rows, columns = place // 9 - 4, place % 9 - 4
    assert int(rows.abs().max()) == 2
    assert int(columns.abs().max()) == 2
    assert torch.equal(moved[:, 0, 0], moved[:, 0, 2])


def test_augmented_colours_stay_within_0_and_1_and_differ_between_samples():
    images = torch.rand(1, 2, 3, 16, 16).repeat(8, 1, 1, 1, 1)
    changed = augmented(images, cw.AugmentCfg())
    assert float(changed.min()) >= 0
    assert float(changed.max()) <= 1
    assert float((changed[0] - changed[1]).abs().mean()) > 0.01


def ring(capacity: int = 5) -> Samples:
    return Samples(capacity, (2, 3, 4, 4), (6, 3, 9), "cpu")


def add(samples: Samples, *numbers: int) -> None:
    n = len(numbers)
    value = torch.tensor(numbers)
    images = value.view(-1, 1, 1, 1, 1).expand(n, 2, 3, 4, 4).to(torch.uint8)
    parts = (value[:, None].expand(n, width).float() for width in (6, 3, 9))
    samples.add(images, *parts)


def test_the_ring_keeps_the_latest_samples():
    samples = ring()
    add(samples, 1, 2, 3)
    assert len(samples) == 3
    add(samples, 4, 5, 6, 7)
    assert sorted(samples.action[:, 0].tolist()) == [3, 4, 5, 6, 7]
    images, own, action, poses = samples.pick(40)
    assert torch.equal(images[:, 0, 0, 0, 0].float(), action[:, 0])
    assert torch.equal(own[:, 0], poses[:, 0])


def test_samples_are_read_as_they_were_written(tmp_path):
    samples, again = ring(), ring()
    add(samples, 1, 2, 3, 4)
    samples.save(tmp_path / "samples.bin")
    again.load(tmp_path / "samples.bin", len(samples), samples.next)
    for kept, read in zip(samples._parts(), again._parts(), strict=True):
        assert torch.equal(kept[:4], read[:4])


def test_samples_that_are_cut_short_are_refused(tmp_path):
    samples = ring()
    add(samples, 1, 2, 3, 4)
    samples.save(tmp_path / "samples.bin")
    content = (tmp_path / "samples.bin").read_bytes()
    (tmp_path / "samples.bin").write_bytes(content[:-1])
    with pytest.raises(TrainError, match="samples of the training are not there"):
        ring().load(tmp_path / "samples.bin", 4, 4)


class Counter:
    """Images of one pixel that count the calls."""

    cameras, size = ("base",), 1

    def __init__(self) -> None:
        self.calls = 0

    def begin(self, which: torch.Tensor) -> None:
        del which

    def render(self, qpos: torch.Tensor, mocap: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        del mocap
        self.calls += 1
        return torch.full((len(qpos), 1, 3, 1, 1), self.calls, dtype=torch.uint8)

    def state(self) -> dict[str, torch.Tensor]:
        return {}

    def restore(self, state: dict[str, torch.Tensor]) -> None:
        del state


def test_images_are_as_late_as_their_delay_and_begin_anew_with_an_episode():
    worlds = SimpleNamespace(physics=SimpleNamespace(qpos=torch.zeros(2, 1), mocap=(torch.zeros(2, 0, 3),) * 2))
    line = DelayedImages(Counter(), 2, (1, 1))
    seen = []
    for k in range(5):
        started = torch.tensor([k == 0, k in (0, 3)])
        seen.append(line.look(worlds, started)[:, 0, ::3, 0, 0].tolist())  # pyright: ignore[reportArgumentType]
    # Each has the image of one step before, and that of two steps before.
    assert [one[0] for one in seen] == [[1, 1], [1, 1], [2, 1], [3, 2], [4, 3]]
    assert [one[1] for one in seen] == [[1, 1], [1, 1], [2, 1], [4, 4], [4, 4]]


def test_a_keypoint_follows_a_bright_spot():
    torch.manual_seed(0)
    encoder = CameraEncoder(3, cw.StudentNetworkCfg(channels=(8, 8), keypoints=8, blocks=0))
    places = torch.zeros(2, 8, 2)
    for k, column in enumerate((6, 26)):
        image = -torch.ones(1, 3, 32, 32)
        image[..., 14:18, column - 2 : column + 2] = 1
        with torch.no_grad():
            # Sharp scores: random weights prefer no place by much.
            encoder.scores.weight.mul_(50 if k == 0 else 1)
            places[k] = encoder(image)[0, :16].view(2, 8).T
    moved = (places[1] - places[0]).abs()
    across, down = moved[moved[:, 0].argmax()].tolist()
    assert across > 0.5
    assert down < 0.3 * across


def network(**settings: bool) -> StudentNetwork:
    torch.manual_seed(0)
    cfg = cw.StudentNetworkCfg(channels=(8, 8), keypoints=4, hidden=(16,), **settings)
    return StudentNetwork(2, 1, 5, 3, 2, cfg).eval()


def test_an_action_changes_with_the_image_unless_the_student_is_blind():
    own = torch.zeros(1, 5)
    dark, bright = torch.zeros(1, 2, 3, 16, 16), torch.rand(1, 2, 3, 16, 16)
    with torch.no_grad():
        seeing, blind = network(), network(blind=True)
        assert float((seeing(dark, own) - seeing(bright, own)).abs().max()) > 1e-4
        assert torch.equal(blind(dark, own), blind(bright, own))
        assert float((blind(dark, own) - blind(dark, own + 1)).abs().max()) > 1e-4


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"images": cw.ImagesCfg(cameras=("base", "base"))}, "each once"),
        ({"images": cw.ImagesCfg(delay=(2, 1))}, "smallest and a largest"),
        ({"network": cw.StudentNetworkCfg(channels=(12,))}, "multiples of 8"),
        ({"network": cw.StudentNetworkCfg(hidden=())}, "at least one layer"),
        ({"dagger": cw.DaggerCfg(beta=1.5)}, "at most 1"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, said):
    with pytest.raises(TrainError, match=said):
        DistilCfg(**settings)


def test_settings_are_read_as_they_were_written(tmp_path):
    cfg = cw.DistilCfg(seed=3, states=7, images=cw.ImagesCfg(cameras=("wrist",), delay=(1, 3)))
    cfg.save(tmp_path / "distil.toml")
    assert DistilCfg.load(tmp_path / "distil.toml") == cfg
