"""How far hybrid images are from the camera's, and what each layer does for that, in the stand-in world.

    python benchmarks/render_gap.py --out render_gap.jsonl                     # small networks, on a CPU
    python benchmarks/render_gap.py --full --device cuda:0 --out render_gap.jsonl

The stand-in's laboratory plays the real one: other textures, lights, shadows and noise than the simulation's image. It
is filmed without objects to train the networks, and with them on trajectories that training never saw; the objects are
photographed under the laboratory's lights to fit their splats. What is made is kept in --folder and not made again.
A line of JSON for each way of rendering is appended to --out.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from measurements import Measurements
from pages import machine

from concent_warp.cli.entry import main as concent
from concent_warp.reality.footage import FootageCfg, developed
from concent_warp.reality.laboratory import light
from concent_warp.reality.photographs import PhotographsCfg, photographs
from concent_warp.reality.record import RealityCfg, record
from concent_warp.recording.hdf5 import read_hdf5, write_hdf5
from concent_warp.recording.recording import Recording

CAMERAS = ("base", "wrist")
SMALL = (
    "--flow.steps 900 --flow.batch 8 --flow.ema 0.99 --flow.learning-rate 1.5e-3 --flow.warm-up 20 --network.width 16 "
    "--enlarge.steps 400 --enlarge.batch 8 --enlarge.ema 0.99 --enlarge.learning-rate 1e-3 --enlarge.warm-up 20 "
    "--super-resolution.width 32 --super-resolution.blocks 4 --half"
)
"""Networks that a CPU trains in a quarter of an hour."""
FULL = "--flow.steps 12000 --enlarge.steps 6000 --half"
VARIANTS: dict[str, dict[str, bool]] = {
    "raw simulation": {},
    "splats": {"splats": True},
    "flow": {"painter": True},
    "flow and splats": {"painter": True, "splats": True},
    "flow, splats and shadows": {"painter": True, "splats": True, "shadows": True},
}


def footage(folder: Path, name: str, seeds: list[int], *, objects: bool, rate: float) -> Recording:
    """Return a recording of the laboratory, from the folder if it is there."""
    path = folder / name
    if not path.exists():
        cfg = RealityCfg(footage=FootageCfg(cameras=CAMERAS, objects=objects, rate=rate))
        write_hdf5(record(cfg, seeds)[0], path)
    return read_hdf5(path)


def fitted_splats(folder: Path, body: str, arguments: argparse.Namespace) -> Path:
    """Return the splats of an object, fitted to photographs under the laboratory's lights."""
    from concent_warp.render.splat_views import SplatViews

    path = folder / f"splats_{body}" / "splats.ply"
    if not path.exists():
        cfg = RealityCfg()
        world = cfg.world.build(cfg.task.build())
        light(world)
        taken = photographs(world, body, PhotographsCfg(size=arguments.photo))
        rgba = taken.rgba.copy()
        rgba[..., :3] = np.round(255 * developed(rgba[..., :3] / 255))
        SplatViews(rgba, taken.poses, taken.intrinsics, True).write(folder / f"photos_{body}")
        command = ["splat-fit", str(folder / f"photos_{body}"), "--out", str(path.parent), "--device", arguments.device]
        if concent([*command, "--overwrite", "--fit.iterations", str(arguments.iterations)]) != 0:
            raise SystemExit("the splats could not be fitted")
    return path


