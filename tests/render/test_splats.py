import pytest
import torch

from concent_warp.errors import RenderError
from concent_warp.render.splats.splats import Splats
from concent_warp.scene.shapes.objects import load_object


def shell(count=400, degree=2, radius=0.03):
    """Opaque splats on a sphere, denser on one side, as a pattern there would have it."""
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(count, 3, generator=generator)
    means[: count // 2, 0] = means[: count // 2, 0].abs() + 2
    means = radius * means / means.norm(dim=1, keepdim=True)
    harmonics = torch.randn(count, (degree + 1) ** 2, 3, generator=generator)
    return Splats(
        means, torch.randn(count, 4, generator=generator), torch.full((count, 3), 0.002), torch.full((count,), 0.9),
        harmonics,
    )  # fmt: skip


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_splats_survive_the_file(tmp_path, degree):
    splats = shell(degree=degree)
    splats.write(tmp_path / "s.ply")
    again = Splats.read(tmp_path / "s.ply")
    assert again.degree == degree
    for given, read in zip(splats.tensors(), again.tensors(), strict=True):
        if given.shape[-1] == 4:
            given = given / given.norm(dim=1, keepdim=True)
        torch.testing.assert_close(read, given, rtol=1e-5, atol=1e-6)


def test_spread_evens_out_the_density():
    splats = shell()
    chosen = splats.select(splats.spread(50)).means
    assert len(chosen) == 50
    nearest = (torch.cdist(chosen, chosen) + torch.eye(50)).amin(dim=1)
    plain = splats.means[torch.linspace(0, 399, 50).long()]
    assert nearest.min() > 3 * (torch.cdist(plain, plain) + torch.eye(50)).amin(dim=1).min()


def test_written_splats_become_an_object_with_spheres(tmp_path):
    shell().write(tmp_path / "s.ply")
    found = load_object(tmp_path / "s.ply", "thing")
    assert found.mass == pytest.approx(1000 * 4 / 3 * 3.14 * 0.03**3, rel=0.15)


def test_scale_of_a_file_goes_to_lengths_alone(tmp_path):
    shell().write(tmp_path / "s.ply")
    read, small = Splats.read(tmp_path / "s.ply"), Splats.read(tmp_path / "s.ply", scale=0.001)
    torch.testing.assert_close(small.scales, 0.001 * read.scales)
    torch.testing.assert_close(small.means, 0.001 * read.means)
    torch.testing.assert_close(small.harmonics, read.harmonics)


def test_splats_of_odd_shapes_are_refused():
    with pytest.raises(RenderError, match=r"\(3, 5, 3\)"):
        Splats(torch.zeros(3, 3), torch.zeros(3, 4), torch.zeros(3, 3), torch.zeros(3), torch.zeros(3, 5, 3))
