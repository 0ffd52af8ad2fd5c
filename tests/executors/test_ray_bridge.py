"""The bridge between a hunt and the nodes, with a cluster that is made up, and a clock."""

from __future__ import annotations

import json
import socket
import threading
import time
import zlib
from itertools import pairwise
from types import SimpleNamespace

import pytest

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, RecorderError, UsageError
from crashhunt.episode import WorkerSettings, scratch_of
from crashhunt.executors.ray import RayExecutor, _bridge, _executor
from crashhunt.executors.ray._cluster import ClusterNode, Meant, NodeLostError
from crashhunt.executors.ray._messages import News, NodeTrial
from crashhunt.scenario import Scenario
from crashhunt.trial import CRASHES, Outcome, TrialResult, TrialSpec


class Actor:
    """One that stands on a machine."""

    def __init__(self, machine, slots):
        self.machine, self.slots, self.alive, self.asked = machine, slots, True, None


class Made:
    """A cluster of which the test says what there is and what is answered."""

    def __init__(self, address, *, cpus, temporary):
        self.address = address
        self.cpus = {}  # machine to CPUs
        self.others = {}  # machine to CPUs that somebody else has
        self.hunts = {}  # machine to CPUs that other hunts have
        self.actors = []
        self.late = False  # whether actors wait
        self.nowhere = set()  # those that do
        self.ready = {}  # answer to value
        self.orders = []
        self.given = []  # machine, how and trials
        self.differing = {}  # machine to what

    def nodes(self):
        taken = {machine: self.others.get(machine, 0) for machine in self.cpus}
        for actor in self.actors:
            if actor.alive and actor.machine in taken and actor not in self.nowhere:
                taken[actor.machine] += actor.slots
        return {name: ClusterNode(name, name, cpus, max(0, cpus - taken[name])) for name, cpus in self.cpus.items()}

    def stand(self, machine, slots):
        self.actors.append(Actor(machine, slots))
        if self.late:
            self.nowhere.add(self.actors[-1])
        return self.actors[-1]

    def waits(self, actor):
        return actor in self.nowhere

    def held(self, machine):
        ours = [one for one in self.actors if one.alive and one.machine == machine and one not in self.nowhere]
        return sum(one.slots for one in ours) + self.hunts.get(machine, 0)

    def ask(self, actor, what, *arguments):
        actor.asked = answer = object()
        if what == "take" and arguments[1]:
            self.given.append((actor.machine, "take", arguments[1]))
        if actor in self.nowhere:
            return answer
        if what == "differs":
            self.ready[answer] = self.differing.get(actor.machine, "")
        elif what == "begin":
            self.ready[answer] = "ready"
        return answer

    def order(self, actor, what, *arguments):
        (self.given if what == "submit" else self.orders).append((actor.machine, what, *arguments))

    def answered(self, answers, wait_s):
        return [answer for answer in answers if answer in self.ready]

    def value(self, answer):
        found = self.ready.pop(answer)
        if isinstance(found, Exception):
            raise found
        return found

    def shared(self, make):
        return make()

    def kill(self, actor, *, after_s=0.0):
        actor.alive = False

    def news(self, actor, *ended, where=None, notes=(), error=None):
        """Have an actor answer what it was asked last."""
        self.ready[actor.asked] = News(list(ended), where, list(notes), error, b"")


@pytest.fixture
def clock(monkeypatch):
    """Time goes by when somebody lets it."""
    found = SimpleNamespace(now=100.0, sleep=lambda seconds: None)
    found.monotonic = lambda: found.now
    monkeypatch.setattr("crashhunt.executors.ray._bridge.time", found)
    monkeypatch.setattr("crashhunt.executors.ray._node_scheduler.time", found)
    return found


@pytest.fixture
def begin(tmp_path, monkeypatch, clock):
    """Makes a bridge; returns it, its cluster, and what lets a second go by and returns what the hunt is told."""
    monkeypatch.setattr(_bridge, "Cluster", Made)
    scenario = Scenario(simulator="toy", folder=tmp_path)
    settings = WorkerSettings(scenario=scenario, oracles=(), crash_on=CRASHES, scratch=tmp_path)
    ends = []

    def make(parallel=0, resumed=False, **cpus):
        theirs, ours = socket.socketpair()
        ends.extend((theirs, ours))
        job = {
            "settings": settings.to_json(), "parallel": parallel, "address": "x:1", "cpus": 2,
            "temporary": None, "versions": {}, "code": "", "resumed": resumed,
        }  # fmt: skip
        bridge = _bridge.Bridge(theirs, job)
        bridge._cluster.cpus = cpus
        ours.setblocking(False)

        def after(seconds=1):
            said = b""
            for _ in range(seconds):
                clock.now += 1.01
                for _ in range(4):  # what is asked next is answered, too
                    bridge.turn(0)
                try:
                    while data := ours.recv(1 << 16):
                        said += data
                except BlockingIOError:
                    pass
            return [json.loads(line) for line in said.splitlines()]

        return bridge, bridge._cluster, after

    yield make
    for end in ends:
        end.close()


