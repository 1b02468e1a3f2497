from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from photographed import ball, cameras, photographed

from concent_warp.errors import RenderError, SceneError
from concent_warp.render.splats.cfg import RatesCfg, SplatFitCfg
from concent_warp.render.splats.fit import SplatFit, _turned
from concent_warp.render.splats.initial import read_start, visual_hull
from concent_warp.render.splats.splats import Splats

CFG = SplatFitCfg(
    iterations=120, start=500, most=800, every=40, degree=0, rates=RatesCfg(scales=0.03, opacities=0.1, colour=0.05)
)


@pytest.fixture(scope="module")
def views():
    return photographed(24)


@pytest.fixture(scope="module")
def hull(views):
    return visual_hull(views, 500, np.random.default_rng(0))


def test_hull_of_the_masks_is_the_object(hull):
    radius = np.linalg.norm(hull, axis=1)
    assert len(hull) == 500
    # The silhouette of the splats lies a little outside of their centres, at 30 mm.
    assert 0.03 < np.median(radius) < 0.037
    assert np.abs(hull.mean(axis=0)).max() < 0.002


def test_fit_shows_views_that_it_has_not_seen(views, hull):
    fit = SplatFit(views, hull, CFG)
    before = np.mean([score.psnr for score in fit.evaluate()])
    splats = fit.learn()
    after = fit.evaluate()
    assert [score.view for score in after] == [7, 15, 23]
    assert np.mean([score.psnr for score in after]) > max(25, before + 8)
    assert all(score.psnr_object < score.psnr for score in after)
    assert 500 < len(splats) <= 800
    assert 0.025 < splats.means.norm(dim=1).quantile(0.5) < 0.035


def test_fit_with_several_views_a_step_and_harmonics_descends(views, hull):
    fit = SplatFit(views, hull[:200], replace(CFG, views=3, degree=2, iterations=15))
    losses = [float(fit.step()) for _ in range(15)]
    assert losses[-1] < 0.85 * losses[0]
    assert fit.parameters["rest"].abs().max() > 0


def test_interrupted_fit_goes_on_to_the_same_result(views, hull, tmp_path):
    cfg = replace(CFG, iterations=30, every=10)
    whole = SplatFit(views, hull[:200], cfg)
    expected = whole.learn()
    broken = SplatFit(views, hull[:200], cfg)
    for _ in range(14):
        broken.step()
    broken.save(tmp_path / "checkpoint.npz")
    again = SplatFit(views, hull[:200], cfg)
    again.resume(tmp_path / "checkpoint.npz")
    assert again.iteration == 14
    for one, other in zip(again.learn().tensors(), expected.tensors(), strict=True):
        assert torch.equal(one, other)


def test_checkpoint_of_other_images_or_broken_is_refused(views, hull, tmp_path):
    cfg = replace(CFG, iterations=1)
    fit = SplatFit(views, hull, cfg)
    fit.learn(checkpoint=tmp_path / "c.npz")
    with pytest.raises(RenderError, match="other images"):
        SplatFit(photographed(4), hull, cfg).resume(tmp_path / "c.npz")
    (tmp_path / "c.npz").write_bytes((tmp_path / "c.npz").read_bytes()[:-200])
    with pytest.raises(RenderError, match="not a checkpoint"):
        fit.resume(tmp_path / "c.npz")


def test_faint_splats_go_and_split_ones_cover_the_same(views, hull):
    fit = SplatFit(views, hull[:200], replace(CFG, grow=0.1))
    fit.step()
    with torch.no_grad():
        fit.parameters["opacities"][:50] = -8
    before = Splats(*(t.detach().clone() for t in fit.splats().tensors()))
    where = before.means[50:].mean(dim=0)
    fit.reshape()
    after = Splats(*(t.detach() for t in fit.splats().tensors()))
    assert len(after) == 150 + 20
    assert after.opacities.min() > 0.1
    torch.testing.assert_close(after.means.mean(dim=0), where, atol=2e-3, rtol=0)
    through = (1 - after.opacities[-40:-20]) * (1 - after.opacities[-20:])
    torch.testing.assert_close(1 - through, before.opacities[60:80], atol=0.05, rtol=0)


def test_start_from_a_mesh_or_from_splats(tmp_path):
    trimesh.creation.icosphere(radius=30).export(tmp_path / "ball.stl")
    rng = np.random.default_rng(0)
    points = read_start(tmp_path / "ball.stl", 300, 0.001, rng)
    assert points.shape == (300, 3)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.03, atol=0.001)
    ball(200).write(tmp_path / "ball.ply")
    assert len(read_start(tmp_path / "ball.ply", 50, 1.0, rng)) == 50
    with pytest.raises(SceneError, match="no such file"):
        read_start(tmp_path / "none.ply", 50, 1.0, rng)


def test_what_cannot_be_fitted_is_refused(views, hull):
    mirrored = replace(views, poses=views.poses @ np.diag([1.0, -1.0, -1.0, 1.0]))
    with pytest.raises(RenderError, match="no volume in common"):
        visual_hull(mirrored, 100, np.random.default_rng(0))
    with pytest.raises(RenderError, match="alpha channel"):
        visual_hull(replace(views, masked=False), 100, np.random.default_rng(0))
    still = replace(views, poses=np.tile(cameras(1), (24, 1, 1)), rgba=np.tile(views.rgba[:1], (24, 1, 1, 1)))
    with pytest.raises(RenderError, match="several sides"):
        visual_hull(still, 100, np.random.default_rng(0))
    with pytest.raises(RenderError, match="too few points"):
        SplatFit(views, hull[:5], CFG)
    with pytest.raises(RenderError, match="no images are left"):
        SplatFit(views, hull, replace(CFG, held_out=1))
    with pytest.raises(RenderError, match="degree is out of bounds; expected at least 0 and at most 3"):
        replace(CFG, degree=4)


def test_vectors_are_turned_as_by_scipy():
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(0)
    quats, vectors = rng.normal(size=(20, 4)), rng.normal(size=(20, 3))
    expected = Rotation.from_quat(quats, scalar_first=True).apply(vectors)
    np.testing.assert_allclose(_turned(torch.tensor(quats), torch.tensor(vectors)), expected)
