"""The command line that SUMO is started with, and the files staged for it in a folder of the worker's own."""

from __future__ import annotations

import os
import string
from typing import TYPE_CHECKING

from crashhunt.base.errors import CrashhuntError, InvalidEpisodeError
from crashhunt.scenario.backends.sumo._options import ALWAYS, INPUTS, USUALLY, canonical, is_output, is_shown
from crashhunt.scenario.backends.sumo._table import SumoSetup
from crashhunt.scenario.backends.sumo._xml import read_xml, references, rewritten

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from crashhunt.scenario._scenario import Scenario
    from crashhunt.scenario.backends.sumo._xml import Reference
    from crashhunt.trial import Value

__all__ = ["StagedFiles", "filled_in"]

_NOWHERE = "/dev/null"


class StagedFiles:
    """The scenario's files, as one worker reads them.

    Every file is linked into a folder of the worker's own. One that says what SUMO is to write is copied there, and
    writes nothing: nobody would find the files of a thousand trials, and two workers would write the same one. A route
    or additional file that says ``${NAME}`` is filled in per trial.

    Args:
        scenario: whose files.
        folder: to stage them in; must exist.
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
        """Close the folders that had to be opened to be named."""
        for opened in self._opened.values():
            os.close(opened)

    def arguments(self, seed: int, values: Mapping[str, Value]) -> list[str]:
        """Render the files for one trial and return SUMO's command line without the program.

        Raises:
            InvalidEpisodeError: a file asks for an argument that the scenario does not have.
        """
        for path, template in self._templates.items():
            try:
                text = _substitute(template, values)
            except (KeyError, ValueError) as error:
                raise InvalidEpisodeError(
                    f"{path.name} asks for the scenario argument {error}",
                    fix="declare it under [arguments]",
                    where=self._scenario.origin,
                ) from None
            if self._rendered.get(path) != text:
                try:
                    path.write_bytes(self._own(text.encode(), path))
                except CrashhuntError as error:
                    raise InvalidEpisodeError(error.message, fix=error.fix, where=path.name) from None
                self._rendered[path] = text
        options = USUALLY | {canonical(name): _text(value) for name, value in self._sumo.options.items()}
        for name, setup in self._scenario.arguments.items():
            if setup.option and name in values:
                options[canonical(setup.option)] = _text(values[name])
        options = {
            name: self._paths(value.split(",")) if name in INPUTS else value
            for name, value in options.items()
            if not is_output(name) and not is_shown(name)
        }
        options |= {"seed": str(seed), "step-length": repr(self._scenario.step_length_s), **ALWAYS}
        options["net-file"] = self._paths([self._sumo.net])
        for option, names in (("route-files", self._sumo.routes), ("additional-files", self._sumo.additional)):
            if names:
                options[option] = self._paths(names)
        # In one word each: a value that begins with a dash would be taken for the next option.
        return [f"--{name}={value}" for name, value in options.items()]

    def _stage(self, source: Path, staged: Path) -> bool:
        """Copy a file that cannot be read where it is; False for one that can."""
        content = read_xml(source)
        is_net = staged == self._folder / self._sumo.net
        if b"${" in content and not is_net and not self._sumo.literal:
            self._templates[staged] = string.Template(content.decode())
            staged.touch()  # a file that only a trial adds would show as something that the trial left behind
            return True
        own = self._own(content, source)
        if own == content:
            return False
        staged.write_bytes(own)
        return True

    def _own(self, content: bytes, path: Path) -> bytes:
        """The content of a file that reads only what is staged, and writes nothing."""

        def name(reference: Reference) -> str:
            if reference.kind == "written":
                return _NOWHERE
            if not reference.value.startswith("/"):
                return reference.value
            return str(self._folder / os.path.relpath(reference.value, self._scenario.folder))

        return rewritten(content, references(content, str(path)), name)

    def _paths(self, names: list[str] | tuple[str, ...]) -> str:
        return ",".join(self._path(self._folder / name.strip()) for name in names)

    def _path(self, path: Path) -> str:
        """The name of a staged file in an option, where SUMO takes a comma for the end and fills in ``${NAME}``."""
        if not {",", "$"}.intersection(str(path)):
            return str(path)
        parent = str(path.parent)
        if parent not in self._opened:
            self._opened[parent] = os.open(parent, os.O_RDONLY | os.O_DIRECTORY)
        return f"/proc/self/fd/{self._opened[parent]}/{path.name}"


def filled_in(content: bytes, values: Mapping[str, Value]) -> bytes:
    """Return a route or additional file as a trial reads it.

    Raises:
        KeyError: it asks for an argument that is not there.
        ValueError: it is no text, or has a dollar sign that means nothing.
    """
    return _substitute(string.Template(content.decode()), values).encode() if b"${" in content else content


def _substitute(template: string.Template, values: Mapping[str, Value]) -> str:
    return template.substitute({name: _text(value) for name, value in values.items()})


def _text(value: Value) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return str(value)
