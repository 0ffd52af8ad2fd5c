"""The process between a hunt and Ray: it sends trials to nodes, returns their results, and notices lost nodes.

If a cluster ends, Ray ends the process that is connected to it. Ray also writes to the output of this process, and
handles its signals. In a separate process, none of this affects the hunt. The hunt sends trials through a socket, and
receives their results.
"""

from __future__ import annotations

import itertools
import json
import os
import signal
import socket
import sys
import threading
import time
import traceback
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, RecorderError, UsageError
from crashhunt.base.exceptions import in_words
from crashhunt.episode import WorkerSettings, scratch_of
from crashhunt.executors._postmortem import killed_from_outside
from crashhunt.executors.ray._cluster import Cluster, ClusterNode, NodeLostError, TokenError, UnreachableError
from crashhunt.executors.ray._code_archive import CodeArchive
from crashhunt.executors.ray._node_scheduler import Node, NodeScheduler, Trial, shares
from crashhunt.executors.ray._node_worker import unpacked
from crashhunt.trial import TrialSpec

if TYPE_CHECKING:
    from crashhunt.executors.ray._messages import (
        BridgeJob,
        FromBridge,
        News,
        NodeJob,
        NodeTrial,
        ToBridge,
    )


_LOOK_EVERY_S = 1.0  # which nodes there are
_WAIT_S = 0.2  # for a node to answer, before the next node is asked
_REFILL_S = 0.005  # for the hunt to submit more, which then goes along with the next question
_CHUNK_BYTES = 1 << 18  # bytes at a time
_TAKE_S = 2.0  # how long a node waits for a trial to end, before it says that there is nothing new
_FREE_S = 3.0  # for CPUs to become free that another job has just released
_START_S = 30.0  # for an actor to be placed; after that, another job that is no hunt has the CPUs
_FREE_CPU_READINGS = (
    3  # that show free CPUs, before a node that takes part runs more: Ray is late to say what has been taken
)
_CLOSE_S = 1.5  # for nodes to end everything; then they are killed
_MAX_NODE_LOSSES = 3  # of a node without a trial between


