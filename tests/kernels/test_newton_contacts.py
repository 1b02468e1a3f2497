"""Contacts of spheres with planes, boxes, spheres, capsules and cylinders: distances, normals, gradients."""

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from concent_warp.kernels.newton_contacts import (
    BOX,
    CAPSULE,
    CYLINDER,
    LARGER_FRICTION,
    PLANE,
    SHAPE_FRICTION,
    SPHERE,
    SPHERE_FRICTION,
    gather_contacts,
    write_contacts,
)

TURNED = wp.transform(wp.vec3(0.1, -0.2, 0.3), wp.quat_rpy(0.4, -0.6, 0.7))
STILL = wp.transform_identity()
SIZE = (0.03, 0.02, 0.01)
"""Half sizes of the box; radius and half length of the capsule and the cylinder."""
RADIUS, CAP, ONSET = 0.005, 0.03, 0.004
KNOWN = [
    # kind, centre of the sphere in the shape's frame, distance of the centre from the surface, normal to the centre
    (PLANE, (0.4, 0.1, 0.02), 0.02, (0, 0, 1)),
    (PLANE, (0.4, 0.1, -0.02), -0.02, (0, 0, 1)),
    (BOX, (0.01, 0.005, 0.015), 0.005, (0, 0, 1)),
    (BOX, (0.033, 0.024, 0.0), 0.005, (0.6, 0.8, 0)),
    (BOX, (0.01, -0.018, 0.002), -0.002, (0, -1, 0)),
    (BOX, (-0.029, 0.0, 0.0), -0.001, (-1, 0, 0)),
    (SPHERE, (0.0, 0.06, 0.08), 0.07, (0, 0.6, 0.8)),
    (CAPSULE, (0.04, 0.0, 0.01), 0.01, (1, 0, 0)),
    (CAPSULE, (0.03, 0.0, 0.06), 0.02, (0.6, 0, 0.8)),
    (CYLINDER, (0.0, 0.04, 0.01), 0.01, (0, 1, 0)),
    (CYLINDER, (0.01, 0.0, 0.019), -0.001, (0, 0, 1)),
    (CYLINDER, (0.0, 0.033, 0.024), 0.005, (0, 0.6, 0.8)),
]


def moved(pose, point):
    """Return a point of a frame, in the world."""
    return Rotation.from_quat(np.array(pose)[3:]).apply(point) + np.array(pose)[:3]


def back(pose, point):
    """Return a point of the world, in a frame."""
    return Rotation.from_quat(np.array(pose)[3:]).inv().apply(point - np.array(pose)[:3])


def placed(kind, centre, pose0, pose1, *, grad=False):
    """Run the kernels for one pair; returns the arrays: centres, poses, point1, normal and margin1."""

    def array(values, dtype, ndim=1):
        shaped = np.asarray(values).reshape((1,) * ndim + np.shape(values)[ndim:])
        return wp.array(shaped, dtype=dtype, device="cpu", requires_grad=grad)

    zero, minus = (wp.array([v], dtype=int, device="cpu") for v in (0, -1))
    kinds, one = (wp.array([v], dtype=int, device="cpu") for v in (kind, 1))
    frame = wp.array([wp.transform(wp.vec3(0.01, 0.02, 0.0), wp.quat_rpy(0.3, 0.1, -0.4))], dtype=wp.transform)
    size = wp.array([SIZE if kind == BOX else (CAP, 0.02, 0.0)], dtype=wp.vec3, device="cpu")
    position, radius = array(np.reshape(centre, (1, 1, 3)), wp.vec3, 2), array([[RADIUS]], float, 2)
    body_q = wp.array([pose0, pose1], dtype=wp.transform, device="cpu", requires_grad=grad)
    round_one = CAP if kind in (SPHERE, CAPSULE) else 0.0
    out = {name: array([0.0], float) for name in ("margin0", "margin1", "stiffness", "damping", "mu")}
    point0, point1, normal = (array(np.zeros((1, 3)), wp.vec3) for _ in range(3))
    damping = array([0.0], float)
    constants = [array([v], float) for v in (round_one, 0.3, 5.0, 2.0)]
    scales = [array([v], float) for v in (0.5, 4.0)]
    wp.launch(
        gather_contacts,
        dim=(1, 1),
        inputs=[1, zero, minus, zero, *constants, position, radius, array([[0.4]], float, 2), *scales],
        outputs=[point0, *out.values()],
        device="cpu",
    )
    fixed = [out[name] for name in ("margin0", "margin1", "damping")]
    wp.launch(
        write_contacts,
        dim=(1, 1),
        inputs=[2, 1, zero, one, minus, kinds, frame, size, position, point0, *fixed, ONSET, body_q],
        outputs=[point1, normal, damping],
        device="cpu",
    )
    return {
        "position": position,
        "body_q": body_q,
        "frame": frame,
        "point1": point1,
        "normal": normal,
        **out,
        "damping": damping,
    }


def gap(found, centre, pose0, pose1):
    """Return Newton's distance of a contact [m], from what it reads, and the normal towards the sphere."""
    normal = -found["normal"].numpy()[0]
    centre, point = moved(pose0, centre), moved(pose1, found["point1"].numpy()[0])
    return float(normal @ (centre - point) - found["margin0"].numpy()[0] - found["margin1"].numpy()[0]), normal


