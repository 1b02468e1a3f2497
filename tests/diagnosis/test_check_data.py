from dataclasses import replace

import numpy as np
import pytest

from concent_warp.diagnosis.check_data import check_data
from concent_warp.recording.recording import Channel
from tests.scenes.swinging import swung


def spoiled(change):
    recording = swung(seconds=1.0)
    (d,) = recording.demonstrations
    return replace(recording, demonstrations=(replace(d, measured={"angle": change(d.measured["angle"])}),))


def paused(channel):
    kept = (channel.time < 0.3) | (channel.time > 0.6)
    return Channel(channel.time[kept], channel.value[kept], channel.noise_std)


def lost(channel):
    return replace(channel, value=np.where(channel.time[:, None] % 0.05 < 0.02, np.nan, channel.value))


def stuck(channel):
    return replace(channel, value=np.full_like(channel.value, 0.1))


def scattered(channel):
    return replace(channel, value=np.random.default_rng(0).normal(0, 0.5, channel.value.shape))


def alone(channel):
    return Channel(channel.time[:1], channel.value[:1], channel.noise_std)


def test_clean_data_are_not_remarked_on():
    assert check_data(swung(seconds=1.0)) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (paused, "demo_0, angle: 1 gaps of up to 0.32 s between samples 0.01 s apart."),
        (lost, "demo_0, angle: 42 % of the samples are missing."),
        (stuck, "demo_0, angle: the reading never changes."),
        (scattered, "demo_0, angle: the readings scatter like noise, no motion shows in them."),
        (alone, "demo_0, angle: only 1 sample, which carries no information."),
    ],
)
def test_doubtful_data_are_reported_with_their_place(change, words):
    assert check_data(spoiled(change)) == [words]
