"""The scripted form of a crash: other actors follow recorded paths, so removing one actor changes no other actor."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from crashhunt.trial import SENSOR_KINDS
from crashhunt.world import paths_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.replays import Rerun
    from crashhunt.trial import TrialSpec

_BEFORE_S = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 20.0, 40.0)
"""How long before the crash it may begin, in s: tried in this order. A lane change is looked for 3 s back."""

_LONGER_S = 1.0  # by which the crash may come later than it did: the others are seen no longer than that


@dataclass(frozen=True, slots=True)
class Part:
    """The actors of a crash that remain in a candidate.

    Args:
        agents: identifiers of the agents that drive themselves.
        others: identifiers of the actors that follow recorded paths; they may include agents.
        begin: the step of the recording at which the candidate begins.
    """

    agents: tuple[str, ...]
    others: tuple[str, ...]
    begin: int = 0

    @property
    def count(self) -> int:
        """The number of actors that take part."""
        return len(self.agents) + len(self.others)


class Scripting:
    """Creates trials with parts of a recorded crash.

    Args:
        rerun: the crash to minimize.
    """

    def __init__(self, rerun: Rerun) -> None:
        recorded = rerun.recorded
        self._spec = rerun.spec
        self._step_s = recorded.prologue.step_length_s
        self._paths = paths_of(recorded.scenes(), recorded.agents)
        escape = rerun.bundle.result.escape
        # An agent that cannot avoid it any more is not tested: however it is mended, it crashes.
        self._latest = recorded.steps if escape is None or escape.step is None else escape.step
        self.whole = Part(recorded.agents, self._paths.names)

    @property
    def steps(self) -> int:
        """The number of recorded steps."""
        return self._paths.steps

    def spec(self, part: Part) -> TrialSpec:
        """Return the trial for the remaining actors, with the recorded arguments."""
        paths = self._paths.driven_by(part.agents).only(part.others)
        paths = paths.cut(part.begin, paths.steps, self._step_s).placing()
        disturbed = (one for one in self._spec.disturbances if one.what in SENSOR_KINDS and one.step > part.begin)
        return replace(
            self._spec,
            arguments={agent: given for agent, given in self._spec.arguments.items() if agent in part.agents},
            # What befell the others is in their ways.
            disturbances=tuple(replace(one, step=one.step - part.begin) for one in disturbed),
            only=None,
            script=paths,
            max_steps=paths.steps + max(1, round(_LONGER_S / self._step_s)),
        )

    def begins(self, agents: Sequence[str]) -> list[int]:
        """Return the possible later starts, the latest first; no start is later than the last avoidable step."""
        known = [{step for step, _ in path.lanes} for path in self._paths.agents if path.actor.id in agents]
        steps = sorted(set.intersection(*known)) if known else []
        found = []
        for before_s in _BEFORE_S:
            latest = min(self._latest, self.steps - round(before_s / self._step_s))
            found += [step for step in steps if 0 < step <= latest][-1:]
        return list(dict.fromkeys(found))


def can_be_scripted(rerun: Rerun) -> bool:
    """Return whether the simulator can move other actors along recorded paths."""
    return rerun.worker.scenario.backend.plays_paths
