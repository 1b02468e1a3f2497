"""Projection of Gaussians into images by elliptical weighted averaging (EWA), after "3D Gaussian Splatting" (2023).

A Gaussian of mean m and covariance S = R diag(s^2) R^T in the camera's frame (x right, y down, z forward) is seen as
one of mean (fx x / z + cx, fy y / z + cy) and covariance J S J^T + 0.3 I [px^2], J the Jacobian of the pinhole
projection at the mean (Zwicker et al., "EWA Splatting", 2002). The 0.3 makes it at least about a pixel wide;
`antialias` takes the opacity down by sqrt(det(J S J^T) / det(J S J^T + 0.3 I)) for that, so that small Gaussians do not
swell (Yu et al., "Mip-Splatting", 2024).

A Gaussian reaches as far as its opacity is above 1/255, so bounds are exact. The kernel is differentiable: launched
with `adjoint=True`, it takes gradients of what it writes to those of the Gaussians.
"""

from __future__ import annotations

import warp as wp

PIXEL_VARIANCE = wp.constant(0.3)
"""Added to the variance along both axes of an image [px^2]."""
MIN_OPACITY = wp.constant(1.0 / 255.0)
"""Least opacity that counts."""
MIN_DEPTH = wp.constant(0.01)
"""Least depth [m]."""
JACOBIAN_MARGIN = wp.constant(0.3)
"""Beyond the image by this share of half its extent, the Jacobian is taken at the border: it grows without bounds."""


@wp.struct
class SplatPoses:
    """Where O objects and C cameras are in W worlds."""

    owner: wp.array[int]  # object of a Gaussian, shape (N,)
    object_pose: wp.array3d[float]  # position [m] and quaternion wxyz, shape (W, O, 7)
    camera_pose: wp.array3d[float]  # the same of cameras that look along -z, y up, shape (W, C, 7)
    pinhole: wp.array3d[float]  # fx, fy, cx, cy [px], (0, 0) the centre of the first pixel, shape (W, C, 4)
    light: wp.array2d[wp.vec3]  # direction along which an image's splats are flattened, shape (W, C), or (0, 0)
    ground: float  # height of the plane onto which they are [m]


@wp.struct
class Frame:
    """The images: W * C of them, cut into square tiles."""

    width: int
    height: int
    tile: int  # edge [px]
    columns: int  # tiles beside each other
    rows: int
    antialias: int


@wp.func
def matrix_of(w: float, x: float, y: float, z: float) -> wp.mat33:
    """Rotation matrix of a quaternion of any length."""
    s = 2.0 / (w * w + x * x + y * y + z * z)
    return wp.mat33(
        1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
        s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x),
        s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y),
    )  # fmt: skip


@wp.func
def pose_matrix(pose: wp.array3d[float], world: int, k: int) -> wp.mat33:
    """Rotation of a pose."""
    return matrix_of(pose[world, k, 3], pose[world, k, 4], pose[world, k, 5], pose[world, k, 6])


@wp.func
def pose_position(pose: wp.array3d[float], world: int, k: int) -> wp.vec3:
    """Position of a pose."""
    return wp.vec3(pose[world, k, 0], pose[world, k, 1], pose[world, k, 2])


@wp.func
def flattening(light: wp.vec3) -> wp.mat33:
    """Projection onto the plane z = 0 along a direction."""
    return wp.mat33(1.0, 0.0, -light[0] / light[2], 0.0, 1.0, -light[1] / light[2], 0.0, 0.0, 0.0)


@wp.func
def colour_seen(harmonics: wp.array2d[wp.vec3], i: int, d: wp.vec3) -> wp.vec3:
    """Colour of a Gaussian seen along a unit direction in its object's frame: real spherical harmonics, plus 0.5."""
    count = harmonics.shape[1]
    colour = 0.28209479177387814 * harmonics[i, 0] + wp.vec3(0.5, 0.5, 0.5)
    x = d[0]
    y = d[1]
    z = d[2]
    if count > 1:
        colour += 0.4886025119029199 * (z * harmonics[i, 2] - y * harmonics[i, 1] - x * harmonics[i, 3])
    if count > 4:
        colour += 1.0925484305920792 * (x * y * harmonics[i, 4] - y * z * harmonics[i, 5] - x * z * harmonics[i, 7])
        colour += 0.31539156525252005 * (2.0 * z * z - x * x - y * y) * harmonics[i, 6]
        colour += 0.5462742152960396 * (x * x - y * y) * harmonics[i, 8]
    if count > 9:
        colour += -0.5900435899266435 * y * (3.0 * x * x - y * y) * harmonics[i, 9]
        colour += 2.890611442640554 * x * y * z * harmonics[i, 10]
        colour += -0.4570457994644658 * y * (4.0 * z * z - x * x - y * y) * harmonics[i, 11]
        colour += 0.3731763325901154 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y) * harmonics[i, 12]
        colour += -0.4570457994644658 * x * (4.0 * z * z - x * x - y * y) * harmonics[i, 13]
        colour += 1.445305721320277 * z * (x * x - y * y) * harmonics[i, 14]
        colour += -0.5900435899266435 * x * (x * x - 3.0 * y * y) * harmonics[i, 15]
    return wp.max(colour, wp.vec3(0.0, 0.0, 0.0))


