"""Which calls Ray gets, what a hunt does with the messages of a bridge, and what nodes rename; without Ray."""

from __future__ import annotations

import json
import os
import socket
import sys
import zlib
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from ray_node import node_works, submissions

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError
from crashhunt.episode import WorkerSettings
from crashhunt.executors.ray import RayExecutor, _cluster, _executor, _node_worker
from crashhunt.executors.ray._cluster import Cluster, ClusterNode, Meant, NodeLostError, TokenError, UnreachableError
from crashhunt.executors.ray._code_archive import NodeFolder, _is_same_snapshot
from crashhunt.executors.ray._node_actor import Site
from crashhunt.recording import BlackBoxHeader, Phase
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.trial import Failure, Outcome, TrialResult, TrialSpec


class RayError(Exception):
    """As Ray has it."""


class RayTaskError(RayError):
    """As Ray has it."""

    def __init__(self, cause):
        super().__init__("a task failed")
        self.cause = cause


@pytest.fixture
def ray(monkeypatch):
    """Ray, as far as it is used; it notes what it is asked for."""
    monkeypatch.setattr(_cluster, "_job_without_folder", lambda: "without the folder")
    found = SimpleNamespace(
        inits=[], options=[], killed=[], waits=[], puts=[], error=None, nodes=[], free={}, actors={}, named={}
    )

    def init(**options):
        found.inits.append(options)
        if found.error:
            raise found.error

    class Kind:
        def options(self, **options):
            found.options.append(options)
            return SimpleNamespace(remote=lambda: "actor")

    def remote(**options):
        found.groups = options
        return lambda kind: Kind()

    def wait(answers, *, num_returns, timeout):
        found.waits.append((list(answers), num_returns, timeout))
        return [one for one in answers if one in found.ready], [one for one in answers if one not in found.ready]

    def get(answer):
        if isinstance(answer, Exception):
            raise answer
        return answer

    def kill(actor, *, no_restart):
        found.killed.append((actor, no_restart))
        if actor == "gone":
            raise RayError

    def module(name, **content):
        made = ModuleType(name)
        made.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, made)
        return made

    def actors(identifier=None, *, actor_state_name=None):
        return found.named if actor_state_name == "ALIVE" else found.actors[identifier]

    exceptions = module("ray.exceptions", RayError=RayError, RayTaskError=RayTaskError)
    pickle = module("ray.cloudpickle", register_pickle_by_value=lambda given: None)
    module("ray.util")
    module("ray.util.scheduling_strategies", NodeAffinitySchedulingStrategy=lambda **given: given)
    module("ray._private")
    module("ray._private.state", available_resources_per_node=lambda: found.free, actors=actors)
    module(
        "ray", init=init, remote=remote, wait=wait, get=get, kill=kill, nodes=lambda: found.nodes,
        method=lambda **group: lambda function: found.grouped.append((function.__name__, group["concurrency_group"])),
        put=lambda given: found.puts.append(given) or given, exceptions=exceptions, cloudpickle=pickle,
    )  # fmt: skip
    found.ready, found.grouped = set(), []
    monkeypatch.setenv("RAY_ADDRESS", "x:1")
    return found


@pytest.fixture
def cluster(ray):
    return Cluster("", cpus=3, temporary="/tmp/here")


