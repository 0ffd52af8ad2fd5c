"""What `check` finds on disk, each kind of damage by itself."""

from __future__ import annotations

import errno
import json
import shutil
import sqlite3
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from crashhunt import recording
from crashhunt.base.integrity import digest_of_data
from crashhunt.base.process_owners import this_process
from crashhunt.crashes import export_crash, find_bundle
from crashhunt.errors import BundleError, CrashhuntError, HuntDirectoryError
from crashhunt.hunts import check, salvage
from crashhunt.hunts._hunt_file_check import intact_snapshots
from crashhunt.ledger import Ledger, Turn
from crashhunt.results import hunt_state
from crashhunt.results._hunt_state import ledger_owner
from crashhunt.trial import Outcome

FROZEN = Path(__file__).parents[1] / "e2e" / "frozen" / "version-1" / "hunt"
CRASH = "000000-collision"
READ: dict[bytes, recording.Recording] = {}  # by the content of its log


@pytest.fixture
def hunt(tmp_path):
    """A hunt of four trials on the toy, of which 0 and 2 crashed."""
    return Path(shutil.copytree(FROZEN, tmp_path / "h"))


@pytest.fixture(autouse=True)
def _read_once(monkeypatch):
    """Read each log once for all tests: to decode it takes longer than the rest of a check."""
    read = recording.read_log

    def read_log(path):
        content = path.read_bytes() if path.is_file() else b""
        if content not in READ:
            READ[content] = read(path)
        return READ[content]

    monkeypatch.setattr(recording, "read_log", read_log)


def found_in(path):
    (found,) = check(path)
    return found


def only_finding(path):
    (finding,) = found_in(path).findings
    return finding


def execute(hunt, *statements):
    with closing(sqlite3.connect(hunt / "ledger.sqlite")) as database, database:
        for statement in statements:
            database.execute(statement)


def cut(file):
    file.write_bytes(file.read_bytes()[:-9])


def signed(file, **change):
    """Change a crash.json as a later crashhunt might have written it."""
    data = json.loads(file.read_text()) | change
    del data["integrity"]
    file.write_text(json.dumps(data | {"integrity": digest_of_data(data)}))


def test_near_misses_and_minimized_crashes_are_no_crashes(hunt):
    near = hunt / "near-misses" / "000001-survived"
    shutil.copytree(hunt / "crashes" / CRASH, near)
    signed(near / "crash.json", outcome="survived", collision=None)
    shutil.copytree(hunt / "crashes" / CRASH, hunt / "crashes" / f"{CRASH}.small")
    found = found_in(hunt)
    assert (found.crash_count, found.minimized, found.near_misses) == (2, 1, ["000001-survived"])
    alone = found_in(near)
    assert (alone.crash_count, alone.near_misses) == (0, ["000001-survived"])


def test_what_is_whole_is_fine(hunt):
    assert found_in(hunt).to_json() == {
        "dir": str(hunt), "kind": "hunt", "fine": True, "protected": True, "trials": 4, "damaged_trials": [],
        "crashes": [CRASH, "000002-collision"], "damaged_crashes": [], "findings": [],
    }  # fmt: skip
    shutil.copytree(hunt, hunt.parent / "town" / "0")
    assert [found.dir for found in check(hunt.parent)] == [hunt, hunt.parent / "town" / "0"]
    one = found_in(hunt / "crashes" / CRASH)
    assert (one.kind, one.crashes, one.fine) == ("crash", [CRASH], True)
    with pytest.raises(HuntDirectoryError):
        check(hunt.parent / "nowhere")


def test_a_low_limit_on_open_files_is_not_taken_for_damage(hunt, monkeypatch):
    error = OSError(errno.EMFILE, "Too many open files")
    monkeypatch.setattr("crashhunt.hunts._hunt_file_check.error_of_next_files", lambda count: error)
    monkeypatch.setattr("resource.getrlimit", lambda which: (5, 5))
    with pytest.raises(CrashhuntError, match="cannot open files: Too many open files; the limit on open files is 5: "):
        check(hunt)


def test_a_full_disk_is_not_taken_for_damage(hunt, monkeypatch):
    def opened(*_, **__):
        raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr("crashhunt.ledger._writer.opened", opened)
    with pytest.raises(HuntDirectoryError, match="the disk is full"):
        check(hunt)
    assert hunt_state(hunt).detail.startswith("ledger.sqlite: the disk is full")  # `status` writes the folder before it


