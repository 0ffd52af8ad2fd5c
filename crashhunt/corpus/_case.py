"""A case: a folder with a crash, and what is expected of today's code.

It is laid out as a hunt's directory with one crash in it, so that whatever looks at crashes looks at it too; beside
these lies ``crashhunt-case.toml``, which people edit.
"""

from __future__ import annotations

import tomllib
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Literal, TypedDict

from crashhunt.base import layout
from crashhunt.base.errors import BundleError
from crashhunt.base.files import whole_file
from crashhunt.base.names import near_path
from crashhunt.base.tolerance import known_part
from crashhunt.base.validation import validate
from crashhunt.crashes import Bundle, list_bundles

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["Case", "CaseData", "Expectation", "find_cases", "read_case"]

Expectation = Literal["still", "fixed"]
_ON_TOP = """\
# A crash that is kept: `crashhunt corpus run` and pytest run it again with today's code.
# expect is "still" as long as it is known to crash, and "fixed" once it must not crash any more.
"""


class CaseData(TypedDict):
    """A case as ``corpus list --json`` and ``corpus add --json`` print it."""

    path: str
    expected: Expectation
    note: str
    crash: str
    bytes: int
    log: bool


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

    def to_json(self) -> CaseData:
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
    return Case(path, said.expect, said.note, said.crash, said.signature)


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
