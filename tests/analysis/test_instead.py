"""What an agent did instead of what it omitted, from speeds alone."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from crashhunt.analysis import _omissions
from crashhunt.trial import Outcome, TrialSpec


def instead(*speeds, dt=0.5, first=0):
    """Speeds in m/s at each step; the last one is that after the crash."""
    roster = SimpleNamespace(index={"ego": 0})
    scenes = [SimpleNamespace(roster=roster, speeds=[speed]) for speed in speeds]
    search = object.__new__(_omissions._Search)
    search._agent, search._dt = "ego", dt
    search._recording = SimpleNamespace(scenes=lambda: scenes)
    found = search._speeds(first)
    return search._instead(found), search._kept_s(found)


@pytest.mark.parametrize(
    ("speeds", "expected"),
    [
        ((20, 21, 22, 23, 24, 25, 3), "sped up"),
        ((20, 20, 20, 20, 20, 20, 3), "kept its speed"),
        ((16, 18, 20, 20, 20, 20, 20.5, 3), "kept its speed"),  # it sped up before the last 2 s, and for a moment
        ((20, 20, 20, 20, 19.9, 19.4, 3), "braked too little"),
        ((25, 20, 21, 22, 23, 24, 3), "braked too little"),  # it has slowed down since the period began
        ((20, 20, 21, 22, 22, 23, 30), "sped up"),  # the crash itself does not count
        ((20, 25, 26, 27, 27, 27, 27, 3), "sped up"),  # to its top speed, 1.5 s before the crash
        ((20, 23, 26, 27, 27, 27, 27, 27, 3), "kept its speed"),  # its top speed was reached 2 s before
        ((20, 20.1, 20.2, 20.3, 20.4, 20.5, 3), "kept its speed"),  # by 0.2 m/s²
        ((20, 3), "kept its speed"),
        ((20, 30, 40, 40, 40, 39, 38, 37, 3), "braked too little"),  # faster than at the beginning of the period
        ((20, 22, 24, 26, 26, 25.8, 25.7, 25.6, 3), "kept its speed"),  # by less than 0.5 m/s
    ],
)
def test_agent_sped_up_if_it_did_so_on_average_over_the_last_two_seconds(speeds, expected):
    assert instead(*speeds)[0] == expected


def test_speeds_before_the_period_do_not_count():
    assert instead(30, 20, 20, 20, 20, 20, 3, first=1) == ("kept its speed", 2.0)


@pytest.mark.parametrize(
    ("speeds", "kept_s"),
    [
        ((32, 34, 36, 38, 40, 40, 40, 3), 1.0),  # not while it sped up before
        ((20.4, 20.0, 20.4, 20.0, 3), 1.5),
        ((20, 19.5, 20, 20, 3), 0.5),
        ((20, 3), 0.0),
    ],
)
def test_speed_is_kept_as_long_as_it_is_that_of_the_end(speeds, kept_s):
    assert instead(*speeds)[1] == kept_s


def searched(**given):
    """A search for the omission of a crash at step 40, in steps of 0.5 s."""
    search = object.__new__(_omissions._Search)
    search._dt, search._left, search._end, search._other, search.runs = 0.5, 10, 40, "x", []
    search._result = SimpleNamespace(digest="a")
    search._rerun = SimpleNamespace(spec=TrialSpec(0, 1, {}, {}, 60))
    for name, value in given.items():
        setattr(search, name, value)
    return search


@pytest.mark.parametrize(("left", "repeated"), [(10, True), (10, False), (4, True), (3, None)])
def test_omission_is_reported_only_if_its_run_can_be_repeated(monkeypatch, left, repeated):
    digests = iter(["a", "b", "c", "a" if repeated else "d"])
    search, asked = searched(_left=left), []
    monkeypatch.setattr(search, "_omission", lambda candidate, faculty: "omitted", raising=False)
    monkeypatch.setattr(search, "_judged", lambda *_: SimpleNamespace(ending="none"), raising=False)
    ended = lambda: SimpleNamespace(result=SimpleNamespace(digest=next(digests)))  # noqa: E731

    def run(specs, faculty, steps):
        asked.append(([spec.max_steps for spec in specs], faculty, steps))
        return [ended() for _ in steps]

    monkeypatch.setattr(search, "_run", run, raising=False)
    found = search._try({"first": 30, "last": 38, "actor": "", "faculty": "speed"}, "speed")
    if repeated is None:  # too few runs are left for all of them
        assert (found, asked) == (None, [])
        return
    assert asked == [([50] * 3, "speed", [30, 29, 28]), ([50], "speed", [30])]
    assert (found.omission, len(found.runs)) == ("omitted" if repeated else None, 3)
    assert found.why_not == ("" if repeated else "a run with the reference driver could not be repeated")


@pytest.mark.parametrize(
    ("endings", "is_cause"),
    [("nnn", True), ("nuu", True), ("unn", False), ("nno", False), ("nsn", False), ("onn", False)],
)
def test_period_is_the_cause_if_the_run_from_its_beginning_ends_well_and_no_run_crashes(monkeypatch, endings, is_cause):
    words = iter({"n": "none", "u": "unclear", "o": "other", "s": "same"}[one] for one in endings)
    search = searched()
    monkeypatch.setattr(search, "_omission", lambda candidate, faculty: faculty, raising=False)
    monkeypatch.setattr(search, "_judged", lambda *_: SimpleNamespace(ending=next(words)), raising=False)
    same = SimpleNamespace(result=SimpleNamespace(digest="b"))
    monkeypatch.setattr(search, "_run", lambda specs, faculty, steps: [same for _ in steps], raising=False)
    found = search._try({"first": 30}, "lateral")
    assert (found is not None and found.omission == "lateral") is is_cause
    assert len(search.runs) == 3


def period(faculty="longitudinal", last=40, actor="x", first=0):
    return {"faculty": faculty, "last": last, "actor": actor, "first": first}


SLOW, SIDE = period("longitudinal", 39, first=9), period("lateral", 30, first=4)
OWN = [("longitudinal", 9), ("lateral", 4)]


@pytest.mark.parametrize(
    ("watched", "endings", "helps", "tried", "why_not"),
    [
        ({"digest": "b"}, {}, None, [], "differs"),
        ({"responses": None}, {}, None, [], "differs"),
        ({"outcome": Outcome.INVALID, "failure": "no driver"}, {}, None, [], "no driver"),
        ({"outcome": Outcome.INVALID}, {}, 1, [OWN[0]], ""),
        ({}, {}, 2, OWN, ""),
        ({}, {"lateral": ["none", "other"]}, 3, [*OWN, ("both", 4)], ""),
        ({}, {"longitudinal": ["other"]}, None, [*OWN, ("both", 9), ("both", 4)], ""),
        ({}, {"lateral": ["other", "same"]}, None, [*OWN, ("both", 4)], ""),
        ({}, {"lateral": ["other", "unclear"]}, None, [*OWN, ("both", 4)], ""),
        ({}, {"lateral": ["other"]}, None, [*OWN, ("both", 4)], ""),  # from the first step as well, but not twice
    ],
)
def test_reference_driver_has_both_parts_where_one_brings_another_crash_about(
    monkeypatch, watched, endings, helps, tried, why_not
):
    seen = {"digest": "a", "outcome": Outcome.COLLISION, "responses": (), "failure": None} | watched
    failure = seen["failure"] and SimpleNamespace(message=seen["failure"])
    result = SimpleNamespace(digest=seen["digest"], outcome=seen["outcome"], failure=failure)
    first = SimpleNamespace(result=result, responses=seen["responses"])
    search, asked = searched(), []

    def attempt(candidate, faculty):
        asked.append((faculty, candidate["first"]))
        search.runs += [SimpleNamespace(ending=one) for one in endings.get(faculty, ["same"])]
        return "cause" if len(asked) == helps else None

    monkeypatch.setattr(search, "_run", lambda *given: [first] if given[1:] == ("none", [0]) else None, raising=False)
    monkeypatch.setattr(search, "_candidates", lambda responses: [SLOW, SIDE], raising=False)
    monkeypatch.setattr(search, "_try", attempt, raising=False)
    found = search.find("differs")
    assert asked == tried
    assert found == "cause" if helps else found.why_not == why_not


@pytest.mark.parametrize(
    ("periods", "first"),
    [
        ([period(first=1), period("lateral", first=2), period(first=3, last=45)], [2, 3, 1]),
        ([period(first=1, actor="y"), period(first=2, actor=""), period(first=3)], [2, 3]),
        ([period(first=number, last=number + 30) for number in range(9)], [8, 7, 6, 5]),
        ([period(first=1, last=19), period(first=2, last=20)], [2]),  # it ended more than 10 s before the crash
    ],
)
def test_lane_changes_and_then_the_latest_periods_with_the_collision_partner_are_examined(periods, first):
    search = searched(_end=60, _dt=0.25)
    assert [one["first"] for one in search._candidates(tuple(periods))] == first
