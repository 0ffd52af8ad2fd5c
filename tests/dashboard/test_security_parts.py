"""The guard of the dashboard without a server: each of its rules at its limits."""

from __future__ import annotations

import asyncio
import json

import pytest

from crashhunt.dashboard import _security
from crashhunt.dashboard._security import Guard, is_loopback, names_of

TOKEN = "0123456789abcdef"


class App:
    """An application that answers everything with 200, and keeps what it was asked."""

    def __init__(self, headers=(), read=False):
        self.scopes, self.messages = [], []
        self._headers, self._read = headers, read

    async def __call__(self, scope, receive, send):
        self.scopes.append(scope)
        while self._read:
            self.messages.append(await receive())
            if not self.messages[-1].get("more_body"):
                break
        if scope["type"] == "http":
            await send({"type": "http.response.start", "status": 200, "headers": [*self._headers]})
            await send({"type": "http.response.body", "body": b"ours"})


def ask(guard, path="/", method="GET", query="", body=(), **headers):
    """The status, the headers and the body of an answer."""
    given = {"host": "localhost", **{name.replace("_", "-"): value for name, value in headers.items()}}
    pairs = [(name.encode(), one.encode("latin-1")) for name, value in given.items() if value is not None
             for one in (value if isinstance(value, list) else [value])]  # fmt: skip
    scope = {"type": "http", "method": method, "path": path, "raw_path": path.encode(), "headers": pairs,
             "query_string": query.encode("latin-1"), "http_version": "1.1", "scheme": "http"}  # fmt: skip
    messages = [{"type": "http.request", "body": part, "more_body": True} for part in body]
    sent = []

    async def receive():
        return messages.pop(0) if messages else {"type": "http.request", "body": b"", "more_body": False}

    async def send(message):
        sent.append(message)

    asyncio.run(guard(scope, receive, send))
    start = sent[0]
    return start["status"], {name.decode(): value.decode() for name, value in start["headers"]}, sent[1]["body"]


def status(guard, *given, **named):
    return ask(guard, *given, **named)[0]


def guard_of(host="127.0.0.1", **options):
    return Guard(App(), host=host, **options)


def test_length_of_an_address_is_that_of_path_and_query():
    guard = guard_of()
    for path, query in ((4_096, 0), (1, 4_095), (2_000, 2_096)):
        assert status(guard, "/" * path, query="q" * query) == 200
        assert status(guard, "/" * path, query="q" * (query + 1)) == 414
        assert status(guard, "/" * (path + 1), query="q" * query) == 414


def test_size_of_headers_is_that_of_names_and_values():
    size = len("host") + len("localhost") + len("x")
    assert status(guard_of(), x="a" * (16_384 - size)) == 200
    assert status(guard_of(), x="a" * (16_385 - size)) == 431
    assert status(guard_of(), x=["a" * 8_000] * 2) == 200
    assert status(guard_of(), x=["a" * 8_000] * 3) == 431


@pytest.mark.parametrize(
    ("length", "expected"),
    [("0", 200), ("16384", 200), ("16385", 413), ("000016384", 200), ("0000016384", 413), ("-1", 413), ("1e3", 413),
     ("", 413), ("\xb2", 413), (["3", "3"], 400)],
)  # fmt: skip
def test_length_of_a_body_is_a_small_decimal_number(length, expected):
    assert status(guard_of(), content_length=length) == expected


def test_body_is_read_up_to_the_limit_even_if_its_length_is_not_given():
    for parts, cut in (([b"a" * 16_384], False), ([b"a" * 16_000, b"a" * 385], True), ([b"a" * 16_385], True)):
        app = App(read=True)
        ask(Guard(app, host="localhost"), body=parts)
        assert [message["type"] for message in app.messages][-1] == ("http.disconnect" if cut else "http.request")
        assert sum(len(message.get("body", b"")) for message in app.messages) <= 16_384