def submit(bridge, *numbers):
    specs = [TrialSpec(number, number, {}, {}, max_steps=3).to_json() for number in numbers]
    bridge._scheduler.waiting += [_bridge.Trial(100 + spec["number"], spec) for spec in specs]


def ended(number, files=None):
    result = TrialResult(TrialSpec(number, number, {}, {}, max_steps=3), Outcome.SURVIVED, steps=3, wall_s=0.0)
    line = json.dumps({"ticket": 100 + number, "result": result.to_json()}).encode() + b"\n"
    return NodeTrial(100 + number, number, line, files or {})


def notes(told):
    return [message["note"] for message in told if "note" in message]


def submitted(cluster):
    return [(machine, [ticket - 100 for ticket, _ in trials]) for machine, _, trials in cluster.given]


def test_a_node_gets_ready_and_runs_what_is_submitted(begin):
    bridge, cluster, after = begin(a=2)
    submit(bridge, 0, 1)
    told = after()
    assert {"capacity": 2} in told
    assert submitted(cluster) == [("a", [0, 1])]
    cluster.news(cluster.actors[0], ended(1), where={0: [1, 0, 0.0, 1, 1, 2, 0]}, notes=["said"])
    told = after()
    assert [message["ticket"] for message in told if "result" in message] == [101]
    assert notes(told) == ["said"]
    assert [list(message["where"]) for message in told if "where" in message] == [["0"]]
    cluster.news(cluster.actors[0], ended(1))
    assert not [message for message in after() if "result" in message], "it has come back already"


def test_nodes_are_looked_for_once_a_second(begin, clock):
    _, cluster, after = begin(a=1)
    looks, nodes = [], cluster.nodes
    cluster.nodes = lambda: looks.append(clock.now) or nodes()
    after(3)
    assert len(looks) == 3
    assert [later - earlier for earlier, later in pairwise(looks)] == pytest.approx([1.01, 1.01])


def test_turn_without_nodes_waits_half_as_long_as_for_an_answer(begin, clock):
    bridge, cluster, _ = begin()
    slept = []
    clock.sleep = slept.append
    bridge.turn(0.5)
    assert slept == [0.25]
    cluster.cpus["a"] = 1
    clock.now += 1.01
    bridge.turn(0)
    assert slept == [0.25]


def test_what_is_kept_is_written_before_the_hunt_hears_of_it(begin, tmp_path):
    bridge, cluster, after = begin(a=1)
    submit(bridge, 0)
    after()
    cluster.news(cluster.actors[0], ended(0, {"blackbox.bin": zlib.compress(b"box")}))
    after()
    assert (_bridge.scratch_of(tmp_path, 0) / "blackbox.bin").read_bytes() == b"box"


@pytest.mark.parametrize(("parallel", "slots"), [(0, [2, 2]), (3, [2, 1]), (2, [2])])
def test_cpus_that_become_free_later_are_taken_where_there_is_room(begin, parallel, slots):
    """Not at once: Ray is late to say what has been taken."""
    _, cluster, after = begin(parallel=parallel, a=4)
    cluster.others["a"] = 2
    assert {"capacity": 2} in after()
    cluster.others.clear()
    after()
    assert [actor.slots for actor in cluster.actors] == [2]
    told = after(9)
    assert [actor.slots for actor in cluster.actors] == slots
    figures = [message["nodes"] for message in told if "nodes" in message][-1]
    assert [(node["name"], node["parallel"]) for node in figures] == [("a", sum(slots))], "one line a machine"


