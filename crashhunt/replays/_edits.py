"""A recorded trial with something changed on purpose: by hand in ``hunt.toml``, or on the command line."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from crashhunt.base.errors import ArgumentError
from crashhunt.plans import Owners, Takes, takes_of
from crashhunt.replays._disturbances import NAME, edited_disturbances, is_about_disturbances, with_other_words
from crashhunt.trial import Constant, Value, parse_spec

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.plans import ArgumentSpec, HuntSettings
    from crashhunt.trial import TrialSpec

__all__ = ["Edits", "edited_spec"]

Values = dict[tuple[str, str], Value]  # (agent, or empty for the scenario; name) to value


@dataclass(frozen=True, slots=True)
class Edits:
    """What is not as it was recorded, in words.

    Args:
        agents: who drives, and with which arguments.
        others: everything else: traffic, length, what counts. If a crash does not come again, that may be why.
        ignored: what is written otherwise in ``hunt.toml`` and makes no difference to a replay.
    """

    agents: tuple[str, ...] = ()
    others: tuple[str, ...] = ()
    ignored: tuple[str, ...] = ()

    @property
    def all(self) -> tuple[str, ...]:
        """What makes it another trial."""
        return (*self.agents, *self.others)


def edited_spec(
    recorded: TrialSpec,
    settings: HuntSettings,
    original: HuntSettings,
    changes: Mapping[str, str],
    *,
    code: Sequence[str] | None = None,
) -> tuple[TrialSpec, Edits]:
    """Return the trial as it is to be replayed, and what is not as it was recorded.

    Args:
        recorded: the trial.
        settings: ``hunt.toml`` as it is now.
        original: ``hunt.toml`` as it was when the trial ran.
        changes: ``NAME`` or ``AGENT.NAME`` to value, applied last.
        code: the folders of the code that is to drive, which is asked what an agent takes where the record is silent;
            None where none of it may run.

    Raises:
        ArgumentError: an argument does not exist, or a range is given where it takes one value.
    """
    agents: list[str] = []
    others: list[str] = []
    values: Values = {}
    before, after = _specs(original), _specs(settings)
    for key in sorted(before.keys() | after.keys()):
        spec = after.get(key)
        if spec is not None and spec != before.get(key):
            values[key] = _constant(spec.spec, spec, f"hunt.toml, {_name(key)}")
    for agent, chosen in settings.agents.items():
        if agent in original.agents and chosen.agent != original.agents[agent].agent:
            agents.append(f"agents.{agent}.agent was {original.agents[agent].agent} and is {chosen.agent}")
    for name in ("max_steps", "crash_on", "events", "oracles"):
        before_it, now = getattr(original, name), getattr(settings, name)
        if before_it != now:
            longer = name == "max_steps" and now > before_it  # which leaves nothing out
            (agents if longer else others).append(f"{name} was {_plain(before_it)} and is {_plain(now)}")
    vehicles = tuple(recorded.arguments) or tuple(settings.agents)
    disturbances, said, unheard = with_other_words(recorded.disturbances, original.disturb, settings.disturb, vehicles)
    others += said
    for name, text in changes.items():
        if is_about_disturbances(name) and name not in recorded.scenario_arguments:
            disturbances, said = edited_disturbances(disturbances, name, text, vehicles)
            others += said
            continue
        key = _find(name, recorded, settings, code)
        values[key] = _constant(text, after.get(key), f"--set {name}")
    arguments = {agent: dict(given) for agent, given in recorded.arguments.items()}
    scenario_arguments = dict(recorded.scenario_arguments)
    for (agent, name), value in values.items():
        target = arguments.setdefault(agent, {}) if agent else scenario_arguments
        if name not in target or target[name] != value:
            (agents if agent else others).append(
                f"{_name((agent, name))} was {target.get(name, '(not there)')} and is {value}"
            )
            target[name] = value
    max_steps = settings.max_steps if settings.max_steps != original.max_steps else recorded.max_steps
    trial = replace(
        recorded,
        arguments=arguments,
        scenario_arguments=scenario_arguments,
        max_steps=max_steps,
        disturbances=disturbances,
    )
    kept = [
        f"{name} was {_plain(was)} and is {_plain(now)} in hunt.toml; a replay keeps that of the recorded trial"
        for name in ("seed", "scenario")
        if (was := getattr(original, name)) != (now := getattr(settings, name))
    ]
    late = next((one for one in disturbances if one.step > max_steps and one not in recorded.disturbances), None)
    if late is not None:
        fix = f"give a step up to {max_steps}"
        raise ArgumentError(f"{NAME}: {late.what}@{late.step} is never, as the trial has {max_steps} steps", fix=fix)
    return trial, Edits(tuple(agents), tuple(others), (*kept, *unheard))


def _specs(settings: HuntSettings) -> dict[tuple[str, str], ArgumentSpec]:
    found = {("", name): spec for name, spec in settings.scenario_arguments.items()}
    for agent, chosen in settings.agents.items():
        found |= {(agent, name): spec for name, spec in chosen.arguments.items()}
    return found


def _constant(text: str, spec: ArgumentSpec | None, where: str) -> Value:
    distribution = parse_spec(text, spec.kind if spec else None, where=where)
    if not isinstance(distribution, Constant):
        raise ArgumentError(f"{where}: {text!r} is not one value, and a replay needs one", fix="give a value")
    return distribution.value


def _find(name: str, recorded: TrialSpec, settings: HuntSettings, code: Sequence[str] | None) -> tuple[str, str]:
    specs = _specs(settings)
    agents = {
        agent: Takes(tuple(dict.fromkeys([*(known for owner, known in specs if owner == agent), *values])))
        for agent, values in recorded.arguments.items()
    }
    scenario = [*(known for owner, known in specs if not owner), *recorded.scenario_arguments]
    owners = Owners(agents, tuple(dict.fromkeys(scenario)))
    ask = None if code is None else lambda agent: takes_of(settings.agents[agent].agent, code)
    owner = owners.of_record(name, ask, option="--set")
    if owner is None:
        raise owners.unknown(name, option="--set", whose="the crash")
    return owner


def _name(key: tuple[str, str]) -> str:
    agent, name = key
    return f"{agent}.{name}" if agent else name


def _plain(value: Value) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
