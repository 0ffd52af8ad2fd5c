"""Which kinds of crashes a hunt has found: when there are enough, and how long ago the last new one came."""

from __future__ import annotations

import json
import time
from contextlib import closing
from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from crashhunt.base import pacing
from crashhunt.base.errors import UsageError
from crashhunt.crashes import (
    Cause,
    CauseGroup,
    Factor,
    Group,
    Judgement,
    LeftOut,
    Signature,
    Why,
    count_causes,
    join_causes,
)
from crashhunt.hunts._reports import kind_data
from crashhunt.ledger import Ledger
from crashhunt.plans import RunSettings
from crashhunt.results import _found_crashes as _crashes
from crashhunt.results._found_crashes import Judged, Kinds, dropped_crashes, find_crashes, prune_bundles
from crashhunt.trial import Collision, Failure, Outcome, TrialResult, TrialSpec


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
        {"words": "IndexError: said", "count": 2, "first": "c0", "shortest": "c0"},
        {"words": "KeyError: said", "count": 2, "first": "c1", "shortest": "c1"},
    ]


def test_a_screen_does_not_wait_for_groups_that_take_long(monkeypatch):
    now, group = [0.0], _crashes.groups_of

    def slowly(*given):
        now[0] += 1.0
        return group(*given)

    monkeypatch.setattr(_crashes, "groups_of", slowly)
    monkeypatch.setattr(pacing, "time", SimpleNamespace(monotonic=lambda: now[0]))
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
    assert [bundle.id for bundle in kinds.drop_excess(1)] == ["c3", "c0"]
    assert kinds.drop_excess(1) == []
    kinds.add(crash(5, "KeyError", 2), 5)
    assert [bundle.id for bundle in kinds.drop_excess(1)] == ["c1"]
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
    assert [bundle.id for bundle in kinds.drop_excess(1)] == ["c2"]
    again = Kinds(0, crashes, dropped=kinds.dropped)  # the ledger was told, and the bundle is there
    assert again.groups()[0].count == 2
    assert [bundle.id for bundle in again.drop_excess(1)] == ["c2"]
    assert (again.dropped, again.groups()[0].count) == (kinds.dropped, 2)


def test_what_was_hunted_for_is_kept_before_what_is_shorter(monkeypatch):
    monkeypatch.setattr(_crashes, "fault_of", lambda bundle, _: SimpleNamespace(is_egos=bundle.id != "c1"))
    kinds = Kinds(1, [crash(1, "KeyError", 4), crash(2, "KeyError", 9), crash(3, "KeyError", 6)], only_at_fault=True)
    assert [bundle.id for bundle in kinds.drop_excess(1)] == ["c2", "c1"]
    noted = kinds.dropped_facts()
    assert (kinds.at_fault, noted["dropped_at_fault"]) == ((2, 3), [2])  # with or without a bundle
    again = Kinds(1, [crash(3, "KeyError", 6)], only_at_fault=True, **noted)
    assert (again.until, again.at_fault) == (kinds.until, (2, 3))


def test_the_one_that_wants_several_kinds_continues_after_the_first_crash():
    assert RunSettings(distinct=3).checked().keep_going
    assert not RunSettings().checked().keep_going
    with pytest.raises(UsageError, match="--distinct is -1"):
        RunSettings(distinct=-1).checked()


def test_only_the_agents_own_crashes_count_where_that_was_asked(monkeypatch):
    monkeypatch.setattr(_crashes, "fault_of", lambda bundle, _: SimpleNamespace(is_egos=bundle.id in ("c4", "c6")))
    kinds = Kinds(1, only_at_fault=True)
    kinds.add(crash(3, "KeyError"), 1)
    assert (kinds.until, kinds.at_fault) == (None, ())
    kinds.add(crash(6, "KeyError"), 2)
    assert (kinds.until, kinds.at_fault) == (6, (6,))
    kinds.add(crash(4, "IndexError"), 3)
    assert (kinds.until, kinds.at_fault) == (4, (4, 6))
    assert len(kinds.groups()) == 2  # all are shown
    assert Kinds(2, [crash(3, "KeyError")]).at_fault is None


