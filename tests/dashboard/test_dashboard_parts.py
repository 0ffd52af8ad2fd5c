"""Parts of the dashboard without a server: jobs, addresses, browsers, and when figures that read all trials are due."""

from __future__ import annotations

import os
import signal
import socket
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from crashhunt.base import pacing
from crashhunt.base.errors import HuntDirectoryError, UsageError
from crashhunt.dashboard import _control, _hunt_page as _hunt, _server
from crashhunt.dashboard._control import Jobs, stop_hunt
from crashhunt.dashboard._hunt_page import HuntView, read_tail
from crashhunt.dashboard._server import Address


@pytest.fixture
def jobs(tmp_path, monkeypatch):
    """Returns a function that makes jobs whose command is a shell script."""
    made = []

    def make(script):
        path = tmp_path / "python"
        path.write_text(f"#!/bin/sh\n{script}\n")
        path.chmod(0o700)
        monkeypatch.setattr(_control, "sys", SimpleNamespace(executable=str(path)))
        made.append(Jobs())
        return made[-1]

    yield make
    for one in made:
        one.close()


def ended(jobs, count, hunt="h", crash="c"):
    """Return the jobs of a crash as soon as so many are over."""
    seconds = threading.Event()
    for _ in range(6_000):
        found = jobs.list(hunt, crash)
        if sum(job["state"] in ("ended", "failed") for job in found) >= count:
            return found
        seconds.wait(0.01)
    raise AssertionError(found)


def test_jobs_run_one_after_another_and_keep_their_output(jobs, tmp_path):
    made = jobs('echo "$@"; test "$4" != judge')
    assert made.add("h", tmp_path, "c", "replay") == {
        "job": 1, "hunt": "h", "crash": "c", "name": "replay", "state": "waiting", "exit_code": None, "output": ""
    }  # fmt: skip
    made.add("h", Path("-x"), "other", "shrink")
    made.add("h", Path("p"), "c", "judge")
    latest, first = ended(made, 2)
    assert (first["job"], first["state"], first["exit_code"]) == (1, "ended", 0)
    assert first["output"] == f"-P -m crashhunt replay --crash c -- {tmp_path}\n"
    assert (latest["job"], latest["name"], latest["exit_code"]) == (3, "judge", 1)
    (other,) = ended(made, 1, crash="other")
    assert other["output"] == "-P -m crashhunt shrink --crash other -- -x\n"
    assert made.list("elsewhere", "c") == []
    with pytest.raises(UsageError, match="there is no job 'rm'; give one of replay, judge, shrink"):
        made.add("h", tmp_path, "c", "rm")


def test_end_of_the_output_is_kept_without_colours(jobs, tmp_path):
    made = jobs("printf '\\033[31m%05d\\033[0m\\007' $(seq 1000)")
    made.add("h", tmp_path, "c", "replay")
    (found,) = ended(made, 1)
    assert found["output"].endswith("01000\\x07")
    assert "\x1b" not in found["output"]
    assert "\x07" not in found["output"]
    assert len(found["output"].replace("\\x07", "\x07")) == 4_000


def test_characters_and_colours_may_arrive_in_parts(jobs, tmp_path):
    made = jobs("printf '\\303'; sleep 0.02; printf '\\251\\033[3'; sleep 0.02; printf '1mred'")
    made.add("h", tmp_path, "c", "replay")
    (found,) = ended(made, 1)
    assert found["output"] == "éred"


def test_command_that_cannot_start_has_failed(jobs, tmp_path, monkeypatch):
    made = jobs("")
    monkeypatch.setattr(_control, "sys", SimpleNamespace(executable=str(tmp_path / "nothing")))
    made.add("h", tmp_path, "c", "replay")
    (found,) = ended(made, 1)
    assert (found["state"], found["exit_code"]) == ("failed", None)
    assert "No such file" in found["output"]


def test_waiting_jobs_are_limited_and_end_with_the_dashboard(jobs, tmp_path, monkeypatch):
    monkeypatch.setattr(_control, "_MAX_WAITING", 2)
    made = jobs("trap 'echo stopped; exit 130' INT; echo begun; while :; do sleep 0.01; done")
    made.add("h", tmp_path, "c", "replay")
    wait = threading.Event()
    while not (found := made.list("h", "c"))[0]["output"]:
        wait.wait(0.01)
    assert (found[0]["state"], found[0]["output"]) == ("running", "begun\n")
    made.add("h", tmp_path, "c", "judge")
    made.add("h", tmp_path, "c", "shrink")
    with pytest.raises(UsageError, match="jobs are waiting"):
        made.add("h", tmp_path, "c", "judge")
    made.close()
    *waiting, first = made.list("h", "c")
    assert (first["exit_code"], first["output"]) == (130, "begun\nstopped\n")
    assert [job["state"] for job in waiting] == ["waiting", "waiting"]


def hunt_of(state="running", host=None, pid=77):
    owner = {"host": host or socket.gethostname(), "pid": pid}
    return SimpleNamespace(refresh=lambda: SimpleNamespace(state=state), facts={"owner": owner} if pid else {})


