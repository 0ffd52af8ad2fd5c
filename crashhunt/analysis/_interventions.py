"""Interventions: changes of the trial of a crash before the trial runs again.

An intervention is a value with one method, `applied`, which returns the run with the change. An intervention that
begins at a step leaves everything before this step as recorded, and the engine verifies this. The property `from_step`
is None for an intervention that holds from the start.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol, get_args

from crashhunt.base import layout
from crashhunt.base.errors import ArgumentError, UsageError
from crashhunt.base.text import one_of
from crashhunt.plans import Owners, agent_of, takes_of
from crashhunt.trial import SENSOR_KINDS, Constant, Handover, Manoeuvre, Overruled, in_turn, parse_spec

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from crashhunt.crashes import Bundle
    from crashhunt.replays import Rerun
    from crashhunt.trial import Disturbance, Value


_FACULTIES = {"reference_speed": "longitudinal", "reference_lanes": "lateral", "reference": "both"}


class Intervention(Protocol):
    """A change of a trial."""

    @property
    def from_step(self) -> int | None:
        """The last step that stays as recorded; None if the change holds from the start."""

    def applied(self, rerun: Rerun) -> Rerun:
        """Return the run with the change.

        Raises:
            UsageError: the change is not possible in this trial.
        """

    def __str__(self) -> str:
        """Return a description of the change."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SetArguments:
    """Other values of arguments and disturbances from the start, as with ``replay --set``."""

    # new value by name, ``NAME`` or ``AGENT.NAME``. The engine passes the values to `prepare`, which checks them.
    changes: Mapping[str, str]

    @property
    def from_step(self) -> None:
        """Always None, because the change holds from the start of the trial."""

    def applied(self, rerun: Rerun) -> Rerun:
        """Return the run unchanged, because `prepare` has already made the change."""
        return rerun

    def __str__(self) -> str:
        return ", ".join(f"{name}={value}" for name, value in self.changes.items())


@dataclass(frozen=True, slots=True, kw_only=True)
class Disturb:
    """Disturbances in addition to those of the trial."""

    disturbances: tuple[Disturbance, ...]  # the disturbances; at least one

    @property
    def from_step(self) -> int:
        """The step before the first disturbance; disturbances of an observation take effect one step earlier."""
        return max(0, min(one.step - (2 if one.what in SENSOR_KINDS else 1) for one in self.disturbances))

    def applied(self, rerun: Rerun) -> Rerun:
        """Return the run with the disturbances."""
        spec = rerun.spec
        return replace(rerun, spec=replace(spec, disturbances=in_turn([*spec.disturbances, *self.disturbances])))

    def __str__(self) -> str:
        return ", ".join(f"{one.agent}: {one.what} in step {one.step}" for one in self.disturbances)


@dataclass(frozen=True, slots=True, kw_only=True)
class Overrule:
    """An agent that is overruled: its actions are replaced."""

    from_step: int  # the last step that stays as recorded
    # the manoeuvre: ``brake`` as hard as the vehicle can, change lanes to the ``left`` or ``right`` and brake, or
    # ``keep_lane`` or ``keep_speed``. With ``reference_speed``, ``reference_lanes`` or ``reference``, a reference
    # driver corrects unsafe speeds, unsafe lane changes, or both.
    manoeuvre: Manoeuvre = "brake"
    agent: str = ""  # id of the agent; empty for the only agent

    def applied(self, rerun: Rerun) -> Rerun:
        """Return the run with the agent overruled."""
        if self.manoeuvre not in get_args(Manoeuvre):
            raise UsageError(f"manoeuvre is {self.manoeuvre!r}", fix=one_of(self.manoeuvre, get_args(Manoeuvre)))
        agent = _agent_of(self.agent, rerun)
        if faculty := _FACULTIES.get(self.manoeuvre):
            overruled = Overruled(agent, self.from_step, reference=faculty)
            return replace(rerun, spec=replace(rerun.spec, overruled=overruled))
        verb, _, kept = self.manoeuvre.partition("_")
        overruled = Overruled(agent, self.from_step, keeps=kept) if kept else Overruled(agent, self.from_step, verb)
        return replace(rerun, spec=replace(rerun.spec, overruled=overruled))

    def __str__(self) -> str:
        return f"{self.agent or 'the agent'} is overruled after step {self.from_step}: {self.manoeuvre}"


