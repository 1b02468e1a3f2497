"""Hidden effects of the world on MuJoCo.

Friction, gears, contacts with a plane and drag are this world's own. What has no formula to choose (another mass, a
shifted frame, a torque that ripples) is taken from `concent_warp.reality.hidden`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np

from benchmarks.independent.data_set import DataSet
from benchmarks.independent.gear import Gear
from benchmarks.independent.lugre import Level, constant
from benchmarks.independent.mujoco_rigs import Experiment, draw_tolerances
from benchmarks.independent.mujoco_shapes import SHAPES
from benchmarks.independent.plane_contact import PlaneContact
from concent_warp.reality.hidden.drives import actuator_names, peak_drive_force
from concent_warp.reality.hidden.hidden_effect import Drive, drives, true_values
from concent_warp.reality.hidden.outside import OUTSIDE
from concent_warp.reality.hidden.registry import hidden
from concent_warp.reality.world import HiddenEffect

Observe = Callable[[str, np.ndarray, np.ndarray], np.ndarray]
"""Given a sensor's name, times (K,) [s] and the signal (K, dim), returns what the instrument sees."""
SPHERE_DRAG = 0.47
"""Drag coefficient of a sphere at Reynolds numbers from 1e3 to 2e5 [-]: Hoerner, "Fluid-Dynamic Drag", 1965."""
AIR = 1.2
"""Density of air [kg/m^3]."""
TEETH = {"hinge": 600.0, "slide": 2e5}
"""Stiffness of a gear's teeth [N m/rad], [N/m]."""


@dataclass(frozen=True)
class Cause:
    """A hidden effect in an experiment; each hook is optional."""

    name: str
    """Canonical name of the library's effect, or one that no library has."""
    effect: HiddenEffect
    parameters: Mapping[str, float] = field(default_factory=dict)
    target: tuple[str, ...] = ()
    known: bool = True
    contact: Callable[[PlaneContact], PlaneContact] | None = None
    """Changes the contact of the free body with the plane."""
    levels: Mapping[str, Level] = field(default_factory=dict)
    """Friction of joints in addition to the nominal one."""
    observe: Observe | None = None


Builder = Callable[[Experiment, float], Cause]


def causes_of(experiment: Experiment, case: DataSet) -> list[Cause]:
    """Return the hidden effects of a data set."""
    found = []
    for name, magnitude in case.magnitudes.items():
        unit = peak_drive_force(experiment.rig, case.demonstrations, case.seed) if name == "actuator_saturation" else 1
        found.append(_cause(experiment, name, unit * magnitude))
    return [replace(c, parameters=_with_tolerances(experiment, case.seed, c, found)) for c in found]


def _cause(experiment: Experiment, name: str, magnitude: float) -> Cause:
    """Return one hidden effect."""
    own = OWN.get(name)
    if own is not None and not (name in PLANE and experiment.contact is None):
        return own(experiment, magnitude)
    if name in SHAPES:
        effect = HiddenEffect(name, edit=SHAPES[name](experiment.rig, magnitude))
        return Cause("contact_geometry", effect, {}, (experiment.rig.body,))
    if name in WITHOUT_PLANE and experiment.contact is None:
        return WITHOUT_PLANE[name](experiment, magnitude)
    taken = hidden(name, magnitude, experiment.rig)
    return Cause(name, taken.effect, dict(taken.truth), taken.target, known=name not in OUTSIDE)


def _with_tolerances(experiment: Experiment, seed: int, cause: Cause, every: list[Cause]) -> Mapping[str, float]:
    """Return the true parameters of an effect, errors of the nominal model in the same numbers included."""
    if cause.name not in ("mass", "inertia", "size", "center_of_mass", "actuator_gain"):
        return cause.parameters
    rig, nominal = experiment.rig, experiment.rig.scene.model
    spec = rig.scene.spec()
    draw_tolerances(spec, seed)
    for other in every:
        if other.effect.edit is not None:
            other.effect.edit(spec)
    world = spec.compile()
    a, b = nominal.body(rig.body).id, world.body(rig.body).id
    mass = float(world.body_mass[b] / nominal.body_mass[a])
    if cause.name == "mass":
        return {"mass": mass}
    if cause.name == "inertia":
        return {"inertia": float(np.mean(world.body_inertia[b] / nominal.body_inertia[a]))}
    if cause.name == "size":
        sizes = nominal.geom_size[nominal.body_geomadr[a]], world.geom_size[world.body_geomadr[b]]
        return {"size": float(np.mean(sizes[1][sizes[0] > 0] / sizes[0][sizes[0] > 0]))}
    if cause.name == "center_of_mass":
        return dict(zip("xyz", map(float, world.body_ipos[b] - nominal.body_ipos[a]), strict=True))
    gains = [
        float(world.actuator_gainprm[world.actuator(n).id, 0] / nominal.actuator_gainprm[nominal.actuator(n).id, 0])
        for n in cause.target
    ]
    return true_values("gain", cause.target, np.array(gains))


