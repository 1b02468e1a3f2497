"""The JSON object of a diagnosis is documented key by key."""

import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.diagnosis.result import VERDICTS
from concent_warp.diagnosis.time_budget import PROFILE_SHARE, SEARCH_SHARE
from concent_warp.effects.library.nominal import BOUND, CLOCK_TOLERANCE, TOLERANCE
from tests.scenes.swinging import drawing, swung

PAGE = (Path(__file__).parents[2] / "docs" / "diagnose.md").read_text()


def keys(heading):
    """First cells of the table that follows a line of the page."""
    rest = PAGE[PAGE.index(heading) :]
    table = re.search(r"\| key \| \|\n\|---\|---\|\n((?:\|.*\n)+)", rest)
    assert table is not None
    return re.findall(r"^\| `(\w+)` \|", table[1], re.MULTILINE)


@pytest.fixture(scope="module")
def found():
    recording = swung(seconds=1.0)
    cfg = DiagnoseCfg(effects=("joint_damping", "armature"), jobs=1)
    return diagnose(drawing(recording), recording, cfg)


def test_every_key_is_documented_and_nothing_else(found):
    assert keys("## JSON") == list(found.to_json())
    rejected = replace(found.effects[0], accepted=False, reason="no better than chance")
    assert keys("Each of `effects`:") == list(rejected.to_json())


def test_keys_of_lists_are_documented(found):
    document = found.to_json()
    assert document["where"]
    assert document["detectable"]
    for name in ("where", "detectable"):
        sentence = PAGE[PAGE.index(f"Each of `{name}` has") :].split(".\n")[0]
        named = re.findall(r"`(\w+)`", sentence)
        assert set(document[name][0]) <= set(named)
    parameter = document["effects"][0]["parameters"][0]
    row = next(line for line in PAGE.splitlines() if line.startswith("| `parameters` |"))
    assert set(re.findall(r"`(\w+)`", row)) == {"parameters", *parameter}


def test_the_posterior_has_the_values_and_intervals_of_the_effects(found):
    posterior, (accepted,) = found.to_json()["posterior"], found.accepted
    (parameter,), ((variance,),) = posterior["parameters"], posterior["covariance"]
    (fitted,) = accepted.parameters
    assert (parameter["effect"], parameter["name"], parameter["value"]) == (accepted.name, fitted.name, fitted.value)
    assert 1.96 * variance**0.5 * parameter["scale"] == pytest.approx(fitted.high - fitted.value, rel=1e-3)
    row = next(line for line in PAGE.splitlines() if line.startswith("| `posterior` |"))
    assert {"posterior", *posterior, *parameter} == set(re.findall(r"`(\w+)`", row))


def test_every_verdict_is_explained():
    assert set(re.findall(r"^\| `(\w+)` \| ", PAGE.split("## Procedure")[0], re.MULTILINE)) == set(VERDICTS)


def test_figures_of_the_procedure_are_those_of_the_settings():
    cfg = DiagnoseCfg()
    assert f"on {cfg.null_samples} data sets without an effect" in PAGE
    assert f"p ≤ {cfg.significance_level:g}; at least {100 * cfg.min_gain:.0f} % of the error removed" in PAGE
    assert cfg.max_additions == 3
    assert "up to three times (`--additions`)" in PAGE
    least, rest = 100 * cfg.unknown_force.min_share, 100 * cfg.max_remainder
    assert f"less than {least:.0f} % of the first discrepancy and at most {cfg.form_error_ratio:g} x noise" in PAGE
    small, ratio = 100 * cfg.small_form_error, cfg.small_form_error_ratio
    assert f"or less than {small:.0f} % and at most {ratio:g} x noise" in PAGE
    assert f"leaves at most {rest:.0f} % of that remainder" in PAGE
    assert f"one of several that leaves more than {rest:.0f} % of what is left without it" in PAGE
    assert cfg.search.reconsidered == 5
    assert "up to five that removed at least half as much" in PAGE
    assert cfg.search.restart_min_gain == 0.5
    assert f"odds of more than {cfg.search.max_odds:g}" in PAGE
    assert PAGE.count(f"{cfg.time_step.max_error:g} x noise") == 2
    assert f"shorter step (at most {cfg.time_step.max_division} times)" in PAGE
    assert f"by more than {cfg.nominal.min_change:g} x noise within this tolerance" in PAGE
    assert f"bound and more than {cfg.nominal.bounded_ratio:g} x noise is left" in PAGE
    assert f"known to about {100 * TOLERANCE:.0f} %, the latency of a channel to {1e3 * CLOCK_TOLERANCE:g} ms" in PAGE
    assert cfg.nominal.promised_share == 0.5
    least = f"{100 * cfg.min_gain:.0f} %"
    assert f"promises to remove half of the {least} of 8, and kept only where they remove {least} of the" in PAGE
    assert f"none can remove the {least} that an effect must (8), none is refined" in PAGE
    assert cfg.search.polished_first == 1
    assert "one fit, the most promising\n   that is above the noise, is refined first" in PAGE
    assert f"that can be touched last {cfg.fits.observation.max_contact_length:g} s at most" in PAGE
    assert f"changes the residuals by more than {cfg.fits.least_squares.max_change:g} x noise is taken again" in PAGE
    assert f"multiple shooting over windows of {cfg.search.shooting_window:g} s" in PAGE
    assert f"shortened to their first {cfg.search.shooting_window:g} s" in PAGE
    assert f"the first fits leave more than {cfg.search.explained_ratio:g} x noise, all" in PAGE
    assert cfg.min_remainder_gain == 0.5
    assert "the best effect must remove half of what is left above the noise" in PAGE
    quiet = 1 / np.sqrt(1 - cfg.quiet_min_gain)
    assert f"than an effect must remove (8): beside effects, up to {quiet:.2f} x noise" in PAGE
    assert (cfg.search.decided_share, cfg.search.explained_min_gain) == (0.5, 0.3)
    assert "leaves less than half of the discrepancy, those\n   that promise less than three tenths of its gain" in PAGE
    assert (SEARCH_SHARE, PROFILE_SHARE) == (0.75, 0.87)
    assert "Three quarters of the time are for the search, an eighth for intervals" in PAGE
    assert (cfg.search.shooting_fits, cfg.search.shooting_min_gain) == (3, 0.5)
    assert f"continued as the windows grow by factors of {cfg.search.window_growth:g}" in PAGE
    assert (cfg.search.scan_step, cfg.search.polish_min_gain) == (0.25, 0.7)
    assert "moves by quarters of its distance from the null value" in PAGE
    assert "seven tenths of the best gain" in PAGE
    assert BOUND == 2.0
    assert "bounds of two tolerances" in PAGE
    assert f"at most {cfg.adequate_ratio:g} x noise altogether, and of {cfg.adequate_channel_ratio:g} x" in PAGE
    assert {f.name for f in fields(cfg)} >= {"jobs", "seed", "window", "effects"}
    assert np.isfinite(cfg.adequate_ratio)
