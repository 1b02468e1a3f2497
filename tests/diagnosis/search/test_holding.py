"""Friction that holds against friction that creeps, on a stage whose friction was integrated as a set-valued force."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest

import concent_warp as cw
from concent_warp.diagnosis.candidates.baseline import fit_baseline
from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.search import additions
from concent_warp.diagnosis.search.holding import hold, with_scene
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.fit.effects.observe import observe
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene
from tests.diagnosis.made_up import finding, node, procedure

STEP, MASS, FRICTION, DAMPING, KP, KV, NOISE = 1e-4, 1.6, 2.5, 4.0, 2500.0, 60.0, 2e-5
STAGE = (
    "<mujoco><option timestep='.002' integrator='implicitfast'/><worldbody><body><joint name='x' type='slide' "
    f"axis='1 0 0' damping='{DAMPING}' frictionloss='{FRICTION}'{{own}}/><inertial pos='0 0 0' mass='{MASS}' "
    "diaginertia='.1 .1 .1'/></body></worldbody>"
    f"<actuator><position name='motor' joint='x' kp='{KP}' kv='{KV}'/></actuator>"
    "<sensor><jointpos name='scale' joint='x'/></sensor></mujoco>"
)
CFG = DiagnoseCfg(jobs=1, explain=False)


def driven(own: str = "", creeps: bool = False) -> Recording:
    """Return a stage that moves between rests, with friction that holds, or as the model's own."""
    rng = np.random.default_rng(3)
    targets = np.cumsum(rng.uniform(0.004, 0.03, 12) * np.where(np.arange(12) % 3 == 2, -1.5, 1.0))
    time = np.arange(240) / 60
    command = np.interp(time % (4 / 12) / 0.15, [0, 1], [0, 1]) * np.diff(targets, prepend=0).repeat(20)
    command += np.r_[0, targets[:-1]].repeat(20)
    count = round(time[-1] / STEP)
    wanted = command[np.minimum((np.arange(count) * STEP * 60 + 1e-9).astype(int), 239)]
    scene = Scene(STAGE.format(own=own))
    if creeps:
        position = simulated(Model(scene), wanted)
    else:
        q, v, position = 0.0, 0.0, np.empty(count)
        for k, u in enumerate(wanted):
            position[k] = q
            free = v + STEP * (KP * (u - q) - (KV + DAMPING) * v) / MASS
            v = float(np.sign(free)) * max(abs(free) - STEP * FRICTION / MASS, 0.0)
            q += STEP * v
    seen = np.arange(0, count, 40)
    reading = position[seen, None] + rng.normal(0, NOISE, (len(seen), 1))
    measured = {"scale": Channel(seen * STEP, reading, noise_std=NOISE)}
    action = {"motor": Channel(time, command)}
    return Recording(scene.xml, (Demonstration("d", action=action, measured=measured),))


def simulated(model: Model, wanted: np.ndarray) -> np.ndarray:
    """Return the position of the stage at each of the times of its commands, as the model predicts it."""
    m = model.compile()
    d, every = mujoco.MjData(m), round(m.opt.timestep / STEP)
    at_steps = [0.0]
    for u in wanted[::every]:
        d.ctrl[0] = u
        mujoco.mj_step(m, d)
        at_steps.append(float(d.qpos[0]))
    return np.interp(np.arange(len(wanted)) / every, np.arange(len(at_steps)), at_steps)


def fitted(recording: Recording) -> FittedModel:
    model = Model(Scene(recording.scene))
    windows = observe(model, recording)
    return fit_baseline(model, windows, cut_blocks(windows))


@pytest.fixture(scope="module")
def held() -> Recording:
    """Return a recording of friction that holds."""
    return driven()


def test_friction_that_holds_explains_more_where_the_stage_rests(held):
    base = fitted(held)
    found, said = hold(base, (), CFG)
    assert (said[0].where, said[0].settings["solreffriction"]) == ("joints", "0.003 1")
    assert said[0].gain > 0.5
    assert 0 < said[0].low < said[0].gain < said[0].high
    assert found.ratio < 0.65 * base.ratio
    np.testing.assert_allclose(found.model.scene.model.dof_solref, [[0.003, 1.0]])
    assert 'solreffriction="0.003 1"' in said[0].sentence
    assert hold(found, said, CFG) == (found, said)
    assert with_scene(found, base.model.scene, CFG.time_step).errors.sum() == pytest.approx(base.errors.sum(), rel=0.02)


