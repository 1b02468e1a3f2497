"""Logs of servos that swing a payload, as Rhoban's BAM publishes them (Duclusaud, Passault, Padois, Daney, "Extended
friction models for the physics simulation of servo actuators", 2024).

Each ``.json`` is one log: payload ``mass`` [kg] and ``length`` [m] of its arm, controller gain ``kp``, supply ``vin``
[V], and ``entries`` with ``timestamp`` [s], ``position`` and ``goal_position`` [rad, 0 where the arm hangs] and more.
The firmware sets the duty cycle in proportion to the error counted in ticks, so that with a motor of torque constant
kt and resistance R the torque is kt vin / R times the duty cycle, cut at 1, less kt^2 / R times the speed.

``load`` and ``speed`` are the firmware's own estimates and are left out: the load is a 16-bit number without a sign,
the speed is filtered. The times between samples are uneven and kept as they are. Where ``torque_enable`` says that the
motor was let go (logs of the kind "lift and drop"), the rest of the log is left out: no command describes it. The noise
of the position is stated as what the encoder's 12 bits leave, tick / sqrt(12).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.documents import is_number, read_json
from concent_warp.errors import RecordingError, printable
from concent_warp.limits import limits
from concent_warp.recording.naming import PREFIX
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.recording.validation.validate import validate

TICK = 2 * math.pi / 4096
"""Resolution of the encoder [rad]."""
FULL_DUTY = 256 * 885
"""Product of gain and error [ticks] at which the duty cycle is full."""
TORQUE_CONSTANT = 0.35
"""kt of the XL330 [N m/A], roughly."""
RESISTANCE = 4.0
"""R of the XL330 [ohm], roughly."""
TIMESTEP = 0.002
"""[s]."""
JOINT, DRIVE, SENSOR = "servo", "servo", "servo_position"
SETUP = {"mass": 1e3, "length": 1e2, "kp": 1e6, "vin": 1e3}
"""What all logs of a recording share, for it is part of the scene, and the largest value of each, in the log's units:
far beyond what a servo moves, and small enough for MuJoCo."""


@dataclass(frozen=True)
class Setup:
    """Payload and controller of a log."""

    mass: float
    """Payload [kg]."""
    length: float
    """Its distance from the axis [m]."""
    kp: float
    """Gain of the controller, in the firmware's units."""
    vin: float
    """Supply [V]."""

    @property
    def stall(self) -> float:
        """Torque at full duty cycle and at rest [N m]."""
        return TORQUE_CONSTANT * self.vin / RESISTANCE

    @property
    def stiffness(self) -> float:
        """Torque for an error of the position [N m/rad]."""
        return self.kp / TICK / FULL_DUTY * self.stall


def read_bam(path: Path | str, kp: float | None = None) -> Recording:
    """Read and validate one log, or all logs of a folder that were made at one gain, in the order of their names.

    Args:
        path: A ``.json`` file or a folder of them.
        kp: Gain of the logs that are read; needed where a folder holds logs of several.

    Returns:
        One demonstration a log, its task the trajectory that the servo was to follow, in the scene of `_servo_scene`.

    Raises:
        RecordingError: A file is missing or no log, or the logs differ in payload, supply or gain.
    """
    path = Path(path)
    if not path.exists():
        raise RecordingError("no such log or folder of logs", where=path, fix="check the path")
    paths = sorted(path.glob("*.json")) if path.is_dir() else [path]
    if not 0 < len(paths) <= limits().demonstrations:
        raise RecordingError("no logs in the folder", where=path, expected=".json files", found=len(paths))
    logs = [(p, document, _setup_of(document, p)) for p in paths for document in [_read_document(p)]]
    gains = sorted({setup.kp for _, _, setup in logs})
    logs = [log for log in logs if kp is None or log[2].kp == kp]
    if not logs:
        raise RecordingError(f"no log at kp {kp:g}", where=path, expected=f"one of {gains}")
    setups = {setup for _, _, setup in logs}
    if len(setups) > 1:
        differ = [name for name in SETUP if len({getattr(s, name) for s in setups}) > 1]
        raise RecordingError(
            "the logs are of several set-ups",
            where=path,
            expected="one payload, supply and gain",
            found=f"different {', '.join(differ)}",
            fix=f"choose kp among {gains}, or put the logs into folders by set-up",
        )
    demonstrations = tuple(_swing(document, f"{PREFIX}{p.stem}", p) for p, document, _ in logs)
    recording = Recording(_servo_scene(setups.pop()), demonstrations, str(path))
    validate(recording)
    return recording


