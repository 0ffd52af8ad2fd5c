"""The part of Ray's interface that a hunt uses: nodes, actors, calls and their answers."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import logging
import os
import queue
import re
import secrets
import socket
import threading
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from crashhunt.base.errors import PluginError, UsageError
from crashhunt.base.extras import install_command
from crashhunt.executors.ray import _node_actor

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


# Find the Ray cluster, and check whether it answers, without an import of Ray.

TOKEN_FIX = "put the token with which the cluster was started into RAY_AUTH_TOKEN, or into ~/.ray/auth_token"
"""The fix if the cluster requires a token."""
OLDEST_RAY_VERSION = (2, 10)
"""The first Ray with which it works, as in pyproject.toml, where the reason is."""
_PROBE_TIMEOUT_S = 5.0
_HTTP2_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])  # and no settings of ours
_FRAME, _KIND, _SETTINGS = (
    9,
    3,
    4,
)  # bytes of a frame's head, the place of its kind there, and the first kind that is sent
_START_FIX = "start a cluster with 'ray start --head', or give the address of a cluster: --executor ray:HOST:PORT"


class Meant(NamedTuple):
    """The cluster that the user has chosen."""

    address: str  # the address ``HOST:PORT`` of the cluster; empty for the hunt's own cluster
    environment: dict[str, str]  # additional environment variables for Ray
    spare: dict[str, str]  # further environment variables for a cluster that requires a token


def require_ray() -> None:
    """Check that Ray is installed in a supported version.

    Raises:
        PluginError: Ray is not installed, or its version is too old.
    """
    spec = importlib.util.find_spec("ray")
    if spec is None or spec.origin is None:  # some folder of that name is none
        raise PluginError("--executor ray needs Ray, which is not installed", fix=install_command("ray"))
    with suppress(importlib.metadata.PackageNotFoundError):
        there_is = importlib.metadata.version("ray")
        found = re.match(r"(\d+)\.(\d+)", there_is)
        if found and (int(found[1]), int(found[2])) < OLDEST_RAY_VERSION:
            oldest = ".".join(map(str, OLDEST_RAY_VERSION))
            raise PluginError(
                f"--executor ray needs Ray {oldest} or newer, and {there_is} is installed",
                fix=f"pip install 'ray>={oldest}', on every machine of the cluster",
            )


def cluster_of(argument: str) -> Meant:
    """Return the cluster that the executor's argument names.

    Clusters may require a token. The hunt's own cluster gets a new token, because Ray would otherwise store a token in
    the home folder. A cluster on this machine receives the existing token, but a cluster on another machine does not,
    as with Ray itself. Whether a token is needed is known only when the hunt joins, because a Ray process with a token
    cannot use a cluster without a token.

    Args:
        argument: the address ``HOST:PORT``; ``auto`` for a cluster that runs on this machine; ``local`` for the hunt's
            own cluster. If the text is empty, a cluster on this machine is used, or else the hunt's own.

    Raises:
        UsageError: the address is invalid, or no cluster answers at the address.
    """
    wanted = argument if argument not in ("", "auto") else os.environ.get("RAY_ADDRESS", "") or argument
    ours = Meant("", {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}, {})
    if wanted == "local":
        return ours
    if wanted in ("", "auto"):
        found = _local_address()
        if found and not silent(found):
            return _connect(found)
        if wanted == "auto":
            raise UsageError("--executor ray:auto: no Ray cluster runs on this machine", fix=_START_FIX)
        return ours
    whence = f"--executor ray:{wanted}" if argument == wanted else f"RAY_ADDRESS={wanted}"
    if "://" in wanted:
        what = "the Ray Client" if wanted.startswith("ray://") else "a service such as Ray's dashboard"
        raise UsageError(
            f"{whence} is an address of {what}, which hunts do not support",
            fix="run the hunt on a machine of the cluster, with the address given to 'ray start'",
        )
    host, colon, port = wanted.rpartition(":")
    if not colon or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise UsageError(f"{whence} is not an address HOST:PORT", fix=f"write --executor ray:{host or wanted}:6379")
    why = silent(wanted)
    if why:
        raise UsageError(f"{whence}: {why}", fix=_START_FIX)
    return _connect(wanted)


def silent(address: str) -> str:
    """Return why no cluster answers at an address; empty if a cluster may answer.

    The check takes a few seconds at most.
    """
    host, _, port = address.rpartition(":")
    said: queue.SimpleQueue[str] = queue.SimpleQueue()

    def ask() -> None:
        try:
            with socket.create_connection((host.strip("[]"), int(port)), timeout=_PROBE_TIMEOUT_S) as connection:
                said.put(_protocol_error(connection))
        except OSError as error:
            said.put(f"no cluster answers there ({error.strerror or error})")
        except UnicodeError:
            said.put("no machine can have that name")

    threading.Thread(target=ask, daemon=True).start()  # looking a name up may take longer than anybody waits
    try:
        return said.get(timeout=_PROBE_TIMEOUT_S + 1.0)
    except queue.Empty:
        return "no cluster answers there in time"


def _protocol_error(connection: socket.socket) -> str:
    """Return why a listening process is not a Ray cluster's head, which uses HTTP/2; empty if it may be the head."""
    if os.environ.get("RAY_USE_TLS", "0") not in ("", "0"):
        return ""
    found = b""
    try:
        connection.sendall(_HTTP2_PREFACE)
        while len(found) < _FRAME and (data := connection.recv(_FRAME - len(found))):
            found += data
    except TimeoutError:
        return "a process listens there and does not answer"
    except OSError:
        pass  # as those do that speak something else
    speaks = len(found) == _FRAME and found[_KIND] == _SETTINGS
    return "" if speaks else "what answers there is not the head of a Ray cluster"


