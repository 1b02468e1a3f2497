"""Experiments of the world on MuJoCo: the user's nominal scene and the true world, which differ in more than effects.

Motions are those of `concent_warp.reality.rigs`. Nominal scenes have the time steps, integrators and contacts that
users have. The world has a step of 0.25 ms, another integrator, other contacts, and masses, lengths and gains within
`TOLERANCE` of the nominal ones. Commands act when they are recorded, without a lead, and no inertia is added.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from benchmarks.independent.data_set import TOLERANCE
from benchmarks.independent.plane_contact import PlaneContact
from concent_warp.reality.hidden.hidden_effect import fixed_inertia
from concent_warp.reality.rigs.registry import RIGS
from concent_warp.reality.rigs.rig import Rig, WorldPhysics
from concent_warp.scene.scene import Scene

STEP = 2.5e-4
"""Time step of the world [s]."""
MACHINING = 3e-4
"""Largest error of a length [m]: ISO 2768-1, class m, for lengths from 30 to 120 mm."""
INTEGRATOR = mujoco.mjtIntegrator
Edit = Callable[[mujoco.MjSpec], None]


@dataclass(frozen=True)
class Experiment:
    """An experiment of the world."""

    rig: Rig
    """Nominal scene, motions, and the parts that effects act on; its physics have no lead and no armature."""
    edit: Edit
    """Turns the nominal scene into the world, but for tolerances."""
    contact: PlaneContact | None = None
    """Contact of the free body with the plane, where MuJoCo's is switched off."""
    launched: bool = False
    """Whether bodies move freely when the recording begins."""

    def world(self, seed: int, contact: PlaneContact | None, edits: list[Edit]) -> mujoco.MjSpec:
        """Return the world, ready to be compiled: tolerances by a seed, the given contact, and edits of effects."""
        spec = self.rig.scene.spec()
        draw_tolerances(spec, seed)
        spec.option.timestep = STEP
        spec.option.iterations, spec.option.ls_iterations = 100, 50
        for joint in spec.joints:
            joint.frictionloss = 0.0  # the world has friction of its own
        self.edit(spec)
        if contact is not None:
            for geom in spec.body(self.rig.body).geoms:
                geom.contype = geom.conaffinity = 0
        for edit in edits:
            edit(spec)
        return spec


def draw_tolerances(spec: mujoco.MjSpec, seed: int) -> None:
    """Draw masses, inertias, lengths and gains of a world about the nominal ones, by a seed.

    Lengths differ by at most `MACHINING` too: sizes of free bodies, and offsets of links and of what is fixed to them.
    """
    rng = np.random.default_rng([seed, 99])
    compiled = spec.copy().compile()

    def factor(length: float | None = None) -> float:
        most = TOLERANCE if not length else min(TOLERANCE, MACHINING / length)
        return 1.0 + float(rng.uniform(-most, most))

    for b in range(1, compiled.nbody):
        body = spec.body(compiled.body(b).name)
        free = any(j.type == mujoco.mjtJoint.mjJNT_FREE for j in body.joints)
        if compiled.body_mass[b] > 0:
            heavier = factor()
            fixed_inertia(spec, body.name)
            body.mass *= heavier
            body.inertia = heavier * factor() * np.array(body.inertia)
        if free:
            for geom in body.geoms:
                size = np.array(geom.size)
                # Half sizes: the tolerance is that of the whole edge or diameter.
                geom.size = [s * factor(2 * s) if s else 0.0 for s in size]
        else:
            way = float(np.linalg.norm(body.pos))
            if way and body.joints and compiled.body_parentid[b]:
                body.pos = factor(way) * np.array(body.pos)
            for site in body.sites:
                way = float(np.linalg.norm(site.pos))
                if way:
                    longer = factor(way)
                    site.pos = longer * np.array(site.pos)
                    body.ipos = longer * np.array(body.ipos)
    for actuator in spec.actuators:
        gain, damping = factor(), factor()
        actuator.gainprm = gain * np.array(actuator.gainprm)
        actuator.biasprm = np.array(actuator.biasprm) * np.array([gain, gain, damping, *[1.0] * 7])


def _rig(name: str, spec: mujoco.MjSpec) -> Rig:
    """Return a rig with another nominal scene, and physics that add nothing."""
    scene = Scene.from_spec(spec, source=f"{name} experiment")
    return replace(RIGS[name], scene=scene, physics=WorldPhysics(timestep=STEP))


