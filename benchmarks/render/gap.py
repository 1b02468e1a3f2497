"""How far hybrid images are from the camera's, and what each layer does for that, in Reality.

    python -m benchmarks.render.gap --out render_gap.jsonl                     # small networks, on a CPU
    python -m benchmarks.render.gap --full --device cuda:0 --train-seconds 540 --out render_gap.jsonl

Reality's cameras take the place of real ones: other textures, lights, shadows and noise than the simulation's image. It
is filmed without objects to train the networks, and with them on trajectories that training never saw; the objects are
photographed under Reality's lights to fit their splats. What is made is kept in --folder and not made again; a
training that was cut short goes on. The folder may be a packed one (render_footage.py). A line of JSON for each way of
rendering is appended to --out, those without networks before these are trained.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.measurements import Measurements
from benchmarks.pages import machine
from benchmarks.render.feature_distance import feature_distance
from benchmarks.render.footage import CAMERAS, EMPTY, HELD, OBJECTS, footage, photographed
from concent_warp.cli.entry import main as concent
from concent_warp.reality.sensors.photographs import PhotographsCfg
from concent_warp.recording.recording import Recording
from concent_warp.render.networks.cfg import FlowNetworkCfg, NetworkTrainCfg, RenderTrainCfg, SuperResolutionCfg

if TYPE_CHECKING:
    from concent_warp.render.networks.pairs import ImagePairs

QUICK = NetworkTrainCfg(steps=900, batch=8, learning_rate=1.5e-3, warm_up=20, ema=0.99)
SMALL = RenderTrainCfg(
    flow=QUICK,
    enlarge=replace(QUICK, steps=400, learning_rate=1e-3),
    network=FlowNetworkCfg(width=16),
    super_resolution=SuperResolutionCfg(width=32, blocks=4),
    half=True,
)
"""Networks that a CPU trains in a quarter of an hour."""
FULL = RenderTrainCfg(flow=NetworkTrainCfg(steps=12_000), enlarge=NetworkTrainCfg(steps=6_000, batch=16), half=True)
ENLARGING = 0.15
"""Share of the time of training that super-resolution gets."""
VARIANTS: dict[str, dict[str, bool]] = {
    "raw simulation": {},
    "splats": {"splats": True},
    "flow": {"painter": True},
    "flow and splats": {"painter": True, "splats": True},
    "flow, splats and shadows": {"painter": True, "splats": True, "shadows": True},
}


def fitted_splats(folder: Path, body: str, arguments: argparse.Namespace) -> Path:
    """Return the splats of an object, fitted to photographs under Reality's lights."""
    path = folder / f"splats_{body}" / "splats.ply"
    if not path.exists():
        photos = photographed(folder, body, PhotographsCfg(size=arguments.photo))
        command = ["splat-fit", str(photos), "--out", str(path.parent), "--device", arguments.device]
        if concent([*command, "--overwrite", "--fit.iterations", str(arguments.iterations)]) != 0:
            raise SystemExit("the splats could not be fitted")
    return path


def trained(folder: Path, networks: Path, arguments: argparse.Namespace) -> None:
    """Train the networks of the footage without objects into a folder, or go on with that."""
    import warp as wp

    from concent_warp.render.networks.pairs import pairs_of
    from concent_warp.render.networks.train import CHECKPOINT, RenderTraining

    where = str(wp.device_to_torch(wp.get_device(arguments.device)))
    pairs = pairs_of(footage(folder, EMPTY, arguments.demonstrations), CAMERAS, device=arguments.device)
    networks.mkdir(exist_ok=True)
    cfg, chosen = FULL if arguments.full else SMALL, networks / "steps.json"
    if arguments.train_seconds is not None:
        if not chosen.exists():
            chosen.write_text(json.dumps(steps_within(arguments.train_seconds, cfg, pairs, where)))
        flow, enlarge = json.loads(chosen.read_text())
        cfg = replace(cfg, flow=replace(cfg.flow, steps=flow), enlarge=replace(cfg.enlarge, steps=enlarge))
    training = RenderTraining(pairs, replace(cfg, checkpoint=20.0), networks, device=where)
    if (networks / CHECKPOINT).exists():
        training.resume()
    begun = time.perf_counter()

    def show(name: str, loss: float) -> None:
        done = training.trainings[name]
        if done.done % 500 == 0 or done.done == done.cfg.steps:
            print(f"[{time.perf_counter() - begun:.0f} s] {name}: {done.done} steps, loss {loss:.4f}", flush=True)

    training.learn(show)
    spent = {"seconds": time.perf_counter() - begun, "flow": cfg.flow.steps, "enlarge": cfg.enlarge.steps}
    (networks / "done").write_text(json.dumps(spent))


