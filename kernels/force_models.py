"""Forces that MuJoCo has no field for, in all worlds of MuJoCo-Warp: `concent_warp.effects` has the formulas.

Each function launches one kernel. It adds to what the caller has cleared (applied forces) or restored (friction loss).
Positions and velocities are of the coming step; what MuJoCo derives from them is of the step before.
"""

from __future__ import annotations

from typing import Any

import mujoco
import mujoco_warp as mjw
import warp as wp

wp.set_module_options({"enable_backward": False})


def add_stribeck_friction(m: mjw.Model, d: mjw.Data, dof: wp.array[Any], values: wp.array[Any]) -> None:
    """Add friction loss that fades with speed: extra exp(-(qd / speed)^2), qd in the middle of the step.

    Args:
        m: Model whose `dof_frictionloss` has one row a world.
        d: Data; `qacc` is that of the step before.
        dof: Degrees of freedom, shape (n,) int.
        values: An extra for each of them, then the speed, shape (N, n + 1).
    """
    wp.launch(
        stribeck_kernel,
        dim=(d.nworld, dof.size),
        inputs=[dof, values, m.opt.timestep, d.qvel, d.qacc],
        outputs=[m.dof_frictionloss],
    )


def add_load_friction(m: mjw.Model, d: mjw.Data, dof: wp.array[Any], values: wp.array[Any]) -> None:
    """Add friction loss in proportion to the load: c (|tau_m| + |tau_e|) / 2.

    Args:
        m: Model whose `dof_frictionloss` has one row a world.
        d: Data; `qfrc_actuator` is tau_m, `qfrc_bias` is -tau_e.
        dof: Degrees of freedom, shape (n,) int.
        values: A coefficient for each of them, shape (N, n).
    """
    wp.launch(
        load_kernel,
        dim=(d.nworld, dof.size),
        inputs=[dof, values, d.qfrc_actuator, d.qfrc_bias],
        outputs=[m.dof_frictionloss],
    )


def apply_loose_gear(m: mjw.Model, d: mjw.Data, actuators: wp.array[Any], first: int, values: wp.array[Any]) -> None:
    """Let a servo's force through only where its rotor presses on an end of the play.

    Args:
        m: Model.
        d: Data; `qfrc_applied` is added to, how far rotors are ahead of their links is kept in `userdata`.
        actuators: Position-controlled actuators of single hinges and slides, shape (n,) int.
        first: Place of actuator 0 in the user data.
        values: Width of the play at the joint, shape (N, 1).
    """
    wp.launch(
        loose_gear_kernel,
        dim=(d.nworld, actuators.size),
        inputs=[
            actuators,
            first,
            values,
            m.opt.timestep,
            m.actuator_trnid,
            m.actuator_gear,
            m.actuator_gainprm,
            m.actuator_biasprm,
            m.actuator_ctrllimited,
            m.actuator_ctrlrange,
            m.actuator_forcelimited,
            m.actuator_forcerange,
            m.jnt_qposadr,
            m.jnt_dofadr,
            d.time,
            d.ctrl,
            d.qpos,
            d.qvel,
        ],
        outputs=[d.userdata, d.qfrc_applied],
    )


def apply_elastic_gear(
    m: mjw.Model,
    d: mjw.Data,
    actuators: wp.array[Any],
    sites: wp.array[Any],
    first: int,
    values: wp.array[Any],
    damping_ratio: float,
    least_damping: float,
) -> None:
    """Let rotors with the joints' armature drive the links through springs.

    Args:
        m: Model whose `dof_armature`, `actuator_gainprm`, `actuator_biasprm`, `actuator_forcerange` and `site_pos` have
            one row a world.
        d: Data; `qfrc_applied` is added to, the rotors' states are kept in `userdata`.
        actuators: Position-controlled actuators of single hinges and slides, shape (n,) int.
        sites: Sites that show twist, its rate and the servo's force, shape (n,) int.
        first: Place of actuator 0 in the user data, four places each.
        values: Compliances of the springs at the joints, and the share of the servos' damping on the rotors, shape
            (N, n + 1).
        damping_ratio: Of a rotor on its spring [-].
        least_damping: Least damping over stiffness of a spring in time steps [-].
    """
    implicit = int(m.opt.integrator) in (
        int(mujoco.mjtIntegrator.mjINT_IMPLICIT),
        int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST),
    )
    wp.launch(
        elastic_gear_kernel,
        dim=(d.nworld, actuators.size),
        inputs=[
            actuators,
            sites,
            first,
            values,
            damping_ratio,
            least_damping,
            1.0 if implicit else 0.0,
            m.opt.timestep,
            m.actuator_trnid,
            m.actuator_gear,
            m.actuator_ctrllimited,
            m.actuator_ctrlrange,
            m.actuator_forcelimited,
            m.jnt_qposadr,
            m.jnt_dofadr,
            d.time,
            d.ctrl,
            d.qpos,
            d.qvel,
        ],
        outputs=[
            m.dof_armature,
            m.actuator_gainprm,
            m.actuator_biasprm,
            m.actuator_forcerange,
            m.site_pos,
            d.userdata,
            d.qfrc_applied,
        ],
    )


