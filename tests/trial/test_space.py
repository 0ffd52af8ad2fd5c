from __future__ import annotations

import enum
import functools
import json
import math
import re
import types
from typing import Annotated, Literal

import numpy as np
import pytest
from hypothesis import given, strategies as st

from crashhunt.errors import ArgumentError
from crashhunt.space import Choice, Constant, Range, Signature, parse_spec
from crashhunt.trial._argument_distributions import Argument, kind_of
from crashhunt.trial._call_signature import CallSignature, signature_of

finite = st.floats(allow_nan=False, allow_infinity=False, width=64).filter(lambda x: abs(x) < 1e300)


@st.composite
def ranges(draw):
    integer = draw(st.booleans())
    number = st.integers(-(10**6), 10**6) if integer else finite
    low, high = sorted((draw(number), draw(number)))
    log = draw(st.booleans())
    if log:
        low, high = abs(low) + 1, abs(low) + 1 + abs(high - low)
    if not np.isfinite(high - low):
        low, high = 0.0, 1.0
    step = None
    if not log and draw(st.booleans()):
        step = draw(st.integers(1, 1000)) if integer else max((high - low) / draw(st.integers(1, 50)), 1e-9)
        if not integer and (high - low) / step > 10**6:
            step = None
    return Range(low, high, step=step, log=log, integer=integer)


def kind_of_range(distribution):
    return "int" if distribution.integer else "float"


@given(ranges())
def test_a_range_is_read_back_as_it_is_written(distribution):
    assert parse_spec(str(distribution), kind_of_range(distribution)) == distribution


@given(ranges(), st.integers(0, 2**32 - 1))
def test_draws_lie_inside_and_have_the_right_type(distribution, seed):
    rng = np.random.default_rng(seed)
    for _ in range(5):
        value = distribution.sample(rng)
        assert distribution.contains(value)
        assert isinstance(value, int if distribution.integer else float)


@given(ranges(), st.integers(1, 20))
def test_a_grid_begins_at_the_lower_end_and_stays_inside(distribution, points):
    if distribution.step is not None and distribution.steps > 10_000:
        return
    values = distribution.grid(points)
    assert values[0] == distribution.low
    assert all(distribution.contains(value) for value in values)
    assert len(set(values)) == len(values)
    if distribution.step is None:
        assert len(values) <= points
        if points > 1:
            assert values[-1] == distribution.high


@given(st.text(max_size=40), st.sampled_from([None, "float", "int", "bool", "str"]))
def test_any_text_is_read_or_refused_with_a_fix(text, kind):
    try:
        distribution = parse_spec(text, kind, where="--arg x")
    except ArgumentError as error:
        assert error.fix
        assert error.where == "--arg x"
    else:
        distribution.sample(np.random.default_rng(0))


@pytest.mark.parametrize(
    ("text", "kind", "expected"),
    [
        ("20", "float", Constant(20.0)),
        ("20", "int", Constant(20)),
        ("20", "str", Constant("20")),
        ("20", None, Constant(20)),
        ("5:40", "int", Range(5, 40, integer=True)),
        ("5:40", "float", Range(5.0, 40.0)),
        ("5:40", None, Range(5, 40, integer=True)),
        ("5:40.0", None, Range(5.0, 40.0)),
        ("5:40:5", "int", Range(5, 40, step=5, integer=True)),
        ("log:1e-3:1", "float", Range(1e-3, 1.0, log=True)),
        ("a|b|c", "str", Choice(("a", "b", "c"))),
        ("1|2", "int", Choice((1, 2))),
        ("true|false", "bool", Choice((True, False))),
        ("true", None, Constant(True)),
        ("module:attribute", None, Constant("module:attribute")),
        ("-3:-1", "int", Range(-3, -1, integer=True)),
        ("5:40", "float|str", Range(5.0, 40.0)),
        ("log:1:9", "float|str", Range(1.0, 9.0, log=True)),
        ("5", "float|str", Constant(5.0)),
        ("wide", "float|str", Constant("wide")),
        ("true", "float|str", Constant("true")),
        ("a:b", "float|str", Constant("a:b")),
        ("3|wide", "float|str", Choice((3.0, "wide"))),
    ],
)
def test_specifications(text, kind, expected):
    found = parse_spec(text, kind)
    assert found == expected
    assert type(found) is type(expected)
    assert parse_spec(str(found), kind) == found


