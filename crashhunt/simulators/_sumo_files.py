"""What SUMO is told: options, and files staged in a folder of the worker's own."""

from __future__ import annotations

import string
from typing import TYPE_CHECKING

from crashhunt.errors import InvalidEpisodeError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from crashhunt.scenario import Scenario
    from crashhunt.space import Value

__all__ = ["RESERVED", "StagedFiles"]

_ALWAYS = {
    "random": "false",
    "threads": "1",  # results depend on it
    "device.rerouting.threads": "0",
    "collision.action": "warn",  # keeps the vehicles and the list; the default teleports
    "collision.check-junctions": "true",  # otherwise crossing traffic never collides
    "collision.mingap-factor": "0",  # otherwise a gap below minGap counts as a crash
    "time-to-teleport": "-1",  # otherwise a jam removes vehicles
    "no-step-log": "true",
    "duration-log.disable": "true",
    "xml-validation": "never",
}
RESERVED = frozenset({*_ALWAYS, "seed", "step-length", "net-file", "route-files", "additional-files"})
"""The options that crashhunt sets itself, because a trial means something else with other values."""


class StagedFiles:
    """The scenario's files, as one worker reads them.

    Every file is linked into a folder of the worker's own, so that whatever SUMO writes beside an input file (SUMO
    resolves detector outputs so) stays apart from other workers and from the scenario. A route or additional file
    that says ``${NAME}`` is filled in per trial.

    Args:
        scenario: whose files.
        folder: to stage them in; must exist.
    """

    def __init__(self, scenario: Scenario, folder: Path) -> None:
        if scenario.sumo is None:
            raise InvalidEpisodeError("the scenario has no [sumo] table", fix="add it", where=scenario.origin)
        self._scenario = scenario
        self._sumo = scenario.sumo
        self._folder = folder
        self._templates: dict[Path, string.Template] = {}
        self._rendered: dict[Path, str] = {}
        for name in scenario.files():
            source, staged = scenario.folder / name, folder / name
            staged.parent.mkdir(parents=True, exist_ok=True)
            text = source.read_bytes() if name != self._sumo.net else b""
            if b"${" in text:
                self._templates[staged] = string.Template(text.decode())
            elif not staged.exists():
                staged.symlink_to(source.resolve())

    def arguments(self, seed: int, values: Mapping[str, Value]) -> list[str]:
        """Render the files for one trial and return SUMO's command line without the program.

        Raises:
            InvalidEpisodeError: a file asks for an argument that the scenario does not have.
        """
        for path, template in self._templates.items():
            try:
                text = template.substitute({name: _text(value) for name, value in values.items()})
            except (KeyError, ValueError) as error:
                raise InvalidEpisodeError(
                    f"{path.name} asks for the scenario argument {error}",
                    fix="declare it under [arguments]",
                    where=self._scenario.origin,
                ) from None
            if self._rendered.get(path) != text:
                path.write_text(text)
                self._rendered[path] = text
        options: dict[str, str] = {name: _text(value) for name, value in self._sumo.options.items()}
        for name, setup in self._scenario.arguments.items():
            if setup.option and name in values:
                options[setup.option] = _text(values[name])
        options |= {"seed": str(seed), "step-length": repr(self._scenario.step_length_s), **_ALWAYS}
        options["net-file"] = str(self._folder / self._sumo.net)
        for option, names in (("route-files", self._sumo.routes), ("additional-files", self._sumo.additional)):
            if names:
                options[option] = ",".join(str(self._folder / name) for name in names)
        return [part for name, value in options.items() for part in (f"--{name}", value)]


def _text(value: Value) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return str(value)