def test_friction_that_creeps_stays_where_the_data_creep_or_the_model_says_so(held):
    own = " solreffriction='0.02 1' solimpfriction='0.9 0.95 0.001'"
    for recording in (driven(creeps=True), replace(held, scene=STAGE.format(own=own))):
        base = fitted(recording)
        assert hold(base, (), CFG) == (base, ())


def test_nothing_is_missing_from_a_stage_whose_friction_holds(held, tmp_path):
    effects = ("backlash", "actuator_gain")  # none of these, where friction creeps
    found = cw.diagnose(Model(Scene(held.scene)), held, replace(CFG, effects=effects))
    assert (found.verdict, found.accepted) == ("none_needed", ())
    (said,) = found.to_json()["holding"]
    assert (said["where"], said["gain"]["value"] > 0.5) == ("joints", True)
    assert found.ratio[0] > 3 > 1.25 > found.ratio[-1]
    assert any("creeps" in sentence for sentence in found.sentences())
    found.model.save(tmp_path / "model.toml")
    compared = cw.compare(cw.load_model(tmp_path / "model.toml"), held)
    ratio = compared.summarise("model", "scale").ratio
    assert ratio is not None
    assert ratio < 1.3


PUCK = (
    "<mujoco><option timestep='.002'{cone}/><worldbody><geom type='plane' size='1 1 .1'/><body pos='0 0 .02'>"
    "<joint name='x' type='slide' axis='1 0 0'/><joint name='y' type='slide' axis='0 1 0'/>"
    "<joint type='slide' axis='0 0 1'/><geom size='.02' mass='1' friction='.4'/></body></worldbody>"
    "<actuator><position name='x' joint='x' kp='200' kv='20'/>"
    "<position name='y' joint='y' kp='200' kv='20'/></actuator>"
    "<sensor><jointpos name='x' joint='x'/><jointpos name='y' joint='y'/></sensor></mujoco>"
)


def pushed(cone: str) -> Recording:
    """Return a puck that is pushed along the diagonal of a table, whose friction is limited by such a cone."""
    rng, time = np.random.default_rng(5), np.arange(0, 2, 0.01)
    m = mujoco.MjModel.from_xml_string(PUCK.format(cone=cone))
    d, read = mujoco.MjData(m), np.empty((len(time), 2))
    wanted = 0.1 * np.sin(3 * time)
    for k, target in enumerate(wanted):
        read[k], d.ctrl[:] = d.qpos[:2], target
        mujoco.mj_step(m, d, nstep=5)
    read += rng.normal(0, NOISE, read.shape)
    measured = {name: Channel(time, read[:, [i]], noise_std=NOISE) for i, name in enumerate("xy")}
    action = {name: Channel(time, wanted) for name in "xy"}
    return Recording(PUCK.format(cone=""), (Demonstration("d", action=action, measured=measured),))


def test_friction_that_depends_on_the_direction_by_default_is_no_effect():
    cfg = replace(CFG, effects=("sensor_gain", "joint_offset"))  # none of these, where cones are pyramids
    recording = pushed(" cone='elliptic'")
    found = cw.diagnose(Model(Scene(recording.scene)), recording, cfg)
    assert (found.verdict, found.accepted) == ("none_needed", ())
    (said,) = found.to_json()["holding"]
    assert (said["where"], said["settings"]) == ("cones", {"cone": "elliptic"})
    assert any("depends on the direction" in sentence for sentence in found.sentences())
    base = fitted(pushed(""))
    assert hold(base, (), CFG) == (base, ())


SLIDING = (
    "<mujoco><option timestep='.002'/><worldbody><geom name='table' type='plane' size='1 1 .1' friction='.3'/>"
    "<body name='puck' pos='0 0 .01'><freejoint/><geom type='cylinder' size='.03 .01' mass='.15' friction='.3'/></body>"
    "</worldbody><sensor><framepos name='place' objtype='body' objname='puck'/></sensor></mujoco>"
)


