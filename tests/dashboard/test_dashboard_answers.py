"""What the application of the dashboard answers, without a server, and with simple objects in place of hunts."""

from __future__ import annotations

import asyncio
import json
import time
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest
from dashboard_hunts import View

from crashhunt.base.errors import BundleError, CrashhuntError, HuntDirectoryError, UsageError
from crashhunt.dashboard import _application, _details
from crashhunt.dashboard._application import _Shown, make_application


class Reply:
    def __init__(self, messages):
        self.status = messages[0]["status"]
        self.headers = {name.decode(): value.decode() for name, value in messages[0]["headers"]}
        self.body = b"".join(message.get("body", b"") for message in messages[1:])

    @property
    def json(self):
        return json.loads(self.body)


def ask(application, target, method="GET", **headers):
    path, _, query = target.partition("?")
    given = {
        "host": "localhost",
        "x-crashhunt": "1",
        **{name.replace("_", "-"): value for name, value in headers.items()},
    }
    scope = {"type": "http", "method": method, "path": path, "raw_path": path.encode(), "query_string": query.encode(),
             "headers": [(name.encode(), value.encode()) for name, value in given.items()], "root_path": "",
             "http_version": "1.1", "scheme": "http", "server": ("localhost", 80)}  # fmt: skip
    sent = []

    async def receive():
        await asyncio.sleep(0)
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message):
        sent.append(message)

    asyncio.run(application.asgi(scope, receive, send))
    return Reply(sent)


class Crashes:
    """The crashes of a hunt: one is there, and one is damaged."""

    def rows(self):
        return {"crashes": [{"id": "c"}], "pending": 0, "count": 1}

    def map(self):
        return {"lanes": [], "points": [{"x": 1.5}]}

    def detail(self, crash):
        if crash == "damaged":
            raise BundleError("log.mcap is damaged", fix="run crashhunt check")
        return {"steps": 3} if crash == "c" else None

    def log(self, crash):
        return vars(self)["path"] if crash == "c" else None

    def bundle(self, crash):
        return SimpleNamespace(hunt=Path("/hunts/one"), name=crash) if crash == "c" else None


@pytest.fixture
def made(monkeypatch):
    """Return a function that makes an application for views by identifier, with their crashes."""

    def make(*views, control=False, crashes=None, **options):
        monkeypatch.setattr(_Shown, "view", lambda self, name: next((v for v in views if v.found.id == name), None))
        known = [view.found.id for view in views]
        monkeypatch.setattr(_Shown, "crashes", lambda self, name: (crashes or Crashes()) if name in known else None)
        catalog = SimpleNamespace(roots=(Path("/hunts"),), is_cut=False, hunts=dict, find=lambda name: None)
        return make_application(catalog, host="localhost", allow_control=control, **options)

    return make


def test_addresses_have_their_answers_and_others_an_error(made, tmp_path):
    crashes = Crashes()
    crashes.path = tmp_path / "log.mcap"
    crashes.path.write_bytes(b"log")
    application = made(View(), crashes=crashes)
    about = ask(application, "/api").json
    assert (about["control"], about["roots"], about["version"]) == (False, ["/hunts"], 1)
    one = "/api/hunts/one"
    assert ask(application, "/api/hunts").json["ids"] == []
    assert ask(application, one).json["path"] == "/hunts/one"
    assert ask(application, f"{one}/crashes").json["crashes"] == [{"id": "c"}]
    assert ask(application, f"{one}/map").json["points"] == [{"x": 1.5}]
    assert ask(application, f"{one}/crashes/c").json["steps"] == 3
    log = ask(application, f"{one}/crashes/c/log")
    assert (log.body, log.headers["content-type"]) == (b"log", "application/octet-stream")
    assert log.headers["cache-control"] == "no-store"
    assert 'filename="c.mcap"' in log.headers["content-disposition"]
    for target, said in (
        ("/api/hunts/two", "this hunt is not there"), ("/api/hunts/two/trials", "this hunt is not there"),
        ("/api/hunts/two/importance", "this hunt is not there"), ("/api/hunts/two/map", "this hunt is not there"),
        ("/api/hunts/two/crashes", "this hunt is not there"), ("/api/hunts/two/crashes/c", "this hunt is not there"),
        (f"{one}/crashes/x", "there is no such crash"), (f"{one}/crashes/x/log", "there is no such log"),
        ("/api/hunts/two/crashes/c/log", "this hunt is not there"),
        (f"{one}/crashes/x/export", "there is no such crash"),
        ("/api/hunts/two/crashes/c/export", "this hunt is not there"), ("/static/x.js", "there is no such file"),
        ("/nothing", "there is no such page"),
    ):  # fmt: skip
        reply = ask(application, target)
        assert reply.status == 404, target
        assert said in reply.json["error"]["message"]
        assert reply.headers["cache-control"] == "no-store"
    for target in (f"{one}/stop", f"{one}/crashes/c/jobs"):
        assert ask(application, target).status == 404


