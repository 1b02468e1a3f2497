"""The log of a robot that plain MuJoCo plays; with a real robot, the file that its controller writes."""

import mujoco
import numpy as np

import concent_warp as cw


def record_log(xml: str, command: np.ndarray, noise: float, seed: int = 0) -> cw.Demonstration:
    """Return commands and noisy sensor readings of one run.

    Args:
        xml: The robot as it really is, MJCF.
        command: Command of each actuator at each time step, shape (T, nu); the first is held until the robot rests.
        noise: Standard deviation of the readings [rad or m].
        seed: Seed of the noise.
    """
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.ctrl[:] = command[0]
    mujoco.mj_step(model, data, nstep=round(2.0 / model.opt.timestep))
    data.time, data.qvel[:] = 0.0, 0.0
    qpos = data.qpos.copy()
    readings = np.empty((len(command), model.nsensordata))
    for k, row in enumerate(command):
        data.ctrl[:] = row
        mujoco.mj_step(model, data)
        readings[k] = data.sensordata  # of the state before the step
    readings += np.random.default_rng(seed).normal(0, noise, readings.shape)
    time = model.opt.timestep * np.arange(len(command))
    starts = zip(model.sensor_adr, model.sensor_dim, strict=True)
    measured = {
        model.sensor(i).name: cw.Channel(time, readings[:, start : start + width], noise)
        for i, (start, width) in enumerate(starts)
    }
    action = {model.actuator(i).name: cw.Channel(time, command[:, i]) for i in range(model.nu)}
    return cw.Demonstration("demo_0", qpos=qpos, qvel=np.zeros(model.nv), action=action, measured=measured)
