"""Every effect gives the same motion in MuJoCo-Warp as in C MuJoCo: all of them at once, one in each world."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest

from concent_warp.effects.effect import Effect, Parameter, variant_fields
from concent_warp.effects.force_model import ForceModel
from concent_warp.effects.library.drives import GAINS
from concent_warp.effects.library.objects import AXES, POINT
from concent_warp.effects.registry import effect_classes
from concent_warp.errors import EngineError
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.warp_engine import WarpEngine

SCENE = """
<mujoco><option timestep="0.002" integrator="implicitfast" cone="elliptic" iterations="50" ls_iterations="50"/>
<worldbody>
  <geom name="floor" type="plane" size="5 5 0.1" friction="0.3 0.004" solref="0.01 1"/>
  <body name="upper" pos="0 0.5 0.5"><joint name="shoulder" axis="0 1 0" damping="0.01" armature="0.002"/>
    <geom type="capsule" fromto="0 0 0 0.02 0 -0.1" size="0.01" mass="0.4" contype="0" conaffinity="0"/>
    <body name="lower" pos="0.02 0 -0.1"><joint name="elbow" axis="0 1 0" damping="0.005"
      range="-0.04 0.4"/>
      <geom type="capsule" fromto="0 0 0 0.01 0 -0.1" size="0.01" mass="0.2" contype="0" conaffinity="0"/></body></body>
  <body name="palm" pos="0 -0.5 0.2"><joint name="lift" type="slide" axis="0 0 1"/>
    <geom type="box" size="0.03 0.03 0.01" mass="0.3" contype="0" conaffinity="0"/>
    <body name="left" pos="0 0.024 -0.06"><joint name="left" type="slide" axis="0 -1 0"/>
      <geom type="box" size="0.01 0.005 0.02" mass="0.05" friction="0.7"/></body>
    <body name="right" pos="0 -0.024 -0.06"><joint name="right" type="slide" axis="0 1 0"/>
      <geom type="box" size="0.01 0.005 0.02" mass="0.05" friction="0.7"/></body></body>
  <body name="block" pos="0 -0.5 0.14"><freejoint/><geom type="box" size="0.02 0.0195 0.02" mass="0.05"/></body>
  <body name="puck" pos="0 0 0.0199"><freejoint/>
    <geom type="box" size="0.05 0.04 0.02" mass="0.3" friction="0.2" solref="0.01 1"/></body>
  <body name="ball" pos="1 0 0.0299"><freejoint/><geom type="sphere" size="0.03" mass="0.1" condim="6"/></body>
</worldbody>
<tendon><fixed name="band" stiffness="0.4" damping="0.01"><joint joint="elbow" coef="1"/></fixed></tendon>
<actuator><position name="shoulder" joint="shoulder" kp="4" kv="0.05"/>
  <position name="elbow" joint="elbow" kp="2" kv="0.02"/><position name="lift" joint="lift" kp="500" kv="20"/>
  <motor name="left" joint="left"/><motor name="right" joint="right"/></actuator>
