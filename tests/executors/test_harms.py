"""Agents that do harm, by kind and moment: each costs its own trial, which says what happened and by which agent."""

from __future__ import annotations

import re
import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING

import harms
import pytest
from conftest import mostly_nightly, wait_for
from toy_trials import settings_for

from crashhunt.executors import FreshProcessExecutor, PoolExecutor
from crashhunt.trial import Outcome, TrialResult, TrialSpec

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from crashhunt.executors import Executor

MAX_STEPS = 12
INVALID, ERROR, DIED, HANG, SURVIVED = "invalid", "agent_error", "process_died", "hang", "survived"
# By what becomes of a process in which an agent does harm: the outcome at each moment, and whether the agent is named.
NAMED = True
EXPECTED: dict[str, dict[str, tuple[str, bool]]] = {
    "raises": {
        "constructor": (INVALID, NAMED), "reset": (INVALID, NAMED),
        "first act": (ERROR, NAMED), "fifth act": (ERROR, NAMED), "signal handler": (ERROR, NAMED),
        # Nothing waits for what these raise.
        "close": (SURVIVED, False), "finalizer": (SURVIVED, False), "thread": (SURVIVED, False),
        "child": (SURVIVED, False), "exit": (SURVIVED, False),
    },
    "dies": {
        "constructor": (INVALID, NAMED), "reset": (INVALID, NAMED),
        "first act": (DIED, NAMED), "fifth act": (DIED, NAMED), "thread": (DIED, NAMED),
        "close": (DIED, NAMED), "finalizer": (DIED, NAMED),
        "signal handler": (DIED, False),  # while the simulator runs; nothing is left that says more
        "child": (SURVIVED, False), "exit": (SURVIVED, False),
    },
    "lives": dict.fromkeys(harms.MOMENTS, (SURVIVED, False)),
}  # fmt: skip
EXPECTED["hangs"] = {
    **{moment: (HANG if outcome == DIED else outcome, named) for moment, (outcome, named) in EXPECTED["dies"].items()},
    "thread": (SURVIVED, False),
}
_DAMAGED = dict.fromkeys(harms.MOMENTS[:-2], (ERROR, NAMED))  # the process cannot report the results trial
SHOWN_IN_STACK = (
    "segfaults",
    "aborts",
    *(("overflows_stack",) if harms.HARMS["overflows_stack"][0] == "dies" else ()),
    "divides_in_c",
    "frees_what_is_not_its_own",
)
EXCEPTIONS: dict[str, dict[str, tuple[str, bool]]] = {
    "no_json": {**_DAMAGED, "constructor": (INVALID, NAMED), "reset": (INVALID, NAMED)},
    "no_os": _DAMAGED,
    # The stack shows whose handler it was.
    **{name: {"signal handler": (DIED, NAMED)} for name in SHOWN_IN_STACK},
    "terminates_group": {"child": (DIED, NAMED)},  # to which its parent belongs
    "sleeps_in_c": {"thread": (HANG, NAMED)},  # it holds the interpreter
    "stops_itself": {"thread": (HANG, NAMED)},  # with all its threads
}
HANGS = ("hangs_with_program", "fifth act")
HANG_S = 4.0  # two hundred times what the trials beside it take
IN_C = ("segfaults", "signal handler")
MESSAGES = {
    ("exits_with_79", "fifth act"): "the process exited with 79 in ego's act() of step 5",
    ("exits_with_78", "fifth act"): "the process exited with 78 in ego's act() of step 5",
    ("exits_with_success", "first act"): "the process exited with 0 in ego's act() of step 1",
    ("segfaults", "close"): "the process died of SIGSEGV after the last step",
    ("exits_with_79", "constructor"): "the process exited with 79 in ego's constructor or reset() while the episode was"
    " being set up",
    ("recurses", "fifth act"): "maximum recursion depth exceeded",
    ("raises_error", "signal handler"): "harm",
    ("feigns_full_disk", "signal handler"): "the disk is full; buy one",
    ("kills_itself", "fifth act"): "the process died of SIGKILL in ego's act() of step 5",
    ("deletes_folder", "fifth act"): None,
}
ATTACKS = [name for name in harms.HARMS if "_to_" in name]
DEADLY = [one for one in ATTACKS if "KILL" in one or one in ("SIGTERM_to_zygote", "SIGTERM_to_supervisor")]
TABLE = {
    (name, moment): EXCEPTIONS.get(name, {}).get(moment, EXPECTED[nature][moment])
    for name, (nature, _) in harms.HARMS.items()
    for moment in harms.MOMENTS
    if name not in (*ATTACKS, "raises_forever")
}


