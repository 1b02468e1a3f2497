"""Virtual collision penalty against float64: all triangles by trimesh, all spheres, closed forms for boxes."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
import warp as wp
from rigid_poses import Poses, on_each_device, outputs, turn, turn_back

from concent_warp.kernels import virtual_collision_kernel
from concent_warp.kernels.virtual_collision import SphereSet, TargetMesh, VirtualCollision, VirtualPair

WEIGHTS = {"depth_weight": 30.0, "band_weight": 0.05, "severe_penalty": 7.0}
NAMES = ("reward", "penetration", "band", "deepest", "deepest_pair", "severe", "finite")
BOX = trimesh.creation.box([0.06, 0.06, 0.06])
MESHES = {
    "box": trimesh.creation.box([0.04, 0.06, 0.08]),
    "ring": trimesh.creation.annulus(0.02, 0.04, 0.03, sections=16),
    "capsule": trimesh.creation.capsule(0.08, 0.03, count=[8, 8]),
}
PLATES = (
    # a box with a square hole, of plates that overlap at the corners: centres and half sizes [m]
    ((0, 0, 0.0015), (0.035, 0.035, 0.0015)),
    ((0.028, 0, 0.011), (0.007, 0.035, 0.011)),
    ((-0.028, 0, 0.011), (0.007, 0.035, 0.011)),
    ((0, 0.028, 0.011), (0.035, 0.007, 0.011)),
    ((0, -0.028, 0.011), (0.035, 0.007, 0.011)),
)


def target(mesh, body):
    return TargetMesh(body, mesh.vertices, mesh.faces)


def ball(body, count, seed, spread=0.04):
    rng = np.random.default_rng(seed)
    return SphereSet(body, rng.uniform(-spread, spread, (count, 3)), rng.uniform(0.003, 0.01, count))


def mesh_distance(mesh, points):
    """Signed distance in float64 to a closed mesh: all its triangles, side by trimesh's ray casting."""
    count = len(mesh.faces)
    repeated = np.repeat(points, count, axis=0)
    nearest = trimesh.triangles.closest_point(np.tile(mesh.triangles, (len(points), 1, 1)), repeated)
    distance = np.linalg.norm(nearest - repeated, axis=1).reshape(-1, count).min(axis=1)
    return np.where(mesh.contains(points), -distance, distance)


def spheres_distance(spheres, points):
    return (np.linalg.norm(points[:, None] - spheres.centre, axis=2) - spheres.radius).min(axis=1)


def plates_distance(points):
    """Signed distance to the union of the plates outside of it, and whether points are inside."""
    distances = []
    for centre, half in PLATES:
        q = np.abs(points - centre) - half
        distances.append(np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0))
    return np.min(distances, axis=0)