def test_own_cluster_has_so_many_cpus_and_a_folder(ray, cluster, monkeypatch):
    (options,) = ray.inits
    assert options.pop("job_config") == "without the folder"
    assert {name: options[name] for name in ("address", "num_cpus", "_temp_dir", "include_dashboard")} == {
        "address": "local", "num_cpus": 3, "_temp_dir": "/tmp/here", "include_dashboard": False,
    }  # fmt: skip
    assert 10**8 < options["object_store_memory"] < 10**9
    assert (options["log_to_driver"], options["configure_logging"]) == (False, False)
    assert "RAY_ADDRESS" not in os.environ
    assert cluster.address == "this machine"
    restarts = {name: ray.groups[name] for name in ("max_restarts", "max_task_retries", "enable_task_events")}
    assert restarts == {"max_restarts": 0, "max_task_retries": 0, "enable_task_events": False}
    assert set(ray.groups["concurrency_groups"].values()) == {1}
    orders = [name for name, group in ray.grouped if group == "orders"]
    assert sorted(orders) == ["cancel", "close", "submit"]
    assert len({group for _, group in ray.grouped}) == 2
    monkeypatch.setattr(_cluster, "_check_protocol", lambda address: ray.inits.append(address))
    ray.error = RuntimeError("other\n  versions:")
    with pytest.raises(UnreachableError, match="the Ray cluster at y:1 cannot be used: other versions;"):
        Cluster("y:1", cpus=3, temporary=None)
    assert ray.inits[1] == "y:1"
    assert ray.inits[2]["address"] == "y:1"
    assert "num_cpus" not in ray.inits[2]


def test_nodes_are_named_by_their_machines(ray, cluster):
    def node(identifier, host, *, alive=True, **resources):
        return {"NodeID": identifier, "NodeManagerHostname": host, "Alive": alive, "Resources": resources}

    ray.nodes = [
        node("aaaaaaaa", "one", CPU=4.0), node("bbbbbbbb", "two", CPU=2.0), node("cccccccc", "two", CPU=2.0),
        node("dddddddd", "gone", alive=False, CPU=9.0), node("eeeeeeee", "head"),
    ]  # fmt: skip
    ray.free = {"aaaaaaaa": {"CPU": 1.5}, "bbbbbbbb": {"CPU": 7.0}, "eeeeeeee": {}}
    assert list(cluster.nodes().values()) == [
        ClusterNode("aaaaaaaa", "one", 4, 1), ClusterNode("bbbbbbbb", "two-bbbbbb", 2, 2),
        ClusterNode("cccccccc", "two-cccccc", 2, 0), ClusterNode("eeeeeeee", "head", 0, 0),
    ]  # fmt: skip
    ray.nodes = [{}]
    with pytest.raises(UnreachableError, match="at this machine does not answer"):
        cluster.nodes()


def test_actors_tell_by_their_names_how_many_cpus_they_have(ray, cluster):
    assert [cluster.stand("aaaa", count) for count in (2, 2)] == ["actor"] * 2
    for options in ray.options:
        assert (options["num_cpus"], options["scheduling_strategy"]) == (2, {"node_id": "aaaa", "soft": False})
    names = [options["name"] for options in ray.options]
    assert names[0] != names[1]
    ray.named = {
        "1": {"Name": names[0], "Address": {"NodeID": "aaaa"}}, "2": {"Name": names[1], "Address": {"NodeID": "bbbb"}},
        "3": {"Name": "other-9-x", "Address": {"NodeID": "aaaa"}}, "4": {"Name": None, "Address": {"NodeID": "aaaa"}},
        "5": {"Name": "crashhunt-3-x", "Address": {"NodeID": "aaaa"}},
    }  # fmt: skip
    assert (cluster.held("aaaa"), cluster.held("bbbb"), cluster.held("cccc")) == (5, 2, 0)
    actor = SimpleNamespace(_actor_id=SimpleNamespace(hex=lambda: "7"))
    for found, waits in (({"Address": {"IPAddress": "1.2"}}, False), ({"Address": None}, True), ({}, False)):
        ray.actors["7"] = found
        assert cluster.waits(actor) is waits
    ray.actors.clear()
    assert not cluster.waits(actor)