def _integrated(integrator: mujoco.mjtIntegrator) -> Edit:
    """Return the edit that sets an integrator."""

    def edit(spec: mujoco.MjSpec) -> None:
        spec.option.integrator = integrator

    return edit


def _touching(solref: tuple[float, float], solimp: tuple[float, ...], impratio: float) -> Edit:
    """Return the edit of other contacts between bodies, integrated implicitly."""

    def edit(spec: mujoco.MjSpec) -> None:
        spec.option.integrator = INTEGRATOR.mjINT_IMPLICIT
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = impratio
        spec.option.tolerance = 1e-12  # solved loosely, stiff contacts kick
        for geom in spec.geoms:
            if geom.contype or geom.conaffinity:
                geom.solref = list(solref)
                geom.solimp = [*solimp, 0.5, 2.0]

    return edit


def _pendulum() -> Experiment:
    """Return the servo with a payload; the user knows its friction, damping and rotor."""
    spec = RIGS["pendulum"].scene.spec()
    spec.option.timestep = 0.001
    joint = spec.joint("hinge")
    joint.frictionloss, joint.armature = 0.01, 4e-4
    joint.damping = [0.004, 0, 0]
    return Experiment(_rig("pendulum", spec), _integrated(INTEGRATOR.mjINT_RK4))


def _arm() -> Experiment:
    """Return the arm in free space."""
    return Experiment(_rig("arm", RIGS["arm"].scene.spec()), _integrated(INTEGRATOR.mjINT_RK4))


def _slide() -> Experiment:
    """Return the launched block."""
    contact = PlaneContact(5e4, 1.0, 120.0, (0.3, 0.3))
    return Experiment(
        _rig("slide", RIGS["slide"].scene.spec()), _integrated(INTEGRATOR.mjINT_EULER), contact, launched=True
    )


def _spin() -> Experiment:
    """Return the ball that spins or rolls."""
    contact = PlaneContact(1e6, 1.5, 600.0, (0.4, 0.4), spinning=1e-3, rolling=4e-4)
    return Experiment(
        _rig("spin", RIGS["spin"].scene.spec()), _integrated(INTEGRATOR.mjINT_EULER), contact, launched=True
    )


def _drop() -> Experiment:
    """Return the thrown ball on a smooth mat, which the user has calibrated by four drops of the same ball."""
    spec = RIGS["drop"].scene.spec()
    spec.option.timestep = 5e-4
    for geom in spec.geoms:
        geom.solref, geom.solimp = [0.0397, 0.2008], [0.9, 0.95, 0.001, 0.5, 2.0]
        geom.friction = [0.04, 0.005, 0.0001]
    contact = PlaneContact(8150.0, 1.05, 23.0, (0.04, 0.04), slip_speed=5e-3)
    return Experiment(_rig("drop", spec), _integrated(INTEGRATOR.mjINT_RK4), contact, launched=True)


def _tumble() -> Experiment:
    """Return the thrown box; the mat has MuJoCo's form of contact with other parameters."""
    edit = _touching((0.04 * 0.95 / 0.93, 0.7), (0.93, 0.93, 0.001), 10.0)
    return Experiment(_rig("tumble", RIGS["tumble"].scene.spec()), edit, launched=True)


def _push() -> Experiment:
    """Return the pushed block; the user knows the inertia of the drives' rotors."""
    spec = RIGS["push"].scene.spec()
    for name in ("slide_x", "slide_y"):
        spec.joint(name).armature = 0.2
    return Experiment(_rig("push", spec), _touching((0.005, 1.0), (0.92, 0.97, 0.001), 6.0))


def _grasp() -> Experiment:
    """Return the grasped block."""
    return Experiment(_rig("grasp", RIGS["grasp"].scene.spec()), _touching((0.005, 1.0), (0.92, 0.97, 0.001), 16.0))


def _insertion() -> Experiment:
    """Return the shape sorter, which the scripted expert demonstrates."""
    rig = RIGS["insertion"]
    return Experiment(replace(rig, physics=WorldPhysics(timestep=2 * STEP)), _integrated(INTEGRATOR.mjINT_IMPLICIT))


EXPERIMENTS: dict[str, Experiment] = {
    e.rig.name: e for e in (_pendulum(), _arm(), _slide(), _spin(), _push(), _drop(), _tumble(), _grasp(), _insertion())
}
"""By the name of the rig."""