def test_a_row_that_has_changed_is_a_damaged_trial(hunt):
    execute(hunt, "UPDATE trials SET steps = steps + 1 WHERE number = 1")
    found = found_in(hunt)
    assert (found.trials, found.damaged_trials, found.fine) == ({0, 2, 3}, {1}, False)
    (finding,) = found.findings
    assert finding.lost == "trials 1"
    assert finding.where == str(hunt / "ledger.sqlite")
    assert "--salvage TO" in finding.fix


def test_many_damaged_trials_are_counted_and_some_are_named(hunt):
    text = (hunt / "hunt.toml").read_text()
    (hunt / "hunt.toml").write_text(text.replace("\ntrials = 4\n", "\ntrials = 9\n"))
    execute(hunt, "UPDATE trials SET steps = steps + 1")
    assert "trials 0, 1, 2, 3" in {finding.lost for finding in found_in(hunt).findings}


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE hunt SET value = '7' WHERE key = 'planned'",
        "UPDATE events SET detail = 'x'",
        "DELETE FROM trials WHERE number = 3",
    ],
)
def test_everything_that_the_ledger_has_is_read(hunt, statement):
    assert found_in(hunt).fine
    execute(hunt, statement)
    found = found_in(hunt)
    assert not found.fine
    assert any(finding.where.startswith(str(hunt / "ledger.sqlite")) for finding in found.findings)


def test_replaced_and_proposed_trials_are_read(hunt):
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        ledger.replace([3])
    assert found_in(hunt).trials == {0, 1, 2}
    with closing(sqlite3.connect(hunt / "ledger.sqlite")) as database, database:
        columns = {name for _, name, *_ in database.execute("PRAGMA table_info(replaced)")}
        database.execute(f"UPDATE replaced SET {'result' if 'result' in columns else 'steps'} = '{{}}'")
    assert not found_in(hunt).fine


def test_a_ledger_that_is_gone_or_no_ledger_is_reported(hunt):
    ledger = hunt / "ledger.sqlite"
    ledger.write_bytes(b"no database" * 100)
    finding = only_finding(hunt)
    assert (finding.where, finding.lost) == (str(ledger), "all trials but the crashes")
    ledger.unlink()
    finding = only_finding(hunt)
    assert (finding.where, finding.what, finding.lost) == (str(ledger), "is missing", "all trials but the crashes")
    (hunt / "crashhunt-case.toml").touch()  # of a case in a corpus there is none
    assert found_in(hunt).fine


def test_settings_that_cannot_be_read_are_reported_and_those_of_the_snapshot_serve(hunt):
    (hunt / "hunt.toml").write_text("nothing")
    finding = only_finding(hunt)
    assert (finding.where, finding.lost) == (str(hunt / "hunt.toml"), "what the hunt was asked")
    shutil.rmtree(hunt / "snapshots")
    assert not found_in(hunt).fine


@pytest.mark.parametrize("name", ["crash.json", "log.mcap"])
def test_a_crash_that_cannot_be_read_is_damaged(hunt, name):
    cut(hunt / "crashes" / CRASH / name)
    found = found_in(hunt)
    assert (found.crashes, found.damaged_crashes) == (["000002-collision"], [CRASH])
    assert found.findings[0].where == str(hunt / "crashes" / CRASH / name)
    assert all(str(hunt / "crashes" / CRASH) in finding.where for finding in found.findings)
    assert found.findings[0].damaged
    one = found_in(hunt / "crashes" / CRASH)
    assert (one.crashes, one.damaged_crashes, one.fine) == ([], [CRASH], False)


def test_a_file_of_a_crash_that_has_changed_is_damage_and_one_that_was_added_is_not(hunt):
    folder = hunt / "crashes" / CRASH
    (folder / "more.txt").write_text("mine")
    finding = only_finding(hunt)
    assert (finding.where, finding.damaged, finding.lost) == (str(folder), False, "")
    assert finding.what.endswith("was not there")
    assert found_in(hunt).crashes == [CRASH, "000002-collision"]
    (folder / "foxglove-layout.json").write_text("{}")
    found = found_in(hunt)
    assert found.damaged_crashes == [CRASH]
    assert {finding.lost for finding in found.findings} == {"", "that file"}


