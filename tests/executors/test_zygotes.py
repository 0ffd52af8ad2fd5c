"""What zygotes and fork servers do with each message and each end of a process; forks and their ends are made up."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
from contextlib import suppress
from types import SimpleNamespace

import pytest

from crashhunt.base import forks
from crashhunt.base.errors import CrashhuntError
from crashhunt.episode import stage_of
from crashhunt.executors import _fork_server, _preparation, _warm_traffics
from crashhunt.executors._preparation import Imported
from crashhunt.executors._warm_traffics import WarmTraffics
from crashhunt.trial import TrialSpec

PID = 4321  # of each fork


class Left(BaseException):
    """In place of the end of this process."""


def leave(code):
    raise Left(code)


def sent(connection):
    """Return the messages that wait in a connection whose messages stay apart, or stand in lines."""
    found = b""
    with suppress(BlockingIOError):
        while data := connection.recv(1 << 16, socket.MSG_DONTWAIT):
            found += data if data.endswith(b"\n") else data + b"\n"
    return [json.loads(line) for line in found.splitlines()]


def spec(number, seed=1, **arguments):
    return TrialSpec(number, seed, {"ego": {}}, arguments, 30)


def job(number, seed=1, **arguments):
    return {"spec": spec(number, seed, **arguments).to_json()}


@pytest.fixture
def copies(monkeypatch):
    """Suspended processes that answer the next of `answers`; an exception is that of a fork that cannot be made."""
    found = SimpleNamespace(answers=[], asked=[], ended=[], killed=[], pids=iter(range(100, 200)), says={}, made=[])

    def fork(run, held, *, keeps=()):
        answer = found.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        wakes, says = map(os.dup, keeps)
        pid = next(found.pids)
        found.says[pid] = wakes, says
        found.made.append((run.args[-1].number, pid))
        reply(pid, answer)
        return pid

    def reply(pid, answer):
        wakes, says = found.says[pid]
        if answer is None:
            os.close(says)
            found.says[pid] = wakes, None
        else:
            os.write(says, json.dumps(answer).encode() + b"\n")

    def wait(descriptor, kill):
        """In place of the zygote's: it has the process answer what it was asked."""
        for pid, (wakes, says) in list(found.says.items()):
            if select.select([wakes], [], [], 0)[0] and (data := os.read(wakes, 1 << 16)):
                found.asked.append((pid, json.loads(data)["spec"]["number"]))
                if says is not None:
                    reply(pid, found.answers.pop(0))
        found.kill = kill
        assert select.select([descriptor], [], [], 1)[0]

    def ended(pid):
        found.ended.append(pid)
        return -signal.SIGTERM

    monkeypatch.setattr(forks, "fork", fork)
    monkeypatch.setattr(forks, "ended", ended)
    monkeypatch.setattr(forks, "held", lambda: "held")
    monkeypatch.setattr(_warm_traffics, "free_memory", lambda: 1.0)
    monkeypatch.setattr(_warm_traffics, "children_of", lambda pid: [pid + 1000] if pid in found.says else [])
    monkeypatch.setattr(_warm_traffics, "kill", found.killed.append)
    found.wait = wait
    yield found
    for pair in found.says.values():
        for descriptor in pair:
            if descriptor is not None:
                os.close(descriptor)


@pytest.fixture
def warm(copies):
    """Makes suspended processes for so many traffics; `notes` are the texts for the user."""
    made = []

    def make(limit):
        copies.notes = []
        found = WarmTraffics(limit, copies.notes.append)
        found.prepare("trial", "simulator")
        made.append(found)
        return found

    yield make
    for one in made:
        one.forget()


SLOW, FAST, RAN = {"took_s": 0.5}, {"took_s": 0.001}, {"pid": 77, "ended": 0}


