"""Counts of crashes are over all trials, however few bundles are kept or shown."""

from __future__ import annotations

import json
import re
from collections import Counter
from contextlib import closing

import pytest

from crashhunt.crashes import list_bundles
from crashhunt.hunts._progress import Progress
from crashhunt.ledger import Ledger
from crashhunt.results import HuntResults, _found_crashes as tally_module, find_crashes, hunt_state
from crashhunt.results._found_crashes import tally_crashes
from crashhunt.trial import Disturbance, Failure, Outcome, TrialResult, TrialSpec

AGENT = """
class Driver:
    def __init__(self, bug: int = 0):
        self.bug = bug

    def reset(self, seed):
        self.left = 3 + seed % 20

    def act(self, observation):
        self.left -= 1
        if not self.left:
            self.fail()
        return (5.0, 0)

    def fail(self):
        if self.bug > 4:
            raise KeyError("five")
        getattr(self, f"fail_{self.bug}")()

    def fail_1(self):
        raise IndexError("1")

    def fail_2(self):
        raise TypeError("2")

    def fail_3(self):
        raise ZeroDivisionError("3")

    def fail_4(self):
        pass
"""
WORDS = ("--scenario", "toy", "--agent", "driver:Driver", "--arg", "bug=1:5", "--seed", "3", "--keep-going", "--json")


def hunted(shell):
    (shell.folder / "driver.py").write_text(AGENT)
    for name, more in (("all", ()), ("kept", ("--keep", "1"))):
        done = shell.crashhunt("run", name, "2", "9", "40", "--no-snapshot", *WORDS, *more)
        (shell.folder / f"{name}.json").write_text(json.dumps(done.json))
        (shell.folder / f"{name}.txt").write_text(done.err)


@pytest.fixture
def hunts(toy, made_once):
    return made_once(hunted, toy)


def counted(folder):
    """Return the number of crashes of each exception, from the rows of the ledger alone."""
    with closing(Ledger(folder / "ledger.sqlite")) as ledger:
        return Counter(one.failure.kind for one in ledger.results() if one.outcome is Outcome.AGENT_ERROR)


def first_of(folder):
    """Return the first trial of each exception, from the rows of the ledger alone."""
    with closing(Ledger(folder / "ledger.sqlite")) as ledger:
        crashes = [one for one in ledger.results() if one.outcome is Outcome.AGENT_ERROR]
    return {one.failure.kind: one.spec.number for one in sorted(crashes, key=lambda one: -one.spec.number)}


def page_of(shell, hunt, *words):
    done = shell.crashhunt("report", hunt, "--json", *words).json
    page = (shell.folder / done["file"]).read_text()
    return done, json.loads(re.search(r'<script id="data" type="application/json">(.*?)</script>', page, re.S)[1])


@pytest.mark.long
@pytest.mark.parametrize("name", ["all", "kept"])
def test_every_count_of_crashes_is_that_of_the_ledger(hunts, name):
    truth = counted(hunts.folder / name)
    count = sum(truth.values())
    saved = len(list_bundles(hunts.folder / name))
    assert len(truth) == 4
    assert count > 5
    assert (saved < count) is (name == "kept")
    run = json.loads((hunts.folder / f"{name}.json").read_text())
    assert (run["crashes_found"], len(run["crashes"])) == (count, saved)
    assert {kind["words"].partition(" ")[0]: kind["count"] for kind in run["kinds"]} == truth
    said = (hunts.folder / f"{name}.txt").read_text()
    assert f"{count} crashes of 4 types" in said
    assert (f"({saved} of {count} have a bundle)" in said) is (name == "kept")
    assert said.count("shortest ") == 4
    assert f"{saved} of {saved} bundles confirmed" in said

    (state,) = hunts.crashhunt("status", name, "--json").json["hunts"]
    assert (state["crashes"], state.get("crashes_saved")) == (count, saved if saved < count else None)
    assert f"{name}: {count} crashes: " in hunts.crashhunt("status", name).out
    groups = hunts.crashhunt("crashes", name, "--json").json["groups"]
    assert {group["words"].partition(" ")[0]: group["count"] for group in groups} == truth
    assert sum(group["saved"] for group in groups) == saved
    if name == "kept":
        assert {group["avoidable"] for group in groups} == {None}

    for limit in (0, 3) if name == "kept" else (5,):
        done, page = page_of(hunts, name, "--crashes", str(limit))
        shown = min(limit, saved)
        assert (done["crashes_found"], done["crashes_saved"], len(done["crashes"])) == (count, saved, shown)
        assert (page["found"], page["saved"], len(page["crashes"])) == (count, saved, shown)
        assert {kind["words"].partition(" ")[0]: kind["count"] for kind in page["kinds"]} == truth
        assert {kind["words"].partition(" ")[0]: kind["first"] for kind in page["kinds"]} == first_of(
            hunts.folder / name
        )
        assert sorted(place for kind in page["kinds"] for place in kind["members"]) == list(range(shown))
        if limit == 5:
            assert all(kind["members"] for kind in page["kinds"])  # each type has an example
            assert f"shows {shown} of {count} crashes" in hunts.crashhunt("report", name, "--crashes", "5").out


