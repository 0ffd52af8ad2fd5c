"""What a process that died or hung left behind, as the result of its trial."""

from __future__ import annotations

import signal
import time
from typing import TYPE_CHECKING

from crashhunt.errors import BundleError
from crashhunt.executors._protocol import scratch_of
from crashhunt.executors._worker import BLACK_BOX, OUTPUT, STACK, read_tail
from crashhunt.oracles import closest_approach
from crashhunt.recording import BlackBoxHeader, Phase, Recording, read_black_box, read_header
from crashhunt.trial import ClosestApproach, Failure, Outcome, TrialResult

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.trial import TrialSpec

__all__ = ["died", "hung", "where_it_is"]


def where_it_is(scratch: Path, number: int) -> BlackBoxHeader | None:
    """Return where a running trial is, or None where it has not begun."""
    header = read_header(scratch_of(scratch, number) / BLACK_BOX)
    return header if header is not None and header.trial == number else None


def died(spec: TrialSpec, scratch: Path, exit_code: int) -> TrialResult:
    """Return the result of a trial whose process died.

    Before the first step that is a start-up failure, which makes the trial invalid; afterwards it is a crash.
    """
    header = where_it_is(scratch, spec.number)
    message = (
        f"the process died of {_signal_name(exit_code)}" if exit_code < 0 else f"the process exited with {exit_code}"
    )
    kind = "signal" if exit_code < 0 else "exit code"
    return _result(spec, scratch, header, Outcome.PROCESS_DIED, kind, message, exit_code)


def hung(spec: TrialSpec, scratch: Path, timeout_s: float) -> TrialResult:
    """Return the result of a trial that was still running at its wall-clock limit, and has been killed."""
    header = where_it_is(scratch, spec.number)
    message = f"still running after {timeout_s:g} s"
    return _result(spec, scratch, header, Outcome.HANG, "timeout", message, None)


def _result(
    spec: TrialSpec,
    scratch: Path,
    header: BlackBoxHeader | None,
    outcome: Outcome,
    kind: str,
    message: str,
    exit_code: int | None,
) -> TrialResult:
    folder = scratch_of(scratch, spec.number)
    output = read_tail(folder / OUTPUT)
    stack = read_tail(folder / STACK)
    agent, steps, sim_time_s, digest, closest = "", 0, 0.0, "", ClosestApproach()
    phase = header.phase if header is not None else Phase.SETUP
    try:
        recording = Recording(read_black_box(folder / BLACK_BOX)) if header is not None else None
    except BundleError:
        recording = None
    scenes = recording.scenes() if recording is not None else []
    if recording is None or not scenes or phase == Phase.SETUP:
        outcome, message = Outcome.INVALID, f"{message} while the episode was being set up"
    else:
        steps, sim_time_s, digest = recording.steps, scenes[-1].time_s, recording.digest
        closest = closest_approach(scenes, recording.agents)
        if header is not None and phase == Phase.ACT:
            agent = recording.agents[header.agent]
            message = f"{message} in {agent}'s act() of step {steps + 1}"
        else:
            message = f"{message} in the simulator at step {steps + 1}"
    failure = Failure(kind, message, stack, agent, exit_code, output)
    wall_s = time.monotonic() - header.started if header is not None else 0.0
    return TrialResult(
        spec,
        outcome,
        steps=steps,
        sim_time_s=sim_time_s,
        digest=digest,
        closest=closest,
        failure=failure,
        wall_s=wall_s,
        worker=header.pid if header is not None else 0,
        kept=folder.is_dir(),
    )


def _signal_name(exit_code: int) -> str:
    try:
        return signal.Signals(-exit_code).name
    except ValueError:
        return f"signal {-exit_code}"
