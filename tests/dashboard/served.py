"""A dashboard that answers on a port of this machine, in a thread of the test, and raw requests to it."""

from __future__ import annotations

import http.client
import json
import socket
import threading
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path


@dataclass
class Reply:
    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


@dataclass
class Dashboard:
    """Where it is, and how to ask it."""

    port: int
    token: str = ""

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def ask(
        self, target: str, headers: Mapping[str, str] | None = None, method: str = "GET", body: Any = None
    ) -> Reply:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        try:
            connection.putrequest(method, target, skip_host="Host" in (headers or {}))
            for name, value in (headers or {}).items():
                connection.putheader(name, value)
            if body is not None:
                connection.putheader("Content-Length", str(len(body)))
            connection.endheaders(body)
            answer = connection.getresponse()
            return Reply(answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read())
        finally:
            connection.close()

    def raw(self, request: bytes) -> bytes:
        with socket.create_connection(("127.0.0.1", self.port), timeout=60) as connection:
            connection.sendall(request)
            connection.shutdown(socket.SHUT_WR)
            found = b""
            while part := connection.recv(65536):
                found += part
            return found

    def get(self, target: str) -> Any:
        reply = self.ask(target)
        assert reply.status == 200, reply.body
        return reply.json

    def hunts(self) -> dict[str, Any]:
        return {row["name"]: row for row in self.get("/api/hunts")["hunts"]}


@contextmanager
def served(*paths: Path, host: str = "127.0.0.1", token: str = "", control: bool = False) -> Iterator[Dashboard]:
    from crashhunt.dashboard import _server, _serving
    from crashhunt.dashboard._application import make_application
    from crashhunt.dashboard._catalog import Catalog

    archives = ExitStack()
    folders, exported = _server._roots(paths, archives)
    listening = socket.create_server(("127.0.0.1", 0))
    application = make_application(Catalog(folders, exported), host=host, token=token, allow_control=control)
    begun = threading.Event()
    server = _serving.make_server(application.asgi, begun.set)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
    thread.start()
    try:
        assert begun.wait(60)
        yield Dashboard(listening.getsockname()[1], token)
    finally:
        server.should_exit = True
        application.close()
        thread.join(60)
        listening.close()
        archives.close()
        assert not thread.is_alive()
