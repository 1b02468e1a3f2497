"""A fit to measured tosses, in small. The figures are those of `benchmarks/fit/cube_tosses.py`."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.fit import cube_tosses as benchmark
from benchmarks.fit import cube_tosses_data as tosses
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

DATA = Path(__file__).parents[3] / "shared" / "data" / "contactnets_cube"


@pytest.mark.skipif(not DATA.is_dir(), reason=f"the measured cube tosses are not at {DATA}")
def test_a_fit_to_measured_tosses_improves_unseen_ones_and_mends_the_size(tmp_path):
    document = benchmark.main(benchmark.Args(data=DATA, out=tmp_path, quick=True))
    assert len(document["results"]) == 2
    for found in document["results"]:
        assert not set(found["fitted_names"]) & set(found["judged_names"])
        assert found["window"]["after"] < 0.95 * found["window"]["before"]
        assert abs(found["edge"] / document["edge"] - 1) < 0.6 * abs(found["factor"] - 1)
    assert document["free_fall"] == pytest.approx(9.5, abs=0.1)
    assert document["resting_edge"] == pytest.approx(0.1025, abs=5e-4)
    assert json.loads((tmp_path / "data" / "fit_cube_tosses.json").read_text())["quick"]
    assert "A quick run" in (tmp_path / "fit_cube_tosses.md").read_text()
    assert (tmp_path / "data" / "fit_cube_tosses.png").stat().st_size < 200_000


def test_the_standing_width_is_that_of_the_planes_on_which_a_cube_stands():
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * 0.05
    sunk = np.array([[0.04, 0.01, 0.01], [-0.04, -0.01, 0.01]])
    position = np.concatenate([corners, sunk])
    n = len(position)
    cube = ContactGeometry(("cube",), np.zeros(n, int), position, np.full(n, 0.004), np.full(n, 0.1), np.full(n, 0.1))
    np.testing.assert_allclose(tosses.standing_widths(cube), 0.108)
