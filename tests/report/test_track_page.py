"""The page of a tracked video, with a body that is lost for a while."""

from __future__ import annotations

import base64
import json
import re
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.perception.pinhole import Pinhole
from concent_warp.perception.tracking.cfg import SearchCfg
from concent_warp.perception.tracking.geometry.pose import moved, rotation_of, rotation_vector
from concent_warp.report.tracking.headline import headline
from concent_warp.report.tracking.series import relative_motion
from concent_warp.report.tracking.spans import lost_spans, state_spans
from tests.report.drawn_film import drawn, poses
from tests.report.test_report_browser import BROWSER, browse

HIDDEN, BLINK = slice(3, 6), 1
"""Frames in which something covers the block: a stretch, and a single one."""
HOSTILE = "</script><b>cam"
needs_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium to open the page with")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A tracked video of two cameras, the second slower, and its page."""
    truth, time = poses(13), 2.3 + np.arange(13) / 20
    film = drawn(truth, time, "put <it> & go")
    stream = film[0].image["camera"]
    rgb, depth = stream.rgb.copy(), stream.depth.copy()
    for rows in (HIDDEN, BLINK):
        rgb[rows], depth[rows] = 40, 0.3
    whole = replace(stream, rgb=rgb, depth=depth)
    slow = replace(stream, time=stream.time[::2], rgb=rgb[::2], depth=depth[::2])
    images = {"camera": whole, HOSTILE: slow}
    recording = replace(film, demonstrations=(replace(film[0], image=images),))
    moments: list[tuple[int, bool, int]] = []

    def watch(moment):
        lines = [moment.outlines(view)["block"] for _, view in moment.views if not moment.lost]
        moments.append((moment.number, moment.lost, len(lines)))

    cfg = cw.TrackCfg(search=SearchCfg(orientations=20, kept=2))  # quick
    tracked = cw.track(recording, cfg, pose={"block": truth[0]}, watch=watch)
    path = tmp_path_factory.mktemp("track") / "track.html"
    cw.write_track_report(path, recording, tracked, settings={"command": "concent track <video>"})
    return SimpleNamespace(recording=recording, tracked=tracked, path=path, truth=truth, moments=moments)


@pytest.fixture(scope="module")
def data(made):
    return embedded(made.path)


def embedded(path):
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', path.read_text(), re.S)
    assert found is not None
    return json.loads(found[1])


def unpacked(packed):
    return np.frombuffer(base64.b64decode(packed["data"]), dtype="<f4")


def test_each_moment_has_a_state_with_residuals_or_a_reason(made):
    track = made.tracked.track("block")
    quality = track.quality
    assert quality is not None
    states = np.array(quality.state)
    assert (states[HIDDEN] == "lost").all()
    assert states[BLINK] == "bridged"
    assert set(states[[0, 2, 11, 12]]) == {"tracked"}
    np.testing.assert_array_equal(states == "lost", track.lost)
    np.testing.assert_array_equal(states == "tracked", [not reason for reason in quality.reason])
    fitted = np.isin(states, ["tracked", "filled"])
    for values in (quality.depth_residual, quality.edge_residual, quality.agreement, quality.visible):
        np.testing.assert_array_equal(np.isfinite(values), fitted)
    assert 2e-4 < np.median(quality.depth_residual[fitted]) < 3e-3
    assert quality.agreement[fitted].min() > cw.TrackCfg().accept.min_agreement
    assert np.nanmax(quality.texture_residual) < 0.5
    assert track.cameras == ("camera", HOSTILE)


def test_who_watches_sees_every_moment_with_the_outlines_of_what_is_found(made):
    states = made.tracked.track("block").quality.state
    assert [number for number, _, _ in made.moments] == list(range(len(states)))
    assert [lost for _, lost, _ in made.moments] == [state != "tracked" for state in states]
    assert [count for _, _, count in made.moments][:3] == [2, 0, 2]


