import numpy as np

from concent_warp.fit.geometry.offset import offset_directions
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

SCENE = """
<mujoco>
  <worldbody>
    <body name="cube"><geom type="box" size="0.03 0.03 0.03"/></body>
    <body name="ball" pos="1 0 0"><geom type="sphere" size="0.03"/></body>
  </worldbody>
</mujoco>"""


def geometry(body: str, position: list[list[float]]) -> ContactGeometry:
    n = len(position)
    return ContactGeometry(
        (body,), np.zeros(n, int), np.array(position), np.full(n, 0.004), np.full(n, 0.1), np.full(n, 0.5)
    )


def test_every_face_of_a_box_moves_by_the_growth_also_at_edges_and_corners():
    spheres = geometry("cube", [[0.026, 0.005, -0.01], [0.026, -0.026, 0.003], [0.026, -0.026, 0.026]])
    directions = offset_directions(spheres, Scene(SCENE))
    np.testing.assert_allclose(directions, [[1, 0, 0], [1, -1, 0], [1, -1, 1]], atol=0.02)


def test_a_ball_grows_along_its_normals():
    way = np.random.default_rng(0).normal(size=(10, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    directions = offset_directions(geometry("ball", list(0.026 * way)), Scene(SCENE))
    np.testing.assert_allclose(directions, way, atol=0.1)
