"""No effect is named where what it leaves may be well above the noise, and a replay in one piece is far off."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.replayed import Replayed
from concent_warp.diagnosis.result import NOISE_OPEN, VERDICTS, Diagnosis
from concent_warp.diagnosis.search.adequacy import qualified_by_noise
from concent_warp.estimation.noise import Noise
from tests.diagnosis.made_up import MODEL, finding, node


def answer(verdict: Any, *, doubtful: bool | None) -> Diagnosis:
    """Return an answer that names one effect; `doubtful` is None without a replay."""
    alike = None if doubtful is None else Replayed(70.0, 30.0 if doubtful else 2.0, 0.7, doubtful)
    none: Any = ()
    return Diagnosis(
        verdict, (finding("drag", 0.7),), (("drag",),), none, 0.0, (2.5, 0.9), none, None, none, (MODEL, MODEL),
        replayed=alike,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("verdict", "low", "doubtful", "expected"),
    [
        ("effect", 0.2, True, "unsettled"),
        ("group", 0.2, True, "unsettled"),
        ("effect", 0.2, False, "effect"),
        ("effect", 0.2, None, "effect"),
        ("effect", 0.9, True, "effect"),  # the noise is known
        ("none_needed", 0.2, None, "none_needed"),
        ("none_of_these", 0.2, None, "none_of_these"),
    ],
)
def test_what_is_left_over_the_least_noise_and_the_replay_decide_together(verdict, low, doubtful, expected):
    one = node(0.9)
    one.windows[0].readings = [SimpleNamespace(channel="angle", rows=slice(0, 1))]
    one.pieces[0].residual = np.array([0.9])
    noises = {"angle": Noise(1e-3, "differences", low * 1e-3, 1.1e-3)}
    found = qualified_by_noise(answer(verdict, doubtful=doubtful), one, noises, DiagnoseCfg())
    assert found.verdict == expected
    assert bool(found.issues) == (low < 0.5 and verdict != "none_of_these")
    if expected == "unsettled":
        assert found.headline == NOISE_OPEN
        assert found.sentences()[1].startswith("The best so far: drag")
        assert "Replayed in one piece" in " ".join(found.sentences())
    elif doubtful is None:
        assert found.headline == VERDICTS[expected] or verdict == "none_of_these"
