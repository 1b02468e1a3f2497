"""What a student sees: ray-traced images under random looks, hybrid images, and those of Reality's cameras."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import concent_warp as cw
from concent_warp.deploy.reality_images import RealityImages
from concent_warp.deploy.reality_world import reality_environment, reality_world
from concent_warp.deploy.simulated_images import RandomisedImages, simulated_images
from concent_warp.errors import RenderError
from concent_warp.reality.sensors.live_cameras import LiveCamerasCfg
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.worlds import make_environment
from tests.render.photographed import ball

SIZE = 32
IMAGES = cw.ImagesCfg(size=SIZE, samples=1, shadows=False)
STILL = cw.LooksCfg(
    colour=0.0, hue_share=0.0, pattern=0.0, grain_share=0.0, light_elevation=(60.0, 60.0), light_strength=(0.5, 0.5),
    light_tint=0.0, ambient=(0.1, 0.1), camera_position=0.0, camera_angle=0.0, size=0.0, chamfer=(0.0, 0.0),
)  # fmt: skip
"""Looks of which only the direction of the lights varies."""
ALL = torch.ones(2, dtype=torch.bool)
BASE, WRIST = 0, 1


@pytest.fixture(scope="module")
def environment(teacher: cw.Policy) -> Environment:
    run = teacher.run
    task = run.task()
    states = run.evaluation_states(task, 2, 0)
    made = make_environment(task, replace(run.cfg.environment, worlds=2), states, device="cpu")
    made.start_from([0, 0])
    return made


def seen(source: RandomisedImages, environment: Environment) -> np.ndarray:
    """Return images of both worlds, float, shape (2, cameras, 3, SIZE, SIZE)."""
    physics = environment.physics
    return source.render(physics.qpos, physics.mocap).clone().numpy().astype(float)


def test_worlds_look_different_and_the_same_until_an_episode_begins(environment):
    source = RandomisedImages(environment.task, 2, IMAGES, cw.LooksCfg(), "cpu")
    torch.manual_seed(0)
    source.begin(ALL)
    first = seen(source, environment)
    assert first.shape == (2, 2, 3, SIZE, SIZE)
    assert np.abs(first[0] - first[1]).mean() > 10
    assert np.array_equal(seen(source, environment), first)
    source.begin(torch.tensor([False, True]))
    second = seen(source, environment)
    assert np.array_equal(second[0], first[0])
    assert np.abs(second[1] - first[1]).mean() > 10


def test_looks_are_restored(environment):
    source = RandomisedImages(environment.task, 2, IMAGES, cw.LooksCfg(), "cpu")
    source.begin(ALL)
    first, state = seen(source, environment), source.state()
    source.begin(ALL)
    assert not np.array_equal(seen(source, environment), first)
    source.restore(state)
    assert np.array_equal(seen(source, environment), first)


@pytest.mark.parametrize("looks", [{"pattern": 1.0}, {"grain_share": 1.0, "grain": 1.0}])
def test_patterns_change_the_brightness_of_surfaces_by_their_contrast(environment, looks):
    plain = RandomisedImages(environment.task, 2, IMAGES, STILL, "cpu")
    patterned = RandomisedImages(environment.task, 2, IMAGES, replace(STILL, **looks), "cpu")
    images = []
    for source in (plain, patterned):
        torch.manual_seed(3)
        source.begin(ALL)
        images.append(seen(source, environment))
    lit = (images[0].min(axis=2) > 20) & (np.maximum(*images).max(axis=2) < 250)
    ratio = np.moveaxis(images[1] / np.maximum(images[0], 1), 2, -1)[lit]
    assert ratio.std() > 0.05
    assert ratio.max() < 2.1
    # A pattern is grey: it changes the colours alike.
    assert np.abs(ratio - ratio.mean(axis=1, keepdims=True)).max() < 0.15


@pytest.mark.parametrize("looks", [{"size": 0.4}, {"chamfer": (0.0, 0.015)}])
def test_objects_are_drawn_in_other_shapes_and_nothing_else_is(environment, looks):
    images = []
    for one in (STILL, replace(STILL, **looks)):
        source = RandomisedImages(environment.task, 2, IMAGES, one, "cpu")
        torch.manual_seed(3)
        source.begin(ALL)
        light = source.state()
        for name in ("light_pos", "light_dir", "background"):  # the same for both worlds
            light[name] = light[name][:1].expand_as(light[name]).clone()
        source.restore(light)
        images.append(seen(source, environment)[:, BASE])
    alike, other = (np.abs(one[0] - one[1]).max(axis=0) > 20 for one in images)
    assert not alike.any()
    assert 0 < other.sum() < 0.05 * SIZE**2


def test_stripes_run_in_one_direction(environment):
    source = RandomisedImages(environment.task, 2, IMAGES, replace(STILL, pattern=1.0, stripe_share=1.0), "cpu")
    source.begin(ALL)
    waves = source.state()["waves"][..., :3]
    across = torch.linalg.cross(waves, waves[:, :, :1].expand_as(waves))
    assert float(across.abs().max()) < 1e-3 * float(waves.square().sum(dim=-1).max())


def test_grains_have_their_size(environment):
    changes = []
    for length in (5.0, 0.01):
        looks = replace(STILL, grain_share=1.0, grain=1.0, grain_length=(length, length))
        images = []
        for one in (STILL, looks):
            source = RandomisedImages(environment.task, 2, IMAGES, one, "cpu")
            torch.manual_seed(3)
            source.begin(ALL)
            images.append(seen(source, environment)[:, BASE, :, SIZE // 2 :])  # mostly the table
        changes.append(np.median(np.abs(np.diff(images[1] / np.maximum(images[0], 1), axis=-1))))
    # A cell as large as the scene changes the table evenly, small ones from pixel to pixel.
    assert changes[0] < 0.02
    assert changes[1] > 0.1


def test_a_camera_that_is_displaced_sees_the_scene_from_elsewhere(environment):
    torch.manual_seed(0)
    still = RandomisedImages(environment.task, 2, IMAGES, STILL, "cpu")
    moved = RandomisedImages(environment.task, 2, IMAGES, replace(STILL, camera_angle=5.0), "cpu")
    for source in (still, moved):
        torch.manual_seed(0)
        source.begin(ALL)
    offset = still._stage.camera_poses(IMAGES.cameras), moved._stage.camera_poses(IMAGES.cameras)
    for source in (still, moved):
        seen(source, environment)
    offset = tuple(source._stage.camera_poses(IMAGES.cameras).numpy() for source in (still, moved))
    assert np.allclose(offset[0][..., :3], offset[1][..., :3], atol=1e-5)
    cosine = np.abs((offset[0][..., 3:] * offset[1][..., 3:]).sum(axis=-1)).clip(0, 1)
    angle = np.degrees(2 * np.arccos(cosine))
    assert angle.max() > 0.5
    assert angle.max() < 5.0 * np.sqrt(3) + 0.1


def test_the_base_camera_has_the_field_of_view_of_the_settings(environment):
    narrow = RandomisedImages(environment.task, 2, replace(IMAGES, base_fovy=12.0), STILL, "cpu")
    focal = [matrix[0, 0] for matrix in narrow._camera.intrinsics()]
    assert focal[BASE] == pytest.approx(SIZE / 2 / np.tan(np.radians(6.0)))
    assert focal[WRIST] < focal[BASE]


def test_splats_of_an_object_are_seen(environment, tmp_path):
    ball().write(tmp_path / "ball.ply")
    body = environment.task.compiled.body(environment.task.objects[0]).name
    cfg = replace(IMAGES, splats=(f"{body}={tmp_path / 'ball.ply'}",))
    hybrid = simulated_images(environment, cfg, cw.LooksCfg())
    hybrid.begin(ALL)
    image = hybrid.render(environment.physics.qpos, environment.physics.mocap)
    assert image.shape == (2, 2, 3, SIZE, SIZE)
    assert image.dtype == torch.uint8
    assert int(image.max()) > int(image.min())
    with pytest.raises(RenderError, match=r"body=file\.ply"):
        simulated_images(environment, replace(IMAGES, splats=("ball",)), cw.LooksCfg())


def reality(
    teacher: cw.Policy, cfg: LiveCamerasCfg, images: cw.ImagesCfg = IMAGES
) -> tuple[Environment, RealityImages]:
    """Return Reality with its cameras."""
    run, given = teacher.run, cw.EvaluateCfg()
    task, settings = run.task(), replace(run.cfg.environment, worlds=2)
    made = reality_environment(task, settings, run.evaluation_states(task, 2, 0), given)
    made.start_from([0, 0])
    return made, RealityImages(made, reality_world(task, settings, given).spec(), images, cfg)


def test_images_of_reality_are_noisy_and_of_cameras_mounted_with_errors(teacher):
    exact = LiveCamerasCfg(noise=0.0, mounting_position=0.0, mounting_angle=0.0, latency=(0.0, 0.0), samples=1)
    made, source = reality(teacher, exact)
    source.begin(ALL)
    first = source.render(made.physics.qpos, made.physics.mocap).float()
    assert torch.equal(first[0], first[1])
    noisy = reality(teacher, replace(exact, noise=3.0))[1]
    noisy.begin(ALL)
    difference = noisy.render(made.physics.qpos, made.physics.mocap).float() - first
    assert 2 < float(difference.std()) < 3.5
    mounted = reality(teacher, replace(exact, mounting_angle=3.0))[1]
    mounted.begin(ALL)
    image = mounted.render(made.physics.qpos, made.physics.mocap).float()
    assert float((image[0] - image[1]).abs().mean()) > 1


def test_images_of_reality_come_late(teacher):
    exact = LiveCamerasCfg(noise=0.0, mounting_position=0.0, mounting_angle=0.0, latency=(0.0, 0.0), samples=1)
    made, now = reality(teacher, exact)
    late = RealityImages(
        made, reality_world(made.task, made._settings, cw.EvaluateCfg()).spec(), IMAGES,
        replace(exact, latency=(made.control_step, made.control_step)),
    )  # fmt: skip
    physics, images = made.physics, []
    for k in range(3):
        qpos = physics.qpos.clone()
        qpos[:, made.task.robot.qpos[0]] += 0.2 * k
        started = ALL if k == 0 else ~ALL
        for source in (now, late):
            source.begin(started)
        images.append([source.render(qpos, physics.mocap).float() for source in (now, late)])
    assert not torch.equal(images[1][0], images[0][0])
    assert torch.equal(images[0][1], images[0][0])
    assert torch.equal(images[1][1], images[0][0])
    assert torch.equal(images[2][1], images[1][0])


def test_a_camera_that_reality_lacks_is_named(teacher):
    with pytest.raises(RenderError, match="ceiling"):
        reality(teacher, LiveCamerasCfg(), replace(IMAGES, cameras=("ceiling",)))
