"""Unexplained forces in words."""

from __future__ import annotations

import numpy as np

from concent_warp.comparison.units import p_value_text
from concent_warp.diagnosis.forces import features
from concent_warp.diagnosis.forces.dependence import Dependences
from concent_warp.diagnosis.forces.force_data import BodyForce, JointForce, PhaseForce
from concent_warp.diagnosis.forces.point_of_action import ForcePlace
from concent_warp.diagnosis.forces.wrench import SLIP, WORLD

MEANINGS = {
    features.DIRECTION: ("opposes motion, whatever its speed", "goes with motion, whatever its speed"),
    features.SLOW: ("opposes slow motion", "goes with slow motion"),
    features.LIMIT: ("takes from the drive's force near its peak", "adds to the drive's force near its peak"),
    features.SPEED: ("opposes motion and grows with speed", "goes with motion and grows with speed"),
    features.DRAG: ("opposes motion and grows with the square of speed", "goes with the square of speed"),
    features.ACCELERATION: ("opposes acceleration, as missing inertia does", "goes with acceleration"),
    features.LOADED: ("opposes motion and grows with load", "goes with motion and grows with load"),
    features.GRAVITY: ("goes against weight", "goes with weight"),
    features.DRIVE: ("goes against the drive's force", "goes with the drive's force"),
    features.COMMAND_RATE: ("lags behind the command", "leads the command"),
    features.POSITION: ("pulls back to a position", "pushes away from a position"),
    features.CONSTANT: ("is constant", "is constant"),
    features.CONTACT: ("comes with contact", "comes with contact"),
    features.SLIDING: ("opposes sliding, whatever its speed", "goes with sliding, whatever its speed"),
    "direction of turning": ("opposes turning, whatever its speed", "goes with turning, whatever its speed"),
    "angular velocity": ("opposes turning and grows with speed", "goes with turning and grows with speed"),
}
"""What a negative and a positive slope mean."""
UNITS = {
    features.SPEED: "per {speed}",
    "angular velocity": "per rad/s",
    features.DRAG: "per (m/s)²",
    features.ACCELERATION: "per {speed}²",
    features.COMMAND_RATE: "s",
    features.POSITION: "per {length}",
}
"""Unit of a slope over the force's unit."""
DIMENSIONLESS = (features.LOADED, features.GRAVITY, features.DRIVE, features.LIMIT)
AXES = "xyz"


def joint_sentence(found: JointForce) -> str:
    """Return the sentence about a joint."""
    head = f"{found.joint}: {found.rms:.2g} {found.unit} unexplained (rms; noise {found.noise:.2g})"
    if found.significant and found.dependences.patterns:
        length = "rad" if found.unit == "N m" else "m"
        return f"{head}; it {_pattern_words(found.dependences, found.unit, length)}."
    if found.significant:
        return f"{head}; it follows none of the features{_time_words(found)}."
    return f"{head}, no more than noise; smallest detectable steady force: {found.detectable:.2g} {found.unit}."


def _time_words(found: JointForce) -> str:
    """Return when a force is largest, in words."""
    worst = max(found.series, key=lambda s: np.nanmax(np.abs(s.force) / s.std, initial=0))
    k = int(np.nanargmax(np.abs(worst.force) / worst.std))
    return f", and is largest at {worst.time[k]:.2f} s of {worst.demonstration}"


def nothing_sentence(found: BodyForce) -> str:
    """Return the sentence about a body of whose force nothing more is known."""
    size = f"force {found.rms:.2g} N rms, noise {found.noise:.2g} N"
    if found.significant:
        return f"{found.body}: unexplained forces ({size}) that are steady in no phase and follow none of the features."
    return f"{found.body}: nothing beyond noise ({size})."


def pattern_sentence(what: str, found: Dependences, unit: str) -> str:
    """Return a sentence about what a force depends on."""
    return f"{what}: {_pattern_words(found, unit, 'm' if unit == 'N' else 'rad')}."


def _pattern_words(found: Dependences, unit: str, length: str) -> str:
    """Return what a force depends on, in words."""
    parts = []
    for pattern in found.patterns:
        low, high = MEANINGS.get(pattern.feature, ("is along -{}", "is along +{}"))
        words = (low if pattern.slope < 0 else high).format(pattern.feature)
        factor = "" if pattern.feature in DIMENSIONLESS else unit
        per = UNITS.get(pattern.feature, "").format(speed=f"{length}/s", length=length)
        size = f"{pattern.slope:.3g} ± {1.96 * pattern.slope_std:.1g} {factor} {per}".rstrip()
        p = p_value_text(pattern.p, pattern.smallest_p)
        text = f"{words} ({' '.join(size.split())}; {100 * pattern.share:.0f} % of it, {p})"
        if pattern.alternatives:
            text += f", which these data cannot distinguish from {' or '.join(pattern.alternatives[:3])}"
        parts.append(text)
    return "; besides, it ".join(parts)


def body_sentence(body: str, found: PhaseForce) -> str:
    """Return the sentence about a body in a phase."""
    spans = ", ".join(f"{d} {a:.2f}-{b:.2f} s" for d, a, b in found.spans[:2])
    more = f" and {len(found.spans) - 2} more" if len(found.spans) > 2 else ""
    text = f"{body}, {found.phase} ({spans}{more}): {found.size:.2g} ± {1.96 * found.size_std:.1g} N unexplained"
    text += f" {_direction_words(found.vector, found.frame)}"
    if found.place is not None:
        text += _place_words(found.place)
    if found.phase == "impact":
        text += f"; {np.linalg.norm(found.impulse):.2g} N s a time"
    return f"{text}; {p_value_text(found.p, found.smallest_p)}."


def _place_words(place: ForcePlace) -> str:
    """Return where a force acts, in words, to follow on what it is."""
    if place.against is not None:
        words = f", at its contact with {place.against} ({place.face})"
    elif place.through_center:
        words = ""
    elif place.off:
        words = f", on a line that misses it by {1e3 * place.off:.0f} mm"
    else:
        known = [i for i, axis in enumerate(AXES) if axis not in place.hidden]
        coordinates = ", ".join(f"{1e3 * place.point[i]:.0f}" if i in known else "?" for i in range(3))
        words = f", at ({coordinates}) mm: {place.face}"
        if known:
            words += f", ± {1e3 * 1.96 * max(place.std[i] for i in known):.2g} mm"
        if place.hidden:
            words += f" (its contacts hide the place along {' and '.join(place.hidden)})"
    if place.through_center:
        words += "; its line passes through the centre of mass, as that of weight, wind or inertia does"
    return words


def _direction_words(vector: np.ndarray, frame: str) -> str:
    """Return the direction of a force in words: "along -x", "along +x -y of block", "against its sliding"."""
    if frame == SLIP:
        return "against its sliding" if vector[0] < 0 else "with its sliding"
    size = max(float(np.linalg.norm(vector)), 1e-12)
    order = np.argsort(-np.abs(vector))
    axes = [i for i in order if abs(vector[i]) > 0.25 * size]
    words = " ".join(f"{'+' if vector[i] > 0 else '-'}{AXES[i]}" for i in axes)
    return f"along {words}" if frame == WORLD else f"along {words} of {frame}"
