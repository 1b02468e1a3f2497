"""Hidden effects of the worlds on other engines: each changes the true physics of a rig and says what is true then.

True values are those of the library's parameters, as the nominal model defines them. Nothing here imports an engine.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks.independent.data_set import Truth
from benchmarks.independent.foreign.rig import ENCODERS, BodyForce, BodyState, ForeignRig, Friction, Measure, Physics

Hidden = Callable[[ForeignRig, Physics, float], Truth]
DRAG_COEFFICIENT = 0.47
"""Drag coefficient of a sphere at Reynolds numbers from 1e3 to 1e5 [-]."""
AIR_DENSITY = 1.2
"""Density of air at 20 degrees [kg/m^3]."""


def joint_friction(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Add Coulomb friction [N m or N]."""
    true = {}
    for d in rig.drives:
        friction = physics.friction.setdefault(d.joint, Friction(0.0, bristle=4e-4 if rig.hinges else 3e-5))
        friction.coulomb += magnitude * d.weight
        true[f"torque[{d.joint}]"] = friction.coulomb
    return Truth("joint_friction", true, _joints(rig))


def stribeck_friction(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Add friction at rest that fades with speed [N m or N]."""
    true: dict[str, float] = {}
    for d in rig.drives:
        friction = physics.friction[d.joint]
        friction.extra = magnitude * d.weight
        true[f"extra[{d.joint}]"] = friction.extra
        true["speed"] = friction.speed
    return Truth("stribeck_friction", true, _joints(rig))


def joint_damping(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Add viscous damping [N m s/rad or N s/m]."""
    true = {}
    for d in rig.drives:
        physics.damping[d.joint] += magnitude * d.weight
        true[f"damping[{d.joint}]"] = physics.damping[d.joint]
    return Truth("joint_damping", true, _joints(rig))


def armature(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Add reflected inertia of rotors [kg m^2 or kg]."""
    true = {}
    for d in rig.drives:
        state = physics.drives[d.actuator]
        state.armature += magnitude * d.weight
        true[f"inertia[{d.joint}]"] = state.armature
    return Truth("armature", true, _joints(rig))


def actuator_gain(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Multiply the drives' torque by a factor [-]."""
    true = {}
    for d in rig.drives:
        physics.drives[d.actuator].gain = magnitude
        true[f"gain[{d.actuator}]"] = magnitude * physics.values[d.kp] / rig.values[d.kp]
    return Truth("actuator_gain", true, _actuators(rig))


def actuator_saturation(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Limit the drives' torque [N m or N]."""
    for d in rig.drives:
        physics.drives[d.actuator].limit = magnitude
    return Truth("actuator_saturation", {"limit": magnitude}, _actuators(rig))


def actuator_delay(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Let commands act late [s]."""
    for d in rig.drives:
        physics.drives[d.actuator].delay = magnitude
    return Truth("actuator_delay", {"delay": magnitude}, _actuators(rig))


def actuator_lag(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Filter commands with a time constant [s]."""
    for d in rig.drives:
        physics.drives[d.actuator].lag = magnitude
    return Truth("actuator_lag", {"time_constant": magnitude}, _actuators(rig))


def backlash(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Put free play [rad] between rotors and links."""
    for d in rig.drives:
        physics.drives[d.actuator].play = magnitude
    return Truth("backlash", {"play": magnitude}, _actuators(rig))


def joint_compliance(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Put springs of a compliance [rad/(N m)] between rotors and links."""
    true = {}
    for d in rig.drives:
        state = physics.drives[d.actuator]
        state.compliance = magnitude / d.weight
        true[f"compliance[{d.actuator}]"] = state.compliance
    return Truth("joint_compliance", true, _actuators(rig))


def joint_offset(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Shift the zero of drives and encoders [rad or m]."""
    true = {}
    for d in rig.drives:
        physics.drives[d.actuator].offset = magnitude * d.weight
        true[f"offset[{d.joint}]"] = magnitude * d.weight
    return Truth("joint_offset", true, _joints(rig))


def gravity_compensation(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Let drives compensate a share of the links' weight [-], as the arm's controller knows it."""
    physics.compensation = magnitude
    return Truth("gravity_compensation", {"share": magnitude}, rig.links)


def mass(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Multiply mass and inertia of the body under test by a factor [-]."""
    physics.mass = magnitude
    name = "mass" if "mass" in physics.values else "mass_2"
    return Truth("mass", {"mass": magnitude * physics.values[name] / rig.values[name]}, (rig.body,))


def inertia(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Multiply the inertia of the body under test by a factor [-]."""
    physics.inertia = magnitude
    factor = 1.0
    if "inertia" in physics.values:
        factor = physics.values["inertia"] / rig.values["inertia"]
    return Truth("inertia", {"inertia": magnitude * factor}, (rig.body,))


def center_of_mass(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Shift the centre of mass of the body under test [m]."""
    physics.center = magnitude * np.array([0.8, -0.5, 0.33])
    return Truth("center_of_mass", dict(zip("xyz", map(float, physics.center), strict=True)), (rig.body,))


def size(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Multiply the body's size by a factor [-]; mass and inertia stay."""
    physics.size = magnitude
    name = "radius" if rig.shape == "ball" else "half_z"
    return Truth("size", {"size": magnitude * physics.values[name] / rig.values[name]}, (rig.body,))


def sliding_friction(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Set the coefficient of sliding friction on the table [-]."""
    physics.values["friction"] = magnitude
    return Truth("sliding_friction", {"coefficient": magnitude}, (rig.body,))


def rolling_friction(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Brake rolling by a torque of a coefficient [m] times the weight."""

    def force(time: float, state: BodyState) -> tuple[np.ndarray, np.ndarray]:
        del time
        rate = np.array([state.turning[0], state.turning[1], 0.0])
        speed = float(np.linalg.norm(rate))
        weight = physics.mass * physics.values["mass"] * float(np.linalg.norm(physics.gravity))
        torque = -magnitude * weight * np.tanh(speed / 0.1) * rate / max(speed, 1e-9)
        return np.zeros(3), torque

    physics.body_forces.append(force)
    return Truth("rolling_friction", {"coefficient": magnitude}, (rig.body,))


def contact_compliance(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Set the damping ratio of the ball's contact [-]; its stiffness stays."""
    physics.values["damping_ratio"] = magnitude
    frequency = np.sqrt(rig.values["stiffness"] / rig.values["mass"])
    true = {"time_constant": float(1 / (frequency * magnitude)), "damping_ratio": magnitude}
    return Truth("contact_compliance", true, (rig.body,))


def gravity_tilt(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Tilt the world: gravity turns about x by an angle [rad], and by -0.7 of it about y."""
    del rig
    x, y = magnitude, -0.7 * magnitude
    angle = float(np.hypot(x, y))
    axis = np.array([x, y, 0.0]) / angle
    down = physics.gravity
    physics.gravity = (
        np.cos(angle) * down + np.sin(angle) * np.cross(axis, down) + (1 - np.cos(angle)) * (axis @ down) * axis
    )
    return Truth("gravity_tilt", {"x": x, "y": y})


def air(physics: Physics, density: float, wind: np.ndarray) -> BodyForce:
    """Return the quadratic drag of a ball in air of a density [kg/m^3] that moves with `wind` (3,) [m/s]."""
    area = np.pi * (physics.values["radius"] * physics.size) ** 2

    def force(time: float, state: BodyState) -> tuple[np.ndarray, np.ndarray]:
        del time
        against = state.velocity - wind
        push = -0.5 * density * DRAG_COEFFICIENT * area * np.linalg.norm(against) * against
        return push, np.zeros(3)

    return force


def air_drag(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Add drag of still air, of a density times drag factor [kg/m^3]; the factor is 1 where the coefficient is 1."""
    physics.body_forces.append(air(physics, magnitude / DRAG_COEFFICIENT, np.zeros(3)))
    return Truth("air_drag", {"density": magnitude}, (rig.body,))


def wind(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Add wind [m/s] along x, and a third of it against y.

    There are no true values: the library's wind has a drag factor of 1.
    """
    velocity = magnitude * np.array([1.0, -1 / 3, 0.0])
    physics.body_forces.append(air(physics, AIR_DENSITY, velocity))
    return Truth("wind", {}, (rig.body,))


def time_base(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Let clocks of trackers, or of encoders where there is no tracker, run fast by a share [-]."""
    names = _clocked(rig)

    def measure(name: str, time: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (time * (1 + magnitude) if name in names else time), value

    physics.measures.append(measure)
    return Truth("time_base", {"scale": magnitude}, names)


def latency(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Let trackers, or encoders where there is no tracker, see what was some time ago [s]."""
    physics.sensor_delay = magnitude
    return Truth("latency", {"delay": magnitude}, _clocked(rig))


def length_scale(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Scale tracked positions by a share [-]."""
    names = tuple(s.name for s in rig.sensors if s.kind in ("marker", "position"))
    physics.measures.append(_changed(names, lambda _, value: value * (1 + magnitude)))
    return Truth("length_scale", {"scale": magnitude}, names)


def frame_offset(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Shift tracked positions [m]."""
    shift = magnitude * np.array([1.0, -0.6, 0.4])
    names = tuple(s.name for s in rig.sensors if s.kind in ("marker", "position"))
    poses = tuple(s.name for s in rig.sensors if s.kind in ("marker", "position", "orientation"))
    physics.measures.append(_changed(names, lambda _, value: value + shift))
    true = dict(zip("xyz", map(float, shift), strict=True)) | {"rx": 0.0, "ry": 0.0, "rz": 0.0}
    return Truth("frame_offset", true, poses)


def sensor_gain(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Scale the readings of encoders by a share [-]; the drives' own are right."""
    names = _encoders(rig)
    physics.measures.append(_changed(names, lambda _, value: value * (1 + magnitude)))
    return Truth("sensor_gain", {f"scale[{n}]": magnitude for n in names}, names)


def sensor_bias(rig: ForeignRig, physics: Physics, magnitude: float) -> Truth:
    """Add a constant to the readings of encoders [rad or m]; the drives' own are right."""
    names = _encoders(rig)
    physics.measures.append(_changed(names, lambda _, value: value + magnitude))
    return Truth("sensor_bias", {f"bias[{n}]": magnitude for n in names}, names)


def _changed(names: tuple[str, ...], change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Measure:
    """Return what changes the values of some sensors."""

    def measure(name: str, time: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return time, change(time, value) if name in names else value

    return measure


def _clocked(rig: ForeignRig) -> tuple[str, ...]:
    tracked = tuple(s.name for s in rig.sensors if s.kind not in ENCODERS)
    return tracked or _encoders(rig)


def _encoders(rig: ForeignRig) -> tuple[str, ...]:
    return tuple(s.name for s in rig.sensors if s.kind in ENCODERS)


def _joints(rig: ForeignRig) -> tuple[str, ...]:
    return tuple(d.joint for d in rig.drives)


def _actuators(rig: ForeignRig) -> tuple[str, ...]:
    return tuple(d.actuator for d in rig.drives)


INSIDE: dict[str, Hidden] = {
    f.__name__: f
    for f in (
        *(joint_friction, stribeck_friction, joint_damping, armature, actuator_gain, actuator_saturation),
        *(actuator_delay, actuator_lag, backlash, joint_compliance, joint_offset, gravity_compensation),
        *(mass, inertia, center_of_mass, size, sliding_friction, rolling_friction, contact_compliance),
        *(gravity_tilt, air_drag, wind, time_base, latency, length_scale, frame_offset, sensor_gain, sensor_bias),
    )
}
"""Effects that the library has, by its names."""
