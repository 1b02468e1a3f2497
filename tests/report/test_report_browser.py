import json
import os
import re
import shutil
import subprocess

import numpy as np
import pytest

from concent_warp.report.opening import first_demonstration, openings

BROWSER = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
pytestmark = pytest.mark.skipif(BROWSER is None, reason="no Chromium to open the report with")
FLAGS = [
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update", "--hide-scrollbars"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--enable-logging=stderr", "--virtual-time-budget=3000"),
]


def browse(page, folder, *flags):
    """Open a page; return standard output and the messages of its console."""
    command = [BROWSER, *FLAGS, f"--user-data-dir={folder / 'profile'}", *flags, f"file://{page}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env={**os.environ, "HOME": str(folder)})
    messages = [line for line in done.stderr.splitlines() if ":CONSOLE:" in line and "GL Driver Message" not in line]
    return done.stdout, messages


@pytest.fixture(scope="module")
def opened(case, tmp_path_factory):
    return browse(case.path, tmp_path_factory.mktemp("dom"), "--window-size=1200,2600", "--dump-dom")


def test_the_console_is_silent_and_the_scripts_come_to_their_end(opened):
    dom, messages = opened
    assert messages == []
    assert 'data-ready="yes"' in dom


def test_the_page_opens_on_the_channel_farthest_above_its_noise_at_its_largest_error(opened, case):
    dom, _ = opened
    found = openings(case.comparison, ["demo_0", "demo_1"])
    expected = found[first_demonstration(found)]
    assert re.search(r'id="errors-title">Error of (\S+) \[', dom)[1] == expected.channel
    assert re.search(r'id="clock">([\d.]+) s', dom)[1] == f"{expected.time:.2f}"


def test_charts_are_drawn_with_phases_noise_floor_and_every_model(opened, case):
    dom, _ = opened
    chart = re.search(r'id="errors".*?</svg>', dom, re.S)[0]
    assert [chart.count(f'class="line {kind}"') for kind in ("before", "null", "after")] == [1, 1, 1]
    assert 'class="noise"' in chart
    bands = re.findall(r'class="band band\d"', chart)
    assert len(bands) == len(case.comparison.phases["demo_0"])
    for path in re.findall(r'class="line \w+" d="([^"]*)"', chart):
        assert path.count("L") > 50
        assert "NaN" not in path
    assert 'class="place"' in chart
    schedule = re.search(r'id="schedule".*?</svg>', dom, re.S)[0]
    assert "block · stop" in schedule
    assert 'class="target"' in schedule
    assert 'class="line held"' in re.search(r'id="fit-chart".*?</svg>', dom, re.S)[0]


def test_the_timeline_has_a_strip_for_each_channel_and_model_and_marks_the_worst_places(opened, case):
    dom, _ = opened
    timeline = re.search(r'id="timeline".*?</svg>', dom, re.S)[0]
    channels = [c for c in case.comparison.channels if case.comparison.summarise("after", c).noise]
    assert timeline.count('class="strip"') == 2 * len(channels)
    assert len(set(re.findall(r'class="(heat\d)"', timeline))) >= 4
    assert timeline.count('class="place"') == timeline.count('class="badge-mark"') >= 1
    levels = [int(level) for level in re.findall(r'class="heat(\d)"', timeline)]
    assert max(levels) == 6
    assert "NaN" not in timeline


def test_the_bars_of_a_diagnosis_stand_at_their_gains(case, tmp_path):
    probe = """<script>
    document.title = JSON.stringify([...document.querySelectorAll("#diagnosis .effect")].map((row) => {
      const box = (kind) => row.querySelector(kind).getBoundingClientRect(), zero = box(".zero").left;
      return [box(".gain").left - zero, box(".gain").right - zero, box(".track").width]; }))</script>"""
    page = tmp_path / "bars.html"
    page.write_text(case.path.read_text().replace("</body>", probe + "</body>"))
    dom, messages = browse(page, tmp_path, "--window-size=1200,2600", "--dump-dom")
    assert messages == []
    rows = json.loads(re.search(r"<title>(.*?)</title>", dom)[1])
    scale = 0.72 / rows[0][2]
    assert [right * scale for _, right, _ in rows[:2]] == pytest.approx([0.5, 0.48], abs=0.01)
    assert rows[2][0] * scale == pytest.approx(-0.02, abs=0.005)


@pytest.mark.parametrize("dark", [False, True])
def test_the_3d_views_show_robot_block_and_moved_spheres(case, tmp_path, dark):
    import cv2

    picture = tmp_path / "page.png"
    scheme = ["--blink-settings=preferredColorScheme=0"] if dark else []
    _, messages = browse(case.path, tmp_path, "--window-size=1200,3200", f"--screenshot={picture}", *scheme)
    assert messages == []
    image = cv2.imread(str(picture)).astype(int)
    blue, green, red = np.moveaxis(image, -1, 0)
    orange = (red > 120) & (red > 1.4 * green) & (green > 1.4 * blue)
    moved = (red > 150) & (red > 2.2 * green) & (red > 3.5 * blue)
    assert orange.sum() > 3000
    assert moved.sum() > 3000
    paper = image[5, 5].sum()
    assert (paper < 150) == dark


def test_the_page_fits_a_telephone(case, tmp_path):
    wrapper = tmp_path / "phone.html"
    probe = 'onload="document.title=this.contentDocument.documentElement.scrollWidth"'
    shutil.copy(case.path, tmp_path / "report.html")
    wrapper.write_text(f'<title>-</title><iframe src="report.html" style="width:390px;height:800px" {probe}></iframe>')
    dom, _ = browse(wrapper, tmp_path, "--dump-dom", "--allow-file-access-from-files")
    assert int(re.search(r"<title>(\d+)</title>", dom)[1]) <= 390


# Frames come from timers, which virtual time drives: a loaded machine draws none before the budget is used up.
USE = """<script>{
window.requestAnimationFrame = (draw) => setTimeout(() => draw(performance.now()), 16);
const made = (type, init) => new (type.startsWith("pointer") ? PointerEvent : Event)(type, { bubbles: true, ...init });
const fire = (node, type, init = {}) => node.dispatchEvent(made(type, init));
const choose = (id, value) => { const node = document.getElementById(id); node.value = value; fire(node, "change"); };
const tick = (id) => { const node = document.getElementById(id); node.checked = !node.checked; fire(node, "change"); };
const canvas = document.getElementById("replay-0");
HTMLElement.prototype.setPointerCapture = () => {};
const azimuth = replayCamera.azimuth, distance = replayCamera.distance;
fire(canvas, "pointerdown", { pointerId: 1, clientX: 100, clientY: 100, buttons: 1 });
fire(canvas, "pointermove", { pointerId: 1, clientX: 160, clientY: 120, buttons: 1 });
const turned = replayCamera.azimuth !== azimuth;
fire(canvas, "pointerdown", { pointerId: 2, clientX: 260, clientY: 120 });
fire(canvas, "pointermove", { pointerId: 2, clientX: 360, clientY: 120 });
const zoomed = replayCamera.distance < distance;
fire(canvas, "pointerup", { pointerId: 1 }); fire(canvas, "pointerup", { pointerId: 2 });
const place = data.places[data.places.length - 1], button = document.querySelector(`[data-place="${place.number}"]`);
button.click();
const went = state.demonstration.name === place.demonstration && state.time === place.peak;
const red = replayViews.map((view) => view.draw().filter((item) => item.colour[0] === COLOURS.place[0]).length);
const strip = document.querySelectorAll("#timeline .hit")[1], box = strip.getBoundingClientRect();
fire(strip, "pointerdown", { clientX: box.left + box.width / 2 });
const halfway = Math.abs(state.time - state.demonstration.duration / 2) < 0.02;
choose("demonstration", "demo_1"); choose("channel", "rail"); choose("follow", ""); choose("body", "stop");
["log", "ghost", "spheres", "arrows", "hull", "mark"].forEach(tick);
const slider = document.getElementById("time"); slider.value = 0.3; fire(slider, "input");
const [clock, title] = ["clock", "errors-title"].map((id) => document.getElementById(id).textContent);
const chart = document.getElementById("errors"), left = chart.getBoundingClientRect().left;
fire(chart, "pointermove", { clientX: left + 300 });
const tip = !document.querySelector("#errors .tip").hidden;
document.getElementById("play").click();
const tell = () => JSON.stringify({ turned, zoomed, clock, title, tip, went, red, halfway, later: state.time > 0.3 });
setInterval(() => { document.title = tell(); }, 100);
}</script>"""


def test_controls_turn_zoom_choose_and_play(case, tmp_path):
    page = tmp_path / "used.html"
    page.write_text(case.path.read_text().replace("</body>", USE + "</body>"))
    dom, messages = browse(page, tmp_path, "--window-size=640,900", "--dump-dom", "--virtual-time-budget=300")
    assert messages == []
    found = json.loads(re.search(r"<title>(.*?)</title>", dom)[1])
    assert found.pop("clock").startswith("0.30 s")
    assert found.pop("title") == "Error of rail [mm]"
    before, after = found.pop("red")
    assert (before, after > 0) == (0, True)
    assert all(found.values())
    assert set(found) == {"turned", "zoomed", "tip", "later", "went", "halfway"}