@pytest.mark.parametrize(
    ("error", "status"),
    [(BundleError("odd"), 422), (UsageError("odd"), 409), (HuntDirectoryError("odd"), 500), (OSError(2, "odd"), 500)],
)
def test_error_has_the_status_of_its_kind(made, error, status):
    def fails(crash):
        raise error

    crashes = Crashes()
    crashes.detail = fails
    reply = ask(made(View(), crashes=crashes), "/api/hunts/one/crashes/c")
    assert (reply.status, reply.headers["cache-control"]) == (status, "no-store")
    assert reply.json["error"]["message"] == "odd"


def test_answer_is_sent_again_only_when_it_has_changed(made):
    view = View()
    application = made(view)
    first = ask(application, "/api/hunts/one")
    assert first.headers["content-type"] == "application/json"
    assert first.headers["cache-control"] == "no-cache"
    assert abs(float(first.headers["x-crashhunt-now"]) - time.time()) < 60
    again = ask(application, "/api/hunts/one", if_none_match=first.headers["etag"])
    assert (again.status, again.body, again.headers["etag"]) == (304, b"", first.headers["etag"])
    view.said["state"] = "crashed"
    changed = ask(application, "/api/hunts/one", if_none_match=first.headers["etag"])
    assert (changed.status, changed.json["state"]) == (200, "crashed")
    assert changed.headers["etag"] != first.headers["etag"]


def test_points_of_a_hunt_come_with_the_shares_of_their_sample(made):
    asked = []
    sample = SimpleNamespace(
        since=lambda cursor: asked.append(cursor) or ([{"number": 3}], "1.4", False), share=0.5, crash_share=0.25
    )
    view = View(sample=sample)
    found = ask(made(view), "/api/hunts/one/trials?since=1.3").json
    assert found == {"version": 1, "points": [{"number": 3}], "cursor": "1.4", "replace": False, "share": 0.5,
                     "crash_share": 0.25}  # fmt: skip
    assert (asked, view.refreshed) == (["1.3"], [True])
    view.sample = None
    found = ask(made(view), "/api/hunts/one/trials").json
    assert found == {"version": 1, "points": [], "cursor": "", "replace": True, "share": 1.0, "crash_share": 1.0}


def test_importance_has_the_units_of_arguments_by_their_names(made, monkeypatch):
    units = {("ego", "speed"): "m/s", ("", "cars"): "1"}
    monkeypatch.setattr(_application, "argument_units", lambda path, settings: units)
    monkeypatch.setattr(_application, "importance_of_points", lambda points, first: [{"points": len(points)}])
    view = View(sample=SimpleNamespace(points=[1, 2]), settings=SimpleNamespace(agents={"ego": 1}))
    found = ask(made(view), "/api/hunts/one/importance").json
    assert (found["importance"], found["units"]) == ([{"points": 2}], {"speed": "m/s", "cars": "1"})
    view.settings.agents["other"] = 2
    assert ask(made(view), "/api/hunts/one/importance").json["units"] == {"ego.speed": "m/s", "cars": "1"}
    assert view.refreshed == [True, True]
    monkeypatch.setattr(_application, "argument_units", lambda *_: (_ for _ in ()).throw(CrashhuntError("no")))
    assert ask(made(view), "/api/hunts/one/importance").json["units"] == {}
    view.sample = None
    assert ask(made(view), "/api/hunts/one/importance").json["importance"] == [{"points": 0}]


