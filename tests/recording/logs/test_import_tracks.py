"""Tracks of video and motion capture: numbers of frames, components that were not measured, one table a body."""

import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.recording.logs.import_log import import_log
from concent_warp.recording.logs.log_map import read_map
from concent_warp.recording.logs.suggest import suggest_map

SCENE = """<mujoco><worldbody><body name="ball" pos="0 0 1"><freejoint/><geom size="0.02"/></body>
<body name="cup" pos="0 0 2"><freejoint/><geom size="0.02"/></body></worldbody>
<sensor><framepos name="ball_position" objtype="xbody" objname="ball"/>
<framepos name="cup_position" objtype="xbody" objname="cup"/>
<framequat name="cup_orientation" objtype="xbody" objname="cup"/></sensor></mujoco>"""
HEIGHT = '[measured.ball_position]\nsource = ["", "", "height_mm"]\nunit = "mm"\n'
TIME = np.arange(40) / 240


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "map.toml").write_text(HEIGHT + '[clock]\n"*" = { rate = 240 }\n')
    rows = [f"{k + 7},{1000 - 4905 * t**2:.3f}" for k, t in enumerate(TIME) if k != 5]
    (tmp_path / "fall.csv").write_text("Frame #,height_mm\n" + "\n".join(rows))
    return tmp_path


def test_numbers_of_frames_are_times_where_there_are_no_others(folder):
    (d,) = import_log(folder / "fall.csv", folder / "scene.xml", mapping=folder / "map.toml").demonstrations
    channel = d.measured["ball_position"]
    np.testing.assert_allclose(channel.time, np.delete(TIME, 5), atol=1e-9)
    np.testing.assert_allclose(channel.value[:, 2], 1 - 4.905 * channel.time**2, atol=1e-5)
    assert np.isnan(channel.value[:, :2]).all()


def test_numbers_of_frames_need_a_rate(folder):
    (folder / "map.toml").write_text(HEIGHT)
    with pytest.raises(RecordingError, match=r'look like numbers of frames.*\[clock\] "height_mm" = \{ rate = FRAMES'):
        import_log(folder / "fall.csv", folder / "scene.xml", mapping=folder / "map.toml")
    assert '# "*" = { rate = ? }' in suggest_map(folder / "fall.csv", folder / "scene.xml")
    (folder / "fall.csv").write_text("frame,t,height_mm\n7,0.1,3\n8,0.2,4\n")
    (d,) = import_log(folder / "fall.csv", folder / "scene.xml", mapping=folder / "map.toml").demonstrations
    np.testing.assert_allclose(d.measured["ball_position"].time, [0, 0.1])


@pytest.mark.parametrize(
    ("source", "sentence"),
    [
        ('[measured.ball_position]\nsource = ["", "", ""]', "source is not right"),
        ('[measured.ball_position]\nsource = ""', "source is not right"),
        ('[action.a]\nsource = [""]', "source is not right"),
        ('[measured.ball_position]\nsource = ["", "height_mm"]', "wrong number of channels"),
        ('[measured.cup_orientation]\nsource = ["height_mm", "", "", ""]', "a quaternion is whole or missing"),
    ],
)
def test_components_that_cannot_be_left_out_are_refused(folder, source, sentence):
    (folder / "map.toml").write_text(f'{source}\n[clock]\n"*" = {{ rate = 240 }}\n')
    with pytest.raises(RecordingError, match=sentence):
        import_log(folder / "fall.csv", folder / "scene.xml", mapping=read_map(folder / "map.toml"))


def test_tables_named_after_bodies_are_one_episode_though_their_columns_are_the_same(folder):
    track = folder / "track"
    track.mkdir()
    for name, start in (("ball", 1), ("cup", 2)):
        rows = [f"{t:.4f},{100 * t:.2f},{1000 * start - 4905 * t**2:.2f}" for t in TIME]
        (track / f"{name}.csv").write_text("time;X_mm;Z_mm\n".replace(";", ",") + "\n".join(rows))
    text = suggest_map(track, folder / "scene.xml")
    assert 'source = ["ball/X_mm", "", "ball/Z_mm"]\nunit = "mm"\n' in text
    assert "[measured.cup_position]  # guess: not all components are in the log" in text
    (folder / "map.toml").write_text(text)
    (d,) = import_log(track, folder / "scene.xml", mapping=folder / "map.toml").demonstrations
    assert d.measured["ball_position"].value[0, 2] == pytest.approx(1)
    assert d.measured["cup_position"].value[0, 2] == pytest.approx(2)
    (folder / "map.toml").write_text('[measured.ball_position]\nsource = ["X_mm", "", "Z_mm"]\nunit = "mm"\n')
    assert len(import_log(track, folder / "scene.xml", mapping=folder / "map.toml").demonstrations) == 2
