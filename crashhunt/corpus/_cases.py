"""A case: a folder with a crash, and what is expected of today's code.

It is laid out as a hunt's directory with one crash in it, so that whatever looks at crashes looks at it too; beside
these lies ``crashhunt-case.toml``, which people edit.
"""

from __future__ import annotations

import shutil
import tomllib
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Literal

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, UsageError
from crashhunt.base.files import cannot_write, sync_folder, sync_tree, whole_file
from crashhunt.base.temporary import remove_ended, temporary_beside
from crashhunt.base.text import near_path
from crashhunt.base.tolerance import known_part
from crashhunt.base.validation import validate
from crashhunt.crashes import Bundle, authenticate_bundle, list_bundles, signature_of
from crashhunt.recording import write_log
from crashhunt.snapshots import Snapshot, without_code
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from crashhunt.base.codec import JsonObject
    from crashhunt.crashes import Signature


__all__ = ["Added", "Case", "Expectation", "add_case", "find_cases", "known_kinds", "read_case"]


Expectation = Literal["still", "fixed"]
_ON_TOP = """\
# A crash that is kept: `crashhunt corpus run` and pytest run it again with today's code.
# expect is "still" as long as it is known to crash, and "fixed" once it must not crash any more.
"""


@dataclass(frozen=True, kw_only=True)
class _File:
    """``crashhunt-case.toml``."""

    expect: Expectation
    note: str = ""
    crash: str = ""
    signature: dict[str, str | bool] = field(default_factory=dict)
    schema: Literal[1] = 1


@dataclass(frozen=True, slots=True)
class Case:
    """A case on disk.

    Args:
        path: of its folder.
        expect: what is expected: that it crashes ``still``, or that it is ``fixed``.
        note: of whoever keeps it.
        crash: what happened, in words.
        signature: of the crash, by the names of its parts; a later version may know more of them.
    """

    path: Path
    expect: Expectation
    note: str
    crash: str
    signature: dict[str, str | bool]

    @property
    def name(self) -> str:
        """What it is called in its corpus."""
        return self.path.name

    def bundle(self) -> Bundle:
        """Read the crash.

        Raises:
            BundleError: it is missing or damaged, or there are several.
        """
        found = list_bundles(self.path)
        if len(found) != 1:
            message = f"a case has one crash, and this one {len(found) or 'none'}"
            raise BundleError(
                message, fix="get it back from the repository, or add the crash anew", where=str(self.path)
            )
        return found[0]

    def expecting(self, expect: Expectation | None, note: str | None) -> Case:
        """Return it with another expectation or note, which is written down; None stays as it is.

        Raises:
            HuntDirectoryError: it cannot be written.
        """
        changed = replace(
            self, expect=self.expect if expect is None else expect, note=self.note if note is None else note
        )
        if changed != self:
            changed.write(self.path)
        return changed

    def write(self, into: Path) -> None:
        """Write ``crashhunt-case.toml``, all of it or nothing.

        Raises:
            HuntDirectoryError: it cannot be written.
        """
        import tomli_w

        said = asdict(_File(expect=self.expect, note=self.note, crash=self.crash, signature=self.signature))
        said = {"schema": said.pop("schema"), **said}
        with whole_file(into / layout.CASE) as temporary:
            temporary.write_text(_ON_TOP + tomli_w.dumps(said), encoding="utf-8")

    def to_json(self) -> JsonObject:
        """Return the shape that ``corpus list --json`` prints."""
        files = [file for file in self.path.rglob("*") if file.is_file()]
        return {
            "path": str(self.path),
            "expected": self.expect,
            "note": self.note,
            "crash": self.crash,
            "bytes": sum(file.stat().st_size for file in files),
            "log": any(file.name == layout.LOG for file in files),
        }


def read_case(path: Path) -> Case:
    """Read the case of a folder.

    Raises:
        BundleError: it has none, or one that is not valid, with the key, its value and the fix.
    """
    file = path / layout.CASE
    try:
        data = tomllib.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise BundleError(f"not valid TOML: {error}", fix="mend the file", where=str(file)) from None
    except OSError as error:
        raise BundleError(f"cannot be read: {error.strerror}", fix="see to the file", where=str(file)) from None
    said = validate(_File, known_part(_File, data)[0], where=str(file), error=BundleError)
    return Case(path=path, expect=said.expect, note=said.note, crash=said.crash, signature=said.signature)


def find_cases(places: list[Path]) -> list[Path]:
    """Return the folders of all cases in some folders, or that are these themselves, in order of their names.

    Raises:
        BundleError: there is none in one of them.
    """
    found: dict[Path, None] = {}
    for place in places:
        files = place.rglob(layout.CASE)
        inside = sorted(file.parent for file in files if not _is_hidden(file.parent.relative_to(place)))
        if not inside:
            what = "has no case of a corpus" if place.is_dir() else "does not exist"
            fix = "" if place.is_dir() else near_path(place)
            raise BundleError(
                f"{str(place)!r} {what}", fix=f"{fix}add one with crashhunt corpus add BUNDLE --to FOLDER"
            )
        found |= dict.fromkeys(inside)
    return list(found)


def _is_hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


# Putting a crash into a corpus: small, without code, and with the scenario that it needs.

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
            case = Case(
                path=final,
                expect=expect or "still",
                note=note or "",
                crash=bundle.result.summary,
                signature=dict(_signature(bundle)),
            )
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


# Which kinds of crashes a corpus has already.


def known_kinds(signatures: Iterable[Signature], cases: Iterable[Case]) -> dict[Signature, Case]:
    """Return the cases that are of the same kinds as some crashes.

    A case that is ``fixed`` makes nothing known: it must not crash any more.

    Args:
        signatures: of the crashes.
        cases: of the corpus.
    """
    still = [case for case in cases if case.expect == "still" and case.signature]
    found = {}
    for signature in signatures:
        parts = signature.to_json()
        same = (case for case in still if all(parts.get(name, said) == said for name, said in case.signature.items()))
        case = next(same, None)
        if case is not None:
            found[signature] = case
    return found