def _servo_scene(setup: Setup) -> str:
    """Return the MJCF of a payload on an arm that a servo turns about a level axis; the motor's constants are rough."""
    braking = TORQUE_CONSTANT**2 / RESISTANCE
    return f"""
<mujoco model="servo pendulum">
  <option timestep="{TIMESTEP}"/>
  <visual><global offwidth="640" offheight="480"/></visual>
  <worldbody>
    <light pos="0 -1 1"/>
    <body name="arm" pos="0 0 {2 * setup.length!r}">
      <joint name="{JOINT}" type="hinge" axis="0 1 0" damping="{braking!r}"/>
      <geom name="arm" type="capsule" fromto="0 0 0 0 0 {-setup.length!r}" size="0.006" mass="0" contype="0"
            conaffinity="0" rgba="0.3 0.3 0.3 1"/>
      <geom name="payload" type="sphere" pos="0 0 {-setup.length!r}" size="0.001" mass="{setup.mass!r}" contype="0"
            conaffinity="0" rgba="0.9 0.5 0.2 1"/>
    </body>
  </worldbody>
  <actuator>
    <position name="{DRIVE}" joint="{JOINT}" kp="{setup.stiffness!r}" forcelimited="true"
              forcerange="{-setup.stall!r} {setup.stall!r}"/>
  </actuator>
  <sensor>
    <jointpos name="{SENSOR}" joint="{JOINT}"/>
  </sensor>
</mujoco>
"""


def _swing(document: dict[str, Any], name: str, path: Path) -> Demonstration:
    """Return a log, as far as the motor drives, as a demonstration; its clock begins at its first sample, at rest."""
    driven = _driven_entries(document, path)
    columns = {key: _column(document, key, path)[:driven] for key in ("timestamp", "position", "goal_position")}
    time = columns["timestamp"] - columns["timestamp"][0]
    position = columns["position"]
    return Demonstration(
        name=name,
        task=printable(str(document.get("trajectory", ""))),
        qpos=position[:1],
        qvel=np.zeros(1),
        action={DRIVE: Channel(time, columns["goal_position"])},
        measured={SENSOR: Channel(time, position[:, None], noise_std=TICK / math.sqrt(12))},
    )


def _driven_entries(document: dict[str, Any], path: Path) -> int:
    """Return how many entries there are before the motor is let go."""
    released = [row for row, entry in enumerate(document["entries"]) if isinstance(entry, dict) and not _driving(entry)]
    if released and released[0] < 2:
        raise RecordingError("the motor is off from the start", where=path, expected="torque_enable true")
    return released[0] if released else len(document["entries"])


def _driving(entry: dict[str, Any]) -> bool:
    """Return whether the motor drives; it does where nothing is said of it."""
    return bool(entry.get("torque_enable", True))


def _column(document: dict[str, Any], key: str, path: Path) -> np.ndarray:
    """Return the numbers of all entries under a key, shape (T,)."""
    entries = document["entries"]
    values = [entry.get(key) if isinstance(entry, dict) else None for entry in entries]
    for row, value in enumerate(values):
        if not is_number(value):
            raise RecordingError(
                f"{key} is not a number",
                where=f"{path}, entry {row}",
                expected="a finite number",
                found=repr(value)[:80],
            )
    return np.array(values, dtype=float)


def _read_document(path: Path) -> dict[str, Any]:
    """Return the JSON document of a log, with its entries."""
    document = read_json(path, RecordingError)
    entries = document.get("entries") if isinstance(document, dict) else None
    if not isinstance(entries, list) or not 2 <= len(entries) <= limits().samples:
        found = len(entries) if isinstance(entries, list) else type(entries).__name__
        raise RecordingError("not a log of a servo", where=path, expected="a list of at least 2 entries", found=found)
    return document


def _setup_of(document: dict[str, Any], path: Path) -> Setup:
    """Return payload and controller of a log."""
    values = []
    for key, largest in SETUP.items():
        value = document.get(key)
        if not is_number(value) or not 0 < value <= largest:
            expected = f"above 0 and at most {largest:g}"
            raise RecordingError(
                f"{key} of the set-up is not right", where=path, expected=expected, found=repr(value)[:80]
            )
        values.append(float(value))
    return Setup(*values)