def collision(number, steps=5, judgement=None):
    spec = TrialSpec(number, 1, {"ego": {}}, {}, max_steps=10)
    hit = Collision("ego", "", "alone", "", "", 0.0, 0.0, "", 0.0, 0.0, 0.0)
    result = TrialResult(spec, Outcome.COLLISION, steps=steps, collision=hit)
    added = {} if judgement is None else {"judged": judgement.to_json()}
    return SimpleNamespace(result=result, path=f"c{number}", id=f"c{number}", added=added, recording=lambda: None)


@pytest.fixture
def one_type(monkeypatch):
    """All collisions have one signature, and features that nothing distinguishes."""
    monkeypatch.setattr(_crashes, "signature_of", lambda bundle, _: bundle.result.outcome)
    monkeypatch.setattr(_crashes, "features_of", lambda bundle, _: (float(bundle.result.spec.number),))


def test_log_is_not_read_where_the_recording_is_at_hand(monkeypatch):
    used = []
    found = {"signature_of": "type", "features_of": (0.0,), "fault_of": SimpleNamespace(is_egos=True)}
    for name, answer in found.items():
        monkeypatch.setattr(_crashes, name, lambda _, given, answer=answer: used.append(given) or answer)
    bundle = collision(3)
    bundle.recording = lambda: pytest.fail("reads the log")
    Kinds(1, only_at_fault=True, by_cause=3).add(bundle, 1, "recording")
    assert used == ["recording"] * 3


def settle(kinds, bundle, what, **more):
    kinds.settle(Judged(bundle, Cause("omission", what) if what else None, **more))


def test_each_cause_of_a_type_counts_where_causes_count(one_type):
    kinds = Kinds(2, by_cause=3)
    crashes = [collision(number) for number in (3, 5, 9)]
    for bundle in crashes:
        kinds.add(bundle, 1)
    assert (kinds.until, kinds.types_by_cause, kinds.count_to_judge()) == (None, 1, 3)
    first = kinds.next_to_judge()
    assert first is crashes[0]
    settle(kinds, first, "vehicle")
    assert (kinds.until, kinds.types_by_cause) == (None, 1)  # not one without a cause, and one with it
    second = kinds.next_to_judge()
    assert second is crashes[2]  # the furthest
    settle(kinds, second, "red light")
    assert (kinds.until, kinds.types_by_cause) == (9, 2)
    assert Kinds(2, crashes).types_by_cause is None


@pytest.fixture
def three_types(monkeypatch):
    """The number of a crash decides its crash type: 0, 1 or 2."""
    monkeypatch.setattr(_crashes, "signature_of", lambda bundle, _: bundle.result.spec.number % 3)
    monkeypatch.setattr(_crashes, "features_of", lambda bundle, _: (0.0,))


def test_a_cause_of_several_types_counts_once_and_types_without_an_answer_do_not_end_a_hunt(three_types):
    kinds = Kinds(2, by_cause=3)
    crashes = [collision(number) for number in (3, 4, 5)]
    for bundle in crashes:
        kinds.add(bundle, 1)
    assert (kinds.until, kinds.types_by_cause) == (None, 3)  # three types, and none is judged
    assert [kinds.next_to_judge() for _ in crashes] == crashes
    settle(kinds, crashes[0], "vehicle")
    settle(kinds, crashes[1], "vehicle")
    assert (kinds.until, kinds.types_by_cause) == (None, 2)  # one cause, and a type without an answer
    settle(kinds, crashes[2], None)  # it cannot be run again
    assert (kinds.until, kinds.types_by_cause) == (5, 2)


@pytest.mark.parametrize(
    ("kinds_of_causes", "counts"),
    [
        (["omission", "unknown"], (1, 1)),
        (["unknown", "unknown"], (1, 0)),
        (["traffic", "unknown"], (1, 1)),
        (["omission", "decision"], (2, 0)),
    ],
)
def test_types_by_cause_are_as_many_as_the_list_of_crashes_counts(one_type, kinds_of_causes, counts):
    """A judged crash whose runs show no cause may be one of the cause that counts."""
    kinds, crashes = Kinds(3, by_cause=3), [collision(number) for number in (3, 5)]
    for bundle, kind in zip(crashes, kinds_of_causes, strict=True):
        kinds.add(bundle, 1)
        kinds.settle(Judged(kinds.next_to_judge(), Cause(kind)))
    group = Group(Signature(outcome="collision", role="collider", manner="rear end"), tuple(crashes))
    parts = [
        CauseGroup(cause=Cause(kind), members=members, judged=members)
        for kind in dict.fromkeys(kinds_of_causes)
        for members in [tuple(one for one, of in zip(crashes, kinds_of_causes, strict=True) if of == kind)]
    ]
    assert count_causes(join_causes([group], [parts])) == counts
    assert kinds.types_by_cause == counts[0]


