"""What holds for every effect of the registry, on scenes in which nothing is at its default."""

import numpy as np
import pytest
from small_worlds import Motion, move

from concent_warp.effects.effect import Effect, variant_fields
from concent_warp.effects.registry import effect_class, effect_classes
from concent_warp.errors import ConcentError, ModelError
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine

ARM = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body name="upper">
  <joint name="shoulder" axis="0 1 0" damping="0.01" armature="0.002" frictionloss="0.01" stiffness="0.1"/>
  <geom type="capsule" fromto="0 0 0 0.02 0 -0.1" size="0.01" mass="0.4"/>
  <body name="lower" pos="0.02 0 -0.1"><joint name="elbow" axis="0 1 0" damping="0.005"/>
    <geom type="capsule" fromto="0 0 0 0.01 0 -0.1" size="0.01" mass="0.2"/></body>
</body></worldbody><actuator>
  <position name="shoulder" joint="shoulder" kp="4" kv="0.05" forcerange="-2 2"/>
  <position name="elbow" joint="elbow" kp="2" kv="0.02"/></actuator>
<sensor><jointpos name="shoulder" joint="shoulder"/><jointvel name="elbow" joint="elbow"/></sensor></mujoco>"""

TOSS = """
<mujoco><option timestep="0.002" integrator="implicitfast" cone="elliptic"/><worldbody>
  <geom name="floor" type="plane" size="5 5 0.1" friction="0.3 0.004" solref="0.01 0.8"/>
  <geom name="wall" type="box" pos="0.2 0 0.1" size="0.02 1 0.2" friction="0.5" solref="0.02 1"/>
  <body name="box" pos="0 0 0.08" euler="10 20 30"><freejoint/>
    <geom name="box" type="box" size="0.05 0.04 0.03" mass="0.3" friction="0.2 0.001" solref="0.015 0.9"/>
    <geom name="drawn" type="sphere" size="0.05" mass="0.01" contype="0" conaffinity="0"/></body>
</worldbody><sensor><framepos name="position" objtype="body" objname="box"/>
<framequat name="orientation" objtype="body" objname="box"/></sensor></mujoco>"""

GRASP = """
<mujoco><option timestep="0.002" integrator="implicitfast" iterations="50" ls_iterations="50"/><worldbody>
  <geom name="floor" type="plane" size="1 1 0.1"/>
  <body name="palm" pos="0 0 0.1"><joint name="lift" type="slide" axis="0 0 1"/>
    <geom type="box" size="0.03 0.03 0.01" mass="0.3" contype="0" conaffinity="0"/>
    <body name="left" pos="0 0.04 -0.06"><joint name="left" type="slide" axis="0 -1 0"/>
      <geom type="box" size="0.01 0.005 0.03" mass="0.05" friction="0.7 0.003" solref="0.01 1" condim="4"/></body>
    <body name="right" pos="0 -0.04 -0.06"><joint name="right" type="slide" axis="0 1 0"/>
      <geom type="box" size="0.01 0.005 0.03" mass="0.05" friction="0.7 0.003" solref="0.01 1" condim="4"/></body>
  </body>
  <body name="block" pos="0.002 0 0.0199"><freejoint/>
    <geom type="box" size="0.02 0.02 0.02" mass="0.08" friction="0.6 0.002" solref="0.016 1"/></body>
</worldbody><actuator>
  <position name="lift" joint="lift" kp="500" kv="20"/>
  <position name="left" joint="left" kp="300" kv="10"/>
  <position name="right" joint="right" kp="300" kv="10"/></actuator>
<sensor><framepos name="block" objtype="body" objname="block"/><jointpos name="lift" joint="lift"/></sensor></mujoco>"""

CORD = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><site name="hook" pos="0 0 0.6"/>
  <body name="bob"><freejoint/><geom name="bob" size="0.04" mass="0.4"/><site name="eye" pos="0 0 0.03"/></body>
  <body name="sled" pos="1 0 0"><joint name="sled" type="slide" damping="0.5"/>
    <geom name="sled" size="0.04" mass="0.4"/>
    <body name="load"><joint name="load" type="slide" range="-0.05 0.3"/>
      <geom name="load" size="0.03" mass="0.2"/></body></body>
</worldbody><tendon>
  <spatial name="cord" stiffness="60" damping="0.2" springlength="0.45"><site site="hook"/><site site="eye"/></spatial>
  <fixed name="band" stiffness="30"><joint joint="load" coef="1"/></fixed></tendon>
<sensor><framepos name="bob" objtype="body" objname="bob"/><jointpos name="load" joint="load"/></sensor></mujoco>"""