def test_a_machine_is_lost_with_all_its_parts(begin):
    bridge, cluster, after = begin(a=4, b=1)
    cluster.others["a"] = 3
    after()
    cluster.others.clear()
    after(5)
    assert {actor.machine: actor.slots for actor in cluster.actors} == {"a": 3, "b": 1}
    submit(bridge, *range(10))
    after()
    del cluster.cpus["a"]
    told = after()
    assert [message["capacity"] for message in told if "capacity" in message][-1] == 1
    assert len([note for note in notes(told) if note.startswith("node a was lost")]) == 2
    (left,) = bridge._scheduler.nodes.values()
    left = [trial.number for trial in left.running.values()] + [trial.number for trial in bridge._scheduler.waiting]
    assert sorted(left) == [*range(10)]


@pytest.mark.parametrize(("before_s", "hunts", "soon_s"), [(2, 0, 40), (3, 2, 5)])
def test_an_actor_whose_cpus_another_got_is_taken_back(begin, before_s, hunts, soon_s):
    """Two hunts that begin at once both see the same CPUs free. The later hunt says so, or waits for other nodes.

    That another hunt has them is known in ten seconds on an idle machine, some of which go by until it has begun.
    """
    _, cluster, after = begin(a=2)
    cluster.late = True
    after(before_s)
    cluster.others["a"], cluster.hunts["a"] = 2, hunts
    with pytest.raises(
        UsageError, match="cannot run trials: none of its 2 CPUs is free; wait until other jobs are done"
    ):
        after(soon_s)
    assert not any(actor.alive for actor in cluster.actors)


def test_what_another_hunt_has_left_is_taken(begin):
    _, cluster, after = begin(a=4)
    cluster.late = True
    after(2)
    cluster.others["a"] = cluster.hunts["a"] = 1
    cluster.late = False
    told = after(4)
    assert [(actor.slots, actor.alive) for actor in cluster.actors] == [(4, False), (3, True)]
    assert {"capacity": 3} in told


def test_an_actor_that_takes_long_to_start_is_given_more_time_again(begin):
    _, cluster, after = begin(a=2)
    cluster.late = True
    after(120)
    assert [actor.alive for actor in cluster.actors] == [False, False, True], "after 30 s, and after 60 s"
    cluster.late = False
    cluster.nowhere.clear()
    cluster.ready[cluster.actors[-1].asked] = ""
    assert {"capacity": 2} in after()


def test_where_no_node_is_left_it_states_so_once_and_continues(begin):
    bridge, cluster, after = begin(a=2)
    submit(bridge, 0, 1, 2)
    after()
    cluster.cpus.clear()
    told = after(5)
    assert notes(told) == [
        "node a was lost with 3 trials, to be run again",
        "no node of the cluster is left; the hunt waits until one is back",
    ]
    assert [message["capacity"] for message in told if "capacity" in message] == [0, 0]
    cluster.cpus["b"] = 1
    cluster.given.clear()
    assert {"capacity": 1} in after()
    assert submitted(cluster) == [("b", [0, 1])]
    cluster.cpus.clear()
    assert "no node of the cluster is left; the hunt waits until one is back" in notes(after(2)), "and again"


def test_a_hunt_that_has_had_nodes_waits_for_them_from_the_start(begin):
    _, _, after = begin(resumed=True)
    assert notes(after(20)) == ["no node of the cluster is left; the hunt waits until one is back"]


def test_an_actor_that_ends_again_and_again_is_not_asked_any_more(begin, monkeypatch):
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    _, cluster, after = begin(a=1)
    cluster.differing["a"] = NodeLostError("gone")
    with pytest.raises(
        UsageError, match=r"a: its process was ended 3 times .*, as happens with RAY_AUTH_MODE=token here"
    ):
        after(5)
    assert len(cluster.actors) == 3


def test_a_loss_between_trials_that_end_is_no_reason_to_give_a_node_up(begin):
    bridge, cluster, after = begin(a=1)
    for number in range(5):
        submit(bridge, number)
        after()
        cluster.news(cluster.actors[-1], ended(number))
        after()
        cluster.ready[cluster.actors[-1].asked] = NodeLostError("gone")
        after()
    assert len(cluster.actors) == 5
    assert not bridge._refused


def test_the_one_that_ends_every_node_is_distinguished_from_who_was_there(begin):
    bridge, cluster, after = begin(a=1)
    submit(bridge, 0, 1)
    results = []
    for _ in range(6):
        told = after()
        results += [message["result"] for message in told if "result" in message]
        if not results:
            cluster.ready[cluster.actors[-1].asked] = NodeLostError("gone")
    (culprit,) = results
    assert culprit["spec"]["number"] == 0
    assert "was lost 3 times, at last with this trial alone on it" in json.dumps(culprit)
    # A node that is lost from outside is no crash of the agent, and a resumed hunt runs the trial again.
    result = TrialResult.from_json(culprit)
    assert (result.outcome, result.was_killed_from_outside) == (Outcome.INVALID, True)
    after()
    (node,) = bridge._scheduler.nodes.values()
    assert [trial.number for trial in node.running.values()] == [1]


