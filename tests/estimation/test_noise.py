import numpy as np
import pytest
from scipy.signal import butter, lfilter, sosfilt
from scipy.spatial.transform import Rotation

from concent_warp.estimation.noise import NoiseCfg, channel_noise, pooled_noise
from concent_warp.recording.recording import Channel

RATE = 100
TIME = np.arange(0, 6, 1 / RATE)
STD = 3e-4


def moving(rng, noise):
    """A swing in three directions with impacts, noise added."""
    swing = 0.05 * np.sin(2 * np.pi * TIME[:, None] * [0.7, 1.1, 0.4] + [0, 1, 2])
    swing[:, 0] += 0.1 * np.abs(np.sin(3 * TIME))
    return swing + noise(rng, swing.shape)


def white(rng, shape):
    return rng.normal(0, STD, shape)


def slow(rng, shape):
    """First-order autoregressive noise with a correlation of 0.6 from sample to sample."""
    found = np.zeros(shape)
    for i in range(1, len(found)):
        found[i] = 0.6 * found[i - 1] + np.sqrt(1 - 0.6**2) * rng.normal(0, STD, shape[1:])
    return found


def test_what_the_recording_states_is_believed():
    noise = channel_noise(Channel(TIME, moving(np.random.default_rng(0), white), noise_std=0.01), "position")
    assert (noise.std, noise.source) == (0.01, "stated")


@pytest.mark.parametrize("seed", range(5))
def test_white_noise_on_motion_with_impacts_is_found_from_differences(seed):
    noise = channel_noise(Channel(TIME, moving(np.random.default_rng(seed), white)), "position")
    assert noise.source == "differences"
    assert noise.std == pytest.approx(STD, rel=0.2)


def test_slow_noise_is_found_at_rest_and_within_the_interval_of_differences():
    rng = np.random.default_rng(1)
    value = moving(rng, slow)
    moved = channel_noise(Channel(TIME, value), "position")
    assert moved.source == "differences"
    assert 0.6 * STD < moved.std < 1.1 * STD
    assert moved.low < STD < moved.high < 2 * STD
    value[300:] = value[300] + slow(rng, value[300:].shape)
    rested = channel_noise(Channel(TIME, value), "position")
    assert rested.source == "rest"
    assert rested.std == pytest.approx(STD, rel=0.2)
    assert "nothing moves" in rested.words


def test_rest_in_one_demonstration_serves_all():
    rng = np.random.default_rng(2)
    moved, still = Channel(TIME, moving(rng, white)), Channel(TIME, white(rng, (len(TIME), 3)))
    assert pooled_noise((moved, still), "position").source == "rest"
    assert pooled_noise((moved, still), "position").std == pytest.approx(STD, rel=0.1)


@pytest.mark.parametrize("spin", [0.0, 5.0])
def test_noise_of_an_orientation_is_that_of_the_rotation_vector(spin):
    rng = np.random.default_rng(3)
    axis = np.array([1, 2, 2]) / 3
    turn = Rotation.from_rotvec(spin * np.sin(TIME)[:, None] * axis) * Rotation.from_rotvec(
        rng.normal(0, 0.01, (len(TIME), 3))
    )
    flipped = turn.as_quat(scalar_first=True) * rng.choice([-1, 1], len(TIME))[:, None]
    noise = channel_noise(Channel(TIME, flipped), "orientation")
    assert noise.source == ("differences" if spin else "rest")
    assert noise.std == pytest.approx(0.01, rel=0.15)


@pytest.mark.parametrize("still", [True, False])
def test_readings_in_steps_err_by_a_step_over_the_root_of_twelve(still):
    step = 2 * np.pi / 4096
    angle = np.zeros(len(TIME)) if still else 0.2 * np.sin(TIME)
    angle[:100] = angle[100] - 0.1 * np.cos(0.5 * np.pi * TIME[:100])
    noise = channel_noise(Channel(TIME, (np.round(angle / step) * step)[:, None]), "joint")
    assert step / np.sqrt(12) <= noise.std * 1.0001 < step
    assert noise.source == "resolution" or not still


