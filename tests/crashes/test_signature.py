from __future__ import annotations

import faulthandler
import subprocess
import sys
import tempfile
import traceback
from types import SimpleNamespace

import pytest

from crashhunt.crashes import Bundle, Signature, group_crashes, signature_of
from crashhunt.trial import UNUSABLE_VALUE, Disturbance, Failure, Outcome, TrialResult, TrialSpec
from crashhunt.world import Event

SPEC = TrialSpec(0, 1, {"ego": {}}, {}, max_steps=10)
BRAKE = Disturbance(3, "ahead", "brake", 4.0, 2.0, "ego", "main.35")


def bundle(number, **evidence):
    outcome = evidence.pop("outcome", Outcome.AGENT_ERROR)
    steps = evidence.pop("steps", 5)
    return SimpleNamespace(
        result=TrialResult(SPEC, outcome, steps=steps, **evidence), path=f"b{number}", id=f"b{number}"
    )


def failure_of(function, *arguments):
    try:
        function(*arguments)
    except Exception as error:
        text = traceback.format_exc()
        caller = '  File "/x/site-packages/crashhunt/episode/_episode.py", line 191, in step\n    action = act()\n'
        head, rest = text.split("\n", 1)
        return Failure(type(error).__name__, str(error), f"{head}\n{caller}{rest}", "ego")
    raise AssertionError


def looks_up(number):
    return {}[number]


def divides(number):
    return number / 0


def test_software_faults_are_the_same_where_exception_and_functions_are():
    one, again, other = (bundle(n, failure=failure_of(f, n)) for n, f in enumerate((looks_up, looks_up, divides)))
    assert signature_of(one) == signature_of(again)
    assert signature_of(one).where == "test_signature.py:looks_up < test_signature.py:failure_of"
    assert signature_of(one).manner == "KeyError"
    assert str(signature_of(other)).startswith("ZeroDivisionError in test_signature.py:divides")
    groups = group_crashes([other, one, again]).groups
    assert [[member.id for member in group.bundles] for group in groups] == [["b0", "b1"], ["b2"]]


def test_crash_whose_log_is_lost_has_no_group(tmp_path):
    event = Event(kind="red_light", agent="ego", what="ran a red light")
    lost = Bundle(tmp_path, TrialResult(SPEC, Outcome("red_light"), 50, event=event), 1, "abc")
    found = group_crashes([lost, bundle(1, outcome=Outcome.HANG)])
    assert [group.bundles[0].id for group in found.groups] == ["b1"]
    assert str(tmp_path) in found.left_out[0]


def test_the_stack_of_a_stuck_process_begins_with_the_innermost_function():
    with tempfile.TemporaryFile("w+") as file:
        faulthandler.dump_traceback(file, all_threads=False)
        file.seek(0)
        text = file.read()
    found = signature_of(bundle(0, outcome=Outcome.HANG, failure=Failure("timeout", "60 s", text)))
    assert found.where.startswith("test_signature.py:test_the_stack_of_a_stuck_process_begins_with_")


def test_stack_of_an_earlier_version_has_the_same_type_in_a_file_with_letters_outside_of_ascii():
    """Earlier versions kept the escapes of `faulthandler`."""
    now, before = (
        Failure("timeout", "60 s", f'Thread 0x1 (most recent call first):\n  File "/mine/{name}.py", line 1 in act')
        for name in ("für", r"f\xfcr")
    )
    found = [signature_of(bundle(0, outcome=Outcome.HANG, failure=failure)) for failure in (now, before)]
    assert [one.where for one in found] == ["für.py:act"] * 2


def test_a_dead_process_is_known_by_its_signal_and_stack():
    code = (
        "import faulthandler, os, signal; faulthandler.enable()\ndef act(): os.kill(os.getpid(), signal.SIGSEGV)\nact()"
    )
    died = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    failure = Failure("signal", "SIGSEGV", died.stderr, exit_code=died.returncode)
    found = signature_of(bundle(0, outcome=Outcome.PROCESS_DIED, failure=failure))
    assert (found.manner, found.where) == ("signal -11", "<string>:act < <string>:<module>")


def test_without_a_stack_what_is_said_counts_but_for_its_numbers():
    said = [Failure("bad action", f"speed {value} is not within 0 and 100") for value in ("-1.5", "130", "0x7f")]
    assert len({signature_of(bundle(0, failure=failure)) for failure in said}) == 1
    assert signature_of(bundle(0, failure=said[0])) != signature_of(bundle(0, failure=Failure("bad action", "nan")))


def test_type_of_a_wrong_action_is_its_message_without_values():
    trace = '  File "/h/code/crashhunt/episode/_episode.py", line 9, in _act\n' + "".join(
        f'  File "/h/code/crashhunt/{place}", line 1, in check\n'
        for place in ("simulators/_actions.py", "sumo/_free_motion.py")
    )
    said = (
        "the trajectory turns the vehicle by -0.39 rad; turn less",
        "the action [nan, 0] is not (speed, lane); fix it",
    )
    found = [str(signature_of(bundle(0, failure=Failure("bad action", text, trace)))) for text in said]
    assert found == [
        "bad action: the trajectory turns the vehicle by # rad",
        "bad action: the action is not (speed, lane)",
    ]


def test_unusable_values_of_one_type_are_one_crash_type():
    texts = ("str: 'a' (allowed: a bool)", "str: 'b' (allowed: a bool)")
    said = [Failure(UNUSABLE_VALUE, f"info['hit'] is of type {text}") for text in texts]
    assert {signature_of(bundle(0, failure=failure)).where for failure in said} == {"info['hit'] is of type str"}


def test_code_of_libraries_is_excluded_where_there_is_other():
    inner = '  File "/v/lib/python3.11/json/decoder.py", line 1, in decode\n'
    own = '  File "/home/me/agent.py", line 5, in read\n'
    text = f"Traceback (most recent call last):\n{own}{inner}ValueError: x"
    assert signature_of(bundle(0, failure=Failure("ValueError", "x", text))).where == "agent.py:read"
    text = f"Traceback (most recent call last):\n{inner}ValueError: x"
    assert signature_of(bundle(0, failure=Failure("ValueError", "x", text))).where == "decoder.py:decode"


def test_files_of_ones_own_may_have_the_names_of_others():
    own = '  File "/home/me/python3-agents/episode.py", line 5, in act\n'
    text = f"Traceback (most recent call last):\n{own}ValueError: x"
    assert signature_of(bundle(0, failure=Failure("ValueError", "x", text))).where == "episode.py:act"


def test_events_and_disturbances_are_kinds_of_their_own():
    event = Event("not_moving", "ego", "ego has not moved for 60 s")
    found = signature_of(bundle(0, outcome=Outcome.NOT_MOVING, event=event))
    assert found == Signature("not_moving", manner="not_moving")
    assert signature_of(bundle(1, outcome=Outcome.NOT_MOVING, event=event, disturbances=(BRAKE,))) != found


@pytest.mark.parametrize(
    ("signature", "words"),
    [
        (Signature("collision", "collider", "rear end", "", "road"), "rear end, the agent into the other"),
        (
            Signature("collision", "victim", "side swipe", "other", "crossing", disturbed=True),
            "side swipe, the other into the agent, while the other changes lanes, where lanes cross, disturbed",
        ),
        (Signature("hang"), "hang"),
    ],
)
def test_words(signature, words):
    assert str(signature) == words
    assert Signature(**signature.to_json()) == signature