@wp.func
def tile_bounds(x: float, y: float, reach_x: float, reach_y: float, frame: Frame) -> wp.vec4i:
    """First and end of the columns, then of the rows, of the tiles with a pixel within reach; ends at 0 where none."""
    # Bounds far outside would not fit an integer.
    left = int(wp.ceil(wp.clamp(x - reach_x, -1.0, float(frame.width))))
    right = int(wp.floor(wp.clamp(x + reach_x, -1.0, float(frame.width))))
    top = int(wp.ceil(wp.clamp(y - reach_y, -1.0, float(frame.height))))
    bottom = int(wp.floor(wp.clamp(y + reach_y, -1.0, float(frame.height))))
    left = wp.max(left, 0)
    right = wp.min(right, frame.width - 1)
    top = wp.max(top, 0)
    bottom = wp.min(bottom, frame.height - 1)
    bounds = wp.vec4i(0, 0, 0, 0)
    if left <= right and top <= bottom:
        bounds = wp.vec4i(
            left / frame.tile, right / frame.tile + 1, top / frame.tile, bottom / frame.tile + 1
        )  # fmt: skip
    return bounds


@wp.kernel
def project(
    mean: wp.array[wp.vec3],
    rotation: wp.array[wp.vec4],
    scale: wp.array[wp.vec3],
    opacity: wp.array[float],
    harmonics: wp.array2d[wp.vec3],
    scene: SplatPoses,
    frame: Frame,
    place: wp.array[wp.vec4],
    shape: wp.array[wp.vec4],
    colour: wp.array[wp.vec3],
    bounds: wp.array[wp.vec4i],
    count: wp.array[int],
):
    """Project Gaussian i, mean (N,) and scale (N,) [m], rotation (N,) wxyz, harmonics (N, K), into an image.

    Writes, at image * N + i: pixel, depth [m] and opacity; the inverse covariance [1/px^2] (xx, xy, yy) and the
    exponent at which it is too faint; its colour; the tiles that it reaches, and how many these are.
    """
    image, i = wp.tid()
    cameras = scene.camera_pose.shape[1]
    world = image / cameras
    camera = image - world * cameras
    k = image * mean.shape[0] + i
    owner = scene.owner[i]

    # MuJoCo's camera looks along -z with y up; here z is forward and y down.
    flip = wp.mat33(1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0)
    to_camera = flip * wp.transpose(pose_matrix(scene.camera_pose, world, camera))
    of_object = pose_matrix(scene.object_pose, world, owner)
    origin = wp.vec3(0.0, 0.0, scene.ground)
    above = of_object * mean[i] + pose_position(scene.object_pose, world, owner) - origin
    if scene.light.shape[0] > 0:
        flat = flattening(scene.light[world, camera])
        of_object = flat * of_object
        above = flat * above
    turn = to_camera * of_object
    p = to_camera * (above + origin - pose_position(scene.camera_pose, world, camera))
    z = p[2]
    tiles = wp.int32(0)
    if z > MIN_DEPTH:
        fx = scene.pinhole[world, camera, 0]
        fy = scene.pinhole[world, camera, 1]
        cx = scene.pinhole[world, camera, 2]
        cy = scene.pinhole[world, camera, 3]
        beside_x = JACOBIAN_MARGIN * 0.5 * float(frame.width) / fx
        beside_y = JACOBIAN_MARGIN * 0.5 * float(frame.height) / fy
        u = wp.clamp(p[0] / z, -cx / fx - beside_x, (float(frame.width) - cx) / fx + beside_x)
        v = wp.clamp(p[1] / z, -cy / fy - beside_y, (float(frame.height) - cy) / fy + beside_y)
        q = rotation[i]
        axes = turn * matrix_of(q[0], q[1], q[2], q[3]) * wp.diag(scale[i])
        row_x = (fx / z) * (axes[0] - u * axes[2])
        row_y = (fy / z) * (axes[1] - v * axes[2])
        xx = wp.dot(row_x, row_x)
        xy = wp.dot(row_x, row_y)
        yy = wp.dot(row_y, row_y)
        # The determinant as a Lagrange identity: the difference of products would lose all digits of needles.
        normal = wp.cross(row_x, row_y)
        sharp = wp.dot(normal, normal)
        det = sharp + PIXEL_VARIANCE * (xx + yy) + PIXEL_VARIANCE * PIXEL_VARIANCE
        strength = opacity[i]
        if frame.antialias != 0:
            strength *= wp.sqrt(wp.max(sharp, 1.0e-12) / det)
        if strength > MIN_OPACITY:
            faint = wp.log(strength / MIN_OPACITY)
            x = fx * p[0] / z + cx
            y = fy * p[1] / z + cy
            reach = tile_bounds(
                x, y, wp.sqrt(2.0 * faint * (xx + PIXEL_VARIANCE)), wp.sqrt(2.0 * faint * (yy + PIXEL_VARIANCE)), frame
            )  # fmt: skip
            tiles = (reach[1] - reach[0]) * (reach[3] - reach[2])
            if tiles > 0:
                place[k] = wp.vec4(x, y, z, strength)
                shape[k] = wp.vec4((yy + PIXEL_VARIANCE) / det, -xy / det, (xx + PIXEL_VARIANCE) / det, faint)
                colour[k] = colour_seen(harmonics, i, wp.transpose(turn) * wp.normalize(p))
                bounds[k] = reach
    count[k] = tiles
