"""Messages of ROS as numbers with names and images as arrays.

Which types are read, and what their numbers are called below the topic:

| type | names |
|---|---|
| sensor_msgs/JointState | position/<joint>, velocity/<joint>, effort/<joint> |
| trajectory_msgs/JointTrajectory | position/<joint>, velocity/<joint>, at the times of its points |
| std_msgs/Float32, Float64, Int32, ... | data |
| std_msgs/Float32MultiArray, Float64MultiArray | data/0, data/1, ... |
| geometry_msgs/PoseStamped, TransformStamped | position/x .. z, orientation/w .. z |
| geometry_msgs/WrenchStamped | force/x .. z, torque/x .. z |
| geometry_msgs/TwistStamped | linear/x .. z, angular/x .. z |
| sensor_msgs/Imu | acceleration/x .. z, angular_velocity/x .. z, orientation/w .. z |
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any

import numpy as np

from concent_warp.errors import RecordingError

SCALARS = ("Float32", "Float64", "Int8", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32", "Bool")
ARRAYS = tuple(f"{name}MultiArray" for name in ("Float32", "Float64", "Int16", "Int32"))
POSES = ("PoseStamped", "TransformStamped")
COLOURS = {"rgb8": (3, (0, 1, 2)), "bgr8": (3, (2, 1, 0)), "rgba8": (4, (0, 1, 2)), "bgra8": (4, (2, 1, 0))}
"""Channels of a pixel, and which of them are red, green and blue, by encoding."""
NUMBERS = ("JointState", "JointTrajectory", *SCALARS, *ARRAYS, *POSES, "WrenchStamped", "TwistStamped", "Imu")
"""Types of messages that `samples` reads."""
GREY = ("mono8", "8UC1")
DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
COMPRESSED_DEPTH_HEADER = 12
"""Bytes before the PNG of a compressedDepth image: its kind, and two numbers of its quantisation."""
Sample = tuple[float | None, dict[str, float]]
"""Time after the stamp [s] and numbers by their names."""


def short_type(msgtype: str) -> str:
    """Return the name of a message type without its package."""
    return msgtype.rpartition("/")[2]


def stamp_of(message: Any) -> float | None:
    """Return the stamp of a message's header [s]; None without a header, or where the stamp is 0."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return None if stamp is None else _seconds(stamp) or None


def samples(kind: str, message: Any) -> Iterator[Sample]:
    """Return the samples of a message of a type in `NUMBERS`.

    The time of a sample is relative to the message's stamp.
    """
    if kind == "JointState":
        return iter([(None, _joints(message))])
    if kind == "JointTrajectory":
        return _trajectory(message)
    if kind in SCALARS:
        return iter([(None, {"data": float(message.data)})])
    if kind in ARRAYS:
        return iter([(None, {f"data/{k}": float(value) for k, value in enumerate(message.data)})])
    if kind in POSES:
        return iter([(None, pose_numbers(message.pose if kind == "PoseStamped" else message.transform))])
    if kind == "WrenchStamped":
        wrench = message.wrench
        return iter([(None, _xyz("force", wrench.force) | _xyz("torque", wrench.torque))])
    if kind == "TwistStamped":
        twist = message.twist
        return iter([(None, _xyz("linear", twist.linear) | _xyz("angular", twist.angular))])
    found = _xyz("acceleration", message.linear_acceleration)
    found |= _xyz("angular_velocity", message.angular_velocity)
    return iter([(None, found | _quaternion(message.orientation))])


def pose_numbers(pose: Any) -> dict[str, float]:
    """Return the numbers of a pose or transform by their names."""
    place = pose.position if hasattr(pose, "position") else pose.translation
    turn = pose.orientation if hasattr(pose, "orientation") else pose.rotation
    return _xyz("position", place) | _quaternion(turn)


def is_depth(kind: str, message: Any) -> bool:
    """Return whether an image is one of depths.

    Raises:
        RecordingError: Its encoding is not read.
    """
    if kind == "CompressedImage":
        form = message.format.lower()
        return "compresseddepth" in form or "16uc1" in form or "32fc1" in form
    encoding = message.encoding
    if encoding in DEPTHS:
        return True
    if encoding in COLOURS or encoding in GREY:
        return False
    known = [*COLOURS, *GREY, *DEPTHS]
    raise RecordingError("an image has an encoding that is not read", expected=f"one of {known}", found=repr(encoding))


