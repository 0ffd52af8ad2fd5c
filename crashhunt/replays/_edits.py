"""Changes that the user makes to a recorded trial, in ``hunt.toml`` or on the command line."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from crashhunt.base.errors import ArgumentError, UsageError
from crashhunt.base.text import one_of
from crashhunt.disturbances import FORM, is_fixed, parse_fixed, parse_rates, word_of
from crashhunt.plans import Owners, Takes, takes_of
from crashhunt.trial import CELLS, KINDS, Constant, Value, parse_spec, why_not

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from crashhunt.plans import ArgumentSpec, HuntSettings
    from crashhunt.trial import Disturbance, TrialSpec


# A crash with other disturbances: ``--set disturbances…`` of a replay, and ``disturb`` of ``hunt.toml``.

NAME = "disturbances"
_EDITABLE_FIELDS = ("who", "how_strong", "how_long")
_NONE = "none"


def is_about_disturbances(name: str) -> bool:
    """Return whether ``--set NAME=…`` changes the disturbances of the trial."""
    return name == NAME or name.startswith(f"{NAME}.")


def edited_disturbances(
    planned: Sequence[Disturbance], name: str, text: str, agents: Sequence[str] = ()
) -> tuple[tuple[Disturbance, ...], list[str]]:
    """Return the disturbances of a trial after one change, and a description of the change.

    Args:
        planned: the planned disturbances of the trial.
        name: the disturbances to change: ``disturbances`` for all of them, or ``disturbances.STEP`` or
            ``disturbances.KIND@STEP`` for one of them, optionally followed by a dot and a field.
        text: the new value: ``none``, a description of other disturbances, or the new value of the field.
        agents: the controlled vehicles; by default, the vehicles that are already disturbed.

    Raises:
        ArgumentError: the name or the text is invalid.
    """
    where, agents = f"--set {name}", agents or tuple(dict.fromkeys(one.agent for one in planned))
    if name == NAME:
        found = () if text == _NONE else _fixed(where, text.split(","), agents)
        return found, [f"{NAME} were {_all(planned, agents)} and are {_all(found, agents)}"] * (found != tuple(planned))
    asked = _Asked.of(name.removeprefix(f"{NAME}."))
    meant = [one for one in planned if asked.means(one)]
    if asked.kind and not asked.field and text != _NONE:
        new = _fixed(where, [f"{asked.kind}@{asked.step}={text}"], agents)
        given = {_key(one) for one in new}
        was = [one for one in planned if _key(one) in given]
        found = tuple(sorted([*(one for one in planned if one not in was), *new], key=_key))
        return found, [f"{name} was {_all(was, agents)} and is {_all(new, agents)}"] * (list(new) != was)
    if not meant:
        every = dict.fromkeys(f"{one.what}@{one.step}" if asked.kind else str(one.step) for one in planned)
        fix = one_of(asked.written, every, give="they begin at", none=f"there is none; write {NAME}.{FORM}")
        raise ArgumentError(f"{where}: no disturbance begins at step {asked.step!r}", fix=fix)
    if not asked.field and text == _NONE:
        left = tuple(one for one in planned if one not in meant)
        return left, [f"{name} was {_all(meant, agents)} and is none"]
    if not asked.field:
        raise ArgumentError(f"{where}: {text!r} is not a disturbance", fix=f"write none, or {NAME}.{FORM}")
    if asked.field not in _EDITABLE_FIELDS:
        fix = one_of(asked.field, _EDITABLE_FIELDS, give="write one of")
        raise ArgumentError(f"{where}: {asked.field!r} cannot be changed", fix=fix)
    if len(meant) > 1:
        several = [word_of(one, agents).partition("=")[0] for one in meant]
        fix = f"write {NAME}.{several[0]}.{asked.field}"
        raise ArgumentError(
            f"{where}: {' and '.join(several)} begin at this step, but the edit must name one of them", fix=fix
        )
    before, value = meant[0], _value(where, asked.field, text)
    now = replace(before, **{asked.field: value})
    if reason := why_not(now):
        raise ArgumentError(f"{where}: {reason[0]}", fix=reason[1])
    words = [f"{name} was {getattr(before, asked.field)} and is {value}"] if now != before else []
    return tuple(now if one == before else one for one in planned), words


def with_other_words(
    planned: Sequence[Disturbance], before: Sequence[str], after: Sequence[str], agents: Sequence[str]
) -> tuple[tuple[Disturbance, ...], list[str], list[str]]:
    """Return the disturbances of a trial after an edit of ``disturb`` in its ``hunt.toml``.

    Disturbances at given steps are replaced by those of the new text. Drawn disturbances are removed if their kind no
    longer has a rate. Drawn disturbances are not drawn again if their rate has changed. ``before`` is the value when
    the trial ran, and ``after`` the present value.

    Returns:
        The disturbances, the changes, and the edits without an effect, as text.

    Raises:
        UsageError: a part of ``disturb`` is invalid.
    """
    if tuple(before) == tuple(after):
        return tuple(planned), [], []
    was, now = parse_fixed(before, agents), parse_fixed(after, agents, shown="hunt.toml, disturb:")
    rates, left = parse_rates(before), parse_rates(after)
    gone = rates.keys() - left.keys()
    if left:  # a user's own model reports its type only after its import
        gone &= KINDS.keys()
    drawn = [one for one in planned if one not in was]
    kept = [one for one in drawn if (left and one.what not in gone) or not rates]
    taken = {_key(one) for one in now}
    found = tuple(sorted([*(one for one in kept if _key(one) not in taken), *now], key=_key))
    changed = [f"disturb was {_quoted(before)} and is {_quoted(after)}"] * (was != now or bool(gone))
    others = {name: rate for name, rate in rates.items() if name not in gone}
    ignored = [
        f"disturb was {_rates(others)} and is {_rates(left)} in hunt.toml; a replay keeps what was drawn for the trial"
    ]
    return found, changed, ignored * (others != left)


@dataclass(frozen=True, slots=True)
class _Asked:
    """The disturbances that an edit by the user selects."""

    kind: str  # the kind of disturbance, optionally preceded by the agent; empty for every kind
    step: str  # the step as the user wrote it
    field: str  # the field to change; empty for the whole disturbance

    @classmethod
    def of(cls, text: str) -> _Asked:
        kind, at, rest = text.rpartition("@")
        step, _, name = (rest if at else text).partition(".")
        return cls(kind, step, name)

    @property
    def written(self) -> str:
        return f"{self.kind}@{self.step}" if self.kind else self.step

    def means(self, one: Disturbance) -> bool:
        return str(one.step) == self.step and self.kind in ("", one.what, f"{one.agent}.{one.what}")


def _fixed(where: str, words: Sequence[str], agents: Sequence[str]) -> tuple[Disturbance, ...]:
    odd = next((word for word in words if not is_fixed(word)), None)
    if odd is not None:
        fix = f"write {NAME}=none, {NAME}={FORM},… or {NAME}.STEP.how_strong=2"
        raise ArgumentError(f"{where}: {odd!r} is not a disturbance", fix=fix)
    try:
        return parse_fixed(words, agents, shown=where.partition(".")[0] + ":")
    except UsageError as error:
        raise ArgumentError(error.message, fix=error.fix) from None


def _value(where: str, field: str, text: str) -> Any:
    if field == "who":
        if text not in CELLS:
            raise ArgumentError(f"{where}: {text!r} is not a place around the agent", fix=one_of(text, CELLS))
        return text
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (0 <= value < math.inf) or (field == "how_long" and value == 0):
        least = "seconds above 0" if field == "how_long" else "a number from 0 on"
        raise ArgumentError(f"{where}: {text!r} is out of range", fix=f"give {least}")
    return value


def _key(one: Disturbance) -> tuple[int, str, str]:
    return one.step, one.agent, one.what


def _all(some: Iterable[Disturbance], agents: Sequence[str]) -> str:
    found = tuple(some)
    return (word_of(found[0], agents) if len(found) == 1 else str(len(found))) if found else _NONE


def _quoted(words: Sequence[str]) -> str:
    return ",".join(words) or _NONE


def _rates(rates: dict[str, float]) -> str:
    return _quoted([f"{name}={rate!r}" for name, rate in rates.items()])


Values = dict[tuple[str, str], Value]  # (agent, or empty for the scenario; name) to value


@dataclass(frozen=True, slots=True)
class Edits:
    """The differences between a trial and its recording, as text."""

    agents: tuple[str, ...] = ()  # differences in the agents and their arguments
    # all other differences, such as traffic, length and crash criteria. Other differences may explain why a crash does
    # not reproduce.
    others: tuple[str, ...] = ()
    ignored: tuple[str, ...] = ()  # changes in ``hunt.toml`` that have no effect on a replay

    @property
    def all(self) -> tuple[str, ...]:
        """All differences that change the trial."""
        return (*self.agents, *self.others)


def edited_spec(
    recorded: TrialSpec,
    settings: HuntSettings,
    original: HuntSettings,
    changes: Mapping[str, str],
    *,
    code: Sequence[str] | None = None,
) -> tuple[TrialSpec, Edits]:
    """Return the trial to replay, and its differences from the recorded trial.

    ``original`` is the ``hunt.toml`` with which the trial ran. The changes, by ``NAME`` or ``AGENT.NAME``, are applied
    last. Arguments that are not recorded are looked up in the agents' ``code``, unless no code may run.

    Raises:
        ArgumentError: an argument does not exist, or a range is given instead of one value.
    """
    before, after = _specs(original), _specs(settings)
    values: Values = {
        key: _constant(spec.spec, spec, f"hunt.toml, {_name(key)}")
        for key, spec in sorted(after.items())
        if spec != before.get(key)
    }
    agents, others = _changes_of_settings(original, settings)
    vehicles = tuple(recorded.arguments) or tuple(settings.agents)
    disturbances, said, unheard = with_other_words(recorded.disturbances, original.disturb, settings.disturb, vehicles)
    others += said
    for name, text in changes.items():
        if is_about_disturbances(name) and name not in recorded.scenario_arguments:
            disturbances, said = edited_disturbances(disturbances, name, text, vehicles)
            others += said
        else:
            key = _find(name, recorded, settings, code)
            values[key] = _constant(text, after.get(key), f"--set {name}")
    max_steps = settings.max_steps if settings.max_steps != original.max_steps else recorded.max_steps
    trial = replace(_with_values(recorded, values, agents, others), max_steps=max_steps, disturbances=disturbances)
    kept = [
        f"{name} was {_plain(was)} and is {_plain(now)} in hunt.toml; a replay keeps that of the recorded trial"
        for name in ("seed", "scenario")
        if (was := getattr(original, name)) != (now := getattr(settings, name))
    ]
    late = next((one for one in disturbances if one.step > max_steps and one not in recorded.disturbances), None)
    if late is not None:
        fix = f"give a step up to {max_steps}"
        raise ArgumentError(f"{NAME}: {late.what}@{late.step} cannot happen: the trial has {max_steps} steps", fix=fix)
    return trial, Edits(tuple(agents), tuple(others), (*kept, *unheard))


def _changes_of_settings(original: HuntSettings, settings: HuntSettings) -> tuple[list[str], list[str]]:
    """Return the changes to agents and limits in ``hunt.toml`` as texts, and those to other settings of its trials."""
    agents = [
        f"agents.{agent}.agent was {original.agents[agent].agent} and is {chosen.agent}"
        for agent, chosen in settings.agents.items()
        if agent in original.agents and chosen.agent != original.agents[agent].agent
    ]
    others: list[str] = []
    for name in ("max_steps", "crash_on", "events", "oracles"):
        was, now = getattr(original, name), getattr(settings, name)
        if was != now:
            longer = name == "max_steps" and now > was  # which leaves nothing out
            (agents if longer else others).append(f"{name} was {_plain(was)} and is {_plain(now)}")
    return agents, others


def _with_values(recorded: TrialSpec, values: Values, agents: list[str], others: list[str]) -> TrialSpec:
    """Return a trial with other values of arguments, and add each change to the texts about agents or other changes."""
    arguments = {agent: dict(given) for agent, given in recorded.arguments.items()}
    scenario_arguments = dict(recorded.scenario_arguments)
    for (agent, name), value in values.items():
        target = arguments.setdefault(agent, {}) if agent else scenario_arguments
        if name not in target or target[name] != value:
            was = target.get(name, "(not there)")
            (agents if agent else others).append(f"{_name((agent, name))} was {was} and is {value}")
            target[name] = value
    return replace(recorded, arguments=arguments, scenario_arguments=scenario_arguments)


def _specs(settings: HuntSettings) -> dict[tuple[str, str], ArgumentSpec]:
    found = {("", name): spec for name, spec in settings.scenario_arguments.items()}
    for agent, chosen in settings.agents.items():
        found |= {(agent, name): spec for name, spec in chosen.arguments.items()}
    return found


def _constant(text: str, spec: ArgumentSpec | None, where: str) -> Value:
    distribution = parse_spec(text, spec.kind if spec else None, where=where)
    if not isinstance(distribution, Constant):
        raise ArgumentError(f"{where}: {text!r} is not a single value", fix="give one value")
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
    owner = owners.of_record(name, ask)
    if owner is None:
        raise owners.unknown(name, option="--set", whose="the crash")
    return owner


def _name(key: tuple[str, str]) -> str:
    agent, name = key
    return f"{agent}.{name}" if agent else name


def _plain(value: Value) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