def test_trials_of_one_traffic_run_in_its_copy(warm, copies):
    traffics = warm(2)
    copies.answers = [SLOW, RAN, {"pid": 78, "ended": -9}, SLOW, RAN]
    ran = [traffics.run(one, copies.wait) for one in (job(0), job(1), job(2, seed=2))]
    assert ran == [(77, 0), (78, -9), (77, 0)]
    assert copies.asked == [(100, 0), (100, 1), (101, 2)]
    assert copies.made == [(0, 100), (2, 101)]
    assert traffics.processes == {100, 101}
    # A trial that has to be killed is a child of the copy; a copy that is still warming up has none.
    copies.kill()
    assert copies.killed == [1101]
    copies.says[101], kept = None, copies.says.pop(101)
    copies.says.pop(101)
    copies.kill()
    assert copies.killed == [1101, 101]
    copies.says[101] = kept
    assert traffics.run(job(3, density=0.5), copies.wait) is None  # the oldest copy is used too recently
    assert (copies.ended, copies.notes) == ([], [])
    traffics.forget()
    assert traffics.processes == frozenset()


def test_copy_that_is_not_used_makes_room(warm, copies):
    traffics = warm(1)
    copies.answers = [SLOW, RAN] + [RAN] * 2
    for number in range(3):
        traffics.run(job(number), copies.wait)
    assert [traffics.run(job(number, seed=2), copies.wait) for number in range(7)] == [None] * 7
    copies.answers = [SLOW, RAN]
    assert traffics.run(job(11, seed=3), copies.wait) == (77, 0)
    assert copies.ended == [100]
    assert sorted(copies.killed) == [100, 1100]
    assert traffics.processes == {101}


def test_without_free_memory_no_copy_is_made(warm, copies, monkeypatch):
    monkeypatch.setattr(_warm_traffics, "free_memory", lambda: 0.0)
    assert warm(2).run(job(0), copies.wait) is None
    assert "of the memory is free: fewer warmed-up copies are kept" in copies.notes[0]
    assert copies.made == []


def test_warm_up_that_is_short_ends_the_search_for_one(warm, copies):
    traffics = warm(2)
    copies.answers = [FAST]
    assert traffics.run(job(0), copies.wait) is None
    assert traffics.run(job(1, seed=2), copies.wait) is None
    assert len(copies.made) == 1
    assert copies.ended == [100]
    assert copies.notes == []
    copies.answers = [{"took_s": 0.02}, RAN]
    assert warm(2).run(job(0), copies.wait) == (77, 0)
    assert warm(0).run(job(0), copies.wait) is None
    unprepared = WarmTraffics(2, copies.notes.append)
    assert unprepared.run(job(0), copies.wait) is None


@pytest.mark.parametrize("answer", [{}, None])
def test_reset_that_fails_concerns_its_own_traffic(warm, copies, answer):
    traffics = warm(2)
    copies.answers = [answer, SLOW, RAN]
    assert traffics.run(job(0), copies.wait) is None
    assert traffics.processes == frozenset()
    assert traffics.run(job(1, seed=2), copies.wait) == (77, 0)
    assert copies.ended == [100]


def test_copy_that_was_killed_loses_its_trial(warm, copies):
    traffics = warm(2)
    copies.answers = [SLOW, None, SLOW, RAN]
    assert traffics.run(job(0), copies.wait) == (100, -signal.SIGTERM)
    assert traffics.processes == frozenset()
    assert traffics.run(job(1), copies.wait) == (77, 0)


def test_traffic_that_cannot_be_forked_is_reported_once(warm, copies):
    traffics = warm(2)
    copies.answers = [SLOW, {"unfit": "it has threads"}]
    assert [traffics.run(job(number), copies.wait) for number in range(2)] == [None, None]
    assert copies.notes == ["trials in the same traffic do not share its warm-up: it has threads"]
    assert copies.ended == [100]
    traffics = warm(2)
    copies.answers = [forks.CannotForkError("no memory")]
    assert [traffics.run(job(number), copies.wait) for number in range(2)] == [None, None]
    assert copies.notes == ["trials in the same traffic do not share its warm-up: no memory"]


