"""What the process of a trial leaves behind when it ends, and whether it may be believed.

That process runs code of the user, which may have bugs: it may write into files and memory that it does not own, or
fork and continue twice. So what it leaves is evidence: records in the black box, behind them one report with a
checksum, and an exit code. The supervisor accepts the report where all of them agree. An agent that forges its own
report on purpose harms only its own hunt, and is no concern here.
"""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from typing import TYPE_CHECKING, cast

from crashhunt.base.errors import CrashhuntError, InternalError
from crashhunt.executors._protocol import CHECKSUM_BYTES, Report, checksum_of
from crashhunt.recording import (
    BlackBoxHeader,
    Tag,
    digest_of,
    is_evidence,
)
from crashhunt.trial import Outcome, TrialResult

if TYPE_CHECKING:
    from crashhunt.base.codec import JsonObject
    from crashhunt.base.json_types import ErrorData
    from crashhunt.trial import TrialSpec


_RECORD_HEAD = struct.Struct("<BxHI")  # of a record: tag, aux, length of its payload
_REPORTED_FAULTS = (Outcome.AGENT_ERROR, Outcome.SIMULATOR_ERROR, Outcome.INVALID)


def check_report(
    report: bytes, *, spec: TrialSpec, header: BlackBoxHeader, records: bytes, pid: int
) -> tuple[TrialResult, Report] | str:
    """Check the report that the process of a trial wrote, and the trial's recording.

    The report follows the committed records of the trial's black box. ``pid`` is the process that should have run the
    trial.

    Returns:
        The result and the whole report, or a description of the first disagreement.

    Raises:
        InternalError: crashhunt itself failed in the trial's process.
    """
    evidence = _evidence_of(records)
    if isinstance(evidence, str):
        return evidence
    if (header.trial, header.pid) != (spec.number, pid):
        return f"it says that process {header.pid} ran trial {header.trial}"
    digest = digest_of(evidence, of_changes=spec.digest_of_changes) if records else ""
    text = report[CHECKSUM_BYTES:]
    if report[:CHECKSUM_BYTES] != checksum_of(text):
        return "its report was overwritten"
    try:
        loaded: JsonObject = json.loads(text)
        if "fault" in loaded:
            raise _fault_of(cast("ErrorData", loaded["fault"]))
        said = cast("Report", loaded)
        data = cast("JsonObject", {**said["result"], "spec": spec.to_json()})
        result = TrialResult.from_json(data)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        return f"its report cannot be read ({type(error).__name__})"
    # An episode that broke off while its observers were called has no digest in its result.
    may_lack_digest = result.outcome in _REPORTED_FAULTS and not result.digest
    if result.outcome is not Outcome.INVALID and result.digest != digest and not may_lack_digest:
        return f"it reports the digest {result.digest or 'none'}, and its recording has {digest}"
    return replace(result, spec=spec), said


def _fault_of(data: ErrorData) -> CrashhuntError:
    try:
        return CrashhuntError.from_json(data)
    except (KeyError, TypeError, AttributeError):
        return InternalError("crashhunt itself failed in a trial, and its report cannot be read")


def _evidence_of(records: bytes) -> list[memoryview] | str:
    """Return the parts of the records that the digest covers, or the first error as text."""
    whole, offset, end, begins = memoryview(records), 0, len(records), 0
    evidence: list[memoryview] = []
    while offset < end:
        if offset + 8 > end:
            return "its recording is cut off"
        tag, _, length = _RECORD_HEAD.unpack_from(records, offset)
        following = offset + 8 + length + (-length & 7)
        if following > end:
            return "its recording is cut off"
        if (tag == Tag.PROLOGUE) != (offset == 0):
            return "its recording does not begin with the prologue, or does twice"
        if not is_evidence(tag):
            evidence.append(whole[begins:offset])
            begins = following
        elif tag == 0:
            return "its recording has an empty record"
        offset = following
    evidence.append(whole[begins:end])
    return evidence