def test_the_page_stands_alone_and_names_cannot_break_it(made):
    text = made.path.read_text()
    markup = re.sub(r"<script.*?</script>", "", text, flags=re.S)
    assert not re.search(r"https?://|url\(|@import", text)
    assert not re.search(r"(src|href)\s*=", markup)
    assert "default-src 'none'" in text
    assert "[[" not in markup
    assert text.count("</script>") == 2
    assert "put &lt;it&gt; &amp; go" in text
    assert made.path.stat().st_size < 1_000_000


def test_the_headline_says_what_was_tracked_and_where_it_was_lost(made):
    track = made.tracked.track("block")
    (span,) = lost_spans(track)
    text = made.path.read_text()
    sentence = headline(made.tracked.tracks)
    assert re.search(r'id="verdict">“block” was tracked through demo_0: poses in (\d+) of 13 frames', text)
    lost = rf", from {span.start:.2f} to {span.end:.2f} s: {re.escape(span.reason)}.$"
    assert re.search(lost, sentence)
    assert span.start == pytest.approx(track.time[2:4].mean())
    assert [s.state for s in state_spans(track)].count("bridged") == 1
    whole = replace(track, pose=np.tile(np.eye(4), (13, 1, 1)), quality=None)
    assert headline([whole]).endswith("poses in all 13 frames. Never lost.")


def test_outlines_lie_on_the_edges_of_the_block_and_are_missing_where_it_is_lost(made, data):
    (demonstration,) = data["demonstrations"]
    stream = made.recording[0].image["camera"]
    shown = next(c for c in demonstration["cameras"] if c["name"] == "camera")["bodies"]["block"]
    track, camera = made.tracked.track("block"), Pinhole.of(stream)
    half = cw.Scene(made.recording.scene).model.geom("block").size
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    pairs = [(i, j) for i in range(8) for j in range(i) if np.count_nonzero(corners[i] - corners[j]) == 1]
    for t, (state, seen) in enumerate(zip(shown["state"], shown["seen"], strict=True)):
        assert (len(seen) == 0) == (state == "lost")
        ends = np.array(seen).reshape(-1, 2) / 10
        if not len(ends):
            continue
        places = camera.project(corners @ track.pose[t, :3, :3].T + track.pose[t, :3, 3])[0]
        lines = np.array([(places[i], places[j]) for i, j in pairs])
        along = lines[:, 1] - lines[:, 0]
        share = np.einsum("nlk,lk->nl", ends[:, None] - lines[:, 0], along) / (along**2).sum(axis=1)
        nearest = lines[:, 0] + np.clip(share, 0, 1)[..., None] * along
        assert np.linalg.norm(ends[:, None] - nearest, axis=2).min(axis=1).max() < 0.2


def test_images_are_the_frames_and_their_number_and_size_are_bounded(made, data, tmp_path):
    import cv2

    cameras = {c["name"]: c for c in data["demonstrations"][0]["cameras"]}
    assert {name: (len(c["images"]), c["total"]) for name, c in cameras.items()} == {
        "camera": (13, 13),
        HOSTILE: (7, 7),
    }
    stream = made.recording[0].image["camera"]
    image = cv2.imdecode(np.frombuffer(base64.b64decode(cameras["camera"]["images"][2]), np.uint8), cv2.IMREAD_COLOR)
    difference = image[..., ::-1].astype(float) - stream.rgb[2]
    assert image.shape == stream.rgb[2].shape
    assert np.abs(difference).mean() < 6
    few, small = tmp_path / "few.html", tmp_path / "small.html"
    cw.write_track_report(few, made.recording, made.tracked, cw.TrackReportCfg(max_frames=5, image_width=60))
    camera = next(c for c in embedded(few)["demonstrations"][0]["cameras"] if c["name"] == "camera")
    assert (len(camera["images"]), camera["total"], camera["width"]) == (5, 13, 240)
    assert camera["time"] == pytest.approx(stream.time[[0, 3, 6, 9, 12]])
    reduced = cv2.imdecode(np.frombuffer(base64.b64decode(camera["images"][0]), np.uint8), cv2.IMREAD_COLOR)
    assert reduced.shape == (45, 60, 3)
    bound = 10_000
    cw.write_track_report(small, made.recording, made.tracked, cw.TrackReportCfg(max_image_bytes=bound))
    size = sum(len(i) for c in embedded(small)["demonstrations"][0]["cameras"] for i in c["images"])
    whole = sum(len(i) for c in cameras.values() for i in c["images"])
    assert 0 < size <= bound < whole