def thrown(coefficient: float) -> Recording:
    """Return slides of a puck, seen from above, that Coulomb friction slows down: in its formula, not in MuJoCo."""
    rng, time, demonstrations = np.random.default_rng(8), np.arange(0, 0.7, 0.01), []
    for k, velocity in enumerate(np.array([[1.4, 0.2], [-1.1, -0.5]])):
        speed = float(np.linalg.norm(velocity))
        gone = np.minimum(time, speed / (9.81 * coefficient))
        way = speed * gone - 0.5 * 9.81 * coefficient * gone**2
        place = np.full((len(time), 3), np.nan)
        place[:, :2] = velocity / speed * way[:, None] + rng.normal(0, 5e-4, (len(time), 2))
        measured = {"place": Channel(time, place, noise_std=5e-4)}
        demonstrations.append(Demonstration(f"demo_{k}", measured=measured))
    return Recording(SLIDING, tuple(demonstrations))


def test_cones_are_compared_beside_a_coefficient_that_may_be_wrong():
    base = fitted(thrown(0.22))
    found, (said, *_) = hold(base, (), CFG)
    assert (said.where, said.settings, said.beside) == ("cones", {"cone": "elliptic"}, "sliding_friction")
    assert found.model.scene.model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert not found.model.effects
    assert "sliding_friction fitted in both" in said.sentence
    recording = thrown(0.22)
    answer = cw.diagnose(Model(Scene(SLIDING)), recording, replace(CFG, effects=("sliding_friction", "gravity_tilt")))
    (effect,) = answer.accepted
    assert effect.name == "sliding_friction"
    assert effect.parameters[0].low < 0.22 < effect.parameters[0].high


def test_friction_that_holds_is_tried_again_beside_each_effect(monkeypatch: Any):
    made, asked = procedure(max_additions=1), []
    nodes = [node(3.0), node(1.5, effects=1), node(1.0, effects=1)]
    monkeypatch.setattr(additions, "finer_time_step", lambda *_: None)
    monkeypatch.setattr(additions, "add_candidate", lambda _base, best: best)
    monkeypatch.setattr(made.context, "nominal_fit", lambda *_, **__: None)
    monkeypatch.setattr(made.additions.finder, "find", lambda *_, **__: (nodes[1], ()))
    monkeypatch.setattr(
        additions, "hold", lambda one, known, _cfg: asked.append((one, known)) or (nodes[2], ("joints",))
    )
    assert made.additions.add_effects(nodes[:1], ())[0] == [nodes[0], nodes[2]]
    assert asked == [(nodes[1], ())]
    assert made.record.holding == ("joints",)
    alone = procedure(max_additions=1)
    monkeypatch.setattr(alone.context, "nominal_fit", lambda *_, **__: None)
    monkeypatch.setattr(alone.additions.finder, "find", lambda *_, **__: (nodes[1], ()))
    assert alone.additions.add_effects(nodes[:1], (), effects_alone=True)[0] == nodes[:2]
    assert len(asked) == 1


@pytest.mark.parametrize("explains", [True, False])
def test_friction_that_holds_is_tried_before_an_effect_is_named_beside_little(monkeypatch: Any, explains):
    made, found = procedure(max_additions=1), []
    given, held, better = node(1.0), node(0.9), node(0.95, effects=1)
    monkeypatch.setattr(additions, "finer_time_step", lambda *_: None)
    monkeypatch.setattr(additions, "add_candidate", lambda _base, best: best)
    monkeypatch.setattr(made.context, "nominal_fit", lambda *_, **__: None)

    def find(base, step, **_):
        found.append(base)
        made.record.findings.append(finding("backlash", 0.1, step=step))
        made.record.groups.append(("backlash",))
        return (better if base is given else None), ()

    monkeypatch.setattr(made.additions.finder, "find", find)
    monkeypatch.setattr(additions, "hold", lambda one, _known, _cfg: (held, ("joints",)) if explains else (one, ()))
    after, _ = made.additions.add_effects([given], ())
    if explains:
        assert (after, found) == ([held], [given, held])
        assert (made.record.holding, made.record.held_first) == (("joints",), 1)
        assert len(made.record.findings) == 1  # what was found beside friction that creeps is forgotten
    else:
        assert (after, found) == ([given, better], [given])