def test_calls_and_answers_of_actors(ray, cluster):
    called = []
    actor = SimpleNamespace(take=SimpleNamespace(remote=lambda *given: called.append(given) or "answer"))
    assert cluster.ask(actor, "take", 1, 2) == cluster.order(actor, "take", 3) == "answer"
    assert called == [(1, 2), (3,)]
    ray.ready = {"b", "c"}
    assert cluster.answered(["a"], 5.0) == []
    assert cluster.answered(["a", "b", "c"], 5.0) == ["b", "c"]
    assert ray.waits == [(["a"], 1, 5.0), (["a", "b", "c"], 1, 5.0), (["a"], 1, 0)]
    assert cluster.value("said") == "said"
    with pytest.raises(ValueError, match="odd"):
        cluster.value(RayTaskError(ValueError("odd")))
    with pytest.raises(RayTaskError):
        cluster.value(RayTaskError("odd"))
    with pytest.raises(NodeLostError):
        cluster.value(RayError())
    made = []
    assert [cluster.shared(lambda: made.append(True) or b"code") for _ in range(2)] == [b"code"] * 2
    assert (len(made), ray.puts) == (1, [b"code"])


def test_actors_end_once_those_that_are_ready_have_closed(ray, cluster, monkeypatch):
    monkeypatch.setattr(_cluster.time, "sleep", lambda seconds: None)
    closed = []
    ready = SimpleNamespace(close=SimpleNamespace(remote=lambda: closed.append(True) or "closed"))
    cluster.close([ready, "gone", "other"], [ready], 1.5)
    assert closed == [True]
    assert ray.waits == [(["closed"], 1, 1.5)]
    assert ray.killed == [(ready, True), ("gone", True), ("other", True)]
    timers = []

    def timer(seconds, function, arguments):
        timers.append((seconds, function, arguments))
        return SimpleNamespace(start=lambda: function(*arguments))

    monkeypatch.setattr(_cluster.threading, "Timer", timer)
    cluster.kill("late", after_s=2.0)
    assert timers[0][0] == 2.0
    assert ray.killed[-1] == ("late", True)


def test_server_that_is_no_head_or_needs_a_token_is_an_error(ray, monkeypatch):
    class AuthenticationError(Exception):
        pass

    def client(error):
        def make(*, address):
            assert address == "y:1"
            if error:
                raise error

        made = ModuleType("ray._raylet")
        made.GcsClient = make
        monkeypatch.setitem(sys.modules, "ray._raylet", made)

    monkeypatch.delenv("RAY_AUTH_MODE", raising=False)
    client(None)
    assert _cluster._check_protocol("y:1") is None
    client(ValueError("no\nhead"))
    with pytest.raises(UnreachableError, match="y:1 is not the head of a Ray cluster: no head"):
        _cluster._check_protocol("y:1")
    client(AuthenticationError())
    with pytest.raises(TokenError, match="needs a token"):
        _cluster._check_protocol("y:1")
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    with pytest.raises(TokenError, match="expects another token"):
        _cluster._check_protocol("y:1")
    assert _cluster._first_line(ValueError("")) == "ValueError"


@pytest.fixture
def settings(tmp_path):
    (tmp_path / "scratch").mkdir()
    scenario = Scenario(simulator="toy", folder=tmp_path, agents={"ego": AgentSetup(agent="keep-lane")})
    return WorkerSettings(scenario=scenario, oracles=(), crash_on=(), scratch=tmp_path / "scratch")