def test_plots_have_pose_covariance_and_residuals_of_every_moment(made, data):
    track = made.tracked.track("block")
    (body,) = data["demonstrations"][0]["bodies"]
    x = unpacked(body["position_x"])
    np.testing.assert_array_equal(np.isfinite(x), ~track.lost)
    np.testing.assert_allclose(x, 1e3 * (track.pose[:, 0, 3] - track.pose[0, 0, 3]), atol=1e-4)
    std = 2 * np.degrees(np.sqrt(track.covariance[:, 5, 5]))
    np.testing.assert_allclose(unpacked(body["rotation_z_2std"]), std, rtol=1e-5)
    np.testing.assert_allclose(unpacked(body["depth"]), 1e3 * track.quality.depth_residual, rtol=1e-5)
    assert [body["reasons"][k] for k in body["reason"]] == list(track.quality.reason)
    assert data["min_agreement"] == 70


def test_rotations_go_on_beyond_half_a_turn_with_the_covariance_of_their_vector():
    axis, angles = np.array([0.6, 0.0, 0.8]), np.linspace(0, 1.5 * np.pi, 31)
    pose = np.tile(np.eye(4), (31, 1, 1))
    pose[:, :3, :3] = [rotation_of(a * axis) for a in angles]
    covariance = np.tile(np.diag([1e-6] * 3 + [1e-4, 2e-4, 3e-4]), (31, 1, 1))
    track = cw.BodyTrack("demo_0", "top", np.arange(31.0), pose, covariance, "none", True)
    _, rotation, found = relative_motion(track)
    np.testing.assert_allclose(rotation, angles[:, None] * axis, atol=1e-6)
    # Of a quarter turn, by small rotations of the pose.
    t = 10
    step = 1e-5
    columns = [rotation_vector(moved(pose[t], step * np.eye(6)[3 + k])[:3, :3]) - rotation[t] for k in range(3)]
    jacobian = np.array(columns).T / step
    np.testing.assert_allclose(found[t, 3:, 3:], jacobian @ covariance[t, 3:, 3:] @ jacobian.T, rtol=1e-3, atol=1e-8)


def test_what_was_not_tracked_is_refused(made, tmp_path):
    path, demonstration = tmp_path / "no.html", made.recording[0]
    stream = demonstration.image["camera"]
    with pytest.raises(cw.RecordingError, match="no tracks to show"):
        cw.write_track_report(path, made.recording, cw.Tracked(made.recording, ()))
    other = replace(made.recording, demonstrations=(replace(demonstration, name="demo_7"),))
    with pytest.raises(cw.RecordingError, match="no such demonstration"):
        cw.write_track_report(path, other, made.tracked)
    late = {**demonstration.image, "camera": replace(stream, time=stream.time + 0.5)}
    other = replace(made.recording, demonstrations=(replace(demonstration, image=late),))
    with pytest.raises(cw.RecordingError, match="not the one that was tracked"):
        cw.write_track_report(path, other, made.tracked)
    assert not path.exists()


USE = """<script>{
window.requestAnimationFrame = (draw) => setTimeout(() => draw(performance.now()), 16);
HTMLElement.prototype.setPointerCapture = () => {};
const kind = (type) => (type.startsWith("pointer") ? PointerEvent : Event);
const fire = (node, type, init = {}) => node.dispatchEvent(new (kind(type))(type, { bubbles: true, ...init }));
const lines = () => document.querySelectorAll(".screen path.tracked:not(.halo)").length;
const flags = () => [...document.querySelectorAll(".flag")].filter((f) => !f.hidden).map((f) => f.textContent);
const found = { screens: screens.length, lines: lines() };
const camera = document.getElementById("camera"); camera.value = "camera"; fire(camera, "change");
found.chosen = screens.length;
[...document.querySelectorAll("#spans button")].find((b) => b.textContent.includes(" lost")).click();
found.lost = [lines(), flags(), document.getElementById("states").textContent, state.time];
const tick = (id) => { const node = document.getElementById(id); node.checked = !node.checked; fire(node, "change"); };
const slider = document.getElementById("time"); slider.value = slider.min; fire(slider, "input");
tick("zoom"); found.window = screens[0].svg.getAttribute("viewBox").split(" ").map(Number); tick("zoom");
tick("outlines"); found.hidden = lines(); tick("outlines");
const chart = document.getElementById("chart-0"), box = chart.getBoundingClientRect();
fire(chart, "pointerdown", { clientX: box.left + box.width / 2 }); found.middle = state.time;
const strip = document.getElementById("strip").getBoundingClientRect();
fire(document.getElementById("strip"), "pointerdown", { clientX: strip.right - 2 }); found.end = state.time;
slider.value = slider.min; fire(slider, "input");
document.getElementById("play").click();
setInterval(() => { document.title = JSON.stringify({ ...found, later: state.time > 2.35 }); }, 100);
}</script>"""