def joint_friction(experiment: Experiment, magnitude: float) -> Cause:
    """Return more dry friction of the strongest drive [N m or N], less of weaker ones."""
    found, nominal = drives(experiment.rig), experiment.rig.scene.model
    added = {d.joint: magnitude * d.weight for d in found}
    truth = {
        f"torque[{joint}]": float(nominal.dof_frictionloss[nominal.joint(joint).dofadr[0]] + more)
        for joint, more in added.items()
    }
    levels = {joint: constant(more) for joint, more in added.items()}
    return Cause("joint_friction", HiddenEffect("joint_friction"), truth, tuple(added), levels=levels)


def stribeck_friction(experiment: Experiment, magnitude: float) -> Cause:
    """Return friction [N m or N] at rest that fades with speed, beyond the nominal friction."""
    rig = experiment.rig
    fade = 0.03 if rig.slides else 0.3

    def at(d: Drive) -> Level:
        top = magnitude * d.weight
        return lambda _model, data, dof: top * float(np.exp(-((data.qvel[dof] / fade) ** 2)))

    found = drives(rig)
    joints = tuple(d.joint for d in found)
    truth = {**true_values("extra", joints, np.array([magnitude * d.weight for d in found])), "speed": fade}
    levels = {d.joint: at(d) for d in found}
    return Cause("stribeck_friction", HiddenEffect("stribeck_friction"), truth, joints, levels=levels)


def load_friction(experiment: Experiment, magnitude: float) -> Cause:
    """Return friction by a coefficient [-] of the torque that the motor gives into the gear.

    The library takes the mean of the torques on both sides, so the coefficient has no true value.
    """
    joints = tuple(d.joint for d in drives(experiment.rig))

    def level(model: mujoco.MjModel, data: mujoco.MjData, dof: int) -> float:
        del model
        return magnitude * abs(float(data.qfrc_actuator[dof]))

    effect = HiddenEffect("load_friction")
    return Cause("load_friction", effect, {}, joints, levels=dict.fromkeys(joints, level))


def warming(experiment: Experiment, magnitude: float) -> Cause:
    """Return friction of a cold drive [N m or N] that vanishes with a time constant of 2.5 s."""
    levels: dict[str, Level] = {
        d.joint: lambda _m, s, _i, w=d.weight: magnitude * w * float(np.exp(-max(s.time, 0.0) / 2.5))
        for d in drives(experiment.rig)
    }
    return Cause("warming", HiddenEffect("warming"), known=False, levels=levels)


def _geared(name: str, gears: list[Gear]) -> HiddenEffect:
    """Return the hooks of gears in all drives."""

    def edit(spec: mujoco.MjSpec) -> None:
        for gear in gears:
            gear.edit(spec)

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        for gear in gears:
            gear(model, data)

    return HiddenEffect(name, edit=edit, force=force)


def backlash(experiment: Experiment, magnitude: float) -> Cause:
    """Return play of a width [rad or m] between rotor and link; encoders read the link."""
    rig = experiment.rig
    stiffness = TEETH["slide" if rig.slides else "hinge"]
    gears = [Gear(d, stiffness, 0.3, magnitude) for d in drives(rig)]
    return Cause("backlash", _geared("backlash", gears), {"play": magnitude}, actuator_names(drives(rig)))


def joint_compliance(experiment: Experiment, magnitude: float) -> Cause:
    """Return a spring [rad/(N m) or m/N] between rotor and link of the strongest drive, softer ones of weaker drives.

    Encoders read the rotor.
    """
    rig = experiment.rig
    m, found = rig.scene.model, drives(rig)
    compliance = np.array([magnitude / d.weight for d in found])
    gears = [Gear(d, 1 / c, 0.1) for d, c in zip(found, compliance, strict=True)]
    of_joint = {g.drive.joint: g for g in gears}

    def observe(sensor: str, time: np.ndarray, value: np.ndarray) -> np.ndarray:
        i = m.sensor(sensor).id
        gear = None
        if m.sensor_type[i] == mujoco.mjtSensor.mjSENS_JOINTPOS:
            gear = of_joint.get(m.joint(m.sensor_objid[i]).name)
        return value if gear is None else value + np.interp(time, gear.time, gear.twist)[:, None]

    truth = true_values("compliance", actuator_names(found), compliance)
    return Cause("joint_compliance", _geared("joint_compliance", gears), truth, actuator_names(found), observe=observe)


def _of_contact(
    name: str, parameter: str | None, change: Callable[[PlaneContact, float], PlaneContact], *, known: bool = True
) -> Builder:
    """Return the builder of an effect that changes the contact with the plane."""

    def build(experiment: Experiment, magnitude: float) -> Cause:
        truth = {} if parameter is None else {parameter: magnitude}
        target = (experiment.rig.body,) if known else ()
        return Cause(name, HiddenEffect(name), truth, target, known, contact=lambda c: change(c, magnitude))

    return build


