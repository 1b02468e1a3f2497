"""Roles of bodies in a scene (robot, object or world), and the entity that each geom belongs to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.events.sequence import Entity, Role

if TYPE_CHECKING:
    from concent_warp.model import Model

COUPLED = (mujoco.mjtEq.mjEQ_JOINT, mujoco.mjtEq.mjEQ_TENDON)


@dataclass(frozen=True)
class Roles:
    """Names and roles of the bodies and geoms of a compiled model."""

    bodies: tuple[str, ...]
    """Body names, by body id."""
    body_role: tuple[Role, ...]
    """Roles, by body id."""
    entities: tuple[Entity, ...]
    """Entities that contacts refer to: robot links, spheres of objects, geoms of the surroundings."""
    geom_body: np.ndarray
    """Body id of each geom, shape (ngeom,)."""
    geom_entity: np.ndarray
    """Index into `entities` of each geom, shape (ngeom,)."""

    @staticmethod
    def of(compiled: mujoco.MjModel, model: Model) -> Roles:
        """Return the roles of a model.

        Objects are the bodies with contact geometry, or those that the scene names where the model has none. Robot is
        every other body in a kinematic tree that an actuator moves, be it directly, through a tendon or through an
        equality that couples joints. All else is world, including the static bodies below a robot's first joint.

        Args:
            compiled: The model as the engine compiled it; geom ids are its.
            model: The model.
        """
        objects = model.scene.objects() if model.geometry is None else model.geometry.bodies
        spheres = {} if model.geometry is None else {name: i for i, name in enumerate(model.geometry.names())}
        bodies = tuple(compiled.body(i).name or f"body{i}" for i in range(compiled.nbody))
        driven = _driven_trees(compiled)
        tree = compiled.body_treeid
        role: tuple[Role, ...] = tuple(
            "object" if name in objects else "robot" if int(tree[i]) in driven else "world"
            for i, name in enumerate(bodies)
        )
        entities: dict[str, Entity] = {}
        number: dict[str, int] = {}
        geom_entity = np.zeros(compiled.ngeom, dtype=int)
        for g in range(compiled.ngeom):
            body = int(compiled.geom_bodyid[g])
            name = compiled.geom(g).name or f"{bodies[body]}_geom{g - compiled.body_geomadr[body]}"
            if role[body] == "robot":
                entity = Entity(bodies[body], "robot", bodies[body])
            else:
                entity = Entity(name, role[body], bodies[body], spheres.get(name))
            while entities.get(entity.name, entity) != entity:
                entity = Entity(f"{entity.name}_geom", entity.role, entity.body, entity.sphere)
            entities[entity.name] = entity
            number.setdefault(entity.name, len(number))
            geom_entity[g] = number[entity.name]
        return Roles(bodies, role, tuple(entities.values()), compiled.geom_bodyid.astype(int), geom_entity)

    def ids(self, role: Role) -> list[int]:
        """Return the ids of the bodies of a role."""
        return [i for i, found in enumerate(self.body_role) if found == role]


def _driven_trees(m: mujoco.MjModel) -> set[int]:
    """Return the ids of the kinematic trees with a joint that an actuator moves."""
    joints: set[int] = set()
    tendons: set[int] = set()
    trees: set[int] = set()
    for i in range(m.nu):
        kind, target = int(m.actuator_trntype[i]), int(m.actuator_trnid[i, 0])
        if kind in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT):
            joints.add(target)
        elif kind == mujoco.mjtTrn.mjTRN_TENDON:
            tendons.add(target)
        elif kind in (mujoco.mjtTrn.mjTRN_SITE, mujoco.mjtTrn.mjTRN_SLIDERCRANK):
            trees.add(int(m.body_treeid[m.site_bodyid[target]]))
        elif kind == mujoco.mjtTrn.mjTRN_BODY:
            trees.add(int(m.body_treeid[target]))
    _spread_couplings(m, joints, tendons)
    trees |= {int(m.body_treeid[m.jnt_bodyid[j]]) for j in joints}
    return trees - {-1}


def _spread_couplings(m: mujoco.MjModel, joints: set[int], tendons: set[int]) -> None:
    """Add to the driven joints and tendons those that move with them through tendons and equalities."""
    before = -1
    while before != len(joints) + len(tendons):
        before = len(joints) + len(tendons)
        for t in tendons:
            wraps = range(m.tendon_adr[t], m.tendon_adr[t] + m.tendon_num[t])
            joints |= {int(m.wrap_objid[w]) for w in wraps if m.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT}
        for e in range(m.neq):
            pair = {int(m.eq_obj1id[e]), int(m.eq_obj2id[e])} - {-1}
            for kind, driven in zip(COUPLED, (joints, tendons), strict=True):
                if m.eq_type[e] == kind and pair & driven:
                    driven |= pair
