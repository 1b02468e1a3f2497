import mujoco
import numpy as np
import pytest
import torch

from concent_warp.errors import RenderError, SceneError
from concent_warp.render.raw import PosedWorlds, RawCamera, _matrix_quaternions, camera_ids
from concent_warp.scene.cameras import BASE, WRIST, with_cameras
from concent_warp.scene.scene import Scene
from concent_warp.scene.shape_sorter import ShapeSorterCfg, home

SIZE = (24, 32)
XML = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <geom name="floor" type="plane" size="2 2 0.1" rgba="0.2 0.6 0.2 1"/>
    <camera name="above" pos="0 0 1" fovy="60"/>
    <body name="ball" pos="0 0 0.2"><freejoint/><geom name="ball" size="0.1" rgba="1 0 0 1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def sorter() -> tuple[mujoco.MjModel, np.ndarray]:
    model = with_cameras(ShapeSorterCfg().build(), (BASE, WRIST)).model
    return model, home(model)


def test_sphere_above_a_plane_is_where_geometry_has_it():
    model = Scene(XML).model
    stage = PosedWorlds(model, 2)
    camera = RawCamera(stage, ["above"], (33, 33))
    qpos = np.tile(model.qpos0, (2, 1))
    qpos[1, 0] = 0.15
    stage.place(qpos)
    images = camera.render()
    depth, segmentation = images.depth[:, 0], images.segmentation[:, 0]
    assert depth[0, 16, 16] == pytest.approx(1 - 0.3, abs=1e-3)
    assert depth[0, 0, 0] == pytest.approx(1.0, abs=1e-4)  # along the axis, not along the ray
    assert segmentation[0, 16, 16] == model.geom("ball").id
    assert segmentation[0, 0, 0] == model.geom("floor").id
    red = images.rgb[1, 0, :, :, 0] > 2 * images.rgb[1, 0, :, :, 1]
    focal = camera.intrinsics()[0, 0, 0]
    assert float(torch.where(red)[1].float().mean()) == pytest.approx(16 + focal * 0.15 / 0.8, abs=0.7)


def test_depth_and_segmentation_are_those_of_c_mujoco(sorter):
    model, qpos = sorter
    stage = PosedWorlds(model, 1)
    images = RawCamera(stage, [BASE, WRIST], SIZE)
    stage.place(qpos[None])
    found = images.render()
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    for c, name in enumerate((BASE, WRIST)):
        depth, geom = cast_through_pixels(model, data, name, images.intrinsics()[c])
        same = found.segmentation[0, c].numpy() == geom
        assert same.mean() > 0.99  # rays along an edge may fall to either side
        assert np.abs(found.depth[0, c].numpy() - depth)[same].max() < 1e-3
        assert len(np.unique(geom)) > 4


def cast_through_pixels(model, data, name, matrix):
    """Return planar depths [m] and geom ids, shape SIZE, by C MuJoCo's rays."""
    row = camera_ids(model, [name])[0]
    depth, geom, hit = np.zeros(SIZE), np.full(SIZE, -1), np.zeros(1, dtype=np.int32)
    turned = data.cam_xmat[row].reshape(3, 3)
    shown = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)
    for v in range(SIZE[0]):
        for u in range(SIZE[1]):
            local = np.array([(u - matrix[0, 2]) / matrix[0, 0], -(v - matrix[1, 2]) / matrix[1, 1], -1.0])
            distance = mujoco.mj_ray(
                model, data, data.cam_xpos[row], turned @ local / np.linalg.norm(local), shown, 1, -1, hit
            )
            geom[v, u] = hit[0]
            depth[v, u] = 0.0 if hit[0] < 0 else distance / np.linalg.norm(local)
    return depth, geom


