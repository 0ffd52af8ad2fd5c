"""What is tried to make a crash smaller, and in which order."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
from hypothesis import given, strategies as st

from crashhunt.shrinking import _scripting, _stages, fewest, plainest
from crashhunt.shrinking._runs import OutOfTimeError
from crashhunt.shrinking._scripting import Part
from crashhunt.trial import Escape, TrialSpec
from crashhunt.world import Actor, Roster, Scene


def first(good, seen):
    """Try candidates, and count them."""

    def tried(candidates):
        for place, candidate in enumerate(candidates):
            seen.append(candidate)
            if good(candidate):
                return place
        return None

    return tried


@given(st.integers(1, 60), st.data())
def test_exactly_what_it_takes_is_left(count, data):
    needed = data.draw(st.sets(st.integers(0, count - 1)))
    seen = []
    found = fewest(range(count), first(lambda some: needed <= set(some), seen))
    assert set(found) == needed
    assert list(found) == sorted(found)
    assert len(seen) <= 4 * (len(needed) + 1) * (count.bit_length() + len(needed) + 2)


def test_what_is_likely_is_tried_first():
    seen = []
    assert fewest(range(1000), first(lambda some: 7 in some, seen), [(3,), (7,)]) == (7,)
    assert seen == [(), (3,), (7,)]


def test_where_each_is_needed_none_is_left_out_and_nothing_of_nothing():
    assert fewest("abcd", first(lambda some: len(some) == 4, [])) == ("a", "b", "c", "d")
    assert fewest((), first(lambda some: True, [])) == ()
    assert fewest("abcd", first(lambda some: True, [])) == ()


@pytest.mark.parametrize(
    ("value", "default", "plainer"),
    [
        (17.2345, 15.0, [15.0, 20.0, 17.0, 17.2, 17.23]),
        (17.2345, None, [20.0, 17.0, 17.2, 17.23]),
        (20.0, None, []),
        (15.0, 15.0, []),
        (37, 20, [20, 40]),
        (True, False, [False]),
        ("firm", "gentle", ["gentle"]),
        ("firm", None, []),
        (float("nan"), None, []),
        (3.0, 1, []),
    ],
)
def test_values_become_plainer(value, default, plainer):
    assert plainest(value, default) == plainer
    assert list(map(type, plainest(value, default))) == list(map(type, plainer))


OTHERS = tuple("abcdefgh")


RERUN = SimpleNamespace(
    spec=TrialSpec(0, 1, {"ego": {}}, {}, 300),
    defaults={},
    recorded=SimpleNamespace(agents=("ego",), prologue=SimpleNamespace(step_length_s=0.1)),
    bundle=SimpleNamespace(
        confirmed=True, driver="ego", result=SimpleNamespace(collision=SimpleNamespace(other="a"), event=None)
    ),
)


@dataclass(frozen=True)
class Script:
    """Who is moved, and who drives."""

    names: tuple[str, ...]
    agents: tuple[str, ...]

    def only(self, names):
        return replace(self, names=tuple(name for name in self.names if name in names))


class Scripting:
    """Parts of a crash of 100 steps."""

    whole, steps = Part(("ego",), OTHERS), 100

    def spec(self, part):
        return TrialSpec(0, 1, {"ego": {}}, {}, 110, script=Script(part.others, part.agents))

    def begins(self, agents):
        return []


class Runs:
    """In traffic it takes these three, and where others are moved it takes all.

    Args:
        scripted: how many runs in which others are moved there is time for.
    """

    def __init__(self, scripted):
        self.most_steps, self.left, self.lengths = 100, scripted, []

    def entered(self, spec):
        return OTHERS

    def first(self, specs, *, again=False):
        for place, spec in enumerate(specs):
            if spec.script is None:
                self.lengths.append(self.most_steps)
            elif not self.left:
                raise OutOfTimeError
            else:
                self.left -= 1
            present = OTHERS if spec.only is None else spec.only
            if spec.script.names == OTHERS if spec.script else {*"abc"} <= {*present}:
                return place
        return None


@pytest.mark.parametrize("scripted", [0, 1, 8, 10, 10**6])
def test_time_that_runs_out_while_others_are_moved_takes_nothing_away(monkeypatch, scripted):
    monkeypatch.setattr(_stages, "_nearest", lambda recording, agent: list(OTHERS[:6]))
    monkeypatch.setattr(_stages, "can_be_scripted", lambda rerun: False)
    monkeypatch.setattr(_stages.Search, "steps_cut", 0)
    search = _stages.Search(RERUN, Runs(scripted), "either")
    search._scripting = Scripting()
    assert search.run(lambda: False)[0] in ("time", "done")
    assert search.best == replace(RERUN.spec, only=("a", "b", "c"))
    assert search.smaller[-1] == search.best


class FromLaterOn(Scripting):
    """From step 60 on it takes two others, and of all that are there; from the start on, four."""

    def begins(self, agents):
        return [90, 60]

    def spec(self, part):
        return replace(super().spec(part), max_steps=part.begin or 1)


class LaterRuns(Runs):
    """In traffic nobody can be left out.

    Args:
        pair: who is enough from step 60 on.
    """

    def __init__(self, pair):
        super().__init__(10**6)
        self.pair = pair

    def first(self, specs, *, again=False):
        for place, spec in enumerate(specs):
            script = spec.script
            if script is None:
                good = spec.only is None
            else:
                good = {*(self.pair if spec.max_steps == 60 else "abcd")} <= {*script.names} and spec.max_steps != 90
            if good:
                return place
        return None


@pytest.mark.parametrize("pair", ["ah", "gh"])
def test_fewer_are_enough_where_it_begins_later(monkeypatch, pair):
    monkeypatch.setattr(_stages, "_nearest", lambda recording, agent: list(OTHERS))
    monkeypatch.setattr(_stages, "can_be_scripted", lambda rerun: False)
    search = _stages.Search(RERUN, LaterRuns(pair), "either")
    search._scripting = FromLaterOn()
    assert search.run(lambda: False)[0] == "done"
    assert (set(search.best.script.names), search.best.max_steps) == ({*pair}, 60)


class FewRuns(LaterRuns):
    """From the start on it takes two others, and from step 60 on one of them."""

    def first(self, specs, *, again=False):
        for place, spec in enumerate(specs):
            needed = {*(self.pair[:1] if spec.max_steps == 60 else self.pair)}
            if spec.only is None if spec.script is None else needed <= {*spec.script.names} and spec.max_steps != 90:
                return place
        return None


def test_whom_it_takes_no_more_where_it_begins_later_is_left_out_of_a_few_as_well(monkeypatch):
    monkeypatch.setattr(_stages, "_nearest", lambda recording, agent: list(OTHERS))
    monkeypatch.setattr(_stages, "can_be_scripted", lambda rerun: False)
    search = _stages.Search(RERUN, FewRuns("gh"), "either")
    search._scripting = FromLaterOn()
    assert search.run(lambda: False)[0] == "done"
    assert (search.best.script.names, search.best.max_steps) == (("g",), 60)


@pytest.mark.parametrize(("escape", "begins"), [(None, [39, 29, 19, 9]), (25, [25, 19, 9]), (0, [])])
def test_it_begins_while_the_agent_can_still_avoid_it(escape, begins):
    ego = Actor("ego", "passenger", 5.0, 1.8)
    scenes = [
        Scene(step / 10, Roster((ego,)), [(float(step), 0.0)], [0.0], [10.0], lanes=("road_0",)) for step in range(50)
    ]
    rerun = SimpleNamespace(
        spec=TrialSpec(0, 1, {"ego": {}}, {}, 300),
        bundle=SimpleNamespace(
            result=SimpleNamespace(escape=None if escape is None else Escape(escape, escape + 1, 8.0, ""))
        ),
        recorded=SimpleNamespace(
            agents=("ego",), steps=49, prologue=SimpleNamespace(step_length_s=0.1), scenes=lambda: scenes
        ),
    )
    assert _scripting.Scripting(rerun).begins(("ego",)) == begins
