"""Make the two animations of the README: a fitted replay beside the unfitted one, and the whole task in Reality.

    make demo
    python docs/images/animations.py runs/demo      # two to three minutes on two cores

Writes fit.webp, policy.webp and, five pictures of the latter, pick_align_insert.png beside this script. Images are
traced by MuJoCo-Warp on the CPU: no display is needed.
"""

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import av
import numpy as np
from PIL import Image, ImageDraw

import concent_warp as cw
from concent_warp.render.raw import PosedWorlds, RawCamera
from concent_warp.scene.cameras import add_camera

HERE = Path(__file__).parent
SIZE = (300, 400)
"""Height and width of one picture [px]."""
EYE, TARGET = (0.82, -0.30, 0.25), (0.48, -0.01, 0.06)
"""Where the camera of the replays stands and what it looks at [m]."""
RATE = 12.5
"""Pictures a second of the replays."""
SHOWN = (0.5, 0.65, 0.75, 0.88, 1.0)
"""Times of the pictures of an episode, as shares of its duration."""


def replayed_images(model: cw.Model, recording: cw.Recording, times: np.ndarray) -> list[Image.Image]:
    """Return pictures of a replay of the first demonstration, spheres shown in place of the objects.

    Args:
        model: Model with contact geometry.
        recording: Holds the commands.
        times: Times of the pictures [s], shape (T,).
    """
    rollout = cw.replay(model, recording)[recording.demonstrations[0].name].numpy()
    spec = model.spec()
    add_camera(spec.worldbody, "close", EYE, TARGET, up=(0, 0, 1), fovy=36)
    worlds = PosedWorlds(spec.compile(), 1)
    camera = RawCamera(worlds, ["close"], SIZE, objects="spheres")
    images = []
    for time in times:
        worlds.place(rollout.qpos[0, np.abs(rollout.time - time).argmin()][None])
        seen = camera.render()
        rgb = np.where(seen.segmentation[0, 0, :, :, None].numpy() < 0, 0.85, seen.rgb[0, 0].numpy())
        images.append(picture(rgb))
    return images


def picture(rgb: np.ndarray) -> Image.Image:
    """Return a picture of colours 0..1, shape (H, W, 3)."""
    return Image.fromarray((np.clip(rgb, 0, 1) * 255).astype(np.uint8))


def side_by_side(columns: dict[str, Sequence[Image.Image]]) -> list[Image.Image]:
    """Return pictures with a title over each column."""
    frames = []
    for images in zip(*columns.values(), strict=True):
        width, height = images[0].size
        frame = Image.new("RGB", (width * len(images) + 4, height + 22), "white")
        draw = ImageDraw.Draw(frame)
        for k, (title, image) in enumerate(zip(columns, images, strict=True)):
            frame.paste(image, (k * (width + 4), 22))
            draw.text((k * (width + 4) + 6, 3), title, fill="black", font_size=14)
        frames.append(frame)
    return frames


def write(path: Path, frames: Sequence[Image.Image], rate: float) -> None:
    """Write an endless animation; the last picture stays for a second and a half."""
    lengths = [round(1000 / rate)] * (len(frames) - 1) + [1500]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=lengths, loop=0, quality=60, method=6)
    print(f"wrote {path.name}: {len(frames)} pictures, {path.stat().st_size / 2**20:.2f} MiB")


def fit(folder: Path) -> None:
    """Write the replays of a run of `concent demo` before and after its fit."""
    recording = cw.load_recording(folder / "demo.h5")
    times = np.arange(0, recording.demonstrations[0].duration, 1 / RATE)
    titles = {"before the fit": "start.toml", "after the fit": "model.toml"}
    columns = {t: replayed_images(cw.load_model(folder / file), recording, times) for t, file in titles.items()}
    write(HERE / "fit.webp", side_by_side(columns), 2 * RATE)


def policy() -> None:
    """Write an episode of the policy of the whole task in Reality."""
    with tempfile.TemporaryDirectory() as folder:
        cfg = cw.EvaluateCfg(videos=1)
        found = cw.evaluate(cw.load_policy("pick_align_insert"), cfg, episodes=1, out=folder)
        with av.open(str(found.videos[0])) as video:
            every = [frame.to_image() for frame in video.decode(video=0)]
            rate = float(video.streams.video[0].average_rate or RATE)
    keep = every[:: max(round(rate / RATE), 1)]
    height = SIZE[0] + 22
    small = [image.resize((round(image.width * height / image.height), height)) for image in keep]
    write(HERE / "policy.webp", small, 2 * RATE)
    shown = [every[round(share * (len(every) - 1))] for share in SHOWN]
    width, height = shown[0].size
    strip = Image.new("RGB", (len(shown) * (width + 4) - 4, height), "white")
    for k, image in enumerate(shown):
        strip.paste(image, (k * (width + 4), 0))
    strip.save(HERE / "pick_align_insert.png")


if __name__ == "__main__":
    fit(Path(sys.argv[1]))
    policy()
