"""Refuses requests that do not come from the user, before any data are read for them.

The page shows files of this machine. Other web sites in the same browser and other users of the network must not get
access (`Guard`):

- The name in the Host header must be a name of this server. A site that makes its own name point to this machine (DNS
  rebinding) sends its own name.
- If the server does not listen on a loopback address, a token is needed. The token is compared in constant time, and
  kept in a cookie that scripts cannot read and other sites cannot send.
- Requests of other sites are refused by the headers Sec-Fetch-Site and Origin, which scripts cannot set. A request
  that has one of these headers twice is refused.
- The size of requests and the number of requests at a time are bounded.
- Each response forbids scripts, styles, connections and frames of other sites.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
import socket
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING, Final
from urllib.parse import parse_qsl, urlencode

from starlette.responses import JSONResponse, RedirectResponse, Response

if TYPE_CHECKING:
    from collections.abc import Iterable

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

MAX_TARGET: Final = 4_096
"""Characters of path and query, at most."""
MAX_BODY: Final = 16_384
"""Bytes of a request's body, at most."""
MAX_HEADERS: Final = 16_384
"""Bytes of a request's headers, at most."""
MAX_REQUESTS: Final = 64
"""Requests at a time, at most."""
MIN_TOKEN: Final = 16
"""Characters of a token that the user chooses, at least."""

_SINGLE = ("host", "origin", "sec-fetch-site", "sec-fetch-mode", "x-crashhunt", "authorization", "content-length")
# A name or an IPv4 address, or an IPv6 address in brackets, and a port (RFC 9110). A user name, as in user@host, is not
# part of it.
_HOST = re.compile(r"(?:\[(?P<address>[0-9a-fA-F:.]+)\]|(?P<name>[^\s@:/?#\[\]\\]+))(?::[0-9]{0,5})?")
_COOKIE = "crashhunt-token"
_CONTENT_SECURITY_POLICY = (
    "default-src 'none'; script-src 'self'; connect-src 'self'; img-src 'self' data: blob:; "
    # plotly sets styles from its script. No text of a hunt becomes markup, so no style of a stranger gets in.
    "style-src 'self' 'unsafe-inline'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    b"content-security-policy": _CONTENT_SECURITY_POLICY.encode(),
    b"x-content-type-options": b"nosniff",
    b"x-frame-options": b"DENY",
    b"referrer-policy": b"no-referrer",
    b"cross-origin-opener-policy": b"same-origin",
    b"cross-origin-resource-policy": b"same-origin",
    b"permissions-policy": b"camera=(), microphone=(), geolocation=()",
}


