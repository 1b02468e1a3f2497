"""Speed and precision of the Chamfer kernels.

    python -m benchmarks.kernels.chamfer --device cpu --out DIR             against SciPy's k-d tree, single thread
    python -m benchmarks.kernels.chamfer --device cuda --sweep --out DIR  all tilings, and torch.cdist and torch.compile
    python -m benchmarks.kernels.chamfer --table FILE.json ...  writes docs/benchmarks/chamfer.md from results

A pair is a point of one set with one of the other, counted once though both directions are computed:
pairs/s = worlds * n * m / time. Kernels are compiled before, inputs are in the device's memory; sets are independent
uniform points in a cube of 0.3 m edge. Several copies of the inputs alternate so that caches do not hold them. The
figures leave out the preparation of point sets.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import subprocess
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from scipy.spatial import KDTree

from concent_warp.kernels.chamfer.distance import ChamferPlan, chamfer
from concent_warp.kernels.chamfer.distance_cuda import Tiling

PAGE = Path(__file__).parents[2] / "docs/benchmarks/chamfer.md"
TILINGS = [
    Tiling(16, 4, blocks=4),
    Tiling(16, 4),
    Tiling(16, 4, blocks=5),
    Tiling(16, 4, unroll=2, blocks=4),
    Tiling(16, 2, blocks=8),
    Tiling(16, 8, blocks=2),
    Tiling(32, 4),
    Tiling(32, 2, blocks=4),
    Tiling(8, 4),
    Tiling(8, 8),
    Tiling(8, 4, unroll=2),
    Tiling(4, 4),
    Tiling(16, 4, expanded=True, blocks=4),
]
OTHER_SIZES = [
    (4096, 128, 128),
    (4096, 256, 256),
    (4096, 512, 128),
    (4096, 600, 300),
    (1024, 1024, 1024),
    (256, 2000, 2000),
]
COPIES = 6

Row = dict[str, Any]


def cube(worlds: int, count: int, device: str) -> torch.Tensor:
    """Uniform points in a cube of 0.3 m edge, shape (worlds, count, 3)."""
    return 0.3 * torch.rand((worlds, count, 3), device=device)


def plan_of(a: torch.Tensor, b: torch.Tensor, **options: Any) -> ChamferPlan:
    return ChamferPlan(wp.from_torch(a, dtype=wp.vec3), wp.from_torch(b, dtype=wp.vec3), **options)


def time_captured(record: Callable[[], None], device: str, repeats: int) -> list[float]:
    """Times of replays of what `record` launches [ms]."""
    wp.synchronize()
    with wp.ScopedDevice(device) as scope:
        record()
        with wp.ScopedCapture() as capture:
            record()
        graph = capture.graph
        assert graph is not None
        times = []
        for k in range(repeats + 3):
            if scope.is_cuda:
                start, end = (wp.Event(enable_timing=True) for _ in range(2))
                wp.record_event(start)
                wp.capture_launch(graph)
                wp.record_event(end)
                elapsed = wp.get_event_elapsed_time(start, end)
            else:
                begin = time.perf_counter()
                wp.capture_launch(graph)
                elapsed = 1e3 * (time.perf_counter() - begin)
            if k >= 3:
                times.append(elapsed)
    return times


def time_called(call: Callable[[int], object], device: str, repeats: int) -> list[float]:
    """Times of calls [ms], on a CPU of this process alone; the call gets its number, to choose its inputs."""
    times = []
    for k in range(repeats + 2):
        if device == "cuda":
            start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            start.record()
            call(k)
            end.record()
            end.synchronize()
            elapsed = start.elapsed_time(end)
        else:
            begin = time.process_time()
            call(k)
            elapsed = 1e3 * (time.process_time() - begin)
        if k >= 2:
            times.append(elapsed)
    return times


def row(name: str, worlds: int, n: int, m: int, times: list[float], launches: int = 1, **more: Any) -> Row:
    """A result: median, 10th and 90th percentile of the time of one launch [ms], and the rate [10^9 pairs/s]."""
    low, middle, high = np.percentile(np.array(times) / launches, (10, 50, 90))
    rate = worlds * n * m / middle * 1e-6
    print(f"{name:44s} {worlds:5d} x {n:4d} x {m:4d} {middle:9.3f} ms {rate:9.1f} G pairs/s", flush=True)
    sizes = {"name": name, "worlds": worlds, "n": n, "m": m}
    return sizes | {"ms": middle, "ms_low": low, "ms_high": high, "rate": rate} | more


def attempt(rows: list[Row], name: str, measure: Callable[[], Row]) -> None:
    """Add a row, or say why there is none: one variant that does not run must not cost the others."""
    try:
        rows.append(measure())
    except Exception as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        print(f"{name:44s} did not run: {reason}", flush=True)
        rows.append({"name": name, "failed": reason})


def exact_parts(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Directional means in float64 by all differences, shape (2, worlds)."""
    a, b = a.double(), b.double()
    parts = []
    for x, y in zip(a, b, strict=True):
        d = (x[:, None] - y).norm(dim=-1)
        parts.append(torch.stack((d.amin(1).mean(), d.amin(0).mean())))
    return torch.stack(parts, 1)


