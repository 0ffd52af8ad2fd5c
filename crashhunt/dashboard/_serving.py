"""The ASGI server, extended by what the dashboard needs: a limit on request times, and a signal that it listens."""

from __future__ import annotations

from typing import TYPE_CHECKING

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

if TYPE_CHECKING:
    import asyncio
    import socket
    from collections.abc import Callable

    from starlette.types import ASGIApp

_MAX_CONNECTIONS = 200
_MAX_HEADERS = 16_384  # bytes of a request's first line and headers
_KEEP_ALIVE_S = 15
_REQUEST_S = 10  # that the first line and the headers of a request may take
_SHUTDOWN_S = 1  # that a request may take after Ctrl-C


class _Protocol(H11Protocol):
    """HTTP protocol with a time limit for the headers of a request, which uvicorn lacks.

    Without the limit, clients that begin requests and never complete them could use up all connections.
    """

    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the time limit of the first request."""
        super().connection_made(transport)
        self._watch()

    def data_received(self, data: bytes) -> None:
        """Read a part of a request."""
        super().data_received(data)
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the time limit of the closed connection."""
        super().connection_lost(exc)
        if self._deadline is not None:
            self._deadline.cancel()

    def _is_waiting(self) -> bool:
        return self.cycle is None or self.cycle.response_complete

    def _watch(self) -> None:
        if self._deadline is not None and not self._is_waiting():
            self._deadline.cancel()
            self._deadline = None
        elif self._deadline is None and self._is_waiting():
            self._deadline = self.loop.call_later(_REQUEST_S, self._drop)

    def _drop(self) -> None:
        self._deadline = None
        if self._is_waiting():
            self.transport.close()


class _Server(uvicorn.Server):
    def __init__(self, config: uvicorn.Config, begun: Callable[[], None]) -> None:
        super().__init__(config)
        self._begun = begun

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets=sockets)
        self._begun()


def make_server(application: ASGIApp, begun: Callable[[], None]) -> uvicorn.Server:
    """Return the server of the dashboard.

    ``begun`` is called once, as soon as requests are answered.
    """
    config = uvicorn.Config(
        application, log_level="critical", access_log=False, server_header=False, date_header=False,
        limit_concurrency=_MAX_CONNECTIONS, timeout_keep_alive=_KEEP_ALIVE_S, ws="none", lifespan="off",
        timeout_graceful_shutdown=_SHUTDOWN_S, h11_max_incomplete_event_size=_MAX_HEADERS, http=_Protocol,
        loop="asyncio", proxy_headers=False,
    )  # fmt: skip
    return _Server(config, begun)


def run_server(application: ASGIApp, listening: socket.socket, begun: Callable[[], None]) -> None:
    """Run the server until Ctrl-C.

    Raises:
        KeyboardInterrupt: the user pressed Ctrl-C; all connections have been closed.
    """
    make_server(application, begun).run(sockets=[listening])
