"""Tasks whose objects collide as the geoms of the scene."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import trimesh
from data_parallel_training import make_run

from concent_warp.scene.scene import Scene
from concent_warp.train.cfg import StressCfg
from concent_warp.train.run import TrainingRun
from concent_warp.train.task.nominal_shapes import with_nominal_shapes


@pytest.fixture(scope="module")
def run() -> TrainingRun:
    return make_run()


def with_scene(run: TrainingRun, edit) -> TrainingRun:
    """Return a training with a changed scene."""
    spec = run.model.scene.spec()
    edit(spec)
    return replace(run, model=replace(run.model, scene=Scene.from_spec(spec, source="changed")))


def test_physics_has_the_scenes_shapes_with_friction_and_inertia_of_the_model(run):
    geometry = run.model.geometry
    rough = replace(geometry, friction=np.where(geometry.body == 0, 0.7, 0.2))
    task = replace(run, model=replace(run.model, geometry=rough)).task()
    nominal = with_nominal_shapes(task)
    assert nominal is not None
    assert replace(nominal, compiled=task.compiled) == task
    m = nominal.compiled
    assert (m.nq, m.nv, m.nu, m.nbody, m.nmocap) == tuple(
        getattr(task.compiled, name) for name in ("nq", "nv", "nu", "nbody", "nmocap")
    )
    for name, friction in zip(geometry.bodies, (0.7, 0.2), strict=True):
        body = m.body(name)
        own = np.flatnonzero(m.geom_bodyid == body.id)
        assert (m.geom_type[own] == int(mujoco.mjtGeom.mjGEOM_BOX)).all()
        assert (m.geom_contype[own] != 0).all()
        np.testing.assert_allclose(m.geom_friction[own, 0], friction)
        assert body.mass == task.compiled.body(name).mass
        np.testing.assert_array_equal(body.inertia, task.compiled.body(name).inertia)


def test_objects_without_shapes_that_collide_keep_their_spheres(run):
    def visual(spec: mujoco.MjSpec) -> None:
        for geom in spec.body("box").geoms:
            geom.contype = geom.conaffinity = 0

    changed = with_scene(run, visual)
    assert with_nominal_shapes(changed.task()) is None
    cfg = replace(changed.cfg, stress=StressCfg(episodes=2, refine=1))
    environment = replace(changed, cfg=cfg).stress_test(device="cpu").environment
    m = environment.physics.model
    assert m.geom("block_sphere0").contype != 0


@pytest.mark.parametrize("hollow", [False, True])
def test_a_mesh_stands_for_itself_unless_it_is_hollow(run, hollow):
    solid = trimesh.creation.annulus(0.02, 0.035, 0.02) if hollow else trimesh.creation.cylinder(0.035, 0.02)

    def mesh(spec: mujoco.MjSpec) -> None:
        made = spec.add_mesh(name="part")
        made.uservert, made.userface = solid.vertices.ravel(), solid.faces.ravel()
        body = spec.body("box")
        for geom in list(body.geoms):
            spec.delete(geom)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="part", pos=[0, 0, 0.01])

    assert (with_nominal_shapes(with_scene(run, mesh).task()) is None) == hollow
