import torch

from concent_warp.train.learning.normalisation import BoundedNormalization


def test_observations_far_out_are_bounded_and_usual_ones_as_rsl_rl_has_them():
    torch.manual_seed(0)
    normal = BoundedNormalization(3, 10.0)
    seen = torch.randn(4096, 3) * torch.tensor([1.0, 0.1, 5.0]) + 2.0
    normal.update(seen)
    found = normal(seen)
    assert found.mean(dim=0).abs().max() < 1e-3
    assert torch.allclose(found.std(dim=0), torch.tensor([1.0, 0.1 / 0.11, 1.0]), atol=0.02)
    assert normal(torch.full((1, 3), 1e6)).max() == 10.0


def test_a_variance_that_rounding_made_negative_does_not_spoil_what_follows():
    normal = BoundedNormalization(2, 10.0)
    constant = torch.full((8192, 2), 0.3172)
    normal.update(constant)
    normal.get_buffer("_var").fill_(-1e-9)
    normal.update(constant)
    assert normal(constant).isfinite().all()
    assert normal.get_buffer("_var").min() >= 0
