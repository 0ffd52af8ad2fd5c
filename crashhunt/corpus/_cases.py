"""Cases of a corpus: folders with a crash and the expected result of the current code.

A case has the layout of a hunt's directory with one crash, so that all commands that read crashes can read it. A case
also contains the file ``crashhunt-case.toml``, which users edit.
"""

from __future__ import annotations

import math
import shutil
import tomllib
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from crashhunt.base import layout
from crashhunt.base.codec import JsonObject, known_part
from crashhunt.base.errors import BundleError, UsageError
from crashhunt.base.files import cannot_write, sync_folder, sync_tree, whole_file
from crashhunt.base.integrity import read_bounded
from crashhunt.base.temporary import remove_ended, temporary_beside
from crashhunt.base.text import near_path
from crashhunt.base.validation import validate
from crashhunt.crashes import (
    Bundle,
    Cause,
    authenticate_bundle,
    cause_of,
    fault_of,
    judgement_of,
    list_bundles,
    signature_of,
    snapshot_of,
    with_judgement,
    without_chance_lengths,
)
from crashhunt.recording import write_log
from crashhunt.snapshots import without_code
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from crashhunt.crashes import Group, Signature
    from crashhunt.recording import Recording
    from crashhunt.trial import TrialSpec, Value


Expectation = Literal["still", "fixed"]
_CASE_COMMENT = """\
# A crash that is kept: `crashhunt corpus run` and pytest run it again with today's code.
# expect is "still" as long as it is known to crash, and "fixed" once it must not crash any more.
"""


@dataclass(frozen=True, kw_only=True)
class _File:
    """The contents of ``crashhunt-case.toml``."""

    expect: Expectation
    note: str = ""
    crash: str = ""
    signature: dict[str, str | bool] = field(default_factory=dict)
    schema: Literal[1] = 1


@dataclass(frozen=True, slots=True)
class Case:
    """A case of a corpus, stored on disk."""

    path: Path  # the folder of the case
    expect: Expectation  # the expected status: ``still`` (reproduces) or ``fixed``
    note: str  # a note of the user
    crash: str  # a description of the crash
    signature: dict[str, str | bool]  # the parts of the crash's signature by name; later versions may add parts

    @property
    def name(self) -> str:
        """The name of the case in its corpus."""
        return self.path.name

    def bundle(self) -> Bundle:
        """Read the crash.

        Raises:
            BundleError: The crash is missing or damaged, or the case has several crashes.
        """
        found = list_bundles(self.path)
        if len(found) != 1:
            message = f"the corpus case contains {len(found)} crashes, not exactly one"
            raise BundleError(
                message, fix="restore the case from the repository, or add the crash again", where=str(self.path)
            )
        return found[0]

    def kind_of_log(self) -> Literal["whole", "compact", ""]:
        """Return whether the log of the case contains all actors; empty if there is no log, as in early cases.

        Raises:
            BundleError: The crash or its log is damaged.
        """
        bundle = self.bundle()
        if not (bundle.path / layout.LOG).is_file():
            return ""
        return "whole" if bundle.recording().compact is None else "compact"

    def expecting(self, expect: Expectation | None, note: str | None) -> Case:
        """Store another expectation or note in the case, and return the changed case; None keeps the present value.

        Raises:
            HuntDirectoryError: The file cannot be written.
        """
        changed = replace(
            self, expect=self.expect if expect is None else expect, note=self.note if note is None else note
        )
        if changed != self:
            changed.write(self.path)
        return changed

    def write(self, into: Path) -> None:
        """Write ``crashhunt-case.toml`` atomically.

        Raises:
            HuntDirectoryError: The file cannot be written.
        """
        import tomli_w

        said = asdict(_File(expect=self.expect, note=self.note, crash=self.crash, signature=self.signature))
        said = {"schema": said.pop("schema"), **said}
        with whole_file(into / layout.CASE) as temporary:
            temporary.write_text(_CASE_COMMENT + tomli_w.dumps(said), encoding="utf-8")

    def to_json(self) -> JsonObject:
        """Return the case in the form that ``corpus list --json`` prints."""
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
    """Read the case in a folder.

    Raises:
        BundleError: The folder has no valid case; the message names the key, its value and the fix.
    """
    file = path / layout.CASE
    try:
        data = tomllib.loads(read_bounded(file).decode())
    except (ValueError, RecursionError) as error:
        raise BundleError(f"not valid TOML: {error}", fix="correct the file", where=str(file)) from None
    except OSError as error:
        raise BundleError(f"cannot be read: {error.strerror}", fix="check its permissions", where=str(file)) from None
    said = validate(_File, known_part(_File, data)[0], where=str(file), error=BundleError)
    return Case(path=path, expect=said.expect, note=said.note, crash=said.crash, signature=said.signature)