class Case:
    """Two sets of spheres on bodies 1 and 2 against three meshes and one another, in three stages."""

    def __init__(self, device, worlds=40, **options):
        self.spheres = [ball(1, 37, 5), ball(2, 150, 6)]
        self.targets = [*(target(mesh, k) for k, mesh in zip((3, 0, 2), MESHES.values(), strict=True)), self.spheres[1]]
        self.pairs = [
            VirtualPair(0, 0, margin=0.02, severe=0.01, gate=(1.0, 0.0, 0.5)),
            VirtualPair(0, 1, margin=0.01, severe=0.02),
            VirtualPair(1, 0, margin=0.005, severe=0.015),
            VirtualPair(1, 1, margin=0.0, severe=0.03),
            VirtualPair(0, 2, margin=0.03, severe=0.02),
            VirtualPair(0, 3, margin=0.01, severe=0.008, gate=(0.0, 2.0, 1.0)),
        ]
        self.poses = Poses(worlds, 4, device, spread=0.08, stages=3)
        self.poses.stage[:2] = -1, 3
        # Far from all else, so that nothing is in reach there.
        self.poses.position[2] *= 100
        self.poses.upload()
        self.collision = VirtualCollision(
            self.spheres, self.targets, self.pairs, *self.poses.arrays, stages=3, **WEIGHTS, **options
        )

    def reference(self):
        """Gaps (W, all spheres of all pairs) where below the margin, and the outputs, by their names."""
        worlds = len(self.poses.stage)
        gaps = []
        found = {name: np.zeros(worlds) for name in ("penetration", "band", "deepest", "severe")}
        deepest_pair = np.full(worlds, -1)
        for p, pair in enumerate(self.pairs):
            spheres, to = self.spheres[pair.spheres], self.targets[pair.target]
            local = []
            for position, quaternion in zip(self.poses.position, self.poses.quaternion, strict=True):
                centre = position[spheres.body] + turn(quaternion[spheres.body], spheres.centre)
                local.append(turn_back(quaternion[to.body], centre - position[to.body]))
            points = np.concatenate(local)
            if isinstance(to, SphereSet):
                distance = spheres_distance(to, points)
            else:
                # Beyond the box and its margin no triangle need be asked.
                near = (np.abs(points) < 0.15).all(axis=1)
                distance = np.full(len(points), np.inf)
                distance[near] = mesh_distance(list(MESHES.values())[pair.target], points[near])
            gap = distance.reshape(worlds, -1) - spheres.radius
            gap[gap >= pair.margin] = np.inf
            depth = np.maximum(-gap, 0)
            gate = np.array([1.0] * 3 if pair.gate is None else pair.gate)
            known = (self.poses.stage >= 0) & (self.poses.stage < 3)
            gate = np.where(known, gate[np.clip(self.poses.stage, 0, 2)], 0)
            found["penetration"] += depth.sum(axis=1)
            if pair.margin:
                found["band"] += gate * (np.clip((pair.margin - gap) / pair.margin, 0, 1) ** 2).sum(axis=1)
            deeper = depth.max(axis=1) > found["deepest"]
            deepest_pair[deeper] = p
            found["deepest"] = np.maximum(found["deepest"], depth.max(axis=1))
            found["severe"] = np.maximum(found["severe"], (depth > pair.severe).any(axis=1))
            gaps.append(gap)
        reward = -(30.0 * found["penetration"] + 0.05 * found["band"] + 7.0 * found["severe"])
        found |= {"reward": reward, "deepest_pair": deepest_pair, "finite": np.ones(worlds)}
        return np.concatenate(gaps, axis=1), found

    def check(self):
        found, (_, expected) = outputs(self.collision, NAMES), self.reference()
        for name in NAMES:
            np.testing.assert_allclose(found[name], expected[name], rtol=1e-4, atol=2e-6, err_msg=name)


def at(device, *positions, targets, radius=0.005, gate=None, margin=0.004, severe=0.003, **options):
    """Launch worlds with one sphere of body 0 at each position, and all targets on body 1 at the origin."""
    poses = Poses(len(positions), 2, device, spread=0)
    poses.quaternion[:] = 1, 0, 0, 0
    poses.position[:, 0] = positions
    poses.upload()
    spheres = [SphereSet(0, np.zeros((1, 3)), np.array([radius]))]
    pairs = [VirtualPair(0, k, margin, severe, gate) for k in range(len(targets))]
    collision = VirtualCollision(spheres, targets, pairs, *poses.arrays, stages=1, gaps=True, **options)
    collision.launch()
    return collision


@on_each_device
def test_gaps_and_sums_match_float64(device):
    case = Case(device, gaps=True)
    case.collision.launch()
    gaps, expected = case.reference()
    np.testing.assert_allclose(case.collision.gap.numpy(), gaps, atol=1e-6)
    case.check()
    # The case must have some of everything.
    assert 0 < expected["severe"].sum() < len(gaps) - 3
    assert len(set(expected["deepest_pair"])) >= 5
    assert not expected["reward"][2]


@on_each_device
def test_captured_graph_follows_poses_and_stages(device):
    case = Case(device, worlds=20)
    with wp.ScopedCapture(device=device) as capture:
        case.collision.launch()
    case.poses.position[:, 1] = (case.poses.position[:, 1] + 0.02).astype(np.float32)
    case.poses.stage[:] = (case.poses.stage + 1) % 3
    case.poses.upload()
    assert capture.graph is not None
    wp.capture_launch(capture.graph)
    case.check()


