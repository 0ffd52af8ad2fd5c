"""The command line that starts SUMO, and the files staged for SUMO in a private folder of the worker."""

from __future__ import annotations

import gzip
import os
import re
import string
import zlib
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Literal
from xml.parsers import expat

from crashhunt.base.errors import CrashhuntError, InvalidEpisodeError, ScenarioError
from crashhunt.sumo._options import DEFAULT_OPTIONS, FIXED_OPTIONS, INPUTS, SumoSetup, canonical, is_output, is_shown

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from crashhunt.scenario import Scenario
    from crashhunt.trial import Value


# What SUMO's XML files say about other files: those that they read, and those that they write.

READ = {
    ("include", "href"),
    ("variableSpeedSign", "file"),
    ("rerouter", "file"),
    ("calibrator", "file"),
    ("edgeData", "edgesFile"),
    ("laneData", "edgesFile"),
}
"""The attributes that name what SUMO reads."""

WRITTEN = {"file", "output", "dest"}
"""The attributes that name what SUMO writes, wherever they are not `READ`."""
_DISCARDED_OUTPUTS = {"", "NUL", "nul", "/dev/null", "stdout", "STDOUT", "-", "stderr", "STDERR"}
"""What SUMO does not take for the name of a file."""

# What is not in a file's bytes, no attribute of it can be; most files have none of these. Networks are large, and a
# word is found ten times as fast as a choice of words: so each by itself, and the pattern only where the word is.
_PATTERNS = dict.fromkeys((b"File", b"output", b"dest", b"href"), rb"\s*=")
_PATTERNS |= {b"file": rb"(?:\s*=|[\"'])", b"<!DOCTYPE": b""}
_WORTH_PARSING = {word: re.compile(word + rest) for word, rest in _PATTERNS.items()}
_MAX_BYTES = 10**9  # of a compressed file, unpacked
_TAG = re.compile(rb"<[^\s/>]+")
_ATTRIBUTE = re.compile(rb"\s+([^\s=]+)\s*=\s*(\"[^\"]*\"|'[^']*')")


@dataclass(frozen=True, slots=True)
class FileReference:
    """An attribute of an XML file that names another file."""

    tag: str  # XML tag of the element that names the file
    attribute: str  # name of the XML attribute that contains the file name
    value: str  # the file name, as written in the XML file
    kind: Literal["read", "written"]  # whether SUMO reads or writes the file
    offset: int  # offset of the element in the XML file, in bytes

    def __str__(self) -> str:
        """Return the reference as it is written in the XML file."""
        return f'<{self.tag} {self.attribute}="{self.value}">'


def read_xml(path: Path) -> bytes:
    """Return the contents of a file as SUMO reads it: decompressed if it is compressed, regardless of its name.

    Raises:
        ScenarioError: the file cannot be read.
    """
    try:
        content = path.read_bytes()
        if content.startswith(b"\x1f\x8b"):
            with gzip.open(path) as packed:
                content = packed.read(_MAX_BYTES + 1)
        if len(content) > _MAX_BYTES:
            raise EOFError("the file is larger than 1 GB")
    except (OSError, EOFError, zlib.error) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ScenarioError(f"cannot be read: {reason}", fix="correct the file", where=str(path)) from None
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = re.sub(r"(<\?xml[^>]*?)\s+encoding\s*=\s*(\"[^\"]*\"|'[^']*')", r"\1", content.decode("utf-16"), count=1)
        return text.encode()
    return content


def references(content: bytes, where: str) -> list[FileReference]:
    """Return the references to other files in an XML file.

    Raises:
        ScenarioError: the file is not valid XML.
    """
    if not any(word in content and pattern.search(content) for word, pattern in _WORTH_PARSING.items()):
        return []
    found: list[FileReference] = []
    parser = expat.ParserCreate()

    def add(tag: str, attribute: str, value: str, kind: Literal["read", "written"]) -> None:
        if value if kind == "read" else value not in _DISCARDED_OUTPUTS:
            offset = parser.CurrentByteIndex
            found.append(FileReference(tag=tag, attribute=attribute, value=value, kind=kind, offset=offset))

    def start(tag: str, attributes: dict[str, str]) -> None:
        for name, value in attributes.items():
            if (tag, name) in READ:
                add(tag, name, value, "read")
            elif name in WRITTEN:
                add(tag, name, value, "written")
        if tag == "param" and _is_written(attributes.get("key", "")):
            add(tag, "value", attributes.get("value", ""), "written")

    parser.StartElementHandler = start
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, ValueError) as error:
        raise ScenarioError(f"not valid XML: {error}", fix="correct the file", where=where) from None
    return found