def test_a_crash_that_is_missing_is_reported_unless_it_was_given_up(hunt):
    shutil.rmtree(hunt / "crashes" / CRASH)
    finding = only_finding(hunt)
    assert finding.what == "trial 0 crashed, and its bundle is missing"
    assert (finding.where, finding.lost) == (str(hunt / "crashes"), "its log and evidence")
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        ledger.note(dropped={"rear end": [0]})
    found = found_in(hunt)
    assert (found.findings, found.dropped) == ([], {0})


def test_a_crash_of_another_hunt_or_trial_is_reported(hunt):
    file = hunt / "crashes" / CRASH / "crash.json"
    whole = file.read_text()
    signed(file, hunt_seed=9)
    assert only_finding(hunt).what == "it is of a hunt with seed 9, and this one has 1"
    file.write_text(whole)
    assert found_in(hunt).fine
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        was = ledger.result(0)
        for other in (replace(was, digest="0" * 32), replace(was, outcome=Outcome.OFF_ROAD), was):
            ledger.replace([0])
            ledger.record(other, snapshot="")
            said = [finding.what for finding in found_in(hunt).findings if finding.damaged]
            assert said == (["the ledger says something else about its trial"] if other != was else [])
    execute(hunt, "UPDATE trials SET steps = steps + 1 WHERE number = 0")
    assert [finding.lost for finding in found_in(hunt).findings] == ["trials 0"]


def test_a_crash_that_the_ledger_does_not_know_is_reported(hunt):
    settings = hunt / "hunt.toml"
    settings.write_text(settings.read_text().replace('    "collision",\n', ""))
    assert {finding.what for finding in found_in(hunt).findings} == {"the ledger has no crash of its trial"}


def test_snapshots_are_looked_at_and_missed(hunt):
    (snapshot,) = (hunt / "snapshots").iterdir()
    cut(snapshot / "manifest.json")
    (finding,) = (each for each in found_in(hunt).findings if each.damaged)
    assert str(snapshot) in finding.where
    assert finding.lost == f"replays of {CRASH} and others by the code that ran"
    assert not found_in(hunt / "crashes" / CRASH).fine
    shutil.rmtree(snapshot)
    finding = only_finding(hunt)
    assert (finding.where, finding.what) == (str(snapshot), "is missing")


def test_a_snapshot_that_no_crash_needs_is_looked_at_as_well(hunt):
    shutil.rmtree(hunt / "crashes")
    (snapshot,) = (hunt / "snapshots").iterdir()
    (snapshot / "environment.json").write_text("{}")
    assert "the code that ran" in {finding.lost for finding in found_in(hunt).findings}


@pytest.mark.parametrize(
    ("place", "option", "lost"),
    [
        ("near-misses", "--near-misses", "the near miss 000000-collision"),
        ("probes", "--probe", "probes/000000-collision"),
        ("branches", "--branch", "branches/000000-collision"),
    ],
)
def test_bundles_next_to_the_crashes_are_looked_at(hunt, place, option, lost):
    shutil.copytree(hunt / "crashes" / CRASH, hunt / place / CRASH)
    assert found_in(hunt).fine
    cut(hunt / place / CRASH / "log.mcap")
    found = found_in(hunt)
    assert found.crashes == [CRASH, "000002-collision"]  # a crash is none of these
    assert {finding.lost for finding in found.findings} == {lost}
    assert found.findings[0].fix == f"remove it: the same hunt with {option} makes it again"


def test_leftovers_are_reported_and_harmless(hunt):
    left = [hunt / "crashes" / ".000001-collision.tmp", hunt / "snapshots" / ".half", hunt / ".scratch-1-2-3"]
    for path in left:
        path.mkdir()
    (hunt / "crashes" / ".000000-collision.small.jsonl").touch()
    found = found_in(hunt)
    assert found.fine
    said = {Path(finding.where).name: finding.what for finding in found.findings}
    assert said == {
        **{path.name: "its writer was killed; it may be removed" for path in left},
        ".000000-collision.small.jsonl": "shrink resumes from it; it may be removed",
    }


def test_an_exported_crash_is_looked_at(hunt, tmp_path):
    file = tmp_path / "crash.zip"
    export_crash(find_bundle(hunt, "0"), file)
    found = found_in(file)
    assert (found.kind, found.crashes, found.fine) == ("file", [CRASH], True)
    cut(file)
    found = found_in(file)
    assert not found.fine
    assert found.findings[0].lost == "the crash"


