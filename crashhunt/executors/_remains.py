"""What a process that died or hung left behind, as the result of its trial."""

from __future__ import annotations

import json
import os
import signal
import time
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.signals import is_sent_from_outside
from crashhunt.episode import scratch_of
from crashhunt.recording import BlackBoxHeader, Phase, Recording, read_black_box, read_header
from crashhunt.trial import KILLED, Failure, Outcome, TrialResult, in_effect
from crashhunt.world import ClosestApproach, DangerMeter, Lane, closest_approach

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.trial import TrialSpec

__all__ = [
    "Attempt",
    "damaged",
    "died",
    "hung",
    "read_map",
    "read_tail",
    "result_of_death",
    "signal_name",
    "where_it_is",
]

_TAIL = 4000  # bytes
_ATTEMPTS = 3  # of a trial whose process is killed from outside


@dataclass(slots=True)
class Attempt:
    """A trial that is to be run, and what has become of it so far.

    A process that ends by certain signals may have been ended from outside: by an administrator, a batch system, the
    kernel because memory ran out. Then the trial is run again, alone. Where it ends in the same way at the same place
    it was the trial itself. Where it ends at another place each time, the trial is not the cause.

    Args:
        spec: the trial.
        ends: of its processes: which signal, at which step.
    """

    spec: TrialSpec
    ends: list[tuple[int, int]] = field(default_factory=list)

    @property
    def alone(self) -> bool:
        """Whether no other trial may run meanwhile."""
        return bool(self.ends)

    @property
    def is_killed_from_outside(self) -> bool:
        """Whether every allowed attempt was killed, each at another step: no attempt shows how the trial ends."""
        return len(self.ends) >= _ATTEMPTS and len(set(self.ends)) == len(self.ends)

    def again(self, scratch: Path, exit_code: int) -> str:
        """Why it is to be run once more, in words; empty where what has happened is its outcome."""
        if not is_sent_from_outside(exit_code):
            return ""
        header = where_it_is(scratch, self.spec.number)
        end = exit_code, header.step if header is not None else -1
        seen = end in self.ends
        self.ends.append(end)
        if seen or len(self.ends) >= _ATTEMPTS:
            return ""
        return f"trial {self.spec.number} was ended by {signal_name(exit_code)} from outside, and is run again"


def where_it_is(scratch: Path, number: int) -> BlackBoxHeader | None:
    """Return where a running trial is, or None where it has not begun."""
    header = read_header(scratch_of(scratch, number) / layout.BLACK_BOX)
    return header if header is not None and header.trial == number else None


def died(spec: TrialSpec, scratch: Path, exit_code: int) -> TrialResult:
    """Return the result of a trial whose process died.

    Before the first step that is a start-up failure, which makes the trial invalid; afterwards it is a crash.
    """
    header = where_it_is(scratch, spec.number)
    message = (
        f"the process died of {signal_name(exit_code)}" if exit_code < 0 else f"the process exited with {exit_code}"
    )
    kind = "signal" if exit_code < 0 else "exit code"
    return _result(spec, scratch, header, Outcome.PROCESS_DIED, kind, message, exit_code)


def result_of_death(attempt: Attempt, scratch: Path, exit_code: int) -> TrialResult:
    """Return the result of a trial whose process died and that is not run again.

    The trial is invalid where its processes were killed from outside at different steps, and else as of `died`.

    Args:
        attempt: the trial; `Attempt.again` has been called with this death.
        scratch: the folder in which the trial records.
        exit_code: exit code of the process; negative for a signal.
    """
    result = died(attempt.spec, scratch, exit_code)
    if not attempt.is_killed_from_outside:
        return result
    ends = ", ".join(f"{signal_name(code)} after step {max(0, step)}" for code, step in attempt.ends)
    why = f"killed from outside {len(attempt.ends)} times, each time at another step ({ends})"
    failure = Failure(KILLED, why, exit_code=exit_code)
    return TrialResult(
        attempt.spec, Outcome.INVALID, failure=failure, wall_s=result.wall_s, worker=result.worker, kept=result.kept
    )