@on_each_device
def test_equal_inputs_give_equal_results_bit_by_bit(device):
    case = Case(device)
    case.collision.launch()
    first = outputs(case.collision, NAMES)
    case.collision.launch()
    for name, values in outputs(case.collision, NAMES).items():
        np.testing.assert_array_equal(values, first[name])


@on_each_device
def test_common_motion_of_all_bodies_changes_nothing(device):
    case = Case(device)
    case.collision.launch()
    before = case.collision.reward.numpy().copy()
    assert before.any()
    shift = np.array([0.4, -0.2, 0.3])
    case.poses.position = turn(np.array([0.6, 0.8, 0, 0]), case.poses.position) + shift
    w, x, y, z = np.moveaxis(case.poses.quaternion, -1, 0)
    case.poses.quaternion = np.stack(
        [0.6 * w - 0.8 * x, 0.6 * x + 0.8 * w, 0.6 * y - 0.8 * z, 0.6 * z + 0.8 * y], axis=-1
    )
    case.poses.upload()
    case.collision.launch()
    np.testing.assert_allclose(case.collision.reward.numpy(), before, rtol=1e-4, atol=1e-4)


@on_each_device
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_pose_that_is_not_sane_is_flagged_and_stays_in_its_world(device, value):
    case = Case(device)
    case.collision.launch()
    before = outputs(case.collision, NAMES)
    case.poses.position[3, 1], case.poses.quaternion[4, 2], case.poses.position[5] = value, value, value
    case.poses.upload()
    case.collision.launch()
    after = outputs(case.collision, NAMES)
    np.testing.assert_array_equal(after["finite"], [1] * 3 + [0] * 3 + [1] * 34)
    for name in NAMES:
        assert (after[name][3:6] == (-1 if name == "deepest_pair" else 0)).all()
        np.testing.assert_array_equal(np.delete(after[name], [3, 4, 5]), np.delete(before[name], [3, 4, 5]))


def test_penalty_grows_without_jump_through_margin_and_touch():
    reach = 0.03 + 0.005
    x = np.linspace(reach + 0.006, reach - 0.0029, 400)
    positions = np.stack([x, np.zeros(400), np.zeros(400)], axis=1)
    collision = at("cpu", *positions, targets=[target(BOX, 1)], depth_weight=10.0, band_weight=0.01)
    reward, gap = collision.reward.numpy(), x - reach
    expected = -(10.0 * np.maximum(-gap, 0) + 0.01 * np.clip((0.004 - gap) / 0.004, 0, 1) ** 2)
    np.testing.assert_allclose(reward, expected, atol=2e-6)
    assert (np.diff(reward) <= 1e-7).all()
    assert not collision.severe.numpy().any()


@on_each_device
def test_severe_penetration_ends_the_episode_at_its_threshold(device):
    positions = [(0.035 - depth, 0, 0) for depth in (0.0029, 0.0031, 0.02)]
    collision = at(device, *positions, targets=[target(BOX, 1)], severe_penalty=5.0, depth_weight=0.0, band_weight=0.0)
    np.testing.assert_array_equal(collision.severe.numpy(), [0, 1, 1])
    np.testing.assert_allclose(collision.reward.numpy(), [0, -5, -5])


@on_each_device
def test_sphere_deep_inside_is_seen_though_it_is_small(device):
    union = SphereSet(1, np.zeros((1, 3)), np.array([0.03]))
    collision = at(device, (0, 0, 0), targets=[target(BOX, 1), union], radius=0.001, margin=0.0)
    np.testing.assert_allclose(collision.gap.numpy(), [[-0.031, -0.031]], atol=1e-7)
    assert collision.severe.numpy()[0] == 1


