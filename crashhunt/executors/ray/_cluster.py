"""Ray itself, as far as a hunt needs it: which nodes there are, actors on them, calls and their answers."""

from __future__ import annotations

import logging
import os
import queue
import secrets
import threading
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from crashhunt.base.errors import UsageError
from crashhunt.executors.ray import _site
from crashhunt.executors.ray._address import TOKEN

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from crashhunt.executors.ray._roster import Node

__all__ = ["Cluster", "Found", "Lost", "TokenError", "UnreachableError"]

_ANSWER_S = 5.0  # for a head; it takes milliseconds where it is not very busy
_STORE_BYTES = 400 * 10**6  # of a cluster of the hunt's own: room for a parcel; memory is taken when it is used
_ORDERS, _ANSWERS = "orders", "answers"  # calls of one kind run in their order, beside those of the other
_NAME = "crashhunt-"  # of actors; what follows is how many CPUs one has
_GROUPS = {"differs": _ANSWERS, "begin": _ANSWERS, "deliver": _ANSWERS, "take": _ANSWERS}
_GROUPS |= {"submit": _ORDERS, "cancel": _ORDERS, "close": _ORDERS}


class Lost(Exception):  # noqa: N818 - it is no fault
    """The node, or the actor on it, is gone."""


class UnreachableError(UsageError):
    """The cluster cannot be reached, now or at all."""


class TokenError(UnreachableError):
    """The cluster asks for a token."""


@dataclass(frozen=True, slots=True)
class Found:
    """A node of a cluster.

    Args:
        id: Ray's.
        name: for people.
        cpus: for work.
        free: those that nobody has taken.
    """

    id: str
    name: str
    cpus: int
    free: int