def test_export_is_removed_when_it_has_been_sent_or_has_failed(made, monkeypatch):
    written = []

    def export(bundle, target):
        written.append(target)
        if len(written) > 1:
            raise BundleError("damaged")
        target.write_bytes(b"PK")

    monkeypatch.setattr(_application, "export_crash", export)
    application = made(View())
    reply = ask(application, "/api/hunts/one/crashes/c/export")
    assert (reply.status, reply.body, reply.headers["content-type"]) == (200, b"PK", "application/zip")
    assert 'filename="c.zip"' in reply.headers["content-disposition"]
    assert reply.headers["cache-control"] == "no-store"
    assert ask(application, "/api/hunts/one/crashes/c/export").status == 422
    assert [path.parent.exists() for path in written] == [False, False]


def test_hunts_to_compare_are_those_named_once_and_eight_at_most(made, monkeypatch):
    compared = []
    monkeypatch.setattr(
        _details.HuntComparer, "compare", lambda self, views: compared.append([v.found.id for v in views]) or {}
    )
    views = [View(f"h{number}") for number in range(12)]
    application = made(*views)
    for query in ("", "hunts=", "hunts=h2,h1,,h2,nothing", "hunts=" + ",".join(view.found.id for view in views)):
        assert ask(application, f"/api/compare?{query}").status == 200
    assert compared == [[], [], ["h2", "h1"], [f"h{number}" for number in range(8)]]


def test_control_stops_hunts_and_starts_jobs_of_crashes_that_exist(made, monkeypatch):
    stopped, added, closed = [], [], []
    monkeypatch.setattr(_application, "stop_hunt", stopped.append)
    monkeypatch.setattr(_application.Jobs, "add", lambda self, *given: added.append(given) or {"job": 1})
    monkeypatch.setattr(_application.Jobs, "list", lambda self, *given: [given])
    monkeypatch.setattr(_application.Jobs, "close", lambda self: closed.append(1))
    view = View()
    application = made(view, control=True)
    assert ask(application, "/api").json["control"] is True
    assert ask(application, "/api/hunts/one/stop", "POST").json == {"version": 1}
    assert stopped == [view]
    assert ask(application, "/api/hunts/two/stop", "POST").status == 404
    assert ask(application, "/api/hunts/one/stop").status == 405
    assert ask(application, "/api/hunts/one/crashes/c/jobs").json["jobs"] == [["one", "c"]]
    assert ask(application, "/api/hunts/one/crashes/c/jobs/judge", "POST").json["job"] == 1
    assert added == [("one", Path("/hunts/one"), "c", "judge")]
    assert ask(application, "/api/hunts/one/crashes/x/jobs/judge", "POST").status == 404
    assert ask(application, "/api/hunts/two/crashes/c/jobs/judge", "POST").status == 404
    application.close()
    assert closed == [1]


def test_files_are_kept_for_ever_only_under_the_address_of_their_version(made, monkeypatch):
    monkeypatch.setattr(_application, "_plotly", lambda: b"plot")
    for kept in (_application._stamp, _application._page):  # not those with the plotly of this test
        monkeypatch.setattr(_application, kept.__name__, cache(kept.__wrapped__))
    application = made()
    for name, kind in (("common.js", "text/javascript"), ("style.css", "text/css"), ("player.js", "text/javascript"),
                       ("plotly.js", "text/javascript")):  # fmt: skip
        stamp = _application._stamp(name)
        reply = ask(application, f"/static/{name}?v={stamp}")
        assert reply.headers["content-type"].startswith(kind)
        assert reply.headers["cache-control"] == "public, max-age=31536000, immutable"
        for query in ("", "?v=", f"?v={stamp}0"):
            assert ask(application, f"/static/{name}{query}").headers["cache-control"] == "no-cache"
    assert ask(application, "/static/plotly.js").body == b"plot"
    for target, title in (("/", "Hunts"), ("/hunts/x", ""), ("/hunts/x/crashes/y", ""), ("/compare", "")):
        page = ask(application, target)
        assert page.headers["content-type"].startswith("text/html")
        assert page.headers["cache-control"] == "no-cache"
        text = page.body.decode()
        assert f"<title>{title}" in text
        assert f'"/static/style.css?v={_application._stamp("style.css")}"' in text
        assert text.count('"/static/') == text.count("?v=")
        assert "<!--PLAYER-->" not in text