def decoded(kind: str, message: Any) -> np.ndarray:
    """Return an image: colours, shape (H, W, 3) uint8, or depths (H, W), uint16 [mm] or float32 [m].

    Raises:
        RecordingError: Its data are not those of an image.
    """
    return _uncompressed(message) if kind == "CompressedImage" else _raw(message)


def _raw(message: Any) -> np.ndarray:
    """Return the pixels of a sensor_msgs/Image."""
    encoding, height, width = message.encoding, message.height, message.width
    channels, order = COLOURS.get(encoding, (1, (0, 0, 0)))
    kind = np.dtype(DEPTHS.get(encoding, "u1")).newbyteorder(">" if message.is_bigendian else "<")
    row = width * channels * kind.itemsize
    data = np.ascontiguousarray(message.data, dtype=np.uint8)
    step = message.step or row
    if height * width == 0 or step < row or data.size < step * height:
        raise RecordingError(
            "an image is not as large as it says", expected=f"{height} rows of {row} bytes", found=f"{data.size} bytes"
        )
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :row])
    pixels = rows.view(kind)
    if encoding in DEPTHS:
        return pixels.astype(kind.newbyteorder("="))
    return np.ascontiguousarray(pixels.reshape(height, width, channels)[..., order])


def _uncompressed(message: Any) -> np.ndarray:
    """Return the pixels of a sensor_msgs/CompressedImage: JPEG or PNG, or a compressedDepth PNG."""
    import cv2

    data = np.ascontiguousarray(message.data, dtype=np.uint8)
    form = message.format.lower()
    header = COMPRESSED_DEPTH_HEADER if "compresseddepth" in form else 0
    image = cv2.imdecode(data[header:], cv2.IMREAD_UNCHANGED) if data.size > header else None
    if image is None:
        raise RecordingError("a compressed image cannot be decoded", expected="JPEG or PNG", found=repr(message.format))
    if image.ndim == 2 and image.dtype == np.uint16:
        if "32fc1" not in form:
            return image
        # Inverse depths, quantised: code = a / depth + b (compressed_depth_image_transport).
        a, b = struct.unpack("<ff", data[4:COMPRESSED_DEPTH_HEADER].tobytes())
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(image > 0, a / (image - b), 0).astype(np.float32)
    if image.dtype != np.uint8:
        raise RecordingError("a compressed image is no image of colours or depths", found=str(image.dtype))
    return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB)


def _joints(message: Any) -> dict[str, float]:
    """Return the numbers of a JointState; arrays may be empty."""
    found: dict[str, float] = {}
    for quantity in ("position", "velocity", "effort"):
        values = getattr(message, quantity)
        if len(values) == len(message.name):
            found |= {f"{quantity}/{name}": float(v) for name, v in zip(message.name, values, strict=True)}
    return found


def _trajectory(message: Any) -> Iterator[Sample]:
    """Yield the points of a JointTrajectory."""
    for point in message.points:
        found: dict[str, float] = {}
        for quantity, values in (("position", point.positions), ("velocity", point.velocities)):
            if len(values) == len(message.joint_names):
                named = zip(message.joint_names, values, strict=True)
                found |= {f"{quantity}/{name}": float(value) for name, value in named}
        yield _seconds(point.time_from_start), found


def _seconds(time: Any) -> float:
    """Return a time of ROS 1 or 2 [s]."""
    return float(time.sec) + 1e-9 * float(time.nanosec)


def _xyz(name: str, vector: Any) -> dict[str, float]:
    """Return the components of a vector by their names."""
    return {f"{name}/{axis}": float(getattr(vector, axis)) for axis in "xyz"}


def _quaternion(turn: Any) -> dict[str, float]:
    """Return the components of a quaternion by their names, w first."""
    return {f"orientation/{axis}": float(getattr(turn, axis)) for axis in "wxyz"}