def _connect(address: str) -> Meant:
    """Return a cluster that is already running.

    Raises:
        UsageError: the cluster requires a token, but there is none.
    """
    there_is = any(os.environ.get(name) for name in ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"))
    there_is = there_is or Path("~/.ray/auth_token").expanduser().exists()
    mode = os.environ.get("RAY_AUTH_MODE", "")
    if mode == "token" and not there_is:
        raise UsageError("RAY_AUTH_MODE is token, but there is no token", fix=TOKEN_FIX)
    return Meant(address, {}, {"RAY_AUTH_MODE": "token"} if not mode and there_is and _is_local(address) else {})


def _is_local(address: str) -> bool:
    """Return whether an address belongs to this machine; a process can listen only on such an address."""
    with suppress(OSError):
        kind, *_, place = socket.getaddrinfo(address.rpartition(":")[0].strip("[]"), 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(kind, socket.SOCK_STREAM) as probe:
            probe.bind(place)
            return True
    return False


def _local_address() -> str:
    """Return the address of the last cluster that Ray started on this machine, as recorded by Ray."""
    try:
        folder = Path(os.environ.get("RAY_TMPDIR", "/tmp"))
        return (folder / "ray" / "ray_current_cluster").read_text(encoding="utf-8").strip()
    except OSError:
        return ""


_ANSWER_S = 5.0  # for a head; it takes milliseconds where it is not very busy
_STORE_BYTES = 400 * 10**6  # of a cluster of the hunt's own: room for a parcel; memory is taken when it is used
_ORDERS, _ANSWERS = "orders", "answers"  # calls of one kind run in their order, in parallel to those of the other
_ACTOR_PREFIX = "crashhunt-"  # of actors; what follows is how many CPUs one has
_CONCURRENCY_GROUPS = {"differs": _ANSWERS, "begin": _ANSWERS, "take": _ANSWERS}
_CONCURRENCY_GROUPS |= {"submit": _ORDERS, "cancel": _ORDERS, "close": _ORDERS}


class NodeLostError(Exception):
    """The node was lost, or the actor on it was lost."""


def _job_without_folder() -> Any:
    """Return the configuration of a Ray job whose workers do not search the current folder for modules.

    Ray puts the current folder first on their path, where a numpy.py would run, unless the job brings a folder along.
    """
    from ray.job_config import JobConfig

    class WithoutFolder(JobConfig):  # type: ignore[misc]
        def _runtime_env_has_working_dir(self) -> bool:
            return True

    return WithoutFolder()


class UnreachableError(UsageError):
    """The cluster cannot be reached, either temporarily or permanently."""


class TokenError(UnreachableError):
    """The cluster requires a token."""


@dataclass(frozen=True, slots=True)
class ClusterNode:
    """A node of a Ray cluster."""

    id: str
    name: str
    cpus: int
    free: int


class Cluster:
    """A connection to a Ray cluster; a process can have only one connection.

    Args:
        address: address of the cluster; empty for the hunt's own cluster, which ends with this process.
        cpus: number of CPUs of the hunt's own cluster.
        temporary: folder for the files of the hunt's own cluster.

    Raises:
        UnreachableError: the cluster cannot be used.
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
            _check_protocol(address)
        try:
            ray.init(address=address or "local", job_config=_job_without_folder(), **options)
        except Exception as error:
            raise UnreachableError(
                f"the Ray cluster at {self.address} cannot be used: {_first_line(error)}",
                fix="run the hunt on a machine that has the same versions of Ray and Python as the cluster",
            ) from error
        cloudpickle.register_pickle_by_value(_node_actor)
        for method, group in _CONCURRENCY_GROUPS.items():
            ray.method(concurrency_group=group)(getattr(_node_actor.Site, method))
        groups = {_ORDERS: 1, _ANSWERS: 1}
        # Without Ray's events of every call, which crashhunt does not use, a call costs a tenth less.
        kind = ray.remote(concurrency_groups=groups, max_restarts=0, max_task_retries=0, enable_task_events=False)
        self._kind: Any = kind(_node_actor.Site)
        self._shared: Any = None

    def nodes(self) -> dict[str, ClusterNode]:
        """Return the present nodes of the cluster.

        Raises:
            UnreachableError: the cluster does not answer.
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
            found[name] = ClusterNode(
                id=name, name=shown, cpus=cpus, free=min(cpus, int(free.get(name, {}).get("CPU", 0)))
            )
        return found

    def stand(self, node: str, slots: int) -> Any:
        """Start an actor on a node; ``slots`` is the number of the node's CPUs that the actor uses."""
        strategy = self._affinity(node_id=node, soft=False)
        name = f"{_ACTOR_PREFIX}{slots}-{secrets.token_hex(8)}"
        return self._kind.options(num_cpus=slots, scheduling_strategy=strategy, name=name).remote()

    def held(self, node: str) -> int:
        """Return the number of CPUs of a node that actors of any hunt use."""
        from ray._private.state import actors

        found = 0
        with suppress(Exception):
            for actor in actors(actor_state_name="ALIVE").values():
                name = actor.get("Name") or ""
                if name.startswith(_ACTOR_PREFIX) and actor["Address"]["NodeID"] == node:
                    found += int(name.removeprefix(_ACTOR_PREFIX).partition("-")[0])
        return found

    def waits(self, actor: Any) -> bool:
        """Return whether an actor is still waiting for its CPUs or for the start of its process."""
        from ray._private.state import actors  # of which there is no public form

        with suppress(Exception):
            found = actors(actor._actor_id.hex())
            return bool(found) and not (found.get("Address") or {}).get("IPAddress")
        return False

    def ask(self, actor: Any, what: str, *arguments: Any) -> Any:
        """Call a method of an actor; return a reference to its answer."""
        return getattr(actor, what).remote(*arguments)

    def order(self, actor: Any, what: str, *arguments: Any) -> Any:
        """Call a method without an answer; such calls run one after another."""
        return getattr(actor, what).remote(*arguments)

    def answered(self, answers: Sequence[Any], wait_s: float) -> list[Any]:
        """Return the answers that have arrived; wait at most ``wait_s`` for the first one."""
        ready, rest = self._ray.wait(list(answers), num_returns=1, timeout=wait_s)
        more, _ = self._ray.wait(rest, num_returns=len(rest), timeout=0) if ready and rest else ([], [])
        return [*ready, *more]

    def value(self, answer: Any) -> Any:
        """Return the value of an answer that has arrived.

        Raises:
            Lost: the actor that was called is lost.
            Exception: the method raised this exception.
        """
        from ray import exceptions

        try:
            return self._ray.get(answer)
        except exceptions.RayTaskError as error:
            raise error.cause if isinstance(error.cause, Exception) else error from None
        except exceptions.RayError as error:
            raise NodeLostError(str(error)) from None

    def shared(self, make: Callable[[], bytes]) -> Any:
        """Return an object that can be sent to all nodes; ``make`` creates it at the first use."""
        if self._shared is None:
            self._shared = self._ray.put(make())
        return self._shared

    def kill(self, actor: Any, *, after_s: float = 0.0) -> None:
        """End an actor, if it is still running."""
        if after_s:
            timer = threading.Timer(after_s, self.kill, [actor])
            timer.daemon = True
            timer.start()
            return
        with suppress(Exception):
            self._ray.kill(actor, no_restart=True)

    def close(self, actors: Sequence[Any], ready: Sequence[Any], wait_s: float) -> None:
        """Let the ready actors finish their work, then end all actors.

        Args:
            actors: all actors that were started.
            ready: the actors that run trials.
            wait_s: time in which the ready actors may finish their work, in s.
        """
        with suppress(Exception):
            closed = [self.order(actor, "close") for actor in ready]
            self._ray.wait(closed, num_returns=len(closed), timeout=wait_s)
        for actor in actors:
            self.kill(actor)
        time.sleep(0.05)  # for the last of these to be on its way


def _check_protocol(address: str) -> None:
    """Check that a cluster answers. Ray itself would wait very long for an answer.

    Raises:
        UnreachableError: the cluster does not answer.
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
            f"the Ray cluster at {address} {'expects another token' if shown else 'needs a token'}",
            fix=TOKEN_FIX if shown else f"set RAY_AUTH_MODE=token, and {TOKEN_FIX}",
        )
    raise UnreachableError(
        f"the server at {address} is not the head of a Ray cluster: {_first_line(error)}",
        fix="give the address that 'ray start --head' has printed; its port is 6379 unless another was chosen",
    )


def _first_line(error: Exception) -> str:
    """Return the message of an error of Ray in one line."""
    return " ".join(str(error).split()).rstrip(":") or type(error).__name__
