"""From simulated plain traffic to the vehicles that ``--ego any`` draws from."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, TypedDict, cast

from crashhunt.base.errors import NoValidTrialError, ScenarioError
from crashhunt.scenario._tables import AgentSetup
from crashhunt.scenario.backends.sumo._ego import EGO_VEHICLE, NOT_GIVEN, Departure, draw_among

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.base.plain import Json
    from crashhunt.scenario._scenario import Scenario

__all__ = ["NOT_ON_A_ROAD", "SurveyedRun", "refine", "restore"]

NOT_ON_A_ROAD = frozenset(
    {
        *("tram", "rail_urban", "rail", "rail_electric", "rail_fast", "subway", "cable_car"),
        *("ship", "container", "aircraft", "drone"),
        *("pedestrian", "wheelchair", "bicycle", "scooter"),
    }
)
"""SUMO's vehicle classes that an agent for cars cannot drive: on rails, on water, in the air, or no motor vehicles."""
RAIL = frozenset({"tram", "rail_urban", "rail", "rail_electric", "rail_fast", "subway", "cable_car"})
FEW_CANDIDATES = 3
"""Below this the window of entry times is extended to all entries, so that trials differ."""
GRIDLOCK_BUILDS_UP_S = 60.0
"""Before a gridlock, the seed decides whether a vehicle finds room to enter: in SUMO's game bs3d, 5 of 60 trials were
invalid, whose vehicles entered up to 40 s before it. With this margin, 1 of 60 was."""
LONG_WAIT_S = 300.0
"""A wait for the first vehicle that is worth a warning: every trial simulates it."""


class Gridlock(TypedDict):
    """A traffic jam that does not move: ``standing`` of ``vehicles`` since ``since_s``, to the end of the run."""

    since_s: float
    standing: int
    vehicles: int


class SurveyedRun(TypedDict):
    """One run of the plain traffic; an entry is vehicle, time in s, vehicle class, whether it is parked."""

    begin_s: float
    end_s: float
    steps: int
    entries: list[tuple[str, float, str, bool]]
    gridlock: Gridlock | None
    cut_short: bool


def refine(scenario: Scenario, answer: Json) -> Scenario:
    """Return the scenario with the vehicles that entered in every run as candidates, and with notes on the traffic.

    Args:
        scenario: of a ``.sumocfg``, with the candidates that its route files promise.
        answer: the runs, at least one, as `SurveyedRun`.

    Raises:
        ScenarioError: every vehicle that enters is one that an agent cannot drive.
        NoValidTrialError: no vehicle enters.
    """
    runs = cast("list[SurveyedRun]", answer)
    known = _entering(runs)
    (agent,) = scenario.agents
    setup = scenario.agents[agent]
    if not known and any(run["cut_short"] for run in runs):
        steps = max(run["steps"] for run in runs)
        note = f"warning: no vehicle that an agent can drive enters before step {steps}, where the look ahead ended"
        return replace(scenario, notes=(scenario.notes[0], note, *scenario.notes[1:]))
    if not known:
        _refuse_undrivable(scenario, runs)
        if setup.route:
            return scenario  # no vehicle enters, and the controlled one is added
        raise _nobody_enters(scenario, runs)
    notes = _warnings(scenario, runs, known)
    if setup.existing and any(one.vehicle == agent for one in known):
        return replace(scenario, notes=(scenario.notes[0], *notes, *scenario.notes[1:]))
    stuck_s = min((run["gridlock"]["since_s"] for run in runs if run["gridlock"]), default=None)
    kept = agent if setup.replaces else ""
    drawn = draw_among(_before(stuck_s, known), few=FEW_CANDIDATES, keep_agent=kept, why=_why(scenario))
    return replace(
        scenario,
        agents={drawn.agent: drawn.setup},
        arguments={
            **{name: argument for name, argument in scenario.arguments.items() if name != EGO_VEHICLE},
            **drawn.arguments,
        },
        notes=(drawn.note, *notes, *scenario.notes[1:]),
    )


def restore(scenario: Scenario, kept: Scenario) -> Scenario | None:
    """Return the scenario with the candidates of the hunt that kept ``kept``; None where that hunt drew none."""
    agent, *others = kept.agents
    before = kept.agents[agent]
    if others or before.replaces != EGO_VEHICLE or EGO_VEHICLE not in kept.arguments:
        return None
    argument = kept.arguments[EGO_VEHICLE]
    count = argument.range.count("|") + 1
    return replace(
        scenario,
        agents={agent: AgentSetup(replaces=EGO_VEHICLE, depart_s=before.depart_s)},
        arguments={**scenario.arguments, EGO_VEHICLE: argument},
        notes=(f"{_why(scenario)}each trial replaces one of the {count} candidates of this hunt", *scenario.notes[1:]),
    )