def main() -> None:
    """Run the bridge; it logs to standard error."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    control = socket.socket(fileno=int(sys.argv[1]))
    job = json.loads(Path(sys.argv[2]).read_text(encoding="utf-8"))
    code = 1
    try:
        Bridge(control, job).run()
        code = 0
    except CrashhuntError as error:
        kinds = {"passing": isinstance(error, UnreachableError), "token": isinstance(error, TokenError)}
        control.sendall(json.dumps({**error.to_json(), **kinds}).encode() + b"\n")
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)  # the keeper and Ray end the remaining processes


class Bridge:
    """Forwards trials to nodes, and results of trials to the hunt.

    Args:
        control: the socket to the hunt.
        job: the settings of the bridge, such as the address of the cluster and the number of parallel trials; see
            `BridgeJob`.
    """

    def __init__(self, control: socket.socket, job: BridgeJob) -> None:
        self._control = control
        self._job = job
        self._settings = WorkerSettings.from_json(job["settings"])
        self._parcel = CodeArchive.of(self._settings)
        self._digest = self._parcel.digest()
        self._lock = threading.RLock()
        self._refilled = threading.Condition(self._lock)
        self._missing = 0  # trials that have ended, and for which the hunt has submitted no others yet
        self._tickets = 0  # that were given out
        self._scheduler = NodeScheduler()
        self._refused: dict[str, str] = {}  # machine to why
        self._losses: dict[str, int] = {}
        self._free: dict[str, int] = {}  # machine to looks that have shown free CPUs
        self._patience: dict[str, float] = {}  # machine to s
        self._parts = itertools.count()
        self._maps: dict[str, bytes] = {}
        self._began = time.monotonic()
        self._looked = self._told = 0.0
        self._ever_ready = bool(job["resumed"])
        self._alone = False  # no node is left, and people know
        self._closing = False
        self._cluster = Cluster(job["address"], cpus=job["cpus"], temporary=job["temporary"])

    def run(self) -> None:
        """Forward trials and results until the hunt ends the bridge."""
        threading.Thread(target=self._listen, daemon=True).start()
        while not self._closing:
            self.turn()
        with self._lock:
            nodes = list(self._scheduler.nodes.values())
            ready = [node.actor for node in nodes if node.ready]
            self._cluster.close([node.actor for node in nodes], ready, _CLOSE_S)

    def turn(self, wait_s: float = _WAIT_S) -> None:
        """Update the nodes, submit trials, and process answers; wait at most ``wait_s`` for the first answer."""
        with self._lock:
            self._refresh_nodes()
            self._assign_trials()
            for node in self._scheduler.nodes.values():
                if node.ready and node.answer is None:
                    given, node.given = node.given, []
                    self._call_node(node, "take", _TAKE_S, given)
            self._send_figures()
            asked = {node.answer: node for node in self._scheduler.nodes.values() if node.answer is not None}
        if not asked:
            time.sleep(wait_s / 2)
            return
        self._missing = 0
        for answer in self._cluster.answered(list(asked), wait_s):
            with self._lock:
                if asked[answer].answer is answer and not self._closing:
                    self._handle_answer(asked[answer])
        with self._refilled:
            self._refilled.wait_for(lambda: self._missing <= 0, timeout=min(wait_s, _REFILL_S))

    def _listen(self) -> None:
        """Process the messages of the hunt, even while the bridge waits for nodes."""
        received = b""
        try:
            while data := self._control.recv(_CHUNK_BYTES):
                *lines, received = (received + data).split(b"\n")
                with self._lock:
                    for line in lines:
                        self._handle_request(json.loads(line))
                    self._assign_trials()
        finally:
            self._closing = True

    def _handle_request(self, message: ToBridge) -> None:
        if "submit" in message:
            self._scheduler.waiting += [Trial(ticket, spec) for ticket, spec in message["submit"]]
            self._tickets = max([self._tickets, *(ticket + 1 for ticket, _ in message["submit"])])
            self._missing -= len(message["submit"])
        else:
            self._scheduler.cancel(message["cancel"])
            self._missing = 0
            for node in self._scheduler.nodes.values():
                if node.ready:
                    self._cluster.order(node.actor, "cancel", message["cancel"], self._tickets)
        if self._missing <= 0:
            self._refilled.notify()

    def _send(self, **message: Unpack[FromBridge]) -> None:
        self._control.sendall(json.dumps(message).encode() + b"\n")

    def _assign_trials(self) -> None:
        """Submit waiting trials.

        If the bridge calls a node soon anyway, the node receives its trials with that call, because each call costs
        time.
        """
        for node, trials in self._scheduler.assign().items():
            given = [(trial.ticket, trial.spec) for trial in trials]
            if node.answer is None:
                node.given += given
            else:
                self._cluster.order(node.actor, "submit", given)

    def _refresh_nodes(self) -> None:
        """Find new and lost nodes, and prepare the new nodes."""
        if time.monotonic() - self._looked < _LOOK_EVERY_S:
            return
        self._looked = time.monotonic()
        alive = self._cluster.nodes()
        for node in list(self._scheduler.nodes.values()):
            if node.machine not in alive:
                self._drop_node(node)
            elif self._is_too_late(node, alive[node.machine]):
                self._release_actor(node)
        able = {found.id: found for found in alive.values() if found.cpus > 0}
        taken = sum(node.slots for node in self._scheduler.nodes.values())
        free = {found.id: self._room(found) for found in able.values() if found.id not in self._refused}
        wanted = max(0, self._job["parallel"] - taken) if self._job["parallel"] else None
        for machine, slots in shares(free, wanted).items():
            name, now = f"{machine}-{next(self._parts)}", time.monotonic()
            node = Node(
                id=name,
                machine=machine,
                name=able[machine].name,
                slots=slots,
                actor=self._cluster.stand(machine, slots),
                stood=now,
            )
            self._scheduler.nodes[name] = node
            self._call_node(node, "differs", self._job["versions"], self._job["code"])
        if self._scheduler.nodes:
            return
        if able and all(name in self._refused for name in able):
            raise UsageError(
                f"no node of the cluster can run the trials: {next(iter(self._refused.values()))}",
                fix="install the packages of this machine on all nodes, and run the same command again",
            )
        if not self._ever_ready and time.monotonic() - self._began > _FREE_S:
            cpus = sum(found.cpus for found in able.values())
            why = f"none of its {cpus} CPUs is free" if cpus else "none of its nodes has a CPU for work"
            raise UsageError(
                f"the Ray cluster at {self._cluster.address} cannot run trials: {why}",
                fix="wait until other jobs are done, or add a node with 'ray start --address=...'",
            )
        if self._ever_ready and not self._alone:
            self._alone = True
            self._send(note="no node of the cluster is left; the hunt waits until one is back", capacity=0)

    def _room(self, found: ClusterNode) -> int:
        """Return the number of further trials that a machine can run."""
        parts = self._scheduler.parts(found.id)
        if not parts:
            return found.free
        settled = found.free > 0 and all(node.ready for node in parts)
        self._free[found.id] = self._free.get(found.id, 0) + 1 if settled else 0
        return found.free if self._free[found.id] >= _FREE_CPU_READINGS else 0

    def _is_too_late(self, node: Node, found: ClusterNode) -> bool:
        """Return whether an actor has waited too long for its CPUs, for example because another hunt uses them."""
        waited_s = time.monotonic() - node.stood
        if node.doing != "differs" or waited_s < _LOOK_EVERY_S or not self._cluster.waits(node.actor):
            return False
        taken = self._cluster.held(node.machine) + node.slots > found.cpus
        return taken or waited_s > self._patience.get(node.machine, _START_S)

    def _release_actor(self, node: Node) -> None:
        """Cancel an actor that could not be placed; the next actor waits longer."""
        self._patience[node.machine] = 2 * self._patience.get(node.machine, _START_S)
        self._scheduler.lose(node)
        self._cluster.kill(node.actor)
        self._began = time.monotonic()  # Ray takes a moment to say that what it had is free

    def _call_node(self, node: Node, what: str, *arguments: Any) -> None:
        node.doing, node.answer = what, self._cluster.ask(node.actor, what, *arguments)

    def _handle_answer(self, node: Node) -> None:
        """Process the answer of a node, and send its next request."""
        answer, node.answer = node.answer, None
        try:
            said = self._cluster.value(answer)
        except NodeLostError:
            self._drop_node(node)
            return
        except Exception as error:  # of ours, over there
            self._refuse(node, in_words(error))
            return
        if node.doing == "take":
            self._handle_news(node, said)
        elif node.doing == "differs" and said:
            self._refuse(node, said)
        elif node.doing == "differs":
            job: NodeJob = {
                "settings": self._job["settings"],
                "digest": self._digest,
                "folders": self._parcel.folders,
                "home": self._parcel.home,
                "slots": node.slots,
            }
            self._call_node(node, "begin", job, self._cluster.shared(self._parcel.packed))
        elif said == "ready":
            node.ready, node.since, self._ever_ready, self._alone = True, time.monotonic(), True, False
            self._send(capacity=self._scheduler.capacity)
            self._send_figures(now=True)
        else:
            self._refuse(node, said)

    def _handle_news(self, node: Node, news: News) -> None:
        """Forward the events of a node to the hunt."""
        if news.map:
            self._maps[node.id] = news.map
        found = [ended for ended in news.ended if self._scheduler.ended(node, ended.ticket)]
        if found:
            self._losses.pop(node.machine, None)
            self._send_figures(now=self._scheduler.idle)  # before the last result, after which the hunt reads no more
        for ended in found:
            if ended.files:
                self._keep(node, ended)
        self._missing += len(found)
        for note in news.notes:  # before results, too: after the last one the hunt reads no more
            self._send(note=note)
        self._control.sendall(b"".join(ended.line for ended in found))
        if news.where is not None:
            self._send(node=node.id, where=news.where)
        if news.error is not None:
            error = CrashhuntError.from_json(news.error)
            self._refuse(node, f"{error.where}: {error.message}" if error.where else error.message)

    def _keep(self, node: Node, ended: NodeTrial) -> None:
        """Write the files of a kept trial to the folder in which the hunt expects them.

        Raises:
            RecorderError: the disk is full.
        """
        scratch = self._settings.scratch
        folder = scratch_of(scratch, ended.number)
        try:
            unpacked(ended.files, folder)
            common = self._maps.get(node.id)
            if common is not None and not (folder / layout.MAP).exists():
                unpacked({layout.MAP: common}, folder if (scratch / layout.MAP).exists() else scratch)
        except OSError as error:
            raise RecorderError(
                f"the results from {node.name} cannot be written here: {error.strerror or error}",
                fix="free some space and run the same command again",
                where=str(error.filename or ""),
            ) from error

    def _drop_node(self, node: Node) -> None:
        """Stop using a lost node; its trials run again on other nodes."""
        count = len(node.running)
        culprits = self._scheduler.lose(node)
        self._send_figures(now=True)
        self._cluster.kill(node.actor)
        self._losses[node.machine] = 0 if culprits else self._losses.get(node.machine, 0) + 1
        if self._losses[node.machine] >= _MAX_NODE_LOSSES:
            why = f"{node.name}: its process was ended {_MAX_NODE_LOSSES} times before a trial was done"
            if self._job["address"] and not self._ever_ready and os.environ.get("RAY_AUTH_MODE") == "token":
                why += ", as happens with RAY_AUTH_MODE=token here and not on the cluster"
            self._refused[node.machine] = why
            self._send(note=f"node {self._refused[node.machine]}; it takes no part any more")
        elif node.ready:
            again = f" with {count} trial{'s' * (count != 1)}, to be run again" if count and not culprits else ""
            self._send(note=f"node {node.name} was lost{again}")
        self._send(capacity=self._scheduler.capacity, node=node.id, where={})
        for trial in culprits:
            # Nothing shows at which step each node was lost. So the trial is not known to be the cause, as where a
            # pool's process is killed at another step each time.
            why = f"the node on which it ran was lost {trial.losses} times, at last with this trial alone on it"
            result = killed_from_outside(TrialSpec.from_json(trial.spec), why, -signal.SIGKILL)
            self._send(ticket=trial.ticket, result=result.to_json())

    def _refuse(self, node: Node, why: str) -> None:
        """Stop using a node that cannot run trials."""
        self._refused[node.machine] = f"{node.name}: {why}"
        for trial in node.running.values():
            trial.losses -= 1  # it is not to blame
        self._scheduler.lose(node)
        self._send_figures(now=True)
        self._cluster.order(node.actor, "close")
        self._cluster.kill(node.actor, after_s=_CLOSE_S)
        self._looked = 0.0
        self._send(
            note=f"node {node.name} takes no part: {why}", capacity=self._scheduler.capacity, node=node.id, where={}
        )

    def _send_figures(self, *, now: bool = False) -> None:
        if now or time.monotonic() - self._told > _LOOK_EVERY_S:
            self._told = time.monotonic()
            self._send(nodes=[asdict(node) for node in self._scheduler.figures()])
