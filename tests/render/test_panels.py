"""Panels: what each kind shows, and that no values of an agent's can break a film."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest
from conftest import examples
from hypothesis import example, given, settings, strategies as st
from hypothesis.extra import numpy as arrays
from PIL import Image

from crashhunt import render
from crashhunt.panels import Action, ActionDistribution, Bar, Contour, Curve, Curve3D, Heatmap, Panel, Picture, Text

BLUE = (0, 114, 178)
numbers = st.floats(width=64)  # NaN, infinities and subnormal numbers among them
vectors = arrays.arrays(float, st.integers(0, 12), elements=numbers)
matrices = arrays.arrays(float, arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=6), elements=numbers)
maybe = st.none() | numbers
panels = st.one_of(
    st.builds(Heatmap, matrices, low=maybe, high=maybe, annotate=st.booleans()),
    st.builds(Contour, matrices, low=maybe, high=maybe, levels=st.integers(-1, 40)),
    st.builds(Curve, st.dictionaries(st.text(max_size=5), vectors) | vectors, x=st.none() | vectors, cursor=maybe),
    st.builds(Curve, vectors, low=maybe, high=maybe),
    st.builds(Curve3D, arrays.arrays(float, st.tuples(st.integers(0, 9), st.just(3)), elements=numbers)),
    st.builds(Bar, st.dictionaries(st.text(max_size=9), numbers, max_size=5) | vectors, low=maybe, high=maybe),
    st.builds(Text, st.text()),
    st.builds(Action, vectors, low=st.just(-1.0) | numbers, high=numbers, names=st.lists(st.text(max_size=5))),
    st.builds(Action, st.integers(-(2**63), 2**63 - 1), names=st.lists(st.text(max_size=5))),
    st.builds(ActionDistribution, probabilities=vectors),
    st.builds(ActionDistribution, mean=st.none() | vectors, std=st.none() | vectors),
    st.builds(Picture, matrices | arrays.arrays(np.uint8, (3, 4, 3))),
)


def colors(picture: np.ndarray) -> dict[tuple[int, ...], int]:
    """How many pixels have each colour."""
    found, counts = np.unique(picture.reshape(-1, 3), axis=0, return_counts=True)
    return {tuple(map(int, color)): int(count) for color, count in zip(found, counts, strict=True)}


@settings(max_examples=examples(200))
@given(panels, st.sampled_from([(240, 160), (64, 64), (500, 90)]))
@example(Curve([5e-324, 0.0]), (240, 160))  # as near as floats get
@example(ActionDistribution(mean=[0.0, 0.0, 0.0], std=[0.0, 0.0, 0.0]), (64, 64))  # a legend as high as the panel
def test_whatever_an_agent_shows_becomes_a_picture_or_one_clear_error(panel, size):
    try:
        picture = panel.draw(*size, label="any")
    except ValueError as error:
        assert "give " in str(error) or "values" in str(error)
        return
    assert picture.shape == (size[1], size[0], 3)
    assert picture.dtype == np.uint8


def test_fixed_limits_keep_colours_comparable_between_steps():
    assert (Heatmap([[1.0]], low=0.0, high=2.0).draw() == Heatmap([[2.0]], low=0.0, high=4.0).draw())[
        30:150, :180
    ].all()


def test_a_curve_goes_up_where_its_values_do_and_has_gaps_where_there_are_none():
    picture = Curve([0.0, 1.0, 2.0, np.nan, np.nan, 5.0, 6.0]).draw()
    rows, columns = np.nonzero((picture == BLUE).all(axis=2))
    left, right = columns < 100, columns > 180
    assert rows[left].mean() > rows[right].mean()
    assert not ((columns > 115) & (columns < 165)).any()


def test_a_cursor_marks_a_place():
    plain, marked = Curve([0, 1, 2]).draw(), Curve([0, 1, 2], cursor=1.0).draw()
    changed = np.nonzero((plain != marked).any(axis=2))[1]
    assert set(changed.tolist()) == {134}  # the middle of the axis


def test_a_discrete_action_is_written_by_its_name_with_the_number_below():
    plain, named = Action(3).draw(), Action(3, names=("LEFT", "IDLE", "RIGHT", "FASTER")).draw()
    written = [np.nonzero((picture == BLUE).all(axis=2))[1] for picture in (plain, named)]
    assert np.ptp(written[1]) > 3 * np.ptp(written[0])  # a word, and not a digit
    below = [int((picture[100:] != 255).any(axis=2).sum()) for picture in (plain, named)]
    assert below[1] > below[0] + 20
    unknown = Action(7, names=("LEFT", "IDLE")).draw()
    assert np.array_equal(unknown, Action(7).draw())


def test_a_distribution_of_a_continuous_action_has_a_curve_for_each_part():
    assert {BLUE, (213, 94, 0)} <= set(colors(ActionDistribution(mean=[0.0, 2.0], std=[1.0, 0.5]).draw()))
    with pytest.raises(ValueError, match="mean has 2 values, but std has 1"):
        ActionDistribution(mean=[0.0, 1.0], std=[1.0]).draw()


def test_text_keeps_its_lines():
    one, two = Text("brake").draw(), Text("brake\nnow").draw()
    assert np.nonzero((one != two).any(axis=2))[0].min() > 30


def test_a_nest_is_labelled_by_scopes_keys_and_titles():
    with render.scope("ego"):
        speed = Curve([1], title="speed")
        with render.scope("critic"):
            value = Bar([1])
    nest = {"plan": [speed, {"value": value, "other": 3}], "again": (Text("x"), Text("y")), 3: Text("z")}
    assert [label for label, _ in render.labelled(nest)] == [
        "ego/plan/speed", "ego/critic/plan/value", "again", "again 2", "3",
    ]  # fmt: skip
    assert render.labelled(None) == render.labelled(7) == []


def test_scopes_are_left_on_errors_and_belong_to_their_task():
    with pytest.raises(KeyError), render.scope("a"):
        raise KeyError
    assert Text("x").scopes == ()

    async def make(name: str) -> tuple[str, ...]:
        with render.scope(name):
            await asyncio.sleep(0)
            return Text("x").scopes

    async def both() -> list[tuple[str, ...]]:
        return await asyncio.gather(make("a"), make("b"))

    assert asyncio.run(both()) == [("a",), ("b",)]


def test_a_panel_of_ones_own_draws_itself():
    class Red(Panel):
        def draw(self, width=240, height=160, label=""):
            return np.full((height, width, 3), (255, 0, 0), np.uint8)

    assert colors(Red().draw()) == {(255, 0, 0): 240 * 160}
    with pytest.raises(TypeError, match="Panel has no method that draws the panel"):
        Panel().draw()


def test_a_panel_of_ones_own_of_the_wrong_size_states_so(tmp_path):
    class Wide(Panel):
        def draw(self, width=240, height=160, label=""):
            return np.zeros((10, 900, 3), np.uint8)

    render.save_panels(tmp_path, 1, [("w", Wide())])
    assert render.load_panels(tmp_path)[1]["w"].shape == (160, 240, 3)


def test_panels_travel_as_pictures_and_one_that_fails_states_why(tmp_path):
    render.save_panels(tmp_path, 4, [("a", Bar([1, 2])), ("b", Heatmap(np.zeros((2, 2, 2))))])
    render.save_panels(tmp_path, 4, [("c", Text("another agent's"))])
    found = render.load_panels(tmp_path)
    assert {step: list(panels) for step, panels in found.items()} == {4: ["a", "b", "c"]}
    assert (found[4]["a"] == Bar([1, 2]).draw(label="a")).all()
    assert len(colors(found[4]["b"])) > 2  # letters
    assert render.load_panels(tmp_path / "nothing") == {}


def test_panels_need_no_pillow_until_they_are_drawn(tmp_path):
    import subprocess
    import sys

    code = "import sys; sys.modules['PIL'] = None; from crashhunt import render; render.labelled([render.Bar([1])])"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path)
    assert Image.new("RGB", (1, 1))