@pytest.mark.parametrize(
    ("text", "kind", "fix"),
    [
        ("40:5", "int", "5:40"),
        ("nan", "float", "finite"),
        ("1:inf", "float", "finite"),
        ("log:0:1", "float", "positive"),
        ("log:1:2:3", "float", "log:LOW:HIGH"),
        ("1:5:0", "int", "above 0"),
        ("1:5:-1", "int", "above 0"),
        ("0.5:3", "int", "whole numbers"),
        ("maybe", "bool", "true"),
        ("a|a", "str", "once"),
        ("fast", "float", "5:40"),
        (f"0:1{'0' * 23}", "int", "give a narrower range"),
        (f"0:1{'0' * 400}", "int", "give two finite numbers"),
        ("0:9e18:0.1", "float", "or a greater step"),
        ("0:1:1e-320", "float", "or a greater step"),
    ],
)
def test_mistakes_name_the_fix(text, kind, fix):
    with pytest.raises(ArgumentError) as caught:
        parse_spec(text, kind)
    assert fix in caught.value.fix


@pytest.mark.parametrize(
    ("text", "message", "fix"),
    [
        ("40:5", "the range '40:5' begins above its end", "write it as 5:40"),
        ("1e2:5:0.50", "the range '1e2:5:0.50' begins above its end", "write it as 5:1e2:0.50"),
        ("log:1:1e-3", "the range 'log:1:1e-3' begins above its end", "write it as log:1e-3:1"),
        ("log:0:1", "the log range 'log:0:1' must begin above 0", "give a positive lower end"),
        ("1:5:0.0", "the range '1:5:0.0' has the step 0", "give a step above 0"),
        ("-1e308:1e308", "the range '-1e308:1e308' is wider than a float can represent", "give a narrower range"),
        ("0:9e18:0.1", "the range '0:9e18:0.1' has 9e+19 values, more than can be drawn from", "give a narrower range"),
    ],
)
def test_mistake_shows_the_range_as_the_user_wrote_it(text, message, fix):
    with pytest.raises(ArgumentError, match=re.escape(message)) as caught:
        parse_spec(text, "float")
    assert caught.value.fix.startswith(fix)


def test_every_whole_number_of_a_range_is_drawn():
    rng = np.random.default_rng(1)
    assert {Range(1, 6, integer=True).sample(rng) for _ in range(200)} == {1, 2, 3, 4, 5, 6}
    assert {Range(1, 6, step=2, integer=True).sample(rng) for _ in range(200)} == {1, 3, 5}
    assert {Choice(("a", "b")).sample(rng) for _ in range(50)} == {"a", "b"}


@given(ranges(), st.floats(0, 1, exclude_max=True))
def test_quantiles_rise_with_their_share(distribution, share):
    value = distribution.quantile(share)
    assert distribution.contains(value)
    assert isinstance(value, int if distribution.integer else float)
    assert distribution.quantile(0.0) == pytest.approx(distribution.low)
    assert distribution.quantile(0.0) <= value <= distribution.quantile(1.0) <= distribution.high


@pytest.mark.parametrize(
    ("distribution", "values"),
    [
        (Choice(("a", "b", "c")), ["a", "a", "b", "c", "c"]),
        (Range(0.0, 8.0), [0.0, 2.0, 4.0, 6.0, 8.0]),
        (Range(1, 3, integer=True), [1, 1, 2, 3, 3]),
        (Range(1.0, 2.2, step=0.5), [1.0, 1.0, 1.5, 2.0, 2.0]),
        (Range(1.0, 16.0, log=True), [1.0, 2.0, 4.0, 8.0, 16.0]),
        (Range(1, 6, step=2, integer=True), [1, 1, 3, 5, 5]),
        (Constant("x"), ["x"] * 5),
    ],
    ids=str,
)
def test_quantiles_divide_the_draws_into_equal_shares(distribution, values):
    assert [distribution.quantile(share) for share in (0.0, 0.25, 0.5, 0.75, 1.0)] == pytest.approx(values)
    for value in dict.fromkeys(values):
        assert 0.0 <= distribution.share_of(value) <= 1.0
        assert distribution.quantile(distribution.share_of(value)) == pytest.approx(value)