@pytest.fixture
def zygote(monkeypatch, tmp_path):
    """A zygote whose trials are forks that have ended; `supervisor` is the other end of its connection."""
    ours, theirs = socket.socketpair()
    settings = SimpleNamespace(
        warm_copies=0, scratch=tmp_path, scenario=SimpleNamespace(agents={}), reuses=(), argument_files=()
    )
    trial = SimpleNamespace(
        make_simulator=lambda: "simulator", record_shared_state=lambda control: "", run=lambda job: leave("trial")
    )
    spared, killed, adopted = [], [], []
    monkeypatch.setattr(_fork_server, "TrialProcess", lambda *given: trial)
    monkeypatch.setattr(_fork_server, "adopt_orphans", lambda: adopted.append(True))
    monkeypatch.setattr(_fork_server, "end_descendants", lambda *given: spared.extend(given or [None]))
    monkeypatch.setattr(_fork_server, "kill", killed.append)
    monkeypatch.setattr(_fork_server.gc, "freeze", lambda: None)
    monkeypatch.setattr(os, "_exit", leave)
    found = _fork_server._Zygote(theirs, settings, Imported(None, makes_simulator=True))
    assert adopted
    found.test = SimpleNamespace(supervisor=ours, trial=trial, spared=spared, killed=killed, settings=settings)
    with ours, theirs:
        yield found


def test_zygote_reports_each_trial_and_whether_another_may_follow(zygote, monkeypatch):
    supervisor, codes = zygote.test.supervisor, iter([0, -9, 3])
    stage = stage_of(zygote.test.settings.scratch, os.getpid())
    stage.mkdir(parents=True)

    def run(given):
        if given["spec"]["number"] == 1:
            zygote._notices.append("a notice")
        if given["spec"]["number"] == 2:
            (stage / "a file").touch()
            os.utime(stage, (1, 1))
        return PID, next(codes)

    monkeypatch.setattr(zygote, "_run", run)
    zygote.test.trial.record_shared_state = lambda control: "a pipe" if control == zygote._control.fileno() else ""
    for number in range(3):
        supervisor.sendall(json.dumps(job(number)).encode() + b"\n" + b'{"kill": true}\n')
    supervisor.shutdown(socket.SHUT_WR)
    zygote.serve()
    notice = (
        "trials are not wholly apart: a module shares a pipe with every one of them; if it is yours, "
        "open this in reset instead"
    )
    assert sent(supervisor) == [
        {"ready": os.getpid()},
        {"ended": 0, "pid": PID, "unfit": False, "notices": [notice]},
        {"ended": -9, "pid": PID, "unfit": False, "notices": ["a notice"]},
        {"ended": 3, "pid": PID, "unfit": True},
    ]


def test_simulator_that_cannot_be_made_is_reported(zygote):
    def reports(error):
        def fails():
            raise error

        zygote.test.trial.make_simulator = fails
        zygote.serve()
        ((said),) = sent(zygote.test.supervisor)
        return said["error"]["message"], said["error"]["fix"]

    assert reports(CrashhuntError("no map", fix="draw one")) == ("no map", "draw one")
    message, fix = reports(OSError(28, "No space left"))
    assert message.startswith("the simulator cannot be made: OSError: ")
    assert fix == "free some space, and run the same command again"
    assert reports(ValueError("odd")) == (
        "the simulator cannot be made: ValueError: odd", "see to what it needs, and run the same command again",
    )  # fmt: skip


@pytest.mark.parametrize("reports", [True, False])
def test_trial_runs_in_a_fork_that_is_waited_for(zygote, monkeypatch, reports):
    supervisor, opened, looks = zygote.test.supervisor, [], []
    watch = SimpleNamespace(look=lambda: looks.append(True), remove=lambda: None)
    monkeypatch.setattr(_fork_server, "SharedMemoryWatch", lambda: watch)
    waited = iter([(0, 0), (0, 0), (PID, 3 << 8)])

    def pidfd_open(pid):
        if not reports:
            raise OSError
        read, write = os.pipe()
        os.write(write, b".")
        opened.append((pid, write))
        return read

    monkeypatch.setattr(os, "fork", lambda: PID)
    monkeypatch.setattr(os, "pidfd_open", pidfd_open)
    monkeypatch.setattr(os, "waitpid", lambda pid, options: next(waited))
    monkeypatch.setattr(_fork_server, "ended", lambda pid: 3 if pid == PID else None)
    zygote._makes_simulator = False
    stage = stage_of(zygote.test.settings.scratch, PID)
    stage.mkdir(parents=True)
    supervisor.sendall(b'{"kill": true}\n')
    assert zygote._run(job(0)) == (PID, 3)
    assert zygote.test.killed == [PID]
    assert zygote.test.spared == [frozenset()]
    assert len(looks) > 1  # at its shared memory, also while it runs: its death would hide this
    assert not stage.exists()
    assert [pid for pid, _ in opened] == [PID] * reports
    for _, write in opened:
        os.close(write)


