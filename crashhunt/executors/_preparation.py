"""Prepares the process from which the processes of trials are forked: rehearses a trial, and imports what trials need.

The rehearsal comes before the user's modules are imported, so that the processes of trials have less to prepare.

Python specializes the bytecode of a function after some calls, fills its caches of attributes, and imports some modules
at the first use. A process that is forked for one trial would do all of this for its one trial, and would copy the
pages of memory that it changes. The rehearsal does it once, in the process from which all of them are forked.

No result depends on the rehearsal: it runs no code of the user, and all generators are seeded after it.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from crashhunt.base.codec import prepare
from crashhunt.base.forks import ended, threads
from crashhunt.base.plugins import locate, registered
from crashhunt.base.processes import end_descendants
from crashhunt.episode import Parts, WorkerSettings, run_episode
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

    ``report`` is called before the import of Gymnasium, as in `Parts.load`.
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


@dataclass(frozen=True, slots=True)
class Imported:
    """The result of the preparation that is made once, before the processes of trials are forked."""

    parts: Parts | None  # the imported parts; None if each trial imports its agents itself
    makes_simulator: bool  # whether the zygote creates the simulator; if not, each trial creates its own simulator


_NOTHING_IMPORTED: Final = Imported(None, makes_simulator=False)


def import_parts(settings: WorkerSettings, report: Callable[[str], None]) -> Imported | None:
    """Rehearse a trial, import the modules that trials need, and check whether a zygote may create the simulator.

    ``report`` is called before each import, as in `Parts.load`, and with an empty text at the end.

    Returns:
        The result; None if this process can no longer be forked.

    Raises:
        CrashhuntError: a module cannot be imported.
    """
    parts = Parts(settings)
    rehearse_trial(settings.scratch, report)
    parts.load(report)
    if not _can_be_forked():
        return None
    report("the simulator cannot be made")
    makes_simulator = settings.scenario.backend.forkable or _is_forkable_with(parts)
    report("")
    return Imported(parts, makes_simulator=makes_simulator)


def import_nothing(settings: WorkerSettings) -> Imported:
    """Import only the library of the simulator, because trials import their agents themselves.

    Raises:
        CrashhuntError: the library cannot be imported.
    """
    if settings.scenario.simulator in registered("simulators"):
        locate("simulators", settings.scenario.simulator)
    return _NOTHING_IMPORTED


def _is_forkable_with(parts: Parts) -> bool:
    """Return whether a process can still be forked after it has created the simulator; a fork of this process tries it.

    The check is needed because an environment may start threads, which a fork does not have.
    """
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            parts.simulator()
            code = 0 if _can_be_forked() else 1
        finally:
            os._exit(code)
    forkable = ended(pid) == 0
    end_descendants()
    return forkable


def _can_be_forked() -> bool:
    """Return whether this process can be forked after its imports: it has no other threads and uses no GPU."""
    torch = sys.modules.get("torch")
    return len(threads()) == 1 and not (torch is not None and torch.cuda.is_initialized())
