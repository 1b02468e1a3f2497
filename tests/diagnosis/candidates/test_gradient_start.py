"""Starts of fits by gradients through Newton, on a block that slides farther than its model."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.diagnosis.candidates.fit_candidate import fit_candidate, polish_candidate
from concent_warp.diagnosis.candidates.gradient_start import GradientStarts, _factor_of, _scaled
from concent_warp.diagnosis.candidates.screening import screen
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.diagnosis.procedure import Procedure
from concent_warp.diagnosis.tasks import TaskRunner
from concent_warp.effects.library.contact import ContactCompliance, SlidingFriction
from concent_warp.effects.library.objects import Inertia, Mass
from concent_warp.errors import ModelError
from concent_warp.fit.newton.scale_factors import Factors
from concent_warp.model import ContactParameters, Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

TRUE, GIVEN, NOISE = 0.1, 0.4, 1e-4
"""Friction of the block and of its model, and noise of a coordinate [m]."""
SLIDING = """
<mujoco>
  <option timestep="0.002" cone="elliptic"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" friction="{friction}"/>
    <body name="block" pos="0 0 0.02">
      <freejoint/><geom type="box" size="0.02 0.02 0.02" mass="0.08" friction="{friction}"/>
    </body>
  </worldbody>
  <sensor>
    <framepos name="position" objtype="xbody" objname="block"/>
    <framequat name="orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""


@pytest.fixture(scope="module")
def slid():
    """The block as spheres in its corners slides at 0.5 m/s for 0.4 s, its friction a quarter of its model's."""
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * 0.018
    eight = [np.full(8, v) for v in (0.002, 0.01, GIVEN)]
    spheres = ContactGeometry(("block",), np.zeros(8, int), corners, *eight)
    model = Model(Scene(SLIDING.format(friction=GIVEN)), spheres, ContactParameters(condim=3))
    m = model.add(SlidingFriction("block"), [TRUE]).compile()
    d, rng = mujoco.MjData(m), np.random.default_rng(0)
    d.qvel[0] = 0.5
    qpos, qvel, read = d.qpos.copy(), d.qvel.copy(), []
    for _ in range(41):
        mujoco.mj_forward(m, d)
        read.append(d.sensordata + NOISE * rng.standard_normal(7))
        mujoco.mj_step(m, d, 5)
    clock, value = np.arange(41) / 100, np.array(read)
    measured = {
        "position": Channel(clock, value[:, :3], noise_std=NOISE),
        "orientation": Channel(clock, value[:, 3:] / np.linalg.norm(value[:, 3:], axis=1, keepdims=True)),
    }
    return model, Recording(model.scene.xml, (Demonstration("demo_0", qpos=qpos, qvel=qvel, measured=measured),))


@pytest.fixture(scope="module")
def base(slid):
    model, recording = slid
    return Procedure(model, recording, DiagnoseCfg(jobs=1)).baseline()


def test_gradients_start_the_fit_of_friction_near_the_truth_and_leave_others_alone(slid, base):
    screened = [screen(base, effect) for effect in (SlidingFriction("block"), Inertia("block"))]
    friction, inertia = GradientStarts(*slid).apply(base, screened, TaskRunner())
    assert inertia is screened[1]
    assert screened[0].start[0] == pytest.approx(0.7 * GIVEN)
    assert friction.start[0] == pytest.approx(TRUE, rel=0.15)
    assert friction.scanned_gain > screened[0].scanned_gain
    found = polish_candidate(base, fit_candidate(base, friction))
    assert found.fit.values[0] == pytest.approx(TRUE, rel=0.02)
    # The model as given is so far off that residuals count in units of about 8 times the noise until one is added.
    assert base.noise_scale > 5
    assert found.ratio < 1.5


def test_a_worse_value_is_not_taken(slid, base):
    screened = screen(base, SlidingFriction("block"))
    starts = GradientStarts(*slid)
    starts.factors = replace(starts.factors, friction=4.0)
    (same,) = starts.apply(base, [screened], TaskRunner())
    np.testing.assert_array_equal(same.start, screened.start)
    assert not same.measured
    assert same.scanned_gain == screened.scanned_gain


def test_factors_are_turned_into_the_values_of_effects():
    found = Factors(0.5, 0.25, {"block": 1.5}, 1.0, 1.0, {}, 0, 0.0)
    cases = (
        (SlidingFriction("block"), [0.4], [0.2]),
        (Mass("block"), [1.0], [1.5]),
        (ContactCompliance("block"), [0.01, 1.0], [0.02, 1.0]),  # a quarter as stiff: twice the time constant
        (Mass("arm"), [1.0], [1.0]),
    )
    for effect, null, value in cases:
        np.testing.assert_allclose(_scaled(effect, np.array(null), _factor_of(effect, found)), value)


def test_what_gradients_cannot_do_is_reported_before_anything_is_fitted(slid):
    model, recording = slid

    def never(*said):
        raise AssertionError(said)

    with pytest.raises(ModelError, match="contact geometry of spheres"):
        diagnose(replace(model, geometry=None), recording, DiagnoseCfg(jobs=1, gradient=True), progress=never)
