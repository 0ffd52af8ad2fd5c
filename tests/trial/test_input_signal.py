"""Arguments that are signals: their points, the values between them, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from crashhunt.errors import ArgumentError
from crashhunt.trial import InputSignal, expand_signal, fold_signals, with_fewer_points


def expand(spec):
    return expand_signal("u", spec, 10.0, where="--arg u")


def test_a_signal_becomes_an_argument_for_each_point():
    assert expand("signal:0:1:points=2:kind=pchip") == {
        "u": "signal:pchip:2:10.0",
        "u[0]": "0.0:1.0",
        "u[1]": "0.0:1.0",
    }
    assert expand("signal:-2:3.5")["u"] == "signal:linear:5:10.0"
    assert expand("0:1") == {}


def test_the_agent_receives_the_signal_in_place_of_its_points():
    given = {"u": "signal:linear:2:10.0", "u[0]": 0.25, "u[1]": 1.0, "v": "signal:linear:2:10.0", "w": "text"}
    folded = fold_signals(given)
    assert folded == {"u": InputSignal((0.25, 1.0), "linear", 10.0), "v": "signal:linear:2:10.0", "w": "text"}
    assert folded["u"](5.0) == 0.625
    assert fold_signals({**given, "u": 0.5}) == {"u": 0.5, "v": given["v"], "w": "text"}
    assert fold_signals({"x[0]": 1.0}) == {"x[0]": 1.0}


# SciPy divides by slopes, so those near the smallest float overflow there.
VALUES = st.floats(-5, 5).filter(lambda value: value == 0 or abs(value) > 1e-100)


@given(points=st.lists(VALUES, min_size=2, max_size=9), share=st.floats(0, 1))
def test_values_are_those_of_the_interpolation(points, share):
    from scipy.interpolate import PchipInterpolator  # takes 0.2 s, and every worker collects this module

    places, at = np.linspace(0, 10, len(points)), 10 * share
    signal = {kind: InputSignal(tuple(points), kind, 10.0) for kind in ("constant", "linear", "pchip")}
    assert signal["linear"](at) == pytest.approx(np.interp(at, places, points), abs=1e-9)
    assert signal["pchip"](at) == pytest.approx(PchipInterpolator(places, points)(at), abs=1e-6)
    assert min(points) - 1e-9 <= signal["pchip"](at) <= max(points) + 1e-9
    assert signal["constant"](at) in points


def test_constant_pieces_change_at_their_edges_and_ends_are_held():
    signal = InputSignal((1.0, 2.0, 3.0), "constant", 0.3)
    assert [signal(step * 0.1) for step in range(5)] == [1.0, 2.0, 3.0, 3.0, 3.0]
    assert InputSignal((1.0, 2.0), "linear", 4.0)(9.0) == 2.0
    assert InputSignal((1.0, 2.0), "linear", 4.0)(-1.0) == 1.0
    assert InputSignal((7.0,), "pchip", 4.0)(1.0) == 7.0


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("signal:", "'signal:' is not a signal; write signal:LOW:HIGH:points=N"),
        ("signal:0", "is not a signal"),
        ("signal:0:1:2", "is not a signal"),
        ("signal:a:b", "is not a signal"),
        ("signal:0:1:points=many", "is not a signal"),
        ("signal:1:0", "has no range; give LOW below HIGH"),
        ("signal:0:nan", "has no range"),
        ("signal:0:inf", "has no range"),
        ("signal:0:1:points=0", "has 0 points; give 1 to 200"),
        ("signal:0:1:points=100000", "has 100000 points"),
        ("signal:0:1:kind=liner", "has an unknown kind 'liner'; did you mean 'linear'?"),
        ("signal:0:1:point=3", "has an unknown setting 'point'; did you mean 'points'?"),
    ],
)
def test_a_specification_that_is_no_signal_is_refused(spec, message):
    with pytest.raises(ArgumentError) as refused:
        expand(spec)
    assert message in str(refused.value)
    assert refused.value.where == "--arg u"


@pytest.mark.parametrize("kind", ["constant", "linear", "pchip"])
def test_a_signal_with_fewer_points_has_values_of_the_signal(kind):
    points = [3.0, 1.0, 4.0, 1.0, 5.0]
    given = {"v": 1.0, "u": f"signal:{kind}:5:10.0", **{f"u[{at}]": value for at, value in enumerate(points)}}
    whole, smaller = fold_signals(given)["u"], with_fewer_points(given, "u")
    assert [len(fold_signals(one)["u"].points) for one in smaller] == [1, 2, 3, 4]
    assert all(one["v"] == 1.0 and len(one) == 2 + count for count, one in enumerate(smaller, 1))
    assert smaller[0]["u[0]"] == whole(5.0)
    if kind != "constant":
        assert fold_signals(smaller[2])["u"].points == (3.0, 4.0, 5.0)
    assert with_fewer_points(given, "v") == with_fewer_points({"u": given["u"]}, "u") == []
    assert with_fewer_points(smaller[0], "u") == []