@pytest.mark.parametrize("kind", ["traffic", "software fault"])
def test_causes_that_name_no_defect_count_for_each_type(three_types, kind):
    kinds = Kinds(2, by_cause=3)
    for bundle in [collision(3), collision(4)]:
        kinds.add(bundle, 1)
        kinds.settle(Judged(kinds.next_to_judge(), Cause(kind)))
    assert (kinds.until, kinds.types_by_cause) == (4, 2)


def test_length_of_the_other_counts_only_where_no_car_was_disregarded(three_types):
    kinds = Kinds(2, by_cause=3)
    for bundle, actor in ((collision(3), "long"), (collision(4), "")):
        kinds.add(bundle, 1)
        kinds.settle(Judged(kinds.next_to_judge(), Cause("omission", "vehicle", "sped up", actor)))
    assert (kinds.until, kinds.types_by_cause) == (None, 1)


def test_hunt_that_has_found_enough_stays_so(three_types):
    """A crash of a type without a cause may later have a cause that counts already."""
    kinds = Kinds(2, by_cause=3)
    for number, what in ((3, "vehicle"), (4, None)):
        kinds.add(collision(number), 1)
        settle(kinds, kinds.next_to_judge(), what)
    assert kinds.until == 4
    kinds.add(collision(7), 2)
    settle(kinds, kinds.next_to_judge(), "vehicle")
    assert (kinds.until, kinds.types_by_cause) == (4, 1)


def test_keep_retains_each_cause_of_each_type(three_types):
    kinds = Kinds(0, by_cause=2)
    for number, steps in ((3, 5), (6, 9), (9, 7), (4, 8), (7, 6), (10, 9)):
        kinds.add(collision(number, steps), 1)
    while (chosen := kinds.next_to_judge()) is not None:
        settle(kinds, chosen, "vehicle")
    assert {bundle.id for bundle in kinds.drop_excess(1)} == {"c6", "c9", "c4", "c10"}


def test_keep_retains_each_cause_once_it_is_known(one_type):
    kinds = Kinds(0, by_cause=2)
    for number, steps in enumerate([9, 8, 7, 6, 5, 4]):
        kinds.add(collision(number, steps), 1)
    assert kinds.drop_excess(1) == []  # nothing is known yet
    settle(kinds, kinds.next_to_judge(), "vehicle")
    rare = kinds.next_to_judge()
    assert rare.id == "c0"  # the longest, furthest from the shortest
    settle(kinds, rare, None, is_stopped=True)
    assert kinds.next_to_judge() is rare
    assert kinds.drop_excess(1) == []
    settle(kinds, rare, "red light")
    # Of each cause, the crash that was judged stays, and the shortest of the others.
    assert {bundle.id for bundle in kinds.drop_excess(1)} == {"c1", "c2", "c3", "c4"}
    assert {bundle.id for group in kinds.groups() for bundle in group.bundles} == {"c5", "c0"}
    assert kinds.groups()[0].count == 6


def test_crashes_that_were_never_judged_are_pruned_at_the_end(one_type):
    kinds = Kinds(0, by_cause=8)
    for number, steps in ((1, 9), (2, 4)):
        kinds.add(collision(number, steps), 1)
        settle(kinds, kinds.next_to_judge(), "vehicle")
    assert kinds.drop_excess(1) == []  # more crashes may come, to be judged
    assert [bundle.id for bundle in kinds.drop_excess(1, final=True)] == ["c1"]


