import pytest
import torch
import warp as wp

from concent_warp.errors import RenderError
from concent_warp.render.splats.rasterise import Rasteriser, intrinsics_of
from concent_warp.render.splats.splats import Splats

STILL = torch.tensor([0.0, 0, 0, 1, 0, 0, 0])


def ball(colour, count=300, radius=0.02, degree=0, seed=0):
    """Opaque splats on a sphere, of one colour."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.randn(count, 3, generator=generator)
    harmonics = torch.zeros(count, (degree + 1) ** 2, 3)
    harmonics[:, 0] = (torch.tensor(colour) - 0.5) / 0.28209479
    return Splats(
        radius * means / means.norm(dim=1, keepdim=True), torch.randn(count, 4, generator=generator),
        torch.full((count, 3), 0.004), torch.full((count,), 0.95), harmonics,
    )  # fmt: skip


def poses(*positions):
    return torch.tensor([[*p, 1, 0, 0, 0] for p in positions])


@pytest.fixture(scope="module")
def pair():
    """Two balls in three worlds, a camera above and one from the side."""
    rasteriser = Rasteriser([ball([1.0, 0, 0]), ball([0, 0, 1.0], degree=2)], 48, 40, 3, 2)
    objects = torch.stack([poses((0.03 * w, 0, 0), (0, 0.07, 0.01)) for w in range(3)])
    half = 0.5**0.5
    cameras = torch.tensor([[0, 0, 0.4, 1, 0, 0, 0], [0, -0.4, 0, half, half, 0, 0]])
    return rasteriser, objects, cameras, intrinsics_of(30.0, 48, 40)


def test_objects_are_seen_where_their_poses_put_them(pair):
    rasteriser, objects, cameras, intrinsics = pair
    layer = rasteriser.render(objects, cameras, intrinsics)
    assert layer.rgb.shape == (3, 2, 40, 48, 3)
    focal = float(intrinsics[0, 0])
    row, column = torch.meshgrid(torch.arange(40.0), torch.arange(48.0), indexing="ij")
    for world in range(3):
        weight = layer.rgb[world, 0, ..., 0]
        assert float((weight * column).sum() / weight.sum()) == pytest.approx(
            23.5 + focal * 0.03 * world / 0.4, abs=0.3
        )
        assert float((weight * row).sum() / weight.sum()) == pytest.approx(19.5, abs=0.3)
        blue = layer.rgb[world, 0, ..., 2]
        # y is up in the image of a camera that looks down with its y along the world's.
        assert float((blue * row).sum() / blue.sum()) == pytest.approx(19.5 - focal * 0.07 / 0.39, abs=0.4)
    # From the side, red is in front and nearer by its radius.
    assert float(layer.depth[0, 1, 19, 23]) == pytest.approx(0.38, abs=0.004)
    assert layer.rgb[0, 1, 19, 23, 2] < 0.05
    rasteriser.check_room()


def test_depth_of_the_simulation_hides_what_is_behind_and_zero_hides_nothing(pair):
    rasteriser, objects, cameras, intrinsics = pair
    free = rasteriser.render(objects, cameras, intrinsics).alpha.clone()
    wall = torch.zeros(3, 2, 40, 48)
    wall[:, 0, :, 24:] = 0.2
    layer = rasteriser.render(objects, cameras, intrinsics, wall)
    torch.testing.assert_close(layer.alpha[:, :, :, :24], free[:, :, :, :24])
    assert free[:, 0, :, 24:].sum() > 100
    assert not layer.alpha[:, 0, :, 24:].any()
    torch.testing.assert_close(layer.alpha[:, 1], free[:, 1])


def test_worlds_are_rendered_as_alone(pair):
    rasteriser, objects, cameras, intrinsics = pair
    together = rasteriser.render(objects, cameras, intrinsics)
    alone = Rasteriser([ball([1.0, 0, 0]), ball([0, 0, 1.0], degree=2)], 48, 40, 1, 2)
    for world in range(3):
        layer = alone.render(objects[world : world + 1], cameras, intrinsics)
        for one, of_many in zip(layer, together, strict=True):
            torch.testing.assert_close(one[0], of_many[world], rtol=0, atol=0)


def test_room_is_measured_at_first_and_lack_of_it_is_reported():
    objects, camera = poses((0.0, 0, 0))[None], poses((0.0, 0, 0.4))
    rasteriser = Rasteriser([ball([1.0, 0, 0])], 64, 64, capacity=50)
    rasteriser.render(objects, camera, intrinsics_of(10.0, 64, 64))
    assert int(rasteriser.overflow) == int(rasteriser.pairs) - 50
    with pytest.raises(RenderError, match=f"capacity of {int(rasteriser.pairs)} or more"):
        rasteriser.check_room()
    measuring = Rasteriser([ball([1.0, 0, 0])], 64, 64)
    measuring.render(objects, camera, intrinsics_of(10.0, 64, 64))
    assert measuring.plan.capacity == 2 * int(rasteriser.pairs)
    measuring.check_room()


def test_room_is_made_when_a_camera_comes_near():
    objects = poses((0.0, 0, 0))[None]
    growing, ample = (Rasteriser([ball([1.0, 0, 0])], 64, 64, capacity=room) for room in (None, 100_000))
    for height in (0.8, 0.06):
        found = [r.render(objects, poses((0.0, 0, height)), intrinsics_of(30.0, 64, 64)) for r in (growing, ample)]
        growing.check_room()
        assert torch.equal(found[0].rgb, found[1].rgb)


def test_recorded_launch_follows_the_buffers(pair):
    rasteriser, objects, cameras, intrinsics = pair
    rasteriser.render(objects, cameras, intrinsics)
    with wp.ScopedCapture(device="cpu") as capture:
        rasteriser.launch()
    expected = rasteriser.render(objects.flip(0), cameras, intrinsics).rgb.clone()
    rasteriser.render(objects, cameras, intrinsics)
    rasteriser.object_poses.copy_(objects.flip(0))
    assert capture.graph is not None
    wp.capture_launch(capture.graph)
    assert torch.equal(rasteriser.layer().rgb, expected)


def test_gradients_flow_to_every_parameter():
    splats = ball([0.4, 0.6, 0.2], count=60, degree=1)
    rasteriser = Rasteriser([splats], 32, 32, gradient=True)
    leaves = [t.clone().requires_grad_() for t in splats.tensors()]
    view = (STILL[None, None], poses((0.0, 0, 0.3)), intrinsics_of(12.0, 32, 32))
    layer = rasteriser.differentiable([Splats(*leaves)], *view)
    target = layer.rgb.detach().roll(2, dims=2)

    def loss():
        return (rasteriser.differentiable([Splats(*leaves)], *view).rgb - target).square().sum()

    before = loss()
    before.backward()
    for leaf, rate in zip(leaves, (1e-8, 1e-5, 1e-8, 1e-5, 1e-5), strict=True):
        gradient = leaf.grad
        assert gradient is not None
        assert gradient.abs().max() > 0
        # A small step down each gradient takes off what the gradient says.
        with torch.no_grad():
            leaf -= rate * gradient
            gained = float(before - loss())
            assert gained == pytest.approx(rate * float(gradient.square().sum()), rel=0.2)
            leaf += rate * gradient


def test_gradients_of_overwritten_images_are_refused():
    splats = ball([0.4, 0.6, 0.2], count=60)
    splats = Splats(splats.means.requires_grad_(), *splats.tensors()[1:])
    rasteriser = Rasteriser([splats], 32, 32, gradient=True)
    view = (STILL[None, None], poses((0.0, 0, 0.3)), intrinsics_of(12.0, 32, 32))
    first = rasteriser.differentiable([splats], *view)
    rasteriser.differentiable([splats], *view)
    with pytest.raises(RuntimeError, match="before these gradients"):
        first.rgb.sum().backward()


def test_what_cannot_be_rendered_is_refused(pair):
    rasteriser, objects, cameras, intrinsics = pair
    with pytest.raises(RenderError, match="nothing to rasterise"):
        Rasteriser([], 4, 4)
    with pytest.raises(RenderError, match=r"object_poses .* \(3, 2, 7\), found \(2, 2, 7\)"):
        rasteriser.render(objects[:2], cameras, intrinsics)
    with pytest.raises(RenderError, match=r"intrinsics .* \(3, 2, 3, 3\)"):
        rasteriser.render(objects, cameras, intrinsics.expand(5, 1, 3, 3))
    with pytest.raises(RenderError, match="degree 2"):
        rasteriser.differentiable([ball([1.0, 0, 0])], objects, cameras, intrinsics)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_shows_what_the_cpu_does_also_from_recorded_graphs(pair):
    rasteriser, objects, cameras, intrinsics = pair
    expected = rasteriser.render(objects, cameras, intrinsics).rgb.clone()
    on_gpu = Rasteriser([ball([1.0, 0, 0]), ball([0, 0, 1.0], degree=2)], 48, 40, 3, 2, device="cuda")
    found = on_gpu.render(objects.cuda(), cameras.cuda(), intrinsics.cuda()).rgb
    torch.testing.assert_close(found.cpu(), expected, atol=1e-4, rtol=0)
    with wp.ScopedCapture(device="cuda:0") as capture:
        on_gpu.launch()
    found.zero_()
    torch.cuda.synchronize()
    assert capture.graph is not None
    wp.capture_launch(capture.graph)
    wp.synchronize_device("cuda:0")
    torch.testing.assert_close(found.cpu(), expected, atol=1e-4, rtol=0)