def test_zygote_without_a_supervisor_ends_its_trial(zygote):
    zygote.test.supervisor.close()
    killed = []
    with pytest.raises(Left, match="0"):
        zygote._wait(None, lambda: killed.append(True))
    assert killed
    assert zygote.test.spared == [frozenset()]


def test_copies_are_spared_when_a_trial_has_ended(zygote, monkeypatch):
    waits = []

    def run(given, wait):
        waits.append(wait)
        return PID, 0

    zygote._warm = SimpleNamespace(run=run, processes=frozenset({5}))
    assert zygote._run(job(0)) == (PID, 0)
    assert zygote.test.spared == [frozenset({5})]
    assert waits == [zygote._wait]


def test_process_of_a_trial_has_no_connection_to_the_supervisor(zygote, monkeypatch):
    died, forgotten = [], []
    monkeypatch.setattr(os, "fork", lambda: 0)
    monkeypatch.setattr(_fork_server, "die_with", died.append)
    zygote._warm = SimpleNamespace(run=lambda *_: None, processes=frozenset(), forget=lambda: forgotten.append(True))
    with pytest.raises(Left, match="trial"):
        zygote._run(job(0))
    assert (died, forgotten) == ([os.getpid()], [True])
    assert zygote._control.fileno() == -1


@pytest.fixture
def server(monkeypatch):
    """A fork server whose forks are made up; `pool` and `template` are the other ends of its connections."""
    pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(2)]
    (pool, control), (template, orders) = pairs
    found = _fork_server._Server(control, orders, 55, SimpleNamespace(timeout_s=9.0), "conditions")
    found.test = SimpleNamespace(
        pool=pool, template=template, killed=[], waits=[], resumed=[], spared=[], own_kills=[], signals=[]
    )
    monkeypatch.setattr(_fork_server, "kill", found.test.killed.append)
    monkeypatch.setattr(_fork_server, "resume", found.test.resumed.append)
    monkeypatch.setattr(_fork_server, "end_descendants", lambda *given: found.test.spared.extend(given or [None]))
    monkeypatch.setattr(os, "_exit", leave)
    monkeypatch.setattr(os, "fork", lambda: PID)
    monkeypatch.setattr(os, "kill", lambda pid, number: found.test.own_kills.append((pid, number)))
    monkeypatch.setattr(_fork_server.signal, "signal", lambda *given: found.test.signals.append(given))

    def waitpid(pid, options):
        if not found.test.waits:
            raise ChildProcessError
        return found.test.waits.pop(0)

    monkeypatch.setattr(os, "waitpid", waitpid)
    yield found
    for descriptor in found._ends.values():
        os.close(descriptor)
    for one in (*pairs[0], *pairs[1]):
        one.close()


