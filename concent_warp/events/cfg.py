"""Settings of the contact event extraction and the staging."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from concent_warp.checks import (
    MAX_COUNT,
    Angle,
    Bounds,
    Duration,
    Positive,
    PositiveDuration,
    PositiveShare,
    Share,
    check_settings,
)
from concent_warp.errors import EventsError


@dataclass(frozen=True)
class InsertionCfg:
    """How the plane of the first contact of two objects is found, and what counts as beyond it.

    "Empirical" values were set on simulated insertions with surfaces of spheres of 2 to 6 mm radius.
    """

    across_angle: Angle = 45.0
    """Angle between a contact's normal and an axis from which on the contact is across the axis [deg]."""
    opposing_angle: Angle = 60.0
    """Angle between a contact's normal and the reverse of a motion below which the contact opposes the motion [deg].
    Empirical: normals of spheres differ by up to this much from that of the surface."""
    inner_share: Share = 0.2
    """Share of the normal force above which the surfaces that it acts on count as touched [-]. Empirical."""
    plane_radius: float = 0.06
    """Distance from the first contact within which spheres are fitted by its plane [m]: the size of a hand-held
    object."""
    plane_min_spheres: Annotated[int, Bounds(3, MAX_COUNT)] = 6
    """Least number of spheres that a plane is fitted to [-]: twice what determines it."""
    plane_band: float = 0.0015
    """Difference in height below which spheres are level [m]. Empirical: a fraction of their radius."""
    plane_tilts: Annotated[tuple[float, ...], Bounds(0, 90, ascending=True)] = tuple(2.0 * k for k in range(1, 16))
    """Tilts against the reverse of the motion that are tried, ascending [deg]."""
    plane_flatness: float = 3.0
    """Ratio of the second to the third singular value of a layer of spheres above which it determines a plane [-].
    Empirical."""
    grid: Positive = 0.001
    """Size of the grid to which points that ever touch are thinned out [m]."""

    def __post_init__(self) -> None:
        if not self.plane_tilts:
            raise EventsError("plane_tilts is empty", expected="angles in degrees", found=self.plane_tilts)
        check_settings(self, EventsError)


@dataclass(frozen=True)
class StagingCfg:
    """How contacts are filtered and how stages and their target events are found.

    Durations lie between the chatter of contacts of stiff spheres and the length of a stage.

    Example:
        >>> import concent_warp as cw
        >>> cw.StagingCfg(min_contact_duration=0.05).min_contact_duration
        0.05
    """

    max_gap: Duration = 0.05
    """Breaks of a contact shorter than this are closed [s]."""
    min_contact_duration: Duration = 0.03
    """Contacts shorter than this, after closing breaks, are dropped [s]."""
    initial_duration: Duration = 0.1
    """Contacts that begin up to this time are the context the task starts in, and open no stage [s]."""
    window: PositiveDuration = 0.1
    """Length of the windows that forces are summed over and target events are read from [s]."""
    min_state_duration: Duration = 0.05
    """A grasp or a contact inside another object counts once it has lasted this long [s]."""
    max_net_force_ratio: Share = 0.5
    """The robot grasps an object when its forces on it add up to less than this share of their magnitudes [-]."""
    min_displacement: float = 0.005
    """An object that the robot touches without grasping it opens a stage if a touched point of it moves by more than
    this [m]."""
    approach_length: float = 0.01
    """Length of path before the first contact of two objects from which the direction of approach is taken [m]."""
    inside_depth: float = 0.003
    """An object is inside another once it is this far beyond the plane of their first contact [m]."""
    min_touch_share: PositiveShare = 0.5
    """A pair belongs to a target event if it touched during this share of the window [-]."""
    target: Literal["settled", "transition"] = "settled"
    """Which configuration of a stage is its target event: the last steady one of the stage, before the object is
    released or the next stage begins, or the one at the transition (the literal reading of the paper)."""
    insertion: InsertionCfg = field(default_factory=InsertionCfg)
    """Contacts of objects with one another."""

    def __post_init__(self) -> None:
        check_settings(self, EventsError)
        if self.target not in ("settled", "transition"):
            raise EventsError("staging: unknown target", expected="'settled' or 'transition'", found=repr(self.target))
