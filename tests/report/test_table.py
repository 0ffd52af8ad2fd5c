"""The layout of tables: a heading of several rows, and columns that fit into a terminal."""

from crashhunt.report._table import aligned, stacked


def test_words_of_a_heading_stand_at_its_bottom():
    assert stacked(["step", "target_speed", "braking needed m/s²"]) == [
        ["", "", "braking"],
        ["", "target_", "needed"],
        ["step", "speed", "m/s²"],
    ]


def test_columns_are_one_space_apart_only_if_the_line_is_too_wide_otherwise():
    rows = [["step", "speed"], ["1", "15.0", "<- here"]]
    assert aligned(rows, width=11) == ["step  speed", "   1   15.0  <- here"]
    assert aligned(rows, width=10) == ["step speed", "   1  15.0 <- here"]
    assert aligned(rows) == aligned(rows, width=11)
