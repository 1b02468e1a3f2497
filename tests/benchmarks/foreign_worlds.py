"""What the tests of the worlds on Drake and on Bullet have in common."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.independent.foreign.hidden import INSIDE
from benchmarks.independent.foreign.outside import OUTSIDE
from benchmarks.independent.foreign.recording import truth_of
from benchmarks.independent.foreign.rig import DriveState, Friction, Physics, true_physics

NULL = {
    **{"actuator_gain": 1.0, "actuator_saturation": 1e6, "mass": 1.0, "inertia": 1.0, "size": 1.0},
    **{"joint_compliance": 0.0},
}
"""Magnitudes at which an effect does nothing, where they are not 0."""
SETTERS = {"sliding_friction": "friction", "contact_compliance": "damping_ratio"}
"""Effects whose magnitude replaces a value of the world."""
NOISE = {"angle": 6e-4, "fine_angle": 4e-4, "travel": 1e-4, "marker": 4e-4, "position": 9e-4, "orientation": 9e-3}
"""Noise of sensors, roughly."""


def nominal_physics(rig):
    """Return the world with nominal values."""
    v = dict(rig.values)
    return Physics(
        v,
        {d.actuator: DriveState(armature=v[d.armature]) for d in rig.drives},
        {joint: Friction(v[name]) for joint, name in rig.friction.items()},
        {joint: v[name] for joint, name in rig.damping.items()},
    )


def brief(rig, seconds=1.0, seed=3):
    """Return a motion of a rig, cut off."""
    trial = rig.plan(np.random.default_rng(seed))
    return replace(trial, duration=min(seconds, trial.duration))


def seen(simulate, rig, physics, trial):
    """Return what there is to see of all sensors, without instruments but with hidden measurement effects."""
    motion = simulate(rig, physics, trial)
    found = {}
    for s in rig.sensors:
        time, value = motion.time, truth_of(rig, physics, s, motion)
        for measure in physics.measures:
            time, value = measure(s.name, time, value)
        found[s.name] = np.column_stack([time, value])
    return found


def check_that_an_effect_shows(simulate, rig, effect, magnitude):
    """Check that readings of a few motions, or of the first of them, differ by more than their noise."""
    seconds = 3.0 if rig.drives and effect in OUTSIDE else 2.0
    kinds = {s.name: s.kind for s in rig.sensors}
    plain, changed = true_physics(rig, 1), true_physics(rig, 1)
    (INSIDE | OUTSIDE)[effect](rig, changed, magnitude)
    if effect == "latency":
        assert changed.sensor_delay == magnitude
        return

    def largest(seed: int) -> float:
        trial = brief(rig, seconds, seed)
        before, after = seen(simulate, rig, plain, trial), seen(simulate, rig, changed, trial)
        return max(np.abs(after[n] - before[n]).max() / NOISE[kinds[n]] for n in before)

    assert any(largest(seed) > 3 for seed in range(min(rig.throws, 3)))


def check_that_an_effect_of_no_size_changes_nothing(simulate, rig, effect):
    """Check that readings are the same."""
    trial = brief(rig, 0.4)
    plain, changed = true_physics(rig, 1), true_physics(rig, 1)
    magnitude = changed.values[SETTERS[effect]] if effect in SETTERS else NULL.get(effect, 0.0)
    if effect == "gravity_tilt":
        magnitude = 1e-15
    INSIDE[effect](rig, changed, magnitude)
    before, after = seen(simulate, rig, plain, trial), seen(simulate, rig, changed, trial)
    for sensor in before:
        assert after[sensor] == pytest.approx(before[sensor], abs=1e-9)


def check_that_sets_are_reproducible_and_do_not_depend_on_one_another(world, name, sensor):
    """Check two recordings of a set, one of another seed and the held-out one."""
    (case,) = (c for c in world.sets() if c.name == name)
    first, again = world.make(case), world.make(case)
    other = world.make(replace(case, seed=7))
    for a, b, c in zip(
        first.recording.demonstrations, again.recording.demonstrations, other.recording.demonstrations, strict=True
    ):
        for channel in a.measured:
            np.testing.assert_array_equal(a.measured[channel].value, b.measured[channel].value)
            np.testing.assert_array_equal(a.measured[channel].time, b.measured[channel].time)
            assert not np.array_equal(a.measured[channel].time[:5], c.measured[channel].time[:5])
    held = first.held_out.demonstrations[0].measured[sensor]
    assert not np.array_equal(held.time[:5], first.recording.demonstrations[0].measured[sensor].time[:5])


def check_that_noise_is_stated_as_the_set_says(world, name):
    """Check both cases, and that held-out recordings always state it."""
    (case,) = (c for c in world.sets() if c.name == name)
    for told in (True, False):
        made = world.make(replace(case, noise_stated=told))
        channels = [c for d in made.recording.demonstrations for c in d.measured.values()]
        assert all((c.noise_std is not None) == told for c in channels)
        assert all(c.noise_std is not None for d in made.held_out.demonstrations for c in d.measured.values())
