"""The programs of the distribution eclipse-sumo: their paths, and how to run them."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.errors import ScenarioError
from crashhunt.base.extras import install_command
from crashhunt.base.processes import running

if TYPE_CHECKING:
    from collections.abc import Sequence

_TIME_LIMIT_S = 1800.0
"""Of one program. netconvert takes 3 s for a town of 6,000 roads; a whole country is no place to hunt in."""

_LEAST_FREE_BYTES = 1 << 16
"""With less, what a program has written may be incomplete, and programs of SUMO do not report that."""


@dataclass(frozen=True, slots=True)
class ToolResult:
    """The exit code and the output of a program."""

    code: int
    output: str


@dataclass(frozen=True, slots=True)
class Tools:
    """An installation of eclipse-sumo."""

    home: Path  # the folder that SUMO's documentation calls SUMO_HOME
    version: str  # version of the distribution, such as ``1.28.0``

    def run(self, program: str, words: Sequence[str], folder: Path) -> ToolResult:
        """Run a program to its end.

        Args:
            program: name of the program, such as ``netconvert``, or of a script below ``tools``, such as
                ``randomTrips.py``.
            words: arguments of the program.
            folder: folder in which the program runs; names in its arguments are relative to this folder.

        Raises:
            ScenarioError: the program cannot be started, takes too long, is killed, or has filled the disk.
        """
        command = [str(self.home / "bin" / program), *words]
        if program.endswith(".py"):
            command = [sys.executable, str(self.home / "tools" / program), *words]
        # Only the child sees SUMO_HOME: libsumo of this process and of trials keeps what the user has set.
        environment = {**os.environ, "SUMO_HOME": str(self.home), "PYTHONDONTWRITEBYTECODE": "1"}
        log = folder / f"{program}.log"
        try:
            with log.open("wb") as file:
                streams = {"stdin": subprocess.DEVNULL, "stdout": file, "stderr": file}
                try:
                    with running(command, cwd=folder, env=environment, **streams) as child:
                        code = child.wait(_TIME_LIMIT_S)
                except subprocess.TimeoutExpired:
                    fix = "choose a smaller map, or a part of it with --bbox W,S,E,N"
                    raise ScenarioError(f"{program} took more than {_TIME_LIMIT_S / 60:g} minutes", fix=fix) from None
        except OSError as error:
            fix = f"install it again: {install_command('maps')} --force-reinstall"
            raise ScenarioError(f"{program} cannot be started: {error.strerror}", fix=fix) from None
        if shutil.disk_usage(folder).free < _LEAST_FREE_BYTES:
            fix = "free some space, or set TMPDIR to a folder on another disk"
            raise ScenarioError(f"{program} has no space left for temporary files", fix=fix, where=str(folder.parent))
        if code < 0:
            fix = "free memory and disk space, or choose a smaller map"
            raise ScenarioError(f"{program} was killed by signal {-code}", fix=fix)
        return ToolResult(code, log.read_text(encoding="utf-8", errors="replace"))


@cache
def find_tools() -> Tools:
    """Return the installed programs of eclipse-sumo.

    Raises:
        ScenarioError: eclipse-sumo is not installed, or its version does not fit that of libsumo.
    """
    install = install_command("maps")
    # The package is called sumo, and so is many a folder of users: only the one of the distribution has programs.
    found = importlib.util.find_spec("sumo")
    home = Path(found.origin).parent if found is not None and found.origin else None
    if home is None or not (home / "bin" / "netconvert").is_file():
        message = "a map becomes a scenario by netconvert, and the package eclipse-sumo is not installed"
        raise ScenarioError(message, fix=install)
    try:
        version, simulator = metadata.version("eclipse-sumo"), metadata.version("libsumo")
    except metadata.PackageNotFoundError as error:
        raise ScenarioError(f"the package {error.name} is not installed", fix=install) from None
    if _release(version) > _release(simulator):
        # A network may hold what came with its version, and an older simulator ignores it or ends.
        message = f"eclipse-sumo {version} is newer than libsumo {simulator}, which would read its networks"
        raise ScenarioError(message, fix=f"pip install 'eclipse-sumo=={simulator}'")
    return Tools(home, version)


def _release(version: str) -> tuple[int, ...]:
    """Return the major and the minor version number; releases that differ only in the third have equal file formats."""
    return tuple(int(part) for part in version.split(".")[:2] if part.isdecimal())


def first_error(output: str) -> str:
    """Return the first error in the output of a program, without its prefix; empty if there is none."""
    for line in output.splitlines():
        if line.startswith("Error:"):
            return line.removeprefix("Error:").strip()
    return ""
