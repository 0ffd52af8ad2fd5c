"""The arguments of a hunt: their owners, and the values that a request, the scenario or the agent's class gives them.

``NAME`` and ``AGENT.NAME`` are resolved in the same way in every option and file.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.agent_locators import is_program
from crashhunt.base.errors import ArgumentError, CrashhuntError, ScenarioError
from crashhunt.base.plugins import locate, registered
from crashhunt.base.text import did_you_mean, listed, one_of
from crashhunt.disturbances import signals_of_fixed
from crashhunt.plans._request import Request, spec_words
from crashhunt.plans._settings import AgentSettings, ArgumentSpec
from crashhunt.trial import (
    FILLED_BY_NAME,
    Argument,
    CallSignature,
    Constant,
    expand_signal,
    is_signal,
    parse_spec,
    signature_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

    from crashhunt.scenario import Scenario
    from crashhunt.trial import Value


SCENARIO = "scenario"  # before a name that is the scenario's, where an agent has it too
_SIGNATURE_TIMEOUT_S = 60.0
# Whatever the module prints when it is imported is not the answer. No crashhunt is needed: it may be an older one.
_SIGNATURE_SCRIPT = """
import importlib, inspect, json, os, sys
from importlib.machinery import PathFinder
answer = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)
module, _, attribute = sys.argv[1].partition(":")
filled, home, *code = sys.argv[2:]
is_there = PathFinder.find_spec(module.partition(".")[0], [home]) is not None
sys.path[:] = [*code, home, *sys.path] if is_there else [*code, *sys.path, home]
found = importlib.import_module(module)
for part in attribute.split("."):
    found = getattr(found, part)
try:
    parameters = inspect.signature(found).parameters.values()
except (TypeError, ValueError):
    names, is_open, defaults = [], True, {}
else:
    kinds = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    names = [known.name for known in parameters if known.kind in kinds and known.name not in filled.split(',')]
    is_open = any(known.kind is known.VAR_KEYWORD for known in parameters)
    defaults = {known.name: known.default for known in parameters if type(known.default) in (bool, int, float, str)}