def start(server, slot):
    """Ask for the supervisor of a slot."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        socket.send_fds(server.test.pool, [json.dumps({"slot": slot}).encode()], [theirs.fileno()])
        return server._handle_request()


def test_supervisor_is_started_killed_and_reported(server, monkeypatch):
    opened = []

    def pidfd_open(pid):
        opened.append(pid)
        return os.open(os.devnull, os.O_RDONLY)

    monkeypatch.setattr(os, "pidfd_open", pidfd_open)
    assert start(server, 3)
    monkeypatch.setattr(os, "fork", lambda: PID + 1)
    assert start(server, 4)
    for _ in range(2):
        data, descriptors, _, _ = socket.recv_fds(server.test.template, 100, 1)
        assert data == b"zygote"
        os.close(descriptors[0])
    assert opened == [PID, PID + 1]
    server.test.pool.send(b'{"kill": 4}')
    assert server._handle_request()
    assert server.test.killed == [PID + 1]
    server.test.waits = [(PID, 3 << 8), (9, 0), (0, 0)]
    assert not server._reap()
    assert sent(server.test.pool) == [{"slot": 3, "pid": PID, "exit_code": 3}]
    assert (set(server._slots), set(server._ends)) == ({PID + 1}, {PID + 1})
    assert server._reap()  # no process is left
    server.test.pool.close()
    assert not server._handle_request()


def test_messages_of_the_template_are_forwarded_but_for_its_imports(server):
    template = server.test.template
    assert server._watch.importing
    template.send(b'{"importing": "the module planner"}')
    assert server._forward_template_messages()
    assert (server._watch.importing, sent(server.test.pool)) == ("the module planner", [])
    for text in (b'{"ready": 5}', b'{"unfit": true}', b'{"unfit": 1}', b"[", b"5"):
        template.send(text)
    error = CrashhuntError("no planner", fix="write one", where="here").to_json()
    template.send(json.dumps(error).encode())
    assert server._forward_template_messages()
    assert sent(server.test.pool) == [{"ready": 5}, {"unfit": True}, {}, {}, {}, error]
    assert server._watch.importing == ""
    template.close()
    assert not server._forward_template_messages()


@pytest.mark.parametrize(
    ("importing", "code", "says"),
    [
        ("", 3, []),
        ("", -signal.SIGKILL, []),
        ("the module planner", -signal.SIGKILL, [{"importing": "the module planner"}]),
        ("the module planner", 3, ["the module planner: its process exited with 3 meanwhile"]),
        ("", -signal.SIGSEGV, []),
    ],
)
def test_server_ends_as_its_template_did(server, importing, code, says):
    server._watch.begin(importing)
    server.test.waits = [(55, -code if code < 0 else code << 8)]
    with pytest.raises(Left) as caught:
        server._reap()
    assert caught.value.args == (code & 0xFF,)  # after the signal, which the test does not send
    assert server.test.own_kills == [(os.getpid(), -code)] * (code < 0)
    assert server.test.spared == [None] * (code < 0)
    assert server.test.signals == [(-code, signal.SIG_DFL)] * (code == -signal.SIGSEGV)
    found = [message if "importing" in message else message["error"]["message"] for message in sent(server.test.pool)]
    assert found == says


@pytest.mark.parametrize("end", ["pool", "template", "hangs", "no process"])
def test_server_serves_until_the_pool_or_the_template_has_ended(server, monkeypatch, end):
    server.test.waits = [(0, 0), (55, 4 << 8)]
    server._watch.begin("the module planner" if end == "hangs" else "")
    rounds = []

    def over(*given):
        server.test.spared.extend(given)
        rounds.append(True)
        if end == "pool":
            server.test.pool.close()
        elif end == "template":
            server.test.template.close()
        elif end == "hangs":
            server._watch._ends_at = 0.0
        else:
            server.test.waits.clear()

    monkeypatch.setattr(_fork_server, "end_descendants", over)
    monkeypatch.setattr(_fork_server, "_ORPHANS_EVERY_S", 0.01)
    server._slots[PID] = 3
    if end == "template":
        with pytest.raises(Left, match="4"):
            server.serve()
    else:
        server.serve()
    assert len(rounds) == 1
    assert server.test.spared == [frozenset({PID, 55})]
    assert server.test.resumed == [55, PID]
    assert server.test.killed == [55] * (end == "hangs")
    if end == "hangs":
        (said,) = sent(server.test.pool)
        assert said["error"]["message"].startswith("the module planner: it takes more than ")


def test_server_whose_template_is_gone_gives_no_supervisor(server):
    server.test.template.close()
    server.test.waits = [(55, 6 << 8)]
    server._watch.begin("")
    with pytest.raises(Left, match="6"):
        start(server, 3)


@pytest.fixture
def template(monkeypatch):
    """What a template or a fork server is made of: `imported` is the result of its imports, or its error."""
    found = SimpleNamespace(imported="imported", late=[], forked=0, called=[], orphans=[], signals=[])
    made = []

    class Tracked(socket.socket):
        """Closed at the end of the test: what would be another process closes nothing."""

        def __init__(self, *given, **more):
            super().__init__(*given, **more)
            made.append(self)

    monkeypatch.setattr(socket, "socket", Tracked)
    found.pool, found.orders = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)

    def imports(settings, report=None):
        if report:
            report("a module")
        found.late.append(report is None)
        if isinstance(found.imported, Exception):
            raise found.imported
        return found.imported

    def zygote(control, settings, imported):
        found.called.append(("zygote", control.fileno() >= 0, settings, imported))
        leave("zygote")

    monkeypatch.setattr(_fork_server, "import_parts", imports)
    monkeypatch.setattr(_fork_server, "import_nothing", lambda settings: imports(settings))
    monkeypatch.setattr(_fork_server, "be_zygote", zygote)
    monkeypatch.setattr(_fork_server, "die_with", lambda pid: found.called.append(("dies with", pid)))
    monkeypatch.setattr(_fork_server, "prepare", lambda what: found.called.append("prepared"))
    monkeypatch.setattr(_fork_server, "gc", SimpleNamespace(freeze=lambda: None, collect=lambda: None))
    monkeypatch.setattr(_fork_server, "adopt_orphans", lambda: found.called.append("adopts"))
    monkeypatch.setattr(_fork_server, "end_descendants", found.orphans.append)
    monkeypatch.setattr(_fork_server, "_ORPHANS_EVERY_S", 0.01)
    monkeypatch.setattr(_fork_server.signal, "signal", lambda *given: found.signals.append(given))
    monkeypatch.setattr(os, "setsid", lambda: found.called.append("own session"))
    monkeypatch.setattr(os, "_exit", leave)
    monkeypatch.setattr(os, "fork", lambda: found.forked)
    yield found
    for one in made:
        one.close()


@pytest.mark.parametrize("late", [False, True])
def test_template_forks_a_zygote_for_each_request(template, monkeypatch, late):
    ours, theirs = socket.socketpair()
    ends = iter([(0, 0), (PID, 0), (0, 0), None])

    def waitpid(pid, options):
        assert (pid, options) == (-1, os.WNOHANG)
        end = next(ends)
        if end is None:
            sent(template.pool)
            template.pool.close()
            raise ChildProcessError
        return end

    monkeypatch.setattr(os, "waitpid", waitpid)
    template.forked = PID
    with ours, theirs:
        socket.send_fds(template.pool, [b"zygote"], [theirs.fileno()])
        with pytest.raises(Left, match="0"):
            _fork_server._be_template(template.orders, "settings", late=late)
    assert template.late == [late]
    assert template.orphans == [frozenset({PID}), frozenset(), frozenset()]
    assert template.called == ["adopts"]


def test_template_reports_imports_and_readiness(template, monkeypatch):
    template.imported = None
    _fork_server._be_template(template.orders, "settings", late=False)
    assert sent(template.pool) == [{"importing": "a module"}, {"unfit": True}]
    template.imported = CrashhuntError("no planner", fix="write one")
    _fork_server._be_template(template.orders, "settings", late=True)
    assert sent(template.pool) == [template.imported.to_json()]
    template.imported = "imported"
    ours, theirs = socket.socketpair()
    with ours, theirs:  # as the zygote
        socket.send_fds(template.pool, [b"zygote"], [theirs.fileno()])
        with pytest.raises(Left, match="zygote"):
            _fork_server._be_template(template.orders, "settings", late=True)
    assert sent(template.pool) == [{"ready": os.getpid()}]
    assert template.called[-3:] == [
        ("dies with", os.getpid()), "own session", ("zygote", True, "settings", "imported"),
    ]  # fmt: skip
    assert template.signals == [(number, signal.SIG_DFL) for number in _fork_server._IGNORED_SIGNALS]
    assert {signal.SIGINT, signal.SIGTERM} <= {number for number, _ in template.signals}
    assert template.orders.fileno() == -1


@pytest.mark.parametrize("sys_path", [[], ["/mine"]])
def test_fork_server_begins_with_its_job(template, monkeypatch, tmp_path, sys_path):
    began = []
    job = tmp_path / "job"
    job.write_text(json.dumps({"settings": "plain", "sys_path": sys_path, "late": True}))
    control, pool = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    settings = SimpleNamespace(code=("code",), timeout_s=9.0)
    monkeypatch.setattr(_fork_server.sys, "argv", ["it", str(os.dup(control.fileno())), str(job)])
    monkeypatch.setattr(_fork_server.sys, "path", ["before"])
    monkeypatch.setattr(_fork_server.WorkerSettings, "from_json", lambda plain: plain == "plain" and settings)
    monkeypatch.setattr(_fork_server, "require_origin", lambda *given: began.append(("origin", *given)))
    monkeypatch.setattr(_fork_server, "HostConditions", lambda given: given)
    monkeypatch.setattr(_fork_server, "seal", lambda given: began.append(("sealed", given)))
    monkeypatch.setattr(_fork_server._Server, "serve", lambda self: began.append((self._template, self._settings)))
    template.forked = PID
    with control, pool:
        _fork_server.main()
        origin = [] if sys_path else [("origin", "crashhunt", ("code",))]
        assert began == [*origin, ("sealed", settings), (PID, settings)]
        assert _fork_server.sys.path == (sys_path or ["before"])
        assert template.signals == [(number, signal.SIG_IGN) for number in _fork_server._IGNORED_SIGNALS]
        assert template.called == ["adopts", "prepared"]

        def fails(given):
            raise CrashhuntError("no sandbox", fix="x")

        monkeypatch.setattr(_fork_server, "seal", fails)
        monkeypatch.setattr(_fork_server.sys, "argv", ["it", str(os.dup(control.fileno())), str(job)])
        _fork_server.main()
        assert sent(pool) == [CrashhuntError("no sandbox", fix="x").to_json()]
        monkeypatch.setattr(_fork_server, "seal", lambda given: None)
        monkeypatch.setattr(_fork_server.sys, "argv", ["it", str(os.dup(control.fileno())), str(job)])
        be_template = lambda orders, given, *, late: began.append((given, late))  # noqa: E731
        monkeypatch.setattr(_fork_server, "_be_template", be_template)
        template.forked = 0
        with pytest.raises(Left, match="1"):
            _fork_server.main()
        assert began[-1] == (settings, True)
        assert template.called[-1] == ("dies with", os.getpid())


def test_supervisor_has_the_connections_of_its_slot_only(server, monkeypatch):
    became = []

    def become(pool, zygote, settings, conditions, parent):
        became.append((pool.fileno() >= 0, zygote.fileno() >= 0, settings, conditions, parent))
        leave("supervisor")

    monkeypatch.setattr(os, "fork", lambda: 0)
    monkeypatch.setattr(_fork_server, "be_supervisor", become)
    read, write = os.pipe()
    os.close(write)
    server._ends[77] = read
    with pytest.raises(Left, match="supervisor"):
        start(server, 3)
    assert became == [(True, True, server._settings, "conditions", os.getpid())]
    assert (server._control.fileno(), server._orders.fileno()) == (-1, -1)
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.close(server._ends.pop(77))
    defaults = [(number, signal.SIG_DFL) for number in _fork_server._IGNORED_SIGNALS]
    assert server.test.signals == [*defaults, (signal.SIGINT, signal.SIG_IGN)]


def test_suspended_process_resets_once_and_runs_each_trial_in_a_fork(monkeypatch):
    wakes, asks = os.pipe()
    told, says = os.pipe()
    forked, drawn, resets, ran = [], [], [], []
    simulator = SimpleNamespace(setup_steps=40)

    def fork(run, held):
        forked.append(held)
        if len(forked) == 2:
            raise forks.CannotForkError("it has threads")
        run()
        return PID

    def reset(*, seed, options):
        resets.append((seed, options))
        return "observations"

    simulator.reset = reset
    monkeypatch.setattr(_warm_traffics, "adopt_orphans", lambda: None)
    monkeypatch.setattr(_warm_traffics, "seed_everything", drawn.append)
    monkeypatch.setattr(_warm_traffics, "options_of", lambda given, made: (given.number, made is simulator))
    monkeypatch.setattr(_warm_traffics, "generators", lambda: "drawn")
    monkeypatch.setattr(_warm_traffics, "set_generators", drawn.append)
    monkeypatch.setattr(_warm_traffics, "supports", lambda made, what: True)
    monkeypatch.setattr(_warm_traffics, "end_descendants", lambda: drawn.append("ended"))
    monkeypatch.setattr(forks, "fork", fork)
    monkeypatch.setattr(forks, "held", lambda: "held")
    monkeypatch.setattr(forks, "ended", lambda pid: 3 if pid == PID else None)
    trial = SimpleNamespace(run=lambda given, again: ran.append((given["spec"]["number"], again(seed=1))))
    for number in range(2):
        os.write(asks, json.dumps(job(number)).encode() + b"\n")
    os.close(asks)
    _warm_traffics._be_suspended(wakes, says, trial, simulator, spec(7, seed=5))
    first, *answers = map(json.loads, os.read(told, 1 << 16).splitlines())
    assert 0 <= first["took_s"] < 5
    assert answers == [{"pid": PID, "ended": 3}, {"unfit": "it has threads"}]
    assert resets == [(5, (7, True))]
    assert ran == [(0, "observations")]
    assert drawn == [5, "drawn", "ended"]
    assert simulator.setup_steps == 0
    assert forked == ["held", "held"]

    def fails(**given):
        raise KeyboardInterrupt

    simulator.reset = fails
    _warm_traffics._be_suspended(wakes, says, trial, simulator, spec(7))
    assert json.loads(os.read(told, 100)) == {}
    for descriptor in (wakes, told, says):
        os.close(descriptor)


def test_traffic_is_that_of_seed_and_arguments_of_the_scenario():
    plain = _warm_traffics._traffic_key(spec(1))
    assert _warm_traffics._traffic_key(spec(2)) == plain
    for other in (spec(1, seed=2), spec(1, density=0.5)):
        assert _warm_traffics._traffic_key(other) != plain
    assert _warm_traffics._traffic_key(spec(1, a=1, b=2)) == _warm_traffics._traffic_key(spec(1, b=2, a=1))


@pytest.mark.parametrize("fails", [False, True])
def test_rehearsal_comes_before_the_imports_and_leaves_nothing(tmp_path, monkeypatch, fails):
    said = []
    settings = SimpleNamespace(scenario=SimpleNamespace(backend=SimpleNamespace(forkable=True)), scratch=tmp_path)
    parts = SimpleNamespace(load=lambda report: report(f"a module, {len(rehearsed)} rehearsals"))
    rehearsed = []
    run = _preparation.run_episode

    def run_episode(*given, **options):
        rehearsed.append(given)
        if fails:
            raise RuntimeError("whatever it is")
        return run(*given, **options)

    monkeypatch.setattr(_preparation, "run_episode", run_episode)
    monkeypatch.setattr(_preparation, "Parts", lambda _: parts)
    monkeypatch.setattr(_preparation, "_can_be_forked", lambda: True)
    assert _preparation.import_parts(settings, said.append) is not None
    assert said[:2] == ["Gymnasium cannot be imported", f"a module, {1 if fails else 10} rehearsals"]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("forkable", "forks_well", "makes"), [(True, None, True), (False, True, True), (False, False, False)]
)
def test_imports_decide_who_makes_the_simulator(monkeypatch, forkable, forks_well, makes):
    said = []
    backend = SimpleNamespace(forkable=forkable)
    settings = SimpleNamespace(scenario=SimpleNamespace(backend=backend, simulator="toy"), scratch=None)
    parts = SimpleNamespace(load=lambda report: report("a module"))
    monkeypatch.setattr(_preparation, "Parts", lambda given: parts if given is settings else None)
    monkeypatch.setattr(_preparation, "rehearse_trial", lambda *_: None)
    monkeypatch.setattr(_preparation, "_is_forkable_with", lambda given: forks_well if given is parts else None)
    monkeypatch.setattr(_preparation, "_can_be_forked", lambda: True)
    assert _preparation.import_parts(settings, said.append) == Imported(parts, makes_simulator=makes)
    assert said == ["a module", "the simulator cannot be made", ""]
    monkeypatch.setattr(_preparation, "_can_be_forked", lambda: False)
    assert _preparation.import_parts(settings, said.append) is None
    located = []
    monkeypatch.setattr(_preparation, "locate", lambda *given: located.append(given))
    assert _preparation.import_nothing(settings) == Imported(None, makes_simulator=False)
    settings.scenario.simulator = "mine:Simulator"
    _preparation.import_nothing(settings)
    assert located == [("simulators", "toy")]
