"""A policy is shown live in a browser."""

import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from live_page import BROWSER, Page, opened

from concent_warp.cli import main
from concent_warp.deploy.cfg import PlayCfg
from concent_warp.deploy.play import _make_player
from concent_warp.train.policy.load import Policy

needs_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium to open the page with")


@pytest.fixture(scope="module")
def served():
    """Give the address of a policy that is being shown, and end it as a user does."""
    command = [sys.executable, "-m", "concent_warp", "play", "--pretrained", "--states", "2", "--port", "8765"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "PYTHONUNBUFFERED": "1"}

    def interruptible() -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # a shell that runs the tests in the background ignores it

    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=environment, preexec_fn=interruptible
    ) as process:
        assert process.stdout is not None
        line = next(text for text in process.stdout if "http" in text)
        yield line.split()[0]
        process.send_signal(signal.SIGINT)
        rest = process.stdout.read()
        assert process.wait(30) == 0
        assert re.search(r"\d+ episodes?", rest)


@pytest.fixture(scope="module")
def page(served, tmp_path_factory):
    with opened(served, tmp_path_factory.mktemp("browser")) as found:
        found.wait_for("spheres touch")
        yield found


def clock(page: Page) -> float:
    return float(page.wait_for(r"Stage insert, ([\d.]+) s")[1])


def stands_still(page: Page, seconds: float = 30) -> float:
    """Return the time the clock shows once it has not moved for a while: a busy machine's page lags behind."""
    end = time.monotonic() + seconds
    shown, since = clock(page), time.monotonic()
    while time.monotonic() < since + 2:
        assert time.monotonic() < end, "the clock goes on"
        time.sleep(0.1)
        if (now := clock(page)) != shown:
            shown, since = now, time.monotonic()
    return shown


def is_running(page: Page) -> bool:
    return page.run("""[...document.querySelectorAll("label")]
        .filter((l) => l.innerText === "Running").map((l) => document.getElementById(l.htmlFor).checked)[0]""")


def click(page: Page, label: str) -> None:
    """Click a button, or the checkbox beside a label."""
    page.run(f"""{{
        const button = [...document.querySelectorAll("button")].find((b) => b.innerText === "{label}");
        const text = [...document.querySelectorAll("label")].find((l) => l.innerText === "{label}");
        (button || document.getElementById(text.htmlFor)).click();
    }}""")


@needs_browser
def test_robot_and_spheres_are_drawn_and_those_that_touch_are_red(page, tmp_path):
    import cv2

    page.wait_for(r"[1-9]\d+ of 912 spheres touch")
    end = time.monotonic() + 30
    while True:
        page.screenshot(tmp_path / "page.png")
        image = cv2.imread(str(tmp_path / "page.png"))[:, :650].astype(int)
        blue, green, red = np.moveaxis(image, -1, 0)
        touching = (red > 90) & (red > 1.5 * green) & (red > 1.5 * blue)
        if touching.sum() > 100 or time.monotonic() > end:
            break
    assert touching.sum() > 100
    # The whole hand is in view, and no single colour is all there is.
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 200
    assert page.messages == []


@needs_browser
def test_controls_pause_step_and_begin_anew(page):
    first = clock(page)
    page.wait_for(rf"Stage insert, (?!{first:.2f} )")
    click(page, "Running")
    stopped = stands_still(page)
    click(page, "Step")
    page.wait_for(rf"Stage insert, {stopped + 0.05:.2f} s|success|missed")
    click(page, "Reset")
    page.wait_for("Stage insert, 0.00 s")
    click(page, "Running")
    page.wait_for(r"Stage insert, 0\.[1-9]")
    assert page.messages == []


@needs_browser
def test_episodes_are_counted_on_the_page(page):
    if not is_running(page):
        click(page, "Running")
    page.wait_for(r"[1-9]\d* episodes?: [1-9]\d* (success|missed)")
    assert page.messages == []


def test_policy_is_shown_in_reality_for_a_number_of_episodes(capsys):
    command = ["play", "--pretrained", "--world", "reality", "--hide", "mass=1.5", "--states", "1", "--episodes", "1"]
    assert main([*command, "--setpoint-lead-scale", "0.5", "--speed", "4", "--port", "8766"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"http://127.0.0.1:87\d\d shows it", said)
    assert re.search(r"1 episode: 1 (success|missed)", said)


def test_commands_are_scaled_as_in_an_evaluation():
    robots = []
    for action_scale, lead_scale in ((1.0, 1.0), (0.4, 0.5)):
        cfg = PlayCfg(states=1, action_scale=action_scale, setpoint_lead_scale=lead_scale)
        player, _ = _make_player(Policy.load("shape_sorter"), cfg, world="simulation")
        robots.append(player.environment.task.robot)
    np.testing.assert_allclose(robots[1].step, 0.4 * robots[0].step)
    np.testing.assert_allclose(robots[1].lead, 0.5 * robots[0].lead)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--hide", "mass=1.5"], "hidden effects exist only in Reality"),
        (["--states", "0"], "--states is out of bounds; expected at least 1"),
        (
            ["--setpoint-lead-scale", "0"],
            "--setpoint-lead-scale is out of bounds; expected above 0 and at most 1, found 0",
        ),
        (["--states", "1", "--speed", "9"], "--speed is out of bounds; expected at least 0.1 and at most 4"),
        (["--states", "1", "--host", "203.0.113.7"], "no page can be served at this address"),
    ],
)
def test_what_cannot_be_shown_is_refused(options, sentence, capsys):
    assert main(["play", "--pretrained", *options]) == 2
    assert sentence in capsys.readouterr().err