@pytest.fixture
def executor(settings, monkeypatch):
    """Makes an executor; `bridges` are the processes that it has started, each with its end of the connection."""
    bridges, made = [], []

    class Kept:
        def __init__(self, module, words, *, environment, inherited, **streams):
            self.job = json.loads(Path(words[1]).read_text())
            self.control = socket.socket(fileno=os.dup(int(words[0])))
            self.control.setblocking(False)
            self.environment, self.inherited, self.ended, self.waited = environment, inherited, False, []
            self.process = SimpleNamespace(wait=self.waited.append)
            streams["stdout"].write(b"first\nno memory\n")
            bridges.append(self)

        def say(self, **message):
            self.control.sendall(json.dumps(message).encode() + b"\n")

        def hear(self):
            return [json.loads(line) for line in self.control.recv(1 << 16).splitlines()]

        def end(self):
            self.ended = True

    def make(address="x:1", *, spare=None, **more):
        monkeypatch.setattr(_executor, "cluster_of", lambda argument: Meant(address, {"A": "1"}, spare or {}))
        found = RayExecutor(settings, **more)
        made.append(found)
        return found, bridges

    monkeypatch.setattr(_executor, "Kept", Kept)
    monkeypatch.setattr(_executor, "require_ray", lambda: None)
    monkeypatch.setattr(_executor, "silent", lambda address: "")
    yield make
    for one in made:
        one.close()
    for bridge in bridges:
        bridge.control.close()


def spec(number):
    return TrialSpec(number, 7, {"ego": {}}, {}, 12)


def survived(number):
    return TrialResult(spec(number), Outcome.SURVIVED, steps=12)


def test_hunt_submits_to_the_bridge_and_hears_of_results(executor):
    found, (bridge,) = executor(parallel=3)
    assert {name: bridge.job[name] for name in ("parallel", "address", "cpus", "resumed")} == {
        "parallel": 3, "address": "x:1", "cpus": 3, "resumed": False,
    }  # fmt: skip
    assert bridge.job["temporary"] is None
    assert bridge.environment["A"] == "1"
    assert bridge.environment["RAY_USAGE_STATS_ENABLED"] == "0"
    assert len(bridge.inherited) == 1
    assert found.capacity == 3
    for number in range(4):
        found.submit(spec(number))
    submitted = [message["submit"] for message in bridge.hear()]
    assert submitted == [[], *([[number, spec(number).to_json()]] for number in range(4))]
    assert list(found.completed(0)) == []
    bridge.say(capacity=7, note="a note", nodes=[{"name": "one", "parallel": 2, "trials": 1, "rate_per_s": 0.5}])
    bridge.say(node="one", where={"1": [5, 1, 2.0, 300, 4, int(Phase.ACT), 0], "9": [5, 9, 2.0, 300, 4, 0, 0]})
    bridge.say(ticket=0, result=survived(0).to_json())
    bridge.say(ticket=0, result=survived(0).to_json())  # it was submitted twice, to a bridge that was lost
    assert list(found.completed(5)) == [survived(0)]
    assert (found.capacity, found.notes()) == (7, ["a note"])
    assert found.where() == {1: BlackBoxHeader(pid=5, trial=1, started=2.0, committed=300, step=4, phase=Phase.ACT,
                                               agent=0)}  # fmt: skip
    (node,) = found.nodes()
    assert (node.name, node.parallel, node.trials, node.rate_per_s) == ("one", 2, 1, 0.5)
    bridge.say(ticket=1, result=survived(1).to_json())
    bridge.say(ticket=3, result=survived(3).to_json())
    found._receive(5)
    found.cancel(above=2)
    assert list(found.completed(0)) == [survived(1)]
    assert bridge.hear() == [{"cancel": 2}]
    assert list(found._open.values()) == [spec(2)]
    bridge.say(capacity=0)
    found._receive(5)
    assert found.capacity == 1
    found.close()
    assert bridge.ended
    assert len(bridge.waited) == 1
    found.close()
    assert len(bridge.waited) == 1


def test_results_are_awaited_as_long_as_asked(executor, monkeypatch):
    clock = SimpleNamespace(now=50.0, slept=[])
    monkeypatch.setattr(_executor.time, "monotonic", lambda: clock.now)
    found, _ = executor()
    waits = []

    def receive(wait_s):
        waits.append(wait_s)
        clock.now += 2

    monkeypatch.setattr(found, "_receive", receive)
    assert list(found.completed(5.0)) == []
    assert waits == [5.0, 3.0, 1.0]


