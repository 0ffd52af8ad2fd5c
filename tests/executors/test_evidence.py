"""What the process of a trial leaves behind is accepted only where all of it agrees."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from hypothesis import given, settings as examples, strategies as st
from toy_trials import settings_for

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError
from crashhunt.episode import Parts, run_episode
from crashhunt.executors._postmortem import agent_in_stack
from crashhunt.executors._protocol import encode_report
from crashhunt.executors._trial_report import _fault_of, check_report
from crashhunt.recording import BlackBox, BlackBoxFile, read_header
from crashhunt.trial import Outcome, TrialSpec

SPEC = TrialSpec(3, 7, {"ego": {"speed": 5.0}}, {}, 12)


@pytest.fixture(scope="module")
def left_behind(tmp_path_factory):
    """Header, records and result of a trial, and the report that goes with them."""
    place = tmp_path_factory.mktemp("trial")
    parts = Parts(settings_for(place, oracles=("overlap",), crash_on=()))
    box = BlackBox(place / "box")
    box.begin(pid=41, trial=SPEC.number, started=0.0)
    result = run_episode(
        SPEC, simulator=parts.simulator(), make_agent=parts.agent, box=box, oracles=parts.oracles(), crash_on=()
    )
    header, records = read_header(place / "box"), bytes(box.committed())
    box.close()
    return header, records, result


def report_of(result, **changes):
    data = {**result.to_json(), **changes}
    del data["spec"]
    return encode_report({"result": data, "notices": []})


def check(left_behind, report, *, records=None, header=None, spec=SPEC, pid=41):
    was, whole, _ = left_behind
    found = whole if records is None else records
    return check_report(report, spec=spec, header=header or was, records=found, pid=pid)


def test_whole_evidence_gives_the_result(left_behind):
    result = left_behind[2]
    found, report = check(left_behind, report_of(result))
    assert found == replace(result, kept=found.kept)
    assert report["notices"] == []


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"digest": "0" * 32}, "it reports the digest 00000000000000000000000000000000, and its recording has "),
        ({"digest": ""}, "it reports the digest none, and its recording has "),
        ({"digest": "1", "outcome": "agent_error"}, "it reports the digest 1, and its recording has "),
        ({"outcome": "no such outcome"}, "its report cannot be read (ValueError)"),
        ({"closest": "near"}, "its report cannot be read ("),
    ],
)
def test_report_that_contradicts_the_recording_is_refused(left_behind, change, reason):
    found = check(left_behind, report_of(left_behind[2], **change))
    assert isinstance(found, str)
    assert found.startswith(reason)


@pytest.mark.parametrize("change", [{"digest": "", "outcome": "agent_error"}, {"digest": "1", "outcome": "invalid"}])
def test_failed_or_invalid_trial_may_have_no_whole_recording(left_behind, change):
    found, _ = check(left_behind, report_of(left_behind[2], **change))
    assert (found.outcome, found.digest) == (change["outcome"], change["digest"])


def test_report_that_was_overwritten_is_refused(left_behind):
    report = report_of(left_behind[2])
    assert (
        check(left_behind, report[:-1]) == check(left_behind, bytes(16) + report[16:]) == "its report was overwritten"
    )


def test_report_of_another_trial_is_refused(left_behind):
    report = report_of(left_behind[2])
    assert "ran trial 3" in check(left_behind, report, spec=replace(SPEC, number=4))
    assert "process 41" in check(left_behind, report, pid=42)


@pytest.mark.parametrize("cut", [1, 8, 100])
def test_recording_that_is_cut_off_is_refused(left_behind, cut):
    found = check(left_behind, report_of(left_behind[2]), records=left_behind[1][:-cut])
    assert isinstance(found, str)


@examples(max_examples=150)
@given(data=st.data())
def test_no_changed_byte_is_believed(left_behind, data):
    _, records, result = left_behind
    report = report_of(result)
    whole = bytearray(records + report)
    place = data.draw(st.integers(0, len(whole) - 1))
    whole[place] ^= data.draw(st.integers(1, 255))
    found = check(left_behind, bytes(whole[len(records) :]), records=bytes(whole[: len(records)]))
    if isinstance(found, str):
        return
    # What is no evidence, such as padding that nobody reads, changes no result.
    assert replace(found[0], kept=False) == replace(result, kept=False)


@examples(max_examples=100)
@given(records=st.binary(max_size=200), report=st.binary(max_size=200))
def test_any_bytes_are_refused_in_words(left_behind, records, report):
    assert isinstance(check(left_behind, report, records=records), str)


def test_black_box_file_states_what_the_process_wrote(tmp_path):
    supervised = BlackBoxFile(tmp_path / "box")
    supervised.begin(trial=9, started=2.5)
    box = BlackBox(tmp_path / "box", begun=supervised.reserved)
    box.begin(pid=5, trial=9, started=3.0)
    box.note(b"one record")
    box.report(json.dumps({"a": 1}).encode())
    header = supervised.header()
    assert (header.pid, header.trial, header.started) == (5, 9, 3.0)
    assert supervised.read_records(header) == bytes(box.committed())
    assert supervised.read_report(header) == b'{"a": 1}'
    assert supervised.is_reusable()
    box.announce_damage()
    assert supervised.read_report(header) is None
    supervised.begin(trial=10, started=4.0)
    assert supervised.read_report(supervised.header()) == b""
    with (tmp_path / "box").open("r+b") as file:
        file.truncate(70)
    assert not supervised.is_reusable()
    box.close()
    supervised.close()


def test_outcome_of_the_toy_is_what_the_test_expects(left_behind):
    assert left_behind[2].outcome is Outcome.SURVIVED
    assert left_behind[2].steps == 12


@pytest.mark.parametrize(
    ("frames", "agent"),
    [
        (["/site/numpy/core.py", "/my/planner.py"], "a"),
        (["/my/package/driver/__init__.py"], "b"),
        (["/my/package/driver.py"], "b"),
        (["/my/other.py"], ""),
        ([str(layout.PACKAGE / "episode/_episode.py"), "/my/planner.py"], ""),
        (["/my/notplanner.py"], ""),
        ([], ""),
    ],
)
def test_stack_of_a_dead_process_names_the_agent_whose_code_ran(frames, agent):
    agents = {"a": "planner", "b": "package.driver"}
    other = '\nThread 0x1:\n  File "/my/package/driver.py", line 3 in wait\n'
    lines = "".join(f'  File "{frame}", line 3 in act\n' for frame in frames)
    stack = f"Fatal Python error{other}\nCurrent thread 0x2 (most recent call first):\n{lines}\nExtension modules: x"
    assert agent_in_stack(stack, agents) == agent
    assert agent_in_stack(stack, {}) == ""
    assert agent_in_stack(stack, {"a": "planner", "c": "planner"}) == ""  # either of both


def test_fault_of_crashhunt_itself_in_a_trial_ends_the_hunt(left_behind):
    records = left_behind[1]
    fault = encode_report({"fault": CrashhuntError("no map", fix="draw one").to_json()})
    with pytest.raises(CrashhuntError, match="no map"):
        check(left_behind, fault, records=records)
    assert "cannot be read" in _fault_of({}).message
