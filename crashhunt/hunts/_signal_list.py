"""The signals that requirements may name in a scenario, read in a trial of one step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypedDict, cast

from crashhunt.base.errors import ScenarioError
from crashhunt.base.isolation import work_apart
from crashhunt.base.temporary import temporary_folder
from crashhunt.episode import Episode, Parts, TrialSignals, WorkerSettings
from crashhunt.hunts._trial_seeds import spec_of
from crashhunt.plans import sampler_of

if TYPE_CHECKING:
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
    spec = spec_of(0, settings, sampler_of(settings))

    def look(_: object) -> Plain:
        with temporary_folder("signals") as scratch:
            parts = Parts(WorkerSettings(scenario=scenario, oracles=(), crash_on=(), scratch=scratch))
            parts.load()
            simulator = parts.simulator()
            with Episode(spec, simulator=simulator, make_agent=parts.agent) as episode:
                result = episode.start()
                if result is not None:
                    raise ScenarioError(f"the trial cannot be set up: {result.summary}", where=scenario.origin)
                episode.step()
                signals = TrialSignals(episode)
                found: list[SignalEntry] = [
                    {"name": name, "unit": unit, "meaning": signals.meaning(name)}
                    for name, unit in signals.known(episode.names[0]).items()
                ]
                agents = list(episode.names)
            simulator.close()
            return {
                "scenario": scenario.name, "step_length_s": simulator.step_length_s, "agents": agents,
                "signals": found,
            }  # fmt: skip

    task = "the signals cannot be read"
    read: Any = work_apart(look, task=task, timeout_s=_MAX_IMPORT_S + settings.run.timeout_s)
    return cast("SignalList", read)
