"""Which Ray cluster is meant, and whether somebody answers there; Ray itself is not imported."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import queue
import re
import secrets
import socket
import threading
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from crashhunt.base.errors import PluginError, UsageError

__all__ = ["OLDEST", "TOKEN", "Meant", "cluster_of", "require_ray", "silent"]

TOKEN = "put the one that the cluster was started with into RAY_AUTH_TOKEN, or into ~/.ray/auth_token"
"""What to do about a token that is asked for."""
OLDEST = (2, 10)
"""The first Ray with which it works, as in pyproject.toml, where the reason is."""
_ANSWER_S = 5.0
_HELLO = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])  # and no settings of ours
_FRAME, _KIND, _SETTINGS = (
    9,
    3,
    4,
)  # bytes of a frame's head, the place of its kind there, and the first kind that is sent
_START = "start one with 'ray start --head', or give the address of one: --executor ray:HOST:PORT"


class Meant(NamedTuple):
    """The cluster that is meant.

    Attributes:
        address: ``HOST:PORT``; empty for one of the hunt's own.
        environment: variables that Ray needs besides those that there are.
        spare: more of them, for a cluster that turns out to ask for a token.
    """

    address: str
    environment: dict[str, str]
    spare: dict[str, str]


def require_ray() -> None:
    """See that Ray is installed, and not too old.

    Raises:
        PluginError: it is not, or it is.
    """
    spec = importlib.util.find_spec("ray")
    if spec is None or spec.origin is None:  # some folder of that name is none
        raise PluginError("--executor ray needs Ray, which is not installed", fix="pip install 'crashhunt[ray]'")
    with suppress(importlib.metadata.PackageNotFoundError):
        there_is = importlib.metadata.version("ray")
        found = re.match(r"(\d+)\.(\d+)", there_is)
        if found and (int(found[1]), int(found[2])) < OLDEST:
            oldest = ".".join(map(str, OLDEST))
            raise PluginError(
                f"--executor ray needs Ray {oldest} or newer, and {there_is} is installed",
                fix=f"pip install 'ray>={oldest}', on every machine of the cluster",
            )


def cluster_of(argument: str) -> Meant:
    """Return the cluster that is meant.

    Clusters may ask for a token. One of our own is given a new one, instead of one that Ray would leave in the home
    folder. One that runs here and asks is shown what there is; another machine is not, as with Ray itself. Whether one
    asks shows when it is joined: a process of Ray's that has a token does not speak to a cluster without.

    Args:
        argument: ``HOST:PORT``; ``auto`` for one that runs here; ``local`` for one of the hunt's own; empty for one
            that runs here, else one of the hunt's own.

    Raises:
        UsageError: it is none, or nobody answers there.
    """
    wanted = argument if argument not in ("", "auto") else os.environ.get("RAY_ADDRESS", "") or argument
    ours = Meant("", {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}, {})
    if wanted == "local":
        return ours
    if wanted in ("", "auto"):
        found = _started_here()
        if found and not silent(found):
            return _joined(found)
        if wanted == "auto":
            raise UsageError("--executor ray:auto: no Ray cluster runs on this machine", fix=_START)
        return ours
    whence = f"--executor ray:{wanted}" if argument == wanted else f"RAY_ADDRESS={wanted}"
    if "://" in wanted:
        what = "the Ray Client" if wanted.startswith("ray://") else "a service such as Ray's dashboard"
        raise UsageError(
            f"{whence} is an address of {what}, which a hunt does not use",
            fix="run the hunt on a machine of the cluster, with the address that 'ray start' was given there",
        )
    host, colon, port = wanted.rpartition(":")
    if not colon or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise UsageError(f"{whence} is no address HOST:PORT", fix=f"write --executor ray:{host or wanted}:6379")
    why = silent(wanted)
    if why:
        raise UsageError(f"{whence}: {why}", fix=_START)
    return _joined(wanted)


def silent(address: str) -> str:
    """Return why no cluster answers at an address; empty where one may, which takes a few seconds at most."""
    host, _, port = address.rpartition(":")
    said: queue.SimpleQueue[str] = queue.SimpleQueue()

    def ask() -> None:
        try:
            with socket.create_connection((host.strip("[]"), int(port)), timeout=_ANSWER_S) as connection:
                said.put(_greeting(connection))
        except OSError as error:
            said.put(f"nobody answers there ({error.strerror or error})")
        except UnicodeError:
            said.put("no machine can have that name")

    threading.Thread(target=ask, daemon=True).start()  # looking a name up may take longer than anybody waits
    try:
        return said.get(timeout=_ANSWER_S + 1.0)
    except queue.Empty:
        return "nobody answers there in time"


def _greeting(connection: socket.socket) -> str:
    """Why whoever listens is no head of Ray, which speaks HTTP/2; empty where it may be one."""
    if os.environ.get("RAY_USE_TLS", "0") not in ("", "0"):
        return ""
    found = b""
    try:
        connection.sendall(_HELLO)
        while len(found) < _FRAME and (data := connection.recv(_FRAME - len(found))):
            found += data
    except TimeoutError:
        return "somebody listens there and does not answer"
    except OSError:
        pass  # as those do that speak something else
    speaks = len(found) == _FRAME and found[_KIND] == _SETTINGS
    return "" if speaks else "what answers there is not the head of a Ray cluster"


def _joined(address: str) -> Meant:
    """A cluster that runs already.

    Raises:
        UsageError: Ray is to show a token, and there is none.
    """
    there_is = any(os.environ.get(name) for name in ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"))
    there_is = there_is or Path("~/.ray/auth_token").expanduser().exists()
    mode = os.environ.get("RAY_AUTH_MODE", "")
    if mode == "token" and not there_is:
        raise UsageError("RAY_AUTH_MODE=token, and there is no token", fix=TOKEN)
    return Meant(address, {}, {"RAY_AUTH_MODE": "token"} if not mode and there_is and _here(address) else {})


def _here(address: str) -> bool:
    """Whether an address is one of this machine: only then somebody can listen there."""
    with suppress(OSError):
        kind, *_, place = socket.getaddrinfo(address.rpartition(":")[0].strip("[]"), 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(kind, socket.SOCK_STREAM) as probe:
            probe.bind(place)
            return True
    return False


def _started_here() -> str:
    """The cluster that was started on this machine last, as Ray writes it down."""
    try:
        folder = Path(os.environ.get("RAY_TMPDIR", "/tmp"))
        return (folder / "ray" / "ray_current_cluster").read_text(encoding="utf-8").strip()
    except OSError:
        return ""