def lose(found, bridge):
    bridge.control.shutdown(socket.SHUT_RDWR)
    while not bridge.ended:
        list(found.completed(0))


def test_trials_without_a_result_go_to_the_next_bridge(executor, monkeypatch):
    clock = SimpleNamespace(now=50.0)
    monkeypatch.setattr(_executor.time, "monotonic", lambda: clock.now)
    monkeypatch.setattr(_executor.time, "sleep", lambda seconds: None)
    found, bridges = executor()
    for number in range(2):
        found.submit(spec(number))
    bridges[0].say(capacity=2, node="one", where={"1": [5, 1, 2.0, 300, 4, 0, 0]})
    bridges[0].say(ticket=0, result=survived(0).to_json())
    assert list(found.completed(5)) == [survived(0)]
    lose(found, bridges[0])
    assert bridges[0].ended
    assert (found.capacity, found.where(), found.nodes()) == (1, {}, [])
    assert found.notes() == ["the Ray cluster was lost; the hunt waits until it is back"]
    found.submit(spec(2))
    clock.now += 2.9
    list(found.completed(0))
    assert len(bridges) == 1
    clock.now += 0.2
    monkeypatch.setattr(_executor, "silent", lambda address: "it is down")
    list(found.completed(0))
    assert len(bridges) == 1
    monkeypatch.setattr(_executor, "silent", lambda address: "")
    list(found.completed(0))
    assert len(bridges) == 1  # it was looked at a moment ago
    clock.now += 3.1
    list(found.completed(0))
    assert bridges[1].hear() == [{"submit": [[1, spec(1).to_json()], [2, spec(2).to_json()]]}]
    assert bridges[1].job["resumed"] is True
    bridges[1].say(error={"message": "it restarts", "fix": "", "where": ""}, passing=True, token=False)
    list(found.completed(0))
    assert found.notes() == ["the Ray cluster was lost (it restarts); the hunt waits until it is back"]
    assert bridges[1].ended


def test_own_cluster_that_ends_three_times_is_an_error(executor, monkeypatch):
    monkeypatch.setattr(_executor.time, "sleep", lambda seconds: None)
    found, bridges = executor("")
    folder = Path(bridges[0].job["temporary"])
    assert folder.is_dir()
    assert len(bridges[0].inherited) == 2
    bridges[0].say(capacity=1)
    for count in range(2):
        lose(found, bridges[count])
        list(found.completed(0))
        assert len(bridges) == count + 2
    assert not folder.exists()
    with pytest.raises(CrashhuntError, match="Ray has ended unexpectedly: no memory"):
        lose(found, bridges[2])
    found, bridges = executor()
    with pytest.raises(CrashhuntError, match="Ray has ended unexpectedly"):
        lose(found, bridges[-1])  # it has never worked


def test_error_of_a_bridge_ends_the_hunt_unless_a_token_helps(executor):
    error = {"message": "no nodes", "fix": "", "where": ""}
    found, bridges = executor(spare={"B": "2"})
    bridges[0].say(error=error, passing=True, token=True)
    list(found.completed(0))
    assert bridges[0].ended
    assert (bridges[1].environment["A"], bridges[1].environment["B"]) == ("1", "2")
    bridges[1].say(error=error, passing=True, token=True)
    with pytest.raises(CrashhuntError, match="no nodes"):  # it has been tried, and no node ever worked
        list(found.completed(0))
    found, bridges = executor()
    bridges[-1].say(capacity=1)
    bridges[-1].say(error=error, passing=False, token=False)
    with pytest.raises(CrashhuntError, match="no nodes"):
        list(found.completed(0))
    found, bridges = executor("")
    bridges[-1].say(capacity=1)
    bridges[-1].say(error=error, passing=True, token=False)
    with pytest.raises(CrashhuntError, match="no nodes"):
        list(found.completed(0))


