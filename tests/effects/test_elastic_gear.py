"""The rotor behind a spring of a compliant joint, against two masses that are integrated independently."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from small_worlds import SLIDER, move, world

from concent_warp.effects.library.drives import JointCompliance
from concent_warp.effects.library.elastic_forces import DAMPING_RATIO
from concent_warp.effects.library.joints import Armature

MASS, KP, KV, ROTOR = 2.0, 400.0, 40.0, 0.5


def servo(*, timestep: float = 0.001, integrator: str = "Euler", kv: float = KV, rotor: float = ROTOR, more: str = ""):
    """Return a cart of 2 kg on a servo with a rotor."""
    xml = SLIDER.format(
        joint=f'armature="{rotor}"', actuator=f'<position name="drive" joint="rail" kp="{KP}" kv="{kv}" {more}/>'
    )
    return xml.replace('timestep="0.001"', f'timestep="{timestep}" integrator="{integrator}"')


def two_masses(
    stiffness: float,
    command: float,
    time: np.ndarray,
    *,
    rotor: float = ROTOR,
    limit: float = np.inf,
    load: float = 0.0,
) -> np.ndarray:
    """Return positions and velocities of link and rotor, shape (4, T), from rest at 0 under a constant command."""
    damping = 2 * DAMPING_RATIO * np.sqrt(stiffness * rotor)

    def rate(_t, state):
        q, v, r, w = state
        torque = stiffness * (r - q) + damping * (w - v)
        drive = np.clip(KP * (command - r) - KV * w, -limit, limit)
        return [v, (torque - load) / MASS, w, (drive - torque) / rotor]

    start = [0.0, 0.0, min(KP * command / (KP + stiffness), limit / stiffness), 0.0]
    return solve_ivp(rate, (0, time[-1]), start, t_eval=time, rtol=1e-9, atol=1e-12, max_step=0.002).y


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
@pytest.mark.parametrize(("stiffness", "rotor"), [(1e3, 0.5), (4e3, 0.5), (1e5, 0.5), (1e3, 0.05)])
def test_link_and_encoder_move_like_two_masses_on_a_spring(integrator, stiffness, rotor):
    effect, values, error = JointCompliance("drive"), np.array([1 / stiffness, 1.0]), []
    for timestep in (0.002, 0.0005):
        model = world(servo(timestep=timestep, integrator=integrator, rotor=rotor), effect, *values)
        cart = move(model, 0.6, ctrl=0.1)
        expected = two_masses(stiffness, 0.1, cart.time, rotor=rotor)
        encoder = effect.measure(model.compile(), cart.read, values)("encoder", cart.time)[:, 0]
        error.append([np.abs(cart.qpos[:, 0] - expected[0]).max(), np.abs(encoder - expected[2]).max()])
    assert np.max(error[0]) < 0.005
    assert np.max(error[1]) < 0.0015


def test_servo_at_its_limit_turns_the_rotor_by_that_limit():
    stiffness, effect = 2e3, JointCompliance("drive")
    model = world(servo(more='forcerange="-15 15"'), effect, 1 / stiffness, 1.0)
    cart = move(model, 0.6, ctrl=0.2)
    expected = two_masses(stiffness, 0.2, cart.time, limit=15.0)
    assert np.abs(cart.qpos[:, 0] - expected[0]).max() < 0.001
    assert np.abs(cart.qpos[:, 0] - two_masses(stiffness, 0.2, cart.time)[0]).max() > 0.02
    servo_force = cart.sensor["concent_twist_drive"][:, 2]
    assert servo_force.max() == 15.0


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
@pytest.mark.parametrize("kv", [0.0, 40.0])
@pytest.mark.parametrize("rotor", [0.0, 0.5])
@pytest.mark.parametrize("more", ["", 'forcerange="-15 15"'])
def test_stiff_joint_is_the_model_without_the_effect(integrator, kv, rotor, more):
    xml = servo(integrator=integrator, kv=kv, rotor=rotor, more=more)
    plain = move(world(xml), 1.0, ctrl=0.1).qpos
    rigid = move(world(xml, JointCompliance("drive"), 0.0, 1.0), 1.0, ctrl=0.1).qpos
    np.testing.assert_allclose(rigid, plain, rtol=0, atol=1e-12)
    # Twice as far off for twice the compliance: no jump at zero.
    off = [
        np.abs(move(world(xml, JointCompliance("drive"), c, 1.0), 1.0, ctrl=0.1).qpos - plain).max()
        for c in (1e-9, 2e-9)
    ]
    assert off[1] < 1e-5
    assert off[1] == pytest.approx(2 * off[0], rel=0.05, abs=1e-9)


@pytest.mark.parametrize("stiffness", [1e2, 1e4, 1e6, 1e8])
@pytest.mark.parametrize("rotor", [0.0, 1e-3, 0.5, 20.0])
@pytest.mark.parametrize("timestep", [0.002, 0.01])
def test_any_stiffness_is_stable_at_the_step_of_the_model(stiffness, rotor, timestep):
    cart = move(
        world(servo(timestep=timestep, rotor=rotor), JointCompliance("drive"), 1 / stiffness, 1.0), 5.0, ctrl=0.1
    )
    tail = cart.qpos[-len(cart.qpos) // 5 :, 0]
    assert np.abs(cart.qpos).max() < 0.3
    assert np.abs(tail - 0.1).max() < (0.12 if rotor == 20.0 else 0.03)


def test_steps_neither_take_energy_out_of_the_swing_of_rotor_against_link_nor_add_any():
    """Of a servo too weak to matter, at rest on a link that moves off at once."""
    stiffness, start = 1e3, 0.1
    reduced = MASS * ROTOR / (MASS + ROTOR)
    decay = DAMPING_RATIO * np.sqrt(stiffness * ROTOR) / reduced
    turning = np.sqrt(stiffness / reduced - decay**2)
    xml = servo(timestep=0.001, kv=0.0).replace(f'kp="{KP}"', 'kp="1e-3"')
    command = start * stiffness * 1e3  # stretches the spring at first, where the rotor is at rest on the servo's force
    command = np.where(np.arange(1000) < 1, command, 0.0)[:, None]
    cart = move(world(xml, JointCompliance("drive"), 1 / stiffness, 1.0), 1.0, ctrl=command)
    twist = cart.sensor["concent_twist_drive"][:, 0]
    free = slice(2, None)
    time = cart.time[free]
    shape = np.stack([np.cos(turning * time), np.sin(turning * time)]) * np.exp(-decay * time)
    size = np.linalg.lstsq(shape.T, twist[free], rcond=None)[0]
    np.testing.assert_allclose(size @ shape, twist[free], atol=0.02 * start)


def test_armature_beside_compliance_is_the_rotor_s_in_either_order():
    xml, c = servo(rotor=0.1), 1e-3
    first = move(world(xml, JointCompliance("drive"), c, 1.0).add(Armature("rail"), [ROTOR]), 0.5, ctrl=0.1).qpos
    last = move(world(xml, Armature("rail"), ROTOR).add(JointCompliance("drive"), [c, 1.0]), 0.5, ctrl=0.1).qpos
    given = move(world(servo(), JointCompliance("drive"), c, 1.0), 0.5, ctrl=0.1).qpos
    np.testing.assert_allclose(first, given, rtol=0, atol=1e-12)
    np.testing.assert_allclose(last, given, rtol=0, atol=1e-12)


def test_damping_from_an_encoder_on_the_link_acts_on_the_link():
    """Without a rotor's inertia, the spring carries kp (u - r) - kv q' then."""
    stiffness, effect = 1e3, JointCompliance("drive")
    cart = move(world(servo(timestep=5e-4, rotor=0.0), effect, 1 / stiffness, 0.0), 0.6, ctrl=0.1)
    share = stiffness / (stiffness + KP)
    weaker = servo(timestep=5e-4, kv=share * KV, rotor=0.0).replace(f'kp="{KP}"', f'kp="{share * KP}"')
    np.testing.assert_allclose(cart.qpos, move(world(weaker), 0.6, ctrl=0.1).qpos, rtol=0, atol=2e-4)
