"""The null model: the same scene in which objects do not touch one another.

A fit can lower the error by dissolving the contact, because what carries an object carries it through the other one
too. The error of this model is what that would reach; a fit that explains the contact must end well below it.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

from concent_warp.scene.scene import Scene

if TYPE_CHECKING:
    from concent_warp.model import Model


def without_object_contact(model: Model) -> Model | None:
    """Return a copy of a model whose objects do not collide with one another; None where it has fewer than two."""
    objects = model.scene.objects() if model.geometry is None else model.geometry.bodies
    if len(objects) < 2:
        return None
    spec = model.scene.spec()
    for a, b in combinations(objects, 2):
        spec.add_exclude(bodyname1=a, bodyname2=b)
    return replace(model, scene=Scene.from_spec(spec, source=model.scene.source))
