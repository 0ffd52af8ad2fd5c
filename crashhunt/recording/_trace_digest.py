"""The trace digest of a trial: one hash of its records, by which two runs of the trial are compared."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.recording._blackbox import RECORD_HEAD
from crashhunt.recording.records._agent_records import OBSERVATION

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from crashhunt.native import Core


def digest_of(parts: Iterable[bytes | memoryview], *, of_changes: bool = False, core: Core | None = None) -> str:
    """Return the trace digest of encoded records: BLAKE2b of 16 bytes, in hexadecimal.

    Args:
        parts: the records; each part contains whole records.
        of_changes: whether only the changes of observations are hashed, as for trials with
            `TrialSpec.digest_of_changes`.
        core: the compiled core, which finds the changes faster.
    """
    digest = hashlib.blake2b(digest_size=16)
    for part in _with_changes_only(parts, changes_of if core is None else core.changes_of) if of_changes else parts:
        digest.update(part)
    return digest.hexdigest()


def _with_changes_only(
    parts: Iterable[bytes | memoryview], changes_of: Callable[[memoryview, memoryview], bytes]
) -> Iterator[bytes | memoryview]:
    """Yield encoded records, with the changes of an observation since the last observation of the same agent.

    Nine tenths of an observation of lanes, routes and signals are as in the step before, and to hash them took half as
    long as a step of SUMO. From the first observations and the changes follows every observation.
    """
    last: dict[int, memoryview] = {}
    for records in parts:
        part, begin, offset = memoryview(records), 0, 0
        while offset < len(part):
            tag, agent, length = RECORD_HEAD.unpack_from(part, offset)
            start = offset + RECORD_HEAD.size
            offset = start + length + (-length % 8)
            if tag == OBSERVATION.tag:
                earlier, now = last.get(agent), part[start:offset]
                last[agent] = now
                if earlier is not None and len(earlier) == len(now):
                    yield part[begin:start]
                    yield changes_of(earlier, now)
                    begin = offset
        yield part[begin:]


def changes_of(earlier: memoryview, now: memoryview) -> bytes:
    """Return where two arrays of 64-bit words differ, as one bit per word, and then the changed words.

    Both arrays have as many bytes.
    """
    words = np.frombuffer(now, "<u8")
    is_changed = words != np.frombuffer(earlier, "<u8")
    changed: bytes = words[is_changed].tobytes()
    return np.packbits(is_changed).tobytes() + changed