def finding_of(found):
    (finding,) = found.findings
    return finding.where, finding.what, finding.lost, finding.damaged


def test_ledger_without_seal_is_no_damage(hunt):
    file = str(hunt / "ledger.sqlite")
    ledger = Ledger(hunt / "ledger.sqlite", writable=True)
    ledger.note(state="running", owner=ledger_owner())
    assert found_in(hunt).findings == []  # its writer is at work
    ledger.note(owner=None)
    where, what, lost, damaged = finding_of(found_in(hunt))
    assert (where, lost, damaged) == (file, "", False)
    assert what.startswith("its writer was killed")
    ledger.close()
    assert found_in(hunt).findings == []


def test_older_ledger_is_no_damage_but_ends_the_check_with_what_to_do(hunt):
    execute(hunt, "PRAGMA application_id = 0")
    with pytest.raises(
        HuntDirectoryError, match=r"the ledger is older than format version 1; read it with crashhunt of"
    ):
        found_in(hunt)


def test_running_hunt_has_no_leftovers_and_misses_no_bundle(hunt):
    (hunt / "crashes" / ".000001-collision.tmp").mkdir()
    shutil.rmtree(hunt / "crashes" / CRASH)
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        ledger.note(state="running", owner=ledger_owner())
    assert found_in(hunt).findings == []
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        ledger.note(owner=None)
    assert len(found_in(hunt).findings) == 2


def test_file_that_another_process_writes_is_no_leftover(hunt):
    token = this_process().token
    mine = hunt / "crashes" / f".000001-collision.{token}"
    mine.mkdir()
    assert found_in(hunt).findings == []
    scratch = hunt / f".scratch-{token}"  # of a hunt, which does not run
    scratch.mkdir()
    assert finding_of(found_in(hunt))[0] == str(scratch)


@pytest.mark.parametrize(("planned", "lost"), [(4, "trials 0, 1, 2, 3"), (9, "trials 0, 1, 2, 3, 4 and 3 more")])
def test_damaged_trials_are_named_up_to_five(hunt, planned, lost):
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        was = ledger.result(1)
        for number in range(4, planned - 1):
            ledger.record(replace(was, spec=replace(was.spec, number=number)), snapshot="")
    execute(hunt, "UPDATE trials SET seed = seed + 1")
    found = found_in(hunt)
    assert lost in {finding.lost for finding in found.findings}
    assert found.damaged_trials == set(range(max(4, planned - 1)))  # whether they were planned or not
    (hunt / "hunt.toml").unlink()
    assert found_in(hunt).damaged_trials == found.damaged_trials


def test_output_of_a_trial_that_has_changed_is_reported(hunt):
    folder = hunt / "trials" / "000001"
    folder.mkdir(parents=True)
    data = {"files": {"run.log": {"size": 3, "blake2b": "0" * 32}}}
    (folder / "params.json").write_text(json.dumps({**data, "integrity": digest_of_data(data)}))
    where, what, lost, damaged = finding_of(found_in(hunt))
    assert (where, lost, damaged) == (str(folder), "what the trial printed", True)
    assert what.startswith("run.log ")


def test_older_crash_is_no_damage_but_ends_the_check_with_what_to_do(hunt):
    file = hunt / "crashes" / CRASH / "crash.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "schema": 2}))
    with pytest.raises(BundleError, match=r"the crash is older than format version 1; read it with crashhunt of git"):
        found_in(hunt)


def test_file_that_was_added_to_a_snapshot_is_no_damage_and_many_changes_are_counted(hunt):
    (snapshot,) = (hunt / "snapshots").iterdir()
    (snapshot / "scenario" / "notes.txt").write_text("mine")
    where, what, lost, damaged = finding_of(found_in(hunt))
    assert (where, lost, damaged) == (str(snapshot), "", False)
    assert what == "scenario/notes.txt was added; it is no module, so it never runs"
    assert [one.path for one in intact_snapshots(hunt)] == [snapshot]
    for number in range(7):
        (snapshot / "scenario" / f"m{number}.py").touch()
        found = [finding.what for finding in found_in(hunt).findings if finding.damaged]
        assert found[:5] == [f"scenario/m{place}.py was not there" for place in range(min(5, number + 1))]
        assert found[5:] == ([f"and {number - 4} more of its files"] if number > 4 else [])
    assert list(intact_snapshots(hunt)) == []