def test_types_of_another_version_are_determined_again(hunts, monkeypatch):
    hunt = hunts.folder / "all"
    truth = counted(hunt)
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        kinds = ledger.facts()["kinds"]
        ledger.note(kinds=[{**kinds[0], "words": "of another version", "count": sum(truth.values())}])
    assert find_crashes(hunt, 0).types == {"of another version": sum(truth.values())}
    monkeypatch.setattr(tally_module, "SIGNATURE_VERSION", 99)
    assert {words.partition(" ")[0]: count for words, count in find_crashes(hunt, 0).types.items()} == truth
    assert {words.partition(" ")[0]: number for words, number in find_crashes(hunt, 0).first.items()} == first_of(hunt)


def test_a_report_reads_only_the_bundles_that_it_shows(hunts, monkeypatch):
    """With 10,000 crashes, a log of each would take minutes."""
    hunt, read = hunts.folder / "all", []
    monkeypatch.setattr(tally_module, "list_bundles", lambda _: pytest.fail("all bundles were read"))
    monkeypatch.setattr(tally_module, "read_bundle", lambda path: read.append(path) or real(path))
    from crashhunt.crashes import read_bundle as real

    found = find_crashes(hunt, 5)
    assert len(read) == len(found.shown) == 5
    steps = sorted(one.result.steps for one in list_bundles(hunt))
    assert found.shown[0].result.steps == steps[0]
    assert len({bundle.result.failure.kind for bundle in found.shown}) == 4


def test_crashes_whose_type_is_not_noted_yet_are_counted_apart(hunts, monkeypatch):
    hunt = hunts.folder / "all"
    monkeypatch.setattr(tally_module, "_MAX_READ_LOGS", 1)
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        kinds = ledger.facts()["kinds"]
        ledger.note(kinds=[{**kinds[0], "count": kinds[0]["count"] - 2}, *kinds[1:]])
    found = find_crashes(hunt, 1)
    assert (found.untyped, sum(found.types.values()) + 2) == (2, found.tally.found)


def recorded(folder, results):
    folder.mkdir(exist_ok=True)
    ledger = Ledger(folder / "ledger.sqlite", writable=True)
    with ledger.together():
        for result in results:
            ledger.record(result, snapshot="s")
    return ledger


def crashed(number, likely=None, *, outcome=Outcome.COLLISION, disturbed=False, origin=""):
    one = Disturbance("brake", "a", 3, 4.0, 2.0) if disturbed else None
    return TrialResult(
        TrialSpec(number, 1, {"ego": {}}, {}, max_steps=9, origin=origin), outcome, steps=number, danger=0.5,
        disturbances=(one,) if one else (), log_likelihood=likely,
        failure=Failure("hang", "x") if outcome is Outcome.HANG else None,
    )  # fmt: skip


def test_disturbed_crashes_and_the_likeliest_are_of_all_trials(tmp_path):
    results = [
        crashed(0, -9.0, disturbed=True), crashed(1, -2.0, disturbed=True), crashed(2, -1.0),
        crashed(3, -0.5, disturbed=True, outcome=Outcome.SURVIVED), crashed(4, None, disturbed=True),
        crashed(5, -0.1, disturbed=True, outcome=Outcome.HANG),
    ]  # fmt: skip
    with closing(recorded(tmp_path / "h", results)) as ledger:
        found = tally_crashes(ledger, ("collision",), disturbed=True)
        assert (found.found, found.disturbed, found.likeliest, found.log_likelihood) == (4, 3, "000001-collision", -2.0)
        assert tally_crashes(ledger, ("off_road",), disturbed=True).found == 0
        again = tally_crashes(ledger, ("collision",), disturbed=False)
        for result in results:
            if result.outcome is Outcome.HANG:
                again.disturbed, again.likeliest, again.log_likelihood = found.disturbed, found.likeliest, -2.0
                again.add(result)
        assert (again.found, again.disturbed, again.likeliest) == (5, 4, "000005-hang")
        ledger.note(disturb=["brake=0.1"], crash_on=["collision"], owner=None)
        ledger.enter("all_trials")
    state = hunt_state(tmp_path / "h")  # no bundle is there, as with --keep
    assert (state.crashes, state.crashes_saved, state.disturbed, state.state) == (4, 0, 3, "crashed")


def test_a_resumed_hunt_counts_the_strategies_of_all_its_trials(tmp_path):
    results = [
        *(crashed(number, origin="mutation", outcome=Outcome.SURVIVED) for number in range(3)),
        crashed(3, origin="mutation"),
        crashed(4, origin="random"),
        crashed(5),
    ]
    with closing(recorded(tmp_path / "h", results)) as ledger:
        progress = Progress()
        progress.searching.resume(6, ledger.tried_by_origin(("collision",)))
    one, other = progress.searching.status().strategies
    assert (one.name, one.trials, one.share, one.danger, one.crashes) == ("mutation", 4, 4 / 6, (1.5 + 1) / 4, 1)
    assert (other.name, other.trials, other.danger, other.crashes) == ("random", 1, 1.0, 1)
    progress.searching.take(crashed(6, origin="random"), crashed=True)
    assert [one.trials for one in progress.searching.status().strategies] == [4, 2]


def test_a_hunt_of_before_takes_what_counts_from_its_settings(hunts):
    hunt = hunts.folder / "kept"
    count = sum(counted(hunt).values())
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        ledger.note(crash_on=None)
    assert hunt_state(hunt).crashes == HuntResults(hunt).state.crashes == count
    (hunt / "hunt.toml").unlink()
    assert hunt_state(hunt).crashes == count  # bundles, and those that the ledger says were deleted
