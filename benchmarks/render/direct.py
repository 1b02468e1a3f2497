"""What painting at 64 x 64 and enlarging costs in quality, and saves in time, against painting at 256 x 256 at once.

    python -m benchmarks.render.direct --width 8 --train-seconds 60 --out F.jsonl          a CPU, to try it
    python -m benchmarks.render.direct --device cuda:0 --train-seconds 240 --out F.jsonl   on a GPU

Both ways learn from the same frames of one camera for the same time, with U-Nets of the same channels, and then paint
the held-out trajectories one frame after the other, with few and more steps of the flow. Objects are not painted: the
pixels where the simulation sees them do not count. Times are of images painted together, without reading anything
back. A line of JSON for each way and number of steps is appended to --out; each way's follow its training.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import warp as wp

from benchmarks.measurements import Measurements
from benchmarks.pages import machine
from benchmarks.render.feature_distance import FeatureDistance, feature_distance
from benchmarks.render.footage import EMPTY, HELD, footage
from concent_warp.recording.recording import Recording
from concent_warp.render.networks.cfg import FlowNetworkCfg, NetworkTrainCfg, RenderTrainCfg
from concent_warp.render.networks.flow import sample_images
from concent_warp.render.networks.flow_network import FlowNetwork
from concent_warp.render.networks.pairs import ImagePairs, camera_scene, pairs_of, to_signed
from concent_warp.render.networks.train import ENLARGE, NetworkTraining, RenderTraining, network_of
from concent_warp.render.raw import PosedWorlds, RawCamera
from concent_warp.scene.scene import Scene

SMALL, WHOLE = "64 and enlarged", "256 at once"
FLOW_STEPS = (1, 2, 4)
SHARE = 0.8
"""Of the time of training that the flow gets where super-resolution is trained too."""
Draw = Callable[[torch.Tensor, torch.Tensor, torch.Tensor | None, int], tuple[torch.Tensor, torch.Tensor]]
"""Takes simulated image, previous one, pose and steps of the flow; returns the image and what is the next previous."""


class WholeTraining(RenderTraining):
    """The flow of one camera at the size of its images, with nothing to enlarge."""

    def __init__(self, pairs: ImagePairs, cfg: RenderTrainCfg, device: str) -> None:
        """Make the network."""
        self.cfg, self.folder, self.device = cfg, None, torch.device(device)
        torch.manual_seed(cfg.seed)
        self.generator = torch.Generator(self.device).manual_seed(cfg.seed)
        self.pairs = self.small = [pairs.to(self.device)]
        real = self.small[0].real
        total = torch.stack([to_signed(part).sum(dim=0) for part in real.split(64)]).sum(dim=0)
        self.reference = [total / len(real)]
        network = FlowNetwork(network_of(cfg.network, pairs.camera))
        self.trainings = {pairs.camera.name: NetworkTraining(self._placed(network), cfg.flow)}


def learn(training: RenderTraining, name: str, seconds: float) -> dict[str, float]:
    """Train a network for a time [s], its rate falling as the time goes by."""
    one, device = training.trainings[name], training.device
    one.network.train()
    begun, limit = time.perf_counter(), one.cfg.steps
    value = math.nan
    every = 20 if device.type == "cuda" else 1
    while one.done < limit:
        with torch.autocast(device.type, torch.bfloat16, enabled=training.cfg.half):
            loss = training.loss(name)
        one.step(loss)
        if one.done % every == 0 or one.done >= limit:
            value = float(loss.detach())  # waits for the device
            spent = time.perf_counter() - begun
            if spent > seconds:
                break
            # So many steps it will be, at this pace; the rate falls along them.
            one.cfg = replace(one.cfg, steps=min(limit, max(one.done + 1, int(one.done * seconds / spent))))
    print(f"{name}: {one.done} steps in {time.perf_counter() - begun:.0f} s, loss {value:.4f}", flush=True)
    return {"steps": one.done, "seconds": time.perf_counter() - begun, "loss": value}


def painting(training: RenderTraining, camera: str) -> Draw:
    """Return how the running means of the weights paint."""
    networks = {name: one.mean.module.eval() for name, one in training.trainings.items()}
    enlarge = networks.get(ENLARGE)
    generator = torch.Generator(training.device).manual_seed(0)

    @torch.no_grad()
    def paint(
        seen: torch.Tensor, previous: torch.Tensor, pose: torch.Tensor | None, steps: int
    ) -> tuple[torch.Tensor, torch.Tensor]:
        with torch.autocast(training.device.type, torch.bfloat16, enabled=training.cfg.half):
            drawn = sample_images(networks[camera], seen, previous, pose, steps=steps, generator=generator)
            image = drawn if enlarge is None else enlarge(drawn)
        return ((image.float() + 1) / 2).clamp(0, 1), drawn

    return paint


def judged(
    paint: Draw,
    held: ImagePairs,
    reference: torch.Tensor,
    there: torch.Tensor,
    steps: int,
    features: FeatureDistance | None,
) -> dict[str, float]:
    """Return PSNR [dB], SSIM and distance of features of frames that are painted one after the other.

    Args:
        paint: How.
        held: Frames at the size that is painted, but `real` at that of the camera.
        reference: The first previous image, shape (3, S, S).
        there: Where objects are, which do not count, shape (N, H, W).
        steps: Steps of the flow.
        features: The distance, None where there is none.
    """
    from kornia.metrics import ssim

    rows, previous = [], reference[None]
    for k in range(len(held)):
        if int(held.before[k]) < 0:
            previous = reference[None]
        pose = held.pose[k : k + 1] if held.camera.moves else None
        image, previous = paint(to_signed(held.simulated[k : k + 1]), previous, pose, steps)
        real = held.real[k : k + 1].float() / 255
        image = torch.where(there[k], real, image)
        error = (image - real).square().mean(dim=1)[0][~there[k]].mean()
        apart = torch.zeros(1) if features is None else features(image, real)
        rows.append((float(error), float(ssim(image, real, window_size=11).mean()), float(apart[0])))
    error, alike, apart = torch.tensor(rows, dtype=torch.float64).mean(dim=0).tolist()
    found = {"psnr": -10 * float(torch.log10(torch.tensor(error))), "ssim": alike}
    return found if features is None else {**found, "features": apart}


def seconds_of(paint: Draw, held: ImagePairs, reference: torch.Tensor, steps: int, batch: int) -> float:
    """Return the time of one of a batch of images [s], the least of five."""
    rows = torch.arange(batch, device=held.real.device) % len(held)
    seen = to_signed(held.simulated[rows])
    pose = held.pose[rows] if held.camera.moves else None
    before = reference.expand(batch, -1, -1, -1)
    times = []
    for _ in range(5):
        _ = float(seen.sum())
        begun = time.perf_counter()
        _ = float(paint(seen, before, pose, steps)[0].sum())
        times.append(time.perf_counter() - begun)
    return min(times[1:]) / batch


def objects_seen(held: ImagePairs, recording: Recording, device: str) -> torch.Tensor:
    """Return where the simulation sees objects, and a few pixels around, shape (N, H, W) bool."""
    from concent_warp.estimation.state_estimator import StateEstimator, StateEstimatorCfg
    from concent_warp.model import Model
    from concent_warp.simulate.mujoco_engine import MujocoEngine

    scene = Scene(recording.scene)
    model = camera_scene(scene, [held.camera])
    stage = PosedWorlds(model, 1, device=device)
    eye = RawCamera(stage, [held.camera.name], (held.real.shape[2], held.real.shape[3]))
    bodies = [model.body(name).id for name in scene.objects()]
    geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] in bodies]
    engine, found = MujocoEngine(Model(scene), threads=1), []
    for demonstration in recording.demonstrations:
        motion = StateEstimator.of(Model(scene), demonstration, StateEstimatorCfg("smoothing_spline"), engine=engine)
        for state in motion.states(demonstration.image[held.camera.name].time.clip(*motion.span)).qpos:
            stage.place(state[None])
            seen = eye.render().segmentation[0, 0]
            there = torch.isin(seen, torch.tensor(geoms, device=seen.device, dtype=seen.dtype)).float()
            found.append(torch.nn.functional.max_pool2d(there[None, None], 7, 1, 3)[0, 0] > 0)
    return torch.stack(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("runs/render_gap"))
    parser.add_argument("--out", type=Path, default=Path("render_direct.jsonl"))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--camera", default="base")
    parser.add_argument("--demonstrations", type=int, default=8, help="to train from")
    parser.add_argument("--train-seconds", type=float, default=240.0, help="time of training of each way [s]")
    parser.add_argument("--width", type=int, default=64, help="channels of the flow's first level")
    parser.add_argument("--batch", type=int, default=16, help="images of a step at 256 x 256, half of those at 64")
    parser.add_argument("--images", type=int, default=64, help="images that are painted together for the times")
    parser.add_argument("--features", type=Path, help="weights for the distance of features (feature_distance.py)")
    parser.add_argument("--seconds", type=float, help="time after which no measurement is begun [s]")
    arguments = parser.parse_args()
    kept = Measurements(arguments.out, seconds=arguments.seconds)
    device = str(wp.device_to_torch(wp.get_device(arguments.device)))
    features = feature_distance(arguments.features, device)
    recording = footage(arguments.folder, HELD)
    held = pairs_of(recording, [arguments.camera], device=arguments.device)[0].to(device)
    there = objects_seen(held, recording, arguments.device)
    pairs = pairs_of(
        footage(arguments.folder, EMPTY, arguments.demonstrations), [arguments.camera], device=arguments.device
    )
    flow = NetworkTrainCfg(steps=100_000, warm_up=100, ema=0.995)  # a mean that short trainings can follow
    cfg = RenderTrainCfg(
        flow=replace(flow, batch=2 * arguments.batch),
        enlarge=replace(flow, batch=arguments.batch),
        network=FlowNetworkCfg(width=arguments.width),
        half=device != "cpu",
    )
    for way in (SMALL, WHOLE):
        keys = {steps: f"{arguments.camera}, width {arguments.width}: {way}, {steps} steps" for steps in FLOW_STEPS}
        missing = [key for key in keys.values() if kept.wanted(key, 1.2 * arguments.train_seconds)]
        if not missing:
            continue
        if way == SMALL:
            training: RenderTraining = RenderTraining(pairs, cfg, device=device)
            shares = {arguments.camera: SHARE, ENLARGE: 1 - SHARE}
        else:
            size = replace(cfg.network, size=held.real.shape[2])
            training = WholeTraining(
                pairs[0], replace(cfg, network=size, flow=replace(flow, batch=arguments.batch)), device
            )
            shares = {arguments.camera: 1.0}
        spent = {name: learn(training, name, share * arguments.train_seconds) for name, share in shares.items()}
        reference = training.reference[0]
        assert reference is not None
        seen = held if way == WHOLE else replace(held, simulated=reduced_bytes(held.simulated, cfg.network.size))
        paint = painting(training, arguments.camera)
        for steps, key in keys.items():
            row: dict[str, Any] = {"way": way, "flow steps": steps, "training": spent}
            row |= judged(paint, seen, reference, there, steps, features)
            row["seconds an image"] = seconds_of(paint, seen, reference, steps, arguments.images)
            kept.add(key, row | {"images": arguments.images, "machine": machine(arguments.device)})
    kept.close()


def reduced_bytes(images: torch.Tensor, size: int) -> torch.Tensor:
    """Return uint8 images (N, 3, H, W) at the size that is painted, as the networks are trained with."""
    from concent_warp.render.networks.super_resolution import downsampled

    return downsampled(images.float(), size).round().clamp(0, 255).to(torch.uint8)


if __name__ == "__main__":
    main()
