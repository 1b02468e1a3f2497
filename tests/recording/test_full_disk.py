"""Writing HDF5 to a disk that is full, for which a limit on the size of files stands in."""

import os
import textwrap
from collections.abc import Iterator

import pytest

from concent_warp.recording.formats.hdf5 import read_hdf5, write_hdf5
from tests.forks import Forks

SCRIPT = """
    import resource, signal, sys
    from dataclasses import replace
    from pathlib import Path
    from concent_warp.errors import ConcentError
    from concent_warp.recording.formats.hdf5 import read_hdf5, write_hdf5
    recording = read_hdf5(Path(sys.argv[1]))
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]),) * 2)
    try:
        write_hdf5(recording, Path(sys.argv[2]))
    except ConcentError as error:
        print(error)
        sys.exit(2)
"""


@pytest.fixture(scope="module")
def forks() -> Iterator[Forks]:
    with Forks("concent_warp.recording.formats.hdf5") as found:
        yield found


@pytest.mark.parametrize("size", [0, 1, 500, 2_000, 8_000, 20_000])
@pytest.mark.parametrize("old", [True, False])
def test_a_full_disk_is_reported_in_one_sentence_and_leaves_the_old_file(tmp_path, recording, forks, size, old):
    source, out = tmp_path / "source.h5", tmp_path / "out" / "recording.h5"
    out.parent.mkdir()
    write_hdf5(recording, source)
    assert source.stat().st_size > 20_000
    if old:
        write_hdf5(recording, out)
    before = out.read_bytes() if old else None
    done = forks.run(textwrap.dedent(SCRIPT), str(source), str(out), str(size))
    assert (done.returncode, done.stderr) == (2, "")
    assert done.stdout.startswith(f"{out}: the file cannot be written; found File too large; make room")
    assert len(done.stdout.splitlines()) == 1
    assert os.listdir(out.parent) == (["recording.h5"] if old else [])
    if old:
        assert out.read_bytes() == before
        read_hdf5(out)