@pytest.mark.parametrize(
    ("host", "local", "other"),
    [
        ("localhost", 200, 200), ("LOCALHOST:80", 200, 200), ("127.0.0.1:8642", 200, 200), ("127.9.9.9", 200, 200),
        ("[::1]:1", 200, 200), ("192.0.2.7", 421, 200), ("[2001:db8::1]:80", 421, 200), ("box", 421, 200),
        ("box.example", 421, 200), ("evil.example", 421, 421), ("", 421, 421), ("[::1", 421, 421), (None, 421, 421),
        (["localhost", "localhost"], 400, 400), (["evil.example", "localhost"], 400, 400),
        ("localhost.evil.example", 421, 421), ("evil.example@localhost", 421, 421), ("a:b@localhost:80", 421, 421),
        ("localhost/evil.example", 421, 421), ("localhost evil.example", 421, 421), ("[localhost]", 421, 421),
    ],
)  # fmt: skip
def test_host_is_a_name_of_this_machine(host, local, other, monkeypatch):
    """Another machine may call this one by any address, and a browser of this machine by a loopback address."""
    monkeypatch.setattr(_security.socket, "gethostname", lambda: "Box")
    monkeypatch.setattr(_security.socket, "getfqdn", lambda: "Box.example")
    assert status(guard_of("127.0.0.1"), host=host) == local
    assert status(guard_of("0.0.0.0"), host=host) == other
    assert status(guard_of("My.Name"), host="my.name") == 200


def test_names_of_a_machine_count_where_others_may_call_it(monkeypatch):
    monkeypatch.setattr(_security.socket, "gethostname", lambda: "Box")
    monkeypatch.setattr(_security.socket, "getfqdn", lambda: "Box.example")
    assert names_of("127.0.0.1") == {"localhost", "127.0.0.1"}
    assert names_of("0.0.0.0") == {"localhost", "0.0.0.0", "box", "box.example"}
    assert all(map(is_loopback, ("localhost", "127.0.0.2", "::1")))
    assert not any(map(is_loopback, ("0.0.0.0", "::", "10.0.0.1", "box", "")))


@pytest.mark.parametrize(
    ("method", "reading", "controlling"),
    [("GET", 200, 200), ("HEAD", 200, 200), ("POST", 405, 200), ("PUT", 405, 405), ("DELETE", 405, 405)],
)
def test_methods_are_those_of_reading_unless_control_is_allowed(method, reading, controlling):
    assert status(guard_of(), method=method, x_crashhunt="1") == reading
    assert status(guard_of(control=True), method=method, x_crashhunt="1") == controlling


@pytest.mark.parametrize(
    ("given", "page", "api", "post"),
    [
        ({}, 200, 200, 200),
        ({"x_crashhunt": None}, 200, 200, 403),
        ({"x_crashhunt": "0"}, 200, 200, 403),
        ({"sec_fetch_site": "same-origin"}, 200, 200, 200),
        ({"sec_fetch_site": "none"}, 200, 200, 200),
        ({"sec_fetch_site": "cross-site"}, 403, 403, 403),
        ({"sec_fetch_site": "same-site"}, 403, 403, 403),
        ({"sec_fetch_site": "cross-site", "sec_fetch_mode": "navigate"}, 200, 403, 403),
        ({"sec_fetch_site": "same-site", "sec_fetch_mode": "navigate"}, 200, 403, 403),
        ({"sec_fetch_site": "cross-site", "sec_fetch_mode": "no-cors"}, 403, 403, 403),
        ({"origin": "http://localhost:8642", "host": "LOCALHOST:8642"}, 200, 200, 200),
        ({"origin": "http://LOCALHOST"}, 200, 200, 200),
        ({"origin": "http://localhost:1"}, 403, 403, 403),
        ({"origin": "http://evil.example"}, 403, 403, 403),
        ({"origin": "null"}, 403, 403, 403),
        ({"origin": "http://evil.example@localhost"}, 403, 403, 403),
        ({"origin": "http://localhost", "host": "evil.example@localhost"}, 421, 421, 421),
        ({"origin": ["http://evil.example", "http://localhost"]}, 400, 400, 400),
        ({"origin": ["http://localhost"] * 2}, 400, 400, 400),
        ({"sec_fetch_site": ["cross-site", "same-origin"]}, 400, 400, 400),
        ({"x_crashhunt": ["1", "1"]}, 400, 400, 400),
    ],
)
def test_request_of_another_site_is_refused_unless_it_follows_a_link_to_a_page(given, page, api, post):
    guard = guard_of(control=True)
    assert status(guard, "/hunts/x", **{"x_crashhunt": "1", **given}) == page
    assert status(guard, "/hunts/x", "HEAD", **{"x_crashhunt": "1", **given}) == page
    assert status(guard, "/api/hunts", **{"x_crashhunt": "1", **given}) == api
    assert status(guard, "/hunts/x", "POST", **{"x_crashhunt": "1", **given}) == post


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, 401),
        ({"authorization": f"Bearer {TOKEN}"}, 200),
        ({"authorization": f"bEARER  {TOKEN} "}, 200),
        ({"authorization": f"Basic {TOKEN}"}, 401),
        ({"authorization": f"Bearer {TOKEN}x"}, 401),
        ({"authorization": TOKEN}, 401),
        ({"cookie": f"a=b; crashhunt-token={TOKEN}"}, 200),
        ({"cookie": f"crashhunt-token={TOKEN[:-1]}"}, 401),
        ({"cookie": f"other={TOKEN}"}, 401),
        ({"cookie": "crashhunt-token=\xe9\xff"}, 401),
        ({"cookie": "[]=;"}, 401),
        ({"query": f"token={TOKEN}"}, 303),
        ({"query": f"token=wrong&token={TOKEN}"}, 303),
        ({"query": f"token={TOKEN}&token=wrong"}, 401),
        ({"query": f"other={TOKEN}"}, 401),
        ({"query": f"token={TOKEN}", "method": "HEAD"}, 303),
        ({"query": f"token={TOKEN}", "method": "POST", "x_crashhunt": "1"}, 401),
        ({"query": "token=", "authorization": f"Bearer {TOKEN}"}, 200),
    ],
)
def test_token_is_in_the_link_the_cookie_or_the_authorization(given, expected):
    guard = guard_of(token=TOKEN, control=True)
    assert status(guard, **given) == expected
    if expected == 200:
        assert status(guard_of(), **given) == 200


