"""Results of trials from the files that a dead process has left."""

from __future__ import annotations

import json
import os
import re
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crashhunt.base import layout
from crashhunt.base.exceptions import is_users
from crashhunt.base.signals import signal_name
from crashhunt.base.text import unescape_letters
from crashhunt.episode import scratch_of
from crashhunt.executors._native_stack import split_native_calls
from crashhunt.executors._trial_attempts import where_it_is
from crashhunt.recording import (
    BlackBoxHeader,
    Phase,
    Recording,
    read_black_box,
)
from crashhunt.trial import KILLED, Failure, Outcome, TrialResult, in_effect
from crashhunt.world import DangerMeter, DrivenMeter, Lane, closest_approach, join_frames

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.executors._trial_attempts import TrialAttempt
    from crashhunt.trial import TrialSpec
    from crashhunt.world import Scene


_HEAD_BYTES, _TAIL_BYTES = 2000, 4000
_MAX_NATIVE_BYTES = 1 << 16
_FRAME_LINE = re.compile(r'  File "(.*)", line (\d+) in (.*)')  # of a stack that faulthandler wrote


@dataclass(frozen=True, slots=True)
class EndedTrial:
    """A trial that has ended."""

    result: TrialResult
    notices: tuple[str, ...] = ()  # texts for the user
    # how the vehicle that collided brakes fully, and its deceleration; None if the settings do not request it
    braking: Mapping[str, object] | None = None


def died(spec: TrialSpec, scratch: Path, exit_code: int, agents: Mapping[str, str] | None = None) -> TrialResult:
    """Return the result of a trial whose process died.

    If the process died before the first step, the trial is invalid because of a start-up failure. If it died later, the
    result is a crash. The exit code is negative for a signal. ``agents`` has the module of each agent whose module no
    other agent uses.
    """
    header = where_it_is(scratch, spec.number)
    message = (
        f"the process died of {signal_name(exit_code)}" if exit_code < 0 else f"the process exited with {exit_code}"
    )
    kind = "signal" if exit_code < 0 else "exit code"
    return _result(spec, scratch, header, Outcome.PROCESS_DIED, kind, message, exit_code, agents=agents)


def result_of_death(attempt: TrialAttempt, scratch: Path, exit_code: int) -> TrialResult:
    """Return the result of a trial whose process died, if the trial is not run again.

    The trial is invalid if its processes were killed from outside at different steps. In all other cases, `died` gives
    the result. `TrialAttempt.again` has been called for the last process. The exit code is negative for a signal.
    """
    result = died(attempt.spec, scratch, exit_code)
    if not attempt.is_killed_from_outside:
        return result
    ends = ", ".join(f"{signal_name(code)} after step {max(0, step)}" for code, step in attempt.ends)
    why = f"killed from outside {len(attempt.ends)} times, each time at another step ({ends})"
    lost = killed_from_outside(attempt.spec, why, exit_code)
    return replace(lost, wall_s=result.wall_s, worker=result.worker, kept=result.kept)


def killed_from_outside(spec: TrialSpec, why: str, exit_code: int) -> TrialResult:
    """Return the result of a trial that was killed from outside, so that a resumed hunt runs it again.

    ``why`` has the number of the kills, and the steps at which they happened. The exit code is negative for a signal.
    """
    return TrialResult(spec, Outcome.INVALID, failure=Failure(KILLED, why, exit_code=exit_code))


def damaged(spec: TrialSpec, scratch: Path, message: str, *, agent: str = "", recorded: bool = True) -> TrialResult:
    """Return the result of a trial whose process damaged itself or its recording.

    ``agent`` is the one that did the damage, if the recording cannot be read.
    """
    if recorded:
        header = where_it_is(scratch, spec.number)
        return _result(spec, scratch, header, Outcome.AGENT_ERROR, "damaged process", message, None, agent)
    output = read_ends(scratch_of(scratch, spec.number) / layout.RUN_LOG)
    failure = Failure("damaged recording", message, agent=agent, last_output=output)
    return TrialResult(spec, Outcome.AGENT_ERROR, failure=failure, kept=True)


def hung(spec: TrialSpec, scratch: Path, timeout_s: float) -> TrialResult:
    """Return the result of a trial that reached its wall-time limit and was killed."""
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
    agents: Mapping[str, str] | None = None,
) -> TrialResult:
    folder = scratch_of(scratch, spec.number)
    stack = _read_stack(folder / layout.STACK)
    phase = header.phase if header is not None else Phase.SETUP
    try:
        recording = Recording(read_black_box(folder / layout.BLACK_BOX)) if header is not None else None
        scenes = recording.scenes() if recording is not None else []
    except Exception:  # of whatever kind: a process that ran foreign code may have written anything there
        recording, scenes = None, []
    measured: dict[str, Any] = {}
    if phase == Phase.SETUP or (recording is not None and not scenes):
        if header is not None and recording is not None and phase == Phase.ACT:
            agent = recording.agents[header.agent] if header.agent < len(recording.agents) else ""
            message = f"{message} in {agent}'s constructor or reset()" if agent else message
        agent = agent or agent_in_stack(stack, agents or {})
        message = f"{message}{_users_frame(stack)}" if outcome is Outcome.HANG else message
        outcome, message = Outcome.INVALID, f"{message} while the episode was being set up"
    elif recording is None or header is None:
        message = f"{message}, and its recording cannot be read"
    else:
        measured = _measures(recording, scenes)
        agent, where = _place_in_step(outcome, header, recording, stack, agents or {})
        message = f"{message}{where}"
    output = read_ends(folder / layout.RUN_LOG)
    failure = Failure(kind=kind, message=message, traceback=stack, agent=agent, exit_code=exit_code, last_output=output)
    result = TrialResult(
        spec,
        outcome,
        failure=failure,
        wall_s=time.monotonic() - header.started if header is not None else 0.0,
        worker=header.pid if header is not None else 0,
        kept=folder.is_dir(),
        setup_steps=(header.setup_steps or None) if header is not None else None,
        step_length_s=recording.prologue.step_length_s if recording is not None and scenes else None,
        **measured,
    )
    return in_effect(result, recording.disturbances if recording is not None else ())


