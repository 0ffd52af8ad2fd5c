"""Which kinds of crashes a hunt has found: when there are enough, and how long ago the last new one came."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest

from crashhunt.base.errors import UsageError
from crashhunt.hunts import _progress
from crashhunt.hunts._progress import Kinds
from crashhunt.hunts._reports import kind_data
from crashhunt.plans import RunSettings
from crashhunt.trial import Failure, Outcome, TrialResult, TrialSpec


def crash(number, kind, steps=5):
    spec = TrialSpec(number, 1, {"ego": {}}, {}, max_steps=10)
    result = TrialResult(spec, Outcome.AGENT_ERROR, steps=steps, failure=Failure(kind, "said"))
    return SimpleNamespace(result=result, path=f"c{number}", id=f"c{number}")


def test_enough_is_up_to_the_least_trial_with_which_there_are_so_many():
    kinds = Kinds(2)
    kinds.add(crash(7, "KeyError"), 1)
    assert kinds.until is None
    kinds.add(crash(9, "IndexError"), 2)
    assert kinds.until == 9
    kinds.add(crash(3, "KeyError"), 3)
    assert kinds.until == 9
    kinds.add(crash(8, "IndexError"), 4)  # lower numbers were still running
    assert kinds.until == 8
    kinds.add(crash(5, "TypeError"), 5)
    assert kinds.until == 5
    assert Kinds(0, [crash(1, "KeyError")]).until is None


def test_the_last_new_kind_is_not_the_last_crash(monkeypatch):
    kinds = Kinds(0, [crash(1, "KeyError")], newest=50.0)
    monkeypatch.setattr(time, "time", lambda: 100.0)
    kinds.add(crash(2, "KeyError"), 4)
    assert (kinds.newest, kinds.newest_trial) == (50.0, None)
    kinds.add(crash(3, "IndexError"), 6)
    assert (kinds.newest, kinds.newest_trial) == (100.0, 6)
    kinds.add(crash(0, "IndexError", steps=2), 8)
    assert kinds.newest_trial == 6
    assert [kind_data(group) for group in kinds.groups()] == [
        {"words": "IndexError in said", "count": 2, "first": "c0", "shortest": "c0"},
        {"words": "KeyError in said", "count": 2, "first": "c1", "shortest": "c1"},
    ]


def test_a_screen_does_not_wait_for_groups_that_take_long(monkeypatch):
    now, group = [0.0], _progress.groups_of

    def slowly(*given):
        now[0] += 1.0
        return group(*given)

    monkeypatch.setattr(_progress, "groups_of", slowly)
    monkeypatch.setattr(_progress, "time", SimpleNamespace(monotonic=lambda: now[0], time=lambda: now[0]))
    kinds = Kinds(0, [crash(1, "KeyError")])
    assert kinds.groups(running=True)[0].count == 1
    kinds.add(crash(2, "KeyError"), 1)
    now[0] = 20.0
    assert kinds.groups(running=True)[0].count == 1  # 5 % of the time
    now[0] = 22.0
    assert kinds.groups(running=True)[0].count == 2
    kinds.add(crash(3, "KeyError"), 1)
    assert kinds.groups()[0].count == 3  # what the hunt ends with


def test_of_each_kind_the_shortest_few_are_kept_and_all_count():
    kinds = Kinds(2)
    for number, (kind, steps) in enumerate([("KeyError", 9), ("KeyError", 4), ("IndexError", 7), ("KeyError", 4)]):
        kinds.add(crash(number, kind, steps), number)
    assert [bundle.id for bundle in kinds.surplus(1)] == ["c3", "c0"]
    assert kinds.surplus(1) == []
    kinds.add(crash(5, "KeyError", 2), 5)
    assert [bundle.id for bundle in kinds.surplus(1)] == ["c1"]
    assert [(group.count, group.first.id, group.shortest.id) for group in kinds.groups()] == [
        (4, "c5", "c5"), (1, "c2", "c2"),
    ]  # fmt: skip
    assert kinds.until == 2  # it was found, though its bundle is gone
    again = Kinds(2, [crash(5, "KeyError", 2)], dropped=kinds.dropped)
    assert again.groups()[0].count == 4
    with pytest.raises(UsageError, match="--keep 2 requires a hunt that continues after a crash"):
        RunSettings(keep=2).checked()
    assert RunSettings(keep=2, distinct=2).checked().keep == 2


def test_who_is_killed_while_giving_bundles_up_counts_none_twice():
    crashes = [crash(1, "KeyError", 4), crash(2, "KeyError", 9)]
    kinds = Kinds(0, crashes)
    assert [bundle.id for bundle in kinds.surplus(1)] == ["c2"]
    again = Kinds(0, crashes, dropped=kinds.dropped)  # the ledger was told, and the bundle is there
    assert again.groups()[0].count == 2
    assert [bundle.id for bundle in again.surplus(1)] == ["c2"]
    assert (again.dropped, again.groups()[0].count) == (kinds.dropped, 2)


def test_what_was_hunted_for_is_kept_before_what_is_shorter(monkeypatch):
    monkeypatch.setattr(_progress, "fault_of", lambda bundle, _: SimpleNamespace(is_egos=bundle.id != "c1"))
    kinds = Kinds(1, [crash(1, "KeyError", 4), crash(2, "KeyError", 9), crash(3, "KeyError", 6)], only_at_fault=True)
    assert [bundle.id for bundle in kinds.surplus(1)] == ["c2", "c1"]
    assert (kinds.at_fault, kinds.dropped_at_fault) == ((2, 3), [2])  # with or without a bundle
    again = Kinds(
        1, [crash(3, "KeyError", 6)], only_at_fault=True, dropped=kinds.dropped, dropped_at_fault=kinds.dropped_at_fault
    )
    assert (again.until, again.at_fault) == (3, (2, 3))


def test_the_one_that_wants_several_kinds_continues_after_the_first_crash():
    assert RunSettings(distinct=3).checked().keep_going
    assert not RunSettings().checked().keep_going
    with pytest.raises(UsageError, match="--distinct is -1"):
        RunSettings(distinct=-1).checked()


def test_only_the_agents_own_crashes_count_where_that_was_asked(monkeypatch):
    monkeypatch.setattr(_progress, "fault_of", lambda bundle, _: SimpleNamespace(is_egos=bundle.id in ("c4", "c6")))
    kinds = Kinds(1, only_at_fault=True)
    kinds.add(crash(3, "KeyError"), 1)
    assert (kinds.until, kinds.at_fault) == (None, ())
    kinds.add(crash(6, "KeyError"), 2)
    assert (kinds.until, kinds.at_fault) == (6, (6,))
    kinds.add(crash(4, "IndexError"), 3)
    assert (kinds.until, kinds.at_fault) == (4, (4, 6))
    assert len(kinds.groups()) == 2  # all are shown
    assert Kinds(2, [crash(3, "KeyError")]).at_fault is None