def test_bridge_that_does_not_read_is_listened_to_meanwhile(executor, monkeypatch):
    found, (bridge,) = executor()
    sent = []

    class Control:
        """A connection that takes nothing before it is read, and then little at a time."""

        def send(self, left, flags):
            assert flags == socket.MSG_DONTWAIT
            if "read" not in sent:
                raise BlockingIOError
            sent.append(bytes(left[:1000]))
            return len(sent[-1])

        def recv(self, size):
            sent.append("read")
            return b'{"note": "later"}\n'

        def shutdown(self, how):
            pass

        def close(self):
            pass

    found._control.close()
    found._control = control = Control()
    monkeypatch.setattr(_executor.select, "select", lambda *given: ([control], [], []))
    found._send({"submit": [(5, {"text": "x" * 1500})]})
    assert sent[0] == "read"
    assert json.loads(b"".join(sent[1:])) == {"submit": [[5, {"text": "x" * 1500}]]}
    found._receive(0)
    assert found.notes() == ["later"]
    sent.clear()
    control.recv = lambda size: b""  # it is gone
    found._send({"cancel": 5})
    assert sent == []
    assert not bridge.ended


def test_machine_whose_links_are_fixed_wants_nodes_that_fix_them(executor, monkeypatch):
    found, _ = executor()
    for order, wanted in ((_executor.FIXED_LOAD_ORDER, {"_crashhunt_link_order": "installed"}), ("as it comes", {})):
        monkeypatch.setattr(_executor, "load_order_of", lambda scenario, given=order: given)
        assert found._load_order() == wanted


@pytest.fixture
def node(settings, tmp_path, monkeypatch):
    with node_works(settings, tmp_path, monkeypatch) as make:
        yield make


def test_node_reports_results_under_their_tickets_and_progress_now_and_then(node, monkeypatch):
    work = node([survived(1), survived(7)])
    assert os.environ["PYTHONDONTWRITEBYTECODE"] == "1"
    news = work.take(2.0, submissions(1, 2))
    assert work._pool.submitted == [1, 2]
    ((ticket, number, line, files),) = news.ended
    assert (ticket, number, files) == (101, 1, {})
    assert json.loads(line) == {"ticket": 101, "result": survived(1).to_json()}
    assert news.where == {1: (5, 1, 2.0, 300, 4, int(Phase.ACT), 0)}
    assert (news.notes, news.error, news.map) == ([], None, b"")
    assert work._pool.waits == [2.0]
    assert work.take(0.0, []).where is None
    monkeypatch.setattr(_node_worker, "_WHERE_EVERY_S", 0.0)
    assert work.take(0.0, []).where is not None
    work.cancel(2, 500)
    assert (work._pool.cancelled, work._tickets) == ([2], {2: 102})
    work.cancel(1, 500)
    assert work._tickets == {}
    work.close()
    assert work._pool.closed
    assert not work._place.path.exists()


def test_node_that_cannot_begin_a_trial_reports_an_error(node):
    work = node([survived(1)])
    work.submit(submissions(1, 99))
    news = work.take(0.0, [])
    assert news.error["error"]["message"] == "a trial cannot be begun: OSError: no file"
    assert news.ended == []


