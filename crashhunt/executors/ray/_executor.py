"""Runs trials on all machines of a Ray cluster; this part runs in the process of the hunt."""

from __future__ import annotations

import itertools
import json
import os
import platform
import select
import socket
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.reaper import Kept
from crashhunt.executors._protocol import NodeFigures, Notes
from crashhunt.executors.ray._cluster import cluster_of, require_ray, silent
from crashhunt.executors.ray._code_archive import CodeArchive, Folder
from crashhunt.executors.ray._node_actor import code_digest
from crashhunt.recording import BlackBoxHeader, Phase
from crashhunt.scenario import FIXED_LOAD_ORDER, load_order_of
from crashhunt.snapshots import versions
from crashhunt.trial import TrialResult

if TYPE_CHECKING:
    from collections.abc import Iterator

    from crashhunt.episode import WorkerSettings
    from crashhunt.executors.ray._messages import BridgeJob, FromBridge, ToBridge
    from crashhunt.trial import TrialSpec

_CHUNK_BYTES = 1 << 18  # bytes at a time
_CLOSE_S = 3.0  # for the bridge to end what runs on the nodes
_RETRY_S = 3.0  # between looks whether a cluster that was lost is back
_MAX_CLUSTER_LOSSES = 3  # of a cluster of the hunt's own, without a trial between
_numbers = itertools.count()


