"""Springs along tendons: nominal values of a model, and effects."""

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.effects.library.tendons import TendonDamping, TendonFriction, TendonStiffness
from concent_warp.effects.registry import effect_class
from concent_warp.errors import ModelError
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene
from tests.scenes.foreign import PUSHER

SLED = """
<mujoco>
  <worldbody>
    <body name="stage"><joint name="stage" type="slide"/><geom size="0.1"/></body>
    <body name="sled"><joint name="sled" type="slide"/><geom size="0.1"/></body>
  </worldbody>
  <tendon>
    <fixed name="rope"><joint joint="sled" coef="1"/></fixed>
    <fixed name="spring" stiffness="150" damping="0.3">
      <joint joint="stage" coef="1"/><joint joint="sled" coef="-1"/>
    </fixed>
  </tendon>
</mujoco>
"""


def test_springs_of_tendons_are_nominal_values(tmp_path):
    kind = effect_class("nominal_tendon_stiffness")
    model = Model(Scene(SLED))
    plain = model.compile()
    assert kind.targets(plain) == (("spring",),)
    stiff = model.add_effect(kind.name, ["spring"], {"stiffness[spring]": 1.01})
    stiff.save(tmp_path / "model.toml")
    m = Model.load(tmp_path / "model.toml").compile()
    np.testing.assert_allclose(m.tendon_stiffness, [0, 151.5])
    np.testing.assert_array_equal(m.tendon_damping, plain.tendon_damping)
    assert kind.targets(Model(Scene(PUSHER)).compile()) == ()


def test_a_tendon_that_is_not_there_is_named():
    with pytest.raises(ModelError, match=r"tendons among \['rope', 'spring'\]"):
        Model(Scene(SLED)).add_effect("nominal_tendon_stiffness", ["string"], {})


HANGING = """
<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody><site name="hook" pos="0 0 1"/>
  <body name="bob" pos="0 0 0.4"><joint name="z" type="slide" axis="0 0 1"/><geom size="0.03" mass="0.5"/>
    <site name="eye"/></body></worldbody>
<tendon><spatial name="cord" stiffness="80" damping="0.4" springlength="0.5"><site site="hook"/><site site="eye"/>
</spatial><spatial name="slack"><site site="hook"/><site site="eye"/></spatial></tendon></mujoco>"""


def test_a_cord_of_another_stiffness_and_length_sags_as_hooke_says():
    model = Model(Scene(HANGING))
    for stiffness, length in ((80.0, 0.5), (50.0, 0.5), (80.0, 0.45)):
        values = {"stiffness[cord]": stiffness, "length[cord]": length}
        m = model.add(TendonStiffness("cord"), values).add(TendonDamping("cord"), [15.0]).compile()
        d = mujoco.MjData(m)
        mujoco.mj_step(m, d, 4000)
        assert d.ten_length[0] == pytest.approx(length + 0.5 * 9.81 / stiffness, abs=1e-6)


def test_a_range_of_lengths_without_force_is_shifted_as_a_whole():
    slack = HANGING.replace('springlength="0.5"', 'springlength="0.4 0.6"')
    (stiffness, length), m = TendonStiffness("cord").parameters(Scene(slack).model), Scene(slack).model
    assert (stiffness.null, length.null, length.unit) == (80.0, pytest.approx(0.5), "m")
    TendonStiffness("cord").write(m, np.array([70.0, 0.53]))
    np.testing.assert_allclose(m.tendon_lengthspring[0], [0.43, 0.63])
    assert m.tendon_stiffness[0] == 70.0


def test_units_of_tendons_are_those_of_the_joints_that_they_add_up():
    turning = SLED.replace('type="slide"', "")
    found = [p.unit for p in TendonStiffness("spring").parameters(Scene(turning).model)]
    assert found == ["N m/rad", "rad"]
    (damping,) = TendonDamping("spring").parameters(Scene(turning).model)
    assert (damping.unit, damping.null) == ("N m s/rad", 0.3)