def test_resumed_hunt_counts_causes_that_bundles_contain(one_type):
    factor = Factor("agent", "ego", "sped up", 7, None, (LeftOut(0, "none"), LeftOut(1, "none")))
    kinds = Kinds(1, [collision(4, judgement=Judgement(why=Why((factor,)))), collision(6)], by_cause=8)
    assert (kinds.until, kinds.types_by_cause, kinds.count_to_judge()) == (4, 1, 1)
    assert kinds.next_to_judge().id == "c6"


def test_resumed_hunt_ends_at_the_same_trial_although_the_first_crash_of_a_type_was_deleted(three_types):
    crashes = [collision(3, steps=9), collision(6, steps=4), collision(5)]
    kinds = Kinds(2, crashes)
    assert kinds.until == 5
    assert [bundle.id for bundle in kinds.drop_excess(1)] == ["c3"]
    assert Kinds(2, crashes[1:], dropped=kinds.dropped).until == 5


def test_resumed_hunt_counts_a_type_of_which_the_crash_at_fault_was_deleted(three_types, monkeypatch):
    monkeypatch.setattr(_crashes, "fault_of", lambda bundle, _: SimpleNamespace(is_egos=False))
    assert Kinds(1, [collision(3)], only_at_fault=True, dropped={"0": [9]}).until is None
    assert Kinds(1, [collision(3)], only_at_fault=True, dropped={"0": [9]}, dropped_at_fault=[9]).until == 9


@pytest.mark.parametrize("only_at_fault", [False, True])
def test_resumed_hunt_knows_the_causes_of_crashes_whose_bundles_were_deleted(one_type, monkeypatch, only_at_fault):
    monkeypatch.setattr(_crashes, "fault_of", lambda bundle, _: SimpleNamespace(is_egos=bundle.id != "c9"))
    kinds = Kinds(1, by_cause=4, only_at_fault=only_at_fault)
    crashes = [collision(number, steps) for number, steps in ((1, 9), (2, 7), (5, 8), (9, 3), (11, 5))]
    for bundle in crashes:
        kinds.add(bundle, 1)
    causes = {1: "vehicle", 2: "vehicle", 5: None, 9: "vehicle", 11: "red light"}
    while (chosen := kinds.next_to_judge()) is not None:
        settle(kinds, chosen, causes[chosen.result.spec.number])
    gone = {bundle.id for bundle in kinds.drop_excess(1)}
    stored = json.loads(json.dumps(kinds.dropped_facts()))

    judged = {number: SimpleNamespace(is_interrupted=False, what=what) for number, what in causes.items() if what}
    monkeypatch.setattr(_crashes, "judgement_of", lambda bundle: judged.get(bundle.result.spec.number))
    monkeypatch.setattr(_crashes, "cause_of", lambda _, judgement: Cause("omission", judgement.what))
    left = [bundle for bundle in crashes if bundle.id not in gone]
    more = {**stored, "only_at_fault": only_at_fault}
    again = Kinds(1, left, by_cause=4, **more)
    assert (again.until, again.types_by_cause, again.count_to_judge()) == (kinds.until, 2, 0)
    for both in (kinds, again):
        both.add(collision(3, 2), 6)
        both.add(collision(12, 1), 7)
    assert [bundle.id for bundle in again.drop_excess(1)] == [bundle.id for bundle in kinds.drop_excess(1)]
    assert again.dropped_judged == kinds.dropped_judged == stored["dropped_judged"]
    # It was killed before it had deleted them.
    killed = Kinds(1, crashes, by_cause=4, **more)
    assert (killed.until, any(killed.dropped_judged.values())) == (kinds.until, False)


def test_crashes_of_other_code_do_not_count_and_stay_in_the_ledger(one_type, monkeypatch):
    monkeypatch.setattr(_crashes, "fault_of", lambda *_: SimpleNamespace(is_egos=True))
    noted = {
        "dropped": {"collision": [1, 7]}, "dropped_at_fault": [1, 7],
        "dropped_judged": {"collision": {"1": {"cause": None}, "7": {"cause": None}}},
    }  # fmt: skip
    kinds = Kinds(1, [collision(9)], only_at_fault=True, apart={1, 2, 3}, **noted)
    assert (kinds.until, kinds.at_fault, [group.count for group in kinds.groups()]) == (7, (7, 9), [2])
    kinds.add(collision(12), 3)
    assert [bundle.id for bundle in kinds.drop_excess(1)] == ["c12"]
    facts = kinds.dropped_facts()
    assert {words: sorted(numbers) for words, numbers in facts["dropped"].items()} == {"collision": [1, 7, 12]}
    assert facts["dropped_at_fault"] == [1, 7, 12]
    assert facts["dropped_judged"] == noted["dropped_judged"]


