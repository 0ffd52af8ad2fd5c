"""The command that installs an extra of crashhunt into the environment of this process."""

from __future__ import annotations

import re
import shlex
import shutil
import sys
from pathlib import Path

from crashhunt.base import layout
from crashhunt.base.text import command_line


def install_command(extra: str) -> str:
    """Return the command that installs an extra, such as ``pip install 'crashhunt[video]'``.

    A clone of the repository is installed in place, and ``scripts/crashhunt`` has its own environment, whose pip is
    not on the PATH. In these cases, the command names the pip of the environment and the folder of the clone.
    """
    programs, root = Path(sys.prefix, "bin"), layout.PACKAGE.parent
    found = shutil.which("pip")
    pip = ["pip"] if found is not None and Path(found).parent == programs else [str(_near(programs / "pip"))]
    if not (programs / "pip").exists():  # such as in an environment that uv has made
        pip = [str(_near(Path(sys.executable))), "-m", "pip"]
    if (root / "pyproject.toml").is_file():
        return command_line(*pip, "install", "-e", f"{_near(root)}[{extra}]")
    return command_line(*pip, "install", f"crashhunt[{extra}]")


def installation_in(fix: str) -> list[str]:
    """Return the words of the command for an extra if the fix of an error contains this command; otherwise no words."""
    named = re.search(r"\[([a-z0-9-]+)\]", fix)
    command = install_command(named[1]) if named is not None else ""
    return shlex.split(command) if command and command in fix else []


def _near(path: Path) -> Path:
    """Return a path relative to the current folder if it lies inside."""
    try:
        return path.relative_to(Path.cwd())
    except (ValueError, OSError):
        return path
