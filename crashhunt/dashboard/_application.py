"""The pages and the API of the dashboard, as an ASGI application."""

from __future__ import annotations

import hashlib
import json
import tempfile
import threading
import time
from collections import OrderedDict
from contextlib import suppress
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from starlette.applications import Starlette
from starlette.background import BackgroundTask
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from crashhunt.base.codec import plain
from crashhunt.base.errors import BundleError, CrashhuntError, UsageError
from crashhunt.base.version import __version__
from crashhunt.crashes import export_crash
from crashhunt.dashboard._control import Jobs, stop_hunt
from crashhunt.dashboard._crash_list import CrashList
from crashhunt.dashboard._details import HuntComparer, detail_of, importance_of_points
from crashhunt.dashboard._hunt_page import HuntView
from crashhunt.dashboard._security import Guard, error_response
from crashhunt.report import argument_units, player_parts
from crashhunt.results import CodeVersions

if TYPE_CHECKING:
    from collections.abc import Callable

    from starlette.requests import Request
    from starlette.types import ASGIApp

    from crashhunt.base.codec import JsonObject
    from crashhunt.crashes import Bundle
    from crashhunt.dashboard._catalog import Catalog, FoundHunt

API_VERSION: Final = 1
"""Of the shapes below ``/api``. Keys may be added; a change of a key raises it."""

_MAX_COMPARED = 8
_NO_HUNT = "this hunt is not there (any more)", "go back to the list of hunts"
_NO_CRASH = "there is no such crash in this hunt"
_NO_STORE = {"cache-control": "no-store"}
_CONTENT_TYPES = {"js": "text/javascript", "css": "text/css", "svg": "image/svg+xml"}
_SCRIPTS = ("common.js", "list.js", "hunt.js", "crash.js", "compare.js", "style.css")


class Application(NamedTuple):
    """The dashboard's application, which answers requests."""

    asgi: ASGIApp  # the ASGI application
    close: Callable[[], None]  # function that ends all processes that the application has started


def make_application(catalog: Catalog, *, host: str, token: str = "", allow_control: bool = False) -> Application:
    """Return the application, protected against requests that do not come from the user.

    The arguments are those of `serve`.
    """
    answers = _Endpoints(catalog, allow_control=allow_control)
    routes = [
        Route("/", _page_route("list")),
        Route("/hunts/{hunt}", _page_route("hunt")),
        Route("/hunts/{hunt}/crashes/{crash}", _page_route("crash")),
        Route("/compare", _page_route("compare")),
        Route("/static/{name}", answers.asset),
        Route("/api", answers.api),
        Route("/api/hunts", answers.hunts),
        Route("/api/hunts/{hunt}", answers.hunt),
        Route("/api/hunts/{hunt}/trials", answers.trials),
        Route("/api/hunts/{hunt}/importance", answers.importance),
        Route("/api/hunts/{hunt}/map", answers.where),
        Route("/api/hunts/{hunt}/crashes", answers.crashes),
        Route("/api/hunts/{hunt}/crashes/{crash}", answers.crash),
        Route("/api/hunts/{hunt}/crashes/{crash}/log", answers.log),
        Route("/api/hunts/{hunt}/crashes/{crash}/export", answers.export),
        Route("/api/compare", answers.compare),
    ]
    if allow_control:
        routes += [
            Route("/api/hunts/{hunt}/stop", answers.stop, methods=["POST"]),
            Route("/api/hunts/{hunt}/crashes/{crash}/jobs", answers.job_list),
            Route("/api/hunts/{hunt}/crashes/{crash}/jobs/{job}", answers.job_add, methods=["POST"]),
        ]
    handlers: Any = {
        404: lambda _request, _: error_response(404, "there is no such page"),
        405: lambda _request, _: error_response(405, "the dashboard only reads"),
        _NotFound: lambda _request, error: error_response(404, *error.args),
        CrashhuntError: lambda _request, error: _from_error(error),
        OSError: lambda _request, error: error_response(500, str(error.strerror or error)),
        500: lambda _request, error: error_response(500, f"this should not happen: {type(error).__name__}"),
    }
    inner = Starlette(routes=routes, exception_handlers=handlers)
    return Application(Guard(inner, host=host, token=token, control=allow_control), answers.jobs.close)


