"""Putting a crash into a corpus: small, without code, and with the scenario that it needs."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import UsageError
from crashhunt.base.files import cannot_write, sync_folder, sync_tree
from crashhunt.base.temporary import remove_ended, temporary_beside
from crashhunt.corpus._case import Case, read_case
from crashhunt.crashes import authenticate_bundle
from crashhunt.recording import write_log
from crashhunt.snapshots import Snapshot, without_code
from crashhunt.triage import signature_of
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.corpus._case import Expectation
    from crashhunt.crashes import Bundle

__all__ = ["Added", "add_case"]

_MOST = 100 * 1024  # bytes of a case with its log; beyond, it is left out: a repository keeps every version for ever


@dataclass(frozen=True, slots=True)
class Added:
    """What came of adding a crash.

    Args:
        case: in the corpus.
        new: whether it was not there yet.
    """

    case: Case
    new: bool


def add_case(bundle: Bundle, corpus: Path, *, expect: Expectation | None = None, note: str | None = None) -> Added:
    """Put a crash into a corpus; what is there already only gets the expectation and the note that are given.

    No code is run. The case is this user's from then on, whoever made the crash, so see first that it is trusted. Two
    may add to the same corpus at once.

    Args:
        bundle: the crash.
        corpus: the folder of the corpus; made where it is not there.
        expect: what is expected of it from now on; ``still`` by default.
        note: of whoever keeps it.

    Raises:
        BundleError: the crash is damaged.
        HuntDirectoryError: the folder cannot be written.
    """
    if bundle.result.outcome in (Outcome.SURVIVED, Outcome.FINISHED):
        raise UsageError(f"{bundle.id!r} is a near miss, and nothing crashes in it", fix="give a crash")
    name = f"{_id(bundle)}-{bundle.result.digest[:6]}"
    final = corpus / name
    try:
        corpus.mkdir(parents=True, exist_ok=True)
        remove_ended(corpus)
        if not final.exists():
            case = Case(final, expect or "still", note or "", bundle.result.summary, dict(_signature(bundle)))
            with temporary_beside(final) as building:
                _build(bundle, case, building)
                try:
                    building.rename(final)
                    sync_folder(corpus)
                    return Added(case, new=True)
                except OSError:
                    if not (final / layout.CASE).is_file():  # else somebody else has added the same meanwhile
                        raise
        return Added(read_case(final).expecting(expect, note), new=False)
    except OSError as error:
        raise cannot_write(corpus, error) from error


def _signature(bundle: Bundle) -> dict[str, str | bool]:
    parts: dict[str, object] = dict(signature_of(bundle).to_json())
    return {name: value for name, value in parts.items() if isinstance(value, str | bool)}


def _id(bundle: Bundle) -> str:
    return bundle.id.removesuffix(layout.SMALL)  # it is the only one there


def _build(bundle: Bundle, case: Case, folder: Path) -> None:
    recording = bundle.recording()
    crash = folder / layout.CRASHES / _id(bundle)
    crash.mkdir(parents=True)
    shutil.copyfile(bundle.hunt / layout.HUNT, folder / layout.HUNT)
    snapshot = without_code(Snapshot(bundle.hunt / layout.SNAPSHOTS / bundle.snapshot), folder / layout.SNAPSHOTS)
    case.write(folder)
    kept = replace(bundle, path=crash, snapshot=snapshot.digest, files={}, authentication_code="")
    kept = replace(kept, authentication_code=authenticate_bundle(kept))
    kept.write(into=crash)
    write_log(crash / layout.LOG, recording, views=False)
    if sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) > _MOST:
        (crash / layout.LOG).unlink()
    kept.write(into=crash)  # with the digest of the log
    sync_tree(folder)