@dataclass(frozen=True, slots=True, kw_only=True)
class LeaveOut:
    """Actors that are excluded from the start."""

    actors: tuple[str, ...]

    @property
    def from_step(self) -> None:
        """Always None, because the change holds from the start of the trial."""

    def applied(self, rerun: Rerun) -> Rerun:
        """Return the run unchanged; the engine excludes the actors after it has determined which actors enter."""
        return rerun

    def taking_part(self, entered: tuple[str, ...], agents: Collection[str]) -> tuple[str, ...]:
        """Return the actors that remain.

        Agents always take part.

        Raises:
            UsageError: an actor to exclude is not among the actors that entered, or is an agent.
        """
        others = [name for name in entered if name not in agents]
        for actor in self.actors:
            if actor not in others:
                fix = one_of(actor, others) if others else "omit --leave-out, because no actor can be excluded"
                why = "agents always take part" if actor in agents else "there is no such actor"
                raise UsageError(f"--leave-out {actor!r}: {why}", fix=fix)
        return tuple(name for name in entered if name not in self.actors)

    def __str__(self) -> str:
        return f"without {', '.join(self.actors)}"


@dataclass(frozen=True, slots=True, kw_only=True)
class HandOver:
    """Another agent, or the same agent with other arguments, that takes control at a step.

    Up to this step, the recorded actions are repeated, and no code of the agent runs. Then the new agent is reset with
    the seed of the trial. The first observation that the new agent receives is the observation after this step.
    """

    from_step: int  # number of recorded actions to repeat
    driver: str = ""  # the new agent, as ``module:Name``; empty for the recorded agent
    # arguments of the new agent. For the recorded agent, all other arguments keep their recorded values.
    arguments: Mapping[str, str] = field(default_factory=dict)
    agent: str = ""  # id of the vehicle; empty for the only controlled vehicle
    option: str = "--arg"  # option with which the user gave the arguments, for error messages

    def applied(self, rerun: Rerun) -> Rerun:
        """Return the run in which the new agent takes control."""
        agent = _agent_of(self.agent, rerun)
        was = rerun.worker.scenario.agents[agent].agent
        driver = self.driver or was
        given: dict[str, Value] = dict(rerun.spec.arguments.get(agent, {})) if driver == was else {}
        if self.arguments:
            owners = Owners({agent: takes_of(driver, rerun.worker.code)})
            for word, text in self.arguments.items():
                owner = owners.of(word, option=self.option)
                if owner is None:
                    raise owners.unknown(word, option=self.option, whose=driver)
                given[owner[1]] = _parse_value(self.option, word, text)
        worker = replace(rerun.worker, scenario=rerun.worker.scenario.with_agents({agent: driver}))
        log = str((rerun.bundle.path / layout.LOG).resolve())
        spec = replace(
            rerun.spec,
            arguments={**rerun.spec.arguments, agent: given},
            handover=Handover(agent, self.from_step, log),
        )
        return replace(rerun, spec=spec, worker=worker)

    def __str__(self) -> str:
        given = " and ".join(f"{name}={value}" for name, value in self.arguments.items())
        who = f"{self.driver or 'the recorded agent'} takes over after step {self.from_step}"
        return f"{who}, with {given}" if given else who


@dataclass(frozen=True, slots=True, kw_only=True)
class Reseed:
    """Other seeds of the simulator's random generators after a step; each run has a different seed."""

    from_step: int  # the last step whose random numbers come from the seed of the trial

    def applied(self, rerun: Rerun) -> Rerun:
        """Return the run unchanged, because the engine gives each run its seed."""
        return rerun

    def __str__(self) -> str:
        return f"the simulator's generators have another seed in each run, after step {self.from_step}"


def step_before(bundle: Bundle, seconds: float) -> int:
    """Return the last step that is at least the given time before the end of a crash.

    Raises:
        UsageError: the time lies before the start, or not before the crash.
    """
    length_s, steps = bundle.recording().prologue.step_length_s, bundle.result.steps
    step = steps - math.ceil(seconds / length_s - 1e-6) if 0 < seconds < 1e9 else -1
    if not 0 <= step < steps:
        allowed = f"give {length_s:g} to {steps * length_s:g}"
        raise UsageError(f"--before is {seconds:g}, but the trial lasts only {steps * length_s:g} s", fix=allowed)
    return step