def test_a_node_that_differs_is_named_once_and_not_asked_again(begin):
    _, cluster, after = begin(a=1, b=1)
    cluster.differing["b"] = "libsumo is 1 there and 2 here"
    assert notes(after(4)) == ["node b takes no part: libsumo is 1 there and 2 here"]
    assert [actor.machine for actor in cluster.actors] == ["a", "b"]
    assert ("b", "close") in cluster.orders
    cluster.cpus.pop("a")
    with pytest.raises(UsageError, match="no node of the cluster can run the trials: b: libsumo is 1 there"):
        after(4)


def test_what_a_node_cannot_run_runs_elsewhere_and_is_not_to_blame(begin):
    bridge, cluster, after = begin(a=1, b=1)
    submit(bridge, *range(4))
    after()
    error = CrashhuntError("the disk is full").to_json()
    cluster.news(cluster.actors[1], error=error)
    cluster.given.clear()
    assert notes(after()) == ["node b takes no part: the disk is full"]
    (left,) = bridge._scheduler.nodes.values()
    assert not any(trial.losses for trial in [*left.running.values(), *bridge._scheduler.waiting])
    cluster.news(cluster.actors[0], ended(0), ended(2))
    after()
    assert submitted(cluster) == [("a", [1, 3])]


def test_an_error_of_ours_over_there_costs_the_node(begin):
    _, cluster, after = begin(a=1, b=1)
    after()
    cluster.ready[cluster.actors[0].asked] = OSError(28, "No space left on device")
    assert notes(after()) == ["node a takes no part: OSError: [Errno 28] No space left on device"]


def test_rates_are_by_the_clock_here(begin):
    """Nothing that a node says holds a time of day, and what it says of its own clock is not looked at."""
    bridge, cluster, after = begin(a=1)
    submit(bridge, 0)
    after()
    cluster.news(cluster.actors[0], ended(0), where={0: [1, 0, 1e9, 1, 1, 2, 0]})
    told = after(9)
    (figures,) = [message["nodes"] for message in told if "nodes" in message][-1]
    assert figures["rate_per_s"] == pytest.approx(1 / 9, rel=0.3)


def test_what_is_given_up_is_given_up_everywhere(begin):
    """Also what is still on its way, which is told from what is submitted later by its ticket."""
    bridge, cluster, after = begin(a=1, b=1)
    after()
    hunt(bridge, submission(*range(6)))
    after()
    hunt(bridge, {"cancel": 1})
    given_up = sorted(order for order in cluster.orders if order[1] == "cancel")
    assert given_up == [("a", "cancel", 1, 106), ("b", "cancel", 1, 106)]
    cluster.news(cluster.actors[0], ended(2))
    assert not [message for message in after() if "result" in message]
    assert not bridge._scheduler.waiting


def test_what_is_submitted_for_what_has_ended_goes_along_with_the_next_question(begin):
    """And nothing of it once it is given up; whoever has been asked already is told at once."""
    bridge, cluster, after = begin(a=2)
    after()
    hunt(bridge, submission(0, 1), submission(2))
    assert cluster.given == [("a", "submit", [(100 + number, spec(number)) for number in range(3)])], "in one call"
    cluster.news(cluster.actors[0], ended(0), ended(1))
    bridge.turn(0)
    hunt(bridge, submission(3, 4, 5), {"cancel": 4})
    cluster.given.clear()
    bridge.turn(0)
    assert cluster.given == [("a", "take", [(103, spec(3)), (104, spec(4))])]


def test_a_disk_that_is_full_here_is_reported_from_a_cluster_that_is_lost(begin, monkeypatch):
    bridge, cluster, after = begin(a=1)
    submit(bridge, 0)
    after()
    cluster.news(cluster.actors[0], ended(0, {"run.log": b""}))

    def full(files, folder):
        raise OSError(28, "No space left on device", str(folder))

    monkeypatch.setattr(_bridge, "unpacked", full)
    with pytest.raises(RecorderError, match=r"trial-000000: the results from a cannot be written here: No space"):
        after()