def test_software_faults_need_no_runs_for_their_cause():
    kinds = Kinds(2, [crash(1, "KeyError"), crash(2, "IndexError")], by_cause=8)
    assert (kinds.until, kinds.next_to_judge(), kinds.types_by_cause) == (2, None, 2)
    assert [bundle.id for bundle in Kinds(0, [crash(1, "A"), crash(2, "A")], by_cause=8).drop_excess(1)] == ["c2"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"by_cause": 8}, "--by-cause 8 has no effect without --distinct or --keep"),
        ({"by_cause": 8, "distinct": 2, "deterministic": True}, "--deterministic and --by-cause"),
        ({"by_cause": -1}, "--by-cause is -1"),
    ],
)
def test_impossible_options_are_refused(options, words):
    with pytest.raises(UsageError, match=words):
        RunSettings(**options).checked()


# Bundles that are deleted, and crashes that are shown.


@dataclass
class Saved:
    """In place of a bundle."""

    id: str
    path: object
    steps: int = 5

    @property
    def result(self):
        number = int(self.id.partition("-")[0])
        return SimpleNamespace(spec=SimpleNamespace(number=number), steps=self.steps)


def test_deleted_bundles_are_noted_before_they_are_removed(tmp_path, monkeypatch):
    calls, asked = [], []
    crashes = [Saved(f"{number:06d}-collision", tmp_path / str(number)) for number in range(4)]
    kinds = SimpleNamespace(
        drop_excess=lambda keep, *, final: asked.append((keep, final)) or [crashes[2], crashes[0]],
        dropped_facts=lambda: {"dropped": {"a": [2, 0]}, "dropped_at_fault": [2], "dropped_judged": None},
    )  # fmt: skip
    monkeypatch.setattr(_crashes, "remove_at_once", lambda path: calls.append(path.name))
    ledger = SimpleNamespace(note=lambda **facts: calls.append(facts))
    assert prune_bundles(ledger, kinds, crashes, 3) == [crashes[1], crashes[3]]
    noted = {"dropped": {"a": [2, 0]}, "dropped_at_fault": [2], "dropped_judged": None}
    assert calls == [noted, "2", "0"]
    assert asked == [(3, False)]
    calls.clear()
    kinds.drop_excess = lambda keep, *, final: asked.append((keep, final)) or []
    assert prune_bundles(ledger, kinds, crashes, 3, final=True) is crashes
    assert asked[-1] == (3, True)
    assert prune_bundles(ledger, kinds, crashes, 0) is prune_bundles(ledger, None, crashes, 3) is crashes
    assert (calls, len(asked)) == ([], 2)


def test_deleted_bundles_of_several_hunts_are_added_up(tmp_path):
    for name, dropped in (("a", {"x": [1, 2], "y": [3]}), ("b", {"x": [4]}), ("c", None)):
        (tmp_path / name).mkdir()
        with closing(Ledger(tmp_path / name / "ledger.sqlite", writable=True)) as ledger:
            ledger.note(dropped=dropped)
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "ledger.sqlite").write_bytes(b"no database" * 99)
    hunts = [tmp_path / name for name in ("a", "nowhere", "d", "b", "c")]
    assert dropped_crashes(hunts) == {"x": 3, "y": 1}