TIME = np.arange(300) * 0.002
CLOSING = 0.03 * np.clip(TIME / 0.2, 0, 1)
SCENES = {
    "arm": (ARM, {"ctrl": np.stack([np.sin(6 * TIME), np.sign(np.sin(9 * TIME))], axis=1), "qvel": [0.5, -0.5]}),
    "toss": (TOSS, {"qvel": [1.5, 0.3, 0, 1, 2, 3]}),
    "cord": (CORD, {"qvel": [0.2, 0.1, 0.3, 0, 0, 0, 0.5, -0.6]}),
    "grasp": (GRASP, {"ctrl": np.stack([0.1 * np.clip(TIME - 0.3, 0, 0.3), CLOSING, CLOSING], axis=1)}),
}
MODELS = {scene: Model(Scene(xml)) for scene, (xml, _) in SCENES.items()}
FOUND: list[tuple[str, Effect]] = [
    (scene, cls(*target))
    for cls in effect_classes().values()
    for scene, model in MODELS.items()
    for target in (*cls.targets(model.compile()), *cls.single_targets(model.compile()))
]
CASES = [pytest.param(scene, e, id=f"{e.name} {scene} {' '.join(e.target)}") for scene, e in FOUND]
VARYING = [
    pytest.param(scene, e, id=f"{e.name} {scene} {' '.join(e.target)}")
    for scene, e in FOUND
    for m in [MODELS[scene].compile()]
    if not e.edits and (e.fields(m) or e.force_model(m))
]
"""Effects that act by fields or by force models."""
DERIVED = {"body_margin", "flg_gravcomp"}
"""What engines derive from the fields that `write` sets."""


def first_case(name: str) -> tuple[Model, Effect]:
    """Return the first scene and target that an effect applies to."""
    return next((MODELS[scene], effect) for scene, effect in FOUND if effect.name == name)


def typical(effect: Effect, model: Model) -> list[float]:
    """Return values away from null."""
    rows = effect.parameters(model.compile())
    return [p.scan[0] if p.scan else p.null + (p.scale if p.null < p.high else -p.scale) for p in rows]


@pytest.fixture(scope="module")
def plain() -> dict[str, Motion]:
    return {scene: move(MODELS[scene], 0.6, **motion) for scene, (_, motion) in SCENES.items()}


@pytest.mark.parametrize("name", effect_classes())
def test_every_effect_applies_somewhere(name):
    assert any(effect.name == name for _, effect in FOUND)


@pytest.mark.parametrize(("scene", "effect"), [c for c in CASES if "wind" not in str(c.id)])
def test_null_values_leave_motion_commands_and_readings_as_they_were(scene, effect, plain):
    model = MODELS[scene].add(effect)
    null = move(model, 0.6, **SCENES[scene][1])
    np.testing.assert_allclose(null.qpos, plain[scene].qpos, rtol=0, atol=1e-9)
    read = effect.measure(model.compile(), null.read, model.effects[0].array)
    for sensor, value in plain[scene].sensor.items():
        np.testing.assert_allclose(read(sensor, plain[scene].time), value, rtol=0, atol=1e-6)


