"""The Ray actor that runs on each node.

The actor is sent as source code, so that it can report a node without crashhunt. The actor therefore imports nothing of
crashhunt before it has checked the installed version.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
import platform
from pathlib import Path
from typing import Any

_LINK_ORDER = "_crashhunt_link_order"  # the library that fixes the order of SUMO's links; no part of a distribution


class Site:
    """Runs trials on a node.

    All other functions are in ``_node_worker.py`` of the crashhunt that is installed on the node.
    """

    def __init__(self) -> None:
        self._work: Any = None

    def differs(self, versions: dict[str, str], code: str) -> str:
        """Return the differences between the versions on this node and on the hunt's machine; empty for none.

        Args:
            versions: required version by name of each package on which results depend.
            code: the digest of crashhunt's own code, whose version number stays the same during development.
        """
        found = []
        for name, wanted in versions.items():
            try:
                if name in ("python", "machine"):
                    here = platform.python_version() if name == "python" else platform.machine()
                elif name == _LINK_ORDER:
                    here = "installed" if importlib.util.find_spec(name) else "not installed"
                else:
                    here = importlib.metadata.version(name)
            except importlib.metadata.PackageNotFoundError:
                here = "not installed"
            if here != wanted:
                found.append(f"{name} is {here} there and {wanted} here")
        if not found:
            try:
                if code_digest() != code:
                    found.append("crashhunt has the same version and other code there")
            except Exception as error:
                found.append(f"crashhunt cannot be found there ({error})")
        return ", ".join(found)

    def begin(self, job: Any, packed: bytes) -> str:
        """Prepare for the trials of a hunt with the archive of its code; return ``ready`` or an error."""
        from crashhunt.executors.ray._node_worker import Work

        self._work = Work(job)
        return str(self._work.begin(packed))

    def submit(self, trials: list[tuple[int, dict[str, Any]]]) -> None:
        """Queue trials, each with its ticket."""
        self._work.submit(trials)

    def cancel(self, above: int, before: int) -> None:
        """Cancel trials, including trials that arrive after this message."""
        self._work.cancel(above, before)

    def take(self, wait_s: float, trials: list[tuple[int, dict[str, Any]]]) -> Any:
        """Queue trials as `submit` does; return the events since the previous call."""
        return self._work.take(wait_s, trials)

    def close(self) -> None:
        """End all processes on the node."""
        if self._work is not None:
            self._work.close()


def code_digest() -> str:
    """Return the digest of the installed crashhunt's code.

    Raises:
        ImportError: crashhunt is not installed.
    """
    spec = importlib.util.find_spec("crashhunt")
    if spec is None or not spec.submodule_search_locations:
        raise ImportError("no such package")
    root = Path(spec.submodule_search_locations[0])
    digest = hashlib.blake2b(digest_size=16)
    for path in sorted(root.rglob("*.py")):
        name = path.relative_to(root).as_posix()
        if not name.startswith("scenarios/"):  # which lie elsewhere in a checkout
            digest.update(f"{name}\0".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()