class Cluster:
    """A connection to a cluster, of which a process has one.

    Args:
        address: of it; empty for one of our own, which ends with this process.
        cpus: of one of our own.
        temporary: the folder for files of one of our own.

    Raises:
        UnreachableError: it cannot be used.
    """

    def __init__(self, address: str, *, cpus: int, temporary: str | None) -> None:
        import ray
        from ray import cloudpickle
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        self._ray = ray
        self._affinity = NodeAffinitySchedulingStrategy
        self.address = address or "this machine"
        os.environ.pop("RAY_ADDRESS", None)  # which was looked at before
        options: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False, "configure_logging": False}
        if not address:
            options |= {"num_cpus": cpus, "include_dashboard": False, "_temp_dir": temporary}
            options |= {"object_store_memory": _STORE_BYTES}
        else:
            _greet(address)
        try:
            ray.init(address=address or "local", **options)
        except Exception as error:
            raise UnreachableError(
                f"the Ray cluster at {self.address} cannot be used: {_in_short(error)}",
                fix="run the hunt on a machine of the cluster that has its versions of Ray and Python",
            ) from error
        cloudpickle.register_pickle_by_value(_site)
        for method, group in _GROUPS.items():
            ray.method(concurrency_group=group)(getattr(_site.Site, method))
        groups = {_ORDERS: 1, _ANSWERS: 1}
        # Nobody looks at what Ray would note of every call; that it does not costs a tenth less.
        kind = ray.remote(concurrency_groups=groups, max_restarts=0, max_task_retries=0, enable_task_events=False)
        self._kind: Any = kind(_site.Site)
        self._shared: Any = None

    def nodes(self) -> dict[str, Found]:
        """Return the nodes that are there now.

        Raises:
            UnreachableError: the cluster does not say.
        """
        from ray._private.state import available_resources_per_node  # of which there is no public form

        try:
            alive = [node for node in self._ray.nodes() if node["Alive"]]
            free = available_resources_per_node()
        except Exception as error:
            raise UnreachableError(f"the Ray cluster at {self.address} does not answer: {error}") from error
        hosts = Counter(node["NodeManagerHostname"] for node in alive)
        found = {}
        for node in alive:
            name, host = node["NodeID"], node["NodeManagerHostname"]
            shown = host if hosts[host] == 1 else f"{host}-{name[:6]}"
            cpus = int(node["Resources"].get("CPU", 0))
            found[name] = Found(name, shown, cpus, min(cpus, int(free.get(name, {}).get("CPU", 0))))
        return found

    def stand(self, node: str, slots: int) -> Any:
        """Have an actor stand on a node, which takes so many of its CPUs."""
        strategy = self._affinity(node_id=node, soft=False)
        name = f"{_NAME}{slots}-{secrets.token_hex(8)}"
        return self._kind.options(num_cpus=slots, scheduling_strategy=strategy, name=name).remote()

    def held(self, node: str) -> int:
        """Return how many CPUs of a node hunts have, this one or others, whose actors stand there."""
        from ray._private.state import actors

        found = 0
        with suppress(Exception):
            for actor in actors(actor_state_name="ALIVE").values():
                name = actor.get("Name") or ""
                if name.startswith(_NAME) and actor["Address"]["NodeID"] == node:
                    found += int(name.removeprefix(_NAME).partition("-")[0])
        return found

    def waits(self, actor: Any) -> bool:
        """Whether an actor stands nowhere yet: somebody else has the CPUs, or its process takes long to start."""
        from ray._private.state import actors  # of which there is no public form

        with suppress(Exception):
            found = actors(actor._actor_id.hex())
            return bool(found) and not (found.get("Address") or {}).get("IPAddress")
        return False

    def ask(self, actor: Any, what: str, *arguments: Any) -> Any:
        """Call a method of an actor; return where its answer will be."""
        return getattr(actor, what).remote(*arguments)

    def order(self, actor: Any, what: str, *arguments: Any) -> Any:
        """Call one whose answer says nothing; orders are carried out one after another."""
        return getattr(actor, what).remote(*arguments)

    def answered(self, answers: Sequence[Any], wait_s: float) -> list[Any]:
        """Return the answers that are there, waiting so long for a first one."""
        ready, rest = self._ray.wait(list(answers), num_returns=1, timeout=wait_s)
        more, _ = self._ray.wait(rest, num_returns=len(rest), timeout=0) if ready and rest else ([], [])
        return [*ready, *more]

    def value(self, answer: Any) -> Any:
        """Return an answer that is there.

        Raises:
            Lost: the one who was asked is gone.
            Exception: what it raised.
        """
        from ray import exceptions

        try:
            return self._ray.get(answer)
        except exceptions.RayTaskError as error:
            raise error.cause if isinstance(error.cause, Exception) else error from None
        except exceptions.RayError as error:
            raise Lost(str(error)) from None

    def shared(self, make: Callable[[], bytes]) -> Any:
        """Return what all nodes can be sent, made when the first one needs it."""
        if self._shared is None:
            self._shared = self._ray.put(make())
        return self._shared

    def kill(self, actor: Any, *, after_s: float = 0.0) -> None:
        """End an actor, where it is still there."""
        if after_s:
            timer = threading.Timer(after_s, self.kill, [actor])
            timer.daemon = True
            timer.start()
            return
        with suppress(Exception):
            self._ray.kill(actor, no_restart=True)

    def close(self, actors: Sequence[Any], ready: Sequence[Node], wait_s: float) -> None:
        """Have nodes end what they do, and leave."""
        with suppress(Exception):
            closed = [self.order(node.actor, "close") for node in ready]
            self._ray.wait(closed, num_returns=len(closed), timeout=wait_s)
        for actor in actors:
            self.kill(actor)
        time.sleep(0.05)  # for the last of these to be on its way


def _greet(address: str) -> None:
    """See that a cluster answers, which Ray itself takes very long to doubt.

    Raises:
        UnreachableError: it does not.
    """
    from ray._raylet import GcsClient  # type: ignore[attr-defined]  # of which there is no public form

    said: queue.SimpleQueue[Exception | None] = queue.SimpleQueue()

    def ask() -> None:
        try:
            GcsClient(address=address)
            said.put(None)
        except Exception as error:
            said.put(error)

    threading.Thread(target=ask, daemon=True).start()
    try:
        error = said.get(timeout=_ANSWER_S)
    except queue.Empty:
        error = TimeoutError("it does not answer in time")
    if error is None:
        return
    if type(error).__name__ == "AuthenticationError":  # which older ones lack, as they lack tokens
        shown = os.environ.get("RAY_AUTH_MODE") == "token"
        raise TokenError(
            f"the Ray cluster at {address} {'takes another token than this one' if shown else 'asks for a token'}",
            fix=TOKEN if shown else f"set RAY_AUTH_MODE=token, and {TOKEN}",
        )
    raise UnreachableError(
        f"what answers at {address} is not the head of a Ray cluster: {_in_short(error)}",
        fix="give the address that 'ray start --head' has printed; its port is 6379 unless another was chosen",
    )


def _in_short(error: Exception) -> str:
    """What an error of Ray's says, in one line."""
    return " ".join(str(error).split()).rstrip(":") or type(error).__name__