def test_hunt_of_this_machine_is_interrupted_as_by_ctrl_c(monkeypatch):
    sent = []
    monkeypatch.setattr(_control.os, "kill", lambda *words: sent.append(words))
    stop_hunt(hunt_of())
    assert sent == [(77, signal.SIGINT)]
    for hunt, told in (
        (hunt_of("crashed"), ("its state is crashed",)),
        (hunt_of(pid=0), ("its state is running",)),
        (hunt_of(host="far"), ("far", "kill -INT 77")),
    ):
        with pytest.raises(UsageError) as caught:
            stop_hunt(hunt)
        assert all(words in str(caught.value) for words in told)
    assert len(sent) == 1

    def gone(*_):
        raise ProcessLookupError

    monkeypatch.setattr(_control.os, "kill", gone)
    stop_hunt(hunt_of())  # it has ended in the meantime


@pytest.mark.parametrize(
    ("address", "url"),
    [
        (Address("127.0.0.1", 8642), "http://127.0.0.1:8642/"),
        (Address("::1", 1), "http://[::1]:1/"),
        (Address("0.0.0.0", 80, "a/b c"), "http://box:80/?token=a%2Fb%20c"),
        (Address("::", 80), "http://box:80/"),
    ],
)
def test_link_opens_in_a_browser_of_any_machine(address, url, monkeypatch):
    monkeypatch.setattr(_server.socket, "gethostname", lambda: "box")
    assert address.url == url


@pytest.mark.parametrize(
    ("browser", "screens", "system", "opened"),
    [
        (True, {"DISPLAY": ":0"}, "linux", 1), (True, {"WAYLAND_DISPLAY": "w"}, "linux", 1), (True, {}, "linux", 0),
        (True, {}, "darwin", 1), (False, {"DISPLAY": ":0"}, "linux", 0),
    ],
)  # fmt: skip
def test_browser_is_opened_where_there_is_a_screen(monkeypatch, browser, screens, system, opened):
    calls, announced = [], []

    class Thread:
        def __init__(self, *, target, args, daemon):
            assert daemon
            self.start = lambda: target(*args)

    monkeypatch.setattr(_server, "threading", SimpleNamespace(Thread=Thread))
    monkeypatch.setattr(_server.webbrowser, "open", calls.append)
    monkeypatch.setattr(_server.sys, "platform", system)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for name, value in screens.items():
        monkeypatch.setenv(name, value)
    address = Address("127.0.0.1", 8642, "t" * 16)
    _server._begin(address, announced.append, browser=browser)
    assert announced == [address]
    assert calls == [address.url] * opened

    def fails(url):
        raise OSError

    monkeypatch.setattr(_server.webbrowser, "open", fails)
    _server._begin(address, announced.append, browser=browser)  # no browser is no error


def test_dashboard_on_other_hosts_gets_a_token(monkeypatch, tmp_path):
    served, closed = [], []

    def make_application(catalog, **options):
        served.append(options)
        return SimpleNamespace(asgi="asgi", close=lambda: closed.append(1))

    def run_server(asgi, listening, begin):
        assert asgi == "asgi"
        begin()
        served.append(listening.getsockname()[1])

    monkeypatch.setattr("crashhunt.dashboard._application.make_application", make_application)
    monkeypatch.setattr("crashhunt.dashboard._serving.run_server", run_server)
    found = []
    for host, token, control in (("127.0.0.1", "", False), ("0.0.0.0", "", True), ("127.0.0.1", "t" * 16, False)):
        _server.serve(
            [tmp_path], host=host, port=0, token=token, browser=False, allow_control=control, announce=found.append
        )
    assert [options["allow_control"] for options in served[::2]] == [False, True, False]
    assert [options["host"] for options in served[::2]] == ["127.0.0.1", "0.0.0.0", "127.0.0.1"]
    assert [address.port for address in found] == served[1::2]
    tokens = [options["token"] for options in served[::2]]
    assert tokens == [address.token for address in found]
    assert (tokens[0], len(tokens[1]), tokens[2]) == ("", 32, "t" * 16)
    assert len(closed) == 3
    for token in ("t" * 15, "ä" * 16, "a b" * 8, "a\n" * 8):
        with pytest.raises(UsageError, match=rf"--token has {len(token)} characters"):
            _server.serve([tmp_path], token=token, announce=found.append)
    with pytest.raises(UsageError, match="does not exist"):
        _server.serve([tmp_path / "nothing"], announce=found.append)


