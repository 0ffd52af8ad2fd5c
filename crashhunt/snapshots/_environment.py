"""What a result depends on besides code: Python, the machine, what is installed."""

from __future__ import annotations

import os
import platform
import sys
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.plugins import distributions as installed
from crashhunt.scenario import installed_backends

if TYPE_CHECKING:
    from crashhunt.snapshots._snapshot import Environment

__all__ = ["environment", "environment_changes", "processor", "versions"]

_VERSIONED = ("crashhunt", "numpy")  # besides those of simulators
_VARIABLES = ("PYTHONHASHSEED", "PYTHONPATH", "OMP_NUM_THREADS", "VIRTUAL_ENV")


def environment() -> Environment:
    """Return the content of ``environment.json``.

    ``loaded`` are the distributions of which something has been imported by now: with the simulator's, those on which
    a result may depend.
    """
    modules = {name.partition(".")[0] for name in list(sys.modules)}
    distributions: dict[str, str] = {}
    named = versions()
    loaded: set[str] = set()
    for distribution in installed():
        name, version, theirs = _facts_of(distribution)
        if not name:
            continue
        distributions[name] = version
        if name in named or not modules.isdisjoint(theirs):
            loaded.add(name)
    return {
        "schema": 1,
        "python": platform.python_version(),
        "implementation": platform.python_implementation(),
        "platform": platform.platform(),
        "machine": platform.machine(),
        "cpu": processor(),
        "versions": named,
        "distributions": dict(sorted(distributions.items(), key=lambda item: item[0].lower())),
        "loaded": sorted(loaded, key=str.lower),
        "variables": {name: os.environ[name] for name in _variables() if name in os.environ},
    }


@lru_cache(maxsize=1024)
def _facts_of(distribution: metadata.Distribution) -> tuple[str, str, set[str]]:
    return *_name_and_version(distribution), _top_level_modules(distribution)


def _name_and_version(distribution: metadata.Distribution) -> tuple[str, str]:
    """Read the two out of the text: `Distribution.metadata` parses all of it, which is most of a hunt's start."""
    text = distribution.read_text("METADATA") or distribution.read_text("PKG-INFO") or ""
    head, _, _ = text.partition("\n\n")
    found = dict(line.split(": ", 1) for line in head.splitlines() if line.startswith(("Name: ", "Version: ")))
    if len(found) == 2:
        return found["Name"].strip(), found["Version"].strip()
    return distribution.metadata["Name"] or "", distribution.metadata["Version"] or ""


def _version_of(name: str) -> str:
    return _name_and_version(metadata.distribution(name))[1]


def _top_level_modules(distribution: metadata.Distribution) -> set[str]:
    """What can be imported of it, as `importlib.metadata.packages_distributions` finds it, in a tenth of the time."""
    declared = (distribution.read_text("top_level.txt") or "").split()
    if declared:
        return set(declared)
    record = distribution.read_text("RECORD")
    names = map(str, distribution.files or ()) if record is None else record.splitlines()
    files = (name.partition(",")[0].strip('"') for name in names)
    return {file.partition("/")[0].removesuffix(".py") for file in files if file.endswith(".py")}


def versions() -> dict[str, str]:
    """Return the versions that every crash names: those of all simulators that are installed are among them."""
    found = {"python": platform.python_version()}
    for name in dict.fromkeys(
        (*_VERSIONED, *(name for _, backend in installed_backends() for name in backend.versions))
    ):
        try:
            found[name] = _version_of(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def _variables() -> tuple[str, ...]:
    return (*_VARIABLES, *(name for _, backend in installed_backends() for name in backend.variables))


def environment_changes(recorded: Environment) -> dict[str, tuple[str, str]]:
    """Return what is another version here than in an ``environment.json``: name to (then, now)."""
    changes = {}
    for name, then, now in (
        ("python", recorded.get("python"), platform.python_version()),
        ("implementation", recorded.get("implementation"), platform.python_implementation()),
        ("machine", recorded.get("machine"), platform.machine()),
    ):
        if then not in (None, now):
            changes[name] = (str(then), now)
    distributions = recorded.get("distributions", {})
    for name in recorded.get("loaded", ()):
        try:
            now = _version_of(name)
        except metadata.PackageNotFoundError:
            now = "not installed"
        then = distributions.get(name, now)
        if then != now and name != "crashhunt":  # which comes from the snapshot
            changes[name] = (str(then), now)
    return changes


def processor() -> str:
    """Return the model of the processor; NumPy rounds otherwise on some than on others."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