def _why(scenario: Scenario) -> str:
    return NOT_GIVEN if scenario.notes[0].startswith(NOT_GIVEN) else ""


def _entering(runs: Sequence[SurveyedRun]) -> list[Departure]:
    """Return the drivable vehicles that entered in every run, by the latest time at which they did.

    A run that was cut short says nothing about what enters later. Where no vehicle entered in every run, those of the
    run with the most entries are returned: a demand scaled to 0 at one end of a range is no reason to refuse.
    """
    found: list[dict[str, float]] = []
    for run in runs:
        usable = [one for one in run["entries"] if one[2] not in NOT_ON_A_ROAD and not one[3]]
        found.append({vehicle: time_s for vehicle, time_s, _, _ in usable})
    first = found[0]
    in_every_run = (vehicle for vehicle in first if all(vehicle in run for run in found))
    times = {vehicle: max(run[vehicle] for run in found) for vehicle in in_every_run}
    if not times:
        times = max(found, key=len)
    return sorted((Departure(vehicle, time_s, off_road=False) for vehicle, time_s in times.items()), key=_by_time)


def _before(stuck_s: float | None, known: list[Departure]) -> list[Departure]:
    """Return the vehicles that enter before a gridlock, and where there are enough, before it builds up."""
    if stuck_s is None:
        return known
    early = [one for one in known if one.depart_s < stuck_s - GRIDLOCK_BUILDS_UP_S]
    return early if len(early) >= FEW_CANDIDATES else [one for one in known if one.depart_s < stuck_s] or known


def _by_time(one: Departure) -> float:
    return one.depart_s  # sorting is stable: vehicles of one step stay in SUMO's order


def _refuse_undrivable(scenario: Scenario, runs: Sequence[SurveyedRun]) -> None:
    classes = Counter(vehicle_class for run in runs for _, _, vehicle_class, _ in run["entries"])
    if not classes:
        return
    simulated_s = max(run["end_s"] - run["begin_s"] for run in runs)
    kind = "only rail vehicles enter" if classes.keys() <= RAIL else "no vehicle that an agent can drive enters"
    if classes.keys() - NOT_ON_A_ROAD:
        kind = "only parked vehicles enter"
    shown = ", ".join(sorted(classes))
    raise ScenarioError(
        f"{kind} in {simulated_s:g} s of simulation (vehicle classes: {shown})",
        fix="name a vehicle with --ego VEHICLE, add one with --ego edges=FROM,TO, or add road traffic",
        where=scenario.origin,
    )


def _nobody_enters(scenario: Scenario, runs: Sequence[SurveyedRun]) -> NoValidTrialError:
    longest = max(runs, key=lambda run: run["steps"])
    return NoValidTrialError(
        f"no vehicle enters in {longest['end_s'] - longest['begin_s']:g} s of simulation "
        f"({longest['steps']} steps from {longest['begin_s']:g} s)",
        fix="set begin in the configuration shortly before the first departure, or raise --set scale",
        where=scenario.origin,
    )


def _warnings(scenario: Scenario, runs: Sequence[SurveyedRun], known: Sequence[Departure]) -> list[str]:
    notes = []
    begin_s, first_s = runs[0]["begin_s"], known[0].depart_s
    if first_s - begin_s > LONG_WAIT_S:
        steps = round((first_s - begin_s) / scenario.step_length_s)
        notes.append(
            f"warning: no vehicle enters before step {steps} ({first_s:g} s), and every trial simulates these steps. "
            f"Fix: set begin to {max(begin_s, first_s - 1.0):g} in {scenario.file}"
        )
    jammed = [run["gridlock"] for run in runs if run["gridlock"]]
    if jammed:
        jam = min(jammed, key=lambda one: one["since_s"])
        notes.append(
            f"warning: the traffic is gridlocked from {jam['since_s']:g} s on: {jam['standing']} of {jam['vehicles']} "
            f"vehicles stand still, in {len(jammed)} of {len(runs)} runs. "
            "Fix: lower the demand (--set scale=0.5), or correct the traffic lights"
        )
    return notes