def test_the_hunt_is_given_a_moment_to_submit_more(begin, monkeypatch):
    bridge, cluster, after = begin(a=1)
    after()
    hunt(bridge, submission(0))
    monkeypatch.setattr(_bridge, "_REFILL_S", 60.0)
    cluster.news(cluster.actors[0], ended(0))
    cluster.given.clear()

    def submits_when_it_hears_of_it():
        while bridge._missing < 1:
            time.sleep(0.01)
        with bridge._lock:  # it has been told
            hunt(bridge, submission(1))

    thread = threading.Thread(target=submits_when_it_hears_of_it)
    thread.start()
    bridge.turn(60.0)
    thread.join()
    bridge.turn(0)
    assert cluster.given == [("a", "take", [(101, spec(1))])]


def test_neither_waits_for_the_other_to_listen_first(tmp_path, monkeypatch):
    """However much both have to say: the bridge does not listen while it tells what has ended."""
    settings = WorkerSettings(
        scenario=Scenario(simulator="toy", folder=tmp_path), oracles=(), crash_on=CRASHES, scratch=tmp_path
    )
    ours, theirs = socket.socketpair()
    monkeypatch.setattr(_executor, "require_ray", lambda: None)
    monkeypatch.setattr(_executor, "cluster_of", lambda argument: Meant("x:1", {}, {}))
    monkeypatch.setattr(RayExecutor, "_start", lambda self: setattr(self, "_control", ours))
    executor = RayExecutor(settings)
    heard = bytearray()

    def bridge():
        with theirs:
            theirs.settimeout(30.0)
            theirs.sendall(b"".join(json.dumps({"note": one * (1 << 19)}).encode() + b"\n" for one in "ab"))
            while not heard.endswith(b"\n"):
                heard.extend(theirs.recv(1 << 20))

    thread = threading.Thread(target=bridge)
    thread.start()
    with ours:
        executor.submit(TrialSpec(0, 0, {"ego": {"text": "c" * (1 << 20)}}, {}, max_steps=3))
        thread.join()
        assert len(heard) > 1 << 20
        executor._ever_up = True
        told = []
        while len(told) < 3:
            list(executor.completed(0.0))
            told += executor.notes()
        assert told == ["a" * (1 << 19), "b" * (1 << 19), "the Ray cluster was lost; the hunt waits until it is back"]


def spec(number):
    return TrialSpec(number, number, {}, {}, max_steps=3).to_json()


def submission(*numbers):
    return {"submit": [(100 + number, spec(number)) for number in numbers]}


def hunt(bridge, *messages):
    """Have the hunt say something, all at once."""
    ours, theirs = socket.socketpair()
    with theirs:
        ours.sendall(b"".join(json.dumps(message).encode() + b"\n" for message in messages))
        ours.close()
        bridge._control, control = theirs, bridge._control
        bridge._listen()
    bridge._control, bridge._closing = control, False


def test_cluster_without_a_free_cpu_is_refused_after_a_moment(begin):
    for others, says in ((2, "none of its 2 CPUs is free"), (0, "none of its nodes has a CPU")):
        _, cluster, after = begin(a=others)
        cluster.others["a"] = others
        after(2)  # what has just been released shows late
        with pytest.raises(UsageError, match=says):
            after(2)
    _, cluster, after = begin(resumed=True, a=2)
    cluster.others["a"] = 2
    after(9)  # it has run there before


def test_map_of_a_node_is_that_of_the_hunt_or_of_a_kept_trial(begin, tmp_path):
    bridge, cluster, after = begin(a=1)
    after()
    (actor,) = cluster.actors
    for number, lanes in ((0, b"first"), (1, b"second"), (2, b"")):
        submit(bridge, number)
        after()
        files = {"run.log": zlib.compress(b"said")}
        cluster.ready[actor.asked] = News([ended(number, files)], None, [], None, lanes and zlib.compress(lanes))
        after()
    assert (tmp_path / layout.MAP).read_text() == "first"
    kept = [scratch_of(tmp_path, number) for number in range(3)]
    assert [(folder / "run.log").read_text() for folder in kept] == ["said"] * 3
    assert [(folder / layout.MAP).exists() for folder in kept] == [False, True, True]
    assert {(folder / layout.MAP).read_text() for folder in kept[1:]} == {"second"}


def test_figures_are_sent_once_a_second(begin, clock):
    _, _, after = begin(a=1)
    assert any("nodes" in message for message in after())
    sent = [sum("nodes" in message for message in after()) for _ in range(3)]
    assert sent == [1, 1, 1]
