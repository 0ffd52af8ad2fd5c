"""What the process of a trial leaves behind when it ends, and whether it may be believed.

That process runs foreign code. So what it leaves is evidence, and no instruction: records in the black box, behind them
one report, and an exit code. The supervisor believes the report where all of them agree. The report carries a keyed
hash over itself and over the trace digest. The key is new for every trial, and only the process of the trial is given
it: this keeps out code that writes into the file, but not code that searches the memory of its own process for the key.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
from dataclasses import replace
from typing import TYPE_CHECKING, NotRequired, TypedDict, cast

from crashhunt.recording import Tag, digest_of
from crashhunt.trial import Outcome, TrialResult

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from crashhunt.recording import BlackBoxHeader
    from crashhunt.trial import ResultData, TrialSpec

__all__ = ["KEY_BYTES", "Report", "check_report", "encode_report"]

KEY_BYTES = 16
_HASH_BYTES = 16
_HEAD = struct.Struct("<BxHI")  # of a record: tag, aux, length of its payload
_STEP_HEAD = struct.Struct("<qd")  # of the payload of a step: its number, and the simulation time in s
_FIRST_ASIDE, _NOTES = 128, int(Tag.NOTES)
_PROLOGUE, _STEP = int(Tag.PROLOGUE), int(Tag.STEP)
_FAULTS = (Outcome.AGENT_ERROR, Outcome.SIMULATOR_ERROR, Outcome.INVALID)
_SUPERVISED = (Outcome.PROCESS_DIED, Outcome.HANG)
"""Outcomes that the supervisor alone can see."""


class Report(TypedDict):
    """What the process of a trial reports at its end.

    ``result`` is without the specification, which the supervisor knows. ``notices`` are lines for people.
    """

    result: Mapping[str, object]
    notices: list[str]
    map: NotRequired[str]
    entered: NotRequired[list[str]]
    braking: NotRequired[Mapping[str, object] | None]


def encode_report(report: Report, key: bytes, digest: str, *, dumps: Callable[[object], str] = json.dumps) -> bytes:
    """Return the bytes of a report.

    Args:
        report: what is reported.
        key: of the trial.
        digest: the trace digest; empty for an invalid trial.
        dumps: writes JSON.
    """
    text = dumps(report).encode()
    return _keyed_hash(text, key, digest) + text


def check_report(
    report: bytes, *, key: bytes, spec: TrialSpec, header: BlackBoxHeader, records: bytes, pid: int
) -> tuple[TrialResult, Report] | str:
    """Check what the process of a trial left behind.

    Args:
        report: as it lies behind the records.
        key: of the trial.
        spec: the trial that was asked for.
        header: of the black box.
        records: all committed records.
        pid: the process that was to run the trial.

    Returns:
        The result and the whole report; in words what does not agree, where something does not.
    """
    found = _walk(records)
    if isinstance(found, str):
        return found
    steps, time_s, evidence = found
    if (header.trial, header.pid) != (spec.number, pid):
        return f"it says that process {header.pid} ran trial {header.trial}"
    digest = digest_of(*evidence) if records else ""
    text = report[_HASH_BYTES:]
    if report[:_HASH_BYTES] not in (_keyed_hash(text, key, digest), _keyed_hash(text, key, "")):
        return "its report was not written by crashhunt"
    try:
        said: Report = json.loads(text)
        data = cast("ResultData", {**said["result"], "spec": spec.to_json()})
        result = TrialResult.from_json(data)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        return f"its report cannot be read ({type(error).__name__})"
    problem = _contradiction(result, spec, steps, time_s, digest)
    return problem or (replace(result, spec=spec), said)


def _contradiction(result: TrialResult, spec: TrialSpec, steps: int, time_s: float, digest: str) -> str:
    """What in a result contradicts its recording; empty where nothing does."""
    outcome = result.outcome
    if outcome in _SUPERVISED:
        return f"a process cannot report {outcome} of itself"
    if outcome in _FAULTS and result.failure is None:
        return f"it reports {outcome} and no reason"
    if outcome is Outcome.INVALID:
        return ""
    # An episode that broke off while its observers were called has no digest in its result.
    if result.digest != digest and (result.digest or outcome not in _FAULTS):
        return f"it reports the digest {result.digest or 'none'}, and its recording has {digest}"
    if not max(result.steps, 0) <= steps <= result.steps + 1:
        return f"it reports {result.steps} steps, and its recording has {steps}"
    if result.steps > spec.max_steps or (outcome is Outcome.SURVIVED and result.steps != spec.max_steps):
        return f"it reports {outcome} after {result.steps} of {spec.max_steps} steps"
    same_time = result.sim_time_s == time_s or math.isnan(time_s)
    if steps == result.steps and not same_time and outcome not in _FAULTS:
        return f"it reports a simulation time of {result.sim_time_s} s, and its recording has {time_s} s"
    return ""


def _walk(records: bytes) -> tuple[int, float, list[memoryview]] | str:
    """Return the last step, its simulation time and the parts that are evidence; in words what is wrong."""
    whole, offset, end = memoryview(records), 0, len(records)
    step, time_s, begins = -1, 0.0, 0
    evidence: list[memoryview] = []
    while offset < end:
        if offset + 8 > end:
            return "its recording is cut off"
        tag, _, length = _HEAD.unpack_from(records, offset)
        start = offset + 8
        following = start + length + (-length & 7)
        if following > end:
            return "its recording is cut off"
        if (tag == _PROLOGUE) != (offset == 0):
            return "its recording does not begin with the prologue, or does twice"
        if tag == _STEP:
            if length < _STEP_HEAD.size:
                return "its recording has a step that is cut off"
            number, time_s = _STEP_HEAD.unpack_from(records, start)
            if number != step + 1:
                return f"its recording has step {number} after step {step}"
            step = number
        elif tag >= _FIRST_ASIDE or tag == _NOTES:
            evidence.append(whole[begins:offset])
            begins = following
        elif tag == 0:
            return "its recording has an empty record"
        offset = following
    evidence.append(whole[begins:end])
    return max(step, 0), time_s, evidence


def _keyed_hash(text: bytes, key: bytes, digest: str) -> bytes:
    found = hashlib.blake2b(text, key=key, digest_size=_HASH_BYTES)
    found.update(digest.encode())
    return found.digest()
