"""Data sets written to a disk that is full, for which a limit on the size of files stands in."""

import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest
from small_dataset import LAYOUT, write

from concent_warp.render.dataset.lerobot import LeRobotWriter
from concent_warp.render.dataset.robomimic import RobomimicWriter
from tests.forks import Forks

SCRIPT = """
    import resource, signal, sys
    from pathlib import Path
    sys.path.insert(0, sys.argv[4])
    from small_dataset import LAYOUT, write
    from concent_warp.errors import ConcentError
    from concent_warp.render.dataset.lerobot import LeRobotWriter
    from concent_warp.render.dataset.robomimic import RobomimicWriter
    writer = {"lerobot": LeRobotWriter, "robomimic": RobomimicWriter}[sys.argv[2]](Path(sys.argv[1]), LAYOUT)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]),) * 2)
    try:
        write(writer, range(2, 4))
        writer.finish()
    except (ConcentError, OSError) as error:
        print(type(error).__name__)
        sys.exit(2)
"""


@pytest.fixture(scope="module")
def forks() -> Iterator[Forks]:
    names = ("lerobot", "robomimic", "video")
    with Forks(*(f"concent_warp.render.dataset.{name}" for name in names)) as found:
        yield found


def files(folder: Path) -> dict[str, bytes]:
    """Return the content of the files of a data set that are not staged."""
    found = [path for path in folder.rglob("*") if path.is_file() and ".staging" not in path.parts]
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


@pytest.mark.parametrize("size", [0, 500, 2_000, 6_000])
@pytest.mark.parametrize("kind", ["robomimic", "lerobot"])
def test_a_full_disk_ends_in_an_error_and_the_data_set_can_be_continued(tmp_path, forks, kind, size):
    Writer = {"lerobot": LeRobotWriter, "robomimic": RobomimicWriter}[kind]
    writer = Writer(tmp_path, LAYOUT)
    write(writer, range(2))
    assert writer.finish() == 2
    before = files(tmp_path)
    place = str(Path(__file__).parent)
    done = forks.run(textwrap.dedent(SCRIPT), str(tmp_path), kind, str(size), place)
    assert done.returncode == 2, done.stderr
    assert {name: files(tmp_path)[name] for name in before} == before
    assert not [path for path in tmp_path.rglob("*partial*") if ".staging" not in path.parts]
    continued = Writer(tmp_path, LAYOUT)
    write(continued, [key for key in range(4) if not continued.has(key)])
    assert continued.finish() == 4
    assert not list(tmp_path.rglob("*partial*"))


VIDEO = """
    import resource, signal, sys
    from pathlib import Path
    import numpy as np
    from concent_warp.render.dataset.video import VideoWriter, join_videos
    folder, what, size = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (60, 64, 64, 3), dtype=np.uint8)

    def limit():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size,) * 2)

    def film(path):
        video = VideoWriter(path, 10, (64, 64))
        try:
            for image in images:
                video.add(image)
            video.close()
        finally:
            video.abandon()

    try:
        if what == "film":
            limit()
            film(folder / "film.mp4")
        else:
            film(folder / "part.mp4")
            limit()
            join_videos([folder / "part.mp4"] * 2, [60, 60], 10, folder / "film.mp4")
    except OSError as error:
        print(error)
        sys.exit(2)
"""


@pytest.mark.parametrize("size", [0, 1_000, 100_000])
@pytest.mark.parametrize("what", ["film", "join"])
def test_a_video_on_a_full_disk_is_an_error_and_no_crash(tmp_path, forks, what, size):
    done = forks.run(textwrap.dedent(VIDEO), str(tmp_path), what, str(size))
    assert (done.returncode, done.stderr) == (2, "")
    assert done.stdout == f"[Errno 27] File too large: '{tmp_path}/film.mp4'\n"
