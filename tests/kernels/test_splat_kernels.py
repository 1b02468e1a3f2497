"""The tile rasteriser against float64: images of many worlds, occlusion, lists that overflow, gradients, graphs."""

from typing import Any

import numpy as np
import pytest
import splat_reference
import warp as wp
from rigid_poses import on_each_device

from concent_warp.kernels.splats import blend, projection, tiles
from concent_warp.kernels.splats.splats import SplatArrays, SplatPlan

NAMES = ("means", "quats", "scales", "opacities", "harmonics")


def unit(rng, *shape):
    values = rng.normal(size=shape)
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


class Case:
    """Two objects of splats before two cameras in some worlds, with a wall that hides part of them."""

    def __init__(self, device="cpu", *, worlds=3, count=150, degree=3, width=45, height=37, seed=0, **options):
        rng = np.random.default_rng(seed)
        self.width, self.height, self.worlds = width, height, worlds
        values = {
            "means": rng.uniform(-0.06, 0.06, (count, 3)),
            "quats": rng.normal(size=(count, 4)),
            # From needles to blobs, some far below the size of a pixel.
            "scales": np.exp(rng.uniform(np.log(5e-4), np.log(0.02), (count, 3))),
            "opacities": rng.uniform(0.02, 1.0, count),
            "harmonics": rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.3,
        }
        # Rounded to float32 at once, so that the reference starts from the same numbers.
        self.values = {name: value.astype(np.float32).astype(float) for name, value in values.items()}
        self.owner = (np.arange(count) % 2).astype(np.int32)
        self.objects = np.concatenate([rng.uniform(-0.05, 0.05, (worlds, 2, 3)), unit(rng, worlds, 2, 4)], axis=-1)
        self.objects = self.objects.astype(np.float32).astype(float)
        tilt = unit(rng, worlds, 2, 4) * 0.1 + np.array([1, 0, 0, 0])
        place = np.array([0, 0, 0.3]) + rng.uniform(-0.03, 0.03, (worlds, 2, 3))
        self.cameras = np.concatenate([place, tilt], axis=-1).astype(np.float32).astype(float)
        self.pinholes = np.tile(np.array([1.35 * width, 1.2 * width, 0.47 * width, 0.51 * height]), (worlds, 2, 1))
        self.hidden = np.where(np.arange(width) < width // 3, 0.29, 0.0) * np.ones((2 * worlds, height, 1))
        self.hidden = self.hidden.astype(np.float32).astype(float)
        self.options = {"margin": 0.002, "antialias": True} | options
        kinds: dict[str, Any] = dict(zip(NAMES, (wp.vec3, wp.vec4, wp.vec3, float, wp.vec3), strict=True))
        given: dict[str, Any] = {
            n: wp.array(v.astype(np.float32), dtype=kinds[n], device=device) for n, v in self.values.items()
        }
        self.arrays = SplatArrays(
            **given,
            owner=wp.array(self.owner, device=device),
            object_poses=wp.array(self.objects.astype(np.float32), device=device),
            camera_poses=wp.array(self.cameras.astype(np.float32), device=device),
            pinholes=wp.array(self.pinholes.astype(np.float32), device=device),
            hidden=wp.array(self.hidden.astype(np.float32), device=device),
        )

    def plan(self, capacity=200_000, **options):
        return SplatPlan(self.arrays, self.width, self.height, capacity=capacity, **self.options, **options)

    def reference(self, values=None):
        """Images in float64, shape (worlds * 2, H, W, ...)."""
        splats = (*(values or self.values).values(), self.owner)
        images = [
            splat_reference.render(
                splats, self.objects[w], self.cameras[w, c], self.pinholes[w, c], self.width, self.height,
                hidden=self.hidden[2 * w + c], **self.options,
            )
            for w in range(self.worlds) for c in range(2)
        ]  # fmt: skip
        return [np.stack(kind) for kind in zip(*images, strict=True)]

    def agrees(self, plan):
        """Assert that images are those of the reference, closely; return whether all splats found room."""
        rgb, alpha, depth = self.reference()
        assert 0.1 < alpha.mean() < 0.9
        np.testing.assert_allclose(plan.rgb.numpy(), rgb, atol=2e-4)
        np.testing.assert_allclose(plan.alpha.numpy(), alpha, atol=1e-4)
        solid = alpha > 0.05
        np.testing.assert_allclose(plan.depth.numpy()[solid], depth[solid], rtol=1e-4)
        return not plan.overflow.numpy().any()


@on_each_device
@pytest.mark.parametrize("tile", [8, 16])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_images_match_float64(device, degree, tile):
    case = Case(device, degree=degree)
    plan = case.plan(tile=tile)
    plan.launch()
    assert case.agrees(plan)


@on_each_device
def test_images_without_antialiasing_match_float64(device):
    case = Case(device, antialias=False)
    plan = case.plan()
    plan.launch()
    assert case.agrees(plan)


@on_each_device
def test_shadows_match_splats_flattened_in_float64(device):
    case = Case(device, degree=0)
    light = np.random.default_rng(2).normal(size=(case.worlds, 2, 3)) * 0.4 + np.array([0, 0, -1.5])
    flat = wp.array(light.astype(np.float32), dtype=wp.vec3, device=device)
    case.arrays.hidden.zero_()
    plan = SplatPlan(
        SplatArrays(**{**vars(case.arrays), "light": flat, "ground": -0.1}),
        case.width, case.height, capacity=200_000,
    )  # fmt: skip
    plan.launch()
    for w, c in np.ndindex(case.worlds, 2):
        _, alpha, depth = splat_reference.render(
            (*case.values.values(), case.owner), case.objects[w], case.cameras[w, c], case.pinholes[w, c], case.width,
            case.height, light=light[w, c], ground=-0.1,
        )  # fmt: skip
        assert 0.1 < alpha.mean() < 0.9
        np.testing.assert_allclose(plan.alpha.numpy()[2 * w + c], alpha, atol=2e-4)
        solid = alpha > 0.05
        np.testing.assert_allclose(plan.depth.numpy()[2 * w + c][solid], depth[solid], rtol=1e-4)


@on_each_device
def test_captured_graph_follows_poses(device):
    case = Case(device)
    plan = case.plan()
    plan.launch()
    before = plan.rgb.numpy().copy()
    with wp.ScopedCapture(device=device) as capture:
        plan.launch()
    case.objects = case.objects[:, ::-1].copy()
    case.arrays.object_poses.assign(case.objects.astype(np.float32))
    assert capture.graph is not None
    wp.capture_launch(capture.graph)
    assert np.abs(plan.rgb.numpy() - before).max() > 0.1
    assert case.agrees(plan)


@on_each_device
def test_splats_behind_the_simulation_are_hidden_and_others_not(device):
    case = Case(device)
    plan = case.plan()
    plan.launch()
    near = plan.alpha.numpy().copy()
    case.arrays.hidden.fill_(0.1)
    plan.launch()
    assert not plan.alpha.numpy().any()
    case.arrays.hidden.fill_(10.0)
    plan.launch()
    far = plan.alpha.numpy().copy()
    case.arrays.hidden.zero_()
    plan.launch()
    np.testing.assert_array_equal(plan.alpha.numpy(), far)
    assert (near[..., : case.width // 3] < far[..., : case.width // 3] - 0.1).any()
    np.testing.assert_array_equal(near[..., case.width // 3 :], far[..., case.width // 3 :])


@on_each_device
def test_what_finds_no_room_is_counted_and_leaves_earlier_images_whole(device):
    case = Case(device)
    whole = case.plan()
    whole.launch()
    pairs = whole.pairs.numpy()
    room = int(pairs[:4].sum()) + 5
    short = case.plan(room)
    short.launch()
    np.testing.assert_array_equal(short.pairs.numpy(), pairs)
    np.testing.assert_array_equal(short.overflow.numpy(), [0, 0, 0, 0, pairs[4] - 5, pairs[5]])
    np.testing.assert_array_equal(short.rgb.numpy()[:4], whole.rgb.numpy()[:4])
    assert not short.alpha.numpy()[5].any()


@on_each_device
def test_equal_inputs_give_equal_images_bit_by_bit(device):
    case = Case(device)
    plan = case.plan()
    plan.launch()
    first = [array.numpy().copy() for array in (plan.rgb, plan.alpha, plan.depth)]
    plan.launch()
    for array, before in zip((plan.rgb, plan.alpha, plan.depth), first, strict=True):
        np.testing.assert_array_equal(array.numpy(), before)


@on_each_device
def test_splats_behind_the_camera_and_beyond_the_image_are_left_out(device):
    case = Case(device)
    case.arrays.object_poses.assign((case.objects + np.array([0, 0, 1, 0, 0, 0, 0])).astype(np.float32))
    plan = case.plan()
    plan.launch()
    assert not plan.pairs.numpy().any()
    case.arrays.object_poses.assign((case.objects + np.array([9, 0, 0, 0, 0, 0, 0])).astype(np.float32))
    plan.launch()
    assert not plan.pairs.numpy().any()
    assert not plan.rgb.numpy().any()


@on_each_device
def test_pixels_are_covered_by_the_frontmost(device):
    case = Case(device, count=2, degree=0)
    for name, value in (
        ("means", [[0, 0, 0.05], [0, 0, -0.05]]),
        ("scales", np.full((2, 3), 0.05)),
        ("opacities", np.ones(2)),
        ("harmonics", np.array([[[1.0, 0, 0]], [[0, 1.0, 0]]]) * 3),
    ):
        getattr(case.arrays, name).assign(np.asarray(value, dtype=np.float32))
    case.arrays.object_poses.assign(np.tile(np.array([0, 0, 0, 1, 0, 0, 0], np.float32), (3, 2, 1)))
    case.arrays.camera_poses.assign(np.tile(np.array([0, 0, 0.3, 1, 0, 0, 0], np.float32), (3, 2, 1)))
    case.arrays.hidden.zero_()
    plan = case.plan()
    plan.launch()
    red, green, _ = plan.rgb.numpy()[0, 19, 21]
    assert red > 1.3
    assert green < 0.01 * red + 0.51
    assert plan.depth.numpy()[0, 19, 21] == pytest.approx(0.25, abs=1e-3)


@on_each_device
@pytest.mark.parametrize("antialias", [True, False])
def test_gradients_match_differences_of_float64(device, antialias):
    case = Case(device, worlds=1, count=12, degree=1, width=24, height=20, seed=4, antialias=antialias)
    plan = case.plan(gradient=True)
    plan.launch()
    rng = np.random.default_rng(5)
    weights = [rng.normal(size=kind.shape) for kind in case.reference()]
    # Where next to nothing is seen, its mean depth jumps as Gaussians pass the least opacity.
    weights[2] *= case.reference()[1] > 0.3
    upstream = [
        wp.array(weight.astype(np.float32), dtype=array.dtype, device=device)
        for weight, array in zip(weights, (plan.rgb, plan.alpha, plan.depth), strict=True)
    ]
    plan.backward(*upstream)

    def loss(values):
        return sum(float(np.sum(w * kind)) for w, kind in zip(weights, case.reference(values), strict=True))

    for name in NAMES:
        found = plan.gradients[name].numpy()
        expected = np.zeros_like(found, dtype=float)
        step = {"means": 1e-7, "scales": 1e-8}.get(name, 1e-6)
        for index in np.ndindex(*found.shape):
            change = np.zeros_like(case.values[name])
            change[index] = step
            ends = [loss({**case.values, name: case.values[name] + sign * change}) for sign in (1, -1)]
            expected[index] = (ends[0] - ends[1]) / (2 * step)
        size = np.abs(expected).max()
        assert size > 0.01
        # Central differences over a pixel's switching on or off are far off; hardly any are.
        close = np.abs(found - expected) < 2e-3 * size + 2e-3 * np.abs(expected)
        assert close.mean() > 0.97, (name, found[~close], expected[~close])


def test_what_cannot_be_is_refused():
    case = Case()
    for match, call in (
        ("capacity", lambda: case.plan(0)),
        ("gradient=True", lambda: case.plan().backward(case.arrays.hidden, case.arrays.hidden, case.arrays.hidden)),
        ("quats must be", lambda: SplatArrays(**{**vars(case.arrays), "quats": case.arrays.means})),
        ("1, 4, 9 or 16", lambda: SplatArrays(**{**vars(case.arrays), "harmonics": wp.zeros((150, 5), dtype=wp.vec3)})),
        ("hidden must be", lambda: SplatPlan(case.arrays, 10, 10, capacity=10)),
    ):
        with pytest.raises(ValueError, match=match):
            call()


@pytest.mark.parametrize("module", [projection, tiles, blend])
def test_cuda_kernels_of_splats_compile_without_a_gpu(tmp_path, module):
    (code,) = wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
    assert code.stat().st_size > 0
