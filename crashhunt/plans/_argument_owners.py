"""Finds the owner of an argument: ``NAME`` and ``AGENT.NAME`` are resolved in the same way in every option and file."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.errors import ArgumentError, CrashhuntError
from crashhunt.base.plugins import locate, registered
from crashhunt.base.programs import is_program
from crashhunt.base.text import did_you_mean, listed
from crashhunt.trial import FILLED_BY_NAME, signature_of

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

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
    """The arguments that an agent accepts.

    Args:
        names: names of the arguments that the agent declares.
        open: whether the agent accepts any other argument as well (``**kwargs``).
        defaults: defaults of the arguments whose default is a number, a string or a Boolean.
    """

    names: Collection[str] = ()
    open: bool = False
    defaults: Mapping[str, Value] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Owners:
    """Finds the owner of an argument: an agent or the scenario.

    ``AGENT.NAME`` is an argument of that agent, and ``scenario.NAME`` is an argument of the scenario. A bare ``NAME``
    belongs to the agent or the scenario that declares it, or else to the agent that accepts any argument. If there are
    several such owners, a bare ``NAME`` belongs to none.

    Args:
        agents: accepted arguments of each agent.
        scenario: names of the scenario's arguments.
    """

    agents: Mapping[str, Takes]
    scenario: Collection[str] = field(default=())

    def of(self, word: str, *, option: str) -> tuple[str, str] | None:
        """Return the owner of an argument (an agent, or empty for the scenario) and its name; None if no owner has it.

        Args:
            word: name of the argument as the user wrote it.
            option: option that contains the name, for error messages.

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

    def of_record(self, word: str, ask: Callable[[str], Takes] | None, *, option: str) -> tuple[str, str] | None:
        """Return the owner and the name of an argument of a recorded crash; None if no owner has it.

        The record lacks arguments whose default is not a number, a string or a Boolean; for these, `ask` is called.

        Args:
            word: name of the argument as the user wrote it.
            ask: function that returns the arguments of an agent from its code; called only if the record does not
                contain the name. The function returns None if the code may not run.
            option: option that contains the name, for error messages.

        Raises:
            ArgumentError: several owners have an argument with this name.
        """
        owner = self.of(word, option=option)
        if owner is not None or ask is None or word.startswith(f"{SCENARIO}."):
            return owner
        agent = agent_of(word, self.agents)
        agents = dict(self.agents)
        for name in [agent] if agent else self.agents:
            asked = ask(name)
            agents[name] = Takes((*agents[name].names, *asked.names), asked.open)
        return Owners(agents, self.scenario).of(word, option=option)

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

    Args:
        locator: locator of the agent, ``module:attribute`` or a registered name.
        code: folders whose modules take precedence over installed modules.
        folder: folder from which other modules are imported; by default the current folder.

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