def test_large_function_of_plotly_is_in_parentheses(monkeypatch):
    head, rest = b"(function (root) { x : this, () => {\n", b"body\n}));"
    for script, expected in (
        (head + rest, b"(function (root) { x : this, (() => {\nbody\n})));"),
        (head + rest + b" ", head + rest + b" "),
        (b"another build\n}));", b"another build\n}));"),
    ):
        file = SimpleNamespace(read_bytes=lambda script=script: script)
        folder = SimpleNamespace(joinpath=lambda *_, file=file: file)
        monkeypatch.setattr(_application.resources, "files", lambda name, folder=folder: folder)
        assert _application._plotly.__wrapped__() == expected


# Rows of the list, and what is kept of hunts.


class Found:
    def __init__(self, name, version=0):
        self.id, self.version = name, version

    def __eq__(self, other):
        return (self.id, self.version) == (other.id, other.version)

    __hash__ = None


@pytest.fixture
def shown(monkeypatch):
    monkeypatch.setattr(_application, "HuntView", lambda found: View(found.id, found=found))
    monkeypatch.setattr(_application, "CrashList", lambda found: SimpleNamespace(found=found))
    hunts = {"a": Found("a"), "b": Found("b")}
    made = _Shown(SimpleNamespace(hunts=lambda: hunts, find=hunts.get, roots=(Path("/hunts"),), is_cut=True))
    made.found = hunts
    return made


def test_rows_are_those_that_changed_since_a_revision(shown):
    def ids(since=""):
        found = shown.rows(since)
        assert found["ids"] == list(shown.found)
        return [row["id"] for row in found["hunts"]], found["revision"]

    assert ids() == (["a", "b"], 1)
    assert ids("1") == ([], 1)
    shown.view("b").said["trials_run"] = 3
    assert ids("1") == (["b"], 2)
    assert ids("2") == ([], 2)
    assert ids("0") == (["a", "b"], 2)
    shown.view("a").said["newest_kind_s"] = 7.0  # changes with the clock only
    assert ids("2") == ([], 2)
    shown.view("a").said["state"] = "crashed"
    assert ids("2") == (["a"], 3)
    for strange in ("4", "x", "-1", "9999999999", "\u0663", "1.5"):  # of another run of the dashboard, or made up
        assert ids(strange)[0] == ["a", "b"]
    del shown.found["a"]
    assert ids("3") == ([], 4)
    shown.found["a"] = Found("a")
    assert ids("4") == (["a"], 5)
    assert shown.rows("")["roots"] == ["/hunts"]
    assert shown.rows("")["is_cut"] is True


def test_view_of_a_hunt_is_kept_until_its_folder_is_another(shown):
    view = shown.view("a")
    assert shown.view("a") is view
    shown.found["a"] = Found("a", version=1)
    assert shown.view("a") is not view
    assert shown.view("nothing") is None
    shown.rows("")
    del shown.found["b"]
    shown.rows("")
    assert list(shown._views) == ["a"]


def test_crashes_of_twenty_hunts_are_kept_that_were_asked_for_last(shown):
    shown.found.update({f"h{number}": Found(f"h{number}") for number in range(25)})
    first = shown.crashes("h0")
    for number in range(1, 20):
        shown.crashes(f"h{number}")
    assert shown.crashes("h0") is first  # asked for again, so that it is not the oldest
    second = shown.crashes("h1")
    for number in range(20, 24):
        shown.crashes(f"h{number}")
    assert len(shown._crashes) == 20
    assert shown.crashes("h0") is first
    assert shown.crashes("h1") is second
    assert "h2" not in shown._crashes
    assert shown.crashes("nothing") is None