def test_images_are_the_ray_tracers_memory_and_follow_it(sorter):
    model, qpos = sorter
    stage = PosedWorlds(model, 2)
    camera = RawCamera(stage, [BASE], SIZE)
    stage.place(np.tile(qpos, (2, 1)))
    first = camera.render()
    addresses = [t.data_ptr() for t in (first.rgb, first.depth, first.segmentation)]
    before = first.depth.clone()
    moved = np.tile(qpos, (2, 1))
    moved[1, 0] += 0.5
    stage.place(moved)
    second = camera.render()
    assert [t.data_ptr() for t in (second.rgb, second.depth, second.segmentation)] == addresses
    assert torch.equal(first.depth[0], before[0])
    assert not torch.equal(first.depth[1], before[1])


def test_bodies_that_are_left_out_show_what_is_behind_them(sorter):
    model, qpos = sorter
    stage = PosedWorlds(model, 1)
    whole, without = (RawCamera(stage, [BASE], (48, 48), leave_out=out) for out in ((), ("block", "box")))
    stage.place(qpos[None])
    objects = [g for g in range(model.ngeom) if model.body(model.geom_bodyid[g]).name in ("block", "box")]
    there = torch.isin(whole.render().segmentation, torch.tensor(objects, dtype=torch.int32))
    assert there.sum() > 20
    bare = without.render()
    assert not torch.isin(bare.segmentation, torch.tensor(objects, dtype=torch.int32)).any()
    assert (bare.depth[there] >= whole.render().depth[there] - 1e-6).all()


def test_wrist_camera_moves_with_the_hand_and_poses_are_those_of_mujoco(sorter):
    model, qpos = sorter
    stage = PosedWorlds(model, 1)
    data = mujoco.MjData(model)
    for angle in (0.0, 0.4):
        data.qpos[:] = qpos
        data.qpos[0] += angle
        stage.place(data.qpos[None].copy())
        mujoco.mj_forward(model, data)
        row = camera_ids(model, [WRIST])[0]
        pose = stage.camera_poses([WRIST])[0, 0].numpy()
        expected = np.zeros(4)
        mujoco.mju_mat2Quat(expected, data.cam_xmat[row])
        assert np.allclose(pose[:3], data.cam_xpos[row], atol=1e-5)
        assert min(np.abs(pose[3:] - expected).max(), np.abs(pose[3:] + expected).max()) < 1e-4


def test_camera_that_is_not_there_is_reported_in_one_sentence(sorter):
    with pytest.raises(RenderError, match=r"no such camera.*base.*found \['side'\]"):
        RawCamera(PosedWorlds(sorter[0], 1), ["side"], SIZE)
    with pytest.raises(SceneError, match="no such camera"):
        with_cameras(Scene(XML), ["wrist"])


def test_quaternions_are_those_of_the_matrices_whatever_the_rotation():
    rng = np.random.default_rng(0)
    given = rng.normal(size=(200, 4))
    given[:3] = [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]  # half turns
    given /= np.linalg.norm(given, axis=1, keepdims=True)
    matrices = np.zeros((200, 9))
    for matrix, quaternion in zip(matrices, given, strict=True):
        mujoco.mju_quat2Mat(matrix, quaternion)
    found = _matrix_quaternions(torch.tensor(matrices).view(10, 20, 3, 3)).view(200, 4).numpy()
    assert np.allclose(np.abs((found * given).sum(axis=1)), 1, atol=1e-9)


@pytest.mark.gpu
def test_images_of_a_gpu_are_those_of_the_cpu(sorter):
    model, qpos = sorter
    states = np.tile(qpos, (4, 1))
    states[:, 0] += np.linspace(0, 0.3, 4)
    found = []
    for device in ("cpu", "cuda:0"):
        stage = PosedWorlds(model, 4, device=device)
        camera = RawCamera(stage, [BASE, WRIST], (64, 64))
        for _ in range(2):
            stage.place(states)
            camera.render()
        stage.place(states)
        images = camera.render()  # a replay of the graph that the first one recorded
        found.append([t.cpu() for t in (images.rgb, images.depth, images.segmentation)])
    same = found[0][2] == found[1][2]
    assert same.float().mean() > 0.99
    assert (found[0][1] - found[1][1])[same].abs().max() < 1e-3
    assert (found[0][0] - found[1][0])[same].abs().max() < 0.02