def steps_within(seconds: float, cfg: RenderTrainCfg, pairs: Sequence[ImagePairs], device: str) -> tuple[int, int]:
    """Return the steps of flow and super-resolution that a time [s] allows, at most those of the settings."""
    import torch

    from concent_warp.render.networks.train import ENLARGE, RenderTraining

    trial = RenderTraining(pairs, cfg, device=device)
    took: dict[str, float] = {}
    for name, training in trial.trainings.items():
        training.network.train()
        for k in range(20):
            if k == 8:
                _ = float(next(training.network.parameters()).detach().sum())  # waits for the device
                took[name] = -time.perf_counter()
            with torch.autocast(trial.device.type, torch.bfloat16, enabled=cfg.half):
                loss = trial.loss(name)
            training.step(loss)
        _ = float(next(training.network.parameters()).detach().sum())
        took[name] = (took[name] + time.perf_counter()) / 12
    painting = sum(value for name, value in took.items() if name != ENLARGE)
    flow = min(cfg.flow.steps, max(20, int((1 - ENLARGING) * seconds / painting)))
    enlarge = min(cfg.enlarge.steps, max(20, int(ENLARGING * seconds / took[ENLARGE])))
    print(f"seconds a step: {took}; steps: {flow} and {enlarge}", flush=True)
    return flow, enlarge


