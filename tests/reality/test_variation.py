"""Friction, masses and gains of Reality that differ from the nominal model's."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.checks import check_settings
from concent_warp.errors import ConcentError
from concent_warp.reality.fingers import pad_geoms
from concent_warp.reality.record import RealityCfg, record
from concent_warp.reality.variation import VariationCfg
from concent_warp.reality.world import INTEGRATORS, WorldCfg
from concent_warp.recording.recording import Demonstration

OBJECTS = ("block", "box")
WORLDS = 300
RANGES = VariationCfg(friction=(0.1, 0.4), grip=(0.5, 0.7), mass=(1.5, 2.0), gain=(0.8, 1.2))


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    task = RealityCfg().task
    return WorldCfg().build(task.build(), ()).compile()


@pytest.fixture(scope="module")
def pads(model) -> tuple[str, ...]:
    return pad_geoms(model, RealityCfg().task.robot.gripper_actuators)


@pytest.fixture(scope="module")
def fields(model, pads) -> dict[str, np.ndarray]:
    return RANGES.sample(model, OBJECTS, pads, WORLDS, np.random.default_rng(0))


def check_uniform(values: np.ndarray, extent: tuple[float, float]) -> None:
    """Check that values (N,) are spread over a range."""
    low, high = extent
    assert values.min() >= low
    assert values.max() <= high
    assert values.mean() == pytest.approx((low + high) / 2, abs=0.06 * (high - low))
    assert values.std() == pytest.approx((high - low) / np.sqrt(12), rel=0.1)


def independent(*columns: np.ndarray) -> bool:
    """Return whether values (N,) each are uncorrelated."""
    correlation = np.corrcoef(np.array(columns)) - np.eye(len(columns))
    return bool(np.abs(correlation).max() < 0.25)


def test_objects_of_a_world_share_a_friction_and_fingers_a_factor(model, pads, fields):
    friction = fields["geom_friction"]
    assert friction.shape == (WORLDS, model.ngeom, 3)
    of_objects = np.isin(model.geom_bodyid, [model.body(name).id for name in OBJECTS])
    fingers = np.isin(np.arange(model.ngeom), [model.geom(name).id for name in pads])
    assert of_objects.sum() > 1
    assert fingers.sum() > 1
    assert not (fingers & of_objects).any()
    common = friction[:, of_objects, 0]
    np.testing.assert_array_equal(common, common[:, :1] * np.ones_like(common))
    check_uniform(common[:, 0], RANGES.friction)
    grip = friction[:, fingers, 0] / model.geom_friction[fingers, 0]
    np.testing.assert_allclose(grip, grip[:, :1] * np.ones_like(grip))
    check_uniform(grip[:, 0], RANGES.grip)
    others = ~(of_objects | fingers)
    np.testing.assert_array_equal(friction[:, others], np.tile(model.geom_friction[others], (WORLDS, 1, 1)))
    np.testing.assert_array_equal(friction[..., 1:], np.tile(model.geom_friction[:, 1:], (WORLDS, 1, 1)))


def test_each_object_has_a_factor_on_mass_and_inertia(model, fields):
    bodies = [model.body(name).id for name in OBJECTS]
    factor = fields["body_mass"][:, bodies] / model.body_mass[bodies]
    for k, body in enumerate(bodies):
        check_uniform(factor[:, k], RANGES.mass)
        np.testing.assert_allclose(fields["body_inertia"][:, body], factor[:, k, None] * model.body_inertia[body])
    others = np.setdiff1d(np.arange(model.nbody), bodies)
    for name in ("body_mass", "body_inertia"):
        value = getattr(model, name)[others]
        np.testing.assert_array_equal(fields[name][:, others], np.broadcast_to(value, (WORLDS, *value.shape)))
    assert independent(*factor.T, fields["geom_friction"][:, model.body("block").geomadr[0], 0])


def test_each_position_control_has_a_factor_on_its_gain(model, fields):
    gain, bias = fields["actuator_gainprm"], fields["actuator_biasprm"]
    factor = gain[:, :, 0] / model.actuator_gainprm[:, 0]
    for actuator in range(model.nu):
        check_uniform(factor[:, actuator], RANGES.gain)
    np.testing.assert_allclose(bias[:, :, 1], factor * model.actuator_biasprm[:, 1])
    kept = [0, *range(2, bias.shape[2])]
    np.testing.assert_array_equal(gain[:, :, 1:], np.tile(model.actuator_gainprm[:, 1:], (WORLDS, 1, 1)))
    np.testing.assert_array_equal(bias[:, :, kept], np.tile(model.actuator_biasprm[:, kept], (WORLDS, 1, 1)))
    assert independent(*factor.T)


def test_values_follow_from_the_generator_and_leave_the_model_as_it_is(model, pads, fields):
    untouched = WorldCfg().build(RealityCfg().task.build(), ()).compile()
    again, other = (RANGES.sample(model, OBJECTS, pads, WORLDS, np.random.default_rng(seed)) for seed in (0, 1))
    assert set(again) == {"geom_friction", "body_mass", "body_inertia", "actuator_gainprm", "actuator_biasprm"}
    for name, value in fields.items():
        np.testing.assert_array_equal(again[name], value)
        assert not np.array_equal(other[name], value)
        np.testing.assert_array_equal(getattr(model, name), getattr(untouched, name))


def test_nothing_varies_where_it_is_switched_off(model, pads):
    rng = np.random.default_rng(0)
    assert replace(RANGES, enabled=False).sample(model, OBJECTS, pads, 5, rng) == {}
    assert rng.random() == np.random.default_rng(0).random()


@pytest.mark.parametrize("name", sorted(INTEGRATORS))
def test_integrator_is_the_one_of_its_name(name):
    scene = RealityCfg().task.build()
    compiled = WorldCfg(integrator=name).build(scene, ()).compile()
    found = mujoco.mjtIntegrator(compiled.opt.integrator)
    assert found.name.lower() == f"mjint_{name}".lower()


def channels(demonstration: Demonstration, kind: str) -> np.ndarray:
    return np.concatenate([channel.value.ravel() for _, channel in sorted(getattr(demonstration, kind).items())])


def test_recording_varies_and_all_else_stays():
    cfg = RealityCfg()
    quick = replace(cfg, expert=replace(cfg.expert, speed=4.0, rate=20.0), world=replace(cfg.world, timestep=0.002))
    off = VariationCfg(enabled=False)
    plain, same, varied, again = (
        record(quick, [0], variation=variation)[0][0] for variation in (None, off, VariationCfg(), VariationCfg())
    )
    assert varied.name == plain.name
    for kind in ("action", "measured"):
        np.testing.assert_array_equal(channels(same, kind), channels(plain, kind))
        np.testing.assert_array_equal(channels(again, kind), channels(varied, kind))
    np.testing.assert_array_equal(channels(varied, "action"), channels(plain, "action"))
    moved = channels(varied, "measured") - channels(plain, "measured")
    assert np.abs(moved).max() > 1e-4


@pytest.mark.parametrize("wrong", [{"friction": (0.5, 0.2)}, {"mass": (0.0, 1.0)}])
def test_ranges_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ConcentError, match="out of bounds"):
        check_settings(VariationCfg(**wrong))


def test_pads_are_those_of_suction_cups_and_of_fingers_that_an_equality_holds():
    model = mujoco.MjModel.from_xml_string("""
<mujoco>
  <worldbody>
    <body><joint name="free" type="slide"/><geom name="other" size="0.1"/></body>
    <body name="a"><joint name="a" type="slide"/><geom name="finger" size="0.1"/><geom size="0.1"/></body>
    <body name="b"><geom name="fixed" size="0.1"/></body>
    <body name="cup"><geom name="lip" size="0.1"/></body>
    <body name="last"><joint name="last" type="slide"/><geom name="last" size="0.1"/></body>
  </worldbody>
  <equality><joint joint1="a"/></equality>
  <actuator><position name="grip" joint="a"/><adhesion name="suction" body="cup" ctrlrange="0 1"/></actuator>
</mujoco>""")
    assert pad_geoms(model, ["suction"]) == ("lip",)
    assert pad_geoms(model, ["grip"]) == ("finger",)
    assert pad_geoms(model, ["grip", "suction", "none"]) == ("finger", "lip")
