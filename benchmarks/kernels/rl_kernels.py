"""Kernels of the contact-centric training against plain torch, by number of worlds.

    python -m benchmarks.kernels.rl_kernels --device cuda --machine h200    measure; writes the data and the page
    python -m benchmarks.kernels.rl_kernels --table                         the page from the stored data, without runs

A scene like the shape sorter just before insertion: a block of 128 spheres above or in a box of 192, between two
fingers, under a hand and three links, with different poses in each world. 40 spheres of the block and 38 of the box are
collidable; the others are checked virtually: the block's against the meshes of box, hand, fingers, links and table and
against the box's collidable spheres, the box's against the meshes of the robot.

*contact pairs* is `ContactPairs`, eight slots; *meshes* and *spheres* are `VirtualCollision` with the pairs of either
kind. The torch version does the same in float32 without a search tree: every pair of a sphere and a triangle, with the
solid angle of the triangle for the sign, and every pair of spheres, in parts that fit in memory. Its ratio on meshes
therefore includes the gain of the tree.

Kernels are captured in a graph and replayed, torch runs eagerly; medians, of torch on meshes one run. *difference* is
the largest difference of the two results for the fewest worlds, relative to their largest value. The figures leave out
physics and policy, and other scenes: time grows with spheres near meshes and with faces.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import trimesh
import warp as wp

from benchmarks.pages import FOLDER, machine, machine_line, read_data, table, write_data, write_page
from concent_warp.kernels.contact_pairs import ContactPairs, PairTable
from concent_warp.kernels.virtual_collision import SphereSet, TargetMesh, VirtualCollision, VirtualPair

TABLE, BOX, BLOCK, HAND, FINGERS, LINKS = 0, 1, 2, 3, (4, 5), (6, 7, 8)
BODIES = 9
Tensors = tuple[torch.Tensor, ...]
STAGES = 3
SIGMA, AMPLITUDE = (0.05, 0.008), (1.0, 2.0)
DEPTH, BAND, SEVERE = 10.0, 0.01, 10.0
CHUNK = {"cpu": 1_000_000, "cuda": 20_000_000}
"""Pairs of a sphere and a triangle, or of two spheres, that torch takes at a time."""


@dataclass(frozen=True)
class Scene:
    """Inputs of the kernels and of torch."""

    table: PairTable
    spheres: list[SphereSet]
    targets: list[SphereSet | TargetMesh]
    meshes: list[VirtualPair]
    balls: list[VirtualPair]


def on_surface(body: int, half: Sequence[float], count: int, rng: np.random.Generator) -> SphereSet:
    """Return spheres whose surfaces touch that of a box from within."""
    radius = np.full(count, 0.002)
    points = rng.uniform(-1, 1, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-1.0, 1.0], count)
    return SphereSet(body, points * (np.array(half) - 0.002), radius)


def make_scene() -> Scene:
    rng = np.random.default_rng(0)

    def mesh(body: int, *parts: trimesh.Trimesh) -> TargetMesh:
        starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
        faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
        return TargetMesh(body, np.concatenate([part.vertices for part in parts]), np.concatenate(faces))

    def plate(x: float, y: float, z: float, a: float, b: float, c: float) -> trimesh.Trimesh:
        return trimesh.creation.box([2 * a, 2 * b, 2 * c]).apply_translation([x, y, z])

    sides = [(s * 0.028, 0.0, 0.011, 0.007, 0.035, 0.011) for s in (-1, 1)]
    sides += [(0.0, s * 0.028, 0.011, 0.035, 0.007, 0.011) for s in (-1, 1)]
    link = trimesh.creation.capsule(0.2, 0.05, count=[16, 16])
    targets: list[SphereSet | TargetMesh] = [
        mesh(TABLE, plate(0, 0, -0.02, 0.6, 0.6, 0.02)),
        mesh(BOX, plate(0, 0, 0.0015, 0.035, 0.035, 0.0015), *(plate(*side) for side in sides)),
        mesh(HAND, plate(0, 0, 0, 0.03, 0.1, 0.03)),
        *(mesh(body, plate(0, 0, 0, 0.01, 0.005, 0.025)) for body in FINGERS),
        *(mesh(body, link) for body in LINKS),
    ]
    block = on_surface(BLOCK, (0.02, 0.02, 0.02), 128, rng)
    box = on_surface(BOX, (0.035, 0.035, 0.011), 192, rng)
    spheres = [SphereSet(BLOCK, block.centre[40:], block.radius[40:]), SphereSet(BOX, box.centre[38:], box.radius[38:])]
    robot = range(2, len(targets))
    targets.append(SphereSet(BOX, box.centre[:38], box.radius[:38]))
    shape = (STAGES, 8)
    normal = rng.normal(size=(*shape, 3))
    pairs = PairTable(
        body_a=np.full(shape, BLOCK),
        point_a=rng.uniform(-0.02, 0.02, (*shape, 3)),
        radius_a=np.full(shape, 0.002),
        body_b=np.full(shape, BOX),
        point_b=rng.uniform(-0.02, 0.02, (*shape, 3)),
        radius_b=np.full(shape, 0.002),
        normal=normal / np.linalg.norm(normal, axis=-1, keepdims=True),
        active=rng.random(shape) < 0.7,
    )
    return Scene(
        pairs,
        spheres,
        targets,
        [VirtualPair(0, k) for k in (0, 1, *robot)] + [VirtualPair(1, k) for k in robot],
        [VirtualPair(0, len(targets) - 1)],
    )


def make_poses(worlds: int, device: str) -> tuple[wp.array, wp.array, wp.array]:
    """Return positions, orientations and stages: the block is within 15 mm and 11 degrees of its place over the box."""
    rng = np.random.default_rng(1)
    place = np.zeros((BODIES, 3))
    place[BOX] = 0.5, 0.1, 0
    place[BLOCK] = place[BOX] + (0, 0, 0.035)
    place[HAND] = place[BLOCK] + (0, 0, 0.08)
    place[FINGERS, :] = place[BLOCK] + np.array([[0, -0.026, 0.01], [0, 0.026, 0.01]])
    place[LINKS, :] = place[HAND] + np.array([[0, 0, 0.15], [-0.1, 0, 0.3], [-0.3, 0, 0.3]])
    held = [BLOCK, HAND, *FINGERS, *LINKS]
    position = np.tile(place, (worlds, 1, 1))
    position[:, held] += rng.uniform(-0.015, 0.015, (worlds, 1, 3))
    angle = np.zeros((worlds, BODIES))
    angle[:, held] = rng.uniform(-0.2, 0.2, (worlds, 1))
    quaternion = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], axis=-1)
    stage = rng.integers(0, STAGES, worlds)
    return (
        wp.array(position, dtype=wp.vec3, device=device),
        wp.array(quaternion, dtype=wp.quat, device=device),
        wp.array(stage, dtype=wp.int32, device=device),
    )


def turn(quaternion: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Rotate vectors (..., 3) by wxyz quaternions (..., 4)."""
    w, u = quaternion[..., :1], quaternion[..., 1:]
    t = 2 * torch.linalg.cross(u, vector)
    return vector + w * t + torch.linalg.cross(u, t)


