"""Checks before a hunt, so that a mistake causes one error and not many invalid trials.

They find agents that cannot start, vehicles for ``--ego any`` that never enter, and unknown signals of requirements.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, TypedDict, cast

from crashhunt.base import layout
from crashhunt.base.errors import ArgumentError, CrashhuntError, FormulaError, ScenarioError, SimulatorError, UsageError
from crashhunt.base.exceptions import is_users
from crashhunt.base.isolation import work_apart
from crashhunt.base.reaper import Kept
from crashhunt.base.signals import is_sent_from_outside, stop_requests
from crashhunt.base.temporary import temporary_folder
from crashhunt.base.text import ABSENT_WORDS, PRESENT_WORDS, count_of
from crashhunt.episode import INFO_KEY, SIGNALS, Episode, Parts, TrialSignals, WorkerSettings
from crashhunt.executors import EXCLUDED_WORDS, worker_environment
from crashhunt.hunts._next_trials import spec_of
from crashhunt.oracles import REQUIREMENT
from crashhunt.plans import read_settings, sampler_of
from crashhunt.requirements import parse
from crashhunt.scenario import as_plain_data, scenario_digest
from crashhunt.snapshots import latest_snapshot
from crashhunt.trial import UNUSABLE_VALUE, Constant, Outcome

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from crashhunt.base.json_types import Json, Plain
    from crashhunt.executors import Executor
    from crashhunt.plans import HuntSettings, Request
    from crashhunt.scenario import RunToSurvey, Scenario, SurveyJob
    from crashhunt.trial import TrialResult


_MAX_INVALID_AT_START = 10  # trials; if none of so many could begin, the setup is wrong, not the seed
_ENOUGH_TRIALS = 10
"""Trials after which a hunt reports that a name of the scenario has not occurred; later trials may still correct it."""
_ABSENT_SO_FAR = " names nothing that occurred "
_OF_ANY_VALUES = ("PluginError", "UsageError")  # classes of errors that the values of arguments do not cause
_ENOUGH_CANDIDATES = 4
"""Trials; one that fails by chance would do so as often as this only rarely."""


class Preflight:
    """Holds back the first results of a hunt as long as all of them are the same start-up failure of an agent.

    This check takes no additional time, because it uses the hunt's own first trials. If an argument of the agent
    varies, another value may work, so no result is held back, except for errors that do not depend on values.

    Args:
        settings: settings of the hunt.
        planned: number of planned trials.
        files: for each file that an argument names, its path in the snapshot.
        code: folders of the snapshot from which agents are imported.
        listen: function called before the first result is counted; it may raise an error that ends the hunt.
    """

    def __init__(
        self, settings: HuntSettings, planned: int, *, files: Mapping[str, str] = MappingProxyType({}),
        code: Sequence[str] = (), listen: Callable[[], None] = lambda: None,
    ) -> None:  # fmt: skip
        self._settings = settings
        self._files = {there: here for here, there in files.items()}
        self._ours = tuple(f"{folder}/{layout.PACKAGE.name}/" for folder in code)
        self._enough = min(_ENOUGH_CANDIDATES, planned)
        self._held: list[TrialResult] = []
        self._passed = False
        self._listen = listen

    def filter_setup_failures(self, result: TrialResult) -> list[TrialResult]:
        """Return the results to count: none as long as results are held back, else all held-back results and this one.

        Raises:
            ArgumentError: the agent does not start in any trial.
            ScenarioError: the first trial has a value that crashhunt cannot compare.
        """
        if not self._passed and (error := unusable_value(result)) is not None:
            raise error
        if self._passed or not self._is_of_an_agent(result):
            if not self._passed:
                self._listen()
            self._passed = True
            found, self._held = [*self._held, result], []
            return found
        self._held.append(result)
        if len(self._held) >= self._enough:
            raise self._refusal(result)
        return []

    def _is_of_an_agent(self, result: TrialResult) -> bool:
        failure = result.failure
        if result.outcome is not Outcome.INVALID or failure is None or failure.agent not in self._settings.agents:
            return False
        first = self._held[0].failure if self._held else failure
        same = first is not None and (first.agent, first.kind, first.message) == (
            failure.agent,
            failure.kind,
            failure.message,
        )
        varied = failure.kind not in _OF_ANY_VALUES and any(
            agent == failure.agent and not isinstance(distribution, Constant)
            for (agent, _), distribution in self._settings.space.items()
        )
        return same and not varied

    def _refusal(self, result: TrialResult) -> ArgumentError:
        failure = result.failure
        assert failure is not None
        # The hunt replaces the other paths of the snapshot.
        message, trace = _replaced(failure.message, self._files), _replaced(failure.traceback, self._files)
        kind = "" if failure.kind in ("ValueError", "invalid", *_OF_ANY_VALUES) else f"{failure.kind}: "
        given = result.spec.arguments.get(failure.agent, {})
        # The user may have given an argument or not, so name no option.
        names = ", ".join(f"{name}={value}" for name, value in given.items() if isinstance(value, str))
        frames = re.findall(r'^  File "([^"]+)", line (\d+)', trace, re.MULTILINE)
        places = [frame for frame in frames if not frame[0].startswith((f"{layout.PACKAGE}/", *self._ours))]
        places = [frame for frame in places if is_users(frame[0])] or places
        message, _, fix = message.partition(" Fix: ")  # which crashhunt's own agents name
        usual = f"correct the agent or its arguments {names}" if names else "correct the agent"
        fix = fix.rstrip(".") or usual
        if failure.kind in _OF_ANY_VALUES:
            fix = ""  # which the message contains
        if "pip install" in message:
            fix = "install the package"
        return ArgumentError(
            f"{self._settings.agents[failure.agent].agent} does not start: {kind}{message.rstrip('.')}",
            fix=fix,
            where=":".join(places[-1]) if kind and places else f"agent {failure.agent}",
        )


def _replaced(text: str, names: Mapping[str, str]) -> str:
    for there, here in names.items():
        text = text.replace(there, here)
    return text


class WorkerNotices:
    """Notices of workers, which are read before the first result is recorded, because one may refuse the hunt."""

    def __init__(self, settings: HuntSettings, outcomes: Mapping[str, int]) -> None:
        self._settings = settings
        self._outcomes = outcomes
        self._notes: list[str] = []
        self._absent: dict[str, str] = {}
        self._is_resumed = any(outcomes.values())
        self._settled: set[str] = set()  # conditions that were reported
        self._occurred: set[str] = set()
        self._refuted: set[str] = set()

    def hear(self, executor: Executor) -> None:
        """Read the notices of an executor's workers.

        Raises:
            UsageError: trials cannot be forked, which the first trials show after their first step. If a trial has
                already ended, the hunt continues without forks.
        """
        for note in executor.notes():
            what, left_out, why = note.partition(EXCLUDED_WORDS)
            if left_out and what in ("probes", "branches", "rare") and not sum(self._outcomes.values()):
                raise self._refusal(why)
            condition, is_absent, rest = note.partition(ABSENT_WORDS)
            if is_absent:
                self._absent.setdefault(condition, rest)
            elif note.endswith(PRESENT_WORDS):
                self._occurred.add(note.removesuffix(PRESENT_WORDS))
            else:
                self._notes.append(note)

    def take(self, executor: Executor) -> list[str]:
        """Return the notices that were not returned before.

        Raises:
            UsageError: trials cannot be forked, as for `hear`.
        """
        self.hear(executor)
        notes, self._notes = self._notes, []
        return notes

    def absent(self, *, at_end: bool = False) -> list[str]:
        """Return new notices about conditions of the scenario whose names have not occurred in any trial of the hunt.

        A resumed hunt reports none, because trials of earlier runs may have had the names.

        Args:
            at_end: whether no further trial follows.
        """
        unknown = (Outcome.INVALID, Outcome.HANG, Outcome.PROCESS_DIED)
        count = sum(number for outcome, number in self._outcomes.items() if outcome not in unknown)
        if self._is_resumed or not count or not (at_end or count >= _ENOUGH_TRIALS):
            return []
        new = {name: rest for name, rest in self._absent.items() if name not in self._occurred | self._settled}
        self._settled |= new.keys()
        where = f"in the first {count_of(count, 'trial')}" if count > 1 else "in the first trial"
        return [f"{name}{_ABSENT_SO_FAR}{where}: {rest}" for name, rest in new.items()]

    def newly_occurred(self) -> tuple[str, ...]:
        """Return how the notices of `absent` begin that trials have refuted since the last call."""
        new, self._refuted = self._occurred - self._refuted, set(self._occurred)
        return tuple(f"{name}{_ABSENT_SO_FAR}" for name in new)

    def _refusal(self, why: str) -> UsageError:
        asked = (
            ("--probe", self._settings.probe),
            ("--branch", self._settings.branch),
            ("--rare", self._settings.rare),
        )
        flags = " and ".join(flag for flag, value in asked if value)
        agents = ", ".join(dict.fromkeys(chosen.agent for chosen in self._settings.agents.values()))
        fix = f"correct {agents}, or omit {flags}"
        return UsageError(f"{flags}: trials with {agents} cannot be copied: {why}", fix=fix)


def unusable_value(result: TrialResult) -> ScenarioError | None:
    """Return the error about a value of the user's code that is neither a bool nor a number; None if there is none.

    Whether such a trial has crashed is unknown, so the hunt ends and its crash rule has to be corrected.
    """
    failure = result.failure
    if failure is None or failure.kind != UNUSABLE_VALUE or failure.agent:
        return None
    when = f"step {result.steps + 1} of trial {result.spec.number} (seed {result.spec.seed})"
    message, _, fix = failure.message.rpartition("; ")
    return ScenarioError(message or fix, fix=fix if message else "", where=when)


def is_hopeless(settings: HuntSettings, outcomes: Mapping[str, int]) -> bool:
    """Return whether the hunt should end because many trials failed in their setup and no trial succeeded."""
    enough = min(settings.most_trials, max(_MAX_INVALID_AT_START, 2 * settings.run.parallel))
    invalid = outcomes.get(str(Outcome.INVALID), 0)
    return invalid >= enough and invalid == sum(outcomes.values())


def why_invalid(result: TrialResult, scenario: Scenario) -> str:
    """Return the reason why a trial could not be set up, including the last message of the simulator."""
    explained = scenario.backend.explained
    if explained is not None and result.failure is not None:
        error = explained(result.summary, result.failure.last_output, scenario)
        if error is not None:
            return str(error)
    said = result.failure.last_output.strip().splitlines() if result.failure else []
    last = next((line for line in reversed(said) if line.strip() and not line.startswith("Warning")), "")
    return f"{result.summary}\n  last output: {last}" if last else result.summary


# Before the first trial of ``--ego any``: simulate the plain traffic, to draw among vehicles that enter.

SURVEY_SEEDS = (1, 2)
"""Fixed, so that every hunt in a scenario draws from the same vehicles. With one run, a vehicle of a random flow that
enters by chance would be a candidate."""
MAX_PROCESSOR_TIME_S = 60.0
"""Of all runs. The bound on simulated steps ends a run sooner on all but very large networks."""
MAX_WALL_TIME_S = 600.0
"""After which the process is taken to hang. It is ten times as long, as other processes may keep the machine busy."""
MAX_ATTEMPTS = 3
"""As many processes as simulate the plain traffic while each is killed from outside. The kernel may kill each of them
where memory is short, so the number is bounded."""
POLL_S = 0.02
SURVEY_OUTPUT = "output.log"


class TrafficSurveyor:
    """Replaces the candidates from the route files by the vehicles that really enter in a simulation.

    A candidate is a vehicle that the agent may replace.

    Args:
        directory: directory of the hunt. An existing hunt keeps its candidates.
        overwrite: whether an existing hunt is replaced.
    """

    def __init__(self, directory: Path, *, overwrite: bool) -> None:
        self._directory = directory
        self._overwrite = overwrite

    def __call__(self, scenario: Scenario, request: Request, settings: HuntSettings) -> Scenario:
        """Return the scenario with the vehicles that enter in a simulation as candidates; unchanged without a survey.

        Raises:
            ScenarioError: no trial of the scenario can be valid.
        """
        survey = scenario.backend.survey
        if survey is None or request.ego not in ("", "any") or Path(scenario.file).suffix == ".toml":
            return scenario
        drawn = {setup.replaces for setup in scenario.agents.values() if setup.replaces}
        if drawn & {name.removeprefix("scenario.") for name in request.scenario_arguments or ()}:
            return scenario  # the user has chosen
        if not self._overwrite and (self._directory / layout.HUNT).exists():
            kept = self._stored_survey()
            restored = survey.restore(scenario, kept) if kept is not None else None
            if restored is not None:
                return restored
        try:
            answer = _survey_despite_kills(scenario, _runs(settings, drawn))
        except (SimulatorError, OSError) as error:
            # The hunt continues: if SUMO refuses its input, the first trial reports file and line.
            why = f"the survey cannot run: {error}" if isinstance(error, OSError) else str(error)
            note = f"warning: candidates are the vehicles that the route files list, entering or not: {why}"
            return replace(scenario, notes=(scenario.notes[0], note, *scenario.notes[1:]))
        refined = survey.refine(scenario, answer)
        if self._has_begun_with(settings) and scenario_digest(refined) != settings.scenario_digest:
            return scenario
        return refined

    def _has_begun_with(self, settings: HuntSettings) -> bool:
        """Return whether the existing hunt uses the candidates from the route files, because its survey failed."""
        if self._overwrite:
            return False
        with suppress(CrashhuntError, OSError):
            return read_settings(self._directory / layout.HUNT).scenario_digest == settings.scenario_digest
        return False

    def _stored_survey(self) -> Scenario | None:
        with suppress(CrashhuntError, OSError):
            snapshot = latest_snapshot(self._directory)
            return snapshot.scenario if snapshot is not None else None
        return None


def _runs(settings: HuntSettings, drawn: set[str]) -> list[RunToSurvey]:
    """Return two runs: all scenario arguments at the low ends of their ranges, and all at the high ends."""
    shares = [index / (len(SURVEY_SEEDS) - 1) for index in range(len(SURVEY_SEEDS))]
    return [
        {
            "seed": seed,
            "values": {
                name: spec.distribution.quantile(share)
                for name, spec in settings.scenario_arguments.items()
                if name not in drawn
            },
        }
        for seed, share in zip(SURVEY_SEEDS, shares, strict=True)
    ]


class _SurveyKilledError(SimulatorError):
    """Another process or the kernel killed the process that simulates the unmodified traffic."""


def _survey_despite_kills(scenario: Scenario, runs: list[RunToSurvey]) -> Json:
    """Return the completed runs of a process; if it is killed from outside, another process is started.

    Raises:
        SimulatorError: the process failed or took too long, or every process was killed.
    """
    for _ in range(MAX_ATTEMPTS - 1):
        with suppress(_SurveyKilledError):
            return _survey(scenario, runs)
    return _survey(scenario, runs)


def _survey(scenario: Scenario, runs: list[RunToSurvey]) -> Json:
    """Return the completed runs of one process.

    Raises:
        _SurveyKilledError: the process was killed from outside.
        SimulatorError: the process failed or took too long.
    """
    survey = scenario.backend.survey
    assert survey is not None
    number = 0
    with temporary_folder("survey") as folder, stop_requests() as stops:
        answer = folder / layout.ANSWER
        job: SurveyJob = {
            "scenario": as_plain_data(scenario),
            "folder": str(scenario.folder.resolve()),
            "stage": str(folder / "stage"),
            "answer": str(answer),
            "processor_time_limit_s": MAX_PROCESSOR_TIME_S,
            "runs": runs,
        }
        (folder / layout.JOB).write_text(json.dumps(job), encoding="utf-8")
        with (folder / SURVEY_OUTPUT).open("wb") as log:
            kept = Kept(
                survey.module,
                [str(folder / layout.JOB)],
                environment={**os.environ, **worker_environment()},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
        deadline = time.monotonic() + MAX_WALL_TIME_S
        try:
            while kept.process.poll() is None and not stops and time.monotonic() < deadline:
                time.sleep(POLL_S)
        finally:
            kept.end()
        if stops:
            number = stops[0]
        elif answer.exists():
            found: Json = json.loads(answer.read_text(encoding="utf-8"))
            return found
        elif time.monotonic() >= deadline:
            raise SimulatorError(
                f"the simulation of the traffic without agents took more than {MAX_WALL_TIME_S:g} s of wall time"
            )
        else:
            said = (folder / SURVEY_OUTPUT).read_text(encoding="utf-8", errors="replace").strip().splitlines()
            errors = (
                [line for line in said if line.startswith("Error")] or said or [_describe_end(kept.process.returncode)]
            )
            kind = _SurveyKilledError if is_sent_from_outside(kept.process.returncode) else SimulatorError
            raise kind(f"the simulation of the traffic without agents failed: {errors[-1].strip()}")
    # The process and its folder are gone: the signal goes to the handler that was there before.
    signal.raise_signal(number)
    raise KeyboardInterrupt


def _describe_end(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"exit code {code}"


# The signals that requirements may name, read in a trial of one step.

_MAX_IMPORT_S = 60.0


class SignalEntry(TypedDict):
    """A signal that requirements may name."""

    name: str
    unit: str
    meaning: str


class SignalList(TypedDict):
    """The signals of a scenario."""

    scenario: str
    step_length_s: float
    agents: list[str]
    signals: list[SignalEntry]


def list_signals(scenario: Scenario, settings: HuntSettings) -> SignalList:
    """Return the signals of the first agent of a scenario, after the first step of a trial.

    Raises:
        ScenarioError: the trial cannot be set up.
    """

    def look(episode: Episode) -> Plain:
        episode.step()
        signals = TrialSignals(episode)
        found: list[SignalEntry] = [
            {"name": name, "unit": unit, "meaning": signals.meaning(name)}
            for name, unit in signals.known(episode.names[0]).items()
        ]
        return {
            "scenario": scenario.name, "step_length_s": signals.step_length_s, "agents": list(episode.names),
            "signals": found,
        }  # fmt: skip

    return cast("SignalList", _in_first_trial(look, scenario, settings))


def require_known_signals(scenario: Scenario, settings: HuntSettings) -> None:
    """Check before the first trial that the requirements of a hunt name known signals.

    Without traffic events, only the environment's code knows the signals, and the first trial checks them. A step runs
    only if a name is not one that scenes have.

    Raises:
        FormulaError: a signal is unknown; the error names the most similar one.
    """
    texts = [
        oracle.partition(":")[2].partition("=") for oracle in settings.oracles if oracle.startswith(f"{REQUIREMENT}:")
    ]
    if not texts or not scenario.backend.reported_events:
        return
    # Only some simulators know the speed limit, so the episode has to be asked for it.
    usual = {*SIGNALS, *scenario.backend.reported_events} - {"speed_limit"}
    requirements = {title: parse(formula) for title, _, formula in texts}
    named = {name for requirement in requirements.values() for name in requirement.signals}
    rest = {name for name in named if name not in usual and not name.startswith("observation[")}
    if not rest:
        return

    def look(episode: Episode) -> Plain:
        signals = TrialSignals(episode)
        plain = {name for agent in episode.names for name in signals.known(agent)}
        episode.step()
        plain |= {name for agent in episode.names for name in signals.known(agent)}
        plain |= {f"info.{name}" for name in plain if signals.meaning(name) == INFO_KEY}
        return dict.fromkeys([*plain, *(f"{agent}.{name}" for agent in episode.names for name in plain)])

    try:
        known = {*_in_first_trial(look, scenario, settings), *(named - rest)}
    except CrashhuntError:
        return  # the first trial reports it
    for title, requirement in requirements.items():
        try:
            requirement.require_known(known)
        except FormulaError as error:
            error.where = f"requirement {title}" if title != REQUIREMENT else title
            raise


def _in_first_trial(look: Callable[[Episode], Plain], scenario: Scenario, settings: HuntSettings) -> Plain:
    """Return what a function reads, in a process of its own, in the first trial of a hunt before its first step."""
    spec = spec_of(0, settings, sampler_of(settings))

    def work(_: object) -> Plain:
        with temporary_folder("signals") as scratch:
            parts = Parts(WorkerSettings(scenario=scenario, oracles=(), crash_on=(), scratch=scratch))
            parts.load()
            simulator = parts.simulator()
            with Episode(spec, simulator=simulator, make_agent=parts.agent) as episode:
                result = episode.start()
                if result is not None:
                    raise ScenarioError(f"the trial cannot be set up: {result.summary}", where=scenario.origin)
                found = look(episode)
            simulator.close()
            return found

    task = "the signals cannot be read"
    return work_apart(work, task=task, timeout_s=_MAX_IMPORT_S + settings.run.timeout_s)
