"""What the process of a trial leaves behind is believed only where all of it agrees."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from hypothesis import given, settings as examples, strategies as st

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError
from crashhunt.episode import Parts, WorkerSettings, run_episode
from crashhunt.executors._postmortem import (
    _contradiction,
    _fault_of,
    agent_in_stack,
    check_report,
    encode_report,
)
from crashhunt.recording import BlackBox, BlackBoxFile, read_header
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.trial import Failure, Outcome, TrialResult, TrialSpec

KEY = bytes(range(16))
SPEC = TrialSpec(3, 7, {"ego": {"speed": 5.0}}, {}, 12)


@pytest.fixture(scope="module")
def left_behind(tmp_path_factory):
    """Header, records and result of a trial, and the report that goes with them."""
    place = tmp_path_factory.mktemp("trial")
    scenario = Scenario(simulator="toy", agents={"ego": AgentSetup(agent="keep-lane")})
    parts = Parts(WorkerSettings(scenario=scenario, oracles=("overlap",), crash_on=(), scratch=place))
    box = BlackBox(place / "box")
    box.begin(pid=41, trial=SPEC.number, started=0.0)
    result = run_episode(
        SPEC, simulator=parts.simulator(), make_agent=parts.agent, box=box, oracles=parts.oracles(), crash_on=()
    )
    header, records = read_header(place / "box"), bytes(box.committed())
    box.close()
    return header, records, result


def report_of(result, key=KEY, **changes):
    data = {**result.to_json(), **changes}
    del data["spec"]
    return encode_report({"result": data, "notices": []}, key, result.digest)


def check(left_behind, report, *, records=None, header=None, spec=SPEC, pid=41):
    was, whole, _ = left_behind
    found = whole if records is None else records
    return check_report(report, key=KEY, spec=spec, header=header or was, records=found, pid=pid)


def test_whole_evidence_gives_the_result(left_behind):
    result = left_behind[2]
    found, report = check(left_behind, report_of(result))
    assert found == replace(result, kept=found.kept)
    assert report["notices"] == []


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"digest": "0" * 32}, "its recording has"),
        ({"steps": 11}, "11 steps|after 11 of 12"),
        ({"steps": 40}, "40 steps"),
        ({"steps": 5, "outcome": "finished"}, "5 steps"),
        ({"outcome": "hang"}, "cannot report hang"),
        ({"outcome": "process_died"}, "cannot report process_died"),
        ({"outcome": "agent_error"}, "no reason"),
        ({"outcome": "invalid"}, "no reason"),
        ({"outcome": "no such outcome"}, "cannot be read"),
        ({"sim_time_s": 3.5}, "simulation time of 3.5 s"),
        ({"closest": "near"}, "cannot be read"),
    ],
)
def test_report_that_contradicts_the_recording_is_refused(left_behind, change, reason):
    found = check(left_behind, report_of(left_behind[2], **change))
    assert isinstance(found, str)
    assert any(part in found for part in reason.split("|")), found


def test_report_with_another_key_is_refused(left_behind):
    assert check(left_behind, report_of(left_behind[2], key=bytes(16))) == "its report was not written by crashhunt"


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


@pytest.mark.parametrize(
    ("changes", "steps", "time_s", "says"),
    [
        ({}, 12, 1.2, ""),
        ({"digest": "1"}, 12, 1.2, "it reports the digest 1, and its recording has 0"),
        ({"outcome": Outcome.AGENT_ERROR, "digest": "1"}, 12, 1.2, "it reports the digest 1, and its recording has 0"),
        ({"outcome": Outcome.AGENT_ERROR, "digest": ""}, 12, 1.2, ""),
        ({"digest": ""}, 12, 1.2, "it reports the digest none, and its recording has 0"),
        ({}, 11, 1.2, "it reports 12 steps, and its recording has 11"),
        ({"steps": 5, "outcome": Outcome.FINISHED}, 6, 9.9, ""),
        ({"steps": 5, "outcome": Outcome.FINISHED}, 7, 1.2, "it reports 5 steps, and its recording has 7"),
        ({"steps": 13, "outcome": Outcome.FINISHED}, 13, 1.2, "it reports finished after 13 of 12 steps"),
        ({"steps": 11}, 11, 1.2, "it reports survived after 11 of 12 steps"),
        ({}, 12, 1.3, "it reports a simulation time of 1.2 s, and its recording has 1.3 s"),
        ({"outcome": Outcome.AGENT_ERROR}, 12, 1.3, ""),
        ({}, 12, float("nan"), ""),
        ({"outcome": Outcome.INVALID, "digest": "1"}, 3, 7.0, ""),
    ],
)
def test_result_and_recording_may_not_contradict_each_other(changes, steps, time_s, says):
    failure = Failure("ValueError", "odd")
    result = replace(
        TrialResult(SPEC, Outcome.SURVIVED, steps=12, sim_time_s=1.2, digest="0", failure=failure), **changes
    )
    assert _contradiction(result, SPEC, steps, time_s, "0") == says


def test_fault_of_crashhunt_itself_in_a_trial_ends_the_hunt(left_behind):
    records = left_behind[1]
    fault = encode_report({"fault": CrashhuntError("no map", fix="draw one").to_json()}, KEY, "")
    with pytest.raises(CrashhuntError, match="no map"):
        check(left_behind, fault, records=records)
    assert "cannot be read" in _fault_of({}).message