def compared(
    held: Recording, wanted: dict[str, bool], made: dict[str, Any], arguments: argparse.Namespace
) -> dict[str, Any]:
    """Return PSNR [dB], SSIM, distance of features and time of one way of rendering, over all held-out frames."""
    import torch
    import warp as wp
    from kornia.metrics import ssim

    from concent_warp.render.composite import HybridCamera
    from concent_warp.render.figure import FrameSelection, decomposition
    from concent_warp.render.shadow_cfg import ShadowCfg

    where = str(wp.device_to_torch(wp.get_device(arguments.device)))
    features = feature_distance(arguments.features, where)
    score: dict[str, list[tuple[float, float, float, float]]] = {name: [] for name in CAMERAS}
    objects = made["scene"].objects()
    camera = HybridCamera(
        made["model"], CAMERAS, (256, 256), 1, objects=objects, device=arguments.device,
        splats=made["splats"] if wanted.get("splats") else None,
        painter=made["painter"] if wanted.get("painter") else None,
        shadows=ShadowCfg() if wanted.get("shadows") else None,
    )  # fmt: skip
    body = [made["model"].body(name).id for name in objects]
    geoms = torch.tensor([g for g in range(made["model"].ngeom) if made["model"].geom_bodyid[g] in body])
    spent, frames, album = 0.0, 0, FrameSelection()
    for demonstration, states in zip(held.demonstrations, made["states"], strict=True):
        camera.begin()
        for t, state in enumerate(states):
            begun = time.perf_counter()
            layers = camera.shoot(state[None])
            image = layers.image[0].cpu()
            spent, frames = spent + time.perf_counter() - begun, frames + 1
            if wanted.get("shadows") and arguments.picture is not None:
                album.add(layers)
            seen = camera._raw.render().segmentation[0].cpu()
            for c, name in enumerate(CAMERAS):
                real = torch.from_numpy(demonstration.image[name].rgb[t] / np.float32(255))
                there = torch.isin(seen[c], geoms)
                error = (image[c] - real).square().mean(dim=-1)
                local = float(error[there].mean()) if there.any() else float("nan")
                both = [i.permute(2, 0, 1)[None].float() for i in (image[c], real)]
                alike = float(ssim(*both, window_size=11).mean())
                apart = 0.0 if features is None else float(features(*(i.to(where) for i in both)))
                score[name].append((float(error.mean()), local, alike, apart))
    if len(album) and arguments.picture is not None:
        decomposition(album.chosen(), CAMERAS, arguments.picture)
    found: dict[str, Any] = {"frames": frames, "seconds per frame": spent / frames}
    for name, rows in score.items():
        error, local, alike, apart = np.nanmean(np.array(rows), axis=0)
        found[name] = {"psnr": -10 * np.log10(error), "psnr of objects": -10 * np.log10(local), "ssim": alike}
        found[name] |= {} if features is None else {"features": apart}
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
    parser.add_argument("--features", type=Path, help="weights for the distance of features (feature_distance.py)")
    parser.add_argument("--picture", type=Path, help="figure of the layers to write")
    parser.add_argument("--train-seconds", type=float, help="take as many steps of training as this allows [s]")
    parser.add_argument("--seconds", type=float, help="time after which no measurement is begun [s]")
    arguments = parser.parse_args()
    kept = Measurements(arguments.out, seconds=arguments.seconds)
    folder = arguments.folder
    folder.mkdir(parents=True, exist_ok=True)
    held = footage(folder, HELD)
    networks = folder / ("networks_full" if arguments.full else "networks")
    made = prepared(held, {body: fitted_splats(folder, body, arguments) for body in OBJECTS}, arguments)
    for name, wanted in VARIANTS.items():
        key = f"{'full' if arguments.full else 'small'}: {name}"
        if not kept.wanted(key):
            continue
        row: dict[str, Any] = {}
        if wanted.get("painter"):
            if not (networks / "done").exists():
                trained(folder, networks, arguments)
            row = {"training": json.loads((networks / "done").read_text()), "flow steps": arguments.flow_steps}
            made["painter"] = made.get("painter") or painter(networks, arguments)
        row |= compared(held, wanted, made, arguments)
        kept.add(key, row | {"machine": machine(arguments.device)})
    kept.close()


def painter(networks: Path, arguments: argparse.Namespace) -> Any:
    """Return the trained networks."""
    import warp as wp

    from concent_warp.render.networks.painter import Painter

    where = str(wp.device_to_torch(wp.get_device(arguments.device)))
    return Painter.load(networks, device=where, steps=arguments.flow_steps)


def prepared(held: Recording, splats: dict[str, Path], arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what all ways of rendering share."""
    import warp as wp

    from concent_warp.estimation.state_estimator import StateEstimator, StateEstimatorCfg
    from concent_warp.model import Model
    from concent_warp.render.cameras import Camera
    from concent_warp.render.networks.pairs import camera_scene
    from concent_warp.render.splats.splats import Splats
    from concent_warp.scene.scene import Scene
    from concent_warp.simulate.mujoco_engine import MujocoEngine

    where = str(wp.device_to_torch(wp.get_device(arguments.device)))
    scene = Scene(held.scene)
    model, states = Model(scene), []
    engine = MujocoEngine(model, threads=1)
    for demonstration in held.demonstrations:
        motion = StateEstimator.of(model, demonstration, StateEstimatorCfg("smoothing_spline"), engine=engine)
        time_ = np.clip(demonstration.image[CAMERAS[0]].time, *motion.span)
        states.append(motion.states(time_).qpos)
    cameras = [Camera.of(name, held.demonstrations[0].image[name]) for name in CAMERAS]
    return {
        "scene": scene,
        "model": camera_scene(scene, cameras),
        "states": states,
        "splats": {name: Splats.read(path, device=where) for name, path in splats.items()},
    }


if __name__ == "__main__":
    main()