def compared(held: Recording, wanted: dict[str, bool], made: dict[str, Any], device: str) -> dict[str, Any]:
    """Return PSNR [dB], SSIM and time of one way of rendering, over all frames of the held-out trajectories."""
    import torch
    from concent_warp.render.composite import HybridCamera
    from concent_warp.render.shadow_cfg import ShadowCfg
    from kornia.metrics import ssim

    score: dict[str, list[tuple[float, float, float]]] = {name: [] for name in CAMERAS}
    objects = made["scene"].objects()
    camera = HybridCamera(
        made["model"], CAMERAS, (256, 256), 1, objects=objects, device=device,
        splats=made["splats"] if wanted.get("splats") else None,
        painter=made["painter"] if wanted.get("painter") else None,
        shadows=ShadowCfg() if wanted.get("shadows") else None,
    )  # fmt: skip
    body = [made["model"].body(name).id for name in objects]
    geoms = torch.tensor([g for g in range(made["model"].ngeom) if made["model"].geom_bodyid[g] in body])
    spent, frames = 0.0, 0
    for demonstration, states in zip(held.demonstrations, made["states"], strict=True):
        camera.begin()
        for t, state in enumerate(states):
            begun = time.perf_counter()
            image = camera.shoot(state[None]).image[0].cpu()
            spent, frames = spent + time.perf_counter() - begun, frames + 1
            seen = camera._raw.render().segmentation[0].cpu()
            for c, name in enumerate(CAMERAS):
                real = torch.from_numpy(demonstration.image[name].rgb[t] / np.float32(255))
                there = torch.isin(seen[c], geoms)
                error = (image[c] - real).square().mean(dim=-1)
                local = float(error[there].mean()) if there.any() else float("nan")
                alike = ssim(*(i.permute(2, 0, 1)[None].float() for i in (image[c], real)), window_size=11)
                score[name].append((float(error.mean()), local, float(alike.mean())))
    found: dict[str, Any] = {"frames": frames, "seconds per frame": spent / frames}
    for name, rows in score.items():
        error, local, alike = np.nanmean(np.array(rows), axis=0)
        found[name] = {"psnr": -10 * np.log10(error), "psnr of objects": -10 * np.log10(local), "ssim": alike}
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("runs/render_gap"))
    parser.add_argument("--out", type=Path, default=Path("render_gap.jsonl"))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--full", action="store_true", help="networks of full size, for a GPU")
    parser.add_argument("--demonstrations", type=int, default=8, help="to train from, without objects")
    parser.add_argument("--photo", type=int, default=96, help="edge of the photographs of objects [px]")
    parser.add_argument("--iterations", type=int, default=600, help="of the fit of splats")
    parser.add_argument("--flow-steps", type=int, default=2)
    parser.add_argument("--seconds", type=float, help="time after which no measurement is begun [s]")
    arguments = parser.parse_args()
    kept = Measurements(arguments.out, seconds=arguments.seconds)
    folder = arguments.folder
    folder.mkdir(parents=True, exist_ok=True)
    footage(folder, "empty.h5", list(range(10, 10 + arguments.demonstrations)), objects=False, rate=10)
    held = footage(folder, "held.h5", [1, 2], objects=True, rate=5)
    networks = folder / ("networks_full" if arguments.full else "networks")
    if not (networks / "done").exists():
        options = (FULL if arguments.full else SMALL).split()
        options += ["--resume"] if (networks / "checkpoint.pt").exists() else ["--overwrite"]
        command = ["render-train", str(folder / "empty.h5"), "--out", str(networks), "--device", arguments.device]
        if concent([*command, *options]) != 0:
            raise SystemExit("the networks could not be trained")
        (networks / "done").touch()
    made = prepared(held, networks, {b: fitted_splats(folder, b, arguments) for b in ("block", "box")}, arguments)
    for name, wanted in VARIANTS.items():
        key = f"{'full' if arguments.full else 'small'}: {name}"
        if kept.wanted(key):
            row = compared(held, wanted, made, arguments.device)
            kept.add(key, row | {"machine": machine(arguments.device)})
    kept.close()


def prepared(held: Recording, networks: Path, splats: dict[str, Path], arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what all ways of rendering share."""
    import warp as wp
    from concent_warp.render.painter import Painter
    from concent_warp.render.pairs import drawn_scene
    from concent_warp.render.splats import Splats

    from concent_warp.diagnose.measured_motion import measured_motion
    from concent_warp.model import Model
    from concent_warp.scene.scene import Scene
    from concent_warp.simulate.mujoco_engine import MujocoEngine

    where = str(wp.device_to_torch(wp.get_device(arguments.device)))
    painter = Painter.load(networks, device=where, steps=arguments.flow_steps)
    scene = Scene(held.scene)
    model, states = Model(scene), []
    engine = MujocoEngine(model, threads=1)
    for demonstration in held.demonstrations:
        motion = measured_motion(model, demonstration, engine)
        time_ = np.clip(demonstration.image[CAMERAS[0]].time, *motion.span)
        states.append(motion.states(time_)[0])
    return {
        "painter": painter,
        "scene": scene,
        "model": drawn_scene(scene, list(painter.cameras.values())),
        "states": states,
        "splats": {name: Splats.read(path, device=where) for name, path in splats.items()},
    }


if __name__ == "__main__":
    main()