@pytest.mark.parametrize(("kind", "local", "distance", "normal"), KNOWN)
def test_gap_and_normal_are_those_known_by_hand(kind, local, distance, normal):
    found = placed(kind, (0, 0, 0), STILL, TURNED)
    frame = found["frame"].numpy()[0]
    sphere = wp.transform(wp.vec3(0.05, 0.0, 0.0), wp.quat_rpy(0.2, 0.5, 0.1))
    centre = back(sphere, moved(TURNED, moved(frame, local)))
    found = placed(kind, centre, sphere, TURNED)
    measured, towards = gap(found, centre, sphere, TURNED)
    assert measured == pytest.approx(distance - RADIUS, abs=2e-6)
    expected = moved(TURNED, moved(frame, normal)) - moved(TURNED, moved(frame, (0, 0, 0)))
    np.testing.assert_allclose(towards, expected, atol=1e-4)
    share = np.clip((RADIUS - distance) / ONSET, 0, 1)
    assert found["damping"].numpy()[0] == pytest.approx(share * 2.0 * np.sqrt(4.0), abs=4e-3)


@pytest.mark.parametrize(("kind", "local", "distance", "normal"), KNOWN)
def test_gradients_of_point_and_normal_are_those_of_central_differences(kind, local, distance, normal):
    del distance, normal
    rng = np.random.default_rng(0)
    frame = placed(kind, (0, 0, 0), STILL, TURNED)["frame"].numpy()[0]
    centre = moved(TURNED, moved(frame, local))
    weight = rng.normal(size=(2, 3))

    def value(at):
        found = placed(kind, at, STILL, TURNED)
        return float(weight[0] @ found["normal"].numpy()[0] + 30 * weight[1] @ found["point1"].numpy()[0])

    with wp.Tape() as tape:
        found = placed(kind, centre, STILL, TURNED, grad=True)
    for name, factor, row in (("normal", 1.0, 0), ("point1", 30.0, 1)):
        found[name].grad.assign((factor * weight[row])[None].astype(np.float32))
    tape.backward()
    step = 2e-4
    expected = [(value(centre + step * e) - value(centre - step * e)) / (2 * step) for e in np.eye(3)]
    np.testing.assert_allclose(found["position"].grad.numpy()[0, 0], expected, rtol=0.02, atol=0.05)


def test_two_fitted_spheres_meet_and_both_carry_gradients():
    pair = [wp.array([v], dtype=int, device="cpu") for v in (0, 1)]
    position = wp.array([[(0.0, 0.0, 0.0), (0.0, 0.0, 0.01)]], dtype=wp.vec3, device="cpu", requires_grad=True)
    body_q = wp.array([wp.transform(wp.vec3(0.0, 0.006, 0.018), wp.quat_identity()), STILL], dtype=wp.transform)
    point0 = wp.zeros(1, dtype=wp.vec3, device="cpu")
    point1, normal = (wp.zeros(1, dtype=wp.vec3, device="cpu", requires_grad=True) for _ in range(2))
    still, damping = [wp.zeros(1, dtype=float) for _ in range(3)], wp.zeros(1, dtype=float)
    kind, frame = wp.array([SPHERE], dtype=int), wp.array([STILL], dtype=wp.transform)
    size = wp.zeros(1, dtype=wp.vec3, device="cpu")
    with wp.Tape() as tape:
        wp.launch(
            write_contacts,
            dim=(1, 1),
            inputs=[2, 1, *pair, pair[1], kind, frame, size, position, point0, *still, ONSET, body_q],
            outputs=[point1, normal, damping],
            device="cpu",
        )
    np.testing.assert_allclose(normal.numpy()[0], [0, -0.6, -0.8], atol=1e-6)
    np.testing.assert_allclose(point1.numpy()[0], [0, 0, 0.01], atol=1e-9)
    normal.grad.assign(np.array([[0, 1, 0]], dtype=np.float32))
    tape.backward()
    np.testing.assert_allclose(position.grad.numpy()[0, 1], [0, 64, -48], rtol=1e-4)  # (1 - n n^T) e_y / |c - p|


@pytest.mark.parametrize(("rule", "expected"), [(SPHERE_FRICTION, 0.4), (SHAPE_FRICTION, 0.9), (LARGER_FRICTION, 0.9)])
def test_friction_and_stiffness_follow_the_rule_and_the_scales(rule, expected):
    def array(values, dtype=float):
        return wp.array(values, dtype=dtype, device="cpu")

    minus, zero = array([-1], int), array([0], int)
    out = [wp.zeros(1, dtype=d, device="cpu") for d in (wp.vec3, float, float, float, float, float)]
    position = wp.zeros((1, 1), dtype=wp.vec3, device="cpu")
    inputs = [1, zero, minus, array([rule], int), array([0.0]), array([0.9]), array([100.0])]
    inputs += [array([3.0]), position, array([[RADIUS]]), array([[0.4]]), array([0.5]), array([4.0])]
    wp.launch(gather_contacts, dim=(1, 1), inputs=inputs, outputs=out, device="cpu")
    stiffness, damping, mu = (a.numpy()[0] for a in out[3:])
    assert mu == pytest.approx(0.5 * expected)
    assert (stiffness, damping) == (pytest.approx(400.0), pytest.approx(6.0))