@pytest.fixture
def saved(tmp_path, monkeypatch):
    """A hunt with bundles of five crashes; trial 4 is the shortest, and 3 and 9 are of a type of their own."""
    steps, read = {1: 50, 2: 40, 3: 90, 4: 10, 9: 90}, []
    for number in steps:
        (tmp_path / "crashes" / f"{number:06d}-collision").mkdir(parents=True)

    def bundle(folder):
        read.append(folder.name)
        return Saved(folder.name, folder, steps[int(folder.name.partition("-")[0])])

    folders = sorted((tmp_path / "crashes").iterdir())
    monkeypatch.setattr(_crashes, "read_bundle", bundle)
    monkeypatch.setattr(_crashes, "list_bundles", lambda directory: list(map(bundle, folders)))

    def grouped(bundles, dropped, *, faults):
        assert faults is False
        groups = {}
        for one in bundles:
            groups.setdefault("own" if one.steps == 90 else "rear-end", []).append(one)
        found = []
        for name, ones in groups.items():
            shortest, count = min(ones, key=lambda one: one.steps), len(ones) + dropped.get(name, 0)
            found.append(SimpleNamespace(signature=name, count=count, first=ones[0], shortest=shortest))
        return SimpleNamespace(groups=found)

    monkeypatch.setattr(_crashes, "group_crashes", grouped)
    return SimpleNamespace(path=tmp_path, read=read, steps=steps)


def numbers(found):
    return [bundle.result.spec.number for bundle in found.shown]


def test_crashes_without_a_ledger_are_those_with_a_bundle(saved):
    found = find_crashes(saved.path, 3)
    assert (found.tally.found, found.saved, found.untyped) == (5, 5, 0)
    assert list(found.types.items()) == [("rear-end", 3), ("own", 2)]
    assert found.shortest == {"rear-end": "000004-collision", "own": "000003-collision"}
    assert found.first == {"rear-end": 1, "own": 3}
    assert numbers(found) == [4, 2, 3]  # one of each type, then the shortest
    assert numbers(find_crashes(saved.path, 1)) == [4]
    assert numbers(find_crashes(saved.path, 9)) == [4, 2, 1, 3, 9]
    assert numbers(find_crashes(saved.path, 0)) == []


def test_crashes_of_a_hunt_are_those_of_its_ledger(saved):
    kinds = [
        {"words": "rear-end", "count": 5, "first": "000001-collision", "shortest": "000004-collision"},
        {"words": "own", "count": 3, "first": "000003-collision", "shortest": "000009-collision"},
    ]
    with closing(Ledger(saved.path / "ledger.sqlite", writable=True)) as ledger:
        for number, steps in {**saved.steps, 5: 70, 6: 80}.items():
            spec = TrialSpec(number, 1, {}, {}, 99)
            ledger.record(TrialResult(spec, Outcome.COLLISION, steps=steps), snapshot="")
        ledger.record(TrialResult(TrialSpec(7, 1, {}, {}, 99), Outcome.SURVIVED, steps=1), snapshot="")
        ledger.note(crash_on=["collision"], dropped={"rear-end": [5, 6], "gone": [8]}, kinds=kinds)
        ledger.note(kinds_version=_crashes.SIGNATURE_VERSION)
    found = find_crashes(saved.path, 2)
    assert (found.tally.found, found.saved, found.untyped) == (8, 5, 0)  # a bundle is written before its row
    assert found.types == {"rear-end": 5, "own": 3}
    assert numbers(found) == [4, 9]
    assert sorted(saved.read) == ["000004-collision", "000009-collision"]
    assert numbers(find_crashes(saved.path, 4)) == [4, 2, 1, 9]
    with closing(Ledger(saved.path / "ledger.sqlite", writable=True)) as ledger:
        ledger.note(kinds=[kinds[0]])  # not all of them: the logs are read
    found = find_crashes(saved.path, 2)
    assert (found.types, found.untyped) == ({"rear-end": 5, "own": 2, "gone": 1}, 0)
    assert found.shortest["own"] == "000003-collision"
    assert found.first == {"rear-end": 1, "own": 3, "gone": 8}
    with closing(Ledger(saved.path / "ledger.sqlite", writable=True)) as ledger:
        ledger.note(kinds=kinds, kinds_version=_crashes.SIGNATURE_VERSION + 1)
    assert find_crashes(saved.path, 2).types == {"rear-end": 5, "own": 2, "gone": 1}


def test_outcomes_that_count_are_noted_or_in_the_settings(tmp_path):
    assert _crashes.outcomes_of_crashes(tmp_path, {"crash_on": ["hang"]}) == ["hang"]
    assert _crashes.outcomes_of_crashes(tmp_path, {"crash_on": []}) == []
    assert _crashes.outcomes_of_crashes(tmp_path, {}) is None
    assert _crashes._number("000012-collision") == 12
    assert _crashes._number("mine") == -1