@pytest.mark.parametrize(
    ("distribution", "shares"),
    [
        (Choice(("a", "b")), {"a": 0.25, "b": 0.75}),
        (Range(0.0, 8.0), {-1: 0.0, 2: 0.25, 9: 1.0}),
        (Range(1, 4, integer=True), {1: 0.125, 4: 0.875}),
        (Range(0.0, 1.0, step=0.25), {0.0: 0.1, 0.3: 0.3, 1.0: 0.9}),
        (Range(1.0, 16.0, log=True), {0.5: 0.0, 4.0: 0.5, 32.0: 1.0}),
        (Range(4.0, 16.0, log=True), {8.0: 0.5, 16.0: 1.0}),
        (Range(3.0, 3.0), {3.0: 0.5}),
    ],
    ids=str,
)
def test_shares_of_values(distribution, shares):
    assert {value: distribution.share_of(value) for value in shares} == pytest.approx(shares)


def test_ends_of_log_ranges_of_whole_numbers_are_as_likely_as_the_others():
    distribution = Range(1, 4, log=True, integer=True)
    drawn = [distribution.quantile((share + 0.5) / 1000) for share in range(1000)]
    counts = [drawn.count(number) for number in (1, 2, 3, 4)]
    assert counts == pytest.approx([500, 232, 153.5, 114.5], abs=1)  # 1000 ln((n + 0.5) / (n - 0.5)) / ln(9)


@pytest.mark.parametrize(
    ("distribution", "points", "values"),
    [
        (Range(0.0, 8.0), 5, [0.0, 2.0, 4.0, 6.0, 8.0]),
        (Range(0.0, 8.0), 1, [0.0]),
        (Range(1.0, 16.0, log=True), 3, [1.0, 4.0, 16.0]),
        (Range(0, 3, integer=True), 4, [0, 1, 2, 3]),
        (Range(0, 10, integer=True), 3, [0, 5, 10]),
        (Range(1, 100, log=True, integer=True), 3, [1, 10, 100]),
        (Range(1, 4, log=True, integer=True), 9, [1, 2, 3, 4]),
        (Range(1, 9, log=True, integer=True), 9, [1, 2, 3, 4, 5, 7, 9]),
        (Range(0.0, 1.0, step=0.4), 2, [0.0, 0.4, 0.8]),
        (Choice(("a", "b")), 1, ["a", "b"]),
        (Constant(7), 3, [7]),
    ],
    ids=str,
)
def test_grids(distribution, points, values):
    found = distribution.grid(points)
    assert list(found) == pytest.approx(values)
    assert [type(value) for value in found] == [type(value) for value in values]


def test_kinds_of_values():
    assert [kind_of(value) for value in (True, 3, 3.0, "3")] == ["bool", "int", "float", "str"]


def test_value_is_contained_if_it_is_a_number_within_the_range():
    distribution = Range(1.0, 2.0)
    assert [distribution.contains(value) for value in (1, 2.0, 2.1, 0.9, True, "1")] == [True, True, *[False] * 4]
    assert [Choice((1, 2)).contains(value) for value in (2, 3)] == [True, False]
    assert [Constant("x").contains(value) for value in ("x", "y")] == [True, False]
    with pytest.raises(ValueError, match="not in tuple"):
        Choice(("a",)).share_of("b")


# What a factory takes.


class Follower:
    def __init__(
        self,
        speed: Annotated[float, Argument("speed", distribution=Range(5.0, 9.0), unit="m/s", help="its speed")] = 7.0,
        mode: str = "calm",
        lanes: int | None = None,
        *,
        weights: str,
        step_length_s: float = 0.1,
        observation_space=None,
    ): ...