def test_names_of_files_are_those_of_the_hunt(node, tmp_path):
    kept = replace(survived(1), outcome=Outcome.AGENT_ERROR, kept=True, steps=3,
                   failure=Failure("ValueError", "no /node/code/0/a.py", traceback="File /node/code/a.py"))  # fmt: skip
    work = node([kept])
    work._renamed = [("/node/code/0", "/home/me"), ("/node/code", "/hunt")]
    folder = _node_worker.scratch_of(work._place.scratch, 1)
    folder.mkdir(parents=True)
    (folder / layout.ERROR_LOG).write_text("in /node/code/0/a.py")
    (folder / "data.bin").write_text("in /node/code/0/a.py")
    (work._place.scratch / layout.MAP).write_text("map")
    work._pool.said = ["see /node/code/b"]
    news = work.take(0.0, submissions(1))
    ((_, _, line, files),) = news.ended
    failure = json.loads(line)["result"]["failure"]
    assert (failure["message"], failure["traceback"]) == ("no /home/me/a.py", "File /hunt/a.py")
    assert {name: zlib.decompress(content) for name, content in files.items()} == {
        layout.ERROR_LOG: b"in /home/me/a.py", "data.bin": b"in /node/code/0/a.py",
    }  # fmt: skip
    assert zlib.decompress(news.map) == b"map"
    assert work._map() == b""  # once
    assert news.notes == ["see /hunt/b"]
    assert not folder.exists()
    _node_worker.unpacked(files, tmp_path / "new/folder")
    _node_worker.unpacked({"../../data.bin": zlib.compress(b"x")}, tmp_path / "new/folder")
    assert (tmp_path / "new/folder/data.bin").read_text() == "x"
    assert work._with_hunt_paths({"a": ["/node/code/x", 5, None]}) == {"a": ["/hunt/x", 5, None]}


@pytest.mark.parametrize(("slots", "kept", "taken"), [(1, False, 1), (2, False, 3), (2, True, 1), (4, False, 1)])
def test_node_waits_for_more_results_only_while_there_is_enough_to_do(node, monkeypatch, slots, kept, taken):
    clock = SimpleNamespace(now=50.0)
    monkeypatch.setattr(_node_worker.time, "monotonic", lambda: clock.now)
    result = replace(survived(0), kept=kept)
    work = node([result], [survived(1)], [survived(2)], slots=slots)
    monkeypatch.setattr(
        work, "_queue_trials", lambda ticket, given: SimpleNamespace(number=given.spec.number, files={})
    )
    if slots == 1:  # the time is over
        monkeypatch.setattr(_node_worker, "_GATHER_S", 0.0)
    news = work.take(2.0, submissions(*range(5)))
    assert len(news.ended) == taken
    assert all(abs(wait - _node_worker._GATHER_S) < 1e-9 for wait in work._pool.waits[1:])


def test_node_forwards_what_it_is_asked_for(monkeypatch):
    called = []

    class Worker:
        def __getattr__(self, name):
            return lambda *given: called.append((name, *given)) or name

    monkeypatch.setattr(_node_worker, "Work", lambda job: called.append(("made", job)) or Worker())
    site = Site()
    site.close()
    assert site.begin("job", b"code") == "begin"
    site.submit(["trial"])
    site.cancel(3, 5)
    assert site.take(2.0, ["trial"]) == "take"
    site.close()
    assert called == [
        ("made", "job"), ("begin", b"code"), ("submit", ["trial"]), ("cancel", 3, 5), ("take", 2.0, ["trial"]),
        ("close",),
    ]  # fmt: skip


def test_copy_of_the_current_folder_is_known_by_its_name_and_files(tmp_path, monkeypatch):
    here, copy = tmp_path / "home/me", tmp_path / f"hunt/{layout.CODE}/@home/me"
    for folder in (here, copy):
        folder.mkdir(parents=True)
        (folder / "a.py").touch()
    monkeypatch.chdir(here)
    place = tmp_path / f"hunt/{layout.CODE}/@{here.as_posix().lstrip('/')}"
    place.mkdir(parents=True)
    for name in ("a.py", "b.py"):
        (place / name).touch()
    assert not _is_same_snapshot(place)  # one of them is not here
    (here / "b.py").touch()
    assert _is_same_snapshot(place)
    assert not _is_same_snapshot(here)
    monkeypatch.chdir(tmp_path)
    assert not _is_same_snapshot(place)


def test_damaged_archive_leaves_no_code():
    place = NodeFolder()
    assert place.scratch.is_dir()
    assert not place.unpack(b"damaged", "digest")
    assert not place.code.exists()
    place.remove()
    assert not place.path.exists()