@pytest.mark.parametrize("digits", [9, 7, 6])
def test_steps_of_an_encoder_are_found_in_a_fast_motion_whose_readings_a_log_rounds(digits):
    step = 2 * np.pi / 8192
    angle = np.round(20 * np.sin(TIME) / step) * step
    read = np.array([float(f"{value:.{digits}g}") for value in angle])
    noise = channel_noise(Channel(TIME, read[:, None]), "joint")
    assert step / np.sqrt(12) <= noise.std * 1.001 < 1.5 * step
    assert noise.low >= 0.7 * step / np.sqrt(12)


def test_readings_without_steps_have_no_resolution():
    read = 20 * np.sin(TIME)[:, None] + white(np.random.default_rng(5), (len(TIME), 1))
    assert channel_noise(Channel(TIME, read), "joint").std == pytest.approx(STD, rel=0.3)


def test_a_uniform_motion_without_noise_has_no_resolution():
    for read in (0.5 * TIME, np.where(TIME.mean() > TIME, 0.5 * TIME, TIME)):
        assert channel_noise(Channel(TIME, read[:, None]), "joint").source != "resolution"


def test_a_slow_creep_is_not_rest():
    rng = np.random.default_rng(4)
    creep = 0.02 * TIME[:, None] + white(rng, (len(TIME), 1))
    noise = channel_noise(Channel(TIME, creep), "position")
    assert noise.std == pytest.approx(STD, rel=0.3)


def test_exact_readings_have_no_information_about_the_noise():
    assert channel_noise(Channel(TIME, np.zeros((len(TIME), 1))), "joint").source == "unknown"
    assert (
        channel_noise(Channel(TIME, 1 + 1e-16 * moving(np.random.default_rng(6), white)), "joint").source == "unknown"
    )


def test_gaps_are_bridged_and_too_few_readings_have_no_information():
    rng = np.random.default_rng(5)
    value = moving(rng, white)
    value[::10] = np.nan
    assert channel_noise(Channel(TIME, value), "position").std == pytest.approx(STD, rel=0.25)
    few = channel_noise(Channel(TIME[:4], value[1:5]), "position")
    assert few.source == "unknown"
    assert np.isnan(few.std)


def autoregressive(rng, shape, correlation):
    found = np.zeros(shape)
    for i in range(1, len(found)):
        found[i] = correlation * found[i - 1] + np.sqrt(1 - correlation**2) * rng.normal(0, STD, shape[1:])
    return found


def filtered(rng, shape):
    """Noise after a Butterworth low-pass at a tenth of the sampling rate."""
    found = np.asarray(sosfilt(butter(2, 0.2, output="sos"), rng.normal(0, 1, shape), axis=0))
    return STD / np.std(found) * found


@pytest.mark.parametrize("rate", [200, 500, 1000])
@pytest.mark.parametrize("seed", range(3))
def test_noise_that_is_correlated_over_samples_is_within_the_interval(rate, seed):
    time = np.arange(0, 6, 1 / rate)
    swing = 0.05 * np.sin(2 * np.pi * time[:, None] * [0.7, 1.1, 0.4] + [0, 1, 2])
    for make, most in (
        (white, 1.1),
        (lambda rng, shape: autoregressive(rng, shape, 0.6), 1.2),
        (lambda rng, shape: autoregressive(rng, shape, 0.9), 2.4),
        (filtered, 1.3),
    ):
        rng = np.random.default_rng(seed)
        noise = channel_noise(Channel(time, swing + make(rng, swing.shape)), "position")
        assert noise.low <= noise.std <= noise.high
        assert noise.low < STD < 1.35 * noise.high
        assert STD / most < noise.std < 1.15 * STD
        assert noise.factor == pytest.approx(noise.high / noise.std)


def test_motion_without_noise_is_no_noise():
    time = np.arange(0, 6, 0.01)
    swing = 0.05 * np.sin(2 * np.pi * time[:, None] * [0.7, 1.1, 0.4])
    noise = channel_noise(Channel(time, swing), "position")
    assert noise.low == 0.0
    assert noise.std < 1e-5
    assert noise.high < 1.2 * noise.std
    fast = channel_noise(Channel(time, np.sin(2 * np.pi * 9 * time[:, None])), "position")  # 11 samples a period
    assert fast.low == 0.0
    assert fast.std < 0.06


def test_an_interval_that_is_not_given_is_the_value_itself():
    noise = channel_noise(Channel(TIME, np.zeros((len(TIME), 3)), noise_std=0.01), "position")
    assert (noise.low, noise.high, noise.factor) == (0.01, 0.01, 1.0)
    assert channel_noise(Channel(TIME, np.zeros((len(TIME), 3))), "position").factor == 1.0


