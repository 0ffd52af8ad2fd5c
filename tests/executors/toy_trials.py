"""Settings of executors for trials of the toy, and trials that run to their end."""

from __future__ import annotations

import time
from contextlib import closing

from crashhunt.episode import WorkerSettings
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.trial import CRASHES


def settings_for(folder, agent="crashhunt.agents:KeepLaneWithSpeed", *, scratch=None, **more):
    """Return settings for trials of an agent, with a scratch folder of their own unless one is given."""
    if scratch is None:
        scratch = folder / f"scratch-{time.monotonic_ns()}"
        scratch.mkdir()
    scenario = Scenario(simulator="toy", folder=folder, agents={"ego": AgentSetup(agent=agent)})
    return WorkerSettings(scratch=scratch, **{"scenario": scenario, "oracles": (), "crash_on": CRASHES} | more)


def results_of(executor, specs):
    """Run trials, close the executor, and return the results in the order of their numbers."""
    found, deadline = [], time.monotonic() + 300
    with closing(executor):
        for spec in specs:
            executor.submit(spec)
        while len(found) < len(specs):
            assert time.monotonic() < deadline, f"only {found} came back"
            found += executor.completed(0.2)
    return sorted(found, key=lambda result: result.spec.number)