@pytest.fixture
def view(tmp_path, monkeypatch):
    """A view of a hunt whose trials take 2 s to read, on a clock of the test."""
    made = HuntView(SimpleNamespace(path=tmp_path, root=tmp_path))
    made.clock, made.reads, made.closed = [100.0], [], []

    def read(*words):
        made.reads.append(made.clock[0])
        made.clock[0] += 2.0
        if made.reads[-1] > 10_000:
            raise HuntDirectoryError("damaged", fix="see check")
        return SimpleNamespace(to_json=lambda: dict.fromkeys(
            ("per", "confidence", "method", "units", "crashes", "estimate", "certain", "why_not", "left_out", "more"),
            len(made.reads),
        ))  # fmt: skip

    def ledger(path, *, read_only):
        assert (path, read_only) == (tmp_path / "ledger.sqlite", True)
        return SimpleNamespace(plain_results=list, close=lambda: made.closed.append(1))

    monkeypatch.setattr(pacing, "time", SimpleNamespace(monotonic=lambda: made.clock[0]))
    monkeypatch.setattr(_hunt, "rate_of_trials", read)
    monkeypatch.setattr(_hunt, "Ledger", ledger)
    monkeypatch.setattr(_hunt, "sums_of_probes", lambda ledger, facts: read() and {"probes": len(made.reads)})
    monkeypatch.setattr(_hunt, "sums_of_branches", lambda ledger, facts: None)
    return made


def test_rate_that_reads_all_trials_takes_a_twentieth_of_the_time(view):
    def rate(trials, state="running"):
        return view._rate_of_all(SimpleNamespace(state=state), None, SimpleNamespace(trials=trials), None)

    first = rate(5)
    assert set(first.values()) == {1}
    assert "more" not in first
    assert rate(5) is rate(6) is first
    assert view.reads == [100.0]
    view.clock[0] = 102.0 + 2.0 / 0.05 - 0.1
    assert rate(6) is first
    view.clock[0] += 0.1
    assert set(rate(6).values()) == {2}
    assert rate(6, "crashed") is rate(6)  # nothing is new
    assert set(rate(7, "crashed").values()) == {3}  # the last trials are read at once
    view.clock[0] = 20_000.0
    assert rate(8) == {"why_not": "damaged; see check"}
    assert len(view.closed) == len(view.reads) == 4
    many = rate(200_001)
    assert "more than 200,000; run: crashhunt rate " in many["why_not"]
    assert len(view.reads) == 4
    view.clock[0] = 30_000.0
    assert rate(200_000) == {"why_not": "damaged; see check"}
    assert len(view.reads) == 5


def test_rate_needs_settings_and_trials_and_all_trials_where_counts_do_not_suffice(view, monkeypatch):
    monkeypatch.setattr(_hunt, "held_out_traffics", lambda settings, paths: None)
    monkeypatch.setattr(_hunt, "counts_suffice", lambda settings, facts, held_out: False)
    state = SimpleNamespace(state="running")
    for settings, counts in ((None, 5), (SimpleNamespace(), None), (SimpleNamespace(), 0)):
        view.settings, view.counts = settings, None if counts is None else SimpleNamespace(trials=counts)
        assert view.rate(state) is None
    view.settings, view.counts = SimpleNamespace(), SimpleNamespace(trials=5)
    assert set(view.rate(state).values()) == {1}


def test_results_of_forks_are_summed_up_in_their_share_of_the_time(view):
    def copies(state="running", copies=True):
        view.facts, view._last = {"copies": copies, "state": state}, view.clock[0]
        view._read_copies("ledger")
        return view._sums_of_copies.get("probes")

    assert copies() == {"probes": 1}
    view.clock[0] = 102.0 + 2.0 / 0.05 - 0.1
    assert copies() == {"probes": 1}
    view.clock[0] += 0.1
    assert copies() == {"probes": 2}
    assert copies("crashed") == {"probes": 3}
    assert copies(copies=False) is None
    assert view._sums_of_copies == {}


def test_time_of_the_last_activity_is_the_latest_that_is_known(view, tmp_path):
    os.utime(tmp_path, (50.0, 60.0))
    assert view.active_at() == 60.0
    view.counts = object()
    assert view.active_at() == 0.0
    view._last, view.facts = 5.0, {"heartbeat": 7.0, "began": 3.0}
    assert view.active_at() == 7.0
    view._last = 9.0
    assert view.active_at() == 9.0


def test_tail_of_a_log_begins_with_a_whole_line(tmp_path, monkeypatch):
    def tail(most):
        monkeypatch.setattr(_hunt, "_LOG_TAIL_BYTES", most)
        return read_tail(log, tmp_path)

    log = tmp_path / "run.log"
    log.write_text("one\ntwo\nthree\n")
    assert read_tail(log, tmp_path) == tail(14) == "one\ntwo\nthree\n"
    assert tail(13) == "two\nthree\n"
    assert tail(7) == "three\n"
    assert read_tail(tmp_path / "nothing", tmp_path) == ""
    (tmp_path / "inside").mkdir()
    assert read_tail(log, tmp_path / "inside") == ""
    (tmp_path / "inside" / "link").symlink_to(log)
    assert read_tail(tmp_path / "inside" / "link", tmp_path / "inside") == ""
    log.write_bytes(b"\xff\n")
    assert read_tail(log, tmp_path) == "\ufffd\n"
