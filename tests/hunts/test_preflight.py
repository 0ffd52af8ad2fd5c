"""Agents that do not start are refused in one line, and only where no trial could make them start."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import pytest

from crashhunt import run
from crashhunt.base import layout
from crashhunt.base.text import ABSENT_WORDS, PRESENT_WORDS
from crashhunt.errors import ArgumentError, FormulaError, ScenarioError, UsageError
from crashhunt.executors import EXCLUDED_WORDS
from crashhunt.hunts import Preflight
from crashhunt.hunts._preflight import WorkerNotices, _describe_end, require_known_signals, unusable_value, why_invalid
from crashhunt.plans import Request, plan
from crashhunt.trial import UNUSABLE_VALUE, Failure, Outcome, TrialResult, TrialSpec


def settings_of(**arguments):
    _, settings = plan(Request(trials=20, max_steps=5, scenario="loop", arguments=arguments, seed=1))
    return settings


def result(number, message="there is no file 'x'", *, outcome=Outcome.INVALID, agent="ego", kind="ValueError"):
    failure = Failure(kind, message, f'Traceback:\n  File "/s/code/my.py", line {7}, in x\n', agent)
    spec = TrialSpec(number, 1, {"ego": {"speed": 15.0}}, {}, max_steps=5)
    return TrialResult(spec, outcome, failure=failure if outcome is Outcome.INVALID else None)


def test_what_fails_in_every_trial_in_the_same_way_is_refused():
    preflight = Preflight(settings_of(speed="15"), 20, code=("/s/code",))
    assert [preflight.filter_setup_failures(result(number, kind="KeyError")) for number in range(3)] == [[], [], []]
    with pytest.raises(
        ArgumentError, match="KeepLaneWithSpeed does not start: KeyError: there is no file 'x'"
    ) as caught:
        preflight.filter_setup_failures(result(3, kind="KeyError"))
    assert caught.value.where == "/s/code/my.py:7"  # the hunt names the original
    assert caught.value.exit_code == 2


def test_value_that_cannot_be_compared_in_the_first_trial_is_refused_at_once():
    failed = result(4, "info['hit'] is of type tuple: ('; ',); return a bool", kind=UNUSABLE_VALUE, agent="")
    failed = replace(failed, outcome=Outcome.SIMULATOR_ERROR, steps=6)
    with pytest.raises(ScenarioError, match=r"^step 7 of trial 4 \(seed 1\): info\['hit'\] is of") as caught:
        Preflight(settings_of(speed="15"), 20).filter_setup_failures(failed)
    assert (caught.value.exit_code, caught.value.fix) == (2, "return a bool")
    preflight = Preflight(settings_of(speed="15"), 20)
    survived = result(0, outcome=Outcome.SURVIVED)
    assert [preflight.filter_setup_failures(one) for one in (survived, failed)] == [[survived], [failed]]
    assert unusable_value(survived) is None


def test_unknown_signal_is_refused_before_the_first_trial(tmp_path):
    asked = {"scenario": "intersection-two-agents", "trials": 1, "max_steps": 20, "seed": 1, "snapshot_code": False}
    with pytest.raises(FormulaError, match=r"requirement far: the signal 'west.gapp_m' is unknown; .* 'west.gap_m'"):
        run(tmp_path / "h", 1, requirements=["far=always (west.gapp_m > 1 and info.speed > 0)"], **asked)
    assert not (tmp_path / "h").exists()
    require_known_signals(*plan(Request(requirements=("always (west.gap_m > 0 or info.speed > 0)",), **asked)))


def test_key_of_info_of_another_agent_can_be_required(tmp_path):
    asked = {"scenario": "intersection-two-agents", "max_steps": 30, "keep_going": True, "snapshot_code": False}
    found = run(tmp_path / "h", 1, 3, requirements=["hit=always (not west.crashed)"], seed=1, **asked)
    assert sum(found.outcomes.values()) == 3
    assert found.outcomes.keys() - {"collision"}  # after which west has left, or drives on


def test_constructor_that_needs_more_than_it_is_given_is_not_blamed_on_a_line_of_crashhunt():
    failure = result(0, "missing 1 required positional argument: 'a'", kind="TypeError")
    called = f'Traceback:\n  File "{layout.PACKAGE}/episode/_parts.py", line 272, in agent\n'
    failed = replace(failure, failure=replace(failure.failure, traceback=called))
    with pytest.raises(ArgumentError, match="missing 1 required") as caught:
        Preflight(settings_of(speed="15"), 1).filter_setup_failures(failed)
    assert caught.value.where == "agent ego"


def test_a_hunt_of_one_trial_is_refused_after_one():
    with pytest.raises(ArgumentError, match="there is no file 'x'; correct the agent"):
        Preflight(settings_of(speed="15"), 1).filter_setup_failures(result(0))


def test_files_are_named_as_they_were_given():
    preflight = Preflight(settings_of(speed="15"), 1, files={"w.onnx": "/s/files/0-w.onnx"})
    with pytest.raises(ArgumentError, match=r"'w.onnx' has nine outputs"):
        preflight.filter_setup_failures(result(0, "'/s/files/0-w.onnx' has nine outputs"))


def test_fix_that_the_agent_names_is_the_fix():
    message = "'m.zip' was trained on observations of shape (5, 5). Fix: give frame_stack=4"
    with pytest.raises(ArgumentError, match=r"of shape \(5, 5\); give frame_stack=4$"):
        Preflight(settings_of(speed="15"), 1).filter_setup_failures(result(0, message))


@pytest.mark.parametrize(
    "other",
    [result(9, outcome=Outcome.SURVIVED), result(9, "another reason"), result(9, agent=""), result(9, kind="KeyError")],
)
def test_as_soon_as_one_is_otherwise_all_are_accounted_for(other):
    preflight = Preflight(settings_of(speed="15"), 20)
    held = [result(number) for number in range(3)]
    assert [preflight.filter_setup_failures(one) for one in held] == [[], [], []]
    assert preflight.filter_setup_failures(other) == [*held, other]
    assert preflight.filter_setup_failures(held[0]) == [held[0]]


def test_where_an_argument_varies_another_value_may_do():
    preflight = Preflight(settings_of(speed="5:15"), 20)
    assert preflight.filter_setup_failures(result(0)) == [result(0)]


@pytest.mark.parametrize("kind", ["PluginError", "UsageError"])
def test_where_no_value_would_do_it_is_refused_with_the_fix_of_the_message(kind):
    preflight = Preflight(settings_of(speed="5:15"), 3)
    message = "'fmu:a.fmu': its input x has no source; name the source"
    held = [result(number, message, kind=kind) for number in range(3)]
    assert [preflight.filter_setup_failures(one) for one in held[:2]] == [[], []]
    with pytest.raises(
        ArgumentError, match=r"^agent ego: .* does not start: 'fmu:a\.fmu': .* no source; name the source$"
    ):
        preflight.filter_setup_failures(held[2])


class Says:
    """An executor with notices."""

    def __init__(self, *notes):
        self.said = list(notes)

    def notes(self):
        found, self.said = self.said, []
        return found


def asking(**options):
    agents = {name: SimpleNamespace(agent=agent) for name, agent in (("ego", "my:A"), ("b", "my:B"), ("c", "my:A"))}
    return SimpleNamespace(**{"probe": "", "branch": False, "rare": False, "agents": agents} | options)


@pytest.mark.parametrize("what", ["probes", "branches", "rare"])
def test_hunt_whose_trials_cannot_be_forked_is_refused_before_its_first_result(what):
    note = f"{what}{EXCLUDED_WORDS}it has threads"
    heard = WorkerNotices(asking(probe="4s", branch=True), {})
    with pytest.raises(UsageError) as caught:
        heard.take(Says("slow", note))
    assert caught.value.message == "--probe and --branch: trials with my:A, my:B cannot be copied: it has threads"
    assert caught.value.fix == "correct my:A, my:B, or omit --probe and --branch"
    with pytest.raises(UsageError, match=r"^--rare: trials with"):
        WorkerNotices(asking(rare=True), {"survived": 0}).hear(Says(note))
    later = WorkerNotices(asking(rare=True), {"survived": 1})  # then the hunt continues without forks
    assert later.take(Says(note)) == [note]


def test_notices_are_returned_once_and_in_order():
    heard = WorkerNotices(asking(), {})
    heard.hear(Says("a", f"logs{EXCLUDED_WORDS}there is no room"))
    assert heard.take(Says("b", "probes are slow")) == [
        "a", f"logs{EXCLUDED_WORDS}there is no room", "b", "probes are slow",
    ]  # fmt: skip
    assert heard.take(Says()) == []


ABSENT = f"gym.danger = 'info.x'{ABSENT_WORDS}info was empty. Fix: name one of its keys"


def test_name_that_no_trial_had_is_reported_once_after_enough_trials_or_at_the_end():
    outcomes = Counter()
    heard = WorkerNotices(asking(), outcomes)
    assert heard.take(Says(ABSENT, ABSENT.replace("empty", "full"), "a")) == ["a"]
    assert heard.absent(at_end=True) == []  # no trial has finished
    outcomes.update({Outcome.FINISHED: 1, Outcome.HANG: 30})  # what hung has not reported its keys
    assert heard.absent() == []
    told = (
        "gym.danger = 'info.x' names nothing that occurred in the first {}: info was empty. Fix: name one of its keys"
    )
    assert heard.absent(at_end=True) == [told.format("trial")]
    assert heard.absent(at_end=True) == []
    again = WorkerNotices(asking(), Counter())
    again._outcomes[Outcome.FINISHED] = 10
    again.hear(Says(ABSENT))
    assert again.absent() == [told.format("10 trials")]
    assert again.newly_occurred() == ()
    again.hear(Says(f"gym.danger = 'info.x'{PRESENT_WORDS}"))
    (refuted,) = again.newly_occurred()
    assert told.startswith(refuted)
    assert again.newly_occurred() == ()


def test_name_that_some_trial_had_and_hunts_that_resume_have_no_such_notice():
    heard = WorkerNotices(asking(), outcomes := Counter())
    assert heard.take(Says(ABSENT, f"gym.danger = 'info.x'{PRESENT_WORDS}")) == []
    outcomes[Outcome.FINISHED] = 30
    assert heard.absent(at_end=True) == []
    resumed = WorkerNotices(asking(), outcomes)
    resumed.hear(Says(ABSENT))
    assert resumed.absent(at_end=True) == []


def test_first_result_is_counted_after_the_notices_were_read():
    heard = []
    preflight = Preflight(settings_of(speed="15"), 20, listen=lambda: heard.append(1))
    assert preflight.filter_setup_failures(result(0)) == []
    assert heard == []
    for number in (1, 2):
        preflight.filter_setup_failures(result(number, outcome=Outcome.SURVIVED))
    assert heard == [1]
    assert preflight.filter_setup_failures(result(3)) == [result(3)]  # nothing is held back any more
    varied = Preflight(settings_of(speed="15:16"), 1)
    assert varied.filter_setup_failures(result(0)) == [result(0)]


def test_refusal_names_arguments_that_are_texts_and_what_to_install():
    def refused(message, arguments, kind="ValueError"):
        failed = result(0, message, kind=kind)
        failed = replace(failed, spec=replace(failed.spec, arguments={"ego": arguments}))
        with pytest.raises(ArgumentError) as caught:
            Preflight(settings_of(speed="15"), 1).filter_setup_failures(failed)
        return caught.value

    assert refused("no", {"speed": 15.0, "policy": "p.zip", "mode": "fast"}).fix == (
        "correct the agent or its arguments policy=p.zip, mode=fast"
    )
    assert refused("no", {"speed": 15.0}).fix == "correct the agent"
    assert refused("it needs torch: pip install torch", {}).fix == "install the package"
    assert refused("no", {}, kind="KeyError").where == "/s/code/my.py:7"
    assert refused("no", {}).where == "agent ego"
    assert refused("no", {}, kind="invalid").message.endswith("does not start: no")


def test_reason_of_an_invalid_trial_is_that_of_the_simulator_or_its_last_line():
    told = []

    def explained(summary, output, scenario):
        told.append((summary, output, scenario))
        return answer

    scenario = SimpleNamespace(backend=SimpleNamespace(explained=explained))
    answer = ValueError("no edge")
    failure = Failure("SimulatorError", "it failed", last_output="Error: no edge\n \nWarning: slow\n")
    failed = TrialResult(TrialSpec(1, 1, {}, {}, 9), Outcome.INVALID, failure=failure)
    assert why_invalid(failed, scenario) == "no edge"
    assert told == [(failed.summary, failure.last_output, scenario)]
    answer = None
    assert why_invalid(failed, scenario) == f"{failed.summary}\n  last output: Error: no edge"
    plain = SimpleNamespace(backend=SimpleNamespace(explained=None))
    assert why_invalid(failed, plain) == f"{failed.summary}\n  last output: Error: no edge"
    silent = replace(failed, failure=replace(failure, last_output="Warning: slow"))
    assert why_invalid(silent, plain) == silent.summary
    assert why_invalid(replace(failed, failure=None), scenario) == replace(failed, failure=None).summary
    assert len(told) == 2


def test_end_of_a_process_is_a_signal_or_an_exit_code():
    assert [_describe_end(code) for code in (-9, -1, 0, 1, 3)] == [
        "signal 9", "signal 1", "exit code 0", "exit code 1", "exit code 3",
    ]  # fmt: skip