def is_loopback(host: str) -> bool:
    """Return whether a host to listen on can be reached only from this machine."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def names_of(host: str) -> frozenset[str]:
    """Return the names by which a request may address this machine, in addition to IP addresses."""
    names = {"localhost", host.lower()}
    if not is_loopback(host):
        names |= {socket.gethostname().lower(), socket.getfqdn().lower()}
    return frozenset(names)


class Guard:
    """Forwards the requests of the user, and refuses all other requests.

    With an empty token, requests need none. Without ``control``, requests may only read.
    """

    def __init__(self, app: ASGIApp, *, host: str, token: str = "", control: bool = False) -> None:
        self._app = app
        self._names = names_of(host)
        self._addresses = not is_loopback(host)  # by which other machines may call this one
        self._token = token.encode()
        self._control = control
        self._requests = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer or refuse one request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return  # uvicorn refuses the handshake of a web socket

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = message.setdefault("headers", [])
                there = {name.lower() for name, _ in given}
                message["headers"] = [*given, *((k, v) for k, v in _HEADERS.items() if k not in there)]
            await send(message)

        headers = _Headers(scope["headers"])
        refusal = self._refusal(scope, headers)
        if refusal is not None:
            await refusal(scope, receive, send_with_headers)
            return
        self._requests += 1
        try:
            if self._requests > MAX_REQUESTS:
                busy = error_response(503, f"more than {MAX_REQUESTS} requests at a time", "try again in a second")
                await busy(scope, receive, send_with_headers)
                return
            await self._app(scope, _bounded(receive), send_with_headers)
        finally:
            self._requests -= 1

    def _refusal(self, scope: Scope, headers: _Headers) -> Response | None:
        if len(scope.get("raw_path") or b"") + len(scope["query_string"]) > MAX_TARGET:
            return error_response(414, "the address is too long", f"give at most {MAX_TARGET} characters")
        if headers.size > MAX_HEADERS:
            return error_response(431, "the headers are too large", f"send at most {MAX_HEADERS} bytes")
        if headers.repeated:
            return error_response(400, f"the header {headers.repeated} occurs twice", "send it once")
        host = headers.only("host")
        if host is None or not self._is_ours(host):
            fix = "open the address that crashhunt dashboard printed"
            return error_response(421, "the Host header names another machine", fix)
        if (length := headers.only("content-length")) is not None and not _is_small(length):
            return error_response(413, "the request is too large", f"send at most {MAX_BODY} bytes")
        reads = scope["method"] in ("GET", "HEAD")
        if not reads and not (self._control and scope["method"] == "POST"):
            return error_response(405, "the dashboard only reads", "start it with --allow-control to control hunts")
        if self._is_foreign(scope, headers, host):
            return error_response(403, "another site sent this request", "open the page itself")
        return self._without_token(scope, headers) if self._token else None

    def _is_ours(self, host: str) -> bool:
        if not (found := _HOST.fullmatch(host)):
            return False
        name = (found["address"] or found["name"]).lower()
        if name in self._names:
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return False
        return self._addresses or address.is_loopback

    def _is_foreign(self, scope: Scope, headers: _Headers, host: str) -> bool:
        """Return whether another site sent a request, unless the request only follows a link to a page."""
        is_page = scope["method"] in ("GET", "HEAD") and not scope["path"].startswith("/api")
        site = headers.only("sec-fetch-site")
        if site in ("cross-site", "same-site") and not (is_page and headers.only("sec-fetch-mode") == "navigate"):
            return True
        origin = headers.only("origin")
        if origin is not None and origin.lower() not in (f"http://{host.lower()}", f"https://{host.lower()}"):
            return True
        # A form of another site cannot set this header, and a script of it would have to ask first.
        return scope["method"] == "POST" and headers.only("x-crashhunt") != "1"

    def _without_token(self, scope: Scope, headers: _Headers) -> Response | None:
        """Return the response to a request without the token; None if the request contains the token."""
        query = parse_qsl(scope["query_string"].decode("latin-1"), keep_blank_values=True, max_num_fields=100)
        given = [value for name, value in query if name == "token"]
        if given and self._fits(given[-1]) and scope["method"] in ("GET", "HEAD"):
            rest = urlencode([(name, value) for name, value in query if name != "token"])
            # One slash: two would be the address of another machine.
            path = "/" + scope["path"].lstrip("/\\")
            answer = RedirectResponse(f"{path}?{rest}" if rest else path, status_code=303)
            answer.set_cookie(_COOKIE, self._token.decode(), httponly=True, samesite="strict", path="/")
            return answer
        kind, _, bearer = (headers.only("authorization") or "").partition(" ")
        if kind.lower() == "bearer" and self._fits(bearer.strip()):
            return None
        if self._fits(_cookie(headers)):
            return None
        return error_response(401, "the token is missing or wrong", "open the address that crashhunt dashboard printed")

    def _fits(self, given: str) -> bool:
        return hmac.compare_digest(given.encode("utf-8", "surrogateescape"), self._token)


class _Headers:
    """The headers of a request, of which those that the guard reads must occur once.

    Proxies and browsers differ in which of two they follow. A cookie may come in several headers (RFC 9113).
    """

    def __init__(self, raw: Iterable[tuple[bytes, bytes]]) -> None:
        self._found: dict[str, list[str]] = {}
        self.size = 0
        for name, value in raw:
            self.size += len(name) + len(value)
            self._found.setdefault(name.decode("latin-1").lower(), []).append(value.decode("latin-1"))

    @property
    def repeated(self) -> str:
        """The name of a header that occurs twice and must not; empty if there is none."""
        return next((name for name in _SINGLE if len(self._found.get(name, ())) > 1), "")

    def only(self, name: str) -> str | None:
        """Return the value of a header; None if the header is missing or occurs twice."""
        values = self._found.get(name, ())
        return values[0] if len(values) == 1 else None


def _cookie(headers: _Headers) -> str:
    try:
        found = SimpleCookie(headers.only("cookie") or "").get(_COOKIE)
    except CookieError:
        return ""
    return found.value if found is not None else ""


def _is_small(length: str) -> bool:
    return length.isascii() and length.isdecimal() and len(length) < 10 and int(length) <= MAX_BODY


def _bounded(receive: Receive) -> Receive:
    """Return a function that stops reading a request's body above the limit, even if its length is unknown."""
    taken = 0

    async def bounded() -> Message:
        nonlocal taken
        message = await receive()
        taken += len(message.get("body", b""))
        if taken > MAX_BODY:
            return {"type": "http.disconnect"}
        return message

    return bounded


def error_response(status: int, message: str, fix: str = "") -> Response:
    """Return an error response in the JSON form that every command's ``--json`` has."""
    return JSONResponse(
        {"error": {"message": message, "fix": fix, "where": ""}}, status, headers={"cache-control": "no-store"}
    )