def test_inside_of_overlapping_plates_and_their_hole_are_distinguished():
    plates = [trimesh.creation.box(2 * np.array(half)).apply_translation(centre) for centre, half in PLATES]
    rng = np.random.default_rng(3)
    points = rng.uniform((-0.05, -0.05, -0.01), (0.05, 0.05, 0.04), (3000, 3)).astype(np.float32).astype(float)
    collision = at("cpu", *points, targets=[target(trimesh.util.concatenate(plates), 1)], margin=0.02)
    gap, expected = collision.gap.numpy()[:, 0], plates_distance(points) - 0.005
    outside = expected > -0.005
    near = expected < 0.02
    np.testing.assert_allclose(gap[outside & near], expected[outside & near], atol=1e-6)
    assert np.isinf(gap[outside & ~near]).all()
    assert (gap[~outside & (expected < -0.00501)] < -0.005).all()
    # No deeper than it is: of overlapping plates some faces lie inside.
    assert (gap[~outside] >= expected[~outside] - 1e-6).all()


def test_hole_in_a_mesh_is_no_inside():
    lid = BOX.face_normals[:, 2] > 0.5
    cup = TargetMesh(1, BOX.vertices, BOX.faces[~lid])
    above = [(0, 0, 0.036), (0.0299, 0, 0.06), (0.029, 0.029, 0.5)]
    inside = [(0, 0, -0.02), (0.02, 0.01, 0.0)]
    collision = at("cpu", *above, *inside, targets=[cup], margin=0.0)
    assert (collision.penetration.numpy()[:3] == 0).all()
    np.testing.assert_allclose(collision.gap.numpy()[3:, 0], [-0.015, -0.015], atol=1e-7)


def test_gate_turns_the_margin_off_but_not_penetration():
    positions = [(0.037, 0, 0), (0.034, 0, 0)]
    shut = at("cpu", *positions, targets=[target(BOX, 1)], gate=(0.0,))
    assert not shut.band.numpy().any()
    np.testing.assert_allclose(shut.penetration.numpy(), [0, 0.001], atol=1e-7)
    assert (at("cpu", *positions, targets=[target(BOX, 1)]).band.numpy() > 0).all()


def test_without_pairs_nothing_is_penalised():
    poses = Poses(4, 2, "cpu")
    collision = VirtualCollision([], [], [], *poses.arrays, stages=1)
    collision.launch()
    assert not collision.reward.numpy().any()
    assert (collision.finite.numpy() == 1).all()


def test_what_cannot_be_is_refused():
    case = Case("cpu", worlds=3)
    few = Poses(3, 3, "cpu")

    def make(pair=None, poses=case.poses, **changes):
        pairs = [replace(case.pairs[0], **changes)] if pair is None else [pair]
        return VirtualCollision(case.spheres, case.targets, pairs, *poses.arrays, stages=3)

    for match, call in (
        ("there are 2 sets and 4 targets", lambda: make(target=4)),
        ("margin and severe", lambda: make(margin=-0.1)),
        ("margin and severe", lambda: make(severe=np.nan)),
        ("must have 3 stages", lambda: make(gate=(1.0,))),
        (r"must be in 0\.\.2", lambda: make(poses=few)),
        ("inwards", lambda: TargetMesh(0, BOX.vertices, BOX.faces[:, ::-1])),
        ("must index", lambda: TargetMesh(0, BOX.vertices, BOX.faces + 1)),
        ("f > 0", lambda: TargetMesh(0, BOX.vertices, np.empty((0, 3), dtype=int))),
        ("n > 0", lambda: SphereSet(0, np.empty((0, 3)), np.empty(0))),
        ("not negative", lambda: SphereSet(0, np.zeros((1, 3)), np.array([-1.0]))),
    ):
        with pytest.raises(ValueError, match=match):
            call()


def test_cuda_kernels_compile_without_a_gpu(tmp_path):
    kernel = virtual_collision_kernel.collision_kernel
    assert isinstance(kernel, wp.Kernel)
    (code,) = wp.compile_aot_module(kernel.module, arch=90, module_dir=tmp_path, use_ptx=True)
    assert code.stat().st_size > 0
