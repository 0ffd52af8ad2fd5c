"""Where panels draw what: bars in their rooms, numbers where they belong, colours of published palettes."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("PIL")

from crashhunt.panels import ActionDistribution, Contour, Curve, Heatmap, Picture
from crashhunt.panels._panels import COLORS, color_map, map_colors, number, ticks

BLUE = (0, 114, 178)
# M. Okabe, K. Ito: Color universal design (2008), in another order, and without black and yellow.
OKABE_ITO = {(0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233)}


def runs(mask):
    """The first and the last place of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.astype(int), [0]))))
    return list(zip(edges[0::2].tolist(), (edges[1::2] - 1).tolist(), strict=True))


def where(picture, color):
    return (picture == color).all(axis=2)


def test_curves_have_the_colours_that_colour_blind_people_can_tell_apart():
    assert set(COLORS[:6]) == OKABE_ITO
    picture = Curve({str(place): [place, place] for place in range(6)}).draw(300, 200)
    found = [np.nonzero(where(picture, color)[:, 20:150])[0].mean() for color in COLORS[:6]]
    assert found == sorted(found, reverse=True)  # the higher a value, the smaller its row


def test_long_names_of_curves_have_a_row_each_above_the_axes():
    names = ({f"{name}{more}": [0, 1] for name in ("speed", "limit")} for more in ("", "x" * 40))
    frames = [(Curve(each, low=-9, high=9).draw() == (93, 107, 125)).all(axis=2).sum(axis=1) > 150 for each in names]
    first, second = (np.flatnonzero(frame)[0] for frame in frames)
    assert second == first + 13


def test_a_distribution_over_actions_is_up_to_one_and_a_normal_one_has_its_peak_at_the_mean():
    picture = ActionDistribution([0.25, 0.75]).draw()
    heights = where(picture, BLUE).sum(axis=0)
    low, high = int(heights[8 + 56]), int(heights[8 + 168])
    assert high == pytest.approx(3 * low, abs=3)
    curve = where(ActionDistribution(mean=[2.0], std=[0.5]).draw(), BLUE)
    rows, columns = np.nonzero(curve)
    frame = columns.min(), columns.max()
    assert columns[rows == rows.min()].mean() == pytest.approx(np.mean(frame), abs=2)
    at_one_sigma = curve[:, frame[0] + round((frame[1] - frame[0]) * 4 / 6)].nonzero()[0].mean()
    share = (rows.max() - at_one_sigma) / (rows.max() - rows.min())
    assert share == pytest.approx(math.exp(-0.5), abs=0.04)


def test_a_heatmap_has_each_value_in_its_cell_and_a_scale_of_the_same_height():
    values = np.arange(12.0).reshape(3, 4)
    picture = Heatmap(values).draw(240, 160)
    colored = (picture.max(axis=2).astype(int) - picture.min(axis=2)) > 20
    left, right = runs(colored[80, :195])[0]
    top, bottom = runs(colored[:, left + 2])[0]
    for row in range(3):
        for column in range(4):
            x = left + round((column + 0.5) * (right - left) / 4)
            y = top + round((row + 0.5) * (bottom - top) / 3)
            wanted = map_colors(values[row, column : column + 1], 0.0, 11.0)[0]
            assert np.abs(picture[y, x].astype(int) - wanted).max() <= 1
    bar = runs(colored[80])[-1]
    assert bar[1] - bar[0] == 7
    column = picture[:, bar[0] + 3]
    scale = runs(colored[:, bar[0] + 3])[0]
    assert scale == (top, bottom)
    for share in (0.0, 0.5, 1.0):
        place = round(scale[1] - share * (scale[1] - scale[0]))
        assert np.abs(column[place].astype(int) - color_map()[round(share * 255)]).max() <= 6
    annotated = Heatmap(values, annotate=True).draw(240, 160)
    changed = (annotated != picture).any(axis=2)
    cells = [
        changed[top + row * (bottom - top) // 3 :, left + column * (right - left) // 4 :][
            : (bottom - top) // 3, : (right - left) // 4
        ]
        for row in range(3)
        for column in range(4)
    ]
    for cell in cells:
        rows, columns = np.nonzero(cell)
        assert rows.mean() == pytest.approx((bottom - top) / 6, abs=5)
        assert columns.mean() == pytest.approx((right - left) / 8, abs=5)


def test_colours_of_values_are_viridis_from_low_to_high():
    assert color_map().shape == (256, 3)
    for share, color in ((0, (68, 1, 84)), (127.5, (33, 144, 141)), (255, (253, 231, 37))):
        assert np.abs(color_map()[round(share)].astype(int) - color).max() <= 2
    luminance = color_map() @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(luminance) > -0.5).all()  # the greater, the lighter
    found = map_colors(np.array([-1.0, 0.0, 5.0, 10.0, 11.0, np.nan]), 0.0, 10.0)
    assert np.array_equal(found[0], found[1])
    assert np.array_equal(found[3], found[4])
    assert found[5].tolist() == [200, 200, 200]
    assert map_colors(np.array([3.0]), 3.0, 3.0)[0].tolist() == color_map()[0].tolist()


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0, 10, (0, 5, 10)), (0, 8, (0, 2, 4, 6, 8)), (-1, 1, (-1, -0.5, 0, 0.5, 1)), (0.31, 0.49, (0.35, 0.4, 0.45)),
        (3, 3, (3,)), (95, 305, (100, 200, 300)),
    ],
)  # fmt: skip
def test_ticks_are_round_and_inside(low, high, expected):
    assert ticks(float(low), float(high)) == pytest.approx(expected)
    assert [number(value) for value in (0.5, 1234.5, math.nan)] == ["0.5", "1,234", "-"]


def test_a_contour_changes_colour_where_a_level_ends():
    slope = np.linspace(0, 1, 60)[None].repeat(40, axis=0)
    row = Contour(slope, levels=4).draw()[80]
    colored = (row.max(axis=1).astype(int) - row.min(axis=1)) > 20
    left, right = runs(colored[:195])[0]
    for level in range(4):
        at = left + round((level + 0.5) / 4 * (right - left))
        assert np.abs(row[at].astype(int) - map_colors(np.array([(level + 0.5) / 4]), 0.0, 1.0)[0]).max() <= 3
        if level:
            edge = left + round(level / 4 * (right - left))
            assert row[edge - 3 : edge + 4].sum(axis=1).min() < 0.8 * row[at].sum()  # a darker line


def test_a_picture_keeps_its_shape_and_is_in_the_middle():
    for shape in ((10, 40), (40, 10)):
        drawn = Picture(np.full((*shape, 3), (200, 30, 30), np.uint8)).draw(240, 160)
        rows, columns = np.nonzero(where(drawn, (200, 30, 30)))
        height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
        assert height / width == pytest.approx(shape[0] / shape[1], rel=0.05)
        assert columns.mean() == pytest.approx(119.5, abs=1)
        assert width <= 228
    grey = Picture(np.array([[0.0, 1.0]])).draw()
    assert {tuple(grey[90, 30]), tuple(grey[90, 210])} == {(0, 0, 0), (255, 255, 255)}
