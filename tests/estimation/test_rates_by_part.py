"""What divides a crash rate into parts: disturbances, and bins of an argument."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from crashhunt.errors import UsageError
from crashhunt.estimation._rates import _bins, _division
from crashhunt.trial import Choice, Range

SPACE = {
    ("ego", "speed"): Range(0.0, 8.0),
    ("", "traffic"): Range(1, 3, integer=True),
    ("ego", "gap"): Choice((5, 10)),
    ("", "gap"): Range(0.0, 1.0),
}
SETTINGS = SimpleNamespace(space=SPACE, disturb=("brake=0.1",))


def division(by, settings=SETTINGS):
    return _division(by, SimpleNamespace(crashes=[]), settings, {"dropped": {"rear end": [4, 5]}})


def trial(number=0, *, disturbances=(), **arguments):
    spec = {"number": number, "arguments": {"ego": arguments}, "scenario_arguments": {"traffic": 2, "gap": 0.6}}
    return {"spec": spec, "disturbances": [{"what": what} for what in disturbances]}


@pytest.mark.parametrize(
    ("distribution", "count", "places"),
    [
        (Range(0.0, 8.0), 4, {0.0: "0 to 2", 1.9: "0 to 2", 2.1: "2 to 4", 7.9: "6 to 8", 8.0: "6 to 8"}),
        (Range(1.0, 16.0, log=True), 2, {1.0: "1 to 4", 3.9: "1 to 4", 4.1: "4 to 16"}),
        (Range(1, 3, integer=True), 4, {1: "1", 2: "2", 3: "3"}),
        (Range(1, 100, integer=True), 2, {1: "1 to 51", 50: "1 to 51", 51: "51 to 100"}),
        (Choice(("a", "b")), 1, {"a": "a", "b": "b"}),
    ],
    ids=str,
)
def test_bins_are_equally_likely_parts_of_a_distribution(distribution, count, places):
    labels, place = _bins(distribution, count)
    assert list(dict.fromkeys(places.values())) == [label for label in labels if label in places.values()]
    assert {value: labels[place(value)] for value in places} == places
    assert len(labels) == (count if isinstance(distribution, Range) and distribution.high != 3 else len(set(labels)))


def test_argument_is_named_alone_or_with_its_vehicle():
    speed, traffic = division("speed:4"), division("traffic")
    assert (speed.by, speed.of_crashes, speed.names[0]) == ("speed", False, "0 to 2")
    assert speed.tag(trial(speed=7.5)) == "6 to 8"
    assert traffic.tag(trial()) == "2"
    assert (division("ego.gap").tag(trial(gap=10)), division("scenario.gap:2").tag(trial())) == ("10", "0.5 to 1")


@pytest.mark.parametrize(
    ("by", "message", "fix"),
    [
        ("gap", "there is no argument 'gap'", "ego.gap"),  # two arguments have this name
        ("sped", "there is no argument 'sped'", "speed"),
        ("kind:3", "kind has no bins", "--by kind"),
        ("speed:0", "'0' bins", "give 1 to"),
        ("speed:x", "'x' bins", "give 1 to"),
        ("speed:999999", "'999999' bins", "give 1 to"),
    ],
)
def test_mistakes_in_a_division_name_the_fix(by, message, fix):
    with pytest.raises(UsageError) as caught:
        division(by)
    assert message in caught.value.message
    assert fix in caught.value.fix


def test_crashes_are_divided_by_disturbance():
    both, first = division(""), division("disturbance")
    plain, disturbed = trial(), trial(disturbances=("brake", "stop"))
    assert [both.tag(one) for one in (plain, disturbed)] == list(both.names)
    assert [first.tag(one) for one in (plain, disturbed)] == [both.names[0], "brake"]
    assert (both.by, both.of_crashes, first.of_crashes) == ("disturbance", True, True)
    whole = division("", SimpleNamespace(space={}, disturb=()))
    assert (whole.by, whole.names, whole.tag(disturbed)) == ("", (), "")


def test_types_of_crashes_without_a_bundle_are_known():
    kinds, faults = division("kind"), division("fault")
    assert kinds.tag(trial(number=5)) == "rear end"
    assert kinds.tag(trial(number=6)) == faults.tag(trial(number=5)) != "rear end"