class _Endpoints:
    """The functions that answer requests; each has the name of its route."""

    def __init__(self, catalog: Catalog, *, allow_control: bool) -> None:
        self._catalog = catalog
        self._allow_control = allow_control
        self._shown = _Shown(catalog)
        self.jobs = Jobs()

    def asset(self, request: Request) -> Response:
        name = request.path_params["name"]
        if name == "plotly.js":
            return Response(_plotly(), media_type="text/javascript", headers=_lasting(request, name))
        text = _assets().get(name)
        if text is None:
            return error_response(404, "there is no such file")
        kind = _CONTENT_TYPES[name.rpartition(".")[2]]
        return Response(text, media_type=kind, headers=_lasting(request, name))

    def api(self, request: Request) -> Response:
        about = {
            "crashhunt": __version__,
            "control": self._allow_control,
            "roots": [str(root) for root in self._catalog.roots],
        }
        return _answer(request, about)

    def hunts(self, request: Request) -> Response:
        return _answer(request, self._shown.rows(request.query_params.get("since", "")))

    def hunt(self, request: Request) -> Response:
        return _answer(request, detail_of(self._view(request)))

    def trials(self, request: Request) -> Response:
        view = self._view(request)
        view.refresh(points=True)
        sample = view.sample
        if sample is None:
            return _answer(request, {"points": [], "cursor": "", "replace": True, "share": 1.0, "crash_share": 1.0})
        points, cursor, is_all = sample.since(request.query_params.get("since", ""))
        return _answer(
            request,
            {
                "points": points,
                "cursor": cursor,
                "replace": is_all,
                "share": sample.share,
                "crash_share": sample.crash_share,
            },
        )

    def importance(self, request: Request) -> Response:
        view = self._view(request)
        view.refresh(points=True)
        units: dict[str, str] = {}
        if view.settings is not None and view.sample is not None:  # else the hunt is damaged or has no trial
            several = len(view.settings.agents) > 1
            with suppress(CrashhuntError, OSError):
                found = argument_units(view.path, view.settings)
                units = {
                    f"{agent}.{name}" if agent and several else name: unit for (agent, name), unit in found.items()
                }
        points = view.sample.points if view.sample is not None else []
        return _answer(
            request, {"importance": importance_of_points(points, CodeVersions.of(view.facts).first), "units": units}
        )

    def crashes(self, request: Request) -> Response:
        return _answer(request, self._crashes(request).rows())

    def where(self, request: Request) -> Response:
        return _answer(request, self._crashes(request).map())

    def crash(self, request: Request) -> Response:
        detail = self._crashes(request).detail(request.path_params["crash"])
        if detail is None:
            raise _NotFound(_NO_CRASH)
        return _answer(request, detail)

    def log(self, request: Request) -> Response:
        name = request.path_params["crash"]
        path = self._crashes(request).log(name)
        if path is None:
            raise _NotFound("there is no such log")
        return FileResponse(path, media_type="application/octet-stream", filename=f"{name}.mcap", headers=_NO_STORE)

    def export(self, request: Request) -> Response:
        bundle, name = self._bundle(request), request.path_params["crash"]
        place = tempfile.TemporaryDirectory(prefix="crashhunt-export-")
        target = Path(place.name) / f"{name}.zip"
        try:
            export_crash(bundle, target)
        except BaseException:
            place.cleanup()
            raise
        after = BackgroundTask(place.cleanup)
        return FileResponse(
            target, media_type="application/zip", filename=target.name, headers=_NO_STORE, background=after
        )

    def compare(self, request: Request) -> Response:
        names = [name for name in request.query_params.get("hunts", "").split(",") if name][:_MAX_COMPARED]
        views = [view for name in dict.fromkeys(names) if (view := self._shown.view(name)) is not None]
        return _answer(request, self._shown.compared.compare(views))

    def stop(self, request: Request) -> Response:
        view = self._view(request)
        stop_hunt(view)
        return _answer(request, {})

    def job_list(self, request: Request) -> Response:
        found = self.jobs.list(request.path_params["hunt"], request.path_params["crash"])
        return _answer(request, {"jobs": found})

    def job_add(self, request: Request) -> Response:
        identifier, name = request.path_params["hunt"], request.path_params["crash"]
        added = self.jobs.add(identifier, self._bundle(request).hunt, name, request.path_params["job"])
        return _answer(request, added)

    def _view(self, request: Request) -> HuntView:
        view = self._shown.view(request.path_params["hunt"])
        if view is None:
            raise _NotFound(*_NO_HUNT)
        return view

    def _crashes(self, request: Request) -> CrashList:
        found = self._shown.crashes(request.path_params["hunt"])
        if found is None:
            raise _NotFound(*_NO_HUNT)
        return found

    def _bundle(self, request: Request) -> Bundle:
        bundle = self._crashes(request).bundle(request.path_params["crash"])
        if bundle is None:
            raise _NotFound(_NO_CRASH)
        return bundle


class _NotFound(Exception):  # noqa: N818 - it is an answer, not a failure
    """A hunt, crash or log of a request that is not there; the message and its fix."""