def relative_error(a_to_b: torch.Tensor, b_to_a: torch.Tensor, a: torch.Tensor, b: torch.Tensor) -> float:
    """Largest relative error of a directional mean over the first eight pairs."""
    expected = exact_parts(a[:8], b[:8])
    found = torch.stack((a_to_b[:8], b_to_a[:8])).double()
    return float(((found - expected).abs() / expected).max())


def by_cdist(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    d = torch.cdist(a, b)
    return d.amin(2).mean(1) + d.amin(1).mean(1)


def by_differences(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    x, y = a[:, :, None], b[:, None]
    d = (x[..., 0] - y[..., 0]) ** 2 + (x[..., 1] - y[..., 1]) ** 2 + (x[..., 2] - y[..., 2]) ** 2
    return d.amin(2).sqrt().mean(1) + d.amin(1).sqrt().mean(1)


def sweep(device: str, worlds: int, size: int, repeats: int) -> dict[str, list[Row]]:
    """All tilings at one size, rivals at that size, other sizes with the default, and precision."""
    torch.manual_seed(0)
    inputs = [(cube(worlds, size, device), cube(worlds, size, device)) for _ in range(COPIES)]
    shape = (worlds, size, size)

    def with_tiling(name: str, tiling: Tiling | None) -> Row:
        begin = time.perf_counter()
        plans = [plan_of(a, b, tiling=tiling) for a, b in inputs]
        built = time.perf_counter() - begin
        times = time_captured(lambda: [plan.launch() for plan in plans], device, repeats)  # pyright: ignore
        means = (wp.to_torch(plans[-1].a_to_b), wp.to_torch(plans[-1].b_to_a))
        return row(name, *shape, times, COPIES, error=relative_error(*means, *inputs[-1]), build_s=built)

    tilings: list[Row] = []
    attempt(tilings, "default", lambda: with_tiling("default", None))
    for tiling in TILINGS:
        attempt(tilings, tiling.name, lambda tiling=tiling: with_tiling(tiling.name, tiling))

    rivals: list[Row] = []

    def with_torch(name: str, call: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]) -> Row:
        times = time_called(lambda k: call(*inputs[k % COPIES]), device, max(3, repeats // 4))
        expected = exact_parts(inputs[0][0][:8], inputs[0][1][:8]).sum(0)
        found = call(*inputs[0])[:8].double()
        return row(name, *shape, times, error=float(((found - expected).abs() / expected).max()))

    attempt(rivals, "chamfer() from torch", lambda: with_torch("chamfer() from torch", chamfer))
    attempt(rivals, "torch.cdist", lambda: with_torch("torch.cdist", by_cdist))
    fused = torch.compile(by_differences)
    attempt(rivals, "torch.compile, fused", lambda: with_torch("torch.compile, fused", fused))

    gradients: list[Row] = []

    def with_gradient() -> Row:
        plan = plan_of(*inputs[0], gradient=True)
        upstream = wp.full(worlds, 1.0, dtype=wp.float32, device=device)

        def both() -> None:
            plan.launch()
            plan.backward(upstream, upstream)

        return row("forward and backward", *shape, time_captured(both, device, repeats))

    def with_torch_gradient() -> Row:
        leaves = [tuple(t.clone().requires_grad_() for t in pair) for pair in inputs[:2]]
        call = lambda k: torch.autograd.grad(chamfer(*leaves[k % 2]).sum(), leaves[k % 2])  # noqa: E731
        return row("forward and backward from torch", *shape, time_called(call, device, repeats))

    attempt(gradients, "forward and backward", with_gradient)
    attempt(gradients, "forward and backward from torch", with_torch_gradient)
    del inputs[1:]

    sizes: list[Row] = []
    for w, n, m in OTHER_SIZES:
        w = max(1, w * worlds // 4096)

        def at_size(w: int = w, n: int = n, m: int = m) -> Row:
            a, b = cube(w, n, device), cube(w, m, device)
            plan = plan_of(a, b)
            times = time_captured(lambda: [plan.launch() for _ in range(4)], device, repeats)  # pyright: ignore
            means = (wp.to_torch(plan.a_to_b), wp.to_torch(plan.b_to_a))
            return row("default", w, n, m, times, 4, error=relative_error(*means, a, b))

        attempt(sizes, f"default {w} x {n} x {m}", at_size)

    def shared_and_masked() -> Row:
        side = max(1, round(worlds**0.5))
        a, b = cube(side * side, size, device).view(side, side, size, 3), cube(side, size, device)
        masks = [torch.rand(t.shape[:-1], device=device) > 0.3 for t in (a, b)]
        arrays = [wp.from_torch(t, dtype=wp.vec3) for t in (a, b)] + [wp.from_torch(t) for t in masks]
        plan = ChamferPlan(*arrays)
        times = time_captured(plan.launch, device, repeats)
        return row("second set shared, 30 % missing", side * side, size, size, times)

    attempt(sizes, "second set shared, 30 % missing", shared_and_masked)
    return {
        "tilings": tilings,
        "rivals": rivals,
        "gradients": gradients,
        "sizes": sizes,
        "precision": precision(device),
    }


def precision(device: str) -> list[Row]:
    """Relative error where coordinates are about 1 m and sets lie 0.1 to 10 mm apart."""
    rows: list[Row] = []
    for apart in (1e-4, 1e-3, 1e-2):
        torch.manual_seed(1)
        a = 1.0 + cube(8, 512, device)
        b = a + apart * torch.nn.functional.normalize(torch.randn_like(a), dim=-1)
        for name, tiling in (("difference", None), ("expanded", Tiling(16, 4, expanded=True, blocks=4))):

            def measure(
                name: str = name, apart: float = apart, tiling: Tiling | None = tiling, a: Any = a, b: Any = b
            ) -> Row:
                plan = plan_of(a, b, tiling=tiling)
                wp.synchronize()
                plan.launch()
                wp.synchronize()
                means = (wp.to_torch(plan.a_to_b), wp.to_torch(plan.b_to_a))
                return {"name": name, "apart": apart, "error": relative_error(*means, a, b)}

            attempt(rows, name, measure)
        expected = exact_parts(a, b).sum(0)
        error = float(((by_cdist(a, b).double() - expected).abs() / expected).max())
        rows.append({"name": "torch.cdist", "apart": apart, "error": error})
    return rows


def by_trees(a: np.ndarray, b: np.ndarray, distances: np.ndarray, _call: int) -> None:
    """Chamfer distances (worlds, frames) of a (worlds, frames, n, 3) and b (frames, m, 3) by k-d trees."""
    trees = [KDTree(frame) for frame in b]
    for world, frame in np.ndindex(*distances.shape):
        x, y = a[world, frame], b[frame]
        distances[world, frame] = trees[int(frame)].query(x)[0].mean() + KDTree(x).query(y)[0].mean()


def against_kd_tree(repeats: int) -> list[Row]:
    """Kernel and SciPy's k-d tree on one thread; the tree of the shared second set is built once a frame."""
    torch.set_num_threads(1)
    rows = []
    for worlds, frames, size in ((32, 100, 128), (8, 25, 512), (2, 5, 2048), (1, 2, 8192)):
        torch.manual_seed(0)
        a, b = cube(worlds * frames, size, "cpu").view(worlds, frames, size, 3), cube(frames, size, "cpu")

        expected = np.zeros((worlds, frames))

        by_tree = float(np.median(time_called(partial(by_trees, a.numpy(), b.numpy(), expected), "cpu", 3)))
        found = chamfer(a, b).numpy()
        forward = time_called(lambda _: chamfer(a, b), "cpu", repeats)  # noqa: B023
        leaf = a.clone().requires_grad_()
        backward = time_called(lambda _: torch.autograd.grad(chamfer(leaf, b).sum(), leaf), "cpu", repeats)  # noqa: B023
        measured = row("kernel", worlds * frames, size, size, forward)
        rows.append(
            {
                **measured,
                "frames": frames,
                "kd_tree_ms": by_tree,
                "ratio": by_tree / measured["ms"],
                "with_gradient_ms": float(np.median(backward)),
                "error": float((np.abs(found - expected) / expected).max()),
            }
        )
        print(f"{'':44s} k-d tree {by_tree:.1f} ms, {rows[-1]['ratio']:.1f} times as long", flush=True)
    return rows


def machine(device: str) -> dict[str, Any]:
    """Return the facts of the machine."""
    facts: dict[str, Any] = {
        "date": datetime.date.today().isoformat(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "warp": wp.__version__,
    }
    if device == "cuda":
        properties = torch.cuda.get_device_properties(0)
        query = ["nvidia-smi", "--query-gpu=driver_version,clocks.sm,clocks.max.sm", "--format=csv,noheader,nounits"]
        answer = subprocess.run(query, capture_output=True, text=True, check=False).stdout.strip().splitlines()
        driver, clock, most = answer[0].split(", ") if answer else ["unknown"] * 3
        facts |= {"processor": properties.name, "multiprocessors": properties.multi_processor_count}
        facts |= {"driver": driver, "clock_mhz": clock, "clock_max_mhz": most}
    else:
        lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
        names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
        facts |= {"processor": names[0] if names else platform.processor(), "cores": os.cpu_count()}
    return facts


def table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] + ["---:"] * (len(head) - 1), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def timed_table(first: str, rows: list[Row]) -> str:
    """Return a table of timed rows, with the reason where one did not run."""
    cells = []
    for r in rows:
        if "failed" in r:
            cells.append([r["name"], f"did not run: {r['failed']}", "", "", ""])
            continue
        spread = f"{r['ms']:.3f} ({r['ms_low']:.3f}-{r['ms_high']:.3f})"
        error = f"{r['error']:.1e}" if "error" in r else ""
        cells.append([r["name"], f"{r['worlds']} x {r['n']} x {r['m']}", spread, f"{r['rate']:,.0f}", error])
    return table([first, "worlds x n x m", "ms, median (10-90 %)", "10^9 pairs/s", "relative error"], cells)


def section(result: dict[str, Any]) -> str:
    """Return the section of one machine."""
    facts = result["machine"]
    others = {key.replace("_", " "): value for key, value in facts.items() if key not in ("processor", "date")}
    on = ", ".join(f"{key} {value}" for key, value in others.items())
    text = f"## {facts['processor']}\n\nMeasured {facts['date']}: {on}.\n\n"
    if "kd_tree" in result:
        cells = [
            [
                f"{r['worlds']} x {r['n']} x {r['m']}", f"{r['ms']:.2f}", f"{r['rate']:.1f}", f"{r['kd_tree_ms']:.1f}",
                f"{r['ratio']:.1f}", f"{r['with_gradient_ms']:.2f}", f"{r['error']:.0e}",
            ]
            for r in result["kd_tree"]
        ]  # fmt: skip
        head = ["pairs of sets x n x m", "kernel, ms", "10^9 pairs/s", "k-d tree, ms"]
        head += ["ratio", "with gradient, ms", "relative error"]
        text += "Time of one processor core; both directions. "
        text += "All worlds share the second set of a frame, and its tree is built once.\n"
        text += "The k-d tree does not compare all pairs, so its disadvantage shrinks with larger sets.\n\n"
        text += table(head, cells) + "\n"
    titles = {
        "rivals": ("Against torch", "method"),
        "tilings": ("Tilings: K points a lane, W warps, U unroll, B blocks a multiprocessor", "tiling"),
        "gradients": ("With the gradient with respect to both sets", "what"),
        "sizes": ("Other sizes", "tiling"),
    }
    for key, (title, first) in titles.items():
        if key in result:
            text += f"### {title}\n\n{timed_table(first, result[key])}\n"
    if "precision" in result:
        cells = [[r["name"], f"{1e3 * r['apart']:g}", f"{r['error']:.1e}"] for r in result["precision"] if "error" in r]
        text += "### Precision, coordinates of about 1 m\n\n"
        text += table(["form", "apart, mm", "relative error"], cells) + "\n"
    return text


def write_page(files: list[Path], page: Path) -> None:
    results = [json.loads(file.read_text()) for file in files]
    text = (
        "# Chamfer distance\n\nWritten by `benchmarks/kernels/chamfer.py`; do not edit.\n\n"
        + (__doc__ or "").split("\n\n", 2)[2]
    )
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(text + "\n" + "\n".join(map(section, results)).rstrip() + "\n")
    print(f"wrote {page}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--sweep", action="store_true", help="all tilings, rivals in torch, other sizes, precision")
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--size", type=int, default=512, help="points of each set")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--out", type=Path, help="folder for chamfer_DEVICE.json")
    parser.add_argument(
        "--table", type=Path, nargs="+", metavar="FILE", help="write the page from these results, no runs"
    )
    parser.add_argument("--page", type=Path, default=PAGE)
    options = parser.parse_args()
    if options.table:
        write_page(options.table, options.page)
        return
    wp.init()
    result: dict[str, Any] = {}
    if options.sweep:
        result |= sweep(options.device, options.worlds, options.size, options.repeats)
    else:
        result["kd_tree"] = against_kd_tree(options.repeats)
    result["machine"] = machine(options.device)
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        path = options.out / f"chamfer_{options.device}.json"
        unfinished = path.with_suffix(".partial")
        unfinished.write_text(json.dumps(result, indent=1) + "\n")
        unfinished.replace(path)
        print(f"wrote {path}")


if __name__ == "__main__":
    main()
