"""Trials on a Ray cluster: several nodes on this machine, and real kills."""

from __future__ import annotations

import re
import time
from dataclasses import replace
from importlib.util import find_spec

import pytest
from ray_cluster import head, nodes

if find_spec("ray") is None:  # to import it takes a while, wherever its tests are not run
    pytest.skip("Ray is not installed: pip install 'crashhunt[ray]'", allow_module_level=True)

from crashhunt.base.errors import CrashhuntError, UsageError
from crashhunt.episode import WorkerSettings
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
