import mujoco
import numpy as np

from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.scene.spheres.export import _export_mjcf, save_mjcf

SCENE = Scene(
    """<mujoco><option timestep=".002"/><default><geom friction=".9" margin=".0005"/>
    <default class="soft"><geom solref=".05 1" condim="6" priority="1"/></default></default><worldbody>
    <geom type="plane" size="1 1 .1" priority="0"/>
    <body name="block" pos="0 0 .05" childclass="soft" quat=".9 .1 .2 .3"><freejoint/>
      <frame pos="0 0 .003"><geom type="box" size=".02 .03 .01" mass=".08" pos=".001234567 .002 0"/></frame></body>
    <body name="ball" pos=".03 0 .12"><freejoint/><geom type="sphere" size=".02"/></body>
    </worldbody></mujoco>"""
)


def simulate(model: mujoco.MjModel) -> tuple[np.ndarray, int]:
    data = mujoco.MjData(model)
    contacts = 0
    for _ in range(200):
        mujoco.mj_step(model, data)
        contacts += data.ncon
    return data.qpos.copy(), contacts


def test_export_simulates_as_the_model_does():
    model = Model(SCENE, ContactGeometryCfg(count=60).build(SCENE))
    expected, contacts = simulate(model.compile())
    found, exported_contacts = simulate(mujoco.MjModel.from_xml_string(_export_mjcf(model)))
    assert contacts > 100
    assert exported_contacts == contacts
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_export_keeps_names_and_inertia():
    geometry = ContactGeometryCfg(count=30).build(SCENE)
    exported = mujoco.MjModel.from_xml_string(_export_mjcf(Model(SCENE, geometry)))
    for i, name in enumerate(geometry.names()):
        geom = exported.geom(name)
        assert geom.size[0] == geometry.radius[i]
        assert geom.friction[0] == geometry.friction[i]
        np.testing.assert_array_equal(geom.pos, geometry.position[i])
    for name in geometry.bodies:
        np.testing.assert_allclose(exported.body(name).mass, SCENE.model.body(name).mass, rtol=1e-14)
        np.testing.assert_allclose(exported.body(name).inertia, SCENE.model.body(name).inertia, rtol=1e-14)


def test_another_time_step_changes_nothing_else():
    finer = SCENE.with_timestep(0.0005)
    assert finer.model.opt.timestep == 0.0005
    assert SCENE.model.opt.timestep == 0.002
    for name in ("body_mass", "body_inertia", "geom_size", "geom_friction", "geom_solref", "geom_quat"):
        np.testing.assert_array_equal(getattr(finer.model, name), getattr(SCENE.model, name))


def test_a_time_step_can_be_set_where_the_scene_has_none_or_several():
    body = "<worldbody><body><freejoint/><geom size='.1'/></body></worldbody>"
    for options in (
        "",
        "<option gravity='0 0 -1'/>",
        "<option timestep='.01'/><option timestep='.02' gravity='0 0 -1'/>",
    ):
        scene = Scene(f"<mujoco>{options}{body}</mujoco>").with_timestep(1 / 3000)
        assert scene.model.opt.timestep == 1 / 3000
        assert scene.model.opt.gravity[2] == (-1.0 if "gravity" in options else -9.81)


def test_scene_without_spheres_is_exported(tmp_path):
    save_mjcf(Model(SCENE), tmp_path / "scene.xml")
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml")).ngeom == 3
    assert [path.name for path in tmp_path.iterdir()] == ["scene.xml"]


def test_bodies_that_the_text_does_not_spell_out_are_exported():
    scene = Scene(
        '<mujoco><worldbody><replicate count="2" offset=".1 0 0"><body name="b" pos="0 0 .1"><freejoint/>'
        '<geom type="box" size=".02 .02 .02"/></body></replicate></worldbody></mujoco>'
    )
    model = Model(scene, ContactGeometryCfg(count=20).build(scene, ["b0", "b1"]))
    found, _ = simulate(mujoco.MjModel.from_xml_string(_export_mjcf(model)))
    np.testing.assert_allclose(found, simulate(model.compile())[0], atol=1e-9)
