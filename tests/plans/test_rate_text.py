"""Rates and shares as users write them."""

from __future__ import annotations

import pytest

from crashhunt.plans._durations_and_rates import check_rate, check_share, rate_of, share_of


@pytest.mark.parametrize(
    ("text", "rate"),
    [
        ("1e-3/trial", (1e-3, "trial")),
        (" 2 / hour ", (2.0, "hour")),
        ("5/1000km", (5.0, "1000km")),
        (".5/1000 km", (0.5, "1000km")),
        ("1e-12/hour", (1e-12, "hour")),
        ("1e12/hour", (1e12, "hour")),
        ("0.999/trial", (0.999, "trial")),
    ],
)
def test_rates_have_a_number_and_what_it_is_per(text, rate):
    assert rate_of(text) == rate
    assert check_rate(text) == ""


@pytest.mark.parametrize(
    "text",
    ["2", "-1/hour", "nan/hour", "0/hour", "9e-13/hour", "1.1e12/hour", "1/trial", "2/trial", "/hour", "inf/hour",
     "1e999/hour", "1/mile", "1//hour", "1/hour/hour", "1,5/hour", "1/1001km"],
)  # fmt: skip
def test_texts_that_are_no_rates_have_a_fix(text):
    with pytest.raises(ValueError, match=r"rate|range"):
        rate_of(text)
    assert check_rate(text).startswith("give a rate from 1e-12 to 1e12")


def test_option_without_a_rate_is_valid():
    assert check_rate("") == check_share("") == ""


@pytest.mark.parametrize(("text", "share"), [("30%", 0.3), ("0.3", 0.3), ("100%", 1.0), ("1", 1.0), ("0.5%", 0.005)])
def test_shares_are_numbers_or_per_cent(text, share):
    assert share_of(text) == pytest.approx(share)
    assert check_share(text) == ""


@pytest.mark.parametrize("text", ["0", "0%", "-1", "1.1", "101%", "x", "nan", "%"])
def test_texts_that_are_no_shares_have_a_fix(text):
    assert check_share(text) == "give a share above 0 and up to 1, such as 30% or 0.3"