class _Shown:
    """The views of all hunts, which are kept between requests."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog
        self._views: dict[str, HuntView] = {}
        self._crashes: OrderedDict[str, CrashList] = OrderedDict()
        self._rows: dict[str, tuple[int, bytes]] = {}  # revision in which a row changed, and its digest
        self._revision = 0
        self._lock = threading.Lock()
        self.compared = HuntComparer()

    def view(self, identifier: str) -> HuntView | None:
        """Return the view of a hunt by the hunt's identifier; None if the hunt is unknown or was deleted."""
        found = self._catalog.find(identifier)
        return None if found is None else self._view(found)

    def _view(self, found: FoundHunt) -> HuntView:
        with self._lock:
            view = self._views.get(found.id)
            if view is None or view.found != found:
                view = self._views[found.id] = HuntView(found)
            return view

    def crashes(self, identifier: str) -> CrashList | None:
        """Return the crashes of a hunt; None if the hunt is unknown or was deleted."""
        found = self._catalog.find(identifier)
        if found is None:
            return None
        with self._lock:
            known = self._crashes.pop(identifier, None) or CrashList(found)
            self._crashes[identifier] = known
            while len(self._crashes) > 20:
                self._crashes.popitem(last=False)
            return known

    def rows(self, since: str) -> JsonObject:
        """Return the rows of hunts that have changed since a revision, and the identifiers of all hunts.

        For a revision that no earlier call returned, all rows are returned.
        """
        found = self._catalog.hunts()
        rows = {name: self._view(hunt).row() for name, hunt in found.items()}
        with self._lock:
            self._views = {name: view for name, view in self._views.items() if name in found}
            digests = {name: _digest(row) for name, row in rows.items()}
            changed = [name for name, digest in digests.items() if self._rows.get(name, (0, b""))[1] != digest]
            if changed or self._rows.keys() != rows.keys():
                self._revision += 1
            known = {name: self._rows[name] for name in rows if name in self._rows}
            self._rows = known | {name: (self._revision, digests[name]) for name in changed}
            after = int(since) if since.isascii() and since.isdecimal() and len(since) < 10 else 0
            after = after if after <= self._revision else 0
            return {
                "hunts": [row for name, row in rows.items() if self._rows[name][0] > after],
                "ids": list(rows),
                "revision": self._revision,
                "roots": [str(root) for root in self._catalog.roots],
                "is_cut": self._catalog.is_cut,
            }


def _answer(request: Request, data: JsonObject) -> Response:
    """Return data as a JSON response, or status 304 if the browser already has these data."""
    text = json.dumps(plain({"version": API_VERSION, **data}), ensure_ascii=False, separators=(",", ":"))
    body = text.encode("utf-8", "replace")
    tag = f'"{hashlib.blake2b(body, digest_size=12).hexdigest()}"'
    headers = {"etag": tag, "cache-control": "no-cache", "x-crashhunt-now": f"{time.time():.3f}"}
    if request.headers.get("if-none-match") == tag:
        return Response(status_code=304, headers=headers)
    return Response(body, media_type="application/json", headers=headers)


def _digest(row: JsonObject) -> bytes:
    """Return the digest of a row, without the values that change only with the clock."""
    row = {name: value for name, value in row.items() if name != "newest_kind_s"}
    return hashlib.blake2b(json.dumps(row, default=str).encode("utf-8", "replace"), digest_size=12).digest()


def _from_error(error: Exception) -> Response:
    assert isinstance(error, CrashhuntError)
    status = 422 if isinstance(error, BundleError) else 409 if isinstance(error, UsageError) else 500
    return JSONResponse(error.to_json(), status, headers=_NO_STORE)


@cache
def _assets() -> dict[str, bytes]:
    """Return the scripts and the style sheet by name; the player is the same as in the report."""
    player = player_parts()
    folder = resources.files("crashhunt.dashboard").joinpath("static")
    found = {name: folder.joinpath(name).read_bytes() for name in _SCRIPTS}
    return {
        **found,
        "player.js": player.script.encode(),
        "numbers.js": player.numbers.encode(),
        "player.css": player.style.encode(),
    }


@cache
def _plotly() -> bytes:
    """Return the script of plotly from its Python package, with its single large function in parentheses.

    A browser compiles a function in parentheses while the script loads. A browser compiles any other function at its
    first call, which would delay the first view of the page by 0.2 s.
    """
    script = resources.files("plotly").joinpath("package_data", "plotly.min.js").read_bytes()
    head, opening, rest = script.partition(b" : this, () => {\n")
    if not opening or not rest.endswith(b"\n}));"):
        return script  # another version of plotly may be built in another way
    return b"".join([head, b" : this, (() => {\n", rest.removesuffix(b"));"), b")));"])


@cache
def _stamp(name: str) -> str:
    """Return a value that changes when the file changes."""
    data = _plotly() if name == "plotly.js" else _assets()[name]
    return hashlib.blake2b(data, digest_size=6).hexdigest()


def _lasting(request: Request, name: str) -> dict[str, str]:
    """Return how long a browser may cache a file: for ever if its address contains the version."""
    fits = request.query_params.get("v") == _stamp(name)
    return {"cache-control": "public, max-age=31536000, immutable" if fits else "no-cache"}


def _page_route(name: str) -> Callable[[Request], Response]:
    def show(_request: Request) -> Response:
        return Response(_page(name), media_type="text/html", headers={"cache-control": "no-cache"})

    return show


@cache
def _page(name: str) -> bytes:
    """Return an HTML page, with the player inserted and with a version in the address of each script."""
    text = resources.files("crashhunt.dashboard").joinpath("static", f"{name}.html").read_text(encoding="utf-8")
    text = text.replace("<!--PLAYER-->", player_parts().controls)
    for asset in (*_assets(), "plotly.js"):
        text = text.replace(f'"/static/{asset}"', f'"/static/{asset}?v={_stamp(asset)}"')
    return text.encode()