def _agent_of(name: str, rerun: Rerun) -> str:
    agents = tuple(rerun.worker.scenario.agents)
    if name:
        if name not in agents:
            raise UsageError(f"there is no agent {name!r}", fix=one_of(name, agents))
        return name
    if len(agents) > 1:
        raise UsageError("the crash has several agents", fix=f"name one of {', '.join(agents)}, as in {agents[0]}=…")
    return agents[0]


def _parse_value(option: str, name: str, text: str) -> Value:
    distribution = parse_spec(text, None, where=f"{option} {name}")
    if not isinstance(distribution, Constant):
        raise ArgumentError(f"{option} {name}: {text!r} is not a single value", fix="give one value")
    return distribution.value


def interventions_of(
    bundle: Bundle,
    *,
    changes: Mapping[str, str],
    from_step: int | None = None,
    before_s: float | None = None,
    agent: str = "",
    arguments: Mapping[str, str] | None = None,
    futures: bool = False,
    overrule: str = "",
    leave_out: tuple[str, ...] = (),
    code: str | None = None,
    more: tuple[Intervention, ...] = (),
) -> list[Intervention]:
    """Return the interventions that the options of ``crashhunt whatif`` request.

    The arguments are those of `crashhunt.what_if`. ``more`` has further interventions, which no option can express.

    Raises:
        UsageError: the options contradict each other, or nothing would change at the step.
    """
    step = step_before(bundle, before_s) if before_s is not None else from_step
    option = "--before" if before_s is not None else "--from-step"
    if arguments and not agent:
        raise UsageError(
            f"--arg {next(iter(arguments))} has no effect without --agent",
            fix="give --agent, or --set instead of --arg",
        )
    if futures and step is None:
        raise UsageError("--futures needs a step", fix="give --from-step K or --before SECONDS")
    if overrule and step is None:
        raise UsageError(f"--overrule {overrule} needs a step", fix="give --from-step K or --before SECONDS")
    if agent and changes:
        raise UsageError("--set and --agent contradict each other", fix="give the agent's arguments by --arg")
    found: list[Intervention] = [*more]
    vehicle, equals, driver = agent.partition("=") if "=" in agent else ("", "", agent)
    if equals and not (vehicle and driver):
        raise UsageError(
            f"--agent {agent!r} is not of the form MODULE:NAME",
            fix="write --agent MODULE:NAME or --agent ID=MODULE:NAME",
        )
    if agent:
        found.append(HandOver(from_step=step or 0, driver=driver, arguments=arguments or {}, agent=vehicle))
    elif step is not None and (changes or code == "current"):
        found.append(_handover_to_same(bundle, step, changes, option))
    elif changes:
        found.append(SetArguments(changes=changes))
    if overrule:
        assert step is not None
        found.append(_overrule_of(overrule, step))
    if leave_out:
        found.append(LeaveOut(actors=leave_out))
    if futures:
        assert step is not None
        found.append(Reseed(from_step=step))
    if step is not None and not found:
        raise UsageError(f"{option} is given without a change", fix="also give --futures, --agent or --set")
    return found


def _overrule_of(text: str, step: int) -> Overrule:
    """Return the intervention of ``HOW`` or ``ID=HOW``."""
    agent, _, how = text.rpartition("=")
    if how not in get_args(Manoeuvre):
        raise UsageError(f"--overrule {text!r} is no manoeuvre", fix=one_of(how, get_args(Manoeuvre)))
    return Overrule(from_step=step, manoeuvre=how, agent=agent)  # type: ignore[arg-type]


def _handover_to_same(bundle: Bundle, step: int, changes: Mapping[str, str], option: str) -> HandOver:
    """Return a hand-over to the recorded agent with other arguments."""
    agents = tuple(bundle.result.spec.arguments)
    vehicles = {agent_of(name, agents) for name in changes} - {""}
    if len(vehicles) > 1:
        raise UsageError(
            f"--set names several agents: {', '.join(sorted(vehicles))}", fix="give values for one agent at a time"
        )
    odd = next((name for name in changes if name in bundle.result.spec.scenario_arguments), "")
    if odd:
        message = f"--set {odd} is an argument of the scenario, which cannot change during the trial"
        raise UsageError(message, fix=f"omit {option}")
    vehicle = next(iter(vehicles), "")
    named = {name.removeprefix(f"{vehicle}.") if vehicle else name: value for name, value in changes.items()}
    return HandOver(from_step=step, arguments=named, agent=vehicle, option="--set")
