"""Whatever an agent does to its process costs its own trial only, and nothing of it stays."""

from __future__ import annotations

import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from conftest import wait_for

from crashhunt.episode import WorkerSettings
from crashhunt.executors import Executor, FreshProcessExecutor, PoolExecutor
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.trial import CRASHES, TrialResult, TrialSpec

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

UNHARMED = "survived"
HARM = {
    "hangs_with_program": "hang",  # first: the others run while it is waited for
    "exits_in_init": "invalid",
    "exits_in_reset": "invalid",
    "exits_in_close": UNHARMED,
    "interrupts_in_close": UNHARMED,
    "mute": "agent_error",
    "leaving": "agent_error",
    "surrogate": "agent_error",
    "shouts": "agent_error",
    "interrupts": "agent_error",
    "exits": "agent_error",
    "leaks": UNHARMED,
    "closes_output": UNHARMED,
    "closes_everything": UNHARMED,
    "limits_files": UNHARMED,
    "leaves_folder": UNHARMED,
    "no_open": UNHARMED,
    "no_length": None,
    "no_modules": None,  # whoever imports something next fails, if anybody does
    "no_output": UNHARMED,
    "no_json": "agent_error",
    "no_random": UNHARMED,
    "no_environment": UNHARMED,
    "no_collection": UNHARMED,
    "shallow": UNHARMED,
    "deaf": UNHARMED,
    "counts": UNHARMED,
    "sets_inside": UNHARMED,
    "fills_default": UNHARMED,
    "thread": UNHARMED,
    "program": UNHARMED,
    "daemon": UNHARMED,
    "forks": UNHARMED,
    "dies_with_program": "process_died",
    "segfaults": "process_died",
    "kills_itself": "process_died",
    "terminates_itself": "process_died",
    "terminates_group": "process_died",
    "kills_parent": "process_died",
}


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> WorkerSettings:
    shutil.copy(Path(__file__).parent / "hostile.py", tmp_path)
    monkeypatch.chdir(tmp_path)
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    scenario = Scenario(simulator="toy", folder=tmp_path, agents={"ego": AgentSetup(agent="hostile:Agent")})
    return WorkerSettings(scenario=scenario, oracles=(), crash_on=CRASHES, scratch=scratch, timeout_s=3.0)


@pytest.fixture
def start(settings: WorkerSettings) -> Iterator[Callable[..., Executor]]:
    started: list[Executor] = []

    def make(kind: Callable[..., Executor], parallel: int, chosen: WorkerSettings = settings) -> Executor:
        started.append(kind(chosen, parallel=parallel))
        return started[-1]

    yield make
    for executor in started:
        executor.close()


def spec(number: int, what: str = "") -> TrialSpec:
    return TrialSpec(number, 7, {"ego": {"what": what}}, {}, max_steps=12)


def collect(executor: Executor, count: int) -> dict[int, TrialResult]:
    found: dict[int, TrialResult] = {}
    deadline = time.monotonic() + 300
    while len(found) < count:
        assert time.monotonic() < deadline, f"only {sorted(found)} came back"
        found |= {result.spec.number: result for result in executor.completed(0.2)}
    return found


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


def test_harm_costs_its_own_trial_only_and_nothing_of_it_stays(start, settings):
    pool = start(PoolExecutor, 2)
    names = list(HARM)
    for number, what in enumerate(names):
        pool.submit(spec(2 * number, what))
        pool.submit(spec(2 * number + 1))
    found = collect(pool, 2 * len(names))
    # The limit is short for those that hang. On a busy machine, others may exceed it, also those in between.
    harm = {2 * number: what for number, what in enumerate(names)}
    slow = [number for number in found if found[number].outcome == "hang" != HARM.get(harm.get(number, ""))]
    if slow:
        patient = start(PoolExecutor, 2, replace(settings, timeout_s=60.0))
        for number in slow:
            patient.submit(spec(number, harm.get(number, "")))
        found |= collect(patient, len(slow))
    outcomes = {what: str(found[2 * number].outcome) for number, what in enumerate(names)}
    assert outcomes == {what: expected or outcomes[what] for what, expected in HARM.items()}
    assert outcomes["no_modules"] in ("survived", "agent_error")
    between = [found[2 * number + 1] for number in range(len(names))]
    assert {str(result.outcome) for result in between} == {"survived"}
    assert len({result.digest for result in between}) == 1
    # The template ends what a worker has left behind after it has told of its end.
    wait_for(lambda: not programs(), every_s=0.05)
    for result in found.values():
        assert TrialResult.from_json(result.to_json()) == result
        str(result.to_json()).encode()  # can be written anywhere


@pytest.mark.parametrize(
    "what", ["daemon", "dies_with_program", "hangs_with_program", "closes_everything", "surrogate"]
)
def test_a_fresh_process_leaves_nothing_either(start, settings, what):
    timeout_s = 1.0 if HARM[what] == "hang" else settings.timeout_s
    fresh = start(FreshProcessExecutor, 1, replace(settings, timeout_s=timeout_s))
    fresh.submit(spec(0, what))
    assert str(collect(fresh, 1)[0].outcome) == HARM[what]
    assert programs() == []
