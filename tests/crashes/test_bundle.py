"""Bundles: what is written is read again to the last value, what has changed is refused, and a name means one crash."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import shutil
import threading
from typing import TYPE_CHECKING

import pytest
from episodes import Episode, write

from crashhunt.analysis import _avoidability
from crashhunt.base import layout
from crashhunt.base.errors import BundleError, UsageError
from crashhunt.base.integrity import digest_of_data
from crashhunt.base.older_versions import HOW_TO_READ
from crashhunt.crashes import (
    Attempt,
    Judgement,
    Reference,
    Why,
    changing,
    files_of,
    find_bundle,
    judgement_of,
    list_bundles,
    list_near_misses,
    read_bundle,
    read_params,
    with_judgement,
    write_bundle,
    write_trial,
)
from crashhunt.crashes._saved_crashes import as_stored
from crashhunt.hunts import _verification
from crashhunt.recording import Recording, read_black_box
from crashhunt.trial import Collision, Escape, Failure, Outcome, TrialResult, TrialSpec
from crashhunt.world import ClosestApproach, Event, Lane

if TYPE_CHECKING:
    from pathlib import Path

SPEC = TrialSpec(12, 99, {"ego": {"speed": 8.5}, "b": {}}, {"gap": 3, "dry": True}, max_steps=40)
CRASH = TrialResult(
    SPEC, Outcome.COLLISION, steps=6, sim_time_s=20.6, digest="?", closest=ClosestApproach(0.5, 0.0, 7.25),
    collision=Collision("ego", "victim", "other", "ego", ("overlap",), "overlap", 1.5, -2.5, "a_0", 9.0, 3.0, math.nan),
    escape=Escape(3, 4, 7.5, "with full braking"), events={"red_light": 2},
)  # fmt: skip


def made(directory: Path, result: TrialResult = CRASH, *, printed: str | None = "said\n"):
    """The bundle of a crash as a hunt makes it."""
    scratch = directory / "scratch" / str(result.spec.number)
    scratch.mkdir(parents=True)
    write(Episode(["ego", "b"], result.steps, result.spec.number), scratch / layout.BLACK_BOX)
    digest = Recording(read_black_box(scratch / layout.BLACK_BOX)).digest
    if printed is not None:
        (scratch / layout.RUN_LOG).write_text(printed)
    result = dataclasses.replace(result, digest=digest)
    lanes = [Lane("a", 3.0, ((0.0, 0.0), (9.0, 0.0)))]
    return write_bundle(directory, result, scratch, hunt_seed=5, snapshot="abc", lanes=lanes)


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    directory = tmp_path_factory.mktemp("hunt")
    made(directory)
    return directory


@pytest.fixture
def bundle(template, tmp_path):
    """The usual crash, to damage."""
    shutil.copytree(template / "crashes", tmp_path / "crashes")
    return read_bundle(tmp_path / "crashes" / "000012-collision")


def numbered(number, steps=6, outcome=Outcome.COLLISION):
    return dataclasses.replace(CRASH, spec=dataclasses.replace(SPEC, number=number), steps=steps, outcome=outcome)


def change(bundle, *, honest=True, **values):
    """Write something else into ``crash.json``, with the digest that belongs to it or without."""
    file = bundle.path / layout.CRASH
    data = {**json.loads(file.read_text()), **values}
    if honest:
        del data["integrity"]
        data["integrity"] = digest_of_data(data)
    file.write_text(json.dumps(data))


def test_reason_for_an_unknown_last_step_is_written_and_read(bundle):
    dataclasses.replace(bundle, result=dataclasses.replace(bundle.result, escape=None, why_no_escape="killed")).write()
    assert (read_bundle(bundle.path).result.escape, read_bundle(bundle.path).result.why_no_escape) == (None, "killed")


def test_what_is_written_is_read(tmp_path):
    bundle = made(tmp_path)
    assert bundle.path == tmp_path / "crashes" / "000012-collision"
    found = read_bundle(bundle.path)
    assert repr(found) == repr(bundle)  # in which what is not a number equals itself
    assert (found.id, found.hunt, found.hunt_seed, found.snapshot) == ("000012-collision", tmp_path, 5, "abc")
    assert (found.confirmed, found.divergence) == (None, None)
    assert found.result.escape == CRASH.escape
    assert found.result.events == {"red_light": 2}
    assert set(found.files) == {"log.mcap", "run.log", "foxglove-layout.json"}
    assert found.faults() == []
    assert found.recording().digest == found.result.digest
    assert sorted(path.name for path in tmp_path.iterdir()) == ["crashes", "scratch"]
    assert list((tmp_path / "scratch").iterdir()) == []
    assert [path.name for path in (tmp_path / "crashes").iterdir()] == ["000012-collision"]
    data = json.loads((bundle.path / layout.CRASH).read_text())
    assert (data["schema"], data["id"], data["category"]) == (1, "000012-collision", "traffic crash")
    assert data["summary"] == "ego was hit by other at step 6"
    assert (data["step"], data["sim_time_s"], data["max_steps"], data["trial"], data["seed"]) == (6, 20.6, 40, 12, 99)
    assert data["collision"]["time_s"] is None
    assert data["arguments"] == {"ego": {"speed": 8.5}, "b": {}}
    assert data["scenario_arguments"] == {"gap": 3, "dry": True}
    assert data["closest_approach"] == {"time_to_collision_s": 0.5, "gap_m": 0.0, "required_deceleration": 7.25}
    assert found.summary() == {
        "id": "000012-collision", "trial": 12, "seed": 99, "outcome": "collision", "step": 6,
        "arguments": {"ego": {"speed": 8.5}, "b": {}}, "scenario_arguments": {"gap": 3, "dry": True},
        "path": str(bundle.path), "digest": found.result.digest, "confirmed": None,
    }  # fmt: skip


def test_a_crash_that_is_confirmed_or_not_states_so(tmp_path):
    bundle = made(tmp_path)
    dataclasses.replace(bundle, confirmed=False, divergence={"step": 3}).write()
    found = read_bundle(bundle.path)
    assert (found.confirmed, found.divergence, found.files) == (False, {"step": 3}, bundle.files)
    again = made(tmp_path)  # the same trial once more
    assert read_bundle(again.path).confirmed is None


def test_judgement_and_confirmation_of_two_processes_are_both_kept(bundle):
    judgement = Judgement(why_not="it was interrupted")
    dataclasses.replace(bundle, confirmed=True).write()
    with changing(bundle) as stored:  # the judgement began before the confirmation
        with_judgement(stored, judgement).write()
    assert (read_bundle(bundle.path).confirmed, judgement_of(read_bundle(bundle.path))) == (True, judgement)
    bundle.write()
    with_judgement(bundle, judgement).write()
    assert _verification._write_if_kept(dataclasses.replace(bundle, confirmed=True), bundle.path)  # the other way round
    assert (read_bundle(bundle.path).confirmed, judgement_of(read_bundle(bundle.path))) == (True, judgement)


def test_second_writer_of_a_crash_waits_for_the_first(bundle):
    def judge():
        with changing(bundle) as stored:
            with_judgement(stored, Judgement(visible_step=3)).write()

    other = threading.Thread(target=judge)
    with changing(bundle) as stored:
        other.start()
        other.join(0.2)
        assert other.is_alive()
        dataclasses.replace(stored, confirmed=True).write()
    other.join(30)
    found = read_bundle(bundle.path)
    assert (found.confirmed, judgement_of(found)) == (True, Judgement(visible_step=3))


def test_judgement_keeps_the_parts_that_another_process_has_found_meanwhile(bundle, monkeypatch):
    found, other = Judgement(why=Why(steps=7)), Judgement(reference=Reference(why_not="no lanes"))
    known = []

    def judge(bundle, options, **_numbers):
        with changing(bundle) as stored:
            with_judgement(stored, known[-1]).write()
        return found

    monkeypatch.setattr(_avoidability, "judge", judge)
    known.append(other)
    judged = _avoidability.judge_bundle(bundle, write=False)
    assert (judgement_of(judged), judgement_of(read_bundle(bundle.path))) == (found, other)
    assert judgement_of(_avoidability.judge_bundle(bundle)) == dataclasses.replace(found, reference=other.reference)
    assert judgement_of(read_bundle(bundle.path)) == other  # nothing was run
    found = dataclasses.replace(found, attempts=(Attempt("brake", 6, {4: "avoided"}, 8.0),))
    _avoidability.judge_bundle(bundle, stopped=lambda: True)
    assert judgement_of(read_bundle(bundle.path)) == other  # half an answer does not replace a whole one
    _avoidability.judge_bundle(bundle)
    assert judgement_of(read_bundle(bundle.path)) == dataclasses.replace(found, reference=other.reference)
    with pytest.raises(UsageError, match="--parallel is -1; give at least 0"):
        _avoidability.judge_bundle(bundle, parallel=-1)


def test_bundle_that_is_gone_damaged_or_of_another_crash_is_not_taken_from_the_disk(bundle):
    assert as_stored(bundle) is not bundle
    other = dataclasses.replace(bundle, result=dataclasses.replace(bundle.result, digest="0" * 32))
    assert as_stored(other) is other
    (bundle.path / layout.CRASH).write_text("{")
    assert as_stored(bundle) is bundle
    shutil.rmtree(bundle.path)
    with changing(bundle) as stored:
        assert stored is bundle


def test_a_trial_that_printed_nothing_has_no_empty_log(tmp_path):
    bundle = made(tmp_path, printed="")
    assert sorted(path.name for path in bundle.path.iterdir()) == ["crash.json", "foxglove-layout.json", "log.mcap"]
    assert set(read_bundle(bundle.path).files) == {"log.mcap", "foxglove-layout.json"}
    assert bundle.faults() == []


def test_a_fault_comes_with_what_was_said(tmp_path):
    failure = Failure("KeyError", "'x'", "Traceback …\n", "b", last_output="the end\n")
    result = dataclasses.replace(CRASH, outcome=Outcome.AGENT_ERROR, collision=None, failure=failure, escape=None)
    bundle = made(tmp_path, result, printed=None)
    assert (bundle.path / "error.log").read_text() == "KeyError: 'x'\n\nTraceback …\n\nthe end\n"
    assert not (bundle.path / "run.log").exists()
    found = read_bundle(bundle.path)
    assert found.result.failure == failure
    assert found.driver == "b"
    silent = dataclasses.replace(result, failure=Failure("signal", "killed", exit_code=-9))
    assert (made(tmp_path, silent).path / "error.log").read_text() == "signal: killed\n"
    bare = dataclasses.replace(result, failure=Failure("AssertionError"))
    assert (made(tmp_path, bare).path / "error.log").read_text() == "AssertionError\n"


def test_the_driver_is_which_it_is_about(bundle, tmp_path):
    event = Event("red_light", "b", "b ran a red light")
    for evidence, driver in (
        ({"collision": CRASH.collision}, "ego"),
        ({"event": event}, "b"),
        ({"failure": Failure("exit code", "3")}, "ego"),
        ({"failure": Failure("exit code", "3", agent="b")}, "b"),
    ):
        parts = {"collision": None, "event": None, "failure": None, **evidence}
        assert dataclasses.replace(bundle, result=dataclasses.replace(CRASH, **parts)).driver == driver
    nobody = dataclasses.replace(CRASH, collision=None, spec=dataclasses.replace(SPEC, arguments={}))
    assert dataclasses.replace(bundle, result=nobody).driver == ""
    red = dataclasses.replace(CRASH, outcome=Outcome.RED_LIGHT, collision=None, escape=None, event=event)
    assert read_bundle(made(tmp_path, red).path).result.event == event


def test_what_has_changed_is_refused(bundle):
    change(bundle, honest=False, step=7)
    with pytest.raises(BundleError, match="the file has changed since it was written") as caught:
        read_bundle(bundle.path)
    assert caught.value.where == str(bundle.path / "crash.json")
    assert caught.value.fix
    change(bundle, step=6)
    read_bundle(bundle.path)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"schema": 6}, "schema version 6 is not supported"),
        ({"schema": 0}, "schema version 0"),
        ({"seed": 2**31}, "out of range"),
        ({"seed": -1}, "out of range"),
        ({"trial": -1}, "out of range"),
        ({"step": -1}, "out of range"),
        ({"max_steps": 0}, "out of range"),
        ({"snapshot": "../abc"}, "not the name of a snapshot"),
        ({"snapshot": ""}, "not the name of a snapshot"),
        ({"outcome": "No Outcome"}, "No Outcome"),
        ({"arguments": {"ego": [1]}}, "arguments"),
        ({"scenario_arguments": {"x": [1]}}, "scenario_arguments"),
        ({"confirmed": "yes"}, "confirmed"),
        ({"events": {"red_light": "2"}}, "events"),
        ({"closest_approach": None}, "closest"),
        ({"collision": {"agent": 1}}, "agent"),
        ({"files": {"../log.mcap": {"size": 1, "blake2b": ""}}}, "is not in the folder of the bundle"),
        ({"files": {"..": {"size": 1, "blake2b": ""}}}, "is not in the folder of the bundle"),
        ({"files": {"": {"size": 1, "blake2b": ""}}}, "is not in the folder of the bundle"),
        ({"files": {"log.mcap": {"size": "1", "blake2b": ""}}}, "size"),
        ({"digest": 3}, "digest"),
    ],
)
def test_what_makes_no_sense_is_refused(bundle, values, says):
    change(bundle, **values)
    with pytest.raises(BundleError, match=says) as caught:
        read_bundle(bundle.path)
    assert caught.value.fix


def test_values_at_the_edge_are_read(bundle):
    change(bundle, seed=2**31 - 1, trial=0, step=0, max_steps=1, events=None)
    spec = read_bundle(bundle.path).result.spec
    assert (spec.seed, spec.number, spec.max_steps) == (2**31 - 1, 0, 1)


@pytest.mark.parametrize("older", [{"schema": 2}, {"schema": 5}, {"integrity": None}])
def test_crash_from_before_version_1_names_the_revision_that_reads_it(bundle, older):
    file = bundle.path / layout.CRASH
    data = {**json.loads(file.read_text()), **older}
    file.write_text(json.dumps({name: value for name, value in data.items() if (name, value) != ("integrity", None)}))
    with pytest.raises(BundleError) as refused:
        read_bundle(bundle.path)
    assert refused.value.message == "the crash is older than format version 1"
    assert refused.value.fix == HOW_TO_READ


def test_a_log_of_another_crash_or_with_other_views_is_refused(tmp_path):
    bundle, other = made(tmp_path), made(tmp_path, numbered(13))
    log = bundle.path / layout.LOG
    whole = log.read_bytes()
    log.write_bytes((other.path / layout.LOG).read_bytes())
    with pytest.raises(BundleError, match=r"differs from that in crash\.json") as caught:
        bundle.recording()
    assert caught.value.where == str(log)
    log.write_bytes(whole + b"\0")
    with pytest.raises(BundleError):
        bundle.recording()
    log.unlink()
    with pytest.raises(BundleError, match="cannot be read"):
        bundle.recording()
    assert bundle.faults() == ["log.mcap is missing"]


def test_every_file_next_to_it_is_looked_at(bundle):
    (bundle.path / "run.log").write_text("other")
    (bundle.path / "note.txt").write_text("mine")
    (bundle.path / ".hidden").write_text("an editor's")
    changed, added = bundle.faults()
    assert changed.startswith("run.log ")
    assert added == "note.txt was not there"


def test_a_crash_is_found_by_what_people_call_it(tmp_path):
    for number, steps in ((1, 9), (2, 4), (12, 4), (120, 5)):
        made(tmp_path, numbered(number, steps))
    made(tmp_path, numbered(7, 8, Outcome.OFF_ROAD))
    assert [bundle.result.spec.number for bundle in list_bundles(tmp_path)] == [1, 2, 7, 12, 120]
    assert find_bundle(tmp_path).id == "000002-collision"  # the shortest, and of these the first
    for word, found in (
        ("000012-collision", 12), ("12", 12), ("000012", 12), ("0012", 12), ("1", 1), ("120", 120), ("000007", 7),
        ("000007-off", 7), ("000120", 120),
    ):  # fmt: skip
        assert find_bundle(tmp_path, word).result.spec.number == found, word
    with pytest.raises(BundleError, match="'0000' matches several") as caught:
        find_bundle(tmp_path, "0000")
    assert "000012-collision" in caught.value.fix
    assert "000120-collision" not in caught.value.fix
    with pytest.raises(BundleError, match="there is no crash '3'"):
        find_bundle(tmp_path, "3")
    folder = tmp_path / "crashes" / "000007-off_road"
    assert find_bundle(folder).result.spec.number == 7
    with pytest.raises(BundleError, match="no crash was saved here"):
        find_bundle(tmp_path / "scratch")
    for hunt in ("base", "head"):  # as in the directory of a gate
        (tmp_path / "kept" / hunt).mkdir(parents=True)
        (tmp_path / "kept" / hunt / "hunt.toml").touch()
    with pytest.raises(BundleError, match="no crash was saved here") as caught:
        find_bundle(tmp_path / "kept")
    assert caught.value.fix.endswith(f": {tmp_path}/kept/base, {tmp_path}/kept/head")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(BundleError, match=r"pipe' is a device or a pipe, .*; write its contents to a file"):
        find_bundle(tmp_path / "pipe")
    with pytest.raises(BundleError, match="does not exist"):
        find_bundle(tmp_path / "gone", "1")


def test_what_copies_found_is_found_by_id_or_number_where_no_crash_is_called_so(tmp_path):
    for number, steps, place in (
        (2, 7, layout.PROBES), (1, 8, layout.PROBES), (2, 6, layout.BRANCHES), (30, 5, layout.BRANCHES),
        (40, 4, layout.NEAR_MISSES), (1, 9, layout.CRASHES),
    ):  # fmt: skip
        bundle = made(tmp_path, numbered(number, steps))
        (tmp_path / place).mkdir(exist_ok=True)
        bundle.path.rename(tmp_path / place / bundle.id)
    for word, steps in (("1", 9), ("2", 7), ("000002-", 7), ("30", 5), ("00003", 5), ("40", 4)):
        assert find_bundle(tmp_path, word).result.steps == steps, word
    with pytest.raises(BundleError, match="there is no crash '3'"):
        find_bundle(tmp_path, "3")
    for place, steps in ((layout.CRASHES, 9), (layout.NEAR_MISSES, 4), (layout.BRANCHES, 5), (layout.PROBES, 7)):
        assert find_bundle(tmp_path).result.steps == steps
        shutil.rmtree(tmp_path / place)


def test_the_most_dangerous_near_miss_comes_first(tmp_path):
    for number, danger in ((1, 0.5), (2, 0.9), (3, 0.9)):
        bundle = made(tmp_path, dataclasses.replace(numbered(number), danger=danger))
        (tmp_path / layout.NEAR_MISSES).mkdir(exist_ok=True)
        bundle.path.rename(tmp_path / layout.NEAR_MISSES / bundle.id)
    assert [bundle.result.spec.number for bundle in list_near_misses(tmp_path)] == [2, 3, 1]
    assert find_bundle(tmp_path).result.spec.number == 2


def test_a_damaged_crash_is_in_the_way_of_no_one_who_means_another(tmp_path):
    made(tmp_path, numbered(1))
    broken = made(tmp_path, numbered(20))
    (broken.path / layout.CRASH).unlink()
    assert find_bundle(tmp_path, "1").result.spec.number == 1
    for word in ("20", "020", "000020", "000020-collision", "0000"):
        with pytest.raises(BundleError, match="the folder contains no crash bundle"):
            find_bundle(tmp_path, word)
    with pytest.raises(BundleError, match="the folder contains no crash bundle"):
        list_bundles(tmp_path)
    (tmp_path / "crashes" / "notes").mkdir()
    (tmp_path / "crashes" / ".000021-hang.part").mkdir()
    (tmp_path / "crashes" / "000022-file").write_text("")
    (broken.path / layout.LOG).parent.rename(tmp_path / "crashes" / "kept")
    assert [bundle.result.spec.number for bundle in list_bundles(tmp_path)] == [1]
    first = tmp_path / "crashes" / "000001-collision"
    first.rename(first.with_name("mine"))
    assert find_bundle(tmp_path, "1").id == "mine"


def test_a_trial_that_is_kept_can_be_checked(tmp_path):
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    (scratch / layout.RUN_LOG).write_text("said\n")
    result = dataclasses.replace(CRASH, outcome=Outcome.INVALID, failure=Failure("invalid", "overlaps"), collision=None)
    write_trial(tmp_path, result, scratch)
    folder = tmp_path / "trials" / "000012"
    assert not scratch.exists()
    assert sorted(path.name for path in folder.iterdir()) == ["error.log", "params.json", "run.log"]
    data = json.loads((folder / "params.json").read_text())
    assert (data["outcome"], data["schema"], data["spec"]["number"]) == ("invalid", 1, 12)
    assert read_params(folder) == []
    assert set(files_of(folder)) == {"error.log", "run.log"}
    (folder / "run.log").write_text("other")
    (wrong,) = read_params(folder)
    assert wrong.startswith("run.log ")
    (folder / "params.json").write_text(json.dumps({**data, "steps": 7}))
    assert read_params(folder) == ["params.json: the file has changed since it was written"]
    assert files_of(folder) == {}
    (folder / "params.json").unlink()
    assert read_params(folder) == ["params.json: No such file or directory"]
    del data["integrity"], data["files"]
    (folder / "params.json").write_text(json.dumps(data))
    assert read_params(folder) == ["params.json: 'integrity' is missing"]
    assert files_of(folder) == {}
    assert set(files_of(made(tmp_path).path)) == {"log.mcap", "run.log", "foxglove-layout.json"}
