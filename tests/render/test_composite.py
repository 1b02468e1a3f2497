import mujoco
import numpy as np
import pytest
import torch
from small_arm import XML, ball, states

from concent_warp.render.composite import HybridCamera, _composed
from concent_warp.render.figure import FrameSelection, decomposition
from concent_warp.render.raw import camera_ids
from concent_warp.render.shadows import ShadowCfg
from concent_warp.scene.scene import Scene

SIZE = (64, 64)


def above_the_ball() -> np.ndarray:
    """Return two states: the arm aside, and the arm over the ball as the camera sees it."""
    qpos = np.tile(Scene(XML).model.qpos0, (2, 1))
    qpos[:, :3] = 0.12, 0.16, 0.1  # on the line from the camera through the arm, a little aside
    qpos[0, 7] = -2.0
    return qpos


def test_composition_is_the_formula_of_layers():
    background, objects = torch.full((1, 1, 1, 3, 3), 0.8), torch.zeros(1, 1, 1, 3, 3)
    objects[..., 1, :], objects[..., 2, :] = 0.5, 2.0
    alpha, shadow = torch.tensor([[[[0.0, 0.5, 1.0]]]]), torch.tensor([[[[0.25, 0.5, 0.9]]]])
    image = _composed(background, objects, alpha, shadow)[0, 0, 0, :, 0]
    assert torch.allclose(image, torch.tensor([0.6, 0.5 + 0.5 * 0.4, 1.0]))


def test_splats_are_where_the_simulation_has_the_object_and_hidden_by_the_arm():
    model = Scene(XML).model
    camera = HybridCamera(model, ["base"], SIZE, 2, objects=["ball"], splats={"ball": ball()})
    layers = camera.shoot(above_the_ball())
    ball_id = model.geom("ball").id
    shown = camera._raw.render().segmentation == ball_id
    for world in range(2):
        there, splats = shown[world, 0], layers.alpha[world, 0] > 0.5
        assert (there & splats).sum() > 0.8 * there.sum()
        near = torch.nn.functional.max_pool2d(there[None].float(), 3, 1, 1)[0] > 0
        assert (splats & ~near).sum() < 4  # splats reach a pixel beyond the edge
    assert 4 < shown[1].sum() < 0.9 * shown[0].sum()  # the arm hides part of it
    green = layers.image[0, 0][shown[0, 0] & (layers.alpha[0, 0] > 0.9)].mean(dim=0)
    assert green[1] > 2 * green[0]


def test_object_that_the_simulation_shows_is_not_in_the_background_of_splats():
    model = Scene(XML).model
    layers = HybridCamera(model, ["base"], SIZE, 1, objects=["ball"], splats={"ball": ball()}).shoot(states(0, 1))
    red = (layers.background[..., 0] > 2 * layers.background[..., 1]).sum()
    assert red == 0
    assert ((layers.raw[..., 0] > 2 * layers.raw[..., 1]).sum()) > 20


def test_shadow_darkens_the_table_beside_the_object_alone():
    model = Scene(XML).model
    lights = ShadowCfg(lights=1, elevation=(40, 40), strength=(0.5, 0.5))
    camera = HybridCamera(model, ["base"], SIZE, 1, objects=["ball"], splats={"ball": ball()}, shadows=lights, seed=1)
    layers = camera.shoot(states(0, 1))
    dark = layers.shadow[0, 0] > 0.2
    assert dark.sum() > 10
    beside = layers.alpha[0, 0] == 0
    image, background = layers.image[0, 0], layers.background[0, 0]
    assert (dark & beside).sum() > 10
    lit = background.amin(dim=-1) > 0
    assert (image[dark & beside & lit] < background[dark & beside & lit]).all()
    away = (layers.shadow[0, 0] == 0) & beside
    assert torch.equal(image[away], background[away].clamp(0, 1))


def test_without_networks_and_splats_the_image_is_the_raw_one():
    layers = HybridCamera(Scene(XML).model, ["base", "wrist"], SIZE, 2, objects=["ball"]).shoot(states(0, 2))
    assert torch.equal(layers.image, layers.raw.clamp(0, 1))
    assert layers.image.shape == (2, 2, 64, 64, 3)


def test_contact_spheres_are_shown_in_the_raw_layer_alone():
    spec = Scene(XML).spec()
    spec.body("ball").add_geom(
        name="sphere", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.06, 0, 0], group=3, rgba=[0.2, 0.3, 0.9, 0.5]
    )
    model = spec.compile()
    camera = HybridCamera(model, ["base"], SIZE, 1, objects=["ball"], show="spheres")
    layers = camera.shoot(states(0, 1))
    blue = [((image[..., 2] > 2 * image[..., 0]).sum()) for image in (layers.raw, layers.image)]
    assert blue[0] > 20
    assert blue[1] == 0


def test_figure_has_a_row_for_each_sample_and_camera(tmp_path):
    import cv2

    camera = HybridCamera(Scene(XML).model, ["base", "wrist"], SIZE, 2, objects=["ball"], splats={"ball": ball()})
    album = FrameSelection()
    for state in states(0, 21):
        album.add(camera.shoot(np.tile(state, (2, 1))), world=1)
    chosen = album.chosen()
    assert len(chosen) == 2
    assert not torch.equal(chosen[0].raw, chosen[1].raw)
    decomposition(chosen, camera.cameras, tmp_path / "layers.png")
    picture = cv2.imread(str(tmp_path / "layers.png"))
    assert picture is not None
    assert picture.shape[1] / picture.shape[0] == pytest.approx(5 / 4, rel=0.1)
    assert len(camera_ids(Scene(XML).model, camera.cameras)) == 2


@pytest.mark.gpu
def test_hybrid_images_of_a_gpu_are_those_of_the_cpu():
    found = []
    for device in ("cpu", "cuda:0"):
        camera = HybridCamera(
            Scene(XML).model, ["base", "wrist"], SIZE, 2, objects=["ball"], splats={"ball": ball().to(device)},
            shadows=ShadowCfg(), device=device,
        )  # fmt: skip
        layers = [camera.shoot(states(t, 2)) for t in range(3)]
        found.append(layers[-1].image.cpu())
    assert (found[0] - found[1]).abs().mean() < 0.003
