"""Check of a recording's channels before anything is attributed to the model."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np

from concent_warp.diagnosis.cfg import CheckDataCfg
from concent_warp.estimation.noise import Noise
from concent_warp.estimation.partial_state import partial_state
from concent_warp.estimation.rotations import continuous_quaternions
from concent_warp.estimation.sensors import kind_and_unit
from concent_warp.recording.recording import Recording
from concent_warp.scene.scene import Scene


def check_data(recording: Recording, cfg: CheckDataCfg | None = None) -> list[str]:
    """Return a sentence on each gap, missing samples, constant reading, noise or position outside a joint's range."""
    cfg, m, found = cfg or CheckDataCfg(), Scene(recording.scene, recording.source).model, []
    orientations = {m.sensor(i).name for i in range(m.nsensor) if kind_and_unit(m, i)[0] == "orientation"}
    for d in recording.demonstrations:
        alone = len(d.measured) == 1
        for name, channel in d.measured.items():
            where = f"{d.name}, {name}"
            if len(channel.time) < 2:
                found.append(f"{where}: only {len(channel.time)} sample, which carries no information.")
                continue
            steps = np.diff(channel.time)
            usual = float(np.median(steps))
            if (long := steps > cfg.gap_ratio * usual).any():
                found.append(
                    f"{where}: {int(long.sum())} gaps of up to {steps.max():.3g} s between samples {usual:.3g} s apart."
                )
            value, measured = channel.value, np.isfinite(channel.value).any(axis=0)
            value = value if measured.all() else value[:, measured]
            known = np.isfinite(value).all(axis=1)
            if (share := 1 - known.mean()) > cfg.max_missing_share:
                found.append(f"{where}: {100 * share:.0f} % of the samples are missing.")
            values = value[known]
            if name in orientations:  # either sign is the same orientation
                values = continuous_quaternions(values)
            if len(values) > 10 and np.ptp(values, axis=0).max() == 0.0:
                found.append(f"{where}: the reading never changes.")
            stated = channel.noise_std
            scatters = alone if stated is None else values.std(axis=0).max(initial=0.0) > cfg.max_scatter_ratio * stated
            if scatters and _is_white(values, cfg):
                found.append(f"{where}: the readings scatter like noise, no motion shows in them.")
            elif beyond := _outside_range(m, name, values, cfg):
                found.append(f"{where}: {beyond}")
    return found


def _outside_range(m: mujoco.MjModel, name: str, values: np.ndarray, cfg: CheckDataCfg) -> str:
    """Return what to say of a joint's positions (T, 1) that its range in the model excludes; empty where it is not so.

    Args:
        m: The compiled model.
        name: Name of the channel, which is that of a sensor.
        values: Measured positions [rad or m].
        cfg: Thresholds.
    """
    sensor = mujoco.mj_name2id(m, int(mujoco.mjtObj.mjOBJ_SENSOR), name)
    if sensor < 0 or m.sensor_type[sensor] != int(mujoco.mjtSensor.mjSENS_JOINTPOS) or not len(values):
        return ""
    joint = int(m.sensor_objid[sensor])
    if not m.jnt_limited[joint]:
        return ""
    low, high = m.jnt_range[joint]
    margin = cfg.outside_margin * (high - low)
    if np.mean((values < low - margin) | (values > high + margin)) <= cfg.max_outside_share:
        return ""
    unit = kind_and_unit(m, sensor)[1]
    farthest = float(values.max() if values.max() - high > low - values.min() else values.min())
    said = (
        f"readings up to {farthest:.3g} {unit} are outside the range of {m.joint(joint).name}, {low:.3g} to {high:.3g}"
        f" {unit}, where the simulated joint stops. Correct the range, or the unit or zero of the readings."
    )
    wide = np.rad2deg([low - margin, high + margin])
    if unit != "rad" or values.min() < wide[0] or values.max() > wide[1]:
        return said
    return (
        f"{said} They fit {np.rad2deg(low):.3g} to {np.rad2deg(high):.3g} rad: an MJCF states angles in degrees, "
        'unless it has <compiler angle="radian"/>.'
    )


def _is_white(values: np.ndarray, cfg: CheckDataCfg) -> bool:
    """Return whether readings (T, dim) differ between samples as much as if each were independent."""
    if len(values) < cfg.min_samples:
        return False
    variance = values.var(axis=0)
    moving = variance > 0
    step = np.mean(np.diff(values, axis=0) ** 2, axis=0)
    return bool(moving.any() and (step[moving] > 2 * cfg.white_noise_ratio * variance[moving]).all())


def noise_remarks(m: mujoco.MjModel, noises: Mapping[str, Noise]) -> list[str]:
    """Return a sentence on the channels whose noise is not stated, with what was estimated; none where all is stated.

    Args:
        m: The compiled model.
        noises: Noise of each channel.
    """
    said = []
    for channel, noise in noises.items():
        unit = kind_and_unit(m, m.sensor(channel).id)[1]
        if noise.source == "unknown":
            said.append(f"{channel} (the readings do not tell)")
        elif noise.source != "stated":
            said.append(f"{channel} {noise.std:.2g} {unit} [{noise.low:.2g}, {noise.high:.2g}]".replace(" -", ""))
    if not said:
        return []
    shown = ", ".join(said[:4]) + (f" and {len(said) - 4} more" if len(said) > 4 else "")
    return [f"Noise that is not stated was estimated from the readings alone: {shown}. State it where it is known."]


def start_remarks(m: mujoco.MjModel, recording: Recording) -> list[str]:
    """Return a sentence on the free bodies of which nothing says where they are at the start; none where there is none.

    Args:
        m: The compiled model.
        recording: The recording.
    """
    unseen = []
    for joint in np.flatnonzero(m.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)):
        first, name = int(m.jnt_dofadr[joint]), m.body(int(m.jnt_bodyid[joint])).name
        told = [
            d.qpos is not None or name in d.points or bool(partial_state(m, d, 0.0).measured[first : first + 6].any())
            for d in recording.demonstrations
        ]
        if not all(told):
            unseen.append(name)
    if not unseen:
        return []
    return [
        f"Nothing says where {', '.join(unseen)} starts: simulations begin with it at rest in the scene's reference"
        " pose. Measure its position by a sensor of its frame, or a marker's position and orientation, or give the"
        " initial state."
    ]
