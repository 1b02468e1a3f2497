"""A box drawn as three smaller ones lacks its edges and keeps its faces."""

import mujoco
import numpy as np
import pytest

from concent_warp.deploy.cut_edges import add_parts, cut_edges

HALF, CUT = np.array([0.02, 0.03, 0.04]), 0.004


def scene(kind: str, size: str, more: str = "") -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(
        f'<mujoco><worldbody><body name="thing" pos="0 0 1"><freejoint/>'
        f'<geom type="{kind}" size="{size}" mass="0.3"/>{more}</body></worldbody></mujoco>'
    )


def inside(model: mujoco.MjModel, sizes: np.ndarray, point: np.ndarray) -> bool:
    """Return whether a point of the body's frame is in a geom of it."""
    found = False
    for k in range(model.ngeom):
        if model.geom_type[k] == mujoco.mjtGeom.mjGEOM_BOX:
            found |= bool((np.abs(point) <= sizes[k]).all())
        else:
            found |= bool(np.hypot(*point[:2]) <= sizes[k, 0] and abs(point[2]) <= sizes[k, 1])
    return found


@pytest.mark.parametrize(
    ("kind", "size", "edge", "faces"),
    [
        ("box", "0.02 0.03 0.04", [0.019, 0.029, 0.0], ([0.02, 0, 0], [0, 0.03, 0], [0, 0, 0.04])),
        ("cylinder", "0.02 0.04", [0.019, 0.0, 0.039], ([0.02, 0, 0], [0, 0, 0.04])),
    ],
)
def test_the_edges_are_left_out_and_the_faces_stay(kind, size, edge, faces):
    spec = scene(kind, size)
    mass = spec.copy().compile().body("thing").mass[0]
    parts = add_parts(spec, ["thing"])
    model = spec.compile()
    edges = cut_edges(model, parts)
    assert model.body("thing").mass[0] == mass
    assert (edges.whole == 0).all()
    sizes = model.geom_size[edges.whole] - CUT * edges.shortened
    assert inside(model, model.geom_size, np.array(edge))
    assert not inside(model, sizes, np.array(edge))
    assert all(inside(model, sizes, np.array(face, float)) for face in faces)


def test_bodies_of_several_geoms_stay_whole():
    spec = scene("box", "0.02 0.03 0.04", '<geom type="sphere" size="0.01"/>')
    assert add_parts(spec, ["thing"]) == {}
    edges = cut_edges(spec.compile(), {})
    assert edges.whole.tolist() == [0, 1]
    assert not edges.shortened.any()


def test_unseen_geoms_do_not_count():
    spec = scene("box", "0.02 0.03 0.04", '<geom type="sphere" size="0.01" group="4"/>')
    assert [len(names) for names in add_parts(spec, ["thing"]).values()] == [3]