def test_friction_along_a_tendon_holds_what_hangs_on_it_and_slows_it_by_its_size():
    xml = SLED.replace("<worldbody>", "<option timestep='0.001' gravity='3 0 0'/><worldbody>")
    xml = xml.replace(' stiffness="150" damping="0.3"', "").replace('type="slide"', 'type="slide" axis="1 0 0"')
    model = Model(Scene(xml.replace('size="0.1"', 'size="0.1" contype="0" conaffinity="0"')))
    assert TendonFriction.targets(model.compile()) == (("rope", "spring"),)
    weight = 3.0 * float(model.compile().body("sled").mass[0])
    for share in (1.2, 0.4):
        m = model.add(TendonFriction("rope"), [share * weight]).compile()
        d = mujoco.MjData(m)
        mujoco.mj_step(m, d, 200)
        assert d.joint("sled").qvel[0] == pytest.approx(max(1 - share, 0.0) * 3.0 * 0.2, abs=3e-3)
        assert d.joint("stage").qvel[0] == pytest.approx(3.0 * 0.2, abs=1e-6)


def test_friction_along_a_tendon_has_the_units_of_what_the_tendon_adds_up():
    (force,) = TendonFriction("rope").parameters(Scene(SLED).model)
    assert (force.name, force.unit, force.null) == ("force[rope]", "N", 0.0)
    (torque,) = TendonFriction("rope").parameters(Scene(SLED.replace('type="slide"', "")).model)
    assert torque.unit == "N m"
    still = SLED.replace('<joint joint="sled" coef="1"/></fixed>', '<joint joint="sled" coef="0"/></fixed>')
    assert TendonFriction.targets(Scene(still).model) == (("spring",),)


def test_tendons_without_a_spring_have_none_of_another_stiffness():
    m = Scene(HANGING).model
    assert TendonStiffness.targets(m) == (("cord",),)
    with pytest.raises(ModelError, match="tendons with a stiffness"):
        Model(Scene(HANGING)).add(TendonStiffness("slack"), [1.0, 1.0])


def bounced(stiffness: float, mass: float) -> Recording:
    """Return 4 s of a bob on a cord of some stiffness [N/m], swung up and down, by Hooke's law alone."""
    clock, rest, rng = np.arange(0, 4.0, 0.01), 0.5, np.random.default_rng(0)
    rows = solve_ivp(
        lambda _, y: [y[1], -9.81 + (stiffness * (1.0 - y[0] - rest) - 0.4 * y[1]) / mass],
        (0.0, 4.0), [0.4, 0.0], t_eval=clock, rtol=1e-9, atol=1e-11,
    ).y[0]  # fmt: skip
    height = (rows + rng.normal(0, 2e-4, len(clock)))[:, None]
    place = np.hstack([0 * height, 0 * height, height]) + rng.normal(0, 2e-4, (len(clock), 3)) * [1, 1, 0]
    sensor = '<sensor><framepos name="bob" objtype="body" objname="bob"/></sensor></mujoco>'
    xml = HANGING.replace("</mujoco>", sensor)
    return Recording(xml, (Demonstration("demo_0", measured={"bob": Channel(clock, place, 2e-4)}),))


def test_another_stiffness_of_a_cord_is_named_beside_the_mass_that_explains_the_same():
    """Only their ratio shows in sag and frequency; the damping tells a little."""
    recording = bounced(55.0, 0.5)
    effects = ("tendon_stiffness", "tendon_damping", "mass", "air_drag", "gravity_tilt")
    cfg = DiagnoseCfg(jobs=1, explain=False, effects=effects)
    found = diagnose(Model.from_recording(recording), recording, cfg)
    assert found.verdict in ("effect", "group")
    assert "tendon_stiffness" in found.groups[0]
    assert set(found.groups[0]) <= {"tendon_stiffness", "mass"}
    (finding,) = (f for f in found.effects if f.name == "tendon_stiffness" and f.step == 0)
    assert finding.parameters[0].low <= 55.0 <= finding.parameters[0].high
