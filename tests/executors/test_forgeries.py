"""Whatever the process of a trial writes where its result is looked for, it is not believed, and the hunt goes on."""

from __future__ import annotations

import shutil
import time
from typing import TYPE_CHECKING

import forgeries
import pytest

from crashhunt.episode import WorkerSettings, scratch_of
from crashhunt.executors import FreshProcessExecutor, PoolExecutor
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.trial import CRASHES, TrialResult, TrialSpec

if TYPE_CHECKING:
    from crashhunt.executors import Executor

SURVIVED = "survived", None, ""
OVERWRITTEN = "agent_error", "its recording was overwritten", "ego"
TRUNCATED = "agent_error", "its recording was truncated", "ego"
NOT_OURS = "agent_error", "the process may not be believed: its report was not written by crashhunt", "ego"
NO_PROLOGUE = (
    "agent_error",
    (
        "the process may not be believed: its recording does not begin with the prologue, or does twice, "
        "and its recording cannot be read"
    ),
    "ego",
)
EXPECTED: dict[str, tuple[str, str | None, str]] = {
    "answer_into_every_descriptor": OVERWRITTEN,
    "error_into_every_descriptor": OVERWRITTEN,
    "answer_file": SURVIVED,
    "report_by_path": NOT_OURS,
    "report_by_own_classes": NOT_OURS,
    "report_and_goes_on": SURVIVED,  # and its own report is the last
    "report_of_endless_length": (
        "agent_error", "the process could not report the result, as it is damaged", "ego",
    ),
    "report_of_negative_length": NOT_OURS,
    "report_by_child_that_stays": NO_PROLOGUE,
    "exit_without_report": ("process_died", "the process exited with 0 in ego's act() of step 5", "ego"),
    "header_through_descriptor": OVERWRITTEN,
    "header_of_another_trial": OVERWRITTEN,
    "fewer_records": SURVIVED,  # the recorder itself says how many there are after each
    "more_records": OVERWRITTEN,
    "garbage_records": (
        "agent_error",
        "the process may not be believed: its recording is cut off, and its recording cannot be read",
        "ego",
    ),
    "truncated": TRUNCATED,
    "truncated_at_step_5": TRUNCATED,
    "grown": SURVIVED,
    "replaced": SURVIVED,  # what counts is what the process has mapped
    "link_to_another_file": SURVIVED,
    "folder_is_a_link": SURVIVED,
    "memory_of_recorder": NO_PROLOGUE,
}  # fmt: skip


def run(tmp_path, monkeypatch, kind: type[Executor]) -> dict[str, TrialResult]:
    shutil.copy(forgeries.__file__, tmp_path)
    monkeypatch.chdir(tmp_path)
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    scenario = Scenario(simulator="toy", agents={"ego": AgentSetup(agent="forgeries:Agent")})
    settings = WorkerSettings(scenario=scenario, oracles=(), crash_on=CRASHES, scratch=scratch, timeout_s=20.0)
    asked = [how for one in EXPECTED for how in ("", one)] + [""]
    found: dict[int, TrialResult] = {}
    executor = kind(settings, parallel=2)
    try:
        for number, how in enumerate(asked):
            executor.submit(TrialSpec(number, 7, {"ego": {"how": how}}, {}, max_steps=12))
        deadline = time.monotonic() + 300
        while len(found) < len(asked):
            assert time.monotonic() < deadline, [asked[number] for number in range(len(asked)) if number not in found]
            found |= {result.spec.number: result for result in executor.completed(0.2)}
        assert not [note for note in executor.notes() if "forged" in note]
    finally:
        executor.close()
    assert {(str(found[number].outcome), found[number].digest) for number in range(0, len(asked), 2)} == {
        ("survived", found[0].digest)
    }
    for number in range(1, len(asked), 2):
        assert found[number].digest != forgeries.DIGEST
        assert not found[number].kept or scratch_of(scratch, number).is_dir()
        assert not scratch_of(scratch, number).is_symlink()
    return {asked[number]: found[number] for number in range(1, len(asked), 2)}


@pytest.mark.parametrize("kind", [PoolExecutor, pytest.param(FreshProcessExecutor, marks=pytest.mark.nightly)])
def test_forged_results_are_refused(tmp_path, monkeypatch, kind):
    found = run(tmp_path, monkeypatch, kind)
    said = {
        how: (str(result.outcome), result.failure and result.failure.message, result.failure.agent)
        if result.failure
        else (str(result.outcome), None, "")
        for how, result in found.items()
    }
    assert said == EXPECTED
    assert len(said) >= 10
