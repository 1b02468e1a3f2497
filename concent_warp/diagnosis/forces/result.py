"""Unexplained forces by degree of freedom and by place on each object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from concent_warp.comparison.result import finite
from concent_warp.diagnosis.forces.describe import (
    body_sentence,
    joint_sentence,
    nothing_sentence,
    pattern_sentence,
)
from concent_warp.diagnosis.forces.force_data import BodyForce, JointForce


@dataclass(frozen=True)
class UnexplainedForces:
    """Forces that a model lacks."""

    window: float
    """Time over which forces are averaged [s]."""
    joints: tuple[JointForce, ...]
    """Those with significant forces first, then by how far beyond noise."""
    bodies: tuple[BodyForce, ...]
    """Those with significant forces first, then by how far beyond noise."""
    level: float
    """Significance level [-]."""

    def arrows(self) -> list[dict[str, Any]]:
        """Return what to draw on the objects: significant forces that have a place, in the frame of their body.

        Each with `body`, `phase`, `point` [m], `vector` [N], `std` [m] of the point, and a `label`.
        """
        return [
            {
                "body": body.body,
                "phase": phase.phase,
                "point": phase.place.point.tolist(),
                "vector": phase.arrow.tolist(),
                "std": phase.place.std.tolist(),
                "label": f"{phase.size:.3g} N, {phase.phase}",
            }
            for body in self.bodies
            for phase in body.phases
            if phase.significant and phase.place is not None
        ]

    def sentences(self) -> list[str]:
        """Return a sentence for each force."""
        found = []
        for joint in self.joints:
            found.append(joint_sentence(joint))
        for body in self.bodies:
            lines = [body_sentence(body.body, phase) for phase in body.phases if phase.significant]
            for what, dependences, unit in (("force", body.force, "N"), ("torque", body.torque, "N m")):
                if body.significant and dependences.patterns:
                    lines.append(pattern_sentence(f"{body.body}, {what}", dependences, unit))
            found += lines or [nothing_sentence(body)]
        return found

    def to_json(self) -> dict[str, Any]:
        """Return everything as one JSON object, SI units; numbers that are not finite are null."""
        return finite(
            {
                "window": self.window,
                "level": self.level,
                "sentences": self.sentences(),
                "joints": [joint.to_json() for joint in self.joints],
                "bodies": [body.to_json() for body in self.bodies],
                "arrows": self.arrows(),
            }
        )
