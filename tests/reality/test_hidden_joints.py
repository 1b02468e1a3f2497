"""Hidden friction, delays, play and springs do what the physics of their magnitude says."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from concent_warp.reality.hidden.drives import CommandDelay, CommandLag
from concent_warp.reality.hidden.hidden_effect import HiddenEffectOfRig, drives
from concent_warp.reality.hidden.registry import EVERY, INSIDE, hidden
from concent_warp.reality.hidden.sizes import MAGNITUDES
from concent_warp.reality.rigs.registry import RIGS
from concent_warp.reality.rigs.rig import Rig, RigTrial, perform, record_rig

PENDULUM = RIGS["pendulum"]


def swing(
    *found: HiddenEffectOfRig, target: float = 0.0, start: float | None = None, duration: float = 1.0
) -> np.ndarray:
    """Hold the pendulum at `target` [rad] and return time, encoder and marker height, shape (K, 3)."""
    effects = [h.effect for h in found]
    model = PENDULUM.world(effects).compile()
    action = {"servo": (np.zeros(1), np.array([target]))}
    settling, qpos = (0.8, {}) if start is None else (0.0, {"hinge": [start]})
    trial = RigTrial(duration, action, qpos=qpos, settling_time=settling)
    motion, _, _ = perform(model, trial, effects, PENDULUM.physics)
    angle = motion.sensordata[:, :1]
    for effect in effects:
        if effect.measure is not None:
            _, angle = effect.measure("hinge_position", motion.time, angle)
    return np.column_stack([motion.time, angle, motion.sensordata[:, 3]])


def sag(angle: float, kp: float = 5.0, mass_arm: float = 0.03 * 0.05 + 0.3 * 0.1) -> float:
    """Return how far a stiffness [N m/rad] yields to the pendulum's weight at an angle [rad]."""
    return 9.81 * mass_arm * np.sin(angle) / kp


def test_bristle_friction_keeps_the_pendulum_where_it_was_within_its_dead_band():
    # From 20 mrad off, a servo of 5 N m/rad pulls with 0.1 N m less the weight's share: not enough against 0.15 N m.
    held = swing(hidden("joint_friction", 0.15, PENDULUM), start=0.02)
    free = swing(start=0.02)
    assert abs(held[-1, 1] - 0.02) < 1e-3
    assert abs(free[-1, 1]) < 1e-4


def test_bristle_friction_does_not_creep_at_rest():
    held = swing(hidden("joint_friction", 0.15, PENDULUM), start=0.02, duration=2.0)
    assert np.ptp(held[held[:, 0] > 0.5, 1]) < 1e-5


def test_weak_drive_sags_by_weight_over_its_stiffness():
    angle = swing(hidden("actuator_gain", 0.5, PENDULUM), target=1.0)[-1, 1]
    assert 1.0 - angle == pytest.approx(sag(angle, kp=2.5), rel=0.02)


def test_compliance_shows_at_the_marker_and_not_at_the_encoder():
    compliance = 0.05
    stiff, soft = (swing(*h, target=1.0)[-1] for h in ((), (hidden("joint_compliance", compliance, PENDULUM),)))
    link = np.arccos((0.3 - soft[2]) / 0.1)
    torque = 5.0 * (1.0 - soft[1])
    assert soft[1] - link == pytest.approx(compliance * torque, rel=0.03)
    assert abs(soft[1] - stiff[1]) < 0.2 * (soft[1] - link)


def test_backlash_lets_the_link_hang_half_the_play_below_where_the_drive_holds_it():
    play = 0.04
    tight, loose = (swing(*h, target=1.0)[-1, 1] for h in ((), (hidden("backlash", play, PENDULUM),)))
    assert tight - loose == pytest.approx(play / 2 + sag(loose) - sag(tight), abs=2e-3)


def test_offset_turns_the_arm_and_leaves_the_reading_near_the_command():
    offset = 0.1
    recording = record_rig(PENDULUM, [hidden("joint_offset", offset, PENDULUM).effect])
    measured = recording[0].measured
    angle, marker = measured["hinge_position"].value[:10].mean(), measured["marker_position"].value[:10].mean(axis=0)
    true = np.arctan2(-marker[0], 0.3 - marker[2])
    assert true - angle == pytest.approx(offset, abs=3e-3)


def test_drive_does_not_exceed_its_hidden_limit():
    limit = 0.2
    path = swing(hidden("actuator_saturation", limit, PENDULUM), target=1.2, start=0.0, duration=0.05)
    inertia = PENDULUM.scene.model.dof_M0[0]
    assert path[-1, 1] == pytest.approx(0.5 * limit / inertia * 0.05**2, rel=0.05)


def test_delayed_commands_arrive_later_by_the_delay_and_begin_anew_with_each_trial():
    late = CommandDelay(0.01)
    for _ in range(2):
        acting = np.array([late(k * 1e-3, np.array([float(k)]))[0] for k in range(30)])
        np.testing.assert_allclose(acting[10:], np.arange(20), atol=1e-12)
        assert (acting[:10] == 0).all()


def test_late_command_acts_for_the_rest_of_the_step_in_which_its_delay_ends():
    late = CommandDelay(2.25e-3)
    acting = [late(k * 1e-3, np.full(1, float(k >= 5)))[0] for k in range(12)]
    np.testing.assert_allclose(acting, [0] * 7 + [0.75] + [1] * 4, atol=1e-9)


def test_lagging_set_point_covers_63_percent_in_a_time_constant():
    lag = CommandLag(0.05)
    lag(-1e-3, np.zeros(1))
    path = np.array([lag(k * 1e-3, np.ones(1))[0] for k in range(100)])
    assert path[49] == pytest.approx(1 - np.exp(-0.0495 / 0.05), abs=1e-5)


@pytest.mark.parametrize("name", ["pendulum", "arm", "push", "grasp", "insertion"])
def test_weights_of_drives_are_shares_of_the_strongest_and_grippers_are_left_out(name: str):
    rig = RIGS[name]
    found = drives(rig)
    assert max(d.weight for d in found) == pytest.approx(1.0)
    assert not {d.actuator for d in found} & set(rig.grippers)
    assert all(d.kp > 0 and d.kv > 0 for d in found)


@pytest.mark.parametrize("name", sorted(MAGNITUDES))
def test_every_sized_effect_can_be_built_into_its_rig_and_reports_its_truth(name: str):
    rig: Rig = RIGS[name]
    for effect, values in MAGNITUDES[name].items():
        made = hidden(effect, values[1], rig)
        assert made.effect.edit or made.effect.force or made.effect.command or made.effect.measure
        if effect in INSIDE and effect != "contact_geometry":
            assert made.truth
        else:
            assert not made.truth
        if rig.recorder is None:
            assert rig.world([made.effect]).compile().opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC


def test_no_effect_is_without_a_size():
    sized = {effect for table in MAGNITUDES.values() for effect in table}
    assert sized == set(EVERY)
