"""Make the picture of the page on tracking: a video of the grasp in which something hides the block for a while.

    python docs/images/track_page.py      # two minutes on two cores; needs Chromium

Writes track_page.webp beside this script, and the page itself where --page says.
"""

import shutil
import subprocess
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import tyro
from PIL import Image

import concent_warp as cw
from benchmarks.perception.track import SETS, film

HERE = Path(__file__).parent
SEED = 1000
HIDDEN = slice(16, 22)
"""Frames, 20 a second, in which a sheet of cardboard is held before the block."""
SHEET = (slice(120, 330), slice(180, 420))
"""Rows and columns that it covers [px]."""
COLOUR, DEPTH = (175, 120, 95), 0.55
"""Its colour and its distance [m]."""
SIZE, SHOWN = (1280, 1180), 2.62
"""Width and height of the picture [px], and the time at which the page is opened [s]."""
QUALITY = 82
"""Quality of the WebP compression."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    page: Path | None = None
    """Where the page is kept."""


def hidden_for_a_while(recording: cw.Recording) -> cw.Recording:
    """Return a recording with the sheet before the block."""
    stream = recording[0].image["camera"]
    rgb, depth = stream.rgb.copy(), stream.depth.copy()
    rgb[HIDDEN][:, *SHEET], depth[HIDDEN][:, *SHEET] = COLOUR, DEPTH
    demonstration = replace(recording[0], image={"camera": replace(stream, rgb=rgb, depth=depth)})
    return replace(recording, demonstrations=(demonstration,))


def photograph(page: Path, folder: Path) -> Path:
    """Return a picture of a page in a browser, taken at a time of its video."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    opened, picture = folder / "opened.html", folder / "picture.png"
    script = f"<script>setTime({SHOWN})</script></body>"
    opened.write_text(page.read_text().replace("</body>", script))
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--virtual-time-budget=4000"]
    flags += [f"--user-data-dir={folder / 'profile'}", f"--window-size={SIZE[0]},{SIZE[1]}"]
    subprocess.run([browser, *flags, f"--screenshot={picture}", f"file://{opened}"], check=True, capture_output=True)
    return picture


def main(args: Args) -> None:
    """Film, track, write the page and photograph it."""
    recording = hidden_for_a_while(film(SEED, SETS["textured"]).recording)
    tracked = cw.track(recording)
    print(tracked.tracks[0].sentence())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        page = args.page or folder / "track.html"
        settings = {"command": "concent track video.h5 -o tracked.h5 --report track.html"}
        cw.write_track_report(page, replace(recording, source="video.h5"), tracked, settings=settings)
        print(f"page: {page.stat().st_size / 1e6:.2f} MB")
        Image.open(photograph(page, folder)).convert("RGB").save(HERE / "track_page.webp", quality=QUALITY, method=6)


if __name__ == "__main__":
    main(tyro.cli(Args))
