"""Unexplained forces of joints and bodies: over time, by phase, and what they depend on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from concent_warp.diagnosis.forces.dependence import Dependences
from concent_warp.diagnosis.forces.point_of_action import ForcePlace


@dataclass(frozen=True)
class ForceSeries:
    """An unexplained force over time, one value a window; windows overlap by half."""

    demonstration: str
    time: np.ndarray
    """Middles of the windows [s], shape (K,)."""
    force: np.ndarray
    """Shape (K,) of a joint, (K, 3) of a body (world frame); NaN where it cannot be estimated."""
    std: np.ndarray
    """Standard deviation, shape (K,)."""

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON."""
        arrays = {name: getattr(self, name).tolist() for name in ("time", "force", "std")}
        return {"demonstration": self.demonstration, **arrays}


@dataclass(frozen=True)
class JointForce:
    """The unexplained force of one joint, over all demonstrations."""

    joint: str
    unit: str
    """"N m" or "N"."""
    rms: float
    noise: float
    """RMS that the measurement noise alone leaves."""
    ratio: float
    """RMS of force over noise, window by window."""
    detectable: float
    """Smallest detectable steady force, in `unit`."""
    p: float
    """p-value of the strongest dependence on any of the features [-]."""
    significant: bool
    """It follows a pattern, after correction for the number of joints and bodies (Holm), or is far beyond noise."""
    dependences: Dependences
    series: tuple[ForceSeries, ...]

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON, SI units."""
        names = ("joint", "unit", "rms", "noise", "ratio", "detectable", "p", "significant")
        return {
            **{name: getattr(self, name) for name in names},
            **_dependences_json(self.dependences),
            "series": [s.to_json() for s in self.series],
        }


@dataclass(frozen=True)
class PhaseForce:
    """The unexplained force on a free body in one phase."""

    phase: str
    spans: tuple[tuple[str, float, float], ...]
    """Demonstration, start and end [s]."""
    frame: str
    """Frame in which the force is steadiest: "world", the body's name, or "sliding"."""
    vector: np.ndarray
    """Steady force [N] in that frame, shape (3,); in "sliding" the first component is along the velocity."""
    std: np.ndarray
    """Its standard deviation [N], shape (3,)."""
    share: float
    """Share of the unexplained force that is steady in that sense."""
    impulse: np.ndarray
    """Time integral of the unexplained force [N s], world frame, mean over the spans, shape (3,)."""
    torque: np.ndarray
    """Mean unexplained torque about the body's origin [N m], body frame, shape (3,)."""
    p: float
    """p-value [-]."""
    smallest_p: float
    """Smallest `p` that the test can give [-]; 0 for known noise."""
    test: str
    """"sign flips", or "known noise"."""
    significant: bool
    place: ForcePlace | None
    """Where it acts; None where that was not measured, or where nothing significant acts."""
    arrow: np.ndarray
    """Mean force [N], body frame, shape (3,), for drawing."""

    @property
    def size(self) -> float:
        """How large the steady force is [N]."""
        return float(np.linalg.norm(self.vector))

    @property
    def size_std(self) -> float:
        """Standard deviation of `size` [N]."""
        unit = self.vector / max(self.size, 1e-12)
        return float(np.sqrt((unit**2 * self.std**2).sum()))

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON, SI units."""
        values = {name: _plain(value) for name, value in vars(self).items() if name not in ("place", "spans")}
        spans = [{"demonstration": d, "start": a, "end": b} for d, a, b in self.spans]
        place = None if self.place is None else self.place.to_json()
        return {**values, "size": self.size, "size_std": self.size_std, "spans": spans, "place": place}


@dataclass(frozen=True)
class BodyForce:
    """The unexplained force and torque on one free body."""

    body: str
    rms: float
    """Of the force [N]."""
    noise: float
    """RMS that the measurement noise alone leaves [N]."""
    ratio: float
    """RMS of force over noise, window by window."""
    p: float
    """Smallest p-value of its phases and dependences, corrected for their number."""
    significant: bool
    """It follows a pattern, after correction for the number of joints and bodies (Holm), or is far beyond noise."""
    force: Dependences
    torque: Dependences
    phases: tuple[PhaseForce, ...]
    """The most significant first."""
    series: tuple[ForceSeries, ...]

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON, SI units."""
        names = ("body", "rms", "noise", "ratio", "p", "significant")
        return {
            **{name: getattr(self, name) for name in names},
            "force": _dependences_json(self.force),
            "torque": _dependences_json(self.torque),
            "phases": [phase.to_json() for phase in self.phases],
            "series": [s.to_json() for s in self.series],
        }


def _dependences_json(found: Dependences) -> dict[str, Any]:
    """Return dependences as JSON."""
    return {
        "dependences": [vars(d) for d in found.all],
        "patterns": [{**vars(p), "alternatives": list(p.alternatives)} for p in found.patterns],
    }


def _plain(value: Any) -> Any:
    """Return an array as a list, anything else as it is."""
    return value.tolist() if isinstance(value, np.ndarray) else value
