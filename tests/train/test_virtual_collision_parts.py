"""What the virtual collision penalty is given: spheres, points, targets, gates and meshes of shapes."""

import importlib
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import trimesh
from made_up_task import SETTINGS, make_task

from concent_warp.kernels.virtual_collision import TargetMesh
from concent_warp.scene.shapes.solid import Box
from concent_warp.scene.shapes.surface import Surface
from concent_warp.train.cfg import CollisionCfg
from concent_warp.train.environment.virtual_collision import _body_mesh, _gate, _geom_mesh, _surface_points, _within

MODULE = importlib.import_module("concent_warp.train.environment.virtual_collision")
CUBE = Surface.of_solids([Box(np.full(3, 0.02))])
SHAPES = """
<mujoco>
  <asset>
    <mesh name="first" vertex="0 0 0  2 0 0  0 2 0  0 0 2"/>
    <mesh name="wedge" vertex="0 0 0  1 0 0  0 1 0  0 0 1  1 0 1"/>
    <hfield name="hills" nrow="2" ncol="2" size="1 1 1 0.1"/>
  </asset>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <geom type="hfield" hfield="hills"/>
    <geom type="sphere" size="0.3"/>
    <geom type="capsule" size="0.1 0.4"/>
    <geom type="ellipsoid" size="0.1 0.2 0.3"/>
    <geom type="cylinder" size="0.2 0.5"/>
    <geom type="box" size="0.1 0.2 0.3"/>
    <geom type="mesh" mesh="wedge"/>
    <body name="parts">
      <geom type="plane" size="1 1 1"/>
      <geom type="box" size="0.1 0.1 0.1" contype="0" conaffinity="0"/>
      <geom type="box" size="0.1 0.2 0.3" pos="1 2 3" quat="0.6 0 0 0.8" conaffinity="0"/>
      <geom type="box" size="0.2 0.1 0.1" pos="0 0 5" contype="0"/>
      <geom type="box" size="0.1 0.1 0.1" pos="0 9 0"/>
    </body>
    <body name="shown"><geom type="box" size="0.1 0.1 0.1" contype="0" conaffinity="0"/></body>
    <body name="ghost"/>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def shapes() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(SHAPES)


def test_planes_and_height_fields_have_no_mesh(shapes):
    assert _geom_mesh(shapes, 0) is None
    assert _geom_mesh(shapes, 1) is None


@pytest.mark.parametrize(
    ("geom", "half", "volume", "vertices", "faces"),
    [
        (2, (0.3, 0.3, 0.3), 4 / 3 * np.pi * 0.3**3, 162, 320),
        (3, (0.1, 0.1, 0.5), np.pi * 0.01 * (4 / 30 + 0.8), 258, 512),
        (4, (0.1, 0.2, 0.3), 4 / 3 * np.pi * 0.006, 162, 320),
        (5, (0.2, 0.2, 0.5), np.pi * 0.04, 50, 96),
        (6, (0.1, 0.2, 0.3), 0.048, 8, 12),
    ],
)
def test_meshes_have_the_sizes_of_their_shapes(shapes, geom, half, volume, vertices, faces):
    mesh = _geom_mesh(shapes, geom)
    assert mesh is not None
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.bounds, [[-x for x in half], half], rtol=0.03)
    np.testing.assert_allclose(mesh.extents[2], 2 * half[2], rtol=1e-6)
    assert mesh.volume == pytest.approx(volume, rel=0.06)
    assert mesh.volume <= volume * (1 + 1e-9)
    assert (len(mesh.vertices), len(mesh.faces)) == (vertices, faces)


def test_meshes_of_files_are_taken_as_they_are(shapes):
    found, row = _geom_mesh(shapes, 7), shapes.mesh("wedge")
    assert found is not None
    first, start = row.vertadr[0], row.faceadr[0]
    assert first > 0
    assert start > 0
    np.testing.assert_allclose(found.vertices, shapes.mesh_vert[first : first + row.vertnum[0]])
    np.testing.assert_array_equal(found.faces, shapes.mesh_face[start : start + row.facenum[0]])
    assert found.volume == pytest.approx(1 / 3)
    # Vertices that coincide stay apart: the kernels index them as they are.
    twice = SimpleNamespace(
        geom_type=[mujoco.mjtGeom.mjGEOM_MESH], geom_size=np.zeros((1, 3)), geom_dataid=[0],
        mesh=lambda _: SimpleNamespace(vertadr=[1], vertnum=[6], faceadr=[1], facenum=[2]),
        mesh_vert=np.array([[9, 9, 9], [0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [1, 0, 0], [0, 1, 0], [7, 7, 7]]),
        mesh_face=np.array([[5, 5, 5], [0, 1, 2], [3, 5, 4], [4, 4, 4]]),
    )  # fmt: skip
    same = _geom_mesh(twice, 0)  # pyright: ignore[reportArgumentType]
    assert same is not None
    np.testing.assert_array_equal(same.vertices, twice.mesh_vert[1:7])
    np.testing.assert_array_equal(same.faces, [[0, 1, 2], [3, 5, 4]])


def test_body_meshes_join_their_shapes_in_the_frame_of_the_body(shapes):
    body = shapes.body("parts").id
    turn = np.array([[-0.28, -0.96, 0], [0.96, -0.28, 0], [0, 0, 1]])
    boxes = [
        (np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0]), turn),
        (np.array([0.2, 0.1, 0.1]), np.array([0.0, 0.0, 5.0]), np.eye(3)),
        (np.array([0.1, 0.1, 0.1]), np.array([0.0, 9.0, 0.0]), np.eye(3)),
    ]
    for visual in (False, True):
        found = _body_mesh(shapes, body, visual=visual)
        assert found is not None
        expected = [(np.array([0.1, 0.1, 0.1]), np.zeros(3), np.eye(3))] * visual + boxes
        vertices, faces = found
        assert vertices.shape == (8 * len(expected), 3)
        assert faces.shape == (12 * len(expected), 3)
        for k, (half, place, frame) in enumerate(expected):
            corners = (vertices[8 * k : 8 * k + 8] - place) @ frame
            np.testing.assert_allclose(np.abs(corners), np.tile(half, (8, 1)), atol=1e-9)
            assert set(faces[12 * k : 12 * k + 12].ravel().tolist()) == set(range(8 * k, 8 * k + 8))
            part = trimesh.Trimesh(vertices, faces[12 * k : 12 * k + 12], process=False)
            assert part.volume == pytest.approx(8 * half.prod())
    shown = shapes.body("shown").id
    assert _body_mesh(shapes, shown, visual=False) is None
    assert _body_mesh(shapes, shown, visual=True) is not None
    assert _body_mesh(shapes, shapes.body("ghost").id, visual=True) is None


def test_gate_is_zero_for_bodies_of_the_targets_pairs():
    task = make_task()
    hand, block, box, peg = (task.compiled.body(name).id for name in ("hand", "block", "box", "peg"))
    gates = {(0, hand, block): 0, (0, block, hand): 0, (0, block, box): 1, (1, box, block): 0, (1, block, hand): 0}
    gates |= {(0, peg, box): 1, (2, block, box): 0, (2, hand, box): 1, (0, 0, 0): 1}
    for (stage, a, b), gate in gates.items():
        assert _gate(task, stage, a, b) == gate


def test_spheres_are_moved_below_the_surface_and_shrink_to_what_is_left():
    centre = np.array([[0.012, 0.0, 0.0], [0.018, 0.0, 0.0], [0.0, 0.021, 0.0], [0.0, 0.0, -0.0199]])
    moved, radius = _within(CUBE, centre, np.full(4, 0.004), 0.0005)
    # 8 mm deep: as it is. 2 mm deep: of 2 mm less the slack. Outside, and 0.1 mm deep: points the slack below.
    np.testing.assert_allclose(radius, [0.0035, 0.0015, 0.0, 0.0], atol=1e-9)
    expected = [[0.012, 0, 0], [0.018, 0, 0], [0, 0.0195, 0], [0, 0, -0.0195]]
    np.testing.assert_allclose(moved, expected, atol=1e-9)


def test_surface_points_are_the_farthest_of_the_candidates():
    cfg = CollisionCfg(points=7, candidates=40, slack=0.0)
    found, _ = CUBE.sample(40, np.random.default_rng(0))
    order = [0]
    while len(order) < 7:
        order.append(int(np.linalg.norm(found[:, None] - found[order], axis=2).min(axis=1).argmax()))
    np.testing.assert_allclose(_surface_points(CUBE, cfg), found[order], atol=1e-7)
    assert len(_surface_points(CUBE, CollisionCfg(points=9, candidates=4))) == 9


CHAIN = """
<mujoco>
  <custom><text name="concent_objects" data="block box"/></custom>
  <worldbody>
    <body name="base" pos="0 0 -1">
      <geom type="box" size="0.1 0.1 0.1"/>
      <body name="arm">
        <joint name="turn"/><geom type="box" size="0.1 0.1 0.1" mass="1"/>
        <body name="wrist">
          <geom type="box" size="0.1 0.1 0.1"/>
          <body name="mount">
            <geom type="box" size="0.1 0.1 0.1"/><site name="tcp"/>
            <body name="finger"><joint name="slide" type="slide"/><geom type="box" size="0.1 0.1 0.1" mass="1"/>
              <body name="pad"><geom type="box" size="0.1 0.1 0.1"/></body>
            </body>
            <body name="label"><geom type="box" size="0.1 0.1 0.1" contype="0" conaffinity="0"/></body>
          </body>
        </body>
      </body>
    </body>
    <body name="block" pos="0 0 0.3"><freejoint/><geom type="box" size="0.04 0.03 0.02" mass="0.1"/></body>
    <body name="box" pos="0.3 0 0"><geom type="box" size="0.1 0.08 0.05"/></body>
    <body name="post" pos="2 0 0"><geom type="box" size="0.1 0.1 0.1"/></body>
  </worldbody>
  <actuator><position name="turn" joint="turn"/><position name="gripper" joint="slide"/></actuator>
