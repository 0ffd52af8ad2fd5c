"""The comparison of hunts as text, and the figures of its page."""

from __future__ import annotations

import math
import re
from types import SimpleNamespace

import numpy as np
import pytest

from crashhunt.report._comparison_text import _argument_plot, _outcomes, _rates, describe_comparison

COLORS = {"a": "#a00", "b": "#0b0"}


def figures(name="a", **given):
    hunt = {
        "dir": name, "trials": 40, "crashes": 10, "disturbed": None, "crash_rate": 0.25, "interval": (0.125, 0.5),
        "median_steps_to_crash": 12.0, "median_time_to_collision_s": 1.234, "counted": "", "why_not": "",
        "exclusions": {}, "excluded": 0, "per": "trial", "outcomes": {"collision": 10, "survived": 30, "hang": 0},
    }  # fmt: skip
    return SimpleNamespace(**hunt | given)


def lines_of(*hunts, pairs=()):
    return describe_comparison(SimpleNamespace(hunts=hunts, pairs=pairs, per=hunts[0].per)).splitlines()


def test_row_has_the_rate_with_its_interval():
    header, row = lines_of(figures())
    assert re.split(r"  +", header) == [
        "hunt", "trials", "crashes", "crash rate per trial", "95 % interval", "median step", "median TTC"
    ]  # fmt: skip
    assert re.split(r"  +", row.strip()) == ["a", "40", "10", "0.25", "0.125 to 0.5", "12", "1.23 s"]


def test_rates_in_another_unit_are_numbers():
    hunts = [figures(per="hour", crash_rate=2.345, interval=(0.51, 1200.4)), figures("b", per="hour", interval=None)]
    header, row, _ = lines_of(*hunts)
    assert "crash rate per hour" in header
    assert re.split(r"  +", row.strip())[3:5] == ["2.35", "0.51 to 1,200"]
    text = _rates([figures(per="hour", crash_rate=2.345, interval=(0.51, math.inf))], COLORS)
    assert "2.35 per hour (10 of 40), 95 % interval 0.51 to any number" in text
    assert "inf" not in text
    assert "nan" not in text


def test_unknown_figures_are_dashes_with_the_reason():
    nothing = {"crash_rate": math.nan, "interval": None, "median_steps_to_crash": math.nan}
    _, row, reason = lines_of(figures(**nothing, median_time_to_collision_s=math.inf, why_not="no trial has ended"))
    assert re.split(r"  +", row.strip()) == ["a", "40", "10", "-", "-", "-", "-"]
    assert reason == "a: no crash rate: no trial has ended"
    assert lines_of(figures(why_not="a grid", interval=None))[2] == "a: no interval: a grid"
    assert lines_of(figures(crash_rate=math.nan, why_not="too few"))[2] == "a: no crash rate: too few"


def test_lines_below_the_table_tell_what_counts():
    pair = SimpleNamespace(verdict="b crashes less", caution="on other trials")
    found = lines_of(figures(counted="random"), figures("b", disturbed=4, excluded=3), pairs=[pair])
    assert found[2].split()[3:5] == ["(4", "disturbed)"]
    assert found[3].startswith("a: only trials of origin random count")
    assert found[4] == "b: not counted: 3 trials after one that has not ended"
    assert found[5:] == ["", "b crashes less", "  but on other trials"]


def test_bars_are_drawn_to_one_scale():
    text = _rates([figures(), figures("b", crash_rate=0.05, interval=(0.0, 0.1), crashes=2)], COLORS)
    places = re.findall(r"left:([\d.]+)%?;width:([\d.]+)%", text)
    assert [tuple(map(float, place)) for place in places] == [(0, 50), (25, 75), (0, 10), (0, 20)]
    assert "0.25 per trial (10 of 40), 95 % interval 0.125 to 0.5" in text
    unknown = _rates([figures(crash_rate=math.nan, interval=None)], COLORS)
    assert "width:0.00%" in unknown
    assert ">10 of 40</span>" in unknown
    assert "3 of them disturbed" in _rates([figures(disturbed=3)], COLORS)


def test_outcomes_that_happened_have_a_column():
    table = _outcomes([figures(), figures("b", outcomes={"survived": 40})])
    assert re.findall(r"<th>(.*?)</th>", table) == ["hunt", "survived", "collision", "a", "b"]
    assert re.findall(r"<td>(.*?)</td>", table) == ["30", "10", "40", "0"]


def points_of(figure):
    return [
        (float(x), float(y), title)
        for x, y, title in re.findall(r'cx="([\d.]+)" cy="([\d.]+)".*?<title>(.*?)</title>', figure)
    ]


def test_plot_of_a_number_has_the_rate_of_each_bin():
    values = np.linspace(0.0, 10.0, 101)  # ten bins of ten values; the last has the upper end too
    figure = _argument_plot("ego.speed", "speed (m/s)", {"a": (values, values >= 5.0)}, COLORS)
    found = points_of(figure)
    assert [title for *_, title in found] == ["0 per trial, 10 trials"] * 5 + ["1 per trial, 10 trials"] * 4 + [
        "1 per trial, 11 trials"
    ]
    assert found[0][:2] == pytest.approx((52 + 216 * 0.05, 148), abs=0.06)
    assert found[-1][:2] == pytest.approx((52 + 216 * 0.95, 12), abs=0.06)
    assert re.findall(r'x="(\d+)" y="163" text-anchor="(\w+)">([\d.]+)<', figure) == [
        ("52", "start", "0"), ("268", "end", "10")
    ]  # fmt: skip
    assert ">1</text>" in figure


def test_plot_of_words_has_a_place_for_each_word_of_all_hunts():
    one, other = np.array(["x", "y", "x", "x"]), np.array(["z", "z", "z", "z"])
    crashed = np.array([True, False, False, False])
    figure = _argument_plot("ego.mode", "mode", {"a": (one, crashed), "b": (other, crashed)}, COLORS)
    assert re.findall(r'x="(\d+)" y="163" text-anchor="(\w+)">(\w)<', figure) == [
        ("88", "middle", "x"), ("160", "middle", "y"), ("232", "middle", "z")
    ]  # fmt: skip
    assert [(x, title) for x, _, title in points_of(figure)] == [
        (88.0, "0.333 per trial, 3 trials"), (160.0, "0 per trial, 1 trials"), (232.0, "0.25 per trial, 4 trials")
    ]  # fmt: skip
    assert figure.count('stroke="#a00"') == figure.count('stroke="#0b0"') == 1


def test_axis_without_crashes_reaches_from_0_to_100_percent():
    values = np.linspace(0.0, 10.0, 101)
    figure = _argument_plot("ego.speed", "speed (m/s)", {"a": (values, values > 99.0)}, COLORS)
    assert ">1</text>" in figure
