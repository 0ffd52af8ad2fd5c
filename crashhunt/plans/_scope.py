"""``NAME`` and ``AGENT.NAME``: whose argument is meant, the same wherever somebody may write one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.errors import ArgumentError
from crashhunt.base.names import did_you_mean, listed
from crashhunt.base.plugins import registered

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

__all__ = ["Owners", "Takes", "agent_of", "takes_of"]

SCENARIO = "scenario"  # before a name that is the scenario's, where an agent has it too
_ASK_S = 60.0
# Whatever the module prints when it is imported is not the answer. No crashhunt is needed: it may be an older one.
_ASK = """
import importlib, inspect, json, os, sys
answer = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)
module, _, attribute = sys.argv[1].partition(":")
found = importlib.import_module(module)
for part in attribute.split("."):
    found = getattr(found, part)
try:
    parameters = inspect.signature(found).parameters.values()
except (TypeError, ValueError):
    names, is_open = [], True
else:
    given = ("observation_space", "action_space", "step_length_s")
    kinds = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    names = [known.name for known in parameters if known.kind in kinds and known.name not in given]
    is_open = any(known.kind is known.VAR_KEYWORD for known in parameters)
json.dump([names, is_open], answer)
"""


@dataclass(frozen=True, slots=True)
class Takes:
    """Which arguments an agent takes.

    Args:
        names: of those that it declares.
        open: whether it takes any other as well (``**kwargs``).
    """

    names: Collection[str] = ()
    open: bool = False


@dataclass(frozen=True, slots=True)
class Owners:
    """Who has which arguments.

    ``AGENT.NAME`` is that agent's, and ``scenario.NAME`` the scenario's. A bare ``NAME`` is whose it is where that is
    one only: of the agents that declare it and the scenario, or else of the agents that take any. Where there are
    several, it is nobody's.

    Args:
        agents: what each takes.
        scenario: the names of the scenario's.
    """

    agents: Mapping[str, Takes]
    scenario: Collection[str] = field(default=())

    def of(self, word: str, *, option: str) -> tuple[str, str] | None:
        """Return the agent (empty for the scenario) and the name that are meant; None where nobody has it.

        Args:
            word: as it was written.
            option: in which, for the error.

        Raises:
            ArgumentError: several have it.
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
        """Return the same where these are of a record, which lacks arguments that have no plain default.

        Args:
            word: as it was written.
            ask: returns what an agent takes by its code, which is asked only where the record does not know; None where
                that code may not run.
            option: in which the word was, for the error.

        Raises:
            ArgumentError: several have it.
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
        """Return the error for a name that nobody has, with what was probably meant."""
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
    """Return the agent whose id a word begins with, and a dot; empty where it is a bare name.

    Ids may have dots themselves, and one may be the beginning of another: the longest is meant.
    """
    return next((agent for agent in sorted(agents, key=len, reverse=True) if word.startswith(f"{agent}.")), "")


def takes_of(locator: str, code: Sequence[str] = (), folder: Path | None = None) -> Takes:
    """Ask the code of an agent what it takes, in a process of its own, as that code may be of a snapshot.

    Args:
        locator: of the agent.
        code: folders whose modules win over installed ones.
        folder: from where it is imported otherwise; by default the current one.

    Returns:
        What it takes; anything, where it cannot be asked, as whoever runs it will say why.
    """
    points = registered("agents")
    target = points[locator].value if locator in points else locator
    home = str(folder or Path.cwd())
    paths = os.pathsep.join(filter(None, (*code, home, os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", _ASK, target], env=environment, cwd=home, stdin=subprocess.DEVNULL,
            capture_output=True, timeout=_ASK_S, check=True,
        )  # fmt: skip
        names, is_open = json.loads(done.stdout)
    except (OSError, ValueError, subprocess.SubprocessError):
        return Takes(open=True)
    return Takes(tuple(names), bool(is_open))
