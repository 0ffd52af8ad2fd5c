"""Until when braking would have helped: further trials of a slot, of which some are killed from outside."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from crashhunt import crashes
from crashhunt.base.errors import BundleError
from crashhunt.executors import _escape_search, _trial_folder
from crashhunt.executors._escape_search import with_escape
from crashhunt.executors._trial_attempts import LostTrialError
from crashhunt.trial import Collision, Escape, Outcome, TrialResult, TrialSpec

HIT = Collision("ego", "collider", "ego", "x", ("overlap",), "overlap", 1.0, 2.0)
CRASH = TrialResult(TrialSpec(4, 1, {}, {}, 90), Outcome.COLLISION, steps=30, collision=HIT)
FOUND = Escape(3, 4, 7.5, "with full braking")


@pytest.fixture
def search(monkeypatch, tmp_path):
    """Calls `with_escape` with a supervisor that loses the first trials."""
    asked = SimpleNamespace(numbers=[], braking=None, ended=[], error=None)
    monkeypatch.setattr(_escape_search, "read_black_box", lambda path: [])
    monkeypatch.setattr(_escape_search, "Recording", lambda records: "recording")

    def find(result, recording, braking, run, borders):
        asked.braking = braking
        if asked.error is not None:
            raise asked.error
        asked.ended.append(run(TrialSpec(9, 1, {}, {}, 20)))
        return FOUND

    monkeypatch.setattr(crashes, "find_escape", find, raising=False)

    def search(lost=0, *, result=CRASH, braking=None, retires=False, find_escapes=True, zygote_ends=False):
        def run(spec):
            asked.numbers.append(spec.number)
            if len(asked.numbers) <= lost:
                supervisor.retires = zygote_ends
                raise LostTrialError(-9)
            return SimpleNamespace(result=result)

        asked.numbers.clear()
        settings = SimpleNamespace(find_escapes=find_escapes, scratch=tmp_path)
        supervisor = SimpleNamespace(retires=retires, run=run)
        return with_escape(supervisor, settings, SimpleNamespace(result=result, braking=braking))

    search.asked = asked
    return search


@pytest.mark.parametrize("lost", [0, 2])
def test_a_trial_of_the_search_is_run_up_to_three_times(search, lost):
    found = search(lost)
    assert (found.escape, found.why_no_escape) == (FOUND, "")
    assert len({*search.asked.numbers}) == lost + 1  # each has a folder of its own, apart from those of the hunt
    assert min(search.asked.numbers) > 1 << 32
    assert search.asked.ended[-1] == (CRASH, "recording")


def test_a_search_that_is_always_killed_states_so_and_leaves_it_open(search):
    found = search(3)
    assert found.escape is None
    assert found.why_no_escape == "the process that searched was killed by SIGKILL, 3 times"
    assert len(search.asked.numbers) == 3
    search.asked.error = BundleError("the log is damaged", fix="")
    assert search().escape == Escape(why_not="the log is damaged")


def test_a_search_whose_zygote_has_ended_is_not_tried_in_vain(search):
    """The message counts the kills that happened."""
    found = search(1, zygote_ends=True)
    assert (found.escape, found.why_no_escape) == (None, "the process that searched was killed by SIGKILL")
    assert len(search.asked.numbers) == 1


@pytest.mark.parametrize(("deceleration", "expected"), [(4, 4.0), (7.5, 7.5), (None, None)])
def test_the_search_brakes_with_the_deceleration_of_the_simulator(search, deceleration, expected):
    search(braking={"how": "with full braking", "deceleration": deceleration})
    assert (search.asked.braking.how, search.asked.braking.deceleration) == ("with full braking", expected)
    search()
    assert search.asked.braking is None


def test_whatever_lies_in_the_way_is_removed_and_what_a_link_leads_to_is_not(tmp_path):
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "inner").write_text("x")
    (tmp_path / "link").symlink_to("kept")
    (tmp_path / "broken").symlink_to("nowhere")
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "inner").write_text("x")
    for name in ("link", "broken", "file", "folder", "gone"):
        _trial_folder._remove(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]
    assert (tmp_path / "kept" / "inner").exists()
