import pytest
import torch
import trimesh


@pytest.fixture
def rl_kernels(script):
    return script("benchmarks.kernels.rl_kernels")


def test_kernels_and_torch_agree_on_the_scene_that_is_timed(rl_kernels):
    rows = rl_kernels.measure(rl_kernels.make_scene(), 2, "cpu", 1, with_error=True)
    assert [row["name"] for row in rows] == ["contact pairs", "meshes", "spheres"]
    for row in rows:
        assert row["error"] < 1e-4, row["name"]


def test_torch_finds_the_inside_of_a_box(rl_kernels):
    corners = trimesh.creation.box([0.04, 0.06, 0.08]).triangles
    points = torch.tensor([[[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.03, 0.0, 0.0], [0.05, 0.07, 0.0]]])
    distance = rl_kernels.to_mesh(points, torch.tensor(corners, dtype=torch.float32))
    assert distance[0].tolist() == pytest.approx([-0.02, -0.01, 0.01, 0.05])