def _is_written(key: str) -> bool:
    """Return whether a parameter of a vehicle, a vehicle type or a traffic light names a file that SUMO writes."""
    return key == "file" or (key.endswith(".file") and key != "device.fcd-replay.file")


def rewritten(content: bytes, found: list[FileReference], name: Callable[[FileReference], str]) -> bytes:
    """Return an XML file with other file names in its attributes; the rest stays unchanged.

    The references are those that `references` has found. A name that is equal changes nothing.
    """
    from xml.sax.saxutils import quoteattr  # which imports urllib and ssl

    parts, end = [], 0
    for reference in found:
        value = name(reference)
        place = _value_span(content, reference)
        if value != reference.value and place is not None:
            parts += [content[end : place[0]], quoteattr(value).encode("ascii", "xmlcharrefreplace")]
            end = place[1]
    return b"".join([*parts, content[end:]])


def _value_span(content: bytes, reference: FileReference) -> tuple[int, int] | None:
    """Return the position of an attribute's value with its quotes; None if the value is the document type's."""
    wanted = reference.attribute.encode()
    match = _TAG.match(content, reference.offset)
    while match is not None and (match := _ATTRIBUTE.match(content, match.end())) is not None:
        if match[1] == wanted:
            return match.span(2)
    return None


def movable(path: Path) -> bytes | None:
    """Return the contents of a file in a form that stays valid if its folder moves; None if no change is needed.

    Raises:
        ScenarioError: the file cannot be read.
    """
    content = read_xml(path)

    def staged_name(reference: FileReference) -> str:
        is_absolute = reference.kind == "read" and reference.value.startswith("/")
        return os.path.relpath(reference.value, path.parent) if is_absolute else reference.value

    moved = rewritten(content, references(content, str(path)), staged_name)
    return None if moved == content else moved


def nested_files(folder: Path, names: tuple[str, ...], *, inside: bool = False) -> tuple[str, ...]:
    """Return all files that SUMO reads because of the given files, directly or indirectly, relative to the folder.

    With ``inside``, files outside of the folder are refused and not read.

    Raises:
        ScenarioError: a file does not exist.
    """
    found: dict[str, None] = {}
    waiting = list(names)
    while waiting:
        name = waiting.pop(0)
        for nested in _references_of(folder, name):
            if inside and nested.startswith(f"..{os.sep}"):
                raise ScenarioError(
                    f"names the file {nested!r} outside the scenario's folder",
                    fix="move the file into the folder, so that snapshots contain it",
                    where=str(folder / name),
                )
            if nested not in found and nested not in names:
                found[nested] = None
                waiting.append(nested)
    return tuple(found)


def written_by(folder: Path, names: tuple[str, ...]) -> list[str]:
    """Return a description of the output that SUMO would write because of some files; empty if it would write none."""
    found = [
        f"{name}: {reference}"
        for name in dict.fromkeys((*names, *nested_files(folder, names)))
        for reference in _template_of(folder / name)
        if reference.kind == "written"
    ]
    more = f" and {len(found) - 1} more" if len(found) > 1 else ""
    return [f"{found[0]}{more} (nothing is written)"] if found else []


def _references_of(folder: Path, name: str) -> list[str]:
    path = folder / name
    try:
        stat = path.stat()
    except OSError:
        return []  # the check of the scenario reports it
    return [os.path.relpath(target, folder) for target in _targets(path, stat.st_mtime_ns, stat.st_size)]


def _template_of(path: Path) -> list[FileReference]:
    content = read_xml(path)
    try:
        return references(content, str(path))
    except ScenarioError:
        if b"${" in content:  # an argument may be more than a value, so that only what it is filled into is XML
            return []
        raise


@lru_cache(maxsize=256)
def _targets(path: Path, _mtime_ns: int, _size: int) -> tuple[str, ...]:
    targets = []
    for reference in _template_of(path):
        if reference.kind == "written":
            continue
        # As SUMO does it: relative to the file that names it, and ${NAME} is no variable here.
        target = os.path.normpath(path.parent / reference.value)
        if not os.path.isfile(target):  # noqa: PTH113
            fix = (
                "name one fixed file; an argument of the scenario cannot choose the file"
                if "${" in target
                else "correct the path"
            )
            raise ScenarioError(f"{reference}: there is no file {target!r}", fix=fix, where=str(path))
        targets.append(target)
    return tuple(targets)


_NULL_DEVICE = "/dev/null"


