"""A slider on a rail, pulled by a servo: with a force that depends on place, with friction, with nothing hidden."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from concent_warp.diagnosis.candidates.baseline import add_candidate, fit_baseline
from concent_warp.diagnosis.candidates.candidates import candidates
from concent_warp.diagnosis.candidates.fit_candidate import fit_candidate
from concent_warp.diagnosis.candidates.screening import screen
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.procedure import Procedure
from concent_warp.diagnosis.result import Finding
from concent_warp.diagnosis.search.unknown_force import _best_force, forces, unknown_force
from concent_warp.effects.registry import effect_class
from concent_warp.effects.unknown_force import UnknownJointForce
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.fit.effects.observe import observe
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

NOISE = 5e-4
FRICTION = 0.6
CFG = DiagnoseCfg(effects=("joint_damping", "joint_friction", "actuator_gain"), jobs=1, explain=False)


def rail(friction=0.0, damping=0.0):
    stiff = f'frictionloss="{friction}" solreffriction="0.003 1" solimpfriction="0.99 0.99 0.001"' if friction else ""
    return f"""
    <mujoco>
      <option timestep="0.002" integrator="implicitfast"/>
      <worldbody>
        <body name="cart">
          <joint name="rail" type="slide" axis="1 0 0" damping="{damping}" {stiff}/>
          <geom type="box" size="0.05 0.05 0.05" mass="1"/>
        </body>
      </worldbody>
      <actuator><position name="servo" joint="rail" kp="200" kv="20"/></actuator>
      <sensor><jointpos name="place" joint="rail"/></sensor>
    </mujoco>"""


def ridden(friction=0.0, damping=0.0, force=None, seconds=5.0, seed=0):
    """Ride to and fro at several speeds; `force` is one on the cart by its place [m]."""
    m = mujoco.MjModel.from_xml_string(rail(friction, damping))
    d = mujoco.MjData(m)
    rng = np.random.default_rng(seed)
    time = m.opt.timestep * np.arange(round(seconds / m.opt.timestep) + 1)
    command = 0.2 * np.sin(2 * np.pi * 0.4 * time) + 0.1 * np.sin(2 * np.pi * 0.93 * time)
    rows = []
    for now in command:
        d.ctrl[0] = now
        d.qfrc_applied[0] = 0.0 if force is None else force(d.qpos[0])
        mujoco.mj_step(m, d)
        rows.append(d.sensordata[0])
    rows = np.array(rows)[::5, None]
    read = Channel(time[::5], rows + rng.normal(0, NOISE, rows.shape), NOISE)
    demonstration = Demonstration(
        "ride", qpos=np.zeros(1), qvel=np.zeros(1), action={"servo": Channel(time, command)}, measured={"place": read}
    )
    return Recording(rail(), (demonstration,))


def nodes_of(recording, *effects):
    """Return the model as drawn, fitted, and with effects added in turn."""
    model = Model(Scene(recording.scene))
    windows = observe(model, recording)
    nodes = [fit_baseline(model, windows, cut_blocks(windows), "mujoco")]
    for name in effects:
        nodes.append(add_candidate(nodes[-1], fit_candidate(nodes[-1], screen(nodes[-1], effect_class(name)("rail")))))
    return nodes


def one_by_one(work, tasks):
    return [work(*task) for task in tasks]


def bump(place):
    return -0.1 * np.exp(-0.5 * ((place - 0.1) / 0.04) ** 2)


@pytest.fixture(scope="module")
def partly():
    """Return a model to which friction was added where a force by place acts as well."""
    return nodes_of(ridden(friction=FRICTION, force=bump), "joint_friction")


def test_a_force_that_depends_on_place_is_seen_behind_an_effect_that_took_up_part_of_it(partly):
    assert 1.02 < partly[-1].ratio < CFG.adequate_ratio
    found = unknown_force(partly, CFG, one_by_one)
    assert found is not None
    assert "the position of rail" in found.words
    assert found.p < 0.05
    assert 0.01 < found.share < 0.5
    assert CFG.unknown_force.min_gain <= found.gain < 1 - 1 / partly[-1].ratio ** 2 + 0.1


@pytest.mark.parametrize(("part", "size", "verdict"), [(0.2, 0.6, "none_of_these"), (1.0, 1.0, "effect")])
def test_a_force_that_explains_much_of_the_discrepancy_decides_the_verdict(part, size, verdict):
    recording = ridden(friction=part * FRICTION, force=lambda place: size * bump(place))
    partly = nodes_of(recording, "joint_friction")
    made = Procedure(Model(Scene(rail())), recording, CFG)
    made.record.findings = [Finding("joint_friction", (), "", (), 0.9, 0.9, 0.9, 0.0, 0.0, True, 0, ())]
    said = made.conclude(partly[0], partly, (), ())
    assert said.verdict == verdict
    assert said.unknown_force is not None
    assert said.unknown_force.form_error == (verdict == "effect")
    assert said.to_json()["unknown_force"]["gain"] == said.unknown_force.gain
    expected = "no more than an error in the formulas" if verdict == "effect" else "explains another"
    assert any("depends on the position of rail" in s and expected in s for s in said.sentences())
    assert (said.unexplained > 0.1) == (verdict == "none_of_these")


def test_a_force_that_beats_the_effect_which_was_added_is_seen(partly):
    (_, friction) = partly
    damping = fit_candidate(friction, screen(friction, effect_class("joint_damping")("rail")))
    found = _best_force(friction, add_candidate(friction, damping), 1.0, CFG, one_by_one)
    assert found is not None
    assert found.instead is not None
    assert found.gain > found.instead + CFG.unknown_force.min_gain
    assert found.instead == pytest.approx(damping.share(friction), abs=0.02)
    assert "of which the effect that was added explains" in found.sentence


def test_a_second_effect_that_is_there_is_not_beaten():
    nodes = nodes_of(ridden(friction=FRICTION, damping=1.0), "joint_friction", "joint_damping")
    assert nodes[1].ratio ** 2 > 1 + 2 * CFG.unknown_force.min_gain
    assert nodes[2].ratio < 1.05
    assert unknown_force(nodes, CFG, one_by_one) is None


def test_no_force_is_found_where_no_effect_is_hidden():
    for seed in range(4):
        assert unknown_force(nodes_of(ridden(seed=seed)), CFG, one_by_one) is None


def test_no_force_is_found_where_the_right_effect_was_added():
    nodes = nodes_of(ridden(friction=FRICTION), "joint_friction")
    assert nodes[0].ratio > 2
    assert unknown_force(nodes, CFG, one_by_one) is None


def test_the_unknown_force_is_not_tested_where_the_residual_is_noise():
    def never(work, tasks):
        raise AssertionError(work, tasks)

    assert unknown_force(nodes_of(ridden()), CFG, never) is None


def test_bumps_lie_where_the_joint_was():
    force_models = [
        force.force_model(mujoco.MjModel.from_xml_string(rail()))
        for force in forces(nodes_of(ridden())[0], CFG.unknown_force)
    ]
    position, velocity = force_models
    assert isinstance(position, UnknownJointForce)
    assert isinstance(velocity, UnknownJointForce)
    low, high = position.centre[0, [0, -1]]
    assert low == pytest.approx(-high, abs=0.06)
    assert 0.15 < high < 0.3
    assert velocity.moving
    assert not position.moving


def test_the_unknown_force_is_not_listed_among_the_effects():
    assert not any(e.name == "unknown_force" for e in candidates(Model(Scene(rail())), {"place"}))