@wp.kernel
def stribeck_kernel(
    dof: wp.array[int],
    values: wp.array2d[float],
    timestep: wp.array[float],
    qvel: wp.array2d[float],
    qacc: wp.array2d[float],
    frictionloss: wp.array2d[float],
):
    """See `add_stribeck_friction`; dim (N, n).

    Args:
        dof: Shape (n,).
        values: Shape (N, n + 1).
        timestep: [s], shape (1 or N,).
        qvel: Shape (N, nv).
        qacc: Shape (N, nv).
        frictionloss: Shape (N, nv), added to.
    """
    world, i = wp.tid()
    row = dof[i]
    middle = qvel[world, row] + 0.5 * timestep[world % timestep.shape[0]] * qacc[world, row]
    ratio = middle / wp.max(values[world, dof.shape[0]], 1.0e-6)
    frictionloss[world, row] += wp.max(values[world, i], 0.0) * wp.exp(-ratio * ratio)


@wp.kernel
def load_kernel(
    dof: wp.array[int],
    values: wp.array2d[float],
    actuator: wp.array2d[float],
    bias: wp.array2d[float],
    frictionloss: wp.array2d[float],
):
    """See `add_load_friction`; dim (N, n).

    Args:
        dof: Shape (n,).
        values: Shape (N, n).
        actuator: Shape (N, nv).
        bias: Shape (N, nv).
        frictionloss: Shape (N, nv), added to.
    """
    world, i = wp.tid()
    row = dof[i]
    carried = 0.5 * (wp.abs(actuator[world, row]) + wp.abs(bias[world, row]))
    frictionloss[world, row] += wp.max(values[world, i], 0.0) * carried


@wp.kernel
def loose_gear_kernel(
    actuators: wp.array[int],
    first: int,
    values: wp.array2d[float],
    timestep: wp.array[float],
    joint_of: wp.array[wp.vec2i],
    gear: wp.array2d[wp.spatial_vector],
    gain: wp.array2d[Any],
    bias: wp.array2d[Any],
    command_limited: wp.array[bool],
    command_range: wp.array2d[wp.vec2],
    force_limited: wp.array[bool],
    force_range: wp.array2d[wp.vec2],
    qpos_address: wp.array[int],
    dof_address: wp.array[int],
    time: wp.array[float],
    ctrl: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    userdata: wp.array2d[float],
    applied: wp.array2d[float],
):
    """See `apply_loose_gear`; dim (N, n).

    Args:
        actuators: Shape (n,).
        first: Place of actuator 0 in the user data.
        values: Shape (N, 1).
        timestep: [s], shape (1 or N,).
        joint_of: What each actuator drives, shape (nu,).
        gear: Shape (1 or N, nu).
        gain: Gain parameters, the position gain first, shape (1 or N, nu).
        bias: Bias parameters: constant, by length, by velocity, shape (1 or N, nu).
        command_limited: Shape (nu,).
        command_range: Shape (1 or N, nu).
        force_limited: Shape (nu,).
        force_range: Shape (1 or N, nu).
        qpos_address: Shape (njnt,).
        dof_address: Shape (njnt,).
        time: [s], shape (N,).
        ctrl: Shape (N, nu).
        qpos: Shape (N, nq).
        qvel: Shape (N, nv).
        userdata: How far rotors are ahead, shape (N, nuserdata).
        applied: Shape (N, nv), added to.
    """
    world, i = wp.tid()
    play = values[world, 0]
    if play <= 0.0:
        return
    a = actuators[i]
    joint = joint_of[a][0]
    dof = dof_address[joint]
    ratio = gear[world % gear.shape[0], a][0]
    kp = gain[world % gain.shape[0], a][0]
    b = bias[world % bias.shape[0], a]
    dt = timestep[world % timestep.shape[0]]
    command = ctrl[world, a]
    if command_limited[a]:
        limits = command_range[world % command_range.shape[0], a]
        command = wp.clamp(command, limits[0], limits[1])
    half = 0.5 * play * wp.abs(ratio)
    speed = ratio * qvel[world, dof]
    error = command + (b[0] + b[1] * ratio * qpos[world, qpos_address[joint]]) / kp
    force = kp * error + b[2] * speed
    ahead = userdata[world, first + a]
    if time[world] == 0.0:
        ahead = wp.clamp(force / kp, -half, half)
    alone = error + (ahead - error) * wp.exp(-dt * kp / wp.max(-b[2], 1.0e-9 * kp)) - speed * dt
    after = wp.clamp(alone, -half, half)
    userdata[world, first + a] = after
    through = 0.0
    if alone != after:
        through = (alone - after) / (alone - ahead) * (kp * (error - after) + b[2] * speed)
    if force_limited[a]:
        limits = force_range[world % force_range.shape[0], a]
        through = wp.clamp(through, limits[0], limits[1])
        force = wp.clamp(force, limits[0], limits[1])
    wp.atomic_add(applied, world, dof, ratio * (through - force))


