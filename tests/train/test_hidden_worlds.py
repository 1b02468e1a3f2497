"""Effects hidden in the world in which a policy is tried."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_insertion import EXACT_STATE, SETTINGS

from concent_warp.cli import main
from concent_warp.deploy.cfg import RealityWorldCfg
from concent_warp.deploy.reality_world import reality_environment
from concent_warp.errors import ConcentError
from concent_warp.reality.fingers import pad_geoms
from concent_warp.reality.hidden.in_task import APPLICABLE, TaskWorld, parse_effects
from concent_warp.reality.rigs.grasp import SCENE
from concent_warp.reality.variation import VariationCfg
from concent_warp.reality.world import WorldCfg
from concent_warp.scene.scene import Scene
from concent_warp.train.environment.physics import Actor, MujocoPhysics
from concent_warp.train.observation_cfg import ObservationCfg

MAGNITUDES = {
    "stribeck_friction": 5.0,
    "joint_friction": 5.0,
    "load_friction": 0.3,
    "joint_damping": 20.0,
    "joint_stiffness": 60.0,
    "armature": 0.5,
    "gravity_compensation": 0.3,
    "actuator_gain": 0.7,
    "actuator_saturation": 3.0,
    "actuator_delay": 0.02,
    "actuator_lag": 0.02,
    "backlash": 0.002,
    "joint_compliance": 1e-3,
    "mass": 1.5,
    "center_of_mass": 0.005,
    "inertia": 50.0,
    "size": 1.1,
    "contact_geometry": 0.003,
    "grip_force": 0.5,
    "pad_friction": 0.1,
    "gravity_tilt": 0.1,
    "cogging": 2.0,
    "cable": 60.0,
    "warming": 5.0,
    "dropout": 0.5,
}


def world(*given: str) -> TaskWorld:
    return TaskWorld(SCENE, WorldCfg(), "block", ("gripper",), parse_effects(given))


def moved(given: Sequence[str], worlds: int = 1) -> np.ndarray:
    """Return where everything is after a grasp, a lift and a shake, shape (steps, worlds, nq)."""
    made = world(*given)
    actors = [[Actor(one.effect.force, one.effect.command) for one in made.hidden()] for _ in range(worlds)]
    physics = MujocoPhysics(made.compile(), worlds, 50, actors=actors)
    physics.qpos[:] = torch.as_tensor([0.0, -0.008, 0.035, 0.035, 0.0, 0.0, 0.02, 1.0, 0.0, 0.0, 0.0])
    steps = []
    for k in range(50):
        time = 0.05 * k
        up = min(max(time - 0.6, 0.0), 0.4) / 0.4
        shake = 0.03 * np.sin(12 * max(time - 1.0, 0.0))
        command = [shake, -0.008 + 0.08 * up, 0.011 if time > 0.1 else 0.035]
        physics.ctrl[:] = torch.tensor(command, dtype=torch.float32)
        physics.advance()
        steps.append(physics.qpos.numpy().copy())
    return np.array(steps)


@pytest.fixture(scope="module")
def plain() -> np.ndarray:
    return moved([])


@pytest.mark.parametrize("name", APPLICABLE)
def test_hidden_effect_changes_what_happens(name, plain):
    found = moved([f"{name}={MAGNITUDES[name]}"])
    assert np.isfinite(found).all()
    assert np.abs(found - plain).max() > 1e-4


def test_block_is_lifted_where_nothing_is_hidden(plain):
    assert plain[-1, 0, 6] > 0.08


def test_worlds_keep_the_states_of_their_effects_apart():
    given = ["joint_friction=5", "actuator_delay=0.02"]
    together, alone = moved(given, worlds=3), moved(given)
    np.testing.assert_array_equal(together, np.repeat(alone, 3, axis=1))


def test_several_effects_act_together():
    both = moved(["mass=1.5", "joint_friction=5"])
    for one in (["mass=1.5"], ["joint_friction=5"]):
        assert np.abs(both - moved(one)).max() > 1e-4
    m, heavier = world().compile(), world("mass=1.5").compile()
    assert heavier.body("block").mass == pytest.approx(1.5 * m.body("block").mass)


def test_what_cannot_be_hidden_is_refused_with_what_can():
    with pytest.raises(ConcentError, match=r"'joint_frction'.*joint_friction, stribeck_friction"):
        parse_effects(["joint_frction=1"])
    with pytest.raises(ConcentError, match="name=value"):
        parse_effects(["mass"])
    with pytest.raises(ConcentError, match="twice"):
        parse_effects(["mass=1.1", "mass=1.2"])
    with pytest.raises(ConcentError, match=r"cannot be built.*mass=-1"):
        world("mass=-1").compile()
    nameless = Scene(SCENE.xml.replace('name="left_pad"', "").replace('name="right_pad"', ""))
    with pytest.raises(ConcentError, match="no geom of the fingers"):
        TaskWorld(nameless, WorldCfg(), "block", ("gripper",), parse_effects(["pad_friction=0.5"]))


def test_unknown_effects_are_refused_before_anything_runs(capsys):
    assert main(["evaluate", "--checkpoint", "nothing", "--hide", "magic=1"]) == 2
    assert "joint_friction" in capsys.readouterr().err
    assert main(["evaluate", "--checkpoint", "nothing", "--hide", "mass=2", "--world", "simulation"]) == 2
    assert "hidden effects exist only in Reality" in capsys.readouterr().err


def test_pads_are_the_geoms_of_all_fingers():
    assert pad_geoms(SCENE.model, ["gripper"]) == ("left_pad", "right_pad")
    assert pad_geoms(SCENE.model, ["nothing"]) == ()


def test_friction_of_reality_differs_between_worlds_and_seeds_unless_it_is_switched_off(task, states):
    block, known = task.compiled.body("block").geomadr[0], RealityWorldCfg(variation=VariationCfg(enabled=False))

    def frictions(seed: int, world: RealityWorldCfg | None = None) -> list[float]:
        environment = reality_environment(task, replace(SETTINGS, worlds=4), states, world, seed=seed)
        physics = environment.physics
        assert isinstance(physics, MujocoPhysics)
        assert physics.model.opt.timestep == pytest.approx(5e-4)
        assert environment.control_step == pytest.approx(physics._decimation * 5e-4) == pytest.approx(0.05)
        return [float(m.geom_friction[block, 0]) for m in physics._models]

    first = frictions(0)
    low, high = VariationCfg().friction
    assert len(set(first)) == 4
    assert all(low <= value <= high for value in first)
    assert frictions(0) == first
    assert not set(frictions(1)) & set(first)
    assert len(set(frictions(0, known))) == 1


@pytest.mark.parametrize("exact", [False, True])
def test_policy_observes_reality_through_its_own_sensors(task, states, exact):
    """The settings of the training's sensors do not matter."""
    trained = EXACT_STATE if not exact else ObservationCfg()
    world = RealityWorldCfg(sensors=EXACT_STATE.sensors) if exact else RealityWorldCfg()
    environment = reality_environment(task, replace(SETTINGS, worlds=2, observation=trained), states, world)
    assert (environment.estimate is None) == exact
    assert ("truth" in environment.get_observations().keys()) != exact  # noqa: SIM118
