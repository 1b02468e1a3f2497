"""A data set of the benchmark, and what making it returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from typing import Literal

from concent_warp.recording.recording import Recording
from concent_warp.scene.scene import Scene

World = Literal["mujoco", "drake", "bullet"]
WORLDS: tuple[World, ...] = ("mujoco", "drake", "bullet")
ENGINES: dict[World, str] = {"mujoco": "MuJoCo", "drake": "Drake", "bullet": "Bullet"}
"""What simulates a world."""
Kind = Literal["null", "single", "outside", "pair", "geometry"]
KINDS: tuple[Kind, ...] = ("null", "single", "outside", "pair", "geometry")
"""Nothing hidden; one effect of the library; one that the library lacks; two of the library at once; a contact geometry
that differs, alone or with another effect."""
Size = Literal["small", "middle", "large"]
SIZES: tuple[Size, ...] = ("small", "middle", "large")
TOLERANCE = 0.01
"""Largest relative error of nominal masses, lengths and gains [-], in all data sets."""


def number(text: str) -> float:
    """Return a number between 0 and 1 that depends on nothing but a text, by SHA-256."""
    return int(sha256(text.encode()).hexdigest()[:12], 16) / 16**12


@dataclass(frozen=True)
class DataSet:
    """A recording to be made; the same each time."""

    name: str
    """Unique over all worlds; in those on other engines than MuJoCo it begins with their name."""
    world: World
    kind: Kind
    rig: str
    """Name of the experiment within its world."""
    magnitudes: Mapping[str, float] = field(default_factory=dict)
    """Value of the main parameter of each hidden effect, by the library's name of the effect where it has it."""
    seed: int = 0
    """Of initial states, commands, clocks, noise and the errors of the nominal model."""
    demonstrations: int = 1
    """How often the rig's experiment is done."""
    noise_stated: bool = True
    """Whether channels of the recording have their `noise_std`."""
    size: Size | None = None
    """Magnitude in words; None where nothing is hidden."""

    @property
    def key(self) -> str:
        """World, rig and hidden effects: the unit that the split locks; each set with nothing hidden is its own."""
        hidden = "+".join(sorted(self.magnitudes)) or self.name
        return f"{self.world}/{self.rig}/{hidden}"


@dataclass(frozen=True)
class Truth:
    """A hidden effect."""

    effect: str
    """Canonical name of the library's effect, or a name that no library has."""
    parameters: Mapping[str, float] = field(default_factory=dict)
    """True values by the name of the library's parameter, as the user's nominal model defines it; none where the
    physics has no such number."""
    target: tuple[str, ...] = ()
    """Joints, drives, bodies or sensors concerned."""
    known: bool = True
    """Whether the library has it."""


@dataclass(frozen=True)
class Data:
    """What making a data set returns."""

    recording: Recording
    """What is diagnosed; its scene is the user's."""
    held_out: Recording
    """Other motions of the same world with the same hidden effects, which the diagnosis does not see; all channels have
    their noise."""
    scene: Scene
    """The user's nominal scene."""
    truth: tuple[Truth, ...]
    """One for each hidden effect; empty where nothing is hidden."""
