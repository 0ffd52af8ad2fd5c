"""The ASGI server, with what the dashboard needs besides: it says when it listens."""

from __future__ import annotations

from typing import TYPE_CHECKING

import uvicorn

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

    from starlette.types import ASGIApp

__all__ = ["make_server", "run_server"]

_MAX_CONNECTIONS = 200
_MAX_HEADERS = 16_384  # bytes of a request's first line and headers
_KEEP_ALIVE_S = 15
_SHUTDOWN_S = 1  # that a request may take after Ctrl-C


class _Server(uvicorn.Server):
    def __init__(self, config: uvicorn.Config, begun: Callable[[], None]) -> None:
        super().__init__(config)
        self._begun = begun

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets=sockets)
        self._begun()


def make_server(application: ASGIApp, begun: Callable[[], None]) -> uvicorn.Server:
    """Return the server.

    Args:
        application: that answers.
        begun: called once, when requests are answered.
    """
    config = uvicorn.Config(
        application, log_level="error", access_log=False, server_header=False, date_header=False,
        limit_concurrency=_MAX_CONNECTIONS, timeout_keep_alive=_KEEP_ALIVE_S, ws="none", lifespan="off",
        timeout_graceful_shutdown=_SHUTDOWN_S, h11_max_incomplete_event_size=_MAX_HEADERS, http="h11", loop="asyncio",
        proxy_headers=False,
    )  # fmt: skip
    return _Server(config, begun)


def run_server(application: ASGIApp, listening: socket.socket, begun: Callable[[], None]) -> None:
    """Answer requests until Ctrl-C.

    Args:
        application: that answers.
        listening: the socket.
        begun: called once, when requests are answered.

    Raises:
        KeyboardInterrupt: after Ctrl-C, once everything is closed.
    """
    make_server(application, begun).run(sockets=[listening])
