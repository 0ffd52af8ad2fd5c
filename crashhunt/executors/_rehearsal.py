"""Rehearses a trial before the user's modules are imported, so that the processes of trials have less to prepare.

Python specializes the bytecode of a function after some calls, fills its caches of attributes, and imports some modules
at the first use. A process that is forked for one trial would do all of this for its one trial, and would copy the
pages of memory that it changes. The rehearsal does it once, in the process from which all of them are forked.

No result depends on the rehearsal: it runs no code of the user, and all generators are seeded after it.
"""

from __future__ import annotations

import importlib
import json
import os
import time
from contextlib import suppress
from typing import TYPE_CHECKING

from crashhunt.base.codec import prepare
from crashhunt.episode import run_episode
from crashhunt.oracles import parse_oracle
from crashhunt.recording import BlackBox
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.trial import TrialResult, TrialSpec

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

_REHEARSALS = 10  # Python specializes a function at its 8th call
_STEPS = 2
_AGENT = "crashhunt.agents:KeepLaneWithSpeed"


def rehearse_trial(scratch: Path, report: Callable[[str], None]) -> None:
    """Run short trials of the toy in this process; they take some 20 ms. A failure has no consequence.

    Args:
        scratch: scratch folder of the hunt.
        report: function called before the import of Gymnasium, as in `Parts.load`.
    """
    report("Gymnasium cannot be imported")
    path = scratch / f"rehearsal-{os.getpid()}"
    with suppress(Exception):  # such as a full disk, which the first trial reports
        importlib.import_module("gymnasium")
        prepare(TrialResult)
        try:
            _rehearse(path)
        finally:
            path.unlink(missing_ok=True)


def _rehearse(path: Path) -> None:
    from crashhunt.agents import KeepLaneWithSpeed  # this import, as the next, needs Gymnasium
    from crashhunt.simulators.toy import ToySimulator

    scenario = Scenario(simulator="toy", agents={"ego": AgentSetup(agent=_AGENT)})
    simulator, oracle, box = ToySimulator(scenario, path), parse_oracle("overlap"), BlackBox(path)
    try:
        for number in range(_REHEARSALS):
            box.begin(pid=os.getpid(), trial=number, started=time.monotonic())
            spec = TrialSpec(
                number=number, seed=number, arguments={"ego": {"speed": 1.0}}, scenario_arguments={}, max_steps=_STEPS
            )
            result = run_episode(
                TrialSpec.from_json(json.loads(json.dumps(spec.to_json()))),
                simulator=simulator,
                make_agent=lambda *_: KeepLaneWithSpeed(speed=1.0),
                box=box,
                oracles=[oracle.make()],
            )
            box.report(json.dumps(result.to_json()).encode())
    finally:
        box.close()