def test_null_wind_is_still_air():
    still = move(MODELS["toss"].add(effect_class("wind")("box")), 0.6, **SCENES["toss"][1])
    drag = move(MODELS["toss"].add(effect_class("air_drag")("box"), [1.2]), 0.6, **SCENES["toss"][1])
    np.testing.assert_allclose(still.qpos, drag.qpos, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", effect_classes())
def test_typical_values_change_what_is_measured_somewhere(name, plain):
    largest = 0.0
    for scene, effect in FOUND:
        if effect.name != name:
            continue
        model = MODELS[scene].add(effect, typical(effect, MODELS[scene]))
        moved = move(model, 0.6, **SCENES[scene][1])
        read = effect.measure(model.compile(), moved.read, model.effects[0].array)
        for sensor, value in plain[scene].sensor.items():
            largest = max(largest, float(np.abs(read(sensor, moved.time) - value).max()))
    assert largest > 1e-5


@pytest.mark.parametrize(("scene", "effect"), CASES)
def test_fields_cover_what_write_sets(scene, effect):
    model = MODELS[scene].add(effect)
    before, after = model.compile(), model.compile()
    effect.write(after, np.array(typical(effect, MODELS[scene])))
    changed = set()
    for owner, prefix in ((lambda m: m, ""), (lambda m: m.opt, "opt.")):
        for field in (name for name in dir(owner(before)) if not name.startswith("_")):
            value = getattr(owner(before), field)
            if isinstance(value, np.ndarray | float | int) and not np.array_equal(value, getattr(owner(after), field)):
                changed.add(prefix + field)
    assert changed - DERIVED <= set(effect.fields(before))
    assert changed or not effect.fields(before)


@pytest.mark.parametrize(("scene", "effect"), VARYING)
def test_values_as_fields_and_laws_of_variants_do_the_same_as_in_the_model(scene, effect):
    values = np.array([typical(effect, MODELS[scene])])
    motion = dict(SCENES[scene][1])
    null = MODELS[scene].add(effect)
    engine = MujocoEngine(null, threads=1)
    m = engine.compiled
    fields = variant_fields(m, [effect], values, [slice(None)])
    force_model = effect.force_model(m)
    start = {name: np.array([motion[name]], dtype=float) for name in ("qpos", "qvel") if name in motion}
    ctrl = effect.command(m, motion.get("ctrl", np.zeros((300, m.nu))), values[0])
    force_models = None if force_model is None else ((force_model, values),)
    varied = engine.run(Variants(1, fields=fields, force_models=force_models, **start), ctrl)
    added = move(MODELS[scene].add(effect, values[0]), 0.6, **motion)
    np.testing.assert_allclose(varied.qpos[0], added.qpos, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", effect_classes())
def test_saved_model_is_the_same_when_loaded(name, tmp_path):
    model, effect = first_case(name)
    for values in (None, typical(effect, model)):
        saved = model.add(effect, values)
        saved.save(tmp_path / "model.toml")
        loaded = Model.load(tmp_path / "model.toml")
        (found,), (given,) = loaded.effects, saved.effects
        assert type(found.effect) is type(given.effect)
        assert (found.effect.target, found.values) == (given.effect.target, given.values)
        a, b = saved.compile(), loaded.compile()
        for field in dir(a):
            value = getattr(a, field)
            if isinstance(value, np.ndarray) and value.dtype.kind in "fi":
                np.testing.assert_allclose(getattr(b, field), value, rtol=1e-5, atol=1e-9, err_msg=field)


@pytest.mark.parametrize("name", effect_classes())
def test_confusions_and_words_are_there(name):
    cls = effect_classes()[name]
    assert set(cls.confusions) <= set(effect_classes())
    assert name not in cls.confusions
    assert all(getattr(cls, text).strip() for text in ("summary", "source", "signature", "family", "kind"))
    assert set(cls.engines) <= {"mujoco", "warp"}


@pytest.mark.parametrize("name", effect_classes())
def test_parameters_have_bounds_around_their_null_values(name):
    model, effect = first_case(name)
    rows = effect.parameters(model.compile())
    assert len({p.name for p in rows}) == len(rows) > 0
    for p in rows:
        assert p.low < p.high
        assert p.low <= p.null <= p.high or np.isinf(p.null)
        assert 0 < p.scale < np.inf
        assert all(p.low <= value <= p.high for value in p.scan)
        assert p.unit


def one_sentence(error: ConcentError, *words: str) -> None:
    """Check that an error is one line, and says some words."""
    text = str(error)
    assert "\n" not in text
    assert all(word in text for word in words), text


@pytest.mark.parametrize("name", effect_classes())
def test_wrong_target_value_or_name_gives_one_clear_sentence(name):
    model, effect = first_case(name)
    m = model.compile()
    rows = effect.parameters(m)
    cls = type(effect)
    with pytest.raises(ModelError) as raised:
        model.add(cls("nowhere"))
    one_sentence(raised.value, name, "nowhere")
    with pytest.raises(ModelError) as raised:
        model.add(effect, [p.null for p in rows] + [0.0])
    one_sentence(raised.value, name, rows[0].name)
    with pytest.raises(ModelError) as raised:
        model.add(effect, {"nothing": 1.0})
    one_sentence(raised.value, name, "nothing", rows[0].name)
    for value in (rows[0].low - 1, rows[0].high + 1, np.nan):
        with pytest.raises(ModelError) as raised:
            model.add(effect, {rows[0].name: value})
        one_sentence(raised.value, name, rows[0].name, "out of bounds")
    with pytest.raises(ModelError) as raised:
        model.add(effect).add(effect)
    one_sentence(raised.value, name, "already")
    with pytest.raises(ModelError) as raised:
        effect_class(name[:-1])
    one_sentence(raised.value, name)


@pytest.mark.parametrize(
    ("scene", "name", "target"),
    [
        ("toss", "joint_friction", ("loose",)),
        ("arm", "backlash", ("torque",)),
        ("arm", "sliding_friction", ("bare",)),
        ("arm", "pad_friction", ("bare",)),
        ("arm", "actuator_saturation", ("site",)),
        ("arm", "actuator_gain", ()),
        ("arm", "length_scale", ("shoulder",)),
        ("arm", "frame_offset", ("shoulder",)),
        ("toss", "contact_compliance", ("box",)),
    ],
)
def test_target_that_the_effect_cannot_act_on_is_refused(scene, name, target):
    xml = SCENES[scene][0]
    xml = xml.replace("<freejoint/>", '<freejoint name="loose"/>').replace('solref="0.015 0.9"', 'solref="-100 0"')
    xml = xml.replace("</actuator>", '<motor name="torque" joint="elbow"/><motor name="site" site="tip"/></actuator>')
    xml = xml.replace("</worldbody>", '<body name="bare"><site name="tip"/></body></worldbody>')
    with pytest.raises(ModelError) as raised:
        Model(Scene(xml)).add(effect_class(name)(*target))
    one_sentence(raised.value, name)
