"""The contract suite for executors. The trials run on the toy simulator, which fails in every way on request."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import pytest

from crashhunt.base import layout
from crashhunt.base.foreign_code import supports
from crashhunt.episode import WorkerSettings, scratch_of
from crashhunt.executors import Executor, HasNodes
from crashhunt.recording import Recording, read_black_box
from crashhunt.scenario import AgentSetup, ArgumentSetup, Scenario
from crashhunt.trial import CRASHES, Outcome, TrialResult, TrialSpec

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.recording import BlackBoxHeader
    from crashhunt.trial import Value

Make = Callable[[WorkerSettings, int], Executor]

_WAITS_S = 150.0  # longer than any executor takes on a loaded machine, and half the limit of a trial that hangs
_SWITCHES = ("fail_at_step", "exit_at_step", "segfault_at_step", "hang_at_step")


class ExecutorContract:
    """Checks an executor against `crashhunt.executors.Executor`.

    The fixture ``make`` returns a function that creates an executor, given settings and a number of workers.
    """

    @pytest.fixture
    def make(self) -> Make:
        """Return a function that creates an executor."""
        raise NotImplementedError("the test class must define the fixture 'make'")

    @pytest.fixture
    def executor(self, make: Make, tmp_path: Path) -> Iterator[Executor]:
        """Return an executor with two workers and a time limit of two seconds."""
        yield from _made(make, tmp_path, timeout_s=2.0)

    @pytest.fixture
    def patient(self, make: Make, tmp_path: Path) -> Iterator[Executor]:
        """Return an executor with two workers, in which a trial may hang for minutes."""
        yield from _made(make, tmp_path, timeout_s=2 * _WAITS_S)

    def _spec(self, number: int, **arguments: Value) -> TrialSpec:
        return TrialSpec(
            number=number, seed=number, arguments={"ego": {"speed": 5.0}}, scenario_arguments=arguments, max_steps=30
        )

    def _collect(self, executor: Executor, count: int) -> dict[int, TrialResult]:
        found: dict[int, TrialResult] = {}
        deadline = time.monotonic() + 90
        while len(found) < count:
            assert time.monotonic() < deadline, f"only {sorted(found)} came back"
            for result in executor.completed(0.2):
                assert result.spec.number not in found, "a trial came back twice"
                found[result.spec.number] = result
        return found

    def _see_nodes(self, executor: Executor, place: HasNodes, ended: int) -> None:
        """Check that the figures of the nodes add up within some seconds."""
        deadline = time.monotonic() + 30
        while sum(node.trials for node in place.nodes()) != ended:
            assert time.monotonic() < deadline, f"{ended} trials have ended, and the nodes are {place.nodes()}"
            assert list(executor.completed(0.1)) == []
        assert sum(node.parallel for node in place.nodes()) == executor.capacity
        assert all(node.name and node.rate_per_s >= 0 for node in place.nodes())

    def test_every_trial_comes_back_once(self, executor: Executor) -> None:
        """Every trial returns with the specification that was submitted."""
        specs = [self._spec(number) for number in range(6)]
        for spec in specs:
            executor.submit(spec)
        found = self._collect(executor, 6)
        assert [found[spec.number].spec for spec in specs] == specs
        assert {result.outcome for result in found.values()} == {Outcome.SURVIVED}
        assert list(executor.completed(0.0)) == []
        if supports(executor, HasNodes):
            self._see_nodes(executor, executor, len(specs))

    def test_a_failure_costs_its_own_trial_only(self, executor: Executor) -> None:
        """Trials that run next to an exception, an exit, a segmentation fault and a hang have their usual results."""
        # The hang comes first: the other worker does the rest while it is waited for.
        failures = {1: "hang_at_step", 3: "fail_at_step", 5: "exit_at_step", 7: "segfault_at_step"}
        for number in range(9):
            executor.submit(self._spec(number, **({failures[number]: 10} if number in failures else {})))
        found = self._collect(executor, 9)
        outcomes = {number: str(result.outcome) for number, result in found.items() if number in failures}
        assert outcomes == {1: "hang", 3: "simulator_error", 5: "process_died", 7: "process_died"}
        assert all(result.steps == 9 for number, result in found.items() if number in failures)
        good = {number: result for number, result in found.items() if number not in failures}
        assert {result.outcome for result in good.values()} == {Outcome.SURVIVED}
        assert all(result.steps == 30 and result.digest for result in good.values())

    def test_cancelled_trials_do_not_come_back(self, patient: Executor) -> None:
        """Cancelled trials block no other trial, even if they hang. Trials that are submitted later run."""
        patient.submit(self._spec(0))
        self._collect(patient, 1)
        for number in range(1, 6):
            patient.submit(self._spec(number, hang_at_step=5))
        list(patient.completed(0.3))
        began = time.monotonic()
        patient.cancel(above=0)
        assert time.monotonic() - began < _WAITS_S, "the executor waits for a trial that hangs"
        patient.submit(self._spec(9))
        assert set(self._collect(patient, 1)) == {9}

    def test_it_states_how_much_it_runs_and_where_that_is(self, executor: Executor) -> None:
        """The progress of running trials is reported or unknown; trials that were not submitted have no progress."""
        assert executor.capacity == 2
        assert dict(executor.where()) == {}
        executor.submit(self._spec(3, hang_at_step=5))
        deadline = time.monotonic() + 60
        found: dict[int, BlackBoxHeader] = {}
        while not found and time.monotonic() < deadline and not list(executor.completed(0.05)):
            found = dict(executor.where())
        assert set(found) <= {3}
        assert all(header.trial == 3 and header.step <= 5 for header in found.values())
        executor.cancel()
        assert dict(executor.where()) == {}

    def test_what_is_reported_is_reported_once(self, executor: Executor) -> None:
        """Notices are lines of text for the user, each returned once."""
        executor.submit(self._spec(0))
        self._collect(executor, 1)
        notes = executor.notes()
        assert all(isinstance(note, str) and note.strip() and "\n" not in note for note in notes)
        assert executor.notes() == []

    def test_what_is_kept_has_its_black_box_here(self, executor: Executor, tmp_path: Path) -> None:
        """The black box of a kept trial is on this machine before the result is returned."""
        executor.submit(self._spec(0))
        executor.submit(self._spec(1, fail_at_step=10))
        found = self._collect(executor, 2)
        assert {number: result.kept for number, result in found.items()} == {0: False, 1: True}
        scratch = tmp_path / "scratch"
        assert Recording(read_black_box(scratch_of(scratch, 1) / layout.BLACK_BOX)).steps == found[1].steps

    def test_closing_twice_is_fine(self, patient: Executor) -> None:
        """Closing ends every process, regardless of what it is doing."""
        patient.submit(self._spec(0, hang_at_step=5))
        list(patient.completed(0.5))
        began = time.monotonic()
        patient.close()
        patient.close()
        assert time.monotonic() - began < _WAITS_S, "the executor waits for a trial that hangs"


def _made(make: Make, folder: Path, *, timeout_s: float) -> Iterator[Executor]:
    scratch = folder / "scratch"
    scratch.mkdir()
    scenario = Scenario(
        simulator="toy",
        folder=folder,
        agents={"ego": AgentSetup()},
        arguments={name: ArgumentSetup(default=0) for name in _SWITCHES},
    )
    settings = WorkerSettings(scenario=scenario, oracles=(), crash_on=CRASHES, scratch=scratch, timeout_s=timeout_s)
    made = make(settings, 2)
    yield made
    made.close()