def friction_of_surface(experiment: Experiment, magnitude: float) -> Cause:
    """Return another coefficient of sliding friction [-] of the surface, in MuJoCo's contacts."""
    rig = experiment.rig

    def edit(spec: mujoco.MjSpec) -> None:
        geoms = [spec.geom(rig.surface), *spec.body(rig.body).geoms]
        for geom in geoms:
            geom.friction = [magnitude, *np.array(geom.friction)[1:]]

    effect = HiddenEffect("sliding_friction", edit=edit)
    return Cause("sliding_friction", effect, {"coefficient": magnitude}, (rig.body,))


def softer_contact(experiment: Experiment, magnitude: float) -> Cause:
    """Return a factor [-] on the damping ratio of MuJoCo's contacts of the body and the surface."""
    rig = experiment.rig

    def edit(spec: mujoco.MjSpec) -> None:
        for geom in (spec.geom(rig.surface), *spec.body(rig.body).geoms):
            geom.solref = [geom.solref[0], magnitude * geom.solref[1]]

    return Cause("contact_compliance", HiddenEffect("contact_compliance", edit=edit), {}, (rig.body,))


def adhesion(experiment: Experiment, magnitude: float, *, reach: float = 4e-4) -> Cause:
    """Return a pull [N] on each corner of a box towards the surface z = 0, which decays with its height."""
    rig = experiment.rig
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        b = model.body(rig.body).id
        half = model.geom_size[model.body_geomadr[b]]
        arm = (half * signs) @ data.xmat[b].reshape(3, 3).T
        height = np.maximum(data.xpos[b, 2] + arm[:, 2], 0.0)
        pull = magnitude * np.exp(-height / reach)
        data.xfrc_applied[b, 2] -= pull.sum()
        lever = data.xpos[b] + arm - data.xipos[b]
        data.xfrc_applied[b, 3:] += (np.stack([-lever[:, 1], lever[:, 0], 0 * pull]) * pull).sum(axis=1)

    return Cause("adhesion", HiddenEffect("adhesion", force=force), {}, (rig.body,))


def _air(experiment: Experiment, density: float, wind: np.ndarray, name: str) -> Cause:
    """Return the drag of air of a density [kg/m^3] that moves with `wind` (3,) [m/s] on a ball."""
    rig = experiment.rig

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        b = model.body(rig.body).id
        dof = model.jnt_dofadr[model.body_jntadr[b]]
        against = data.qvel[dof : dof + 3] - wind
        area = np.pi * model.geom_size[model.body_geomadr[b], 0] ** 2
        data.xfrc_applied[b, :3] -= 0.5 * density * SPHERE_DRAG * area * np.linalg.norm(against) * against

    return Cause(name, HiddenEffect(name, force=force), {}, (rig.body,))


def air_drag(experiment: Experiment, magnitude: float) -> Cause:
    """Return the drag of a medium of a density [kg/m^3]; the library's drag coefficient differs, so it has no truth."""
    return _air(experiment, magnitude, np.zeros(3), "air_drag")


def wind(experiment: Experiment, magnitude: float) -> Cause:
    """Return wind [m/s] along -x, and half as much along y."""
    return _air(experiment, AIR, magnitude * np.array([-1.0, 0.5, 0.0]), "wind")


PLANE: dict[str, Builder] = {
    "sliding_friction": _of_contact("sliding_friction", "coefficient", lambda c, m: replace(c, friction=(m, m))),
    "anisotropic_friction": _of_contact(
        "anisotropic_friction", "ratio", lambda c, m: replace(c, friction=(c.friction[0], m * c.friction[0]))
    ),
    "torsional_friction": _of_contact("torsional_friction", "coefficient", lambda c, m: replace(c, spinning=m)),
    "rolling_friction": _of_contact("rolling_friction", "coefficient", lambda c, m: replace(c, rolling=m)),
    "contact_compliance": _of_contact("contact_compliance", None, lambda c, m: replace(c, damping=m * c.damping)),
    "patch": _of_contact("patch", None, lambda c, m: replace(c, patch=(0.03, 0.02, 0.05, m)), known=False),
}
"""Effects on the contact with the plane."""
WITHOUT_PLANE: dict[str, Builder] = {
    "sliding_friction": friction_of_surface,
    "contact_compliance": softer_contact,
    "adhesion": adhesion,
}
"""The same where the contacts are MuJoCo's."""
OWN: dict[str, Builder] = {
    "joint_friction": joint_friction,
    "stribeck_friction": stribeck_friction,
    "load_friction": load_friction,
    "warming": warming,
    "backlash": backlash,
    "joint_compliance": joint_compliance,
    "air_drag": air_drag,
    "wind": wind,
    **PLANE,
}
"""Effects that this world computes by formulas of its own."""