def find_cases(places: list[Path]) -> list[Path]:
    """Return the folders of all cases in the given folders, sorted by name; a given folder may itself be a case.

    Raises:
        BundleError: A folder contains no case.
    """
    found: dict[Path, None] = {}
    for place in places:
        files = place.rglob(layout.CASE)
        inside = sorted(file.parent for file in files if not _is_hidden(file.parent.relative_to(place)))
        if not inside:
            what = "is not a folder" if place.exists() else "does not exist"
            what = "has no case of a corpus" if place.is_dir() else what
            fix = "" if place.exists() else near_path(place)
            raise BundleError(
                f"{str(place)!r} {what}", fix=f"{fix}add a case with crashhunt corpus add BUNDLE --to FOLDER"
            )
        found |= dict.fromkeys(inside)
    return list(found)


def _is_hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


# Adding a crash to a corpus: small, without code, and with the scenario that it needs.

_MAX_BYTES_WITH_LOG = 100 * 1024  # a larger case has a compact log, because a repository keeps every version forever
_MIN_RADIUS_M, _MAX_RADIUS_M = 20.0, 2000.0  # around the agents, of the actors of a compact log
_MAX_BYTES_OF_OBSERVATIONS = 50 * 1024  # raw; images have more, and only their comparison needs them


@dataclass(frozen=True, slots=True)
class Added:
    """The result of adding a crash to a corpus."""

    case: Case  # the case in the corpus
    new: bool  # whether the case is new in the corpus
    changed: bool = False  # whether the expectation or the note of a present case changed
    judged: bool = False  # whether a present case has got the causes of the crash


def add_case(bundle: Bundle, corpus: Path, *, expect: Expectation | None = None, note: str | None = None) -> Added:
    """Add a crash to a corpus. If the corpus has the crash already, update only the expectation and the note.

    The function runs no code. After the call, the case counts as made by this user, so check before that the bundle is
    trusted. Two processes may add to the same corpus at the same time. The folder of the corpus is created if it does
    not exist. The expected status is ``still`` by default.

    Raises:
        BundleError: The crash is damaged.
        HuntDirectoryError: The folder cannot be written.
    """
    if bundle.result.outcome in (Outcome.SURVIVED, Outcome.FINISHED):
        raise UsageError(f"{bundle.id!r} is a near miss, not a crash", fix="give a crash")
    name = f"{_id(bundle)}-{bundle.result.digest[:6]}"
    final = corpus / name
    try:
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
                    if not (final / layout.CASE).is_file():  # otherwise another process has added the same crash
                        raise
        before = read_case(final)
        case = before.expecting(expect, note)
        return Added(case, new=False, changed=case != before, judged=_add_judgement(case, bundle))
    except OSError as error:
        raise cannot_write(corpus, error) from error


def _signature(bundle: Bundle) -> dict[str, str | bool]:
    if _is_of_case(bundle):  # which may have no log
        return read_case(bundle.hunt).signature
    parts: dict[str, object] = dict(signature_of(bundle).to_json())
    return {name: value for name, value in parts.items() if isinstance(value, str | bool)}


def _add_judgement(case: Case, bundle: Bundle) -> bool:
    """Store the causes of a crash in its case, if the case has none; return whether it has got them."""
    kept, judgement = case.bundle(), judgement_of(bundle)
    if judgement is None or judgement_of(kept) is not None:
        return False
    with_judgement(kept, judgement).write(into=kept.path)
    return True


def _is_of_case(bundle: Bundle) -> bool:
    return (bundle.hunt / layout.CASE).is_file()


def _id(bundle: Bundle) -> str:
    return bundle.id.removesuffix(layout.SMALL)  # a case has only one bundle


def _build(bundle: Bundle, case: Case, folder: Path) -> None:
    if _is_of_case(bundle):  # a case has all that a case needs
        _copy(bundle, case, folder)
        return
    recording = bundle.recording()
    crash = folder / layout.CRASHES / _id(bundle)
    crash.mkdir(parents=True)
    shutil.copyfile(bundle.hunt / layout.HUNT, folder / layout.HUNT)
    snapshot = without_code(snapshot_of(bundle), folder / layout.SNAPSHOTS)
    case.write(folder)
    result = replace(bundle.result, spec=_with_relative_paths(bundle.result.spec, folder))
    kept = replace(bundle, path=crash, result=result, snapshot=snapshot.digest, files={}, authentication_code="")
    kept = replace(kept, authentication_code=authenticate_bundle(kept))
    kept.write(into=crash)
    write_log(crash / layout.LOG, recording, views=False)
    if sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) > _MAX_BYTES_WITH_LOG:
        write_log(crash / layout.LOG, _compact(bundle, recording), views=False)
    kept.write(into=crash)  # with the digest of the log
    sync_tree(folder)


