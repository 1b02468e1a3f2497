r"""Frames a second of the hybrid rendering, layer by layer and as a whole, and what painting at 64 x 64 saves.

    python -m benchmarks.render.speed --out render_speed.jsonl                     # a CPU, few worlds
    python -m benchmarks.render.speed --device cuda:0 --worlds 64 256 1024 --width 64 --enlarge-width 64 --blocks 8 \
        --seconds 500

Networks are not trained: what they take does not depend on their weights. A line of JSON for each measurement is
appended to --out; one that is there is not made again, and one for which the memory did not suffice says so. *Memory*
is what the device has in use then, by torch, which keeps what it had, and Warp.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from benchmarks.measurements import Measurements
from benchmarks.pages import machine
from concent_warp.render.cameras import Camera
from concent_warp.render.composite import HybridCamera
from concent_warp.render.networks.cfg import FlowNetworkCfg, SuperResolutionCfg
from concent_warp.render.networks.flow import sample_images
from concent_warp.render.networks.flow_network import FlowNetwork
from concent_warp.render.networks.painter import Painter
from concent_warp.render.networks.super_resolution import SuperResolution
from concent_warp.render.raw import PosedWorlds, RawCamera
from concent_warp.render.shadow_cfg import ShadowCfg
from concent_warp.render.splats.splats import Splats
from concent_warp.scene.cameras import with_cameras
from concent_warp.scene.shape_sorter import ShapeSorterCfg, home

CAMERAS = ("base", "wrist")
STEPS = 4
"""Steps of the flow."""
KINDS = {"layers": ("raw", "hybrid without networks", "hybrid"), "painting": ("64 and enlarged", "256 at once")}
SPLATS = 8000
"""Splats of each object."""


def timed(call: Callable[[], Any], device: str, least: float) -> float:
    """Return the time of a call [s], the mean of as many as take `least` seconds, after one that is not counted."""

    def wait() -> None:
        if device != "cpu":
            torch.cuda.synchronize()

    call()
    wait()
    begun, count = time.perf_counter(), 0
    while count < 2 or time.perf_counter() - begun < least:
        call()
        wait()
        count += 1
    return (time.perf_counter() - begun) / count


def painter(arguments: argparse.Namespace, device: str) -> Painter:
    """Return networks that nobody has trained."""
    scene = with_cameras(ShapeSorterCfg().build(), CAMERAS)
    cameras = {name: Camera.in_scene(scene, name) for name in CAMERAS}
    base = FlowNetworkCfg(width=arguments.width)
    networks = {
        name: FlowNetwork(FlowNetworkCfg(width=arguments.width, posed=cameras[name].moves)).to(device).eval()
        for name in CAMERAS
    }
    enlarge = SuperResolution(SuperResolutionCfg(width=arguments.enlarge_width, blocks=arguments.blocks)).to(device)
    references = {name: torch.zeros(3, base.size, base.size, device=device) for name in CAMERAS}
    return Painter(networks, references, cameras, enlarge.eval(), steps=STEPS, half=device != "cpu")


def speckled() -> Splats:
    """Return splats on a cube, as many as a fitted object has."""
    rng = np.random.default_rng(0)
    place = rng.uniform(-0.02, 0.02, (SPLATS, 3))
    place[np.arange(SPLATS), rng.integers(0, 3, SPLATS)] = 0.02
    values = (place, rng.normal(size=(SPLATS, 4)), np.full((SPLATS, 3), 8e-4), np.full(SPLATS, 0.9),
              rng.normal(size=(SPLATS, 4, 3)))  # fmt: skip
    return Splats(*(torch.tensor(value, dtype=torch.float32) for value in values))


def layers(worlds: int, arguments: argparse.Namespace) -> Iterator[tuple[str, float]]:
    """Yield the time of a frame of all worlds and both cameras [s], by what is rendered."""
    device = arguments.device
    where = str(wp.device_to_torch(wp.get_device(device)))
    scene = with_cameras(ShapeSorterCfg().build(), CAMERAS)
    model = scene.model
    qpos = torch.tensor(np.tile(home(model), (worlds, 1)), dtype=torch.float32, device=where)
    stage = PosedWorlds(model, worlds, device=device)
    stage.place(qpos)
    raw = RawCamera(stage, CAMERAS, (256, 256))
    yield "raw", timed(raw.render, device, arguments.least)
    del raw, stage
    looks = {name: speckled().to(where) for name in ("block", "box")}
    made = painter(arguments, where)
    for name, options in {
        "hybrid without networks": {"splats": looks, "shadows": ShadowCfg()},
        "hybrid": {"splats": looks, "shadows": ShadowCfg(), "painter": made},
    }.items():
        camera = HybridCamera(model, CAMERAS, (256, 256), worlds, objects=("block", "box"), device=device, **options)
        yield name, timed(lambda camera=camera: camera.shoot(qpos), device, arguments.least)
        del camera


def painting(worlds: int, arguments: argparse.Namespace) -> Iterator[tuple[str, float]]:
    """Yield the time of painting one camera of all worlds [s]: at 64 x 64 and enlarged, and at 256 x 256 at once."""
    where = str(wp.device_to_torch(wp.get_device(arguments.device)))
    made = painter(arguments, where)
    seen = torch.rand(worlds, 1, 256, 256, 3, device=where)
    pose = [torch.zeros(worlds, 9, device=where)]
    made.begin(worlds)
    yield "64 and enlarged", timed(lambda: made.paint(["base"], seen, pose), arguments.device, arguments.least)
    whole = FlowNetwork(FlowNetworkCfg(size=256, width=arguments.width)).to(where).eval()
    image = torch.rand(worlds, 3, 256, 256, device=where)

    def at_once() -> None:
        with torch.autocast(image.device.type, torch.bfloat16, enabled=made.half):
            for part in image.split(arguments.together):
                sample_images(whole, part, part, None, steps=STEPS)

    yield "256 at once", timed(at_once, arguments.device, arguments.least)


def in_use(device: str) -> float:
    """Return the memory of a CUDA device that is in use [GB]."""
    free, total = torch.cuda.mem_get_info(device)
    return (total - free) / 1e9


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("render_speed.jsonl"))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 4])
    parser.add_argument("--width", type=int, default=16, help="channels of the flow's first level")
    parser.add_argument("--enlarge-width", type=int, default=32)
    parser.add_argument("--blocks", type=int, default=4, help="blocks of the super-resolution")
    parser.add_argument("--together", type=int, default=64, help="images of 256 x 256 that are painted at once")
    parser.add_argument("--least", type=float, default=1.0, help="time of each measurement [s]")
    parser.add_argument("--seconds", type=float, help="time after which no measurement is begun [s]")
    arguments = parser.parse_args()
    kept = Measurements(arguments.out, seconds=arguments.seconds)
    for worlds in arguments.worlds:
        for kind, measure in (("layers", layers), ("painting", painting)):
            group = f"{arguments.device} {worlds} worlds, width {arguments.width}: {kind}"
            if all(f"{group}, {name}" in kept.rows for name in KINDS[kind]) or not kept.wanted(group):
                continue
            row: dict[str, Any] = {"worlds": worlds, "machine": machine(arguments.device)}
            try:
                for name, seconds in measure(worlds, arguments):
                    if arguments.device != "cpu":
                        row["memory"] = in_use(arguments.device)
                    kept.add(f"{group}, {name}", {"seconds": seconds, "name": name, **row})
            except (RuntimeError, MemoryError) as error:
                kept.add(group, {**row, "error": " ".join(str(error).split())[:300]})
            if arguments.device != "cpu":
                gc.collect()
                torch.cuda.empty_cache()
    kept.close()


if __name__ == "__main__":
    main()