class Takes:
    def __init__(self, *rest, **options): ...


class Nothing:
    pass


def test_arguments_of_a_factory_are_read_off_its_signature():
    found = signature_of(Follower)
    assert list(found.arguments) == ["speed", "mode", "lanes", "weights"]
    speed, mode, lanes, weights = found.arguments.values()
    assert speed == Argument("speed", "float", 7.0, Range(5.0, 9.0), "m/s", "its speed")
    assert (mode.kind, mode.default, lanes.kind, lanes.default) == ("str", "calm", "int", None)
    assert (weights.kind, weights.default) == ("str", None)
    assert (found.open, found.required) == (False, ("weights",))
    assert set(found.given) == {"step_length_s", "observation_space"}
    assert (signature_of(Takes).open, signature_of(Takes).arguments) == (True, {})
    assert (signature_of(Nothing).open, signature_of(Nothing).arguments) == (False, {})


class Level(enum.IntEnum):
    LOW = 1


Gap = Annotated[float, Argument("gap", distribution=Range(5.0, 9.0))]


def several_types(
    number: int | float = 10,  # noqa: PYI041 - users write it
    name_or_index: int | str = 3,
    gap: float | str = "wide",
    mode_or_gap: str | float = "wide",
    size: int | str | float = 3,  # noqa: PYI041 - users write it
    flag: float | bool = True,
    optional: Gap | None = None,
    mode: Literal["1", "2"] | None = None,
    far: float = math.inf,
    level: Level = Level.LOW,
    angle: float = np.float64(0.5),
): ...


def test_types_of_an_argument_are_those_of_all_parts_of_its_annotation():
    found = signature_of(several_types).arguments
    assert {name: argument.kind for name, argument in found.items()} == {
        "number": "float", "name_or_index": None, "gap": "float|str", "mode_or_gap": "float|str",
        "size": "float|str", "flag": None,
        "optional": "float", "mode": "str", "far": "float", "level": "int",
        "angle": "float",
    }  # fmt: skip
    assert found["optional"].distribution == Range(5.0, 9.0)


def test_default_that_text_cannot_represent_stays_with_the_factory():
    defaults = {name: argument.default for name, argument in signature_of(several_types).arguments.items()}
    assert defaults == {
        **dict.fromkeys(defaults),
        "number": 10,
        "name_or_index": 3,
        "gap": "wide",
        "mode_or_gap": "wide",
        "size": 3,
        "flag": True,
    }


def test_annotations_of_a_wrapped_function_are_those_of_its_own_module():
    @functools.wraps(several_types)
    def foreign(**options): ...

    wrapper = types.FunctionType(foreign.__code__, {})
    wrapper.__wrapped__ = several_types
    for factory in (wrapper, functools.partial(several_types, number=3), functools.partial(wrapper)):
        assert signature_of(factory).arguments["optional"].distribution == Range(5.0, 9.0)


def test_signature_is_rebuilt_from_its_data():
    found = signature_of(Follower)
    data = json.loads(json.dumps(found.to_json()))
    assert CallSignature.from_json(data) == Signature.from_json(data) == found
    assert data["arguments"][0] == {
        "name": "speed", "kind": "float", "default": 7.0, "unit": "m/s", "help": "its speed",
        "distribution": "5.0:9.0",
    }  # fmt: skip


def test_unknown_argument_is_refused_with_the_accepted_ones():
    signature_of(Follower).check(["speed", "mode"], where="ego")
    signature_of(Takes).check(["anything"], where="ego")
    with pytest.raises(ArgumentError) as caught:
        signature_of(Follower).check(["sped"], where="ego")
    assert "ego takes no argument 'sped'" in caught.value.message
    assert "speed" in caught.value.fix
    with pytest.raises(ArgumentError) as caught:
        signature_of(Nothing).check(["x"], where="ego")
    assert "no arguments" in caught.value.fix