class RayExecutor:
    """Runs trials on all machines of a Ray cluster, with a separate pool on each machine.

    A separate process, the bridge (``_bridge.py``), uses Ray and may be lost. Every submitted trial without a result
    is then submitted again to the next bridge.

    Args:
        settings: settings of the hunt.
        parallel: number of trials at a time in the whole cluster; 0 for all CPUs of the cluster, including CPUs that
            are added later.
        argument: argument of ``--executor ray:ADDRESS``, as for `cluster_of`.

    Raises:
        PluginError: Ray is not installed.
        UsageError: no cluster answers at the address, or the code is too large to send.
    """

    sizes_itself: ClassVar[bool] = True

    def __init__(self, settings: WorkerSettings, *, parallel: int = 0, argument: str = "") -> None:
        require_ray()
        self._address, self._environment, self._spare = cluster_of(argument)
        CodeArchive.of(settings)
        self._settings = settings
        self._parallel = parallel
        self._slots: int | None = None
        self._tickets = itertools.count()
        self._open: dict[int, TrialSpec] = {}  # ticket to trial
        self._where: dict[str, dict[int, BlackBoxHeader]] = {}
        self._nodes: list[NodeFigures] = []
        self._notes = Notes(settings.scratch)
        self._found: list[TrialResult] = []
        self._losses = 0
        self._lost_at = 0.0
        self._ever_up = False
        self._closed = False
        self._folder: Folder | None = None
        self._kept: Kept | None = None
        self._control: socket.socket | None = None
        self._log = Path()
        self._received = bytearray()
        self._start()

    @property
    def capacity(self) -> int:
        """The number of trials that run at a time, at least 1; without nodes, the hunt waits."""
        return max(1, self._parallel if self._slots is None else self._slots)

    def submit(self, spec: TrialSpec) -> None:
        """Queue a trial."""
        ticket = next(self._tickets)
        self._open[ticket] = spec
        self._send({"submit": [(ticket, spec.to_json())]})

    def completed(self, timeout_s: float) -> Iterator[TrialResult]:
        """Yield the trials that have ended; wait at most ``timeout_s`` for the first one.

        Raises:
            CrashhuntError: no node can run trials.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            self._receive(max(0.0, deadline - time.monotonic()))
            found, self._found = self._found, []
            yield from found
            if found or time.monotonic() >= deadline:
                return

    def cancel(self, *, above: int = -1) -> None:
        """Cancel all trials whose number is greater than ``above``, at once."""
        self._open = {ticket: spec for ticket, spec in self._open.items() if spec.number <= above}
        self._found = [result for result in self._found if result.spec.number <= above]
        self._send({"cancel": above})

    def where(self) -> dict[int, BlackBoxHeader]:
        """Return the progress of running trials half a second ago, for the status screen."""
        running = {spec.number for spec in self._open.values()}
        found = [pair for headers in self._where.values() for pair in headers.items()]
        return {number: header for number, header in found if number in running}

    def nodes(self) -> list[NodeFigures]:
        """Return the nodes that currently run trials."""
        return self._nodes

    def notes(self) -> list[str]:
        """Return new notices for the user."""
        return self._notes.fresh()

    def close(self) -> None:
        """End all processes on every node, and the hunt's own cluster."""
        if self._closed:
            return
        self._closed = True
        self._open.clear()
        if self._control is not None and self._kept is not None:
            with suppress(OSError):
                self._control.shutdown(socket.SHUT_RDWR)
            with suppress(subprocess.TimeoutExpired):
                self._kept.process.wait(_CLOSE_S)
        self._end()

    def _load_order(self) -> dict[str, str]:
        """Return the library that fixes the link order; a node must have the same library."""
        if load_order_of(self._settings.scenario) != FIXED_LOAD_ORDER:
            return {}
        return {"_crashhunt_link_order": "installed"}

    def _start(self) -> None:
        """Start a bridge, and submit all trials without a result to it."""
        number = next(_numbers)
        scratch = self._settings.scratch
        job, self._log = scratch / f"ray-{number}.json", scratch / f"ray-{number}.log"
        self._folder = None if self._address else Folder()
        content: BridgeJob = {
            "settings": self._settings.to_json(),
            "parallel": self._parallel,
            "address": self._address,
            "cpus": self._parallel or len(os.sched_getaffinity(0)),
            "temporary": None if self._folder is None else str(self._folder.path),
            "versions": {"machine": platform.machine(), **versions(), **self._load_order()},
            "code": code_digest(),
            "resumed": self._ever_up,
        }
        job.write_text(json.dumps(content), encoding="utf-8")
        self._control, theirs = socket.socketpair()
        with theirs, self._log.open("wb") as log:
            self._kept = Kept(
                "crashhunt.executors.ray._bridge",
                [str(theirs.fileno()), str(job)],
                environment={**os.environ, **_RAY_ENVIRONMENT, **self._environment},
                inherited=[theirs.fileno(), *([] if self._folder is None else [self._folder.fileno()])],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
        self._received.clear()
        self._send({"submit": [(ticket, spec.to_json()) for ticket, spec in self._open.items()]})

    def _send(self, message: ToBridge) -> None:
        """Send a message to the bridge; while the bridge does not read, receive its messages."""
        if self._control is None:
            return
        left = memoryview(json.dumps(message).encode() + b"\n")
        with suppress(OSError):  # it is gone, which shows when it is listened to
            while left:
                with suppress(BlockingIOError):
                    left = left[self._control.send(left, socket.MSG_DONTWAIT) :]
                    continue
                readable, _, _ = select.select([self._control], [self._control], [])
                if readable and not self._read_bridge(self._control):
                    return

    def _receive(self, wait_s: float) -> None:
        """Receive messages of the bridge; wait at most ``wait_s`` for the first message."""
        if self._control is None:
            if self._closed or not self._record_return():
                time.sleep(wait_s)
            return
        heard = b"\n" in self._received  # while something was sent
        if not heard and not select.select([self._control], [], [], wait_s)[0]:
            return
        is_there = heard or self._read_bridge(self._control)
        *lines, rest = bytes(self._received).split(b"\n")
        self._received = bytearray(rest)
        for line in lines:
            self._handle_message(json.loads(line))
        if not is_there and self._control is not None:
            self._record_loss()

    def _read_bridge(self, control: socket.socket) -> bool:
        """Process the received messages; return whether the bridge is still connected."""
        try:
            data = control.recv(_CHUNK_BYTES)
        except OSError:
            data = b""
        self._received += data
        return bool(data)

    def _handle_message(self, message: FromBridge) -> None:
        if "result" in message:
            if self._open.pop(message["ticket"], None) is not None:
                self._found.append(TrialResult.from_json(message["result"]))
                self._losses = 0
            return
        if "error" in message:
            error = CrashhuntError.from_json({"error": message["error"]})
            if message["token"] and self._spare:
                self._environment, self._spare = {**self._environment, **self._spare}, {}
                self._end()
                self._start()
                return
            if not message["passing"] or not self._ever_up or not self._address:
                raise error
            self._record_loss(error.message)
            return
        if "capacity" in message:
            self._slots = message["capacity"]
            self._ever_up = self._ever_up or bool(self._slots)
        if "note" in message:
            self._notes.add(message["note"])
        if "nodes" in message:
            self._nodes = [NodeFigures(**figures) for figures in message["nodes"]]
        if "where" in message:
            self._where[message["node"]] = {
                int(number): BlackBoxHeader(
                    pid=pid,
                    trial=trial,
                    started=started,
                    committed=committed,
                    step=step,
                    phase=Phase(phase),
                    agent=agent,
                )
                for number, (pid, trial, started, committed, step, phase, agent) in message["where"].items()
            }

    def _record_loss(self, why: str = "") -> None:
        """Handle the loss of the bridge, and of the cluster or the connection to it.

        Raises:
            CrashhuntError: the bridge has never worked, or the hunt's own cluster has ended too often.
        """
        self._end()
        self._slots, self._lost_at = 0, time.monotonic()
        self._where.clear()
        self._nodes = []
        self._losses += 1
        if not self._ever_up or (not self._address and self._losses >= _MAX_CLUSTER_LOSSES):
            lines = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
            raise CrashhuntError(
                f"Ray has ended unexpectedly{f': {lines[-1]}' if lines else ''}",
                fix="raise the limits on memory (ulimit -v) and processes (ulimit -u), and run the same command again",
            )
        self._notes.add(f"the Ray cluster was lost{f' ({why})' if why else ''}; the hunt waits until it is back")

    def _record_return(self) -> bool:
        """Return whether a lost cluster answers again, so that the hunt can resume on it."""
        if time.monotonic() - self._lost_at < (_RETRY_S if self._address else 0.0):
            return False
        self._lost_at = time.monotonic()
        if self._address and silent(self._address):
            return False
        self._start()
        return True

    def _end(self) -> None:
        if self._kept is not None:
            self._kept.end()
            self._kept = None
        if self._control is not None:
            self._control.close()
            self._control = None
        if self._folder is not None:
            self._folder.remove()
            self._folder = None


# Nothing goes to the makers of Ray, and it gives a lost head up soon: the hunt looks for it again.
_RAY_ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_gcs_rpc_server_reconnect_timeout_s": "10",
    "RAY_NUM_REDIS_GET_RETRIES": "5",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "PYTHONUNBUFFERED": "1",
}
