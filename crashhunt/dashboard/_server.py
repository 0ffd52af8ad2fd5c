"""Runs the server of the dashboard until Ctrl-C."""

from __future__ import annotations

import errno
import importlib.util
import os
import secrets
import socket
import sys
import threading
import webbrowser
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING
from urllib.parse import quote

from crashhunt.base.errors import UsageError
from crashhunt.base.extras import install_command
from crashhunt.base.text import near_path

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

_EXTRA_LIBRARIES = ("starlette", "uvicorn", "plotly")
_MAX_TRIED_PORTS = 100


@dataclass(frozen=True, slots=True)
class Address:
    """The address at which a browser reaches the dashboard."""

    host: str
    port: int
    token: str = ""

    @property
    def url(self) -> str:
        """The link that opens the dashboard."""
        host = {"0.0.0.0": socket.gethostname(), "::": socket.gethostname()}.get(self.host, self.host)
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.port}/" + (f"?token={quote(self.token, safe='')}" if self.token else "")


def serve(
    paths: Sequence[Path],
    *,
    host: str = "127.0.0.1",
    port: int = 8642,
    token: str = "",
    browser: bool = True,
    allow_control: bool = False,
    announce: Callable[[Address], None],
) -> None:
    """Serve the dashboard until the user interrupts.

    Args:
        paths: hunts, suites, folders with hunts below them, or files that ``crashhunt export`` wrote.
        host: host to listen on.
        port: port to listen on; 0 for any free port.
        token: token that requests need; if it is empty and the host is not a loopback address, a random token is used.
        browser: whether to open a browser, if one is available.
        allow_control: whether the page may stop hunts and start commands.
        announce: function called with the address as soon as the dashboard can be opened.

    Raises:
        UsageError: a path does not exist, the port is in use, the token is too short, or the extra is not installed.
    """
    if missing := _missing():
        raise UsageError(f"the dashboard needs {', '.join(missing)}", fix=f"run {install_command('dashboard')}")
    from crashhunt.dashboard._application import make_application
    from crashhunt.dashboard._catalog import Catalog
    from crashhunt.dashboard._security import MIN_TOKEN, is_loopback
    from crashhunt.dashboard._serving import run_server

    if token and (len(token) < MIN_TOKEN or not (token.isascii() and token.isprintable() and " " not in token)):
        raise UsageError(
            f"--token has {len(token)} characters (allowed: at least {MIN_TOKEN}, printable ASCII without spaces)",
            fix="give a longer token, or omit --token for a random one",
        )
    if not token and not is_loopback(host):
        token = secrets.token_urlsafe(24)
    with ExitStack() as opened:
        folders, exported = _roots(paths, opened)
        listening = opened.enter_context(_listen(host, port))
        address = Address(host, listening.getsockname()[1], token)
        application = make_application(Catalog(folders, exported), host=host, token=token, allow_control=allow_control)
        opened.callback(application.close)
        run_server(application.asgi, listening, lambda: _begin(address, announce, browser=browser))


def has_dashboard() -> bool:
    """Return whether the packages of the dashboard are installed, without importing them."""
    return not _missing()


def _missing() -> list[str]:
    return [name for name in _EXTRA_LIBRARIES if importlib.util.find_spec(name) is None]


def _begin(address: Address, announce: Callable[[Address], None], *, browser: bool) -> None:
    announce(address)
    if browser and _has_screen():
        # In a thread of its own, because a browser may take seconds to start.
        threading.Thread(target=_open, args=(address.url,), daemon=True).start()


def _open(url: str) -> None:
    with suppress(webbrowser.Error, OSError):
        webbrowser.open(url)


def _has_screen() -> bool:
    """Return whether a browser with a window can be opened; a browser in the terminal would occupy the terminal."""
    return sys.platform == "darwin" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _roots(paths: Sequence[Path], opened: ExitStack) -> tuple[list[Path], dict[str, Path]]:
    """Return the folders to search, and the folders of unpacked exports by the name of the exported file."""
    folders: list[Path] = []
    exported: dict[str, Path] = {}
    for path in paths:
        if path.is_dir():
            folders.append(path)
        elif path.is_file():
            from crashhunt.crashes import open_archive

            exported[path.name] = opened.enter_context(open_archive(path)).directory
        else:
            raise UsageError(
                f"{str(path)!r} does not exist",
                fix=f"{near_path(path, '.zip')}give a folder of hunts, or a file that crashhunt export wrote",
            )
    return folders, exported


def _listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens on a host and a port.

    Raises:
        UsageError: the port is in use, not allowed or out of range, or the host is not a host of this machine.
    """
    if not 0 <= port < 65536:
        raise UsageError(f"--port is {port} (allowed: 0 to 65535)", fix="give a port in that range")
    try:
        family, _, _, _, target = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    except (OSError, UnicodeError) as error:
        raise UsageError(f"--host {host!r} is not known ({error})", fix="give an address of this machine") from None
    try:
        return _bound(family, target)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            free = _next_free(family, target)
            fix = f"give --port {free}, which is free" if free else "give another --port"
            raise UsageError(f"port {port} of {host} is taken", fix=fix) from None
        if error.errno == errno.EACCES:
            raise UsageError(
                f"port {port} needs the rights of an administrator", fix="give a --port from 1024 to 65535"
            ) from None
        raise UsageError(f"cannot listen on {host} port {port}: {error.strerror}", fix="give another --host") from None


def _bound(family: int, target: tuple[object, ...]) -> socket.socket:
    found = socket.socket(family, socket.SOCK_STREAM)
    try:
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # of a dashboard that ended a moment ago
        found.bind(target)
        found.listen(128)
    except BaseException:
        found.close()
        raise
    return found


def _next_free(family: int, target: tuple[object, ...]) -> int:
    """Return the next higher port that is free; 0 if none of the next ports is free."""
    host, port, *rest = target
    assert isinstance(port, int)
    for number in range(port + 1, min(port + _MAX_TRIED_PORTS, 65536)):
        with suppress(OSError):
            _bound(family, (host, number, *rest)).close()
            return number
    return 0