@wp.kernel
def elastic_gear_kernel(
    actuators: wp.array[int],
    sites: wp.array[int],
    first: int,
    values: wp.array2d[float],
    damping_ratio: float,
    least_damping: float,
    implicit: float,
    timestep: wp.array[float],
    joint_of: wp.array[wp.vec2i],
    gear: wp.array2d[wp.spatial_vector],
    command_limited: wp.array[bool],
    command_range: wp.array2d[wp.vec2],
    force_limited: wp.array[bool],
    qpos_address: wp.array[int],
    dof_address: wp.array[int],
    time: wp.array[float],
    ctrl: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    armature: wp.array2d[float],
    gain: wp.array2d[Any],
    bias: wp.array2d[Any],
    force_range: wp.array2d[wp.vec2],
    site_pos: wp.array2d[wp.vec3],
    userdata: wp.array2d[float],
    applied: wp.array2d[float],
):
    """See `apply_elastic_gear`; dim (N, n).

    Args:
        actuators: Shape (n,).
        sites: Shape (n,).
        first: Place of actuator 0 in the user data.
        values: Shape (N, n + 1).
        damping_ratio: [-].
        least_damping: [-].
        implicit: 1 where the integrator takes the servo's velocity at the end of a step, else 0.
        timestep: [s], shape (1 or N,).
        joint_of: What each actuator drives, shape (nu,).
        gear: Shape (1 or N, nu).
        command_limited: Shape (nu,).
        command_range: Shape (1 or N, nu).
        force_limited: Shape (nu,).
        qpos_address: Shape (njnt,).
        dof_address: Shape (njnt,).
        time: [s], shape (N,).
        ctrl: Shape (N, nu).
        qpos: Shape (N, nq).
        qvel: Shape (N, nv).
        armature: Shape (N, nv), weakened.
        gain: Gain parameters, the position gain first, shape (N, nu), weakened.
        bias: Bias parameters: constant, by length, by velocity, shape (N, nu), weakened.
        force_range: Shape (N, nu), widened.
        site_pos: Shape (N, nsite), set.
        userdata: Shape (N, nuserdata).
        applied: Shape (N, nv), added to.
    """
    world, i = wp.tid()
    if values[world, i] <= 0.0:
        return
    a = actuators[i]
    joint = joint_of[a][0]
    dof = dof_address[joint]
    dt = timestep[world % timestep.shape[0]]
    ratio = gear[world % gear.shape[0], a][0]
    g = gain[world, a]
    b = bias[world, a]
    rotor = armature[world, dof]
    stiffness = 1.0 / values[world, i]
    kp = -ratio * ratio * b[1]
    whole = -ratio * ratio * b[2]
    kv = values[world, actuators.shape[0]] * whole
    centred = 2.0 * damping_ratio * wp.sqrt(stiffness * rotor)
    late = wp.max(least_damping * dt * stiffness - centred, 0.0)
    damping = centred + late
    spring = 0.25 * dt * dt * stiffness + 0.5 * dt * centred + dt * late

    command = ctrl[world, a]
    if command_limited[a]:
        limits = command_range[world % command_range.shape[0], a]
        command = wp.clamp(command, limits[0], limits[1])
    speed = qvel[world, dof]
    free = g[0] * command + b[0] + b[1] * ratio * qpos[world, qpos_address[joint]] + b[2] * ratio * speed
    limits = force_range[world, a]
    slot = first + 4 * a
    rate = 0.0
    twist = 0.0
    if time[world] == 0.0:
        carried = stiffness * free / (kp + stiffness)
        if force_limited[a]:
            carried = wp.clamp(carried, limits[0], limits[1])
        twist = ratio * carried / stiffness
    else:
        rate = userdata[world, slot + 1] + userdata[world, slot + 2] - userdata[world, slot + 3] * speed
        twist = userdata[world, slot] + dt * rate
    torque = stiffness * twist + damping * rate
    back = kp * twist + kv * rate
    brake = 0.25 * dt * dt * kp + 0.5 * dt * wp.max(kv, 0.0)
    total = rotor + spring + brake
    push = ratio * free - back - torque
    servo = free - (back + brake * push / total) / ratio
    drive = ratio * free
    moved = rotor + implicit * dt * whole
    if force_limited[a] and (servo < limits[0] or servo > limits[1]):
        servo = wp.clamp(servo, limits[0], limits[1])
        drive = 0.0
        total = rotor + spring
        push = ratio * servo - torque
        moved = rotor
        g[0] = 0.0
        for k in range(3):
            b[k] = 0.0
    share = spring / total
    follow = moved / total
    userdata[world, slot] = twist
    userdata[world, slot + 1] = rate
    userdata[world, slot + 2] = push * dt / total + follow * speed
    userdata[world, slot + 3] = follow
    wp.atomic_add(applied, world, dof, torque + share * (push - drive))
    site_pos[world, sites[i]] = wp.vec3(twist, rate, servo)

    armature[world, dof] = share * rotor
    force_range[world, a] = wp.vec2(-1.0e9, 1.0e9)
    g[0] = share * g[0]
    gain[world, a] = g
    for k in range(3):
        b[k] = share * b[k]
    bias[world, a] = b