def damaged(spec: TrialSpec, scratch: Path, message: str, *, agent: str = "", recorded: bool = True) -> TrialResult:
    """Return the result of a trial whose process damaged itself or its recording.

    Args:
        spec: the trial.
        scratch: the folder in which it recorded.
        message: what is damaged, as a sentence.
        agent: identifier of the agent that did it, where the recording cannot be read; empty where that is not known.
        recorded: whether the recording can be read.
    """
    if recorded:
        header = where_it_is(scratch, spec.number)
        return _result(spec, scratch, header, Outcome.AGENT_ERROR, "damaged process", message, None, agent)
    output = read_tail(scratch_of(scratch, spec.number) / layout.RUN_LOG)
    failure = Failure("damaged recording", message, agent=agent, last_output=output)
    return TrialResult(spec, Outcome.AGENT_ERROR, failure=failure, kept=True)


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
    agent: str = "",
) -> TrialResult:
    folder = scratch_of(scratch, spec.number)
    output = read_tail(folder / layout.RUN_LOG)
    stack = read_tail(folder / layout.STACK)
    steps, sim_time_s, digest, closest = 0, 0.0, "", ClosestApproach()
    danger: float | None = None
    phase = header.phase if header is not None else Phase.SETUP
    try:
        recording = Recording(read_black_box(folder / layout.BLACK_BOX)) if header is not None else None
        scenes = recording.scenes() if recording is not None else []
    except Exception:  # of whatever kind: a process that ran foreign code may have written anything there
        recording, scenes = None, []
    if phase == Phase.SETUP or (recording is not None and not scenes):
        outcome, message = Outcome.INVALID, f"{message} while the episode was being set up"
    elif recording is None:
        message = f"{message}, and its recording cannot be read"
    else:
        steps, sim_time_s, digest = recording.steps, scenes[-1].time_s, recording.digest
        closest = closest_approach(scenes, recording.agents)
        meter = DangerMeter(recording.agents, recording.prologue.step_length_s)
        meter.add([scene.frame for scene in scenes])
        danger = meter.danger
        if outcome is Outcome.AGENT_ERROR:
            agent = recording.agents[0] if len(recording.agents) == 1 else ""
        elif header is not None and phase == Phase.ACT:
            agent = recording.agents[header.agent]
            message = f"{message} in {agent}'s act() of step {steps + 1}"
        elif phase == Phase.DONE:  # where no code but that of agents runs, in close() or a finalizer
            agent = recording.agents[0] if len(recording.agents) == 1 else ""
            message = f"{message} after the last step"
        else:
            message = f"{message} in the simulator at step {steps + 1}"
    failure = Failure(kind, message, stack, agent, exit_code, output)
    wall_s = time.monotonic() - header.started if header is not None else 0.0
    result = TrialResult(
        spec,
        outcome,
        steps=steps,
        sim_time_s=sim_time_s,
        digest=digest,
        closest=closest,
        danger=danger,
        failure=failure,
        wall_s=wall_s,
        worker=header.pid if header is not None else 0,
        kept=folder.is_dir(),
        setup_steps=(header.setup_steps or None) if header is not None else None,
    )
    return in_effect(result, recording.disturbances if recording is not None else ())


def read_map(scratch: Path, trial: Path) -> list[Lane]:
    """Return the map of a trial that is kept, or that of its hunt; nothing where none has been written down."""
    for folder in (trial, scratch):
        with suppress(OSError, ValueError, TypeError):
            data = json.loads((folder / layout.MAP).read_text(encoding="utf-8"))
            return [Lane(name, width, tuple(map(tuple, shape))) for name, width, shape in data]
    return []


def read_tail(path: Path) -> str:
    """Return the last few thousand characters of a file; nothing where there is none."""
    try:
        with path.open("rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(max(0, file.tell() - _TAIL))
            return file.read().decode("utf-8", "replace")
    except OSError:
        return ""


def signal_name(exit_code: int) -> str:
    """Return what people call the signal that a process died of."""
    try:
        return signal.Signals(-exit_code).name
    except ValueError:
        return f"signal {-exit_code}"
