"""Which Ray cluster is meant, and whether somebody answers there; Ray itself is not imported."""

from __future__ import annotations

import importlib.util
import os
import queue
import secrets
import socket
import threading
from pathlib import Path
from typing import NamedTuple

from crashhunt.base.errors import PluginError, UsageError

__all__ = ["Meant", "answers", "cluster_of", "require_ray"]

_ANSWER_S = 5.0
_START = "start one with 'ray start --head', or give the address of one: --executor ray:HOST:PORT"


class Meant(NamedTuple):
    """The cluster that is meant.

    Attributes:
        address: ``HOST:PORT``; empty for one of the hunt's own.
        environment: variables that Ray needs besides those that there are.
    """

    address: str
    environment: dict[str, str]


def require_ray() -> None:
    """See that Ray is installed.

    Raises:
        PluginError: it is not.
    """
    if importlib.util.find_spec("ray") is None:
        raise PluginError("--executor ray needs Ray, which is not installed", fix="pip install 'crashhunt[ray]'")


def cluster_of(argument: str) -> Meant:
    """Return the cluster that is meant.

    Since 2.59, clusters ask for a token. One of our own is given a new one, instead of one that Ray would leave in the
    home folder. One that runs here is shown what there is; a host that somebody has named is not, as with Ray itself.

    Args:
        argument: ``HOST:PORT``; ``auto`` for one that runs here; ``local`` for one of the hunt's own; empty for one
            that runs here, else one of the hunt's own.

    Raises:
        UsageError: it is none, or nobody answers there.
    """
    wanted = argument if argument not in ("", "auto") else os.environ.get("RAY_ADDRESS", "") or argument
    ours = Meant("", {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)})
    if wanted == "local":
        return ours
    if wanted in ("", "auto"):
        found = _started_here()
        if found and not answers(found):
            return Meant(found, {"RAY_AUTH_MODE": "token"} if "RAY_AUTH_MODE" not in os.environ and _token() else {})
        if wanted == "auto":
            raise UsageError("--executor ray:auto: no Ray cluster runs on this machine", fix=_START)
        return ours
    whence = f"--executor ray:{wanted}" if argument == wanted else f"RAY_ADDRESS={wanted}"
    if wanted.startswith("ray://"):
        raise UsageError(
            f"{whence} is an address of the Ray Client, which a hunt does not use",
            fix="run the hunt on a machine of the cluster, with the address that 'ray start' was given there",
        )
    host, colon, port = wanted.rpartition(":")
    if not colon or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise UsageError(f"{whence} is no address HOST:PORT", fix=f"write --executor ray:{host or wanted}:6379")
    why = answers(wanted)
    if why:
        raise UsageError(f"{whence}: nobody answers there ({why})", fix=_START)
    return Meant(wanted, {})


def answers(address: str) -> str:
    """Return why nobody answers at an address; empty where somebody does, which takes a few seconds at most."""
    host, _, port = address.rpartition(":")
    said: queue.SimpleQueue[str] = queue.SimpleQueue()

    def ask() -> None:
        try:
            with socket.create_connection((host.strip("[]"), int(port)), timeout=_ANSWER_S):
                said.put("")
        except OSError as error:
            said.put(error.strerror or str(error))

    threading.Thread(target=ask, daemon=True).start()  # looking a name up may take longer than anybody waits
    try:
        return said.get(timeout=_ANSWER_S + 1.0)
    except queue.Empty:
        return f"the name {host!r} cannot be looked up in time"


def _token() -> bool:
    """Whether there is a token, where Ray looks for one."""
    named = any(os.environ.get(name) for name in ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"))
    return named or Path("~/.ray/auth_token").expanduser().exists()


def _started_here() -> str:
    """The cluster that was started on this machine last, as Ray writes it down."""
    try:
        folder = Path(os.environ.get("RAY_TMPDIR", "/tmp"))
        return (folder / "ray" / "ray_current_cluster").read_text(encoding="utf-8").strip()
    except OSError:
        return ""