json.dump([names, is_open, defaults], answer)
"""


@dataclass(frozen=True, slots=True)
class Takes:
    """The arguments that an agent accepts."""

    names: Collection[str] = ()  # names of the arguments that the agent declares
    open: bool = False  # whether the agent accepts any other argument as well (``**kwargs``)
    # defaults of the arguments whose default is a number, a string or a Boolean
    defaults: Mapping[str, Value] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Owners:
    """Finds the owner of an argument: an agent or the scenario.

    ``AGENT.NAME`` is an argument of that agent, and ``scenario.NAME`` is an argument of the scenario. A bare ``NAME``
    belongs to the agent or the scenario that declares it, or else to the agent that accepts any argument. If there are
    several such owners, a bare ``NAME`` belongs to none.
    """

    agents: Mapping[str, Takes]
    scenario: Collection[str] = field(default=())

    def of(self, word: str, *, option: str) -> tuple[str, str] | None:
        """Return the owner of an argument (an agent, or empty for the scenario) and its name; None if no owner has it.

        Raises:
            ArgumentError: several owners have an argument with this name.
        """
        agent = agent_of(word, self.agents)
        if agent:
            name = word.removeprefix(f"{agent}.")
            takes = self.agents[agent]
            return (agent, name) if name in takes.names or takes.open else None
        bare = word.removeprefix(f"{SCENARIO}.") if SCENARIO not in self.agents else word
        if bare != word or (word in self.scenario and not self._declaring(word)):
            return ("", bare) if bare in self.scenario else None
        takers = self._declaring(word) if word in self.scenario else self._taking(word)
        several = [*takers, *([SCENARIO] if word in self.scenario else [])]
        if len(several) > 1:
            who = "several agents take it" if SCENARIO not in several else f"{' and '.join(several)} have it"
            fix = " or ".join(f"{option} {owner}.{word}=…" for owner in several)
            raise ArgumentError(f"{option} {word}: {who}", fix=f"write {fix}")
        return (takers[0], word) if takers else None

    def of_record(self, word: str, ask: Callable[[str], Takes] | None) -> tuple[str, str] | None:
        """Return the owner and the name of an argument that ``--set`` names; None if no owner has it.

        The record lacks arguments whose default is not a number, a string or a Boolean. Therefore, if it does not
        contain the name, ``ask`` returns the arguments of an agent from its code. It is None if no code may run.

        Raises:
            ArgumentError: several owners have an argument with this name.
        """
        owner = self.of(word, option="--set")
        if owner is not None or ask is None or word.startswith(f"{SCENARIO}."):
            return owner
        agent = agent_of(word, self.agents)
        agents = dict(self.agents)
        for name in [agent] if agent else self.agents:
            asked = ask(name)
            agents[name] = Takes((*agents[name].names, *asked.names), asked.open)
        return Owners(agents, self.scenario).of(word, option="--set")

    def unknown(self, word: str, *, option: str, whose: str) -> ArgumentError:
        """Return the error for an unknown argument, with the most similar known name."""
        bare = {name: name for name in self.scenario}
        bare |= {f"{agent}.{name}": name for agent, takes in self.agents.items() for name in takes.names}
        near = (f"did you mean {whole!r}?" for whole, part in bare.items() if did_you_mean(word, [part]))
        hint = did_you_mean(word, bare) or next(near, "")
        return ArgumentError(
            f"{option}: {whose} has no argument {word!r}", fix=f"{hint} it has {listed(bare)}".lstrip()
        )

    def _declaring(self, name: str) -> list[str]:
        return [agent for agent, takes in self.agents.items() if name in takes.names]

    def _taking(self, name: str) -> list[str]:
        return [agent for agent, takes in self.agents.items() if name in takes.names or takes.open]


def agent_of(word: str, agents: Collection[str]) -> str:
    """Return the agent whose id, followed by a dot, is a prefix of the given word; empty if there is none.

    Identifiers may contain dots, and an identifier may be a prefix of another identifier. If several match, the longest
    is used.
    """
    return next((agent for agent in sorted(agents, key=len, reverse=True) if word.startswith(f"{agent}.")), "")


def takes_of(locator: str, code: Sequence[str] = (), folder: Path | None = None) -> Takes:
    """Read the arguments of an agent from its code in another process, because the code may belong to a snapshot.

    Modules in the folders of ``code`` take precedence over installed modules. Other modules are imported from
    ``folder``, by default the current folder.

    Returns:
        The accepted arguments. If they cannot be determined, every argument is accepted, because the first run reports
        the reason.
    """
    if is_program(locator):
        return _takes_of_program(locator)
    points = registered("agents")
    target = points[locator].value if locator in points else locator
    home = str(folder or Path.cwd())
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", _SIGNATURE_SCRIPT, target, ",".join(FILLED_BY_NAME), home, *code],
            env=environment, cwd=home,
            stdin=subprocess.DEVNULL, capture_output=True, timeout=_SIGNATURE_TIMEOUT_S, check=True,
        )  # fmt: skip
        names, is_open, defaults = json.loads(done.stdout)
    except (OSError, ValueError, subprocess.SubprocessError):
        return Takes(open=True)
    return Takes(tuple(names), bool(is_open), {name: defaults[name] for name in names if name in defaults})


def _takes_of_program(locator: str) -> Takes:
    try:
        signature = signature_of(locate("agents", locator))
    except CrashhuntError:
        return Takes(open=True)
    defaults = {name: one.default for name, one in signature.arguments.items() if one.default is not None}
    return Takes(tuple(signature.arguments), signature.open, defaults)


# The values of the arguments.


def settings_of_agents(
    request: Request,
    scenario: Scenario,
    signatures: Mapping[str, CallSignature],
    actions: Mapping[str, str],
    observations: Mapping[str, tuple[str, ...]],
    *,
    hunted: bool,
) -> dict[str, AgentSettings]:
    """Return the settings of each agent, with a specification of each argument that has a value.

    Unless ``hunted``, only values that the user gives apply, and no declared ranges.

    Raises:
        ArgumentError: an argument is unknown, missing or invalid.
        ScenarioError: the scenario names an argument that the agent does not take.
    """
    asked: dict[str, dict[str, str]] = {agent: {} for agent in scenario.agents}
    for name, spec in spec_words(request.arguments).items():
        agent, argument = _owner(name, scenario, signatures)
        asked[agent][argument] = spec
    agents: dict[str, AgentSettings] = {}
    duration_s = request.max_steps * scenario.backend.step_length_s(scenario)
    for agent, setup in scenario.agents.items():
        signature = signatures[agent]
        known = scenario.agent_arguments(agent)
        for name in known:
            if name not in signature.arguments and not signature.open:
                raise ScenarioError(
                    f"agents.{agent}.arguments.{name}: {setup.agent} takes no such argument",
                    fix=one_of(name, signature.arguments, give="it takes", none="no arguments"),
                    where=scenario.origin,
                )
        specs: dict[str, ArgumentSpec] = {}
        for name, spec in asked[agent].items():
            specs |= _signal_specs(name, spec, duration_s, f"--arg {name}")
        for name in sorted({*signature.arguments, *known, *asked[agent]} - specs.keys()):
            found = _spec(name, signature.arguments.get(name), known.get(name), asked[agent].get(name), hunted=hunted)
            if found is not None:
                specs[name] = found
            elif name in signature.required:
                fix = f"give --arg {name}=SPEC"
                if name in ("observation", "obs", "state"):  # of a function that is a policy itself
                    fix = "name a class with the methods reset and act, or a function that returns such an object"
                raise ArgumentError(f"{setup.agent} needs the argument {name!r}", fix=fix, where=f"agent {agent}")
        agents[agent] = AgentSettings(
            agent=setup.agent, arguments=specs, action=actions.get(agent), observation=observations.get(agent)
        )
    return agents


def _owner(name: str, scenario: Scenario, signatures: Mapping[str, CallSignature]) -> tuple[str, str]:
    """Return the agent and the name to which an ``--arg`` refers."""
    takes = {agent: Takes(signature.arguments, signature.open) for agent, signature in signatures.items()}
    owner = Owners(takes).of(name, option="--arg")
    if owner is not None:
        return owner
    agent = agent_of(name, scenario.agents)
    if agent:
        where = f"--arg {name}: {scenario.agents[agent].agent}"
        signatures[agent].check([name.removeprefix(f"{agent}.")], where=where)
    if name in scenario.arguments:
        raise ArgumentError(
            f"--arg {name}: {name} is an argument of the scenario, not of an agent", fix=f"write --set {name}=SPEC"
        )
    first = next(iter(scenario.agents))
    signatures[first].check([name], where=f"--arg: {scenario.agents[first].agent}")
    raise AssertionError(name)  # the agent that accepts it is its owner


def _spec(
    name: str, declared: Argument | None, known: Argument | None, asked: str | None, *, hunted: bool
) -> ArgumentSpec | None:
    kind = (declared.kind if declared else None) or (known.kind if known else None)
    if asked is not None:
        distribution = parse_spec(asked, kind, where=f"--arg {name}")
        # A program's 12 has no type, because JSON has one type of numbers.
        if declared and kind is None and type(declared.default) is int and str in map(type, distribution.grid(1)):
            raise ArgumentError(f"--arg {name}: {asked!r} is not a number", fix=f"give one, such as {declared.default}")
        return ArgumentSpec(spec=str(distribution), kind=kind)
    for argument in (known, declared) if hunted else ():
        if argument is not None and argument.distribution is not None:
            # The same text may mean whole numbers or not, depending on the agent's own type.
            return ArgumentSpec(spec=str(parse_spec(str(argument.distribution), kind, where=name)), kind=kind)
    for argument in (known, declared):
        # The constructor's own default too: it may be another one by the time of a replay.
        if argument is not None and argument.default is not None:
            try:
                constant = parse_spec(str(Constant(argument.default)), kind, where=name)
            except ArgumentError:
                if argument is known:
                    raise
                return None  # a default of another type than the annotation, such as `gap: float = "auto"`
            # A text such as "a|b" would be read as a choice, and "7" as a number; so its owner keeps it as a default.
            is_kept = isinstance(constant, Constant) and (argument is known or constant.value == argument.default)
            return ArgumentSpec(spec=str(constant), kind=kind) if is_kept else None
    return None


def specs_of_scenario(
    request: Request, scenario: Scenario, disturb: Sequence[str], *, hunted: bool
) -> dict[str, ArgumentSpec]:
    """Return the specification of each argument of the scenario, and of the signals of disturbances.

    Unless ``hunted``, only values that the user gives apply, and no declared ranges.

    Raises:
        ArgumentError: an argument is unknown or invalid.
        ScenarioError: an argument has no value.
    """
    known = scenario.scenario_arguments()
    wanted: dict[str, str] = {}
    for name, spec in spec_words(request.scenario_arguments).items():
        owner = Owners({}, known).of(name, option="--set")
        if owner is None:
            raise ArgumentError(f"--set: the scenario has no argument {name!r}", fix=one_of(name, known, give="it has"))
        wanted[owner[1]] = spec
    specs: dict[str, ArgumentSpec] = {}
    duration_s = request.max_steps * scenario.backend.step_length_s(scenario)
    for name, argument in known.items():
        asked = wanted.get(name)
        if asked is not None and is_signal(asked):
            able = tuple(scenario.backend.signal_arguments(scenario))
            if name not in able:
                fix = f"give a range, or vary one of {', '.join(able)}" if able else "give a range"
                raise ArgumentError(f"--set {name}: the argument cannot vary over time in this scenario", fix=fix)
            specs |= _signal_specs(name, asked, duration_s, f"--set {name}")
            continue
        if asked is not None:
            spec = str(parse_spec(asked, argument.kind, where=f"--set {name}"))
        elif argument.distribution is not None and (hunted or argument.default is None):
            spec = str(argument.distribution)
        elif argument.default is not None:
            spec = str(Constant(argument.default))
        else:
            raise ScenarioError(
                f"arguments.{name} has neither a default nor a range",
                fix="give it a default or a range",
                where=scenario.origin,
            )
        specs[name] = ArgumentSpec(spec=spec, kind=argument.kind)
    for name, (one, signal, word) in signals_of_fixed(disturb, tuple(scenario.agents)).items():
        specs |= _signal_specs(name, signal, one.how_long, f"--disturb {word}")
    return specs


def _signal_specs(name: str, spec: str, duration_s: float, where: str) -> dict[str, ArgumentSpec]:
    """Return the specifications of a signal and of its points; empty if the specification is no signal."""
    found = expand_signal(name, spec, duration_s, where=where)
    return {part: ArgumentSpec(spec=text, kind="str" if part == name else "float") for part, text in found.items()}