def test_lags_are_settings():
    rng = np.random.default_rng(0)
    value = 0.01 * np.sin(TIME)[:, None] + autoregressive(rng, (len(TIME), 1), 0.6)
    near = channel_noise(Channel(TIME, value), "position", NoiseCfg(lags=(1, 2)))
    far = channel_noise(Channel(TIME, value), "position")
    assert near.std < 0.75 * STD < far.std


@pytest.mark.parametrize("kind", ["position", "orientation"])
def test_uneven_steps_of_a_clock_are_no_noise(kind):
    """At 100 deg/s a clock that is uneven by 1 ms moves a reading by more than its noise."""
    rng = np.random.default_rng(3)
    time = np.arange(0, 6, 0.007) + rng.uniform(-1e-3, 1e-3, 858)
    angle = 0.8 * np.sin(2 * time) + 0.3 * np.sin(5 * time) + rng.normal(0, STD, len(time))
    value = angle[:, None]
    if kind == "orientation":
        value = Rotation.from_rotvec(angle[:, None] * [0, 0, 1.0]).as_quat(scalar_first=True)
        noise = channel_noise(Channel(time, value), kind)
        assert noise.std == pytest.approx(STD / np.sqrt(3), rel=0.1)
        return
    assert channel_noise(Channel(time, value), kind).std == pytest.approx(STD, rel=0.1)
    even = channel_noise(Channel(np.arange(858) * 0.007, value), kind)
    assert even.std > 2 * STD


def steps(noise: float, resolution: float = 0.0) -> np.ndarray:
    """Return readings, shape (300, 1), of a stiff servo behind set-points in steps of 10 mm, which it overshoots."""
    rng, value = np.random.default_rng(3), []
    for target in 0.01 * rng.integers(0, 20, 60):
        start = value[-1] if value else 0.0
        value += [target + 0.6 * (target - start), *[target] * int(rng.integers(2, 9))]
    read = np.array(value[:300])[:, None] + noise * rng.normal(size=(300, 1))
    return np.round(read / resolution) * resolution if resolution else read


@pytest.mark.parametrize(("noise", "resolution"), [(2e-5, 0.0), (2e-5, 1e-5), (5e-5, 5e-5)])
def test_set_points_in_steps_that_are_followed_stiffly_are_no_noise(noise, resolution):
    found = channel_noise(Channel(0.04 * np.arange(300), steps(noise, resolution)), "joint")
    assert noise < 2 * found.std
    assert found.std < 2 * noise
    assert found.low < noise


@pytest.mark.parametrize("resolution", [0.0, 0.5, 1.0, 1.5, 3.0])
def test_noise_of_a_smooth_motion_is_read_by_the_median_whatever_the_resolution(resolution):
    time, rng = 0.01 * np.arange(600), np.random.default_rng(4)
    read = np.sin(time)[:, None] + 1e-3 * rng.normal(size=(600, 1))
    if resolution:
        read = np.round(read / (1e-3 * resolution)) * 1e-3 * resolution
    found = channel_noise(Channel(time, read), "joint")
    assert found.std == pytest.approx(1e-3 * np.sqrt(1 + resolution**2 / 12), rel=0.35)


@pytest.mark.parametrize("seed", range(4))
def test_pushes_with_short_rests_between_them_are_no_noise(seed):
    """Over 4 samples most differences are motion; over 8 the smallest ones, those of rests, are about as large."""
    place, asked = 0.0, []
    for target, samples, rest in ((0.22, 50, 40), (0.1, 50, 20), (0.4, 45, 60), (0.7, 45, 80)):
        u = np.arange(samples) / samples
        asked += [place + (target - place) * (10 * u**3 - 15 * u**4 + 6 * u**5), np.full(rest, target)]
        place = target
    followed = np.asarray(lfilter([0.13], [1, -0.87], np.concatenate(asked)))
    read = followed + 3e-5 * np.random.default_rng(seed).normal(size=len(followed))
    found = channel_noise(Channel(0.01 * np.arange(len(read)), read[:, None]), "joint")
    assert found.std == pytest.approx(3e-5, rel=0.2)
    assert found.low < 3.1e-5 < found.high < 1e-4
