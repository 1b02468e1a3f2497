"""Images of splats per second, by size, number of Gaussians and batch, against gsplat where it is installed.

    python -m benchmarks.render.rasteriser                         measure on the CPU; writes the data and the page
    python -m benchmarks.render.rasteriser --device cuda:0 --out F.jsonl           the same on a GPU, with gsplat
    python -m benchmarks.render.rasteriser --table                 the page from the stored data, without runs

The scene is a cube of 40 mm that fills half of the image's height, its faces covered evenly by flat Gaussians as wide
as the gaps between them, with harmonics of degree 3. Each image has its own camera. *images/s* is without gradients, on
CUDA from a recorded graph; *with gradients* is an image and the gradients of all parameters. Lists are twice as long as
needed. gsplat renders the same Gaussians from the same cameras with antialiasing, its Python calls included;
*difference* is the largest and the mean difference of the images, in units of full brightness. *error* is the largest
and the mean difference to a rasteriser in float64 without tiles and lists, in two 64 x 64 images; the largest are of
pixels where Gaussians of nearly equal depth are blended in the other order. On the shared CPU the fastest repetition
counts, on CUDA the median. Scenes with more overlap take longer; gsplat is faster with large batches.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from benchmarks.measurements import Measurements
from benchmarks.pages import FOLDER, ROOT, machine, machine_line, table, write_page
from concent_warp.render.splats.rasterise import Rasteriser, intrinsics_of
from concent_warp.render.splats.splats import Splats

NAME = "rasteriser"
DATA = FOLDER / "data" / f"{NAME}.jsonl"
EDGE, DISTANCE, FOVY = 0.04, 0.3, 15.0
CASES = {
    "cpu": [(64, 1000, 1), (64, 4000, 1), (64, 4000, 16), (128, 4000, 1), (256, 2000, 1), (256, 20000, 1)],
    "cuda": [
        (64, 4000, 64), (64, 4000, 256), (64, 4000, 1024), (64, 1000, 1024), (128, 4000, 256), (256, 20000, 16),
        (256, 20000, 64),
    ],
}  # fmt: skip
"""Pixels of an edge, Gaussians, images at once."""
REPETITIONS = {"cpu": 20, "cuda": 30}
LONGEST = 40.0
"""Time for one measurement of one kind [s]."""


def cube(count: int) -> Splats:
    """Return flat Gaussians on the faces of a cube."""
    rng = np.random.default_rng(0)
    means = rng.uniform(-0.5, 0.5, (count, 3))
    axis = rng.integers(0, 3, count)
    row = np.arange(count)
    means[row, axis] = rng.choice([-0.5, 0.5], count)
    scales = np.full((count, 3), EDGE * np.sqrt(6 / count) / 2)
    scales[row, axis] *= 0.1
    harmonics = rng.normal(size=(count, 16, 3)) * 0.05
    harmonics[:, 0] = rng.uniform(-1.5, 1.5, (count, 3))
    quats, opacities = np.tile([1.0, 0, 0, 0], (count, 1)), rng.uniform(0.5, 0.98, count)
    values = (EDGE * means, quats, scales, opacities, harmonics)
    return Splats(*(torch.tensor(v, dtype=torch.float32) for v in values))


def cameras(count: int) -> torch.Tensor:
    """Return poses all around the cube, shape (count, 1, 7)."""
    from scipy.spatial.transform import Rotation

    quats = np.random.default_rng(1).normal(size=(count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    places = Rotation.from_quat(quats, scalar_first=True).apply([0, 0, DISTANCE])
    poses = np.concatenate([places, quats], axis=1)
    return torch.tensor(poses, dtype=torch.float32)[:, None]


def seconds_of(call: Callable[[], object], device: str) -> float:
    """Return the time of a call [s]: the least on a CPU, which others use too, the median on CUDA."""
    for _ in range(2):
        call()
    times: list[float] = []
    begun = time.perf_counter()
    kind = torch.device(device).type
    for _ in range(REPETITIONS[kind]):
        if kind == "cuda":
            torch.cuda.synchronize()
            wp.synchronize_device(device)
        start = time.perf_counter()
        call()
        if kind == "cuda":
            torch.cuda.synchronize()
            wp.synchronize_device(device)
        times.append(time.perf_counter() - start)
        if time.perf_counter() - begun > LONGEST:
            break
    return float(min(times) if kind == "cpu" else np.median(times))


def measure(size: int, count: int, batch: int, device: str, tile: int | None = None) -> dict[str, Any]:
    splats, poses, matrix = cube(count), cameras(batch).to(device), intrinsics_of(FOVY, size, size, device)
    still = torch.tensor([0.0, 0, 0, 1, 0, 0, 0], device=device).expand(batch, 1, 7)
    rasteriser = Rasteriser([splats], size, size, batch, 1, device=device, tile=tile, gradient=True)
    layer = rasteriser.render(still, poses, matrix)
    rasteriser.check_room()
    row: dict[str, Any] = {
        "size": size, "count": count, "batch": batch, "device": device,
        "pairs": float(rasteriser.pairs.float().mean()), "covered": float((layer.alpha > 0.5).float().mean()),
    }  # fmt: skip
    images = layer.rgb[:, 0].clone()
    if torch.device(device).type == "cuda":
        with wp.ScopedCapture(device=device) as capture:
            rasteriser.plan.launch()
        graph = capture.graph
        assert graph is not None
        row["seconds"] = seconds_of(lambda: wp.capture_launch(graph), device)
    else:
        row["seconds"] = seconds_of(rasteriser.launch, device)
    plan = rasteriser.plan
    to_rgb, to_alpha = (wp.full(a.shape, 1.0, dtype=a.dtype, device=a.device) for a in (plan.rgb, plan.alpha))
    to_depth = wp.zeros_like(plan.depth)

    def both() -> None:
        plan.launch()
        plan.backward(to_rgb, to_alpha, to_depth)

    row["seconds_gradient"] = seconds_of(both, device)
    if size == 64:
        row["error"], row["error_mean"] = error(splats, poses[:2].cpu(), matrix.cpu(), images[:2].cpu())
    if torch.device(device).type == "cuda":
        row |= against_gsplat(splats.to(device), poses, matrix, images, device)
    return row


def error(splats: Splats, poses: torch.Tensor, matrix: torch.Tensor, images: torch.Tensor) -> tuple[float, float]:
    """Return the largest and the mean difference of images to those in float64."""
    path = ROOT / "tests" / "kernels" / "splat_reference.py"
    spec = importlib.util.spec_from_file_location("splat_reference", path)
    assert spec is not None
    assert spec.loader is not None
    reference = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(reference)
    size = images.shape[1]
    values = [*(t.double().numpy() for t in splats.tensors()), np.zeros(len(splats), dtype=int)]
    pinhole = matrix.double().numpy()[[0, 1, 0, 1], [0, 1, 2, 2]]
    still = np.array([[0.0, 0, 0, 1, 0, 0, 0]])
    expected = [reference.render(values, still, pose[0], pinhole, size, size)[0] for pose in poses.double().numpy()]
    off = np.abs(np.stack(expected) - images.double().numpy())
    return float(off.max()), float(off.mean())


def against_gsplat(
    splats: Splats, poses: torch.Tensor, matrix: torch.Tensor, images: torch.Tensor, device: str
) -> dict[str, Any]:
    """Return times of gsplat and the difference of its images, or why there are none."""
    from scipy.spatial.transform import Rotation

    batch, size = len(poses), images.shape[1]
    world = np.tile(np.eye(4), (batch, 1, 1))
    quaternions = poses[:, 0, 3:].cpu().numpy()
    world[:, :3, :3] = Rotation.from_quat(quaternions, scalar_first=True).as_matrix() @ np.diag([1.0, -1, -1])
    world[:, :3, 3] = poses[:, 0, :3].cpu().numpy()
    views = torch.tensor(np.linalg.inv(world), dtype=torch.float32, device=device)
    # Its pixel coordinates count from the corner of the image.
    pinholes = (matrix + torch.tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], device=device)).expand(batch, 3, 3)
    tensors = [tensor.clone().requires_grad_() for tensor in splats.tensors()]

    def render() -> torch.Tensor:
        return rasterization(
            *tensors, views, pinholes.contiguous(), size, size, sh_degree=3, packed=False, rasterize_mode="antialiased"
        )[0]

    def alone() -> torch.Tensor:
        with torch.no_grad():
            return render()

    def both() -> None:
        render().sum().backward()

    # Not there, or its extension cannot be built: nothing of ours depends on it, and why goes into the row.
    row: dict[str, Any] = {}
    try:
        from gsplat import rasterization  # pyright: ignore[reportMissingImports]

        off = (alone() - images).abs()
        row |= {"difference": float(off.max()), "difference_mean": float(off.mean())}
        row["gsplat"] = seconds_of(alone, device)
        row["gsplat_gradient"] = seconds_of(both, device)
    except Exception as error:
        row["gsplat_missing"] = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
    return row


def write(rows: dict[str, dict[str, Any]]) -> None:
    head = (
        "pixels", "Gaussians", "batch", "pairs an image", "ms an image", "images/s", "with gradients", "error",
        "gsplat, images/s", "with gradients", "difference",
    )  # fmt: skip
    parts = [
        "# Images of splats per second\n\nWritten by `benchmarks/render/rasteriser.py`; do not edit.\n",
        *(f"{part}\n" for part in (__doc__ or "").split("\n\n")[2:]),
    ]
    for name in dict.fromkeys(row["machine_name"] for row in rows.values()):
        of_machine = [row for row in rows.values() if row["machine_name"] == name]
        parts += [f"## {name}\n", machine_line(of_machine[-1]["machine"]) + "\n"]
        lines = []
        for row in of_machine:
            rate = row["batch"] / row["seconds"]
            lines.append(
                (
                    f"{row['size']} x {row['size']}", f"{row['count']:,}", f"{row['batch']:,}", f"{row['pairs']:,.0f}",
                    f"{1e3 / rate:.3g}", f"{rate:,.0f}", f"{row['batch'] / row['seconds_gradient']:,.0f}",
                    f"{row['error']:.0e}, {row['error_mean']:.0e}" if "error" in row else "",
                    f"{row['batch'] / row['gsplat']:,.0f}" if "gsplat" in row else "",
                    f"{row['batch'] / row['gsplat_gradient']:,.0f}" if "gsplat_gradient" in row else "",
                    f"{row['difference']:.0e}, {row['difference_mean']:.0e}" if "difference_mean" in row else "",
                )
            )  # fmt: skip
        parts.append(table(head, lines))
    write_page(NAME, "\n".join(parts))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", help="cpu or cuda:0")
    parser.add_argument("--machine", default=None, help="name of the machine on the page")
    parser.add_argument("--tile", type=int, default=None, help="edge of a tile [px]; the device's own by default")
    parser.add_argument("--out", type=Path, default=DATA, help="file of JSON lines")
    parser.add_argument("--seconds", type=float, default=None, help="time after which no measurement is begun [s]")
    parser.add_argument("--table", action="store_true", help="write the page from the stored data")
    arguments = parser.parse_args()
    kept = Measurements(arguments.out, seconds=arguments.seconds)
    if not arguments.table:
        facts = machine(arguments.device)
        name = arguments.machine or facts.get("device", facts["processor"])
        for case in CASES[torch.device(arguments.device).type]:
            key = f"{name} {case}" + (f" tile {arguments.tile}" if arguments.tile else "")
            if kept.wanted(key):
                row = measure(*case, arguments.device, arguments.tile)
                kept.add(key, {**row, "machine_name": name, "machine": facts})
        kept.close()
    if arguments.out == DATA:
        write(kept.rows)


if __name__ == "__main__":
    main()
