"""Fits over the first parts of windows find what fits over whole windows with impacts miss."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis.candidates.baseline import fit_baseline
from concent_warp.diagnosis.candidates.fit_candidate import fit_candidate
from concent_warp.diagnosis.candidates.growing_windows import baseline_of_first_parts, continue_fit, fit_first_parts
from concent_warp.diagnosis.candidates.screening import screen
from concent_warp.diagnosis.cfg import SearchCfg
from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.fit.effects.observation import TimeStepDefect, first_part
from concent_warp.fit.effects.observation_cfg import ObservationCfg
from concent_warp.fit.effects.observe import observe
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.simulate.replay_recording import replay

SCENE = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <geom type="plane" size="5 5 0.1" solref="0.06 0.15"/>
    <body name="ball" pos="0 0 0.5"><freejoint/><geom size="0.03" mass="0.05" solref="0.06 0.15"/></body>
  </worldbody>
  <sensor><framepos name="ball" objtype="xbody" objname="ball"/></sensor>
</mujoco>
"""
NOISE, SCALE = 1e-3, 0.04
"""Of a position [m]; error of the length scale [-]."""
TIME = np.arange(0, 0.9, 0.01)


def bounces() -> Recording:
    """Return throws of a ball that bounces, tracked by position on another scale of lengths."""
    rng, thrown = np.random.default_rng(0), []
    for k in range(3):
        start: dict[str, Any] = {
            "qpos": np.array([0.0, 0, 0.3 + 0.1 * k, 1, 0, 0, 0]),
            "qvel": np.array([0.5, 0.2 * k, -0.5, 0, 3.0, 0]),
        }
        channel = Channel(TIME, np.ones((len(TIME), 3)), noise_std=NOISE)
        thrown.append(Demonstration(f"demo_{k}", **start, measured={"ball": channel}))
    exact = replay(Model.from_recording(Recording(SCENE, tuple(thrown))), Recording(SCENE, tuple(thrown)))
    seen = []
    for d in thrown:
        value = np.asarray(exact[d.name].sensordata[0])[np.arange(len(TIME)) * 5]
        value = (1 + SCALE) * value + NOISE * rng.normal(size=value.shape)
        seen.append(Demonstration(d.name, measured={"ball": Channel(TIME, value, noise_std=NOISE)}))
    return Recording(SCENE, tuple(seen))


@pytest.fixture(scope="module")
def base():
    recording = bounces()
    model = Model.from_recording(recording)
    windows = observe(model, recording, cfg=ObservationCfg(scatter_samples=0))  # the recording is of the same engine
    assert [round(w.end - w.start, 2) for w in windows] == [0.89] * 3
    return fit_baseline(model, windows, cut_blocks(windows), "mujoco")


def test_what_the_first_parts_show_is_continued_to_whole_windows(base):
    effect, cfg = effect_class("length_scale")("ball"), SearchCfg()
    at_once = fit_candidate(base, screen(base, effect, cfg))
    near = baseline_of_first_parts(base, cfg.shooting_window)
    assert near.ratio > 1.2
    first = fit_first_parts(near, effect, cfg, 0.05)
    assert first is not None
    found = continue_fit(base, first, cfg)
    assert found is not None
    assert found.fit.cost < 0.5 * at_once.fit.cost
    assert found.fit.values[0] == pytest.approx(SCALE, rel=0.05)
    assert found.ratio < 1.15
    assert fit_first_parts(near, effect_class("mass")("ball"), cfg, 0.05) is None


def test_what_gains_too_little_over_parts_of_windows_is_not_continued(base):
    effect, cfg = effect_class("length_scale")("ball"), SearchCfg()
    first = fit_first_parts(baseline_of_first_parts(base, cfg.shooting_window), effect, cfg, 0.05)
    assert first is not None
    found = continue_fit(base, first, cfg, 0.05)
    assert found is not None
    assert continue_fit(base, first, cfg, 0.99) is None
    assert continue_fit(base, first, cfg, 0.05, found) is not None
    # Less than a multiple of what the best one gains there.
    assert continue_fit(base, first, replace(cfg, shooting_min_gain=1.5), 0.05, found) is None


def test_the_first_part_of_a_window_has_its_first_readings(base):
    w = base.windows[0]
    readings = w.readings[0]
    assert first_part(w, 0.9) is w
    part = first_part(w, 0.2)
    assert (part.start, part.end) == (w.start, w.start + 0.2)
    assert part.count == 3 * 21 == len(part.clock)
    assert part.readings[0].value.tolist() == readings.value[:21].tolist()
    assert part.clock.tolist() == w.clock[:63].tolist()
    known = np.random.default_rng(0).random(readings.value.shape) < 0.5
    count = int(known.sum())
    missing = replace(readings, known=known, rows=slice(0, count))
    other = replace(readings, channel="other", rows=slice(count, count + 3 * len(TIME)))
    defect = TimeStepDefect(1e-3, np.arange(count + 3.0 * len(TIME)))
    clock = np.concatenate([np.repeat(TIME, known.sum(axis=1)), np.repeat(TIME, 3)])
    both = replace(w, readings=(missing, other), count=len(clock), clock=clock, defect=defect)
    part = first_part(both, 0.2)
    shown = int(known[:21].sum())
    assert [r.rows for r in part.readings] == [slice(0, shown), slice(shown, shown + 63)]
    assert part.readings[0].known is not None
    assert part.readings[0].known.tolist() == known[:21].tolist()
    assert part.clock.tolist() == [*np.repeat(TIME[:21], known[:21].sum(axis=1)), *np.repeat(TIME[:21], 3)]
    assert part.defect is not None
    assert part.defect.residual.tolist() == [*range(shown), *range(count, count + 63)]
    late = replace(w, readings=(replace(readings, time=readings.time + 0.5),))
    assert first_part(late, 0.2) is late