class StagedFiles:
    """The scenario's files, in the form in which one worker reads them.

    Every file is linked into a private folder of the worker. A file that requests output from SUMO is copied without
    these requests, because two workers would write the same file. In a route or additional file, ``${NAME}`` is
    replaced in every trial.
    """

    def __init__(self, scenario: Scenario, folder: Path) -> None:
        self._scenario = scenario
        self._sumo = scenario.table(SumoSetup)
        self._folder = folder
        self._templates: dict[Path, string.Template] = {}
        self._rendered: dict[Path, str] = {}
        self._opened: dict[str, int] = {}
        texts = set(scenario.texts())
        for name in scenario.files():
            source, staged = scenario.folder / name, folder / name
            staged.parent.mkdir(parents=True, exist_ok=True)
            said = name in texts or name == self._sumo.net
            if not (said and self._stage(source, staged)) and not staged.exists():
                staged.symlink_to(source.resolve())

    def __del__(self) -> None:
        """Close the folders that had to be opened for paths with special characters."""
        for opened in self._opened.values():
            os.close(opened)

    def arguments(self, seed: int, values: Mapping[str, Value]) -> list[str]:
        """Write the files for one trial, and return SUMO's command line without the program.

        Raises:
            InvalidEpisodeError: a file uses an argument that the scenario does not have.
        """
        for path, template in self._templates.items():
            try:
                text = _substitute(template, values)
            except (KeyError, ValueError) as error:
                raise InvalidEpisodeError(
                    f"{path.name} uses the undeclared scenario argument {error}",
                    fix="declare it under [arguments]",
                    where=self._scenario.origin,
                ) from None
            if self._rendered.get(path) != text:
                try:
                    path.write_bytes(self._staged_content(text.encode(), path))
                except CrashhuntError as error:
                    raise InvalidEpisodeError(error.message, fix=error.fix, where=path.name) from None
                self._rendered[path] = text
        options = DEFAULT_OPTIONS | {canonical(name): _text(value) for name, value in self._sumo.options.items()}
        for name, setup in self._scenario.arguments.items():
            if setup.option and name in values:
                options[canonical(setup.option)] = _text(values[name])
        options = {
            name: self._paths(value.split(",")) if name in INPUTS else value
            for name, value in options.items()
            if not is_output(name) and not is_shown(name)
        }
        options |= {"seed": str(seed), "step-length": repr(self._scenario.step_length_s), **FIXED_OPTIONS}
        options["net-file"] = self._paths([self._sumo.net])
        for option, names in (("route-files", self._sumo.routes), ("additional-files", self._sumo.additional)):
            if names:
                options[option] = self._paths(names)
        # In one word each: a value that begins with a dash would be taken for the next option.
        return [f"--{name}={value}" for name, value in options.items()]

    def _stage(self, source: Path, staged: Path) -> bool:
        """Copy a file that SUMO cannot read unchanged; return False if no copy is needed."""
        content = read_xml(source)
        is_net = staged == self._folder / self._sumo.net
        if b"${" in content and not is_net and not self._sumo.literal:
            self._templates[staged] = string.Template(content.decode())
            staged.touch()  # a file that only a trial adds would show as something that the trial left behind
            return True
        own = self._staged_content(content, source)
        if own == content:
            return False
        staged.write_bytes(own)
        return True

    def _staged_content(self, content: bytes, path: Path) -> bytes:
        """Return the contents of a file, changed so that it reads only staged files and writes none."""

        def name(reference: FileReference) -> str:
            if reference.kind == "written":
                return _NULL_DEVICE
            if not reference.value.startswith("/"):
                return reference.value
            return str(self._folder / os.path.relpath(reference.value, self._scenario.folder))

        return rewritten(content, references(content, str(path)), name)

    def _paths(self, names: list[str] | tuple[str, ...]) -> str:
        return ",".join(self._path(self._folder / name.strip()) for name in names)

    def _path(self, path: Path) -> str:
        """Return the path of a staged file without characters that SUMO interprets in options, such as ``,``."""
        if not {",", "$"}.intersection(str(path)):
            return str(path)
        parent = str(path.parent)
        if parent not in self._opened:
            self._opened[parent] = os.open(parent, os.O_RDONLY | os.O_DIRECTORY)
        return f"/proc/self/fd/{self._opened[parent]}/{path.name}"


def filled_in(content: bytes, values: Mapping[str, Value]) -> bytes:
    """Return a route or additional file with the values of a trial in place of ``${NAME}``.

    Raises:
        KeyError: the file uses an argument that has no value.
        ValueError: the file is not text, or contains an invalid dollar sign.
    """
    return _substitute(string.Template(content.decode()), values).encode() if b"${" in content else content


def _substitute(template: string.Template, values: Mapping[str, Value]) -> str:
    return template.substitute({name: _text(value) for name, value in values.items()})


def _text(value: Value) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return str(value)