def _with_relative_paths(spec: TrialSpec, case: Path) -> TrialSpec:
    """Return a specification with relative paths for files below the current folder, such as weights.

    Paths from a scenario file are absolute, and another machine has the repository elsewhere. A case outside of the
    current folder, such as the case of `crashhunt bisect`, keeps absolute paths.
    """
    here = Path.cwd()
    if not case.resolve().is_relative_to(here):
        return spec

    def relative(value: Value) -> Value:
        inside = isinstance(value, str) and Path(value).is_absolute() and Path(value).is_relative_to(here)
        return str(Path(str(value)).relative_to(here)) if inside else value

    arguments = {
        agent: {name: relative(value) for name, value in given.items()} for agent, given in spec.arguments.items()
    }
    return replace(spec, arguments=arguments)


def _copy(bundle: Bundle, case: Case, folder: Path) -> None:
    """Copy a case, with the given expectation and note."""
    for place in (layout.CRASHES, layout.SNAPSHOTS):
        shutil.copytree(bundle.hunt / place, folder / place)
    shutil.copyfile(bundle.hunt / layout.HUNT, folder / layout.HUNT)
    case.write(folder)
    crash = folder / layout.CRASHES / bundle.path.name
    kept = replace(bundle, path=crash)
    replace(kept, authentication_code=authenticate_bundle(kept)).write(into=crash)
    sync_tree(folder)


def _compact(bundle: Bundle, recording: Recording) -> Recording:
    """Return the recording with the vehicles of the crash, and in each step also the actors near an agent.

    The distance is doubled until crash type and fault are the same as with all actors. Criticality and the closest
    approach depend on actors that are farther away, so they are not reported from a compact log.
    """
    if recording.compact is not None:
        return recording
    hit, truth = bundle.result.collision, _facts(bundle, recording)
    always = () if hit is None else (hit.collider, hit.victim)
    size = sum(recording.observations(agent).nbytes for agent in recording.agents)
    radius_m = _MIN_RADIUS_M
    while True:
        small = recording.compacted(always, radius_m, observations=size <= _MAX_BYTES_OF_OBSERVATIONS)
        if radius_m >= _MAX_RADIUS_M or _facts(bundle, small) == truth:
            return small
        radius_m = radius_m * 2 if radius_m * 2 < _MAX_RADIUS_M else math.inf


def _facts(bundle: Bundle, recording: Recording) -> tuple[object, ...]:
    """Return the facts that commands derive from a recording, so that two recordings can be compared."""
    return signature_of(bundle, recording), fault_of(bundle, recording).to_json()


# The crash types that a corpus already has.


@dataclass(frozen=True, slots=True)
class KnownType:
    """A crash type of which the corpus has cases that are expected to reproduce, and the causes of its crashes."""

    case: Case  # the first of these cases
    by: Literal["cause", "type"]  # ``cause`` if the causes of crashes and cases were compared, else ``type``
    # causes of crashes that none of the cases has; with such a cause, the type has new crashes
    new_causes: tuple[Cause, ...] = ()


def compare_types(
    groups: Sequence[Group], cases: Iterable[Case], causes: Sequence[Iterable[Cause]] | None = None
) -> dict[Signature, KnownType]:
    """Return the crash types that a corpus contains; no code of the crashes runs.

    Crashes of one type may have different causes. If a cause is known on both sides, it decides: a crash of a known
    type with another cause than all cases is new. By default, the causes are those that are stored in the bundles of
    the crashes.
    """
    cases = list(cases)
    today = cache(signature_today)
    found = {}
    for number, group in enumerate(groups):
        same = cases_of_type(group.signature, cases)
        same = same or [case for case in cases if case.expect == "still" and today(case.path) == group.signature]
        if not same:
            continue
        given = map(_stored_cause, group.bundles) if causes is None else causes[number]
        own, its = ({cause for cause in some if cause.kind != "unknown"} for some in (given, map(_cause, same)))
        if not own or not its:
            found[group.signature] = KnownType(same[0], "type")
            continue
        lengths = without_chance_lengths(own | its)
        new = {lengths[cause] for cause in own} - {lengths[cause] for cause in its}
        found[group.signature] = KnownType(same[0], "cause", tuple(sorted(new)))
    return found


def cases_of_type(signature: Signature, cases: Iterable[Case]) -> list[Case]:
    """Return the cases of a crash type that expect ``still``; crashes that are ``fixed`` must not occur again."""
    parts = signature.to_json()
    return [
        case
        for case in cases
        if case.expect == "still"
        and case.signature
        and all(parts.get(name, said) == said for name, said in case.signature.items())
    ]


def signature_today(case: Path) -> Signature | None:
    """Return the signature of a case by the present rules; None if it has no readable log.

    Earlier versions may have stored another one, such as a crossing for a rear end in a bend.
    """
    try:
        return signature_of(read_case(case).bundle())
    except BundleError:
        return None


def _cause(case: Case) -> Cause:
    try:
        return _stored_cause(case.bundle())
    except BundleError:
        return Cause("unknown")


def _stored_cause(bundle: Bundle) -> Cause:
    try:
        return cause_of(bundle, judgement_of(bundle))
    except BundleError:  # the recording of an omission is damaged
        return Cause("unknown")
