"""Arrays on a full disk, for which a limit on the size of files stands in."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from concent_warp.array_file import read_arrays, write_arrays
from concent_warp.errors import ConcentError, ModelError

SCRIPT = """
    import resource, signal, sys
    import numpy as np
    from pathlib import Path
    from concent_warp.array_file import write_arrays
    from concent_warp.errors import ConcentError
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
    try:
        write_arrays(Path(sys.argv[1]), {"a": np.random.rand(5000), "b": np.zeros(3)}, compressed=True)
    except ConcentError as error:
        print(error)
        sys.exit(2)
"""


@pytest.mark.parametrize("size", [0, 20, 5_000, 30_000])
def test_a_full_disk_is_said_in_one_sentence_and_leaves_the_old_file(tmp_path, size):
    path = tmp_path / "a.npz"
    write_arrays(path, {"a": np.arange(3.0), "b": np.array(["x"])})
    before = path.read_bytes()
    command = [sys.executable, "-c", textwrap.dedent(SCRIPT), str(path), str(size)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (2, "")
    assert done.stdout.startswith(f"{path}: the file cannot be written; found File too large")
    assert len(done.stdout.splitlines()) == 1
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.npz"]


def test_what_was_written_is_read(tmp_path):
    write_arrays(tmp_path / "a.npz", {"a": np.arange(3.0), "b": np.array(["x"])}, compressed=True)
    found = read_arrays(tmp_path / "a.npz", ("a",))
    assert list(found) == ["a"]
    assert found["a"].tolist() == [0, 1, 2]
    with pytest.raises(ModelError, match=r"a\.npz: not a thing; found .*gone"):
        read_arrays(tmp_path / "a.npz", ("gone",), kind="a thing", error=ModelError)


def test_a_device_is_not_written_to():
    with pytest.raises(ConcentError, match="/dev/full: not a file"):
        write_arrays(Path("/dev/full"), {"a": np.zeros(3)})
