"""Training pairs of real camera images and simulated images at the same times.

The recording is of the robot alone, no objects on the table: objects are rendered by other means (paper, appendix E).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch

from concent_warp.errors import RenderError
from concent_warp.estimation.state_estimator import StateEstimator, StateEstimatorCfg
from concent_warp.model import Model
from concent_warp.recording.recording import Recording
from concent_warp.render.cameras import Camera, place_cameras
from concent_warp.render.raw import PosedWorlds, RawCamera
from concent_warp.scene.scene import Scene
from concent_warp.simulate.mujoco_engine import MujocoEngine


@dataclass(frozen=True)
class ImagePairs:
    """N frames of one camera."""

    camera: Camera
    real: torch.Tensor
    """What the camera saw, shape (N, 3, H, W) uint8."""
    simulated: torch.Tensor
    """What the simulation shows without the objects, same shape, uint8."""
    pose: torch.Tensor
    """Position [m] and two columns of the rotation of the body that carries the camera, shape (N, 9); zeros if none."""
    before: torch.Tensor
    """Number of the frame before each, -1 for the first of a demonstration, shape (N,) int64."""

    def __len__(self) -> int:
        return len(self.real)

    def to(self, device: str | torch.device) -> ImagePairs:
        """Return the pairs on a device."""
        tensors = (self.real, self.simulated, self.pose, self.before)
        return ImagePairs(self.camera, *(t.to(device) for t in tensors))


def camera_scene(scene: Scene, cameras: Sequence[Camera]) -> mujoco.MjModel:
    """Return a scene's model with cameras at their calibrated places."""
    spec = scene.spec()
    place_cameras(spec, cameras)
    return spec.compile()


def pairs_of(
    recording: Recording,
    cameras: Sequence[str] = (),
    *,
    device: str = "cpu",
    batch: int = 16,
    progress: Callable[[float], None] | None = None,
) -> list[ImagePairs]:
    """Return the pairs of each camera of a recording, at the size of its images.

    Args:
        recording: Demonstrations with images and the measured joints.
        cameras: Names of the cameras; all that every demonstration has by default.
        device: Warp's name of the device that renders.
        batch: States rendered at a time.
        progress: Called with the share done.

    Raises:
        RenderError: The recording has no such images, or a camera moved between demonstrations.
    """
    demonstrations = recording.demonstrations
    common = [name for name in demonstrations[0].image if all(name in d.image for d in demonstrations)]
    names = list(cameras) or common
    missing = sorted(set(names) - set(common))
    if not names or missing:
        raise RenderError(
            "the recording lacks images to learn from",
            where=recording.source,
            expected=f"the cameras {missing} in every demonstration" if names else "an image channel",
            found=common,
        )
    scene = Scene(recording.scene, source=recording.source)
    engine = MujocoEngine(Model(scene), threads=1)
    motions = [
        StateEstimator.of(Model(scene), d, StateEstimatorCfg("smoothing_spline"), engine=engine) for d in demonstrations
    ]
    found = []
    for c, name in enumerate(names):
        camera = Camera.of(name, demonstrations[0].image[name])
        streams = [d.image[name] for d in demonstrations]
        shape = streams[0].rgb.shape[1:]
        if any(Camera.of(name, stream) != camera or stream.rgb.shape[1:] != shape for stream in streams):
            raise RenderError("a camera is not the same in all demonstrations", where=recording.source, found=name)
        states = [m.states(np.clip(s.time, *m.span)).qpos for m, s in zip(motions, streams, strict=True)]
        qpos = np.concatenate(states)
        shown = None if progress is None else lambda share, c=c: progress((c + share) / len(names))
        simulated, pose = _rendered(scene, camera, streams[0].rgb.shape[1:3], qpos, device, batch, shown)
        real = torch.from_numpy(np.concatenate([s.rgb for s in streams])).permute(0, 3, 1, 2).contiguous()
        before = _frames_before([len(s.time) for s in streams])
        found.append(ImagePairs(camera, real, simulated, pose, before))
    return found


def _frames_before(lengths: Sequence[int]) -> torch.Tensor:
    """Return the number of the frame before each in demonstrations of these lengths, -1 for first ones, shape (N,)."""
    before = torch.arange(-1, sum(lengths) - 1)
    first = torch.tensor([sum(lengths[:k]) for k in range(len(lengths))])
    before[first] = -1
    return before


def _rendered(
    scene: Scene,
    camera: Camera,
    size: tuple[int, int],
    qpos: np.ndarray,
    device: str,
    batch: int,
    progress: Callable[[float], None] | None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return images (N, 3, H, W) uint8 of states (N, nq) without the objects, and poses (N, 9) of the camera's body."""
    model = camera_scene(scene, [camera])
    stage = PosedWorlds(model, batch, device=device)
    sensor = RawCamera(stage, [camera.name], size, leave_out=scene.objects())
    images = torch.zeros((len(qpos), 3, *size), dtype=torch.uint8)
    poses = torch.zeros(len(qpos), 9)
    for first in range(0, len(qpos), batch):
        rows = np.minimum(np.arange(first, first + batch), len(qpos) - 1)
        stage.place(qpos[rows])
        count = min(batch, len(qpos) - first)
        seen = to_bytes(sensor.render().rgb[:count, 0])
        images[first : first + count] = seen.permute(0, 3, 1, 2).cpu()
        poses[first : first + count] = carrier_pose(stage, camera)[:count].cpu()
        if progress is not None:
            progress((first + count) / len(qpos))
    return images, poses


def carrier_pose(stage: PosedWorlds, camera: Camera) -> torch.Tensor:
    """Return position [m] and two columns of the rotation of the body that carries a camera, shape (W, 9).

    Zeros for a camera that is fixed in the world.
    """
    if camera.body is None:
        return torch.zeros(stage.worlds, 9, device=stage.qpos.device)
    body = stage.model.body(camera.body).id
    return torch.cat([stage.position[:, body], _columns(stage.quaternion[:, body])], dim=1)


def _columns(quaternion: torch.Tensor) -> torch.Tensor:
    """Return the first two columns of the rotations of unit quaternions wxyz (N, 4), shape (N, 6)."""
    w, x, y, z = quaternion.unbind(-1)
    first = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], dim=-1)
    second = torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], dim=-1)
    return torch.cat([first, second], dim=-1)


def to_bytes(colour: torch.Tensor) -> torch.Tensor:
    """Return colours 0..1 as uint8."""
    return (255 * colour.clamp(0, 1)).round().to(torch.uint8)


def to_signed(image: torch.Tensor) -> torch.Tensor:
    """Return uint8 images as numbers in -1..1."""
    return image.float() / 127.5 - 1