def _measures(recording: Recording, scenes: Sequence[Scene]) -> dict[str, Any]:
    """Return what the recorded steps tell, as fields of a `TrialResult`."""
    frames = [*join_frames(scenes)]
    meter = DangerMeter(recording.agents, recording.prologue.step_length_s)
    meter.add(frames)
    driven = DrivenMeter(recording.agents, recording.prologue.step_length_s)
    driven.add(frames)
    return {
        "steps": recording.steps,
        "sim_time_s": scenes[-1].time_s,
        "digest": recording.digest,
        "closest": closest_approach(scenes, recording.agents),
        "danger": meter.danger,
        "driven_m": driven.driven_m,
        "driven_s": driven.driven_s,
    }


def _place_in_step(
    outcome: Outcome, header: BlackBoxHeader, recording: Recording, stack: str, agents: Mapping[str, str]
) -> tuple[str, str]:
    """Return the agent whose code a lost trial was in, empty for none, and the place as the end of a message."""
    only = recording.agents[0] if len(recording.agents) == 1 else ""
    step = recording.steps + 1
    if outcome is Outcome.AGENT_ERROR:
        return only, ""
    if header.phase == Phase.ACT:
        agent = recording.agents[header.agent]
        return agent, f" in {agent}'s act() of step {step}"
    if header.phase == Phase.DONE:  # where no code but that of agents runs, in close() or a finalizer
        return only, " after the last step"
    agent = agent_in_stack(stack, agents)
    whose = f"{agent}'s code" if agent else "the simulator"
    where = _users_frame(stack) if outcome is Outcome.HANG else ""
    return agent, f" in {whose}{where} at step {step}"


def agent_in_stack(stack: str, agents: Mapping[str, str]) -> str:
    """Return the agent whose code was running when the process died; empty if the stack does not show an agent.

    The simulator may be interrupted by a signal handler of an agent. In that case, the frames of the handler lie above
    those of crashhunt.
    """
    _, _, frames = stack.rpartition("\nCurrent thread ")
    for line in frames.split("\n\n", 1)[0].splitlines():
        found = _FRAME_LINE.match(line)
        if found is None:
            continue
        if found[1].startswith(str(layout.PACKAGE)):
            return ""
        endings = {name: module.replace(".", os.sep) for name, module in agents.items()}
        named = [
            name
            for name, ending in endings.items()
            if found[1].endswith((f"{os.sep}{ending}.py", f"{os.sep}{ending}{os.sep}__init__.py"))
        ]
        if named:
            return named[0] if len(named) == 1 else ""
    return ""


def _users_frame(stack: str) -> str:
    """Return the innermost function of the user in a stack as text in brackets; empty if there is none."""
    frames = (
        found
        for line in stack.rpartition("(most recent call first):")[2].splitlines()
        if (found := _FRAME_LINE.match(line))
    )
    frame = next((frame for frame in frames if is_users(frame[1])), None)
    return "" if frame is None else f" ({Path(frame[1]).name}, line {frame[2]} in {frame[3]})"


def read_map(scratch: Path, trial: Path) -> list[Lane]:
    """Return the map of a kept trial, or the map of its hunt; empty if neither was written."""
    for folder in (trial, scratch):
        with suppress(OSError, ValueError, TypeError):
            data = json.loads((folder / layout.MAP).read_text(encoding="utf-8"))
            return [Lane(name, width, tuple(map(tuple, shape))) for name, width, shape in data]
    return []


def read_ends(path: Path) -> str:
    """Return the first and the last few thousand characters of a file; empty if the file does not exist."""
    try:
        with path.open("rb") as file:
            between = file.seek(0, os.SEEK_END) - _HEAD_BYTES - _TAIL_BYTES
            file.seek(0)
            if between <= 0:
                return file.read().decode("utf-8", "replace")
            head = file.read(_HEAD_BYTES).decode("utf-8", "replace")
            file.seek(between, os.SEEK_CUR)
            return f"{head}\n[{between:,} bytes omitted]\n{file.read().decode('utf-8', 'replace')}"
    except OSError:
        return ""


def _read_stack(path: Path) -> str:
    """Return the stack of a dead process; after the native calls, if there are any, only the end of the rest."""
    try:
        with path.open("rb") as file:
            text = file.read(_MAX_NATIVE_BYTES).decode("utf-8", "replace")
    except OSError:
        return ""
    native, rest = split_native_calls(text)
    return f"{native}{unescape_letters(rest[-_TAIL_BYTES:])}" if native else unescape_letters(read_ends(path))
