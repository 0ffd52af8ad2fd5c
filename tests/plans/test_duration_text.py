"""How long a hunt may take, and how often it probes, as users write it."""

from __future__ import annotations

import math

import pytest

from crashhunt.plans._durations_and_rates import check_duration, check_probe, seconds_of


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("90", 90.0), ("90s", 90.0), ("1.5s", 1.5), ("30m", 1800.0), ("1h", 3600.0), ("2d", 172_800.0),
        ("1h30m", 5400.0), ("1d2h3m4s", 93_784.0), ("0.5h", 1800.0), ("", math.inf),
    ],
)  # fmt: skip
def test_each_unit_counts_its_seconds(text, seconds):
    assert seconds_of(text) == seconds
    assert check_duration(text) == ""


@pytest.mark.parametrize(
    "text", ["0", "0s", "-1", "1x", "h", "30m1h", "1 h", " 5s", "s", "nan", "inf", "1e3", "9" * 400]
)
def test_text_that_is_no_time_is_refused(text):
    with pytest.raises(ValueError, match="is not a time"):
        seconds_of(text)
    assert "give a time above 0, such as 90s" in check_duration(text)
    assert "such as 4s" in check_probe(text)
    assert check_probe("4s") == check_probe("") == ""
