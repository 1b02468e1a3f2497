import mujoco
import pytest

from concent_warp.comparison.no_contact import without_object_contact
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg

XML = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <body name="low" pos="0 0 .1"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
    <body name="high" pos="0 0 .31"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize("spheres", [False, True])
def test_objects_fall_through_one_another_and_rest_on_the_floor(spheres):
    scene = Scene(XML)
    geometry = ContactGeometryCfg(count=64, radius=0.02).build(scene) if spheres else None
    heights = []
    for model in (Model(scene, geometry), without_object_contact(Model(scene, geometry))):
        compiled = model.compile()
        data = mujoco.MjData(compiled)
        mujoco.mj_step(compiled, data, nstep=500)
        heights.append(data.body("high").xpos[2])
    assert heights[0] > 0.28
    assert 0.09 < heights[1] < 0.15


def test_one_object_alone_has_no_null_model():
    lone = Scene(XML.replace('<body name="high" pos="0 0 .31"><freejoint/>', '<body name="high" pos="0 0 .31">'))
    assert without_object_contact(Model(lone)) is None
