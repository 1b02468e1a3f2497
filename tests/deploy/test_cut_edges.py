"""A box drawn in parts lacks its edges and keeps its faces."""

import mujoco
import numpy as np
import pytest

from concent_warp.deploy.cut_edges import CutEdges, add_parts, cut_edges

CUT = 0.004
AT = np.array([0.01, -0.02, 0.03])


def scene(kind: str, size: str, more: str = "") -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(
        f'<mujoco><worldbody><body name="thing" pos="0 0 1"><freejoint/>'
        f'<geom type="{kind}" size="{size}" mass="0.3" pos="0.01 -0.02 0.03" euler="30 40 50"/>{more}'
        f"</body></worldbody></mujoco>"
    )


def inside(model: mujoco.MjModel, edges: CutEdges, cut: float, point: np.ndarray) -> bool:
    """Return whether a point of the first geom's frame is in a geom of the body, whose edges are cut so far."""
    whole = model.geom_size[edges.whole]
    sizes = np.einsum("gij,gj->gi", edges.size, whole) + cut * edges.size_cut
    places = model.geom_pos + np.einsum("gij,gj->gi", edges.place, whole) + cut * edges.place_cut
    turns = np.zeros((model.ngeom, 9))
    for turn, quat in zip(turns, model.geom_quat, strict=True):
        mujoco.mju_quat2Mat(turn, quat)
    turns = turns.reshape(-1, 3, 3)
    world = model.geom_pos[0] + turns[0] @ point
    found = False
    for k in range(model.ngeom):
        local = turns[k].T @ (world - places[k])
        if model.geom_type[k] == mujoco.mjtGeom.mjGEOM_BOX:
            found |= bool((np.abs(local) <= sizes[k] + 1e-12).all())
        else:
            found |= bool(np.hypot(*local[:2]) <= sizes[k, 0] and abs(local[2]) <= sizes[k, 1])
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
    assert np.allclose(model.geom_pos, AT)
    shrunk = 1 - 1e-6
    assert inside(model, edges, 0.0, np.array(edge))
    assert not inside(model, edges, CUT, np.array(edge))
    assert all(inside(model, edges, CUT, shrunk * np.array(face, float)) for face in faces)


def test_a_box_with_cut_edges_is_what_a_plane_at_each_edge_leaves_but_for_its_corners():
    spec = scene("box", "0.02 0.03 0.04")
    parts = add_parts(spec, ["thing"])
    model = spec.compile()
    edges, half = cut_edges(model, parts), np.array([0.02, 0.03, 0.04])
    rng, compared = np.random.default_rng(0), 0
    for point in rng.uniform(-1.05, 1.05, (3000, 3)) * half:
        gaps = half - np.abs(point)
        if (gaps < CUT).all():  # a corner
            continue
        pairs = gaps[[0, 0, 1]] + gaps[[1, 2, 2]]
        if min(np.abs(gaps).min(), np.abs(pairs - CUT).min()) < 1e-6:
            continue
        expected = bool((gaps >= 0).all() and (pairs >= CUT).all())
        assert inside(model, edges, CUT, point) == expected, point
        compared += 1
    assert compared > 2000


def test_bodies_of_several_geoms_stay_whole():
    spec = scene("box", "0.02 0.03 0.04", '<geom type="sphere" size="0.01"/>')
    assert add_parts(spec, ["thing"]) == {}
    edges = cut_edges(spec.compile(), {})
    assert edges.whole.tolist() == [0, 1]
    assert (edges.size == np.eye(3)).all()
    assert not edges.size_cut.any()
    assert not edges.place.any()


def test_unseen_geoms_do_not_count():
    spec = scene("box", "0.02 0.03 0.04", '<geom type="sphere" size="0.01" group="4"/>')
    assert [len(names) for names in add_parts(spec, ["thing"]).values()] == [15]