@needs_browser
def test_controls_choose_the_moment_and_lost_is_visible_as_lost(made, tmp_path):
    page = tmp_path / "used.html"
    page.write_text(made.path.read_text().replace("</body>", USE + "</body>"))
    dom, messages = browse(page, tmp_path, "--window-size=1280,2600", "--dump-dom", "--virtual-time-budget=6000")
    assert messages == []
    assert 'data-ready="yes"' in dom
    title = re.search(r"<title>(.*?)</title>", dom, re.S)
    assert title is not None
    found = json.loads(title[1])
    track = made.tracked.track("block")
    lines, flags, words, time = found["lost"]
    assert (found["screens"], found["lines"] > 0, found["hidden"], found["chosen"]) == (2, True, 0, 1)
    assert (lines, flags) == (0, ["block: lost"])
    assert words == f"block: lost: {track.quality.reason[3]}"
    assert time == pytest.approx(track.time[3], abs=1e-3)
    assert 0 < found["window"][2] < 240
    assert found["middle"] == pytest.approx(track.time[[0, -1]].mean(), abs=0.03)
    assert found["end"] == pytest.approx(track.time[-1], abs=0.01)
    assert found["later"]
    charts = re.findall(r'id="chart-\d".*?</svg>', dom, re.S)
    assert len(charts) == 7
    for chart in charts:
        assert chart.count('class="span lost"') == 1
        assert 'class="line' in chart
        assert "NaN" not in chart
    assert [chart.count('class="area ') for chart in charts] == [3, 3, 0, 0, 0, 0, 0]


@needs_browser
@pytest.mark.parametrize("dark", [False, True])
def test_the_frame_is_drawn_below_the_outline(made, tmp_path, dark):
    import cv2

    picture = tmp_path / "page.png"
    scheme = ["--blink-settings=preferredColorScheme=0"] if dark else []
    _, messages = browse(made.path, tmp_path, "--window-size=1280,1000", f"--screenshot={picture}", *scheme)
    assert messages == []
    blue, green, red = np.moveaxis(cv2.imread(str(picture)).astype(int), -1, 0)
    outline = (green > 200) & (red < 110) & (blue < 190)
    assert outline.sum() > 300
    rows, columns = np.nonzero(outline)
    around = np.s_[rows.min() : rows.max(), columns.min() : columns.max()]
    grey = (np.abs(red - green) < 40) & (np.abs(green - blue) < 40) & (red > 20) & (red < 240)
    assert grey[around].sum() > 1000
    assert (red[5, 5] + green[5, 5] + blue[5, 5] < 150) == dark


@needs_browser
def test_the_track_page_fits_a_telephone(made, tmp_path):
    wrapper = tmp_path / "phone.html"
    probe = 'onload="document.title=this.contentDocument.documentElement.scrollWidth"'
    shutil.copy(made.path, tmp_path / "track.html")
    wrapper.write_text(f'<title>-</title><iframe src="track.html" style="width:390px;height:800px" {probe}></iframe>')
    dom, _ = browse(wrapper, tmp_path, "--dump-dom", "--allow-file-access-from-files")
    found = re.search(r"<title>(\d+)</title>", dom)
    assert found is not None
    assert int(found[1]) <= 390
