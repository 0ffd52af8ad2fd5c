"""Which trials run on which node of a cluster, and what happens to the trials of a lost node. Knows nothing of Ray."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from crashhunt.executors._protocol import NodeFigures

if TYPE_CHECKING:
    from collections.abc import Mapping

    from crashhunt.base.codec import JsonObject
    from crashhunt.executors.ray._messages import Submitted


_TRIALS_PER_CPU = 2  # trials that a node has for each of its CPUs, so that none waits for the wire
_MAX_TRIAL_LOSSES = 2  # of a trial with its node; then it runs alone on one, in case it is what ends them


@dataclass(slots=True, eq=False)
class Trial:
    """A submitted trial."""

    ticket: int  # position of the trial in the order of submission
    spec: JsonObject  # specification of the trial as JSON
    losses: int = 0  # number of times that the node of the trial was lost

    @property
    def number(self) -> int:
        """The number of the trial in the hunt."""
        return int(self.spec["number"])

    @property
    def alone(self) -> bool:
        """Whether the trial must run alone on a node."""
        return self.losses >= _MAX_TRIAL_LOSSES


@dataclass(slots=True, eq=False)
class Node:
    """A machine that runs trials, or a part of a machine whose CPUs became free at different times."""

    id: str  # identifier of this part of a machine
    machine: str  # Ray's identifier of the machine
    name: str  # name of the machine for users
    slots: int  # number of trials that run at a time
    actor: Any  # the actor that runs on the node
    stood: float = 0.0  # time at which the actor was started, on the clock `time.monotonic`
    doing: str = ""  # the last request that has no answer yet
    answer: Any = None  # Ray's reference to the answer of this request
    ready: bool = False  # whether the node runs trials
    given: list[Submitted] = field(default_factory=list)  # trials to send with the next request, by ticket
    running: dict[int, Trial] = field(default_factory=dict)  # trials that run on the node, by ticket
    done: int = 0  # number of trials that have ended on the node
    since: float = 0.0  # time at which the node became ready, on the clock `time.monotonic`

    @property
    def has_room(self) -> bool:
        """Return whether the node can run one more trial."""
        return self.ready and len(self.running) < _TRIALS_PER_CPU * self.slots

    @property
    def rate_per_s(self) -> float:
        """The number of ended trials per second, measured by the clock of the hunt's machine."""
        elapsed_s = time.monotonic() - self.since if self.ready else 0.0
        return self.done / elapsed_s if elapsed_s > 0 else 0.0


class NodeScheduler:
    """The nodes of a cluster, and the trials that wait for a node."""

    def __init__(self) -> None:
        self.nodes: dict[str, Node] = {}
        self.waiting: deque[Trial] = deque()

    @property
    def capacity(self) -> int:
        """The number of trials that the ready nodes can run at a time, in total."""
        return sum(node.slots for node in self.nodes.values() if node.ready)

    @property
    def idle(self) -> bool:
        """Whether no trial is waiting or running."""
        return not self.waiting and not any(node.running for node in self.nodes.values())

    def figures(self) -> list[NodeFigures]:
        """Return the figures of the ready machines for the status screen."""
        machines: dict[str, list[Node]] = {}
        for node in self.nodes.values():
            if node.ready:
                machines.setdefault(node.machine, []).append(node)
        return [
            NodeFigures(
                name=nodes[0].name,
                parallel=sum(node.slots for node in nodes),
                trials=sum(node.done for node in nodes),
                rate_per_s=sum(node.rate_per_s for node in nodes),
            )
            for nodes in machines.values()
        ]

    def parts(self, machine: str) -> list[Node]:
        """Return the nodes on a machine that run trials."""
        return [node for node in self.nodes.values() if node.machine == machine]

    def assign(self) -> dict[Node, list[Trial]]:
        """Assign waiting trials to nodes in their order, each to the least busy node; return the assignments."""
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
        """Record that a trial has ended on a node; return whether it was running there and was not cancelled."""
        if node.running.pop(ticket, None) is None:
            return False
        node.done += 1
        return True

    def lose(self, node: Node) -> list[Trial]:
        """Remove a node; return those of its trials that do not run again because they ran alone on the node."""
        self.nodes.pop(node.id, None)
        culprits = [trial for trial in node.running.values() if trial.alone]
        for trial in node.running.values():
            trial.losses += 1
        again = [trial for trial in node.running.values() if trial not in culprits]
        self.waiting = deque(sorted([*again, *self.waiting], key=lambda trial: trial.ticket))
        node.running.clear()
        return culprits

    def cancel(self, above: int) -> None:
        """Cancel the trials whose number is greater than ``above``."""
        self.waiting = deque(trial for trial in self.waiting if trial.number <= above)
        for node in self.nodes.values():
            node.running = {ticket: trial for ticket, trial in node.running.items() if trial.number <= above}
            node.given = [(ticket, spec) for ticket, spec in node.given if ticket in node.running]


def shares(free: Mapping[str, int], wanted: int | None) -> dict[str, int]:
    """Divide the trials that run at a time evenly among nodes, without exceeding the free slots of any node.

    Without ``wanted``, the hunt wants all free slots.
    """
    left = {node: count for node, count in free.items() if count > 0}
    if wanted is None:
        return left
    found: dict[str, int] = {}
    for _ in range(min(wanted, sum(left.values()))):
        node = max(
            (one for one, count in left.items() if count > 0), key=lambda node: (left[node], -found.get(node, 0))
        )
        left[node] -= 1
        found[node] = found.get(node, 0) + 1
    return found