@pytest.fixture
def run(tmp_path, monkeypatch) -> Callable[..., dict[int, TrialResult]]:
    shutil.copy(harms.__file__, tmp_path)
    monkeypatch.chdir(tmp_path)

    def run_trials(
        trials: Iterable[tuple[str, str]],
        make: Callable[..., Executor] = PoolExecutor,
        timeout_s: float = 3.0,
        *,
        every: int = 1,
    ) -> dict[int, TrialResult]:
        """Run trials that do harm at a moment, each, or so many of them, between two that do none."""
        settings = settings_for(tmp_path, "harms:Agent", timeout_s=timeout_s)
        asked = [("", "")]
        for place, pair in enumerate(trials, start=1):
            asked += [pair] if place % every else [pair, ("", "")]
        asked += [("", "")] * bool(asked[-1][0])
        found: dict[int, TrialResult] = {}
        executor = make(settings, parallel=2)
        try:
            for number, (what, when) in enumerate(asked):
                slow = {"step_wall_s": 0.004} if when == "signal handler" else {}  # so that the simulator is what runs
                executor.submit(TrialSpec(number, 7, {"ego": {"what": what, "when": when}}, slow, MAX_STEPS))
            deadline = time.monotonic() + 380
            while len(found) < len(asked):
                assert time.monotonic() < deadline, f"missing: {[asked[n] for n in set(range(len(asked))) - {*found}]}"
                found |= {result.spec.number: result for result in executor.completed(0.2)}
        finally:
            executor.close()
        harmful = [number for number, (what, _) in enumerate(asked) if what]
        clean = {(str(one.outcome), one.digest) for number, one in found.items() if number not in harmful}
        assert len(clean) == 1, {
            (asked[number - 1] if number else None): str(result.outcome)
            for number, result in found.items()
            if number not in harmful and str(result.outcome) != SURVIVED
        }
        assert {outcome for outcome, _ in clean} == {SURVIVED}
        for result in found.values():
            assert TrialResult.from_json(result.to_json()) == result
            str(result.to_json()).encode()  # can be written anywhere
        return {place: found[number] for place, number in enumerate(harmful)}

    return run_trials


def check(trials, found):
    """Each trial has the outcome, and names the agent, as the table says."""
    got = {
        pair: (str(result.outcome), result.failure is not None and result.failure.agent == "ego")
        for pair, result in zip(trials, (found[number] for number in range(len(trials))), strict=True)
    }
    expected = {pair: TABLE[pair] for pair in trials}
    wrong = {
        pair: (got[pair], expected[pair], found[number].failure and found[number].failure.message[:200])
        for number, pair in enumerate(trials)
        if got[pair] != expected[pair]
    }
    assert wrong == {}


def check_each(run, trials, make=PoolExecutor):
    """Run trials that hang with a short time limit, and all others with one that no busy machine exceeds."""
    hanging = [pair for pair in trials if harms.HARMS[pair[0]][0] == "hangs" or TABLE[pair][0] == HANG]
    for some, timeout_s in ((hanging, 10.0), ([pair for pair in trials if pair not in hanging], 60.0)):
        check(some, run(some, make, timeout_s=timeout_s))


def sample(start, *, natures=("raises", "dies", "lives"), every=17):
    """Some kinds of harm, each at moments of its own."""
    chosen = [pair for pair in TABLE if harms.HARMS[pair[0]][0] in natures and pair[0] != "raises_long_message"]
    return chosen[start::every]


def programs() -> list[int]:
    """The programs that the agent starts, wherever they have gone."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            line = path.read_bytes()
            here = (path.parent / "cwd").readlink()
        except OSError:
            continue
        if line.startswith(b"sleep\x00986") and here == Path.cwd():
            found.append(int(path.parent.name))
    return found


def test_harm_of_each_kind_costs_its_own_trial_and_nothing_of_it_stays(run):
    assert len(TABLE) + len(ATTACKS) > 300
    natures = ("raises", "dies", "lives")
    trials = [(name, "fifth act") for name, (nature, _) in harms.HARMS.items() if nature in natures]
    trials = [pair for pair in dict.fromkeys([*trials, *MESSAGES, IN_C]) if pair in TABLE]
    # A handler that raises again and again does so also while crashhunt finds out whose exception it is.
    endless = [("raises_forever", "fifth act")] * 4
    found = run([*trials, *endless], timeout_s=60.0, every=4)  # none of these hangs, and the machine may be busy
    check(trials, found)
    raised = [found[len(trials) + number] for number in range(len(endless))]
    assert {(str(result.outcome), result.failure.agent) for result in raised} == {(ERROR, "ego")}
    said = {pair: found[number].failure and found[number].failure.message for number, pair in enumerate(trials)}
    assert {pair: said[pair] for pair in MESSAGES} == MESSAGES
    # The signal arrives after a time, not at a place: now and then in the middle of a call of act().
    assert re.match(r"the process died of SIGSEGV in ego's (code at|act\(\) of) step \d+$", said[IN_C])
    assert all(result.digest or result.outcome is Outcome.INVALID for result in found.values())
    check([HANGS], run([HANGS], timeout_s=HANG_S))
    # The template ends what a worker has left behind after it has told of its end.
    wait_for(lambda: not programs(), every_s=0.05)


@pytest.mark.parametrize(
    "what",
    mostly_nightly(
        ["starts_daemon", "dies_with_program", "hangs_with_program", "closes_everything", "raises_surrogate"],
        always=["starts_daemon", "hangs_with_program"],
    ),
)
def test_fresh_process_leaves_nothing_either(run, what):
    trials = [(what, "fifth act")]
    check(trials, run(trials, FreshProcessExecutor, timeout_s=HANG_S if trials == [HANGS] else 60.0))
    assert programs() == []


@pytest.mark.nightly
@pytest.mark.parametrize("part", range(8))
def test_every_harm_at_every_moment_costs_its_own_trial_and_is_named(run, part):
    check_each(run, list(TABLE)[part::8])


@pytest.mark.nightly
def test_fresh_processes_say_the_same(run):
    check_each(run, sample(5, natures=("raises", "dies", "lives", "hangs"), every=29), FreshProcessExecutor)


@pytest.mark.parametrize(
    "attack", [one if one == "SIGSTOP_to_zygote" else pytest.param(one, marks=pytest.mark.nightly) for one in ATTACKS]
)
def test_attack_on_the_processes_above_costs_no_other_trial(run, attack):
    result = run([(attack, "fifth act")])[0]
    # Killed from outside, it is run again, alone; killed at the same place again, it did that itself.
    assert str(result.outcome) == (DIED if attack in DEADLY else SURVIVED)
    assert result.failure is None or result.failure.agent == "ego"