<sensor><jointpos name="shoulder" joint="shoulder"/><framepos name="puck" objtype="body" objname="puck"/></sensor>
</mujoco>"""
STEPS = 100
QVEL = np.array([0.5, -1.0, 0, 0, 0, *[0] * 6, 0.5, 0.4, 0, 0, 0, 3, 0.3, 0.1, 0, 0, 10, 5])
"""Arm, lift and fingers, block, puck, ball."""
AIR = ("air_drag", "wind")
ON_MOTION = tuple(name for name, cls in effect_classes().items() if cls.family != "measurement" and name not in AIR)


def commands(m) -> np.ndarray:
    """Return commands that reverse the arm, lift the hand and squeeze the block, shape (STEPS, nu)."""
    time = np.arange(STEPS) * m.opt.timestep
    arm = np.stack([0.5 * np.sign(np.sin(40 * time)), 0.3 * np.sin(30 * time), 0.3 * time], axis=1)
    return np.concatenate([arm, np.full((STEPS, 2), 0.8)], axis=1)


def typical(effect: Effect, m) -> list[float]:
    """Return values away from null; pads so slippery that the block falls."""
    if effect.name == "pad_friction":
        return [0.15]
    rows = effect.parameters(m)
    # A limit must be low to act.
    parts = [4 if np.isinf(p.null) else 2 for p in rows]
    return [
        p.scan[len(p.scan) // part] if p.scan else p.null + (p.scale if p.null < p.high else -p.scale)
        for p, part in zip(rows, parts, strict=True)
    ]


def on_every_target(model: Model, names: Sequence[str], part: str = "") -> list[Effect]:
    """Return effects that fields, force models and commands can express, on each target or on a part of each."""
    m = model.compile()
    kinds = [effect_classes()[name] for name in names]
    found = [cls(*t) for cls in kinds for t in (*cls.targets(m), *(cls.single_targets(m) if part else ()))]
    return [e for e in found if not e.edits and (e.target[-1] if e.is_part else "") == part]


def all_at_once(
    device: str, names: Sequence[str] = ON_MOTION, moment: str = ""
) -> tuple[list[Effect], np.ndarray, np.ndarray]:
    """Simulate a world without effects and one for each effect, on both engines.

    Returns:
        The effects, and qpos of both engines, each of shape (1 + effects, STEPS + 1, nq).
    """
    model = Model(Scene(SCENE))
    chosen = on_every_target(model, names, moment)
    values = [typical(effect, model.compile()) for effect in chosen]
    for effect in chosen:
        model = model.add(effect)
    engine, warp_engine = MujocoEngine(model, threads=1), WarpEngine(model, device=device, nconmax=48, njmax=192)
    m = engine.compiled
    parts = [slice(a, b) for a, b in pairwise(np.cumsum([0, *(len(v) for v in values)]))]
    rows = np.tile(np.concatenate([a.array for a in model.effects]), (1 + len(chosen), 1))
    for n, (part, value) in enumerate(zip(parts, values, strict=True)):
        rows[1 + n, part] = value
    acting = ((effect.force_model(m), rows[:, part]) for effect, part in zip(chosen, parts, strict=True))
    ctrl = np.tile(commands(m), (len(rows), 1, 1))
    for n, (effect, value) in enumerate(zip(chosen, values, strict=True)):
        ctrl[1 + n] = effect.command(m, ctrl[1 + n], np.array(value))
    variants = Variants(
        len(rows),
        fields=variant_fields(m, chosen, rows, parts),
        force_models=tuple((force_model, given) for force_model, given in acting if force_model is not None),
        qvel=np.tile(QVEL, (len(rows), 1)),
    )
    expected, found = engine.run(variants, ctrl), warp_engine.run(variants, ctrl).numpy()
    assert not expected.diverged.any()
    assert not found.diverged.any()
    return chosen, expected.qpos, found.qpos


def assert_parity(chosen: list[Effect], expected: np.ndarray, found: np.ndarray) -> None:
    np.testing.assert_allclose(found[0], expected[0], rtol=0, atol=2e-4)
    largest: dict[str, float] = {}
    for n, effect in enumerate(chosen, start=1):
        change = np.abs(expected[n] - expected[0]).max()
        error = np.abs((found[n] - found[0]) - (expected[n] - expected[0])).max()
        assert error < 0.1 * change + 1e-5, (effect, error, change)
        largest[effect.name] = max(change, largest.get(effect.name, 0.0))
    assert min(largest.values()) > 5e-5, largest


def test_every_effect_changes_the_motion_alike_on_both_engines():
    assert_parity(*all_at_once("cpu"))


def test_air_changes_the_motion_alike_on_both_engines():
    assert_parity(*all_at_once("cpu", AIR))


@pytest.mark.parametrize("part", AXES)
def test_single_moments_of_inertia_change_the_motion_alike_on_both_engines(part):
    assert_parity(*all_at_once("cpu", ("inertia",), part))


def test_loads_in_a_point_change_the_motion_alike_on_both_engines():
    assert_parity(*all_at_once("cpu", ("mass",), POINT))


@pytest.mark.parametrize("part", GAINS)
def test_single_gains_change_the_motion_alike_on_both_engines(part):
    assert_parity(*all_at_once("cpu", ("actuator_gain",), part))


@pytest.mark.gpu
@pytest.mark.parametrize("names", [ON_MOTION, AIR], ids=["motion", "air"])
def test_every_effect_changes_the_motion_alike_on_a_gpu(names):
    assert_parity(*all_at_once("cuda:0", names))


def test_engines_agree_on_a_model_that_has_many_effects():
    model = Model(Scene(SCENE))
    for cls in [effect_classes()[name] for name in ON_MOTION]:
        targets = cls.targets(model.compile())
        effect = cls(*(("puck",) if ("puck",) in targets else targets[0]))
        model = model.add(effect, typical(effect, model.compile()))
    engine, warp_engine = MujocoEngine(model, threads=1), WarpEngine(model, device="cpu", nconmax=48, njmax=192)
    ctrl = commands(engine.compiled)[:40]
    variants = Variants(1, qvel=QVEL[None])
    expected, found = engine.run(variants, ctrl), warp_engine.run(variants, ctrl).numpy()
    plain = MujocoEngine(Model(Scene(SCENE)), threads=1).run(variants, ctrl)
    assert np.abs(plain.qpos - expected.qpos).max() > 0.01
    np.testing.assert_allclose(found.qpos, expected.qpos, rtol=0, atol=1e-4)
    again = warp_engine.run(variants, ctrl).numpy()
    np.testing.assert_array_equal(again.qpos, found.qpos)


class Needy(Effect):
    name, family, kind = "needy", "world", "none"
    engines = ("mujoco",)

    @classmethod
    def targets(cls, m):  # noqa: ARG003
        return ((),)

    def parameters(self, m):  # noqa: ARG002
        return (Parameter("size", "-", 0.0, 0.0, 1.0, 0.1),)


class NoKernel(ForceModel):
    def apply(self, m, d, values):  # noqa: ARG002
        d.qfrc_applied[0] += values[0]


class Half(Needy):
    name = "half"
    engines = ("mujoco", "warp")

    def force_model(self, m):  # noqa: ARG002
        return NoKernel()


def test_effect_that_needs_the_other_engine_says_so():
    model = Model(Scene(SCENE)).add(Needy(), [0.5])
    with pytest.raises(EngineError, match=r"needy cannot run on MuJoCo-Warp; use MujocoEngine\.$"):
        WarpEngine(model, device="cpu")


def test_law_without_a_kernel_says_so():
    engine = WarpEngine(Model(Scene(SCENE)).add(Half(), [0.5]), device="cpu", nconmax=48, njmax=192)
    with pytest.raises(EngineError, match=r"^NoKernel cannot run on MuJoCo-Warp; use the mujoco engine\.$"):
        engine.run(Variants(1), commands(engine.compiled)[:2])


def test_drag_that_mujoco_warp_would_get_wrong_is_refused():
    model = Model(Scene(SCENE)).add(effect_classes()["air_drag"]("puck"), [20.0])
    shifted = WarpEngine(model.add(effect_classes()["center_of_mass"]("puck"), [0.01, 0, 0]), device="cpu")
    with pytest.raises(EngineError, match=r"drag is wrong .*\['puck'\]; use MujocoEngine"):
        shifted.run(Variants(1), commands(shifted.compiled)[:2])
    engine = WarpEngine(model, device="cpu")
    moved = np.tile(engine.compiled.body_ipos, (2, 1, 1))
    with pytest.raises(EngineError, match="use MujocoEngine"):
        engine.run(Variants(2, fields={"body_ipos": moved}), commands(engine.compiled)[:2])