class TorchPairs:
    """Contact pairs in torch: the features and the reward of `ContactPairs`."""

    def __init__(self, pairs: PairTable, poses: Tensors, device: str) -> None:
        self.position, self.quaternion, self.stage = poses
        real = (torch.as_tensor(v, dtype=torch.float32, device=device) for v in (
            pairs.point_a, pairs.radius_a, pairs.point_b, pairs.radius_b, pairs.normal
        ))  # fmt: skip
        self.point_a, self.radius_a, self.point_b, self.radius_b, self.normal = real
        self.body_a, self.body_b, self.active = (
            torch.as_tensor(v, device=device) for v in (pairs.body_a, pairs.body_b, pairs.active)
        )

    def __call__(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return features (W, 104) and both terms of the reward (W, 2)."""
        s = self.stage.long()
        world = torch.arange(len(s), device=s.device)[:, None]
        a, b, active = self.body_a[s], self.body_b[s], self.active[s]
        normal = turn(self.quaternion[world, b], self.normal[s])
        contact = self.position[world, a] + turn(self.quaternion[world, a], self.point_a[s])
        contact = contact - self.radius_a[s][..., None] * normal
        target = self.position[world, b] + turn(self.quaternion[world, b], self.point_b[s])
        delta = target + self.radius_b[s][..., None] * normal - contact
        distance = delta.norm(dim=-1)
        direction = delta / distance.clamp(min=1e-6)[..., None]
        mask = active[..., None].float()
        features = torch.cat([mask, contact * mask, delta * mask, direction * mask, normal * mask], dim=-1)
        worst = torch.where(active, distance, -1.0).max(dim=1).values
        reach = torch.stack([A * torch.exp(-worst / r) for A, r in zip(AMPLITUDE, SIGMA, strict=True)], dim=1)
        return features.flatten(1), torch.where(active.any(dim=1, keepdim=True), reach, 0.0)


class TorchCollision:
    """Virtual collisions in torch: the reward of `VirtualCollision`."""

    def __init__(self, scene: Scene, pairs: Sequence[VirtualPair], poses: Tensors, device: str) -> None:
        self.position, self.quaternion, _ = poses

        def real(values: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        self.chunk = CHUNK[torch.device(device).type]
        self.work = []
        for pair in pairs:
            spheres, to = scene.spheres[pair.spheres], scene.targets[pair.target]
            shapes = (
                (real(np.column_stack([to.centre, to.radius])),)
                if isinstance(to, SphereSet)
                else (real(np.asarray(to.vertices)[to.faces]),)
            )
            self.work.append((pair, spheres.body, to.body, real(spheres.centre), real(spheres.radius), shapes[0]))

    def __call__(self) -> torch.Tensor:
        """Return the reward (W,)."""
        worlds = len(self.position)
        depths, bands = (torch.zeros(worlds, device=self.position.device) for _ in range(2))
        severe = torch.zeros(worlds, dtype=torch.bool, device=self.position.device)
        for pair, a, b, centre, radius, shape in self.work:
            step = max(1, self.chunk // (len(centre) * len(shape)))
            for w in range(0, worlds, step):
                rows = slice(w, w + step)
                x = self.position[rows, a, None] + turn(self.quaternion[rows, a, None], centre[None])
                back = self.quaternion[rows, b, None] * torch.tensor([1.0, -1, -1, -1], device=x.device)
                x = turn(back, x - self.position[rows, b, None])
                distance = (to_spheres if shape.dim() == 2 else to_mesh)(x, shape)
                gap = distance - radius
                depth = (-gap).clamp(min=0)
                depths[rows] += depth.sum(dim=1)
                bands[rows] += (((pair.margin - gap) / pair.margin).clamp(0, 1) ** 2).sum(dim=1)
                severe[rows] |= (depth > pair.severe).any(dim=1)
        return -(DEPTH * depths + BAND * bands + SEVERE * severe)


def to_spheres(x: torch.Tensor, spheres: torch.Tensor) -> torch.Tensor:
    """Signed distance (w, n) of points (w, n, 3) to the union of spheres (m, 4)."""
    return ((x[:, :, None] - spheres[:, :3]).norm(dim=-1) - spheres[:, 3]).min(dim=-1).values


def to_mesh(x: torch.Tensor, corners: torch.Tensor) -> torch.Tensor:
    """Signed distance (w, n) of points (w, n, 3) to triangles (f, 3, 3): nearest point, side by solid angles."""
    a, b, c = (corner - x[:, :, None] for corner in corners.unbind(1))
    ab, bc, ca = (corners[:, (k + 1) % 3] - corners[:, k] for k in range(3))
    normal = torch.linalg.cross(ab, -ca)
    square = (normal * normal).sum(-1)

    def to_edge(start: torch.Tensor, edge: torch.Tensor) -> torch.Tensor:
        t = (-(start * edge).sum(-1) / (edge * edge).sum(-1)).clamp(0, 1)
        return (start + t[..., None] * edge).square().sum(-1)

    over = torch.ones_like(a[..., 0], dtype=torch.bool)
    for start, edge in ((a, ab), (b, bc), (c, ca)):
        over &= (torch.linalg.cross(edge, normal) * start).sum(-1) >= 0
    plane = (a * normal).sum(-1) ** 2 / square
    edges = torch.minimum(torch.minimum(to_edge(a, ab), to_edge(b, bc)), to_edge(c, ca))
    distance = torch.where(over, plane, edges).min(dim=-1).values.sqrt()
    la, lb, lc = a.norm(dim=-1), b.norm(dim=-1), c.norm(dim=-1)
    volume = (a * torch.linalg.cross(b, c)).sum(-1)
    below = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    winding = torch.atan2(volume, below).sum(-1) / (2 * torch.pi)
    return torch.where(winding > 0.5, -distance, distance)


def median_ms(call: Callable[[], object], device: str, repeats: int, *, captured: bool) -> float:
    """Return the median time of a call [ms]; `captured` records it in a graph, 10 in one on CUDA."""
    call()
    inner = 10 if captured and device != "cpu" else 1
    run = call
    if captured:
        with wp.ScopedCapture(device=device) as capture:
            for _ in range(inner):
                call()
        graph = capture.graph
        assert graph is not None
        run = lambda: wp.capture_launch(graph)  # noqa: E731
        run()
    times = []
    for _ in range(repeats):
        synchronize(device)
        begin = time.perf_counter()
        run()
        synchronize(device)
        times.append(1e3 * (time.perf_counter() - begin) / inner)
    return float(np.median(times))


def synchronize(device: str) -> None:
    if device != "cpu":
        wp.synchronize_device(device)
        torch.cuda.synchronize(device)


def measure(scene: Scene, worlds: int, device: str, repeats: int, *, with_error: bool) -> list[dict[str, Any]]:
    """Return the rows of one number of worlds."""
    poses = make_poses(worlds, device)
    synchronize(device)
    tensors = tuple(wp.to_torch(array) for array in poses)
    pairs = ContactPairs(scene.table, *poses, amplitude=AMPLITUDE, sigma=SIGMA)
    work: list[tuple[str, Any, wp.array, Any]] = [
        ("contact pairs", pairs, pairs.features, TorchPairs(scene.table, tensors, device))
    ]
    for name, chosen in (("meshes", scene.meshes), ("spheres", scene.balls)):
        kernel = VirtualCollision(
            scene.spheres,
            scene.targets,
            chosen,
            *poses,
            stages=STAGES,
            depth_weight=DEPTH,
            band_weight=BAND,
            severe_penalty=SEVERE,
        )
        work.append((name, kernel, kernel.reward, TorchCollision(scene, chosen, tensors, device)))
    rows = []
    for name, kernel, output, plain in work:
        kernel_ms = median_ms(kernel.launch, device, repeats, captured=True)
        slow = name == "meshes"
        torch_ms = median_ms(plain, device, 1 if slow else repeats, captured=False)
        row = {"name": name, "worlds": worlds, "kernel_ms": kernel_ms, "torch_ms": torch_ms}
        if with_error:
            found = wp.to_torch(output)
            expected = plain()
            expected = expected[0] if isinstance(expected, tuple) else expected
            row["error"] = float((found - expected).abs().max() / expected.abs().max())
        rows.append(row)
        print(row, flush=True)
    return rows


def section(data: dict[str, Any]) -> str:
    """Return the part of the page for one machine."""
    facts = data["machine"]
    cells = [
        [
            row["name"],
            f"{row['worlds']:,}",
            f"{row['kernel_ms']:.3f}",
            f"{row['worlds'] / row['kernel_ms'] / 1e3:,.2f}",
            f"{row['torch_ms']:,.2f}",
            f"{row['torch_ms'] / row['kernel_ms']:,.0f}",
            f"{row['error']:.0e}" if "error" in row else "",
        ]
        for row in sorted(data["rows"], key=lambda row: row["name"])
    ]
    head = ["what", "worlds", "kernel, ms", "10^6 worlds/s", "torch, ms", "ratio", "difference"]
    return f"## {facts.get('device', facts['processor'])}\n\n{machine_line(facts)}\n\n{table(head, cells)}"


def page() -> str:
    """Return the page of all stored data."""
    names = sorted(path.stem for path in (FOLDER / "data").glob("rl_kernels_*.json"))
    about = (__doc__ or "").split("\n\n", 2)[2].strip()
    title = "# Kernels of the contact-centric training"
    written = "Written by `benchmarks/kernels/rl_kernels.py`; do not edit."
    return "\n\n".join([title, written, about, *(section(read_data(name)) for name in names)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--machine", help="names the data file; by default the device")
    parser.add_argument("--worlds", type=int, nargs="+", help="by default 1,024 to 16,384 on CUDA, 16 and 64 on a CPU")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--table", action="store_true", help="write the page from the stored data, without runs")
    options = parser.parse_args()
    if not options.table:
        device = "cpu" if options.device == "cpu" else "cuda:0"
        few = [16, 64] if device == "cpu" else [1024, 2048, 4096, 8192, 16384]
        torch.set_num_threads(1)
        scene = make_scene()
        worlds = sorted(options.worlds or few)
        rows = [
            row for n in worlds for row in measure(scene, n, device, options.repeats, with_error=n == worlds[0])
        ]  # fmt: skip
        write_data(f"rl_kernels_{options.machine or options.device}", {"machine": machine(device), "rows": rows})
    write_page("rl_kernels", page())


if __name__ == "__main__":
    main()