def test_minimized_crash_is_none_of_the_ledger(hunt):
    small = hunt / "crashes" / f"{CRASH}.small"
    shutil.copytree(hunt / "crashes" / CRASH, small)
    signed(small / "crash.json", hunt_seed=9)
    found = found_in(hunt)
    assert found.findings == []
    assert found.crashes == [CRASH, small.name, "000002-collision"]


def test_export_without_a_crash_is_reported(hunt, tmp_path, monkeypatch):
    shutil.rmtree(hunt / "crashes")

    @contextmanager
    def opened(path):
        yield SimpleNamespace(directory=hunt)

    monkeypatch.setattr("crashhunt.crashes.open_archive", opened)
    file = tmp_path / "crash.zip"
    file.touch()
    where, what, lost, damaged = finding_of(found_in(file))
    assert (where, what, lost, damaged) == (str(file), "there is no crash in it", "the crash", True)


def test_hunt_without_settings_and_ledger_is_looked_at_by_its_files(hunt):
    (hunt / "hunt.toml").unlink()
    (hunt / "ledger.sqlite").unlink()
    (hunt / "request.json").write_text("{}")
    found = found_in(hunt)
    assert [finding.what for finding in found.findings] == ["is missing"]
    assert found.crashes == [CRASH, "000002-collision"]


def test_only_a_hunt_can_be_salvaged(hunt, tmp_path):
    with pytest.raises(HuntDirectoryError, match=r"has no part of a hunt that can be recovered; give the directory"):
        salvage(found_in(hunt / "crashes" / CRASH), tmp_path / "to")
    (hunt / "trials" / "000001").mkdir(parents=True)
    (hunt / "trials" / "000001" / "run.log").write_text("printed")
    (hunt / "request.json").write_text("{}")
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        ledger.propose([Turn((), ledger.result(1).spec)])
    assert salvage(found_in(hunt), tmp_path / "to") == {"trials": 4, "crashes": 2}
    assert (tmp_path / "to" / "trials" / "000001" / "run.log").read_text() == "printed"
    assert (tmp_path / "to" / "request.json").read_text() == "{}"
    with closing(Ledger(tmp_path / "to" / "ledger.sqlite")) as ledger:
        assert [turn.spec.number for turn in ledger.turns()] == [1]
        assert ledger.facts()["detail"] == f"what was whole of {hunt}"
        assert (ledger.facts()["planned"], ledger.facts()["hunt_seed"]) == (4, 1)
    text = (tmp_path / "to" / "hunt.toml").read_text()
    assert f"check {hunt} --salvage {tmp_path / 'to'}" in text
    # A second call does nothing, unless a hunt has resumed there or something is gone.
    assert salvage(found_in(hunt), tmp_path / "to") == {"trials": 4, "crashes": 2}
    with closing(Ledger(tmp_path / "to" / "ledger.sqlite", writable=True)) as ledger:
        ledger.enter("all_trials")
    with pytest.raises(HuntDirectoryError, match="the directory exists already"):
        salvage(found_in(hunt), tmp_path / "to")


@pytest.mark.parametrize("gone", ["hunt.toml", f"crashes/{CRASH}", "a trial"])
def test_copy_that_lacks_something_is_no_copy(hunt, tmp_path, gone):
    to = tmp_path / "to"
    salvage(found_in(hunt), to)
    if gone == "a trial":
        with closing(Ledger(to / "ledger.sqlite", writable=True)) as ledger:
            ledger.replace([3])
    elif (to / gone).is_dir():
        shutil.rmtree(to / gone)
    else:
        (to / gone).unlink()
    with pytest.raises(HuntDirectoryError, match="the directory exists already"):
        salvage(found_in(hunt), to)


def test_salvage_takes_the_settings_of_a_snapshot_and_no_crash_without_its_bundle(hunt, tmp_path):
    (hunt / "hunt.toml").write_text("nothing")
    cut(hunt / "crashes" / CRASH / "log.mcap")
    (tmp_path / "empty").mkdir()
    assert salvage(found_in(hunt), tmp_path / "empty") == {"trials": 3, "crashes": 1}
    with closing(Ledger(tmp_path / "empty" / "ledger.sqlite")) as ledger:
        assert ledger.finished() == {1, 2, 3}
    shutil.rmtree(hunt / "snapshots")
    with pytest.raises(HuntDirectoryError):
        salvage(found_in(hunt), tmp_path / "other")
