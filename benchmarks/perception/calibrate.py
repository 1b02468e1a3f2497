"""Camera calibration: pose, clock offset and intervals, against Reality.

    python -m benchmarks.perception.calibrate                     measure; goes on after an interruption
    python -m benchmarks.perception.calibrate --seconds 280       begin nothing after that time
    python -m benchmarks.perception.calibrate --table             the page from the stored data

The arm passes through 12 poses in 24 s, of which a camera of 640 x 480 px takes 16 frames: on the hand over a tag of
60 mm, over three tags or over a ChArUco board, or fixed in the world with a tag on the hand, or without any. Frames
have noise, blur of the lens and of an exposure of 6 ms, depth has noise and holes; encoders have a noise of 0.7 mrad
and lose readings; the recorded pose is off by up to 30 mm and 4 degrees an axis, the clock by up to 60 ms. *within*
is the share of the components (three of the position, three of the orientation, one clock) of all recordings that lie
in their 95 % intervals. A row counts every seed that was begun; a calibration that is refused counts as refused, and
in no error.

The bars are 2 mm, 0.3 degrees and 3 ms. Rows below the first five break an assumption: encoders with a constant error
of their own (standard deviation 1 mrad a joint, about 1 mm at the hand), which no camera can tell from its own pose;
a focal length that is recorded 2 % too long, with `--fit-intrinsics`; depth that reads 1.8 % too long. The figures do
not show real lenses, printed tags that are bent, rolling shutters, or a robot whose cables its model lacks.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.measurements import Measurements
from benchmarks.pages import FOLDER, machine, machine_line, table, write_page
from concent_warp.errors import RecordingError
from concent_warp.perception.calibration.calibrate import calibrate
from concent_warp.perception.calibration.cfg import CalibrateCfg, CalibrationTargetCfg
from concent_warp.perception.calibration.result import CameraCalibration
from concent_warp.reality.calibration import CAMERA, CalibrationSceneCfg, CalibrationTruth, record_calibration

NAME = "calibrate"
DATA = FOLDER / "data" / f"{NAME}.jsonl"
TAG = CalibrationTargetCfg(tag_size=0.06)
CHARUCO = CalibrationTargetCfg("charuco", "4X4_50", 0.0225, board=(6, 4), spacing=0.03)
BARS = (2.0, 0.3, 3.0)
"""Bars of position [mm], orientation [deg] and clock [ms]."""


@dataclass(frozen=True)
class Case:
    """A kind of recording and how it is calibrated."""

    scene: CalibrationSceneCfg
    seeds: int
    cfg: CalibrateCfg = field(default_factory=lambda: CalibrateCfg(TAG))


HAND = CalibrationSceneCfg(frames=16)
FIXED = replace(HAND, camera="world")
ROBOT = replace(FIXED, target="none")
CASES = {
    "camera on the hand, one tag": Case(HAND, 12),
    "camera on the hand, three tags": Case(replace(HAND, target="tags"), 4),
    "camera on the hand, ChArUco board": Case(
        replace(HAND, target="charuco", dictionary="DICT_4X4_50"), 4, CalibrateCfg(CHARUCO)
    ),
    "fixed camera, tag on the hand": Case(FIXED, 12),
    "fixed camera, robot in view": Case(ROBOT, 8, CalibrateCfg()),
    "on the hand, encoders off by 1 mrad": Case(replace(HAND, joint_bias=1e-3), 4),
    "fixed, tag, encoders off by 1 mrad": Case(replace(FIXED, joint_bias=1e-3), 4),
    "on the hand, focal length 2 % long": Case(
        replace(HAND, focal_scale=1.02), 4, CalibrateCfg(TAG, fit_intrinsics=True)
    ),
    "fixed, robot in view, depth 1.8 % long": Case(replace(ROBOT, depth_scale=1.018), 4, CalibrateCfg()),
}


def scored(found: CameraCalibration, truth: CalibrationTruth) -> dict[str, Any]:
    """Return errors [mm, deg, ms], and which components lie in their intervals."""
    shift = found.pose[:3, 3] - truth.pose[:3, 3]
    turn = Rotation.from_matrix(found.pose[:3, :3].T @ truth.pose[:3, :3]).as_rotvec()
    late = found.clock_offset - truth.clock_offset
    within = [*(np.abs(shift) <= found.position_interval), *(np.abs(turn) <= found.rotation_interval)]
    if found.clock_interval is not None:
        within.append(abs(late) <= found.clock_interval)
    return {
        "position": 1e3 * float(np.linalg.norm(shift)),
        "rotation": float(np.degrees(np.linalg.norm(turn))),
        "clock": 1e3 * abs(late),
        "half_position": 1e3 * float(np.linalg.norm(found.position_interval) / np.sqrt(3)),
        "within": [bool(one) for one in within],
        "frames": len(found.frames),
        "checks": {c.name: [c.value, c.low, c.high] for c in found.checks},
        "remarks": list(found.remarks),
    }


def measure(case: Case, seed: int) -> dict[str, Any]:
    """Return the score of one recording, or why it was refused."""
    recording, truth = record_calibration(case.scene, seed)
    begun = time.perf_counter()
    try:
        found = calibrate(recording, case.cfg).cameras[CAMERA]
    except RecordingError as error:
        return {"refused": str(error), "machine": machine()}
    return {**scored(found, truth), "seconds": time.perf_counter() - begun, "machine": machine()}


def rows_of(rows: dict[str, dict[str, Any]]) -> list[tuple[str, ...]]:
    """Return the lines of the table."""
    lines = []
    for name in CASES:
        begun = [row for key, row in rows.items() if key.rpartition("/")[0] == name]
        done = [row for row in begun if "position" in row]
        if not begun:
            continue
        within = [one for row in done for one in row["within"]]
        cells = [name, f"{len(begun)}", f"{len(begun) - len(done)}"]
        for key, bar in zip(("position", "rotation", "clock"), BARS, strict=True):
            values = [row[key] for row in done]
            digits = 3 if key == "rotation" else 2
            cells.append(
                f"{np.median(values):.{digits}f} / {max(values):.{digits}f}{'' if max(values) <= bar else ' **above**'}"
                if values
                else "-"
            )
        cells += [f"{np.mean([row['half_position'] for row in done]):.2f}" if done else "-"]
        cells += [f"{100 * np.mean(within):.0f} % of {len(within)}" if within else "-"]
        cells += [f"{np.median([row['seconds'] for row in done]):.0f}" if done else "-"]
        lines.append(tuple(cells))
    return lines


def write(rows: dict[str, dict[str, Any]]) -> None:
    head = (
        *("recordings", "begun", "refused", "position, mm: median / worst", "orientation, deg", "clock, ms"),
        *("half interval of position, mm", "within", "time, s"),
    )
    plain = [row for key, row in rows.items() if key.rpartition("/")[0] in list(CASES)[:5]]
    within = [one for row in plain for one in row.get("within", [])]
    parts = [
        "# Camera calibration\n\nWritten by `benchmarks/perception/calibrate.py`; do not edit.\n",
        "```\npython -m benchmarks.perception.calibrate\n```\n",
        *(f"{part}\n" for part in (__doc__ or "").split("\n\n")[2:]),
        machine_line(next(iter(rows.values()))["machine"]) + "\n",
        table(head, rows_of(rows)),
        f"In the first five rows {100 * np.mean(within):.1f} % of {len(within)} components lie in their intervals.\n",
        checks_text(rows),
    ]
    write_page(NAME, "\n".join(parts))


def checks_text(rows: dict[str, dict[str, Any]]) -> str:
    """Return what the checks of focal length and depth say where these are off, and why recordings were refused."""
    lines = []
    for name, check, truth in (
        ("on the hand, focal length 2 % long", "focal length x", 2.0),
        ("fixed, robot in view, depth 1.8 % long", "depth", 1.8),
    ):
        found = [
            r["checks"][check] for k, r in rows.items() if k.rpartition("/")[0] == name and check in r.get("checks", {})
        ]
        if found:
            values = ", ".join(f"{v:.2f} ({low:.2f} to {high:.2f})" for v, low, high in found)
            lines.append(f"- *{name}*: {check} found to be off by {values} %; truth {truth} %.")
    lines += [
        f"- *{key.replace('/', '*, seed ')}, refused: {row['refused']}" for key, row in rows.items() if "refused" in row
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES), help="what to measure")
    parser.add_argument("--first", type=int, default=0, help="first seed; the page has those from 0")
    parser.add_argument("--seeds", type=int, help="seeds of a case")
    parser.add_argument("--out", type=Path, default=DATA, help="file of JSON lines")
    parser.add_argument("--seconds", type=float, help="time after which nothing is begun [s]")
    parser.add_argument("--table", action="store_true", help="write the page from the stored data")
    arguments = parser.parse_args()
    kept = Measurements(arguments.out, seconds=arguments.seconds)
    if not arguments.table:
        for name in arguments.cases:
            for seed in range(arguments.first, arguments.first + (arguments.seeds or CASES[name].seeds)):
                if kept.wanted(f"{name}/{seed}", expected=45.0):
                    kept.add(f"{name}/{seed}", measure(CASES[name], seed))
        kept.close()
    if arguments.out == DATA:
        write(kept.rows)


if __name__ == "__main__":
    main()
