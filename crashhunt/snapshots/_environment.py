"""``environment.json`` of a snapshot: Python, the machine and the installed distributions, on which results depend."""

from __future__ import annotations

import platform
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, NotRequired, TypedDict, cast

from crashhunt.base.plugins import ImportedModules, distributions as installed
from crashhunt.scenario import installed_backends

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.base.binaries import BinaryFacts


class Environment(TypedDict):
    """The contents of ``environment.json``: everything besides code on which a result depends.

    The entry ``simd`` is missing in snapshots of earlier versions. The entry ``git`` has the revision of each work
    tree. The entry ``core`` is whether the simulator's compiled core was used, which does not change results. The entry
    ``origins`` has folders of the snapshot and the user's folders that they copy. If results depend on an order at
    load, ``load_order`` is ``fixed`` or ``not fixed: REASON``. Without ``load_order``, the order was not fixed. The
    entry ``programs`` has architecture, build id and libraries of the programs of agents, by their words in the command
    line.
    """

    schema: int
    python: str
    implementation: str
    platform: str
    machine: str
    cpu: str
    versions: dict[str, str]
    distributions: dict[str, str]
    loaded: list[str]
    variables: dict[str, str]
    simd: NotRequired[str]
    core: NotRequired[str]
    load_order: NotRequired[str]
    programs: NotRequired[dict[str, BinaryFacts]]
    git: NotRequired[dict[str, str]]
    origins: NotRequired[Sequence[tuple[str, str]]]


_VERSIONED = ("crashhunt", "numpy")  # besides those of simulators
_RECORDED_VARIABLES = ("PYTHONHASHSEED", "PYTHONPATH", "OMP_NUM_THREADS", "VIRTUAL_ENV")


def environment(imported: ImportedModules | None = None) -> Environment:
    """Return the contents of ``environment.json``.

    ``loaded`` lists the distributions with an imported module, and those of simulators, because results may depend on
    them. By default, the imported modules are those of this process.
    """
    imported = imported or ImportedModules.here()
    modules, variables = imported.places.keys(), imported.variables
    distributions: dict[str, str] = {}
    named = versions()
    recorded = (*_RECORDED_VARIABLES, *(name for _, backend in installed_backends() for name in backend.variables))
    loaded: set[str] = set()
    for distribution in installed():
        name, version, theirs = _facts_of(distribution)
        if not name or name in distributions:  # of two versions, the first is the one that is imported
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
        "simd": vector_extension(),
        "versions": named,
        "distributions": dict(sorted(distributions.items(), key=lambda item: item[0].lower())),
        "loaded": sorted(loaded, key=str.lower),
        "variables": {name: variables[name] for name in recorded if name in variables},
    }


@lru_cache(maxsize=1024)
def _facts_of(distribution: metadata.Distribution) -> tuple[str, str, set[str]]:
    return *_name_and_version(distribution), _top_level_modules(distribution)


def _name_and_version(distribution: metadata.Distribution) -> tuple[str, str]:
    """Return a distribution's name and version from the head of its metadata; parsing all of it is slow."""
    text = distribution.read_text("METADATA") or distribution.read_text("PKG-INFO") or ""
    head, _, _ = text.partition("\n\n")
    found = dict(line.split(": ", 1) for line in head.splitlines() if line.startswith(("Name: ", "Version: ")))
    if len(found) == 2:
        return found["Name"].strip(), found["Version"].strip()
    return distribution.metadata["Name"] or "", distribution.metadata["Version"] or ""


def _version_of(name: str) -> str:
    """Return the version of a distribution; empty if it is not installed."""
    try:
        return _name_and_version(metadata.distribution(name))[1]
    except metadata.PackageNotFoundError:
        return ""


def _top_level_modules(distribution: metadata.Distribution) -> set[str]:
    """Return the modules of a distribution, like `importlib.metadata.packages_distributions`, but faster."""
    declared = (distribution.read_text("top_level.txt") or "").split()
    if declared:
        return set(declared)
    record = distribution.read_text("RECORD")
    names = map(str, distribution.files or ()) if record is None else record.splitlines()
    files = (name.partition(",")[0].strip('"') for name in names)
    return {file.partition("/")[0].removesuffix(".py") for file in files if file.endswith(".py")}


def versions() -> dict[str, str]:
    """Return the versions that every crash records, including those of all installed simulators."""
    found = {"python": platform.python_version()}
    for name in dict.fromkeys(
        (*_VERSIONED, *(name for _, backend in installed_backends() for name in backend.versions))
    ):
        if version := _version_of(name):
            found[name] = version
    return found


def environment_changes(recorded: Environment) -> dict[str, tuple[str, str]]:
    """Return the versions that differ from an ``environment.json``, each as (recorded, current), by name."""
    loaded = recorded.get("loaded", ())
    now = {
        "python": platform.python_version(),
        "implementation": platform.python_implementation(),
        "machine": platform.machine(),
        "distributions": {name: version for name in loaded if (version := _version_of(name))},
    }
    return differing_versions(recorded, now)


def differing_versions(then: Environment, now: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """Return the versions that differ between two recorded environments, each as (then, now), by name.

    Only distributions that the earlier process had loaded count, without crashhunt, whose code is in the snapshot.
    """
    found = {}
    for name in ("python", "implementation", "machine"):
        was, is_now = str(then.get(name, "")), str(now.get(name, ""))
        if was and is_now and was != is_now:
            found[name] = was, is_now
    before, after = then.get("distributions", {}), now.get("distributions", {})
    for name in then.get("loaded", ()):
        if name != "crashhunt" and name in before and before[name] != (is_now := after.get(name, "not installed")):
            found[name] = before[name], is_now
    return found


def processor() -> str:
    """Return the model of the processor, because NumPy's results may differ between models."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")


def vector_extension() -> str:
    """Return the last vector extension of the processor that NumPy uses, such as ``X86_V3`` or ``AVX512_ICL``.

    NumPy rounds sines differently with AVX-512. The model does not state it: virtual machines with and without this
    extension may both have the model ``AMD EPYC``.
    """
    import numpy as np

    config = cast("dict[str, dict[str, list[str]]]", np.show_config(mode="dicts"))
    return config.get("SIMD Extensions", {}).get("found", [""])[-1]


def environment_of_simulation(found: Environment) -> Environment:
    """Return the environment without distributions that were not loaded, and without the user's folders."""
    loaded = set(found["loaded"])
    distributions = {name: version for name, version in found["distributions"].items() if name in loaded}
    return {**found, "distributions": distributions, "variables": {}, "git": {}, "origins": []}
