"""The signals that requirements may name in a scenario, read in a trial of one step."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypedDict, cast

from crashhunt.base.errors import CrashhuntError, FormulaError, ScenarioError
from crashhunt.base.isolation import work_apart
from crashhunt.base.temporary import temporary_folder
from crashhunt.episode import INFO_KEY, SIGNALS, Episode, Parts, TrialSignals, WorkerSettings
from crashhunt.hunts._next_trials import spec_of
from crashhunt.oracles import REQUIREMENT
from crashhunt.plans import sampler_of
from crashhunt.requirements import parse

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.base.json_types import Plain
    from crashhunt.plans import HuntSettings
    from crashhunt.scenario import Scenario

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

    Args:
        scenario: the scenario.
        settings: the settings of a hunt in the scenario.

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

    Args:
        scenario: the scenario.
        settings: the settings of a hunt in the scenario.

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
