"""Which trials run on which node: the part of the bridge that knows nothing of Ray."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from crashhunt.executors.ray._messages import Figures, Submitted
    from crashhunt.trial import SpecData

__all__ = ["Node", "Roster", "Trial", "shares"]

_AHEAD = 2  # trials that a node has for each of its CPUs, so that none waits for the wire
_LOSSES = 2  # of a trial with its node; then it runs alone on one, in case it is what ends them


@dataclass(slots=True, eq=False)
class Trial:
    """A trial that was submitted.

    Args:
        ticket: the order in which it was.
        spec: as JSON.
        losses: how often the node was lost on which it ran.
    """

    ticket: int
    spec: SpecData
    losses: int = 0

    @property
    def number(self) -> int:
        """Which one it is."""
        return self.spec["number"]

    @property
    def alone(self) -> bool:
        """Whether it gets a node of its own."""
        return self.losses >= _LOSSES


@dataclass(slots=True, eq=False)
class Node:
    """A machine that takes part, or a part of one whose CPUs became free one after another.

    Args:
        id: of this part.
        machine: Ray's.
        name: of the machine, for people.
        slots: how many trials at a time.
        actor: that stands there.
        stood: since when, as of `time.monotonic`.
        doing: what it was asked last, and has not answered yet.
        answer: where its answer to that will be.
        ready: whether it runs trials.
        given: what goes along with the next question, by ticket; of what is running.
        running: ticket to trial.
        done: trials so far.
        since: when it became ready, as of `time.monotonic`.
    """

    id: str
    machine: str
    name: str
    slots: int
    actor: Any
    stood: float = 0.0
    doing: str = ""
    answer: Any = None
    ready: bool = False
    given: list[Submitted] = field(default_factory=list)
    running: dict[int, Trial] = field(default_factory=dict)
    done: int = 0
    since: float = 0.0

    @property
    def has_room(self) -> bool:
        """Whether it can be given a trial more."""
        return self.ready and len(self.running) < _AHEAD * self.slots

    @property
    def rate_per_s(self) -> float:
        """How many trials have ended a second, by the clock of this machine here."""
        elapsed_s = time.monotonic() - self.since if self.ready else 0.0
        return self.done / elapsed_s if elapsed_s > 0 else 0.0


class Roster:
    """The nodes, and the trials that wait for one."""

    def __init__(self) -> None:
        self.nodes: dict[str, Node] = {}
        self.waiting: deque[Trial] = deque()

    @property
    def capacity(self) -> int:
        """How many trials run at a time, on nodes that are ready."""
        return sum(node.slots for node in self.nodes.values() if node.ready)

    @property
    def idle(self) -> bool:
        """Whether there is nothing to do."""
        return not self.waiting and not any(node.running for node in self.nodes.values())

    def figures(self) -> list[Figures]:
        """Return what people want to know about the machines that are ready."""
        found: dict[str, Figures] = {}
        for node in self.nodes.values():
            if node.ready:
                none: Figures = {"name": node.name, "parallel": 0, "trials": 0, "rate_per_s": 0.0}
                told = found.setdefault(node.machine, none)
                told["parallel"] += node.slots
                told["trials"] += node.done
                told["rate_per_s"] += node.rate_per_s
        return list(found.values())

    def parts(self, machine: str) -> list[Node]:
        """Return the parts of a machine that take part."""
        return [node for node in self.nodes.values() if node.machine == machine]

    def assign(self) -> dict[Node, list[Trial]]:
        """Give trials that wait to nodes, in their order, each to the one that has least to do; return who got what."""
        given: dict[Node, list[Trial]] = {}
        kept = {node.machine for node in self.nodes.values() for trial in node.running.values() if trial.alone}
        while self.waiting:
            alone = self.waiting[0].alone
            busy = {node.machine for node in self.nodes.values() if node.running} if alone else kept
            free = [node for node in self.nodes.values() if node.has_room and node.machine not in busy]
            if not free:
                break
            node = min(free, key=lambda node: len(node.running) / node.slots)
            trial = self.waiting.popleft()
            node.running[trial.ticket] = trial
            if alone:
                kept.add(node.machine)
            given.setdefault(node, []).append(trial)
        return given

    def ended(self, node: Node, ticket: int) -> bool:
        """Take note that a trial has ended on a node; return whether it is one that ran there, and was not given up."""
        if node.running.pop(ticket, None) is None:
            return False
        node.done += 1
        return True

    def lose(self, node: Node) -> list[Trial]:
        """Take a node out; return the trials that ran there and are not to run again, for they were alone on it."""
        self.nodes.pop(node.id, None)
        culprits = [trial for trial in node.running.values() if trial.alone]
        for trial in node.running.values():
            trial.losses += 1
        again = [trial for trial in node.running.values() if trial not in culprits]
        self.waiting = deque(sorted([*again, *self.waiting], key=lambda trial: trial.ticket))
        node.running.clear()
        return culprits

    def cancel(self, above: int) -> None:
        """Give up trials whose number is greater."""
        self.waiting = deque(trial for trial in self.waiting if trial.number <= above)
        for node in self.nodes.values():
            node.running = {ticket: trial for ticket, trial in node.running.items() if trial.number <= above}
            node.given = [(ticket, spec) for ticket, spec in node.given if ticket in node.running]


def shares(free: Mapping[str, int], wanted: int | None) -> dict[str, int]:
    """Divide trials at a time among nodes: evenly, each at most what it has free.

    Args:
        free: node to how many it could run.
        wanted: how many are wanted in all; None for all there are.
    """
    left = {node: count for node, count in free.items() if count > 0}
    if wanted is None:
        return left
    found: dict[str, int] = {}
    for _ in range(min(wanted, sum(left.values()))):
        node = max(_still(left), key=lambda node: (left[node], -found.get(node, 0)))
        left[node] -= 1
        found[node] = found.get(node, 0) + 1
    return found


def _still(left: Mapping[str, int]) -> Iterable[str]:
    return (node for node, count in left.items() if count > 0)
