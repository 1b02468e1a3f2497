import numpy as np
import pytest

from concent_warp.events.roles import Roles
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

XML = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body name="table"><geom name="top" type="box" size="1 1 .01"/>
      <body name="base"><geom type="box" size=".1 .1 .1"/>
        <body name="arm"><joint name="arm" type="hinge"/><geom type="sphere" size=".1"/>
          <body name="tip">
            <geom name="tip_a" type="sphere" size=".1"/><geom name="tip_b" type="sphere" size=".1"/>
          </body>
        </body>
      </body>
    </body>
    <body name="follower"><joint name="follower" type="slide"/><geom type="sphere" size=".1"/></body>
    <body name="pulled"><joint name="pulled" type="slide"/><geom type="sphere" size=".1"/></body>
    <body name="swing"><joint type="hinge"/><geom name="swing" type="sphere" size=".1"/></body>
    <body name="ball"><freejoint/><geom type="sphere" size=".1"/></body>
    <body name="cup"><geom type="sphere" size=".1"/></body>
  </worldbody>
  <tendon><fixed name="rope"><joint joint="pulled" coef="1"/></fixed></tendon>
  <equality><joint joint1="follower" joint2="arm"/></equality>
  <actuator>{actuators}</actuator>
</mujoco>
"""


@pytest.fixture
def roles() -> Roles:
    scene = Scene(XML.format(actuators='<motor joint="arm"/><motor tendon="rope"/>'))
    geometry = ContactGeometry(
        ("ball", "cup"), np.array([0, 1, 1]), np.zeros((3, 3)), np.full(3, 0.01), np.full(3, 0.1), np.ones(3)
    )
    model = Model(scene, geometry)
    return Roles.of(model.compile(), model)


def role_of(roles: Roles) -> dict[str, str]:
    return dict(zip(roles.bodies, roles.body_role, strict=True))


def test_bodies_that_actuators_move_are_robot_also_through_equalities_and_tendons(roles: Roles):
    found = role_of(roles)
    assert {name for name, role in found.items() if role == "robot"} == {"arm", "tip", "follower", "pulled"}


def test_bodies_with_contact_geometry_are_objects_even_if_fixed(roles: Roles):
    assert {name for name, role in role_of(roles).items() if role == "object"} == {"ball", "cup"}


def test_what_stands_still_or_swings_freely_is_world(roles: Roles):
    found = role_of(roles)
    assert {found[name] for name in ("world", "table", "base", "swing")} == {"world"}


def test_nothing_is_robot_without_actuators():
    model = Model(Scene(XML.format(actuators="")))
    assert "robot" not in Roles.of(model.compile(), model).body_role


def test_a_link_is_one_entity_and_spheres_know_their_index(roles: Roles):
    entities = {entity.name: entity for entity in roles.entities}
    assert entities["tip"].role == "robot"
    assert "tip_a" not in entities
    assert {name: e.sphere for name, e in entities.items() if e.sphere is not None} == {
        "ball_sphere0": 0,
        "cup_sphere0": 1,
        "cup_sphere1": 2,
    }
    assert entities["floor"].body == "world"


def test_names_stay_unique_where_a_geom_is_named_like_a_link():
    scene = Scene(XML.format(actuators='<motor joint="arm"/>').replace('name="swing"', 'name="arm"', 2))
    spec = scene.xml.replace('<body name="arm"><joint type="hinge"/>', '<body name="swing"><joint type="hinge"/>')
    model = Model(Scene(spec))
    found = Roles.of(model.compile(), model)
    assert len({entity.name for entity in found.entities}) == len(found.entities)
    assert {"arm", "arm_geom"} <= {entity.name for entity in found.entities}
