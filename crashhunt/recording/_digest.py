"""The digest of a trial: what belongs to it, and how it is computed."""

from __future__ import annotations

import hashlib

__all__ = ["FIRST_ASIDE", "digest_of", "is_evidence"]


FIRST_ASIDE = 128
"""Tags from here on are of records that are no evidence: whoever does not know a type knows what the digest is of."""
_NOTES = 11  # the only type of the first eleven that is no evidence, from before there was that rule


def is_evidence(tag: int) -> bool:
    """Whether records with this tag belong to the digest of the trial."""
    return tag < FIRST_ASIDE and tag != _NOTES


def digest_of(*records: bytes | memoryview) -> str:
    """Return the trace digest of encoded records: BLAKE2b of 16 bytes, in hexadecimal."""
    digest = hashlib.blake2b(digest_size=16)
    for part in records:
        digest.update(part)
    return digest.hexdigest()
