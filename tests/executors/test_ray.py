"""Trials on a Ray cluster: several nodes on this machine, and real kills."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import sqlite3
import time
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest
from ray_cluster import below, head, nodes

if find_spec("ray") is None:  # to import it takes a while, wherever its tests are not run
    pytest.skip("Ray is not installed: pip install 'crashhunt[ray]'", allow_module_level=True)

from crashhunt.base.errors import CrashhuntError, UsageError
from crashhunt.episode import WorkerSettings
from crashhunt.executors import PoolExecutor
from crashhunt.executors.ray import RayExecutor
from crashhunt.scenario import AgentSetup, ArgumentSetup, Scenario
from crashhunt.testing import ExecutorContract
from crashhunt.trial import CRASHES, TrialSpec

DEADLINE_S = 300.0  # as on a loaded machine


@pytest.fixture(scope="module")
def cluster():
    """A head that runs nothing, and a node of two CPUs."""
    with head() as found:
        found.add_node(num_cpus=2)
        yield found


@pytest.fixture
def add(cluster):
    """Adds nodes, and removes them in the end."""
    with nodes(cluster) as added:

        def node(**options):
            added.append(cluster.add_node(**options))
            return added[-1]

        yield node


@pytest.fixture
def settings(tmp_path):
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    switches = ("fail_at_step", "exit_at_step", "segfault_at_step", "hang_at_step", "step_wall_s")
    scenario = Scenario(
        simulator="toy",
        folder=tmp_path,
        agents={"ego": AgentSetup()},
        arguments={name: ArgumentSetup(default=0) for name in switches},
    )
    return WorkerSettings(scenario=scenario, oracles=(), crash_on=CRASHES, scratch=scratch, timeout_s=20.0)


@pytest.fixture
def begin(cluster, settings):
    """Begins executors on the cluster, and ends them."""
    begun = []

    def executor(parallel=0, **changes):
        begun.append(RayExecutor(settings, parallel=parallel, argument=cluster.address))
        return begun[-1]

    yield executor
    for one in begun:
        one.close()


def spec(number, **arguments):
    return TrialSpec(number, number, {"ego": {"speed": 5.0}}, arguments, max_steps=30)


def collect(executor, count, *, until_s=DEADLINE_S):
    found = {}
    deadline = time.monotonic() + until_s
    while len(found) < count:
        assert time.monotonic() < deadline, f"only {sorted(found)} came back; {executor.notes()}"
        for result in executor.completed(0.2):
            assert result.spec.number not in found, "a trial came back twice"
            found[result.spec.number] = result
    return found


@pytest.mark.nightly  # as all that needs a cluster
class TestRayExecutor(ExecutorContract):
    @pytest.fixture
    def make(self, cluster):
        return lambda settings, parallel: RayExecutor(settings, parallel=parallel, argument=cluster.address)

    @pytest.mark.nightly
    def test_what_is_reported_is_reported_once(self, executor):
        super().test_what_is_reported_is_reported_once(executor)

    @pytest.mark.nightly
    def test_closing_twice_is_fine(self, executor):
        super().test_closing_twice_is_fine(executor)

    @pytest.mark.nightly
    def test_it_states_how_much_it_runs_and_where_that_is(self, executor):
        super().test_it_states_how_much_it_runs_and_where_that_is(executor)

    @pytest.mark.nightly
    def test_cancelled_trials_do_not_come_back(self, executor):
        super().test_cancelled_trials_do_not_come_back(executor)

    @pytest.mark.nightly
    def test_what_is_kept_has_its_black_box_here(self, executor, tmp_path):
        super().test_what_is_kept_has_its_black_box_here(executor, tmp_path)


def digests(results):
    return {number: (result.outcome, result.steps, result.digest) for number, result in results.items()}


def raylet(node):
    return node.all_processes["raylet"][0].process.pid


def process_of(node, title):
    """The process of a node that has set a title, such as its actor."""
    for pid in below(raylet(node)):
        with contextlib.suppress(OSError):
            if Path(f"/proc/{pid}/cmdline").read_bytes().startswith(title.encode()):
                return pid
    return None


def gone(pids):
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline:
        if not any(Path(f"/proc/{pid}").exists() for pid in pids):
            return True
        time.sleep(0.1)
    return False


def collect_into(found, executor, count):
    """Collect until there are so many."""
    more = collect(executor, max(0, count - len(found)))
    assert not found.keys() & more.keys(), "a trial came back twice"
    found |= more


def on_one_machine(settings, specs, tmp_path):
    scratch = tmp_path / "pool"
    scratch.mkdir()
    pool = PoolExecutor(replace(settings, scratch=scratch), parallel=2)
    try:
        for one in specs:
            pool.submit(one)
        return collect(pool, len(specs))
    finally:
        pool.close()


def busy(executor, specs, found, until):
    """Collect until something is so; the executor has something to do all the time."""
    deadline = time.monotonic() + DEADLINE_S
    while not until():
        assert time.monotonic() < deadline, f"only {sorted(found)} came back; {executor.notes()}"
        while len(specs) < len(found) + 12:
            specs.append(spec(len(specs), step_wall_s=0.02))
            executor.submit(specs[-1])
        for result in executor.completed(0.2):
            assert result.spec.number not in found, "a trial came back twice"
            found[result.spec.number] = result


@pytest.mark.nightly  # by day, test_ray_bridge.py asks it of a made-up cluster
def test_what_is_killed_costs_time_and_nothing_else(begin, add, settings, tmp_path):
    """A node that joins late, its actor, then the node: every trial comes back once, as it does on one machine."""
    specs, found = [], {}
    executor = begin()
    busy(executor, specs, found, lambda: found)
    assert executor.capacity == 2
    node = add(num_cpus=2)
    busy(executor, specs, found, lambda: executor.capacity == 4)
    actor = process_of(node, "ray::Site")
    os.kill(actor, signal.SIGSTOP)  # so that it has something to do when it ends
    left = below(actor)
    os.kill(actor, signal.SIGKILL)
    assert gone(left), "the workers of an actor end with it"
    count = len(found)
    busy(executor, specs, found, lambda: len(found) >= count + 4)
    os.kill(raylet(node), signal.SIGKILL)
    busy(executor, specs, found, lambda: executor.capacity == 2)
    collect_into(found, executor, len(specs))
    assert list(executor.completed(0.3)) == []
    assert any("was lost" in note for note in executor.notes())
    assert digests(found) == digests(on_one_machine(settings, specs, tmp_path))


@pytest.mark.nightly
def test_where_all_nodes_are_lost_it_waits_and_states_so(begin, add):
    """The machine goes with everything on it; CPUs that somebody else leaves then are as good as a new one."""
    other = begin(2)
    other.submit(spec(99))
    collect(other, 1)
    node = add(num_cpus=1)
    executor = begin()
    for number in range(8):
        executor.submit(spec(number, step_wall_s=0.01))
    found = collect(executor, 1)
    for pid in [raylet(node), *below(raylet(node))]:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    deadline = time.monotonic() + DEADLINE_S
    while not any(line.startswith("no node of the cluster is left; the hunt waits") for line in executor.notes()):
        assert time.monotonic() < deadline
        found |= {result.spec.number: result for result in executor.completed(0.1)}
    assert executor.nodes() == []
    assert executor.capacity == 1, "or the hunt would take it for done"
    assert len(found) < 8
    other.close()
    collect_into(found, executor, 8)


@pytest.mark.nightly
def test_a_node_that_differs_takes_no_part_and_the_others_continue(begin, add, tmp_path):
    """What travels to it says so, whatever there is."""
    other = tmp_path / "other" / "libsumo-0.1.dist-info"
    other.mkdir(parents=True)
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: libsumo\nVersion: 0.1\n")
    (tmp_path / "other" / "crashhunt").mkdir()
    (tmp_path / "other" / "crashhunt" / "__init__.py").write_text("raise SystemExit")
    add(num_cpus=1, env_vars={"PYTHONPATH": str(tmp_path / "other")})
    executor = begin(3)
    notes = []
    deadline = time.monotonic() + DEADLINE_S
    while not notes and time.monotonic() < deadline:
        list(executor.completed(0.1))
        notes += executor.notes()
    executor.submit(spec(0))
    collect(executor, 1)
    (note,) = notes
    assert re.fullmatch(r"node \S+ takes no part: libsumo is 0.1 there and [\d.]+ here", note)
    assert executor.capacity == 2


def refusal(executor):
    """What an executor raises that can run nothing."""
    executor.submit(spec(0))
    with pytest.raises(CrashhuntError) as raised:
        collect(executor, 1)
    return str(raised.value)


@pytest.mark.nightly
def test_a_cluster_that_can_run_nothing_states_why(begin, settings, cluster):
    lacking = replace(settings, scenario=replace(settings.scenario, agents={"ego": AgentSetup(agent="nowhere:Agent")}))
    executor = RayExecutor(lacking, argument=cluster.address)
    said = refusal(executor)
    executor.close()
    assert "'nowhere:Agent' cannot be imported: No module named 'nowhere'; install the packages of this machine" in said
    assert said.count("\n") == 0

    first = begin()
    first.submit(spec(0))
    collect(first, 1)
    assert f"the Ray cluster at {cluster.address} cannot run trials: none of its 2 CPUs is free; wait" in refusal(
        begin()
    )


def test_what_is_too_large_to_travel_is_refused(settings, tmp_path):
    (tmp_path / "code").mkdir()
    with (tmp_path / "code" / "weights.bin").open("wb") as file:
        file.truncate(300 * 10**6)
    with pytest.raises(
        UsageError, match=r"have 300 MB, above the 200 MB .* is \S+weights.bin \(300 MB\); make this file smaller"
    ):
        RayExecutor(replace(settings, code=(str(tmp_path / "code"),)), argument="local")


def rows(shell, hunt):
    """The ledger of a hunt, but for times and processes."""
    with sqlite3.connect(shell.folder / hunt / "ledger.sqlite") as ledger:
        ledger.row_factory = sqlite3.Row
        found = [dict(row) for row in ledger.execute("select * from trials order by number")]
    ledger.close()
    for row in found:
        row |= json.loads(row.pop("result"))
    passing = ("wall_s", "setup_s", "worker", "ended_at", "integrity")
    return [{key: value for key, value in row.items() if key not in passing} for row in found]


@pytest.mark.nightly  # by day, test_ray_bridge.py and test_ray_store.py run both ends without a cluster
@pytest.mark.long
def test_a_hunt_is_the_same_as_on_one_machine(toy, cluster):
    """The same rows, and the same first crash with everything that belongs to it."""
    words = ("2", "12", "60", "--scenario", "toy", "--seed", "3", "--arg", "speed=5:14", "--deterministic", "--json")
    here = toy.crashhunt("run", "h", *words).json
    there = toy.crashhunt("run", "g", *words, "--executor", f"ray:{cluster.address}").json
    crash, same = here["crashes"][0], there["crashes"][0]
    assert crash | {"path": ""} == same | {"path": ""}
    assert same["confirmed"]
    assert there["stopped_because"] == "crash"
    assert rows(toy, "h")[: crash["trial"] + 1] == rows(toy, "g")[: crash["trial"] + 1]
    assert toy.crashhunt("replay", "g", "--json").json["verdict"] == "reproduced"
