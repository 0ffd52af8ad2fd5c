"""The shapes of what describes a snapshot: ``manifest.json`` and ``environment.json``."""

from __future__ import annotations

from typing import TYPE_CHECKING, NotRequired, TypedDict

if TYPE_CHECKING:
    from crashhunt.base.integrity import FileEntry

__all__ = ["Environment", "Manifest"]


class Manifest(TypedDict):
    """``manifest.json``: which files there are, and from where modules are imported.

    ``described`` are the files that say what the snapshot is and are no part of its digest; the earliest had neither
    them nor ``integrity``. ``authentication_code`` proves to the user who took the snapshot that it is unchanged.
    """

    schema: int
    paths: list[str]
    argument_files: dict[str, str]
    left_out: list[str]
    files: dict[str, FileEntry]
    described: NotRequired[dict[str, FileEntry]]
    authentication_code: NotRequired[str]
    integrity: NotRequired[str]


class Environment(TypedDict):
    """``environment.json``: what a result depends on besides code. ``git`` has the revision of each work tree.

    ``core`` is whether the simulator's compiled core was used, which makes no difference to results. ``load_order`` is
    ``fixed`` or ``not fixed: REASON`` where results depend on an order at load; snapshots of earlier versions lack it.
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
    core: NotRequired[str]
    load_order: NotRequired[str]
    git: NotRequired[dict[str, str]]
