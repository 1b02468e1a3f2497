import numpy as np

from concent_warp.events.filter import close_gaps, debounce, drop_short_contacts, steps_of, true_runs, window_sums


def frames(text: str) -> np.ndarray:
    return np.array([c == "#" for c in text])


def text(touching: np.ndarray) -> str:
    return "".join("#" if t else "." for t in touching)


def test_runs_are_half_open_spans():
    assert true_runs(frames("##..#")).tolist() == [[0, 2], [4, 5]]
    assert true_runs(frames("...")).shape == (0, 2)


def test_breaks_shorter_than_the_gap_are_closed_and_longer_ones_kept():
    assert text(close_gaps(frames("#..#...#"), 3)) == "####...#"


def test_time_before_the_first_and_after_the_last_touch_is_no_break():
    assert text(close_gaps(frames(".#.."), 9)) == ".#.."


def test_contacts_shorter_than_the_blip_are_dropped():
    assert text(drop_short_contacts(frames("##.###.#"), 3)) == "...###.."


def test_a_flickering_contact_survives_as_one_and_a_lone_tap_does_not():
    assert text(debounce(frames("#.#.#.#......#...."), max_gap=3, shortest=4)) == "#######..........."


def test_durations_become_whole_steps():
    assert steps_of(0.05, 0.005) == 10
    assert steps_of(0.001, 0.005) == 1


def test_windows_are_centred_and_cut_at_the_ends():
    assert window_sums(np.arange(5.0), 3).tolist() == [1, 3, 6, 9, 7]
    assert window_sums(np.ones((4, 2)), 100).tolist() == [[4, 4]] * 4


def test_windows_without_contact_give_exact_zeros():
    value = np.zeros(50)
    value[:10] = 0.1
    assert (window_sums(value, 5)[12:] == 0).all()
