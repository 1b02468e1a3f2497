import math

import pytest
import torch

from concent_warp.errors import RenderError
from concent_warp.render.shadows import ShadowCfg, Shadows, with_shadow
from concent_warp.render.splats.rasterise import intrinsics_of
from concent_warp.render.splats.splats import Splats

SIZE = 96
INTRINSICS = intrinsics_of(15.0, SIZE, SIZE)
ABOVE = torch.tensor([[0.0, 0, 0.6, 1, 0, 0, 0]])
FOCAL = float(INTRINSICS[0, 0])
HARD = ShadowCfg(lights=1, softness=0.0)


def ball(count=1500, radius=0.02):
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(count, 3, generator=generator)
    return Splats(
        radius * means / means.norm(dim=1, keepdim=True), torch.randn(count, 4, generator=generator),
        torch.full((count, 3), 0.0006), torch.full((count,), 0.95), torch.zeros(count, 1, 3),
    )  # fmt: skip


def at(*positions):
    return torch.tensor([[[*p, 1.0, 0, 0, 0]] for p in positions])


def centre(shadow):
    """Middle of a shadow seen from above [m], x and y in the world."""
    row, column = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    middle = (SIZE - 1) / 2
    x = float((shadow * (column - middle)).sum() / shadow.sum()) * 0.6 / FOCAL
    y = float((shadow * (middle - row)).sum() / shadow.sum()) * 0.6 / FOCAL
    return x, y


def test_shadow_falls_where_the_light_throws_it_and_is_as_large_as_the_body():
    shadows = Shadows([ball()], SIZE, SIZE, 2, 1, cfg=HARD)
    for world, direction in enumerate(([0.5, 0.0, -1.0], [0.0, -1.0, -1.0])):
        shadows.directions[world, 0] = torch.tensor(direction)
    shadows.strengths[:] = 1.0
    shadow = shadows.render(at((0.0, 0, 0.06), (0.01, 0, 0.02)), ABOVE, INTRINSICS)
    assert centre(shadow[0, 0]) == pytest.approx((0.03, 0), abs=1e-3)
    assert centre(shadow[1, 0]) == pytest.approx((0.01, -0.02), abs=1e-3)
    # A ball's shadow is an ellipse, drawn out along the light by one over the sine of its elevation.
    area = float(shadow[0, 0].sum()) * (0.6 / FOCAL) ** 2
    assert area == pytest.approx(math.pi * 0.02**2 * math.hypot(0.5, 1), rel=0.2)
    assert shadow[0, 0].max() > 0.98


def test_what_stands_before_the_table_hides_the_shadow_and_the_table_does_not():
    shadows = Shadows([ball()], SIZE, SIZE, cfg=HARD)
    pose = at((0.0, 0, 0.05))
    free = shadows.render(pose, ABOVE, INTRINSICS)
    table = torch.full((1, 1, SIZE, SIZE), 0.6)
    torch.testing.assert_close(shadows.render(pose, ABOVE, INTRINSICS, table), free)
    assert free.max() > 0.05
    assert not shadows.render(pose, ABOVE, INTRINSICS, table - 0.1).any()


def test_lights_of_new_episodes_are_sampled_and_others_stay():
    shadows = Shadows([ball(50)], 16, 16, 4, generator=torch.Generator().manual_seed(3))
    before = shadows.directions.clone(), shadows.strengths.clone()
    shadows.sample_lights(torch.tensor([True, False, True, False]))
    for kept, new in zip(before, (shadows.directions, shadows.strengths), strict=True):
        assert torch.equal(kept[1::2], new[1::2])
        assert (kept[::2] != new[::2]).any(dim=-1).all()
    again = Shadows([ball(50)], 16, 16, 4, generator=torch.Generator().manual_seed(3))
    assert torch.equal(again.directions, before[0])


def test_sampled_lights_keep_within_their_bounds():
    shadows = Shadows([ball(50)], 16, 16, 500, cfg=ShadowCfg(elevation=(40.0, 60.0), strength=(0.2, 0.3)))
    elevation = torch.rad2deg(torch.asin(-shadows.directions[..., 2]))
    assert 40 <= elevation.min() < 42
    assert 58 < elevation.max() <= 60
    assert 0.2 <= shadows.strengths.min() < 0.21
    azimuth = torch.atan2(shadows.directions[..., 1], shadows.directions[..., 0])
    assert torch.histc(azimuth, 4).min() > 180


def test_cameras_see_the_shadows_of_their_world_and_lights_add_up():
    seeded = torch.Generator().manual_seed(0)
    shadows = Shadows([ball()], SIZE, SIZE, 2, 2, cfg=ShadowCfg(softness=0.0), generator=seeded)
    farther = torch.stack([ABOVE[0], ABOVE[0] + torch.tensor([0.0, 0, 0.3, 0, 0, 0, 0])])
    shadow = shadows.render(at((0.0, 0, 0.02), (0.02, 0, 0.02)), farther, INTRINSICS)
    assert shadow.shape == (2, 2, SIZE, SIZE)
    assert float(shadow[0, 1].sum() / shadow[0, 0].sum()) == pytest.approx((0.6 / 0.9) ** 2, rel=0.2)
    assert not torch.allclose(shadow[0, 0], shadow[1, 0])
    alone = Shadows([ball()], SIZE, SIZE, cfg=HARD)
    light = torch.ones(SIZE, SIZE)
    for k in range(2):
        alone.directions[0], alone.strengths[0] = shadows.directions[0, k], shadows.strengths[0, k]
        light *= 1 - alone.render(at((0.0, 0, 0.02)), ABOVE, INTRINSICS)[0, 0]
    torch.testing.assert_close(shadow[0, 0], 1 - light)


def test_soft_shadows_keep_their_sum_and_lose_their_edge():
    pose = at((0.0, 0, 0.02))
    hard = Shadows([ball()], SIZE, SIZE, cfg=HARD)
    soft = Shadows([ball()], SIZE, SIZE, cfg=ShadowCfg(lights=1, softness=0.03))
    soft.directions.copy_(hard.directions)
    soft.strengths.copy_(hard.strengths)
    sharp, blurred = (s.render(pose, ABOVE, INTRINSICS)[0, 0] for s in (hard, soft))
    assert float(blurred.sum()) == pytest.approx(float(sharp.sum()), rel=1e-3)
    assert blurred.diff(dim=1).abs().max() < 0.5 * sharp.diff(dim=1).abs().max()


def test_shaded_image_loses_the_share_that_the_shadow_takes():
    shadow = torch.tensor([[0.0, 0.5]])
    torch.testing.assert_close(with_shadow(torch.ones(1, 2, 3), shadow), torch.tensor([[[1.0] * 3, [0.5] * 3]]))


def test_lights_that_cannot_be_are_refused():
    for make in (
        lambda: ShadowCfg(lights=0),
        lambda: ShadowCfg(elevation=(0.0, 50.0)),
        lambda: ShadowCfg(elevation=(60.0, 50.0)),
        lambda: ShadowCfg(strength=(0.1, 1.2)),
    ):
        with pytest.raises(RenderError, match="is out of bounds"):
            make()