def test_link_with_the_token_leads_to_the_same_page_without_it():
    guard = guard_of(token=TOKEN)
    for path, query, location in (
        ("/", f"token={TOKEN}", "/"),
        ("/hunts/x", f"a=1&token={TOKEN}&b=", "/hunts/x?a=1&b="),
        ("//evil.example/x", f"token={TOKEN}", "/evil.example/x"),
        ("/\\evil.example", f"token={TOKEN}", "/evil.example"),
    ):
        code, headers, _ = ask(guard, path, query=query)
        assert (code, headers["location"]) == (303, location)
        cookie = headers["set-cookie"].split("; ")
        assert cookie[0] == f"crashhunt-token={TOKEN}"
        assert {"HttpOnly", "Path=/", "SameSite=strict"} == set(cookie[1:])


def test_every_answer_has_the_headers_that_forbid_other_sites_once():
    expected = {name.decode(): value.decode() for name, value in _security._HEADERS.items()}
    for guard, given in ((guard_of(), {}), (guard_of(), {"host": "evil"}), (guard_of(token=TOKEN), {})):
        assert ask(guard, **given)[1].items() >= expected.items()
    own = Guard(App([(b"Referrer-Policy", b"origin"), (b"x", b"y")]), host="localhost")
    _, headers, body = ask(own)
    assert headers == {"Referrer-Policy": "origin", "x": "y"} | {
        name: value for name, value in expected.items() if name != "referrer-policy"
    }
    assert body == b"ours"


def test_refusal_is_an_error_in_json_that_is_not_kept():
    code, headers, body = ask(guard_of(), host="evil")
    assert (code, headers["cache-control"]) == (421, "no-store")
    error = json.loads(body)["error"]
    assert error == {"message": "the Host header names another machine", "where": "",
                     "fix": "open the address that crashhunt dashboard printed"}  # fmt: skip


def test_requests_at_a_time_are_counted_also_when_one_fails(monkeypatch):
    monkeypatch.setattr(_security, "MAX_REQUESTS", 2)
    inside = []

    async def app(scope, receive, send):
        inside.append(scope["path"])
        if scope["path"] == "/error":
            raise RuntimeError
        if len(inside) < 3:
            await guard({**scope, "path": f"/{len(inside)}"}, receive, send)
        else:
            raise AssertionError("a third request got through")

    guard = Guard(app, host="localhost")
    for _ in range(3):
        with pytest.raises(RuntimeError):
            ask(guard, "/error")
    inside.clear()
    code, _, body = ask(guard)  # each asks for another one
    assert (code, inside) == (503, ["/", "/1"])
    assert json.loads(body)["error"]["message"] == "more than 2 requests at a time"
    inside.clear()
    assert ask(guard)[0] == 503


def test_other_kinds_of_connections_are_passed_on_or_dropped():
    app = App()
    guard = Guard(app, host="localhost", token=TOKEN)

    async def never(*_):
        raise AssertionError

    for kind in ("lifespan", "websocket"):
        asyncio.run(guard({"type": kind}, never, never))
    assert [scope["type"] for scope in app.scopes] == ["lifespan"]