</mujoco>
"""


def recorded(monkeypatch, task, cfg: CollisionCfg):
    """Return the arguments with which the penalty is made, None if it is not."""
    made = []

    def record(*args, **kwargs):
        made.append(SimpleNamespace(sets=args[0], targets=args[1], pairs=args[2], rest=args[3:], settings=kwargs))
        return made[-1]

    monkeypatch.setattr(MODULE, "VirtualCollision", record)
    physics = SimpleNamespace(poses=lambda: ("positions", "quaternions"))
    found = MODULE.virtual_collision(task, physics, "stage", cfg)
    assert found is (made[0] if made else None)
    return found


def test_spheres_outside_the_physics_are_penalised_near_everything_and_points_near_objects(monkeypatch):
    task = make_task(SETTINGS)
    cfg = CollisionCfg(margin=0.03, severe=0.02, slack=0.001, depth=7.0, band=0.3, points=5, candidates=50, threads=32)
    found = recorded(monkeypatch, task, cfg)
    m = task.compiled
    names = [m.body(t.body).name for t in found.targets]
    assert names == ["block", "box", "peg", "arm", "hand", "left", "right"]
    assert all(isinstance(target, TargetMesh) for target in found.targets)
    assert [m.body(s.body).name for s in found.sets] == ["block", "box", "block", "box"]
    assert [len(s.radius) for s in found.sets] == [1, 1, 5, 5]
    np.testing.assert_allclose(found.sets[0].centre, [[-0.03, 0.0, 0.01]], atol=1e-9)
    np.testing.assert_allclose(found.sets[0].radius, [0.007], atol=1e-9)
    np.testing.assert_allclose(found.sets[1].radius, [0.011], atol=1e-9)
    for points, body in zip(found.sets[2:], ("block", "box"), strict=True):
        assert not points.radius.any()
        surface = Surface.of_body(task.model.scene, body)
        np.testing.assert_array_equal(points.centre, _surface_points(surface, cfg))
    pairs = {(p.spheres, names[p.target]) for p in found.pairs}
    expected = {(0, name) for name in names if name != "block"} | {(1, name) for name in names if name != "box"}
    expected |= {(2, "box"), (2, "peg"), (3, "block"), (3, "peg")}
    assert pairs == expected
    assert len(found.pairs) == len(expected)
    for pair in found.pairs:
        assert (pair.margin, pair.severe) == (0.03, 0.02)
        ids = found.sets[pair.spheres].body, found.targets[pair.target].body
        assert pair.gate == tuple(_gate(task, s, *ids) for s in range(3))
    assert found.rest == ("positions", "quaternions", "stage")
    expected = {"stages": 3, "depth_weight": 7.0, "band_weight": 0.3, "severe_penalty": 0.0, "threads": 32}
    assert found.settings == expected


def test_there_is_no_penalty_without_spheres_or_points_outside_the_physics(monkeypatch):
    task = make_task()
    everything = SimpleNamespace(**vars(task))
    everything.collidable = np.ones(3, bool)
    assert recorded(monkeypatch, everything, CollisionCfg(points=0)) is None
    found = recorded(monkeypatch, everything, CollisionCfg(points=3, candidates=9))
    assert [len(s.radius) for s in found.sets] == [3, 3]
    everything.model = SimpleNamespace(geometry=None)
    with pytest.raises(AssertionError):
        recorded(monkeypatch, everything, CollisionCfg())


def test_targets_are_all_bodies_that_the_arm_moves_and_collide_but_not_those_that_stand(monkeypatch):
    from concent_warp.model import Model
    from concent_warp.scene.scene import Scene
    from concent_warp.train.cfg import ActionCfg
    from concent_warp.train.task.robot import Robot

    plain = make_task()
    assert plain.model.geometry is not None
    model = Model(Scene(CHAIN), plain.model.geometry)
    m = model.compile()
    task = SimpleNamespace(
        model=model, compiled=m, robot=Robot.of(m, ActionCfg()), table=plain.table, collidable=plain.collidable,
        objects=(m.body("block").id, m.body("box").id),
    )  # fmt: skip
    found = recorded(monkeypatch, task, CollisionCfg(points=0))
    names = [m.body(t.body).name for t in found.targets]
    assert names == ["block", "box", "arm", "wrist", "mount", "finger", "pad"]
