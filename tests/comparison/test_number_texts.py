import numpy as np
import pytest

from concent_warp.comparison.units import interval_texts, number_text


@pytest.mark.parametrize(
    ("value", "low", "high", "texts"),
    [
        (1101.2, 1096.1, 1106.4, ("1101", "1096", "1106")),
        (0.02984, 0.02706, 0.03261, ("0.0298", "0.0271", "0.0326")),
        (23456.7, 20000.4, 27000.0, ("23457", "20000", "27000")),
        (1.000412, 1.00021, 1.00079, ("1.0004", "1.0002", "1.0008")),
        (2.18e-5, 1.79e-5, 2.56e-5, ("2.18e-05", "1.79e-05", "2.56e-05")),
        (2.0, 1.9, np.inf, ("2", "1.9", "inf")),
        (2.0, 1.9, np.nan, ("2", "1.9", "nan")),
        (3.0, 3.0, 3.0, ("3", "3", "3")),
        (0.0, 0.0, 36.77, ("0", "0", "36.8")),
        (1.2345678e7, 1.1e7, 1.3e7, ("1.23e+07", "1.1e+07", "1.3e+07")),
    ],
)
def test_values_and_intervals_have_the_digits_that_tell_them_apart(value, low, high, texts):
    assert interval_texts(value, low, high) == texts


def test_numbers_below_a_million_have_no_exponent():
    assert [number_text(v) for v in (1.0, 999.9, 12345.0, -654321.0, 0.00021)] == [
        "1", "999.9", "12345", "-654321", "0.00021",
    ]  # fmt: skip
